"""Workers that come and go: waited for, and the same bytes in the end."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import barpc
from barpc.base.options import RunOptions, TieOptions
from barpc.pipeline import executor as cluster
from barpc.pipeline.executor import run_batch

SAMPLES = Path(__file__).resolve().parents[2] / "data_samples"


@pytest.fixture
def distributed() -> Any:
    """Only real workers ask for it."""
    return pytest.importorskip("distributed")


def test_a_cluster_without_workers_is_said(caplog: pytest.LogCaptureFixture) -> None:
    def on(*threads: int) -> int:
        client = SimpleNamespace(nthreads=lambda: {f"tcp://127.0.0.1:{i}": n for i, n in enumerate(threads)})
        return cluster.worker_count(SimpleNamespace(_client=client))  # type: ignore[arg-type]

    assert (on(1), on(40, 2)) == (32, 42)  # it may grow
    assert not caplog.records
    assert on() == 32
    assert "the cluster has no worker: the run waits" in caplog.text


def test_a_worker_that_comes_later_with_another_version_works_on_nothing() -> None:
    done: list[int] = []
    outcomes, seconds = run_batch(done.append, [(1,), (2,)], "0.0.9")
    assert not done
    assert seconds == 0.0
    assert [str(error).split(":")[0] for _, _, error in outcomes] == [
        f"a worker has barpc {barpc.__version__}, this process 0.0.9"
    ] * 2
    assert run_batch(done.append, [(1,), (2,)], barpc.__version__)[0][0][2] is None
    assert done == [1, 2]


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore")
def test_workers_close_and_come_during_a_run_and_the_bytes_are_the_same(distributed: Any, tmp_path: Path) -> None:
    images = sorted(SAMPLES.glob("*.tif"))[:2]
    options = RunOptions(images="none", tie=TieOptions(tile=256, points_per_image=600))
    barpc.adjust(images, tmp_path / "alone", options)
    seen: list[str] = []

    def progress(stage: str, done: int, _total: int) -> None:
        if stage == "detect" and done == 2 and not seen:
            seen.append(stage)
            dask.scale(0)

            def later() -> None:
                time.sleep(3)
                dask.scale(2)

            threading.Thread(target=later, daemon=True).start()

    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, dashboard_address=None, local_directory=str(tmp_path / "dask")
        ) as dask,
        distributed.Client(dask) as client,
    ):
        barpc.adjust(images, tmp_path / "dask_run", options, executor=client.get_executor(), progress=progress)
    assert seen
    for name in ("view_00_RPC.TXT", "view_01_RPC.TXT", "tables/observations.csv", "tables/block.npz"):
        assert (tmp_path / "dask_run" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes(), name
