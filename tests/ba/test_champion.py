"""The plain model beside a larger one, on all tie points: what is excluded still counts."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks
from barpc.ba.constraints.block import first_state, join, make_problem
from barpc.ba.select import champion
from barpc.ba.select.champion import Bands, compared, is_closer
from barpc.base.statistics import BANDS
from barpc.scene import Tracks
from barpc.sensor.geometry import epipolar_offset
from barpc.simulate import simulate_block


@pytest.fixture(scope="module")
def block() -> Any:
    return simulate_block(3, 1500, seed=21)


def delivered(made: Any, xy: np.ndarray | None = None, noise: float = 1.0, params: Any = None) -> tuple[Any, Any]:
    """A solution that leaves the cameras as delivered, or as `params`, and the tie points of its block."""
    tracks = made.tracks if xy is None else Tracks(made.tracks.view, made.tracks.point, xy, made.tracks.sigma)
    options = AdjustOptions()
    ties = join(made.views, tracks, None, options)
    problem = make_problem(ties, options, None, None)
    state, _ = first_state(problem, ties, options, None)
    final = state if params is None else replace(state, params=params)
    outcome = SimpleNamespace(noise=noise, inlier=ties.use)
    return SimpleNamespace(problem=problem, final=final, outcome=outcome), ties


def test_offsets_are_those_of_the_epipolar_lines(block: Any) -> None:
    """Against rays intersected by the sensors themselves: in the second image, of every pair, with its sign or not."""
    found, ties = delivered(block)
    bands = Bands.of(ties)
    offsets = bands.offsets(found).reshape(5, -1)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        rows = (ties.view[bands.first] == i) & (ties.view[bands.second] == j)
        a, b = ties.xy[:, bands.first[rows]].T, ties.xy[:, bands.second[rows]].T
        truth, _ = epipolar_offset(block.views[i].sensor, block.views[j].sensor, a, b, 300.0)
        assert np.abs(truth).max() > 0.5
        np.testing.assert_allclose(np.abs(offsets[4, rows]), np.abs(truth), rtol=5e-4, atol=2e-3)
        sign = np.sign(offsets[4, rows] * truth)
        assert abs(sign.mean()) > 0.99
        back, _ = epipolar_offset(block.views[j].sensor, block.views[i].sensor, b, a, 300.0)
        np.testing.assert_allclose(np.abs(offsets[0, rows]), np.abs(back), rtol=5e-4, atol=2e-3)


def test_every_pair_has_its_median_and_eight_bands_of_both_images_each_way(block: Any) -> None:
    found, ties = delivered(block)
    bands = Bands.of(ties)
    assert len(bands.count) == 3 * (4 * BANDS + 1)
    assert bands.count.sum() == 5 * len(bands.first)
    middle, error = bands.medians(bands.offsets(found))
    assert np.isfinite(middle).all()
    assert (error > 0).all()
    assert np.isnan(bands.medians(np.full(bands.count.sum(), np.nan))[0]).all()


def test_a_model_that_bends_an_eighth_loses_and_one_that_mends_more_wins(block: Any) -> None:
    """Cameras with their true corrections against the same, one of them shifted: by tie points of rows that lie off."""
    found = adjust_tracks(block.views, block.tracks, AdjustOptions(terms="none"))
    good, ties = delivered(block, params=found.params)
    bent = found.params.copy()
    bent[0, -2] += 0.5  # a drift [m] at the ends of the rows
    worse, _ = delivered(block, params=bent)
    assert compared(good, good, ties) == champion.Comparison(False, 0.0)
    beside = compared(worse, good, ties)
    assert beside.worse
    assert beside.changed > 0.05
    assert not compared(good, worse, ties).worse
    assert compared(good, worse, ties).changed == pytest.approx(beside.changed)
    assert is_closer(good, worse, ties)
    assert not is_closer(worse, good, ties)
    assert not is_closer(good, good, ties)


def test_what_a_model_excludes_still_counts(block: Any) -> None:
    """Two solutions of half of the ties each: the one that fits its own half no better than the other is no ground."""
    rng, tracks = np.random.default_rng(3), block.tracks
    found = adjust_tracks(block.views, tracks, AdjustOptions(terms="none"))
    middle = np.median(tracks.xy[:, 1])
    far = np.zeros(tracks.num_points, dtype=bool)
    far[tracks.point[(tracks.view == 0) & (tracks.xy[:, 1] > middle)]] = True
    xy = tracks.xy.copy()
    xy[far[tracks.point] & (tracks.view == 2)] += (0.06, 0.06)  # as ties of textures err, half a sigma
    moved = replace(block, tracks=Tracks(tracks.view, tracks.point, xy, tracks.sigma))
    both = adjust_tracks(moved.views, moved.tracks, AdjustOptions(terms="none"))
    compromise, ties = delivered(moved, xy, params=both.params)
    of_half, _ = delivered(moved, xy, params=found.params, noise=0.9)
    assert not is_closer(of_half, compromise, ties)
    xy = tracks.xy.copy()
    xy[far[tracks.point] & (tracks.view == 2) & (rng.random(len(tracks)) < 0.6)] += (3.0, 3.0)  # a cloud of 30 %
    clouded = replace(block, tracks=Tracks(tracks.view, tracks.point, xy, tracks.sigma))
    spread = adjust_tracks(clouded.views, clouded.tracks, AdjustOptions(terms="none", loss="linear"))
    compromise, ties = delivered(clouded, xy, params=spread.params, noise=9.0)
    of_half, _ = delivered(clouded, xy, params=found.params)
    assert is_closer(of_half, compromise, ties)
