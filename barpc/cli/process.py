"""The process of the command: its standard streams, which may be closed or full, and the signals that end it."""

from __future__ import annotations

import atexit
import io
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from barpc.base.atomic import STATE
from barpc.base.errors import OutputError

if TYPE_CHECKING:
    from barpc.base.tasks import Progress

EXIT_INTERRUPTED = 130
INTERRUPTED = "interrupted"
CLEAN_UP = 2.0
"""Seconds after a first signal in which more of them change nothing: `timeout` and batch systems send two at once."""


# --- streams ----------------------------------------------------------------------------------------------


class _Stream(io.FileIO):
    """Stdout or stderr. What cannot be written to stdout is an error once; what stderr does not take is lost."""

    _lost = False

    def write(self, data: Any, /) -> int:
        try:
            if not self._lost:
                return super().write(data)
        except OSError as error:
            self._lost = True
            if self.fileno() == 1:
                if isinstance(error, BrokenPipeError):
                    raise
                kept = "what was written to files is whole"
                raise OutputError(f"stdout: cannot be written ({error.strerror}); {kept}") from error
        return len(data)


def hold_streams() -> None:
    """Give a closed standard stream the null device, before a file of the run gets its number; hold the others."""
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        stream = getattr(sys, name)
        if stream is None:
            stream = open(os.devnull, mode, encoding="utf-8", errors="replace")  # noqa: PTH123, SIM115
            os.set_inheritable(stream.fileno(), True)  # of workers, too
            setattr(sys, name, stream)
            continue
        buffer = getattr(stream, "buffer", None)
        raw = getattr(buffer, "raw", buffer)
        if mode == "w" and type(raw) is io.FileIO and raw.fileno() == number:  # not the console of Windows
            held = io.BufferedWriter(_Stream(number, mode, closefd=False))
            how = {"encoding": stream.encoding, "errors": stream.errors, "line_buffering": stream.line_buffering}
            setattr(sys, name, io.TextIOWrapper(held, write_through=stream.write_through, **how))


class Kept:
    """Results of an interrupted verb that are kept, in words: of a run with a `folder` those of finished tasks."""

    folder: Path | None = None
    stage = "its start"

    def __str__(self) -> str:
        if self.folder is None or not any((self.folder / STATE / "cache").glob("*/*.npz")):
            return "nothing was kept"
        return f"finished tasks are kept: the same command goes on at {self.stage}"

    def following(self, progress: Progress) -> Progress:
        """Return a progress that stores the stage, too."""

        def follow(stage: str, done: int, total: int) -> None:
            self.stage = stage
            progress(stage, done, total)

        return follow


# --- signals ----------------------------------------------------------------------------------------------

_at_last: list[Callable[[], None]] = []


@atexit.register
def _leave() -> None:
    """Exit handler that runs after those of libraries: it is registered before they are imported."""
    for work in _at_last:
        work()


class Interrupt:
    """Handler of SIGINT and SIGTERM: the first raises KeyboardInterrupt, one after `CLEAN_UP` ends the process."""

    def __init__(self) -> None:
        self._came: float | None = None
        self._code, self._said = EXIT_INTERRUPTED, f"barpc: {INTERRUPTED}\n".encode()

    def __call__(self, _number: int, _frame: FrameType | None) -> None:
        """Take a signal."""
        now = time.monotonic()
        if self._came is None:
            self._came = now
            raise KeyboardInterrupt
        if now > self._came + CLEAN_UP:
            with suppress(OSError):
                os.write(2, self._said)
            os._exit(self._code)

    def end(self) -> bool:
        """Let no further signal raise; return whether one had come."""
        came, self._came = self._came is not None, time.monotonic()
        return came

    def done(self, code: int) -> None:
        """Store the exit code of the finished command."""
        self.end()
        self._code, self._said = code, b""

    @property
    def ended(self) -> bool:
        """Whether a signal ended the command."""
        return self._code == EXIT_INTERRUPTED and not self._said

    def leave(self, numbers: Iterable[int]) -> None:
        """Ignore signals from now on, as the last exit handler: Python then restores their default actions."""
        for number in numbers:
            signal.signal(number, signal.SIG_IGN)
        if self.ended:
            os._exit(self._code)  # Python ends itself by SIGINT where one came to code that `exec` ran


@contextmanager
def interruptible(own: bool) -> Iterator[Interrupt]:
    """Let SIGTERM, as batch systems send it, end a command in the same way as Ctrl-C; yield what takes both.

    Where the process is the command's `own` it is taken until Python has ended.
    """
    interrupt, before = Interrupt(), dict[int, Any]()
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
        if before[signal.SIGINT] is not signal.default_int_handler:  # a shell's background job ignores it
            del before[signal.SIGINT]
        for number in before:
            signal.signal(number, interrupt)
    if own:
        _at_last.append(partial(interrupt.leave, tuple(before)))
    try:
        yield interrupt
    finally:
        if own and interrupt.ended:  # Python's threads may find pipes of workers closed, and say so after that
            sys.unraisablehook = lambda _: None
        for number, handler in () if own else before.items():
            signal.signal(number, handler)
