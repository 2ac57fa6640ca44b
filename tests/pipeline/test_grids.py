"""Grids, tiles and resampled images of a run: written where one RPC does not do, reopened, owned, told."""

from __future__ import annotations

import json
import logging
import re
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from barpc.cameras import open_camera
from barpc.cli.main import cli
from barpc.errors import FitError, ImageError, OutputError
from barpc.fit import FitOptions, RpcFit, fit_rpc
from barpc.options import RunOptions
from barpc.pipeline import adjust, check, grids
from barpc.pipeline.grids import CORRECTION, GRID, RESAMPLED, TILES, grid_names, tile_boxes, write_grids
from barpc.rpcio import read_rpc
from barpc.rpcio.grids import read_correction
from barpc.scene import View
from barpc.sensor.direct_grid import LINEAR
from barpc.workspace import Workspace, own_files
from tests.jitter import scene
from tests.rpcio.conftest import write_image

from .test_growth import write_block

SIZE, ALTS = (1500, 2200), (0.0, 600.0)
ENDS = (GRID, CORRECTION, RESAMPLED, TILES)


@pytest.fixture(scope="module")
def camera():
    """A swing of 0.3 px every 900 rows: two and a half in the image, which no RPC follows."""
    return scene(900.0, 0.3, SIZE, ALTS)


@pytest.fixture(scope="module")
def fit(camera) -> RpcFit:
    return fit_rpc(camera, SIZE, ALTS, strict=False)


@pytest.fixture(scope="module")
def easy(camera) -> RpcFit:
    return fit_rpc(camera.sensor, SIZE, ALTS)


@pytest.fixture(scope="module")
def view(tmp_path_factory, camera) -> View:
    path = write_image(tmp_path_factory.mktemp("in") / "a.tif", (1, SIZE[1], SIZE[0]), dtype="uint16")
    return View("a", str(path), SIZE, camera.sensor, ALTS)


def seen_by(camera, count=2000, low=(0.0, 0.0), high=SIZE):
    rng = np.random.default_rng(8)
    image = rng.uniform(np.array(low) - 0.5, np.array(high) - 0.5, (count, 2))
    return camera.localize(image, rng.uniform(*ALTS, count)), image


def run_of(folder: Path, *given, **options) -> list[dict[str, dict[str, float | str]]]:
    with Workspace(folder) as run:
        return write_grids(run, given, RunOptions(**options))


def test_grids_are_written_where_the_rpc_misses_the_camera_and_nowhere_else(
    tmp_path, view, camera, fit, easy
):
    assert 0.02 < fit.max_ckp.max() < 0.6
    other = replace(view, name="b")
    written = run_of(tmp_path / "out", (view, fit, camera), (other, easy, camera.sensor))
    assert [list(one) for one in written] == [["a" + GRID, "a" + CORRECTION], []]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {".barpc", "a" + GRID, "a" + CORRECTION}
    written = run_of(tmp_path / "all", (view, fit, camera), (other, easy, camera.sensor), grids=True)
    assert list(written[1]) == ["b" + GRID, "b" + CORRECTION]
    near = replace(fit, max_ckp=np.array([0.0119, 0.0159]))  # 0.0199 together
    assert run_of(tmp_path / "near", (view, near, camera)) == [{}]
    far = replace(fit, max_ckp=np.array([0.0121, 0.0161]))
    assert list(run_of(tmp_path / "far", (view, far, camera))[0]) == ["a" + GRID, "a" + CORRECTION]


def test_what_is_told_of_a_grid_is_its_error(tmp_path, view, camera, fit):
    (written,) = run_of(tmp_path, (view, fit, camera))
    ground, image = seen_by(camera)
    for name in (GRID, CORRECTION):
        off = np.linalg.norm(open_camera(tmp_path / f"a{name}").model.project(ground) - image, axis=1).max()
        told = written[f"a{name}"]["barpc"]
        assert 0.3 * told < off < 1.2 * told
        assert told < LINEAR
    assert LINEAR / 10 < written["a" + GRID]["linear"] < LINEAR


def test_no_altitude_changes_what_is_added_to_the_rpc_of_a_correction(tmp_path, view, camera, fit):
    """The run's own RPC is not the one to add to: what it lacks is another at other altitudes."""
    run_of(tmp_path, (view, fit, camera))
    rpc, lacking = read_correction(tmp_path / f"a{CORRECTION}")
    at = seen_by(camera)[1]
    for alt in ALTS:
        ground = rpc.localize(at, np.full(len(at), alt))
        assert np.linalg.norm(lacking.apply(at) - camera.project(ground), axis=1).max() < LINEAR
    assert rpc.err_bias == fit.rpc.err_bias


def test_an_rpc_of_a_tile_is_the_camera_in_its_own_pixels(tmp_path, view, camera, fit):
    (written,) = run_of(tmp_path, (view, fit, camera), tiles=500)
    table = json.loads((tmp_path / ("a" + TILES)).read_text())
    assert (table["image"], table["size"]) == ("a", list(SIZE))
    assert len(table["tiles"]) == 12
    for tile in table["tiles"]:
        origin, side = np.array([tile["col"], tile["row"]]), np.array([tile["width"], tile["height"]])
        assert tile["file"] == f"a_tiles/{tile['row']:05d}_{tile['col']:05d}_RPC.TXT"
        ground, image = seen_by(camera, 200, origin, origin + side)
        off = np.linalg.norm(
            read_rpc(tmp_path / tile["file"]).project(ground) - (image - origin), axis=1
        ).max()
        assert off < LINEAR
        assert off < 1.2 * tile["max_px"] + 1e-6
    worst = max(tile["max_px"] for tile in table["tiles"])
    assert written["a" + TILES] == {"barpc": worst}
    assert worst < LINEAR < 0.02 < fit.max_ckp.max()


def test_tiles_that_are_too_large_are_told(tmp_path, view, camera, fit, caplog):
    with caplog.at_level(logging.WARNING):
        (written,) = run_of(tmp_path, (view, fit, camera), tiles=2000)
    assert written["a" + TILES]["barpc"] > LINEAR
    assert "tiles of 2000 px miss the camera" in caplog.text


@pytest.mark.parametrize("size", [(100, 100), (64, 4000), (149, 150), (1000, 333)])
@pytest.mark.parametrize("side", [64, 100, 1000])
def test_tiles_cover_an_image_once(size, side):
    boxes = tile_boxes(size, side)
    count = np.zeros(size[::-1], int)
    for col, row, width, height in boxes:
        count[row : row + height, col : col + width] += 1
        assert col % side == row % side == 0
        assert all(
            2 * n >= min(side, whole) and n <= 1.5 * side
            for n, whole in zip((width, height), size, strict=True)
        )
    assert (count == 1).all()


def test_a_resampled_image_has_one_rpc_that_holds(tmp_path, view, camera, fit):
    """Its pixels are those of the image, taken where the camera sees what its RPC sees."""
    (written,) = run_of(tmp_path, (view, fit, camera), resample=True)
    assert list(written) == ["a" + GRID, "a" + CORRECTION, "a" + RESAMPLED]
    assert max(written["a" + RESAMPLED].values()) < 0.02
    rpc, _ = read_correction(tmp_path / f"a{CORRECTION}")
    assert read_rpc(tmp_path / f"a{RESAMPLED}").off(rpc).max() < 1e-9


def test_a_file_that_does_not_hold_what_was_written_ends_the_run(tmp_path, view, camera, fit, monkeypatch):
    real = grids.write_correction
    monkeypatch.setattr(
        grids,
        "write_correction",
        lambda grid, *given, **how: real(replace(grid, shift=-grid.shift), *given, **how),
    )
    with pytest.raises(
        OutputError, match=r"a_correction\.tif: (gdal|barpc) reads it [01]\.\d+ px RMS off, not 0\.00\d+; is"
    ):
        run_of(tmp_path / "out", (view, fit, camera))


@pytest.mark.slow
def test_a_run_that_dies_half_way_leaves_nothing_half_written(tmp_path, view, camera, fit, monkeypatch):
    def dying(*given, **how):
        raise KeyboardInterrupt

    monkeypatch.setattr(grids, "write_resampled", dying)
    with pytest.raises(KeyboardInterrupt):
        run_of(tmp_path / "out", (view, fit, camera), resample=True)
    assert [path.name for path in (tmp_path / "out").iterdir()] == [".barpc"]
    assert not list((tmp_path / "out" / ".barpc" / "partial").rglob("*.tif"))
    monkeypatch.undo()
    run_of(tmp_path / "out", (view, fit, camera), resample=True)
    assert own_files(tmp_path / "out") == {"a" + GRID, "a" + CORRECTION, "a" + RESAMPLED}


def test_tiles_that_were_fitted_are_not_fitted_again(tmp_path, view, camera, fit, monkeypatch):
    model = fit.rpc  # of barpc, so that results of it are kept
    real = Workspace.write_text

    def dying(self, name, text):
        if name.endswith(TILES):
            raise KeyboardInterrupt
        return real(self, name, text)

    monkeypatch.setattr(Workspace, "write_text", dying)
    with pytest.raises(KeyboardInterrupt):
        run_of(tmp_path / "out", (view, fit, model), tiles=750)
    monkeypatch.undo()
    monkeypatch.setattr(grids, "fit_rpc", None)
    run_of(tmp_path / "out", (view, fit, model), tiles=750)
    assert len(own_files(tmp_path / "out")) == 6 + 1 + 2  # tiles, their list, grids


def test_a_camera_without_ground_in_a_part_of_its_image_is_one_line(tmp_path, view, camera, fit):
    @dataclass(frozen=True)
    class Blind:
        def __getattr__(self, name):
            return getattr(camera, name)

        def localize(self, image, alt):
            return np.where(np.asarray(image)[..., :1] > 1400, np.nan, camera.localize(image, alt))

    with pytest.raises(FitError, match=r"^a, tile from column 1000, row 0 on: .*no ground point"):
        run_of(tmp_path / "tiles", (view, replace(fit, max_ckp=np.zeros(2)), Blind()), tiles=500)
    with pytest.raises(OutputError, match=r"^a: no grid can be made of its camera") as caught:
        run_of(tmp_path / "out", (view, fit, Blind()), grids=True)
    assert "\n" not in str(caught.value)


def test_what_steps_leave_is_told(tmp_path, view, camera, fit, caplog):
    """A grid does not hold a step between detectors in the cell that it runs through: said, with how much it is."""

    class Stepped:
        sensor = camera.sensor

        def localize(self, image, alt):
            image = np.asarray(image)
            return camera.localize(image - 0.1 * (image[..., :1] > 700.3), alt)

        def project(self, ground):
            image = camera.project(ground)
            return image + 0.1 * (image[..., :1] > 700.25)

    with caplog.at_level(logging.WARNING):
        (written,) = run_of(tmp_path, (view, fit, Stepped()), grids=True)
    for end in (GRID, CORRECTION):  # whoever reads a file sees the step that was seen as it was written
        (told,) = re.findall(rf"a{end}: \S+ px RMS off, up to (0\.\d+) px", caplog.text)
        assert 0.02 < 0.99 * float(told) <= written["a" + end]["barpc"] < 0.3


def test_all_names_are_known_before_the_run(view):
    assert grid_names(view, RunOptions()) == ["a" + GRID, "a" + CORRECTION]
    names = grid_names(view, RunOptions(tiles=800, resample=True))
    assert names[:3] == ["a" + GRID, "a" + CORRECTION, "a" + RESAMPLED]
    assert names[3:] == [
        *(f"a_tiles/{r:05d}_{c:05d}_RPC.TXT" for r in (0, 800, 1600) for c in (0, 800)),
        "a" + TILES,
    ]


# --- whole runs -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    folder = tmp_path_factory.mktemp("block")
    return write_block(folder, 3)[1], str(folder / "matches.npz")


@pytest.mark.slow
def test_a_run_with_everything_is_told_and_the_same_whatever_the_workers(block, tmp_path):
    images, matches = block
    options = RunOptions(matches=matches, matches_only=True, grids=True, tiles=128, resample=True)
    result = adjust(images, tmp_path / "a", options)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        adjust(images, tmp_path / "b", options, executor=executor)
    for view in result.record.views:
        ends = [".vrt", "_RPC.TXT", *ENDS]
        assert list(view.outputs) == [view.name + end for end in ends]
        for name in view.outputs:
            assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
        assert all(
            isinstance(px, float) and px < LINEAR for one in view.outputs.values() for px in one.values()
        )
        for end in (GRID, CORRECTION, RESAMPLED):
            found = open_camera(tmp_path / "a" / (view.name + end)).model
            ground = found.localize(np.array([[10.0, 20.0], [200.0, 250.0]]), np.array([*view.alt_range_m]))
            rpc = read_rpc(tmp_path / "a" / f"{view.name}_RPC.TXT")
            assert np.abs(rpc.project(ground) - [[10.0, 20.0], [200.0, 250.0]]).max() < 1e-3
    adjust(images, tmp_path / "a", replace(options, grids=False, tiles=None, resample=False, overwrite=True))
    left = {path.name for path in (tmp_path / "a").iterdir()}
    assert not [name for name in left if name.endswith(ENDS)]
    assert not list((tmp_path / "a").glob("*_tiles/*"))


def test_a_file_of_the_user_is_never_replaced(block, tmp_path):
    images, matches = block
    out = tmp_path / "out"
    out.mkdir()
    (out / f"{images[0].stem}{GRID}").write_text("mine")
    options = RunOptions(matches=matches, matches_only=True, overwrite=True)
    with pytest.raises(OutputError, match=r"_grid\.tif"):
        adjust(images, out, options)
    assert (out / f"{images[0].stem}{GRID}").read_text() == "mine"


@pytest.mark.slow
def test_with_grids_a_camera_that_no_rpc_holds_is_no_failure(block, tmp_path):
    """The image's RPC is given with a tolerance that no fit meets: refused without grids, and told with them."""
    images, matches = block
    options = RunOptions(matches=matches, matches_only=True, fit=FitOptions(tolerance=1e-12))
    with pytest.raises(Exception, match="wanted 1e-12"):
        adjust(images, tmp_path / "a", options)
    result = adjust(images, tmp_path / "b", replace(options, grids=True))
    assert {view.status for view in result.record.views}.isdisjoint({"failed"})


@pytest.mark.slow
def test_verbs_understand_grids(block, tmp_path):
    images, matches = block
    adjust(images, tmp_path / "a", RunOptions(matches=matches, matches_only=True, grids=True))
    name = images[0].stem
    grid, rpc = str(tmp_path / "a" / f"{name}{GRID}"), str(tmp_path / "a" / f"{name}.vrt")

    def said(*words):
        found = CliRunner().invoke(cli, [str(word) for word in words], standalone_mode=False)
        assert found.exception is None, found
        return found.return_value, found.stdout

    code, text = said("info", "--json", grid, tmp_path / "a" / f"{name}{CORRECTION}")
    assert [one["size_px"] for one in json.loads(text)] == [[256, 256], [256, 256]]
    assert [one["rpc"].split(" in ")[0] for one in json.loads(text)] == ["grid", "correction"]
    assert said("convert", grid, tmp_path / "b_RPC.TXT")[0] == 0
    assert read_rpc(tmp_path / "b_RPC.TXT").off(read_rpc(rpc)).max() < 1e-2
    code, text = said("convert", rpc, tmp_path / f"c{GRID}", "--json")
    assert (code, json.loads(text)[-1]["consumer"]) == (0, "barpc")
    assert open_camera(tmp_path / f"c{GRID}").model.lonlat.shape == open_camera(grid).model.lonlat.shape
    code, text = said("check", "--json", rpc, "--against", grid)
    assert json.loads(text)[0]["max_px"] < 1e-3
    assert said("fit", grid)[0] == 0


@pytest.mark.slow
def test_a_grid_is_the_camera_of_an_image_and_no_image(block, tmp_path):
    images, matches = block
    adjust(images, tmp_path / "a", RunOptions(matches=matches, matches_only=True, grids=True))
    for end in (GRID, CORRECTION):
        given = [f"{path},camera={tmp_path / 'a' / (path.stem + end)}" for path in images]
        found = check(given, RunOptions(matches=matches, matches_only=True))
        assert found.record.views[0].rmse_before < 0.5
        with pytest.raises(ImageError, match="a grid and no image"):
            check([str(tmp_path / "a" / (images[0].stem + end)), images[1]])


def test_a_grid_that_no_rpc_holds_is_not_converted(tmp_path, view, camera, fit):
    run_of(tmp_path / "out", (view, fit, camera))
    path = tmp_path / "out" / f"a{GRID}"
    found = CliRunner().invoke(
        cli, ["convert", str(path), str(tmp_path / "a_RPC.TXT")], standalone_mode=False
    )
    assert str(path) in str(found.exception)
    assert "wanted 0.01" in str(found.exception)
    assert not (tmp_path / "a_RPC.TXT").exists()
