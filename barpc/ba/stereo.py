"""How well a pair of adjusted views knows heights: what a stereo user wants to be told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from barpc.geodesy import Array, enu_basis, ground_from_ecef
from barpc.scene import IntArray

if TYPE_CHECKING:
    from barpc.ba.result import Adjustment

_SAMPLE = 200


@dataclass(frozen=True)
class PairHeights:
    """Standard deviations of heights measured in two views, from the uncertainty of their corrections alone.

    Parameters
    ----------
    views : tuple of int
        The pair.
    absolute : float
        Of a height [m].
    relative : float
        Of a height against the mean height of the pair's tie points [m].
    count : int
        Tie points that it was evaluated at.
    """

    views: tuple[int, int]
    absolute: float
    relative: float
    count: int


def pair_heights(adjustment: Adjustment, first: int, second: int) -> PairHeights:
    """Height uncertainty of a pair at the tie points that both views see.

    Parameters
    ----------
    adjustment : Adjustment
        A result of `barpc.ba.adjust_tracks`.
    first, second : int
        Indices of the views.

    Returns
    -------
    PairHeights
        NaN where the views share no point.
    """
    structure = adjustment.covariance.reduced.structure
    seen = np.intersect1d(_points_of(adjustment, first), _points_of(adjustment, second))
    seen = seen[seen < len(adjustment.points)]
    seen = seen[np.isfinite(adjustment.points[seen, 0])]
    if not len(seen):
        return PairHeights((first, second), np.nan, np.nan, 0)
    points = adjustment.points[seen[:: len(seen) // _SAMPLE + 1]]
    n, pair = len(points), sorted((first, second))
    bounds = np.searchsorted(np.repeat(pair, n), np.arange(structure.num_views + 1))
    ecef = np.concatenate([points, points]).T
    projected = adjustment.cameras.project(adjustment.params, ecef, bounds)
    by_point = projected.by_point.reshape(2, 3, 2, n).transpose(3, 2, 0, 1)  # point, view, coordinate, axis
    by_unknown = projected.by_unknown.reshape(2, -1, 2, n).transpose(3, 2, 0, 1)
    up = enu_basis(ground_from_ecef(points))[:, 2]
    stacked = by_point.reshape(n, 4, 3)
    normal = np.swapaxes(stacked, 1, 2) @ stacked
    weights = np.linalg.solve(normal, up[..., None])[..., 0]
    pull = np.einsum("nvca,na->nvc", by_point, weights)
    by_camera = -np.einsum("nvc,nvcq->nvq", pull, by_unknown).reshape(n, -1)
    covariance = adjustment.covariance.joint(np.array(pair))
    relative = by_camera - by_camera.mean(axis=0)
    return PairHeights((first, second), _rms(by_camera, covariance), _rms(relative, covariance), n)


def _points_of(adjustment: Adjustment, view: int) -> IntArray:
    structure = adjustment.covariance.reduced.structure
    points: IntArray = structure.point[structure.bounds[view] : structure.bounds[view + 1]]
    return points


def _rms(rows: Array, covariance: Array) -> float:
    return float(np.sqrt(np.einsum("ni,ij,nj->n", rows, covariance, rows).mean()))
