"""The physical camera of SPOT 1 to 5 scenes of level 1A, from DIMAP 1 (``METADATA.DIM``).

As in CNES' "SPOT 123-4-5 Satellite Geometry Handbook" (S-NT-73-12-SI): position and velocity are Lagrange's polynomial
through the eight points of the ephemeris about the scene; Z points from the Earth's centre to the satellite, X = V x Z,
Y = Z x X. A detector looks along u = (-tan psi_y, tan psi_x, -1), turned by the attitude Rx(-pitch) Ry(-roll) Rz(yaw)
whose angles are linear in time. Line l (from 1) is taken at SCENE_CENTER_TIME + LINE_PERIOD (l - SCENE_CENTER_LINE).

SPOT 5 states corrected attitudes and the look angles of each detector. SPOT 1 to 4 state those of the first and the
last detector (between them the angles are linear: a mirror turns the view), and raw attitudes, which the producer's own
corners leave out, and so does the model unless they are asked for: the angle at the start, and the speeds integrated.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
from numpy.polynomial.polynomial import polyfit, polyval

from barpc.base.errors import InputError, RpcFormatError
from barpc.base.geodesy import Array
from barpc.sensor.curve import EXTRAPOLATION
from barpc.sensor.document import MOST_PIXELS, XmlFields, seconds, table_of
from barpc.sensor.samples import ATTITUDE_STEP, Detector, Linescan, Samples, camera_of_samples, check_times

SCENE = "Dataset_Sources/Source_Information/Scene_Source"
"""Where DIMAP 1 says what took an image; DIMAP 2 has no such part."""

_PRODUCT_LEVEL = re.compile(r"(?<!\d)(1A|1B|2A|2B|3|ORTHO)(?![0-9A-Z])")
_LEVEL_PLACES = (
    "Data_Processing/PROCESSING_LEVEL",
    "Metadata_Id/METADATA_PROFILE",
    "Data_Processing/GEOMETRIC_PROCESSING",
)
_EPHEMERIS_POINTS = 8  # of the ephemeris
_LONGEST_PERIOD = 0.1  # s; 0.0004 to 0.003 are usual
_LARGEST_ATTITUDE = 0.5  # rad: of an attitude; 0.07 are usual (yaw steering)
_LOOK_DEGREES, _LOOK_MISFIT = range(1, 9), 1e-4  # px: the lowest degree of the tangents that is truer is taken
_LEAST_PIXEL = 1e-7  # rad; 3e-6 is the least of SPOT 5
_LOOK_STEP = 2.0  # px: look angles farther from a polynomial are no line of detectors
_LOCATION = {True: (30 / 8.3e5, 1.0), False: (350 / 8.3e5, 10.0)}  # rad, m: sigma without GCPs of SPOT 5, of 1 to 4
_NAVIGATION_FROM_CAMERA = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def is_scene(root: XmlFields) -> bool:
    """Return whether a document is of DIMAP 1, of whatever satellite and level."""
    return root.element.tag == "Dimap_Document" and root.element.find(SCENE) is not None


def camera_of_scene(root: XmlFields, band: str | None = None, attitudes: str | None = None) -> Linescan:
    """Return the model of a SPOT 1A scene, and the corners that its producer states.

    `band`: BAND_INDEX whose detectors are taken, the first one by default. `attitudes`: "raw" takes SPOT 1 to 4's.
    InputError for choices that the scene does not have; RpcFormatError for another satellite or level, and for a part
    that is missing, by its name.
    """
    five = _is_spot_5(root)
    if attitudes is not None and (five or attitudes != "raw"):
        raise InputError(f"{root.name}: attitudes={attitudes}: the choice is raw, of SPOT 1 to 4")
    strip, size = root.one("Data_Strip"), root.one("Raster_Dimensions").size("NCOLS", "NROWS")
    stamp = strip.one("Sensor_Configuration/Time_Stamp")
    period = stamp.positive("LINE_PERIOD", _LONGEST_PERIOD)
    before = round(period * (stamp.positive("SCENE_CENTER_LINE", MOST_PIXELS) - 1.0) * 1e9)
    first = stamp.time("SCENE_CENTER_TIME") - np.timedelta64(before, "ns")
    last = period * (size[1] - 1)
    ticks = np.arange(-EXTRAPOLATION, last + EXTRAPOLATION + ATTITUDE_STEP, ATTITUDE_STEP)
    states = _ephemeris(strip, first, last, ticks)
    angles = np.zeros((len(ticks), 3))
    if five or attitudes:
        times, sampled = (_corrected if five else _raw)(strip.one("Satellite_Attitudes"), first)
        inside = np.clip((0.0, last), times[0], times[-1]) if len(times) else np.zeros(2)  # real lists begin late
        held = np.abs(inside - (0.0, last)).max() <= EXTRAPOLATION  # the first and the last are held so long
        check_times(times, (inside[0], inside[1]) if held else (0.0, last), "attitudes", root.name)
        if not (np.abs(sampled) < _LARGEST_ATTITUDE).all():
            raise RpcFormatError(f"{root.name}: an attitude of {np.abs(sampled).max():.3g} rad; are these radians?")
        angles = np.stack([np.interp(ticks, times, one) for one in sampled.T], axis=1)
    quaternions = _ecef_from_camera(states, angles)
    samples = Samples(root.name, ticks, states[:, :3], states[:, 3:], ticks, quaternions)
    detector = Detector(_look(strip, band, size[0]), (size[0] - 1) / 2, period, size)
    found = camera_of_samples(samples, detector, _LOCATION[five])
    stated = table_of(root.all("Dataset_Frame/Vertex"), ("FRAME_LON", "FRAME_LAT", "FRAME_COL", "FRAME_ROW"))
    return found if attitudes or not len(stated) else replace(found, corners=stated - [0.0, 0.0, 1.0, 1.0])


def _is_spot_5(root: XmlFields) -> bool:
    """Return whether a scene is SPOT 5's; RpcFormatError for another satellite than SPOT 1 to 5, or level than 1A."""
    name = " ".join(root.one(SCENE).element.findtext(tag, "").strip() for tag in ("MISSION", "MISSION_INDEX")).strip()
    mission = re.fullmatch(r"SPOT[ -]*([1-5])( \1)?", name, re.IGNORECASE)
    if mission is None:
        raise RpcFormatError(f"{root.name}: a scene of {name or 'no MISSION'}; of DIMAP 1 only SPOT 1 to 5 are read")
    stated = (_PRODUCT_LEVEL.search(root.element.findtext(where, "").upper()) for where in _LEVEL_PLACES)
    level = next((found[1] for found in stated if found), "1A")
    if level != "1A":
        raise RpcFormatError(f"{root.name}: a scene of level {level}, resampled: only 1A has a physical model")
    return mission[1] == "5"


def _ephemeris(strip: XmlFields, first: np.datetime64, last: float, ticks: Array) -> Array:
    """Return positions and velocities (N, 6) [m, m/s], ECEF, at times (N,) [s from row 0]."""
    tags = [f"{what}/{axis}" for what in ("Location", "Velocity") for axis in "XYZ"]
    times, points = _listed_values(strip, "Ephemeris/Points/Point", tags, first)
    check_times(times, (0.0, last), "positions", strip.name)
    near = np.sort(np.abs(times - last / 2).argsort(kind="stable")[:_EPHEMERIS_POINTS])
    middle, half = times[near].mean(), np.ptp(times[near]) / 2
    coeffs = polyfit((times[near] - middle) / half, points[near], len(near) - 1)
    return np.asarray(polyval((ticks - middle) / half, coeffs)).T


def _listed_values(part: XmlFields, path: str, tags: list[str], first: np.datetime64) -> tuple[Array, Array]:
    """Return the times (N,) [s from row 0], ascending, and numbers (N, K) of the samples that are in range."""
    usable = [one for one in part.all(path) if one.element.findtext("OUT_OF_RANGE", "").strip().upper() != "Y"]
    times = np.array([seconds(one.time("TIME"), first) for one in usable])
    order = times.argsort(kind="stable")
    return times[order], table_of(usable, tags)[order]


_ANGLES = ["YAW", "PITCH", "ROLL"]


def _corrected(attitudes: XmlFields, first: np.datetime64) -> tuple[Array, Array]:
    """Return the times and angles (N, 3) of SPOT 5 [rad]."""
    return _listed_values(attitudes.one("Corrected_Attitudes"), ".//Angles", _ANGLES, first)


def _raw(attitudes: XmlFields, first: np.datetime64) -> tuple[Array, Array]:
    """Return the times and angles (N, 3) of SPOT 1 to 4 [rad]: the first angles, and speeds integrated from there."""
    aocs = attitudes.one("Raw_Attitudes/Aocs_Attitude")
    at, angles = _listed_values(aocs, "Angles_List/Angles", _ANGLES, first)
    times, speeds = _listed_values(aocs, "Angular_Speeds_List/Angular_Speeds", _ANGLES, first)
    if not (len(at) and len(times)):
        raise RpcFormatError(f"{attitudes.name}: Aocs_Attitude without Angles, or without Angular_Speeds, in range")
    steps = (speeds[1:] + speeds[:-1]) / 2 * np.diff(times)[:, None]
    turned = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    begun = [np.interp(at[0], times, one) for one in turned.T]
    return times, angles[0] + turned - begun


def _ecef_from_camera(states: Array, angles: Array) -> Array:
    """Return quaternions (N, 4), scalar first, of states (N, 6) and yaw, pitch, roll (N, 3) [rad]."""
    from scipy.spatial.transform import Rotation

    up = states[:, :3] / np.linalg.norm(states[:, :3], axis=1, keepdims=True)
    across = np.cross(states[:, 3:], up)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    frame = Rotation.from_matrix(np.stack([across, np.cross(up, across), up], axis=2))
    turned = Rotation.from_euler("XYZ", angles[:, [1, 2, 0]] * [-1.0, -1.0, 1.0])
    camera = frame * turned * Rotation.from_matrix(_NAVIGATION_FROM_CAMERA)
    return np.asarray(camera.as_quat(scalar_first=True))


def _look(strip: XmlFields, band: str | None, width: int) -> Array:
    """Return `Pushbroom.look` of the columns from the middle one."""
    lists = strip.all("Sensor_Configuration/Instrument_Look_Angles_List/Instrument_Look_Angles")
    names = [one.element.findtext("BAND_INDEX", "").strip() for one in lists]
    if not lists or (band is not None and band not in names):
        missing = f"of band {band}; it has {', '.join(names)}" if lists else "at all; is the file complete?"
        raise (InputError if lists else RpcFormatError)(f"{strip.name}: no Instrument_Look_Angles {missing}")
    holder = lists[0 if band is None else names.index(band)]
    table = table_of(holder.all("Look_Angles_List/Look_Angles"), ("DETECTOR_ID", "PSI_X", "PSI_Y"))
    table = table[table[:, 0].argsort(kind="stable")]
    ids = table[:, 0]
    if len(ids) < 2 or width < 2 or ids[0] > 1 or ids[-1] < width or not (np.diff(ids) > 0).all():
        raise RpcFormatError(
            f"{strip.name}: {len(ids)} Look_Angles, of detectors {ids.min(initial=np.inf):g} to "
            f"{ids.max(initial=-np.inf):g}; expected each once, from 1 to {width}"
        )
    psi_x, psi_y = (np.interp(np.arange(1.0, width + 1.0), ids, psi) for psi in table[:, 1:].T)
    tangents = np.tan(np.stack([psi_x, -psi_y], axis=1))
    half = (width - 1) / 2
    scaled = np.linspace(-1.0, 1.0, width)
    pixel = float(np.linalg.norm(tangents[-1] - tangents[0])) / (width - 1)
    if not pixel > _LEAST_PIXEL:
        raise RpcFormatError(f"{strip.name}: look angles of one direction, {pixel:.2g} rad a detector")
    for degree in _LOOK_DEGREES:
        coeffs = polyfit(scaled, tangents, degree)
        misfit = float(np.abs(polyval(scaled, coeffs).T - tangents).max() / pixel)
        if misfit <= _LOOK_MISFIT:
            break
    if not misfit <= _LOOK_STEP:
        raise RpcFormatError(f"{strip.name}: look angles {misfit:.3g} px from a smooth line of detectors")
    return np.asarray(coeffs.T / half ** np.arange(degree + 1))
