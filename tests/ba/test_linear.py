"""Every way to solve with the reduced matrix gives the same solution."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp

from barpc.ba import linear, normal, solve
from barpc.ba.structure import counting_sort
from barpc.errors import AdjustError
from tests.ba.conftest import solve as adjust


def _matrix(n: int = 120, width: int = 9) -> np.ndarray:
    rng = np.random.default_rng(0)
    lower = np.tril(np.triu(rng.normal(size=(n, n)), -width)) + 5 * np.eye(n)
    return lower @ lower.T


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_dense_banded_sparse_and_iterative_solutions_agree(monkeypatch, damping):
    dense = _matrix()
    matrix = sp.csr_array(dense)
    rhs = np.random.default_rng(1).normal(size=(120, 3))
    expected = np.linalg.solve(dense + damping * np.diag(dense.diagonal()), rhs)
    methods = {}
    methods["dense"] = linear.factorize(dense, damping)
    methods["banded"] = linear.factorize(matrix, damping)
    monkeypatch.setattr(linear, "BANDED_WORK", 0.0)
    methods["sparse"] = linear.factorize(matrix, damping)

    def fails(*_, **__):
        raise MemoryError

    monkeypatch.setattr(linear, "splu", fails)
    methods["iterative"] = linear.factorize(matrix, damping)
    for name, factor in methods.items():
        assert factor.method == name
        np.testing.assert_allclose(factor.solve(rhs), expected, rtol=1e-7, atol=1e-9)


def test_a_matrix_that_is_not_finite_is_an_adjust_error():
    with pytest.raises(AdjustError, match="not finite"):
        linear.factorize(np.full((3, 3), np.nan))


def test_a_large_block_is_solved_in_sparse_form_as_in_dense_form(block, adjusted, monkeypatch):
    monkeypatch.setattr(normal, "DENSE_UNKNOWNS", 0)
    sparse = adjust(block)
    assert sparse.covariance.factor.method == "banded"
    np.testing.assert_allclose(sparse.params, adjusted.params, atol=1e-4)
    np.testing.assert_allclose(sparse.gauge.sigma, adjusted.gauge.sigma, rtol=1e-4)


def test_a_failing_decomposition_inside_scipy_is_survived(block, adjusted, monkeypatch):
    def fails(*_, **__):
        raise la.LinAlgError("SVD did not converge")

    monkeypatch.setattr(solve, "least_squares", fails)
    found = adjust(block, solver="scipy")
    np.testing.assert_allclose(found.params, adjusted.params, atol=1e-4)


def test_counting_sorts_as_a_stable_sort_does():
    key = np.random.default_rng(0).integers(0, 40, 500)
    order, bounds = counting_sort(key, 41)
    np.testing.assert_array_equal(order, np.argsort(key, kind="stable"))
    np.testing.assert_array_equal(bounds, np.searchsorted(np.sort(key), np.arange(42)))
