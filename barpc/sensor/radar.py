"""Common geometry of radars: the range-Doppler circle of a pixel, and the look side.

The points of one range and one Doppler lie on a circle about the line of flight.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from barpc.base.errors import RpcError
from barpc.base.geodesy import NEWTON_TOLERANCE, Array, ground_from_ecef, newton, pointwise, up, wrap_longitude
from barpc.sensor import Pointwise
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

    def turned(angle: Array) -> Array:
        _, ground = at(angle)
        rise = dot(up(ground), span * (across * np.cos(angle) + above * np.sin(angle)))
        return angle + (alt - ground[:, 2]) / rise / distance

    away, ground = at(newton(turned, angle, NEWTON_TOLERANCE / distance)[0])
    ground[~(np.abs(ground[:, 2] - alt) <= NEWTON_TOLERANCE)] = np.nan
    ground[:, 2] = alt
    return ground, -away


class Radar(Pointwise):
    """Base of the radar models: they know where their beam comes from."""

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

    @cached_property
    def _middle(self) -> float:
        """Longitude of the image's middle [deg]."""
        lon = float(super().localize(0.5 * np.array(self.size), np.array(np.mean(self.alt_range)))[0])
        return lon if np.isfinite(lon) else 0.0
