"""Searching the best counterpart of every keypoint inside a band about its epipolar segment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from barpc.geodesy import Array
from barpc.scene import IntArray
from barpc.tie.epipolar import Frame
from barpc.tie.features import Keypoints

FloatArray = npt.NDArray[np.float32]

_MAX_TURN = np.radians(30.0)  # between the orientation seen and the one expected
_MAX_ZOOM = np.log(1.8)  # the same for the scale
_APART = 2.0  # px; nearer candidates are the same point
_NONE = np.float32(-2.0)  # below every cosine


@dataclass(frozen=True, eq=False)
class Band:
    """Where points of A are looked for in B, relative to a `Frame`.

    Parameters
    ----------
    before, after : (N,)
        How far along the axis, from (negative: backwards) and to [px].
    across : float
        Half width [px].
    """

    before: Array
    after: Array
    across: float

    def select(self, rows: IntArray) -> Band:
        """The band of some points."""
        return Band(self.before[rows], self.after[rows], self.across)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Mutual best pairs of keypoints.

    Parameters
    ----------
    index : (M, 2)
        Keypoints of A and of B.
    distance : (M,)
        Of the descriptors, 0 to 2.
    ambiguity : (M,)
        `distance` over that to the second best candidate; over 1 where there is none.
    """

    index: IntArray
    distance: Array
    ambiguity: Array


class Matcher(Protocol):
    """Finds for keypoints of A their best counterparts in B within a band."""

    def match(self, a: Keypoints, b: Keypoints, where: Frame, band: Band) -> Candidates:
        """Mutual best candidates inside the band."""
        ...


class Guided:
    """Mutual best descriptors of like scale and orientation, cell by cell of the predicted positions."""

    def match(self, a: Keypoints, b: Keypoints, where: Frame, band: Band) -> Candidates:
        """Mutual best candidates inside the band."""
        best = _Best(len(a), len(b))
        if len(a) and len(b):
            turned = where.turn(b.xy)
            strips = _Strips(turned)
            described_a, described_b = _Described.of(a, where.linear), _Described.of(b, np.eye(2))
            for rows in _cells(where, float(np.clip(band.across, 64.0, 512.0))):
                part = band.select(rows)
                tilt = np.abs(where.slope[rows]).max() * max(-part.before.min(), part.after.max(), 0.0)
                u, w = where.along[rows, None], where.across[rows, None]
                side = part.across + tilt
                cols = strips.inside(
                    (u[:, 0] + part.before).min(),
                    (u[:, 0] + part.after).max(),
                    w.min() - side,
                    w.max() + side,
                )
                if not len(cols):
                    continue
                du = (turned[cols, 0] - u).astype(np.float32)
                dw = (turned[cols, 1] - w).astype(np.float32) - where.slope[rows, None].astype(
                    np.float32
                ) * du
                allowed = (
                    (np.abs(dw) <= part.across) & (du >= part.before[:, None]) & (du <= part.after[:, None])
                )
                best.update(rows, cols, described_a.likeness(rows, described_b, cols, allowed), du, dw)
        return best.mutual()


MATCHERS: dict[str, Callable[[], Matcher]] = {"guided": Guided}
"""Name -> matcher."""


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

    def mutual(self) -> Candidates:
        found = np.flatnonzero(self._top > -1)
        found = found[self._of_b[self._of_a[found]] == found]
        top, second = self._top[found].astype(np.float64), self._second[found].astype(np.float64)
        distance = np.sqrt(np.maximum(2.0 - 2.0 * top, 0.0))
        rival = np.where(second < -1, 1.0, np.sqrt(np.maximum(2.0 - 2.0 * second, 1e-12)))
        return Candidates(np.stack([found, self._of_a[found]], axis=1), distance, distance / rival)


class _Strips:
    """Points of B sorted into strips across the epipolar direction, and along it within a strip."""

    height = 32.0

    def __init__(self, turned: Array) -> None:
        self._first = float(turned[:, 1].min())
        strip = np.floor((turned[:, 1] - self._first) / self.height).astype(np.int64)
        self._order = np.lexsort((turned[:, 0], strip))
        self._along = turned[self._order, 0]
        self._starts = np.searchsorted(strip[self._order], np.arange(strip.max() + 2))

    def inside(self, left: float, right: float, low: float, high: float) -> IntArray:
        """Indices of the points in strips that touch [low, high] across, within [left, right] along."""
        first = max(0, int((low - self._first) // self.height))
        last = min(len(self._starts) - 2, int((high - self._first) // self.height))
        parts = []
        for strip in range(first, last + 1):
            start, stop = self._starts[strip], self._starts[strip + 1]
            begin, end = np.searchsorted(self._along[start:stop], [left, right])
            parts.append(self._order[start + begin : start + end])
        return np.sort(np.concatenate(parts)) if parts else np.empty(0, dtype=np.int64)


def _cells(where: Frame, side: float) -> list[IntArray]:
    """Indices of the predicted points of A, cell by cell of B; points without a prediction are left out."""
    usable = np.flatnonzero(np.isfinite(where.along + where.across + where.slope))
    if not len(usable):
        return []
    cell = np.floor(np.stack([where.across[usable], where.along[usable]], axis=1) / side)
    order = np.lexsort((cell[:, 1], cell[:, 0]))
    cuts = np.flatnonzero((np.diff(cell[order], axis=0) != 0).any(axis=1)) + 1
    return np.split(usable[order], cuts)
