"""Registered points resemble each other: their templates overlap, and seasons, suns and terrains err over many of them.

What is smooth in a reference's residuals is therefore not all of the camera: of points whose templates share half of
their pixels half of the noise is the same, and together they are worth `ALIKE` independent ones at most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barpc.ba.held.block import Block
from barpc.ba.held.ground import ALIKE
from barpc.ba.usual import MANY
from barpc.base.geodesy import Array, metres_per_unit
from barpc.scene import BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class Resemblance:
    """Correlation of the noise of a block's K observations."""

    of_reference: BoolArray  # (K,)
    place: Array  # (2, K) where a reference's points lie, east, north [m]
    width: float  # of their templates [m]
    share: Array  # (K,) how much of an independent observation each is where it counts with its neighbours
    precision: Array  # (K,) their weight beside the view's tie points: variances' ratio, times `share`

    @classmethod
    def of(cls, block: Block, terms: int) -> Resemblance | None:
        """Return the noise correlation of observations, beside `terms` of smooth errors; None without reference."""
        given = block.reference
        if given is None:
            return None
        rows = block.point >= block.num_known
        lonlatalt = given.points.lonlatalt
        east_north = (lonlatalt * metres_per_unit(lonlatalt.mean(axis=0)))[:, :2].T
        place = np.zeros((2, len(rows)))
        place[:, rows] = east_north[:, block.point[rows] - block.num_known]
        share, precision = np.ones(len(rows)), np.ones(len(rows))
        found = cls(rows, place, given.width, share, precision)
        for view in np.unique(block.view[rows]):
            own = np.flatnonzero(rows & (block.view == view))
            ties = ~rows & (block.view == view)
            asked = own[:: -(-len(own) // MANY)]  # they lie on a grid
            alike = found.overlap(asked[:, None], own[None]).sum(axis=1).mean()
            share[own] = 1.0 / (alike + len(own) / (terms * ALIKE))
            usual = np.median(block.sigma[ties] if ties.any() else block.sigma[own])
            precision[own] = share[own] * (usual / block.sigma[own]) ** 2
        return found

    def overlap(self, first: IntArray, second: IntArray) -> Array:
        """Return the share (...) by which the templates of two reference observations overlap."""
        apart = np.abs(self.place[:, first] - self.place[:, second])
        if self.width == 0:
            return np.asarray((apart == 0).all(axis=0), np.float64)
        return np.asarray(np.maximum(1.0 - apart / self.width, 0.0).prod(axis=0))

    def correlation(self, first: IntArray, second: IntArray) -> Array:
        """Return the correlation (...), 0 to 1, of the noise of two observations of one view."""
        both = self.of_reference[first] & self.of_reference[second]
        same = self.overlap(first, second)
        return np.asarray(both * (same + (1.0 - same) / ALIKE))
