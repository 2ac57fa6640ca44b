"""Physical camera models of pushbroom images, from the orbit and attitude in a vendor's XML metadata.

Maxar's image support data (ISD) of Basic 1B images of WorldView, GeoEye and Legion ("Imagery Support Data (ISD)
Documentation", v. 1.1.2, DigitalGlobe 2014): EPHEMLIST and ATTLIST sample position, velocity and the quaternion
ecef_from_body (scalar last) with their covariances; IMD gives the time of lines (TLCLIST), GEO the camera: detector c
stands at (DETORIGINX, DETORIGINY) + c DETPITCH (sin a, -cos a) [mm] of the focal plane at PD, turned into the body by
CAMERA_ATTITUDE.

Airbus' DIMAP (``DIM_*.XML``) of Pleiades, SPOT 6/7 and Pleiades Neo primary products ("Pleiades Imagery User Guide",
"Pleiades Neo User Guide"): ``Geometric_Data/Refined_Model`` gives the time of rows, positions over time, the attitude
ecef_from_camera (a cubic polynomial of time of each component of the quaternion, or samples), and the tangents of the
two look angles as polynomials of the detector: column c looks along (tan psi_y, -tan psi_x, 1) of the camera.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import count, takewhile
from pathlib import Path

import numpy as np
from numpy.polynomial.polynomial import polyval

from barpc.base.errors import InputError, RpcFormatError
from barpc.base.geodesy import Array
from barpc.base.safe_io import parse_xml
from barpc.sensor.curve import EXTRAPOLATION
from barpc.sensor.document import LINE_TIME_TOLERANCE, XmlFields, padded, seconds
from barpc.sensor.pushbroom import STRAIGHT, Light
from barpc.sensor.samples import ATTITUDE_STEP, Detector, Linescan, Samples, camera_of_samples, unit
from barpc.sensor.spot import camera_of_scene, is_scene

_SAMPLE_LISTS = {"EPH": (13, 7), "ATT": (15, 5)}  # numbers of a row: with covariances, without
_STAR_TRACKER_LIGHT = Light(aberration=True, refraction=True)  # star trackers tell where the body points
_PERIOD_UNITS = (1.0, 1e-3, 1e-6)  # s: that LINE_PERIOD may be in
_LINE_PERIOD_TOLERANCE = 0.01  # relative: by how much LINE_PERIOD may miss what START and END say


def read_linescan(
    path: Path,
    *,
    band: str | None = None,
    aberration: bool | None = None,
    refraction: bool | None = None,
    attitudes: str | None = None,
) -> Linescan:
    """Return the physical model in an XML file.

    Parameters
    ----------
    path : Path, Maxar's image support data, Airbus' ``DIM_*.XML`` or SPOT's ``METADATA.DIM``
    band : str, optional, the band whose detector is taken, where they have detectors of their own
    aberration, refraction : bool, optional
        Bending of the line of sight (`Light`); None: both kinds for Maxar, by the settings of a DIMAP for Airbus,
        none for SPOT 1 to 5.
    attitudes : str, optional, "raw": with the attitudes that SPOT 1 to 4 measured, which their producer leaves out

    Raises
    ------
    RpcFormatError
        There is no such model, or it is damaged.
    """
    root = XmlFields(parse_xml(path, strip_namespaces=True), str(path))
    vendor = _VENDOR_READERS.get(root.element.tag)
    if vendor is None:
        known = ", ".join(f"<{tag}>" for tag in _VENDOR_READERS)
        raise RpcFormatError(
            f"{path}: no physical camera model; its root is <{root.element.tag}>, expected one of {known}"
        )
    read, kind = vendor
    if is_scene(root):
        kind, usual, found = "spot physical model", STRAIGHT, camera_of_scene(root, band, attitudes)
    elif attitudes is not None:
        raise InputError(f"{path}: attitudes is a choice for SPOT 1 to 4")
    else:
        found, usual = read(root, band)
    light = Light(
        usual.aberration if aberration is None else aberration, usual.refraction if refraction is None else refraction
    )
    return replace(found, model=replace(found.model, light=light), kind=kind)


def camera_of_isd(root: XmlFields, band: str | None = None) -> tuple[Linescan, Light]:
    """Return the model of an ISD, and how light bends; InputError where `band` is none of its bands."""
    from scipy.spatial.transform import Rotation

    level = root.text("IMD/PRODUCTLEVEL")
    if "1B" not in level.upper():
        raise RpcFormatError(f"{root.name}: a product of level {level}, resampled: only 1B has a physical model")
    size = root.size("IMD/NUMCOLUMNS", "IMD/NUMROWS")
    period, first = _isd_lines(root, size[1])
    (times, orbit), (ticks, attitude) = (_sample_table(root, part, first) for part in _SAMPLE_LISTS)
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
    detector = Detector(_isd_look(root, band), 0.0, period, size)
    return camera_of_samples(samples, detector, _sigma(orbit, attitude)), _STAR_TRACKER_LIGHT


def _isd_lines(root: XmlFields, rows: int) -> tuple[float, np.datetime64]:
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
    if not bent <= LINE_TIME_TOLERANCE:
        raise RpcFormatError(f"{root.name}: the line rate changes ({bent:.3g} rows in TLCLIST), which is not read")
    begins = start - period * line
    first = image.time("TLCTIME") + np.timedelta64(round(begins * 1e9), "ns")
    late = seconds(image.time("FIRSTLINETIME"), first) / period
    if not abs(late) <= 1:
        raise RpcFormatError(f"{root.name}: FIRSTLINETIME is {late:.4g} rows from TLCLIST's time of row 0")
    return period, first


def _sample_table(root: XmlFields, part: str, epoch: np.datetime64) -> tuple[Array, Array]:
    """Return the times [s from the epoch] and rows of EPHEMLIST or ATTLIST."""
    of, tag = root.one(part), f"{part}{'EM' * (part == 'EPH')}LIST"
    stated = int(of.positive("NUMPOINTS"))
    rows = [row.numbers(".") for row in of.all(f"{tag}List/{tag}")]
    if len(rows) != stated:
        raise RpcFormatError(f"{root.name}: {tag} holds {len(rows)} of {stated} samples; is the file complete?")
    widths = {len(row) for row in rows}
    if len(widths) != 1 or not widths <= set(_SAMPLE_LISTS[part]):
        raise RpcFormatError(
            f"{root.name}: rows of {tag} hold {', '.join(map(str, sorted(widths)))} numbers, expected "
            + " or ".join(map(str, _SAMPLE_LISTS[part]))
        )
    table = np.array(rows)
    start = seconds(of.time("STARTTIME"), epoch)
    return start + of.positive("TIMEINTERVAL", 100.0) * (table[:, 0] - 1.0), table


def _isd_look(root: XmlFields, band: str | None) -> Array:
    """Return the detector line in the focal plane, as `Pushbroom.look` of the column."""
    geo = root.one("GEO")
    if geo.number("OPTICAL_DISTORTION/POLYORDER") >= 0:
        raise RpcFormatError(f"{root.name}: an optical distortion polynomial, which is not read")
    mounted = geo.one("DETECTOR_MOUNTING").all("*")
    bands = {one.element.tag[5:]: one for one in mounted if one.element.tag.startswith("BAND_")}
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


def _sigma(orbit: Array, attitude: Array) -> tuple[float, float] | None:
    """Return the standard deviations of an angle [rad] and a coordinate [m], from upper triangles of covariances.

    A turn by the small angle w changes the quaternion by w / 2.
    """
    if orbit.shape[1] < _SAMPLE_LISTS["EPH"][0] or attitude.shape[1] < _SAMPLE_LISTS["ATT"][0]:
        return None
    turn = 4.0 * attitude[:, [5, 9, 12, 14]].sum(axis=1).mean() / 3.0
    place = orbit[:, [7, 10, 12]].mean()
    return (math.sqrt(turn), math.sqrt(place)) if turn > 0 and place > 0 else None


def camera_of_dimap(root: XmlFields, band: str | None = None) -> tuple[Linescan, Light]:
    """Return the model of a DIMAP, and how light bends; InputError where `band` is none of its bands."""
    if root.element.find("Geometric_Data/Refined_Model") is None:
        raise RpcFormatError(f"{root.name}: no Geometric_Data/Refined_Model: it holds no physical camera model")
    model = root.one("Geometric_Data/Refined_Model")
    size = root.one("Raster_Data/Raster_Dimensions").size("NCOLS", "NROWS")
    first, period = _dimap_lines(model, size[1])
    points = model.all("Ephemeris/Point_List/Point")
    times = _sample_times(points, first)
    positions, velocities = (
        np.array([point.numbers(tag, 3, ",") for point in points]).reshape(-1, 3)
        for tag in ("LOCATION_XYZ", "VELOCITY_XYZ")
    )
    ticks, quaternions = _attitude(model.one("Attitudes"), first, (size[1] - 1) * period)
    samples = Samples(root.name, times, positions, velocities, ticks, quaternions)
    look, origin = _dimap_look(model.one("Geometric_Calibration/Instrument_Calibration"), band)
    return camera_of_samples(samples, Detector(look, origin, period, size)), _light(root)


def _sample_times(parts: list[XmlFields], epoch: np.datetime64) -> Array:
    return np.array([seconds(part.time("TIME"), epoch) for part in parts])


def _dimap_lines(model: XmlFields, rows: int) -> tuple[np.datetime64, float]:
    """Time of row 0, and from one row to the next [s], in the unit that agrees with the time of the last."""
    span = model.one("Time/Time_Range")
    start, lasts = span.time("START"), seconds(span.time("END"), span.time("START"))
    stated = model.positive("Time/Time_Stamp/LINE_PERIOD")
    for scale in _PERIOD_UNITS:
        if abs(stated * scale * rows - lasts) <= _LINE_PERIOD_TOLERANCE * lasts + 2 * stated * scale:
            return start, stated * scale
    raise RpcFormatError(
        f"{model.name}: LINE_PERIOD {stated:g} times {rows} rows is not the {lasts:g} s from START to END, in no unit"
    )


def _attitude(attitudes: XmlFields, first: np.datetime64, lasts: float) -> tuple[Array, Array]:
    """Return the times [s from the first row] and quaternions, scalar first."""
    listed = attitudes.all("Quaternion_List/Quaternion")
    if listed:
        return _sample_times(listed, first), np.array([[q.number(f"Q{k}") for k in range(4)] for q in listed])
    poly = attitudes.one("Polynomial_Quaternions")
    ticks = np.arange(-EXTRAPOLATION, lasts + EXTRAPOLATION + ATTITUDE_STEP, ATTITUDE_STEP)
    days = first.astype("datetime64[D]") + np.arange(-1, 2)  # OFFSET counts from a midnight
    since = min(seconds(first, days.astype("datetime64[ns]")) - poly.number("OFFSET"), key=abs)
    scaled = (ticks + since) / poly.positive("SCALE")
    values = []
    for k in range(4):
        part = poly.one(f"Q{k}")
        degree = int(part.number("DEGREE"))
        values.append(polyval(scaled, part.numbers("COEFFICIENTS", degree + 1)))
    return ticks, np.stack(values, axis=1)


def _dimap_look(calibration: XmlFields, band: str | None) -> tuple[Array, float]:
    """Return `Pushbroom.look` and its origin."""
    bands = calibration.all("Band_Calibration_List/Band_Calibration")
    names = [part.element.findtext("BAND_ID", "").strip() for part in bands]
    if band is not None and band not in names:
        raise InputError(f"{calibration.name}: no detector of band {band}; it has {', '.join(names) or 'one for all'}")
    holder = calibration if not bands else bands[0 if band is None else names.index(band)]
    angles = holder.one("Polynomial_Look_Angles")
    tangents = [_tangents(angles, axis) for axis in "YX"]
    if not tangents[0] or len(tangents[1]) < 2:
        raise RpcFormatError(f"{calibration.name}: Polynomial_Look_Angles without YLOS_0, XLOS_0 and XLOS_1")
    begins = calibration.element.findtext("Swath_Range/FIRST_COL")
    origin = 0.0 if begins is None else 1.0 - calibration.number("Swath_Range/FIRST_COL")
    return padded(tangents) * [[1.0], [-1.0]], origin


def _tangents(angles: XmlFields, axis: str) -> list[float]:
    """Return the coefficients of one look angle, ascending, as many as there are."""
    tags = takewhile(lambda tag: angles.element.find(tag) is not None, (f"{axis}LOS_{k}" for k in count()))
    return [angles.number(tag) for tag in tags]


def _light(root: XmlFields) -> Light:
    """Return the light bending that the product's settings state: none (Pleiades), refraction (Neo)."""
    stated = "Processing_Information/Product_Settings/Geometric_Settings/{}_SETTING"
    said = (root.element.findtext(stated.format(w), "") for w in ("LIGHT_SPEED", "ATMOSPHERIC_REFRACTION"))
    return Light(*(text.strip().lower() == "true" for text in said))


_VENDOR_READERS = {
    "isd": (camera_of_isd, "maxar physical model"),
    "Dimap_Document": (camera_of_dimap, "dimap physical model"),
}
"""Root of the document -> its reader and the kind of camera; DIMAP 1 is of the same root (`barpc.sensor.spot`)."""
