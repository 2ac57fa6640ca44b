"""The surface of the tie points, and the motion that brings it onto heights measured from elsewhere.

Around every tie point its neighbours give a curved patch, with its covariance and what the ground scatters about it.
Where a height is given, the patch of the nearest tie point predicts it; its slopes tell how that changes where the
whole surface moves. Slopes are themselves uncertain: what they claim to know is taken off the normal matrix, as in
errors-in-variables regression (Fuller, "Measurement error models", 1987).
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
    SAMPLE,
    STATED_FREEDOM,
    SURELY,
    TIMES,
    kd_tree,
    robust_spread,
)
from barpc.scene import BoolArray, IntArray

PATCH_POINTS = 15  # tie points of a patch: its six unknowns are checked by nine
_MIN_RELIEF = 0.01  # m: no ground is flatter, and no motion that is smaller is any
_SIDE = 25  # trials along each axis of the search
_MIN_SLOPE_SHARE = 0.2  # of the information that slopes claim: below, they are their own noise


@dataclass(frozen=True)
class TieSurface:
    """Quadratic patches around tie points, in a local frame (east, north, up) about their middle.

    A patch is in lengths of its reach: height, slopes and half the curvatures times 1, u, v, u^2, u v, v^2.
    """

    points: Array  # (P, 3) [m]
    patch: Array  # (P, 6) [m]
    covariance: Array  # (P, 6, 6) [m^2]
    scatter: Array  # (P,) standard deviation of the ground about the patch [m]
    reach: Array  # (P,) where the patch's farthest neighbour lies [m]
    whole: BoolArray  # (P,) whether the patch scatters as most do: edges of houses and cliffs are no patches
    tree: Any  # of its places

    @classmethod
    def of(cls, points: Array) -> TieSurface:
        """Fit the surface of at least `PATCH_POINTS` points (P, 3)."""
        tree = kd_tree(points[:, :2])
        distance, near = (np.asarray(part) for part in tree.query(points[:, :2], k=PATCH_POINTS))
        reach = np.maximum(distance[:, -1], 1e-3)
        delta = points[near] - points[:, None]
        design = _powers(delta[..., :2] / reach[:, None, None])
        normal, terms = np.swapaxes(design, 1, 2) @ design, design.shape[-1]
        freedom = PATCH_POINTS - terms
        inverse = np.linalg.inv(normal + RIDGE * np.eye(terms))
        patch = np.einsum("pij,pkj,pk->pi", inverse, design, delta[..., 2])
        squares = ((delta[..., 2] - np.einsum("pkj,pj->pk", design, patch)) ** 2).sum(axis=1)
        usual = max(float(np.sqrt(np.median(squares) / freedom)), _MIN_RELIEF)
        variance = (squares + STATED_FREEDOM * usual**2) / (freedom + STATED_FREEDOM)
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
        """Return the height (n,) at places (n, 2), the tie point (n,) of its patch, and whether that reaches there."""
        distance, nearest = (np.asarray(part) for part in self.tree.query(place))
        design = _powers(self._from(place, nearest))
        near = (distance <= self.reach[nearest]) & self.whole[nearest]
        return (design * self.patch[nearest]).sum(axis=1), nearest, near

    def variance(self, place: Array, nearest: IntArray) -> Array:
        """Return the variance [m^2] of the ground's height at places (n, 2) about the patches."""
        design = _powers(self._from(place, nearest))
        of_patch = np.einsum("ni,nij,nj->n", design, self.covariance[nearest], design)
        return np.asarray(of_patch + self.scatter[nearest] ** 2)

    def slope(self, place: Array, nearest: IntArray) -> tuple[Array, Array]:
        """Return the slopes (n, 2) to the east and north at places (n, 2), and their covariance (n, 2, 2)."""
        u, v = self._from(place, nearest).T
        zero, one = np.zeros_like(u), np.ones_like(u)
        rates = np.array([[zero, one, zero, 2.0 * u, v, zero], [zero, zero, one, zero, u, 2.0 * v]])
        rates = rates.transpose(2, 0, 1) / self.reach[nearest, None, None]
        covariance = rates @ self.covariance[nearest] @ np.swapaxes(rates, 1, 2)
        return np.einsum("nci,ni->nc", rates, self.patch[nearest]), covariance

    def _from(self, place: Array, nearest: IntArray) -> Array:
        """Return the places from a tie point, in lengths of its patch's reach."""
        away = (place - self.points[nearest, :2]) / self.reach[nearest, None]
        return np.asarray(np.clip(away, -1.0, 1.0))


def _powers(away: Array) -> Array:
    u, v = away[..., 0], away[..., 1]
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


@dataclass(frozen=True)
class GivenHeights:
    """Heights given from elsewhere, in the frame of a surface."""

    place: Array  # (n, 3) east, north, up [m]
    sigma: Array  # (n,) of the height [m]
    sigma_flat: Array  # (n,) of the place, along an axis [m]

    def select(self, keep: BoolArray) -> GivenHeights:
        """Return the heights of a mask (n,)."""
        return GivenHeights(self.place[keep], self.sigma[keep], self.sigma_flat[keep])


@dataclass(frozen=True)
class Registration:
    """The motion of a surface that brings it onto the heights given, and how well these agree on it."""

    motion: Array  # (7,) east, north, up, tilts, turn, scale [m], as `barpc.ba.constraints.gauge.MOTIONS`
    covariance: Array  # (7, 7) of it, what was known before left out but for a hundredth
    near: BoolArray  # (n,) heights on patches of the surface
    agree: BoolArray  # (n,) those of them that agree with the motion
    residual: Array  # (n,) given minus surface, moved [m]; NaN where there is no surface
    sigma: Array  # (n,) its standard deviation as stated [m]
    rivals: int  # heights that agree on another level of the surface: the most that do

    @property
    def share(self) -> float:
        """Share of the heights on the surface that agree, 0 to 1."""
        return float(self.agree.sum() / max(self.near.sum(), 1))

    @property
    def is_most(self) -> bool:
        """Whether those that agree may be most of all, and clearly outnumber any other group.

        Clearly is two standard deviations of a count; of n heights, half of them right, as many less than a half agree
        by chance.
        """
        agree, count = int(self.agree.sum()), int(self.near.sum())
        clearly = agree - self.rivals > 2.0 * np.sqrt(agree + self.rivals)
        return bool(clearly and agree > 0.5 * count - np.sqrt(count))


def displacement(local: Array) -> Array:
    """Return the derivatives (n, 3, 7) of points at `local` (n, 2) radii by the seven motions of a scene."""
    e, o = local.T
    moves = np.zeros((len(e), 3, 7))
    moves[:, (0, 1, 2), (0, 1, 2)] = 1.0
    moves[:, 2, 3], moves[:, 2, 4] = e, o
    moves[:, 0, 5], moves[:, 1, 5] = -o, e
    moves[:, 0, 6], moves[:, 1, 6] = e, o
    return moves


def register(surface: TieSurface, given: GivenHeights, radius: float, before: Array) -> Registration:
    """Find the motion of a surface onto heights, of which the larger part is right.

    `before` (7,) are the standard deviations of the motions without these heights [m]: how far is looked, and where
    the heights tell nothing, that stays open.
    """
    free = np.diag((TIMES * before) ** -2)
    motion, noise = _converged_motion(surface, given, search_shift(surface, given, before), radius, free)
    found = registration_at(surface, given, motion, radius, noise, free)
    wider = _jackknife(surface, given, found, radius, noise, free)
    return replace(found, covariance=wider[:, None] * found.covariance * wider)


def _converged_motion(
    surface: TieSurface, given: GivenHeights, motion: Array, radius: float, free: Array, noise: float | None = None
) -> tuple[Array, float]:
    """Return the motion (7,) after reweighted steps, and the noise over its stated size, estimated if None."""
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
    """Return the factors (7,) of standard deviations: how the motion changes where the heights of one part
    are left out.

    Slopes tell where heights lie on them, and steps of roofs and trees move with the place that is found: no
    linearisation at its end has that (the delete-a-group jackknife: Shao and Tu, "The Jackknife and Bootstrap", 1995).
    """
    group, wider = _scene_parts(given.place[:, :2], found.near), np.ones(len(free))
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


def _scene_parts(place: Array, near: BoolArray) -> IntArray:
    """Return the part (of some twenty squares of a scene) in which each place (n, 2) lies; -1: none is near."""
    group, number = np.full(len(place), -1), np.zeros(0, dtype=np.int64)
    at = place[near]
    size = float(np.ptp(at, axis=0).max()) if len(at) else 0.0
    while size > 0.0 and number.max(initial=0) + 1 < min(FEWEST, len(at)):  # of tracks most are empty
        size /= np.sqrt(2.0)
        cell = np.floor((at - at.min(axis=0)) / size).astype(np.int64)
        number = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    group[near] = number if len(number) else 0
    return group


@dataclass(frozen=True)
class _SurfaceMisfit:
    """Heights against a surface that was moved."""

    residual: Array  # (n,) given minus predicted [m]
    sigma: Array  # (n,) [m]
    rows: Array  # (n, 7) the prediction by the motions
    near: BoolArray  # (n,)
    nearest: IntArray  # (n,)
    moves: Array  # (n, 3, 7)
    doubt: Array  # (n, 2, 2) covariance of the slopes

    @classmethod
    def of(cls, surface: TieSurface, given: GivenHeights, motion: Array, radius: float) -> _SurfaceMisfit:
        moves = displacement(given.place[:, :2] / radius)
        moved = moves @ motion
        place = given.place[:, :2] - moved[:, :2]
        height, nearest, near = surface.at(place)
        slope, doubt = surface.slope(place, nearest)
        variance = surface.variance(place, nearest) + given.sigma**2
        variance += (slope**2).sum(axis=1) * given.sigma_flat**2
        normal = np.column_stack([-slope, np.ones(len(slope))])
        rows = np.einsum("nc,ncm->nm", normal, moves)
        return cls(given.place[:, 2] - height - moved[:, 2], np.sqrt(variance), rows, near, nearest, moves, doubt)


def search_shift(surface: TieSurface, given: GivenHeights, before: Array) -> Array:
    """Return the shift (7,) [m] on which the most heights agree, east and north within four of `before` (7,) [m].

    Its tilts, turn and scale are 0; all is 0 where no height lies on the surface.
    """
    few = given.select(np.arange(len(given.sigma)) % -(-len(given.sigma) // SAMPLE) == 0)
    first = _SurfaceMisfit.of(surface, few, np.zeros(7), 1.0)
    steep = float(np.sqrt(((surface.patch[:, 1:3] / surface.reach[:, None]) ** 2).mean()))
    wide = float(np.median(first.sigma))
    reach = CRITICAL * before[:2]
    step = np.maximum(1.5 * wide / max(steep, 1e-6), 2.0 * reach / (_SIDE - 1))
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
    """Return the registration at a motion (7,) [m]: its covariance, that of an M-estimate, and which heights agree.

    `radius` [m] of the scene; `noise`: by how much the misfit exceeds what is stated; `free` (7, 7) [1/m^2]: the prior
    information on the motion. LinAlgError where that is not positive definite.
    """
    seen = _SurfaceMisfit.of(surface, given, motion, radius)
    scale = min(max(noise, 1.0), SURELY)
    agree = seen.near & (np.abs(seen.residual) < SURELY * scale * seen.sigma)
    residual = np.where(seen.near, seen.residual, np.nan)
    # of an M-estimate (Huber, "Robust statistics", 1981, 7.6): what wrong heights among the right ones cost is in it
    part = np.where(seen.near, seen.residual / (BIWEIGHT * scale * seen.sigma), 1.0) ** 2
    inside = part < 1.0
    rate = np.where(inside, (1.0 - part) * (1.0 - 5.0 * part), 0.0)[inside].mean() if inside.any() else 0.0
    rows, inverse = seen.rows[inside], max(float(rate), _MIN_SLOPE_SHARE) / (scale * seen.sigma[inside]) ** 2
    pull = (1.0 - part[inside]) ** 2 * seen.residual[inside] / (scale * seen.sigma[inside])
    forms = rows * (pull / (scale * seen.sigma[inside]))[:, None]
    normal = (rows * inverse[:, None]).T @ rows
    slopes = np.zeros((len(rows), 3, 3))
    slopes[:, :2, :2] = seen.doubt[inside]
    moves = seen.moves[inside]
    doubt = np.einsum("n,ncm,ncd,ndk->mk", inverse, moves, slopes, moves)
    alone = forms.T @ forms
    group = _inflation(given.place[inside], forms, np.diag(alone), surface)
    # whitened by what slopes claim: axes along which they know `told` of it
    root = np.linalg.cholesky(normal + free)
    half = np.linalg.inv(root)
    told, axes = np.linalg.eigh(half @ (normal - doubt + free) @ half.T)
    told = np.maximum(told, 0.0)
    axes = half.T @ axes
    meat = axes.T @ (group[:, None] * alone * group[None, :] + free) @ axes
    known = np.where(told > _MIN_SLOPE_SHARE, 1.0 / np.maximum(told, _MIN_SLOPE_SHARE), 0.0)
    covariance = axes @ (known[:, None] * meat * known) @ axes.T
    lost = axes[:, told <= _MIN_SLOPE_SHARE]
    covariance += lost @ lost.T / _MIN_SLOPE_SHARE**2 if lost.size else 0.0
    open_ = np.linalg.inv(free)
    covariance = np.linalg.inv(np.linalg.inv(covariance + 1e-12 * open_) + free)
    covariance = np.asarray(covariance, dtype=np.float64)
    rivals = _disagreeing_count(seen, agree, scale)
    return Registration(motion, covariance, seen.near, agree, residual, seen.sigma, rivals)


def _disagreeing_count(seen: _SurfaceMisfit, agree: BoolArray, scale: float) -> int:
    """Return the most of the heights that do not agree and lie within each other's noise."""
    others = seen.near & ~agree
    off = np.sort(seen.residual[others])
    if not len(off):
        return 0
    width = 2.0 * SURELY * scale * float(np.median(seen.sigma[others]))
    return int((np.searchsorted(off, off + width) - np.arange(len(off))).max())


def _inflation(place: Array, forms: Array, alone: Array, surface: TieSurface) -> Array:
    """Return the factors (7,) of standard deviations by correlated errors: a sandwich estimate over
    groups of growing size.

    `forms` (n, 7) are the weighted residuals by the motions, `alone` (7,) the variances of their sums if each were
    independent.
    """
    size, most = 2.0 * float(np.median(surface.reach)), np.ones(7)
    while True:
        cell = np.floor(place[:, :2] / size).astype(np.int64)
        _, group = np.unique(cell, axis=0, return_inverse=True)
        count = int(group.max(initial=-1)) + 1
        if count < FEWEST:
            return most
        sums = np.stack([np.bincount(group.ravel(), column, minlength=count) for column in forms.T], axis=1)
        ratio = (sums**2).sum(axis=0) / np.maximum(alone, 1e-300) * count / (count - 7.0)  # seven are fitted
        up, flat = [2, 3, 4], [0, 1, 5, 6]
        for part in (up, flat):
            most[part] = np.maximum(most[part], np.sqrt(ratio[part].mean()))
        size *= 2.0
