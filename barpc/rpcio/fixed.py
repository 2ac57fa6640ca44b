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
    fields_from_rpc,
    number,
    rpc_from_fields,
)
from barpc.sensor.rpc import RPC
from barpc.sidefile import IMAGE, read_head

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
    data = read_head(path, IMAGE, _SCAN_LIMIT)
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


def nitf_record(rpc: RPC) -> str:
    """The 1041 characters of an RPC00B extension.

    The record holds integer image and height offsets and scales, 1e-4 degree and seven digits a
    coefficient: an RPC that was not fitted for it (`barpc.fit`, precision "nitf") loses tenths of a pixel,
    and what is read back says how much. An accuracy that is unknown is written as zero, as the format asks.

    Raises
    ------
    RpcFormatError
        A number does not fit its field, such as the negative offset of a crop.
    """
    fields = fields_from_rpc(rpc)
    decimals = {"ERR": 2, "LAT": 4, "LONG": 4}
    signed = {"LAT_OFF", "LONG_OFF", "HEIGHT_OFF", "LAT_SCALE", "LONG_SCALE", "HEIGHT_SCALE"}
    cells = ["1"]
    for key, width in _NITF:
        value = fields.get(key, [0.0])[0]
        sign = "+" if key in signed else ""
        cell = format(value, f"{sign}0{width}.{decimals.get(key.split('_')[0], 0)}f")
        if len(cell) != width or (not sign and value < 0):
            raise RpcFormatError(f"NITF RPC00B: {key} = {value:g} does not fit {width} characters")
        cells.append(cell)
    cells += [_nitf_coefficient(value, key) for key in COEFFICIENTS for value in fields[key]]
    return "".join(cells)


def _nitf_coefficient(value: float, key: str) -> str:
    """+d.ddddddE-d."""
    mantissa, exponent = f"{value:+.6E}".split("E")
    power = int(exponent)
    if power < -9:
        return "+0.000000E+0"
    if power > 9:
        raise RpcFormatError(f"NITF RPC00B: a coefficient of {key} is {value:g}, beyond the format")
    return f"{mantissa}E{power:+d}"


def sniff_alos(text: str) -> bool:
    """One line of 1026 characters or more that starts with two numbers of fixed width."""
    first = text.split("\n", 1)[0]
    return len(first) >= 1026 and re.fullmatch(r"[\d+\-. ]{66}[\d+\-. E]+", first[:1026].upper()) is not None


def read_alos(text: str, name: str, options: ReadOptions) -> RPC:
    """ALOS PRISM's and AVNIR's ``RPC-*.txt``: offsets, scales, four times twenty coefficients."""
    fields = _columns(text.split("\n", 1)[0], _ALOS, name)
    return rpc_from_fields(fields, name, options.first_pixel or 0.0)
