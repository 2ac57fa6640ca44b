"""Where in an image ties are wrong, or off, more than elsewhere: scans over all intervals of its rows and columns.

Two statistics, both about the logarithm of a likelihood ratio: of the share of observations that are wrong (Kulldorff
1997, "A spatial scan statistic"), and of a displacement that all observations of the interval have in common.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import entr, xlogy

from barpc.ba.estimated.waves import DRIFTS
from barpc.ba.usual import OUTLIER, SURE
from barpc.base.geodesy import Array
from barpc.scene import IntArray

BINS = 40  # stretches of an image's rows or columns
_STARTS, _STOPS = np.triu_indices(BINS + 1, 1)  # all intervals of these
LINE = 0.05  # of the larger extent of residuals: a smaller one is that of epipolar lines, which turn over an image


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
    """Return the cost of choosing among the intervals of all views, rows and columns [nats]."""
    return float(np.log(BINS * (BINS + 1) / 2 * 2 * views))


def scan(
    view: IntArray, place: Array, size: Array, wrong: Array, off: Array, told: Array, floor: float = 0.0
) -> list[Interval]:
    """Find the interval that stands out most, by each statistic, in every view's columns and rows; the best
    first.

    Parameters
    ----------
    view : (K,)
    place : (2, K), where observations are [px], in images of `size` (2, N)
    wrong : (K,), probability that an observation is wrong
    off : (2, K), residuals in standard deviations that they would have, of wrong ones, too
    told : (K,), weights of these; 0 of observations that tell nothing
    floor : float, what displacements are let be [the same]: no adjustment is asked to be better
    """
    views, found = size.shape[1], []
    off, costs = np.clip(off, -OUTLIER, OUTLIER), price(views)
    for axis in (0, 1):
        bin_ = (place[axis] / size[axis][view] * BINS).astype(np.int64).clip(0, BINS - 1)
        rows = np.array([np.ones(len(view)), wrong])
        sums = np.array([np.bincount(view * BINS + bin_, row, views * BINS) for row in rows])
        whole = sums.reshape(2, views, BINS)
        shares = _shares(*_intervals(whole).swapaxes(0, 1), *whole.sum(axis=2))
        gains, displaced = _displacements(view, bin_, off, told, views, floor)
        for by_share, gain in zip((True, False), (shares, gains), strict=True):
            gain[BINS - 1] = 0.0  # all of an image is no interval
            for v, at in enumerate(gain.argmax(axis=0).tolist()):
                worth, common = float(gain[at, v]) - costs, float(displaced[at, v])
                i, j = int(_STARTS[at]), int(_STOPS[at])
                if not by_share and 2 * (j - i) > BINS and (i == 0 or j == BINS):
                    i, j = (0, i) if j == BINS else (j, BINS)  # of two parts the smaller one lies off
                step = size[axis, v] / BINS
                inside, wrongs = whole[:, v, i:j].sum(axis=1).tolist()
                ends = float(i * step), float(j * step)
                found.append(Interval(v, axis, *ends, worth, wrongs / max(inside, 1.0), common, by_share))
    return sorted(found, key=lambda one: -one.gain)


def _intervals(bins: Array) -> Array:
    """Return the sums (intervals, ...) of all intervals of bins (..., `BINS`): rows, which are copied fast."""
    edges = np.zeros((BINS + 1, *bins.shape[:-1]))
    np.moveaxis(bins, -1, 0).cumsum(axis=0, out=edges[1:])
    return np.asarray(edges[_STOPS] - edges[_STARTS])


def _displacements(
    view: IntArray, bin_: IntArray, off: Array, told: Array, views: int, floor: float
) -> tuple[Array, Array]:
    """Return the gain [nats] (N, intervals) by which a displacement of an interval explains residuals, and
    its size.

    The score test beside what a camera follows along an axis: a constant, a slope and a bend are taken off both. What
    stands out beside a step is its middle; the step itself is what explains it.
    """
    at = view * BINS + bin_
    sums = [np.bincount(at, told * row, views * BINS) for row in (np.ones(len(view)), *off)]
    count, *shifts = np.array(sums, dtype=np.float64).reshape(3, views, BINS)
    smooth = np.vander(np.linspace(-1.0, 1.0, BINS), DRIFTS, increasing=True)
    weighted = count[:, :, None] * smooth
    normal = np.swapaxes(weighted, 1, 2) @ smooth + 1e-9 * np.eye(DRIFTS) * (count.sum(axis=1) + 1.0)[:, None, None]
    shift = np.stack(shifts, axis=2)  # (N, bins, 2)
    followed = smooth @ np.linalg.solve(normal, smooth.T @ shift)
    left = (off.T - followed[view, bin_]).T * np.sqrt(told)
    scatter = [[np.bincount(view, a * b, views) for a in left] for b in left]
    size, axes = np.linalg.eigh(np.moveaxis(np.array(scatter), 2, 0) / (count.sum(axis=1) + 1.0)[:, None, None])
    rest = np.swapaxes((shift - count[:, :, None] * followed) @ axes, 1, 2)
    across = np.linalg.solve(np.linalg.cholesky(normal), np.swapaxes(weighted, 1, 2))
    squares = (_intervals(bins) ** 2 for bins in (*np.moveaxis(rest, 1, 0), *np.moveaxis(across, 1, 0)))
    own, (one, other, *by_smooth) = _intervals(count), squares
    own, size = np.maximum(own - sum(by_smooth), 0.5), np.maximum(size, 1.0)
    more = own * floor**2
    gain = 0.5 / own * (one / (size[:, 0] + more) + other / (size[:, 1] + more))
    return gain, np.sqrt(one + other) / own


def neighbours_alike(view: IntArray, place: Array, residual: Array, views: int) -> Array:
    """Return the evidence (N,) [nats] that neighbouring residuals point in the same direction, the choice
    among tests paid for.

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
        along = axes.T[size > LINE * size[0]] @ residual[:, rows]
        along[1:] -= np.median(along[1:], axis=1, keepdims=True)
        for axis in (0, 1):
            signs = along[:, np.argsort(place[axis, rows], kind="stable")] > 0.0
            alike, count = (signs[:, 1:] == signs[:, :-1]).sum(axis=1), float(len(rows) - 1)
            share = np.maximum(alike / count, 0.5)
            found = count * (np.log(2.0) - entr(share) - entr(1.0 - share))
            out[v] = max(out[v], float(found.max()))
    return out - float(np.log(4 * views))


def _shares(count: Array, bad: Array, total: Array, all_bad: Array) -> Array:
    """Return the logarithm of the likelihood ratio of two shares over one, where that inside is the larger."""

    def log(k: Array, n: Array) -> Array:
        good = np.maximum(n - k, 0.0)
        return np.asarray(xlogy(k, k) + xlogy(good, good) - xlogy(n, n))

    whole, gain = log(all_bad, total), np.zeros_like(count)
    told = whole < -SURE  # where all that are wrong lie in one interval, the rest are certain
    count, bad, total, all_bad = count[:, told], bad[:, told], total[told], all_bad[told]
    outside, bad_outside = total - count, all_bad - bad
    more = bad * np.maximum(outside, 1e-9) > bad_outside * count
    gain[:, told] = np.where(more, log(bad, count) + log(bad_outside, outside) - whole[told], 0.0)
    return gain
