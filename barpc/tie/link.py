"""Matches of pairs become tracks: one ground point, seen once in each of its views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from barpc.geodesy import Array
from barpc.scene import BoolArray, IntArray, Tracks
from barpc.tie.matcher import Matches

_QUOTAS = (4, 8, 16)
"""Tracks that a cell takes, round by round; with the first an image of full cells holds what is asked for."""


def link(pairs: Sequence[tuple[int, int]], matches: Sequence[Matches]) -> Tracks:
    """Join matches that share points; a track that meets a view twice is thrown away.

    Parameters
    ----------
    pairs : sequence of (int, int)
        The two views of each pair, in any order: the result does not depend on it.
    matches : sequence of Matches
        Of each pair.

    Returns
    -------
    tracks : Tracks
        Ordered by their first observation; sigma is that of the best match an observation took part in.
    """
    if not any(len(m) for m in matches):
        return Tracks(*(np.empty(0, np.int64),) * 2, np.empty((0, 2)), np.empty(0))
    count = [2 * len(m) for m in matches]
    view: IntArray = np.concatenate([np.tile(pair, len(m)) for pair, m in zip(pairs, matches, strict=True)])
    number = np.concatenate([m.index for m in matches]).ravel()
    xy = np.concatenate([m.xy for m in matches]).reshape(-1, 2)
    sigma = np.repeat([m.sigma for m in matches], count)
    order = np.lexsort((number, view))
    new = (np.diff(view[order]) != 0) | (np.diff(number[order]) != 0)
    node: IntArray = np.empty(len(order), dtype=np.int64)
    node[order] = np.concatenate([[0], np.cumsum(new)])
    total = int(node.max()) + 1
    first, second = node.reshape(-1, 2).T
    graph = coo_array((np.ones(len(first), dtype=np.int8), (first, second)), shape=(total, total))
    label: IntArray = connected_components(graph, directed=False)[1].astype(np.int64)
    order = np.lexsort((sigma, node))
    once = order[np.r_[True, np.diff(node[order]) > 0]]
    return _clean(view[once], label[node[once]], xy[once], sigma[once])


def _clean(view: IntArray, label: IntArray, xy: Array, sigma: Array) -> Tracks:
    """Rows grouped by track and sorted by view; tracks with two points of one view dropped."""
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
    """Fewer tracks, evenly spread: long and accurate ones first, until the cells of every image are full.

    Parameters
    ----------
    tracks : Tracks
        Rows grouped by track.
    sizes : sequence of (width, height)
        Of the views [px].
    most : int
        Observations kept in a view, about.

    Returns
    -------
    tracks : Tracks
        Each is wanted by a cell that has room for it in at least one of its views.
    """
    count = np.bincount(tracks.view, minlength=len(sizes))
    if not len(tracks) or (count <= most).all():
        return tracks
    side = np.sqrt([_QUOTAS[0] * width * height / most for width, height in sizes])
    columns = np.array([int(width / s) + 2 for (width, _), s in zip(sizes, side, strict=True)])
    rows = np.array([int(height / s) + 2 for (_, height), s in zip(sizes, side, strict=True)])
    first_cell = np.concatenate([[0], np.cumsum(columns * rows)])
    col, row = np.floor((tracks.xy + 0.5) / side[tracks.view][:, None]).astype(np.int64).clip(0).T
    cell = first_cell[tracks.view] + row * columns[tracks.view] + col
    keep = _fill(tracks, cell.tolist(), int(first_cell[-1]), most, len(sizes))
    return tracks.select(keep[tracks.point])


def _fill(tracks: Tracks, cell: list[int], num_cells: int, most: int, num_views: int) -> BoolArray:
    """Mask of the tracks that are taken, greedily, in rounds of growing quota where images have empty parts."""
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


def common_tracks(tracks: Tracks, first: int, second: int) -> tuple[Array, Array]:
    """Image points (M, 2), (M, 2) [px] of the tracks that two views have in common, in the same order."""
    a, b = tracks.view == first, tracks.view == second
    _, rows_a, rows_b = np.intersect1d(tracks.point[a], tracks.point[b], return_indices=True)
    return tracks.xy[a][rows_a], tracks.xy[b][rows_b]
