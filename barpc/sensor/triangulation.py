"""Ground points that rays of any sensor models meet in, and how far the rays of matches pass each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from barpc.base.geodesy import NEWTON_STEPS, Array, BoolArray, IntArray, ecef_from_ground, metres_per_unit
from barpc.sensor import SensorModel
from barpc.sensor.curve import cross
from barpc.sensor.rpc import RpcStack

_LAST_STEP = 1e-3  # m: intersections are quadratic, so that the next would be below 1e-9


def epipolar_offset(
    sensor_a: SensorModel,
    sensor_b: SensorModel,
    image_a: Array,
    image_b: Array,
    alt: float | npt.ArrayLike,
    steps: int = 4,
) -> tuple[Array, Array]:
    """Return the distances of matches from their epipolar lines: the part of a mismatch that no altitude explains.

    The altitude that brings the ray of a nearest to the point in b is found by Gauss-Newton along the
    ray; the signed distance that is left, across the epipolar line, is the offset.

    Parameters
    ----------
    image_a, image_b : (N, 2), col, row [px] of the matches
    alt : float or (N,), first guess of the altitude [m]
    steps : int, to the closest approach of the rays; the default: from the altitude of the scene

    Returns
    -------
    offset : (N,)
        Signed distance in image b [px], positive to the right of the direction of rising altitude (columns to the
        right, rows down: clockwise); NaN where the rays are parallel.
    alt : (N,), the altitudes [m]
    """
    alt = np.array(np.broadcast_to(np.asarray(alt, dtype=np.float64), len(image_a)))
    with np.errstate(invalid="ignore", divide="ignore"):
        ground = sensor_a.localize(image_a, alt)
        for step in range(steps + 1):
            image, jacobian = sensor_a.project_jacobian(ground)
            (p, q), (r, s), (u, v) = np.moveaxis(jacobian, 0, -1).swapaxes(0, 1)  # by lon, lat, alt
            col, row = (image_a - image).T  # what is left of a step along the ray, which bends
            det = p * s - q * r
            ground[:, :2] += (np.stack([s * col - r * row, p * row - q * col]) / det).T
            rise = np.stack([r * v - s * u, q * u - p * v, det]).T / det[:, None]  # ground units a metre of altitude
            image, jacobian = sensor_b.project_jacobian(ground)
            along = (jacobian @ rise[..., None])[..., 0]
            miss = image_b - image
            length2 = (along * along).sum(axis=1)
            if step < steps:
                more = (miss * along).sum(axis=1) / length2
                alt += more
                ground += rise * more[:, None]
        offset = (along[:, 0] * miss[:, 1] - along[:, 1] * miss[:, 0]) / np.sqrt(length2)
    return offset, alt


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Ground points intersected from tracks."""

    points: Array  # (P, 3): ECEF [m]; NaN where fewer than two rays meet, parallel ones, or outside a model
    residuals: Array  # (K, 2): projected - observed [px]; NaN for the rows of such points
    ok: BoolArray  # (P,): whether the point is usable


def triangulate(
    sensors: Sequence[SensorModel],
    view: npt.ArrayLike,
    point: npt.ArrayLike,
    xy: Array,
    sigma: Array | None = None,
    *,
    alt: float | npt.ArrayLike = 0.0,
    steps: int = NEWTON_STEPS,
) -> Triangulation:
    """Intersect the rays of tracks: batched Gauss-Newton on the reprojection error.

    Parameters
    ----------
    sensors : sequence of SensorModel, one a view
    view, point : (K,), view and track of each observation
    xy : (K, 2), col, row [px]
    sigma : (K,), optional, standard deviations [px]; equal if not given
    alt : float or (P,), altitude [m] that the first guess is localised at
    """
    view, point = np.asarray(view, dtype=np.int64), np.asarray(point, dtype=np.int64)
    xy = np.asarray(xy, dtype=np.float64)
    num = int(point.max()) + 1 if len(point) else 0
    if not num:
        return Triangulation(np.empty((0, 3)), np.empty((0, 2)), np.empty(0, dtype=bool))
    order = np.argsort(view, kind="stable")  # so that the rows of a view are a slice
    at, goal = point[order], xy[order]
    stack, bounds = RpcStack(sensors), np.searchsorted(view[order], np.arange(len(sensors) + 1))
    weight = np.ones(len(xy)) if sigma is None else 1.0 / np.asarray(sigma, dtype=np.float64)[order]
    left = np.empty((len(xy), 2))
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        ground, ok = _intersect((stack, bounds), at, goal, weight, np.broadcast_to(alt, num), steps)
        left[order] = stack.seen(ground[at], bounds).T - goal
    ok &= np.bincount(point, minlength=num) > 0
    ok[point[~np.isfinite(left).all(axis=1)]] = False
    ground[~ok] = np.nan
    left[~ok[point]] = np.nan
    return Triangulation(ecef_from_ground(ground), left, ok)


def _intersect(
    cameras: tuple[RpcStack, IntArray], point: IntArray, xy: Array, weight: Array, alt: Array, steps: int
) -> tuple[Array, BoolArray]:
    """Return ground points (P, 3) by Gauss-Newton from where a view sees a track at `alt`, and if there are any.

    `cameras`: them and which rows are whose.
    """
    stack, bounds = cameras
    ground = np.full((len(alt), 3), np.nan)
    untried = np.arange(len(point))
    while len(untried):
        rows = np.sort(untried[np.unique(point[untried], return_index=True)[1]])
        ground[point[rows]] = stack.localize(xy[rows], alt[point[rows]], np.searchsorted(rows, bounds)).T
        untried = np.setdiff1d(untried, rows, assume_unique=True)
        untried = untried[np.isnan(ground[point[untried], 0])]
    ok, of_points = np.ones(len(ground), dtype=bool), partial(np.bincount, point, minlength=len(ground))
    for _ in range(steps):
        scale = metres_per_unit(ground)
        image, jacobian = stack.seen_jacobian(ground[point], bounds)
        residual = (image - xy.T) * weight
        jacobian *= weight
        step, ok = _normal_step(jacobian.swapaxes(0, 1), residual, scale.T, of_points)
        ground -= step.T / scale
        if not np.abs(step[:, ok]).max(initial=0.0) > _LAST_STEP:
            break
    return ground, ok


def intersect_pair(pair: Sequence[SensorModel], image: Sequence[Array], alt: Array) -> Array:
    """Return the ground points (n, 3) [deg, deg, m] of matches of two images, as `triangulate` finds their tracks.

    Parameters
    ----------
    pair : two SensorModels
    image : two arrays (n, 2), col, row [px] of the matches
    alt : (n,), altitude [m] that the first guess is localised at

    A point is NaN where the rays do not meet, or are parallel.
    """
    goal = np.concatenate([one.T for one in image])
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        ground = pair[0].localize(image[0], alt)
        lost = np.isnan(ground[:, 0])
        ground[lost] = pair[1].localize(image[1][lost], alt[lost])
        for _ in range(NEWTON_STEPS):
            scale = metres_per_unit(ground)
            seen, slopes = zip(*(sensor.project_jacobian(ground) for sensor in pair), strict=True)
            residual = np.concatenate([one.T for one in seen]) - goal
            jacobian = np.concatenate([np.moveaxis(one, 0, -1) for one in slopes]).swapaxes(0, 1)
            step, ok = _normal_step(jacobian, residual, scale.T)
            ground -= step.T / scale
            if not np.abs(step[:, ok]).max(initial=0.0) > _LAST_STEP:
                break
    ground[~ok | ~np.isfinite(residual).all(axis=0)] = np.nan
    return ground


def _normal_step(
    jacobian: Array, residual: Array, scale: Array, of_points: Callable[[Array], Any] = np.asarray
) -> tuple[Array, BoolArray]:
    """Return Gauss-Newton steps (3, num) [m] and for which points the rays determine one.

    `jacobian` (3, m, K) and `residual` (m, K) are weighted; `scale` (3, num): metres of a unit of lon, lat, alt;
    `of_points` sums (K,) numbers of observations by point: each of m is one in one image, or all that there are.
    """
    num = scale.shape[1]

    def total(u: Array, v: Array) -> Array:
        weights = u[0] * v[0]
        for one, other in zip(u[1:], v[1:], strict=True):
            weights += one * other
        return np.asarray(of_points(weights), dtype=np.float64)

    normal = np.empty((3, 3, num))
    for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
        normal[i, j] = normal[j, i] = total(jacobian[i], jacobian[j]) / (scale[i] * scale[j])
    right = np.stack([total(by_axis, residual) / metres for by_axis, metres in zip(jacobian, scale, strict=True)])
    cofactors = np.stack([cross(normal[i - 2], normal[i - 1]) for i in range(3)])  # Cramer: a step need not be exact
    det, mean = (normal[0] * cofactors[0]).sum(axis=0), (normal[0, 0] + normal[1, 1] + normal[2, 2]) / 3
    # parallel rays: the determinant against the trace; 1e-10 is 0.0006 degrees
    ok = np.isfinite(det) & (det > 1e-10 * mean**3)
    step = (cofactors * right).sum(axis=1) / det
    step[:, ~ok] = 0.0
    return step, ok
