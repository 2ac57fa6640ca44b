"""Find the set of ground control points that agree with each other, before any of them constrains the cameras.

The block is adjusted by its tie points alone; control points are triangulated in it, without a prior on their position.
The triangulated minus the given position of a point is d = U a + n. Here a are the free motions of the block, including
shifts of any size; they are standard normal. n is the error of the point itself (given position and rays), whitened to
unit variance. The evidence of a set of points is the density of their d, with the motions integrated out. Points
outside the set are wrong, and their errors have a uniform distribution in the logarithm of their size. The standard
deviations of n, and those of the motions, may be understated: a factor on each is chosen by the data (MacKay 1992).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy.special import chdtri

from barpc.ba.constraints.block import Block
from barpc.ba.robust.heldout import enu_offsets
from barpc.ba.solving.covariance import Covariance
from barpc.ba.solving.normal import TRIANGLE, cholesky3, solve_lower, solve_transposed
from barpc.base.geodesy import Array, enu_basis, parts
from barpc.base.statistics import CRITICAL, GROSS, LEVEL, SURE, TRIALS
from barpc.scene import BoolArray, IntArray

# m: prior standard deviation of an unconstrained point; wide for the cameras, it keeps a point with one ray finite
UNCONSTRAINED_SIGMA = 1e4
_MAX_SET_POINTS = 50_000  # points in one batch, summed over its sets; about 25 MB
_SIGMA_FACTORS = (1.0, 2.0, 3.0, 5.0)  # candidate factors by which standard deviations are understated
ODDS = float(-np.log(LEVEL))
"""Log of the prior odds against an exception [nats]: a wrong point, or moving ground that covers most of a scene.

The log prior of standard deviations understated by a factor f is -ODDS ln f. The log evidence of the best set must also
exceed that of a smaller contradicting set by ODDS.
"""


@dataclass(frozen=True, eq=False)
class Agreement:
    """The set of control points that agree, and are used.

    Parameters
    ----------
    used : (G,)
        Mask of the points used: those that agree with each other, and those that cannot be compared.
    sets : tuple of (G,)
        Two contradicting sets of equal evidence, neither of which is used; empty if one set is used.
    scale : float
        Factor by which the standard deviations of the points used are understated; 1: they are not.
    alike : bool
        Whether two or more unused points agree with each other; they may refer to another datum.
    torn : (2,)
        RMS of check tie points without and with control [px], if control that agrees raises it; then no point is used.
        Empty otherwise.
    """

    used: BoolArray
    sets: tuple[BoolArray, ...] = ()
    scale: float = 1.0
    alike: bool = False
    torn: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Offsets:
    """Triangulated minus given positions of G control points, whitened by the error of each point itself.

    Parameters
    ----------
    own : (G, 3)
        Offsets.
    motions : (G, 3, r)
        Derivatives of the offsets by r free motions of the block, per standard deviation of each motion. The last
        three motions are shifts of any size.
    """

    own: Array
    motions: Array

    def select(self, keep: BoolArray) -> Offsets:
        """Return the offsets of the points in a mask (G,)."""
        return Offsets(self.own[keep], self.motions[keep])

    @cached_property
    def products(self) -> Array:
        """Products A^T A (G, r + 1, r + 1) of each point, where A (3, r + 1) are its motions and, last, its offset."""
        both = np.concatenate([self.motions, self.own[..., None]], axis=2)
        return np.asarray(np.swapaxes(both, 1, 2) @ both)

    def sums(self, masks: BoolArray) -> Array:
        """Return the sums (B, r + 1, r + 1) of `products` over the points of sets (B, G)."""
        flat = self.products.reshape(len(self.own), -1)
        return np.asarray((masks.astype(np.float64) @ flat).reshape(-1, *self.products.shape[1:]))


def offsets_of(covariance: Covariance, block: Block, points: Array, faint: Array) -> Offsets:
    """Return the offsets of the control points of a block from a solution without control.

    Parameters
    ----------
    covariance : Covariance
        Of the solution.
    block : Block
    points : (P, 3)
        Adjusted points, ECEF [m].
    faint : (P,)
        Factors by which the solution enlarged the standard deviations of the observations of each point.
    """
    gcps, first, structure = block.gcps, block.num_tracks, covariance.reduced.structure
    count, q = len(gcps.names), covariance.num_unknowns
    index = np.arange(first, first + count)
    enu = enu_basis(gcps.lonlatalt)
    rays = solve_transposed(covariance.reduced.lower[:, index], np.eye(3)[..., None]).transpose(2, 0, 1)
    bounds = structure.point_bounds
    rows = [structure.by_point[bounds[p] : bounds[p + 1]] for p in index]
    views = np.unique(structure.view[np.concatenate(rows)])
    of_cameras = np.zeros((count, 3, len(views) * q))
    for g, rows_of_point in enumerate(rows):
        for k in rows_of_point:
            at = int(np.searchsorted(views, structure.view[k])) * q
            of_cameras[g, :, at : at + q] -= enu[g] @ rays[g] @ covariance.reduced.cross[k]
    by_rays = enu @ rays / faint[index, None, None]
    noise = by_rays @ np.swapaxes(by_rays, 1, 2) + gcps.sigma[:, :, None] ** 2 * np.eye(3)
    whitening = np.linalg.inv(np.linalg.cholesky(noise))
    flat = (whitening @ of_cameras).reshape(3 * count, -1)
    size, root = np.linalg.eigh(covariance.joint(views))
    modes, size, _ = np.linalg.svd(flat @ (root * np.sqrt(np.maximum(size, 0.0))), full_matrices=False)
    modes = (modes * size)[:, size > LEVEL].reshape(count, 3, -1)
    motions = np.concatenate([modes, UNCONSTRAINED_SIGMA * whitening @ enu], axis=2)
    offset = enu_offsets(points[index], gcps.lonlatalt)
    return Offsets((whitening @ offset[..., None])[..., 0], motions)


def agreement(offsets: Offsets, told: BoolArray) -> Agreement:
    """Find the control points to use.

    With up to twelve points, all sets are compared. With more, the candidate sets are those that agree with three
    points drawn at random.

    Parameters
    ----------
    offsets : Offsets
        Of G control points.
    told : (G,)
        Mask of the points with two or more rays. Other points cannot be tested; they are used, unless two sets
        contradict each other.
    """
    index = np.flatnonzero(told)
    if len(index) < 2:
        return Agreement(np.ones(len(told), dtype=bool))
    if _fits_as_stated(offsets.select(told)):
        return Agreement(np.ones(len(told), dtype=bool))
    found = _SubsetSearch(offsets.select(told))
    best, score, scale = found.best()
    others = found.against(best, score)

    def expanded(mask: BoolArray) -> BoolArray:
        out = np.zeros(len(told), dtype=bool)
        out[index[mask]] = True
        return out

    if others is not None:
        one, other = sorted((expanded(best), expanded(others)), key=lambda mask: int(mask.argmax()))
        return Agreement(np.zeros(len(told), dtype=bool), (one, other))
    alike = int(np.count_nonzero(~best)) > 1 and _fits_as_stated(found.offsets.select(~best))
    return Agreement(expanded(best) | ~told, scale=scale, alike=alike)


def _fits_as_stated(offsets: Offsets) -> bool:
    """Return whether the offsets pass a chi-square test together, and removing any point lowers the evidence."""
    count = len(offsets.own)
    every = SetEvidence(offsets, np.ones((1, count), dtype=bool))
    freedom = 3.0 * (count - 1)  # less a free shift
    fits = every.squares[0] < chdtri(freedom, LEVEL)
    return bool(fits and every.gains(np.arange(count)).max() <= 0.0)


class _SubsetSearch:
    """Search for the set of points with the largest evidence."""

    def __init__(self, offsets: Offsets) -> None:
        self.offsets, self.count = offsets, len(offsets.own)
        self.masks, self.score = np.zeros((0, self.count), dtype=bool), np.zeros(0)
        self.factors = np.zeros((0, 2))  # of each set, on standard deviations and motions
        every = self.count * 2**self.count <= _MAX_SET_POINTS
        if every:
            numbers = np.arange(1, 2**self.count)
            self._add(((numbers[:, None] >> np.arange(self.count)) & 1).astype(bool))
        else:
            self._add(self._drawn(np.ones(self.count, dtype=bool)))
            self._refine(int(self.score.argmax()))
            rest = ~self.masks[self.score.argmax()]
            if rest.sum() >= 3:
                self._add(self._drawn(rest))

    def best(self) -> tuple[BoolArray, float, float]:
        """Return the set (G,) with the largest evidence, its evidence, and the factor on its standard deviations."""
        n = int(self.score.argmax())
        return self.masks[n], float(self.score[n]), float(self.factors[n, 0])

    def against(self, best: BoolArray, score: float) -> BoolArray | None:
        """Return a set that contradicts the best one with similar evidence, or else the other points if a majority.

        None if there is neither.
        """
        size, common = self.masks.sum(axis=1), (self.masks & best).sum(axis=1)
        other = np.flatnonzero((size > common) & (2 * common <= best.sum()))
        if len(other):
            # a set of the same size may fit better by chance
            least = np.where(size[other] >= best.sum(), 2.0 * SURE, ODDS)
            rival = np.where(self.score[other] > score - least, self.score[other], -np.inf)
            if np.isfinite(rival).any():
                return np.asarray(self.masks[other[rival.argmax()]])
        return None if 2 * best.sum() >= self.count else ~best

    def _drawn(self, among: BoolArray) -> BoolArray:
        """Return sets (B, G): points that agree with three drawn from the mask `among` (G,), with a fixed seed."""
        some = self.offsets.select(among)
        rng, count = np.random.default_rng(0), len(some.own)
        every = np.arange(count)
        found = [np.ones(count, dtype=bool)]
        for scale in _SIGMA_FACTORS:
            for _ in range(TRIALS // 2):
                mask = np.zeros(count, dtype=bool)
                mask[rng.choice(count, 3, replace=False)] = True
                for _ in range(2):
                    if mask.any():  # an empty set would accept every point
                        mask = SetEvidence(some, mask[None], scale).deviations(every)[0][0] < CRITICAL**2
                found += [mask] if mask.any() else []
        sets = np.unique(np.array(found), axis=0)
        out = np.zeros((len(sets), self.count), dtype=bool)
        out[:, among] = sets
        return out

    def _refine(self, n: int) -> None:
        """Move points into or out of set `n` while this raises the evidence.

        Each iteration tries two moves: all points with a positive gain, and only the point with the largest gain.
        """
        for _ in range(self.count):
            mask, before = self.masks[n], self.score[n]
            evidence = SetEvidence(self.offsets, mask[None], *self.factors[n])
            squared = evidence.deviations(np.arange(self.count))[0][0]
            candidates = np.flatnonzero((squared < 2.0 * CRITICAL**2) & (~mask | (squared > 0.5 * CRITICAL**2)))
            gains = evidence.gains(candidates)
            if not (gains > 0.0).any():
                break
            moved = np.zeros((2, self.count), dtype=bool)
            moved[0, candidates[gains > 0.0]] = moved[1, candidates[gains.argmax()]] = True
            self._add(mask ^ moved)
            n = int(self.score.argmax())
            if self.score[n] <= before:
                break

    def _add(self, masks: BoolArray) -> None:
        """Compute the evidence of sets (B, G) and add them to the search."""
        score, factors = self._scored(masks)
        self.masks = np.concatenate([self.masks, masks])
        self.score, self.factors = np.append(self.score, score), np.concatenate([self.factors, factors])

    def _scored(self, masks: BoolArray) -> tuple[Array, Array]:
        """Return the evidence (B,) of sets (B, G), and their best factors (B, 2) on standard deviations and motions.

        A set whose upper limit of the evidence is 2 SURE or more below the largest one cannot contradict the best set:
        its evidence is not computed and is minus infinity.
        """
        best = self.score.max(initial=-np.inf)
        score, factors = np.full(len(masks), -np.inf), np.ones((len(masks), 2))
        batch, sums = max(_MAX_SET_POINTS // self.count, 1), self.offsets.sums(masks)
        for motions, times in product(_SIGMA_FACTORS, _SIGMA_FACTORS):
            sets = SetEvidence(self.offsets, masks, times, motions, sums)
            limit = sets.at_most()
            order = np.argsort(-limit, kind="stable")
            for start in range(0, len(masks), batch):
                part = order[start : start + batch]
                part = part[limit[part] > max(best, score.max()) - 2.0 * SURE]
                if not len(part):
                    break
                found = sets.evidence(part)
                better = found > score[part]
                score[part[better]], factors[part[better]] = found[better], (times, motions)
        return score, factors


class SetEvidence:
    """Evidence that the points of each set agree, and predictions of all points by each set.

    Parameters
    ----------
    offsets : Offsets
        Of G control points.
    masks : (B, G)
        Points of each set.
    times : float
        Factor on the standard deviations of the points.
    motions : float
        Factor on the standard deviations of the motions, except the shifts.
    sums : (B, r + 1, r + 1), optional
        Sums of `Offsets.products` over each set.
    """

    def __init__(
        self, offsets: Offsets, masks: BoolArray, times: float = 1.0, motions: float = 1.0, sums: Array | None = None
    ) -> None:
        r = offsets.motions.shape[2]
        sums = offsets.sums(masks) if sums is None else sums
        self.offsets, self.masks, self.variance = offsets, masks, times**2
        factor = np.append(np.full(r - 3, motions), np.ones(3))  # shifts are of any size
        information = np.eye(r) + sums[:, :r, :r] * np.outer(factor, factor) / self.variance
        lower = np.linalg.cholesky(information)
        inverse = np.linalg.inv(lower)
        self._root = factor[:, None] * np.swapaxes(inverse, 1, 2)  # (B, r, r) root of their covariance given the set
        self._mean = (inverse @ (sums[:, :r, r] * factor / self.variance)[..., None])[..., 0]
        self.squares = sums[:, r, r] / self.variance - (self._mean**2).sum(axis=1)
        volume = 2.0 * np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
        of_points = 1.5 * np.log(2.0 * np.pi * self.variance) * masks.sum(axis=1)
        self._inside = -0.5 * (self.squares + volume) - of_points - ODDS * np.log(times * motions)

    def deviations(self, points: IntArray) -> tuple[Array, Array]:
        """Return the squared Mahalanobis distances (B, n) of points from their predictions by each set.

        The second result are the log determinants (B, n) of the covariances of these deviations.
        """
        left, root = self._misfit(points)
        return _mahalanobis(left, self._predicted_covariance(root))

    def evidence(self, part: IntArray) -> Array:
        """Return the log evidence (n,) of the sets `part` (n,)."""
        out = ~self.masks[part]
        some = np.flatnonzero(out.any(axis=0))
        left, root = self._misfit(some, part)
        wrong = _outlier_cost(*_mahalanobis(left, self._predicted_covariance(root)))
        return np.asarray(self._inside[part] - (wrong * out[:, some]).sum(axis=1))

    def at_most(self) -> Array:
        """Return upper limits (B,) of the log evidence of the sets, without predictions of the points outside them."""
        least = _outlier_cost(np.zeros(1), 3.0 * np.log(self.variance))
        return np.asarray(self._inside - least * (~self.masks).sum(axis=1))

    def gains(self, points: IntArray) -> Array:
        """Return the gains (n,) of log evidence if each point alone moves into the set, or out of it.

        There must be only one set. Each move is an update of rank three of the predictions (Woodbury identity).
        """
        inside, out = self.masks[0, points], np.flatnonzero(~self.masks[0])
        left, root = self._misfit(points)
        sign = np.where(inside, -1.0, 1.0)
        covariance = self._predicted_covariance(root, sign)
        squared, volume = (part[0] for part in _mahalanobis(left, covariance))
        unit = 3.0 * np.log(self.variance)
        by_others = np.where(inside, 2.0 * unit - volume, volume)  # predicted by the set's other points
        gain = sign * (_outlier_cost(squared, by_others) - 0.5 * squared - 1.5 * np.log(2.0 * np.pi))
        gain += inside * unit - 0.5 * volume
        if not len(out):
            return np.asarray(gain)
        left_outside, root_outside = self._misfit(out)
        outside = self._predicted_covariance(root_outside)
        before = _outlier_cost(*_mahalanobis(left_outside, outside))[0]
        lower = cholesky3(covariance)
        pull = solve_lower(lower, np.moveaxis(left, 2, 0))
        for part in parts(len(points), max(_MAX_SET_POINTS // len(out), 1)):
            shared = np.einsum("hir,gjr->ijhg", root_outside[0], root[0, part], optimize=True)
            moves = np.stack([solve_lower(lower[..., part], row) for row in shared])  # (3, 3, m, n)
            reduction = np.stack([(moves[i] * moves[j]).sum(axis=0) for i, j in TRIANGLE])
            rest = left_outside[0].T[..., None] - sign[part] * (moves * pull[:, :, part]).sum(axis=1)
            updated = outside[:, 0, :, None] - sign[part] * reduction
            after = _outlier_cost(*_mahalanobis(np.moveaxis(rest, 0, 2), updated))
            change = np.where(out[:, None] == points[part], 0.0, after - before[:, None])
            gain[part] -= change.sum(axis=0)
        return np.asarray(gain)

    def _misfit(self, points: IntArray, part: IntArray | slice = slice(None)) -> tuple[Array, Array]:
        """Return the deviations (B, n, 3) of points from their predictions by each set.

        The second result are roots R (B, n, 3, r) of the covariances R R^T of the predictions.
        """
        motions, motion_root = self.offsets.motions[points], self._root[part]
        root = (motions.reshape(-1, motions.shape[2]) @ motion_root).reshape(len(motion_root), *motions.shape)
        return self.offsets.own[points] - (root @ self._mean[part, None, :, None])[..., 0], root

    def _predicted_covariance(self, root: Array, sign: Array | float = 1.0) -> Array:
        """Return the covariances (6, B, n) of deviations (lower triangles): noise + `sign` x prediction."""
        rows = [sign * np.einsum("bnr,bnr->bn", root[:, :, i], root[:, :, j]) for i, j in TRIANGLE]
        return np.stack([row + self.variance * (i == j) for row, (i, j) in zip(rows, TRIANGLE, strict=True)])


def _mahalanobis(left: Array, covariance: Array) -> tuple[Array, Array]:
    """Return squared Mahalanobis lengths of vectors (..., 3), and log determinants of their covariances (6, ...)."""
    lower = cholesky3(covariance)
    squared = (solve_lower(lower, np.moveaxis(left, -1, 0)) ** 2).sum(axis=0)
    return squared, 2.0 * np.log(lower[[0, 3, 5]]).sum(axis=0)


def _outlier_cost(squared: Array, volume: Array | float) -> Array:
    """Return minus the log density of wrong points, plus the log prior odds `ODDS` against a wrong point.

    The density is uniform in the logarithm of the deviation, from one to 10,000 standard deviations. The arguments are
    the squared Mahalanobis distances from the predictions, and the log determinants of their covariances.
    """
    ball = np.log(4.0 * np.pi * (1.0 / 3.0 + np.log(GROSS**2)))
    return np.asarray(1.5 * np.log(np.maximum(squared, 1.0)) + ball + 0.5 * volume + ODDS)
