"""The structure of a block: which view sees which point, and the elimination order of the views.

The order is nested dissection (George 1973), which keeps the fill-in low. The edges of its graph join views that share
points. The fewest views that touch every edge across a cut separate the block in two. Each side is cut again, and a
separator is eliminated after both of its sides. For n views in a square arrangement the factor has O(n log n) numbers
and costs O(n^1.5) products; for n views in one row, O(n) of both.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp

from barpc.base.geodesy import Array
from barpc.scene import BoolArray, IntArray

LEAF = 32  # largest number of views that is not cut further


@dataclass(frozen=True, eq=False)
class Front:
    """Views eliminated together, and the later views that their elimination couples."""

    pivots: IntArray  # views, in the order of elimination
    border: IntArray  # later views coupled to the pivots by then, in the order of elimination
    parent: int  # the front that has the first view of the border among its pivots; -1: none


@dataclass(frozen=True, eq=False)
class Dissection:
    """The order of elimination, front by front: children before their parents."""

    fronts: tuple[Front, ...]
    rank: IntArray  # (N,) position of each view in the order; -1: not eliminated
    owner: IntArray  # (N,) the front that has the view among its pivots; -1: not eliminated


def dissect(pairs: IntArray, place: Array, use: BoolArray, last: IntArray | None = None) -> Dissection:
    """Return the nested-dissection order of the views in `use` (N,), at `place` (N, 2), with `pairs` (M, 2) as edges.

    The views `last` (n,) form the last front, in the order given. Its matrix is their reduced matrix once all other
    views are eliminated.
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
    """Return the fronts of the pieces, in order; a border joins later neighbours of the pivots and child borders."""
    fronts: list[Front] = []
    child_borders: list[list[IntArray]] = [[] for _ in pieces]
    for number, piece in enumerate(pieces):
        neighbours = np.concatenate([graph.indices[slice(*graph.indptr[v : v + 2])] for v in piece])
        later = [views[rank[views] > rank[piece[-1]]] for views in (neighbours, *child_borders[number])]
        border = np.unique(np.concatenate(later).astype(np.int64))
        border = border[np.argsort(rank[border])]
        parent = int(owner[border[0]]) if len(border) else -1
        if len(border):
            child_borders[parent].append(border)
        fronts.append(Front(piece, border, parent))
    return fronts


def _dissect(graph: sp.csr_array, place: Array, views: IntArray, pieces: list[IntArray]) -> None:
    """Append the views (n,) to `pieces`: one side, the other side, then their separator."""
    waiting = [(views, False)]
    while waiting:
        piece, is_separator = waiting.pop()
        split = None if is_separator or len(piece) <= LEAF else _separator(graph, place, piece)
        if split is not None:
            near, far, between = split
            waiting += [(between, True), (far, False), (near, False)]
        elif len(piece):
            pieces.append(piece)


def _separator(graph: sp.csr_array, place: Array, views: IntArray) -> tuple[IntArray, IntArray, IntArray] | None:
    """Return two sides of the views and their separator; None where every cut leaves a side empty."""
    own = graph[views][:, views]
    at = place[views]
    order, cut = min((best_cut(own, order) for order in _orders(own, at)), key=lambda found: found[2])[:2]
    if not cut:
        return None
    near, far = np.sort(order[:cut]), np.sort(order[cut:])
    between = _vertex_cover(own, near, far)
    narrow = int(np.argmin(np.ptp(at, axis=0)))
    between = between[np.argsort(at[between, narrow], kind="stable")]  # views close together stay adjacent
    near, far = np.setdiff1d(near, between), np.setdiff1d(far, between)
    return views[near], views[far], views[between]


def _orders(graph: sp.csr_array, place: Array) -> Iterator[IntArray]:
    """Yield orders of n views to cut: by connected component, or else along each ground axis and by graph distance."""
    from scipy.sparse.csgraph import breadth_first_order, connected_components  # slow to import

    count, part = connected_components(graph, connection="strong")  # the graph is symmetric
    if count > 1:
        yield np.argsort(part, kind="stable")
        return
    for axis in range(2):
        yield np.argsort(place[:, axis], kind="stable")
    last = 0  # the farthest view, from the farthest view, from any view (George and Liu 1979)
    for _ in range(2):
        last = breadth_first_order(graph, last, return_predecessors=False)[-1]
    yield breadth_first_order(graph, last, return_predecessors=False).astype(np.int64)


def best_cut(graph: sp.csr_array, order: IntArray) -> tuple[IntArray, int, float]:
    """Return the order, the number of its views before the best cut (0: there is none), and the cost of that cut.

    The cost is (s + 1) / (a b), for a separator of s views between sides of a and b: small separator, balanced sides.
    """
    n = len(order)
    rank = np.empty(n, dtype=np.int64)
    rank[order] = np.arange(n)
    neighbour = rank[graph.indices]  # each view is its own neighbour, too
    first, last = (ufunc.reduceat(neighbour, graph.indptr[:-1]) for ufunc in (np.minimum, np.maximum))
    cut, every = np.arange(1, n), np.arange(n)
    # number of views before each cut with neighbours behind it, and the reverse
    before = np.cumsum(np.bincount(every, minlength=n) - np.bincount(last, minlength=n))[:-1]
    behind = np.cumsum(np.bincount(first, minlength=n) - np.bincount(every, minlength=n))[:-1]
    fewest = np.minimum(before, behind)
    product = np.where(before < behind, (cut - before) * (n - cut), cut * (n - cut - behind))
    cost = np.where(product > 0, (fewest + 1.0) / np.maximum(product, 1), np.inf)
    best = int(np.argmin(cost))
    return order, int(cut[best]) if np.isfinite(cost[best]) else 0, float(cost[best])


def _vertex_cover(graph: sp.csr_array, near: IntArray, far: IntArray) -> IntArray:
    """Return the fewest views that touch all edges between two sides: the minimum vertex cover (König's theorem)."""
    across = graph[near][:, far]
    rows = np.flatnonzero(np.diff(across.indptr))
    cols = np.unique(across.indices)
    if not len(rows):
        return np.zeros(0, dtype=np.int64)
    across = sp.csr_array(across[rows][:, cols])
    row_of_col = _matching(across)
    row_reached, col_reached = np.ones(len(rows), dtype=bool), np.zeros(len(cols), dtype=bool)
    row_reached[row_of_col[row_of_col >= 0]] = False
    new = np.flatnonzero(row_reached)
    while len(new):  # alternating paths: along any edge to the far side, along a matched one back
        touched = np.unique(across[new].indices)
        touched = touched[~col_reached[touched]]
        col_reached[touched] = True
        back = row_of_col[touched]
        new = back[~row_reached[back]]
        row_reached[new] = True
    return np.concatenate([near[rows[~row_reached]], far[cols[col_reached]]])


def _matching(across: sp.csr_array) -> IntArray:
    """Return the row matched with each column (-1: none) in a maximum matching, found as a maximum flow.

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
    network = sp.csr_array((capacity, indices.astype(np.int32), starts.astype(np.int32)), shape=(size, size))
    flow = maximum_flow(network, 0, size - 1).flow
    reverse = flow[1 + rows : size - 1, 1 : 1 + rows].tocoo()  # the reverse of a used edge has flow -1
    out = np.full(cols, -1)
    used = reverse.data < 0
    out[reverse.row[used]] = reverse.col[used]
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
    first: IntArray  # (Q,) first observations of all pairs on one point; pairs are sorted by views
    second: IntArray  # (Q,) their second observations
    pair_view: IntArray  # (M, 2) pairs of views i < j that share a point
    pair_bounds: IntArray  # (M + 1,) observation pairs of view pair m are pair_bounds[m] : pair_bounds[m + 1]
    place: Array  # (N, 2) approximate position of each view on the ground
    _orders: dict[bytes, Dissection] = field(default_factory=dict, repr=False)

    def order(self, use: BoolArray) -> Dissection:
        """Return the elimination order of the views in `use` (N,), computed once."""
        key = use.tobytes()
        if key not in self._orders:
            self._orders[key] = dissect(self.pair_view, self.place, use)
        return self._orders[key]

    def sum_points(self, rows: Array) -> Array:
        """Return the sums (m, P) of rows (m, K) over the observations of each point."""
        return np.array([np.bincount(self.point, row, self.num_points) for row in rows])

    def of_points(self, points: Array) -> Array:
        """Return the coordinates (3, K) of the point of each observation, from points (P, 3)."""
        return np.ascontiguousarray(points.T).take(self.point, axis=1, mode="clip")

    def sum_views(self, rows: Array) -> Array:
        """Return the sums (N, m) of rows (m, K) over the observations of each view."""
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
    """Return the structure of observations (K,) sorted by view; any two of the views `joined` (n,) are a pair, too."""
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
    """Return the indices (n q,) of the unknowns of views (n,), of q = `size` unknowns each."""
    return np.asarray((views[:, None] * size + np.arange(size)).ravel())


def counting_sort(key: IntArray, size: int) -> tuple[IntArray, IntArray]:
    """Return the stable order (n,) of keys 0 .. size - 1, and the bounds (size + 1,) of the range of each key.

    A radix sort: numpy sorts numbers of 16 bits by counting.
    """
    order = np.argsort(key.astype(np.uint16), kind="stable")
    for shift in range(16, size.bit_length(), 16):
        order = order[np.argsort((key[order] >> shift).astype(np.uint16), kind="stable")]
    return order, np.append(0, np.cumsum(np.bincount(key, minlength=size)))


def _observation_pairs(by_point: IntArray, starts: IntArray) -> tuple[IntArray, IntArray]:
    """Return all pairs of observations of each point; the first has the lower view."""
    length = np.diff(starts)
    first, second = [], []
    for n in np.unique(length[length > 1]):
        rows = by_point[starts[:-1][length == n, None] + np.arange(n)]
        i, j = np.triu_indices(n, 1)
        first.append(rows[:, i].ravel())
        second.append(rows[:, j].ravel())
    empty = [np.zeros(0, dtype=np.int64)]
    return np.concatenate(first or empty), np.concatenate(second or empty)
