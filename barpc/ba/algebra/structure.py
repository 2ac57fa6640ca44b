"""Who sees what: the sparsity of a block, worked out once and used by every linearisation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from barpc.ba.algebra.dissection import Dissection, dissect
from barpc.base.geodesy import Array
from barpc.scene import BoolArray, IntArray


@dataclass(frozen=True)
class Structure:
    """Index arrays of K observations of P points in N views, sorted by view."""

    num_views: int
    num_points: int
    view: IntArray  # (K,)
    point: IntArray  # (K,)
    bounds: IntArray  # (N + 1,) observations of view v are bounds[v] : bounds[v + 1]
    by_point: IntArray  # (K,) observations sorted by point
    # (P + 1,) observations of point p are by_point[point_bounds[p] : point_bounds[p + 1]]
    point_bounds: IntArray
    first: IntArray  # (Q,) pairs of observations of one point, sorted by their pair of views
    second: IntArray  # (Q,)
    pair_view: IntArray  # (M, 2) pairs of views i < j that share a point
    pair_bounds: IntArray  # (M + 1,) observation pairs of view pair m are pair_bounds[m] : pair_bounds[m + 1]
    place: Array  # (N, 2) where each view stands on the ground, roughly
    _orders: dict[bytes, Dissection] = field(default_factory=dict, repr=False)

    def order(self, use: BoolArray) -> Dissection:
        """Return the order of elimination of the views in use (N,), computed once."""
        key = use.tobytes()
        if key not in self._orders:
            self._orders[key] = dissect(self.pair_view, self.place, use)
        return self._orders[key]

    def sum_points(self, rows: Array) -> Array:
        """Return the sums (m, P) over every point's observations of rows (m, K)."""
        return np.array([np.bincount(self.point, row, self.num_points) for row in rows])

    def of_points(self, points: Array) -> Array:
        """Return the coordinates (3, K) of every observation's point, of points (P, 3)."""
        return np.ascontiguousarray(points.T).take(self.point, axis=1, mode="clip")

    def sum_views(self, rows: Array) -> Array:
        """Return the sums (N, m) over every view's observations of rows (m, K)."""
        out = np.zeros((self.num_views, len(rows)))
        filled = np.flatnonzero(np.diff(self.bounds))
        if len(filled):
            out[filled] = np.add.reduceat(rows, self.bounds[filled], axis=1).T
        return out


def make_structure(
    view: IntArray,
    point: IntArray,
    num_views: int,
    num_points: int,
    place: Array | None = None,
    joined: IntArray | None = None,
) -> Structure:
    """Return the structure of observations (K,) that are already sorted by view; all views `joined` are pairs, too."""
    bounds = np.searchsorted(view, np.arange(num_views + 1))
    by_point, point_bounds = counting_sort(point, num_points)
    first, second = _pairs(by_point, point_bounds)
    order, _ = counting_sort(view[second], num_views)
    order = order[counting_sort(view[first[order]], num_views)[0]]
    first, second = first[order], second[order]
    key = view[first] * num_views + view[second]
    keys = key[np.flatnonzero(np.diff(key, prepend=-1))]
    if joined is not None:
        i, j = np.sort(joined)[np.stack(np.triu_indices(len(joined), 1))]
        keys = np.union1d(keys, i * num_views + j)
    pair_view = np.column_stack([keys // num_views, keys % num_views])
    pair_bounds = np.append(np.searchsorted(key, keys), len(key))
    return Structure(
        num_views,
        num_points,
        view,
        point,
        bounds,
        by_point,
        point_bounds,
        first,
        second,
        pair_view,
        pair_bounds,
        np.zeros((num_views, 2)) if place is None else place,
    )


def parts(stop: int, size: int, start: int = 0) -> Iterator[slice]:
    """Yield the pieces of observations start .. stop, of `size` that stay in cache."""
    for first in range(start, stop, size):
        yield slice(first, min(first + size, stop))


def counting_sort(key: IntArray, size: int) -> tuple[IntArray, IntArray]:
    """Return the stable order (n,) of keys 0 .. size - 1, and the start and end of each key's part (size + 1,).

    Sixteen bits at a time, which numpy sorts by counting.
    """
    order = np.argsort(key.astype(np.uint16), kind="stable")
    for shift in range(16, size.bit_length(), 16):
        order = order[np.argsort((key[order] >> shift).astype(np.uint16), kind="stable")]
    return order, np.append(0, np.cumsum(np.bincount(key, minlength=size)))


def _pairs(by_point: IntArray, starts: IntArray) -> tuple[IntArray, IntArray]:
    """Return all pairs of observations of each point; views ascend within a point, so i < j in every pair."""
    length = np.diff(starts)
    first, second = [], []
    for n in np.unique(length[length > 1]):
        rows = by_point[starts[:-1][length == n, None] + np.arange(n)]
        i, j = np.triu_indices(n, 1)
        first.append(rows[:, i].ravel())
        second.append(rows[:, j].ravel())
    empty = [np.zeros(0, dtype=np.int64)]
    return np.concatenate(first or empty), np.concatenate(second or empty)
