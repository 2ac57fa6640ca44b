"""Solving with the reduced camera matrix: dense, banded, sparse or iterative, whichever suits."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import LinearOperator, cg, splu

from barpc.errors import AdjustError
from barpc.geodesy import Array
from barpc.scene import IntArray

_LOG = logging.getLogger(__name__)

BANDED_WORK = 2e11  # multiplications (n times the band's width squared) up to which Cholesky is banded

Matrix = Array | sp.csr_array | sp.bsr_array


@dataclass(frozen=True)
class Factor:
    """A factorised symmetric positive definite matrix."""

    solve: Callable[[Array], Array]  # (n,) or (n, m) right-hand sides -> solutions
    method: str  # "dense", "banded", "sparse" or "iterative"


def factorize(matrix: Matrix, damping: float = 0.0, less: Array | None = None) -> Factor:
    """Factorise S + damping diag(S) - B^T B, with a few rows `less` (m, n) as B (Woodbury's formula).

    Raises
    ------
    numpy.linalg.LinAlgError
        The matrix is not positive definite.
    AdjustError
        The matrix is not finite.
    """
    if less is not None:
        return _updated(factorize(matrix, damping), less)
    diagonal = matrix.diagonal()
    if not np.isfinite(diagonal).all():
        raise AdjustError(
            "the normal equations are not finite: a camera cannot be evaluated at its tie points"
        )
    if not len(diagonal):
        return Factor(lambda b: b, "none")
    if isinstance(matrix, np.ndarray):
        damped = matrix + np.diag(damping * diagonal) if damping else matrix
        cholesky = la.cho_factor(damped, check_finite=False)
        return Factor(lambda b: la.cho_solve(cholesky, b, check_finite=False), "dense")
    sparse = sp.csc_array(matrix)
    if damping:
        sparse = sp.csc_array(sparse + sp.diags_array(damping * diagonal))
    order = reverse_cuthill_mckee(sp.csr_array(sparse), symmetric_mode=True).astype(np.int64)
    banded = _banded(sparse, order)
    if banded is not None:
        return banded
    try:
        lu = splu(sparse, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except (MemoryError, RuntimeError) as error:
        _LOG.warning("sparse factorisation failed (%s): going on by conjugate gradients", error)
        return _iterative(sparse)
    return Factor(lu.solve, "sparse")


def _updated(factor: Factor, less: Array) -> Factor:
    """The factor of S - B^T B from that of S."""
    pulled = factor.solve(np.ascontiguousarray(less.T))
    small = la.cho_factor(np.eye(len(less)) - less @ pulled)

    def solve(b: Array) -> Array:
        first = factor.solve(b)
        return first + pulled @ la.cho_solve(small, less @ first)

    return Factor(solve, factor.method)


def _banded(matrix: sp.csc_array, order: IntArray) -> Factor | None:
    """Banded Cholesky after reverse Cuthill-McKee; None where the band is too wide."""
    n = matrix.shape[0]
    place = np.empty(n, dtype=np.int64)
    place[order] = np.arange(n)
    coo = matrix.tocoo()
    row, col = place[coo.coords[0]], place[coo.coords[1]]
    width = int(np.abs(row - col).max(initial=0))
    if float(n) * width * width > BANDED_WORK:
        return None
    below = row >= col
    band = np.zeros((width + 1, n))
    band[(row - col)[below], col[below]] = coo.data[below]
    factor = la.cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)

    def solve(b: Array) -> Array:
        out = np.empty_like(b)
        out[order] = la.cho_solve_banded((factor, True), b[order], check_finite=False)
        return out

    return Factor(solve, "banded")


def _iterative(matrix: sp.csc_array) -> Factor:
    """Conjugate gradients with a Jacobi preconditioner: slow under a weak gauge, but needs no memory."""
    inverse = 1.0 / matrix.diagonal()
    shape = matrix.shape

    def solve(b: Array) -> Array:
        columns = b.reshape(len(b), -1)
        out = np.empty_like(columns)
        for i, column in enumerate(columns.T):
            operator = LinearOperator(shape, matvec=lambda x: inverse * x)
            out[:, i], info = cg(matrix, column, rtol=1e-10, maxiter=20 * len(b), M=operator)
            if info:
                raise AdjustError(
                    "the normal equations could not be solved: neither factorised nor by iteration"
                )
        return out.reshape(b.shape)

    return Factor(solve, "iterative")
