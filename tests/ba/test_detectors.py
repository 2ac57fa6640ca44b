"""Where detectors of a focal plane begin: what a change explains, and where it is found."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import AdjustOptions
from barpc.ba.constraints.block import join, make_problem
from barpc.ba.parameters.additional_parameters import AdditionalParameters
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State
from barpc.ba.terms import detectors
from barpc.ba.terms.detectors import Columns, find_edges
from barpc.base.geodesy import ecef_from_ground
from barpc.simulate import simulate_block
from tests.ba.conftest import centers_of
from tests.constants import Sized


def columns(cols: list[np.ndarray], sigma: float = 1.0, together: bool = False) -> tuple[Columns, np.ndarray]:
    """Views whose observations stand at these columns, all in use; the columns of all, one after the other."""
    bounds, col = np.cumsum([0, *map(len, cols)]), np.concatenate(cols)
    n = list(range(len(cols)))
    use = np.ones(len(col), dtype=bool)
    return Columns(bounds, col, use, np.full(len(col), sigma), [n] if together else [[v] for v in n]), col


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
    gain, at = Columns(np.array([0, 240]), col, use, sigma, [[0]]).split(0, low, high, residual)
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


def grown(made: Columns, residual: np.ndarray, sigma: float = 1.0) -> tuple[list[list[float]], float]:
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
def test_changes_half_as_large_as_the_largest_are_taken_with_it(sized: Sized, share, found) -> None:
    sized(edge_rounds=1)
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
