"""What is added to image points: splines over the rows, steps between detectors, and their sign."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline

from barpc.errors import RpcError
from barpc.sensor.splined import RowSpline, Splined

from .conftest import make_rpc

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
    spline = RowSpline(np.zeros((0, 2)), edges=[100.0], steps=[[0.0, 0.0], [0.5, -0.5]])
    found = spline.at(np.array([[99.9, 7.0], [100.0, 7.0], [np.nan, 7.0]]))
    np.testing.assert_array_equal(found, [[0.0, 0.0], [0.5, -0.5], [np.nan, np.nan]])
    assert np.isnan(spline.spacing)


@pytest.mark.parametrize(
    "wrong",
    [
        {"coeffs": np.zeros((3, 2))},
        {"coeffs": np.zeros((5, 3))},
        {"coeffs": COEFFS, "row_scale": 0.0},
        {"coeffs": COEFFS, "edges": [5.0], "steps": [[0.0, 0.0]]},
        {"coeffs": COEFFS, "edges": [5.0, 5.0], "steps": np.zeros((3, 2))},
        {"coeffs": COEFFS, "steps": np.zeros((1, 2))},
        {"coeffs": COEFFS * np.nan},
    ],
)
def test_what_is_no_spline_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(RpcError):
        RowSpline(**wrong)
