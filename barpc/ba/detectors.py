"""Where one detector of a focal plane ends and the next begins: change points of the residuals over the columns.

A step in one view is seen in the residuals of all that share its points, smaller. So the largest changes of all
views are taken first, what they explain is taken out of all residuals, the points following, and so on.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from barpc.ba.problem import Problem
from barpc.ba.solve import State
from barpc.geodesy import Array
from barpc.scene import BoolArray

_LARGE = 40.0  # twice the logarithm of a likelihood ratio: the largest of 10,000 places by chance once in 100,000 views
_AS_LARGE = (
    0.5  # of the largest change: not what another view's step leaves here, a quarter of it with three views
)
_ROUNDS = 12
_BACKFITTING = 6
_SAME = 0.02  # of an image's width
_FEWEST = 30  # observations of a detector

Edges = list[list[float]]  # of every view, ascending


class _Columns:
    """The observations in use of every view in the order of their columns."""

    def __init__(self, problem: Problem, use: BoolArray, sigma: Array) -> None:
        bounds, col = problem.structure.bounds, problem.xy[0]
        inside = [a + np.flatnonzero(use[a:b]) for a, b in pairwise(bounds)]
        self.order = [rows[np.argsort(col[rows], kind="stable")] for rows in inside]
        self.col = [col[rows] for rows in self.order]
        self.weight = [1.0 / sigma[rows] ** 2 for rows in self.order]

    def detectors(self, v: int, edges: list[float]) -> list[slice]:
        """The places in the order of a view of its detectors."""
        ends = [0, *np.searchsorted(self.col[v], edges).tolist(), len(self.col[v])]
        return [slice(a, b) for a, b in pairwise(ends)]

    def means(self, residual: Array, edges: Edges) -> Array:
        """Every detector's mean (2, K) of residuals (2, K) at its observations in use; zero elsewhere."""
        out = np.zeros_like(residual)
        for v, order in enumerate(self.order):
            for part in self.detectors(v, edges[v]) if edges[v] else ():
                rows, weight = order[part], self.weight[v][part]
                out[:, rows] = (residual[:, rows] @ weight / max(weight.sum(), 1e-30))[:, None]
        return out

    def split(self, v: int, part: slice, residual: Array) -> tuple[float, float]:
        """The largest change in a stretch of the columns of view v: how much it explains, and where it is."""
        weight = self.weight[v][part]
        if len(weight) < 2 * _FEWEST:
            return 0.0, 0.0
        total = np.cumsum(weight)
        sums = np.cumsum(residual[:, self.order[v][part]] * weight, axis=1)
        left, right = total[:-1], total[-1] - total[:-1]
        apart = sums[:, :-1] / left - (sums[:, -1:] - sums[:, :-1]) / np.maximum(right, 1e-30)
        gain = (apart**2).sum(axis=0) * left * right / total[-1]
        gain[: _FEWEST - 1] = gain[len(gain) - _FEWEST + 1 :] = 0.0
        at = int(gain.argmax())
        col = self.col[v][part]
        return float(gain[at]), float(0.5 * (col[at] + col[at + 1]))


def find_edges(problem: Problem, state: State, residual: Array, use: BoolArray, sigma: Array) -> Array:
    """Columns (N, C) [px] where other detectors begin, infinite where a view has fewer, of residuals (2, K) [px] with
    standard deviations `sigma` (K,) as they were observed.
    """
    columns, weight = _Columns(problem, use, sigma), use / sigma
    projected = problem.project_points(state.params, state.points)
    edges: Edges = [[] for _ in columns.order]
    part = np.zeros_like(residual)
    for _ in range(_ROUNDS):
        left = problem.settled_residual(residual - part, projected, weight)
        found = [
            (v, *columns.split(v, piece, left))
            for v in range(len(edges))
            for piece in columns.detectors(v, edges[v])
        ]
        largest = max(gain for _, gain, _ in found)
        if largest < _LARGE:
            break
        for v, gain, col in found:
            if gain >= max(_LARGE, _AS_LARGE * largest):
                edges[v] = sorted([*edges[v], col])
        for _ in range(_BACKFITTING):
            part += columns.means(problem.settled_residual(residual - part, projected, weight), edges)
    left = part + problem.settled_residual(residual - part, projected, weight)
    placed = [_placed(columns, v, of_view, left) for v, of_view in enumerate(edges)]
    widths = problem.cameras.unknowns.half[0] * 2.0
    edges = _of_one_plane(placed, widths) or [[col for col, _ in of_view] for of_view in placed]
    out = np.full((len(edges), max(map(len, edges))), np.inf)
    for v, of_view in enumerate(edges):
        out[v, : len(of_view)] = of_view
    return out


def _placed(columns: _Columns, v: int, edges: list[float], residual: Array) -> list[tuple[float, float]]:
    """The edges of a view, each where it is best between its neighbours, and what it explains, if that is enough."""
    found: list[tuple[float, float]] = []
    for at in range(len(edges)):
        stretch = columns.detectors(v, [*(col for col, _ in found), *edges[at + 1 :]])[len(found)]
        gain, col = columns.split(v, stretch, residual)
        found += [(col, gain)] if gain >= _LARGE else []
    return found


def _of_one_plane(placed: list[list[tuple[float, float]]], widths: Array) -> Edges | None:
    """The edges of all views together, where images are equally wide and two show an edge at the same column."""
    near, every = (
        _SAME * widths[0],
        sorted((col, gain, v) for v, one in enumerate(placed) for col, gain in one),
    )
    groups: list[list[tuple[float, float, int]]] = []
    for edge in every:
        if groups and edge[0] - groups[-1][0][0] < near:
            groups[-1].append(edge)
        else:
            groups.append([edge])
    if (widths != widths[0]).any() or not any(len({v for _, _, v in group}) > 1 for group in groups):
        return None
    return [[max(group, key=lambda edge: edge[1])[0] for group in groups]] * len(placed)
