"""SICD: radar images of Umbra, Capella, ICEYE and others, by the projection that their metadata state.

`open_sicd` makes the model from the XML alone, as a file or within a NITF 2.1 (NGA.STND.0024, SICD volumes 1 and 3).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import BinaryIO

import numpy as np

from barpc.base.errors import InputError, RpcFormatError, plain
from barpc.base.geodesy import ALTITUDES, EARTH_RATE, Array, ground_from_ecef
from barpc.base.safe_io import MAX_XML, PRODUCT, opened, parse_xml
from barpc.sensor.curve import Curve
from barpc.sensor.document import RELIEF_AROUND, XmlFields, padded
from barpc.sensor.sicd.monostatic import Formation, ImagePlane, Monostatic, PolarFormat, RangeAzimuth, ZeroDoppler

_ORDER = 30  # no polynomial of a document has so high a power
_SCP_TOLERANCE = 1.0  # px: where the stated centre point must project
_NITF = b"NITF02.10"
_SEGMENTS = {"images": (6, 10), "graphics": (4, 6), "reserved": (0, 0), "texts": (4, 5), "data extensions": (4, 9)}
"""Digits of the lengths of subheader and data."""


def is_sicd(head: bytes) -> bool:
    """Return whether the first bytes of a document begin a SICD, its namespace with a prefix or without."""
    return re.search(rb"<([\w.-]{1,40}:)?SICD[\s>]", head) is not None


def find_sicd(path: Path) -> bytes | None:
    """Return the SICD document that a file is or, in a NITF, holds; None where there is none.

    RpcFormatError for a NITF whose header is damaged, InputError for a document that is too large.
    """
    with opened(path, PRODUCT) as file:
        head = file.read(4096)
        if not head.startswith(_NITF):
            return head + file.read(MAX_XML + 1 - len(head)) if is_sicd(head) else None
        try:
            return next((text for text in _extensions(file) if is_sicd(text[:4096])), None)
        except ValueError as error:
            raise RpcFormatError(f"{path}: a NITF with a damaged header ({plain(error)})") from error


def _extensions(file: BinaryIO) -> list[bytes]:
    """Return the data of all data extensions of a NITF."""
    file.seek(354)  # in the header: its own length, then numbers of segments
    place = _digits(file, 6)
    found = []
    for kind, (header, data) in _SEGMENTS.items():
        lengths = [(_digits(file, header), _digits(file, data)) for _ in range(_digits(file, 3) if data else 0)]
        if not data:
            file.seek(3, 1)  # the number of reserved segments, always 0
        here = file.tell()
        for subheader, length in lengths:
            if kind == "data extensions" and length <= MAX_XML:
                file.seek(place + subheader)
                found.append(file.read(length))
            place += subheader + length
        file.seek(here)
    return found


def _digits(file: BinaryIO, count: int) -> int:
    text = file.read(count)
    if len(text) != count or not text.isdigit():
        raise ValueError(f"{text[:10]!r} where {count} digits belong")
    return int(text)


def open_sicd(path: Path) -> Monostatic:
    """Return the model of a SICD image, an XML or a NITF file.

    Row and column 0 are the image's own first, also where it is a part of a larger one.

    Raises
    ------
    RpcFormatError
        Not a SICD, or a damaged one: a field missing, no number, or a centre that is not seen where it is said to be.
    InputError
        A bistatic image, or a way of forming images that the standard does not project.
    """
    data = find_sicd(path)
    if data is None:
        raise RpcFormatError(f"{path}: no SICD metadata in it")
    root = XmlFields(parse_xml(data, name=str(path), strip_namespaces=True), str(path))
    if root.element.findtext("CollectionInfo/CollectType", "MONOSTATIC").strip() != "MONOSTATIC":
        raise InputError(f"{path}: a bistatic image; only monostatic ones are read")
    scp = _vector(root, "GeoData/SCP/ECF")
    altitude = float(ground_from_ecef(scp)[2])
    if not ALTITUDES[0] <= altitude <= ALTITUDES[1]:
        raise RpcFormatError(f"{path}: GeoData/SCP/ECF is {altitude:.0f} m above the ellipsoid, not on the ground")
    first = [_integer(root, f"ImageData/First{axis}") for axis in ("Row", "Col")]
    center = [_integer(root, f"ImageData/SCPPixel/{axis}") for axis in ("Row", "Col")]
    model = Monostatic(
        orbit=_read_orbit(root),
        formation=_formation(root, scp),
        spacing=(root.positive("Grid/Row/SS"), root.positive("Grid/Col/SS")),
        origin=(center[0] - first[0], center[1] - first[1]),
        size=root.size("ImageData/NumCols", "ImageData/NumRows"),
        alt_range=(altitude - RELIEF_AROUND, altitude + RELIEF_AROUND),
        look=root.chosen("SCPCOA/SideOfTrack", {"R": "right", "L": "left"}),
        accuracy=_accuracy(root, scp),
    )
    seen = model.project(ground_from_ecef(scp))
    miss = float(np.abs(seen - model.origin[::-1]).max())
    if not miss <= _SCP_TOLERANCE:
        raise RpcFormatError(
            f"{path}: its scene centre is not projected to its stated pixel (error {miss:.3g} px); is the file damaged?"
        )
    return model


def _integer(root: XmlFields, path: str) -> int:
    return int(root.numbers(path)[0])


def _vector(root: XmlFields, path: str) -> Array:
    return np.array([root.numbers(f"{path}/{axis}")[0] for axis in "XYZ"])


def _accuracy(root: XmlFields, scp: Array) -> tuple[float, float] | None:
    """Return the stated accuracy of range and along the flight [m]: of the scene centre, else of orbit and range."""
    whole = _error(root, "CompositeSCP//Rg"), _error(root, "CompositeSCP//Az")
    orbit = np.array([_error(root, f"Components/PosVelErr/P{k}") for k in (1, 2, 3)])
    frame = root.element.findtext("ErrorStatistics/Components/PosVelErr/Frame", "").strip()
    if min(whole) > 0 or not (orbit > 0).all() or frame not in ("ECF", "RIC_ECF", "RIC_ECI"):
        return whole if min(whole) > 0 else None
    position, velocity = _vector(root, "SCPCOA/ARPPos"), _vector(root, "SCPCOA/ARPVel")
    directions, basis = np.stack([position - scp, velocity], axis=1), np.eye(3)
    with np.errstate(invalid="ignore"):  # of damaged documents
        if frame != "ECF":  # radial, in track, across it
            turning = np.array([0.0, 0.0, EARTH_RATE * (frame == "RIC_ECI")])
            across = np.cross(position, velocity + np.cross(turning, position))
            basis = np.stack([position, np.cross(across, position), across])
            basis /= np.linalg.norm(basis, axis=1, keepdims=True)
        parts = orbit[:, None] * (basis @ directions)
        far, along = np.linalg.norm(parts, axis=0) / np.linalg.norm(directions, axis=0)
    delays = ("RadarSensor/RangeBias", "TropoError/TropoRangeSlant", "IonoError/IonoRangeVertical")
    found = float(np.linalg.norm([far, *(_error(root, f"Components/{d}") for d in delays)])), float(along)
    return found if np.isfinite(found).all() else None


def _error(root: XmlFields, path: str) -> float:
    """Return a standard deviation [m]; 0 where it is not stated."""
    return max([0.0, *(float(one.numbers(".")[0]) for one in root.all(f"ErrorStatistics/{path}"))])


def _read_orbit(root: XmlFields) -> Curve:
    """Read ARPPoly over the time of the collection."""
    coeffs = padded(_polynomial(root, f"Position/ARPPoly/{axis}", 1) for axis in "XYZ")
    return Curve.polynomial(coeffs.T, 0.0, root.positive("Timeline/CollectDuration"))


def _polynomial(root: XmlFields, path: str, variables: int) -> Array:
    """Return the coefficients by their powers, (K,) or (K, L)."""
    terms = root.all(f"{path}/Coef")
    if not terms:
        raise RpcFormatError(f"{root.name}: no {path}; is the file complete?")
    powers = [[term.element.get(f"exponent{k + 1}", "") for k in range(variables)] for term in terms]
    if not all(p.isdecimal() and p.isascii() and int(p) <= _ORDER for power in powers for p in power):
        raise RpcFormatError(f"{root.name}: {path} has a coefficient of no power from 0 to {_ORDER}")
    table = np.array(powers, dtype=np.int64)
    coeffs = np.zeros(table.max(axis=0) + 1)
    for power, term in zip(table, terms, strict=True):
        coeffs[tuple(power)] = term.numbers(".")[0]
    return coeffs


def _formation(root: XmlFields, scp: Array) -> Formation:
    """Return the formation by Grid/Type and, for RGAZIM, ImageFormation/ImageFormAlgo."""
    time, kind = _polynomial(root, "Grid/TimeCOAPoly", 2), root.text("Grid/Type")
    if kind == "RGAZIM":
        algorithm = root.text("ImageFormation/ImageFormAlgo")
        if algorithm == "PFA":
            angle, scale = (_polynomial(root, f"PFA/{p}", 1) for p in ("PolarAngPoly", "SpatialFreqSFPoly"))
            return PolarFormat(time, scp, angle, scale)
        if algorithm == "RGAZCOMP":
            return RangeAzimuth(time, scp, float(root.numbers("RgAzComp/AzSF")[0]))
        kind = f"RGAZIM by {algorithm}"
    if kind == "RGZERO":
        return ZeroDoppler(
            time,
            _polynomial(root, "RMA/INCA/TimeCAPoly", 1),
            root.positive("RMA/INCA/R_CA_SCP"),
            _polynomial(root, "RMA/INCA/DRateSFPoly", 2),
        )
    if kind in ("XRGYCR", "XCTYAT", "PLANE"):
        return ImagePlane(time, scp, _vector(root, "Grid/Row/UVectECF"), _vector(root, "Grid/Col/UVectECF"))
    raise InputError(f"{root.name}: an image of the kind {kind[:40]}, which the SICD standard does not project")
