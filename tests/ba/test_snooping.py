"""Control points against each other: blunders are found and named, residuals are those of points left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.ba import adjust_tracks
from barpc.ba.snooping import CRITICAL, ControlTest
from barpc.geodesy import ecef_from_ground, enu_basis, metres_per_unit
from barpc.options import RunOptions
from barpc.report import Run, summarize
from barpc.report.summary import GcpEntry
from barpc.scene import GroundPoints
from barpc.sensor.geometry import sight_enu, triangulate
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


@pytest.mark.parametrize(
    ("w", "used", "culprit"),
    [
        ([1.0, 4.2, 0.5], [1, 1, 1], 1),
        ([1.0, 3.9, 0.5], [1, 1, 1], None),
        ([9.0, 8.0], [1, 1], None),  # of two none can be named
        ([9.0, 8.0, np.nan], [1, 1, 1], None),  # nor of two that tell
        ([9.0, 8.0, 7.0, 1.0, 1.0], [1, 1, 0, 1, 1], None),  # of five one may be wrong
        ([9.0, 8.0, 70.0, 1.0, 1.0, 1.0], [1, 1, 0, 1, 1, 1], 0),  # of six two
        ([9.0, 8.0, 70.0, np.nan, 1.0, 1.0], [1, 1, 0, 1, 1, 1], None),
        ([9.0, 12.0, np.nan, 1.0], [1, 1, 0, 1], 1),  # one that nothing tells about does not count among them
    ],
)  # fmt: skip
def test_the_worst_of_enough_control_points_is_the_culprit(w, used, culprit) -> None:
    n = len(w)
    tested = ControlTest(np.array(used, dtype=bool), np.zeros((n, 3)), np.array(w), np.ones(n))
    assert tested.culprit() == culprit


def test_a_control_point_that_contradicts_is_said_to() -> None:
    assert 3.9 < CRITICAL < 4.1
    tested = ControlTest(
        np.array([True, True, False]), np.zeros((3, 3)), np.array([3.9, 4.1, 9.0]), np.ones(3)
    )
    assert [tested.status(g) for g in range(3)] == ["used", "contradicts", "rejected"]


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
    assert [tested.status(g) for g in (0, 1)] == ["contradicts", "contradicts"]


def said(scene, gcps):
    """The adjustment and the verdict on it."""
    found = adjust_tracks(scene.views, scene.tracks, None, gcps)
    run = Run("adjust", scene.views, (), scene.tracks, adjustment=found, gcps=gcps, options=RunOptions())
    return found.control, summarize(run)


@pytest.mark.parametrize("seed", [1, 4])
def test_two_points_that_contradict_each_other_are_never_good(seed):
    scene = scene_of(2, seed)
    gcps = scene.gcps
    for east in (2.5, 3.5, 10.0):  # 0.3 m and 0.3 px are stated
        moved = gcps.lonlatalt.copy()
        moved[0, 0] += east / metres_per_unit(moved[0])[0]
        tested, summary = said(scene, replace(gcps, lonlatalt=moved))
        assert not summary.passed
        assert not tested.agrees
        assert any("GCP" in reason for reason in summary.reasons)
    tested, summary = said(scene, gcps)
    assert tested.fits
    assert tested.checked
    assert not any("Nothing checks" in line for line in summary.verdict)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("times", "good"), [(1.0, True), (3.5, False)])
def test_errors_that_are_no_ones_alone_show_in_all_together(seed, times, good):
    scene = scene_of(6, seed)
    gcps, rng = scene.gcps, np.random.default_rng(seed)
    more = np.sqrt(times**2 - 1) * 0.3 * rng.normal(size=(6, 3)) / metres_per_unit(gcps.lonlatalt)
    tested, summary = said(scene, replace(gcps, lonlatalt=gcps.lonlatalt + more))
    assert (tested.fits and tested.used.all()) == good
    if tested.used.all():
        assert (0.6 < tested.scatter < 1.5) if good else (2.0 < tested.scatter < 6.0)
    assert any("GCP" in reason for reason in summary.reasons) != good


def test_a_point_that_nothing_checks_is_said_to_be():
    scene = scene_of(1, 1)
    tested, summary = said(scene, scene.gcps)
    assert tested.used.all()
    assert not tested.checked
    assert any(line == "Nothing checks it: an error in a GCP would not show." for line in summary.verdict)


@pytest.mark.parametrize("seed", SEEDS)
def test_points_in_one_image_are_tested_across_its_line_of_sight(seed):
    scene = scene_of(6, seed)
    gcps, keep = scene.gcps, scene.gcps.view == 1
    one = replace(gcps, **{name: getattr(gcps, name)[keep] for name in ("point", "view", "xy", "xy_sigma")})
    tested, summary = said(scene, one)
    seen = np.bincount(one.point, minlength=6) > 0
    assert tested.used.all()
    assert np.isfinite(tested.w[seen]).all()
    assert tested.w[seen].max() < CRITICAL
    ray = sight_enu(scene.views[1].sensor, gcps.lonlatalt[seen])
    along = np.abs((tested.residual[seen] * ray).sum(axis=1))
    assert (along < 0.02 * np.linalg.norm(tested.residual[seen], axis=1) + 0.01).all()
    assert any(f"seen in {scene.views[1].name} alone" in line for line in summary.verdict)
    wrong = int(np.flatnonzero(seen)[1])
    moved = one.lonlatalt.copy()
    moved[wrong, 0] += 30.0 / metres_per_unit(one.lonlatalt[wrong])[0]
    tested, summary = said(scene, replace(one, lonlatalt=moved))
    assert np.flatnonzero(~tested.used).tolist() == [wrong]
    assert not summary.passed


def test_the_summary_has_every_point_with_its_residual_in_the_images():
    scene = scene_of(6, 1)
    gcps = blundered(scene.gcps, {1: 30.0}, 1)
    tested, summary = said(scene, gcps)
    found = summary.gcps[1]
    assert (found.used, found.status) == (False, "rejected")
    assert [one.used for one in summary.gcps] == tested.used.tolist()
    offset = np.array(found.residual_enu_m)
    rays = [sight_enu(view.sensor, gcps.lonlatalt[1]) for view in scene.views if view.name in found.images]
    across = [np.linalg.norm(offset - offset @ ray * ray) for ray in rays]
    assert found.residual_px == pytest.approx(
        np.sqrt(np.mean(np.square(across))) / 0.5, rel=0.1
    )  # pixels of 0.5 m
    many = [replace(one, used=n != 40, w=float(n)) for n in range(60) for one in summary.gcps[:1]]
    shown = GcpEntry.worst(many)
    assert [int(one.w) for one in shown] == [*range(40, 60)]
    odd = GcpEntry.worst([replace(one, used=one.w != 3) for one in many])
    assert [int(one.w) for one in odd] == [3, *range(41, 60)]
