"""The paper's solver: one h from the corner of the L-curve, then weighted and ICCV iterations.

Akiki et al. 2021, section 3. All unknowns are penalised alike, as in the paper; its singular value
decompositions are taken of the compressed system, which has the same singular values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from barpc.fit.ridge import penalized, solution
from barpc.fit.system import Compressed, Problem
from barpc.geodesy import Array

MAX_PASSES = 20
TOLERANCE = 1e-10
"""Change of the RMSE [px] at which the iterations stop."""
_SAMPLES = 200  # of the L-curve


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
