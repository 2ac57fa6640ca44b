"""Files of ground control points as other tools write them: a table of formats, each told by its content.

A reader says what its file holds (`GcpTable`): places in the file's own reference system, altitudes as they stand,
image points, which `open_gcps` brings to (0, 0) at the centre of the first pixel. Those of CSV, GeoJSON and ASP are
taken as they stand.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from barpc.base.errors import BarpcError, InputError, plain
from barpc.base.geodesy import INFERRED, Array
from barpc.base.remote import PathOrUrl
from barpc.base.safe_io import GEOJSON, TABLE, encoding_of, opened_text, parse_xml, read_head, read_json
from barpc.pointio.columns import guessed
from barpc.pointio.gcp_tables import ALONE, GCP_NAMES, KNOWN, NAN, SIGMAS, TEXTS, GcpTable, Row, named, of_columns
from barpc.pointio.layers import GEOPACKAGE, SHAPEFILE, read_layer
from barpc.pointio.tables import IMAGE_SIGMA, Texts, degrees, numbers_of, read_columns, row_of
from barpc.rasters.raster import driver_at, driver_of, open_raster
from barpc.rasters.vertical import ELLIPSOID, Vertical


class GcpFormat(NamedTuple):
    """One syntax: the beginning of its files, its reader, and the offset of its image points from barpc's [px]."""

    sniff: Callable[[str, bytes], bool]  # of a file's beginning, as a text and as bytes
    read: Callable[[Path], GcpTable]
    more: float = 0.0
    holds: str = ""  # words of docs/formats.md


def open_gcps(path: Path) -> tuple[str, GcpTable]:
    """Return the name of a file's format and its content; InputError where it does not parse."""
    text, head = _decoded_head(path)
    name = next(name for name, form in GCP_FORMATS.items() if form.sniff(text.lstrip("\ufeff \t\r\n"), head))
    table = GCP_FORMATS[name].read(path)
    table.numbers[:, 6:8] -= GCP_FORMATS[name].more
    if table.apart == "image" and table.images is None:  # of the image that the file is called as
        table = table._replace(images=Texts.of([path.name] * len(table.names)))
    return name, table


def _decoded_head(path: Path) -> tuple[str, bytes]:
    head = read_head(path, TABLE, 65536)
    return head.decode(encoding_of(head), "replace"), head


# --- tables with names of columns -------------------------------------------------------------------------

_STATED_CRS = re.compile(
    r"^#[ \t]*(?:(?:CRS|SRS|CoordinateSystem|Projection)[ \t]*[:=][ \t]*(\S.*)|(EPSG:\S+))",
    re.IGNORECASE | re.MULTILINE,
)
_AGISOFT = re.compile(r"^#\s*CoordinateSystem|X/(?:Longitude|East)", re.IGNORECASE | re.MULTILINE)


def _read_csv(path: Path) -> GcpTable:
    """Read a header of names, perhaps behind `#`, and comments that say the reference system."""
    text = _decoded_head(path)[0]
    at, delimiter, words = _header(text)
    columns, empty = named(path, words, lax=_AGISOFT.search(text) is not None)
    blank = {"alt", *SIGMAS} & columns.keys()
    read = read_columns(path, at + 1, delimiter, columns, columns.keys() & {*TEXTS}, blank)
    table, stated = of_columns(path, read, empty), _STATED_CRS.search("\n".join(_LINES.split(text)))
    return table if stated is None or table.crs else table._replace(crs=(stated[1] or stated[2]).rstrip())


_LINES = re.compile(r"\r\n|\r|\n")


def _header(text: str) -> tuple[int, str, list[str]]:
    """Return the number of the line with column names, its delimiter, and the names.

    It is counted from 0: the first that is no comment, or the last comment before it, where that line is of as many
    cells and names no columns; -1: none.
    """
    none: tuple[int, str, list[str]] = (-1, "", [])
    last = none
    for i, line in enumerate(_LINES.split(text)):
        bare = line.lstrip("\ufeff").strip()
        if not bare:
            continue
        sign = next((sign for sign in "\t;," if sign in bare), " ")
        words, comment = row_of(bare.lstrip("# "), sign), bare.startswith("#")
        if not any(numbers_of([word]) for word in words[1:4]) and _names_columns(words):
            last = i, sign, words
        if not comment:
            return last if last[0] == i or len(words) <= len(last[2]) else none
    return none


def _names_columns(words: Sequence[str]) -> bool:
    """Return whether words are a header: three columns of control or more, or two that could be one."""
    try:
        return len(guessed(words, KNOWN)[0]) > 2
    except InputError:
        return True


def _read_qgis(path: Path) -> GcpTable:
    """Read a CSV whose rows of pixels count upwards."""
    table = _read_csv(path)
    table.numbers[:, 7] *= -1.0
    if (table.numbers[:, 7] < 0.0).any():
        raise InputError(
            f"{path}: QGIS .points above its image (sourceY is positive): of an image with map coordinates of its own; "
            "set the points in the image without them"
        )
    return table


# --- lines in an order of their own -----------------------------------------------------------------------

_ODM = re.compile(r"(EPSG:\d+(?:\+\d+)?|\+proj=.*)|WGS84\s+UTM\s+(\d+)\s*([NS])", re.IGNORECASE)
_ENVI = re.compile(
    r"projection info\s*=\s*\{\s*(?:UTM\s*,\s*(?:1\s*,\s*)?(\d+)\s*,\s*(North|South)|(Geographic))", re.I
)


def _read_asp(path: Path) -> GcpTable:
    """Read the lines `id lat lon alt sigma_x sigma_y sigma_z image col row sigma_col sigma_row [image ...]`."""

    def rows() -> Iterator[Row]:
        for number, words in _words_of(path):
            try:
                lat, lon, *ground = map(float, words[1:7])
                if len(words) < 12 or len(words) % 5 != 2:
                    raise ValueError(f"{len(words)} words")
                for i in range(7, len(words), 5):
                    col, row, *spread = map(float, words[i + 1 : i + 5])
                    yield words[0], words[i], lon, lat, *ground, col, row, max(spread)
            except ValueError as error:
                if other := _foreign(words):
                    raise InputError(f"{path}: {other}") from error
                raise InputError(
                    f"{path}, line {number}: in no format that is read ({', '.join(GCP_FORMATS)}): a CSV begins with "
                    "its columns' names, a line of ASP's is 'id lat lon alt sx sy sz image col row scol srow ...' "
                    f"({plain(error)})"
                ) from error

    return GcpTable.of_rows(rows())._replace(vertical=Vertical(ELLIPSOID, provenance=INFERRED))


def _foreign(words: Sequence[str]) -> str:
    """Return the name of the program that writes such lines, and the cure; empty for an unknown one."""
    how, words = "give it a first line of names", [word for word in re.split(r"[\s,]+", " ".join(words)) if word]
    if len(words) == 4 and numbers_of(words) is not None:
        return (
            "ArcGIS links, pairs of places without names and heights: "
            f"{how} (col row east north) with rows that count downwards, --gcp-crs, and heights by --dem"
        )
    if len(words) > 4 and numbers_of(words[:4]) is not None and numbers_of(words[4:5]) is None:
        return f"Global Mapper's points: {how} (col,row,east,north,id,...), and --gcp-crs"
    if len(words) == 4 and numbers_of(words[2:]) is not None and "." in words[0]:
        return f"Pix4D's image points: {how} (image,id,col,row), and the ground points with another --gcp"
    if len(words) == 4 and numbers_of(words[1:]) is not None:
        return f"Pix4D's ground points: {how} (id,east,north,alt), the image points with another --gcp, and --gcp-crs"
    return ""


def _words_of(path: Path, sign: str = "#") -> Iterator[tuple[int, list[str]]]:
    """Yield the lines of words between blanks and commas that are no comments, by their numbers."""
    with opened_text(path, TABLE) as lines:
        for number, raw in enumerate(lines, start=1):
            line = re.split(rf"(?:^|\s){sign}", raw, maxsplit=1)[0] if sign in raw else raw
            quoted = '"' in line  # names of images with blanks
            if words := row_of(" ".join(line.split()), " ") if quoted else line.replace(",", " ").split():
                yield number, words


def _in_order(path: Path, order: str, lines: Iterable[tuple[int, list[str]]]) -> GcpTable:
    """Read lines whose words stand in an order of x, y, alt, col, row, image and id, of which the latter may lack."""

    def rows() -> Iterator[Row]:
        for number, words in lines:
            of = dict(zip(order.split(), words, strict=False))
            try:
                x, y, col, row = (float(of[key]) for key in ("x", "y", "col", "row"))
                alt = float(of.get("alt", "nan"))
            except (KeyError, ValueError) as error:
                raise InputError(f"{path}, line {number}: expected '{order}' ({plain(error)})") from error
            yield of.get("id", ""), of.get("image"), x, y, alt, *ALONE, col, row, IMAGE_SIGMA

    return GcpTable.of_rows(rows())


def _read_odm(path: Path) -> GcpTable:
    """Read a reference system, then lines `x y z col row image [name]`."""
    lines = _words_of(path)
    found = _ODM.match(" ".join(next(lines)[1]))
    crs = None if found is None else found[1] or f"WGS 84 / UTM zone {int(found[2])}{found[3].upper()}"
    return _in_order(path, "x y alt col row image id", lines)._replace(crs=crs)


def _read_envi_points(path: Path) -> GcpTable:
    """Read comments that say the reference system and the order, then lines `x y col row`."""
    head = _decoded_head(path)[0]
    if re.search(r"^;.*\b(Base|Warp)\b", head, re.MULTILINE):
        raise InputError(f"{path}: ENVI .pts of two images; one from image to map is needed")
    found, turned = _ENVI.search(head), re.search(r"^;\s*Image.*Map", head, re.MULTILINE | re.IGNORECASE)
    crs = None if found is None or found[3] else f"WGS 84 / UTM zone {int(found[1])}{found[2][0].upper()}"
    return _in_order(path, "col row x y" if turned else "x y col row", _words_of(path, ";"))._replace(crs=crs)


# --- layers of points -------------------------------------------------------------------------------------


def read_geojson(path: Path) -> GcpTable:
    """Read a GeoJSON, with the reference system that it could name before 2016; InputError where it is none."""
    document, crs = read_json(path, GEOJSON), None
    try:
        if "crs" in document:
            crs = str(document["crs"]["properties"]["name"])
        features = list(document["features"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: not a GeoJSON of points ({plain(error)})") from error
    return _of_features(path, features, None if crs is None or crs.endswith(("CRS84", "EPSG::4326")) else crs)


def _of_features(path: Path, features: Sequence[Any], crs: str | None, what: str = "a GeoJSON") -> GcpTable:
    """Read features with points and properties: `ji` (col, row) or names as of columns, `sigma_m` of three numbers."""
    try:
        rows = list(map(_properties, features))
    except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        raise InputError(
            f"{path}: not {what} of points, each with ji = [col, row], filename; sigma_m is [east, north, up], "
            f"sigma_px a number ({plain(error)})"
        ) from error
    if not rows:
        return GcpTable.of_rows([])
    columns, empty = named(path, words := list(dict.fromkeys(chain.from_iterable(rows))))
    read: dict[str, Any] = {}
    for key, name in ((key, words[i]) for key, i in columns.items()):
        cells = [of.get(name) for of in rows]
        try:
            read[key] = _as_texts(cells) if key in TEXTS else [_value(key, cell) for cell in cells]
        except ValueError as error:
            raise InputError(f"{path}: {name!r} of a point: {plain(error)}") from error
    return of_columns(path, read, empty)._replace(crs=crs)


def _properties(feature: Any) -> dict[str, Any]:
    """Return the coordinates and properties of a feature by the names of columns; any error where it is none."""
    of, spread = dict(feature["properties"] or {}), {"ji": ("col", "row"), "sigma_m": ("sx", "sy", "sz")}
    if feature.get("id") is not None and not {key.lower() for key in of} & set(GCP_NAMES["id"]):
        of["id"] = feature["id"]
    for key in spread.keys() & of.keys():
        of |= dict(zip(spread[key], of.pop(key), strict=True))
    if feature["geometry"] is None:
        raise ValueError("a feature without a geometry")
    x, y, *z = feature["geometry"]["coordinates"]
    return {"lon": x, "lat": y} | ({"alt": z[0]} if z else {}) | of


def _as_texts(cells: Iterable[Any]) -> Texts:
    return Texts.of("" if cell is None else str(cell) for cell in cells)


def _value(key: str, cell: Any) -> float | None:
    if cell is None and key not in ("lon", "lat", "col", "row"):
        return None
    if isinstance(cell, bool) or not isinstance(cell, (str, int, float)):
        raise ValueError(f"{str(cell)[:40]!r} is no number")
    return degrees(str(cell), key) if key in ("lon", "lat") else float(str(cell))


def _read_vector(path: Path) -> GcpTable:
    """Read the points of a GeoPackage or Shapefile."""
    return _of_features(path, *read_layer(path), "a layer")


# --- images -----------------------------------------------------------------------------------------------


def read_tags(path: PathOrUrl) -> tuple[GcpTable, tuple[int, int]]:
    """Return the GCP tags of an image, seen in that image alone, and its width and height [px].

    GDAL leaves their origin to the application: their range determines it (`_first_pixel`), or AREA_OR_POINT of the
    raster, whose tags GDAL returns counted from the corner. Else they are used unchanged.
    """
    with open_raster(path) as dataset:
        (gcps, crs), size, tags = dataset.gcps, (int(dataset.width), int(dataset.height)), dataset.tags()
    table = GcpTable.of_rows(
        (str(g.id or n), str(path), g.x, g.y, NAN if g.z is None else g.z, *ALONE, g.col, g.row, IMAGE_SIGMA)
        for n, g in enumerate(gcps, 1)
    )
    if not gcps:
        return table, size
    at, why = table.numbers[:, 6:8], ""
    if (first := _first_pixel(at, np.array(size))) is None:
        points = tags.get("AREA_OR_POINT") == "Point"
        first, why = (0.5, ", as of a raster of points") if points else (0.0, ", by default")
    at -= first
    where = {0.0: "the centre", 0.5: "the corner"}.get(first, f"{first:g} px before the centre")
    said = f"{len(gcps)} GCPs of {path.name}, counted from {where} of the first pixel{why}"
    system = None if crs is None or crs.to_string() in ("EPSG:4326", "OGC:CRS84") else crs.to_string()
    return table._replace(crs=system, said=said), size


_CONTROLS = re.compile(r"[\0-\x08\x0e-\x1f]")
_TEXT_CONTROLS = 1e-3  # of a text's characters: form feeds and the like
_LONGEST_LINE = 16384  # characters of a first line of names, or of a comment with a reference system


def _is_binary(text: str) -> bool:
    """Return whether the beginning of a file is no text: low heights of two bytes look like letters in UTF-16."""
    endless = len(text) > _LONGEST_LINE and not text.startswith(("{", "<")) and not re.search(r"[\r\n]", text)
    return "\0" in text or endless or len(_CONTROLS.findall(text)) > _TEXT_CONTROLS * len(text)


def _read_tagged(path: Path) -> GcpTable:
    if driver_at(path) is None:
        raise InputError(f"{path}: neither a text nor a file of points that is read ({', '.join(GCP_FORMATS)})")
    table, _ = read_tags(path)
    if not table.names:
        raise InputError(f"{path}: an image without GCP tags")
    return table


_CENTRE_TOLERANCE = 1e-3  # px: GCPs that end so near to a pixel's centre or edge are meant to lie there


def _first_pixel(at: Array, size: Array) -> float | None:
    """Return the coordinate of the first pixel's centre in image points (K, 2), by their range; None where unclear.

    Those that span a pixel less than the image, as Sentinel-1's, go from centre to centre, those that span all of it
    from edge to edge: they may begin at 0, at 0.5 or, of rasters of points that GDAL wrote and read, at 1.
    """
    start, beyond = at.min(axis=0), np.ptp(at, axis=0) - size
    edges = float(np.rint(beyond[0])) + 1.0
    told = (
        edges in (0.0, 1.0)
        and (np.abs(beyond - edges + 1.0) <= _CENTRE_TOLERANCE).all()
        and np.ptp(start) <= _CENTRE_TOLERANCE
    )
    first = np.rint(2.0 * start[0]) / 2.0
    return (
        float(first + 0.5 * edges)
        if told and 0.0 <= first <= 1.0 and abs(start[0] - first) <= _CENTRE_TOLERANCE
        else None
    )


# --- MicMac -----------------------------------------------------------------------------------------------

MICMAC = "MicMac XML"


def _read_micmac(path: Path) -> GcpTable:
    """Read ground points (DicoAppuisFlottant), image points (SetOfMesureAppuisFlottants), or both."""
    try:
        root = parse_xml(path, strip_namespaces=True)
    except BarpcError as error:
        raise InputError(str(error)) from error

    if root.tag == "kml":
        raise InputError(f"{path}: KML, places without image points; give a CSV (id,image,lon,lat,alt,col,row)")

    def stated(point: Element, tag: str, count: int, usual: str = "") -> tuple[float, ...]:
        numbers = tuple(map(float, (point.findtext(tag) or usual).split()))
        if len(numbers) != count:
            raise ValueError("too many or too few values")
        return numbers

    def called(element: Element, tag: str = "NamePt") -> str:
        return element.findtext(tag, "").strip()

    try:
        points = [*root.iter("OneAppuisDAF")]
        ground = {called(one): stated(one, "Pt", 3) + stated(one, "Incertitude", 3, "1 1 1") for one in points}
        seen = [
            (called(one), called(image, "NameIm"), stated(one, "PtIm", 2))
            for image in root.iter("MesureAppuiFlottant1Im")
            for one in image.iter("OneMesureAF1I")
        ]
    except ValueError as error:
        raise InputError(f"{path}: {MICMAC}, expected Pt of three numbers, PtIm of two ({plain(error)})") from error
    if not seen and not ground:
        raise InputError(f"{path}: XML without OneAppuisDAF or OneMesureAF1I, so no points of MicMac's")
    if not ground:
        return GcpTable.of_rows(((n, file, *[NAN] * 3, *ALONE, *at, IMAGE_SIGMA) for n, file, at in seen), "image")
    rows = [(n, file, *ground[n], *at, IMAGE_SIGMA) for n, file, at in seen if n in ground]
    alone = ((name, None, *place, NAN, NAN, IMAGE_SIGMA) for name, place in ground.items())
    return GcpTable.of_rows(rows or alone, "" if rows else "ground")


GCP_FORMATS: dict[str, GcpFormat] = {
    "GeoPackage or Shapefile": GcpFormat(
        lambda _, head: head.startswith((GEOPACKAGE, SHAPEFILE)), _read_vector, 0.0, "points; CSV's columns or `ji`"
    ),
    "image with GCP tags": GcpFormat(
        lambda text, head: driver_of(head) is not None or _is_binary(text), _read_tagged, 0.0,
        "GDAL's GCPs; first pixel by extent",
    ),
    "GeoJSON": GcpFormat(lambda text, _: text.startswith("{"), read_geojson, 0.0, "points; CSV's columns or `ji`"),
    MICMAC: GcpFormat(lambda text, _: text.startswith("<"), _read_micmac, 0.0, "perhaps two files"),
    "ENVI .pts": GcpFormat(
        lambda text, _: text.startswith(";"), _read_envi_points, 1.5, "`x y col row`"  # from the corner, as 1
    ),
    "QGIS .points": GcpFormat(
        lambda text, _: "mapX" in text[:4096] and _header(text)[0] >= 0, _read_qgis, 0.5,
        "`mapX,mapY,sourceX,sourceY`, rows negative",
    ),
    "ODM gcp_list.txt": GcpFormat(
        lambda text, _: _ODM.match(text) is not None, _read_odm, 0.5, "CRS; `x y z col row image`"
    ),
    "Metashape CSV": GcpFormat(
        lambda text, _: _AGISOFT.search(text) is not None and _header(text)[0] >= 0, _read_csv, 0.5,
        "`# CoordinateSystem`",
    ),
    "CSV": GcpFormat(lambda text, _: _header(text)[0] >= 0, _read_csv, 0.0, "named columns; `# CRS: ...`"),
    "ASP .gcp": GcpFormat(lambda *_: True, _read_asp, 0.0, "`id lat lon height sx sy sz image col row scol srow ...`"),
}  # fmt: skip
"""Name -> row: the first that knows the beginning reads the file. QGIS, ODM and Metashape count from the corner."""
