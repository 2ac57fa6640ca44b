"""The best counterpart of every keypoint inside a band about its epipolar segment."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from barpc.geodesy import Array
from barpc.options import TieOptions
from barpc.scene import IntArray, View
from barpc.tie.epipolar import Frame
from barpc.tie.features import Keypoints
from barpc.tie.matcher import NO_MATCHES, Matches, Prediction

FloatArray = npt.NDArray[np.float32]

CLEAR_RATIO = 0.8
"""Largest ratio where only clear matches count."""
_MAX_TURN = np.radians(30.0)  # between the orientation seen and the one expected
_MAX_ZOOM = np.log(1.8)  # the same for the scale
_APART = 2.0  # px; nearer candidates are the same point
_NONE = np.float32(-2.0)  # below every cosine
_CANDIDATES = 400_000  # looked at together


class Guided:
    """Mutual best descriptors of like scale and orientation among the candidates inside the bands."""

    detects: ClassVar[bool] = True

    def __init__(self, options: TieOptions, keypoints: tuple[Keypoints, Keypoints]) -> None:
        self._ratio, (self._a, self._b) = options.ratio, keypoints
        self._prepared: tuple[_Strips, _Described, _Described] | None = None

    def match(self, a: View, b: View, prediction: Prediction) -> Matches:
        """Return the mutual best keypoints whose second best is farther by the ratio test (Lowe 2004)."""
        if not (len(self._a) and len(self._b)):
            return NO_MATCHES
        where, across = prediction.at(self._a.xy), prediction.half_width
        if self._prepared is None:  # the axis of the frames, and so all this, is one for a pair
            described = _Described.of(self._a, where.linear), _Described.of(self._b, np.eye(2))
            self._prepared = _Strips(where.turn(self._b.xy)), *described
        strips, first, second = self._prepared
        best = _Best(len(self._a), len(self._b))
        for row, col in strips.near(where, across, prediction.chosen(len(self._a))):
            du, dw = strips.apart(where, row, col)
            allowed = (np.abs(dw) <= across) & (du >= where.before[row]) & (du <= where.after[row])
            allowed[allowed] = first.alike(row[allowed], second, col[allowed])
            if allowed.any():
                a_of, b_of = row[allowed], col[allowed]
                best.update(a_of, b_of, first.likeness(a_of, second, b_of), du[allowed], dw[allowed])
        index, distance, ambiguity = best.mutual()
        clear = ambiguity <= (self._ratio if prediction.probes is None else min(self._ratio, CLEAR_RATIO))
        xy = np.stack([self._a.xy[index[:, 0]], self._b.xy[index[:, 1]]], axis=1)
        return Matches(xy, distance, index).select(clear)


@dataclass(frozen=True, eq=False)
class _Described:
    """Descriptors as unit vectors, with orientation and scale as they should be in B."""

    unit: FloatArray
    direction: FloatArray
    zoom: FloatArray

    @staticmethod
    def of(keypoints: Keypoints, linear: Array) -> _Described:
        values = keypoints.descriptors.astype(np.float32)
        norm = np.maximum(np.linalg.norm(values, axis=1, keepdims=True), np.float32(1e-6))
        turned = np.stack([np.cos(keypoints.angle), np.sin(keypoints.angle)], axis=-1) @ linear.T
        turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
        zoom = np.log(keypoints.scale * np.sqrt(np.abs(np.linalg.det(linear))))
        return _Described(values / norm, turned.astype(np.float32), zoom.astype(np.float32))

    def alike(self, row: IntArray, other: _Described, col: IntArray) -> npt.NDArray[np.bool_]:
        """Return the candidates of about the expected orientation and scale."""
        turned = np.einsum("ij,ij->i", self.direction[row], other.direction[col])
        out: npt.NDArray[np.bool_] = turned >= np.float32(np.cos(_MAX_TURN))
        out &= np.abs(other.zoom[col] - self.zoom[row]) <= np.float32(_MAX_ZOOM)
        return out

    def likeness(self, row: IntArray, other: _Described, col: IntArray) -> FloatArray:
        """Return the cosines of the descriptors, pair by pair."""
        out: FloatArray = np.einsum("ij,ij->i", self.unit[row], other.unit[col])
        return out


class _Best:
    """Best and second best counterpart of every point of A, best of every point of B, as candidates come in."""

    def __init__(self, size_a: int, size_b: int) -> None:
        self._of_a = np.full(size_a, -1)
        self._top, self._second = np.full((2, size_a), _NONE)
        self._of_b = np.full(size_b, -1)
        self._top_b = np.full(size_b, _NONE)

    def update(self, row: IntArray, col: IntArray, likeness: FloatArray, du: Array, dw: Array) -> None:
        """Take in all candidates of some points of A: their cosines and their places about the predicted ones."""
        order = np.lexsort((row, -likeness, col))
        back = order[np.unique(col[order], return_index=True)[1]]
        back = back[likeness[back] > self._top_b[col[back]]]
        self._of_b[col[back]], self._top_b[col[back]] = row[back], likeness[back]
        order = np.lexsort((col, -likeness, row))
        rows, start, number = np.unique(row[order], return_index=True, return_inverse=True)
        pick = order[start]
        self._of_a[rows], self._top[rows] = col[pick], likeness[pick]
        same = np.abs(du[order] - du[pick][number]) <= _APART
        same &= np.abs(dw[order] - dw[pick][number]) <= _APART
        self._second[rows] = np.maximum.reduceat(np.where(same, _NONE, likeness[order]), start)

    def mutual(self) -> tuple[IntArray, Array, Array]:
        """Return the mutual best pairs (M, 2), their distances, and these over those to the second best (M,).

        Distances of descriptors are 0 to 2; where there is no second best, its distance counts as 1.
        """
        found = np.flatnonzero(self._top > -1)
        found = found[self._of_b[self._of_a[found]] == found]
        top, second = self._top[found].astype(np.float64), self._second[found].astype(np.float64)
        distance = np.sqrt(np.maximum(2.0 - 2.0 * top, 0.0))
        rival = np.where(second < -1, 1.0, np.sqrt(np.maximum(2.0 - 2.0 * second, 1e-12)))
        return np.stack([found, self._of_a[found]], axis=1), distance, distance / rival


class _Strips:
    """Points of B sorted into strips across the epipolar direction, and along it within a strip."""

    height = 8.0

    def __init__(self, turned: Array) -> None:
        self._turned = turned
        self._corner = turned.min(axis=0)
        self._length = float(np.ptp(turned[:, 0])) + 3.0
        strip = np.floor((turned[:, 1] - self._corner[1]) / self.height)
        key = strip * self._length + turned[:, 0] - self._corner[0] + 1.0
        self._order = np.argsort(key, kind="stable")
        self._key, self._last = key[self._order], int(strip.max())

    def near(self, where: Frame, across: float, wanted: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
        """Yield the points of A and the points of B in the strips that their bands touch, all of a point of A
        together.
        """
        rows = wanted[np.isfinite(where.along + where.across + where.slope)[wanted]]
        before, after, u, w = (x[rows] for x in (where.before, where.after, where.along, where.across))
        reach = across + np.abs(where.slope[rows]) * np.maximum(np.abs(before), np.abs(after))
        ends = ((end - self._corner[1]) / self.height for end in (w - reach, w + reach))
        first, last = (np.floor(end).clip(-1, self._last + 1).astype(np.int64) for end in ends)
        first, last = first.clip(0), last.clip(None, self._last)
        point, strip = _expanded(first, (last - first + 1).clip(0))
        span = (
            (u + end - self._corner[0])[point].clip(-1.0, self._length - 2.0) + 1.0 for end in (before, after)
        )
        low, high = (strip * self._length + end for end in span)
        begin, end = (
            np.searchsorted(self._key, low, side="left"),
            np.searchsorted(self._key, high, side="right"),
        )
        count = (end - begin).clip(0)
        of_point = np.bincount(point, weights=count, minlength=len(rows))
        cuts = np.searchsorted(point, np.flatnonzero(np.diff(np.cumsum(of_point) // _CANDIDATES)) + 1)
        for part in np.split(np.arange(len(point)), cuts):
            number, place = _expanded(begin[part], count[part])
            yield rows[point[part][number]], self._order[place]

    def apart(self, where: Frame, row: IntArray, col: IntArray) -> tuple[Array, Array]:
        """Return the distances along and across of points of B from the predicted ones of A, pair by pair."""
        du = self._turned[col, 0] - where.along[row]
        return du, self._turned[col, 1] - where.across[row] - where.slope[row] * du


def _expanded(first: IntArray, count: IntArray) -> tuple[IntArray, IntArray]:
    """Return the ranges that begin at `first` and hold `count` numbers: the number of its range, and each
    number in it.
    """
    which = np.repeat(np.arange(len(first)), count)
    within = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    return which, first[which] + within
