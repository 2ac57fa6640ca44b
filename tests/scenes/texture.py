"""What the ground looks like on a date: fields, roads, trees, relief shading and cast shadows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from barpc.base.geodesy import Array
from tests.scenes.terrain import Float32, Grid, Ray, Terrain, fractal

IntIndex = npt.NDArray[np.signedinteger[Any]]

AMBIENT = 0.35
"""Light of the sky, as a part of the light on a plane that faces the sun."""


@dataclass(frozen=True)
class Date:
    """The light, and what has changed since the first date.

    Parameters
    ----------
    sun_azimuth, sun_elevation : float
        Direction to the sun, clockwise from north, above the horizon [deg].
    change : float
        Relative change of the vegetation's brightness (standard deviation).
    """

    sun_azimuth: float = 150.0
    sun_elevation: float = 50.0
    change: float = 0.0

    @property
    def sun(self) -> Array:
        """Unit vector (3,) to the sun: x (east), y (north), up."""
        azimuth, elevation = np.radians([self.sun_azimuth, self.sun_elevation])
        flat = np.cos(elevation)
        return np.array([flat * np.sin(azimuth), flat * np.cos(azimuth), np.sin(elevation)])


@dataclass(frozen=True, eq=False)
class Surface:
    """Brightness of everything that can be seen, on one date.

    Parameters
    ----------
    terrain : Terrain
        What it lies on.
    ground : Grid
        Brightness of the bare ground, light and shadows included; 1 is a white plane in full sun.
    detail : Grid
        Fine structure for roofs and walls, mean 0.
    roof, wall : (B,)
        Reflectance of every building's roof and walls.
    date : Date
        The light.
    """

    terrain: Terrain
    ground: Grid
    detail: Grid
    roof: Array
    wall: Array
    date: Date

    def mirrored(self, low: Array, high: Array) -> Surface:
        """The same with all of it again and again, mirrored, as far as `low` and `high` (2,) [m]."""
        relief = self.terrain.relief
        start = relief.origin
        side = relief.step * (np.array(relief.values.shape[::-1]) - 1)
        first, last = (np.floor((edge - start) / side).astype(int) for edge in (low, high))
        buildings = self.terrain.buildings.repeated(start, side, first, last)
        times = int(np.prod(last - first + 1))
        terrain = replace(self.terrain, relief=replace(relief, beyond="mirror"), buildings=buildings)
        grids = replace(self.ground, beyond="mirror"), replace(self.detail, beyond="mirror")
        return Surface(terrain, *grids, np.tile(self.roof, times), np.tile(self.wall, times), self.date)

    def building(self, index: IntIndex, wall: IntIndex, x: Array, y: Array, alt: Array) -> Float32:
        """Brightness (N,) of places x, y, alt (N,) [m] on buildings, on the roof or a wall."""
        buildings = self.terrain.buildings
        cosine, sine = np.cos(buildings.angle[index]), np.sin(buildings.angle[index])
        dx, dy = x - buildings.center[index, 0], y - buildings.center[index, 1]
        u, v = cosine * dx + sine * dy, cosine * dy - sine * dx
        along = np.where(wall == 1, v, u)
        place = np.where(wall > 0, alt - buildings.foot[index], v)
        room = self.detail.step * np.array(self.detail.values.shape[::-1]) - 80.0
        start = self.detail.origin + 40.0  # another part of the detail for every building
        start = start + (7.0 * np.abs(buildings.center[index])) % np.maximum(room, 1.0)
        detail = self.detail(start[:, 0] + np.where(wall > 0, along, u), start[:, 1] + place)
        first = np.where(wall == 1, np.sign(u), 0.0)
        second = np.where(wall == 2, np.sign(v), 0.0)
        sun = self.date.sun
        facing = (cosine * first - sine * second) * sun[0] + (sine * first + cosine * second) * sun[1]
        light = AMBIENT + (1 - AMBIENT) * np.where(wall > 0, np.maximum(facing, 0.0), sun[2])
        tone = np.where(wall > 0, self.wall[index], self.roof[index])
        return np.asarray(light * tone * np.clip(1.0 + 0.25 * detail, 0.3, 2.0), dtype=np.float32)


def make_surfaces(rng: np.random.Generator, terrain: Terrain, step: float, dates: list[Date]) -> list[Surface]:
    """Surfaces of one place on several dates.

    Parameters
    ----------
    rng : numpy.random.Generator
    terrain : Terrain
    step : float
        Distance of the texture's nodes [m]; half a pixel shows everything that an image can.
    dates : list of Date

    Returns
    -------
    surfaces : list of Surface
        One a date.
    """
    relief = terrain.relief
    x, y = relief.axes()
    shape = (int((y[-1] - y[0]) / step) + 1, int((x[-1] - x[0]) / step) + 1)
    detail = fractal(rng, shape, 0.9)
    albedo, green = _albedo(rng, shape, detail, step)
    count = len(terrain.buildings)
    roof, wall = rng.uniform(0.12, 0.75, count), rng.uniform(0.15, 0.5, count)
    surfaces = []
    for date in dates:
        today = albedo
        if date.change:
            today = albedo * np.clip(1.0 + date.change * green * fractal(rng, shape, 0.9), 0.2, 3.0)
        light = _resampled(_light(relief, date), relief.step / step, shape)
        lit = Grid(relief.origin, step, light)
        _cast(terrain, lit, date)
        light = ndimage.gaussian_filter(lit.values, 0.7)
        surfaces.append(
            Surface(
                terrain,
                Grid(relief.origin, step, (today * light).astype(np.float32)),
                Grid(relief.origin, step, detail),
                roof,
                wall,
                date,
            )
        )
    return surfaces


def _albedo(rng: np.random.Generator, shape: tuple[int, int], detail: Float32, step: float) -> tuple[Float32, Float32]:
    """Reflectance of the ground and how green it is (0 to 1): fields, roads, trees, fine structure."""
    coarse = tuple(n // 4 + 2 for n in shape)
    waves = [_resampled(fractal(rng, (coarse[0], coarse[1]), 1.9, 4.0), 4.0, shape) for _ in range(3)]
    field = (np.floor(3.0 * waves[0]) * 31 + np.floor(3.0 * waves[1]) * 7).astype(np.int64) % 64
    albedo = rng.uniform(0.14, 0.42, 64).astype(np.float32)[field]
    green = rng.uniform(0.0, 1.0, 64).astype(np.float32)[field]
    gradient = np.hypot(*np.gradient(waves[2]))
    road = np.abs(waves[2] % 1.2 - 0.6) < 3.0 / step * gradient
    albedo[road], green[road] = 0.34, 0.0
    albedo *= 1.0 + np.where(road, 0.04, 0.22).astype(np.float32) * detail
    trees = _trees(rng, shape, step) * (green > 0.3)
    albedo *= 1.0 - 0.65 * trees
    blurred: Float32 = ndimage.gaussian_filter(np.clip(albedo, 0.03, 0.9), 0.8)
    return blurred, np.maximum(green, trees)


def _trees(rng: np.random.Generator, shape: tuple[int, int], step: float) -> Float32:
    """Crowns of 1.5 to 4 m radius, about 60 a hectare: 1 in a crown, 0 elsewhere."""
    crowns = np.zeros(shape, dtype=np.float32)
    for radius in (1.5, 2.5, 4.0):
        count = int(20e-4 * shape[0] * shape[1] * step * step)
        cells = int(np.ceil(radius / step))
        offset = np.arange(-cells, cells + 1)
        rows, cols = np.nonzero(np.hypot(offset[:, None], offset) * step <= radius)
        at_row = rng.integers(cells, shape[0] - cells, count)[:, None] + rows - cells
        at_col = rng.integers(cells, shape[1] - cells, count)[:, None] + cols - cells
        crowns[at_row, at_col] = 1.0
    return crowns


def _light(relief: Grid, date: Date) -> Float32:
    """Light (H, W) on the nodes of the relief, without shadows."""
    by_y, by_x = np.gradient(relief.values.astype(np.float64), relief.step)
    sun = date.sun
    facing = (sun[2] - by_x * sun[0] - by_y * sun[1]) / np.sqrt(1.0 + by_x**2 + by_y**2)
    return np.asarray(AMBIENT + (1 - AMBIENT) * np.maximum(facing, 0.0), dtype=np.float32)


def _cast(terrain: Terrain, lit: Grid, date: Date) -> None:
    """Darken, in place, what lies in the shadow of a building."""
    sun, buildings = date.sun, terrain.buildings
    x, y = lit.axes()
    reach = -sun[:2] / sun[2]
    corners = buildings.corners()
    for i in range(len(buildings)):
        foot = corners[i, 4:, :2]
        tip = foot + reach * (buildings.top[i] - buildings.foot[i])
        low, high = (f(np.concatenate([foot, tip]), axis=0) for f in (np.min, np.max))
        cols = slice(*np.searchsorted(x, (low[0], high[0])))
        rows = slice(*np.searchsorted(y, (low[1], high[1])))
        px, py = np.meshgrid(x[cols], y[rows])
        if not px.size:
            continue
        alt = terrain.relief(px, py).astype(np.float64)
        slope = np.broadcast_to(sun[:2] / sun[2], (*px.shape, 2))
        start, stop, _ = buildings.inside(i, Ray(px, py, slope[..., 0], slope[..., 1], alt))
        dark = stop > np.maximum(start, alt)
        part = lit.values[rows, cols]
        part[dark] = np.minimum(part[dark], AMBIENT * 0.9)


def _resampled(values: Float32, factor: float, shape: tuple[int, int]) -> Float32:
    """Values on a grid `factor` times as fine, linear in between."""
    out = values
    for axis, count in enumerate(shape):
        place = np.minimum(np.arange(count) / factor, out.shape[axis] - 1.000001)
        cell = place.astype(np.int64)
        weight = np.expand_dims((place - cell).astype(np.float32), 1 - axis)
        low, high = np.take(out, cell, axis=axis), np.take(out, cell + 1, axis=axis)
        out = low + weight * (high - low)
    return out
