"""Matching of descriptors: the best counterpart of every keypoint in a band about its epipolar segment."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from barpc.base.geodesy import Array
from barpc.base.options import TieOptions
from barpc.scene import BoolArray, IntArray, View
from barpc.tie.matchers.features import Keypoints
from barpc.tie.matchers.matcher import DUPLICATE_DISTANCE, NO_MATCHES, Matches, Prediction
from barpc.tie.pairing.epipolar import EpipolarSegments
from barpc.tie.pixels import PIECE

FloatArray = npt.NDArray[np.float32]

CLEAR_RATIO = 0.8
"""Largest ratio where only clear matches count."""
_MAX_TURN = np.radians(30.0)  # between the orientation seen and the one expected
_SECTORS = int(np.rint(np.pi / _MAX_TURN))  # of twice that


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
        for rows, cols in _pairs_in_band(
            where, prediction.half_width, prediction.chosen(len(self._a)), turned, first, second
        ):
            du = turned[cols, 0] - where.along[rows]
            dw = turned[cols, 1] - where.across[rows] - where.slope[rows] * du
            allowed = np.abs(dw) <= prediction.half_width
            allowed &= first.is_turned_like(second, rows, cols)
            if allowed.any():
                rows, cols, du, dw = (values[allowed] for values in (rows, cols, du, dw))
                best.update(rows, cols, first.likeness(second, rows, cols), du, dw)
        index, distance, ambiguity = best.mutual()
        clear = ambiguity <= (self._ratio if prediction.probes is None else min(self._ratio, CLEAR_RATIO))
        xy = np.stack([self._a.xy[index[:, 0]], self._b.xy[index[:, 1]]], axis=1)
        return Matches(xy, distance, index).select(clear)


@dataclass(frozen=True, eq=False)
class _Described:
    """Descriptors, their lengths, and their orientations as predicted in B."""

    values: FloatArray  # whole numbers: their products are exact in any order of summing, on any machine
    length: FloatArray
    direction: npt.NDArray[np.complex64]

    @staticmethod
    def of(keypoints: Keypoints, linear: Array) -> _Described:
        values = keypoints.descriptors.astype(np.float32)
        length = np.maximum(np.linalg.norm(values, axis=1), np.float32(1e-6))
        turned = (np.stack([np.cos(keypoints.angle), np.sin(keypoints.angle)], axis=-1) @ linear.T) @ [1.0, 1.0j]
        return _Described(values, length, (turned / np.maximum(np.abs(turned), 1e-9)).astype(np.complex64))

    def sector(self, turn: float) -> IntArray:
        """Return the sectors (n,), twice the allowed turn wide, of orientations turned by an angle [rad]."""
        return np.asarray(np.floor((np.angle(self.direction) + turn) / (2.0 * _MAX_TURN)).astype(np.int64) % _SECTORS)

    def is_turned_like(self, other: _Described, rows: IntArray, cols: IntArray) -> BoolArray:
        """Return the mask of pairs (P,) of rows and others' cols with the predicted orientation."""
        cosine = (self.direction[rows] * other.direction.conj()[cols]).real
        return np.asarray(cosine >= np.cos(_MAX_TURN))

    def likeness(self, other: _Described, rows: IntArray, cols: IntArray) -> FloatArray:
        """Return the cosines (P,) of the descriptors of pairs."""
        product = np.einsum("pk,pk->p", self.values[rows], other.values[cols])
        return np.asarray(product / (self.length[rows] * other.length[cols]))


class _Best:
    """Best and second best counterpart of every point of A, best of every point of B, as candidates come in."""

    def __init__(self, size_a: int, size_b: int) -> None:
        self._of_a = np.full(size_a, -1)
        self._top, self._second = np.full((2, size_a), -np.inf, np.float32)
        self._of_b = np.full(size_b, -1)
        self._top_b = np.full(size_b, -np.inf, np.float32)

    def update(self, rows: IntArray, cols: IntArray, likeness: FloatArray, du: Array, dw: Array) -> None:
        """Add candidate pairs (P,), all of a row of A together, and their offsets from the predicted places."""
        begin = np.flatnonzero(np.diff(rows, prepend=-1))
        of, row = np.repeat(np.arange(len(begin)), np.diff(begin, append=len(rows))), rows[begin]
        top = np.maximum.reduceat(likeness, begin)
        pick = np.empty(len(begin), dtype=np.int64)
        hit = np.flatnonzero(likeness == top[of])
        hit = hit[np.argsort(-cols[hit])]
        pick[of[hit]] = hit  # of equals the first of B
        self._of_a[row], self._top[row] = cols[pick], top
        same = (np.abs(du - du[pick][of]) <= DUPLICATE_DISTANCE) & (np.abs(dw - dw[pick][of]) <= DUPLICATE_DISTANCE)
        self._second[row] = np.maximum.reduceat(np.where(same, np.float32(-np.inf), likeness), begin)
        more = np.flatnonzero(likeness > self._top_b[cols])
        np.maximum.at(self._top_b, cols[more], likeness[more])
        more = more[likeness[more] == self._top_b[cols[more]]][::-1]
        self._of_b[cols[more]] = rows[more]  # of equals the first of A

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


def _pairs_in_band(
    where: EpipolarSegments, across: float, wanted: IntArray, turned: Array, first: _Described, second: _Described
) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield pairs (P,), (P,) of points of A and the points of B, `turned`, in a box about their band, row by row.

    Points of B stand in sectors of orientation, in each in strips across the axis, and there by their place along it.
    Sectors and strips are as wide as the widest box: two by two ranges hold any.
    """
    rows = wanted[np.isfinite(where.along + where.across + where.slope)[wanted]]
    if not len(rows):
        return
    before, after = where.before[rows], where.after[rows]
    reach = across + np.abs(where.slope[rows]) * np.maximum(np.abs(before), np.abs(after))
    low = turned[:, 1].min()
    strip = np.floor((turned[:, 1] - low) / (2.0 * reach.max())).astype(np.int64) + 2
    strips = np.floor((where.across[rows] - reach - low) / (2.0 * reach.max())).clip(-2.0, strip.max()) + 2.0
    u, num_u, num_strips = np.sort(turned[:, 0]), len(turned) + 1, strip.max() + 3
    key = (second.sector(0.0) * num_strips + strip) * num_u + np.searchsorted(u, turned[:, 0], "left")
    order = np.argsort(key, kind="stable")
    sector = (first.sector(-_MAX_TURN)[rows, None, None] + np.arange(2)) % _SECTORS
    start = (sector * num_strips + strips.astype(np.int64)[:, None, None] + np.arange(2)[:, None]) * num_u
    left, right = where.along[rows] + before, where.along[rows] + after
    begin = np.searchsorted(key[order], start + np.searchsorted(u, left, "left")[:, None, None])
    end = np.searchsorted(key[order], start + np.searchsorted(u, right, "right")[:, None, None])
    size = np.maximum(end - begin, 0)
    portion = np.cumsum(size.sum(axis=(1, 2))) * first.values.shape[1] // PIECE
    for some in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(portion)) + 1):
        sizes = size[some].ravel()
        at = np.repeat(begin[some].ravel() - (np.cumsum(sizes) - sizes), sizes) + np.arange(sizes.sum())
        yield np.repeat(rows[some], size[some].sum(axis=(1, 2))), order[at]
