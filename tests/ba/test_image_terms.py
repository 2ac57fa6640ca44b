"""Terms, splines and steps estimated with the cameras: when they are tried, what is kept, what they displace."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import AdjustOptions
from barpc.ba.constraints.block import join
from barpc.ba.parameters.additional_parameters import AdditionalParameters
from barpc.ba.robust.heldout import keep_out
from barpc.ba.select import image_terms
from barpc.ba.select.beam import Selection
from barpc.ba.select.image_terms import spline_counts, with_splines, with_terms, with_terms_beside_splines
from barpc.ba.select.parts import Parts
from barpc.ba.select.search import search_terms
from barpc.ba.solution import Solution, solve_block
from barpc.ba.terms.term import Finding
from barpc.simulate import simulate_block
from tests.ba.residuals import DIRECTION, Displacement, cell_errors, sinusoid, step
from tests.costs import once
from tests.lanes import rest_slow

# --- how many splines -----------------------------------------------------------------------------------------------


def views_of(*counts: int, rows: int = 20000, unused: int = 0) -> Any:
    """A block of views with so many observations each, of which the first ones are not used."""
    view = np.repeat(np.arange(len(counts)), counts)
    sizes = [SimpleNamespace(size=(5000, rows - 10 * v)) for v in range(len(counts))]
    return SimpleNamespace(views=sizes, view=view, use=np.arange(len(view)) >= unused)


@pytest.mark.parametrize(
    ("options", "waves", "counts"),
    [
        ({}, True, [13, 19, 28, 42, 63, 94, 100]),  # half as many more each time, to an observation in thirty
        ({}, False, []),
        ({"jitter": "off"}, True, []),
        ({"jitter": "off", "detectors": (9.0,)}, True, [0]),
        ({"drift": 0}, True, []),  # who has rotations stand still wants to see what they leave
        ({"drift": 0, "detectors": (9.0,)}, True, [0]),
        ({"drift": 1}, True, [13, 19, 28, 42, 63, 94, 100]),
        ({"drift": 0, "jitter": "1000"}, True, [23]),
        ({"jitter": "1001"}, False, [23]),
        ({"jitter": "999"}, False, [24]),
        ({"jitter": "100"}, False, [100]),  # an observation in thirty
        ({"jitter": "9000"}, False, [7]),  # never fewer
        ({"detectors": (9.0,)}, False, [0]),
        ({"detectors": (9.0,)}, True, [13, 19, 28, 42, 63, 94, 100]),
    ],
)
def test_splines_are_as_many_as_asked_for_or_ever_more(options, waves, counts) -> None:
    assert spline_counts(views_of(3000, 3000, 3000), AdjustOptions(**options), waves) == counts


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("counts", "expected"),
    [
        ((1319, 1320, 1e4), [13, 19, 28, 42, 44]),  # the view in the middle tells
        ((100, 1289, 1e4), [13, 19, 28, 42]),
        ((390, 390, 390), [13]),
        ((389, 389, 389), [12]),
        ((209, 209, 209), []),
        ((3000,) * 100, [13, 19, 28, 42, 60]),  # 12,000 unknowns of all
        ((3000,) * 857, [7]),
        ((3000,) * 858, []),
    ],
)
def test_a_view_needs_thirty_observations_a_spline(counts, expected) -> None:
    assert spline_counts(views_of(*map(int, counts)), AdjustOptions(), True) == expected


def test_observations_that_are_not_used_hold_no_spline() -> None:
    assert spline_counts(views_of(700, 700, unused=310), AdjustOptions(), True) == [13, 18]
    assert spline_counts(views_of(60, 60), AdjustOptions(jitter="1000"), True) == [7]


# --- what is kept, of blocks with known displacements -----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Solved:
    """A block solved with its cameras alone."""

    found: Solution
    parts: Parts
    options: AdjustOptions

    @property
    def selected(self) -> Selection:
        return search_terms(self.found.outcome, self.parts.inner, self.options.noise_floor)

    def with_terms(self) -> Solution:
        selected = self.selected
        return with_terms(replace(self.found, findings=selected.findings), selected, self.parts, self.options)

    def with_splines(self) -> Solution:
        return with_splines(self.found, self.parts, self.options)


@once
def solved(*moved: Displacement, tracks: int = 300, all_of: bool = True, **given: Any) -> Solved:
    """Three views, of which the check tracks may be displaced as the others are, or may not."""
    made, options = simulate_block(3, tracks, seed=3, attitude=1e-6, position=0.2), AdjustOptions(**given)
    block = join(made.views, made.tracks, None, options)
    out, size = keep_out(block), np.array([view.size for view in block.views], dtype=np.float64).T
    away = sum((one(block.view, block.xy / size[:, block.view]) for one in moved), np.zeros((2, 1)))
    parts = Parts(replace(block, xy=block.xy + away * (all_of | ~out)), out, np.zeros(len(out), dtype=np.int64))
    return Solved(solve_block(parts.inner, parts.outer, options, None, None, None), parts, options)


def waves_of(found: Solution) -> AdditionalParameters | None:
    return found.problem.cameras.unknowns.waves


STEP, SWING = step(2.0, 1, 0.4, 0.6), sinusoid(0.6, 1, 20.0)


@pytest.mark.parametrize("moved", rest_slow([SWING, STEP]), ids=["sinusoid", "step"])
def test_terms_that_were_found_are_estimated_with_the_cameras_and_all_ties_come_back(moved: Displacement) -> None:
    one, sound = solved(moved), solved()
    found = one.with_terms()
    (term,) = found.findings
    waves = waves_of(found)
    own = waves.steps[1, 0] if term.kind == "step" else waves.periods[1]
    np.testing.assert_array_equal(own, term.where if term.kind == "step" else [term.period])
    assert np.isinf(waves.steps[[0, 2]]).all()
    assert np.isinf(waves.periods[[0, 2]]).all()
    assert found.outcome.inlier.mean() > max(0.99, one.found.outcome.inlier.mean())
    # to check tracks a part of the rows is one of wrong matches, a sinusoid is not
    assert found.after.error < (1.0 if term.kind == "step" else 0.6) * one.found.after.error
    assert found.after.error < 1.15 * sound.found.after.error
    params = found.final.params[1, found.problem.cameras.unknowns.in_waves]
    px = np.abs(params) if term.kind == "step" else np.hypot(*params.reshape(2, 2).T)
    np.testing.assert_allclose(px, (2.0 if term.kind == "step" else 0.6) * DIRECTION[:, 0], rtol=0.25)


def test_terms_that_check_tracks_contradict_are_refused_and_those_not_asked_for_never_tried() -> None:
    one = solved(SWING, all_of=False)
    assert [term.kind for term in one.selected.findings] == ["sinusoid"]
    found = one.with_terms()
    assert found.findings == ()
    assert found.outcome is one.found.outcome
    off = solved(SWING, jitter="off")
    found = off.with_terms()
    assert found.findings  # said all the same
    assert found.outcome is off.found.outcome


@pytest.mark.nightly
def test_steps_of_all_images_are_terms_where_splines_and_detectors_leave_more() -> None:
    one = solved(STEP, step(1.5, 0, 0.1, 0.25), step(1.5, 2, 0.7, 0.85))
    found = one.with_terms()
    waves = waves_of(found)
    assert sorted(term.view for term in found.findings) == [0, 1, 2]
    assert waves.count == 0
    assert found.outcome.inlier.mean() > 0.99


@dataclass
class Ended:
    """A solution by its name, and how well check tracks are met."""

    name: str
    after: int
    findings: tuple[Any, ...] = ()
    outcome: Any = None
    asked: tuple[str, ...] = ()


@pytest.mark.parametrize(
    ("kinds", "whole", "axis", "kept"),
    [
        ({0: "step", 1: "step"}, 1, 1, "tried"),  # one image stands still: it is seen against that
        ({0: "step", 1: "step"}, 1, 0, "tried"),  # of columns, too: a line of detectors is a term
        ({0: "step", 1: "step", 2: "decay"}, 1, 1, "found"),  # of all images: what is of images as a whole competes
        ({0: "step", 1: "step", 2: "decay"}, 3, 1, "tried"),
        ({0: "sinusoid", 1: "sinusoid"}, 1, 1, "found"),
        ({0: "sinusoid"}, 1, 1, "tried"),
    ],
)
def test_terms_of_all_images_compete_with_splines_and_detectors(monkeypatch, kinds, whole, axis, kept) -> None:
    """Of three images; the less, the better are check tracks met: 9 without terms, 2 with them, `whole` by splines."""
    terms: Any = [SimpleNamespace(kind=kind, view=v, where=(axis,), moved=None, gain=9.0) for v, kind in kinds.items()]
    for name, value in (
        ("_layout_of", None), ("_at_selection", Ended("found", 9)), ("_solve_with", Ended("tried", 2)),
        ("with_splines", Ended("whole", whole)), ("significant_intervals", []),
    ):  # fmt: skip
        monkeypatch.setattr(image_terms, name, lambda *_, value=value: value)
    monkeypatch.setattr(image_terms, "is_better", lambda one, other, outer: one < other)
    monkeypatch.setattr(image_terms, "is_admitted", lambda one, other, outer, gain: not other < one)
    parts: Any = SimpleNamespace(inner=views_of(300, 300, 300), outer=None)
    found: Any = with_terms(Ended("found", 9), Selection(tuple(terms)), parts, AdjustOptions())
    assert found.name == kept


def shaken(px: float, waves: float) -> Displacement:
    """All images, each with a phase of its own."""
    return lambda of, at: (
        px * np.stack([np.sin(2.0 * np.pi * waves * at[1] + 2.1 * of), np.cos(2.0 * np.pi * waves * at[1] + 1.3 * of)])
    )


def test_splines_and_detectors_that_are_asked_for_are_taken_and_none_in_a_sound_block() -> None:
    assert solved().with_splines() is solved().found
    for given, count, edges in (({"jitter": "2000"}, 8, 0), ({"detectors": (2500.0, 9000.0)}, 0, 2)):
        one = solved(**given)
        found = one.with_splines()
        waves = waves_of(found)
        assert (waves.count, waves.edges.shape) == (count, (3, edges))
        assert edges == 0 or waves.edges.tolist() == [[2499.5, 8999.5]] * 3  # between pixels
        assert found.asked["jitter"] is one.found.outcome.smooth
        assert found.after.error < 1.02 * one.found.after.error


def test_splines_are_solved_once_and_keep_what_else_was_found() -> None:
    """Terms have splines as a rival; where these win, the solution without the terms is asked for them again."""
    one = solved(jitter="2000")
    found, other = one.with_splines(), Finding("step", 0, None, np.zeros(2), 9.0, 1.0, "", np.zeros(2))
    again = with_splines(replace(one.found, findings=(other,)), one.parts, one.options)
    assert again.outcome is found.outcome
    assert (found.findings, again.findings) == ((), (other,))


def test_splines_that_spoil_the_check_tracks_in_one_round_are_not_solved_to_the_end(monkeypatch) -> None:
    one, ended = solved(), []
    for times, tried in ((1.4, True), (1.6, False)):
        bad = replace(one.found, after=replace(one.found.after, noise=times * one.found.after.noise))
        monkeypatch.setattr(Solution, "has_waves", True)

        def solve(*_: Any, once: bool = False, bad: Any = bad, **__: Any) -> Any:
            ended.extend([] if once else [bad])
            return bad

        monkeypatch.setattr(image_terms, "_solve_with", solve)
        assert with_splines(one.found, replace(one.parts), one.options) is one.found
        assert bool(ended) is tried
        ended.clear()


@pytest.mark.slow
@pytest.mark.parametrize("case", rest_slow([(3, 300, 8), (5, 700, 13)], mark=pytest.mark.nightly), ids=str)
def test_splines_are_as_dense_as_what_shakes_the_images_asks_for(case: tuple[int, int, int]) -> None:
    waves, tracks, least = case
    one = solved(shaken(0.5, waves), tracks=tracks)
    assert one.found.has_waves
    found = one.with_splines()
    taken = waves_of(found)
    assert least <= taken.count <= 23
    assert found.after.error < 0.5 * one.found.after.error
    off = solved(shaken(0.5, waves), tracks=tracks, jitter="off")
    assert off.with_splines() is off.found


def test_a_step_that_jitter_hid_is_found_beside_splines() -> None:
    """Alone 0.4 px are hidden by jitter of 0.5 px in all images; check tracks have both."""
    one = solved(shaken(0.5, 3), step(0.4, 1, 0.25, 0.6, 0))
    smooth = one.with_splines()
    beside = search_terms(smooth.outcome, one.parts.inner, one.options.noise_floor)
    found = with_terms_beside_splines(smooth, beside, one.parts, one.options)
    before, waves = waves_of(smooth), waves_of(found)
    assert ("step", 1) in [(term.kind, term.view) for term in found.findings]
    assert waves.count == before.count > 0
    assert found.after.error < 0.8 * smooth.after.error
    params = found.final.params[1, found.problem.cameras.unknowns.in_waves][waves.kinds[2]]
    np.testing.assert_allclose(np.abs(params), 0.4 * DIRECTION[:, 0], rtol=0.25)
    assert with_terms_beside_splines(smooth, Selection(), one.parts, one.options) is smooth


@pytest.mark.slow
def test_errors_that_neighbours_share_are_no_reason_for_splines() -> None:
    one = solved(cell_errors(0.4, 1))
    assert one.found.has_waves
    assert one.with_splines() is one.found


def test_what_was_found_are_unknowns_of_the_images_with_the_sizes_found() -> None:
    def found(kind: str, view: int, *unknowns: float, where: Any = None, period: float | None = None) -> Finding:
        return Finding(kind, view, where, np.zeros(2), 9.0, 1.0, "", np.array(unknowns), period)

    rows, decay = (1, 10.0, 20.0, 0.0, 0.0), (1, 30.0, 99.0, 30.0, 0.1)
    parts = [
        found("step", 2, 1.0, 2.0, where=rows),
        found("sinusoid", 0, 3.0, 4.0, 5.0, 6.0, period=50.0),
        found("decay", 2, 7.0, 8.0, where=decay),
        found("transient", 1, 9.0, 10.0, where=decay),
    ]
    layout = image_terms._layout_of(parts, 4)
    waves, params = layout.additional, layout.start
    assert (waves.count, waves.edges.shape, waves.steps.shape) == (0, (4, 0), (4, 2, 5))
    np.testing.assert_array_equal(waves.steps[2], [rows, decay])
    np.testing.assert_array_equal(waves.steps[1, 0], decay)
    assert np.isinf(waves.steps[[0, 3]]).all()
    assert np.isinf(waves.steps[1, 1]).all()
    np.testing.assert_array_equal(waves.periods, [[50.0], [np.inf], [np.inf], [np.inf]])
    # columns of all strips, then rows; of sinusoids too
    np.testing.assert_array_equal(params[2], [1, 7, 2, 8, 0, 0, 0, 0])
    np.testing.assert_array_equal(params[1], [9, 0, 10, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(params[0], [0, 0, 0, 0, 3, 4, 5, 6])
    assert not params[3].any()
