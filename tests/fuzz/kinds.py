"""What a kind of file is to the fuzz."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from .mutate import Mutate


@dataclass(frozen=True)
class Sample:
    """A kind of file.

    Parameters
    ----------
    name : str
        What the file is called, which its errors must name.
    read : callable
        Its reader, and whatever meets the values first.
    data : callable
        The bytes of a good file.
    mutations : tuple of callable
        Beside damage to bytes.
    beside : callable
        Puts what the file needs beside it into a folder, once.
    share : float
        Part of a sample's usual runs, for slow readers.
    """

    name: str
    read: Callable[[Path], object]
    data: Callable[[], bytes]
    mutations: tuple[Mutate, ...] = ()
    beside: Callable[[Path], object] = lambda folder: None
    share: float = 1.0


def bytes_of(write: Callable[[Path], Path]) -> Callable[[], bytes]:
    """The bytes of a file that is written into a folder and named, once a process."""

    def made() -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            return write(Path(folder)).read_bytes()

    return cache(made)
