"""Geometry of any sensor model: footprint, lines of sight, view angles; many cameras in one go."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeGuard

import numpy as np
import numpy.typing as npt

from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, metres_per_unit, wrap_longitude
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Corrected, Corrections
from barpc.sensor.rpc import RpcStack, localize_stack

if TYPE_CHECKING:
    from barpc.sensor.radar import Radar

LEAST_RANGE = 100.0  # of altitudes [m] between which a ray is drawn, or that an RPC is made for


def image_border(size: tuple[int, int], per_side: int = 8) -> Array:
    """Return the points (4 per_side, 2) [px] along the outline of an image, from the top-left corner, clockwise."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    t = np.arange(per_side)[:, None] / per_side
    sides = corners[:, None] + t * (np.roll(corners, -1, axis=0) - corners)[:, None]
    return np.asarray(sides.reshape(-1, 2) * size - 0.5)


def footprint(sensor: SensorModel, size: tuple[int, int], alt: npt.ArrayLike) -> Array:
    """Return the outline (32, 2) of an image of `size` (width, height) on the ground: lon, lat [deg], not closed.

    `alt` [m above the ellipsoid]: of the ground, or of each point (32,) of the outline (`image_border`). Longitudes run
    on across the antimeridian.
    """
    return np.asarray(footprints([sensor], [size], alt)[0])


def footprints(sensors: Sequence[SensorModel], sizes: Sequence[tuple[int, int]], alt: npt.ArrayLike) -> Array:
    """Return the outlines (N, 32, 2) of images on the ground, at an altitude [m] or one each (N, 1): `footprint`s."""
    borders = np.array([image_border(size) for size in sizes]).reshape(len(sizes), -1, 2)
    alts = np.broadcast_to(np.asarray(alt, dtype=np.float64), borders.shape[:2])
    bounds = borders.shape[1] * np.arange(len(sizes) + 1)
    rings = localize_stack(sensors, borders.reshape(-1, 2), alts.ravel(), bounds)[:, :2].reshape(borders.shape)
    rings[..., 0] = wrap_longitude(rings[..., 0], rings[:, :1, 0])
    return rings


def lines_of_sight(sensor: SensorModel, image: Array, alt_range: tuple[float, float]) -> tuple[Array, Array]:
    """Return the straight lines through the ground points of image points at two altitudes.

    Parameters
    ----------
    image : (..., 2), col, row [px]
    alt_range : (low, high), the two altitudes [m]; at least 100 m apart are taken

    Returns
    -------
    origin : (..., 3), ECEF [m], at the lower altitude
    direction : (..., 3), unit vector in ECEF, pointing up, towards the sensor
    """
    image = np.asarray(image, dtype=np.float64)
    alt = np.empty((2, *image.shape[:-1]))
    alt[0], alt[1] = alt_range[0], max(alt_range[1], alt_range[0] + LEAST_RANGE)
    origin, end = ecef_from_ground(sensor.localize(np.broadcast_to(image, (2, *image.shape)), alt))
    direction = end - origin
    return origin, direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def sight_enu(sensor: SensorModel, ground: Array) -> Array:
    """Return the unit vectors (..., 3) east, north, up from ground points (..., 3) along the rays to the sensor."""
    ground = np.asarray(ground, dtype=np.float64)
    _, jacobian = sensor.project_jacobian(ground)
    metric = jacobian / metres_per_unit(ground)[..., None, :]
    sight = np.cross(metric[..., 0, :], metric[..., 1, :])
    sight *= np.where(sight[..., 2:] < 0, -1.0, 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(sight / np.linalg.norm(sight, axis=-1, keepdims=True))


def view_angles(sensor: SensorModel, ground: Array) -> tuple[Array, Array]:
    """Return the incidence and azimuth of the line of sight, or of a radar's beam, at ground points (..., 3).

    Returns
    -------
    incidence : (...), angle between the local vertical and the direction to the sensor [deg]
    azimuth : (...), direction to the sensor, clockwise from north [deg, 0 to 360]
    """
    east, north, up = np.moveaxis(_to_sensor(sensor, np.asarray(ground, dtype=np.float64)), -1, 0)
    return np.degrees(np.arctan2(np.hypot(east, north), up)), np.degrees(np.arctan2(east, north)) % 360.0


def is_radar(sensor: SensorModel) -> TypeGuard[Radar]:
    """Return whether a model knows where its beam comes from; none is loaded to ask."""
    return hasattr(sensor, "to_radar")


def _to_sensor(sensor: SensorModel, ground: Array) -> Array:
    """Return the east, north, up (..., 3) of the direction to the sensor, of any length."""
    if isinstance(sensor, Several):
        return sensor.each(_to_sensor, ground)
    if is_radar(sensor):
        return np.asarray((enu_basis(ground) @ sensor.to_radar(ground)[..., None])[..., 0])
    return sight_enu(sensor, ground)


def ground_sample_distance(sensor: SensorModel, ground: Array) -> tuple[Array, Array]:
    """Return the ground sampling distance [m] at points (..., 3) on level ground.

    Returns
    -------
    sides : (..., 2), metres from one pixel to the next along col and along row
    mean : (...), side [m] of the square that has the area of a pixel
    """
    _, jacobian = sensor.project_jacobian(ground)
    metric = jacobian[..., :2] / metres_per_unit(ground)[..., None, :2]  # px a metre east, north
    with np.errstate(divide="ignore", invalid="ignore"):
        density = np.abs(np.linalg.det(metric))
        sides = np.linalg.norm(metric[..., ::-1, :], axis=-1) / density[..., None]  # columns of the inverse
        return sides, np.asarray(1.0 / np.sqrt(density))


def convergence_angle(sensor_a: SensorModel, sensor_b: SensorModel, ground: Array) -> Array:
    """Return the angle (...) [deg] between the lines of sight of two cameras at ground points (..., 3)."""
    a, b = sight_enu(sensor_a, ground), sight_enu(sensor_b, ground)
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.degrees(np.arctan2(cross, (a * b).sum(axis=-1))))


def base_to_height(sensor_a: SensorModel, sensor_b: SensorModel, ground: Array) -> Array:
    """Return B/H (...) of two cameras at ground points (..., 3): metres of parallax a metre of height.

    abs(t_a - t_b), t = (east, north) / up of a line of sight: the distance of the two cameras at the height 1. The
    textbook's 2 tan(angle / 2) is that only where the vertical halves the angle: of two cameras on one side of it,
    at 30 and 40 degrees, it is 0.17 instead of 0.26.
    """
    a, b = sight_enu(sensor_a, ground), sight_enu(sensor_b, ground)
    return np.asarray(np.linalg.norm(a[..., :2] / a[..., 2:] - b[..., :2] / b[..., 2:], axis=-1))


class Several:
    """Many cameras as one, each point with its own: row n of an argument belongs to camera `view[n]`.

    One call evaluates a whole block instead of one pair.
    """

    def __init__(self, sensors: Sequence[SensorModel], view: npt.ArrayLike) -> None:
        used, camera = np.unique(np.asarray(view, dtype=np.int64), return_inverse=True)
        cameras = [sensors[v] for v in used.tolist()]
        self._order = np.argsort(camera, kind="stable")
        self._stack, self._bounds = RpcStack(cameras), np.searchsorted(camera[self._order], np.arange(len(used) + 1))
        self.behind: Corrected | None = None  # all cameras are behind corrections in space: one behind many
        behind = [one for one in cameras if isinstance(one, Corrected)]
        if len(behind) == len(used) and len({len(one.correction.drift) for one in behind}) == 1:
            inner = Several([one.sensor for one in behind], camera)
            self.behind = Corrected(inner, Corrections.of([one.correction for one in behind], camera))

    def each(self, function: Callable[[SensorModel, Array], Array], ground: Array) -> Array:
        """Return the values of a function at ground points (N, 3), each with its own camera."""
        out = np.empty_like(ground)
        for sensor, rows in zip(self._stack.sensors, np.split(self._order, self._bounds[1:-1]), strict=False):
            out[rows] = function(sensor, ground[rows])
        return out

    def project(self, ground: Array, near: Array | None = None) -> Array:
        """Project ground points (N, 3) [deg, deg, m] to image points (N, 2) [px], perhaps known to be `near`."""
        if self.behind is not None:
            return self.behind.project(ground, near)
        return self._given_back(self._stack.seen(ground[self._order], self._bounds))

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Return image points (N, 2) [px] and their derivatives (N, 2, 3) [px/deg, px/deg, px/m]."""
        if self.behind is not None:
            return self.behind.project_jacobian(ground)
        image, jacobian = self._stack.seen_jacobian(ground[self._order], self._bounds)
        return self._given_back(image), self._given_back(jacobian)

    def localize(self, image: Array, alt: Array) -> Array:
        """Localise image points (N, 2) [px] at altitudes (N,) [m]: ground points (N, 3)."""
        if self.behind is not None:
            with np.errstate(all="ignore"):
                return self.behind.localize_rows(image, alt)
        return self._given_back(self._stack.localize(image[self._order], alt[self._order], self._bounds))

    def _given_back(self, found: Array) -> Array:
        """Return values (..., N), sorted by camera, as rows (N, ...) in the order of the request."""
        out = np.empty_like(found)
        out[..., self._order] = found
        return np.moveaxis(out, -1, 0)
