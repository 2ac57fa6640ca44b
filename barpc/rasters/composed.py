"""Rasters that more files belong to, or are named in: raw pixels with ENVI's header, Maxar's tiles, PCIDSK's channels.

GDAL opens what such files name, by whatever driver. So it is shown a header written anew of what was read here, no list
of tiles, and no PCIDSK with pixels in other files.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from barpc.base.errors import BarpcError, ImageError, RpcFormatError
from barpc.base.remote import PathOrUrl
from barpc.base.safe_io import IMAGE, MB, RPC_FILE, Kind, opened, read_bytes, read_head
from barpc.rasters.crs import plain_crs
from barpc.rasters.vrt import INDIRECT, Rect

_ENVI_HEADER = Kind("an ENVI header", MB, ImageError)
_BYTES = {1: 1, 2: 2, 3: 4, 4: 4, 5: 8, 6: 8, 9: 16, 12: 2, 13: 4, 14: 8, 15: 8}  # ENVI's data type -> of a value
_SYSTEM = "coordinate system string"
_SHOWN = {
    *("samples", "lines", "bands", "header offset", "data type", "interleave", "byte order", "data ignore value"),
    *("map info", "projection info", "geo points", "rpc info", _SYSTEM),
}
# Each value runs to the end of its line, or to the brace that closes it.
_LINE = re.compile(r"^[ \t]*+(\w[\w ]*+)=[ \t]*+(\{[^{}]*+\}|[^{\n]*+)", re.MULTILINE)


def header_beside(path: PathOrUrl) -> Path | None:
    """Return the ENVI header beside a raw image, by the names that GDAL looks for; None without one."""
    if not isinstance(path, Path):
        return None
    for file in (path.parent / f"{name}{end}" for name in (path.stem, path.name) for end in (".hdr", ".HDR")):
        with suppress(BarpcError):
            if file.is_file() and read_head(file, _ENVI_HEADER, 4) == b"ENVI":
                return file
    return None


def _lines_of(header: Path) -> dict[str, str]:
    text = read_bytes(header, _ENVI_HEADER).decode("latin-1").translate({0: " ", 13: "\n"})
    return {" ".join(key.lower().split()): value.strip() for key, value in _LINE.findall(text)}


def _size_of(lines: Mapping[str, str]) -> int | None:
    """Return how many bytes the pixels of a header take; None where it does not say."""
    keys = ("samples", "lines", "bands", "data type", "header offset")
    cells = [lines.get(key, "0" if key == "header offset" else "") for key in keys]
    if not all(re.fullmatch(r"\d{1,9}", cell, re.ASCII) for cell in cells):
        return None
    samples, rows, bands, kind, offset = map(int, cells)
    return samples * rows * bands * _BYTES.get(kind, 0) + offset


def is_raw(path: PathOrUrl) -> bool:
    """Return whether a file is as long as an ENVI header beside it says of its pixels: nothing else tells raw ones."""
    header = header_beside(path)
    if header is None or not isinstance(path, Path):
        return False
    with suppress(BarpcError, OSError):
        return _size_of(_lines_of(header)) == path.stat().st_size > 0
    return False


def shown_header(path: Path) -> bytes:
    """Return the header of a raw image for GDAL: lines that were read, and a reference system that opens no file."""
    header = header_beside(path)
    if header is None:
        raise ImageError(f"{path}: its ENVI header is gone")
    lines = {key: value for key, value in _lines_of(header).items() if key in _SHOWN}
    if system := lines.get(_SYSTEM, "").strip("{} \t\n"):
        plain_crs(system, header, ImageError)
    text = "\n".join(["ENVI", "file type = ENVI Standard", *(f"{key} = {value}" for key, value in lines.items()), ""])
    return text.encode("latin-1")


_CHANNEL_BYTES, _NAME_BYTES = 1024, 64  # bytes of a channel's header, and of the name of its file
_MOST_CHANNELS = 4096


def refuse_foreign_channels(path: PathOrUrl) -> None:
    """Raise ImageError for a PCIDSK file with pixels in another one, which GDAL would open by whatever driver."""
    with opened(path, IMAGE) as file:
        head = file.read(512)
        cells = [head[start:end].strip(b" \0") for start, end in ((336, 352), (376, 384))]
        if not all(re.fullmatch(rb"\d{1,16}", cell) for cell in cells) or int(cells[1]) > _MOST_CHANNELS:
            raise ImageError(f"{path}: cannot be read as PCIDSK: its header does not say where its channels are")
        for index in range(int(cells[1])):
            file.seek(512 * (int(cells[0]) - 1) + _CHANNEL_BYTES * index + _NAME_BYTES)
            name = file.read(_NAME_BYTES).strip(b" \0")
            if name and not re.fullmatch(rb"/SIS=\d+", name):  # that: of tiles in the file itself
                raise ImageError(f"{path}: the pixels of its channel {index + 1} are in another file; export it as one")


def tiles_of(text: str, path: PathOrUrl) -> dict[str, Rect]:
    """Return first and last col, row of every tile that Maxar's ``.TIL`` lists, by name in lower case; none of others.

    RpcFormatError where a tile has none.
    """
    found = {}
    for number, part in enumerate(re.split(r"BEGIN_GROUP\s*+=\s*+TILE_\d++", text)[1:], start=1):
        words = {word.lower(): value for word, value in re.findall(r'(\w++)\s*+=\s*+"?([^";\n]*+)"?;', part)}
        cells = [words.get(f"{key}offset", "").strip() for key in ("ulcol", "ulrow", "lrcol", "lrrow")]
        if not (words.get("filename") and all(re.fullmatch(r"\d{1,7}", cell) for cell in cells)):
            raise RpcFormatError(f"{path}: tile {number} has no file name, or no corners UL and LR in pixels")
        found[words["filename"].strip().lower()] = (int(cells[0]), int(cells[1]), int(cells[2]), int(cells[3]))
    return found


def placed_tiles(path: Path) -> dict[Path, Rect]:
    """Return the tiles beside a ``.TIL`` that lists them, and where each goes: col, row, width, height [px]."""
    try:
        listed = tiles_of(read_bytes(path, RPC_FILE).decode("latin-1"), path)
    except RpcFormatError as error:
        raise ImageError(str(error)) from error
    present = {entry.name.lower(): entry.name for entry in os.scandir(path.parent)}
    for name, (left, top, right, bottom) in listed.items():
        if INDIRECT.match(name) or "\\" in name or Path(name).name != name:
            raise ImageError(f"{path}: its tile {name[:200]!r} is no file beside it")
        if right < left or bottom < top:
            raise ImageError(f"{path}: its tile {name} ends before it begins")
    if not listed:
        raise ImageError(f"{path}: lists no tiles")
    return {
        path.parent / present.get(name, name): (left, top, right - left + 1, bottom - top + 1)
        for name, (left, top, right, bottom) in listed.items()
    }
