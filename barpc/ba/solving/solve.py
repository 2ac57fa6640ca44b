"""Least squares of a `Problem` at fixed weights: scipy's `least_squares`, or a sparse Levenberg-Marquardt method.

By default up to `SCIPY_UNKNOWNS` camera unknowns are minimised by `scipy.optimize.least_squares`, more of them by
Gauss-Newton steps of the sparse system that are damped where one fails; a minimum that is only a stage of the robust
rounds (a tolerance above `TOLERANCE`) always by the latter.

Both solve the joint least-squares problem of cameras AND points, whose points are eliminated. scipy sees it compressed:
with S = U^T U the reduced matrix and g its gradient, f = (U^-T g, sqrt(cost - gain - |U^-T g|^2)) and J = (U; 0) have
the cost, the gradient and the Gauss-Newton step of the full problem, in N q + 1 residuals. scipy's own tolerances end
its iteration; the last thing that it evaluates is the linearisation at the minimum, which the covariance comes from.
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
from barpc.base.statistics import CONVERGED, ITERATIONS, ROUNDING
from barpc.scene import BoolArray

logger = logging.getLogger(__name__)
_told: ContextVar[Callable[[], None]] = ContextVar("told", default=lambda: None)  # before each minimisation

TOLERANCE = 1e-6  # a solve ends when a step would lower the cost by less than this fraction
SCIPY_UNKNOWNS = (
    200  # 22 views of nine: beyond, the dense products of `WhitenedProblem` take over a tenth of an adjustment
)


@dataclass(frozen=True)
class State:
    """State of the iteration: cameras and points."""

    params: Array  # (N, q) unknowns of the views
    points: Array  # (P, 3) ECEF [m]
    cost: float = np.inf  # sum of squared whitened residuals
    history: tuple[float, ...] = ()  # the cost at every linearisation, and at the end of every pass, so far

    def moved(self, step: Array, reduced: Reduced, cost: float) -> State:
        """Return the state after a step (N, q) of the cameras and the points' step that goes with it."""
        points = self.points + reduced.point_step(step)
        return replace(self, params=self.params + step, points=points, cost=cost)


@dataclass(frozen=True)
class Minimum:
    """End of a minimisation."""

    state: State  # the minimum
    reduced: Reduced  # the last linearisation: at the minimum (scipy), or one small step before it
    factor: Factor | None = None  # of its matrix, free unknowns only, where it was factorised
    status: str = ""  # which solver ran, and why it stopped
    ahead: tuple[Array, Projected | None] | None = None  # `Problem.prepare` of the state, where that was asked
    settled: bool = True  # or the number of steps was used up
    _known: list[Covariance] = field(default_factory=list, repr=False)

    def covariance(self, free: BoolArray) -> Covariance:
        """Return the posterior covariance by the last linearisation, computed once."""
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
    """Call `tell(n)` at the start of the n-th minimisation; how many there will be depends on the residuals."""
    number = count(1)
    token = _told.set(lambda: tell(next(number)))
    try:
        yield
    finally:
        _told.reset(token)


def minimise(
    problem: Problem,
    state: State,
    weight: Array,
    solver: str = "auto",
    tolerance: float = TOLERANCE,
    projected: Projected | None = None,
) -> Minimum:
    """Minimise at fixed weights (K,) [1/px] from a state near the minimum.

    The step that is expected to gain less than `tolerance` of the cost is taken and is the last, and so is one
    that is expected to leave a thousandth of it (see `has_converged`). `solver` is "auto" or "sparse" (see
    the head of this module). `projected` is `Problem.linearise` of the state, and is used up.

    Raises
    ------
    AdjustError
        The cost is not finite, or no step lowers it.
    """
    _told.get()()
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
    """Return whether a step that should lower the cost by `gain`, after one by `before`, is the last.

    `cost` is that before the step, `tolerance` the share of it that does not matter. The gains shrink at least in the
    proportion of the last two: what the step leaves is gain^2 / before. Without noise the cost is rounding alone: the
    tolerance is a thousandth of a standard deviation at least.
    """
    cost = max(cost, 1.0)
    return gain <= tolerance * cost or gain * gain <= 1e-3 * tolerance * cost * before < np.inf


def _is_as_told(cost: float, told: float, tolerance: float) -> bool:
    """Return whether a step that leaves `cost` is the last, after which `told` should be left.

    What the residuals bend beyond their linearisation is all that a next step could mend, and it gains no more than
    about twice what that adds to the cost: a hundredth of the tolerance.
    """
    return abs(cost - told) <= 5e-3 * tolerance * told


def gauss_newton(problem: Problem, state: State, weight: Array, projected: Projected | None = None) -> State:
    """Take one undamped Gauss-Newton step, for rounds whose weights change anyway; `projected` as in `minimise`."""
    reduced = problem.reduce(state.params, state.points, weight, projected)
    step, gain, _ = camera_step(problem, reduced)
    return state.moved(step, reduced, max(_finite_cost(reduced.cost) - gain, 0.0))


def camera_step(problem: Problem, reduced: Reduced, damping: float = 0.0) -> tuple[Array, float, Factor]:
    """Return the Gauss-Newton step (N, q) of the cameras, its gain with the points', and the factor."""
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
    """Return Gauss-Newton steps, damped only when one fails."""
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
        if not damping and _is_as_told(cost, ahead.cost, tolerance):
            status = _status(state, "the last step gained what it should")
            return Minimum(replace(ahead, cost=cost), reduced, factor, status, (residual, projected))
        if cost <= state.cost * (1.0 + 1e-12):
            del reduced, factor  # of a large block no two fit
            reduced = problem.reduce(ahead.params, ahead.points, weight, projected)
            state = replace(ahead, cost=reduced.cost, history=(*state.history, reduced.cost))
            before = gain if not damping else np.inf
            damping = damping / 10.0 if damping > 1e-8 else 0.0
            continue
        # a cost does not fall any more where so little is promised, or what is tolerated and no damping makes it fall
        if gain <= TOLERANCE * (CONVERGED if damping < 1e8 else 1.0) * state.cost:
            return Minimum(state, reduced, status=_status(state, "what a step gains is lost in rounding"))
        if damping >= 1e8:
            raise AdjustError(f"no step lowers the cost {state.cost:.6g}: the solution is not usable")
        damping = max(10.0 * damping, 1e-6)
    return Minimum(state, reduced, status=_status(state, "the number of steps is used up"), settled=False)


def _status(state: State, reason: str) -> str:
    return f"sparse Levenberg-Marquardt, {len(state.history)} evaluations in all: {reason}"


class WhitenedProblem:
    """The problem as scipy sees it, in unknowns x = U0 p whitened by the first linearisation.

    In them the matrix is nearly the identity: the gradient's size is what a step would gain.
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
        gradient = self.reduced.gradient[self.problem.free]
        self.whitened = la.solve_triangular(upper, gradient, trans="T", check_finite=False)
        rest = self.reduced.cost - self.reduced.gain - float(self.whitened @ self.whitened)
        self.rest = np.sqrt(max(rest, 0.0))
        self.slope = la.solve_triangular(self.upper0, upper.T, trans="T", check_finite=False).T

    def at(self, x: Array) -> None:
        """Linearise at whitened unknowns, unless that was the last thing done.

        Points are moved from the lowest cost so far: those of a step that failed may be anywhere.
        """
        key = x.tobytes()
        if key == self.key:
            return
        self.key, (known, state, reduced) = key, self.lowest
        if key != known:
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
            # a step so far astray that its matrix is rounding is refused for its cost, whatever its derivative
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
    from scipy.optimize import least_squares  # a twentieth of a second, which large blocks do not need

    compressed = WhitenedProblem(problem, state, weight, projected)
    found = least_squares(
        compressed.residual,
        np.zeros(len(compressed.whitened)),
        compressed.jacobian,
        method="trf",
        x_scale=10.0 * (1.0 + float(np.linalg.norm(compressed.whitened))),  # no first step cut short
        tr_solver="lsmr",  # nearly the identity takes few products; "exact" decomposes it at every step
        tr_options={"regularize": False, "atol": ROUNDING, "btol": ROUNDING},
        ftol=tolerance,
        xtol=ROUNDING,  # no step lowers the cost any more
        gtol=np.sqrt(tolerance),  # of whitened unknowns: a thousandth of a standard deviation for a millionth
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
