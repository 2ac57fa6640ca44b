"""The plain model beside a larger one, on all tie points: what is excluded still counts."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks
from barpc.ba.select import champion, models
from barpc.ba.select.champion import Bands, compared, is_closer
from barpc.base.statistics import BANDS
from barpc.sensor.triangulation import epipolar_offset
from barpc.simulate import simulate_block
from tests.ba.residuals import started


@pytest.fixture(scope="module")
def block() -> Any:
    return simulate_block(3, 1500, seed=21)


def delivered(made: Any, xy: np.ndarray | None = None, noise: float = 1.0, params: Any = None) -> tuple[Any, Any]:
    """A solution that leaves the cameras as delivered, or as `params`, and the tie points of its block."""
    ties, problem, state, _ = started(made if xy is None else replace(made, tracks=replace(made.tracks, xy=xy)))
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
    offsets = bands.offsets(found)
    offsets[np.random.default_rng(1).random(len(offsets)) < 0.3] = np.nan
    offsets[bands.group == 0] = np.nan
    offsets[np.flatnonzero(bands.group == 1)[11:]] = np.inf  # of 11 nothing is known, of 12 enough
    offsets[np.flatnonzero(bands.group == 2)] = np.arange(bands.count[2])
    middle = bands.medians(offsets)
    error = bands.errors(offsets, middle)
    for band in range(len(bands.count)):
        known = offsets[(bands.group == band) & np.isfinite(offsets)]
        if len(known) < 12:
            assert np.isnan([middle[band], error[band]]).all()
            continue
        assert middle[band] == np.median(known)
        deviation = np.median(np.abs(known - middle[band]))
        assert error[band] == pytest.approx(1.2533 * 1.4826 * deviation / np.sqrt(bands.count[band]), rel=1e-4)
    assert np.isnan(middle[:2]).all()
    assert np.isfinite(middle[2:]).all()


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
    both = adjust_tracks(block.views, replace(tracks, xy=xy), AdjustOptions(terms="none"))
    compromise, ties = delivered(block, xy, params=both.params)
    of_half, _ = delivered(block, xy, params=found.params, noise=0.9)
    assert not is_closer(of_half, compromise, ties)
    xy = tracks.xy.copy()
    xy[far[tracks.point] & (tracks.view == 2) & (rng.random(len(tracks)) < 0.6)] += (3.0, 3.0)  # a cloud of 30 %
    spread = adjust_tracks(block.views, replace(tracks, xy=xy), AdjustOptions(terms="none"))
    compromise, ties = delivered(block, xy, params=spread.params, noise=9.0)
    of_half, _ = delivered(block, xy, params=found.params)
    assert is_closer(of_half, compromise, ties)


# --- what moves, and which of two groups is the ground ----------------------------------------------------------


def moving(made: Any, share: float, by: float, dates: tuple[str, ...] = ("", "", "")) -> tuple[Any, Any, np.ndarray]:
    """A block with a corner of its ground that moves by so many pixels a view; and which tracks are on it."""
    tracks = made.tracks
    first = np.full(tracks.num_points, np.nan)
    for v in range(len(made.views)):
        rows = np.flatnonzero(tracks.view == v)
        new = rows[np.isnan(first[tracks.point[rows]])]
        first[tracks.point[new]] = tracks.xy[new, 0] + 0.7 * tracks.xy[new, 1]
    member = first < np.quantile(first, share)
    xy = tracks.xy + np.outer(member[tracks.point] * by * tracks.view / (len(made.views) - 1), (0.6, 0.8))
    views = tuple(replace(view, date=date) for view, date in zip(made.views, dates, strict=False))
    return views, replace(tracks, xy=xy), member


@pytest.mark.parametrize(("by", "seen"), [(0.3, False), pytest.param(20.0, True, marks=pytest.mark.costs(5))])
def test_ground_that_moves_within_a_pass_moves_by_more_than_matches_err(block: Any, by: float, seen: bool) -> None:
    views, tracks, member = moving(block, 0.35, by)
    found = adjust_tracks(views, tracks)
    assert found.moving.any() == seen
    if seen:
        np.testing.assert_allclose(found.moving[~found.held_out], member[tracks.point][~found.held_out], atol=1)
        assert np.mean(found.moving != member[tracks.point]) < 0.02
        (one,) = (finding for finding in found.findings if finding.motion is not None)
        # the largest displacement across the base, 0.5 m a pixel: less than the whole motion, which may be height
        assert 1.0 < one.motion.metres < 11.0


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore::barpc.base.errors.BarpcWarning")  # angles of wrong matches
def test_a_deck_that_covers_more_than_half_is_told_by_the_priors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its cameras are far from where they were delivered; without that it is the larger group that stands."""
    made = simulate_block(4, 1200, seed=1)
    views, tracks, member = moving(made, 0.6, 100.0, ("",) * 4)
    exchanged: list[bool] = []
    before = models._likelier_ground

    def noted(found: Any, parts: Any, *rest: Any) -> Any:
        out = before(found, parts, *rest)
        exchanged.append(out[1] is not parts)
        return out

    monkeypatch.setattr(models, "_likelier_ground", noted)
    adjust_tracks(views, tracks)
    assert exchanged[:1] == [True]
    exchanged.clear()
    adjust_tracks(views, moving(made, 0.45, 20.0, ("",) * 4)[1])
    assert exchanged == [False]
    assert member.mean() == pytest.approx(0.6, abs=0.01)


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore::barpc.base.errors.BarpcWarning")  # angles of wrong matches
def test_a_view_that_most_contradict_is_left_out_where_the_others_depend_on_it(monkeypatch: pytest.MonkeyPatch) -> None:
    made = simulate_block(4, 600, seed=1)
    tracks, rng = made.tracks, np.random.default_rng(1)
    wrong = (tracks.view == 3) & (rng.random(len(tracks)) < 0.6)
    xy = tracks.xy + wrong[:, None] * rng.uniform(-30, 30, tracks.xy.shape)
    mixed = replace(tracks, xy=xy)
    found = adjust_tracks(made.views, mixed)
    assert found.apart is None  # its wrong matches lie anywhere and are cut: the others stay as without it
    three = adjust_tracks(made.views[:3], tracks.select(tracks.view < 3))
    monkeypatch.setattr(models, "SURE_TREND", 1e-9)
    alone = adjust_tracks(made.views, mixed)
    assert (alone.apart.views, alone.apart.clear) == ((3,), True)
    np.testing.assert_array_equal(alone.params[3], 0.0)
    off = np.abs(alone.params[:3] - three.params).max()
    assert off < 0.2 * np.abs(three.params).max()  # other tracks are held out
