"""The one door for cameras: every kind goes through every verb, and a new kind is one row."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np
import pytest

import barpc
from barpc.base.errors import ImageError, InputError
from barpc.base.geodesy import Array, ecef_from_ground, ecef_from_ground_jacobian
from barpc.base.remote import Remote
from barpc.cameras import EVERYWHERE as ON_EARTH
from barpc.cameras import OPENERS, Opener, open_camera
from barpc.cli import cli
from barpc.rpcio import read_rpc, write_rpc
from barpc.rpcio.grids import write_correction, write_grid
from barpc.scene import Camera
from barpc.sensor import SensorModel
from barpc.sensor.csm import open_state
from barpc.sensor.image_corrections import CorrectionGrid
from barpc.sensor.rpc import altitude_range
from tests.cli.test_main import run
from tests.fit.models import Frame
from tests.pipeline.known import part
from tests.rpcio.conftest import dimap_v2, make_rpc, write_image
from tests.sensor.conftest import MODELS
from tests.sensor.linescan_files import Flight, isd
from tests.sensor.terrasar_files import Terrasar
from tests.sensor.test_csm import linescan
from tests.sensor.test_csm import write as write_state

# --- a camera that barpc does not know: an aerial frame camera, in one class and one row --------------------


class Pinhole(Frame):
    """One that looks straight down: one instant, one focal length [px]; with the derivatives that a camera has."""

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        place, axes = self._pose()
        x, y, z = np.moveaxis((ecef_from_ground(ground) - place) @ axes.T, -1, 0)
        zero = np.zeros_like(z)
        by_seen = self.focal * np.stack(
            [np.stack([1 / z, zero, -x / z**2], -1), np.stack([zero, 1 / z, -y / z**2], -1)], -2
        )
        return self.project(ground), by_seen @ axes @ ecef_from_ground_jacobian(ground)


def _open_frame(path: Path, higher: float = 0.0) -> Camera:
    values = json.loads(path.read_text())["frame"]
    size = (values["size"][0], values["size"][1])
    model = Pinhole(values["lon"], values["lat"], values["alt"] + higher, values["focal"], size)
    return Camera(model, path, "frame", model.size, (-100.0, 400.0))


@pytest.fixture
def frame(tmp_path, monkeypatch):
    row = Opener(lambda _path, head, _choices: head.startswith(b'{"frame"'), _open_frame, {"higher": float})
    monkeypatch.setitem(OPENERS, "frame", row)
    path = tmp_path / "frame.json"
    values = {"lon": 5.4, "lat": 43.2, "alt": 3000.0, "focal": 6000.0, "size": [4000, 3000]}
    path.write_text(json.dumps({"frame": values}))
    return path


def test_a_new_sensor_goes_through_every_verb_by_one_row(frame, tmp_path, capsys):
    model = open_camera(frame).model
    assert isinstance(model, SensorModel)
    assert run("localize", frame, 100, 200, "--alt", 50, "--json") == 0
    (ground,) = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(model.project([ground["lon"], ground["lat"], 50.0]), [100, 200], atol=1e-3)
    assert run("project", frame, ground["lon"], ground["lat"], 50, "--json") == 0
    (image,) = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose([image["col"], image["row"]], [100, 200], atol=1e-3)
    assert run("info", frame, "--json") == 0
    (report,) = json.loads(capsys.readouterr().out)
    assert report["rpc"] == f"frame in {frame}"
    assert report["altitude_range_m"] == [-100.0, 400.0]
    assert report["gsd_m"]["col"] == pytest.approx((3000 - 150) / 6000, rel=1e-3)
    assert report["incidence_deg"] < 0.1
    assert run("info", f"{frame},higher=1000", "--json") == 0
    (report,) = json.loads(capsys.readouterr().out)
    assert report["gsd_m"]["col"] == pytest.approx((4000 - 150) / 6000, rel=1e-3)
    out = tmp_path / "out" / "frame_RPC.TXT"
    assert run("fit", frame, "-o", out) == 0
    capsys.readouterr()
    points = model.localize([[0.0, 0.0], [3999.0, 0.0], [2000.0, 1500.0]], np.array([0.0, 100.0, 300.0]))
    np.testing.assert_allclose(read_rpc(out).project(points), model.project(points), atol=1e-3)


def test_a_camera_that_is_no_rpc_says_so_where_an_rpc_is_needed(frame, tmp_path, capsys):
    assert run("convert", frame, tmp_path / "a.RPB") == 1
    assert "barpc fit" in capsys.readouterr().err
    assert not (tmp_path / "a.RPB").exists()


def test_a_localisation_grid_is_a_camera(tmp_path):
    case = MODELS["localisation grid"]()
    write_grid(case.model, tmp_path / "grid.tif")
    camera = open_camera(tmp_path / "grid.tif")
    assert camera.format == "grid"
    assert camera.model == case.model
    assert camera.alt_range == (-100.0, 1100.0)
    assert camera.size == (20501, 19301)


def test_a_csm_state_is_a_camera_for_all_ground_on_earth_or_the_altitudes_that_are_named(tmp_path):
    path = write_state(linescan(), tmp_path / "a.json")
    camera = open_camera(path)
    assert (camera.format, camera.size, camera.alt_range) == ("csm", (3000, 4000), ON_EARTH)
    named = open_camera(f"{path},altitudes=0:300")
    assert named.alt_range == (0.0, 300.0)
    at, alt = np.array([[10.0, 20.0]]), np.array([150.0])
    np.testing.assert_array_equal(named.model.localize(at, alt), open_state(path)[0].localize(at, alt))


def test_a_correction_grid_is_a_camera_of_the_image_that_it_spans(tmp_path):
    rpc = make_rpc()
    lacking = CorrectionGrid(np.array([-0.5, 99.5]), np.array([-0.5, 39.5, 79.5]), np.full((3, 2, 2), [0.25, -0.5]))
    write_correction(lacking, rpc, tmp_path / "a.tif")
    camera = open_camera(tmp_path / "a.tif")
    assert (camera.format, camera.size, camera.alt_range) == ("correction", (100, 80), altitude_range(rpc))
    ground = rpc.localize(np.array([[50.0, 30.0]]), np.array([200.0]))
    np.testing.assert_allclose(camera.model.project(ground), [[50.25, 29.5]], atol=1e-4)


@pytest.mark.slow
def test_a_radar_product_and_a_vendor_s_grid_go_through_the_verbs(shared_data, tmp_path, capsys):
    radar = sorted((shared_data / "sar").glob("s1a-iw1-slc-vv-20210216*.xml"))[0]
    grid = shared_data / "physical" / "GRID_P1BP--2017092838284574CP.tif"
    folder = Terrasar().write(tmp_path).parent
    for source, kind in ((radar, "sentinel-1"), (grid, "grid"), (folder, "terrasar-x")):
        camera = open_camera(source)
        assert camera.format == kind
        middle = (np.array(camera.extent) - 1) / 2
        assert run("localize", source, *middle, "--json") == 0
        (ground,) = json.loads(capsys.readouterr().out)
        assert run("project", source, ground["lon"], ground["lat"], ground["alt"], "--json") == 0
        (image,) = json.loads(capsys.readouterr().out)
        np.testing.assert_allclose([image["col"], image["row"]], middle, atol=2e-3)
        assert run("info", source, "--json") == 0
        assert json.loads(capsys.readouterr().out)[0]["footprint"]["type"] == "Polygon"


# --- what may stand behind a file ---------------------------------------------------------------------------


def test_the_camera_of_an_image_may_lie_anywhere(tmp_path):
    image = write_image(tmp_path / "scene.tif", shape=(1, 40, 60))
    write_rpc(make_rpc(), tmp_path / "elsewhere" / "other.RPB")
    camera = open_camera(f"{image},camera={tmp_path / 'elsewhere' / 'other.RPB'}")
    assert camera.model == make_rpc()
    assert camera.size == (60, 40)
    assert camera.path == tmp_path / "elsewhere" / "other.RPB"


@pytest.mark.parametrize(
    ("kind", "choices"),
    [("sentinel-1", {}), ("terrasar-x", {}), ("sicd", {}), ("physical", {"model": "physical"})],
)
def test_cameras_that_are_read_from_disk_only_say_so_of_a_url(kind, choices):
    with pytest.raises(ImageError, match=r"^s3://bucket/product: .* read from disk only$"):
        OPENERS[kind].open(Remote("s3://bucket/product"), **choices)


def test_a_physical_model_is_found_beside_its_image_or_read_from_its_own_file(tmp_path):
    flight = Flight(size=(60, 40), swing=0.0)
    (tmp_path / "scene.XML").write_text(isd(flight)[0])
    image = write_image(tmp_path / "scene.tif", shape=(1, 40, 60))
    for given in (image, tmp_path / "scene.XML"):
        camera = open_camera(given, model="physical")
        assert (camera.path, camera.size) == (tmp_path / "scene.XML", (60, 40))


def test_a_file_whose_name_looks_like_choices_is_a_file(tmp_path):
    write_rpc(make_rpc(), tmp_path / "a,size=3:4.RPB")
    camera = open_camera(tmp_path / "a,size=3:4.RPB")
    assert (camera.model, camera.size) == (make_rpc(), None)
    assert open_camera(f"{tmp_path / 'a,size=3:4.RPB'},size=5:6").size == (5, 6)


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ("swath=iw1", "swath is no choice for the kind rpc"),
        ("size=3", "size=3 cannot be read"),
        ("size=3:0", "size=3:0 cannot be read"),
        ("first_pixel=2", "first_pixel=2 cannot be read"),
        ("band=x", "band=x cannot be read"),
    ],
)
def test_a_choice_that_does_not_go_with_the_camera_names_the_file(choice, words, tmp_path):
    write_rpc(make_rpc(), tmp_path / "a.RPB")
    with pytest.raises(InputError, match=words) as error:
        open_camera(f"{tmp_path / 'a.RPB'},{choice}")
    assert "a.RPB" in str(error.value)


def test_every_choice_of_every_kind_stands_in_the_help():
    text = cli.get_command(click.Context(cli, **cli.context_settings), "info").help
    for choice in {"size", "camera", *(choice for opener in OPENERS.values() for choice in opener.choices)}:
        assert f'",{choice}=' in text, choice


# --- a run with cameras of one's own ------------------------------------------------------------------------


@dataclass(frozen=True)
class Own:
    """Somebody's own model: an RPC that hides behind the three methods."""

    inner: barpc.RPC

    def project(self, ground: Array) -> Array:
        return self.inner.project(ground)

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        return self.inner.project_jacobian(ground)

    def localize(self, image: Array, alt: Array) -> Array:
        return self.inner.localize(image, alt)


@pytest.mark.slow
def test_views_with_one_s_own_model_are_adjusted_as_files_are(tmp_path):
    from barpc.pipeline import load_views

    images = part(tmp_path).images[:2]
    views = load_views(images).views
    views = [replace(v, sensor=replace(v.sensor, err_bias=None)) for v in views]  # what only an RPC can state
    own = [replace(v, sensor=Own(v.sensor)) for v in views]
    files = barpc.adjust(views, tmp_path / "files")
    mine = barpc.adjust(own, tmp_path / "mine")
    assert [view.path for view in mine.views] == [str(path) for path in images]
    for view, expected in zip(mine.views, files.views, strict=True):
        points = expected.sensor.localize([[0.0, 0.0], [90.0, 270.0]], np.array([200.0, 250.0]))
        np.testing.assert_allclose(view.sensor.project(points), expected.sensor.project(points), atol=1e-4)
    assert mine.summary["views"][0]["rpc_source"]["format"] == "given"
    assert barpc.check(mine.views).passed
    wrong = replace(own[0], size=(3, 4))
    with pytest.raises(InputError, match="view says"):
        barpc.check([wrong, own[1]])


def test_a_physical_model_is_for_the_altitudes_of_the_rpc_beside_it_or_for_all_ground_on_earth(tmp_path):
    (tmp_path / "DIM_A.XML").write_text(isd(Flight(size=(60, 40), swing=0.0))[0])
    assert open_camera(tmp_path / "DIM_A.XML", model="physical").alt_range == (-500.0, 9000.0)
    rpc = make_rpc()
    write_rpc(rpc, tmp_path / "other.RPB")
    (tmp_path / "other.RPB").rename(tmp_path / "RPC_A.XML")
    assert open_camera(tmp_path / "DIM_A.XML", model="physical").alt_range == altitude_range(rpc)


@pytest.mark.parametrize(
    ("text", "taken"),
    [("-10000:100000", True), *((text, False) for text in ("-10001:0", "0:100001", "5:5", "6:5", "0:1:2"))],
)
def test_altitudes_are_an_interval_that_ground_may_lie_in(text, taken):
    if taken:
        assert OPENERS["csm"].choices["altitudes"](text) == (-1e4, 1e5)
    else:
        with pytest.raises(ValueError):
            OPENERS["csm"].choices["altitudes"](text)


@pytest.mark.parametrize("physical", [True, False])
def test_a_vendor_s_xml_alone_says_its_image_s_size_and_whether_it_holds_more(physical, tmp_path):
    inside = "<NCOLS>700</NCOLS><NROWS>500</NROWS>" + "<ATTLIST>1 2</ATTLIST>" * physical
    text = dimap_v2(make_rpc()).replace("</Dimap_Document>", f"{inside}</Dimap_Document>")
    (tmp_path / "RPC_a.XML").write_text(text)
    found = open_camera(tmp_path / "RPC_a.XML")
    assert found.size == (700, 500)
    assert ("it holds a physical camera model, too: FILE,model=physical" in found.notes) == physical
