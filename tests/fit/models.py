"""Sensor models that an RPC follows badly: wide, bent, shaken, or on top of the world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace

import numpy as np
from numpy.polynomial import Polynomial

from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, ground_from_ecef
from barpc.fit import RpcFit
from barpc.simulate import Look, fly
from tests.fit.cameras import synthetic_rpc

FLAT = SimpleNamespace(localize=lambda image, alt: np.column_stack([image, alt]), project=lambda ground: ground[:, :2])
"""A camera whose image is the ground."""


@dataclass(frozen=True)
class Bent:
    """A model whose image is moved by a smooth or rough field of its ideal image points (..., 2) [px]."""

    model: object
    moves: Callable[[Array], Array]

    def project(self, ground: Array) -> Array:
        ideal = self.model.project(ground)
        return ideal + self.moves(ideal)

    def localize(self, image: Array, alt: Array) -> Array:
        ideal = image
        for _ in range(60):
            ideal = image - self.moves(ideal)
        return self.model.localize(ideal, alt)


@dataclass(frozen=True)
class Frame:
    """A pinhole over lon, lat that looks down, with the radial distortion k1 of Brown at the unit focal length."""

    lon: float
    lat: float
    alt: float
    focal: float
    size: tuple[int, int]
    k1: float = 0.0

    def _pose(self) -> tuple[Array, Array]:
        ground = np.array([self.lon, self.lat, self.alt])
        east, north, up = enu_basis(ground)
        return ecef_from_ground(ground), np.stack([east, -north, -up])

    def project(self, ground: Array) -> Array:
        place, axes = self._pose()
        seen = (ecef_from_ground(ground) - place) @ axes.T
        xy = seen[..., :2] / seen[..., 2:]
        bent = xy * (1.0 + self.k1 * (xy**2).sum(axis=-1, keepdims=True))
        return self.focal * bent + (np.array(self.size) - 1) / 2

    def localize(self, image: Array, alt: Array) -> Array:
        place, axes = self._pose()
        bent = (image - (np.array(self.size) - 1) / 2) / self.focal
        xy = bent
        for _ in range(60):
            xy = bent / (1.0 + self.k1 * (xy**2).sum(axis=-1, keepdims=True))
        ray = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1) @ axes
        alt = np.broadcast_to(alt, ray.shape[:-1])
        depth = self.alt - alt
        for _ in range(12):
            ground = ground_from_ecef(place + depth[..., None] * ray)
            depth = depth + (ground[..., 2] - alt)
        return np.concatenate([ground[..., :2], alt[..., None]], axis=-1)


@dataclass(frozen=True)
class Radar:
    """Zero-Doppler images of 12000 x 9000 px, 50 km wide, from a straight flight."""

    lon: float
    lat: float
    heading: float
    side: float  # 1: looks to the right
    ground_range: bool = False

    def localize(self, image: Array, alt: Array) -> Array:
        image, alt = np.broadcast_arrays(image, np.asarray(alt)[..., None])
        target = np.array([self.lon, self.lat, 0.0])
        axes = enu_basis(target)
        turn = np.radians(self.heading)
        ahead = axes.T @ [np.sin(turn), np.cos(turn), 0.0]
        right = axes.T @ [np.cos(turn), -np.sin(turn), 0.0]
        up = axes[2]
        start = ecef_from_ground(target) + 600e3 * up - self.side * 400e3 * right
        along = ahead * (image[..., 1:] - 4500) * 1.5
        far = 5e4 * (image[..., :1] / 12000 - 0.5)
        slant = np.sqrt(600e3**2 + (400e3 + far) ** 2) if self.ground_range else 721e3 + 0.55 * far
        angle = np.full(slant.shape, np.arctan2(400e3, 600e3))
        for _ in range(12):  # the look angle at which the beam's circle has the altitude
            place = start + along + slant * (np.sin(angle) * self.side * right - np.cos(angle) * up)
            turned = slant * (np.cos(angle) * self.side * right + np.sin(angle) * up)
            normal = enu_basis(ground_from_ecef(place))[..., 2, :]
            rise = (turned * normal).sum(axis=-1, keepdims=True)
            angle = angle + (alt[..., :1] - ground_from_ecef(place)[..., 2:]) / rise
        return ground_from_ecef(place)


def pushbroom(lat: float, size: tuple[int, int] = (20000, 20000), gsd: float = 0.5, incidence: float = 12.0):
    """An orbiting pushbroom over longitude 5.4 [deg]."""
    return fly(np.array([5.4, lat, 200.0]), Look(incidence=incidence, azimuth=100.0), size, gsd)


def whiskbroom(half_angle: float, size: tuple[int, int] = (2000, 2000)):
    """Columns are steps of one angle, to `half_angle` [deg] either side: a scanner from 700 km."""
    plain = pushbroom(45.0, size, 500.0, 0.0)
    u = np.linspace(-1.0, 1.0, 400)
    angle = np.radians(half_angle) * u
    series = Polynomial.fit(u, np.tan(angle), 25).convert().coef
    scale = np.power(0.5 * (size[0] - 1), -np.arange(len(series), dtype=np.float64))
    return replace(plain, look=np.stack([0.0 * series, -series * scale]))


def bump(size: tuple[int, int], width: float, height: float, at: tuple[float, float]) -> Callable[[Array], Array]:
    """A Gaussian bump of the columns: `width` (one sigma) and height in px, `at` as parts of the image."""
    middle = np.array(size) * at

    def moves(image: Array) -> Array:
        away = ((image - middle) ** 2).sum(axis=-1) / width**2
        return np.stack([height * np.exp(-0.5 * away), 0.0 * away], axis=-1)

    return moves


def waves(rows: int, cycles: float, height: float) -> Callable[[Array], Array]:
    """Columns and rows that swing with the row."""

    def moves(image: Array) -> Array:
        phase = 2.0 * np.pi * cycles * image[..., 1] / rows
        return height * np.stack([np.sin(phase), np.cos(phase + 1.0)], axis=-1)

    return moves


def quotient(x: Array, basis: Array) -> Array:
    """Values (N,) of a numerator (20) and a denominator (19 behind a 1) `x` (39,) of terms (20, N)."""
    return (x[:20] @ basis) / (np.append(1.0, x[20:]) @ basis)


SIZE = (20000, 20000)
RANGE = (0.0, 1500.0)


@cache
def hard() -> dict[str, tuple[object, tuple[int, int], tuple[float, float]]]:
    """Name -> model, size, altitude range: what a cubic RPC cannot follow to a thousandth of a pixel."""
    wide, low = (14000, 10000), (0.0, 600.0)
    smooth = pushbroom(45.0)
    bends = {
        "distortion": lambda p: 3e-13 * (p - 1e4) ** 3 + 2e-17 * (p - 1e4) ** 4,
        **{f"waves {cycles:g}": waves(20000, cycles, 0.5) for cycles in (0.25, 1.0, 7.0, 60.0)},
        "bump": bump(SIZE, 250.0, 0.5, (0.37, 0.61)),
        "bump in a corner": bump(SIZE, 250.0, 0.5, (0.01, 0.99)),
    }
    return {
        **{f"frame, k1 {k1:g}": (Frame(5.4, 43.2, 5000.0, 12000.0, wide, k1), wide, low) for k1 in (-0.1, 0.02)},
        "whiskbroom 110 deg": (whiskbroom(55.0), (2000, 2000), RANGE),
        "pushbroom at 89.9 N": (pushbroom(89.9), SIZE, RANGE),
        "pushbroom at 78 N, 100k rows": (pushbroom(78.0, (20000, 100000)), (20000, 100000), RANGE),
        "wide pushbroom": (pushbroom(45.0, (20000, 40000), 15.0), (20000, 40000), (0.0, 4000.0)),
        **{name: (Bent(smooth, moves), SIZE, RANGE) for name, moves in bends.items()},
    }


def made(**changes: object) -> RpcFit:
    """A fit of these figures: a good one, but for what is changed."""
    one = np.ones(2)
    values: dict[str, object] = {
        "rpc": synthetic_rpc(), "rmse_cnp": one * 1e-3, "max_cnp": one * 2e-3, "rmse_ckp": one * 3e-3,
        "max_ckp": one * 5e-3, "beyond": 1e-3, "min_denominator": 0.9, "roundtrip": 1e-9, "coverage": 1.0, "h": one,
        "iterations": 1, "num_cnp": 100, "num_ckp": 50, "method": "ridge",
    }  # fmt: skip
    return RpcFit(**{**values, **changes})  # type: ignore[arg-type]
