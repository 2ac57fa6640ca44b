"""In which order the views of a block are eliminated: nested dissection (George 1973), so that little fills in.

Views are tied to those beside them on the ground: a block is nearly a planar graph. It is cut in two by the fewest
views that touch all ties across a line, each side is cut again, and what cuts is eliminated after what it parts. The
factor of a square of n views then has n log n numbers and costs n^1.5 products, that of a strip n of both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import maximum_bipartite_matching

from barpc.geodesy import Array
from barpc.scene import BoolArray, IntArray

LEAF = 32  # views that are not cut any further
_CUTS = (0.44, 0.5, 0.56)  # part of the views before the line
_NARROW = 0.7  # of the longer side: a shorter one is not cut across


@dataclass(frozen=True, eq=False)
class Front:
    """Views eliminated together, and whom that ties to each other."""

    pivots: IntArray  # views, in the order of elimination
    border: IntArray  # later ones that are tied to them by then, in that order
    parent: int  # the front that has the first of these among its pivots; -1: none


@dataclass(frozen=True, eq=False)
class Dissection:
    """The order of elimination, front by front: children before their parents."""

    fronts: tuple[Front, ...]
    rank: IntArray  # (N,) which comes when; -1 for one that is not eliminated
    owner: IntArray  # (N,) the front whose pivot it is, or -1


def dissect(pairs: IntArray, place: Array, use: BoolArray) -> Dissection:
    """The order for views tied in `pairs` (M, 2) that stand at `place` (N, 2), those in `use` (N,) only."""
    n = len(place)
    i, j = pairs[use[pairs].all(axis=1)].astype(np.int32).T
    ones = np.ones(2 * len(i), dtype=np.int8)
    graph = sp.csr_array((ones, (np.concatenate([i, j]), np.concatenate([j, i]))), shape=(n, n))
    pieces: list[IntArray] = []
    _cut(graph, np.nan_to_num(place), np.flatnonzero(use), pieces)
    rank, owner, at = np.full(n, -1), np.full(n, -1), 0
    for number, piece in enumerate(pieces):
        rank[piece], owner[piece] = at + np.arange(len(piece)), number
        at += len(piece)
    return Dissection(tuple(_fronts(graph, pieces, rank, owner)), rank, owner)


def _fronts(graph: sp.csr_array, pieces: list[IntArray], rank: IntArray, owner: IntArray) -> list[Front]:
    """The fronts of pieces in their order: a border is what the pivots touch, or the fronts below them."""
    fronts: list[Front] = []
    below: list[list[IntArray]] = [[] for _ in pieces]
    for number, piece in enumerate(pieces):
        touched = np.concatenate([graph.indices[slice(*graph.indptr[v : v + 2])] for v in piece])
        near = np.unique(np.concatenate([touched.astype(np.int64), *below[number]]))
        border = near[rank[near] > rank[piece[-1]]]
        border = border[np.argsort(rank[border])]
        parent = int(owner[border[0]]) if len(border) else -1
        if len(border):
            below[parent].append(border)
        fronts.append(Front(piece, border, parent))
    return fronts


def _cut(graph: sp.csr_array, place: Array, views: IntArray, pieces: list[IntArray]) -> None:
    """Append the views (n,) piece by piece: one side, the other, what parts them."""
    parted = _part(graph, place, views) if len(views) > LEAF else None
    if parted is None:
        if len(views):
            pieces.append(views)
        return
    *sides, between = parted
    for side in sides:
        _cut(graph, place, side, pieces)
    if len(between):
        pieces.append(between)


def _part(graph: sp.csr_array, place: Array, views: IntArray) -> tuple[IntArray, IntArray, IntArray] | None:
    """Two sides of the views and the fewest between them, of some straight cuts; None where a side has none left."""
    at = place[views]
    extent = at.max(axis=0) - at.min(axis=0)
    best: tuple[IntArray, IntArray, IntArray] | None = None
    for axis in np.flatnonzero(extent >= _NARROW * extent.max()):
        order = views[np.argsort(at[:, axis], kind="stable")]
        for share in _CUTS:
            middle = int(share * len(views))
            near, far = np.sort(order[:middle]), np.sort(order[middle:])
            between = _touching(graph, near, far)
            if best is None or len(between) < len(best[2]):
                along = np.argsort(place[between, 1 - axis], kind="stable")  # neighbours stay neighbours
                best = near, far, between[along]
    assert best is not None
    near, far = (side[~np.isin(side, best[2])] for side in best[:2])
    return (near, far, best[2]) if len(near) and len(far) else None


def _touching(graph: sp.csr_array, near: IntArray, far: IntArray) -> IntArray:
    """The fewest views that touch all ties between two sides (König's theorem)."""
    across = graph[near][:, far]
    rows = np.flatnonzero(np.diff(across.indptr))
    cols = np.unique(across.indices)
    if not len(rows):
        return np.zeros(0, dtype=np.int64)
    across = sp.csr_array(across[rows][:, cols])
    of_row = maximum_bipartite_matching(across, perm_type="column")
    of_col = np.full(len(cols), -1)
    of_col[of_row[of_row >= 0]] = np.flatnonzero(of_row >= 0)
    reached, by_tie = of_row < 0, np.zeros(len(cols), dtype=bool)
    new = np.flatnonzero(reached)
    while len(new):  # along ties to the far side, along the matching back
        touched = np.unique(across[new].indices)
        touched = touched[~by_tie[touched]]
        by_tie[touched] = True
        back = of_col[touched]
        new = back[~reached[back]]
        reached[new] = True
    return np.concatenate([near[rows[~reached]], far[cols[by_tie]]])
