"""Foul HTTP, byte by byte: whatever a server sends is the data, or an OSError of that file, in bounded memory."""

from __future__ import annotations

import itertools
import random
import tracemalloc
from collections.abc import Iterable

import pytest

from barpc.base.remote import REQUEST_BYTES, Part

HEAD = b'HTTP/1.1 206 OK\r\nETag: "a"\r\nContent-Range: bytes 0-65535/1000000\r\n'
CHUNKED = HEAD + b"Transfer-Encoding: chunked\r\n\r\n"
DATA = bytes(range(256)) * 256
END = b"0\r\n\r\n"


def endless(first: bytes, unit: bytes) -> Iterable[bytes]:
    return itertools.chain([first], itertools.repeat(unit))


FOUL: dict[str, Iterable[bytes]] = {
    "a negative chunk": [CHUNKED, b"-5\r\nhello\r\n", END],
    "a chunk of -1 bytes, which reads to the end": endless(CHUNKED + b"-1\r\n", b"x" * REQUEST_BYTES),
    "a negative chunk behind good ones": [CHUNKED, b"8000\r\n", DATA[:32768], b"\r\n-8000\r\n", DATA, b"\r\n", END],
    "a size that is no number": [CHUNKED, b"zz\r\nhello\r\n", END],
    "no size": [CHUNKED, b"\r\n\r\n"],
    "a size without end": endless(CHUNKED, b"f" * REQUEST_BYTES),
    "a truncated chunk": [CHUNKED, b"10000\r\nabc"],
    "fewer chunks than were said": [CHUNKED, b"10\r\n", DATA[:16], b"\r\n", END],
    "extensions without end": endless(CHUNKED, b"1;" + b"e" * 60000 + b"\r\nx\r\n"),
    "headers without end": endless(HEAD, b"X-A: b\r\n"),
    "a header without end": endless(HEAD + b"X: ", b"a" * REQUEST_BYTES),
    "a status without end": endless(b"HTTP/1.1 206 ", b"a" * REQUEST_BYTES),
    "one that goes on and on": endless(b"", b"HTTP/1.1 100 Continue\r\n\r\n"),
    "the words of a missing file without end": endless(
        b"HTTP/1.1 404 No\r\nTransfer-Encoding: chunked\r\n\r\n-1\r\n", b"x" * REQUEST_BYTES
    ),
    "a status that is none": [b"HTTP/1.1 99999 OK\r\n\r\n"],
    "no HTTP": [b"\x15\x03\x01\x00\x02\x02P"],
    "another version": [b"HTTP/2 200 OK\r\n\r\n"],
    "nothing": [],
    "a negative length": [HEAD, b"Content-Length: -65536\r\n\r\n", DATA],
    "letters of another alphabet": [b"HTTP/1.1 206 \xb2\r\n\0: \xff\xfe\r\nContent-Range: bytes 0-65535/\xb2\r\n\r\n"],
}


@pytest.mark.parametrize("parts", FOUL.values(), ids=FOUL)
def test_foul_http_is_an_error_of_its_file_alone_in_bounded_memory(fetched, parts):
    tracemalloc.start()
    try:
        with pytest.raises(OSError, match="its host") as caught:
            fetched(more=parts)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()
    assert type(caught.value) is OSError
    assert "\n" not in str(caught.value)


def test_what_is_sent_before_the_end_of_too_much_is_read(fetched):
    """Chunks of one byte, the dearest way to send it that there is, and trailers that do not end."""
    single = b"".join(b"1\r\n" + DATA[i : i + 1] + b"\r\n" for i in range(len(DATA)))
    assert fetched(CHUNKED, single, END).data == DATA
    assert fetched(CHUNKED, b"8000;ext=1\r\n", DATA[:32768], b"\r\n8000\r\n", DATA[32768:], b"\r\n", END).data == DATA
    assert fetched(CHUNKED, b"10000\r\n", DATA, b"\r\n0\r\n", more=itertools.repeat(b"X: y\r\n")).data == DATA
    assert fetched(HEAD, b"Content-Length: 65536\r\n\r\n", DATA) == Part(DATA, 1_000_000, '"a"')


def test_damaged_answers_give_the_bytes_that_were_asked_or_an_oserror(fetched):
    rng = random.Random(5)
    whole = [
        CHUNKED + b"8000\r\n" + DATA[:32768] + b"\r\n8000\r\n" + DATA[32768:] + b"\r\n" + END,
        HEAD + b"Content-Length: 65536\r\n\r\n" + DATA,
        b"HTTP/1.1 301 Moved\r\nLocation: /y.tif\r\nContent-Length: 0\r\n\r\n",
        b"HTTP/1.1 416 No\r\nContent-Range: bytes */0\r\n\r\n",
    ]
    words = [b"-", b"-1", b"0", b"\r\n", b"\0", b"\xff", b"9" * 30, b" ", b"chunked", b":", b"//", b"[", b"http://["]
    outcomes = set()
    for _ in range(1500):
        data = rng.choice(whole)
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(min(len(data), 200)) if rng.random() < 0.8 else rng.randrange(len(data))
            cut = rng.choice((0, 1, 1, 4))
            data = data[:at] + rng.choice(words) + data[at + cut :]
        try:
            found = fetched(data)
            outcomes.add(len(found.data))
        except OSError as error:
            outcomes.add(str(error)[:12])
    assert {0, REQUEST_BYTES} == {one for one in outcomes if isinstance(one, int)}
    assert len(outcomes) > 3
