"""Check points: known points that stay out of the solve, and what the adjusted cameras make of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from barpc.errors import InputError
from barpc.geodesy import Array, ecef_from_ground, enu_basis
from barpc.scene import BoolArray, GroundPoints
from barpc.sensor import SensorModel
from barpc.sensor.geometry import triangulate


@dataclass(frozen=True, eq=False)
class CheckResiduals:
    """Known points against cameras.

    Parameters
    ----------
    image : (M, 2)
        Projected - observed [px] of every observation.
    ground : (G, 3)
        Triangulated - known, east, north, up [m]; NaN for a point that fewer than two views see.
    """

    image: Array
    ground: Array

    def rms(self) -> tuple[Array, Array]:
        """Root mean squares: col, row (2,) [px]; east, north, up (3,) [m], NaN without a triangulated point."""
        known = np.isfinite(self.ground).all(axis=1)
        ground = np.full(3, np.nan)
        if known.any():
            ground = np.sqrt((self.ground[known] ** 2).mean(axis=0))
        return np.sqrt((self.image**2).mean(axis=0)), ground


def check_residuals(sensors: Sequence[SensorModel], points: GroundPoints) -> CheckResiduals:
    """What cameras make of known points.

    Parameters
    ----------
    sensors : sequence of SensorModel
        One a view: `Adjustment.sensors`, or the delivered ones.
    points : GroundPoints
        Check points.

    Returns
    -------
    CheckResiduals
    """
    image = np.empty((len(points.view), 2))
    for v in np.unique(points.view):
        rows = points.view == v
        image[rows] = sensors[v].project(points.lonlatalt[points.point[rows]]) - points.xy[rows]
    ground = np.full((len(points.names), 3), np.nan)
    seen = np.bincount(points.point, minlength=len(points.names)) >= 2
    rows = np.flatnonzero(seen[points.point])
    if len(rows):
        order = rows[np.lexsort((points.view[rows], points.point[rows]))]
        index, place = np.unique(points.point[order], return_inverse=True)
        found = triangulate(list(sensors), points.view[order], place.ravel(), points.xy[order])
        offset = found.points - ecef_from_ground(points.lonlatalt[index])
        ground[index] = (enu_basis(points.lonlatalt[index]) @ offset[..., None])[..., 0]
    return CheckResiduals(image, ground)


def split_points(points: GroundPoints, checks: Sequence[str]) -> tuple[GroundPoints, GroundPoints]:
    """Points as control for the solve and as checks that stay out of it.

    Parameters
    ----------
    points : GroundPoints
        All of them.
    checks : sequence of str
        Names of the check points.

    Returns
    -------
    control, check : GroundPoints

    Raises
    ------
    InputError
        A name is not among the points.
    """
    unknown = sorted(set(checks) - set(points.names))
    if unknown:
        raise InputError(f"no ground point is named {', '.join(unknown[:10])}")
    is_check = np.isin(np.array(points.names, dtype=object), list(checks))
    return _select(points, ~is_check), _select(points, is_check)


def _select(points: GroundPoints, keep: BoolArray) -> GroundPoints:
    rows = keep[points.point]
    closed = np.cumsum(keep) - 1
    return GroundPoints(
        tuple(name for name, kept in zip(points.names, keep, strict=True) if kept),
        points.lonlatalt[keep],
        points.sigma[keep],
        closed[points.point[rows]],
        points.view[rows],
        points.xy[rows],
        points.xy_sigma[rows],
    )
