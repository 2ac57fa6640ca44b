"""Workers that come and go: said, waited for, and the same bytes in the end."""

from __future__ import annotations

import logging
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


class Counted:
    """A client whose workers are counted, one number a poll."""

    def __init__(self, *numbers: int | None, waits: bool = True) -> None:
        self.numbers, self.status = list(numbers), "running"
        self.futures = {"a": SimpleNamespace(status="finished"), "b": SimpleNamespace(status="pending")}
        if not waits:
            del self.futures["b"]

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
    assert told(caplog, Counted(1, 0, waits=False), 0.2) == []  # it adapts, and nothing is waited for
    caplog.clear()
    assert told(caplog, Counted(1, None, waits=False), 0.2)
    with cluster.watched(None):
        assert not [t for t in threading.enumerate() if t.name == cluster.__name__]


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


def test_the_last_worker_is_said_within_ten_seconds_and_then_once_a_minute() -> None:
    assert cluster.POLL <= 5
    assert cluster.REMIND == 60


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore")
def test_workers_close_and_come_during_a_run_and_the_bytes_are_the_same(
    distributed: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "POLL", 0.2)
    caplog.set_level(logging.WARNING)
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
    lines = [record.message for record in caplog.records if record.name == cluster.__name__]
    assert any("no worker" in line for line in lines)
    assert any("worker(s), after" in line for line in lines)
    for name in ("view_00_RPC.TXT", "view_01_RPC.TXT", "tables/observations.csv", "tables/block.npz"):
        assert (tmp_path / "dask_run" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes(), name


# --- the watch, by a clock of its own ----------------------------------------------------------------------


class Clock:
    """Time that goes on by POLL with each wait, and an end after so many of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, polls: int) -> None:
        self.now, self.left = 1000.0, polls
        monkeypatch.setattr(cluster, "time", SimpleNamespace(monotonic=lambda: self.now))

    def wait(self, seconds: float) -> bool:
        self.now += seconds
        self.left -= 1
        return self.left < 0


@pytest.mark.parametrize(
    ("numbers", "waits", "said"),
    [
        ([1] * 9, True, []),
        ([0] * 13, True, ["has had no worker for 5 s", "has had no worker for 65 s"]),
        ([0] * 12, True, ["has had no worker for 5 s"]),
        ([1, 1, 0, 0, 3, 3], True, ["has had no worker for 5 s", "has 3 worker(s), after 15 s without"]),
        ([1, None, None, 2], True, ["has not answered for 5 s", "has 2 worker(s), after 15 s without"]),
        ([0] * 20, False, []),
        ([None] * 2, False, ["has not answered for 5 s"]),
        ([1, 0, 1, 0, 1], True, ["has had no worker for 5 s", "has 1 worker(s), after 10 s without"] * 2),
    ],
)  # fmt: skip
def test_what_is_said_of_workers_and_when(monkeypatch, caplog, numbers, waits, said) -> None:
    """Workers are counted every 5 s; the seconds without any count from when there was one for the last time."""
    cluster._watch(Counted(*numbers, waits=waits), Clock(monkeypatch, len(numbers)))
    assert [record.getMessage().split(":")[0] for record in caplog.records] == [f"the cluster {line}" for line in said]
    waiting = [record.getMessage() for record in caplog.records if ":" in record.getMessage()]
    assert all(line.endswith("Ctrl-C ends the run and the same command goes on with it") for line in waiting)


def test_an_end_of_work_ends_the_reminders(monkeypatch, caplog) -> None:
    """While nothing is waited for there need be no worker, and that there was none before is not said of a new one."""
    client, clock = Counted(0), Clock(monkeypatch, 6)
    real = clock.wait

    def wait(seconds: float) -> bool:
        if clock.left == 4:
            client.futures.clear()
        if clock.left == 2:
            client.numbers = [1]
        return real(seconds)

    clock.wait = wait  # type: ignore[method-assign]
    cluster._watch(client, clock)
    assert [record.getMessage().split(":")[0] for record in caplog.records] == ["the cluster has had no worker for 5 s"]


def test_workers_of_a_scheduler_that_is_gone_are_not_known() -> None:
    client = Counted(2)
    assert cluster._workers(client) == 2
    assert cluster._workers(Counted(0)) == 0
    assert cluster._workers(Counted(None)) is None
    client.status = "closed"
    assert cluster._workers(client) is None
    assert cluster._waits(Counted(1))
    assert not cluster._waits(Counted(1, waits=False))


def test_the_watch_begins_with_the_work_and_ends_with_it(monkeypatch) -> None:
    ends: list[threading.Event] = []
    begun = threading.Event()

    def watch(client, end) -> None:
        ends.append(end)
        assert threading.current_thread().daemon  # it holds nobody up who leaves
        begun.set()

    monkeypatch.setattr(cluster, "_watch", watch)
    with pytest.raises(KeyError), cluster.watched(Works(Counted(1))):  # type: ignore[arg-type]
        assert begun.wait(60.0)
        assert not ends[0].is_set()
        raise KeyError
    assert ends[0].is_set()
    assert len(ends) == 1
