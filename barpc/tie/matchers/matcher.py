"""What a matcher is given, and what it gives back.

A matcher is a class of one file and one row in `barpc.tie.matchers.matching.MATCHERS`: `match(a, b, prediction)` looks
for points of view A in view B. A view has a path to read pixels from and the camera; the prediction says where
in B any point of A may lie. What is found goes, whatever found it, the same way: bands that hold no true match
tell how many are false, a robust fit throws out what does not lie on the epipolar lines, matches that share a
point are linked into tracks, and these are registered to sub-pixel places.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np

from barpc.geodesy import Array
from barpc.options import TieOptions
from barpc.scene import BoolArray, IntArray, View
from barpc.tie.matchers.features import Keypoints
from barpc.tie.pairing.epipolar import EpipolarSegments
from barpc.tie.pixels import Box


@dataclass(frozen=True, eq=False)
class Prediction:
    """Bands in B in which points of A may lie."""

    where: Callable[[Array], EpipolarSegments]  # of points of A (N, 2) [px]; one axis for all predictions of a pair
    half_width: float  # how far across the epipolar lines to look [px]
    windows: Callable[[], Sequence[Box]]  # those of A that B may see, as far as the cameras may be wrong
    probes: int | None = None
    """So many points, spread evenly, are enough and only clear matches count: the cameras' error is looked for."""
    aside: float = 0.0  # how far the bands are moved across the epipolar lines [px]

    def at(self, xy: Array) -> EpipolarSegments:
        """Return the epipolar frame of points of A (N, 2) [px]; NaN: nowhere."""
        return self.where(xy).moved(self.aside)

    def chosen(self, count: int) -> IntArray:
        """Return the indices of the wanted ones of `count` points, ascending."""
        return np.linspace(0, count - 1, min(count, self.probes or count)).astype(np.int64)

    def contains(self, xy: Array) -> BoolArray:
        """Return the matches (M, 2, 2) that lie in the bands, for a matcher that looks everywhere."""
        return self.judge(xy[:, 0], xy[:, 1])[0]

    def judge(self, first: Array, second: Array) -> tuple[BoolArray, Array]:
        """Return the places (M, 2), (M, 2) that lie in the bands, and their distance from the middles (M,), 1
        at the edge.

        False matches lie anywhere in a band: where nothing else tells how alike two places look, this does.
        """
        where = self.at(first)
        along, across = where.errors(second).T
        aside = np.abs(across) / self.half_width
        return (along >= where.before) & (along <= where.after) & (aside <= 1.0), aside


@dataclass(frozen=True, eq=False)
class Matches:
    """Points of two views that show the same ground."""

    xy: Array  # (M, 2, 2) col, row in the first and in the second view [px]
    score: Array  # (M,) how unlike the two places look: 0 or more, comparable among all calls for a pair
    index: IntArray
    """(M, 2) number of the point in either view: points of a view that two pairs number alike belong to one track."""
    sigma: float = float("nan")  # standard deviation of each coordinate [px], measured once they are verified

    def __len__(self) -> int:
        """Number of matches M."""
        return len(self.xy)

    @staticmethod
    def of_places(xy: Array, score: Array) -> Matches:
        """Return the matches whose points are numbered by the pixel in which they lie."""
        pixel = np.rint(xy).astype(np.int64)
        return Matches(xy, score, (pixel[..., 1] << 32) + pixel[..., 0])

    def select(self, keep: IntArray | BoolArray) -> Matches:
        """Return the matches of a mask or of indices."""
        return replace(self, xy=self.xy[keep], score=self.score[keep], index=self.index[keep])


NO_MATCHES = Matches(np.empty((0, 2, 2)), np.empty(0), np.empty((0, 2), dtype=np.int64))


class Matcher(Protocol):
    """A matcher of one pair of views, asked several times: in wide bands, narrow ones, and decoy bands aside."""

    detects: ClassVar[bool]
    """Whether it wants the views' keypoints: they are found once a view, for all its pairs."""

    def __init__(self, options: TieOptions, keypoints: tuple[Keypoints, Keypoints]) -> None: ...

    def match(self, a: View, b: View, prediction: Prediction) -> Matches:
        """Return the unambiguous matches inside the bands of the prediction, and no others; in any order."""
        ...
