"""What a kind of file is to the fuzz."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
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
