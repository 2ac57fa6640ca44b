"""The small matrices of points, and from which size on a block is worked on otherwise."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import AdjustOptions
from barpc.ba.constraints.block import join, make_problem
from barpc.ba.solving.covariance import Covariance
from barpc.ba.solving.linear import Blocks, Factor
from barpc.ba.solving.normal import (
    TRIANGLE,
    Common,
    Reduced,
    cholesky3,
    point_products,
    solve_lower,
    solve_transposed,
    whiten,
)
from barpc.base.geodesy import ecef_from_ground
from barpc.simulate import simulate_block
from tests.ba.conftest import centers_of


def whole(lower: np.ndarray) -> np.ndarray:
    """Factors (6, P) as matrices (P, 3, 3)."""
    out = np.zeros((lower.shape[1], 3, 3))
    for element, (i, j) in zip(lower, TRIANGLE, strict=True):
        out[:, i, j] = element
    return out


@pytest.fixture(scope="module")
def points() -> tuple[np.ndarray, np.ndarray]:
    """Matrices (7, 3, 3) and their elements."""
    root = np.random.default_rng(0).normal(size=(7, 3, 3))
    matrix = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)
    return matrix, np.array([matrix[:, i, j] for i, j in TRIANGLE])


def test_factors_of_points_are_those_of_numpy(points) -> None:
    matrix, elements = points
    np.testing.assert_allclose(whole(cholesky3(elements)), np.linalg.cholesky(matrix), rtol=1e-10)


def test_points_are_solved_and_whitened_by_their_factors(points) -> None:
    matrix, elements = points
    lower, rng = cholesky3(elements), np.random.default_rng(1)
    factor, rhs = np.linalg.cholesky(matrix), rng.normal(size=(3, 7))
    np.testing.assert_allclose(solve_lower(lower, rhs).T, np.linalg.solve(factor, rhs.T[..., None])[..., 0])
    expected = np.linalg.solve(factor.transpose(0, 2, 1), rhs.T[..., None])[..., 0]
    np.testing.assert_allclose(solve_transposed(lower, rhs).T, expected)
    by_point = rng.normal(size=(2, 3, 7))
    expected = np.linalg.solve(factor, by_point.transpose(2, 1, 0)).transpose(2, 1, 0)
    np.testing.assert_allclose(whiten(by_point, lower), expected)


def test_products_of_an_observation_are_those_of_its_matrix() -> None:
    rng = np.random.default_rng(2)
    by_point, residual = rng.normal(size=(2, 3, 5)), rng.normal(size=(2, 5))
    found = point_products(by_point, residual)
    for k in range(5):
        matrix = by_point[..., k].T @ by_point[..., k]
        np.testing.assert_allclose(found[:6, k], [matrix[i, j] for i, j in TRIANGLE])
        np.testing.assert_allclose(found[6:, k], by_point[..., k].T @ residual[:, k])


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("size", "known"), [(0.0, False), (0.5e-12, False), (1e-9, True)])
def test_a_direction_without_information_is_that_of_a_metre(axis: int, size: float, known: bool) -> None:
    """Relative to what is known of the others: it stays where it is, and the others move as they would."""
    diagonal = np.full(3, 0.5)
    diagonal[axis] = size
    lower = whole(cholesky3(np.array([[diagonal[i] if i == j else 0.0] for i, j in TRIANGLE])))[0]
    expected = np.sqrt(np.where(diagonal > 1e-12, diagonal, 1.0))
    np.testing.assert_allclose(lower, np.diag(expected))
    assert (lower[axis, axis] == 1.0) != known


def test_a_ray_alone_leaves_its_own_direction_unknown() -> None:
    """Two observations along any axes: what they cannot tell has a factor of one."""
    by_point = np.random.default_rng(0).normal(size=(2, 3, 50))
    lower = whole(cholesky3(point_products(by_point, np.zeros((2, 50)))[:6]))
    np.testing.assert_array_equal(lower[:, 2, 2], 1.0)
    nothing = cholesky3(np.zeros((6, 1)))
    np.testing.assert_array_equal(whole(nothing)[0], np.eye(3))


# --- sizes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("in_common", [False, True])
@pytest.mark.parametrize("as_array", [False, True])
def test_the_blocks_of_views_are_those_on_the_diagonal_however_the_matrix_is_kept(
    as_array: bool, in_common: bool
) -> None:
    rng, (n, q) = np.random.default_rng(3), (4, 2)
    pairs = np.array([[0, 2], [1, 2], [2, 3]])
    matrix: Any = Blocks(rng.normal(size=(n, q, q)), rng.normal(size=(3, q, q)), pairs)
    by_camera, expected = rng.normal(size=(3, n * q)), matrix.plain()
    if in_common and not as_array:  # an array has lost it already
        expected = expected - by_camera.T @ by_camera
    none: Any = np.zeros(0)
    common = Common(none, none, none, by_camera, none) if in_common else None
    structure: Any = SimpleNamespace(num_views=n)
    kept = matrix.plain() if as_array else matrix
    reduced = Reduced(structure, kept, none, 0.0, 0.0, none, none, np.zeros((1, 3, q)), common)
    np.testing.assert_allclose(
        reduced.of_views(), [expected[k : k + q, k : k + q] for k in range(0, n * q, q)], atol=1e-14
    )


@pytest.mark.parametrize(("views", "plain"), [(32, True), (33, False)])
def test_a_matrix_of_what_is_one_front_anyway_is_an_array(views: int, plain: bool) -> None:
    made = simulate_block(views, 12 * views, seed=1, num_checks=0)
    block = join(made.views, made.tracks, None, AdjustOptions())
    problem = make_problem(block, AdjustOptions(), centers_of(made), None)
    matrix = problem.reduce(problem.camera_prior.mean, ecef_from_ground(made.truth.ground), 1.0 / block.sigma).matrix
    assert isinstance(matrix, np.ndarray) == plain
    assert isinstance(matrix, Blocks) != plain


def covariance(n: int, blocks: Any = None) -> Covariance:
    reduced: Any = SimpleNamespace(cross=np.zeros((1, 3, 1)))
    return Covariance(reduced, Factor(lambda b: 2.0 * b, "multifrontal", blocks), np.ones(n, dtype=bool))


@pytest.mark.parametrize(("n", "large"), [(900, False), (901, True)])
def test_a_block_of_more_than_nine_hundred_unknowns_is_large(n: int, large: bool) -> None:
    assert covariance(n).is_large == large


@pytest.mark.parametrize(("n", "kept"), [(900, True), (901, False)])
def test_the_whole_matrix_is_kept_up_to_nine_hundred_unknowns(n: int, kept: bool) -> None:
    near = Blocks(np.full((n, 1, 1), 2.0), np.zeros((0, 1, 1)), np.zeros((0, 2), dtype=int))
    found = covariance(n, lambda: near)
    np.testing.assert_array_equal(found.joint(np.array([5, 3])), 2.0 * np.eye(2))
    assert ("full" in found.__dict__) == kept
