"""What tie points say about cameras: errors of views, epipolar offsets of pairs, the shift of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from barpc.geodesy import Array, enu_basis, ground_from_ecef
from barpc.scene import BoolArray, IntArray, Tracks
from barpc.sensor import SensorModel
from barpc.sensor.geometry import Triangulation, convergence_angle, epipolar_offset, triangulate

MAX_PER_PAIR = 2000
"""Matches of a pair that its epipolar offset is measured on, evenly taken."""


def robust_spread(values: Array) -> float:
    """1.4826 times the median absolute deviation: the standard deviation of a normal core."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def rmse_by_view(residuals: Array, view: IntArray, num_views: int) -> Array:
    """Root mean square reprojection error of each view.

    Parameters
    ----------
    residuals : (K, 2)
        Projected - observed [px]; rows with NaN do not count.
    view : (K,)
        View of each row.
    num_views : int
        Number of views N.

    Returns
    -------
    rmse : (N,)
        sqrt(mean(dcol^2 + drow^2)) [px]; NaN for a view without rows.
    """
    use = np.isfinite(residuals).all(axis=1)
    squares = np.bincount(view[use], (residuals[use] ** 2).sum(axis=1), minlength=num_views)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(squares / np.bincount(view[use], minlength=num_views)))


@dataclass(frozen=True, eq=False)
class PairOffset:
    """Epipolar offset of a pair's matches.

    Parameters
    ----------
    median, spread, rms : float
        Across the epipolar line [px]; the spread is 1.4826 times the median absolute deviation.
    count : int
        Matches measured.
    """

    median: float
    spread: float
    rms: float
    count: int


@dataclass(frozen=True, eq=False)
class PairTies:
    """The observations that two views have in common.

    Parameters
    ----------
    views : (int, int)
        The pair, ascending.
    a, b : (M,)
        Rows of the tracks: the observations in the first view and in the second.
    """

    views: tuple[int, int]
    a: IntArray
    b: IntArray


def pair_ties(tracks: Tracks, keep: BoolArray | None = None) -> list[PairTies]:
    """All pairs of views with tracks in common, in ascending order.

    Parameters
    ----------
    tracks : Tracks
        Tie points.
    keep : (K,), optional
        Observations to count.
    """
    rows = np.arange(len(tracks)) if keep is None else np.flatnonzero(keep)
    rows = rows[np.lexsort((tracks.view[rows], tracks.point[rows]))]
    point = tracks.point[rows]
    found_a, found_b = [], []
    for step in range(1, int(np.bincount(point).max(initial=1))):
        together = point[step:] == point[:-step]
        found_a.append(rows[:-step][together])
        found_b.append(rows[step:][together])
    if not found_a:
        return []
    a, b = np.concatenate(found_a), np.concatenate(found_b)
    num = int(tracks.view.max()) + 1
    code = tracks.view[a] * num + tracks.view[b]
    order = np.argsort(code, kind="stable")
    a, b, code = a[order], b[order], code[order]
    starts = np.flatnonzero(np.diff(code, prepend=-1))
    ends = np.append(starts[1:], len(code))
    return [
        PairTies((int(code[s] // num), int(code[s] % num)), np.sort(a[s:e]), b[s:e][np.argsort(a[s:e])])
        for s, e in zip(starts, ends, strict=True)
    ]


def pair_offset(ties: PairTies, tracks: Tracks, sensors: Sequence[SensorModel], alt: float) -> PairOffset:
    """The epipolar offset of a pair's matches through given cameras, started at an altitude [m]."""
    pick = np.linspace(0, len(ties.a) - 1, min(len(ties.a), MAX_PER_PAIR)).astype(np.int64)
    i, j = ties.views
    offset, _ = epipolar_offset(sensors[i], sensors[j], tracks.xy[ties.a[pick]], tracks.xy[ties.b[pick]], alt)
    offset = offset[np.isfinite(offset)]
    if not len(offset):
        return PairOffset(float("nan"), float("nan"), float("nan"), 0)
    rms = float(np.sqrt((offset**2).mean()))
    return PairOffset(float(np.median(offset)), robust_spread(offset), rms, len(offset))


def pair_angle(ties: PairTies, tracks: Tracks, sensors: Sequence[SensorModel], ground: Array) -> float:
    """Median convergence angle [deg] of a pair at its tie points; `ground` (P, 3) are all tracks' points."""
    at = ground[tracks.point[ties.a[:: max(1, len(ties.a) // 100)]]]
    at = at[np.isfinite(at).all(axis=1)]
    i, j = ties.views
    return float(np.median(convergence_angle(sensors[i], sensors[j], at))) if len(at) else float("nan")


def triangulate_tracks(tracks: Tracks, sensors: Sequence[SensorModel], alt: float) -> Triangulation:
    """All tracks intersected through given cameras, started at an altitude [m]."""
    return triangulate(sensors, tracks.view, tracks.point, tracks.xy, tracks.sigma, alt=alt)


def scene_shift(before: Array, after: Array) -> Array:
    """Mean displacement of triangulated points (P, 3) [m, ECEF], as east, north, up (3,) [m]."""
    both = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    if not both.any():
        return np.full(3, np.nan)
    middle = ground_from_ecef(before[both].mean(axis=0))
    return np.asarray(enu_basis(middle) @ (after[both] - before[both]).mean(axis=0))
