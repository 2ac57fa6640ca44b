"""Consensus of pairs: select the pairs whose heights of a cell agree, never the mean of a correct and a wrong height.

Two heights agree within a pixel of disparity, as matches of one surface do. The largest group of pairs that agree is
taken. If another group is as large, the neighbouring cells in which pairs agree decide. The height of a single pair is
void if such cells surround it and agree with it nowhere.
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
"""Radius of the neighbourhood [cells]; every second cell each way is used.

Errors of matches up to two windows apart (7 cells of two pixels) are correlated, as they share pixels: the radius is
larger. In 13 kinds of rendered scenes 0.08 to 0.9 % of the cells are void; with a radius of 10, up to 1.1 %.
"""


SURROUNDED = 0.4
"""Least share of neighbours in which pairs agree that may void the height of a single pair.

Outside a straight border of the cells that several pairs see, only the first two cells have as many. Further out the
terrain may slope away from these neighbours.
"""


_AXIS_OFFSETS = range(-NEIGHBOUR_RADIUS, NEIGHBOUR_RADIUS + 1, 2)


_NEIGHBOUR_OFFSETS = [
    (down, right) for down in _AXIS_OFFSETS for right in _AXIS_OFFSETS if 0 < down**2 + right**2 <= NEIGHBOUR_RADIUS**2
]


def finite_median(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the median of the finite values along the first axis; NaN without any."""
    ranked, num = np.sort(values, axis=0), np.isfinite(values).sum(axis=0)  # NaN comes last
    low, high = (np.take_along_axis(ranked, at[None], axis=0)[0] for at in ((num - 1) // 2, num // 2))
    return np.asarray((low + high) / 2)


def consensus(heights: F32, metres: F32) -> BoolArray:
    """Return the mask (K, rows, cols) of the pairs whose heights are taken in each cell; none in a void cell.

    Parameters
    ----------
    heights : (K, rows, cols), heights of K pairs, the best pair first [m]; NaN where unknown
    metres : (K,), height difference per pixel of disparity [m]
    """
    known = np.isfinite(heights)
    if len(heights) == 1:
        return known
    level, within, agree = (
        _without_pair_offsets(heights),
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
    undecided = tied | (
        single & maximum_filter(np.isfinite(sure), 2 * NEIGHBOUR_RADIUS + 1)
    )  # single heights without such neighbours stay
    rival, level, single = rival[:, undecided], level[:, undecided], single[undecided]
    votes, witnesses = _votes(sure, np.where(rival, level, np.nan), metres, np.nonzero(undecided))
    votes[~rival] = -1
    best = votes.argmax(axis=0)
    chosen = np.abs(level - np.take_along_axis(level, best[None], axis=0)) <= within[:, best]
    others = np.where(rival & ~chosen, votes, -1).max(axis=0)
    free = single & (witnesses < SURROUNDED * len(_NEIGHBOUR_OFFSETS))
    taken[:, undecided] = chosen & ((votes.max(axis=0) > np.maximum(others, 0)) | free)
    return taken


def _without_pair_offsets(heights: F32) -> F32:
    """Return the heights less each pair's constant offset: camera errors cause it, it is no contradiction."""
    several = np.isfinite(heights).sum(axis=0) > 1
    apart = [one[several & np.isfinite(one)] for one in heights - finite_median(heights)]
    off = np.array([np.median(one) if len(one) else 0.0 for one in apart], np.float32)
    return np.asarray(heights - off[:, None, None])


def _votes(
    sure: Array, candidates: F32, metres: F32, at: tuple[npt.NDArray[np.intp], ...]
) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.int16]]:
    """Return the number of neighbouring heights that agree with each candidate (K, n), and that of all known ones (n,).

    `sure` (rows, cols): heights of the cells in which pairs agree, else NaN; `at`: rows and columns of n cells.
    """
    around, (row, col) = np.pad(sure, NEIGHBOUR_RADIUS, constant_values=np.nan), (one + NEIGHBOUR_RADIUS for one in at)
    votes, witnesses = np.zeros(candidates.shape, np.int16), np.zeros(len(row), np.int16)
    for down, right in _NEIGHBOUR_OFFSETS:
        neighbour = around[row + down, col + right]
        votes += np.abs(candidates - neighbour) <= metres[:, None]
        witnesses += np.isfinite(neighbour)
    return votes, witnesses
