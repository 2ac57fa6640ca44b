"""Geometry of any sensor model: footprint, lines of sight, view angles, triangulation, camera centre."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, TypeGuard

import numpy as np
import numpy.typing as npt

from barpc.base.errors import RpcError
from barpc.base.geodesy import (
    NEWTON_STEPS,
    Array,
    BoolArray,
    IntArray,
    ecef_from_ground,
    enu_basis,
    ground_from_ecef,
    metres_per_unit,
    wrap_longitude,
)
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Corrected, Corrections
from barpc.sensor.curve import cross
from barpc.sensor.rpc import RpcStack, localize_stack

if TYPE_CHECKING:
    from barpc.sensor.radar import Radar

CenterMethod = Literal["line", "projective", "nominal", "stated"]

_RAYS = 41  # of a line
LEAST_RANGE = 100.0  # of altitudes [m] between which a ray is drawn, or that an RPC is made for
NOMINAL_ALTITUDE = 650e3  # orbit altitude [m] assumed where a model does not tell its own
GRID_NODES = 11, 5  # of a grid over an image, along its sides and its altitudes
PLAUSIBLE_ALTITUDE = (380e3, 1000e3)  # a camera centre regressed outside this range [m] is not believed


def image_border(size: tuple[int, int], per_side: int = 8) -> Array:
    """Return the points (4 per_side, 2) [px] along the outline of an image, from the top-left corner, clockwise."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    t = np.arange(per_side)[:, None] / per_side
    sides = corners[:, None] + t * (np.roll(corners, -1, axis=0) - corners)[:, None]
    return np.asarray(sides.reshape(-1, 2) * size - 0.5)


def image_grid(
    size: tuple[int, int], alt_range: tuple[float, float], nodes: tuple[int, int] = GRID_NODES
) -> tuple[Array, Array]:
    """Return the image points (N, 2) [px] and altitudes (N,) [m] of a grid over an image, columns slowest."""
    col, row = (np.linspace(0, side - 1, nodes[0]) for side in size)
    grid = np.stack(np.meshgrid(col, row, np.linspace(*alt_range, nodes[1]), indexing="ij"), axis=-1)
    return grid[..., :2].reshape(-1, 2), grid[..., 2].ravel()


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


def _to_sensor(sensor: SensorModel, ground: Array) -> Array:
    """Return the east, north, up (..., 3) of the direction to the sensor, of any length."""
    if isinstance(sensor, Several):
        return sensor.each(_to_sensor, ground)
    if _is_radar(sensor):
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


@dataclass(frozen=True, eq=False)
class CameraCenter:
    """Position of a camera, and how it was found."""

    ecef: Array  # (3,) [m]
    altitude: float
    method: CenterMethod  # how it was found: "nominal" where "line" was not plausible, "stated" by a radar


def camera_center(
    sensor: SensorModel,
    size: tuple[int, int],
    alt_range: tuple[float, float],
    how: Literal["line", "projective"] = "line",
) -> CameraCenter:
    """Estimate the camera centre by regression of a sensor model's rays.

    One image line of a pushbroom camera IS a perspective camera, so its rays meet in one point, found by least
    squares. A point outside `PLAUSIBLE_ALTITUDE` is replaced by one at `NOMINAL_ALTITUDE` on the central ray, and says
    so in its ``method``. A projective camera regressed over the whole image, as in the paper, stands at about twice
    the distance: the image is perspective across the track and affine along it. A radar states where it is.

    Parameters
    ----------
    size : (width, height) [px]
    alt_range : (low, high), altitudes [m] between which rays are drawn
    how : the rays of the middle line, or a projective camera over image and altitudes

    Raises
    ------
    RpcError
        The model cannot be localised over its own image.
    """
    return camera_centers([sensor], [size], [alt_range], how)[0]


def camera_centers(
    sensors: Sequence[SensorModel],
    sizes: Sequence[tuple[int, int]],
    alt_ranges: Sequence[tuple[float, float]],
    how: Literal["line", "projective"] = "line",
) -> list[CameraCenter]:
    """Estimate the centres of cameras: `camera_center` of each, in one go."""
    number = [i for i, sensor in enumerate(sensors) if not _is_radar(sensor)]
    ecef = np.full((len(sensors), 3), np.nan)
    if how == "line":
        some = [sensors[i] for i in number], [sizes[i] for i in number], [alt_ranges[i] for i in number]
        ecef[number] = _centers_of_lines(*some)
    else:
        for i in number:
            ecef[i] = _center_projective(sensors[i], sizes[i], alt_ranges[i])
    altitude = ground_from_ecef(ecef)[:, 2].tolist()
    found = []
    for i, (sensor, size, alt_range) in enumerate(zip(sensors, sizes, alt_ranges, strict=True)):
        low, high = PLAUSIBLE_ALTITUDE if how == "line" else (alt_range[1], np.inf)
        if _is_radar(sensor):
            found.append(_center_stated(sensor, size, alt_range))
        elif low <= altitude[i] <= high:
            found.append(CameraCenter(ecef[i], altitude[i], how))
        else:
            found.append(_center_nominal(sensor, size, alt_range, altitude[i]))
    return found


def _is_radar(sensor: SensorModel) -> TypeGuard[Radar]:
    """Return whether a model knows where its beam comes from; none is loaded to ask."""
    return hasattr(sensor, "to_radar")


def _center_stated(sensor: Radar, size: tuple[int, int], alt_range: tuple[float, float]) -> CameraCenter:
    point = sensor.localize((np.array(size) - 1) / 2.0, np.array(np.mean(alt_range)))
    ecef = ecef_from_ground(point) + sensor.to_radar(point)
    if not np.isfinite(ecef).all():
        raise RpcError("camera centre: the model has no ground point at its image's centre")
    return CameraCenter(ecef, float(ground_from_ecef(ecef)[2]), "stated")


def _centers_of_lines(
    sensors: Sequence[SensorModel], sizes: Sequence[tuple[int, int]], alt_ranges: Sequence[tuple[float, float]]
) -> Array:
    """Return the points (N, 3) nearest to the rays of every camera's middle line; NaN where one has none."""
    side, ends = np.array(sizes, dtype=np.float64).reshape(-1, 2) - 1.0, np.array(alt_ranges).reshape(-1, 2)
    n, m = len(side), _RAYS
    image = np.empty((n, 2, m, 2))
    image[..., 0] = side[:, :1, None] * np.linspace(0.0, 1.0, m)
    image[..., 1] = side[:, 1:, None] / 2.0
    alt = np.repeat(np.column_stack([ends[:, 0], np.maximum(ends[:, 1], ends[:, 0] + LEAST_RANGE)]), m)
    ground = localize_stack(sensors, image.reshape(-1, 2), alt, 2 * m * np.arange(n + 1))
    origin, end = ecef_from_ground(ground).reshape(n, 2, m, 3).swapaxes(0, 1)
    direction = end - origin
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    shift = origin.mean(axis=1)
    local = origin - shift[:, None]
    normal = m * np.eye(3) - np.swapaxes(direction, 1, 2) @ direction
    along = (direction * local).sum(axis=2, keepdims=True)
    rhs = (local - along * direction).sum(axis=1)
    seen = np.asarray(np.isfinite(normal).all(axis=(1, 2)))
    inverse = np.linalg.pinv(np.where(seen[:, None, None], normal, 0.0), rcond=1e-15)
    found = (inverse @ rhs[..., None])[..., 0] + shift
    return np.where(seen[:, None], found, np.nan)


def _center_projective(sensor: SensorModel, size: tuple[int, int], alt_range: tuple[float, float]) -> Array:
    """Return the centre (3,) of the matrix (3, 4) from ground to image points: its null space (Hartley, DLT)."""
    image, alt = image_grid(size, alt_range)
    ecef = ecef_from_ground(sensor.localize(image, alt))
    if not np.isfinite(ecef).all():
        return np.full(3, np.nan)
    middle, spread = ecef.mean(axis=0), float(ecef.std())
    world = np.column_stack([(ecef - middle) / spread, np.ones(len(ecef))])
    col, row = ((image - image.mean(axis=0)) / image.std()).T
    zero = np.zeros_like(world)
    system = np.concatenate(
        [np.hstack([world, zero, -col[:, None] * world]), np.hstack([zero, world, -row[:, None] * world])]
    )
    matrix = np.linalg.svd(np.linalg.qr(system)[1])[2][-1].reshape(3, 4)
    return np.asarray(middle - spread * np.linalg.solve(matrix[:, :3], matrix[:, 3]))


def _center_nominal(
    sensor: SensorModel, size: tuple[int, int], alt_range: tuple[float, float], regressed: float
) -> CameraCenter:
    """Return the centre on the central ray at the nominal altitude, where the one regressed is at none plausible."""
    middle = sensor.localize(np.array(size) / 2.0, np.array(alt_range[0]))
    if not np.isfinite(regressed) and not np.isfinite(middle).all():
        raise RpcError("camera centre: the model has no ground point at its image's centre")
    image = np.array([(size[0] - 1) / 2, (size[1] - 1) / 2])
    origin, direction = lines_of_sight(sensor, image, alt_range)
    cosine = max(float(direction @ enu_basis(ground_from_ecef(origin))[2]), 0.3)
    point = origin
    for _ in range(6):  # the Earth curves away: a few steps along the ray reach the altitude
        point = point + (NOMINAL_ALTITUDE - float(ground_from_ecef(point)[2])) / cosine * direction
    return CameraCenter(np.asarray(point), float(ground_from_ecef(point)[2]), "nominal")


def epipolar_offset(
    sensor_a: SensorModel,
    sensor_b: SensorModel,
    image_a: Array,
    image_b: Array,
    alt: float | npt.ArrayLike = 0.0,
    steps: int = 6,
) -> tuple[Array, Array]:
    """Return the distances of matches from their epipolar lines: the part of a mismatch that no altitude explains.

    The altitude that brings the ray of a nearest to the point in b is found by Gauss-Newton along the
    ray; the signed distance that is left, across the epipolar line, is the offset.

    Parameters
    ----------
    image_a, image_b : (N, 2), col, row [px] of the matches
    alt : float or (N,), first guess of the altitude [m]

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


_LAST_STEP = 1e-3  # m: intersections are quadratic, so that the next would be below 1e-9


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
