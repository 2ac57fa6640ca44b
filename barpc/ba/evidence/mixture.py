"""Mixture model of a linearised block: every observation, rejected ones included, is an inlier or a wrong match.

A wrong match has probability eps of its view and is uniformly distributed over the area in which matches were found.
An inlier is normally distributed about the model. The inliers of a track are all its observations, all but one, or at
most one. The ground point is integrated out. Camera unknowns and the unknowns of terms have normal priors, and the
model is linear in them. The log evidence is that of observations and priors with Laplace's approximation, so that
hypotheses with different unknowns can be compared. Expectation maximisation estimates eps and the noise, annealed from
gross errors down (MacKay 2003, "Information Theory, Inference, and Learning Algorithms", chapters 22 and 28).

Optionally tracks may belong to a group that moves on the ground between the views (`Group`). Every subset then has two
hypotheses, still and moved, and the share of moving tracks of every ground cell is estimated too.
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

NEAR_LIMIT = 4.5  # [nats] the density of wrong matches is lower than the peak density of inliers by this at least
COOLED = 0.6  # annealing: least ratio of the noise of an iteration to that of the iteration before
LIKELIHOOD_TOLERANCE = STANDS * SURE  # [nats] a change of the log-likelihood below it is convergence
WRONG_SHARE_PRIOR = 1.0, 10.0  # prior of the share of wrong observations of a view: one of ten pseudo-observations


@dataclass(frozen=True, eq=False)
class Group:
    """Tracks that may have moved between the views, and the share of moving tracks in each cell of the ground."""

    by_move: Array  # (2, m, K) derivatives of the image points by the m unknowns of the move [px]
    sigma: Array  # (m,) prior standard deviations of these unknowns
    cell: IntArray  # (K,) ground cell of each observation's track
    share: Array  # (K,) prior probability that this track moves: the share of its cell
    start: MixtureFit | None = None  # fit of a sample of the tracks as a start; None: annealing from gross errors


@dataclass(frozen=True, eq=False)
class MixtureFit:
    """The fit of one hypothesis to a block."""

    evidence: float  # log evidence, up to a constant that all hypotheses of the block share
    step: Array  # (N, q) change of the camera unknowns from the state
    extra: Array  # (e,) unknowns of terms
    noise: float  # standard deviation of inliers, observed over stated
    eps: Array  # (N,) share of wrong observations of each view
    right: Array  # (K,) probability of being an inlier; 0 outside tracks
    move: Array = field(default_factory=lambda: np.zeros(0))  # (m,) unknowns of the move of a group
    moving: Array = field(default_factory=lambda: np.zeros(0))  # (K,) probability that an observation's track moves
    scatter: float = 0.0  # standard deviation of moving inliers, observed over stated


def fit_mixture(
    linear: Linear,
    extra: Array | None = None,
    sigma: Array | None = None,
    warm: MixtureFit | None = None,
    group: Group | None = None,
    noisiest: float = np.inf,
) -> MixtureFit:
    """Fit camera unknowns and the unknowns of terms, with columns `extra` (2, e, K) [px], to a block.

    `sigma` (e,) [px] are the prior standard deviations of the terms' unknowns. `warm` is a fit to start from: its terms
    are the first of `extra`, and annealing starts at the misfit of the others. With a moving `group` annealing starts
    at gross errors, or at the fit `group.start`. `noisiest` is the upper limit of the noise.
    """
    return Mixture(linear, extra, sigma, warm, group, noisiest).run()


def moving(linear: Linear, extra: Array, group: Group, found: MixtureFit) -> Array:
    """Return the probability (K,) that each observation's track moves, for a fit `found` with this moving group."""
    left = linear.residual_after(found.step) + np.einsum("cek,e->ck", extra, found.extra) / linear.sigma
    away = np.einsum("cmk,m->ck", group.by_move, found.move) / linear.sigma
    moved = _MovedObservations(left + away, group.share, found.scatter)
    out, subsets = np.zeros(len(linear.view)), linear.subsets
    out[subsets.rows] = _track_posteriors(linear, left, found.noise, found.eps, moved).moved(subsets)[subsets.of_row]
    return out


def log_likelihoods(linear: Linear, residual: Array, found: MixtureFit) -> Array:
    """Return the log-likelihood (K,) of each observation's track at residuals (2, K) [stated sigmas]."""
    out = np.zeros(len(linear.view))
    out[linear.subsets.rows] = _track_posteriors(linear, residual, found.noise, found.eps).log[linear.subsets.of_row]
    return out


def residuals_from_inliers(linear: Linear, residual: Array, right: Array) -> tuple[Array, BoolArray]:
    """Return normalised residuals (2, K) of all observations, with ground points intersected from inliers alone.

    The divisor is the standard deviation of the residual of an inlier. Also returned is the mask (K,) of observations
    with two other inliers in their track. `right` (K,) is the probability of being an inlier.
    """
    out, known = np.zeros_like(residual), np.zeros(residual.shape[1], dtype=bool)
    for tracks in linear.tracks:
        count, n = tracks.rows.shape
        ground = np.swapaxes(tracks.point_bases[:, :3], 1, 2)  # scaled: its normal matrix is the identity
        weight = right[tracks.rows]
        weighted = np.swapaxes(ground * np.repeat(weight, 2, axis=1)[..., None], 1, 2)
        matrix = weighted @ ground + RIDGE * np.eye(3)
        by_row = np.linalg.solve(matrix, np.swapaxes(ground, 1, 2))  # (T, 3, 2n)
        values = residual.T[tracks.rows].reshape(count, -1)
        left = values - (np.swapaxes(by_row, 1, 2) @ (weighted @ values[..., None]))[..., 0]
        spread = 1.0 + (1.0 - 2.0 * np.repeat(weight, 2, axis=1)) * (np.swapaxes(ground, 1, 2) * by_row).sum(axis=1)
        off = (left / np.sqrt(np.maximum(spread, 0.1))).reshape(count, n, 2)
        out[:, tracks.rows] = off.transpose(2, 0, 1)
        known[tracks.rows] = weight.sum(axis=1, keepdims=True) - weight > 1.5  # two or more, rounded
    return out, known


def first_guess(
    linear: Linear, found: MixtureFit, extra: Array, new: Array, precision: Array, wrong: int = -1
) -> tuple[Array, float, float]:
    """Estimate start values (e,) of new unknowns with columns `new` (2, e, K) [px], beside those of `found`.

    They minimise the sum of the norms of the tracks' residuals (L1). `extra` [px] are the columns of the terms of
    `found`. The last e of `precision` are the prior precisions of the new unknowns. Observations of the view `wrong`
    (-1: none) are excluded from tracks of more than two. Also returned are the median norm and the change of the sum,
    divided by the noise; a negative change is an improvement.
    """
    left = linear.residual_after(found.step) + np.einsum("cek,e->ck", extra, found.extra) / linear.sigma
    prior = np.diag(precision[len(precision) - new.shape[1] :])
    parts, beside = [], new / linear.sigma
    touched = np.asarray(beside.any(axis=(0, 1)))
    for tracks in linear.tracks:
        some = np.flatnonzero(touched[tracks.rows].any(axis=1))
        rows, size = tracks.rows[some], 2 * tracks.rows.shape[1]
        columns = beside[:, :, rows].transpose(2, 3, 0, 1).reshape(len(some), size, new.shape[1])
        off = left[:, rows].transpose(1, 2, 0).reshape(len(some), size, 1)
        counts, follow = tracks.without_view(some, wrong)
        parts.append(tuple(counts * one - np.swapaxes(follow, 1, 2) @ (follow @ one) for one in (off, columns)))
    unknown, lengths, totals = np.zeros(new.shape[1]), [np.zeros(0)], list[float]()
    for _ in range(BACKFITTING):
        matrix, gradient, lengths = prior.copy(), prior @ unknown, []
        for off, projected in parts:
            now = off + projected @ unknown[:, None]
            lengths.append(np.sqrt((now**2).sum(axis=(1, 2)) + found.noise**2))
            weight = projected / lengths[-1][:, None, None]
            matrix += (np.swapaxes(weight, 1, 2) @ projected).sum(axis=0)
            gradient = gradient + (np.swapaxes(weight, 1, 2) @ now).sum(axis=0)[:, 0]
        unknown = unknown - np.linalg.solve(matrix, gradient)
        totals.append(sum(float(of_tracks.sum()) for of_tracks in lengths))
    distances = np.concatenate(lengths)
    middle = float(np.median(distances)) if len(distances) else 0.0
    return unknown, middle, (totals[-1] - totals[0]) / found.noise


@dataclass(frozen=True, eq=False)
class _MovedObservations:
    """Observations under the hypothesis that their tracks moved."""

    residual: Array  # (2, K)
    share: Array  # (K,) of moving tracks in the ground cell
    noise: float


@dataclass(frozen=True, eq=False)
class _TrackPosteriors:
    """Posterior probabilities of tracks. In lists the first element is for still tracks, the second for moved ones."""

    log: Array  # (T,) log-likelihood of each track
    right: Array  # (M,) probability of being an inlier; it may be the only one of its track
    shares: list[Array]  # (S,) probability that the inliers are those of a subset
    subsets: list[_SubsetLikelihoods]

    def moved(self, subsets: Subsets) -> Array:
        """Return the probability (T,) that a track moved, given that it has two inliers or more."""
        still, moved = (np.add.reduceat(share, subsets.begins[1]) for share in self.shares)
        return np.asarray(moved / np.maximum(still + moved, 1e-300))


def _track_posteriors(
    linear: Linear, residual: Array, noise: float, eps: Array, moved: _MovedObservations | None = None
) -> _TrackPosteriors:
    """Return the posteriors at residuals (2, K) [stated sigmas], of still tracks and, if given, of moved ones."""
    subsets, (rows, begins) = linear.subsets, linear.subsets.begins
    area = max(linear.area, 2.0 * np.pi * noise**2 * np.exp(NEAR_LIMIT))
    view = linear.view[subsets.rows]
    odds, wrong = (np.log1p(-eps) - np.log(eps))[view], np.add.reduceat(np.log(eps)[view], rows)
    found = [_SubsetLikelihoods.at(linear, residual, noise, area)]
    log = [found[0].log]
    if moved is not None:
        share = moved.share[subsets.rows[rows]][subsets.of_subset]
        found.append(_SubsetLikelihoods.at(linear, moved.residual, moved.noise, area))
        log = [log[0] + np.log1p(-share), found[1].log + np.log(share)]
    prior = subsets.members @ odds + wrong[subsets.of_subset]
    np.exp(odds, out=odds)
    of_odds = np.add.reduceat(odds, rows)
    at_most_one = wrong + np.log1p(of_odds) - np.log(linear.image_area) - (subsets.views - 1) * np.log(area)
    log = [one + prior for one in log]
    top = np.maximum.reduce([at_most_one, *(np.maximum.reduceat(one, begins) for one in log)])
    shares, no_subset = [np.exp(one - top[subsets.of_subset]) for one in log], np.exp(at_most_one - top)
    total = no_subset + sum(np.add.reduceat(one, begins) for one in shares)
    shares = [one / total[subsets.of_subset] for one in shares]
    single = (no_subset / total / (1.0 + of_odds))[subsets.of_row] * odds
    return _TrackPosteriors(top + np.log(total), subsets.member_of @ sum(shares) + single, shares, found)


@dataclass(frozen=True, eq=False)
class _SubsetLikelihoods:
    """Likelihoods of the subsets of all tracks, either still or moved."""

    log: Array  # (S,) log-likelihood if the inliers are those of the subset
    square: Array  # (S,) sum of squared residuals with the ground point estimated
    values: Array  # (M, 2) residuals without that estimate
    absorbed: Array  # (S, 3) their components along `TrackGroup.point_bases`

    @classmethod
    def at(cls, linear: Linear, residual: Array, noise: float, area: float) -> _SubsetLikelihoods:
        """Return the likelihoods at residuals (2, K) [stated sigmas]; wrong matches are uniform over `area`."""
        subsets = linear.subsets
        values, followed = residual.T.take(subsets.rows, axis=0), np.empty((len(subsets.size), 3))
        for tracks, (rows, some) in zip(linear.tracks, subsets.parts, strict=True):
            count = len(tracks.rows)
            np.matmul(tracks.point_bases, values[rows].reshape(count, -1, 1), out=followed[some].reshape(count, -1, 1))
        square = np.maximum(subsets.members @ (values**2).sum(axis=1) - (followed**2).sum(axis=1), 0.0)
        left_out, two_pi = subsets.views[subsets.of_subset] - subsets.size, np.log(2.0 * np.pi * noise**2)
        log = subsets.log_volume - square / (2.0 * noise**2)
        log -= left_out * np.log(area) + 0.5 * (2 * subsets.size - 3) * two_pi
        return cls(log, square, values, followed)

    def weighted(self, linear: Linear, share: Array) -> _WeightedResiduals:
        """Return the residuals weighted by the probabilities `share` (S,) of the subsets."""
        subsets, inlier = linear.subsets, linear.subsets.member_of @ share
        pulls, weighed = inlier[:, None] * self.values, share[:, None] * self.absorbed
        absorbed, weights = np.empty_like(pulls), list[Array]()
        for tracks, (rows, some) in zip(linear.tracks, subsets.parts, strict=True):
            count = len(tracks.rows)
            np.matmul(weighed[some].reshape(count, 1, -1), tracks.point_bases, out=absorbed[rows].reshape(count, 1, -1))
            weights.append(share[some].reshape(count, -1))
        right, pull = np.zeros(len(linear.view)), np.zeros((2, len(linear.view)))
        right[subsets.rows], pull[:, subsets.rows] = inlier, (pulls - absorbed).T
        freedom = float(share @ (2 * subsets.size - 3))
        return _WeightedResiduals(tuple(weights), right, pull, float(share @ self.square), freedom)


@dataclass(frozen=True, eq=False)
class _WeightedResiduals:
    """Residuals of all tracks, either still or moved, weighted by the posterior probabilities of their subsets."""

    weight: tuple[Array, ...]  # (T, S) these probabilities, for each `TrackGroup`
    right: Array  # (K,) probability of being an inlier together with others of its track
    pull: Array  # (2, K) weighted residuals with the ground points estimated
    squares: float  # weighted sum of the squared residuals
    freedom: float  # degrees of freedom of this sum


@dataclass(frozen=True, eq=False)
class _Expectations:
    """Result of an E step: expectations over all tracks at the present unknowns."""

    log: float  # log-likelihood
    right: Array  # (K,) as in `MixtureFit`
    moving: Array  # (K,) as in `MixtureFit`
    kinds: tuple[_WeightedResiduals, ...]  # of still tracks and, with a group, of moved ones


class Mixture:
    """Expectation maximisation of one fit, with unknowns x = (cameras N q, terms e, moving group m).

    Each iteration is a Newton step for the expected weights. The curvature is computed again only where the weights
    have changed, and for the last step.
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
        self.beside = [self.extra]  # columns of unknowns for still tracks, and for moved ones
        if group is not None:
            self.noise, self.eps = GROSS, np.full(linear.views, WRONG_SHARE_PRIOR[0] / WRONG_SHARE_PRIOR[1])
            self.beside.append(np.concatenate([self.extra, group.by_move / linear.sigma], axis=1))
            if group.start is not None:
                self.noise, self.eps = group.start.noise, group.start.eps
                self.x[: linear.precision.size] = group.start.step.ravel()
                self.x[len(self.x) - len(group.sigma) :] = group.start.move
            scatter = self.noise if group.start is None else group.start.scatter
            self.moved = _MovedObservations(linear.residual, group.share, scatter)
        self.squared = [(beside**2).sum(axis=0) for beside in self.beside]
        self.part = np.flatnonzero(linear.in_tracks)
        self.count = np.bincount(linear.view[self.part], minlength=linear.views)
        self.touched = np.asarray(self.beside[-1].any(axis=(0, 1)))
        self.curvature: list[Array] = []
        self.summed: list[Array] = []
        if warm is not None and extra is not None and group is None and known < len(self.x):
            self._set_first_guess(warm, extra, own)

    def _set_first_guess(self, warm: MixtureFit, extra: Array, precision: Array) -> None:
        """Set the new unknowns to the likeliest of several first guesses: from all views, or with one view ignored.

        If two views are displaced, the L1 guess from all views may explain both by one displacement. The guess without
        one of these views is then likelier.
        """
        known = warm.step.size + len(warm.extra)
        old, new = np.split(extra, [len(warm.extra)], axis=1)
        given = self.linear, warm, old, new, precision
        guesses = [first_guess(*given)]
        if guesses[0][1] > np.sqrt(2.0 * self.linear.views) * self.noise:  # large residuals remain
            touched, view = np.asarray(new.any(axis=(0, 1))), self.linear.view
            tied = [view[tracks.rows[touched[tracks.rows].any(axis=1)]].ravel() for tracks in self.linear.tracks]
            beside = np.setdiff1d(np.concatenate(tied), view[touched])
            guesses += [first_guess(*given, one) for one in beside.tolist()]

        def set_and_evaluate(guess: tuple[Array, float, float]) -> float:
            self.x[known:] = guess[0]
            return self._expectations().log

        self.x[known:], far, _ = max(guesses, key=set_and_evaluate) if len(guesses) > 1 else guesses[0]
        self.noise = max(self.noise, far)

    def run(self, most: int = ITERATIONS, cooled: float = COOLED) -> MixtureFit:
        """Iterate to convergence, at most `most` times; a later call continues. `cooled` replaces `COOLED`."""
        linear, last, fitted, ends, overshot = self.linear, -np.inf, 0.0, False, False
        self.cooled = cooled
        for left in range(most, 0, -1):
            expected = self._expectations()
            # an outdated curvature may overshoot, and the iteration would then cycle
            overshot |= expected.log < last - LIKELIHOOD_TOLERANCE
            is_new = self._has_changed(expected) or ends or overshot or left == 1
            if is_new:
                kinds = zip(expected.kinds, self.beside, strict=True)
                self.curvature = [self._curvature(kind.weight, beside) for kind, beside in kinds]
            matrix = self._matrix()
            factor = cho_factor(matrix.T, lower=True, overwrite_a=True, check_finite=False)  # in LAPACK's order
            if is_new:
                inverse = np.tril(dtrtri(factor[0], lower=1)[0])
                fitted = len(matrix) - float((inverse**2).sum(axis=0) @ self.precision)
            self.x = self.x - cho_solve(factor, self._gradient(expected), check_finite=False)
            settled = self._update_noise(expected, fitted) and abs(expected.log - last) < LIKELIHOOD_TOLERANCE
            last = expected.log
            if settled and is_new:
                break
            ends = settled
        deviation = self.offset + self.x
        log_det = 2.0 * float(np.log(factor[0].diagonal()).sum()) - float(np.log(self.precision).sum())
        evidence = expected.log - 0.5 * float(self.precision @ deviation**2) - 0.5 * log_det
        sizes = linear.precision.size, linear.precision.size + self.extra.shape[1]
        step, extra, move = np.split(self.x, sizes)
        scatter = 0.0 if self.group is None else self.moved.noise
        step = step.reshape(linear.shape)
        return MixtureFit(evidence, step, extra, self.noise, self.eps, expected.right, move, expected.moving, scatter)

    def scores(self, new: Array, cell: IntArray, cells: int) -> tuple[Array, Array, Array]:
        """Return the score statistics of m new unknowns for each of C cells, with columns `new` (2, m, K) [px].

        `cell` (K,) is the cell of each observation. Returned are the curvature (C, m, m), the gradient (C, m) with the
        P present unknowns projected out, and F (C, P, m). Projecting them out reduces the curvature by F' F.
        """
        linear, expected, moves = self.linear, self._expectations(), new / self.linear.sigma
        (views, q), (e, m) = linear.shape, (self.extra.shape[1], new.shape[1])
        curvature, across = np.zeros((cells, m, m)), np.zeros((cells, views * q + e, m))
        of_views = across[:, : views * q].reshape(cells, views, q, m)
        for tracks, of_subset in zip(linear.tracks, expected.kinds[0].weight, strict=True):
            columns = moves[:, :, tracks.rows].transpose(2, 3, 0, 1).reshape(len(tracks.rows), -1, m)
            weighted = tracks.projectors(of_subset) @ columns
            own = cell[tracks.rows[:, 0]]
            np.add.at(curvature, own, np.swapaxes(columns, 1, 2) @ weighted)
            for k, rows in enumerate(tracks.rows.T):
                part = weighted[:, 2 * k : 2 * k + 2]
                np.add.at(of_views, (own, linear.view[rows]), np.swapaxes(linear.by_row[rows], 1, 2) @ part)
                np.add.at(across[:, views * q :], own, self.extra[:, :, rows].transpose(2, 1, 0) @ part)
        self.curvature = [self._curvature(expected.kinds[0].weight, self.extra)]
        lower = np.linalg.cholesky(self._matrix())
        followed = (
            solve_triangular(lower, across.transpose(1, 0, 2).reshape(len(lower), -1), lower=True) / self.noise**2
        )
        followed = followed.reshape(len(lower), cells, m).transpose(1, 0, 2)
        pulls = np.einsum("cmk,ck->mk", moves, expected.kinds[0].pull) / self.noise**2
        own = np.stack([np.bincount(cell, one, cells) for one in pulls], axis=1)
        absorbed = np.swapaxes(followed, 1, 2) @ solve_triangular(lower, self._gradient(expected), lower=True)
        return curvature / self.noise**2, own - absorbed, followed

    def _update_noise(self, expected: _Expectations, fitted: float) -> bool:
        """Update the noise and the share of wrong observations of each view; return whether the noise has converged."""
        still = expected.kinds[0]
        found = min(max(float(np.sqrt(still.squares / max(still.freedom - fitted, 1.0))), LEAST_NOISE), self.noisiest)
        cold = self.noise <= found
        noise = found if cold else max(found, self.cooled * self.noise)
        wrong = np.bincount(self.linear.view[self.part], 1.0 - expected.right[self.part], minlength=self.linear.views)
        self.eps = np.clip((wrong + WRONG_SHARE_PRIOR[0]) / (self.count + WRONG_SHARE_PRIOR[1]), SLIGHT, 1.0 - SLIGHT)
        if self.group is not None:
            self._update_group(expected, noise, noise <= found)
        converged = abs(np.log(noise / self.noise)) < CONVERGED
        self.noise = noise
        return bool(converged)

    def _update_group(self, expected: _Expectations, noise: float, cold: bool) -> None:
        """Update the share of moving tracks in every cell and their noise, if the annealing has ended (`cold`)."""
        assert self.group is not None
        share, scatter = self.group.share, noise
        if cold:
            rows = self.linear.subsets.rows[self.linear.subsets.begins[0]]
            cell, moved = self.group.cell, expected.kinds[1]
            weights = expected.moving[rows], np.ones(len(rows))
            moving_count, all_of = (np.bincount(cell[rows], w, cell.max() + 1) for w in weights)
            share = ((moving_count + 0.5) / (all_of + 1.0))[cell]
            scatter = max(float(np.sqrt(moved.squares / max(moved.freedom, 1.0))), noise)
        self.moved = _MovedObservations(self.moved.residual, share, scatter)

    def _expectations(self) -> _Expectations:
        """Return the expectations at the present unknowns."""
        linear, size = self.linear, self.extra.shape[1]
        step, extra, move = np.split(self.x, [linear.precision.size, linear.precision.size + size])
        left = linear.residual_after(step.reshape(linear.shape)) + np.einsum("cek,e->ck", self.extra, extra)
        moved = None
        if self.group is not None:
            away = np.einsum("cmk,m->ck", self.beside[1][:, size:], move)
            moved = self.moved = replace(self.moved, residual=left + away)
        found, subsets = _track_posteriors(linear, left, self.noise, self.eps, moved), linear.subsets
        right, moving = np.zeros((2, len(linear.view)))
        right[subsets.rows] = found.right
        if moved is not None:
            moving[subsets.rows] = found.moved(subsets)[subsets.of_row]
        kinds = (one.weighted(linear, share) for one, share in zip(found.subsets, found.shares, strict=True))
        return _Expectations(float(found.log.sum()), right, moving if moved is not None else moving[:0], tuple(kinds))

    @property
    def _noise_of_kinds(self) -> list[float]:
        """Noise of still tracks and, with a group, of moved ones."""
        return [self.noise] if self.group is None else [self.noise, self.moved.noise]

    def _has_changed(self, expected: _Expectations) -> bool:
        """Return whether the sums of weights of a view or of an unknown have changed since the last curvature."""
        sums, further = [], self.precision[self.linear.precision.size :]
        for kind, squared, noise in zip(expected.kinds, self.squared, self._noise_of_kinds, strict=True):
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
        for matrix, noise in zip(self.curvature, self._noise_of_kinds, strict=True):
            out[: len(matrix), : len(matrix)] += matrix / noise**2
        return out

    def _gradient(self, expected: _Expectations) -> Array:
        """Return the gradient of half the weighted squares, priors included."""
        linear, out = self.linear, self.precision * (self.offset + self.x)
        camera, pulls = linear.precision.size, np.zeros_like(linear.residual)
        for kind, beside, noise in zip(expected.kinds, self.beside, self._noise_of_kinds, strict=True):
            pull = kind.pull / noise**2
            pulls += pull
            out[camera : camera + beside.shape[1]] += np.einsum("cek,ck->e", beside, pull)
        by_row, flat = linear.by_row.reshape(-1, linear.shape[1]), pulls.T.ravel()
        for v, (a, b) in enumerate(pairwise(linear.bounds)):
            out[v * linear.shape[1] : (v + 1) * linear.shape[1]] += flat[2 * a : 2 * b] @ by_row[2 * a : 2 * b]
        return out

    def _curvature(self, weights: Sequence[Array], beside: Array) -> Array:
        """Return the Hessian of half the weighted squares by the unknowns of cameras and of columns `beside`."""
        linear, (views, q), size = self.linear, self.linear.shape, beside.shape[1]
        of_beside, across = np.zeros((size, size)), np.zeros((views, q, size))
        of_pairs, seen, turned = list[Array](), list[IntArray](), list[Array]()
        for tracks, of_subset in zip(linear.tracks, weights, strict=True):
            n = tracks.rows.shape[1]
            weight = tracks.projectors(of_subset)
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
        cameras = self._camera_matrix(np.concatenate([one.reshape(-1, 2, 2) for one in of_pairs]))
        cross = across.reshape(views * q, size)
        return np.block([[cameras, cross], [cross.T, of_beside]])

    def _camera_matrix(self, weight: Array) -> Array:
        """Return the normal matrix (N q, N q) of the camera unknowns for weights (M, 2, 2) of `Linear.pairs`."""
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
