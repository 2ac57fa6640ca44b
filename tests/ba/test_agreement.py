"""Sets of control points that agree with each other: found, named, and none believed where none outweighs others.

Truth is drawn here: points on a plane, moved by a shift, tilts, a turn and a scale of their own formulas, each with
errors of its own. Whole blocks are the worlds of `benchmarks.worlds_families`, flown by cameras that are not barpc's.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import starmap
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks, solution
from barpc.ba.control import agreement as sets
from barpc.ba.control.agreement import Agreement, Offsets, SetEvidence, agreement, offsets_of
from barpc.ba.control.snooping import ControlTest
from barpc.ba.solution import Solution
from barpc.base.geodesy import enu_basis
from barpc.base.options import RunOptions
from barpc.report import Run, summarize
from barpc.scene import GroundPoints
from barpc.simulate import simulate_block
from benchmarks import worlds_families as families
from benchmarks.worlds import judge
from benchmarks.worlds_families import CONTROL, make
from tests import distributions as stats
from tests.ba.conftest import INDEPENDENT, centers_of
from tests.costs import once
from tests.lanes import diagonal, rest_slow

SIGMA = 0.3


def drawn(count: int, seed: int, wrong: dict[int, tuple[float, float, float]] | None = None, **how: float) -> Offsets:
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


@pytest.mark.slow
@pytest.mark.parametrize(("times", "whole"), [(1.0, 20), (3.0, 18)])
def test_points_without_a_blunder_stay_one_set_whatever_their_accuracies(times, whole) -> None:
    all_of = [found(6, seed, times=times) for seed in range(20)]
    assert sum(bool(one.used.all()) for one in all_of) >= whole
    assert not any(one.sets for one in all_of)
    assert 0.7 < float(np.mean([one.scale for one in all_of])) / times < 1.2


@pytest.mark.parametrize("seeds", rest_slow([range(4), range(4, 20)]))
def test_cameras_farther_off_than_stated_blame_no_point(seeds) -> None:
    assert all(found(6, seed, motions=3.0).used.all() for seed in seeds)


@pytest.mark.parametrize(
    ("count", "wrong", "size", "least"),
    rest_slow(
        starmap(pytest.param, [(6, 3, 8.0, 14), (9, 4, 100.0, 19), (5, 1, 3.0, 16), (5, 1, 30.0, 19), (6, 3, 30.0, 19)])
    ),
)
def test_the_right_points_are_used_and_no_other(count, wrong, size, least) -> None:
    exact = 0
    for seed in range(20 if count < 9 else 4):
        one = found(count, seed, any_way(seed, wrong, size))
        assert one.used[wrong:].all() or one.sets  # a right one is never blamed
        exact += int(one.used[wrong:].all() and not one.used[:wrong].any())
    assert exact >= (least if count < 9 else 4)


@pytest.mark.few(1)
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


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize(("count", "moved"), rest_slow(starmap(pytest.param, [(9, 4), (5, 2), (12, 4), (30, 9)])))
def test_the_larger_set_is_used_and_the_others_are_told_to_agree(count, moved) -> None:
    alike, times = 0, 10 if count < 12 else 2
    for seed in range(times):
        one = found(count, seed, dict.fromkeys(range(moved), (25.0, -10.0, 4.0)))
        assert np.flatnonzero(~one.used).tolist() == list(range(moved))
        alike += one.alike
    assert alike >= 0.7 * times
    assert not found(count, 1, any_way(1, moved, 40.0)).alike


def test_sets_that_are_drawn_find_what_all_of_them_find(monkeypatch) -> None:
    """Of three and of twelve points that are off in their own ways, and what another set of them agrees on."""
    for wrong in (any_way(3, 3, 12.0), dict.fromkeys(range(3), (0.0, 0.0, 60.0)), {}):
        offsets, told = drawn(7, 3, wrong), np.ones(7, dtype=bool)
        every = agreement(offsets, told)
        with monkeypatch.context() as patch:
            patch.setattr(sets, "_MAX_SET_POINTS", 700)
            patch.setattr(sets, "TRIALS", 40)
            one, again = agreement(offsets, told), agreement(offsets, told)
            search = sets._SubsetSearch(offsets)
        assert np.flatnonzero(~every.used).tolist() == list(range(len(wrong)))
        assert (one.used == every.used).all()
        assert (one.scale, one.alike) == (every.scale, every.alike)
        assert (again.used == one.used).all()
        assert len(search.masks) < 2**7 - 1


@pytest.mark.parametrize("seeds", rest_slow([(0, 1, 2, 10), range(3, 10)]))
def test_where_nothing_agrees_with_anything_none_is_used(seeds) -> None:
    for seed in seeds:
        one = found(6, seed, any_way(seed, 6, 300.0))
        assert not one.used.any()
        first, second = one.sets
        assert (first != second).any()


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
    told = SetEvidence(offsets, chosen[None], scale)
    (score,), (squared,), (together,) = told.evidence(np.arange(1)), told.deviations(np.arange(5))[0], told.squares
    motions = offsets.motions.reshape(15, -1)
    whole = motions @ motions.T + scale**2 * np.eye(15)
    rows = np.repeat(chosen, 3)
    inside = stats.multivariate_normal(np.zeros(9), whole[np.ix_(rows, rows)])
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
        expected += density - 0.5 * np.linalg.slogdet(spread)[1] - sets.ODDS
    assert score == pytest.approx(expected - sets.ODDS * np.log(scale), abs=0.05)
    assert told.at_most()[0] > score


@pytest.mark.parametrize(("scale", "motions"), [(1.0, 1.0), (3.0, 2.0)])
@pytest.mark.parametrize("inside", [2, 7, 15])
def test_what_a_point_adds_to_a_set_is_the_evidence_with_it_less_that_without(scale, motions, inside, sized) -> None:
    """In one piece, and where the points are many a few at a time; the set of all, too."""
    offsets = drawn(15, 3, any_way(3, 4, 6.0))
    chosen = np.arange(15) >= 15 - inside
    masks = np.vstack([chosen, chosen ^ np.eye(15, dtype=bool)])
    score = SetEvidence(offsets, masks, scale, motions).evidence(np.arange(16))
    there = SetEvidence(offsets, chosen[None], scale, motions)
    np.testing.assert_allclose(there.gains(np.arange(15)), score[1:] - score[0], rtol=1e-6, atol=1e-5)
    sized(set_points=20)
    np.testing.assert_allclose(there.gains(np.arange(3, 15)), score[4:] - score[0], rtol=1e-6, atol=1e-5)


def test_thousands_of_points_some_wrong_are_told_apart_and_none_is_asked_of_every_other() -> None:
    offsets = drawn(4000, 3, any_way(3, 80, 12.0))
    one = agreement(offsets, np.ones(4000, dtype=bool))
    assert not one.used[:80].any()
    assert one.used[80:].sum() > 3910  # five of the right ones in a thousand are beyond what the others tell


def test_right_control_points_do_not_make_tie_points_look_better_than_they_are() -> None:
    """Nothing holds their places while outliers are looked for, and their residuals are small."""
    block = simulate_block(3, 300, seed=1, num_gcps=900, num_checks=0)
    one = adjust_tracks(block.views, block.tracks, None, block.gcps)
    alone = adjust_tracks(block.views, block.tracks)
    assert one.noise == pytest.approx(alone.noise, rel=0.03)


# --- a block ----------------------------------------------------------------------------------------------


def test_what_a_block_says_of_points_has_the_covariance_that_it_states_of_them() -> None:
    block = simulate_block(3, 100, seed=5, num_gcps=4, num_checks=0)
    gcps = block.gcps
    taken: list[Any] = []

    def spy(covariance: Any, given: Any, points: Any, faint: Any) -> Offsets:
        taken.append((covariance, given.num_tracks, offsets_of(covariance, given, points, faint)))
        assert (faint[given.num_tracks :] == 100.0).all()
        return taken[-1][2]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("barpc.ba.solution.offsets_of", spy)
        options = AdjustOptions(drift=0, jitter="off", **INDEPENDENT)
        adjust_tracks(block.views, block.tracks, options, gcps, centers=centers_of(block), hold_out=False)
    covariance, first, offsets = taken[-1]
    enu = enu_basis(gcps.lonlatalt)
    stated = enu @ covariance.points(first + np.arange(4)) @ np.swapaxes(enu, 1, 2)
    for g, column in enumerate(covariance.reduced.lower[:, first : first + 4].T):
        lower = np.zeros((3, 3))
        lower[np.tril_indices(3)] = column[[0, 1, 3, 2, 4, 5]]  # its elements 00, 10, 20, 11, 21, 22
        of_rays = enu[g] @ np.linalg.inv(lower @ lower.T) @ enu[g].T  # a hundred times as noisy as they are
        stated[g] -= of_rays * (1.0 - 1e-4)
    whole = stated + gcps.sigma[:, :, None] ** 2 * np.eye(3)
    for g in range(4):  # in the units of the offsets the variance of a point is that of its motions, and one
        moved = offsets.motions[g, :, :-3]
        shift = offsets.motions[g, :, -3:] / 1e4  # whitening, turned
        whitened = shift @ enu[g].T @ whole[g] @ enu[g] @ shift.T
        np.testing.assert_allclose(whitened, moved @ moved.T + np.eye(3), rtol=0.05, atol=0.05)


@once
def flown(kind: str, times: int = 0) -> Any:
    """A world of a kind adjusted, with what is said, and the same block without control."""
    world = make("control", [name for name, _ in CONTROL].index(kind) + times * len(CONTROL))
    one = adjust_tracks(world.views, world.tracks, None, world.gcps)
    run = Run("adjust", world.views, (), world.tracks, adjustment=one, gcps=world.gcps, options=RunOptions())
    return world, one, summarize(run), adjust_tracks(world.views, world.tracks)


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize("times", rest_slow(range(3), mark=pytest.mark.nightly))
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
            "Without consistent ground control, the scene's position is uncertain" in line for line in summary.verdict
        )
    else:
        assert [word != "used" for word in status] == wrong.tolist()
        assert any(
            line.startswith("With") and "the scene's position is uncertain by" in line for line in summary.verdict
        )
    assert summary.passed == (tested.agrees and not wrong.any())
    assert any("Nothing checks" in line for line in summary.verdict) == (kind == "1 point")
    assert any("check their datum" in line for line in summary.verdict) == ("another datum" in kind)


def test_points_that_none_outweighs_are_undecided_and_agree_with_nothing() -> None:
    undecided = Agreement(np.zeros(3, dtype=bool), (np.array([1, 0, 0]) > 0, np.array([0, 1, 0]) > 0))
    tested = ControlTest(undecided.used, np.zeros((3, 3)), np.ones(3), np.ones(3), agreed=undecided)
    assert [tested.status(g) for g in range(3)] == ["undecided"] * 3
    assert not tested.agrees


# --- what the images say of it ----------------------------------------------------------------------------


def raised(block: Any, gcps: GroundPoints) -> tuple[Any, float]:
    """A block held by control, and what that adds to tie points that took no part [px, in quadrature].

    Beside the same control where its places may be wrong by kilometres: its observations are there, and pull nothing.
    """
    one = adjust_tracks(block.views, block.tracks, None, gcps)
    free = adjust_tracks(block.views, block.tracks, None, replace(gcps, sigma=np.full_like(gcps.sigma, 1e4)))
    held, without = (float((x.held_out_rms**2).mean()) for x in (one, free))
    return one, float(np.sqrt(max(held - without, 0.0)))


def believing(patch: pytest.MonkeyPatch) -> None:
    """Let every control point pass as one that agrees with all others."""
    patch.setattr("barpc.ba.solution.agreement", lambda _, told: Agreement(np.ones(len(told), dtype=bool)))


@pytest.mark.nightly
@pytest.mark.parametrize("what", ["two of six up", "a wave"])
def test_control_that_passes_as_agreeing_and_tears_the_images_is_let_go(what, monkeypatch) -> None:
    block = simulate_block(3, 400, seed=5, num_gcps=6)
    gcps, lonlatalt = block.gcps, block.gcps.lonlatalt.copy()
    if what == "two of six up":
        lonlatalt[:2, 2] += 40.0
    else:
        lonlatalt[:, 0] += 3e-4 * np.sin(np.arange(6) * 2.5)
    wrong = replace(gcps, lonlatalt=lonlatalt)
    believing(monkeypatch)
    one, rise = raised(block, wrong)
    without, torn = one.control.torn
    assert np.sqrt(torn**2 - without**2) > 0.04
    assert rise < 0.03
    assert not one.control.used.any()
    assert not one.control.agrees
    assert (one.gauge.sigma > 3.0).all()  # its place is what the delivered cameras tell
    run = Run("adjust", block.views, (), block.tracks, adjustment=one, gcps=wrong, options=RunOptions())
    summary = summarize(run)
    assert not summary.passed
    assert any("With the GCPs the images would agree less" in reason for reason in summary.reasons)
    assert any(line.startswith("Without consistent ground control") for line in summary.verdict)
    assert [point.status for point in summary.gcps] == ["rejected"] * 6


@pytest.mark.parametrize(
    ("held", "free", "better", "let_go"),
    [(0.50, 0.47, True, True), (0.50, 0.49, True, False), (0.47, 0.50, True, False), (0.50, 0.47, False, False)],
)
def test_control_stays_where_images_are_worse_with_it_by_no_more_than_they_tell(
    monkeypatch, held: float, free: float, better: bool, let_go: bool
) -> None:
    """Two unknowns of a view are known to twice the square of the noise floor [px^2] by its ties."""
    told: Any = SimpleNamespace(whole_rms=free)
    monkeypatch.setattr(solution, "measure", lambda *_: told)
    monkeypatch.setattr(solution, "is_better", lambda one, other, _: better and one is told and other is found.after)
    monkeypatch.setattr(solution, "finished", lambda first, *_: first)
    found: Any = SimpleNamespace(after=SimpleNamespace(whole_rms=held), agreed=Agreement(np.ones(3, dtype=bool)))
    state = SimpleNamespace(params=np.zeros((4, 2)))
    alone = Solution(*[None] * 4, SimpleNamespace(state=state), *[None] * 3, {})
    ended: Any = solution._without_distorting_control(found, alone, None, None, AdjustOptions(noise_floor=0.1))  # type: ignore[arg-type]
    assert (ended is not found) == let_go
    if let_go:
        assert ended.agreed.torn == (free, held)
        assert not ended.agreed.used.any()


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("pixels", [1.0, 10.0])
def test_control_marked_beside_itself_in_one_image_does_not_move_it(pixels) -> None:
    block = simulate_block(3, 400, seed=5, num_gcps=6)
    xy = block.gcps.xy.copy()
    xy[block.gcps.view == 1] += [pixels, -pixels]
    one = adjust_tracks(block.views, block.tracks, None, replace(block.gcps, xy=xy))
    free = adjust_tracks(block.views, block.tracks)
    np.testing.assert_allclose(one.held_out_rms, free.held_out_rms, atol=0.003)
    assert one.control.torn
    assert not one.control.used.any()
    assert one.apart is None  # its RPC is its own


@pytest.mark.slow
def test_control_that_is_right_stays_and_the_images_are_worse_with_it_by_less_than_they_are_asked_to_be() -> None:
    block = simulate_block(3, 400, seed=5, num_gcps=6)
    one, rise = raised(block, block.gcps)
    assert one.control.used.all()
    assert not one.control.torn
    assert rise < np.sqrt(one.params.shape[1]) * AdjustOptions().noise_floor


def controlled(seed: int, points: int, views: int, sigma: float, tracks: int) -> Any:
    """A world with control as it is stated."""

    def plan(_: int, rng: np.random.Generator) -> Any:
        drawn_plan = families.draw(rng, views, side=(8000, 24000))
        drawn_plan.tracks = tracks
        drawn_plan.control = families.Control("as stated", np.zeros((points, 3)), sigma=(sigma,) * 3)
        drawn_plan.injected.append(families.Injected("none", (), 1, 0, 0, 0.0))
        return drawn_plan

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(families.FAMILIES, "controlled", plan)
        return make("controlled", seed)


@pytest.mark.nightly
@pytest.mark.parametrize(("worlds", "most"), [(6, 1), (40, 2)])
def test_of_forty_worlds_with_control_as_stated_none_loses_it(worlds: int, most: int) -> None:
    unused = 0
    for seed in range(worlds):
        sigma, tracks = (0.3, 0.05)[seed // 4 % 2], (400, 2000, 200)[seed % 3]
        world = controlled(seed, (6, 20, 40, 4)[seed % 4], (2, 3, 4)[seed // 2 % 3], sigma, tracks)
        one = adjust_tracks(world.views, world.tracks, None, world.gcps)
        assert not one.control.torn
        unused += int((~one.control.used).sum())
    assert unused <= most  # of 100, or 700


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "tracks", "drawn"),
    diagonal(["wave", "bend", "flat wave", "noise"], [400, 8000], [(0, 2), (3, 3), (5, 3)], mark=pytest.mark.nightly),
)
def test_no_wrong_control_raises_what_tie_points_are_left_with(kind, tracks, drawn) -> None:
    seed, views = drawn
    world = controlled(seed, 40, views, 0.05, tracks)
    given = world.gcps.lonlatalt
    at = given[:, :2] - given[:, :2].mean(axis=0)
    at /= np.abs(at).max(axis=0)
    enu = np.zeros((40, 3))
    if kind == "bend":
        enu[:, 2] = (at**2).sum(axis=1)
    elif kind == "wave":
        enu[:, 2] = np.sin(4.0 * at[:, 0])
    elif kind == "flat wave":
        enu[:, :2] = np.column_stack([np.sin(4.0 * at[:, 1]), np.cos(3.0 * at[:, 0])])
    else:
        enu = np.random.default_rng(seed).normal(size=(40, 3))
    metres = np.stack([111e3 * np.cos(np.radians(given[:, 1])), np.full(40, 111e3), np.ones(40)], axis=1)
    moved = replace(world.gcps, lonlatalt=given + 3.0 * enu / metres)
    _, rise = raised(world, moved)
    assert rise < 0.07  # ties of a view are worth 0.02 px in all, a camera has nine unknowns: 3 x 0.02 px, and chance
