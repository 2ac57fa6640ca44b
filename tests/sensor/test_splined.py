"""What is added to image points: splines over the rows, steps between detectors, and their sign."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline

from barpc.base.errors import RpcError
from barpc.sensor.image_corrections import Calibrated, ColumnSpline, RowSpline, Splined, bsplines, sine_and_cosine
from tests.sensor.conftest import make_rpc, slopes

COEFFS = np.random.default_rng(2).normal(0, 0.5, (11, 2))


def scipys(row: np.ndarray) -> BSpline:
    """The same spline by scipy: knots at equal steps, three beyond either end."""
    knots = 9499.5 + 9500.0 * (np.arange(15) - 3 - 4) / 4
    return BSpline(knots, COEFFS, 3)


def test_the_spline_and_its_rate_are_scipys() -> None:
    row = np.linspace(0.0, 18999.0, 400)
    spline = RowSpline(COEFFS, 9499.5, 9500.0)
    image = np.column_stack([row % 977, row])
    np.testing.assert_allclose(spline.at(image), scipys(row)(row), rtol=0, atol=1e-13)
    np.testing.assert_allclose(spline.rate(row), scipys(row).derivative()(row), rtol=0, atol=1e-15)
    assert spline.spacing == pytest.approx(2375.0)


def test_beyond_the_image_the_last_value_holds() -> None:
    spline = RowSpline(COEFFS, 9499.5, 9500.0)
    beyond, end = spline.at(np.array([[3.0, 30000.0], [3.0, 18999.5]]))
    np.testing.assert_allclose(beyond, end, atol=1e-9)
    assert (spline.rate(np.array([-2.0, 30000.0])) == 0).all()


def test_points_are_seen_where_they_are_projected_plus_the_displacement() -> None:
    rpc, image = make_rpc(), np.array([[3000.0, 4000.0], [12000.0, 800.0], [12000.0, 17000.0]])
    steps = [[0.1, -0.2], [-0.3, 0.4], [0.0, 0.1]]
    model = Splined(rpc, RowSpline(COEFFS, 9499.5, 9500.0, [2500.0, 10000.0], steps))
    ground = model.localize(image, np.full(3, 300.0))
    displacement = scipys(image[:, 1])(image[:, 1]) + np.array(steps)[[1, 2, 2]]
    np.testing.assert_allclose(image - rpc.project(ground), displacement, rtol=0, atol=1e-8)
    np.testing.assert_allclose(model.project(ground), image, rtol=0, atol=1e-6)
    assert np.abs(displacement).min() > 1e-3


def test_a_detector_begins_at_its_edge() -> None:
    spline = RowSpline(np.zeros((0, 2)), detector_edges=[100.0], detector_steps=[[0.0, 0.0], [0.5, -0.5]])
    found = spline.at(np.array([[99.9, 7.0], [100.0, 7.0], [np.nan, 7.0]]))
    np.testing.assert_array_equal(found, [[0.0, 0.0], [0.5, -0.5], [np.nan, np.nan]])
    assert np.isnan(spline.spacing)


def test_a_spline_over_columns_is_scipys_and_its_steps_add_up() -> None:
    """From the left edge of the first pixel to the right edge of the last; beyond, the value of the edge."""
    spline = ColumnSpline(4000, COEFFS, [1000.0, 2500.0], [[0.1, -0.2], [0.3, 0.4]])
    col = np.array([-0.5, 3.0, 999.9, 1000.0, 2499.9, 2500.0, 3000.0, 3999.5])
    scipy = BSpline(500.0 * (np.arange(15) - 3) - 0.5, COEFFS, 3)
    steps = np.array([[0.0, 0.0], [0.1, -0.2], [0.4, 0.2]])[[0, 0, 0, 1, 1, 2, 2, 2]]
    np.testing.assert_allclose(spline.at(col), scipy(col) + steps, rtol=0, atol=1e-13)
    np.testing.assert_allclose(spline.rate(col[1:-1]), scipy.derivative()(col[1:-1]), rtol=0, atol=1e-15)
    np.testing.assert_allclose(spline.at(np.array([-90.0, 5000.0])), spline.at(col[[0, -1]]), rtol=0, atol=1e-13)
    assert np.isnan(spline.at(np.array([np.nan]))).all()
    u = np.linspace(-1.0, 1.0, 41)
    np.testing.assert_allclose(COEFFS.T @ bsplines(u, len(COEFFS)), scipy(2000.0 * (u + 1.0) - 0.5).T, atol=1e-13)
    rpc, image = make_rpc(), np.array([[700.0, 4000.0], [1200.0, 800.0], [3100.0, 17000.0]])
    model = Calibrated(rpc, spline)
    ground = model.localize(image, np.full(3, 300.0))
    np.testing.assert_allclose(image - rpc.project(ground), spline.at(image[:, 0]), rtol=0, atol=1e-8)
    np.testing.assert_allclose(model.project(ground), image, rtol=0, atol=1e-6)
    for wrong in ((1, COEFFS), (4000, COEFFS[:3]), (4000, COEFFS, [9.0, 9.0], np.zeros((2, 2)))):
        with pytest.raises(RpcError, match="two of them and four coefficients are needed at least, and edges ascend"):
            ColumnSpline(*wrong)
    assert ColumnSpline(2, COEFFS[:4]).at(np.zeros(1)).shape == (1, 2)


STRIPS = [[1.0, 4000.0, 9000.0, 0.0, 0.0], [0.0, -500.0, 700.0, 0.0, 0.0], [1.0, -20.0, 19100.0, 300.0, 1e-3]]
MOVED = [[0.5, -0.25], [0.0, 0.125], [2.0, 1.0]]


def test_strips_move_what_is_seen_in_them_and_add_up() -> None:
    spline = RowSpline(np.zeros((0, 2)), steps=STRIPS[:2], step_sizes=MOVED[:2])
    image = np.array([[800.0, 3999.9], [800.0, 4000.0], [699.0, 8999.9], [699.0, 9000.0], [np.nan, 5000.0]])
    expected = [[0.0, 0.0], [0.5, -0.25], [0.5, -0.125], [0.0, 0.125], [np.nan, np.nan]]
    np.testing.assert_array_equal(spline.at(image), expected)
    np.testing.assert_array_equal(spline.rate(image[:, 1]), 0.0)


@pytest.mark.parametrize("rate", [1e-3, -2e-3])
def test_what_fades_begins_at_its_origin_and_has_its_rate(rate: float) -> None:
    strip = [[1.0, -20.0, 19100.0, 9000.0, rate]]
    spline = RowSpline(np.zeros((0, 2)), steps=strip, step_sizes=MOVED[2:])
    away = np.sign(rate) * np.array([-500.0, 0.0, 1.0 / abs(rate), 3000.0])
    image = np.column_stack([away * 0.0, 9000.0 + away])
    factor = np.exp(-np.maximum(away * rate, 0.0))
    np.testing.assert_allclose(spline.at(image), factor[:, None] * MOVED[2], rtol=1e-12)
    row = 9000.0 + away[2:]
    slope = (spline.at(np.column_stack([row, row + 0.01])) - spline.at(np.column_stack([row, row - 0.01]))) / 0.02
    np.testing.assert_allclose(spline.rate(row), slope, rtol=1e-6, atol=1e-12)
    assert (spline.rate(9000.0 + away[:1]) == 0).all()


SWINGS = [[[0.1, 0.0], [0.0, -0.2]], [[0.3, 0.1], [-0.1, 0.05]]]


def test_a_swing_without_a_period_is_none() -> None:
    row, period = np.array([0.0, 25.0, 30.0]), np.array([100.0, 100.0, np.inf])
    np.testing.assert_allclose(sine_and_cosine(row, period), [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], atol=1e-12)


def test_swings_repeat_themselves_and_have_their_slope() -> None:
    spline = RowSpline(np.zeros((0, 2)), periods=[400.0, 90.0], amplitudes=SWINGS)
    row = np.array([0.0, 17.0, 1234.5])
    image = np.column_stack([row * 0.0 + 5.0, row])
    np.testing.assert_allclose(spline.at(image), spline.at(image + [0.0, 3600.0]), atol=1e-12)
    alone = RowSpline(np.zeros((0, 2)), periods=[400.0], amplitudes=SWINGS[:1])
    expected = np.column_stack([0.1 * np.cos(2 * np.pi * row / 400.0), -0.2 * np.sin(2 * np.pi * row / 400.0)])
    np.testing.assert_allclose(alone.at(image), expected, atol=1e-12)
    slope = (spline.at(image + [0.0, 0.01]) - spline.at(image - [0.0, 0.01])) / 0.02
    np.testing.assert_allclose(spline.rate(row), slope, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    "spline",
    [
        RowSpline(COEFFS, 9499.5, 9500.0, steps=STRIPS, step_sizes=MOVED),
        RowSpline(np.zeros((0, 2)), periods=[400.0, 90.0], amplitudes=SWINGS),
    ],
    ids=["strips", "swings"],
)
def test_a_camera_behind_rows_that_move_is_the_same_both_ways_and_has_its_jacobian(spline: RowSpline) -> None:
    model = Splined(make_rpc(), spline)
    image = np.array([[3000.0, 5000.0], [300.0, 350.0], [12000.0, 17000.0], [600.0, 8000.0]])
    ground = model.localize(image, np.full(4, 300.0))
    np.testing.assert_allclose(model.project(ground), image, rtol=0, atol=1e-6)
    numeric = slopes(model, ground, np.array([1e-7, 1e-7, 1e-2]))
    np.testing.assert_allclose(model.project_jacobian(ground)[1], numeric, rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize(
    "wrong",
    [
        {"splines": np.zeros((3, 2))},
        {"splines": np.zeros((5, 3))},
        {"splines": COEFFS, "row_scale": 0.0},
        {"splines": COEFFS, "detector_edges": [5.0], "detector_steps": [[0.0, 0.0]]},
        {"splines": COEFFS, "detector_edges": [5.0, 5.0], "detector_steps": np.zeros((3, 2))},
        {"splines": COEFFS, "detector_steps": np.zeros((1, 2))},
        {"splines": COEFFS * np.nan},
        {"splines": COEFFS, "steps": STRIPS, "step_sizes": MOVED[:2]},
        {"splines": COEFFS, "steps": [[2.0, 0.0, 1.0, 0.0, 0.0]], "step_sizes": MOVED[:1]},
        {"splines": COEFFS, "steps": [[1.0, 0.0, np.inf, 0.0, 0.0]], "step_sizes": MOVED[:1]},
        {"splines": COEFFS, "steps": [[1.0, 0.0, 1.0]], "step_sizes": MOVED[:1]},
        {"splines": COEFFS, "periods": [300.0], "amplitudes": np.zeros((2, 2, 2))},
        {"splines": COEFFS, "periods": [0.0], "amplitudes": np.zeros((1, 2, 2))},
        {"splines": COEFFS, "periods": [np.inf], "amplitudes": np.zeros((1, 2, 2))},
    ],
)
def test_what_is_no_spline_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(RpcError):
        RowSpline(**wrong)
