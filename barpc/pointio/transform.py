"""Motions of the ground that other tools found: matrices of ECEF coordinates, as text."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from barpc.errors import InputError
from barpc.geodesy import Array
from barpc.sidefile import LARGEST, OPTIONS, read_text

_ROUNDED = 2e-6
"""What the squares of a rotation's rows are off by at most where each number has the six decimals that `%f` writes."""
_WANTED = "expected three or four lines of four numbers: a rotation (with a scale) and a translation [m], ECEF"


def read_transform(path: Path | str) -> Array:
    """Read the matrix (3, 4) of a motion of the ground, ECEF [m]: a rotation times a scale, a translation.

    Lines of four numbers between blanks, commas or semicolons, perhaps in brackets, three of them or, with the last
    line 0 0 0 1, four: what pc_align of the Ames Stereo Pipeline, CloudCompare and PDAL write. InputError for anything
    else, one line that says what was found.
    """
    rows = []
    for raw in read_text(path, OPTIONS).splitlines():
        words = raw.partition("#")[0].translate(_BLANKS).split()
        if words:
            rows.append([_number(path, word) for word in words])
    shape = len(rows), *sorted({len(row) for row in rows})
    if shape == (1, 16) or shape == (1, 12):  # row after row in one line
        rows = np.reshape(rows, (-1, 4)).tolist()
    elif shape == (4, 3):
        raise InputError(f"{path}: four lines of three numbers, a transposed matrix? {_WANTED}")
    elif shape not in ((4, 4), (3, 4)):
        counts = f"{len(rows)} lines of {' or '.join(map(str, shape[1:4])) or 'no'} numbers"
        raise InputError(f"{path}: {counts}; {_WANTED}")
    return _checked(path, np.array(rows))


_BLANKS = str.maketrans(",;[]()", "      ")


def _number(path: Path | str, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not abs(value) <= LARGEST:
        raise InputError(f"{path}: {word[:40]!r} is no finite number; {_WANTED}")
    return value


def _checked(path: Path | str, matrix: Array) -> Array:
    if len(matrix) == 4 and not np.array_equal(matrix[3], [0, 0, 0, 1]):
        turned = np.array_equal(matrix[:, 3], [0, 0, 0, 1])
        what = "the matrix is transposed" if turned else "the matrix is no motion"
        raise InputError(f"{path}: its last line is {_told(matrix[3])} and not 0 0 0 1: {what}")
    square = matrix[:3, :3] @ matrix[:3, :3].T
    scale = float(np.trace(square)) / 3.0
    off = float(np.abs(square / scale - np.eye(3)).max()) if scale > 0 else np.inf
    if not off <= _ROUNDED:
        raise InputError(
            f"{path}: its first three columns are no rotation times a scale (off by {off:.2g}): a matrix of map "
            "coordinates or of longitudes and latitudes, or one that shears? A motion of ECEF coordinates is needed"
        )
    if np.linalg.det(matrix[:3, :3]) < 0:
        raise InputError(f"{path}: its first three columns mirror the ground")
    return matrix[:3]


def _told(row: Array) -> str:
    return " ".join(f"{value:g}" for value in row)
