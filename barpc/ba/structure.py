"""Who sees what: the sparsity of a block, worked out once and used by every linearisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from barpc.geodesy import Array
from barpc.scene import IntArray


@dataclass(frozen=True)
class Structure:
    """Index arrays of K observations of P points in N views; observations sorted by view.

    Parameters
    ----------
    num_views, num_points : int
        N and P.
    view, point : (K,)
        Indices of every observation.
    bounds : (N + 1,)
        Observations of view v are bounds[v] : bounds[v + 1].
    point_sum : (P, K) sparse
        Sums over the observations of a point.
    first, second : (Q,)
        Pairs of observations of one point, sorted by their pair of views.
    pair_view : (M, 2)
        Pairs of views i < j that share a point.
    pair_bounds : (M + 1,)
        Observation pairs of view pair m are pair_bounds[m] : pair_bounds[m + 1].
    """

    num_views: int
    num_points: int
    view: IntArray
    point: IntArray
    bounds: IntArray
    point_sum: sp.csr_array
    first: IntArray
    second: IntArray
    pair_view: IntArray
    pair_bounds: IntArray

    def sum_points(self, rows: Array) -> Array:
        """Sums (P, m) over every point's observations of rows (K, m)."""
        total: Array = self.point_sum @ rows
        return total

    def sum_views(self, rows: Array) -> Array:
        """Sums (N, m) over every view's observations of rows (m, K)."""
        out = np.zeros((self.num_views, len(rows)))
        filled = np.flatnonzero(np.diff(self.bounds))
        if len(filled):
            out[filled] = np.add.reduceat(rows, self.bounds[filled], axis=1).T
        return out


def make_structure(view: IntArray, point: IntArray, num_views: int, num_points: int) -> Structure:
    """The structure of observations that are already sorted by view.

    Parameters
    ----------
    view, point : (K,)
        Indices of every observation, views ascending.
    num_views, num_points : int
        N and P.

    Returns
    -------
    Structure
    """
    count = len(view)
    bounds = np.searchsorted(view, np.arange(num_views + 1))
    by_point = np.argsort(point, kind="stable")
    starts = np.searchsorted(point[by_point], np.arange(num_points + 1))
    point_sum = sp.csr_array((np.ones(count), by_point, starts), shape=(num_points, count))
    first, second = _pairs(by_point, starts)
    key = view[first] * num_views + view[second]
    order = np.argsort(key, kind="stable")
    key = key[order]
    at = np.flatnonzero(np.diff(key, prepend=-1))
    keys = key[at]
    pair_view = np.column_stack([keys // num_views, keys % num_views])
    pair_bounds = np.append(at, len(key))
    return Structure(
        num_views,
        num_points,
        view,
        point,
        bounds,
        point_sum,
        first[order],
        second[order],
        pair_view,
        pair_bounds,
    )


def _pairs(by_point: IntArray, starts: IntArray) -> tuple[IntArray, IntArray]:
    """All pairs of observations of each point; views ascend within a point, so i < j in every pair."""
    length = np.diff(starts)
    first, second = [], []
    for n in np.unique(length[length > 1]):
        rows = by_point[starts[:-1][length == n, None] + np.arange(n)]
        i, j = np.triu_indices(n, 1)
        first.append(rows[:, i].ravel())
        second.append(rows[:, j].ravel())
    empty = [np.zeros(0, dtype=np.int64)]
    return np.concatenate(first or empty), np.concatenate(second or empty)
