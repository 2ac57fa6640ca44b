"""A cluster's workers come and go: whether any is left is said while a run waits, and each must be this barpc's."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from importlib import metadata
from typing import Any

from barpc.errors import InputError

logger = logging.getLogger(__name__)

POLL, REMIND = 5.0, 60.0
"""How often the workers are counted, and how often it is said that there is none [s]."""


@contextmanager
def watched(executor: Executor | None) -> Iterator[None]:
    """Log when a dask cluster has no worker, once a minute while the run waits, and when work goes on.

    InputError where a worker has another version of barpc.
    """
    client = getattr(executor, "_client", None)
    if client is None:
        yield
        return
    _require_own_version(client)
    end = threading.Event()
    threading.Thread(target=_watch, args=(client, end), daemon=True).start()
    try:
        yield
    finally:
        end.set()


def other_version(theirs: str, own: str, where: str = "a worker") -> InputError:
    """Return why a worker would give other bytes (its version), or nothing."""
    return InputError(
        f"{where} has barpc {theirs}, this process {own}: results would differ; install the same version everywhere"
    )


def _require_own_version(client: Any) -> None:
    try:
        own = metadata.version("barpc")
    except metadata.PackageNotFoundError:  # from a folder: nothing to compare with
        return
    found = client.run(metadata.version, "barpc", on_error="return")
    for worker, theirs in sorted(found.items()):
        if theirs != own:
            none = isinstance(theirs, Exception)
            raise other_version("of no version" if none else theirs, own, f"the worker {worker}")


def _watch(client: Any, end: threading.Event) -> None:
    seen, said = time.monotonic(), None
    while not end.wait(POLL):
        number, now = _workers(client), time.monotonic()
        if number or (number == 0 and not _waits(client)):
            if number and said is not None:
                logger.warning("the cluster has %d worker(s), after %.0f s without", number, now - seen)
            seen, said = now, None
        elif said is None or now - said >= REMIND:
            said = now
            logger.warning(
                "the cluster %s for %.0f s: waiting; what is finished is kept, Ctrl-C ends the run and the "
                "same command goes on with it",
                "has had no worker" if number == 0 else "has not answered",
                now - seen,
            )


def _waits(client: Any) -> bool:
    """Return whether a task is under way: a cluster that adapts may do without workers while there is none."""
    return any(state.status == "pending" for state in list(client.futures.values()))


def _workers(client: Any) -> int | None:
    """Return the number of workers; None where the scheduler does not say."""
    if client.status != "running":
        return None
    try:
        return len(client.nthreads())
    except Exception:  # noqa: BLE001  (of many classes; the run's own calls tell what it was)
        return None
