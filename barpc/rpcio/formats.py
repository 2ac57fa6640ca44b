"""The table of RPC file formats: how each is recognised, read and written."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from barpc.base import remote
from barpc.base.atomic import write_text
from barpc.base.errors import InputError, RpcFormatError
from barpc.base.remote import PathOrUrl
from barpc.base.safe_io import RPC_FILE
from barpc.rpcio import text, xml
from barpc.rpcio.images import write_rpc_copy, write_rpc_vrt
from barpc.rpcio.text import ReadOptions, Size
from barpc.sensor.rpc import RPC


@dataclass(frozen=True)
class Format:
    """One syntax of RPC files: how it is called, told from others, read, written and verified."""

    name: str  # as --rpc-format and messages call it
    suffixes: tuple[str, ...]  # ends of the names of written files in any case, the usual one first
    sniff: Callable[[str], bool]  # whether a file's text is of this format
    read: Callable[[str, str, ReadOptions], RPC]  # of text, file name for messages, options
    write: Callable[..., str] | None = None  # of an RPC; `sized`: and of the width and height of its image, or None
    beside: str = ""  # end of the name of the file that a run writes for an image, after the image's name
    consumers: tuple[str, ...] = ()  # besides barpc, of what is written: rows of `verify_outputs.CONSUMERS`
    sized: bool = False  # whether it states the size of its image
    reads: str = ""  # what of it is read, and how it is written: words of docs/formats.md
    writes: str = ""


def _has(*patterns: str, markup: bool = False) -> Callable[[str], bool]:
    """Return whether a text holds all of some patterns, searched in time in proportion to it.

    And whether it is `markup`: the metadata of an image, 1 MB of XML, take 10 ms a pattern that is none of theirs.
    """

    def holds(content: str) -> bool:
        return markup == bool(_MARKUP.match(content)) and all(re.search(pattern, content) for pattern in patterns)

    return holds


_MARKUP = re.compile(r"\s*+<")


GRID_SUFFIX, CORRECTION = "_grid.tif", "_correction.tif"
"""Ends of the names of localisation and correction grids."""
SIGN = "image point = that of the RPC in this file + (dcol, drow)"  # in a correction grid
_TEXT_ENDS = ("_RPC.TXT", ".rpc", ".txt", ".rpc_adj")  # the last: of SAT-BA, beside the .rpc that it adjusted
_BESIDE = "gdal, beside an image"
# OSSIM's keys, in small letters, have two digits
_TXT = _has(r"(?im)^[ \t]*+(?:[a-z][\w.]*?[._])?LINE_NUM_COEFF(_1|(?-i:(?<=F)_01))?[ \t]*+[:=,](?(1)|[ \t]*+[-+.\d])")
_RPB = _has(r"(?i)lineNumCoef\s*+=")
_GEOM = _has(r"(?m)^[ \t]*+(\w++\.)?line_num_coeff_00[ \t]*+:")
_is_maxar = _has(r"<(\w+:)?LINENUMCOEF", markup=True)
_JSON = _has(r"\A\s*+\{", r'"row_num"|(?i:"line_num_coeff")|"rowNum"')
_SYNTAXES = (
    Format(
        "txt", _TEXT_ENDS, _TXT, text.read_txt, text.write_txt, "_RPC.TXT", (_BESIDE, "rpcm"),
        reads="`KEY: value`, all with one prefix (`RPC_`) or none; coefficients from 1 or 0; units (feet and radians "
        "are converted, others refused), signs, `=`, D exponents, UTF-8, UTF-16, Latin-1; denominators that do not "
        "start with 1. Planet, SkySat, BlackSky, IKONOS, GeoEye, OrbView, KOMPSAT, EROS; ZY-3, Jilin-1 as described; "
        "WHU-TLC's inverse is not used",
        writes="shortest exact decimals, no units",
    ),
    Format(
        "rpb", (".RPB",), _RPB, text.read_rpb, text.write_rpb, ".RPB", (_BESIDE,),
        reads="Maxar's lists in parentheses; RPC00A reordered, SpecIds of converters (XXX) as RPC00B",
        writes="`RPC00B`; unknown accuracies left out",
    ),
    Format(
        "geom", (".geom",), _GEOM, text.read_geom, text.write_geom, ".geom", ("keywords", "shareloc"),
        reads="OSSIM's `polynomial_format` B, A; adjustments (`adj_param_N`) applied, a rotation only where rows and "
        "columns share a denominator; speaks of the FULL image ([crops](conventions.md#crops))",
        writes="all keys",
    ),
    Format(
        "xml", (".XML",), _is_maxar, xml.read_maxar, xml.write_maxar, ".rpc.xml", (_BESIDE,), sized=True,
        reads="Maxar's `<isd><RPB>`, with or without namespace",
    ),
    Format(
        "json", (".json",), _JSON, text.read_rpc_json, text.write_json, ".rpc.json", ("rpcm",),
        reads="names of rpcm, rasterio, VisSat", writes="rpcm's",
    ),
    Format(  # a Dimap_Document, or the model alone
        "dimap", (), _has(r"<(\w+:)?Global_RFM", markup=True), xml.read_dimap,
        reads="v1, v2, v3: the inverse model; the direct one never",
    ),
    Format(
        "enmap", (), _has(r"<bandID\s", r"(?i)<ROW_NUM_0?1>", markup=True), xml.read_enmap, reads="`band=N`"
    ),
    Format(
        "radarsat", (), _has(r"<(\w+:)?rationalFunctions\b", markup=True), xml.read_radarsat, reads="RADARSAT-2, RCM"
    ),
    Format(
        "gdal", (), _has(r"<(VRTDataset|PAMDataset)\b", r'domain="RPC"', markup=True), xml.read_gdal,
        reads="VRT, `.aux.xml`",
    ),
    Format("yaml", (), _has(r"(?m)^[ \t]++line_num_coeff:"), text.read_yaml, reads="orthority's"),
    Format("envi", (), _has(r"(?im)^[ \t]*+rpc info\s*+=\s*+\{"), text.read_envi, reads="its header"),
    Format(
        "bare", (), text.is_bare_rpc, text.read_bare, reads="90, 92 (tag 50844) or 93 numbers without names"
    ),
    Format("alos", (), _has(r"\A[\d+\-. ]{66}[\d+\-. Ee]{960}"), text.read_alos, reads="PRISM, AVNIR"),
)  # fmt: skip
FORMATS: dict[str, Format] = {row.name: row for row in _SYNTAXES}
"""Name -> format. One row a syntax; readers are tried in this order."""

WRITABLE: dict[str, Format] = {name: row for name, row in FORMATS.items() if row.write is not None}
"""The formats that are written, in the order in which they are offered."""


@dataclass(frozen=True)
class Carrier:
    """A raster that carries an RPC."""

    suffixes: tuple[str, ...]
    write: Callable[[RPC, PathOrUrl, Path, Path, bool], None]  # rpc, image, path, where it will stand, overwrite
    consumers: tuple[str, ...] = ("gdal", "rpcm", "shareloc", "orthority")
    reads: str = ""  # as of a `Format`
    writes: str = ""


CARRIERS: dict[str, Carrier] = {
    "vrt": Carrier(
        (".vrt",),
        lambda rpc, image, path, place, over: write_rpc_vrt(rpc, image, path, place=place, overwrite=over),
        reads="[below](#vrt)",
    ),
    "copy": Carrier(
        (".tif", ".tiff"),
        lambda rpc, image, path, _, over: write_rpc_copy(rpc, image, path, overwrite=over),
        reads="tag 50844, to the bit",
        writes="the source's bytes, a new directory behind them (a cloud-optimised header then says so); refused near "
        "4 GB of classic TIFF; other rasters are converted",
    ),
}
"""Name -> raster that carries an RPC."""


def _writable_formats() -> list[Format | Carrier]:
    return [*CARRIERS.values(), *WRITABLE.values()]


def format_for(path: Path | str) -> Format | Carrier | None:
    """Return the row of a file to be written, by its name; None where no name ends so."""
    name = Path(path).name.lower()
    return next((row for row in _writable_formats() if name.endswith(tuple(end.lower() for end in row.suffixes))), None)


def write_camera(
    rpc: RPC,
    path: Path | str,
    image: Path | str,
    *,
    place: Path | str | None = None,
    overwrite: bool = False,
    size: Size | None = None,
) -> None:
    """Write an RPC into a file, or into a raster with the pixels of `image`, as the name of `path` says.

    `place` is where the file will stand in the end, if not at `path`: its name decides. An existing file is replaced
    if `overwrite` is true, never the image. `size` is the image's (width, height) [px], which Maxar's XML states.
    """
    place = Path(path if place is None else place)
    row = format_for(place)
    if isinstance(row, Carrier):
        row.write(rpc, remote.location(image), Path(path), place, overwrite)
    else:
        write_text(path, _text_of(rpc, place, None, size), overwrite=overwrite)


_STABLE_FOLDER_AGE = 2_000_000_000  # ns: after so long a change shows in a folder's time


def files_of(folder: Path) -> Mapping[str, str]:
    """Return the names in a folder by themselves in lower case; none where it cannot be read.

    A folder of ten thousand images is asked for each of them: it is listed once while its time stays the same.
    """
    try:
        changed = folder.stat().st_mtime_ns
        settled = time.time_ns() - changed > _STABLE_FOLDER_AGE
        return (_folder_listing if settled else _folder_listing.__wrapped__)(folder, changed)
    except OSError:
        return {}


@lru_cache(maxsize=4)
def _folder_listing(folder: Path, _changed: int) -> Mapping[str, str]:
    return {name.lower(): name for name in sorted(entry.name for entry in os.scandir(folder))}


def find_rpc(folder: Path, image: Path) -> Path:
    """Return the file in a folder with an image's RPC, in a format of `FORMATS` with a writer (or InputError)."""
    present = files_of(folder)
    ends = [suffix for row in _writable_formats() for suffix in row.suffixes]
    ends += [row.beside for row in WRITABLE.values()]
    for name in (image.name, *(image.stem + end for end in dict.fromkeys(ends))):
        if name.lower() in present:
            return folder / present[name.lower()]
    tried = ", ".join(row.suffixes[0] for row in _writable_formats())
    raise InputError(f"{folder}: no RPC of {image.name} there (looked for {image.stem} with {tried})")


def parse_rpc(data: bytes, name: str, options: ReadOptions | None = None) -> tuple[RPC, str]:
    """Return the RPC in all bytes of a file called `name`, and its format; RpcFormatError where none is valid."""
    if not data.strip():
        raise RpcFormatError(f"{name}: the file is empty, expected an RPC")
    RPC_FILE.check(name, len(data))
    content = text.decode_text(data)
    for row in FORMATS.values():
        if row.sniff(content):
            return row.read(content, name, options or ReadOptions()), row.name
    if (part := _PART_OF_MAXAR.search(content)) is not None:
        raise RpcFormatError(f"{name}: Maxar's {part[1].lower()} file, a part of a camera: give the product's .XML")
    hint = "; it holds a physical camera model: give FILE,model=physical" if holds_physical(content) else ""
    raise RpcFormatError(f"{name}: no RPC format recognised (known: {', '.join(FORMATS)}){hint}")


_PART_OF_MAXAR = re.compile(r"(?im)^[ \t]*+BEGIN_GROUP\s*+=\s*+(ATTITUDE|EPHEMERIS|GEOMETRIC|OPTICAL|PRINCIPAL)")
holds_physical = _has(r"<(\w+:)?(ATTLIST|Refined_Model|Scene_Source)\b", markup=True)  # the last: of DIMAP 1


def write_rpc(
    rpc: RPC,
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    overwrite: bool = False,
    size: Size | None = None,
) -> None:
    """Write an RPC to a text file; every number reads back to the bit.

    Parameters
    ----------
    path : Path or str
        Its name chooses the format, ``_RPC.TXT``, ``.RPB`` or another of the suffixes in `WRITABLE`. An RPC goes into
        a raster by `write_rpc_vrt` or `write_rpc_copy`, never into the input.
    format : str, optional, a row of `FORMATS`, whatever the name
    overwrite : bool, replace an existing file
    size : tuple of int, optional, width and height of the image [px]: Maxar's XML states it

    Returns
    -------
    None, once the file is whole

    Raises
    ------
    RpcFormatError
        No format by that name.
    OutputError
        The file exists or cannot be written.

    Examples
    --------
    >>> rpc = barpc.read_rpc("data_samples/view_00.tif")
    >>> barpc.write_rpc(rpc, "view_00.RPB")
    >>> barpc.read_rpc("view_00.RPB") == rpc
    True
    """
    path = Path(path)
    write_text(path, _text_of(rpc, path, format, size), overwrite=overwrite)


def _text_of(rpc: RPC, path: Path, name: str | None, size: Size | None) -> str:
    row = format_for(path) if name is None else WRITABLE.get(name)
    if isinstance(row, Format) and row.write is not None:
        return row.write(rpc, size) if row.sized else row.write(rpc)
    known = ", ".join(f"{n} ({row.suffixes[0]})" for n, row in WRITABLE.items())
    raise RpcFormatError(f"{path}: an RPC is not written in this format; choose one of {known}")
