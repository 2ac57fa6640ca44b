"""One block of a radar view and two optical ones: the adjustment needs nothing but the three methods."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from barpc.ba import Adjustment, AdjustOptions, adjust_tracks
from barpc.base.geodesy import Array, ecef_from_ground, ground_from_ecef, metres_per_unit
from barpc.fit import fit_rpc
from barpc.scene import Tracks, View
from barpc.sensor import SensorModel
from barpc.sensor.centers import camera_center
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.triangulation import triangulate
from barpc.simulate import Look, fly
from tests.everywhere import rows_of
from tests.sensor.s1_product import Product

SIZE = (20000, 19000)
ALT = (0.0, 1000.0)
SIGMA = np.array([0.2, 0.2, 0.1])  # px: optical, optical, radar (2.3 x 14 m)


@dataclass(frozen=True)
class Scene:
    """Views as delivered, their exact cameras, tie points and held-out points."""

    views: tuple[View, ...]
    exact: tuple[SensorModel, ...]
    centers: Array
    tracks: Tracks
    ground: Array
    check: Array

    def only(self, count: int) -> tuple[tuple[View, ...], Tracks]:
        """The first so many views and their observations."""
        keep = self.tracks.view < count
        return self.views[:count], self.tracks.select(keep)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Two optical views 8 m and 6 m off, and a radar view that is exact."""
    rng = np.random.default_rng(11)
    radar = Product().model()
    target = radar.localize(np.array([10000.0, 6000.0]), np.array(300.0))
    flown = [fly(target, look, SIZE, 0.5) for look in (Look(15.0, 100.0), Look(20.0, 280.0))]
    optical = [fit_rpc(camera, SIZE, ALT).rpc for camera in flown]
    centers = [camera_center(camera, SIZE, ALT).ecef for camera in flown]
    middle = radar.orbit.states(np.array([12.5]))[0][:, 0]
    off = [([8e-6, -6e-6, 3e-6], [2.0, 1.0, -1.0]), ([-6e-6, 5e-6, 4e-6], [1.0, -2.0, 1.0])]
    exact = [Corrected(rpc, Correction(*w, c)) for rpc, w, c in zip(optical, off, centers, strict=True)]
    exact.append(radar)
    views = [View(f"optical{k}", "", SIZE, rpc, ALT) for k, rpc in enumerate(optical)]
    views.append(View("radar", "", radar.size, radar, ALT))
    spread = np.array([4000.0, 4000.0, 200.0]) / metres_per_unit(target)
    ground, check = (target + rng.uniform(-1, 1, (n, 3)) * spread for n in (300, 200))
    xy = np.stack([camera.project(ground) for camera in exact], axis=1)
    xy += rng.normal(size=xy.shape) * SIGMA[:, None]
    tracks = Tracks(*rows_of(xy), np.tile(SIGMA, 300))
    return Scene(tuple(views), tuple(exact), np.array([*centers, middle]), tracks, ground, check)


@pytest.fixture(scope="module")
def held(scene: Scene) -> Adjustment:
    """Adjusted, the radar view being exact."""
    options = AdjustOptions(fixed=("radar",), noise_floor=1e-9)
    return adjust_tracks(scene.views, scene.tracks, options, centers=scene.centers)


def seen_by_radar(scene: Scene, result: Adjustment) -> Array:
    """Where the exact radar sees the adjusted points, against where it sees the true ones: median [m]."""
    radar = scene.exact[2]
    points = ground_from_ecef(result.points)
    error = radar.project(points) - radar.project(scene.ground)
    return np.nanmedian(error, axis=0) * [2.33, 13.9]


def test_a_block_of_radar_and_optical_views_is_adjusted_to_its_noise(scene: Scene) -> None:
    result = adjust_tracks(scene.views, scene.tracks, centers=scene.centers)
    assert (result.inlier | result.held_out).mean() >= 0.98
    before = np.linalg.norm(result.residuals_before / scene.tracks.sigma[:, None], axis=1)
    after = np.linalg.norm(result.residuals / scene.tracks.sigma[:, None], axis=1)
    assert np.sqrt((before**2).mean()) >= 5.0
    assert np.sqrt((after[result.inlier] ** 2).mean()) <= np.sqrt(2.0)
    assert 0.9 <= result.noise <= 1.1


def test_an_exact_radar_view_gives_the_block_its_place(scene: Scene, held: Adjustment) -> None:
    views, tracks = scene.only(2)
    without = adjust_tracks(views, tracks, centers=scene.centers[:2])
    assert np.abs(seen_by_radar(scene, without)).max() >= 2.0
    assert np.abs(seen_by_radar(scene, held)).max() <= 0.15
    off = np.linalg.norm(held.points - ecef_from_ground(scene.ground), axis=1)
    alone = np.linalg.norm(without.points - ecef_from_ground(scene.ground), axis=1)
    assert np.nanmedian(off) <= 0.5 * np.nanmedian(alone)


def test_held_out_points_are_seen_where_the_exact_cameras_see_them_once_the_place_is_known(
    scene: Scene, held: Adjustment
) -> None:
    """Relative to each other: the points that the first view sees, carried over to the second."""
    image = np.stack([camera.project(scene.check) for camera in scene.exact], axis=1)
    view, *seen = rows_of(image)
    for cameras, low, high in ((held.sensors, 0.0, 0.1), ([v.sensor for v in scene.views], 1.0, 100.0)):
        residuals = triangulate(cameras, view, *seen).residuals
        optical = residuals[view < 2]
        assert low <= np.sqrt((optical**2).sum(axis=1).mean()) <= high
