"""One BLAS thread, so that sums keep their order: several split them, and last digits follow their number."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import product
from pathlib import Path

_MAPS = Path("/proc/self/maps")
_NAMES = [f"{prefix}openblas_%s_num_threads{suffix}" for prefix, suffix in product(("scipy_", ""), ("64_", ""))]


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Hold every OpenBLAS of this process, as the wheels of numpy and scipy bring it, to one thread; Linux alone."""
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
            for name in _NAMES:
                if hasattr(library, name % "set"):
                    yield getattr(library, name % "get"), getattr(library, name % "set")
