"""Priors as whitened residual blocks: every block gives residuals and their derivative, divided by sigma.

All of them are linear in the unknowns; the tie observations, which are not, are in `problem`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from barpc.geodesy import Array, ecef_from_ground, enu_basis, ground_from_ecef, metres_per_unit
from barpc.scene import GroundPoints, IntArray

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
    """Priors on points: rows (X - mean).

    Parameters
    ----------
    index : (Q,)
        Which points; none twice.
    mean : (Q, 3)
        ECEF [m].
    rows : (Q, 3, 3)
        Whitening rows [1/m]; rows of zeros say nothing.
    """

    index: IntArray
    mean: Array
    rows: Array

    def residual(self, points: Array) -> Array:
        """Whitened residuals (Q, 3) of points (P, 3) [m]."""
        whitened: Array = (self.rows @ (points[self.index] - self.mean)[..., None])[..., 0]
        return whitened

    def jacobian(self) -> Array:
        """Derivatives (Q, 3, 3) by the points `index` [1/m]."""
        return self.rows


def join_point_priors(priors: list[PointPrior]) -> PointPrior | None:
    """One block of several that speak of different points; None where they are all empty."""
    priors = [prior for prior in priors if len(prior.index)]
    if not priors:
        return None
    return PointPrior(*(np.concatenate(column) for column in zip(*map(_columns, priors), strict=True)))


def _columns(prior: PointPrior) -> tuple[IntArray, Array, Array]:
    return prior.index, prior.mean, prior.rows


def ground_control(gcps: GroundPoints, index: IntArray) -> PointPrior:
    """GCPs as priors on the points `index` (G,): east, north and up by their sigmas."""
    rows = enu_basis(gcps.lonlatalt) / gcps.sigma[..., None]
    return PointPrior(index, ecef_from_ground(gcps.lonlatalt), rows)


def terrain_heights(points: Array, index: IntArray, terrain: Terrain, sigma: float) -> PointPrior:
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
        Standard deviation of the altitudes [m].

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
    return _heights(ground, index, alt, normal, np.full(len(alt), sigma))


def flat_heights(points: Array, index: IntArray, alt: float, sigma: float) -> PointPrior:
    """Points `index` held to one altitude [m] within `sigma` [m]."""
    ground = ground_from_ecef(points[index])
    n = len(index)
    return _heights(ground, index, np.full(n, alt), np.tile([0.0, 0.0, 1.0], (n, 1)), np.full(n, sigma))


def _heights(ground: Array, index: IntArray, alt: Array, normal: Array, sigma: Array) -> PointPrior:
    known = np.isfinite(alt)
    foot = np.column_stack([ground[known, :2], alt[known]])
    rows = np.zeros((len(foot), 3, 3))
    rows[:, 0] = np.einsum("qe,qex->qx", normal[known], enu_basis(foot)) / sigma[known, None]
    return PointPrior(index[known], ecef_from_ground(foot), rows)
