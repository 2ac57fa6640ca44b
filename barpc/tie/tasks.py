"""How the tasks of a stage are handed to whoever works on them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from itertools import islice
from typing import Any

Progress = Callable[[str, int, int], None]
"""Called with the stage, how much is done, of how much."""


def ordered(
    executor: Executor | None,
    function: Callable[..., Any],
    tasks: Sequence[tuple[Any, ...]],
    stage: str,
    progress: Progress | None = None,
) -> list[Any]:
    """Run `function(*task)` on an executor and return the results in order; the rest is cancelled when one
    fails.

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
    """Run tasks as `ordered`, but yield each result as it comes and keep none; at most `ahead` are handed in at a
    time, so that kept results of all others are not in memory, too.
    """
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
