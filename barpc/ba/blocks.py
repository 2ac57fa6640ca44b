"""Priors as whitened residual blocks: every block gives residuals and their derivative, divided by sigma.

All of them are linear in the unknowns; the tie observations, which are not, are in `problem`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from barpc.geodesy import Array, ecef_from_ground, enu_basis, ground_from_ecef, metres_per_unit
from barpc.scene import BoolArray, GroundPoints, IntArray

Terrain = Callable[[Array, Array], Array]
"""lon, lat (n,) [deg] -> altitude (n,) [m above the ellipsoid], NaN where it is unknown."""

_SLOPE_STEP = 15.0  # m: terrain slopes are taken over twice this distance


@dataclass(frozen=True)
class CameraPrior:
    """Independent priors: (p - mean) / sigma.

    Parameters
    ----------
    mean, sigma : (N, q)
        Of every view's unknowns.
    """

    mean: Array
    sigma: Array

    def residual(self, params: Array) -> Array:
        """Whitened residuals (N, q) of unknowns (N, q)."""
        whitened: Array = (params - self.mean) / self.sigma
        return whitened

    def jacobian(self) -> Array:
        """Diagonal of the derivative (N, q)."""
        return 1.0 / self.sigma


@dataclass(frozen=True)
class JointPrior:
    """A prior on several views together, with all of their correlations: root (p - mean).

    Parameters
    ----------
    index : (n,)
        Places of the unknowns in the raveled (N, q) array.
    mean : (n,)
        Their prior mean.
    root : (n, n)
        Upper triangular factor of the information matrix.
    """

    index: IntArray
    mean: Array
    root: Array

    def residual(self, params: Array) -> Array:
        """Whitened residuals (n,) of unknowns (N, q)."""
        whitened: Array = self.root @ (params.ravel()[self.index] - self.mean)
        return whitened

    def jacobian(self) -> Array:
        """Derivative (n, n) by the unknowns `index`."""
        return self.root


@dataclass(frozen=True)
class PointPrior:
    """Priors on points with errors in common: rows (X - mean) - common b, and b itself is standard normal.

    b is never a state of its own: residuals are those that the best b for the points leaves.

    Parameters
    ----------
    index : (Q,)
        Which points; none twice.
    mean : (Q, 3)
        ECEF [m].
    rows : (Q, 3, 3)
        Whitening rows [1/m]; rows of zeros say nothing.
    common : (Q, 3, m)
        What one standard deviation of each of m common errors adds to the whitened residuals.
    """

    index: IntArray
    mean: Array
    rows: Array
    common: Array

    def offset(self, points: Array) -> Array:
        """The common errors (m,) that points (P, 3) [m] show, in their standard deviations."""
        whitened = self.apart(points)
        offset: Array = np.linalg.solve(self.information(), np.einsum("qim,qi->m", self.common, whitened))
        return offset

    def residual(self, points: Array) -> Array:
        """Whitened residuals (Q, 3) of points (P, 3) [m], the common errors taken away."""
        residual: Array = self.apart(points) - self.common @ self.offset(points)
        return residual

    def cost(self, points: Array) -> float:
        """Sum of the squared residuals, with the common errors' own."""
        return float((self.residual(points) ** 2).sum() + (self.offset(points) ** 2).sum())

    def information(self) -> Array:
        """Information (m, m) on the common errors where the points are known."""
        information: Array = np.einsum("qim,qin->mn", self.common, self.common)
        information += np.eye(len(information))
        return information

    def select(self, keep: BoolArray) -> PointPrior:
        """Some of its rows (Q,)."""
        return PointPrior(self.index[keep], self.mean[keep], self.rows[keep], self.common[keep])

    def apart(self, points: Array) -> Array:
        """Whitened offsets (Q, 3) of points (P, 3) [m], the common errors still in them."""
        whitened: Array = (self.rows @ (points[self.index] - self.mean)[..., None])[..., 0]
        return whitened

    def jacobian(self) -> Array:
        """Derivatives (Q, 3, 3) by the points `index` [1/m]."""
        return self.rows


def join_point_priors(priors: list[PointPrior]) -> PointPrior | None:
    """One block of several that speak of different points, and share their errors; None where all are empty."""
    priors = [prior for prior in priors if len(prior.index)]
    if not priors:
        return None
    most = max(prior.common.shape[2] for prior in priors)
    common = [np.pad(p.common, ((0, 0), (0, 0), (0, most - p.common.shape[2]))) for p in priors]
    return PointPrior(
        np.concatenate([prior.index for prior in priors]),
        np.concatenate([prior.mean for prior in priors]),
        np.concatenate([prior.rows for prior in priors]),
        np.concatenate(common),
    )


def ground_control(gcps: GroundPoints, index: IntArray) -> PointPrior:
    """GCPs as priors on the points `index` (G,): east, north and up by their sigmas."""
    rows = enu_basis(gcps.lonlatalt) / gcps.sigma[..., None]
    return PointPrior(index, ecef_from_ground(gcps.lonlatalt), rows, np.zeros((len(index), 3, 0)))


def terrain_heights(
    points: Array, index: IntArray, terrain: Terrain, sigma: float, common_sigma: float
) -> PointPrior:
    """Points `index` held to a terrain: the height above its tangent plane at the points' present place.

    Parameters
    ----------
    points : (P, 3)
        ECEF [m].
    index : (Q,)
        Which points; those where the terrain is unknown are left out.
    terrain : Terrain
        Altitudes; the slope is taken over 30 m.
    sigma : float
        Standard deviation of single altitudes [m].
    common_sigma : float
        Of what all of them are wrong by, and at the scene's edges of a slope to the east and to the north [m].

    Returns
    -------
    PointPrior
    """
    ground = ground_from_ecef(points[index])
    step = _SLOPE_STEP / metres_per_unit(ground)[:, :2]
    lon, lat = ground[:, 0], ground[:, 1]
    alt = terrain(lon, lat)
    slope_east = (terrain(lon + step[:, 0], lat) - terrain(lon - step[:, 0], lat)) / (2.0 * _SLOPE_STEP)
    slope_north = (terrain(lon, lat + step[:, 1]) - terrain(lon, lat - step[:, 1])) / (2.0 * _SLOPE_STEP)
    normal = np.stack([-np.nan_to_num(slope_east), -np.nan_to_num(slope_north), np.ones(len(alt))], axis=1)
    return _heights(ground, index, alt, normal, sigma, common_sigma)


def flat_heights(points: Array, index: IntArray, alt: float, sigma: float, common_sigma: float) -> PointPrior:
    """Points `index` held to one altitude [m]: each within `sigma` [m], all together within `common_sigma` [m]."""
    ground = ground_from_ecef(points[index])
    n = len(index)
    return _heights(ground, index, np.full(n, alt), np.tile([0.0, 0.0, 1.0], (n, 1)), sigma, common_sigma)


def _heights(
    ground: Array, index: IntArray, alt: Array, normal: Array, sigma: float, common_sigma: float
) -> PointPrior:
    known = np.isfinite(alt)
    foot = np.column_stack([ground[known, :2], alt[known]])
    rows, common = np.zeros((len(foot), 3, 3)), np.zeros((len(foot), 3, 3))
    rows[:, 0] = np.einsum("qe,qex->qx", normal[known], enu_basis(foot)) / sigma
    common[:, 0, 0] = common_sigma / sigma
    mean = ecef_from_ground(foot)
    if len(foot):
        middle = mean.mean(axis=0)
        plane = (mean - middle) @ enu_basis(ground_from_ecef(middle))[:2].T
        common[:, 0, 1:] = plane / np.maximum(np.abs(plane).max(axis=0), 1.0) * (common_sigma / sigma)
    return PointPrior(index[known], mean, rows, common)
