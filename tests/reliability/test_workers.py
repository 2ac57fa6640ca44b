"""The bytes do not depend on who does the work: one process, several, a cluster, one that loses a worker."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from barpc.errors import AdjustError, ImageError, OutputError
from barpc.pipeline.executor import LARGE, CachingExecutor, Spilled, worker_count
from barpc.workspace import Workspace

from .conftest import barpc
from .trials import SAMPLES, crop, outputs

TILES = "[tie]\ntile = 256\n"  # more tasks than workers


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """A folder of three images and options that cut them into many tasks."""
    folder = tmp_path_factory.mktemp("scene")
    for path in SAMPLES:
        crop(path, folder / path.name, side=500, start=150)
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


def test_a_rerun_gives_the_same_bytes(scene, alone):
    assert barpc(*command(scene, "again")).code == 0
    assert outputs(scene / "again") == alone


@pytest.mark.parametrize("jobs", [2, pytest.param(4, marks=pytest.mark.slow)])
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
    quiet = {
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.PIPE,
        "text": True,
        "env": where,
        "cwd": folder,
    }
    program = [sys.executable, "-m"]
    scheduler = subprocess.Popen(
        [*program, "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"],
        **quiet,
    )
    address = None
    for line in scheduler.stderr:
        if found := re.search(r"tcp://127\.0\.0\.1:\d+", line):
            address = found[0]
            break
    workers = [
        subprocess.Popen(
            [
                *program,
                "distributed.cli.dask_worker",
                address,
                "--nthreads",
                "1",
                "--no-nanny",
                "--no-dashboard",
            ],
            **(quiet | {"stderr": subprocess.DEVNULL}),
        )
        for _ in range(2)
    ]
    yield address, workers
    for process in (*workers, scheduler):
        process.kill()
        process.communicate()


@pytest.mark.slow
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


# -- kept results -----------------------------------------------------------------------------------------


def square(number, _pad=None):
    return {"square": np.array(float(number) ** 2)}


def refuse(number):
    if number == 3:
        raise ImageError("three.tif: is damaged")
    return float(number)


def bug(number):
    return 1 / number


class Recording(ThreadPoolExecutor):
    """A pool that writes down how many tasks came together."""

    def __init__(self) -> None:
        super().__init__(2)
        self.batches: list[int] = []

    def submit(self, fn, /, *args):
        self.batches.append(len(args[1]))
        return super().submit(fn, *args)


def test_results_come_back_in_order_and_are_found_the_next_time(tmp_path):
    for _ in range(2):
        with Workspace(tmp_path / "run", overwrite=True) as workspace, Recording() as pool:
            with CachingExecutor(workspace, {}, pool) as caching:
                futures = [caching.submit(square, n) for n in range(40)]
                assert [float(future.result()["square"]) for future in futures] == [n**2 for n in range(40)]
    assert pool.batches == []


def test_quick_tasks_travel_together(tmp_path):
    with (
        Workspace(tmp_path / "run") as workspace,
        Recording() as pool,
        CachingExecutor(workspace, {}, pool) as caching,
    ):
        futures = [caching.submit(square, n) for n in range(400)]
        for future in futures:
            future.result()
    assert sum(pool.batches) == 400
    assert max(pool.batches) > 10
    assert len(pool.batches) < 100


def test_an_error_goes_to_its_own_task_and_the_others_are_kept(tmp_path):
    with (
        Workspace(tmp_path / "run") as workspace,
        Recording() as pool,
        CachingExecutor(workspace, {}, pool) as caching,
    ):
        futures = [caching.submit(refuse, n) for n in range(30)]
        with pytest.raises(ImageError, match="damaged"):
            futures[3].result()
        assert [future.result() for future in futures[4:]] == [float(n) for n in range(4, 30)]
        assert len(list(workspace.cache.glob("refuse/*.npz"))) == 29


def test_a_bug_in_a_worker_says_where(tmp_path):
    with (
        Workspace(tmp_path / "run") as workspace,
        Recording() as pool,
        CachingExecutor(workspace, {}, pool) as caching,
    ):
        with pytest.raises(ZeroDivisionError) as caught:
            caching.submit(bug, 0).result()
    assert any("in bug" in note for note in caught.value.__notes__)


def test_a_pool_that_was_shut_down_is_an_error_of_every_task(tmp_path):
    pool = Recording()
    pool.shutdown()
    with Workspace(tmp_path / "run") as workspace, CachingExecutor(workspace, {}, pool) as caching:
        futures = [caching.submit(square, n) for n in range(3000)]
        for future in futures:
            with pytest.raises((RuntimeError, AdjustError)):
                future.result()


def test_a_full_disk_reaches_whoever_asks_for_the_result(tmp_path, monkeypatch):
    def full(*_args):
        raise OutputError("the disk is full")

    monkeypatch.setattr(Workspace, "store", full)
    with (
        Workspace(tmp_path / "run") as workspace,
        Recording() as pool,
        CachingExecutor(workspace, {}, pool) as caching,
    ):
        with pytest.raises(OutputError, match="full"):
            caching.submit(square, 2).result()


def test_large_arrays_are_sent_as_paths_and_taken_away(tmp_path):
    pad = np.arange(LARGE // 8 + 1.0)
    sent = []

    class Looking(ThreadPoolExecutor):
        def submit(self, fn, /, *args):
            sent.extend(args[1])
            return super().submit(fn, *args)

    with Workspace(tmp_path / "run") as workspace, Looking(2) as pool:
        with CachingExecutor(workspace, {}, pool) as caching:
            futures = [caching.submit(square, n, pad) for n in range(4)]
            assert [float(future.result()["square"]) for future in futures] == [0, 1, 4, 9]
            assert len(list(workspace.cache.glob("arrays/*.npz"))) == 1
        assert not (workspace.cache / "arrays").exists()
    assert all(isinstance(task, Spilled) for task in sent)
    assert sum(array.nbytes for array in sent[0].small.values()) < 2000


def test_a_cluster_may_grow():
    class Client:
        def nthreads(self):
            return {"a": 1}

    class Cluster:
        _client = Client()

    assert worker_count(Cluster()) == 32
    assert worker_count(Recording()) == 2
