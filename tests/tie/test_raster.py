"""Reading windows: what counts as a valid pixel, and how numbers become an 8-bit picture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import rasterio

from barpc.base.errors import ImageError
from barpc.tie.pixels import Stretch, grow, jpeg, levelled, read_pixels, sample_stretch, thumbnail
from tests.geotiffs import write_image
from tests.rasters.test_vrt import band, rects, source, vrt

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float32", "float64"])
def test_every_real_type_is_read_and_stretched_over_the_whole_range(tmp_path, dtype: str) -> None:
    data = RNG.integers(10, 120, (300, 200)).astype(dtype)
    path = write_image(tmp_path / "a.tif", data)
    pixels, valid = read_pixels(path, (5, 7, 50, 60), 1)
    assert valid.all()
    np.testing.assert_array_equal(pixels, data[7:67, 5:55])
    stretch = sample_stretch(path, 1)
    assert stretch is not None
    picture = stretch.apply(pixels, valid)
    assert picture.min() < 15
    assert picture.max() > 240


@pytest.mark.few(4)
@pytest.mark.parametrize(
    ("dtype", "ratio", "offset"),
    [
        ("float64", 1e30, 0.0),
        ("float64", 1e300, 0.0),
        ("float64", 1e-300, 0.0),
        ("float64", 1e-6, -1e3),
        ("float32", 1e34, 0.0),
        ("float32", 1e-30, 0.0),
        ("int32", 1, 2e9),
        ("uint32", 1, 4e9),
        ("int64", 10**9, 0),
        ("int16", 1, -20000),
    ],
)
def test_neither_the_picture_nor_the_registration_sees_scale_and_offset(tmp_path, dtype, ratio, offset) -> None:
    data = RNG.integers(10, 1000, (120, 90))
    plain = write_image(tmp_path / "plain.tif", data.astype(np.uint16))
    scaled = write_image(tmp_path / "scaled.tif", (data * ratio + offset).astype(dtype))
    seen = []
    for path in (plain, scaled):
        stretch = sample_stretch(path, 1)
        assert stretch is not None
        pixels, valid = read_pixels(path, (0, 0, 90, 120), 1)
        assert valid.all()
        patch = levelled(pixels, valid)
        assert patch.dtype == np.float32
        seen.append((stretch.apply(pixels, valid).astype(int), (patch - patch.mean()) / patch.std()))
    assert np.abs(seen[0][0] - seen[1][0]).max() <= 1
    np.testing.assert_allclose(seen[1][1], seen[0][1], rtol=0, atol=2e-5)


def test_a_hot_pixel_does_not_drown_the_others(tmp_path) -> None:
    data = RNG.uniform(10, 1000, (60, 60))
    data[30, 30] = 1e300
    pixels, valid = read_pixels(write_image(tmp_path / "a.tif", data), (0, 0, 60, 60), 1)
    patch = levelled(pixels, valid)
    assert np.isfinite(patch).all()
    assert np.corrcoef(patch[:29].ravel(), data[:29].ravel())[0, 1] > 1 - 1e-9


def test_the_scale_of_a_window_is_that_of_all_its_pixels() -> None:
    """Of every other column, as of a detector with two gains, too."""
    data = np.tile([1.0, 1.0, 1.0, 1000.0], (50, 20)) * RNG.uniform(0.9, 1.1, (50, 80))
    for pixels in (data, data[:, ::-1]):
        patch = levelled(pixels, np.ones(pixels.shape, bool))
        assert 0.95 * 255.0 < patch.max() < 1.05 * 255.0
        assert -50.0 < patch.min() < 0.0


def test_complex_pixels_are_refused_with_advice(tmp_path) -> None:
    path = write_image(tmp_path / "slc.tif", np.ones((64, 64), np.complex64))
    with pytest.raises(ImageError, match=r"slc\.tif: band 1 is complex; give its amplitude"):
        sample_stretch(path, 1)


def test_a_band_that_does_not_exist_is_refused(tmp_path) -> None:
    path = write_image(tmp_path / "a.tif", np.ones((2, 64, 64), np.uint8))
    with pytest.raises(ImageError, match="no band 3, only 2"):
        read_pixels(path, (0, 0, 8, 8), band=3)


def test_the_band_that_is_asked_for_is_read(tmp_path) -> None:
    data = RNG.integers(1, 200, (3, 40, 40)).astype(np.uint8)
    path = write_image(tmp_path / "a.tif", data)
    np.testing.assert_array_equal(read_pixels(path, (0, 0, 40, 40), band=2)[0], data[1])


def test_nodata_nan_saturated_and_zero_borders_are_invalid_but_a_lone_zero_is_not(tmp_path) -> None:
    data = RNG.uniform(1, 100, (60, 60)).astype(np.float32)
    data[0, 0], data[1, 1], data[2, 2] = np.nan, np.inf, -9999
    _, valid = read_pixels(write_image(tmp_path / "float.tif", data, nodata=-9999), (0, 0, 60, 60), 1)
    assert np.flatnonzero(~valid).tolist() == [0, 61, 122]
    whole = np.full((60, 60), 7, np.uint16)
    whole[:, :5], whole[20:25, 20:25], whole[50, 50] = 0, 0, 65535
    whole[40:44, 40:44], whole[30, 30] = 0, 0  # under five pixels: dark ones
    _, valid = read_pixels(write_image(tmp_path / "whole.tif", whole), (0, 0, 60, 60), 1)
    expected = np.ones((60, 60), bool)
    expected[:, :5] = expected[20:25, 20:25] = expected[50, 50] = False
    np.testing.assert_array_equal(valid, expected)


@pytest.mark.parametrize(
    ("value", "dtype"),
    [(0, "uint16"), (7, "uint16"), (65535, "uint16"), (7e40, "float64"), (np.nan, "float32")],
)
def test_a_constant_image_has_no_stretch(tmp_path, value: float, dtype: str) -> None:
    assert sample_stretch(write_image(tmp_path / "a.tif", np.full((90, 90), value, dtype)), 1) is None


def test_an_image_of_one_pixel_has_no_stretch(tmp_path) -> None:
    assert sample_stretch(write_image(tmp_path / "a.tif", np.ones((1, 1), np.uint8)), 1) is None


def test_an_image_that_varies_by_a_few_steps_of_its_type_alone_has_no_stretch(tmp_path) -> None:
    flat = np.full((50, 50), 2.0**23, np.float32)  # one step of the type is 1
    for range_, varies in ((6.0, False), (10.0, True)):
        flat[20:30] = 2.0**23 + range_
        assert (sample_stretch(write_image(tmp_path / f"{varies}.tif", flat), 1) is not None) == varies


@pytest.mark.parametrize(
    ("box", "grown"),
    [
        ((40, 10, 20, 12), (35, 5, 30, 22)),
        ((0, 3, 30, 20), (0, 0, 35, 28)),
        ((90, 30, 20, 20), (85, 25, 15, 7)),
        ((-9, -9, 4, 4), (0, 0, 1, 1)),  # beside the image: the pixel that is nearest
        ((150, 50, 20, 20), (99, 31, 1, 1)),
        ((150, -50, 20, 20), (99, 0, 1, 1)),
    ],
)
def test_a_grown_box_is_cut_at_the_image_and_holds_a_pixel_at_least(box, grown) -> None:
    assert grow(box, 5, (100, 32)) == grown


@pytest.mark.parametrize("side", ["left", "right", "top", "bottom", "middle"])
def test_the_stretch_sees_the_whole_image_up_to_its_last_pixels(tmp_path, side: str) -> None:
    """Fifteen columns or rows of a large image, and nothing else, are bright."""
    data = RNG.integers(100, 110, (900, 1100)).astype(np.uint16)
    part = {
        "left": np.s_[:, :15], "right": np.s_[:, -15:], "top": np.s_[:15], "bottom": np.s_[-15:],
        "middle": np.s_[440:460],
    }[side]  # fmt: skip
    data[part] = 5000
    stretch = sample_stretch(write_image(tmp_path / "a.tif", data), 1)
    assert stretch is not None
    assert stretch.low == pytest.approx(100, abs=1)
    assert stretch.high == 5000


def test_the_stretch_is_that_of_the_usual_values_not_of_the_extreme_ones(tmp_path) -> None:
    data = np.tile(np.arange(1000, 2000), (1000, 1)).astype(np.uint16)
    stretch = sample_stretch(write_image(tmp_path / "a.tif", RNG.permuted(data, axis=1)), 1)
    assert stretch is not None
    assert stretch.low == pytest.approx(1005, abs=1.5)
    assert stretch.high == pytest.approx(1994, abs=1.5)
    picture = stretch.apply(np.array([[900, 1005, 1499.5, 1994, 2100]], np.float32), np.ones((1, 5), bool))
    np.testing.assert_allclose(picture[0].astype(int), [0, 0, 127, 255, 255], atol=1)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_stretch_takes_its_ends_to_0_and_255_and_holes_to_the_mean(dtype) -> None:
    pixels = np.array([[100.0, 150.0, 200.0], [50.0, 300.0, 100.4]], dtype)
    whole = np.ones((2, 3), bool)
    assert Stretch(100.0, 200.0).apply(pixels, whole).tolist() == [[0, 128, 255], [0, 255, 1]]
    hole = whole.copy()
    hole[1, :2] = False
    picture = Stretch(100.0, 200.0).apply(pixels, hole)
    assert picture[1, :2].tolist() == [96, 96]  # the mean of 0, 127.5, 255 and 1
    assert Stretch(0.0, 1.0).apply(pixels, ~whole).tolist() == [[0] * 3] * 2


def test_a_window_of_one_value_is_level() -> None:
    for value in (0.0, 2e9, -1e30):
        pixels = np.full((8, 8), value)
        for valid in (np.ones((8, 8), bool), np.eye(8, dtype=bool), np.zeros((8, 8), bool)):
            np.testing.assert_array_equal(levelled(pixels, valid), np.zeros((8, 8), np.float32))


def test_a_stretch_of_jpeg_2000_is_that_of_its_overviews(tmp_path) -> None:
    """Where decoding is dear: noise of pixels is between a quarter, as averages of 16 leave, and a half of it."""
    noise = np.random.default_rng(0).normal(1000, 100, (700, 900)).astype(np.uint16)
    found, place = {}, {"crs": "EPSG:32631", "transform": rasterio.Affine(2, 0, 5e5, 0, -2, 5e6)}
    for driver, given in (("GTiff", {}), ("JP2OpenJPEG", {"REVERSIBLE": "YES", "QUALITY": "100", "BLOCKXSIZE": 256})):
        stretch = sample_stretch(write_image(tmp_path / driver, noise, driver=driver, **place, **given), 1)
        assert stretch is not None
        found[driver] = (stretch.high - stretch.low) / 515.2  # 0.5 to 99.5 % of a normal distribution
    assert found["GTiff"] == pytest.approx(1.0, abs=0.03)
    assert 0.24 < found["JP2OpenJPEG"] < 0.5


# --- small pictures of images as they lie, of a bounded size in pixels and bytes ------------------------------


@pytest.fixture
def ramp(tmp_path):
    """An image that grows brighter to the right and, by half as much, downwards; its left border is no data."""
    rows, cols = np.mgrid[0:900, 0:1300]
    pixels = (1000 + 2 * cols + rows).astype(np.uint16)
    pixels[:, :130] = 7
    return write_image(tmp_path / "ramp.tif", pixels, nodata=7)


@pytest.mark.parametrize("kind", ["file", "mosaic", "small"])
def test_a_thumbnail_is_the_image_as_it_lies_stretched_with_black_where_nothing_is_known(ramp, tmp_path, kind):
    path = ramp
    if kind == "mosaic":
        whole = rects((0, 0, 1300, 900), (0, 0, 1300, 900))
        body = band("<NoDataValue>7</NoDataValue>", source("ramp.tif", whole))
        path = vrt(tmp_path / "m.vrt", body, size=(1300, 900))
    grey = thumbnail(path, (1300, 900), 2000 if kind == "small" else 130, 1)
    assert grey.shape == ((900, 1300) if kind == "small" else (90, 130))
    shown = cv2.resize(grey, (130, 90), interpolation=cv2.INTER_AREA).astype(float)
    assert (shown[:, :12] == 0).all()
    assert shown[10:80, 15:125].min() > 0
    right, down = np.diff(shown[10:80, 20:120], axis=1).mean(), np.diff(shown[10:80, 20:120], axis=0).mean()
    rows, cols = np.mgrid[0:900, 130:1300]
    assert right == pytest.approx(255 * 20 / np.ptp(np.percentile(1000 + 2 * cols + rows, (0.5, 99.5))), rel=0.03)
    assert down == pytest.approx(right / 2, rel=0.05)


def test_an_image_without_contrast_has_no_thumbnail_and_one_of_noise_fits_its_bytes(tmp_path):
    flat = write_image(tmp_path / "flat.tif", np.full((50, 50), 9, np.uint8))
    assert thumbnail(flat, (50, 50), 48, 1) is None
    noise = np.random.default_rng(1).integers(0, 255, (480, 480)).astype(np.uint8)
    assert len(jpeg(noise)) > 60_000
    for most in (60_000, 25_000, 1000, 1):
        made = jpeg(noise, most)
        assert len(made) <= most or most == 1
        assert cv2.imdecode(np.frombuffer(made, np.uint8), 0) is not None


@pytest.mark.parametrize("size", [(20, 30_000), (30_000, 3), (1, 1), (2, 1)])
def test_an_image_of_few_columns_or_rows_has_a_thumbnail_or_none(tmp_path, size):
    pixels = (np.arange(size[0] * size[1]) % 251).reshape(size[1], size[0]).astype(np.uint8)
    grey = thumbnail(write_image(tmp_path / "thin.tif", pixels, nodata=255), size, 480, 1)
    assert grey is None or (max(grey.shape) <= 480 and min(grey.shape) >= 1)
    assert (grey is None) <= (max(size) < 3)
