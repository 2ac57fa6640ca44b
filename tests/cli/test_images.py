"""Images by folder and pattern, cameras by name, and the configurations of other tools as lists of both."""

from __future__ import annotations

import json
import shutil
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.cli import main
from barpc.cli.specs import corrected, expanded, read_config, with_cameras
from barpc.errors import BarpcError, InputError
from barpc.raster import open_raster
from barpc.rpcio import WRITABLE, read_rpc, write_rpc, write_rpc_copy
from barpc.scene import View
from tests.pipeline.known import part
from tests.reliability.trials import SIDE
from tests.rpcio.conftest import make_rpc, write_image


def run(*args: object) -> int:
    with pytest.raises(SystemExit) as stop:
        main([str(arg) for arg in args])
    return int(stop.value.code or 0)


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


def dictionary(rpc) -> dict:
    return json.loads(WRITABLE["json"].write(rpc))["rpc"]


# --- folders and patterns ---------------------------------------------------------------------------------


def test_a_folder_stands_for_its_rasters_and_a_pattern_for_what_it_finds(folder):
    both = [str(folder / "images" / f"img {number}.tif") for number in (1, 2)]
    assert expanded([str(folder / "images")]) == both
    assert expanded([f"{folder}/images/img*.tif", "a.tif"]) == [*both, "a.tif"]
    assert expanded([f"{folder}/images/img?1.tif,band=2"]) == [f"{both[0]},band=2"]
    odd = folder / "images" / "img[1].tif"
    shutil.copy(both[0], odd)
    assert expanded([str(odd)]) == [str(odd)]  # a file of this whole name goes first
    assert expanded(["https://host/a*.tif"]) == ["https://host/a*.tif"]


def test_a_radar_product_stays_one(tmp_path):
    (tmp_path / "product").mkdir()
    (tmp_path / "product" / "manifest.safe").touch()
    assert expanded([str(tmp_path / "product")]) == [str(tmp_path / "product")]


def test_an_empty_folder_and_a_pattern_without_files_say_so(tmp_path):
    with pytest.raises(InputError, match="without images"):
        expanded([str(tmp_path)])
    with pytest.raises(InputError, match="no file has such a name"):
        expanded([str(tmp_path / "*.tif")])


def test_info_takes_a_folder(folder, tmp_path, capsys):
    for number in (1, 2):
        image = folder / "images" / f"img {number}.tif"
        write_rpc_copy(make_rpc().crop(900, 900), image, tmp_path / "with" / image.name)
    assert run("info", tmp_path / "with", "--alt", "100", "--json") == 0
    assert len(json.loads(capsys.readouterr().out)) == 2


# --- cameras by name --------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["{folder}/images/img 1.tif", "img 1.tif", "img 1"])
def test_a_camera_is_named_by_path_file_name_or_stem(key, folder):
    images = expanded([str(folder / "images")])
    file = folder / "cams" / "rpc_1.RPB"
    assert with_cameras(images, [f"{key.format(folder=folder)}={file}"]) == [
        f"{images[0]},camera={file}",
        images[1],
    ]


def test_a_camera_that_is_found_anyway_changes_nothing(folder):
    shutil.copy(folder / "cams" / "rpc_1.RPB", folder / "images" / "img 1.RPB")
    images = expanded([str(folder / "images")])
    assert with_cameras(images, [f"img 1={folder}/images/img 1.RPB"]) == images


@pytest.mark.parametrize(
    ("named", "message"),
    [
        (["img 3=x"], "none of the images"),
        (["img 1"], "none of the images"),
        (["img 1=x", "img 1.tif=y"], "a second camera"),
    ],
)
def test_a_camera_of_no_image_or_the_second_of_one_is_refused(named, message, folder):
    with pytest.raises(InputError, match=message):
        with_cameras(expanded([str(folder / "images")]), named)


def test_two_images_of_one_stem_need_their_paths():
    images = ["a/img.tif", "b/img.tif"]
    with pytest.raises(InputError, match="several images"):
        with_cameras(images, ["img=x.RPB"])
    assert with_cameras(images, ["b/img.tif=x.RPB"]) == ["a/img.tif", "b/img.tif,camera=x.RPB"]
    assert with_cameras(["c=d.tif", "c"], ["c=d.tif=x"]) == [
        "c=d.tif,camera=x",
        "c",
    ]  # the longest name has it


def test_check_takes_cameras_by_name(folder, capsys):
    images, cams = folder / "images", folder / "cams"
    (images / "damaged.tif").unlink()
    named = [f"--rpc=img {number}={cams / f'rpc_{number}.RPB'}" for number in (1, 2)]
    assert run("check", images, *named, "--against", cams / "rpc_1.RPB", "--json") == 3
    first, second = json.loads(capsys.readouterr().out)
    assert first["max_px"] < 1e-6
    assert second["max_px"] == pytest.approx(1.0, abs=1e-3)


# --- configurations ---------------------------------------------------------------------------------------


def s2p(folder: Path) -> Path:
    images = [
        {"img": "images/img 1.tif", "rpc": "cams/rpc_1.RPB"},
        {"img": "images/img 2.tif", "rpc": dictionary(read_rpc(folder / "cams" / "rpc_2.RPB"))},
    ]
    (folder / "config.json").write_text(
        json.dumps({"images": images, "out_dir": "out", "cld": "cams/rpc_1.RPB", "roi": {"x": 1.5}})
    )
    return folder / "config.json"


def test_a_configuration_of_s2p_lists_images_and_rpcs(folder):
    first, second = read_config("s2p", str(s2p(folder))).images()
    assert first == f"{folder}/images/img 1.tif,camera={folder}/cams/rpc_1.RPB"
    assert isinstance(second, View)
    assert second.size == (60, 40)
    assert read_rpc(folder / "cams" / "rpc_2.RPB").off(second.sensor).max() < 1e-9


def test_it_is_written_back_with_new_rpcs_and_paths_that_hold(folder):
    config, out = read_config("s2p", str(s2p(folder))), folder / "a" / "run"
    out.mkdir(parents=True)
    new = make_rpc().crop(3, 4)
    views = [View(f"img {n}", "", (60, 40), new, (0.0, 1.0)) for n in (1, 2)]
    found = json.loads(corrected(config, out, views))
    assert [image["rpc"] for image in found["images"]] == [dictionary(new)] * 2
    assert [(out / image["img"]).resolve() for image in found["images"]] == [
        (folder / "images" / f"img {n}.tif").resolve() for n in (1, 2)
    ]
    assert (out / found["cld"]).resolve() == (folder / "cams" / "rpc_1.RPB").resolve()
    assert (found["out_dir"], found["roi"]) == ("out", {"x": 1.5})


CARS = """input:
  sensors:
    one: {image: images/img 1.tif, geomodel: {path: cams/rpc_1.RPB, model_type: RPC}}
    two: {image: {bands: {b0: {path: images/img 2.tif, band: 0}}}, geomodel: cams/rpc_2.RPB}
  pairing: [[one, two]]
output: {directory: out, when: 2020-01-02}
"""


@pytest.mark.parametrize("kind", ["yaml", "json"])
def test_a_configuration_of_cars_is_read_and_written_back_as_it_came(kind, folder):
    yaml = pytest.importorskip("yaml")
    given = yaml.safe_load(CARS)
    given["output"]["when"] = "2020-01-02"
    path = folder / f"inputs.{kind}"
    path.write_text(CARS if kind == "yaml" else json.dumps(given))
    config = read_config("cars", str(path))
    assert config.images() == [f"{folder}/images/img {n}.tif,camera={folder}/cams/rpc_{n}.RPB" for n in (1, 2)]
    (folder / "run").mkdir()
    (folder / "run" / "x.vrt").touch()
    views = [View(name, "", (60, 40), make_rpc(), (0.0, 1.0)) for name in ("x", "y")]
    text = corrected(config, folder / "run", views)
    found = yaml.safe_load(text) if kind == "yaml" else json.loads(text)
    sensors = found["input"]["sensors"]
    assert sensors["one"] == {"image": "x.vrt", "geomodel": {"path": "x.geom", "model_type": "RPC"}}
    assert sensors["two"]["image"] == {"bands": {"b0": {"path": "../images/img 2.tif", "band": 0}}}
    assert found["input"]["pairing"] == [["one", "two"]]
    assert str(found["output"]["when"]) == "2020-01-02"


def test_sat_bundleadjust_says_where_images_and_rpcs_lie(folder):
    for number in (1, 2):
        (folder / "images" / f"img {number}.tif").rename(folder / "images" / f"img_{number}.tif")
        (folder / "rpcs").mkdir(exist_ok=True)
        write_rpc(make_rpc(), folder / "rpcs" / f"img_{number}.rpc")
    path = folder / "config.json"
    path.write_text(json.dumps({"input_dir": ".", "output_dir": "x"}))
    wanted = [f"{folder}/images/img_{n}.tif,camera={folder}/rpcs/img_{n}.rpc" for n in (1, 2)]
    assert read_config("sat-bundleadjust", str(path)).images() == wanted
    path.write_text(json.dumps({"geotiff_dir": "images", "rpc_dir": "rpcs", "rpc_src": "txt"}))
    assert read_config("sat-bundleadjust", str(path)).images() == wanted


DEEP = "[" * 100_000
DAMAGED = (
    "",
    "[]",
    "{}",
    "null",
    '{"images": 3}',
    '{"images": []}',
    '{"images": [{"rpc": "x"}]}',
    '{"images": [{"img": 3}]}',
    '{"images": [{"img": ""}]}',
    '{"images": [null]}',
    '{"images": NaN}',
    DEEP,
)


@pytest.mark.parametrize(
    ("ending", "tool", "text"),
    [
        # what reads YAML does not know the tool, and takes its time with depth
        pytest.param(*row, marks=[pytest.mark.slow] * (row[::2] == ("yaml", DEEP) and row[1] != "s2p"))
        for row in product(("json", "yaml"), ("s2p", "cars", "sat-bundleadjust"), DAMAGED)
    ],
)
def test_a_damaged_configuration_is_one_line_that_names_it(tool, text, ending, tmp_path):
    if ending == "yaml":
        pytest.importorskip("yaml")
    path = tmp_path / f"config.{ending}"
    path.write_text(text)
    with pytest.raises(InputError, match=r"config\.") as error:
        read_config(tool, str(path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("item", "message"),
    [
        ({"img": "https://host/a.tif"}, "allow-remote"),
        ({"img": "/vsicurl/http://host/a.tif"}, "virtual paths are not read"),
        ({"img": "/dev/zero"}, "device"),
        ({"img": "images/img 1.tif", "rpc": "/dev/zero"}, "device"),
        ({"img": "images/img 1.tif", "rpc": "https://host/a.RPB"}, "allow-remote"),
        ({"img": "images/img 1.tif", "rpc": {"row_num": [1]}}, "rpc of"),
        ({"img": "a\0b"}, "holds the character"),
    ],
)
def test_what_a_configuration_names_is_opened_as_carefully_as_all_else(item, message, folder, capsys):
    path = folder / "config.json"
    path.write_text(json.dumps({"images": [item, {"img": "images/img 2.tif", "rpc": "cams/rpc_2.RPB"}]}))
    assert run("adjust", "--from", "s2p", path, "-o", folder / "out") == 1
    assert message in capsys.readouterr().err
    assert not (folder / "out").exists()


def test_yaml_takes_no_aliases_and_says_what_it_needs(tmp_path, monkeypatch):
    pytest.importorskip("yaml")
    path = tmp_path / "a.yaml"
    path.write_text("a: &a [x, x]\nb: &b [*a, *a]\ninput: *b\n")
    with pytest.raises(InputError, match="alias"):
        read_config("cars", str(path))
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(InputError, match="PyYAML"):
        read_config("cars", str(path))


def test_images_come_from_one_place(folder, capsys):
    assert run("adjust", "--from", "s2p", s2p(folder), "a.tif", "-o", folder / "out") == 2
    shutil.move(folder / "config.json", folder / "summary.json")
    assert run("adjust", "--from", "s2p", folder / "summary.json", "-o", folder / "out") == 2
    assert "a file of this name itself" in capsys.readouterr().err


@pytest.fixture(scope="module")
def bare(tmp_path_factory) -> Path:
    """Parts of the repository's images without their RPCs, and a configuration of s2p that brings them."""
    folder = tmp_path_factory.mktemp("s2p")
    (folder / "with").mkdir()
    images = []
    for path in part(folder / "with", SIDE).images:
        with open_raster(path) as image:
            pixels = image.read()
        bare = write_image(folder / path.name, shape=pixels.shape, transform=rasterio.Affine(1, 0, 0, 0, -1, 9))
        with rasterio.open(bare, "r+") as out:
            out.write(pixels)
        images.append({"img": path.name, "rpc": dictionary(read_rpc(path))})
    (folder / "config.json").write_text(json.dumps({"images": images, "out_dir": "s2p"}))
    return folder


@pytest.mark.slow
def test_a_run_writes_the_corrected_configuration(bare, capsys):
    out = bare / "run"
    assert run("-q", "adjust", "--from", "s2p", bare / "config.json", "-o", out) == 0
    found = json.loads((out / "config.json").read_text())
    assert found["out_dir"] == "s2p"
    for image in found["images"]:
        name = Path(image["img"]).stem
        assert (out / image["img"]).resolve() == (bare / f"{name}.tif").resolve()
        assert dictionary(read_rpc(out / f"{name}_RPC.TXT")) == image["rpc"]
        delivered = read_rpc(bare / "with" / f"{name}.tif").off(read_rpc(out / f"{name}_RPC.TXT"))
        assert np.median(delivered) > 0.5
    assert len(found["images"]) == 3
    before = (out / "config.json").read_bytes()
    assert run("-q", "adjust", "--from", "s2p", bare / "config.json", "-o", out) == 1  # the folder is not empty
    assert (out / "config.json").read_bytes() == before
    capsys.readouterr()


def test_a_refused_camera_is_no_traceback(folder):
    with pytest.raises(BarpcError):
        read_config("s2p", str(folder / "none.json"))


# --- names and configurations, one branch after the other -------------------------------------------------


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
    ends = ".tif, .tiff, .ntf, .nitf, .nsf, .jp2, .j2k, .vrt"
    assert str(error.value) == f"{tmp_path}: a folder without images ({ends})"
    write_image(tmp_path / "B.TIF")
    assert expanded([str(tmp_path)]) == [str(tmp_path / "B.TIF")]


def test_a_camera_on_the_web_is_taken_as_named(folder):
    image = f"{folder}/images/img 1.tif"
    assert with_cameras([image], ["img 1=https://h/a.RPB"]) == [f"{image},camera=https://h/a.RPB"]
    assert with_cameras(["https://h/a.tif"], ["a=b.RPB"]) == ["https://h/a.tif,camera=b.RPB"]
    assert with_cameras([f"{image},band=2"], ["img 1=b.RPB"]) == [f"{image},band=2,camera=b.RPB"]
    assert with_cameras([image], []) == [image]


def listed(tool, folder, data, name="config.json"):
    (folder / name).write_text(json.dumps(data))
    return [(item.image, item.camera) for item in read_config(tool, str(folder / name)).items]


@pytest.mark.parametrize("rpc", [{}, {"rpc": None}, {"rpc": ""}])
def test_s2p_may_leave_the_camera_to_the_image(rpc, folder):
    assert listed("s2p", folder, {"images": [{"img": "a.tif", **rpc}]}) == [(f"{folder}/a.tif", None)]
    config = read_config("s2p", str(folder / "config.json"))
    assert config.images() == [f"{folder}/a.tif"]


def test_names_on_the_web_and_absolute_ones_stay(folder):
    data = {"images": [{"img": "https://h/a.tif", "rpc": "/b.RPB"}, {"img": "/c.tif", "rpc": {"row_num": 1}}]}
    assert listed("s2p", folder, data) == [("https://h/a.tif", "/b.RPB"), ("/c.tif", {"row_num": 1})]


@pytest.mark.parametrize("key", ["input", "inputs"])
def test_cars_spells_an_image_in_three_ways(key, folder):
    sensors = {
        "one": "a.tif",
        "two": {"image": {"main_file": "b.tif", "bands": {}}},
        "three": {"image": {"bands": {"x": {"path": "c.tif"}, "y": {"path": "d.tif"}}}, "geomodel": "c.geom"},
        "four": {"image": "e.tif", "geomodel": {"path": "e.geom"}},
    }
    assert listed("cars", folder, {key: {"sensors": sensors}}) == [
        (f"{folder}/a.tif", None),
        (f"{folder}/b.tif", None),
        (f"{folder}/c.tif", f"{folder}/c.geom"),
        (f"{folder}/e.tif", f"{folder}/e.geom"),
    ]


@pytest.mark.parametrize("source", [{}, {"rpc_src": "geotiff", "rpc_dir": "nowhere"}])
def test_sat_bundleadjust_may_find_rpcs_in_the_images(source, folder):
    found = listed("sat-bundleadjust", folder, {"geotiff_dir": "images", **source})
    assert found == [(f"{folder}/images/img {n}.tif", None) for n in (1, 2)]


def test_an_error_of_a_file_that_a_configuration_names_keeps_its_words(folder):
    with pytest.raises(InputError) as error:
        listed("sat-bundleadjust", folder, {"geotiff_dir": "cams"})
    assert str(error.value).startswith(f"{folder / 'cams'}: a folder without images")
    with pytest.raises(InputError, match=r"config\.json: not a configuration of s2p \(KeyError\('images'\)\)"):
        listed("s2p", folder, {})
    with pytest.raises(InputError, match="it lists no images"):
        listed("s2p", folder, {"images": []})
    (folder / "config.json").write_text("{,}")
    with pytest.raises(InputError, match=r"config\.json: not JSON that can be read"):
        read_config("s2p", str(folder / "config.json"))


def written_back(folder, data, tool="s2p", name="config.json", views=None):
    (folder / name).write_text(json.dumps(data))
    run_folder = folder / "a" / "run"
    run_folder.mkdir(parents=True, exist_ok=True)
    config = read_config(tool, str(folder / name))
    views = views or [View("v", "", (60, 40), make_rpc(), (0.0, 1.0))] * len(config.items)
    return json.loads(corrected(config, run_folder, views))


def test_names_of_files_that_are_there_hold_from_the_new_folder(folder):
    data = {
        "images": [{"img": "images/img 1.tif"}],
        "there": ["cams/rpc_1.RPB", {"deep": "cams"}],
        "other": ["cams/none.RPB", ".", "..", "", "a\0b", str(folder / "cams"), 1, 1.5, None, True],
    }
    found = written_back(folder, data)
    assert found["images"][0]["img"] == "../../images/img 1.tif"
    assert found["there"] == ["../../cams/rpc_1.RPB", {"deep": "../../cams"}]
    assert found["other"] == data["other"]


@pytest.mark.parametrize(("depth", "ok"), [(38, True), (39, True), (40, False)])
def test_a_configuration_is_at_most_forty_deep(depth, ok, folder):
    deep: object = 1
    for _ in range(depth):
        deep = [deep]
    data = {"images": [{"img": "images/img 1.tif"}], "deep": deep}
    if ok:
        assert written_back(folder, data)["deep"] == deep
    else:
        with pytest.raises(InputError, match="nested more than 40 deep"):
            written_back(folder, data)


@pytest.mark.parametrize(("end", "image"), [(".vrt", "v.vrt"), (".tif", "v.tif"), ("", "../../images/img 1.tif")])
def test_cars_gets_the_image_that_the_run_wrote(end, image, folder):
    (folder / "a" / "run").mkdir(parents=True)
    if end:
        (folder / "a" / "run" / f"v{end}").touch()
    found = written_back(folder, {"input": {"sensors": {"one": "images/img 1.tif"}}}, "cars")
    assert found["input"]["sensors"]["one"] == {
        "image": image,
        "geomodel": {"path": "v.geom", "model_type": "RPC"},
    }


def test_an_rpc_within_s2p_is_a_view_with_its_altitudes(folder):
    first, second = read_config("s2p", str(s2p(folder))).images()
    assert isinstance(first, str)
    assert (second.name, second.path) == ("img 2", f"{folder}/images/img 2.tif")
    assert second.alt_range == pytest.approx((166.6667 - 142.8571, 166.6667 + 142.8571), abs=1e-3)
