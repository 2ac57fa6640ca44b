"""Steps between the detectors of a focal plane: change points of the residuals over the columns of images.

The largest change of all views is found first. A step in one view appears, smaller, in the residuals of all views that
share its points. Therefore the effect of the steps found is removed from all residuals, with the points re-estimated,
before the next is searched. Equally wide images may be from one focal plane, with steps at the same columns: the search
is repeated with the gains of all images summed, and the set that explains more is returned.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State
from barpc.base.geodesy import Array
from barpc.base.statistics import BACKFITTING, FEW, ITERATIONS
from barpc.scene import BoolArray, IntArray

_MIN_LOG_RATIO = 40.0  # least doubled log-likelihood ratio: among 10,000 columns reached by noise once in 100,000 views
_A_VIEW = 4.0  # added to it for every further view of a focal plane
_AS_LARGE = 0.5  # of the largest gain, at least: a step of another view has a quarter of it with three views

Edges = list[list[float]]  # columns of the steps of each group of views, ascending


class Columns:
    """Observations in use, sorted by column, of groups of views that share their detectors.

    Parameters
    ----------
    bounds : (N + 1,)
        First observation of each view, and the end.
    col, use, sigma : (K,)
        Columns of all observations [px], the mask of those in use, and their standard deviations [px].
    groups : list of list of int
        Views of each group.
    """

    def __init__(
        self, bounds: Sequence[int] | IntArray, col: Array, use: BoolArray, sigma: Array, groups: list[list[int]]
    ) -> None:
        inside = [a + np.flatnonzero(use[a:b]) for a, b in pairwise(bounds)]
        self.order = [rows[np.argsort(col[rows], kind="stable")] for rows in inside]
        self.col = [col[rows] for rows in self.order]
        self.weight = [1.0 / sigma[rows] ** 2 for rows in self.order]
        self.groups = groups
        every = [np.unique(np.concatenate([self.col[v] for v in group])) for group in groups]
        self.places = [0.5 * (one[1:] + one[:-1]) for one in every]

    def means(self, residual: Array, edges: Edges) -> Array:
        """Return for each observation in use the mean residual (2, K) of its detector; zero for others."""
        out = np.zeros_like(residual)
        for group, of_group in zip(self.groups, edges, strict=True):
            for v in group if of_group else ():
                for a, b in pairwise([0, *np.searchsorted(self.col[v], of_group), len(self.col[v])]):
                    rows, weight = self.order[v][a:b], self.weight[v][a:b]
                    out[:, rows] = (residual[:, rows] @ weight / max(weight.sum(), 1e-30))[:, None]
        return out

    def split(self, g: int, low: float, high: float, residual: Array) -> tuple[float, float]:
        """Return the largest change between two columns of a group: its gain less the price of views, and column."""
        places = self.places[g][np.searchsorted(self.places[g], low) : np.searchsorted(self.places[g], high)]
        if not len(places):
            return 0.0, low
        gain = sum(self._gains(v, low, high, residual, places) for v in self.groups[g])
        at = int(np.argmax(gain))
        return float(np.max(gain)) - _A_VIEW * (len(self.groups[g]) - 1), float(places[at])

    def _gains(self, v: int, low: float, high: float, residual: Array, places: Array) -> Array:
        a, b = np.searchsorted(self.col[v], [low, high])
        at, weight = np.searchsorted(self.col[v], places) - a, self.weight[v][a:b]
        total = np.append(0.0, np.cumsum(weight))
        sums = np.cumsum(residual[:, self.order[v][a:b]] * weight, axis=1)
        sums = np.hstack([np.zeros((2, 1)), sums])
        left, right = np.maximum(total[at], 1e-30), np.maximum(total[-1] - total[at], 1e-30)
        change = sums[:, at] / left - (sums[:, -1:] - sums[:, at]) / right
        gain = (change**2).sum(axis=0) * left * right / max(total[-1], 1e-30)
        return np.where((at >= FEW) & (b - a - at >= FEW), gain, 0.0)


def find_edges(problem: Problem, state: State, residual: Array, use: BoolArray, sigma: Array) -> Array:
    """Find the columns (N, C) [px] of steps of the residuals (2, K) [px]; infinite where a view has fewer."""
    weight, widths = use / sigma, problem.cameras.unknowns.half[0]
    project = problem.projected_off_points(problem.project_points(state.params, state.points), weight)
    residual, views = project(_without_steps(problem, state, residual)), list(range(len(widths)))
    given = problem.structure.bounds, problem.xy[0], use, sigma
    edges, cost = _grown(Columns(*given, [[v] for v in views]), residual, project, weight)
    if any(edges) and len(views) > 1 and (widths == widths[0]).all():
        common, in_common = _grown(Columns(*given, [views]), residual, project, weight)
        edges = common * len(views) if in_common < cost else edges
    out = np.full((len(edges), max(map(len, edges))), np.inf)
    for v, of_view in enumerate(edges):
        out[v, : len(of_view)] = of_view
    return out


def _without_steps(problem: Problem, state: State, residual: Array) -> Array:
    """Return the residuals (2, K) [px] of the cameras without steps found earlier."""
    unknowns, steps = problem.cameras.unknowns, np.zeros_like(residual)
    if unknowns.waves is not None and unknowns.waves.edges.size:
        params = state.params.copy()
        for others in unknowns.waves.kinds[::2]:
            params[:, unknowns.in_waves][:, others] = 0.0
        unknowns.add_waves(steps, steps[:, None, :][:, :0], params, problem.structure.view, problem.xy)
    return residual - steps


def _grown(columns: Columns, residual: Array, project: Callable[[Array], Array], weight: Array) -> tuple[Edges, float]:
    """Return the edges of each group, found one after the other and refined; and the cost of residuals and edges."""
    edges: Edges = [[] for _ in columns.groups]
    explained = np.zeros_like(residual)
    for _ in range(ITERATIONS):
        left = project(residual - explained)
        found = [
            (g, *columns.split(g, *stretch, left))
            for g, of_group in enumerate(edges)
            for stretch in pairwise([-np.inf, *of_group, np.inf])
        ]
        largest = max(gain for _, gain, _ in found)
        if largest < _MIN_LOG_RATIO:
            break
        for g, gain, col in found:
            if gain >= max(_MIN_LOG_RATIO, _AS_LARGE * largest):
                edges[g] = sorted([*edges[g], col])
        for _ in range(BACKFITTING):
            explained += columns.means(project(residual - explained), edges)
    left = project(residual - explained)
    cost = float(((left * weight) ** 2).sum())
    cost += sum(
        len(one) * (_MIN_LOG_RATIO + _A_VIEW * (len(group) - 1))
        for one, group in zip(edges, columns.groups, strict=True)
    )
    return [_edge_positions(columns, g, of_group, explained + left) for g, of_group in enumerate(edges)], cost


def _edge_positions(columns: Columns, g: int, edges: list[float], residual: Array) -> list[float]:
    """Return the significant edges of a group, each at its best column between its neighbours."""
    found: list[float] = []
    for at in range(len(edges)):
        low = found[-1] if found else -np.inf
        gain, col = columns.split(g, low, edges[at + 1] if at + 1 < len(edges) else np.inf, residual)
        found += [col] if gain >= _MIN_LOG_RATIO else []
    return found
