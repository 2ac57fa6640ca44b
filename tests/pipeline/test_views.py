"""Image files to views: what each must have, which altitudes count, and one image under two names."""

from __future__ import annotations

import os
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from rasterio.windows import Window

from barpc.base.errors import DisconnectedError, ImageError, InputError, MissingRpcError, RpcError
from barpc.pipeline import RunOptions, adjust, load_views
from barpc.pipeline import loading as views
from barpc.pipeline.loading import image_path
from barpc.rpcio import write_rpc
from barpc.scene import View
from barpc.sensor.rpc import RPC
from benchmarks.real_sets import as_rasterio
from tests import geotiffs
from tests.rpcio.conftest import make_rpc

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

WIDE, HIGH = 700, 90


def placed(folder: Path, name: str, pixels: np.ndarray, shift: float = 0.0, **profile: object) -> Path:
    """An image of these pixels, its RPC beside it."""
    path = geotiffs.write_image(folder / f"{name}.tif", pixels, **profile)
    write_rpc(make_rpc().crop(900 + shift, 900), folder / f"{name}_RPC.TXT")
    return path


def pixels_of(seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).integers(1, 60000, (HIGH, WIDE)).astype(np.uint16)


@pytest.fixture
def pair(tmp_path: Path) -> list[Path]:
    return [placed(tmp_path, name, pixels_of(seed), seed) for seed, name in enumerate("ab")]


# --- what an image must have ------------------------------------------------------------------------------


def test_views_stand_in_the_order_of_their_names_with_size_date_and_camera(pair) -> None:
    found = load_views(pair[::-1])
    assert [view.name for view in found.views] == ["a", "b"]
    assert [Path(view.path) for view in found.views] == pair
    assert [source.path.name for source in found.sources] == ["a_RPC.TXT", "b_RPC.TXT"]
    assert {view.size for view in found.views} == {(WIDE, HIGH)}
    assert found.views[0].alt_range == pytest.approx((166.6667 - 142.8571, 166.6667 + 142.8571))
    assert (found.left_out, found.worker_seconds) == ((), 0.0)


@pytest.mark.parametrize(("count", "least", "passes"), [(0, 1, False), (1, 2, False), (1, 1, True), (2, 2, True)])
def test_as_many_images_as_are_needed(pair, count, least, passes) -> None:
    if passes:
        assert len(load_views(pair[:count], min_views=least).views) == count
        return
    said = rf"{count} images? given \({'none' if not count else '.*a.tif'}\): at least {least} that overlap"
    with pytest.raises(InputError, match=said):
        load_views(pair[:count], min_views=least)


def test_a_bad_file_is_left_out_while_enough_are_left(pair, tmp_path) -> None:
    (tmp_path / "c.tif").write_text("no image")
    given = [*pair, tmp_path / "c.tif"]
    with pytest.raises(ImageError, match=r"c\.tif"):
        load_views(given)
    found = load_views(given, keep_going=True)
    assert [path for path, _ in found.left_out] == [str(tmp_path / "c.tif")]
    assert len(found.views) == len(found.sources) == 2
    with pytest.raises(InputError, match="1 of 2 images can be used: at least 2 are needed"):
        load_views(given[1:], keep_going=True)
    assert len(load_views(given[1:], keep_going=True, min_views=1).views) == 1


def test_an_image_without_an_rpc_is_told_how_to_get_one_or_be_left_out(pair, tmp_path) -> None:
    plain = geotiffs.write_image(tmp_path / "plain.tif", pixels_of())
    with pytest.raises(MissingRpcError) as told:
        load_views([*pair, plain])
    assert str(told.value).startswith(f"{plain}: no RPC in the image and none beside it")
    assert "plain.tif,camera=FILE" in str(told.value)
    assert "--keep-going" in str(told.value)
    assert isinstance(told.value, ImageError)
    found = load_views([*pair, plain], keep_going=True)
    assert [view.name for view in found.views] == ["a", "b"]
    ((path, reason),) = found.left_out
    assert path == str(plain)
    assert "--keep-going" not in reason  # it was given


@pytest.mark.parametrize(("band", "passes"), [(0, False), (1, True), (2, True), (3, False)])
def test_the_band_is_one_that_the_image_has(tmp_path, band, passes) -> None:
    path = placed(tmp_path, "a", np.stack([pixels_of(1), pixels_of(2)]))
    if passes:
        assert len(load_views([path], min_views=1, band=band).views) == 1
        return
    with pytest.raises(ImageError, match=rf"a\.tif: has 2 band\(s\), no band {band}"):
        load_views([path], min_views=1, band=band)


def test_a_view_brings_its_own_camera_altitudes_and_date_and_its_size_is_that_of_the_file(pair) -> None:
    given = View("x", str(pair[0]), (WIDE, HIGH), make_rpc(), (100.0, 400.0), "2020-01-02")
    (found,) = load_views([given], min_views=1).views
    assert (found.name, found.alt_range, found.date) == ("a", (100.0, 400.0), "2020-01-02")
    assert found.sensor == given.sensor
    with pytest.raises(InputError, match=rf"is \({WIDE}, {HIGH}\) px large, but its view says \({WIDE}, 80\)"):
        load_views([replace(given, size=(WIDE, 80))], min_views=1)


@pytest.mark.parametrize(
    ("stated", "used"),
    [
        ((0.0, 100.0), (0.0, 100.0)),
        ((10.0, 90.0), (0.0, 100.0)),  # too narrow for an RPC
        ((250.0, 250.0), (200.0, 300.0)),
        ((-3000.0, 20000.0), (-1000.0, 9500.0)),
        ((-3000.0, 40.0), (-1000.0, 40.0)),
        ((9000.0, 12000.0), (9000.0, 9500.0)),
        ((20000.0, 30000.0), (9450.0, 9550.0)),  # in space: the highest ground
        ((-30000.0, -20000.0), (-1050.0, -950.0)),
    ],
)
def test_altitudes_are_those_of_the_earth_and_a_hundred_metres_at_least(pair, stated, used) -> None:
    rpc = make_rpc()
    rpc = replace(rpc, ground_scale=rpc.ground_scale * [1.0, 1.0, 1000.0])  # it sees all of these
    given = View("a", str(pair[0]), (WIDE, HIGH), rpc, stated)
    (found,) = load_views([given], min_views=1).views
    assert found.alt_range == pytest.approx(used)


def test_an_rpc_that_does_not_reach_the_ground_is_named(pair) -> None:
    rpc = make_rpc()
    beyond = RPC(rpc.coeffs, [5.4, 43.2, 166.0], rpc.ground_scale, rpc.image_offset, rpc.image_scale)
    blind = SimpleNamespace(
        localize=lambda image, alt: np.full((*np.shape(image)[:-1], 3), np.nan), project=beyond.project
    )
    with pytest.raises(RpcError, match=rf"does not reach the ground over the image \({WIDE} x {HIGH} px\)"):
        load_views([View("a", str(pair[0]), (WIDE, HIGH), blind, (0.0, 300.0))], min_views=1)


def test_the_file_of_an_image_is_absolute_and_without_its_choices(monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    for given in ("a.tif", "a.tif,band=2", Path("a.tif"), View("x", "a.tif", (2, 2), make_rpc(), (0.0, 1.0))):
        assert image_path(given) == tmp_path / "a.tif"


# --- once and not twice -----------------------------------------------------------------------------------


def refused(paths: list[Path], what: str, **options) -> None:
    for order in (paths, paths[::-1]):
        with pytest.raises(InputError, match=rf"{what}.*; give each image once"):
            load_views(order, **options)


def test_a_file_under_two_names_is_one_image(pair, tmp_path) -> None:
    os.link(pair[0], tmp_path / "c.tif")
    write_rpc(make_rpc().crop(1, 2), tmp_path / "c_RPC.TXT")
    refused([pair[0], tmp_path / "c.tif"], r"c\.tif: is the same file as .*a\.tif")
    found = load_views([*pair, tmp_path / "c.tif"], keep_going=True)
    assert [Path(path).name for path, _ in found.left_out] == ["c.tif"]
    assert len(load_views([pair[0], tmp_path / "c.tif"], distinct=False).views) == 2


def test_one_camera_of_images_of_one_size_is_one_image(tmp_path) -> None:
    given = [placed(tmp_path, name, pixels_of(seed), 5) for seed, name in enumerate("ab")]
    refused(given, r"b\.tif: is the same size and the same RPC as .*a\.tif")
    smaller = placed(tmp_path, "c", pixels_of(3)[:-1], 5)
    assert len(load_views([given[0], smaller]).views) == 2


@pytest.mark.parametrize(
    ("kind", "how"),
    [
        (np.uint16, {"compress": "deflate", "tiled": True, "blockxsize": 64, "blockysize": 32}),
        (np.uint16, {"interleave": "pixel"}), (np.int32, {}), (np.float32, {}), (np.float64, {}), (np.complex64, {}),
    ],
)  # fmt: skip
def test_the_same_pixels_under_another_rpc_are_one_image_in_any_layout_and_type(tmp_path, kind, how) -> None:
    """Whatever its folder is."""
    first, complex_ = pixels_of(), kind is np.complex64
    one = placed(tmp_path, "a", first.astype(kind) if complex_ else first, 1)
    (tmp_path / "far").mkdir()
    twin = placed(tmp_path / "far", "z", first.astype(kind), 2, **how)
    refused([one, twin], r"z\.tif: shows the same pixels as .*a\.tif under another RPC")
    if complex_:  # both parts count
        assert len(load_views([one, placed(tmp_path, "c", first * np.complex64(1 + 1j), 3)]).views) == 2


def test_zeros_and_pixels_that_are_no_numbers_are_the_same_whatever_their_sign(tmp_path) -> None:
    given = []
    for number, sign in enumerate((1.0, -1.0)):
        shown = pixels_of().astype(np.float32)
        shown[:, :2] = np.copysign(np.array([0.0, np.nan], np.float32), sign)
        given.append(placed(tmp_path, "ab"[number], shown, number))
    refused(given, "same pixels")


def test_of_three_twins_the_first_is_kept(tmp_path) -> None:
    given = [placed(tmp_path, name, pixels_of(), shift) for shift, name in enumerate("abc")]
    found = load_views(given, keep_going=True, min_views=1)
    assert [view.name for view in found.views] == ["a"]
    assert [reason.split(": ")[1].split(" as ")[0] for _, reason in found.left_out] == ["shows the same pixels"] * 2


def test_one_pixel_makes_another_image_wherever_it_is(tmp_path) -> None:
    """Outside of the sampled windows, too: then both are read whole, each once."""
    first = placed(tmp_path, "a", pixels_of(), 1)
    for number, (row, col) in enumerate([(0, 0), (HIGH - 1, WIDE - 1), (HIGH // 2, WIDE // 2), (1, 5)]):
        changed = pixels_of()
        changed[row, col] ^= 1
        other = placed(tmp_path, f"b{number}", changed, 2 + number)
        assert len(load_views([first, other]).views) == 2


def test_images_alike_in_the_samples_are_read_whole_once_each_and_no_others(tmp_path, monkeypatch) -> None:
    read: list[str] = []
    whole = views._whole_digest
    monkeypatch.setattr(
        views, "_whole_digest", lambda image, band: (read.append(Path(image.name).stem), whole(image, band))[1]
    )
    given = []
    for number in range(4):
        changed = pixels_of()
        changed[0, number] = 0  # a corner is in no sampled window
        given.append(placed(tmp_path, f"v{number}", changed, number))
    given.append(placed(tmp_path, "w", pixels_of(7), 9))
    assert len(load_views(given).views) == 5
    assert sorted(read) == ["v0", "v1", "v2", "v3"]


def test_images_that_show_nothing_are_compared_with_none(tmp_path) -> None:
    for value in (0, 700):
        folder = tmp_path / str(value)
        folder.mkdir()
        blank = np.full((HIGH, WIDE), value, np.uint16)
        assert len(load_views([placed(folder, name, blank, n) for n, name in enumerate("abc")]).views) == 3


def test_the_band_that_is_matched_is_the_one_that_is_compared(tmp_path) -> None:
    one, two, three = pixels_of(1), pixels_of(2), pixels_of(3)
    given = [
        placed(tmp_path, "a", np.stack([one, three]), 1),
        placed(tmp_path, "b", np.stack([two, three]), 2),
    ]
    assert len(load_views(given).views) == 2
    refused(given, "same pixels", band=2)


def test_windows_lie_in_the_middle_and_at_the_quarters_and_inside_small_images() -> None:
    boxes = [(w.col_off, w.row_off, w.width, w.height) for w in views._samples(1256, 416)]
    assert boxes == [(500, 200, 256, 16), (250, 100, 256, 16), (750, 300, 256, 16)]
    assert {(w.col_off, w.row_off, w.width, w.height) for w in views._samples(50, 9)} == {(0, 0, 50, 9)}
    more = {(w.col_off, w.row_off) for w in views._samples(1256, 416, views._MORE)}
    assert more == {(200 * x, 80 * y) for x in range(6) for y in range(6)}


def test_an_image_is_hashed_in_whole_blocks_and_each_row_counts(tmp_path, monkeypatch) -> None:
    path = placed(tmp_path, "a", pixels_of(), blockysize=8)
    asked: list[tuple[float, float]] = []
    digest = views._pixel_digest

    def watched(image, band, windows):
        asked.extend((w.row_off, w.height) for w in windows)
        return digest(image, band, windows)

    monkeypatch.setattr(views, "_pixel_digest", watched)
    with views.open_raster(path) as image:
        assert views._whole_digest(image, 1) == digest(image, 1, [Window(0, 0, WIDE, HIGH)])
    assert asked == [(top, min(8, HIGH - top)) for top in range(0, HIGH, 8)]


@pytest.mark.parametrize(("group", "asked"), [(3, 0), (2, 2)])
def test_images_are_read_by_other_workers_when_they_are_more_than_a_group(pair, tmp_path, sized, group, asked) -> None:
    class Counting(ThreadPoolExecutor):
        asked = 0

        def submit(self, function, /, *given):
            self.asked += 1
            return super().submit(function, *given)

    sized(images_together=group)
    third = placed(tmp_path, "c", pixels_of(5), 7)
    with Counting(1) as pool:
        load_views([*pair, third], executor=pool)
    assert pool.asked == asked


@pytest.mark.slow
def test_an_image_that_its_rpc_is_not_for_is_left_out_and_said(corner, tmp_path) -> None:
    """Mirrored, as some readers write images: the two others are adjusted as without it."""
    mirrored = tmp_path / corner.images[1].name
    with rasterio.open(corner.images[1]) as image:
        pixels, profile, tags = image.read()[:, :, ::-1], image.profile, image.tags(ns="RPC")
    with rasterio.open(mirrored, "w", **profile) as out:
        out.write(pixels)
        out.update_tags(ns="RPC", **tags)
    images = [corner.images[0], mirrored, corner.images[2]]
    words = "shows the picture mirrored, its columns reversed, as keypoints of"
    with pytest.raises(DisconnectedError, match=f"{mirrored}: {words}"):
        adjust(images, tmp_path / "out")
    assert not (tmp_path / "out/summary.json").exists()
    result = adjust(images, tmp_path / "out", RunOptions(keep_going=True, overwrite=True))
    assert result.record.left_out[0].reason.startswith(words)
    assert result.record.status == "bad"
    alone = adjust([images[0], images[2]], tmp_path / "alone")
    assert result.tracks.xy.tolist() == alone.tracks.xy.tolist()


# --- one name a file --------------------------------------------------------------------------------------


def test_an_image_is_read_as_quickly_by_a_relative_name_and_a_link(tmp_path, monkeypatch) -> None:
    """And its camera is one file, however it is spelt: 20 MB of pixels, searched as text, would take seconds."""
    side = 3200
    noise = np.random.default_rng(5).integers(40, 123, (side, side), dtype=np.uint16) * 257  # letters
    path = placed(tmp_path, "a", noise)
    with rasterio.open(path, "r+") as file:
        file.rpcs = as_rasterio(make_rpc(), np.zeros(2))
    (tmp_path / "a_RPC.TXT").unlink()
    (tmp_path / "b.tif").symlink_to("a.tif")
    monkeypatch.chdir(tmp_path)
    for given in ("a.tif", "./a.tif", "b.tif", path, "a.tif,camera=b.tif"):
        start = time.process_time()
        found = load_views([given], min_views=1)
        assert time.process_time() - start < 0.5
        assert found.sources[0].path == Path(str(given).partition(",")[0]).absolute() or "camera" in str(given)
        assert found.sources[0].path.is_absolute()
        assert found.sources[0].sensor == ""
