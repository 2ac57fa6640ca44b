"""Matches of pairs become tracks: linked, evenly thinned, registered to sub-pixel places, verified.

One reference patch a track; all its other observations are registered to it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from barpc.geodesy import Array
from barpc.options import TieOptions
from barpc.scene import BoolArray, IntArray, Tracks, View, connected_labels
from barpc.tie.epipolar import agreeing, frame, grouped, linear_map, robust_spread
from barpc.tie.matcher import Matches
from barpc.tie.register import Registration, register_places
from barpc.tie.tasks import Progress, ordered

PATCH = 21
"""Side of the patches that are registered [px], odd."""
_QUOTAS = (4, 8, 16)
"""Tracks that a cell takes, round by round; with the first an image of full cells holds what is asked for."""
_FLOOR = 0.1  # px across the epipolar line that are always tolerated
_DISTORTED = 2.0  # times the median sigma: the patch lies across a step of the ground
_LEAST_SIGMA = 0.02  # px
_LEAST_REACH = 5.0  # px of half a segment, below which altitudes are not compared
_FEW = 20  # observations of a pair of views below which their sigmas are not scaled by their errors


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
    label = connected_labels(int(node.max()) + 1, node.reshape(-1, 2))
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


def refine(
    views: Sequence[View],
    tracks: Tracks,
    spreads: Mapping[tuple[int, int], float],
    options: TieOptions,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Tracks:
    """Register every observation to its track's reference patch, and verify the result.

    Parameters
    ----------
    views : sequence of View
        The images.
    tracks : Tracks
        As `link` made them.
    spreads : mapping of (int, int) to float
        `PairReport.spread` of the pairs of views: tells which view of a track makes the best reference.
    options : TieOptions
        `patch`, `min_correlation`, `band`, `tile`.
    executor, progress : optional
        Who does the work, and who hears how far it is: see `ordered`. The result does not depend on them.

    Returns
    -------
    tracks : Tracks
        Reference observations at whole pixels, the others refined; without what did not correlate or
        left its epipolar line. Each observation carries half the variance of its registration.
    """
    if not len(tracks):
        return tracks
    of_track = references(tracks, spreads, len(views))
    other = np.flatnonzero(np.arange(len(tracks)) != of_track[tracks.point])
    links = _Links(views, tracks, of_track[tracks.point[other]], other)
    found = links.register(options, executor, progress)
    good = links.verified(found, found.ok & (found.correlation >= options.min_correlation))
    sigma = links.scaled(found, good)
    return _shared(tracks, of_track, other[good], found.xy[good], sigma[good])


@dataclass(frozen=True, eq=False)
class _Links:
    """Observations that are registered (`other`), each with the reference of its track; rows of `tracks`."""

    views: Sequence[View]
    tracks: Tracks
    reference: IntArray
    other: IntArray

    def __len__(self) -> int:
        return len(self.other)

    @property
    def origin(self) -> Array:
        """Whole pixels at which the reference patches stand."""
        return np.rint(self.tracks.xy[self.reference])

    def of(self, part: IntArray) -> tuple[View, View]:
        """The two views of links that have them in common."""
        ends = self.reference[part[0]], self.other[part[0]]
        return self.views[self.tracks.view[ends[0]]], self.views[self.tracks.view[ends[1]]]

    def groups(self, *more: IntArray) -> list[IntArray]:
        """Indices of the links between the same two views, and of equal values of `more`."""
        return grouped(self.tracks.view[self.reference], self.tracks.view[self.other], *more)

    def register(
        self, options: TieOptions, executor: Executor | None, progress: Progress | None
    ) -> Registration:
        """Register all, tile by tile of the reference view."""
        origin = self.origin
        linear = np.empty((len(self), 2, 2))
        for group in self.groups():
            linear[group] = linear_map(*self.of(group), origin[group])
        rounding = (origin - self.tracks.xy[self.reference])[:, :, None]
        start = self.tracks.xy[self.other] + (linear @ rounding)[:, :, 0]
        parts = self.groups(*np.floor(origin[:, ::-1] / options.tile).astype(np.int64).T)
        tasks = []
        for part in parts:
            first, second = self.of(part)
            images = ((first.path, first.size), (second.path, second.size))
            tasks.append((images, options.band, origin[part], start[part], linear[part], PATCH))
        done: list[Registration] = ordered(executor, register_places, tasks, "refine", progress)
        xy, (correlation, sigma) = np.empty((len(self), 2)), np.empty((2, len(self)))
        ok = np.zeros(len(self), dtype=bool)
        for part, one in zip(parts, done, strict=True):
            xy[part], correlation[part], sigma[part], ok[part] = one.xy, one.correlation, one.sigma, one.ok
        return Registration(xy, correlation, sigma, ok)

    def errors(self, found: Registration, group: IntArray) -> tuple[Array, Array]:
        """Along and across the epipolar lines (M, 2) [px] between two views; half the segments' length (M,)."""
        where = frame(*self.of(group), self.origin[group])
        return where.errors(found.xy[group]), where.after

    def verified(self, found: Registration, good: BoolArray) -> BoolArray:
        """Those near their epipolar line, no less certain than others, at one altitude with their track."""
        verified = np.zeros(len(self), dtype=bool)
        altitude, reach = np.zeros((2, len(self)))  # from the middle of the range, in its halves
        for group in self.groups():
            group = group[good[group]]
            if len(group):
                group = group[found.sigma[group] <= _DISTORTED * np.median(found.sigma[group])]
                errors, reach[group] = self.errors(found, group)
                verified[group] = agreeing(self.origin[group], errors[:, 1], _FLOOR)[0]
                altitude[group] = errors[:, 0] / np.maximum(reach[group], 1e-9)
        return verified & ~self._torn(verified, altitude, reach)

    def _torn(self, good: BoolArray, altitude: Array, reach: Array) -> BoolArray:
        """Links that disagree in altitude with all their neighbours in the track, up to an affine function."""
        rows = np.flatnonzero(good & (reach >= _LEAST_REACH))
        first, second = rows[:-1], rows[1:]
        same = self.reference[first] == self.reference[second]
        first, second = first[same], second[same]
        apart = (altitude[first] - altitude[second]) * np.minimum(reach[first], reach[second])
        compared, agreed = np.zeros((2, len(self)), dtype=bool)
        views = self.tracks.view
        for group in grouped(
            views[self.reference[first]], views[self.other[first]], views[self.other[second]]
        ):
            agree = agreeing(self.origin[first[group]], apart[group], 2 * _FLOOR)[0]
            for end in (first[group], second[group]):
                compared[end] = True
                agreed[end[agree]] = True
        torn: BoolArray = compared & ~agreed
        return torn

    def scaled(self, found: Registration, good: BoolArray) -> Array:
        """Sigmas [px] made larger where the distances from the epipolar lines are."""
        sigma = found.sigma.copy()
        for group in self.groups():
            group = group[good[group]]
            if len(group) >= _FEW:
                across = self.errors(found, group)[0][:, 1]
                residual = agreeing(self.origin[group], across, _FLOOR)[1]
                sigma[group] *= max(1.0, robust_spread(residual / sigma[group]))
        return sigma


def _shared(tracks: Tracks, of_track: IntArray, rows: IntArray, xy: Array, sigma: Array) -> Tracks:
    """Registered rows and their references; the variance of a registration is shared by both its ends."""
    points = tracks.point[rows]
    count = np.bincount(points, minlength=tracks.num_points)
    variance = np.zeros(len(tracks))
    variance[rows] = 0.5 * sigma**2
    variance[of_track] = np.bincount(points, weights=variance[rows], minlength=tracks.num_points)
    variance[of_track] /= np.maximum(count, 1)
    placed, keep = np.rint(tracks.xy), np.zeros(len(tracks), dtype=bool)
    placed[rows], keep[rows] = xy, True
    keep[of_track] = count > 0
    return Tracks(tracks.view, tracks.point, placed, np.sqrt(variance).clip(_LEAST_SIGMA)).select(keep)


def references(tracks: Tracks, spreads: Mapping[tuple[int, int], float], num_views: int) -> IntArray:
    """Row of the reference observation of every track (P,): the view that is most like the others.

    The spread across the epipolar line of the pairs that were matched [px] tells: it grows with the angle between two
    views and with everything else that makes them look different.
    """
    key = np.array([min(pair) * num_views + max(pair) for pair in spreads] or [-1], dtype=np.int64)
    spread = np.array(list(spreads.values()) or [0.0])[np.argsort(key)]
    key = np.sort(key)
    starts = np.searchsorted(tracks.point, np.arange(tracks.num_points + 1))
    length = np.diff(starts)[tracks.point]
    left = np.repeat(np.arange(len(tracks)), length)
    step = np.arange(len(left)) - np.repeat(np.cumsum(length) - length, length)
    right = starts[tracks.point[left]] + step
    low = np.minimum(tracks.view[left], tracks.view[right])
    wanted = low * num_views + np.maximum(tracks.view[left], tracks.view[right])
    place = np.searchsorted(key, wanted).clip(0, len(key) - 1)
    unlike = np.where(key[place] == wanted, spread[place], np.where(left == right, 0.0, 2.0 * spread.max()))
    cost = np.bincount(left, weights=unlike, minlength=len(tracks))
    order = np.lexsort((cost, tracks.point))
    first: IntArray = order[starts[:-1]]
    return first
