"""`barpc triangulate`: corresponding image points to ground points."""

from __future__ import annotations

import click
import numpy as np

from barpc.cameras import open_camera
from barpc.cli.points import NUMBERS, as_json, print_points, read_points, tell_failures
from barpc.geodesy import ground_from_ecef
from barpc.sensor.geometry import triangulate


@click.command("triangulate", context_settings=NUMBERS)
@click.argument("images", nargs=-1, required=True, metavar="IMAGE IMAGE...")
@click.option("--at", type=(float, float), multiple=True, help="COL ROW, once for each image.")
@click.option("--points", metavar="FILE", help="CSV with col1, row1, col2, row2, ...; - is standard input.")
@as_json
def command(
    images: tuple[str, ...],
    at: tuple[tuple[float, float], ...],
    points: str | None,
    as_json: bool,
) -> int:
    r"""Print the ground points where the lines of sight of several images meet, and the error that is left.

    A point that an image does not see has nan there. `error` is the root mean square distance between a
    point's projections and what was given [px].

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
    xy = read_points([v for pair in at for v in pair], points, names).reshape(-1, len(cameras), 2)
    point, view = np.nonzero(np.isfinite(xy).all(axis=2))
    models = [camera.model for camera in cameras]
    found = triangulate(models, view, point, xy[point, view], alt=cameras[0].altitude)
    table = np.full((len(xy), 4), np.nan)
    square = np.bincount(point, (found.residuals**2).sum(axis=1), minlength=len(found.points))
    count = np.bincount(point, minlength=len(found.points))
    table[: len(found.points), :3] = ground_from_ecef(found.points)
    with np.errstate(invalid="ignore", divide="ignore"):
        table[: len(found.points), 3] = np.sqrt(square / count)
    print_points(("lon", "lat", "alt", "error"), table, (10, 10, 4, 4), as_json)
    return tell_failures(table[:, :1], "could not be intersected")
