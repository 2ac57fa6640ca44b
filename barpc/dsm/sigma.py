"""What the cameras' joint covariance says of heights: of each pair's, and of what all cells share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from barpc.ba import BlockPrior
from barpc.ba.estimated.projected import Cameras
from barpc.ba.estimated.unknowns import make_unknowns
from barpc.ba.result import height_by_unknowns
from barpc.base.errors import InputError
from barpc.base.geodesy import Array, ecef_from_ground
from barpc.scene import View


@dataclass(frozen=True, eq=False)
class CameraErrors:
    """Views of an adjusted block behind their corrections, and the covariance (V q, V q) of their unknowns."""

    cameras: Cameras
    covariance: Array

    @classmethod
    def of(cls, prior: BlockPrior, views: Sequence[View]) -> CameraErrors:
        """Return the errors that an adjustment left in the cameras of these views; those that it held fixed have none.

        The derivatives are those at the corrected cameras: corrections are so small that they change none of them.
        """
        names, q = tuple(view.name for view in views), prior.params.shape[1]
        place = {name: n for n, name in enumerate(prior.names)}
        free = np.array([i for i, name in enumerate(names) if name in place], dtype=np.int64)
        if not len(free):
            raise InputError("the block's covariance names none of the run's images: run the adjustment again")
        at, centers = np.array([place[names[i]] for i in free]), np.zeros((len(views), 3))
        centers[free] = prior.center[at]
        all_free = len(free) == len(views)
        unknowns = make_unknowns(views, prior.model, prior.drift, centers if all_free else None, prior.waves(names))
        if unknowns.size != q:
            raise InputError(f"the block's covariance is of {q} unknowns an image, its cameras have {unknowns.size}")
        theirs, own = ((index[:, None] * q + np.arange(q)).ravel() for index in (at, free))
        try:
            found = la.cho_solve(la.cho_factor(prior.dense()), np.eye(prior.params.size)[:, theirs])[theirs]
        except la.LinAlgError as error:
            raise InputError(f"the block's information is damaged ({error})") from error
        covariance = np.zeros((len(views) * q, len(views) * q))
        covariance[np.ix_(own, own)] = 0.5 * (found + found.T)
        return cls(Cameras(views, unknowns), covariance)

    def rows(self, pair: tuple[int, int], ground: Array) -> Array:
        """Return the derivative (n, V q) of heights that a pair measures at ground points (n, 3) by all unknowns."""
        q = self.cameras.unknowns.size
        params = np.zeros((len(self.cameras.sensors), q))
        by_pair = height_by_unknowns(self.cameras, params, pair, ecef_from_ground(ground))
        out = np.zeros((len(ground), len(self.covariance)))
        for n, view in enumerate(pair):
            out[:, view * q : (view + 1) * q] = by_pair[:, n]
        return out

    def sigma(self, rows: Array) -> Array:
        """Return the standard deviation (n,) [m] of heights, or differences of them, of these derivatives (n, V q)."""
        square: Array = np.einsum("ni,ij,nj->n", rows, self.covariance, rows)
        return np.asarray(np.sqrt(np.maximum(square, 0.0)))
