"""Pinhole cameras near an RPC: found exactly where they hold, by derivatives and starts that are right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.export import pinholes
from barpc.export.pinholes import Pinhole, fit_pinhole
from barpc.export.shots import Sampled
from barpc.sensor.curve import rotation_matrix

TURN = rotation_matrix(np.array([np.pi - 0.2, 0.1, 0.05]))  # looks down
TRUE = Pinhole(np.array([9000.0, 8500.0]), np.array([480.0, 300.0]), TURN, np.array([20.0, -10.0, 6000.0]))


def world(num: int = 60) -> np.ndarray:
    return np.random.default_rng(0).uniform(-400, 400, (num, 3)) * [1.0, 1.0, 0.2]


def derivative(pinhole: Pinhole, at: np.ndarray) -> np.ndarray:
    """Of the image point by the place, by central differences."""
    steps = 1e-2 * np.eye(3)
    return ((pinhole.project(at + steps) - pinhole.project(at - steps)) / 2e-2).T


def view_of(pinhole: Pinhole, at: np.ndarray) -> dict:
    """What a fit starts from."""
    center = -pinhole.rotation.T @ pinhole.translation
    away = center - at
    far = float(np.linalg.norm(away))
    return {
        "at": at,
        "pixel": pinhole.project(at[None])[0],
        "rows": derivative(pinhole, at),
        "sight": away / far,
        "far": far,
    }


def test_a_pinhole_divides_by_the_depth():
    seen = Pinhole(np.array([100.0, 200.0]), np.array([10.0, 20.0]), np.eye(3), np.array([0.0, 0.0, 5.0]))
    assert seen.project(np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 5.0]])).tolist() == [[30, 100], [20, 60]]


def test_the_error_is_the_largest_distance():
    samples = Sampled(np.zeros((3, 3)), np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]]))
    assert samples.error(np.array([[0.0, 1.0], [4.0, 5.0], [2.0, 2.0]])) == 5.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("times", [1.0, 3.0])
@pytest.mark.parametrize("shear", [0.0, 0.3, -0.3])
@pytest.mark.parametrize("mirrored", [1.0, -1.0])
def test_a_start_has_the_derivative_that_was_seen(sign, times, shear, mirrored):
    at, sight = np.array([30.0, -20.0, 10.0]), np.array([0.1, -0.2, 1.0])
    sight /= np.linalg.norm(sight)
    right = np.cross([0.0, 1.0, 0.0], sight)
    right /= np.linalg.norm(right)
    down = -np.cross(sight, right)
    rows = np.array([2.0 * right, mirrored * 1.5 * (down + shear * right)])
    pixel, far = np.array([400.0, 300.0]), times * 5000.0
    found = pinholes._start(sign, at, pixel, rows, sight, far)
    assert found.rotation @ found.rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert found.project(at[None])[0] == pytest.approx(pixel, abs=1e-6)
    assert derivative(found, at) == pytest.approx(rows, abs=1e-6)
    center = -found.rotation.T @ found.translation
    assert center == pytest.approx(at + far * sight, abs=1e-6)
    assert np.sign(found.focal).tolist() == [1.0, mirrored]
    if shear:  # the principal point takes the place of a skew: on one side or the other
        away = found.center - pixel
        cosine = shear / np.hypot(1.0, shear)
        ray = np.sqrt(abs(cosine) / (1.0 - abs(cosine)))
        assert np.sign(away[0]) == -sign
        assert np.abs(away / found.focal) == pytest.approx([ray, ray], rel=1e-9)
    else:
        assert found.center == pytest.approx(pixel)


def test_a_fit_starts_on_both_sides_at_up_to_three_times_the_distance(monkeypatch):
    given, start = [], pinholes._start
    monkeypatch.setattr(pinholes, "_start", lambda sign, *rest: given.append((sign, rest[-1])) or start(sign, *rest))
    points = world()
    fit_pinhole(Sampled(points, TRUE.project(points)), **{**view_of(TRUE, points[0]), "far": 6000.0})
    assert given == [(sign, far) for far in (6000.0, 12000.0, 18000.0) for sign in (1.0, -1.0)]


def test_a_pinhole_is_found_where_there_is_one():
    points = world()
    samples = Sampled(points, TRUE.project(points))
    found = fit_pinhole(samples, **view_of(TRUE, np.array([5.0, 8.0, 0.0])))
    assert samples.error(found.project(points)) < 1e-5
    assert found.focal == pytest.approx(TRUE.focal, rel=1e-5)
    assert found.center == pytest.approx(TRUE.center, abs=0.05)
    assert found.rotation == pytest.approx(TRUE.rotation, abs=1e-5)
    assert found.translation == pytest.approx(TRUE.translation, abs=0.1)


def test_a_pinhole_of_noisy_points_is_where_their_squares_are_least():
    """No unknown that is moved lessens the sum of squares: of its parabola, the bottom is there."""
    points = world(200)
    noise = np.random.default_rng(1).normal(0, 0.5, (200, 2))
    samples = Sampled(points, TRUE.project(points) + noise)
    found = fit_pinhole(samples, **view_of(TRUE, np.array([5.0, 8.0, 0.0])))

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


def test_of_the_refinements_the_one_with_the_smallest_largest_error_is_taken(monkeypatch):
    points = world()
    errors = iter([5.0, 3.0, 1.0, 2.0, 4.0, 6.0])
    monkeypatch.setattr(
        pinholes, "_least_squares_pinhole", lambda *_: replace(TRUE, center=TRUE.center + [next(errors), 0.0])
    )
    found = fit_pinhole(Sampled(points, TRUE.project(points)), **view_of(TRUE, points[0]))
    assert found.center[0] == TRUE.center[0] + 1.0
