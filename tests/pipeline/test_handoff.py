"""The hand-off check finds what is wrong with a file, not only what is right."""

from __future__ import annotations

import errno
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio

from barpc.base.errors import OutputError
from barpc.base.geodesy import Array
from barpc.pipeline import verify_outputs
from barpc.pipeline.verify_outputs import (
    CONSUMERS,
    READING_TOLERANCE,
    _lent,
    unverified,
    verify,
    verify_grid,
)
from barpc.rpcio import (
    CARRIERS,
    WRITABLE,
    find_rpc,
    format_for,
    read_rpc,
    write_camera,
    write_rpc,
    write_rpc_copy,
)
from barpc.rpcio.formats import CORRECTION
from barpc.rpcio.grids import write_correction
from barpc.scene import BoolArray
from barpc.sensor.image_corrections import CorrectionGrid, Displaced
from barpc.sensor.rpc import RPC
from barpc.sensor.sampler import Sample, Scattered
from barpc.workspace import Workspace
from tests.rpcio.conftest import make_rpc, write_image

SIZE, ALTITUDES = (2000, 1900), (30.0, 300.0)
NAMES = [f"a{row.suffixes[0]}" for row in {**WRITABLE, **CARRIERS}.values()]


def refuse_hiding(folder: Path, names: list[str], inputs: list[Path]) -> None:
    """A workspace that is to write these files, in a folder that holds other things, too."""
    with Workspace(folder, overwrite=True, keep=inputs, adds=True) as run:
        run._refuse_hiding(names)


def write(rpc: RPC, image: Path, folder: Path, name: str) -> Path:
    path = folder / name
    write_camera(rpc, path, image, overwrite=True)
    return path


@pytest.fixture
def image(tmp_path: Path) -> Path:
    return write_image(tmp_path / "scene.tif")


@pytest.mark.parametrize("name", NAMES)
def test_every_file_is_read_by_another_tool_than_barpc_to_a_billionth_of_a_pixel(name, image, tmp_path):
    if not any(CONSUMERS[tool].installed for tool in format_for(name).consumers):
        pytest.skip("none of the tools that read this format is installed")
    rpc = make_rpc()
    readings = verify([write(rpc, image, tmp_path / "out", name)], Sample.grid(rpc, SIZE, ALTITUDES))
    assert {reading.consumer for reading in readings} > {"barpc"}
    for reading in readings:
        assert reading.passed, reading
        assert reading.max_error <= 1e-9, reading


@pytest.mark.parametrize("name", NAMES)
def test_a_file_of_another_camera_does_not_pass(name, image, tmp_path):
    rpc = make_rpc()
    readings = verify([write(rpc.crop(0.5, 0.5), image, tmp_path / "out", name)], Sample.grid(rpc, SIZE, ALTITUDES))
    for reading in readings:
        assert not reading.passed
        assert reading.max_error == pytest.approx(np.hypot(0.5, 0.5), abs=1e-6)


def test_a_sidecar_that_hides_a_tag_is_caught_by_its_effect(image, tmp_path):
    rpc = make_rpc()
    path = write(rpc, image, tmp_path / "out", "a.tif")
    write_rpc(rpc.crop(0, 7), tmp_path / "out" / "a.RPB")
    for reading in verify([path], Sample.grid(rpc, SIZE, ALTITUDES)):
        assert reading.max_error == pytest.approx(7.0, abs=1e-6)


def test_a_foreign_reader_sees_a_raster_with_its_rpc_files_and_nothing_else(image, tmp_path):
    rpc = make_rpc()
    for name in ("a.tif", "a_RPC.TXT"):
        write(rpc, image, tmp_path / "out", name)
    path = tmp_path / "out/a.tif"
    for more in ("a.tif.aux.xml", "a.tif.ovr", "a.tif.msk"):
        (path.parent / more).write_text("<a/>")
    with _lent(path) as lent:
        assert {file.name for file in lent.parent.iterdir()} == {"a.tif", "a_RPC.TXT"}
        assert lent.resolve() == path.resolve()
        assert lent != path
    with _lent(path.parent / "a_RPC.TXT") as lent:
        assert lent == path.parent / "a_RPC.TXT"


def test_a_file_that_a_tool_cannot_read_is_reported_with_its_reason(tmp_path):
    path = tmp_path / "a_RPC.TXT"
    path.write_text("LINE_OFF: 1\n")
    readings = verify([path], Sample.grid(make_rpc(), SIZE, ALTITUDES))
    assert len(readings) >= 2
    for reading in readings:
        assert not reading.passed
        assert np.isnan(reading.max_error)
        assert reading.note
        assert "\n" not in reading.note


@pytest.mark.parametrize(("code", "refused"), [(errno.ENOSPC, True), (errno.EIO, True), (errno.ENOENT, False)])
def test_a_fault_of_the_machine_is_no_finding_about_a_file(image, tmp_path, monkeypatch, code, refused):
    """Else a run would end well whose file nobody has looked at."""
    path = write(make_rpc(), image, tmp_path / "out", "a_RPC.TXT")

    def lend(*_: object, **__: object) -> None:
        raise OSError(code, "so it is")

    monkeypatch.setattr(rasterio, "MemoryFile", lend)
    if refused:
        with pytest.raises(OutputError, match=r"a_RPC\.TXT: cannot be opened as gdal.* does \(so it is\)"):
            verify([path], Sample.grid(make_rpc(), SIZE, ALTITUDES))
    else:
        readings = verify([path], Sample.grid(make_rpc(), SIZE, ALTITUDES))
        assert [reading.passed for reading in readings].count(False) == 1


def test_a_new_format_is_one_row_written_verified_and_offered(image, tmp_path, monkeypatch, capsys):
    import barpc.cli.convert  # noqa: F401  before the row is there: its help is written once
    from barpc.cli import main
    from barpc.rpcio import formats, text

    def read(content, name, options):
        return text.read_txt(content.removeprefix("NEW\n"), name, options)

    row = formats.Format(
        "new",
        (".new",),
        lambda t: t.startswith("NEW"),
        read,
        lambda rpc: "NEW\n" + text.write_txt(rpc),
        ".new",
    )
    monkeypatch.setattr(formats, "FORMATS", {"new": row, **formats.FORMATS})
    monkeypatch.setitem(formats.WRITABLE, "new", row)
    write_rpc_copy(make_rpc(), image, tmp_path / "in" / "scene.tif")
    args = ["convert", tmp_path / "in" / "scene.tif", "--rpc-format", "new", "-o", tmp_path / "out"]
    with pytest.raises(SystemExit) as stop:
        main([str(arg) for arg in args])
    captured = capsys.readouterr()
    assert stop.value.code == 0, captured.err
    assert f"{tmp_path / 'out' / 'scene.new'}: barpc 0.0e+00 px" in captured.out
    assert "scene.new: only barpc itself has read it" in captured.err
    write_rpc(make_rpc(), tmp_path / "again.new")
    assert read_rpc(tmp_path / "again.new") == make_rpc()
    assert find_rpc(tmp_path / "out", Path("scene.ntf")).name == "scene.vrt"


@pytest.mark.parametrize("row", [*CARRIERS.values(), *WRITABLE.values()], ids=lambda row: row.suffixes[0])
def test_every_row_names_consumers_that_exist(row):
    assert row.consumers
    assert set(row.consumers) <= set(CONSUMERS)
    assert all(format_for(f"a{suffix}") is row for suffix in row.suffixes)


def test_a_format_that_no_installed_tool_reads_says_so(monkeypatch):
    assert unverified(["a.geom", "a.vrt"]) == []
    monkeypatch.setitem(CONSUMERS, "rpcm", replace(CONSUMERS["rpcm"], package="no_such_package"))
    (sentence,) = unverified(["a.vrt", "a.json", "b.json"])
    assert "json" in sentence
    assert "rpcm" in sentence


def test_gdal_s_way_with_a_correction_puts_its_nodes_where_barpc_does_and_keeps_the_ends_beyond(tmp_path):
    rpc, rng = make_rpc(), np.random.default_rng(0)
    grid = CorrectionGrid(np.linspace(300.0, 1500.0, 5), np.linspace(100.0, 1600.0, 4), rng.normal(size=(4, 5, 2)))
    write_correction(grid, rpc, tmp_path / f"a{CORRECTION}")
    found = verify_grid(tmp_path / f"a{CORRECTION}", Scattered.over(Displaced(rpc, grid), SIZE, ALTITUDES))
    assert {one.consumer for one in found} == {"gdal", "barpc"}
    for one in found:
        assert one.max_error < 1e-5, one  # the file holds four-byte numbers


def test_the_consumers_that_are_always_there_need_no_other_package():
    assert {name for name, consumer in CONSUMERS.items() if consumer.installed} >= {
        "gdal",
        "keywords",
        "barpc",
    }
    assert READING_TOLERANCE <= 1e-6


class Other:
    """What stands for another tool's module: it says how it was asked, and answers with a camera of ours."""

    __spec__ = None

    def __init__(self, rpc: RPC) -> None:
        self.rpc, self.asked = rpc, []

    def __call__(self, *given: object, **named: object) -> Other:
        self.asked.append((*given, *named.values()))
        return self

    def __getattr__(self, name: str) -> Other:
        self.asked.append(name)
        return self


def install(monkeypatch: pytest.MonkeyPatch, module: Other) -> None:
    """Let it be what Python imports as the other tool."""
    for name in ("shareloc.geomodels", "shareloc.geomodels.rpc", "orthority.factory"):
        monkeypatch.setitem(sys.modules, name, module)


@pytest.mark.parametrize(
    ("name", "reader"),
    [("a.tif", "rpc_from_geotiff"), ("a_RPC.TXT", "rpc_from_rpc_file"), ("a.json", "RPCModel")],
)
def test_rpcm_is_asked_in_the_way_that_suits_the_file(name, reader, image, tmp_path, monkeypatch):
    rpc = make_rpc()
    path = write(rpc, image, tmp_path / "out", name)
    rpcm = Other(rpc)
    rpcm.projection = lambda lon, lat, alt: rpc.project(np.column_stack([lon, lat, alt])).T
    monkeypatch.setitem(sys.modules, "rpcm.rpc_model", rpcm)
    project = CONSUMERS["rpcm"].open(path)
    ground = Sample.grid(rpc, SIZE, ALTITUDES).ground
    np.testing.assert_array_equal(project(ground), rpc.project(ground))
    assert rpcm.asked[0] == reader
    content, *rest = rpcm.asked[1]
    if name == "a.json":
        assert rest == ["rpcm"]
        assert content["col_offset"] == pytest.approx(rpc.image_offset[0])
    else:
        assert (content, rest) == (str(path), [])


def shareloc(rpc: RPC, takes: Callable[[Array], BoolArray] = lambda lon: np.abs(lon) <= 180.0) -> Other:
    """Stands for shareloc, which gives NaN at longitudes that it does not take, and adds no whole turns."""
    model = Other(rpc)

    def inverse_loc(lon, lat, alt):
        turned = np.where(takes(lon) & (np.abs(lon - rpc.ground_offset[0]) < 180.0), lon, np.nan)
        col, row = rpc.project(np.column_stack([turned, lat, alt])).T
        return row + 0.5, col + 0.5, alt

    model.inverse_loc, model.offset_x = inverse_loc, rpc.ground_offset[0]
    return model


@pytest.mark.parametrize(("lon", "turn"), [(5.0, 0.0), (179.98, 0.0), (-160.0, 360.0), (160.0, -360.0)])
def test_shareloc_counts_from_the_corner_of_the_first_pixel_and_row_before_col(lon, turn, monkeypatch, tmp_path):
    rpc = make_rpc(lon=lon)
    model = shareloc(rpc)
    install(monkeypatch, model)
    ground = Sample.grid(rpc, SIZE, ALTITUDES).ground
    found = CONSUMERS["shareloc"].open(tmp_path / "a.tif")(ground + [turn, 0.0, 0.0])
    np.testing.assert_allclose(found, rpc.project(ground), atol=1e-6 if turn else 1e-9)
    assert (str(tmp_path / "a.tif"),) in model.asked


def test_shareloc_is_asked_of_a_grid_from_the_corner_of_the_first_pixel_and_row_before_col(monkeypatch, tmp_path):
    rpc = make_rpc()
    at = np.random.default_rng(0).uniform([0.0, 0.0, 100.0], [900.0, 700.0, 800.0], (50, 3))
    asked = Other(rpc)

    def direct_loc_h(row, col, alt):
        return np.column_stack([rpc.localize(np.column_stack([col, row]) - 0.5, alt)[:, :2], alt])

    asked.direct_loc_h = direct_loc_h
    install(monkeypatch, asked)
    monkeypatch.setattr("barpc.pipeline.verify_outputs.open_camera", lambda _: SimpleNamespace(model=None))
    localize = verify_outputs._shareloc_grid(tmp_path / "a_grid.tif")
    np.testing.assert_allclose(localize(at)[:, :2], rpc.localize(at[:, :2], at[:, 2])[:, :2], rtol=0, atol=1e-12)
    assert asked.asked[0] == "GeoModel"
    assert asked.asked[1] == (str(tmp_path / "a_grid.tif"), "GRID")


def test_shareloc_asks_in_one_thread_and_leaves_as_many_as_there_were(monkeypatch, tmp_path):
    """Threads that wait for each other took 15 ms of CPU an image."""
    rpc, threads = make_rpc(), [2]
    numba = SimpleNamespace(get_num_threads=lambda: threads[-1], set_num_threads=threads.append)
    model = shareloc(rpc)
    inverse = model.inverse_loc
    model.inverse_loc = lambda *given: threads.append(10 * threads[-1]) or inverse(*given)
    install(monkeypatch, model)
    monkeypatch.setitem(sys.modules, "numba", numba)
    CONSUMERS["shareloc"].open(tmp_path / "a.tif")(Sample.grid(rpc, SIZE, ALTITUDES).ground)
    assert threads == [2, 1, 10, 2]


@pytest.mark.parametrize(
    ("lon", "takes", "note"),
    [
        (
            179.9999,
            lambda lon: np.abs(lon) <= 180.0,
            "shareloc takes no longitude beyond 180 degrees, where ",
        ),
        (
            -179.9999,
            lambda lon: np.abs(lon) <= 180.0,
            "shareloc takes no longitude beyond 180 degrees, where ",
        ),
        (200.0, lambda lon: np.abs(lon) <= 180.0, "where 605 of 605 points lie"),
        (179.9999, lambda lon: lon < 1000.0, ""),  # a version that takes them
        (179.9999, lambda lon: lon > 1000.0, "it projects to no finite point"),
        (5.0, lambda lon: lon < 5.0, "it projects to no finite point"),
    ],
)
def test_what_shareloc_leaves_out_beyond_180_degrees_is_told(lon, takes, note, monkeypatch, tmp_path):
    rpc = make_rpc(lon=lon)
    install(monkeypatch, shareloc(rpc, takes))
    named = {"shareloc": replace(CONSUMERS["shareloc"], package="numpy"), "barpc": CONSUMERS["barpc"]}
    monkeypatch.setattr("barpc.pipeline.verify_outputs._consumers", lambda _: named)
    write_rpc(rpc, tmp_path / "a.geom")
    reading, own = verify([tmp_path / "a.geom"], Sample.grid(rpc, SIZE, ALTITUDES))
    assert own.passed
    assert reading.passed == (not note)
    assert note in reading.note
    assert bool(note) == bool(reading.note)


def test_orthority_counts_as_barpc_does(monkeypatch, tmp_path):
    rpc = make_rpc()
    model = Other(rpc)
    model.world_to_pixel = lambda columns: rpc.project(columns.T).T
    install(monkeypatch, model)
    ground = Sample.grid(rpc, SIZE, ALTITUDES).ground
    found = CONSUMERS["orthority"].open(tmp_path / "a.tif")(ground)
    np.testing.assert_array_equal(found, rpc.project(ground))
    assert ((str(tmp_path / "a.tif"),),) in model.asked
    assert ("a.tif",) in model.asked


# --- what would be read in place of an image's RPC ------------------------------------------------------------


def with_own_camera(path: Path) -> Path:
    """An image that holds an RPC."""
    plain = write_image(path.with_name("plain.tif"))
    write_rpc_copy(make_rpc(), plain, path, overwrite=True)
    plain.unlink()
    return path


def test_a_file_that_would_hide_an_image_s_own_rpc_is_refused(tmp_path):
    image = with_own_camera(tmp_path / "scene.tif")
    with pytest.raises(OutputError, match=r"scene_RPC\.TXT: would be read in place of the RPC of .*scene\.tif"):
        refuse_hiding(tmp_path, ["scene_RPC.TXT"], [])
    with pytest.raises(OutputError, match="of the input"):
        refuse_hiding(tmp_path, ["scene_RPC.TXT"], [image])
    refuse_hiding(tmp_path, ["other_RPC.TXT"], [image])
    refuse_hiding(tmp_path / "nowhere", ["scene_RPC.TXT"], [image])


def test_what_is_there_already_hides_no_more_than_it_did_but_from_inputs(tmp_path):
    image = with_own_camera(tmp_path / "scene.tif")
    write_rpc(make_rpc(), tmp_path / "scene_RPC.TXT")
    refuse_hiding(tmp_path, ["scene_RPC.TXT"], [])
    with pytest.raises(OutputError, match="of the input"):
        refuse_hiding(tmp_path, ["scene_RPC.TXT"], [image])


def test_an_image_that_a_run_wrote_may_be_written_over_with_its_rpc(tmp_path):
    made = with_own_camera(tmp_path / "scene.tif")
    with Workspace(tmp_path / "run") as run, run.output("scene.tif") as path:
        path.write_bytes(made.read_bytes())
    refuse_hiding(tmp_path / "run", ["scene_RPC.TXT"], [])
    with (tmp_path / "run/scene.tif").open("ab") as file:
        file.write(b"edited")
    with pytest.raises(OutputError, match="in place of the RPC"):
        refuse_hiding(tmp_path / "run", ["scene_RPC.TXT"], [])
