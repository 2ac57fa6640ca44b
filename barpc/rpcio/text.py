"""RPC files made of lines of text: ``_RPC.TXT``, ``.RPB``, OSSIM's ``.geom``, ENVI's header."""

from __future__ import annotations

import re
from collections.abc import Iterator

from barpc.errors import RpcFormatError
from barpc.rpcio.fields import (
    COEFFICIENTS,
    ERRORS,
    OFFSETS,
    SCALES,
    Fields,
    ReadOptions,
    collect_numbered,
    fields_from_rpc,
    format_number,
    number,
    numbers,
    rpc_from_fields,
)
from barpc.sensor.rpc import RPC

_LINE = re.compile(r"^[ \t]*+([A-Za-z][\w.]*+)[ \t]*+[:=](.*)$", re.MULTILINE)
# Patterns here take time in proportion to the text, whatever it holds: no two repetitions can share a character,
# and one that may run far begins where a line or a word begins.
_KEYS = {*OFFSETS, *SCALES, *ERRORS}


def decode(data: bytes) -> str:
    """Text of a file, with line ends of one kind: UTF-8, or Latin-1 where it is not (a degree sign, say)."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n")


# --- _RPC.TXT ---------------------------------------------------------------------------------------------


def sniff_txt(text: str) -> bool:
    """``LINE_OFF: ...`` and ``LINE_NUM_COEFF_1: ...``, one a line."""
    return re.search(r"^[ \t]*+LINE_NUM_COEFF_1[ \t]*+[:=]", text, re.MULTILINE | re.IGNORECASE) is not None


def _pairs(text: str) -> Iterator[tuple[str, str]]:
    """Key and value of every line that has both."""
    for match in _LINE.finditer(text):
        yield match[1], match[2].strip().removesuffix(";").rstrip()


def read_txt(text: str, name: str, options: ReadOptions) -> RPC:
    """``KEY: value``, with or without a unit behind (GDAL, Planet, IKONOS, GeoEye, OrbView, KOMPSAT)."""
    pairs = []
    for key, value in _pairs(text):
        key = key.upper()
        if key in _KEYS or key.rpartition("_")[0] in COEFFICIENTS:
            pairs.append((key, number(value, name, key)))
    return rpc_from_fields(collect_numbered(pairs, name), name, options.first_pixel or 0.0)


def write_txt(rpc: RPC) -> str:
    """``KEY: value`` without units (rpcm stumbles on them); every number reads back to the bit."""
    lines = []
    for key, values in fields_from_rpc(rpc).items():
        if key in COEFFICIENTS:
            lines += [f"{key}_{i}: {format_number(v)}" for i, v in enumerate(values, 1)]
        else:
            lines.append(f"{key}: {format_number(values[0])}")
    return "\n".join(lines) + "\n"


# --- .RPB -------------------------------------------------------------------------------------------------

_RPB_NAMES = {
    "errBias": "ERR_BIAS",
    "errRand": "ERR_RAND",
    "lineOffset": "LINE_OFF",
    "sampOffset": "SAMP_OFF",
    "latOffset": "LAT_OFF",
    "longOffset": "LONG_OFF",
    "heightOffset": "HEIGHT_OFF",
    "lineScale": "LINE_SCALE",
    "sampScale": "SAMP_SCALE",
    "latScale": "LAT_SCALE",
    "longScale": "LONG_SCALE",
    "heightScale": "HEIGHT_SCALE",
    "lineNumCoef": "LINE_NUM_COEFF",
    "lineDenCoef": "LINE_DEN_COEFF",
    "sampNumCoef": "SAMP_NUM_COEFF",
    "sampDenCoef": "SAMP_DEN_COEFF",
}
_RPB_LOWER = {key.lower(): value for key, value in _RPB_NAMES.items()}
_RPB_PAIR = re.compile(r"\b(\w++)\s*+=\s*+(\([^()]*+\)|[^;\n()]*+);?")


def sniff_rpb(text: str) -> bool:
    """``lineNumCoef = ( ...``."""
    return re.search(r"lineNumCoef\s*+=", text, re.IGNORECASE) is not None


def read_rpb(text: str, name: str, options: ReadOptions) -> RPC:
    """Maxar's ``key = value;`` with lists in parentheses."""
    fields: Fields = {}
    for key, value in _RPB_PAIR.findall(text):
        field = _RPB_LOWER.get(key.lower())
        if field is not None:
            fields[field] = numbers(value.strip("()"), name, key)
    if re.search(r'SpecId\s*+=\s*+"RPC00A"', text, re.IGNORECASE):
        raise RpcFormatError(f"{name}: coefficients in RPC00A order; only RPC00B is written to .RPB files")
    return rpc_from_fields(fields, name, options.first_pixel or 0.0)


def write_rpb(rpc: RPC) -> str:
    """Maxar's syntax; an unknown accuracy is left out, as a zero would read as perfect."""
    names = {field: key for key, field in _RPB_NAMES.items()}
    lines = ['satId = "????";', 'bandId = "?";', 'SpecId = "RPC00B";', "BEGIN_GROUP = IMAGE"]
    for field, values in fields_from_rpc(rpc).items():
        if field in COEFFICIENTS:
            rows = ",\n".join(f"\t\t\t{format_number(v)}" for v in values)
            lines.append(f"\t{names[field]} = (\n{rows});")
        else:
            lines.append(f"\t{names[field]} = {format_number(values[0])};")
    return "\n".join([*lines, "END_GROUP = IMAGE", "END;"]) + "\n"


# --- .geom ------------------------------------------------------------------------------------------------

_GEOM_ERRORS = {"bias_error": "ERR_BIAS", "rand_error": "ERR_RAND"}
_GEOM_COEFF = re.compile(r"(line|samp)_(num|den)_coeff_(\d\d)")


def sniff_geom(text: str) -> bool:
    """``line_num_coeff_00: ...``."""
    return re.search(r"^[ \t]*+(\w++\.)?line_num_coeff_00[ \t]*+:", text, re.MULTILINE) is not None


def read_geom(text: str, name: str, options: ReadOptions) -> RPC:
    """OSSIM's keyword list, as OTB and CARS use it; the RPC of the FULL image."""
    pairs = []
    kind = re.search(r"^[ \t]*+polynomial_format:[ \t]*+(\w*+)", text, re.MULTILINE)
    if kind and kind.group(1) != "B":
        raise RpcFormatError(f"{name}: polynomial_format {kind.group(1)!r}, only B (RPC00B) is read")
    for key, value in _pairs(text):
        field = _GEOM_ERRORS.get(key, key.upper())
        if field in _KEYS or _GEOM_COEFF.fullmatch(key):
            pairs.append((field, number(value, name, key)))
    return rpc_from_fields(collect_numbered(pairs, name, first=0), name, options.first_pixel or 0.0)


def write_geom(rpc: RPC) -> str:
    """OSSIM's keyword list with all keys that its readers ask for (they add the half pixel themselves)."""
    lines = ["type:  ossimRpcModel", "polynomial_format:  B"]
    fields = fields_from_rpc(rpc)
    for key, field in _GEOM_ERRORS.items():  # required keys; 0 is OSSIM's "unknown"
        lines.append(f"{key}:  {format_number(fields.pop(field, [0.0])[0])}")
    for field, values in fields.items():
        key = field.lower()
        if field in COEFFICIENTS:
            lines += [f"{key}_{i:02d}:  {format_number(v)}" for i, v in enumerate(values)]
        else:
            lines.append(f"{key}:  {format_number(values[0])}")
    return "\n".join(lines) + "\n"


# --- ENVI -------------------------------------------------------------------------------------------------

_ENVI = re.compile(r"^[ \t]*+rpc info\s*+=\s*+\{([^{}]*+)\}", re.MULTILINE | re.IGNORECASE)


def sniff_envi(text: str) -> bool:
    """``rpc info = {`` in a header."""
    return re.search(r"^[ \t]*+rpc info\s*+=\s*+\{", text, re.MULTILINE | re.IGNORECASE) is not None


def read_envi(text: str, name: str, options: ReadOptions) -> RPC:
    """ENVI's header: offsets, scales, four times twenty coefficients; three more numbers may follow."""
    match = _ENVI.search(text)
    values = numbers(match.group(1), name, "rpc info") if match else []
    if len(values) not in (90, 93):
        raise RpcFormatError(f"{name}: rpc info has {len(values)} numbers, expected 90 or 93")
    fields: Fields = {key: [value] for key, value in zip(OFFSETS + SCALES, values, strict=False)}
    fields |= {key: values[10 + 20 * i : 30 + 20 * i] for i, key in enumerate(COEFFICIENTS)}
    return rpc_from_fields(fields, name, options.first_pixel or 0.0)
