"""`barpc verify`: what is still the same of a finished run, and what is not, told apart."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from barpc import adjust
from barpc.base.options import RunOptions
from barpc.rpcio import read_rpc, write_rpc
from tests.reliability.conftest import barpc
from tests.reliability.trials import SAMPLES, crop


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("verify")
    (folder / "in").mkdir()
    images = [crop(source, folder / "in" / source.name) for source in SAMPLES[:2]]
    adjust(images, folder / "out", RunOptions(grids=True, resample=True, rpc_formats=("txt", "rpb")))
    return folder


@pytest.fixture
def run(finished, tmp_path) -> Path:
    """A run whose inputs stayed where they were."""
    shutil.copytree(finished / "out", tmp_path / "out")
    return tmp_path / "out"


def findings(run: Path, *places: Path) -> tuple[int, dict[tuple[str, str], str]]:
    said = barpc("verify", run, *places, "--json")
    rows = json.loads(said.out)
    return said.code, {(one["kind"], Path(one["file"]).name): one["now"] for one in rows}


@pytest.mark.slow
def test_a_run_that_nobody_touched_is_what_it_was(run) -> None:
    code, found = findings(run)
    assert code == 0
    assert set(found.values()) == {"same"}
    written = {path.relative_to(run).as_posix() for path in run.rglob("*") if path.is_file()}
    expected = {name for name in written if not name.startswith(".barpc/")} - {"summary.json", "report.html"}
    assert {name for kind, name in found if kind == "output"} == {Path(name).name for name in expected}
    assert {name for kind, name in found if kind == "input"} >= {"view_00.tif", "view_01.tif"}
    cameras = {name for kind, name in found if kind == "camera"}
    assert {"view_00.vrt", "view_00_RPC.TXT", "view_00.RPB", "view_00_grid.tif"} <= cameras
    said = barpc("verify", run)
    assert said.err == ""
    assert f"outputs: {len(expected)} same" in said.out


def test_an_output_that_was_changed_is_named(run) -> None:
    rpc = read_rpc(run / "view_01_RPC.TXT")
    write_rpc(rpc.crop(0.5, 0.0), run / "view_01_RPC.TXT", format="txt", overwrite=True)
    (run / "view_00.RPB").unlink()
    code, found = findings(run)
    assert code == 3
    assert {key: now for key, now in found.items() if now != "same"} == {
        ("output", "view_01_RPC.TXT"): "changed",
        ("camera", "view_01_RPC.TXT"): "changed",
        ("output", "view_00.RPB"): "missing",
        ("camera", "view_00.RPB"): "missing",
    }
    said = barpc("verify", run)
    assert "camera view_01_RPC.TXT: changed, reads 0.5 px off the certified camera" in said.out
    assert "exit code 3" in said.err


def test_a_report_that_is_made_again_is_no_fault(run) -> None:
    (run / "report.html").unlink()
    assert findings(run)[0] == 0


def test_inputs_that_changed_are_told_from_those_that_moved(finished, run, tmp_path) -> None:
    summary = json.loads((run / "summary.json").read_text())
    archive = tmp_path / "archive"
    archive.mkdir()
    shutil.copy(finished / "in" / "view_00.tif", archive)
    (archive / "view_01.tif").write_bytes((finished / "in" / "view_01.tif").read_bytes()[:-1] + b"?")
    for one in summary["inputs"]:
        one["path"] = str(tmp_path / "gone" / Path(one["path"]).name)
    (run / "summary.json").write_text(json.dumps(summary))
    code, found = findings(run)
    assert code == 3
    assert {now for (kind, _), now in found.items() if kind == "input"} == {"missing"}
    code, found = findings(run, archive)
    assert code == 3
    assert found["input", "view_00.tif"] == "moved"
    assert found["input", "view_01.tif"] == "missing"
    shutil.copy(finished / "in" / "view_01.tif", archive)
    assert findings(run, archive)[0] == 0
    (tmp_path / "gone").mkdir()
    shutil.copy(finished / "in" / "view_00.tif", tmp_path / "gone" / "view_01.tif")
    assert findings(run)[1]["input", "view_01.tif"] == "changed"


def test_a_run_without_hashes_is_one_line(run) -> None:
    summary = json.loads((run / "summary.json").read_text())
    del summary["inputs"]
    (run / "summary.json").write_text(json.dumps(summary))
    said = barpc("verify", run)
    assert (said.code, said.out) == (1, "")
    assert "holds no hashes" in said.err
    assert barpc("verify", run.parent / "nowhere").code == 1
