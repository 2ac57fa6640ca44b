"""Opening rasters: what is read, and what is refused in one line."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import rasterio
import rasterio.shutil

from barpc.base import identity
from barpc.base.errors import ImageError, InputError
from barpc.rasters import raster
from barpc.rasters.raster import hashed, map_crs, open_raster
from tests.geotiffs import write_image
from tests.rasters.test_vrt import band, source
from tests.rasters.test_vrt import vrt as written


@pytest.fixture
def image(tmp_path: Path) -> Path:
    return write_image(tmp_path / "image.tif", np.arange(48, dtype=np.uint16).reshape(6, 8))


def vrt(path: Path, file: object, relative: int = 1) -> Path:
    return written(path, band(source(file, relative=relative)), size=(8, 6))


def test_a_raster_without_georeference_opens_without_a_warning(image: Path) -> None:
    with open_raster(image) as dataset:
        assert dataset.shape == (6, 8)
        assert dataset.read(1)[5, 7] == 47


def test_a_vrt_of_a_plain_local_raster_opens(image: Path, tmp_path: Path) -> None:
    with open_raster(vrt(tmp_path / "a.vrt", "image.tif")) as dataset:
        assert dataset.read(1)[5, 7] == 47
    with open_raster(vrt(tmp_path / "b.vrt", image, 0)) as dataset:
        assert dataset.read(1)[0, 1] == 1


def test_a_vrt_that_is_replaced_while_it_is_hashed_is_no_input(image: Path, tmp_path: Path, monkeypatch) -> None:
    """Its sources would be those of another one than was hashed."""
    path = vrt(tmp_path / "a.vrt", "image.tif")
    (part,) = hashed(path).parts
    assert part == identity.fingerprint(image)
    read = raster.read_vrt

    def replaced(file: Path) -> object:
        vrt(path, image, 0)
        return read(file)

    monkeypatch.setattr(raster, "read_vrt", replaced)
    with pytest.raises(InputError, match="changed"):
        hashed(path)


@pytest.mark.parametrize("name", ["x.tif", "x.jp2"])
def test_an_image_whose_metadata_name_its_overviews_is_refused_in_a_vrt_too(
    tmp_path: Path, image: Path, name: str
) -> None:
    """GDAL opens what they name, which may be a web service, when it reads every second pixel."""
    shape = {"width": 64, "height": 64, "count": 1, "dtype": "uint16", "transform": rasterio.Affine.scale(2.0)}
    with rasterio.open(tmp_path / "x.tif", "w", driver="GTiff", **shape) as out:
        out.write(np.ones((1, 64, 64), np.uint16))
        out.update_tags(ns="overviews", overview_file=str(image))
    if name == "x.jp2":
        rasterio.shutil.copy(tmp_path / "x.tif", tmp_path / name, driver="JP2OpenJPEG", WRITE_METADATA="YES")
    for path in (tmp_path / name, vrt(tmp_path / "x.vrt", name)):
        with pytest.raises(ImageError, match="names another file as its overviews"), open_raster(path):
            pass


def test_a_vrt_that_warps_is_refused(tmp_path: Path, image: Path) -> None:
    path = vrt(tmp_path / "x.vrt", "image.tif")
    path.write_text(path.read_text().replace("<VRTDataset", '<VRTDataset subClass="VRTWarpedDataset"'))
    with pytest.raises(ImageError, match="VRTDataset"), open_raster(path):
        pass


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (b"hello world", "not a raster"),
        (b"<GDAL_WMS><Service/></GDAL_WMS>", "not a raster"),
        (b'<VRTDataset><!DOCTYPE x [<!ENTITY a "b">]></VRTDataset>', "DOCTYPE"),
        (b"II*\x00\x08\x00\x00\x00", "is cut off after 8 bytes"),
        (b"\x89PNG damaged", "cannot be read as PNG"),
    ],
)
def test_a_file_that_is_no_image_is_refused_in_one_line(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "x.tif"
    path.write_bytes(content)
    with pytest.raises(ImageError, match=message) as caught, open_raster(path):
        pass
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("path", ["/vsicurl/http://127.0.0.1:9/x.tif", "s3://bucket/x.tif", "GTIFF_DIR:1:x.tif"])
def test_a_remote_or_indirect_path_is_refused(path: str) -> None:
    with pytest.raises(ImageError, match="remote and virtual"), open_raster(path):
        pass


def test_a_missing_file_a_folder_and_a_pipe_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name, message in (("missing.tif", "no such file"), ("", "folder"), ("pipe", "pipe")):
        with pytest.raises(ImageError, match=message), open_raster(tmp_path / name):
            pass


def test_an_error_while_reading_names_the_file(image: Path) -> None:
    cut = image.with_name("cut.tif")
    cut.write_bytes(image.read_bytes()[:-40])
    with pytest.raises(ImageError, match=r"cut\.tif"), open_raster(cut) as dataset:
        dataset.read(1)


@pytest.mark.parametrize(
    ("given", "code"),
    [(None, 32731), ("EPSG:2154", 2154), ("epsg:3413", 3413), ("EPSG:4326", 0), ("EPSG:4978", 0), ("EPSG:2263", 0),
     ("EPSG:32631x", 0), ("nonsense", 0)],
)  # fmt: skip
def test_cells_are_in_metres_of_a_map_and_of_the_utm_zone_where_none_is_given(given: str | None, code: int) -> None:
    """Not in degrees, of the Earth's centre, or in feet."""
    middle = np.array([5.0, -44.0, 0.0])
    if code:
        assert map_crs(given, middle).to_epsg() == code
    else:
        with pytest.raises(InputError, match=f"--crs {given}: "):
            map_crs(given, middle)
