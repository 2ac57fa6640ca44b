"""Matches become tracks: joined, free of contradictions, evenly thinned, independent of their order."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from barpc.scene import Tracks
from barpc.tie import Matches, TieOptions, thin
from barpc.tie import link as link_pairs
from barpc.tie.linking import require_tracks
from barpc.tie.matchers.report import PairReport
from tests.everywhere import tied
from tests.tie.stages import common_tracks, select_pairs
from tests.tie.test_pairs import METRE, camera, views

PLACES = np.random.default_rng(0).uniform(0, 100, (4, 10, 2))


def matches(i: int, j: int, *index: tuple[int, int], sigma: float = 0.2) -> tuple[tuple[int, int], Matches]:
    rows = np.array(index, dtype=np.int64).reshape(-1, 2)
    xy = np.stack([PLACES[i][rows[:, 0]], PLACES[j][rows[:, 1]]], axis=1)
    return (i, j), Matches(xy, np.zeros(len(rows)), rows, sigma)


def tracks_of(*rows: tuple[int, int]) -> Tracks:
    view, point = np.array(rows).T
    xy = np.arange(2.0 * len(rows)).reshape(-1, 2) * 10.0 + 0.3
    return Tracks(view, point, xy, np.full(len(rows), 0.2))


def link(*found: tuple[tuple[int, int], Matches]) -> Tracks:
    return link_pairs([pair for pair, _ in found], [m for _, m in found])


def as_sets(tracks: Tracks) -> set[frozenset[tuple[int, float, float]]]:
    return {
        frozenset((int(v), x, y) for v, (x, y) in zip(tracks.view[p], tracks.xy[p], strict=True))
        for p in (tracks.point == k for k in range(tracks.num_points))
    }


def test_matches_that_share_a_keypoint_become_one_track() -> None:
    tracks = link(matches(0, 1, (3, 4)), matches(1, 2, (4, 5)), matches(2, 3, (5, 6), (1, 1)))
    assert tracks.num_points == 2
    assert sorted(np.bincount(tracks.point)) == [2, 4]
    np.testing.assert_array_equal(tracks.xy[tracks.view == 0], [PLACES[0, 3]])


def test_a_track_that_meets_a_view_twice_is_thrown_away() -> None:
    tracks = link(matches(0, 1, (3, 4), (1, 1)), matches(1, 2, (4, 5)), matches(0, 2, (9, 5)))
    assert as_sets(tracks) == {frozenset([(0, *PLACES[0, 1]), (1, *PLACES[1, 1])])}


def test_the_order_of_the_pairs_does_not_matter() -> None:
    pairs = [
        matches(0, 1, *((k, k) for k in range(8))),
        matches(1, 2, *((k, k) for k in range(3, 9)), sigma=0.1),
        matches(0, 2, (9, 9)),
    ]
    first, second = link(*pairs), link(*pairs[::-1])
    for name in ("view", "point", "xy", "sigma"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_rows_of_a_track_stand_together_with_views_ascending() -> None:
    tracks = link(matches(2, 3, (1, 1), (2, 2)), matches(0, 3, (5, 2)), matches(0, 1, (5, 5)))
    assert (np.diff(tracks.point) >= 0).all()
    assert (np.diff(tracks.view)[np.diff(tracks.point) == 0] > 0).all()


def test_no_matches_make_no_tracks() -> None:
    assert link().num_points == 0
    assert link(matches(0, 1)).num_points == 0


def many(count: int, views: int = 2, crowd: float = 1.0) -> Tracks:
    rng = np.random.default_rng(1)
    xy = 1000 * rng.uniform(0, 1, (count, 1, 2)) ** crowd + rng.uniform(0, 1, (1, views, 2))
    return tied(xy, 0.1)


def both(a: Tracks, b: Tracks) -> Tracks:
    columns = [a.view, b.view], [a.point, b.point + a.num_points], [a.xy, b.xy], [a.sigma, b.sigma]
    return Tracks(*map(np.concatenate, columns))


@pytest.mark.parametrize("crowd", [1.0, 3.0])
def test_thinned_tracks_are_about_as_many_as_asked_for_and_cover_the_image_evenly(crowd: float) -> None:
    tracks = thin(many(20_000, crowd=crowd), [(1001, 1001)] * 2, 1000)
    assert 700 <= np.bincount(tracks.view)[0] <= 1000
    cells = np.floor(tracks.xy[tracks.view == 0] / 125).astype(int).clip(0, 7)
    counts = np.zeros((8, 8), int)
    np.add.at(counts, tuple(cells.T), 1)
    assert counts.min() >= 2
    assert counts.max() <= 70


def test_long_and_accurate_tracks_are_kept_first() -> None:
    short, long = many(3000), many(300, 3)
    tracks = thin(both(short, long), [(1001, 1001)] * 3, 600)
    assert (np.bincount(tracks.point) == 3).sum() > 250


def test_a_border_that_two_of_three_views_see_has_its_tracks() -> None:
    """The third view begins at column 127 of the others, where all tracks are short before: cells keep half."""
    two, three = many(20_000), many(20_000, 3)
    three = three.select(np.repeat(three.xy[::3, 0] >= 127, 3))
    kept = thin(both(two, three), [(1001, 1001)] * 3, 1000)
    first = kept.xy[kept.view == 0]
    assert 700 <= len(first) <= 1000
    side = np.sqrt(4 * 1001**2 / 1000)
    counts = np.zeros((2, 15), int)
    col, row = ((first + 0.5) // side).astype(int).T
    within = (col < 2) & (row < 15)
    np.add.at(counts, (col[within], row[within]), 1)
    assert counts.min() >= 2


def test_accuracies_within_a_hundredth_of_a_pixel_are_alike() -> None:
    """Else the images' part that is better by nothing would be filled first."""
    alike = many(3000)
    graded = replace(alike, sigma=0.096 + 0.008 * alike.xy[:, 0] / 1001)
    kept = [thin(tracks, [(1001, 1001)] * 2, 500).xy for tracks in (alike, graded)]
    np.testing.assert_array_equal(*kept)
    better = replace(alike, sigma=np.where(alike.xy[:, 0] < 500, 0.1, 0.12))
    assert len(thin(better, [(1001, 1001)] * 2, 500).xy) != 0
    assert not np.array_equal(thin(better, [(1001, 1001)] * 2, 500).xy, kept[0])


def test_among_equals_no_direction_is_preferred() -> None:
    """Tracks numbered from west to east: those kept lie anywhere in their cells."""
    tracks = many(20_000)
    order = np.argsort(tracks.xy[::2, 0])
    ranked = replace(tracks, xy=tracks.xy.reshape(-1, 2, 2)[order].reshape(-1, 2))
    kept = thin(ranked, [(1001, 1001)] * 2, 1000)
    side = np.sqrt(4 * 1001**2 / 1000)
    place = ((kept.xy[kept.view == 0, 0] + 0.5) / side) % 1.0
    assert 0.45 < place.mean() < 0.55
    assert place.std() == pytest.approx(np.sqrt(1 / 12), abs=0.02)


def test_common_tracks_come_in_the_same_order() -> None:
    tracks = many(20, 3)
    first, third = common_tracks(tracks, 0, 2)
    np.testing.assert_array_equal(first, tracks.xy[tracks.view == 0])
    np.testing.assert_array_equal(third, tracks.xy[tracks.view == 2])


def test_few_tracks_are_handed_back_as_they_are() -> None:
    tracks = tracks_of(*[(v, p) for p in range(30) for v in (0, 1)])
    for most in (30, 31, 1000):
        assert thin(tracks, [(1000, 800)] * 2, most) is tracks
    assert thin(tracks, [(1000, 800)] * 2, 29).num_points == 29
    none = tracks.select(tracks.point < 0)
    assert thin(none, [(1000, 800)] * 2, 5) is none


def test_every_place_has_its_four_before_one_has_five() -> None:
    """A hundred tracks at one place of an image and six each at three others."""
    place = np.array([[100.0, 100.0], [900.0, 100.0], [100.0, 900.0], [900.0, 900.0]])
    of = np.repeat([0, 1, 2, 3], [100, 6, 6, 6])
    tracks = tied(np.repeat(place[of][:, None], 2, axis=1), 0.1)

    def kept(most: int) -> list[int]:
        left = thin(tracks, [(1000, 1000)] * 2, most)
        near = np.abs(left.xy[left.view == 0][:, None] - place).sum(axis=2).argmin(axis=1)
        return np.bincount(near, minlength=4).tolist()

    assert kept(16) == [4, 4, 4, 4]
    assert kept(28) == [10, 6, 6, 6]
    assert kept(100) == [16, 6, 6, 6]  # and none more than sixteen


def test_cells_hold_the_first_quota_of_as_many_observations_as_are_kept(monkeypatch) -> None:
    seen = []

    def fill(tracks: Tracks, cell: list[int], cells: int, most: int, views: int) -> np.ndarray:
        seen.append((cell, cells))
        return np.ones(tracks.num_points, dtype=bool)

    monkeypatch.setattr(sys.modules["barpc.tie.linking"], "_fill_cells", fill)
    tracks = tracks_of(*[(v, p) for p in range(30) for v in (0, 1)])
    thin(tracks, [(1000, 800), (700, 700)], 20)
    ((cell, count),) = seen
    sides = [np.sqrt(4 * 1000 * 800 / 20), np.sqrt(4 * 700 * 700 / 20)]
    columns, rows = (
        [int(1000 / sides[0]) + 2, int(700 / sides[1]) + 2],
        [int(800 / sides[0]) + 2, int(700 / sides[1]) + 2],
    )
    assert count == columns[0] * rows[0] + columns[1] * rows[1]
    for k, found in enumerate(cell):
        v = int(tracks.view[k])
        col, row = ((tracks.xy[k] + 0.5) // sides[v]).astype(int)
        assert found == v * columns[0] * rows[0] + row * columns[v] + col


def test_tracks_must_tie_every_pair_after_registration() -> None:
    two = views(camera(0.0), camera(100 * METRE))
    pairs = select_pairs(two, TieOptions())
    reports = [PairReport(("v0", "v1"), "ok", (50, 50), 30, 20)]
    tracks = tracks_of(*[(v, p) for p in range(4) for v in (0, 1)])
    require_tracks(two, tracks, pairs, reports)
    with pytest.raises(Exception, match="only 3 tracks after registration"):
        require_tracks(two, tracks.select(tracks.point < 3), pairs, reports)
