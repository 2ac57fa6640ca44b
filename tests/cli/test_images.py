"""Images by folder and pattern."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.cameras import open_camera
from barpc.cli.flags import image_paths
from barpc.rpcio import find_rpc, write_rpc, write_rpc_copy
from barpc.verbs.images import expanded
from tests.cli.test_main import run
from tests.rpcio.conftest import make_rpc, write_image


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two images without a camera in `images`, their RPCs under other names in `cams`."""
    (tmp_path / "images").mkdir()
    for number in (1, 2):
        write_image(tmp_path / "images" / f"img {number}.tif", shape=(1, 40, 60))
        write_rpc(make_rpc().crop(900, 900 + number), tmp_path / "cams" / f"rpc_{number}.RPB")
    (tmp_path / "images" / "notes.txt").write_text("no image")
    (tmp_path / "images" / "damaged.tif").write_text("no image either")
    return tmp_path


# --- folders and patterns ---------------------------------------------------------------------------------


def test_a_folder_stands_for_its_rasters_and_a_pattern_for_what_it_finds(folder):
    both = [str(folder / "images" / f"img {number}.tif") for number in (1, 2)]
    assert expanded([str(folder / "images")]) == both
    assert expanded([f"{folder}/images/img*.tif", "a.tif"]) == [*both, "a.tif"]
    odd = folder / "images" / "img[1].tif"
    shutil.copy(both[0], odd)
    assert expanded([str(odd)]) == [str(odd)]  # a file of this whole name goes first
    assert expanded(["https://host/a*.tif"]) == ["https://host/a*.tif"]


def test_a_radar_product_stays_one(tmp_path):
    (tmp_path / "product").mkdir()
    (tmp_path / "product" / "manifest.safe").touch()
    assert expanded([str(tmp_path / "product")]) == [str(tmp_path / "product")]


def test_a_pattern_without_files_says_so(tmp_path):
    with pytest.raises(InputError, match="no file has such a name"):
        expanded([str(tmp_path / "*.tif")])


def test_info_takes_a_folder(folder, tmp_path, capsys):
    for number in (1, 2):
        image = folder / "images" / f"img {number}.tif"
        write_rpc_copy(make_rpc().crop(900, 900), image, tmp_path / "with" / image.name)
    assert run("info", tmp_path / "with", "--alt", "100", "--json") == 0
    assert len(json.loads(capsys.readouterr().out)) == 2


# --- names, one branch after the other ----------------------------------------------------------------------


def test_an_empty_name_is_refused_and_a_point_is_the_folder(folder, monkeypatch):
    with pytest.raises(InputError, match="an empty name among the images"):
        expanded(["a.tif", ""])
    monkeypatch.chdir(folder / "images")
    assert expanded(["."]) == ["img 1.tif", "img 2.tif"]
    assert expanded(["./img*1.tif"]) == ["./img 1.tif"]


@pytest.mark.parametrize(
    ("spec", "found"),
    [
        ("{f}/img*1.tif,band=2,size=3:4", "{f}/img 1.tif,band=2,size=3:4"),
        ("{f}/img?1.tif,band=2", "{f}/img 1.tif,band=2"),
        ("{f}/none.tif,band=2", "{f}/none.tif,band=2"),
        ("{f}/img 1.tif,band=2", "{f}/img 1.tif,band=2"),
        ("https://host/x[1].tif,band=2", "https://host/x[1].tif,band=2"),
    ],
)
def test_choices_stay_behind_what_a_pattern_finds(spec, found, folder):
    f = folder / "images"
    assert expanded([spec.format(f=f)]) == [found.format(f=f)]


@pytest.mark.parametrize("name", ["S1A.SAFE", "s1a.safe"])
def test_a_product_is_known_by_its_folder_s_name_and_never_by_a_raster_in_it(name, folder):
    product = folder / name
    product.mkdir()
    shutil.copy(folder / "images" / "img 1.tif", product / "a.tiff")
    assert expanded([str(product)]) == [str(product)]


def test_a_folder_says_by_which_ends_images_are_known(tmp_path):
    (tmp_path / "a.png").write_bytes(b"x")
    (tmp_path / "deep.tif").mkdir()
    with pytest.raises(InputError) as error:
        expanded([str(tmp_path)])
    ends = ".tif, .tiff, .ntf, .nitf, .nsf, .jp2, .j2k, .pix, .img, .dat, .vrt"
    assert str(error.value) == f"{tmp_path}: a folder without images ({ends})"
    write_image(tmp_path / "B.TIF")
    assert expanded([str(tmp_path)]) == [str(tmp_path / "B.TIF")]


@pytest.mark.parametrize("name", ["S1A.zarr", "S1A.ZARR/", "store", "v3", "S1A.zarr.zip", "a.zarr,swath=iw1"])
@pytest.mark.parametrize("verb", ["info", "fit", "adjust", "match", "convert", "localize"])
def test_a_zarr_store_is_named_with_its_cure(verb, name, tmp_path, capsys):
    """EOPF's, by name or content; a folder of something else is not called so."""
    store = tmp_path / name.partition(",")[0]
    if name.endswith(".zip"):
        with zipfile.ZipFile(store, "w") as archive:
            archive.writestr(".zmetadata", "{}")
    else:
        (store / "measurements").mkdir(parents=True)
        (store / ("zarr.json" if name == "v3" else ".zmetadata" if name == "store" else "other")).write_text("{}")
    given = [str(tmp_path / name)]
    rest = {"adjust": ["-o", tmp_path / "o"], "match": ["-o", tmp_path / "o"], "convert": [tmp_path / "x_RPC.TXT"],
            "localize": ["1", "2"]}.get(verb, [])  # fmt: skip
    if verb in ("adjust", "match"):
        if name.endswith(".zip"):
            pytest.skip("one image is refused before it is opened")
        given.append(str(tmp_path / name))
    assert run(verb, *given, *rest) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "a Zarr store, which is not read: of Sentinel-1 take the same product as SAFE" in said
    assert not (tmp_path / "o").exists()


def test_another_folder_is_no_zarr_store(tmp_path, capsys):
    (tmp_path / "zarr").mkdir()
    assert run("info", tmp_path / "zarr") == 1
    assert "Zarr" not in capsys.readouterr().err


# --- lists ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", [".rpc", ".rpc_adj", ".json"])
def test_a_list_names_cameras_in_a_folder_of_their_own_wherever_it_is_read(folder, tmp_path, monkeypatch, layout):
    """As sets for bundle adjustment and neural surfaces come: rpcs/NAME.rpc, and JSON that holds more than an RPC."""
    lines = []
    for number in (1, 2):
        path = folder / "rpcs" / f"img {number}{layout}"
        write_rpc(make_rpc().crop(900, 900 + number), path)
        if layout == ".json":
            told = json.loads(path.read_text())
            more = {"img": f"img {number}.tif", "min_alt": 5, "keypoints": {"2d_coordinates": [[1.0, 2.0]]}}
            path.write_text(json.dumps({**more, "rpc": told.get("rpc", told)}))
        lines.append(f"images/img {number}.tif,camera=rpcs/{path.name}")
        assert find_rpc(path.parent, folder / "images" / f"img {number}.tif") == path
    lines.append(f"images/img 2.tif,camera={path.absolute()},size=60:40")
    (folder / "images.txt").write_text("\n".join(lines))
    (tmp_path / "elsewhere").mkdir()
    ground = make_rpc().localize([[930.0, 910.0]], 100.0)
    for place, listed in ((tmp_path / "elsewhere", folder / "images.txt"), (folder, "images.txt")):
        monkeypatch.chdir(place)
        cameras = [open_camera(path) for path in image_paths((), str(listed))]
        found = [camera.model.project(ground)[0] for camera in cameras]
        assert np.array(found) == pytest.approx(np.array([[30, 9], [30, 8], [30, 8]]), abs=1e-6)
