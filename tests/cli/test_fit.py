"""`barpc fit` on the command line: what it writes, prints and returns."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from rasterio.control import GroundControlPoint
from rasterio.crs import CRS

from barpc.rpcio import read_rpc, write_rpc
from barpc.sensor.rpc import RPC, altitude_range
from barpc.sensor.sentinel1 import RangeDoppler
from tests.cli.test_main import run
from tests.fit.cameras import Camera, random_points, synthetic
from tests.geotiffs import write_image
from tests.reliability.conftest import assert_one_line, barpc
from tests.rpcio.conftest import make_rpc


@pytest.fixture(scope="module")
def camera() -> Camera:
    return synthetic()


def tagged(path: Path, rpc: RPC, first: float, flat: float | None = None, steps: int = 10, crs: int = 4326) -> Path:
    """An image of 1001 x 801 px with GCPs and no RPC; `first` is what its tags call the first pixel's centre."""
    cols, rows = np.meshgrid(np.linspace(0, 1000 + 2 * first, steps + 1), np.linspace(0, 800 + 2 * first, steps + 1))
    image = np.column_stack([cols.ravel(), rows.ravel()])
    low, high = altitude_range(rpc)
    alt = low + (high - low) * (0.5 + 0.4 * np.sin(image[:, 0] / 97) * np.cos(image[:, 1] / 71))
    ground = rpc.localize(image - first, alt if flat is None else np.full(len(image), flat))
    gcps = [
        GroundControlPoint(row, col, *place, id=str(i))
        for i, ((col, row), place) in enumerate(zip(image, ground, strict=True))
    ]
    return write_image(path, np.zeros((801, 1001), np.uint8), gcps=gcps, crs=CRS.from_epsg(crs))


@pytest.mark.parametrize(("first", "where"), [(0.5, "corner"), (0.0, "centre")])
def test_an_image_with_a_grid_of_gcps_and_no_rpc_becomes_an_rpc(
    first: float, where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """GDAL counts from the corner; Sentinel-1's grids go from 0 to the last pixel, whose centres they mean."""
    rpc, out = make_rpc().crop(500, 500), tmp_path / "new_RPC.TXT"
    image = tagged(tmp_path / "grd.tif", rpc, first)
    assert run("fit", image, "-o", out, "--json") == 0
    told = capsys.readouterr()
    assert f"121 GCPs of grd.tif, counted from the {where} of the first pixel" in told.err
    assert "hold no terms" not in told.err
    assert json.loads(told.out)["coverage"] > 0.9
    points = np.random.default_rng(3).uniform(0, 800, (500, 2))
    for alt in altitude_range(rpc):
        found = read_rpc(out).project(rpc.localize(points, np.full(500, alt)))
        assert np.abs(found - points).max() < 0.01
    assert_one_line(barpc("info", image), 1, "it has 121 GCPs: 'barpc fit' makes an RPC of them")


@pytest.mark.parametrize("alt", [0.0, 250.0])
def test_of_gcps_at_one_altitude_it_is_said_that_heights_hold_nothing(
    alt: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = tagged(tmp_path / "a.tif", make_rpc().crop(500, 500), 0.5, flat=alt)
    run("fit", image)
    assert f"all points are at {alt:g} m: the RPC has no terms in height" in capsys.readouterr().err


def test_an_rpc_goes_before_gcps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rpc = make_rpc().crop(500, 500)
    image = tagged(tmp_path / "a.tif", rpc, 0.5)
    write_rpc(rpc.crop(30, 40), tmp_path / "a.RPB")
    assert run("fit", image, "-o", tmp_path / "b_RPC.TXT") == 0
    assert "GCPs" not in capsys.readouterr().err
    np.testing.assert_allclose(
        read_rpc(tmp_path / "b_RPC.TXT").localize([[500.0, 400.0]], [170.0]), rpc.localize([[530.0, 440.0]], [170.0])
    )
    (tmp_path / "a.RPB").write_text("lineNumCoef = (1")
    assert_one_line(barpc("fit", image), 1, "a.RPB")


@pytest.mark.parametrize(
    ("given", "code", "said"),
    [({"crs": 32631}, 1, "its GCPs are in EPSG:32631"), ({"steps": 4}, 3, "25 points carry quadratic polynomials")],
)
def test_gcps_that_make_no_rpc_are_refused(
    given: dict[str, int], code: int, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("fit", tagged(tmp_path / "a.tif", make_rpc().crop(500, 500), 0.5, **given)) == code
    assert said in capsys.readouterr().err


def test_examples_in_the_help_stand_on_lines_of_their_own(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("fit", "--help") == 0
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert "barpc fit points.csv,size=20000:19000 -o points.RPB --tolerance 1" in lines


def test_points_become_an_rpc_file_that_reads_back(
    camera: Camera, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "points_RPC.TXT"
    ground, image = random_points(camera, 400, np.random.default_rng(0))
    np.savez(tmp_path / "p.npz", ground=ground, image=image)
    assert run("fit", tmp_path / "p.npz", "-o", out, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["verdict"] == ""
    assert report["output"] == str(out)
    assert max(report["max_ckp"]) <= 1e-5
    ground, image = random_points(camera, 500, np.random.default_rng(1))
    assert np.abs(read_rpc(out).project(ground) - image).max() <= 1e-5
    assert np.abs(camera.rpc.project(ground) - image).max() >= 1.0
    assert_one_line(barpc("fit", tmp_path / "p.npz", "-o", out), 1, "exists already")
    assert run("fit", tmp_path / "p.npz", "-o", out, "--overwrite") == 0


@pytest.mark.filterwarnings("default:points")
def test_a_table_that_mirrors_the_ground_is_fitted_and_said(
    camera: Camera, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    ground, image = random_points(camera, 300, np.random.default_rng(0))
    for name, columns, said in (("plain", [0, 1, 2], False), ("exchanged", [1, 0, 2], True)):
        np.savez(tmp_path / f"{name}.npz", ground=ground[:, columns], image=image)
        assert run("fit", tmp_path / f"{name}.npz", "-o", tmp_path / f"{name}_RPC.TXT") == 0
        assert ("show the ground mirrored" in caplog.text) == said
        assert np.abs(read_rpc(tmp_path / f"{name}_RPC.TXT").project(ground[:, columns]) - image).max() < 1e-5


def test_an_rpc_file_is_refitted_over_another_altitude_range(
    camera: Camera, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_rpc(camera.rpc, tmp_path / "a_RPC.TXT")
    assert_one_line(barpc("fit", tmp_path / "a_RPC.TXT", "-o", tmp_path / "b.RPB"), 1, "size=")
    sized = f"{tmp_path / 'a_RPC.TXT'},size=20000:19000"
    assert run("fit", sized, "--alt-range", 200, 2200, "-o", tmp_path / "b.RPB") == 0
    assert "within tolerance" in capsys.readouterr().out
    refitted = read_rpc(tmp_path / "b.RPB")
    assert [refitted.ground_offset[2], refitted.ground_scale[2]] == [1200.0, 1000.0]
    ground, _ = random_points(camera, 500, np.random.default_rng(1))
    assert np.abs(refitted.project(ground) - camera.rpc.project(ground)).max() <= 1e-7


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("lon,lat,alt,col,row\n5,43,1,2\n", "line 2"),
        ("lon,lat,alt,col,row\n5,43,1,2,3\n", "determine no image"),
        ("nothing at all", "no RPC format recognised"),
    ],
)
def test_a_source_that_cannot_be_fitted_is_one_line_and_exit_1(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "points.csv"
    path.write_text(content)
    said = barpc("fit", path)  # a remark may stand above it
    assert (said.code, said.out) == (1, "")
    assert message in said.err.splitlines()[-1]


def test_real_sources(shared_data: Path, tmp_path: Path) -> None:
    image = shared_data / "optical" / "phr_triplet_north" / "img_01.tif"
    (tmp_path / "fit.toml").write_text('[fit]\nspace = "ground"\n')
    assert run("fit", image, "-o", tmp_path / "img.vrt", "--options", tmp_path / "fit.toml") == 0
    assert run("fit", shared_data / "physical" / "GRID_P1BP--2017092838284574CP.tif") == 0
    radar = sorted((shared_data / "sar").glob("s1a-iw1-slc-vv-20210216*.xml"))[0]
    (tmp_path / "fit.toml").write_text('[fit]\nmethod = "lcurve-joint"\n')
    assert run("fit", radar, "-o", tmp_path / "iw1_RPC.TXT", "--options", tmp_path / "fit.toml") == 0


def test_the_altitudes_may_come_from_a_dem(shared_data: Path, tmp_path: Path) -> None:
    dem = ("--dem", shared_data / "dem" / "N44E005.hgt", "--geoid", shared_data / "dem" / "egm96_15.gtx")
    image = shared_data / "optical" / "phr_ventoux" / "left_image.tif"
    assert run("fit", image, *dem, "--dem-margin", 200, "-o", tmp_path / "left_RPC.TXT") == 0
    rpc = read_rpc(tmp_path / "left_RPC.TXT")
    low, high = rpc.ground_offset[2] - rpc.ground_scale[2], rpc.ground_offset[2] + rpc.ground_scale[2]
    assert 200.0 < low < 400.0
    assert 700.0 < high < 1100.0


@pytest.mark.slow
def test_of_a_radar_swath_all_ground_on_earth_is_held_to_five_thousandths_of_a_pixel(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = sorted((shared_data / "sar").glob("s1a-iw1-slc-vv-20160114*.xml"))[0]
    assert run("fit", source, "-o", tmp_path / "iw1_RPC.TXT") == 0
    model, rpc = RangeDoppler.from_annotation(source), read_rpc(tmp_path / "iw1_RPC.TXT")
    rng = np.random.default_rng(0)
    at = rng.uniform(0, 1, (3000, 2)) * model.size - 0.5
    for low, high in ((-500, -400), (0, 1000), (8900, 9000)):
        ground = model.localize(at, rng.uniform(low, high, 3000))
        assert np.abs(rpc.project(ground) - at).max() <= 5e-3
    capsys.readouterr()
    tight = ("--tolerance", 0.002)
    assert run("fit", source, "-o", tmp_path / "low_RPC.TXT", *tight) == 0
    assert "the scene's altitudes, -197 to 530 m" in capsys.readouterr().err
    assert read_rpc(tmp_path / "low_RPC.TXT").ground_offset[2] < 200.0
