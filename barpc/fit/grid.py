"""Control points (CNP) and check points (CKP) of a sensor model."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from barpc.errors import FitError
from barpc.fit.options import ALTITUDE_FLOOR, FitOptions, Nodes
from barpc.geodesy import Array, wrap_longitude
from barpc.sensor import SensorModel
from barpc.sensor.geometry import footprint

_SLAB = 8192  # check points handed out at a time, about
_SAMPLES = 400  # of a DEM along each side of the image


def spaced(low: float, high: float, count: int, nodes: Nodes) -> Array:
    """Positions (count,) from `low` to `high`, both ends included."""
    t = np.linspace(-1.0, 1.0, count)
    if nodes == "chebyshev":
        t = np.sin(0.5 * np.pi * t)
    return 0.5 * (low + high) + 0.5 * (high - low) * t


def widened(alt_range: tuple[float, float]) -> tuple[float, float]:
    """`alt_range` [m], at least 2 `ALTITUDE_FLOOR` wide: a flat scene still gets its altitude terms."""
    low, high = float(alt_range[0]), float(alt_range[1])
    if not (np.isfinite(low) and np.isfinite(high) and low <= high):
        raise FitError(f"altitude range {low:g} to {high:g} m is not an interval")
    lacking = max(0.0, ALTITUDE_FLOOR - 0.5 * (high - low))
    return low - lacking, high + lacking


def terrain_range(
    model: SensorModel,
    size: tuple[int, int],
    alt_range: tuple[float, float],
    dem: Callable[[Array, Array], Array],
    margin: float,
) -> tuple[float, float]:
    """Altitudes of a DEM over an image, with a margin.

    Parameters
    ----------
    model : SensorModel
        The camera.
    size : (width, height)
        [px].
    alt_range : (low, high)
        Altitudes [m] that the footprint is looked for at.
    dem : callable
        (lon, lat) [deg] -> altitude [m above the ellipsoid], NaN where it has none.
    margin : float
        Added below and above [m]; the paper takes 500.

    Raises
    ------
    FitError
        The DEM has no altitude under the image.
    """
    (west, east), (south, north) = _ground_box(model, size, alt_range)
    lon, lat = np.meshgrid(np.linspace(west, east, _SAMPLES), np.linspace(south, north, _SAMPLES))
    alt = dem(lon.ravel(), lat.ravel())
    alt = alt[np.isfinite(alt)]
    if not len(alt):
        raise FitError(
            f"the DEM has no altitude under the image (lon {west:.4f} to {east:.4f}, lat {south:.4f} to "
            f"{north:.4f}): give one that covers it, or an altitude range"
        )
    return float(alt.min()) - margin, float(alt.max()) + margin


def control_points(
    model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float], options: FitOptions
) -> tuple[Array, Array]:
    """Grid of control points.

    Parameters
    ----------
    model : SensorModel
        The camera to be sampled.
    size : (width, height)
        [px]; the grid spans the outer edges of the image.
    alt_range : (low, high)
        [m above the ellipsoid].
    options : FitOptions
        Its ``grid``, ``space`` and ``nodes``.

    Returns
    -------
    ground : (n_x, n_y, n_alt, 3)
        lon, lat [deg], alt [m]; longitudes run on across the antimeridian. NaN where the model fails.
    image : (n_x, n_y, n_alt, 2)
        col, row [px].
    """
    n_x, n_y, n_alt = options.grid
    alt = spaced(*alt_range, n_alt, options.nodes)
    if options.space == "ground":
        x, y = _ground_box(model, size, alt_range)
    else:
        x, y = (-0.5, size[0] - 0.5), (-0.5, size[1] - 0.5)
    axes = spaced(*x, n_x, options.nodes), spaced(*y, n_y, options.nodes), alt
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
    """Longitudes and latitudes [deg] of the box around the footprints at both altitudes."""
    ring = np.concatenate([footprint(model, size, alt) for alt in alt_range])
    ring = ring[np.isfinite(ring).all(axis=1)]
    if not len(ring):
        raise FitError("the model has no footprint over this altitude range")
    lon, lat = wrap_longitude(ring[:, 0], ring[0, 0]), ring[:, 1]
    return (float(lon.min()), float(lon.max())), (float(lat.min()), float(lat.max()))


def check_points(ground: Array) -> Iterator[Array]:
    """Middles of consecutive control points: strictly inside the box, never used by the fit.

    Parameters
    ----------
    ground : (n_x, n_y, n_alt, 3)
        Control points; lon, lat [deg], alt [m].

    Yields
    ------
    middle : (M, 3)
        lon, lat [deg], alt [m]; the finite ones, some thousands at a time.
    """
    step = max(1, _SLAB // max(1, (ground.shape[1] - 1) * (ground.shape[2] - 1)))
    for start in range(0, ground.shape[0] - 1, step):
        middle = ground[start : start + step + 1]
        for axis in range(3):
            head = middle[(slice(None),) * axis + (slice(None, -1),)]
            tail = middle[(slice(None),) * axis + (slice(1, None),)]
            middle = 0.5 * (head + tail)
        flat = middle.reshape(-1, 3)
        yield flat[np.isfinite(flat).all(axis=1)]
