"""Pinhole cameras near an RPC: found exactly where they hold, and where squares are least."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.export import pinholes
from barpc.export.pinholes import Pinhole, fit_camera, pinhole_camera
from barpc.export.shots import Scene
from barpc.sensor.curve import rotation_matrix
from barpc.sensor.sampler import Sample
from tests.export.conftest import ecef

TURN = rotation_matrix(np.array([np.pi - 0.2, 0.1, 0.05]))  # looks down
TRUE = Pinhole(np.array([9000.0, 8500.0]), np.array([480.0, 300.0]), TURN, np.array([20.0, -10.0, 6000.0]))
FAR = float(np.linalg.norm(TRUE.translation))
SIGHT = -TURN.T @ TRUE.translation / FAR


def world(num: int = 60) -> np.ndarray:
    return np.random.default_rng(0).uniform(-400, 400, (num, 3)) * [1.0, 1.0, 0.2]


def fit_pinhole(samples: Sample, sight: np.ndarray, far: float | None = None) -> Pinhole:
    return pinhole_camera(fit_camera(samples, sight, far))


def test_a_pinhole_divides_by_the_depth():
    seen = Pinhole(np.array([100.0, 200.0]), np.array([10.0, 20.0]), np.eye(3), np.array([0.0, 0.0, 5.0]))
    assert seen.project(np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 5.0]])).tolist() == [[30, 100], [20, 60]]


def test_the_error_is_the_largest_distance():
    samples = Sample(np.zeros((3, 3)), np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]))
    assert samples.compare(lambda _: np.array([[0.0, 1.0], [4.0, 5.0], [2.0, 2.0]])) == 5.0


@pytest.mark.parametrize("held", [False, True])
def test_a_pinhole_is_found_where_there_is_one(held):
    points = world()
    samples = Sample(points, TRUE.project(points))
    found = fit_pinhole(samples, SIGHT, FAR if held else None)
    assert samples.compare(found.project) < 1e-7
    assert found.focal == pytest.approx(TRUE.focal, rel=1e-8)
    assert found.center == pytest.approx(TRUE.center, abs=1e-4)
    assert found.rotation == pytest.approx(TRUE.rotation, abs=1e-8)
    assert found.translation == pytest.approx(TRUE.translation, abs=1e-4)


def test_a_pinhole_is_as_far_as_it_is_held_and_shows_the_right_side():
    """Points seen along parallel rays, in axes that are not perpendicular, as an image with a skew shows them."""
    points = world()
    image = points @ np.array([[2.0, 0.02, 0.3], [0.0, -2.0, 0.4]]).T + [480.0, 300.0]
    samples, sight = Sample(points, image), np.array([0.0, 0.0, 1.0])
    errors = []
    for far in (7e5, 1.4e6, 1.4e7):
        found = fit_pinhole(samples, sight, far)
        assert (found.focal > 0).all()
        assert found.rotation @ found.rotation.T == pytest.approx(np.eye(3), abs=1e-9)
        assert np.linalg.det(found.rotation) == pytest.approx(1.0)
        forward, depth = found.rotation[2], found.translation[2]
        assert -(forward @ sight) / depth == pytest.approx(1 / far)
        errors.append(samples.compare(found.project))
    assert errors[0] < 0.5
    assert errors[1] == pytest.approx(errors[0] / 2, rel=0.1)  # an affine image is seen from far away
    assert errors[2] == pytest.approx(errors[0] / 20, rel=0.1)


def test_a_mirrored_image_has_no_focal_lengths_of_one_sign():
    points = world()
    image = points @ np.array([[2.0, 0.02, 0.3], [0.0, 2.0, 0.4]]).T
    assert (fit_pinhole(Sample(points, image), np.array([0.0, 0.0, 1.0]), 7e5).focal < 0).tolist() == [False, True]


def test_a_camera_at_infinity_is_refused_by_its_numbers_not_by_a_failure():
    points = world()
    found = fit_pinhole(Sample(points, points[:, :2] * [2.0, -2.0]), np.array([0.0, 0.0, 1.0]))
    assert not ((found.focal > 0).all() and (found.focal < 1e9).all())


def test_the_same_points_give_the_same_bytes_wherever_they_lie_in_memory():
    points = world(200)
    image = TRUE.project(points) + np.random.default_rng(1).normal(0, 0.5, (200, 2))
    found = set()
    for shift in range(0, 64, 8):
        held = np.zeros(points.nbytes + 64, np.uint8)[shift:][: points.nbytes].view(float).reshape(points.shape)
        held[:] = points
        one = fit_pinhole(Sample(held, image.copy()), SIGHT)
        found.add(b"".join(part.tobytes() for part in (one.focal, one.center, one.rotation, one.translation)))
    assert len(found) == 1


def test_a_pinhole_of_noisy_points_is_where_their_squares_are_least():
    """No unknown that is moved lessens the sum of squares: of its parabola, the bottom is there."""
    points = world(200)
    noise = np.random.default_rng(1).normal(0, 0.5, (200, 2))
    samples = Sample(points, TRUE.project(points) + noise)
    found = fit_pinhole(samples, SIGHT)

    def cost(step: np.ndarray) -> float:
        """Of a small turn, a move, logarithms of the focal lengths, the principal point."""
        turned = rotation_matrix(step[:3]) @ found.rotation
        focal, center = found.focal * np.exp(step[6:8]), found.center + step[8:]
        moved = Pinhole(focal, center, turned, found.translation + step[3:6])
        return float(((moved.project(points) - samples.image) ** 2).sum())

    least = cost(np.zeros(10))
    assert least < float((noise**2).sum())
    for step in np.diag([1e-5] * 3 + [0.1] * 3 + [1e-5] * 2 + [0.1] * 2):
        high, low = cost(step), cost(-step)
        assert (high - low) ** 2 / 8 / (high + low - 2 * least) < 1e-6 * least


# --- pictures -----------------------------------------------------------------------------------------------


def test_a_skewed_camera_is_found_where_there_is_one():
    camera = np.array([[9000.0, 40.0, 480.0], [0.0, 8500.0, 300.0], [0.0, 0.0, 1.0]]) @ np.column_stack(
        [TRUE.rotation, TRUE.translation]
    )
    points = world()
    seen = np.column_stack([points, np.ones(len(points))]) @ camera.T
    found = fit_camera(Sample(points, seen[:, :2] / seen[:, 2:]), SIGHT, skewed=True)
    assert found / found[2, 3] == pytest.approx(camera / camera[2, 3], rel=1e-6, abs=1e-9)


def missed(scene: Scene, shot, picture, margin: float = 0.0) -> np.ndarray:
    """How far [px] the plain arithmetic of a reader is from the ground that the RPC sees in a picture, by PROJ."""
    rng, (col, row, width, height) = np.random.default_rng(5), picture.window
    image = rng.uniform([col, row], [col + width - 1, row + height - 1], (4000, 2))
    alt = rng.uniform(*scene.alt_range, 4000)
    matrix, at = np.linalg.inv(scene.world_to_ecef), ecef(*shot.rpc.localize(image, alt).T[:2], alt)
    x, y, z = ((at @ matrix[:3, :3].T + matrix[:3, 3]) @ picture.pinhole.rotation.T + picture.pinhole.translation).T
    (fx, fy), (w, h) = picture.pinhole.focal, picture.size
    assert fx == fy  # square
    shown = np.column_stack([fx * x / z + w / 2, fx * y / z + h / 2])
    assert (shown >= 0).all()
    assert (shown <= [w, h]).all()
    back = np.column_stack([shown, np.ones(4000)]) @ picture.homography.T
    scale = np.sqrt(abs(np.linalg.det(picture.homography)))  # of pixels: near 1
    assert scale == pytest.approx(1.0, abs=0.01)
    return np.linalg.norm(back[:, :2] / back[:, 2:] - 0.5 - image, axis=1)


def test_a_central_camera_misses_what_it_says_and_parts_as_much_less_as_they_are_smaller(south, dateline):
    for scene in (south, dateline):
        for shot in scene.shots:
            errors = []
            for window in ((0, 0, 900, 700), (450, 0, 450, 350)):
                picture = pinholes.central_picture(scene, shot, window)
                errors.append(missed(scene, shot, picture).max())
                assert 0.7 * picture.error < errors[-1] < 1.05 * picture.error
            assert errors[0] < 0.2
            assert errors[1] < 0.6 * errors[0]


def test_the_centre_is_above_the_ground_and_the_picture_keeps_the_axes_of_the_image(south):
    for shot in south.shots:
        picture = pinholes.central_picture(south, shot, (100, 50, 300, 200))
        assert -picture.pinhole.rotation.T[2] @ picture.pinhole.translation > 300e3
        assert picture.homography[:2, :2] == pytest.approx(np.eye(2), abs=0.1)
        assert np.array(picture.size) == pytest.approx([300, 200], rel=0.1)


def test_an_image_that_shows_the_ground_mirrored_gets_a_picture_that_does_not(south):
    scene, shot = south, south.shots[0]
    mirrored = replace(shot, rpc=replace(shot.rpc, image_scale=shot.rpc.image_scale * [1, -1]))
    picture = pinholes.central_picture(scene, mirrored, (0, 0, 900, 700))
    assert np.linalg.det(picture.pinhole.rotation) == pytest.approx(1.0)
    assert np.linalg.det(picture.homography[:2, :2]) < 0
    assert missed(scene, mirrored, picture).max() < 1.05 * picture.error < 0.2


def test_parts_are_the_fewest_that_stay_within_the_tolerance(south):
    scene, shot = south, south.shots[0]
    for tolerance, most in ((0.2, 1), (0.1, 4)):
        pictures = pinholes.pictures_of(scene, shot, tolerance)
        assert len(pictures) <= most
        assert max(missed(scene, shot, one).max() for one in pictures) < tolerance
        covered = np.zeros((700, 900), int)
        for col, row, width, height in (one.window for one in pictures):
            covered[row : row + height, col : col + width] += 1
        assert (covered == 1).all()
    with pytest.raises(InputError, match=r"parts of 64 px are not within 0\.001 px of .* a larger --tolerance"):
        pinholes.pictures_of(scene, shot, 0.001)
