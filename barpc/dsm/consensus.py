"""Consensus of pairs: which of their heights of a cell are taken where they contradict each other.

It is never the mean of a right and a wrong one. Two heights agree within a pixel of disparity, as matches of one
surface do, and the largest group of pairs that agree is taken. Where another group is as large, neighbouring cells in
which pairs agree decide; the height of a single pair is void where it is surrounded by such cells and agrees with none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter

from barpc.base.geodesy import Array
from barpc.scene import BoolArray

F32 = npt.NDArray[np.float32]


NEIGHBOUR_RADIUS = 12
"""Cells that neighbours are away at most; every second one each way is asked.

Matches up to two windows apart (7 cells of two pixels) look at the same pixels and are wrong together, so evidence
comes from beyond. Of 13 kinds of rendered scenes 0.08 to 0.9 % of the cells are void, within 10 cells up to 1.1 %.
"""


SURROUNDED = 0.4
"""Share of the neighbours in which pairs agree, about the height of a single pair that they may refuse.

Beyond a straight border of what others see they are fewer from two cells on, where a slope may lead away from them.
"""


_AWAY = range(-NEIGHBOUR_RADIUS, NEIGHBOUR_RADIUS + 1, 2)


_NEIGHBOUR_OFFSETS = [
    (down, right) for down in _AWAY for right in _AWAY if 0 < down**2 + right**2 <= NEIGHBOUR_RADIUS**2
]


def finite_median(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the median of finite values along the first axis; NaN where nothing is."""
    ranked, num = np.sort(values, axis=0), np.isfinite(values).sum(axis=0)  # NaN comes last
    low, high = (np.take_along_axis(ranked, at[None], axis=0)[0] for at in ((num - 1) // 2, num // 2))
    return np.asarray((low + high) / 2)


def consensus(heights: F32, metres: F32) -> BoolArray:
    """Return the pairs whose heights are taken in each cell, (K, rows, cols); none in a void cell.

    Parameters
    ----------
    heights : (K, rows, cols), of K pairs, the best first [m]; NaN where unknown
    metres : (K,), height that a pixel of disparity stands for [m]
    """
    known = np.isfinite(heights)
    if len(heights) == 1:
        return known
    level, within, agree = (
        _without_offset(heights),
        np.maximum(metres[:, None], metres),
        np.zeros(heights.shape, np.int8),
    )
    for other, most in zip(level, within, strict=True):
        agree += np.abs(level - other) <= most[:, None, None]
    first = agree.argmax(axis=0)
    taken: BoolArray = np.abs(level - np.take_along_axis(level, first[None], axis=0)) <= within[:, first]
    rival, single = known & (agree == agree.max(axis=0)), known.sum(axis=0) == 1
    tied = (rival & ~taken).any(axis=0)
    sure = np.where(tied | single, np.nan, finite_median(np.where(taken, level, np.nan)))
    asked = tied | (
        single & maximum_filter(np.isfinite(sure), 2 * NEIGHBOUR_RADIUS + 1)
    )  # where nobody is near none refuses
    rival, level, single = rival[:, asked], level[:, asked], single[asked]
    votes, witnesses = _votes(sure, np.where(rival, level, np.nan), metres, np.nonzero(asked))
    votes[~rival] = -1
    best = votes.argmax(axis=0)
    chosen = np.abs(level - np.take_along_axis(level, best[None], axis=0)) <= within[:, best]
    others = np.where(rival & ~chosen, votes, -1).max(axis=0)
    free = single & (witnesses < SURROUNDED * len(_NEIGHBOUR_OFFSETS))
    taken[:, asked] = chosen & ((votes.max(axis=0) > np.maximum(others, 0)) | free)
    return taken


def _without_offset(heights: F32) -> F32:
    """Return the heights without the offset of each pair, by camera errors: an offset is no contradiction."""
    several = np.isfinite(heights).sum(axis=0) > 1
    apart = [one[several & np.isfinite(one)] for one in heights - finite_median(heights)]
    off = np.array([np.median(one) if len(one) else 0.0 for one in apart], np.float32)
    return np.asarray(heights - off[:, None, None])


def _votes(
    sure: Array, candidates: F32, metres: F32, at: tuple[npt.NDArray[np.intp], ...]
) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.int16]]:
    """Return how many neighbouring heights agree with each of the candidates (K, n) of n cells, and how many are
    known (n,).
    """
    around, (row, col) = np.pad(sure, NEIGHBOUR_RADIUS, constant_values=np.nan), (one + NEIGHBOUR_RADIUS for one in at)
    votes, witnesses = np.zeros(candidates.shape, np.int16), np.zeros(len(row), np.int16)
    for down, right in _NEIGHBOUR_OFFSETS:
        neighbour = around[row + down, col + right]
        votes += np.abs(candidates - neighbour) <= metres[:, None]
        witnesses += np.isfinite(neighbour)
    return votes, witnesses
