"""RPCs in columns of fixed width: NITF's RPC00B extension and ALOS PRISM's text file."""

from __future__ import annotations

import re
from pathlib import Path

from barpc.errors import RpcFormatError
from barpc.rpcio.fields import (
    COEFFICIENTS,
    ERRORS,
    OFFSETS,
    SCALES,
    Fields,
    ReadOptions,
    number,
    rpc_from_fields,
)
from barpc.sensor.rpc import RPC

Columns = tuple[tuple[str, int], ...]

_NITF: Columns = (
    *zip(ERRORS, (7, 7), strict=True),
    *zip(OFFSETS, (6, 5, 8, 9, 5), strict=True),
    *zip(SCALES, (6, 5, 8, 9, 5), strict=True),
)
_ALOS: Columns = (*zip(OFFSETS, (6, 5, 8, 9, 5), strict=True), *zip(SCALES, (6, 5, 8, 9, 5), strict=True))
_COEFFICIENT_WIDTH = 12
_TRE_LENGTH = 1041
_SCAN_LIMIT = 1 << 24  # bytes searched for the extension

# Position in RPC00A of each of RPC00B's twenty monomials.
_B_FROM_A = (0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 7, 11, 14, 17, 12, 15, 18, 13, 16, 19)


def _columns(text: str, columns: Columns, name: str) -> Fields:
    """The fields of one record: single numbers by `columns`, then four times twenty coefficients."""
    needed = sum(width for _, width in columns) + 80 * _COEFFICIENT_WIDTH
    if len(text) < needed:
        raise RpcFormatError(f"{name}: an RPC record of {len(text)} characters, expected {needed}")
    fields: Fields = {}
    position = 0
    for key, width in columns:
        fields[key] = [number(text[position : position + width], name, key)]
        position += width
    for key in COEFFICIENTS:
        cells = [text[position + _COEFFICIENT_WIDTH * i :][:_COEFFICIENT_WIDTH] for i in range(20)]
        fields[key] = [number(cell, name, f"{key}_{i}") for i, cell in enumerate(cells, 1)]
        position += 20 * _COEFFICIENT_WIDTH
    return fields


def is_nitf(head: bytes) -> bool:
    """Whether a file's first bytes are those of a NITF or NSIF."""
    return head[:4] in (b"NITF", b"NSIF")


def read_nitf(path: Path) -> RPC | None:
    """The RPC in a NITF's RPC00B (or RPC00A) extension, or None where there is none.

    Raises
    ------
    RpcFormatError
        The extension is there and does not parse, or says of itself that it is not valid.
    """
    with path.open("rb") as file:
        data = file.read(_SCAN_LIMIT)
    match = re.search(rb"RPC00([AB])01041", data)
    if match is None:
        return None
    record = data[match.end() : match.end() + _TRE_LENGTH].decode("latin-1")
    name = f"{path} (RPC00{match.group(1).decode()})"
    if not record.startswith("1"):
        raise RpcFormatError(f"{name}: its SUCCESS flag is {record[:1]!r}, not 1: the vendor's fit failed")
    fields = _columns(record[1:], _NITF, name)
    if match.group(1) == b"A":
        fields |= {key: [fields[key][i] for i in _B_FROM_A] for key in COEFFICIENTS}
    return rpc_from_fields(fields, name)


def sniff_alos(text: str) -> bool:
    """One line of 1026 characters or more that starts with two numbers of fixed width."""
    first = text.split("\n", 1)[0]
    return len(first) >= 1026 and re.fullmatch(r"[\d+\-. ]{66}[\d+\-. E]+", first[:1026].upper()) is not None


def read_alos(text: str, name: str, options: ReadOptions) -> RPC:
    """ALOS PRISM's and AVNIR's ``RPC-*.txt``: offsets, scales, four times twenty coefficients."""
    fields = _columns(text.split("\n", 1)[0], _ALOS, name)
    return rpc_from_fields(fields, name, options.first_pixel or 0.0)
