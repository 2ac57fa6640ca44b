"""Maxar's image support data (ISD): the physical model of Basic 1B images of WorldView, GeoEye and Legion.

EPHEMLIST and ATTLIST sample position, velocity and the quaternion ecef_from_body (scalar last) with their
covariances; IMD gives the time of lines (TLCLIST), GEO the camera: detector c stands at (DETORIGINX, DETORIGINY) +
c DETPITCH (sin a, -cos a) [mm] of the focal plane at PD, turned into the body by CAMERA_ATTITUDE.

Names and units are those of "Imagery Support Data (ISD) Documentation", v. 1.1.2, DigitalGlobe 2014.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from barpc.errors import InputError, RpcFormatError
from barpc.geodesy import Array
from barpc.sensor.document import MOST_PIXELS, STRAIGHT, Fields, seconds
from barpc.sensor.linescan.samples import Detector, Linescan, Samples, camera_of_samples, unit
from barpc.sensor.pushbroom import Light

ROOT, KIND = "isd", "maxar physical model"

_TABLES = {"EPH": (13, 7), "ATT": (15, 5)}  # numbers of a row: with covariances, without
_LIGHT = Light(aberration=True, refraction=True)  # star trackers tell where the body points


def camera_of_isd(root: Fields, band: str | None = None) -> tuple[Linescan, Light]:
    """Return the model of an ISD, and how light bends; RpcFormatError where it is damaged, InputError where `band` is
    none of its bands.
    """
    level = root.text("IMD/PRODUCTLEVEL")
    if "1B" not in level.upper():
        raise RpcFormatError(f"{root.name}: a product of level {level}, resampled: only 1B has a physical model")
    size = (int(root.positive("IMD/NUMCOLUMNS", MOST_PIXELS)), int(root.positive("IMD/NUMROWS", MOST_PIXELS)))
    period, first = _lines(root, size[1])
    (times, orbit), (ticks, attitude) = (_table(root, part, first) for part in _TABLES)
    body = Rotation.from_quat(unit(attitude[:, 1:5], root.name))
    camera = root.one("GEO/CAMERA_ATTITUDE")
    mounting = np.array([camera.number(f"QCS{k}") for k in (1, 2, 3, 4)])
    quaternions = (body * Rotation.from_quat(unit(mounting[None], root.name))).as_quat(scalar_first=True)
    arm = np.array([root.number(f"GEO/PERSPECTIVE_CENTER/C{axis}") for axis in "XYZ"])
    positions = orbit[:, 1:4]
    if arm.any():
        if not np.array_equal(times, ticks):
            raise RpcFormatError(f"{root.name}: PERSPECTIVE_CENTER with positions and attitudes of other times")
        positions = positions + body.apply(arm)
    samples = Samples(root.name, times, positions, orbit[:, 4:7], ticks, quaternions)
    detector = Detector(_look(root, band), 0.0, period, size)
    return camera_of_samples(samples, detector, _sigma(orbit, attitude)), _LIGHT


def _lines(root: Fields, rows: int) -> tuple[float, np.datetime64]:
    """Time from one row to the next [s], and the time of row 0."""
    image = root.one("IMD/IMAGE")
    table = np.array([row.numbers(".", 2) for row in image.all("TLCLISTList/TLCLIST")]).reshape(-1, 2)
    stated = int(image.positive("NUMTLC"))
    if len(table) != stated:
        raise RpcFormatError(f"{root.name}: TLCLIST holds {len(table)} of {stated} entries; is the file complete?")
    if stated == 1:
        rate = abs(image.number("AVGLINERATE"))
        rate = -rate if image.text("SCANDIRECTION").lower() == "reverse" else rate
        table = np.vstack([table, table[0] + [rate, 1.0]])
    (line, start), (stop_line, stop) = table[0], table[-1]
    period = (stop - start) / (stop_line - line) if stop_line != line else 0.0
    if not 0 < abs(period) < 1:
        raise RpcFormatError(f"{root.name}: TLCLIST gives {period:g} s a row")
    bent = np.abs(start + period * (table[:, 0] - line) - table[:, 1]).max() / abs(period)
    if not bent <= STRAIGHT:
        raise RpcFormatError(f"{root.name}: the line rate changes ({bent:.3g} rows in TLCLIST), which is not read")
    begins = start - period * line
    first = image.time("TLCTIME") + np.timedelta64(round(begins * 1e9), "ns")
    late = seconds(image.time("FIRSTLINETIME"), first) / period
    if not abs(late) <= 1:
        raise RpcFormatError(f"{root.name}: FIRSTLINETIME is {late:.4g} rows from TLCLIST's time of row 0")
    return period, first


def _table(root: Fields, part: str, epoch: np.datetime64) -> tuple[Array, Array]:
    """Return the times [s from the epoch] and rows of EPHEMLIST or ATTLIST."""
    of, tag = root.one(part), f"{part}{'EM' * (part == 'EPH')}LIST"
    stated = int(of.positive("NUMPOINTS"))
    rows = [row.numbers(".") for row in of.all(f"{tag}List/{tag}")]
    if len(rows) != stated:
        raise RpcFormatError(f"{root.name}: {tag} holds {len(rows)} of {stated} samples; is the file complete?")
    widths = {len(row) for row in rows}
    if len(widths) != 1 or not widths <= set(_TABLES[part]):
        raise RpcFormatError(
            f"{root.name}: rows of {tag} hold {', '.join(map(str, sorted(widths)))} numbers, expected "
            + " or ".join(map(str, _TABLES[part]))
        )
    table = np.array(rows)
    start = seconds(of.time("STARTTIME"), epoch)
    return start + of.positive("TIMEINTERVAL", 100.0) * (table[:, 0] - 1.0), table


def _look(root: Fields, band: str | None) -> Array:
    """Return the detector line in the focal plane, as `Pushbroom.look` of the column."""
    geo = root.one("GEO")
    if geo.number("OPTICAL_DISTORTION/POLYORDER") >= 0:
        raise RpcFormatError(f"{root.name}: an optical distortion polynomial, which is not read")
    bands = dict(_bands(geo))
    name = next(iter(bands), "") if band is None and len(bands) == 1 else (band or "").upper()
    if name not in bands:
        found = ", ".join(bands) or "none"
        raise InputError(f"{root.name}: which band's detector? give band=NAME of {found}")
    arrays = bands[name].all("DETECTOR_ARRAY")
    if len(arrays) != 1:
        raise RpcFormatError(f"{root.name}: band {name} of {len(arrays)} detector arrays, only one is read")
    array, distance = arrays[0], geo.positive("PRINCIPAL_DISTANCE/PD")
    angle, pitch = math.radians(array.number("DETROTANGLE")), array.positive("DETPITCH", 1.0)
    origin = [array.number("DETORIGINX"), array.number("DETORIGINY")]
    return np.column_stack([origin, [pitch * math.sin(angle), -pitch * math.cos(angle)]]) / distance


def _bands(geo: Fields) -> Iterator[tuple[str, Fields]]:
    for element in geo.one("DETECTOR_MOUNTING").element:
        if element.tag.startswith("BAND_"):
            yield element.tag.removeprefix("BAND_"), Fields(element, geo.name)


def _sigma(orbit: Array, attitude: Array) -> tuple[float, float] | None:
    """Return the standard deviations of an angle [rad] and of a coordinate [m] from upper triangles of
    covariances.

    A turn by the small angle w changes the quaternion by w / 2.
    """
    if orbit.shape[1] < _TABLES["EPH"][0] or attitude.shape[1] < _TABLES["ATT"][0]:
        return None
    turn = 4.0 * attitude[:, [5, 9, 12, 14]].sum(axis=1).mean() / 3.0
    place = orbit[:, [7, 10, 12]].sum(axis=1).mean() / 3.0
    return (math.sqrt(turn), math.sqrt(place)) if turn > 0 and place > 0 else None
