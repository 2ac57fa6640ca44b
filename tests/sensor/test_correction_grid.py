"""What an RPC lacks: its sign, its nodes, and that linear interpolation between them is worth what is promised."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.base.errors import RpcError
from barpc.fit import fit_rpc
from barpc.sensor.direct_grid import LINEAR, DirectGrid, linear_axes
from barpc.sensor.image_corrections import CorrectionGrid, Displaced, ImageAffine, ImageCorrected
from tests.jitter import scene

SIZE, ALTS = (8000, 8000), (0.0, 1000.0)


@pytest.fixture(scope="module")
def camera():
    return scene(3000.0, 0.7)


def check_points(camera, seed=11, count=4000):
    """Ground points (N, 3) and where the camera sees them (N, 2), corners included."""
    rng = np.random.default_rng(seed)
    image = rng.uniform(-0.5, np.array(SIZE) - 0.5, (count, 2))
    image[:4] = [[-0.5, -0.5], [7999.5, -0.5], [-0.5, 7999.5], [7999.5, 7999.5]]
    return camera.localize(image, rng.uniform(*ALTS, count)), image


def test_a_true_position_is_that_of_the_rpc_and_the_correction(camera):
    """The image stands 2 columns right of and 3 rows above where the RPC says: (2, -3) is added, not taken off."""
    rpc = camera.sensor
    moved = ImageCorrected(rpc, ImageAffine([2.0, -3.0], np.zeros((2, 2))))
    lacking = CorrectionGrid.between(rpc, moved, SIZE, 500.0)
    np.testing.assert_allclose(lacking.shift, np.broadcast_to([2.0, -3.0], lacking.shift.shape), atol=1e-5)
    np.testing.assert_allclose(lacking.apply(np.array([[10.0, 20.0]])), [[12.0, 17.0]], atol=1e-5)


def test_nodes_reach_from_corner_to_corner_of_the_image_and_no_farther(camera):
    """What grows over the image is met at its outer corners, too; beyond them it stays as it is there."""
    stretched = ImageCorrected(camera.sensor, ImageAffine([0.0, 0.0], [[1e-3, 0.0], [0.0, -2e-3]]))
    lacking = CorrectionGrid.between(camera.sensor, stretched, (3000, 2000), 500.0)
    assert [lacking.cols[0], lacking.cols[-1], lacking.rows[0], lacking.rows[-1]] == [-0.5, 2999.5, -0.5, 1999.5]
    corners = np.array([[-0.5, -0.5], [2999.5, 1999.5]])
    np.testing.assert_allclose(lacking.at(corners), corners * [1e-3, -2e-3], rtol=0, atol=1e-5)
    np.testing.assert_array_equal(lacking.at(corners + [[-9.0, -9.0], [9.0, 9.0]]), lacking.at(corners))


def test_an_rpc_and_its_correction_are_the_camera_between_the_nodes(camera):
    """Without it the RPC misses by half a pixel and more; with it by no more than what is promised, but not by far
    less: nodes cost space."""
    lacking = CorrectionGrid.between(camera.sensor, camera, SIZE, 500.0)
    ground, image = check_points(camera)
    bare = np.linalg.norm(camera.sensor.project(ground) - image, axis=1)
    whole = Displaced(camera.sensor, lacking)
    left = np.linalg.norm(whole.project(ground) - image, axis=1)
    assert 0.5 < bare.max() < 1.5
    assert LINEAR / 10 < left.max() < LINEAR
    back = whole.localize(image, ground[:, 2])
    assert np.linalg.norm(camera.project(back) - image, axis=1).max() < LINEAR


@pytest.mark.few(1)
@pytest.mark.parametrize("period", [1024.0, 512.0, 256.0])
def test_no_wave_hides_between_the_nodes(period):
    """Periods of the very distances that are tried first: nodes that meet a wave at one phase see nothing of it."""
    camera = scene(period, 0.3)
    lacking = CorrectionGrid.between(camera.sensor, camera, SIZE, 500.0)
    ground, image = check_points(camera)
    left = np.linalg.norm(lacking.apply(camera.sensor.project(ground)) - image, axis=1)
    assert LINEAR / 10 < left.max() < 1.5 * LINEAR
    assert np.diff(lacking.rows).max() < period / 8
    assert len(lacking.cols) < 40 < len(lacking.rows)  # the wave runs along the rows only


def test_a_step_between_detectors_is_met_as_near_as_nodes_may_stand():
    def stepped(points):
        return np.where(points[..., :1] < 3141.5, 0.0, 0.1) * np.ones(2)

    cols, rows = linear_axes(stepped, np.zeros(2), np.full(2, 8000.0), np.full(2, 1024.0), LINEAR)
    assert len(cols) == 1025
    assert len(rows) == 9


@pytest.mark.slow
@pytest.mark.parametrize("period", [2700.0, 1024.0])
def test_a_localisation_grid_is_the_camera_for_those_who_interpolate_linearly(period):
    from scipy.interpolate import RegularGridInterpolator

    camera = scene(period, 0.5)
    grid = DirectGrid.of(camera, SIZE, ALTS)
    ground, image = check_points(camera)
    linear = RegularGridInterpolator((grid.alts, grid.rows, grid.cols), grid.lonlat)
    seen = camera.project(np.column_stack([linear(np.column_stack([ground[:, 2], image[:, ::-1]])), ground[:, 2]]))
    off = np.linalg.norm(seen - image, axis=1).max()
    assert LINEAR / 10 < off < LINEAR
    assert np.linalg.norm(grid.project(ground) - image, axis=1).max() < 1e-4  # by splines
    assert (grid.cols[0], grid.cols[-1], grid.rows[-1]) == (-0.5, 7999.5, 7999.5)
    assert grid.lonlat.nbytes < 8e6


def test_a_grid_of_a_narrow_image_is_inverted_everywhere():
    """One cell would do for linear interpolation, but splines through two nodes do not find every point again."""
    camera, size, alts = scene(400.0, 0.5, (240, 1200), (180.0, 280.0)), (240, 1200), (180.0, 280.0)
    rng = np.random.default_rng(1)
    image = rng.uniform(-0.5, np.array(size) - 0.5, (3000, 2))
    ground = camera.localize(image, rng.uniform(*alts, 3000))
    assert np.abs(DirectGrid.of(camera, size, alts).project(ground) - image).max() < 1e-3


@pytest.mark.slow
def test_a_looser_promise_takes_fewer_nodes(camera):
    fine, coarse = (DirectGrid.of(camera, SIZE, ALTS, tolerance).lonlat.size for tolerance in (0.005, 0.05))
    assert 10 * coarse < fine


def test_a_camera_that_sees_no_ground_in_a_part_of_the_image_gets_no_grid(camera):
    class Blind:
        def __getattr__(self, name):
            return getattr(camera, name)

        def localize(self, image, alt):
            ground = camera.localize(image, alt)
            return np.where(np.asarray(image)[..., :1] > 6000, np.nan, ground)

    for make in (
        lambda: DirectGrid.of(Blind(), SIZE, ALTS),
        lambda: CorrectionGrid.between(Blind(), camera, SIZE, 0.0),
    ):
        with pytest.raises(RpcError, match="no ground point"):
            make()


@pytest.mark.parametrize(
    ("cols", "rows", "shift"),
    [
        ([0.0], [0.0, 1.0], np.zeros((2, 1, 2))),
        ([1.0, 0.0], [0.0, 1.0], np.zeros((2, 2, 2))),
        ([0.0, 1.0], [0.0, 2.0, 2.0], np.zeros((3, 2, 2))),
        ([0.0, 1.0], [0.0, 1.0], np.zeros((2, 3, 2))),
        ([0.0, 1.0], [0.0, 1.0], np.full((2, 2, 2), np.nan)),
    ],
)
def test_what_is_no_grid_is_refused(cols, rows, shift):
    with pytest.raises(RpcError):
        CorrectionGrid(cols, rows, shift)


@pytest.mark.slow
def test_the_best_single_rpc_is_no_base_for_a_correction_that_knows_no_altitude():
    """The reason why another RPC may stand in a correction grid: what the best one lacks depends on the altitude."""
    camera = scene(4000.0, 0.7)
    best = fit_rpc(camera, SIZE, ALTS, strict=False).rpc
    ground, image = check_points(camera)
    off = [
        np.linalg.norm(
            CorrectionGrid.between(rpc, camera, SIZE, 500.0).apply(rpc.project(ground)) - image, axis=1
        ).max()
        for rpc in (best, camera.sensor)
    ]
    assert off[0] > 4 * off[1]
    assert off[1] < LINEAR
