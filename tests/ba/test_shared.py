"""Noise that neighbouring ties share: by its likelihood; told from cameras, ground that moves, and single noise."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from barpc.ba import adjust_tracks
from barpc.ba.select.anomalies import log_ratio_by_image
from benchmarks.worlds import judge
from benchmarks.worlds_families import World, make
from tests.distributions import multivariate_normal

SIZE = np.array([[1000.0, 800.0], [500.0, 900.0]])  # cols, rows of two views


def ties(count: int = 1500, seed: int = 0) -> tuple[Any, Any, Any]:
    rng = np.random.default_rng(seed)
    view = np.repeat([0, 1], count)
    return view, rng.uniform(0, 1, (2, 2 * count)) * SIZE[:, view], rng.normal(0, 1, (2, 2 * count))


def with_cells(place: Any, view: Any, off: Any, side: int, size: float, of: int, seed: int = 5) -> Any:
    cells = np.random.default_rng(seed).normal(0, size, (2, side, side))
    col, row = (place / SIZE[:, view] * side).astype(int)
    return off + cells[:, row, col] * (view == of)


def test_noise_of_every_tie_by_itself_is_shared_by_no_neighbours() -> None:
    found = []
    for seed in range(20):
        view, place, off = ties(seed=seed)
        found.append(log_ratio_by_image(view, place, SIZE, off))
    assert np.shape(found) == (20, 2)
    assert np.max(found) < 2.0
    assert np.mean(np.array(found) == 0.0) > 0.8


@pytest.mark.parametrize("side", [4, 8, 16])
def test_errors_of_cells_are_found_in_the_view_that_has_them(side: int) -> None:
    view, place, off = ties()
    for size, least in ((1.0, 60.0), (2.0, 300.0)):
        found = log_ratio_by_image(view, place, SIZE, with_cells(place, view, off, side, size, 1))
        assert found[0] < 2.0
        assert found[1] > least
        # whatever the unit
        smaller = 0.1 * with_cells(place, view, off, side, size, 1)
        np.testing.assert_allclose(log_ratio_by_image(view, place, SIZE, smaller), found)


def test_the_gain_is_that_of_a_normal_distribution_less_the_choice() -> None:
    """Of the likeliest grid, of 4 to 32 cells a side, and share of the noise, of 5 to 95 %."""
    view, place, off = ties(60)
    off = with_cells(place, view, off, 4, 1.5, 0)
    found = log_ratio_by_image(view, place, SIZE, off)
    for v in range(2):
        mine = view == v
        values, one = off[:, mine] / np.sqrt((off[:, mine] ** 2).mean()), np.eye(mine.sum())
        alone, gains = multivariate_normal(np.zeros(len(one)), one), []
        for side, share in product((4, 8, 16, 32), np.arange(0.05, 0.96, 0.05)):
            col, row = (place[:, mine] / SIZE[:, [v]] * side).astype(int)
            same = (col[:, None] == col) & (row[:, None] == row)
            both = multivariate_normal(np.zeros(len(one)), share * same + (1.0 - share) * one)
            gains.append(sum(both.logpdf(x) - alone.logpdf(x) for x in values))
        assert found[v] == pytest.approx(max(max(gains) - np.log(len(gains)), 0.0), rel=1e-9)
    assert found[0] > 1.0


def test_few_ties_and_none_tell_nothing() -> None:
    view, place, off = ties(29)
    off = with_cells(place, view, off, 4, 9.0, 0)
    np.testing.assert_array_equal(log_ratio_by_image(view, place, SIZE, off), 0.0)
    none = np.zeros((2, 0))
    np.testing.assert_array_equal(log_ratio_by_image(np.zeros(0, np.int64), none, SIZE, none), 0.0)
    np.testing.assert_array_equal(log_ratio_by_image(view, place, SIZE, np.zeros_like(off)), 0.0)


def biased(world: World, size: float, side: int, seed: int) -> World:
    """The ties of a world, those of each cell of an image off alike."""
    tracks, shape = world.tracks, np.array(world.plan.size)
    cell = (tracks.xy / shape * side).astype(int).clip(0, side - 1)
    errors = np.random.default_rng(seed).normal(0, size, (len(world.views), side, side, 2))
    return replace(world, tracks=replace(tracks, xy=tracks.xy + errors[tracks.view, cell[:, 0], cell[:, 1]]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "side", "seed"),
    [(0.1, 8, 0), *(pytest.param(*one, marks=pytest.mark.nightly) for one in ((0.2, 8, 6), (0.1, 16, 12)))],
)
def test_matches_that_are_biased_place_by_place_bend_no_camera(size: float, side: int, seed: int) -> None:
    """As large as their noise, or twice: no cloud, strip, swing, spline or step follows them."""
    world = biased(make("clean", seed), size, side, seed)
    found = adjust_tracks(world.views, world.tracks)
    assert found.findings == ()
    assert found.cameras.unknowns.waves is None
    assert judge(world, found.sensors).left < size


@pytest.mark.nightly
def test_a_jump_is_told_among_matches_that_are_biased_place_by_place() -> None:
    world = make("local", 0)
    found = adjust_tracks(world.views, biased(world, 0.05, 8, 1).tracks)
    (one,) = found.findings
    assert one.view == 1
    assert one.kind in ("step", "decay")  # a bias of cells beside its end may look like one that fades
    assert one.where is not None
    assert one.where[1] == pytest.approx(world.plan.injected[0].low, abs=0.02 * world.plan.size[1])
    assert judge(world, [view.sensor for view in world.views]).left > 5.0
    assert judge(world, found.sensors).left < 0.1
