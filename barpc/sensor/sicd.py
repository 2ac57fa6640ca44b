"""SICD: radar images of Umbra, Capella, ICEYE and others, by the projection that their metadata state.

`open_sicd` makes the model from the XML alone, as a file or within a NITF 2.1 (NGA.STND.0024, SICD volumes 1 and 3).
A ground point is seen where range and range rate are those of the pixel: what a pixel states, both at the centre of
its aperture, is the image's `Formation`. (x, y) [m] are the image's own coordinates, along its rows' and its columns'
numbers, from the scene centre point (SCP). Equations: SICD volume 3, "Image Projections Description", sections 4 and 5;
names are the document's.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval, polyval2d

from barpc.base.errors import InputError, RpcError, RpcFormatError, plain
from barpc.base.frozen import Frozen
from barpc.base.geodesy import (
    ALTITUDES,
    EARTH_RATE,
    Array,
    ecef_from_ground,
    ecef_from_ground_jacobian,
    ground_from_ecef,
    newton,
)
from barpc.base.safe_io import MAX_XML, PRODUCT, opened, parse_xml
from barpc.sensor.curve import Curve
from barpc.sensor.document import RELIEF_AROUND, XmlFields, padded
from barpc.sensor.radar import Radar, aside, dot, on_circle

_DIFFERENCE_STEP = 1.0  # m: central differences over so much are exact to 1e-9
_VALIDITY_MARGIN = 1.0  # sides of the image around it that its polynomials are believed for


class Aperture(NamedTuple):
    """Position and velocity of the radar for N pixels, and the range and range rate measured there."""

    position: Array  # (3, N): ECEF [m]
    velocity: Array  # (3, N): [m/s]
    distance: Array  # (N,): R [m]
    rate: Array  # (N,): dR/dt [m/s]
    time: Array  # (N,): of the centre of the aperture [s]

    @classmethod
    def of(cls, point: Array, flight: tuple[Array, Array], time: Array) -> Aperture:
        """Return that of points (3, N) or (3, 1): the range and its rate are their own."""
        position, velocity = flight
        sight = position - point
        distance = np.sqrt(dot(sight, sight))
        return cls(position, velocity, distance, dot(velocity, sight) / distance, time)


@dataclass(frozen=True, eq=False)
class Formation(Frozen, ABC):
    """Image formation: from pixels to range and range rate.

    Parameters
    ----------
    time : (K, L), TimeCOAPoly: coefficients of x^k y^l [s]
    """

    time: Array

    _SHAPES: ClassVar[tuple[tuple[str, tuple[int | None, ...]], ...]] = ()

    def __post_init__(self) -> None:
        for name, shape in (("time", (None, None)), *self._SHAPES):
            self._array(name, shape, RpcError)

    def at(self, x: Array, y: Array, orbit: Curve) -> Aperture:
        """Return the apertures of N pixels at x, y (N,) [m]."""
        return self._at(x, y, orbit, np.asarray(polyval2d(x, y, self.time), dtype=np.float64))

    @abstractmethod
    def _at(self, x: Array, y: Array, orbit: Curve, time: Array) -> Aperture: ...


@dataclass(frozen=True, eq=False)
class PolarFormat(Formation):
    """Grid RGAZIM made by the polar format algorithm (PFA).

    Parameters
    ----------
    scp : (3,), ECEF [m]
    angle : (K,), PolarAngPoly: coefficients by time [rad]
    scale : (K,), SpatialFreqSFPoly: coefficients by that angle
    """

    scp: Array
    angle: Array
    scale: Array

    _SHAPES = ("scp", (3,)), ("angle", (None,)), ("scale", (None,))

    def _at(self, x: Array, y: Array, orbit: Curve, time: Array) -> Aperture:
        center = Aperture.of(self.scp[:, None], orbit(time), time)
        angle, turning = polyval(time, self.angle), polyval(time, polyder(self.angle))
        scale, by_angle = polyval(angle, self.scale), polyval(angle, polyder(self.scale))
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        rate = center.rate + (by_angle * along + scale * across) * turning
        return center._replace(distance=center.distance + scale * along, rate=rate)


@dataclass(frozen=True, eq=False)
class RangeAzimuth(Formation):
    """Grid RGAZIM made by range-azimuth compression (RGAZCOMP); `factor` is AzSF [1/m]."""

    scp: Array
    factor: float

    _SHAPES = (("scp", (3,)),)

    def _at(self, x: Array, y: Array, orbit: Curve, time: Array) -> Aperture:
        center = Aperture.of(self.scp[:, None], orbit(time), time)
        rate = center.rate - np.sqrt(dot(center.velocity, center.velocity)) * self.factor * y
        return center._replace(distance=center.distance + x, rate=rate)


@dataclass(frozen=True, eq=False)
class ZeroDoppler(Formation):
    """Grid RGZERO made by range migration with imaging near closest approach (RMA, INCA).

    Parameters
    ----------
    closest_time : (K,), TimeCAPoly: time of closest approach by y [s]
    closest : R_CA_SCP, range of closest approach of the SCP [m]
    scale : (K, L), DRateSFPoly
    """

    closest_time: Array
    closest: float
    scale: Array

    _SHAPES = ("closest_time", (None,)), ("scale", (None, None))

    def _at(self, x: Array, y: Array, orbit: Curve, time: Array) -> Aperture:
        closest_time = np.asarray(polyval(y, self.closest_time), dtype=np.float64)
        _, speed = orbit(closest_time)
        late, closest = time - closest_time, self.closest + x
        bend = polyval2d(x, y, self.scale) * dot(speed, speed)
        distance = np.sqrt(closest**2 + bend * late**2)
        return Aperture(*orbit(time), distance, bend * late / distance, time)


@dataclass(frozen=True, eq=False)
class ImagePlane(Formation):
    """Grids XRGYCR, XCTYAT and PLANE: a pixel is a point of a plane.

    Parameters
    ----------
    scp : (3,), ECEF [m]
    along_x, along_y : (3,), unit vectors of the rows' and the columns' numbers (Row and Col UVectECF)
    """

    scp: Array
    along_x: Array
    along_y: Array

    _SHAPES = ("scp", (3,)), ("along_x", (3,)), ("along_y", (3,))

    def _at(self, x: Array, y: Array, orbit: Curve, time: Array) -> Aperture:
        point = self.scp[:, None] + self.along_x[:, None] * x + self.along_y[:, None] * y
        return Aperture.of(point, orbit(time), time)


@dataclass(frozen=True, eq=False, repr=False)
class Monostatic(Radar):
    """A SICD image: itself a `SensorModel`.

    Rows of the image go on in range (x), columns along the flight (y), so that `image` is (column, row) as ever.

    Parameters
    ----------
    orbit : Curve, position of the antenna (ARPPoly) [m], ECEF; time counts from the start of the collection
    formation : Formation, (x, y) to range and range rate
    spacing : (float, float), x and y of a pixel [m]
    origin : (float, float), row and column [px] of the scene centre point
    size : (width, height) [px]
    alt_range : (low, high), altitudes that the image is used for [m above the ellipsoid]
    look : "right" or "left", side of the track; a point on the other side projects to NaN
    accuracy : (float, float) or None, standard deviations of range and of the place along the flight [m]
    """

    orbit: Curve
    formation: Formation
    spacing: tuple[float, float]
    origin: tuple[float, float]
    size: tuple[int, int]
    alt_range: tuple[float, float]
    look: Literal["right", "left"] = "right"
    accuracy: tuple[float, float] | None = None

    _kind: ClassVar[str] = "SICD"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not min(self.spacing) > 0:
            raise RpcError(f"SICD: spacing {self.spacing} m")

    @cached_property
    def _bounds(self) -> tuple[Array, Array]:
        """The lowest and highest valid (x, y) (2, 1) [m]."""
        sides = np.array([self.size[1], self.size[0]], dtype=np.float64)
        spacing, origin = np.array(self.spacing), np.array(self.origin)
        low, high = (-_VALIDITY_MARGIN * sides - origin) * spacing, ((1 + _VALIDITY_MARGIN) * sides - origin) * spacing
        return low[:, None], high[:, None]

    def _image(self, plane: Array) -> Array:
        """Return (col, row) (N, 2) of (x, y) (2, N)."""
        row, col = plane / np.array(self.spacing)[:, None] + np.array(self.origin)[:, None]
        return np.column_stack([col, row])

    def _miss(self, plane: Array, point: Array) -> tuple[Array, Aperture, Array, Array]:
        """Return pixel - point in range and rate (2, N), the aperture, the point's sight (3, N), distance (N,)."""
        seen = self.formation.at(plane[0], plane[1], self.orbit)
        sight = seen.position - point
        distance = np.sqrt(dot(sight, sight))
        sight = sight / distance
        miss = np.stack([seen.distance - distance, seen.rate - dot(seen.velocity, sight)])
        return miss, seen, sight, distance

    def _by_plane(self, plane: Array, point: Array) -> Array:
        """Return the derivative (2, 2, N) of `_miss` by (x, y)."""
        steps = _DIFFERENCE_STEP * np.eye(2)[:, :, None]
        columns = [self._miss(plane + s, point)[0] - self._miss(plane - s, point)[0] for s in steps]
        return np.stack(columns, axis=1) / (2 * _DIFFERENCE_STEP)

    def _project(self, ground: Array) -> Array:
        return self._image(self._solve(ecef_from_ground(ground).T))

    def _solve(self, point: Array) -> Array:
        """Return (x, y) (2, N) of points (3, N), by Newton from the scene centre."""
        low, high = self._bounds

        def moved(plane: Array) -> Array:
            step = _solve_systems(self._by_plane(plane, point), self._miss(plane, point)[0])
            return np.clip(plane - step, low, high)

        plane, settled = newton(moved, np.where(np.isfinite(point[:2]), 0.0, np.nan))
        _, seen, sight, _ = self._miss(plane, point)
        side = dot(aside(seen.position, seen.velocity, self.look == "right"), sight)
        inside = ((plane > low) & (plane < high)).all(axis=0)
        plane[:, ~(inside & (side < 0) & settled.all(axis=0))] = np.nan
        return plane

    def _to_radar(self, ground: Array) -> Array:
        point = ecef_from_ground(ground).T
        _, _, sight, distance = self._miss(self._solve(point), point)
        return (sight * distance).T

    def _derivatives(self, ground: Array) -> tuple[Array, Array]:
        point = ecef_from_ground(ground).T
        plane = self._solve(point)
        slope = self._by_plane(plane, point)
        _, seen, sight, distance = self._miss(plane, point)
        toward = dot(seen.velocity, sight)
        by_point = np.stack([sight, (seen.velocity - toward * sight) / distance])  # (2, 3, N)
        moved = -np.stack([_solve_systems(slope, by_point[:, k]) for k in range(3)], axis=1)  # d(x, y)/dX
        by_ground = np.einsum("ikn,nkj->nij", moved, ecef_from_ground_jacobian(ground))
        return self._image(plane), (by_ground / np.array(self.spacing)[:, None])[:, ::-1]

    def _localize(self, image: Array, alt: Array) -> Array:
        low, high = self._bounds
        plane = ((image[:, ::-1] - np.array(self.origin)) * np.array(self.spacing)).T
        plane[:, ~((plane > low) & (plane < high)).all(axis=0)] = np.nan
        seen = self.formation.at(plane[0], plane[1], self.orbit)
        ahead = -seen.rate / np.sqrt(dot(seen.velocity, seen.velocity))
        ground, _ = on_circle(seen.position, seen.velocity, seen.distance, alt, self.look == "right", ahead)
        return ground


def _solve_systems(matrix: Array, right: Array) -> Array:
    """Return the solutions (2, N) of 2 x 2 systems (2, 2, N)."""
    (a, b), (c, d) = matrix
    return np.asarray(np.stack([d * right[0] - b * right[1], a * right[1] - c * right[0]]) / (a * d - b * c))


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
    arp = padded(_polynomial(root, f"Position/ARPPoly/{axis}", 1) for axis in "XYZ")
    model = Monostatic(
        orbit=Curve.polynomial(arp.T, 0.0, root.positive("Timeline/CollectDuration")),
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
