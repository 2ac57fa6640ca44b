"""Where an image's RPC comes from: GDAL's order, never silently another one."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.base.errors import ImageError, RpcError, RpcFormatError
from barpc.rpcio import (
    FORMATS,
    read_rpc,
    read_rpc_source,
    shadows,
    sidecars,
    write_rpc,
    write_rpc_copy,
    write_rpc_vrt,
)
from barpc.rpcio.acquisition import read_acquisition
from barpc.rpcio.sources import only_physical, stated_in_xml
from tests.rpcio.carriers import seen_by_gdal
from tests.rpcio.conftest import dimap_v2, grid, rpc_domain, write_image

STEM = "IMG_scene_R1C1"


@pytest.fixture
def tagged(rpc, tmp_path) -> Path:
    image = write_image(tmp_path / "raw.tif")
    write_rpc_copy(rpc, image, tmp_path / "a" / f"{STEM}.tif")
    return tmp_path / "a" / f"{STEM}.tif"


def put(kind: str, folder: Path, rpc) -> Path:
    """A sidecar of each kind beside the image STEM.tif."""
    names = {
        "rpb": f"{STEM}.RPB",
        "rpb in lower case": f"{STEM}.rpb",
        "txt": f"{STEM}_RPC.TXT",
        "txt in lower case": f"{STEM}_rpc.txt",
        "rpc": f"{STEM}.rpc",
        "xml": f"{STEM}.XML",
        "geom": f"{STEM}.geom",
        "dimap": "RPC_scene.XML",
        "pam": f"{STEM}.tif.aux.xml",
    }
    path = folder / names[kind]
    if kind == "dimap":
        path.write_text(dimap_v2(rpc))
    elif kind == "pam":
        path.write_text(f"<PAMDataset>\n{rpc_domain(rpc)}\n</PAMDataset>\n")
    else:
        write_rpc(rpc, path)
    return path


HIDING = ["rpb", "rpb in lower case", "txt", "txt in lower case", "rpc", "xml", "dimap"]


@pytest.mark.parametrize("kind", HIDING)
def test_a_sidecar_that_gdal_reads_before_the_tag_is_read_named_and_found(kind, rpc, tagged):
    other = rpc.crop(300, 400)
    path = put(kind, tagged.parent, other)
    assert seen_by_gdal(tagged).line_off == pytest.approx(other.image_offset[1], abs=1e-9)
    source = read_rpc_source(tagged)
    np.testing.assert_allclose(source.rpc.image_offset, other.image_offset, rtol=0, atol=1e-9)
    assert source.path == path
    assert source.notes == ("not used: the image's own RPC",)
    assert [sidecar.path for sidecar in shadows(tagged)] == [path]


@pytest.mark.parametrize("kind", ["geom", "pam"])
def test_a_sidecar_that_gdal_reads_after_the_tag_is_passed_over_and_named(kind, rpc, tagged):
    path = put(kind, tagged.parent, rpc.crop(300, 400))
    assert seen_by_gdal(tagged).line_off == pytest.approx(rpc.image_offset[1])
    source = read_rpc_source(tagged)
    assert (source.rpc, source.format) == (rpc, "tag")
    assert source.notes == (f"not used: {path.name}",)
    assert [sidecar.path for sidecar in shadows(tagged)] == ([path] if kind == "geom" else [])


@pytest.mark.parametrize("kind", [*HIDING, "geom", "pam"])
def test_every_sidecar_serves_an_image_without_an_rpc(kind, rpc, tmp_path):
    image = write_image(tmp_path / f"{STEM}.tif")
    path = put(kind, tmp_path, rpc)
    source = read_rpc_source(image)
    np.testing.assert_allclose(source.rpc.project(grid(rpc)), rpc.project(grid(rpc)), rtol=0, atol=1e-9)
    assert source.path == path
    assert [sidecar.path for sidecar in shadows(image)] == [path]


def test_of_several_sidecars_the_one_that_gdal_takes_is_read(rpc, tagged):
    """.RPB before the Maxar XML before _RPC.TXT before the tag."""
    for index, kind in enumerate(["txt", "xml", "rpb"], 1):
        put(kind, tagged.parent, rpc.crop(0, 100 * index))
        assert seen_by_gdal(tagged).line_off == pytest.approx(read_rpc(tagged).image_offset[1], abs=1e-9)
        assert read_rpc(tagged) == rpc.crop(0, 100 * index)


def test_beside_an_imd_file_the_text_no_longer_hides_the_tag(rpc, tagged):
    put("txt", tagged.parent, rpc.crop(0, 100))
    (tagged.parent / f"{STEM}.IMD").write_text('version = "R";\n')
    assert seen_by_gdal(tagged).line_off == pytest.approx(rpc.image_offset[1])
    assert read_rpc(tagged) == rpc


def test_nothing_beside_a_vrt_hides_its_rpc_from_gdal(rpc, tagged):
    vrt = tagged.with_suffix(".vrt")
    write_rpc_vrt(rpc, tagged, vrt)
    for kind in ("rpb", "txt", "xml"):
        put(kind, tagged.parent, rpc.crop(300, 400))
    assert seen_by_gdal(vrt).line_off == rpc.image_offset[1]
    assert read_rpc(vrt) == rpc
    assert shadows(vrt) == []
    assert len(shadows(tagged)) == 3


@pytest.mark.parametrize("found", [True, False])
def test_a_vrt_without_an_rpc_is_an_image_like_others(found, rpc, tmp_path):
    plain = write_image(tmp_path / "plain.tif")
    vrt = tmp_path / "of_it.vrt"
    rasterio.shutil.copy(plain, vrt, driver="VRT")
    if found:
        write_rpc(rpc, tmp_path / "of_it_RPC.TXT")
        assert read_rpc(vrt) == rpc
    else:
        with pytest.raises(ImageError, match=r"of_it\.vrt.*RPC"):
            read_rpc(vrt)


@pytest.mark.parametrize("kind", ["rpb", "txt", "xml", "dimap"])
def test_a_sidecar_that_does_not_parse_is_an_error_not_a_fall_back_to_the_tag(kind, rpc, tagged):
    path = put(kind, tagged.parent, rpc)
    text = path.read_text()
    path.write_text(text.replace("LINE_SCALE", "LINE_SCALY").replace("lineScale", "x").replace("LINESCALE", "X"))
    with pytest.raises(RpcFormatError, match=path.name.replace(".", r"\.")):
        read_rpc(tagged)


def test_an_xml_beside_an_image_that_is_no_rpc_is_left_alone(rpc, tagged):
    (tagged.parent / f"{STEM}.XML").write_text("<metadata><sensor>x</sensor></metadata>")
    assert read_rpc_source(tagged).format == "tag"
    assert sidecars(tagged) == []


@pytest.mark.parametrize(("y", "step"), [(5200.0, 1.0), (-5200.0, -1.0)])
def test_a_geom_is_the_full_image_s_and_the_crop_origin_is_taken_off(y, step, rpc, tmp_path):
    """Also where the geotransform counts rows downwards as negative northings."""
    transform = rasterio.Affine(1.0, 0.0, 5100.0, 0.0, step, y)
    image = write_image(tmp_path / "crop.tif", transform=transform)
    write_rpc(rpc, tmp_path / "crop.geom")
    source = read_rpc_source(image)
    np.testing.assert_array_equal(source.rpc.image_offset, rpc.image_offset - [5100, 5200])
    assert source.notes == ("crop origin (5100, 5200) of the geotransform applied",)


def test_a_geom_beside_a_georeferenced_image_is_taken_as_it_is(rpc, tmp_path):
    transform = rasterio.Affine(1e-5, 0, 5.4, 0, -1e-5, 43.2)
    image = write_image(tmp_path / "map.tif", transform=transform, crs=4326)
    write_rpc(rpc, tmp_path / "map.geom")
    assert read_rpc(image) == rpc


@pytest.mark.parametrize(
    ("tile", "origin"),
    [("", (0, 0)), ("_R1C1", (0, 0)), ("_R1C2", (2048, 0)), ("_R2C1", (0, 4096)), ("_R3C2", (2048, 8192))],
)
def test_a_tile_counts_by_the_size_of_its_product_s_tiles(tile, origin, rpc, tmp_path):
    image = write_image(tmp_path / f"IMG_scene{tile}.tif")
    (tmp_path / "RPC_scene.XML").write_text(dimap_v2(rpc))
    if origin != (0, 0):  # the first tile needs to know nothing of the others
        (tmp_path / "DIM_scene.XML").write_text('<Dimap><NTILES_SIZE nrows="4096" ncols="2048"/></Dimap>')
    source = read_rpc_source(image)
    np.testing.assert_allclose(source.rpc.image_offset, rpc.image_offset - origin, rtol=0, atol=1e-9)
    assert source.notes == (() if origin == (0, 0) else (f"tile origin {origin} applied",))


def test_an_image_without_an_rpc_says_so_and_a_missing_file_too(tmp_path):
    image = write_image(tmp_path / "plain.tif")
    with pytest.raises(ImageError, match=r"plain\.tif: no RPC in the image and none beside it"):
        read_rpc(image)
    with pytest.raises(ImageError, match="no such file"):
        read_rpc(tmp_path / "nothing.tif")
    with pytest.raises(ImageError, match="a folder"):
        read_rpc(tmp_path)


def test_a_file_is_read_by_its_content_whatever_its_name(rpc, tmp_path):
    write_rpc(rpc, tmp_path / "a.geom")
    shutil.copy(tmp_path / "a.geom", tmp_path / "a.RPB")
    assert read_rpc_source(tmp_path / "a.RPB").format == "geom"


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_a_file_that_may_not_be_read_is_an_error_in_one_line(rpc, tmp_path):
    write_rpc(rpc, tmp_path / "a.geom")
    (tmp_path / "a.geom").chmod(0)
    with pytest.raises((RpcError, ImageError), match=r"a\.geom"):
        read_rpc(tmp_path / "a.geom")


@pytest.mark.parametrize("name", [f"{STEM}.tif.rpb", f"{STEM}_RPB.TXT", f"{STEM}-RPC.txt"])
def test_a_side_file_that_gdal_does_not_look_for_is_found_where_the_image_has_no_rpc(name, rpc, tagged):
    other = rpc.crop(300, 400)
    text = FORMATS["rpb" if "rpb" in name.lower() else "txt"].write(other)
    (tagged.parent / name).write_text(text)
    assert seen_by_gdal(tagged).line_off == pytest.approx(rpc.image_offset[1])
    source = read_rpc_source(tagged)
    assert (source.rpc, source.notes) == (rpc, (f"not used: {name}",))
    plain = write_image(tagged)
    assert read_rpc_source(plain).rpc == other
    assert [sidecar.path.name for sidecar in shadows(plain)] == [name]


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("<a><NCOLS>40</NCOLS><NROWS> 30 </NROWS></a>", (40, 30)),
        ("<a><isd:NUMCOLUMNS>40</isd:NUMCOLUMNS><isd:NUMROWS>30</isd:NUMROWS></a>", (40, 30)),
        ("<a><NCOLS>40</NCOLS></a>", None),
        ("<a><NCOLS>40</NCOLS><NROWS>0</NROWS></a>", None),
        ("<a><NCOLS>12345678</NCOLS><NROWS>30</NROWS></a>", None),
    ],
)
def test_a_vendor_s_xml_says_how_large_its_image_is(tmp_path, text, size):
    (tmp_path / "a.xml").write_text(text)
    assert stated_in_xml(tmp_path / "a.xml") == (size, False)
    assert not only_physical(tmp_path / "a.xml")


def test_an_xml_without_an_rpc_may_hold_a_physical_camera(tmp_path, rpc):
    (tmp_path / "a.xml").write_text("<isd><ATT><ATTLIST>1 2</ATTLIST></ATT></isd>")
    (tmp_path / "b.xml").write_text(dimap_v2(rpc))
    assert [only_physical(tmp_path / name) for name in ("a.xml", "b.xml", "c.xml")] == [True, False, False]
    assert stated_in_xml(tmp_path / "a.xml") == (None, True)


@pytest.mark.parametrize(
    ("name", "text", "sensor"),
    [
        ("a.IMD", 'bandId = "P";\nsatId = "WV02";\n', "WV02_P"),
        ("a.IMD", 'satId = "QB02";\n', "QB02"),
        ("DIM_a.XML", "<MISSION>PHR</MISSION><MISSION_INDEX>1B</MISSION_INDEX><BANDID>PAN</BANDID>", "PHR1B_PAN"),
        ("DIM_a.XML", "<MISSION>SPOT 6/7</MISSION>", ""),
        ("DIM_a.XML", "<MISSION>SPOT 6.7</MISSION><BAND_ID>P</BAND_ID>", "SPOT-6-7_P"),
        ("a.IMD", 'bandId = "P";\nresatId = "WV02";\n', ""),
    ],
)  # fmt: skip
def test_a_sensor_is_named_by_its_satellite_and_band(name, text, sensor, tmp_path) -> None:
    (tmp_path / name).write_text(text)
    assert read_acquisition(tmp_path / "a.tif", tmp_path / name).sensor == sensor
