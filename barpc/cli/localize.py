"""`barpc localize`: image points to ground points."""

from __future__ import annotations

import click

from barpc.cameras import open_camera
from barpc.cli.points import NUMBERS, as_json, print_points, read_points, tell_failures
from barpc.dem import Dem, localize_on_terrain


@click.command("localize", context_settings=NUMBERS)
@click.argument("image")
@click.argument("numbers", nargs=-1, type=float, metavar="[COL ROW]...")
@click.option("--points", metavar="FILE", help="CSV with col, row and perhaps alt; - is standard input.")
@click.option(
    "--alt", type=float, help="Altitude of points without one [m].  [default: the middle of the camera's]"
)
@click.option("--dem", metavar="FILE", help="Intersect the lines of sight with a DEM.")
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
    r"""Print the ground points (lon, lat, alt) seen at image points.

    \b
    Examples:
      barpc localize image.tif 512.5 300 --alt 180
      barpc localize image.tif 512.5 300 --dem N44E005.hgt --geoid egm96_15.gtx
    """
    camera = open_camera(image)
    fill = camera.altitude if alt is None else alt
    at = read_points(numbers, points, ("col", "row", "alt"), fill=fill)
    if dem is not None:
        terrain = Dem.open(dem, geoid)
        ground = localize_on_terrain(camera.model, at[:, :2], terrain, camera.alt_range)
    else:
        ground = camera.model.localize(at[:, :2], at[:, 2])
    print_points(("lon", "lat", "alt"), ground, (10, 10, 4), as_json)
    return tell_failures(ground, "have no ground point")
