"""Area of interest for tie points: polygons of a GeoJSON file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import affinity

from barpc.base.errors import InputError, plain
from barpc.base.geodesy import Array, is_lonlat, wrap_longitude
from barpc.base.safe_io import GEOJSON, read_json
from barpc.scene import BoolArray

_MALFORMED = (
    ValueError, LookupError, TypeError, AttributeError, OverflowError, shapely.GEOSException,
)  # fmt: skip
_MOST_CROSSED = 2000  # times that an outline is untangled: GEOS takes a second, of twice as many ten
_TOGETHER = 64  # sides of an outline that are looked at together
_WGS84_NAMES = ("CRS84", "4326", "4979")
_WRAPPED = {"Feature": "geometry", "FeatureCollection": "features", "GeometryCollection": "geometries"}


@dataclass(frozen=True, eq=False)
class Area:
    """Part of the ground, at any altitude: polygons in lon, lat [deg], all of them three times, a whole turn apart."""

    outline: shapely.Geometry

    def plane(self, origin: Array, scale: Array) -> shapely.Geometry:
        """Return the area in a plane [m]: (lon, lat) minus `origin` (2,) [deg], times `scale` (2,) [m/deg]."""
        near = np.array([float(wrap_longitude(origin[0])), origin[1]])
        return shapely.transform(self.outline, lambda lonlat: (lonlat - near) * scale)

    def contains(self, lonlat: Array) -> BoolArray:
        """Return the points (N, 2), lon, lat [deg], that lie inside; NaN does not."""
        shapely.prepare(self.outline)
        return shapely.contains_xy(self.outline, wrap_longitude(lonlat[:, 0]), lonlat[:, 1])


def read_area(path: str | os.PathLike[str]) -> Area:
    """Read the polygons of a GeoJSON file as one area.

    Parameters
    ----------
    path : path
        Polygons, or features and collections of them; lon, lat [deg] on WGS84. An outline may cross the antimeridian
        with or without a jump of its longitudes, or be cut there (RFC 7946).

    Raises
    ------
    InputError
        The file cannot be read, or holds no polygon in degrees; the message names it.
    """
    data = read_json(Path(path), GEOJSON)
    try:
        crs = data.get("crs")  # before 2016 GeoJSON could name another reference system
        if crs is not None and not str(crs["properties"]["name"]).endswith(_WGS84_NAMES):
            raise ValueError(f"its coordinates are in {crs['properties']['name']}")
        polygons = [_valid(polygon) for polygon in _polygons(data)]
    except _MALFORMED as error:
        said = " ".join(plain(error).split())[:200]
        raise InputError(f"{path}: not an area of interest, GeoJSON polygons in degrees ({said})") from error
    turns = [affinity.translate(polygon, turn) for polygon in polygons for turn in (-360.0, 0.0, 360.0)]
    outline = shapely.union_all(turns)
    if not outline.area > 0:
        raise InputError(f"{path}: the area of interest holds no polygon of any extent")
    return Area(outline)


def _valid(polygon: shapely.Polygon) -> shapely.Geometry:
    """Return a polygon whose outline does not cross itself; ValueError where it does too often to be untangled."""
    if polygon.is_valid:
        return polygon
    rings = [np.asarray(ring.coords) for ring in (polygon.exterior, *polygon.interiors)]
    sides: Any = shapely.linestrings(np.concatenate([np.stack([ring[:-1], ring[1:]], axis=1) for ring in rings]))
    tree, crossed = shapely.STRtree(sides), 0
    for first in range(0, len(sides), _TOGETHER):
        crossed += tree.query(sides[first : first + _TOGETHER], predicate="crosses").shape[1]
        if crossed > 2 * _MOST_CROSSED:  # each was found from both sides
            raise ValueError(f"an outline crosses itself more than {_MOST_CROSSED} times")
    return shapely.make_valid(polygon)


def _polygons(data: dict[str, Any]) -> Iterator[shapely.Polygon]:
    """Yield all polygons of a GeoJSON object, whatever they are wrapped in."""
    kind = data["type"]
    if kind in _WRAPPED:
        inner = data[_WRAPPED[kind]]
        for part in [inner] if kind == "Feature" else inner:
            yield from _polygons(part)
    elif kind in ("Polygon", "MultiPolygon"):
        parts = data["coordinates"] if kind == "MultiPolygon" else [data["coordinates"]]
        for part in parts:
            rings = [_ring_vertices(ring) for ring in part]
            for hole in rings[1:]:
                hole[:, 0] += wrap_longitude(hole[0, 0], rings[0][0, 0]) - hole[0, 0]
            yield shapely.Polygon(rings[0], rings[1:])
    else:
        raise ValueError(f"a {kind} is no polygon")


def _ring_vertices(positions: list[list[float]]) -> Array:
    """Return the vertices (N, 2) of an outline, the first between -180 and 180, its longitudes without jumps."""
    ring = np.array([position[:2] for position in positions], dtype=np.float64).reshape(-1, 2)
    if not is_lonlat(ring).all():
        raise ValueError("a position is not a longitude and a latitude")
    step = np.diff(ring[:, 0])
    # a full turn is no jump, but an edge along a parallel
    ring[1:, 0] -= np.cumsum(np.where(np.abs(step) < 360.0, step - wrap_longitude(step), 0.0))
    ring[:, 0] += wrap_longitude(ring[:1, 0]) - ring[0, 0]
    return ring
