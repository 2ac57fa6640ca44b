"""A run that Python opens is what `adjust` returned, to the bit; what is no run, or half of one, is said."""

from __future__ import annotations

import csv
import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from click.testing import CliRunner

import barpc
from barpc.base.errors import BarpcWarning, InputError
from barpc.cli import cli
from barpc.pipeline import AdjustResult
from barpc.report import summarize
from barpc.report.overview import RUN_COLUMNS
from barpc.report.runfiles import OBSERVATION_COLUMNS
from tests.pipeline.known import SAMPLES
from tests.report.conftest import run_of_block, written


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> tuple[AdjustResult, Path]:
    """A simulated run with outliers, and its folder."""
    run, folder = run_of_block(3, 60, size=(900, 700), outliers=0.05), tmp_path_factory.mktemp("opened") / "run"
    written(run, folder)
    run = replace(run, out_dir=str(folder))
    views = tuple(replace(view, sensor=fit.rpc) for view, fit in zip(run.views, run.fits, strict=True))
    return AdjustResult(views, run, summarize(run)), folder


def assert_same(opened: barpc.OpenedRun, result: AdjustResult) -> None:
    """All that `adjust` returned but the seconds of its stages, which no file holds."""
    assert opened.views == result.views
    assert opened.tracks == result.tracks
    assert opened.passed == result.passed
    assert opened.to_geojson() == json.loads(json.dumps(result.to_geojson()))
    one, two = opened.summary, result.summary
    assert {k: v for k, v in one.items() if k not in ("stages", "inputs", "outputs")} == {
        k: v for k, v in two.items() if k not in ("stages", "inputs", "outputs")
    }
    assert repr(opened) == repr(result).replace("AdjustResult", "OpenedRun")
    for name in ("view", "track", "xy", "before", "after", "used"):
        np.testing.assert_array_equal(
            getattr(opened.tables.observations, name), getattr(result.tables.observations, name)
        )


def test_an_opened_run_is_what_was_returned(done):
    result, folder = done
    opened = barpc.open_run(folder)
    assert_same(opened, result)
    rows = list(csv.DictReader((folder / "tables/observations.csv").read_text().splitlines()))
    assert tuple(rows[0]) == OBSERVATION_COLUMNS
    found = opened.tables.observations
    np.testing.assert_array_equal(found.xy, [[float(row["col"]), float(row["row"])] for row in rows])
    assert [opened.views[i].name for i in found.view] == [row["view"] for row in rows]
    with np.load(folder / "tables/matches.npz") as file:
        np.testing.assert_array_equal(file["xy"], result.run.tracks.xy)
    for view, feature in zip(opened.views, opened.to_geojson()["features"], strict=True):
        middle = view.sensor.localize((np.array(view.size) - 1) / 2, result.record.altitude_m)
        assert feature["properties"]["name"] == view.name
        assert shapely.geometry.shape(feature["geometry"]).contains(shapely.Point(middle[:2]))


def test_a_check_has_no_folder_to_read_from(done):
    result, _ = done
    check = AdjustResult(result.run.views, replace(result.run, out_dir=""), replace(result.record, out_dir=None))
    assert check.to_geojson() == result.to_geojson()
    for ask in (lambda: check.tables, check.report):
        with pytest.raises(InputError, match="a check writes no files"):
            ask()


def _half(folder: Path) -> None:
    (folder / "SHA256SUMS").unlink()


def _ended(folder: Path) -> None:
    (folder / "SHA256SUMS").unlink()
    (folder / "summary.json").unlink()


def _edited(name: str):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-40] + b"0" * 40)


@pytest.mark.parametrize(
    ("spoil", "ask", "words"),
    [
        (shutil.rmtree, "views", "no summary.json, so no finished run; give the folder of one"),
        (_ended, "views", "no summary.json, so no finished run"),
        (_half, "views", "SHA256SUMS: missing: the run was interrupted"),
        (_edited("summary.json"), "passed", "summary.json: was changed since the run wrote it"),
        (_edited("view_0000_RPC.TXT"), "views", "view_0000_RPC.TXT: was changed since"),
        (lambda folder: (folder / "view_0001_RPC.TXT").unlink(), "views", "view_0001_RPC.TXT: is gone since"),
        (_edited("tables/matches.npz"), "tracks", "matches.npz: was changed since"),
        (_edited("tables/observations.csv"), "tables", "observations.csv: was changed since"),
    ],
)
def test_what_is_no_whole_run_is_refused_in_a_line(spoil, ask, words, done, tmp_path):
    folder = shutil.copytree(done[1], tmp_path / "run")
    spoil(folder)
    with pytest.raises(InputError, match=words) as caught:
        getattr(barpc.open_run(folder), ask)
    assert "\n" not in str(caught.value)


def test_verify_is_false_where_something_changed(done, tmp_path):
    folder = shutil.copytree(done[1], tmp_path / "run")
    found = barpc.verify(folder)
    assert found
    assert repr(found) == f"Verification({len(found)} files, none has changed)"
    _edited("view_0000_RPC.TXT")(folder)
    assert not barpc.verify(folder)
    assert "view_0000_RPC.TXT changed" in repr(barpc.verify(folder))


def test_runs_are_listed_a_line_each_and_what_is_none_has_its_reason(done, tmp_path):
    _, folder = done
    odd = shutil.copytree(folder, tmp_path / "=run, two")
    _half(half := shutil.copytree(folder, tmp_path / "half"))
    words = [str(one) for one in (folder, odd, half, tmp_path / "none")]
    said = CliRunner().invoke(cli, ["report", "--csv", *words], standalone_mode=False)
    assert said.return_value == 3
    rows = list(csv.DictReader(io.StringIO(said.stdout)))
    assert tuple(rows[0]) == RUN_COLUMNS
    assert [row["status"] for row in rows] == [done[0].record.status] * 2 + ["none"] * 2
    assert [row["run"].removeprefix("'") for row in rows] == words
    assert "SHA256SUMS: missing" in rows[2]["reasons"]
    views = json.loads((folder / "summary.json").read_text())["views"]
    assert float(rows[0]["rmse_after_px"]) == pytest.approx(np.median([one["rmse_after"] for one in views]), rel=1e-3)
    assert "2 of 4 folders hold no finished run" in said.stderr
    told = CliRunner().invoke(cli, ["--json", "report", "--csv", words[0]], standalone_mode=False)
    assert told.return_value == 0
    assert json.loads(told.stdout) == barpc.report(words[0], csv=True)
    with pytest.raises(InputError, match="3 runs: give one, two to compare, or any number with csv=True"):
        barpc.report(*words[:3])


@pytest.mark.slow
def test_samples_opened_where_they_are_and_after_their_images_moved(tmp_path):
    images = [shutil.copy(path, tmp_path) for path in SAMPLES]
    result = barpc.adjust(images, tmp_path / "run", points_per_image=400)
    assert_same(barpc.open_run(tmp_path / "run"), result)
    assert barpc.open_run(tmp_path / "run").root == result.root
    (tmp_path / "other").mkdir()
    for image in images:
        shutil.move(image, tmp_path / "other")
    shutil.move(tmp_path / "run", tmp_path / "other/run")  # beside its images again
    moved = barpc.open_run(tmp_path / "other/run")
    assert [Path(view.path) for view in moved.views] == [tmp_path / "other" / Path(one).name for one in images]
    (tmp_path / "other/view_01.tif").unlink()
    with pytest.warns(BarpcWarning, match=r"view_01\.tif: is gone") as caught:
        views = barpc.open_run(tmp_path / "other/run").views
    assert len(caught) == 1
    assert [view.sensor for view in views] == [view.sensor for view in result.views]
    shutil.copy(SAMPLES[1], tmp_path / "other")
    (tmp_path / "other/view_02.tif").write_bytes(SAMPLES[0].read_bytes())
    with pytest.warns(BarpcWarning, match=r"view_02\.tif: is not the file that"):
        assert barpc.open_run(tmp_path / "other/run").views[2].sensor == result.views[2].sensor


@pytest.mark.slow
def test_a_real_run_with_text_files_alone_and_its_matches_again(shared_data, tmp_path):
    images = sorted((shared_data / "optical/phr_triplet_north").glob("*.tif"))
    result = barpc.adjust(images, tmp_path / "run", images="none", rpc_format=("txt",), points_per_image=800)
    assert_same(barpc.open_run(tmp_path / "run"), result)
    matches = tmp_path / "run/tables/matches.npz"
    again = barpc.adjust(images, tmp_path / "again", matches=matches, matches_only=True)
    assert again.tracks == result.tracks
