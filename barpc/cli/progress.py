"""Progress on stderr, bars or lines, and the executors that `-j` asks for."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING

import click

from barpc.cli.terminal import THREADS, say
from barpc.errors import InputError, visible

if TYPE_CHECKING:
    from click._termui_impl import ProgressBar

    from barpc.tie.tasks import Progress


MINUTE = 60.0  # s between two lines where nobody sees bars


@contextmanager
def progress_told(quiet: bool, verbose: int) -> Iterator[Progress]:
    """Yield a callback `progress(stage, done, total)`: bars on a terminal, else and with -v lines; silent with -q."""
    if quiet:
        yield lambda _stage, _done, _total: None
    elif sys.stderr.isatty() and not verbose:
        with _bars() as progress:
            yield progress
    else:
        lines, over = Lines(groups=bool(verbose)), threading.Event()
        threading.Thread(target=lines.watch, args=(over,), daemon=True).start()
        try:
            yield lines
        finally:
            over.set()


class Lines:
    """Says a line a minute where the run is, and with `groups` one for each tenth of a stage, too.

    `clock` tells seconds; `say` takes the line.
    """

    def __init__(
        self,
        groups: bool = False,
        clock: Callable[[], float] = time.monotonic,
        say: Callable[[str], None] = say,
    ) -> None:
        self._groups, self._clock, self._say = groups, clock, say
        self._lock = threading.Lock()
        self._stage, self._done, self._total = "", 0, 1
        self._began = self._said = clock()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Take in what is done."""
        with self._lock:
            if stage != self._stage:
                self._stage, self._done, self._began = stage, 0, self._clock()
            tenth = self._groups and total > 1 and 10 * done // total > 10 * self._done // total
            self._done, self._total = done, total
        self.look(tenth)

    def look(self, now: bool = False) -> None:
        """Say where the run is, if a minute has passed since it was said, or `now`."""
        with self._lock:
            time, spent = self._clock(), self._clock() - self._began
            if not self._stage or not (now or time - self._said >= MINUTE):
                return
            self._said = time
            line = f"{self._stage}: {self._done} of {self._total}"
            if self._total == 1:
                line = f"{self._stage}: at work for {_minutes(spent)}"
            elif self._done:
                line += f", about {_minutes(spent / self._done * (self._total - self._done))} left"
        self._say(line)

    def watch(self, over: threading.Event) -> None:
        """Look every second: a stage that is one task says nothing by itself."""
        while not over.wait(1.0):
            self.look()


def _minutes(seconds: float) -> str:
    for unit, name in ((3600.0, "h"), (60.0, "min")):
        if seconds >= unit:
            return f"{seconds / unit:.1f} {name}"
    return f"{seconds:.0f} s"


@contextmanager
def _bars() -> Iterator[Progress]:
    """Yield one bar a stage at a time, with the time that is left."""
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
    """Yield the executor of a run: None works in this process."""
    if jobs == 1:
        yield None
        return
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
    """Keep to one BLAS thread, so that sums keep their order; Ctrl-C is the parent's, and its end the worker's."""
    os.environ.update(dict.fromkeys(THREADS, "1"))  # before numpy is imported
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    threading.Thread(target=_leave_with_parent, daemon=True).start()


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
