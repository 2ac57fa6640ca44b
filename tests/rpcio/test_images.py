"""RPCs in rasters: copies whose pixels stay, VRTs that point at the original, crops, NITF."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from rasterio import Affine
from rasterio.control import GroundControlPoint
from rasterio.shutil import copy as raster_copy

from barpc.base.errors import OutputError, RpcFormatError
from barpc.pipeline.verify_outputs import CONSUMERS
from barpc.rasters.raster import open_raster
from barpc.rpcio import images, read_rpc, read_rpc_source, write_crop, write_rpc_copy, write_rpc_vrt
from barpc.rpcio.images import printable, put_tag, read_tag
from tests.rpcio.conftest import grid, make_rpc, pixels, write_image, write_nitf

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

KINDS = {
    "uint16": {},
    "uint8 in bands": {"shape": (3, 40, 60), "dtype": "uint8", "photometric": "rgb"},
    "float32": {"dtype": "float32"},
    "tiled and compressed": {"shape": (1, 300, 500), "tiled": True, "compress": "deflate"},
    "JPEG": {"shape": (1, 64, 64), "dtype": "uint8", "compress": "jpeg"},
    "BigTIFF": {"BIGTIFF": "YES"},
    "big-endian": {"ENDIANNESS": "BIG"},
    "big-endian BigTIFF": {"ENDIANNESS": "BIG", "BIGTIFF": "YES"},
    "with nodata": {"nodata": 7},
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_copy_has_the_rpc_to_the_bit_and_untouched_pixels(kind, rpc, tmp_path):
    image = write_image(tmp_path / "scene.tif", **KINDS[kind])
    before = image.read_bytes()
    write_rpc_copy(rpc, image, tmp_path / "out" / "copy.tif")
    source = read_rpc_source(tmp_path / "out" / "copy.tif")
    assert (source.rpc, source.format) == (rpc, "tag")
    np.testing.assert_array_equal(pixels(tmp_path / "out" / "copy.tif"), pixels(image))
    assert image.read_bytes() == before
    with open_raster(tmp_path / "out" / "copy.tif") as copy, open_raster(image) as original:
        assert copy.nodata == original.nodata
        assert copy.colorinterp == original.colorinterp
        assert copy.rpcs.line_off == pytest.approx(rpc.image_offset[1], rel=1e-14)


@pytest.mark.parametrize("kind", KINDS)
def test_a_vrt_has_the_rpc_to_the_bit_and_the_pixels_of_the_image(kind, rpc, tmp_path):
    image = write_image(tmp_path / "scene.tif", **KINDS[kind])
    write_rpc_vrt(rpc, image, tmp_path / "out" / "scene.vrt")
    assert read_rpc(tmp_path / "out" / "scene.vrt") == rpc
    np.testing.assert_array_equal(pixels(tmp_path / "out" / "scene.vrt"), pixels(image))
    with open_raster(tmp_path / "out" / "scene.vrt") as vrt, open_raster(image) as original:
        assert vrt.nodata == original.nodata
        assert vrt.colorinterp == original.colorinterp
    with rasterio.open(tmp_path / "out" / "scene.vrt") as by_gdal:
        assert by_gdal.rpcs.line_num_coeff == rpc.coeffs[2].tolist()
        np.testing.assert_array_equal(by_gdal.read(), pixels(image))


def test_offsets_of_more_digits_than_gdal_hands_on_move_nothing(rpc, image, tmp_path):
    """As they are, they would: 4e-14 degrees are 7e-9 px."""
    long = replace(
        rpc,
        ground_offset=rpc.ground_offset + [1 / 3e8, 1 / 7e8, 1 / 3e5],
        ground_scale=rpc.ground_scale * (1 + 1 / 3e9),
        image_scale=rpc.image_scale * (20 + 1 / 3e9),
    )
    write_rpc_copy(long, image, tmp_path / "a.tif")
    found = read_rpc(tmp_path / "a.tif")
    assert printable(found) == found != long
    for name in ("ground_offset", "ground_scale", "image_offset", "image_scale"):
        np.testing.assert_array_equal(getattr(found, name), [float(f"{v:.15g}") for v in getattr(long, name)])
    np.testing.assert_allclose(found.project(grid(long)), long.project(grid(long)), rtol=0, atol=2e-10)
    by_gdal = CONSUMERS["gdal"].open(tmp_path / "a.tif")(grid(long))
    np.testing.assert_allclose(by_gdal, long.project(grid(long)), rtol=0, atol=2e-10)
    write_rpc_copy(found, image, tmp_path / "b.tif")
    assert read_rpc(tmp_path / "b.tif") == found


def test_a_second_copy_replaces_the_tag_of_the_first(rpc, image, tmp_path):
    write_rpc_copy(rpc, image, tmp_path / "a.tif")
    write_rpc_copy(rpc.crop(3, 4), tmp_path / "a.tif", tmp_path / "b.tif")
    assert read_rpc(tmp_path / "b.tif") == rpc.crop(3, 4)
    np.testing.assert_array_equal(pixels(tmp_path / "b.tif"), pixels(image))


def test_overviews_and_masks_of_a_copy_stay(rpc, tmp_path):
    image = write_image(tmp_path / "scene.tif", shape=(1, 512, 512), tiled=True)
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(image, "r+") as out:
        out.write_mask(np.eye(512, dtype=bool))
        out.build_overviews([2, 4])
    write_rpc_copy(rpc, image, tmp_path / "copy.tif")
    write_rpc_vrt(rpc, image, tmp_path / "scene.vrt")
    with open_raster(tmp_path / "copy.tif") as copy:
        assert copy.overviews(1) == [2, 4]
        np.testing.assert_array_equal(copy.dataset_mask() > 0, np.eye(512, dtype=bool))
    with open_raster(tmp_path / "scene.vrt") as vrt:
        np.testing.assert_array_equal(vrt.read_masks(1) > 0, np.eye(512, dtype=bool))


def test_a_cloud_optimised_image_is_copied_and_no_longer_claims_its_layout(rpc, tmp_path):
    image = write_image(tmp_path / "scene.tif", shape=(1, 600, 600), driver="COG", dtype="uint8")
    assert b"KNOWN_INCOMPATIBLE_EDITION=NO\n " in image.read_bytes()
    write_rpc_copy(rpc, image, tmp_path / "copy.tif")
    assert b"KNOWN_INCOMPATIBLE_EDITION=YES\n" in (tmp_path / "copy.tif").read_bytes()
    assert read_rpc(tmp_path / "copy.tif") == rpc
    np.testing.assert_array_equal(pixels(tmp_path / "copy.tif"), pixels(image))


def test_a_copy_has_the_bytes_of_its_source_but_for_one_offset_and_one_line(rpc, tmp_path):
    """Before its new directory: the directory's offset, and in a cloud-optimised file what says that it moved."""
    for driver in ("GTiff", "COG"):
        source = write_image(tmp_path / f"{driver}.tif", (1, 300, 300), driver=driver)
        write_rpc_copy(rpc, source, tmp_path / f"{driver}_copy.tif")
        before, after = source.read_bytes(), (tmp_path / f"{driver}_copy.tif").read_bytes()
        expected = before.replace(b"KNOWN_INCOMPATIBLE_EDITION=NO\n ", b"KNOWN_INCOMPATIBLE_EDITION=YES\n")
        assert (expected != before) == (driver == "COG")
        changed = [i for i in range(len(before)) if after[i] != expected[i]]
        assert changed
        assert set(changed) <= {4, 5, 6, 7}
        assert len(before) < len(after) < len(before) + 2000


def test_a_geotransform_without_crs_is_left_out_and_one_with_crs_is_kept(rpc, tmp_path):
    """Without CRS it is the origin of a crop, which the RPC that is written has already."""
    origin = Affine(1.0, 0, 5000, 0, -1, -5000)
    crop = write_image(tmp_path / "crop.tif", transform=origin)
    turned = write_image(tmp_path / "turned.tif", transform=origin @ Affine.rotation(10.0))
    map_ = write_image(tmp_path / "map.tif", transform=Affine(1e-5, 0, 5, 0, -1e-5, 44), crs=4326)
    for image, kept in ((crop, False), (turned, False), (map_, True)):
        write_rpc_copy(rpc, image, tmp_path / "copy.tif", overwrite=True)
        write_rpc_vrt(rpc, image, tmp_path / "copy.vrt", overwrite=True)
        for written in ("copy.tif", "copy.vrt"):
            with open_raster(tmp_path / written) as out, open_raster(image) as original:
                assert (out.transform == original.transform) is kept
                assert out.crs == original.crs


def test_a_vrt_and_its_image_may_move_together(rpc, image, tmp_path):
    write_rpc_vrt(rpc, image, tmp_path / "out" / "scene.vrt")
    write_rpc_vrt(rpc, image, tmp_path / "out" / "fixed.vrt", relative=False)
    expected = pixels(image)
    np.testing.assert_array_equal(pixels(tmp_path / "out" / "fixed.vrt"), expected)
    (tmp_path / "moved").mkdir()
    for name in ("in", "out"):
        shutil.move(tmp_path / name, tmp_path / "moved" / name)
    np.testing.assert_array_equal(pixels(tmp_path / "moved" / "out" / "scene.vrt"), expected)


def test_the_input_is_never_written_to(rpc, image, tmp_path):
    before = image.read_bytes()
    (tmp_path / "link.tif").symlink_to(image)
    for target in (image, tmp_path / "link.tif"):
        for write in (write_rpc_copy, write_rpc_vrt):
            with pytest.raises(OutputError, match="never written to"):
                write(rpc, image, target, overwrite=True)
        with pytest.raises(OutputError, match="never written to"):
            write_crop(rpc, image, target, (0, 0, 5, 5), overwrite=True)
    assert image.read_bytes() == before


def test_a_crop_of_a_map_that_is_turned_and_sheared_stays_in_its_place(rpc, tmp_path):
    placed = Affine(1.1e-5, 3e-6, 5.0, -2e-6, -0.9e-5, 44.0)
    image = write_image(tmp_path / "scene.tif", shape=(1, 90, 120), transform=placed, crs=4326)
    for col, row in ((0, 0), (37, 0), (0, 51), (20, 30)):
        write_crop(rpc, image, tmp_path / "crop.tif", (col, row, 30, 20), overwrite=True)
        with open_raster(tmp_path / "crop.tif") as crop:
            assert crop.crs == rasterio.crs.CRS.from_epsg(4326)
            for x, y in ((0, 0), (29, 0), (0, 19), (13, 7)):
                np.testing.assert_allclose(crop.transform @ (x, y), placed @ (col + x, row + y), rtol=1e-14)


def test_resampling_moves_pixel_centres_with_their_corners(rpc):
    """Downscaled by s: offset (off + 0.5)/s - 0.5, scale / s."""
    half = rpc.window(0, 0, 2, 2)
    np.testing.assert_allclose(half.image_offset, (rpc.image_offset + 0.5) / 2 - 0.5, rtol=0, atol=1e-12)
    projected = (rpc.project(grid(rpc)) + 0.5) / 2 - 0.5
    np.testing.assert_allclose(half.project(grid(rpc)), projected, rtol=0, atol=1e-9)


def test_a_nitf_is_read_to_the_last_digit_of_its_record(image, tmp_path):
    rpc = make_rpc()
    fitting = type(rpc)(
        np.round(rpc.coeffs, 6),
        [5.4, 43.2, 500.0],
        [0.0062, 0.0045, 500.0],
        [999.0, 950.0],
        [1010.0, 980.0],
        3.1,
        0.7,
    )
    write_nitf(fitting, image, tmp_path / "a.ntf")
    source = read_rpc_source(tmp_path / "a.ntf")
    assert (source.rpc, source.format) == (fitting, "nitf")
    np.testing.assert_array_equal(pixels(tmp_path / "a.ntf"), pixels(image))


def test_gdal_makes_a_nitf_of_a_copy_to_the_digits_of_its_record(image, tmp_path):
    """GDAL puts the tag's RPC into the record, whose few digits cost pixels."""
    write_rpc_copy(make_rpc(), image, tmp_path / "a.tif")
    with open_raster(tmp_path / "a.tif") as dataset:
        raster_copy(dataset, str(tmp_path / "a.ntf"), driver="NITF")
    assert 0.1 <= read_rpc(tmp_path / "a.ntf").off(make_rpc()).max() <= 5.0


def test_a_raster_that_is_no_tiff_is_converted_and_leaves_nothing_beside(rpc, tmp_path):
    image = write_image(tmp_path / "in.png", shape=(1, 30, 30), driver="PNG", dtype="uint8")
    (tmp_path / "in.png.aux.xml").unlink(missing_ok=True)
    write_rpc_copy(rpc, image, tmp_path / "copy.tif")
    assert read_rpc(tmp_path / "copy.tif") == rpc
    np.testing.assert_array_equal(pixels(tmp_path / "copy.tif"), pixels(image))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["copy.tif", "in.png"]


def test_a_converted_copy_whose_pixels_are_not_the_image_s_is_an_error_and_leaves_nothing(tmp_path, monkeypatch):
    """As on a disk that is full when GDAL closes the file, of which it says nothing."""
    real = images.raster_copy

    def losing(dataset, target, **options):
        real(dataset, target, **options)
        with rasterio.open(target, "r+") as out:
            out.write(np.zeros((1, 1), out.dtypes[0]), 1, window=rasterio.windows.Window(7, 5, 1, 1))

    monkeypatch.setattr(images, "raster_copy", losing)
    image = write_image(tmp_path / "a.png", shape=(1, 30, 30), driver="PNG", dtype="uint8")
    with pytest.raises(OutputError, match="other pixels than were written"):
        write_rpc_copy(make_rpc(), image, tmp_path / "out" / "copy.any")
    assert not list((tmp_path / "out").iterdir())


def test_the_tag_of_a_tiff_that_is_cut_off_is_an_error_in_one_line(rpc, image, tmp_path):
    write_rpc_copy(rpc, image, tmp_path / "a.tif")
    data = (tmp_path / "a.tif").read_bytes()
    for size in (4, 8, 12, len(data) - 800, len(data) - 400, len(data) - 5):
        (tmp_path / "cut.tif").write_bytes(data[:size])
        with pytest.raises(RpcFormatError, match=r"cut\.tif"):
            read_tag(tmp_path / "cut.tif")


@pytest.mark.parametrize("placed", [True, False])
@pytest.mark.parametrize("how", ["tie points", "transform"])
def test_a_tag_is_put_beside_the_place_of_an_image_or_in_its_stead(tmp_path, how, placed):
    path, corners = tmp_path / "a.tif", [(0, 0), (0, 9), (9, 0), (9, 9)]
    gcps = [GroundControlPoint(row, col, 5 + col / 10, 43 - row / 10, 0.0) for row, col in corners]
    place = {"gcps": gcps} if how == "tie points" else {"transform": Affine(0.1, 0.02, 5, 0.02, -0.1, 43)}
    with rasterio.open(path, "w", driver="GTiff", width=9, height=9, count=1, dtype="uint8", crs=4326, **place) as out:
        out.write(np.zeros((1, 9, 9), np.uint8))
    put_tag(path, make_rpc(), placed)
    with rasterio.open(path) as found:
        assert found.rpcs is not None
        assert bool(found.gcps[0]) is (placed and how == "tie points")
        assert found.transform == (place["transform"] if placed and how == "transform" else Affine.identity())
