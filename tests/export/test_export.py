"""Exports against the readers they are made for, and against rpcm and PROJ, which share nothing with us."""

from __future__ import annotations

import csv
import json
import re
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp

from barpc.base.errors import InputError, OutputError
from barpc.base.verb_options import ExportOptions
from barpc.export.colmap import _ShotPixels
from barpc.export.light import sun_angles
from barpc.export.targets import TARGETS, export_run
from barpc.rpcio import read_rpc
from barpc.rpcio.acquisition import read_acquisition
from barpc.sensor.sampler import image_grid
from tests.export.conftest import changed, ecef, ended, posed, read, table
from tests.geotiffs import write_image
from tests.lanes import rest_slow

DATED = {"time": ("2013-04-17T22:00:00+02:00",)}  # for images whose files state no time


def exported(run: Path, target: str, tmp_path: Path, **options: object) -> Path:
    exact = {"exact": True} if target == "colmap" else {}  # (the images of these runs do not exist)
    export_run(run, target, tmp_path / target, ExportOptions(**DATED | exact | options))
    return tmp_path / target


def box(rpc, size: tuple[int, int], alts: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """ECEF of points all over an image and the altitudes, by PROJ, and where the RPC shows them."""
    image, alt = image_grid(size, alts, (9, 4))
    ground = rpc.localize(image, alt)
    return ecef(*ground.T), image


@pytest.mark.slow
def test_every_rpc_dictionary_is_the_written_rpc_for_rpcm(run_dir, tmp_path):
    rpcm = pytest.importorskip("rpcm")
    views = read(run_dir / "summary.json")["views"]
    records = exported(run_dir, "satnerf", tmp_path)
    found = [read(records / f"{view['name']}.json")["rpc"] for view in views]
    found += [image["rpc"] for image in read(exported(run_dir, "s2p", tmp_path) / "config.json")["images"]]
    items = exported(run_dir, "stac", tmp_path)
    found += [read(items / f"{view['name']}.json")["properties"]["rpc"] for view in views]
    assert len(found) == 9
    for view, rpc in zip(views * 3, found, strict=True):
        model = rpcm.RPCModel(rpc, dict_format="rpcm")
        truth = rpcm.rpc_from_rpc_file(str(run_dir / f"{view['name']}_RPC.TXT"))
        image, alt = image_grid(view["size"], view["alt_range_m"], (7, 4))
        lon, lat, _ = read_rpc(run_dir / f"{view['name']}_RPC.TXT").localize(image, alt).T
        off = np.subtract(model.projection(lon, lat, alt), truth.projection(lon, lat, alt))
        assert np.abs(off).max() < 1e-6


@pytest.mark.few(1)
def test_satnerf_files_hold_what_its_loader_reads(run_dir, tmp_path):
    rpcm = pytest.importorskip("rpcm")
    out = exported(run_dir, "satnerf", tmp_path)
    names = (out / "train.txt").read_text().split("\n")
    assert names == [f"{view['name']}.json" for view in read(run_dir / "summary.json")["views"]]
    assert sorted(path.name for path in out.glob("*.json")) == sorted(names)  # its loader takes every one
    points = np.load(out / "pts3d.npy")
    records = [read(out / name) for name in names]
    paths = [Path(view["path"]) for view in read(run_dir / "summary.json")["views"]]
    assert [(out / one["img"]).resolve() for one in records] == paths  # in several folders: from OUT
    times = [datetime.strptime(one["acquisition_date"], "%Y%m%d%H%M%S") for one in records]  # as its scripts read it
    assert [f"{time:%d %H:%M:%S}" for time in times] == ["17 10:32:15", "17 20:00:00", "17 20:00:00"]
    angles = np.array([[float(one["sun_elevation"]), float(one["sun_azimuth"])] for one in records])
    assert angles[0] == pytest.approx([52.25, 150.5])  # as its file states it
    lon, lat = records[1]["geojson"]["center"]
    assert angles[1:] == pytest.approx(np.array([sun_angles(times[1].replace(tzinfo=UTC), lon, lat)] * 2), abs=0.02)
    pyproj = pytest.importorskip("pyproj")
    back = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    for one in records:
        assert (one["width"], one["height"]) == (900, 700)
        seen = np.array(one["keypoints"]["2d_coordinates"])
        at = points[one["keypoints"]["pts3d_indices"]]
        model = rpcm.RPCModel(one["rpc"], dict_format="rpcm")
        lon, lat, alt = back.transform(*at.T)
        lon = lon + 360.0 * np.rint((one["rpc"]["lon_offset"] - lon) / 360.0)  # rpcm knows no turns
        off = np.hypot(*(np.column_stack(model.projection(lon, lat, alt)) - seen).T)
        assert len(seen) > 150
        assert 0.01 < np.median(off) < 0.5  # not half a pixel off, nor made of the projections
        high = one["max_alt"]
        assert one["min_alt"] < alt.min() < alt.max() < high
        top = ecef(*model.localization(*seen.T, np.full(len(seen), high)), np.full(len(seen), high))
        np.testing.assert_allclose(one["keypoints"]["depths"], np.linalg.norm(top - at, axis=1), atol=1e-3)
        parts = one["geojson"]["coordinates"]
        rings = [np.array(part[0] if one["geojson"]["type"] == "MultiPolygon" else part) for part in parts]
        assert all((np.abs(ring[:, 0]) <= 180).all() for ring in rings)
        assert len(rings) == (2 if abs(one["geojson"]["center"][0]) > 100 else 1)


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("run_dir", rest_slow(["on_date_line", "southern"]), indirect=True)
def test_colmap_s_pinholes_are_as_near_as_they_say(run_dir, tmp_path):
    out = exported(run_dir, "colmap", tmp_path)
    about = read(out / "world.json")
    to_world = np.linalg.inv(np.array(about["world_to_ecef"]))
    for view, image in zip(read(run_dir / "summary.json")["views"], posed(out), strict=True):
        rpc = read_rpc(run_dir / f"{view['name']}_RPC.TXT")
        at, seen = box(rpc, view["size"], about["alt_range"])
        world = at @ to_world[:3, :3].T + to_world[:3, 3]
        assert np.abs(world).max() < 5000
        off = np.hypot(*(image.project(world) - 0.5 - seen).T).max()
        assert off < 0.3
        assert 0.8 * off < about["pinhole_error_px"][image.name] < 1.2 * off
        assert Path(out, about["images"][image.name]).resolve() == Path(view["path"]).resolve()
        assert (-image.turn.T @ image.shift)[2] > 300e3  # it looks down from its orbit


def in_one_folder(run: Path, tmp_path: Path, form: str = "/images/{}.tif") -> Path:
    """A copy of a run whose images lie together."""
    return changed(run, tmp_path, lambda of: [view.update(path=form.format(view["name"])) for view in of["views"]])


def test_an_image_s_path_that_is_no_text_is_refused_by_the_summary_s_name(run_dir, tmp_path):
    odd = in_one_folder(run_dir, tmp_path, "/images/\udce9/{}.tif")
    with pytest.raises(InputError, match=r"summary\.json: .* its path holds bytes that are not UTF-8"):
        exported(odd, "satnerf", tmp_path)
    assert not (tmp_path / "satnerf").exists()


@pytest.mark.slow
def test_pycolmap_opens_the_model_and_finds_the_errors_that_it_states(southern, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    out = exported(in_one_folder(southern, tmp_path), "colmap", tmp_path)
    model = pycolmap.Reconstruction(str(out / "sparse/0"))
    stated = read(out / "world.json")
    assert (model.num_images(), model.num_reg_images()) == (3, 3)
    assert model.num_points3D() > 250
    assert all(camera.model.name == "PINHOLE" for camera in model.cameras.values())
    off, said = [], []
    for point in model.points3D.values():
        misses = []
        for element in point.track.elements:
            image = model.images[element.image_id]
            seen = image.camera.img_from_cam(image.cam_from_world() * point.xyz)
            misses.append(np.linalg.norm(seen - image.points2D[element.point2D_idx].xy))
            assert image.points2D[element.point2D_idx].point3D_id in model.points3D
        off.append(np.mean(misses))
        said.append(point.error)
    np.testing.assert_allclose(off, said, atol=1e-6)
    assert 0.01 < np.median(off) < 0.4
    assert set(stated["pinhole_error_px"]) == {image.name for image in model.images.values()}
    rows = np.array(stated["world_to_ecef"])
    np.testing.assert_allclose(rows[:3, :3] @ rows[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.slow
def test_colmap_finds_every_image_in_its_folder_and_none_is_copied(southern, tmp_path):
    for _ in range(2):  # again: in place of the first
        export_run(southern, "colmap", tmp_path / "model", ExportOptions(overwrite=True, exact=True))
    views = read(southern / "summary.json")["views"]
    for image, view in zip(posed(tmp_path / "model"), views, strict=True):
        path = tmp_path / "model/images" / image.name
        assert path.is_symlink()
        assert path.resolve() == Path(view["path"]).resolve()
    assert len(list((tmp_path / "model/images").iterdir())) == len(views)


def test_a_link_takes_the_place_of_an_earlier_one_and_of_nothing_else(southern, tmp_path, monkeypatch, caplog):
    run, how = in_one_folder(southern, tmp_path), ExportOptions(overwrite=True, exact=True)
    link, mine = (tmp_path / f"model/images/view_000{k}.tif" for k in (0, 1))
    link.parent.mkdir(parents=True)
    link.symlink_to("../../b.tif")
    mine.write_text("mine")
    with pytest.raises(OutputError, match=r"view_0001\.tif: is there already and no link of an earlier export"):
        export_run(run, "colmap", tmp_path / "model", how)
    assert (link.is_symlink(), link.resolve()) == (True, Path("/images/view_0000.tif").resolve())
    assert mine.read_text() == "mine"

    def refuse(*_: object) -> None:
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    export_run(run, "colmap", tmp_path / "linked", how)
    said = r"view_0002\.tif: no link to (\.\./)+images/view_0002\.tif \(Operation not permitted\): copy the image there"
    assert re.search(said, caplog.text)


def test_colmap_refuses_a_name_that_its_text_cannot_hold(southern, tmp_path):
    with pytest.raises(InputError, match="space"):
        exported(in_one_folder(southern, tmp_path, "/images/{} a.tif"), "colmap", tmp_path)


def test_points_come_with_the_covariance_of_their_rays(southern, tmp_path):
    plyfile = pytest.importorskip("plyfile")
    out = exported(southern, "points", tmp_path)
    comment, *lines = (out / "points.csv").read_text().splitlines()
    assert comment.startswith("# covariance")
    rows = list(csv.DictReader(lines))
    known = {int(row["track"]): row for row in csv.DictReader(table(southern, "residuals"))}
    assert {int(row["track"]) for row in rows} == set(known)
    assert all(row["alt"] == known[int(row["track"])]["height_above_datum"] for row in rows)
    ply = plyfile.PlyData.read(str(out / "points.ply"))["vertex"]
    assert len(ply) == len(rows)
    names = ("var_ee", "var_en", "var_eu", "var_nn", "var_nu", "var_uu")
    values = np.array([[float(row[name]) for name in names] for row in rows])
    np.testing.assert_allclose(np.stack([ply[name] for name in names], axis=1), values, rtol=1e-4)
    matrix = values[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    assert (np.linalg.eigvalsh(matrix) > 0).all()
    assert (values[:, 5] > 2 * values[:, 0]).mean() > 0.9  # heights are worse than places
    # by a Monte Carlo of one point: image noise in, scatter of the intersection out
    rng, track = np.random.default_rng(3), rows[7]["track"]
    seen = [r for r in csv.DictReader(table(southern, "observations")) if r["track"] == track]
    noise = float(comment.split("noise ")[1].split(" px")[0])
    from barpc.base.geodesy import ecef_from_ground, enu_basis
    from barpc.sensor.triangulation import triangulate

    models = [read_rpc(southern / f"{r['view']}_RPC.TXT") for r in seen if r["used"] == "1"]
    xy = np.array([[float(r["col"]), float(r["row"])] for r in seen if r["used"] == "1"])
    many = 2000
    noisy = xy + rng.normal(0, noise, (many, *xy.shape))
    view, point = np.tile(np.arange(len(models)), many), np.repeat(np.arange(many), len(models))
    found = triangulate(models, view, point, noisy.reshape(-1, 2), alt=float(rows[7]["alt"])).points
    origin = [float(rows[7][key]) for key in ("lon", "lat", "alt")]
    scatter = np.cov(((found - ecef_from_ground(origin)) @ enu_basis(origin).T).T)
    np.testing.assert_allclose(np.diag(scatter), np.diag(matrix[7]), rtol=0.15)


def test_stac_items_are_valid_of_a_day_and_across_the_date_line(run_dir, tmp_path):
    pystac = pytest.importorskip("pystac")
    out = exported(run_dir, "stac", tmp_path, time=(), date=("2013-04-17",))
    views = read(run_dir / "summary.json")["views"]
    for view in views:
        content = read(out / f"{view['name']}.json")
        item = pystac.Item.from_dict(content)
        from pystac.validation.stac_validator import JsonSchemaSTACValidator

        validator = JsonSchemaSTACValidator()  # the core's schemas come with it; those of extensions lie on the net
        validator.validate_core(content, pystac.STACObjectType.ITEM, "1.1.0", href=None)
        assert item.properties["proj:shape"] == [700, 900]
        west, south, east, north = item.bbox
        assert south < north
        assert (west > east) == (abs(west) > 100)
        for name in view["outputs"]:
            assert (out / item.assets[name].href).resolve() == (run_dir / name).resolve()
    collection = read(out / "collection.json")
    validator.validate_core(collection, pystac.STACObjectType.COLLECTION, "1.1.0", href=None)
    whole = pystac.Collection.from_file(str(out / "collection.json"))
    items = list(whole.get_items())
    assert [item.id for item in items] == [view["name"] for view in views]
    assert all(item.get_collection().id == whole.id for item in items)
    (west, south, east, north), turn = whole.extent.spatial.bboxes[0], 360.0
    assert (east - west) % turn < 1.0
    for item in items:
        assert south <= item.bbox[1] < item.bbox[3] <= north
        assert 0.0 <= (item.bbox[0] - west) % turn <= (item.bbox[2] - west) % turn <= (east - west) % turn + 1e-9
    assert read(out / f"{views[0]['name']}.json")["properties"]["datetime"] == "2013-04-17T10:32:15.5Z"
    day = pystac.Item.from_file(str(out / f"{views[1]['name']}.json"))
    assert day.datetime is None
    assert f"{day.common_metadata.end_datetime:%F %T}" == "2013-04-17 23:59:59"


@pytest.mark.slow
def test_altitudes_may_be_given(southern, tmp_path):
    out = exported(southern, "colmap", tmp_path, alt=(-200.0, 2000.0))
    assert read(out / "world.json")["alt_range"] == [-200.0, 2000.0]


@pytest.mark.parametrize("target", rest_slow(sorted(TARGETS, key=["s2p", "asp"].__contains__, reverse=True), 2))
def test_nothing_is_replaced_that_is_not_an_earlier_export(target, southern, tmp_path):
    southern = in_one_folder(southern, tmp_path)
    out = exported(southern, target, tmp_path)
    before = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    with pytest.raises(OutputError, match="not empty"):
        exported(southern, target, tmp_path)
    exported(southern, target, tmp_path, overwrite=True)
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == before
    foreign = sorted(before)[0]
    (out / foreign).write_text("mine")
    with pytest.raises(OutputError, match="not replaced"):
        exported(southern, target, tmp_path, overwrite=True)
    assert (out / foreign).read_text() == "mine"


def test_an_image_of_the_run_is_never_written_over(southern, tmp_path):
    out = tmp_path / "stereo"
    run = changed(southern, tmp_path, lambda of: of["views"][0].update(path=str(out / "config.json")))
    with pytest.raises(OutputError, match=r"config\.json: is an input and is never written"):
        export_run(run, "s2p", out)


def test_the_run_s_own_folder_is_never_an_export(southern):
    with pytest.raises(OutputError, match="one of its own"):
        export_run(southern, "s2p", southern, ExportOptions(overwrite=True))


@pytest.mark.parametrize("name", ["../out", "a/b", "..", "x\0y"])
def test_a_run_that_lies_about_names_writes_and_reads_nothing_outside(name, southern, tmp_path):
    old = read(southern / "summary.json")["views"][0]["name"]

    def rename(summary: dict) -> None:
        text = json.dumps(summary).replace(json.dumps(old), json.dumps(name))
        summary |= json.loads(text)

    rows = [line.replace(f"{old},", f'"{name}",', 1) for line in table(southern, "observations")]
    run = changed(southern, tmp_path, rename, observations=rows)
    with pytest.raises((InputError, OutputError)):
        export_run(run, "satnerf", tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"]


def test_rpc_files_are_taken_from_the_run_s_own_folder_alone(southern, tmp_path):
    def move(summary: dict) -> None:
        view, run = summary["views"][0], tmp_path / "run"
        shutil.move(run / f"{view['name']}_RPC.TXT", tmp_path / "elsewhere_RPC.TXT")
        (run / "link_RPC.TXT").symlink_to(tmp_path / "elsewhere_RPC.TXT")
        view["outputs"] = {"link_RPC.TXT": {}, "..": {}}

    run = changed(southern, tmp_path, move)
    with pytest.raises(InputError, match="no RPC file"):
        export_run(run, "s2p", tmp_path / "out")


def test_a_run_without_an_adjustment_says_so(southern, tmp_path):
    run = changed(southern, tmp_path, lambda of: of.update(kind="match"))
    with pytest.raises(InputError, match="without corrected cameras"):
        export_run(run, "s2p", tmp_path / "out")
    with pytest.raises(InputError, match=r"no summary\.json"):
        export_run(tmp_path / "none", "s2p", tmp_path / "out")


def test_the_verb_prints_what_it_wrote(southern, tmp_path, capsys):
    assert ended(southern, tmp_path / "a b", "--to", "s2p", "--json") == 0
    assert json.loads(capsys.readouterr().out) == [str(tmp_path / "a b" / "config.json")]
    assert ended("--help") == 0
    words = capsys.readouterr().out.translate(str.maketrans("[]|,", "    ")).split()
    assert set(TARGETS) <= set(words)  # the verb offers every target


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("a.IMD", 'BEGIN_GROUP = IMAGE_1\n\tfirstLineTime = 2015-09-30T10:56:56.973685Z;\n\tmeanSunAz = 162.1;\n'
         "\tminSunEl = 1.0;\n\tmeanSunEl = 40.3;\n", (40.3, 162.1, "2015-09-30T10:56:56.973685Z")),
        ("a.xml", "<IMD><MINSUNAZ>1.0</MINSUNAZ><MEANSUNAZ>1.621000000000000e+02</MEANSUNAZ>"
         "<MEANSUNEL>4.030000000000000e+01</MEANSUNEL></IMD>", (40.3, 162.1, None)),
        ("a_metadata.json", '{"properties": {"acquired": "2020-01-02T03:04:05.6Z", "sun_azimuth": 150, '
         '"sun_elevation": -1.5}}', (-1.5, 150.0, "2020-01-02T03:04:05.6Z")),
        ("a.xml", "<SUN_ELEVATION>10</SUN_ELEVATION><SUN_ELEVATION>12</SUN_ELEVATION><SUN_ELEVATION>30</SUN_ELEVATION>"
         "<IMAGING_DATE>2013-99-17</IMAGING_DATE>", (12.0, None, None)),
        ("a.xml", "nothing", (None, None, None)),
    ],
)  # fmt: skip
def test_sun_and_time_are_read_from_what_lies_beside_an_image(name, text, expected, tmp_path):
    (tmp_path / name).write_text(text)
    light = read_acquisition(str(tmp_path / "a.tif"))
    assert (light.elevation, light.azimuth, light.time) == expected


def test_metadata_that_is_no_file_is_passed_over(tmp_path):
    (tmp_path / "a.xml").symlink_to("/dev/zero")
    assert read_acquisition(str(tmp_path / "a.tif"), "/dev/zero").time is None
    assert read_acquisition("https://host/a.tif", "https://host/b.xml").time is None


def test_an_export_of_another_name_and_altitudes_upside_down_are_refused(southern, tmp_path):
    with pytest.raises(InputError, match="no export of that name; there are satnerf, "):
        export_run(southern, "obj", tmp_path / "x")
    for altitudes in ((5.0, 5.0), (6.0, 5.0)):
        with pytest.raises(InputError, match="the lower one first"):
            export_run(southern, "s2p", tmp_path / "x", ExportOptions(alt=altitudes))
    assert not (tmp_path / "x").exists()
    assert export_run(southern, "s2p", tmp_path / "x") == [tmp_path / "x" / "config.json"]


@pytest.mark.parametrize(
    ("target", "flags", "said"),
    [
        ("s2p", ["--images"], "--exact, --images and --tolerance go with --to colmap, not s2p"),
        ("colmap", ["--exact", "--tolerance", "0.2"], "--exact takes the images as they are"),
        ("colmap", ["--tolerance", "0"], "tolerance"),
    ],
)
def test_flags_that_do_not_go_together_are_wrong_usage(target, flags, said, southern, tmp_path, capsys):
    assert ended(southern, tmp_path / "out", "--to", target, *flags) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_pictures_of_images_that_are_gone_are_not_made(southern, tmp_path, capsys):
    assert ended(southern, tmp_path / "out", "--to", "colmap") == 1
    assert re.fullmatch(r"barpc: .*north\.tif: .*\n", capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
def test_a_picture_has_the_colours_of_its_image(south, tmp_path):
    rng = np.random.default_rng(0)
    bands = rng.integers(1, 200, (4, 40, 50)).astype(np.uint8)
    bands[0, :8] = 0  # a border
    path = write_image(tmp_path / "rgb.tif", bands, nodata=0)
    with rasterio.open(path, "r+") as file:
        file.colorinterp = [getattr(ColorInterp, name) for name in ("blue", "green", "red", "undefined")]
    shot = south.shots[0]
    pixels = _ShotPixels(replace(shot, file=str(path), entry=replace(shot.entry, size=(50, 40))))
    shown, valid = pixels.read((5, 4, 30, 20))
    assert shown.shape == (20, 30, 3)
    for k, band in enumerate((2, 1, 0)):
        low, high = np.percentile(bands[band][bands[band] > 0], [0.5, 99.5])
        expected = np.clip((bands[band, 4:24, 5:35] - low) / (high - low) * 255, 0, 255)
        assert shown[4:, :, k] == pytest.approx(expected[4:], abs=4)
    assert not valid[:4].any()
    assert valid[4:].all()
