"""Motions of the ground: a matrix as pc_align of the Ames Stereo Pipeline, CloudCompare and PDAL write it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from barpc.base.errors import InputError
from barpc.base.geodesy import Array
from barpc.base.safe_io import MAX_NUMBER, OPTIONS, read_text
from barpc.pointio.tables import numbers_of

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
