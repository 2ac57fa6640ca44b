"""Which control points agree with each other, found before any of them moves a camera.

The block is solved by its tie points alone; control points are seen in it, and their places are no constraint. What the
block says of a point minus its given place is d = U a + n: the block's free motions (a, standard normal; a shift of
any size is one of them) and what is the point's own, n, whitened to unit variance: the stated accuracy of its place and
that of its rays. A set S of points agrees as well as its evidence says, the density of d with the motions integrated
out; the points outside are wrong by anything, alike at all sizes. All accuracies of n may be s times too good, and
the cameras' motions l times larger than their covariance: the data choose among a few (MacKay 1992).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.special import chdtri

from barpc.ba.constraints.block import Block
from barpc.ba.robust.heldout import enu_offsets
from barpc.ba.solving.covariance import Covariance
from barpc.ba.solving.normal import solve_transposed
from barpc.base.geodesy import Array, enu_basis
from barpc.base.statistics import CRITICAL, GROSS, LEVEL, SURE, TRIALS
from barpc.scene import BoolArray

UNCONSTRAINED_SIGMA = (
    1e4  # m: a place so uncertain holds nothing, and keeps a point that one ray shows from running away
)
_MAX_SET_POINTS = 50_000  # points of sets at a time: some 25 MB
_SIGMA_FACTORS = (1.0, 2.0, 3.0, 5.0)  # more than five times is wrong, not optimistic
ODDS = float(-np.log(LEVEL))
"""Nats that it costs to call a point wrong, and each factor of e in accuracies or motions; and by which a set must
beat any other that contradicts it: one in twenty."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """The set of control points that agree and hold a block.

    Parameters
    ----------
    used : (G,)
        Points that agree with each other, and more than half of what may be said against them does not.
    sets : tuple of (G,)
        Two sets that contradict each other and weigh the same: none is used. Empty where one is.
    scale : float
        Factor by which the stated accuracies of the points used are too good; 1: they are not.
    alike : bool
        Whether the points that are not used, two or more, agree with each other: in another datum, perhaps.
    torn : (2,)
        Residuals of check tie points, without control and with it [px, RMS], where control that agrees with
        itself would raise them, so that none is used; else empty.
    """

    used: BoolArray
    sets: tuple[BoolArray, ...] = ()
    scale: float = 1.0
    alike: bool = False
    torn: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Offsets:
    """The adjusted places of control points minus their given ones, in units of each point's own accuracy.

    Parameters
    ----------
    own : (G, 3)
    motions : (G, 3, r)
        By the free motions of the block, of one standard deviation; the last three are shifts of any size.
    """

    own: Array
    motions: Array

    def select(self, keep: BoolArray) -> Offsets:
        """Return the offsets of some of the points."""
        return Offsets(self.own[keep], self.motions[keep])

    def moving(self, times: float) -> Offsets:
        """Return the offsets with the free motions of the cameras scaled by a factor."""
        factor = np.full(self.motions.shape[2], times)
        factor[-3:] = 1.0
        return Offsets(self.own, self.motions * factor)


def offsets_of(covariance: Covariance, block: Block, points: Array, faint: Array) -> Offsets:
    """Estimate the offsets of control points at a solution without control.

    Parameters
    ----------
    covariance : Covariance, of the solution
    block : Block
    points : (P, 3), adjusted, ECEF [m]
    faint : (P,), times by which observations of a point count as noisier there
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
    for g, mine in enumerate(rows):
        for k in mine:
            at = int(np.searchsorted(views, structure.view[k])) * q
            of_cameras[g, :, at : at + q] -= enu[g] @ rays[g] @ covariance.reduced.cross[k]
    turned = enu @ rays / faint[index, None, None]
    own = turned @ np.swapaxes(turned, 1, 2) + gcps.sigma[:, :, None] ** 2 * np.eye(3)
    whitening = np.linalg.inv(np.linalg.cholesky(own))
    flat = (whitening @ of_cameras).reshape(3 * count, -1)
    size, root = np.linalg.eigh(covariance.joint(views))
    modes, size, _ = np.linalg.svd(flat @ (root * np.sqrt(np.maximum(size, 0.0))), full_matrices=False)
    modes = (modes * size)[:, size > LEVEL].reshape(count, 3, -1)
    motions = np.concatenate([modes, UNCONSTRAINED_SIGMA * whitening @ enu], axis=2)
    offset = enu_offsets(points[index], gcps.lonlatalt)
    return Offsets((whitening @ offset[..., None])[..., 0], motions)


def agreement(offsets: Offsets, told: BoolArray) -> Agreement:
    """Find the control points that hold a block, among those that can be judged, `told` (G,); the others go
    with them.

    Every set is looked at where they are few (twelve); of more, those that agree with three drawn at random.
    """
    given = np.flatnonzero(told)
    if len(given) < 2:
        return Agreement(np.ones(len(told), dtype=bool))
    if _fits_as_stated(offsets.select(told)):
        return Agreement(np.ones(len(told), dtype=bool))
    found = _SubsetSearch(offsets.select(told))
    best, score, scale = found.best()
    others = found.against(best, score)

    def whole(mask: BoolArray) -> BoolArray:
        out = np.zeros(len(told), dtype=bool)
        out[given[mask]] = True
        return out

    if others is not None:
        one, other = sorted((whole(best), whole(others)), key=lambda mask: int(mask.argmax()))
        return Agreement(np.zeros(len(told), dtype=bool), (one, other))
    alike = int(np.count_nonzero(~best)) > 1 and _fits_as_stated(found.offsets.select(~best))
    return Agreement(whole(best) | ~told, scale=scale, alike=alike)


def _fits_as_stated(offsets: Offsets) -> bool:
    """Return whether all points are as near as nineteen times of twenty, and no better without one."""
    count = len(offsets.own)
    one_less = np.concatenate([np.ones((1, count), dtype=bool), ~np.eye(count, dtype=bool)])
    score, _, squares = log_evidence(offsets, one_less, 1.0)
    freedom = 3.0 * (count - 1)  # a shift is free
    return bool(squares[0] < chdtri(freedom, LEVEL) and score[0] >= score.max())


class _SubsetSearch:
    """Sets of points that are compared, and their evidence."""

    def __init__(self, offsets: Offsets) -> None:
        self.offsets, self.count = offsets, len(offsets.own)
        every = self.count * 2**self.count <= _MAX_SET_POINTS
        if every:
            numbers = np.arange(1, 2**self.count)
            self.masks = ((numbers[:, None] >> np.arange(self.count)) & 1).astype(bool)
        else:
            self.masks = np.unique(np.array(list(self._drawn(np.ones(self.count, dtype=bool)))), axis=0)
        self.score, self.scale = self._scored(self.masks)
        if not every:
            self._refine(int(self.score.argmax()))
            rest = ~self.masks[self.score.argmax()]
            if rest.sum() >= 3:
                self._add(np.unique(np.array(list(self._drawn(rest))) & rest, axis=0))

    def best(self) -> tuple[BoolArray, float, float]:
        """Return the set with the largest evidence, that, and the scale of its accuracies."""
        n = int(self.score.argmax())
        return self.masks[n], float(self.score[n]), float(self.scale[n])

    def against(self, best: BoolArray, score: float) -> BoolArray | None:
        """Return the set that contradicts the best and weighs as much, the rest without a majority, or None."""
        size, common = self.masks.sum(axis=1), (self.masks & best).sum(axis=1)
        other = np.flatnonzero((size > common) & (2 * common <= best.sum()))
        if len(other):
            # how well as many points happen to fit is no vote
            least = np.where(size[other] >= best.sum(), 2.0 * SURE, ODDS)
            rival = np.where(self.score[other] > score - least, self.score[other], -np.inf)
            if np.isfinite(rival).any():
                return np.asarray(self.masks[other[rival.argmax()]])
        return None if 2 * best.sum() >= self.count else ~best

    def _drawn(self, among: BoolArray) -> Iterator[BoolArray]:
        """Yield the sets that agree with three points drawn from some; the same whenever they are drawn."""
        rng, places = np.random.default_rng(0), np.flatnonzero(among)
        yield among.copy()
        for trial in range(TRIALS):
            mask = np.zeros(self.count, dtype=bool)
            mask[rng.choice(places, 3, replace=False)] = True
            scale = (1.0, 3.0)[trial % 2]
            for _ in range(2):
                squared = log_evidence(self.offsets, mask[None], scale)[1][0]
                mask = among & (squared < CRITICAL**2)
            if mask.any():
                yield mask

    def _refine(self, n: int) -> None:
        """Move single points into or out of a set as long as that raises its evidence."""
        for _ in range(self.count):
            squared = log_evidence(self.offsets, self.masks[n][None], self.scale[n])[1][0]
            doubtful = np.flatnonzero((squared > 0.5 * CRITICAL**2) & (squared < 2.0 * CRITICAL**2))
            before = self.score[n]
            self._add(self.masks[n] ^ np.eye(self.count, dtype=bool)[doubtful])
            n = int(self.score.argmax())
            if self.score[n] <= before:
                break

    def _add(self, masks: BoolArray) -> None:
        """Add sets to those whose evidence is compared."""
        score, scale = self._scored(masks)
        self.masks = np.concatenate([self.masks, masks])
        self.score, self.scale = np.append(self.score, score), np.append(self.scale, scale)

    def _scored(self, masks: BoolArray) -> tuple[Array, Array]:
        """Return the evidence (B,) of sets (B, G), and the scale of the accuracies that it has it with."""
        score, scale = np.full(len(masks), -np.inf), np.ones(len(masks))
        for motions, times in product(_SIGMA_FACTORS, _SIGMA_FACTORS):
            found = log_evidence(self.offsets.moving(motions), masks, times)[0] - ODDS * np.log(times * motions)
            better = found > score
            score[better], scale[better] = found[better], times
        return score, scale


def log_evidence(offsets: Offsets, masks: BoolArray, scale: float) -> tuple[Array, Array, Array]:
    """Return the log evidence (B,) of sets of points (B, G), and their squared deviations (B, G) and (B,).

    The deviations of every point from what each set tells of it, in variances of that, and the sum of squares of the
    points in a set. Points agree to `scale` times their standard deviations; wrong ones lie anywhere.
    """
    own, motions, variance = offsets.own, offsets.motions, scale**2
    if len(masks) > (room := max(_MAX_SET_POINTS // len(own), 1)):
        parts = [log_evidence(offsets, masks[n : n + room], scale) for n in range(0, len(masks), room)]
        score, squared, squares = (np.concatenate(part) for part in zip(*parts, strict=True))
        return score, squared, squares
    chosen = masks.astype(np.float64)
    count, r = motions.shape[0], motions.shape[2]
    gram = np.einsum("gir,gis->grs", motions, motions).reshape(count, -1) / variance
    matrix = np.eye(r) + (chosen @ gram).reshape(-1, r, r)
    vector = chosen @ (np.einsum("gir,gi->gr", motions, own) / variance)
    inverse = np.linalg.inv(matrix)
    mean = np.einsum("brs,bs->br", inverse, vector)
    volume = np.linalg.slogdet(matrix)[1]
    squares = chosen @ ((own**2).sum(axis=1) / variance) - (vector * mean).sum(axis=1)
    inside = -0.5 * (squares + volume) - 1.5 * np.log(2.0 * np.pi * variance) * chosen.sum(axis=1)
    left = own[None] - np.einsum("gir,br->bgi", motions, mean)
    spread = np.einsum("gir,brs,gjs->bgij", motions, inverse, motions, optimize=True)
    spread = spread + variance * np.eye(3)
    squared = np.einsum("bgi,bgi->bg", left, np.linalg.solve(spread, left[..., None])[..., 0])
    # an error of a wrong point is alike in its logarithm from one standard deviation on, to 10,000
    volume = np.log(4.0 * np.pi * (1.0 / 3.0 + np.log(GROSS**2)))
    anywhere = 1.5 * np.log(np.maximum(squared, 1.0)) + volume + 0.5 * np.linalg.slogdet(spread)[1]
    return inside - ((1.0 - chosen) * (anywhere + ODDS)).sum(axis=1), squared, squares
