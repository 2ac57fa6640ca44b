"""Figures beside other tools are in no favour of either: check points of turned images, surfaces on other cells."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import Affine
from scipy import ndimage

from barpc.sensor.rpc import RPC
from benchmarks.real import Row, across, features, held_out, matched, measured
from benchmarks.real_sets import Change, as_rasterio, changed, correlated
from benchmarks.surfaces import between, heights
from tests.fit.cameras import synthetic_rpc
from tests.geotiffs import write_image


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_check_points_are_at_the_same_place_in_a_turned_image(turns: int) -> None:
    texture = np.random.default_rng(4).normal(size=(40, 48)).repeat(6, axis=0).repeat(6, axis=1)
    for axis in (0, 1):  # blurred: keypoints of several sizes
        for _ in range(3):
            texture = (np.roll(texture, 1, axis) + texture + np.roll(texture, -1, axis)) / 3
    grey = np.clip(128 + 40 * texture, 0, 255).astype(np.uint8)
    rows = matched(features(grey), features(np.ascontiguousarray(np.rot90(grey, turns))))
    height, width = grey.shape
    col, row, *other = rows.T
    right = [(col, row), (row, width - 1 - col), (width - 1 - col, height - 1 - row), (height - 1 - row, col)][turns]
    assert len(rows) > 100
    off = np.array(other) - right
    assert np.abs(np.median(off, axis=1)).max() < 0.02
    assert np.median(np.abs(off)) < 0.1


def surface(path: Path, values: np.ndarray, west: float, north: float) -> Path:
    path.parent.mkdir(exist_ok=True)
    place = Affine(1.0, 0.0, west, 0.0, -1.0, north)
    return write_image(path, values, crs="EPSG:32631", transform=place, nodata=-999.0)


def test_surfaces_are_compared_at_the_same_ground(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    ground = np.add.outer(np.linspace(0, 60, 120), np.linspace(90, 0, 150)).astype(np.float32)
    whole = surface(tmp_path / "a.tif", ground, 5000.0, 9000.0)
    seen = (ground + 0.5 + rng.normal(0, 0.3, ground.shape)).astype(np.float32)[10:, 20:]
    seen[:30] = -999.0
    other = surface(tmp_path / "b.tif", seen, 5020.0, 8990.0)
    assert np.isfinite(heights(other, whole)).sum() == (seen > -999).sum()
    middle, noise = (float(between(other, whole).split()[i]) for i in (0, 2))
    assert middle == pytest.approx(0.5, abs=0.02)
    assert 0.001 < noise < 0.02  # 0.3 m over 10,000 cells, of medians


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).resolve().parents[1] / "benchmarks").glob("*.py")), ids=lambda path: path.name
)
def test_a_command_finds_these_tests_before_those_of_other_packages(path: Path) -> None:
    """Some packages install a folder `tests`, and a command starts with its own folder alone."""
    text = path.read_text(encoding="utf-8")
    at = [text.find(start) for start in ("\nfrom tests", "\n    from tests") if start in text]
    assert not at or 0 <= text.find("sys.path.insert(0, ") < min(at)


# --- sets that are made ------------------------------------------------------------------------------------


CAMERA = synthetic_rpc()
MIDDLE = np.array([10700.0, 9100.0])
GROUND = np.concatenate([CAMERA.localize(MIDDLE, np.array(500.0))[:2], [500.0]])


def wrong_by(change: Change) -> RPC:
    """What GDAL's names, changed, mean to this package."""
    told = changed(as_rasterio(CAMERA, np.zeros(2)), MIDDLE, change, GROUND)
    coeffs = [told.samp_num_coeff, told.samp_den_coeff, told.line_num_coeff, told.line_den_coeff]
    offset = [told.long_off, told.lat_off, told.height_off]
    scale = [told.long_scale, told.lat_scale, told.height_scale]
    places = [told.samp_off, told.line_off], [told.samp_scale, told.line_scale]
    return RPC(np.array(coeffs), offset, scale, *places)


def test_a_shift_moves_every_point_by_it() -> None:
    some = CAMERA.localize(np.random.default_rng(1).uniform(0, 20000, (50, 2)), np.linspace(0, 900, 50))
    off = wrong_by(Change((12.0, -16.0))).project(some) - CAMERA.project(some)
    np.testing.assert_allclose(off, np.broadcast_to([12.0, -16.0], off.shape), atol=1e-8)


def test_a_scale_is_about_the_middle() -> None:
    some = CAMERA.localize(np.random.default_rng(1).uniform(0, 20000, (50, 2)), np.linspace(0, 900, 50))
    before = CAMERA.project(some)
    np.testing.assert_allclose(
        wrong_by(Change(scale=2e-3)).project(some), MIDDLE + 1.002 * (before - MIDDLE), atol=1e-8
    )


@pytest.mark.parametrize("yaw", [3e-3, -0.4])
def test_a_yaw_is_of_the_ground_about_the_middle_to_the_last_digit(yaw: float) -> None:
    camera = wrong_by(Change(yaw=yaw))
    np.testing.assert_allclose(camera.project(GROUND), MIDDLE, atol=1e-7)
    east, north = 300.0 * np.array([np.cos(yaw), np.sin(yaw)])  # of the ground that is seen where 300 m east was
    for alt in (100.0, 800.0):
        here, there = (offset_metres(GROUND[:2], *by, alt) for by in ((300.0, 0.0), (east, north)))
        np.testing.assert_allclose(camera.project(here), CAMERA.project(there), atol=1e-6)


def offset_metres(lonlat: np.ndarray, east: float, north: float, alt: float) -> np.ndarray:
    """A place east and north of another, on a sphere's degrees."""
    degree = 111_000.0
    lon = lonlat[0] + east / degree / np.cos(np.radians(lonlat[1]))
    return np.array([lon, lonlat[1] + north / degree, alt])


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, -1.8), (-3.3, 2.6)])
def test_correlation_of_gradients_finds_a_shift_under_other_tones(shift: tuple[float, float]) -> None:
    rng = np.random.default_rng(6)
    ground = ndimage.gaussian_filter(rng.normal(size=(420, 420)), 2.5)
    ground = 1000.0 + 250.0 * ground / ground.std()
    moved = ndimage.shift(ground, shift[::-1], order=5, mode="nearest")
    other = (3000.0 - 0.8 * moved + rng.normal(0, 5, moved.shape)).astype(np.uint16)  # what was bright is dark
    other[:, :60] = 0  # no data
    at, there = correlated(ground.astype(np.uint16), other, side=64)
    assert len(at) > 15
    assert there[:, 0].min() > 60
    np.testing.assert_allclose(np.median(there - at, axis=0), shift, atol=0.05)


def test_corners_lie_beside_their_lines_with_a_sign() -> None:
    lines = np.array([[0.0, 0.0], [5.0, 5.0], [10.0, 0.0], [15.0, 5.0]])  # two lines along the columns
    assert across(lines, np.array([[3.0, 0.25], [-9.0, 5.25]])) == "+0.250 +- 0.000 (2)"
    assert across(lines, np.array([[3.0, -0.5], [2.0, 4.5]])) == "-0.500 +- 0.000 (2)"


FORMULA = """
import json
from pathlib import Path
import numpy as np
class Rpc:
    def __init__(self, path):
        self.mean = np.array(json.loads(Path(path).read_text()))
    def project(self, ground):
        return np.tile(self.mean, (len(ground), 1))
"""


def test_every_control_point_is_held_out_once_and_alone(tmp_path: Path) -> None:
    """A tool that says the mean of its control points is as wrong as leaving one out makes it, not less."""
    (tmp_path / "check.py").write_text(FORMULA)
    seen = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 8.0]])
    rows = [{"properties": {"ji": one}, "geometry": {"coordinates": [5.0, 43.0, 0.0]}} for one in seen.tolist()]
    (tmp_path / "points.json").write_text(json.dumps({"type": "FeatureCollection", "features": rows}))

    def refine(gcps: Path, out: Path) -> tuple[Row, dict[str, Path]]:
        assert not out.exists()
        rest = json.loads(gcps.read_text())
        assert rest["type"] == "FeatureCollection"
        places = [one["properties"]["ji"] for one in rest["features"]]
        out.mkdir()
        (out / "camera").write_text(json.dumps(np.mean(places, axis=0).tolist()))
        return Row("mean", cpu=float(len(places)), code=0), {"a": out / "camera"}

    row = held_out(refine, tmp_path / "check.py", tmp_path / "points.json", tmp_path / "runs")
    assert (row.tool, row.cpu) == ("mean", 2.0)
    assert row.offset == "GCPs {:.2f}, {:.2f} (3)".format(*np.sqrt([(4 + 16 + 4) / 3, (16 + 16 + 64) / 3]))


def test_memory_of_a_command_is_not_that_of_who_measures_it(tmp_path: Path) -> None:
    held = np.ones(40_000_000)  # 320 MB
    code = "import sys; a = bytearray(b'x' * 60_000_000); sum(range(10**6)); sys.exit(7)"
    cpu, peak, ended = measured([sys.executable, "-c", code], tmp_path, tmp_path / "log")
    assert ended == 7
    assert 0.01 < cpu < 10
    assert 60 < peak < 180
    assert held.size
