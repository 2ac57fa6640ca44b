"""Files on other hosts: named by URL, read by parts, and only where the user allowed the host.

A `Remote` is made in one place, `located`, of what the user gives, and it is what every reader asks for: a text that
happens to name a URL - in a VRT, a list, a side file - opens nothing. It travels with the tasks, so that no worker has
settings of its own, and knows the version of the file, so that all workers read the same bytes or say that it changed.
"""

from __future__ import annotations

import io
import os
import re
import threading
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from ipaddress import IPv6Address
from pathlib import Path, PurePath, PurePosixPath
from typing import Any

from barpc.base.errors import ImageError

HOST_PATTERN = re.compile(r"(?:(?:https?|s3|gs|az)://)?(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:]+\])(?::\d{1,5})?")
"""An entry of the list of hosts: a host is that of https; http, and the buckets of object stores, say so."""
_URL = re.compile(r"(https?|s3|gs|az)://([^/?#]+)/([^?#]+)", re.IGNORECASE)
_FLATTENED_URL = re.compile(r"(?:https?|s3|gs|az):/[^/]")  # what pathlib makes of a URL

REQUEST_BYTES = 1 << 16  # bytes that are asked for at a time, at least
_AHEAD = 1 << 20  # bytes read ahead, at most, of a file that is read in a row
_MAX_REQUEST_BYTES = 8 << 20  # bytes of a request, at most
_CACHE_BYTES = 64 << 20  # bytes of blocks that a process keeps


class Remote(str):
    """A URL that may be opened, and the version of the file it was found to have; has the properties of a path's name.

    `size` [bytes] and `tag` (ETag, or time of change) are of that version; None and empty before it was asked for.
    """

    size: int | None
    tag: str

    def __new__(cls, url: str, size: int | None = None, tag: str = "") -> Remote:
        """For `located` and those who have a `Remote` only."""
        made = super().__new__(cls, url)
        made.size, made.tag = size, tag
        return made

    def __getnewargs__(self) -> tuple[str, int | None, str]:  # type: ignore[override]  # pickle asks for it
        return str(self), self.size, self.tag

    @property
    def pure(self) -> PurePosixPath:
        """Host and path, as a path."""
        return PurePosixPath("/" + self.partition("://")[2])

    name = property(lambda self: self.pure.name)
    stem = property(lambda self: self.pure.stem)
    suffix = property(lambda self: self.pure.suffix)

    @property
    def parent(self) -> Remote:
        """The folder."""
        return Remote(self.rpartition("/")[0])

    def __truediv__(self, name: str) -> Remote:
        return Remote(f"{self}/{name}")

    def absolute(self) -> Remote:
        """Return the URL itself: every URL is absolute."""
        return self

    def resolve(self) -> Remote:
        """Return the URL itself: no link leads elsewhere."""
        return self

    def is_dir(self) -> bool:
        """Return False: folders are not opened."""
        return False

    def is_file(self) -> bool:
        """Return True: a missing file shows when it is read."""
        return True


PathOrUrl = Path | Remote


def is_url(text: str | os.PathLike[str]) -> bool:
    """Return whether a text names a file on another host, and none here."""
    found = re.match(r"(https?|s3|gs|az)://", os.fspath(text), re.IGNORECASE)
    return found is not None and not os.path.lexists(text)


def location(path: str | os.PathLike[str]) -> PathOrUrl:
    """Return the location of a file: a Remote unchanged, any other text as a local path."""
    return path if isinstance(path, Remote) else Path(path)


def here(names: Iterable[str | os.PathLike[str]]) -> list[Path]:
    """Return those files that are on this machine."""
    return [Path(name) for name in names if not isinstance(name, Remote)]


def pure(file: PathOrUrl) -> PurePath:
    """Return a file's folders and name; of a Remote its host and path."""
    return file.pure if isinstance(file, Remote) else file


def located(path: str | os.PathLike[str], hosts: Iterable[str]) -> PathOrUrl:
    """Return a name that the user gave as `location` does; a URL of a host among `hosts` becomes a Remote.

    ImageError for a URL that is refused: its host is not among them, or it holds a user, a query or a fragment.
    """
    text = os.fspath(path)
    if _FLATTENED_URL.match(text) and not os.path.lexists(text):
        raise ImageError(f"{text}: a URL that went through a Path has lost a slash; give it as text")
    if isinstance(path, Remote) or not is_url(text):
        return location(path)
    found = _URL.fullmatch(text)
    if found is None or not HOST_PATTERN.fullmatch(found[2]) or not _is_host(found[2]):
        raise ImageError(
            f"{text}: a URL is SCHEME://HOST/PATH without user and query, which would be written into outputs"
        )
    scheme, host, rest = found[1].lower(), found[2], found[3]
    known = {entry.lower() if "://" in entry else f"https://{entry.lower()}" for entry in hosts}
    if f"{scheme}://{host.lower()}" not in known:
        entry = host if scheme == "https" else f"{scheme}://{host}"
        raise ImageError(f"{text}: remote files are read where you say so: give --allow-remote {entry}")
    return Remote(f"{scheme}://{host}/{rest}")


def _is_host(text: str) -> bool:
    """Return whether a host and its port can be asked: labels of a name, a number in brackets, a port that there is."""
    name, _, port = text.rpartition(":") if re.search(r":\d+$", text) else (text, "", "80")
    if name.startswith("["):
        try:
            IPv6Address(name[1:-1])
        except ValueError:
            return False
        return 0 < int(port) < 1 << 16
    return all(0 < len(label) < 64 for label in name.removesuffix(".").split(".")) and 0 < int(port) < 1 << 16


# --- reading ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """Bytes of a file, and the version that they are of."""

    data: bytes
    size: int
    tag: str


def _fetch_part(at: Remote, start: int, stop: int) -> Part:
    from barpc.base.remote.hosts import fetch

    return fetch(at, start, stop)


_BlockKey = tuple[str, int | None, str, int]


class _BlockCache:
    """The blocks that this process read last."""

    def __init__(self) -> None:
        self._lock, self._held, self._bytes = threading.Lock(), OrderedDict[_BlockKey, bytes](), 0

    def get(self, key: _BlockKey) -> bytes | None:
        with self._lock:
            if key in self._held:
                self._held.move_to_end(key)
            return self._held.get(key)

    def put(self, key: _BlockKey, data: bytes) -> None:
        with self._lock:
            self._bytes += len(data) - len(self._held.pop(key, b""))
            self._held[key] = data
            while self._bytes > _CACHE_BYTES:
                self._bytes -= len(self._held.popitem(last=False)[1])


_blocks = _BlockCache()


def pinned(at: Remote) -> Remote:
    """Return a file with the version that it has now; OSError where there is none, or it does not answer."""
    if at.size is not None:
        return at
    part = _fetch_part(at, 0, REQUEST_BYTES)
    if not part.tag:
        raise OSError("its host names no version of it (ETag, Last-Modified), so it might change unseen; fetch it")
    found = Remote(at, part.size, part.tag)
    _blocks.put((str(found), found.size, found.tag, 0), part.data)
    return found


class RemoteFile(io.RawIOBase):
    """A file on another host, for reading: OSError where it does not answer, or is no longer the same."""

    def __init__(self, at: PathOrUrl) -> None:
        super().__init__()
        assert isinstance(at, Remote)
        self._at = pinned(at)
        self.size, self._position, self._end, self._ahead = self._at.size or 0, 0, 0, 0

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        """Move to where the next byte is read, and return that place."""
        self._position = max(0, offset + (0, self._position, self.size)[whence])
        return self._position

    def readinto(self, buffer: Any) -> int:
        """Read as many bytes as the buffer takes, up to the end of the file."""
        start = min(self._position, self.size)
        data = self._read(start, min(start + len(buffer), self.size))
        buffer[: len(data)] = data
        self._position = start + len(data)
        return len(data)

    def _read(self, start: int, stop: int) -> bytes:
        if start == stop:
            return b""
        first, last = start // REQUEST_BYTES, (stop - 1) // REQUEST_BYTES
        found = {i: self._known(i) for i in range(first, last + 1)}
        missing = [i for i, data in found.items() if data is None]
        if missing:  # a file that is read in a row is asked for twice as much each time
            self._ahead = min(2 * self._ahead + REQUEST_BYTES, _AHEAD) if start == self._end else 0
            for run in _runs(missing):
                found |= self._asked(run.start, run.stop, self._ahead if run.stop == last + 1 else 0)
        self._end = stop
        data = b"".join(found[i] or b"" for i in range(first, last + 1))
        return data[start - first * REQUEST_BYTES : stop - first * REQUEST_BYTES]

    def _known(self, block: int) -> bytes | None:
        return _blocks.get((str(self._at), self._at.size, self._at.tag, block))

    def _asked(self, first: int, last: int, ahead: int) -> dict[int, bytes | None]:
        most = last + ahead // REQUEST_BYTES
        end = next((i for i in range(last, most) if self._known(i) is not None), most)
        start, stop = first * REQUEST_BYTES, min(end * REQUEST_BYTES, self.size)
        part = _fetch_part(self._at, start, stop)
        if (part.size, part.tag) != (self._at.size, self._at.tag):
            raise OSError("it was changed on its host while it was read; run the same command again")
        cut = {
            first + i // REQUEST_BYTES: part.data[i : i + REQUEST_BYTES] for i in range(0, stop - start, REQUEST_BYTES)
        }
        for block, data in cut.items():
            _blocks.put((str(self._at), self._at.size, self._at.tag, block), data)
        return dict(cut)


def _runs(blocks: list[int]) -> Iterator[range]:
    """Yield the ascending numbers as ranges, none of more bytes than a request has."""
    start = before = blocks[0]
    for block in [*blocks[1:], -1]:
        if block != before + 1 or (block - start) * REQUEST_BYTES >= _MAX_REQUEST_BYTES:
            yield range(start, before + 1)
            start = block
        before = block


def beside(image: Remote, names: Iterable[str]) -> dict[str, str]:
    """See `barpc.base.remote.hosts.present_beside`."""
    from barpc.base.remote.hosts import present_beside as look

    return look(image, names)
