"""The structure of a block: views by points, and the order in which views are eliminated, for every linearisation.

The order is nested dissection (George 1973), so that little fills in. Views are tied to those beside them on the
ground, or to those next in time where all see one place. A block is cut in two by the fewest views that touch all ties
across a cut, each side is cut again, and what cuts is eliminated after what it parts. The factor of a square of n views
then has n log n numbers and costs n^1.5 products; that of a strip, n both.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp

from barpc.base.geodesy import Array
from barpc.scene import BoolArray, IntArray

LEAF = 32  # views that are not cut any further


@dataclass(frozen=True, eq=False)
class Front:
    """Views eliminated together, and the views that this ties to each other."""

    pivots: IntArray  # views, in the order of elimination
    border: IntArray  # later ones that are tied to them by then, in that order
    parent: int  # the front that has the first of these among its pivots; -1: none


@dataclass(frozen=True, eq=False)
class Dissection:
    """The order of elimination, front by front: children before their parents."""

    fronts: tuple[Front, ...]
    rank: IntArray  # (N,) which comes when; -1 for one that is not eliminated
    owner: IntArray  # (N,) the front whose pivot it is, or -1


def dissect(pairs: IntArray, place: Array, use: BoolArray, last: IntArray | None = None) -> Dissection:
    """Return the nested-dissection order of the views in `use` (N,), tied in `pairs` (M, 2), at `place` (N, 2).

    Views that are to come `last` (n,) are the last front, in the order given: its matrix is the reduced one of theirs
    once all others are eliminated.
    """
    n = len(place)
    (i, j), own = pairs[use[pairs].all(axis=1)].astype(np.int32).T, np.arange(n, dtype=np.int32)
    ties = np.concatenate([i, j, own]), np.concatenate([j, i, own])
    graph = sp.csr_array((np.ones(len(ties[0]), dtype=np.int8), ties), shape=(n, n))
    pieces: list[IntArray] = []
    last = np.zeros(0, dtype=np.int64) if last is None else last
    _dissect(graph, np.nan_to_num(place), np.setdiff1d(np.flatnonzero(use), last), pieces)
    pieces += [last] if len(last) else []
    rank, owner, at = np.full(n, -1), np.full(n, -1), 0
    for number, piece in enumerate(pieces):
        rank[piece], owner[piece] = at + np.arange(len(piece)), number
        at += len(piece)
    return Dissection(tuple(_fronts(graph, pieces, rank, owner)), rank, owner)


def _fronts(graph: sp.csr_array, pieces: list[IntArray], rank: IntArray, owner: IntArray) -> list[Front]:
    """Return the fronts of pieces in their order: a border has the unknowns tied to pivots or to fronts below."""
    fronts: list[Front] = []
    below: list[list[IntArray]] = [[] for _ in pieces]
    for number, piece in enumerate(pieces):
        touched = np.concatenate([graph.indices[slice(*graph.indptr[v : v + 2])] for v in piece])
        later = [views[rank[views] > rank[piece[-1]]] for views in (touched, *below[number])]
        border = np.unique(np.concatenate(later).astype(np.int64))
        border = border[np.argsort(rank[border])]
        parent = int(owner[border[0]]) if len(border) else -1
        if len(border):
            below[parent].append(border)
        fronts.append(Front(piece, border, parent))
    return fronts


def _dissect(graph: sp.csr_array, place: Array, views: IntArray, pieces: list[IntArray]) -> None:
    """Append the views (n,) piece by piece: one side, the other, and their separator."""
    waiting = [(views, False)]
    while waiting:
        piece, whole = waiting.pop()
        parted = None if whole or len(piece) <= LEAF else _separator(graph, place, piece)
        if parted is not None:
            near, far, between = parted
            waiting += [(between, True), (far, False), (near, False)]
        elif len(piece):
            pieces.append(piece)


def _separator(graph: sp.csr_array, place: Array, views: IntArray) -> tuple[IntArray, IntArray, IntArray] | None:
    """Return two sides of the views and the fewest between them; None where every cut leaves a side empty."""
    own = graph[views][:, views]
    at = place[views]
    order, cut = min((best_cut(own, order) for order in _orders(own, at)), key=lambda found: found[2])[:2]
    if not cut:
        return None
    near, far = np.sort(order[:cut]), np.sort(order[cut:])
    between = _touching(own, near, far)
    narrow = int(np.argmin(np.ptp(at, axis=0)))
    between = between[np.argsort(at[between, narrow], kind="stable")]  # neighbours stay neighbours
    near, far = np.setdiff1d(near, between), np.setdiff1d(far, between)
    return views[near], views[far], views[between]


def _orders(graph: sp.csr_array, place: Array) -> Iterator[IntArray]:
    """Yield the orders of n views that a cut may part in two: by their parts, or along the ground and along
    the ties.
    """
    from scipy.sparse.csgraph import breadth_first_order, connected_components  # of blocks that are cut alone

    count, part = connected_components(graph, connection="strong")  # ties go both ways
    if count > 1:
        yield np.argsort(part, kind="stable")
        return
    for axis in range(2):
        yield np.argsort(place[:, axis], kind="stable")
    last = 0  # of an order from anywhere: as far as ties reach, or nearly (George and Liu 1979)
    for _ in range(2):
        last = breadth_first_order(graph, last, return_predecessors=False)[-1]
    yield breadth_first_order(graph, last, return_predecessors=False).astype(np.int64)


def best_cut(graph: sp.csr_array, order: IntArray) -> tuple[IntArray, int, float]:
    """Return an order, how many of it stand before its best cut (0: there is none), and its cost.

    A cut that s views touch from one side, and that leaves a and b, costs s / (a b): few views, and balanced sides.
    """
    n = len(order)
    rank = np.empty(n, dtype=np.int64)
    rank[order] = np.arange(n)
    tied = rank[graph.indices]  # each view to itself, too
    first, last = (ufunc.reduceat(tied, graph.indptr[:-1]) for ufunc in (np.minimum, np.maximum))
    cut, every = np.arange(1, n), np.arange(n)
    # touched from before the cut, and from behind it
    before = np.cumsum(np.bincount(every, minlength=n) - np.bincount(last, minlength=n))[:-1]
    behind = np.cumsum(np.bincount(first, minlength=n) - np.bincount(every, minlength=n))[:-1]
    fewest = np.minimum(before, behind)
    product = np.where(before < behind, (cut - before) * (n - cut), cut * (n - cut - behind))
    cost = np.where(product > 0, (fewest + 1.0) / np.maximum(product, 1), np.inf)
    best = int(np.argmin(cost))
    return order, int(cut[best]) if np.isfinite(cost[best]) else 0, float(cost[best])


def _touching(graph: sp.csr_array, near: IntArray, far: IntArray) -> IntArray:
    """Return the fewest views that touch all ties between two sides (König's theorem)."""
    across = graph[near][:, far]
    rows = np.flatnonzero(np.diff(across.indptr))
    cols = np.unique(across.indices)
    if not len(rows):
        return np.zeros(0, dtype=np.int64)
    across = sp.csr_array(across[rows][:, cols])
    of_col = _matching(across)
    reached, by_tie = np.ones(len(rows), dtype=bool), np.zeros(len(cols), dtype=bool)
    reached[of_col[of_col >= 0]] = False
    new = np.flatnonzero(reached)
    while len(new):  # along ties to the far side, along the matching back
        touched = np.unique(across[new].indices)
        touched = touched[~by_tie[touched]]
        by_tie[touched] = True
        back = of_col[touched]
        new = back[~reached[back]]
        reached[new] = True
    return np.concatenate([near[rows[~reached]], far[cols[by_tie]]])


def _matching(across: sp.csr_array) -> IntArray:
    """Return the row that each column is matched with, or -1, as many as can be: a flow of one from each row
    to a column.

    scipy's `maximum_bipartite_matching` takes time exponential in the depth of such graphs (scipy issue 26147).
    """
    from scipy.sparse.csgraph import maximum_flow

    (rows, cols), ties = across.shape, across.nnz
    # nodes: the source, rows, columns, the sink
    indices = np.concatenate([1 + np.arange(rows), 1 + rows + across.indices, np.full(cols, 1 + rows + cols)])
    to_sink = rows + ties + np.arange(cols + 1)
    starts = np.concatenate([[0], rows + across.indptr[:-1], to_sink, [rows + ties + cols]])
    size = rows + cols + 2
    capacity = np.ones(len(indices), dtype=np.int32)
    pipes = sp.csr_array((capacity, indices.astype(np.int32), starts.astype(np.int32)), shape=(size, size))
    flow = maximum_flow(pipes, 0, size - 1).flow
    back = flow[1 + rows : size - 1, 1 : 1 + rows].tocoo()  # less than nothing flows back along a tie
    out = np.full(cols, -1)
    used = back.data < 0
    out[back.row[used]] = back.col[used]
    return out


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
    first, second = _observation_pairs(by_point, point_bounds)
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


def unknowns_of(views: IntArray, size: int) -> IntArray:
    """Return the places (n q,) of the unknowns of views (n,), of `size` q each."""
    return np.asarray((views[:, None] * size + np.arange(size)).ravel())


def counting_sort(key: IntArray, size: int) -> tuple[IntArray, IntArray]:
    """Return the stable order (n,) of keys 0 .. size - 1, and the start and end of each key's part (size + 1,).

    Sixteen bits at a time, which numpy sorts by counting.
    """
    order = np.argsort(key.astype(np.uint16), kind="stable")
    for shift in range(16, size.bit_length(), 16):
        order = order[np.argsort((key[order] >> shift).astype(np.uint16), kind="stable")]
    return order, np.append(0, np.cumsum(np.bincount(key, minlength=size)))


def _observation_pairs(by_point: IntArray, starts: IntArray) -> tuple[IntArray, IntArray]:
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
