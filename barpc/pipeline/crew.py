"""Who works on the tasks: an executor that remembers results, and keeps only a few tasks in flight.

The stages hand their tasks (per tile, per pair) to any `concurrent.futures.Executor`. `Crew` is one: it
looks each task up among the kept results first, gives the rest to the executor behind it (or works on them
itself, when asked for the result), and keeps what comes back. So a run that was interrupted goes on where it
was, and a thousand pairs do not stand pickled in a queue.
"""

from __future__ import annotations

import hashlib
import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Executor, Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from barpc.errors import AdjustError
from barpc.record import from_record, to_record
from barpc.workspace import Workspace, key_of

logger = logging.getLogger(__name__)

_PER_WORKER = 3  # tasks in flight for each worker: enough that none waits


class Crew(Executor):
    """An executor with a memory.

    Parameters
    ----------
    workspace : Workspace
        Where results are kept.
    fingerprints : mapping of str to str
        Path of every input file to the hash of its content: results belong to contents, not to names.
    executor : Executor, optional
        Works on the tasks; None: they are worked on in this process, one after the other, when their result
        is asked for.
    workers : int
        How many workers the executor has.
    """

    def __init__(
        self,
        workspace: Workspace,
        fingerprints: Mapping[str, str],
        executor: Executor | None = None,
        workers: int = 1,
    ) -> None:
        self._workspace, self._fingerprints = workspace, dict(fingerprints)
        self._executor, self._limit = executor, _PER_WORKER * max(workers, 1)
        self._lock = threading.Lock()
        self._waiting: deque[_Task] = deque()
        self._in_flight = 0
        self._digests: dict[int, tuple[object, str]] = {}

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Hand in `fn(*args)`; its result is looked up, or made when its turn comes."""
        if kwargs:
            raise TypeError("tasks take positional arguments only")
        task = _Task(self, fn, args)
        with self._lock:
            self._waiting.append(task)
        self._pump()
        return task

    def forget(self) -> None:
        """Drop the digests of arrays that were seen (and the arrays with them)."""
        self._digests.clear()

    def key(self, fn: Callable[..., Any], args: tuple[Any, ...]) -> str:
        """The key under which the result of a task is kept."""
        return key_of(fn.__module__, fn.__qualname__, [self._canonical(arg) for arg in args])

    def _canonical(self, value: Any) -> Any:
        if isinstance(value, str):
            return self._fingerprints.get(value, value)
        if isinstance(value, np.ndarray):
            known = self._digests.get(id(value))
            if known is None:  # the array is held with its digest, so that its id stays its own
                digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
                known = self._digests[id(value)] = (value, f"{value.dtype} {value.shape} {digest}")
            return known[1]
        if is_dataclass(value) and not isinstance(value, type):
            given = [getattr(value, field.name) for field in fields(value) if field.init]
            return [type(value).__qualname__, *(self._canonical(part) for part in given)]
        if isinstance(value, (tuple, list)):
            return [self._canonical(v) for v in value]
        return value

    def _pump(self) -> None:
        """Give waiting tasks to the executor while few are in flight."""
        if self._executor is None:
            return
        while True:
            with self._lock:
                if not self._waiting or self._in_flight >= self._limit:
                    return
                task = self._waiting.popleft()
                self._in_flight += 1
            if task.cancelled() or not task.start(self._executor):
                self._landed(None)

    def _landed(self, _: Future[Any] | None) -> None:
        with self._lock:
            self._in_flight -= 1
        self._pump()


class _Task(Future[Any]):
    """One task of a crew: found, in flight, or to be done when asked for."""

    def __init__(self, crew: Crew, fn: Callable[..., Any], args: tuple[Any, ...]) -> None:
        super().__init__()
        self._crew, self._fn, self._args = crew, fn, args
        self._inner: Future[Any] | None = None
        self._kept: Any = None
        self._is_kept = False

    def start(self, executor: Executor) -> bool:
        """Look the result up, or hand the task to the executor; whether it is in flight now."""
        if self._look_up():
            return False
        try:
            self._inner = executor.submit(self._fn, *self._args)
        except RuntimeError as error:  # the pool is broken or was shut down
            self.set_exception(error)
            return False
        self._inner.add_done_callback(self._crew._landed)
        return True

    def result(self, timeout: float | None = None) -> Any:
        """The result, kept for the next time."""
        if self.cancelled():
            raise CancelledError
        if not self.done() and not self._is_kept:
            self._work(timeout)
        if self._is_kept:
            return self._kept
        try:
            return super().result(timeout)
        except BrokenProcessPool as error:
            raise _worker_died() from error

    def _work(self, timeout: float | None) -> None:
        crew = self._crew
        if self._inner is None and not self._look_up():
            value = self._fn(*self._args)
        elif self._inner is not None:
            try:
                value = self._inner.result(timeout)
            except BrokenProcessPool as error:
                raise _worker_died() from error
        else:
            return
        crew._workspace.store(self._stage, self._key, to_record(value))
        self._keep(value)

    @property
    def _stage(self) -> str:
        return self._fn.__name__.strip("_")

    def _look_up(self) -> bool:
        self._key = self._crew.key(self._fn, self._args)
        record = self._crew._workspace.load(self._stage, self._key)
        if record is None:
            return False
        try:
            self._keep(from_record(record))
        except ValueError as error:
            logger.warning("a kept result is made again: %s", error)
            return False
        return True

    def _keep(self, value: Any) -> None:
        self._kept, self._is_kept, self._args, self._inner = value, True, (), None


def _worker_died() -> AdjustError:
    return AdjustError(
        "a worker process died (out of memory?): what was finished is kept, so run the same command again, "
        "perhaps with a smaller -j"
    )
