"""Execution of the tasks of a stage, and the store of their results, which travel by reference."""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from barpc.base import identity
from barpc.base.atomic import replacing
from barpc.base.errors import InputError
from barpc.base.frozen import Arrays, load_npz

logger = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]
"""Called with the stage, how much is done, of how much."""


def ordered(
    executor: Executor | None,
    function: Callable[..., Any],
    tasks: Sequence[tuple[Any, ...]],
    stage: str,
    progress: Progress | None = None,
) -> list[Any]:
    """Run `function(*task)` on an executor; return the results in order. A failure cancels the rest.

    Parameters
    ----------
    executor : Executor or None
        Works on the tasks; None: they are worked on here, one after the other.
    function : callable
        Of a module, so that it can be sent to another process.
    tasks, stage, progress
        Its arguments; `progress(stage, done, total)` is called as they are done.
    """
    return list(one_by_one(executor, function, tasks, stage, progress))


def one_by_one(
    executor: Executor | None,
    function: Callable[..., Any],
    tasks: Sequence[tuple[Any, ...]],
    stage: str,
    progress: Progress | None = None,
    ahead: int | None = None,
) -> Iterator[Any]:
    """Run tasks as `ordered`, but yield each result once it is known; at most `ahead` are submitted at a time."""
    waiting, futures = iter(tasks), deque[Future[Any]]()
    try:
        for done, task in enumerate(tasks, start=1):
            if executor is not None:
                more = len(tasks) if ahead is None else ahead - len(futures)
                futures.extend(executor.submit(function, *one) for one in islice(waiting, more))
            yield futures.popleft().result() if executor is not None else function(*task)
            if progress is not None:
                progress(stage, done, len(tasks))
    finally:
        for future in futures:
            future.cancel()


@dataclass(frozen=True)
class Store:
    """A folder that every worker sees under the same path, ``<stage>/<key>.npz`` in it; a name is ``stage/key``."""

    folder: str
    room: str  # for files on their way, on the same disk

    scratch = "arrays"  # the stage of what need not outlive a run

    def write(self, name: str, arrays: Arrays) -> None:
        """Write named arrays, whole or not at all; not if a file that they were made of has changed."""
        identity.ask()
        path = Path(self.folder) / f"{name}.npz"
        with (
            replacing(path, overwrite=True, durable=False, room=Path(self.room)) as partial,
            partial.open("wb") as file,
        ):
            np.savez(file, allow_pickle=False, **{k: np.asarray(v) for k, v in arrays.items()})

    def read(self, name: str) -> Arrays | None:
        """Read the arrays of a name, or None; a file that is damaged is taken away and counts as missing."""
        path = Path(self.folder) / f"{name}.npz"
        try:
            return None if path.is_symlink() or not path.is_file() else load_npz(path)
        except (OSError, ValueError) as error:
            logger.warning("%s: a damaged cache file is made again (%s)", path, error)
            path.unlink(missing_ok=True)
            return None

    def need(self, name: str) -> Arrays:
        """Return the arrays of a name that was written before; InputError where this worker does not find it."""
        found = self.read(name)
        if found is None:
            raise InputError(
                f"{self.folder}/{name}.npz: a worker cannot read it; images and run folder must be on a disk that all "
                "workers see under the same path"
            )
        return found

    def clear(self) -> None:
        """Remove the files under `scratch`."""
        shutil.rmtree(Path(self.folder) / self.scratch, ignore_errors=True)


@contextmanager
def store_of(executor: Executor | None) -> Iterator[Store]:
    """Yield the executor's store (`barpc.pipeline.executor`), or a temporary one."""
    given: Store | None = getattr(executor, "store", None)
    if given is not None:
        yield given
        return
    with tempfile.TemporaryDirectory(prefix="barpc-") as folder:
        yield Store(folder, folder)


def names_of(executor: Executor | None, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> list[str]:
    """Return names for results, by the content of inputs where the executor knows it: a later run finds them."""
    key = getattr(executor, "key", None)
    names = (key(function, task) if key else number for number, task in enumerate(tasks))
    return [f"{function.__name__}/{name}" for name in names]


@dataclass(frozen=True)
class Work:
    """Executor of tasks (None: this process), listener for progress, and store of results that travel by reference."""

    executor: Executor | None = None
    progress: Progress | None = None
    store: Store | None = None

    def ordered(self, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], stage: str) -> list[Any]:
        """Run tasks as `ordered`."""
        return ordered(self.executor, function, tasks, stage, self.progress)


HERE = Work()
"""This process, silently."""
