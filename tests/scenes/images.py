"""Rendered scenes: cameras, ground, images and the truth about them.

The exact camera of a view is a `Pushbroom`. The delivered one is an RPC fitted to that camera behind the
inverse of a correction (R, T, C), so that P(R (X - T - C) + C) with the delivered P is the exact camera again
(to the fit's 1e-8 px): the correction that an adjustment looks for is known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from barpc.base.errors import InputError
from barpc.base.geodesy import Array
from barpc.fit import fit_rpc
from barpc.scene import BoolArray
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.curve import Curve, rotation_matrix
from barpc.sensor.pushbroom import Pushbroom
from barpc.sensor.rpc import RPC
from barpc.simulate import Look, fly, looks
from tests.scenes.render import Radiometry, expose, render
from tests.scenes.terrain import TALLEST, Float32, Plane, Terrain, make_terrain
from tests.scenes.texture import Date, Surface, make_surfaces

ALTITUDES = (694e3, 617e3, 770e3)
"""Satellites of the first, second and third date [m above the ellipsoid]; then again from the first."""
MIRRORED = 2500
"""Images of more pixels a side show ground that is made for so many, again and again, mirrored: memory is bounded."""
_ROWS, _BLUR = 2048, 8
"""Rows of a picture made at a time, and beside them for the blur."""
_OPEN = 250.0  # m below and above the ground for which a delivered RPC is fitted: its error moves heights


@dataclass(frozen=True)
class ImageOptions:
    """A rendered scene.

    Parameters
    ----------
    views : int
        Number of images.
    size : tuple of int
        Width, height of every image [px].
    seed : int
        The same seed gives the same scene.
    lon, lat, alt : float
        Middle of the scene [deg, deg, m above the ellipsoid].
    gsd : float
        Ground sampling distance at nadir [m].
    relief : float
        Difference between the highest and the lowest ground [m].
    buildings : float
        Buildings a hectare.
    turn : float
        Where the views stand across the flight, 0 to 1: the start of a sequence (see `looks`).
    attitude : float
        Standard deviation of each component of the attitude error [rad].
    position : float
        Standard deviation of each component of the position error [m].
    drift : float
        Standard deviation of each component of the attitude drift over an image's height [rad].
    snr : float
        Ratio of signal to noise of a white plane in full sun; 0: no noise.
    saturation : int
        Largest number in an image.
    sun_azimuth : tuple of float
        Direction to the sun, one a date, clockwise from north [deg]; view i is of date i modulo their number.
    sun_elevation : float
        Of the sun on the first date [deg]; 8 less on every other.
    change : float
        Relative change of the vegetation on every date but the first (standard deviation).
    clouds : float
        Part of every image under clouds.
    checks : int
        Held-out ground points, each seen by two views or more, where the scene has so many.
    gcps : int
        Ground points for use as GCPs, likewise.
    gcp_noise : float
        Standard deviation of the GCPs' image coordinates [px].
    """

    views: int = 3
    size: tuple[int, int] = (1000, 1000)
    seed: int = 0
    lon: float = 5.4
    lat: float = 43.3
    alt: float = 230.0
    gsd: float = 0.5
    relief: float = 60.0
    buildings: float = 8.0
    turn: float = 0.0
    attitude: float = 15e-6
    position: float = 1.0
    drift: float = 0.0
    snr: float = 100.0
    saturation: int = 4095
    sun_azimuth: tuple[float, ...] = (150.0,)
    sun_elevation: float = 50.0
    change: float = 0.0
    clouds: float = 0.0
    checks: int = 200
    gcps: int = 0
    gcp_noise: float = 0.2

    def __post_init__(self) -> None:
        if self.views < 1 or min(self.size) < 64 or max(self.size) > 40000:
            raise InputError("simulate: at least one view, and images of 64 to 40000 px a side")
        if not (0.05 <= self.gsd <= 50.0 and abs(self.lat) <= 85.0 and -500.0 <= self.alt <= 9000.0):
            raise InputError("simulate: gsd 0.05 to 50 m, latitude up to 85 deg, altitude -500 to 9000 m")
        if not 0.0 <= self.clouds < 1.0:
            raise InputError(f"simulate: clouds {self.clouds} is not a part of the image")
        if not self.sun_azimuth or not 10.0 <= self.sun_elevation <= 90.0:
            raise InputError("simulate: a sun azimuth for every date, and a sun at 10 to 90 deg of elevation")
        if not 256 <= self.saturation <= 65535:
            raise InputError(f"simulate: saturation {self.saturation} is not in 256 .. 65535")
        spread = self.attitude, self.position, self.drift, self.gcp_noise
        if min(*spread, self.snr, self.relief, self.buildings, self.change, self.checks, self.gcps) < 0:
            raise InputError("simulate: standard deviations, counts and sizes must not be negative")


@dataclass(frozen=True, eq=False)
class Shot:
    """One view of a scene and everything that is true about it.

    Parameters
    ----------
    name : str
        File stem.
    look : Look
        Where the satellite stands.
    date : int
        Index of the date.
    exact : Pushbroom
        The camera that the image is rendered through.
    exact_rpc : RPC
        An RPC fitted to it.
    delivered : RPC
        The RPC that goes with the image.
    correction : Correction
        Makes the delivered camera exact.
    drift : (3,)
        What the delivered camera turns too far over the height of the image, about its own axes [rad].
    radiometry : Radiometry
        Brightness to numbers.
    """

    name: str
    look: Look
    date: int
    exact: Pushbroom
    exact_rpc: RPC
    delivered: RPC
    correction: Correction
    drift: Array
    radiometry: Radiometry


@dataclass(frozen=True, eq=False)
class Picture:
    """The pixels of a view.

    Parameters
    ----------
    numbers : (H, W)
        uint16; never 0, which is left for nodata.
    altitude : (H, W)
        Of what is seen [m], float32; NaN where a pixel sees more than one surface. Clouds do not count.
    """

    numbers: npt.NDArray[np.uint16]
    altitude: Float32


@dataclass(frozen=True)
class Scene:
    """A scene that can be photographed: `shots` are its cameras, `picture(i)` renders one.

    Parameters
    ----------
    options : ImageOptions
    """

    options: ImageOptions

    @cached_property
    def target(self) -> Array:
        """Ground point (3,) in the middle of every image."""
        return np.array([self.options.lon, self.options.lat, self.options.alt])

    @cached_property
    def alt_range(self) -> tuple[float, float]:
        """Altitudes [m] that the delivered RPCs are fitted for."""
        half = 0.5 * self.options.relief
        low, high = self.options.alt - half, self.options.alt + half + TALLEST
        return float(np.floor(low - _OPEN)), float(np.ceil(high + _OPEN))

    @cached_property
    def shots(self) -> tuple[Shot, ...]:
        """The views."""
        return tuple(self._shot(i) for i in range(self.options.views))

    @cached_property
    def surfaces(self) -> list[Surface]:
        """The ground, one a date."""
        options, rng = self.options, self._rng(-1)
        plane = Plane(options.lon, options.lat)
        corners = np.array([[-0.5, -0.5], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
        corners[1:] = corners[1:] * options.size - 0.5
        low, high = self.alt_range
        levels = np.array([[low + _OPEN], [high - _OPEN]])
        seen = np.concatenate([plane.xy(s.exact.localize(corners, levels)).reshape(-1, 2) for s in self.shots])
        edge = 20.0 * options.gsd
        low, high = seen.min(axis=0) - edge, seen.max(axis=0) + edge
        wide, reach = max(options.size) > MIRRORED, 0.5 * MIRRORED * options.gsd
        part = (np.maximum(low, -reach), np.minimum(high, reach)) if wide else (low, high)  # the plane's origin: middle
        bounds = (*part[0].tolist(), *part[1].tolist())
        terrain = make_terrain(rng, plane, bounds, options.alt, options.relief, options.buildings)
        dates = [
            Date(azimuth, max(options.sun_elevation - 8.0 * (k % 2), 10.0), options.change if k else 0.0)
            for k, azimuth in enumerate(options.sun_azimuth)
        ]
        made = make_surfaces(rng, terrain, 0.5 * options.gsd, dates)
        return [one.mirrored(low, high) for one in made] if wide else made

    @property
    def terrain(self) -> Terrain:
        """Relief and buildings."""
        return self.surfaces[0].terrain

    def picture(self, index: int) -> Picture:
        """Render view `index`."""
        shot = self.shots[index]
        rendering = render(shot.exact, self.options.size, self.surfaces[shot.date])
        numbers = expose(rendering.brightness, shot.radiometry, self._rng(index, 1))
        return Picture(numbers, rendering.altitude)

    def strips(self, index: int) -> Iterator[tuple[int, Picture]]:
        """Render view `index` in parts, each with its first row: memory grows with the width alone."""
        shot, rng, (_, height) = self.shots[index], self._rng(index, 1), self.options.size
        for top in range(0, height, _ROWS):
            end = min(top + _ROWS, height)
            first, last = max(top - _BLUR, 0), min(end + _BLUR, height)
            rendering = render(shot.exact, self.options.size, self.surfaces[shot.date], rows=(first, last))
            kept = slice(top - first, end - first)
            yield top, Picture(expose(rendering.brightness, shot.radiometry, rng)[kept], rendering.altitude[kept])

    def candidates(self, count: int) -> Array:
        """Ground points (count, 3) on the relief and on roofs, before anyone asked who sees them."""
        terrain, rng = self.terrain, self._rng(-2)
        x, y = terrain.relief.axes()
        xy = rng.uniform([x[0], y[0]], [x[-1], y[-1]], (count, 2))
        return terrain.plane.ground(np.column_stack([xy, terrain.highest(*xy.T)]))

    def shows(self, index: int, ground: Array, altitude: Float32) -> tuple[Array, BoolArray]:
        """Exact image points (N, 2) of ground points (N, 3) in a view, and which of them are in sight."""
        image = self.shots[index].exact.project(ground)
        width, height = self.options.size
        with np.errstate(invalid="ignore"):
            inside = np.asarray(((image >= 0) & (image <= (width - 1, height - 1))).all(axis=1))
        cell = np.rint(np.where(inside[:, None], image, 0.0)).astype(np.int64)
        near = np.abs(altitude[cell[:, 1], cell[:, 0]] - ground[:, 2]) < 0.5  # False for NaN
        return image, np.asarray(inside & near)

    def _rng(self, *key: int) -> np.random.Generator:
        """A generator of its own for every purpose: what one draws does not change another."""
        return np.random.default_rng([self.options.seed, *(k + 8 for k in key)])

    def _shot(self, index: int) -> Shot:
        options, rng = self.options, self._rng(index, 0)
        dates = len(options.sun_azimuth)
        date, within = index % dates, index // dates
        count = len(range(date, options.views, dates))
        turn = options.turn + 0.31 * date
        look = looks(count, turn, ALTITUDES[date % len(ALTITUDES)])[within]
        exact = fly(self.target, look, options.size, options.gsd)
        center = exact.position(0.5 * (options.size[1] - 1))
        correction = Correction(rng.normal(0, options.attitude, 3), rng.normal(0, options.position, 3), center)
        drift = rng.normal(0, options.drift, 3)
        wrong = Corrected(_drifting(exact, drift, options.size[1]), inverse(correction))
        accuracy = float(np.hypot(options.attitude * look.altitude, options.position))
        delivered = fit_rpc(wrong, options.size, self.alt_range).rpc
        return Shot(
            name=f"view_{index:0{max(2, len(str(options.views - 1)))}d}",
            look=look,
            date=date,
            exact=exact,
            exact_rpc=fit_rpc(exact, options.size, self.alt_range).rpc,
            delivered=replace(delivered, err_bias=round(accuracy, 2) or None, err_rand=0.1),
            correction=correction,
            drift=drift,
            radiometry=Radiometry(
                gain=float(rng.uniform(1600.0, 2400.0)),
                gamma=float(rng.uniform(0.92, 1.08)),
                offset=float(rng.uniform(40.0, 90.0)),
                snr=options.snr,
                saturation=options.saturation,
                clouds=options.clouds,
            ),
        )


def inverse(correction: Correction) -> Correction:
    """The correction that undoes another: R' = R^T, T' = -R T, about the same C."""
    turn = rotation_matrix(correction.rotation)
    return Correction(-correction.rotation, -turn @ correction.translation, correction.center)


def _drifting(sensor: Pushbroom, drift: Array, height: int) -> Pushbroom:
    """The camera with an attitude that turns by `drift` (3,) more over the image, none in the middle row."""
    curve = sensor.attitude
    coeffs = curve.coeffs.copy()
    rate = drift / (height * sensor.line_period)
    coeffs[:, 0] += rate * (curve.knots[:-1, None] - sensor.time(0.5 * (height - 1)))
    coeffs[:, 1] += rate
    return replace(sensor, attitude=Curve(curve.knots, coeffs))
