"""Inputs as they were hashed: what the system says of a file, what a block relies on, what was read."""

from __future__ import annotations

import hashlib
import os

import pytest

from barpc.base import identity
from barpc.base.errors import InputError
from barpc.base.remote import Remote


def test_a_file_whose_number_changes_and_whose_bytes_do_not_is_the_same(tmp_path) -> None:
    """Some file systems number files anew; times that changed mean that somebody was at it."""

    def renumbered(name: str, sha256: str = "") -> identity.Input:
        (tmp_path / name).write_bytes(b"x" * 1000)
        found = identity.fingerprint(tmp_path / name)
        found.ask()
        assert found.stamp is not None
        stamp = identity.Stamp(*found.stamp.times(), 1, 2, "here")
        return identity.Input(found.path, found.size, sha256 or found.sha256, stamp)

    same, other = renumbered("a"), renumbered("b", "0" * 64)
    same.ask()
    with pytest.raises(InputError, match="was changed or replaced"):
        other.ask()
    (tmp_path / "a").unlink()
    with pytest.raises(InputError, match="was changed or replaced"):
        same.ask()


def test_devices_are_compared_on_one_host_only() -> None:
    one = identity.Stamp(1, 2, 3, 4, 5, "here")
    assert one.matches(one)
    assert one.matches(identity.Stamp(1, 2, 3, 4, 6, "there"))
    assert not one.matches(identity.Stamp(1, 2, 3, 4, 6, "here"))
    for field in range(4):
        values = [1, 2, 3, 4]
        values[field] += 1
        assert not one.matches(identity.Stamp(*values, 5, "there"))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes")
def test_a_pipe_in_the_place_of_a_file_is_not_waited_for(tmp_path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="not a regular file"):
        identity.fingerprint(tmp_path / "pipe")
    with pytest.raises(InputError, match="not a regular file"):
        identity.fingerprint("/dev/zero")


def test_an_input_is_its_bytes_and_those_of_its_parts(tmp_path) -> None:
    (tmp_path / "a").write_bytes(b"one")
    (tmp_path / "b").write_bytes(b"two")
    a, b = identity.fingerprint(tmp_path / "a"), identity.fingerprint(tmp_path / "b")
    assert (a.path, a.size, a.sha256) == (str(tmp_path / "a"), 3, hashlib.sha256(b"one").hexdigest())
    assert a.key == a.sha256
    whole = identity.fingerprint(tmp_path / "a", [b])
    assert whole.key not in (a.key, b.key)
    assert [one.path for one in whole.every()] == [a.path, b.path]
    elsewhere = identity.fingerprint(Remote("https://a.org/x", 7, "tag"))
    assert (elsewhere.size, elsewhere.stamp) == (7, None)
    assert elsewhere.sha256 != identity.fingerprint(Remote("https://a.org/x", 7, "other")).sha256
    elsewhere.ask()  # its host is asked for that version


def test_within_a_block_every_input_is_asked_at_the_end_and_one_when_it_is_opened(tmp_path) -> None:
    (tmp_path / "a").write_bytes(b"one")
    (tmp_path / "b").write_bytes(b"two")
    a, b = identity.fingerprint(tmp_path / "a"), identity.fingerprint(tmp_path / "b")
    identity.ask()
    with identity.guarded([a, b]):
        identity.ask()
        identity.ask(tmp_path / "c")
    with pytest.raises(InputError, match=r"b: was changed"), identity.guarded([a, b]):
        (tmp_path / "b").write_bytes(b"2")
        identity.ask(tmp_path / "a")
        with pytest.raises(InputError, match=r"b: was changed"):
            identity.ask(tmp_path / "b")
    with pytest.raises(InputError, match=r"b: was changed"), identity.guarded([a, b]):
        raise OSError("whatever a file that is half there makes a reader say")
    with pytest.raises(OSError, match="its own"), identity.guarded([a]):
        raise OSError("its own")
    identity.ask()  # nothing is relied on any more


def test_what_was_read_is_noted_once_and_must_stay(tmp_path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"one")
    identity.note(path, path.stat())  # nobody asked
    with identity.recorded({}) as seen:
        identity.note(path, path.stat())
        identity.note(path, path.stat())
        assert list(seen) == [str(path)]
        identity.fingerprint(path)
        path.write_bytes(b"another")
        with pytest.raises(InputError, match="was changed"):
            identity.note(path, path.stat())
        with pytest.raises(InputError, match="was changed"):
            identity.fingerprint(path)
        with pytest.raises(InputError, match="was changed"):
            identity.also_seen({str(path): identity.Stamp.of(path.stat())})
    identity.note(path, path.stat())
