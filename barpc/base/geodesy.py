"""WGS84: ground coordinates (lon, lat, alt) to ECEF and back, with derivatives, and the local frame.

`ground` is (lon [deg], lat [deg], alt [m above the ellipsoid]) and `ecef` is (x, y, z) [m], always on the
last axis; leading axes broadcast. Nothing here raises for a point: what is not finite comes out as NaN.
Outlines become GeoJSON as RFC 7946 asks: longitudes -180 to 180, polygons cut at the antimeridian, closed at a pole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from barpc.base.errors import InputError

Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
ByteImage = npt.NDArray[np.uint8]
Box = tuple[int, int, int, int]
"""Pixels of an image: col, row of the first one, width, height [px]."""

WGS84_A = 6378137.0  # semi-major axis [m]
WGS84_F = 1.0 / 298.257223563  # flattening
WGS84_B = WGS84_A * (1.0 - WGS84_F)  # semi-minor axis [m]
WGS84_E2 = WGS84_F * (2.0 - WGS84_F)  # first eccentricity, squared
EARTH_RATE = 7.292115e-5  # rotation of the Earth [rad/s]
SPEED_OF_LIGHT = 299792458.0  # in vacuum [m/s]

_EP2 = WGS84_E2 / (1.0 - WGS84_E2)  # second eccentricity, squared
ALTITUDES = (-1000.0, 9500.0)
"""The Earth's ground stays inside this [m], with a margin; RPCs that state more are cut to it."""
EVERYWHERE = (-500.0, 9000.0)
"""Altitudes of all ground on Earth [m], that a camera of no stated altitudes is used for."""
GEOID = 110.0
"""m: no geoid lies farther from the ellipsoid."""
STATED, INFERRED, DEFAULT = "stated", "inferred", "default"
"""How it is known what heights count from: a person or a file says it; a format's definition does; nothing does."""
TURNS = 540.0
"""Longitudes are taken by whole turns up to this [deg]."""
MAX_COORDINATE = 1e9
"""No place, size or other number of a file comes near, be it in px, deg or m."""
NEWTON_STEPS = 12
"""Steps of a Newton method that gains digits with every one, at most: it ends where it has settled."""
NEWTON_TOLERANCE = 1e-4
"""Of the last of these steps [px or m], where they are quadratic: what it leaves is below rounding."""
CHUNK = 8192
"""Points worked on at a time, so that temporaries stay in cache."""
np.empty(32 * 2**20 - 2**16, dtype=np.uint8)  # its end tells glibc to keep what is freed: pages taken again cost faults
_RAD = np.pi / 180.0


@dataclass(frozen=True)
class HeightDatum:
    """The vertical datum assumed for the heights of a source: the ellipsoid, or a geoid; evidence for the other."""

    source: str  # of the adjustment's datum: "gcps", "heights" (of a DEM) or "altimetry"
    name: str  # in sentences
    otherwise: float  # m that the heights would be higher by if they counted from the other of both
    provenance: str  # `STATED`, `INFERRED` or `DEFAULT`
    converted: bool = False  # by a geoid: they were taken to count from it
    above: tuple[tuple[float, float], ...] = ()  # their offset above others of known datum, and its sigma [m]


def parts(stop: int, size: int = CHUNK, start: int = 0) -> Iterator[slice]:
    """Yield slices of start .. stop, of a `size` that stays in cache."""
    for first in range(start, stop, size):
        yield slice(first, min(first + size, stop))


def as_numbers(values: npt.ArrayLike, what: str, wanted: str = "") -> Array:
    """Return values as float64, those that are masked as NaN; InputError where they are complex, or no numbers."""
    given: Any = values
    try:
        if isinstance(given, (list, tuple)) and any(hasattr(one, "mask") for one in given):
            given = np.ma.stack(given)
        found: Any = given if isinstance(given, np.ndarray) else np.asarray(given)
        if found.dtype.kind == "c":
            raise InputError(f"{what}: complex numbers; give their real parts")
        if hasattr(found, "mask"):  # (np.ma is a tenth of numpy, loaded when it is named)
            found = np.ma.filled(found.astype(np.float64), np.nan)
        return np.asarray(found, dtype=np.float64)
    except (TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{what}: numbers are expected{wanted} ({error})") from error


def as_points(values: npt.ArrayLike, width: int, what: str, axis: str) -> Array:
    """Return points as float64 (..., width); InputError names the last axis that is expected and the shape found."""
    points = as_numbers(values, what, f", (..., {width}): {axis}")
    if points.shape[-1:] != (width,):
        turned = "; transpose them" if points.ndim == 2 and len(points) == width else ""
        raise InputError(f"{what} of shape {points.shape}: (..., {width}) is expected, {axis} on the last axis{turned}")
    return points


def newton(
    moved: Callable[[Array], Array], x: Array, tolerance: float | Array = NEWTON_TOLERANCE
) -> tuple[Array, BoolArray]:
    """Return where steps from `x` to `moved(x)` end, and which of its elements have settled to `tolerance`."""
    for _ in range(NEWTON_STEPS):
        before, x = x, moved(x)
        step = np.abs(x - before)
        if not (step > tolerance).any():
            break
    return x, step <= tolerance


def as_ground(ground: npt.ArrayLike) -> Array:
    """Return ground points as float64 (..., 3); see `as_points`."""
    return as_points(ground, 3, "ground points", "lon, lat [deg], altitude [m]")


def as_image(image: npt.ArrayLike) -> Array:
    """Return image points as float64 (..., 2); see `as_points`."""
    return as_points(image, 2, "image points", "col, row [px]")


def pointwise(
    function: Callable[..., Iterable[Array]],
    shapes: Sequence[tuple[int, ...]],
    points: npt.ArrayLike,
    alt: npt.ArrayLike | None = None,
    rows: int = 0,
) -> list[Array]:
    """Apply a function of points (..., k) and altitudes (...), broadcast, to `CHUNK` of them at a time.

    The function takes (n, k) points, (n,) altitudes if there are any, and (rows, n) memory to overwrite if it asks for
    `rows` (fresh memory costs more than sums), and gives arrays (n, *shape); what is not finite is no news.
    """
    points = np.asarray(points, dtype=np.float64)
    lead, k = points.shape[:-1], points.shape[-1]
    flat: list[Array] = [points.reshape(-1, k)]
    if alt is not None:
        alt = as_numbers(alt, "altitudes")
        if alt.shape != lead:
            try:
                lead = np.broadcast_shapes(lead, alt.shape)
            except ValueError:
                expected = f"one, or an array that broadcasts with {lead}"
                raise InputError(f"altitudes of shape {alt.shape} for points {points.shape}: {expected}") from None
            points, alt = np.broadcast_to(points, (*lead, k)), np.broadcast_to(alt, lead)
        flat = [points.reshape(-1, k), alt.reshape(-1)]
    count = len(flat[0])
    out = [np.empty((count, *shape)) for shape in shapes]
    memory = np.empty((rows, min(count, CHUNK)))
    with np.errstate(all="ignore"):
        for part in parts(count):
            given = [array[part] for array in flat]
            if rows:
                given.append(memory[:, : len(given[0])])
            for whole, piece in zip(out, function(*given), strict=True):
                whole[part] = piece
    return [whole.reshape((*lead, *shape)) for whole, shape in zip(out, shapes, strict=True)]


def ecef_from_ground(ground: npt.ArrayLike) -> Array:
    """Return ECEF coordinates (..., 3) [m] of ground points (..., 3)."""
    ground = as_ground(ground)
    lon, lat, alt = ground[..., 0] * _RAD, ground[..., 1] * _RAD, ground[..., 2]
    sin_lat, cos_lat = np.sin(lat), np.cos(lat)
    normal = WGS84_A / np.sqrt(1.0 - WGS84_E2 * sin_lat * sin_lat)
    horizontal = (normal + alt) * cos_lat
    ecef = np.empty(ground.shape)
    ecef[..., 0] = horizontal * np.cos(lon)
    ecef[..., 1] = horizontal * np.sin(lon)
    ecef[..., 2] = (normal * (1.0 - WGS84_E2) + alt) * sin_lat
    return ecef


def ground_from_ecef(ecef: npt.ArrayLike) -> Array:
    """Return the ground coordinates (..., 3) of ECEF points (..., 3), lon in -180 to 180: inverts `ecef_from_ground`.

    Within 5e-9 m from -10 km to 900 km of altitude, and to the rounding of the coordinates far beyond.
    """
    (ground,) = pointwise(lambda part: [_geodetic(*np.ascontiguousarray(part.T))[0].T], [(3,)], ecef)
    return ground


def ground_rows_from_ecef(ecef: Array) -> tuple[Array, Array]:
    """Return the ground coordinates (3, N) of ECEF points (3, N) and their derivative (3, 3, N), row by row.

    `ground_from_ecef` and `ground_from_ecef_jacobian` in one, without the trigonometry of the second; as many points
    as suit the cache. Not finite for longitude at a pole.
    """
    x, y, _ = ecef
    ground, sin_lat, cos_lat, horizontal, root = _geodetic(*ecef)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / horizontal
        cos_lon, sin_lon = x * inverse, y * inverse
        inverse /= _RAD
        meridian = (1.0 - WGS84_E2) * WGS84_A / (root * root * root)
        north = (1.0 / _RAD) / (meridian + ground[2])
    jacobian = np.empty((3, 3, x.size))
    np.multiply(-sin_lon, inverse, out=jacobian[0, 0])
    np.multiply(cos_lon, inverse, out=jacobian[0, 1])
    jacobian[0, 2] = 0.0
    np.multiply(cos_lat, cos_lon, out=jacobian[2, 0])
    np.multiply(cos_lat, sin_lon, out=jacobian[2, 1])
    jacobian[2, 2] = sin_lat
    south = sin_lat * -north
    np.multiply(south, cos_lon, out=jacobian[1, 0])
    np.multiply(south, sin_lon, out=jacobian[1, 1])
    np.multiply(cos_lat, north, out=jacobian[1, 2])
    return ground, jacobian


def _geodetic(x: Array, y: Array, z: Array) -> tuple[Array, ...]:
    """Return the ground (3, N); sin, cos of latitude, distance from the axis [m], sqrt(1 - e^2 sin^2(lat)) (N,).

    Two steps (one leaves 1e-6 m, two 4e-9 m) of Bowring, "Transformation from spatial to geographical coordinates",
    from the start in "The accuracy of geodetic latitude and height equations", Survey Review 1976 and 1985.
    """
    square = x * x + y * y
    horizontal = np.sqrt(square)
    radius = np.sqrt(np.maximum(square + z * z, 1e-60))  # 0/0 at the centre of the Earth otherwise
    s, c = z * (WGS84_B + _EP2 * WGS84_B * WGS84_B / radius), WGS84_A * horizontal
    for _ in range(2):  # s : c is the sine to the cosine of the reduced latitude
        inverse = 1.0 / np.sqrt(s * s + c * c + 1e-60)
        s *= inverse
        c *= inverse
        s = WGS84_B * z + (_EP2 * WGS84_B * WGS84_B) * (s * s * s)
        c = WGS84_A * horizontal - (WGS84_E2 * WGS84_A * WGS84_A) * (c * c * c)
    s /= WGS84_B
    c /= WGS84_A
    inverse = 1.0 / np.sqrt(s * s + c * c + 1e-60)
    s *= inverse
    c *= inverse
    root = np.sqrt(1.0 - WGS84_E2 * (s * s))
    ground = np.empty((3, x.size))
    np.arctan2(y, x, out=ground[0])
    np.arctan2(s, c, out=ground[1])
    ground[:2] *= 1.0 / _RAD
    np.subtract(horizontal * c + z * s, WGS84_A * root, out=ground[2])
    return ground, s, c, horizontal, root


def enu_basis(ground: npt.ArrayLike) -> Array:
    """Return the rotation (..., 3, 3) of ECEF vectors into (east, north, up), its rows, at ground points (..., 3)."""
    ground = np.asarray(ground, dtype=np.float64)
    lon, lat = ground[..., 0] * _RAD, ground[..., 1] * _RAD
    sin_lon, cos_lon, sin_lat, cos_lat = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    basis = np.empty((*ground.shape[:-1], 3, 3))
    basis[..., 0, 0], basis[..., 0, 1], basis[..., 0, 2] = -sin_lon, cos_lon, 0.0
    basis[..., 1, 0], basis[..., 1, 1], basis[..., 1, 2] = -sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat
    basis[..., 2, 0], basis[..., 2, 1], basis[..., 2, 2] = cos_lat * cos_lon, cos_lat * sin_lon, sin_lat
    return basis


def up(ground: Array) -> Array:
    """Return the unit vectors (3, N) up at ground points (N, 3), ECEF."""
    lon, lat = ground[:, 0] * _RAD, ground[:, 1] * _RAD
    cos_lat = np.cos(lat)
    return np.stack([cos_lat * np.cos(lon), cos_lat * np.sin(lon), np.sin(lat)])


def metres_per_unit(ground: npt.ArrayLike) -> Array:
    """Return the metres (..., 3) of one degree of longitude, of latitude, and one metre up, at points (..., 3)."""
    ground = np.asarray(ground, dtype=np.float64)
    lat, alt = ground[..., 1] * _RAD, ground[..., 2]
    w2 = 1.0 - WGS84_E2 * np.sin(lat) ** 2
    normal = WGS84_A / np.sqrt(w2)
    scale = np.empty(ground.shape)
    scale[..., 0] = (normal + alt) * np.cos(lat) * _RAD
    scale[..., 1] = (normal * (1.0 - WGS84_E2) / w2 + alt) * _RAD
    scale[..., 2] = 1.0
    return scale


def ecef_from_ground_jacobian(ground: npt.ArrayLike) -> Array:
    """Return d(x, y, z) / d(lon, lat, alt) (..., 3, 3) [m/deg, m/deg, m/m] at ground points (..., 3)."""
    return np.swapaxes(enu_basis(ground) * metres_per_unit(ground)[..., None], -1, -2)


def ground_from_ecef_jacobian(ground: npt.ArrayLike) -> Array:
    """Return d(lon, lat, alt) / d(x, y, z) (..., 3, 3) [deg/m, deg/m, m/m] at GROUND points; infinite at a pole."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return enu_basis(ground) / metres_per_unit(ground)[..., None]


def wrap_longitude(lon: npt.ArrayLike, center: npt.ArrayLike = 0.0) -> Array:
    """Return the longitudes (...) [deg] by whole turns within 180 degrees of `center`; unchanged if they are there."""
    lon = np.asarray(lon, dtype=np.float64)
    turns = np.rint((lon - center) / 360.0)
    return lon - 360.0 * turns


def is_lonlat(places: Array) -> BoolArray:
    """Return which places (..., 2 or more) begin with a longitude and a latitude [deg]; NaN does not."""
    return np.asarray((np.abs(places[..., :2]) <= (TURNS, 90.0)).all(axis=-1))


def utm(lon: float, lat: float) -> tuple[int, str]:
    """Return the UTM zone of a place [deg], by its longitude alone, and the reference system of the zone."""
    zone = int((lon + 180.0) // 6.0) % 60 + 1
    return zone, f"EPSG:{(32600 if lat >= 0 else 32700) + zone}"


def reach(origin: Array, direction: Array, alt: Array) -> Array:
    """Return the ground (N, 3) where lines from points (3, N) [m] along vectors come down to altitudes (N,).

    NaN where they miss.
    """
    axes = np.array([[WGS84_A], [WGS84_A], [WGS84_B]]) + alt
    o, d = origin / axes, direction / axes
    a, b, c = (d * d).sum(axis=0), (o * d).sum(axis=0), (o * o).sum(axis=0) - 1.0
    distance = c / (np.sqrt(b * b - a * c) - b)  # the nearer root, without cancellation
    for _ in range(2):
        ground = ground_from_ecef((origin + distance * direction).T)
        distance += (alt - ground[:, 2]) / (up(ground) * direction).sum(axis=0)
    ground = ground_from_ecef((origin + distance * direction).T)
    ground[:, 2] = alt
    ground[~(distance > 0)] = np.nan
    return ground


# --- GeoJSON ----------------------------------------------------------------------------------------------


def polygon(ring: Array) -> dict[str, Any] | None:
    """Return the geometry of a footprint: counter-clockwise, closed; led to the pole if it goes around one.

    Of a ring (N, 2) as `barpc.sensor.geometry.footprint` gives it; a MultiPolygon where the antimeridian cuts it, None
    for an outline that is not finite.
    """
    ring = np.asarray(ring, dtype=np.float64)
    if not np.isfinite(ring).all():
        return None
    step = np.diff(ring[:, 0], append=ring[:1, 0])
    step = wrap_longitude(step)
    turn = float(step.sum() - wrap_longitude(step.sum()))
    if turn:
        ring = _clip(_around_pole(ring, step, turn), -180.0)
    if _area(ring) < 0:
        ring = ring[::-1]
    low, high = ring[:, 0].min(), ring[:, 0].max()
    parts = []
    for world in np.arange(low - wrap_longitude(low), high + 180.0, 360.0):
        part = _clip(ring, world - 180.0)
        if len(part) >= 3 and _area(part):
            part = part - [world, 0.0]
            parts.append([[*part.tolist(), part[0].tolist()]])
    if len(parts) == 1:
        return {"type": "Polygon", "coordinates": parts[0]}
    return {"type": "MultiPolygon", "coordinates": parts}


def geojson_feature(ring: Array, **properties: Any) -> dict[str, Any]:
    """Return a Feature of a footprint with its properties."""
    return {"type": "Feature", "properties": properties, "geometry": polygon(ring)}


def feature_collection(features: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a FeatureCollection."""
    return {"type": "FeatureCollection", "features": features}


def _around_pole(ring: Array, step: Array, turn: float) -> Array:
    """Return the area between an outline around a pole and that pole, three turns of it: from it one is cut."""
    lon = ring[0, 0] % 360.0 - 1.5 * turn + np.concatenate([[0.0], np.cumsum(np.tile(step, 3))])
    lat = np.append(np.tile(ring[:, 1], 3), ring[0, 1])
    pole = np.copysign(90.0, lat.mean())
    return np.column_stack([np.concatenate([lon, lon[[-1, 0]]]), np.concatenate([lat, [pole, pole]])])


def _area(ring: Array) -> float:
    x, y = ring.T
    return float(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def _clip(ring: Array, west: float) -> Array:
    """Return the part of a polygon within 360 degrees east of a meridian (Sutherland and Hodgman)."""
    for lon, side in ((west, 1.0), (west + 360.0, -1.0)):
        out: list[Array] = []
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            inside_a, inside_b = side * (a[0] - lon) >= 0, side * (b[0] - lon) >= 0
            if inside_a:
                out.append(a)
            if inside_a != inside_b:
                t = (lon - a[0]) / (b[0] - a[0])
                out.append(np.array([lon, a[1] + t * (b[1] - a[1])]))
        ring = np.array(out).reshape(-1, 2)
    return ring
