"""Pinhole cameras near an RPC: found exactly where they hold, and where squares are least."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.export.pinholes import Pinhole, fit_pinhole
from barpc.export.shots import Sampled
from barpc.sensor.curve import rotation_matrix

TURN = rotation_matrix(np.array([np.pi - 0.2, 0.1, 0.05]))  # looks down
TRUE = Pinhole(np.array([9000.0, 8500.0]), np.array([480.0, 300.0]), TURN, np.array([20.0, -10.0, 6000.0]))
FAR = float(np.linalg.norm(TRUE.translation))
SIGHT = -TURN.T @ TRUE.translation / FAR


def world(num: int = 60) -> np.ndarray:
    return np.random.default_rng(0).uniform(-400, 400, (num, 3)) * [1.0, 1.0, 0.2]


def test_a_pinhole_divides_by_the_depth():
    seen = Pinhole(np.array([100.0, 200.0]), np.array([10.0, 20.0]), np.eye(3), np.array([0.0, 0.0, 5.0]))
    assert seen.project(np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 5.0]])).tolist() == [[30, 100], [20, 60]]


def test_the_error_is_the_largest_distance():
    samples = Sampled(np.zeros((3, 3)), np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]))
    assert samples.error(np.array([[0.0, 1.0], [4.0, 5.0], [2.0, 2.0]])) == 5.0


@pytest.mark.parametrize("held", [False, True])
def test_a_pinhole_is_found_where_there_is_one(held):
    points = world()
    samples = Sampled(points, TRUE.project(points))
    found = fit_pinhole(samples, SIGHT, FAR if held else None)
    assert samples.error(found.project(points)) < 1e-7
    assert found.focal == pytest.approx(TRUE.focal, rel=1e-8)
    assert found.center == pytest.approx(TRUE.center, abs=1e-4)
    assert found.rotation == pytest.approx(TRUE.rotation, abs=1e-8)
    assert found.translation == pytest.approx(TRUE.translation, abs=1e-4)


def test_a_pinhole_is_as_far_as_it_is_held_and_shows_the_right_side():
    """Points seen along parallel rays, in axes that are not perpendicular, as an image with a skew shows them."""
    points = world()
    image = points @ np.array([[2.0, 0.02, 0.3], [0.0, -2.0, 0.4]]).T + [480.0, 300.0]
    samples, sight = Sampled(points, image), np.array([0.0, 0.0, 1.0])
    errors = []
    for far in (7e5, 1.4e6, 1.4e7):
        found = fit_pinhole(samples, sight, far)
        assert (found.focal > 0).all()
        assert found.rotation @ found.rotation.T == pytest.approx(np.eye(3), abs=1e-9)
        assert np.linalg.det(found.rotation) == pytest.approx(1.0)
        forward, depth = found.rotation[2], found.translation[2]
        assert -(forward @ sight) / depth == pytest.approx(1 / far)
        errors.append(samples.error(found.project(points)))
    assert errors[0] < 0.5
    assert errors[1] == pytest.approx(errors[0] / 2, rel=0.1)  # an affine image is seen from far away
    assert errors[2] == pytest.approx(errors[0] / 20, rel=0.1)


def test_a_mirrored_image_has_no_focal_lengths_of_one_sign():
    points = world()
    image = points @ np.array([[2.0, 0.02, 0.3], [0.0, 2.0, 0.4]]).T
    assert (fit_pinhole(Sampled(points, image), np.array([0.0, 0.0, 1.0]), 7e5).focal < 0).tolist() == [False, True]


def test_a_camera_at_infinity_is_refused_by_its_numbers_not_by_a_failure():
    points = world()
    found = fit_pinhole(Sampled(points, points[:, :2] * [2.0, -2.0]), np.array([0.0, 0.0, 1.0]))
    assert not ((found.focal > 0).all() and (found.focal < 1e9).all())


def test_the_same_points_give_the_same_bytes_wherever_they_lie_in_memory():
    points = world(200)
    image = TRUE.project(points) + np.random.default_rng(1).normal(0, 0.5, (200, 2))
    found = set()
    for shift in range(0, 64, 8):
        held = np.zeros(points.nbytes + 64, np.uint8)[shift:][: points.nbytes].view(float).reshape(points.shape)
        held[:] = points
        one = fit_pinhole(Sampled(held, image.copy()), SIGHT)
        found.add(b"".join(part.tobytes() for part in (one.focal, one.center, one.rotation, one.translation)))
    assert len(found) == 1


def test_a_pinhole_of_noisy_points_is_where_their_squares_are_least():
    """No unknown that is moved lessens the sum of squares: of its parabola, the bottom is there."""
    points = world(200)
    noise = np.random.default_rng(1).normal(0, 0.5, (200, 2))
    samples = Sampled(points, TRUE.project(points) + noise)
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
