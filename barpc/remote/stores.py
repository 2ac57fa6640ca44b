"""Parts of files from object stores, by fsspec: it knows their credentials and addresses as every tool does."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Mapping
from functools import cache, lru_cache
from typing import Any

from barpc.remote import Part, Remote

_NAMES = {"s3": "s3fs", "gs": "gcsfs", "az": "adlfs"}
_S3 = {"connect_timeout": 10, "read_timeout": 30, "retries": {"max_attempts": 3}}
_OPEN = 64  # files
_LISTED = 60  # s that the list of a folder is used for: the images in it are loaded one after the other


@cache
def _store(scheme: str) -> Any:
    try:
        import fsspec

        given = {"config_kwargs": _S3} if scheme == "s3" else {}
        return fsspec.filesystem(scheme, use_listings_cache=False, **given)
    except ImportError as error:
        raise OSError(
            f"{scheme}:// needs the extra: pip install 'barpc[remote]' ({_NAMES[scheme]} is missing)"
        ) from error
    except Exception as error:  # no credentials
        raise _one_line(error) from error


class _Opened:
    """An object of one version, as its store opens it."""

    def __init__(self, at: Remote) -> None:
        store = _store(at.partition(":")[0])
        self._lock, self._store, self._url = threading.Lock(), store, str(at)
        self._file = _told(store.open, str(at), "rb", cache_type="none")
        found = _told(store.info, str(at))
        if found.get("type") == "directory":
            raise OSError("a folder")
        self.version = _version(found)

    def read(self, start: int, stop: int) -> bytes:
        with self._lock:
            _told(self._file.seek, start)
            data = bytes(_told(self._file.read, stop - start))
            if not self._url.startswith("s3:"):  # s3fs asks for bytes of the version that it opened
                self.require(*_version(_told(self._store.info, self._url)))
            return data

    def require(self, size: int, tag: str) -> None:
        if self.version != (size, tag):
            raise OSError("it was changed in its store while it was read; run the same command again")


def _version(found: Mapping[str, Any]) -> tuple[int, str]:
    tags = (found.get(key) for key in ("ETag", "etag", "generation", "mtime", "LastModified", "last_modified"))
    return int(found["size"]), str(next(filter(None, tags), ""))


@lru_cache(_OPEN)
def _pinned(url: str, size: int, tag: str) -> _Opened:
    found = _Opened(Remote(url))
    found.require(size, tag)
    return found


def fetch(at: Remote, start: int, stop: int) -> Part:
    """Return the bytes `start` to `stop` of a file, or to its end; OSError where the store does not hand them out."""
    file = _Opened(at) if at.size is None else _pinned(str(at), at.size, at.tag)
    size, tag = file.version
    wanted = max(0, min(stop, size) - start)
    data = file.read(start, start + wanted) if wanted else b""
    if len(data) != wanted:
        raise OSError(f"its store sent {len(data)} of {wanted} bytes")
    return Part(data, size, tag)


def beside(image: Remote, names: Iterable[str]) -> dict[str, str]:
    """See `barpc.remote.beside`."""
    wanted = {name.lower() for name in names}
    present = _listed(image.parent, int(time.monotonic() / _LISTED))
    return {name.lower(): name for name in present if name.lower() in wanted}


@lru_cache(8)
def _listed(folder: str, _minute: int) -> tuple[str, ...]:
    found = _told(_store(folder.partition(":")[0]).ls, folder, detail=False)
    return tuple(sorted(str(path).rpartition("/")[2] for path in found))


def _told(ask: Any, *args: Any, **given: Any) -> Any:
    """Return a store's answer; errors of its many classes become an OSError of one line."""
    try:
        return ask(*args, **given)
    except FileNotFoundError as error:
        raise FileNotFoundError("its store has no such object or bucket") from error
    except Exception as error:
        raise _one_line(error) from error


def _one_line(error: Exception) -> OSError:
    first = next(iter(str(error).strip().splitlines()), "")  # Azure adds the whole answer
    return OSError(f"its store answers {type(error).__name__}: {first[:300]}")
