"""Transformations of the ground: matrices that pc_align of the Ames Stereo Pipeline, CloudCompare and PDAL write."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from barpc.base.errors import InputError
from barpc.base.geodesy import Array
from barpc.base.safe_io import MAX_NUMBER, OPTIONS, read_text
from barpc.pointio.tables import numbers_of

_ROUNDING_ERROR = 2e-6
"""Largest deviation of R R^T from the identity for a rotation R that is written with the six decimals of `%f`."""


_WANTED = "expected three or four lines of four numbers: a rotation (with a scale) and a translation [m], ECEF"


_BLANKS = str.maketrans(",;[]()", "      ")


def read_transform(path: Path | str) -> Array:
    """Read a similarity transformation of the ground: scaled rotation and translation (3, 4), ECEF [m].

    The file has three lines of four numbers, or a fourth line 0 0 0 1, or the same in one line, row by row. Blanks,
    commas or semicolons separate the numbers; brackets and comments after # are ignored. InputError for anything else.
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
    if shape not in ((4, 4), (3, 4), (1, 16), (1, 12)):  # 16, 12: one line
        counts = f"{len(rows)} lines of {' or '.join(map(str, shape[1:4])) or 'no'} numbers"
        raise InputError(f"{path}: {counts}; {_WANTED}")
    matrix = np.array(rows, dtype=np.float64).reshape(-1, 4)
    if reason := _why_no_similarity(matrix):
        raise InputError(f"{path}: {reason}")
    return matrix[:3]


def _why_no_similarity(matrix: Array) -> str:
    """Return why a matrix is not a scaled rotation and a translation; empty if it is."""
    if len(matrix) == 4 and not np.array_equal(matrix[3], [0, 0, 0, 1]):
        turned = np.array_equal(matrix[:, 3], [0, 0, 0, 1])
        what = "the matrix is transposed" if turned else "the matrix is no motion"
        return f"its last line is {' '.join(f'{value:g}' for value in matrix[3])} and not 0 0 0 1: {what}"
    square = matrix[:3, :3] @ matrix[:3, :3].T
    scale = float(np.trace(square)) / 3.0
    off = float(np.abs(square / scale - np.eye(3)).max()) if scale > 0 else np.inf
    if not off <= _ROUNDING_ERROR:
        return (
            f"its first three columns are no rotation times a scale (deviation {off:.2g}): a matrix of map "
            "coordinates or of longitudes and latitudes, or one that shears? A motion of ECEF coordinates is needed"
        )
    return "its first three columns mirror the ground" if np.linalg.det(matrix[:3, :3]) < 0 else ""
