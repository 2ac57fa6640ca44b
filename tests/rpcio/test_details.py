"""What readers and writers decide by a number, a sign or a name: either side of each."""

from __future__ import annotations

import io
import json
import os
import re
import struct
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.base.errors import ImageError, InputError, OutputError, RpcError, RpcFormatError
from barpc.rpcio import FORMATS, read_rpc, read_rpc_source, write_rpc, write_rpc_copy, write_rpc_vrt
from barpc.rpcio.acquisition import Acquisition, read_acquisition
from barpc.rpcio.formats import files_of, find_rpc, format_for, parse_rpc, write_camera
from barpc.rpcio.grids import read_correction, write_correction, write_grid
from barpc.rpcio.images import (
    Directory,
    Entry,
    printable,
    put_tag,
    read_directory,
    read_tag,
    read_values,
    write_crop,
)
from barpc.rpcio.sources import hidden_by, metadata_beside, shadows, sidecars
from barpc.rpcio.text import collect_numbered, listed_numbers, number
from barpc.sensor.direct_grid import DirectGrid
from barpc.sensor.image_corrections import CorrectionGrid
from tests.rpcio.conftest import alos, dimap_v2, grid, make_rpc, pixels, write_image, yaml

# --- TIFF ------------------------------------------------------------------------------------------------------

KINDS = {
    1: 1,
    2: 1,
    3: 2,
    4: 4,
    5: 8,
    6: 1,
    7: 1,
    8: 2,
    9: 4,
    10: 8,
    11: 4,
    12: 8,
    13: 4,
    16: 8,
    17: 8,
    18: 8,
}
"""Types of TIFF 6.0 and BigTIFF: bytes of one value."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("big", [False, True])
def test_a_value_of_each_type_takes_its_bytes(kind: int, big: bool) -> None:
    """As many as fit stand in the entry itself, one more stands elsewhere."""
    width, room = KINDS[kind], 8 if big else 4
    data = bytes(range(1, 65))
    directory = Directory("<", big, (), b"")
    inside = room // width
    if inside:
        entry = Entry(1, kind, inside, data[:room])
        assert read_values(io.BytesIO(b""), directory, entry, "a") == data[: inside * width]
    place = struct.pack("<Q" if big else "<I", 16)
    entry = Entry(1, kind, inside + 1, place)
    assert read_values(io.BytesIO(bytes(16) + data), directory, entry, "a") == data[: (inside + 1) * width]


@pytest.mark.parametrize(
    ("count", "words"), [(1 << 24, "lies beyond the end"), ((1 << 24) + 1, "claims 16777217 bytes")]
)
def test_a_value_of_sixteen_megabytes_is_the_largest(count: int, words: str) -> None:
    with pytest.raises(RpcFormatError, match=words):
        read_values(io.BytesIO(b""), Directory("<", False, (), b""), Entry(7, 1, count, bytes(4)), "a")


@pytest.mark.parametrize(("count", "ok"), [(0, False), (1, True), (4096, True), (4097, False)])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("big", [False, True])
def test_a_directory_has_one_to_4096_entries(count: int, ok: bool, order: str, big: bool) -> None:
    mark = {"<": b"II", ">": b"MM"}[order]
    head = mark + struct.pack(f"{order}HHHQ", 43, 8, 0, 16) if big else mark + struct.pack(f"{order}HI8x", 42, 16)
    number_, entry = ("Q", "HHQQ") if big else ("H", "HHII")
    body = struct.pack(order + number_, count)
    body += b"".join(struct.pack(order + entry, 256 + k, 4, 1, k) for k in range(count))
    file = io.BytesIO(head + body + struct.pack(order + ("Q" if big else "I"), 77))
    if not ok:
        with pytest.raises(RpcFormatError, match=f"a TIFF directory of {count} entries"):
            read_directory(file, "a")
        return
    found = read_directory(file, "a")
    assert (found.order, found.big, len(found.entries)) == (order, big, count)
    assert found.entries[-1].tag == 255 + count
    assert struct.unpack(order + ("Q" if big else "I"), found.following) == (77,)
    assert found.find(256) == found.entries[0]
    assert found.find(9) is None


@pytest.mark.parametrize("options", [{}, {"BIGTIFF": "YES"}, {"ENDIANNESS": "BIG"}])
def test_a_tag_is_put_into_every_kind_of_tiff(options: dict[str, str], tmp_path: Path) -> None:
    """Behind the pixels, at a multiple of sixteen; its 92 numbers to the bit, an unknown accuracy as -1."""
    rpc = replace(make_rpc(), err_rand=None)
    path = write_image(tmp_path / "a.tif", **options)
    size = path.stat().st_size
    put_tag(path, rpc)
    assert read_tag(path) == rpc
    raw = path.read_bytes()
    order = "<" if raw[:2] == b"II" else ">"
    start = size + -size % 16
    values = struct.unpack(f"{order}92d", raw[start : start + 736])
    assert values[:2] == (3.1, -1.0)
    assert values[2:7] == (950.7, 999.1, 43.2, 5.4, 166.6667)
    assert values[7:12] == (980.9, 1010.3, 0.0045, 0.0062, 142.8571)
    np.testing.assert_array_equal(np.reshape(values[12:], (4, 20)), rpc.coeffs[[2, 3, 0, 1]])
    with path.open("rb") as file:
        tags = [entry.tag for entry in read_directory(file, "a").entries]
    assert tags == sorted(tags)


@pytest.mark.parametrize(("size", "ok"), [(0xFFFFFFFF - (1 << 16) - 15, True), (0xFFFFFFFF - (1 << 16) + 17, False)])
def test_a_classic_tiff_of_four_gigabytes_has_no_room_for_a_tag(size: int, ok: bool, tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.tif")
    os.truncate(path, size)  # a hole
    with nullcontext() if ok else pytest.raises(ImageError, match=f"does not fit behind {size} bytes of classic TIFF"):
        put_tag(path, make_rpc())
        assert read_tag(path) == make_rpc()
    assert (path.stat().st_size == size) != ok


def test_coefficients_make_up_for_digits_that_are_not_printed(monkeypatch) -> None:
    """Exaggerated: of nine digits, which by themselves move the image by a hundred times what is left."""
    from barpc.rpcio import images

    rng = np.random.default_rng(4)
    rpc = make_rpc()
    long = replace(
        rpc,
        coeffs=rpc.coeffs + rng.normal(0, 1e-2, (4, 20)) * (np.arange(20) > 0),
        ground_offset=rpc.ground_offset + [1.2345e-9, -1.9876e-8, 1.2345e-7],
        ground_scale=rpc.ground_scale * (1 + 3.3e-9),
        image_offset=rpc.image_offset + 4.4e-6,
        image_scale=rpc.image_scale * (1 + 2.2e-9),
    )
    monkeypatch.setattr(images, "_fifteen", lambda values: np.array([float(f"{v:.9g}") for v in values.tolist()]))
    short = printable(long)
    off = [
        np.abs(replace(short, **{name: getattr(long, name)}).project(grid(rpc)) - long.project(grid(rpc))).max()
        for name in ("ground_offset", "ground_scale", "image_offset", "image_scale")
    ]
    assert min(off) > 1e-7
    np.testing.assert_allclose(short.project(grid(rpc)), long.project(grid(rpc)), rtol=0, atol=1e-8)


# --- rasters ---------------------------------------------------------------------------------------------------


def test_a_vrt_of_a_vrt_points_at_the_image_and_shows_the_same_part(tmp_path: Path) -> None:
    path = tmp_path / "scene.vrt"
    write_rpc_vrt(make_rpc(), write_image(tmp_path / "scene.tif"), path)
    write_rpc_vrt(make_rpc(), path, tmp_path / "again.vrt")
    assert "scene.tif" in (tmp_path / "again.vrt").read_text()
    text = path.read_text()
    part = text.replace('<SrcRect xOff="0"', '<SrcRect xOff="1"')
    assert part != text
    path.write_text(part)
    write_rpc_vrt(make_rpc(), path, tmp_path / "again.vrt", overwrite=True)
    np.testing.assert_array_equal(pixels(tmp_path / "again.vrt"), pixels(path))


@pytest.mark.parametrize(
    ("window", "ok"),
    [
        ((0, 0, 60, 40), True), ((59, 39, 1, 1), True), ((-1, 0, 5, 5), False), ((0, -1, 5, 5), False),
        ((0, 0, 61, 5), False), ((0, 0, 5, 41), False), ((10, 10, 0, 5), False), ((10, 10, 5, 0), False),
    ],
)  # fmt: skip
def test_a_window_lies_within_the_image_and_has_pixels(window: tuple[int, ...], ok: bool, tmp_path: Path) -> None:
    image, rpc = write_image(tmp_path / "a.tif", shape=(2, 40, 60), dtype="float32", nodata=-1), make_rpc()
    col, row, width, height = window
    if not ok:
        with pytest.raises(ImageError, match="is not inside the image of 60 x 40"):
            write_crop(rpc, image, tmp_path / "b.tif", window)
        assert not (tmp_path / "b.tif").exists()
        return
    crop = write_crop(rpc, image, tmp_path / "b.tif", window)
    np.testing.assert_array_equal(pixels(tmp_path / "b.tif"), pixels(image)[:, row : row + height, col : col + width])
    assert crop.off(rpc.crop(col, row)).max() < 1e-9
    assert read_rpc(tmp_path / "b.tif") == crop


def test_no_writer_replaces_a_file_unless_it_is_told_to(tmp_path: Path) -> None:
    rpc, image = make_rpc(), write_image(tmp_path / "a.tif", dtype="uint8")
    none = CorrectionGrid([0.0, 59.0], [0.0, 39.0], np.zeros((2, 2, 2)))
    nodes = DirectGrid([0.0, 1.0], [0.0, 1.0], [0.0, 50.0], np.random.default_rng(0).uniform(5, 6, (2, 2, 2, 2)))
    path = tmp_path / "out"
    for write in (
        lambda **how: write_rpc(rpc, path, format="txt", **how),
        lambda **how: write_rpc_vrt(rpc, image, path, **how),
        lambda **how: write_rpc_copy(rpc, image, path, **how),
        lambda **how: write_crop(rpc, image, path, (0, 0, 5, 5), **how),
        lambda **how: write_correction(none, rpc, path, **how),
        lambda **how: write_grid(nodes, path, **how),
    ):
        path.write_text("mine")
        with pytest.raises(OutputError, match="exists"):
            write()
        assert path.read_text() == "mine"
        write(overwrite=True)
        assert path.read_bytes() != b"mine"


# --- files beside an image -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["IMG-01-SCENE.tif", "IMG-SCENE.tif"])
def test_the_text_of_an_alos_scene_goes_before_the_tag(name: str, tmp_path: Path) -> None:
    write_rpc_copy(make_rpc(), write_image(tmp_path / "plain.tif"), tmp_path / name)
    (tmp_path / "RPC-SCENE.txt").write_text(alos())
    source = read_rpc_source(tmp_path / name)
    assert source.format == "alos"
    assert source.notes == ("not used: the image's own RPC",)
    assert [s.kind for s in shadows(tmp_path / name)] == ["alos"]


@pytest.mark.parametrize(
    ("image", "beside"),
    [
        ("abcdefg.tif", "RPCg.txt"),
        ("abcd.tif", "RPCd.txt"),
        ("abcde.tif", "RPC_e.XML"),
        ("a_b_c_d.tif", "RPC_c.XML"),
    ],
)
def test_short_names_have_their_files_too(image: str, beside: str, tmp_path: Path) -> None:
    write_image(tmp_path / image)
    (tmp_path / beside).write_text(alos() if beside.endswith("txt") else dimap_v2(make_rpc()))
    assert [s.path.name for s in sidecars(tmp_path / image)] == [beside]


def test_beside_an_imd_only_maxar_s_own_files_go_before_the_tag(tmp_path: Path) -> None:
    image = write_image(tmp_path / "IMG_x.tif")
    (tmp_path / "IMG_x.IMD").write_text("x")
    write_rpc(make_rpc(), tmp_path / "IMG_x.RPB")
    write_rpc(make_rpc(), tmp_path / "IMG_x.XML")
    write_rpc(make_rpc(), tmp_path / "IMG_x_RPC.TXT")
    (tmp_path / "RPC_x.XML").write_text(dimap_v2(make_rpc()))
    write_rpc(make_rpc(), tmp_path / "IMG_x.rpc", format="txt")
    write_rpc(make_rpc(), tmp_path / "IMG_x.geom")
    told = [(s.kind, s.before_tag) for s in sidecars(image)]
    assert told == [
        ("rpb", True), ("xml", True), ("txt", False), ("dimap", False), ("txt", False), ("geom", False),
    ]  # fmt: skip
    (tmp_path / "IMG_x.IMD").unlink()
    assert [s.before_tag for s in sidecars(image)] == [True, True, True, True, True, False]


def test_files_that_would_hide_an_rpc_are_told_with_it(tmp_path: Path) -> None:
    rpc = make_rpc()
    write_rpc_copy(rpc, write_image(tmp_path / "bare.tif"), tmp_path / "tagged.tif")
    wanted = [tmp_path / n for n in ("TAGGED.rpb", "bare.RPB", "nothing.RPB", "tagged.tif")]
    told = list(hidden_by([*wanted, tmp_path / "no folder" / "a.RPB"]))
    assert told == [(wanted[0], tmp_path / "tagged.tif", rpc)]


def test_metadata_of_a_physical_model_lie_beside_the_image(tmp_path: Path) -> None:
    image = tmp_path / "IMG_scene_R1C1.TIF"
    with pytest.raises(ImageError, match=r"beside it \(IMG_scene_R1C1\.xml or dim_scene_R1C1\.xml\)"):
        metadata_beside(image)
    for name in (
        "DIM_scene.XML",
        "dim_scene_R1C1.xml",
        "img_SCENE_r1c1.XML",
    ):  # each goes before those already there
        (tmp_path / name).write_text("x")
        assert metadata_beside(image) == tmp_path / name


def test_the_origin_of_a_crop_has_a_step(tmp_path: Path) -> None:
    """Steps of two pixels halve the camera's; a geotransform that is none of a crop is refused."""
    write_rpc(make_rpc(), tmp_path / "crop.geom")
    image = write_image(tmp_path / "crop.tif", transform=rasterio.Affine(2.0, 0.0, 100.0, 0.0, 4.0, 60.0))
    assert read_rpc(image) == make_rpc().window(100.0, 60.0, 2.0, 4.0)
    image = write_image(tmp_path / "crop.tif", transform=rasterio.Affine(1.0, 0.0, 0.0, 0.0, -1.0, 0.0))
    assert read_rpc(image) == make_rpc()
    image = write_image(tmp_path / "crop.tif", transform=rasterio.Affine(-1.0, 0.0, 5.0, 0.0, 1.0, 0.0))
    with pytest.raises(RpcFormatError, match=r"no crop origin \(steps -1\.0, 1\.0\)"):
        read_rpc(image)


def test_a_folder_is_listed_again_when_it_changed_and_once_while_it_rests(tmp_path: Path, monkeypatch) -> None:
    """A change within two seconds may not show in the folder's time: it is listed anew until then."""
    listed: list[object] = []
    scan = os.scandir
    monkeypatch.setattr(os, "scandir", lambda folder: listed.append(folder) or scan(folder))
    now = time.time_ns()
    for name in ("B.tif", "a.TIF"):
        (tmp_path / name).touch()
    for age, times in ((1.0, 2), (3.0, 1)):
        os.utime(tmp_path, ns=(now, now - round(age * 1e9)))
        listed.clear()
        for _ in range(2):
            monkeypatch.setattr(time, "time_ns", lambda: now)
            assert files_of(tmp_path) == {"b.tif": "B.tif", "a.tif": "a.TIF"}
        assert len(listed) == times, age
    assert files_of(tmp_path / "nothing") == {}


def test_the_rpc_of_an_image_is_found_by_its_name_in_any_format(tmp_path: Path) -> None:
    image = Path("elsewhere/Scene.tif")
    with pytest.raises(InputError, match=r"no RPC of Scene\.tif there \(looked for Scene with \.vrt, \.tif"):
        find_rpc(tmp_path, image)
    for name in ("scene.geom", "scene_rpc.txt", "scene.vrt", "SCENE.TIF"):
        (tmp_path / name).touch()
        found = find_rpc(tmp_path, image)
        assert found.name in ("scene.geom", "scene_rpc.txt", "scene.vrt", "SCENE.TIF")
    assert found.name == "SCENE.TIF"


# --- texts ---------------------------------------------------------------------------------------------------------


def test_a_geom_of_another_polynomial_is_refused() -> None:
    text = FORMATS["geom"].write(make_rpc())
    for other in ("C", ""):
        with pytest.raises(RpcFormatError, match=f"order 'RPC00{other}', only RPC00A and RPC00B"):
            parse_rpc(text.replace("polynomial_format:  B", f"polynomial_format:  {other}").encode(), "m")
    silent = re.sub(r"polynomial_format:.*\n", "", text)
    assert silent != text
    assert parse_rpc(silent.encode(), "m")[0] == make_rpc()


def test_a_yaml_of_two_images_or_without_numbers() -> None:
    text = yaml(make_rpc())
    with pytest.raises(RpcFormatError, match="given twice; give a file of one image"):
        parse_rpc((text + text.replace("scene", "other")).encode(), "m")
    unknown = re.sub(r"err_bias: .*", "err_bias: null", text)
    unknown = re.sub(r"err_rand: .*", "err_rand: ~", unknown)
    found, _ = parse_rpc(unknown.encode(), "m")
    assert (found.err_bias, found.err_rand) == (None, None)
    dashes = re.sub(r"\[([^\]]*)\]", lambda m: "".join(f"\n        - {v.strip()}" for v in m[1].split(",")), text)
    assert parse_rpc(dashes.encode(), "m")[0] == make_rpc()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1.5", 1.5), ("+.5", 0.5), ("-2.", -2.0), ("1d3", 1000.0), ("1E-2 m", 0.01), ("7°", 7.0), ("7%", 7.0),
        ("+005124.00 pixels", 5124.0), ("-1.5D-03", -0.0015), ("1e3\tm", 1000.0),
    ],
)  # fmt: skip
def test_a_number_begins_its_text(text: str, value: float) -> None:
    assert number(text, "a", "K") == value


@pytest.mark.parametrize(
    "text", ["", "x", "1x", "1,2", ".", "1e", "--1", "0x10", "1_000", "12abc", "1.2.3", "nan", "inf", "-inf"]
)
def test_what_is_no_number_is_refused_by_name(text: str) -> None:
    with pytest.raises(RpcFormatError, match="a: K is not a number"):
        number(text, "a", "K")
    with pytest.raises(RpcFormatError, match="a: K is not finite"):
        number("1e999", "a", "K")


def test_lists_are_parted_by_blanks_and_commas() -> None:
    assert listed_numbers(" 1, 2  3,4,\n5 ,", "a", "K") == [1, 2, 3, 4, 5]


def test_numbered_coefficients_are_gathered_from_0_or_1_on() -> None:
    for first in (0, 1):
        pairs = [(f"LINE_NUM_COEFF_{i + first}", float(i)) for i in reversed(range(20))]
        assert collect_numbered([*pairs, ("LINE_OFF", 3.0)], "a") == {
            "LINE_OFF": [3.0], "LINE_NUM_COEFF": [float(i) for i in range(20)],
        }  # fmt: skip
        for missing in (0, 7, 19):
            with pytest.raises(RpcFormatError, match="LINE_NUM_COEFF has 19 coefficients"):
                collect_numbered(pairs[:missing] + pairs[missing + 1 :], "a")
        assert collect_numbered([*pairs, pairs[3]], "a")
        with pytest.raises(RpcFormatError, match=r"given twice, 3\.0 and 4\.0"):
            collect_numbered([("LINE_OFF", 3.0), ("LINE_OFF", 4.0)], "a")
    beyond = [(f"LINE_NUM_COEFF_{i}", float(i)) for i in range(21)]
    for pairs in (beyond, [(f"LINE_NUM_COEFF_{i}", float(i)) for i in range(2, 22)]):
        with pytest.raises(RpcFormatError, match=r"2. coefficients, expected 20, numbered from 0 or 1"):
            collect_numbered(pairs, "a")


@pytest.mark.parametrize(
    ("name", "row"),
    [("a_RPC.TXT", "txt"), ("a.rpc_adj", "txt"), ("A.rpb", "rpb"), ("a.JSON", "json"), ("a.doc", None)],
)
def test_the_end_of_a_name_tells_its_format(name: str, row: str | None) -> None:
    found = format_for(name)
    assert (found is None) if row is None else (found is FORMATS[row])


def test_a_camera_is_written_as_the_name_of_its_place_says(tmp_path: Path) -> None:
    image, rpc = write_image(tmp_path / "a.tif"), make_rpc()
    write_camera(rpc, tmp_path / "partial", image, place=tmp_path / "b.RPB")
    assert read_rpc_source(tmp_path / "partial").format == "rpb"
    with pytest.raises(OutputError, match="exists"):
        write_camera(rpc, tmp_path / "partial", image, place=tmp_path / "b.RPB")
    write_camera(rpc, tmp_path / "partial", image, place=tmp_path / "b.geom", overwrite=True)
    assert read_rpc_source(tmp_path / "partial").format == "geom"
    write_camera(rpc, tmp_path / "c.vrt", image)
    write_camera(rpc, tmp_path / "c.tif", image)
    for name in ("c.vrt", "c.tif"):
        assert read_rpc(tmp_path / name) == rpc
    with pytest.raises(RpcFormatError, match="choose one of txt"):
        write_camera(rpc, tmp_path / "b.doc", image)


def test_a_json_may_say_null_for_what_is_not_known() -> None:
    document = json.loads(FORMATS["json"].write(make_rpc()))
    document["rpc"]["err_bias"] = None
    assert parse_rpc(json.dumps(document).encode(), "m")[0] == make_rpc(err_bias=None)


# --- grids ---------------------------------------------------------------------------------------------------------


def correction() -> CorrectionGrid:
    cols, rows = np.linspace(-0.5, 999.5, 6), np.linspace(-0.5, 799.5, 5)
    shift = np.random.default_rng(0).normal(size=(5, 6, 2)).astype(np.float32)
    return CorrectionGrid(cols, rows, shift)


@pytest.mark.parametrize(("off", "ok"), [(0.8e-6, True), (1.3e-6, False)])
def test_nodes_are_even_to_a_millionth_of_a_step(off: float, ok: bool, tmp_path: Path) -> None:
    cols = np.linspace(-0.5, 999.5, 6)
    cols[2] += off * 200.0
    grid_ = DirectGrid(cols, [0.0, 1.0, 2.0], [0.0, 50.0, 100.0], np.random.default_rng(0).uniform(5, 6, (3, 3, 6, 2)))
    with nullcontext() if ok else pytest.raises(RpcError, match="not evenly spaced"):
        write_grid(grid_, tmp_path / "a_grid.tif")
        with rasterio.open(tmp_path / "a_grid.tif") as dataset:
            assert dataset.count == 6
            altitudes = [dataset.tags()[f"ALTITUDE_B{k}"] for k in range(6)]
            assert altitudes == np.repeat(["0.0", "50.0", "100.0"], 2).tolist()
            np.testing.assert_array_equal(dataset.read(3), grid_.lonlat[1, ..., 0])
            np.testing.assert_array_equal(dataset.read(6), grid_.lonlat[2, ..., 1])
            assert dataset.transform[:6] == pytest.approx((200.0, 0.0, 0.0, 0.0, 1.0, 0.5))


# --- the light -----------------------------------------------------------------------------------------------------


def test_the_sun_of_an_image_is_the_median_of_what_its_files_say(tmp_path: Path) -> None:
    image = tmp_path / "IMG_x_R1C1.TIF"
    assert read_acquisition(str(image)) == Acquisition()
    (tmp_path / "DIM_x.XML").write_text(
        "<IMAGING_DATE>2013-04-17</IMAGING_DATE><IMAGING_TIME>10:36:02.1Z</IMAGING_TIME>"
        + "".join(f'<SUN_ELEVATION unit="deg">{e}</SUN_ELEVATION><SUN_AZIMUTH unit="deg">{a}</SUN_AZIMUTH>'
                  for e, a in ((50.0, 140.0), (51.0, 150.0), (59.0, 141.0)))
    )  # fmt: skip
    assert read_acquisition(str(image)) == Acquisition(51.0, 141.0, "2013-04-17T10:36:02.1Z")
    (tmp_path / "IMG_x_R1C1.IMD").write_text(
        "meanSunEl = 33.5;\nmeanSunAz = 361.0;\nfirstLineTime = 2014-01-02T03:04:05Z;"
    )
    assert read_acquisition(str(image)) == Acquisition(33.5, 141.0, "2014-01-02T03:04:05Z")  # an azimuth within a turn
    (tmp_path / "IMG_x_R1C1.IMD").write_text("meanSunAz = -360;")
    assert read_acquisition(str(image)).azimuth == -360.0
    assert read_acquisition("https://host/IMG_x_R1C1.TIF") == Acquisition()
    assert read_acquisition("") == Acquisition()


@pytest.mark.parametrize(("day", "stated"), [("1957-01-01", True), ("1956-12-31", False)])
def test_no_image_was_taken_before_there_were_satellites(day: str, stated: bool, tmp_path: Path) -> None:
    (tmp_path / "a.IMD").write_text(f"firstLineTime = {day}T00:00:00Z;")
    assert read_acquisition(str(tmp_path / "a.tif")).time == (f"{day}T00:00:00Z" if stated else None)


@pytest.mark.parametrize(("rows", "words"), [(8192, "no correction grid"), (8193, "1073872896 bytes, too large for")])
def test_a_correction_grid_is_held_to_what_its_numbers_become(rows: int, words: str, tmp_path: Path) -> None:
    """Nodes are kept in four bytes and worked on in eight: a gigabyte of them is the most. None is written here."""
    path = tmp_path / "a_correction.tif"
    shape = {"width": 8192, "height": rows, "count": 2, "dtype": "float32", "SPARSE_OK": True}
    with rasterio.open(path, "w", driver="GTiff", transform=rasterio.Affine(2.0, 0.0, 0.0, 0.0, 2.0, 0.0), **shape):
        pass
    with pytest.raises(RpcFormatError, match=words):
        read_correction(path)
