"""The search for terms, on residuals of simulated blocks with known displacements: what is named, and what not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks, terms
from barpc.ba.constraints.block import Block, join
from barpc.ba.evidence.scan import Interval
from barpc.ba.robust.rounds import Outcome
from barpc.ba.select import anomalies, search
from barpc.ba.select.anomalies import log_ratio_by_image
from barpc.ba.select.beam import Selection, TermSearch, _overlap, _SearchState, _SelectedTerm, _without_overlaps
from barpc.ba.select.search import linearised_among, search_terms
from barpc.ba.solution import solve_block
from barpc.ba.terms import TERMS
from barpc.ba.terms.term import SIZE_PRICE, Finding, Residuals, Term, in_both_coordinates
from barpc.base.statistics import SURE
from barpc.simulate import simulate_block
from benchmarks.worlds import DEM_AS_STATED, judge
from benchmarks.worlds_families import make
from tests.ba.residuals import (
    DIRECTION,
    Displacement,
    cell_errors,
    decay,
    residuals_at,
    residuals_of,
    sinusoid,
    step,
    transient,
)
from tests.ba.test_moving import drifting
from tests.costs import once
from tests.lanes import known, rest_slow

FLOOR = 0.05  # px
STEP, SWING = step(2.0, 1, 0.4, 0.6), sinusoid(0.6, 1, 20.0)


def searched(seen: Residuals, *first: Interval, floor: float = FLOOR) -> Selection:
    """The terms of residuals, of which intervals stood out before."""
    return TermSearch(seen, list(first), floor, float(np.median(seen.linear.sigma))).run()


def kinds(found: Selection) -> list[tuple[str, int]]:
    return [(one.kind, one.view) for one in found.findings]


def interval(start: float, stop: float, view: int = 0, axis: int = 1, by_share: bool = False) -> Interval:
    return Interval(view, axis, start, stop, 9.0, 0.1, 0.5, by_share)


class Fan(Term):
    """A bend of the columns of one image, as of an optical distortion."""

    NAME = "fan"
    NOUN, SENTENCE = "a bend of the columns", "columns of {image} are bent by {size:.2f} px"

    @classmethod
    def propose(cls, residuals: Residuals, interval: Interval) -> list[Fan]:
        rows = np.flatnonzero(residuals.linear.view == interval.view)
        u = 2.0 * residuals.place[0, rows] / residuals.size[0, interval.view] - 1.0
        columns = in_both_coordinates(residuals, rows, (u**2 - 1.0 / 3.0)[None])
        return [cls(interval.view, columns, np.ones(2), SIZE_PRICE + np.log(residuals.linear.choices))]


@pytest.mark.slow
def test_a_new_term_is_one_class_and_one_row_of_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is proposed, beats those that resemble it and is recorded; without it they are taken in its place."""

    def bent(of: Any, at: Any) -> Any:
        return DIRECTION * 1.5 * ((2.0 * at[0] - 1.0) ** 2 - 1.0 / 3.0) * (of == 1)

    seen = residuals_of(bent)
    middle = Interval(1, 0, *(share * float(seen.size[0, 1]) for share in (0.25, 0.75)), 9.0, 0.1, 0.5, False)
    assert "fan" not in dict(kinds(searched(seen, middle)))
    monkeypatch.setitem(terms.TERMS, "fan", Fan)
    found = searched(seen, middle)
    assert kinds(found) == [("fan", 1)]
    (one,) = found.findings
    np.testing.assert_allclose(one.unknowns, 1.5 * DIRECTION[:, 0], atol=0.15)
    assert one.runner_up in terms.TERMS
    assert terms.TERMS[one.kind].SENTENCE.format(image="b", size=1.5) == "columns of b are bent by 1.50 px"


# --- what is named ----------------------------------------------------------------------------------------------------


@pytest.mark.landing(3)
@pytest.mark.parametrize("seed", rest_slow([1, 2]))
@pytest.mark.parametrize(
    ("view", "axis", "start", "stop"), [(0, 1, 0.8, 1.1), (1, 1, 0.4, 0.6), (2, 0, 0.25, 0.4)], ids=str
)
def test_a_step_is_found_with_its_ends_between_the_tie_points(request, view, axis, start, stop, seed) -> None:
    if (view, seed) == (2, 1):
        request.applymarker(known("the runner-up is a step of another image"))
    seen = residuals_of(step(1.0, view, start, stop, axis), seed=seed)
    found = searched(seen)
    (one,) = found.findings
    assert (one.kind, one.view, one.or_of) == ("step", view, ())
    assert one.where is not None
    assert one.where[0] == axis
    at = seen.place[axis, seen.linear.view == view]
    true = (at >= start * seen.size[axis, view]) & (at < stop * seen.size[axis, view])
    inside = (at >= one.where[1]) & (at < one.where[2])
    assert (inside != true).sum() <= 2
    np.testing.assert_allclose(one.size, DIRECTION[:, 0], atol=0.13)
    assert one.gain > 100.0
    assert 0.0 < one.gap < (0.2 if axis else 0.9) * one.gain
    # an endless decay is a step to the end of its image, and no other; then rows, or detectors, of another image
    assert one.runner_up == ("decay" if stop > 1.0 else "step" if axis else "detector_line")
    assert (found.right > 0.5).mean() > 0.98  # those that were displaced, too
    assert found.step.shape == (3, seen.linear.residual.size and found.step.shape[1])


@pytest.mark.parametrize("seed", rest_slow([1, 2]))
@pytest.mark.parametrize(("view", "origin", "length"), [(2, 0.4, 0.2), (0, 0.5, -0.15)], ids=str)
def test_a_decay_is_found_with_its_origin_length_and_sign(view, origin, length, seed) -> None:
    seen = residuals_of(decay(3.0, view, origin, length), seed=seed)
    (one,) = searched(seen).findings
    assert (one.kind, one.view) == ("decay", view)
    assert one.where is not None
    assert one.where[3] == pytest.approx(origin * 20000, abs=200)
    assert 1.0 / (one.where[4] * 20000) == pytest.approx(length, rel=0.12)
    np.testing.assert_allclose(one.size, 3.0 * DIRECTION[:, 0], rtol=0.06)


@pytest.mark.nightly
@pytest.mark.parametrize("length", [0.05, -0.05])
def test_a_transient_of_all_images_is_one_term_of_its_rate_and_a_record_a_view(length) -> None:
    seen = residuals_of(transient(6.0, length), views=4, tracks=200)
    found = searched(seen)
    assert [(one.kind, one.view) for one in found.findings] == [("transient", v) for v in range(4)]
    for one in found.findings:
        assert one.where is not None
        assert one.where[3:] == pytest.approx((0.0 if length > 0 else 20000.0, 1.0 / (length * 20000)), rel=0.05)
    # what all images have in common is the ground's
    assert max(float(np.hypot(*one.size)) for one in found.findings) == pytest.approx(6.0, rel=0.15)
    assert (found.right > 0.5).mean() > 0.98


def test_a_sinusoid_is_found_with_its_image_period_and_amplitude() -> None:
    for seed in (1, 2):
        (one,) = searched(residuals_of(sinusoid(0.4, 1, 20.0), seed=seed)).findings
        assert (one.kind, one.view, one.where, one.or_of) == ("sinusoid", 1, None, ())
        assert one.period == pytest.approx(1000.0, abs=6.0)
        np.testing.assert_allclose(one.size, 0.4 * DIRECTION[:, 0], atol=0.05)
    (one,) = searched(residuals_of(sinusoid(0.5, 1, 20.0), views=2, tracks=300, seed=2)).findings
    assert (one.view, one.runner_up) == (1, "sinusoid")  # of a pair the part across epipolar lines is seen
    assert 0.4 < np.hypot(*one.size) < 0.52


def test_of_a_part_and_the_rest_of_an_image_the_smaller_is_displaced() -> None:
    for part in (0.1, 0.2):
        seen = residuals_of(step(3.0, 1, part, 1.1), views=2, tracks=300)
        (one,) = searched(seen, interval(0.0, 20000 * part, 1)).findings
        assert one.kind == "step"
        assert one.where is not None
        assert one.where[1:3] == pytest.approx((-20000.0, 20000 * part), abs=100.0)


WORLDS: dict[str, tuple[tuple[Displacement, ...], int, dict[tuple[str, int], float]]] = {
    "columns and a sinusoid": (
        (step(1.9, 2, 0.77, 0.97, 0), sinusoid(0.27, 2, 20.0)), 21, {("sinusoid", 2): 0.27, ("step", 2): 1.9},
    ),
    "a decay and columns": (
        (decay(3.8, 0, 0.64, 0.1), step(1.1, 2, 0.43, 0.63, 0)), 12, {("decay", 0): 3.8, ("step", 2): 1.1},
    ),
    "two of one image": (
        (step(1.9, 1, 0.71, 0.91, 0), decay(1.8, 1, 0.46, 0.1)), 4, {("decay", 1): 1.8, ("step", 1): 1.9},
    ),
    "rows": ((step(1.4, 0, 0.54, 0.75), step(2.0, 2, 0.8, 1.1)), 2, {("step", 0): 1.4, ("step", 2): 2.0}),
}  # fmt: skip
"""What is displaced, the seed of the block, and what is to be named, with its size [px]."""


@pytest.mark.landing(1)
@pytest.mark.parametrize("world", rest_slow(WORLDS))
def test_terms_are_named_that_together_explain_most_though_another_does_by_itself(sized, world: str) -> None:
    """They are found among rivals of the best: without rivals other images are named."""
    moved, seed, truth = WORLDS[world]
    seen = residuals_of(*moved, seed=seed)
    found = searched(seen)
    assert sorted(kinds(found)) == sorted(truth)
    for one in found.findings:
        np.testing.assert_allclose(one.size, truth[one.kind, one.view] * DIRECTION[:, 0], rtol=0.35, atol=0.05)
        assert one.unknowns.shape == (4 if one.kind == "sinusoid" else 2,)
        assert 0.0 < one.gap <= sum(row.gain for row in found.findings) + 1e-9
    # a sample of tracks for the first choice ends at the same terms
    assert sorted(kinds(searched(replace(seen, few=seen.linear.thinned(110))))) == sorted(truth)
    sized(rivals=1)
    alone = searched(seen)
    assert sorted(kinds(alone)) != sorted(truth)
    assert sum(one.gain for one in alone.findings) < sum(one.gain for one in found.findings)


@pytest.mark.slow
@pytest.mark.costs(4)
@pytest.mark.landing(1)
@pytest.mark.few(1)
@pytest.mark.parametrize("seed", [41, 43, 5, 9, 13])
def test_lines_lost_in_two_of_four_views_are_given_back_to_both(seed: int) -> None:
    """Tens of pixels of two images, with cameras of other code: rows of two others would explain most ties as well."""
    world = make("lost", seed)
    adjusted = adjust_tracks(world.views, world.tracks, DEM_AS_STATED, world.gcps, world.dem)
    first, second = sorted(world.plan.injected, key=lambda one: one.views)
    assert [(one.kind, one.view) for one in sorted(adjusted.findings, key=lambda one: one.view)] == [
        ("lines_lost", *first.views), ("lines_lost", *second.views)
    ]  # fmt: skip
    judged = judge(world, adjusted.sensors)
    assert max(*judged.p99, judged.hit) < 0.06


@pytest.mark.slow
def test_a_jump_whose_rows_a_pair_hardly_observes_is_no_number_of_lines() -> None:
    """A jump of 2.8 px across epipolar lines is as well one of 156 +- 4 rows: of these one is near a whole number."""
    world = make("local", 0)
    found = adjust_tracks(world.views, world.tracks, DEM_AS_STATED)
    assert [one.kind for one in found.findings] == ["step"]
    assert judge(world, found.sensors).left < 0.02


@pytest.mark.parametrize("outliers", rest_slow([0.1, 0.0]))
def test_nothing_is_found_in_sound_residuals_though_intervals_are_asked_about(outliers) -> None:
    found = searched(residuals_of(outliers=outliers), interval(4000.0, 8000.0, 1), interval(0.0, 1000.0, by_share=True))
    assert found.findings == ()
    assert found.step.size == found.right.size == 0


def test_errors_that_neighbours_share_are_no_term_and_hide_none() -> None:
    assert kinds(searched(residuals_of(cell_errors(0.3, 1), tracks=400), interval(4000.0, 8000.0, 1))) == []
    assert kinds(searched(residuals_of(STEP, cell_errors(0.2, 0), tracks=300))) == [("step", 1)]


@pytest.mark.nightly
def test_a_sinusoid_or_a_motion_is_taken_from_two_and_a_half_floors_on() -> None:
    """The same residuals, of a sinusoid of 0.16 px and of ground that moved, and floors below and above."""
    seen = residuals_of(sinusoid(0.16, 1, 20.0), tracks=400)
    (one,) = searched(seen).findings
    size = float(np.hypot(*one.size))
    assert size == pytest.approx(0.16, abs=0.02)
    assert kinds(searched(seen, floor=size / 2.6)) == [("sinusoid", 1)]
    assert ("sinusoid", 1) not in kinds(searched(seen, floor=size / 2.4))
    assert kinds(searched(seen, floor=size / 1.7)) == []
    moved, _ = moving()
    assert ("moving_objects", -1) in kinds(searched(moved, interval(10000.0, 20000.0, 1), floor=0.2))
    assert ("moving_objects", -1) not in kinds(searched(moved, interval(10000.0, 20000.0, 1), floor=3.0))


@once
def moving(*beside: Displacement) -> tuple[Residuals, np.ndarray]:
    """Residuals of a block of which a tenth of the ground moves by 2 m; the observations there."""
    made, tracks, moves = drifting(3, 300, 0.1, 2.0)
    block = join(made.views, tracks, None, AdjustOptions())
    return residuals_at(block, *beside), moves[block.order]


def test_ground_that_moves_is_the_last_term_and_no_camera_follows_it() -> None:
    seen, moves = moving()
    found = searched(seen, interval(10000.0, 20000.0, 1))
    (one,) = found.findings
    assert (one.kind, one.view, one.where, one.gap > 100.0) == ("moving_objects", -1, None, True)
    assert one.moved is not None
    np.testing.assert_array_equal(one.moved.member, moves)
    np.testing.assert_array_equal(found.step, seen.base.step)  # cameras, and what is right, are as without it
    np.testing.assert_array_equal(found.right, seen.base.right)


@pytest.mark.slow
def test_ground_that_moves_is_found_beside_a_sinusoid_and_the_cameras_are_those_of_the_sinusoid() -> None:
    both, moves = moving(sinusoid(1.0, 1, 20.0))
    found = searched(both, interval(10000.0, 20000.0, 1))
    assert [one.kind for one in found.findings] == ["sinusoid", "moving_objects"]
    assert found.findings[1].moved is not None
    assert (found.findings[1].moved.member == moves).mean() > 0.99
    assert np.abs(found.step - both.base.step).max() > 0.0  # as with the sinusoid alone
    assert (found.right[~moves] > 0.5).mean() > 0.98


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ((0, 10), (0, 19), True),  # more than half of both together is common
        ((0, 10), (0, 20), False),
        ((3, 13), (0, 10), True),
        ((4, 14), (0, 10), False),
        ((0, 10), (11, 12), False),
    ],
)
def test_intervals_are_the_same_whose_most_is_common(one, other, same) -> None:
    assert _overlap(interval(*one), interval(*other)) == _overlap(interval(*other), interval(*one)) == same
    assert not _overlap(interval(*one), interval(*other, view=1))
    assert not _overlap(interval(*one), interval(*other, axis=0))
    rows = [interval(*one), interval(*other), interval(50, 60)]
    assert _without_overlaps(rows) == ([rows[0], rows[2]] if same else rows)


@pytest.mark.parametrize(("seed", "also"), [(2, (0,)), (1, ())])
def test_a_sinusoid_of_a_pair_may_be_that_of_the_other_where_the_evidence_is_no_surer(seed: int, also: Any) -> None:
    (one,) = searched(residuals_of(sinusoid(0.11, 1, 20.0), views=2, tracks=300, seed=seed), floor=0.03).findings
    assert (one.kind, one.view, one.or_of) == ("sinusoid", 1, also)
    assert (one.gap < SURE) == bool(also)


@once
def combined(*rows: tuple[str, int, float]) -> _SearchState:
    """A combination of terms, each of a kind and view, with what it gains."""
    seen = residuals_of(tracks=30)
    taken = tuple(_SelectedTerm(placed(kind, view), gain, 1.0, "", (), seen) for kind, view, gain in rows)
    return _SearchState(seen, taken)


def placed(kind: str, view: int = 0) -> Term:
    none = np.zeros((2, 2, len(residuals_of(tracks=30).linear.view)))
    return TERMS[kind](view, none, np.full(2, 0.5), 0.0, (1, 2.0, 5.0, 0.0, 0.0))


@pytest.mark.nightly
def test_a_combination_ends_with_six_terms_or_moving_ground_and_another_goes_on_that_may_pass_it() -> None:
    base = combined().seen.base
    for count, kind, ended in ((4, "step", False), (5, "step", True), (0, "moving_objects", True)):
        found = combined(*[("step", 0, 9.0)] * count).with_best_of([(placed(kind), base, 20.0)])
        assert (found.ended, found.gain) == (ended, 9.0 * count + 20.0)
    # as many more as the other has and two, none gaining more than the last
    for best, may in (((60.0, 59.0), True), ((60.0, 60.0), False)):
        assert combined(("step", 0, 30.0)).may_pass(combined(*[("step", 0, gain) for gain in best])) == may
    # as many more as six terms are, none gaining more than the best: 30 + 20 + 4 x 30
    for noise, may in ((169.0, True), (170.0, False)):
        assert combined(("step", 0, 30.0), ("step", 0, 20.0)).may_exceed(noise) == may
    best, other = combined(("sinusoid", 1, 60.0)), combined(("decay", 0, 30.0))
    for beside, adds in ((30.0 - SURE + 0.1, True), (30.0 - SURE, False)):  # beside the best: no other way
        assert other.complements(best, [(placed("decay"), base, beside), (placed("step"), base, 90.0)]) == adds
    assert not other.complements(best, [(placed("decay", 1), base, 40.0)])
    behind = combined(("step", 2, 50.0), ("decay", 0, 30.0))
    assert not behind.complements(best, [(placed("decay"), base, 30.0)])  # what went before is another
    assert behind.complements(combined(("step", 2, 50.0), ("sinusoid", 1, 60.0)), [(placed("decay"), base, 30.0)])
    for rival, gap in ((0.5, 19.5), (-3.0, 20.0)):  # over nothing, where the runner-up is worse
        (row,) = combined().with_best_of([(placed("step"), base, 20.0), (placed("decay", 1), base, rival)]).taken
        assert row.gap == gap


# --- of a block that was solved ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Solved:
    block: Block
    outcome: Outcome


@once
def solved(*moved: Displacement, views: int = 3, tracks: int = 250) -> Solved:
    made = simulate_block(views, tracks, seed=3, attitude=1e-6, position=0.2)
    size = np.array([view.size for view in made.views], dtype=np.float64)
    at = (made.tracks.xy / size[made.tracks.view]).T
    away = sum((one(made.tracks.view, at) for one in moved), np.zeros((2, 1)))
    options = AdjustOptions()
    block = join(made.views, replace(made.tracks, xy=made.tracks.xy + away.T), None, options)
    none = block.without(np.ones(len(block.view), dtype=bool))
    return Solved(block, solve_block(block, none, options, None, None, None).outcome)


def test_rows_that_stand_out_are_said_in_pixels_from_the_floor_on_and_looked_for_once() -> None:
    one = solved(STEP)
    found = anomalies.significant_intervals(one.outcome, one.block, FLOOR)
    assert found
    assert found[0].view == 1
    assert (found[0].start, found[0].stop) == pytest.approx((8000.0, 12000.0), abs=600.0)
    assert all(row.gain > SURE for row in found)
    assert anomalies.significant_intervals(one.outcome, one.block, FLOOR) is found
    means = [row for row in anomalies.significant_intervals(one.outcome, one.block, 0.0) if not row.by_share]
    assert all(0.0 < row.off < 2.1 for row in means)  # no more than what is displaced
    assert not [row for row in anomalies.significant_intervals(one.outcome, one.block, 3.0) if not row.by_share]
    sound = solved()
    assert anomalies.significant_intervals(sound.outcome, sound.block, FLOOR) == []
    assert anomalies.unexplained_intervals(sound.outcome, sound.block, FLOOR) == []
    # what was cut there lies off by what it is displaced, as the tracks of the others see it
    left = anomalies.unexplained_intervals(one.outcome, one.block, FLOOR)
    apart = [row.apart for row in left if row.by_share and row.view == 1]
    assert apart
    assert 0.8 < max(apart) < 2.2


def test_periods_and_errors_that_neighbours_share_are_measured_by_the_ties_that_were_kept() -> None:
    one, sound, shared = solved(SWING), solved(), solved(cell_errors(0.3, 1), tracks=400)
    (period,) = [row for row in anomalies.periods_of(one.outcome, one.block) if row.view == 1]
    assert period.period == pytest.approx(1000.0, abs=6.0)
    assert anomalies.periods_of(sound.outcome, sound.block) == []
    assert anomalies.correlated_noise_gain(sound.outcome, sound.block) < 2.0
    assert anomalies.correlated_noise_gain(shared.outcome, shared.block) > 50.0
    # means of cells are none of an image's part
    means = anomalies.significant_intervals(shared.outcome, shared.block, FLOOR)
    gain = anomalies.correlated_noise_gain(shared.outcome, shared.block)
    expected = [row for row in means if row.by_share or row.gain > gain]
    assert len(anomalies.unexplained_intervals(shared.outcome, shared.block, FLOOR)) == len(expected)


def test_of_n_views_two_n_less_three_residuals_of_a_track_are_free_of_what_neighbours_share() -> None:
    """Tracks of two views have one of four; what is no outlier, and right, counts."""
    rng = np.random.default_rng(0)
    place, view, size = rng.uniform(0, 1000, (2, 600)), np.arange(600) % 3, np.full((2, 3), 1000.0)
    off = cell_errors(2.0, 1)(view, place / 1000.0) + rng.normal(0, 1, (2, 600))
    right = rng.random(600) < 0.9
    used = right & (np.hypot(*off) < 5.0)
    whole = float(log_ratio_by_image(view[used], place[:, used], size, off[:, used]).sum())
    assert whole > 30.0
    for many, track in ((3, np.arange(600) // 3), (2, np.arange(600) // 2)):
        found = anomalies.correlated_log_ratio(view, place, size, off, right, track)
        free = 1.0 - 1.5 * len(np.unique(track[used])) / used.sum()
        assert found == pytest.approx(free * whole)
        assert 0.0 < free < 1.0 - 1.5 / many + 1e-9
    assert anomalies.correlated_log_ratio(view, place, size, off, np.zeros(600, dtype=bool), track) == 0.0


def test_what_was_cut_is_seen_where_two_others_tell_its_point() -> None:
    block: Any = SimpleNamespace(point=np.array([0, 0, 0, 1, 1, 2]), num_points=4)
    outcome: Any = SimpleNamespace(inlier=np.array([True, True, False, True, False, True]))
    np.testing.assert_array_equal(anomalies._confirmed_observations(outcome, block), [1, 1, 1, 0, 0, 0])


def test_a_block_is_searched_where_rows_or_else_a_period_stand_out_and_up_to_a_size(sized) -> None:
    for moved, named in ((STEP, [("step", 1)]), (SWING, [("sinusoid", 1)])):
        one = solved(moved)
        found = search_terms(one.outcome, one.block, FLOOR)
        assert kinds(found) == named
        assert found.right.shape == one.block.view.shape
        assert found.step.shape[0] == 3
    sound = solved()
    assert kinds(search_terms(sound.outcome, sound.block, FLOOR)) == []
    most = {"unknowns_searched": one.outcome.problem.free.size, "observations_searched": len(one.block.view)}
    for limit in most:
        sized(**most)
        assert kinds(search_terms(one.outcome, one.block, FLOOR)) == named
        sized(**{limit: most[limit] - 1})
        assert search_terms(one.outcome, one.block, FLOOR).findings == ()


@pytest.mark.nightly
def test_a_large_block_is_searched_among_the_neighbours_of_each_view_that_stands_out(sized) -> None:
    """The same terms as of the whole block, under its numbers, and nothing of views far away."""
    one = solved(step(2.0, 1, 0.4, 0.6), sinusoid(0.6, 4, 20.0), views=6, tracks=300)
    whole = search_terms(one.outcome, one.block, FLOOR)
    assert sorted(kinds(whole)) == [("sinusoid", 4), ("step", 1)]
    a_view = one.outcome.problem.free.size // 6
    sized(unknowns_together=4 * a_view, views_together=3)
    found = search_terms(one.outcome, one.block, FLOOR)
    assert sorted(kinds(found)) == [("sinusoid", 4), ("step", 1)]
    for kind in ("step", "sinusoid"):
        a, b = (next(row for row in of.findings if row.kind == kind) for of in (whole, found))
        np.testing.assert_allclose(a.size, b.size, atol=0.15)
    assert found.step.shape == (6, a_view)
    assert found.right.shape == one.block.view.shape
    sound = search_terms(solved(views=6, tracks=300).outcome, solved(views=6, tracks=300).block, FLOOR)
    assert (sound.findings, sound.step.size) == ((), 0)


def tied(pairs: list[tuple[int, int]], views: int) -> Any:
    """A block of tracks of two views each."""
    point = np.repeat(np.arange(len(pairs)), 2)
    return SimpleNamespace(
        views=[None] * views, view=np.array(pairs).ravel(), point=point, num_points=len(pairs),
        num_tracks=len(pairs), use=np.ones(len(point), dtype=bool),
    )  # fmt: skip


def test_a_view_is_searched_among_those_that_share_most_tracks_with_it() -> None:
    block = tied([(0, v) for v in range(1, 15) for _ in range(v)], 16)
    assert search._neighbour_views(block, 0).tolist() == [0, *range(4, 15)]
    assert search._neighbour_views(block, 3).tolist() == [0, 3]
    unused = tied([(0, 1), (0, 1), (0, 2), (1, 2)], 4)
    assert search._neighbour_views(unused, 0).tolist() == [0, 1, 2]
    unused.use[[4, 5]] = False  # its track with view 2
    assert search._neighbour_views(unused, 0).tolist() == [0, 1]
    control = tied([(0, 1), (0, 2)], 3)
    control.num_tracks = 1
    assert search._neighbour_views(control, 0).tolist() == [0, 1]


def test_terms_among_some_views_are_those_of_the_block() -> None:
    step = np.zeros((5, 2))
    step[3] = 7.0
    all_of = Selection(("first",), step, np.ones(6))  # type: ignore[arg-type]
    found = Finding("sinusoid", 1, None, np.zeros(2), 9.0, 1.0, "", np.zeros(4), 30.0, (0, 2))
    own = Selection((found,), np.arange(6.0).reshape(3, 2) + 1.0, np.array([0.1, 0.2]))
    both = search._with_findings(all_of, own, np.array([1, 3, 4]), np.array([2, 5]))
    assert both.findings[0] == "first"
    assert (both.findings[1].view, both.findings[1].or_of) == (3, (1, 4))
    # of a view that was searched before the first is kept
    np.testing.assert_array_equal(both.step, [[0, 0], [1, 2], [0, 0], [7, 7], [5, 6]])
    np.testing.assert_array_equal(both.right, [1, 1, 0.1, 1, 1, 0.2])
    np.testing.assert_array_equal(all_of.right, 1.0)
    assert (all_of.step[[1, 4]] == 0).all()


def test_tie_points_among_some_views_are_linearised_where_they_are_not_too_many(sized) -> None:
    one = solved(views=6, tracks=300)
    views = np.array([1, 2, 4])
    found = linearised_among(one.outcome, one.block, views)
    assert found is not None
    linear, _ = found
    rows = np.unique(np.concatenate([tracks.rows.ravel() for tracks in linear.tracks]))
    count = np.bincount(one.block.point[np.isin(one.block.view, views)], minlength=one.block.num_points)
    expected = np.isin(one.block.view, views) & (count[one.block.point] >= 2)
    np.testing.assert_array_equal(rows, np.flatnonzero(expected))
    a_view = one.outcome.problem.free.size // 6
    sized(unknowns_together=3 * a_view)
    assert linearised_among(one.outcome, one.block, views) is not None
    assert linearised_among(one.outcome, one.block, np.arange(4)) is None
    control = replace(one.block, use=one.block.use & False)  # an image alone by its control: no tie points to search
    assert linearised_among(one.outcome, control, views) is None
    sized(elements_linearised=1)
    assert linearised_among(one.outcome, one.block, views) is None


def test_a_mixture_that_cannot_be_solved_has_no_terms_and_says_so(monkeypatch, caplog) -> None:
    def fails(*_: Any, **__: Any) -> None:
        raise np.linalg.LinAlgError("not positive definite")

    monkeypatch.setattr(search, "fit_mixture", fails)
    one = solved(STEP)
    assert search_terms(one.outcome, one.block, FLOOR).findings == ()
    assert "not explained" in caplog.text
