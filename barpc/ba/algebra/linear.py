"""Solving with the reduced camera matrix: dense, or front by front where it is sparse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from barpc.ba.algebra.dissection import Dissection
from barpc.ba.algebra.multifrontal import Blocks, Cholesky
from barpc.base.errors import AdjustError
from barpc.base.geodesy import Array

Matrix = Array | Blocks


@dataclass(frozen=True)
class Factor:
    """A factorised symmetric positive definite matrix."""

    solve: Callable[[Array], Array]  # (n,) or (n, m) right-hand sides -> solutions
    method: str  # "dense" or "multifrontal"
    inverse: Callable[[], Blocks] | None = None  # the inverse's blocks where the matrix has some, if it has blocks
    whole_inverse: Callable[[], Array] | None = None  # (n, n), of a dense one
    log_determinant: float = np.nan  # of the matrix, of a dense one


def factorize(matrix: Array, damping: float = 0.0) -> Factor:
    """Factorise S + damping diag(S).

    Raises
    ------
    numpy.linalg.LinAlgError
        The matrix is not positive definite.
    AdjustError
        The matrix is not finite.
    """
    diagonal = matrix.diagonal()
    _check(diagonal)
    if not len(diagonal):
        return Factor(lambda b: b, "none", whole_inverse=lambda: matrix, log_determinant=0.0)
    damped = matrix + np.diag(damping * diagonal) if damping else matrix
    cholesky = la.cho_factor(damped, lower=True, check_finite=False)

    def inverse() -> Array:
        lower = np.tril(la.lapack.dpotri(cholesky[0], lower=True)[0])
        return np.asarray(lower + np.tril(lower, -1).T)

    volume = 2.0 * float(np.log(cholesky[0].diagonal()).sum())
    return Factor(
        lambda b: la.cho_solve(cholesky, b, check_finite=False),
        "dense",
        whole_inverse=inverse,
        log_determinant=volume,
    )


def factorize_blocks(matrix: Blocks, order: Dissection, damping: float = 0.0, less: Array | None = None) -> Factor:
    """Factorise S, of the views in an order of elimination, less B^T B of a few rows `less` (m, n)."""
    _check(matrix.diagonal)
    cholesky = Cholesky(matrix, order)
    cholesky.factorize(damping)
    factor = Factor(cholesky.solve, "multifrontal", cholesky.inverse)
    return factor if less is None else _updated(factor, less, order)


def _check(diagonal: Array) -> None:
    if not np.isfinite(diagonal).all():
        raise AdjustError("the normal equations are not finite: a camera cannot be evaluated at its tie points")


def _updated(factor: Factor, less: Array, order: Dissection) -> Factor:
    """Return the factor of S - B^T B from that of S (Woodbury's formula)."""
    pulled = factor.solve(np.ascontiguousarray(less.T))
    upper = la.cholesky(np.eye(len(less)) - less @ pulled)
    root = la.solve_triangular(upper, pulled.T, trans="T").T  # (S - B^T B)^-1 = S^-1 + root root^T

    def solve(b: Array) -> Array:
        first = factor.solve(b)
        return first + root @ (root.T @ b)

    def inverse() -> Blocks:
        assert factor.inverse is not None
        found = factor.inverse()
        by_view = np.zeros((*found.diagonal.shape[:2], len(less)))
        by_view[order.rank >= 0] = root.reshape(-1, *by_view.shape[1:])
        i, j = found.pair_view.T
        found.diagonal[...] += by_view @ by_view.swapaxes(1, 2)
        found.pairs[...] += by_view[i] @ by_view[j].swapaxes(1, 2)
        return found

    return Factor(solve, factor.method, inverse)
