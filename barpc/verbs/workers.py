"""Who works on a run: this process, others on this machine, or a cluster."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

from barpc.base.errors import InputError

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_OBJECTS = 50_000  # made between two looks for cycles


def quicken() -> None:
    """Shorten the start of barpc's own process; a host application's imports are left alone.

    Cycles are not looked for every 700 objects, and rasterio does not load boto3, a sixth of a second: what is on
    other hosts is opened by `barpc.base.remote`.
    """
    gc.set_threshold(_OBJECTS)
    sys.modules.setdefault("boto3", None)  # type: ignore[arg-type]  # an import of it fails


@contextmanager
def executor_for(jobs: int | str, given: Executor | None = None) -> Iterator[Executor | None]:
    """Yield the executor of a run: the given one, or of `jobs` processes, or of a cluster; None works in this process.

    InputError for a number below one, or an address at which no scheduler answers.
    """
    if given is not None or jobs == 1:
        yield given
        return
    if not isinstance(jobs, str) and jobs < 1:
        raise InputError(f"jobs {jobs}: a number of processes, or the address of a cluster, is expected")
    with _cluster(jobs) if isinstance(jobs, str) else _processes(jobs) as executor:
        yield executor


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError(f"-j {address}: an address needs the extra: pip install 'barpc[cluster]'") from error
    try:
        client = Client(address, timeout=20)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise InputError(f"-j {address}: no scheduler answers there ({error})") from error
    with client:
        yield client.get_executor()  # type: ignore[no-untyped-call]


@contextmanager
def _processes(jobs: int) -> Iterator[Executor]:
    context, others = multiprocessing.get_context("spawn"), multiprocessing.active_children()
    pool = _Workers(jobs, mp_context=context, initializer=_enter_worker)
    try:
        yield pool
    except BaseException:  # an error or Ctrl-C: nobody waits for what is in flight
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - set(others):
            process.kill()
        raise
    pool.shutdown()


class _Workers(ProcessPoolExecutor):
    """Processes, started one by one as tasks come, without an ear for Ctrl-C, which comes to all of a terminal."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        if not hasattr(signal, "pthread_sigmask"):
            return super().submit(fn, *args, **kwargs)
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return super().submit(fn, *args, **kwargs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _enter_worker() -> None:
    """Keep to one BLAS thread, so that sums keep their order; Ctrl-C is the parent's, and its end the worker's."""
    os.environ.update(dict.fromkeys(THREADS, "1"))  # before numpy is imported
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    quicken()
    threading.Thread(target=_leave_with_parent, daemon=True).start()


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
