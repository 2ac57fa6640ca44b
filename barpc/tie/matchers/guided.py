"""The best counterpart of every keypoint inside a band about its epipolar segment."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from barpc.base.geodesy import Array
from barpc.base.options import TieOptions
from barpc.scene import IntArray, View
from barpc.tie.matchers.features import Keypoints
from barpc.tie.matchers.matcher import APART, NO_MATCHES, Matches, Prediction
from barpc.tie.pairing.epipolar import EpipolarSegments

FloatArray = npt.NDArray[np.float32]

CLEAR_RATIO = 0.8
"""Largest ratio where only clear matches count."""
_MAX_TURN = np.radians(30.0)  # between the orientation seen and the one expected
_ROWS = 64  # points of A, near each other, that are compared with all their candidates at a time


class Guided:
    """Mutual best descriptors of like orientation among the candidates inside the bands."""

    detects: ClassVar[bool] = True

    def __init__(self, options: TieOptions, keypoints: tuple[Keypoints, Keypoints]) -> None:
        self._ratio, (self._a, self._b) = options.ratio, keypoints
        self._prepared: tuple[Array, _Described, _Described] | None = None

    def match(self, a: View, b: View, prediction: Prediction) -> Matches:
        """Return the mutual best keypoints whose second best is farther by the ratio test (Lowe 2004)."""
        if not (len(self._a) and len(self._b)):
            return NO_MATCHES
        where = prediction.at(self._a.xy)
        if self._prepared is None:  # the axis of the frames, and so all this, is one for a pair
            described = _Described.of(self._a, where.linear), _Described.of(self._b, np.eye(2))
            self._prepared = where.turn(self._b.xy), *described
        turned, first, second = self._prepared
        best = _Best(len(self._a), len(self._b))
        for rows, cols in _near(where, prediction.half_width, prediction.chosen(len(self._a)), turned):
            du = turned[cols, 0] - where.along[rows, None]
            dw = turned[cols, 1] - where.across[rows, None] - where.slope[rows, None] * du
            allowed = (np.abs(dw) <= prediction.half_width) & (du <= where.after[rows, None])
            allowed &= du >= where.before[rows, None]
            best.update(rows, cols, first.select(rows).likeness(second.select(cols), allowed), du, dw)
        index, distance, ambiguity = best.mutual()
        clear = ambiguity <= (self._ratio if prediction.probes is None else min(self._ratio, CLEAR_RATIO))
        xy = np.stack([self._a.xy[index[:, 0]], self._b.xy[index[:, 1]]], axis=1)
        return Matches(xy, distance, index).select(clear)


@dataclass(frozen=True, eq=False)
class _Described:
    """Descriptors and their lengths, with the orientation that they should have in B."""

    values: FloatArray  # whole numbers: their products are exact in any order of summing, on any machine
    length: FloatArray
    direction: FloatArray

    @staticmethod
    def of(keypoints: Keypoints, linear: Array) -> _Described:
        values = keypoints.descriptors.astype(np.float32)
        length = np.maximum(np.linalg.norm(values, axis=1), np.float32(1e-6))
        turned = np.stack([np.cos(keypoints.angle), np.sin(keypoints.angle)], axis=-1) @ linear.T
        turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
        return _Described(values, length, turned.astype(np.float32))

    def select(self, which: IntArray) -> _Described:
        """Return those of some keypoints."""
        return _Described(self.values[which], self.length[which], self.direction[which])

    def likeness(self, other: _Described, allowed: npt.NDArray[np.bool_]) -> FloatArray:
        """Return the cosines (n, m) of descriptors whose orientation is as expected; else -inf."""
        allowed &= self.direction @ other.direction.T >= np.float32(np.cos(_MAX_TURN))
        cosine = self.values @ other.values.T / (self.length[:, None] * other.length)
        return np.where(allowed, cosine, np.float32(-np.inf))


class _Best:
    """Best and second best counterpart of every point of A, best of every point of B, as candidates come in."""

    def __init__(self, size_a: int, size_b: int) -> None:
        self._of_a = np.full(size_a, -1)
        self._top, self._second = np.full((2, size_a), -np.inf, np.float32)
        self._of_b = np.full(size_b, -1)
        self._top_b = np.full(size_b, -np.inf, np.float32)

    def update(self, rows: IntArray, cols: IntArray, likeness: FloatArray, du: Array, dw: Array) -> None:
        """Take in the cosines (n, m) of candidates of some points of A, and their places about the predicted ones."""
        back = likeness.argmax(axis=0)
        top = likeness[back, np.arange(len(cols))]
        more = top > self._top_b[cols]
        self._of_b[cols[more]], self._top_b[cols[more]] = rows[back[more]], top[more]
        pick = likeness.argmax(axis=1)[:, None]
        self._of_a[rows] = cols[pick[:, 0]]
        self._top[rows] = np.take_along_axis(likeness, pick, axis=1)[:, 0]
        same = np.abs(du - np.take_along_axis(du, pick, axis=1)) <= APART
        same &= np.abs(dw - np.take_along_axis(dw, pick, axis=1)) <= APART
        self._second[rows] = np.where(same, np.float32(-np.inf), likeness).max(axis=1)

    def mutual(self) -> tuple[IntArray, Array, Array]:
        """Return the mutual best pairs (M, 2), their distances, and these over those to the second best (M,).

        Distances of descriptors are 0 to 2; where there is no second best, its distance counts as 1.
        """
        found = np.flatnonzero(self._top > -np.inf)
        found = found[self._of_b[self._of_a[found]] == found]
        top, second = self._top[found].astype(np.float64), self._second[found].astype(np.float64)
        distance = np.sqrt(np.maximum(2.0 - 2.0 * top, 0.0))
        rival = np.where(second == -np.inf, 1.0, np.sqrt(np.maximum(2.0 - 2.0 * second, 1e-12)))
        return np.stack([found, self._of_a[found]], axis=1), distance, distance / rival


def _near(
    where: EpipolarSegments, across: float, wanted: IntArray, turned: Array
) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield points of A whose bands lie near each other, and the points of B, `turned`, about these; ascending."""
    rows = wanted[np.isfinite(where.along + where.across + where.slope)[wanted]]
    if not len(rows):
        return
    u, w = where.along[rows], where.across[rows]
    reach = across + np.abs(where.slope[rows]) * np.maximum(np.abs(where.before), np.abs(where.after))[rows]
    strip = np.floor(w / max(float(np.ptp(w)) * min(1.0, (_ROWS / len(rows)) ** 0.5), across))
    order, by_w = np.lexsort((u, strip)), np.argsort(turned[:, 1], kind="stable")
    height = turned[by_w, 1]
    for first in range(0, len(order), _ROWS):
        some = order[first : first + _ROWS]
        low, high = (w - reach)[some].min(), (w + reach)[some].max()
        cols = by_w[np.searchsorted(height, low, "left") : np.searchsorted(height, high, "right")]
        left, right = (u + where.before[rows])[some].min(), (u + where.after[rows])[some].max()
        cols = cols[(turned[cols, 0] >= left) & (turned[cols, 0] <= right)]
        if len(cols):
            yield np.sort(rows[some]), np.sort(cols)
