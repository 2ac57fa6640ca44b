"""Who works on the tasks: an executor that remembers results, and keeps only a few tasks in flight.

`CachingExecutor` looks a task (a tile, a pair) up among the kept results, gives the rest to the executor behind it, and
keeps what comes back at once: an interrupted run goes on where it was, and a thousand pairs do not stand pickled in a
queue. Quick tasks travel in batches: the way (0.2 ms to a process, 10 ms over dask) is paid once for half a second of
work. What goes to many tasks lies in the run folder, which all workers see as they see the images (what dask scatters
dies with the worker that holds it): workers write the keypoints of a tile into the executor's store and read there what
a pair needs, and large arrays among the arguments are spilled once.
"""

from __future__ import annotations

import hashlib
import logging
import os
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from barpc import __version__
from barpc.base.errors import AdjustError, BarpcError, InputError, out_of_memory
from barpc.base.fields import given, is_record
from barpc.base.frozen import Arrays, from_arrays, to_arrays
from barpc.base.identity import Input, guarded
from barpc.base.safe_io import MB
from barpc.base.tasks import Progress, Store, ordered
from barpc.workspace import Workspace, key_of

logger = logging.getLogger(__name__)

BATCH_SECONDS = 0.5  # work that is handed in at a time [s], as far as there are tasks for all workers
GROUP = 8  # images, or tiles of one, of a task whose result is kept
_PER_WORKER = 3  # batches in flight for each worker: enough that none waits
_CLUSTER = 32  # workers of a cluster, at least: it may grow when there is work
_LOST = ("KilledWorker", "FutureCancelledError")  # of distributed, which may not be installed

TaskFunction = Callable[..., Any]
TaskOutcome = tuple[float, Any, BaseException | None]  # seconds, result, error of one task


def worker_count(executor: Executor | None) -> int:
    """Return the number of tasks that an executor works on at a time; of a dask cluster what it may grow to."""
    client = getattr(executor, "_client", None)
    if client is not None:
        threads = [int(number) for number in client.nthreads().values()]
        if not threads:
            logger.warning("the cluster has no worker: the run waits for one; Ctrl-C ends it, and what is done is kept")
        return max(_CLUSTER, sum(threads))
    return int(getattr(executor, "_max_workers", None) or os.cpu_count() or 1)


def by_groups(
    executor: Executor | None,
    function: Callable[..., Any],
    items: Sequence[Any],
    given: tuple[Any, ...],
    stage: str,
    progress: Progress | None,
) -> list[Any]:
    """Run `function(group, *given)` on `GROUP` items at a time, as `ordered`; progress counts the items."""
    tasks, num = [(tuple(items[at : at + GROUP]), *given) for at in range(0, len(items), GROUP)], len(items)
    told = progress and (lambda stage, done, _: progress(stage, min(done * GROUP, num), num))
    return ordered(executor, function, tasks, stage, told)


class CachingExecutor(Executor):
    """An executor that keeps results in a workspace.

    `inputs` holds every input file by its path, as it was hashed: results belong to contents, not to names, and none
    is kept that was made while its file changed. Without an `executor` this process works on the tasks, one after the
    other, when their result is asked for. With `keep` false nothing is kept: of tasks that look at files.
    """

    def __init__(
        self,
        workspace: Workspace,
        inputs: Mapping[str, Input],
        executor: Executor | None = None,
        keep: bool = True,
    ) -> None:
        self.workspace, self.executor, self.keep = workspace, executor, keep
        self.store = workspace.store
        places = {self.store.folder: "cache", self.store.room: "partial"}  # wherever the run folder lies
        self._inputs = inputs
        self._fingerprints = {**{path: one.key for path, one in inputs.items()}, **places}
        self._limit = _PER_WORKER * worker_count(executor)
        self._lock = threading.Lock()
        self._storing = threading.RLock()  # while results are kept: `shutdown` waits for it
        self._waiting: deque[_PendingTask] = deque()
        self._in_flight, self._open = 0, True
        self._seconds: dict[TaskFunction, float] = {}
        self._digests: dict[int, tuple[object, str]] = {}
        self._spilled: set[str] = set()

    def submit(self, fn: TaskFunction, /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit `fn(*args)`; its result is looked up in the workspace, or computed when its turn comes."""
        if kwargs:
            raise TypeError("tasks take positional arguments only")
        task = _PendingTask(self, fn, args)
        if self.executor is not None:
            with self._lock:
                self._waiting.append(task)
            self._send()
        return task

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Stop accepting tasks and keeping results; the executor behind stays as it is."""
        with self._storing:
            self._open = False
            self._waiting.clear()
            self._digests.clear()
            self.store.clear()

    def key(self, fn: TaskFunction, args: tuple[Any, ...]) -> str:
        """Return the key under which the result of a task is kept."""
        return key_of(fn.__module__, fn.__qualname__, [self._canonical(arg) for arg in args])

    def _canonical(self, value: Any) -> Any:
        if isinstance(value, str):
            return self._fingerprints.get(value, value)
        if isinstance(value, np.ndarray):
            return self._digest(value)
        if is_record(value):
            return [type(value).__qualname__, *map(self._canonical, given(value).values())]
        if isinstance(value, (tuple, list)):
            return [self._canonical(v) for v in value]
        return value

    def guards(self, args: Any) -> tuple[Input, ...]:
        """Return the hashed inputs that the arguments of a task name."""
        if isinstance(args, str):
            return (self._inputs[args],) if args in self._inputs else ()
        if is_record(args):
            args = list(given(args).values())
        if not isinstance(args, (tuple, list)) or not self._inputs:
            return ()
        return tuple(dict.fromkeys(one for arg in args for one in self.guards(arg)))

    def _digest(self, value: np.ndarray[Any, Any]) -> str:
        known = self._digests.get(id(value))
        if known is None:  # the array is held with its digest, so that its id stays its own
            digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
            known = self._digests[id(value)] = (value, f"{value.dtype} {value.shape} {digest}")
        return known[1]

    # -- handing out -------------------------------------------------------------------------------

    def _send(self) -> None:
        """Give waiting tasks to the executor while few are in flight."""
        while batch := self._next_batch():
            try:
                tasks = [self._spill(task.args) for task in batch]
                guards = [self.guards(task.args) for task in batch]
                assert self.executor is not None
                future = self.executor.submit(run_batch, batch[0].fn, tasks, __version__, guards)
            except (RuntimeError, OSError) as error:  # the pool is broken or shut down; the disk is full
                self._resolve(batch, [(0.0, None, _worker_error(error))] * len(batch))
            else:
                future.add_done_callback(partial(self._completed, batch))

    def _spill(self, args: tuple[Any, ...]) -> tuple[Any, ...] | Spilled:
        """Return the arguments, large arrays among them as files of the run folder."""
        try:
            record = to_arrays(args)
        except TypeError:  # something that is not kept as a record, such as a user's own sensor
            return args
        large = {}
        for name, array in record.items():
            if array.nbytes >= MB:
                digest = hashlib.sha256(self._digest(array).encode()).hexdigest()
                large[name] = place = f"{self.store.scratch}/{digest[:32]}"
                if place not in self._spilled:
                    self.store.write(place, {"array": array})
                    self._spilled.add(place)
        if not large:
            return args
        return Spilled({name: array for name, array in record.items() if name not in large}, large, self.store)

    def _next_batch(self) -> list[_PendingTask]:
        """Return the waiting tasks of one function without a kept result; they count as in flight, if any."""
        with self._lock:
            if not self._open or self._in_flight >= self._limit:
                return []
            self._in_flight += 1
        batch: list[_PendingTask] = []
        while (task := self._next_task(batch)) is not None:
            if task.begin():
                batch.append(task)
        if not batch:
            with self._lock:
                self._in_flight -= 1
        return batch

    def _next_task(self, batch: Sequence[_PendingTask]) -> _PendingTask | None:
        """Return one more for a batch: as many as take BATCH_SECONDS, as far as the other workers get as many."""
        with self._lock:
            if not self._waiting:
                return None
            fn = self._waiting[0].fn
            seconds, share = self._seconds.get(fn), -(-len(self._waiting) // self._limit)
            most = 1 if seconds is None else max(1, min(int(BATCH_SECONDS / max(seconds, 1e-6)), share))
            full = bool(batch) and (fn is not batch[0].fn or len(batch) >= most)
            return None if full else self._waiting.popleft()

    # -- taking back -------------------------------------------------------------------------------

    def _completed(self, batch: Sequence[_PendingTask], future: Future[Any]) -> None:
        try:
            outcomes, spent = future.result()
        except BaseException as error:  # noqa: BLE001  (goes to whoever asks for the result)
            outcomes = [(0.0, None, _worker_error(error))] * len(batch)
        else:
            with self._lock:
                self.workspace.worker_seconds += spent
            seconds = sum(outcome[0] for outcome in outcomes) / len(outcomes)
            self._seconds[batch[0].fn] = 0.5 * (self._seconds.get(batch[0].fn, seconds) + seconds)
        self._resolve(batch, outcomes)
        self._send()

    def _resolve(self, batch: Sequence[_PendingTask], outcomes: Sequence[TaskOutcome]) -> None:
        with self._lock:
            self._in_flight -= 1
        with self._storing:
            for task, (_, value, error) in zip(batch, outcomes, strict=True):
                task.finish(value, error, keep=self._open)


class _PendingTask(Future[Any]):
    """One task: found, in flight, or to be done when asked for."""

    def __init__(self, owner: CachingExecutor, fn: TaskFunction, args: tuple[Any, ...]) -> None:
        super().__init__()
        self._owner, self.fn, self.args = owner, fn, args
        self._name = ""  # of its result in the store
        # a task that is given the store keeps there itself what it makes
        self._kept_here = owner.keep and not (args and isinstance(args[0], Store))

    def begin(self) -> bool:
        """Return whether there is work to do: it was not cancelled, and no result is kept."""
        if not self.set_running_or_notify_cancel():
            return False
        try:
            found, value = self._look_up()
        except Exception as error:  # noqa: BLE001  (goes to whoever asks for the result)
            self.set_exception(error)
            return False
        if found:
            self.set_result(value)
        return not found

    def finish(self, value: Any, error: BaseException | None, *, keep: bool = True) -> None:
        """Take the outcome, and keep a result for the next time."""
        self.args = ()
        try:
            if error is None and keep and self._kept_here:
                self._owner.store.write(self._name, to_arrays(value))
        except Exception as failed:  # noqa: BLE001  (a full disk: goes to whoever asks for the result)
            error = failed
        if error is None:
            self.set_result(value)
        else:
            self.set_exception(error)

    def result(self, timeout: float | None = None) -> Any:
        """Return the result, worked out here where there is no executor."""
        if self._owner.executor is None and not self.done() and self.begin():
            with guarded(self._owner.guards(self.args)):
                found = self.fn(*self.args)
            self.finish(found, None)
        return super().result(timeout)

    def _look_up(self) -> tuple[bool, Any]:
        if not self._kept_here:
            return False, None
        self._name = f"{self.fn.__name__.strip('_')}/{self._owner.key(self.fn, self.args)}"
        record = self._owner.store.read(self._name)
        try:
            return record is not None, None if record is None else from_arrays(record)
        except ValueError as error:
            logger.warning("a kept result is made again: %s", error)
            return False, None


@dataclass(frozen=True)
class Spilled:
    """Arguments of a task with large arrays stored in files: the arrays of `to_arrays`, by name."""

    small: Arrays
    large: Mapping[str, str]
    store: Store

    def load(self) -> tuple[Any, ...]:
        """Return the arguments; InputError where the worker does not see the store."""
        arrays = {name: self.store.need(place)["array"] for name, place in self.large.items()}
        arguments: tuple[Any, ...] = from_arrays({**self.small, **arrays}, sent=True)
        return arguments


def run_batch(
    fn: TaskFunction,
    tasks: Sequence[tuple[Any, ...] | Spilled],
    version: str,
    guards: Sequence[tuple[Input, ...]] | None = None,
) -> tuple[list[TaskOutcome], float]:
    """Run a batch of tasks in a worker; an error of one leaves the others theirs. Returns CPU seconds, too.

    `guards`: the inputs that each task names. One that came to a cluster with another `version` works on nothing.
    """
    if version != __version__:
        error = InputError(
            f"a worker has barpc {__version__}, this process {version}: results would differ; install the same version "
            "everywhere"
        )
        return [(0.0, None, error)] * len(tasks), 0.0
    outcomes: list[TaskOutcome] = []
    cpu = time.thread_time()
    for task, inputs in zip(tasks, guards or [()] * len(tasks), strict=True):
        start = time.perf_counter()
        try:
            with guarded(inputs):
                value = fn(*(task.load() if isinstance(task, Spilled) else task))
            outcomes.append((time.perf_counter() - start, value, None))
        except Exception as failed:  # noqa: BLE001  (raised again where the result is asked for)
            failure = MemoryError() if out_of_memory(failed) else failed  # there, room may be found
            if not isinstance(failure, BarpcError):
                failure.add_note("in a worker:\n" + traceback.format_exc())
            outcomes.append((time.perf_counter() - start, None, failure))
    return outcomes, time.thread_time() - cpu


def _worker_error(error: BaseException) -> BaseException:
    """Return a lost worker's error in words; any other error as it is."""
    if not isinstance(error, (BrokenExecutor, CancelledError)) and type(error).__name__ not in _LOST:
        return error
    died = AdjustError(
        "a worker process died (out of memory?): what was finished is kept, so run the same command again, "
        "perhaps with a smaller -j"
    )
    died.__cause__ = error
    return died
