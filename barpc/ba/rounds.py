"""Rounds of solving: robust with a shrinking scale, then a cut, then least squares on what is left."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from barpc.ba.loss import LOSSES
from barpc.ba.options import AdjustOptions
from barpc.ba.problem import Problem
from barpc.ba.solve import State, minimise
from barpc.geodesy import Array
from barpc.scene import BoolArray

_LOG = logging.getLogger(__name__)

_MEDIAN = 0.55  # of |r|^2 over its expectation: chi-square with 1 (two views) to 2 (many) degrees of freedom
_ROUGH = 1e-4  # tolerance of a robust round: the weights change anyway
_ROBUST_ROUNDS = 12


@dataclass(frozen=True)
class Outcome:
    """What the rounds end with.

    Parameters
    ----------
    problem : Problem
        With the priors on points as they ended.
    state : State
        Unknowns and points.
    weight : (K,)
        Final weights [1/px], 0 where an observation was cut.
    inlier : (K,)
        Observations in the final solve.
    noise : float
        Observed over stated standard deviation.
    passes : int
        Rounds of cutting.
    """

    problem: Problem
    state: State
    weight: Array
    inlier: BoolArray
    noise: float
    passes: int


class Observations:
    """How much observations count: stated sigmas, the observed noise, and the cap on a view's information."""

    def __init__(self, problem: Problem, sigma: Array, noise_floor: float) -> None:
        self.structure, self.sigma, self.noise_floor = problem.structure, sigma, noise_floor
        self.has_prior = np.zeros(self.structure.num_points, dtype=bool)
        if problem.point_prior is not None:
            self.has_prior[problem.point_prior.index] = True

    def freedom(self, use: BoolArray) -> Array:
        """Degrees of freedom (K,) of an observation once its point is estimated: 1/2 of two views', to 2."""
        structure = self.structure
        count = structure.sum_points(use[:, None].astype(np.float64))[:, 0]
        rows = 2.0 * np.maximum(count, 1.0)
        free = np.where(self.has_prior, rows, np.maximum(rows - 3.0, 0.25))
        freedom: Array = (2.0 * free / rows)[structure.point]
        return freedom

    def squared(self, residual: Array, use: BoolArray) -> Array:
        """|r|^2 (K,) over its expectation under the stated sigmas."""
        s: Array = (residual**2).sum(axis=0) / self.sigma**2 / self.freedom(use)
        return np.where(np.isfinite(s), s, np.inf)

    def weight(self, use: BoolArray, noise: float) -> Array:
        """1 / sigma (K,) [1/px] under the cap; 0 where not used."""
        weight = use / (self.sigma * noise)
        information = self.structure.sum_views((weight**2)[None])[:, 0]
        cap = np.minimum(1.0, 1.0 / np.maximum(information * self.noise_floor**2, 1e-300))
        capped: Array = weight * np.sqrt(cap)[self.structure.view]
        return capped

    def tied(self, use: BoolArray) -> BoolArray:
        """`use` without the observations whose point is left without a second one (or a prior)."""
        structure = self.structure
        count = structure.sum_points(use[:, None].astype(np.float64))[:, 0]
        tied: BoolArray = use & ((count >= 2) | self.has_prior)[structure.point]
        return tied


def run_rounds(
    problem: Problem,
    observations: Observations,
    state: State,
    options: AdjustOptions,
    use: BoolArray,
    hold: Callable[[Problem, Array], Problem],
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

    Returns
    -------
    Outcome
    """
    finite = np.isfinite(problem.residuals(state.params, state.points)).all(axis=0)
    everything = use = observations.tied(use & finite)
    noise, passes = 1.0, 0
    problem = hold(problem, state.points)
    if options.loss == "linear":
        state = _minimise(problem, state, observations.weight(use, noise), options)
    else:
        state, noise = _robust(problem, observations, state, use, options)
        for passes in range(1, options.num_passes + 1):
            problem = hold(problem, state.points)
            s = observations.squared(problem.residuals(state.params, state.points), use)
            kept = observations.tied(everything & (s <= (options.robust_threshold * noise) ** 2))
            if passes > 1 and (kept == use).all():
                break
            use = kept
            state = _minimise(problem, state, observations.weight(use, noise), options)
            noise = _noise(problem, observations, state, use)
            _LOG.info("pass %d: %d of %d observations, noise %.3f", passes, use.sum(), len(use), noise)
    noise = _noise(problem, observations, state, use) if options.estimate_noise else 1.0
    weight = observations.weight(use, noise)
    state = _minimise(hold(problem, state.points), state, weight, options)
    return Outcome(problem, state, weight, use, noise, passes)


def _robust(
    problem: Problem, observations: Observations, state: State, use: BoolArray, options: AdjustOptions
) -> tuple[State, float]:
    """Reweighted rounds while the loss's scale shrinks to three standard deviations of the noise."""
    loss = LOSSES[options.loss]
    scale = np.inf
    noise = 1.0
    for _ in range(_ROBUST_ROUNDS):
        s = observations.squared(problem.residuals(state.params, state.points), use)
        noise = float(np.sqrt(np.median(s[use]) / _MEDIAN)) if use.any() else 1.0
        wanted = max(3.0 * noise, 1e-6)
        if scale <= 1.2 * wanted:
            break
        scale = wanted
        weight = observations.weight(use, noise) * np.sqrt(loss(s / scale**2)[1])
        state = minimise(problem, state, weight, options.solver, 2, _ROUGH)
    return state, noise


def _minimise(problem: Problem, state: State, weight: Array, options: AdjustOptions) -> State:
    return minimise(problem, state, weight, options.solver, options.max_steps, options.tolerance)


def _noise(problem: Problem, observations: Observations, state: State, use: BoolArray) -> float:
    """Observed over stated standard deviation of the observations in use."""
    residual = problem.residuals(state.params, state.points)[:, use] / observations.sigma[use]
    structure = problem.structure
    seen = np.unique(structure.point[use & ~observations.has_prior[structure.point]])
    freedom = residual.size - 3 * len(seen) - int(problem.free.sum())
    if freedom < 10:
        return 1.0
    return max(float(np.sqrt((residual**2).sum() / freedom)), 1e-6)
