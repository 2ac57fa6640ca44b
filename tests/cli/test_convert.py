"""What `barpc convert` refuses, cuts out and says, on files of a few hundred pixels."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.windows import Window

from barpc.base.errors import InputError, OutputError, Remark, UsageError
from barpc.cameras import open_camera
from barpc.pipeline.verify_outputs import Reading
from barpc.rpcio import read_rpc, write_rpc, write_rpc_copy
from barpc.scene import Camera
from barpc.sensor.sampler import Scattered
from barpc.verbs import converting as module
from barpc.verbs.converting import Converted, box_of, check_target, convert, window_of
from tests.cli.test_main import run
from tests.cli.test_terrain import Map
from tests.reliability.conftest import assert_one_line, barpc
from tests.rpcio.conftest import make_rpc

NAN = float("nan")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_rpc(make_rpc(), tmp_path / "cams" / "a.RPB")
    return tmp_path / "cams" / "a.RPB"


# --- the command line -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["a", "-o", "d", "--window", "0", "0", "1", "1"], "--window goes with a TARGET, not with -o"),
        (["a", "-o", "d", "--bbox", "0", "0", "1", "1", "--images", "vrt"], "--images goes with whole images"),
        (["a"], "give SOURCE and TARGET, or images and -o DIR"),
        (["a", "b", "c"], "give SOURCE and TARGET, or images and -o DIR"),
        (["a", "b", "--rpc", "c"], "give SOURCE and TARGET, or images and -o DIR"),
        (["a", "b", "--images", "copy"], "give SOURCE and TARGET, or images and -o DIR"),
        ([], "Missing argument"),
    ],
)
def test_what_does_not_go_together_is_wrong_usage(words: list[str], told: str) -> None:
    assert_one_line(barpc("convert", *words), 2, told)


def test_the_help_lists_the_formats(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("convert", "--help") == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "Of txt (_RPC.TXT)," in text
    assert "Without: that of TARGET's name; in a folder txt." in text


def test_an_rpc_is_copied_as_it_is_and_read_back(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = file.parent / "b.geom"
    assert run("convert", str(file), str(target)) == 0
    said = capsys.readouterr()
    assert said.out == f"{file} (rpb) -> {target} (read back: 0 px)\n"
    assert said.err == ""
    assert read_rpc(target) == read_rpc(file)
    assert run("convert", str(file), str(target)) == 1
    assert run("convert", str(file), str(target), "--overwrite", "--json") == 0
    row = json.loads(capsys.readouterr().out)
    assert row == {"source": str(file), "format": "rpb", "target": str(target), "max_px": 0.0}


def test_a_format_may_be_named(file: Path) -> None:
    target = file.parent / "c_RPC.TXT"
    assert run("convert", str(file), str(target), "--rpc-format", "txt") == 0
    assert read_rpc(target) == read_rpc(file)
    other = file.parent / "odd.txt"
    assert run("convert", str(file), str(other), "--rpc-format", "txt") == 0
    assert "LINE_OFF" in other.read_text()
    assert run("convert", str(file), str(other), "--rpc-format", "txt") == 1
    assert run("convert", str(file), str(other), "--rpc-format", "txt", "--overwrite") == 0


def test_what_reads_back_elsewhere_ends_with_3(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for shift, code in ((0.9e-6, 0), (1.1e-6, 3)):
        monkeypatch.setattr(module, "read_rpc", lambda path, shift=shift: read_rpc(path).crop(shift, 0))
        assert run("convert", str(file), str(file.parent / f"{code}.geom")) == code
        assert ("another RPC file beside it" in capsys.readouterr().err) == (code == 3)


def test_notes_of_a_camera_are_told_but_not_beside_json(
    image: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for suffix in (".RPB", "_RPC.TXT"):
        write_rpc(read_rpc(image), image.with_name(f"scene{suffix}"))
    assert run("convert", str(image), str(tmp_path / "b.geom")) == 0
    told = capsys.readouterr().err
    assert told.startswith("barpc: not used: ")
    assert told.count("\n") == 1
    assert run("convert", str(image), str(tmp_path / "c.geom"), "--json") == 0
    assert capsys.readouterr().err == ""


# --- targets ----------------------------------------------------------------------------------------------


def test_no_input_is_ever_replaced(image: Path, tmp_path: Path) -> None:
    write_rpc(make_rpc(), image.with_suffix(".RPB"))
    for target in (image, image.with_suffix(".RPB"), image.parent / ".." / "in" / "scene.tif"):
        with pytest.raises(OutputError, match="belongs to the input and is never replaced"):
            check_target(target, [image], overwrite=True)
    check_target(tmp_path / "new.tif", [image], overwrite=False)


def test_a_file_that_would_be_read_in_place_of_an_rpc_is_refused_or_told(image: Path, file: Path) -> None:
    target = image.with_suffix(".RPB")  # of an image that is no input here
    with pytest.raises(OutputError, match="would be read in place of the RPC that") as error:
        check_target(target, [file], overwrite=False)
    assert str(image) in str(error.value)
    with pytest.warns(Remark, match=f"{target} is read in place of the RPC that {image} had"):
        check_target(target, [file], overwrite=True)
    check_target(target, [file], overwrite=False, rpc=read_rpc(image))  # the same: nothing changes
    with pytest.raises(OutputError):
        check_target(target, [file], overwrite=False, rpc=make_rpc())


def test_an_image_may_get_its_own_rpc_as_a_file_beside_it(image: Path) -> None:
    beside = image.with_suffix(".RPB")
    assert run("convert", str(image), str(beside)) == 0
    assert read_rpc(beside).off(make_rpc().crop(900, 900)).max() < 1e-6


# --- windows ----------------------------------------------------------------------------------------------


CAMERA = Camera(Map(lean=1.0), Path("flat"), "rpb", (200, 100), (0.0, 2000.0))


def window(bbox: Any, alt: float | None = 0.0, dem: Any = None, camera: Camera = CAMERA) -> Any:
    return window_of(camera, Path("flat.tif"), bbox, alt, dem)


@pytest.mark.parametrize(
    ("bbox", "expected"),
    [
        ((10.1, 49.6, 10.3, 49.8), (10, 20, 21, 21)),  # columns 10 to 30, rows 20 to 40, whole pixels
        ((10.104, 49.604, 10.296, 49.796), (10, 20, 21, 21)),
        ((10.106, 49.594, 10.304, 49.796), (11, 20, 20, 22)),
    ],
)
def test_a_box_is_cut_to_the_pixels_that_it_touches(
    bbox: Any, expected: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert window(bbox) == expected
    assert capsys.readouterr().err == ""


def test_a_box_moves_with_its_altitude_and_a_dem() -> None:
    assert window((10.1, 49.6, 10.3, 49.8), alt=7000.0) == (17, 20, 21, 21)
    slope = window((10.1, 49.6, 10.3, 49.8), dem=lambda lon, lat: 1e5 * (lon - 10.1) + 0 * lat)
    assert slope == (10, 20, 41, 21)


def test_a_box_beyond_the_image_is_cut_off_and_told() -> None:
    with pytest.warns(Remark, match=r"^flat.tif: --bbox reaches beyond the image; 76 % of it is cut off$"):
        assert window((9.894, 49.756, 10.094, 50.254)) == (0, 0, 10, 25)  # of 21 x 50


@pytest.mark.parametrize("bbox", [(12.1, 49.6, 12.3, 49.8), (10.1, 48.0, 10.3, 48.9), (9.5, 49.6, 9.9, 49.8)])
def test_a_box_beside_the_image_is_wrong_usage(bbox: Any) -> None:
    with pytest.raises(UsageError, match=r"does not meet flat \(ground at 5 m\)"):
        window(bbox, alt=5.0)


def test_a_box_may_lie_across_the_antimeridian() -> None:
    class East(Map):
        def project(self, ground: Any) -> np.ndarray:
            return super().project(ground - [169.5, 0, 0])

    camera = replace(CAMERA, model=East(lean=1.0))  # from 179.5 E
    assert window((179.8, 49.6, -179.8, 49.8), camera=camera) == (30, 20, 41, 21)


def test_a_window_stands_alone(image: Path, tmp_path: Path) -> None:
    for both in (
        {"window": (1, 2, 3, 4), "bbox": (0.0, 0.0, 1.0, 1.0)},
        {"bbox": (0.0,) * 4, "aoi": "a"},
        {"window": (1, 2, 3, 4), "aoi": "a"},
    ):
        with pytest.raises(UsageError, match="give one of --window, --bbox and --aoi"):
            convert(image, tmp_path / "part.tif", **both)
    assert convert(image, tmp_path / "part.tif", window=(1, 2, 3, 4)).window == (1, 2, 3, 4)


# --- a part of the ground out of many images --------------------------------------------------------------


def an_area(path: Path, west: float, south: float, east: float, north: float) -> Path:
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    return path


@pytest.mark.parametrize(
    "box",
    [(5.25, 43.0, 5.5, 43.5), (-10.0, -1.0, 10.0, 1.0), (179.5, 10.0, 180.0, 11.0), (0.0, 0.0, 180.0, 1.0)],
)
def test_the_box_around_an_area_is_its_own(box: Any, tmp_path: Path) -> None:
    assert box_of(str(an_area(tmp_path / "a.geojson", *box))) == pytest.approx(box)


def test_the_box_around_an_area_on_the_180th_meridian_is_not_the_earth(tmp_path: Path) -> None:
    west, south, east, north = box_of(str(an_area(tmp_path / "a.geojson", 179.75, 10.0, 180.5, 11.0)))
    assert (west, south, east, north) == pytest.approx((179.75, 10.0, -179.5, 11.0))


@pytest.fixture
def four(image: Path, tmp_path: Path) -> tuple[list[str], tuple[float, float, float, float]]:
    """Three images of a place and one of another, and a box of some sixty pixels in the first three."""
    rpc, paths = read_rpc(image), []
    for k in range(4):
        path = tmp_path / f"in/view_{k}.tif"
        moved = replace(rpc, ground_offset=rpc.ground_offset + [1.0 * (k == 3), 0.0, 0.0])
        write_rpc_copy(moved, tmp_path / "raw.tif", path)
        paths.append(str(path))
    lon, lat, _ = rpc.localize(np.array([[100.0, 100.0]]), np.array([rpc.ground_offset[2]]))[0]
    return paths, (lon - 1e-4, lat - 1e-4, lon + 1e-4, lat + 1e-4)


def test_a_box_is_cut_out_of_every_image_that_shows_it(
    four: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths, box = four
    before = {path: Path(path).read_bytes() for path in paths}
    words = ["convert", *paths, "-o", tmp_path / "crops", "--bbox", *box, "--rpc-format", "txt"]
    assert run(*words) == 0
    said = capsys.readouterr()
    found = sorted(p.name for p in (tmp_path / "crops").iterdir() if not p.name.startswith("."))
    assert found == sorted(f"view_{k}{end}" for k in range(3) for end in (".tif", "_RPC.TXT"))
    assert f"{paths[3]} is left out" in said.err
    for k in range(3):
        crop, whole = read_rpc(tmp_path / f"crops/view_{k}.tif"), read_rpc(paths[k])
        ground = np.array([[*np.reshape(box, (2, 2)).mean(axis=0), whole.ground_offset[2]]])
        col, row = np.rint(whole.image_offset - crop.image_offset).astype(int)
        assert np.allclose(crop.project(ground) + [col, row], whole.project(ground), atol=1e-6)
        with rasterio.open(tmp_path / f"crops/view_{k}.tif") as cut, rasterio.open(paths[k]) as full:
            assert max(cut.shape) < 120
            pixels = full.read(window=Window(col, row, cut.width, cut.height))
            assert np.array_equal(cut.read(), pixels)
        text = read_rpc(tmp_path / f"crops/view_{k}_RPC.TXT")
        assert np.allclose(text.project(ground), crop.project(ground), atol=1e-6)
    assert {path: Path(path).read_bytes() for path in paths} == before
    assert run(*words) == 1  # the folder is another's now
    assert run(*words, "--overwrite") == 0


def test_an_area_that_no_image_shows_leaves_no_folder(
    four: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths, _ = four
    area = an_area(tmp_path / "a.geojson", 100.0, 10.0, 100.1, 10.1)
    assert run("convert", *paths, "-o", str(tmp_path / "crops"), "--aoi", str(area)) == 2
    assert "no image covers the area to be cut out" in capsys.readouterr().err
    assert not (tmp_path / "crops").exists()


def test_a_window_is_cut_and_told(image: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--window", "50", "60", "100", "80")
    target = str(tmp_path / "w.tif")
    assert run("convert", str(image), target, *words) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"{target}: col 50, row 60, 100 x 80 px (read back: ")
    np.testing.assert_allclose(read_rpc(target).image_offset, read_rpc(image).image_offset - [50, 60], atol=1e-9)
    with rasterio.open(target) as cut:
        assert (cut.width, cut.height) == (100, 80)
    assert run("convert", str(image), target, *words) == 1
    assert run("convert", str(image), target, *words, "--overwrite", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found.pop("max_px") < 1e-9
    assert found == {"path": target, "window": [50, 60, 100, 80]}
    assert run("convert", image, tmp_path / "x.tif", "--window", 590, 0, 100, 80) == 1
    assert not (tmp_path / "x.tif").exists()


@pytest.mark.parametrize("name", ["w.vrt", "w.ntf", "w.png", "w_RPC.TXT", "w"])
def test_a_window_goes_into_no_file_whose_name_says_another_kind(name, image, tmp_path, capsys):
    assert run("convert", str(image), str(tmp_path / name), "--window", "50", "60", "100", "80") == 2
    assert "ends in .tif, .tiff" in capsys.readouterr().err
    assert not (tmp_path / name).exists()


# --- grids ------------------------------------------------------------------------------------------------


def test_a_camera_goes_into_a_grid_and_back(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = file.parent / "a_grid.tif"
    assert run("convert", f"{file},size=600:500", str(target)) == 0
    said = capsys.readouterr()
    assert all(line.startswith(f"{target}: ") and line.endswith(" px") for line in said.out.splitlines())
    assert said.err == ""
    grid = open_camera(str(target)).model
    at = np.array([[100.0, 200.0], [550.0, 30.0]])
    np.testing.assert_allclose(grid.localize(at, 150.0), make_rpc().localize(at, 150.0), atol=1e-3)
    assert run("convert", f"{file},size=600:500", str(target)) == 1  # exists


def test_a_grid_goes_into_an_rpc_where_one_holds_it(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    grid, target = file.parent / "a_grid.tif", file.parent / "back.geom"
    assert run("convert", f"{file},size=600:500", str(grid)) == 0
    capsys.readouterr()
    assert run("convert", str(grid), str(target)) == 0
    (told,) = capsys.readouterr().err.splitlines()
    assert told.startswith(f"barpc: {grid}: grid, fitted to ")
    at = np.array([[100.0, 200.0], [550.0, 30.0]])
    seen = read_rpc(target).project(make_rpc().localize(at, 150.0))
    np.testing.assert_allclose(seen, at, atol=2e-2)
    assert_one_line(barpc("convert", grid, grid, "--overwrite"), 1, "belongs to the input and is never replaced")
    assert_one_line(barpc("convert", file, file, "--overwrite"), 1, "belongs to the input and is never replaced")
    poor = type("Fit", (), {"verdict": lambda self, tolerance: f"misses {tolerance == options.tolerance}"})()
    options = module.FitOptions()
    monkeypatch.setattr("barpc.verbs.moving.fit_rpc", lambda *_, **__: poor)
    assert run("convert", str(grid), str(file.parent / "none.geom")) == 1
    assert f"{grid}: misses True ('barpc fit --keep-going' writes it" in capsys.readouterr().err
    assert not (file.parent / "none.geom").exists()


@pytest.mark.parametrize(("worst", "code"), [(0.009, 0), (0.011, 3), (NAN, 3)])
def test_a_grid_that_does_not_hold_the_camera_ends_with_3(
    worst: float, code: int, file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    worst = worst / 0.01 * module.LINEAR
    reading = Reading(Path("x"), "gdal", worst, "" if worst == worst else "not read")
    monkeypatch.setattr(module, "verify_grid", lambda path, sample: [reading] * isinstance(sample, Scattered))
    assert run("convert", f"{file},size=600:500", str(file.parent / "a_grid.tif")) == code
    error = capsys.readouterr().err
    assert ("does not hold the camera to" in error) == (code == 3)
    if code:
        assert f"gdal: {'not read' if worst != worst else worst}" in error


# --- a folder ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("errors", "said"), [
    ((1e-13, 8e-13, 0.0), "2 images written, all readers agree to 8e-13 px."),
    ((1e-13, 0.25, 0.0), "2 images written, all readers differ from the camera by up to 0.2 px."),
    ((1e-13, None, 3e-9), "2 images written, 2 of 3 readings agree to 3e-09 px."),
    ((None,), "2 images written, no reader opened them."),
])  # fmt: skip
def test_a_hand_off_ends_with_the_largest_difference_of_all_readers(errors: Sequence[float | None], said: str) -> None:
    seen = [Reading(Path("a"), "gdal", NAN if e is None else e, "no field" if e is None else "") for e in errors]
    assert str(Converted((), tuple(seen), 2)) == said


def test_names_of_a_hand_off_are_checked_first(image: Path, tmp_path: Path) -> None:
    a, b = tmp_path / "a" / "x.tif", tmp_path / "b" / "x.tif"

    def handed(images: list[Path], out: Path, formats: str = "txt") -> None:
        convert(images, out_dir=out, rpc=tmp_path / "none", rpc_format=formats)

    out = tmp_path / "out"
    with pytest.raises(UsageError, match="--rpc-format doc: not a format that is written"):
        handed([a], out, "txt,doc")
    with pytest.raises(InputError, match="several images named x: apply them one folder at a time"):
        handed([a, b], out)
    with pytest.raises(InputError, match="the folder of the images; choose a new one"):
        handed([b, a.with_name("y.tif")], a.parent)
    with pytest.raises(InputError):
        handed([a], Path(str(tmp_path / "a\0b")))
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match=r"no RPC of scene\.tif there"):
        handed([image], out)
    assert not out.exists()


def test_what_hides_an_rpc_is_told_of_the_input_and_counts_in_the_output(image: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert convert(image, out_dir=out, images="copy").reasons == ()
    write_rpc(make_rpc().crop(900, 900), image.with_suffix(".RPB"))
    write_rpc(make_rpc(), hiding := out / "scene.RPB")
    told = f"^beside {image}: scene.RPB hides an RPC put into the image$"
    with pytest.warns(Remark, match=told):
        reasons = convert(image, out_dir=out, images="copy", overwrite=True).reasons
    assert f"{hiding} hides the RPC of {out / 'scene.tif'}: move it away." in reasons
    with pytest.warns(Remark, match=told):  # it is one of those just written
        assert convert(image, out_dir=tmp_path / "new", images="copy", rpc_format="rpb").reasons == ()


def test_a_hand_off_writes_the_formats_named_and_tells_what_is_wrong(
    image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []

    def verify(paths: Any, sample: Any) -> list[Reading]:
        image, alts = (np.array([one.min(axis=0), one.max(axis=0)]) for one in (sample.image, sample.ground[:, 2]))
        size = tuple(np.rint(np.ptp(image, axis=0) + 1).astype(int).tolist())
        names, there = sorted(path.name for path in paths), all(path.is_file() for path in paths)
        asked.append((names, size, tuple(alts.tolist()), there))
        return [Reading(paths[0], "gdal", 2e-6), Reading(paths[1], "rpcm", NAN, "no field")]

    monkeypatch.setattr(module, "verify", verify)
    monkeypatch.setattr(module, "unverified", lambda paths: [f"not tried: {len(paths)}"])
    write_rpc(make_rpc(), tmp_path / "rpc.geom")
    out = tmp_path / "out"
    words = ("-o", str(out), "--rpc", str(tmp_path / "rpc.geom"), "--rpc-format", " txt,,json ")
    assert run("convert", str(image.parent), *words) == 3
    alts = open_camera(str(tmp_path / "rpc.geom")).alt_range
    assert asked == [(["scene.rpc.json", "scene.vrt", "scene_RPC.TXT"], (600, 400), alts, True)]
    assert read_rpc(out / "scene_RPC.TXT") == make_rpc()
    said = capsys.readouterr()
    *lines, last = said.out.splitlines()
    assert lines == [f"{out / 'scene.vrt'}: gdal 2.0e-06 px", f"{out / 'scene_RPC.TXT'}: rpcm no field"]
    assert last == "1 image written, 1 of 2 readings differ from the camera by up to 2e-06 px."
    assert said.err.splitlines() == [
        "barpc: not tried: 3",
        f"barpc: needs review (exit code 3): The hand-off needs review. {out / 'scene.vrt'}: gdal reads it with an "
        "error of 2.0e-06 "
        f"px. {out / 'scene_RPC.TXT'}: rpcm no field.",
    ]
    assert run("convert", str(image), *words) == 1  # the folder is not empty
    assert run("convert", str(image), *words, "--overwrite") == 3
