"""Known corrections come back: with noise, outliers, fixed views, GCPs, a DEM, at the ends of the Earth."""

from __future__ import annotations

from dataclasses import replace
from itertools import starmap

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks, check_residuals, split_points
from barpc.base.errors import BarpcWarning, DisconnectedError, InputError
from barpc.base.geodesy import ecef_from_ground, enu_basis, ground_from_ecef
from barpc.scene import Tracks
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.triangulation import triangulate
from barpc.simulate import simulate_block
from tests.ba.conftest import INDEPENDENT, centers_of, least_squares, of_noise_as_stated, solve
from tests.lanes import known, rest_slow

EVERY = {"hold_out": False}


def truth_sensors(block):
    return [Corrected(v.sensor, c) for v, c in zip(block.views, block.truth.corrections, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["sparse", "auto"])
def test_without_noise_the_held_out_points_are_met_to_a_millionth_of_a_pixel(solver):
    exact = simulate_block(6, 500, seed=2, noise=0.0)
    options = AdjustOptions(**{**INDEPENDENT, "sigma_attitude": 1e4, "sigma_position": 1e3}, drift=0, solver=solver)
    problem, found = least_squares(exact, options)
    assert exact.held_out_rms([v.sensor for v in exact.views]) > 1.0
    sensors = problem.cameras.unknowns.corrected(found.state.params, exact.views)
    assert exact.held_out_rms(list(sensors)) < 1e-5


@pytest.mark.slow
def test_an_adjusted_block_meets_held_out_points_to_a_fraction_of_the_noise(block, adjusted):
    assert block.held_out_rms([v.sensor for v in block.views]) > 1.0
    assert block.held_out_rms(list(adjusted.sensors)) < 0.1 * 0.1  # noise 0.1 px, thousands of points
    assert (adjusted.inlier | adjusted.held_out).mean() > 0.995
    assert adjusted.noise == pytest.approx(1.0, abs=0.03)


def test_reported_residuals_are_those_of_the_corrected_sensors(block, adjusted):
    for v, sensor in enumerate(adjusted.sensors):
        there = np.isfinite(adjusted.points[block.tracks.point, 0])
        assert there.mean() > 0.995
        rows = (block.tracks.view == v) & there
        ground = ground_from_ecef(adjusted.points[block.tracks.point[rows]])
        again = sensor.project(ground) - block.tracks.xy[rows]
        # a drift is asked for at the observed row, a residual away from the projected one
        atol = 1e-6 + 5e-5 * np.linalg.norm(again, axis=1, keepdims=True)
        assert (np.abs(adjusted.residuals[rows] - again) <= atol).all()


@pytest.fixture(scope="module")
def small():
    """Four views, 300 tie points."""
    return simulate_block(4, 300, seed=11)


ENDS = known("scipy's solver ends 3.3e-6 of the cost below the sparse one's tight minimum")
MODELS = ("rotation", "translation", "rotation+translation")


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "model"),
    [
        *rest_slow(pytest.param("small", model) for model in MODELS[::-1]),
        *(pytest.param("block", m, marks=pytest.mark.nightly) for m in MODELS if m != "translation"),
        pytest.param("block", "translation", marks=[pytest.mark.nightly, ENDS]),
    ],
)
def test_both_solvers_reach_the_same_minimum(request, size, model):
    block = request.getfixturevalue(size)
    first, second = (solve(block, **EVERY, model=model, solver=solver) for solver in ("auto", "sparse"))
    tight = solve(block, **EVERY, model=model, solver="sparse", tolerance=1e-14)
    assert first.cost_history[-1] == pytest.approx(tight.cost_history[-1], rel=1e-6)
    assert second.cost_history[-1] == pytest.approx(tight.cost_history[-1], rel=1e-6)
    np.testing.assert_allclose(first.params, tight.params, atol=2e-3 * np.abs(tight.params).max())


PLACES = [(5.4, 43.3), (5.0, 0.0), (0.0, 51.0), (90.0, 30.0), (180.0, 10.0), (30.0, 84.0)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("views", "tracks", "places"), [(4, 500, PLACES[4:]), pytest.param(10, 1500, PLACES, marks=pytest.mark.slow)]
)
def test_the_cost_is_optimal_wherever_on_earth_the_scene_lies(views, tracks, places):
    for lon, lat in places:
        there = simulate_block(views, tracks, seed=4, lon=lon, lat=lat)
        costs = [
            solve(there, **EVERY, solver="auto").cost_history[-1],
            solve(there, **EVERY, solver="sparse", tolerance=1e-14).cost_history[-1],
        ]
        assert costs[0] == pytest.approx(costs[1], rel=1e-6), (lon, lat)
        freedom = 2 * len(there.tracks) - 3 * tracks
        assert costs[0] == pytest.approx(freedom, rel=0.1), (lon, lat)


@pytest.mark.parametrize(
    ("size", "solver"),
    [("small", "auto"), *(pytest.param("block", solver, marks=pytest.mark.slow) for solver in ("auto", "sparse"))],
)
def test_an_adjustment_takes_few_linearisations_from_metres_away(request, size, solver):
    block = request.getfixturevalue(size)
    with of_noise_as_stated():
        found, tight = (solve(block, **EVERY, solver=solver, **more) for more in ({}, {"tolerance": 1e-14}))
    assert found.steps <= {"auto": 5, "sparse": 4}[solver]  # two passes: the second with priors that have learnt
    assert block.held_out_rms([v.sensor for v in block.views]) > 100 * block.held_out_rms(list(found.sensors))
    # not of costs, which rounding alone moves by a billionth
    apart = ((found.residuals - tight.residuals) ** 2).sum()
    assert apart < 1e-9 * (tight.residuals**2).sum()


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("views", "bounds"), [(3, {0.10: 1.15, 0.25: 1.60, 0.40: 2.00}), (10, {0.10: 1.15, 0.25: 1.50, 0.40: 2.00})]
)
def test_outliers_cost_little(views, bounds):
    rms = {part: [] for part in (0.0, *bounds)}
    for seed in range(1, 6):
        for part in rms:
            dirty = simulate_block(views, 3000, seed=seed, outliers=part)
            found = solve(dirty, drift=0, hold_out=False)
            rms[part].append(dirty.held_out_rms(list(found.sensors)))
            wrong = dirty.truth.outlier
            assert not wrong.any() or found.inlier[wrong].mean() < 0.03
    clean = np.sqrt(np.mean(np.square(rms[0.0])))
    for part, bound in bounds.items():
        assert np.sqrt(np.mean(np.square(rms[part]))) <= bound * clean, (part, rms)


@pytest.mark.slow
@pytest.mark.parametrize("seeds", rest_slow([(3,), (1, 2, 3)], mark=pytest.mark.nightly))
def test_drift_is_corrected_as_if_there_were_none(seeds):
    ratio, price = [], []
    for seed in seeds:
        still, drifting = (simulate_block(10, 3000, seed=seed, drift=d) for d in (0.0, 20e-6))
        with_drift = drifting.held_out_rms(list(solve(drifting).sensors))
        ratio.append(with_drift / still.held_out_rms(list(solve(still).sensors)))
        price.append(with_drift / still.held_out_rms(list(solve(still, drift=0).sensors)))
    assert np.mean(ratio) <= 1.12
    assert np.mean(price) <= 1.4  # three more unknowns a view cost a quarter, drift or not


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_where_no_drift_is_asked_for_no_spline_takes_its_place(seed):
    drifting = simulate_block(10, 3000, seed=seed, drift=20e-6)
    plain = solve(drifting, drift=0)
    assert drifting.held_out_rms(list(plain.sensors)) > 1.0
    assert plain.params.shape[1] == 6


@pytest.mark.slow
def test_a_drift_is_followed_where_the_model_has_one():
    drifting = simulate_block(4, 300, seed=1, drift=20e-6)
    plain, found = (solve(drifting, drift=drift, jitter="off", **EVERY) for drift in (0, 1))
    assert drifting.held_out_rms(list(plain.sensors)) > 1.0
    assert 0.005 < drifting.held_out_rms(list(found.sensors)) < 0.05


@pytest.mark.parametrize(
    ("model", "bound"),
    [
        ("affine", 0.02),
        *(pytest.param(*row, marks=pytest.mark.slow) for row in (("shift-drift", 0.03), ("shift", 0.04))),
    ],
)
def test_image_models_correct_what_they_can(model, bound):
    small = simulate_block(3, 1000, seed=6, size=(4000, 4000))
    found = solve(small, model=model, sigma_shift=30.0)
    assert small.held_out_rms(list(found.sensors)) < bound
    assert small.held_out_rms([v.sensor for v in small.views]) > 3 * small.held_out_rms(list(found.sensors))


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("tracks", "seeds"), rest_slow(starmap(pytest.param, [(50, range(3)), (50, range(3, 6)), (600, range(6))]))
)
def test_three_gcps_bring_the_scene_to_its_place(tracks, seeds):
    errors, sigmas = [], []
    for seed in seeds:
        triplet = simulate_block(3, tracks, seed=seed, num_gcps=3)
        gcps = replace(triplet.gcps, sigma=np.full((3, 3), 0.2))
        rng = np.random.default_rng(seed)
        enu = enu_basis(gcps.lonlatalt)
        moved = ecef_from_ground(gcps.lonlatalt) + np.einsum("gij,gi->gj", enu, rng.normal(0, 0.2, (3, 3)))
        gcps = replace(gcps, lonlatalt=ground_from_ecef(moved))
        found = adjust_tracks(
            triplet.views, triplet.tracks, AdjustOptions(**INDEPENDENT), gcps, centers=centers_of(triplet)
        )
        check = triplet.truth.check
        there = triangulate(list(found.sensors), check.view, check.point, check.xy)
        offset = there.points - ecef_from_ground(triplet.truth.check_ground)
        errors.append(np.abs(enu[0] @ offset.mean(axis=0)))
        sigmas.append(found.gauge.sigma)
        assert (found.gauge.sigma < [1.0, 1.0, 2.0]).all()
    assert (np.array(errors) < 2 * np.array(sigmas)).mean() > 0.8
    assert (np.array(errors) < 3.5 * np.array(sigmas)).all()
    assert 0.6 < np.sqrt(((np.array(errors) / np.array(sigmas)) ** 2).mean()) < 1.3


@pytest.mark.slow
def test_check_points_stay_out_of_the_solve_and_measure_it():
    triplet = simulate_block(3, 600, seed=2, num_gcps=12)
    control, check = split_points(triplet.gcps, triplet.gcps.names[6:])
    centers = centers_of(triplet)
    found = adjust_tracks(triplet.views, triplet.tracks, AdjustOptions(**INDEPENDENT), control, centers=centers)
    before = check_residuals([view.sensor for view in triplet.views], check).rms()
    after = check_residuals(found.sensors, check).rms()
    assert (before[0] > 1.0).all()
    assert (after[0] < 0.4).all()
    assert (after[1] < 1.0).all()
    exact = check_residuals(truth_sensors(triplet), triplet.gcps).rms()
    assert (exact[0] < 0.15).all()
    with pytest.raises(InputError, match="named nobody"):
        split_points(triplet.gcps, ["nobody"])


def test_a_check_point_in_one_view_has_no_place_on_the_ground():
    one = simulate_block(1, 0, seed=3, num_gcps=3, num_checks=0)
    found = check_residuals(truth_sensors(one), one.gcps)
    assert np.isnan(found.ground).all()
    assert np.isnan(found.rms()[1]).all()
    assert (found.rms()[0] < 0.3).all()


def test_a_single_view_is_refined_by_gcps_alone():
    one = simulate_block(1, 0, seed=3, num_gcps=12, num_checks=0)
    found = adjust_tracks(one.views, one.tracks, AdjustOptions(**INDEPENDENT), one.gcps, centers=centers_of(one))
    truth = truth_sensors(one)[0]
    image = np.random.default_rng(0).uniform(0, 19999, (50, 2))
    ground = truth.localize(image, np.full(50, 300.0))
    before = np.abs(one.views[0].sensor.project(ground) - image).max()
    assert np.sqrt(((found.sensors[0].project(ground) - image) ** 2).mean()) < 0.2
    assert before > 3.0
    assert np.abs(found.gcp_residuals).max() < 0.5


@pytest.mark.parametrize("count", [1, 2, 3])
def test_one_to_three_gcps_tell_a_view_what_they_can_and_priors_the_rest(count):
    """Its errors all over the image are as large as its covariance says, and it is met at the points themselves."""
    z, at_points = [], []
    options = AdjustOptions(**{**INDEPENDENT, "drift": 0})
    for seed in range(12):
        one = simulate_block(1, 0, seed=seed, num_gcps=12, num_checks=0)
        gcps = one.gcps.select(np.arange(12) < count)
        gcps = replace(gcps, sigma=np.full(gcps.sigma.shape, 0.1))  # they are exact
        found = adjust_tracks(one.views, one.tracks, options, gcps, centers=centers_of(one))
        truth, unknowns = truth_sensors(one)[0], found.cameras.unknowns
        image = np.random.default_rng(seed).uniform(0, 19999, (20, 2))
        ground = truth.localize(image, np.full(20, 300.0))
        off = (found.sensors[0].project(ground) - image).ravel()
        steps = 1e-3 * np.eye(found.params.shape[1])
        moved = [unknowns.corrected(found.params + step, one.views)[0].project(ground).ravel() for step in steps]
        jacobian = (np.array(moved) - found.sensors[0].project(ground).ravel()).T / 1e-3
        sigma = np.sqrt(np.einsum("ij,jk,ik->i", jacobian, found.covariance.view(0), jacobian))
        z.append(np.sqrt(np.mean((off / sigma) ** 2)))
        at_points.append(np.abs(truth.project(gcps.lonlatalt) - found.sensors[0].project(gcps.lonlatalt)).max())
    assert 0.4 < np.sqrt(np.mean(np.square(z))) < 1.3  # what is learnt of priors by so few is rather too wide
    assert max(z) < 3.5
    assert np.median(at_points) < 0.5


@pytest.mark.slow
def test_a_dem_holds_the_height_of_the_scene():
    block = simulate_block(3, 600, seed=8, alt_range=(200.0, 201.0))
    options = AdjustOptions(**{**INDEPENDENT, "dem_sigma": 2.0, "dem_bias_sigma": 0.3})
    free = solve(block)
    level = lambda lon, lat: np.full(len(lon), 200.5)  # noqa: E731
    held = adjust_tracks(block.views, block.tracks, options, dem=level, centers=centers_of(block))
    truth = ecef_from_ground(block.truth.ground)
    up = enu_basis(block.truth.ground)[0, 2]
    error = [abs(np.nanmean((found.points - truth) @ up)) for found in (free, held)]
    assert error[1] < 0.2 < error[0]
    assert held.gauge.sigma[2] < 0.5 < free.gauge.sigma[2]


@pytest.mark.filterwarnings("ignore:.*constrained in height")
@pytest.mark.parametrize("count", [1, 5])
def test_groups_without_common_tie_points_are_named(block, count):
    """What some views and the others see of a track are two."""
    _, point = np.unique(2 * block.tracks.point + (block.tracks.view < count), return_inverse=True)
    split = replace(block.tracks, point=point)
    with pytest.raises(DisconnectedError) as caught:
        adjust_tracks(block.views, split, centers=centers_of(block))
    assert sorted(len(group) for group in caught.value.groups) == [count, 10 - count]
    options = AdjustOptions(min_convergence=0.01)
    with pytest.warns(BarpcWarning, match="keep their cameras"):
        found = adjust_tracks(block.views, split, options, centers=centers_of(block), keep_largest=True)
    assert len(found.left_out) == count
    left = np.isin(found.names, found.left_out)
    assert np.abs(found.params[left]).max() < 1e-9
    assert not found.inlier[left[split.view]].any()
    assert np.abs(found.params[~left]).max() > 0.1  # the others go on


def test_contradictions_are_refused(block):
    tracks = block.tracks
    twice = Tracks(
        np.append(tracks.view, tracks.view[-1]), np.append(tracks.point, tracks.point[-1]),
        np.vstack([tracks.xy, tracks.xy[-1:]]), np.append(tracks.sigma, 0.1),
    )  # fmt: skip
    with pytest.raises(InputError, match="twice"):
        adjust_tracks(block.views, twice, centers=centers_of(block))
    alike = replace(block.views[1], name=block.views[0].name)
    with pytest.raises(InputError, match="two views have the same name"):
        adjust_tracks((block.views[0], alike, *block.views[2:]), tracks, centers=centers_of(block))
    with pytest.raises(InputError, match="no view is named"):
        adjust_tracks(block.views, tracks, AdjustOptions(fixed=("nobody",)), centers=centers_of(block))


def test_rows_of_tracks_may_come_in_any_order(block, adjusted):
    tracks = block.tracks
    order = np.random.default_rng(0).permutation(len(tracks))
    mixed = Tracks(tracks.view[order], tracks.point[order], tracks.xy[order], tracks.sigma[order])
    found = adjust_tracks(block.views, mixed, AdjustOptions(**INDEPENDENT), centers=centers_of(block))
    np.testing.assert_allclose(found.params, adjusted.params, atol=1e-4)
    np.testing.assert_allclose(found.residuals, adjusted.residuals[order], atol=1e-4)
    np.testing.assert_array_equal(found.held_out, adjusted.held_out[order])


@pytest.mark.slow
@pytest.mark.parametrize("size", ["small", pytest.param("block", marks=pytest.mark.slow)])
def test_centers_are_regressed_where_none_are_given(request, size):
    block = request.getfixturevalue(size)
    adjusted = solve(block)
    found = adjust_tracks(block.views, block.tracks, AdjustOptions(**INDEPENDENT))
    for mine, theirs in zip(found.corrections, block.truth.corrections, strict=True):
        assert isinstance(mine, Correction)
        assert np.linalg.norm(mine.center - theirs.center) < 0.03 * 694e3
    assert block.held_out_rms(list(found.sensors)) < 1.2 * block.held_out_rms(list(adjusted.sensors))
