"""`barpc localize`: image points to ground points."""

from __future__ import annotations

import click

from barpc.cli.points import (
    NUMBERS,
    camera_options,
    load_camera,
    middle_altitude,
    print_points,
    read_points,
    tell_failures,
)
from barpc.dem import Dem, localize_on_terrain
from barpc.sensor.geometry import altitude_range


@click.command("localize", context_settings=NUMBERS)
@click.argument("image")
@click.argument("numbers", nargs=-1, type=float, metavar="[COL ROW]...")
@click.option("--points", metavar="FILE", help="CSV with col, row and perhaps alt; - is standard input.")
@click.option("--alt", type=float, help="Altitude of points without one [m].  [default: the RPC's middle]")
@click.option("--dem", metavar="FILE", help="Intersect the lines of sight with a DEM.")
@click.option("--geoid", metavar="FILE", help="Geoid grid for a DEM of orthometric heights.")
@camera_options
def command(
    image: str,
    numbers: tuple[float, ...],
    points: str | None,
    alt: float | None,
    dem: str | None,
    geoid: str | None,
    pixel_convention: str,
    band: int,
    as_json: bool,
) -> int:
    r"""Print the ground points (lon, lat, alt) seen at image points.

    \b
    Examples:
      barpc localize image.tif 512.5 300 --alt 180
      barpc localize image.tif 512.5 300 --dem N44E005.hgt --geoid egm96_15.gtx
    """
    camera = load_camera(image, pixel_convention, band)
    fill = middle_altitude(camera.rpc) if alt is None else alt
    at = read_points(numbers, points, ("col", "row", "alt"), fill=fill)
    if dem is not None:
        terrain = Dem.open(dem, geoid)
        ground = localize_on_terrain(camera.rpc, at[:, :2], terrain, altitude_range(camera.rpc))
    else:
        ground = camera.rpc.localize(at[:, :2], at[:, 2])
    print_points(("lon", "lat", "alt"), ground, (10, 10, 4), as_json)
    return tell_failures(ground, "have no ground point")
