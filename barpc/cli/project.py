"""`barpc project`, `localize` and `triangulate`: points through cameras, in tables."""

from __future__ import annotations

import csv
import json
import sys
from array import array
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import click
import numpy as np

from barpc.base.errors import InputError
from barpc.base.geodesy import Array
from barpc.base.safe_io import TABLE, opened_text
from barpc.base.verb_options import HeightOptions
from barpc.cameras import open_camera
from barpc.cli.flags import flags_of, given_flags
from barpc.cli.terminal import echo, tell_gate, wants_json
from barpc.verbs import points as verbs
from barpc.verbs.images import place_of

_MAX_INTERSECTION_ERROR = 1.0  # px: lines of sight that a point's places miss by as much (RMS) do not meet
_NUMBERS = {"ignore_unknown_options": True}  # -3.5 is a number, not an option


# --- the verbs ---------------------------------------------------------------------------------------------


def _points_option(columns: str) -> Callable[..., Any]:
    return click.option("--points", metavar="FILE", help=f"CSV with {columns}; - is standard input.")


@click.command("project", context_settings=_NUMBERS)
@click.argument("image")
@click.argument("numbers", nargs=-1, type=float, metavar="[LON LAT ALT]...")
@_points_option("lon, lat, alt")
@flags_of(HeightOptions, alt="Altitude of points without one, where no DEM is given.")
def project(image: str, numbers: tuple[float, ...], points: str | None, alt: float | None, **heights: Any) -> int:
    r"""Print the image points (col, row; the first pixel's centre is 0, 0) of ground points.

    \b
    Examples:
      barpc project image.tif 5.44 43.26 180
      barpc project image.tif --points ground.csv --json
    """
    camera, terrain = open_camera(image), verbs.terrain_of(**given_flags(heights))
    given = given_points(numbers, points, ("lon", "lat", "alt"), fill=np.nan if terrain else alt)
    ground = verbs.with_altitudes(given, None, terrain)
    found = camera.model.project(ground)
    _print_points(("col", "row"), found, (6, 6))
    return _tell_failures(found, "could not be projected", image, verbs.far_outside(camera, ground))


@click.command("localize", context_settings=_NUMBERS)
@click.argument("image")
@click.argument("numbers", nargs=-1, type=float, metavar="[COL ROW]...")
@_points_option("col, row and perhaps alt")
@flags_of(HeightOptions)
def localize(image: str, numbers: tuple[float, ...], points: str | None, alt: float | None, **heights: Any) -> int:
    r"""Print the ground points (lon, lat, alt) seen at image points.

    \b
    Examples:
      barpc localize image.tif 512.5 300 --alt 180
      barpc localize image.tif 512.5 300 --dem N44E005.hgt --geoid egm96
    """
    camera, terrain = open_camera(image), verbs.terrain_of(**given_flags(heights))
    at = given_points(numbers, points, ("col", "row", "alt"), fill=np.nan)
    if terrain is None and (without := np.isnan(at[:, 2])).any():
        at[without, 2] = verbs.altitude_of(camera, place_of(image), alt)
    ground = verbs.ground_at(camera, at[:, :2], at[:, 2], terrain)
    _print_points(("lon", "lat", "alt"), ground, (10, 10, 4))
    return _tell_failures(ground, "have no ground point", image, verbs.far_outside(camera, ground))


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
    names = [f"{axis}{i}" for i in range(1, len(images) + 1) for axis in ("col", "row")]
    if points is None and len(at) != len(images) > 1:
        raise click.UsageError(f"{len(at)} points given with --at for {len(images)} images")
    xy = given_points([v for pair in at for v in pair], points, names).reshape(-1, len(images), 2)
    table = np.column_stack(verbs.triangulate(cameras, xy))
    _print_points(("lon", "lat", "alt", "error"), table, (10, 10, 4, 4))
    apart = np.flatnonzero(table[:, 3] >= _MAX_INTERSECTION_ERROR)
    if not len(apart):
        return _tell_failures(table[:, :1], "could not be intersected")
    failed = int(np.isnan(table[:, 0]).sum())
    worst = f"{len(apart)} of {len(table)} points do not meet: they are up to {table[apart, 3].max():.2f} px apart"
    why = "Wrong correspondences, or cameras that were not adjusted."
    return tell_gate(f"{worst}.", [why] + [f"{failed} could not be intersected."] * bool(failed))


# --- tables of points -------------------------------------------------------------------------------------


_POINT_TABLE = replace(TABLE, empty=True)  # no points, as standard input may have none


def given_points(numbers: Sequence[float], file: str | None, names: Sequence[str], fill: float | None = None) -> Array:
    """Return points (N, columns) from arguments, a CSV file, or standard input ("-").

    A file has a header with the columns' names, or their order; blanks separate, too. `fill` is the value of the last
    column where it is not given.
    """
    if file is not None:
        with nullcontext(sys.stdin) if file == "-" else opened_text(file, _POINT_TABLE, newline="") as stream:
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


def _tell_failures(points: Array, what: str, image: str = "", wrong: str = "") -> int:
    """Return the exit code of a verb on points; those without a value, and what is `wrong`, are said on stderr."""
    count = int((~np.isfinite(points).all(axis=1)).sum())
    reasons = [f"{count} of {len(points)} points {what}"] * bool(count) + [f"{image}: {wrong}"] * bool(wrong)
    return tell_gate("; ".join(reasons), []) if reasons else 0
