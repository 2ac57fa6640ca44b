"""One truth for position: a move is what cameras did, a motion has one figure, and adding takes nothing away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks, block_prior
from barpc.ba.constraints.gauge import MOTIONS
from barpc.ba.constraints.incremental import BlockPrior
from barpc.base.geodesy import enu_basis, metres_per_unit
from barpc.base.options import RunOptions
from barpc.fit import fit_rpc
from barpc.report import Run, summarize
from barpc.report.records import json_form
from barpc.sensor.triangulation import triangulate
from barpc.simulate import SimulatedBlock, simulate_block
from tests.ba.conftest import centers_of, seen
from tests.ba.test_uncertainty import _divided
from tests.lanes import rest_slow


def right_cameras(num_tracks: int, num_gcps: int) -> SimulatedBlock:
    """A block whose delivered cameras are right, with few tie points."""
    block = simulate_block(3, max(num_tracks, 40), seed=3, num_gcps=num_gcps)
    sensors = [view.sensor for view in block.views]
    tracks = block.tracks.select(block.tracks.point < num_tracks)
    gcps = seen(block.gcps, block.gcps.lonlatalt, sensors, 2)
    return replace(block, tracks=seen(tracks, block.truth.ground, sensors, 1), gcps=gcps)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [(300.0, 0.0, 0.0), (0.0, 0.0, 500.0)])
def test_a_gcp_that_is_rejected_moves_no_scene(wrong: tuple[float, ...]) -> None:
    """Its place was given and then found: that is no move of what the cameras show (-27.8 m up was said)."""
    block = right_cameras(12, 4)
    places = block.gcps.lonlatalt.copy()
    places[1] += np.array(wrong) / metres_per_unit(places[1])
    gcps = replace(block.gcps, lonlatalt=places)
    found = adjust_tracks(block.views, block.tracks, AdjustOptions(), gcps, centers=centers_of(block))
    assert found.control is not None
    assert found.control.used.tolist() == [True, False, True, True]
    assert np.abs(found.gauge.shift).max() < 0.2


@pytest.mark.slow
def test_gcps_that_hold_the_scene_move_it_as_far_as_its_rays_meet_elsewhere() -> None:
    """Three in four points are GCPs, 40 m above where the cameras show them: the scene moved 40 m, not 10."""
    block = right_cameras(12, 36)
    gcps = replace(block.gcps, lonlatalt=block.gcps.lonlatalt + [0.0, 0.0, 40.0])
    found = adjust_tracks(block.views, block.tracks, AdjustOptions(), gcps, centers=centers_of(block))
    first, last = (
        triangulate(list(sensors), block.tracks.view, block.tracks.point, block.tracks.xy, alt=300.0).points
        for sensors in ([view.sensor for view in block.views], found.sensors)
    )
    moved = enu_basis(block.truth.ground[0]) @ np.nanmean((last - first)[:12], axis=0)
    assert moved[2] == pytest.approx(40.0, abs=1.0)
    np.testing.assert_allclose(found.gauge.shift, moved, atol=0.1)


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::barpc.BarpcWarning")
@pytest.mark.parametrize("wrong", rest_slow([0.1, 0.0]))
def test_two_images_with_one_rpc_have_no_height_to_move(wrong: float) -> None:
    """Their rays meet nowhere: what the cameras do to heights of hundreds of metres a pixel is no move."""
    block = simulate_block(2, 100, seed=1, per_site=2)
    sensor = block.views[0].sensor
    tracks = seen(block.tracks, block.truth.ground, [sensor, sensor], 1, 0.1)
    xy, rng = tracks.xy + np.where(tracks.view[:, None] == 1, [40.0, 300.0], 0.0), np.random.default_rng(2)
    bad = rng.uniform(size=len(xy)) < wrong
    xy[bad] += rng.uniform(-30.0, 30.0, (int(bad.sum()), 2))
    views = (block.views[0], replace(block.views[1], sensor=sensor))
    found = adjust_tracks(views, replace(tracks, xy=xy), AdjustOptions())
    assert found.held.any()
    # both go half of the way, towards each other: the places between them stay
    assert np.abs(found.gauge.shift).max() < 1.0


@pytest.mark.slow
def test_list_table_verdict_and_summary_say_one_figure_of_a_motion() -> None:
    block = simulate_block(3, 100, seed=3, num_gcps=1)
    found = adjust_tracks(block.views, block.tracks, AdjustOptions(), block.gcps, centers=centers_of(block))
    run = Run("adjust", block.views, (), block.tracks, adjustment=found, gcps=block.gcps)
    scene = summarize(run).scene
    assert scene is not None
    table = {entry.part: entry.sigma_m for entry in scene.datum}
    assert {mode.meaning: mode.sigma_m for mode in scene.weakest_modes} == table
    assert [table[name] for name in MOTIONS[:3]] == list(scene.sigma_enu_m)
    for mode in scene.weakest_modes:
        assert mode.motion_m[MOTIONS.index(mode.meaning)] == pytest.approx(mode.sigma_m)


@pytest.mark.slow
def test_an_image_that_is_added_makes_no_motion_less_known(tmp_path) -> None:
    """Its ties with the one view that it resembles are another scene, which is tilted more easily."""
    block = simulate_block(4, 600, seed=4, per_site=4)
    centers, (old, new, _) = centers_of(block), _divided(block, 3)
    few = np.isin(new.view, (2, 3)) | np.isin(new.point, np.unique(new.point)[:8])
    first = adjust_tracks(block.views[:3], old, AdjustOptions(), centers=centers[:3])
    block_prior(first).save(tmp_path / "prior.npz")
    prior = BlockPrior.load(tmp_path / "prior.npz")
    both = adjust_tracks(block.views, new.select(few), AdjustOptions(), centers=centers, prior=prior)
    assert (both.gauge.motion_sigma <= first.gauge.motion_sigma).all()
    assert both.gauge.sigma[2] < 0.8 * first.gauge.sigma[2]  # and the image does tell
    assert sum(both.datum.values()) == pytest.approx(np.ones(10), abs=1e-6)
    # the move is the earlier scene's, by its own tie points
    one, other = (
        triangulate(list(sensors[:3]), old.view, old.point, old.xy, alt=300.0).points
        for sensors in (first.sensors, both.sensors)
    )
    kept = np.unique(old.point[first.inlier])
    moved = enu_basis(block.truth.ground[0]) @ (other - one)[kept].mean(axis=0)
    assert abs(moved[2]) > 5.0
    np.testing.assert_allclose(both.gauge.shift, moved, atol=0.02 * np.abs(moved).max())
    # a third run goes on with the same scene
    again = block_prior(both).scene
    assert again is not None
    np.testing.assert_array_equal(again.by_unknown[:, : first.params.size], block_prior(first).scene.by_unknown)
    assert not again.by_unknown[:, first.params.size :].any()


def stating(block: SimulatedBlock, sensors: list, accuracy: float) -> tuple:
    """The views with RPCs of sensors that state an accuracy [m]."""
    return tuple(
        replace(view, sensor=replace(fit_rpc(sensor, view.size, view.alt_range).rpc, err_bias=accuracy))
        for view, sensor in zip(block.views, sensors, strict=True)
    )


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("count", rest_slow([2, 4, 8]))
def test_adjusting_what_was_adjusted_makes_its_place_no_better_known(count: int) -> None:
    """Its errors are shared: n views that state what the place is known to are not n witnesses (36.6 -> 13.0 m)."""
    block = simulate_block(count, 100, seed=8, per_site=count)
    views, sigmas = block.views, []
    for _ in range(3):
        found = adjust_tracks(views, block.tracks, AdjustOptions(), centers=centers_of(block))
        sigmas.append(found.gauge.sigma)
        views = stating(block, list(found.sensors), float(np.sqrt((found.gauge.sigma[:2] ** 2).mean())))
    for again in sigmas[1:]:
        ratio = again / sigmas[0]
        assert (ratio > 0.95).all()
        assert (ratio < 1.1).all()  # nor worse


def test_accuracies_that_independent_errors_have_are_taken_as_they_are() -> None:
    """The same views, each off by what it states: their errors average."""
    block = simulate_block(4, 100, seed=8, per_site=4, attitude=7.5 / 694e3, position=7.5)
    views = tuple(replace(view, sensor=replace(view.sensor, err_bias=7.5)) for view in block.views)
    stated, silent = (
        adjust_tracks(given, block.tracks, AdjustOptions(), centers=centers_of(block)) for given in (views, block.views)
    )
    assert stated.prior.shared == 1.0
    np.testing.assert_array_equal(stated.params, silent.params)
    np.testing.assert_array_equal(stated.gauge.sigma, silent.gauge.sigma)


@pytest.mark.slow
def test_what_the_user_states_of_the_cameras_is_taken_as_stated() -> None:
    block = simulate_block(4, 100, seed=8, per_site=4, attitude=1e-9, position=1e-3)
    views = tuple(replace(view, sensor=replace(view.sensor, err_bias=7.5)) for view in block.views)
    given = AdjustOptions(sigma_attitude=7.5, sigma_position=7.5)
    found, of_file = (
        adjust_tracks(views, block.tracks, options, centers=centers_of(block)) for options in (given, AdjustOptions())
    )
    assert found.prior.shared == 1.0
    assert of_file.prior.shared > 1.2


@pytest.mark.slow
def test_accuracies_that_are_shared_are_in_the_summary() -> None:
    block = simulate_block(6, 100, seed=8, per_site=4)
    views = tuple(replace(view, sensor=replace(view.sensor, err_bias=40.0)) for view in block.views)
    found = adjust_tracks(views, block.tracks, AdjustOptions(), centers=centers_of(block))
    assert found.prior.shared > 1.2
    summary = summarize(Run("adjust", views, (), block.tracks, adjustment=found, options=RunOptions()))
    assert summary.scene.prior_shared == found.prior.shared
    assert json_form(summary)["scene"]["prior_shared"] == pytest.approx(found.prior.shared)


@pytest.mark.slow
def test_what_delivered_cameras_let_the_scene_be_off_by_is_what_it_is_off_by_held_or_not() -> None:
    """GCPs find where it was; the points that they hold do not make delivered cameras better."""
    off = []
    for seed in range(12):
        block = simulate_block(3, 300, seed=seed, num_gcps=5)
        free = adjust_tracks(block.views, block.tracks)
        held = adjust_tracks(block.views, block.tracks, None, block.gcps)
        if (
            max(held.prior.scale.max(), free.prior.scale.max()) == 1.0
        ):  # without control they are widened with more care
            np.testing.assert_allclose(held.gauge.delivered_sigma, free.gauge.delivered_sigma, rtol=0.1)
        off.append(held.gauge.shift / held.gauge.delivered_sigma)
    rms = np.sqrt(np.square(off).mean(axis=0))
    assert (rms > 0.5).all()
    assert (rms < 1.6).all()
