"""How the tasks of a stage are handed to whoever works on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
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
    """Results of `function(*task)` in the order of the tasks; the rest is cancelled when one fails.

    Parameters
    ----------
    executor : Executor or None
        Works on the tasks; None: they are worked on here, one after the other.
    function : callable
        Of a module, so that it can be sent to another process.
    tasks, stage, progress
        Its arguments; `progress(stage, done, total)` is called as they are done.
    """
    results = []
    futures = [executor.submit(function, *task) for task in tasks] if executor is not None else []
    try:
        for done, task in enumerate(tasks, start=1):
            results.append(futures[done - 1].result() if futures else function(*task))
            if progress is not None:
                progress(stage, done, len(tasks))
    finally:
        for future in futures:
            future.cancel()
    return results
