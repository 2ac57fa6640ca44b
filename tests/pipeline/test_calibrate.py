"""Sensors calibrated by finished runs, and runs with a calibration; tie points are given, images are empty."""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

import barpc
from barpc.base.errors import InputError
from barpc.base.options import AdjustOptions, RunOptions
from barpc.cameras import open_camera
from barpc.pipeline import AdjustResult, adjust
from barpc.pipeline.calibrate import calibrations_of, read_calibration
from barpc.pointio.matches import write_matches
from barpc.rpcio.carried import put_tag
from barpc.scene import Camera
from barpc.sensor.rpc import RPC
from benchmarks.calibrate import Scene, Sensor, any_looks, scene

SIZE = (4000, 3000)
RUNS = 6
pytestmark = pytest.mark.filterwarnings("ignore")


def files(made: Scene, folder: Path, sensor: str = "SIM1") -> list[Path]:
    """Write a scene's images, with their metadata, and its tie points."""
    folder.mkdir(parents=True)
    names = []
    for view in made.views:
        path, how = folder / f"{view.name}.tif", {"driver": "GTiff", "count": 1, "dtype": "uint8", "sparse_ok": True}
        with warnings.catch_warnings(action="ignore"):
            rasterio.open(path, "w", width=view.size[0], height=view.size[1], **how).close()
        assert isinstance(view.sensor, RPC)
        put_tag(path, view.sensor)
        if sensor:
            said = {"satellite_id": sensor, "instrument": "PAN", "acquired": "2020-01-01T10:00:00Z"}
            path.with_name(f"{view.name}_metadata.json").write_text(json.dumps(said))
        names.append(path)
    write_matches(folder / "ties.npz", made.tracks, [view.name for view in made.views])
    return names


def run(paths: list[Path], out: str = "adjusted", **given: Any) -> AdjustResult:
    folder = paths[0].parent
    # what one block takes for jitter of its own is the sensor's
    options = RunOptions(matches=(str(folder / "ties.npz"),), matches_only=True, adjust=AdjustOptions(jitter="off"), **given)
    return adjust(paths, folder / out, options)


@pytest.fixture(scope="module")
def line() -> Sensor:
    return Sensor.made("polynomials", 3, chips=4, size=SIZE)


@pytest.fixture(scope="module")
def archive(line: Sensor, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The folders of finished runs of one sensor."""
    place, rng, found = tmp_path_factory.mktemp("archive"), np.random.default_rng(5), []
    for i in range(RUNS):
        paths = files(scene(any_looks(3, rng), line, rng, 500, size=SIZE), place / f"scene{i}")
        run(paths)
        found.append(paths[0].parent / "adjusted")
    return found


@pytest.fixture(scope="module")
def calibration(archive: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("cal") / "SIM1_PAN.cal"
    barpc.calibrate(archive, out)
    return out


def straight(curve: np.ndarray, cols: np.ndarray) -> np.ndarray:
    fit = np.polynomial.polynomial.polyfit(cols, curve, 1)
    return curve - np.polynomial.polynomial.polyval(cols, fit).T


@pytest.mark.slow
def test_runs_tell_the_curve_and_how_well(calibration: Path, archive: list[Path], line: Sensor) -> None:
    found, text = read_calibration(calibration), json.loads(calibration.read_text())
    cols = np.arange(5.0, SIZE[0] - 5.0)
    cols = cols[np.abs(cols[:, None] - line.edges).min(axis=1) > 5.0]
    truth = straight(line.curve(cols), cols)
    wrong = np.sqrt((straight(found.spline.at(cols), cols) - truth) ** 2).mean(axis=0)
    assert (wrong < 0.1 * np.sqrt((truth**2).mean())).all()
    assert np.linalg.norm(wrong) < 2.0 * np.linalg.norm(text["sigma_px"])
    assert np.linalg.norm(text["sigma_px"]) < 0.1
    assert text["sensor"] == "SIM1_PAN"
    assert [one["name"] for one in text["runs"]] == ["adjusted"] * RUNS
    assert len({one["root"] for one in text["runs"]}) == RUNS
    assert sum(one["gain"] > 0 for one in text["runs"]) == RUNS
    assert calibration.stat().st_size < 60_000
