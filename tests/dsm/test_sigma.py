"""The cameras' share of sigma, and the frames of matching, against cameras that are moved by hand."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from pyproj import CRS

from barpc.ba import BlockPrior
from barpc.base.geodesy import ecef_from_ground, ground_from_ecef
from barpc.dsm import stereo
from barpc.dsm.stereo import CameraErrors, Tile, noise_of_mean
from barpc.dsm.surface import shaded
from barpc.scene import View
from barpc.sensor.centers import camera_center
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.rpc import RPC
from barpc.sensor.triangulation import intersect_pair, triangulate
from barpc.tie.patches.dense import WINDOW, DenseMatches, epipolar_frame
from tests.dsm.conftest import ALTS
from tests.everywhere import rows_of


@pytest.fixture(scope="module")
def views(rendered):
    size = rendered.scene.options.size
    return [View(s.name, "", size, s.exact_rpc, rendered.scene.alt_range) for s in rendered.scene.shots]


def prior_of(views, information):
    centers = np.array([camera_center(v.sensor, v.size, v.alt_range).ecef for v in views])
    names = tuple(view.name for view in views)
    return BlockPrior(names, "rotation+translation", 0, np.zeros((len(views), 6)), information, centers)


@pytest.mark.parametrize("unknown", range(12))
def test_a_height_moves_as_its_derivative_says_when_a_camera_does(unknown, views):
    """One metre of an unknown of either camera: the pair's points are intersected again, with the others' rays."""
    prior = prior_of(views, np.eye(18))
    errors = CameraErrors.of(prior, views)
    ground = np.array([[5.4, 43.3, 230.0], [5.4005, 43.3004, 250.0]])
    pair, view, part = (0, 2), (0, 2)[unknown // 6], unknown % 6
    seen = [views[k].sensor.project(ground) for k in pair]
    rotation, translation = np.zeros(3), np.zeros(3)
    scene = views[view].sensor.localize((np.array(views[view].size) - 1) / 2, np.array(views[view].altitude))
    distance = np.linalg.norm(prior.center[view] - ecef_from_ground(scene))
    if part < 3:
        rotation[part] = 1.0 / distance
    else:
        translation[part - 3] = 1.0
    moved = Corrected(views[view].sensor, Correction(rotation, translation, prior.center[view]))
    sensors = [moved if k == view else views[k].sensor for k in pair]
    found = triangulate(sensors, *rows_of(np.stack(seen, 1)), alt=230.0)
    change = ground_from_ecef(found.points)[:, 2] - ground[:, 2]
    stated = errors.rows([[pair]], ground)[:, view * 6 + part]
    np.testing.assert_allclose(change, stated, atol=2e-3 * max(1.0, np.abs(stated).max()))


def test_what_is_shared_by_both_cameras_moves_all_heights_alike(views):
    """Of cameras that can only be moved together, the height has that motion's sigma and no more."""
    direction = np.tile(np.r_[np.zeros(3), ecef_up()], 3)  # all translated upwards
    information = (
        1e12 * (np.eye(18) - np.outer(direction, direction) / 3.0) + np.outer(direction, direction) / 9.0 / 4.0
    )
    errors = CameraErrors.of(prior_of(views, information), views)
    rows = errors.rows([[(0, 1)]], np.array([[5.4, 43.3, 230.0], [5.4005, 43.3004, 250.0]]))
    # (each camera by a metre is the sum of the three: information 1 / 4 is a sigma of 2 m)
    np.testing.assert_allclose(errors.sigma(rows), 2.0, rtol=2e-3)
    np.testing.assert_allclose(errors.sigma(rows - rows.mean(axis=0)), 0.0, atol=5e-3)


def ecef_up():
    at = np.array([5.4, 43.3, 230.0])
    step = ecef_from_ground(at + [0, 0, 1.0]) - ecef_from_ground(at)
    return step / np.linalg.norm(step)


@pytest.fixture(scope="module")
def framed(views):
    """The frame of two views, and the places in either of 75 ground points that it is made of."""
    lon, lat = np.meshgrid(np.linspace(5.3995, 5.4005, 5), np.linspace(43.2997, 43.3003, 5))
    alt = np.repeat(np.linspace(*ALTS, 3), lon.size)
    ground = np.column_stack([np.tile(lon.ravel(), 3), np.tile(lat.ravel(), 3), alt])
    places = [view.sensor.project(ground) for view in views[:2]]
    return epipolar_frame(*places, alt), places


def test_rows_of_the_frame_are_epipolar_lines_and_disparity_tells_height(views, framed):
    frame, places = framed
    assert frame.across < 0.02
    other = np.array([[5.40021, 43.29991, 260.0], [5.39972, 43.30022, 215.0]])
    first, second = (
        view.sensor.project(other) @ one[:, :2].T + one[:, 2] for view, one in zip(views, frame.maps, strict=False)
    )
    assert np.abs(first[:, 1] - second[:, 1]).max() < 0.02
    disparity = first[:, 0] - second[:, 0]
    assert ((disparity > 0) & (disparity < frame.num)).all()
    told = np.column_stack([first, disparity, np.ones(2)]) @ frame.altitude
    np.testing.assert_allclose(told, other[:, 2], atol=0.2)
    for one, points in zip(frame.maps, places, strict=True):
        scale = np.linalg.norm(one[:, :2], axis=1)
        np.testing.assert_allclose(scale, [2.0, 1.0], rtol=0.1)  # two columns and one row a pixel
        assert len(points) == 75


@dataclass(frozen=True)
class Wobbly:
    """A camera whose attitude swings along its rows, by so many pixels."""

    still: RPC
    amplitude: float

    def project(self, ground):
        at = self.still.project(ground)
        return at + np.stack([self.amplitude * np.sin(at[..., 1]), np.zeros(at.shape[:-1])], axis=-1)

    def project_jacobian(self, ground):
        at, jacobian = self.still.project_jacobian(ground)
        jacobian[..., 0, :] += self.amplitude * np.cos(at[..., 1:]) * jacobian[..., 1, :]
        return self.project(ground), jacobian

    def localize(self, image, alt):
        back = np.stack([self.amplitude * np.sin(image[..., 1]), np.zeros(image.shape[:-1])], axis=-1)
        return self.still.localize(image - back, alt)


@pytest.mark.parametrize(("amplitude", "few"), [(0.0, True), (0.1, False)])
def test_matches_are_intersected_to_a_millimetre_and_one_by_one_where_a_camera_swings(
    amplitude, few, views, framed, monkeypatch
):
    frame = framed[0]
    col, row = (part.ravel() for part in np.meshgrid(np.arange(-100.0, 100.0), np.arange(-60.0, 60.0)))
    disparity = frame.num / 2 + np.random.default_rng(3).normal(0.0, frame.num / 8, len(col))
    found = DenseMatches(frame, np.stack([col, row, disparity]), np.ones(len(col)), 1.0)
    sensors = [Wobbly(view.sensor, amplitude) for view in views[:2]]
    tile = Tile(CRS.from_epsg(32631).to_wkt(), 694_000.0, 4_797_000.0, 1.0, (200, 120), ALTS)
    expected, asked = tile.on_map(intersect_pair(sensors, (found.a, found.b), found.alt)), []
    monkeypatch.setattr(stereo, "intersect_pair", lambda *given: (asked.extend(given[2]), intersect_pair(*given))[1])
    pair = [replace(view, sensor=sensor) for view, sensor in zip(views, sensors, strict=False)]
    np.testing.assert_allclose(stereo._intersected(pair, tile, found), expected, atol=1e-3)
    assert (len(asked) < 1000) == few


def test_a_slope_to_the_light_is_bright_and_one_away_from_it_dark_and_the_unknown_black():
    """The sign that could be wrong: rows count to the south, light comes from the north-west."""
    east, south = np.meshgrid(np.arange(20.0), np.arange(16.0))
    falls = {"north-west": 0.5 * (east + south), "south-east": -0.5 * (east + south), "flat": 0.0 * east}
    grey = {name: float(np.median(shaded(height.astype(np.float32), 1.0))) for name, height in falls.items()}
    assert grey["north-west"] > grey["flat"] > grey["south-east"]
    height = np.full((6, 6), np.nan, np.float32)
    height[:, :4] = 1.0
    assert (shaded(height, 1.0)[:, 4:] == 0).all()
    assert (shaded(height, 1.0)[:, :3] > 0).all()


@pytest.mark.parametrize("side", [1, 2, 3, 5, 8, 40])
def test_the_mean_of_matches_is_known_as_well_as_what_they_look_at_overlaps(side):
    look = np.ones(WINDOW)
    weights = np.convolve(look, look)  # of the pixels under a match: a mean of steps, each of a window
    seen = np.convolve(weights, np.ones(side) / side)  # under the mean of a row of matches
    assert noise_of_mean(np.array([float(side), 1.0]))[0] == pytest.approx(
        (seen @ seen) / (weights @ weights), abs=0.01
    )
    assert noise_of_mean(np.array([1.0])) == 1.0
