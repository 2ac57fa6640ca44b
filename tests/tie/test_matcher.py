"""Any matcher goes through the whole stage: dense correlation, one that looks everywhere, one that guesses."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import ClassVar

import cv2
import numpy as np
import pytest

from barpc.base.errors import TiePointError
from barpc.tie import Keypoints, Matches, TieOptions, find_tracks
from barpc.tie.matchers.matcher import Prediction
from barpc.tie.pixels import levelled, read_pixels
from tests.lanes import rest_slow
from tests.tie.stages import common_tracks

HALF = 8
STEP = 12


class Correlated:
    """Normalised correlation on a grid of A, pixel by pixel of each point's band in B."""

    detects: ClassVar[bool] = False

    def __init__(self, options: TieOptions, keypoints: tuple[Keypoints, Keypoints]) -> None:
        assert [len(k) for k in keypoints] == [0, 0]
        self.band = options.band

    def match(self, a, b, prediction: Prediction) -> Matches:
        first, second = (levelled(*read_pixels(v.path, (0, 0, *v.size), self.band)) for v in (a, b))
        grid = [
            (x, y)
            for col, row, width, height in prediction.windows()
            for y in range(max(row, HALF), min(row + height, a.size[1] - HALF), STEP)
            for x in range(max(col, HALF), min(col + width, a.size[0] - HALF), STEP)
        ]
        points = np.array(grid, dtype=np.float64)[prediction.chosen(len(grid))]
        where = prediction.at(points)
        ends = np.stack([where.place(where.before), where.place(where.after)])
        low, high = ends.min(axis=0) - prediction.half_width, ends.max(axis=0) + prediction.half_width
        low = np.maximum(np.floor(low).astype(int), HALF)
        high = np.minimum(np.ceil(high).astype(int), np.array(b.size) - HALF - 1)
        found, score = [], []
        for (x, y), (left, top), (right, bottom) in zip(points.astype(int), low, high, strict=True):
            if right <= left or bottom <= top:
                found.append((np.nan, np.nan))
                score.append(2.0)
                continue
            patch = first[y - HALF : y + HALF + 1, x - HALF : x + HALF + 1]
            place = second[top - HALF : bottom + HALF + 1, left - HALF : right + HALF + 1]
            likeness = cv2.matchTemplate(place, patch, cv2.TM_CCOEFF_NORMED)
            row, col = np.unravel_index(likeness.argmax(), likeness.shape)
            found.append((left + col, top + row))
            score.append(1.0 - likeness[row, col])
        xy = np.stack([points, np.array(found, dtype=np.float64)], axis=1)
        good = np.flatnonzero((np.array(score) < 0.3) & prediction.contains(xy))
        return Matches.of_places(xy[good], np.array(score)[good])


class Everywhere(Correlated):
    """Looks once, in a wide band, and asks of what it found what was predicted."""

    def match(self, a, b, prediction: Prediction) -> Matches:
        if not hasattr(self, "found"):
            self.found = super().match(a, b, replace(prediction, probes=None, half_width=90.0))
        return self.found.select(prediction.contains(self.found.xy))


class Guessing(Correlated):
    """Any place in the band, with any score."""

    def match(self, a, b, prediction: Prediction) -> Matches:
        rng = np.random.default_rng(0)
        points = rng.uniform(30, np.array(a.size) - 30, (2000, 2)).round()
        where = prediction.at(points)
        along = rng.uniform(where.before, where.after)
        aside = rng.uniform(-1, 1, len(points)) * prediction.half_width
        xy = np.stack([points, where.moved(aside).place(along)], axis=1)
        return Matches.of_places(xy, rng.uniform(0, 1, len(points)))


@pytest.fixture(params=rest_slow([Correlated, Everywhere]))
def matcher(request, in_table) -> str:
    return in_table(request.param)


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(("number", "side"), [(2, 300), pytest.param(3, 600, marks=pytest.mark.nightly)])
def test_a_dense_matcher_gives_tracks_as_good_as_the_detectors(render, matcher, number: int, side: int) -> None:
    scene, share = render(views=number, size=(side, side)), (side / 600) ** 2
    result = find_tracks(scene.views, TieOptions(matcher=matcher))
    tracks = result.tracks
    assert result.keypoints == (0,) * number
    assert all(report.status == "ok" and report.control_share <= 0.01 for report in result.pairs)
    assert (np.bincount(tracks.point) == number).sum() > 200 * share
    for i, j in combinations(range(number), 2):
        assert len(common_tracks(tracks, i, j)[0]) > 300 * share
        assert scene.typical(tracks, i, j).max() <= 0.06
        assert (np.abs(scene.errors_of(tracks, i, j)).max(axis=1) > 1.0).mean() <= 0.02


def test_a_matcher_that_guesses_is_not_believed(scene, in_table) -> None:
    with pytest.raises(TiePointError, match=r"no common offset|too few matches"):
        find_tracks(scene.views, TieOptions(matcher=in_table(Guessing)))


class Blocks(Correlated):
    """What it compares is so wide that all its matches rest on the same few pixels."""

    patch: ClassVar[float] = 150.0


@pytest.mark.slow
def test_matches_of_a_few_patches_are_not_many(scene, in_table) -> None:
    """Templates wider than their pitch share their pixels: of noise so many agree by chance as stand on one patch."""
    with pytest.raises(TiePointError, match="too few matches on common epipolar lines"):
        find_tracks(scene.views, TieOptions(matcher=in_table(Blocks)))
