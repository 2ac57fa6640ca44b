"""Matching of structure: seasons that keypoints refuse, wrong places refused, decoys that say so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.errors import TiePointError
from barpc.scene import View
from barpc.tie import Matches, PairReport, TieOptions, common_tracks, find_tracks, matching, select_pairs
from barpc.tie.epipolar import robust_affine
from barpc.tie.features import join
from barpc.tie.matcher import NO_MATCHES
from barpc.tie.matching import STRUCTURE, _altitudes, _better, _match_within, _within, match_pair
from barpc.tie.raster import read_pixels
from barpc.tie.structure import register_places
from tests.scenes.season import SEASONS, disguised
from tests.tie.conftest import write_image


@pytest.fixture(scope="module")
def winter(render, tmp_path_factory) -> tuple[View, View]:
    """Two views of a scene, the second under half a metre of snow for 40 %, a quarter of its classes turned over."""
    first, second = render(views=2).views
    pixels, _ = read_pixels(second.path, (0, 0, *second.size))
    path = tmp_path_factory.mktemp("winter") / "winter.tif"
    write_image(path, disguised(pixels, 1, *SEASONS["winter"]))
    return first, replace(second, path=str(path))


@pytest.fixture(scope="module")
def tied(winter):
    return find_tracks(winter)


def test_what_keypoints_find_too_little_of_is_tied_by_structure(render, winter, tied) -> None:
    report = tied.pairs[0]
    assert report.matcher == STRUCTURE
    assert 0.0 <= report.control_share <= 0.05
    first, second = common_tracks(tied.tracks, 0, 1)
    errors = render(views=2).errors(0, 1, first, second)
    assert 200 < len(errors) < 800
    spread = 1.4826 * np.median(np.abs(errors - np.median(errors, axis=0)), axis=0)
    assert 0.02 < spread.min() < 0.2
    assert spread.max() < 0.4
    assert (np.abs(np.median(errors, axis=0)) < 0.1).all()
    assert (np.abs(errors).max(axis=1) > 2.0).mean() <= 0.05
    assert 0.05 < tied.tracks.sigma.mean() < 0.2  # half of the variance at either end


def test_the_same_images_give_the_same_bytes(winter) -> None:
    one, two = (find_tracks(winter, TieOptions(matcher=STRUCTURE)).tracks for _ in range(2))
    assert one.xy.tobytes() == two.xy.tobytes()


def test_another_place_is_refused(render, winter) -> None:
    other = render(views=2, seed=5).views[1]
    with pytest.raises(TiePointError, match=r"no common offset|too few matches"):
        find_tracks(
            [winter[0], replace(winter[1], path=other.path)], TieOptions(matcher=STRUCTURE, search=90.0)
        )


def test_as_delivered_it_is_a_tenth_of_a_pixel_off(render) -> None:
    scene = render(views=2)
    found = find_tracks(scene.views, TieOptions(matcher=STRUCTURE))
    errors = scene.errors(0, 1, *common_tracks(found.tracks, 0, 1))
    spread = 1.4826 * np.median(np.abs(errors), axis=0)
    assert len(errors) > 500
    assert 0.01 < spread.min() < 0.1  # across the epipolar lines
    assert 0.01 < spread.max() < 0.25  # along them: a patch sees more than its middle's altitude
    assert found.keypoints == (0, 0)


def test_a_patch_is_registered_where_the_truth_says(render) -> None:
    scene = render(views=2)
    a, b = scene.views
    at = np.stack(np.meshgrid(np.arange(100.0, 500.0, 40.0), np.arange(100.0, 500.0, 40.0)), -1).reshape(
        -1, 2
    )
    known = [scene.errors(0, 1, one[None], np.zeros((1, 2))) for one in at]
    at = at[[len(one) > 0 for one in known]]  # not beside a step
    truth = np.concatenate(known)
    assert len(at) > 50
    linear = np.broadcast_to(np.eye(2), (len(at), 2, 2))
    xy, ok, score = register_places([(v.path, v.size) for v in (a, b)], 1, at, truth + [1.0, -1.0], linear)
    assert ok.mean() > 0.8
    assert (np.abs(np.median((xy - truth)[ok], axis=0)) < 0.05).all()
    assert (1.4826 * np.median(np.abs((xy - truth)[ok]), axis=0) < [0.15, 0.25]).all()
    assert ((score[ok] > 0.1) & (score[ok] < 1.0)).all()


def test_two_dates_of_a_satellite_lie_where_they_lie(shared_data) -> None:
    """Fields ten days apart on one grid, a corner of one under clouds, another without data."""
    paths = sorted((shared_data / "optical/s2_two_dates").glob("*.tif"))
    grid = np.stack(np.meshgrid(np.arange(200.0, 920.0, 40.0), np.arange(200.0, 1160.0, 40.0)), -1).reshape(
        -1, 2
    )
    files, linear = (
        [(str(path), (1200, 1200)) for path in paths],
        np.broadcast_to(np.eye(2), (len(grid), 2, 2)),
    )
    xy, ok, _ = register_places(files, 1, grid, grid + [-0.6, 1.9], linear)
    common = [robust_affine(grid[ok], (xy - grid)[ok, k]) for k in (0, 1)]
    apart = np.hypot(*((xy - grid)[:, k] - fit(grid) for k, fit in enumerate(common)))
    assert (ok & (apart < 1.0)).mean() >= 0.95
    assert 0.03 < np.median(apart[ok]) <= 0.15
    assert np.abs([fit.coefficients[0] for fit in common] - np.array([-0.66, 1.85])).max() < 0.1


def test_terrain_or_other_ties_narrow_the_altitudes(render) -> None:
    views = tuple(render(views=2).views)
    low, high = views[0].alt_range
    middle = 0.5 * (low + high)
    flat = _within(views, lambda lon, lat: np.full(len(lon), middle), (low, low))
    assert flat[0].alt_range == flat[1].alt_range == (max(low, middle - 150), min(high, middle + 150))
    assert _within(views, None, None) == views
    assert _within(views, None, (high + 1e4, high + 2e4)) == views
    assert _within(views, lambda lon, lat: np.full(len(lon), np.nan), (low, low))[0].alt_range[1] == min(
        high, low + 150
    )
    assert _within(views, None, (middle, middle), 50.0)[0].alt_range == (
        max(low, middle - 50),
        min(high, middle + 50),
    )
    pair = select_pairs(views, TieOptions())[0]
    found, report = match_pair(views, (join([]), join([])), pair, TieOptions(matcher=STRUCTURE))
    known = _altitudes([(views, found)])
    seen = render(views=2).altitude[0]
    assert known is not None
    assert abs(known[0] - np.nanpercentile(seen, 2)) < 40  # cameras as delivered
    assert abs(known[1] - np.nanpercentile(seen, 98)) < 40
    assert _altitudes([]) is None
    assert report.matcher == STRUCTURE


@pytest.mark.parametrize("seen", [False, True])
def test_only_terrain_that_both_may_see_counts(render, seen) -> None:
    first, second = render(views=2).views
    middle, flat = (
        0.5 * sum(first.alt_range),
        first.sensor.localize(np.array([[150.0, 300.0]]), np.array([0.0])),
    )
    half = replace(second, sensor=second.sensor.crop(0.0 if seen else 450.0, 0.0), size=(150, 600))

    def hilly(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
        """A hill where the first image has its column 150."""
        away = np.hypot((lon - flat[0, 0]) * np.cos(np.radians(lat)), lat - flat[0, 1]) * 111e3
        return np.where(away < 60.0, middle + 20.0, middle)

    found = _within((first, half), hilly, None, 50.0)[0].alt_range[1]
    assert found == min(first.alt_range[1], middle + (70.0 if seen else 50.0))


def test_fewer_altitudes_are_tried_where_all_find_few(render, monkeypatch) -> None:
    views, asked = tuple(render(views=2).views), []
    wide, narrow = (
        (replace(views[0], alt_range=around), views[1]) for around in ((0.0, 300.0), (100.0, 200.0))
    )

    def few(pair: tuple[View, View], *_: object) -> tuple[Matches, PairReport]:
        asked.append(pair[0].alt_range)
        return NO_MATCHES, PairReport(("a", "b"), "ok", (0, 0), verified=most // len(asked))

    monkeypatch.setattr(matching, "match_pair", few)
    for most, tries in ((99, 2), (100, 1)):
        asked.clear()
        report = _match_within(
            [wide, narrow], (join([]), join([])), select_pairs(views, TieOptions())[0], TieOptions()
        )[1]
        assert report.verified == most
        assert asked == [(0.0, 300.0), (100.0, 200.0)][:tries]


def test_the_attempt_with_more_verified_matches_counts_and_a_refused_one_never(render) -> None:
    views = tuple(render(views=2).views)
    pair = select_pairs(views, TieOptions())[0]
    found, report = match_pair(views, (join([]), join([])), pair, TieOptions(matcher=STRUCTURE))
    few, refused = replace(report, verified=20), replace(report, verified=900, status="too few matches")
    for attempts, best in (
        ((few, report, refused), report),
        ((refused, few), few),
        ((few, replace(few, loosened=True)), few),
    ):
        won = _better(*((found, attempt) for attempt in attempts))[1]
        assert len(won.beaten) == len(attempts) - 1
        assert replace(won, beaten=()) == best
