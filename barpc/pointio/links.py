"""Points of images and which of them show the same ground: what every file of matches is brought to."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from barpc.geodesy import Array
from barpc.pointio.correspondences import IMAGE_SIGMA
from barpc.scene import IntArray, connected_labels

_STEPS = 16  # observations of a track are linked to so many after them: all of a usual track

PairPoints = tuple[int, int, Array, Array]
"""Two views, and points (M, 2), (M, 2) [px] of them that show the same ground."""


@dataclass(frozen=True, eq=False)
class Links:
    """Points (K,) of views, and pairs of them (M, 2), as rows, that were matched."""

    view: IntArray  # (K,)
    xy: Array  # (K, 2) [px]
    sigma: Array  # (K,) standard deviation of each coordinate [px]
    ends: IntArray  # (M, 2)

    @staticmethod
    def of_pairs(pairs: Iterable[PairPoints]) -> Links:
        """Return the matches of pairs of views: points of a view at the very same place are one."""
        given = list(pairs)
        view = np.concatenate(
            [np.full(len(xy), i) for a, b, *ends in given for i, xy in zip((a, b), ends, strict=True)] or [np.zeros(0)]
        )
        xy = np.concatenate([xy for _, _, *ends in given for xy in ends] or [np.zeros((0, 2))])
        starts = np.cumsum([0, *(2 * len(first) for _, _, first, _ in given)])
        ends = [
            start + np.arange(2 * len(first)).reshape(2, -1).T
            for start, (_, _, first, _) in zip(starts, given, strict=False)
        ]
        joined = np.concatenate(ends) if given else np.zeros((0, 2), dtype=np.int64)
        return Links(view.astype(np.int64), xy, np.full(len(xy), IMAGE_SIGMA), joined).merged()

    @staticmethod
    def joined(parts: Sequence[Links]) -> Links:
        """Return the matches of several files."""
        starts = np.cumsum([0, *(len(part.view) for part in parts)])
        columns = ([getattr(part, name) for part in parts] for name in ("view", "xy", "sigma"))
        view, xy, sigma = map(np.concatenate, columns)
        ends = [start + part.ends for start, part in zip(starts, parts, strict=False)]
        whole = Links(view, xy, sigma, np.concatenate(ends))
        return whole.merged() if len(parts) > 1 else parts[0]

    def merged(self) -> Links:
        """Return the points of a view at the very same place as one, the most certain."""
        table = np.column_stack([self.view, self.xy])
        order = np.lexsort((self.sigma, *table.T[::-1]))
        new = np.ones(len(table), dtype=bool)
        new[1:] = (np.diff(table[order], axis=0) != 0).any(axis=1)
        number = np.empty(len(table), dtype=np.int64)
        number[order] = np.cumsum(new) - 1
        kept = order[new]
        return Links(self.view[kept], self.xy[kept], self.sigma[kept], number[self.ends])

    @staticmethod
    def of_tracks(view: IntArray, track: IntArray, xy: Array, sigma: Array) -> Links:
        """Return the observations of tracks: each is linked to the next ones of its track."""
        order = np.lexsort((view, track))
        label, ends = track[order], [np.zeros((0, 2), dtype=np.int64)]
        for step in range(1, min(_STEPS, len(view) - 1) + 1):
            same = np.flatnonzero(label[step:] == label[:-step])
            if not len(same):
                break
            ends.append(np.column_stack([order[same], order[same + step]]))
        return Links(view, xy, sigma, np.concatenate(ends))

    def tracks(self) -> IntArray:
        """Return the track (K,) of every point: points that are linked belong to one."""
        return connected_labels(len(self.view), self.ends)


def index_pairs(matches: npt.NDArray[np.generic], counts: tuple[int, int]) -> IntArray:
    """Return the numbers (M, 2) of matched keypoints, from such a table or the partner of each (-1: none).

    ValueError for another shape, or a number beyond the `counts` of keypoints.
    """
    if matches.dtype.kind not in "iu":
        raise ValueError(f"matches of type {matches.dtype}, not whole numbers")
    found = matches.astype(np.int64)
    if found.ndim == 1 and len(found) == counts[0]:
        found = np.column_stack([np.arange(len(found)), found])[found >= 0]
    if found.ndim != 2 or found.shape[1] != 2:
        raise ValueError(f"matches of shape {found.shape} of {counts[0]} and {counts[1]} keypoints")
    if len(found) and (found.min() < 0 or (found.max(axis=0) >= counts).any()):
        raise ValueError(f"a match of a keypoint beyond the {counts[0]} and {counts[1]} that there are")
    return found
