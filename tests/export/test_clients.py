"""What the next program reads of a real run, RPCs in tags alone: by its client, or by a reader made from its format.

Clients that a package index has run here where they are installed (`dev`). Nothing is asserted by our own readers: the
truth of every camera is the RPC in the VRT, by rpcm, and PROJ.
"""

from __future__ import annotations

import csv
import json
from datetime import datetime
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.warp import Resampling, reproject
from scipy.ndimage import map_coordinates

import barpc
from tests.export.conftest import ecef, posed, read, table

rpcm = pytest.importorskip("rpcm")
pyproj = pytest.importorskip("pyproj")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:Dataset has no geotransform")]
MAXAR = "LINE", "SAMP", "LAT", "LONG", "HEIGHT"
NAMES = "img_01", "img_02", "img_03"


@pytest.fixture(scope="module")
def run(shared_data, tmp_path_factory) -> Path:
    """s2p's public triplet, adjusted with few tie points."""
    images = [shared_data / f"optical/phr_triplet_whole/{name}.tif" for name in NAMES]
    folder = tmp_path_factory.mktemp("real") / "run"
    barpc.adjust(images, folder, points_per_image=400)
    return folder


def exported(run: Path, target: str, name: str = "", **options: object) -> Path:
    out = run.parent / (name or target)
    if not out.exists():
        barpc.export(run, out, target, **options)
    return out


def truth(run: Path, name: str):
    """The RPC that the run wrote for an image, as rpcm reads it."""
    return rpcm.rpc_from_rpc_file(str(run / f"{name}_RPC.TXT"))


def ground(run: Path, name: str, alts=(40.0, 350.0), num: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    """Points all over an image, and the ground (lon, lat, alt) that its RPC sees there, by rpcm."""
    rng = np.random.default_rng(1)
    image, alt = rng.uniform(5, 1000, (num, 2)), rng.uniform(*alts, num)
    return image, np.column_stack([*truth(run, name).localization(*image.T, alt), alt])


def off(model, run: Path, name: str) -> float:
    """The largest distance [px] of an rpcm model from what the run wrote."""
    image, at = ground(run, name)
    return float(np.abs(np.column_stack(model.projection(*at.T)) - image).max())


# --- COLMAP and trainers ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model(run) -> Path:
    return exported(run, "colmap", images=True)


def test_pycolmap_finds_the_reprojection_error_that_is_stated(model):
    pycolmap = pytest.importorskip("pycolmap")
    found, stated = pycolmap.Reconstruction(str(model / "sparse/0")), read(model / "world.json")
    found.update_point_3d_errors()
    assert found.compute_mean_reprojection_error() == pytest.approx(stated["mean_reprojection_error_px"], rel=0.01)
    assert found.compute_mean_reprojection_error() < 0.06  # the run: 0.04
    assert found.num_points3D() > 300
    for image in found.images.values():
        picture = pycolmap.Bitmap.read(str(model / "images" / image.name), True)
        camera = image.camera
        assert (picture.width, picture.height) == (camera.width, camera.height)
        assert camera.focal_length_x == camera.focal_length_y
        assert (camera.principal_point_x, camera.principal_point_y) == (camera.width / 2, camera.height / 2)
    colours = np.array([point.color for point in found.points3D.values()])
    assert colours.std() > 20  # not one grey


def splatted(model: Path) -> dict[str, tuple[np.ndarray, float, float, int, int]]:
    """World-to-clip matrices of each picture as a loader of 3D Gaussian Splatting makes them, in float32.

    It takes the rotation, the translation and the two focal lengths for fields of view; principal points it ignores.
    """
    found = {}
    for image in posed(model):
        view = np.eye(4)
        view[:3, :3], view[:3, 3] = image.turn, image.shift
        across, down = 2 * np.arctan(np.array(image.size) / (2 * image.focal))
        near, far = 0.01, 100.0
        clip = np.zeros((4, 4))
        clip[0, 0], clip[1, 1] = 1 / np.tan(across / 2), 1 / np.tan(down / 2)
        clip[2, 2:], clip[3, 2] = [far / (far - near), -far * near / (far - near)], 1.0
        both = clip.astype(np.float32) @ view.astype(np.float32)
        found[image.name] = both, *image.focal, *image.size
    return found


def to_world(model: Path, at: np.ndarray) -> np.ndarray:
    """Ground points (lon, lat, alt) in the frame of the model, by its matrix."""
    matrix = np.linalg.inv(np.array(read(model / "world.json")["world_to_ecef"]))
    return ecef(*at.T) @ matrix[:3, :3].T + matrix[:3, 3]


def test_a_loader_of_splatting_sees_the_ground_where_the_rpc_does(model, run):
    about = read(model / "world.json")
    for name, (both, fx, fy, width, height) in splatted(model).items():
        assert fx == fy
        image, at = ground(run, name.removesuffix(".png"), about["alt_range"])
        world = np.column_stack([to_world(model, at), np.ones(len(at))]).astype(np.float32)
        assert np.abs(world).max() < 2000
        clip = world @ both.T
        pixel = ((clip[:, :2] / clip[:, 3:] + 1) * [width, height] - 1) / 2  # its rasterizer's, of pixel centres
        back = np.column_stack([pixel + 0.5, np.ones(len(pixel))]) @ np.array(about["pictures"][name]["homography"]).T
        error = np.linalg.norm(back[:, :2] / back[:, 2:] - 0.5 - image, axis=1).max()
        assert 0.5 * about["pinhole_error_px"][name] < error < about["pinhole_error_px"][name] + 0.02  # float32's share
        assert about["pinhole_error_px"][name] < 0.1
        sun = about["sun"][name]
        up, turn = np.radians([sun["elevation"], sun["azimuth"]])
        assert sun["toward"] == pytest.approx([np.cos(up) * np.sin(turn), np.cos(up) * np.cos(turn), np.sin(up)])
        assert (sun["elevation"], sun["azimuth"]) == pytest.approx((54.8, 153.4), abs=0.2)


def grey(values: np.ndarray, xy: np.ndarray) -> np.ndarray:
    return map_coordinates(values, xy.T[::-1], order=1)


def test_pictures_show_what_the_images_do(model, run, shared_data):
    """The pixel of a ground point in the picture, by the model, is that of the image, by its RPC."""
    about = read(model / "world.json")
    for name, (both, _, _, width, height) in splatted(model).items():
        stem = name.removesuffix(".png")
        image, at = ground(run, stem, (190.0, 191.0), 8000)
        clip = np.column_stack([to_world(model, at), np.ones(len(at))]).astype(np.float32) @ both.T
        pixel = ((clip[:, :2] / clip[:, 3:] + 1) * [width, height] - 1) / 2
        with rasterio.open(model / f"images/{name}") as file, rasterio.open(model / f"masks/{name}") as mask:
            shown, valid = file.read(1).astype(float), mask.read(1)
            assert file.count in (3, 4)
        with rasterio.open(shared_data / f"optical/phr_triplet_whole/{stem}.tif") as file:
            source = file.read(1).astype(float)
        assert set(np.unique(valid)) <= {0, 255}
        assert 0.97 < (valid == 255).mean() <= 1.0

        inside = grey(valid.astype(float), pixel) == 255
        ours = grey(shown, pixel[inside])

        def alike(shift: tuple[float, float], image=image[inside], source=source, ours=ours) -> float:
            theirs = np.clip(grey(source, image + shift), *np.percentile(source, [1, 98]))
            return float(np.corrcoef(ours, theirs)[0, 1])

        best = alike((0.0, 0.0))
        assert best > 0.985
        assert all(best > alike(way) for way in ((0.4, 0.0), (-0.4, 0.0), (0.0, 0.4), (0.0, -0.4)))
    assert set(about["images"]) == {f"{name}.png" for name in NAMES}


def test_gdal_makes_the_same_pictures(model, run):
    out = exported(run, "colmap", "by_gdal")
    about, others = read(out / "world.json"), read(model / "world.json")
    for line in (out / "warp.sh").read_text().splitlines()[3:]:
        words = line.split()
        assert words[:7] == ["gdalwarp", "-q", "-order", "2", "-et", "0", "-r"]
        width, height = map(int, words[words.index("-ts") + 1 :][:2])
        vrt, to = words[-2:]
        with rasterio.open(out / vrt) as file:
            gcps, values = file.gcps[0], file.read(1)
        made = np.zeros((height, width), np.uint8)
        upwards = rasterio.Affine(1, 0, 0, 0, -1, height)
        how = {"resampling": Resampling.cubic, "tolerance": 0, "MAX_GCP_ORDER": 2}
        crs = rasterio.crs.CRS.from_epsg(3857)  # (any: rasterio asks for one)
        reproject(values, made, gcps=gcps, src_crs=crs, dst_crs=crs, dst_transform=upwards, **how)
        name = Path(to).name
        twin = name.replace(".tif", ".png")
        assert about["pictures"][name] == others["pictures"][twin]
        with rasterio.open(model / f"images/{twin}") as file:
            ours = file.read(1)
        apart = np.abs(made[8:-8, 8:-8].astype(float) - ours[8:-8, 8:-8])
        assert np.median(apart) <= 1
        assert np.percentile(apart, 99) < 8  # of two kernels; half a pixel off it is 40


def test_nerfstudio_s_cameras_are_colmap_s(model):
    meta = read(model / "transforms.json")
    assert (model / meta["ply_file_path"]).is_file()
    matrices = splatted(model)
    points = np.random.default_rng(2).uniform(-200, 200, (50, 3))
    for frame in meta["frames"]:
        assert (model / frame["file_path"]).is_file()
        assert (model / frame["mask_path"]).is_file()
        pose = np.array(frame["transform_matrix"])
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T  # of OpenGL: right, up, backwards

        seen = np.column_stack([frame["cx"] - frame["fl_x"] * x / z, frame["cy"] + frame["fl_y"] * y / z])
        both, _, _, width, height = matrices[Path(frame["file_path"]).name]
        clip = np.column_stack([points, np.ones(50)]) @ both.astype(float).T
        theirs = (clip[:, :2] / clip[:, 3:] + 1) / 2 * [width, height]
        assert seen == pytest.approx(theirs, abs=0.05)


def test_the_cloud_that_trainers_start_from(model):
    plyfile = pytest.importorskip("plyfile")
    cloud = plyfile.PlyData.read(str(model / "sparse/0/points3D.ply"))["vertex"]
    rows = [line.split() for line in (model / "sparse/0/points3D.txt").read_text().splitlines()]
    assert np.column_stack([cloud[axis] for axis in "xyz"]) == pytest.approx(
        np.array([row[1:4] for row in rows], float), abs=1e-4
    )
    assert np.column_stack([cloud[name] for name in ("red", "green", "blue")]).tolist() == [
        [int(word) for word in row[4:7]] for row in rows
    ]
    assert {cloud[name].max() for name in ("nx", "ny", "nz")} == {0.0}


# --- Sat-NeRF and EOGS --------------------------------------------------------------------------------------


def test_the_arithmetic_of_sat_nerf_and_eogs_runs_on_every_record(run, shared_data):
    out = exported(run, "satnerf")
    names, points = (out / "train.txt").read_text().split("\n"), np.load(out / "pts3d.npy")
    for name, record in ((name, read(out / name)) for name in names):
        with rasterio.open(shared_data / "optical/phr_triplet_whole" / record["img"]) as file:  # its img_dir
            assert (file.width, file.height) == (record["width"], record["height"])
        assert name.removesuffix(".json") == record["img"].rpartition("/")[2].replace(".tif", "")  # EOGS' split
        up, turn = np.radians([float(record["sun_elevation"]), float(record["sun_azimuth"])])
        assert (np.degrees(up), np.degrees(turn)) == pytest.approx((54.8, 153.4), abs=0.2)
        when = datetime.strptime(record["acquisition_date"], "%Y%m%d%H%M%S")
        assert f"{when:%F %H}" == "2013-04-17 10"
        model = rpcm.RPCModel(record["rpc"], dict_format="rpcm")
        low, high = float(record["min_alt"]), float(record["max_alt"])
        seen, at = np.array(record["keypoints"]["2d_coordinates"]), points[record["keypoints"]["pts3d_indices"]]
        ends = [
            ecef(*model.localization(*seen.T, alt), alt) for alt in (np.full(len(seen), high), np.full(len(seen), low))
        ]
        along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0], axis=1)[:, None]
        depth = ((at - ends[0]) * along).sum(axis=1)
        beside = np.linalg.norm(at - ends[0] - depth[:, None] * along, axis=1)
        assert np.median(beside) < 0.05  # m: points lie on the rays of their pixels
        assert record["keypoints"]["depths"] == pytest.approx(depth, abs=0.05)
        image, ground_at = ground(run, name.removesuffix(".json"), (low, high), 2000)
        utm = np.column_stack([*pyproj.Transformer.from_crs("EPSG:4979", "EPSG:32631", always_xy=True).transform(
            *ground_at.T[:2])[:2], ground_at[:, 2], np.ones(len(image))])  # fmt: skip
        view = (image + 0.5) / [record["width"], record["height"]] * 2 - 1
        affine = np.linalg.lstsq(utm - [*utm.mean(axis=0)[:3], 0], view, rcond=None)
        left = view - (utm - [*utm.mean(axis=0)[:3], 0]) @ affine[0]
        assert np.abs(left * [record["width"], record["height"]]).max() < 2.0  # px: EOGS' affine camera


# --- stereo pipelines ---------------------------------------------------------------------------------------


def test_s2p_finds_images_and_cameras(run):
    """Its configuration's cameras are dictionaries that rpcm, its reader, takes."""
    out = exported(run, "s2p")
    config = read(out / "config.json")
    assert config["full_img"] is True
    assert len(config["images"]) == 3
    for one, name in zip(config["images"], NAMES, strict=True):
        with rasterio.open(out / one["img"]) as file:
            assert file.rpcs is not None
            assert off(rpcm.rpc_from_geotiff(str(out / one["img"])), run, name) < 1e-4
            assert file.read(1).std() > 10
        assert off(rpcm.RPCModel(one["rpc"], dict_format="rpcm"), run, name) < 1e-6


def test_cars_reads_the_cameras_with_shareloc(run):
    geomodels = pytest.importorskip("shareloc.geomodels")
    out = exported(run, "cars")
    found = pytest.importorskip("yaml").safe_load((out / "inputs.yaml").read_text())["input"]
    assert {frozenset(pair) for pair in found["pairing"]} <= {frozenset(pair) for pair in combinations(NAMES, 2)}
    for name in NAMES:
        sensor = found["sensors"][name]
        with rasterio.open(out / sensor["image"]) as file:
            assert file.width > 1000
        model = geomodels.GeoModel(str(out / sensor["geomodel"]["path"]), sensor["geomodel"]["model_type"])
        image, at = ground(run, name)
        row, col, _ = model.inverse_loc(*at.T)
        theirs = np.column_stack([col, row]) - 0.5  # it counts from corners
        assert np.abs(theirs - image).max() < 1e-4


@pytest.mark.nightly
def test_cars_takes_its_configuration(run):
    sensor_inputs = pytest.importorskip("cars.pipelines.parameters.sensor_inputs", exc_type=ImportError)
    out = exported(run, "cars")
    given = json.loads((out / "inputs.yaml").read_text())["input"]
    found = sensor_inputs.sensors_check_inputs(given, config_dir=str(out))
    assert list(found["sensors"]) == list(NAMES)
    assert found["pairing"] == given["pairing"]
    for name, sensor in found["sensors"].items():
        assert Path(sensor["geomodel"]["path"]).resolve() == (out / f"{name}.geom").resolve()


def test_asp_gets_maxar_s_xml(run):
    """A reader of the RPB block: offsets, scales, four lists of twenty, in Maxar's names; bias and corners aside."""
    etree = pytest.importorskip("xml.etree.ElementTree")
    out = exported(run, "asp")
    cameras = (out / "cameras.txt").read_text().split()
    images = (out / "images.txt").read_text().split()
    assert cameras == [f"{name}.xml" for name in NAMES]
    for path, file, name in zip(cameras, images, NAMES, strict=True):
        assert (out / file).is_file()
        block = etree.parse(out / path).getroot().find(".//RPB/IMAGE")
        number = {one.tag: float(one.text) for one in block if not len(one)}
        lists = {one.tag: np.array(one[0].text.split(), float) for one in block if len(one)}
        model = rpcm.RPCModel({
            **{f"{theirs}_{kind}": number[f"{ours}{kind.upper()}"]
               for theirs, ours in zip(("row", "col", "lat", "lon", "alt"), MAXAR, strict=True)
               for kind in ("offset", "scale")},
            **{f"{theirs}_{kind}": lists[f"{ours}{kind.upper()}COEFList"].tolist()
               for theirs, ours in (("row", "LINE"), ("col", "SAMP")) for kind in ("num", "den")},
        }, dict_format="rpcm")  # fmt: skip
        assert off(model, run, name) < 1e-4


# --- catalogues, points -------------------------------------------------------------------------------------


def test_pystac_walks_the_catalogue(run):
    pystac = pytest.importorskip("pystac")
    validator = pytest.importorskip("pystac.validation.stac_validator").JsonSchemaSTACValidator()
    out = exported(run, "stac")
    whole = pystac.Collection.from_file(str(out / "collection.json"))
    items = list(whole.get_items())
    assert [item.id for item in items] == list(NAMES)
    for item in items:
        content = read(out / f"{item.id}.json")
        validator.validate_core(content, pystac.STACObjectType.ITEM, "1.1.0", href=None)
        assert f"{item.datetime:%F %H}" == "2013-04-17 10"
        assert item.bbox[0] < 5.44 < item.bbox[2]
        for asset in item.assets.values():
            assert Path(asset.get_absolute_href()).is_file()
        prefixes = {key.partition(":")[0] for key in content["properties"] if ":" in key}
        listed = {one.split("/")[3] for one in item.stac_extensions}
        assert listed == {{"proj": "projection"}.get(one, one) for one in prefixes}
    start, end = whole.extent.temporal.intervals[0]
    assert (start, end) == (min(item.datetime for item in items), max(item.datetime for item in items))


def test_the_table_of_points_lies_on_the_rays(run):
    out = exported(run, "points")
    rows = list(csv.DictReader((out / "points.csv").read_text().splitlines()[1:]))
    at = np.array([[float(row[key]) for key in ("lon", "lat", "alt")] for row in rows])
    tracks = {row["track"]: k for k, row in enumerate(rows)}
    seen = list(csv.DictReader(table(run, "observations")))
    for name in NAMES:
        own = [row for row in seen if row["view"] == name and row["used"] == "1" and row["track"] in tracks]
        xy = np.array([[float(row["col"]), float(row["row"])] for row in own])
        shown = np.column_stack(truth(run, name).projection(*at[[tracks[row["track"]] for row in own]].T))
        assert np.sqrt(((shown - xy) ** 2).sum(axis=1).mean()) < 0.08
