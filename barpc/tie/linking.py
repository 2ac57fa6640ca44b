"""Link matches to tracks, and thin tracks evenly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from barpc.base.errors import TiePointError
from barpc.base.geodesy import Array, ground_from_ecef
from barpc.scene import BoolArray, IntArray, Tracks, View, connected_labels, middle_altitude, row_pairs
from barpc.sensor.triangulation import triangulate
from barpc.tie.matchers.matcher import Matches
from barpc.tie.matchers.report import PairReport, require_matches
from barpc.tie.pairing.area import Area
from barpc.tie.pairing.overlaps import Pair

NEEDED = 4
"""Least tracks of a pair: across the epipolar lines one determines a shift, and three can contradict it."""
_MEAN_PER_CELL = 4
"""Mean observations per cell of an image with the number wanted: it determines the size of cells."""


_QUOTAS = (1, 2, _MEAN_PER_CELL, 8, 16)
"""Observations allowed in a cell, round by round. With a first quota above one, long tracks, which are taken first and
fill cells of all their views, would leave none for borders that fewer views see."""


def tracks_inside(views: Sequence[View], tracks: Tracks, area: Area | None) -> Tracks:
    """Return the tracks with ground points in an area (None: all tracks); TiePointError if there are none."""
    if area is None or not len(tracks):
        return tracks
    cameras = [view.sensor for view in views]
    points = triangulate(cameras, tracks.view, tracks.point, tracks.xy, alt=middle_altitude(views)).points
    kept = area.contains(ground_from_ecef(points)[:, :2])
    if not kept.any():
        raise TiePointError(f"none of {len(kept)} tie points lies in the area of interest: enlarge it")
    return tracks.select(kept[tracks.point])


def require_tracks(
    views: Sequence[View],
    tracks: Tracks,
    pairs: Sequence[Pair],
    reports: Sequence[PairReport],
    joined: Sequence[int] = (),
) -> None:
    """Raise the errors of `require_matches`; pairs with fewer than `NEEDED` tracks count as not matched."""
    left, counts = [], pair_counts(tracks)
    for pair, report in zip(pairs, reports, strict=True):
        common = counts.get(pair.views, 0)
        status = "ok" if common >= NEEDED else f"only {common} tracks after registration"
        left.append(replace(report, status=status if report.status == "ok" else report.status))
    require_matches(views, pairs, left, joined)


def link(pairs: Sequence[tuple[int, int]], matches: Sequence[Matches]) -> Tracks:
    """Link matches of pairs into tracks by shared points; tracks with two points of a view are rejected.

    The order of the pairs does not matter: tracks are ordered by their first observation. An observation's sigma is
    that of its most accurate match.
    """
    if not any(len(m) for m in matches):
        return Tracks(*(np.empty(0, np.int64),) * 2, np.empty((0, 2)), np.empty(0))
    view: IntArray = np.concatenate([np.tile(pair, len(m)) for pair, m in zip(pairs, matches, strict=True)])
    _, number = np.unique(np.concatenate([m.index for m in matches]).ravel(), return_inverse=True)
    xy = np.concatenate([m.xy for m in matches]).reshape(-1, 2)
    sigma = np.repeat([m.sigma for m in matches], [2 * len(m) for m in matches])
    points, node = np.unique(view * len(number) + number, return_inverse=True)
    label = connected_labels(len(points), node.reshape(-1, 2))
    best = np.lexsort((sigma, node))
    once = best[np.unique(node[best], return_index=True)[1]]
    return _ordered_tracks(view[once], label[node[once]], xy[once], sigma[once])


def _ordered_tracks(view: IntArray, label: IntArray, xy: Array, sigma: Array) -> Tracks:
    """Return tracks in order of their first observations, rows by view; those with two points of a view are dropped."""
    order = np.lexsort((view, label))
    view, label, xy, sigma = view[order], label[order], xy[order], sigma[order]
    twice = (np.diff(view) == 0) & (np.diff(label) == 0)
    keep = ~np.isin(label, label[1:][twice])
    _, head, point = np.unique(label[keep], return_index=True, return_inverse=True)
    rank = np.empty(len(head), dtype=np.int64)
    firsts = np.stack([view[keep][head], xy[keep][head][:, 1], xy[keep][head][:, 0]])
    rank[np.lexsort(firsts[::-1])] = np.arange(len(head))
    point = rank[point]
    again = np.lexsort((view[keep], point))
    return Tracks(view[keep][again], point[again], xy[keep][again], sigma[keep][again])


def thin(tracks: Tracks, sizes: Sequence[tuple[int, int]], most: int) -> Tracks:
    """Thin tracks evenly over the images: long and accurate ones first, at most `most` observations in an image.

    `sizes` (width, height) of the images [px]. A track is taken if its cell in any of its views is not full.
    """
    count = np.bincount(tracks.view, minlength=len(sizes))
    if not len(tracks) or (count <= most).all():
        return tracks
    side = np.sqrt([_MEAN_PER_CELL * width * height / most for width, height in sizes])
    columns, rows = (np.array(sizes) / side[:, None]).astype(np.int64).T + 2
    first_cell = np.concatenate([[0], np.cumsum(columns * rows)])
    col, row = np.floor((tracks.xy + 0.5) / side[tracks.view][:, None]).astype(np.int64).clip(0).T
    cell = first_cell[tracks.view] + row * columns[tracks.view] + col
    keep = _fill_cells(tracks, cell.tolist(), int(first_cell[-1]), most, len(sizes))
    return tracks.select(keep[tracks.point])


def _fill_cells(tracks: Tracks, cell: list[int], num_cells: int, most: int, num_views: int) -> BoolArray:
    """Return the mask of tracks taken: greedily, in rounds of growing quota per cell. `cell`: of each observation."""
    starts = np.searchsorted(tracks.point, np.arange(tracks.num_points + 1))
    worst = np.maximum.reduceat(tracks.sigma, starts[:-1])
    # Knuth's multiplicative hash: an order without direction among equals
    shuffle = (np.arange(tracks.num_points) * 2654435761) % (1 << 32)
    waiting = np.lexsort((shuffle, np.round(worst, 2), -np.diff(starts))).tolist()
    bounds, views = starts.tolist(), tracks.view.tolist()
    filled, total = [0] * num_cells, [0] * num_views
    keep = np.zeros(tracks.num_points, dtype=bool)
    for quota in _QUOTAS:
        left = []
        for track in waiting:
            rows = range(bounds[track], bounds[track + 1])
            if any(total[views[r]] >= most for r in rows):
                continue
            if not any(filled[cell[r]] < quota for r in rows):
                left.append(track)
                continue
            keep[track] = True
            for r in rows:
                filled[cell[r]] += 1
                total[views[r]] += 1
        waiting = left
    return keep


def pair_counts(tracks: Tracks) -> dict[tuple[int, int], int]:
    """Return the number of common tracks of each pair of views, ascending, that has any."""
    (first, second), num = row_pairs(tracks.point), int(tracks.view.max(initial=0)) + 1
    keys, counts = np.unique(tracks.view[first] * num + tracks.view[second], return_counts=True)
    return {divmod(key, num): count for key, count in zip(keys.tolist(), counts.tolist(), strict=True)}
