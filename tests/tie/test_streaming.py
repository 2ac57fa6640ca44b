"""Large images: an even quota, keypoints by reference, blocks decoded once."""

from __future__ import annotations

import functools
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import barpc.tie.pixels as reading
from barpc.base.errors import ImageError, InputError
from barpc.base.tasks import Store, Work
from barpc.pipeline.executor import CachingExecutor
from barpc.scene import View
from barpc.tie import TieOptions, find_tracks
from barpc.tie.matchers import features
from barpc.tie.matchers.features import KeypointDensity, KeypointFiles, detect_tile, keep_tile, locate
from barpc.tie.patches.links import _usual
from barpc.tie.pixels import Survey, read_picture, survey, tiles
from barpc.workspace import Workspace
from tests.constants import Sized
from tests.geotiffs import write_image
from tests.lanes import diagonal, rest_slow
from tests.tie.stages import detect

from .conftest import altered
from .test_pairs import camera

SIDE = 1000
BLOCKS = {"tiled": True, "blockxsize": 64, "blockysize": 64, "compress": "deflate"}


@functools.cache
def quiet(noise: float, move: int = 0) -> np.ndarray:
    """A picture whose left half has a third of the contrast of the right one."""
    rng = np.random.default_rng(7)
    fine, coarse = (cv2.GaussianBlur(rng.normal(0, 1, (SIDE, SIDE)), (0, 0), s) for s in (1.2, 5.0))
    texture = 150 * fine / fine.std() + 250 * coarse / coarse.std()
    texture[:, : SIDE // 2] /= 3
    grain = np.random.default_rng(move).normal(0, noise, texture.shape)
    return (900 + np.roll(texture, (move, move), axis=(0, 1)) + grain).clip(1, 4000).astype(np.uint16)


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> list[View]:
    folder = tmp_path_factory.mktemp("quiet")
    paths = [write_image(folder / f"{k}.tif", quiet(10.0, 2 * k), **BLOCKS) for k in range(2)]
    sensors = camera(0.0, lean=0.0), camera(0.0, lean=0.1)
    each = zip(paths, sensors, strict=True)
    return [View(path.stem, str(path), (SIDE, SIDE), sensor, (0.0, 100.0)) for path, sensor in each]


def left(xy: np.ndarray) -> float:
    return float(np.mean(xy[:, 0] < SIDE / 2))


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("most", "zoom"),
    [
        (300, 4),
        pytest.param(150, 4, marks=pytest.mark.slow),
        *(pytest.param(*row, marks=pytest.mark.nightly) for row in ((900, 2), (4000, 1))),
    ],
)
def test_the_quiet_half_of_a_scene_has_its_share_however_few_keypoints_it_may_hold(
    pair, monkeypatch, sized: Sized, most: int, zoom: int
) -> None:
    """16 to 0.6 keypoints a cell of 64 px, as images of 2,000 to 13,000 px a side have; each looked at in its way."""
    monkeypatch.setattr(features, "_ZOOMS", ((np.inf, zoom),))
    sized(keypoints_per_image=most)
    options = TieOptions(tile=128)
    for found in detect(pair, options):
        assert 0.9 * most <= len(found) <= most
        assert 0.4 <= left(found.xy) <= 0.6
    tracks = find_tracks(pair, options).tracks
    assert tracks.num_points >= 0.25 * most
    assert 0.3 <= left(tracks.xy[tracks.view == 0]) <= 0.7


@pytest.mark.parametrize(("side", "zoom"), [(1000, 1), (3000, 1), (4000, 2), (13_000, 2), (15_000, 4), (40_000, 4)])
def test_larger_images_are_looked_at_in_less_detail(side: int, zoom: int, sized: Sized) -> None:
    assert KeypointDensity.of((side, side), TieOptions()).zoom == zoom
    sized(keypoints_per_image=10**7)
    assert KeypointDensity.of((side, side), TieOptions(points_per_image=10**6)).zoom <= zoom


def test_a_sigma_is_judged_beside_those_about_it() -> None:
    places = np.random.default_rng(0).uniform(0, SIDE, (2000, 2))
    sigma = np.where(places[:, 0] < 500, 0.04, 0.01)
    sigma[:20] *= 3
    inner = np.abs(places[:, 0] - 500) > 150
    np.testing.assert_array_equal(_usual(places, sigma)[inner], np.where(places[:, 0] < 500, 0.04, 0.01)[inner])
    assert _usual(places[:1], sigma[:1]).tolist() == sigma[:1].tolist()


def test_a_share_lasts_when_the_cameras_move_a_little() -> None:
    share = KeypointDensity.of((4000, 4000), TieOptions())
    assert share.within(0.9) == share.within(0.6) == share.within(1.0)
    assert share.within(0.2).density == 4 * share.density
    assert share.within(0.0).density > share.density


# --- by reference ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_caller_never_loads_keypoints(scene, monkeypatch) -> None:
    inside, load = [], KeypointFiles.load

    def watched(self: KeypointFiles, wanted=None):
        inside.append(threading.current_thread() is threading.main_thread())
        return load(self, wanted)

    monkeypatch.setattr(KeypointFiles, "load", watched)
    with ThreadPoolExecutor(1) as pool:
        find_tracks(scene.views, executor=pool)
    assert inside == [False] * 4  # to match, and to count what there was to see


def test_a_pair_reads_the_tiles_that_it_needs(pair, tmp_path, sized: Sized) -> None:
    store = Store(str(tmp_path), str(tmp_path))
    sized(keypoints_per_image=900)
    files = locate(pair[:1], TieOptions(tile=256), Work(store=store))[0]
    assert 890 < len(files) <= 900
    every, numbers = files.load()
    assert sorted(numbers) == list(range(len(files)))
    some, few = files.load(files.boxes[3:5])
    assert len(some) == len(few) == sum(files.counts[3:5])
    np.testing.assert_array_equal(some.xy, every.xy[np.isin(numbers, few)])
    assert (few >= sum(files.counts[:3])).all()
    box = files.boxes[3]
    assert (some.xy[: files.counts[3]] >= np.array(box[:2]) - 0.5).all()


@pytest.mark.parametrize("damage", rest_slow(["cut", "gone", "empty", "other"], keep=2))
def test_a_damaged_tile_is_made_again_and_a_missing_one_is_named(pair, tmp_path, damage: str) -> None:
    store, view, box = Store(str(tmp_path / "kept"), str(tmp_path)), pair[0], (0, 0, 256, 256)
    found = survey(view.path, 1)
    task = (store, "tile/a", (view.path, view.size, box, found, KeypointDensity(0.002)))
    count = keep_tile(*task)
    path = tmp_path / "kept/tile/a.npz"
    whole = path.read_bytes()
    other = np.savez(tmp_path / "b.npz", a=np.zeros(3)) or (tmp_path / "b.npz").read_bytes()
    if damage == "gone":
        path.unlink()
        with pytest.raises(InputError, match=r"a\.npz: a worker cannot read it"):
            KeypointFiles(store, (box,), ("tile/a",), (count,)).load()
    else:
        path.write_bytes({"cut": whole[:-300], "empty": b"", "other": other}[damage])
    assert [keep_tile(*task), keep_tile(*task)] == [count, count]
    assert path.read_bytes() == whole
    assert [p.name for p in tmp_path.iterdir() if p.name != "b.npz"] == ["kept"]


@pytest.mark.slow
def test_a_finished_tile_is_not_searched_again_and_its_keys_do_not_name_the_folder(
    pair, tmp_path, monkeypatch, sized: Sized
) -> None:
    """Nor for another camera or other thresholds, as a later pass has them."""
    sized(keypoints_per_image=300)
    options, keys = TieOptions(tile=256), []
    later, loose = [replace(view, sensor=view.sensor.crop(9.0, 9.0)) for view in pair], replace(options, ratio=0.7)
    for number in range(2):
        with Workspace(tmp_path / f"run{number}") as workspace, CachingExecutor(workspace, {}) as executor:
            files = locate(pair, options, Work(executor, store=executor.store))
            keys.append(executor.key(find_tracks, (files[0], files[1])))
            count = len(list(workspace.cache.rglob("*.npz")))
            with monkeypatch.context() as patch:
                patch.setattr(features, "Sift", None)
                assert locate(pair, options, Work(executor, store=executor.store)) == files
                assert locate(later, replace(loose, search=9.0), Work(executor, store=executor.store)) == files
            tiles_of = [box for of_view in files for box in of_view.boxes]
            assert len(list(workspace.cache.glob("detect_tile/*.npz"))) == len(tiles_of) == 8
            assert len(list(workspace.cache.rglob("*.npz"))) == count  # and nothing is kept twice
            assert not list(workspace.partial.glob("*"))
    assert keys[0] == keys[1]


# --- reading -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("zoom", "profile"),
    diagonal([1, 2, 4], [BLOCKS, {"blockysize": 7}, {"blockysize": 1000, "compress": "deflate"}]),
)
def test_a_picture_is_the_same_however_the_file_is_stored(tmp_path, zoom: int, profile: dict[str, object]) -> None:
    data = quiet(10.0)[:702, :801].copy()
    data[100:130, 200:260] = 0
    path = write_image(tmp_path / "a.tif", data, nodata=0, **profile)
    known = survey(path, 1)
    assert known is not None
    picture, valid = read_picture(path, (64, 64, 737, 638), known, zoom)
    assert picture.shape == valid.shape == (638 // zoom, 737 // zoom)
    hole = np.zeros((638, 737), bool)
    hole[36:66, 136:196] = True
    part = valid.shape[0] * zoom, valid.shape[1] * zoom
    each = (part[0] // zoom, zoom, part[1] // zoom, zoom)
    np.testing.assert_array_equal(valid, ~hole[: part[0], : part[1]].reshape(each).any(axis=(1, 3)))
    low, high = known.stretch.low, known.stretch.high
    stretched = ((data[64:, 64:].astype(float) - low) * 255 / (high - low)).clip(0, 255)
    mean = stretched[: part[0], : part[1]].reshape(each).mean(axis=(1, 3))
    assert np.abs(picture - mean)[valid].max() <= 1.01


@pytest.mark.parametrize(("zoom", "side"), rest_slow(pytest.param(*row) for row in ((4, 512), (4, 960), (2, 960))))
def test_the_levels_of_a_jpeg_2000_show_the_same_places(tmp_path, zoom: int, side: int) -> None:
    data = quiet(0.0)[:side, -side:]
    lossless = {"driver": "JP2OpenJPEG", "QUALITY": "100", "REVERSIBLE": "YES", "RESOLUTIONS": "4"}
    warnings.simplefilter("ignore")
    paths = [write_image(tmp_path / name, data, **how) for name, how in (("a.tif", BLOCKS), ("a.jp2", lossless))]
    found = [survey(path, 1) for path in paths]
    assert [known and known.levels for known in found] == [False, True]
    share = KeypointDensity(1.0, zoom)
    at = [detect_tile(str(p), (side, side), (0, 0, side, side), f, share) for p, f in zip(paths, found, strict=True)]  # type: ignore[arg-type]
    apart = at[0].xy[:, None] - at[1].xy
    near = np.hypot(*apart.T).T
    mutual = [(i, j) for i, j in enumerate(near.argmin(axis=1)) if near[i, j] < zoom]
    offset = np.median([apart[i, j] for i, j in mutual], axis=0)
    assert len(mutual) > 0.5 * len(at[0])
    assert np.abs(offset).max() < 0.1 * zoom


@pytest.mark.parametrize(("side", "resolutions", "levels"), [(1024, 5, True), (512, 3, True), (512, 2, False)])
def test_a_jpeg_2000_has_levels_where_every_second_and_fourth_pixel_are_stored(tmp_path, side, resolutions, levels):
    warnings.simplefilter("ignore")
    ramp = np.tile(np.arange(side, dtype=np.uint8), (side, 1))
    found = survey(write_image(tmp_path / "a.jp2", ramp, driver="JP2OpenJPEG", RESOLUTIONS=resolutions), 1)
    assert found is not None
    assert found.levels == levels


def decoded(log: list[tuple[int, str, tuple[int, int], tuple[int, int, int, int], int]]) -> dict[str, float]:
    """Blocks decoded for the windows of a log over those of the file: GDAL keeps them while it is open."""
    blocks = {
        (number, path, zoom, c, r)
        for number, path, (height, width), (col, row, wide, high), zoom in log
        for c in range(col // width, (col + wide - 1) // width + 1)
        for r in range(row // height, (row + high - 1) // height + 1)
    }
    shapes = {path: shape for _, path, shape, _, _ in log}
    whole = {path: -(-SIDE // shape[0]) * -(-SIDE // shape[1]) for path, shape in shapes.items()}
    return {path: sum(1 / zoom**2 for _, p, zoom, _, _ in blocks if p == path) / n for path, n in whole.items()}


@pytest.mark.parametrize(
    ("layout", "zoom", "surveyed", "found"),
    [
        ({"tiled": True, "blockxsize": 64, "blockysize": 64}, 2, 0.8, 1.6),
        pytest.param({"tiled": True, "blockxsize": 64, "blockysize": 64}, 1, 0.8, 1.6, marks=pytest.mark.nightly),
        pytest.param({"blockysize": 8, "compress": "deflate"}, 1, 0.75, 1.15, marks=pytest.mark.nightly),
        pytest.param(
            {"driver": "JP2OpenJPEG", "BLOCKXSIZE": 256, "BLOCKYSIZE": 256, "RESOLUTIONS": 4},
            1,
            0.07,
            1.0,
            marks=pytest.mark.slow,
        ),
    ],
)
def test_blocks_are_decoded_once_a_stage(pair, tmp_path, monkeypatch, layout, zoom, surveyed, found) -> None:
    """But for those in the margins; of JPEG 2000 the survey looks at every fourth pixel."""
    warnings.simplefilter("ignore")
    views, options = [altered(view, tmp_path, lambda d: d, **layout) for view in pair], TieOptions(tile=512)
    log: list[Any] = []
    opened: list[str] = []
    read, start = reading._RasterBand.read, reading.open_raster
    monkeypatch.setattr(reading, "open_raster", lambda path: opened.append(str(path)) or start(path))

    def noted(band, box, zoom=1):
        log.append((len(opened), band.dataset.name, band.dataset.block_shapes[0], box, zoom))
        return read(band, box, zoom)

    monkeypatch.setattr(reading._RasterBand, "read", noted)
    known = survey(views[0].path, 1)
    assert known is not None
    assert 0.0 < decoded(log)[views[0].path] <= surveyed
    log.clear()
    for box in tiles((SIDE, SIDE), options.tile, zoom, known):
        detect_tile(views[0].path, (SIDE, SIDE), box, known, KeypointDensity(0.004, zoom, options.tile))
    assert 0.99 <= decoded(log)[views[0].path] <= found
    if zoom > 1:  # enough for the fast lane
        return
    assert find_tracks(views, options).tracks.num_points > 500
    registered = [entry for entry in log if entry[0] == len(opened)]  # both files were opened before any was read
    assert len(registered) == 8  # windows: four tiles of either
    assert all(0.9 <= share <= 1.0 for share in decoded(registered).values())


@pytest.mark.parametrize(
    ("size", "zoom", "found", "widths", "heights"),
    [
        ((9000, 3000), 1, Survey(None, (9000, 8), False), {9000}, {1024, 952}),  # type: ignore[arg-type]
        ((900, 3000), 1, Survey(None, (900, 8), False), {900}, {1024, 952}),  # type: ignore[arg-type]
        ((9000, 3000), 1, Survey(None, (512, 512), False), {1024, 808}, {1024, 952}),  # type: ignore[arg-type]
        ((4000, 3000), 1, Survey(None, (4000, 8), False), {4000}, {1024, 952}),  # type: ignore[arg-type]
        ((9000, 9000), 2, Survey(None, (1024, 1024), True), {4096, 808}, {4096, 808}),  # type: ignore[arg-type]
        ((9000, 9000), 1, Survey(None, (640, 640), True), {1280, 40}, {1280, 40}),  # type: ignore[arg-type]
    ],
)  # fmt: skip
def test_tiles_are_whole_strips_and_whole_blocks_where_decoding_is_dear(size, zoom, found, widths, heights) -> None:
    boxes = tiles(size, TieOptions().tile, zoom, found)
    assert {w for _, _, w, _ in boxes} == widths
    assert {h for _, _, _, h in boxes} == heights
    assert sum(w * h for _, _, w, h in boxes) == size[0] * size[1]


def test_the_store_goes_with_the_run_folder(tmp_path) -> None:
    with Workspace(tmp_path / "run") as workspace, CachingExecutor(workspace, {}) as executor:
        assert Path(executor.store.folder) == workspace.cache
        assert Path(executor.store.room) == workspace.partial


def test_a_block_that_two_windows_share_is_decoded_once(tmp_path) -> None:
    """The pixels are gone from the file when the second window asks for them."""
    path = write_image(tmp_path / "a.tif", quiet(10.0), **BLOCKS)
    with reading.PixelReader(path, 1) as reader:
        before = reader.read((10, 10, 600, 600))[0]
        with path.open("r+b") as file:
            file.write(bytes(path.stat().st_size))
        np.testing.assert_array_equal(reader.read((100, 200, 300, 400))[0], before[190:590, 90:390])
    with pytest.raises(ImageError):
        reading.read_pixels(path, (100, 200, 300, 400), 1)
