"""RPCs in JSON (rpcm's and rasterio's dialects) and in orthority's YAML."""

from __future__ import annotations

import json
import re
from typing import Any

from barpc.errors import RpcFormatError
from barpc.rpcio.fields import (
    COEFFICIENTS,
    ERRORS,
    OFFSETS,
    SCALES,
    Fields,
    ReadOptions,
    fields_from_rpc,
    numbers,
    rpc_from_fields,
)
from barpc.sensor.rpc import RPC
from barpc.sidefile import parse_json

_RPCM = {
    "LINE_OFF": "row_offset",
    "SAMP_OFF": "col_offset",
    "LAT_OFF": "lat_offset",
    "LONG_OFF": "lon_offset",
    "HEIGHT_OFF": "alt_offset",
    "LINE_SCALE": "row_scale",
    "SAMP_SCALE": "col_scale",
    "LAT_SCALE": "lat_scale",
    "LONG_SCALE": "lon_scale",
    "HEIGHT_SCALE": "alt_scale",
    "LINE_NUM_COEFF": "row_num",
    "LINE_DEN_COEFF": "row_den",
    "SAMP_NUM_COEFF": "col_num",
    "SAMP_DEN_COEFF": "col_den",
    "ERR_BIAS": "err_bias",  # not rpcm's own; it passes over them
    "ERR_RAND": "err_rand",
}
_PLAIN = {key: key.lower() for key in (*OFFSETS, *SCALES, *COEFFICIENTS, *ERRORS)}


def sniff_json(text: str) -> bool:
    """A JSON object with the keys of one of the dialects."""
    return text.lstrip().startswith("{") and ('"row_num"' in text or '"line_num_coeff"' in text.lower())


def read_json(text: str, name: str, options: ReadOptions) -> RPC:
    """``{"rpc": {"row_offset": ...}}`` (rpcm, s2p) or ``{"line_off": ...}`` (rasterio), nested or not."""
    try:
        document = parse_json(text)
    except ValueError as error:
        raise RpcFormatError(f"{name}: not JSON ({error})") from error
    for dialect, mark in ((_RPCM, "row_num"), (_PLAIN, "line_num_coeff")):
        found = _find(document, mark)
        if found is not None:
            names = {key.upper(): value for key, value in found.items()}
            raw = {key: names[alias.upper()] for key, alias in dialect.items() if alias.upper() in names}
            fields: Fields = {
                key: _values(value, name, dialect[key]) for key, value in raw.items() if value is not None
            }
            return rpc_from_fields(fields, name, options.first_pixel or 0.0)
    raise RpcFormatError(f"{name}: no RPC in this JSON (looked for row_num and line_num_coeff)")


def _find(document: Any, mark: str, depth: int = 3) -> dict[str, Any] | None:
    """The first object that has the key `mark`, at most `depth` levels down."""
    if not isinstance(document, dict):
        return None
    if mark in {str(key).lower() for key in document}:
        return document
    inner = (_find(value, mark, depth - 1) for value in document.values()) if depth else ()
    return next((found for found in inner if found is not None), None)


def _values(value: Any, name: str, key: str) -> list[float]:
    """Numbers of a JSON value: a number, a list of numbers, or a text of numbers (GDAL's)."""
    if isinstance(value, str):
        return numbers(value, name, key)
    items = value if isinstance(value, list) else [value]
    if any(isinstance(item, bool) or not isinstance(item, int | float | str) for item in items):
        raise RpcFormatError(f"{name}: {key} is not a number or a list of numbers")
    return [v for item in items for v in numbers(str(item), name, key)]


def write_json(rpc: RPC) -> str:
    """The dictionary of rpcm and s2p, without the vendor's direct coefficients."""
    fields = fields_from_rpc(rpc)
    rpcm = {
        alias: fields[key] if key in COEFFICIENTS else fields[key][0]
        for key, alias in _RPCM.items()
        if key in fields
    }
    return json.dumps({"rpc": rpcm}, indent=1) + "\n"


# --- YAML -------------------------------------------------------------------------------------------------

_PAIR = re.compile(r"^[ \t-]*+(\w++):[ \t]*+(\[[^\[\]]*+\]|[^\n\[{]*+)", re.MULTILINE)


def sniff_yaml(text: str) -> bool:
    """``line_num_coeff: [...]`` or the same list in dashes."""
    return re.search(r"^[ \t]++line_num_coeff:", text, re.MULTILINE) is not None


def read_yaml(text: str, name: str, options: ReadOptions) -> RPC:
    """A parameter file of orthority with one image: names as rasterio's, lists in brackets or as dashes."""
    text = re.sub(r"\n[ \t]*+-[ \t]++(?=[+-.\d])", ", ", text)  # a block list into one line
    aliases = {alias: key for key, alias in _PLAIN.items()}
    fields: Fields = {}
    for alias, value in _PAIR.findall(text):
        key = aliases.get(alias)
        if key is None or not value.strip("[], \t\n"):
            continue
        if key in fields:
            raise RpcFormatError(f"{name}: the RPCs of several images; give a file of one image")
        if value.strip() not in ("null", "~"):
            fields[key] = numbers(value.strip("[], \t\n").replace("\n", " "), name, alias)
    return rpc_from_fields(fields, name, options.first_pixel or 0.0)
