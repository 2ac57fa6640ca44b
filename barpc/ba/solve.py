"""Minimising a `Problem` at fixed weights: scipy on the compressed problem, or Levenberg-Marquardt.

Both see the joint least-squares problem in cameras AND points. In compressed form, with S = U^T U the
reduced matrix and g its gradient, f = (U^-T g, sqrt(cost - gain - |U^-T g|^2)) and J = (U; 0) have the
cost, the gradient and the Gauss-Newton step of the full problem, in N q + 1 residuals.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg as la
from scipy.optimize import least_squares

from barpc.ba.linear import Factor, Matrix, factorize
from barpc.ba.normal import Reduced
from barpc.ba.problem import Problem
from barpc.errors import AdjustError
from barpc.geodesy import Array

_LOG = logging.getLogger(__name__)

SCIPY_VIEWS = 100
"""Up to so many views "auto" takes scipy, whose dense decomposition grows as N^3."""


@dataclass(frozen=True)
class State:
    """Where the iteration stands.

    Parameters
    ----------
    params : (N, q)
        Unknowns of the views.
    points : (P, 3)
        ECEF [m].
    cost : float
        Sum of squared whitened residuals.
    history : tuple of float
        The cost of every linearisation so far.
    """

    params: Array
    points: Array
    cost: float = np.inf
    history: tuple[float, ...] = ()


def minimise(
    problem: Problem,
    state: State,
    weight: Array,
    solver: str = "auto",
    max_steps: int = 30,
    tolerance: float = 1e-9,
) -> State:
    """Minimise at fixed weights from a state near the minimum.

    Parameters
    ----------
    problem : Problem
        What is minimised.
    state : State
        Where it starts.
    weight : (K,)
        1 / sigma of every observation [1/px], 0 for one that does not count.
    solver : str
        "scipy", "sparse" or "auto".
    max_steps : int
        Linearisations.
    tolerance : float
        Ends when a step would gain less than this fraction of the cost.

    Returns
    -------
    State

    Raises
    ------
    AdjustError
        The cost is not finite, or no step lowers it.
    """
    start = time.process_time()
    views = problem.structure.num_views
    if solver == "auto":
        solver = "scipy" if views <= SCIPY_VIEWS and problem.joint_prior is None else "sparse"
    if solver == "scipy":
        try:
            state = _scipy(problem, state, weight, max_steps, tolerance)
        except np.linalg.LinAlgError as error:  # its SVD may fail on a finite matrix
            _LOG.warning("least_squares failed (%s): going on by Levenberg-Marquardt", error)
            state = _levenberg_marquardt(problem, state, weight, max_steps, tolerance)
    else:
        state = _levenberg_marquardt(problem, state, weight, max_steps, tolerance)
    _LOG.info("%s: %d views, cost %.6g, %.2f s", solver, views, state.cost, time.process_time() - start)
    return state


def _levenberg_marquardt(
    problem: Problem, state: State, weight: Array, max_steps: int, tolerance: float
) -> State:
    """Gauss-Newton steps, damped only when one fails."""
    damping = 0.0
    reduced = problem.reduce(state.params, state.points, weight)
    state = replace(state, cost=_finite(reduced.cost), history=(*state.history, reduced.cost))
    for _ in range(max_steps):
        try:
            step, expected = camera_step(problem, reduced, damping)
        except np.linalg.LinAlgError:
            damping = max(10.0 * damping, 1e-8)
            continue
        params, points = state.params + step, state.points + reduced.point_step(step)
        if expected <= tolerance * state.cost:
            return replace(state, params=params, points=points, cost=state.cost - expected)
        trial = problem.reduce(params, points, weight)
        if trial.cost <= state.cost * (1.0 + 1e-12):
            state = State(params, points, trial.cost, (*state.history, trial.cost))
            reduced, damping = trial, damping / 10.0 if damping > 1e-8 else 0.0
        elif damping > 1e8:
            raise AdjustError(f"no step lowers the cost {state.cost:.6g}: the solution is not usable")
        else:
            damping = max(10.0 * damping, 1e-6)
    _LOG.warning("the adjustment did not settle in %d steps", max_steps)
    return state


def camera_step(problem: Problem, reduced: Reduced, damping: float = 0.0) -> tuple[Array, float]:
    """Gauss-Newton step (N, q) of the camera unknowns, and what cameras and points together would gain."""
    free = problem.free
    gradient = reduced.gradient[free]
    solution = factorize_free(problem, reduced.matrix, damping).solve(gradient)
    step = np.zeros(len(free))
    step[free] = -solution
    return step.reshape(problem.structure.num_views, -1), float(gradient @ solution) + reduced.gain


def factorize_free(problem: Problem, matrix: Matrix, damping: float = 0.0) -> Factor:
    """Factor of the reduced matrix restricted to the views that are not fixed."""
    return factorize(free_part(problem, matrix), damping)


def free_part(problem: Problem, matrix: Matrix) -> Matrix:
    """The reduced matrix restricted to the views that are not fixed."""
    free = problem.free
    if free.all():
        return matrix
    if isinstance(matrix, np.ndarray):
        return matrix[np.ix_(free, free)]
    keep = np.flatnonzero(free)
    part: Matrix = matrix.tocsr()[keep][:, keep]
    return part


class _Compressed:
    """The problem as scipy sees it: camera unknowns in, N q + 1 residuals and their derivative out."""

    def __init__(self, problem: Problem, state: State, weight: Array) -> None:
        self.problem, self.weight = problem, weight
        self.reduced = problem.reduce(state.params, state.points, weight)
        self.state = replace(
            state, cost=_finite(self.reduced.cost), history=(*state.history, self.reduced.cost)
        )
        self.key = state.params.ravel()[problem.free].tobytes()
        self.factor = self._factor()

    def _factor(self) -> tuple[Array, Array]:
        matrix = free_part(self.problem, self.reduced.matrix)
        if not isinstance(matrix, np.ndarray):
            matrix = matrix.toarray()
        upper = la.cholesky(matrix, check_finite=False)
        gradient = self.reduced.gradient[self.problem.free]
        return upper, la.solve_triangular(upper, gradient, trans="T", check_finite=False)

    def _at(self, x: Array) -> None:
        key = x.tobytes()
        if key == self.key:
            return
        params = self.state.params.copy().ravel()
        params[self.problem.free] = x
        params = params.reshape(self.state.params.shape)
        points = self.state.points + self.reduced.point_step(params - self.state.params)
        self.reduced = self.problem.reduce(params, points, self.weight)
        self.state = State(params, points, self.reduced.cost, (*self.state.history, self.reduced.cost))
        self.key, self.factor = key, self._factor()

    def residual(self, x: Array) -> Array:
        self._at(x)
        whitened = self.factor[1]
        rest = self.reduced.cost - self.reduced.gain - float(whitened @ whitened)
        return np.append(whitened, np.sqrt(max(rest, 0.0)))

    def jacobian(self, x: Array) -> Array:
        self._at(x)
        return np.vstack([self.factor[0], np.zeros((1, len(x)))])


def _scipy(problem: Problem, state: State, weight: Array, max_steps: int, tolerance: float) -> State:
    compressed = _Compressed(problem, state, weight)
    start = state.params.ravel()[problem.free]
    if len(start):
        result = least_squares(
            compressed.residual,
            start,
            compressed.jacobian,
            method="trf",
            x_scale=1e3,
            ftol=max(tolerance, 1e-15),
            xtol=None,
            gtol=None,
            max_nfev=max_steps,
        )
        if result.status < 0 or not np.isfinite(result.cost):
            raise AdjustError(f"no usable solution: {result.message}")
        compressed.residual(result.x)
    state = compressed.state
    move = compressed.reduced.point_step(np.zeros_like(state.params))
    return replace(state, points=state.points + move, cost=compressed.reduced.cost - compressed.reduced.gain)


def _finite(cost: float) -> float:
    if not np.isfinite(cost):
        raise AdjustError("the cost is not finite: a camera cannot be evaluated at its tie points")
    return cost
