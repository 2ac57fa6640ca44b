"""What is looked at before points are fitted: shapes, numbers, order of columns, geometry."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from barpc.errors import FitError
from barpc.geodesy import Array, metres_per_unit, wrap_longitude

_RANGES = (("longitude", -360.0, 720.0), ("latitude", -90.0, 90.0), ("altitude", -12e3, 100e3))
_ONE_ALTITUDE = 1e-3  # metres
_CHUNK = 8192


def extent(points: Array) -> tuple[Array, Array]:
    """Smallest and largest value of each column of (N, k); columns one by one are faster than rows."""
    columns = points.T
    return np.array([c.min() for c in columns]), np.array([c.max() for c in columns])


def screened(ground: npt.ArrayLike, image: npt.ArrayLike, allow_mirrored: bool) -> tuple[Array, Array]:
    """Correspondences fit to be fitted, longitudes made continuous.

    Parameters
    ----------
    ground : (N, 3)
        lon, lat [deg], alt [m].
    image : (N, 2)
        col, row [px].
    allow_mirrored : bool
        Do not suspect swapped columns behind a mirrored image.

    Raises
    ------
    FitError
        As for `numbers`; or columns that look swapped, points on a line or in a plane.
    """
    ground, image = numbers(ground, image)
    _check_geometry(ground, image, allow_mirrored)
    return ground, image


def numbers(ground: npt.ArrayLike, image: npt.ArrayLike) -> tuple[Array, Array]:
    """Points (N, 3) and (N, 2) as finite arrays, longitudes made continuous.

    Raises
    ------
    FitError
        No points, a wrong shape, numbers that are not finite or out of range.
    """
    ground = np.asarray(ground, dtype=np.float64)
    image = np.asarray(image, dtype=np.float64)
    if ground.ndim != 2 or ground.shape[1:] != (3,) or image.shape != (len(ground), 2):
        raise FitError(f"points: expected (N, 3) and (N, 2), found {ground.shape} and {image.shape}")
    if not len(ground):
        raise FitError("points: none at all, an RPC takes forty or more")
    bad = np.flatnonzero(~np.isfinite(ground.sum(axis=1) + image.sum(axis=1)))
    if len(bad):
        raise FitError(f"points: {len(bad)} of {len(ground)} are not finite (the first is point {bad[0]})")
    for axis, (name, low, high) in enumerate(_RANGES):
        value = ground[:, axis]
        if value.min() < low or value.max() > high:
            wrong = value.min() if value.min() < low else value.max()
            raise FitError(
                f"points: {wrong:g} is not a {name}: are the columns swapped? Give lon, lat [deg], alt [m]"
            )
    if np.ptp(ground[:, 0]) > 180.0:
        ground = ground.copy()
        ground[:, 0] = wrap_longitude(ground[:, 0], ground[0, 0])
    return ground, image


def _check_geometry(ground: Array, image: Array, allow_mirrored: bool) -> None:
    (low, left), (high, right) = zip(extent(ground), extent(image), strict=True)
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
    if not allow_mirrored:
        slope = np.linalg.solve(covariance[np.ix_(used, used)], covariance[np.ix_(used, [3, 4])])
        metres = span[:2] * metres_per_unit(0.5 * (low[:3] + high[:3]))[:2]
        _check_order(slope[:2].T * span[3:, None] / metres)


def _covariance(ground: Array, image: Array, center: Array, span: Array) -> Array:
    """Covariance (5, 5) of lon, lat, alt, col, row, each in units of its span."""
    total, squares = np.zeros(5), np.zeros((5, 5))
    for start in range(0, len(ground), _CHUNK):
        part = slice(start, start + _CHUNK)
        z = np.concatenate([ground[part].T, image[part].T])
        z -= center[:, None]
        z /= span[:, None]
        total += z.sum(axis=1)
        squares += z @ z.T
    return np.asarray(squares / len(ground) - np.outer(total, total) / len(ground) ** 2)


def _check_order(jacobian: Array) -> None:
    """Refuse an image that is mirrored as given, and square and upright with two columns swapped.

    Parameters
    ----------
    jacobian : (2, 2)
        d(col, row) / d(east, north) [px/m].
    """
    a, b = np.linalg.norm(jacobian, axis=1)
    square = 0.5 < a / b < 2.0 and abs(jacobian[0] @ jacobian[1]) < 0.5 * a * b
    if np.linalg.det(jacobian) < 0 or not square:  # rows run down: a view from above is < 0
        return
    raise FitError(
        "points: they show the ground mirrored, as if col and row or lon and lat were swapped; give "
        "lon, lat, alt and col, row (and allow_mirrored for a radar image that is mirrored)"
    )
