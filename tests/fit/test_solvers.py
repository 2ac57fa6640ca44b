"""The pieces of the solvers against their definitions."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.base.geodesy import Array
from barpc.fit.methods import corner
from barpc.fit.system import FitProblem, TriangularSystem, expected_size, noise_scaled, solution
from tests.fit.cameras import Camera, random_points

ALL = np.arange(20)


@pytest.fixture(scope="module")
def problem(camera: Camera) -> FitProblem:
    rng = np.random.default_rng(1)
    ground, image = random_points(camera, 1300, rng)
    return FitProblem(ground, image + rng.normal(0, 0.3, image.shape), camera.norm)


def dense(problem: FitProblem, axis: int, denominator: Array | None = None) -> Array:
    """The whole system (M | y) at once."""
    return np.concatenate([rows for _, rows in problem.rows(axis, denominator)])


@pytest.mark.parametrize("axis", [0, 1])
def test_the_compressed_system_is_the_system(camera: Camera, problem: FitProblem, axis: int) -> None:
    whole = dense(problem, axis, camera.rpc.coeffs[2 * axis + 1])
    system = problem.compressed(axis, camera.rpc.coeffs[2 * axis + 1])
    assert system.triangle.T @ system.triangle == pytest.approx(whole.T @ whole, abs=1e-9)
    x = np.linspace(-1, 1, 39)
    assert system.squares(x) == pytest.approx(((whole[:, :-1] @ x - whole[:, -1]) ** 2).sum())
    free = np.linalg.lstsq(whole[:, :-1], whole[:, -1], rcond=None)
    assert system.sigma == pytest.approx(np.sqrt(free[1][0] / (1300 - 39)))


def test_rows_are_the_papers_equation(camera: Camera, problem: FitProblem) -> None:
    """w (m(x), -y m'(x)) (a, b') = w y holds for the coefficients of the RPC that made the points."""
    exact = FitProblem(problem.ground, camera.rpc.project(problem.ground), problem.norm)
    for axis in (0, 1):
        numerator, denominator = camera.rpc.coeffs[2 * axis : 2 * axis + 2]
        for weight in (None, denominator):
            rows = dense(exact, axis, weight)
            assert rows[:, :-1] @ np.r_[numerator, denominator[1:]] == pytest.approx(rows[:, -1], abs=1e-12)


def test_the_penalised_solution_is_that_of_the_normal_equations(problem: FitProblem) -> None:
    whole = dense(problem, 0)
    penalty = np.r_[np.zeros(4), np.linspace(0.1, 3, 35)]
    matrix = whole[:, :-1]
    expected = np.linalg.solve(matrix.T @ matrix + np.diag(penalty**2), matrix.T @ whole[:, -1])
    assert solution(problem.compressed(0).penalized(penalty)) == pytest.approx(expected, abs=1e-9)


def test_the_penalty_follows_the_noise(camera: Camera, problem: FitProblem) -> None:
    system = problem.compressed(0, camera.rpc.coeffs[1])
    expected = expected_size(ALL)
    assert expected[:4].tolist() == [np.inf] * 4
    added, sigma = noise_scaled(system, expected)
    assert sigma * 10100 == pytest.approx(0.3, rel=0.05)
    more = added.triangle.T @ added.triangle - system.triangle.T @ system.triangle
    assert np.sqrt(np.diag(more)[20:23]) == pytest.approx(sigma / 0.003, rel=0.05)


def test_the_corner_of_the_l_curve_has_the_largest_curvature(problem: FitProblem) -> None:
    """Against the curvature of the sampled curve (log |M x - y|, log |x|)."""
    system = problem.compressed(0)
    h = corner([system])
    grid = h * np.exp(np.linspace(-0.4, 0.4, 401))
    curve = []
    for value in grid:
        x = np.linalg.lstsq(
            np.vstack([system.matrix, value * np.eye(39)]), np.r_[system.target, np.zeros(39)], rcond=None
        )[0]
        curve.append([0.5 * np.log(system.squares(x)), np.log(np.linalg.norm(x))])
    rho, eta = np.gradient(np.array(curve), np.log(grid), axis=0).T
    rho2, eta2 = np.gradient(rho, np.log(grid)), np.gradient(eta, np.log(grid))
    curvature = (rho * eta2 - rho2 * eta) / (rho**2 + eta**2) ** 1.5
    assert abs(np.log(grid[5 + np.argmax(curvature[5:-5])] / h)) <= 0.02


def test_a_corner_that_is_not_sharp_is_one() -> None:
    """Singular values from 1 to 0.001, of a curve whose curvature is at most 0.47: against the sampled curve."""
    s = np.geomspace(1.0, 1e-3, 5)
    triangle = np.zeros((6, 6))
    triangle[:5], triangle[5, 5] = np.column_stack([np.diag(s), s]), 1.0
    t = np.linspace(np.log(1e-3), 0.0, 20001)
    f = s**2 / (s**2 + np.exp(2 * t)[:, None])
    rho, eta = 0.5 * np.log((((1 - f) * s) ** 2).sum(axis=1) + 1.0), 0.5 * np.log((f**2).sum(axis=1))
    rho1, eta1 = np.gradient(rho, t), np.gradient(eta, t)
    rho2, eta2 = np.gradient(rho1, t), np.gradient(eta1, t)
    curvature = (rho1 * eta2 - rho2 * eta1) / (rho1**2 + eta1**2) ** 1.5
    best = 10 + int(np.argmax(curvature[10:-10]))
    assert curvature[best] == pytest.approx(0.47, abs=0.01)
    assert corner([TriangularSystem(triangle, 10)]) == pytest.approx(np.exp(t[best]), rel=0.01)


def test_without_a_corner_the_regularisation_is_the_least() -> None:
    """Of exact points whose L-curve is concave from the smallest singular value to the largest."""
    s, beta = np.array([0.4, 0.1]), np.array([0.05, 0.9])
    triangle = np.zeros((3, 3))
    triangle[:2] = np.column_stack([np.diag(s), beta])
    assert corner([TriangularSystem(triangle, 10)]) == pytest.approx(0.1)


def test_one_point_more_than_unknowns_tells_the_noise(problem: FitProblem) -> None:
    """The residual of 40 points and 39 unknowns has one degree of freedom, as that of fewer is taken to have."""
    few = FitProblem(problem.ground[:40], problem.image[:40], problem.norm)
    whole = dense(few, 0)
    residual = np.linalg.lstsq(whole[:, :-1], whole[:, -1], rcond=None)[1]
    assert few.compressed(0).sigma == pytest.approx(float(np.sqrt(residual[0])), rel=1e-3)


def test_weighted_by_its_own_denominator_the_residual_is_that_of_the_image(camera: Camera, problem: FitProblem) -> None:
    residual = camera.rpc.project(problem.ground) - problem.image
    for axis, scale in enumerate(camera.rpc.image_scale):
        both = camera.rpc.coeffs[2 * axis : 2 * axis + 2]
        squares = problem.compressed(axis, both[1]).squares(problem.packed(both)) * scale**2
        assert squares == pytest.approx((residual[:, axis] ** 2).sum())
