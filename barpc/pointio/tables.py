"""Text tables of numbers: points by the names of their columns, whoever wrote them, and motions of the ground."""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from barpc.base.errors import InputError
from barpc.base.geodesy import Array
from barpc.base.sidefile import LARGEST, OPTIONS, TABLE, opened_text, read_text
from barpc.pointio.names import from_cell

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


def read_table(
    path: Path,
    names: Names,
    needed: Sequence[str],
    *,
    unnamed: Sequence[str] = (),
    texts: Collection[str] = (),
    blank: Collection[str] = (),
) -> tuple[list[str], dict[str, list[Any]]]:
    """Return the words of a table's first line, and its columns: numbers, None where a cell is blank, or texts.

    Cells stand between tabs, semicolons (then with decimal commas), commas or blanks, whichever the first line has;
    ``#`` begins a comment. InputError for a line that lacks a number, or a first line without the columns needed.

    Parameters
    ----------
    names, needed : the columns that are read, and those that must be there
    unnamed : the order of columns whose first line is numbers, not names; those beyond `needed` may be missing, what
        comes behind is passed over where all are needed
    texts, blank : columns that are no numbers, and columns whose cells may be blank or missing
    """
    words, delimiter = list[str](), ","
    columns, found = dict[str, int](), dict[str, list[Any]]()
    with opened_text(path, TABLE) as lines:
        for number, raw in enumerate(lines, start=1):
            line = raw if texts else raw.partition("#")[0]
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            try:
                if first := not columns:
                    delimiter = next((sign for sign in "\t;," if sign in line), " ")
                cells = _cells(line, delimiter)
                if first:
                    words = cells
                    columns = _columns(path, words, delimiter, names, needed, unnamed)
                    found = {name: [] for name in columns}
                if not first or _numbers(words, delimiter):
                    for name, place in columns.items():
                        text = cells[place] if place < len(cells) or name not in blank else ""
                        found[name].append(
                            from_cell(text) if name in texts else _number(text, delimiter, name in blank)
                        )
            except (ValueError, IndexError, csv.Error) as error:
                raise InputError(f"{path}, line {number}: expected {', '.join(columns or needed)} ({error})") from error
    if not columns:
        raise _lacking(path, needed, words)
    return words, found


def _cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line, those that are empty too unless blanks part them."""
    line = line.rstrip("\r\n")
    if '"' in line:
        row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    else:
        row = [cell.lstrip(" ") for cell in line.split(delimiter)]
    return [cell for cell in row if delimiter != " " or cell]


def _number(cell: str, delimiter: str, blank: bool) -> float | None:
    if blank and not cell.strip():
        return None
    return float(cell.replace(",", ".") if delimiter == ";" else cell)


def _numbers(words: Sequence[str], delimiter: str) -> bool:
    return numbers_of([word.replace(",", ".") if delimiter == ";" else word for word in words]) is not None


def _columns(
    path: Path, words: Sequence[str], delimiter: str, names: Names, needed: Sequence[str], unnamed: Sequence[str]
) -> dict[str, int]:
    """Return the column of each quantity by the first line: its names, or the order of numbers."""
    most = len(words) if len(unnamed) == len(needed) else len(unnamed)
    if unnamed and len(needed) <= len(words) <= most and _numbers(words, delimiter):
        return dict(zip(unnamed, range(len(words)), strict=False))
    found = header_of(words, names)
    if not set(needed) <= set(found):
        raise _lacking(path, [name for name in needed if name not in found], words)
    return found


def _lacking(path: Path, names: Sequence[str], words: Sequence[str]) -> InputError:
    return InputError(f"{path}: no column {', '.join(names)} among the {len(words)} of its first line")


def header_of(words: Sequence[str], names: Names) -> dict[str, int]:
    """Return the column of each quantity that a header names."""
    lower = [re.sub(r"[\[(].*", "", word.lower()).strip().replace(" ", "_") for word in words]
    hits = {key: [lower.index(a) for a in aliases if a in lower] for key, aliases in names.items()}
    found = {key: places[0] for key, places in hits.items() if places}
    left = [pair for pair in _EITHER if set(pair) <= set(names) and not set(pair) <= set(found)]
    if len(left) == 1:
        either = {key: lower.index(word) for key, word in zip(left[0], "xy", strict=True) if word in lower}
        found = {**either, **found}
    return found


def first_words(head: bytes) -> list[str]:
    """Return the words of the first line of a text that is no comment, as it begins."""
    lines = head.decode("utf-8-sig", errors="replace").splitlines()
    first = next((line for line in lines if line.strip() and not line.lstrip().startswith("#")), "")
    return [word.strip().strip('"') for word in re.split(r"[,;\t]|\s+", first.strip()) if word.strip()]


def numbers_of(words: Sequence[str]) -> list[float] | None:
    """Return the words as numbers; None where one is none."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return None


# --- motions ----------------------------------------------------------------------------------------------

_ROUNDED = 2e-6
"""What the squares of a rotation's rows are off by at most where each number has the six decimals that `%f` writes."""
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
        if value is None or not abs(value[0]) <= LARGEST:
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
            f"its first three columns are no rotation times a scale (off by {off:.2g}): a matrix of map "
            "coordinates or of longitudes and latitudes, or one that shears? A motion of ECEF coordinates is needed"
        )
    return "its first three columns mirror the ground" if np.linalg.det(matrix[:3, :3]) < 0 else ""
