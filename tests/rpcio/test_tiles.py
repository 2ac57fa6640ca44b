"""Tiles of a strip: one RPC for all of them, and where each lies said by Maxar's ``.TIL``."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.base.errors import ImageError, RpcFormatError
from barpc.cameras import open_camera
from barpc.rpcio import read_rpc, read_rpc_source, shadows, write_rpc, write_rpc_copy
from barpc.rpcio.sources import hidden_by
from tests.rpcio.conftest import dimap_v2, grid, write_image

CORNERS = {"R1C1": (0, 0), "R1C2": (50, 0), "R2C1": (0, 30), "R2C2": (50, 30)}
STRIP = "20JAN01-M2AS-01_P001"


def tile(folder: Path, place: str) -> Path:
    return folder / f"20JAN01-M2AS_{place}-01_P001.TIF"


def strip(folder: Path, rpc, end: str = ".RPB") -> Path:
    """Four tiles of different sizes, their list, the metadata, and the RPC of the whole, 90 x 70 px."""
    folder.mkdir(exist_ok=True)
    lines = ['bandId = "P";', "numTiles = 4;", 'tileUnits = "Pixels";']
    for n, (place, (left, top)) in enumerate(CORNERS.items(), start=1):
        width, height = (40 if left else 50), (40 if top else 30)
        write_image(tile(folder, place), (1, height, width), dtype="uint16")
        right, bottom = left + width - 1, top + height - 1
        corners = {"UL": (left, top), "UR": (right, top), "LR": (right, bottom), "LL": (left, bottom)}
        lines += [f"BEGIN_GROUP = TILE_{n}", f'\tfilename = "{tile(folder, place).name}";']
        for name, (col, row) in corners.items():
            lines += [f"\t{name}ColOffset = {col};", f"\t{name}RowOffset = {row};"]
        lines.append(f"END_GROUP = TILE_{n}")
    til = folder / f"{STRIP}.TIL"
    til.write_text("\n".join([*lines, "END;", ""]))
    (folder / f"{STRIP}.IMD").write_text(
        'version = "28.3";\nbandId = "P";\nnumRows = 70;\nnumColumns = 90;\nbitsPerPixel = 16;\n'
        'BEGIN_GROUP = IMAGE_1\n\tsatId = "WV02";\n'
        "END_GROUP = IMAGE_1\nEND;\n"
    )
    write_rpc(rpc, folder / f"{STRIP}{end}")
    return til


@pytest.mark.parametrize("end", [".RPB", ".XML", "_RPC.TXT"])
def test_a_tile_has_its_part_of_the_strip_s_rpc(end, rpc, tmp_path):
    strip(tmp_path / "in", rpc, end)
    for place, (left, top) in CORNERS.items():
        source = read_rpc_source(tile(tmp_path / "in", place))
        assert source.rpc == rpc.crop(left, top)
        assert source.path.name == f"{STRIP}{end}"
        assert source.notes == (() if place == "R1C1" else (f"tile origin ({left}, {top}) applied",))


def test_the_list_of_tiles_stands_for_the_mosaic_as_gdal_opens_it(rpc, tmp_path):
    til = strip(tmp_path / "in", rpc)
    camera = open_camera(til)
    assert (camera.model, camera.size) == (rpc, (90, 70))
    assert "a mosaic of 4 tiles" in camera.notes
    assert read_rpc(til) == rpc
    with rasterio.open(til) as dataset:
        assert (dataset.width, dataset.height) == camera.size
        assert dataset.rpcs.samp_off == rpc.image_offset[0]
    (tmp_path / "in" / f"{STRIP}.RPB").unlink()
    with pytest.raises(ImageError, match="no RPC in the image and none beside it"):
        open_camera(til)


def test_the_strip_s_rpc_given_for_a_tile_is_taken_at_the_tile_s_place(rpc, tmp_path):
    til = strip(tmp_path / "in", rpc)
    image, beside = tile(tmp_path / "in", "R2C2"), til.with_suffix(".RPB")
    (tmp_path / "far").mkdir()
    elsewhere = [tmp_path / "far" / name for name in (beside.name, "renamed.RPB", f"{STRIP.lower()}_rpc.txt")]
    for path in elsewhere:
        write_rpc(rpc, path)
    for holder in (beside, til, *elsewhere):
        camera = open_camera(image, camera=holder)
        assert camera.model == rpc.crop(50, 30), holder
        assert camera.size == (40, 40)
        assert "tile origin (50, 30) applied" in camera.notes
    assert open_camera(tile(tmp_path / "in", "R1C1"), camera=beside).model == rpc


def test_another_rpc_given_for_a_tile_is_its_own_and_said_to_be(rpc, tmp_path):
    strip(tmp_path / "in", rpc)
    own, better = rpc.crop(50, 0), tmp_path / "better.RPB"
    write_rpc(own, better)
    camera = open_camera(tile(tmp_path / "in", "R1C2"), camera=better)
    assert (camera.model, camera.size) == (own, (40, 30))
    assert camera.notes == (f"taken as the RPC of this tile alone, not of its strip {STRIP}",)
    named = tmp_path / f"{tile(tmp_path, 'R1C2').stem}_RPC.TXT"
    write_rpc(own, named)
    camera = open_camera(tile(tmp_path / "in", "R1C2"), camera=named)
    assert (camera.model, camera.notes) == (own, ())


def test_a_tile_s_own_rpc_goes_before_the_strip_s(rpc, tmp_path):
    strip(tmp_path / "in", rpc)
    image, own = tile(tmp_path / "in", "R1C2"), rpc.crop(1, 2)
    tagged = tmp_path / "tagged.tif"
    write_rpc_copy(own, image, tagged)
    shutil.copy(tagged, image)
    source = read_rpc_source(image)
    assert (source.rpc, source.format) == (own, "tag")
    assert source.notes == (f"not used: {STRIP}.RPB",)
    assert not shadows(image)
    assert [hidden.name for _, hidden, _ in hidden_by([tmp_path / "in" / f"{STRIP}.XML"])] == [f"{STRIP}.TIL"]
    write_rpc(rpc.crop(3, 4), image.with_suffix(".RPB"))
    assert read_rpc(image) == rpc.crop(3, 4)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda text: text.replace("_R1C2-", "_R9C9-"), r"lists no tile .*_R1C2-.* of 40 x 30 px"),
        (
            lambda text: text.replace("URColOffset", "x").replace("LRColOffset = 89", "LRColOffset = 90"),
            "lists no tile",
        ),
        (lambda text: text.replace("ULRowOffset = 0", "ULRowOffset = -1"), "tile 1 has no file name, or no corners"),
        (lambda text: text.replace("ULRowOffset = 30", "ULRowOffset = 30.5"), "tile 3 has no file name, or no corners"),
        (lambda text: text.replace("filename", "name"), "tile 1 has no file name"),
        (lambda text: None, r"the RPC of a strip, and where its tile .* lies is not known: .*\.TIL is missing"),
    ],
)
def test_a_tile_whose_place_is_not_known_is_refused(change, what, rpc, tmp_path):
    til = strip(tmp_path / "in", rpc)
    changed = change(til.read_text())
    til.unlink() if changed is None else til.write_text(changed)
    image = tile(tmp_path / "in", "R1C2")
    with pytest.raises(RpcFormatError, match=what):
        read_rpc(image)
    with pytest.raises(RpcFormatError, match=what):
        open_camera(image, camera=tmp_path / "in" / f"{STRIP}.RPB")
    if changed is None:
        assert read_rpc(tile(tmp_path / "in", "R1C1")) == rpc


@pytest.mark.parametrize("name", ["IMG_A_R2C2.TIF", "IMG_A_MS_R2C2.TIF"])
def test_the_rpc_of_a_dimap_product_given_for_a_tile_is_taken_at_its_place_too(name, rpc, tmp_path):
    product = name[4:].rpartition("_")[0]
    image = write_image(tmp_path / name)
    given = tmp_path / "given" / f"RPC_{product}.XML"
    given.parent.mkdir()
    given.write_text(dimap_v2(rpc))
    with pytest.raises(RpcFormatError, match=r"tile size of .* is unknown"):
        open_camera(image, camera=given)
    (tmp_path / f"DIM_{product}.XML").write_text('<a><NTILES_SIZE nrows="300" ncols="200"/></a>')
    camera = open_camera(image, camera=given)
    np.testing.assert_allclose(camera.model.project(grid(rpc)), rpc.crop(200, 300).project(grid(rpc)), atol=1e-9)
    assert camera.notes == ("tile origin (200, 300) applied",)


def test_the_case_from_the_field(shared_data):
    folder = shared_data / "field_cases" / "til"
    if not folder.is_dir():
        pytest.skip("no field cases in the shared data")
    (second,) = folder.glob("*_R1C2*.TIF")
    (rpb,) = folder.glob("*.RPB")
    assert read_rpc(second).image_offset.tolist() == [99.5, 199.5]
    assert open_camera(second, camera=rpb).rpc.image_offset.tolist() == [99.5, 199.5]
    (til,) = folder.glob("*.TIL")
    assert open_camera(til).size == (200, 200)
