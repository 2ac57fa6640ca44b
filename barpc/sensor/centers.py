"""The centre of any sensor model: where its rays meet, or where it says that it stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from barpc.base.errors import RpcError
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, ground_from_ecef
from barpc.sensor import SensorModel
from barpc.sensor.geometry import LEAST_RANGE, is_radar, lines_of_sight
from barpc.sensor.rpc import localize_stack
from barpc.sensor.sampler import image_grid

if TYPE_CHECKING:
    from barpc.sensor.radar import Radar

CenterMethod = Literal["line", "projective", "nominal", "stated"]

_RAYS = 41  # of a line
NOMINAL_ALTITUDE = 650e3  # orbit altitude [m] assumed where a model does not tell its own
PLAUSIBLE_ALTITUDE = (380e3, 1000e3)  # a camera centre regressed outside this range [m] is not believed


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
    number = [i for i, sensor in enumerate(sensors) if not is_radar(sensor)]
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
        if is_radar(sensor):
            found.append(_center_stated(sensor, size, alt_range))
        elif low <= altitude[i] <= high:
            found.append(CameraCenter(ecef[i], altitude[i], how))
        else:
            found.append(_center_nominal(sensor, size, alt_range, altitude[i]))
    return found


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
