"""Where a radar sees a pixel: the points of one range and one Doppler lie on a circle about the line of flight."""

from __future__ import annotations

import numpy as np

from barpc.geodesy import NEWTON_STEPS, Array, ground_from_ecef, up
from barpc.sensor.curve import cross

_SETTLED = 1e-9  # rad, about a millimetre: what is left after such a step is below rounding


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
        step = (alt - ground[:, 2]) / (distance * dot(up(ground), turned))
        angle = angle + step
        if not (np.abs(step).max(initial=0.0, where=np.isfinite(step)) > _SETTLED):
            break
    away, ground = at(angle)
    ground[~(np.abs(ground[:, 2] - alt) <= 1e-6)] = np.nan
    ground[:, 2] = alt
    return ground, -away
