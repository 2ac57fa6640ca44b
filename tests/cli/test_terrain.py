"""Where altitudes come from that nobody gave, coordinates the wrong way round, and boxes beyond an image."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.base.errors import Remark
from barpc.cameras import open_camera
from barpc.rpcio import read_rpc, write_rpc
from barpc.scene import Camera
from barpc.verbs.points import altitude_of, exchanged
from tests import geotiffs
from tests.cli.test_images import run
from tests.reliability.conftest import assert_one_line, barpc
from tests.report.conftest import run_of_block, written
from tests.rpcio.conftest import make_rpc


@pytest.fixture
def dem(tmp_path: Path) -> Path:
    """A plane that rises by 1000 m a degree to the east, 60 m at 5.4 degrees."""
    path, step = tmp_path / "dem.tif", 0.002
    lon = 5.2 + step * (np.arange(250) + 0.5)
    heights = np.tile(60 + 1000 * (lon - 5.4), (250, 1)).astype(np.float64)
    where = rasterio.Affine(step, 0, 5.2, 0, -step, 43.5)
    return geotiffs.write_image(path, heights, crs="EPSG:4979", transform=where)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "run"
    found = run_of_block(3, 200, size=(900, 700))
    written(replace(found, views=tuple(replace(v, path=f"/images/{v.name}.tif") for v in found.views)), folder)
    return folder


@pytest.mark.parametrize("verb", ["info", "localize", "footprint", "crop"])
def test_the_middle_of_the_rpc_is_taken_aloud(verb, image, tmp_path, capsys):
    box = ("--bbox", 5.3995, 43.1993, 5.4005, 43.2)
    verbs = {
        "info": ("info", image),
        "localize": ("localize", image, 10, 20),
        "footprint": ("info", "--footprint", image),
        "crop": ("convert", image, tmp_path / "part.tif", *box),
    }
    assert run(*verbs[verb]) == 0
    said = capsys.readouterr().err
    rpc = read_rpc(image)
    middle = rpc.ground_offset[2]
    at = rpc.localize([299.5, 199.5], middle)
    off = np.linalg.norm(rpc.project(at + [0, 0, 50.0]) - rpc.project(at - [0, 0, 50.0]))
    assert f"terrain height unknown, {middle:g} m assumed" in said
    told = float(said.split("an error of 100 m shifts the result by ")[1].split(" px")[0])
    assert told == pytest.approx(off, rel=0.02)
    assert run(*verbs[verb], "--alt", 123, *(["--overwrite"] if verb == "crop" else [])) == 0
    assert "middle" not in capsys.readouterr().err


def test_altitudes_that_a_table_brings_need_no_word(image, tmp_path, capsys):
    (tmp_path / "points.csv").write_text("col,row,alt\n1,2,100\n")
    assert run("localize", image, "--points", tmp_path / "points.csv") == 0
    assert capsys.readouterr().err == ""


@pytest.mark.slow
def test_a_run_s_own_files_know_its_tie_points(finished, capsys):
    summary = json.loads((finished / "summary.json").read_text())
    (name,) = summary["views"][1]["outputs"]
    camera = open_camera(finished / name)
    assert altitude_of(camera, finished / name) == summary["altitude_m"]
    assert run("localize", finished / name, 100, 200, "--json") == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)[0]["alt"] == pytest.approx(summary["altitude_m"], abs=1e-3)
    assert abs(summary["altitude_m"] - camera.altitude) > 1.0  # else this would show nothing
    assert captured.err == ""


def test_a_damaged_summary_and_a_stranger_s_file_know_nothing(finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "copy")
    (name, other) = sorted(path.name for path in folder.glob("*_RPC.TXT"))[:2]
    shutil.copy(folder / name, folder / "stranger_RPC.TXT")
    stranger = open_camera(folder / "stranger_RPC.TXT")
    with pytest.warns(Remark, match="the middle of the camera's altitude range"):
        assert altitude_of(stranger, folder / "stranger_RPC.TXT") == stranger.altitude
    damaged = shutil.copytree(finished, tmp_path / "damaged")
    (damaged / "summary.json").write_text("{")
    camera = open_camera(damaged / other)
    with pytest.warns(Remark, match="the middle of the camera's altitude range"):
        assert altitude_of(camera, damaged / other) == camera.altitude


def test_a_dem_is_asked_where_one_is_given(image, dem, tmp_path, capsys):
    rpc = read_rpc(image)
    assert run("info", image, "--dem", dem, "--json") == 0
    captured = capsys.readouterr()
    (found,) = json.loads(captured.out)
    lon, lat = found["center_deg"]
    assert found["center_alt_m"] == pytest.approx(60 + 1000 * (lon - 5.4), abs=2e-3)
    seen = rpc.project([lon, lat, 60 + 1000 * (lon - 5.4)])
    np.testing.assert_allclose(seen, [299.5, 199.5], atol=1e-2)
    assert captured.err == ""
    assert run("info", "--footprint", image, "--dem", dem) == 0
    ring = np.array(json.loads(capsys.readouterr().out)["features"][0]["geometry"]["coordinates"][0])
    corners = rpc.project(np.column_stack([ring, 60 + 1000 * (ring[:, 0] - 5.4)]))
    outside = np.maximum(np.abs(corners[:, 0] - 299.5) - 300, np.abs(corners[:, 1] - 199.5) - 200)
    np.testing.assert_allclose(outside, 0.0, atol=1e-2)
    box = [*ring[:, :2].mean(axis=0) - 2e-4, *ring[:, :2].mean(axis=0) + 2e-4]
    assert run("convert", image, tmp_path / "part.tif", "--bbox", *box, "--dem", dem, "--json") == 0
    col, row, width, height = json.loads(capsys.readouterr().out)["window"]
    lon, lat = np.meshgrid(np.linspace(box[0], box[2], 9), np.linspace(box[1], box[3], 9))
    inside = rpc.project(np.stack([lon, lat, 60 + 1000 * (lon - 5.4)], axis=-1)).reshape(-1, 2)
    low, high = inside.min(axis=0), inside.max(axis=0)
    assert (np.abs(low - 0.5 - [col, row] + 0.5) < 1.5).all()
    assert (np.abs(high + 0.5 - [col + width, row + height] + 0.5) < 1.5).all()


@pytest.mark.parametrize("verb", ["info", "localize", "convert"])
def test_an_altitude_and_a_dem_contradict_each_other(verb, image, dem, tmp_path):
    more = {"localize": (1, 2), "convert": (tmp_path / "x.tif", "--bbox", 5, 43, 6, 44)}.get(verb, ())
    expected = 0 if verb == "localize" else 2  # there --alt is for points of a table
    assert run(verb, image, *more, "--alt", 5, "--dem", dem) == expected
    assert_one_line(barpc(verb, image, *more, "--geoid", dem), 2, "--geoid goes with --dem")


@pytest.mark.parametrize("how", ["outside", "in a void"])
def test_a_dem_without_a_height_there_is_an_error(how, image, dem):
    with rasterio.open(dem, "r+") as out:
        if how == "outside":
            out.transform = rasterio.Affine(0.002, 0, 15.2, 0, -0.002, 43.5)
        else:
            out.write(np.full(out.shape, np.nan), 1)
    assert_one_line(barpc("info", image, "--dem", dem), 1, "dem.tif: has no height at the images' position")


def test_exchanged_coordinates_are_recognised(image, tmp_path, capsys):
    assert run("project", image, 43.1995, 5.4005, 200) == 3
    assert "longitude and latitude exchanged" in capsys.readouterr().err
    assert run("project", image, 5.4005, 43.1995, 200) == 0
    assert run("project", image, 15.4005, 43.1995, 200) == 3  # far off, and no better the other way round
    said = capsys.readouterr().err
    assert "1 of 1 points lie beyond the image by more than its size" in said
    assert "latitude exchanged" not in said
    assert_one_line(barpc("info", image, "--at", 43.1995, 5.4005, 200), 1, "exchanged")
    box = (43.1993, 5.3995, 43.2, 5.4005)
    assert_one_line(barpc("convert", image, tmp_path / "part.tif", "--alt", 100, "--bbox", *box), 2, "exchanged")


def test_what_a_box_loses_at_the_border_is_said(image, tmp_path, capsys):
    rpc = read_rpc(image)
    inside = rpc.localize(np.array([[250.0, 150.0], [300.0, 200.0]]), np.full(2, 100.0))
    box = [*inside[:, :2].min(axis=0), *inside[:, :2].max(axis=0)]
    assert run("convert", image, tmp_path / "a.tif", "--alt", 100, "--bbox", *box) == 0
    assert "cut off" not in capsys.readouterr().err
    far = rpc.localize(np.array([[599.5, 199.5]]), np.array([100.0]))[0]  # half of it lies beyond
    box = [far[0] - 4e-4, far[1] - 4e-4, far[0] + 4e-4, far[1] + 4e-4]
    assert run("convert", image, tmp_path / "b.tif", "--alt", 100, "--bbox", *box) == 0
    share = float(capsys.readouterr().err.split("image; ")[1].split(" %")[0])
    assert 40 < share < 60


class Map:
    """100 columns a degree from 10 E, 100 rows a degree from 50 N southwards; 5 px for 100 m, but a `lean` [px/km]."""

    def __init__(self, lean: float = 0.0) -> None:
        self.lean, self.asked = lean / 1000, []

    def localize(self, image, alt):
        self.asked.append((image.tolist(), np.asarray(alt).tolist()))
        return np.stack([10 + (image[..., 0] - self.lean * alt) / 100, 50 - image[..., 1] / 100, alt], axis=-1)

    def project(self, ground):
        return np.stack(
            [(ground[..., 0] - 10) * 100 + self.lean * ground[..., 2], (50 - ground[..., 1]) * 100], axis=-1
        )

    def project_jacobian(self, ground):
        return self.project(ground), np.array([[1.0, 2.0, 0.03], [3.0, 4.0, -0.04]])


def a_map(**changes) -> Camera:
    usual = {"model": Map(), "path": Path("map"), "format": "rpb", "size": (200, 100), "alt_range": (0.0, 50.0)}
    return Camera(**{**usual, **changes})


def test_what_an_unknown_altitude_is_worth_is_measured_in_the_middle():
    camera = a_map()
    told = r"^map.tif: terrain height unknown, 25 m assumed \(the middle of the camera's altitude range\)"
    with pytest.warns(Remark, match=f"{told}: an error of 100 m shifts the result by 5 px; give an altitude or a DEM$"):
        assert altitude_of(camera, Path("map.tif")) == 25.0
    assert camera.model.asked == [([99.5, 49.5], 25.0)]
    with pytest.warns(Remark, match=f"{told}; give an altitude or a DEM$"):
        assert altitude_of(a_map(size=None), Path("map.tif")) == 25.0
    assert altitude_of(camera, Path("map.tif"), 0.0) == 0.0


@pytest.mark.parametrize(
    ("lon", "lat", "near"),
    [
        (11.0, 49.5, True),
        (8.01, 49.5, True),
        (7.99, 49.5, False),
        (13.99, 49.5, True),
        (14.01, 49.5, False),
        (11.0, 50.99, True),
        (11.0, 51.01, False),
        (11.0, 48.01, True),
        (11.0, 47.99, False),
    ],
)
def test_coordinates_are_exchanged_where_only_the_other_order_is_near_the_image(lon, lat, near):
    point = np.array([[lat, lon, 0.0]])
    assert bool(exchanged(a_map(), point)) == near
    assert exchanged(a_map(), point[:, [1, 0, 2]]) == ""
    assert exchanged(a_map(), np.vstack([point, [[11.0, 49.5, 0.0]]])) == ""  # one is on the image
    assert exchanged(a_map(size=None), point) == ""
    assert exchanged(a_map(), point[:0]) == ""


@pytest.mark.parametrize(("far", "told"), [(0.0, True), (2.8, True), (-2.8, True), (3.2, False), (-3.2, False)])
def test_an_rpc_alone_has_the_image_that_it_states(far, told):
    """Half an image is a scale: a point is near to three scales from the middle, seldom to the last digit."""
    rpc = make_rpc()
    ground = rpc.localize(rpc.image_offset + [far * rpc.image_scale[0], 0.3 * far * rpc.image_scale[1]], 137.7)
    camera = Camera(rpc, Path("a.RPB"), "rpb", None, (0.0, 300.0))
    assert bool(exchanged(camera, ground[None, [1, 0, 2]])) == told
    assert exchanged(camera, ground[None]) == ""


@pytest.mark.parametrize("name", ["alone", "of an image"])
def test_exchanged_coordinates_are_recognised_whatever_the_rpc_does_far_out(name, tmp_path, capsys):
    """An RPC file alone has no image whose size is known; far out its quotients may come near the image again."""
    rpc = make_rpc()
    coeffs = np.array(rpc.coeffs)
    coeffs[:, 4:] = 0.0
    coeffs[1::2, 4] = -4e-3
    far = replace(rpc, coeffs=coeffs)
    for number, one in enumerate((rpc, far)):
        write_rpc(one, file := tmp_path / f"{number}_RPC.TXT")
        camera = f"{file},size=2000:2000" if name == "of an image" else file
        lon, lat, alt = one.localize(one.image_offset, 100.0)
        assert (np.abs(one.project([lat, lon, alt]) - one.image_offset).max() < 1500) == bool(number)
        assert run("project", camera, lat, lon, alt) == 3
        assert "on it with longitude and latitude exchanged" in capsys.readouterr().err
        assert run("project", camera, lon, lat, alt) == 0
        assert run("project", camera, lon + 10.0, lat, alt) == 3
        said = capsys.readouterr().err
        assert "1 of 1 points lie beyond the image by more than its size" in said
        assert "latitude exchanged" not in said
