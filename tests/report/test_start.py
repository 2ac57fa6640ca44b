"""What a reading verb loads: the records of a run, and neither the adjustment nor the matcher."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from barpc.base.options import RunOptions
from barpc.verbs.runs import adjust
from tests.reliability.trials import SAMPLES, crop

COUNT = """
import atexit, sys
from barpc.cli import main
atexit.register(lambda: print(*sorted(sys.modules), file=sys.stderr, sep="\\n"))
main()
"""
SOLVER = {"barpc.ba", "barpc.tie", "barpc.fit.refit", "cv2", "scipy.optimize", "scipy.sparse"}


def loaded(*words: object) -> set[str]:
    """Modules of a process of its own that runs a verb."""
    environment = os.environ | {"PYTHONWARNINGS": "ignore"}
    command = [sys.executable, "-c", COUNT, "-q", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return set(done.stderr.split("\n"))


def ours(modules: set[str]) -> int:
    return sum(name.split(".")[0] == "barpc" for name in modules)


def test_the_report_of_a_run_is_made_without_what_measured_it(block_run) -> None:
    modules = loaded("report", block_run.folder, block_run.folder)
    assert not modules & SOLVER
    assert ours(modules) <= 60


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("start")
    images = [crop(source, folder / source.name) for source in SAMPLES[:2]]
    adjust(images, folder / "run", RunOptions())
    return folder / "run"


@pytest.mark.landing(3)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "most"),
    [
        (["verify", "{run}"], 60),
        (["report", "{run}"], 58),
        (["report", "{run}", "{run}"], 60),
        (["export", "{run}", "{out}", "--to", "s2p"], 75),
        (["export", "{run}", "{out}", "--to", "points"], 75),
        (["info", "{run}/view_00.vrt", "{run}/view_01.vrt"], 66),
        (["info", "{run}/view_00_RPC.TXT"], 56),
        (["project", "{run}/view_00_RPC.TXT", "5.4", "43.3", "100"], 49),
        (["localize", "{run}/view_00_RPC.TXT", "10", "10", "--alt", "100"], 49),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else None,
)
def test_a_reading_verb_loads_no_solver(run, tmp_path, words: list[str], most: int) -> None:
    modules = loaded(*(word.format(run=run, out=tmp_path / "out") for word in words))
    assert not modules & SOLVER
    assert ours(modules) <= most
    assert words != ["report", "{run}"] or "rasterio" not in modules  # no image is opened
