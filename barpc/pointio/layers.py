"""GeoPackages (OGC 12-128r19) and Shapefiles of points, read without GDAL, which opens the files beside them."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

from barpc.base.errors import InputError, plain
from barpc.base.safe_io import OPTIONS, TABLE, read_bytes, read_text

GEOPACKAGE, SHAPEFILE = b"SQLite format 3\0", b"\0\0\x27\x0a"
"""First bytes of the files."""
Feature = dict[str, Any]
"""As of GeoJSON; `geometry` is None where a feature has none."""

_ENVELOPES = {0: 0, 1: 32, 2: 48, 3: 48, 4: 64}  # bytes before a geometry, by the flags
_TURN, _MOST_TURNS = 10_000_000, 100  # steps of sqlite: a million points take 30 million
_POINT_TYPES = {1: 2, 11: 3, 21: 2}  # shape types: coordinates that are read
_DBF_TEXTS = b"CNFDL"


def read_layer(path: Path) -> tuple[list[Feature], str | None]:
    """Return the points of a layer, of a GeoPackage the first, and its reference system; InputError: it is none."""
    data = read_bytes(path, TABLE)
    read = _of_geopackage if data.startswith(GEOPACKAGE) else _of_shapefile
    try:
        return read(path, data)
    except (sqlite3.Error, struct.error, ValueError, IndexError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        what = "GeoPackage" if data.startswith(GEOPACKAGE) else "Shapefile"
        raise InputError(f"{path}: a damaged {what}, or one without a layer of points ({plain(error)})") from error


def _of_geopackage(path: Path, data: bytes) -> tuple[list[Feature], str | None]:
    with closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(data[:18] + b"\1\1" + data[20:])  # what a log beside it would add was not written to it
        turns = iter(range(_MOST_TURNS))
        base.set_progress_handler(lambda: next(turns, None) is None, _TURN)
        found = base.execute(
            "SELECT g.table_name, g.column_name, g.srs_id FROM gpkg_geometry_columns g JOIN gpkg_contents c "
            "ON c.table_name = g.table_name WHERE c.data_type = 'features' ORDER BY c.rowid"
        ).fetchone()
        if found is None:
            raise InputError(f"{path}: a GeoPackage without a layer of points")
        table, geometry, system = found
        quoted = '"' + str(table).replace('"', '""') + '"'
        keys = {name for _, name, *_, key in base.execute(f"PRAGMA table_info({quoted})") if key}
        rows = base.execute(f"SELECT * FROM {quoted}")  # noqa: S608  (quoted)
        names = [one[0] for one in rows.description]
        features = []
        for row in rows:
            of = dict(zip(names, row, strict=True))
            place = _point_of_blob(of.pop(geometry))
            left = {name: cell for name, cell in of.items() if name not in keys and not isinstance(cell, bytes)}
            features.append({"geometry": place and {"coordinates": place}, "properties": left})
        known = base.execute(
            "SELECT organization, organization_coordsys_id, definition FROM gpkg_spatial_ref_sys WHERE srs_id = ?",
            (system,),
        ).fetchone()
    if known is None or str(known[0]).upper() == "NONE":
        return features, None
    return features, f"EPSG:{known[1]}" if str(known[0]).upper() == "EPSG" else str(known[2])


def _point_of_blob(blob: bytes | None) -> list[float] | None:
    """Return the coordinates of a point in GeoPackage's binary; None for one that is empty; ValueError for another."""
    if blob is None or blob[3] & 0x10:
        return None
    if blob[:2] != b"GP":
        raise ValueError("no geometry of GeoPackage's")
    wkb = blob[8 + _ENVELOPES[blob[3] >> 1 & 7] :]
    order = "<" if wkb[0] else ">"
    kind = struct.unpack_from(f"{order}I", wkb, 1)[0]
    if kind % 1000 != 1:
        raise ValueError("no point")
    return list(struct.unpack_from(f"{order}{3 if kind in (1001, 3001) else 2}d", wkb, 5))


def _of_shapefile(path: Path, data: bytes) -> tuple[list[Feature], str | None]:
    table, system = (
        next((one for one in map(path.with_suffix, (end, end.upper())) if one.exists()), None)
        for end in (".dbf", ".prj")
    )
    if table is None:
        raise InputError(f"{path}: a Shapefile without its {path.stem}.dbf beside it")
    rows, places = list(_rows_of_dbf(path, read_bytes(table, TABLE))), list(_points_of_shp(data))
    if len(rows) != len(places):
        raise InputError(f"{path}: {len(places)} points, and {len(rows)} rows in {table.name}")
    crs = None if system is None else read_text(system, OPTIONS).strip()
    kept = (one for one in zip(places, rows, strict=True) if one[1] is not None)
    return [{"geometry": at and {"coordinates": at}, "properties": row} for at, row in kept], crs


def _points_of_shp(data: bytes) -> Iterator[list[float] | None]:
    at = 100
    while at + 12 <= len(data):
        words, kind = struct.unpack_from(">I", data, at + 4)[0], struct.unpack_from("<I", data, at + 8)[0]
        if kind and kind not in _POINT_TYPES:
            raise ValueError("no point")
        yield list(struct.unpack_from(f"<{_POINT_TYPES[kind]}d", data, at + 12)) if kind else None
        at += 8 + 2 * words


def _rows_of_dbf(path: Path, data: bytes) -> Iterator[Feature | None]:
    """Yield the rows of a dBase table, cells as texts, None where they are blank; None for a row that is deleted."""
    count, begins, width = struct.unpack_from("<IHH", data, 4)
    fields, at = list[tuple[str, int, int]](), 1
    for start in range(32, begins - 31, 32):
        if data[start] == 0x0D:
            break
        if data[start + 11] in _DBF_TEXTS:
            fields.append((data[start : start + 11].split(b"\0")[0].decode("latin-1"), at, at + data[start + 16]))
        at += data[start + 16]
    if at > width or begins + count * width > len(data):
        raise InputError(f"{path}: its .dbf ends too early")
    for row in (data[begins + n * width : begins + (n + 1) * width] for n in range(count)):
        cells = (row[first:last].strip(b" \0*") for _, first, last in fields)
        named = zip((name for name, *_ in fields), cells, strict=True)
        yield None if row[:1] == b"*" else {name: _decoded(cell) if cell else None for name, cell in named}


def _decoded(cell: bytes) -> str:
    try:
        return cell.decode()
    except UnicodeDecodeError:
        return cell.decode("latin-1")
