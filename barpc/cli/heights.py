"""Altitudes that the command line does not give: of a run's tie points, of a DEM, or none, which is said."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import click
import numpy as np

from barpc.cameras import Camera
from barpc.cli.terminal import say
from barpc.dem import Dem, localize_on_terrain
from barpc.errors import BarpcError
from barpc.geodesy import Array
from barpc.options import GEOID_HELP
from barpc.remote import Place
from barpc.scene import BoolArray

Function = TypeVar("Function", bound=Callable[..., Any])


class Altitudes(NamedTuple):
    """Where a verb takes altitudes from: --alt [m], or --dem and its --geoid."""

    alt: float | None
    dem: str | None
    geoid: str | None

    def terrain(self) -> Dem | None:
        """Return the DEM, if one is given; a usage error beside --alt, or for a geoid alone."""
        return opened_dem(self.dem, self.geoid, self.alt)


def with_heights(alt: str) -> Callable[[Function], Function]:
    """Return the flags --alt, with this help, --dem and --geoid of a verb, which gets them as its `heights`."""

    def added(verb: Function) -> Function:
        @click.option("--alt", type=float, help=alt)
        @click.option("--dem", metavar="FILE", help="Take the altitudes from a DEM.")
        @click.option("--geoid", metavar="NAME|FILE", help=GEOID_HELP)
        @wraps(verb)
        def told(*, alt: float | None, dem: str | None, geoid: str | None, **given: Any) -> Any:
            return verb(heights=Altitudes(alt, dem, geoid), **given)

        return cast(Function, told)

    return added


def opened_dem(dem: str | None, geoid: str | None, alt: float | None = None) -> Dem | None:
    """Return the DEM of a command line, if it gives one; a usage error beside --alt, or for a geoid alone."""
    if dem is None:
        if geoid is not None:
            raise click.UsageError("--geoid goes with --dem")
        return None
    if alt is not None:
        raise click.UsageError("give either --alt or --dem")
    return Dem.open(dem, geoid)


def altitude_of(camera: Camera, image: Place, given: float | None = None) -> float:
    """Return the altitude of an image's ground [m]: as given, of the tie points of its run, else the camera's middle.

    Where nothing is known of the ground a line says so, and what that may be worth.
    """
    if given is not None:
        return given
    for path in (camera.path, image):
        known = _written_in(path.absolute().parent).get(path.name) if isinstance(path, Path) else None
        if known is not None:
            return known
    say(f"{image}: {_unknown(camera)}; give --alt or --dem")
    return camera.altitude


def _unknown(camera: Camera) -> str:
    """Return what it is worth not to know the ground, in words."""
    text = f"its ground is taken at {camera.altitude:g} m, the middle of its altitudes"
    if camera.size is None:
        return text
    at = camera.model.localize((np.array(camera.size) - 1) / 2, np.array(camera.altitude))
    _, jacobian = camera.model.project_jacobian(at)
    return f"{text}: 100 m more or less are {100 * float(np.linalg.norm(jacobian[:, 2])):.3g} px"


@cache
def _written_in(folder: Path) -> dict[str, float]:
    """Return the files that a run wrote for its images into a folder, and the median altitude of its tie points [m]."""
    from barpc.report.tables import read_summary

    if not (folder / "summary.json").is_file():
        return {}
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
    """Return what to say of points (N, 3) far off an image that shows them with lon and lat exchanged; else empty."""
    if camera.size is None or not len(ground):
        return ""
    swapped = ground[:, [1, 0, 2]]
    on_earth = np.abs(swapped[:, 1]) <= 90.0
    if _near(camera, ground).any() or not (on_earth & _near(camera, swapped)).any():
        return ""
    return "far off the image, and on it with longitude and latitude exchanged: give LON first, then LAT"


def _near(camera: Camera, ground: Array) -> BoolArray:
    """Return which points (N, 3) are on the image, or less than its size off it."""
    size = np.array(camera.extent)
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(camera.model.project(ground) - size / 2) <= 1.5 * size).all(axis=1))
