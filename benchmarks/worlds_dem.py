"""DEMs with waves, for `worlds.py`: what barpc is given of the relief, and how wrong it is.

Posts 30 m apart. Single errors of 5 m, alike over some three posts; waves of 1 to 10 km, 2 m together. On top of them
what a family puts in: an offset, a tilt, voids, another place, nothing at all.

    python -m benchmarks.worlds --only dem --solver-only --seeds 0-23
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.worlds_cameras import Array, Relief, compass, ecef

POST, SINGLE, TOGETHER = 30.0, 5.0, 2.0
NUM_WAVES = 24


@dataclass(frozen=True)
class Wrong:
    """What is wrong with a DEM beside its errors as stated: `kind` of a DEM, and how much of it [m]."""

    kind: str = ""
    size: float = 0.0


@dataclass(frozen=True, eq=False)
class Grid:
    """Heights at nodes of a grid in longitude and latitude, and where that is."""

    heights: Array  # (rows, cols) [m], north first
    west: float
    north: float
    step: Array  # (2,) of longitude and latitude [deg]

    def __call__(self, lon: Array, lat: Array) -> Array:
        """Bilinear altitude [m], NaN outside and beside voids."""
        lon, lat = np.broadcast_arrays(lon, lat)
        at = np.stack([(self.north - lat) / self.step[1], (lon - self.west) / self.step[0]])
        return np.asarray(map_coordinates(self.heights, at, order=1, mode="constant", cval=np.nan))


def make_dem(relief: Relief, extent: float, rng: np.random.Generator, wrong: Wrong) -> Grid:
    """The DEM of a relief over `extent` metres and a margin of 1 km."""
    half = int((0.6 * extent + 1000.0) / POST)
    lon0, lat0, alt0 = relief.place
    step = np.array([POST / (111320.0 * np.cos(np.radians(lat0))), POST / 110570.0])
    number = np.arange(-half, half + 1)
    lon, lat = np.meshgrid(lon0 + number * step[0], lat0 - number * step[1])
    enu = _beside(relief.place, lon, lat)
    seen = enu + ([wrong.size, 0.0] if wrong.kind == "elsewhere" else [0.0, 0.0])
    heights = alt0 + _waves_at(seen, relief.waves)
    if wrong.kind == "flat":
        heights = np.full(heights.shape, alt0)
    white = gaussian_filter(rng.normal(size=heights.shape), 1.2, mode="wrap")
    heights = heights + SINGLE * white / white.std() + long_waves(rng)(enu)
    if wrong.kind == "offset":
        heights += wrong.size
    elif wrong.kind == "tilt":
        heights += wrong.size * enu[..., 0] / (0.5 * extent)
    elif wrong.kind == "void":
        heights[np.abs(enu[..., 0]) < wrong.size] = np.nan
    return Grid(heights, lon[0, 0], lat[0, 0], step)


def long_waves(rng: np.random.Generator) -> Callable[[Array], Array]:
    """Waves of `TOGETHER` metres by metres east and north (..., 2)."""
    length = np.exp(rng.uniform(np.log(1e3), np.log(1e4), NUM_WAVES))
    angle, phase = rng.uniform(0, 2 * np.pi, (2, NUM_WAVES))
    size = rng.uniform(0.5, 1.0, NUM_WAVES)
    size *= TOGETHER / np.sqrt(0.5 * np.sum(size**2))
    number = 2 * np.pi / length
    waves = np.column_stack([number * np.cos(angle), number * np.sin(angle), size, phase])
    return lambda enu: _waves_at(enu, waves)


def _waves_at(enu: Array, waves: Array) -> Array:
    flat = enu.reshape(-1, 2)
    parts = np.array_split(flat, len(flat) // 20000 + 1)
    found = [np.sin(part @ waves[:, :2].T + waves[:, 3]) @ waves[:, 2] for part in parts]
    return np.concatenate(found).reshape(enu.shape[:-1])


def _beside(place: Array, lon: Array, lat: Array) -> Array:
    """Metres east and north (..., 2) of a place at which `worlds_cameras.beside` has points of lon, lat."""
    axes, alt = compass(place), np.full(lon.shape, place[2])
    for _ in range(5):
        off = (ecef(np.stack([lon, lat, alt], -1)) - ecef(place)) @ axes.T
        alt = alt - off[..., 2]
    return np.asarray(off[..., :2])


def main() -> None:
    """Say what this is for."""
    argparse.ArgumentParser(description="DEMs for benchmarks/worlds.py, which has the commands.").parse_args()


if __name__ == "__main__":
    main()
