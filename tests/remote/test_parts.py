"""Which parts of a file are asked for and kept, and what each answer of a host means: without any host."""

from __future__ import annotations

import io
import os
import ssl
import sys
from email.message import Message
from http.client import HTTPException
from types import SimpleNamespace
from typing import Any

import pytest

from barpc.base import remote
from barpc.base.remote import (
    REQUEST_BYTES,
    Part,
    Remote,
    RemoteFile,
    _BlockCache,
    _runs,
    beside,
    hosts,
    is_url,
    location,
)

AT = Remote("https://a.org/b/x.tif", 20 * REQUEST_BYTES + 5, "one")


# --- names ------------------------------------------------------------------------------------------------


def test_a_url_is_as_absolute_as_can_be_and_no_folder():
    assert AT.absolute() is AT
    assert not AT.is_dir()
    assert (AT.name, AT.stem, AT.suffix, str(AT.parent), str(AT.parent / "y")) == (
        "x.tif", "x", ".tif", "https://a.org/b", "https://a.org/b/y",
    )  # fmt: skip
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


def test_a_file_has_the_version_that_it_is_found_to_have(monkeypatch):
    asked = []

    def fetch(at, start, stop):
        asked.append((start, stop))
        return Part(b"x" * REQUEST_BYTES, 7 * REQUEST_BYTES, tag)

    monkeypatch.setattr(remote, "_fetch_part", fetch)
    tag = "v"
    found = remote.pinned(Remote("https://a.org/new.tif"))
    assert (found.size, found.tag, asked) == (7 * REQUEST_BYTES, "v", [(0, REQUEST_BYTES)])
    assert RemoteFile(found).read(10) == b"x" * 10  # the first block is kept
    assert remote.pinned(found) is found
    assert len(asked) == 1
    tag = ""
    with pytest.raises(OSError, match="names no version"):
        remote.pinned(Remote("https://a.org/new.tif"))


# --- blocks -----------------------------------------------------------------------------------------------


@pytest.fixture
def asked(monkeypatch) -> list[tuple[int, int]]:
    """The parts, in blocks, that are asked of a file whose every byte says its block."""
    parts: list[tuple[int, int]] = []

    def fetch(at, start, stop):
        parts.append((start // REQUEST_BYTES, -(-stop // REQUEST_BYTES)))
        data = b"".join(bytes([k]) * REQUEST_BYTES for k in range(start // REQUEST_BYTES, -(-stop // REQUEST_BYTES)))
        return Part(data[: stop - start], AT.size or 0, "one")

    monkeypatch.setattr(remote, "_fetch_part", fetch)
    monkeypatch.setattr(remote, "_blocks", _BlockCache())
    return parts


def test_what_is_read_here_and_there_is_asked_for_block_by_block(asked):
    file = RemoteFile(AT)
    assert (file.readable(), file.seekable()) == (True, True)
    for where in (9, 3, 15):
        assert file.seek(where * REQUEST_BYTES + 7) == where * REQUEST_BYTES + 7
        assert file.read(2) == bytes([where]) * 2
    assert asked == [(9, 10), (3, 4), (15, 16)]
    assert file._ahead == 0
    file.seek(2 * REQUEST_BYTES)
    assert (
        file.read(3 * REQUEST_BYTES)
        == bytes([2]) * REQUEST_BYTES + bytes([3]) * REQUEST_BYTES + bytes([4]) * REQUEST_BYTES
    )
    assert asked[3:] == [(2, 3), (4, 5)]  # not the one that it has
    file.seek(2 * REQUEST_BYTES - 1)
    assert file.read(2) == b"\1\2"
    assert asked[5:] == [(1, 2)]


def test_a_file_that_is_read_in_a_row_is_asked_for_twice_as_much_each_time(asked):
    file = RemoteFile(AT)
    data = [file.read(REQUEST_BYTES) for _ in range(20)]
    assert data == [bytes([k]) * REQUEST_BYTES for k in range(20)]
    assert file.read(99) == bytes([20]) * 5  # its end
    assert file.read(99) == b""
    assert asked == [(0, 2), (2, 6), (6, 14), (14, 21)]


def test_no_more_than_a_mebibyte_is_read_ahead_and_nothing_that_is_there(asked, monkeypatch):
    file = RemoteFile(AT)
    file._ahead = remote._AHEAD
    file.read(1)
    assert asked == [(0, 17)]  # one, and sixteen ahead
    blocks = _BlockCache()
    monkeypatch.setattr(remote, "_blocks", blocks)
    blocks.put((str(AT), AT.size, AT.tag, 4), b"\4" * REQUEST_BYTES)
    file = RemoteFile(AT)
    file._ahead = remote._AHEAD
    assert file.read(5 * REQUEST_BYTES)[-1] == 4
    assert asked[1:] == [(0, 4)]


def test_a_place_is_counted_from_the_start_from_here_or_from_the_end(asked):
    file = RemoteFile(AT)
    assert file.seek(-4, os.SEEK_END) == 20 * REQUEST_BYTES + 1
    assert file.seek(2, os.SEEK_CUR) == 20 * REQUEST_BYTES + 3
    assert file.read() == bytes([20]) * 2
    assert file.seek(-10) == 0
    assert file.seek(99 * REQUEST_BYTES) == 99 * REQUEST_BYTES
    assert file.read(5) == b""
    assert file.tell() == 20 * REQUEST_BYTES + 5
    assert io.BufferedReader(RemoteFile(AT)).read(3) == b"\0\0\0"


def test_a_file_that_changed_is_noticed(asked):
    for other in (Remote(str(AT), AT.size, "two"), Remote(str(AT), (AT.size or 0) + REQUEST_BYTES, "one")):
        with pytest.raises(OSError, match="changed on its host"):
            RemoteFile(other).read(1)


def test_blocks_are_asked_for_together_but_not_more_than_eight_mebibytes():
    assert list(_runs([3])) == [range(3, 4)]
    assert list(_runs([1, 2, 4, 7, 8])) == [range(1, 3), range(4, 5), range(7, 9)]
    assert [len(run) for run in _runs(list(range(300)))] == [128, 128, 44]
    assert (remote.REQUEST_BYTES, remote._AHEAD, remote._MAX_REQUEST_BYTES, remote._CACHE_BYTES) == (
        1 << 16,
        1 << 20,
        8 << 20,
        64 << 20,
    )


def test_the_blocks_that_were_used_last_are_kept(monkeypatch):
    monkeypatch.setattr(remote, "_CACHE_BYTES", 30)
    blocks = _BlockCache()
    keys: list[Any] = [("x", 1, "t", k) for k in range(5)]
    for key in keys[:3]:
        blocks.put(key, b"0123456789")
    assert blocks.get(keys[0]) == b"0123456789"  # so it is newer than the second
    blocks.put(keys[3], b"0123456789")
    assert [blocks.get(key) is not None for key in keys[:4]] == [True, False, True, True]
    blocks.put(keys[2], b"01234")  # in place of what was there
    blocks.put(keys[4], b"01234")
    assert [blocks.get(key) is not None for key in keys] == [True, False, True, True, True]
    assert blocks._bytes == 30


def test_web_servers_and_stores_are_asked_in_their_own_ways(monkeypatch):
    monkeypatch.setattr(hosts, "_from_server", lambda *args: ("web", *args))
    monkeypatch.setattr(hosts, "_from_store", lambda *args: ("store", *args))
    monkeypatch.setattr(hosts, "_there", lambda at: at.endswith("a"))
    monkeypatch.setattr(hosts, "_store_listing", lambda folder, _: ("A", "b"))
    store = Remote("s3://b/x")
    assert remote._fetch_part(AT, 1, 2) == ("web", AT, 1, 2)
    assert remote._fetch_part(store, 1, 2) == ("store", store, 1, 2)
    assert beside(AT, ["a"]) == {"a": "a"}
    assert beside(store, ["a"]) == {"a": "A"}


# --- answers of web servers -------------------------------------------------------------------------------


class Answer:
    """A server's answer."""

    def __init__(self, status: int, body: bytes = b"", **headers: str) -> None:
        self.status, self.headers, self._body = status, Message(), io.BytesIO(body)
        self.asked: list[int] = []
        for name, value in headers.items():
            self.headers[name.replace("_", "-")] = value

    def read(self, size: int) -> bytes:
        self.asked.append(size)
        return self._body.read(size)


def told(answer: Answer, start: int = 10, stop: int = 14) -> Any:
    return hosts._answered(answer, start, stop)  # type: ignore[arg-type]


def test_the_figures_of_patience():
    assert (hosts.WAITS, hosts.TIMEOUT, hosts._SLOWEST, hosts._MOVES) == ((0.0, 0.5, 2.0), 30.0, 10_000, 3)


@pytest.mark.parametrize("status", [408, 425, 429, 500, 502, 503, 504])
def test_what_may_pass_is_said_to(status):
    with pytest.raises(hosts._PassingError, match=str(status)):
        told(Answer(status))


@pytest.mark.parametrize("status", [100, 204, 304, 400, 403, 405, 416, 451, 501, 505])
def test_what_will_not_pass_is_no_such_error(status):
    with pytest.raises(OSError, match=f"answers {status}") as caught:
        told(Answer(status, Content_Range="bytes */9"))
    assert not isinstance(caught.value, hosts._PassingError)


@pytest.mark.parametrize("status", [301, 302, 303, 307, 308])
def test_a_move_is_told_by_its_address(status):
    assert told(Answer(status, Location="/x")) == "/x"
    assert told(Answer(status)) == ""


@pytest.mark.parametrize("status", [404, 410])
def test_a_missing_file_is_none_and_its_words_are_read(status):
    answer = Answer(status, b"no such file")
    assert told(answer) is None
    assert answer.asked == [1 << 16]


def test_a_part_is_what_was_asked_with_its_version():
    whole = {"Content_Range": "bytes 10-13/20", "Content_Length": "4"}
    assert told(Answer(206, b"abcdef", ETag="t", **whole)) == Part(b"abcd", 20, "t")
    assert told(Answer(206, b"abcd", Last_Modified="d", **whole)) == Part(b"abcd", 20, "d")
    assert told(Answer(206, b"abcd", ETag="t", Last_Modified="d", **whole)).tag == "t"
    assert told(Answer(206, b"ab", Content_Range="bytes 10-11/12")) == Part(b"ab", 12, "")  # the end of the file
    with pytest.raises(hosts._PassingError, match="3 of 4 bytes"):
        told(Answer(206, b"abc", **whole))


@pytest.mark.parametrize(
    ("span", "length"),
    [
        ("bytes 9-12/20", "4"), ("bytes 10-14/20", "4"), ("bytes 10-12/20", "3"), ("bytes 10-13/20", "5"),
        ("bytes 10-13/10", "4"), ("bytes 10-9/10", "0"), ("bytes 10-13/*", "4"), ("10-13/20", "4"), ("", "4"),
        ("bytes 10-13/" + "9" * 19, "4"), ("bytes  10-13/20", "4"),
    ],
)  # fmt: skip
def test_other_bytes_than_were_asked_are_none(span, length):
    with pytest.raises(OSError, match="other bytes"):
        told(Answer(206, b"abcdef", Content_Range=span, Content_Length=length))


def test_a_whole_file_does_where_it_is_not_longer_than_what_was_asked():
    assert told(Answer(200, b"abcd", Content_Length="4", ETag="t"), 0, 4) == Part(b"abcd", 4, "t")
    assert told(Answer(200, b"ab", Content_Length="2"), 0, 4) == Part(b"ab", 2, "")
    for length, start in (("5", 0), ("4", 1), ("", 0), ("x", 0), ("0" * 10, 0)):
        with pytest.raises(OSError, match="no parts of files"):
            told(Answer(200, b"abcde", Content_Length=length), start, 4)


def test_an_empty_file_is_told_by_its_range():
    assert told(Answer(416, Content_Range="bytes */0", ETag="t"), 0, 9) == Part(b"", 0, "t")
    with pytest.raises(OSError, match="answers 416"):
        told(Answer(416, Content_Range="bytes */1"), 0, 9)


def test_what_is_compressed_is_refused():
    with pytest.raises(OSError, match="compressed"):
        told(Answer(206, Content_Encoding="gzip", Content_Range="bytes 10-13/20"))
    assert told(Answer(206, b"abcd", Content_Encoding="identity", Content_Range="bytes 10-13/20")).size == 20


# --- asking again, moving, keeping connections ------------------------------------------------------------


def test_it_is_asked_four_times_with_longer_waits(monkeypatch):
    waited: list[float] = []
    monkeypatch.setattr(hosts.time, "sleep", waited.append)
    monkeypatch.setattr(hosts, "_fetch_redirected", lambda *_: (_ for _ in ()).throw(hosts._PassingError("no")))
    with pytest.raises(OSError, match="no; asked 4 times"):
        hosts.fetch(AT, 0, 1)
    assert waited == [0.0, 0.5, 2.0]


def test_three_moves_are_too_many_and_none_leads_to_another_host(monkeypatch):
    seen: list[str] = []

    def once(url, *_):
        seen.append(url)
        return answers.pop(0)

    monkeypatch.setattr(hosts, "_once", once)
    part = Part(b"", 0, "")
    answers: list[Any] = ["/1", "2", part]
    assert hosts._fetch_redirected(AT, 0, 1) is part
    assert seen == ["https://a.org/b/x.tif", "https://a.org/1", "https://a.org/2"]
    answers = ["/1", "/2", "/3", part]
    with pytest.raises(OSError, match="on and on"):
        hosts._fetch_redirected(AT, 0, 1)
    for address in ("http://a.org/x", "https://b.org/x", "//b.org/x"):
        answers = [address, part]
        with pytest.raises(OSError, match="not followed"):
            hosts._fetch_redirected(AT, 0, 1)
    answers = ["https://b.org/" + "x" * 900]
    with pytest.raises(OSError, match="not followed") as caught:
        hosts._fetch_redirected(AT, 0, 1)
    assert len(str(caught.value)) < 300


class Connection:
    """What connects to no host; answers as told."""

    made: list[Connection]

    def __init__(self, host: str, timeout: float) -> None:
        self.host, self.timeout, self.sock, self.closed = host, timeout, None, False
        self.asked: list[Any] = []
        type(self).made.append(self)

    def connect(self) -> None:
        if isinstance(failure, BaseException):
            raise failure

    def request(self, *words: Any, headers: dict[str, str]) -> None:
        self.asked.append((*words, headers))

    def getresponse(self) -> Any:
        if isinstance(failure, BaseException):
            raise failure
        found = Answer(206, b"abcd", Content_Range="bytes 10-13/20")
        found.close = lambda: None  # type: ignore[attr-defined]
        found.isclosed = lambda: read_out  # type: ignore[attr-defined]
        found.will_close = will_close  # type: ignore[attr-defined]
        return found

    def close(self) -> None:
        self.closed = True


failure: BaseException | None = None
read_out, will_close = True, False


@pytest.fixture
def made(monkeypatch) -> list[Connection]:
    """The connections that are made."""
    here = globals()
    monkeypatch.setitem(here, "failure", None)
    monkeypatch.setitem(here, "read_out", True)
    monkeypatch.setitem(here, "will_close", False)
    Connection.made = []
    for name in ("HTTPConnection", "HTTPSConnection"):
        monkeypatch.setattr(hosts, name, type(name, (Connection,), {"made": Connection.made}))
    monkeypatch.setattr(hosts, "_idle", {})
    return Connection.made


def test_a_request_asks_for_the_bytes_as_they_are(made):
    assert hosts._once("https://a.org/b/my x(1).tif", 10, 14) == Part(b"abcd", 20, "")
    (connection,) = made
    assert (connection.host, connection.timeout, type(connection).__name__) == (
        "a.org",
        30.0,
        "HTTPSConnection",
    )
    method, path, headers = connection.asked[0]
    assert (method, path) == ("GET", "/b/my%20x(1).tif")
    assert headers == {"Range": "bytes=10-13", "Accept-Encoding": "identity"}
    hosts._once("http://a.org/x", 10, 14)
    assert type(made[1]).__name__ == "HTTPConnection"


@pytest.mark.parametrize(("read", "ends", "kept"), [(True, False, True), (True, True, False), (False, False, False)])
def test_a_connection_is_kept_that_was_read_out_and_stays_open(made, monkeypatch, read, ends, kept):
    monkeypatch.setitem(globals(), "read_out", read)
    monkeypatch.setitem(globals(), "will_close", ends)
    for _ in range(2):
        hosts._once("https://a.org/x", 10, 14)
    assert len(made) == (1 if kept else 2)
    assert made[0].closed == (not kept)
    assert list(hosts._idle) == ([(os.getpid(), "https", "a.org")] if kept else [])


def test_nothing_of_another_process_is_used(made, monkeypatch):
    hosts._once("https://a.org/x", 10, 14)
    pid = os.getpid()
    monkeypatch.setattr(hosts.os, "getpid", lambda: pid + 1)
    hosts._once("https://a.org/x", 10, 14)
    assert len(made) == 2


def test_all_that_is_kept_is_closed_at_the_end(made):
    hosts._once("https://a.org/x", 10, 14)
    hosts._once("https://b.org/x", 10, 14)
    hosts._close()
    assert [connection.closed for connection in made] == [True, True]


@pytest.mark.parametrize("error", [HTTPException("x"), TimeoutError(), ConnectionResetError(), ssl.SSLError("x")])
def test_a_host_that_breaks_off_may_do_better_next_time(made, monkeypatch, error):
    hosts._once("https://a.org/x", 10, 14)
    monkeypatch.setitem(globals(), "failure", error)
    with pytest.raises(hosts._PassingError, match="broke off"):
        hosts._once("https://a.org/x", 10, 14)
    assert made[0].closed
    assert hosts._idle == {(os.getpid(), "https", "a.org"): []}


def test_a_wrong_certificate_does_not_pass(made, monkeypatch):
    wrong = ssl.SSLCertVerificationError("x")
    wrong.verify_message = "self-signed"
    monkeypatch.setitem(globals(), "failure", wrong)
    with pytest.raises(OSError, match="no certificate that holds") as caught:
        hosts._connection("https", "a.org")
    assert not isinstance(caught.value, hosts._PassingError)
    monkeypatch.setitem(globals(), "failure", OSError(111, "Connection refused"))
    with pytest.raises(hosts._PassingError, match="no answer from its host"):
        hosts._connection("https", "a.org")


def test_a_request_has_a_time_that_grows_with_its_bytes(made, monkeypatch):
    given: list[Any] = []

    class Timer:
        def __init__(self, seconds, function, arguments):
            given.append((seconds, function, arguments))

        def start(self):
            given.append("start")

        def cancel(self):
            given.append("cancel")

    monkeypatch.setattr(hosts.threading, "Timer", Timer)
    hosts._once("https://a.org/x", 10, 14)
    assert [given[0][0], *given[1:]] == [30.0 + 4 / 10_000, "start", "cancel"]
    assert given[0][1] is hosts._shut_down
    assert given[0][2][0] is None


@pytest.mark.parametrize("shown", [ConnectionResetError(104, "reset"), TimeoutError(), None])
def test_a_request_that_is_cut_is_said_to_be_late_however_the_cut_shows(made, monkeypatch, shown):
    class Timer:
        def __init__(self, _seconds, _function, arguments):
            self.late = arguments[1]

        def start(self):
            self.late.set()

        def cancel(self):
            pass

    def answered(answer, start, stop):
        raise shown or hosts._PassingError("its host sent 0 of 4 bytes")

    monkeypatch.setattr(hosts.threading, "Timer", Timer)
    monkeypatch.setattr(hosts, "_answered", answered)
    with pytest.raises(hosts._PassingError, match="takes more than 30 s for 4 bytes"):
        hosts._once("https://a.org/x", 10, 14)


def test_side_files_are_asked_for_as_named_and_with_their_ending_in_lower_case(monkeypatch):
    tried: list[str] = []
    present = {"img_rpc.txt", "img.RPB", "img_RPC.geom"}

    def fetch(at, start, stop):
        tried.append(at.name)
        assert (start, stop) == (0, 1)
        if at.name not in present:
            raise FileNotFoundError
        return Part(b"", 0, "")

    monkeypatch.setattr(hosts, "fetch", fetch)
    found = hosts.present_beside(AT, ["img_RPC.TXT", "img.RPB", "img.xml", "img_RPC.geom"])
    assert sorted(tried) == [
        "img.RPB",
        "img.rpb",
        "img.xml",
        "img_RPC.TXT",
        "img_RPC.geom",
        "img_rpc.geom",
        "img_rpc.txt",
    ]
    assert found == {"img_rpc.txt": "img_rpc.txt", "img.rpb": "img.RPB", "img_rpc.geom": "img_RPC.geom"}
    present.add("img.rpb")
    assert hosts.present_beside(AT, ["img.RPB"]) == {"img.rpb": "img.RPB"}  # the name as it is goes first


# --- object stores ----------------------------------------------------------------------------------------


class Shelf:
    """A store of objects by URL; counts what it is asked."""

    def __init__(self, **objects: bytes) -> None:
        self.objects = {f"s3://b/{name}": data for name, data in objects.items()}
        self.asked: list[tuple[Any, ...]] = []
        self.kind = "file"

    def info(self, url):
        self.asked.append(("info", url))
        if url not in self.objects:
            raise FileNotFoundError
        return {"size": len(self.objects[url]), "ETag": "e", "type": self.kind}

    def open(self, url, mode, cache_type):
        self.asked.append(("open", url))
        if url not in self.objects:
            raise FileNotFoundError
        return io.BytesIO(self.objects[url])

    def ls(self, folder, detail):
        self.asked.append(("ls", folder, detail))
        return [url.partition("://")[2] for url in self.objects]

    def pipe_file(self, url, data):
        if "full" in url:
            raise PermissionError("no leave\nat all")
        self.objects[url] = data

    def cat_file(self, url):
        if "shut" in url:
            raise PermissionError("no leave")
        if url not in self.objects:
            raise FileNotFoundError
        return self.objects[url]

    def rm(self, folder, recursive):
        self.asked.append(("rm", folder, recursive))
        raise PermissionError


@pytest.fixture
def shelf(monkeypatch) -> Shelf:
    found = Shelf(x=b"0123456789", Y_RPC=b"", Z=b"")
    monkeypatch.setattr(hosts, "_store", lambda _: found)
    for cached in (hosts._open_version, hosts._store_listing):
        cached.cache_clear()
    return found


def test_a_part_of_an_object_ends_where_it_does(shelf):
    at = Remote("s3://b/x")
    assert hosts.fetch(at, 2, 5) == Part(b"234", 10, "e")
    assert hosts.fetch(at, 8, 99) == Part(b"89", 10, "e")
    assert hosts.fetch(at, 10, 99) == hosts.fetch(at, 12, 99) == Part(b"", 10, "e")
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
        hosts.fetch(at, 0, 4)


def test_an_object_that_is_cut_short_is_noticed(shelf, monkeypatch):
    monkeypatch.setattr(shelf, "info", lambda _: {"size": 99, "ETag": "e"})
    with pytest.raises(OSError, match="its store sent 8 of 18 bytes"):
        hosts.fetch(Remote("s3://b/x"), 2, 20)


@pytest.mark.parametrize(
    ("found", "version"),
    [
        ({"size": "7", "ETag": "a", "etag": "b"}, (7, "a")), ({"size": 7, "ETag": "", "etag": "b"}, (7, "b")),
        ({"size": 7, "generation": 5, "mtime": 9}, (7, "5")), ({"size": 7, "mtime": 9}, (7, "9")),
        ({"size": 7, "LastModified": "d"}, (7, "d")), ({"size": 7, "last_modified": "d"}, (7, "d")),
        ({"size": 7}, (7, "")),
    ],
)  # fmt: skip
def test_a_version_has_many_names(found, version):
    assert hosts._version(found) == version


def test_the_files_beside_an_object_are_listed_once_a_minute(shelf, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(hosts.time, "monotonic", lambda: now[0])
    at = Remote("s3://b/x")
    assert hosts.present_beside(at, ["y_rpc", "X", "other"]) == {"y_rpc": "Y_RPC", "x": "x"}
    now[0] = 59.0
    hosts.present_beside(at, ["z"])
    assert shelf.asked == [("ls", "s3://b", False)]
    now[0] = 61.0
    assert hosts.present_beside(at, ["z"]) == {"z": "Z"}
    assert len(shelf.asked) == 2


def test_what_a_store_says_has_300_letters_at_most_and_may_be_nothing():
    assert str(hosts._one_line(ValueError("x" * 999))) == f"its store answers ValueError: {'x' * 300}"
    assert str(hosts._one_line(ValueError(""))) == "its store answers ValueError: "


def test_a_store_is_made_with_limits_of_time_and_without_a_list_of_its_own(monkeypatch):
    made: list[Any] = []
    fake = SimpleNamespace(filesystem=lambda scheme, **given: made.append((scheme, given)))
    monkeypatch.setitem(sys.modules, "fsspec", fake)
    hosts._store.cache_clear()
    try:
        hosts._store("s3")
        hosts._store("gs")
        fake.filesystem = lambda *_, **__: (_ for _ in ()).throw(RuntimeError("no credentials\nat all"))
        with pytest.raises(OSError, match=r"its store answers RuntimeError: no credentials$"):
            hosts._store("az")
    finally:
        hosts._store.cache_clear()
    limits = {"connect_timeout": 10, "read_timeout": 30, "retries": {"max_attempts": 3}}
    assert made == [
        ("s3", {"use_listings_cache": False, "config_kwargs": limits}),
        ("gs", {"use_listings_cache": False}),
    ]


@pytest.mark.parametrize("length", ["", "1", "4"])
def test_a_part_that_does_not_say_where_it_is_from_is_none_at_the_start_either(length):
    with pytest.raises(OSError, match="other bytes"):
        told(Answer(206, b"abcd", Content_Length=length), 0, 4)
    with pytest.raises(OSError, match="other bytes"):
        told(Answer(206, b"abcd", Content_Range="bytes 0-0/0", Content_Length=length), 0, 4)


def test_who_is_sent_on_within_a_host_takes_the_query_along(monkeypatch) -> None:
    asked: list[str] = []

    def once(url: str, _start: int, _stop: int) -> object:
        asked.append(url)
        return "/b.tif?key=a/b&n=1" if len(asked) == 1 else hosts.Part(b"1", 1, "tag")

    monkeypatch.setattr(hosts, "_once", once)
    assert hosts.fetch(Remote("https://a.org/a.tif"), 0, 1).data == b"1"
    assert asked == ["https://a.org/a.tif", "https://a.org/b.tif?key=a/b&n=1"]


def test_an_address_that_is_none_is_one_line(monkeypatch) -> None:
    monkeypatch.setattr(hosts, "_once", lambda *_: "http://[bad/")
    with pytest.raises(OSError, match=r"sends us on to what is no address \(http://\[bad/\)"):
        hosts.fetch(Remote("https://a.org/a.tif"), 0, 1)


def test_a_query_is_part_of_what_is_asked(monkeypatch) -> None:
    asked: list[str] = []

    class Connection:
        sock = None

        def request(self, _method: str, target: str, headers: object) -> None:
            asked.append(target)
            raise ConnectionError

        def close(self) -> None: ...

    monkeypatch.setattr(hosts, "_connection", lambda *_: Connection())
    for url in ("https://a.org/x y.tif?k=a/b&n=ü", "https://a.org/x.tif"):
        with pytest.raises(OSError, match="broke off"):
            hosts._once(url, 0, 1)
    assert asked == ["/x%20y.tif?k=a/b&n=%C3%BC", "/x.tif"]
