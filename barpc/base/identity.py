"""Identity of input files: by content, and by the file system's stamp between hashing and reading.

A run hashes its inputs once. From then on the system is asked whether a file is still that one wherever it matters: as
a worker opens it, before a result is kept, before outputs appear. Nothing is read for that.
"""

from __future__ import annotations

import hashlib
import os
import platform
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from barpc.base.errors import InputError
from barpc.base.remote import Remote

_HOST_NAME = platform.node()


@dataclass(frozen=True)
class Stamp:
    """File status by the system: its times change with whatever is written or put in its place."""

    size: int
    mtime_ns: int
    ctime_ns: int
    inode: int
    device: int
    host: str

    @classmethod
    def of(cls, found: os.stat_result) -> Stamp:
        """Return the stamp that `os.stat` gives."""
        return cls(found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino, found.st_dev, _HOST_NAME)

    def times(self) -> tuple[int, int, int]:
        """Return the parts of the stamp that every host sees alike."""
        return self.size, self.mtime_ns, self.ctime_ns

    def matches(self, other: Stamp) -> bool:
        """Return whether both are of one file; the numbers of devices are each host's own."""
        same = self.times() == other.times() and self.inode == other.inode
        return same and (self.host != other.host or self.device == other.device)


@dataclass(frozen=True)
class Input:
    """A hashed file with its parts (the sources of a VRT)."""

    path: str
    size: int
    sha256: str  # of its bytes; of a file on another host of its URL and the version that the host names
    stamp: Stamp | None  # None: on another host, which is asked for that version
    parts: tuple[Input, ...] = ()

    @property
    def key(self) -> str:
        """A hash of all that it is made of."""
        if not self.parts:
            return self.sha256
        return hashlib.sha256(" ".join([self.sha256, *(part.key for part in self.parts)]).encode()).hexdigest()

    def every(self) -> Iterator[Input]:
        """Yield the input itself and its parts."""
        yield self
        for part in self.parts:
            yield from part.every()

    def ask(self) -> None:
        """Raise InputError where the input or a part of it was changed since it was hashed."""
        for one in self.every():
            if one.stamp is not None and not one._same():
                raise changed(one.path)

    def _same(self) -> bool:
        assert self.stamp is not None
        try:
            found = Stamp.of(Path(self.path).stat())
        except OSError:
            return False
        if found.matches(self.stamp) or found == _stamps.get(self.path):
            return True
        # some file systems number a file anew: then its bytes are asked
        if found.times() != self.stamp.times() or fingerprint(self.path).sha256 != self.sha256:
            return False
        _stamps[self.path] = found
        return True


_stamps: dict[str, Stamp] = {}  # files whose bytes were asked by this process


def changed(path: str) -> InputError:
    """Return the error message for a file changed since it was hashed."""
    return InputError(
        f"{path}: was changed or replaced while the run was at work; nothing of it is kept; run the same command again"
    )


def fingerprint(path: str | os.PathLike[str], parts: Iterable[Input] = ()) -> Input:
    """Hash a file; InputError where it changes meanwhile, OSError where it cannot be read."""
    if isinstance(path, Remote):
        text = f"{path} {path.size} {path.tag}"
        return Input(str(path), path.size or 0, hashlib.sha256(text.encode()).hexdigest(), None)
    name = os.fspath(path)
    descriptor = os.open(name, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with open(descriptor, "rb", buffering=0) as file:  # noqa: PTH123  (a pipe would wait, a device has no end)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise InputError(f"{name}: not a regular file")
        before = Stamp.of(os.fstat(file.fileno()))
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        after = Stamp.of(os.fstat(file.fileno()))
    if not before.matches(after):
        raise changed(name)
    noted = (_stamps_of_run.get() or {}).get(name)
    if noted is not None and not noted.matches(before):
        raise changed(name)
    return Input(name, before.size, digest, before, tuple(parts))


# --- what a task may rely on ------------------------------------------------------------------------------

_guard: ContextVar[Mapping[str, Input]] = ContextVar("guard")


@contextmanager
def guarded(inputs: Iterable[Input]) -> Iterator[None]:
    """Register inputs for `ask` within the block; at its good end all are asked again."""
    token = _guard.set({one.path: one for one in inputs})
    try:
        yield
        ask()
    except Exception:
        ask()  # what was half replaced may fail in any way
        raise
    finally:
        _guard.reset(token)


def ask(path: str | os.PathLike[str] | None = None) -> None:
    """Raise InputError where a file in use by the block (None: any of them) was changed since it was hashed."""
    known = _guard.get({})
    for one in known.values() if path is None else filter(None, [known.get(os.fspath(path))]):
        one.ask()


# --- what was read ----------------------------------------------------------------------------------------

_stamps_of_run: ContextVar[dict[str, Stamp] | None] = ContextVar("seen", default=None)


@contextmanager
def recorded(seen: dict[str, Stamp]) -> Iterator[dict[str, Stamp]]:
    """Record every file opened by `barpc.base.safe_io` in the block, with its first state."""
    token = _stamps_of_run.set(seen)
    try:
        yield seen
    finally:
        _stamps_of_run.reset(token)


def note(path: str | os.PathLike[str], found: os.stat_result) -> None:
    """Note that a file was opened; InputError where it is another one than the last time."""
    also_seen({os.fspath(Path(path).absolute()): Stamp.of(found)})


def also_seen(files: Mapping[str, Stamp]) -> None:
    """Note files that were opened here or in another process."""
    seen = _stamps_of_run.get()
    if seen is not None:
        for name, stamp in files.items():
            if not seen.setdefault(name, stamp).matches(stamp):
                raise changed(name)
