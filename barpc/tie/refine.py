"""Tracks with sub-pixel observations: one reference patch a track, all others registered to it."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from barpc.geodesy import Array
from barpc.scene import BoolArray, IntArray, Tracks, View
from barpc.sensor import SensorModel
from barpc.tie.epipolar import agreeing, frame, linear_map, mad
from barpc.tie.matching import common_range
from barpc.tie.options import TieOptions
from barpc.tie.pairs import Pair
from barpc.tie.register import Registration, Task, register_task
from barpc.tie.work import Progress, ordered

_FLOOR = 0.1  # px across the epipolar line that are always tolerated
_DISTORTED = 2.2  # times the median sigma: the patch lies across a step of the ground
_LEAST_SIGMA = 0.02  # px
_UNKNOWN_ANGLE = 90.0  # deg, of views that were not paired
_FEW = 20  # observations of a pair of views below which their sigmas are not scaled by their errors


def refine(
    views: Sequence[View],
    tracks: Tracks,
    pairs: Sequence[Pair],
    options: TieOptions,
    *,
    sensors: Sequence[SensorModel] | None = None,
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
    pairs : sequence of Pair
        Their angles tell which view of a track is the most central one.
    options : TieOptions
        `patch`, `min_correlation`, `band`, `tile`.
    sensors : sequence of SensorModel, optional
        Corrected cameras to use instead of the views' own.
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
    cameras = [view.sensor for view in views] if sensors is None else sensors
    of_track = references(tracks, pairs, len(views))
    other = np.flatnonzero(np.arange(len(tracks)) != of_track[tracks.point])
    links = _Links(views, cameras, tracks, of_track[tracks.point[other]], other)
    found = links.register(options, executor, progress)
    good = links.verified(found, found.ok & (found.correlation >= options.min_correlation))
    sigma = links.scaled(found, good)
    return _shared(tracks, of_track, other[good], found.xy[good], sigma[good])


@dataclass(frozen=True, eq=False)
class _Links:
    """Observations that are registered (`other`), each with the reference of its track; rows of `tracks`."""

    views: Sequence[View]
    cameras: Sequence[SensorModel]
    tracks: Tracks
    reference: IntArray
    other: IntArray

    def __len__(self) -> int:
        return len(self.other)

    @property
    def origin(self) -> Array:
        """Whole pixels at which the reference patches stand."""
        return np.rint(self.tracks.xy[self.reference])

    def of(self, part: IntArray) -> tuple[int, int]:
        """The two views of links that have them in common."""
        first = part[0]
        return int(self.tracks.view[self.reference[first]]), int(self.tracks.view[self.other[first]])

    def groups(self, *more: IntArray) -> list[IntArray]:
        """Indices of the links between the same two views, and of equal values of `more`."""
        table = np.stack([self.tracks.view[self.reference], self.tracks.view[self.other], *more])
        order = np.lexsort(table[::-1])
        cuts = np.flatnonzero((np.diff(table[:, order], axis=1) != 0).any(axis=0)) + 1
        return np.split(order, cuts) if len(order) else []

    def register(
        self, options: TieOptions, executor: Executor | None, progress: Progress | None
    ) -> Registration:
        """Register all, tile by tile of the reference view."""
        origin = self.origin
        linear = np.empty((len(self), 2, 2))
        for group in self.groups():
            r, v = self.of(group)
            alt = 0.5 * sum(common_range(self.views[r], self.views[v]))
            linear[group] = linear_map(self.cameras[r], self.cameras[v], origin[group], alt)
        rounding = (origin - self.tracks.xy[self.reference])[:, :, None]
        start = self.tracks.xy[self.other] + (linear @ rounding)[:, :, 0]
        parts = self.groups(*np.floor(origin[:, ::-1] / options.tile).astype(np.int64).T)
        tasks = []
        for part in parts:
            first, second = (self.views[k] for k in self.of(part))
            files, sizes = (first.path, second.path), (first.size, second.size)
            where = (origin[part], start[part], linear[part])
            tasks.append((Task(files, sizes, options.band, *where, options.patch),))
        done: list[Registration] = ordered(executor, register_task, tasks, "refine", progress)
        xy, (correlation, sigma) = np.empty((len(self), 2)), np.empty((2, len(self)))
        ok = np.zeros(len(self), dtype=bool)
        for part, one in zip(parts, done, strict=True):
            xy[part], correlation[part], sigma[part], ok[part] = one.xy, one.correlation, one.sigma, one.ok
        return Registration(xy, correlation, sigma, ok)

    def residuals(self, found: Registration, group: IntArray) -> tuple[BoolArray, Array]:
        """Which links between two views agree with their epipolar lines, and the distances from them [px]."""
        r, v = self.of(group)
        origin = self.origin[group]
        limits = common_range(self.views[r], self.views[v])
        where = frame(self.cameras[r], self.cameras[v], origin, limits)
        return agreeing(origin, where.errors(np.arange(len(group)), found.xy[group])[:, 1], _FLOOR)

    def verified(self, found: Registration, good: BoolArray) -> BoolArray:
        """Those that are near their epipolar line and no less certain than others of the two views."""
        verified = np.zeros(len(self), dtype=bool)
        for group in self.groups():
            group = group[good[group]]
            if len(group):
                group = group[found.sigma[group] <= _DISTORTED * np.median(found.sigma[group])]
                verified[group] = self.residuals(found, group)[0]
        return verified

    def scaled(self, found: Registration, good: BoolArray) -> Array:
        """Sigmas [px] made larger where the distances from the epipolar lines are."""
        sigma = found.sigma.copy()
        for group in self.groups():
            group = group[good[group]]
            if len(group) >= _FEW:
                residual = self.residuals(found, group)[1]
                sigma[group] *= max(1.0, mad(residual / sigma[group]))
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


def references(tracks: Tracks, pairs: Sequence[Pair], num_views: int) -> IntArray:
    """Row of the reference observation of every track (P,): the view with the least angles to the others.

    Parameters
    ----------
    tracks : Tracks
        Rows grouped by track.
    pairs : sequence of Pair
        Angles between views.
    num_views : int
        Number of views.
    """
    key = np.array([i * num_views + j for i, j in (pair.views for pair in pairs)], dtype=np.int64)
    angle = np.array([pair.angle for pair in pairs])[np.argsort(key)]
    key = np.sort(key)
    starts = np.searchsorted(tracks.point, np.arange(tracks.num_points + 1))
    length = np.diff(starts)[tracks.point]
    left = np.repeat(np.arange(len(tracks)), length)
    step = np.arange(len(left)) - np.repeat(np.cumsum(length) - length, length)
    right = starts[tracks.point[left]] + step
    low = np.minimum(tracks.view[left], tracks.view[right])
    wanted = low * num_views + np.maximum(tracks.view[left], tracks.view[right])
    place = np.searchsorted(key, wanted).clip(0, len(key) - 1)
    apart = np.where(key[place] == wanted, angle[place], np.where(left == right, 0.0, _UNKNOWN_ANGLE))
    cost = np.bincount(left, weights=apart, minlength=len(tracks))
    order = np.lexsort((cost, tracks.point))
    first: IntArray = order[starts[:-1]]
    return first
