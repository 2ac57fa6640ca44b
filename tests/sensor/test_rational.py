"""The inverse of a rational map: what its quick way promises, and where the careful one takes over."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.sensor.rational import Rational, monomials
from tests.fit.cameras import synthetic_rpc


def make(slope: float = 0.0, curve: float = 0.0) -> Rational:
    """(x + curve x^2, -y) / (1 + slope x): a pole at -1/slope, a fold where its derivative vanishes."""
    coeffs = np.zeros((4, 20))
    coeffs[0, 1], coeffs[2, 2], coeffs[0, 7] = 1.0, -1.0, curve
    coeffs[1::2, 0], coeffs[1::2, 1] = 1.0, slope
    return Rational(coeffs, np.full(2, 1e-9))


@pytest.fixture(scope="module")
def curved() -> Rational:
    """A map with every coefficient at work, stronger than a camera's."""
    rpc = synthetic_rpc()
    coeffs = rpc.coeffs + np.random.default_rng(0).normal(0, 3e-3, (4, 20))
    return Rational(coeffs, np.full(2, 1e-9))


def test_values_and_derivatives_are_those_of_the_formula(curved) -> None:
    x = np.random.default_rng(1).uniform(-1, 1, (3, 40))
    col, col_den, row, row_den = curved.coeffs @ monomials(x)
    np.testing.assert_allclose(curved.value(x), [col / col_den, row / row_den], rtol=1e-13)
    value, gradient = curved.value_and_gradient(x)
    np.testing.assert_allclose(value, curved.value(x), rtol=1e-13)
    for axis in range(3):
        step = np.zeros((3, 1))
        step[axis] = 1e-5
        numeric = (curved.value(x + step) - curved.value(x - step)) / 2e-5
        np.testing.assert_allclose(gradient[axis], numeric, atol=1e-8)
    np.testing.assert_array_equal(curved.value_and_gradient(x, axes=2)[1], gradient[:2])


def test_what_one_safe_step_leaves_is_below_the_accuracy_asked_for(curved) -> None:
    """And a hundred times that step is not safe: the bound is no smaller than it need be."""
    curved.accuracy[:] = 1e-7
    rng = np.random.default_rng(3)
    truth = rng.uniform(-1, 1, (3, 500))
    inverse = Rational(curved.coeffs, np.full(2, 1e-7))._inverse
    assert inverse is not None
    left = {}
    for times in (1.0, 100.0):
        start = truth.copy()
        start[:2] += times * inverse.safe_step * rng.choice([-1.0, 1.0], (2, 500))
        curved._step(curved.value(truth), start)
        left[times] = np.abs(curved.value(start) - curved.value(truth)).max()
    assert left[1.0] <= 1e-7
    assert left[100.0] > 1e-6


def test_the_cubic_inverse_is_near_over_the_box_and_a_tenth_around_it(curved) -> None:
    inverse = curved._inverse
    assert inverse is not None
    x = np.random.default_rng(4).uniform(-1.05, 1.05, (3, 500))
    arguments = (np.concatenate([curved.value(x), x[2:]]) - inverse.center) / inverse.scale
    assert np.abs(arguments).max() <= 1.05
    assert np.abs(arguments).max() > 0.9
    assert np.abs(inverse.coeffs @ monomials(arguments) - x[:2]).max() < 0.02


@pytest.mark.parametrize(
    ("slope", "curve", "quick"),
    [(0.0, 0.0, True), (0.5, 0.0, True), (0.85, 0.0, True), (0.95, 0.0, False), (-0.95, 0.0, False),
     (0.0, 0.4, True), (0.0, 0.5, False), (0.0, -0.5, False)],
)  # fmt: skip
def test_a_pole_or_a_fold_in_the_box_takes_the_quick_way_away(slope, curve, quick) -> None:
    """The box and its tenth: poles at |x| = 1/slope, folds at |x| = 1/(2 curve), nodes to 1.083."""
    assert (make(slope, curve)._inverse is not None) == quick


@pytest.mark.parametrize(("slope", "curve"), [(0.0, 0.0), (0.95, 0.0), (-0.95, 0.0), (0.5, 0.2), (0.0, 0.49)])
def test_points_are_found_on_the_sheet_of_the_centre_and_nowhere_else(slope, curve) -> None:
    rational_map = make(slope, curve)
    x = np.random.default_rng(5).uniform(-1, 1, (3, 300))
    found, ok = rational_map.solve(rational_map.value(x), x[2])
    assert ok.all()
    np.testing.assert_allclose(found, x, atol=1e-6)
    if slope:  # beyond the pole the map goes on, on another sheet
        beyond = np.array([[-1.5 / slope], [0.2], [0.0]])
        _, ok = rational_map.solve(rational_map.value(beyond), beyond[2])
        assert not ok.any() or np.abs(rational_map.solve(rational_map.value(beyond), beyond[2])[0] - beyond).max() > 0.1


@pytest.mark.parametrize(("curve", "quick"), [(0.2, True), (-0.2, True), (0.9, True), (0.95, False), (-0.95, False)])
def test_a_fold_of_a_map_that_is_turned_is_where_its_determinant_vanishes(curve: float, quick: bool) -> None:
    """(x + y + curve x^2, x - y): a fold at x = -1/curve."""
    coeffs = np.zeros((4, 20))
    coeffs[0, [1, 2, 7]], coeffs[2, [1, 2]] = [1.0, 1.0, curve], [1.0, -1.0]
    coeffs[1::2, 0] = 1.0
    turned = Rational(coeffs, np.full(2, 1e-9))
    assert (turned._inverse is not None) == quick
    at = np.array([[-0.99, -1.01, 0.5], [0.3, 0.3, -2.0], [0.0, 0.0, 0.0]])
    at[0, :2] /= curve
    assert turned._regular(at).tolist() == [True, False, True]
    x = np.random.default_rng(5).uniform(-0.9, 0.9, (3, 100))
    found, ok = turned.solve(turned.value(x), x[2])
    assert ok.all()
    np.testing.assert_allclose(found, x, atol=1e-7)


def test_targets_that_the_map_never_reaches_are_not_ok() -> None:
    fold = make(curve=0.5)  # x + x^2 / 2 is never below -1/2
    target = np.array([[-0.4999, -0.52, np.nan, 0.1], [0.0, 0.0, 0.0, np.inf]])
    with np.errstate(all="ignore"):
        _, ok = fold.solve(target, np.zeros(4))
    assert ok.tolist() == [True, False, False, False]
    with np.errstate(all="ignore"):
        _, ok = fold.solve(target[:, :1], np.array([np.nan]))
    assert not ok.any()


def test_points_far_outside_the_box_are_found_with_care(curved) -> None:
    x = np.array([[2.5, -3.0, 0.0], [0.0, 1.0, 2.8], [0.5, 0.5, -0.5]])
    found, ok = curved.solve(curved.value(x), x[2])
    assert ok.all()
    np.testing.assert_allclose(found, x, atol=1e-6)


def test_a_step_is_halved_until_the_error_falls_and_never_crosses_a_pole() -> None:
    steep = make(slope=0.9)
    target = steep.value(np.array([[0.5], [0.5], [0.0]]))
    for times, halvings in ((1.0, 0), (4.0, 1), (100.0, 6)):
        x = np.array([[0.45], [0.5], [0.0]])
        step = np.array([[0.05 * times], [0.0]])
        assert steep._line_search(target, x, step, np.ones((2, 1))).all()
        assert x[0, 0] == pytest.approx(0.45 + 0.05 * times / 2**halvings)
    x = np.array([[0.45], [0.5], [0.0]])
    assert not steep._line_search(target, x, np.array([[-0.1], [0.0]]), np.ones((2, 1))).any()
    assert x[0, 0] == 0.45
    across = np.array([[-1.0], [0.0], [0.0]])  # from just before the pole a step to the other side
    goal = steep.value(np.array([[-1.3], [0.0], [0.0]]))
    steep._line_search(goal, across, np.array([[-0.3], [0.0]]), np.ones((2, 1)))
    assert across[0, 0] > -1 / 0.9
