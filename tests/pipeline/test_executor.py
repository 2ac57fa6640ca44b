"""Who works on the tasks: results in order, kept and found again, in batches, each error where it belongs; workers
that come and go.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import barpc
from barpc import __version__
from barpc.base.errors import AdjustError, ImageError, OutputError
from barpc.base.identity import Input
from barpc.base.options import RunOptions, TieOptions
from barpc.base.safe_io import MB
from barpc.pipeline.executor import BATCH_SECONDS, CachingExecutor, Spilled, run_batch, worker_count
from barpc.workspace import Workspace
from tests.pipeline.known import SAMPLES


def square(number):
    return {"square": np.array(float(number) ** 2)}


def refuse(number, _pad=None):
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


@contextmanager
def working(folder: Path, pool: Executor | None = None, **how: bool) -> Iterator[CachingExecutor]:
    """An executor over a pool, for the run in a folder."""
    with Workspace(folder / "run", overwrite=True) as workspace, CachingExecutor(workspace, {}, pool, **how) as caching:
        yield caching


def test_results_come_back_in_order_and_are_found_the_next_time(tmp_path):
    for _ in range(2):
        with Recording() as pool, working(tmp_path, pool) as caching:
            futures = [caching.submit(square, n) for n in range(40)]
            assert [float(future.result()["square"]) for future in futures] == [n**2 for n in range(40)]
    assert pool.batches == []


def test_an_error_goes_to_its_own_task_and_the_others_are_kept(tmp_path):
    with Recording() as pool, working(tmp_path, pool) as caching:
        futures = [caching.submit(refuse, n) for n in range(30)]
        with pytest.raises(ImageError, match="damaged"):
            futures[3].result()
        assert [future.result() for future in futures[4:]] == [float(n) for n in range(4, 30)]
        assert len(list(caching.workspace.cache.glob("refuse/*.npz"))) == 29


def test_a_bug_in_a_worker_says_where(tmp_path):
    with Recording() as pool, working(tmp_path, pool) as caching:
        with pytest.raises(ZeroDivisionError) as caught:
            caching.submit(bug, 0).result()
    assert any("in bug" in note for note in caught.value.__notes__)


@pytest.mark.slow
def test_a_pool_that_was_shut_down_is_an_error_of_every_task(tmp_path):
    pool = Recording()
    pool.shutdown()
    with working(tmp_path, pool) as caching:
        futures = [caching.submit(square, n) for n in range(3000)]
        for future in futures:
            with pytest.raises((RuntimeError, AdjustError)):
                future.result()


def test_a_result_that_cannot_be_kept_is_an_error_of_whoever_asks_for_it(tmp_path):
    with Recording() as pool, working(tmp_path, pool) as caching:
        caching.workspace.cache.mkdir(exist_ok=True)
        (caching.workspace.cache / "square").touch()  # where its folder would be
        with pytest.raises(OutputError, match="cache/square"):
            caching.submit(square, 2).result()


# --- its parts ---------------------------------------------------------------------------------------------


class Later(Executor):
    """A pool whose batches are done when one says so."""

    _max_workers = 2

    def __init__(self) -> None:
        self.batches: list[tuple[Future, tuple]] = []

    def submit(self, fn, /, *args):
        future: Future = Future()
        self.batches.append((future, args[:3]))
        return future

    def finish(self, number: int = 0, outcomes=None, spent: float = 0.0) -> None:
        future, (fn, tasks, version) = self.batches.pop(number)
        done = run_batch(fn, tasks, version)[0] if outcomes is None else outcomes(fn, tasks)
        future.set_result((done, spent))


def test_workers_are_counted_by_their_pool_and_of_a_cluster_that_may_grow(monkeypatch, caplog) -> None:
    def on(*threads: int) -> int:
        client = SimpleNamespace(nthreads=lambda: {f"tcp://127.0.0.1:{i}": n for i, n in enumerate(threads)})
        return worker_count(SimpleNamespace(_client=client))  # type: ignore[arg-type]

    assert worker_count(None) == os.cpu_count()
    assert worker_count(ThreadPoolExecutor(3)) == 3
    assert (on(1), on(40, 2)) == (32, 42)
    assert not caplog.records
    assert on() == 32
    assert "the cluster has no worker: the run waits" in caplog.text
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert worker_count(None) == 1


def test_three_batches_for_each_worker_are_in_flight_and_one_follows_another(tmp_path) -> None:
    pool = Later()
    with working(tmp_path, pool) as caching:
        futures = [caching.submit(square, n) for n in range(9)]
        assert [len(args[1]) for _, args in pool.batches] == [1] * 6
        pool.finish(2)
        assert futures[2].result()["square"] == 4.0
        assert len(pool.batches) == 6
        while pool.batches:
            pool.finish()
        assert [float(future.result()["square"]) for future in futures] == [n**2 for n in range(9)]


@pytest.mark.parametrize(("seconds", "most"), [(0.4, 1), (0.25, 2), (0.1, 5), (0.01, 9), (0.0, 9)])
def test_a_batch_is_half_a_second_of_work_but_leaves_the_others_their_share(tmp_path, seconds, most) -> None:
    pool = Later()
    with working(tmp_path, pool) as caching:
        for n in range(66):  # six are sent at once; of sixty nine leave as many for each other place
            caching.submit(square, n)
        pool.finish(0, lambda fn, tasks: [(seconds, fn(*tasks[0]), None)])
        assert len(pool.batches[-1][1][1]) == most
        caching.shutdown()


def test_the_time_of_a_task_is_a_running_mean(tmp_path) -> None:
    pool = Later()
    with working(tmp_path, pool) as caching:
        for n in range(300):
            caching.submit(square, n)
        for seconds, mean in ((0.04, 0.04), (0.02, 0.03), (0.009, 0.0195)):
            pool.finish(0, lambda fn, tasks, s=seconds: [(s, fn(*task), None) for task in tasks])
            assert len(pool.batches[-1][1][1]) == int(BATCH_SECONDS / mean)
        caching.shutdown()


def test_a_batch_is_of_one_function(tmp_path) -> None:
    pool = Later()
    with working(tmp_path, pool) as caching:
        for n in range(40):
            caching.submit(square if n % 20 < 18 else refuse, n + 5)
        while pool.batches:
            _, (fn, tasks, _) = pool.batches[0]
            wanted = [n + 5 for n in range(40) if (fn is square) == (n % 20 < 18)]
            assert {task[0] for task in tasks} <= set(wanted)
            pool.finish(0, lambda fn, tasks: [(0.001, n, None) for n in range(len(tasks))])


def test_cpu_seconds_of_workers_are_added_up(tmp_path) -> None:
    pool = Later()
    with working(tmp_path, pool) as caching:
        for n in range(3):
            caching.submit(square, n)
        for spent in (0.5, 0.25, 1.0):
            pool.finish(0, spent=spent)
        assert caching.workspace.worker_seconds == 1.75


def test_without_a_pool_a_task_is_done_when_its_result_is_asked_for_and_kept(tmp_path) -> None:
    done: list[int] = []

    def note(number):
        done.append(number)
        return float(number)

    with working(tmp_path) as caching:
        first, second = caching.submit(note, 1), caching.submit(note, 2)
        assert done == []
        assert (second.result(), first.result(), second.result()) == (2.0, 1.0, 2.0)
        assert done == [2, 1]
        assert caching.submit(note, 1).result() == 1.0
        assert done == [2, 1]
    with working(tmp_path, keep=False) as caching:
        assert caching.submit(note, 1).result() == 1.0
    assert done == [2, 1, 1]
    assert len(list(caching.workspace.cache.glob("note/*.npz"))) == 2


def test_tasks_take_positional_arguments_only(tmp_path) -> None:
    with working(tmp_path) as caching:
        with pytest.raises(TypeError, match="positional"):
            caching.submit(square, number=2)


def test_a_cancelled_task_is_not_done(tmp_path) -> None:
    pool = Later()
    with working(tmp_path, pool) as caching:
        futures = [caching.submit(square, n) for n in range(8)]
        assert futures[7].cancel()
        sent = []
        while pool.batches:
            sent += [task[0] for task in pool.batches[0][1][1]]
            pool.finish()
        assert sent == list(range(7))
        more = [caching.submit(square, n) for n in range(10, 30)]
        assert len(pool.batches) == 6  # as many as at first: nothing is in flight
        caching.shutdown()
        assert all(future.cancelled() or not future.done() for future in more)


def test_after_its_end_nothing_is_handed_out_or_kept(tmp_path) -> None:
    pool = Later()
    with Workspace(tmp_path / "run") as workspace:
        caching = CachingExecutor(workspace, {}, pool)
        for n in range(9):
            caching.submit(square, n)
        pool.finish()
        assert len(list(workspace.cache.glob("square/*.npz"))) == 1
        caching.shutdown()
        while pool.batches:
            pool.finish()
        assert len(list(workspace.cache.glob("square/*.npz"))) == 1


@dataclass(frozen=True)
class Pair:
    first: object
    second: object = None
    worked_out: object = field(default="a.tif", init=False)


def test_a_key_is_of_contents_and_not_of_names(tmp_path) -> None:
    with Workspace(tmp_path / "run") as workspace:
        one, other = (
            CachingExecutor(
                workspace,
                {name: Input(name, 1, sha, None) for name, sha in (("a.tif", mark), ("b.tif", "1"))},
            )
            for mark in ("1", "2")
        )
        assert one.key(square, ("a.tif",)) == one.key(square, ("b.tif",)) == other.key(square, ("b.tif",))
        assert one.key(square, ("a.tif",)) != other.key(square, ("a.tif",))
        assert one.key(square, ("c.tif",)) != one.key(square, ("d.tif",))
        assert one.key(square, (1,)) != one.key(refuse, (1,))
        nested = [("a.tif", 1), [("a.tif", 1)], Pair("a.tif", 1), ["a.tif", 2]]
        keys = [one.key(square, (value,)) for value in nested]
        assert len(set(keys)) == 4
        assert [other.key(square, (value,)) for value in nested] != keys
        again = [("b.tif", 1), [("b.tif", 1)], Pair("b.tif", 1), ["b.tif", 2]]
        assert [one.key(square, (value,)) for value in again] == keys


def test_arrays_count_by_values_type_and_shape(tmp_path) -> None:
    with Workspace(tmp_path / "run") as workspace:
        caching = CachingExecutor(workspace, {})
        a = np.arange(6.0)
        others = [a + 1, a.reshape(2, 3), a.reshape(3, 2), a.view(np.int64), a.astype(np.float32)]
        keys = {caching.key(square, (array,)) for array in [a, *others]}
        assert len(keys) == 6
        assert caching.key(square, (a.copy(),)) in keys
        assert caching.key(square, (np.asfortranarray(a.reshape(2, 3)),)) in keys


def test_a_large_array_is_spilled_once_and_a_small_one_is_sent(tmp_path) -> None:
    large, small, pool = np.zeros(MB // 8), np.zeros(MB // 8 - 1), Later()
    with working(tmp_path, pool) as caching:
        futures = [caching.submit(refuse, *args) for args in ((1, small), (1, large), (2, large.copy()))]
        sent, first, second = (args[1][0] for _, args in pool.batches)
        assert sent == (1, small)
        assert isinstance(first, Spilled)
        assert isinstance(second, Spilled)
        (place,) = first.large.values()
        assert list(second.large.values()) == [place]
        assert [path.stem for path in caching.workspace.cache.glob("arrays/*.npz")] == [place.rpartition("/")[2]]
        assert sum(array.nbytes for array in first.small.values()) < 2000
        number, array = second.load()
        assert number == 2
        np.testing.assert_array_equal(array, large)
        while pool.batches:
            pool.finish()
        assert [future.result() for future in futures] == [1.0, 1.0, 2.0]
    assert not (caching.workspace.cache / "arrays").exists()


class KilledWorker(Exception):
    """Of distributed, by its name."""


@pytest.mark.parametrize("error", [BrokenExecutor("x"), CancelledError(), KilledWorker("x"), ValueError("of its own")])
def test_a_lost_worker_is_said_in_words_and_any_other_error_of_a_pool_is_itself(tmp_path, error) -> None:
    pool = Later()
    with working(tmp_path, pool) as caching:
        task = caching.submit(square, 1)
        pool.batches.pop()[0].set_exception(error)
        lost = not isinstance(error, ValueError)
        with pytest.raises(AdjustError if lost else ValueError) as caught:
            task.result()
    assert caught.value.__cause__ is error if lost else caught.value is error
    assert str(caught.value).startswith("a worker process died" if lost else "of its own")


def test_a_batch_gives_every_task_its_seconds_value_or_error() -> None:
    def slow(number):
        start = time.perf_counter()
        while time.perf_counter() - start < 0.01:
            pass
        return refuse(number)

    outcomes, spent = run_batch(slow, [(2,), (3,), (4,)], __version__)
    assert [value for _, value, _ in outcomes] == [2.0, None, 4.0]
    assert [type(error) for _, _, error in outcomes] == [type(None), ImageError, type(None)]
    assert all(seconds >= 0.01 for seconds, _, _ in outcomes)
    assert spent > 0.0
    assert not getattr(outcomes[1][2], "__notes__", [])  # an error of barpc says enough


def test_a_kept_result_that_cannot_be_read_is_made_again(tmp_path, caplog) -> None:
    with working(tmp_path) as caching:
        caching.submit(square, 3).result()
        (kept,) = caching.workspace.cache.rglob("*.npz")
        np.savez(kept, no=np.zeros(1))
        assert float(caching.submit(square, 3).result()["square"]) == 9.0
    assert "a kept result is made again" in caplog.text


def test_a_task_relies_on_the_inputs_that_its_arguments_name(tmp_path) -> None:
    a, b = (Input(name, 1, name, None) for name in ("a.tif", "b.tif"))
    with Workspace(tmp_path / "run") as workspace:
        caching = CachingExecutor(workspace, {"a.tif": a, "b.tif": b})
        assert caching.guards(("a.tif", 1, None, np.arange(3.0))) == (a,)
        assert caching.guards(([Pair("b.tif")], ("x.tif", "a.tif"), Pair("a.tif", "b.tif"))) == (b, a)
        assert caching.guards((Pair("x.tif"), {"a.tif": 1}, "a.tif.bak")) == ()


def test_of_tasks_that_wait_behind_others_one_goes_ahead_while_their_time_is_not_known(tmp_path) -> None:
    pool = Later()
    with working(tmp_path, pool) as caching:
        for n in range(66):  # six are in flight
            caching.submit(square if n < 6 else refuse, n + 5)
        assert [fn for _, (fn, *_) in pool.batches] == [square] * 6
        pool.finish(0, lambda fn, tasks: [(0.001, fn(*task), None) for task in tasks])
        assert [(fn, len(tasks)) for _, (fn, tasks, _) in pool.batches[5:]] == [(refuse, 1)]
        caching.shutdown()


# --- workers of a cluster -----------------------------------------------------------------------------------


def test_a_worker_that_comes_later_with_another_version_works_on_nothing() -> None:
    done: list[int] = []
    outcomes, seconds = run_batch(done.append, [(1,), (2,)], "0.0.9")
    assert not done
    assert seconds == 0.0
    assert [str(error).split(":")[0] for _, _, error in outcomes] == [
        f"a worker has barpc {__version__}, this process 0.0.9"
    ] * 2
    assert run_batch(done.append, [(1,), (2,)], __version__)[0][0][2] is None
    assert done == [1, 2]


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore")
def test_workers_close_and_come_during_a_run_and_the_bytes_are_the_same(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    images = SAMPLES[:2]
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
