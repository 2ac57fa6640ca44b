"""Tracks with sub-pixel observations: one reference patch a track, all others registered to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from barpc.geodesy import Array
from barpc.scene import BoolArray, IntArray, Tracks, View
from barpc.tie.epipolar import agreeing, frame, linear_map, mad
from barpc.tie.options import Progress, TieOptions, ordered
from barpc.tie.register import Registration, Task, register_task

_FLOOR = 0.1  # px across the epipolar line that are always tolerated
_DISTORTED = 2.0  # times the median sigma: the patch lies across a step of the ground
_LEAST_SIGMA = 0.02  # px
_LEAST_REACH = 5.0  # px of half a segment, below which altitudes are not compared
_FEW = 20  # observations of a pair of views below which their sigmas are not scaled by their errors


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
    executor : Executor, optional
        Works on the tiles of the pairs.
    progress : callable, optional
        `progress("refine", done, total)`.

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
        return _grouped(self.tracks.view[self.reference], self.tracks.view[self.other], *more)

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
            files, sizes = (first.path, second.path), (first.size, second.size)
            where = (origin[part], start[part], linear[part])
            tasks.append((Task(files, sizes, options.band, *where, options.patch),))
        done: list[Registration] = ordered(executor, register_task, tasks, "refine", progress)
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
        for group in _grouped(
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
                sigma[group] *= max(1.0, mad(residual / sigma[group]))
        return sigma


def _grouped(*keys: IntArray) -> list[IntArray]:
    """Indices of rows with equal keys, in ascending order of the keys."""
    table = np.stack(keys)
    order = np.lexsort(table[::-1])
    cuts = np.flatnonzero((np.diff(table[:, order], axis=1) != 0).any(axis=0)) + 1
    return np.split(order, cuts) if len(order) else []


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

    Parameters
    ----------
    tracks : Tracks
        Rows grouped by track.
    spreads : mapping of (int, int) to float
        Spread across the epipolar line of the pairs that were matched [px]: it grows with the angle
        between two views and with everything else that makes them look different.
    num_views : int
        Number of views.
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
