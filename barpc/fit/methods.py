"""From points to the coefficients of an RPC: one function a method, on the linearised system (`barpc.fit.system`).

``ridge``, the default: least squares with a penalty scaled by the noise. Bayes' rule for coefficients of known size:
with noise sigma in y and a coefficient expected within +- t, the penalty is (sigma / t)^2 x^2. Exact points have no
noise, hence no penalty; noisy points cannot drive a denominator to zero. sigma is read off the compressed system.

``gauss-newton``: the least squares of y - a / b itself, not of b y - a, from the ridge on: the same rows with what the
coefficients now give in place of y, and damped towards them. No penalty: for models without noise, whose misfit a ridge
takes for noise. Denominators stay above a tenth over the hull of the points and a margin (`barpc.fit.poles`).

``lcurve-joint``, the paper's solver (Akiki et al. 2021, section 3): one h from the corner of the L-curve, then weighted
and ICCV iterations. All unknowns are penalised alike, as in the paper; its singular value decompositions are taken of
the compressed system, which has the same singular values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from barpc.base.errors import FitError
from barpc.base.geodesy import Array
from barpc.base.options import FitOptions
from barpc.fit.points import column_ranges
from barpc.fit.poles import Region, bounded
from barpc.fit.system import (
    EPS,
    MAX_PASSES,
    TAU,
    FitProblem,
    Normalization,
    TriangularSystem,
    expected_size,
    noise_scaled,
    solution,
)
from barpc.sensor.geometry import LEAST_RANGE
from barpc.sensor.rpc import RPC

SolverResult = tuple[Array, list["TriangularSystem"], Array, int]
"""Coefficients (4, 20); final systems of col and row, penalties included; their regularisation h (2,); passes."""

WEIGHTED = 1
"""Further passes of ``ridge`` with the residuals weighted by 1 / denominator, where that varies."""
RMSE_TOLERANCE = 1e-10
"""Change of the RMSE [px] at which the iterations stop."""
_DAMPED = 1e-6  # of the size of a column, at first
_MIN_STEP_GAIN = 1e-3  # of the sum of squares: less in a step, and it stands
_NEGLIGIBLE_DENOMINATOR = 0.05  # a denominator within 1 -/+ this weights nothing


def corner(systems: Sequence[TriangularSystem]) -> float:
    """Return the regularisation h at the corner of the systems' one L-curve: the largest curvature, by grids of h.

    The curve (log |M x - y|, log |x|) and its curvature have a closed form in the singular values (Hansen,
    "Rank-deficient and discrete ill-posed problems", 1998).
    """
    parts = [np.linalg.svd(system.matrix) for system in systems]
    s = np.concatenate([part.S for part in parts])
    beta = np.concatenate([part.U.T @ system.target for part, system in zip(parts, systems, strict=True)])
    rest = sum(float(system.triangle[-1, -1]) ** 2 for system in systems)
    low = max(float(s.min()), float(s.max()) * 16 * EPS)
    high = float(s.max())
    for _ in range(5):  # each narrows it by 25
        h = np.geomspace(low, high)
        curvature = _curvature(h[:, None], s, beta, rest)
        best = int(np.argmax(curvature))
        if not curvature[best] > 0:  # concave throughout: the least regularisation
            return low
        low, high = h[max(best - 1, 0)], h[min(best + 1, len(h) - 1)]
    return float(h[best])


def _curvature(h: Array, s: Array, beta: Array, rest: float) -> Array:
    """Return the curvature (n,) of the L-curve at h (n, 1) for singular values s and projections beta (k,)."""
    xi2, beta2 = (beta / s) ** 2, beta**2
    f = s**2 / (s**2 + h**2)
    g = 1.0 - f
    # -h/2 df/dh: curvature takes neither the parameter's scale nor d2f/dh2, which is along the curve
    slope = f * g
    eta2, rho2 = (f * f * xi2).sum(axis=1), (g * g * beta2).sum(axis=1) + rest
    # derivatives of log(eta) and log(rho)
    eta1, rho1 = -(f * slope * xi2).sum(axis=1) / eta2, (g * slope * beta2).sum(axis=1) / rho2
    eta22 = (slope**2 * xi2).sum(axis=1) / eta2 - 2.0 * eta1**2
    rho22 = (slope**2 * beta2).sum(axis=1) / rho2 - 2.0 * rho1**2
    return np.asarray((rho1 * eta22 - rho22 * eta1) / (rho1**2 + eta1**2) ** 1.5)


def _lcurve(problem: FitProblem) -> SolverResult:
    """Fit col and row with one h: the paper's joint problem of 78 unknowns.

    The passes over the points are weighted ones until the RMSE stands still, then from the best such ones of the ICCV
    kind (eq. 6).
    """
    systems = [problem.compressed(axis) for axis in range(2)]
    h = corner(systems)
    ridge = np.full(len(systems[0].target), h)
    solved, passes, least = [system.penalized(ridge) for system in systems], 1, np.inf
    best = _solved_coefficients(problem, solved), solved
    for penalty, corrected in ((ridge, False), (np.ones_like(ridge), True)):
        (coeffs, solved), last = best, np.inf
        for _ in range(MAX_PASSES + 1):
            passes += 1
            rmse, following = _reweighted(problem, coeffs, penalty, corrected)
            if rmse < least:
                least, best = rmse, (coeffs, solved)
            if not abs(last - rmse) >= RMSE_TOLERANCE:  # nor a number, where a denominator is 0 at a point
                break
            coeffs, solved, last = _solved_coefficients(problem, following), following, rmse
    coeffs, solved = best
    return coeffs, solved, np.full(2, h), passes


def _solved_coefficients(problem: FitProblem, systems: list[TriangularSystem]) -> Array:
    """Return the coefficients (4, 20) that solve the systems of col and row."""
    return np.concatenate([problem.expanded(solution(system)) for system in systems])


def _reweighted(
    problem: FitProblem, coeffs: Array, penalty: Array, corrected: bool
) -> tuple[float, list[TriangularSystem]]:
    """Return RMSE [px] of coefficients, and the systems that their denominators weight."""
    squares, following = 0.0, []
    for axis in range(2):
        with np.errstate(all="ignore"):  # a denominator that is 0 at a point: no number comes of it, and the passes end
            system = problem.compressed(axis, coeffs[2 * axis + 1])
        x = problem.packed(coeffs[2 * axis : 2 * axis + 2])
        squares += system.squares(x) * float(problem.norm.image_scale[axis]) ** 2
        # corrected: |M x - y|^2 + |x - x_previous|^2
        following.append(system.penalized(penalty, x if corrected else 0.0))
    return float(np.sqrt(squares / (2 * len(problem.image)))), following


@dataclass(frozen=True, eq=False)
class FitSolution:
    """Coefficients and how they were found: the problem, and the final systems of its parts with their penalties."""

    coeffs: Array  # (4, 20)
    problem: FitProblem
    solved: list[TriangularSystem]
    h: Array
    iterations: int
    method: str

    @cached_property
    def rpc(self) -> RPC:
        """The camera, of points on the ground."""
        norm = self.problem.norm
        return RPC(self.coeffs, norm.ground_offset, norm.ground_scale, norm.image_offset, norm.image_scale)

    @cached_property
    def region(self) -> Region:
        """Region of the ground over which denominators are bounded."""
        return region_of(self.problem)

    def leave_one_out(self) -> Iterator[Array]:
        """Yield the leave-one-out residuals (n, 2) of the points, some hundred at a time.

        r / (1 - leverage), the leverage from the final system: exact for a linear problem.
        """
        problem = self.problem
        # from the rows of (M | y) to the unknowns' standard deviations (k, n)
        inverses = [np.asarray(np.linalg.pinv(system.matrix)) for system in self.solved]
        rows = [problem.rows(axis, self.coeffs[2 * axis + 1]) for axis in range(2)]
        for both in zip(*rows, strict=True):
            residual = np.empty((len(both[0][1]), 2))
            for axis, (part, block) in enumerate(both):
                x = problem.packed(self.coeffs[2 * axis : 2 * axis + 2])
                spread = block[:, :-1] @ inverses[axis]
                leverage = np.einsum("ij,ij->i", spread, spread)
                residual[:, axis] = (block[:, :-1] @ x - block[:, -1]) * problem.norm.image_scale[axis]
                residual[:, axis] /= np.maximum(1.0 - leverage, 1e-6)
                if problem.weight is not None:
                    residual[:, axis] /= problem.weight[part]
            yield residual


def region_of(problem: FitProblem) -> Region:
    """Return the hull of a problem's own points and its margin."""
    norm = problem.norm
    ground = (problem.ground - norm.ground_offset) / norm.ground_scale
    return Region.around(ground, (problem.image - norm.image_offset) / norm.image_scale, problem.margin)


def tidy(values: Array) -> Array:
    """Return values rounded to twelve significant digits: they survive every reader that prints fifteen."""
    return np.array([float(f"{value:.12g}") for value in values])


def normalization(ground: Array, image: Array) -> Normalization:
    """Return the offsets and scales that take points into [-1, 1]."""
    (low, high), (left, right) = column_ranges(ground), column_ranges(image)
    offset = tidy(0.5 * (low + high))
    scale = tidy(np.maximum(0.5 * (high - low), [1e-9, 1e-9, LEAST_RANGE / 2]))
    middle, half = tidy(0.5 * (left + right)), tidy(np.maximum(0.5 * (right - left), 1e-6))
    return Normalization(offset, scale, middle, half)


def solve(
    ground: Array,
    image: Array,
    options: FitOptions,
    method: str,
    *,
    weight: Array | None = None,
) -> FitSolution:
    """Fit the coefficients of an RPC to points (N, 3) lon (continuous), lat [deg], alt [m] and (N, 2) [px].

    `method` is a row of `METHODS`, weights (N,) are 1 / standard deviation. FitError: too few points, or points that do
    not determine the coefficients.
    """
    norm = normalization(ground, image)
    problem = FitProblem(ground, image, norm, weight=weight, margin=options.pole_margin).screened()
    unknowns = 2 * len(problem.active) - 1
    if len(ground) <= unknowns:
        raise FitError(
            f"{len(ground)} points are too few: each coordinate has {unknowns} unknowns, "
            f"give {unknowns + 1} points or more"
        )
    coeffs, systems, h, passes = METHODS[method](problem)
    return FitSolution(coeffs, problem, systems, h, passes, method)


def _ridge(problem: FitProblem) -> SolverResult:
    solved, h, passes = [], np.zeros(2), 1
    expected = expected_size(problem.active)
    for axis in range(2):
        denominator = None
        for done in range(1 + WEIGHTED):
            system, sigma = noise_scaled(problem.compressed(axis, denominator), expected)
            denominator = problem.expanded(solution(system))[-1]
            passes = max(passes, 1 + done)
            if np.abs(denominator[1:]).sum() < _NEGLIGIBLE_DENOMINATOR:
                break
        solved.append(system)
        h[axis] = sigma / TAU
    return _solved_coefficients(problem, solved), solved, h, passes


def _gauss_newton_fit(problem: FitProblem) -> SolverResult:
    start, _, _, passes = _ridge(problem)
    parts, solved, region = [], [], region_of(problem)
    for axis in range(2):
        part = start[2 * axis : 2 * axis + 2]
        if not region.above(part[1]):  # from a polynomial, then
            denominator = np.eye(20)[0]
            part = problem.expanded(solution(problem.compressed(axis, denominator, free=False)), denominator)
        x, system, steps = _minimised(problem, axis, problem.packed(part), region)
        parts.append(problem.expanded(x))
        solved.append(system)
        passes = max(passes, steps)
    return np.concatenate(parts), solved, np.zeros(2), passes


def _minimised(problem: FitProblem, axis: int, x: Array, region: Region) -> tuple[Array, TriangularSystem, int]:
    """Return the least squares of y - a / b from unknowns x (k,), the system there, and the passes over the points."""

    def linearised(x: Array) -> TriangularSystem:
        numerator, denominator = problem.expanded(x)
        return problem.compressed(axis, denominator, numerator=numerator)

    system, damping, passes = linearised(x), 0.0, 1
    size = np.linalg.norm(system.matrix, axis=0)
    while passes < MAX_PASSES:
        ahead = _ahead(problem, system, x, damping * size, size, region)
        following, passes = linearised(ahead), passes + 1
        before, after = system.squares(x), following.squares(ahead)
        if after < before:
            x, system, damping = ahead, following, 0.1 * damping if damping > _DAMPED else 0.0
            if before - after < _MIN_STEP_GAIN * before:
                break
        else:
            damping = max(10.0 * damping, _DAMPED)
    return x, system, passes


def _ahead(
    problem: FitProblem, system: TriangularSystem, x: Array, penalty: Array, size: Array, region: Region
) -> Array:
    """Return the solution of a system damped towards x, its denominator kept up over a region; x if there is none."""
    for least, solver in (
        (EPS, solution),
        (_DAMPED, partial(bounded, region=region, active=problem.active)),  # which wants it well conditioned
    ):
        damped = np.maximum(penalty, least * size)
        ahead = solver(system.penalized(damped, damped * x))
        if ahead is not None and region.above(problem.expanded(ahead)[-1]):
            return ahead
    return x


METHODS: dict[str, Callable[[FitProblem], SolverResult]] = {
    "ridge": _ridge,
    "gauss-newton": _gauss_newton_fit,
    "lcurve-joint": _lcurve,
}
"""Name -> solver of a problem."""
