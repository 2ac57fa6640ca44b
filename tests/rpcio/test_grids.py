"""Grid files: laid out as CARS and GDAL read them, with the sign that is documented, and read back."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy.interpolate import RegularGridInterpolator

from barpc.base.errors import BarpcError, RpcError, RpcFormatError
from barpc.base.geodesy import metres_per_unit
from barpc.cameras import open_camera
from barpc.pipeline.verify_outputs import unverified, verify_grid
from barpc.rpcio import read_rpc
from barpc.rpcio.formats import CORRECTION, GRID_SUFFIX
from barpc.rpcio.grids import read_correction, write_correction, write_grid
from barpc.sensor.direct_grid import LINEAR, DirectGrid
from barpc.sensor.image_corrections import CorrectionGrid, Displaced
from barpc.sensor.sampler import Scattered
from tests.jitter import scene
from tests.rpcio.conftest import make_rpc

SIZE, ALTS = (6000, 9000), (0.0, 1000.0)


@pytest.fixture(scope="module")
def camera():
    return scene(3000.0, 0.5, SIZE, ALTS)


@pytest.fixture(scope="module")
def sample(camera):
    return Scattered.over(camera, SIZE, ALTS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, camera) -> Path:
    folder = tmp_path_factory.mktemp("grids")
    write_grid(DirectGrid.of(camera, SIZE, ALTS), folder / f"a{GRID_SUFFIX}")
    lacking = CorrectionGrid.between(camera.sensor, camera, SIZE, 500.0)
    write_correction(lacking, camera.sensor, folder / f"a{CORRECTION}")
    return folder


def check_points(camera, count=3000):
    rng = np.random.default_rng(5)
    image, alt = rng.uniform(-0.5, np.array(SIZE) - 0.5, (count, 2)), rng.uniform(*ALTS, count)
    return image, camera.localize(image, alt)


def test_a_localisation_grid_reads_back_as_the_camera(folder, camera):
    image, ground = check_points(camera)
    found = open_camera(folder / f"a{GRID_SUFFIX}")
    assert (found.format, found.size, found.alt_range) == ("grid", SIZE, ALTS)
    assert np.linalg.norm(found.model.project(ground) - image, axis=1).max() < 1e-4


@pytest.mark.slow  # before a commit: every node, below, and rasterio's reading of it
def test_shareloc_localises_with_the_grid(folder, camera):
    """As CARS does: linear, from its own origin half a pixel aside; to a millimetre of what the grid is and 0.005 px of
    the camera."""
    pytest.importorskip("shareloc")
    from shareloc.geomodels import GeoModel

    image, ground = check_points(camera)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = GeoModel(str(folder / f"a{GRID_SUFFIX}"), "GRID")
    found = np.asarray(model.direct_loc_h(image[:, 1] + 0.5, image[:, 0] + 0.5, ground[:, 2]))
    off = np.linalg.norm(camera.project(found) - image, axis=1)
    assert LINEAR / 10 < off.max() < LINEAR
    grid = open_camera(folder / f"a{GRID_SUFFIX}").model
    linear = RegularGridInterpolator((grid.alts, grid.rows, grid.cols), grid.lonlat)
    lonlat = linear(np.column_stack([ground[:, 2], image[:, ::-1]]))
    assert np.abs((found[:, :2] - lonlat) * metres_per_unit(ground)[:, :2]).max() < 1e-3
    model.estimate_inverse_loc_predictor()
    row, col, _ = model.inverse_loc(*np.ascontiguousarray(ground[:20].T))
    back = np.column_stack([col, row]) - 0.5
    assert np.linalg.norm(back - image[:20], axis=1).max() < 0.01


def test_the_layout_is_that_of_vendors_grids(folder):
    with rasterio.open(folder / f"a{GRID_SUFFIX}") as grid:
        layers = grid.count // 2
        assert {grid.tags()[f"ALTITUDE_B{k}"] for k in (0, 1)} == {"0.0"}
        assert float(grid.tags()[f"ALTITUDE_B{2 * layers - 1}"]) == 1000.0
        assert grid.tags()["REF"] == "EPSG:4326"
        assert (grid.transform.c, grid.transform.f) == (0.0, 0.0)  # the corner of the first pixel
        assert grid.transform.a * (grid.width - 1) == pytest.approx(SIZE[0])
        assert grid.transform.e * (grid.height - 1) == pytest.approx(SIZE[1])
        assert set(grid.dtypes) == {"float64"}


def test_gdal_sees_the_displacements_at_their_places_and_with_their_sign(tmp_path):
    """dcol = 1 at column 100 and row 40 only: found there, counted from the corner of the first pixel, in band 1."""
    cols, rows, shift = np.linspace(-0.5, 199.5, 201), np.linspace(-0.5, 99.5, 11), np.zeros((11, 201, 2))
    shift[4, 100] = 1.0, -0.25
    write_correction(CorrectionGrid(cols, rows, shift), make_rpc(), tmp_path / f"a{CORRECTION}")
    with rasterio.open(tmp_path / f"a{CORRECTION}") as found:
        assert found.xy(4, 100) == (100.0, 40.0)  # node (-0.5, -0.5) is at (0, 0) there
        assert found.read()[:, 4, 100].tolist() == [1.0, -0.25]
        assert found.descriptions == ("dcol", "drow")
        assert "RPC in this file + (dcol, drow)" in found.tags()["CORRECTION"]
        assert set(found.dtypes) == {"float32"}
    rpc, grid = read_correction(tmp_path / f"a{CORRECTION}")
    np.testing.assert_allclose(grid.cols, cols, rtol=0, atol=1e-9)
    np.testing.assert_allclose(grid.rows, rows, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(grid.shift, shift)
    np.testing.assert_allclose(grid.at(np.array([[99.5, 39.5], [99.5, 39.5 + 5]])), [[1, -0.25], [0.5, -0.125]])
    assert rpc == make_rpc()


def test_a_correction_grid_is_a_camera(folder, camera):
    image, ground = check_points(camera)
    found = open_camera(folder / f"a{CORRECTION}")
    assert (found.format, found.size) == ("correction", SIZE)
    assert isinstance(found.model, Displaced)
    assert isinstance(found.model.correction, CorrectionGrid)
    left = np.linalg.norm(found.model.project(ground) - image, axis=1).max()
    bare = np.linalg.norm(read_rpc(folder / f"a{CORRECTION}").project(ground) - image, axis=1).max()
    assert left < LINEAR < 0.2 < bare


@pytest.mark.parametrize(("width", "height"), [(2, 2), (700, 1025)])
def test_a_correction_grid_is_known_however_many_nodes_it_has(tmp_path, width, height):
    """By a tag in the file's head: the places of many strips would push it out of there."""
    shift = np.random.default_rng(width).normal(size=(height, width, 2)).astype(np.float32).astype(np.float64)
    grid = CorrectionGrid(np.linspace(-0.5, 5999.5, width), np.linspace(-0.5, 8999.5, height), shift)
    write_correction(grid, make_rpc(), tmp_path / f"a{CORRECTION}")
    found = open_camera(tmp_path / f"a{CORRECTION}").model
    assert isinstance(found, Displaced)
    assert isinstance(found.correction, CorrectionGrid)
    np.testing.assert_array_equal(found.correction.shift, shift)


@pytest.mark.slow
def test_consumers_find_the_error_of_a_grid_and_not_less(folder, camera, sample, tmp_path):
    """A grid of the RPC alone misses by the jitter; one whose columns are moved by half a pixel, as by another idea of
    where pixels begin, by half a pixel more."""
    for name in (GRID_SUFFIX, CORRECTION):
        for reading in verify_grid(folder / f"a{name}", sample):
            assert 1e-7 < reading.max_error < LINEAR, reading
    write_grid(DirectGrid.of(camera.sensor, SIZE, ALTS), tmp_path / f"a{GRID_SUFFIX}")
    for reading in verify_grid(tmp_path / f"a{GRID_SUFFIX}", sample):
        assert 0.4 < reading.max_error < 1.5, reading
    lacking = CorrectionGrid.between(camera.sensor, camera, SIZE, 500.0)
    moved = CorrectionGrid(lacking.cols, lacking.rows, lacking.shift + [0.5, 0.0])
    write_correction(moved, camera.sensor, tmp_path / f"b{CORRECTION}")
    turned = CorrectionGrid(lacking.cols, lacking.rows, -lacking.shift)
    write_correction(turned, camera.sensor, tmp_path / f"c{CORRECTION}")
    for reading in verify_grid(tmp_path / f"b{CORRECTION}", sample):
        assert reading.max_error == pytest.approx(0.5, abs=0.01), reading
    for reading in verify_grid(tmp_path / f"c{CORRECTION}", sample):
        assert 0.8 < reading.max_error < 3.0, reading


@pytest.mark.parametrize(("lon", "across"), [(179.98, False), (179.9999, True)])
def test_a_grid_across_the_antimeridian_is_read_by_all_but_shareloc_which_says_why(lon, across, tmp_path):
    rpc, size, alts = make_rpc(lon=lon), (2000, 1900), (30.0, 300.0)
    write_grid(DirectGrid.of(rpc, size, alts), tmp_path / f"a{GRID_SUFFIX}")
    for reading in verify_grid(tmp_path / f"a{GRID_SUFFIX}", Scattered.over(rpc, size, alts)):
        told = "shareloc takes no longitude beyond 180 degrees" in reading.note
        assert told == (across and reading.consumer == "shareloc")
        assert told or reading.max_error < LINEAR, reading


def test_a_file_that_cannot_be_read_is_named_with_its_reason(sample, tmp_path):
    (tmp_path / f"a{GRID_SUFFIX}").write_bytes(b"II*\0")
    for reading in verify_grid(tmp_path / f"a{GRID_SUFFIX}", sample):
        assert np.isnan(reading.max_error)
        assert reading.note


def test_only_tools_that_are_not_installed_are_missed(folder, monkeypatch):
    monkeypatch.setattr("barpc.pipeline.verify_outputs._is_installed", lambda package: package != "shareloc")
    (sentence,) = unverified([folder / f"a{GRID_SUFFIX}"])
    assert sentence.endswith("a_grid.tif: only barpc itself has read it (.tif: shareloc would, and is not installed)")
    assert unverified([folder / f"a{CORRECTION}"]) == []  # GDAL has


def test_uneven_nodes_are_not_written(tmp_path):
    with pytest.raises(RpcError, match="evenly"):
        write_correction(
            CorrectionGrid([0.0, 1.0, 3.0], [0.0, 1.0], np.zeros((2, 3, 2))), make_rpc(), tmp_path / "a.tif"
        )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("what", ["no tag", "no RPC", "three bands", "NaN", "nowhere", "turned"])
def test_a_damaged_correction_grid_is_one_line(tmp_path, what):
    path = tmp_path / f"a{CORRECTION}"
    cols, rows = np.linspace(-0.5, 199.5, 5), np.linspace(-0.5, 99.5, 3)
    write_correction(CorrectionGrid(cols, rows, np.zeros((3, 5, 2))), make_rpc(), path)
    with rasterio.open(path) as good:
        profile, tags, rpcs, data = dict(good.profile), good.tags(), good.rpcs, good.read()
    tags.pop("AREA_OR_POINT", None)
    if what in ("NaN", "nowhere"):
        data[0, 1, 1] = np.nan if what == "NaN" else 1e30
    if what == "three bands":
        data, profile["count"] = np.concatenate([data, data[:1]]), 3
    if what == "turned":
        profile["transform"] = rasterio.Affine(50.0, 1.0, -25.0, 1.0, 50.0, -25.0)
    path.unlink()
    with rasterio.open(path, "w", **profile, **({} if what == "no RPC" else {"rpcs": rpcs})) as out:
        out.write(data)
        if what != "no tag":
            out.update_tags(**tags)
    with pytest.raises(RpcFormatError, match=path.name) as caught:
        read_correction(path)
    assert "\n" not in str(caught.value)
    nodes = "a node of it is no image point, or has no displacement"
    assert (nodes in str(caught.value)) == (what in ("NaN", "nowhere"))
    if what != "no tag":
        with pytest.raises(BarpcError):
            open_camera(path)
