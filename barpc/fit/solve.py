"""From points to the coefficients of an RPC: one function a method.

``ridge``, the default: least squares with a penalty scaled by the noise. Bayes' rule for coefficients of known size:
with noise sigma in y and a coefficient expected within +- t, the penalty is (sigma / t)^2 x^2. Exact points have no
noise, hence no penalty; noisy points cannot drive a denominator to zero. sigma is read off the compressed system.

``lcurve``, the paper's solver (Akiki et al. 2021, section 3): one h from the corner of the L-curve, then weighted and
ICCV iterations. All unknowns are penalised alike, as in the paper; its singular value decompositions are taken of
the compressed system, which has the same singular values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.linalg import solve_triangular

from barpc.errors import FitError
from barpc.fit.points import extent
from barpc.fit.precision import ALTITUDE_FLOOR, PRECISIONS, Normalization
from barpc.fit.system import Compressed, IntArray, Problem
from barpc.geodesy import Array
from barpc.options import FitOptions
from barpc.sensor.rpc import MONOMIALS, RPC

_DEGREE = np.array([0, *(len(monomial) for monomial in MONOMIALS[1:])])
_NUMERATOR = np.array([np.inf, np.inf, 0.1, 0.03])
_DENOMINATOR = np.array([np.inf, 1.0, 0.1, 0.01])
_SIGMA_STEPS = 2
_EPS = float(np.finfo(np.float64).eps)
MAX_PASSES = 20
TAU = 0.003
"""Standard deviation that ``ridge`` expects of a denominator coefficient of degree one (no unit)."""
WEIGHTED = 1
"""Further passes of ``ridge`` with the residuals weighted by 1 / denominator, where that varies."""
TOLERANCE = 1e-10
"""Change of the RMSE [px] at which the iterations stop."""
_SAMPLES = 200  # of the L-curve
_EVEN = 0.05  # a denominator within 1 -/+ this weights nothing


def expected_size(active: IntArray) -> Array:
    """Size (k,) expected of each unknown; infinite where nothing is expected.

    Numerator: 0.1 of degree two, 0.03 of degree three. Denominator: `TAU` of degree one, a tenth of it
    of degree two, a hundredth of degree three: what vendors' RPCs show, with room.
    """
    degree = _DEGREE[active]
    return np.concatenate([_NUMERATOR[degree], TAU * _DENOMINATOR[degree[1:]]])


def penalized(system: Compressed, penalty: Array) -> Compressed:
    """The system with the rows diag(`penalty`) x = 0 below."""
    k = len(penalty)
    rows = np.zeros((k, k + 1), order="F")
    rows[np.arange(k), np.arange(k)] = penalty
    return system.stacked(rows)


def noise_scaled(system: Compressed, expected: Array) -> tuple[Compressed, float]:
    """The system with each unknown penalised by sigma / its expected size, and sigma.

    The free solution lets noisy denominators shrink, and the residual with them; the residual of the
    penalised one tells the noise better. Never quite singular: there is a floor at the rounding.
    """
    floor = 16 * _EPS * float(np.abs(system.matrix).max())
    dof = max(system.num_points - len(expected), 1)
    sigma = system.sigma
    for _ in range(_SIGMA_STEPS):
        penalty = np.where(np.isfinite(expected), np.maximum(sigma / expected, floor), 0.0)
        penalised = penalized(system, penalty)
        sigma = float(np.sqrt(system.squares(solution(penalised)) / dof))
    return penalised, sigma


def solution(system: Compressed, quantize: Callable[[Array], Array] | None = None) -> Array:
    """The least-squares solution (k,), by back substitution.

    Parameters
    ----------
    system : Compressed
        Penalties included.
    quantize : callable, optional
        Rounds a coefficient to what a file can hold. Each is rounded in turn, and the ones still to come
        make up for its rounding (Babai's nearest plane).
    """
    matrix, target = system.matrix, system.target
    if quantize is None:
        return np.asarray(solve_triangular(matrix, target))
    x = np.zeros(len(target))
    for i in range(len(x) - 1, -1, -1):
        x[i] = quantize((target[i] - matrix[i, i + 1 :] @ x[i + 1 :]) / matrix[i, i])
    return x


def corner(systems: Sequence[Compressed]) -> float:
    """Regularisation h at the corner of the L-curve of systems that share one h.

    The curve (log |M x - y|, log |x|) and its curvature have a closed form in the singular values (Hansen,
    "Rank-deficient and discrete ill-posed problems", 1998); the largest curvature is searched on a
    geometric range of h and around its best value.
    """
    parts = [np.linalg.svd(system.matrix) for system in systems]
    s = np.concatenate([part.S for part in parts])
    beta = np.concatenate([part.U.T @ system.target for part, system in zip(parts, systems, strict=True)])
    rest = sum(float(system.triangle[-1, -1]) ** 2 for system in systems)
    low = max(float(s.min()), float(s.max()) * 16 * float(np.finfo(np.float64).eps))
    high = float(s.max())
    for _ in range(4):
        h = np.geomspace(low, high, _SAMPLES)
        curvature = _curvature(h[:, None], s, beta, rest)
        best = int(np.argmax(curvature))
        if not curvature[best] > 0:  # concave throughout: the least regularisation
            return low
        low, high = h[max(best - 1, 0)], h[min(best + 1, _SAMPLES - 1)]
    return float(h[best])


def _curvature(h: Array, s: Array, beta: Array, rest: float) -> Array:
    """Curvature (n,) of the L-curve at h (n, 1) for singular values s and projections beta (k,)."""
    xi2, beta2 = (beta / s) ** 2, beta**2
    f = s**2 / (s**2 + h**2)
    g = 1.0 - f
    f1 = -2.0 * f * g / h
    f2 = -f1 * (3.0 - 4.0 * f) / h
    eta2, rho2 = (f * f * xi2).sum(axis=1), (g * g * beta2).sum(axis=1) + rest
    phi, psi = (f * f1 * xi2).sum(axis=1), (g * f1 * beta2).sum(axis=1)
    dphi = ((f1 * f1 + f * f2) * xi2).sum(axis=1)
    dpsi = ((g * f2 - f1 * f1) * beta2).sum(axis=1)
    # derivatives of log(eta) and log(rho) with respect to h
    eta1, rho1 = phi / eta2, -psi / rho2
    eta22, rho22 = dphi / eta2 - 2.0 * eta1**2, -dpsi / rho2 - 2.0 * rho1**2
    return np.asarray((rho1 * eta22 - rho22 * eta1) / (rho1**2 + eta1**2) ** 1.5)


@dataclass
class _State:
    """The best solution so far: coefficients, solved systems, RMSE [px]; and the last RMSE."""

    coeffs: Array
    solved: list[Compressed]
    best: float
    last: float


def solve_lcurve(problem: Problem, axes: Sequence[int]) -> tuple[Array, list[Compressed], float, int]:
    """Fit the coordinates `axes` (0 col, 1 row) with one h.

    Parameters
    ----------
    problem : Problem
        The points.
    axes : sequence of int
        One coordinate, or both for the paper's joint problem of 78 unknowns.

    Returns
    -------
    coeffs : (2 len(axes), 20)
        Numerator and denominator of each coordinate.
    solved : list of Compressed
        Their final systems, penalties included.
    h : float
        Regularisation.
    passes : int
        Passes over the points.
    """
    systems = [problem.compressed(axis) for axis in axes]
    h = corner(systems)
    size = np.full(len(systems[0].target), h)
    penalised = [penalized(system, size) for system in systems]
    coeffs = np.concatenate([problem.expanded(solution(system)) for system in penalised])
    state = _State(coeffs, penalised, np.inf, np.inf)
    passes = 1 + _iterate(problem, axes, state, size, corrected=False)
    passes += _iterate(problem, axes, state, np.ones_like(size), corrected=True)
    return state.coeffs, state.solved, h, passes


def _iterate(problem: Problem, axes: Sequence[int], state: _State, penalty: Array, corrected: bool) -> int:
    """Weighted passes until the RMSE stands still; with `corrected`, of the ICCV kind (eq. 6)."""
    coeffs, solved = state.coeffs, state.solved
    for step in range(1, MAX_PASSES + 2):
        squares, following = 0.0, []
        for i, axis in enumerate(axes):
            system = problem.compressed(axis, coeffs[2 * i + 1])
            x = np.concatenate([coeffs[2 * i, problem.active], coeffs[2 * i + 1, problem.active[1:]]])
            squares += system.squares(x) * float(problem.norm.image_scale[axis]) ** 2
            if corrected:  # |M x - y|^2 + |x - x_previous|^2
                rows = np.column_stack([np.diag(penalty), x])
                following.append(system.stacked(rows))
            else:
                following.append(penalized(system, penalty))
        rmse = float(np.sqrt(squares / (len(axes) * len(problem.image))))
        if rmse < state.best:
            state.coeffs, state.solved, state.best = coeffs, solved, rmse
        settled, state.last = abs(state.last - rmse) < TOLERANCE, rmse
        if settled or step > MAX_PASSES:
            break
        solved = following
        coeffs = np.concatenate([problem.expanded(solution(system)) for system in following])
    state.last = np.inf
    return step


@dataclass(frozen=True, eq=False)
class Solution:
    """An RPC and how it was found.

    Parameters
    ----------
    rpc : RPC
        The result.
    problem : Problem
        What was solved.
    solved : list of Compressed
        Final systems of col and row, penalties included.
    h : (2,)
        Regularisation of col, row.
    iterations : int
        Passes over the points.
    method : str
        The solver.
    """

    rpc: RPC
    problem: Problem
    solved: list[Compressed]
    h: Array
    iterations: int
    method: str

    def leave_one_out(self) -> Iterator[Array]:
        """Residuals (n, 2) [px] that points would have if they had not been used, some hundred at a time.

        r / (1 - leverage), the leverage from the final system: exact for a linear problem.
        """
        inverses = [np.linalg.pinv(system.matrix) for system in self.solved]
        rows = [
            self.problem.rows(axis, self.rpc.coeffs[2 * axis + 1], len(inverse) > len(self.problem.active))
            for axis, inverse in enumerate(inverses)
        ]
        for both in zip(*rows, strict=True):
            part = both[0][0]
            residual = self.rpc.project(self.problem.ground[part]) - self.problem.image[part]
            for axis, (_, block) in enumerate(both):
                spread = block[:, :-1] @ inverses[axis]
                leverage = np.einsum("ij,ij->i", spread, spread)
                residual[:, axis] /= np.maximum(1.0 - leverage, 1e-6)
            yield residual


def tidy(values: Array) -> Array:
    """Values of at most twelve significant digits: they survive every reader that prints fifteen."""
    return np.array([float(f"{value:.12g}") for value in values])


def normalization(
    ground: Array, image: Array, options: FitOptions, vendor: RPC | None = None
) -> Normalization:
    """Offsets and scales that take points into [-1, 1].

    Parameters
    ----------
    ground : (N, 3)
        lon (continuous), lat [deg], alt [m].
    image : (N, 2)
        col, row [px].
    options : FitOptions
        Its ``precision`` rounds what is found.
    vendor : RPC, optional
        Ground offsets and scales are taken from it.
    """
    (low, high), (left, right) = extent(ground), extent(image)
    offset, scale = 0.5 * (low + high), 0.5 * (high - low)
    if vendor is not None:
        offset, scale = vendor.ground_offset, vendor.ground_scale
    else:
        offset, scale = tidy(offset), tidy(np.maximum(scale, [1e-9, 1e-9, ALTITUDE_FLOOR]))
    middle, half = tidy(0.5 * (left + right)), tidy(np.maximum(0.5 * (right - left), 1e-6))
    found = Normalization(offset, scale, middle, half)
    return found if options.precision is None else PRECISIONS[options.precision].normalization(found)


def solve(
    ground: Array,
    image: Array,
    options: FitOptions,
    method: str,
    *,
    weight: Array | None = None,
    vendor: RPC | None = None,
) -> Solution:
    """Fit the coefficients of an RPC to points.

    Parameters
    ----------
    ground : (N, 3)
        lon (continuous), lat [deg], alt [m].
    image : (N, 2)
        col, row [px].
    options : FitOptions
        Parameters of the solvers.
    method : {"ridge", "lcurve", "lcurve-joint", "vendor-denominators"}
        The solver.
    weight : (N,), optional
        Weights of the points (1 / standard deviation).
    vendor : RPC, optional
        Whose denominators "vendor-denominators" keeps.

    Raises
    ------
    FitError
        Too few points, or points that do not determine the coefficients.
    """
    keeps = method == "vendor-denominators"
    if keeps and vendor is None:
        raise FitError(
            "vendor-denominators: the model is not built on an RPC whose denominators could be kept"
        )
    norm = normalization(ground, image, options, vendor if keeps else None)
    problem = Problem(ground, image, norm, weight=weight).screened()
    unknowns = len(problem.active) * (1 if keeps else 2) - (0 if keeps else 1)
    if len(ground) <= unknowns:
        raise FitError(
            f"{len(ground)} points are too few: each coordinate has {unknowns} unknowns, "
            f"give {unknowns + 1} points or more"
        )
    return _METHODS[method](problem, options, vendor)


def _quantize(options: FitOptions) -> Callable[[Array], Array] | None:
    return None if options.precision is None else PRECISIONS[options.precision].coeffs


def _assembled(
    problem: Problem, coeffs: Array, solved: list[Compressed], h: Array, passes: int, method: str
) -> Solution:
    norm = problem.norm
    rpc = RPC(coeffs, norm.ground_offset, norm.ground_scale, norm.image_offset, norm.image_scale)
    return Solution(rpc, problem, solved, h, passes, method)


def _ridge(problem: Problem, options: FitOptions, vendor: RPC | None) -> Solution:
    expected = expected_size(problem.active)
    quantize = _quantize(options)
    coeffs, solved, h, passes = np.zeros((4, 20)), [], np.zeros(2), 1
    for axis in range(2):
        denominator = None
        for done in range(1 + WEIGHTED):
            system, sigma = noise_scaled(problem.compressed(axis, denominator), expected)
            pair = problem.expanded(solution(system))
            denominator = pair[1]
            passes = max(passes, 1 + done)
            if np.abs(denominator[1:]).sum() < _EVEN:
                break
        coeffs[2 * axis : 2 * axis + 2] = (
            pair if quantize is None else problem.expanded(solution(system, quantize))
        )
        solved.append(system)
        h[axis] = sigma / TAU
    return _assembled(problem, coeffs, solved, h, passes, "ridge")


def _lcurve(problem: Problem, options: FitOptions, vendor: RPC | None, joint: bool = False) -> Solution:
    groups = [[0, 1]] if joint else [[0], [1]]
    results = [solve_lcurve(problem, axes) for axes in groups]
    coeffs = np.concatenate([result[0] for result in results])
    solved = [system for result in results for system in result[1]]
    quantize = _quantize(options)
    if quantize is not None:
        pairs = [problem.expanded(solution(system, quantize)) for system in solved]
        coeffs = np.concatenate(pairs)
    h = np.broadcast_to([result[2] for result in results], 2).copy()
    name, passes = "lcurve-joint" if joint else "lcurve", max(result[3] for result in results)
    return _assembled(problem, coeffs, solved, h, passes, name)


def _vendor_denominators(problem: Problem, options: FitOptions, vendor: RPC | None) -> Solution:
    quantize = _quantize(options)
    coeffs, solved = np.zeros((4, 20)), []
    for axis in range(2):
        denominator = vendor.coeffs[2 * axis + 1] if vendor is not None else coeffs[1]
        denominator = denominator / denominator[0]
        if quantize is not None:
            denominator = quantize(denominator)
        raw = problem.compressed(axis, denominator, free=False)
        system, _ = noise_scaled(raw, expected_size(problem.active)[: len(raw.matrix)])
        x = solution(system, quantize)
        coeffs[2 * axis : 2 * axis + 2] = problem.expanded(x, denominator)
        solved.append(system)
    return _assembled(problem, coeffs, solved, np.zeros(2), 1, "vendor-denominators")


_METHODS: dict[str, Callable[[Problem, FitOptions, RPC | None], Solution]] = {
    "ridge": _ridge,
    "lcurve": _lcurve,
    "lcurve-joint": partial(_lcurve, joint=True),
    "vendor-denominators": _vendor_denominators,
}
