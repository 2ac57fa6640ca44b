"""RPCs as text: ``_RPC.TXT``, ``.RPB``, OSSIM's ``.geom``, ENVI, rpcm's JSON, orthority's YAML, ALOS' columns.

Every reader, here and in XML and rasters, gathers `Fields`, numbers by the names that GDAL gives them; one function
makes the RPC of them and checks that nothing is missing.
"""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from barpc.base.errors import Remark, RpcError, RpcFormatError, plain
from barpc.base.safe_io import encoding_of, parse_json
from barpc.sensor.rpc import RPC, RPCM_NAMES

OFFSETS = ("LINE_OFF", "SAMP_OFF", "LAT_OFF", "LONG_OFF", "HEIGHT_OFF")
SCALES = ("LINE_SCALE", "SAMP_SCALE", "LAT_SCALE", "LONG_SCALE", "HEIGHT_SCALE")
COEFFICIENTS = ("LINE_NUM_COEFF", "LINE_DEN_COEFF", "SAMP_NUM_COEFF", "SAMP_DEN_COEFF")
ERROR_FIELDS = ("ERR_BIAS", "ERR_RAND")
SINGLE = ERROR_FIELDS + OFFSETS + SCALES
KEYS = SINGLE + COEFFICIENTS  # GDAL's names of all fields, in the order of the GeoTIFF tag

_MAXAR_WORDS = (
    "errBias errRand lineOffset sampOffset latOffset longOffset heightOffset lineScale sampScale latScale longScale "
    "heightScale lineNumCoef lineDenCoef sampNumCoef sampDenCoef"
)
MAXAR = dict(zip(KEYS, _MAXAR_WORDS.split(), strict=True))
"""GDAL's name of a field -> Maxar's in an ``.RPB`` file; its XML has them in capitals."""

Size = tuple[int, int]  # width, height [px]
Fields = dict[str, list[float]]
"""Field name -> its numbers: one, or twenty for the four lists of coefficients (RPC00B order)."""

_INDEXED = re.compile(rf"({'|'.join(COEFFICIENTS)})_(\d+)")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([EeDd][+-]?\d+)?")


@dataclass(frozen=True)
class ReadOptions:
    """Choices that the reader of an RPC cannot take from the file."""

    first_pixel: float | None = None
    """The file's coordinate of the first pixel's centre: 0, 0.5 or 1; None: the format's rule (``docs/formats.md``)."""
    band: int = 1
    """Which band's RPC, from 1, where a file holds one for each."""


_UNITS = {
    word: (measure, size)
    for measure, size, words in (
        ("pixels", 1.0, "px pixel pixels line lines row rows sample samples column columns"),
        ("degrees", 1.0, "deg degree degrees decimaldegree decimaldegrees"),
        ("degrees", 180.0 / math.pi, "rad radian radians"),
        ("metres", 1.0, "m meter meters metre metres"),
        ("metres", 0.3048, "ft foot feet internationalfoot internationalfeet"),
        ("metres", 1200.0 / 3937.0, "ftus usft usfoot usfeet surveyfoot surveyfeet ussurveyfoot ussurveyfeet"),
    )
    for word in words.split()
}
"""Unit, as files write it behind a number -> what it measures, and how many of the unit of `Fields` it is."""
_MEASURES = {
    "pixels": re.compile(r"(?i)(line|samp|row|col)(?!.*(num|den))"),
    "degrees": re.compile(r"(?i)(lat|lon)(?!.*(num|den))"),
    "metres": re.compile(r"(?i)(height|alt|err|bias|rand)"),
}
_UNIT_WORDS = re.compile(r"[\s(\[]*([^\W\d_][^\W\d]*(?:[\s.-]+[^\W\d]+){0,4})")


class Stated(float):
    """A number with a unit behind it, in that of `Fields`."""

    size = 1.0  # of its own unit


def _field_measure(key: str) -> str | None:
    """Return the unit of a field, by the name that a file has for it; None of coefficients, which have none."""
    return next((measure for measure, names in _MEASURES.items() if names.match(key)), None)


def _unit_size(rest: str, name: str, key: str) -> float | None:
    """Return the size of the unit behind a number of a field, None without one; RpcFormatError where it is no such."""
    found, measure = _UNIT_WORDS.match(rest.replace("°", " deg ")), _field_measure(key)
    if found is None or measure is None:
        return None
    words = re.split(r"[\s_.-]+", found[1].lower())
    for end in range(len(words), 0, -1):
        unit = _UNITS.get("".join(words[:end]))
        if unit is not None and unit[0] == measure and all(len(word) > 1 for word in words[end : end + 1]):
            return unit[1]
    raise RpcFormatError(f"{name}: {key} is in {rest.strip()[:40]!r}, expected {measure}")


def number(text: str, name: str, key: str) -> float:
    """Return the number at the start of `text` (or RpcFormatError); 1D3 is Fortran's 1E3.

    A unit may follow: `Stated` numbers are in pixels, degrees or metres; what is no unit of `key` is refused.
    """
    text = text.strip()
    match = NUMBER.match(text)
    rest = text[match.end() :] if match else text
    apart = not rest or rest[0].isspace() or rest[0] in "°%" or (rest[0].isalpha() and _field_measure(key) is not None)
    if match is None or not apart:
        raise RpcFormatError(f"{name}: {key} is not a number ({text[:40]!r})")
    found, size = match.group(), _unit_size(rest, name, key) if rest else None
    try:
        value = float(found)
    except ValueError:
        value = float(found.upper().replace("D", "E"))
    if not math.isfinite(value):
        raise RpcFormatError(f"{name}: {key} is not finite ({text[:40]!r})")
    if size is None:
        return value
    stated = Stated(value * size)
    stated.size = size
    return stated


def listed_numbers(text: str, name: str, key: str) -> list[float]:
    """Return the numbers of a list separated by blanks or commas, of a measure each with its unit, if any."""
    apart = r"[\s,]+" if _field_measure(key) is None else r"[\s,]+(?=[-+.\d]|nan\b|inf)"
    return [number(part, name, key) for part in re.split(apart, text.strip(), flags=re.IGNORECASE) if part]


def format_number(value: float) -> str:
    """Return the shortest text that reads back as the same double."""
    return repr(float(value)).removesuffix(".0")


def collect_numbered(pairs: Iterable[tuple[str, float]], name: str) -> Fields:
    """Gather ``LINE_NUM_COEFF_1 .. _20``, or ``_0 .. _19``, into lists, in whatever order they come."""
    single: dict[str | int, float] = {}
    lists: dict[str, dict[str | int, float]] = {}
    for key, value in pairs:
        found = _INDEXED.fullmatch(key)
        slot = int(found[2][:9]) if found else key
        known = (lists.setdefault(found[1], {}) if found else single).setdefault(slot, value)
        if known != value:
            raise RpcFormatError(f"{name}: {key} is given twice, {known} and {value}")
    for stem, values in lists.items():
        if set(values) not in (set(range(20)), set(range(1, 21))):
            raise RpcFormatError(f"{name}: {stem} has {len(values)} coefficients, expected 20, numbered from 0 or 1")
    one = {str(key): [value] for key, value in single.items()}
    return one | {stem: [values[i] for i in sorted(values)] for stem, values in lists.items()}


def fields_in_order(values: Sequence[float], keys: Sequence[str]) -> Fields:
    """Return the fields of numbers without names: single ones `keys`, then four times twenty coefficients."""
    fields: Fields = {key: [value] for key, value in zip(keys, values, strict=False)}
    return fields | {key: list(values[len(keys) + 20 * i :][:20]) for i, key in enumerate(COEFFICIENTS)}


# Position in RPC00A of each of RPC00B's twenty monomials.
_B_FROM_A = (0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 7, 11, 14, 17, 12, 15, 18, 13, 16, 19)


def in_order_b(fields: Fields, order: str, name: str) -> Fields:
    """Return the fields with coefficients in RPC00B's order, of one that a file calls "RPC00A"; any other is RPC00B.

    Converters write "XXX" or the name of their program there, and GDAL passes it over.
    """
    if order.startswith("RPC00") and order not in ("RPC00A", "RPC00B"):
        raise RpcFormatError(f"{name}: coefficients in the order {order!r}, only RPC00A and RPC00B are read")
    lists = (key for key in COEFFICIENTS if order == "RPC00A" and len(fields.get(key, ())) == len(_B_FROM_A))
    return fields | {key: [fields[key][i] for i in _B_FROM_A] for key in lists}


def rpc_from_fields(
    fields: Mapping[str, Sequence[float]], name: str, options: ReadOptions | None = None, first_pixel: float = 0.0
) -> RPC:
    """Return the RPC of the fields of a file called `name`.

    The format's coordinate of the centre of the first pixel, or the options', is subtracted from the image offsets.
    RpcFormatError where a field (but ERR_BIAS and ERR_RAND) is missing, has the wrong length, is not finite, or a
    scale is zero.
    """
    if options is not None and options.first_pixel is not None:
        first_pixel = options.first_pixel
    _require_fields(fields, name)
    single = np.array([fields[key][0] for key in OFFSETS + SCALES])
    single[:2] -= first_pixel
    bias, rand = (next(iter(fields.get(key, ())), None) for key in ERROR_FIELDS)
    try:
        return RPC.of_numbers([*single, *(fields[key] for key in COEFFICIENTS)], bias, rand)
    except RpcError as error:
        raise RpcFormatError(f"{name}: {error}") from error


def _require_fields(fields: Mapping[str, Sequence[float]], name: str) -> None:
    for key, count in (dict.fromkeys(OFFSETS + SCALES, 1) | dict.fromkeys(COEFFICIENTS, 20)).items():
        found = len(fields.get(key, ()))
        if found != count:
            what = "is missing" if not found else f"has {found} numbers, expected {count}"
            raise RpcFormatError(f"{name}: {key} {what}")
    for axis in ("LAT", "LONG", "HEIGHT"):
        both = {getattr(fields[f"{axis}_{part}"][0], "size", None) for part in ("OFF", "SCALE")}
        if None in both and both - {None, 1.0}:
            raise RpcFormatError(f"{name}: of {axis}_OFF and {axis}_SCALE one states a unit, the other none")


def fields_from_rpc(rpc: RPC) -> Fields:
    """Return the fields of an RPC, in the order that files give them; unknown accuracies are left out."""
    fields = {key: [value] for key, value in zip(ERROR_FIELDS, (rpc.err_bias, rpc.err_rand), strict=True) if value}
    keys = OFFSETS + SCALES + COEFFICIENTS
    return fields | {k: v if k in COEFFICIENTS else [v] for k, v in zip(keys, rpc.numbers(), strict=True)}


# --- names and numbers, a line each ----------------------------------------------------------------------

# Patterns here take time in proportion to the text, whatever it holds: no two repetitions can share a character,
# and one that may run far begins where a line or a word begins.
_PREFIX = re.compile(r"(|.*[._])LINE_OFF")
_KEY_VALUE_LINE = re.compile(r"^[ \t]*+([A-Za-z][\w.]*+)[ \t]*+[:=,](.*)$", re.MULTILINE)
_INVERSE = re.compile(r"(LAT|LONG)_(NUM|DEN)_COEFF_\d+")  # of WHU-TLC and SatMVS, in the units of their own


def decode_text(data: bytes) -> str:
    """Return the text of a file, with line ends of one kind: UTF-8, UTF-16, else Latin-1 (a degree sign, say)."""
    try:
        text = data.decode(encoding_of(data))
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def _numbered_lines(fields: Fields, separator: str, indices: Sequence[str]) -> list[str]:
    """Return a line for every number; the coefficients of a list have these indices."""
    lines = []
    for key, values in fields.items():
        names = [f"{key}_{index}" for index in indices] if key in COEFFICIENTS else [key]
        lines += [f"{k}{separator}{format_number(value)}" for k, value in zip(names, values, strict=True)]
    return lines


_GEOM_ERRORS = {"BIAS_ERROR": "ERR_BIAS", "RAND_ERROR": "ERR_RAND"}


def _key_value_pairs(text: str, name: str) -> list[tuple[str, str]]:
    """Return keys, in capitals, and values of a text; a prefix that all have, ``RPC_`` or ``image0.``, is left out."""
    lines = [(match[1].upper(), match[2].strip().removesuffix(";")) for match in _KEY_VALUE_LINE.finditer(text)]
    found = {match[1] for key, _ in lines if (match := _PREFIX.fullmatch(key))}
    if len(found - {""}) > 1:
        raise RpcFormatError(f"{name}: RPCs of several images ({', '.join(sorted(found))}); give a file of one")
    prefix = min(found, default="")
    return [(key.removeprefix(prefix), value) for key, value in lines if key.startswith(prefix)]


def read_txt(text: str, name: str, options: ReadOptions) -> RPC:
    """Read ``KEY: value``, with or without a unit behind (GDAL, Planet, IKONOS, GeoEye, OrbView, KOMPSAT).

    Coefficients are numbered from 1 or 0, or twenty in a line, as GDAL has them. An inverse from image to ground of
    the 170 lines of WHU-TLC and SatMVS is passed over: the RPC's own is computed.
    """
    lines = _key_value_pairs(text, name)
    if any(key.startswith("LONG_NUM_COEFF") for key, _ in lines):
        warnings.warn(f"{name}: its inverse (LAT_ and LONG_ coefficients) is not used", Remark, stacklevel=2)
        lines = [(key, value) for key, value in lines if not _INVERSE.fullmatch(key)]
    return rpc_from_fields(_fields_of_lines(lines, name), name, options)


def _fields_of_lines(lines: Iterable[tuple[str, str]], name: str) -> Fields:
    pairs: list[tuple[str, float]] = []
    for word, value in lines:
        key = _GEOM_ERRORS.get(word, word)
        if key in COEFFICIENTS:
            pairs += [(f"{key}_{i}", one) for i, one in enumerate(listed_numbers(value, name, key), 1)]
        elif key in SINGLE or key.rpartition("_")[0] in COEFFICIENTS:
            pairs.append((key, number(value, name, key)))
    return collect_numbered(pairs, name)


def write_txt(rpc: RPC) -> str:
    """Write ``KEY: value`` without units (rpcm stumbles on them); every number reads back to the bit.

    The first ninety lines are those of readers that go by the line alone; what only some RPCs have stands behind.
    """
    fields = fields_from_rpc(rpc)
    order = (*OFFSETS, *SCALES, *COEFFICIENTS, *ERROR_FIELDS)
    lines = _numbered_lines({key: fields[key] for key in order if key in fields}, ": ", [str(i) for i in range(1, 21)])
    return "\n".join(lines) + "\n"


# --- .RPB -------------------------------------------------------------------------------------------------

_RPB_PAIR = re.compile(r"\b(\w++)\s*+=\s*+(\([^()]*+\)|[^;\n()]*+);?")


def _read_words(
    pairs: Iterable[tuple[str, str]], words: Mapping[str, str], name: str, options: ReadOptions, order: str = "RPC00B"
) -> RPC:
    """Return the RPC of words, of a field each, and values: numbers, or lists of them in parentheses or brackets."""
    keys = {word.lower(): key for key, word in words.items()}
    fields: Fields = {}
    for word, value in pairs:
        key, bare_value = keys.get(word.lower()), value.strip("()[], \t\n")
        if key is None or not bare_value:
            continue
        if key in fields:
            raise RpcFormatError(f"{name}: {word} is given twice; give a file of one image")
        if bare_value not in ("null", "~"):
            fields[key] = listed_numbers(bare_value, name, word)
    return rpc_from_fields(in_order_b(fields, order, name), name, options)


def read_rpb(text: str, name: str, options: ReadOptions) -> RPC:
    """Read Maxar's ``key = value;`` with lists in parentheses."""
    spec = re.search(r'SpecId\s*+=\s*+"([^"\n]*+)"', text, re.IGNORECASE)
    order = spec[1].strip().upper() if spec else "RPC00B"
    return _read_words(_RPB_PAIR.findall(text), MAXAR, name, options, order)


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


def read_geom(text: str, name: str, options: ReadOptions) -> RPC:
    """Read OSSIM's keyword list, as OTB and CARS use it, with its current adjustment; the RPC of the FULL image."""
    lines = _key_value_pairs(text, name)
    order = f"RPC00{dict(lines).get('POLYNOMIAL_FORMAT', 'B')}"
    fields = in_order_b(_fields_of_lines(lines, name), order, name)
    return _with_ossim_adjustment(rpc_from_fields(fields, name, options), dict(lines), name)


def _with_ossim_adjustment(rpc: RPC, lines: Mapping[str, str], name: str) -> RPC:
    """Return an RPC with OSSIM's adjustments: offsets and scales of rows and columns, and a rotation.

    Each is center + sigma * parameter. OSSIM rotates the quotients, which are quotients again only where both have one
    denominator: else a rotation is refused.
    """
    current = f"ADJUSTMENT_{lines.get('CURRENT_ADJUSTMENT', '0').strip()}.ADJ_PARAM_"
    sizes = dict.fromkeys("01234", 0.0)
    for index in {key.removeprefix(current).partition(".")[0] for key in lines if key.startswith(current)}:
        center, sigma, parameter = (
            number(lines.get(f"{current}{index}.{part}", "0"), name, f"adj_param_{index}.{part.lower()}")
            for part in ("CENTER", "SIGMA", "PARAMETER")
        )
        sizes[index] = center + sigma * parameter
        if (parameter and not sigma) or (sizes[index] and index not in "01234"):
            raise RpcFormatError(f"{name}: adj_param_{index} is no adjustment of OSSIM's RPC (0 to 4), or has no sigma")
    rows, cols, row_scale, col_scale, turn = (sizes[index] for index in "01234")
    coeffs = rpc.coeffs
    if turn:
        if not (coeffs[1] == coeffs[3]).all():
            raise RpcFormatError(
                f"{name}: adjusted by a rotation of {turn:g} degrees, which an RPC holds only where rows and columns "
                "have one denominator; project points with OSSIM and give them to 'barpc fit'"
            )
        cos, sin = math.cos(math.radians(turn)), math.sin(math.radians(turn))
        col, row = cos * coeffs[0] - sin * coeffs[2], cos * coeffs[2] + sin * coeffs[0]
        coeffs = np.array([col, coeffs[1], row, coeffs[3]])
    offset, scale = np.add(rpc.image_offset, [cols, rows]), np.add(rpc.image_scale, [col_scale, row_scale])
    try:
        return replace(rpc, coeffs=coeffs, image_offset=offset, image_scale=scale)
    except RpcError as error:
        raise RpcFormatError(f"{name}: adjusted, {error}") from error


def write_geom(rpc: RPC) -> str:
    """Write OSSIM's keyword list with all keys that its readers ask for (they add the half pixel themselves)."""
    fields = fields_from_rpc(rpc)
    errors = {word: fields.pop(key, [0.0]) for word, key in _GEOM_ERRORS.items()}  # 0 is OSSIM's "unknown"
    lines = _numbered_lines(errors | fields, ":  ", [f"{i:02d}" for i in range(20)])
    head = ["type:  ossimRpcModel", "polynomial_format:  B"]
    return "\n".join([*head, *(line.lower() for line in lines)]) + "\n"


_ENVI_RPC_INFO = re.compile(r"^[ \t]*+rpc info\s*+=\s*+\{([^{}]*+)\}", re.MULTILINE | re.IGNORECASE)


def read_envi(text: str, name: str, options: ReadOptions) -> RPC:
    """Read ENVI's header: offsets, scales, four times twenty coefficients; three more numbers may follow."""
    match = _ENVI_RPC_INFO.search(text)
    values = listed_numbers(match.group(1), name, "rpc info") if match else []
    if len(values) not in _RPC_LENGTHS:
        raise RpcFormatError(f"{name}: rpc info has {len(values)} numbers, expected 90 or 93")
    return rpc_from_fields(fields_in_order(values, OFFSETS + SCALES), name, options)


_RPC_LENGTHS = (90, 93)  # numbers of an RPC; three more may follow
_OF_TAG = 92  # numbers of GeoTIFF's tag 50844, the errors first
_BETWEEN = re.compile(r"[\s,;]+")
_ONE = 0.01  # by which the first coefficient of a denominator may miss 1: OrbView's are 0.99995


def is_bare_rpc(text: str) -> bool:
    """Return whether a text holds the numbers of an RPC and nothing else."""
    parts = [part for part in _BETWEEN.split(text, maxsplit=100) if part]
    return len(parts) in (*_RPC_LENGTHS, _OF_TAG) and all(map(NUMBER.fullmatch, parts))


def read_bare(text: str, name: str, options: ReadOptions) -> RPC:
    """Read numbers without names, between commas, blanks or lines, in the order of ENVI's header (IARPA, s2p), or of
    GeoTIFF's tag 50844.
    """
    values = [number(part, name, "a number") for part in _BETWEEN.split(text) if part]
    keys = SINGLE if len(values) == _OF_TAG else OFFSETS + SCALES
    rpc = rpc_from_fields(fields_in_order(values, keys), name, options)
    first = rpc.coeffs[1::2, 0]
    if not (np.abs(first - 1.0) <= _ONE).all():
        raise RpcFormatError(
            f"{name}: {len(values)} numbers without names, whose denominators would begin with {first[1]:g} and "
            f"{first[0]:g}: those of an RPC begin with 1"
        )
    return rpc


_LOWER_KEYS = {key: key.lower() for key in KEYS}
_RPCM_KEYS = _LOWER_KEYS | dict(zip(KEYS[2:], RPCM_NAMES, strict=True))  # the errors are not rpcm's own
_VISSAT_WORDS = (
    "rowoff coloff latoff lonoff altoff rowscale colscale latscale lonscale altscale rownum rowden colnum colden"
)
_VISSAT_KEYS = dict(zip(KEYS[2:], _VISSAT_WORDS.split(), strict=True))


def read_rpc_json(text: str, name: str, options: ReadOptions) -> RPC:
    """Read ``{"rpc": {"row_offset": ...}}`` (rpcm, s2p), ``{"line_off": ...}`` (rasterio) or ``{"rowOff": ...}``
    (VisSat, SatelliteSfM), nested or not.
    """
    try:
        document = parse_json(text)
    except ValueError as error:
        raise RpcFormatError(f"{name}: not JSON ({plain(error)})") from error
    for dialect, mark in ((_RPCM_KEYS, "row_num"), (_LOWER_KEYS, "line_num_coeff"), (_VISSAT_KEYS, "rownum")):
        found = _find(document, mark)
        if found is not None:
            values = {word.lower(): value for word, value in found.items() if value is not None}
            fields = {key: _values(values[word], name, word) for key, word in dialect.items() if word in values}
            return rpc_from_fields(fields, name, options)
    raise RpcFormatError(f"{name}: no RPC in this JSON (looked for row_num, line_num_coeff and rowNum)")


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
    return json.dumps({"rpc": rpc.to_rpcm_dict()}, indent=1) + "\n"


_KEY_AND_VALUE = re.compile(r"^[ \t-]*+(\w++):[ \t]*+(\[[^\[\]]*+\]|[^\n\[{]*+)", re.MULTILINE)


def read_yaml(text: str, name: str, options: ReadOptions) -> RPC:
    """Read a parameter file of orthority with one image: names as rasterio's, lists in brackets or as dashes."""
    text = re.sub(r"\n[ \t]*+-[ \t]++(?=[+-.\d])", ", ", text)  # a block list into one line
    return _read_words(_KEY_AND_VALUE.findall(text), _LOWER_KEYS, name, options)


# --- columns of fixed width -------------------------------------------------------------------------------

WIDTHS = 2 * (6, 5, 8, 9, 5)
"""Characters of offsets and scales, as NITF and ALOS have them."""


def cells_of(text: str, widths: Sequence[int], keys: Sequence[str], name: str, order: str = "RPC00B") -> Fields:
    """Return the fields of one record: single numbers `keys` of these widths, then four times twenty coefficients."""
    ends = np.cumsum([*widths, *[12] * 80]).tolist()
    if len(text) < ends[-1]:
        raise RpcFormatError(f"{name}: an RPC record of {len(text)} characters, expected {ends[-1]}")
    labels = [*keys, *(f"{key}_{i}" for key in COEFFICIENTS for i in range(1, 21))]
    places = zip(labels, [0, *ends[:-1]], ends, strict=True)
    values = [number(text[start:end], name, label) for label, start, end in places]
    return in_order_b(fields_in_order(values, keys), order, name)


def read_alos(text: str, name: str, options: ReadOptions) -> RPC:
    """Read ALOS PRISM's and AVNIR's ``RPC-*.txt``: offsets, scales, four times twenty coefficients."""
    return rpc_from_fields(cells_of(text.split("\n", 1)[0], WIDTHS, OFFSETS + SCALES, name), name, options)
