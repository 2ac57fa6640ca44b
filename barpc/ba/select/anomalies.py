"""Tests of the residuals of a solved block: significant intervals, periods and correlated noise.

Rejected observations are tested with the others. Matching noise may be correlated between neighbouring tie points:
templates overlap, and shadows or seasons displace neighbours the same way. A step, a sinusoid or a moving group may fit
such noise. So a term must gain more evidence than a model of correlated noise: a part of the noise is common to all tie
points in a cell of the image.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barpc.ba.constraints.block import Block
from barpc.ba.evidence.periods import Period, find_periods
from barpc.ba.evidence.scan import Interval, scan
from barpc.ba.robust.rounds import Outcome, retriangulate_rejected
from barpc.ba.robust.weights import Observations
from barpc.base.geodesy import Array
from barpc.base.statistics import FEW, OUTLIER
from barpc.scene import BoolArray, IntArray

_SIDES = 2 ** np.arange(2, 6)  # grids to try: cells along each side of an image
_CORRELATED_SHARES = np.linspace(0.0, 1.0, 21)[1:-1]  # to try: part of the noise variance common to a cell


def significant_intervals(outcome: Outcome, block: Block, floor: float) -> list[Interval]:
    """Find the intervals of rows or columns with significantly many rejected tie points, or a displacement.

    A displacement must exceed `floor` [px]. The result is cached in the outcome.
    """
    if floor not in outcome.significant_intervals:
        outcome.significant_intervals[floor] = _find_significant(outcome, block, floor)
    return outcome.significant_intervals[floor]


def _find_significant(outcome: Outcome, block: Block, floor: float) -> list[Interval]:
    rows, off = _whitened(outcome, block)
    right = outcome.inlier[rows].astype(np.float64)  # means of inliers only: a few large outliers would shift them
    pixel = float(np.median(block.sigma[rows])) * outcome.noise if rows.any() else 1.0
    found = scan(block.view[rows], block.xy[:, rows], image_sizes(block), 1.0 - right, off, right, floor / pixel)
    return [replace(one, off=one.off * pixel) for one in found]


def unexplained_intervals(outcome: Outcome, block: Block, floor: float) -> list[Interval]:
    """Return the significant intervals that correlated noise does not explain.

    Each has the median residual of its rejected tie points. Rejected tracks are triangulated from all observations.
    """
    found = significant_intervals(outcome, block, floor)
    if not all(one.by_share for one in found):  # correlated noise also displaces intervals
        by_neighbours = correlated_noise_gain(outcome, block)
        found = [one for one in found if one.by_share or one.gain > by_neighbours]
    if not any(one.by_share for one in found):
        return found
    state, weight = outcome.state, block.use / block.sigma
    residual = retriangulate_rejected(outcome.problem, state, outcome.residual, outcome.inlier, weight)[1]
    off = np.hypot(*residual)
    cut = (block.point < block.num_tracks) & block.use & ~outcome.inlier & np.isfinite(off)
    inside = [
        cut & (block.view == one.view) & (block.xy[one.axis] >= one.start) & (block.xy[one.axis] < one.stop)
        for one in found
    ]
    return [
        replace(one, apart=float(np.median(off[rows])) if rows.any() else 0.0)
        for one, rows in zip(found, inside, strict=True)
    ]


def periods_of(outcome: Outcome, block: Block) -> list[Period]:
    """Find significant periods of the residuals along rows, at most one for each image."""
    rows, off = _whitened(outcome, block)
    return find_periods(
        block.view[rows], block.xy[1, rows], image_sizes(block), _confirmed_observations(outcome, block)[rows], off
    )


def correlated_noise_gain(outcome: Outcome, block: Block) -> float:
    """Return the log-likelihood ratio [nats] of correlated over independent noise of the inliers of a block."""
    rows, off = _whitened(outcome, block)
    return correlated_log_ratio(
        block.view[rows], block.xy[:, rows], image_sizes(block), off, outcome.inlier[rows], block.point[rows]
    )


def correlated_log_ratio(
    view: IntArray, place: Array, size: Array, off: Array, right: BoolArray, track: IntArray
) -> float:
    """Return the log-likelihood ratio [nats] of correlated over independent noise in all images.

    Residuals `off` (2, k) are in standard deviations, `right` (k,) are the inliers; else as `log_ratio_by_image`. The
    ratio is scaled by the share of degrees of freedom: a track of n views has 2 n residuals, 2 n - 3 of them free.
    """
    right = right & (np.hypot(*off) < OUTLIER)
    free = 1.0 - 1.5 * len(np.unique(track[right])) / max(int(right.sum()), 1)
    return free * float(log_ratio_by_image(view[right], place[:, right], size, off[:, right]).sum())


def _confirmed_observations(outcome: Outcome, block: Block) -> Array:
    """Return 1 for all observations (K,) of points with at least two inliers, rejected ones included; else 0."""
    right = np.bincount(block.point[outcome.inlier], minlength=block.num_points)
    return (right[block.point] >= 2).astype(np.float64)


def _whitened(outcome: Outcome, block: Block) -> tuple[BoolArray, Array]:
    """Return the mask (K,) of tie points in use, and their residuals (2, k) in standard deviations."""
    is_tie = (block.point < block.num_tracks) & block.use
    freedom = Observations(outcome.problem, block.sigma, 0.0, is_tie).freedom(outcome.inlier.astype(np.float64))
    spread = block.sigma * outcome.noise * np.sqrt(0.5 * freedom)
    rows = is_tie & np.isfinite(outcome.residual).all(axis=0)
    return rows, outcome.residual[:, rows] / spread[rows]


def image_sizes(block: Block) -> Array:
    """Return the sizes (2, N) of the images, columns and rows."""
    return np.array([view.size for view in block.views], dtype=np.float64).T


def log_ratio_by_image(view: IntArray, place: Array, size: Array, off: Array) -> Array:
    """Return the log-likelihood ratio (N,) [nats] of correlated over independent noise, for each image.

    Correlated noise has a part that is common to all tie points in a cell of the image.

    Parameters
    ----------
    view, place, off : (k,), (2, k), (2, k)
        Inliers: their images, image coordinates [px], and residuals in any unit.
    size : (2, N), of the images [px]

    Returns
    -------
    The ratio at the best grid and common part a, less the logarithm of the number of both tried; at least 0. The two
    coordinates are independent. The covariance of a cell is (1 - a) I + a 11' (compound symmetry).
    """
    num = size.shape[1]
    count = np.bincount(view, minlength=num)
    scale = np.sqrt(np.bincount(view, (off**2).mean(axis=0), num) / np.maximum(count, 1))
    values = off / np.maximum(scale, np.finfo(np.float64).tiny)[view]
    found = np.zeros((len(_SIDES), len(_CORRELATED_SHARES), num))
    for k, side in enumerate(_SIDES.tolist()):
        col, row = (place / size[:, view] * side).astype(np.int64).clip(0, side - 1)
        cell = (view * side + row) * side + col
        n = np.bincount(cell, minlength=num * side**2).astype(np.float64)
        between = sum(np.bincount(cell, one, len(n)) ** 2 for one in values) / np.maximum(n, 1.0)
        total = np.bincount(cell, (values**2).sum(axis=0), len(n))
        for j, fraction in enumerate(_CORRELATED_SHARES.tolist()):
            inflation = 1.0 + (n - 1.0) * fraction  # variance of the sum of a cell over that of independent noise
            log_det = (n - 1.0) * np.log(1.0 - fraction) + np.log(inflation)
            squares = (total - between) / (1.0 - fraction) + between / inflation - total
            found[k, j] = -np.where(n > 0, log_det + 0.5 * squares, 0.0).reshape(num, -1).sum(axis=1)
    gain = found.max(axis=(0, 1)) - np.log(found[:, :, 0].size)
    return np.where(count >= FEW, np.maximum(gain, 0.0), 0.0)
