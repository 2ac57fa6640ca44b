"""Parts of files from web servers, by range requests of the standard library, and from object stores, by fsspec.

A server is not trusted: it answers for the bytes that were asked or not at all, within a time, and sends nobody on.
fsspec knows the stores' credentials and addresses as every tool does.
"""

from __future__ import annotations

import atexit
import io
import os
import re
import socket
import ssl
import threading
import time
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from functools import cache, lru_cache, partial
from http.client import HTTPConnection, HTTPException, HTTPResponse, HTTPSConnection
from itertools import chain
from typing import Any, BinaryIO
from urllib.parse import quote, urljoin, urlsplit

from barpc.base.errors import visible
from barpc.base.remote import REQUEST_BYTES, Part, Remote


def fetch(at: Remote, start: int, stop: int) -> Part:
    """Return the bytes `start` to `stop` of a file, or to its end; OSError where its host does not hand them out."""
    return (_from_server if at.startswith("http") else _from_store)(at, start, stop)


def present_beside(image: Remote, names: Iterable[str]) -> dict[str, str]:
    """Return the names of those of these files that are in an image's folder, by name in lower case.

    A store lists the folder, and case does not count; a web server is asked for each name as it is and with its ending
    in lower case.
    """
    if not image.startswith("http"):
        wanted = {name.lower() for name in names}
        present = _store_listing(image.parent, int(time.monotonic() / _LISTED))
        return {name.lower(): name for name in present if name.lower() in wanted}
    tried: dict[str, str] = {}
    for name in dict.fromkeys(names):
        cut = name.rfind("_RPC.") if "_RPC." in name else name.rfind(".")
        tried |= dict.fromkeys((name, name[:cut] + name[cut:].lower()), name.lower())
    with ThreadPoolExecutor() as pool:
        found = dict(zip(tried, pool.map(lambda name: _there(image.parent / name), tried), strict=True))
    return {tried[name]: name for name, there in reversed(found.items()) if there}


def _there(at: Remote) -> bool:
    try:
        fetch(at, 0, 1)
    except FileNotFoundError:
        return False
    return True


# --- web servers ------------------------------------------------------------------------------------------

WAITS = (0.0, 0.5, 2.0)
"""Before each new attempt [s]."""
TIMEOUT = 30.0  # s without a byte, and for an answer without its bytes
_SLOWEST = 10_000  # bytes a second, on top of TIMEOUT
_AGAIN = (408, 425, 429, 500, 502, 503, 504)
_ELSEWHERE = (301, 302, 303, 307, 308)
_MOVES = 3
_EXTRA = 1 << 20  # bytes of an answer beside its data, whose chunks may be of one byte: these take six
_UNQUOTED = "/%:@!$&'()*+,;=~"  # characters that stand in an address as they are

_idle: dict[tuple[int, str, str], list[HTTPConnection]] = {}  # process (a fork shares no socket), scheme, host
_lock = threading.Lock()


class _PassingError(OSError):
    """An error that may be over at the next attempt."""


def _from_server(at: Remote, start: int, stop: int) -> Part:
    for wait in (*WAITS, None):
        try:
            return _fetch_redirected(at, start, stop)
        except _PassingError as error:
            if wait is None:
                raise OSError(f"{error}; asked {len(WAITS) + 1} times") from error
            time.sleep(wait)
    raise AssertionError


def _fetch_redirected(at: str, start: int, stop: int) -> Part:
    """Fetch once; a server may redirect within itself."""
    url = at
    for _ in range(_MOVES):
        found = _once(url, start, stop)
        if isinstance(found, Part):
            return found
        try:
            url = urljoin(url, found)
            same = urlsplit(url)[:2] == urlsplit(at)[:2]
        except ValueError as error:
            raise OSError(f"its host sends us on to what is no address ({visible(found[:200])})") from error
        if not same:
            raise OSError(f"its host sends us on to {visible(url[:200])}, which is not followed; give that address")
    raise OSError("its host sends us on and on")


def _once(url: str, start: int, stop: int) -> Part | str:
    """Return the part, or the address where it is said to be."""
    scheme, host, path, query = urlsplit(url)[:4]
    connection = _connection(scheme, host)
    connection.response_class = partial(_response, _EXTRA + 6 * (stop - start))  # type: ignore[assignment]
    longest, late = TIMEOUT + (stop - start) / _SLOWEST, threading.Event()
    limit = threading.Timer(longest, _shut_down, (connection.sock, late))
    limit.start()
    again = False
    try:
        connection.request(
            "GET",
            quote(path, safe=_UNQUOTED) + (f"?{quote(query, safe=_UNQUOTED + '?')}" if query else ""),
            headers={"Range": f"bytes={start}-{stop - 1}", "Accept-Encoding": "identity"},
        )
        with closing(connection.getresponse()) as answer:
            found = _answered(answer, start, stop)
            again = answer.isclosed() and not answer.will_close
    except (HTTPException, ValueError, TimeoutError, ConnectionError, ssl.SSLError, _PassingError) as error:
        if late.is_set():  # however the cut shows: as an end, as a reset
            raise _PassingError(f"its host takes more than {longest:.3g} s for {stop - start} bytes") from error
        if isinstance(error, _PassingError):
            raise
        raise _PassingError(f"its host broke off ({type(error).__name__})") from error
    finally:
        limit.cancel()
        if again:
            with _lock:
                _idle.setdefault((os.getpid(), scheme, host), []).append(connection)
        else:
            connection.close()
    if found is None:
        raise FileNotFoundError(f"its host answers {answer.status}")
    return found


class _Wire(io.RawIOBase):
    """The response of a server up to a number of bytes: http.client reads headers and chunks without limit."""

    def __init__(self, sent: BinaryIO, most: int) -> None:
        self._sent, self._left = sent, most

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._sent.read1(min(len(buffer), self._left))  # type: ignore[attr-defined]
        if not self._left:
            raise _PassingError("its host sends more than was asked, and goes on")
        buffer[: len(data)] = data
        self._left -= len(data)
        return len(data)

    def close(self) -> None:
        self._sent.close()
        super().close()


def _response(most: int, *args: Any, **given: Any) -> HTTPResponse:
    answer = HTTPResponse(*args, **given)
    answer.fp = io.BufferedReader(_Wire(answer.fp, most))
    return answer


def _shut_down(connected: socket.socket, late: threading.Event) -> None:
    late.set()
    with suppress(OSError):
        connected.shutdown(socket.SHUT_RDWR)


@atexit.register
def _close() -> None:
    for connection in chain(*_idle.values()):
        connection.close()


def _connection(scheme: str, host: str) -> HTTPConnection:
    with _lock:
        if kept := _idle.get((os.getpid(), scheme, host)):
            return kept.pop()
    connection = (HTTPConnection if scheme == "http" else HTTPSConnection)(host, timeout=TIMEOUT)
    try:
        connection.connect()
    except ssl.SSLCertVerificationError as error:
        raise OSError(f"its host has no certificate that holds ({error.verify_message})") from error
    except OSError as error:
        raise _PassingError(f"no answer from its host ({error.strerror or error})") from error
    return connection


def _answered(answer: HTTPResponse, start: int, stop: int) -> Part | str | None:
    """Return a server's response, the address that it redirects to, or None where there is no such file."""
    status, length = answer.status, answer.headers.get("Content-Length", "")
    tag = answer.headers.get("ETag") or answer.headers.get("Last-Modified") or ""
    if status in _AGAIN:
        raise _PassingError(f"its host answers {status}")
    if status in _ELSEWHERE:
        return answer.headers.get("Location", "")
    if status in (404, 410):
        answer.read(REQUEST_BYTES)  # so that the connection can be used again
        return None
    if answer.headers.get("Content-Encoding", "identity") != "identity":
        raise OSError("its host sends it compressed, though that was not asked")
    if status == 416 and answer.headers.get("Content-Range", "").replace(" ", "") == "bytes*/0":
        return Part(b"", 0, tag)
    if status == 200 and start == 0 and re.fullmatch(r"\d{1,9}", length) and int(length) <= stop:
        return Part(_body(answer, int(length)), int(length), tag)
    if status == 200:
        raise OSError("its host hands out no parts of files (range requests); fetch it, and give the copy")
    if status != 206:
        raise OSError(f"its host answers {status}")
    return _part_of(answer, start, stop, tag)


def _part_of(answer: HTTPResponse, start: int, stop: int, tag: str) -> Part:
    """Return the bytes that were asked for, or to the end of the file; OSError for others."""
    found = re.fullmatch(r"bytes (\d{1,18})-(\d{1,18})/(\d{1,18})", answer.headers.get("Content-Range", ""))
    first, last, size = map(int, found.groups()) if found else (0, 0, 0)
    wanted = min(stop, size) - start
    stated = answer.headers.get("Content-Length", "")
    if (first, last + 1) != (start, start + wanted) or wanted < 1 or stated not in ("", str(wanted)):
        raise OSError("its host answers with other bytes than were asked")
    return Part(_body(answer, wanted), size, tag)


def _body(answer: HTTPResponse, wanted: int) -> bytes:
    """Read a given number of bytes, and no more."""
    data = answer.read(wanted)
    if len(data) != wanted:
        raise _PassingError(f"its host sent {len(data)} of {wanted} bytes")
    return data


# --- stores -----------------------------------------------------------------------------------------------

_STORE_PACKAGES = {"s3": "s3fs", "gs": "gcsfs", "az": "adlfs"}
_S3 = {"connect_timeout": 10, "read_timeout": 30, "retries": {"max_attempts": 3}}
_LISTED = 60  # s that the list of a folder is used for: the images in it are loaded one after the other


@cache
def _store(scheme: str) -> Any:
    try:
        import fsspec

        given = {"config_kwargs": _S3} if scheme == "s3" else {}
        return fsspec.filesystem(scheme, use_listings_cache=False, **given)
    except ImportError as error:
        raise OSError(
            f"{scheme}:// needs the extra: pip install 'barpc[remote]' ({_STORE_PACKAGES[scheme]} is missing)"
        ) from error
    except Exception as error:  # no credentials
        raise _store_error(error) from error


class _Opened:
    """An object of one version, as its store opens it."""

    def __init__(self, at: Remote) -> None:
        store = _store(at.partition(":")[0])
        self._lock, self._store, self._url = threading.Lock(), store, str(at)
        self._file = _store_answer(store.open, str(at), "rb", cache_type="none")
        found = _store_answer(store.info, str(at))
        if found.get("type") == "directory":
            raise OSError("a folder")
        self.version = _store_answer(_version, found)

    def read(self, start: int, stop: int) -> bytes:
        with self._lock:
            _store_answer(self._file.seek, start)
            data = bytes(_store_answer(self._file.read, stop - start))
            if not self._url.startswith("s3:"):  # s3fs asks for bytes of the version that it opened
                self.require(*_store_answer(_version, _store_answer(self._store.info, self._url)))
            return data

    def require(self, size: int, tag: str) -> None:
        if self.version != (size, tag):
            raise OSError("it was changed in its store while it was read; run the same command again")


def _version(found: Mapping[str, Any]) -> tuple[int, str]:
    tags = (found.get(key) for key in ("ETag", "etag", "generation", "mtime", "LastModified", "last_modified"))
    return int(found["size"]), str(next(filter(None, tags), ""))


@lru_cache
def _open_version(url: str, size: int, tag: str) -> _Opened:
    found = _Opened(Remote(url))
    found.require(size, tag)
    return found


def _from_store(at: Remote, start: int, stop: int) -> Part:
    file = _Opened(at) if at.size is None else _open_version(str(at), at.size, at.tag)
    size, tag = file.version
    wanted = max(0, min(stop, size) - start)
    data = file.read(start, start + wanted) if wanted else b""
    if len(data) != wanted:
        raise OSError(f"its store sent {len(data)} of {wanted} bytes")
    return Part(data, size, tag)


@lru_cache(8)
def _store_listing(folder: str, _minute: int) -> tuple[str, ...]:
    found = _store_answer(_store(folder.partition(":")[0]).ls, folder, detail=False)
    return tuple(sorted(str(path).rpartition("/")[2] for path in found))


def _store_answer(ask: Any, *args: Any, **given: Any) -> Any:
    """Return a store's answer; errors of its many classes become an OSError of one line."""
    try:
        return ask(*args, **given)
    except FileNotFoundError as error:
        raise FileNotFoundError("its store has no such object or bucket") from error
    except Exception as error:
        raise _store_error(error) from error


def _store_error(error: Exception) -> OSError:
    first = next(iter(str(error).strip().splitlines()), "")  # Azure adds the whole answer
    return OSError(f"its store answers {type(error).__name__}: {first[:300]}")
