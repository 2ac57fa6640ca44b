"""Handing tasks to whoever works on them, and getting the results back in order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Any

import cv2

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
    tasks : sequence of tuple
        Its arguments.
    stage : str
        Name for the progress.
    progress : callable, optional
        `progress(stage, done, total)`.
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


def one_thread() -> None:
    """Keep OpenCV to one thread: in a worker, where the work is spread by processes."""
    if cv2.getNumThreads() != 1:
        cv2.setNumThreads(1)
