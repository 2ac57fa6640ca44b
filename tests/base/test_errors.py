"""Errors: a line of bounded length, groups, and what says that memory is out."""

from __future__ import annotations

import errno
import mmap

import pytest

from barpc.base.errors import BarpcError, DisconnectedError, InputError, has_room, out_of_memory, plain


def test_a_message_is_one_printable_line_of_its_two_ends():
    assert str(InputError("a\nb\x1b")) == "a\\nb\\u001b"
    assert str(InputError("x" * 1500)) == "x" * 1500
    assert str(InputError("a" + "x" * 1499 + "b")) == "a" + "x" * 749 + " ... " + "x" * 749 + "b"
    assert plain(InputError("as it is")) == "as it is"


def test_groups_and_faults_stay_with_an_error():
    found = DisconnectedError("two", [["a", "b"], ["c"]], {"c": "clouds"})
    assert (str(found), found.groups, found.said) == ("two", (("a", "b"), ("c",)), {"c": "clouds"})
    assert (DisconnectedError("none").groups, DisconnectedError("none").said) == ((), {})


def cv2_error(text: str) -> Exception:
    return type("error", (Exception,), {"__module__": "cv2"})(text)


def because(error: Exception, cause: Exception) -> Exception:
    error.__cause__ = cause
    return error


def unmapped(*_: int) -> None:
    raise OSError(errno.ENOMEM, "no")


def reworded(error: Exception) -> None:
    try:
        raise error
    except type(error):
        raise BarpcError("another sentence") from None


@pytest.mark.parametrize(
    ("error", "always", "short"),
    [
        (None, False, False),
        (MemoryError(), True, True),
        (OSError(errno.ENOMEM, "no"), True, True),
        (OSError(errno.ENOENT, "no"), False, False),
        (because(ValueError("x"), MemoryError()), True, True),
        (cv2_error("(-4:Insufficient memory)"), True, True),
        (cv2_error("(-5:Bad argument)"), False, False),
        (ImportError("lib.so: failed to map segment from shared object"), False, True),
        (because(RuntimeError("x"), RuntimeError("can't start new thread")), False, True),
        (ImportError("cannot allocate memory in static TLS block"), False, False),
        (OSError("failed to map segment: Operation not permitted"), False, False),
        (BarpcError("out of memory"), False, False),  # its own words
    ],
)
def test_memory_is_out_where_an_error_says_so_or_may_and_none_can_be_had(monkeypatch, error, always, short):
    assert has_room(1 << 20)
    assert not has_room(1 << 60)
    for room, said in ((True, always), (False, short)):
        if not room:
            monkeypatch.setattr(mmap, "mmap", unmapped)
        assert out_of_memory(error) == said
        if said and error is not None and not isinstance(error, MemoryError):
            with pytest.raises(BarpcError if room else MemoryError):  # no other sentence is put on it
                reworded(error)
