"""Memory and threads of this process: its peak, freed memory returned to the system, one BLAS thread."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import product
from pathlib import Path

_MAPS = Path("/proc/self/maps")
_BLAS_NAMES = [f"{prefix}openblas_%s_num_threads{suffix}" for prefix, suffix in product(("scipy_", ""), ("64_", ""))]


def peak_memory() -> int:
    """Return the peak resident memory [bytes] of this process and its children so far; 0 where unknown."""
    try:
        import resource
    except ImportError:  # not on Windows
        return 0
    scale = 1 if os.uname().sysname == "Darwin" else 1024
    usage = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return max(resource.getrusage(who).ru_maxrss for who in usage) * scale


def give_back() -> None:
    """Return freed memory to the system: glibc keeps pages between blocks that are in use."""
    with suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Hold every OpenBLAS of this process, as the wheels of numpy and scipy bring it, to one thread; Linux alone.

    Several split sums, whose last digits follow their number.
    """
    before = [(keep, read()) for read, keep in _switches()]
    for keep, _ in before:
        keep(1)
    try:
        yield
    finally:
        for keep, count in before:
            keep(count)


def _switches() -> Iterator[tuple[Callable[[], int], Callable[[int], object]]]:
    """Yield getter and setter of the number of threads of each loaded OpenBLAS."""
    lines = _MAPS.read_text().splitlines() if _MAPS.exists() else []
    for path in sorted({line.split(maxsplit=5)[-1] for line in lines if "openblas" in line.rpartition("/")[2]}):
        with suppress(OSError):
            library = ctypes.CDLL(path)
            for name in _BLAS_NAMES:
                if hasattr(library, name % "set"):
                    yield getattr(library, name % "get"), getattr(library, name % "set")
