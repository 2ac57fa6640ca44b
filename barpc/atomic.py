"""Files written whole or not at all: a temporary name beside the target, fsync, rename.

A run that is killed, or a disk that is full, leaves the target as it was: never half a file. What a killed
run does leave is its temporary file, which `remove_leftovers` clears at the next start.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from barpc.errors import OutputError

_MARK = ".barpc-partial-"
_END = 16  # characters of a name that hold every suffix


@contextmanager
def replacing(path: Path | str, *, overwrite: bool = False, durable: bool = True) -> Iterator[Path]:
    """A temporary path beside `path`, renamed to it when the block ends without an error.

    The temporary name ends as the target's own does, so that what a writer takes from a suffix stays right, and is
    short whatever the target is called.

    Parameters
    ----------
    path : Path or str
        The file to be written; its folder is made where it is missing.
    overwrite : bool
        Replace an existing file.
    durable : bool
        Wait until the file is on the disk; not needed for what can be made again.

    Yields
    ------
    partial : Path
        Write here.

    Raises
    ------
    OutputError
        The file exists and `overwrite` is false, or it cannot be written.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: exists already; choose another name or allow overwriting")
    partial = path.with_name(f"{_MARK}{uuid.uuid4().hex[:12]}-{path.name[-_END:]}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        if durable:
            _sync(partial)
        partial.replace(path)
        if durable:
            _sync(path.parent)
    except OSError as error:
        if isinstance(error, OutputError) or error.errno is None:
            raise
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from error
    finally:
        with suppress(OSError):  # renamed away, or never made
            partial.unlink()


def _sync(path: Path) -> None:
    """Ask the system to put a file, or a folder's entries, on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_bytes(path: Path | str, data: bytes, *, overwrite: bool = False) -> None:
    """Write `data` to `path`, whole or not at all (`replacing`)."""
    with replacing(path, overwrite=overwrite) as partial:
        partial.write_bytes(data)


def write_text(path: Path | str, text: str, *, overwrite: bool = False) -> None:
    """Write `text` to `path` as UTF-8 with the line ends it has, whole or not at all (`replacing`)."""
    write_bytes(path, text.encode(), overwrite=overwrite)


def remove_leftovers(folder: Path | str) -> list[Path]:
    """Delete the temporary files that killed runs left in `folder`; their paths."""
    found = sorted(Path(folder).glob(f"{_MARK}*"))
    for path in found:
        path.unlink(missing_ok=True)
    return found
