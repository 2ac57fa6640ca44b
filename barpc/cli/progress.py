"""Progress bars on stderr, and the executors that `-j` asks for."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING

import click

from barpc.cli.terminal import THREADS
from barpc.errors import InputError, visible

if TYPE_CHECKING:
    from click._termui_impl import ProgressBar

    from barpc.tie.tasks import Progress


@contextmanager
def progress_bars(quiet: bool) -> Iterator[Progress]:
    """A callback `progress(stage, done, total)` that draws one bar a stage at a time; silent in pipes and with -q."""
    if quiet or not sys.stderr.isatty():
        yield lambda _stage, _done, _total: None
        return
    bars: dict[str, ProgressBar[int]] = {}

    def finish() -> None:
        for bar in bars.values():
            bar.render_finish()
        bars.clear()

    def show(stage: str, done: int, total: int) -> None:
        if stage not in bars:
            finish()
            label = visible(f"{stage:<22}")
            bars[stage] = click.progressbar(length=total, label=label, show_pos=True, file=sys.stderr)
        bars[stage].length = total
        bars[stage].update(done - bars[stage].pos)

    try:
        yield show
    finally:
        finish()


@contextmanager
def executor_for(jobs: int | str) -> Iterator[Executor | None]:
    """The executor of a run: None works in this process."""
    with (
        nullcontext()
        if jobs == 1
        else _cluster(jobs)
        if isinstance(jobs, str)
        else _processes(jobs) as executor
    ):
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
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_enter_worker)
    try:
        yield pool
    except BaseException:  # an error or Ctrl-C: nobody waits for what is in flight
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.kill()
        raise
    pool.shutdown()


def _enter_worker() -> None:
    """One BLAS thread, so that sums keep their order; Ctrl-C is the parent's, and its end the worker's."""
    os.environ.update(dict.fromkeys(THREADS, "1"))  # before numpy is imported
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    threading.Thread(target=_leave_with_parent, daemon=True).start()


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
