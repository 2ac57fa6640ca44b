"""The number of threads of a BLAS changes no byte of what is signed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from barpc.base.process import _switches, one_blas_thread
from barpc.verbs.workers import THREADS
from tests.pipeline.known import FOLDER, SAMPLES

RUN = "import numpy, sys, barpc; barpc.adjust(sys.argv[3:], sys.argv[1], gcp=sys.argv[2])"
COMMAND = (
    "import sys; from barpc.cli import main; main(['adjust', *sys.argv[3:], '-o', sys.argv[1], '--gcp', sys.argv[2]])"
)


@pytest.mark.skipif(not list(_switches()), reason="no OpenBLAS that is told its number of threads")
def test_blas_is_held_to_one_thread_and_given_back() -> None:
    for _, keep in _switches():
        keep(3)
    with one_blas_thread():
        assert {read() for read, _ in _switches()} == {1}
    assert {read() for read, _ in _switches()} == {3}
    with pytest.raises(KeyError), one_blas_thread():
        raise KeyError
    assert {read() for read, _ in _switches()} == {3}
    for _, keep in _switches():
        keep(1)


@pytest.mark.nightly
@pytest.mark.skipif(sys.platform != "linux", reason="the libraries of a process are told by /proc")
@pytest.mark.parametrize("code", [RUN, COMMAND], ids=["Python", "command"])
def test_the_threads_of_a_blas_change_no_byte(code: str, tmp_path: Path) -> None:
    words = [str(FOLDER / "gcps.geojson"), *map(str, SAMPLES)]
    sums = []
    for count in ("1", "4"):
        where = {**os.environ, **dict.fromkeys(THREADS, count)}
        out = tmp_path / count / "out"
        command = [sys.executable, "-W", "ignore", "-c", code, str(out), *words]
        done = subprocess.run(
            command, env=where, cwd=FOLDER.parent, capture_output=True, text=True, check=False, timeout=300
        )
        assert done.returncode == 0, done.stderr
        sums.append((out / "SHA256SUMS").read_text())
    assert sums[0] == sums[1]
