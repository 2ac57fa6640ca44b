"""Regularised weighted least squares for quotients of polynomials, on a compressed system.

One coordinate y = a(x) / b(x), b_0 = 1, is linear in its unknowns once multiplied by b:

    w (m(x), -y m'(x)) (a, b') = w y,      w = 1 / b(x)  or 1                       (eq. 3 of the paper)

m are the twenty monomials, m' those without the constant one. Whatever the number of points, the system
(M | y) is first compressed into its triangular factor R, chunk by chunk; every solver works on R.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg.lapack import dtpqrt

from barpc.geodesy import Array
from barpc.sensor.rpc import monomials

CHUNK = 512
_BLOCK = 8
_EPS = float(np.finfo(np.float64).eps)

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Compressed:
    """Triangular factor of the system (M | y) of one coordinate.

    Parameters
    ----------
    triangle : (k + 1, k + 1)
        R of the QR decomposition of (M | y); its last column is Q' y, its last entry the residual's norm.
    num_points : int
        Rows of M.
    num_numerators : int
        Unknowns that belong to the numerator; they come first.
    """

    triangle: Array
    num_points: int
    num_numerators: int

    @property
    def matrix(self) -> Array:
        """(k, k): what stands for M."""
        return self.triangle[:-1, :-1]

    @property
    def target(self) -> Array:
        """(k,): what stands for y."""
        return self.triangle[:-1, -1]

    @property
    def residual(self) -> float:
        """Norm of the part of y that no solution reaches."""
        return abs(float(self.triangle[-1, -1]))

    def sigma(self) -> float:
        """Standard deviation of the noise in y, from the residual of the free solution."""
        dof = max(self.num_points - len(self.matrix), 1)
        return self.residual / float(np.sqrt(dof))

    def misfit(self, solution: Array) -> float:
        """Root mean square of M x - y over the points."""
        rest = self.matrix @ solution - self.target
        return float(np.sqrt((rest @ rest + self.residual**2) / self.num_points))


def compress(
    normalized: Array,
    target: Array,
    active: IntArray,
    denominator: Array | None = None,
    weight: Array | None = None,
) -> Compressed:
    """QR-compress the linearised system of one coordinate.

    Parameters
    ----------
    normalized : (3, N)
        Normalised longitude, latitude, altitude.
    target : (N,)
        Normalised col or row.
    active : (m,)
        Indices of the monomials in use; the first is the constant one.
    denominator : (20,), optional
        Denominator whose inverse weights the rows.
    weight : (N,), optional
        Further weights of the rows.

    Returns
    -------
    Compressed
        Unknowns: m numerator coefficients, then m - 1 of the denominator.
    """
    m, k = len(active), 2 * len(active) - 1
    triangle = np.zeros((k + 1, k + 1), order="F")
    for start in range(0, len(target), CHUNK):
        part = slice(start, start + CHUNK)
        basis = monomials(normalized[:, part])
        rows = np.empty((basis.shape[1], k + 1), order="F")
        y = target[part]
        rows[:, :m] = basis[active].T
        rows[:, m:k] = (basis[active[1:]] * -y).T
        rows[:, k] = y
        factor = None if weight is None else weight[part]
        if denominator is not None:
            by_denominator = 1.0 / (denominator @ basis)
            factor = by_denominator if factor is None else factor * by_denominator
        if factor is not None:
            rows *= factor[:, None]
        triangle = dtpqrt(0, min(_BLOCK, k + 1), triangle, rows, overwrite_a=True, overwrite_b=True)[0]
    return Compressed(np.triu(triangle), len(target), m)


def solve_ridge(system: Compressed, h: float) -> Array:
    """Minimise |M x - y|^2 + h^2 |x_den|^2: the penalty acts on the denominator alone.

    Parameters
    ----------
    system : Compressed
        The system.
    h : float
        Regularisation; 0 is the free solution of least norm in the denominator.

    Returns
    -------
    solution : (k,)
        Numerator, then denominator coefficients.
    """
    m = system.num_numerators
    matrix, target = system.matrix, system.target
    u, s, vt = np.linalg.svd(matrix[m:, m:])
    h = max(h, _EPS * float(s.max(initial=0.0)) * len(s), np.finfo(np.float64).tiny)
    den = vt.T @ (s / (s * s + h * h) * (u.T @ target[m:]))
    num = np.linalg.lstsq(matrix[:m, :m], target[:m] - matrix[:m, m:] @ den, rcond=None)[0]
    return np.concatenate([num, den])


def solve_noise_scaled(system: Compressed, tau: float) -> tuple[Array, float]:
    """`solve_ridge` with h = sigma / tau: the noise over the size expected of a denominator coefficient.

    Returns
    -------
    solution : (k,)
        Numerator, then denominator coefficients.
    h : float
        The regularisation used.
    """
    h = system.sigma() / tau
    return solve_ridge(system, h), h
