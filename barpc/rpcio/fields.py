"""The names that RPC files share, numbers as files print them, and the way between both and an `RPC`.

Every reader gathers `Fields`: GDAL's names, ``LINE_OFF`` to ``SAMP_DEN_COEFF``. One function makes the RPC
of them and checks that nothing is missing, so a format's module knows its syntax and nothing else.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from barpc.errors import RpcError, RpcFormatError
from barpc.sensor.rpc import RPC

OFFSETS = ("LINE_OFF", "SAMP_OFF", "LAT_OFF", "LONG_OFF", "HEIGHT_OFF")
SCALES = ("LINE_SCALE", "SAMP_SCALE", "LAT_SCALE", "LONG_SCALE", "HEIGHT_SCALE")
COEFFICIENTS = ("LINE_NUM_COEFF", "LINE_DEN_COEFF", "SAMP_NUM_COEFF", "SAMP_DEN_COEFF")
ERRORS = ("ERR_BIAS", "ERR_RAND")

Fields = dict[str, list[float]]
"""Field name -> its numbers: one, or twenty for the four lists of coefficients (RPC00B order)."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([EeDd][+-]?\d+)?")


@dataclass(frozen=True)
class ReadOptions:
    """What the reader of an RPC cannot know from the file.

    Parameters
    ----------
    first_pixel : float or None
        The coordinate that the file gives to the centre of the first pixel: 0, 0.5 or 1. None takes the
        format's own rule (``docs/formats.md``).
    band : int
        Which band's RPC, from 1, where a file holds one for each.
    """

    first_pixel: float | None = None
    band: int = 1


def number(text: str, name: str, key: str) -> float:
    """The number at the start of `text`; a unit may follow, and the exponent may be Fortran's D.

    Parameters
    ----------
    text : str
        Such as ``+005124.00 pixels``, ``-1.5D-03``.
    name, key : str
        File and field, for the message.

    Raises
    ------
    RpcFormatError
        No finite number.
    """
    text = text.strip()
    match = _NUMBER.match(text)
    rest = text[match.end() :] if match else text
    if match is None or (rest and not rest[0].isspace() and rest[0] not in "°%"):
        raise RpcFormatError(f"{name}: {key} is not a number ({text[:40]!r})")
    value = float(match.group().upper().replace("D", "E"))
    if not math.isfinite(value):
        raise RpcFormatError(f"{name}: {key} is not finite ({text[:40]!r})")
    return value


def numbers(text: str, name: str, key: str) -> list[float]:
    """The numbers of a list separated by blanks or commas."""
    return [number(part, name, key) for part in re.split(r"[\s,]+", text.strip()) if part]


def format_number(value: float) -> str:
    """The shortest text that reads back as the same double."""
    text = repr(float(value))
    return text.removesuffix(".0")


def collect_numbered(pairs: Iterable[tuple[str, float]], name: str, first: int = 1) -> Fields:
    """Gather ``LINE_NUM_COEFF_1 .. _20`` into lists, in whatever order they come.

    Parameters
    ----------
    pairs : iterable of (str, float)
        Field names of this module, coefficients with ``_<index>`` behind.
    name : str
        The file, for messages.
    first : int
        Index of the first coefficient.
    """
    fields: Fields = {}
    lists: dict[str, dict[int, float]] = {}
    for key, value in pairs:
        stem, _, index = key.rpartition("_")
        target: dict[int, float] | None = None
        if stem in COEFFICIENTS and index.isdecimal():
            target, slot = lists.setdefault(stem, {}), int(index) - first
            if slot in target and target[slot] != value:
                raise RpcFormatError(f"{name}: {key} is given twice, {target[slot]} and {value}")
            target[slot] = value
        else:
            if key in fields and fields[key] != [value]:
                raise RpcFormatError(f"{name}: {key} is given twice, {fields[key][0]} and {value}")
            fields[key] = [value]
    for stem, slots in lists.items():
        missing = sorted(set(range(20)) - set(slots))
        if missing or len(slots) != 20:
            raise RpcFormatError(f"{name}: {stem} has {len(slots)} coefficients, expected 20")
        fields[stem] = [slots[i] for i in range(20)]
    return fields


def rpc_from_fields(fields: Mapping[str, Sequence[float]], name: str, first_pixel: float = 0.0) -> RPC:
    """The RPC of a file's fields.

    Parameters
    ----------
    fields : mapping
        `Fields`; ERR_BIAS and ERR_RAND may be missing, and are unknown where they are not positive.
    name : str
        The file, for messages.
    first_pixel : float
        The file's coordinate of the centre of the first pixel, subtracted from the image offsets.

    Raises
    ------
    RpcFormatError
        A field is missing, has the wrong length, is not finite, or a scale is zero.
    """
    for key, count in [*((k, 1) for k in OFFSETS + SCALES), *((k, 20) for k in COEFFICIENTS)]:
        found = len(fields.get(key, ()))
        if found != count:
            what = "is missing" if not found else f"has {found} numbers, expected {count}"
            raise RpcFormatError(f"{name}: {key} {what}")
    one = {key: fields[key][0] for key in OFFSETS + SCALES}
    try:
        return RPC(
            coeffs=np.array(
                [fields[f"{axis}_{part}_COEFF"] for axis in ("SAMP", "LINE") for part in ("NUM", "DEN")]
            ),
            ground_offset=np.array([one["LONG_OFF"], one["LAT_OFF"], one["HEIGHT_OFF"]]),
            ground_scale=np.array([one["LONG_SCALE"], one["LAT_SCALE"], one["HEIGHT_SCALE"]]),
            image_offset=np.array([one["SAMP_OFF"], one["LINE_OFF"]]) - first_pixel,
            image_scale=np.array([one["SAMP_SCALE"], one["LINE_SCALE"]]),
            err_bias=_accuracy(fields.get("ERR_BIAS")),
            err_rand=_accuracy(fields.get("ERR_RAND")),
        )
    except RpcFormatError:
        raise
    except RpcError as error:
        raise RpcFormatError(f"{name}: {error}") from error


def _accuracy(value: Sequence[float] | None) -> float | None:
    """A stated accuracy [m]; zero and below mean that nobody knows, not that it is perfect."""
    if not value or not math.isfinite(value[0]) or value[0] <= 0:
        return None
    return float(value[0])


def fields_from_rpc(rpc: RPC) -> Fields:
    """The fields of an RPC, in the order that files give them; unknown accuracies are left out."""
    (lon, lat, alt), (lon_scale, lat_scale, alt_scale) = rpc.ground_offset.tolist(), rpc.ground_scale.tolist()
    (col, row), (col_scale, row_scale) = rpc.image_offset.tolist(), rpc.image_scale.tolist()
    col_num, col_den, row_num, row_den = rpc.coeffs.tolist()
    fields = {key: [value] for key, value in zip(ERRORS, (rpc.err_bias, rpc.err_rand), strict=True) if value}
    fields |= {key: [v] for key, v in zip(OFFSETS, (row, col, lat, lon, alt), strict=True)}
    scales = (row_scale, col_scale, lat_scale, lon_scale, alt_scale)
    fields |= {key: [v] for key, v in zip(SCALES, scales, strict=True)}
    fields |= dict(zip(COEFFICIENTS, (row_num, row_den, col_num, col_den), strict=True))
    return fields
