"""RPCs: ``_RPC.TXT``, ``.RPB``, OSSIM's ``.geom``, ENVI, rpcm's JSON, orthority's YAML, NITF's and ALOS' columns."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from barpc.errors import RpcFormatError
from barpc.remote import Place
from barpc.rpcio.fields import (
    COEFFICIENTS,
    DIRECT,
    ERRORS,
    KEYS,
    LISTS,
    MAXAR,
    NUMBER,
    OFFSETS,
    SCALES,
    SINGLE,
    Fields,
    ReadOptions,
    collect_numbered,
    fields_from_rpc,
    format_number,
    listed_numbers,
    number,
    rpc_from_fields,
)
from barpc.sensor.rpc import RPC
from barpc.sidefile import IMAGE, encoding_of, parse_json, read_head

# Patterns here take time in proportion to the text, whatever it holds: no two repetitions can share a character,
# and one that may run far begins where a line or a word begins.
_LINE = re.compile(r"^[ \t]*+([A-Za-z][\w.]*+)[ \t]*+[:=](.*)$", re.MULTILINE)


def decode(data: bytes) -> str:
    """Return the text of a file, with line ends of one kind: UTF-8, UTF-16, else Latin-1 (a degree sign, say)."""
    try:
        text = data.decode(encoding_of(data))
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _pairs(text: str) -> Iterator[tuple[str, str]]:
    for match in _LINE.finditer(text):
        yield match[1], match[2].strip().removesuffix(";").rstrip()


def _numbered(fields: Fields, separator: str, indices: Sequence[str]) -> list[str]:
    """Return a line for every number; the coefficients of a list have these indices."""
    lines = []
    for key, values in fields.items():
        names = [f"{key}_{index}" for index in indices] if key in LISTS else [key]
        lines += [f"{k}{separator}{format_number(value)}" for k, value in zip(names, values, strict=True)]
    return lines


def read_txt(text: str, name: str, options: ReadOptions) -> RPC:
    """Read ``KEY: value``, with or without a unit behind (GDAL, Planet, IKONOS, GeoEye, OrbView, KOMPSAT).

    Coefficients are numbered or, as GDAL shows them, twenty in a line.
    """
    found = [(key.upper(), value) for key, value in _pairs(text)]
    pairs = [(k, number(v, name, k)) for k, v in found if k in SINGLE or k.rpartition("_")[0] in LISTS]
    pairs += [
        (f"{k}_{i}", value) for k, v in found if k in LISTS for i, value in enumerate(listed_numbers(v, name, k), 1)
    ]
    return rpc_from_fields(collect_numbered(pairs, name), name, options)


def write_txt(rpc: RPC) -> str:
    """Write ``KEY: value`` without units (rpcm stumbles on them); every number reads back to the bit."""
    return "\n".join(_numbered(fields_from_rpc(rpc, direct=True), ": ", [str(i) for i in range(1, 21)])) + "\n"


# --- .RPB -------------------------------------------------------------------------------------------------

_RPB_PAIR = re.compile(r"\b(\w++)\s*+=\s*+(\([^()]*+\)|[^;\n()]*+);?")


def read_rpb(text: str, name: str, options: ReadOptions) -> RPC:
    """Read Maxar's ``key = value;`` with lists in parentheses."""
    keys = {word.lower(): key for key, word in MAXAR.items()}
    fields: Fields = {}
    for word, value in _RPB_PAIR.findall(text):
        if (key := keys.get(word.lower())) is not None:
            fields[key] = listed_numbers(value.strip("()"), name, word)
    if re.search(r'SpecId\s*+=\s*+"RPC00A"', text, re.IGNORECASE):
        raise RpcFormatError(f"{name}: coefficients in RPC00A order; only RPC00B is written to .RPB files")
    return rpc_from_fields(fields, name, options)


def write_rpb(rpc: RPC) -> str:
    """Write Maxar's syntax; an unknown accuracy is left out, as a zero would read as perfect."""
    lines = ['satId = "????";', 'bandId = "?";', 'SpecId = "RPC00B";', "BEGIN_GROUP = IMAGE"]
    for key, values in fields_from_rpc(rpc).items():
        if key in COEFFICIENTS:
            rows = ",\n".join(f"\t\t\t{format_number(value)}" for value in values)
            lines.append(f"\t{MAXAR[key]} = (\n{rows});")
        else:
            lines.append(f"\t{MAXAR[key]} = {format_number(values[0])};")
    return "\n".join([*lines, "END_GROUP = IMAGE", "END;"]) + "\n"


# --- .geom ------------------------------------------------------------------------------------------------

_GEOM_ERRORS = {"bias_error": "ERR_BIAS", "rand_error": "ERR_RAND"}
_GEOM_COEFF = re.compile(r"(line|samp)_(num|den)_coeff_(\d\d)")


def read_geom(text: str, name: str, options: ReadOptions) -> RPC:
    """Read OSSIM's keyword list, as OTB and CARS use it; the RPC of the FULL image."""
    kind = re.search(r"^[ \t]*+polynomial_format:[ \t]*+(\w*+)", text, re.MULTILINE)
    if kind and kind.group(1) != "B":
        raise RpcFormatError(f"{name}: polynomial_format {kind.group(1)!r}, only B (RPC00B) is read")
    pairs = []
    for key, value in _pairs(text):
        field = _GEOM_ERRORS.get(key, key.upper())
        if field in SINGLE or _GEOM_COEFF.fullmatch(key):
            pairs.append((field, number(value, name, key)))
    return rpc_from_fields(collect_numbered(pairs, name, first=0), name, options)


def write_geom(rpc: RPC) -> str:
    """Write OSSIM's keyword list with all keys that its readers ask for (they add the half pixel themselves)."""
    fields = fields_from_rpc(rpc)
    errors = {word: fields.pop(key, [0.0]) for word, key in _GEOM_ERRORS.items()}  # 0 is OSSIM's "unknown"
    lines = _numbered(errors | fields, ":  ", [f"{i:02d}" for i in range(20)])
    head = ["type:  ossimRpcModel", "polynomial_format:  B"]
    return "\n".join([*head, *(line.lower() for line in lines)]) + "\n"


_ENVI = re.compile(r"^[ \t]*+rpc info\s*+=\s*+\{([^{}]*+)\}", re.MULTILINE | re.IGNORECASE)


def read_envi(text: str, name: str, options: ReadOptions) -> RPC:
    """Read ENVI's header: offsets, scales, four times twenty coefficients; three more numbers may follow."""
    match = _ENVI.search(text)
    values = listed_numbers(match.group(1), name, "rpc info") if match else []
    return _in_order(values, "rpc info", name, options)


def _in_order(values: list[float], what: str, name: str, options: ReadOptions) -> RPC:
    """Return the RPC of offsets, scales and four times twenty coefficients."""
    if len(values) not in _COUNTS:
        raise RpcFormatError(f"{name}: {what} has {len(values)} numbers, expected 90 or 93")
    fields: Fields = {key: [value] for key, value in zip(OFFSETS + SCALES, values, strict=False)}
    fields |= {key: values[10 + 20 * i : 30 + 20 * i] for i, key in enumerate(COEFFICIENTS)}
    return rpc_from_fields(fields, name, options)


_COUNTS = (90, 93)  # numbers of an RPC; three more may follow
_BETWEEN = re.compile(r"[\s,;]+")
_ONE = 0.01  # by which the first coefficient of a denominator may miss 1: OrbView's are 0.99995


def bare(text: str) -> bool:
    """Return whether a text holds the numbers of an RPC and nothing else."""
    parts = [part for part in _BETWEEN.split(text, maxsplit=100) if part]
    return len(parts) in _COUNTS and all(map(NUMBER.fullmatch, parts))


def read_bare(text: str, name: str, options: ReadOptions) -> RPC:
    """Read the numbers without names, separated by commas, blanks or lines, in the order of ENVI's header
    (IARPA, s2p).
    """
    values = [number(part, name, "a number") for part in _BETWEEN.split(text) if part]
    rpc = _in_order(values, "a list without names", name, options)
    first = rpc.coeffs[1::2, 0]
    if not (np.abs(first - 1.0) <= _ONE).all():
        raise RpcFormatError(
            f"{name}: {len(values)} numbers without names, of which the 31st and 71st are {values[30]:g} and "
            f"{values[70]:g}: denominators of an RPC begin with 1"
        )
    return rpc


# The errors are not rpcm's own; it passes over them.
_RPCM_WORDS = (
    "err_bias err_rand row_offset col_offset lat_offset lon_offset alt_offset row_scale col_scale lat_scale lon_scale "
    "alt_scale row_num row_den col_num col_den"
)
_RPCM = dict(zip(KEYS, _RPCM_WORDS.split(), strict=True))
_RPCM |= {key: key.removesuffix("_COEFF").lower() for key in DIRECT}
_PLAIN = {key: key.lower() for key in KEYS}


def read_rpc_json(text: str, name: str, options: ReadOptions) -> RPC:
    """Read ``{"rpc": {"row_offset": ...}}`` (rpcm, s2p) or ``{"line_off": ...}`` (rasterio), nested or not."""
    try:
        document = parse_json(text)
    except ValueError as error:
        raise RpcFormatError(f"{name}: not JSON ({error})") from error
    for dialect, mark in ((_RPCM, "row_num"), (_PLAIN, "line_num_coeff")):
        found = _find(document, mark)
        if found is not None:
            values = {word.lower(): value for word, value in found.items() if value is not None}
            fields = {key: _values(values[word], name, word) for key, word in dialect.items() if word in values}
            return rpc_from_fields(fields, name, options)
    raise RpcFormatError(f"{name}: no RPC in this JSON (looked for row_num and line_num_coeff)")


def _find(document: Any, mark: str, depth: int = 3) -> dict[str, Any] | None:
    """Return the first object that has the key `mark`, at most `depth` levels down."""
    if not isinstance(document, dict):
        return None
    if mark in {str(key).lower() for key in document}:
        return document
    inner = (_find(value, mark, depth - 1) for value in document.values()) if depth else ()
    return next((found for found in inner if found is not None), None)


def _values(value: Any, name: str, key: str) -> list[float]:
    """Return the numbers of a JSON value: a number, a list of numbers, or a text of numbers (GDAL's)."""
    if isinstance(value, str):
        return listed_numbers(value, name, key)
    items = value if isinstance(value, list) else [value]
    if any(isinstance(item, bool) or not isinstance(item, int | float | str) for item in items):
        raise RpcFormatError(f"{name}: {key} is not a number or a list of numbers")
    return [v for item in items for v in listed_numbers(str(item), name, key)]


def write_json(rpc: RPC) -> str:
    """Write the dictionary of rpcm and s2p."""
    fields = fields_from_rpc(rpc, direct=True)
    order = (*(key for key in KEYS if key not in ERRORS), *DIRECT, *ERRORS)
    rpcm = {_RPCM[k]: fields[k] if k in LISTS else fields[k][0] for k in order if k in fields}
    return json.dumps({"rpc": rpcm}, indent=1) + "\n"


_PAIR = re.compile(r"^[ \t-]*+(\w++):[ \t]*+(\[[^\[\]]*+\]|[^\n\[{]*+)", re.MULTILINE)


def read_yaml(text: str, name: str, options: ReadOptions) -> RPC:
    """Read a parameter file of orthority with one image: names as rasterio's, lists in brackets or as dashes."""
    text = re.sub(r"\n[ \t]*+-[ \t]++(?=[+-.\d])", ", ", text)  # a block list into one line
    keys = {word: key for key, word in _PLAIN.items()}
    fields: Fields = {}
    for word, value in _PAIR.findall(text):
        key = keys.get(word)
        if key is None or not value.strip("[], \t\n"):
            continue
        if key in fields:
            raise RpcFormatError(f"{name}: the RPCs of several images; give a file of one image")
        if value.strip() not in ("null", "~"):
            fields[key] = listed_numbers(value.strip("[], \t\n").replace("\n", " "), name, word)
    return rpc_from_fields(fields, name, options)


# --- columns of fixed width -------------------------------------------------------------------------------

_WIDTHS = 2 * (6, 5, 8, 9, 5)
_NITF = dict(zip(SINGLE, (7, 7, *_WIDTHS), strict=True))
_ALOS = dict(zip(OFFSETS + SCALES, _WIDTHS, strict=True))
_COEFFICIENT_WIDTH = 12
_TRE_LENGTH = 1041
_SCAN_LIMIT = 1 << 24  # bytes searched for the extension

# Position in RPC00A of each of RPC00B's twenty monomials.
_B_FROM_A = (0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 7, 11, 14, 17, 12, 15, 18, 13, 16, 19)


def _columns(text: str, widths: dict[str, int], name: str) -> Fields:
    """Return the fields of one record: single numbers of these widths, then four times twenty coefficients."""
    cells = [(key, key, width) for key, width in widths.items()]
    cells += [(key, f"{key}_{i}", _COEFFICIENT_WIDTH) for key in COEFFICIENTS for i in range(1, 21)]
    needed = sum(width for _, _, width in cells)
    if len(text) < needed:
        raise RpcFormatError(f"{name}: an RPC record of {len(text)} characters, expected {needed}")
    fields: Fields = {}
    position = 0
    for key, label, width in cells:
        fields.setdefault(key, []).append(number(text[position : position + width], name, label))
        position += width
    return fields


def read_nitf(path: Place) -> RPC | None:
    """Read the RPC in a NITF's RPC00B (or RPC00A) extension, None without one; RpcFormatError where it is not valid."""
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
    """Return the 1041 characters of an RPC00B extension; RpcFormatError where a number does not fit its
    field.

    Image and height offsets and scales are integers, degrees have four decimals, coefficients seven digits: an
    RPC that was not fitted for it (`barpc.fit`, precision "nitf") loses tenths of a pixel. An unknown accuracy
    is written as zero, as the format asks.
    """
    fields = fields_from_rpc(rpc)
    decimals = {"ERR": 2, "LAT": 4, "LONG": 4}
    cells = ["1"]
    for key, width in _NITF.items():
        value = fields.get(key, [0.0])[0]
        axis = key.split("_")[0]
        sign = "+" if axis in ("LAT", "LONG", "HEIGHT") else ""
        cell = format(value, f"{sign}0{width}.{decimals.get(axis, 0)}f")
        if len(cell) != width or (not sign and value < 0):
            raise RpcFormatError(f"NITF RPC00B: {key} = {value:g} does not fit {width} characters")
        cells.append(cell)
    cells += [_nitf_coefficient(value, key) for key in COEFFICIENTS for value in fields[key]]
    return "".join(cells)


def _nitf_coefficient(value: float, key: str) -> str:
    mantissa, exponent = f"{value:+.6E}".split("E")
    power = int(exponent)
    if power < -9:
        return "+0.000000E+0"
    if power > 9:
        raise RpcFormatError(f"NITF RPC00B: a coefficient of {key} is {value:g}, beyond the format")
    return f"{mantissa}E{power:+d}"


def read_alos(text: str, name: str, options: ReadOptions) -> RPC:
    """Read ALOS PRISM's and AVNIR's ``RPC-*.txt``: offsets, scales, four times twenty coefficients."""
    return rpc_from_fields(_columns(text.split("\n", 1)[0], _ALOS, name), name, options)
