"""Where tie points that took no part are met worse: found where it was put, and nowhere where all is alike."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.ba.evidence.places import Place, Unused, met_worse
from barpc.ba.usual import CHANCE
from tests.lanes import diagonal

SIZE = np.array([[20_000.0, 9_000.0], [15_000.0, 12_000.0]])
NOISE = 0.1
LIMITS = 4.0, 0.06, 0.3  # far off [standard deviations], what may be shared [px], what may be far off [share]


def observed(seed: int, each: int, wrong: float, images: int = 1) -> tuple[Unused, np.random.Generator]:
    """Observations of images seen in many: noise, and wrong ones anywhere within 15 px."""
    rng = np.random.default_rng(seed)
    view = np.repeat(np.arange(images), each)
    xy = rng.uniform(0, 1, (2, len(view))) * SIZE[:, view]
    residual = rng.normal(0, NOISE, (2, len(view)))
    bad = rng.random(len(view)) < wrong
    residual[:, bad] += rng.uniform(-15, 15, (2, bad.sum()))
    return Unused(view, xy, residual, np.full(len(view), np.sqrt(2) * NOISE)), rng


def worst(unused: Unused) -> list[Place]:
    return met_worse(unused, SIZE[:, : unused.view.max() + 1], *LIMITS)


@pytest.mark.parametrize(("each", "wrong"), diagonal([60, 200, 25], [0.03, 0.3, 0.0, 0.5]))
def test_where_all_places_are_alike_none_is_named(each: int, wrong: float) -> None:
    found = [worst(observed(seed, each, wrong, 2)[0]) for seed in range(12)]
    assert not any(found)


@pytest.mark.parametrize("wrong", [0.03, 0.3])
@pytest.mark.parametrize(
    ("axis", "part", "move"),
    [
        (1, (0.0, 0.1), (0.0, 3.0)),  # a cut took them: they are far off, all in one direction
        (1, (0.75, 1.0), (0.15, -0.15)),  # nobody cuts that
        (0, (0.25, 0.5), (0.0, 0.3)),
        (1, (0.0, 0.5), (0.2, 0.0)),
    ],
)
def test_rows_and_columns_that_lie_off_are_named_with_their_size(axis, part, move, wrong) -> None:
    unused, _ = observed(1, 600, wrong, 2)
    place = unused.xy[axis] / SIZE[axis, unused.view]
    hit = (unused.view == 1) & (place >= part[0]) & (place < part[1])
    unused.residual[:, hit] += np.array(move)[:, None]
    (one,) = worst(unused)
    assert one.view == 1
    side = (one.columns, one.rows)[axis]
    assert side is not None
    found, size = np.array(side) / SIZE[axis, 1], part[1] - part[0]
    overlap = min(found[1], part[1]) - max(found[0], part[0])
    if part == (0.0, 0.5):  # the rest is off by as much the other way
        assert overlap > 0.0 or found[0] >= 0.5
    else:
        assert overlap > 0.4 * size
        assert found[1] - found[0] < 1.2 * size + 0.05
        assert one.off == pytest.approx(np.hypot(*move), rel=0.35)
    assert (one.far > 0.3) == (move[1] == 3.0)
    assert 0.0 <= one.chance < CHANCE


def test_a_cell_is_named_and_not_the_rows_that_it_is_in() -> None:
    unused, _ = observed(2, 900, 0.03)
    hit = ((unused.xy / SIZE[:, :1] > [[0.5], [0.25]]) & (unused.xy / SIZE[:, :1] < [[0.75], [0.5]])).all(axis=0)
    unused.residual[:, hit] += 0.5
    (one,) = worst(unused)
    assert one.columns == (10_000.0, 15_000.0)
    assert one.rows == (3_750.0, 7_500.0)


@pytest.mark.parametrize("turned", [0.0, 0.5, 1.5])
def test_of_two_views_residuals_on_a_line_are_tested_along_it(turned: float) -> None:
    """The line turns by two degrees over the image, as epipolar lines do."""
    rng = np.random.default_rng(4)
    for move, told in ((0.0, False), (0.3, True)):
        for seed in range(8):
            rng = np.random.default_rng(seed)
            xy = rng.uniform(0, 1, (2, 300)) * SIZE[:, :1]
            angle = turned + np.radians(2.0) * (xy[0] / SIZE[0, 0] - 0.5)
            along = rng.normal(0, NOISE * np.sqrt(0.5), 300) + move * (xy[1] < 1500.0)
            along[rng.random(300) < 0.05] += 9.0
            residual = along * np.array([np.cos(angle), np.sin(angle)])
            unused = Unused(np.zeros(300, dtype=np.int64), xy, residual, np.full(300, NOISE * np.sqrt(0.5)))
            assert bool(worst(unused)) == told


def test_wrong_matches_that_stand_together_are_no_error_of_a_camera() -> None:
    """A cloud, a forest: half of a corner's tie points lie anywhere, and the rest agrees."""
    for seed in range(10):
        unused, rng = observed(seed, 300, 0.02)
        corner = (unused.xy < 0.4 * SIZE[:, :1]).all(axis=0) & (rng.random(300) < 0.5)
        unused.residual[:, corner] = rng.uniform(-15, 15, (2, corner.sum()))
        assert not worst(unused)


def test_neighbours_that_share_their_error_are_one() -> None:
    """Forty tie points of one roof, all wrong alike, against the image."""
    unused, _ = observed(5, 400, 0.02)
    unused.xy[:, :40] = [[4_000.0], [5_000.0]] + np.random.default_rng(1).uniform(0, 50, (2, 40))
    unused.residual[:, :40] = [[2.0], [3.0]]
    assert not worst(unused)


@pytest.mark.parametrize(("part", "times"), [(0.25, 3.0), (0.35, 3.0), (0.6, 2.0)])
def test_a_scatter_that_is_larger_in_a_part_is_none(part: float, times: float) -> None:
    """Haze, or a desert: noise is larger in a part of the rows, and centred."""
    for seed in range(10):
        unused, _ = observed(seed, 400, 0.02)
        unused.residual[:, unused.xy[1] < part * SIZE[1, 0]] *= times
        assert not worst(unused)


def test_few_observations_and_exact_ones_say_nothing_wrong() -> None:
    assert worst(observed(1, 19, 0.0)[0]) == []
    unused, _ = observed(1, 300, 0.0)
    exact = Unused(unused.view, unused.xy, np.zeros((2, 300)), np.full(300, 1e-6))
    assert worst(exact) == []
    far = Unused(unused.view, unused.xy, unused.residual + 50.0, unused.deviation)  # nothing is near: no place is worse
    assert worst(far) == []
    outside = Unused(unused.view, unused.xy - 3e4, unused.residual, unused.deviation)
    assert worst(outside) == []
