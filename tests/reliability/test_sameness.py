"""The same images give the same result, however they are listed; one image under two names is found."""

from __future__ import annotations

import csv
import json
import random
import shutil
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.base.errors import InputError
from barpc.pipeline import AdjustResult, RunOptions, adjust, load_views
from barpc.pipeline import loading as views
from barpc.pipeline.loading import unique_names
from barpc.rpcio import read_rpc, write_rpc_vrt
from tests.pipeline.known import part
from tests.scenes import ImageOptions, write_scene

from .conftest import barpc, rewrite
from .trials import SAMPLES, crop, outputs

START, SIDE = 240, 160


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """Three images, and everything a run may be given besides."""
    folder = tmp_path_factory.mktemp("scene")
    images = part(folder, SIDE, START, gcps=3).images
    lon, lat = read_rpc(images[0]).localize(np.full(2, SIDE / 2.0), np.array(230.0))[:2]
    square = [[lon + 3e-4 * x, lat + 3e-4 * y] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))]
    (folder / "area.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [square]}))
    (folder / "pairs.txt").write_text("view_02 view_00\nview_01 view_00\n")
    adjust(images, folder / "ties", RunOptions(stop_after="matching"))
    rows = (folder / "ties/matches.csv").read_text().splitlines(keepends=True)
    (folder / "two.csv").write_text("".join(row for row in rows if not row.startswith("view_02")))
    two = RunOptions(matches=str(folder / "two.csv"), matches_only=True, stop_after="adjustment")
    adjust(images[:2], folder / "earlier", two)
    (folder / "bad.tif").write_text("hello")
    return folder


def ways(scene: Path) -> dict[str, RunOptions]:
    return {
        "the defaults": RunOptions(),
        "given matches": RunOptions(matches=str(scene / "ties/matches.csv"), matches_only=True),
        "matches to be verified": RunOptions(matches=str(scene / "ties/matches.csv")),
        "control points": RunOptions(
            gcp=(str(scene / "gcps.geojson"),), matches=str(scene / "ties/matches.npz"), matches_only=True
        ),
        "a list of pairs": RunOptions(overlap_list=str(scene / "pairs.txt")),
        "an area": RunOptions(aoi=str(scene / "area.geojson")),
        "an earlier run": RunOptions(add_to=str(scene / "earlier")),
        "a bad file": RunOptions(keep_going=True),
    }


AT_NIGHT = "the defaults", "given matches", "matches to be verified"  # in all orders below, or as with control points


def images_of(scene: Path, way: str) -> list[Path]:
    return [*sorted(scene.glob("view_*.tif")), *([scene / "bad.tif"] if way == "a bad file" else [])]


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize(
    "way", [pytest.param(way, marks=[pytest.mark.nightly] * (way in AT_NIGHT)) for way in ways(Path())]
)
def test_the_order_of_the_images_changes_no_byte(scene, tmp_path, way):
    orders = list(permutations(images_of(scene, way)))
    require_same(scene, tmp_path, way, [orders[0], random.Random(way).choice(orders[1:])])


@pytest.mark.nightly
def test_no_order_of_three_images_changes_a_byte(scene, tmp_path):
    require_same(scene, tmp_path, "the defaults", list(permutations(images_of(scene, "the defaults"))))


def require_same(scene: Path, tmp_path: Path, way: str, orders: list[tuple[Path, ...]]) -> None:
    files = []
    for number, order in enumerate(orders):
        result = adjust(order, tmp_path / str(number), ways(scene)[way])
        files.append(outputs(tmp_path / str(number)))
        given = [str(path) for path in order if path.name != "bad.tif"]
        assert [view.path for view in result.views] == given
    assert {"view_00_RPC.TXT", "view_00.vrt", "summary.json", "tables/block.npz"} <= set(files[0])
    assert all(other == files[0] for other in files[1:])


@pytest.mark.nightly
def test_ten_images_in_ten_orders_give_the_same_bytes(tmp_path):
    images = write_scene(tmp_path / "scene", ImageOptions(views=10, size=(256, 256), seed=3))
    adjust(images, tmp_path / "sorted")
    truth = outputs(tmp_path / "sorted")
    for seed in range(10):
        listed = tmp_path / "images.txt"
        listed.write_text("\n".join(map(str, random.Random(seed).sample(images, 10))))
        out = tmp_path / str(seed)
        assert barpc("adjust", "--image-list", listed, "-o", out).code == 0
        assert outputs(out) == truth


def test_names_do_not_depend_on_the_order():
    files = [Path("/d/a/x.tif"), Path("/d/b/x.tif"), Path("/e/b/x.tif"), Path("/x.tif")]
    names = [dict(zip(order, unique_names(order), strict=True)) for order in permutations(files)]
    assert all(other == names[0] for other in names)
    assert len(set(names[0].values())) == len(files)


def distance(first: AdjustResult, second: AdjustResult, names: dict[str, str] | None = None) -> float:
    """Largest difference of two results on a grid over the images [px]."""
    others, worst = {view.name: view for view in second.views}, 0.0
    for view in first.views:
        grid = np.stack(np.meshgrid(*(np.linspace(0, side - 1, 5) for side in view.size)), axis=-1)
        ground = view.sensor.localize(grid.reshape(-1, 2), np.array(230.0))
        other = others[view.name if names is None else names[view.name]].sensor
        worst = max(worst, float(np.abs(other.project(ground) - grid.reshape(-1, 2)).max()))
    return worst


@pytest.mark.slow
def test_the_order_of_rows_and_the_names_of_files_change_rounding_alone(scene, tmp_path):
    images = images_of(scene, "given matches")
    given = RunOptions(matches_only=True, matches=str(scene / "ties/matches.csv"), gcp=(str(scene / "gcps.geojson"),))
    result = adjust(images, tmp_path / "first", given)
    head, *rows = csv.reader((scene / "ties/matches.csv").read_text().splitlines())
    points = json.loads((scene / "gcps.geojson").read_text())
    new = {"view_00": "z", "view_01": "a", "view_02": "m"}
    random.Random(2).shuffle(rows)
    random.Random(3).shuffle(points["features"])
    renamed = [Path(shutil.copy(path, tmp_path / f"{new[path.stem]}.tif")) for path in images]
    for feature in points["features"]:
        feature["properties"]["filename"] = new[Path(feature["properties"]["filename"]).stem]
    with (tmp_path / "m.csv").open("w") as file:
        csv.writer(file).writerows([head, *([new[name], *more] for name, *more in rows)])
    (tmp_path / "g.geojson").write_text(json.dumps(points))
    other = replace(given, matches=str(tmp_path / "m.csv"), gcp=(str(tmp_path / "g.geojson"),))
    assert distance(result, adjust(renamed, tmp_path / "second", other), new) < 1e-7


# -- the same pixels ----------------------------------------------------------------------------------


def other_camera(rpcs: rasterio.rpc.RPC) -> None:
    rpcs.samp_off += 1.5


def copied(source: Path, target: Path, **how: object) -> Path:
    return rewrite(Path(shutil.copy(source, target)), camera=other_camera, **how)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "how",
    [
        {"blockysize": 7},
        {"tiled": True, "blockxsize": 64, "blockysize": 64, "compress": "lzw", "predictor": 2},
        {"dtype": "int32", "compress": "deflate"},
        {"dtype": "float64", "nodata": -1.0},
        {"count": 2, "interleave": "pixel"},
    ],
    ids=str,
)
def test_the_same_pixels_in_other_dress_are_found(scene, tmp_path, how):
    images = images_of(scene, "")
    twin = copied(images[1], tmp_path / "twin.tif", **how)
    for order in ([*images, twin], [twin, *images]):
        with pytest.raises(InputError, match=r"view_01\.tif: shows the same pixels as .*twin\.tif under another"):
            load_views(order)


@pytest.mark.nightly
def test_a_vrt_with_an_rpc_of_its_own_is_the_same_image(scene, tmp_path):
    images = images_of(scene, "")
    twin = tmp_path / "twin.vrt"
    write_rpc_vrt(read_rpc(images[1]), images[0], twin)
    said = barpc("adjust", *images, twin, "-o", tmp_path / "out", "--keep-going", "--json")
    assert said.code == 3
    left = json.loads(said.out)["left_out"]
    assert [Path(entry["path"]).name for entry in left] == ["view_00.tif", "view_01.tif"]
    assert "same pixels" in left[0]["reason"]
    assert "the same RPC" in left[1]["reason"]


def test_images_that_are_nearly_empty_are_no_twins(scene, tmp_path, monkeypatch):
    """None is read whole, however many there are; a copy among them is found."""
    reads = []
    whole = views._whole_digest
    monkeypatch.setattr(views, "_whole_digest", lambda image, band: reads.append(image.name) or whole(image, band))
    images = []
    for number in range(8):

        def corner(values: np.ndarray, number: int = number) -> np.ndarray:
            kept = np.zeros_like(values)
            kept[:40, :40] = values[number : number + 40, :40]
            return kept if number < 6 else np.zeros_like(values)  # and two that show nothing at all

        def camera(rpcs: rasterio.rpc.RPC, number: int = number) -> None:
            rpcs.samp_off += number

        target = Path(shutil.copy(scene / "view_00.tif", tmp_path / f"v{number}.tif"))
        images.append(rewrite(target, pixels=corner, camera=camera, nodata=0))
    assert len(load_views(images).views) == 8
    assert reads == []  # more windows are asked where the first show nothing
    twin = copied(images[3], tmp_path / "w.tif")
    with pytest.raises(InputError, match=r"w\.tif: shows the same pixels as .*v3\.tif"):
        load_views([*images, twin])


def test_an_image_in_which_only_nan_differs_is_no_twin(scene, tmp_path):
    """NaN compares with itself here, wherever it stands."""

    def holes(at: int):
        def change(values: np.ndarray) -> np.ndarray:
            values[at, at] = np.nan
            return values

        return change

    make = {"dtype": "float32", "camera": other_camera}
    first = rewrite(Path(shutil.copy(scene / "view_00.tif", tmp_path / "a.tif")), pixels=holes(3), dtype="float32")
    second = rewrite(Path(shutil.copy(scene / "view_00.tif", tmp_path / "b.tif")), pixels=holes(4), **make)
    third = rewrite(Path(shutil.copy(scene / "view_00.tif", tmp_path / "c.tif")), pixels=holes(3), **make)
    assert len(load_views([first, second]).views) == 2
    with pytest.raises(InputError, match="same pixels"):
        load_views([first, third])


@pytest.mark.slow
def test_a_part_of_an_image_is_named_in_the_verdict(scene, tmp_path):
    images = images_of(scene, "")
    part = crop(SAMPLES[0], tmp_path / "part.tif", side=100, start=START + 30)
    options = RunOptions(stop_after="adjustment")
    summary = adjust([*images, part], tmp_path / "out", options).summary
    assert {view["name"]: view["advice"] for view in summary["views"]} == dict.fromkeys(
        ("view_00", "view_01", "view_02"), ""
    )
    assert [(one["name"], one["lead"]) for one in summary["carried"]] == [("part", "view_00")]
    assert any(line.startswith("part: of one acquisition with view_00") for line in summary["verdict"])
