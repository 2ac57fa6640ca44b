"""Control points against each other: blunders are found and named, residuals are those of points left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.ba import adjust_tracks
from barpc.ba.snooping import CRITICAL
from barpc.geodesy import ecef_from_ground, enu_basis, metres_per_unit
from barpc.scene import GroundPoints
from barpc.sensor.geometry import triangulate
from benchmarks.referee import cases, judge, make
from tests.ba.test_referee import hills

SEEDS = (1, 2)


def scene_of(count: int, seed: int):
    return make(replace(cases()["5 GCPs"], gcps=count, seed=seed), hills)


def blundered(gcps: GroundPoints, wrong: dict[int, float], seed: int = 0) -> GroundPoints:
    """Some points moved by so many metres, in any direction."""
    place, rng = gcps.lonlatalt.copy(), np.random.default_rng(seed)
    for g, size in wrong.items():
        move = rng.normal(size=3) * [1.0, 1.0, 0.3]
        place[g] += size * move / np.linalg.norm(move) / metres_per_unit(place[g : g + 1])[0]
    return replace(gcps, lonlatalt=place)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("count", "wrong"), [(5, {1: 3.0}), (5, {2: 30.0}), (10, {1: 30.0, 4: 30.0, 7: 30.0}), (3, {0: 30.0})]
)
def test_what_is_wrong_is_found_named_and_left_out(count, wrong, seed):
    scene = scene_of(count, seed)
    found = adjust_tracks(scene.views, scene.tracks, None, blundered(scene.gcps, wrong, seed))
    tested = found.control
    assert np.flatnonzero(~tested.used).tolist() == sorted(wrong)
    for g, size in wrong.items():
        assert tested.status(g) == "rejected"
        assert np.linalg.norm(tested.residual[g]) == pytest.approx(
            size, abs=1.0
        )  # 0.3 m, and 0.3 px seen from afar
        assert tested.w[g] > CRITICAL
    assert np.nanmax(np.where(tested.used, tested.w, 0.0)) < CRITICAL
    moved = judge(scene, found.sensors).move
    assert (np.abs(moved) < 4 * found.gauge.sigma).all()


@pytest.mark.parametrize("seed", range(1, 7))
def test_points_that_hold_are_all_used(seed):
    scene = scene_of(8, seed)
    tested = adjust_tracks(scene.views, scene.tracks, None, scene.gcps).control
    assert tested.used.all()
    assert np.nanmax(tested.w) < CRITICAL
    assert (tested.redundancy >= 0).all()
    assert (tested.redundancy <= 1).all()


def test_a_residual_is_the_one_that_leaving_the_point_out_shows():
    scene = scene_of(6, 1)
    gcps = scene.gcps
    tested = adjust_tracks(scene.views, scene.tracks, None, gcps).control
    for g in range(6):
        rows = gcps.point == g
        if rows.sum() < 2:
            continue
        sigma = gcps.sigma.copy()
        sigma[g] = 1e5  # its rays count, its place does not
        without = adjust_tracks(scene.views, scene.tracks, None, replace(gcps, sigma=sigma))
        seen = triangulate(
            list(without.sensors), gcps.view[rows], np.zeros(rows.sum(), dtype=int), gcps.xy[rows], alt=900.0
        ).points[0]
        offset = enu_basis(gcps.lonlatalt[g]) @ (seen - ecef_from_ground(gcps.lonlatalt[g]))
        np.testing.assert_allclose(tested.residual[g], offset, atol=0.15)


def test_a_wrong_position_in_one_image_costs_the_point_and_not_the_scene():
    scene = scene_of(6, 2)
    gcps = scene.gcps
    xy = gcps.xy.copy()
    xy[np.flatnonzero(gcps.point == 1)[0]] += 40.0
    found = adjust_tracks(scene.views, scene.tracks, None, replace(gcps, xy=xy))
    assert np.flatnonzero(~found.control.used).tolist() == [1]
    assert (np.abs(judge(scene, found.sensors).move) < 4 * found.gauge.sigma).all()


def test_of_two_points_none_is_taken_out():
    scene = scene_of(2, 1)
    tested = adjust_tracks(scene.views, scene.tracks, None, blundered(scene.gcps, {0: 30.0})).control
    assert tested.used.all()
