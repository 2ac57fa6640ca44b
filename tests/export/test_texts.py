"""What stands in the files of each export, read with nothing but the standard library and numpy."""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.base.geodesy import ecef_from_ground, enu_basis, ground_from_ecef, metres_per_unit
from barpc.base.verb_options import ExportOptions
from barpc.export import files as made_of
from barpc.export import pinholes
from barpc.export.colmap import colmap
from barpc.export.light import UnknownTimeError, dated
from barpc.export.shots import Scene, pairs_of, read_scene, relative_link
from barpc.rpcio import CARRIERS, read_rpc
from barpc.sensor.centers import camera_center
from barpc.sensor.sampler import Sample, image_grid
from tests.export.conftest import changed, posed, table

OUT = Path("/elsewhere/out")
HOW = ExportOptions()


def with_shot(of: Scene, **fields: Any) -> Scene:
    """The scene with its first shot changed; fields of its entry by the names that it has, of itself else."""
    shot = of.shots[0]
    entry = {key: value for key, value in fields.items() if hasattr(shot.entry, key)}
    own = {key: value for key, value in fields.items() if key not in entry}
    return replace(of, shots=(replace(shot, entry=replace(shot.entry, **entry), **own), *of.shots[1:]))


# --- the scene --------------------------------------------------------------------------------------------


def with_summary(south: Scene, **values: Any) -> Scene:
    return replace(south, run=replace(south.run, summary=replace(south.summary, **values)))


def test_a_scene_holds_what_counts_of_its_run(south, southern):
    lines = [line.split(",") for line in table(southern, "observations")[1:]]
    places = np.loadtxt(table(southern, "residuals"), delimiter=",", skiprows=1)[:, :3]
    for shot in south.shots:
        rows = [line for line in lines if line[0] == shot.name and line[8] == "1"]
        assert south.tracks[shot.index].tolist() == [int(row[1]) for row in rows]
        assert shot.xy == pytest.approx(np.array([[float(row[2]), float(row[3])] for row in rows]))
        assert shot.size == (900, 700)
    assert south.points == pytest.approx(places)
    used = [line for line in lines if line[8] == "1"]
    left = np.array([[float(row[6]), float(row[7])] for row in used])
    free = left.size - 3 * len({row[1] for row in used})
    assert south.noise == pytest.approx(np.sqrt((left**2).sum() / free))


def test_altitudes_reach_a_margin_beyond_all_but_half_a_per_cent(southern, south, tmp_path):
    low, high = np.percentile(south.points[:, 2], [0.5, 99.5])
    margin = 20.0 + 0.1 * (high - low)
    assert south.alt_range == (np.floor(low - margin), np.ceil(high + margin))
    head, first, *_ = table(southern, "residuals")
    cells = first.split(",")
    level = [",".join([*cells[:2], "100.0", *cells[3:-1], track]) for track in "01"]

    def apart(summary: dict[str, Any]) -> None:
        for k, view in enumerate(summary["views"]):
            view["alt_range_m"] = [10.0 * k - 50, 10.0 * k + 500]

    assert read_scene(changed(southern, tmp_path / "two", residuals=[head, *level])).alt_range == (80.0, 120.0)
    assert read_scene(changed(southern, tmp_path / "none", apart, residuals=[head])).alt_range == (-50.0, 520.0)


def test_the_origin_is_in_the_middle_of_the_tie_points(south, dateline):
    for one in (south, dateline):
        lon = one.points[:, 0] % 360.0
        assert one.origin[0] % 360.0 == pytest.approx((lon.min() + lon.max()) / 2)
        assert -180 <= one.origin[0] <= 180
        assert one.origin[1] == np.median(one.points[:, 1])
        assert one.origin[2] == sum(one.alt_range) / 2
    none = replace(south, points=np.zeros((0, 3)))
    assert none.origin[:2] == pytest.approx(south.origin[:2], abs=2e-3)  # of its outlines


def test_the_world_is_metres_east_north_up(south):
    at = south.origin + np.array([[0, 0, 0], [1e-4, 0, 0], [0, 1e-4, 0], [0, 0, 50.0]])
    found = south.world(at)
    degree = metres_per_unit(south.origin)
    assert found == pytest.approx(
        np.array([[0, 0, 0], [degree[0] * 1e-4, 0, 0], [0, degree[1] * 1e-4, 0], [0, 0, 50.0]]), abs=1e-3
    )
    matrix = south.world_to_ecef
    assert found @ matrix[:3, :3].T + matrix[:3, 3] == pytest.approx(ecef_from_ground(at), abs=1e-6)
    assert matrix[3].tolist() == [0, 0, 0, 1]


def test_the_sight_of_a_shot_leads_from_its_middle_to_its_sensor(south):
    shot = south.shots[1]
    sight, far = south.sight_of(shot)
    ground = shot.rpc.localize(np.array([449.5, 349.5]), np.array(south.origin[2]))
    center = camera_center(shot.rpc, shot.size, south.alt_range).ecef
    place = south.world(ground[None])[0] + far * sight
    assert south.world_to_ecef @ np.append(place, 1.0) == pytest.approx(np.append(center, 1.0), abs=1e-6)
    assert far == pytest.approx(np.linalg.norm(center - ecef_from_ground(ground)))
    upper = shot.rpc.localize(np.array([449.5, 349.5]), np.array(south.origin[2] + 100.0))
    along = south.world(upper[None])[0] - south.world(ground[None])[0]
    assert sight == pytest.approx(along / np.linalg.norm(along), abs=2e-2)


def test_samples_lie_on_a_grid_over_image_and_altitudes(south):
    shot = south.shots[0]
    for checked, nodes in ((False, (11, 5)), (True, (21, 9))):
        found = south.samples(shot, checked=checked)
        image, alt = image_grid(shot.size, south.alt_range, nodes)
        assert found.image == pytest.approx(image)
        assert found.ground == pytest.approx(south.world(shot.rpc.localize(image, alt)))
    assert len(south.samples(shot).image) == 11 * 11 * 5
    with pytest.raises(InputError, match="sees no ground"):

        class Blind:
            def localize(self, image, alt):
                return np.where(np.arange(len(image))[:, None] < 11, 1.0, np.nan) * np.ones(3)

        south.samples(replace(shot, rpc=Blind()))


def test_files_are_named_relative_to_where_they_are_named(tmp_path):
    assert relative_link("https://a.org/b/x.tif", OUT) == "https://a.org/b/x.tif"
    assert relative_link("/elsewhere/images/x.tif", OUT) == "../images/x.tif"
    assert relative_link("/elsewhere/out/x.tif", OUT) == "x.tif"


def test_images_of_one_folder_go_by_their_names_and_others_relative(south):
    assert [name.rpartition("/")[2] for name in south.file_names(OUT)] == [
        "north.tif",
        "same.tif",
        "same.tif",
    ]
    assert all(name.startswith("../") for name in south.file_names(OUT))
    one = replace(south, shots=tuple(replace(shot, file=f"/a/{k}.tif") for k, shot in enumerate(south.shots)))
    assert one.file_names(OUT) == ["0.tif", "1.tif", "2.tif"]


def test_pairs_for_stereo_have_an_angle_between_two_and_fifty_degrees(south):
    def pairs(*angles):
        names = [("A", "B"), ("A", "C"), ("B", "C"), ("B", "D")]
        of = [
            replace(south.summary.pairs[0], a=a, b=b, convergence_deg=angle)
            for (a, b), angle in zip(names, angles, strict=False)
        ]
        return pairs_of(replace(south, pairs=tuple(of)))

    assert pairs(2.0, 50.0, 1.9, 50.1) == [("A", "B"), ("A", "C")]
    assert pairs(1.0, None) == [("A", "B"), ("A", "C")]  # better than none


def test_the_run_s_raster_with_the_rpc_in_it_goes_before_the_image(southern, tmp_path):
    names = [f"view_0000{end}" for row in CARRIERS.values() for end in row.suffixes]

    def carrier(folder: str, *said: str, there: Sequence[str] = names) -> Path | None:
        def write(summary: dict[str, Any]) -> None:
            summary["views"][0]["outputs"] |= {name: {} for name in said}
            for name in there:
                (tmp_path / folder / "run" / name).write_text("x")
            if not there:
                (tmp_path / folder / "outside.vrt").write_text("x")
                (tmp_path / folder / "run" / names[0]).symlink_to("../outside.vrt")

        return read_scene(changed(southern, tmp_path / folder, write)).shots[0].carrier

    assert carrier("unsaid") is None  # the run says nothing of it
    for k, name in enumerate(names):
        assert carrier(f"run {k}", *names[k:]) == tmp_path / f"run {k}/run" / name
    assert carrier("linked", names[0], there=()) is None


# --- for renderers ----------------------------------------------------------------------------------------


def test_a_record_of_sat_nerf(south):
    files = made_of.satnerf(dated(south, ["2013-04-17T20:00:00"], []), OUT, HOW)
    shot = south.shots[0]
    one = json.loads(files[f"{shot.name}.json"])
    assert (one["height"], one["width"], one["min_alt"], one["max_alt"]) == (700, 900, *south.alt_range)
    assert one["img"] == south.file_names(OUT)[0]
    assert (one["sun_elevation"], one["sun_azimuth"], one["acquisition_date"]) == (
        52.25,
        150.5,
        "20130417103215",
    )
    middle = shot.rpc.localize(np.array([449.5, 349.5]), np.array(south.origin[2]))
    assert one["geojson"]["center"] == pytest.approx(middle[:2])
    assert one["geojson"]["type"] == "Polygon"
    assert one["keypoints"]["2d_coordinates"] == pytest.approx(shot.xy)
    assert one["keypoints"]["pts3d_indices"] == shot.index.tolist()
    top = ecef_from_ground(shot.rpc.localize(shot.xy, np.full(len(shot.xy), south.alt_range[1])))
    points = np.load(io.BytesIO(files["pts3d.npy"]))
    assert points == pytest.approx(ecef_from_ground(south.points))
    assert one["keypoints"]["depths"] == pytest.approx(np.linalg.norm(top - points[shot.index], axis=1))
    names = [f"{shot.name}.json" for shot in south.shots]
    assert (files["train.txt"].decode(), files["test.txt"].decode()) == ("\n".join(names), names[-1])
    rpc = read_rpc_of(one["rpc"])
    assert rpc.off(shot.rpc).max() < 1e-6


def read_rpc_of(found: dict[str, Any]):
    """The RPC of a dictionary in the names of rpcm, by way of a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.json"
        path.write_text(json.dumps({"rpc": found}))
        return read_rpc(path)


@pytest.mark.parametrize("sign", [[1, -1], [-1, 1]])
def test_a_camera_that_shows_the_ground_mirrored_is_no_pinhole(south, sign):
    rpc = south.shots[0].rpc
    of = with_shot(south, rpc=replace(rpc, image_scale=rpc.image_scale * sign))
    with pytest.raises(InputError, match="mirrored, or no pinhole"):
        pinholes.pinhole_of(of, of.shots[0])


def test_colmap_s_texts_hold_the_scene(south, tmp_path):
    of = replace(south, shots=tuple(replace(shot, file=f"/images/{k}.tif") for k, shot in enumerate(south.shots)))
    files, texts = colmap(of, OUT, ExportOptions(exact=True)), ("cameras", "images", "points3D")
    assert set(files) == {f"sparse/0/{name}.txt" for name in texts} | {
        "sparse/0/points3D.ply", "transforms.json", "world.json",
    }  # fmt: skip
    (tmp_path / "sparse/0").mkdir(parents=True)
    for name in texts:
        (tmp_path / f"sparse/0/{name}.txt").write_bytes(files[f"sparse/0/{name}.txt"])
    about, rows = json.loads(files["world.json"]), (tmp_path / "sparse/0/points3D.txt").read_text().splitlines()
    points = {}
    world = of.world(of.points)
    for line in rows:
        number, *rest = line.split()
        points[int(number)] = np.array(rest[:3], float)
        assert rest[3:6] == ["128"] * 3
        assert points[int(number)] == pytest.approx(world[int(number) - 1])
    assert list(points) == sorted(points)
    errors: dict[int, list[float]] = {number: [] for number in points}
    for k, (shot, image) in enumerate(zip(of.shots, posed(tmp_path), strict=True)):
        assert (image.number, image.camera, image.name, image.size) == (k + 1, k + 1, f"{k}.tif", (900, 700))
        numbers = image.places[:, 2].astype(int).tolist()
        assert image.places[:, :2] == pytest.approx(shot.xy + 0.5)
        assert numbers == (shot.index + 1).tolist()
        off = np.hypot(*(image.project(np.array([points[n] for n in numbers])) - image.places[:, :2]).T)
        assert np.median(off) < 0.4
        for n, error in zip(numbers, off, strict=True):
            errors[n].append(error)
    for line in rows:
        words = line.split()
        assert float(words[7]) == pytest.approx(np.mean(errors[int(words[0])]), abs=1e-6)
        track = [(int(a) - 1, int(b)) for a, b in zip(words[8::2], words[9::2], strict=True)]
        assert [of.shots[image].index[place] + 1 for image, place in track] == [int(words[0])] * len(track)
        assert len(track) == len(errors[int(words[0])]) >= 2
    assert list(about["pinhole_error_px"]) == ["0.tif", "1.tif", "2.tif"]
    assert all(0 < error < 0.5 for error in about["pinhole_error_px"].values())
    assert np.array(about["world_to_ecef"]) == pytest.approx(of.world_to_ecef)
    assert about["alt_range"] == list(of.alt_range)
    assert about["images"] == {f"{k}.tif": f"../../images/{k}.tif" for k in range(3)}


# --- for stereo -------------------------------------------------------------------------------------------


def test_stereo_pipelines_get_images_and_cameras(south, southern):
    carried = with_shot(south, carrier=southern / "a.vrt")
    config = json.loads(made_of.s2p(carried, southern, HOW)["config.json"])
    assert (config["out_dir"], config["full_img"]) == ("s2p_out", True)
    assert config["images"][0]["img"] == "a.vrt"  # the run's raster goes before the image
    assert config["images"][1]["img"] == relative_link(south.shots[1].file, southern)
    assert read_rpc_of(config["images"][1]["rpc"]).off(south.shots[1].rpc).max() < 1e-6
    files = made_of.asp(carried, southern, HOW)
    names = [shot.name for shot in south.shots]
    assert files["cameras.txt"].decode() == "".join(f"{name}.xml\n" for name in names)
    assert files["images.txt"].decode().split("\n")[:2] == ["a.vrt", relative_link(south.shots[1].file, southern)]
    assert files["images.txt"].endswith(b"\n")
    assert set(files) == {*(f"{name}.xml" for name in names), "cameras.txt", "images.txt"}
    for end, made in (("xml", files), ("geom", made_of.cars(south, southern, HOW))):
        path = southern.parent / f"check.{end}"
        path.write_bytes(made[f"{names[0]}.{end}"])
        assert read_rpc(path).off(south.shots[0].rpc).max() < 1e-5


def test_the_yaml_of_cars(south):
    text = made_of.cars(south, OUT, HOW)["inputs.yaml"].decode()
    found = json.loads(text)
    assert pytest.importorskip("yaml").safe_load(text) == found  # as CARS reads it
    first = south.shots[0]
    assert found["input"]["sensors"][first.name] == {
        "image": relative_link(first.file, OUT),
        "geomodel": {"path": f"{first.name}.geom", "model_type": "RPC"},
    }
    assert [tuple(pair) for pair in found["input"]["pairing"]] == list(pairs_of(south))
    assert found["output"] == {"directory": "cars_out"}


# --- for catalogues ---------------------------------------------------------------------------------------


def test_a_stac_item_says_where_when_and_how(south, southern):
    of = dated(south, [], ["2013-04-17"])
    name, texts = south.shots[0].name, made_of.stac(of, OUT, HOW)
    item = json.loads(texts[f"{name}.json"])
    boxes = np.array([json.loads(text)["bbox"] for key, text in texts.items() if key != "collection.json"])
    ends = [*boxes[:, :2].min(axis=0), *boxes[:, 2:].max(axis=0)]
    assert json.loads(texts["collection.json"])["extent"]["spatial"]["bbox"] == [pytest.approx(ends, abs=1e-12)]
    assert (item["type"], item["stac_version"], item["id"]) == ("Feature", "1.1.0", name)
    assert [(one["rel"], one["href"]) for one in item["links"]] == [
        (rel, "./collection.json") for rel in ("root", "parent", "collection")
    ]
    used = {key.partition(":")[0] for key in item["properties"] if ":" in key}
    names = {"proj": "projection/v2.0.0", "view": "view/v1.0.0", "processing": "processing/v1.2.0"}
    assert item["stac_extensions"] == [
        f"https://stac-extensions.github.io/{names[one]}/schema.json" for one in sorted(used)
    ]
    assert used == set(names)
    ring = np.array(item["geometry"]["coordinates"][0])
    assert item["bbox"] == pytest.approx([ring[:, 0].min(), ring[:, 1].min(), ring[:, 0].max(), ring[:, 1].max()])
    found, view = item["properties"], south.shots[0].entry
    assert (found["datetime"], found["proj:shape"], found["proj:code"]) == (
        "2013-04-17T10:32:15.5Z",
        [700, 900],
        None,
    )
    assert "start_datetime" not in found
    assert (found["gsd"], found["view:incidence_angle"], found["view:azimuth"]) == (
        view.gsd_m,
        view.incidence_deg,
        view.azimuth_deg,
    )
    assert (found["view:sun_azimuth"], found["view:sun_elevation"]) == (150.5, 52.25)
    assert found["processing:software"] == {"barpc": south.summary.barpc}
    assert item["assets"]["image"] == {"href": relative_link(south.shots[0].file, OUT), "roles": ["source"]}
    kinds = {
        "a.TIF": ("image/tiff; application=geotiff", "data"), "a.vrt": ("application/xml", "data"),
        "a.xml": ("application/xml", "metadata"), "a.json": ("application/json", "metadata"),
        "a_RPC.TXT": ("text/plain", "metadata"),
    }  # fmt: skip
    run = with_shot(of, written=tuple(kinds))
    assets = json.loads(made_of.stac(run, OUT, HOW)[f"{name}.json"])["assets"]
    for output, (kind, role) in kinds.items():
        assert assets[output] == {"href": relative_link(southern / output, OUT), "type": kind, "roles": [role]}


def test_a_stac_item_of_an_unknown_time_or_day(south, dateline):
    """A day is an interval: no clock is invented."""
    with pytest.raises(UnknownTimeError, match=r"^view_0001, view_0002: no file states the day .* --date YYYY-MM-DD "):
        made_of.stac(south, OUT, HOW)
    of = dated(south, [], ["2013-04-19", "view_0002=2013-04-20"])
    texts = {name: json.loads(text) for name, text in made_of.stac(of, OUT, HOW).items()}
    found = texts["view_0001.json"]["properties"]
    assert [found[key] for key in ("datetime", "start_datetime", "end_datetime")] == [
        None,
        "2013-04-19T00:00:00Z",
        "2013-04-19T23:59:59Z",
    ]
    assert "view:sun_azimuth" not in found
    interval = texts["collection.json"]["extent"]["temporal"]["interval"]
    assert interval == [["2013-04-17T10:32:15.5Z", "2013-04-20T23:59:59Z"]]
    dateline = dated(dateline, [], ["2013-04-17"])
    west, south_lat, east, north = json.loads(made_of.stac(dateline, OUT, HOW)[f"{dateline.shots[0].name}.json"])[
        "bbox"
    ]
    assert 179 < west < 180
    assert -180 < east < -179
    assert south_lat < -16.8 < north


def test_points_are_written_with_their_covariance(south):
    files = made_of.points(south, OUT, HOW)
    comment, header, *rows = files["points.csv"].decode().splitlines()
    place = ", ".join(f"{value:.4g}" for value in south.summary.scene.sigma_enu_m)
    assert comment == (
        f"# covariance [m2] of the intersection alone; noise {south.noise:.4g} px; the scene's own place east, north, "
        f"up is known to [m]: {place}"
    )
    assert header == "track,lon,lat,alt,var_ee,var_en,var_eu,var_nn,var_nu,var_uu"
    table = np.array([row.split(",") for row in rows], float)
    assert table[:, 0].astype(int).tolist() == south.tracks.tolist()
    assert np.abs(table[:, 1:3] - south.points[:, :2]).max() < 1e-9
    assert np.abs(table[:, 3] - south.points[:, 2]).max() < 1e-4
    values, columns = table[:, 4:], np.triu_indices(3)
    for point in (0, 7, 40):  # the inverse of what its rays tell
        ground, normal = south.points[point], np.zeros((3, 3))
        for shot in (one for one in south.shots if point in one.index):
            at = ecef_from_ground(ground)
            moved = [ground_from_ecef(at + s * np.eye(3) @ enu_basis(south.origin)) for s in (0.5, -0.5)]
            steps = (shot.rpc.project(moved[0]) - shot.rpc.project(moved[1])).T
            normal += steps.T @ steps
        expected = south.noise**2 * np.linalg.inv(normal)[columns]
        assert values[point] == pytest.approx(expected, rel=1e-3, abs=1e-9)
    head, body = files["points.ply"].split(b"end_header\n", 1)
    kind = np.dtype([("xyz", "<f8", 3), ("track", "<i4"), ("var", "<f4", 6)])
    cloud = np.frombuffer(body, dtype=kind)
    assert cloud["xyz"] == pytest.approx(south.world(south.points))
    assert cloud["track"].tolist() == south.tracks.tolist()
    assert cloud["var"] == pytest.approx(values, rel=1e-5)
    lines = head.decode().splitlines()
    assert lines[2] == f"comment {comment[2:]}"
    lon, lat, alt = south.origin
    assert (
        lines[3] == f"comment x east, y north, z up [m] of lon {lon:.9f} lat {lat:.9f} alt {alt:.4f} (WGS84, ellipsoid)"
    )
    assert lines[4] == f"element vertex {len(south.points)}"
    assert [line.split()[1:] for line in lines[5:]] == [
        *(["double", axis] for axis in "xyz"), ["int", "track"], *(["float", name] for name in header.split(",")[4:]),
    ]  # fmt: skip
    alone = made_of.points(replace(south, shots=south.shots[:1]), OUT, HOW)["points.csv"]
    assert alone.decode().splitlines()[2].endswith(",,,,,,")  # what one image shows is not known
    unknown = made_of.points(with_summary(south, scene=None), OUT, HOW)["points.csv"]
    assert unknown.decode().splitlines()[0].endswith("is known to [m]: unknown")
    assert isinstance(south.samples(south.shots[0]), Sample)


@pytest.mark.parametrize(
    ("tracks", "noise"),
    [
        ([0, 0, 1, 1, 1], 1.0),
        ([0, 0, 0, 0, 0], np.sqrt(8 * 0.25 / 5)),
        ([0, 0, 1, 2, 2], np.nan),
        ([0, 0, 1], np.nan),  # none to spare
        ([], np.nan),
    ],
)
def test_noise_is_what_is_left_over_the_observations_that_points_did_not_take(southern, tmp_path, tracks, noise):
    """Where an observation has no residual, as the fifth, it is none."""
    left = [f"view_000{k % 3},{track},1,2,0,0,{',' if k == 4 else '0.5,-0.5'},1" for k, track in enumerate(tracks)]
    run = changed(southern, tmp_path, observations=[table(southern, "observations")[0], *left])
    np.testing.assert_allclose(read_scene(run).noise, noise)


def test_stereo_is_made_of_images_without_reservation_that_share_thirty_matches(south):
    views = [replace(view, name=name, advice="look" if name == "C" else "") for view, name in
             zip(south.summary.views, "ABC", strict=True)]  # fmt: skip
    base = replace(south.summary.pairs[0], convergence_deg=12.0, num_matches=30)
    rows = [replace(base, a="A", b="B"), replace(base, a="A", b="C", num_matches=900)]

    def of(*pairs):
        shots = tuple(replace(south.shots[0], entry=view) for view in views)
        return list(pairs_of(replace(south, shots=shots, pairs=pairs)))

    assert of(*rows) == [("A", "B")]
    assert of(rows[1], replace(rows[0], num_matches=29)) == [("A", "C"), ("A", "B")]  # better than none
    assert of(rows[1]) == [("A", "C")]
