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


def test_the_iteration_knows_that_unknowns_have_sizes_of_their_own(monkeypatch):
    """Unknowns in metres beside such in micrometres: a hundred steps of twenty a number are plenty."""
    monkeypatch.setattr(linear, "BANDED_WORK", 0.0)
    scale = np.geomspace(1e-4, 1e4, 60)
    dense = _matrix(60) * scale[:, None] * scale

    def fails(*_, **__):
        raise MemoryError

    monkeypatch.setattr(linear, "splu", fails)
    factor = linear.factorize(sp.csr_array(dense))
    assert factor.method == "iterative"
    rhs = np.random.default_rng(1).normal(size=(60, 2)) * scale[:, None]
    steps = []
    cg = linear.cg
    monkeypatch.setattr(linear, "cg", lambda *given, **options: cg(*given, callback=steps.append, **options))
    found = factor.solve(rhs)
    np.testing.assert_allclose(
        found * scale[:, None], np.linalg.solve(dense, rhs) * scale[:, None], rtol=1e-6
    )
    assert len(steps) < 2 * 60
    assert factor.solve(rhs[:, 0]).shape == (60,)
    hopeless = sp.csr_array(np.diag([1.0, -1.0, 2.0, -2.0]))  # no cost falls
    monkeypatch.setattr(linear, "cg", lambda matrix, b, **options: (b, 1))
    with pytest.raises(AdjustError, match="neither factorised nor by iteration"):
        linear._iterative(sp.csc_array(hopeless)).solve(np.ones(4))


@pytest.mark.parametrize(("less_than", "method"), [(0.9, "sparse"), (1.1, "banded")])
def test_a_band_is_taken_where_its_work_is_bounded(monkeypatch, less_than, method):
    """Twelve numbers, three beside the diagonal: 12 * 3^2 products."""
    dense = sp.csr_array(np.triu(np.tril(_matrix(12, 3), 3), -3) + 50 * np.eye(12))
    monkeypatch.setattr(linear, "BANDED_WORK", 12 * 9 * less_than)
    factor = linear.factorize(dense)
    assert factor.method == method
    rhs = np.arange(12.0)
    np.testing.assert_allclose(factor.solve(rhs), np.linalg.solve(dense.toarray(), rhs), rtol=1e-10)


def test_rows_taken_off_are_taken_off(monkeypatch):
    """Woodbury's formula, for every way to solve."""
    dense, rng = _matrix(40, 4), np.random.default_rng(3)
    less = 0.3 * rng.normal(size=(3, 40))
    expected = np.linalg.inv(dense - less.T @ less)
    for matrix in (dense, sp.csr_array(dense)):
        factor = linear.factorize(matrix, 0.0, less)
        np.testing.assert_allclose(factor.solve(np.eye(40)), expected, atol=1e-9)
        np.testing.assert_allclose(factor.solve(np.ones(40)), expected @ np.ones(40), atol=1e-9)
    damped = linear.factorize(dense, 0.2, less).solve(np.eye(40))
    np.testing.assert_allclose(
        damped, np.linalg.inv(dense + 0.2 * np.diag(dense.diagonal()) - less.T @ less), atol=1e-9
    )


def test_nothing_is_solved_without_unknowns():
    assert linear.factorize(np.zeros((0, 0))).solve(np.zeros((0, 2))).shape == (0, 2)


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
