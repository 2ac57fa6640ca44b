"""A web server on this machine that hands out parts of files, counts them, and misbehaves when told to."""

from __future__ import annotations

import io
import itertools
import re
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import pytest

from barpc.base.remote import REQUEST_BYTES, Part, Remote, hosts

WIRED = Remote("http://a.org/x.tif")


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    web: ClassVar[Web]

    def setup(self) -> None:
        self.web.counts["connections"] += 1
        super().setup()

    def log_message(self, *_args: object) -> None:
        pass

    def answer(self, status: int, body: bytes = b"", **headers: str) -> None:
        self.send_response(status)
        for name, value in {"Content_Length": str(len(body)), **headers}.items():
            if value:
                self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        with suppress(OSError):
            self.wfile.write(body)

    def do_GET(self) -> None:
        with suppress(OSError):
            self.web.handle(self)


class Web:
    """`mood(handler, data, start, stop, size)` answers in place of the plain answer and returns True, or does not."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.counts, self.seen = folder, Counter[str](), list[str]()
        self.tag = '"one"'
        self.mood: Callable[..., bool | None] | None = None
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"web": self}))
        self.host = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()

    def url(self, name: str) -> str:
        return f"{self.host}/{name}"

    def handle(self, handler: _Handler) -> None:
        self.counts["requests"] += 1
        self.seen.append(handler.path)
        path = self.folder / handler.path.lstrip("/")
        if self.mood is None and not path.is_file():
            handler.answer(404, b"there is no such file")
            return
        data = path.read_bytes() if path.is_file() else b""
        start, stop = map(int, re.fullmatch(r"bytes=(\d+)-(\d+)", handler.headers["Range"]).groups())  # type: ignore[union-attr]
        part = data[start : stop + 1]
        if self.mood is None or not self.mood(handler, part, start, start + len(part), len(data)):
            if not part:
                handler.answer(416, Content_Range=f"bytes */{len(data)}")
                return
            self.counts["bytes"] += len(part)
            self.counts[handler.path] += len(part)
            span = f"bytes {start}-{start + len(part) - 1}/{len(data)}"
            handler.answer(206, part, Content_Range=span, ETag=self.tag)


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Web]:
    monkeypatch.setattr(hosts, "WAITS", (0.0, 0.01, 0.01))
    folder = tmp_path / "served"
    folder.mkdir()
    found = Web(folder)
    try:
        yield found
    finally:
        found.server.shutdown()
        found.server.server_close()


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a second for an answer, and hardly more for its bytes."""
    monkeypatch.setattr(hosts, "TIMEOUT", 0.5)
    monkeypatch.setattr(hosts, "_SLOWEST", 1_000_000)


def drip(handler: _Handler, part: bytes, *_span: int) -> bool:
    """One byte now and then, for ever."""
    handler.send_response(206)
    handler.send_header("Content-Range", "bytes 0-65535/1000000")
    handler.send_header("Content-Length", "65536")
    handler.end_headers()
    for _ in range(100):
        handler.wfile.write(b"x")
        handler.web.counts["dripped"] += 1
        time.sleep(0.2)
    return True


class Sent(io.RawIOBase):
    """What comes over a wire, part by part, as it is asked for."""

    def __init__(self, parts: Iterable[bytes]) -> None:
        self._parts, self._rest = iter(parts), b""

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        self._rest = self._rest or next(self._parts, b"")
        data, self._rest = self._rest[: len(buffer)], self._rest[len(buffer) :]
        buffer[: len(data)] = data
        return len(data)


class Wire:
    """A socket that answers with given bytes, whatever is asked, which it notes."""

    def __init__(self, parts: Iterator[bytes], asked: list[str]) -> None:
        self._parts, self._asked = parts, asked

    def sendall(self, data: bytes) -> None:
        self._asked.append(data.decode())

    def shutdown(self, how: int) -> None: ...
    def close(self) -> None: ...

    def makefile(self, _mode: str) -> io.BufferedReader:
        return io.BufferedReader(Sent(self._parts))


class Fetched:
    """Fetches a part, the first block if none is named, from a server that sends these bytes; notes its requests."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self._sent: Iterator[bytes] = iter(())

    def connection(self, _scheme: str, host: str) -> HTTPConnection:
        made = HTTPConnection(host)
        made.sock = Wire(self._sent, self.asked)  # type: ignore[assignment]
        return made

    def __call__(
        self, *parts: bytes, more: Iterable[bytes] = (), at: Remote = WIRED, start: int = 0, stop: int = REQUEST_BYTES
    ) -> Part:
        self._sent = itertools.chain(parts, more)
        return hosts.fetch(at, start, stop)


def forget() -> None:
    """What was known of stores, and of where they are."""
    for cached in (hosts._store, hosts._open_version, hosts._store_listing):
        cached.cache_clear()
    for module, name in (("s3fs", "S3FileSystem"), ("gcsfs", "GCSFileSystem"), ("adlfs", "AzureBlobFileSystem")):
        if module in sys.modules:
            getattr(sys.modules[module], name).clear_instance_cache()


@pytest.fixture
def forgotten() -> Iterator[None]:
    """No store is known before or after."""
    forget()
    yield
    forget()


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> Fetched:
    found = Fetched()
    monkeypatch.setattr(hosts, "_connection", found.connection)
    monkeypatch.setattr(hosts, "WAITS", ())
    monkeypatch.setattr(hosts, "_idle", {})
    return found
