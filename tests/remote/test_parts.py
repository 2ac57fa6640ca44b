"""Which parts of a file are asked for and kept, and what each answer of a host means: without any host."""

from __future__ import annotations

import io
import itertools
import os
import ssl
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import nullcontext
from typing import Any

import pytest

from barpc.base import remote
from barpc.base.remote import REQUEST_BYTES, Part, Remote, RemoteFile, hosts, is_url, location

AT = Remote("https://a.org/b/x.tif", 70 * REQUEST_BYTES + 5, "one")


# --- names ------------------------------------------------------------------------------------------------


def test_a_url_is_as_absolute_as_can_be_and_no_folder():
    assert AT.absolute() is AT
    assert not AT.is_dir()
    assert (Remote("s3://b/x").size, Remote("s3://b/x").tag) == (None, "")


def test_a_name_that_lies_here_is_no_url(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert is_url("s3://b/x")
    assert not is_url("ftp://b/x")
    (tmp_path / "s3:/b").mkdir(parents=True)
    (tmp_path / "s3:/b/x").write_text("x")
    assert not is_url("s3://b/x")
    assert not isinstance(location("s3://b/x"), Remote)
    assert location(AT) is AT


def test_a_file_has_the_version_that_it_is_found_to_have(server):
    (server.folder / "new.tif").write_bytes(b"x" * 7 * REQUEST_BYTES)
    server.tag = "v"
    found = remote.pinned(Remote(server.url("new.tif")))
    assert (found.size, found.tag, server.counts["bytes"]) == (7 * REQUEST_BYTES, "v", REQUEST_BYTES)
    assert RemoteFile(found).read(10) == b"x" * 10  # the first block is kept
    assert remote.pinned(found) is found
    assert server.counts["requests"] == 1
    server.tag = ""
    with pytest.raises(OSError, match="names no version"):
        remote.pinned(Remote(server.url("new.tif")))


# --- blocks -----------------------------------------------------------------------------------------------

names = (f"https://a.org/{k}/x.tif" for k in itertools.count())


def block(k: int, size: int = REQUEST_BYTES) -> bytes:
    return bytes([k % 251]) * size


@pytest.fixture
def asked(monkeypatch) -> list[tuple[int, int]]:
    """The parts, in blocks, that are asked of files whose every byte says its block."""
    parts: list[tuple[int, int]] = []

    def fetch(at, start, stop):
        first, last = start // REQUEST_BYTES, -(-stop // REQUEST_BYTES)
        parts.append((first, last))
        return Part(b"".join(map(block, range(first, last)))[: stop - start], at.size, "one")

    monkeypatch.setattr(hosts, "fetch", fetch)
    return parts


def new(blocks: int = 70) -> Remote:
    """A file of so many blocks and five bytes, of which nothing is kept yet."""
    return Remote(next(names), blocks * REQUEST_BYTES + 5, "one")


def read_blocks(file: RemoteFile, first: int, last: int) -> None:
    file.seek(first * REQUEST_BYTES)
    assert file.read((last - first) * REQUEST_BYTES) == b"".join(map(block, range(first, last)))


def test_what_is_read_here_and_there_is_asked_for_block_by_block(asked):
    file = RemoteFile(new())
    assert (file.readable(), file.seekable()) == (True, True)
    for where in (9, 3, 15):
        assert file.seek(where * REQUEST_BYTES + 7) == where * REQUEST_BYTES + 7
        assert file.read(2) == block(where, 2)
    assert asked == [(9, 10), (3, 4), (15, 16)]
    read_blocks(file, 2, 5)
    assert asked[3:] == [(2, 3), (4, 5)]  # not the one that it has
    file.seek(2 * REQUEST_BYTES - 1)
    assert file.read(2) == b"\1\2"
    assert asked[5:] == [(1, 2)]


def test_a_file_that_is_read_in_a_row_is_asked_for_twice_as_much_each_time_and_a_mebibyte_ahead_at_most(asked):
    file = RemoteFile(new())
    assert [file.read(REQUEST_BYTES) for _ in range(70)] == [block(k) for k in range(70)]
    assert file.read(99) == block(70, 5)  # its end
    assert file.read(99) == b""
    assert asked == [(0, 2), (2, 6), (6, 14), (14, 30), (30, 47), (47, 64), (64, 71)]


def test_nothing_is_read_ahead_that_is_there(asked):
    at = new()
    read_blocks(RemoteFile(at), 4, 5)
    file = RemoteFile(at)
    assert [file.read(REQUEST_BYTES) for _ in range(4)] == [block(k) for k in range(4)]
    assert asked == [(4, 5), (0, 2), (2, 4)]


def test_a_place_is_counted_from_the_start_from_here_or_from_the_end(asked):
    at = new()
    file = RemoteFile(at)
    assert file.seek(-4, os.SEEK_END) == 70 * REQUEST_BYTES + 1
    assert file.seek(2, os.SEEK_CUR) == 70 * REQUEST_BYTES + 3
    assert file.read() == bytes([70]) * 2
    assert file.seek(-10) == 0
    assert file.seek(99 * REQUEST_BYTES) == 99 * REQUEST_BYTES
    assert file.read(5) == b""
    assert file.tell() == 70 * REQUEST_BYTES + 5
    assert io.BufferedReader(RemoteFile(at)).read(3) == b"\0\0\0"


def test_a_file_that_changed_is_noticed(server):
    (server.folder / "x").write_bytes(block(0))
    url, size, tag = server.url("x"), REQUEST_BYTES, server.tag
    assert RemoteFile(Remote(url, size, tag)).read(1) == b"\0"
    for other in (Remote(url, size, "two"), Remote(url, size + REQUEST_BYTES, tag)):
        with pytest.raises(OSError, match="changed on its host"):
            RemoteFile(other).read(1)


def test_blocks_are_asked_for_together_but_not_more_than_eight_mebibytes(asked):
    file = RemoteFile(new(400))
    for first, last in ((3, 4), (5, 7)):
        read_blocks(file, first, last)
    read_blocks(file, 1, 9)
    assert asked == [(3, 4), (5, 7), (1, 3), (4, 5), (7, 9)]
    asked.clear()
    read_blocks(file, 10, 310)
    assert asked == [(10, 138), (138, 266), (266, 310)]


def test_the_64_mebibytes_that_were_used_last_are_kept(asked):
    file = RemoteFile(new(1100))
    read_blocks(file, 1, 1025)
    read_blocks(file, 1, 2)  # so it is newer than the second
    read_blocks(file, 1050, 1051)
    asked.clear()
    for kept in (1, 3, 1024, 1050):
        read_blocks(file, kept, kept + 1)
    assert asked == []
    read_blocks(file, 2, 3)
    assert asked == [(2, 3)]


# --- answers of web servers -------------------------------------------------------------------------------


def http(status: int, body: bytes = b"", **headers: str) -> bytes:
    lines = "".join(f"{name.replace('_', '-')}: {value}\r\n" for name, value in headers.items())
    return f"HTTP/1.1 {status} x\r\n{lines}\r\n".encode() + body


SPAN = {"Content_Range": "bytes 10-13/20"}
WHOLE = {**SPAN, "Content_Length": "4"}
GOOD = http(206, b"abcd", **WHOLE)


@pytest.mark.parametrize(
    ("answer", "start", "found"),
    [
        (http(206, b"abcdef", ETag="t", **WHOLE), 10, Part(b"abcd", 20, "t")),
        (http(206, b"abcd", Last_Modified="d", **WHOLE), 10, Part(b"abcd", 20, "d")),
        (http(206, b"abcd", ETag="t", Last_Modified="d", **WHOLE), 10, Part(b"abcd", 20, "t")),
        (http(206, b"abcd", Content_Encoding="identity", **SPAN), 10, Part(b"abcd", 20, "")),
        (http(206, b"ab", Content_Range="bytes 10-11/12"), 10, Part(b"ab", 12, "")),  # the end of the file
        (http(200, b"abcd", Content_Length="4", ETag="t"), 0, Part(b"abcd", 4, "t")),  # all that was asked
        (http(200, b"ab", Content_Length="2"), 0, Part(b"ab", 2, "")),
        (http(416, Content_Range="bytes */0", ETag="t"), 0, Part(b"", 0, "t")),  # an empty file
    ],
)
def test_the_part_that_was_asked_comes_with_its_version(fetched, answer, start, found):
    assert fetched(answer, start=start, stop=start + 4) == found


@pytest.mark.parametrize(
    ("answer", "start", "said"),
    [
        *((http(status), 10, f"answers {status}; asked 1 times") for status in (408, 425, 429, 500, 502, 503, 504)),
        *((http(k, Content_Range="bytes */9"), 10, f"answers {k}$") for k in (204, 304, 400, 405, 416, 451, 501, 505)),
        (http(416, Content_Range="bytes */1"), 0, "answers 416$"),
        (http(206, b"abc", **SPAN), 10, "3 of 4 bytes; asked 1 times"),
        (http(206, b"abcd", Content_Encoding="gzip", **SPAN), 10, "compressed"),
        *(
            (http(206, b"abcdef", Content_Range=span, Content_Length=length), 10, "other bytes")
            for span, length in [
                ("bytes 9-12/20", "4"), ("bytes 10-14/20", "4"), ("bytes 10-12/20", "3"), ("bytes 10-13/20", "5"),
                ("bytes 10-13/10", "4"), ("bytes 10-9/10", "0"), ("bytes 10-13/*", "4"), ("10-13/20", "4"), ("", "4"),
                ("bytes 10-13/" + "9" * 19, "4"), ("bytes 10-13/" + "9" * 5000, "4"), ("bytes  10-13/20", "4"),
            ]
        ),
        *((http(206, b"abcd", Content_Length=length), 0, "other bytes") for length in ("", "1", "4")),
        (http(206, b"abcd", Content_Range="bytes 0-0/0", Content_Length="4"), 0, "other bytes"),
        *(
            (http(200, b"abcde", Content_Length=length), start, "no parts of files")
            for length, start in (("5", 0), ("4", 1), ("", 0), ("x", 0), ("0" * 10, 0))
        ),
    ],
)  # fmt: skip
def test_any_other_answer_is_an_error_and_asked_again_where_it_may_pass(fetched, answer, start, said):
    with pytest.raises(OSError, match=said):
        fetched(answer, start=start, stop=start + 4)


@pytest.mark.parametrize("status", [404, 410])
def test_a_missing_file_is_told_apart(fetched, status):
    with pytest.raises(FileNotFoundError):
        fetched(http(status, b"no such file"))


# --- asking again, moving, keeping connections ------------------------------------------------------------


def moved(to: str, status: int = 302) -> bytes:
    return http(status, Location=to, Content_Length="0")


def fails(error: BaseException) -> Iterator[bytes]:
    """What is sent by a host of which a read fails."""
    raise error
    yield b""


def test_it_is_asked_four_times_with_longer_waits(monkeypatch, fetched):
    waited: list[float] = []
    monkeypatch.undo()
    monkeypatch.setattr(time, "sleep", waited.append)
    monkeypatch.setattr("http.client.HTTPSConnection.connect", lambda _: next(fails(ConnectionRefusedError("no"))))
    with pytest.raises(OSError, match=r"no answer from its host \(no\); asked 4 times"):
        hosts.fetch(AT, 0, 1)
    assert waited == [0.0, 0.5, 2.0]


@pytest.mark.parametrize(
    ("moves", "asked"),
    [
        ([("/1", 301), ("2", 303)], ["/b/x.tif", "/1", "/2"]),
        ([("http://a.org/b.tif?key=a/b&n=1", 307), ("", 308)], ["/b/x.tif", *["/b.tif?key=a/b&n=1"] * 2]),
    ],
)
def test_a_move_is_followed_within_its_host_and_takes_the_query_along(fetched, moves, asked):
    at = Remote("http://a.org/b/x.tif")
    assert fetched(*(moved(*one) for one in moves), GOOD, at=at, start=10, stop=14).data == b"abcd"
    assert [words.split()[1] for words in fetched.asked] == asked


@pytest.mark.parametrize(
    ("moves", "said"),
    [
        (["/1", "/2", "/3"], "on and on"), (["https://a.org/x"], "not followed"),
        (["http://b.org/x"], r"sends us on to http://b\.org/x, which is not followed"),
        (["//b.org/x"], "not followed"), (["http://[bad/"], r"sends us on to what is no address \(http://\[bad/\)"),
        (["http://b.org/" + "x" * 900], "not followed"),
    ],
)  # fmt: skip
def test_three_moves_are_too_many_and_none_leads_to_another_host(fetched, moves, said):
    with pytest.raises(OSError, match=said) as caught:
        fetched(*map(moved, moves), GOOD, start=10, stop=14)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    ("name", "target"),
    [
        ("b/my x(1).tif", "/b/my%20x(1).tif"), ("x y.tif?k=a/b&n=ü", "/x%20y.tif?k=a/b&n=%C3%BC"), ("x.tif", "/x.tif"),
    ],
)  # fmt: skip
def test_a_request_asks_for_the_bytes_as_they_are(fetched, name, target):
    assert fetched(GOOD, at=Remote(f"http://a.org/{name}"), start=10, stop=14).data == b"abcd"
    assert fetched.asked == [
        f"GET {target} HTTP/1.1\r\nHost: a.org\r\nRange: bytes=10-13\r\nAccept-Encoding: identity\r\n\r\n"
    ]


def test_a_connection_is_kept_that_was_read_out_and_stays_open(server, monkeypatch):
    (server.folder / "x").write_bytes(b"abcdefgh")

    def ask() -> int:
        """Ask for a part; how many connections were made until then."""
        assert hosts.fetch(Remote(server.url("x")), 0, 4).data == b"abcd"
        return server.counts["connections"]

    assert [ask(), ask()] == [1, 1]
    pid = os.getpid()
    with monkeypatch.context() as fork:  # nothing of another process is used
        fork.setattr(os, "getpid", lambda: pid + 1)
        assert ask() == 2
    headers = {"Content_Range": "bytes 0-3/8", "ETag": "x"}
    for k, mood in enumerate((
        lambda handler, part, *_: handler.answer(206, part, Connection="close", **headers) or True,
        lambda handler, part, *_: handler.answer(206, part + b"efgh", Content_Length="8", **headers) or True,
    )):  # fmt: skip
        server.mood = mood
        with pytest.raises(OSError, match="other bytes") if k else monkeypatch.context():
            ask()
        server.mood = None
        assert [ask(), ask()] == [k + 3, k + 3]


def test_all_that_is_kept_is_closed_at_the_end(server, monkeypatch):
    (server.folder / "x").write_bytes(b"abcd")
    hosts.fetch(Remote(server.url("x")), 0, 4)
    closed: list[str] = []
    monkeypatch.setattr("http.client.HTTPConnection.close", lambda self: closed.append(f"{self.host}:{self.port}"))
    hosts._close()
    assert server.host.removeprefix("http://") in closed


@pytest.mark.parametrize("error", [TimeoutError(), ConnectionResetError(), ssl.SSLError("x")])
def test_a_host_that_breaks_off_may_do_better_next_time(fetched, error):
    with pytest.raises(OSError, match=rf"broke off \({type(error).__name__}\); asked 1 times"):
        fetched(more=fails(error))


def test_a_wrong_certificate_does_not_pass(monkeypatch):
    wrong = ssl.SSLCertVerificationError("x")
    wrong.verify_message = "self-signed"
    monkeypatch.setattr("http.client.HTTPSConnection.connect", lambda _: next(fails(wrong)))
    with pytest.raises(OSError, match=r"no certificate that holds \(self-signed\)$"):
        hosts.fetch(Remote("https://a.org/x"), 0, 4)


@pytest.mark.parametrize("shown", [ConnectionResetError(104, "reset"), TimeoutError(), None])
def test_a_request_has_a_time_that_grows_with_its_bytes_however_its_end_shows(fetched, monkeypatch, shown):
    given: list[Any] = []

    class Timer:
        def __init__(self, seconds, function, arguments):
            self.function, self.arguments = function, arguments
            given.append(seconds)

        def start(self):
            given.append("start")
            if late:
                self.function(*self.arguments)

        def cancel(self):
            given.append("cancel")

    monkeypatch.setattr(threading, "Timer", Timer)
    late = False
    fetched(GOOD, start=10, stop=14)
    late = True
    with pytest.raises(OSError, match="takes more than 30 s for 4 bytes; asked 1 times"):
        fetched(http(206, b"", **WHOLE), more=fails(shown) if shown else (), start=10, stop=14)
    assert given == [30.0 + 4 / 10_000, "start", "cancel"] * 2


def test_side_files_are_asked_for_as_named_and_with_their_ending_in_lower_case(server):
    for name in ("img_rpc.txt", "img.RPB", "img_RPC.geom"):
        (server.folder / name).write_bytes(b"abcd")
    image = Remote(server.url("img.tif"))
    found = remote.beside(image, ["img_RPC.TXT", "img.RPB", "img.xml", "img_RPC.geom"])
    every = ["img.RPB", "img.rpb", "img.xml", "img_RPC.TXT", "img_RPC.geom", "img_rpc.geom", "img_rpc.txt"]
    assert sorted(server.seen) == [f"/{name}" for name in every]
    assert server.counts["bytes"] == 3  # one of each
    assert found == {"img_rpc.txt": "img_rpc.txt", "img.rpb": "img.RPB", "img_rpc.geom": "img_RPC.geom"}
    (server.folder / "img.rpb").write_bytes(b"x")
    assert remote.beside(image, ["img.RPB"]) == {"img.rpb": "img.RPB"}  # the name as it is goes first


# --- object stores ----------------------------------------------------------------------------------------


class Shelf:
    """A store of objects by URL; counts what it is asked."""

    def __init__(self, **objects: bytes) -> None:
        self.objects = {f"s3://b/{name}": data for name, data in objects.items()}
        self.asked: list[tuple[Any, ...]] = []
        self.made: list[tuple[str, dict[str, Any]]] = []
        self.kind = "file"

    def filesystem(self, scheme, **given):
        """As fsspec makes one."""
        self.made.append((scheme, given))
        return self

    def info(self, url):
        self.asked.append(("info", url))
        return {"size": len(self.objects[url]), "ETag": "e", "type": self.kind}

    def open(self, url, mode, cache_type):
        self.asked.append(("open", url))
        if url not in self.objects:
            raise FileNotFoundError
        return io.BytesIO(self.objects[url])

    def ls(self, folder, detail):
        self.asked.append(("ls", folder, detail))
        return [url.partition("://")[2] for url in self.objects]


@pytest.fixture
def shelf(monkeypatch, forgotten) -> Shelf:
    found = Shelf(x=b"0123456789", Y_RPC=b"", Z=b"")
    monkeypatch.setitem(sys.modules, "fsspec", found)
    return found


STORED = Remote("s3://b/x")


def test_a_part_of_an_object_ends_where_it_does(shelf):
    assert hosts.fetch(STORED, 2, 5) == Part(b"234", 10, "e")
    assert hosts.fetch(STORED, 8, 99) == Part(b"89", 10, "e")
    assert hosts.fetch(STORED, 10, 99) == hosts.fetch(STORED, 12, 99) == Part(b"", 10, "e")
    shelf.asked.clear()
    known = Remote("s3://b/x", 10, "e")
    for _ in range(3):
        assert hosts.fetch(known, 0, 4).data == b"0123"
    assert shelf.asked == [("open", "s3://b/x"), ("info", "s3://b/x")]  # opened once
    for size, tag in ((11, "e"), (10, "f")):
        with pytest.raises(OSError, match="changed in its store"):
            hosts.fetch(Remote("s3://b/x", size, tag), 0, 4)
    with pytest.raises(FileNotFoundError, match="no such object or bucket"):
        hosts.fetch(Remote("s3://b/none"), 0, 4)
    shelf.kind = "directory"
    with pytest.raises(OSError, match="a folder"):
        hosts.fetch(STORED, 0, 4)


@pytest.mark.parametrize(("scheme", "noticed"), [("gs", True), ("az", True), ("s3", False)])
def test_a_version_is_looked_at_after_each_read_where_the_store_does_not_hold_it(shelf, scheme, noticed):
    at, tags = f"{scheme}://b/x", iter("11112")
    shelf.objects[at], shelf.info = bytes(20), lambda _: {"size": 20, "etag": next(tags)}
    assert hosts.fetch(Remote(at), 0, 10).tag == "1"
    known = Remote(at, 20, "1")
    assert hosts.fetch(known, 0, 10).data == bytes(10)
    with pytest.raises(OSError, match="changed in its store") if noticed else nullcontext():
        assert hosts.fetch(known, 10, 20).data == bytes(10)


def test_an_object_that_is_cut_short_is_noticed(shelf):
    shelf.info = lambda _: {"size": 99, "ETag": "e"}
    with pytest.raises(OSError, match="its store sent 8 of 18 bytes"):
        hosts.fetch(STORED, 2, 20)


@pytest.mark.parametrize(
    ("found", "version"),
    [
        ({"size": "7", "ETag": "a", "etag": "b"}, "a"), ({"size": 7, "ETag": "", "etag": "b"}, "b"),
        ({"size": 7, "generation": 5, "mtime": 9}, "5"), ({"size": 7, "mtime": 9}, "9"),
        ({"size": 7, "LastModified": "d"}, "d"), ({"size": 7, "last_modified": "d"}, "d"), ({"size": 7}, ""),
    ],
)  # fmt: skip
def test_a_version_has_many_names(shelf, found, version):
    shelf.info = lambda _: found
    assert hosts.fetch(STORED, 0, 2) == Part(b"01", 7, version)


def test_the_files_beside_an_object_are_listed_once_a_minute(shelf, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    assert remote.beside(STORED, ["y_rpc", "X", "other"]) == {"y_rpc": "Y_RPC", "x": "x"}
    now[0] = 59.0
    remote.beside(STORED, ["z"])
    assert shelf.asked == [("ls", "s3://b", False)]
    now[0] = 61.0
    assert remote.beside(STORED, ["z"]) == {"z": "Z"}
    assert len(shelf.asked) == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [("x" * 999, "x" * 300), ("", ""), ("\nrefused\n<xml>\n  <RequestId>1</RequestId>", "refused")],
)
def test_what_a_store_says_is_its_first_line_of_300_letters_at_most_and_may_be_nothing(shelf, words, said):
    shelf.info = lambda _: next(fails(ValueError(words)))
    with pytest.raises(OSError, match=f"^its store answers ValueError: {said}$"):
        hosts.fetch(STORED, 0, 4)


def test_a_store_is_made_with_limits_of_time_and_without_a_list_of_its_own(shelf):
    shelf.objects["gs://b/x"] = b"0123456789"
    for at in (STORED, STORED, Remote("gs://b/x")):
        assert hosts.fetch(at, 0, 4).data == b"0123"
    limits = {"connect_timeout": 10, "read_timeout": 30, "retries": {"max_attempts": 3}}
    assert shelf.made == [
        ("s3", {"use_listings_cache": False, "config_kwargs": limits}),
        ("gs", {"use_listings_cache": False}),
    ]
    shelf.filesystem = lambda *_, **__: next(fails(RuntimeError("no credentials\nat all")))
    with pytest.raises(OSError, match=r"its store answers RuntimeError: no credentials$"):
        hosts.fetch(Remote("az://b/x"), 0, 4)
