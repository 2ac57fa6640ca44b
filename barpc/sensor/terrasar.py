"""TerraSAR-X, TanDEM-X and PAZ: Range-Doppler models from the annotation of slant range products (SSC).

Rows go on by zero-Doppler time and columns by range time, in stripmaps and spotlights alike. Both are later than
geometry has it by what ``ANNOTATION/GEOREF.xml`` states of the atmosphere and the timing; with it the model is that of
the product's geolocation grid. Names are those of "TerraSAR-X Level 1b Product Format Specification" (DLR).
"""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.polynomial.polynomial import polyval

from barpc.base.errors import BarpcWarning, InputError, RpcError, RpcFormatError
from barpc.base.safe_io import parse_xml
from barpc.sensor.curve import fit_orbit
from barpc.sensor.document import RELIEF_AROUND, XmlFields, seconds, warn_off_grid
from barpc.sensor.sentinel1.range_doppler import RELIEF, RangeDoppler, SlantFrame

ROOT = "level1Product"

_PRODUCT_PATTERN = "*1_SAR__*.xml"  # TSX1, TDX1, PAZ1
_IMAGING_MODES = ("SM", "SL", "HS", "HS300", "ST")  # ScanSAR stores its bursts apart
_REFERENCE_FRAME = re.compile(r"(WGS-?84|ITRF|IG[Sb])[-_ ()G\d]*")  # of any year: they agree to centimetres
_SPAN_TOLERANCE = 2.0  # rows or columns that first and last may be off their number times their interval
_LATEST = 1e-3  # s: no stated delay is longer


def find_annotation(folder: Path) -> Path | None:
    """Return the annotation in a product folder; None where it is not one."""
    found = sorted(folder.glob(_PRODUCT_PATTERN))
    return found[0] if len(found) == 1 else None


def open_terrasar(path: str | Path) -> RangeDoppler:
    """Return the model of a TerraSAR-X, TanDEM-X or PAZ image.

    Parameters
    ----------
    path : str or Path, a product folder, or the annotation in it (``TSX1_SAR__SSC____....xml``)

    Raises
    ------
    RpcFormatError
        No such annotation, or a damaged one.
    InputError
        A product in another projection than slant range, a ScanSAR, or received by another satellite than sent.
    """
    path = Path(path)
    file = (find_annotation(path) or path) if path.is_dir() else path
    root = XmlFields(parse_xml(file, strip_namespaces=True), str(file))
    if root.element.tag != ROOT:
        raise RpcFormatError(f"{file}: no TerraSAR-X annotation; its root is <{root.element.tag}>, not <{ROOT}>")
    _refuse_other_geometry(root)
    path = file.parent / "ANNOTATION" / "GEOREF.xml"
    if not path.exists():
        warnings.warn(
            f"{file}: no ANNOTATION/GEOREF.xml beside it, which says how late the signals are: some 2 m in range",
            BarpcWarning,
            stacklevel=2,
        )
        return _range_doppler(root, (0.0, 0.0))
    georef = XmlFields(parse_xml(path, strip_namespaces=True), str(path))
    late = (_delay_sum(georef, "rangeDelay", root), _delay_sum(georef, "azimuthShift", root))
    return _checked_by_grid(_range_doppler(root, late), georef, late)


def _refuse_other_geometry(root: XmlFields) -> None:
    """Raise InputError for a product of another geometry."""
    projection = root.text("productInfo/productVariantInfo/projection")
    if projection != "SLANTRANGE":
        raise InputError(
            f"{root.name}: a product in {projection[:20]} projection, which is not read: take the slant range one (SSC)"
        )
    mode = root.text("productInfo/acquisitionInfo/imagingMode")
    if mode not in _IMAGING_MODES:
        raise InputError(f"{root.name}: an image of mode {mode[:20]}, read are {', '.join(_IMAGING_MODES)}")
    if "_BRX" in root.one("generalHeader").element.get("fileName", ""):
        raise InputError(f"{root.name}: received by another satellite than sent, only monostatic images are read")
    image = root.one("productSpecific/complexImageInfo")
    for tag, known in (("imageCoordinateType", "ZERODOPPLER"), ("imageDataStartWith", "EARLYAZNEARRG")):
        if image.text(tag) != known:
            raise InputError(f"{root.name}: {tag} is {image.text(tag)[:40]}, only {known} is read")


def _range_doppler(root: XmlFields, late: tuple[float, float]) -> RangeDoppler:
    """Return the model whose times of range and azimuth are later [s] than geometry has them."""
    scene, raster = root.one("productInfo/sceneInfo"), root.one("productInfo/imageDataInfo/imageRaster")
    size = raster.size("numberOfColumns", "numberOfRows")
    start, near = scene.time("start/timeUTC"), scene.positive("rangeTime/firstPixel", 1.0)
    spans = (scene.positive("rangeTime/lastPixel", 1.0) - near, seconds(scene.time("stop/timeUTC"), start))
    steps = [raster.positive(f"{along}Spacing", 1.0) for along in ("row", "column")]  # from column to column
    for step, span, count, what in zip(steps, spans, size, ("columns", "rows"), strict=True):
        if not abs(span / step - (count - 1)) <= _SPAN_TOLERANCE:
            raise RpcFormatError(
                f"{root.name}: {count} {what} every {step:g} s do not last the {span:g} s from the first to the last"
            )
    frame = root.element.findtext("platform/orbit/orbitHeader/stateVectorRefFrame", "WGS84").strip()
    if not _REFERENCE_FRAME.fullmatch(frame):
        raise RpcFormatError(f"{root.name}: state vectors in {frame[:20]}, WGS84 or ITRF is needed")
    epoch = start - np.timedelta64(round(late[1] * 1e9), "ns")
    vectors = root.all("platform/orbit/stateVec")
    times = np.array([seconds(vector.time("timeUTC"), epoch) for vector in vectors])
    position, velocity = (
        np.reshape([[v.number(f"{part}{axis}") for axis in "XYZ"] for v in vectors], (-1, 3)) for part in ("pos", "vel")
    )
    try:
        orbit = fit_orbit(times, position, velocity, (0.0, spans[1]))
    except RpcError as error:
        raise RpcFormatError(f"{root.name}: {str(error).partition(';')[0]}") from error
    height = scene.number("sceneAverageHeight")
    return RangeDoppler(
        orbit=orbit,
        epoch=epoch,
        frame=SlantFrame(near - late[0], 1.0 / steps[0], steps[1]),
        size=size,
        alt_range=(height - RELIEF_AROUND, height + RELIEF_AROUND),
        look=root.chosen("productInfo/acquisitionInfo/lookDirection", {"RIGHT": "right", "LEFT": "left"}),
    )


def _delay_sum(georef: XmlFields, kind: str, root: XmlFields) -> float:
    """Return the sum of the delays of one kind at mid range [s]."""
    ends = [root.number(f"productInfo/sceneInfo/rangeTime/{end}Pixel") for end in ("first", "last")]
    total = 0.0
    for part in georef.all(f"signalPropagationEffects/{kind}"):
        coeffs = [term.number(".") for term in part.all("coefficient")]
        total += float(polyval(sum(ends) / 2 - part.number("referencePoint"), coeffs or [0.0]))
    if not abs(total) <= _LATEST:
        raise RpcFormatError(f"{georef.name}: {kind} is {total:g} s, expected at most {_LATEST:g}")
    return total


def _checked_by_grid(model: RangeDoppler, georef: XmlFields, late: tuple[float, float]) -> RangeDoppler:
    """Return the model with the altitudes of the product's grid, which it is held against."""
    origin = georef.one("geolocationGrid/gridReferenceTime")
    since = seconds(origin.time("tReferenceTimeUTC"), model.epoch) - late[1]
    near = origin.positive("tauReferenceTime", 1.0) - late[0]
    points, tags = georef.all("geolocationGrid/gridPoint"), ("tau", "t", "lon", "lat", "height")
    if not points:
        raise RpcFormatError(f"{georef.name}: no gridPoint; is the file complete?")
    table = np.array([[point.number(tag) for tag in tags] for point in points]).T
    image, _ = model.frame.image(np.stack([table[1] + since, table[0] + near]))
    warn_off_grid(georef.name, model.project(table[2:].T) - image.T)
    low, high = float(np.floor(table[4].min())), float(np.ceil(table[4].max()))
    return replace(model, alt_range=(low - RELIEF[0], high + RELIEF[1]))
