"""Vendors' files, and what independent tools make of them."""

from __future__ import annotations

import json
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import ImageError, RpcFormatError
from barpc.base.geodesy import Array
from barpc.pipeline.verify_outputs import CONSUMERS, verify
from barpc.rpcio import read_rpc, read_rpc_source, write_rpc, write_rpc_copy, write_rpc_vrt
from barpc.sensor.rpc import RPC, altitude_range
from barpc.sensor.sampler import Sample
from tests.lanes import rest_slow

PRINTED = 0.51e-7
"""The tables of truth have seven decimals [px]."""
ROUNDING = 1e-9
"""Against a tool that is here, number against number [px]."""
FIFTEEN_DIGITS = 2e-8
"""What a vendor's tag loses on the way through GDAL, which hands offsets on with fifteen digits [px]."""

EXPECTED = {
    "optical/phr_triplet_north/img_01.tif": "tag",
    "optical/phr_triplet_north/img_02.tif": "tag",
    "optical/phr_triplet_north/img_03.tif": "tag",
    "optical/phr_ventoux/RPC_PHR1B_P_201308051042194_SEN_690908101-001.XML": "dimap",
    "optical/phr_ventoux/left_image.geom": "geom",
    "optical/phr_ventoux/right_image.geom": "geom",
    "optical/phr_ventoux/right_image_bias.geom": "geom",
    "optical/qb2_single/qb2_basic1b.tif": "tag",
    "physical/RPC_P1BP--2017092838284574CP.XML": "dimap",
    "rpc_formats/20191015_073816_ssc1d3_0011_basic_l1a_panchromatic_dn_RPC.TXT": "txt",
    "rpc_formats/JAX_068_001_RGB.json": "json",
    "rpc_formats/PHR1B_P_201709281038045_SEN_PRG_FC_178608-001.geom": "geom",
    "rpc_formats/PHR1B_P_201709281038393_SEN_PRG_FC_178609-001.tif": "tag",
    "rpc_formats/RPC_PHR1B_P_201709281038045_SEN_PRG_FC_178608-001.XML": "dimap",
    "rpc_formats/WV02_10300100D0772D00.r100.xml": "xml",
    "rpc_formats/ikonos-1.geom": "geom",
    "rpc_formats/md_dg.RPB": "rpb",
    "rpc_formats/md_ov_rpc.txt": "txt",
    "rpc_formats/qb-1.geom": "geom",
    "rpc_formats/rpc_IKONOS.txt": "txt",
    "rpc_formats/rpc_PLANET_L1A.txt": "txt",
    "rpc_formats/rpc_PLEIADES.xml": "dimap",
    "rpc_formats/rpc_SPOT6.xml": "dimap",
    "rpc_formats/rpc_WV2.xml": "xml",
    "rpc_formats/wv3_20.NTF": "nitf",
}
_FIRST = list({kind: file for file, kind in reversed(EXPECTED.items())}.values())
ONE_OF_EACH = rest_slow([*_FIRST, *(file for file in EXPECTED if file not in _FIRST)], keep=len(_FIRST))
"""A file of each format before a commit."""


def table(shared_data: Path, file: str) -> dict[str, Array]:
    path = shared_data / "truth" / "rpc" / f"{file.replace('/', '__')}.csv"
    data = np.genfromtxt(path, delimiter=",", names=True)
    columns = {
        "ground": ("lon", "lat", "h"),
        "rpcm": ("rpcm_col", "rpcm_row"),
        "gdal": ("gdal_pixel", "gdal_line"),
    }
    columns["shareloc"] = ("shareloc_col", "shareloc_row")
    return {key: np.stack([data[n] for n in names], axis=-1) for key, names in columns.items()}


@pytest.mark.parametrize("file", EXPECTED)
def test_a_vendor_s_file_is_recognised_and_projects_as_three_independent_tools(file, shared_data):
    source = read_rpc_source(shared_data / file)
    assert source.format == EXPECTED[file]
    truth = table(shared_data, file)
    image = source.rpc.project(truth["ground"])
    compared = 0
    for tool, half in (("rpcm", 0.0), ("gdal", 0.5), ("shareloc", 0.5)):
        known = np.isfinite(truth[tool]).all(axis=1)
        if known.any():
            compared += 1
            largest = np.abs(image - (truth[tool] - half))[known].max()
            assert largest <= PRINTED + 1e-12 * np.abs(image).max(), tool
    assert compared >= 2


def test_every_file_that_holds_an_rpc_is_in_the_list(shared_data):
    index = json.loads((shared_data / "truth" / "rpc_index.json").read_text())
    readable = []
    for row in index["files"]:
        try:
            read_rpc(shared_data / row["file"])
        except (RpcFormatError, ImageError):
            continue
        readable.append(row["file"])
    beyond = {
        "optical/phr_ventoux/left_image.tif",  # the .geom beside it
        "optical/phr_ventoux/right_image.tif",
        "rpc_formats/rpc_unsupported.xml",  # a VRT
    }
    assert set(readable) == set(EXPECTED) | beyond


@pytest.mark.few(8)
@pytest.mark.parametrize("file", EXPECTED)
def test_number_against_number_rpcm_s_and_gdal_s_formulas_agree(file, shared_data, tmp_path):
    """Through a text file that both read, so that the vendor's syntax plays no part; no printed decimals."""
    pytest.importorskip("rpcm")
    rpc = read_rpc(shared_data / file)
    path = tmp_path / "scene_RPC.TXT"
    write_rpc(rpc, path)
    ground = table(shared_data, file)["ground"]
    image = rpc.project(ground)
    scale = np.maximum(1.0, np.abs(image) / 1e5)  # far outside the image a double has fewer decimals
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for tool in ("rpcm", "gdal, beside an image"):
            found = CONSUMERS[tool].open(path)(ground)
            assert (np.abs(found - image) / scale).max() <= ROUNDING, tool


NATIVE = {
    "rpcm": [f for f, kind in EXPECTED.items() if kind in ("tag", "dimap", "txt") or f.endswith("WV2.xml")],
    "gdal": [f for f, kind in EXPECTED.items() if kind in ("tag", "nitf")],
}


@pytest.mark.parametrize(("tool", "file"), [(tool, file) for tool, files in NATIVE.items() for file in files])
def test_number_against_number_the_vendor_s_own_file_reads_as_other_tools_read_it(tool, file, shared_data):
    """The spread over the box is the accuracy; SPOT 6 and Pleiades count from 1 in rpcm too."""
    rpcm = pytest.importorskip("rpcm.rpc_model")
    path = shared_data / file
    rpc = read_rpc(path)
    ground = table(shared_data, file)["ground"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if tool == "gdal":
            found = CONSUMERS["gdal"].open(path)(ground)
        else:
            model = rpcm.rpc_from_geotiff(str(path)) if EXPECTED[file] == "tag" else rpcm.rpc_from_rpc_file(str(path))
            found = np.column_stack(model.projection(*ground.T))
    image = rpc.project(ground)
    scale = np.maximum(1.0, np.abs(image) / 1e5)
    bound = FIFTEEN_DIGITS if EXPECTED[file] == "tag" else ROUNDING
    assert (np.abs(found - image) / scale).max() <= bound


@pytest.mark.few(3)
@pytest.mark.parametrize("file", ONE_OF_EACH)
def test_what_is_written_of_a_vendor_s_rpc_reads_the_same_in_every_tool(file, shared_data, tmp_path):
    rpc = read_rpc(shared_data / file)
    names = ["a_RPC.TXT", "a.RPB", "a.geom", "a.XML", "a.json"]
    for name in names:
        write_rpc(rpc, tmp_path / name)
    pixels = shared_data / "optical/phr_triplet_north/img_01.tif"
    write_rpc_vrt(rpc, pixels, tmp_path / "a.vrt")
    write_rpc_copy(rpc, pixels, tmp_path / "copy" / "a.tif")
    paths = [*(tmp_path / name for name in [*names, "a.vrt"]), tmp_path / "copy" / "a.tif"]
    readings = verify(paths, Sample.grid(rpc, _size(rpc), altitude_range(rpc)))
    assert {reading.path for reading in readings} == set(paths)
    for reading in readings:
        assert reading.max_error <= ROUNDING, reading


def _size(rpc: RPC) -> tuple[int, int]:
    """The image that an RPC's offsets speak of; for a crop that keeps the full scene's, its first pixels."""
    col, row = np.maximum(rpc.image_offset + np.abs(rpc.image_scale), 100.0)
    return int(min(col, 50000)), int(min(row, 50000))


def test_the_crop_of_ventoux_is_its_full_image_s_rpc_with_the_origin_taken_off(shared_data):
    folder = shared_data / "optical" / "phr_ventoux"
    source = read_rpc_source(folder / "left_image.tif")
    full = read_rpc(folder / "left_image.geom")
    np.testing.assert_array_equal(source.rpc.image_offset, full.image_offset - 5000)
    assert "crop origin (5000, 5000)" in source.notes[0]


def test_a_negative_row_step_gives_the_same_crop(shared_data):
    folder = shared_data / "optical" / "phr_ventoux"
    with tempfile.TemporaryDirectory() as temporary:
        beside = Path(temporary)
        (beside / "left_image_y_inverted.tif").symlink_to(folder / "left_image_y_inverted.tif")
        (beside / "left_image_y_inverted.geom").symlink_to(folder / "left_image.geom")
        assert read_rpc(beside / "left_image_y_inverted.tif") == read_rpc(folder / "left_image.tif")


def test_an_ikonos_geom_sees_ossim_s_points_where_ossim_does(shared_data):
    """OTB's points count from the first pixel's corner, to the digits of its file."""
    rpc = read_rpc(shared_data / "rpc_formats" / "ikonos-1.geom")
    rows = np.loadtxt(shared_data / "rpc_formats" / "ikonos-1.gcp")
    image = rpc.project(rows[:, 2:5])
    assert np.abs(image + 0.5 - rows[:, :2]).max() < 2e-5
