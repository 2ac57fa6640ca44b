"""The search for explanations: what are rivals, what is the same, what ends it, by made-up gains."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba.evidence.mixture import MixtureFit
from barpc.ba.evidence.scan import Interval
from barpc.ba.select import anomalies, beam
from barpc.ba.select import search as searching
from barpc.ba.select.beam import Selection, TermSearch, _of_one_image, _rivals, _same, _SearchState, _Taken, _uncovered
from barpc.ba.select.search import _neighbour_views, _with_findings
from barpc.ba.terms import TERMS, Transient
from barpc.ba.terms.decay import Decay
from barpc.ba.terms.sinusoid import _amplitude
from barpc.ba.terms.step import Step
from barpc.ba.terms.term import Finding, Residuals, Term
from barpc.base.statistics import SURE

VIEW = np.array([0, 0, 0, 0, 1, 1])


def interval(start: float, stop: float, view: int = 0, axis: int = 1, by_share: bool = False) -> Interval:
    return Interval(view, axis, start, stop, 9.0, 0.1, 0.5, by_share)


def explained(kind: str, view: int = 0, start: float = 0.0, stop: float = 9.0, **given: Any) -> Term:
    """An explanation of two unknowns that moves the observations 0, 1, .. of `rows`, the first by default."""
    extra = np.zeros((2, 2, len(VIEW)))
    extra[1, 1, given.pop("rows", [0])] = 1.0
    where = None if kind in ("sinusoid", "moving_objects") else (given.pop("axis", 1), start, stop, 0.0, 0.0)
    return TERMS[kind](view, extra, np.full(2, 0.5), given.pop("price", 0.0), where, **given)


def fitted(evidence: float = 0.0, extra: Any = (), **given: Any) -> MixtureFit:
    n = len(VIEW)
    return replace(MixtureFit(evidence, np.zeros((2, 3)), np.array(extra), 1.0, np.zeros(2), np.ones(n)), **given)


def seen() -> Residuals:
    linear: Any = SimpleNamespace(view=VIEW, sigma=np.ones(len(VIEW)))
    other: Any = SimpleNamespace(view=VIEW)
    nothing: Any = None
    return Residuals(
        linear, other, nothing, np.zeros((2, 6)), np.ones((2, 2)), fitted(), np.zeros((2, 0, 6)), np.zeros(0)
    )


def taken(gain: float, kind: str = "step", view: int = 0, gap: float = 1.0) -> _Taken:
    return _Taken(explained(kind, view), gain, gap, "", (), seen())


# --- intervals and explanations that are the same ---------------------------------------------------------------------


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
    assert _same(interval(*one), interval(*other)) == _same(interval(*other), interval(*one)) == same
    assert not _same(interval(*one), interval(*other, view=1))
    assert not _same(interval(*one), interval(*other, axis=0))


def test_of_intervals_that_are_the_same_the_first_stays() -> None:
    rows = [interval(0, 10), interval(0, 12), interval(50, 60), interval(1, 10), interval(49, 61)]
    assert _uncovered(rows) == [rows[0], rows[2]]


def test_explanations_differ_by_kind_view_axis_and_rows_that_do_not_overlap() -> None:
    one = explained("step", 0, 2.0, 5.0)
    assert not one.differs(explained("step", 0, 4.9, 9.0))
    assert not explained("step", 0, 4.9, 9.0).differs(one)
    assert one.differs(explained("step", 0, 5.0, 9.0))
    assert explained("step", 0, 5.0, 9.0).differs(one)
    assert one.differs(explained("step", 0, 2.0, 5.0, axis=0))
    assert one.differs(explained("step", 1, 2.0, 5.0))
    assert one.differs(explained("decay", 0, 2.0, 5.0))
    assert not explained("sinusoid").differs(explained("sinusoid"))
    assert explained("sinusoid").differs(explained("sinusoid", 1))
    assert not replace(one, where=None).differs(one)
    assert not one.differs(replace(one, where=None))


def test_a_part_and_its_complement_are_of_one_image() -> None:
    strip, fade, swing = explained("step"), explained("decay"), explained("sinusoid")
    assert _of_one_image(strip, fade)
    assert _of_one_image(fade, explained("step"))
    assert _of_one_image(swing, swing)
    assert not _of_one_image(swing, explained("sinusoid"))
    assert not _of_one_image(strip, swing)
    assert not _of_one_image(swing, strip)
    assert not _of_one_image(strip, explained("decay", 1))


def test_a_part_is_counted_in_observations_of_its_image_or_of_all() -> None:
    assert explained("step", 0, rows=[0, 1, 2, 4]).share(seen()) == pytest.approx(3 / 4)
    assert explained("step", 1, rows=[0, 4]).share(seen()) == pytest.approx(1 / 2)
    assert explained("transient", -1, rows=[0, 4]).share(seen()) == pytest.approx(2 / 6)
    assert explained("step", 7, rows=[0]).share(seen()) == 0.0


def test_a_swing_s_amplitude_is_that_of_a_cosine_and_a_sine_each_in_columns_and_rows() -> None:
    np.testing.assert_allclose(_amplitude(np.array([3.0, -4.0, 5.0, 12.0])), [5.0, 13.0])


def test_rivals_are_the_best_of_other_kinds_or_images_with_more_than_a_third_of_the_gain() -> None:
    def of(*rows: tuple[Term, float]) -> list[int]:
        return _rivals([(one, fitted(), gain) for one, gain in rows])

    first = (explained("step", 0, 0.0, 5.0), 30.0)
    assert of(first) == []
    assert of(first, (explained("decay"), 10.0)) == []
    assert of(first, (explained("decay"), 10.1)) == [1]
    assert of(first, (explained("step", 0, 1.0, 6.0), 29.0), (explained("step", 0, 5.0, 6.0), 28.0)) == [2]
    assert of(
        first,
        (explained("moving_objects", -1), 29.0),
        (explained("low_frequency"), 28.0),
        (explained("transient", -1), 27.0),
    ) == [3]
    assert of(first, (explained("decay"), 20.0), (explained("decay"), 19.0), (explained("decay", 1), 18.0)) == [1, 3]
    assert of(first, (explained("decay"), 20.0), (explained("sinusoid"), 19.0), (explained("decay", 1), 18.0)) == [1, 2]


# --- states -----------------------------------------------------------------------------------------------------------


def state(*gains: float, **given: Any) -> _SearchState:
    return _SearchState(seen(), fitted(), tuple(taken(gain) for gain in gains), **given)


def test_a_state_may_pass_another_with_as_many_more_as_that_has_and_two() -> None:
    assert state(50.0, 20.0).gain == 70.0
    assert state().gain == 0.0
    for best, may in (((60.0, 59.0), True), ((60.0, 60.0), False)):  # 30 and three of 30
        assert state(30.0).may_pass(state(*best)) == may
    for best, may in (((79.0,), True), ((80.0,), False)):  # 40 + 20 and one of 20
        assert state(40.0, 20.0).may_pass(state(*best)) == may


def test_what_gains_as_much_beside_the_best_is_no_other_way() -> None:
    best = _SearchState(seen(), fitted(), (taken(60.0, "sinusoid", 1),))
    other = _SearchState(seen(), fitted(), (taken(30.0, "decay"),))
    same = explained("decay")
    assert other.adds_to(best, [(same, fitted(), 30.0 - SURE + 0.1)])
    assert not other.adds_to(best, [(same, fitted(), 30.0 - SURE)])
    assert not other.adds_to(best, [(explained("decay", 1), fitted(), 40.0)])
    assert not other.adds_to(best, [(explained("step"), fitted(), 40.0)])
    assert not other.adds_to(best, [])
    assert other.adds_to(best, [(explained("step"), fitted(), 90.0), (same, fitted(), 29.0), (same, fitted(), 2.0)])
    behind = replace(other, taken=(taken(50.0, "sinusoid"), *other.taken))
    assert not behind.adds_to(best, [(same, fitted(), 30.0)])  # what went before is another
    beside = replace(best, taken=(taken(50.0, "sinusoid"), *best.taken))
    assert behind.adds_to(beside, [(same, fitted(), 30.0)])
    small = replace(other, taken=(taken(4.0, "decay"),))
    assert small.adds_to(best, [])  # of less than is sure there is always as much


@pytest.mark.parametrize(("second", "smaller"), [(25.1, True), (25.0, False)])
def test_of_two_parts_of_an_image_that_are_as_good_the_smaller_one_is_taken(second: float, smaller: bool) -> None:
    large, small = explained("step", rows=[0, 1, 2]), explained("decay", rows=[3])
    made, other = fitted(1.0), fitted(2.0)
    found = state().added([(large, made, 30.0), (small, other, second), (explained("sinusoid", 1), fitted(), 12.0)])
    last = found.taken[-1]
    assert last.term is (small if smaller else large)
    assert last.gain == (second if smaller else 30.0)
    assert last.gap == pytest.approx(second - 30.0 if smaller else 30.0 - second)
    assert last.runner_up == ("step" if smaller else "decay")
    assert found.seen.base is found.followed is (other if smaller else made)
    np.testing.assert_array_equal(found.seen.extra, last.term.columns)
    np.testing.assert_array_equal(found.seen.sigma, [0.5, 0.5])
    assert not found.ended


def test_what_is_taken_stands_behind_what_was_and_the_rest_are_its_rivals() -> None:
    before = state(40.0)
    before = replace(before, seen=replace(before.seen, extra=np.ones((2, 1, 6)), sigma=np.array([0.3])))
    one = explained("step", 1, rows=[4])
    found = before.added([(one, fitted(), 20.0), (replace(one), fitted(), 18.0)])
    assert (found.taken[0], found.taken[1].term) == (before.taken[0], one)
    assert (found.taken[1].gap, found.taken[1].runner_up) == (20.0, "")  # the same rows again are no rival
    np.testing.assert_array_equal(found.seen.extra, np.concatenate([np.ones((2, 1, 6)), one.columns], axis=1))
    np.testing.assert_array_equal(found.seen.sigma, [0.3, 0.5, 0.5])
    beaten = before.added([(one, fitted(), 20.0), (explained("sinusoid"), fitted(), -3.0)])
    assert beaten.taken[1].gap == 20.0  # over nothing, where the runner-up is worse than it
    pairs = before.added(
        [(one, fitted(), 20.0), (explained("sinusoid"), fitted(), 7.0), (explained("decay"), fitted(), 8.0)]
    )
    assert (pairs.taken[1].gap, pairs.taken[1].runner_up) == (12.0, "decay")


def test_swings_that_are_as_good_in_other_images_are_named() -> None:
    tried = [
        (explained("sinusoid", 5), fitted(), 30.0),
        (explained("sinusoid", 3), fitted(), 26.0),
        (explained("sinusoid", 2), fitted(), 25.1),
        (explained("sinusoid", 1), fitted(), 25.0),
        (explained("step", 0), fitted(), 29.0),
    ]
    assert state().added(tried).taken[0].or_of == (2, 3)
    assert state().added(tried[-1:] + tried[:1]).taken[0].or_of == ()


@pytest.mark.parametrize(
    ("kind", "before", "ended"), [("step", 4, False), ("step", 5, True), ("moving_objects", 0, True)]
)
def test_a_search_ends_with_six_or_with_what_is_not_followed(kind: str, before: int, ended: bool) -> None:
    first, made = state(*[9.0] * before), fitted(1.0)
    found = first.added([(explained(kind), made, 20.0)])
    assert found.ended == ended
    assert found.seen.base is made
    assert found.followed is (first.followed if kind == "moving_objects" else made)


# --- the search -------------------------------------------------------------------------------------------------------


def search(**given: Any) -> TermSearch:
    return TermSearch(given.pop("seen", seen()), given.pop("first", []), given.pop("floor", 0.1), 0.1)


def test_what_ends_as_best_is_sure_by_what_the_next_ones_lack(monkeypatch) -> None:
    """Where it was not the best by itself; all that are followed have their cameras and probabilities."""

    monkeypatch.setattr(_SearchState, "simplified", lambda state: state)

    def ran(*states: _SearchState) -> tuple[list[_Taken], Any]:
        monkeypatch.setattr(TermSearch, "_grown", lambda self, before: (list(states), True))
        monkeypatch.setattr(
            _SearchState,
            "findings",
            lambda self, margin: [replace(row, gap=row.gap if row.gap > 0.0 else margin) for row in self.taken],
        )
        noise = iter([shared, *beside])
        monkeypatch.setattr(beam, "_by_neighbours", lambda seen: next(noise))
        found = search().run()
        return list(found.findings), found  # type: ignore[arg-type]

    shared, beside = 41.9, [11.9]
    last, earlier = fitted(right=np.zeros(6)), fitted(step=np.ones((2, 3)))
    one = _SearchState(replace(seen(), base=last), earlier, (taken(30.0, gap=-2.0), taken(12.0, "decay", gap=3.0)))
    rows, found = ran(one, state(35.0))
    assert [row.gap for row in rows] == [7.0, 3.0]
    assert found.right is last.right
    assert found.step is last.step
    assert [row.gap for row in ran(one)[0]] == [42.0, 3.0]
    shared = 29.0
    assert [row.gap for row in ran(replace(one, taken=(taken(30.0, gap=0.0),)))[0]] == [30.0]
    moves, found = ran(replace(one, taken=(taken(30.0), taken(12.0, "moving_objects", -1))))
    assert len(moves) == 2
    assert found.step is earlier.step
    assert found.right is earlier.right
    shared, beside = 41.9, [12.0]  # beside the first it explains as much as the second: that stays out
    rows, found = ran(one)
    assert [row.gain for row in rows] == [30.0]
    shared = 42.0  # noise that neighbours share explains as much as all that was taken
    rows, found = ran(one)
    assert rows == []
    assert found.step.size == found.right.size == 0


def test_what_neighbours_share_is_asked_of_right_ties_in_stated_deviations(monkeypatch) -> None:
    """Two tracks of three views and one of two: of 16 residuals 3 + 3 + 1 are free."""
    tracks = [SimpleNamespace(rows=np.array([[0, 1, 2], [3, 4, 5]])), SimpleNamespace(rows=np.array([[6, 7]]))]
    view = np.array([0, 1, 2, 0, 1, 2, 0, 1, 2])  # the last takes no part
    linear: Any = SimpleNamespace(view=view, tracks=tracks, left=lambda step: np.zeros((2, 9)), sigma=np.ones(9))
    off, asked = np.zeros((2, 9)), list[Any]()
    monkeypatch.setattr(beam, "off_from_right", lambda *_: (off, None))

    def told(*given: Any) -> Any:
        asked.append(given)
        return np.array([8.0, 0.0, 8.0])

    monkeypatch.setattr(anomalies, "shared_errors", told)
    size = np.full((2, 3), 100.0)
    base = fitted(right=np.ones(9), noise=7.0)
    place, extra = np.arange(18.0).reshape(2, 9), np.zeros((2, 0, 9))
    one = replace(seen(), linear=linear, base=base, place=place, size=size, extra=extra)
    assert beam._by_neighbours(one) == pytest.approx(16.0 * 7 / 16)
    of_view, place, _, values = asked.pop()
    assert of_view.tolist() == view[:8].tolist()
    np.testing.assert_array_equal(place, np.arange(18.0).reshape(2, 9)[:, :8])
    assert values.shape == (2, 8)
    off[0, 6] = 5.1  # what is larger is no noise, whatever the noise of all is
    assert beam._by_neighbours(one) == pytest.approx(16.0 * (1.0 - 1.5 * 3 / 7))
    assert asked.pop()[0].tolist() == [0, 1, 2, 0, 1, 2, 1]


def grown(monkeypatch, states: list[_SearchState], *tried: list[tuple[Term, float]]) -> tuple[list[_SearchState], bool]:
    """States with one more each, where so much is tried, in turn."""
    left = [[(one, fitted(), gain) for one, gain in rows] for rows in tried]
    monkeypatch.setattr(TermSearch, "_tried", lambda self: left.pop(0))
    found = search()._grown(states)
    assert not left
    return found


def whats(states: list[_SearchState]) -> list[list[tuple[str, int]]]:
    return [[row.name for row in one.taken] for one in states]


def test_a_search_goes_on_with_the_best_and_its_rivals(monkeypatch) -> None:
    rows = [
        (explained("step"), 30.0),
        (explained("sinusoid", 1), 11.0),
        (explained("decay", 1), 9.0),
        (explained("low_frequency"), 20.0),
    ]
    found, ended = grown(monkeypatch, [state()], rows)
    assert whats(found) == [[("step", 0)], [("sinusoid", 1)]]
    assert not ended
    assert found[1].taken[0].gap == pytest.approx(11.0 - 30.0)
    many = [(explained(kind, view), 30.0 - view) for view in range(3) for kind in ("step", "sinusoid")]
    assert whats(grown(monkeypatch, [state()], many)[0]) == [[("step", 0)], [("sinusoid", 0)], [("step", 1)]]


def test_a_search_ends_where_nothing_gains_enough(monkeypatch) -> None:
    best = state(30.0)
    found, ended = grown(monkeypatch, [best, state(12.0)], [(explained("sinusoid"), SURE)])
    assert ended
    assert found[0] is best
    again, ended = grown(monkeypatch, [best], [(explained("sinusoid"), SURE + 0.1)])
    assert not ended
    assert whats(again) == [[("step", 0), ("sinusoid", 0)]]


def test_another_way_that_finds_nothing_more_has_ended(monkeypatch) -> None:
    best, other = state(30.0), _SearchState(seen(), fitted(), (taken(12.0, "sinusoid", 1),))
    found, ended = grown(monkeypatch, [best, other], [(explained("decay", 1), 10.0)], [])
    assert whats(found) == [[("step", 0), ("decay", 1)], [("sinusoid", 1)]]
    assert [one.ended for one in found] == [False, True]
    assert not ended


def test_what_has_ended_stays_and_what_may_not_pass_it_is_let_be(monkeypatch) -> None:
    best, slow = state(90.0, ended=True), _SearchState(seen(), fitted(), (taken(20.0, "sinusoid", 1),))
    found, ended = grown(monkeypatch, [best, slow])  # 20 and two of 20
    assert found == [best, slow]
    assert ended
    fast = _SearchState(seen(), fitted(), (taken(40.0, "sinusoid", 1),))
    found, ended = grown(monkeypatch, [best, fast], [(explained("decay", 1), 60.0)])
    assert whats(found) == [[("sinusoid", 1), ("decay", 1)], [("step", 0)]]
    assert not ended


def test_two_ways_with_the_same_parts_are_one_the_better(monkeypatch) -> None:
    one, other = state(30.0), _SearchState(seen(), fitted(), (taken(25.0, "sinusoid", 1),))
    found, _ = grown(monkeypatch, [one, other], [(explained("sinusoid", 1), 12.0)], [(explained("step"), 19.0)])
    assert whats(found) == [[("sinusoid", 1), ("step", 0)]]
    assert found[0].gain == 44.0


def test_a_swing_or_a_motion_below_the_floor_is_nothing() -> None:
    each = search(floor=0.1)  # of which two and a half are asked
    for size, nothing in ((0.99, True), (1.01, False)):
        parts = size * 0.25 * np.array([0.36, 0.48, 0.48, 0.64])
        assert (four().amplitude(fitted(extra=[7.0, *parts])) < each.floor * beam._SEEN) == nothing
        moving = np.array([0.6, 0.4, 0.9, 0.0, 0.0, 0.0])
        by_move = np.zeros((2, 1, 6))
        by_move[0, 0, [0, 1]], by_move[1, 0, 2] = [1.0, 50.0], 7.0  # a mean square of 25
        group: Any = SimpleNamespace(by_move=by_move)
        found = fitted(moving=moving, move=np.array([0.05 * size]))
        assert (explained("moving_objects", -1, group=group).amplitude(found) < each.floor * beam._SEEN) == nothing
        still = replace(found, moving=0.5 * np.ones(6))
        assert not (explained("moving_objects", -1, group=group).amplitude(still) < each.floor * beam._SEEN)
    assert not (explained("step").amplitude(fitted(extra=[0.0, 0.0])) < each.floor * beam._SEEN)


def test_parts_of_images_that_hold_what_moves_are_tried_beside_it(monkeypatch) -> None:
    """Of each image the best rows and columns, by what moves of the ties that take part; groups are looked for once."""
    rows, moving = np.arange(6) < 5, np.array([0.9, 0.1, 0.2, 0.3, 0.8, 0.7])
    asked: list[Any] = []
    best, second = interval(0, 5, by_share=True), replace(interval(2, 5, view=1, by_share=True), gain=30.0)
    places = [best, replace(best, gain=8.0), interval(0, 9, view=1), second, interval(0, 3, view=2)]

    def scanned(view: Any, place: Any, size: Any, wrong: Any, off: Any, told: Any) -> list[Interval]:
        asked.append((view.tolist(), place.shape, wrong.tolist(), off.shape, told.tolist()))
        return [*places, replace(interval(0, 9, view=3, by_share=True), gain=SURE)]

    def proposed(_: Any, intervals: Any, periods: Any, kinds: Any) -> Any:
        asked.append((intervals, periods, kinds))
        return (explained("step", one.view) for one in intervals)

    def groups(given: Any, where: Any) -> list[Term]:
        asked.append(where)
        return [explained("moving_objects", -1), explained("moving_objects", -2)]

    gains = {-1: 20.0, -2: SURE}
    monkeypatch.setattr(beam, "scan", scanned)
    monkeypatch.setattr(beam, "proposed", proposed)
    monkeypatch.setattr(beam.MovingObjects, "propose", groups)
    monkeypatch.setattr(TermSearch, "_refined", lambda self, made: made)

    def tried(_: Any, made: Any, more: Any) -> list[Any]:
        return [*made, *((one, fitted(moving=moving), gains.get(one.view, 1.0)) for one in more)]

    monkeypatch.setattr(TermSearch, "_with", tried)
    known = seen()
    known.linear.taking_part = rows  # type: ignore[misc]
    each = search(seen=known)
    found = each._moving([best, second], [])
    assert [(row[0].NAME, row[0].view) for row in found] == [
        ("moving_objects", -1), ("moving_objects", -2), ("step", 1), ("step", 0),
    ]  # fmt: skip
    assert asked == [
        best,
        ([0, 0, 0, 0, 1], (2, 5), moving[:5].tolist(), (2, 5), [0.0] * 5),
        ([second, best], [], [Step, Decay, Transient]),
    ]
    each._moving([second], [])
    assert asked.count(best) == 1
    assert second not in asked


def four() -> Term:
    """A swing of four unknowns."""
    return replace(explained("sinusoid"), columns=np.zeros((2, 4, 6)), sigma=np.full(4, 0.5))


def test_ends_are_looked_for_where_they_may_gain_most(monkeypatch) -> None:
    """Of three a kind, and only of what is not far behind what is sure already."""
    sharp: list[Term] = []

    def sharpened(self: TermSearch, one: Term, found: MixtureFit) -> tuple[Term, MixtureFit]:
        sharp.append(one)
        return one, replace(found, evidence=found.evidence + 1.0)

    monkeypatch.setattr(TermSearch, "_refine", sharpened)

    def of(*gains: float) -> list[int]:
        of_group: Any = {"moving_objects": {"group": "a group"}}
        kinds = ("step", "step", "step", "step", "decay", "transient", "sinusoid", "low_frequency", "moving_objects")
        rows = [
            (explained(kind, **of_group.get(kind, {})), fitted(gain), gain)
            for kind, gain in zip(kinds, gains, strict=False)
        ]
        sharp.clear()
        made = search()._refined(rows)
        assert [row[2] for row in made] == sorted((row[2] for row in made), reverse=True)
        assert sum(row[2] for row in made) == pytest.approx(sum(gains) + len(sharp))
        return [next(n for n, row in enumerate(rows) if row[0] is one) for one in sharp]

    assert of(30.0, 29.0, 28.5, 28.0, 27.0, 26.0, 25.0, 24.0, 23.0) == [0, 1, 2, 4, 5, 6, 7]
    assert of(30.0, 10.0, 9.0, 8.0, 10.1) == [0, 4]
    assert of(12.0, 5.0, 4.0, 3.0, 5.1) == [0, 4]
    assert of(5.0, 4.0, 3.0, 2.0, -2.0) == [0, 1, 2, 4]  # where nothing is sure all may be
    assert search()._refined([]) == []


def test_of_many_explanations_those_are_fitted_that_few_tracks_let_hope(monkeypatch) -> None:
    monkeypatch.setattr(beam, "fit_mixture", lambda *_: fitted(100.0))
    monkeypatch.setattr(
        TermSearch, "_fit", lambda self, one, linear=None, base=None: fitted(100.0 + one.view + one.price)
    )

    def of(*gains: int, few: bool = True) -> list[int]:
        each = search()
        each.seen = each.seen if few else replace(each.seen, few=each.seen.linear)
        return [one.view for one in each._worth_more([explained("sinusoid", gain, price=2.0) for gain in gains])]

    assert of(30, 10, 9) == [30, 10]
    assert of(5, 4, 1, -9) == [5, 4, 1, -9]  # none is sure: all are
    assert of(6, 2, 1) == [6, 2]
    assert of(30, 1) == [30, 1]
    assert of(30, 2, 1, few=False) == [30, 2, 1]


def test_a_mean_stands_out_beyond_the_floor_in_units_of_what_ties_are_known_to(monkeypatch) -> None:
    asked: list[float] = []
    monkeypatch.setattr(beam, "off_from_right", lambda linear, left, right: (left, np.zeros(len(VIEW), dtype=bool)))
    monkeypatch.setattr(beam, "scan", lambda *given: asked.append(given[-1]) or [])
    monkeypatch.setattr(beam, "find_periods", lambda *_: [])
    linear: Any = SimpleNamespace(
        view=VIEW,
        sigma=np.ones(len(VIEW)),
        taking_part=np.arange(len(VIEW)),
        left=lambda step: np.zeros((2, len(VIEW))),
    )
    each = TermSearch(replace(seen(), linear=linear), [], 0.06, 0.1)
    each._standing_out(fitted(noise=2.0), np.zeros((2, 0, len(VIEW))))
    assert asked == [pytest.approx(0.3)]  # 0.06 px of ties that are known to 0.2 px


@pytest.mark.parametrize("left", [([], []), ([1], []), ([], [1])])
def test_nothing_is_left_beside_the_best_where_neither_rows_nor_periods_stand_out(monkeypatch, left) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(TermSearch, "_standing_out", lambda self, found, extra: asked.append(extra) or left)
    one, found = explained("step"), fitted()
    assert search()._leaves_nothing([(one, found, SURE + 0.1)]) == (left == ([], []))
    np.testing.assert_array_equal(asked[0], one.columns)
    assert not search()._leaves_nothing([(one, found, SURE)])
    assert not search()._leaves_nothing([(explained("low_frequency"), found, 99.0), (one, found, 98.0)])
    assert not search()._leaves_nothing([])
    assert len(asked) == 1


def test_gains_are_over_what_is_known_less_the_price_of_a_choice() -> None:
    each = search(seen=replace(seen(), base=fitted(100.0)))
    rows = [(explained("step", price=4.0), fitted(110.0)), (explained("decay", price=1.0), fitted(109.0))]
    assert [(row[0].NAME, row[2]) for row in each._sorted(rows)] == [("decay", 8.0), ("step", 6.0)]


# --- which parts of a block are judged --------------------------------------------------------------------------------


def tied(pairs: list[tuple[int, int]], views: int) -> Any:
    """A block of tracks of two views each."""
    point = np.repeat(np.arange(len(pairs)), 2)
    return SimpleNamespace(
        views=[SimpleNamespace(size=(100, 200))] * views, view=np.array(pairs).ravel(), point=point,
        num_points=len(pairs), num_tracks=len(pairs), use=np.ones(len(point), dtype=bool),
    )  # fmt: skip


def test_a_view_is_judged_among_those_that_share_most_tracks_with_it() -> None:
    block = tied([(0, v) for v in range(1, 15) for _ in range(v)], 16)
    assert _neighbour_views(block, 0).tolist() == [0, *range(4, 15)]
    assert _neighbour_views(block, 3).tolist() == [0, 3]
    unused = tied([(0, 1), (0, 1), (0, 2), (1, 2)], 4)
    assert _neighbour_views(unused, 0).tolist() == [0, 1, 2]
    unused.use[[4, 5]] = False  # its track with view 2
    assert _neighbour_views(unused, 0).tolist() == [0, 1]
    control = tied([(0, 1), (0, 2)], 3)
    control.num_tracks = 1
    assert _neighbour_views(control, 0).tolist() == [0, 1]


def test_findings_among_some_views_are_those_of_the_block() -> None:
    step = np.zeros((5, 2))
    step[3] = 7.0
    all_of = Selection(("first",), step, np.ones(6))  # type: ignore[arg-type]
    found = Finding("sinusoid", 1, None, np.zeros(2), 9.0, 1.0, "", np.zeros(4), 30.0, (0, 2))
    own = Selection((found,), np.arange(6.0).reshape(3, 2) + 1.0, np.array([0.1, 0.2]))
    both = _with_findings(all_of, own, np.array([1, 3, 4]), np.array([2, 5]))
    assert both.findings[0] == "first"
    assert (both.findings[1].view, both.findings[1].or_of) == (3, (1, 4))
    # of a view that was judged before the first is kept
    np.testing.assert_array_equal(both.step, [[0, 0], [1, 2], [0, 0], [7, 7], [5, 6]])
    np.testing.assert_array_equal(both.right, [1, 1, 0.1, 1, 1, 0.2])
    np.testing.assert_array_equal(all_of.right, 1.0)
    assert (all_of.step[[1, 4]] == 0).all()


def judged(monkeypatch, size: int, rows: list[int], periods: list[int], views: int = 14, ties: int = 8) -> Any:
    """Which views are judged together in a block of so many unknowns; whether periods were looked for."""
    asked: list[list[int]] = []

    def among(outcome: Any, block: Any, floor: float, chosen: np.ndarray) -> Selection:
        asked.append(chosen.tolist())
        found = Finding("step", 0, None, np.zeros(2), 9.0, 1.0, "", np.zeros(2))
        n = len(chosen)
        rows = np.isin(block.view, chosen)
        return Selection((found,), np.ones((n, size // views)), np.zeros(int(rows.sum())))

    looked: list[int] = []
    monkeypatch.setattr(searching, "_searched_among", among)
    monkeypatch.setattr(searching, "standing_out", lambda *_: [interval(0, 1, view) for view in rows])
    swings = [SimpleNamespace(view=view) for view in periods]
    monkeypatch.setattr(searching, "periods_of", lambda *_: looked.append(1) or swings)
    block = tied([(v, v + 1) for v in range(0, views, 2) for _ in range(ties // 2)], views)
    outcome: Any = SimpleNamespace(problem=SimpleNamespace(free=np.ones(size)), inlier=np.ones(len(block.view), bool))
    found = searching.search_terms(outcome, block, 0.0)
    return asked, bool(looked), found


def test_a_small_block_is_judged_whole_where_rows_stand_out_or_else_a_period(monkeypatch) -> None:
    every = [[*range(14)]]
    assert judged(monkeypatch, 14 * 9, [3], [])[:2] == (every, False)
    assert judged(monkeypatch, 14 * 9, [], [3])[:2] == (every, True)
    asked, looked, found = judged(monkeypatch, 14 * 9, [], [])
    assert (asked, looked, found.findings) == ([], True, ())
    assert judged(monkeypatch, 400, [3], [])[0] == every
    assert judged(monkeypatch, 401, [3], [])[0] == [[2, 3]]


def test_a_large_block_is_judged_around_each_view_that_stands_out(monkeypatch) -> None:
    asked, looked, found = judged(monkeypatch, 14 * 40, [3, 9, 2, 3], [12, 8])
    assert asked == [[2, 3], [8, 9], [12, 13]]
    assert looked
    assert [one.view for one in found.findings] == [2, 8, 12]
    np.testing.assert_array_equal(found.step.any(axis=1), np.isin(np.arange(14), [2, 3, 8, 9, 12, 13]))
    assert found.step.shape == (14, 40)
    assert (found.right == 0.0).sum() == 3 * 8
    assert judged(monkeypatch, 12_000, [3], [], 12)[0] == [[2, 3]]
    asked, _, found = judged(monkeypatch, 12_001, [3], [3], 12)
    assert (asked, found.findings, found.step.shape) == ([], (), (0, 0))
    monkeypatch.setattr(searching, "MAX_OBSERVATIONS", 4 * 14)
    assert judged(monkeypatch, 14 * 9, [3], [])[0] == [[*range(14)]]
    monkeypatch.setattr(searching, "MAX_OBSERVATIONS", 4 * 14 - 1)
    assert judged(monkeypatch, 14 * 9, [3], [])[0] == []


def test_what_was_cut_in_an_interval_is_said_with_its_distance(monkeypatch) -> None:
    """The median of ties that are used, and finite, from the start of the interval up to its stop."""
    block = tied([(0, 1)] * 8, 2)
    n = 16
    block.xy = np.stack([np.zeros(n), np.repeat(np.arange(8.0) * 10.0, 2)])
    block.sigma, block.num_tracks = np.ones(n), 7
    inlier = np.zeros(n, dtype=bool)
    inlier[6] = True  # view 0, row 30
    block.use[8] = False  # row 40
    away = np.zeros((2, n))
    away[0, ::2], away[1, ::2] = 3.0 * np.arange(8), 4.0 * np.arange(8)  # 5 times the number
    away[0, 4] = np.nan  # row 20
    away[:, 1::2] = 1e3
    monkeypatch.setattr(anomalies, "retriangulate_rejected", lambda *_: (None, away))
    monkeypatch.setattr(anomalies, "correlated_noise_gain", lambda *_: 0.0)
    outcome: Any = SimpleNamespace(
        minimum=SimpleNamespace(state=None), problem=None, residual=None, inlier=inlier, standing_out={}
    )

    def apart(*rows: Interval) -> list[float]:
        outcome.standing_out[0.25] = list(rows)
        return [one.apart for one in anomalies.left_over(outcome, block, 0.25)]

    one = replace(interval(10.0, 60.0), by_share=True)
    assert apart(one) == [15.0]  # rows 10 and 50: the one at 60 is beyond
    assert apart(one, replace(one, start=10.1), replace(one, stop=60.1), replace(one, stop=100.0)) == [15, 25, 25, 25]
    assert apart(replace(one, start=65.0, stop=90.0), replace(one, start=20.0, stop=50.0)) == [0.0, 0.0]
    assert apart(replace(one, view=1)) == [pytest.approx(np.hypot(1e3, 1e3))]
    assert apart(interval(10.0, 60.0)) == [0.0]  # none by its share: nothing is measured
    assert apart(interval(10.0, 60.0), one) == [15.0, 15.0]
    monkeypatch.setattr(
        anomalies, "correlated_noise_gain", lambda *_: 1e9
    )  # a mean that noise of neighbours explains is none
    assert apart(interval(10.0, 60.0)) == []
    assert apart(interval(10.0, 60.0), one) == [15.0]


def test_what_was_cut_is_seen_where_two_others_tell_its_point() -> None:
    block: Any = SimpleNamespace(point=np.array([0, 0, 0, 1, 1, 2]), num_points=4)
    outcome: Any = SimpleNamespace(inlier=np.array([True, True, False, True, False, True]))
    np.testing.assert_array_equal(anomalies._confirmed_observations(outcome, block), [1, 1, 1, 0, 0, 0])


def test_what_stands_out_is_asked_and_said_in_pixels(monkeypatch) -> None:
    """A floor in standard deviations of the median tie; of what is found what gains enough."""
    asked: list[Any] = []
    found = [replace(interval(0, 1), gain=gain, off=3.0) for gain in (SURE, SURE + 0.1)]
    monkeypatch.setattr(anomalies, "scan", lambda *given: asked.append(given) or found)
    monkeypatch.setattr(anomalies, "find_periods", lambda *given: asked.append(given) or "swings")
    rows, off = np.array([0, 1, 1, 1], dtype=bool), np.arange(6.0).reshape(2, 3)
    monkeypatch.setattr(anomalies, "_whitened", lambda outcome, block: (rows if outcome and block else None, off))
    block: Any = SimpleNamespace(
        view=np.array([5, 0, 1, 1]), xy=np.arange(8.0).reshape(2, 4), sigma=np.array([9.0, 0.1, 0.25, 0.4]),
        views=[SimpleNamespace(size=(100, 200)), SimpleNamespace(size=(300, 400))],
        point=np.array([0, 1, 1, 1]), num_points=2,
    )  # fmt: skip
    outcome: Any = SimpleNamespace(inlier=np.array([1, 1, 0, 1], dtype=bool), noise=2.0, standing_out={})
    (one,) = anomalies.standing_out(outcome, block, 0.3)
    assert one.gain > SURE
    assert one.off == pytest.approx(3.0 * 0.5)
    view, place, size, wrong, seen_off, told, floor = asked[0]
    assert floor == pytest.approx(0.3 / 0.5)
    np.testing.assert_array_equal(view, [0, 1, 1])
    np.testing.assert_array_equal(place, block.xy[:, 1:])
    np.testing.assert_array_equal(size, [[100, 300], [200, 400]])
    np.testing.assert_array_equal(wrong, [0, 1, 0])
    np.testing.assert_array_equal(told, [1, 0, 1])
    assert seen_off is off
    assert anomalies.standing_out(outcome, block, 0.3)[0] is one  # looked for once
    assert len(asked) == 1
    assert anomalies.periods_of(outcome, block) == "swings"
    view, row, size, right, seen_off = asked[1]
    np.testing.assert_array_equal(row, block.xy[1, 1:])
    np.testing.assert_array_equal(right, [1, 1, 1])
    rows[:] = False
    asked.clear()
    anomalies.standing_out(outcome, block, 0.7)
    assert asked[0][-1] == pytest.approx(0.7)  # of no ties a deviation is a pixel


def test_ties_among_some_views_are_linearised_where_they_are_not_too_many(monkeypatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(searching, "retriangulate_rejected", lambda *given: asked.append(given) or ("revived", None))
    monkeypatch.setattr(searching, "linearise", lambda *given: asked.append(given) or "linear")
    block = tied([(0, 1), (1, 2), (0, 2), (0, 1)], 3)
    block.num_tracks, block.sigma, block.alt_range = 3, np.full(8, 0.5), (100.0, 450.0)
    block.use[0] = False
    problem = SimpleNamespace(free=np.ones(3 * 200))
    outcome: Any = SimpleNamespace(problem=problem, minimum=SimpleNamespace(state="s"), residual="r", inlier="i")
    assert searching.linearised_among(outcome, block, np.array([0, 1])) == ("linear", "revived")
    np.testing.assert_array_equal(asked[0][4], [0, 2, 2, 2, 2, 2, 2, 2])
    given, state, use, sigma, span = asked[1]
    assert (given is problem, state, sigma is block.sigma, span) == (True, "revived", True, 350.0)
    np.testing.assert_array_equal(use, [0, 1, 1, 0, 1, 0, 0, 0])
    assert searching.linearised_among(outcome, block, np.arange(3)) is None  # 600 unknowns
    counted = list[Any]()
    monkeypatch.setattr(searching, "array_elements", lambda count: counted.append(count.tolist()) or 3e7)
    assert searching.linearised_among(outcome, block, np.array([0, 1])) is not None
    assert counted == [[1, 1, 1]]
    monkeypatch.setattr(searching, "array_elements", lambda count: 3.1e7)
    assert searching.linearised_among(outcome, block, np.array([0, 1])) is None


def test_some_views_are_judged_under_numbers_of_their_own(monkeypatch, caplog) -> None:
    """What stands out in the others is left out; a fit that fails is no judgement."""
    block = tied([(0, 1), (1, 3), (3, 2)], 4)
    block.xy, block.sigma = np.arange(12.0).reshape(2, 6), np.array([0.1, 0.2, 0.3, 0.3, 0.4, 0.5])
    linear = SimpleNamespace(among=lambda views: SimpleNamespace(views=views, thinned=lambda most: ("few", most)))
    monkeypatch.setattr(searching, "linearised_among", lambda *_: (linear, "state"))
    parts = SimpleNamespace(of=lambda problem, state: SimpleNamespace(part=lambda rows: rows))
    monkeypatch.setattr(searching, "GroundMotion", parts)
    monkeypatch.setattr(searching, "standing_out", lambda *_: [interval(0, 1, view) for view in (3, 0, 1)])
    monkeypatch.setattr(searching, "fit_mixture", lambda linear: "base")
    asked: list[Any] = []
    monkeypatch.setattr(
        searching, "TermSearch", lambda *given: asked.append(given) or SimpleNamespace(run=lambda: "said")
    )
    outcome: Any = SimpleNamespace(problem=None)
    assert searching._searched_among(outcome, block, 0.07, np.array([1, 3])) == "said"
    ((found, first, floor, sigma),) = asked
    assert [one.view for one in first] == [1, 0]
    assert (floor, sigma, found.base, found.few) == (0.07, pytest.approx(0.3), "base", ("few", 2000))
    np.testing.assert_array_equal(found.ground, [1, 2, 3, 4])
    np.testing.assert_array_equal(found.place, block.xy[:, 1:5])
    np.testing.assert_array_equal(found.size, [[100, 100], [200, 200]])
    assert found.extra.shape == (2, 0, 4)
    assert found.sigma.shape == (0,)

    def fails(_: Any) -> None:
        raise np.linalg.LinAlgError("not positive definite")

    monkeypatch.setattr(searching, "fit_mixture", fails)
    assert searching._searched_among(outcome, block, 0.07, np.array([1, 3])).findings == ()
    assert "not explained" in caplog.text
    monkeypatch.setattr(searching, "linearised_among", lambda *_: None)
    assert searching._searched_among(outcome, block, 0.07, np.array([1, 3])).findings == ()
