"""Agile satellites on circular orbits: pushbroom cameras that look at a place from where asked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barpc.geodesy import Array, ecef_from_ground, enu_basis
from barpc.sensor.curve import Curve
from barpc.sensor.pushbroom import Pushbroom

GM = 3.986004418e14
"""Gravitational constant of the Earth (WGS84) [m^3/s^2]."""
EARTH_RATE = 7.292115e-5
"""Rotation of the Earth (WGS84) [rad/s]."""
PITCH = 10.0
"""Views of one site are spread from -PITCH to +PITCH degrees of incidence along the flight."""
ROLL = 8.0
"""Largest incidence across the flight [deg]."""
_DEGREE = 4  # of the polynomials of time for position and attitude
_NODES = 9  # times at which the guided motion is sampled for them


@dataclass(frozen=True)
class Look:
    """Where a satellite stands and how it scans.

    Parameters
    ----------
    incidence : float
        Angle between the local vertical at the target and the direction to the satellite [deg].
    azimuth : float
        Azimuth of the direction from the target to the satellite, clockwise from north [deg].
    altitude : float
        Of the satellite above the ellipsoid [m].
    heading : float
        Direction of flight at the target, clockwise from north [deg]; 192 is a descending sun-synchronous
        pass in middle latitudes.
    scan : float or None
        Direction in which the rows advance over the ground, clockwise from north [deg]; None: the heading.
    """

    incidence: float = 0.0
    azimuth: float = 90.0
    altitude: float = 694e3
    heading: float = 192.0
    scan: float | None = None


def looks(count: int, turn: float = 0.0, altitude: float = 694e3) -> list[Look]:
    """So many looks at one place: pitch spread evenly, roll by the golden section.

    Parameters
    ----------
    count : int
        Number of views.
    turn : float
        Start of the sequence of rolls, in turns.
    altitude : float
        Of the satellites above the ellipsoid [m].

    Returns
    -------
    looks : list of Look
    """
    flight = Look().heading
    out = []
    for k in range(count):
        pitch = PITCH * (2 * k / (count - 1) - 1.0) if count > 1 else 0.0
        roll = ROLL * (2 * ((turn + 0.5 + 0.381966 * k) % 1.0) - 1.0)
        tangent = np.tan(np.radians([pitch, roll]))
        incidence = float(np.degrees(np.arctan(np.hypot(*tangent))))
        azimuth = (flight + np.degrees(np.arctan2(tangent[1], tangent[0]))) % 360.0
        out.append(Look(incidence, float(azimuth), altitude))
    return out


def standpoint(target: Array, look: Look) -> Array:
    """Where the satellite of `look` stands.

    Parameters
    ----------
    target : (3,)
        lon, lat [deg], alt [m].
    look : Look
        Incidence, azimuth and altitude.

    Returns
    -------
    ecef : (3,)
        [m]; on the line of sight, at a distance from the Earth's centre of the local radius + altitude.
    """
    incidence, azimuth = np.radians([look.incidence, look.azimuth])
    enu = np.array(
        [np.sin(incidence) * np.sin(azimuth), np.sin(incidence) * np.cos(azimuth), np.cos(incidence)]
    )
    origin, direction = ecef_from_ground(target), enu @ enu_basis(target)
    foot = ecef_from_ground(np.array([target[0], target[1], 0.0]))
    along = origin @ direction
    radius = np.linalg.norm(foot) + look.altitude
    return np.asarray(origin + direction * (np.sqrt(along**2 + radius**2 - origin @ origin) - along))


def fly(target: Array, look: Look, size: tuple[int, int], gsd: float) -> Pushbroom:
    """A pushbroom camera that scans a target from a circular orbit.

    The orbit is a circle in the inertial frame, seen from the turning Earth. The attitude follows the scan:
    the line of sight of the middle of the detector moves over the ground in the direction of scan at `gsd` a
    line, the detector line stands across it, and columns run to the LEFT of the scan (for a descending pass
    north is up and east is right). Both are polynomials of time of degree 4.

    Parameters
    ----------
    target : (3,)
        Ground point at the image's centre; lon, lat [deg], alt [m].
    look : Look
        Where the satellite stands.
    size : tuple of int
        Width, height of the image [px].
    gsd : float
        Ground sampling distance at nadir [m]; the pixel's angle is gsd / altitude.

    Returns
    -------
    sensor : Pushbroom
    """
    place = standpoint(target, look)
    enu = enu_basis(target)
    heading = np.radians(look.heading)
    scan = heading if look.scan is None else np.radians(look.scan)
    radial = place / np.linalg.norm(place)
    forward = np.array([np.sin(heading), np.cos(heading), 0.0]) @ enu
    forward -= (forward @ radial) * radial
    forward /= np.linalg.norm(forward)

    radius = float(np.linalg.norm(place))
    rate = np.sqrt(GM / radius**3)
    period = gsd / (rate * float(np.linalg.norm(ecef_from_ground(target))))
    half = 0.5 * (size[1] - 1) * period
    margin = 0.1 * half + 8 * period
    times = (half + margin) * np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)[::-1]

    position = _circle(radius, radial, forward, rate, times)
    along = np.array([np.sin(scan), np.cos(scan), 0.0]) @ enu
    aim = ecef_from_ground(target) + (gsd / period) * times[:, None] * along
    mount, attitude = _guided(aim - position, along)
    start, stop = -half - margin, half + margin
    return Pushbroom(
        orbit=_polynomial(times, position, start, stop),
        attitude=_polynomial(times, attitude, start, stop),
        mount=mount,
        look=np.array([[0.0, 0.0], [0.0, -gsd / look.altitude]]),
        look_origin=0.5 * (size[0] - 1),
        line_period=period,
        first_line=-half,
    )


def _circle(radius: float, radial: Array, forward: Array, rate: float, times: Array) -> Array:
    """ECEF positions (N, 3) on a circular inertial orbit, at `radial` at time 0 and flying `forward`."""
    phase, turn = rate * times, -EARTH_RATE * times
    x, y, z = radius * (np.cos(phase) * radial[:, None] + np.sin(phase) * forward[:, None])
    return np.stack([np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y, z], axis=1)


def _guided(sight: Array, along: Array) -> tuple[Array, Array]:
    """Axes in the middle (3, 3) and rotation vectors from there (N, 3) of cameras that look along `sight`."""
    z = sight / np.linalg.norm(sight, axis=1, keepdims=True)
    y = np.cross(z, along)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    axes = np.stack([np.cross(y, z), y, z], axis=2)
    middle = axes[len(axes) // 2]
    return middle, _rotation_vectors(middle.T @ axes)


def _rotation_vectors(matrices: Array) -> Array:
    """Rotation vectors (N, 3) [rad] of rotations (N, 3, 3) well below half a turn."""
    odd = np.stack(
        [
            matrices[:, 2, 1] - matrices[:, 1, 2],
            matrices[:, 0, 2] - matrices[:, 2, 0],
            matrices[:, 1, 0] - matrices[:, 0, 1],
        ],
        axis=1,
    )
    sine = 0.5 * np.linalg.norm(odd, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(matrices, axis1=1, axis2=2) - 1.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        return odd * np.where(sine > 1e-12, 0.5 * angle / sine, 0.5)[:, None]


def _polynomial(times: Array, values: Array, start: float, stop: float) -> Curve:
    """The least-squares polynomial of degree 4 through values (N, 3) at times (N,)."""
    scale = stop - start
    basis = np.vander((times - start) / scale, _DEGREE + 1, increasing=True)
    coeffs = np.linalg.lstsq(basis, values, rcond=None)[0]
    return Curve.polynomial(coeffs / scale ** np.arange(_DEGREE + 1)[:, None], start, stop)
