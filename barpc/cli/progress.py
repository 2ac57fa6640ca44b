"""Progress bars on stderr, and the executors that `-j` asks for."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from barpc.plain import visible

if TYPE_CHECKING:
    from click._termui_impl import ProgressBar

Progress = Callable[[str, int, int], None]

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@contextmanager
def progress_bars(quiet: bool) -> Iterator[Progress]:
    """A callback `progress(stage, done, total)` that draws one bar a stage at a time; silent in pipes and with -q."""
    if quiet or not sys.stderr.isatty():
        yield lambda _stage, _done, _total: None
        return
    bars: dict[str, ProgressBar[int]] = {}

    def show(stage: str, done: int, total: int) -> None:
        if stage not in bars:
            finish()
            label = visible(f"{stage:<22}")
            bars[stage] = click.progressbar(length=total, label=label, show_pos=True, file=sys.stderr)
        bars[stage].length = total
        bars[stage].update(done - bars[stage].pos)

    def finish() -> None:
        for bar in bars.values():
            bar.render_finish()
        bars.clear()

    try:
        yield show
    finally:
        finish()


@contextmanager
def executor_for(jobs: int | str) -> Iterator[Executor | None]:
    """The executor of a run: None works in this process."""
    if isinstance(jobs, str):
        with _cluster(jobs) as executor:
            yield executor
    elif jobs > 1:
        with _processes(jobs) as executor:
            yield executor
    else:
        yield None


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    from barpc.errors import InputError

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
    """Worker processes with one BLAS thread each: the work is spread by processes, and sums keep their order."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_enter_worker)
    try:
        yield pool
    except BaseException:  # an error or Ctrl-C: nobody waits for what is in flight
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.kill()
        raise
    else:
        pool.shutdown()
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _enter_worker() -> None:
    """Leave Ctrl-C to the parent, and end when the parent is gone, however it went."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    threading.Thread(target=_leave_with_parent, daemon=True).start()


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
