"""Triangulation: tracks of image points to ground points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from barpc.geodesy import Array, ecef_from_ground, metres_per_unit
from barpc.sensor import SensorModel


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Ground points intersected from tracks.

    Parameters
    ----------
    points : (P, 3)
        ECEF [m]; NaN where the rays do not meet (fewer than two, parallel, or outside a model's domain).
    residuals : (K, 2)
        Projected - observed [px]; NaN for the rows of such points.
    ok : (P,)
        Whether the point is usable.
    """

    points: Array
    residuals: Array
    ok: npt.NDArray[np.bool_]


def triangulate(
    sensors: Sequence[SensorModel],
    view: npt.ArrayLike,
    point: npt.ArrayLike,
    xy: Array,
    sigma: Array | None = None,
    *,
    alt: float | npt.ArrayLike = 0.0,
    steps: int = 10,
) -> Triangulation:
    """Intersect the rays of tracks: batched Gauss-Newton on the reprojection error.

    The unknowns of a step are metres east, north and up at the point, so that it is the step in ECEF
    without the conversions.

    Parameters
    ----------
    sensors : sequence of SensorModel
        One a view.
    view, point : (K,)
        View and track of each observation.
    xy : (K, 2)
        col, row [px].
    sigma : (K,), optional
        Standard deviations [px]; equal if not given.
    alt : float or (P,)
        Altitude [m] that the first guess is localised at.
    steps : int
        At most so many steps.

    Returns
    -------
    Triangulation
        Points (P, 3) in ECEF [m], residuals (K, 2) [px], and which points are usable.
    """
    view, point = np.asarray(view, dtype=np.int64), np.asarray(point, dtype=np.int64)
    xy = np.asarray(xy, dtype=np.float64)
    num = int(point.max()) + 1 if len(point) else 0
    if not num:
        return Triangulation(np.empty((0, 3)), np.empty((0, 2)), np.empty(0, dtype=bool))
    order = np.argsort(view, kind="stable")  # so that the rows of a view are a slice
    at, goal = point[order], xy[order]
    first = np.flatnonzero(np.diff(view[order], prepend=-1))
    rows = [
        (sensors[view[order[i]]], slice(i, j)) for i, j in zip(first, [*first[1:], len(view)], strict=True)
    ]
    weight = np.ones(len(xy)) if sigma is None else 1.0 / np.asarray(sigma, dtype=np.float64)[order]
    ground = _first_guess(rows, at, goal, np.broadcast_to(np.asarray(alt, dtype=np.float64), num))
    jacobian, residual = np.empty((3, 2, len(xy))), np.empty((2, len(xy)))
    ok = np.ones(num, dtype=bool)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        for _ in range(steps):
            scale = metres_per_unit(ground)
            for sensor, part in rows:
                image, by_ground = sensor.project_jacobian(ground[at[part]])
                np.multiply((image - goal[part]).T, weight[part], out=residual[:, part])
                np.multiply(by_ground.T, weight[part], out=jacobian[:, :, part])
            step, ok = _normal_step(jacobian, residual, at, scale.T)
            ground -= np.where(ok, step, 0.0).T / scale
            if not np.abs(step[:, ok]).max(initial=0.0) > 1e-3:  # metres; quadratic: the next is below 1e-9
                break
        left = np.empty((len(xy), 2))
        for sensor, part in rows:
            left[order[part]] = sensor.project(ground[at[part]]) - goal[part]
    bad = np.ones(num, dtype=bool)
    bad[point] = False
    bad[point[~np.isfinite(left).all(axis=1)]] = True
    ok &= ~bad
    ground[~ok] = np.nan
    left[~ok[point]] = np.nan
    return Triangulation(ecef_from_ground(ground), left, ok)


def _first_guess(
    rows: list[tuple[SensorModel, slice]],
    point: npt.NDArray[np.int64],
    xy: Array,
    alt: Array,
) -> Array:
    """Each track localised at `alt` in one of its views."""
    ground = np.full((len(alt), 3), np.nan)
    for sensor, part in rows:
        new = np.flatnonzero(np.isnan(ground[point[part], 0])) + part.start
        if len(new):
            ground[point[new]] = sensor.localize(xy[new], alt[point[new]])
    return ground


def _normal_step(
    jacobian: Array, residual: Array, point: npt.NDArray[np.int64], scale: Array
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Gauss-Newton steps (3, num) [m], and for which points the rays determine one.

    `jacobian` (3, 2, K) by (lon, lat, alt) and `residual` (2, K) are weighted; `scale` (3, num) holds the
    metres of a unit of each. The 3 x 3 systems are solved by their cofactors, one vector an entry.
    """
    num = scale.shape[1]

    def total(u: Array, v: Array) -> Array:
        weights: Array = u[0] * v[0] + u[1] * v[1]
        return np.asarray(np.bincount(point, weights, minlength=num), dtype=np.float64)

    a, b, c = jacobian
    (e, n, u) = scale
    aa, bb, cc = total(a, a) / (e * e), total(b, b) / (n * n), total(c, c) / (u * u)
    ab, ac, bc = total(a, b) / (e * n), total(a, c) / (e * u), total(b, c) / (n * u)
    ra, rb, rc = total(a, residual) / e, total(b, residual) / n, total(c, residual) / u
    paa, pab, pac = bb * cc - bc * bc, ac * bc - ab * cc, ab * bc - ac * bb
    pbb, pbc, pcc = aa * cc - ac * ac, ab * ac - aa * bc, aa * bb - ab * ab
    det = aa * paa + ab * pab + ac * pac
    # parallel rays: the determinant against the trace; 1e-10 is 0.0006 degrees
    ok = np.isfinite(det) & (det > 1e-10 * (aa + bb + cc) ** 3 / 27)
    step = np.stack(
        [paa * ra + pab * rb + pac * rc, pab * ra + pbb * rb + pbc * rc, pac * ra + pbc * rb + pcc * rc]
    )
    return step / det, ok
