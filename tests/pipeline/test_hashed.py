"""The inputs of a run, hashed: which they are, under which name, in which groups, and that none changed meanwhile."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from barpc.base.errors import InputError
from barpc.base.identity import Stamp, fingerprint
from barpc.base.options import RunOptions, TieOptions
from barpc.base.remote import Remote
from barpc.pipeline.inputs import hash_inputs
from tests.rpcio.conftest import write_image

AT = Remote("https://a.org/x.tif", 10, "one")


def run_of(*paths: str | Path) -> Any:
    return SimpleNamespace(
        carried=(), views=[SimpleNamespace(path=p if isinstance(p, Remote) else str(p)) for p in paths]
    )


def digest(path: Path) -> str:
    return sha256(path.read_bytes()).hexdigest()


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    found = {name: tmp_path / name for name in ("a.tif", "b.tif", "c.tif", "gcps.csv", "beside.txt")}
    for path in found.values():
        path.write_bytes(b"II*\0" + path.name.encode() * 3)
    return found


def test_images_references_side_files_and_what_options_name_are_inputs(files, monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    options = RunOptions(
        gcp=("gcps.csv", "nowhere.csv"),
        dem=str(files["b.tif"]),
        reference=("c.tif",),
        add_to=str(tmp_path),
    )
    seen = {str(files["beside.txt"]): Stamp.of(files["beside.txt"].stat())}
    found = hash_inputs(run_of(files["a.tif"], files["a.tif"]), options, seen)
    assert list(found) == [str(files[n]) for n in ("a.tif", "c.tif", "beside.txt", "gcps.csv", "b.tif")]
    for name, one in found.items():
        assert (one.path, one.sha256, one.parts) == (name, digest(Path(name)), ())


def test_a_vrt_counts_with_its_image(tmp_path) -> None:
    from barpc.rpcio import write_rpc_vrt
    from tests.rpcio.conftest import make_rpc

    image = write_image(tmp_path / "a.tif", shape=(1, 4, 4))
    write_rpc_vrt(make_rpc(), image, tmp_path / "a.vrt")
    (found,) = hash_inputs(run_of(tmp_path / "a.vrt"), RunOptions(), {}).values()
    assert [part.path for part in found.every()] == [str(tmp_path / "a.vrt"), str(image)]
    with pytest.raises(InputError, match=r"a\.tif: was changed or replaced"):
        hash_inputs(run_of(tmp_path / "a.vrt"), RunOptions(), {str(image): Stamp.of(tmp_path.stat())})


def test_a_file_that_is_another_than_was_read_ends_the_run(files) -> None:
    path = files["a.tif"]
    seen = {str(path): Stamp.of(path.stat())}
    assert hash_inputs(run_of(path), RunOptions(), seen)
    os.utime(path, ns=(1, 1))
    with pytest.raises(InputError, match=r"a\.tif: was changed or replaced"):
        hash_inputs(run_of(path), RunOptions(), seen)


def test_a_file_elsewhere_is_its_version() -> None:
    found = hash_inputs(run_of(AT), RunOptions(), {str(AT): Stamp(1, 1, 1, 1, 1, "x")})
    assert found == {str(AT): fingerprint(AT)}
    assert found[str(AT)].stamp is None


def test_a_matcher_counts_with_its_files_under_its_name(tmp_path, monkeypatch) -> None:
    code = [tmp_path / "hashed_matcher.py", tmp_path / "weights.bin"]
    code[0].write_text("def match(a, b, prediction): ...\nmatch.files = ['weights.bin']\n")
    code[1].write_bytes(b"12")
    monkeypatch.syspath_prepend(str(tmp_path))
    name = "hashed_matcher:match"
    found = hash_inputs(run_of(), RunOptions(tie=TieOptions(matcher=name)), {})[name]
    assert [(one.path, one.sha256) for one in found.every()] == [(str(p), digest(p)) for p in code]
    assert (found.size, found.stamp) == (code[0].stat().st_size, Stamp.of(code[0].stat()))
    assert hash_inputs(run_of(), RunOptions(), {}) == {}


def test_the_work_goes_to_the_executor_under_its_stage_in_order(files) -> None:
    told: list[tuple[str, int, int]] = []
    with ThreadPoolExecutor(2) as threads:
        pool = Mock(wraps=threads)
        run = run_of(files["b.tif"], files["a.tif"])
        found = hash_inputs(run, RunOptions(), {}, pool, lambda *now: told.append(now))
    assert pool.submit.call_count == 2
    assert told == [("hash", 1, 2), ("hash", 2, 2)]
    assert [Path(name).name for name in found] == ["b.tif", "a.tif"]
    assert [one.sha256 for one in found.values()] == [digest(files["b.tif"]), digest(files["a.tif"])]
