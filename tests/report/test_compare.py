"""Two runs side by side."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from barpc.cli.main import cli
from barpc.errors import InputError
from barpc.report.compare import compare_runs
from barpc.rpcio import read_rpc, write_rpc


def test_a_run_does_not_differ_from_itself(block_run):
    found = compare_runs(block_run.folder, block_run.folder)
    assert len(found["views"]) == 9
    for view in found["views"]:
        assert view["rpc_difference_px"] == 0
        assert view["rmse"][0] == view["rmse"][1]
    assert found["options"] == found["only_a"] == found["only_b"] == []


def test_a_shift_of_a_camera_is_found_and_told_from_a_change_of_its_shape(block_run, tmp_path):
    shutil.copytree(block_run.folder, tmp_path / "other")
    path = tmp_path / "other" / f"{block_run.views[3].name}_RPC.TXT"
    rpc = read_rpc(path)
    write_rpc(replace(rpc, image_offset=rpc.image_offset + [3.0, -4.0]), path, overwrite=True)
    found = compare_runs(block_run.folder, tmp_path / "other")
    assert found["views"][3]["rpc_difference_px"] == pytest.approx(5.0, abs=1e-6)
    assert found["views"][3]["rpc_difference_without_shift_px"] < 1e-6
    assert "differ by up to 5 px (view_0003)" in " ".join(found["lines"])


def test_options_and_images_of_one_run_alone_are_named(block_run, tmp_path):
    shutil.copytree(block_run.folder, tmp_path / "other")
    summary = json.loads((tmp_path / "other/summary.json").read_text())
    summary["options"]["adjust"]["drift"] = 1
    gone = summary["views"].pop()["name"]
    summary["pairs"] = [pair for pair in summary["pairs"] if gone not in (pair["a"], pair["b"])]
    (tmp_path / "other/summary.json").write_text(json.dumps(summary))
    found = compare_runs(block_run.folder, tmp_path / "other")
    assert found["options"] == [{"option": "adjust.drift", "values": [None, 1]}]
    assert found["only_a"] == [block_run.views[-1].name]
    assert "Option adjust.drift: None in A, 1 in B." in found["lines"]


def test_runs_without_files_are_compared_by_their_errors(block_run, check_run):
    found = compare_runs(check_run.folder, block_run.folder)
    assert all(view["rpc_difference_px"] is None for view in found["views"])
    assert np.median([view["rmse"][0] / view["rmse"][1] for view in found["views"]]) > 3


def test_runs_of_other_images_are_refused(block_run, antimeridian_run):
    with pytest.raises(InputError, match="no image in common"):
        compare_runs(block_run.folder, antimeridian_run.folder)


def test_the_verb_prints_tables_or_json(block_run, check_run):
    arguments = ["report", str(check_run.folder), str(block_run.folder)]
    text = CliRunner().invoke(cli, arguments, standalone_mode=False)
    assert "error A [px]  error B [px]" in text.output
    found = CliRunner().invoke(cli, [*arguments, "--json"], standalone_mode=False)
    assert json.loads(found.output) == compare_runs(check_run.folder, block_run.folder)
