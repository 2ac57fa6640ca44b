"""Tracks that the rays alone do not fix in height: which they are, and what holds them."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from barpc.ba.blocks import PointPrior, Terrain, flat_heights, join_point_priors, terrain_heights
from barpc.ba.cameras import Projected
from barpc.ba.problem import Problem
from barpc.ba.structure import Structure
from barpc.errors import BarpcWarning
from barpc.geodesy import Array, ground_from_ecef
from barpc.options import AdjustOptions
from barpc.scene import BoolArray, IntArray

_FLAT_SIGMA = 50.0  # m: least spread of altitudes that tracks held without a DEM are given
_TOGETHER = (
    0.25  # of that spread: what their mean may be wrong by (RPCs' ranges lie about the terrain, roughly)
)


def convergence_angles(structure: Structure, projected: Projected, points: Array) -> Array:
    """Largest angle (P,) [rad] between a point's rays and their mean, doubled: the angle of two rays."""
    by_point = projected.by_point
    ray = np.cross(by_point[0], by_point[1], axis=0)
    up = structure.of_points(points)
    with np.errstate(all="ignore"):
        ray *= np.sign((ray * up).sum(axis=0)) / np.linalg.norm(ray, axis=0)
    ray = np.nan_to_num(ray)
    mean = structure.sum_points(ray)
    mean /= np.maximum(np.linalg.norm(mean, axis=0), 1e-12)
    apart = np.linalg.norm(ray - mean.take(structure.point, axis=1, mode="clip"), axis=0)
    largest = np.zeros(structure.num_points)
    np.maximum.at(largest, structure.point, apart)
    angle: Array = 4.0 * np.arcsin(np.minimum(0.5 * largest, 1.0))
    return angle


@dataclass(frozen=True)
class Heights:
    """The priors on points: GCPs, and heights for tracks that need (or are given) them."""

    control: tuple[PointPrior, ...]  # GCPs
    weak: BoolArray  # (P,) points whose rays meet under too small an angle
    tracks: IntArray  # (T,) points that are tracks (GCPs are held already)
    alt_range: tuple[float, float]  # altitudes [m] to expect where no other track tells
    options: AdjustOptions  # `dem_sigma`, `dem_for_all`
    dem: Terrain | None  # none: weak tracks are held to the altitude of the others, within their spread

    def hold(self, problem: Problem, points: Array) -> Problem:
        """The problem with priors on points that stand at `points` (P, 3), ECEF [m]."""
        held = self._held(points)
        return problem.with_point_prior(join_point_priors([*self.control, *([] if held is None else [held])]))

    def _held(self, points: Array) -> PointPrior | None:
        dem, options = self.dem, self.options
        weak = self.weak[self.tracks]
        index = self.tracks if dem is not None and options.dem_for_all else self.tracks[weak]
        if not len(index):
            return None
        if dem is not None:
            return terrain_heights(points, index, dem, options.dem_sigma, options.dem_bias_sigma)
        others = self.tracks[~weak]
        if len(others) >= 10:
            low, middle, high = np.percentile(ground_from_ecef(points[others])[:, 2], [5, 50, 95])
        else:
            low, high = self.alt_range
            middle = 0.5 * (low + high)
        sigma = max(float(high - low) * (1.0 if len(others) >= 10 else 0.5), _FLAT_SIGMA)
        return flat_heights(points, index, float(middle), sigma, _TOGETHER * sigma)

    def warn(self) -> None:
        """Say that tracks are held in height without a DEM."""
        count = int(self.weak[self.tracks].sum())
        if count and self.dem is None:
            message = (
                f"{count} of {len(self.tracks)} tracks are seen under less than "
                f"{self.options.min_convergence:g} deg: without a DEM they are held in height"
            )
            warnings.warn(message, BarpcWarning, stacklevel=3)
