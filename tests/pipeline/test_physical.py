"""Runs on the physical models of images: found beside them, corrected like any camera, an RPC fitted to the result."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

import barpc
from barpc.base.errors import ImageError, InputError, RpcFormatError
from barpc.base.geodesy import ecef_from_ground
from barpc.base.options import RunOptions
from barpc.cameras import open_camera, read_points
from barpc.pipeline import adjust
from barpc.pointio.matches import write_matches
from barpc.rpcio import read_rpc, write_rpc
from barpc.rpcio.acquisition import read_acquisition
from barpc.rpcio.xml import write_maxar
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.linescan import read_linescan
from barpc.sensor.pushbroom import Light
from barpc.sensor.triangulation import triangulate
from barpc.simulate import Look
from tests.everywhere import rows_of, tied
from tests.geotiffs import write_blank
from tests.lanes import rest_slow
from tests.rpcio.conftest import make_rpc, write_image
from tests.sensor.linescan_files import Flight, dimap, isd
from tests.sensor.spot_files import Scene

SIZE = (900, 6000)
LOOKS = [Look(12.0, 12.0), Look(3.0, 100.0), Look(12.0, 192.0)]
KINDS = {"maxar": (isd, "{}.XML"), "dimap": (dimap, "DIM_{}.XML")}


@pytest.fixture(scope="module", params=rest_slow(KINDS))
def folder(request, tmp_path_factory):
    """Three images without pixels of their own, their metadata beside them; one has a vendor's RPC, too."""
    path = tmp_path_factory.mktemp(request.param)
    write, name = KINDS[request.param]
    for k, look in enumerate(LOOKS):
        text, _ = write(Flight(size=SIZE, look=look, swing=0.0))
        (path / name.format(f"scene{k}")).write_text(text)
        stem = f"IMG_scene{k}" if request.param == "dimap" else f"scene{k}"
        write_blank(path / f"{stem}.tif", SIZE)
    return path


def images(folder):
    return [f"{path},model=physical" for path in sorted(folder.glob("*.tif"))]


@pytest.mark.landing(1)
@pytest.mark.slow
def test_an_adjustment_on_physical_models(folder, tmp_path):
    models = [open_camera(image).model for image in images(folder)]
    rng = np.random.default_rng(8)
    turned = []
    for model in models:  # what the platform really did: 4 urad and 2 m off
        centre = model.position((SIZE[1] - 1) / 2)
        turned.append(Corrected(model, Correction(rng.normal(0, 4e-6, 3), rng.normal(0, 2, 3), centre)))
    seen = np.column_stack([rng.uniform(30, SIZE[0] - 30, 300), rng.uniform(30, SIZE[1] - 30, 300)])
    ground = turned[1].localize(seen, rng.uniform(0, 300, 300))
    xy = np.stack([camera.project(ground) for camera in turned])
    ground = ground[((xy > 0) & (xy < np.array(SIZE) - 1)).all(axis=(0, 2))]
    xy = np.stack([camera.project(ground) for camera in turned], axis=1) + rng.normal(0, 0.02, (len(ground), 3, 2))
    assert len(ground) > 150
    half = len(ground) // 2
    stems = [path.stem for path in sorted(folder.glob("*.tif"))]
    write_matches(tmp_path / "ties.csv", tied(xy[:half], 0.02), stems)
    options = RunOptions(matches=str(tmp_path / "ties.csv"), matches_only=True)
    result = adjust(images(folder), tmp_path / "out", options)

    def miss(cameras):
        found = triangulate(cameras, *rows_of(xy[half:]), alt=150.0)
        return np.sqrt(np.nanmean(found.residuals**2))

    fresh = [read_rpc(tmp_path / "out" / f"{stem}_RPC.TXT") for stem in stems]
    assert miss(models) > 0.3
    assert 0.005 < miss(result.adjustment.sensors) < 0.03
    assert 0.005 < miss(fresh) < 0.03
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert len(summary["views"]) == 3


def test_the_rpc_stays_the_default(tmp_path):
    text, _ = isd(Flight(size=SIZE, swing=0.0))
    image = write_blank(tmp_path / "a.tif", SIZE)
    (tmp_path / "a.XML").write_text(text)
    write_rpc(make_rpc(), tmp_path / "a.RPB")
    assert open_camera(image).format == "rpb"
    camera = open_camera(f"{image},model=physical")
    assert (camera.format, camera.path, camera.size) == ("maxar physical model", tmp_path / "a.XML", SIZE)
    assert camera.model == read_linescan(tmp_path / "a.XML").model
    assert camera.alt_range == (-500.0, 9000.0)
    assert open_camera(f"{image},model=physical,altitudes=100:900").alt_range == (100.0, 900.0)
    straight = open_camera(f"{image},model=physical,aberration=no,refraction=no").model
    assert (straight.light, camera.model.light) == (Light(), Light(True, True))
    point = camera.model.localize([100.0, 100.0], np.array(0.0))
    off = np.linalg.norm(ecef_from_ground(point) - ecef_from_ground(straight.localize([100.0, 100.0], np.array(0.0))))
    assert 10 < off < 30
    elsewhere = tmp_path / "far" / "b.xml"
    elsewhere.parent.mkdir()
    (tmp_path / "a.XML").rename(elsewhere)
    assert open_camera(f"{image},camera={elsewhere},model=physical").model == camera.model
    with pytest.raises(ImageError, match="no metadata with a physical model beside it"):
        open_camera(f"{image},model=physical")


def test_the_rpc_beside_a_physical_model_tells_its_altitudes(tmp_path):
    text, _ = isd(Flight(size=SIZE, swing=0.0))
    rpb = _rpb()
    (tmp_path / "a.XML").write_text(text.replace("</isd>", f"{rpb}</isd>"))
    low, high = open_camera(tmp_path / "a.XML", model="physical").alt_range
    assert (low, high) == (pytest.approx(166.6667 - 142.8571), pytest.approx(166.6667 + 142.8571))


def _rpb():
    text = write_maxar(make_rpc())
    return text[text.index("<RPB>") : text.index("</isd>")]


def test_pixels_of_another_size_are_refused(tmp_path):
    text, _ = isd(Flight(size=SIZE, swing=0.0))
    image = write_image(tmp_path / "a.tif", (1, 40, 60))
    (tmp_path / "a.XML").write_text(text)
    for spec in (f"{image},model=physical", f"{image},camera={tmp_path / 'a.XML'},model=physical"):
        with pytest.raises(InputError, match=r"\(60, 40\) px large, its physical model in .* of \(900, 6000\)"):
            open_camera(spec)
    for wrong in ("100", "1:2:3", "900:100", "nan:5", "low:high"):
        with pytest.raises(InputError, match=f"altitudes={wrong} cannot be read"):
            open_camera(f"{tmp_path / 'a.XML'},model=physical,altitudes={wrong}")
    with pytest.raises(InputError, match="model is no choice for the kind rpc"):
        open_camera(f"{tmp_path / 'a.XML'},model=rigorous")


def test_an_xml_alone_tells_its_size_and_that_it_holds_a_physical_model(tmp_path):
    text, _ = isd(Flight(size=SIZE, swing=0.0))
    path = tmp_path / "a.XML"
    path.write_text(text)
    bare = open_camera(path)  # no RPC in it: what it holds is taken
    assert (bare.format, bare.size) == ("maxar physical model", SIZE)
    assert bare.model == open_camera(path, model="physical").model
    path.write_text(text.replace("</isd>", f"{_rpb()}</isd>"))
    both = open_camera(path)
    assert (both.format, both.size, both.rpc) == ("xml", SIZE, make_rpc())
    assert both.notes == ("it holds a physical camera model, too: FILE,model=physical",)
    image = write_image(tmp_path / "a.tif", (1, 40, 60))  # a part of the image: its own size counts
    assert (open_camera(image).size, open_camera(image).notes) == ((60, 40), ())
    dim, _ = dimap(Flight(size=SIZE, swing=0.0))
    (tmp_path / "DIM_b.XML").write_text(dim)
    assert open_camera(tmp_path / "DIM_b.XML").size == SIZE


@pytest.mark.nightly
def test_a_run_on_swinging_platforms_ends_with_grids_that_hold_them(tmp_path):
    """An attitude that swings by 100 urad at 2 Hz: a single RPC misses it by pixels."""
    cameras = []
    for name, look in zip("ab", LOOKS, strict=False):
        text, _ = isd(Flight(size=SIZE, look=look, swing=1e-4))
        (tmp_path / f"{name}.XML").write_text(text)
        write_blank(tmp_path / f"{name}.tif", SIZE)
        cameras.append(open_camera(tmp_path / f"{name}.XML", altitudes=(0.0, 1000.0)).model)
    rng = np.random.default_rng(2)
    ground = cameras[0].localize(rng.uniform(30, np.array(SIZE) - 30, (300, 2)), rng.uniform(0, 300, 300))
    xy = np.stack([camera.project(ground) for camera in cameras], axis=1)
    xy = xy[((xy > 0) & (xy < np.array(SIZE) - 1)).all(axis=(1, 2))]
    xy += rng.normal(0, 0.1, xy.shape)
    count = len(xy)
    assert count > 100
    write_matches(tmp_path / "ties.csv", tied(xy, 0.1), ["a", "b"])
    options = RunOptions(matches=str(tmp_path / "ties.csv"), matches_only=True)
    given = [f"{tmp_path / name}.tif,model=physical,altitudes=0:1000" for name in "ab"]
    result = adjust(given, tmp_path / "out", options)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    for view, name, sensor in zip(summary["views"], "ab", result.adjustment.sensors, strict=True):
        assert view["fit"]["max_px"][1] > 0.5
        assert "includes the orbit and attitude of its physical model, and one RPC misses it by" in view["advice"]
        assert f"({name}_grid.tif)" in view["advice"]
        grid = open_camera(tmp_path / "out" / f"{name}_grid.tif").model
        image, alt = rng.uniform(0, np.array(SIZE) - 1, (200, 2)), rng.uniform(0, 1000, 200)
        np.testing.assert_allclose(grid.project(sensor.localize(image, alt)), image, rtol=0, atol=0.01)


# --- SPOT 1 to 5: METADATA.DIM beside IMAGERY.TIF -----------------------------------------------------------------


@pytest.fixture(scope="module")
def scene_text():
    return Scene(mission=4, size=SIZE, period=1.504e-3, center_line=3000, swath=(0.002, 0.0108)).text()


@pytest.mark.parametrize(
    "names", [("IMAGERY.TIF", "METADATA.DIM"), ("imagery.tif", "Metadata.dim"), ("a.tif", "A.DIM")]
)
def test_an_image_of_a_scene_has_the_camera_beside_it(tmp_path, scene_text, names):
    image, file = (tmp_path / name for name in names)
    write_blank(image, SIZE)
    file.write_text(scene_text)
    camera = open_camera(image)
    assert (camera.format, camera.path, camera.size) == ("spot physical model", file, SIZE)
    assert camera.notes == ("the corners that its producer states are met within 0.0 m",)
    assert camera.doubts == ()
    assert camera.model == open_camera(file).model == open_camera(f"{image},model=physical").model
    raw = open_camera(f"{image},attitudes=raw,altitudes=0:900")
    assert (raw.alt_range, raw.notes) == ((0.0, 900.0), ())
    assert raw.model != camera.model
    assert read_points(image) == (None, None)  # `fit` takes the camera
    acquisition = read_acquisition(image, camera.path)
    assert (acquisition.sensor, acquisition.time) == ("SPOT4_HRV", "2005-05-09T23:59:59Z")
    assert (acquisition.elevation, acquisition.azimuth) == (61.25, 151.5)
    write_rpc(make_rpc(), tmp_path / f"{image.stem}.RPB")
    assert open_camera(image).format == "rpb"  # as of any other image
    assert open_camera(f"{image},model=physical").model == camera.model


def test_other_images_beside_a_scene_are_not_its_image(tmp_path, scene_text):
    (tmp_path / "METADATA.DIM").write_text(scene_text)
    with pytest.raises(ImageError, match="no RPC in the image and none beside it"):
        open_camera(write_blank(tmp_path / "ortho.tif", SIZE))
    with pytest.raises(InputError, match=r"\(60, 40\) px large, its physical model in .* of \(900, 6000\)"):
        open_camera(write_image(tmp_path / "IMAGERY.TIF", (1, 40, 60)))


def test_a_scene_of_another_level_is_refused_by_its_level(tmp_path, scene_text):
    write_blank(tmp_path / "IMAGERY.TIF", SIZE)
    (tmp_path / "METADATA.DIM").write_text(scene_text.replace(">1A<", ">2A<"))
    for name in ("IMAGERY.TIF", "METADATA.DIM"):
        with pytest.raises(RpcFormatError, match=r"METADATA\.DIM: a scene of level 2A, resampled: only 1A has"):
            open_camera(tmp_path / name)


def test_corners_of_another_scene_are_said_with_the_camera(tmp_path, scene_text):
    path = tmp_path / "METADATA.DIM"
    path.write_text(scene_text.replace("SCENE_CENTER_LINE>3000", "SCENE_CENTER_LINE>3004"))
    (doubt,) = open_camera(path).doubts
    assert re.fullmatch(r"the corners that its producer states lie 4\d m from the camera's", doubt.sentence)


@pytest.mark.parametrize("mission", [4, pytest.param(5, marks=pytest.mark.slow)])
def test_an_rpc_of_a_scene_is_that_of_its_orbit(tmp_path, mission):
    scene = Scene(mission, SIZE, center_line=3000, swath=(0.002, 0.0108), listed=40 * (mission == 5))
    write_blank(tmp_path / "IMAGERY.TIF", SIZE)
    (tmp_path / "METADATA.DIM").write_text(scene.text())
    found = barpc.fit(tmp_path / "IMAGERY.TIF", tmp_path / "new" / "IMAGERY_RPC.TXT")
    image = np.array([[10.0, 5000.0], [450.0, 3000.0], [880.0, 20.0]])
    for alt in (0.0, 1500.0):
        off = np.abs(found.rpc.project(scene.ground(image, alt)) - image).max()
        assert off <= np.max(found.max_ckp) + 1e-3 < 0.02
