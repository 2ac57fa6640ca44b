"""When splines and steps are tried, which are kept, and where detectors are found: piece by piece."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import AdjustOptions
from barpc.ba.constraints.block import join, make_problem
from barpc.ba.parameters.additional_parameters import AdditionalParameters
from barpc.ba.select import image_terms
from barpc.ba.select.image_terms import _given_edges, _Layout, _spline_counts, _with_edges, with_splines
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State
from barpc.ba.terms import detectors
from barpc.ba.terms.detectors import _Columns, find_edges
from barpc.base.geodesy import ecef_from_ground
from barpc.simulate import simulate_block
from tests.ba.conftest import centers_of

# --- how many splines -----------------------------------------------------------------------------------------------


def views_of(*counts: int, rows: int = 20000, unused: int = 0) -> Any:
    """A block of views with so many observations each, of which the first ones are not used."""
    view = np.repeat(np.arange(len(counts)), counts)
    sizes = [SimpleNamespace(size=(5000, rows - 10 * v)) for v in range(len(counts))]
    return SimpleNamespace(views=sizes, view=view, use=np.arange(len(view)) >= unused)


@pytest.mark.parametrize(
    ("options", "waves", "counts"),
    [
        ({}, True, [13, 23, 43, 83]),  # knots of 2000 rows, halved three times
        ({}, False, []),
        ({"jitter": "off"}, True, []),
        ({"jitter": "off", "detectors": (9.0,)}, True, [0]),
        ({"drift": 0}, True, []),  # who has rotations stand still wants to see what they leave
        ({"drift": 0, "detectors": (9.0,)}, True, [0]),
        ({"drift": 1}, True, [13, 23, 43, 83]),
        ({"drift": 0, "jitter": "1000"}, True, [23]),
        ({"jitter": "1000"}, False, [23]),
        ({"jitter": "1001"}, False, [23]),
        ({"jitter": "999"}, False, [24]),
        ({"jitter": "100"}, False, [100]),  # an observation in thirty
        ({"jitter": "9000"}, False, [7]),  # never fewer
        ({"detectors": (9.0,)}, False, [0]),
        ({"detectors": (9.0,)}, True, [13, 23, 43, 83]),
    ],
)
def test_splines_are_as_many_as_asked_for_or_ever_more(options, waves, counts) -> None:
    assert _spline_counts(views_of(3000, 3000, 3000), AdjustOptions(**options), waves) == counts


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("counts", "expected"),
    [
        ((1319, 1320, 1e4), [13, 23, 43, 44]),  # the view in the middle tells
        ((100, 1289, 1e4), [13, 23, 42]),
        ((390, 390, 390), [13]),
        ((389, 389, 389), [12]),
        ((210, 210, 210), [7]),
        ((209, 209, 209), []),
        ((3000,) * 100, [13, 23, 43, 60]),  # 12,000 unknowns of all
        ((3000,) * 857, [7]),
        ((3000,) * 858, []),
    ],
)
def test_a_view_needs_thirty_observations_a_spline(counts, expected) -> None:
    assert _spline_counts(views_of(*map(int, counts)), AdjustOptions(), True) == expected


def test_observations_that_are_not_used_hold_no_spline() -> None:
    assert _spline_counts(views_of(700, 700, unused=310), AdjustOptions(), True) == [13, 18]
    few = views_of(60, 60)
    assert _spline_counts(few, AdjustOptions(jitter="1000"), True) == [7]


def test_columns_that_are_given_lie_between_pixels() -> None:
    found = _given_edges(views_of(1, 1), AdjustOptions(detectors=(2500.0, 5000.0)))
    np.testing.assert_array_equal(found, [[2499.5, 4999.5]] * 2)


# --- which are kept ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tried:
    """A solution by script."""

    name: str
    after: str
    has_waves: bool
    outcome: Any
    asked: dict[str, Any] = field(default_factory=dict)


def followed(monkeypatch, tells: str, better: str, **options: Any) -> tuple[str, list[str]]:
    """The solution kept, and what was tried: 0 is the given one, 1, 2, ... one denser than the other.

    `tells`: those in which something is left that neighbours share; `better`: those that are better than the best.
    """
    made: list[str] = []

    def solution(count: int) -> Tried:
        name = str(made.index(f"{count}") + 1) if count >= 0 else "0"
        return Tried(name, name, name in tells, SimpleNamespace(smooth=f"smooth of {name}"), {"drift": 1})

    def with_waves(found: Any, parts: Any, options: Any, layout: _Layout, once: bool = False) -> Tried:
        assert found.name == "0"  # always from where it ended without
        assert once == (not options.detectors)
        made.append(str(layout.waves.count))
        return solution(layout.waves.count)

    monkeypatch.setattr(image_terms, "_solve_with", with_waves)
    monkeypatch.setattr(image_terms, "_with_edges", lambda found, *_: found)
    monkeypatch.setattr(image_terms, "_explains", lambda *_: True)
    monkeypatch.setattr(image_terms, "is_admitted", lambda one, other, outer: one in better and other < one)
    parts: Any = SimpleNamespace(inner=views_of(3000, 3000), outer=None)
    found: Any = with_splines(solution(-1), parts, AdjustOptions(**options))  # type: ignore[arg-type]
    assert found.asked == ({"drift": 1} if found.name == "0" else {"drift": 1, "jitter": "smooth of 0"})
    return found.name, made


@pytest.mark.parametrize(
    ("tells", "better", "kept", "tried"),
    [
        ("", "1234", "0", 0),  # nothing asks for any
        ("0", "1234", "1", 1),  # what is left is nothing
        ("0", "", "0", 2),  # two that are no better are enough
        ("0", "2", "2", 2),
        ("0", "34", "0", 2),
        ("01", "1", "1", 3),
        ("0123", "1234", "4", 4),
        ("01234", "124", "4", 4),  # a miss between
        ("013", "13", "3", 4),
    ],
)
def test_knots_are_denser_until_nothing_is_left_or_two_are_no_better(monkeypatch, tells, better, kept, tried) -> None:
    found, made = followed(monkeypatch, tells, better)
    assert (found, len(made)) == (kept, tried)
    assert made == ["13", "23", "43", "83"][:tried]


@pytest.mark.parametrize(
    ("before", "left", "error", "kept"),
    [
        (100.0, 50.0, 0.99, True),
        (100.0, 51.0, 0.99, False),  # most of it is left: noise that neighbours share
        (100.0, 90.0, 0.69, True),  # much is gained
        (100.0, 90.0, 0.71, False),
        (0.0, 5.0, 0.99, True),  # too little to tell
        (0.0, 5.1, 0.99, False),
    ],
)
def test_what_is_followed_explains_most_of_what_neighbours_share(monkeypatch, before, left, error, kept) -> None:
    monkeypatch.setattr(image_terms, "correlated_noise_gain", lambda outcome, block: outcome)
    tried, found = (
        SimpleNamespace(outcome=o, after=SimpleNamespace(error=e)) for o, e in ((left, error), (before, 1.0))
    )
    assert image_terms._explains(tried, found, None) == kept  # type: ignore[arg-type]


def test_what_is_asked_for_is_taken_once(monkeypatch) -> None:
    assert followed(monkeypatch, "", "", jitter="1000") == ("1", ["23"])
    assert followed(monkeypatch, "", "", detectors=(9.0,)) == ("1", ["0"])
    assert followed(monkeypatch, "01", "", detectors=(9.0,)) == ("1", ["13", "23", "43"])
    assert followed(monkeypatch, "0", "1", jitter="off") == ("0", [])
    assert followed(monkeypatch, "0", "1", jitter="off", detectors=(9.0,)) == ("1", ["0"])


@dataclass
class Ended:
    """A solution by its name, and how well held-out tracks are met."""

    name: str
    after: int
    findings: tuple[Any, ...] = ()
    outcome: Any = None
    asked: tuple[str, ...] = ()


@pytest.mark.parametrize(
    ("parts", "plain", "kept"),
    [
        ({0: "step", 1: "step"}, 1, "tried"),  # one image stands still: it is seen against that
        ({0: "step", 1: "step", 2: "decay"}, 1, "found"),  # all do: what follows images as a whole, where it is better
        ({0: "step", 1: "step", 2: "decay"}, 3, "tried"),
        ({0: "sinusoid", 1: "sinusoid"}, 1, "found"),
        ({0: "sinusoid"}, 1, "tried"),
    ],
)
def test_strips_of_all_images_compete_with_what_follows_them_as_a_whole(monkeypatch, parts, plain, kept) -> None:
    """Of three images; the fewer, the better are held-out tracks met: 9 without strips, 2 with them."""
    findings = tuple(SimpleNamespace(kind=kind, view=v, where=(1,), moved=None, gain=9.0) for v, kind in parts.items())
    found, whole = Ended("found", 9), Ended("whole", plain)
    monkeypatch.setattr(image_terms, "_layout_of", lambda *_: SimpleNamespace())
    monkeypatch.setattr(image_terms, "_at_selection", lambda found, *_: found)
    monkeypatch.setattr(image_terms, "_solve_with", lambda *_, **__: Ended("tried", 2))
    monkeypatch.setattr(image_terms, "with_splines", lambda *_: whole)
    monkeypatch.setattr(image_terms, "standing_out", lambda *_: [])
    monkeypatch.setattr(image_terms, "is_better", lambda one, other, outer: one < other)
    monkeypatch.setattr(image_terms, "is_admitted", lambda one, other, outer, gain: not other < one)
    judged: Any = SimpleNamespace(findings=findings)
    block: Any = SimpleNamespace(inner=views_of(300, 300, 300), outer=None)
    ended: Any = image_terms.with_terms(found, judged, block, AdjustOptions())  # type: ignore[arg-type]
    assert ended.name == kept


def steps(monkeypatch, counts: list[int], tells: list[bool], given: int = 0) -> tuple[list[int], list[float]]:
    """Edges of the waves solved with, one after the other, where looks find so many; sigmas of the looks."""
    sigmas: list[float] = []
    solved: list[int] = []

    def solution(waves: AdditionalParameters) -> Any:
        unknowns = SimpleNamespace(unknowns=SimpleNamespace(waves=waves))
        outcome = SimpleNamespace(noise=2.0, problem=None, residual=None, inlier=None)
        return SimpleNamespace(
            problem=SimpleNamespace(cameras=unknowns),
            outcome=outcome,
            final=None,
            has_waves=tells[len(solved)],
        )

    def with_waves(found: Any, parts: Any, options: Any, layout: _Layout, once: bool = False) -> Any:
        waves = layout.waves
        assert not once
        assert waves.count == 13
        solved.append(waves.edges.shape[1])
        return solution(waves)

    def look(problem: Any, state: Any, residual: Any, use: Any, sigma: np.ndarray) -> np.ndarray:
        sigmas.append(float(sigma[0]))
        return np.zeros((2, counts[len(sigmas) - 1]))

    monkeypatch.setattr(image_terms, "_solve_with", with_waves)
    monkeypatch.setattr(image_terms, "find_edges", look)
    start = solution(AdditionalParameters(13, np.zeros((2, given))))
    parts: Any = SimpleNamespace(inner=SimpleNamespace(sigma=np.full(3, 0.1)))
    _with_edges(start, parts, None)  # type: ignore[arg-type]
    return solved, sigmas


def test_it_is_looked_for_detectors_twice_and_in_units_of_the_noise_seen(monkeypatch) -> None:
    assert steps(monkeypatch, [2, 3, 4], [True] * 4) == ([2, 3], [0.2, 0.2])
    assert steps(monkeypatch, [2, 2, 3], [True] * 4) == ([2], [0.2, 0.2])
    assert steps(monkeypatch, [2, 1], [True] * 4) == ([2], [0.2, 0.2])
    assert steps(monkeypatch, [0], [True] * 4) == (
        [0],
        [0.2],
    )  # without any it is solved to the end all the same
    assert steps(monkeypatch, [], [False] * 4) == ([0], [])


# --- where detectors begin --------------------------------------------------------------------------------------------


def columns(cols: list[np.ndarray], sigma: float = 1.0, together: bool = False) -> tuple[_Columns, np.ndarray]:
    """Views whose observations stand at these columns, all in use; the columns of all, one after the other."""
    bounds, col = np.cumsum([0, *map(len, cols)]), np.concatenate(cols)
    problem: Any = SimpleNamespace(structure=SimpleNamespace(bounds=bounds), xy=np.stack([col, 0 * col]))
    n = list(range(len(cols)))
    use = np.ones(len(col), dtype=bool)
    return _Columns(problem, use, np.full(len(col), sigma), [n] if together else [[v] for v in n]), col


def squares(residual: np.ndarray, weight: np.ndarray) -> float:
    """Weighted squares about the weighted mean, both coordinates."""
    mean = (residual * weight).sum(axis=1, keepdims=True) / weight.sum()
    return float(((residual - mean) ** 2 * weight).sum())


@pytest.mark.parametrize(("low", "high"), [(-np.inf, np.inf), (1500.0, 8000.0)])
def test_a_change_explains_as_much_as_two_means_explain_more_than_one(low, high) -> None:
    rng = np.random.default_rng(0)
    col = rng.uniform(0, 9000, 240)
    sigma, use = rng.uniform(0.5, 2, 240), rng.random(240) < 0.9
    residual = rng.normal(0, 1, (2, 240)) + np.where(col > 4000, [[1.0], [-0.5]], 0.0)
    problem: Any = SimpleNamespace(structure=SimpleNamespace(bounds=np.array([0, 240])), xy=np.stack([col, col]))
    gain, at = _Columns(problem, use, sigma, [[0]]).split(0, low, high, residual)
    inside = use & (col > low) & (col < high)
    best = (0.0, 0.0)
    for place in np.sort(col[inside]):
        left, right = inside & (col <= place), inside & (col > place)
        if min(left.sum(), right.sum()) >= 30:
            of_both = sum(squares(residual[:, part], sigma[part] ** -2) for part in (left, right))
            best = max(best, (squares(residual[:, inside], sigma[inside] ** -2) - of_both, place))
    assert gain == pytest.approx(best[0], rel=1e-9)
    assert gain > 20.0
    after = np.sort(col[inside])
    assert best[1] < at < after[after > best[1]][0]  # between two observations


def test_a_detector_has_thirty_observations() -> None:
    for count, found in ((29, False), (30, True)):
        for first in (count, 200 - count):
            col = np.arange(200.0)
            made, _ = columns([col])
            residual = np.tile(np.where(col < first, 50.0, 0.0), (2, 1))
            _, at = made.split(0, -np.inf, np.inf, residual)
            assert (at == first - 0.5) == found
        assert made.split(0, 0.0, 0.0, residual) == (0.0, 0.0)  # where nothing is, nothing begins


def test_what_changes_where_all_of_a_focal_plane_change_adds_up_less_a_price() -> None:
    cols = [np.arange(100.0), np.arange(100.0), np.arange(100.0)]
    apart, col = columns(cols)
    together, _ = columns(cols, together=True)
    residual = np.stack([np.where(col < 50, 0.0, 0.4), 0 * col])
    single = 0.16 * 25  # n1 n2 / (n1 + n2) of two times fifty
    for v in range(3):
        assert apart.split(v, -np.inf, np.inf, residual) == (pytest.approx(single), 49.5)
    assert together.split(0, -np.inf, np.inf, residual) == (pytest.approx(3 * single - 2 * 4.0), 49.5)


def test_means_of_detectors_are_weighted_and_nothing_where_there_is_no_edge() -> None:
    made, col = columns([np.arange(10.0), np.arange(10.0)])
    made.weight[0] = np.arange(1.0, 11.0)
    residual = np.stack([col**2, -col])
    found = made.means(residual, [[3.5], []])
    weight = np.arange(1.0, 11.0)
    for part in (slice(0, 4), slice(4, 10)):
        expected = np.average(residual[:, part], axis=1, weights=weight[part])
        np.testing.assert_allclose(found[:, part], np.tile(expected[:, None], (1, part.stop - part.start)))
    assert not found[:, 10:].any()


def grown(made: _Columns, residual: np.ndarray, sigma: float = 1.0) -> tuple[list[list[float]], float]:
    """Edges where points do not share what is wrong."""
    return detectors._grown(made, residual, lambda given: given, np.full(residual.shape[1], 1.0 / sigma))


@pytest.mark.parametrize(("share", "found"), [(0.98, False), (1.02, True)])
def test_a_step_is_found_where_it_explains_forty(share, found) -> None:
    made, col = columns([np.arange(200.0)], sigma=0.1)
    size = 0.1 * np.sqrt(share * 40.0 / 50.0)  # 50 = 100 100 / 200
    residual = np.stack([0 * col, np.where(col < 100, 0.0, size)])
    edges, left = grown(made, residual, 0.1)
    assert edges == ([[99.5]] if found else [[]])
    # an edge costs what it has to explain
    assert left == pytest.approx(40.0 if found else squares(residual, np.full(200, 100.0)) * 2, abs=1e-6)


@pytest.mark.parametrize(("share", "found"), [(0.98, False), (1.02, True)])
def test_a_step_of_a_focal_plane_has_to_explain_four_more_a_view(share, found) -> None:
    made, col = columns([np.arange(200.0)] * 3, together=True)
    residual = np.stack([np.where(col < 100, 0.0, np.sqrt(share * 48.0 / 150.0)), 0 * col])
    edges, left = grown(made, residual)
    assert edges == ([[99.5]] if found else [[]])
    if found:
        assert left == pytest.approx(48.0, abs=1e-6)


@pytest.mark.parametrize(("share", "found"), [(0.48, False), (0.52, True)])
def test_changes_half_as_large_as_the_largest_are_taken_with_it(monkeypatch, share, found) -> None:
    monkeypatch.setattr(detectors, "ITERATIONS", 1)
    made, col = columns([np.arange(200.0)] * 2)
    size = np.where(np.arange(400) < 200, np.sqrt(200.0 / 50.0), np.sqrt(share * 200.0 / 50.0))
    edges, _ = grown(made, np.stack([np.where(col < 100, 0.0, size), 0 * col]))
    assert edges == [[99.5], [99.5] if found else []]


def test_steps_of_many_detectors_are_found_where_they_begin() -> None:
    made, col = columns([np.arange(600.0)])
    levels = np.array([0.0, 3.0, 1.0, 4.0, 2.5, 0.0])
    edges, left = grown(made, np.stack([levels[(col // 100).astype(int)], -levels[(col // 100).astype(int)]]))
    np.testing.assert_allclose(edges[0], [99.5, 199.5, 299.5, 399.5, 499.5])
    assert left == pytest.approx(5 * 40.0, abs=1.0)


@pytest.fixture(scope="module")
def exact() -> tuple[Problem, State]:
    """Three views that see 500 points without an error."""
    made = simulate_block(3, 500, seed=4, noise=0.0, visible=1.0, num_checks=0)
    options = AdjustOptions(drift=0)
    block = join(made.views, made.tracks, None, options)
    problem = make_problem(block, options, centers_of(made), None)
    distance = problem.cameras.unknowns.distance
    params = [np.r_[c.rotation * d, c.translation] for c, d in zip(made.truth.corrections, distance, strict=True)]
    return problem, State(np.array(params), ecef_from_ground(made.truth.ground))


def found_edges(exact: tuple[Problem, State], *sizes: float) -> np.ndarray:
    """Edges where columns and rows of the views are off by so much from the 9000th column on."""
    problem, state = exact
    moved = np.array(sizes)[problem.structure.view] * (problem.xy[0] > 9000.0)
    noise = np.random.default_rng(0).normal(0, 0.05, problem.xy.shape)
    residual = problem.residuals(state.params, state.points) + noise + np.outer([1.0, -1.0], moved)
    n = len(problem.structure.view)
    return find_edges(problem, state, residual, np.ones(n, dtype=bool), np.full(n, 0.05))


def test_the_step_of_one_view_is_found_in_that_view_and_that_of_all_in_all(exact) -> None:
    assert found_edges(exact, 0.0, 0.0, 0.0).shape == (3, 0)
    alone = found_edges(exact, 0.0, 0.3, 0.0)
    assert alone.shape == (3, 1)
    assert np.isinf(alone[[0, 2], 0]).all()
    assert alone[1, 0] == pytest.approx(9000.0, abs=150.0)
    every = found_edges(exact, 0.3, 0.0, -0.3)
    assert every.shape == (3, 1)
    assert (every == every[0]).all()
    assert every[0, 0] == pytest.approx(9000.0, abs=150.0)


def test_what_was_found_before_is_looked_for_anew(exact) -> None:
    """Residuals of cameras that know the steps are those of cameras without, what their splines do left out."""
    problem, state = exact
    waves = AdditionalParameters(9, np.tile([9000.0], (3, 1)))
    unknowns = replace(problem.cameras.unknowns, waves=waves)
    params = np.hstack([state.params, np.random.default_rng(1).normal(0, 0.2, (3, waves.size))])
    cameras = SimpleNamespace(unknowns=unknowns)
    known: Any = SimpleNamespace(cameras=cameras, structure=problem.structure, xy=problem.xy)
    zero = np.zeros(problem.xy.shape)
    found = detectors._without_steps(known, replace(state, params=params), zero)
    of_steps = params[:, unknowns.in_waves][:, waves.kinds[1]].reshape(3, 2, -1)
    right = problem.xy[0] >= 9000.0
    for v in range(3):
        mine = problem.structure.view == v
        levels = waves._of_steps @ of_steps[v].T  # (2 detectors, 2 coordinates)
        np.testing.assert_allclose(found[:, mine], -levels[right[mine].astype(int)].T, atol=1e-12)
    assert (detectors._without_steps(problem, state, zero) == 0).all()


# --- splines and steps ------------------------------------------------------------------------------------------------


def test_unknowns_of_waves_are_about_as_large_within_half_an_octave() -> None:
    bands = AdditionalParameters(13, np.zeros((2, 3))).bands
    m, s, strips, swings = AdditionalParameters(13, np.zeros((2, 3))).parts
    assert strips == swings == 0
    assert (m, s) == (10, 2)  # a shift and a scale of the columns are not theirs
    # of 3, 4, 5, ... half waves: between powers of the root of two
    expected = [0, 1, 1, 2, 2, 3, 3, 3, 3, 4]
    assert bands.tolist() == [*expected, *expected, *[5] * 2 * s]
    assert AdditionalParameters(0, np.zeros((1, 1))).bands.tolist() == [0, 0]
    assert AdditionalParameters(0, np.zeros((1, 1))).parts == (0, 1, 0, 0)
    both = AdditionalParameters(13, np.zeros((2, 3)), np.zeros((2, 4, 5)))  # strips are as large as each other
    assert both.bands.tolist() == [*expected, *expected, *[5] * 2 * s, *[6] * 8]
    assert AdditionalParameters(0, np.zeros((2, 0)), np.zeros((2, 4, 5))).bands.tolist() == [0] * 8
    assert AdditionalParameters(9).size == 2 * 6


def test_unknowns_of_another_layout_are_gone_on_from_where_they_are_the_same() -> None:
    """Splines of as many, strips and one more, swings of as many; detectors are asked again."""
    strips, edges = np.zeros((2, 2, 5)), np.zeros((2, 1))
    known = AdditionalParameters(9, edges, strips[:, :1], np.zeros((2, 1)))
    more = replace(known, strips=strips)
    params = np.random.default_rng(0).normal(size=(2, known.size))
    found = more.carried(params, known)
    for kind in (0, 3):
        np.testing.assert_array_equal(found[:, more.kinds[kind]], params[:, known.kinds[kind]])
    assert not found[:, more.kinds[1]].any()
    col, row = params[:, known.kinds[2]].T
    np.testing.assert_array_equal(found[:, more.kinds[2]].T, [col, 0.0 * col, row, 0.0 * row])
    assert not replace(known, count=11).carried(params, known)[:, : 2 * 8].any()
    assert not AdditionalParameters(0, periods=np.zeros((2, 2))).carried(params, known).any()
    assert not AdditionalParameters(0, strips=strips).carried(params[:, known.kinds[0]], AdditionalParameters(9)).any()


PERIODS = np.array([[200.0, 31.5], [np.inf, np.inf], [700.0, np.inf]])


def test_swings_are_cosines_and_sines_of_the_row_seen() -> None:
    waves = AdditionalParameters(0, np.zeros((3, 0)), np.zeros((3, 0, 5)), PERIODS)
    assert waves.parts == (0, 0, 0, 4)
    assert waves.size == 8
    assert waves.bands.tolist() == [0] * 8
    row, index = np.tile([0.0, 50.0, 333.3], 3), np.repeat([0, 1, 2], 3)
    (basis,) = waves.basis(np.zeros(9), np.stack([row * 0.0, row]), index)
    assert not basis[:, 3:6].any()
    params = np.arange(1.0, 9.0)
    for view in range(3):
        made = waves.correction(params, view, 0.0, 1.0)
        assert made.periods.tolist() == PERIODS[view][np.isfinite(PERIODS[view])].tolist()
        moved = made.at(np.column_stack([np.zeros(3), row[:3]]))
        here = slice(3 * view, 3 * view + 3)
        np.testing.assert_allclose(moved, (params.reshape(2, 4) @ basis[:, here]).T, atol=1e-12)
    # a column's cosine of the first swing of view 0
    np.testing.assert_allclose(basis[0, :3], np.cos(2 * np.pi * row[:3] / 200.0), atol=1e-12)


def test_an_error_that_neighbours_share_is_another_in_every_half_of_a_wave() -> None:
    none, strips = np.zeros((3, 0)), np.zeros((3, 0, 5))
    assert AdditionalParameters(13, none, strips).stretches(9000.0) == AdditionalParameters(13).size
    of_waves = 9000.0 / 200.0 + 9000.0 / 31.5
    assert AdditionalParameters(0, none, strips, PERIODS).stretches(9000.0) == pytest.approx(4.0 * of_waves)
    assert AdditionalParameters(13, none, strips, PERIODS).stretches(9000.0) == pytest.approx(
        AdditionalParameters(13).size + 4.0 * of_waves
    )
    assert AdditionalParameters(0, none, strips, 1e9 * PERIODS).stretches(9000.0) == 8  # as many as there are unknowns


@pytest.mark.parametrize("count", [1, 2, 7])
def test_steps_leave_a_shift_and_a_scale_to_others(count: int) -> None:
    steps = AdditionalParameters(0, np.zeros((1, count)))._of_steps
    place = np.linspace(-1, 1, count + 1)
    np.testing.assert_allclose(steps.T @ np.ones(count + 1), 0.0, atol=1e-12)
    if count > 1:
        np.testing.assert_allclose(steps.T @ place, 0.0, atol=1e-12)
    np.testing.assert_allclose(steps.T @ steps, np.eye(steps.shape[1]), atol=1e-12)


def test_a_view_without_edges_has_no_steps_and_one_with_fewer_its_own() -> None:
    waves = AdditionalParameters(0, np.array([[5.0, 9.0], [7.0, np.inf], [np.inf, np.inf]]))
    col, index = np.tile([4.9, 5.0, 8.0, 9.5], 3), np.repeat([0, 1, 2], 4)
    (basis,) = waves.basis(np.zeros(12), np.stack([col, col * 0.0]), index)
    levels = waves._of_steps.T
    place = [0, 1, 1, 2, 0, 0, 1, 1]
    np.testing.assert_allclose(basis[:, :8], levels[:, place])
    assert not basis[:, 8:].any()
    params = np.array([0.5, -0.25])
    for view, edges in ((0, [5.0, 9.0]), (1, [7.0]), (2, [])):
        made = waves.correction(params, view, 0.0, 1.0)
        assert made.edges.tolist() == edges
        moved = made.at(np.column_stack([col[:4], np.zeros(4)]))
        expected = np.outer(basis[0, 4 * view : 4 * view + 4], params)
        np.testing.assert_allclose(moved, expected, atol=1e-12)
