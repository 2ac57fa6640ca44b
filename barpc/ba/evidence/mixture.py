"""A block near its solution as a mixture: each observation, kept or cut, is noise about the model, or lies anywhere.

With probability 1 - eps of its view an observation is normal about the model, else it is uniform over the area in
which matches were found. Of a track of n views any subset of two or more may be right, its ground point integrated
out, or none. Camera unknowns and what is tried beside them have normal priors; all is linear in them. The logarithm
of the evidence is that of all observations, of the priors, and of the room that they leave (Laplace), so that
explanations with different unknowns compare; eps and the noise are found by expectation and maximisation, cooled from
gross errors down (MacKay 2003, "Information Theory, Inference, and Learning Algorithms", chapters 22 and 28).

Beside them tracks may belong to a group that moves on the ground while the views are taken (`Group`): every subset
then counts twice, still and moved, and of every cell of the ground the share that moves is found with the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.linalg.lapack import dtrtri

from barpc.ba.evidence.linearised import Linear, Subsets
from barpc.base.geodesy import CHUNK, Array
from barpc.base.statistics import BACKFITTING, CONVERGED, GROSS, ITERATIONS, LEAST_NOISE, RIDGE, SLIGHT, STANDS, SURE
from barpc.scene import BoolArray, IntArray

NEAR_LIMIT = 4.5  # log(wrong area / 2 pi sigma^2), at least: while the noise is large wrong ones lie no nearer
COOLED = 0.6  # the noise, from one iteration to the next, at most
LIKELIHOOD_TOLERANCE = STANDS * SURE  # change of the log-likelihood at the end
WRONG_SHARE_PRIOR = 1.0, 10.0  # of so many observations of a view so many are wrong, before any is seen


@dataclass(frozen=True, eq=False)
class Group:
    """Tracks that may have moved while the views were taken, with the share that moves in each cell of the ground."""

    by_move: Array  # (2, m, K) how a unit of each of its unknowns moves observations [px]
    sigma: Array  # (m,) their prior
    cell: IntArray  # (K,) of the ground, where an observation's track lies
    share: Array  # (K,) probability that its track moves, before anything is known


@dataclass(frozen=True, eq=False)
class MixtureFit:
    """The result of fitting one explanation to a block."""

    evidence: float  # log, but for a constant of the block
    step: Array  # (N, q) of the cameras' unknowns from the state
    extra: Array  # (e,) of what was tried beside them
    noise: float  # observed over stated
    eps: Array  # (N,) part of each view's observations that is wrong
    right: Array  # (K,) probability that an observation is; 0 for those that take no part
    move: Array = field(default_factory=lambda: np.zeros(0))  # (m,) unknowns of a group that moves
    moving: Array = field(default_factory=lambda: np.zeros(0))  # (K,) probability that the track is of it
    scatter: float = 0.0  # its noise, observed over stated


def fit_mixture(
    linear: Linear,
    extra: Array | None = None,
    sigma: Array | None = None,
    warm: MixtureFit | None = None,
    group: Group | None = None,
    noisiest: float = np.inf,
) -> MixtureFit:
    """Fit cameras and extra unknowns, which move observations by `extra` (2, e, K) [px] a unit, to a block as
    a mixture.

    Their prior standard deviations are `sigma` (e,) [px]. From a fit that is `warm`, whose unknowns may be fewer, it
    is cooled again only from where the further ones begin; with a `group` that moves from the top. Its noise ends at
    `noisiest` at most.
    """
    return Mixture(linear, extra, sigma, warm, group, noisiest).run()


def moving(linear: Linear, extra: Array, group: Group, found: MixtureFit) -> Array:
    """Return the probability (K,) that the track of an observation belongs to a moving group, by a fit with it."""
    left = linear.left(found.step) + np.einsum("cek,e->ck", extra, found.extra) / linear.sigma
    away = np.einsum("cmk,m->ck", group.by_move, found.move) / linear.sigma
    moved = _MovedObservations(left + away, group.share, found.scatter)
    out, subsets = np.zeros(len(linear.view)), linear.subsets
    out[subsets.rows] = _expect(linear, left, found.noise, found.eps, moved).gone(subsets)[subsets.of_row]
    return out


def log_likelihoods(linear: Linear, residual: Array, found: MixtureFit) -> Array:
    """Return the log-likelihood (K,) of every observation's track, at residuals (2, K) in stated deviations."""
    out = np.zeros(len(linear.view))
    out[linear.subsets.rows] = _expect(linear, residual, found.noise, found.eps).log[linear.subsets.of_row]
    return out


def off_from_right(linear: Linear, residual: Array, right: Array) -> tuple[Array, BoolArray]:
    """Return the residuals (2, K) of all observations from ground points intersected by the right ones (K,).

    In standard deviations that they would have if all were right; and which (K,) have at least two right others.
    """
    out, known = np.zeros_like(residual), np.zeros(residual.shape[1], dtype=bool)
    for tracks in linear.tracks:
        count, n = tracks.rows.shape
        ground = np.swapaxes(tracks.follow[:, :3], 1, 2)  # in units in which all observations know it alike
        weight = right[tracks.rows]
        weighted = np.swapaxes(ground * np.repeat(weight, 2, axis=1)[..., None], 1, 2)
        matrix = weighted @ ground + RIDGE * np.eye(3)
        by_row = np.linalg.solve(matrix, np.swapaxes(ground, 1, 2))  # (T, 3, 2n)
        values = residual.T[tracks.rows].reshape(count, -1)
        left = values - (np.swapaxes(by_row, 1, 2) @ (weighted @ values[..., None]))[..., 0]
        spread = 1.0 + (1.0 - 2.0 * np.repeat(weight, 2, axis=1)) * (np.swapaxes(ground, 1, 2) * by_row).sum(axis=1)
        off = (left / np.sqrt(np.maximum(spread, 0.1))).reshape(count, n, 2)
        out[:, tracks.rows] = off.transpose(2, 0, 1)
        known[tracks.rows] = weight.sum(axis=1, keepdims=True) - weight > 1.5  # so many or more, rounded
    return out, known


def first_guess(
    linear: Linear, found: MixtureFit, extra: Array, new: Array, precision: Array, wrong: int = -1
) -> tuple[Array, float, float]:
    """Estimate starting values (e,) of unknowns that move observations by `new` (2, e, K) [px], beside a fit
    with `extra` [px].

    They have the least sum of what all tracks are off by, not of its squares; also the median of that, and the sum less
    that without them, over the noise. Their prior's precisions are the last of `precision`. Observations of a view
    that is `wrong` do not count in tracks of more than two.
    """
    left = linear.left(found.step) + np.einsum("cek,e->ck", extra, found.extra) / linear.sigma
    prior = np.diag(precision[len(precision) - new.shape[1] :])
    parts, beside = [], new / linear.sigma
    touched = np.asarray(beside.any(axis=(0, 1)))
    for tracks in linear.tracks:
        some = np.flatnonzero(touched[tracks.rows].any(axis=1))
        rows, size = tracks.rows[some], 2 * tracks.rows.shape[1]
        columns = beside[:, :, rows].transpose(2, 3, 0, 1).reshape(len(some), size, new.shape[1])
        off = left[:, rows].transpose(1, 2, 0).reshape(len(some), size, 1)
        met, follow = tracks.all_but(some, wrong)
        parts.append(tuple(met * one - np.swapaxes(follow, 1, 2) @ (follow @ one) for one in (off, columns)))
    moved, far, sums = np.zeros(new.shape[1]), [np.zeros(0)], list[float]()
    for _ in range(BACKFITTING):
        matrix, gradient, far = prior.copy(), prior @ moved, []
        for off, turned in parts:
            now = off + turned @ moved[:, None]
            far.append(np.sqrt((now**2).sum(axis=(1, 2)) + found.noise**2))
            weight = turned / far[-1][:, None, None]
            matrix += (np.swapaxes(weight, 1, 2) @ turned).sum(axis=0)
            gradient = gradient + (np.swapaxes(weight, 1, 2) @ now).sum(axis=0)[:, 0]
        moved = moved - np.linalg.solve(matrix, gradient)
        sums.append(sum(float(of_tracks.sum()) for of_tracks in far))
    distances = np.concatenate(far)
    middle = float(np.median(distances)) if len(distances) else 0.0
    return moved, middle, (sums[-1] - sums[0]) / found.noise


@dataclass(frozen=True, eq=False)
class _MovedObservations:
    """Observations as they are for tracks of a group that moves."""

    residual: Array  # (2, K)
    share: Array  # (K,) of the track's cell
    noise: float


@dataclass(frozen=True, eq=False)
class _Expected:
    """Expectations of tracks that stand, and then of those that move."""

    log: Array  # (T,) log-likelihood of a track
    right: Array  # (M,) probability of each observation, alone or with others
    shares: list[Array]  # (S,) probability of each subset
    subsets: list[_OfSubsets]

    def gone(self, subsets: Subsets) -> Array:
        """Probability (T,) that a track of which something is right moves."""
        still, gone = (np.add.reduceat(share, subsets.begins[1]) for share in self.shares)
        return np.asarray(gone / np.maximum(still + gone, 1e-300))


def _expect(
    linear: Linear, residual: Array, noise: float, eps: Array, moved: _MovedObservations | None = None
) -> _Expected:
    """Return the expectations of all tracks at residuals (2, K) [stated deviations], and those of tracks that moved."""
    subsets, (rows, begins) = linear.subsets, linear.subsets.begins
    area = max(linear.area, 2.0 * np.pi * noise**2 * np.exp(NEAR_LIMIT))
    view = linear.view[subsets.rows]
    odds, wrong = (np.log1p(-eps) - np.log(eps))[view], np.add.reduceat(np.log(eps)[view], rows)
    found = [_OfSubsets.at(linear, residual, noise, area)]
    log = [found[0].log]
    if moved is not None:
        share = moved.share[subsets.rows[rows]][subsets.of_subset]
        found.append(_OfSubsets.at(linear, moved.residual, moved.noise, area))
        log = [log[0] + np.log1p(-share), found[1].log + np.log(share)]
    chance = subsets.members @ odds + wrong[subsets.of_subset]
    np.exp(odds, out=odds)
    of_odds = np.add.reduceat(odds, rows)
    alone = wrong + np.log1p(of_odds) - np.log(linear.image) - (subsets.views - 1) * np.log(area)
    log = [one + chance for one in log]
    top = np.maximum.reduce([alone, *(np.maximum.reduceat(one, begins) for one in log)])
    shares, of_none = [np.exp(one - top[subsets.of_subset]) for one in log], np.exp(alone - top)
    total = of_none + sum(np.add.reduceat(one, begins) for one in shares)
    shares = [one / total[subsets.of_subset] for one in shares]
    single = (of_none / total / (1.0 + of_odds))[subsets.of_row] * odds
    return _Expected(top + np.log(total), subsets.member_of @ sum(shares) + single, shares, found)


@dataclass(frozen=True, eq=False)
class _OfSubsets:
    log: Array  # (S,) log-likelihood if a subset is right
    square: Array  # (S,) squared residuals of subsets
    values: Array  # (M, 2) residuals
    followed: Array  # (S, 3) what ground points follow of them

    @classmethod
    def at(cls, linear: Linear, residual: Array, noise: float, area: float) -> _OfSubsets:
        """Return the likelihoods of all subsets at residuals (2, K) [stated deviations]."""
        subsets = linear.subsets
        values, followed = residual.T.take(subsets.rows, axis=0), np.empty((len(subsets.size), 3))
        for tracks, (rows, some) in zip(linear.tracks, subsets.parts, strict=True):
            count = len(tracks.rows)
            np.matmul(tracks.follow, values[rows].reshape(count, -1, 1), out=followed[some].reshape(count, -1, 1))
        square = np.maximum(subsets.members @ (values**2).sum(axis=1) - (followed**2).sum(axis=1), 0.0)
        left_out, two_pi = subsets.views[subsets.of_subset] - subsets.size, np.log(2.0 * np.pi * noise**2)
        log = subsets.volume - square / (2.0 * noise**2)
        log -= left_out * np.log(area) + 0.5 * (2 * subsets.size - 3) * two_pi
        return cls(log, square, values, followed)

    def expected(self, linear: Linear, share: Array) -> _Component:
        """Return the expectations where each subset is right with a probability (S,)."""
        subsets, seen = linear.subsets, linear.subsets.member_of @ share
        pulls, weighed = seen[:, None] * self.values, share[:, None] * self.followed
        absorbed, weights = np.empty_like(pulls), list[Array]()
        for tracks, (rows, some) in zip(linear.tracks, subsets.parts, strict=True):
            count = len(tracks.rows)
            np.matmul(weighed[some].reshape(count, 1, -1), tracks.follow, out=absorbed[rows].reshape(count, 1, -1))
            weights.append(share[some].reshape(count, -1))
        right, pull = np.zeros(len(linear.view)), np.zeros((2, len(linear.view)))
        right[subsets.rows], pull[:, subsets.rows] = seen, (pulls - absorbed).T
        freedom = float(share @ (2 * subsets.size - 3))
        return _Component(tuple(weights), right, pull, float(share @ self.square), freedom)


@dataclass(frozen=True, eq=False)
class _Component:
    """Expectations of a mixture for ties that stand, or that move."""

    weight: tuple[Array, ...]  # of tracks their subsets' probabilities (T, S)
    right: Array  # (K,) probability of every observation, not by itself
    pull: Array  # (2, K) residuals less what ground points follow, as far as they are right
    squares: float
    freedom: float


@dataclass(frozen=True, eq=False)
class _Expectations:
    """Expectations of a mixture over all tracks at its present unknowns."""

    log: float
    right: Array  # (K,)
    moving: Array  # (K,)
    kinds: tuple[_Component, ...]


class Mixture:
    """One fit at work: unknowns x = (cameras N q, extra e, those of a group that moves m).

    Each step is Newton's for the weights expected now, but for the curvature, which is summed anew only where weights
    have changed: at the end it is that of the weights there.
    """

    def __init__(
        self,
        linear: Linear,
        extra: Array | None,
        sigma: Array | None,
        warm: MixtureFit | None,
        group: Group | None = None,
        noisiest: float = np.inf,
    ) -> None:
        self.linear, self.group, self.noisiest = linear, group, noisiest
        self.extra = np.zeros((2, 0, len(linear.sigma))) if extra is None else extra / linear.sigma
        own = np.zeros(0) if sigma is None else 1.0 / sigma**2
        further = own if group is None else np.append(own, 1.0 / group.sigma**2)
        self.precision = np.concatenate([linear.precision, further])
        self.offset = np.concatenate([linear.offset, np.zeros(len(further))])
        self.x = np.zeros(len(self.precision))
        self.noise, self.eps = GROSS, np.full(linear.views, WRONG_SHARE_PRIOR[0] / WRONG_SHARE_PRIOR[1])
        if warm is not None:
            known = warm.step.size + len(warm.extra)
            self.x[:known] = *warm.step.ravel(), *warm.extra
            self.noise, self.eps = warm.noise, warm.eps
        self.beside = [self.extra]  # of what stands still, and of what moves
        if group is not None:
            self.noise, self.eps = GROSS, np.full(linear.views, WRONG_SHARE_PRIOR[0] / WRONG_SHARE_PRIOR[1])
            self.beside.append(np.concatenate([self.extra, group.by_move / linear.sigma], axis=1))
            self.moved = _MovedObservations(linear.residual, group.share, self.noise)
        self.squared = [(beside**2).sum(axis=0) for beside in self.beside]
        self.part = np.flatnonzero(linear.taking_part)
        self.count = np.bincount(linear.view[self.part], minlength=linear.views)
        self.touched = np.asarray(self.beside[-1].any(axis=(0, 1)))
        self.curvature: list[Array] = []
        self.summed: list[Array] = []
        if warm is not None and extra is not None and group is None and known < len(self.x):
            self._begin(warm, extra, own)

    def _begin(self, warm: MixtureFit, extra: Array, precision: Array) -> None:
        """Set the further unknowns to the best of their first guesses: from all views, or as if one were wrong.

        Where rows of two views are displaced, the least sum may be that of one displacement for both; the larger
        probability is that of one's own, with the other wrong.
        """
        known = warm.step.size + len(warm.extra)
        old, new = np.split(extra, [len(warm.extra)], axis=1)
        given = self.linear, warm, old, new, precision
        guesses = [first_guess(*given)]
        if guesses[0][1] > np.sqrt(2.0 * self.linear.views) * self.noise:  # else most tracks are met as well as may be
            touched, view = np.asarray(new.any(axis=(0, 1))), self.linear.view
            tied = [view[tracks.rows[touched[tracks.rows].any(axis=1)]].ravel() for tracks in self.linear.tracks]
            beside = np.setdiff1d(np.concatenate(tied), view[touched])
            guesses += [first_guess(*given, one) for one in beside.tolist()]

        def log(guess: tuple[Array, float, float]) -> float:
            self.x[known:] = guess[0]
            return self._expected().log

        self.x[known:], far, _ = max(guesses, key=log) if len(guesses) > 1 else guesses[0]
        self.noise = max(self.noise, far)

    def run(self, most: int = ITERATIONS, cooled: float = COOLED) -> MixtureFit:
        """Iterate until nothing changes, or a number of times; goes on where the last run ended."""
        linear, last, known, ends = self.linear, -np.inf, 0.0, False
        self.cooled = cooled
        for left in range(most, 0, -1):
            seen = self._expected()
            is_new = self._has_changed(seen) or ends or left == 1
            if is_new:
                kinds = zip(seen.kinds, self.beside, strict=True)
                self.curvature = [self._curvature(kind.weight, beside) for kind, beside in kinds]
            matrix = self._matrix()
            factor = cho_factor(matrix.T, lower=True, overwrite_a=True, check_finite=False)  # as LAPACK has it
            if is_new:
                inverse = np.tril(dtrtri(factor[0], lower=1)[0])
                known = len(matrix) - float((inverse**2).sum(axis=0) @ self.precision)
            self.x = self.x - cho_solve(factor, self._gradient(seen), check_finite=False)
            settled = self._noise(seen, known) and abs(seen.log - last) < LIKELIHOOD_TOLERANCE
            last = seen.log
            if settled and is_new:
                break
            ends = settled
        away = self.offset + self.x
        room = 2.0 * float(np.log(factor[0].diagonal()).sum()) - float(np.log(self.precision).sum())
        evidence = seen.log - 0.5 * float(self.precision @ away**2) - 0.5 * room
        sizes = linear.precision.size, linear.precision.size + self.extra.shape[1]
        step, extra, move = np.split(self.x, sizes)
        scatter = 0.0 if self.group is None else self.moved.noise
        step = step.reshape(linear.shape)
        return MixtureFit(evidence, step, extra, self.noise, self.eps, seen.right, move, seen.moving, scatter)

    def scores(self, new: Array, cell: IntArray, cells: int) -> tuple[Array, Array, Array]:
        """Return the score statistics of unknowns that move the observations of one cell each by `new` (2, m, K) [px].

        At the present unknowns: curvature (C, m, m) and pull (C, m) of each cell's, the pull less what cameras and
        the others follow, and (C, P, m) by what root of curvature they are followed.
        """
        linear, seen, moves = self.linear, self._expected(), new / self.linear.sigma
        (views, q), (e, m) = linear.shape, (self.extra.shape[1], new.shape[1])
        curvature, across = np.zeros((cells, m, m)), np.zeros((cells, views * q + e, m))
        of_views = across[:, : views * q].reshape(cells, views, q, m)
        for tracks, of_subset in zip(linear.tracks, seen.kinds[0].weight, strict=True):
            columns = moves[:, :, tracks.rows].transpose(2, 3, 0, 1).reshape(len(tracks.rows), -1, m)
            weighted = tracks.weight(of_subset) @ columns
            own = cell[tracks.rows[:, 0]]
            np.add.at(curvature, own, np.swapaxes(columns, 1, 2) @ weighted)
            for k, rows in enumerate(tracks.rows.T):
                part = weighted[:, 2 * k : 2 * k + 2]
                np.add.at(of_views, (own, linear.view[rows]), np.swapaxes(linear.by_row[rows], 1, 2) @ part)
                np.add.at(across[:, views * q :], own, self.extra[:, :, rows].transpose(2, 1, 0) @ part)
        self.curvature = [self._curvature(seen.kinds[0].weight, self.extra)]
        lower = np.linalg.cholesky(self._matrix())
        followed = (
            solve_triangular(lower, across.transpose(1, 0, 2).reshape(len(lower), -1), lower=True) / self.noise**2
        )
        followed = followed.reshape(len(lower), cells, m).transpose(1, 0, 2)
        pulls = np.einsum("cmk,ck->mk", moves, seen.kinds[0].pull) / self.noise**2
        own = np.stack([np.bincount(cell, one, cells) for one in pulls], axis=1)
        taken = np.swapaxes(followed, 1, 2) @ solve_triangular(lower, self._gradient(seen), lower=True)
        return curvature / self.noise**2, own - taken, followed

    def _noise(self, seen: _Expectations, known: float) -> bool:
        """Return the noise and the shares of wrong observations, estimated anew; whether the noise stands."""
        still = seen.kinds[0]
        found = min(max(float(np.sqrt(still.squares / max(still.freedom - known, 1.0))), LEAST_NOISE), self.noisiest)
        cold = self.noise <= found
        noise = found if cold else max(found, self.cooled * self.noise)
        wrong = np.bincount(self.linear.view[self.part], 1.0 - seen.right[self.part], minlength=self.linear.views)
        self.eps = np.clip((wrong + WRONG_SHARE_PRIOR[0]) / (self.count + WRONG_SHARE_PRIOR[1]), SLIGHT, 1.0 - SLIGHT)
        if self.group is not None:
            self._group(seen, noise, noise <= found)
        stands = abs(np.log(noise / self.noise)) < CONVERGED
        self.noise = noise
        return bool(stands)

    def _group(self, seen: _Expectations, noise: float, cold: bool) -> None:
        """Estimate the moving share of every cell and the scatter of its tracks."""
        assert self.group is not None
        share, scatter = self.group.share, noise
        if cold:
            rows = self.linear.subsets.rows[self.linear.subsets.begins[0]]
            cell, moved = self.group.cell, seen.kinds[1]
            weights = seen.moving[rows], np.ones(len(rows))
            gone, all_of = (np.bincount(cell[rows], w, cell.max() + 1) for w in weights)
            share = ((gone + 0.5) / (all_of + 1.0))[cell]
            scatter = max(float(np.sqrt(moved.squares / max(moved.freedom, 1.0))), noise)
        self.moved = _MovedObservations(self.moved.residual, share, scatter)

    def _expected(self) -> _Expectations:
        linear, size = self.linear, self.extra.shape[1]
        step, extra, move = np.split(self.x, [linear.precision.size, linear.precision.size + size])
        left = linear.left(step.reshape(linear.shape)) + np.einsum("cek,e->ck", self.extra, extra)
        moved = None
        if self.group is not None:
            away = np.einsum("cmk,m->ck", self.beside[1][:, size:], move)
            moved = self.moved = replace(self.moved, residual=left + away)
        found, subsets = _expect(linear, left, self.noise, self.eps, moved), linear.subsets
        right, moving = np.zeros((2, len(linear.view)))
        right[subsets.rows] = found.right
        if moved is not None:
            moving[subsets.rows] = found.gone(subsets)[subsets.of_row]
        kinds = (one.expected(linear, share) for one, share in zip(found.subsets, found.shares, strict=True))
        return _Expectations(float(found.log.sum()), right, moving if moved is not None else moving[:0], tuple(kinds))

    @property
    def _noises(self) -> list[float]:
        return [self.noise] if self.group is None else [self.noise, self.moved.noise]

    def _has_changed(self, seen: _Expectations) -> bool:
        """Return whether the weights of views and unknowns have changed since the curvature was summed."""
        sums, further = [], self.precision[self.linear.precision.size :]
        for kind, squared, noise in zip(seen.kinds, self.squared, self._noises, strict=True):
            of_views = np.bincount(self.linear.view, kind.right, minlength=self.linear.views)
            sums += [of_views + 1.0, squared @ kind.right + further[: len(squared)] * noise**2]
        new = np.log(np.concatenate(sums))
        if len(self.summed) and bool((np.abs(new - self.summed) < STANDS).all()):
            return False
        self.summed = new
        return True

    def _matrix(self) -> Array:
        """Return the normal matrix, with the precisions of the priors."""
        out = np.diag(self.precision)
        for matrix, noise in zip(self.curvature, self._noises, strict=True):
            out[: len(matrix), : len(matrix)] += matrix / noise**2
        return out

    def _gradient(self, seen: _Expectations) -> Array:
        linear, out = self.linear, self.precision * (self.offset + self.x)
        camera, pulls = linear.precision.size, np.zeros_like(linear.residual)
        for kind, beside, noise in zip(seen.kinds, self.beside, self._noises, strict=True):
            pull = kind.pull / noise**2
            pulls += pull
            out[camera : camera + beside.shape[1]] += np.einsum("cek,ck->e", beside, pull)
        by_row, flat = linear.by_row.reshape(-1, linear.shape[1]), pulls.T.ravel()
        for v, (a, b) in enumerate(pairwise(linear.bounds)):
            out[v * linear.shape[1] : (v + 1) * linear.shape[1]] += flat[2 * a : 2 * b] @ by_row[2 * a : 2 * b]
        return out

    def _curvature(self, weights: Sequence[Array], beside: Array) -> Array:
        """Return the second derivatives of half the squares by the cameras' unknowns and those beside them."""
        linear, (views, q), size = self.linear, self.linear.shape, beside.shape[1]
        of_beside, across = np.zeros((size, size)), np.zeros((views, q, size))
        of_pairs, seen, turned = list[Array](), list[IntArray](), list[Array]()
        for tracks, of_subset in zip(linear.tracks, weights, strict=True):
            n = tracks.rows.shape[1]
            weight = tracks.weight(of_subset)
            of_pairs.append(weight.reshape(-1, n, 2, n, 2).transpose(0, 1, 3, 2, 4)[:, *np.triu_indices(n)])
            some = np.flatnonzero(self.touched[tracks.rows].any(axis=1)) if size else ()
            if len(some):
                columns = beside[:, :, tracks.rows[some]].transpose(2, 3, 0, 1).reshape(len(some), -1, size)
                weighted = weight[some] @ columns
                of_beside += columns.reshape(-1, size).T @ weighted.reshape(-1, size)
                seen.append(tracks.rows[some].ravel())
                turned.append(weighted.reshape(-1, 2, size))
        if seen:
            rows = np.concatenate(seen)
            order = np.argsort(linear.view[rows], kind="stable")
            left = linear.by_row[rows[order]].reshape(-1, q)
            right = np.concatenate(turned)[order].reshape(-1, size)
            for v, (a, b) in enumerate(pairwise(2 * np.searchsorted(linear.view[rows[order]], np.arange(views + 1)))):
                across[v] = left[a:b].T @ right[a:b]
        cameras = self._of_cameras(np.concatenate([one.reshape(-1, 2, 2) for one in of_pairs]))
        cross = across.reshape(views * q, size)
        return np.block([[cameras, cross], [cross.T, of_beside]])

    def _of_cameras(self, weight: Array) -> Array:
        """Return the normal matrix (N q, N q) of the cameras' unknowns, of weights (M, 2, 2) of pairs."""
        linear, (views, q), pairs = self.linear, self.linear.shape, self.linear.pairs
        sums, at = np.empty((len(pairs.views), q, q)), pairs.bounds
        starts = at[np.searchsorted(at, np.arange(0, at[-1] + CHUNK, CHUNK), side="right").clip(1) - 1]
        for start, stop in pairwise(np.unique([*starts.tolist(), at[-1]]).tolist()):
            part = slice(start, stop)
            left = linear.by_row.take(pairs.first[part], axis=0).reshape(-1, q).T
            second = linear.by_row.take(pairs.second[part], axis=0)
            right = (weight.take(pairs.order[part], axis=0) @ second).reshape(-1, q)
            first, last = np.searchsorted(at, [start, stop]).tolist()
            for n, (a, b) in enumerate(pairwise((2 * (at[first : last + 1] - start)).tolist()), first):
                np.matmul(left[:, a:b], right[a:b], out=sums[n])
        out, (one, other) = np.zeros((views, q, views, q)), pairs.views.T
        out[one, :, other, :] = sums
        out[other, :, one, :] = sums.swapaxes(1, 2)
        return out.reshape(views * q, -1)
