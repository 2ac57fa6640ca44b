"""Layers of a run in one GeoPackage (OGC 12-128r19), with styles for QGIS: by sqlite3 and shapely."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
import numpy.typing as npt
import shapely

from barpc.base.geodesy import Array

_WGS84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]]'
)
_EMPTY_GEOPACKAGE = """
PRAGMA application_id = 0x47504B47;
PRAGMA user_version = 10300;
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
    organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
    description TEXT DEFAULT '', last_change DATETIME NOT NULL, min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE,
    srs_id INTEGER REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL UNIQUE REFERENCES gpkg_contents(table_name),
    column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL
    REFERENCES gpkg_spatial_ref_sys(srs_id), z TINYINT NOT NULL, m TINYINT NOT NULL,
    PRIMARY KEY (table_name, column_name));
CREATE TABLE layer_styles (id INTEGER PRIMARY KEY, f_table_catalog TEXT, f_table_schema TEXT, f_table_name TEXT,
    f_geometry_column TEXT, styleName TEXT, styleQML TEXT, styleSLD TEXT, useAsDefault BOOLEAN, description TEXT,
    owner TEXT, ui TEXT, update_time DATETIME);
"""
_SYSTEMS = (
    ("undefined cartesian", -1, "NONE", -1, "undefined"),
    ("undefined geographic", 0, "NONE", 0, "undefined"),
    ("WGS 84", 4326, "EPSG", 4326, _WGS84),
)
_UNCHANGED = "1970-01-01T00:00:00.000Z"  # a date would make two runs of the same differ
_HEAD = struct.pack("<2sBBi", b"GP", 0, 1, 4326)  # little-endian, without an envelope


_GOOD, _LOOK, _BAD = "26,127,55,255", "138,93,0,255", "193,18,31,255"  # as on the report


@dataclass(frozen=True)
class Style:
    """How QGIS draws a layer: outlines, or a marker, of a size [mm], coloured by values of a column ("": the rest)."""

    column: str
    colours: Mapping[str, str]
    marker: str = ""
    size: float = 0.5
    angle: int = 0

    def qml(self) -> str:
        """Return the style in the language of QGIS."""
        root = Element("qgis", version="3.0", styleCategories="Symbology")
        renderer = SubElement(root, "renderer-v2", type="categorizedSymbol", attr=self.column)
        categories, symbols = SubElement(renderer, "categories"), SubElement(renderer, "symbols")
        kind, layer_class = ("marker", "SimpleMarker") if self.marker else ("fill", "SimpleFill")
        for k, (value, colour) in enumerate(self.colours.items()):
            SubElement(categories, "category", symbol=str(k), value=value, label=value or "others", render="true")
            layer = SubElement(SubElement(symbols, "symbol", name=str(k), type=kind), "layer", {"class": layer_class})
            drawn = {"style": "no", "outline_color": colour, "outline_width": str(self.size)}
            if self.marker:
                drawn = {"name": self.marker, "color": colour, "size": str(self.size), "angle": str(self.angle)}
                drawn["outline_style"] = "no"
            for key, held in drawn.items():
                SubElement(layer, "prop", k=key, v=held)
        SubElement(root, "layerGeometryType").text = "0" if self.marker else "2"
        return tostring(root, encoding="unicode")


STYLES = {
    "footprints": Style("status", {"failed": _BAD, "doubtful": _LOOK, "weak": _LOOK, "": _GOOD}),
    "tie_points": Style("track", {"": "9,105,218,255"}, "circle", 0.8),
    "gcps": Style("status", {"used": "130,80,223,255", "not seen": "87,96,106,255", "": _BAD}, "triangle", 3.5),
    "check_points": Style("status", {"": "179,89,0,255"}, "triangle", 3.5, 180),
}
"""Layer -> its style."""


@dataclass(frozen=True)
class MapLayer:
    """Geometries in lon, lat [deg], points with altitude [m above the ellipsoid], and columns with their SQL types."""

    name: str
    shapes: Sequence[Any] | npt.NDArray[np.object_]
    columns: Sequence[str]
    rows: Iterable[Sequence[Any]]


def point_shapes(lonlatalt: Array) -> npt.NDArray[np.object_]:
    """Return points (n, 3) as geometries."""
    return np.asarray(shapely.points(lonlatalt))


def geopackage(layers: Sequence[MapLayer]) -> bytes:
    """Return the bytes of a GeoPackage; layers without geometries are left out.

    Examples
    --------
    >>> import numpy as np
    >>> layer = MapLayer("ties", point_shapes(np.array([[5.4, 43.3, 120.0]])), ["track INTEGER"], [(7,)])
    >>> geopackage([layer])[:15]
    b'SQLite format 3'
    """
    with closing(sqlite3.connect(":memory:")) as data:
        data.executescript(_EMPTY_GEOPACKAGE)
        data.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)", _SYSTEMS)
        for layer in layers:
            if not len(layer.shapes):
                continue
            kinds, box = {shape.geom_type for shape in layer.shapes}, shapely.total_bounds(layer.shapes)
            kind, has_z = kinds.pop() if len(kinds) == 1 else "Geometry", int(layer.shapes[0].has_z)
            columns = ["fid INTEGER PRIMARY KEY", f"geom {kind.upper()}", *layer.columns]
            data.execute(f"CREATE TABLE {layer.name} ({', '.join(columns)})")
            about = (layer.name, "features", layer.name, _UNCHANGED, *map(float, box), 4326)
            data.execute("INSERT INTO gpkg_contents VALUES (?, ?, ?, '', ?, ?, ?, ?, ?, ?)", about)
            column = (layer.name, "geom", kind.upper(), 4326, has_z, 0)
            data.execute("INSERT INTO gpkg_geometry_columns VALUES (?, ?, ?, ?, ?, ?)", column)
            marks = ", ".join("?" * (1 + len(layer.columns)))
            blobs = (_HEAD + one for one in shapely.to_wkb(layer.shapes, byte_order=1, flavor="iso").tolist())
            rows = ((blob, *row) for blob, row in zip(blobs, layer.rows, strict=True))
            data.executemany(f"INSERT INTO {layer.name} VALUES (NULL, {marks})", rows)  # noqa: S608  (our own names)
            if layer.name in STYLES:
                style = (layer.name, "geom", layer.name, STYLES[layer.name].qml(), _UNCHANGED)
                data.execute("INSERT INTO layer_styles VALUES (NULL, '', '', ?, ?, ?, ?, '', 1, '', '', '', ?)", style)
        about = "layer_styles", "attributes", "layer_styles", _UNCHANGED
        data.execute("INSERT INTO gpkg_contents VALUES (?, ?, ?, '', ?, NULL, NULL, NULL, NULL, 0)", about)
        data.commit()
        return bytes(data.serialize())
