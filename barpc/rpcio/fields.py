"""The names that RPC files share, numbers as files print them, and the way between both and an `RPC`.

Every reader gathers `Fields`; one function makes the RPC of them and checks that nothing is missing.
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
DIRECT = ("LON_NUM_COEFF", "LON_DEN_COEFF", "LAT_NUM_COEFF", "LAT_DEN_COEFF")  # rpcm's: of a localisation RPC
LISTS = COEFFICIENTS + DIRECT
ERRORS = ("ERR_BIAS", "ERR_RAND")
SINGLE = ERRORS + OFFSETS + SCALES
KEYS = SINGLE + COEFFICIENTS  # GDAL's names of all fields, in the order of the GeoTIFF tag

_MAXAR = (
    "errBias errRand lineOffset sampOffset latOffset longOffset heightOffset lineScale sampScale latScale longScale "
    "heightScale lineNumCoef lineDenCoef sampNumCoef sampDenCoef"
)
MAXAR = dict(zip(KEYS, _MAXAR.split(), strict=True))
"""GDAL's name of a field -> Maxar's in an ``.RPB`` file; its XML has them in capitals."""

Fields = dict[str, list[float]]
"""Field name -> its numbers: one, or twenty for the four lists of coefficients (RPC00B order)."""

_INDEXED = re.compile(rf"({'|'.join(LISTS)})_(\d+)")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([EeDd][+-]?\d+)?")


@dataclass(frozen=True)
class ReadOptions:
    """Choices that the reader of an RPC cannot take from the file."""

    first_pixel: float | None = None
    """The file's coordinate of the first pixel's centre: 0, 0.5 or 1; None: the format's rule (``docs/formats.md``)."""
    band: int = 1
    """Which band's RPC, from 1, where a file holds one for each."""


def number(text: str, name: str, key: str) -> float:
    """Return the number at the start of `text` (or RpcFormatError); a unit may follow, the exponent may be
    Fortran's D.
    """
    text = text.strip()
    match = NUMBER.match(text)
    rest = text[match.end() :] if match else text
    if match is None or (rest and not rest[0].isspace() and rest[0] not in "°%"):
        raise RpcFormatError(f"{name}: {key} is not a number ({text[:40]!r})")
    value = float(match.group().upper().replace("D", "E"))
    if not math.isfinite(value):
        raise RpcFormatError(f"{name}: {key} is not finite ({text[:40]!r})")
    return value


def listed_numbers(text: str, name: str, key: str) -> list[float]:
    """Return the numbers of a list separated by blanks or commas."""
    return [number(part, name, key) for part in re.split(r"[\s,]+", text.strip()) if part]


def format_number(value: float) -> str:
    """Return the shortest text that reads back as the same double."""
    return repr(float(value)).removesuffix(".0")


def collect_numbered(pairs: Iterable[tuple[str, float]], name: str, first: int = 1) -> Fields:
    """Gather ``LINE_NUM_COEFF_1 .. _20`` (the first index is `first`) into lists, in whatever order they come."""
    single: dict[str | int, float] = {}
    lists: dict[str, dict[str | int, float]] = {}
    for key, value in pairs:
        found = _INDEXED.fullmatch(key)
        slot = int(found[2][:9]) - first if found else key
        known = (lists.setdefault(found[1], {}) if found else single).setdefault(slot, value)
        if known != value:
            raise RpcFormatError(f"{name}: {key} is given twice, {known} and {value}")
    for stem, values in lists.items():
        if set(values) != set(range(20)):
            raise RpcFormatError(f"{name}: {stem} has {len(values)} coefficients, expected 20")
    one = {str(key): [value] for key, value in single.items()}
    return one | {stem: [values[i] for i in range(20)] for stem, values in lists.items()}


def rpc_from_fields(
    fields: Mapping[str, Sequence[float]],
    name: str,
    options: ReadOptions | None = None,
    first_pixel: float = 0.0,
) -> RPC:
    """Return the RPC of the fields of a file called `name`.

    The format's coordinate of the centre of the first pixel, or the options', is subtracted from the image offsets.
    RpcFormatError where a field (but ERR_BIAS and ERR_RAND) is missing, has the wrong length, is not finite, or a
    scale is zero.
    """
    if options is not None and options.first_pixel is not None:
        first_pixel = options.first_pixel
    lists = LISTS if any(key in fields for key in DIRECT) else COEFFICIENTS
    for key, count in [*((k, 1) for k in OFFSETS + SCALES), *((k, 20) for k in lists)]:
        found = len(fields.get(key, ()))
        if found != count:
            what = "is missing" if not found else f"has {found} numbers, expected {count}"
            raise RpcFormatError(f"{name}: {key} {what}")
    ground, image = ("LONG", "LAT", "HEIGHT"), ("SAMP", "LINE")
    try:
        return RPC(
            coeffs=np.array([fields[f"{axis}_{part}_COEFF"] for axis in image for part in ("NUM", "DEN")]),
            ground_offset=np.array([fields[f"{axis}_OFF"][0] for axis in ground]),
            ground_scale=np.array([fields[f"{axis}_SCALE"][0] for axis in ground]),
            image_offset=np.array([fields[f"{axis}_OFF"][0] for axis in image]) - first_pixel,
            image_scale=np.array([fields[f"{axis}_SCALE"][0] for axis in image]),
            err_bias=_accuracy(fields.get("ERR_BIAS")),
            err_rand=_accuracy(fields.get("ERR_RAND")),
            direct=np.array([fields[key] for key in DIRECT]) if lists is LISTS else None,
        )
    except RpcFormatError:
        raise
    except RpcError as error:
        raise RpcFormatError(f"{name}: {error}") from error


def _accuracy(value: Sequence[float] | None) -> float | None:
    """Return a stated accuracy [m]; zero and below mean that nobody knows, not that it is perfect."""
    if not value or not math.isfinite(value[0]) or value[0] <= 0:
        return None
    return float(value[0])


def fields_from_rpc(rpc: RPC, direct: bool = False) -> Fields:
    """Return the fields of an RPC, in the order that files give them; unknown accuracies are left out.

    Those of its localisation RPC come last, in files that hold them (`direct`).
    """
    fields = {key: [value] for key, value in zip(ERRORS, (rpc.err_bias, rpc.err_rand), strict=True) if value}
    for keys, image, ground in (
        (OFFSETS, rpc.image_offset, rpc.ground_offset),
        (SCALES, rpc.image_scale, rpc.ground_scale),
    ):
        (col, row), (lon, lat, alt) = image.tolist(), ground.tolist()
        fields |= {key: [value] for key, value in zip(keys, (row, col, lat, lon, alt), strict=True)}
    col_num, col_den, row_num, row_den = rpc.coeffs.tolist()
    fields |= dict(zip(COEFFICIENTS, (row_num, row_den, col_num, col_den), strict=True))
    held = rpc.direct.tolist() if direct and rpc.direct is not None else []
    return fields | dict(zip(DIRECT, held, strict=False))
