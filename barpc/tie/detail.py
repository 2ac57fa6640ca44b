"""Expected density of tie points, by the keypoints that partners see, and its gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import pdtr

from barpc.base.geodesy import Array
from barpc.base.statistics import LEVEL
from barpc.scene import IntArray
from barpc.tie.matchers.features import KeypointFiles

PARTS_PER_SIDE = 64
"""Equal parts of an image's columns, and of its rows, in which keypoints are counted."""
_MIN_PER_PART = 14.0
"""Keypoints of a part on average, or parts are joined by two: the poorest of 20 lacks 1.87 deviations, half of them."""
_LEAST_PARTS = 8
_CHANCE_PER_PAIR = 1e-6 / (PARTS_PER_SIDE * (PARTS_PER_SIDE - 1) / 2)
"""Of each stretch of parts: of a million axes one is found by chance."""
Seen = tuple[Array, Array, tuple[int, int]]
"""Matches of a view (M, 2) with a partner (M, 2) [px], and the partner's size."""


@dataclass(frozen=True)
class Gap:
    """Columns (axis 0) or rows (1), `first` to `last` [px], with few tie points where keypoints make many expected."""

    axis: int
    first: float
    last: float
    found: int
    expected: int


def seen_detail(files: KeypointFiles, size: tuple[int, int], partners: Sequence[Seen]) -> IntArray:
    """Count the keypoints that partners see, by an affine of their matches, in parts of columns and rows (2, PARTS).

    Those count that are as strong as most that tie: on water noise is found, too; each by the share of them that its
    partner ties, relative to the best partner's: few are found again in an image of another side or season.
    """
    keypoints = files.load()[0]
    xy, weight = keypoints.xy, np.zeros(len(keypoints))
    tied = [np.isin(xy @ [1.0, 1.0j], here @ [1.0, 1.0j]) for here, _, _ in partners]
    ties = np.any([np.zeros(len(xy), dtype=bool), *tied], axis=0)
    strong = keypoints.response >= np.quantile(keypoints.response[ties], LEVEL) if ties.any() else ~ties
    for own, (here, there, other) in zip(tied, partners, strict=True):
        linear = np.linalg.lstsq(_affine_design(here), there, rcond=None)[0]
        relief = np.abs(there - _affine_design(here) @ linear).max(axis=0)  # it may hide what is so near an edge
        place = _affine_design(xy) @ linear
        seen = strong & ((place >= relief) & (place <= np.array(other) - 1.0 - relief)).all(axis=1)
        weight[seen] = np.maximum(weight[seen], own[seen].sum() / max(int(seen.sum()), 1))
    return in_parts(xy, size, weight / max(float(weight.max(initial=0.0)), np.finfo(float).tiny))


def _affine_design(xy: Array) -> Array:
    return np.column_stack([np.ones(len(xy)), xy])


def in_parts(xy: Array, size: tuple[int, int], weight: Array | None = None) -> IntArray:
    """Count points (N, 2) [px], each as one or by its weight, in parts of columns and rows (2, PARTS)."""
    ends = [(-0.5, length - 0.5) for length in size]
    counts = [np.histogram(xy[:, axis], PARTS_PER_SIDE, ends[axis], weights=weight)[0] for axis in (0, 1)]
    return np.asarray(np.rint(np.stack(counts)), dtype=np.int64)


def gap(detail: IntArray, ties: IntArray, size: tuple[int, int]) -> Gap | None:
    """Return the columns or rows with the most significant lack of tie points (2, PARTS), given the keypoints, if any.

    They are to be as many a keypoint as beside it, over its own length on either side, or in all, where these are
    fewer; the keypoints of all its parts are taken to be those of its poorest: water, with a shore, has none to lack.
    By chance (Poisson) they are as few as found once in a million images; and no more are found than may be wrong.
    """
    parts = PARTS_PER_SIDE
    while parts > _LEAST_PARTS and detail[0].sum() < parts * _MIN_PER_PART:
        parts //= 2
        detail, ties = (counts.reshape(2, parts, 2).sum(axis=2) for counts in (detail, ties))
    start, stop = np.triu_indices(parts + 1, 2)  # in one part alone a shore may lie
    before, after = np.maximum(2 * start - stop, 0), np.minimum(2 * stop - start, parts)
    best, found = _CHANCE_PER_PAIR, None
    for axis in (0, 1):
        k, n = (np.append(0, np.cumsum(counts[axis])) for counts in (detail, ties))
        beside = [c[start] - c[before] + c[after] - c[stop] for c in (n, k)]
        poorest = np.concatenate([np.minimum.accumulate(detail[axis, first:])[1:] for first in range(parts - 1)])
        rate = np.minimum(beside[0] / np.maximum(beside[1], 1), n[-1] / max(k[-1], 1))
        expected, seen = (stop - start) * poorest * rate, n[stop] - n[start]
        chance = np.where(seen <= LEVEL * expected, pdtr(seen, expected), 1.0)
        at = int(chance.argmin())
        if chance[at] < best:
            best, side = float(chance[at]), size[axis] / parts
            first, last = float(np.ceil(start[at] * side)), float(np.ceil(stop[at] * side) - 1.0)
            found = Gap(axis, first, last, int(seen[at]), round(float(expected[at])))
    return found
