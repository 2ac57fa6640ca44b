"""Tracks with sub-pixel observations: one reference patch a track, all others registered to it."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

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
    rows = np.flatnonzero(np.arange(len(tracks)) != of_track[tracks.point])
    reference = of_track[tracks.point[rows]]
    xy, sigma, keep = np.rint(tracks.xy), np.full(len(tracks), np.nan), np.zeros(len(tracks), dtype=bool)
    linear, start = np.empty((len(rows), 2, 2)), np.empty((len(rows), 2))
    groups = _grouped(tracks.view[reference], tracks.view[rows])
    for group in groups:
        r, v = _views(tracks, reference, rows, group)
        alt = 0.5 * sum(common_range(views[r], views[v]))
        linear[group] = linear_map(cameras[r], cameras[v], xy[reference[group]], alt)
    rounding = (xy - tracks.xy)[reference]
    start = tracks.xy[rows] + (linear @ rounding[:, :, None])[:, :, 0]
    tile = np.floor(xy[reference] / options.tile).astype(np.int64)
    parts = _grouped(tracks.view[reference], tracks.view[rows], tile[:, 1], tile[:, 0])
    tasks = []
    for part in parts:
        r, v = _views(tracks, reference, rows, part)
        at = (xy[reference[part]], start[part], linear[part])
        both = (views[r], views[v])
        tasks.append(
            (
                Task(
                    (both[0].path, both[1].path),
                    (both[0].size, both[1].size),
                    options.band,
                    *at,
                    options.patch,
                ),
            )
        )
    found: list[Registration] = ordered(executor, register_task, tasks, "refine", progress)
    for part, registration in zip(parts, found, strict=True):
        xy[rows[part]], sigma[rows[part]] = registration.xy, registration.sigma
        keep[rows[part]] = registration.ok & (registration.correlation >= options.min_correlation)
    for group in groups:
        group = group[keep[rows[group]]]
        if not len(group):
            continue
        r, v = _views(tracks, reference, rows, group)
        where = frame(cameras[r], cameras[v], xy[reference[group]], common_range(views[r], views[v]))
        errors = where.errors(np.arange(len(group)), xy[rows[group]])[:, 1]
        agree, residual = agreeing(xy[reference[group]], errors, _FLOOR)
        scale = mad(residual / sigma[rows[group]]) if len(group) >= _FEW else 1.0
        sigma[rows[group]] *= max(1.0, scale)
        keep[rows[group]] = agree
    return _finish(tracks, of_track, xy, sigma, keep)


def _views(tracks: Tracks, reference: IntArray, rows: IntArray, group: IntArray) -> tuple[int, int]:
    return int(tracks.view[reference[group[0]]]), int(tracks.view[rows[group[0]]])


def _grouped(*keys: IntArray) -> list[IntArray]:
    """Indices of rows with equal keys, in ascending order of the keys."""
    table = np.stack(keys)
    order = np.lexsort(table[::-1])
    cuts = np.flatnonzero((np.diff(table[:, order], axis=1) != 0).any(axis=0)) + 1
    return np.split(order, cuts) if len(order) else []


def _finish(tracks: Tracks, of_track: IntArray, xy: Array, sigma: Array, keep: BoolArray) -> Tracks:
    """Kept rows and their references; the variance of a registration is shared by both its ends."""
    variance = np.where(keep, 0.5 * np.nan_to_num(sigma) ** 2, 0.0)
    count = np.bincount(tracks.point[keep], minlength=tracks.num_points)
    total = np.bincount(tracks.point, weights=variance, minlength=tracks.num_points)
    keep, variance = keep.copy(), variance.copy()
    keep[of_track] = count > 0
    variance[of_track] = total / np.maximum(count, 1)
    refined = Tracks(
        tracks.view, tracks.point, np.where(keep[:, None], xy, 0.0), np.sqrt(variance).clip(_LEAST_SIGMA)
    )
    return refined.select(keep)


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
