"""Tie points that are kept out before anything is rejected: what an adjustment is measured on.

Survivors of a rejection agree because the others were cut. A tenth of the tracks, evenly over pairs and images, takes
no part in it; triangulated by the adjusted cameras they tell what those are worth, wrong matches and all, so their
figures are medians.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barpc.ba.block import Block
from barpc.ba.loss import geman_mcclure
from barpc.ba.problem import Problem
from barpc.ba.rounds import MEDIAN, Observations
from barpc.ba.solve import State
from barpc.ba.structure import Structure, make_structure
from barpc.geodesy import Array
from barpc.scene import BoolArray

_EVERY = 10
_LEAST = 100  # observations of a view, or its tracks are all needed
_CELLS = 8  # a side of an image
_STEPS = 5
_WIDE = 4.0  # sigmas
_FEW = 20  # observations of a view that tell nothing by themselves


@dataclass(frozen=True, eq=False)
class HeldOut:
    """What the tracks that were kept out say.

    Parameters
    ----------
    rows : (H,)
        Their observations, sorted by view.
    residual : (2, H)
        Projected - observed [px], points triangulated by the adjusted cameras.
    points : (P, 3)
        All points, those triangulated anew, ECEF [m].
    noise : (N,)
        Observed over stated standard deviation of every view's; NaN with too few.
    rms : (N,)
        The same as a root mean square of residuals [px].
    """

    rows: BoolArray
    residual: Array
    points: Array
    noise: Array
    rms: Array


def keep_out(block: Block, structure: Structure) -> BoolArray:
    """Observations (K,) of about every tenth track, evenly over pairs of views and their images."""
    use = np.bincount(block.point[block.use], minlength=block.num_points)
    few = structure.sum_views(block.use[None].astype(np.float64))[:, 0] < _LEAST
    needed = np.bincount(block.point[few[block.view] | ~block.use], minlength=block.num_points)
    tracks = np.flatnonzero((use >= 2) & (needed == 0) & (np.arange(block.num_points) < block.num_tracks))
    first, last = (structure.by_point[structure.point_bounds[tracks + n] - n] for n in (0, 1))
    size = np.array([view.size for view in block.views], dtype=np.float64)
    cell = np.floor(block.xy[:, first] / size[block.view[first]].T * _CELLS)
    order = np.lexsort((tracks, *cell, block.view[last], block.view[first]))
    chosen = np.zeros(block.num_points, dtype=bool)
    chosen[tracks[order[_EVERY // 2 :: _EVERY]]] = True
    return chosen[block.point]


def measure(problem: Problem, state: State, sigma: Array, rows: BoolArray) -> HeldOut:
    """The observations `rows` (K,), of standard deviations `sigma` (K,) [px], under the cameras of a state."""
    structure = problem.structure
    index, point = np.unique(structure.point[rows], return_inverse=True)
    view, xy = structure.view[rows], problem.xy[:, rows]
    views = structure.num_views
    part = replace(
        problem,
        cameras=problem.cameras.seeing(xy[1]),
        structure=make_structure(view, point, views, len(index)),
        xy=xy,
        point_prior=None,
    )
    observations = Observations(part, sigma[rows], 0.0, np.ones(len(view), dtype=bool))
    points, counted = state.points[index], np.ones(len(view))
    for step in range(_STEPS):
        projected = part.project_points(state.params, points)
        if step > 1:  # of three views that do not agree two may
            counted = geman_mcclure(((projected.image - xy) ** 2).sum(axis=0) / (_WIDE * sigma[rows]) ** 2)[1]
        points = part.triangulate(points, projected, np.sqrt(counted) / sigma[rows])
    residual = part.residuals(state.params, points)
    squared = observations.squared(residual, counted)
    expected = observations.sigma**2 * observations.freedom(counted)
    noise, rms = np.full(views, np.nan), np.full(views, np.nan)
    for v in np.flatnonzero(np.bincount(view, minlength=views) >= _FEW):
        of_view = view == v
        noise[v] = np.sqrt(np.median(squared[of_view]) / MEDIAN)
        rms[v] = noise[v] * np.sqrt(expected[of_view].mean())
    moved = state.points.copy()
    moved[index] = points
    return HeldOut(rows, residual, moved, noise, rms)
