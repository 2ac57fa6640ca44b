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
from barpc.base.geodesy import Array
from barpc.base.safe_io import MAX_DIGITS, TABLE, opened_text
from barpc.pointio.names import from_cell
from barpc.scene import IntArray

GROUND_SIGMA = 1.0  # standard deviation [m] along an axis of a GCP, or of the place of a height, whose file states none
IMAGE_SIGMA = 0.5  # standard deviation of each image coordinate [px], of GCPs and tie points whose file states none

Names = Mapping[str, Sequence[str]]
"""Quantity -> names that files give its column."""
_XY_PAIRS = ("lon", "lat"), ("col", "row")
"""Meanings of columns x and y: the pair for which the file has no other columns."""


def header_of(words: Sequence[str], names: Names) -> dict[str, int]:
    """Return the column index of each quantity that a header gives a listed name, or x and y (`_XY_PAIRS`)."""
    lower = [normalised_word(word) for word in words]
    hits = {key: [lower.index(a) for a in aliases if a in lower] for key, aliases in names.items()}
    found = {key: places[0] for key, places in hits.items() if places}
    left = [pair for pair in _XY_PAIRS if set(pair) <= set(names) and not set(pair) <= set(found)]
    if len(left) == 1:
        either = {key: lower.index(word) for key, word in zip(left[0], "xy", strict=True) if word in lower}
        found = {**either, **found}
    return found


def normalised_word(word: str) -> str:
    """Return a name in lower case, with _ for blanks, without anything in brackets."""
    return re.sub(r"[\[(].*", "", word.lower()).strip().replace(" ", "_")


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
