"""The best counterpart of every keypoint inside a band about its epipolar segment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from barpc.geodesy import Array
from barpc.options import TieOptions
from barpc.scene import IntArray, View
from barpc.tie.epipolar import Frame, grouped
from barpc.tie.features import Keypoints
from barpc.tie.matcher import NO_MATCHES, Matches, Prediction

FloatArray = npt.NDArray[np.float32]

_CLEAR_RATIO = 0.8  # where only clear matches count
_MAX_TURN = np.radians(30.0)  # between the orientation seen and the one expected
_MAX_ZOOM = np.log(1.8)  # the same for the scale
_APART = 2.0  # px; nearer candidates are the same point
_NONE = np.float32(-2.0)  # below every cosine


class Guided:
    """Mutual best descriptors of like scale and orientation, cell by cell of the predicted positions."""

    detects: ClassVar[bool] = True

    def __init__(self, options: TieOptions, keypoints: tuple[Keypoints, Keypoints]) -> None:
        self._ratio, (self._a, self._b) = options.ratio, keypoints
        self._prepared: tuple[_Strips, _Described, _Described] | None = None

    def match(self, a: View, b: View, prediction: Prediction) -> Matches:
        """Mutual best keypoints whose second best is farther by the ratio test (Lowe 2004)."""
        if not (len(self._a) and len(self._b)):
            return NO_MATCHES
        where, across = prediction.at(self._a.xy), prediction.half_width
        if self._prepared is None:  # the axis of the frames, and so all this, is one for a pair
            described = _Described.of(self._a, where.linear), _Described.of(self._b, np.eye(2))
            self._prepared = _Strips(where.turn(self._b.xy)), *described
        strips, first, second = self._prepared
        best = _Best(len(self._a), len(self._b))
        side = float(np.clip(across, 64.0, 512.0))
        for rows in _cells(where, prediction.chosen(len(self._a)), side):
            cols = strips.near(where, across, rows)
            if len(cols):
                du, dw = strips.apart(where, rows, cols)
                allowed = np.abs(dw) <= across
                allowed &= (du >= where.before[rows, None]) & (du <= where.after[rows, None])
                best.update(rows, cols, first.likeness(rows, second, cols, allowed), du, dw)
        index, distance, ambiguity = best.mutual()
        clear = ambiguity <= (self._ratio if prediction.probes is None else min(self._ratio, _CLEAR_RATIO))
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

    def likeness(
        self, rows: IntArray, other: _Described, cols: IntArray, allowed: npt.NDArray[np.bool_]
    ) -> FloatArray:
        """Cosines (rows, cols) of the descriptors; `_NONE` where not allowed or not alike."""
        allowed &= self.direction[rows] @ other.direction[cols].T >= np.float32(np.cos(_MAX_TURN))
        allowed &= np.abs(other.zoom[cols] - self.zoom[rows, None]) <= np.float32(_MAX_ZOOM)
        cosine: FloatArray = self.unit[rows] @ other.unit[cols].T
        cosine[~allowed] = _NONE
        return cosine


class _Best:
    """Best and second best counterpart of every point of A, best of every point of B, as cells come in."""

    def __init__(self, size_a: int, size_b: int) -> None:
        self._of_a = np.full(size_a, -1)
        self._top, self._second = np.full((2, size_a), _NONE)
        self._of_b = np.full(size_b, -1)
        self._top_b = np.full(size_b, _NONE)

    def update(
        self, rows: IntArray, cols: IntArray, likeness: FloatArray, du: FloatArray, dw: FloatArray
    ) -> None:
        """Take in the cosines (rows, cols), and the positions (rows, cols) of the candidates."""
        back = likeness.argmax(axis=0)
        value = likeness[back, np.arange(len(cols))]
        better = value > self._top_b[cols]
        self._of_b[cols[better]], self._top_b[cols[better]] = rows[back[better]], value[better]
        each, pick = np.arange(len(rows)), likeness.argmax(axis=1)
        self._of_a[rows], self._top[rows] = cols[pick], likeness[each, pick]
        same = np.abs(du - du[each, pick][:, None]) <= _APART
        same &= np.abs(dw - dw[each, pick][:, None]) <= _APART
        likeness[same] = _NONE
        self._second[rows] = likeness.max(axis=1)

    def mutual(self) -> tuple[IntArray, Array, Array]:
        """Mutual best pairs (M, 2), their distances, and these over those to the second best (M,).

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

    height = 32.0

    def __init__(self, turned: Array) -> None:
        self._turned = turned
        self._first = float(turned[:, 1].min())
        strip = np.floor((turned[:, 1] - self._first) / self.height).astype(np.int64)
        self._order = np.lexsort((turned[:, 0], strip))
        self._along = turned[self._order, 0]
        self._starts = np.searchsorted(strip[self._order], np.arange(strip.max() + 2))

    def near(self, where: Frame, across: float, rows: IntArray) -> IntArray:
        """Indices of the points in strips that the bands of some points of A touch, ascending."""
        before, after, u, w = (x[rows] for x in (where.before, where.after, where.along, where.across))
        tilt = np.abs(where.slope[rows]).max() * max(-before.min(), after.max(), 0.0)
        low, high = w.min() - (across + tilt), w.max() + (across + tilt)
        first = max(0, int((low - self._first) // self.height))
        last = min(len(self._starts) - 2, int((high - self._first) // self.height))
        parts = []
        for strip in range(first, last + 1):
            start, stop = self._starts[strip], self._starts[strip + 1]
            begin, end = np.searchsorted(self._along[start:stop], [(u + before).min(), (u + after).max()])
            parts.append(self._order[start + begin : start + end])
        return np.sort(np.concatenate(parts)) if parts else np.empty(0, dtype=np.int64)

    def apart(self, where: Frame, rows: IntArray, cols: IntArray) -> tuple[FloatArray, FloatArray]:
        """Distances along and across (rows, cols) of points of B from the predicted ones of A."""
        du = (self._turned[cols, 0] - where.along[rows, None]).astype(np.float32)
        dw = (self._turned[cols, 1] - where.across[rows, None]).astype(np.float32)
        return du, dw - where.slope[rows, None].astype(np.float32) * du


def _cells(where: Frame, wanted: IntArray, side: float) -> list[IntArray]:
    """The wanted points of A, cell by cell of B; points without a prediction are left out."""
    usable = wanted[np.isfinite(where.along + where.across + where.slope)[wanted]]
    cell = np.floor(np.stack([where.across[usable], where.along[usable]]) / side)
    return [usable[rows] for rows in grouped(*cell)]
