"""Small pictures of images as they lie, of a bounded size in pixels and bytes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from barpc.tie.pixels import jpeg, thumbnail
from tests.geotiffs import write_image
from tests.rasters.test_vrt import band, rects, source, vrt

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


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
