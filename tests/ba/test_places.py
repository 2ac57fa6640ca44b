"""Where tie points that took no part are met worse: found where it was put, and nowhere where all is alike."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.ba.evidence import scan
from barpc.ba.evidence.scan import CheckTies, ImageRegion, worst_regions
from barpc.base.statistics import CHANCE
from tests.distributions import hypergeom
from tests.lanes import diagonal

SIZE = np.array([[20_000.0, 9_000.0], [15_000.0, 12_000.0]])
NOISE = 0.1
LIMITS = 4.0, 0.06, 0.3  # far off [standard deviations], what may be shared [px], what may be far off [share]


def observed(seed: int, each: int, wrong: float, images: int = 1) -> tuple[CheckTies, np.random.Generator]:
    """Observations of images seen in many: noise, and wrong ones anywhere within 15 px."""
    rng = np.random.default_rng(seed)
    view = np.repeat(np.arange(images), each)
    xy = rng.uniform(0, 1, (2, len(view))) * SIZE[:, view]
    residual = rng.normal(0, NOISE, (2, len(view)))
    bad = rng.random(len(view)) < wrong
    residual[:, bad] += rng.uniform(-15, 15, (2, bad.sum()))
    return CheckTies(view, xy, residual, np.full(len(view), np.sqrt(2) * NOISE)), rng


def worst(unused: CheckTies) -> list[ImageRegion]:
    return worst_regions(unused, SIZE[:, : unused.view.max() + 1], *LIMITS)


@pytest.mark.few(2)
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
            unused = CheckTies(np.zeros(300, dtype=np.int64), xy, residual, np.full(300, NOISE * np.sqrt(0.5)))
            assert bool(worst(unused)) == told


def test_wrong_matches_that_stand_together_are_no_error_of_a_camera() -> None:
    """A cloud, a forest: half of a corner's tie points lie anywhere, and the rest agrees."""
    for seed in range(10):
        unused, rng = observed(seed, 300, 0.02)
        corner = (unused.xy < 0.4 * SIZE[:, :1]).all(axis=0) & (rng.random(300) < 0.5)
        unused.residual[:, corner] = rng.uniform(-15, 15, (2, corner.sum()))
        assert not worst(unused)


@pytest.mark.parametrize(("share", "named"), [(0.15, False), (0.25, False), (0.4, True)])
def test_rows_are_named_by_those_alike_where_these_are_more_than_may_be_far_off(share: float, named: bool) -> None:
    """As many again lie far off, each by itself."""
    unused, _ = observed(1, 600, 0.0, 2)
    hit = np.flatnonzero((unused.view == 1) & (unused.xy[1] < 0.1 * SIZE[1, 1]))
    alike, apart = np.split(hit[: 2 * int(share * len(hit))], 2)
    around = np.arange(len(apart)) * 2.4
    unused.residual[:, alike] += [[0.0], [3.0]]
    unused.residual[:, apart] += 10.0 * np.stack([np.cos(around), np.sin(around)])
    assert [one.rows is not None and one.far > 0.3 for one in worst(unused)] == [True] * named


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


@pytest.mark.parametrize(("few", "images"), [(20, 2), (19, 1)])
def test_images_of_twenty_observations_are_among_those_that_a_place_is_chosen_from(few: int, images: int) -> None:
    unused, _ = observed(1, 600, 0.0, 2)
    unused.xy[:, 600:] = (np.arange(600) + 0.5) / 600 * SIZE[:, 1:]  # no two of the few in a small part
    unused.residual[0, :600] += (unused.xy[1, :600] < 0.1 * SIZE[1, 0]) * 3.0
    (alone,) = worst(unused.part(unused.view == 0))
    (beside,) = worst(unused.part(np.r_[np.arange(600), 600 + np.linspace(0, 599, few).astype(int)]))
    assert beside.chance == pytest.approx(images * alone.chance, rel=1e-9, abs=0.0)


def test_few_observations_and_exact_ones_say_nothing_wrong() -> None:
    assert worst(observed(1, 19, 0.0)[0]) == []
    unused, _ = observed(1, 300, 0.0)
    exact = CheckTies(unused.view, unused.xy, np.zeros((2, 300)), np.full(300, 1e-6))
    assert worst(exact) == []
    far = CheckTies(unused.view, unused.xy, unused.residual + 50.0, unused.deviation)  # nothing is near
    assert worst(far) == []
    outside = CheckTies(unused.view, unused.xy - 3e4, unused.residual, unused.deviation)
    assert worst(outside) == []


# --- piece by piece -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("found", "count", "alike", "whole"), [(3, 10, 8, 60), (0, 5, 9, 30), (7, 7, 9, 12), (4, 30, 4, 31)]
)
def test_as_many_alike_in_a_place_have_the_hypergeometric_chance(found, count, alike, whole) -> None:
    chance = hypergeom(whole, alike, count).sf(found - 1)
    assert scan.hypergeometric_tail(found, count, alike, whole) == pytest.approx(chance, rel=1e-9)


def test_a_place_has_the_chance_of_as_many_alike_times_the_tests() -> None:
    """One of the far ones is where the others are looked for; each of the place might be it."""
    rng = np.random.default_rng(3)
    cell = rng.permutation(32 * 32)[:400]  # no two in a part
    xy = (np.stack([cell % 32, cell // 32]) + 0.5) / 32 * SIZE[:, :1]
    residual, deviation = rng.normal(0, NOISE, (2, 400)), np.full(400, NOISE)
    inside = np.flatnonzero(xy[1] < SIZE[1, 0] / 8)
    elsewhere = np.setdiff1d(np.arange(400), inside)
    alike = np.append(inside[::2], elsewhere[:20])
    residual[:, alike] += [[3.0], [2.0]]
    residual[:, inside[1:7:2]] += rng.uniform(5.0, 15.0, (2, 3))  # far off, each by itself
    (one,) = worst(CheckTies(np.zeros(400, dtype=int), xy, residual, deviation))
    assert (one.columns, one.rows) == (None, (0.0, SIZE[1, 0] / 8))
    among = len(inside[::2])
    assert one.far == pytest.approx(among / len(inside))
    chance = hypergeom(399, among + 20 - 1, len(inside) - 1).sf(among - 2)
    tests = 2 * (62 + 62 + 4 + 16 + 64)  # lines each way of 32 parts, and squares of 2, 4 and 8 parts a side
    assert one.chance == pytest.approx(chance * (among + 3) * tests, rel=1e-9)


def test_axes_are_those_of_the_covariance_the_largest_first() -> None:
    rng = np.random.default_rng(0)
    standard = np.array([[3.0, 1.0], [0.5, 0.2]]) @ rng.normal(size=(2, 300)) + 9.0
    axes, spread = scan.principal_axes(standard)
    covariance = np.cov(standard, bias=True)
    np.testing.assert_allclose(axes.T @ covariance @ axes, np.diag(spread**2), atol=1e-9)
    assert spread[0] > spread[1] > 0


def test_the_variance_of_a_place_s_mean_is_that_of_its_parts_its_own_mean_taken_off() -> None:
    rng = np.random.default_rng(2)
    n = 90
    along, near = rng.normal(size=(2, n)) * [[1.0], [3.0]], np.ones(n, dtype=bool)
    near[:6] = False
    col, row = rng.integers(0, 32, (2, n))
    cells = scan._image_cells(near, col, row)
    parts = 2  # of 84: the root of seven twelves
    of_cell = np.where(near, row * parts // 32 * parts + col * parts // 32, -1)
    np.testing.assert_array_equal(cells, of_cell[:, None] == np.arange(4))
    inside = (rng.random((3, n)) < 0.4) & near
    mean = np.stack([along[:, one].mean(axis=1) for one in inside])
    found = scan._variances(along * near, inside.astype(float), mean, cells)
    for place, one in enumerate(inside):
        for axis in (0, 1):
            left = along[axis] - one * mean[place, axis]
            whole = (left[near] ** 2).sum() / (near.sum() - 2)
            expected = 0.0
            for cell in range(4):
                own = left[of_cell == cell]
                expected += (one & (of_cell == cell)).sum() * max((own**2).sum() / (len(own) - 1), whole)
            expected *= (1.0 - one.sum() / near.sum()) / one.sum() ** 2
            assert found[place, axis] == pytest.approx(expected)
