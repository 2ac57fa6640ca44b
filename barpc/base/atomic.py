"""Files are written whole or not at all."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from barpc.base.errors import OutputError

_MARK = ".barpc-partial-"
STATE, PARTIAL = ".barpc", "partial"
"""Where a run folder keeps what is on its way, and is emptied at the next start: nothing there need last."""


@contextmanager
def replacing(
    path: Path | str, *, overwrite: bool = False, durable: bool = True, room: Path | None = None
) -> Iterator[Path]:
    """Yield a temporary path for `path`, renamed to it when the block ends without an error.

    It has the target's own name, in a folder of its own: what a writer takes from a name stays right, however long.
    In a run folder's room, where everything is on its way already, it is the path itself.

    Parameters
    ----------
    path : Path or str, the file to be written; its folder is made where it is missing
    overwrite : bool, replace an existing file, else an OutputError
    durable : bool, wait until the file is on the disk; what can be made again need not, nor has a folder of its own
    room : Path, optional, where the temporary folder is made, on the same disk; None: beside `path`
    """
    path = Path(path)
    refuse_existing(path, overwrite)
    place = (room or path.parent) / f"{_MARK}{uuid.uuid4().hex[:12]}"
    partial = place / path.name if durable else place
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if f"/{STATE}/{PARTIAL}/" in path.as_posix():
            yield path
            return
        partial.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        if durable:
            _sync(partial)
        refuse_existing(path, overwrite)  # it may have come while the block was at work
        partial.replace(path)
        if durable:
            _sync(path.parent)
    except OSError as error:
        if isinstance(error, OutputError) or error.errno is None:
            raise
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from error
    finally:
        try:
            place.rmdir() if durable else place.unlink(missing_ok=True)
        except FileNotFoundError:  # it was not needed
            pass
        except OSError:  # something is left in it
            shutil.rmtree(place, ignore_errors=True)


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Raise an OutputError where a file would be replaced that may not be."""
    if not overwrite and os.path.lexists(path):
        raise OutputError(f"{path}: exists already; choose another name or allow overwriting")


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_text(path: Path | str, text: str, *, overwrite: bool = False) -> None:
    """Write `text` to `path` as UTF-8 with the line ends it has, whole or not at all (`replacing`)."""
    with replacing(path, overwrite=overwrite) as partial:
        partial.write_bytes(text.encode())
