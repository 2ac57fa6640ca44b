"""Agile satellites on circular orbits: pushbroom cameras that look at a place from where asked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyfit
from scipy.spatial.transform import Rotation

from barpc.geodesy import EARTH_RATE, Array, ecef_from_ground, enu_basis
from barpc.sensor.curve import Curve, about_middle
from barpc.sensor.pushbroom import Pushbroom

GM = 3.986004418e14  # gravitational constant of the Earth (WGS84) [m^3/s^2]
PITCH = 10.0  # views of one site are spread from -PITCH to +PITCH degrees of incidence along the flight
ROLL = 8.0  # largest incidence across the flight [deg]
_DEGREE = 4  # of the polynomials of time for position and attitude
_NODES = 9  # times at which the guided motion is sampled for them


@dataclass(frozen=True)
class Look:
    """Look direction, orbit and scan of a satellite."""

    incidence: float = 0.0  # angle between the vertical at the target and the satellite [deg]
    azimuth: float = 90.0  # of the satellite seen from the target, clockwise from north [deg]
    altitude: float = 694e3  # of the satellite above the ellipsoid [m]
    heading: float = 192.0  # of the flight [deg]; 192: a descending sun-synchronous pass in middle latitudes
    scan: float | None = None  # direction in which the rows advance over the ground [deg]; None: the heading


def looks(count: int, turn: float = 0.0, altitude: float = 694e3) -> list[Look]:
    """Return looks at one place: pitch spread evenly, roll by the golden section, which starts at `turn` [turns]."""
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


def fly(target: Array, look: Look, size: tuple[int, int], gsd: float) -> Pushbroom:
    """Return a pushbroom camera that scans a target from a circular orbit.

    The orbit is a circle in the inertial frame, seen from the turning Earth. The attitude follows the scan:
    the line of sight of the middle of the detector moves over the ground in the direction of scan at `gsd` a
    line, the detector line stands across it, and columns run to the LEFT of the scan (for a descending pass
    north is up and east is right). Both are polynomials of time of degree 4.

    Parameters
    ----------
    target : (3,), ground point at the image's centre; lon, lat [deg], alt [m]
    size : (width, height) [px]
    gsd : float, ground sampling distance at nadir [m]; the pixel's angle is gsd / altitude
    """
    place, aim, enu = _standpoint(target, look), ecef_from_ground(target), enu_basis(target)
    heading = np.radians(look.heading)
    along = _level(heading if look.scan is None else np.radians(look.scan)) @ enu
    rate = np.sqrt(GM / np.linalg.norm(place) ** 3)
    period = gsd / float(rate * np.linalg.norm(aim))
    half = 0.5 * (size[1] - 1) * period
    stop = 1.1 * half + 8 * period
    times = stop * np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)[::-1]

    position = _circle(place, _level(heading) @ enu, rate, times)
    z = aim + (gsd / period) * times[:, None] * along - position
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    y = np.cross(z, along)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    mount, vectors = about_middle(Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=2)))
    orbit, attitude = (
        Curve.polynomial(polyfit(times + stop, values, _DEGREE), -stop, stop) for values in (position, vectors)
    )
    look_angles = np.array([[0.0, 0.0], [0.0, -gsd / look.altitude]])
    return Pushbroom(orbit, attitude, mount, look_angles, 0.5 * (size[0] - 1), period, -half)


def _level(azimuth: float) -> Array:
    return np.array([np.sin(azimuth), np.cos(azimuth), 0.0])


def _standpoint(target: Array, look: Look) -> Array:
    """Return the satellite's position (3,) [m, ECEF]: on the line of sight, `altitude` beyond the radius at
    the target.
    """
    incidence, azimuth = np.radians([look.incidence, look.azimuth])
    enu = np.sin(incidence) * _level(azimuth) + [0.0, 0.0, np.cos(incidence)]
    origin, direction = ecef_from_ground(target), enu @ enu_basis(target)
    foot = ecef_from_ground(np.array([target[0], target[1], 0.0]))
    along = origin @ direction
    radius = np.linalg.norm(foot) + look.altitude
    return np.asarray(origin + direction * (np.sqrt(along**2 + radius**2 - origin @ origin) - along))


def _circle(place: Array, forward: Array, rate: float, times: Array) -> Array:
    """Return ECEF positions (N, 3) on a circular inertial orbit, at `place` at time 0 and flying `forward`."""
    forward = forward - (forward @ place) / (place @ place) * place
    forward *= np.linalg.norm(place) / np.linalg.norm(forward)
    inertial = np.outer(np.cos(rate * times), place) + np.outer(np.sin(rate * times), forward)
    return Rotation.from_rotvec(np.outer(-EARTH_RATE * times, [0.0, 0.0, 1.0])).apply(inertial)
