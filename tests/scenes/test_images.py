"""Rendered scenes and their files: what truth.json says is what the images show."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

from barpc.base.errors import InputError, OutputError
from barpc.rpcio import read_rpc
from barpc.sensor.centers import camera_center
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.geometry import convergence_angle
from barpc.sensor.rpc import RPC
from barpc.sensor.triangulation import triangulate
from tests.scenes import ImageOptions, Scene, images, write_scene
from tests.scenes.__main__ import command
from tests.scenes.images import inverse

SMALL = ImageOptions(size=(200, 160), seed=3, checks=40, gcps=3)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(SMALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("simulated") / "scene"
    write_scene(out, SMALL)
    return out


@pytest.fixture(scope="module")
def truth(folder):
    return json.loads((folder / "truth.json").read_text())


def correction(view) -> Correction:
    return Correction(view["rotation"], view["translation"], view["center"])


def test_the_delivered_camera_behind_its_correction_is_the_exact_camera(scene):
    """P(R (X - T - C) + C) with the delivered RPC, over the image and the altitudes: to the fit's rounding."""
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 160, (500, 2))
    for shot in scene.shots:
        ground = shot.exact.localize(image, rng.uniform(*scene.alt_range, 500))
        assert np.abs(Corrected(shot.delivered, shot.correction).project(ground) - image).max() < 1e-6
        assert np.abs(shot.exact_rpc.project(ground) - image).max() < 1e-6
        assert np.abs(shot.delivered.project(ground) - image).max() > 1.0


def test_a_correction_and_its_inverse_cancel(scene):
    ecef = scene.shots[0].exact.position(np.arange(5.0)) * 0.9
    given = Correction([1e-3, -2e-3, 5e-4], [30.0, -20.0, 10.0], ecef[0] * 1.1)
    assert np.abs(inverse(given).apply(given.apply(ecef)) - ecef).max() < 1e-8


def test_drift_leaves_the_middle_row_alone_and_bends_the_rest():
    scene = Scene(ImageOptions(size=(200, 160), drift=30e-6, views=2))
    shot = scene.shots[0]
    cols = np.linspace(0, 199, 9)
    error = {}
    for row in (0.0, 79.5, 159.0):
        image = np.stack([cols, np.full(9, row)], axis=1)
        ground = shot.exact.localize(image, np.array(230.0))
        error[row] = Corrected(shot.delivered, shot.correction).project(ground) - image
    assert np.abs(error[79.5]).max() < 1e-4
    assert np.abs(error[0.0] + error[159.0]).max() < 0.05 * np.abs(error[0.0]).max()
    assert np.abs(error[0.0]).max() > 1.0


def test_views_converge_like_those_of_an_agile_satellite(scene):
    angles = [
        float(convergence_angle(scene.shots[a].exact, scene.shots[b].exact, scene.target))
        for a, b in ((0, 1), (1, 2), (0, 2))
    ]
    assert min(angles) > 6.0
    assert max(angles) < 25.0


def test_the_images_carry_the_delivered_rpc_to_the_last_digit(scene, folder, truth):
    for shot, view in zip(scene.shots, truth["views"], strict=True):
        assert read_rpc(folder / view["file"]) == shot.delivered
        with rasterio.open(folder / view["file"]) as dataset:
            assert dataset.rpcs is not None
            assert dataset.dtypes == ("uint16",)
            assert (dataset.width, dataset.height) == SMALL.size
            assert dataset.read(1).min() > 0


def test_check_points_triangulate_to_their_ground_in_the_exact_cameras(truth):
    names = [view["name"] for view in truth["views"]]
    sensors = [RPC(**view["exact_rpc"]) for view in truth["views"]]
    rows = [
        (names.index(name), i, xy)
        for i, point in enumerate(truth["check_points"])
        for name, xy in point["image"].items()
    ]
    view, point, xy = (np.array(part) for part in zip(*rows, strict=True))
    found = triangulate(sensors, view, point, xy)
    assert len(truth["check_points"]) == SMALL.checks
    assert np.abs(found.residuals).max() < 1e-6
    for i, sensor in enumerate(sensors):
        on = view == i
        ground = np.array([truth["check_points"][p]["ground"] for p in point[on]])
        assert np.abs(sensor.project(ground) - xy[on]).max() < 1e-6


def test_check_points_are_in_sight(scene, truth):
    """The altitude that was rendered at a check point's pixel is the check point's."""
    picture = scene.picture(0)
    name = scene.shots[0].name
    for point in truth["check_points"]:
        if name in point["image"]:
            col, row = np.rint(point["image"][name]).astype(int)
            assert abs(picture.altitude[row, col] - point["ground"][2]) < 0.5


def test_gcps_are_given_as_geojson_with_noisy_image_points(scene, folder):
    features = json.loads((folder / "gcps.geojson").read_text())["features"]
    exact = {f"{shot.name}.tif": shot.exact for shot in scene.shots}
    error = [
        exact[f["properties"]["filename"]].project(np.array(f["geometry"]["coordinates"])) - f["properties"]["ji"]
        for f in features
    ]
    assert len({f["properties"]["id"] for f in features}) == 3
    assert 0.05 < np.std(error) < 0.4


@pytest.mark.slow
def test_the_same_command_writes_the_same_bytes(folder, tmp_path):
    write_scene(tmp_path / "again", SMALL)
    for path in (p for p in folder.iterdir() if p.is_file()):
        assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes()


@pytest.mark.slow
def test_another_seed_is_another_scene(scene):
    other = Scene(ImageOptions(size=(200, 160), seed=4))
    a, b = scene.picture(0).numbers.astype(float), other.picture(0).numbers.astype(float)
    assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.5


@pytest.mark.slow
def test_dates_differ_in_light_and_views_of_a_date_do_not():
    scene = Scene(ImageOptions(size=(200, 160), views=4, sun_azimuth=(150.0, 230.0), change=0.3))
    assert [shot.date for shot in scene.shots] == [0, 1, 0, 1]
    assert len(scene.surfaces) == 2
    first, second = (surface.ground.values.ravel() for surface in scene.surfaces)
    assert 0.3 < np.corrcoef(first, second)[0, 1] < 0.95
    assert scene.surfaces[0].terrain is scene.surfaces[1].terrain


@pytest.mark.slow
def test_nothing_is_overwritten_unless_asked(folder):
    with pytest.raises(OutputError, match="--overwrite"):
        write_scene(folder, SMALL)
    write_scene(folder, SMALL, overwrite=True)


@pytest.mark.parametrize(
    "wrong",
    [
        {"views": 0},
        {"size": (10, 10)},
        {"clouds": 1.0},
        {"lat": 89.0},
        {"attitude": -1.0},
        {"sun_azimuth": ()},
    ],
)
def test_options_that_make_no_scene_are_refused(wrong):
    with pytest.raises(InputError):
        ImageOptions(**wrong)


def test_the_command_prints_the_images_that_it_wrote(tmp_path):
    out = tmp_path / "scene"
    result = CliRunner().invoke(command, [str(out), "--views", "2", "--size", "120", "100", "--drift", "5"])
    assert result.exit_code == 0, result.output
    assert result.output.split() == [str(out / "view_00.tif"), str(out / "view_01.tif")]
    assert json.loads((out / "truth.json").read_text())["options"]["drift"] == pytest.approx(5e-6)


@pytest.mark.slow
def test_a_scene_across_the_antimeridian_is_like_any_other():
    scene = Scene(ImageOptions(size=(150, 120), lon=180.0, lat=-16.8, alt=20.0))
    picture = scene.picture(0)
    image, visible = scene.shows(0, scene.candidates(100), picture.altitude)
    assert np.isfinite(picture.altitude).mean() > 0.8
    assert visible.sum() > 15
    assert np.isfinite(image).all()


@pytest.mark.slow
def test_another_turn_is_another_set_of_viewpoints(scene):
    other = Scene(ImageOptions(size=(200, 160), seed=3, turn=0.5))
    for a, b in zip(scene.shots, other.shots, strict=True):
        apart = np.degrees(np.arccos(np.cos(np.radians(a.look.azimuth - b.look.azimuth))))
        assert apart > 5.0 or abs(a.look.incidence - b.look.incidence) > 1.0


@pytest.mark.few(1)
@pytest.mark.parametrize("side", [600, 1000])
def test_the_line_method_finds_the_camera_centre_of_small_images_within_two_percent(side):
    for shot in Scene(ImageOptions(size=(side, side))).shots:
        found = camera_center(shot.delivered, (side, side), (130.0, 400.0))
        assert found.altitude == pytest.approx(shot.look.altitude, rel=0.02)


@pytest.mark.nightly
def test_three_views_of_600_pixels_take_seconds(tmp_path):
    start = time.process_time()
    write_scene(tmp_path / "scene", ImageOptions(size=(600, 600)))
    assert time.process_time() - start < 15.0  # CPU s; some 2 on a machine of its own


@pytest.mark.slow
def test_a_picture_made_in_strips_is_the_picture(monkeypatch):
    scene = Scene(replace(SMALL, snr=0.0))
    whole = scene.picture(1)
    monkeypatch.setattr(images, "_ROWS", 64)
    tops, parts = zip(*scene.strips(1), strict=True)
    assert tops == (0, 64, 128)
    np.testing.assert_array_equal(np.concatenate([part.numbers for part in parts]), whole.numbers)
    np.testing.assert_array_equal(np.concatenate([part.altitude for part in parts]), whole.altitude)
    monkeypatch.setattr(images, "_ROWS", 160)
    ((_, noisy),) = Scene(SMALL).strips(1)
    np.testing.assert_array_equal(noisy.numbers, Scene(SMALL).picture(1).numbers)


@pytest.mark.slow
def test_ground_beyond_what_is_made_is_its_mirror_image_with_all_that_stands_on_it(monkeypatch):
    monkeypatch.setattr(images, "MIRRORED", 60)
    surface = Scene(replace(SMALL, buildings=60.0)).surfaces[0]
    x, y = surface.terrain.relief.axes()
    low, side = np.array([x[0], y[0]]), np.array([x[-1] - x[0], y[-1] - y[0]])
    rng = np.random.default_rng(1)
    inside = low + rng.uniform(0.0, 1.0, (400, 2)) * side
    assert len(surface.terrain.buildings) > 9

    def seen(at):
        return surface.terrain.highest(*at.T), surface.ground(*at.T)

    for turn in ([1, 0], [0, -1], [1, 1]):
        edge = low + side * (np.array(turn) > 0)
        mirrored = np.where(np.array(turn) != 0, 2 * edge - inside, inside)
        for there, here in zip(seen(mirrored), seen(inside), strict=True):
            np.testing.assert_allclose(there, here, rtol=1e-3)
    assert (seen(inside)[0] > surface.terrain.relief(*inside.T) + 1.0).mean() > 0.02
