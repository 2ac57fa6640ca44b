"""Text tables of numbers: points by the names of their columns, whoever wrote them, and motions of the ground.

A column's name says quantity, unit and vertical datum; a cell is a number, or degrees, minutes and seconds.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np

from barpc.base.errors import BarpcError, InputError, plain
from barpc.base.geodesy import DEFAULT, INFERRED, STATED, Array
from barpc.base.safe_io import MAX_DIGITS, MAX_NUMBER, OPTIONS, TABLE, opened_text, read_text
from barpc.pointio.names import from_cell
from barpc.rasters.vertical import ELLIPSOID, UNKNOWN, Vertical, metres_of
from barpc.scene import IntArray

GROUND_SIGMA = 1.0  # standard deviation [m] along an axis of a GCP, or of the place of a height, whose file states none
IMAGE_SIGMA = 0.5  # standard deviation of each image coordinate [px], of GCPs and tie points whose file states none

Names = Mapping[str, Sequence[str]]
"""Quantity -> what files call it."""

COLUMNS: Names = {
    "lon": ("lon", "long", "longitude", "lng"),
    "lat": ("lat", "latitude"),
    "alt": ("alt", "altitude", "height", "h", "z", "elevation", "elev", "height_above_datum"),
    "col": ("col", "column", "samp", "sample", "pixel", "px", "pixel_x", "image_x"),
    "row": ("row", "line", "py", "pixel_y", "image_y"),
}
_EITHER = ("lon", "lat"), ("col", "row")
"""What x and y are: the pair that no other column is named for."""


def header_of(words: Sequence[str], names: Names) -> dict[str, int]:
    """Return the column of each quantity that a header names."""
    lower = [_normalised_word(word) for word in words]
    hits = {key: [lower.index(a) for a in aliases if a in lower] for key, aliases in names.items()}
    found = {key: places[0] for key, places in hits.items() if places}
    left = [pair for pair in _EITHER if set(pair) <= set(names) and not set(pair) <= set(found)]
    if len(left) == 1:
        either = {key: lower.index(word) for key, word in zip(left[0], "xy", strict=True) if word in lower}
        found = {**either, **found}
    return found


def guessed(words: Sequence[str], known: Names) -> tuple[dict[str, int], list[str], Vertical]:
    """Return the column of each quantity of control points, by the names of `known` and `COLUMNS`, then by likeness;
    in words, which were guessed so; and what the altitude's name says of it. InputError where two could be that.
    """
    if {"X", "Y", "x", "y"} <= set(words):  # where the case alone tells them apart, as scripts for Metashape write it
        words = [_BY_CASE.get(word, word) for word in words]
    bare = [_bare(word) for word in words]
    exact = header_of(bare, {**COLUMNS, **known})
    found = dict(exact)
    if {"x", "y"} <= set(bare) and not {"lon", "lat", "col", "row"} & set(found):
        on_map = all(key in found or _alike(key, words, bare, found.values()) is not None for key in ("east", "north"))
        pair = ("east", "north") if "alt" in found and not on_map else ("col", "row")
        found |= {key: bare.index(word) for key, word in zip(pair, "xy", strict=True)}
    for key in (key for key in _LIKE if key not in found):
        if (place := _alike(key, words, bare, found.values())) is not None:
            found[key] = place
    said = [f"column {words[i]!r} is {key}" for key, i in found.items() if exact.get(key) != i]
    return found, said, vertical_of_column(words[found["alt"]] if "alt" in found else "")


def _alike(key: str, words: Sequence[str], bare: Sequence[str], taken: Collection[int]) -> int | None:
    """Return the column not `taken` yet with a name like a quantity's; InputError where two could be the altitude."""
    free = (i for i, word in enumerate(bare) if i not in taken and not _ERRORS.match(word))
    hits = [i for i in free if _LIKE[key].fullmatch(bare[i])]
    above = [i for i in hits if "ellips" in bare[i] or "hae" in bare[i]]
    if key == "alt" and len(hits) > 1 and len(above) != 1:
        raise InputError(f"columns {' and '.join(repr(words[i]) for i in hits)} could be the altitude; rename one alt")
    return next(iter(above or hits), None)


def vertical_of_column(word: str) -> Vertical:
    """Return the vertical datum and unit of altitudes from the name of their column."""
    _, unit, metres = _unit_of(word)
    none = (UNKNOWN, None, DEFAULT)
    name, geoid, known = next((of for sign, of in _LEVELS.items() if re.search(sign, word, re.IGNORECASE)), none)
    return Vertical(name, metres, unit, geoid, known)


def like_altitudes(words: Sequence[str]) -> list[str]:
    """Return the names, as `header_of` compares them, that are like that of an altitude."""
    return [
        _normalised_word(word)
        for word in words
        if _LIKE["alt"].fullmatch(bare := _bare(word)) and not _ERRORS.match(bare)
    ]


def _normalised_word(word: str) -> str:
    return re.sub(r"[\[(].*", "", word.lower()).strip().replace(" ", "_")


def _unit_of(word: str) -> tuple[str, str, float]:
    """Return a column's name without its unit of length, the unit (empty: none is said) and its metres."""
    parts = re.findall(r"[^\s_\[\]()-]+", word)
    for n in range(min(3, len(parts) - 1), 0, -1):
        unit = "".join(parts[-n:])
        if unit.isalpha() and (metres := metres_of(unit)) is not None:
            return word[: word.rindex(parts[-n])].rstrip(" _[("), " ".join(parts[-n:]), metres
    return word, "", 1.0


_LEVELS = {
    "ellips|hae|(?<![a-z])ell(?![a-z])": (ELLIPSOID, None, STATED), "egm.?96": ("EGM96 height", "egm96", STATED),
    "egm.?(20)?08": ("EGM2008 height", "egm2008", STATED),
    "navd.?88": ("NAVD88 height", "egm96", STATED), "ortho|msl|geoid": ("the sea", "egm96", STATED),
    # as barpc, GeoJSON, ICESat-2 and GEDI define them
    r"^alt(?![a-z])|^h_(?:ph|li|te_best_fit|mean)$|lowestmode": (ELLIPSOID, None, INFERRED),
}  # fmt: skip
_ERRORS = re.compile(
    "sigma|std|stdev|acc|err|resid|d[xyz]$|.*_(error|est|sigma|std|accuracy)$|(image|img)_(width|height)"
)
_IMAGE_WORDS = "image|img|pixel|pix|px|photo|source|raster|im"
_MAP = "utm|map|world|ground|geo|coord|point|proj|gk|l93|lambert|lambert93|terrain|gcp|coordinate"
_LIKE = {
    key: re.compile(pattern)
    for key, pattern in {
        "col": rf"({_IMAGE_WORDS})_?(x|u|col|column|sample)|(x|u|col|column|sample)_?({_IMAGE_WORDS})|u",
        "row": rf"({_IMAGE_WORDS})_?(y|v|row|line)|(y|v|row|line)_?({_IMAGE_WORDS})|v",
        "lon": r"(.+_)?(lon|long|longitude|lng)(_.+)?",
        "lat": r"(.+_)?(lat|latitude)(_.+)?",
        "east": rf"e|(.+_)?(east|eastings?|rechtswert)(_.+)?|({_MAP})_?(x|e)|x_?({_MAP})",
        "north": rf"n|(.+_)?(north|northings?|hochwert)(_.+)?|({_MAP})_?(y|n)|y_?({_MAP})",
        "alt": r"(.+_)?(alt|altitude|height|hgt|ele|elev|elevation|z|h|hae|msl|egm_?(20)?(96|08)|navd_?88)(_.+)?",
        "image": r"(.+_)?(image|img|photo|picture|camera|file|filename)(_(name|file|id|label|path))?",
        "id": r"(gcp|point|pt|marker|target|station)_?(id|name|no|nr|num|number|label)?|fid|no|nr|num|number",
    }.items()
}
"""What columns that nobody lists are taken for: the log says so."""


_BY_CASE = {"X": "map_X", "Y": "map_Y", "Z": "map_Z", "x": "px_x", "y": "px_y"}
_PIXELS = re.compile(r"(?i)^\s*([xyuv])\s*[\[(]\s*(px|pix|pixels?)\s*[\])]\s*$")


def _bare(word: str) -> str:
    """Return a column's name in lower case, words joined by lines, without unit; of X/Longitude the latter."""
    word = _PIXELS.sub(r"px_\1", word)
    name, _, metres = _unit_of(word)
    # accuracies are read in metres alone
    word = re.sub(r"\W", "_", word) if metres != 1.0 and _ERRORS.match(word.lower()) else name
    word = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", word.strip().rpartition("/")[2])
    return re.sub(r"[^\w]+", "_", re.sub(r"[\[(].*", "", word).lower()).strip("_")


_DEGREES = re.compile(
    r"([NSEW])?\s*([+-]?\d{1,3}(?:[.,]\d+)?)\s*(?:[°ºd:]|deg)?\s*(?:(\d{1,2}(?:[.,]\d+)?)\s*(?:['′’m:]|min)?\s*"
    r"(?:(\d{1,2}(?:[.,]\d+)?)\s*(?:[\"″”s]|''|sec)?)?)?\s*([NSEW])?"
)


def degrees(text: str, axis: str) -> float:
    r"""Return a longitude or latitude (`axis` lon or lat), decimal or in degrees, minutes and seconds; or ValueError.

    Examples
    --------
    >>> degrees("43°30'36\"S", "lat"), degrees("W 5 24", "lon"), degrees("694517.1", "lon")
    (-43.51, -5.4, 694517.1)
    """
    if (plain := numbers_of([text])) is not None:
        return plain[0]
    found = _DEGREES.fullmatch(text.strip().replace("−", "-"))
    if found is None:
        raise ValueError(f"{text[:40]!r} is no number, and no degrees, minutes and seconds")
    before, whole, *parts, behind = found.groups("")
    signs = before + behind + "-" * whole.startswith("-")
    numbers = np.array([part.replace(",", ".") for part in (whole.lstrip("+-"), *parts) if part], dtype=np.float64)
    if signs not in ("", "-", *("NS" if axis == "lat" else "EW")):
        raise ValueError(f"{text[:40]!r} is no {axis}")
    if (numbers[1:] >= 60.0).any() or (numbers[:-1] % 1.0).any():
        raise ValueError(f"{text[:40]!r} is no degrees, minutes and seconds")
    value = (numbers / 60.0 ** np.arange(len(numbers))).sum()
    return float(np.round(value, 12)) * (-1.0 if signs in ("-", "S", "W") else 1.0)


def first_words(head: bytes) -> list[str]:
    """Return the words of the first line of a text other than comments."""
    lines = head.decode("utf-8-sig", errors="replace").splitlines()
    first = next((line for line in lines if line.strip() and not line.lstrip().startswith("#")), "")
    return [word.strip().strip('"') for word in re.split(r"[,;\t]|\s+", first.strip()) if word.strip()]


def numbers_of(words: Sequence[str]) -> list[float] | None:
    """Return the words as numbers; None where one is none."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return None


def read_table(
    path: Path,
    names: Names,
    needed: Sequence[str],
    *,
    unnamed: Sequence[str] = (),
    texts: Collection[str] = (),
    blank: Collection[str] = (),
) -> tuple[list[str], dict[str, Any]]:
    """Return the words of a table's first line, and its columns: arrays of numbers, or `Texts`.

    Cells stand between tabs, semicolons (then with decimal commas), commas or blanks, whichever the first line has;
    ``#`` begins a comment. InputError for a line that lacks a number, or a first line without the columns needed.

    Parameters
    ----------
    names, needed : the columns that are read, and those that must be there
    unnamed : the order of columns whose first line is numbers, not names; those beyond `needed` may be missing, what
        comes behind is passed over where all are needed
    texts, blank : columns that are no numbers, and columns whose cells may be blank or missing: lists of numbers and
        None
    """
    with opened_text(path, TABLE) as text:
        number, first = next(
            ((n, line) for n, raw in enumerate(text, 1) for line in _content_lines([raw], texts)), (1, "")
        )
        delimiter = next((sign for sign in "\t;," if sign in first), " ")
        with _line_named(path, number, needed):
            words = row_of(first, delimiter)
            columns = _column_indices(path, words, delimiter, names, needed, unnamed)
        rows = chain([first], text) if _are_numbers(words, delimiter) else text
        return words, _filled(path, rows, number + (rows is text), _GrowingTable(columns, delimiter, texts, blank))


def read_columns(
    path: Path, skipped: int, delimiter: str, columns: dict[str, int], texts: Collection[str], blank: Collection[str]
) -> dict[str, Any]:
    """Return the columns of a table, whose places are known, below the lines that are skipped (see `read_table`)."""
    with opened_text(path, TABLE) as text:
        return _filled(path, islice(text, skipped, None), skipped + 1, _GrowingTable(columns, delimiter, texts, blank))


def _filled(path: Path, rows: Iterator[str], number: int, table: _GrowingTable) -> dict[str, Any]:
    """Return the columns of the lines that begin with the one called `number`, read by batches."""
    while batch := list(islice(rows, _BATCH)):
        try:
            table.add(_content_lines(batch, table.texts))
        except _PARSE_ERRORS:
            for n, raw in enumerate(batch, number):
                with _line_named(path, n, list(table.columns)):
                    table.parsed(_content_lines([raw], table.texts))
            raise
        number += len(batch)
    return table.whole()


_BATCH = 1 << 12  # lines that are parsed at a time: their cells stay in the processor's cache
_PARSE_ERRORS = (ValueError, IndexError, csv.Error)


def _content_lines(lines: Sequence[str], texts: Collection[str]) -> list[str]:
    """Return the lines without comments, which of lines of numbers alone may stand behind these, and empty ones."""
    if not texts:
        lines = [line.partition("#")[0] for line in lines]
    return [line for line in lines if (bare := line.lstrip()) and bare[0] != "#"]


@contextmanager
def _line_named(path: Path, number: int, columns: Sequence[str]) -> Iterator[None]:
    try:
        yield
    except BarpcError:
        raise
    except _PARSE_ERRORS as error:
        said = plain(error)
        cure = "; decimal commas need semicolons or tabs between cells" if re.match(r"'[+-]?\d+,\d+' ", said) else ""
        raise InputError(f"{path}, line {number}: expected {', '.join(columns)} ({said}{cure})") from error


@dataclass(frozen=True, eq=False)
class Texts:
    """A column of texts: those there are in the order of their first rows, and which of them each row (N,) has."""

    different: Sequence[str] | IntArray  # numbers, where all are written as `str` does
    index: IntArray

    @classmethod
    def of(cls, texts: Iterable[str]) -> Texts:
        """Return the column of texts, one a row."""
        known: dict[str, int] = {}
        index = index_texts(texts, known)
        return cls(list(known), index)

    def per_row(self) -> list[str]:
        """Return the text of each row."""
        texts = list(map(str, self.different))
        return texts if len(texts) == len(self.index) else [texts[i] for i in self.index.tolist()]


def index_texts(texts: Iterable[str], known: dict[str, int]) -> IntArray:
    """Return the number of each text, that of its first appearance among all that are `known`, which grows."""
    every, first = list(texts), len(known)
    new = dict(zip(every, range(first, first + len(every)), strict=True))
    if len(new) == len(every) and known.keys().isdisjoint(new.keys()):  # labels, mostly
        known.update(new)
        return np.arange(first, first + len(every))
    for text in new:
        known.setdefault(text, len(known))
    return np.fromiter(map(known.__getitem__, every), np.int64, len(every))


def distinct(rows: Array, *by: Array) -> tuple[IntArray, IntArray]:
    """Return the first of all rows (N, m) that are the same, least in `by` (N,), in their order; and which each is."""
    if (np.diff(rows[:, 0]) > 0.0).all():
        return np.arange(len(rows)), np.arange(len(rows))
    order = np.lexsort((*by, *rows.T[::-1]))
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (np.diff(rows[order], axis=0) != 0).any(axis=1)
    number = np.empty(len(rows), dtype=np.int64)
    number[order] = np.cumsum(new) - 1
    return order[new], number


class _Texts:
    """Texts that come in parts; whole numbers as `str` writes them, labels of most tables, are kept as such."""

    def __init__(self) -> None:
        self._known: dict[str, int] | None = None
        self._parts: list[IntArray] = []

    def append(self, cells: list[str]) -> None:
        part = _as_integers(cells) if self._known is None else None
        if part is None:
            if self._known is None:
                self._known = {}
                self._parts = [index_texts(map(str, part.tolist()), self._known) for part in self._parts]
            part = index_texts(cells, self._known)
        self._parts.append(part)

    def column(self) -> Texts:
        index = np.concatenate([np.zeros(0, dtype=np.int64), *self._parts])
        if self._known is not None:
            return Texts([from_cell(cell) if cell[:1] == "'" else cell for cell in self._known], index)
        values, first, inverse = np.unique(index, return_index=True, return_inverse=True)
        order = np.argsort(first)
        return Texts(values[order], np.argsort(order)[inverse.ravel()])


def _as_integers(cells: list[str]) -> IntArray | None:
    """Return texts as the numbers (N,) that they are; None unless all are written as `str` does."""
    joined = "".join(cells)
    if not (all(cells) and joined.isascii() and joined.isdecimal()) or max(map(len, cells)) > MAX_DIGITS:
        return None
    values = np.array(cells, dtype=np.int64)
    digits = len(values) + sum(np.count_nonzero(values >= 10**n) for n in range(1, MAX_DIGITS))
    return values if digits == len(joined) else None


class _GrowingTable:
    """Columns that grow by batches of lines."""

    def __init__(self, columns: dict[str, int], delimiter: str, texts: Collection[str], blank: Collection[str]) -> None:
        self.columns, self._delimiter, self.texts, self._blank = columns, delimiter, texts, blank
        self._parts = {name: _Texts() if name in texts else list[Any]() for name in columns}

    def add(self, lines: Sequence[str]) -> None:
        for name, part in self.parsed(lines).items() if lines else ():
            self._parts[name].append(part)

    def parsed(self, lines: Sequence[str]) -> dict[str, Any]:
        """Return the cells of each column: texts, numbers, or, where they may be blank, numbers and None."""
        sign, text = self._delimiter, "".join(lines)
        found = self._all_numbers(lines, text)
        most = -1 if not found else max((self.columns[name] for name in self.texts), default=0) + 1
        plain = sign != " "  # split at once; what is left of blanks does no harm to numbers
        rows = [line.split(sign, most) if plain and '"' not in line else row_of(line, sign) for line in lines]
        for name, place in self.columns.items():
            if name in self.texts:
                cells = [row[place] for row in rows]
                if "\n" in "".join(cells):
                    cells = [cell.rstrip("\r\n") for cell in cells]
                if " " in text:  # a blank before a name in quotes is its own
                    cells = [c if '"' in line else c.lstrip(" ") for c, line in zip(cells, lines, strict=True)]
                found[name] = cells
            elif name not in found:
                cells = [row[place] if place < len(row) or name not in self._blank else "" for row in rows]
                found[name] = _numeric(
                    [_pointed(cell, sign) for cell in cells] if sign in ";\t" else cells, name, name in self._blank
                )
        return found

    def _all_numbers(self, lines: Sequence[str], text: str) -> dict[str, Any]:
        """Return the columns of numbers, where every cell is one as numpy reads them at once; else nothing."""
        names = [name for name in self.columns if name not in self.texts]
        if not (names and lines) or any(mark in text for mark in _SLOW_MARKS[self._delimiter]):
            return {}
        where, sign = [self.columns[name] for name in names], self._delimiter.strip(" ") or None
        try:
            table = np.loadtxt(lines, delimiter=sign, usecols=where, comments=None, ndmin=2)
        except ValueError:
            return {}
        return dict(zip(names, table.T.copy(), strict=True))

    def whole(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name in self.columns:
            parts = self._parts.pop(name)
            if isinstance(parts, _Texts):
                found[name] = parts.column()
            else:
                some_blank = any(isinstance(part, list) for part in parts)
                found[name] = list(chain.from_iterable(parts)) if some_blank else np.concatenate([[], *parts])
        return found


_SLOW_MARKS = {",": '"', ";": '",', "\t": '",', " ": '"\t'}
"""Delimiter -> what takes more than one: cells in quotes, decimal commas."""


def _pointed(cell: str, delimiter: str) -> str:
    return cell.replace(",", ".") if delimiter in ";\t" else cell


def _numeric(cells: list[str], name: str, blank: bool = False) -> Array | list[float | None]:
    """Return cells as numbers; a list with None where some are blank."""
    try:
        return np.fromiter(map(float, cells), np.float64, len(cells))
    except ValueError:
        if blank:
            return [float(cell) if (cell := one.strip()) else None for one in cells]
        if name not in ("lon", "lat"):
            raise
        return np.array([degrees(cell, name) for cell in cells])


def row_of(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line, those that are empty too unless blanks part them."""
    line = line.rstrip("\r\n")
    if '"' in line:
        row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    else:
        row = [cell.lstrip(" ") for cell in line.split(delimiter)]
    return [cell for cell in row if delimiter != " " or cell]


def _are_numbers(words: Sequence[str], delimiter: str) -> bool:
    return numbers_of([_pointed(word, delimiter) for word in words]) is not None


def _column_indices(
    path: Path, words: Sequence[str], delimiter: str, names: Names, needed: Sequence[str], unnamed: Sequence[str]
) -> dict[str, int]:
    """Return the column of each quantity by the first line: its names, or the order of numbers."""
    most = len(words) if len(unnamed) == len(needed) else len(unnamed)
    if unnamed and len(needed) <= len(words) <= most and _are_numbers(words, delimiter):
        return dict(zip(unnamed, range(len(words)), strict=False))
    found = header_of(words, names)
    if not set(needed) <= set(found):
        raise lacking(path, [name for name in needed if name not in found], words)
    return found


def lacking(path: Path, names: Sequence[str], words: Sequence[str]) -> InputError:
    """Return the error of a table without columns that are needed."""
    return InputError(f"{path}: no column {', '.join(names)} among the {len(words)} of its first line")


# --- motions ----------------------------------------------------------------------------------------------

_ROUNDED = 2e-6
"""Largest error of the squares of a rotation's rows where each number has the six decimals of `%f`."""
_WANTED = "expected three or four lines of four numbers: a rotation (with a scale) and a translation [m], ECEF"
_BLANKS = str.maketrans(",;[]()", "      ")


def read_transform(path: Path | str) -> Array:
    """Read the matrix (3, 4) of a motion of the ground, ECEF [m]: a rotation times a scale, a translation.

    Lines of four numbers between blanks, commas or semicolons, perhaps in brackets, three of them or, with the last
    line 0 0 0 1, four: what pc_align of the Ames Stereo Pipeline, CloudCompare and PDAL write. InputError for anything
    else, one line that says what was found.
    """
    lines = [raw.partition("#")[0].translate(_BLANKS).split() for raw in read_text(path, OPTIONS).splitlines()]
    rows = [words for words in lines if words]
    for word in (word for words in rows for word in words):
        value = numbers_of([word])
        if value is None or not abs(value[0]) <= MAX_NUMBER:
            raise InputError(f"{path}: {word[:40]!r} is no finite number; {_WANTED}")
    shape = len(rows), *sorted({len(row) for row in rows})
    if shape == (4, 3):
        raise InputError(f"{path}: four lines of three numbers, a transposed matrix? {_WANTED}")
    if shape not in ((4, 4), (3, 4), (1, 16), (1, 12)):  # or row after row in one line
        counts = f"{len(rows)} lines of {' or '.join(map(str, shape[1:4])) or 'no'} numbers"
        raise InputError(f"{path}: {counts}; {_WANTED}")
    matrix = np.array(rows, dtype=np.float64).reshape(-1, 4)
    if reason := _no_motion(matrix):
        raise InputError(f"{path}: {reason}")
    return matrix[:3]


def _no_motion(matrix: Array) -> str:
    """Return why a matrix moves no ground; empty where it does."""
    if len(matrix) == 4 and not np.array_equal(matrix[3], [0, 0, 0, 1]):
        turned = np.array_equal(matrix[:, 3], [0, 0, 0, 1])
        what = "the matrix is transposed" if turned else "the matrix is no motion"
        return f"its last line is {' '.join(f'{value:g}' for value in matrix[3])} and not 0 0 0 1: {what}"
    square = matrix[:3, :3] @ matrix[:3, :3].T
    scale = float(np.trace(square)) / 3.0
    off = float(np.abs(square / scale - np.eye(3)).max()) if scale > 0 else np.inf
    if not off <= _ROUNDED:
        return (
            f"its first three columns are no rotation times a scale (deviation {off:.2g}): a matrix of map "
            "coordinates or of longitudes and latitudes, or one that shears? A motion of ECEF coordinates is needed"
        )
    return "its first three columns mirror the ground" if np.linalg.det(matrix[:3, :3]) < 0 else ""
