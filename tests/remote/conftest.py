"""A web server on this machine that hands out parts of files, counts them, and misbehaves when told to."""

from __future__ import annotations

import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar

import pytest

from barpc.base.remote import hosts


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    web: ClassVar[Web]

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
    monkeypatch.setattr(hosts, "TIMEOUT", 2.0)
    folder = tmp_path / "served"
    folder.mkdir()
    found = Web(folder)
    try:
        yield found
    finally:
        found.server.shutdown()
        found.server.server_close()


def drip(handler: _Handler, part: bytes, *_span: int) -> bool:
    """One byte now and then, for ever."""
    handler.send_response(206)
    handler.send_header("Content-Range", "bytes 0-65535/1000000")
    handler.send_header("Content-Length", "65536")
    handler.end_headers()
    for _ in range(100):
        handler.wfile.write(b"x")
        time.sleep(0.2)
    return True
