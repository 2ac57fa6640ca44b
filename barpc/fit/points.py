"""What is looked at before points are fitted: shapes, numbers, order of columns, geometry."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from barpc.errors import FitError
from barpc.geodesy import Array, metres_per_unit, wrap_longitude

_RANGES = (("longitude", -360.0, 720.0), ("latitude", -90.0, 90.0), ("altitude", -12e3, 100e3))
_ONE_ALTITUDE = 1e-3  # metres


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
        A wrong shape, numbers that are not finite or out of range, columns that look swapped, points on
        a line or in a plane.
    """
    ground = np.asarray(ground, dtype=np.float64)
    image = np.asarray(image, dtype=np.float64)
    if ground.ndim != 2 or ground.shape[1:] != (3,) or image.shape != (len(ground), 2):
        raise FitError(f"points: expected (N, 3) and (N, 2), found {ground.shape} and {image.shape}")
    if not len(ground):
        raise FitError("points: none at all, an RPC takes forty or more")
    bad = np.flatnonzero(~(np.isfinite(ground).all(axis=1) & np.isfinite(image).all(axis=1)))
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
    _check_geometry(ground, image, allow_mirrored)
    return ground, image


def _check_geometry(ground: Array, image: Array, allow_mirrored: bool) -> None:
    for name, value in zip(("lon", "lat", "col", "row"), (*ground[:, :2].T, *image.T), strict=True):
        if np.ptp(value) <= 1e-12 * np.abs(value).max():
            raise FitError(f"points: all have {name} {value[0]:g}: they determine no image")
    metres = (ground - ground.mean(axis=0)) * metres_per_unit(ground.mean(axis=0))
    used = metres if np.ptp(ground[:, 2]) >= _ONE_ALTITUDE else metres[:, :2]
    for points, where in ((used, "on the ground"), (image - image.mean(axis=0), "in the image")):
        spread = np.linalg.svd(points / np.ptp(points, axis=0), compute_uv=False)
        if spread[-1] < 1e-5 * spread[0]:
            raise FitError(
                f"points: {where} they lie {'in a plane' if points.shape[1] == 3 else 'on a line'}; an RPC "
                "needs points at several altitudes everywhere"
            )
    if not allow_mirrored:
        _check_order(used, image)


def _check_order(used: Array, image: Array) -> None:
    """Refuse an image that is mirrored as given, and square and upright with two columns swapped."""
    jacobian = np.linalg.lstsq(used, image - image.mean(axis=0), rcond=None)[0].T[:, :2]
    if np.linalg.det(jacobian) < 0 or not _square(jacobian):  # rows run down: a view from above is < 0
        return
    raise FitError(
        "points: they show the ground mirrored, as if col and row or lon and lat were swapped; give "
        "lon, lat, alt and col, row (and allow_mirrored for a radar image that is mirrored)"
    )


def _square(jacobian: Array) -> bool:
    """Whether a (2, 2) derivative has nearly square pixels with nearly right angles."""
    a, b = np.linalg.norm(jacobian, axis=1)
    return bool(0.5 < a / b < 2.0 and abs(jacobian[0] @ jacobian[1]) < 0.5 * a * b)
