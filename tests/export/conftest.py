"""Finished runs, as exports find them: a site in the south, one on the 180th meridian; and plain readers of exports."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from barpc.cli import main
from barpc.export.shots import Scene, read_scene
from tests.report.conftest import run_of_block, written
from tests.sealing import seal

DIM = """<Dimap_Document><IMAGING_DATE>2013-04-17</IMAGING_DATE><IMAGING_TIME>10:32:15.5Z</IMAGING_TIME>
<SUN_AZIMUTH unit="deg">150.5</SUN_AZIMUTH><SUN_ELEVATION unit="deg">52.25</SUN_ELEVATION></Dimap_Document>"""


def _run(folder: Path, **where: float) -> Path:
    run = run_of_block(3, 300, size=(900, 700), outliers=0.03, **where)
    images = folder / "images à part"
    images.mkdir()
    (images / "north.xml").write_text(DIM)
    paths = (images / "north.tif", folder / "other" / "same.tif", folder / "twin" / "same.tif")
    views = tuple(replace(v, path=str(path)) for v, path in zip(run.views, paths, strict=True))
    written(replace(run, views=views), folder / "run")
    return folder / "run"


@pytest.fixture(scope="session")
def southern(tmp_path_factory) -> Path:
    """Three images of a place at 33 degrees south, 70 west."""
    return _run(tmp_path_factory.mktemp("south"), lon=-70.3, lat=-33.4)


@pytest.fixture(scope="session")
def on_date_line(tmp_path_factory) -> Path:
    return _run(tmp_path_factory.mktemp("dateline"), lon=180.0, lat=-16.8)


@pytest.fixture(params=["southern", "on_date_line"])
def run_dir(request) -> Path:
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="session")
def south(southern) -> Scene:
    return read_scene(southern)


@pytest.fixture(scope="session")
def dateline(on_date_line) -> Scene:
    return read_scene(on_date_line)


def read(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


def changed(
    run: Path, folder: Path, edit: Callable[[dict[str, Any]], object] = lambda summary: None, **tables: list[str]
) -> Path:
    """A copy of a run in a folder, as if it had been written so: its summary edited, tables of other lines."""
    shutil.copytree(run, folder / "run")
    summary = read(folder / "run/summary.json")
    edit(summary)
    (folder / "run/summary.json").write_text(json.dumps(summary))
    for name, lines in tables.items():
        (folder / f"run/tables/{name}.csv").write_text("".join(f"{line}\n" for line in lines))
    return seal(folder / "run")


def table(run: Path, name: str) -> list[str]:
    """The lines of a run's table."""
    return (run / f"tables/{name}.csv").read_text().splitlines()


def ended(*words: object) -> int:
    """The exit code of `barpc export`."""
    with pytest.raises(SystemExit) as stop:
        main(["export", *map(str, words)])
    return int(stop.value.code or 0)


def ecef(lon: np.ndarray, lat: np.ndarray, alt: np.ndarray) -> np.ndarray:
    """ECEF coordinates (N, 3) [m] of ground points, by PROJ."""
    pyproj = pytest.importorskip("pyproj")
    to = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    return np.column_stack(to.transform(lon, lat, alt))


class Posed(NamedTuple):
    """An image of COLMAP's texts: its number and its camera's, focal lengths, principal point, world to camera.

    `places` (n, 3): column, row and number of the points that it shows.
    """

    number: int
    camera: int
    name: str
    size: tuple[int, int]
    focal: np.ndarray
    center: np.ndarray
    turn: np.ndarray
    shift: np.ndarray
    places: np.ndarray

    def project(self, world: np.ndarray) -> np.ndarray:
        """Columns and rows (N, 2), (0, 0) at the corner of the first pixel."""
        seen = world @ self.turn.T + self.shift
        return self.focal * seen[:, :2] / seen[:, 2:] + self.center


def turned(w: float, x: float, y: float, z: float) -> np.ndarray:
    """The rotation of a quaternion."""
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def posed(model: Path) -> Iterator[Posed]:
    """The images of a model in COLMAP's texts, in their order."""
    cameras = {}
    for line in (model / "sparse/0/cameras.txt").read_text().splitlines():
        number, kind, *rest = line.split()
        assert kind == "PINHOLE"
        cameras[number] = [float(word) for word in rest]
    lines = iter((model / "sparse/0/images.txt").read_text().splitlines())
    for line, seen in zip(lines, lines, strict=True):
        number, *words, camera, name = line.split()
        pose, (width, height, *numbers) = np.array(words, float), cameras[camera]
        assert pose[0] >= 0
        focal, center = np.array(numbers).reshape(2, 2)
        places = np.array(seen.split(), float).reshape(-1, 3)
        size = int(width), int(height)
        yield Posed(int(number), int(camera), name, size, focal, center, turned(*pose[:4]), pose[4:], places)
