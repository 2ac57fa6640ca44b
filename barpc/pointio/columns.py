"""Columns of text tables of any program, by their names, which state quantity, unit and vertical datum."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

from barpc.base.errors import InputError
from barpc.base.geodesy import DEFAULT, INFERRED, STATED
from barpc.pointio.tables import Names, header_of, normalised_word
from barpc.rasters.vertical import ELLIPSOID, UNKNOWN, Vertical, metres_of

COLUMNS: Names = {
    "lon": ("lon", "long", "longitude", "lng"),
    "lat": ("lat", "latitude"),
    "alt": ("alt", "altitude", "height", "h", "z", "elevation", "elev", "height_above_datum"),
    "col": ("col", "column", "samp", "sample", "pixel", "px", "pixel_x", "image_x"),
    "row": ("row", "line", "py", "pixel_y", "image_y"),
}


def guessed(words: Sequence[str], known: Names) -> tuple[dict[str, int], list[str], Vertical]:
    """Return the column index of each quantity of control points, a remark on each guess, and the vertical datum.

    Names listed in `known` and `COLUMNS` come first, then those that match `_PATTERNS`: guesses. The datum and
    unit are those in the altitude's name. InputError if two columns could be the altitude.
    """
    if {"X", "Y", "x", "y"} <= set(words):  # scripts for Metashape distinguish map and image by case alone
        words = [_BY_CASE.get(word, word) for word in words]
    bare = [_bare_name(word) for word in words]
    exact = header_of(bare, {**COLUMNS, **known})
    found = dict(exact)
    if {"x", "y"} <= set(bare) and not {"lon", "lat", "col", "row"} & set(found):
        on_map = all(key in found or _alike(key, words, bare, found.values()) is not None for key in ("east", "north"))
        pair = ("east", "north") if "alt" in found and not on_map else ("col", "row")
        found |= {key: bare.index(word) for key, word in zip(pair, "xy", strict=True)}
    for key in (key for key in _PATTERNS if key not in found):
        if (place := _alike(key, words, bare, found.values())) is not None:
            found[key] = place
    said = [f"column {words[i]!r} is {key}" for key, i in found.items() if exact.get(key) != i]
    return found, said, vertical_of_column(words[found["alt"]] if "alt" in found else "")


def _alike(key: str, words: Sequence[str], bare: Sequence[str], taken: Collection[int]) -> int | None:
    """Return the first column not `taken` whose name matches the pattern; InputError if two could be the altitude."""
    free = (i for i, word in enumerate(bare) if i not in taken and not _NO_COORDINATE.match(word))
    hits = [i for i in free if _PATTERNS[key].fullmatch(bare[i])]
    above = [i for i in hits if "ellips" in bare[i] or "hae" in bare[i]]
    if key == "alt" and len(hits) > 1 and len(above) != 1:
        raise InputError(f"columns {' and '.join(repr(words[i]) for i in hits)} could be the altitude; rename one alt")
    return next(iter(above or hits), None)


def vertical_of_column(word: str) -> Vertical:
    """Return the vertical datum and unit of altitudes from the name of their column."""
    _, unit, metres = _unit_of(word)
    none = (UNKNOWN, None, DEFAULT)
    name, geoid, known = next((of for sign, of in _DATUMS.items() if re.search(sign, word, re.IGNORECASE)), none)
    return Vertical(name, metres, unit, geoid, known)


def like_altitudes(words: Sequence[str]) -> list[str]:
    """Return the normalised names that match the pattern of an altitude, for tables without a listed one."""
    return [
        normalised_word(word)
        for word in words
        if _PATTERNS["alt"].fullmatch(bare := _bare_name(word)) and not _NO_COORDINATE.match(bare)
    ]


def _unit_of(word: str) -> tuple[str, str, float]:
    """Return a column's name without its unit of length, the unit (empty: none is stated) and its length [m]."""
    parts = re.findall(r"[^\s_\[\]()-]+", word)
    for n in range(min(3, len(parts) - 1), 0, -1):
        unit = "".join(parts[-n:])
        if unit.isalpha() and (metres := metres_of(unit)) is not None:
            return word[: word.rindex(parts[-n])].rstrip(" _[("), " ".join(parts[-n:]), metres
    return word, "", 1.0


_DATUMS = {  # pattern of an altitude's name -> reference, geoid grid and provenance of its datum
    "ellips|hae|(?<![a-z])ell(?![a-z])": (ELLIPSOID, None, STATED), "egm.?96": ("EGM96 height", "egm96", STATED),
    "egm.?(20)?08": ("EGM2008 height", "egm2008", STATED),
    "navd.?88": ("NAVD88 height", "egm96", STATED), "ortho|msl|geoid": ("the sea", "egm96", STATED),
    # by the definitions of barpc, GeoJSON, ICESat-2 and GEDI
    r"^alt(?![a-z])|^h_(?:ph|li|te_best_fit|mean)$|lowestmode": (ELLIPSOID, None, INFERRED),
}  # fmt: skip


_NO_COORDINATE = re.compile(
    "sigma|std|stdev|acc|err|resid|d[xyz]$|.*_(error|est|sigma|std|accuracy)$|(image|img)_(width|height)"
)


_IMAGE_WORDS = "image|img|pixel|pix|px|photo|source|raster|im"
_MAP_WORDS = "utm|map|world|ground|geo|coord|point|proj|gk|l93|lambert|lambert93|terrain|gcp|coordinate"


_PATTERNS = {
    key: re.compile(pattern)
    for key, pattern in {
        "col": rf"({_IMAGE_WORDS})_?(x|u|col|column|sample)|(x|u|col|column|sample)_?({_IMAGE_WORDS})|u",
        "row": rf"({_IMAGE_WORDS})_?(y|v|row|line)|(y|v|row|line)_?({_IMAGE_WORDS})|v",
        "lon": r"(.+_)?(lon|long|longitude|lng)(_.+)?",
        "lat": r"(.+_)?(lat|latitude)(_.+)?",
        "east": rf"e|(.+_)?(east|eastings?|rechtswert)(_.+)?|({_MAP_WORDS})_?(x|e)|x_?({_MAP_WORDS})",
        "north": rf"n|(.+_)?(north|northings?|hochwert)(_.+)?|({_MAP_WORDS})_?(y|n)|y_?({_MAP_WORDS})",
        "alt": r"(.+_)?(alt|altitude|height|hgt|ele|elev|elevation|z|h|hae|msl|egm_?(20)?(96|08)|navd_?88)(_.+)?",
        "image": r"(.+_)?(image|img|photo|picture|camera|file|filename)(_(name|file|id|label|path))?",
        "id": r"(gcp|point|pt|marker|target|station)_?(id|name|no|nr|num|number|label)?|fid|no|nr|num|number",
    }.items()
}
"""Quantity -> pattern of names that are not listed: guesses, which the log reports."""


_BY_CASE = {"X": "map_X", "Y": "map_Y", "Z": "map_Z", "x": "px_x", "y": "px_y"}
_XY_IN_PIXELS = re.compile(r"(?i)^\s*([xyuv])\s*[\[(]\s*(px|pix|pixels?)\s*[\])]\s*$")


def _bare_name(word: str) -> str:
    """Return a name in lower case without unit, words joined by underscores; of X/Longitude the second."""
    word = _XY_IN_PIXELS.sub(r"px_\1", word)
    name, _, metres = _unit_of(word)
    # accuracies are read in metres only: one in another unit keeps it, so that no listed name matches
    word = re.sub(r"\W", "_", word) if metres != 1.0 and _NO_COORDINATE.match(word.lower()) else name
    word = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", word.strip().rpartition("/")[2])
    return re.sub(r"[^\w]+", "_", re.sub(r"[\[(].*", "", word).lower()).strip("_")
