"""Matrices of other tools: the syntaxes that are read, and what is refused in one line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barpc.base.errors import InputError
from barpc.pointio.motions import read_transform
from tests.pointio.conftest import refused

MATRIX = np.eye(4)
MATRIX[:3, :3] = 1.000003 * Rotation.from_rotvec([1e-4, -2e-4, 5e-5]).as_matrix()
MATRIX[:3, 3] = [812.5, -33.25, 401.0]


def written(matrix, form="%.17g", between=" "):
    return "\n".join(between.join(form % value for value in row) for row in np.atleast_2d(matrix)) + "\n"


@pytest.mark.parametrize(
    "text",
    [
        written(MATRIX),
        written(MATRIX, "%25.17e", "\t"),
        written(MATRIX[:3], between=", "),
        written(MATRIX.reshape(1, 16)),
        written(MATRIX[:3].reshape(1, 12)),
        "# from a tool\r\n\r\n" + written(MATRIX).replace("\n", "\r\n"),
        "[[" + written(MATRIX, between=", ").strip().replace("\n", "],\n[") + "]]",
    ],
)
def test_what_tools_write_is_one_matrix(tmp_path: Path, text):
    file = tmp_path / "t.txt"
    file.write_text(text)
    np.testing.assert_array_equal(read_transform(file), MATRIX[:3])


def test_six_decimals_are_enough_and_four_are_not(tmp_path: Path):
    file = tmp_path / "t.txt"
    file.write_text(written(MATRIX, "%.6f"))
    np.testing.assert_allclose(read_transform(file), MATRIX[:3], rtol=0, atol=5.1e-7)
    file.write_text(written(MATRIX, "%.4f"))
    with pytest.raises(InputError, match="no rotation"):
        read_transform(file)


MIRRORED, SHEARED, FLAT, PERSPECTIVE = MATRIX.copy(), MATRIX.copy(), MATRIX.copy(), MATRIX.copy()
MIRRORED[:3, :3] *= -1
SHEARED[0, 1] += 1e-4
FLAT[:3, :3] = 0
PERSPECTIVE[3, 3] = 2.0


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (written(MATRIX.T), "0 0 0 1: the matrix is transposed"),
        (written(MATRIX[:3].T), "transposed matrix"),
        (written(PERSPECTIVE), "the matrix is no motion"),
        (written(MIRRORED), "mirror"),
        (written(SHEARED), "no rotation"),
        (written(FLAT), "no rotation"),
        ("1 0 0 5\n0 1 0 6\n0 0 1 nan\n0 0 0 1\n", "'nan' is no finite number"),
        ("1 0 0 5\n0 1 0 6\n0 0 1 1e200\n0 0 0 1\n", "'1e200' is no finite number"),
        ("lon lat alt sigma\n5.4 43.3 100 1\n", "'lon' is no finite number"),
        ("5.40 43.30 100 1\n5.41 43.30 100 1\n5.41 43.31 120 1\n", "no rotation"),
        ("1 0 0\n0 1 0\n0 0 1\n", "3 lines of 3 numbers"),
        ("1 0 0 5\n0 1 0\n0 0 1 7\n", "3 lines of 3 or 4 numbers"),
        ("1 2 3\n", "1 lines of 3 numbers"),
        ("", "0 lines of no numbers"),
        ("1 0 0 0\n" * 4000, "4000 lines"),
    ],
)
def test_what_is_no_motion_is_refused_in_one_line(tmp_path: Path, text, told):
    file = tmp_path / "t.txt"
    file.write_text(text)
    refused(read_transform, file, re.escape(told))


def test_what_is_no_text_is_refused(tmp_path: Path):
    file = tmp_path / "t.txt"
    file.write_bytes(b"\xff\xfe\x00\x01" * 20)
    with pytest.raises(InputError, match=r"t\.txt"):
        read_transform(file)
    with pytest.raises(InputError, match="folder"):
        read_transform(tmp_path)
