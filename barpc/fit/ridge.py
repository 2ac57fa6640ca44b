"""The default solver: least squares with a penalty scaled by the noise.

Bayes' rule for coefficients of known size: with noise sigma in y and a coefficient expected within +- t,
the penalty is (sigma / t)^2 x^2. Exact points have no noise, hence no penalty; noisy points cannot drive a
denominator to zero. sigma is read off the compressed system itself.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import solve_triangular

from barpc.fit.system import Compressed, IntArray
from barpc.geodesy import Array
from barpc.sensor.rpc import MONOMIALS

_DEGREE = np.array([0, *(len(monomial) for monomial in MONOMIALS[1:])])
_NUMERATOR = np.array([np.inf, np.inf, 0.1, 0.03])
_DENOMINATOR = np.array([np.inf, 1.0, 0.1, 0.01])
_SIGMA_STEPS = 2
_EPS = float(np.finfo(np.float64).eps)


def expected_size(active: IntArray, tau: float) -> Array:
    """Size (k,) expected of each unknown; infinite where nothing is expected.

    Numerator: 0.1 of degree two, 0.03 of degree three. Denominator: `tau` of degree one, a tenth of it
    of degree two, a hundredth of degree three: what vendors' RPCs show, with room.
    """
    degree = _DEGREE[active]
    return np.concatenate([_NUMERATOR[degree], tau * _DENOMINATOR[degree[1:]]])


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
