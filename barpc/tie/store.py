"""Where results lie that travel by reference: workers write and read them, the caller only knows their names.

All access goes through `Store`: a folder on a disk that all see.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from barpc import identity
from barpc.errors import InputError
from barpc.frozen import Arrays, load_npz, replacing


@dataclass(frozen=True)
class Store:
    """A folder that every worker sees under the same path."""

    folder: str
    room: str  # for files on their way, on the same disk

    scratch = "arrays"  # where names of a run that need not outlive it begin

    def write(self, name: str, arrays: Arrays) -> None:
        """Write named arrays, whole or not at all; not if a file that they were made of has changed."""
        identity.ask()
        path = Path(self.folder) / f"{name}.npz"
        with (
            replacing(path, overwrite=True, durable=False, room=Path(self.room)) as partial,
            partial.open("wb") as file,
        ):
            np.savez(file, **arrays)  # type: ignore[arg-type]

    def read(self, name: str) -> Arrays | None:
        """Read the arrays of a name; None where it is missing or damaged."""
        path = Path(self.folder) / f"{name}.npz"
        try:
            return None if path.is_symlink() or not path.is_file() else load_npz(path)
        except (OSError, ValueError, InputError):
            return None

    def need(self, name: str) -> Arrays:
        """Return the arrays of a name that was written before; InputError where this worker does not find it."""
        found = self.read(name)
        if found is None:
            raise InputError(
                f"{self.folder}/{name}.npz: a worker cannot read it; images and run folder must be on a disk that all "
                "workers see under the same path"
            )
        return found

    def clear(self) -> None:
        """Remove what lies under `scratch`."""
        shutil.rmtree(Path(self.folder) / self.scratch, ignore_errors=True)


@contextmanager
def store_of(executor: Executor | None) -> Iterator[Store]:
    """Yield the executor's store (`barpc.pipeline.executor`), or a temporary one."""
    given: Store | None = getattr(executor, "store", None)
    if given is not None:
        yield given
        return
    with tempfile.TemporaryDirectory(prefix="barpc-") as folder:
        yield Store(folder, folder)


def names_of(executor: Executor | None, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> list[str]:
    """Return names for results, by the content of inputs where the executor knows it, so that a later run
    finds them.
    """
    key = getattr(executor, "key", None)
    names = (key(function, task) if key else number for number, task in enumerate(tasks))
    return [f"{function.__name__}/{name}" for name in names]
