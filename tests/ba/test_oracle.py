"""The solver's reduced system, covariance and gauge against the whole problem written plainly and solved densely."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.linalg as la

from barpc.ba import AdjustOptions, adjust_tracks, block_prior
from barpc.ba.constraints.block import join, make_problem
from barpc.ba.constraints.gauge import MOTIONS, datum_shares, gauge_report, weakest_modes
from barpc.ba.constraints.ground import PointConstraints, convergence_angles, ground_control
from barpc.ba.control.snooping import image_test
from barpc.ba.robust.weights import Observations
from barpc.ba.solving.covariance import Covariance
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import Minimum, State, WhitenedProblem, camera_step, gauss_newton
from barpc.scene import GroundPoints
from barpc.simulate import simulate_block
from tests.ba.conftest import Held, centers_of, held_by
from tests.ba.oracle import Plain, ecef_of, enu_of, ground_of
from tests.constants import chosen
from tests.lanes import diagonal, rest_slow

SIGMAS = {"sigma_attitude": 7.0, "sigma_position": 2.0}
EAST, NORTH = 0.3, -0.2  # slopes of the terrain


@dataclass
class Case:
    """One block twice: as the solver holds it, and plainly; and a state that is not the minimum."""

    problem: Problem
    plain: Plain
    params: np.ndarray
    points: np.ndarray
    weight: np.ndarray

    @property
    def reduced(self) -> Any:
        return self.problem.reduce(self.params, self.points, self.weight)

    @property
    def state(self) -> State:
        return State(self.params, self.points)

    @property
    def covariance(self) -> Covariance:
        return Minimum(self.state, self.reduced).covariance(self.problem.free)

    @cached_property
    def dense(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Normal matrix, gradient and cost of the whole."""
        jacobian, residual = (f(self.params, self.points) for f in (self.plain.jacobian, self.plain.residual))
        return jacobian.T @ jacobian, jacobian.T @ residual, float(residual @ residual)


def _terrain(origin: np.ndarray, alt: float):
    """A plane of constant slope east and north [m/m] through an origin, as a function of lon, lat."""
    frame = enu_of(*origin[:2])
    unit = [frame @ (ecef_of(origin + step) - ecef_of(origin - step)) / 2e-4
            for step in np.eye(3)[:2] * 1e-4]  # fmt: skip
    east, north = unit[0][0], unit[1][1]  # m a degree
    return lambda lon, lat: alt + EAST * east * (lon - origin[0]) + NORTH * north * (lat - origin[1])


def make_case(drift: int = 0, fixed: tuple[str, ...] = ()) -> Case:
    made = simulate_block(4, 10, seed=7, num_gcps=2, noise=0.3)
    sharp = {name: np.where(one.view == 1, 3.0, 1.0) for name, one in (("ties", made.tracks), ("gcps", made.gcps))}
    gcps = replace(made.gcps, sigma=np.array([[0.1, 0.5, 2.0], [3.0, 0.2, 0.7]]))
    gcps = replace(gcps, xy_sigma=gcps.xy_sigma / sharp["gcps"])
    options = AdjustOptions(drift=drift, fixed=fixed, **SIGMAS)
    centers, tracks = centers_of(made), replace(made.tracks, sigma=made.tracks.sigma / sharp["ties"])
    with chosen(AdjustOptions, min_observations=1, sigma_drift=3.0):
        block = join(made.views, tracks, gcps, options)
        problem = make_problem(block, options, centers, None)
    rng = np.random.default_rng(1)
    params = rng.normal(0, 3, (4, problem.cameras.unknowns.size))
    points = ecef_of(np.vstack([made.truth.ground, gcps.lonlatalt])) + rng.normal(0, 2, (12, 3))
    origin = made.truth.ground.mean(axis=0)
    terrain = _terrain(origin, 180.0)
    weak = np.zeros(12, dtype=bool)
    weak[[2, 5, 8]] = True
    control = ground_control(gcps, np.array([10, 11]))
    held = replace(options, dem_sigma=4.0, dem_bias_sigma=6.0)
    heights = PointConstraints((control,), weak, np.arange(10), (0.0, 500.0), held, terrain)
    problem = heights.hold(problem, points)

    def plane(p: int):
        """Height above the tangent plane of the terrain below where the point stands now."""
        lon, lat, _ = ground_of(points[p])
        foot = np.array([lon, lat, terrain(lon, lat)])
        return lambda x: np.array([-EAST, -NORTH, 1.0]) @ enu_of(lon, lat) @ (x - ecef_of(foot))

    feet = np.array([[*ground_of(points[p])[:2], 0.0] for p in (2, 5, 8)])
    feet[:, 2] = terrain(feet[:, 0], feet[:, 1])
    middle = ecef_of(feet).mean(axis=0)
    east_north = (ecef_of(feet) - middle) @ enu_of(*ground_of(middle)[:2])[:2].T
    design = 6.0 * np.column_stack([np.ones(3), east_north / np.abs(east_north).max(axis=0)])
    order = np.argsort(np.concatenate([tracks.view, gcps.view]), kind="stable")
    view = np.concatenate([tracks.view, gcps.view])[order]
    sigma = np.concatenate([tracks.sigma, gcps.xy_sigma])[order]
    camera_sigma = np.repeat([7.0, 2.0, *[3.0] * drift], 3) * np.ones((4, 1))
    plain = Plain(
        made.views,
        centers,
        drift,
        view,
        np.concatenate([tracks.point, 10 + gcps.point])[order],
        np.concatenate([tracks.xy, gcps.xy])[order],
        sigma,
        camera_sigma,
        [(10 + i, gcps.lonlatalt[i], gcps.sigma[i]) for i in range(2)],
        [(p, plane(p), 4.0) for p in (2, 5, 8)],
        design,
    )
    return Case(problem, plain, params, points, 1.0 / block.sigma)


@pytest.fixture(scope="module", params=rest_slow([2, 0]))
def case(request) -> Case:
    return make_case(request.param)


def _schur(matrix: np.ndarray, gradient: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Points eliminated densely."""
    pull = np.linalg.solve(matrix[size:, size:], matrix[size:, :size]).T
    return matrix[:size, :size] - pull @ matrix[size:, :size], gradient[:size] - pull @ gradient[size:]


def _assert_close(found: np.ndarray, expected: np.ndarray, rtol: float = 1e-5) -> None:
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=rtol * np.abs(expected).max())


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize("dense_views", [100, 0])
def test_the_reduced_system_is_the_schur_complement_of_the_whole_differenced_problem(case, sized, dense_views):
    sized(dense_views=dense_views)
    matrix, gradient, cost = case.dense
    size = case.params.size
    reduced = case.reduced
    expected, slope = _schur(matrix, gradient, size)
    everything = np.ones(size, dtype=bool)
    _assert_close(reduced.plain(everything), expected, 3e-5)
    solved = reduced.factor(everything).solve(slope)
    _assert_close(solved, np.linalg.solve(expected, slope), 1e-3)
    _assert_close(reduced.gradient, slope, 3e-5)
    assert reduced.cost == pytest.approx(cost, rel=1e-7)
    moved = np.linalg.solve(matrix[size:, size:], gradient[size:])
    assert reduced.gain == pytest.approx(gradient[size:] @ moved, rel=1e-5)


def test_pieces_of_any_size_make_the_same_system(case, sized):
    whole = case.reduced
    sized(observations_together=3)
    sized(points_together=5)
    pieces = case.reduced
    _assert_close(pieces.matrix, whole.matrix, 1e-12)
    _assert_close(pieces.gradient, whole.gradient, 1e-9)


def test_one_step_is_the_gauss_newton_step_of_the_whole(case):
    matrix, gradient, cost = case.dense
    whole = -np.linalg.solve(matrix, gradient)
    step, gain, _ = camera_step(case.problem, case.reduced)
    size = case.params.size
    _assert_close(step.ravel(), whole[:size], 1e-4)
    _assert_close(case.reduced.point_step(step).ravel(), whole[size:], 1e-4)
    assert gain == pytest.approx(-gradient @ whole, rel=1e-5)
    projected = case.problem.linearise(case.params, case.points)
    moved = gauss_newton(case.problem, case.state, case.weight, projected)
    assert projected.image.shape == (2, len(case.plain.view))
    _assert_close(moved.params - case.params, whole[:size].reshape(case.params.shape), 1e-4)
    assert moved.cost == pytest.approx(cost + gradient @ whole, rel=1e-5)


def test_what_scipy_sees_has_the_cost_the_gradient_and_the_matrix_of_the_reduced_problem(case):
    compressed = WhitenedProblem(case.problem, case.state, case.weight, None)
    size = case.params.size
    upper0 = la.cholesky(case.reduced.plain(np.ones(size, dtype=bool)))
    for x in (np.zeros(size), np.random.default_rng(3).normal(0, 0.5, size)):
        residual, jacobian = compressed.residual(x), compressed.jacobian(x)
        assert (residual.shape, jacobian.shape) == ((size + 1,), (size + 1, size))
        state = compressed.state
        np.testing.assert_allclose((state.params - case.params).ravel(), np.linalg.solve(upper0, x), atol=1e-9)
        there = case.problem.reduce(state.params, state.points, case.weight)
        assert state.cost == pytest.approx(there.cost, rel=1e-9)
        assert residual @ residual == pytest.approx(there.cost - there.gain, rel=1e-9)
        inverse = np.linalg.inv(upper0)
        _assert_close(jacobian.T @ residual, inverse.T @ there.gradient, 1e-6)
        matrix = there.plain(np.ones(size, dtype=bool))
        _assert_close(jacobian.T @ jacobian, inverse.T @ matrix @ inverse, 1e-6)
    evaluations = len(compressed.state.history)
    assert evaluations == 2  # asked twice at one place, linearised once
    compressed.at(x + 1e-3)
    assert len(compressed.state.history) == 3


def test_damping_adds_its_part_of_the_diagonal(case):
    matrix, gradient, _ = case.dense
    size = case.params.size
    expected, slope = _schur(matrix, gradient, size)
    step, _, _ = camera_step(case.problem, case.reduced, damping=0.4)
    wanted = -np.linalg.solve(expected + 0.4 * np.diag(np.diag(expected)), slope)
    _assert_close(step.ravel(), wanted, 1e-4)


@pytest.mark.slow
def test_fixed_views_do_not_move_and_have_no_variance():
    held = make_case(0, fixed=("view_0002",))
    matrix, gradient, _ = held.dense
    free = np.ones(len(matrix), dtype=bool)
    free[12:18] = False
    whole = np.zeros(len(matrix))
    whole[free] = -np.linalg.solve(matrix[np.ix_(free, free)], gradient[free])
    step, _, _ = camera_step(held.problem, held.reduced)
    _assert_close(step.ravel(), whole[:24], 1e-4)
    covariance = held.covariance
    inverse = np.zeros_like(matrix)
    inverse[np.ix_(free, free)] = np.linalg.inv(matrix[np.ix_(free, free)])
    _assert_close(covariance.full, inverse[:24, :24], 1e-4)
    assert not covariance.full[12:18].any()


def test_points_alone_take_the_gauss_newton_step_of_their_own_blocks(case):
    matrix, gradient, _ = case.dense
    size = case.params.size
    projected = case.problem.project_points(case.params, case.points)
    moved = case.problem.triangulate(case.points, projected, case.weight) - case.points
    expected = -np.linalg.solve(matrix[size:, size:], gradient[size:]).reshape(-1, 3)
    alone = np.setdiff1d(np.arange(12), [2, 5, 8])
    _assert_close(moved[alone], expected[alone], 1e-5)
    _assert_close(moved, expected, 0.05)  # the error that heights share is held in this step


def test_covariances_are_blocks_of_the_inverse_of_the_whole_put_together_of_any_number_of_columns(case, sized):
    inverse = np.linalg.inv(case.dense[0])
    size = case.params.size
    index = np.array([1, 5, 7, 8, 10])
    for p, found in zip(index, case.covariance.points(index), strict=True):
        place = size + 3 * p + np.arange(3)
        _assert_close(found, inverse[np.ix_(place, place)], 1e-4)
    for columns in (1, 5, size - 1, size, 1000):
        sized(columns_kept=columns * size, dense_views=0)
        full = case.covariance.full
        _assert_close(full, inverse[:size, :size], 1e-4)
        np.testing.assert_array_equal(full, full.T)


def test_a_residual_in_an_image_is_taken_in_units_of_its_own_deviation(case, sized):
    """Baarda's w against 1 - J (J^T J)^-1 J^T of the whole differenced problem; heights that share errors, too."""
    matrix, _, _ = case.dense
    jacobian = case.plain.jacobian(case.params, case.points)
    structure = case.problem.structure
    rows = np.flatnonzero(np.isin(structure.point, [2, 5, 6, 10, 11]))
    assert (np.bincount(structure.point[rows])[[2, 10]] > 1).all()
    residual = case.problem.residuals(case.params, case.points)
    covariance = case.covariance
    found = image_test(covariance, case.problem, case.state, residual, case.weight, rows)
    left = 1.0 - np.einsum("ki,ij,kj->k", jacobian, np.linalg.inv(matrix), jacobian)
    whitened = case.plain.residual(case.params, case.points)
    places = 2 * rows[:, None] + [0, 1]
    assert (left[places] < 0.99).any()  # or all would be residuals over what is stated
    np.testing.assert_allclose(found, (np.abs(whitened[places]) / np.sqrt(left[places])).max(axis=1), rtol=1e-4)
    sized(tests_kept=1)
    one_by_one = image_test(covariance, case.problem, case.state, residual, case.weight, rows)
    np.testing.assert_allclose(one_by_one, found, rtol=1e-9)


def test_modes_are_the_motions_the_weakest_first_and_what_goes_with_them():
    root = np.random.default_rng(4).normal(size=(7, 7))
    covariance = root @ root.T
    modes = weakest_modes(covariance)
    assert sorted(mode.meaning for mode in modes) == sorted(MOTIONS[:7])  # every one once
    assert [mode.sigma for mode in modes] == sorted((mode.sigma for mode in modes), reverse=True)
    drawn = np.random.default_rng(5).multivariate_normal(np.zeros(7), covariance, 200_000)
    for mode in modes:
        m = MOTIONS.index(mode.meaning)
        assert mode.sigma == pytest.approx(np.sqrt(covariance[m, m]))
        assert mode.motion[m] == pytest.approx(mode.sigma)
        off = np.abs(drawn[:, m] - mode.sigma) < 0.1 * mode.sigma  # what is seen of the others where it is off so
        np.testing.assert_allclose(drawn[off].mean(axis=0), mode.motion, atol=0.1 * np.sqrt(np.diag(covariance)).max())
    still = weakest_modes(np.zeros((7, 7)))  # nothing may move
    assert [mode.sigma for mode in still] == [0.0] * 7
    assert not any(mode.motion.any() for mode in still)
    assert weakest_modes(np.diag([0.0] * 6 + [-1e-18]))[-1].sigma == 0.0  # less than nothing is rounding


@pytest.mark.parametrize("dense_views", [100, 0])
@pytest.mark.parametrize("small", [0, 900])
def test_blocks_of_views_are_the_same_whether_the_whole_is_kept_or_not(case, sized, small, dense_views):
    sized(dense_unknowns=small, dense_views=dense_views)
    q = case.params.shape[1]
    inverse = np.linalg.inv(case.dense[0])
    fresh = case.covariance
    places = np.r_[2 * q : 3 * q, 0:q]  # in the order asked for
    for _ in range(2):
        _assert_close(fresh.joint(np.array([2, 0])), inverse[np.ix_(places, places)], 1e-4)
        _assert_close(fresh.view(2, 0), inverse[2 * q : 3 * q, :q], 1e-4)
        _assert_close(fresh.view(0, 2), inverse[:q, 2 * q : 3 * q], 1e-4)
        _assert_close(fresh.view(1), inverse[q : 2 * q, q : 2 * q], 1e-4)
        assert fresh.full.shape == (4 * q, 4 * q)  # from now on


def test_the_gauge_is_the_least_squares_motion_of_all_points_and_its_covariance(case):
    matrix, _, _ = case.dense
    size = case.params.size
    before = case.points + np.random.default_rng(2).normal(0, 1, case.points.shape)
    use = np.ones(len(case.points), dtype=bool)
    use[4] = False
    covariance = case.covariance
    report = gauge_report(covariance, case.points, before, use)
    index = np.flatnonzero(use)
    middle = case.points[index].mean(axis=0)
    lon, lat, _ = ground_of(middle)
    enu = enu_of(lon, lat)
    local = (case.points[index] - middle) @ enu.T
    radius = np.sqrt((local[:, :2] ** 2).sum(axis=1).mean())
    e, n = local[:, 0] / radius, local[:, 1] / radius
    zero, one = np.zeros(len(e)), np.ones(len(e))
    plane = np.column_stack([one, e, n])  # is in none of what bends: the scene's place and tilts stay what they are
    bends = [bend - plane @ (np.linalg.pinv(plane) @ bend) for bend in (e * n, e**2, n**2)]
    moves = np.stack([  # of every point, by one metre of each motion: counterclockwise turn, growth
        np.stack([one, zero, zero], 1), np.stack([zero, one, zero], 1), np.stack([zero, zero, one], 1),
        np.stack([zero, zero, e], 1), np.stack([zero, zero, n], 1), np.stack([-n, e, zero], 1),
        np.stack([e, n, zero], 1), *(np.stack([zero, zero, bend / np.ptp(bend)], 1) for bend in bends),
    ]).reshape(10, -1).T  # fmt: skip
    places = (size + 3 * index[:, None] + np.arange(3)).ravel()
    by_points = np.linalg.pinv(moves) @ np.kron(np.eye(len(index)), enu)
    expected = by_points @ np.linalg.inv(matrix)[np.ix_(places, places)] @ by_points.T
    np.testing.assert_allclose(report.motion_sigma, np.sqrt(np.diag(expected)), rtol=1e-4)
    np.testing.assert_allclose(report.sigma, report.motion_sigma[:3])
    assert report.radius == pytest.approx(radius, rel=1e-9)
    _assert_close(report.shift, enu @ (case.points - before)[index].mean(axis=0), 1e-6)
    rebuilt = np.zeros((10, 10))
    for mode in report.modes:
        m = MOTIONS.index(mode.meaning)
        rebuilt[m] = mode.sigma * mode.motion
        assert mode.sigma == report.motion_sigma[m]
    _assert_close(rebuilt, expected, 1e-4)


def test_a_sample_of_many_points_stands_for_the_scene_and_their_own_noise_averages_over_all(case, monkeypatch, sized):
    covariance = case.covariance
    before, use = case.points - [3.0, 0.0, 1.0] * (np.arange(12) == 7)[:, None], np.ones(12, dtype=bool)
    whole = gauge_report(covariance, case.points, before, use)
    sized(scene_points=11)
    assert gauge_report(covariance, case.points, before, use).radius != whole.radius  # every second
    sized(scene_points=3)
    some = gauge_report(covariance, case.points, before, use)
    monkeypatch.undo()
    sample = np.arange(12) % 4 == 0
    alone = gauge_report(covariance, case.points, before, sample)
    assert some.radius == pytest.approx(alone.radius)
    np.testing.assert_allclose(some.by_unknown, alone.by_unknown)
    assert np.linalg.norm(some.shift) == pytest.approx(np.linalg.norm(whole.shift), rel=1e-9)  # the mean of all
    assert np.linalg.norm(alone.shift) == pytest.approx(0.0, abs=1e-9)
    of_cameras = np.diag(some.by_unknown @ covariance.solve(some.by_unknown.T))
    own = [report.motion_sigma**2 - of_cameras for report in (some, alone)]
    still = 2  # heights share errors, whose part is no average
    np.testing.assert_allclose(own[0][:still], 0.25 * own[1][:still], rtol=0.02)


def test_a_joint_prior_of_an_earlier_block_adds_its_information():
    made = simulate_block(4, 60, seed=3)
    options = AdjustOptions(noise_floor=0.0, min_convergence=0.01, drift=0)
    centers = centers_of(made)
    old = made.tracks.select(made.tracks.view < 3)
    first = adjust_tracks(made.views[:3], old, options, centers=centers[:3])
    prior = block_prior(first)
    block = join(made.views, made.tracks, None, options)
    with_prior = make_problem(block, options, centers, prior)
    without = make_problem(block, options, centers, None)
    rng = np.random.default_rng(0)
    params = rng.normal(0, 2, (4, 6))
    points = ecef_of(made.truth.ground)
    weight = 1.0 / block.sigma
    a, b = (p.reduce(params, points, weight) for p in (with_prior, without))
    old_sigma = without.camera_prior.sigma[:3].ravel()
    offset = params[:3].ravel() - first.params.ravel()
    information = np.asarray(first.covariance.reduced.matrix)
    expected = np.zeros((24, 24))
    expected[:18, :18] = information - np.diag(1.0 / old_sigma**2)
    _assert_close(a.matrix - b.matrix, expected, 1e-8)
    slope = np.r_[information @ offset - params[:3].ravel() / old_sigma**2, np.zeros(6)]
    _assert_close(a.gradient - b.gradient, slope, 1e-8)
    cost = offset @ information @ offset - ((params[:3].ravel() / old_sigma) ** 2).sum()
    assert a.cost - b.cost == pytest.approx(cost, rel=1e-8)


def test_the_convergence_angle_of_two_views_is_the_angle_of_their_rays():
    made = simulate_block(3, 40, seed=1)
    options = AdjustOptions(drift=0)
    block = join(made.views, made.tracks, None, options)
    centers = centers_of(made)
    problem = make_problem(block, options, centers, None)
    points = ecef_of(made.truth.ground)
    projected = problem.project_points(np.zeros((3, 6)), points)
    found = convergence_angles(problem.structure, projected, points)
    for p in range(40):
        seen = made.tracks.view[made.tracks.point == p]
        ray = centers[seen] - points[p]
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        if len(seen) == 2:
            assert found[p] == pytest.approx(np.arccos(ray[0] @ ray[1]), rel=0.03)
        else:
            mean = ray.mean(axis=0) / np.linalg.norm(ray.mean(axis=0))
            away = np.arccos(np.clip(ray @ mean, -1, 1)).max()
            assert found[p] == pytest.approx(2 * away, rel=0.06)


@pytest.fixture(scope="module")
def observations() -> tuple[Observations, Any]:
    """Ten tracks and two GCPs, a noise floor."""
    made = simulate_block(3, 10, seed=4, num_gcps=2, visible=0.8)
    with chosen(AdjustOptions, min_observations=1) as options:
        block = join(made.views, made.tracks, made.gcps, options)
    problem = make_problem(block, options, centers_of(made), None)
    problem = replace(problem, point_prior=ground_control(made.gcps, np.array([10, 11])))
    return Observations(problem, block.sigma, 0.05, block.point < 10), block, problem


def test_a_track_has_three_degrees_of_freedom_less_than_coordinates(observations):
    counts, block, _ = observations
    freedom = counts.freedom(np.ones(len(block.view)))
    seen = np.bincount(block.point, minlength=12)
    assert {2, 3} <= set(seen[:10])
    for k, p in enumerate(block.point):
        expected = 2.0 if p >= 10 else (2 * seen[p] - 3) / seen[p]
        assert freedom[k] == pytest.approx(expected)
    # an observation that counts for nothing leaves a track of the others
    three = int(np.flatnonzero(seen[:10] == 3)[0])
    counted = np.ones(len(block.view))
    counted[np.flatnonzero(block.point == three)[0]] = 0.0
    np.testing.assert_allclose(counts.freedom(counted)[block.point == three], 0.5)


def test_squares_are_taken_of_residuals_in_sigmas_over_their_freedom(observations):
    counts, block, _ = observations
    residual = np.full((2, len(block.view)), 0.3)
    residual[:, 0] = np.nan
    s = counts.squared(residual, np.ones(len(block.view)))
    assert np.isinf(s[0])
    freedom = counts.freedom(np.ones(len(block.view)))
    np.testing.assert_allclose(s[1:], (0.18 / block.sigma**2 / freedom)[1:])


def test_an_observation_without_a_second_one_is_left_out_unless_a_prior_holds_its_point(observations):
    counts, block, _ = observations
    pair = int(np.flatnonzero(np.bincount(block.point)[:10] == 2)[0])
    use = np.ones(len(block.view), dtype=bool)
    one, other = np.flatnonzero(block.point == pair)
    use[one] = False
    gcp = np.flatnonzero(block.point == 10)
    use[gcp[1:]] = False
    tied = counts.tied(use)
    assert not tied[[one, other]].any()
    assert tied[gcp[0]]
    assert tied.sum() == use.sum() - 1


def test_residuals_of_gcps_point_from_the_given_to_the_adjusted_place():
    """A GCP given 5 m too far east, 3 m too far south and 8 m too low, loosely: it is found west, north, up."""
    made = simulate_block(3, 100, seed=2, num_gcps=4, attitude=0.0, position=0.0)
    true = made.gcps
    offset = np.array([5.0, -3.0, -8.0])
    wrong = np.array([ground_of(ecef_of(g) + enu_of(*g[:2]).T @ offset) for g in true.lonlatalt])
    gcps = GroundPoints(true.names, wrong, np.full((4, 3), 1e3), true.point, true.view, true.xy, true.xy_sigma)
    options = AdjustOptions(noise_floor=0.0, sigma_attitude=0.01, sigma_position=0.01, min_convergence=0.01)
    found = adjust_tracks(made.views, made.tracks, options, gcps, centers=centers_of(made))
    np.testing.assert_allclose(found.gcp_residuals, np.tile(-offset, (4, 1)), atol=1.0)


@pytest.mark.parametrize(
    ("strong", "spread", "alt", "sigma"),
    [
        (0, 0.0, 300.0, 200.0),  # none other tells: the middle of the range 100 to 500, its half
        (9, 400.0, 300.0, 200.0),
        (10, 0.0, 700.0, 50.0),  # the others' median, and never less than 50 m
        (10, 400.0, 700.0, 360.0),  # from their 5th to their 95th percentile
    ],
)
def test_weak_tracks_are_held_to_the_altitude_of_the_others(strong, spread, alt, sigma):
    lon, lat = np.linspace(5.0, 5.01, strong + 2), np.full(strong + 2, 43.0)
    altitudes = np.r_[700.0 + np.linspace(-0.5, 0.5, strong) * spread, -50.0, 2000.0]
    points = ecef_of(np.column_stack([lon, lat, altitudes]))
    weak = np.arange(strong + 2) >= strong
    heights = PointConstraints((), weak, np.arange(strong + 2), (100.0, 500.0), AdjustOptions(), None)
    prior = held_by(heights, points)
    assert prior.index.tolist() == [strong, strong + 1]
    np.testing.assert_allclose(prior.apart(points)[:, 0] * sigma, altitudes[-2:] - alt, atol=1e-6)
    assert not prior.residual(points)[:, 1:].any()
    none: Any = Held(prior)
    assert replace(heights, weak=np.zeros(strong + 2, dtype=bool)).hold(none, points).point_prior is None


def test_only_observations_of_known_points_are_looked_at_again_for_the_datum(case):
    covariance = case.covariance
    report = gauge_report(covariance, case.points, case.points, np.ones(12, dtype=bool))
    asked: list[Any] = []
    cameras: Any = SimpleNamespace(seeing=lambda xy: asked.append(xy.shape[1]) or case.problem.cameras.seeing(xy))
    given = covariance, report.by_unknown, replace(case.problem, cameras=cameras), case.state, case.weight
    shares = datum_shares(*given, (12, 12))
    assert not asked
    assert shares["gcps"].max() == shares["fixed_views"].max() == shares["reference"].max() == 0.0
    np.testing.assert_allclose(shares["cameras"] + shares["heights"], 1.0)
    datum_shares(*given, (11, 12))
    assert asked == [np.count_nonzero((case.problem.structure.point == 11) & (case.weight > 0))]


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize(("known", "fixed"), diagonal([12, 11], [(), (1,)]))  # the last point: a GCP, a reference's
def test_the_shares_of_the_datum_are_what_each_row_pays_of_the_cheapest_move(fixed, known):
    case = make_case(1, tuple(f"view_{v:04d}" for v in fixed))
    free = np.append(case.problem.free, np.ones(case.points.size, dtype=bool))
    matrix, _, _ = case.dense
    matrix = matrix[np.ix_(free, free)]
    jacobian = case.plain.jacobian(case.params, case.points)[:, free]
    size = int(case.problem.free.sum())
    use = np.ones(12, dtype=bool)
    covariance = case.covariance
    report = gauge_report(covariance, case.points, case.points, use)
    found = datum_shares(covariance, report.by_unknown, case.problem, case.state, case.weight, (10, known))

    middle = case.points.mean(axis=0)
    enu = enu_of(*ground_of(middle)[:2])
    e, n = ((case.points - middle) @ enu.T).T[:2] / report.radius
    zero, one = np.zeros(12), np.ones(12)
    moves = [[one, zero, zero], [zero, one, zero], [zero, zero, one], [zero, zero, e], [zero, zero, n]]
    moves = np.array([*moves, [-n, e, zero], [e, n, zero]]).transpose(0, 2, 1).reshape(7, -1).T
    by_points = np.linalg.pinv(moves) @ np.kron(np.eye(12), enu)
    follow = -np.linalg.solve(matrix[size:, size:], matrix[size:, :size])
    by_camera = by_points @ follow
    left = matrix[:size, :size] + matrix[:size, size:] @ follow
    cheapest = np.linalg.solve(left, by_camera.T)
    cheapest /= np.sqrt((by_camera.T * cheapest).sum(axis=0))
    paid = (jacobian @ np.vstack([cheapest, follow @ cheapest])) ** 2
    view, point = np.repeat(case.plain.view, 2), np.repeat(case.plain.point, 2)
    seen, ends = len(view), np.cumsum([len(view), case.params.size, 6, 3])
    of_gcps, of_reference = (point >= 10) & (point < known), point >= known
    middle = ends[1] + 3 * (known - 10)
    kept = np.isin(view, fixed)
    expected = {
        "fixed_views": paid[:seen][(point < 10) & kept].sum(axis=0),
        "cameras": paid[ends[0] : ends[1]].sum(axis=0),
        "gcps": paid[:seen][of_gcps].sum(axis=0) + paid[ends[1] : middle].sum(axis=0),
        "reference": paid[:seen][of_reference].sum(axis=0) + paid[middle : ends[2]].sum(axis=0),
        "heights": paid[ends[2] : ends[3]].sum(axis=0),
        "earlier_run": np.zeros(7),
        "altimetry": np.zeros(7),
    }
    assert set(found) == set(expected)
    for source, cost in expected.items():  # of what the ties between free views do not pay
        shares = cost / sum(expected.values())
        np.testing.assert_allclose(found[source][:7], shares, atol=1e-4, err_msg=source)
    np.testing.assert_allclose(sum(found.values()), 1.0, rtol=1e-6)
    assert found["fixed_views" if fixed else "cameras"].max() > 0.01
    assert found["heights"][2] > 0.001
    assert found["gcps"][:3].max() > 0.05
