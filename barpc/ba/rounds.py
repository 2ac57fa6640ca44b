"""Rounds of solving: robust with a shrinking scale, then a cut, then least squares on what is left."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from barpc.ba.cameras import Projected
from barpc.ba.loss import LOSSES
from barpc.ba.problem import Problem
from barpc.ba.smooth import SPLINES, Smooth, SmoothTest
from barpc.ba.solve import TOLERANCE, Minimum, State, gauss_newton, minimise
from barpc.ba.variances import PriorTest, Variances, same_prior
from barpc.geodesy import Array
from barpc.options import AdjustOptions
from barpc.scene import BoolArray

_LOG = logging.getLogger(__name__)

MEDIAN = 0.55  # of |r|^2 over its expectation: chi-square with 1 (two views) to 2 (many) degrees of freedom
_LOW = 0.2  # part of the observations, and the |r|^2 over its expectation that they stay below, about
_LEAST_NOISE = 0.5  # of the stated sigmas, while outliers are about
_SAME = 1e-3  # a cut that changes less than this part of the observations is not solved again
_SAME_NOISE = 0.02  # nor is a change of the noise by less than this part
_SAME_PRIOR = 0.2  # nor of a prior's standard deviation
_LARGEST_MISFIT = 3.0  # px: or a misfit would loosen the view that causes it
_SMOOTH_SEEN = 0.3  # sigmas: a smooth part that is smaller is taken from each view by itself
_BACKFITTING = 6
_MANY_CUT = 0.01  # of the observations: more are looked at again
_REVIVING = 2
_LEAST_FREEDOM = 20
_ROBUST_ROUNDS = 20
_AS_STATED = 1.5  # times the noise stated, and
_CLEAN = 5.0  # sigmas
_FEW = 0.002  # of the observations farther away than that: there is nothing to be careful about
_NEAR = 12.0  # sigmas: a loss that is no wider asks what is smooth
_SHRINK = 0.25  # of the loss's scale in one round, at most
MAX_PASSES = 5
"""Rounds of cutting and solving, at most: they end when nothing changes."""
_FIRST_TOLERANCE = 0.1  # of the first pass after robust rounds: the second, which follows always, is exact


@dataclass(frozen=True)
class Outcome:
    """What the rounds end with.

    Parameters
    ----------
    problem : Problem
        With the priors on points as they ended.
    minimum : Minimum
        Unknowns, points, the last linearisation.
    residual : (2, K)
        Projected - observed [px].
    inlier : (K,)
        Observations in the final solve.
    noise : float
        Observed over stated standard deviation.
    passes : int
        Rounds of cutting.
    prior : PriorTest
        How the corrections compare with the priors given, and what the priors became.
    smooth : SmoothTest
        What is smooth in the residuals that are left.
    """

    problem: Problem
    minimum: Minimum
    residual: Array
    inlier: BoolArray
    noise: float
    passes: int
    prior: PriorTest
    smooth: SmoothTest


class Observations:
    """How much observations count: stated sigmas, the observed noise, and the cap on a view's information."""

    def __init__(self, problem: Problem, sigma: Array, noise_floor: float, is_tie: BoolArray) -> None:
        self.structure, self.sigma, self.noise_floor = problem.structure, sigma, noise_floor
        self.is_tie = is_tie
        self.has_prior = np.zeros(self.structure.num_points, dtype=bool)
        if problem.point_prior is not None:
            self.has_prior[problem.point_prior.index] = True
        self.is_control = ~is_tie & self.has_prior[self.structure.point]  # tested point by point, not cut

    def freedom(self, counted: Array) -> Array:
        """Degrees of freedom (K,) of an observation once its point is estimated: 1/2 of two views', to 2.

        `counted` (K,) says how much each observation counts; a track with one that counts for nothing is a
        track of the others.
        """
        structure = self.structure
        largest = np.zeros(structure.num_points)
        np.maximum.at(largest, structure.point, counted)
        count = structure.sum_points(counted[None])[0] / np.maximum(largest, 1e-300)
        rows = 2.0 * np.maximum(count, 1.0)
        free = np.where(self.has_prior, rows, np.maximum(rows - 3.0, 0.25))
        freedom: Array = (2.0 * free / rows)[structure.point]
        return freedom

    def squared(self, residual: Array, counted: Array) -> Array:
        """|r|^2 (K,) over its expectation under the stated sigmas."""
        s: Array = (residual**2).sum(axis=0) / self.sigma**2 / self.freedom(counted)
        return np.where(np.isfinite(s), s, np.inf)

    def weight(self, use: BoolArray, noise: float, misfit: Array | float = 0.0) -> Array:
        """1 / sigma (K,) [1/px], tie points under the cap; 0 where not used.

        What a view's camera cannot follow, `misfit` (N,) [px], does not average away either: it is as good as
        `SPLINES` independent errors.
        """
        weight: Array = use / (self.sigma * noise)
        information = self.structure.sum_views((weight * self.is_tie)[None] ** 2)[:, 0]
        floor = self.noise_floor**2 + np.minimum(misfit, _LARGEST_MISFIT) ** 2 / SPLINES
        cap = 1.0 / np.sqrt(np.maximum(information * floor, 1.0))
        return np.where(self.is_tie, weight * cap[self.structure.view], weight)

    def noise(self, residual: Array, use: BoolArray, problem: Problem, fitted: int = 0) -> float:
        """Observed over stated standard deviation of the observations in use; 1 where there are too few.

        `fitted` further parameters have been taken out of the residuals.
        """
        use = use & ~self.is_control
        whitened = residual[:, use] / self.sigma[use]
        seen = np.zeros(self.structure.num_points, dtype=bool)
        seen[self.structure.point[use]] = True
        freedom = whitened.size - 3 * int((seen & ~self.has_prior).sum()) - int(problem.free.sum()) - fitted
        if freedom < _LEAST_FREEDOM:
            return 1.0
        return max(float(np.sqrt((whitened**2).sum() / freedom)), 1e-6)

    def tied(self, use: BoolArray) -> BoolArray:
        """`use` without the observations whose point is left without a second one (or a prior)."""
        structure = self.structure
        count = np.bincount(structure.point[use], minlength=structure.num_points)
        tied: BoolArray = use & ((count >= 2) | self.has_prior)[structure.point]
        return tied


def run_rounds(
    problem: Problem,
    observations: Observations,
    state: State,
    options: AdjustOptions,
    everything: BoolArray,
    use: BoolArray,
    hold: Callable[[Problem, Array], Problem],
    variances: Variances,
    smooth: Smooth,
    known_noise: float | None = None,
) -> Outcome:
    """Robust rounds, cuts and the final least squares.

    Outliers are judged by what is left of their residuals once the smooth part of every view is taken away: a
    camera that the unknowns cannot follow yet does not make its tie points wrong.

    Parameters
    ----------
    problem : Problem
        What is minimised.
    observations : Observations
        What each observation counts.
    state : State
        Unknowns at their prior, points triangulated.
    options : AdjustOptions
        Loss, threshold, number of passes, solver.
    everything : (K,)
        Observations that may be used.
    use : (K,)
        Those to start with.
    hold : callable
        The problem with its points' priors renewed at points (P, 3).
    variances : Variances
        What may be learnt about the cameras' priors.
    smooth : Smooth
        The smooth model of the views.
    known_noise : float, optional
        Of rounds that have ended near here: what is in use has been chosen, and nothing robust comes first.

    Returns
    -------
    Outcome
    """
    robust = options.loss != "linear"
    projected: Projected | None = problem.linearise(state.params, state.points)
    assert projected is not None
    residual = projected.image - problem.xy
    everything = observations.tied(everything & np.isfinite(residual).all(axis=0))
    use = observations.tied(use & everything)
    problem = hold(problem, state.points)
    noise, passes, counted = 1.0, 0, use.astype(np.float64)
    floor: Array | float = 0.0
    if known_noise is not None:
        noise = known_noise
    elif robust:
        start = problem.with_camera_prior(variances.for_search())
        state, residual, counted, noise = _robust(start, observations, state, projected, use, options, smooth)
        floor = smooth.test(residual, use, neighbours=False).rms
    while True:
        if robust and projected is None and use.sum() < (1.0 - _MANY_CUT) * everything.sum():
            state, residual = revived(problem, state, residual, use, everything / observations.sigma)
        problem = hold(problem, state.points)
        passes += 1
        kept = use
        if robust:
            scatter = _scatter(problem, observations, smooth, state, residual, counted)
            s = observations.squared(scatter, use.astype(np.float64))
            near = (s <= (options.robust_threshold * noise) ** 2) | observations.is_control
            kept = observations.tied(everything & near)
        wanted = noise if options.estimate_noise else 1.0
        weight = observations.weight(kept, wanted, floor)
        found = minimise(
            problem,
            state,
            weight,
            "sparse"
            if options.solver == "auto" and passes == 1
            else options.solver,  # a second pass follows always
            TOLERANCE if passes > 1 or not robust else _FIRST_TOLERANCE,
            projected,
        )
        state, projected = found.state, None
        residual = problem.residuals(state.params, state.points)
        cost = problem.cost(state.params, state.points, residual * weight)
        state = replace(state, cost=cost, history=(*state.history, cost))
        prior, tested = variances.learnt(problem, found)
        same = passes > 1 and int((kept != use).sum()) <= _SAME * len(use)
        use, counted, before = kept, kept.astype(np.float64), noise
        if robust:
            scatter = _scatter(problem, observations, smooth, state, residual, counted)
            noise = observations.noise(scatter, use, problem, smooth.parameters(counted))
            floor = smooth.test(residual, use, neighbours=False).rms
        else:
            noise = observations.noise(residual, use, problem)
        _LOG.info("pass %d: %d of %d observations, noise %.3f", passes, use.sum(), len(use), noise)
        settled = not options.estimate_noise or abs(noise / before - 1.0) < _SAME_NOISE
        settled &= same_prior(prior, problem.camera_prior, _SAME_PRIOR)
        if passes > MAX_PASSES or (settled and (same or not robust)):
            minimum = replace(found, state=state)
            return Outcome(problem, minimum, residual, use, noise, passes, tested, smooth.test(residual, use))
        problem = problem.with_camera_prior(prior)


def _robust(
    problem: Problem,
    observations: Observations,
    state: State,
    projected: Projected,
    use: BoolArray,
    options: AdjustOptions,
    smooth: Smooth,
) -> tuple[State, Array, Array, float]:
    """Reweighted steps while the loss's scale shrinks to three standard deviations of the noise.

    `projected` is of the state, and in the end of the one that is returned, with its residuals, how much every
    observation counts, and the noise.

    The noise is a median that counts observations by their weights: as the scale shrinks, it leaves the
    wrong ones behind. It cannot fall below what the best fifth of all observations shows, nor below half of
    what is stated, or a few that fit by chance would be left.
    """
    loss = LOSSES[options.loss]
    counted, scale, noise = use.astype(np.float64), np.inf, 1.0
    residual = projected.image - problem.xy
    s = observations.squared(residual, counted)
    for _ in range(_ROBUST_ROUNDS):
        least = float(np.sqrt(np.quantile(s[use], _LOW) / _LOW)) if use.any() else 1.0
        noise = max(float(np.sqrt(_median(s, counted) / MEDIAN)), least, _LEAST_NOISE)
        if scale <= 3.6 * noise:
            break
        clean = noise < _AS_STATED and float((s[use] > (_CLEAN * noise) ** 2).mean()) < _FEW
        scale = 3.0 * noise if np.isinf(scale) or clean else max(3.0 * noise, _SHRINK * scale)
        counted = np.where(observations.is_control, use, use * loss(s / scale**2)[1])
        state = gauss_newton(problem, state, observations.weight(use, noise) * np.sqrt(counted), projected)
        residual = problem.linearise(state.params, state.points).image - problem.xy  # into `projected`
        near = scale <= _NEAR * noise
        s = observations.squared(residual - smooth.part(residual, counted) if near else residual, counted)
        counted = np.where(observations.is_control, use, use * loss(s / scale**2)[1])
    return state, residual, counted, noise


def revived(
    problem: Problem, state: State, residual: Array, use: BoolArray, weight: Array
) -> tuple[State, Array]:
    """The state with tracks that were cut altogether where the cameras now see them, and the residuals (2, K) there.

    Nothing moved them since; with what they were cut for mended, they may come back.
    """
    structure = problem.structure
    dead = structure.sum_points(use[None].astype(np.float64))[0] == 0
    points = state.points.copy()
    for _ in range(_REVIVING):
        moved = problem.triangulate(points, problem.project_points(state.params, points), weight)
        points[dead] = moved[dead]
    again = problem.residuals(state.params, points)
    return replace(state, points=points), np.where(dead[structure.point], again, residual)


def _scatter(
    problem: Problem,
    observations: Observations,
    smooth: Smooth,
    state: State,
    residual: Array,
    counted: Array,
) -> Array:
    """Residuals (2, K) [px] without the smooth parts of all views that see a point.

    A point shares what one of its views is wrong by among all of them, and relief moves the rows of the views against
    each other: so the smooth parts are found view by view and the points follow, until they stand.
    """
    part = smooth.part(residual, counted)
    size = float(np.sqrt((counted * (part / observations.sigma) ** 2).sum() / max(counted.sum(), 1.0)))
    if size < _SMOOTH_SEEN:
        return residual - part
    projected = problem.project_points(state.params, state.points)
    weight = counted**0.5 / observations.sigma
    left = residual
    for _ in range(_BACKFITTING):
        left = problem.settled_residual(residual - part, projected, weight)
        part += smooth.part(left, counted)
    return problem.settled_residual(residual - part, projected, weight)


def _median(values: Array, weights: Array) -> float:
    """Median of `values`, each counted as often as its weight says."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    if not len(total) or not total[-1] > 0:
        return 1.0
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])
