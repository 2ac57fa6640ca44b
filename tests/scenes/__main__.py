"""Synthetic images whose cameras and ground are known.

python -m tests.scenes scene --views 5 --size 2000 2000
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from barpc.base.errors import BarpcError
from tests.scenes.files import write_scene
from tests.scenes.images import ImageOptions

HELP = {
    "views": "Number of images.",
    "size": "Width and height.",
    "seed": "Another number is another scene.",
    "center": "Middle of the scene, degrees and metres above the ellipsoid.",
    "gsd": "Ground sampling at nadir, metres.",
    "relief": "Highest minus lowest ground, metres.",
    "buildings": "Buildings a hectare.",
    "turn": "Another set of viewpoints, 0 to 1.",
    "attitude": "Attitude error, microradians a component.",
    "position": "Position error, metres a component.",
    "drift": "Attitude drift over an image, microradians.",
    "snr": "Signal to noise in full sun; 0: no noise.",
    "saturation": "Largest pixel value.",
    "sun_azimuth": "Direction to the sun; give it several times for several dates.",
    "change": "Change of the vegetation between dates, 0 to 1.",
    "clouds": "Part of every image under clouds, 0 to 1.",
    "checks": "Held-out check points.",
    "gcps": "Ground control points (gcps.geojson).",
}
"""Flags that are fields of `ImageOptions`, or, below, not quite."""
SPELT: dict[str, dict[str, Any]] = {
    "size": {"nargs": 2, "type": int, "metavar": "W H"},
    "center": {"nargs": 3, "type": float, "metavar": "LON LAT ALT", "default": (5.4, 43.3, 230.0)},
    "attitude": {"default": 15.0},
    "sun_azimuth": {"multiple": True, "type": float, "metavar": "DEG"},
}


def scene_flags(function: Callable[..., None]) -> Callable[..., None]:
    """The flags of `HELP`, with the scene's own defaults."""
    for name, text in reversed(HELP.items()):
        spelt = {"default": getattr(ImageOptions, name, None)} | SPELT.get(name, {})
        function = click.option(f"--{name.replace('_', '-')}", show_default=True, help=text, **spelt)(function)
    return function


@click.command()
@click.argument("out", metavar="OUT")
@scene_flags
@click.option("--overwrite", is_flag=True, help="Replace files of an earlier run.")
def command(
    out: str, center: tuple[float, float, float], attitude: float, drift: float, overwrite: bool, **scene: Any
) -> None:
    """Make synthetic images with known cameras and truth.

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
