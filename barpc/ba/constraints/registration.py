"""Registration of the surface of the tie points to given heights (altimetry).

A quadratic patch is fitted to the neighbours of each tie point, with its covariance and its residual scatter. The patch
of the nearest tie point predicts a given height. The slopes of the patch give the derivatives of the prediction by
motions of the surface. Slopes have errors, whose expected contribution is subtracted from the normal matrix
(errors-in-variables regression: Fuller, "Measurement error models", 1987).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtri

from barpc.base.geodesy import Array
from barpc.base.statistics import (
    BIWEIGHT,
    CHANCE,
    CRITICAL,
    FEWEST,
    ITERATIONS,
    RIDGE,
    SURELY,
    TIMES,
    evenly,
    kd_tree,
    pooled_variance,
    robust_spread,
)
from barpc.scene import BoolArray, IntArray

PATCH_POINTS = 15  # tie points of a patch: six unknowns, nine redundant
_MIN_RELIEF = 0.01  # m: least scatter about a patch; also, a smaller change of the motion ends the iteration
_TRIALS_PER_AXIS = 25  # trial shifts along each axis of the search
_MIN_SLOPE_SHARE = 0.2  # least share of the information on a motion that is not due to errors of slopes


@dataclass(frozen=True)
class TieSurface:
    """Quadratic patches around P tie points, in a local frame (east, north, up) about their middle.

    Coefficients multiply 1, u, v, u^2, u v, v^2: u and v are east and north of the tie point, in units of `reach`.
    """

    points: Array  # (P, 3) [m]
    patch: Array  # (P, 6) coefficients [m]
    covariance: Array  # (P, 6, 6) covariance of the coefficients [m^2]
    scatter: Array  # (P,) standard deviation of the ground about the patch [m]
    reach: Array  # (P,) distance of the farthest neighbour of the patch [m]
    whole: BoolArray  # (P,) whether the scatter is not unusually large (as at edges of houses and cliffs)
    tree: Any  # k-d tree of the horizontal positions

    @classmethod
    def of(cls, points: Array) -> TieSurface:
        """Fit the surface of at least `PATCH_POINTS` points (P, 3)."""
        tree = kd_tree(points[:, :2])
        distance, near = (np.asarray(part) for part in tree.query(points[:, :2], k=PATCH_POINTS))
        reach = np.maximum(distance[:, -1], 1e-3)
        delta = points[near] - points[:, None]
        design = _quadratic_terms(delta[..., :2] / reach[:, None, None])
        normal, terms = np.swapaxes(design, 1, 2) @ design, design.shape[-1]
        freedom = PATCH_POINTS - terms
        inverse = np.linalg.inv(normal + RIDGE * np.eye(terms))
        patch = np.einsum("pij,pkj,pk->pi", inverse, design, delta[..., 2])
        squares = ((delta[..., 2] - np.einsum("pkj,pj->pk", design, patch)) ** 2).sum(axis=1)
        usual = max(float(np.sqrt(np.median(squares) / freedom)), _MIN_RELIEF)
        variance = pooled_variance(squares, freedom, usual**2)
        patch[:, 0] += points[:, 2]
        return cls(
            points,
            patch,
            variance[:, None, None] * inverse,
            np.sqrt(variance),
            reach,
            squares <= chdtri(freedom, CHANCE) * usual**2,
            tree,
        )

    def at(self, place: Array) -> tuple[Array, IntArray, BoolArray]:
        """Return heights (n,) at positions (n, 2), the nearest tie points (n,), and if their patches are valid."""
        distance, nearest = (np.asarray(part) for part in self.tree.query(place))
        design = _quadratic_terms(self._relative(place, nearest))
        near = (distance <= self.reach[nearest]) & self.whole[nearest]
        return (design * self.patch[nearest]).sum(axis=1), nearest, near

    def variance(self, place: Array, nearest: IntArray) -> Array:
        """Return the variance (n,) [m^2] of ground heights predicted by patches at positions (n, 2)."""
        design = _quadratic_terms(self._relative(place, nearest))
        of_patch = np.einsum("ni,nij,nj->n", design, self.covariance[nearest], design)
        return np.asarray(of_patch + self.scatter[nearest] ** 2)

    def slope(self, place: Array, nearest: IntArray) -> tuple[Array, Array]:
        """Return the slopes (n, 2) to the east and north at positions (n, 2), and their covariance (n, 2, 2)."""
        u, v = self._relative(place, nearest).T
        zero, one = np.zeros_like(u), np.ones_like(u)
        rates = np.array([[zero, one, zero, 2.0 * u, v, zero], [zero, zero, one, zero, u, 2.0 * v]])
        rates = rates.transpose(2, 0, 1) / self.reach[nearest, None, None]
        covariance = rates @ self.covariance[nearest] @ np.swapaxes(rates, 1, 2)
        return np.einsum("nci,ni->nc", rates, self.patch[nearest]), covariance

    def _relative(self, place: Array, nearest: IntArray) -> Array:
        """Return the positions relative to the tie points `nearest`, in units of their reach, within +-1."""
        away = (place - self.points[nearest, :2]) / self.reach[nearest, None]
        return np.asarray(np.clip(away, -1.0, 1.0))


def _quadratic_terms(away: Array) -> Array:
    u, v = away[..., 0], away[..., 1]
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


@dataclass(frozen=True)
class GivenHeights:
    """Given heights, in the frame of a `TieSurface`."""

    place: Array  # (n, 3) east, north, up [m]
    sigma: Array  # (n,) standard deviation of the height [m]
    sigma_flat: Array  # (n,) standard deviation of the horizontal position along each axis [m]

    def select(self, keep: BoolArray | slice) -> GivenHeights:
        """Return the heights of a mask (n,), or of a slice."""
        return GivenHeights(self.place[keep], self.sigma[keep], self.sigma_flat[keep])


@dataclass(frozen=True)
class Registration:
    """The motion that registers a surface to n given heights, and the agreement of these."""

    motion: Array  # (7,) east, north, up, tilts, turn, scale [m], as `barpc.ba.constraints.gauge.MOTIONS`
    covariance: Array  # (7, 7) of the motion, with a prior `TIMES` wider than `before` in `register` [m^2]
    near: BoolArray  # (n,) heights at valid patches of the surface
    agree: BoolArray  # (n,) inliers among them
    residual: Array  # (n,) given height minus moved surface [m]; NaN: no valid patch
    sigma: Array  # (n,) a-priori standard deviation of the residual [m]
    rivals: int  # largest number of outliers with about the same residual

    @property
    def share(self) -> float:
        """Fraction of inliers among the heights at valid patches, 0 to 1."""
        return float(self.agree.sum() / max(self.near.sum(), 1))

    @property
    def is_most(self) -> bool:
        """Whether the inliers can be the majority and are significantly more than `rivals` (two standard deviations).

        The number of inliers may be sqrt(n) below n / 2 by chance: two standard deviations of a count.
        """
        agree, count = int(self.agree.sum()), int(self.near.sum())
        clearly = agree - self.rivals > 2.0 * np.sqrt(agree + self.rivals)
        return bool(clearly and agree > 0.5 * count - np.sqrt(count))


def displacement(local: Array) -> Array:
    """Return the derivatives (n, 3, 7) by the seven motions, of points at `local` (n, 2) [radii of the scene]."""
    e, o = local.T
    moves = np.zeros((len(e), 3, 7))
    moves[:, (0, 1, 2), (0, 1, 2)] = 1.0
    moves[:, 2, 3], moves[:, 2, 4] = e, o
    moves[:, 0, 5], moves[:, 1, 5] = -o, e
    moves[:, 0, 6], moves[:, 1, 6] = e, o
    return moves


def register(surface: TieSurface, given: GivenHeights, radius: float, before: Array) -> Registration:
    """Register a surface, of a scene of `radius` [m], to given heights, most of which are right.

    `before` (7,) [m] are the standard deviations of the motions without these heights. They limit the search, and
    `TIMES` wider they are a prior for motions that the heights do not determine.
    """
    free = np.diag((TIMES * before) ** -2)
    motion, noise = _converged_motion(surface, given, search_shift(surface, given, before), radius, free)
    found = registration_at(surface, given, motion, radius, noise, free)
    wider = _jackknife(surface, given, found, radius, noise, free)
    return replace(found, covariance=wider[:, None] * found.covariance * wider)


def _converged_motion(
    surface: TieSurface, given: GivenHeights, motion: Array, radius: float, free: Array, noise: float | None = None
) -> tuple[Array, float]:
    """Return the motion (7,) by reweighted least squares, and the ratio of observed to stated noise (`noise`)."""
    is_known, noise = noise is not None, SURELY if noise is None else noise
    for step in range(ITERATIONS):
        seen = _SurfaceMisfit.of(surface, given, motion, radius)
        whitened = seen.residual / seen.sigma
        near = seen.near & (np.abs(whitened) < BIWEIGHT * noise)
        if near.sum() < len(motion):
            break
        rows = np.where(near, np.maximum(1.0 - (whitened / (BIWEIGHT * noise)) ** 2, 0.0), 0.0)
        weight = (rows / seen.sigma) ** 2  # rows^2 is the biweight
        normal = (seen.rows * weight[:, None]).T @ seen.rows + free
        change = np.linalg.solve(normal, seen.rows.T @ (weight * np.where(near, seen.residual, 0.0)) - free @ motion)
        motion = motion + change
        if not is_known and step >= 2:
            among = np.abs(whitened[seen.near & (np.abs(whitened) < 2.0 * BIWEIGHT * noise)])
            noise = float(np.clip(robust_spread(among), 0.5, max(noise, 1.0)))
        if (is_known or step > 5) and np.abs(change).max() < _MIN_RELIEF:
            break
    return motion, noise


def _jackknife(
    surface: TieSurface, given: GivenHeights, found: Registration, radius: float, noise: float, free: Array
) -> Array:
    """Return factors (7,) on the standard deviations, from the delete-a-group jackknife.

    Near roofs and trees the nearest patch changes with the motion; the linearised covariance neglects this
    (Shao and Tu, "The Jackknife and Bootstrap", 1995).
    """
    group, wider = _grid_cells(given.place[:, :2], found.near), np.ones(len(free))
    count = int(group.max(initial=-1)) + 1
    if count < FEWEST:
        return wider
    without = np.array(
        [
            _converged_motion(surface, given.select((group != n) & found.near), found.motion, radius, free, noise)[0]
            for n in range(count)
        ]
    )
    variance = (count - 1.0) / count * ((without - without.mean(axis=0)) ** 2).sum(axis=0)
    ratio = variance / np.diag(found.covariance)
    for part in ([2, 3, 4], [0, 1, 5, 6]):
        wider[part] = np.sqrt(max(float(ratio[part].mean()), 1.0))
    return wider


def _grid_cells(place: Array, near: BoolArray) -> IntArray:
    """Return the index (n,) of the grid cell (of at least `FEWEST` in use) of each position (n, 2); -1: not `near`."""
    group, number = np.full(len(place), -1), np.zeros(0, dtype=np.int64)
    at = place[near]
    size = float(np.ptp(at, axis=0).max()) if len(at) else 0.0
    while size > 0.0 and number.max(initial=0) + 1 < min(FEWEST, len(at)):  # altimetry tracks leave most cells empty
        size /= np.sqrt(2.0)
        cell = np.floor((at - at.min(axis=0)) / size).astype(np.int64)
        number = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    group[near] = number if len(number) else 0
    return group


@dataclass(frozen=True)
class _SurfaceMisfit:
    """Residuals of given heights against a moved surface, with derivatives."""

    residual: Array  # (n,) given minus predicted [m]
    sigma: Array  # (n,) standard deviation of the residual [m]
    rows: Array  # (n, 7) derivatives of the prediction by the motions
    near: BoolArray  # (n,) heights at valid patches
    nearest: IntArray  # (n,) tie points of the patches
    moves: Array  # (n, 3, 7) result of `displacement`
    slope_covariance: Array  # (n, 2, 2)

    @classmethod
    def of(cls, surface: TieSurface, given: GivenHeights, motion: Array, radius: float) -> _SurfaceMisfit:
        moves = displacement(given.place[:, :2] / radius)
        moved = moves @ motion
        place = given.place[:, :2] - moved[:, :2]
        height, nearest, near = surface.at(place)
        slope, slope_covariance = surface.slope(place, nearest)
        variance = surface.variance(place, nearest) + given.sigma**2
        variance += (slope**2).sum(axis=1) * given.sigma_flat**2
        normal = np.column_stack([-slope, np.ones(len(slope))])
        rows = np.einsum("nc,ncm->nm", normal, moves)
        residual = given.place[:, 2] - height - moved[:, 2]
        return cls(residual, np.sqrt(variance), rows, near, nearest, moves, slope_covariance)


def search_shift(surface: TieSurface, given: GivenHeights, before: Array) -> Array:
    """Return the shift with most inliers as a motion (7,) [m]; a grid search within `CRITICAL` times `before`.

    Its tilts, turn and scale are 0. All is 0 if no height is at a valid patch.
    """
    few = given.select(evenly(len(given.sigma)))
    first = _SurfaceMisfit.of(surface, few, np.zeros(7), 1.0)
    steep = float(np.sqrt(((surface.patch[:, 1:3] / surface.reach[:, None]) ** 2).mean()))
    wide = float(np.median(first.sigma))
    reach = CRITICAL * before[:2]
    step = np.maximum(wide / max(steep, 1e-6), 2.0 * reach / (_TRIALS_PER_AXIS - 1))
    sides = [np.arange(-(r // s), r // s + 1) * s for r, s in zip(reach, step, strict=True)]
    half = 2.0 * float(np.hypot(wide, 0.5 * steep * np.hypot(*np.minimum(step, reach))))
    best, found = -1.0, np.zeros(7)
    for east in sides[0]:
        for north in sides[1]:
            height, _, near = surface.at(few.place[:, :2] - [east, north])
            off = np.sort((few.place[:, 2] - height)[near])
            if not len(off):
                continue
            count = np.searchsorted(off, off + 2.0 * half) - np.arange(len(off))
            start = int(count.argmax())
            inside = off[start : start + count[start]]
            score = float(count[start]) - float(((inside - inside.mean()) ** 2).sum()) / half**2
            if score > best:
                best, found = score, np.array([east, north, np.median(inside), 0, 0, 0, 0])
    return found


def registration_at(
    surface: TieSurface, given: GivenHeights, motion: Array, radius: float, noise: float, free: Array
) -> Registration:
    """Return the registration at a motion (7,) [m], with the covariance of an M-estimate and the inliers.

    `radius` [m] is that of the scene, `noise` the ratio of observed to stated noise, `free` (7, 7) [1/m^2] the prior
    information on the motion. Raises LinAlgError if that is not positive definite.
    """
    seen = _SurfaceMisfit.of(surface, given, motion, radius)
    scale = min(max(noise, 1.0), SURELY)
    agree = seen.near & (np.abs(seen.residual) < SURELY * scale * seen.sigma)
    residual = np.where(seen.near, seen.residual, np.nan)
    # M-estimate (Huber, "Robust statistics", 1981, 7.6): `rate`, the mean derivative of psi, is the efficiency
    part = np.where(seen.near, seen.residual / (BIWEIGHT * scale * seen.sigma), 1.0) ** 2
    inside = part < 1.0
    rate = np.where(inside, (1.0 - part) * (1.0 - 5.0 * part), 0.0)[inside].mean() if inside.any() else 0.0
    rows, inverse = seen.rows[inside], max(float(rate), _MIN_SLOPE_SHARE) / (scale * seen.sigma[inside]) ** 2
    psi = (1.0 - part[inside]) ** 2 * seen.residual[inside] / (scale * seen.sigma[inside])
    gradients = rows * (psi / (scale * seen.sigma[inside]))[:, None]
    normal = (rows * inverse[:, None]).T @ rows
    slopes = np.zeros((len(rows), 3, 3))
    slopes[:, :2, :2] = seen.slope_covariance[inside]
    moves = seen.moves[inside]
    by_slope_errors = np.einsum("n,ncm,ncd,ndk->mk", inverse, moves, slopes, moves)
    independent = gradients.T @ gradients
    inflation = _inflation(given.place[inside], gradients, np.diag(independent), surface)
    # generalised eigenvectors and eigenvalues of the corrected information relative to the uncorrected one
    root = np.linalg.cholesky(normal + free)
    half = np.linalg.inv(root)
    ratio, axes = np.linalg.eigh(half @ (normal - by_slope_errors + free) @ half.T)
    ratio = np.maximum(ratio, 0.0)
    axes = half.T @ axes
    meat = axes.T @ (inflation[:, None] * independent * inflation[None, :] + free) @ axes
    known = np.where(ratio > _MIN_SLOPE_SHARE, 1.0 / np.maximum(ratio, _MIN_SLOPE_SHARE), 0.0)
    covariance = axes @ (known[:, None] * meat * known) @ axes.T
    undetermined = axes[:, ratio <= _MIN_SLOPE_SHARE]
    covariance += undetermined @ undetermined.T / _MIN_SLOPE_SHARE**2 if undetermined.size else 0.0
    prior_covariance = np.linalg.inv(free)
    covariance = np.linalg.inv(np.linalg.inv(covariance + 1e-12 * prior_covariance) + free)
    covariance = np.asarray(covariance, dtype=np.float64)
    rivals = _largest_rival(seen, agree, scale)
    return Registration(motion, covariance, seen.near, agree, residual, seen.sigma, rivals)


def _largest_rival(seen: _SurfaceMisfit, agree: BoolArray, scale: float) -> int:
    """Return the largest number of outliers whose residuals are equal within the noise."""
    others = seen.near & ~agree
    off = np.sort(seen.residual[others])
    if not len(off):
        return 0
    width = 2.0 * SURELY * scale * float(np.median(seen.sigma[others]))
    return int((np.searchsorted(off, off + width) - np.arange(len(off))).max())


def _inflation(place: Array, gradients: Array, independent: Array, surface: TieSurface) -> Array:
    """Return factors (7,) on the standard deviations for correlated errors: a sandwich estimate over growing cells.

    `gradients` (n, 7) are those of the cost, one per height. `independent` (7,) are the variances of their sums if they
    are independent.
    """
    size, factors = 2.0 * float(np.median(surface.reach)), np.ones(7)
    while True:
        cell = np.floor(place[:, :2] / size).astype(np.int64)
        _, group = np.unique(cell, axis=0, return_inverse=True)
        count = int(group.max(initial=-1)) + 1
        if count < FEWEST:
            return factors
        sums = np.stack([np.bincount(group.ravel(), column, minlength=count) for column in gradients.T], axis=1)
        ratio = (sums**2).sum(axis=0) / np.maximum(independent, 1e-300) * count / (count - len(factors))
        up, flat = [2, 3, 4], [0, 1, 5, 6]
        for part in (up, flat):
            factors[part] = np.maximum(factors[part], np.sqrt(ratio[part].mean()))
        size *= 2.0
