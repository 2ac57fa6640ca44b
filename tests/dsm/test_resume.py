"""A surface that was killed: the same command goes on, does no tile twice, and gives the same bytes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from barpc.base.options import RunOptions
from barpc.base.verb_options import DsmOptions
from barpc.dsm.surface import make_dsm
from barpc.pipeline import adjust
from barpc.report.runfiles import SURFACE
from tests.cli.test_main import run
from tests.dsm.conftest import ALTS
from tests.lanes import rest_slow

FINE = DsmOptions(alt=ALTS, gsd=0.25)  # four tiles
pytestmark = pytest.mark.slow


def kept(folder: Path) -> dict[Path, int]:
    """The results of tiles, and when each was written [ns]."""
    found = {}
    with suppress(FileNotFoundError):  # a command that ends clears up meanwhile
        for path in folder.rglob("*.unfinished/.barpc/cache/surface_tile/*.npz"):
            found[path] = path.stat().st_mtime_ns
    return found


def killed(call: list[str], when) -> bool:
    """Run a command and kill it as soon as `when` holds; whether it was in time."""
    work = subprocess.Popen([sys.executable, "-m", "barpc", "-q", *call])
    try:
        while work.poll() is None and not when():
            time.sleep(0.002)
    finally:
        if work.poll() is None:
            os.kill(work.pid, signal.SIGKILL)
        work.wait()
    return work.returncode == -signal.SIGKILL


@pytest.mark.nightly
@pytest.mark.parametrize("times", rest_slow([(0, 2), (0, 1, 2, 4)], mark=pytest.mark.nightly))
def test_a_killed_command_goes_on_and_gives_the_same_bytes(rendered, tmp_path, times):
    whole = tmp_path / "whole" / "dsm.tif"
    make_dsm(rendered.paths[:2], whole, FINE)
    folder = tmp_path / "again"
    options = ["--gsd", "0.25", "--alt", *map(str, ALTS)]
    call = ["dsm", *rendered.paths[:2], "-o", str(folder / "dsm.tif"), *options]
    rng, before = np.random.default_rng(int.from_bytes(os.urandom(4))), dict[Path, int]()
    for tiles in times:
        waits = rng.uniform(0.0, 0.3)
        since: list[float] = []

        def now(tiles=tiles, waits=waits, since=since):
            if len(kept(folder)) >= tiles and (folder / "dsm.tif.unfinished").exists():
                since.append(time.monotonic())
            return since and time.monotonic() > since[0] + waits

        in_time = killed(call, now)
        if not in_time:
            break
        found = kept(folder)
        assert before.items() <= found.items()  # nothing was done again
        assert sorted(path.name for path in folder.iterdir()) in (
            ["dsm.tif.unfinished"],
            ["dsm.tif", "dsm.tif.unfinished"],
        )
        before = found
    if not (folder / "dsm.tif").exists():
        assert run("-q", *call) == 0
    assert (folder / "dsm.tif").read_bytes() == whole.read_bytes()


@pytest.mark.nightly
def test_a_finished_run_whose_surface_was_killed_stays_finished(rendered, tmp_path, capsys):
    folder = tmp_path / "run"
    adjust(rendered.paths[:2], folder)
    page = (folder / "report.html").read_bytes()
    call = ["dsm", str(folder), "-o", str(folder / "dsm.tif")]
    assert killed(call, (folder / "dsm.tif.unfinished").exists)
    assert not (folder / "dsm.tif").exists()
    assert (folder / "report.html").read_bytes() == page
    assert run("-q", "adjust", *rendered.paths[1:], "-o", folder) == 1
    assert "exists and is not empty; give --overwrite" in capsys.readouterr().err
    assert run("-q", *call) == 0
    assert not (folder / "dsm.tif.unfinished").exists()
    # another run in the same folder does not show it
    old = (folder / "tables" / SURFACE).read_bytes()
    adjust(rendered.paths[1:], folder, RunOptions(overwrite=True))
    assert "Which ground do they reconstruct?" not in (folder / "report.html").read_text(encoding="utf-8")
    (folder / "tables" / SURFACE).write_bytes(old)
    assert run("-q", "report", folder) == 1
    assert "was changed since the run wrote it" in capsys.readouterr().err
