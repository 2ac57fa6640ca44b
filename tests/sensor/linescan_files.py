"""Metadata of pushbroom images as Maxar and Airbus write them, of simulated flights.

Written from the public guides; what they mean is worked out here once more, without barpc's cameras: `Truth` knows
the attitude between the samples, meets the ellipsoid by bisection, and bends light in the inertial frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from barpc.base.geodesy import Array, ecef_from_ground, ground_from_ecef
from barpc.sensor.linescan import read_linescan
from barpc.sensor.pushbroom import Pushbroom
from barpc.sensor.samples import Linescan
from barpc.simulate import Look, fly

START = np.datetime64("2026-05-07T23:59:59.250000", "ns")
"""Time of row 0: the image goes on into the next day."""
SIZE = (4000, 20000)
STEP = 0.02
PITCH = 0.008


def read(folder: Path, text: str, **choices: object) -> Linescan:
    """The camera of a document."""
    path = folder / "metadata.xml"
    path.write_text(text)
    return read_linescan(path, **choices)


def words(values: Array) -> str:
    """Numbers as text, to the bit."""
    return " ".join(map(repr, map(float, values)))


def stamp(seconds: float) -> str:
    """UTC text, to the nanosecond, of seconds after START."""
    return f"{START + np.timedelta64(round(seconds * 1e9), 'ns')}Z"


@dataclass
class Flight:
    """What both vendors are told: one scan, sampled; the fields are what a test may vary."""

    lon: float = 10.0
    lat: float = 45.0
    size: tuple[int, int] = SIZE
    look: Look = field(default_factory=lambda: Look(25.0, 100.0))
    swing: float = 2e-6  # rad, at 2 Hz, about all axes

    def __post_init__(self) -> None:
        self.sensor = fly(np.array([self.lon, self.lat, 0.0]), self.look, self.size, 0.5)
        self.period = self.sensor.line_period
        count = int((self.size[1] - 1) * self.period / STEP) + 6
        self.times = np.round((np.arange(count) - 2) * STEP, 9)
        since = self.times + self.sensor.first_line
        self.positions, self.velocities = (part.T for part in self.sensor.orbit(since))
        self.body = self.attitude(self.times)

    def attitude(self, time: Array) -> Rotation:
        """The true attitude, ecef_from_camera, at times from row 0."""
        wobble = self.swing * np.sin(4 * np.pi * time)[:, None] * [1.0, -1.0, 0.5]
        turns = self.sensor.attitude(time + self.sensor.first_line)[0].T + wobble
        return Rotation.from_matrix(self.sensor.mount) * Rotation.from_rotvec(turns)


@dataclass
class Truth:
    """Where pixels look, from samples alone."""

    flight: Flight
    inside: Callable[[Array], Array]  # (N,) columns -> (N, 3) directions in the camera
    turn: Callable[[Array], Rotation]  # attitude at times

    def sight(self, image: Array) -> tuple[Array, Array]:
        """Places and seen directions (N, 3) of image points."""
        time = image[:, 1] * self.flight.period
        origin = self.flight.sensor.orbit(time + self.flight.sensor.first_line)[0].T
        direction = self.turn(time).apply(self.inside(image[:, 0]))
        return origin, direction / np.linalg.norm(direction, axis=1, keepdims=True)

    def ground(self, image: Array, alt: float) -> Array:
        """Ground points (N, 3) on straight lines of sight."""
        out = []
        for o, d in zip(*self.sight(image), strict=True):
            far = brentq(lambda s, o=o, d=d: ground_from_ecef(o + s * d)[2] - alt, 3e5, 1.2e6, xtol=1e-7)
            out.append(ground_from_ecef(o + far * d))
        return np.array(out)

    def misses(self, model: Pushbroom, image: Array, alt: float = 500.0) -> float:
        """How far off [px] a model sees the ground points of image points, at most."""
        return float(np.abs(model.project(self.ground(image, alt)) - image).max())


def inertial_sight(ground: Array, origin: Array, velocity: Array) -> Array:
    """The direction (3,) in which a camera sees a point: the axes stand still as ECEF does when the light arrives."""
    rate, c = np.array([0.0, 0.0, 7.292115e-5]), 299792458.0
    point = ecef_from_ground(ground)
    late = np.linalg.norm(point - origin) / c
    for _ in range(3):
        left = Rotation.from_rotvec(-rate * late).apply(point)  # where the point was when the light left it
        late = np.linalg.norm(left - origin) / c
    away = (left - origin) / np.linalg.norm(left - origin) + (velocity + np.cross(rate, origin)) / c
    return np.asarray(away / np.linalg.norm(away))


def isd(
    flight: Flight,
    angle: float = 0.0,
    along: float = 0.0,
    camera: Rotation | None = None,
) -> tuple[str, Truth]:
    """Maxar's XML, of a detector turned by `angle` [deg] and `along` [mm] before the axis, in a turned camera."""
    distance = PITCH * flight.look.altitude / 0.5
    across = PITCH * flight.sensor.look_origin
    camera = camera or Rotation.identity()
    body = (flight.body * camera.inv()).as_quat()
    body[::3] *= -1  # the same rotations
    cov, eph = [4e-12, 0, 0, 0, 3e-12, 0, 0, 2e-12, 0, 3e-12], [0.01, 0, 0, 0.02, 0, 0.03]
    n = range(len(flight.times))
    tables = {
        "EPH": [[k + 1, *flight.positions[k], *flight.velocities[k], *eph] for k in n],
        "ATT": [[k + 1, *body[k], *cov] for k in n],
    }
    parts = []
    for part, rows in tables.items():
        tag = {"EPH": "EPHEMLIST", "ATT": "ATTLIST"}[part]
        lines = "\n".join(f"<{tag}>{words(row)}</{tag}>" for row in rows)
        parts.append(
            f"<{part}><STARTTIME>{stamp(flight.times[0])}</STARTTIME><NUMPOINTS>{len(rows)}</NUMPOINTS>"
            f"<TIMEINTERVAL>{STEP}</TIMEINTERVAL><{tag}List>\n{lines}\n</{tag}List></{part}>"
        )
    last = flight.size[1]
    quaternion = "".join(f"<QCS{k + 1}>{v!r}</QCS{k + 1}>" for k, v in enumerate(map(float, camera.as_quat())))
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<isd><IMD><PRODUCTLEVEL>LV1B</PRODUCTLEVEL><BANDID>P</BANDID>
<NUMROWS>{flight.size[1]}</NUMROWS><NUMCOLUMNS>{flight.size[0]}</NUMCOLUMNS>
<IMAGE><SATID>WV03</SATID><SCANDIRECTION>Forward</SCANDIRECTION><TLCTIME>{stamp(0)}</TLCTIME><NUMTLC>2</NUMTLC>
<TLCLISTList><TLCLIST>0.0 0.0</TLCLIST><TLCLIST>{last}.0 {last * flight.period!r}</TLCLIST></TLCLISTList>
<FIRSTLINETIME>{stamp(0)}</FIRSTLINETIME><AVGLINERATE>{1 / flight.period!r}</AVGLINERATE></IMAGE></IMD>
{"".join(parts)}
<GEO><PRINCIPAL_DISTANCE><PD>{distance!r}</PD></PRINCIPAL_DISTANCE>
<OPTICAL_DISTORTION><POLYORDER>-1</POLYORDER></OPTICAL_DISTORTION>
<PERSPECTIVE_CENTER><CX>0.0</CX><CY>0.0</CY><CZ>0.0</CZ></PERSPECTIVE_CENTER>
<CAMERA_ATTITUDE>{quaternion}</CAMERA_ATTITUDE>
<DETECTOR_MOUNTING><BAND_P><BANDID>P</BANDID><DETECTOR_ARRAY><DETARRID>1</DETARRID><DETORIGINX>{along}</DETORIGINX>
<DETORIGINY>{across!r}</DETORIGINY><DETROTANGLE>{angle}</DETROTANGLE><DETPITCH>{PITCH}</DETPITCH></DETECTOR_ARRAY></BAND_P>
</DETECTOR_MOUNTING></GEO></isd>
"""
    turn = np.radians(angle)

    def inside(col: Array) -> Array:
        x, y = along + col * PITCH * np.sin(turn), across - col * PITCH * np.cos(turn)
        return np.stack([x, y, np.full_like(x, distance)], axis=1)

    return text, Truth(flight, inside, flight.attitude)


def dimap(flight: Flight, first_col: int = 31, poly: bool = True, unit: float = 1e-3) -> tuple[str, Truth]:
    """Airbus' XML, the attitude as a polynomial (Pleiades) or as samples (Neo), line period in `unit` [s]."""
    points = "".join(
        f"<Point><TIME>{stamp(t)}</TIME><LOCATION_XYZ>{words(p)}</LOCATION_XYZ>"
        f"<VELOCITY_XYZ>{words(v)}</VELOCITY_XYZ></Point>"
        for t, p, v in zip(flight.times, flight.positions, flight.velocities, strict=True)
    )
    q = flight.body.as_quat(scalar_first=True)
    q *= np.sign(q @ q[0])[:, None]
    lasts = flight.size[1] * flight.period
    midnight = float((START - START.astype("datetime64[D]")) / np.timedelta64(1, "s"))
    coeffs = np.polynomial.polynomial.polyfit((flight.times - lasts / 2) / lasts, q, 3)
    if poly:
        tables = "".join(
            f"<Q{k}><DEGREE>3</DEGREE><COEFFICIENTS>{words(coeffs[:, k])}</COEFFICIENTS></Q{k}>" for k in range(4)
        )
        attitude = (
            f"<Polynomial_Quaternions><OFFSET>{midnight + lasts / 2!r}</OFFSET><SCALE>{lasts!r}</SCALE>{tables}"
            "</Polynomial_Quaternions>"
        )
    else:
        tables = "".join(
            f"<Quaternion><TIME>{stamp(t)}</TIME>{''.join(f'<Q{k}>{float(v)!r}</Q{k}>' for k, v in enumerate(row))}"
            "</Quaternion>"
            for t, row in zip(flight.times, q, strict=True)
        )
        attitude = f"<Quaternion_List>{tables}</Quaternion_List>"
    step = 0.5 / flight.look.altitude
    begin = -step * (flight.sensor.look_origin + first_col - 1)
    angles = (
        f"<Polynomial_Look_Angles><XLOS_0>{begin!r}</XLOS_0><XLOS_1>{step!r}</XLOS_1><YLOS_0>0.003</YLOS_0>"
        "</Polynomial_Look_Angles>"
    )
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<Dimap_Document><Metadata_Identification><METADATA_PROFILE>PHR_SENSOR</METADATA_PROFILE></Metadata_Identification>
<Raster_Data><Raster_Dimensions><NROWS>{flight.size[1]}</NROWS><NCOLS>{flight.size[0]}</NCOLS></Raster_Dimensions>
</Raster_Data><Geometric_Data><Refined_Model>
<Time><Time_Range><START>{stamp(0)}</START><END>{stamp(lasts)}</END></Time_Range>
<Time_Stamp><LINE_PERIOD>{flight.period / unit!r}</LINE_PERIOD></Time_Stamp></Time>
<Ephemeris><EPHEMERIS_USED>CORRECTED</EPHEMERIS_USED><Point_List>{points}</Point_List></Ephemeris>
<Attitudes>{attitude}</Attitudes>
<Geometric_Calibration><Instrument_Calibration><Swath_Range><FIRST_COL>{first_col}</FIRST_COL></Swath_Range>
{angles}</Instrument_Calibration></Geometric_Calibration></Refined_Model></Geometric_Data></Dimap_Document>
"""

    def inside(col: Array) -> Array:
        psi_x = begin + step * (col + first_col - 1)
        return np.stack([np.full_like(col, 0.003), -psi_x, np.ones_like(col)], axis=1)

    def turn(time: Array) -> Rotation:
        powers = np.polynomial.polynomial.polyval((time - lasts / 2) / lasts, coeffs)
        return Rotation.from_quat(powers.T, scalar_first=True)

    return text, Truth(flight, inside, turn if poly else flight.attitude)
