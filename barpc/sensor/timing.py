"""Common geometry of radars: the range-Doppler circle of a pixel, the look side, and timing corrections.

The points of one range and one Doppler lie on a circle about the line of flight. Their errors are an
offset and a slope of range and azimuth time along the flight, no attitude.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.polynomial import polynomial

from barpc.base.errors import RpcError
from barpc.base.frozen import Frozen
from barpc.base.geodesy import NEWTON_STEPS, NEWTON_TOLERANCE, Array, ground_from_ecef, pointwise, up, wrap_longitude
from barpc.sensor import Behind, Pointwise
from barpc.sensor.curve import Curve, cross


def dot(a: Array, b: Array) -> Array:
    """Return the dot products (N,) of vectors (3, N)."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def aside(position: Array, velocity: Array, right: bool) -> Array:
    """Return the vectors (3, N) across the track, to its right or left."""
    across = cross(velocity, position)
    return across if right else -across


def on_circle(
    position: Array, velocity: Array, distance: Array, alt: Array, right: bool, ahead: Array | float = 0.0
) -> tuple[Array, Array]:
    """Return the points of a circle that have a given altitude: Newton on the look angle.

    Parameters
    ----------
    position, velocity : (3, N), of the radar [m, m/s], ECEF
    distance : (N,), from the radar [m]
    alt : (N,), [m above the ellipsoid]
    right : the side of the track
    ahead : (N,), cosine of the angle between flight and line of sight; 0 at zero Doppler

    Returns
    -------
    ground : (N, 3), lon, lat [deg], alt [m]; NaN where the range does not reach
    sight : (3, N), unit vectors to the radar
    """
    forward = ahead * velocity / np.sqrt(dot(velocity, velocity))
    span = np.sqrt(1.0 - np.square(ahead))
    across = aside(position, velocity, right)
    across /= np.sqrt(dot(across, across))
    above = position * dot(velocity, velocity) - velocity * dot(velocity, position)
    above /= np.sqrt(dot(above, above))
    height = ground_from_ecef(position.T)[:, 2]
    radius = np.sqrt(dot(position, position)) - height + alt
    cosine = dot(position, position) + distance**2 - radius**2 + 2 * distance * dot(position, forward)
    angle = np.arccos(cosine / (2 * distance * span * dot(position, above)))

    def at(angle: Array) -> tuple[Array, Array]:
        away = span * (across * np.sin(angle) - above * np.cos(angle)) + forward
        return away, ground_from_ecef((position + distance * away).T)

    for _ in range(NEWTON_STEPS):
        _, ground = at(angle)
        turned = span * (across * np.cos(angle) + above * np.sin(angle))
        moved = (alt - ground[:, 2]) / dot(up(ground), turned)
        angle = angle + moved / distance
        if not (np.abs(moved).max(initial=0.0, where=np.isfinite(moved)) > NEWTON_TOLERANCE):
            break
    away, ground = at(angle)
    ground[~(np.abs(ground[:, 2] - alt) <= NEWTON_TOLERANCE)] = np.nan
    ground[:, 2] = alt
    return ground, -away


@dataclass(frozen=True, eq=False)
class Timing(Frozen):
    """Corrections of a radar's range and azimuth time: polynomials of the position along the flight.

    Parameters
    ----------
    coeffs : (D + 1, 2)
        Range [m] and azimuth time [s], one way, by the powers 1, u, u^2, ... of u = (along - offset) / scale.
    offset, scale : float, of the coordinate along the flight where u = 0, and from there to u = 1
    """

    coeffs: Array
    offset: float = 0.0
    scale: float = 1.0

    def __post_init__(self) -> None:
        self._array("coeffs", (None, 2), RpcError)
        if not (len(self.coeffs) and np.isfinite(self.offset) and np.isfinite(self.scale) and self.scale > 0):
            raise RpcError(f"timing: {len(self.coeffs)} terms, offset {self.offset}, scale {self.scale}")

    def at(self, along: Array) -> Array:
        """Return the range [m] and azimuth time [s] (2, N) that are added at coordinates (N,)."""
        return np.asarray(polynomial.polyval((along - self.offset) / self.scale, self.coeffs))

    def rate(self, along: Array) -> Array:
        """Return the derivative (2, N) of range and azimuth time by the coordinate."""
        slopes = polynomial.polyder(self.coeffs) / self.scale
        return np.asarray(polynomial.polyval((along - self.offset) / self.scale, slopes))


class Clocked(Pointwise, ABC):
    """Base of the radar models: they know where their beam comes from, and their clocks can be corrected.

    Their `_derivatives` are image points (n, 2) and d(image)/d(ground) (n, 2, 3), d(image)/d(range, azimuth time)
    (n, 2, 2), the coordinate along the flight (n,).
    """

    azimuth_axis: ClassVar[int]
    """The image coordinate that goes along the flight: 0 (col) or 1 (row)."""
    orbit: Curve
    size: tuple[int, int]
    alt_range: tuple[float, float]
    look: Literal["right", "left"]
    accuracy: tuple[float, float] | None
    """Stated standard deviations of range and of the position along the flight [m]."""
    _kind: ClassVar[str]
    _to_radar: Any

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.size) < 1 or not self.alt_range[0] <= self.alt_range[1]:
            raise RpcError(f"{self._kind}: size {self.size}, altitudes {self.alt_range}")
        if self.look not in ("right", "left"):
            raise RpcError(f"{self._kind}: look {self.look!r}, expected 'right' or 'left'")

    @property
    @abstractmethod
    def speed(self) -> float:
        """Speed of the flight in the middle of the image [m/s]."""

    @abstractmethod
    def timed(self, timing: Timing) -> Self:
        """Return the model with a timing, its coordinate in pixels, in place of its own."""

    def localize(self, image: Array, alt: Array) -> Array:
        """Localise image points (..., 2) [px] at altitudes (...) [m]: ground points (..., 3).

        On the circle of a pixel, Newton on the look angle until the point has the altitude. Longitudes run on across
        the antimeridian; NaN off the orbit's time span, far off the image, or where the range does not reach.
        """
        ground = super().localize(image, alt)
        with np.errstate(all="ignore"):
            ground[..., 0] = wrap_longitude(ground[..., 0], self._middle)
        return ground

    def to_radar(self, ground: Array) -> Array:
        """Return the vectors (..., 3) [m], ECEF, from points (..., 3) to the radar; NaN as `project`."""
        return pointwise(lambda part: [self._to_radar(part)], [(3,)], ground)[0]

    def timing_jacobian(self, ground: Array) -> tuple[Array, Array, Array, Array]:
        """Return image points (..., 2) [px] of ground points (..., 3), derivatives, the place along the flight.

        d(image)/d(ground) (..., 2, 3), d(image)/d(range, azimuth time) (..., 2, 2) [px/m, px/s], and (...) [px].
        """
        image, by_ground, by_timing, along = pointwise(self._derivatives, [(2,), (2, 3), (2, 2), ()], ground)
        return image, by_ground, by_timing, along

    @cached_property
    def _middle(self) -> float:
        """Longitude of the image's middle [deg]."""
        lon = float(super().localize(0.5 * np.array(self.size), np.array(np.mean(self.alt_range)))[0])
        return lon if np.isfinite(lon) else 0.0


@dataclass(frozen=True)
class Timed(Behind):
    """A radar model behind the correction of its clocks; itself a `SensorModel`."""

    sensor: Clocked  # the model as delivered
    correction: Timing  # its coordinate is the image's, along the flight [px]

    @cached_property
    def _model(self) -> Clocked:
        return self.sensor.timed(self.correction)

    def project(self, ground: Array) -> Array:
        """Project ground points (..., 3) [deg, deg, m] to image points (..., 2) [px]."""
        return self._model.project(ground)

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Return image points (..., 2) [px] and their derivatives (..., 2, 3) [px/deg, px/deg, px/m]."""
        return self._model.project_jacobian(ground)

    def localize(self, image: Array, alt: Array) -> Array:
        """Localise image points (..., 2) [px] at altitudes (...) [m]: ground points (..., 3)."""
        return self._model.localize(image, alt)

    def timing_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Return image points (..., 2) [px] and their derivative (..., 2, 2) by range and azimuth time."""
        image, _, by_timing, _ = self._model.timing_jacobian(ground)
        return image, by_timing
