"""Observations of tracks and their references: what is registered together, believed, and how exactly."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from barpc.tie.pairing.epipolar import epipolar_segments
from barpc.tie.patches.links import _Registrations, _shared_variance, references
from barpc.tie.patches.register import PatchRegistration, _at, register_places, task_parts
from tests.constants import Sized
from tests.everywhere import tied
from tests.geotiffs import write_image
from tests.tie.test_pairs import camera, views
from tests.tie.test_tracks import tracks_of


def test_the_reference_of_a_track_is_the_view_most_like_the_others() -> None:
    tracks = tracks_of((0, 0), (1, 0), (2, 0), (0, 1), (2, 1), (1, 2), (2, 2))
    assert references(tracks, {(0, 1): 0.1, (1, 2): 0.1, (0, 2): 0.5}, 3).tolist() == [1, 3, 5]
    assert references(tracks, {(0, 1): 0.1, (1, 2): 0.5, (0, 2): 0.1}, 3).tolist() == [0, 3, 5]


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
@pytest.mark.parametrize(
    "spreads",
    [
        {(0, 1): 0.1, (0, 2): 0.5, (1, 2): 0.9, (1, 3): 0.9, (2, 3): 0.1},
        {(0, 1): 0.9, (0, 2): 0.9, (1, 2): 1.0, (2, 3): 0.1},
        {(0, 1): 0.1, (0, 2): 0.1, (1, 3): 0.7, (2, 3): 1.0, (1, 2): 0.9},
        {(0, 1): 0.1, (0, 2): 0.1, (1, 3): 0.9, (2, 3): 0.5, (1, 2): 0.5},
    ],
)
def test_a_pair_that_was_not_matched_is_twice_as_unlike_as_the_worst(spreads, scale) -> None:
    def unlike(i: int, j: int) -> float:
        return spreads.get((min(i, j), max(i, j)), 2 * max(spreads.values())) if i != j else 0.0

    best = int(np.argmin([sum(unlike(i, j) for j in range(4)) for i in range(4)]))
    found = references(tracks_of(*((v, 0) for v in range(4))), {p: scale * x for p, x in spreads.items()}, 4)
    assert found.tolist() == [best]


def test_a_point_is_on_the_mask_where_its_nearest_pixel_is() -> None:
    mask = np.zeros((4, 6), dtype=bool)
    mask[0, 0] = mask[3, 5] = mask[0, 5] = mask[2, 3] = mask[1, 1] = True
    places = [[0, 0], [0.4, -0.4], [0, 1], [5, 3], [5.4, 3.4], [5, 0], [5, 2], [3, 2], [2, 3], [-0.6, 0], [0, -0.6],
              [5.6, 3], [5, 3.6], [np.nan, 0], [np.nan, 1], [1, np.nan], [np.nan, np.nan]]  # fmt: skip
    expected = [1, 1, 0, 1, 1, 1, 0, 1] + [0] * 9
    np.testing.assert_array_equal(_at(mask, np.array(places, dtype=float)), np.array(expected, dtype=bool))


def test_the_variance_of_a_registration_is_shared_by_both_ends() -> None:
    tracks = tracks_of((0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (0, 2), (2, 2))
    of_track = np.array([0, 3, 5])
    rows, xy = np.array([1, 2, 4]), np.array([[1.25, 2.5], [3.25, 4.5], [5.5, 6.5]])
    sigma = np.array([0.2, 0.4, 0.01])
    found = _shared_variance(tracks, of_track, rows, xy, sigma)
    assert found.point.tolist() == [0, 0, 0, 1, 1]  # the third is found nowhere
    expected = [np.sqrt((0.02 + 0.08) / 2), np.sqrt(0.02), np.sqrt(0.08), 0.02, 0.02]
    np.testing.assert_allclose(found.sigma, expected)
    np.testing.assert_allclose(found.xy[[1, 2, 4]], xy)
    np.testing.assert_array_equal(found.xy[[0, 3]], np.rint(tracks.xy[[0, 3]]))


@pytest.mark.parametrize(
    ("count", "noise", "scaled"), [(200, 0.3, 0.3), (200, 0.02, 0.1), (29, 0.3, 0.1), (30, 0.3, 0.3)]
)
def test_sigmas_are_those_of_the_epipolar_lines_where_these_say_more(count, noise, scaled) -> None:
    two = views(camera(0.0, lean=0.0), camera(0.0, lean=0.2))
    rng = np.random.default_rng(4)
    places = rng.integers(100, 900, (count, 2)).astype(float)
    tracks = tied(np.stack([places, epipolar_segments(*two, places).place(np.zeros(count))], axis=1), 0.1)
    links = _Registrations(two, tracks, np.arange(0, 2 * count, 2), np.arange(1, 2 * count, 2))
    across = rng.normal(0, noise, count)
    found = PatchRegistration.none(tracks.xy[1::2])
    found.sigma[:] = 0.1
    sigma = links.scaled(found, np.ones(count, dtype=bool), across)
    np.testing.assert_allclose(sigma, scaled, rtol=0.3 if scaled > 0.1 else 1e-12)


def links_of(count: int, seen: int) -> _Registrations:
    """Tracks in a row of `seen` like views, referred to the first."""
    many = views(*(camera(0.0, lean=0.2 * v) for v in range(seen)))
    xy = np.random.default_rng(5).integers(100, 900, (count, 1, 2)).astype(float)
    tracks = tied(np.repeat(xy, seen, axis=1), 0.1)
    rows = np.arange(seen * count)
    other = rows[rows % seen > 0]
    return _Registrations(many, tracks, other - other % seen, other)


def test_links_that_disagree_in_altitude_with_all_their_neighbours_are_torn() -> None:
    """Three views: two links a track, 20 px of half a segment. Two pixels of altitude apart, neither is believed."""
    links = links_of(60, 3)
    good, reach = np.ones(120, dtype=bool), np.full(120, 20.0)
    altitude = np.repeat(np.random.default_rng(1).uniform(-0.5, 0.5, 60), 2)
    assert not links._torn(good, altitude, reach).any()
    wrong = altitude.copy()
    wrong[[10, 41]] += 0.1
    assert np.flatnonzero(links._torn(good, wrong, reach)).tolist() == [10, 11, 40, 41]
    tolerated = altitude.copy()
    tolerated[10] += 0.09 / 20.0  # a tenth of a pixel
    assert not links._torn(good, tolerated, reach).any()
    # an affine function of place is a camera's error
    tilted = altitude.copy()
    tilted[1::2] += 1e-3 * links.origin[1::2, 0] / 20.0 * 20.0
    assert not links._torn(good, tilted, reach).any()
    # short segments tell no altitude, nor do links that are out already
    assert not links._torn(good, wrong, np.full(120, 4.9)).any()
    assert links._torn(good, wrong, np.full(120, 5.1)).sum() == 4
    good[11] = False
    assert np.flatnonzero(links._torn(good, wrong, reach)).tolist() == [40, 41]


def test_what_is_verified_is_at_its_altitude_and_no_less_certain_than_others_on_its_line_or_not() -> None:
    links = links_of(60, 3)
    altitude = np.repeat(np.random.default_rng(1).uniform(-0.5, 0.5, 60), 2)
    xy = np.empty((120, 2))
    for group in links.groups():
        where = epipolar_segments(*links.of(group), links.origin[group])
        xy[group] = where.place(altitude[group] * where.after)
        assert 15.0 < np.median(where.after) < 45.0
        aside = np.array([-where.axis[1], where.axis[0]])
    found = PatchRegistration(xy, np.ones(120), np.full(120, 0.1), np.ones(120, dtype=bool))
    every = np.ones(120, dtype=bool)
    assert links.verified(found, every)[0].all()
    few = every.copy()
    few[::3] = False
    np.testing.assert_array_equal(links.verified(found, few)[0], few)
    off = PatchRegistration(xy.copy(), found.correlation, found.sigma.copy(), found.ok)
    off.xy[20] += 0.15 * aside  # off its line: a camera's error or a match's, as the adjustment judges
    off.xy[51] += 3.0 * np.array([aside[1], -aside[0]])  # along it: at another altitude than its neighbour
    off.sigma[80], off.sigma[90] = 0.21, 0.19  # of the median 0.1 twice is tolerated
    left, across = links.verified(off, every)
    assert np.flatnonzero(~left).tolist() == [50, 51, 80]
    assert across[20] == pytest.approx(0.15, abs=1e-6)
    assert np.abs(np.delete(across, 20)).max() < 1e-6


def test_tiles_that_follow_each_other_share_a_task_as_far_as_it_holds_their_points(sized: Sized) -> None:
    places = np.column_stack([64.0 * np.repeat(np.arange(5), (3, 2, 1, 6, 2)), np.zeros(14)])
    for most, lengths in ((1, [3, 2, 1, 6, 2]), (5, [5, 1, 6, 2]), (6, [6, 6, 2]), (14, [14])):
        sized(patches_together=most)
        joined = task_parts(places, np.arange(14), 64)
        assert [len(part) for part in joined] == lengths
        np.testing.assert_array_equal(np.concatenate(joined), np.arange(14))


@pytest.mark.parametrize("count", [1300, 60_000])
def test_few_points_are_registered_in_bands_of_rows_swept_by_columns(count: int) -> None:
    places = np.random.default_rng(0).uniform(0, 40_000, (count, 2))
    links = np.arange(count) + 7
    parts = task_parts(places, links, 1024)
    assert max(len(part) for part in parts) <= 512
    assert len(parts) <= 1.1 * count / 512 + count / 400  # nearly full
    assert sorted(np.concatenate(parts)) == links.tolist()
    if count < 10_000:  # a band is in one task: strips are decoded once
        bands = [set(places[part - 7, 1] // 512) for part in parts]
        assert sum(map(len, bands)) == len(set.union(*bands))
    swept = places[np.concatenate(parts) - 7]
    assert (np.diff(swept[:, 1] // 512) >= 0).all()
    same = np.diff(swept[:, 1] // 512) == 0
    assert (np.diff(swept[:, 0])[same] >= 0).all()


@pytest.mark.parametrize("integers", [True, False])
def test_places_far_apart_are_found_as_in_one_window(tmp_path, integers: bool) -> None:
    """As where there are too many to read about each. Some near the border; the second image is the first one moved."""
    noise = np.random.default_rng(0).uniform(100, 3000, (700, 600)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    moved = np.ascontiguousarray(np.roll(smooth, (3, -2), axis=(0, 1)))
    data = [image.astype(np.uint16) if integers else image.astype(np.float64) for image in (smooth, moved)]
    files = tuple((str(write_image(tmp_path / f"{k}.tif", image)), (600, 700)) for k, image in enumerate(data))
    reference = np.array([[100.0, 150.0], [9, 300], [400, 690], [300, 400], [585, 20], [50, 680], [250, 250]])
    start = reference + [-1.6, 3.3]
    many = [np.tile(places, (20, 1)) for places in (reference, start)]
    apart = register_places(files, 1, reference, start, np.tile(np.eye(2), (7, 1, 1)), 21)
    together = register_places(files, 1, *many, np.tile(np.eye(2), (140, 1, 1)), 21)
    np.testing.assert_array_equal(np.tile(apart.ok, 20), together.ok)
    assert 4 <= apart.ok.sum() < len(start)  # a patch that reaches beyond the border is not registered
    np.testing.assert_allclose(apart.xy[apart.ok], together.xy[:7][apart.ok], atol=0.002)
    np.testing.assert_allclose(apart.xy[apart.ok], (reference + [-2, 3])[apart.ok], atol=0.01)


def test_patches_are_registered_tile_by_tile(sized: Sized) -> None:
    links, seen = links_of(200, 3), []

    def ordered(function: Any, tasks: Any, name: str) -> list[PatchRegistration]:
        seen.extend(tasks)
        return [PatchRegistration.none(np.concatenate([part[2] for part in parts])) for parts, _ in tasks]

    sized(patches_together=1)
    found = links.register(1, 256, SimpleNamespace(ordered=ordered))
    assert len(found.xy) == 400
    assert [band for _, band in seen] == [1]  # small parts of a view in one task
    for _, origin, start, linear, structural in seen[0][0]:
        assert (np.ptp(np.floor(origin / 256), axis=0) == 0).all()
        assert not structural
        assert len(origin) == len(start) == len(linear)
    starts = [part[2] for part in seen[0][0]]
    assert sum(map(len, starts)) == 400
    assert len(starts) > 20
    np.testing.assert_array_equal(np.sort(found.xy, axis=0), np.sort(np.concatenate(starts), axis=0))
