"""Residuals of simulated blocks, linear in their unknowns, of which observations are displaced as is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from barpc.ba import AdjustOptions
from barpc.ba.constraints.block import Block, first_state, join, make_problem
from barpc.ba.constraints.ground import PointConstraints
from barpc.ba.evidence.linearised import Linear, linearise
from barpc.ba.evidence.mixture import fit_mixture
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State
from barpc.ba.terms.moving_ground import GroundMotion
from barpc.ba.terms.term import Residuals
from barpc.base.geodesy import Array
from barpc.scene import IntArray
from barpc.simulate import SimulatedBlock, simulate_block

Displacement = Callable[[IntArray, Array], Array]
"""Views (K,) and places (2, K), as parts of their images -> displacements (2, K) [px]."""
DIRECTION = np.array([[0.8], [0.6]])


class Started(NamedTuple):
    """A block at its delivered cameras."""

    block: Block
    problem: Problem
    state: State
    heights: PointConstraints

    def linear(self, span: float = 800.0) -> Linear:
        """Linearised there, of heights within a span [m]."""
        return linearise(self.problem, self.state, self.block.use, self.block.sigma, span)


def started(made: SimulatedBlock | Block, centers: Array | None = None, **given: Any) -> Started:
    """A simulated block, or one that is joined already, at its delivered cameras, with such options."""
    options = AdjustOptions(**given)
    block = made if isinstance(made, Block) else join(made.views, made.tracks, None, options)
    problem = make_problem(block, options, centers, None)
    return Started(block, problem, *first_state(problem, block, options, None))


def step(px: float, view: int, start: float, stop: float, axis: int = 1) -> Displacement:
    """Rows (axis 1) or columns of a view are displaced."""
    return lambda of, at: DIRECTION * px * ((of == view) & (at[axis] >= start) & (at[axis] < stop))


def decay(px: float, view: int, origin: float, length: float) -> Displacement:
    """Rows of a view are displaced from an origin on, less and less: downwards, or of a negative length upwards."""

    def moved(of: IntArray, at: Array) -> Array:
        along = (at[1] - origin) / length
        return DIRECTION * px * np.where((of == view) & (along >= 0.0), np.exp(-np.maximum(along, 0.0)), 0.0)

    return moved


def sinusoid(px: float, view: int, waves: float) -> Displacement:
    """Rows of a view have a sinusoid of so many waves an image."""
    return lambda of, at: DIRECTION * px * np.sin(2.0 * np.pi * waves * at[1] + 1.0) * (of == view)


def transient(px: float, length: float) -> Displacement:
    """The first rows of all views are displaced, the last ones of a negative length, each view in a direction."""

    def moved(of: IntArray, at: Array) -> Array:
        along = at[1] / length if length > 0.0 else (at[1] - 1.0) / length
        return px * np.exp(-along) * np.array([np.cos(1.7 * of), np.sin(1.7 * of)])

    return moved


def cell_errors(px: float, view: int, seed: int = 5) -> Displacement:
    """Observations of a view share errors with their neighbours in 8 x 8 cells."""
    cells = np.random.default_rng(seed).normal(0.0, px, (2, 8, 8))
    return lambda of, at: cells[:, *np.clip(8.0 * at[::-1], 0, 7).astype(int)] * (of == view)


def residuals_of(
    *moved: Displacement, views: int = 3, tracks: int = 150, seed: int = 1, sample: int | None = None, **options: Any
) -> Residuals:
    """Residuals of a block at its delivered cameras, a first choice by a sample of tracks where one is given."""
    made = simulate_block(views, tracks, seed=seed, attitude=1e-6, position=0.2, **options)
    return residuals_at(join(made.views, made.tracks, None, AdjustOptions()), *moved, sample=sample)


def residuals_at(block: Block, *moved: Displacement, sample: int | None = None) -> Residuals:
    """Residuals of a given block."""
    start = started(block)
    linear = start.linear()
    size = np.array([view.size for view in block.views], dtype=np.float64).T
    away = sum((one(block.view, block.xy / size[:, block.view]) for one in moved), np.zeros((2, 1)))
    linear = replace(linear, residual=linear.residual - away / block.sigma)
    few, none = linear if sample is None else linear.thinned(sample), np.zeros((2, 0, len(block.view)))
    ground = GroundMotion.of(start.problem, start.state)
    return Residuals(linear, few, ground, block.xy, size, fit_mixture(linear), none, np.zeros(0))
