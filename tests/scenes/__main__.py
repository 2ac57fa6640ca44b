"""Synthetic images whose cameras and ground are known.

python -m tests.scenes scene --views 5 --size 2000 2000
"""

from __future__ import annotations

from typing import Any

import click

from barpc.base.errors import BarpcError
from tests.scenes.files import write_scene
from tests.scenes.images import ImageOptions


@click.command()
@click.argument("out", metavar="OUT")
@click.option("--views", default=3, show_default=True, help="Number of images.")
@click.option(
    "--size",
    nargs=2,
    type=int,
    default=(1000, 1000),
    show_default=True,
    help="Width and height.",
    metavar="W H",
)
@click.option("--seed", default=0, show_default=True, help="Another number is another scene.")
@click.option(
    "--center",
    nargs=3,
    type=float,
    default=(5.4, 43.3, 230.0),
    show_default=True,
    metavar="LON LAT ALT",
    help="Middle of the scene, degrees and metres above the ellipsoid.",
)
@click.option("--gsd", default=0.5, show_default=True, help="Ground sampling at nadir, metres.")
@click.option("--relief", default=60.0, show_default=True, help="Highest minus lowest ground, metres.")
@click.option("--buildings", default=8.0, show_default=True, help="Buildings a hectare.")
@click.option("--turn", default=0.0, show_default=True, help="Another set of viewpoints, 0 to 1.")
@click.option("--attitude", default=15.0, show_default=True, help="Attitude error, microradians a component.")
@click.option("--position", default=1.0, show_default=True, help="Position error, metres a component.")
@click.option("--drift", default=0.0, show_default=True, help="Attitude drift over an image, microradians.")
@click.option("--snr", default=100.0, show_default=True, help="Signal to noise in full sun; 0: no noise.")
@click.option("--saturation", default=4095, show_default=True, help="Largest pixel value.")
@click.option(
    "--sun-azimuth",
    multiple=True,
    type=float,
    default=(150.0,),
    show_default=True,
    metavar="DEG",
    help="Direction to the sun; give it several times for several dates.",
)
@click.option("--change", default=0.0, show_default=True, help="Change of the vegetation between dates, 0 to 1.")
@click.option("--clouds", default=0.0, show_default=True, help="Part of every image under clouds, 0 to 1.")
@click.option("--checks", default=200, show_default=True, help="Held-out check points.")
@click.option("--gcps", default=0, show_default=True, help="Ground control points (gcps.geojson).")
@click.option("--overwrite", is_flag=True, help="Replace files of an earlier run.")
def command(
    out: str,
    center: tuple[float, float, float],
    attitude: float,
    drift: float,
    overwrite: bool,
    **scene: Any,
) -> None:
    r"""Make synthetic images with known cameras and truth.

    OUT receives one GeoTIFF a view, with a delivered RPC that is wrong by a known correction, and truth.json
    with the exact corrections, the exact RPCs and held-out check points.

    \b
    Examples:
      python -m tests.scenes scene --views 5 --size 2000 2000
      python -m tests.scenes dates --views 6 --sun-azimuth 150 --sun-azimuth 215 --change 0.3 --clouds 0.15
    """
    lon, lat, alt = center
    try:
        options = ImageOptions(lon=lon, lat=lat, alt=alt, attitude=attitude * 1e-6, drift=drift * 1e-6, **scene)
        paths = write_scene(out, options, overwrite=overwrite)
    except BarpcError as error:
        raise click.ClickException(str(error)) from error
    for path in paths:
        click.echo(path)


if __name__ == "__main__":
    command(prog_name="python -m tests.scenes")
