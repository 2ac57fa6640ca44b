"""Where in an image ties are wrong, or off, more than elsewhere: scans over all intervals of its rows and columns.

Two statistics, both about the logarithm of a likelihood ratio: of the share of observations that are wrong (Kulldorff
1997, "A spatial scan statistic"), and of a displacement that all observations of the interval have in common.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import entr, xlogy

from barpc.geodesy import Array
from barpc.scene import IntArray

BINS = 40  # stretches of an image's rows or columns
_STARTS, _STOPS = np.triu_indices(BINS + 1, 1)  # all intervals of these
_WHOLE = BINS - 1  # which of them is all of an image, and no interval
SURE = 5.0  # nats: an explanation that gains less is none
_LINE = 0.05  # of the larger extent of residuals: a smaller one is none
CLIPPED = 8.0
"""Standard deviations: one residual tells no more."""


@dataclass(frozen=True)
class Interval:
    """A stretch of an image that stands out."""

    view: int
    axis: int  # 0: columns, 1: rows
    start: float  # [px]
    stop: float
    gain: float  # nats, what the choice among all places costs taken off
    share: float  # of its observations that are wrong
    off: float  # what the others have in common, in the units of the residuals
    by_share: bool  # whether the share stands out, or what they have in common
    apart: float = 0.0  # half of those that are wrong are farther off than this, where it was measured
    moves: bool = False  # the share is of a group that moves


def price(views: int) -> float:
    """What the choice among the intervals of all views, rows and columns, costs [nats]."""
    return float(np.log(BINS * (BINS + 1) / 2 * 2 * views))


def scan(
    view: IntArray, place: Array, size: Array, wrong: Array, off: Array, floor: float = 0.0
) -> list[Interval]:
    """The interval that stands out most, by each statistic, of every view's columns and rows; the best first.

    Parameters
    ----------
    view : (K,)
    place : (2, K), where observations are [px], in images of `size` (2, N)
    wrong : (K,), probability that an observation is wrong
    off : (2, K), residuals in standard deviations that they would have; 0 of those that are wrong
    floor : float, what means are let be [the same]: no adjustment is asked to be better
    """
    views = size.shape[1]
    off = np.clip(off, -CLIPPED, CLIPPED)
    found = []
    for axis in (0, 1):
        bin_ = (place[axis] / size[axis][view] * BINS).astype(np.int64).clip(0, BINS - 1)
        rows = np.array([np.ones(len(view)), wrong, *off])
        sums = np.array([np.bincount(view * BINS + bin_, row, views * BINS) for row in rows])
        sums = np.pad(sums.reshape(-1, views, BINS).cumsum(axis=-1), ((0, 0), (0, 0), (1, 0)))
        count, bad, col, row = sums[:, :, _STOPS] - sums[:, :, _STARTS]  # (N, intervals)
        total, all_bad = sums[:2, :, -1:]
        both = _shares(count, bad, total, all_bad), _means(count - bad, col, row, floor)
        for by_share, gain in zip((True, False), both, strict=True):
            gain[:, _WHOLE] = 0.0
            for v in range(views):
                at = int(gain[v].argmax())
                worth = float(gain[v, at]) - price(views)
                i, j = int(_STARTS[at]), int(_STOPS[at])
                if not by_share and 2 * (j - i) > BINS and (i == 0 or j == BINS):
                    i, j = (
                        (0, i) if j == BINS else (j, BINS)
                    )  # means tell of two parts: the smaller one lies off
                step = size[axis, v] / BINS
                inside, wrongs, *off_by = (sums[:, v, j] - sums[:, v, i]).tolist()
                common = float(np.hypot(*off_by) / max(inside - wrongs, 1.0))
                ends = float(i * step), float(j * step)
                found.append(Interval(v, axis, *ends, worth, wrongs / max(inside, 1.0), common, by_share))
    return sorted(found, key=lambda one: -one.gain)


def neighbours_alike(view: IntArray, place: Array, residual: Array, views: int) -> Array:
    """How surely neighbours lie off in the same direction (N,) [nats], what the choice among all tests costs taken off.

    Of wrong matches that lie anywhere they do so in half of the cases; of what moves, bends or shakes, in more.

    Parameters
    ----------
    view : (K,), place : (2, K) [px], residual : (2, K) of observations that are wrong
    views : int, N
    """
    out = np.full(views, -np.inf)
    for v in range(views):
        rows = np.flatnonzero(view == v)
        if len(rows) < 2:
            continue
        axes, size = np.linalg.svd(residual[:, rows], full_matrices=False)[:2]
        # of two views all lie along one line: what is left across it is no direction, or what large ones bend alike
        along = axes.T[size > _LINE * size[0]] @ residual[:, rows]
        along[1:] -= np.median(along[1:], axis=1, keepdims=True)
        for axis in (0, 1):
            signs = along[:, np.argsort(place[axis, rows], kind="stable")] > 0.0
            alike, count = (signs[:, 1:] == signs[:, :-1]).sum(axis=1), float(len(rows) - 1)
            share = np.maximum(alike / count, 0.5)
            found = count * (np.log(2.0) - entr(share) - entr(1.0 - share))
            out[v] = max(out[v], float(found.max()))
    return out - float(np.log(4 * views))


def _means(count: Array, col: Array, row: Array, floor: float) -> Array:
    """Logarithm of the likelihood ratio of a displacement inside, and another outside, over one of all."""
    all_of = slice(_WHOLE, _WHOLE + 1)
    part = count / np.maximum(count[:, all_of], 1.0)
    inside = np.hypot(col - col[:, all_of] * part, row - row[:, all_of] * part)
    spread = np.maximum(count * (1.0 - part), 0.5)
    return np.asarray(0.5 * inside**2 / (spread + (spread * floor) ** 2))


def _shares(count: Array, bad: Array, total: Array, all_bad: Array) -> Array:
    """Logarithm of the likelihood ratio of two shares over one, where that inside is the larger."""

    def log(k: Array, n: Array) -> Array:
        good = np.maximum(n - k, 0.0)
        return np.asarray(xlogy(k, k) + xlogy(good, good) - xlogy(n, n))

    outside, bad_outside = total - count, all_bad - bad
    more = bad * np.maximum(outside, 1e-9) > bad_outside * count
    return np.where(more, log(bad, count) + log(bad_outside, outside) - log(all_bad, total), 0.0)
