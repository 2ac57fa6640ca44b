"""The table of RPC file formats: how each is recognised, read and written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from barpc.atomic import write_text
from barpc.errors import RpcFormatError
from barpc.rpcio import fixed, structured, text, xml
from barpc.rpcio.fields import ReadOptions
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
    """

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[str], bool]
    read: Callable[[str, str, ReadOptions], RPC]
    write: Callable[[RPC], str] | None = None


FORMATS: dict[str, Format] = {
    row.name: row
    for row in (
        Format(
            "txt", ("_RPC.TXT", "_rpc.txt", ".rpc", ".txt"), text.sniff_txt, text.read_txt, text.write_txt
        ),
        Format("rpb", (".RPB", ".rpb"), text.sniff_rpb, text.read_rpb, text.write_rpb),
        Format("geom", (".geom",), text.sniff_geom, text.read_geom, text.write_geom),
        Format("xml", (".XML", ".xml"), xml.sniff_maxar, xml.read_maxar, xml.write_maxar),
        Format("json", (".json",), structured.sniff_json, structured.read_json, structured.write_json),
        Format("dimap", (), xml.sniff_dimap, xml.read_dimap),
        Format("enmap", (), xml.sniff_enmap, xml.read_enmap),
        Format("gdal", (), xml.sniff_gdal, xml.read_gdal),
        Format("yaml", (), structured.sniff_yaml, structured.read_yaml),
        Format("envi", (), text.sniff_envi, text.read_envi),
        Format("alos", (), fixed.sniff_alos, fixed.read_alos),
    )
}
"""Name -> format. One row a syntax; readers are tried in this order."""


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
    writable = {row.name: row.write for row in FORMATS.values() if row.write is not None}
    if name is None:
        ends = [(s, row.name) for row in FORMATS.values() for s in row.suffixes]
        name = next((n for suffix, n in ends if path.name.lower().endswith(suffix.lower())), None)
    if name in writable:
        return writable[name]
    known = ", ".join(f"{n} ({FORMATS[n].suffixes[0]})" for n in writable)
    raise RpcFormatError(f"{path}: an RPC is not written in this format; choose one of {known}")
