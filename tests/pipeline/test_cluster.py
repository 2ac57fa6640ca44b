"""Workers that come and go: said, waited for, and the same bytes in the end."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

import pytest

import barpc
from barpc.options import RunOptions, TieOptions
from barpc.pipeline import cluster

distributed = pytest.importorskip("distributed")
SAMPLES = Path(__file__).resolve().parents[2] / "data_samples"


class Counted:
    """A client whose workers are counted, one number a poll."""

    def __init__(self, *numbers: int | None) -> None:
        self.numbers, self.status = list(numbers), "running"

    def nthreads(self) -> dict[str, int]:
        number = self.numbers.pop(0) if len(self.numbers) > 1 else self.numbers[0]
        if number is None:
            raise OSError("Timed out")
        return {f"tcp://127.0.0.1:{i}": 1 for i in range(number)}


class Works:
    def __init__(self, client: object) -> None:
        self._client = client


def told(caplog: pytest.LogCaptureFixture, client: Counted, seconds: float) -> list[str]:
    caplog.set_level(logging.WARNING)
    with cluster.watched(Works(client)):  # type: ignore[arg-type]
        time.sleep(seconds)
    return [record.message for record in caplog.records]


def test_a_cluster_without_workers_is_said_again_and_again_and_its_end_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(cluster, "POLL", 0.01)
    monkeypatch.setattr(cluster, "REMIND", 0.2)
    lines = told(caplog, Counted(2, 2, *[0] * 30, None, 3), 1.5)
    assert lines[-1].startswith("the cluster has 3 worker(s)")
    assert 3 <= len(lines) <= 30  # not a line a poll
    assert all("no worker" in line or "not answer" in line for line in lines[:-1])


def test_a_cluster_with_workers_and_an_executor_that_is_none_are_not_spoken_of(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(cluster, "POLL", 0.01)
    assert told(caplog, Counted(1), 0.2) == []
    with cluster.watched(None):
        assert not [t for t in threading.enumerate() if t.name == cluster.__name__]


def test_the_last_worker_is_said_within_ten_seconds_and_then_once_a_minute() -> None:
    assert cluster.POLL <= 5
    assert cluster.REMIND == 60


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_workers_close_and_come_during_a_run_and_the_bytes_are_the_same(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "POLL", 0.2)
    caplog.set_level(logging.WARNING)
    images = sorted(SAMPLES.glob("*.tif"))[:2]
    options = RunOptions(images="none", tie=TieOptions(tile=256, keypoints_per_image=3000))
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
        barpc.adjust(
            images, tmp_path / "dask_run", options, executor=client.get_executor(), progress=progress
        )
    assert seen
    lines = [record.message for record in caplog.records if record.name == cluster.__name__]
    assert any("no worker" in line for line in lines)
    assert any("worker(s), after" in line for line in lines)
    for name in ("view_00_RPC.TXT", "view_01_RPC.TXT", "observations.csv", "block.npz"):
        assert (tmp_path / "dask_run" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes(), name
