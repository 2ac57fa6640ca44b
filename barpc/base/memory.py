"""Peak memory of this process, and freed memory returned to the system."""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress


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
