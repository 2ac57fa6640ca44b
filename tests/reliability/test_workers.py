"""The bytes do not depend on who does the work: one process, several, a cluster, one that loses a worker."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.lanes import rest_slow

from .conftest import barpc
from .trials import SAMPLES, crop, outputs

TILES = "[tie]\ntile = 128\n"  # more tasks than workers


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """A folder of three images and options that cut them into many tasks."""
    folder = tmp_path_factory.mktemp("scene")
    for path in SAMPLES:
        crop(path, folder / path.name, side=200, start=300)
    (folder / "run.toml").write_text(TILES)
    return folder


def command(scene: Path, out: str, *more: object) -> list[object]:
    images = sorted(scene.glob("*.tif"))
    return ["adjust", *images, "--options", scene / "run.toml", "-o", scene / out, *more]


@pytest.fixture(scope="module")
def alone(scene) -> dict[str, bytes]:
    """What one process gives."""
    assert barpc(*command(scene, "alone")).code == 0
    return outputs(scene / "alone")


@pytest.mark.nightly
def test_a_rerun_gives_the_same_bytes(scene, alone):
    assert barpc(*command(scene, "again")).code == 0
    assert outputs(scene / "again") == alone


@pytest.mark.costs(3)
@pytest.mark.slow
@pytest.mark.parametrize("jobs", rest_slow([2, 4], mark=pytest.mark.nightly))
def test_any_number_of_workers_gives_the_same_bytes(scene, alone, jobs):
    assert barpc(*command(scene, f"workers_{jobs}", "-j", jobs)).code == 0
    assert outputs(scene / f"workers_{jobs}") == alone
    assert not (scene / f"workers_{jobs}/.barpc/cache/arrays").exists()


# -- a cluster ----------------------------------------------------------------------------------------


@pytest.fixture
def cluster(tmp_path):
    """Address of a dask scheduler on this machine, and the processes of its two workers."""
    pytest.importorskip("distributed")
    folder = tmp_path / "dask"
    folder.mkdir()
    where = {**os.environ, "DASK_TEMPORARY_DIRECTORY": str(folder), "OMP_NUM_THREADS": "1"}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "env": where, "cwd": folder}
    program = [sys.executable, "-m"]
    scheduler = subprocess.Popen(
        [*program, "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"], **quiet
    )
    address = None
    for line in scheduler.stderr:
        if found := re.search(r"tcp://127\.0\.0\.1:\d+", line):
            address = found[0]
            break
    workers = [
        subprocess.Popen(
            [*program, "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"],
            **(quiet | {"stderr": subprocess.DEVNULL}),
        )
        for _ in range(2)
    ]
    yield address, workers
    for process in (*workers, scheduler):
        process.kill()
        process.communicate()


@pytest.mark.nightly
def test_a_cluster_gives_the_same_bytes_also_when_it_loses_a_worker(scene, alone, cluster):
    address, workers = cluster
    run = [sys.executable, "-m", "barpc", *map(str, command(scene, "dask", "-j", address))]
    process = subprocess.Popen(run, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 600
    while len(list(scene.glob("dask/.barpc/cache/detect_tile/*.npz"))) < 3:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.kill(workers[0].pid, signal.SIGKILL)
    _, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    assert "Traceback" not in err
    assert workers[1].poll() is None
    assert outputs(scene / "dask") == alone
