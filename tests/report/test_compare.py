"""Two runs side by side."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from barpc.base.errors import InputError
from barpc.base.geodesy import metres_per_unit
from barpc.cli import cli
from barpc.report.compare import compare_runs
from barpc.report.records import flat_options, json_form
from barpc.rpcio import read_rpc, write_rpc
from tests.rpcio.conftest import make_rpc
from tests.sealing import seal

from .made import a_pair, a_summary, a_view


def compare(*folders: Path) -> dict[str, Any]:
    """Two runs, which are as they were written: another test changes them."""
    return compare_runs(*map(seal, folders))


def test_a_shift_of_a_camera_is_found_and_told_from_a_change_of_its_shape(block_run, copied):
    path = copied(block_run) / f"{block_run.views[3].name}_RPC.TXT"
    rpc = read_rpc(path)
    write_rpc(replace(rpc, image_offset=rpc.image_offset + [3.0, -4.0]), path, overwrite=True)
    found = compare(block_run.folder, path.parent)
    assert found["views"][3]["rpc_difference_px"] == pytest.approx(5.0, abs=1e-6)
    assert found["views"][3]["rpc_difference_without_shift_px"] < 1e-6
    assert "differ by up to 5 px (view_0003)" in " ".join(found["lines"])
    others = [view for k, view in enumerate(found["views"]) if k != 3]
    assert [view["rpc_difference_px"] for view in others] == [0.0] * 8
    assert all(view["rmse"][0] == view["rmse"][1] for view in found["views"])
    assert found["options"] == found["only_a"] == found["only_b"] == []


@pytest.mark.parametrize("motion", [(0.0, 0.0, 0.0), (3.0, -4.0, 12.0)])
def test_the_motion_of_the_scene_is_told_in_metres_from_the_first_run_to_the_second(block_run, copied, motion):
    """RPCs whose ground is set elsewhere as a whole, whatever the summary says of it."""
    other = copied(block_run)
    for view in block_run.views:
        path = other / f"{view.name}_RPC.TXT"
        rpc = read_rpc(path)
        by = np.array(motion) / metres_per_unit(rpc.ground_offset)
        write_rpc(replace(rpc, ground_offset=rpc.ground_offset + by), path, overwrite=True)
    found = compare(block_run.folder, other)
    assert found["moved_enu_m"] == pytest.approx(motion, abs=0.02)
    back = compare(other, block_run.folder)["moved_enu_m"]
    assert back == pytest.approx([-one for one in motion], abs=0.02)
    said = next(line for line in found["lines"] if line.startswith("The scene moved by "))
    if any(motion):
        assert re.fullmatch(r"The scene moved by \+3\.0\d m east, -\S+ m north, \+1\S+ m up, 13 m in all, .*", said)


def test_of_rpcs_of_one_image_no_motion_of_the_scene_is_told(block_run, copied):
    views = block_run.summary["views"]
    for name, some in (("one", views[:1]), ("two", [views[0], {**views[1], "outputs": {}}])):
        folder = copied(block_run, name, lambda summary, some=some: summary.update(views=some, pairs=[]))
        found = compare(folder, folder)
        assert found["moved_enu_m"] is None
        assert "moved" not in " ".join(found["lines"])


def test_runs_of_other_images_are_refused(block_run, antimeridian_run):
    first, second = (run.views[0].name for run in (block_run, antimeridian_run))
    said = rf"no image in common \({first} and others there, {second} here\)"
    with pytest.raises(InputError, match=said):
        compare(block_run.folder, antimeridian_run.folder)


def test_the_verb_prints_tables_or_json(block_run, check_run):
    arguments = ["report", str(check_run.folder), str(block_run.folder)]
    text = CliRunner().invoke(cli, arguments, standalone_mode=False)
    assert "error A [px]  error B [px]" in text.output
    found = CliRunner().invoke(cli, [*arguments, "--json"], standalone_mode=False)
    assert json.loads(found.output) == compare(check_run.folder, block_run.folder)


@pytest.fixture
def compared(tmp_path):
    """Compares two runs by their summaries and the RPCs that they wrote, image by image."""

    def made(*runs, rpcs=({}, {})):
        folders = [tmp_path / f"{len([*tmp_path.iterdir()])}_{name}" for name in "ab"]
        for folder, summary, written in zip(folders, runs, rpcs, strict=True):
            folder.mkdir()
            (folder / "summary.json").write_text(json.dumps(json_form(summary)))
            for name, rpc in written.items():
                write_rpc(rpc, folder / f"{name}_RPC.TXT")
        return compare(*folders)

    return made


def test_what_is_said_of_two_runs(compared):
    errors = {"A": (1.0, 0.1), "B": (3.0, 0.3), "C": (2.0, 0.2)}
    a, b = (
        [a_view(name, rmse_after=of[k], outputs={f"{name}_RPC.TXT": {}}) for name, of in errors.items()] for k in (0, 1)
    )
    rpc = make_rpc()
    bent = replace(rpc, image_scale=rpc.image_scale * 1.0001)
    first = a_summary([*a, a_view("X"), a_view("Y")], options={"tie": {"band": 1}})
    second = a_summary(b, options={})
    rpcs = {"A": rpc, "B": rpc}, {"A": bent, "B": rpc.crop(3.0, -4.0)}
    found = compared(first, second, rpcs=rpcs)
    (whole, bend), (shift, rest), nothing = (
        (view["rpc_difference_px"], view["rpc_difference_without_shift_px"]) for view in found["views"]
    )
    assert nothing == (None, None)
    assert (shift, rest) == pytest.approx((5.0, 0.0), abs=1e-6)
    assert 0.01 < bend <= whole < 2.0
    assert found["lines"] == [
        "3 images in both: their tie points have residuals of 2.000 px in A, 0.200 px in B.",
        f"Their RPCs differ by up to 5 px (B), by {bend:.3g} px once the mean shift of each image is taken away.",
        "In A alone: X, Y.",
        "Option tie.band: 1 in A, None in B.",
    ]
    assert len(compared(a_summary(a[2:]), a_summary([b[2], a_view("Z")]))["lines"]) == 2


def test_each_run_s_error_is_that_of_its_last_cameras(compared):
    check, adjusted = a_view(rmse_before=2.0, rmse_after=None, num_observations=5), a_view(rmse_after=0.2)
    (found,) = compared(a_summary([check]), a_summary([adjusted]))["views"]
    assert (found["rmse"], found["num_observations"]) == ([2.0, 0.2], [5, 100])
    assert found["rpc_difference_px"] is found["rpc_difference_without_shift_px"] is None


def test_where_the_first_of_two_cameras_sees_no_ground_no_difference_is_told(compared):
    run = a_summary([a_view(outputs={"A_RPC.TXT": {}})])
    far, near = ({"A": make_rpc().crop(beside, 0.0)} for beside in (1e12, 0.0))
    (found,) = compared(run, run, rpcs=(far, near))["views"]
    assert found["rpc_difference_px"] is found["rpc_difference_without_shift_px"] is None
    assert compared(run, run, rpcs=(near, near))["views"][0]["rpc_difference_px"] == 0.0


def test_pairs_in_both_are_set_side_by_side_with_their_last_offsets(compared):
    views = [a_view(name) for name in "ABC"]
    a = a_summary(views, [a_pair("A", "B", 5, epipolar_after=None), a_pair("A", "C"), a_pair("B", "C", 8)])
    b = a_summary(views, [a_pair("B", "C", 9), a_pair("A", "B", 7)])
    assert compared(a, b)["pairs"] == [
        {"a": "A", "b": "B", "num_matches": [5, 7], "epipolar_rms": [0.4, 0.1]},
        {"a": "B", "b": "C", "num_matches": [8, 9], "epipolar_rms": [0.1, 0.1]},
    ]


def test_options_of_one_run_alone_count_and_those_without_effect_do_not(compared):
    options = ({"x": 1, "now": None, "deep": {"y": 2}, "overwrite": True}, {"x": 1, "now": 3, "z": {}, "keep_going": 1})
    found = compared(*(a_summary([a_view("A"), a_view(f"only {k}")], options=options[k]) for k in (0, 1)))
    assert found["options"] == [
        {"option": "now", "values": [None, 3]},
        {"option": "deep.y", "values": [2, None]},
        {"option": "z", "values": [None, {}]},
    ]
    assert (found["only_a"], found["only_b"], found["versions"]) == (["only 0"], ["only 1"], ["1", "1"])
    assert [Path(found[key], "summary.json").is_file() for key in "ab"] == [True, True]
    assert [found[key][-2:] for key in "ab"] == ["_a", "_b"]
    assert [view["name"] for view in found["views"]] == ["A"]
    assert flat_options({"a": {"b": {"c": 1}}, "d": {}}) == {"a.b.c": 1, "d": {}}


def test_runs_of_other_images_of_the_same_names_are_not_compared(block_run, copied):
    def of(folder: str, *digits: str) -> Path:
        """Images of other places, and of other contents by these digits."""

        def change(summary):
            for view in summary["views"]:
                view["path"] = f"/{folder}/{view['name']}.tif"
            summary["inputs"] = [
                {"path": view["path"], "bytes": 9, "sha256": digit * 64}
                for view, digit in zip(summary["views"], digits, strict=True)
            ]

        return copied(block_run, folder, change)

    one = of("one", "0", *"11111111")
    found = compare(one, of("two", "0", *"22222222"))
    assert [view["name"] for view in found["views"]] == ["view_0000"]
    assert found["only_a"] == found["only_b"] == [view.name for view in block_run.views[1:]]
    with pytest.raises(InputError, match="are other files, so these runs have none in common: nothing to compare"):
        compare(one, of("three", *"222222222"))


def test_a_file_is_the_same_option_from_folders_of_any_depth(block_run, copied, tmp_path):
    def of(folder, path):
        given = {"dem": path, "gcp": [path, "https://a.org/x"], "aoi": None}
        return copied(block_run, folder, lambda summary: summary["options"].update(given))

    one, deeper = of("one", "../srtm.tif"), of("two/deeper", "../../srtm.tif")
    other, moved = of("three/other", "../srtm.tif"), of("other/folder", "../../other.tif")
    assert compare(one, deeper)["options"] == []
    assert compare(one, other)["options"] == []  # a run that was moved
    differ = compare(one, moved)["options"]
    assert [row["option"] for row in differ] == ["gcp", "dem"]
    assert differ[1]["values"] == [str(tmp_path / "srtm.tif"), str(tmp_path / "other.tif")]
