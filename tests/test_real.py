"""Figures beside other tools are in no favour of either: check points of turned images, surfaces on other cells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from benchmarks.real import features, matched
from benchmarks.surfaces import between, heights


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
    size = {"width": values.shape[1], "height": values.shape[0], "count": 1, "dtype": values.dtype}
    place = {"crs": "EPSG:32631", "transform": Affine(1.0, 0.0, west, 0.0, -1.0, north), "nodata": -999.0}
    with rasterio.open(path, "w", "GTiff", **size, **place) as file:
        file.write(values, 1)
    return path


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
