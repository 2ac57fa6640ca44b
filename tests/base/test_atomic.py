"""Files are written whole or not at all."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from barpc.base.atomic import replacing, write_text
from barpc.base.errors import OutputError


def test_a_block_that_fails_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), replacing(path, overwrite=True) as partial:
        partial.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_an_existing_file_is_refused_before_anything_is_written(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(OutputError, match=r"a\.txt: exists already"):
        write_text(path, "new")
    write_text(path, "new", overwrite=True)
    assert path.read_text() == "new"


def test_folders_are_made_and_line_ends_stay(tmp_path):
    write_text(tmp_path / "x" / "y" / "a.txt", "a\nb\r\n")
    assert (tmp_path / "x" / "y" / "a.txt").read_bytes() == b"a\nb\r\n"


def test_a_folder_that_cannot_be_written_is_an_error_in_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write_text(tmp_path / "file" / "a", "")


def test_the_temporary_name_keeps_the_suffix(tmp_path):
    with replacing(tmp_path / "scene_RPC.TXT") as partial:
        assert partial.name.endswith("scene_RPC.TXT")
        partial.write_text("x")


_WRITER = """
import sys
from barpc.base.atomic import write_text
while True:
    for fill in ("a", "b"):
        write_text(sys.argv[1], fill * 3_000_000, overwrite=True)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL here")
def test_a_killed_writer_never_leaves_half_a_file(tmp_path):
    path = tmp_path / "big.bin"
    for trial in range(6):
        writer = subprocess.Popen([sys.executable, "-c", _WRITER, str(path)], env=_environment())
        deadline = time.monotonic() + 600
        while not path.exists() and time.monotonic() < deadline:
            time.sleep(0.005)
        time.sleep(0.004 * trial)
        writer.kill()
        writer.wait()
        data = path.read_bytes()
        assert data in (b"a" * 3_000_000, b"b" * 3_000_000)
    for left in tmp_path.glob(".barpc-partial-*"):
        shutil.rmtree(left)
    assert list(tmp_path.iterdir()) == [path]


def _environment() -> dict[str, str]:
    root = Path(__file__).resolve().parents[2]
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])}
