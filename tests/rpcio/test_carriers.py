"""RPCs that GDAL shows of rasters of any kind: the same camera to barpc, last in the order of its sources."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import RPCTransformer

from barpc.base.errors import ImageError, MissingRpcError, RpcFormatError
from barpc.cameras import open_camera
from barpc.rasters.raster import hashed, open_raster
from barpc.rpcio import read_rpc, read_rpc_source, shadows, write_crop, write_rpc, write_rpc_copy, write_rpc_vrt
from barpc.rpcio.acquisition import read_acquisition
from barpc.sensor.rpc import RPC
from barpc.verbs.images import expanded
from tests.rpcio.carriers import MAKERS, envi, gdal_pixels, pcidsk, seen_by_gdal
from tests.rpcio.conftest import ended, grid, make_rpc, pixels, rpc_domain, write_image
from tests.rpcio.test_tiles import STRIP, strip, tile

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.fixture
def rpc() -> RPC:
    return make_rpc(err_bias=None, err_rand=None)


def projected_by_gdal(path: Path, ground: np.ndarray) -> np.ndarray:
    """Col, row by GDAL's transformer, which counts from the corner of the first pixel."""
    with rasterio.open(path) as dataset, RPCTransformer(dataset.rpcs) as transformer:
        row, col = transformer.rowcol(*ground.T, op=np.positive)
    return np.column_stack([col, row]) - 0.5


@pytest.mark.parametrize("end", MAKERS)
def test_the_camera_and_the_pixels_are_those_that_gdal_shows(end: str, rpc: RPC, tmp_path: Path) -> None:
    path = MAKERS[end](tmp_path / f"x.{end}", rpc)
    source, points = read_rpc_source(path), grid(rpc)
    assert (source.format, source.path, source.notes) == ("domain", path, ())
    np.testing.assert_allclose(source.rpc.project(points), rpc.project(points), rtol=0, atol=1e-8)
    np.testing.assert_allclose(source.rpc.project(points), projected_by_gdal(path, points), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(pixels(path), gdal_pixels(path))
    camera = open_camera(path)
    assert (camera.size, camera.doubts) == ((60, 40), ())
    assert expanded([str(tmp_path)]) == [str(path)]
    assert read_acquisition(path, path).sensor == ""
    whole = read_rpc_source(path, first_pixel=1.0).rpc
    assert (rpc.image_offset - whole.image_offset).tolist() == [1.0, 1.0]


@pytest.mark.parametrize("end", MAKERS)
def test_what_is_written_of_it_is_read_by_gdal(end: str, rpc: RPC, tmp_path: Path) -> None:
    path, other = MAKERS[end](tmp_path / f"x.{end}", rpc), rpc.crop(7.0, 9.0)
    write_rpc_vrt(other, path, tmp_path / "out" / "x.vrt")
    write_rpc_copy(other, path, tmp_path / "out" / "x.tif")
    write_crop(rpc, path, tmp_path / "out" / "crop.tif", (7, 9, 20, 10))
    for name, window in (("x.vrt", np.s_[:, :, :]), ("x.tif", np.s_[:, :, :]), ("crop.tif", np.s_[:, 9:19, 7:27])):
        made = tmp_path / "out" / name
        np.testing.assert_allclose(projected_by_gdal(made, grid(rpc)), other.project(grid(rpc)), rtol=0, atol=1e-6)
        np.testing.assert_array_equal(gdal_pixels(made), gdal_pixels(path)[window])


@pytest.mark.parametrize("end", MAKERS)
def test_files_beside_the_image_go_before_it_and_it_is_named(end: str, rpc: RPC, tmp_path: Path) -> None:
    path = MAKERS[end](tmp_path / f"x.{end}", rpc)
    for n, name in enumerate((f"x.{end}.aux.xml", "x-RPC.txt", "x.geom", "x_RPC.TXT", "x.RPB"), start=1):
        other, beside = rpc.crop(0.0, 10.0 * n), tmp_path / name
        if name.endswith(".xml"):
            beside.write_text(f"<PAMDataset>\n{rpc_domain(other)}\n</PAMDataset>\n")
            assert seen_by_gdal(path).line_off == pytest.approx(other.image_offset[1])
        else:
            write_rpc(other, beside)
        source = read_rpc_source(path)
        assert (source.path, source.rpc) == (beside, other)
        assert source.notes == ("not used: the image's own RPC",)
        assert [one.path for one in shadows(path)] == [beside]
        beside.unlink()
    (tmp_path / "x_RPC.TXT").write_text("LINE_NUM_COEFF_1: 1\n")
    with pytest.raises(RpcFormatError, match=r"x_RPC\.TXT: LINE_NUM_COEFF has 1 coefficients"):
        read_rpc(path)


@pytest.mark.parametrize("end", MAKERS)
def test_an_image_without_an_rpc_says_so(end: str, tmp_path: Path) -> None:
    path = MAKERS[end](tmp_path / f"x.{end}", None)
    assert seen_by_gdal(path) is None
    with pytest.raises(MissingRpcError, match="no RPC in the image and none beside it"):
        read_rpc(path)
    assert pixels(path).shape == (1, 40, 60)


def test_a_damaged_rpc_domain_is_one_line(rpc: RPC, tmp_path: Path) -> None:
    """Also where no other file has one: no step to 'no RPC'."""
    zero = pcidsk(tmp_path / "zero.pix", rpc, cells={"LINE_SCALE": "0"})
    words = pcidsk(tmp_path / "words.pix", rpc, cells={"LAT_SCALE": "unknown"})
    many = envi(tmp_path / "many.img", None, "rpc info = {" + ", ".join(["nan"] * 93) + "}\n")
    for path in (zero, words, many):
        assert seen_by_gdal(path) is not None
        with pytest.raises(RpcFormatError, match=rf"{path.name} \(RPC by GDAL's driver \w+\): ") as told:
            read_rpc(path)
        assert "\n" not in str(told.value)
        write_rpc(rpc, path.with_suffix(".RPB"))
        assert read_rpc_source(path).notes == ()


def tiff_with_items(path: Path, rpc: RPC, lacking: str = "") -> Path:
    """A TIFF without an RPC tag, but with GDAL's domain as text in GDAL's own."""
    items = "".join(
        f'<Item name="{key}" domain="RPC">{value}</Item>'
        for key, value in re.findall(r'<MDI key="(\w+)">([^<]*)</MDI>', rpc_domain(rpc))
        if key != lacking
    )
    write_image(path)
    with rasterio.open(path, "r+") as dataset:
        dataset.update_tags(PLACE="#" * 8000)
    data, filler = path.read_bytes(), b'<Item name="PLACE">' + b"#" * 8000 + b"</Item>"
    assert data.count(filler) == 1
    path.write_bytes(data.replace(filler, items.encode().ljust(len(filler))))
    return path


def test_the_rpc_in_the_metadata_of_a_tiff_counts_as_in_gdal(rpc: RPC, tmp_path: Path) -> None:
    image = tiff_with_items(tmp_path / "x.tif", rpc)
    assert seen_by_gdal(image) is not None
    assert read_rpc_source(image).format == "domain"
    np.testing.assert_allclose(read_rpc(image).project(grid(rpc)), rpc.project(grid(rpc)), rtol=0, atol=1e-8)


@pytest.mark.parametrize("lacking", ["HEIGHT_OFF", "LINE_NUM_COEFF", "SAMP_SCALE"])
def test_a_key_that_is_missing_is_named(lacking: str, rpc: RPC, tmp_path: Path) -> None:
    with pytest.raises(RpcFormatError, match=f"{lacking} is missing"):
        read_rpc(tiff_with_items(tmp_path / "x.tif", rpc, lacking))


# --- ENVI: the header decides ------------------------------------------------------------------------------


def test_raw_pixels_are_known_by_a_header_that_goes_with_their_length(rpc: RPC, tmp_path: Path) -> None:
    path = envi(tmp_path / "x.dat", rpc)
    header = path.with_suffix(".hdr")
    assert [part.path for part in hashed(path).parts] == [str(header)]
    text = tmp_path / "x.rpc"  # the RPC of the same image, to which the header does not speak
    write_rpc(rpc, text)
    assert read_rpc_source(text).format == "txt"
    text.unlink()
    for name in ("x.HDR", "x.dat.hdr", "x.dat.HDR"):
        header = header.rename(tmp_path / name)
        assert read_rpc_source(path).format == "domain"
        assert seen_by_gdal(path) is not None
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ImageError, match=r"its length is not what x\.dat\.HDR says of its pixels"):
        read_rpc(path)
    with pytest.raises(ImageError, match=r"its length is not what"), open_raster(path):
        pass


def test_the_bytes_of_text_in_raw_pixels_are_pixels(rpc: RPC, tmp_path: Path) -> None:
    path = envi(tmp_path / "x.img", rpc, dtype="uint8")
    path.write_bytes(b"a" * path.stat().st_size)
    assert read_rpc_source(path).format == "domain"
    assert (pixels(path) == ord("a")).all()


@pytest.mark.parametrize("interleave", ["bil", "bip", "bsq"])
def test_every_layout_of_raw_pixels_is_gdal_s(interleave: str, rpc: RPC, tmp_path: Path) -> None:
    path = envi(tmp_path / "x.img", rpc, "map info = {UTM, 1, 1, 500000, 4800000, 2, 2, 31, North, WGS-84}\n",
                shape=(3, 20, 30), INTERLEAVE=interleave)  # fmt: skip
    np.testing.assert_array_equal(pixels(path), gdal_pixels(path))
    with rasterio.open(path) as by_gdal, open_raster(path) as ours:
        assert (ours.crs, ours.transform) == (by_gdal.crs, by_gdal.transform)
        assert ours.crs.to_epsg() == 32631


# --- tiles -------------------------------------------------------------------------------------------------


def test_a_list_of_tiles_is_an_image(rpc: RPC, tmp_path: Path) -> None:
    til = strip(tmp_path / "in", rpc)
    expected = np.zeros((70, 90), np.uint16)
    for place, (left, top) in {"R1C1": (0, 0), "R1C2": (50, 0), "R2C1": (0, 30), "R2C2": (50, 30)}.items():
        part = gdal_pixels(tile(tmp_path / "in", place))[0]
        expected[top : top + part.shape[0], left : left + part.shape[1]] = part
    np.testing.assert_array_equal(pixels(til)[0], expected)
    assert len(hashed(til).parts) == 4
    write_rpc_vrt(rpc, til, tmp_path / "out" / "x.vrt")
    write_rpc_copy(rpc, til, tmp_path / "out" / "x.tif")
    for name in ("x.vrt", "x.tif"):
        np.testing.assert_array_equal(gdal_pixels(tmp_path / "out" / name)[0], expected)
        assert read_rpc(tmp_path / "out" / name).off(rpc).max() < 1e-9
    tile(tmp_path / "in", "R2C1").rename(tmp_path / "in" / tile(tmp_path, "R2C1").name.lower())
    np.testing.assert_array_equal(pixels(til)[0], expected)


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("../outside.tif", "no file beside it"), ("/etc/passwd", "no file beside it"), ("a\\b.tif", "no file beside"),
        ("/vsicurl/http://127.0.0.1:9/x.tif", "no file beside it"), ("GTIFF_DIR:1:x.tif", "no file beside it"),
        ("gone.tif", "no such file"), (f"{STRIP}.TIL", "of a VRT is not read"), (f"{STRIP}.RPB", "not a raster"),
        ("small.tif", "12 x 10 px and would be resampled to 40 x 40"),
    ],
)  # fmt: skip
def test_a_list_points_at_plain_tiles_beside_it(name: str, what: str, rpc: RPC, tmp_path: Path) -> None:
    til = strip(tmp_path / "in", rpc)
    write_image(tmp_path / "in" / "small.tif", (1, 10, 12))
    write_image(tmp_path / "outside.tif", (1, 40, 40))
    til.write_text(til.read_text().replace(tile(tmp_path, "R2C2").name, name))
    with pytest.raises(ImageError, match=what):
        pixels(til)


# --- what GDAL would open elsewhere ------------------------------------------------------------------------


def channel_elsewhere(path: Path, name: str) -> None:
    """Put the name of another file into the header of a PCIDSK's first channel."""
    data = bytearray(path.read_bytes())
    data[64:80] = b" " * 16
    at = 512 * (int(data[336:352]) - 1)
    data[at + 64 : at + 128] = name.encode().ljust(64)
    data[360:368] = b"FILE    "
    path.write_bytes(data)


def test_a_pcidsk_with_pixels_elsewhere_is_refused_before_gdal_sees_it(rpc: RPC, tmp_path: Path) -> None:
    secret, whole = write_image(tmp_path / "secret.tif"), pcidsk(tmp_path / "whole.pix", rpc).read_bytes()
    for n, name in enumerate(("secret.tif", "../secret.tif", "/vsicurl/http://127.0.0.1:9/x", "LNK=3", "/SIS=1 x")):
        path = tmp_path / f"{n}.pix"
        path.write_bytes(whole)
        channel_elsewhere(path, name)
        if n == 0:
            np.testing.assert_array_equal(gdal_pixels(path), gdal_pixels(secret))  # no idle guard
        for read in (pixels, read_rpc):
            with pytest.raises(ImageError, match=rf"{n}\.pix: the pixels of its channel 1 are in another file"):
                read(path)
    for layout in ("PIXEL", "BAND", "TILED"):
        path = pcidsk(tmp_path / f"{layout}.pix", rpc, INTERLEAVING=layout, shape=(2, 40, 60))
        np.testing.assert_array_equal(pixels(path), gdal_pixels(path))
    data = bytearray(path.read_bytes())
    data[376:384] = b"99999999"
    path.write_bytes(data)
    with pytest.raises(ImageError, match="does not say where its channels are"):
        pixels(path)


HOSTILE_SYSTEMS = (
    'GEOGCS["x",DATUM["d",SPHEROID["s",6378137,298.257]],EXTENSION["PROJ4_GRIDS","GRID"]]',
    'BOUNDCRS["x",PARAMETERFILE["Latitude and longitude difference file","GRID"]]',
    "GRID",
)


@pytest.mark.parametrize("system", HOSTILE_SYSTEMS)
def test_an_envi_header_opens_nothing(system: str, rpc: RPC, tmp_path: Path) -> None:
    text = system.replace("GRID", str(tmp_path / "canary"))
    path = envi(tmp_path / "x.img", rpc, f"coordinate system string = {{{text}}}\n")
    with pytest.raises(ImageError, match=r"x\.hdr: .* is not read as a reference system"):
        pixels(path)


def test_gdal_sees_of_raw_pixels_no_other_file(rpc: RPC, tmp_path: Path) -> None:
    """Overviews, masks and metadata beside an image could be, or name, a web service."""
    for end in MAKERS:
        path = MAKERS[end](tmp_path / end / f"x.{end}", rpc)
        beside = [f"{stem}{end}" for stem in ("x", path.name) for end in (".ovr", ".msk", ".sta", ".rrd", ".aux")]
        for name in (*beside, f"{path.name}.aux.xml", "x.RPB", "x.IMD", "x.XML", "x_RPC.TXT", "x_rpc.txt"):
            os.mkfifo(path.with_name(name))  # whoever opens it waits for ever
        assert read_rpc_source(path).format == "domain"
        with open_raster(path) as dataset:
            assert dataset.overviews(1) == []
            assert dataset.read_masks(1).all()


def test_a_header_by_gdal_s_rules_smuggles_nothing(rpc: RPC, tmp_path: Path) -> None:
    """Keys in other cases, twice, behind a zero byte, within braces: GDAL is shown what was read, written anew."""
    evil = HOSTILE_SYSTEMS[0].replace("GRID", str(tmp_path / "canary"))
    path = envi(tmp_path / "x.img", rpc)
    header = path.with_suffix(".hdr")
    good = header.read_text()
    for more in (
        f"COORDINATE  SYSTEM string= {{{evil}}}\n",
        f"\tcoordinate system string ={{{evil}}}\r\n",
        f"coordinate system string = {{}}\ncoordinate system string = {{{evil}}}\n",
        f"description = {{\ncoordinate system string = {{{evil}}}\n}}\n",
        f"band names = {{a\0}}\ncoordinate system string = {{{evil}}}\n",
    ):
        header.write_text(good + more)
        try:
            with open_raster(path) as dataset:
                assert dataset.crs is None
        except ImageError as error:
            assert "reference system" in str(error)  # noqa: PT017


# --- a run -------------------------------------------------------------------------------------------------


@pytest.mark.nightly
def test_a_run_of_such_images_is_that_of_the_tiffs(tmp_path: Path) -> None:
    samples = Path(__file__).parents[2] / "data_samples"
    given, plain = [], []
    for n, end in enumerate(("pix", "img")):  # of a JPEG 2000 GDAL has coarser levels of its own
        source = samples / f"view_0{n}.tif"
        whole = read_rpc(source)
        camera = RPC(whole.coeffs, whole.ground_offset, whole.ground_scale, whole.image_offset, whole.image_scale)
        data = gdal_pixels(source)
        given.append(MAKERS[end](tmp_path / "in" / f"view_0{n}.{end}", camera, data=data))
        plain.append(tmp_path / "plain" / f"view_0{n}.tif")
        write_rpc_copy(camera, source, plain[-1])
        write_rpc(camera, plain[-1].with_suffix(".RPB"))
    for name, images in (("out", given), ("ref", plain)):
        assert ended("adjust", *images, "-o", tmp_path / name) == 0
    for n in range(2):
        found, expected = (read_rpc(tmp_path / name / f"view_0{n}_RPC.TXT") for name in ("out", "ref"))
        assert found.off(expected).max() < 1e-6
        seen = tmp_path / "out" / f"view_0{n}.vrt"
        np.testing.assert_allclose(projected_by_gdal(seen, grid(found)), found.project(grid(found)), rtol=0, atol=1e-6)
        np.testing.assert_array_equal(gdal_pixels(seen), gdal_pixels(plain[n]))
    assert ended("verify", tmp_path / "out") == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert any(one["path"].endswith("view_01.hdr") for one in summary["inputs"])
