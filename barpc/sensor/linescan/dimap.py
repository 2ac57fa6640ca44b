"""Airbus' DIMAP (``DIM_*.XML``): the physical model of Pleiades, SPOT 6/7 and Pleiades Neo primary products.

``Geometric_Data/Refined_Model`` gives the time of rows, positions over time, the attitude ecef_from_camera (a cubic
polynomial of time of each component of the quaternion, or samples), and the tangents of the two look angles as
polynomials of the detector: column c looks along (tan psi_y, -tan psi_x, 1) of the camera.

After the "Pleiades Imagery User Guide" and the "Pleiades Neo User Guide" of Airbus Defence and Space.
"""

from __future__ import annotations

from itertools import count, takewhile

import numpy as np
from numpy.polynomial.polynomial import polyval

from barpc.errors import InputError, RpcFormatError
from barpc.geodesy import Array
from barpc.sensor.curve import EXTRAPOLATION
from barpc.sensor.document import MOST_PIXELS, Fields, seconds
from barpc.sensor.linescan.samples import Detector, Linescan, Samples, camera_of_samples
from barpc.sensor.pushbroom import Light

ROOT, KIND = "Dimap_Document", "dimap physical model"

_UNITS = (1.0, 1e-3, 1e-6)  # s: that LINE_PERIOD may be in
_AGREE = 0.01  # relative: by how much LINE_PERIOD may miss what START and END say
_DAY = 86400.0  # s: OFFSET counts from midnight
_STEP = 0.05  # s: at which a polynomial attitude is sampled


def _light(root: Fields) -> Light:
    """Return the light bending that the product's settings state: none (Pleiades), refraction (Neo)."""
    stated = "Processing_Information/Product_Settings/Geometric_Settings/{}_SETTING"
    said = (root.element.findtext(stated.format(w), "") for w in ("LIGHT_SPEED", "ATMOSPHERIC_REFRACTION"))
    return Light(*(text.strip().lower() == "true" for text in said))


def camera_of_dimap(root: Fields, band: str | None = None) -> tuple[Linescan, Light]:
    """Return the model of a DIMAP, and how light bends; RpcFormatError where it is damaged or has none, InputError
    for no such `band`.
    """
    if root.element.find("Geometric_Data/Refined_Model") is None:
        raise RpcFormatError(f"{root.name}: no Geometric_Data/Refined_Model: it holds no physical camera model")
    model, raster = root.one("Geometric_Data/Refined_Model"), root.one("Raster_Data/Raster_Dimensions")
    size = (int(raster.positive("NCOLS", MOST_PIXELS)), int(raster.positive("NROWS", MOST_PIXELS)))
    first, period = _lines(model, size[1])
    points = model.all("Ephemeris/Point_List/Point")
    times = _times(points, first)
    positions, velocities = (
        np.array([point.numbers(tag, 3, ",") for point in points]).reshape(-1, 3)
        for tag in ("LOCATION_XYZ", "VELOCITY_XYZ")
    )
    ticks, quaternions = _attitude(model.one("Attitudes"), first, (size[1] - 1) * period)
    samples = Samples(root.name, times, positions, velocities, ticks, quaternions)
    look, origin = _look(model.one("Geometric_Calibration/Instrument_Calibration"), band)
    return camera_of_samples(samples, Detector(look, origin, period, size)), _light(root)


def _times(parts: list[Fields], epoch: np.datetime64) -> Array:
    return np.array([seconds(part.time("TIME"), epoch) for part in parts])


def _lines(model: Fields, rows: int) -> tuple[np.datetime64, float]:
    """Time of row 0, and from one row to the next [s], in the unit that agrees with the time of the last."""
    span = model.one("Time/Time_Range")
    start, lasts = span.time("START"), seconds(span.time("END"), span.time("START"))
    stated = model.positive("Time/Time_Stamp/LINE_PERIOD")
    for unit in _UNITS:
        if abs(stated * unit * rows - lasts) <= _AGREE * lasts + 2 * stated * unit:
            return start, stated * unit
    raise RpcFormatError(
        f"{model.name}: LINE_PERIOD {stated:g} times {rows} rows is not the {lasts:g} s from START to END, in no unit"
    )


def _attitude(attitudes: Fields, first: np.datetime64, lasts: float) -> tuple[Array, Array]:
    """Return the times [s from the first row] and quaternions, scalar first."""
    listed = attitudes.all("Quaternion_List/Quaternion")
    if listed:
        return _times(listed, first), np.array([[q.number(f"Q{k}") for k in range(4)] for q in listed])
    poly = attitudes.one("Polynomial_Quaternions")
    ticks = np.arange(-EXTRAPOLATION, lasts + EXTRAPOLATION + _STEP, _STEP)
    midnight = first.astype("datetime64[D]").astype("datetime64[ns]")
    since = seconds(first, midnight) - poly.number("OFFSET")
    since -= _DAY * round(since / _DAY)  # of an image taken at midnight
    scaled = (ticks + since) / poly.positive("SCALE")
    values = []
    for k in range(4):
        part = poly.one(f"Q{k}")
        degree = int(part.number("DEGREE"))
        values.append(polyval(scaled, part.numbers("COEFFICIENTS", degree + 1)))
    return ticks, np.stack(values, axis=1)


def _look(calibration: Fields, band: str | None) -> tuple[Array, float]:
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
    look = np.zeros((2, max(map(len, tangents))))
    look[0, : len(tangents[0])], look[1, : len(tangents[1])] = tangents[0], np.negative(tangents[1])
    begins = calibration.element.findtext("Swath_Range/FIRST_COL")
    return look, 0.0 if begins is None else 1.0 - calibration.number("Swath_Range/FIRST_COL")


def _tangents(angles: Fields, axis: str) -> list[float]:
    """Return the coefficients of one look angle, ascending, as many as there are."""
    tags = takewhile(lambda tag: angles.element.find(tag) is not None, (f"{axis}LOS_{k}" for k in count()))
    return [angles.number(tag) for tag in tags]
