"""A finished folder: which of its files are as they were written, and where its inputs are, by their content."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from barpc.base import sealed
from barpc.base.errors import InputError
from barpc.base.identity import Stamp
from barpc.base.sealed import Sealed, portable
from barpc.workspace import Workspace


def sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


@pytest.fixture
def made(tmp_path) -> Path:
    """A folder of two layers that was made of one file, which lies beside it."""
    (tmp_path / "in").mkdir()
    (tmp_path / "in/a.tif").write_bytes(b"a")
    with Workspace(tmp_path / "deep/run") as run:
        run.note({"../../in/a.tif": Stamp.of((tmp_path / "in/a.tif").stat())})
        run.write_text("summary.json", "1")
        run.write_text("report.html", "first")
        run.seal()
    with Workspace(tmp_path / "deep/run", overwrite=True, adds=True) as run:
        run.write_text("report.html", "second")
        run.write_text("dsm.tif", "made of it")
    return tmp_path / "deep/run"


def test_files_are_as_they_were_written_or_named(made) -> None:
    run = Sealed.open(made)
    for name in ("summary.json", "report.html", "dsm.tif"):
        assert run.file(name) == made / name
    assert run.file("tables/surface.json") == made / "tables/surface.json"  # of no command, and not there
    (made / "dsm.tif").write_text("made of IT")
    (made / "summary.json").unlink()
    (made / "other").touch()
    (made / "report.html").unlink()
    (made / "report.html").mkdir()
    for name, what in {
        "dsm.tif": "was changed",
        "summary.json": "is gone",
        "report.html": "was",
        "other": "was",
    }.items():
        with pytest.raises(InputError, match=rf"{name}: {what}.* since the run wrote it \(barpc verify .*run it again"):
            run.file(name)


def test_sums_that_were_written_anew_are_not_those_that_were_noted(made) -> None:
    text = (made / "SHA256SUMS").read_text()
    (made / "summary.json").write_text("2")
    (made / "SHA256SUMS").write_text(text.replace(sha(b"1"), sha(b"2")))
    with pytest.raises(InputError, match="SHA256SUMS: was changed since"):
        Sealed.open(made).file("summary.json")


def test_a_file_of_a_later_command_that_was_ended_is_its_own_and_no_result_of_the_run_is(made) -> None:
    with (made / ".barpc/outputs.jsonl").open("a") as notes:
        notes.write("".join(f'["{name}", "{sha(b"x")}"]\n' for name in ("dsm.tif", "summary.json")))
    for name in ("dsm.tif", "summary.json"):
        (made / name).write_text("x")
    run = Sealed.open(made)
    assert run.file("dsm.tif") == made / "dsm.tif"
    with pytest.raises(InputError, match=r"summary\.json: was changed"):
        run.file("summary.json")


def test_without_sums_there_is_no_finished_folder(made) -> None:
    (made / "SHA256SUMS").unlink()
    with pytest.raises(InputError, match=r"SHA256SUMS: missing: the run was interrupted, or"):
        Sealed.open(made)


def test_a_portable_path_is_that_of_its_file_from_wherever_the_folder_lies(made, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path / "in")
    for given in ("a.tif", "../in/a.tif", str(tmp_path / "in/a.tif")):
        assert portable(given, made) == "../../in/a.tif"
    assert portable(str(made / "x/y"), made) == "x/y"
    monkeypatch.chdir(tmp_path)
    here, path = str(tmp_path / "in/a.tif"), "../../in/a.tif"
    for seen in (made, Path("deep/run")):
        assert Sealed.open(seen).input(path, sha(b"a"), 1) == here
    for same in ("", "https://a.org/a.tif", "s3://b/a.tif"):
        assert portable(same, made) == Sealed.open(made).input(same, sha(b"a")) == same
    (tmp_path / "link").symlink_to(made)
    moved = made.rename(tmp_path / "moved")  # alone: the file is where it was
    assert Sealed.open(moved).input(path, sha(b"a"), 1) == here
    (tmp_path / "link").unlink()
    (tmp_path / "far/off").mkdir(parents=True)
    (tmp_path / "far/off/link").symlink_to(moved)
    (tmp_path / "moved/.barpc/state.json").unlink()
    assert Sealed.open(tmp_path / "far/off/link").find("../in/a.tif", sha(b"a")) == tmp_path / "in/a.tif"


def test_an_input_is_the_file_of_its_content_in_the_first_place_that_has_it(made, tmp_path) -> None:
    """Another file of its name is none, wherever it lies."""
    moved, path = made.rename(tmp_path / "moved"), "../../in/a.tif"
    (tmp_path.parent / "in").mkdir(exist_ok=True)
    places = [
        tmp_path.parent / "in/a.tif",  # as seen from the folder
        tmp_path / "in/a.tif",  # from where it was made
        moved / "a.tif",
        tmp_path / "a.tif",
        tmp_path / "given/a.tif",
    ]
    (tmp_path / "given").mkdir()
    for place in places:
        place.write_bytes(b"b")
    run, more = Sealed.open(moved), [tmp_path / "given"]
    assert run.find(path, sha(b"a"), 1, more) is None
    with pytest.raises(InputError, match=r"in/a\.tif: is not the file that .*moved was made of, and no file of its"):
        run.input(path, sha(b"a"), 1, more)
    for place in reversed(places):
        place.write_bytes(b"a")
        assert run.find(path, sha(b"a"), 1, more) == place
        assert run.find(path, sha(b"a"), 2, more) is None  # of another size
    for place in places:
        place.unlink()
    with pytest.raises(InputError, match=r"in/a\.tif: is gone, and no file of its name"):
        run.input(path, sha(b"a"), 1, more)


@pytest.mark.parametrize("name", ["v" * 300 + ".tif", "a\0b", "a.tif/b", ".", ""])
def test_no_name_is_more_than_a_file_that_is_not_there(made, name) -> None:
    """A name that is too long, a zero byte, a file for a folder."""
    assert not Sealed.open(made).holds(made / name, name, sha(b"a"))
    if name:
        with pytest.raises(InputError, match=r"is gone|is not the file"):
            Sealed.open(made).input(f"../../in/{name}", sha(b"a"))


def test_a_large_file_is_hashed_where_its_times_are_not_those_noted(made, tmp_path, monkeypatch) -> None:
    size, hash_of = sealed.READ_WHOLE + 1, hashlib.file_digest
    path, image = "../../in/a.tif", tmp_path / "in/a.tif"
    hashed = list[object]()
    monkeypatch.setattr(hashlib, "file_digest", lambda *given: (hashed.append(given), hash_of(*given))[1])
    assert Sealed.open(made).find(path, sha(b"a"), 1) == image
    assert len(hashed) == 1  # a small one, whose times are those noted
    image.write_bytes(b"a" * size)
    with Workspace(made, adds=True) as run:
        run.note({path: Stamp.of(image.stat())})
    hashed.clear()

    def find(**how: bool) -> Path | None:
        return Sealed.open(made).find(path, sha(b"a" * size), size, **how)

    assert find() == image
    assert hashed == []
    assert find(whole=True) == image
    assert len(hashed) == 1
    times = image.stat()
    image.write_bytes(b"b" * size)
    os.utime(image, ns=(times.st_atime_ns, times.st_mtime_ns))  # as a forger does
    assert find() is None
    image.write_bytes(b"a" * size)  # put back: other times, the same content
    assert find() == image
