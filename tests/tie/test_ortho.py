"""Images and orthoimages on a grid on the ground: where its pixels lie, what they show, and what they do not know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rasterio import Affine

from barpc.base.errors import InputError
from barpc.base.geodesy import metres_per_unit
from barpc.tie.patches.channels import Patch, Sheet, of_image, of_reference, picture, picture_share, ticks
from tests.geotiffs import write_image

from .test_pairs import camera, views

HERE = np.array([5.4, 43.3])
METRES = metres_per_unit(np.array([5.4, 43.3, 0.0]))[:2]


def hill(lon, lat):
    return 100.0 + 1e4 * (lon - 5.4) - 2e4 * (lat - 43.3)


@pytest.mark.parametrize(
    ("count", "nodes"),
    [(2, [0, 1]), (9, [0, 8]), (10, [0, 4.5, 9]), (17, [0, 8, 16]), (18, [0, 17 / 3, 34 / 3, 17])],
)
def test_nodes_are_no_more_than_eight_pixels_apart_from_the_first_pixel_to_the_last(count, nodes) -> None:
    np.testing.assert_allclose(ticks(count), nodes)


def test_a_patch_goes_east_and_south_in_metres_and_has_the_heights_of_the_terrain() -> None:
    patch = Patch.on(hill, HERE, 2.0, (18, 9), np.zeros(2))
    nodes = patch.nodes()
    assert nodes.shape == (4, 2, 2)
    np.testing.assert_array_equal(nodes[0, 0], HERE)
    np.testing.assert_allclose((nodes[-1, -1] - HERE) * METRES, [2.0 * 8, -2.0 * 17], rtol=1e-9)
    np.testing.assert_allclose((nodes[0, -1] - HERE) * METRES, [2.0 * 8, 0.0], atol=1e-9)
    np.testing.assert_allclose(patch.heights, hill(nodes[..., 0], nodes[..., 1]))


def test_a_camera_that_is_off_shows_a_patch_beside_its_place() -> None:
    (view,) = views(camera(5.4, 43.3, lean=0.3))
    patch = Patch.on(hill, HERE, 2.0, (20, 30), np.array([7.0, -4.0]))
    nodes = patch.nodes()
    ground = np.concatenate([nodes + np.array([7.0, -4.0]) / METRES, patch.heights[..., None]], axis=-1)
    np.testing.assert_allclose(patch.image(view), view.sensor.project(ground), atol=1e-9)
    at = np.array([[0.0, 0.0], [29.0, 19.0], [3.25, 17.5], [11.0, 2.0]])
    lonlat = HERE + at * [2.0, -2.0] / METRES
    place = np.column_stack([lonlat + np.array([7.0, -4.0]) / METRES, hill(*lonlat.T)])
    np.testing.assert_allclose(patch.seen(view, at), view.sensor.project(place), atol=1e-6)


# --- orthoimages --------------------------------------------------------------------------------------------


def sheet(path, data: np.ndarray, step: float = 1e-5, corner: tuple[float, float] = (5.4, 43.3)) -> str:
    """An orthoimage whose pixels are `step` degrees a side, from its outer corner on."""
    place = Affine(step, 0, corner[0], 0, -step, corner[1])
    return str(write_image(path, data, crs="EPSG:4326", transform=place, nodata=0))


@pytest.fixture
def square(tmp_path) -> Sheet:
    return Sheet.read(sheet(tmp_path / "square.tif", np.ones((40, 60), np.uint16)))


def test_a_pixel_of_an_orthoimage_lies_where_its_middle_is(square) -> None:
    at = np.array([[[0.0, 0.0], [59.0, 39.0]], [[10.25, 7.5], [-3.0, 50.0]]])
    lonlat = HERE + (at + 0.5) * [1e-5, -1e-5]
    np.testing.assert_allclose(square.image(lonlat), at, atol=1e-6)


def test_an_orthoimage_shows_what_lies_between_the_middles_of_its_outer_pixels(square) -> None:
    at = np.array([[0.001, 0.001], [58.999, 38.999], [-0.001, 20], [20, -0.001], [59.001, 20], [20, 39.001]])
    assert square.shows(HERE + (at + 0.5) * [1e-5, -1e-5]).tolist() == [True, True] + [False] * 4


def test_an_orthoimages_step_is_the_side_of_a_square_as_large_as_its_pixel(square) -> None:
    assert square.step(HERE) == pytest.approx(1e-5 * np.sqrt(METRES.prod()), rel=1e-4)


@pytest.mark.parametrize(("count", "bands"), [(1, (1,)), (2, (1,)), (3, (1, 2, 3)), (4, (1, 2, 3))])
def test_three_bands_are_seen_together_and_of_two_the_first(tmp_path, count, bands) -> None:
    path = sheet(tmp_path / "a.tif", np.ones((count, 8, 9), np.uint8))
    assert Sheet.read(path).bands == bands
    assert Sheet.read(path).size == (9, 8)


@pytest.mark.parametrize("place", [{}, {"crs": "EPSG:4326", "transform": Affine(1e-5, 0, 5, 0, 0, 43)}], ids=str)
def test_a_raster_without_a_crs_or_an_extent_is_refused(tmp_path, place) -> None:
    path = write_image(tmp_path / "a.tif", np.ones((8, 9), np.uint8), **place)
    with pytest.raises(InputError, match=r"a\.tif: a reference is an orthoimage"):
        Sheet.read(str(path))


# --- pictures -----------------------------------------------------------------------------------------------

SIZE = 160, 120
RAMP = (1000.0 + 3.0 * np.arange(160) + 5.0 * np.arange(120)[:, None]).astype(np.uint16)


def grid(first: tuple[float, float], step: float, shape: tuple[int, int]) -> np.ndarray:
    """Nodes of a grid whose pixels lie `step` px apart in the raster, from `first` on."""
    x, y = (start + step * ticks(n) for start, n in zip(first, shape[::-1], strict=True))
    return np.stack(np.meshgrid(x, y), axis=-1)


@pytest.mark.parametrize(
    ("first", "step", "shape"),
    [((10.0, 8.0), 1.0, (30, 40)), ((10.25, 8.5), 1.0, (30, 40)), ((11.3, 9.1), 1.9, (20, 30)),
     ((12.0, 12.0), 2.0, (20, 30)), ((14.2, 15.7), 3.7, (20, 18)), ((150.0, 110.0), -1.0, (40, 30))],
)  # fmt: skip
def test_a_slope_is_a_slope_however_coarse_the_grid_on_which_it_is_seen(tmp_path, first, step, shape) -> None:
    path = str(write_image(tmp_path / "a.tif", RAMP))
    found, valid = picture(path, (1,), SIZE, grid(first, step, shape), shape)
    assert valid.all()
    x, y = first[0] + step * np.arange(shape[1]), first[1] + step * np.arange(shape[0])[:, None]
    # cubic convolution as OpenCV has it loses a thirtieth of a pixel of a slope
    np.testing.assert_allclose(found, 1000.0 + 3.0 * x + 5.0 * y, atol=0.4 * abs(step))


def test_bands_count_alike_and_where_one_is_unknown_nothing_is_known(tmp_path) -> None:
    bands = np.stack([RAMP, 2 * RAMP, 7000 - RAMP])
    bands[1, 40:60, 50:70] = 0
    path, nodes = str(write_image(tmp_path / "a.tif", bands, nodata=0)), grid((20.0, 20.0), 1.0, (60, 90))
    found, valid = picture(path, (1, 3), SIZE, nodes, (60, 90))
    assert valid.all()
    assert np.ptp(found) < 0.002 * found.mean()  # what one grows by the other shrinks by
    _, valid = picture(path, (1, 2), SIZE, nodes, (60, 90))
    expected = np.ones((60, 90), bool)
    expected[20:40, 30:50] = False
    np.testing.assert_array_equal(valid, expected)


@pytest.mark.parametrize(
    ("step", "known"),
    [(1.0, (0, 30)), (2.0, (0, 15))],
)
def test_beside_a_raster_nothing_is_known(tmp_path, step, known) -> None:
    path = str(write_image(tmp_path / "a.tif", RAMP))
    _, valid = picture(path, (1,), SIZE, grid((130.0 if step == 1.0 else 130.5, 20.0), step, (20, 60)), (20, 60))
    assert valid[:, known[0] : known[1]].all()
    assert not valid[:, known[1] :].any()


@pytest.mark.parametrize("first", [(-60.0, 20.0), (20.0, -60.0), (161.0, 20.0), (20.0, 121.0), (np.nan, 20.0)])
def test_a_grid_beside_a_raster_or_of_no_place_shows_nothing(tmp_path, first) -> None:
    path = str(write_image(tmp_path / "a.tif", RAMP))
    found, valid = picture(path, (1,), SIZE, grid(first, 1.0, (30, 40)), (30, 40))
    assert found.shape == valid.shape == (30, 40)
    assert not found.any()
    assert not valid.any()


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(("first", "shown"), [(-39.0, 39), (SIZE[0] - 1.0, 0)])
def test_a_grid_that_only_reaches_the_outermost_pixels_shows_these(tmp_path, first, shown, turned) -> None:
    """By its last column the raster's first, or by its first the raster's last; and rows alike."""
    path = str(write_image(tmp_path / "a.tif", RAMP.T if turned else RAMP))
    nodes = grid((first, 20.0), 1.0, (30, 40))
    nodes, size = (nodes.swapaxes(0, 1)[..., ::-1], SIZE[::-1]) if turned else (nodes, SIZE)
    found, valid = picture(path, (1,), size, nodes, (40, 30) if turned else (30, 40))
    found, valid = (found.T, valid.T) if turned else (found, valid)
    np.testing.assert_array_equal(np.flatnonzero(valid.all(axis=0)), [shown])
    assert not np.delete(valid, shown, axis=1).any()
    np.testing.assert_allclose(found[:, shown], RAMP[20:50, 0 if shown else SIZE[0] - 1], atol=1.0)


def test_what_is_coarser_than_the_raster_is_averaged(tmp_path) -> None:
    """Noise of every pixel alone: of 16 of them a quarter is left, and a blur for what a whole factor leaves."""
    noise = np.random.default_rng(0).normal(2000, 200, (400, 400)).clip(1).astype(np.uint16)
    path = str(write_image(tmp_path / "a.tif", noise))
    spread = {}
    for step in (1.0, 2.0, 2.9, 4.0):
        found, _ = picture(path, (1,), (400, 400), grid((20.0, 20.0), step, (80, 80)), (80, 80))
        spread[step] = found.std() / 200
    assert spread[1.0] == pytest.approx(1.0, abs=0.05)
    assert spread[2.0] < 0.55
    assert spread[4.0] < 0.28
    assert 0.6 < spread[2.9] / (1 / 2.9) < 1.2


# --- channels of them ---------------------------------------------------------------------------------------


def textured(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(500, 1500, (120, 160)).astype(np.uint16)


def test_of_several_orthoimages_the_first_that_shows_a_place_is_seen(tmp_path) -> None:
    step = 2.0 / METRES.mean()
    first, second = textured(1), textured(2)
    first[:, 80:] = 0
    paths = [sheet(tmp_path / f"{k}.tif", data, step) for k, data in enumerate((first, second))]
    far = sheet(tmp_path / "far.tif", textured(3), step, (5.5, 43.3))
    corner = HERE + np.array([20.0, -20.0]) / METRES
    patch = Patch.on(hill, corner, 2.0, (60, 100), np.zeros(2))
    one, two, both = (of_reference(part, patch) for part in ([paths[0]], [paths[1]], [far, *paths]))
    assert both.shape == (2, 60, 100)
    west, east = np.s_[:, :, :50], np.s_[:, :, 95:]
    np.testing.assert_array_equal(both[west], one[west])
    np.testing.assert_array_equal(both[east], two[east])
    assert np.abs(both[west] - two[west]).max() > 0.1
    assert 0.4 < picture_share(one) < 0.8
    assert picture_share(both) > 0.9
    assert picture_share(of_reference([far], patch)) == 0.0


def test_an_image_on_a_patch_is_what_its_camera_sees_there(tmp_path) -> None:
    (view,) = views(camera(5.4, 43.3, lean=0.0))
    data = textured(4)
    view = replace(view, path=str(write_image(tmp_path / "a.tif", data)), size=(160, 120))
    lon, lat, _ = view.sensor.localize(np.array([[30.0, 20.0]]), np.array([100.0]))[0]
    patch = Patch.on(lambda x, y: np.full(np.shape(x), 100.0), np.array([lon, lat]), 0.5, (40, 50), np.zeros(2))
    shape = of_image(view, 1, patch)
    assert shape.shape == (2, 40, 50)
    assert picture_share(shape) == 1.0
    moved = replace(patch, lonlat=patch.lonlat - np.array([1.0, 2.0]) / METRES, moved=np.array([1.0, 2.0]))
    np.testing.assert_allclose(of_image(view, 1, moved), shape, atol=0.02)


def test_a_patch_beyond_the_terrain_shows_what_lies_where_it_is_known(tmp_path) -> None:
    (view,) = views(camera(5.4, 43.3, lean=0.0))
    view = replace(view, path=str(write_image(tmp_path / "a.tif", textured(4))), size=(160, 120))
    corner = view.sensor.localize(np.array([[30.0, 20.0]]), np.array([100.0]))[0, :2]
    at = np.array([[0.0, 0.0], [31.9, 11.0], [32.1, 11.0], [48.0, 39.0]])
    whole = Patch.on(lambda x, y: np.full(np.shape(x), 100.0), corner, 0.5, (41, 49), np.zeros(2))
    ends = corner[0] + 0.5 * 36 / METRES[0]  # between the nodes of columns 32 and 40
    part = replace(whole, heights=np.where(whole.nodes()[..., 0] > ends, np.nan, 100.0))
    seen = part.seen(view, at)
    np.testing.assert_allclose(seen[:2], whole.seen(view, at)[:2], atol=1e-9)
    assert np.isnan(seen[2:]).all()
    pixels, valid = picture(view.path, (1,), view.size, part.image(view), part.shape)
    every, all_valid = picture(view.path, (1,), view.size, whole.image(view), whole.shape)
    np.testing.assert_array_equal(valid, all_valid & (np.arange(49) <= 32))
    np.testing.assert_allclose(pixels[valid], every[valid], atol=1e-3)
    lost = replace(whole, heights=np.full_like(whole.heights, np.nan))
    assert not picture(view.path, (1,), view.size, lost.image(view), lost.shape)[1].any()
