"""A scene over the years: many dates, each with its own season; seasons near in the year look alike, others do not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from barpc.base.geodesy import Array
from barpc.scene import BoolArray, View
from barpc.sensor.rpc import RPC
from barpc.sensor.triangulation import triangulate
from tests.everywhere import rows_of
from tests.scenes.files import _write_image
from tests.scenes.images import ImageOptions, Scene
from tests.scenes.render import expose, render
from tests.scenes.season import CLASSES, unlit
from tests.scenes.terrain import Float32, fractal
from tests.scenes.texture import Surface, _albedo

_ANCHORS = 4  # times of the year with tones of their own, which other days lie between


@dataclass(frozen=True)
class Years:
    """Views of many dates.

    Parameters
    ----------
    phases : tuple of float
        Time of the year of each date, 0 to 1; snow lies about 0.
    views : tuple of int
        Date of each view.
    size : tuple of int
        Of every image [px].
    seed : int
        Another number is another scene.
    growth : float
        How much of the ground is that of its time of the year alone, and not of the place: 0 to 1.
    snow : float
        Part of the ground under snow in the middle of the winter.
    clouds : tuple of float
        Part of the images under clouds, one a date; shorter: none.
    shift, stretch : float
        Standard deviations of what is wrong with the delivered RPCs: of their image offsets [px] and scales, which
        no rotation or translation of a camera makes up for.
    """

    phases: tuple[float, ...]
    views: tuple[int, ...]
    size: tuple[int, int] = (256, 256)
    seed: int = 0
    growth: float = 0.3
    snow: float = 0.5
    clouds: tuple[float, ...] = ()
    shift: float = 12.0
    stretch: float = 2e-4

    @cached_property
    def scene(self) -> Scene:
        """Cameras and ground; the light of each view is that of the same hour."""
        options = ImageOptions(
            len(self.views), self.size, self.seed, attitude=0.0, position=0.0, turn=0.37, buildings=4.0
        )
        return Scene(options)

    @cached_property
    def delivered(self) -> list[RPC]:
        """The RPCs that go with the images."""
        rng, out = np.random.default_rng([self.seed, 83]), []
        for shot in self.scene.shots:
            offset = shot.exact_rpc.image_offset + rng.normal(0, self.shift, 2)
            scale = shot.exact_rpc.image_scale * (1 + rng.normal(0, self.stretch, 2))
            out.append(replace(shot.exact_rpc, image_offset=offset, image_scale=scale, err_bias=8.0))
        return out

    def write(self, folder: Path) -> list[View]:
        """Render the images into a folder: their views, with the dates that they are of."""
        season, out = _Seasons(self), []
        for i, (shot, date) in enumerate(zip(self.scene.shots, self.views, strict=True)):
            cloudy = dict(enumerate(self.clouds)).get(date, 0.0)
            light = render(shot.exact, self.size, season.surface(date)).brightness
            numbers = expose(light, replace(shot.radiometry, clouds=cloudy), np.random.default_rng([self.seed, 84, i]))
            path = folder / f"{shot.name}.tif"
            _write_image(path, numbers, self.delivered[i])
            out.append(View(shot.name, str(path), self.size, self.delivered[i], self.scene.alt_range))
        return out

    def errors(self, sensors: list[RPC], seen: BoolArray | None = None) -> Array:
        """RMS error (N,) [px] of exact places in each view, or those `seen`, from where all say the points are."""
        axes = (np.linspace(-30.0, 30.0, 5) * self.size[0] / 256.0 / 111e3, np.linspace(-20.0, 20.0, 3))
        east, north, up = (axis.ravel() for axis in np.meshgrid(axes[0], axes[0], axes[1]))
        ground = self.scene.target + np.stack([east / np.cos(np.radians(43.3)), north, up], axis=1)
        shots = np.array(self.scene.shots, dtype=object)[slice(None) if seen is None else seen]
        xy = np.stack([shot.exact.project(ground) for shot in shots], axis=1)
        found = triangulate(sensors, *rows_of(xy), alt=float(self.scene.target[2]))
        return np.asarray(np.sqrt((found.residuals.reshape(xy.shape) ** 2).sum(axis=2).mean(axis=0)))


class _Seasons:
    """What the ground looks like over the year."""

    def __init__(self, years: Years) -> None:
        self._years, scene = years, years.scene
        self._base = scene.surfaces[0]
        rng = np.random.default_rng([years.seed, 82])
        shape, step = self._base.ground.values.shape, self._base.ground.step
        self._light, self._albedo, self._local, self._kind = unlit(scene)
        tones = np.linspace(0.08, 0.5, CLASSES)
        self._tone = np.array([rng.permutation(tones) for _ in range(_ANCHORS)])
        self._sign = np.array([rng.permutation(np.where(np.arange(CLASSES) % 2, -1.0, 1.0)) for _ in range(_ANCHORS)])
        self._roof = rng.uniform(0.1, 0.8, (_ANCHORS, len(self._base.roof)))
        self._grown = [_albedo(rng, shape, fractal(rng, shape, 0.9), step)[0] for _ in range(_ANCHORS)]
        self._drifts = fractal(rng, shape, 1.2)  # where snow stays longest
        self._white = 0.02 * fractal(rng, shape, 0.9)

    def surface(self, date: int) -> Surface:
        """The ground on a date."""
        phase, rng = self._years.phases[date], np.random.default_rng([self._years.seed, 85, date])
        first, share = int(phase * _ANCHORS) % _ANCHORS, phase * _ANCHORS % 1.0

        def of(table: Array) -> Array:
            return np.asarray((1 - share) * table[first] + share * table[(first + 1) % _ANCHORS])

        today = of(self._tone)[self._kind] + of(self._sign)[self._kind] * (self._albedo - self._local)
        grown = (1 - share) * self._grown[first] + share * self._grown[(first + 1) % _ANCHORS]
        today = (1 - self._years.growth) * today + self._years.growth * grown
        today = today * (1.0 + 0.05 * fractal(rng, today.shape, 0.9))
        cover = self._years.snow * max(0.0, np.cos(2 * np.pi * phase))
        if cover:
            white = self._drifts > np.quantile(self._drifts[::7, ::7], 1.0 - cover)
            today = np.where(white, 0.85 + self._white, today)
        ground: Float32 = (np.clip(today, 0.03, 0.95) * self._light).astype(np.float32)
        return replace(self._base, ground=replace(self._base.ground, values=ground), roof=of(self._roof))
