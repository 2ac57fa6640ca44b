"""Keypoints: tiles join without a seam, cells hold their quota, empty images hold none."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from barpc.base.tasks import Work, store_of
from barpc.scene import View
from barpc.tie import TieOptions
from barpc.tie.matchers.features import KeypointDensity, KeypointFiles, _an_octave_up, detect_tile, locate
from barpc.tie.pairing.overlaps import Pair
from barpc.tie.pixels import survey
from tests.constants import Sized, chosen
from tests.geotiffs import write_image
from tests.tie.stages import detect
from tests.tie.test_pairs import camera


@pytest.fixture(scope="module")
def texture() -> np.ndarray:
    noise = np.random.default_rng(5).uniform(100, 3000, (400, 500)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 2.0).astype(np.uint16)


def view(path, size=(500, 400)) -> View:
    return View("a", str(path), size, None, (0.0, 1.0))  # type: ignore[arg-type]


def test_no_cell_holds_more_than_its_quota(tmp_path, texture) -> None:
    path = write_image(tmp_path / "a.tif", texture)
    with chosen(TieOptions, keypoints_per_cell=5) as options:
        found = detect([view(path)], options)[0]
    cells = np.floor((found.xy + 0.5) / 64).astype(int)
    assert np.unique(cells, axis=0, return_counts=True)[1].max() == 5


def test_the_bound_on_an_image_thins_all_cells_alike(tmp_path, texture, sized: Sized) -> None:
    path = write_image(tmp_path / "a.tif", texture)
    sized(keypoints_per_image=300)
    found = detect([view(path)])[0]
    assert 150 <= len(found) <= 300
    counts = np.unique(np.floor((found.xy + 0.5) / 64).astype(int), axis=0, return_counts=True)[1]
    assert counts.max() <= 8


def test_keypoints_stay_as_far_from_every_border_as_they_reach_and_no_farther(tmp_path, texture) -> None:
    found = detect([view(write_image(tmp_path / "a.tif", texture))])[0]
    for away in (*found.xy.T, *([499, 399] - found.xy).T):
        assert (away + 1.0 > np.maximum(3.0, found.scale)).all()
        assert (away < 8.0).sum() > 3


@pytest.mark.parametrize("wide", [True, False])
def test_keypoints_stay_away_from_nodata_at_the_far_end_of_a_strip(tmp_path, texture, wide: bool) -> None:
    """A hole of ten pixels by a hundred beyond the length of the other side, in a strip across and in one along."""
    holed = texture[:200].copy()
    holed[50:150, 400:410] = 9
    holed = holed if wide else np.ascontiguousarray(holed.T)
    path = write_image(tmp_path / "a.tif", holed, nodata=9)
    found = detect([view(path, holed.shape[::-1])])[0]
    xy = found.xy if wide else found.xy[:, ::-1]
    away = np.hypot(*np.maximum(np.abs(xy - [404.5, 99.5]) - [4.5, 49.5], 0.0).T)
    assert (away >= np.maximum(3.0, found.scale) - 1.0).all()
    assert (away < 12.0).sum() > 5  # and not farther than need be
    free = np.abs(xy[:, 0] - 200) < 50
    assert free.sum() > 50


@pytest.mark.parametrize("data", [np.zeros((400, 500), np.uint16), np.full((400, 500), np.nan, np.float32)])
def test_an_image_without_content_has_no_keypoints(tmp_path, data: np.ndarray) -> None:
    found = detect([view(write_image(tmp_path / "a.tif", data))])[0]
    assert len(found) == 0
    assert found.descriptors.shape == (0, 128)


def test_views_of_one_name_keep_their_own_keypoints(tmp_path, texture) -> None:
    part = np.ascontiguousarray(texture[:200, :200])
    one = view(write_image(tmp_path / "a.tif", part), (200, 200))
    other = replace(one, path=str(write_image(tmp_path / "b.tif", np.flipud(part).copy())))
    alone = [detect([v])[0] for v in (one, other)]
    for found, expected in zip(detect([one, other]), alone, strict=True):
        np.testing.assert_array_equal(found.xy, expected.xy)


def test_every_view_has_the_files_of_its_own_tiles(tmp_path, texture) -> None:
    """Of two views of two tiles and one; a coarse look's have names of their own."""
    sizes = {"a": (100, 200), "b": (100, 120)}
    views = [
        view(write_image(tmp_path / f"{name}.tif", np.ascontiguousarray(texture[: size[1], : size[0]])), size)
        for name, size in sizes.items()
    ]
    options, alone = TieOptions(tile=128), []
    for one in views:
        with store_of(None) as store:
            alone.append(locate([one], options, Work(store=store))[0].load()[0].xy)
    with store_of(None) as store:
        both = locate(views, options, Work(store=store))
        coarse = locate(views, options, Work(store=store), coarse=True)
        assert [found.boxes for found in both] == [((0, 0, 100, 128), (0, 128, 100, 72)), ((0, 0, 100, 120),)]
        assert [len(found.names) for found in both] == [len(found.counts) for found in both] == [2, 1]
        for found, xy in zip(both, alone, strict=True):
            assert len(found) == len(xy) > 0
            np.testing.assert_array_equal(found.load()[0].xy, xy)
        assert [name for found in coarse for name in found.names if not name.endswith("-coarse")] == []


def test_cells_hold_more_where_less_of_an_image_is_looked_at(tmp_path, texture, sized: Sized) -> None:
    """Keypoints wanted of an image are those of its part that is read: of under a half, twice as many a pixel."""
    sized(keypoints_per_image=40)
    path = str(write_image(tmp_path / "a.tif", np.ascontiguousarray(texture[:, :300])))
    one, north = (
        View(name, path, (300, 400), camera(0.0).crop(0.0, top), (0.0, 200.0)) for name, top in (("a", 0), ("b", -320))
    )
    options, first = TieOptions(tile=150, search=10.0), (0, 0, 300, 192)
    for pairs, count in ((None, 18), ([Pair((0, 1), 0.2, 0.0)], 38)):
        with store_of(None) as store:
            found = locate([one, north], options, Work(store=store), pairs=pairs)[0]
        assert (found.boxes[0], found.counts[0]) == (first, count)
        assert len(found.boxes) == (1 if pairs else 3)


# --- how many, and how closely an image is looked at ---------------------------------------------------------


@pytest.mark.parametrize(
    ("keypoints", "points", "tile", "zoom"),
    [
        (31_990, 10_000, 512, 2), (32_010, 10_000, 512, 1),  # 2000e-6 a pixel
        (1990, 10_000, 512, 4), (2010, 10_000, 512, 2),  # 125e-6
        (90_000, 6398, 512, 2), (90_000, 6402, 512, 1),  # five keypoints for a tie point
        (1990, 10_000, 999, 4), (1990, 10_000, 1000, 2),  # an image of more than four tiles a side
        (1990, 10_000, 2000, 1),
    ],
)  # fmt: skip
def test_an_image_is_looked_at_as_closely_as_the_keypoints_wanted_ask_for(
    keypoints, points, tile, zoom, sized: Sized
) -> None:
    sized(keypoints_per_image=keypoints)
    options = TieOptions(points_per_image=points, tile=tile)
    share = KeypointDensity.of((4000, 4000), options)
    assert share.zoom == zoom
    assert share.density == keypoints / 16e6
    sized(keypoints_per_image=10 * keypoints)
    assert KeypointDensity.of((4000, 40_000), options).zoom in (zoom, 1, 2)


def test_a_box_may_hold_its_share() -> None:
    assert KeypointDensity(0.001).most((7, 9, 100, 50)) == 5
    assert KeypointDensity(0.001).most((7, 9, 100, 61)) == 6


@pytest.mark.parametrize(("side", "cell"), [(10.0, 64), (95.0, 64), (97.0, 128), (159.0, 128), (161.0, 192)])
def test_cells_hold_about_a_keypoint_and_are_whole_multiples(side, cell) -> None:
    assert KeypointDensity(1.0 / side**2).cell == cell


def test_the_strongest_of_files_are_the_same_share_of_every_tile() -> None:
    files = KeypointFiles(None, ((0, 0, 9, 9),) * 4, ("a",) * 4, (100, 50, 1, 0))  # type: ignore[arg-type]
    assert files.strongest(30).counts == (20, 10, 1, 0)
    assert files.strongest(151).counts == files.strongest(1000).counts == (100, 50, 1, 0)
    assert len(KeypointFiles(None).strongest(5)) == 0  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("octave", "up"),
    [
        (0x0001FF, 0x000000),
        (0x0003FF, 0x000000),
        (0x000100, 0x000001),
        (0x000305, 0x000006),
        (0x7A0402, 0x7A0103),
    ],
)
def test_a_keypoint_is_described_an_octave_up(octave, up) -> None:
    assert _an_octave_up(SimpleNamespace(octave=octave)).octave == up


@pytest.mark.parametrize("zoom", [1, 2, 4])
def test_a_spot_is_found_where_it_stands_however_closely_it_is_looked_at(tmp_path, zoom) -> None:
    row, col = np.mgrid[:400, :480]
    spots = np.array([[101.3, 80.6], [240.0, 200.5], [120.4, 310.9]])
    picture = sum(np.exp(-0.5 * ((col - x) ** 2 + (row - y) ** 2) / (4.0 * zoom) ** 2) for x, y in spots)
    path = write_image(tmp_path / "a.tif", (100 + 2000 * np.asarray(picture)).astype(np.uint16))
    known = survey(path, 1)
    assert known is not None
    found = detect_tile(str(path), (480, 400), (0, 0, 480, 400), known, KeypointDensity(0.1, zoom))
    near = np.abs(found.xy[:, None] - spots).max(axis=2)
    assert (near.min(axis=0) < 0.3 * zoom).all()  # a quarter of it is OpenCV's own
    scale = found.scale[near.argmin(axis=0)]
    np.testing.assert_allclose(scale, scale.mean(), rtol=0.2)
    assert 6.0 * zoom < scale.mean() < 16.0 * zoom


@pytest.mark.parametrize(("share", "least", "most"), [(0.02, 0, 0), (0.045, 12, 36)])
def test_spots_of_a_twentieth_of_the_span_of_grey_values_are_enough(tmp_path, share, least, most) -> None:
    """Fainter ones are what noise makes."""
    row, col = np.mgrid[:400, :480]
    places = np.stack(np.meshgrid(60.0 * np.arange(6) + 50, 60.0 * np.arange(6) + 50), axis=-1).reshape(-1, 2)
    spots = places + np.random.default_rng(2).uniform(-3, 3, places.shape)
    picture = sum(np.exp(-0.5 * ((col - x) ** 2 + (row - y) ** 2) / 4.0**2) for x, y in spots)
    path = write_image(tmp_path / "a.tif", (100 + 20000 * (share * picture + (col > 420))).astype(np.uint16))
    known = survey(path, 1)
    assert known is not None
    found = detect_tile(str(path), (480, 400), (0, 0, 480, 400), known, KeypointDensity(0.1, 1))
    near = np.abs(found.xy[:, None] - spots).max(axis=2) < 1.0
    assert least <= near.any(axis=0).sum() <= most


def test_a_box_looked_at_in_parts_has_the_keypoints_that_the_whole_has_there(tmp_path, texture) -> None:
    path, box, size = write_image(tmp_path / "a.tif", texture), (64, 128, 384, 256), (500, 400)
    known = survey(path, 1)
    assert known is not None
    boxes, sides = [(0, 0, *size), box, box], [512, 512, 128]
    whole, once, parts = (
        detect_tile(str(path), size, each, known, KeypointDensity(1.0, 1, side))
        for each, side in zip(boxes, sides, strict=True)
    )
    first, last = np.array(box[:2]) - 0.5, np.add(box[:2], box[2:]) - 0.5
    there = ((whole.xy >= first) & (whole.xy < last)).all(axis=1) & (whole.scale < 12)
    wanted = {tuple(xy) for xy in np.round(whole.xy[there], 1)}
    assert len(wanted) > 300
    for found in (once, parts):
        assert ((found.xy >= first) & (found.xy < last)).all()
        assert len(np.unique(np.column_stack([found.xy, found.angle]), axis=0)) == len(found)
        seen = {tuple(xy) for xy in np.round(found.xy[found.scale < 12], 1)}
        assert len(wanted & seen) > 0.97 * len(wanted | seen)
