"""An image of which rows or columns lie elsewhere: its tie points are found behind the edge as before it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import shift

from barpc.base.options import TieOptions
from barpc.base.tasks import HERE
from barpc.scene import View
from barpc.tie import find_tracks
from barpc.tie.matchers.given import verify_given
from barpc.tie.matchers.matcher import Matches
from barpc.tie.matchers.pair_search import PairSearch
from barpc.tie.pairing.epipolar import epipolar_segments
from barpc.tie.pairing.overlaps import Pair
from benchmarks.planted import Plant
from tests.tie.conftest import Rendered, altered
from tests.tie.stages import common_tracks

PLANTS = [
    Plant("jump", 1, 1, 150, (0.0, 2.0)),
    Plant("jump", 1, 1, 90, (-12.0, 0.0)),
    Plant("lost", 1, 1, 150, (0.0, -6.0)),
    Plant("detector", 1, 0, 200, (3.0, 0.0)),
    Plant("jump", 1, 1, 230, (0.0, 6.0)),
    Plant("jump", 1, 1, 150, (1.0, 0.0)),
    Plant("jump", 1, 1, 60, (3.0, 0.0)),
    Plant("detector", 1, 0, 100, (0.0, -1.0)),
]


def whole(grey: np.ndarray) -> np.ndarray:
    """Grey values as images have them."""
    return np.clip(np.rint(grey), 0, np.iinfo(np.uint16).max).astype(np.uint16)


def planted(view: View, plant: Plant, folder) -> View:
    """The view as it is delivered with the error."""
    return altered(view, folder, lambda pixels: whole(plant.pixels(pixels.astype(np.float64))))


@pytest.mark.few(4)
@pytest.mark.parametrize("plant", PLANTS, ids=str)
def test_ties_stand_behind_an_edge_as_they_do_before_it(scene: Rendered, plant: Plant, tmp_path) -> None:
    usual, _ = common_tracks(scene.tied.tracks, 0, 1)
    views = [scene.views[0], planted(scene.views[1], plant, tmp_path)]
    first, second = common_tracks(find_tracks(views).tracks, 0, 1)
    true = scene.place(0, 1, first)
    beyond = true[:, plant.axis] > plant.start - 0.5 - min(0.0, plant.by[plant.axis])
    off = second - true - np.where(beyond[:, None], plant.by, 0.0)
    edge = np.abs(true[:, plant.axis] - plant.start) < 12 + np.abs(plant.by).max()
    known = np.isfinite(off).all(axis=1) & ~edge
    assert np.quantile(np.abs(off[known]), 0.95) < 0.25
    assert np.median(np.hypot(*off[known].T)) < 0.1
    before = scene.place(0, 1, usual)[:, plant.axis] > plant.start
    for side in (True, False):  # both sides keep what they had, but for a band about the edge
        assert (beyond == side).sum() > 0.6 * (before == side).sum()


def test_single_places_that_lie_off_their_lines_reach_whoever_judges_them(scene: Rendered, tmp_path) -> None:
    """Patches of an image, far from each other, lie 0.6 px off: no neighbour shares that, and their ties are right."""
    here, there = common_tracks(scene.tied.tracks, 0, 1)
    axis = epipolar_segments(*scene.views, here).axis
    by = 0.6 * np.array([-axis[1], axis[0]])
    far: list[np.ndarray] = []
    for place in there[((there > 30) & (there < 270)).all(axis=1)]:
        if all(np.abs(place - other).max() > 60 for other in far):
            far.append(place)

    def moved(pixels: np.ndarray) -> np.ndarray:
        for col, row in np.rint(far).astype(int):
            near = np.s_[row - 25 : row + 26, col - 25 : col + 26]
            patch = shift(pixels[near].astype(np.float64), by[::-1], order=3, mode="nearest")[7:-7, 7:-7]
            pixels[row - 18 : row + 19, col - 18 : col + 19] = whole(patch)
        return pixels

    two, few = [scene.views[0], altered(scene.views[1], tmp_path, moved)], TieOptions(points_per_image=300)
    first, second = common_tracks(find_tracks(two, few).tracks, 0, 1)
    off = second - scene.place(0, 1, first)
    inside = np.array([np.abs(second - place).max(axis=1) < 8 for place in far])
    assert len(far) >= 8
    found = [np.median(off[one], axis=0) for one in inside if one.any()]
    assert len(found) >= 0.5 * len(far)  # of points as sparse as that few patches hold one
    assert np.abs(np.nanmedian(found, axis=0) - by).max() < 0.1
    beside = ~(np.array([np.abs(second - place).max(axis=1) < 32 for place in far]).any(axis=0))
    assert np.nanmedian(np.hypot(*off[beside].T)) < 0.1


def given(scene: Rendered, jump: tuple[float, float], wrong: float, count: int = 400) -> tuple[Matches, np.ndarray]:
    """Matches of which the lower part of the second view has jumped, and a share lies anywhere; which are right."""
    rng = np.random.default_rng(5)
    first = rng.uniform(20, 280, (3 * count, 2))
    second = scene.place(0, 1, first)
    fine = np.flatnonzero(np.isfinite(second).all(axis=1) & (second > 5).all(axis=1) & (second < 280).all(axis=1))
    first, second = first[fine[:count]], second[fine[:count]] + rng.normal(0.0, 0.1, (count, 2))
    second += np.where(second[:, 1:] > 150, jump, 0.0)
    right = rng.uniform(size=count) >= wrong
    second[~right] = rng.uniform(20, 280, ((~right).sum(), 2))
    return Matches.of_places(np.stack([first, second], axis=1), np.zeros(count)), right


@pytest.mark.parametrize("wrong", [0.1, 0.3, 0.5])
@pytest.mark.parametrize("jump", [(0.0, 0.0), (2.0, 0.0), (12.0, 0.0), (0.0, -6.0)])
def test_of_given_matches_those_behind_a_jump_stay_and_those_anywhere_go(scene: Rendered, jump, wrong: float) -> None:
    matches, right = given(scene, jump, wrong)
    pair = Pair((0, 1), 1.0, 5.0)
    ((found, report),) = verify_given(scene.views, {(0, 1): matches}, [pair], TieOptions(), HERE)
    assert report.status == "ok"
    kept = (found.xy[:, None] == matches.xy[None]).all(axis=(2, 3)).any(axis=0)
    lower = matches.xy[:, 1, 1] > 150 + jump[1]
    for side in (lower, ~lower):
        assert kept[right & side].mean() > 0.85
    assert kept[~right].sum() <= max(3, 0.03 * kept.sum())


def test_a_clean_pair_is_not_looked_at_for_offsets_that_it_does_not_have(scene: Rendered, monkeypatch) -> None:
    peaks, beside = [], PairSearch._beside
    monkeypatch.setattr(PairSearch, "_beside", lambda *args: peaks.append(beside(*args)) or peaks[-1])
    find_tracks(scene.views)
    assert peaks
    assert not any(peaks)
