"""Pairs whose heights contradict: the right one or none, never their mean; by hand, and on rendered ground."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import maximum_filter, minimum_filter

from barpc.base.verb_options import DsmOptions
from barpc.dsm import stereo
from barpc.dsm.consensus import NEIGHBOUR_RADIUS, SURROUNDED, consensus, finite_median
from barpc.dsm.stereo import block_of_images, surface_tile
from barpc.dsm.surface import Grid
from tests.dsm.conftest import SMALL, Rendered
from tests.lanes import rest_slow
from tests.scenes import Scene
from tests.scenes.terrain import fractal

PIXEL = np.array([2.0, 2.0, 3.0, 2.5], np.float32)  # metres of height that a pixel of disparity of each pair stands for


def hills(pairs: int, side: int = 48, slope: float = 0.3) -> np.ndarray:
    """Heights of pairs that see the same slope, each with its own noise of a few centimetres."""
    east, south = np.meshgrid(np.arange(side), np.arange(side))
    noise = np.random.default_rng(pairs).normal(0.0, 0.05, (pairs, side, side))
    return (100.0 + slope * east - 0.5 * slope * south + noise).astype(np.float32)


def known_median(values: np.ndarray) -> np.ndarray:
    """Numpy's, of what is known."""
    return np.ma.median(np.ma.masked_invalid(values), axis=0).filled(np.nan)


def heights_of(cells: np.ndarray) -> np.ndarray:
    return finite_median(np.where(consensus(cells, PIXEL[: len(cells)]), cells, np.nan))


def taken_by_hand(heights: np.ndarray, metres: np.ndarray) -> np.ndarray:
    """The rule cell by cell: the largest group, else what the cells around say in which pairs agree."""
    num, rows, cols = heights.shape
    several = np.isfinite(heights).sum(axis=0) > 1
    middle = known_median(heights)
    off = [np.nanmedian((one - middle)[several]) for one in heights]
    level = heights - np.array(off)[:, None, None]
    taken, sure = np.zeros(heights.shape, bool), np.full((rows, cols), np.nan)
    open_cells = {}
    for at in np.ndindex(rows, cols):
        one = level[:, *at]
        groups = [{n for n in range(num) if abs(one[n] - one[k]) <= max(metres[n], metres[k])} for k in range(num)]
        largest = max(map(len, groups))
        best = [k for k in range(num) if len(groups[k]) == largest and np.isfinite(one[k])]
        if largest > 1 and set(best) <= groups[best[0]]:
            taken[list(groups[best[0]]), *at] = True
            sure[at] = np.median(one[list(groups[best[0]])])
        elif best:
            open_cells[at] = best, groups
    away = range(-NEIGHBOUR_RADIUS, NEIGHBOUR_RADIUS + 1, 2)
    around = [(i, j) for i in away for j in away if 0 < i * i + j * j <= NEIGHBOUR_RADIUS**2]
    for at, (best, groups) in open_cells.items():
        near = [(at[0] + i, at[1] + j) for i, j in around]
        near = [sure[one] for one in near if 0 <= one[0] < rows and 0 <= one[1] < cols and np.isfinite(sure[one])]
        votes = {k: sum(abs(level[k, *at] - one) <= metres[k] for one in near) for k in best}
        chosen = max(best, key=lambda k: (votes[k], -k))
        rivals = [votes[k] for k in best if k not in groups[chosen]]
        alone = not rivals and len(near) < SURROUNDED * len(around)
        if votes[chosen] > max([0, *rivals]) or alone:
            taken[list(groups[chosen]), *at] = True
    return taken


@pytest.mark.parametrize("pairs", [2, 3, 4])
def test_the_pairs_taken_are_those_that_the_rule_takes_cell_by_cell(pairs: int) -> None:
    rng = np.random.default_rng(pairs)
    cells = hills(pairs, 22) + np.arange(pairs, dtype=np.float32)[:, None, None] * 7.0
    wrong = rng.random(cells.shape) < 0.35
    cells[wrong] += rng.choice([-9.0, -4.0, 1.5, 4.0, 9.0], wrong.sum()).astype(np.float32)
    cells[rng.random(cells.shape) < 0.3] = np.nan
    cells[:, 15:, :9] = np.nan
    cells[0, 15:, :8] = 100.0  # a corner that one pair sees alone
    expected, found = taken_by_hand(cells, PIXEL[:pairs]), consensus(cells, PIXEL[:pairs])
    np.testing.assert_array_equal(found, expected)
    assert 0 < (np.isfinite(cells).any(axis=0) & ~found.any(axis=0)).sum() < 0.5 * found[0].size


@pytest.mark.parametrize("wrong", [0, 1])
@pytest.mark.parametrize("off", [-30.0, -6.0, 6.0, 30.0])
@pytest.mark.parametrize("cameras", [0.0, 50.0])
def test_of_two_heights_that_contradict_the_wrong_one_is_left_whichever_it_is(wrong, off, cameras):
    """In a patch of 9 cells a side; also of cameras that move all heights of a pair, which is no contradiction."""
    truth, cells = hills(2)[1 - wrong].copy(), hills(2)
    cells[wrong, 20:29, 20:29] += off
    cells[1] += cameras
    kept = consensus(cells, PIXEL[:2])
    patch = np.zeros(truth.shape, bool)
    patch[20:29, 20:29] = True
    assert kept[:, ~patch].all()
    assert kept[1 - wrong, patch].mean() > 0.98
    assert not kept[wrong, patch].any()
    found = heights_of(cells) - (0.0 if not cameras else np.where(kept.all(axis=0), 25.0, 50.0 * (1 - wrong)))
    assert np.nanmax(np.abs(found - truth)) < 0.3


def test_of_two_pairs_against_two_the_neighbours_decide_and_two_against_one_need_none():
    cells = hills(4)
    cells[2:, 20:26, 20:26] += 8.0
    kept = consensus(cells, PIXEL)
    assert kept[:2].all()
    assert not kept[2:, 20:26, 20:26].any()
    cells = hills(3)
    cells[0] += np.where(np.indices(cells[0].shape).sum(axis=0) % 2, 8.0, -8.0)  # wrong everywhere, to either side
    kept = consensus(cells, PIXEL[:3])
    assert kept[1:].all()
    assert not kept[0].any()


def test_heights_a_pixel_of_disparity_apart_are_one_surface_of_the_coarser_pair():
    cells = hills(2) * 0.0
    cells[1, 10, 10], cells[1, 30, 30] = 2.99, 3.01
    kept = consensus(cells, np.array([1.0, 3.0], np.float32))
    assert kept[:, 10, 10].all()
    assert kept[:, 30, 30].tolist() == [True, False]


def test_where_neighbours_know_nothing_or_as_much_of_both_a_contradiction_is_void():
    cells = np.full((2, 40, 40), np.nan, np.float32)
    cells[:, 5, 5] = 0.0, 10.0
    cells[:, 18:, :] = 0.0  # 13 cells away
    assert not consensus(cells, PIXEL[:2])[:, 5, 5].any()
    cells[:, 17, 5] = 0.0
    assert consensus(cells, PIXEL[:2])[:, 5, 5].tolist() == [True, False]
    cells = np.zeros((2, 41, 41), np.float32)
    cells[:, :, 21:] = 10.0  # a roof, and between it and the ground a column in which the pairs contradict
    cells[1, :, 20] = 10.0
    found = heights_of(cells)
    assert np.isnan(found[:, 20]).all()
    assert set(np.unique(found[:, :20])) == {0.0}
    assert set(np.unique(found[:, 21:])) == {10.0}
    cells[:, :, 18] = np.nan  # of the neighbours, every second cell, the roof has more then
    assert set(np.unique(heights_of(cells)[:, 20])) == {10.0}


def test_a_single_pair_is_asked_only_where_it_is_surrounded_and_a_slope_at_a_border_stays():
    cells = hills(2, 60, slope=2.0)  # two metres a cell
    cells[1, :20] = np.nan  # nothing but one pair's: 20 rows
    kept = consensus(cells, PIXEL[:2])
    assert kept[0].all()
    cells = hills(2, 60)
    cells[1, 28:32, 28:32] = np.nan
    assert consensus(cells, PIXEL[:2])[0].all()
    cells[0, 28:32, 28:32] += 9.0
    kept = consensus(cells, PIXEL[:2])
    assert not kept[:, 28:32, 28:32].any()
    assert kept[0].sum() == kept[0].size - 16
    alone = hills(1)
    alone[0, ::2] += 50.0
    assert consensus(alone, PIXEL[:1]).all()
    alone = np.concatenate([alone, np.full_like(alone, np.nan)])
    assert consensus(alone, PIXEL[:2])[0].all()
    assert not consensus(alone, PIXEL[:2])[1].any()


def test_beyond_a_straight_border_of_the_others_two_cells_are_asked_and_no_more():
    cells = np.zeros((2, 60, 60), np.float32)
    cells[1, :30] = np.nan
    cells[0, 20:30] = 9.0  # a wall, as far as the others could tell
    kept = consensus(cells, PIXEL[:2])[0, :, 15:-15].all(axis=1)
    assert kept.tolist() == [True] * 28 + [False] * 2 + [True] * 30


def test_the_median_of_what_is_known_is_numpys():
    rng = np.random.default_rng(3)
    values = rng.normal(size=(5, 20, 30))
    values[rng.random(values.shape) < 0.5] = np.nan
    values[:, 0, 0] = np.nan
    np.testing.assert_allclose(finite_median(values), known_median(values), rtol=1e-15)


def test_a_tile_says_which_pairs_it_took_and_how_far_all_of_them_disagree(monkeypatch):
    """Sigma is that of the pairs taken; the disagreement counts what was left, too."""
    cells = hills(3) * 0.0
    cells[1, 10, 10] = 20.0
    cells[:, 20, 20] = np.nan, 5.0, -5.0
    cells[:, 30, 30] = 0.0, np.nan, np.nan
    sigma = np.broadcast_to(np.array([1.0, 2.0, 4.0], np.float32)[:, None, None], cells.shape)
    metres = iter([2.0, 1.5, 2.5])
    monkeypatch.setattr(
        stereo, "_tile_points", lambda pair, tile, band: [(np.zeros((1, 3)), np.ones(1), 0.9, next(metres))]
    )
    made = iter(np.stack([cells, sigma], axis=1))
    monkeypatch.setattr(stereo, "gathered", lambda *given: next(made))
    tile = SimpleNamespace(size=(48, 48))
    height, nmad, noise, seen, shares = surface_tile([(0, 1), (0, 2), (1, 2)], tile, 1)
    assert (height[10, 10], seen[10, 10]) == (0.0, 5.0)
    assert noise[10, 10] == pytest.approx(np.sqrt(8.5))
    assert nmad[10, 10] == 0.0
    assert np.isnan([one[20, 20] for one in (height, nmad, noise)]).all()
    assert (seen[20, 20], seen[30, 30], seen[0, 0]) == (0.0, 1.0, 7.0)
    assert (height[30, 30], noise[30, 30]) == (0.0, 1.0)
    assert np.isnan(nmad[30, 30])
    assert noise[0, 0] == pytest.approx(np.sqrt(7.0))
    np.testing.assert_allclose(shares, 0.9)
    assert {one.dtype for one in (height, nmad, noise, seen, shares)} == {np.dtype(np.float32)}


# --- on ground that is known ------------------------------------------------------------------------------


def pale(scene: Scene) -> None:
    """Little texture: a quarter of the usual contrast."""
    for surface in scene.surfaces:
        surface.ground.values[...] = surface.ground.values.mean() + 0.25 * (
            surface.ground.values - surface.ground.values.mean()
        )
        surface.detail.values[...] *= 0.25


def canopy(scene: Scene) -> None:
    """Bumps of metres on the ground, steeper than it, as crowns have."""
    relief = scene.terrain.relief.values
    bumps = fractal(np.random.default_rng(99), relief.shape, 0.8, 2.5)
    steepest = max(np.abs(np.diff(bumps, axis=axis)).max() for axis in (0, 1)) / scene.terrain.relief.step
    relief += (1.3 / steepest * np.maximum(bumps, -0.5)).astype(np.float32)


KINDS = {
    "town": ({"relief": 20.0, "buildings": 25.0, "seed": 1006}, None),
    "two dates": ({"relief": 30.0, "sun_azimuth": (150.0, 190.0), "change": 0.3, "seed": 1013}, None),
    "steep": ({"relief": 300.0, "buildings": 4.0, "seed": 1004}, None),
    "forest": ({"relief": 40.0, "buildings": 2.0, "seed": 1032}, canopy),
    "pale": ({"relief": 40.0, "buildings": 6.0, "seed": 1031}, pale),
}


@pytest.mark.nightly
@pytest.mark.parametrize("kind", rest_slow(list(KINDS), 2, pytest.mark.nightly))
def test_few_cells_are_grossly_wrong_and_hardly_any_is_lost(kind, tmp_path, monkeypatch):
    """Beside the median of all pairs; a height is wrong that is more than 5 m off all ground within a cell."""
    given, changed = KINDS[kind]
    scene = Scene(replace(SMALL, size=(600, 600), turn=0.37, **given))
    if changed is not None:
        changed(scene)
    found = Rendered(scene, tmp_path).write()
    block = block_of_images(found.paths, found.alts, 1)
    ((_, tile, (group,)),) = Grid(block, DsmOptions(alt=found.alts)).tiles
    truth = found.truth_in(tile)
    low = minimum_filter(np.where(np.isfinite(truth), truth, np.inf), 3)
    high = maximum_filter(np.where(np.isfinite(truth), truth, -np.inf), 3)
    pairs = [(block.views[i], block.views[j]) for i, j in group]
    after = surface_tile(pairs, tile, 1)[0]
    monkeypatch.setattr(stereo, "consensus", lambda heights, metres: np.isfinite(heights))
    before = surface_tile(pairs, tile, 1)[0]
    gross = [np.mean(((one < low - 5.0) | (one > high + 5.0))[np.isfinite(one)]) for one in (before, after)]
    assert gross[1] < (0.03 if kind == "pale" else 0.01)
    assert gross[1] < 0.7 * gross[0]
    lost = 1.0 - np.isfinite(after).sum() / np.isfinite(before).sum()
    assert 0.0 < lost < (0.015 if kind == "pale" else 0.01)
