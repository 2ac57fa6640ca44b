"""`barpc project`, `localize` and `triangulate`: points through cameras, in tables."""

from __future__ import annotations

import csv
import json
import sys
from array import array
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from functools import cache, wraps
from pathlib import Path
from typing import Any, cast

import click
import numpy as np

from barpc.base.errors import BarpcError, InputError
from barpc.base.geodesy import Array, ground_from_ecef, wrap_longitude
from barpc.base.options import GEOID_HELP
from barpc.base.remote import PathOrUrl
from barpc.base.safe_io import TABLE, opened_text
from barpc.cameras import open_camera, split_spec
from barpc.cli.flags import Function
from barpc.cli.terminal import echo, remark, tell_gate, wants_json
from barpc.rasters.dem import Dem, localize_on_terrain
from barpc.scene import BoolArray, Camera
from barpc.sensor import geometry
from barpc.sensor.rpc import RPC

_SAME_PLACE = 0.01  # deg: places that are one; others that are seen alike lie degrees away
_MAX_INTERSECTION_ERROR = 1.0  # px: lines of sight that a point's places miss by as much (RMS) do not meet
_NUMBERS = {"ignore_unknown_options": True}  # -3.5 is a number, not an option


# --- altitudes that the command line does not give --------------------------------------------------------


def with_heights(alt: str, both: bool = False) -> Callable[[Function], Function]:
    """Return the flags --alt, with this help, --dem and --geoid of a verb, which gets `alt` [m] and `terrain`, a DEM.

    A usage error for a geoid alone, and for --alt beside --dem unless a verb takes `both`.
    """

    def added(verb: Function) -> Function:
        @click.option("--alt", type=float, help=alt)
        @click.option("--dem", metavar="FILE", multiple=True, help="Take the altitudes from a DEM (repeatable).")
        @click.option("--geoid", metavar="NAME|FILE", help=GEOID_HELP)
        @wraps(verb)
        def told(*, alt: float | None, dem: tuple[str, ...], geoid: str | None, **given: Any) -> Any:
            if geoid is not None and not dem:
                raise click.UsageError("--geoid goes with --dem")
            if dem and alt is not None and not both:
                raise click.UsageError("give either --alt or --dem")
            return verb(alt=alt, terrain=Dem.open(dem, geoid) if dem else None, **given)

        return cast(Function, told)

    return added


def altitude_of(camera: Camera, image: PathOrUrl, given: float | None = None) -> float:
    """Return the altitude of an image's ground [m]: as given, of the tie points of its run, else the camera's middle.

    Where nothing is known of the ground a line says so, and what that may be worth.
    """
    if given is not None:
        return given
    for path in (camera.path, image):
        known = _written_in(path.absolute().parent).get(path.name) if isinstance(path, Path) else None
        if known is not None:
            return known
    remark(f"{image}: {_unknown(camera)}; give --alt or --dem")
    return camera.altitude


def _unknown(camera: Camera) -> str:
    """Return the error by an unknown terrain height, in words."""
    text = f"terrain height unknown, {camera.altitude:g} m assumed (the middle of the camera's altitude range)"
    if camera.size is None:
        return text
    at = camera.model.localize((np.array(camera.size) - 1) / 2, np.array(camera.altitude))
    _, jacobian = camera.model.project_jacobian(at)
    return f"{text}: an error of 100 m shifts the result by {100 * float(np.linalg.norm(jacobian[:, 2])):.3g} px"


@cache
def _written_in(folder: Path) -> dict[str, float]:
    """Return the files that a run wrote for its images into a folder, and the median altitude of its tie points [m]."""
    if not (folder / "summary.json").is_file():
        return {}
    from barpc.report.runfiles import read_summary  # with all that a run has to say: as long again as the cameras take

    try:
        summary = read_summary(folder)
    except BarpcError:
        return {}
    if summary.altitude_m is None:
        return {}
    return {name: summary.altitude_m for view in summary.views for name in view.outputs}


def ground_at(camera: Camera, image: Array, alt: Array | float, dem: Dem | None) -> Array:
    """Return ground points (N, 3) of image points (N, 2), on the DEM where there is one, else at altitudes [m]."""
    if dem is not None:
        return localize_on_terrain(camera.model, image, dem, camera.alt_range)
    return camera.model.localize(image, np.broadcast_to(np.asarray(alt, dtype=np.float64), len(image)))


def exchanged(camera: Camera, ground: Array) -> str:
    """Return a remark on points (N, 3) outside an image that covers them with lon and lat exchanged; else empty."""
    if not len(ground) or (camera.size is None and not isinstance(camera.model, RPC)):
        return ""
    swapped = ground[:, [1, 0, 2]]
    if _on_image(camera, ground).any() or not _on_image(camera, swapped[np.abs(swapped[:, 1]) <= 90.0]).any():
        return ""
    return "far off the image, and on it with longitude and latitude exchanged: give LON first, then LAT"


def _on_image(camera: Camera, ground: Array) -> BoolArray:
    """Return which points (N, 3) are on the image, or less than its size off it: as stated, or that of an RPC alone.

    Far out an RPC comes near its image again; there it shows another place.
    """
    if camera.size is None:
        middle, side = camera.rpc.image_offset, 2.0 * np.abs(camera.rpc.image_scale)
    else:
        middle, side = np.array(camera.size) / 2, np.array(camera.size)
    image = camera.model.project(ground)
    near = np.asarray((np.abs(image - middle) <= 1.5 * side).all(axis=1))
    off = camera.model.localize(image[near], ground[near, 2]) - ground[near]
    near[near] = (np.abs(np.column_stack([wrap_longitude(off[:, 0]), off[:, 1]])) <= _SAME_PLACE).all(axis=1)
    return near


# --- the verbs ---------------------------------------------------------------------------------------------


def _points_option(columns: str) -> Callable[..., Any]:
    return click.option("--points", metavar="FILE", help=f"CSV with {columns}; - is standard input.")


@click.command("project", context_settings=_NUMBERS)
@click.argument("image")
@click.argument("numbers", nargs=-1, type=float, metavar="[LON LAT ALT]...")
@_points_option("lon, lat, alt")
@with_heights("Altitude of points without one [m above the ellipsoid].", both=True)
def project(image: str, numbers: tuple[float, ...], points: str | None, alt: float | None, terrain: Dem | None) -> int:
    r"""Print the image points (col, row; the first pixel's centre is 0, 0) of ground points.

    \b
    Examples:
      barpc project image.tif 5.44 43.26 180
      barpc project image.tif --points ground.csv --json
    """
    camera = open_camera(image)
    ground = given_points(numbers, points, ("lon", "lat", "alt"), fill=np.nan if terrain else alt)
    if terrain is not None:
        ground[:, 2] = terrain(ground[:, 0], ground[:, 1])
    found = camera.model.project(ground)
    _print_points(("col", "row"), found, (6, 6))
    if wrong := exchanged(camera, np.nan_to_num(ground)):
        return tell_gate(f"{image}: {wrong}", [])
    return _tell_failures(found, "could not be projected")


@click.command("localize", context_settings=_NUMBERS)
@click.argument("image")
@click.argument("numbers", nargs=-1, type=float, metavar="[COL ROW]...")
@_points_option("col, row and perhaps alt")
@with_heights(
    "Altitude of points without one [m].  [default: of the run's tie points, else the middle of the camera's]",
    both=True,
)
def localize(image: str, numbers: tuple[float, ...], points: str | None, alt: float | None, terrain: Dem | None) -> int:
    r"""Print the ground points (lon, lat, alt) seen at image points.

    \b
    Examples:
      barpc localize image.tif 512.5 300 --alt 180
      barpc localize image.tif 512.5 300 --dem N44E005.hgt --geoid egm96
    """
    camera = open_camera(image)
    at = given_points(numbers, points, ("col", "row", "alt"), fill=np.nan)
    if terrain is None and (without := np.isnan(at[:, 2])).any():
        at[without, 2] = altitude_of(camera, split_spec(image)[0], alt)
    ground = ground_at(camera, at[:, :2], at[:, 2], terrain)
    _print_points(("lon", "lat", "alt"), ground, (10, 10, 4))
    return _tell_failures(ground, "have no ground point")


@click.command("triangulate", context_settings=_NUMBERS)
@click.argument("images", nargs=-1, required=True, metavar="IMAGE IMAGE...")
@click.option("--at", type=(float, float), multiple=True, help="COL ROW, once for each image.")
@_points_option("col1, row1, col2, row2, ...")
def triangulate(images: tuple[str, ...], at: tuple[tuple[float, float], ...], points: str | None) -> int:
    r"""Print the ground points intersected from several images, and their residuals.

    A point that an image does not see has nan there. `error` is the root mean square distance between a
    point's projections and what was given [px]; exit code 3 where it is a pixel or more, as lines of sight that far
    apart do not meet.

    \b
    Examples:
      barpc triangulate left.tif right.tif --at 512 300 --at 498 301
      barpc triangulate a.tif b.tif c.tif --points ties.csv
    """
    cameras = [open_camera(image) for image in images]
    if len(cameras) < 2:
        raise click.UsageError("one image; the lines of sight of at least two can meet")
    names = [f"{axis}{i}" for i in range(1, len(cameras) + 1) for axis in ("col", "row")]
    if points is None and len(at) != len(cameras):
        raise click.UsageError(f"{len(at)} points given with --at for {len(cameras)} images")
    xy = given_points([v for pair in at for v in pair], points, names).reshape(-1, len(cameras), 2)
    point, view = np.nonzero(np.isfinite(xy).all(axis=2))
    models = [camera.model for camera in cameras]
    found = geometry.triangulate(models, view, point, xy[point, view], alt=cameras[0].altitude)
    table, count = np.full((len(xy), 4), np.nan), len(found.points)
    square = np.bincount(point, (found.residuals**2).sum(axis=1), minlength=count)
    table[:count, :3] = ground_from_ecef(found.points)
    with np.errstate(invalid="ignore", divide="ignore"):
        table[:count, 3] = np.sqrt(square / np.bincount(point, minlength=count))
    _print_points(("lon", "lat", "alt", "error"), table, (10, 10, 4, 4))
    apart = np.flatnonzero(table[:, 3] >= _MAX_INTERSECTION_ERROR)
    if not len(apart):
        return _tell_failures(table[:, :1], "could not be intersected")
    failed = int(np.isnan(table[:, 0]).sum())
    worst = f"{len(apart)} of {len(table)} points do not meet: they are up to {table[apart, 3].max():.2f} px apart"
    why = "Wrong correspondences, or cameras that were not adjusted."
    return tell_gate(f"{worst}.", [why] + [f"{failed} could not be intersected."] * bool(failed))


# --- tables of points -------------------------------------------------------------------------------------


def given_points(numbers: Sequence[float], file: str | None, names: Sequence[str], fill: float | None = None) -> Array:
    """Return points (N, columns) from arguments, a CSV file, or standard input ("-").

    A file has a header with the columns' names, or their order; blanks separate, too. `fill` is the value of the last
    column where it is not given.
    """
    if file is not None:
        with nullcontext(sys.stdin) if file == "-" else opened_text(file, TABLE, newline="") as stream:
            return _point_table(stream, file, names, fill)
    width = len(names) if fill is None else len(names) - 1
    if not numbers or len(numbers) % width:
        wanted = " ".join(names[:width]).upper()
        raise click.UsageError(f"{len(numbers)} numbers; give {wanted} of each point, or --points FILE")
    points = np.array(numbers, dtype=np.float64).reshape(-1, width)
    return points if fill is None else np.column_stack([points, np.full(len(points), fill)])


def _point_table(lines: Iterable[str], file: str, names: Sequence[str], fill: float | None) -> Array:
    columns, found, width = list[int](), array("d"), len(names)
    for row in filter(None, map(_split_line, lines)):
        if not columns:
            columns = list(range(width))
            if not _is_number(row[0]):
                header = [cell.strip().lower() for cell in row]
                columns = [header.index(name) if name in header else -1 for name in names]
                if -1 in columns[: -1 if fill is not None else None]:
                    raise InputError(f"{file}: columns {', '.join(names)} expected, found {', '.join(header)}")
                continue
        place = f"{file}: point {len(found) // width + 1}"
        for name, column in zip(names, columns, strict=True):
            if 0 <= column < len(row):
                if not _is_number(row[column]):
                    raise InputError(f"{place}: {row[column]!r} is no number")
                found.append(float(row[column]))
            elif fill is None or name != names[-1]:
                raise InputError(f"{place} has {len(row)} columns, expected {', '.join(names)}")
            else:
                found.append(fill)
    return np.array(found).reshape(-1, width)


def _split_line(line: str) -> list[str]:
    line = line.split("#", 1)[0].strip()
    return next(csv.reader([line])) if "," in line else line.split()


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _print_points(names: Sequence[str], values: Array, digits: Sequence[int]) -> None:
    """Print a table of points as CSV with a header, or as a JSON list of objects (null for NaN)."""
    rows = [list(zip(row, digits, strict=True)) for row in values.tolist()]
    if wants_json():
        plain = [[round(v, d) if np.isfinite(v) else None for v, d in row] for row in rows]
        echo(json.dumps([dict(zip(names, row, strict=True)) for row in plain]))
        return
    for line in (names, *([f"{v:.{d}f}" for v, d in row] for row in rows)):
        echo(",".join(line))


def _tell_failures(points: Array, what: str) -> int:
    """Return the exit code of a verb on points; where some came out without a value, it is said on stderr."""
    count = int((~np.isfinite(points).all(axis=1)).sum())
    return tell_gate(f"{count} of {len(points)} points {what}", []) if count else 0
