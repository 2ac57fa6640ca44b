"""What every verb that writes cameras prints, read again from its files by GDAL and rpcm: nothing of barpc is between.

The sets are real; what a file says is asked of the file alone.
"""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import RPCTransformer

import barpc
from barpc.base.geodesy import Array
from barpc.pipeline.run import AdjustResult
from barpc.verbs import figures
from tests.geotiffs import write_image

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
TOLERANCE = 0.005  # px

Reader = Callable[[Array], Array]


def of_rpcs(rpcs: rasterio.rpc.RPC) -> Reader:
    def project(ground: Array) -> Array:
        with RPCTransformer(rpcs) as transformer:
            row, col = transformer.rowcol(*ground.T, op=np.positive)
        return np.column_stack([col, row]) - 0.5

    return project


def by_gdal(image: Path) -> Reader:
    with rasterio.open(image) as dataset:
        assert dataset.rpcs is not None
        return of_rpcs(dataset.rpcs)


def residuals(run: Path, readers: Mapping[str, Reader], motion: Reader = lambda ground: ground) -> dict[str, float]:
    """The RMS [px] of each image over the tie points in use, by the tables of a run and any cameras."""
    with (run / "tables/residuals.csv").open() as file:
        place = {row["track"]: row for row in csv.DictReader(file)}
    ground, seen = {name: [] for name in readers}, {name: [] for name in readers}
    with (run / "tables/observations.csv").open() as file:
        for row in csv.DictReader(file):
            if row["used"] == "1" and row["track"] in place and row["view"] in readers:
                at = place[row["track"]]
                ground[row["view"]].append([float(at[key]) for key in ("lon", "lat", "height_above_datum")])
                seen[row["view"]].append([float(row["col"]), float(row["row"])])
    found = {}
    for name, project in readers.items():
        off = project(motion(np.array(ground[name]))) - np.array(seen[name])
        found[name] = float(np.sqrt((off**2).sum(axis=1).mean()))
    return found


def printed(run: Path) -> dict[str, float]:
    return {view["name"]: view["rmse_after"] for view in json.loads((run / "summary.json").read_text())["views"]}


def assert_agreement(found: Mapping[str, float], said: Mapping[str, float]) -> None:
    assert len(found) >= 2
    assert found.keys() == said.keys()
    for name, value in found.items():
        assert abs(value - said[name]) <= TOLERANCE, (name, value, said[name])


@pytest.fixture(scope="module")
def grown(shared_data, tmp_path_factory) -> Path:
    """A pair, and an image added to it; the newest run."""
    folder, images = tmp_path_factory.mktemp("grown"), sorted((shared_data / "optical/phr_triplet_north").glob("*.tif"))
    barpc.adjust(images[:2], folder / "january")
    barpc.adjust(images[2:], folder / "february", add_to=str(folder / "january"))
    return folder / "february"


@pytest.mark.parametrize("of", ["triplet", "ventoux", "ventoux_biased"])
def test_adjust(of: str, request: pytest.FixtureRequest) -> None:
    _, run = request.getfixturevalue(of)
    assert_agreement(residuals(run, {name: by_gdal(run / f"{name}.vrt") for name in printed(run)}), printed(run))


def test_adjust_by_rpcm(triplet: tuple[AdjustResult, Path]) -> None:
    rpcm = pytest.importorskip("rpcm.rpc_model")
    readers = dict[str, Reader]()
    for name in printed(triplet[1]):
        model = rpcm.rpc_from_rpc_file(str(triplet[1] / f"{name}_RPC.TXT"))
        readers[name] = lambda ground, model=model: np.column_stack(model.projection(*ground.T))
    assert_agreement(residuals(triplet[1], readers), printed(triplet[1]))


def test_add_to(grown: Path) -> None:
    """Half of the cameras lie in the folder of the run before."""
    folders = grown, grown.parent / "january"
    where = {name: next(one for one in folders if (one / f"{name}.vrt").exists()) for name in printed(grown)}
    assert len(set(where.values())) == 2
    assert_agreement(
        residuals(grown, {name: by_gdal(folder / f"{name}.vrt") for name, folder in where.items()}), printed(grown)
    )


@pytest.mark.landing(2)
@pytest.mark.few(1)
@pytest.mark.parametrize("of", ["triplet", "grown", "ventoux_biased"])
def test_check_of_what_lies_on_disk_prints_what_the_run_printed(of: str, request: pytest.FixtureRequest) -> None:
    found = request.getfixturevalue(of)
    run = found if of == "grown" else found[1]
    folders = (run, run.parent / "january") if of == "grown" else (run,)
    record = json.loads((run / "summary.json").read_text())
    there = barpc.check([path for folder in folders for path in folder.glob("*.vrt")])
    now = [view.rmse_before for view in there.record.views]
    assert abs(np.median(now) - np.median(list(printed(run).values()))) <= TOLERANCE
    offsets = {(pair.a, pair.b): pair.epipolar_before for pair in there.record.pairs}
    for pair in record["pairs"]:
        said, read = pair["epipolar_after"], offsets[pair["a"], pair["b"]]
        chance = 3.0 * 1.25 * read.spread / np.sqrt(said["count"])  # of a median of other matches
        assert abs(said["median"] - read.median) <= TOLERANCE + chance * (of == "grown")
        assert abs(said["spread"] - read.spread) <= TOLERANCE + chance * (of == "grown")


def test_convert(triplet: tuple[AdjustResult, Path], tmp_path: Path) -> None:
    _, run = triplet
    barpc.convert([run / f"{name}.vrt" for name in printed(run)], out_dir=tmp_path, images="copy", rpc_format="rpb")
    assert_agreement(residuals(run, {name: by_gdal(tmp_path / f"{name}.tif") for name in printed(run)}), printed(run))


@pytest.mark.filterwarnings("ignore::barpc.base.errors.Remark")
def test_move(triplet: tuple[AdjustResult, Path], tmp_path: Path) -> None:
    """Points that are moved as the cameras were are seen where they were."""
    pyproj, (_, run) = pytest.importorskip("pyproj"), triplet
    barpc.convert([run / f"{name}.vrt" for name in printed(run)], out_dir=tmp_path, move=(3.0, -2.0, 11.0))
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    lon, lat = (np.radians(value) for value in barpc.localize(run / "img_02.vrt", [512.0, 280.0], 200.0)[:2])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    shift = 3.0 * east - 2.0 * north + 11.0 * up

    def moved(ground: Array) -> Array:
        there = np.column_stack(to_ecef.transform(*ground.T)) + shift
        return np.column_stack(to_ecef.transform(*there.T, direction="INVERSE"))

    readers = {name: by_gdal(tmp_path / f"{name}.vrt") for name in printed(run)}
    assert_agreement(residuals(run, readers, moved), printed(run))
    assert min(residuals(run, readers).values()) > 1.0


@pytest.mark.parametrize("of", ["triplet", "grown"])
def test_export(of: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    """The numbers that s2p reads, of all images of a run that grew."""
    rpcm, found = pytest.importorskip("rpcm.rpc_model"), request.getfixturevalue(of)
    run = found if of == "grown" else found[1]
    barpc.export(run, tmp_path / "s2p", "s2p")
    readers = dict[str, Reader]()
    for image in json.loads((tmp_path / "s2p/config.json").read_text())["images"]:
        model = rpcm.RPCModel(image["rpc"], dict_format="rpcm")
        readers[Path(image["img"]).stem] = lambda ground, model=model: np.column_stack(model.projection(*ground.T))
    assert_agreement(residuals(run, readers), printed(run))


def test_fit(shared_data: Path, tmp_path: Path) -> None:
    """The RMSE that is printed of an RPC fitted to a vendor's grid, at pixels of another lattice."""
    (grid,) = (shared_data / "physical").glob("GRID_P1BP*.tif")
    fitted = barpc.fit(grid, tmp_path / "a_RPC.TXT", alt_range=(40.0, 1120.0))
    camera = barpc.open_camera(grid)
    width, height = camera.size
    at = np.stack(np.meshgrid(np.linspace(7, width - 9, 23), np.linspace(5, height - 8, 29)), axis=-1).reshape(-1, 2)
    parts = [camera.model.localize(at, np.full(len(at), alt)) for alt in (77.0, 333.0, 1010.0)]
    image = write_image(tmp_path / "a.tif", np.zeros((1, 1), dtype=np.uint8))
    off = by_gdal(image)(np.concatenate(parts)) - np.tile(at, (3, 1))
    assert abs(np.sqrt((off**2).sum(axis=1).mean()) - np.linalg.norm(fitted.rmse_ckp)) <= TOLERANCE


# --- `barpc verify --figures` -----------------------------------------------------------------------------


def states(run: Path) -> dict[str, bool]:
    return {one.file: one.passed for one in barpc.verify(run, figures=True) if one.kind == "figure"}


def test_verify_measures_the_figures_again(grown: Path) -> None:
    found = states(grown)
    assert len(found) == 2 * len(printed(grown))
    assert all(found.values())


def test_verify_names_a_camera_that_is_not_the_one_of_the_figures(grown: Path, tmp_path: Path) -> None:
    for name in ("january", "february"):
        shutil.copytree(grown.parent / name, tmp_path / name)
    file = tmp_path / "january/img_01_RPC.TXT"
    name, value = next(line for line in file.read_text().splitlines() if line.startswith("LINE_OFF")).split()[:2]
    file.write_text(file.read_text().replace(value, str(float(value) + 0.1)))
    assert [name for name, passed in states(tmp_path / "february").items() if not passed] == ["img_01_RPC.TXT"]


def test_verify_names_a_summary_that_was_changed(grown: Path, tmp_path: Path) -> None:
    for name in ("january", "february"):
        shutil.copytree(grown.parent / name, tmp_path / name)
    summary = tmp_path / "february/summary.json"
    summary.write_text(summary.read_text().replace('"rmse_after": 0.0', '"rmse_after": 0.1'))
    assert not any(states(tmp_path / "february").values())


def test_a_tool_that_cannot_read_a_file_is_a_finding(grown: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Broken:
        installed = True

        def open(self, _: Path) -> Reader:
            raise ValueError("no such key")

    monkeypatch.setitem(figures.CONSUMERS, "gdal", Broken())
    found = states(grown)
    assert not any(passed for name, passed in found.items() if name.endswith(".vrt"))
    assert all(passed for name, passed in found.items() if not name.endswith(".vrt"))
