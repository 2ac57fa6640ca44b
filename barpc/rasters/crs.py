"""Reference systems by text, whoever wrote it: codes, names and WKT, and plain parameters of projections.

PROJ and GDAL open what a text points at: grids, files of definitions, addresses, pipelines. So a text is held to a
closed grammar before either sees it, and the text in a raster before GDAL opens the raster.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, BinaryIO

from barpc.base.errors import BarpcError, ImageError, InputError
from barpc.base.remote import PathOrUrl
from barpc.base.safe_io import IMAGE, MB, opened

if TYPE_CHECKING:
    from pyproj import CRS

_MAX_LETTERS = 50_000  # the longest WKT of EPSG has a fifth
_CURE = "give its code, such as EPSG:32631"

_WKT = re.compile(r"[A-Za-z]\w*\s*[\[(]\s*\"", re.ASCII)
_TOKEN = re.compile(r'"((?:[^"]|"")*)"|(\w+)\s*[\[(]|[\])]', re.ASCII)
_PROJ_METHOD = re.compile(r"PROJ[ _]\w+( O_PROJ=\w+)?|PROJECT\w*", re.ASCII)
_OPENING_NODES = """BOUNDCRS ABRIDGEDTRANSFORMATION PARAMETERFILE COORDINATEOPERATION CONCATENATEDOPERATION
POINTMOTIONOPERATION GEOGTRAN VERTTRAN FITTED_CS PARAM_MT CONCAT_MT INVERSE_MT PASSTHROUGH_MT"""
_NAME = re.compile(r"(?!.*//)(?=[^\W_])[\w :/().,'&+*°–-]+")
_OGC_NAME = re.compile(r"https?://(?:www\.)?opengis\.net/def/crs/(\w+)/[\w.]+/(\w+)", re.IGNORECASE)
_NUMBERS_AND_NAMES = """a alpha approx axis azi b datum ellps es f gamma h k k_0 lat_0 lat_1 lat_2 lat_ts lon_0 lon_1
lon_2 lonc lonlat no_defs no_off no_uoff no_rot ns over pm R R_A R_V R_a R_g R_h rf south sweep to_meter towgs84 type
units vto_meter vunits wktext x_0 y_0 zone"""
_PLAIN_PARAMETERS = {
    **dict.fromkeys(_NUMBERS_AND_NAMES.split(), re.compile(r"[\w.,:^+-]+")),
    "proj": re.compile(r"(?!pipeline)\w+", re.IGNORECASE),
    "nadgrids": re.compile("@null"),  # none: GDAL says so of the Mercator projection of web maps
}


def plain_crs(text: str, of: PathOrUrl | str, kind: type[BarpcError] = InputError) -> str:
    """Return the text of a reference system that makes PROJ and GDAL open nothing.

    Allowed are codes and names that PROJ's database has, WKT without grids, and projections by plain parameters. Else
    an error of the class `kind`, which begins with `of`, the file or flag that the text is from.
    """
    bare = text.strip()
    if _WKT.match(bare):
        wrong = _wrong_in_wkt(bare)
    elif "=" in bare:
        wrong = _wrong_parameter(bare)
    else:
        wrong = "" if _NAME.fullmatch(bare) or _OGC_NAME.fullmatch(bare) else "no code, name or WKT"
    if len(bare) > _MAX_LETTERS:
        wrong = f"{len(bare)} characters"
    if wrong:
        cure = "give it its code (gdal_edit.py -a_srs EPSG:32631)" if kind is ImageError else _CURE
        raise kind(f"{of}: {bare[:60]!r} is not read as a reference system ({wrong}); {cure}")
    return bare


def _wrong_in_wkt(wkt: str) -> str:
    """Return the first part of a WKT that could make PROJ open a file, in words; empty where there is none."""
    if wkt.count('"') % 2 or not _TOKEN.sub("", wkt).isascii():
        return "its quotation marks are not in pairs"
    open_nodes = [("", list[str]())]
    for found in _TOKEN.finditer(wkt):
        text, node = found.groups()
        if text is not None:
            open_nodes[-1][1].append(text)
            if wrong := _wrong_in_node(*open_nodes[-1]):
                return wrong
        elif node is not None:
            if node.upper() in _OPENING_NODES.split():
                return f"it holds a {node}"
            open_nodes.append((node.upper(), []))
        elif len(open_nodes) > 1:
            open_nodes.pop()
    return ""


def _wrong_in_node(node: str, texts: Sequence[str]) -> str:
    first, last = texts[0].strip().upper(), texts[-1]
    of_proj = node in ("METHOD", "PROJECTION", "GEOIDMODEL") and first.startswith("PROJ")
    if of_proj and not (node != "GEOIDMODEL" and _PROJ_METHOD.fullmatch(first)):
        return f"{node} {last[:40]!r}"
    if node != "EXTENSION" or len(texts) == 1:
        return ""
    return _wrong_parameter(last) if first == "PROJ4" else f"{first[:20]} {last[:40]!r}" if "PROJ" in first else ""


def _wrong_parameter(text: str) -> str:
    """Return the first wrong word of a text of projection parameters, in words; empty where there is none."""
    for word in text.split():
        key, _, value = word.removeprefix("+").partition("=")
        pattern = _PLAIN_PARAMETERS.get(key)
        if pattern is None or (value and not pattern.fullmatch(value)):
            return f"{word[:40]!r} is no parameter of a projection"
    return ""


def crs_of(text: str, of: PathOrUrl | str) -> CRS:
    """Return the reference system of a text, as `plain_crs` allows it; InputError where PROJ knows none."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    bare = plain_crs(text, of)
    if found := _OGC_NAME.fullmatch(bare):
        bare = ":".join(found.groups())
    try:
        return CRS.from_user_input(bare)
    except (CRSError, UnicodeError) as error:
        raise InputError(f"{of}: {bare[:60]!r} is no reference system that PROJ knows; {_CURE}") from error


# --- what a raster says before GDAL opens it --------------------------------------------------------------

_GEO_ASCII = 34737
"""TIFF tag of GeoTIFF's texts, where Esri's tools put a WKT."""
_GEO_JP2 = bytes.fromhex("b14bf8bd083d4b43a5ae8cd7d5a6ce03")
_MOST_ENTRIES, _MOST_BOXES = 65_535, 1_000


def refuse_opening_crs(path: PathOrUrl, driver: str) -> None:
    """Raise ImageError for a raster with a reference system that would make GDAL open another file with it."""
    if driver not in ("GTiff", "JP2OpenJPEG"):
        return
    with opened(path, IMAGE) as file:
        for text in _texts_of_tiff(file) if driver == "GTiff" else _texts_of_jp2(file):
            if found := _WKT.search(text):
                plain_crs(text[found.start() :], path, ImageError)


def _texts_of_tiff(file: BinaryIO) -> Iterator[str]:
    """Yield GeoTIFF's texts of a TIFF's first directory; of a damaged file none, which GDAL refuses."""
    head = file.read(16)
    order, big = "<" if head[:2] == b"II" else ">", b"+" in head[2:4]
    number, entry = struct.Struct(order + ("Q" if big else "I")), struct.Struct(order + ("HHQ8s" if big else "HHI4s"))
    count = struct.Struct(order + ("Q" if big else "H"))
    try:
        file.seek(number.unpack_from(head, 8 if big else 4)[0])
        entries = min(count.unpack(file.read(count.size))[0], _MOST_ENTRIES)
        data = file.read(entries * entry.size)
        for tag, _, size, value in entry.iter_unpack(data[: len(data) // entry.size * entry.size]):
            if tag == _GEO_ASCII and size > len(value):
                file.seek(number.unpack(value)[0])
                yield file.read(min(size, 2 * _MAX_LETTERS)).decode("latin-1")
    except (struct.error, OverflowError, ValueError):
        return


def _texts_of_jp2(file: BinaryIO) -> Iterator[str]:
    """Yield GeoTIFF's texts in the boxes of a JPEG 2000."""
    at = 0
    for _ in range(_MOST_BOXES):
        file.seek(at)
        head = file.read(32)
        if len(head) < 32:
            return
        size, begins = int.from_bytes(head[:4]), 8
        if size == 1:
            size, begins = int.from_bytes(head[8:16]), 16
        if head[4:8] == b"uuid" and head[begins : begins + 16] == _GEO_JP2:
            file.seek(at + begins + 16)
            yield from _texts_of_tiff(io.BytesIO(file.read(min(size or MB, MB))))
        if size < begins:  # 0: the last
            return
        at += size
