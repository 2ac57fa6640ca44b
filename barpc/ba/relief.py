"""How much of a DEM's relief is believed: scale by scale, as far as the tie points' own heights show it.

A DEM is h = t + e, terrain and error. Where its small slopes are error they pull nowhere, but least squares that
take them for the terrain's find a place where the errors happen to fit, and believe it. What counts is the best
guess of the terrain, given the DEM: sum of gain x band over bands of scales, gain = var t / (var t + var e), for the
rest of the terrain then has nothing to do with the guess and its slopes. The gains come from a regression of the tie points'
heights on the bands (regression calibration: Carroll et al., Measurement Error in Nonlinear Models, ch. 4).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.optimize import lsq_linear

from barpc.geodesy import Array, metres_per_unit, wrap_longitude
from barpc.scene import BoolArray

Terrain = Callable[[Array, Array], Array]
"""lon, lat (n,) [deg] -> altitude (n,) [m above the ellipsoid], NaN where it is unknown."""

SLOPE_STEP = 15.0  # m: slopes of the DEM itself are taken over twice this distance
_NODES = 600  # of the grid on which a DEM is smoothed, along the scene's longer side
_FINEST = 5.0  # m between them, at least
_WIDEST = 16  # the widest smoothing is the scene's longer side over this, as a standard deviation
_MARGIN = 0.1  # of the scene, and
_LEAST_MARGIN = 300.0  # m, as cameras may be off


@dataclass(frozen=True, eq=False)
class Bands:
    """A DEM in bands of scales over a scene, the finest first, and their slopes."""

    terrain: Terrain
    origin: Array  # (2,) lon, lat of the first node [deg]
    unit: Array  # (2,) metres a degree there
    step: float  # m between nodes
    smoothed: tuple[Array, ...]  # the DEM smoothed, each twice as wide as the one before

    @classmethod
    def of(cls, terrain: Terrain, ground: Array) -> Bands:
        """The bands over ground points (n, 3)."""
        lon = wrap_longitude(ground[:, 0], ground[0, 0])
        low = np.array([lon.min(), ground[:, 1].min()])
        high = np.array([lon.max(), ground[:, 1].max()])
        unit = metres_per_unit(np.append((low + high) / 2.0, ground[0, 2]))[:2]
        side = (high - low) * unit
        extent = float(side.max())
        margin = max(_MARGIN * extent, _LEAST_MARGIN)
        step = max((extent + 2 * margin) / _NODES, _FINEST)
        origin = low - margin / unit
        cols, rows = (np.arange(int((s + 2 * margin) / step) + 2) * step for s in side)
        lon, lat = np.meshgrid(origin[0] + cols / unit[0], origin[1] + rows / unit[1])
        heights = np.asarray(terrain(lon.ravel(), lat.ravel()), dtype=np.float64).reshape(lon.shape)
        known = np.isfinite(heights)
        middle = float(np.median(heights[known])) if known.any() else 0.0
        filled, smoothed, width = np.where(known, heights - middle, 0.0), [], step
        while width * _WIDEST <= max(extent, _WIDEST * step):
            of = [gaussian_filter(a, width / step, mode="nearest") for a in (filled, known.astype(np.float64))]
            smoothed.append(middle + of[0] / np.maximum(of[1], 1e-6))
            width *= 2.0
        return cls(terrain, origin, unit, step, tuple(smoothed))

    def local(self, ground: Array) -> Array:
        """Metres east and north (n, 2) of the first node."""
        lon = wrap_longitude(ground[:, 0], self.origin[0])
        return (np.column_stack([lon, ground[:, 1]]) - self.origin) * self.unit

    def at(self, ground: Array) -> tuple[Array, Array]:
        """Heights (K, n) [m] of the bands at ground points (n, 3), which add up to the DEM's, and slopes (K, n, 2)."""
        step = SLOPE_STEP / metres_per_unit(ground)[:, :2]
        lon, lat = ground[:, 0], ground[:, 1]
        east = self.terrain(lon + step[:, 0], lat) - self.terrain(lon - step[:, 0], lat)
        north = self.terrain(lon, lat + step[:, 1]) - self.terrain(lon, lat - step[:, 1])
        heights = [np.asarray(self.terrain(lon, lat), dtype=np.float64)]
        slopes = [np.nan_to_num(np.column_stack([east, north]) / (2.0 * SLOPE_STEP))]
        at = self.local(ground).T[::-1] / self.step
        for layer in self.smoothed:
            sloping = [a / self.step for a in np.gradient(layer)][::-1]
            heights.append(map_coordinates(layer, at, order=1, mode="nearest"))
            slopes.append(np.column_stack([map_coordinates(a, at, order=1, mode="nearest") for a in sloping]))
        return _differences(np.array(heights)), _differences(np.array(slopes))


def _differences(layers: Array) -> Array:
    """Bands of layers (K, ...), each without the next, which is smoother."""
    return np.concatenate([layers[:-1] - layers[1:], layers[-1:]])


@dataclass(frozen=True, eq=False)
class Believed:
    """What is believed of a DEM at points."""

    alt: Array  # (n,) the terrain's altitude [m]; NaN where the DEM has none
    slopes: Array  # (n, 2) towards east and north
    gains: Array  # (K,) of the bands, the finest first
    sigma: float  # standard deviation of single altitudes [m]
    design: float  # as many points are worth one
    agrees: BoolArray  # (n,)
    target: Array


def bends(flat: Array, degree: int = 3) -> Array:
    x, y = flat.T
    return np.column_stack([x**i * y**j for n in range(degree + 1) for i in range(n, -1, -1) for j in [n - i]])


def believe(bands: Bands, ground: Array, tell: BoolArray) -> Believed:
    """What is believed of a DEM at points (n, 3), by the heights of those that `tell` (n,)."""
    heights, slopes = bands.at(ground)
    alt = heights.sum(axis=0)
    known = np.isfinite(alt)
    at = bands.local(ground)
    scale = max(np.ptp(at, axis=0).max() / 2, 1.0)
    flat = (at - at.mean(axis=0)) / scale
    tell = tell & known
    smooth = bends(flat)
    eps = 1e-4
    by = np.stack([(bends(flat + eps * d) - bends(flat - eps * d)) / (2 * eps * scale) for d in np.eye(2)], -1)  # n, m, 2
    trend = np.linalg.lstsq(smooth[tell], heights[:, tell].T, rcond=1e-9)[0]  # (m, K)
    bent = heights - (smooth @ trend).T
    slopes_bent = slopes - np.einsum("nmx,mk->knx", by, trend)
    kept, slope_kept = (smooth @ trend).sum(axis=1), np.einsum("nmx,mk->nx", by, trend)
    agrees = known.copy()
    gains = np.ones(len(bent))
    above = ground[:, 2] - kept
    for _ in range(5):
        sloping = np.einsum("k,knx->nx", gains, slopes_bent)
        shifts = np.column_stack([a * b for a in sloping.T for b in (np.ones(len(flat)), *flat.T)])
        moved = np.column_stack([smooth, shifts])
        use = tell & agrees
        both = np.column_stack([above, bent.T])
        free = both[use] - moved[use] @ np.linalg.lstsq(moved[use], both[use], rcond=1e-9)[0]
        gains = lsq_linear(free[:, 1:], free[:, 0], (0.0, 1.0)).x
        rest = above - bent.T @ gains
        part = moved @ np.linalg.lstsq(moved[use], rest[use], rcond=1e-9)[0]
        left = rest - part
        spread = 1.4826 * np.median(np.abs(left[use]))
        agrees = known & (np.abs(left) < 5.0 * spread)
    sigma = float(np.sqrt(np.mean(left[use] ** 2)))
    score = sloping[use]
    score = score - smooth[use] @ np.linalg.lstsq(smooth[use], score, rcond=1e-9)[0]
    design = _design(at[use], score, left[use])
    guess = kept + gains @ bent
    target = np.where(tell, ground[:, 2] - part, guess)
    return Believed(guess, sloping + slope_kept, gains, sigma, design, agrees, target)


def _design(at: Array, slopes: Array, left: Array) -> float:
    """How many points are worth one: sums of their pull over cells against sums of independent ones."""
    score = slopes * left[:, None]
    found = []
    for cells in (6, 10, 16):
        cell = np.floor((at - at.min(axis=0)) / max(np.ptp(at, axis=0).max(), 1.0) * cells).astype(int)
        number = np.unique(cell @ [1000, 1], return_inverse=True)[1]
        sums = np.stack([np.bincount(number, s) for s in score.T])
        found.append((sums**2).sum(axis=1) / (score**2).sum(axis=0))
    DEBUG.append(np.array(found))
    return float(max(np.max(found), 1.0))
DEBUG = []


def telling(bands, ground, strong, sharp):
    alt = bands.terrain(ground[:, 0], ground[:, 1])
    tell = strong & np.isfinite(alt)
    at = bands.local(ground)
    smooth = bends((at - at[tell].mean(axis=0)) / max(np.ptp(at[tell], axis=0).max() / 2, 1.0))
    off = ground[:, 2] - alt
    off = off - smooth @ np.linalg.lstsq(smooth[tell], off[tell], rcond=1e-9)[0]
    tell &= sharp < 0.25 * 1.4826 * np.median(np.abs(off[tell]))
    return tell
