"""The hand-off check finds what is wrong with a file, not only what is right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from barpc.errors import OutputError
from barpc.handoff import CONSUMERS, TOLERANCE, control_grid, difference, verify
from barpc.rpcio import write_rpc, write_rpc_copy, write_rpc_nitf, write_rpc_vrt
from barpc.sensor.rpc import RPC
from tests.rpcio.conftest import make_rpc, write_image

SIZE, ALTITUDES = (2000, 1900), (30.0, 300.0)
NAMES = ["a_RPC.TXT", "a.RPB", "a.geom", "a.XML", "a.json", "a.vrt", "a.tif"]


def write(rpc: RPC, image: Path, folder: Path, name: str) -> Path:
    path = folder / name
    writer = {".vrt": write_rpc_vrt, ".tif": write_rpc_copy, ".ntf": write_rpc_nitf}.get(path.suffix)
    if writer is None:
        write_rpc(rpc, path, overwrite=True)
    else:
        writer(rpc, image, path, overwrite=True)
    return path


@pytest.fixture
def image(tmp_path: Path) -> Path:
    return write_image(tmp_path / "scene.tif")


@pytest.mark.parametrize("name", NAMES)
def test_every_file_is_read_by_another_tool_than_barpc_to_a_billionth_of_a_pixel(name, image, tmp_path):
    if name.endswith(".json"):
        pytest.importorskip("rpcm", reason="of the other tools only rpcm reads this format")
    rpc = make_rpc()
    readings = verify([write(rpc, image, tmp_path / "out", name)], rpc, SIZE, ALTITUDES)
    assert {reading.consumer for reading in readings} > {"barpc"}
    for reading in readings:
        assert reading.passed, reading
        assert reading.max_error <= 1e-9, reading


@pytest.mark.parametrize("name", NAMES)
def test_a_file_of_another_camera_does_not_pass(name, image, tmp_path):
    rpc = make_rpc()
    readings = verify([write(rpc.crop(0.5, 0.5), image, tmp_path / "out", name)], rpc, SIZE, ALTITUDES)
    for reading in readings:
        assert not reading.passed
        assert reading.max_error == pytest.approx(np.hypot(0.5, 0.5), abs=1e-6)


def test_a_sidecar_that_hides_a_tag_is_caught_by_its_effect(image, tmp_path):
    rpc = make_rpc()
    path = write(rpc, image, tmp_path / "out", "a.tif")
    write_rpc(rpc.crop(0, 7), tmp_path / "out" / "a.RPB")
    for reading in verify([path], rpc, SIZE, ALTITUDES):
        assert reading.max_error == pytest.approx(7.0, abs=1e-6)


def test_a_nitf_tells_what_its_record_cut_off(image, tmp_path):
    """Half a pixel of the offsets, tenths of the 1e-4 degrees, the seventh digit of the coefficients."""
    rpc = make_rpc()
    (reading, *_) = verify([write(rpc, image, tmp_path / "out", "a.ntf")], rpc, SIZE, ALTITUDES)
    assert not reading.passed
    assert 0.1 < reading.max_error < 5


def test_a_file_that_a_tool_cannot_read_is_reported_with_its_reason(tmp_path):
    path = tmp_path / "a_RPC.TXT"
    path.write_text("LINE_OFF: 1\n")
    readings = verify([path], make_rpc(), SIZE, ALTITUDES)
    assert len(readings) >= 2
    for reading in readings:
        assert not reading.passed
        assert np.isnan(reading.max_error)
        assert reading.note
        assert "\n" not in reading.note


def test_the_grid_covers_the_image_and_its_altitudes():
    rpc = make_rpc()
    ground, image = control_grid(rpc, SIZE, ALTITUDES)
    np.testing.assert_allclose(image.min(axis=0), [0, 0], atol=1e-6)
    np.testing.assert_allclose(image.max(axis=0), [SIZE[0] - 1, SIZE[1] - 1], atol=1e-6)
    assert (ground[:, 2].min(), ground[:, 2].max()) == ALTITUDES


def test_two_cameras_differ_by_what_one_was_moved():
    rpc = make_rpc()
    assert difference(rpc, rpc, SIZE, ALTITUDES) == 0.0
    assert difference(rpc, rpc.crop(3, 4), SIZE, ALTITUDES) == pytest.approx(5.0, abs=1e-9)
    assert np.isnan(difference(rpc.crop(1e12, 0), rpc, SIZE, ALTITUDES))


def test_a_model_that_sees_nothing_is_an_error():
    blind = make_rpc().crop(1e12, 1e12)
    with pytest.raises(OutputError, match="no ground point"):
        verify([], blind, SIZE, ALTITUDES)


def test_the_consumers_that_are_always_there_need_no_other_package():
    assert {name for name, consumer in CONSUMERS.items() if consumer.installed} >= {
        "gdal",
        "keywords",
        "barpc",
    }
    assert TOLERANCE <= 1e-6
