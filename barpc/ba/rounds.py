"""Rounds of solving: robust with a shrinking scale, then a cut, then least squares on what is left."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from barpc.ba.cameras import Projected
from barpc.ba.loss import LOSSES
from barpc.ba.options import AdjustOptions
from barpc.ba.problem import Problem
from barpc.ba.solve import Minimum, State, gauss_newton, minimise
from barpc.geodesy import Array
from barpc.scene import BoolArray

_LOG = logging.getLogger(__name__)

_MEDIAN = 0.55  # of |r|^2 over its expectation: chi-square with 1 (two views) to 2 (many) degrees of freedom
_LOW = 0.2  # part of the observations, and the |r|^2 over its expectation that they stay below, about
_LEAST_NOISE = 0.5  # of the stated sigmas, while outliers are about
_SAME = 1e-3  # a cut that changes less than this part of the observations is not solved again
_SAME_NOISE = 0.02  # nor is a change of the noise by less than this part
_LEAST_FREEDOM = 20
_ROBUST_ROUNDS = 20
_SHRINK = 0.25  # of the loss's scale in one round, at most
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
    """

    problem: Problem
    minimum: Minimum
    residual: Array
    inlier: BoolArray
    noise: float
    passes: int


class Observations:
    """How much observations count: stated sigmas, the observed noise, and the cap on a view's information."""

    def __init__(self, problem: Problem, sigma: Array, noise_floor: float, is_tie: BoolArray) -> None:
        self.structure, self.sigma, self.noise_floor = problem.structure, sigma, noise_floor
        self.is_tie = is_tie
        self.has_prior = np.zeros(self.structure.num_points, dtype=bool)
        if problem.point_prior is not None:
            self.has_prior[problem.point_prior.index] = True

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

    def weight(self, use: BoolArray, noise: float) -> Array:
        """1 / sigma (K,) [1/px], tie points under the cap; 0 where not used."""
        weight: Array = use / (self.sigma * noise)
        information = self.structure.sum_views((weight * self.is_tie)[None] ** 2)[:, 0]
        cap = 1.0 / np.sqrt(np.maximum(information * self.noise_floor**2, 1.0))
        return np.where(self.is_tie, weight * cap[self.structure.view], weight)

    def noise(self, residual: Array, use: BoolArray, problem: Problem) -> float:
        """Observed over stated standard deviation of the observations in use; 1 where there are too few."""
        whitened = residual[:, use] / self.sigma[use]
        seen = np.zeros(self.structure.num_points, dtype=bool)
        seen[self.structure.point[use]] = True
        freedom = whitened.size - 3 * int((seen & ~self.has_prior).sum()) - int(problem.free.sum())
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
    use: BoolArray,
    hold: Callable[[Problem, Array], Problem],
    projected: Projected,
) -> Outcome:
    """Robust rounds, cuts and the final least squares.

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
    use : (K,)
        Observations to start with.
    hold : callable
        The problem with its points' priors renewed at points (P, 3).
    projected : Projected
        `Problem.linearise` of `state`; it is used up.

    Returns
    -------
    Outcome
    """
    residual, ahead = projected.image - problem.xy, True
    everything = use = observations.tied(use & np.isfinite(residual).all(axis=0))
    problem = hold(problem, state.points)
    noise, passes = 1.0, 0
    if options.loss != "linear":
        state, residual, noise = _robust(problem, observations, state, projected, use, options)
    while True:
        problem = hold(problem, state.points)
        passes += 1
        kept = use
        if options.loss != "linear":
            s = observations.squared(residual, use.astype(np.float64))
            kept = observations.tied(everything & (s <= (options.robust_threshold * noise) ** 2))
        wanted = noise if options.estimate_noise else 1.0
        weight = observations.weight(kept, wanted)
        found = minimise(
            problem,
            state,
            weight,
            options.solver,
            options.max_steps,
            options.tolerance if passes > 1 or options.loss == "linear" else _FIRST_TOLERANCE,
            projected if ahead else None,
        )
        state, ahead = found.state, False
        residual = problem.residuals(state.params, state.points)
        cost = problem.cost(state.params, state.points, residual * weight)
        state = replace(state, cost=cost, history=(*state.history, cost))
        same = passes > 1 and int((kept != use).sum()) <= _SAME * len(use)
        use, before = kept, noise
        noise = observations.noise(residual, use, problem)
        _LOG.info("pass %d: %d of %d observations, noise %.3f", passes, use.sum(), len(use), noise)
        settled = not options.estimate_noise or abs(noise / before - 1.0) < _SAME_NOISE
        if passes > options.num_passes or (settled and (same or options.loss == "linear")):
            return Outcome(problem, replace(found, state=state), residual, use, noise, passes)


def _robust(
    problem: Problem,
    observations: Observations,
    state: State,
    projected: Projected,
    use: BoolArray,
    options: AdjustOptions,
) -> tuple[State, Array, float]:
    """Reweighted steps while the loss's scale shrinks to three standard deviations of the noise.

    `projected` is of the state, and in the end of the one that is returned.

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
        noise = max(float(np.sqrt(_median(s, counted) / _MEDIAN)), least, _LEAST_NOISE)
        if scale <= 3.6 * noise:
            break
        scale = 3.0 * noise if np.isinf(scale) else max(3.0 * noise, _SHRINK * scale)
        counted = use * loss(s / scale**2)[1]
        state = gauss_newton(problem, state, observations.weight(use, noise) * np.sqrt(counted), projected)
        residual = problem.linearise(state.params, state.points).image - problem.xy  # into `projected`
        s = observations.squared(residual, counted)
        counted = use * loss(s / scale**2)[1]
    return state, residual, noise


def _median(values: Array, weights: Array) -> float:
    """Median of `values`, each counted as often as its weight says."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    if not len(total) or not total[-1] > 0:
        return 1.0
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])
