"""`barpc project`, `localize` and `triangulate`: points through cameras, in tables."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from typing import Any

import click
import numpy as np

from barpc.cameras import open_camera, split_spec
from barpc.cli.heights import Altitudes, altitude_of, exchanged, ground_at, opened_dem, with_heights
from barpc.cli.terminal import echo, tell_gate, wants_json
from barpc.errors import InputError
from barpc.geodesy import Array, ground_from_ecef
from barpc.sensor import geometry
from barpc.sidefile import TABLE, opened_text

_APART = 1.0  # px: lines of sight that a point's places miss by as much (RMS) do not meet
_NUMBERS = {"ignore_unknown_options": True}  # -3.5 is a number, not an option


def _points(columns: str) -> Callable[..., Any]:
    return click.option("--points", metavar="FILE", help=f"CSV with {columns}; - is standard input.")


@click.command("project", context_settings=_NUMBERS)
@click.argument("image")
@click.argument("numbers", nargs=-1, type=float, metavar="[LON LAT ALT]...")
@_points("lon, lat, alt")
@with_heights("Altitude of points without one [m above the ellipsoid].")
def project(image: str, numbers: tuple[float, ...], points: str | None, heights: Altitudes) -> int:
    r"""Print the image points (col, row; the first pixel's centre is 0, 0) of ground points.

    \b
    Examples:
      barpc project image.tif 5.44 43.26 180
      barpc project image.tif --points ground.csv --json
    """
    terrain = opened_dem(heights.dem, heights.geoid)
    camera = open_camera(image)
    ground = given_points(numbers, points, ("lon", "lat", "alt"), fill=np.nan if terrain else heights.alt)
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
@_points("col, row and perhaps alt")
@with_heights(
    "Altitude of points without one [m].  [default: of the run's tie points, else the middle of the camera's]"
)
def localize(image: str, numbers: tuple[float, ...], points: str | None, heights: Altitudes) -> int:
    r"""Print the ground points (lon, lat, alt) seen at image points.

    \b
    Examples:
      barpc localize image.tif 512.5 300 --alt 180
      barpc localize image.tif 512.5 300 --dem N44E005.hgt --geoid egm96
    """
    terrain = opened_dem(heights.dem, heights.geoid)
    camera = open_camera(image)
    at = given_points(numbers, points, ("col", "row", "alt"), fill=np.nan)
    if terrain is None and (without := np.isnan(at[:, 2])).any():
        at[without, 2] = altitude_of(camera, split_spec(image)[0], heights.alt)
    ground = ground_at(camera, at[:, :2], at[:, 2], terrain)
    _print_points(("lon", "lat", "alt"), ground, (10, 10, 4))
    return _tell_failures(ground, "have no ground point")


@click.command("triangulate", context_settings=_NUMBERS)
@click.argument("images", nargs=-1, required=True, metavar="IMAGE IMAGE...")
@click.option("--at", type=(float, float), multiple=True, help="COL ROW, once for each image.")
@_points("col1, row1, col2, row2, ...")
def triangulate(images: tuple[str, ...], at: tuple[tuple[float, float], ...], points: str | None) -> int:
    r"""Print the ground points where the lines of sight of several images meet, and the error that is left.

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
    apart = np.flatnonzero(table[:, 3] >= _APART)
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
            return _table(stream, file, names, fill)
    width = len(names) if fill is None else len(names) - 1
    if not numbers or len(numbers) % width:
        wanted = " ".join(names[:width]).upper()
        raise click.UsageError(f"{len(numbers)} numbers; give {wanted} of each point, or --points FILE")
    points = np.array(numbers, dtype=np.float64).reshape(-1, width)
    return points if fill is None else np.column_stack([points, np.full(len(points), fill)])


def _table(lines: Iterable[str], file: str, names: Sequence[str], fill: float | None) -> Array:
    rows = [row for line in lines if (row := _cells(line))]
    columns = list(range(len(names)))
    if rows and not _is_number(rows[0][0]):
        header = [cell.strip().lower() for cell in rows.pop(0)]
        columns = [header.index(name) if name in header else -1 for name in names]
        if -1 in columns[: -1 if fill is not None else None]:
            raise InputError(f"{file}: columns {', '.join(names)} expected, found {', '.join(header)}")
    points = np.empty((len(rows), len(names)))
    if fill is not None:
        points[:, -1] = fill
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            if 0 <= column < len(row):
                if not _is_number(row[column]):
                    raise InputError(f"{file}: point {i + 1}: {row[column]!r} is no number")
                points[i, j] = float(row[column])
            elif fill is None or j < len(names) - 1:
                raise InputError(f"{file}: point {i + 1} has {len(row)} columns, expected {', '.join(names)}")
    return points


def _cells(line: str) -> list[str]:
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
