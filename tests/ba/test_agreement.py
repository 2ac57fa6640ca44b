"""Sets of control points that agree with each other: found, named, and none believed where none outweighs others.

Truth is drawn here: points on a plane, moved by a shift, tilts, a turn and a scale of their own formulas, each with
errors of its own. Whole blocks are the worlds of `benchmarks.worlds_families`, flown by cameras that are not barpc's.
"""

from __future__ import annotations

from functools import cache
from itertools import starmap
from typing import Any

import numpy as np
import pytest
from scipy import stats

from barpc.ba import AdjustOptions, adjust_tracks
from barpc.ba import agreement as sets
from barpc.ba.agreement import Agreement, Offsets, agreement, offsets_of
from barpc.ba.snooping import ControlTest
from barpc.geodesy import enu_basis
from barpc.options import RunOptions
from barpc.report import Run, summarize
from barpc.report.decisions import decisions
from barpc.simulate import simulate_block
from benchmarks.worlds import judge
from benchmarks.worlds_families import CONTROL, make
from tests.ba.conftest import INDEPENDENT, centers_of
from tests.lanes import rest_slow

SIGMA = 0.3


def drawn(
    count: int, seed: int, wrong: dict[int, tuple[float, float, float]] | None = None, **how: float
) -> Offsets:
    """Offsets of points [m over their sigma] under motions of 1.5 m at the edge, after a shift of tens of metres.

    `wrong` moves points [m]; errors are `times` as large as stated, motions `motions` as large.
    """
    rng = np.random.default_rng(seed)
    e, n = rng.uniform(-1.0, 1.0, (2, count))
    zero, one = np.zeros(count), np.ones(count)
    forms = [(zero, zero, e), (zero, zero, n), (-n, e, zero), (e, n, zero)]
    motions = np.stack([1.5 * np.stack(form, axis=1) for form in forms], axis=2)
    free = how.get("free", 1e3)
    shifts = np.stack([free * np.outer(one, axis) for axis in np.eye(3)], axis=2)
    offset = motions @ (how.get("motions", 1.0) * rng.normal(size=4)) + rng.normal(0.0, 20.0, 3)
    offset = offset + rng.normal(0.0, SIGMA * how.get("times", 1.0), (count, 3))
    for g, move in (wrong or {}).items():
        offset[g] += move
    return Offsets(offset / SIGMA, np.concatenate([motions, shifts], axis=2) / SIGMA)


def found(count: int, seed: int, wrong: Any = None, **how: float) -> Agreement:
    return agreement(drawn(count, seed, wrong, **how), np.ones(count, dtype=bool))


def any_way(seed: int, count: int, size: float) -> dict[int, Any]:
    """So many points moved by a length in any direction."""
    move = np.random.default_rng([seed, 7]).normal(size=(count, 3))
    return dict(enumerate(size * move / np.linalg.norm(move, axis=1)[:, None]))


# --- linear, with truth -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("times", "whole"), [(1.0, 20), (3.0, 18)])
def test_points_without_a_blunder_stay_one_set_whatever_their_accuracies(times, whole) -> None:
    all_of = [found(6, seed, times=times) for seed in range(20)]
    assert sum(bool(one.used.all()) for one in all_of) >= whole
    assert not any(one.sets for one in all_of)
    assert 0.7 < float(np.mean([one.scale for one in all_of])) / times < 1.2


def test_cameras_farther_off_than_stated_blame_no_point() -> None:
    assert all(found(6, seed, motions=3.0).used.all() for seed in range(20))


@pytest.mark.parametrize(
    ("count", "wrong", "size", "least"),
    rest_slow(
        starmap(
            pytest.param,
            [(6, 3, 8.0, 14), (9, 4, 100.0, 19), (5, 1, 3.0, 16), (5, 1, 30.0, 19), (6, 3, 30.0, 19)],
        ),
        keep=3,
    ),
)
def test_the_right_points_are_used_and_no_other(count, wrong, size, least) -> None:
    exact = 0
    for seed in range(20 if count < 9 else 4):
        one = found(count, seed, any_way(seed, wrong, size))
        assert one.used[wrong:].all() or one.sets  # a right one is never blamed
        exact += int(one.used[wrong:].all() and not one.used[:wrong].any())
    assert exact >= (least if count < 9 else 4)


@pytest.mark.parametrize(
    ("count", "moved"), rest_slow(starmap(pytest.param, [(2, 1), (4, 2), (6, 3), (12, 6)]), keep=3)
)
def test_two_sets_of_equal_weight_are_both_said_and_none_is_used(count, moved) -> None:
    for seed in range(10 if count < 12 else 2):
        one = found(count, seed, dict.fromkeys(range(moved), (0.0, 0.0, 60.0)))
        assert not one.used.any()
        first, second = one.sets  # of each of the two most are named
        assert not first[moved:].any()
        assert not second[:moved].any()
        assert 2 * min(first.sum(), second.sum()) >= moved


@pytest.mark.parametrize(
    ("count", "moved"), rest_slow(starmap(pytest.param, [(9, 4), (5, 2), (12, 4), (30, 9)]))
)
def test_the_larger_set_is_used_and_the_others_are_told_to_agree(count, moved) -> None:
    alike, times = 0, 10 if count < 12 else 2
    for seed in range(times):
        one = found(count, seed, dict.fromkeys(range(moved), (25.0, -10.0, 4.0)))
        assert np.flatnonzero(~one.used).tolist() == list(range(moved))
        alike += one.alike
    assert alike >= 0.7 * times
    assert not found(count, 1, any_way(1, moved, 40.0)).alike


def test_of_many_points_sets_are_drawn_and_the_same_ones_always() -> None:
    offsets = drawn(40, 3, any_way(3, 10, 12.0))
    told = np.ones(40, dtype=bool)
    one, again = agreement(offsets, told), agreement(offsets, told)
    assert np.flatnonzero(~one.used).tolist() == list(range(10))
    assert (one.used == again.used).all()
    assert one.scale == again.scale
    assert found(40, 4).used.all()


def test_where_nothing_agrees_with_anything_none_is_used() -> None:
    for seed in range(10):
        one = found(6, seed, any_way(seed, 6, 300.0))
        assert not one.used.any()
        assert len(one.sets) == 2


def test_points_that_nothing_tells_of_take_no_part() -> None:
    offsets = drawn(6, 1, {0: (30.0, 0.0, 0.0), 5: (0.0, 900.0, 0.0)})
    told = np.arange(6) != 5
    one = agreement(offsets, told)
    assert np.flatnonzero(~one.used).tolist() == [0]
    alone = agreement(offsets, np.arange(6) == 5)
    assert alone.used.all()  # one point, and nothing against it
    assert not agreement(drawn(2, 1, {0: (0.0, 50.0, 0.0)}), np.ones(2, dtype=bool)).used.any()


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_the_evidence_of_a_set_is_the_density_of_what_it_shows(scale) -> None:
    offsets = drawn(5, 2, {0: (9.0, 0.0, 0.0)}, free=50.0)
    chosen = np.array([0, 1, 1, 0, 1], dtype=bool)
    (score,), (squared,), (together,) = sets._evidence(offsets, chosen[None], scale)
    motions = offsets.motions.reshape(15, -1)
    whole = motions @ motions.T + scale**2 * np.eye(15)
    rows = np.repeat(chosen, 3)
    inside = stats.multivariate_normal(np.zeros(9), whole[np.ix_(rows, rows)], allow_singular=True)
    y = offsets.own.ravel()
    expected = inside.logpdf(y[rows])
    assert together == pytest.approx(y[rows] @ np.linalg.solve(whole[np.ix_(rows, rows)], y[rows]), rel=1e-5)
    for g in np.flatnonzero(~chosen):
        mine = slice(3 * g, 3 * g + 3)
        gain = whole[mine][:, rows] @ np.linalg.inv(whole[np.ix_(rows, rows)])
        left, spread = y[mine] - gain @ y[rows], whole[mine, mine] - gain @ whole[rows][:, mine]
        far = np.sqrt(left @ np.linalg.solve(spread, left))
        assert squared[g] == pytest.approx(far**2, rel=1e-4)
        # alike at all sizes from one sigma to 10,000: 1 / (4 pi r^3) over ln 10,000 and the ball within
        density = -np.log(4 * np.pi * (1 / 3 + np.log(1e4))) - 3 * np.log(max(far, 1.0))
        expected += density - 0.5 * np.linalg.slogdet(spread)[1] - sets._WRONG
    assert score == pytest.approx(expected, abs=0.05)


# --- a block ----------------------------------------------------------------------------------------------


def test_what_a_block_says_of_points_has_the_covariance_that_it_states_of_them() -> None:
    block = simulate_block(3, 100, seed=5, num_gcps=4, num_checks=0)
    gcps = block.gcps
    taken: list[Any] = []

    def spy(covariance: Any, given: Any, points: Any) -> Offsets:
        taken.append((covariance, given.num_tracks, offsets_of(covariance, given, points)))
        return taken[-1][2]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("barpc.ba.solution.offsets_of", spy)
        options = AdjustOptions(drift=0, jitter="off", **INDEPENDENT)
        adjust_tracks(block.views, block.tracks, options, gcps, centers=centers_of(block), hold_out=False)
    covariance, first, offsets = taken[-1]
    enu = enu_basis(gcps.lonlatalt)
    stated = enu @ covariance.points(first + np.arange(4)) @ np.swapaxes(enu, 1, 2)
    whole = stated + gcps.sigma[:, :, None] ** 2 * np.eye(3)
    for g in range(4):  # in the units of the offsets the variance of a point is that of its motions, and one
        moved = offsets.motions[g, :, :-3]
        shift = offsets.motions[g, :, -3:] / 1e3  # whitening, turned
        whitened = shift @ enu[g].T @ whole[g] @ enu[g] @ shift.T
        np.testing.assert_allclose(whitened, moved @ moved.T + np.eye(3), rtol=0.05, atol=0.05)


@cache
def flown(kind: str, times: int = 0) -> Any:
    """A world of a kind adjusted, with what is said, and the same block without control."""
    world = make("control", [name for name, _ in CONTROL].index(kind) + times * len(CONTROL))
    one = adjust_tracks(world.views, world.tracks, None, world.gcps)
    run = Run("adjust", world.views, (), world.tracks, adjustment=one, gcps=world.gcps, options=RunOptions())
    return world, one, summarize(run), adjust_tracks(world.views, world.tracks)


@pytest.mark.slow
@pytest.mark.parametrize("times", [0, 1, 2])
@pytest.mark.parametrize("kind", [name for name, _ in CONTROL])
def test_control_of_a_world_is_used_where_it_is_right_and_never_bends_the_images(kind, times) -> None:
    world, one, summary, free = flown(kind, times)
    tested, wrong = one.control, np.abs(world.plan.control.wrong).sum(axis=1) > 0
    assert not (tested.used & wrong).any()
    assert np.nanmedian(one.held_out_rms) < 1.05 * np.nanmedian(free.held_out_rms) + 0.001
    before, after = judge(world, free.sensors), judge(world, one.sensors)
    assert after.shape < before.shape + 0.7  # as far as 0.3 m of control and 0.3 px tilt it
    assert (np.abs(after.move) < 4.0 * one.gauge.sigma).all()
    status = [tested.status(g) for g in range(len(wrong))]
    if kind in ("1 of 2 wrong by 25 m", "2 of 4 up 40 m", "3 and 3"):
        assert set(status) == {"undecided"}
        assert {tuple(points) for points in tested.sets} == {tuple(wrong), tuple(~wrong)}
        assert (one.gauge.sigma > 4.0).all()
        assert any("GCPs contradict each other" in reason for reason in summary.reasons)
        assert any(
            "Without ground control that agrees its place is known" in line for line in summary.verdict
        )
        assert any("0 of" in line and "none outweighs" in line for line in decisions(summary))
    else:
        assert [word != "used" for word in status] == wrong.tolist()
        assert any(line.startswith("With") and "its place is known to" in line for line in summary.verdict)
    assert summary.passed == (tested.agrees and not wrong.any())
    assert any("Nothing checks" in line for line in summary.verdict) == (kind == "1 point")
    assert any("is their datum" in line for line in summary.verdict) == ("another datum" in kind)


def test_points_that_none_outweighs_are_undecided_and_agree_with_nothing() -> None:
    undecided = Agreement(np.zeros(3, dtype=bool), (np.array([1, 0, 0]) > 0, np.array([0, 1, 0]) > 0))
    tested = ControlTest(undecided.used, np.zeros((3, 3)), np.ones(3), np.ones(3), agreed=undecided)
    assert [tested.status(g) for g in range(3)] == ["undecided"] * 3
    assert not tested.agrees
