"""What was read is what was hashed: an input that changes between two runs, or while one is at work, is never taken for
the old one."""

from __future__ import annotations

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc import adjust, identity
from barpc.errors import InputError
from barpc.options import RunOptions
from barpc.rpcio import write_rpc_vrt
from tests.reliability.trials import SAMPLES, crop, outputs

AGAIN = RunOptions(overwrite=True, pictures=False)


@pytest.fixture
def images(tmp_path: Path) -> list[Path]:
    (tmp_path / "in").mkdir()
    return [crop(source, tmp_path / "in" / source.name) for source in SAMPLES[:2]]


def other(path: Path) -> bytes:
    """The same file with its pixels three columns further: another answer, and as many bytes."""
    copy = path.with_name(f"other_{path.name}")
    shutil.copy(path, copy)
    with rasterio.open(copy, "r+") as image:
        image.write(np.roll(image.read(1), 3, axis=1), 1)
    data = copy.read_bytes()
    copy.unlink()
    return data


def in_place(path: Path, data: bytes) -> None:
    """Written over, and its time of change put back."""
    found = path.stat()
    path.write_bytes(data)
    os.utime(path, ns=(found.st_atime_ns, found.st_mtime_ns))


def moved_in(path: Path, data: bytes) -> None:
    """Another file takes the name, with the same size and time of change."""
    found, new = path.stat(), path.with_name("new")
    new.write_bytes(data)
    os.utime(new, ns=(found.st_atime_ns, found.st_mtime_ns))
    new.replace(path)


FAST = [(moved_in, "cameras"), (in_place, "detect")]


def test_a_vrt_whose_image_was_replaced_is_another_input(images, tmp_path) -> None:
    views = []
    for path in images:
        vrt = tmp_path / f"{path.stem}.vrt"
        with rasterio.open(path) as image:
            assert image.rpcs is not None
        from barpc.rpcio import read_rpc

        write_rpc_vrt(read_rpc(path), path, vrt)
        views.append(vrt)
    adjust(views, tmp_path / "out", AGAIN)
    before = outputs(tmp_path / "out")
    images[0].write_bytes(other(images[0]))
    adjust(views, tmp_path / "out", AGAIN)
    after = outputs(tmp_path / "out")
    adjust(views, tmp_path / "fresh", AGAIN)
    assert after == outputs(tmp_path / "fresh")
    name = f"{views[0].stem}_RPC.TXT"
    assert after[name] != before[name]


@pytest.mark.parametrize(
    ("change", "stage"),
    [
        pytest.param(change, stage, marks=() if (change, stage) in FAST else pytest.mark.slow)
        for change in (in_place, moved_in)
        for stage in ("cameras", "hash", "read", "detect", "match", "fit")
    ],
)
def test_an_image_that_is_replaced_at_work_ends_the_run_and_leaves_nothing_wrong(
    images, tmp_path, change, stage
) -> None:
    truth, new = images[0].read_bytes(), other(images[0])
    adjust(images, tmp_path / "truth", AGAIN)
    done = []

    def progress(name: str, number: int, total: int) -> None:
        if name.startswith(stage) and not done:
            done.append(name)
            change(images[0], new)

    with pytest.raises(
        InputError, match=rf"{images[0].name}: was changed or replaced while the run was at work"
    ):
        adjust(images, tmp_path / "out", AGAIN, progress=progress)
    assert done
    assert not [path for path in (tmp_path / "out").rglob("*") if path.suffix in (".vrt", ".TXT", ".html")]
    change(images[0], truth)
    adjust(images, tmp_path / "out", AGAIN)
    assert outputs(tmp_path / "out") == outputs(tmp_path / "truth")


def test_workers_see_it_too(images, tmp_path) -> None:
    new, done = other(images[1]), []

    def progress(name: str, number: int, total: int) -> None:
        if name.startswith("read") and not done:
            done.append(name)
            moved_in(images[1], new)

    with ThreadPoolExecutor(2) as pool, pytest.raises(InputError, match="was changed or replaced"):
        adjust(images, tmp_path / "out", AGAIN, executor=pool, progress=progress)
    assert done


def test_what_does_not_change_a_file_does_not_end_a_run(images, tmp_path) -> None:
    def progress(name: str, number: int, total: int) -> None:
        images[0].read_bytes()
        (images[0].parent / "beside.txt").write_text(name)

    adjust(images, tmp_path / "out", AGAIN, progress=progress)
    assert (tmp_path / "out" / "summary.json").is_file()


MATCHER = """
from users_helper import keep
import numpy as np

def match(a, b, prediction):
    x = np.stack(np.meshgrid(np.arange(10, 150, 12.0), np.arange(10, 150, 12.0)), axis=-1).reshape(-1, 2)
    return keep(np.stack([x, x], axis=1))

match.files = ["weights.bin"]
"""


def test_all_that_a_matcher_of_ones_own_is_made_of_counts(tmp_path, monkeypatch) -> None:
    from barpc.tie.hook import hook_files

    (tmp_path / "users_own.py").write_text(MATCHER)
    (tmp_path / "users_helper.py").write_text("def keep(places):\n    return places\n")
    (tmp_path / "weights.bin").write_bytes(b"1")
    monkeypatch.syspath_prepend(tmp_path)
    found = hook_files("users_own:match")
    assert [path.name for path in found] == ["users_own.py", "users_helper.py", "weights.bin"]
    assert hook_files("guided") == []
    (tmp_path / "weights.bin").unlink()
    with pytest.raises(InputError, match=r"declares .*weights\.bin, which is no file"):
        hook_files("users_own:match")


# --- the value itself -------------------------------------------------------------------------------------


def test_a_file_whose_number_changes_and_whose_bytes_do_not_is_the_same(tmp_path) -> None:
    """Some file systems number files anew; times that changed mean that somebody was at it."""
    path = tmp_path / "a"
    path.write_bytes(b"x" * 1000)
    found = identity.take(path)
    found.ask()
    assert found.stamp is not None
    renumbered = identity.Input(
        found.path, found.size, found.sha256, identity.Stamp(*found.stamp.times(), 1, 2, "here")
    )
    renumbered.ask()
    wrong = identity.Input(
        found.path, found.size, "0" * 64, identity.Stamp(*found.stamp.times(), 3, 2, "here")
    )
    identity._known.clear()
    with pytest.raises(InputError, match="was changed or replaced"):
        wrong.ask()
    path.unlink()
    with pytest.raises(InputError, match="was changed or replaced"):
        found.ask()


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
        identity.take(tmp_path / "pipe")
    with pytest.raises(InputError, match="not a regular file"):
        identity.take("/dev/zero")
