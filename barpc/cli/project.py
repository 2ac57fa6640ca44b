"""`barpc project`: ground points to image points."""

from __future__ import annotations

import click
import numpy as np

from barpc.cameras import open_camera
from barpc.cli.points import NUMBERS, as_json, print_points, read_points, tell_failures
from barpc.dem import Dem


@click.command("project", context_settings=NUMBERS)
@click.argument("image")
@click.argument("numbers", nargs=-1, type=float, metavar="[LON LAT ALT]...")
@click.option("--points", metavar="FILE", help="CSV with lon, lat, alt; - is standard input.")
@click.option("--alt", type=float, help="Altitude of points without one [m above the ellipsoid].")
@click.option("--dem", metavar="FILE", help="Take the altitudes from a DEM.")
@click.option("--geoid", metavar="FILE", help="Geoid grid for a DEM of orthometric heights.")
@as_json
def command(
    image: str,
    numbers: tuple[float, ...],
    points: str | None,
    alt: float | None,
    dem: str | None,
    geoid: str | None,
    as_json: bool,
) -> int:
    r"""Print the image points (col, row; the first pixel's centre is 0, 0) of ground points.

    \b
    Examples:
      barpc project image.tif 5.44 43.26 180
      barpc project image.tif --points ground.csv --json
    """
    terrain = Dem.open(dem, geoid) if dem else None
    camera = open_camera(image)
    ground = read_points(numbers, points, ("lon", "lat", "alt"), fill=np.nan if terrain else alt)
    if terrain is not None:
        ground[:, 2] = terrain(ground[:, 0], ground[:, 1])
    found = camera.model.project(ground)
    print_points(("col", "row"), found, (6, 6), as_json)
    return tell_failures(found, "could not be projected")
