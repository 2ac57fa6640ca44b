"""`barpc convert --move` and `--transform`: the cameras follow the ground, with the sign that was said."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from barpc.base.errors import Remark
from barpc.base.geodesy import ecef_from_ground, enu_basis, ground_from_ecef
from barpc.cameras import open_camera
from barpc.rpcio import read_rpc
from barpc.scene import Camera
from barpc.sensor.triangulation import triangulate
from barpc.verbs.moving import moved
from tests.cli.test_main import run
from tests.reliability.conftest import assert_one_line, barpc
from tests.reliability.trials import SAMPLES
from tests.rpcio.conftest import make_rpc

pytestmark = pytest.mark.filterwarnings("ignore::barpc.base.errors.Remark")  # the motion and the refit are told


def _seen(camera, count=50):
    """Ground points that a camera sees, and where."""
    rng = np.random.default_rng(3)
    xy = rng.uniform(0, camera.extent, (count, 2))
    return camera.model.localize(xy, rng.uniform(*camera.alt_range, count)), xy


def _similarity(at, scale):
    """A matrix (4, 4) that moves a point (3,) by 60 m or so, turns about it and scales."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.from_rotvec([1e-4, -2e-4, 5e-5]).as_matrix()
    matrix[:3, 3] = at + [20.0, -30.0, 50.0] - matrix[:3, :3] @ at
    return matrix


def _saved(matrix, folder: Path) -> str:
    np.savetxt(folder / "t.txt", matrix, fmt="%.17g")
    return str(folder / "t.txt")


_IMAGES_ALONE = "md_ov", "ssc1d3"
"""OrbView-3's denominators are those of no turned RPC; SkySat's states two degrees of ground for an image of 2 km."""


def test_the_cameras_show_points_after_a_move_where_they_showed_them_before(image: Path, tmp_path: Path, capsys):
    before = open_camera(image)
    ground, xy = _seen(before)
    assert run("convert", str(image), "-o", str(tmp_path / "out"), "--move", "-30,40,90") == 0
    after = open_camera(tmp_path / "out" / "scene.vrt")
    # told from the points themselves: up is up, and a motion against the sign would be twice as far
    told = capsys.readouterr().err
    at = np.array([*map(float, re.search(r"at its middle, lon (\S+), lat (\S+)$", told, re.M).groups()), 0.0])
    assert np.abs(at - ground.mean(axis=0))[:2].max() < 2e-3
    moved = ground_from_ecef(ecef_from_ground(ground) + enu_basis(at).T @ [-30.0, 40.0, 90.0])
    np.testing.assert_allclose((moved - ground)[:, 2], 90.0, atol=0.1)
    np.testing.assert_allclose(after.model.project(moved), xy, rtol=0, atol=1e-6)
    assert np.abs(after.model.project(ground) - xy).min() > 1.0
    assert after.alt_range[0] == pytest.approx(before.alt_range[0] + 90, abs=60)
    assert "-30.000 m east, +40.000 m north, +90.000 m up" in told


@pytest.mark.few(1)
@pytest.mark.parametrize("scale", [1.0, 1.00002, 0.99998])
def test_a_matrix_is_followed_to_the_last_digit(image: Path, tmp_path: Path, scale: float, capsys):
    ground, xy = _seen(open_camera(image))
    ecef = ecef_from_ground(ground)
    matrix = _similarity(ecef.mean(axis=0), scale)
    out = tmp_path / "out"
    assert run("convert", image, "-o", out, "--transform", _saved(matrix, tmp_path), "--json") == 0
    there = ground_from_ecef(ecef @ matrix[:3, :3].T + matrix[:3, 3])
    np.testing.assert_allclose(read_rpc(out / "scene_RPC.TXT").project(there), xy, rtol=0, atol=1e-7)
    said = capsys.readouterr()
    assert all(row["max_px"] < 1e-6 for row in json.loads(said.out) if row["max_px"] is not None)
    assert "turned by 229 urad" in said.err
    assert "few digits" not in said.err


def test_back_and_forth_is_where_it_was(image: Path, tmp_path: Path):
    ground, xy = _seen(open_camera(image))
    matrix = _similarity(ecef_from_ground(ground[0]), 1.00001)
    np.savetxt(tmp_path / "back.txt", np.linalg.inv(matrix)[:3], fmt="%.17g", delimiter=",")
    once, twice = tmp_path / "once", tmp_path / "twice"
    assert run("convert", image, "-o", once, "--transform", _saved(matrix, tmp_path)) == 0
    assert run("convert", image, "--rpc", once, "-o", twice, "--transform", tmp_path / "back.txt") == 0
    np.testing.assert_allclose(read_rpc(twice / "scene.vrt").project(ground), xy, rtol=0, atol=1e-6)


@pytest.mark.parametrize("length", [1.0, 30.0, 1000.0])
def test_the_rpc_of_a_crop_still_holds_all_the_ground_that_it_was_made_for(image: Path, tmp_path: Path, length: float):
    """Its image is a seventieth of that: an RPC fitted there alone is off elsewhere."""
    before = open_camera(image)
    rpc = before.rpc
    ground = rpc.ground_offset + np.random.default_rng(0).uniform(-1, 1, (500, 3)) * rpc.ground_scale
    matrix = _similarity(ecef_from_ground(ground).mean(axis=0), 1.00001)
    matrix[:3, 3] *= 1.0 + length / 6.4e6
    assert run("convert", image, "-o", tmp_path / "o", "--transform", _saved(matrix, tmp_path)) == 0
    there = ground_from_ecef(ecef_from_ground(ground) @ matrix[:3, :3].T + matrix[:3, 3])
    after = open_camera(tmp_path / "o" / "scene.vrt")
    np.testing.assert_allclose(after.rpc.project(there), rpc.project(ground), rtol=0, atol=1e-6)
    assert after.size == before.size


def test_what_no_rpc_holds_so_exactly_is_fitted_over_its_image(shared_data: Path):
    """OrbView-3's, a kilometre away: 2e-5 px over its 220 Mpx, and nothing in a corner of it."""
    camera = open_camera(str(shared_data / "rpc_formats" / "md_ov_rpc.txt"))
    crop = replace(camera, model=camera.rpc.crop(6000, 20000), size=(500, 400))
    with pytest.warns(Remark) as said:
        (after,) = moved([crop], np.array([600.0, -700.0, 400.0]), None)
    assert float(re.search(r"moved and refitted to (\S+) px", str(said[0].message))[1]) < 1e-7
    assert after.rpc.image_scale.tolist() == [250.0, 200.0]


def test_an_image_beyond_what_its_rpc_states_is_held_too():
    rpc = make_rpc()
    for size in ((300, 200), (2600, 2500)):
        (after,) = moved([Camera(rpc, Path("a.RPB"), "rpb", size, (0.0, 300.0))], np.full(3, 50.0), None)
        ends = after.rpc.image_offset + [[-1.0], [1.0]] * after.rpc.image_scale
        assert (ends[0] <= -0.5).all()
        assert (ends[1] >= np.array(size) - 0.5).all()


@pytest.mark.landing(3)
@pytest.mark.few(2)
@pytest.mark.parametrize("length", [1.0, 30.0, 1000.0])
@pytest.mark.parametrize("turn", [0.0, 1e-4])
def test_vendors_rpcs_follow_a_motion_over_all_their_ground(
    shared_data: Path, tmp_path: Path, length: float, turn: float
):
    """PROJ moves the ground: of the image, and all that the RPC is made for."""
    to_ecef = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    rng, count = np.random.default_rng(int(length)), 0
    for path in sorted((shared_data / "rpc_formats").iterdir()):
        if path.suffix == ".gcp":
            continue
        camera = open_camera(str(path))
        rpc = camera.rpc
        size = camera.size or tuple(int(n) for n in np.ceil(rpc.image_offset + np.abs(rpc.image_scale)))
        xy = rng.uniform(0, 1, (300, 2)) * size
        ground = rpc.localize(xy, rng.uniform(*camera.alt_range, 300))
        if not any(name in path.name for name in _IMAGES_ALONE):
            ground = np.vstack([ground, rpc.ground_offset + rng.uniform(-1, 1, (300, 3)) * rpc.ground_scale])
        ecef = np.stack(to_ecef.transform(*ground.T), axis=-1)
        shift = rng.normal(size=3)
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec(turn * rng.normal(size=3)).as_matrix()
        middle = ecef.mean(axis=0)
        matrix[:3, 3] = middle - matrix[:3, :3] @ middle + length * shift / np.linalg.norm(shift)
        (after,) = moved([replace(camera, size=size)], None, _saved(matrix, tmp_path))
        moved_to = ecef @ matrix[:3, :3].T + matrix[:3, 3]
        there = np.stack(to_ecef.transform(*moved_to.T, direction="INVERSE"), axis=-1)
        off = np.abs(after.rpc.project(there) - rpc.project(ground)).max()
        assert off < (5e-5 if "md_ov" in path.name else 1e-5), path.name
        count += 1
    assert count == 17


@pytest.mark.few(1)
@pytest.mark.parametrize("words", [("--move", "200,-100,50"), ("--transform", "")])
def test_rays_of_three_images_meet_where_the_motion_takes_the_point(tmp_path: Path, words):
    old = [open_camera(file).model for file in SAMPLES]
    rng = np.random.default_rng(1)
    alt = rng.uniform(150, 250, 20)
    ground = old[0].localize(rng.uniform(200, 800, (20, 2)), alt)
    ecef = ecef_from_ground(ground)
    matrix = _similarity(ecef.mean(axis=0), 1.00001)
    flag, value = words
    value = value or _saved(matrix, tmp_path)
    assert run("convert", *SAMPLES, "-o", tmp_path / "out", flag, value) == 0
    new = [read_rpc(tmp_path / "out" / f"{file.stem}_RPC.TXT") for file in SAMPLES]
    seen = np.stack([model.project(ground) for model in old])
    point, view = np.tile(np.arange(20), 3), np.repeat(np.arange(3), 20)
    found = triangulate(new, view, point, seen.reshape(-1, 2)).points
    off = np.concatenate([new[v].project(ground_from_ecef(found)) - seen[v] for v in range(3)])
    np.testing.assert_allclose(off, 0.0, atol=1e-6)
    if flag == "--transform":
        there = ecef @ matrix[:3, :3].T + matrix[:3, 3]
        np.testing.assert_allclose(found, there, rtol=0, atol=1e-4)
    else:
        shift = found - ecef
        np.testing.assert_allclose(shift - shift[0], 0, atol=1e-4)
        np.testing.assert_allclose(enu_basis(ground[0]) @ shift[0], [200, -100, 50], atol=0.1)


def test_few_digits_are_told_in_metres(image: Path, tmp_path: Path, capsys):
    ground, _ = _seen(open_camera(image))
    np.savetxt(tmp_path / "t.txt", _similarity(ecef_from_ground(ground).mean(axis=0), 1.0), fmt="%f")
    assert run("convert", str(image), "-o", str(tmp_path / "o"), "--transform", str(tmp_path / "t.txt")) == 0
    assert "few digits: it determines the ground to some" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("move", "told"),
    [
        ("1,2", "must be 3 values, each a number"),
        ("1,2,3,4", "must be 3 values, each a number"),
        ("1 2 3", "must be 3 values, each a number"),
        ("1,2,x", "and below 22000 [m], found 'x'"),
        ("1,2,nan", "above -22000 and below 22000 [m]"),
        ("1,inf,3", "above -22000 and below 22000 [m]"),
        ("602000,4795000,100", "above -22000 and below 22000 [m]"),
    ],
)
def test_a_move_is_three_numbers_of_metres(image: Path, tmp_path: Path, move: str, told: str):
    assert_one_line(barpc("convert", image, "-o", tmp_path / "o", "--move", move), 2, told)
    assert not (tmp_path / "o").exists()


def test_a_longitude_and_latitude_in_the_images_is_no_move(image: Path, tmp_path: Path, capsys):
    lon, lat, _ = open_camera(image).model.localize(np.array([150.0, 100.0]), np.array(100.0))
    for words in (f"{lon:.5f},{lat:.5f},180", f"{lat:.5f},{lon:.5f},180"):
        assert run("convert", str(image), "-o", str(tmp_path / "o"), "--move", words) == 1
        assert "is a longitude and latitude in the images" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_a_matrix_that_leaves_the_earth_writes_nothing(image: Path, tmp_path: Path, capsys):
    matrix = np.eye(4)
    for matrix[:3, :3] in (2.0 * np.eye(3), 1.01 * np.eye(3)):  # as of map coordinates in feet, or of a local frame
        assert run("convert", image, "-o", tmp_path / "o", "--transform", _saved(matrix, tmp_path)) == 1
        assert "a matrix of other coordinates than ECEF?" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_a_motion_goes_with_a_folder_and_there_is_one(image: Path, tmp_path: Path, capsys):
    assert run("convert", str(image), str(tmp_path / "a_RPC.TXT"), "--move", "1,2,3") == 2
    assert "with it: --rpc, --images, --move, --transform" in capsys.readouterr().err
    both = ("--move", "1,2,3", "--transform", "t.txt")
    assert_one_line(barpc("convert", image, "-o", tmp_path / "o", *both), 2, "give either --move or --transform")
