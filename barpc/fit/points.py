"""The points of a fit: a grid of a sensor model, or given and looked at first (shapes, numbers, geometry)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from barpc.base.errors import FitError, InputError
from barpc.base.geodesy import MAX_COORDINATE, Array, as_numbers, metres_per_unit, parts, wrap_longitude
from barpc.base.options import FitOptions
from barpc.sensor import SensorModel
from barpc.sensor.geometry import LEAST_RANGE, footprint

_DEM_SAMPLES = 400  # of a DEM along each side of the image
_RANGES = (("longitude", -360.0, 720.0), ("latitude", -90.0, 90.0), ("altitude", -12e3, 100e3))
_ONE_ALTITUDE = 1e-3  # metres


def spaced(low: float, high: float, count: int, even: bool = False) -> Array:
    """Return the positions (count,) from `low` to `high`, ends included: Chebyshev-Lobatto nodes, or `even` steps."""
    t = np.linspace(-1.0, 1.0, count)
    if not even:
        t = np.sin(0.5 * np.pi * t)
    return 0.5 * (low + high) + 0.5 * (high - low) * t


def widened(alt_range: tuple[float, float]) -> tuple[float, float]:
    """Return `alt_range` [m] widened to `LEAST_RANGE`: a flat scene still gets its altitude terms."""
    low, high = float(alt_range[0]), float(alt_range[1])
    if not (np.isfinite(low) and np.isfinite(high) and low <= high):
        raise FitError(f"altitude range {low:g} to {high:g} m is not an interval")
    lacking = max(0.0, 0.5 * (LEAST_RANGE - (high - low)))
    return low - lacking, high + lacking


def terrain_range(
    model: SensorModel,
    size: tuple[int, int],
    alt_range: tuple[float, float],
    dem: Callable[[Array, Array], Array],
    margin: float,
) -> tuple[float, float]:
    """Return the lowest and highest altitude [m] of a DEM under an image of `size` (width, height), and a margin.

    `alt_range` [m] is where the footprint is looked for; `dem` takes lon, lat [deg] and gives altitudes [m above the
    ellipsoid], NaN where it has none, and has one somewhere; the paper's `margin` [m] is 500.
    """
    (west, east), (south, north) = _ground_box(model, size, alt_range)
    lon, lat = np.meshgrid(np.linspace(west, east, _DEM_SAMPLES), np.linspace(south, north, _DEM_SAMPLES))
    alt = dem(lon.ravel(), lat.ravel())
    return float(np.nanmin(alt)) - margin, float(np.nanmax(alt)) + margin


def control_points(
    model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float], options: FitOptions
) -> tuple[Array, Array]:
    """Return the control points: ground (n_x, n_y, n_alt, 3) lon, lat [deg], alt [m] and image (n_x, n_y, n_alt, 2).

    It spans the outer edges of the image and `alt_range` [m]; longitudes run on across the antimeridian. NaN where
    the model fails.
    """
    if options.space == "ground":
        x, y = _ground_box(model, size, alt_range)
    else:
        x, y = (-0.5, size[0] - 0.5), (-0.5, size[1] - 0.5)
    axes = (
        spaced(*ends, n, options.space == "ground") for ends, n in zip((x, y, alt_range), options.grid, strict=True)
    )
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    if options.space == "ground":
        return points, model.project(points)
    image = np.ascontiguousarray(points[..., :2])
    ground = model.localize(image, points[..., 2])
    finite = ground[np.isfinite(ground).all(axis=-1)]
    if len(finite):
        ground[..., 0] = wrap_longitude(ground[..., 0], finite[0, 0])
    return ground, image


def _ground_box(
    model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the longitudes and latitudes [deg] of the box around the footprints at both altitudes."""
    ring = np.concatenate([footprint(model, size, alt) for alt in alt_range])
    ring = ring[np.isfinite(ring).all(axis=1)]
    if not len(ring):
        raise FitError("the model has no footprint over this altitude range")
    lon, lat = wrap_longitude(ring[:, 0], ring[0, 0]), ring[:, 1]
    return (float(lon.min()), float(lon.max())), (float(lat.min()), float(lat.max()))


def column_ranges(points: Array) -> tuple[Array, Array]:
    """Return the smallest and largest value of each column of (N, k); columns one by one are faster than rows."""
    columns = points.T
    return np.array([c.min() for c in columns]), np.array([c.max() for c in columns])


def screened(ground: npt.ArrayLike, image: npt.ArrayLike) -> tuple[Array, Array, bool]:
    """Return `checked_points`, and whether they show the ground mirrored; FitError for points that make no RPC."""
    ground, image = checked_points(ground, image)
    mirrored = _is_mirrored(_checked_slope(ground, image))
    distinct = len(np.unique(ground, axis=0)) if len(ground) < 400 else len(ground)
    if distinct < min(len(ground), 40):
        raise FitError(f"points: only {distinct} of {len(ground)} are distinct, too few for an RPC")
    return ground, image, mirrored


def checked_points(ground: npt.ArrayLike, image: npt.ArrayLike) -> tuple[Array, Array]:
    """Return points (N, 3) lon, lat [deg], alt [m] and (N, 2) [px] as finite arrays, longitudes made continuous.

    FitError: no points, a wrong shape, numbers that are not finite or out of range.
    """
    try:
        ground, image = as_numbers(ground, "ground points"), as_numbers(image, "image points")
    except InputError as error:
        raise FitError(f"points: {error}") from error
    if ground.ndim != 2 or ground.shape[1:] != (3,) or image.shape != (len(ground), 2):
        raise FitError(f"points: expected (N, 3) and (N, 2), found {ground.shape} and {image.shape}")
    if not len(ground):
        raise FitError("points: none at all; 4 give an affine at their altitude, 40 a whole RPC")
    bad = np.flatnonzero(~np.isfinite(ground.sum(axis=1) + image.sum(axis=1)))
    if len(bad):
        raise FitError(f"points: {len(bad)} of {len(ground)} are not finite (the first is point {bad[0]})")
    for value, (name, low, high) in zip(ground.T, _RANGES, strict=True):
        if value.min() < low or value.max() > high:
            wrong = value.min() if value.min() < low else value.max()
            raise FitError(f"points: {wrong:g} is not a {name}: are the columns swapped? Give lon, lat [deg], alt [m]")
    if not (np.abs(image) <= MAX_COORDINATE).all():
        raise FitError(f"points: {np.abs(image).max():g} px is no place in an image")
    if np.ptp(ground[:, 0]) > 180.0:  # across the antimeridian; others are not copied
        ground = np.column_stack([wrap_longitude(ground[:, 0], ground[0, 0]), ground[:, 1:]])
    return ground, image


def _checked_slope(ground: Array, image: Array) -> Array:
    """Return d(col, row) / d(east, north) (2, 2) [px/m]; FitError for points on a line or in a plane."""
    (low, left), (high, right) = zip(column_ranges(ground), column_ranges(image), strict=True)
    low, high = np.concatenate([low, left]), np.concatenate([high, right])
    span = high - low
    for i, name in ((0, "lon"), (1, "lat"), (3, "col"), (4, "row")):
        if span[i] <= 1e-12 * max(abs(low[i]), abs(high[i])):
            raise FitError(f"points: all have {name} {low[i]:g}: they determine no image")
    used = [0, 1, 2] if span[2] >= _ONE_ALTITUDE else [0, 1]
    covariance = _covariance(ground, image, 0.5 * (low + high), np.where(span > 0, span, 1.0))
    for axes, where in ((used, "on the ground"), ([3, 4], "in the image")):
        spread = np.linalg.eigvalsh(covariance[np.ix_(axes, axes)])
        if spread[0] < 1e-10 * spread[-1]:
            raise FitError(
                f"points: {where} they lie {'in a plane' if len(axes) == 3 else 'on a line'}; an RPC needs "
                "points at several altitudes everywhere"
            )
    slope = np.linalg.solve(covariance[np.ix_(used, used)], covariance[np.ix_(used, [3, 4])])
    metres = span[:2] * metres_per_unit(0.5 * (low[:3] + high[:3]))[:2]
    return np.asarray(slope[:2].T * span[3:, None] / metres)


def _covariance(ground: Array, image: Array, center: Array, span: Array) -> Array:
    """Return the covariance (5, 5) of lon, lat, alt, col, row, each in units of its span."""
    total, squares = np.zeros(5), np.zeros((5, 5))
    for part in parts(len(ground)):
        z = np.concatenate([ground[part].T, image[part].T])
        z -= center[:, None]
        z /= span[:, None]
        total += z.sum(axis=1)
        squares += z @ z.T
    return np.asarray(squares / len(ground) - np.outer(total, total) / len(ground) ** 2)


def _is_mirrored(jacobian: Array) -> bool:
    """Return whether an image whose d(col, row) / d(east, north) [px/m] is square and upright is mirrored."""
    a, b = np.linalg.norm(jacobian, axis=1)
    square = 0.5 < a / b < 2.0 and abs(jacobian[0] @ jacobian[1]) < 0.5 * a * b
    return bool(square and np.linalg.det(jacobian) > 0)  # rows run down: a view from above is < 0
