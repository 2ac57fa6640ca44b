"""Matches of others: noisy true ones become as exact as our own, false ones go, the rest of the pairs is matched."""

from __future__ import annotations

import logging
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

import barpc.tie.pixels as reading
from barpc.base.errors import DisconnectedError, TiePointError
from barpc.scene import Tracks
from barpc.tie import Matches, Scope, TieOptions, find_tracks
from barpc.tie.linking import pair_counts
from barpc.tie.pairing.epipolar import epipolar_segments
from tests.lanes import rest_slow
from tests.tie.stages import common_tracks

from .conftest import SIDES, Rendered, altered

PAIRS = ((0, 1), (0, 2), (1, 2))


def true_matches(
    scene: Rendered, *pairs: tuple[int, int], count: int = 500, noise: float = 0.4, false: float = 0.0
) -> dict[tuple[int, int], Matches]:
    """Places that the exact cameras join, each coordinate with noise; pairs have the points of the first view alike."""
    made = {}
    for pair in pairs:
        rng = np.random.default_rng(pair[0])
        side = scene.scene.options.size[0]
        first = rng.uniform(30, side - 31, (4 * count, 2))
        numbers = np.arange(len(first))
        xy = np.stack([first, scene.place(*pair, first)], axis=1)
        rows = np.flatnonzero(((xy > 30) & (xy < side - 31)).all(axis=(1, 2)))[:count]
        xy = xy[rows] + rng.normal(0, noise, (len(rows), 2, 2))
        wrong = rng.random(len(xy)) < false
        xy[wrong, 1] = rng.uniform(30, side - 31, (wrong.sum(), 2))
        index = -1 - np.stack([numbers[rows], numbers[rows] + 10_000 * (1 + sum(pair))], axis=1)
        made[pair] = Matches(xy, np.zeros(len(xy)), index)
    return made


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(
    ("views", "noise", "false"),
    rest_slow(pytest.param(*row) for row in ((2, 0.4, 0.6), (3, 0.4, 0.6), (3, 0.3, 0.0), (3, 0.5, 0.0))),
)
def test_half_a_pixel_becomes_a_tenth_and_false_matches_go(
    render, views: int, noise: float, false: float, side: int
) -> None:
    scene, pairs = render(views=views, size=(side, side)), PAIRS if views == 3 else PAIRS[:1]
    given = true_matches(scene, *pairs, noise=noise, false=false)
    result = find_tracks(scene.views, scope=Scope(given=given))
    assert result.keypoints == (0,) * views  # nothing else is looked for
    for pair, report in zip(pairs, result.pairs, strict=True):
        true = (1 - false) * len(given[pair])
        assert report.status == "ok"
        assert 0.75 * true <= report.verified <= 1.15 * true
        assert noise < report.spread < 2 * noise  # of both ends together
        assert pair_counts(result.tracks)[pair] >= 0.55 * true
        assert scene.typical(result.tracks, *pair).max() <= 0.1
        errors = np.abs(scene.errors_of(result.tracks, *pair)).max(axis=1)
        assert (errors > 1.0).mean() <= 0.02


def blank(pixels: np.ndarray) -> np.ndarray:
    return np.full_like(pixels, 900)


def shifted(scene: Rendered, by: tuple[float, float]) -> dict[tuple[int, int], Matches]:
    """Places in the first view and, all in one direction, beside the true ones of the second."""
    given = true_matches(scene, (0, 1), noise=0.2)[0, 1]
    return {(0, 1): replace(given, xy=given.xy + np.array([[0.0, 0.0], by]))}


@pytest.mark.landing(1)
@pytest.mark.parametrize("count", rest_slow((13, 6, 500)))
def test_false_matches_are_as_none_given_and_that_is_said(scene, caplog, count: int) -> None:
    alone = find_tracks(scene.views)
    result = find_tracks(scene.views, scope=Scope(given=true_matches(scene, (0, 1), count=count, false=1.0)))
    assert result.tracks.xy.tolist() == alone.tracks.xy.tolist()
    assert re.search(rf"of {count} matches given 0 are verified \(.*\): own are used, ok, \d\d\d", caplog.text)


@pytest.mark.landing(1)
@pytest.mark.parametrize("by", rest_slow(((3.0, -4.0), (-30.0, 0.0), (0.0, 9.0))))
def test_matches_that_agree_with_each_other_and_with_no_pixel_give_way_to_own_ones(scene, caplog, by) -> None:
    """As those of other crops, or of another pair, do: their epipolar lines are straight, and elsewhere."""
    result = find_tracks(scene.views, scope=Scope(given=shifted(scene, by)))
    assert re.search(
        r"of \d\d\d matches given \d\d? could be registered, of own ones \d{3,4}: these are used", caplog.text
    )
    assert result.pairs[0].matcher == "guided"
    assert scene.typical(result.tracks).max() <= 0.1
    assert np.abs(np.median(scene.errors_of(result.tracks), axis=0)).max() <= 0.05


@pytest.mark.parametrize(("count", "used"), [(25, False), (400, True)])
def test_few_true_matches_have_own_ones_beside_them(scene, caplog, count: int, used: bool) -> None:
    result = find_tracks(scene.views, scope=Scope(given=true_matches(scene, (0, 1), count=count)))
    assert (result.pairs[0].matcher == "given") is used
    assert ("own are used" in caplog.text) is not used
    assert scene.typical(result.tracks).max() <= 0.1


@pytest.mark.parametrize(("noise", "used"), [(0.4, True), (7.0, False)])
def test_where_nothing_else_ties_what_agrees_by_chance_is_refused(scene, tmp_path, noise: float, used: bool) -> None:
    """Images that show nothing: a matcher's places, or places that lie as densely beside a line as on it."""
    count = 40
    views = [altered(view, tmp_path, blank) for view in scene.views]
    for seed in range(10):
        given = true_matches(scene, (0, 1), count=count)[0, 1]
        where = epipolar_segments(*views, given.xy[:, 0])
        along = np.random.default_rng(seed).normal(0, [[20.0], [noise]], (2, count))
        places = np.stack([given.xy[:, 0], replace(where, across=where.across + along[1]).place(along[0])], axis=1)
        scope = Scope(given={(0, 1): replace(given, xy=places)})
        if used:
            assert find_tracks(views, scope=scope).tracks.num_points >= 30
            continue
        with pytest.raises(TiePointError, match="too few tie points: view_00 - view_01"):
            find_tracks(views, scope=scope)


@pytest.mark.slow
def test_pairs_that_are_not_given_are_matched_and_points_in_common_are_one_track(three) -> None:
    result = find_tracks(three.views, scope=Scope(given=true_matches(three, (0, 1), (0, 2))))
    assert [report.keypoints[0] == 500 for report in result.pairs] == [True, True, False]
    assert result.pairs[2].verified > 500
    lengths = np.bincount(result.tracks.point)
    assert (lengths == 3).sum() > 150  # of the points that the given pairs share
    for pair in PAIRS:
        assert three.typical(result.tracks, *pair).max() <= 0.1


@pytest.mark.slow
def test_a_camera_that_is_wrong_by_hundreds_of_pixels_does_not_refuse_them(scene) -> None:
    first, second = scene.views
    moved = replace(second, sensor=second.sensor.crop(-300.0, -200.0))
    result = find_tracks([first, moved], scope=Scope(given=true_matches(scene, (0, 1))))
    assert result.pairs[0].verified > 400
    assert np.hypot(*result.pairs[0].offset) > 150
    assert scene.typical(result.tracks).max() <= 0.1


@pytest.mark.slow
def test_a_negative_is_registered_on_channels(three, tmp_path, caplog) -> None:
    """No patch has the grey values of its other; edges are where they were."""
    first, second, third = three.views
    views = [first, altered(second, tmp_path, lambda d: 4000 - d.clip(0, 3999)), third]
    with caplog.at_level(logging.WARNING):
        tracks = find_tracks(views, scope=Scope(given=true_matches(three, *PAIRS, noise=0.4, false=0.2))).tracks
    assert "used as found" not in caplog.text
    for pair in PAIRS:
        assert pair_counts(tracks)[pair] >= 150
        across = np.abs(three.errors_of(tracks, *pair)).min(axis=1)
        assert 0.002 < np.median(across) < (0.05 if pair == (0, 2) else 0.1)
    assert three.typical(tracks, 0, 2).max() <= 0.1  # of one date: by grey values


@pytest.mark.nightly
def test_what_cannot_be_registered_is_used_as_it_is_and_once(scene, tmp_path, caplog) -> None:
    """Of the second image three sixteenths are left, the rest says nothing: places stay true, and each counts once."""
    first, second = scene.views

    def left(pixels: np.ndarray) -> np.ndarray:
        noise = np.random.default_rng(3).integers(100, 3000, pixels.shape).astype(pixels.dtype)
        return np.where(np.arange(300) < 56, pixels, noise)

    views = [first, altered(second, tmp_path, left)]
    given = true_matches(scene, (0, 1), noise=0.3, false=0.2)
    with caplog.at_level(logging.WARNING):
        result = find_tracks(views, TieOptions(min_matches=100), Scope(given=given))
    assert "used as found, good to 0." in caplog.text
    assert 0.7 * 400 <= result.tracks.num_points <= 450
    errors = np.abs(scene.errors_of(result.tracks)).max(axis=1)
    assert 0.2 < np.median(errors) < 0.6
    assert (errors > 3.0).mean() <= 0.02
    exact = result.tracks.sigma < 0.25
    assert 10 < exact.sum() / 2 < 60
    places = np.hstack(common_tracks(result.tracks, 0, 1))
    known = exact[result.tracks.view == 0]
    assert cKDTree(places[~known]).query(places[known])[0].min() > 2.0


@pytest.mark.slow
def test_a_view_that_cannot_be_registered_joins_the_points_that_the_others_are_registered_by(three, tmp_path) -> None:
    """Each point is one track: that of the two views that register, and the third where it was matched."""
    third = altered(three.views[2], tmp_path, blank)
    given = true_matches(three, *PAIRS, noise=0.3)
    result = find_tracks([*three.views[:2], third], TieOptions(min_matches=100), Scope(given=given))
    tracks = result.tracks
    assert [report.unregistered > 100 for report in result.pairs] == [False, True, True]
    assert "by keypoints" in result.pairs[1].means
    assert (np.bincount(tracks.point) == 3).sum() > 100
    places = tracks.xy[tracks.view == 0]
    assert (cKDTree(places).query(places, k=2)[0][:, 1] < 1.0).mean() < 0.03  # two points of one pixel
    errors = np.abs(three.errors_of(tracks, 0, 2))
    assert 0.1 < np.median(errors) < 0.5
    assert (errors > 3.0).mean() <= 0.02


def test_no_more_is_read_for_matches_of_others_than_patches_about_them(scene, tmp_path, monkeypatch) -> None:
    """Of nine million pixels an image the corner that the points stand in, once."""
    large = [altered(view, tmp_path, lambda d: np.tile(d, (10, 10)), tiled=True) for view in scene.views]
    read, pixels = reading._RasterBand.read, []

    def watched(band, box, *more):
        pixels.append(box[2] * box[3])
        return read(band, box, *more)

    monkeypatch.setattr(reading._RasterBand, "read", watched)
    given = true_matches(scene, (0, 1), count=200)
    assert find_tracks(large, scope=Scope(given=given)).tracks.num_points > 100
    assert 2 * 290**2 < sum(pixels) <= 2 * 356**2  # 300 and a margin of 28 px


def test_given_pairs_connect_what_the_cameras_say_is_apart(scene) -> None:
    options = TieOptions(angles=(50.0, 60.0))
    with pytest.raises(DisconnectedError, match="no overlap"):
        find_tracks(scene.views, options)
    assert find_tracks(scene.views, options, Scope(given=true_matches(scene, (0, 1)))).tracks.num_points > 300


def test_pairs_are_counted_in_one_go() -> None:
    tracks = Tracks([0, 1, 3, 0, 3, 1, 3], [0, 0, 0, 1, 1, 2, 2], np.zeros((7, 2)), np.ones(7))
    assert pair_counts(tracks) == {(0, 1): 1, (0, 3): 2, (1, 3): 2}
    assert pair_counts(tracks.select(np.zeros(7, dtype=bool))) == {}
