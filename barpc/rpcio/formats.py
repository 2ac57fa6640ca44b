"""The table of RPC file formats: how each is recognised, read and written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from barpc.atomic import write_text
from barpc.errors import InputError, RpcFormatError
from barpc.rpcio import fixed, structured, text, xml
from barpc.rpcio.fields import ReadOptions
from barpc.rpcio.images import rpc_vrt, write_rpc_copy, write_rpc_nitf
from barpc.sensor.rpc import RPC
from barpc.sidefile import RPC_FILE


@dataclass(frozen=True)
class Format:
    """One syntax of RPC files.

    Parameters
    ----------
    name : str
        As ``--rpc-format`` and messages call it.
    suffixes : tuple of str
        Ends of the names of files to be written, the usual one first; reading goes by content.
    sniff : callable
        Whether a file's text is of this format.
    read : callable
        (text, file name for messages, options) -> RPC.
    write : callable or None
        RPC -> text.
    beside : str
        End of the name of the file that a run writes for an image, after the image's name.
    consumers : tuple of str
        Tools that read what is written (rows of `barpc.handoff.CONSUMERS`); barpc reads every one. A written file is
        opened by each that is installed; where none is, that is said.
    """

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[str], bool]
    read: Callable[[str, str, ReadOptions], RPC]
    write: Callable[[RPC], str] | None = None
    beside: str = ""
    consumers: tuple[str, ...] = ()


FORMATS: dict[str, Format] = {
    row.name: row
    for row in (
        Format(
            "txt",
            ("_RPC.TXT", "_rpc.txt", ".rpc", ".txt"),
            text.sniff_txt,
            text.read_txt,
            text.write_txt,
            "_RPC.TXT",
            ("gdal, beside an image", "rpcm"),
        ),
        Format(
            "rpb",
            (".RPB", ".rpb"),
            text.sniff_rpb,
            text.read_rpb,
            text.write_rpb,
            ".RPB",
            ("gdal, beside an image",),
        ),
        Format(
            "geom",
            (".geom",),
            text.sniff_geom,
            text.read_geom,
            text.write_geom,
            ".geom",
            ("keywords", "shareloc"),
        ),
        Format(
            "xml",
            (".XML", ".xml"),
            xml.sniff_maxar,
            xml.read_maxar,
            xml.write_maxar,
            ".rpc.xml",
            ("gdal, beside an image",),
        ),
        Format(
            "json",
            (".json",),
            structured.sniff_json,
            structured.read_json,
            structured.write_json,
            ".rpc.json",
            ("rpcm",),
        ),
        Format("dimap", (), xml.sniff_dimap, xml.read_dimap),
        Format("enmap", (), xml.sniff_enmap, xml.read_enmap),
        Format("gdal", (), xml.sniff_gdal, xml.read_gdal),
        Format("yaml", (), structured.sniff_yaml, structured.read_yaml),
        Format("envi", (), text.sniff_envi, text.read_envi),
        Format("alos", (), fixed.sniff_alos, fixed.read_alos),
    )
}
"""Name -> format. One row a syntax; readers are tried in this order."""

WRITABLE: dict[str, Format] = {name: row for name, row in FORMATS.items() if row.write is not None}
"""The formats that are written, in the order in which they are offered."""


@dataclass(frozen=True)
class Carrier:
    """A raster that carries an RPC.

    Parameters
    ----------
    suffixes : tuple of str
        Ends of its names, the usual one first.
    write : callable
        (rpc, image, path, where the file will stand, overwrite): writes it.
    consumers : tuple of str
        As of `Format`.
    """

    suffixes: tuple[str, ...]
    write: Callable[[RPC, Path, Path, Path, bool], None]
    consumers: tuple[str, ...]


def _vrt(rpc: RPC, image: Path, path: Path, place: Path, overwrite: bool) -> None:
    write_text(path, rpc_vrt(rpc, image, place), overwrite=overwrite)


def _copy(rpc: RPC, image: Path, path: Path, _place: Path, overwrite: bool) -> None:
    write_rpc_copy(rpc, image, path, overwrite=overwrite)


def _nitf(rpc: RPC, image: Path, path: Path, _place: Path, overwrite: bool) -> None:
    write_rpc_nitf(rpc, image, path, overwrite=overwrite)


_READ_BY = ("gdal", "rpcm", "shareloc", "orthority")
CARRIERS: dict[str, Carrier] = {
    "vrt": Carrier((".vrt",), _vrt, _READ_BY),
    "copy": Carrier((".tif", ".tiff"), _copy, _READ_BY),
    "nitf": Carrier((".ntf",), _nitf, _READ_BY),
}
"""Name -> raster that carries an RPC."""


def _rows() -> list[Format | Carrier]:
    return [*CARRIERS.values(), *WRITABLE.values()]


def row_of(path: Path | str) -> Format | Carrier | None:
    """The row of a file to be written, by its name; None where no name ends so."""
    name = Path(path).name.lower()
    for row in _rows():
        if name.endswith(tuple(suffix.lower() for suffix in row.suffixes)):
            return row
    return None


def write_camera(
    rpc: RPC, path: Path | str, image: Path | str, *, place: Path | str | None = None, overwrite: bool = False
) -> None:
    """Write an RPC into a file or a raster, as the name says.

    Parameters
    ----------
    rpc : RPC
        What to write.
    path : Path or str
        The file.
    image : Path or str
        The image that a raster carries.
    place : Path or str, optional
        Where the file will stand in the end, if not at `path`; its name decides.
    overwrite : bool
        Replace an existing file, never the image.

    Raises
    ------
    RpcFormatError, ImageError, OutputError
        No format by that name; the image or the file cannot be read or written.
    """
    place = Path(path if place is None else place)
    row = row_of(place)
    if isinstance(row, Carrier):
        row.write(rpc, Path(image), Path(path), place, overwrite)
    else:
        write_text(path, _writer(place, None)(rpc), overwrite=overwrite)


def find_rpc(folder: Path, image: Path) -> Path:
    """The file in a folder that holds the RPC of an image of that name, in any format that is written.

    Raises
    ------
    InputError
        There is none.
    """
    present = {entry.name.lower(): entry for entry in sorted(folder.iterdir())}
    ends = [suffix for row in _rows() for suffix in row.suffixes]
    ends += [row.beside for row in WRITABLE.values()]
    for name in (image.name, *(image.stem + end for end in dict.fromkeys(ends))):
        if name.lower() in present:
            return present[name.lower()]
    tried = ", ".join(row.suffixes[0] for row in _rows())
    raise InputError(f"{folder}: no RPC of {image.name} there (looked for {image.stem} with {tried})")


def parse(data: bytes, name: str, options: ReadOptions | None = None) -> tuple[RPC, str]:
    """The RPC in the bytes of a file, and the name of the format that was recognised.

    Parameters
    ----------
    data : bytes
        The whole file.
    name : str
        The file, for messages.
    options : ReadOptions, optional
        Pixel convention and band.

    Raises
    ------
    RpcFormatError
        Empty, too large, of no known format, or of a known one and not valid.
    """
    if not data.strip():
        raise RpcFormatError(f"{name}: the file is empty, expected an RPC")
    RPC_FILE.check(name, len(data))
    content = text.decode(data)
    for row in FORMATS.values():
        if row.sniff(content):
            return row.read(content, name, options or ReadOptions()), row.name
    raise RpcFormatError(f"{name}: no RPC format recognised (known: {', '.join(FORMATS)})")


def write_rpc(rpc: RPC, path: Path | str, *, format: str | None = None, overwrite: bool = False) -> None:
    """Write an RPC to a text file; every number reads back to the bit.

    Parameters
    ----------
    rpc : RPC
        What to write.
    path : Path or str
        The file. Its name chooses the format: ``_RPC.TXT``, ``.RPB``, ``.geom``, ``.XML`` (Maxar), ``.json``
        (rpcm). An RPC goes into a raster by `write_rpc_vrt` or `write_rpc_copy`, never into the input.
    format : str, optional
        A row of `FORMATS`, whatever the name.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    RpcFormatError
        No format by that name.
    OutputError
        The file exists or cannot be written.
    """
    path = Path(path)
    write_text(path, _writer(path, format)(rpc), overwrite=overwrite)


def _writer(path: Path, name: str | None) -> Callable[[RPC], str]:
    row = row_of(path) if name is None else WRITABLE.get(name)
    if isinstance(row, Format) and row.write is not None:
        return row.write
    known = ", ".join(f"{n} ({row.suffixes[0]})" for n, row in WRITABLE.items())
    raise RpcFormatError(f"{path}: an RPC is not written in this format; choose one of {known}")
