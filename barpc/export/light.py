"""When images were taken and where the sun stood then: by their files, by the user, by astronomy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from barpc.base.errors import InputError, UsageError, listed
from barpc.export.shots import Scene, Shot
from barpc.rpcio.acquisition import FIRST_YEAR


class UnknownTimeError(InputError):
    """The time of acquisition of some images is unknown, and the export needs it."""


def sun_angles(time: datetime, lon: float, lat: float) -> tuple[float, float]:
    """Return the elevation and azimuth, clockwise from north [deg], of the sun's centre, without refraction.

    Low precision of Meeus (Astronomical Algorithms, 2nd ed., 1998): chapters 25 (the sun), 22 (obliquity and nutation),
    12 (sidereal time), 13 (horizon), 40 (parallax); to 0.01 degrees of direction from 1990 to 2050. TT is taken for UT.
    """
    days = (time - datetime(2000, 1, 1, 12, tzinfo=UTC)).total_seconds() / 86400
    t = days / 36525
    anomaly, node = np.radians([357.52911 + 35999.05029 * t, 125.04 - 1934.136 * t])
    centre = (
        (1.914602 - 0.004817 * t) * np.sin(anomaly) + 0.019993 * np.sin(2 * anomaly) + 0.000289 * np.sin(3 * anomaly)
    )
    nutation = -0.00478 * np.sin(node)
    along = np.radians(280.46646 + 36000.76983 * t + centre - 0.00569 + nutation)
    tilt = np.radians(23.439291 - 0.0130042 * t + 0.00256 * np.cos(node))
    ascension = np.arctan2(np.cos(tilt) * np.sin(along), np.cos(along))
    sidereal = 280.46061837 + 360.98564736629 * days + nutation * np.cos(tilt)
    declination, hour, up = (
        np.arcsin(np.sin(tilt) * np.sin(along)),
        np.radians(sidereal + lon) - ascension,
        np.radians(lat),
    )
    east = -np.cos(declination) * np.sin(hour)
    north = np.sin(declination) * np.cos(up) - np.cos(declination) * np.sin(up) * np.cos(hour)
    zenith = np.sin(declination) * np.sin(up) + np.cos(declination) * np.cos(up) * np.cos(hour)
    elevation = np.degrees(np.arcsin(np.clip(zenith, -1, 1)))
    parallax = 0.00244 * np.hypot(east, north)  # the sun's, of an observer on the ground
    return float(elevation - parallax), float(np.degrees(np.arctan2(east, north)) % 360)


def moment(time: str | None) -> datetime | None:
    """Return a time as a file or `dated` states it; None of a day alone."""
    return datetime.fromisoformat(time) if time and "T" in time else None


def dated(scene: Scene, times: Sequence[str], dates: Sequence[str]) -> Scene:
    """Return a scene with the times and days that the user gives, ``[IMAGE=]2013-04-17[T10:36:44]`` in UTC.

    Those of an image count for it; those without are of all images whose files state none.

    Raises
    ------
    UsageError
        No time or day, one before satellites, or of no image of the scene.
    """
    given = dict(_given(scene, text, "--date", 10) for text in dates)
    given |= dict(_given(scene, text, "--time", None) for text in times)
    shots = []
    for shot in scene.shots:
        own, common = given.get(shot.name), given.get("")
        known = shot.light.time if own is None else None
        if known is None or (moment(known) is None and moment(common) is not None):
            known = own or common or known
        shots.append(replace(shot, light=replace(shot.light, time=known)))
    return replace(scene, shots=tuple(shots))


def _given(scene: Scene, text: str, flag: str, length: int | None) -> tuple[str, str]:
    """Return the image, or none, and the time in UTC that a flag states."""
    name, _, stated = text.rpartition("=")
    try:
        when = datetime.fromisoformat(stated)
        if (len(stated) == 10) != (length == 10) or when.year < FIRST_YEAR:
            raise ValueError
    except ValueError:
        wanted = "2013-04-17" if length else "2013-04-17T10:36:44"
        raise UsageError(f"{flag} {text}: is no {'day' if length else 'UTC time'} as {wanted}") from None
    if name and name not in (known := [shot.name for shot in scene.shots]):
        raise UsageError(f"{flag} {text}: no image {name}; there are {listed(known)}")
    utc = when if when.tzinfo is None else when.astimezone(UTC).replace(tzinfo=None)
    return name, stated if length else f"{utc.isoformat()}Z"


def require(shots: Sequence[Shot], what: str) -> None:
    """Raise UnknownTimeError, which names the flag, if there are shots."""
    if shots:
        flag = "--date YYYY-MM-DD" if what == "day" else "--time YYYY-MM-DDThh:mm:ss"
        raise UnknownTimeError(
            f"{listed([shot.name for shot in shots])}: no file states the {what} of acquisition; give {flag} (UTC)"
        )


def lit(scene: Scene, needed: bool = True) -> Scene:
    """Return a scene of which every shot has a time and the sun's angles: those stated, else computed.

    Where they are not `needed`, shots of an unknown time stay as they are.

    Raises
    ------
    UnknownTimeError
        The time of an image is unknown.
    InputError
        The sun was below the horizon then.
    """
    if needed:
        require([shot for shot in scene.shots if moment(shot.light.time) is None], "time")
    shots = []
    for shot in scene.shots:
        light = shot.light
        when = moment(light.time)
        if when is not None and (light.elevation is None or light.azimuth is None):
            lon, lat = scene.middle(shot)[:2]
            elevation, azimuth = sun_angles(when if when.tzinfo else when.replace(tzinfo=UTC), lon, lat)
            if elevation < 0:
                raise InputError(f"{shot.name}: taken {light.time}, {-elevation:.0f} degrees of sun below the horizon; "
                                 "--time gives the right time, in UTC")  # fmt: skip
            light = replace(light, elevation=round(elevation, 4), azimuth=round(azimuth, 4))
        shots.append(replace(shot, light=light))
    return replace(scene, shots=tuple(shots))
