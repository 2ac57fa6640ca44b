"""Least squares of a `Problem` at fixed weights: scipy's `least_squares`, or a sparse Levenberg-Marquardt method.

By default `scipy.optimize.least_squares` minimises problems of up to `SCIPY_UNKNOWNS` camera unknowns. Larger ones are
solved by sparse Gauss-Newton steps, damped only where a step fails. So are intermediate minima of the robust rounds,
whose tolerance is above `TOLERANCE`.

Both solve the joint least-squares problem of cameras and points, with the points eliminated. scipy gets it compressed:
with S = U^T U the reduced matrix and g its gradient, f = (U^-T g, sqrt(cost - gain - |U^-T g|^2)) and J = (U; 0) have
the cost, the gradient and the Gauss-Newton step of the full problem, in N q + 1 residuals. scipy's own tolerances end
its iteration. The last evaluation is the linearisation at the minimum, from which the covariance is computed.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from itertools import count

import numpy as np
import scipy.linalg as la

from barpc.ba.parameters.projected import Projected
from barpc.ba.solving.covariance import Covariance
from barpc.ba.solving.linear import Factor
from barpc.ba.solving.normal import Reduced
from barpc.ba.solving.problem import Problem
from barpc.base.errors import AdjustError
from barpc.base.geodesy import Array
from barpc.base.statistics import CONVERGED, ITERATIONS, ROUNDING, STANDS
from barpc.scene import BoolArray

logger = logging.getLogger(__name__)
_on_start: ContextVar[Callable[[], None]] = ContextVar("on_start", default=lambda: None)  # of each minimisation

TOLERANCE = 1e-6  # a step that would lower the cost by less than this fraction is the last
SCIPY_UNKNOWNS = 200  # 22 views of 9; with more, dense products of `WhitenedProblem` take over 10 % of the time


@dataclass(frozen=True)
class State:
    """State of the iteration: cameras and points."""

    params: Array  # (N, q) unknowns of the views
    points: Array  # (P, 3) ECEF [m]
    cost: float = np.inf  # sum of squared whitened residuals
    history: tuple[float, ...] = ()  # cost at every linearisation so far, and at the end of every pass

    def moved(self, step: Array, reduced: Reduced, cost: float) -> State:
        """Return the state after a step (N, q) of the cameras and the corresponding step of the points."""
        points = self.points + reduced.point_step(step)
        return replace(self, params=self.params + step, points=points, cost=cost)


@dataclass(frozen=True)
class Minimum:
    """Result of a minimisation."""

    state: State  # the minimum
    reduced: Reduced  # the last linearisation: at the minimum (scipy), or one small step before it
    factor: Factor | None = None  # of its matrix, free unknowns only; None: not factorised
    status: str = ""  # which solver ran, and why it stopped
    ahead: tuple[Array, Projected | None] | None = None  # `Problem.prepare` at the state, if evaluated
    settled: bool = True  # False: stopped at the maximum number of steps
    _known: list[Covariance] = field(default_factory=list, repr=False)  # the covariance, once computed

    def covariance(self, free: BoolArray) -> Covariance:
        """Return the posterior covariance from the last linearisation, computed once."""
        if not self._known:
            self._known.append(self._covariance(free))
        return self._known[0]

    def _covariance(self, free: BoolArray) -> Covariance:
        factor = self.factor
        if factor is None:
            try:
                factor = self.reduced.factor(free)
            except np.linalg.LinAlgError as error:
                raise AdjustError(
                    f"the normal equations are not positive definite at the solution ({error}): do the tie points "
                    "cover the images, and are the priors finite?"
                ) from error
        return Covariance(self.reduced, factor, free)


@contextmanager
def passes_told(tell: Callable[[int], None]) -> Iterator[None]:
    """Call `tell(n)` at the start of the n-th minimisation; their number depends on the residuals."""
    number = count(1)
    token = _on_start.set(lambda: tell(next(number)))
    try:
        yield
    finally:
        _on_start.reset(token)


def minimise(
    problem: Problem,
    state: State,
    weight: Array,
    solver: str = "auto",
    tolerance: float = TOLERANCE,
    projected: Projected | None = None,
) -> Minimum:
    """Minimise at fixed weights (K,) [1/px] from a state near the minimum.

    The last step is one that is expected to lower the cost by less than `tolerance` times the cost, or after which
    the next would lower it by less than a thousandth of that (see `has_converged`). `solver` is "auto" or "sparse"
    (see the module docstring). `projected` is the result of `Problem.linearise` at the state; it is overwritten.

    Raises
    ------
    AdjustError
        The cost is not finite, or no step lowers it.
    """
    _on_start.get()()
    start = time.process_time()
    unknowns, result = int(problem.free.sum()), None
    if solver == "auto":
        solver = "scipy" if 0 < unknowns <= SCIPY_UNKNOWNS and tolerance <= TOLERANCE else "sparse"
    if solver == "scipy":
        try:
            result = _scipy(problem, state, weight, tolerance, projected)
        except np.linalg.LinAlgError as error:  # its SVD may fail on a finite matrix
            logger.warning("least_squares failed (%s): going on by Levenberg-Marquardt", error)
            solver, projected = "sparse", None
    if result is None:
        result = _levenberg_marquardt(problem, state, weight, tolerance, projected)
    seconds = time.process_time() - start
    logger.info("%s: %d unknowns, cost %.6g, %.2f s", solver, unknowns, result.state.cost, seconds)
    return result


def has_converged(gain: float, before: float, cost: float, tolerance: float) -> bool:
    """Return whether a step that should lower the cost by `gain`, after a step with `before`, is the last.

    `cost` is the cost before the step, `tolerance` its negligible fraction. Gains shrink at least in the ratio of the
    last two, so the next one is at most gain^2 / before. A cost below 1 counts as 1: without noise it is only rounding.
    """
    cost = max(cost, 1.0)
    return gain <= tolerance * cost or gain * gain <= 1e-3 * tolerance * cost * before < np.inf


def _is_as_predicted(cost: float, predicted: float, tolerance: float) -> bool:
    """Return whether the cost after a step is so close to the predicted one that the step is the last.

    A further step could only correct the nonlinearity of the residuals. It would lower the cost by at most about twice
    the difference of the two costs: here a hundredth of the tolerance.
    """
    return abs(cost - predicted) <= 5e-3 * tolerance * predicted


def gauss_newton(problem: Problem, state: State, weight: Array, projected: Projected | None = None) -> State:
    """Return the state after one undamped step, for rounds that change the weights; `projected`: see `minimise`."""
    reduced = problem.reduce(state.params, state.points, weight, projected)
    step, gain, _ = camera_step(problem, reduced)
    return state.moved(step, reduced, max(_finite_cost(reduced.cost) - gain, 0.0))


def camera_step(problem: Problem, reduced: Reduced, damping: float = 0.0) -> tuple[Array, float, Factor]:
    """Return the Gauss-Newton step (N, q) of the cameras, the decrease of the cost it predicts, and the factor."""
    free = problem.free
    step = np.zeros(len(free))
    gradient = reduced.gradient[free]
    factor = reduced.factor(free, damping)
    solution = factor.solve(gradient)
    step[free] = -solution
    gain = reduced.gain + float(gradient @ solution)
    return step.reshape(problem.structure.num_views, -1), gain, factor


def _levenberg_marquardt(
    problem: Problem, state: State, weight: Array, tolerance: float, projected: Projected | None
) -> Minimum:
    """Minimise by Gauss-Newton steps, damped only after one fails."""
    damping, before = 0.0, np.inf
    reduced = problem.reduce(state.params, state.points, weight, projected)
    state = replace(state, cost=_finite_cost(reduced.cost), history=(*state.history, reduced.cost))
    for _ in range(ITERATIONS):
        try:
            step, gain, factor = camera_step(problem, reduced, damping)
        except np.linalg.LinAlgError:
            damping = max(10.0 * damping, 1e-8)
            continue
        ahead = state.moved(step, reduced, max(state.cost - gain, 0.0))
        if has_converged(gain, before, state.cost, tolerance):
            status = _status(state, "the next step gains too little")
            return Minimum(ahead, reduced, None if damping else factor, status)
        residual, projected = problem.prepare(ahead.params, ahead.points)
        cost = problem.cost(ahead.params, ahead.points, residual * weight)
        if not damping and _is_as_predicted(cost, ahead.cost, tolerance):
            status = _status(state, "the last step gained what it should")
            return Minimum(replace(ahead, cost=cost), reduced, factor, status, (residual, projected))
        if cost <= state.cost * (1.0 + 1e-12):
            slow = damping > 0.0 and state.cost - cost < STANDS  # a fifth of a standard deviation of a weak mode
            del reduced, factor  # two of a large block do not fit into memory
            reduced = problem.reduce(ahead.params, ahead.points, weight, projected)
            state = replace(ahead, cost=reduced.cost, history=(*state.history, reduced.cost))
            if slow:
                return Minimum(state, reduced, status=_status(state, "a damped step gains too little"))
            before = gain if not damping else np.inf
            damping = damping / 10.0 if damping > 1e-8 else 0.0
            continue
        # rounding: the predicted decrease is far below the tolerance, or below it and no damping lowers the cost
        if gain <= TOLERANCE * (CONVERGED if damping < 1e8 else 1.0) * state.cost:
            return Minimum(state, reduced, status=_status(state, "what a step gains is lost in rounding"))
        if damping >= 1e8:
            raise AdjustError(f"no step lowers the cost {state.cost:.6g}: the solution is not usable")
        damping = max(10.0 * damping, 1e-6)
    return Minimum(state, reduced, status=_status(state, "the number of steps is used up"), settled=False)


def _status(state: State, reason: str) -> str:
    return f"sparse Levenberg-Marquardt, {len(state.history)} evaluations in all: {reason}"


class WhitenedProblem:
    """The compressed problem for scipy, in unknowns x = U0 (p - p0) whitened by the first linearisation at p0.

    Their normal matrix is nearly the identity, so the squared norm of the gradient is the gain of a step.
    """

    def __init__(self, problem: Problem, state: State, weight: Array, projected: Projected | None) -> None:
        self.problem, self.weight = problem, weight
        self.reduced = problem.reduce(state.params, state.points, weight, projected)
        cost = _finite_cost(self.reduced.cost)
        self.state = replace(state, cost=cost, history=(*state.history, cost))
        self.start = state.params
        self.upper0 = la.cholesky(self.reduced.plain(self.problem.free), check_finite=False)
        self.key = np.zeros(len(self.upper0)).tobytes()
        self._compress(self.upper0)
        self.lowest = self.key, self.state, self.reduced

    def _compress(self, upper: Array) -> None:
        """Set the compressed residuals `whitened` and `rest` and their derivative `slope`, from S = U^T U."""
        gradient = self.reduced.gradient[self.problem.free]
        self.whitened = la.solve_triangular(upper, gradient, trans="T", check_finite=False)
        rest = self.reduced.cost - self.reduced.gain - float(self.whitened @ self.whitened)
        self.rest = np.sqrt(max(rest, 0.0))
        self.slope = la.solve_triangular(self.upper0, upper.T, trans="T", check_finite=False).T

    def at(self, x: Array) -> None:
        """Linearise at whitened unknowns x, unless it is linearised there already.

        Points start from the state of lowest cost so far: after a failed step they may be anywhere.
        """
        key = x.tobytes()
        if key == self.key:
            return
        self.key, (lowest_key, state, reduced) = key, self.lowest
        if key != lowest_key:
            step = np.zeros(self.start.size)
            step[self.problem.free] = la.solve_triangular(self.upper0, x, check_finite=False)
            state = state.moved(self.start + step.reshape(self.start.shape) - state.params, reduced, np.inf)
            reduced = self.problem.reduce(state.params, state.points, self.weight)
            state = replace(state, cost=reduced.cost, history=(*self.state.history, reduced.cost))
        if reduced.cost <= self.lowest[1].cost:
            self.lowest = key, state, reduced
        self.state, self.reduced = state, reduced
        try:
            upper = la.cholesky(self.reduced.plain(self.problem.free), check_finite=False)
        except np.linalg.LinAlgError:
            if key == self.lowest[0]:
                raise
            # scipy rejects so bad a step by its cost, whatever the derivative
            self.whitened, self.rest = np.zeros(len(x)), np.sqrt(reduced.cost)
            return
        self._compress(upper)

    def residual(self, x: Array) -> Array:
        """Return the N q + 1 residuals."""
        self.at(x)
        return np.append(self.whitened, self.rest)

    def jacobian(self, x: Array) -> Array:
        """Return the derivative of the residuals."""
        self.at(x)
        return np.vstack([self.slope, np.zeros((1, len(x)))])


def _scipy(problem: Problem, state: State, weight: Array, tolerance: float, projected: Projected | None) -> Minimum:
    from scipy.optimize import least_squares  # slow to import (0.05 s); large blocks do not need it

    compressed = WhitenedProblem(problem, state, weight, projected)
    found = least_squares(
        compressed.residual,
        np.zeros(len(compressed.whitened)),
        compressed.jacobian,
        method="trf",
        x_scale=10.0 * (1.0 + float(np.linalg.norm(compressed.whitened))),  # the first step is not shortened
        tr_solver="lsmr",  # few products, J being nearly the identity; "exact": an SVD a step
        tr_options={"regularize": False, "atol": ROUNDING, "btol": ROUNDING},
        ftol=tolerance,
        xtol=ROUNDING,  # steps below rounding
        gtol=np.sqrt(tolerance),  # for whitened unknowns, whose squared gradient is the gain of a step
        max_nfev=ITERATIONS,
    )
    compressed.at(found.x)
    _finite_cost(compressed.state.cost)
    status = f"scipy least_squares, {found.nfev} evaluations: {found.message.rstrip('.')}"
    return Minimum(compressed.state, compressed.reduced, status=status, settled=bool(found.success))


def _finite_cost(cost: float) -> float:
    if not np.isfinite(cost):
        raise AdjustError("the cost is not finite: a camera cannot be evaluated at its tie points")
    return cost
