"""Control points against each other: blunders are found and named, residuals are those of points left out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from barpc.ba import Adjustment, AdjustOptions, adjust_tracks
from barpc.ba.control.snooping import CRITICAL, ControlTest, global_test
from barpc.base.geodesy import enu_basis, metres_per_unit
from barpc.base.options import RunOptions
from barpc.report import Run, summarize
from barpc.scene import GroundPoints, Reference
from barpc.sensor.geometry import sight_enu
from barpc.simulate import SimulatedBlock, simulate_block
from benchmarks.referee import cases, judge, make
from tests import distributions as stats
from tests.ba.conftest import INDEPENDENT, centers_of
from tests.ba.test_referee import hills
from tests.constants import Sized
from tests.costs import once
from tests.lanes import rest_slow

SEEDS = (1, 2)
ONE = rest_slow(SEEDS, mark=pytest.mark.nightly)


@once
def scene_of(count: int, seed: int):
    return make(replace(cases()["5 GCPs"], gcps=count, seed=seed), hills)


def blundered(gcps: GroundPoints, wrong: dict[int, float], seed: int = 0) -> GroundPoints:
    """Some points moved by so many metres, in any direction."""
    place, rng = gcps.lonlatalt.copy(), np.random.default_rng(seed)
    for g, size in wrong.items():
        move = rng.normal(size=3) * [1.0, 1.0, 0.3]
        place[g] += size * move / np.linalg.norm(move) / metres_per_unit(place[g : g + 1])[0]
    return replace(gcps, lonlatalt=place)


def some(gcps: GroundPoints, keep: np.ndarray) -> GroundPoints:
    """Some of the observations."""
    return replace(gcps, **{name: getattr(gcps, name)[keep] for name in ("point", "view", "xy", "xy_sigma")})


def test_a_control_point_that_contradicts_is_said_to() -> None:
    assert 3.9 < CRITICAL < 4.1
    tested = ControlTest(np.array([True, True, False]), np.zeros((3, 3)), np.array([3.9, 4.1, 9.0]), np.ones(3))
    assert [tested.status(g) for g in range(3)] == ["used", "contradicts", "rejected"]


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize("seed", ONE)
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
        assert np.linalg.norm(tested.residual[g]) == pytest.approx(size, abs=1.0)  # 0.3 m, and 0.3 px seen from afar
        assert tested.w[g] > CRITICAL
    assert np.nanmax(np.where(tested.used, tested.w, 0.0)) < CRITICAL
    moved = judge(scene, found.sensors).move
    assert (np.abs(moved) < 4 * found.gauge.sigma).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", rest_slow(range(1, 7), keep=2, mark=pytest.mark.nightly))
def test_points_that_hold_are_all_used(seed):
    scene = scene_of(8, seed)
    tested = adjust_tracks(scene.views, scene.tracks, None, scene.gcps).control
    assert tested.used.all()
    assert np.nanmax(tested.w) < CRITICAL
    assert (tested.redundancy >= 0).all()
    assert (tested.redundancy <= 1).all()


@pytest.mark.slow
def test_a_wrong_position_in_one_image_costs_the_point_and_not_the_scene():
    scene = scene_of(6, 2)
    gcps = scene.gcps
    xy = gcps.xy.copy()
    xy[np.flatnonzero(gcps.point == 1)[0]] += 40.0
    found = adjust_tracks(scene.views, scene.tracks, None, replace(gcps, xy=xy))
    assert np.flatnonzero(~found.control.used).tolist() == [1]
    assert (np.abs(judge(scene, found.sensors).move) < 4 * found.gauge.sigma).all()


def said(scene, gcps):
    """The adjustment and the verdict on it."""
    found = adjust_tracks(scene.views, scene.tracks, None, gcps)
    run = Run("adjust", scene.views, (), scene.tracks, adjustment=found, gcps=gcps, options=RunOptions())
    return found.control, summarize(run)


@pytest.mark.nightly
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


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("seed", ONE)
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


@pytest.mark.slow
@pytest.mark.parametrize("seed", ONE)
def test_points_in_one_image_are_tested_across_its_line_of_sight(seed):
    scene = scene_of(6, seed)
    gcps = scene.gcps
    one = some(gcps, gcps.view == 1)
    tested, summary = said(scene, one)
    seen = np.bincount(one.point, minlength=6) > 0
    assert tested.used.all()
    assert np.isfinite(tested.w[seen]).all()
    assert tested.w[seen].max() < CRITICAL
    ray = sight_enu(scene.views[1].sensor, gcps.lonlatalt[seen])
    along = np.abs((tested.residual[seen] * ray).sum(axis=1))
    assert (along < 0.02 * np.linalg.norm(tested.residual[seen], axis=1) + 0.01).all()
    assert any(f"Only {scene.views[1].name} shows GCPs" in line for line in summary.verdict)
    wrong = int(np.flatnonzero(seen)[1])
    moved = one.lonlatalt.copy()
    moved[wrong, 0] += 30.0 / metres_per_unit(one.lonlatalt[wrong])[0]
    tested, summary = said(scene, replace(one, lonlatalt=moved))
    assert np.flatnonzero(~tested.used).tolist() == [wrong]
    assert not summary.passed


# --- a small block --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small() -> SimulatedBlock:
    """Three views, a hundred tie points, six control points of 0.3 m and 0.1 px."""
    block = simulate_block(3, 100, seed=5, num_gcps=6, num_checks=0)
    gcps, rng = block.gcps, np.random.default_rng(1)
    place = gcps.lonlatalt + rng.normal(0, 0.3, (6, 3)) / metres_per_unit(gcps.lonlatalt)
    return replace(block, gcps=replace(gcps, lonlatalt=place, sigma=np.full((6, 3), 0.3)))


def held(small: SimulatedBlock, gcps: GroundPoints, **options: Any) -> Adjustment:
    options = {"drift": 0, "jitter": "off", **INDEPENDENT, **options}
    centers = centers_of(small)
    return adjust_tracks(small.views, small.tracks, AdjustOptions(**options), gcps, centers=centers, hold_out=False)


def test_points_that_hold_are_used_and_a_blunder_is_left_out(small) -> None:
    tested = held(small, small.gcps).control
    assert tested.used.all()
    assert tested.agrees
    assert np.nanmax(tested.w) < CRITICAL
    assert 0.5 < tested.scatter < 1.5
    assert ((tested.redundancy > 0.3) & (tested.redundancy < 1.0)).all()
    tested = held(small, blundered(small.gcps, {4: 8.0})).control
    assert np.flatnonzero(~tested.used).tolist() == [4]
    assert tested.status(4) == "rejected"
    assert np.linalg.norm(tested.residual[4]) == pytest.approx(8.0, abs=1.0)
    assert tested.agrees


def test_a_residual_points_from_the_given_place_to_the_one_that_all_others_tell(small) -> None:
    gcps = small.gcps
    tested = held(small, gcps).control
    loose = gcps.sigma.copy()
    loose[2] = 1e5  # its rays count, its place does not
    without = held(small, replace(gcps, sigma=loose))
    offset = without.gcp_residuals[2]
    np.testing.assert_allclose(tested.residual[2], offset, atol=0.02)
    enu, covariance = enu_basis(gcps.lonlatalt[2]), without.covariance.points(np.array([len(small.truth.ground) + 2]))
    sigma = np.sqrt(np.diag(enu @ covariance[0] @ enu.T) + 0.3**2)
    # at a blunder of any size the w-test is that of the point left out, component by component
    moved = gcps.lonlatalt.copy()
    moved[2, 2] += 3.0
    both = held(small, replace(gcps, lonlatalt=moved))
    assert both.control.residual[2][2] == pytest.approx(offset[2] - 3.0, abs=0.03)
    assert both.control.w[2] == pytest.approx(np.max(np.abs(both.control.residual[2]) / sigma), rel=0.3)


def test_what_nothing_tells_of_is_not_tested(small) -> None:
    gcps = small.gcps
    never = held(small, some(gcps, gcps.point != 3)).control  # a point that no image shows
    assert np.isnan(never.w[3])
    assert np.isnan(never.residual[3]).all()
    assert never.redundancy[3] == 0.0
    assert np.isfinite(np.delete(never.w, 3)).all()
    first = np.flatnonzero(gcps.point == 3)[0]
    once = held(small, some(gcps, (gcps.point != 3) | (np.arange(len(gcps.point)) == first))).control
    ray = sight_enu(small.views[gcps.view[first]].sensor, gcps.lonlatalt[3])
    assert abs(once.residual[3] @ ray) < 0.02  # along its ray nothing is told
    assert 0.1 < once.redundancy[3] < 2 / 3
    last = np.flatnonzero(gcps.point == 3)[1:]
    twice = held(small, blundered(some(gcps, ~np.isin(np.arange(len(gcps.point)), last[1:])), {3: 20.0})).control
    assert twice.status(3) == "rejected"  # by two rays, which tell by how much
    assert np.linalg.norm(twice.residual[3]) == pytest.approx(20.0, abs=2.0)
    assert twice.w[3] > CRITICAL


def test_a_point_alone_is_not_checked_and_two_that_differ_contradict(small) -> None:
    gcps = small.gcps
    one, two = (gcps.select(np.arange(6) < n) for n in (1, 2))
    alone = held(small, one).control
    assert alone.used.all()
    assert not alone.checked
    both = held(small, blundered(two, {0: 12.0})).control
    assert not both.used.any()
    assert [both.status(g) for g in (0, 1)] == ["undecided"] * 2
    assert not both.agrees


@pytest.mark.parametrize("wrong", [0, 7])
def test_an_observation_of_a_control_point_that_is_off_has_the_largest_w_in_the_order_given(small, wrong) -> None:
    gcps = small.gcps
    gcps = some(gcps, np.random.default_rng(3).permutation(len(gcps.view)))
    xy = gcps.xy.copy()
    xy[wrong, 0] += 0.8
    found = held(small, replace(gcps, xy=xy))
    assert found.gcp_w.shape == found.gcp_inlier.shape == (len(gcps.view),)
    assert found.gcp_inlier.all()
    assert np.argmax(found.gcp_w) == wrong
    assert 4.0 < found.gcp_w[wrong] < 12.0  # 8 sigmas, of which its point takes some
    assert found.reference_w.shape == found.reference_inlier.shape == (0,)


@pytest.mark.parametrize(("share", "fits"), [(0.97, True), (1.03, False)])
def test_all_together_they_may_scatter_as_chance_lets_them_once_in_a_thousand(share, fits) -> None:
    redundancy, used = np.array([0.5, 0.25, 0.9, 0.0]), np.array([True, True, False, True])
    freedom = 3 * 0.75
    whitened = np.full((4, 3), 9.0)  # of what is not used, and of what nothing tells, nothing counts
    whitened[:2] = np.sqrt(share * stats.chi2.isf(1e-3, freedom) / 6)
    scatter, may_be = global_test(whitened, redundancy, used)
    assert scatter == pytest.approx(np.sqrt(share * stats.chi2.isf(1e-3, freedom) / freedom))
    assert may_be == fits


@pytest.mark.parametrize(("redundancy", "told"), [(0.32, False), (0.35, True)])
def test_of_less_than_one_degree_of_freedom_nothing_is_told(redundancy, told) -> None:
    scatter, fits = global_test(np.full((1, 3), 99.0), np.array([redundancy]), np.ones(1, dtype=bool))
    assert np.isfinite(scatter) == told
    assert fits != told


@pytest.mark.parametrize(("redundancy", "checked"), [([0.09, 0.9], False), ([0.11, 0.0], True)])
def test_a_point_is_checked_by_a_tenth_of_redundancy(redundancy, checked) -> None:
    used = np.array([True, False])
    tested = ControlTest(used, np.zeros((2, 3)), np.zeros(2), np.array(redundancy))
    assert tested.checked == checked


def test_of_a_reference_of_many_points_every_nth_is_tested_in_the_images(sized: Sized) -> None:
    """And all control points that are held and were kept."""
    sized(scene_points=20)
    block = simulate_block(3, 100, seed=5, num_gcps=36, num_checks=0)
    gcps, first = block.gcps, np.arange(36) < 6
    points = gcps.select(~first)
    points = replace(points, xy=points.xy + 30.0 * (np.arange(len(points.xy)) % 9 == 0)[:, None])
    reference = Reference(replace(points, sigma=np.full((30, 3), 0.5)), np.full(3, 0.5), np.zeros((3, 2)))
    given = blundered(replace(gcps, sigma=np.full((36, 3), 0.3)).select(first), {4: 30.0})
    found = adjust_tracks(block.views, block.tracks, None, given, reference=reference, hold_out=False)
    np.testing.assert_array_equal(np.isfinite(found.gcp_w), found.gcp_inlier & (given.point != 4))  # it is not held
    kept = np.flatnonzero(found.reference_inlier)
    assert 0.8 < len(kept) / len(points.xy) < 0.95
    kept = kept[np.argsort(points.view[kept], kind="stable")]
    every = -(-len(kept) // 20)
    assert every > 2
    assert np.flatnonzero(np.isfinite(found.reference_w)).tolist() == sorted(kept[::every])


@pytest.mark.parametrize(
    ("used", "w", "fits", "agrees"),
    [
        ([1, 1, 1], [0.5, 1.0, 2.0], True, True),
        ([1, 1, 1], [0.5, 1.0, 2.0], False, False),  # together they scatter by more than stated
        ([1, 1, 1], [0.5, 1.0, 9.0], True, False),
        ([1, 1, 0], [0.5, 1.0, 9.0], False, False),
    ],
)
def test_control_agrees_where_no_point_and_not_all_together_contradict(used, w, fits, agrees) -> None:
    n = len(used)
    tested = ControlTest(np.array(used, dtype=bool), np.zeros((n, 3)), np.array(w), np.ones(n), scatter=1.0, fits=fits)
    assert tested.agrees is agrees
