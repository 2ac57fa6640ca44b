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

from barpc import adjust
from barpc.base.errors import InputError
from barpc.base.options import RunOptions
from barpc.rpcio import read_rpc, write_rpc_vrt
from tests.reliability.trials import outputs

AGAIN = RunOptions(overwrite=True)


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


FAST, SLOW = (in_place, "detect"), ((moved_in, "cameras"), (in_place, "hash"), (in_place, "fit"))


@pytest.mark.slow
def test_a_vrt_whose_image_was_replaced_is_another_input(crops, tmp_path) -> None:
    views = [tmp_path / f"{path.stem}.vrt" for path in crops]
    for path, vrt in zip(crops, views, strict=True):
        write_rpc_vrt(read_rpc(path), path, vrt)
    adjust(views, tmp_path / "out", AGAIN)
    before = outputs(tmp_path / "out")
    crops[0].write_bytes(other(crops[0]))
    adjust(views, tmp_path / "out", AGAIN)
    after = outputs(tmp_path / "out")
    adjust(views, tmp_path / "fresh", AGAIN)
    assert after == outputs(tmp_path / "fresh")
    name = f"{views[0].stem}_RPC.TXT"
    assert after[name] != before[name]


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "stage"),
    [
        pytest.param(change, stage, marks=() if (change, stage) in (FAST, *SLOW) else pytest.mark.nightly)
        for change in (in_place, moved_in)
        for stage in ("cameras", "hash", "read", "detect", "match", "fit")
    ],
)
def test_an_image_that_is_replaced_at_work_ends_the_run_and_leaves_nothing_wrong(
    crops, tmp_path, change, stage
) -> None:
    truth, new = crops[0].read_bytes(), other(crops[0])
    adjust(crops, tmp_path / "truth", AGAIN)
    done = []

    def progress(name: str, number: int, total: int) -> None:
        if name.startswith(stage) and not done:
            done.append(name)
            change(crops[0], new)

    with pytest.raises(InputError, match=rf"{crops[0].name}: was changed or replaced while the run was at work"):
        adjust(crops, tmp_path / "out", AGAIN, progress=progress)
    assert done
    assert not [path for path in (tmp_path / "out").rglob("*") if path.suffix in (".vrt", ".TXT", ".html")]
    change(crops[0], truth)
    adjust(crops, tmp_path / "out", AGAIN)
    assert outputs(tmp_path / "out") == outputs(tmp_path / "truth")


def test_workers_see_it_too(crops, tmp_path) -> None:
    new, done = other(crops[1]), []

    def progress(name: str, number: int, total: int) -> None:
        if name.startswith("read") and not done:
            done.append(name)
            moved_in(crops[1], new)

    with ThreadPoolExecutor(2) as pool, pytest.raises(InputError, match="was changed or replaced"):
        adjust(crops, tmp_path / "out", AGAIN, executor=pool, progress=progress)
    assert done


@pytest.mark.slow
def test_what_does_not_change_a_file_does_not_end_a_run(crops, tmp_path) -> None:
    def progress(name: str, number: int, total: int) -> None:
        crops[0].read_bytes()
        (crops[0].parent / "beside.txt").write_text(name)

    adjust(crops, tmp_path / "out", AGAIN, progress=progress)
    assert (tmp_path / "out" / "summary.json").is_file()
