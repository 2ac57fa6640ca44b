"""A dry run: what it says is what the run then does, and nothing is written."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import barpc
from barpc.base.errors import OutputError
from barpc.rpcio import read_rpc, write_rpc
from tests.pipeline.known import SAMPLES as VIEWS
from tests.reliability.conftest import barpc as command

GCPS = "a,view_00,510,494,5.4,43.3,120\nb,view_00,610,494,5.4006,43.2999,131\n"


def everything(folder: Path) -> dict[str, tuple[int, int]]:
    """Every file and folder, with size and time of change."""
    return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in [folder, *folder.rglob("*")]}


def test_a_dry_run_writes_nothing_wherever_results_are_to_go(tmp_path, monkeypatch):
    (tmp_path / "full").mkdir()
    (tmp_path / "full/own.txt").touch()
    monkeypatch.chdir(tmp_path)
    before = everything(tmp_path), everything(VIEWS[0].parent)
    said = command("adjust", *VIEWS, "--dry-run", "-o", tmp_path / "new/deep")
    assert said.code == 0, said.err
    assert said.out.splitlines()[0].startswith("3 images, 3 pairs to match first: about ")
    assert "view_00 - view_01: " in said.out
    assert "no ground control" in said.out
    told = json.loads(command("--json", "adjust", *VIEWS, "--dry-run", "-o", tmp_path / "new/deep").out)
    assert told["pairs"] == [list(pair) for pair in barpc.plan(VIEWS).pairs]
    refused = command("adjust", *VIEWS, "--dry-run", "-o", tmp_path / "full")
    assert (refused.code, refused.out) == (1, "")
    assert "exists and is not empty" in refused.err
    with pytest.raises(OutputError, match="give overwrite=True or another out_dir"):
        barpc.plan(VIEWS, tmp_path / "full")
    assert (everything(tmp_path), everything(VIEWS[0].parent)) == before


def test_doubts_of_the_input_gate_are_said_and_what_is_no_input_is_refused(tmp_path):
    with pytest.raises(barpc.BarpcError, match=r"no\.tif"):
        barpc.plan([*VIEWS, tmp_path / "no.tif"])
    write_rpc(read_rpc(VIEWS[2]).window(0, 0, 4, 4), tmp_path / "coarse_RPC.TXT")
    coarse = f"{VIEWS[2]},camera={tmp_path / 'coarse_RPC.TXT'}"
    found = barpc.plan([*VIEWS[:2], coarse, tmp_path / "no.tif"], keep_going=True)
    assert [sum(name in one for one in found.doubts) for name in ("view_02", "no.tif")] == [1, 1], found.doubts
    said = command("adjust", *VIEWS[:2], coarse, tmp_path / "no.tif", "--keep-going", "--dry-run", "-o", tmp_path / "o")
    assert said.code == 3
    assert all(one in said.err for one in found.doubts)


def test_the_datum_that_is_assumed_is_said(tmp_path):
    (tmp_path / "gcps.csv").write_text("name,image,col,row,lon,lat,alt\n" + GCPS)
    found = barpc.plan(VIEWS, gcp=tmp_path / "gcps.csv")
    assert any("2 GCPs are taken as ellipsoidal (inferred); if they are above sea level" in s for s in found.datum)
    given = barpc.plan(VIEWS, gcp=tmp_path / "gcps.csv", geoid="egm96").datum
    assert any("egm96_15.tif, as given" in sentence for sentence in given)


def test_memory_grows_with_processes_and_images():
    one, three = barpc.plan(VIEWS[:2]), barpc.plan(VIEWS)
    assert one.cpu_seconds < three.cpu_seconds
    assert one.memory_mb < three.memory_mb


@pytest.mark.slow
def test_the_pairs_and_the_time_are_those_of_the_run(shared_data, tmp_path):
    """CPU within a factor of four: cores differ."""
    images = sorted((shared_data / "optical/phr_triplet_north").glob("*.tif"))
    found, done = barpc.plan(images), barpc.adjust(images, tmp_path / "run")
    assert [pair[:2] for pair in found.pairs] == [(pair.a, pair.b) for pair in done.record.pairs]
    assert {pair[:2]: pair[3] for pair in found.pairs} == pytest.approx(
        {(pair.a, pair.b): pair.convergence_deg for pair in done.record.pairs}, abs=0.5
    )
    took = sum(stage.cpu_seconds for stage in done.record.stages)
    assert found.cpu_seconds[0] / 2 < took < 2 * found.cpu_seconds[1]
    assert max(stage.peak_memory_mb for stage in done.record.stages) < 2.5 * found.memory_mb
