"""Every way to solve with the reduced matrix gives the same solution."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg as la

from barpc.ba import Adjustment
from barpc.ba.solving import linear
from barpc.ba.solving.linear import Blocks
from barpc.ba.solving.structure import counting_sort, dissect
from barpc.base.errors import AdjustError
from barpc.simulate import SimulatedBlock, simulate_block
from tests.ba.conftest import solve as adjust


@pytest.fixture(scope="module")
def block() -> SimulatedBlock:
    """Four views, 300 tie points."""
    return simulate_block(4, 300, seed=11)


@pytest.fixture(scope="module")
def adjusted(block: SimulatedBlock) -> Adjustment:
    """`block`, adjusted."""
    return adjust(block)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_a_dense_matrix_is_damped_and_solved(damping):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(40, 40))
    matrix, rhs = root @ root.T + np.eye(40), rng.normal(size=(40, 3))
    expected = np.linalg.solve(matrix + damping * np.diag(matrix.diagonal()), rhs)
    factor = linear.factorize(matrix, damping)
    assert factor.method == "dense"
    np.testing.assert_allclose(factor.solve(rhs), expected, rtol=1e-9)


def test_nothing_is_solved_without_unknowns():
    assert linear.factorize(np.zeros((0, 0)), 0.0).solve(np.zeros((0, 2))).shape == (0, 2)


def test_a_matrix_that_is_not_finite_is_an_adjust_error():
    with pytest.raises(AdjustError, match="not finite"):
        linear.factorize(np.full((3, 3), np.nan), 0.0)
    pairs = np.zeros((0, 2), dtype=np.int64)
    blocks = Blocks(np.full((2, 3, 3), np.nan), np.zeros((0, 3, 3)), pairs)
    with pytest.raises(AdjustError, match="not finite"):
        linear.factorize_blocks(blocks, dissect(pairs, np.zeros((2, 2)), np.ones(2, dtype=bool)), 0.0)


def test_a_large_block_is_solved_in_sparse_form_as_in_dense_form(block, adjusted, sized):
    sized(dense_views=0)
    sparse = adjust(block)
    assert sparse.covariance.factor.method == "multifrontal"
    np.testing.assert_allclose(sparse.params, adjusted.params, atol=1e-4)
    np.testing.assert_allclose(sparse.gauge.sigma, adjusted.gauge.sigma, rtol=1e-4)


def test_what_a_large_block_does_not_keep_it_works_out_again(block, adjusted, sized):
    """Derivatives from one step to the next, and the terms of the smooth parts."""
    sized(products_kept=0)
    sized(terms_kept=0)
    found = adjust(block)
    np.testing.assert_allclose(found.params, adjusted.params, atol=1e-7)
    np.testing.assert_allclose(found.smooth.rms, adjusted.smooth.rms, atol=1e-9)
    np.testing.assert_array_equal(found.inlier, adjusted.inlier)


def test_a_failing_decomposition_inside_scipy_is_survived(block, adjusted, monkeypatch):
    def fails(*_, **__):
        raise la.LinAlgError("SVD did not converge")

    monkeypatch.setattr("scipy.optimize.least_squares", fails)
    found = adjust(block)
    np.testing.assert_allclose(found.params, adjusted.params, atol=1e-4)


def test_counting_sorts_as_a_stable_sort_does():
    key = np.random.default_rng(0).integers(0, 40, 500)
    order, bounds = counting_sort(key, 41)
    np.testing.assert_array_equal(order, np.argsort(key, kind="stable"))
    np.testing.assert_array_equal(bounds, np.searchsorted(np.sort(key), np.arange(42)))
