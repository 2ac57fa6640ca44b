"""Pictures of a run for its report: small, of the images as they are, along epipolar lines that rays confirm."""

from __future__ import annotations

import base64
import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rasterio

from barpc.pipeline import outputs, pictures
from barpc.rasters import raster
from barpc.simulate import simulate_block
from barpc.tie.pixels import jpeg, thumbnail

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def decoded(text: str) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_GRAYSCALE)


def write(path, pixels, **profile):
    with rasterio.open(path, "w", "GTiff", pixels.shape[1], pixels.shape[0], 1, dtype=pixels.dtype, **profile) as file:
        file.write(pixels, 1)
    return path


@pytest.fixture
def ramp(tmp_path):
    """An image that grows brighter to the right and, by half as much, downwards; its left border is no data."""
    rows, cols = np.mgrid[0:900, 0:1300]
    pixels = (1000 + 2 * cols + rows).astype(np.uint16)
    pixels[:, :130] = 7
    return write(tmp_path / "ramp.tif", pixels, nodata=7)


@pytest.mark.parametrize("kind", ["file", "mosaic", "small"])
def test_a_thumbnail_is_the_image_as_it_lies_stretched_with_black_where_nothing_is_known(ramp, tmp_path, kind):
    path = ramp
    if kind == "mosaic":
        path = tmp_path / "m.vrt"
        path.write_text(
            '<VRTDataset rasterXSize="1300" rasterYSize="900"><VRTRasterBand dataType="UInt16" band="1">'
            '<NoDataValue>7</NoDataValue><SimpleSource><SourceFilename relativeToVRT="1">ramp.tif</SourceFilename>'
            '<SourceBand>1</SourceBand><SrcRect xOff="0" yOff="0" xSize="1300" ySize="900"/>'
            '<DstRect xOff="0" yOff="0" xSize="1300" ySize="900"/></SimpleSource></VRTRasterBand></VRTDataset>'
        )
        with raster.open_raster(path) as dataset:
            assert isinstance(dataset, raster.Mosaic)
    grey = thumbnail(path, (1300, 900), 2000 if kind == "small" else 130)
    assert grey.shape == ((900, 1300) if kind == "small" else (90, 130))
    shown = cv2.resize(grey, (130, 90), interpolation=cv2.INTER_AREA).astype(float)
    assert (shown[:, :12] == 0).all()
    assert shown[10:80, 15:125].min() > 0
    right, down = np.diff(shown[10:80, 20:120], axis=1).mean(), np.diff(shown[10:80, 20:120], axis=0).mean()
    rows, cols = np.mgrid[0:900, 130:1300]
    assert right == pytest.approx(255 * 20 / np.ptp(np.percentile(1000 + 2 * cols + rows, (0.5, 99.5))), rel=0.03)
    assert down == pytest.approx(right / 2, rel=0.05)


def test_an_image_without_contrast_has_no_thumbnail_and_one_of_noise_fits_its_bytes(tmp_path):
    flat = write(tmp_path / "flat.tif", np.full((50, 50), 9, np.uint8))
    assert thumbnail(flat, (50, 50), 48) is None
    noise = np.random.default_rng(1).integers(0, 255, (480, 480)).astype(np.uint8)
    assert len(jpeg(noise)) > 60_000
    for most in (60_000, 25_000, 1000, 1):
        made = jpeg(noise, most)
        assert len(made) <= most or most == 1
        assert cv2.imdecode(np.frombuffer(made, np.uint8), 0) is not None


@pytest.mark.parametrize("order", [1, -1])
def test_rows_of_tiles_are_epipolar_lines_and_what_the_cameras_miss_is_across_them(order):
    """Rays, not the code of tiles: ground points along a line of sight at other heights stand on the middle row."""
    block = simulate_block(2, 40, seed=3)
    a, b = (view.sensor for view in block.views[::order])
    here = np.array([[300.0, 400.0], [1200.0, 900.0], [2000.0, 1500.0]])
    alt = np.full(3, float(np.mean(block.views[0].alt_range)))
    there = b.project(np.column_stack([a.localize(here, alt)[:, :2], alt]))
    first, second = pictures._along_lines([a, b], (here, there), alt, 20.0)
    size = first.shape[1]
    assert first.shape == second.shape == (3, size, size, 2)
    for nodes, middle in ((first, here), (second, there)):
        assert nodes[:, [0, 0, -1, -1], [0, -1, 0, -1]].mean(axis=1) == pytest.approx(middle, abs=1e-3)
    assert np.linalg.norm(first[:, 0, -1] - first[:, 0, 0], axis=1) == pytest.approx(40.0)
    assert (first[:, :, -1, 0] > first[:, :, 0, 0]).all()
    ends = second[:, [0, -1]].mean(axis=1)  # the line of middles of columns: the middle row
    axis = (ends[:, -1] - ends[:, 0]) / np.linalg.norm(ends[:, -1] - ends[:, 0], axis=1, keepdims=True)
    across = np.column_stack([-axis[:, 1], axis[:, 0]])
    for rise in (-30.0, 15.0, 40.0):
        seen = b.project(np.column_stack([a.localize(here, alt + rise)[:, :2], alt + rise])) - there
        assert np.abs((seen * across).sum(axis=1)).max() < 0.02
        assert np.abs((seen * axis).sum(axis=1)).min() > 1.0
    for miss in (-3.0, 5.0):  # px: the tile stays on its line, so the point stands that far from it
        off = pictures._along_lines([a, b], (here, there + miss * across + 4.0 * axis), alt, 20.0)[1]
        moved = off[:, [0, 0, -1, -1], [0, -1, 0, -1]].mean(axis=1) - there
        assert moved == pytest.approx(4.0 * axis, abs=0.02)


def test_cameras_without_a_parallax_and_unknown_heights_end_no_run(ramp):
    view = simulate_block(2, 40, seed=3).views[0]
    here = np.array([[300.0, 400.0], [500.0, 600.0]])
    first, second = pictures._along_lines([view.sensor, view.sensor], (here, here), np.array([100.0, np.nan]), 20.0)
    assert np.isnan(first[1]).all()
    assert np.isnan(second[1]).all()
    shown = replace(view, path=str(ramp), size=(1300, 900))
    assert not pictures._tile(shown, 1, first[1]).any()
    assert pictures._tile(shown, 1, second[0]).shape == (120, 120)


@pytest.mark.parametrize("size", [(20, 30_000), (30_000, 3), (1, 1), (2, 1)])
def test_an_image_of_few_columns_or_rows_has_a_thumbnail_or_none(tmp_path, size):
    pixels = (np.arange(size[0] * size[1]) % 251).reshape(size[1], size[0]).astype(np.uint8)
    grey = thumbnail(write(tmp_path / "thin.tif", pixels, nodata=255), size, 480)
    assert grey is None or (max(grey.shape) <= 480 and min(grey.shape) >= 1)
    assert (grey is None) <= (max(size) < 3)


def test_a_run_keeps_small_pictures_of_what_it_saw_and_they_are_no_results(adjusted):
    result, out = adjusted
    found = json.loads((out / "tables/pictures.json").read_text())
    assert [one["image"] for one in found["images"]] == [view.name for view in result.run.views]
    for one, view in zip(found["images"], result.run.views, strict=True):
        grey = decoded(one["picture"])
        assert grey.shape[::-1] == tuple(one["size"])
        assert max(one["size"]) == min(480, max(view.size))
        assert len(one["picture"]) < 80_000
        with rasterio.open(view.path) as file:
            own = cv2.resize(file.read(1).astype(np.float32), tuple(one["size"]), interpolation=cv2.INTER_AREA)
        assert np.corrcoef(grey.ravel(), own.ravel())[0, 1] > 0.95
    (strip,) = found["pairs"]
    tiles = decoded(strip["picture"]).astype(float).reshape(3, 120, strip["tiles"], 120).transpose(0, 2, 1, 3)
    assert strip["rows"][1].endswith("delivered cameras")
    assert "tables/pictures.json" not in {one["file"] for one in result.summary["outputs"]}
    assert "tables/pictures.json" in (out / "SHA256SUMS").read_text()
    after = [cv2.phaseCorrelate(a, b)[0][1] for a, b in zip(tiles[0], tiles[2], strict=True)]
    assert np.median(np.abs(after)) < 1.0  # px of a tile: 0.2 to 1.3 of the image
    page = (out / "report.html").read_text()
    assert page.count("data:image/jpeg") == len(found["images"]) + 1
    assert len(page) < 2.5e6


def test_the_page_is_made_again_without_the_images_and_of_a_run_without_pictures(adjusted, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(adjusted[1], out)
    before = (out / "report.html").read_bytes()
    assert outputs.remake_report(out).read_bytes() == before
    (out / "tables/pictures.json").unlink()  # of an earlier release
    assert b"data:image/jpeg" not in outputs.remake_report(out).read_bytes()


@pytest.mark.parametrize(
    "text", ["{", "{}", '{"images": [{"image": "a", "size": [1, 1], "picture": "\\"><b>"}], "pairs": []}']
)
def test_damaged_pictures_are_named_in_one_line(adjusted, tmp_path, text):
    out = tmp_path / "run"
    shutil.copytree(adjusted[1], out)
    (out / "tables/pictures.json").write_text(text)
    with pytest.raises(outputs.InputError, match=r"pictures\.json"):
        outputs.remake_report(out)


def test_an_image_that_is_gone_or_elsewhere_is_left_out(matched, tmp_path):
    first, second, _ = matched[0].run.views
    gone = [first, replace(second, path=str(tmp_path / "no.tif")), replace(second, path="https://example.org/a.tif")]
    shown, unread = pictures.thumbnails(gone, 1, 60_000)
    assert (shown["image"], unread["image"]) == (first.name, second.name)
    assert "picture" in shown
    assert unread.keys() == {"image", "error"}
    assert "no.tif" in unread["error"]
