"""Ground to ECEF and back, against PROJ and against central differences."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.base import geodesy
from barpc.base.errors import InputError
from barpc.base.statistics import robust_spread


@pytest.fixture
def ground():
    rng = np.random.default_rng(0)
    n = 20000
    return np.column_stack([rng.uniform(-180, 180, n), rng.uniform(-89.9, 89.9, n), rng.uniform(-1e4, 9e5, n)])


def test_ecef_equals_proj(ground):
    pyproj = pytest.importorskip("pyproj")
    proj = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    expected = np.column_stack(proj.transform(*ground.T))
    np.testing.assert_allclose(geodesy.ecef_from_ground(ground), expected, rtol=0, atol=2e-9)


def test_there_and_back_is_a_few_nanometres(ground):
    ecef = geodesy.ecef_from_ground(ground)
    back = geodesy.ground_from_ecef(ecef)
    assert np.abs(geodesy.ecef_from_ground(back) - ecef).max() <= 8e-9
    assert np.abs(back[:, 2] - ground[:, 2]).max() <= 8e-9


def test_rows_with_their_derivative_are_the_points_with_theirs(ground):
    ecef = geodesy.ecef_from_ground(ground)
    rows, jacobian = geodesy.ground_rows_from_ecef(np.ascontiguousarray(ecef.T))
    np.testing.assert_array_equal(rows.T, geodesy.ground_from_ecef(ecef))
    expected = np.moveaxis(geodesy.ground_from_ecef_jacobian(ground), 0, -1)
    np.testing.assert_allclose(jacobian, expected, rtol=1e-12, atol=1e-17)


def test_the_centre_of_the_earth_and_its_axis_raise_nothing():
    assert geodesy.ground_from_ecef([0.0, 0.0, 0.0])[2] == -geodesy.WGS84_A
    with_pole, _ = geodesy.ground_rows_from_ecef(np.array([[0.0], [0.0], [6.4e6]]))
    np.testing.assert_allclose(with_pole[:, 0], [0, 90, 6.4e6 - geodesy.WGS84_B], atol=1e-8)


def test_the_poles_and_the_equator_have_an_answer():
    ecef = [[0, 0, 6.4e6], [0, 0, -6.4e6], [geodesy.WGS84_A, 0, 0], [0, -geodesy.WGS84_A - 100, 0]]
    ground = geodesy.ground_from_ecef(ecef)
    altitude = 6.4e6 - geodesy.WGS84_B
    expected = [[0, 90, altitude], [0, -90, altitude], [0, 0, 0], [-90, 0, 100]]
    np.testing.assert_allclose(ground, expected, rtol=0, atol=1e-8)


def test_jacobians_are_central_differences_and_each_others_inverse(ground):
    ground = ground[np.abs(ground[:, 1]) < 85][:500]
    forward = geodesy.ecef_from_ground_jacobian(ground)
    for axis, step in enumerate((1e-4, 1e-4, 10.0)):
        d = np.zeros(3)
        d[axis] = step
        difference = (geodesy.ecef_from_ground(ground + d) - geodesy.ecef_from_ground(ground - d)) / (2 * step)
        np.testing.assert_allclose(forward[..., axis], difference, rtol=0, atol=2e-6 * np.abs(difference).max())
    product = forward @ geodesy.ground_from_ecef_jacobian(ground)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), rtol=0, atol=1e-12)


def test_wrapping_a_longitude_leaves_near_ones_alone_to_the_bit():
    lon = np.array([5.123456789, -179.9, 179.9, 359.5, -200.0])
    np.testing.assert_array_equal(geodesy.wrap_longitude(lon[:3]), lon[:3])
    np.testing.assert_allclose(geodesy.wrap_longitude(lon), [5.123456789, -179.9, 179.9, -0.5, 160.0])
    np.testing.assert_allclose(geodesy.wrap_longitude([-179.9], 179.9), [180.1])


def test_a_longitude_by_whole_turns_and_a_latitude_are_places_and_nothing_else_is():
    places = np.array([[5.4, 43.3], [540.0, -90.0], [-540.0, 90.0], [541.0, 0.0], [0.0, 90.1], [np.nan, 0.0]])
    found = geodesy.is_lonlat(np.column_stack([places, np.full(6, np.nan)]))  # whatever its altitude
    assert found.tolist() == geodesy.is_lonlat(places).tolist() == [True, True, True, False, False, False]


def test_what_is_not_finite_stays_so_without_an_exception():
    assert np.isnan(geodesy.ecef_from_ground([np.nan, 0, 0])).any()
    assert np.isnan(geodesy.ground_from_ecef([np.nan, 0, 0])).any()


@pytest.mark.parametrize(
    ("lon", "lat", "zone"),
    [
        (-180.0, 10.0, (1, "EPSG:32601")), (-174.1, 0.0, (1, "EPSG:32601")), (-174.0, -0.1, (2, "EPSG:32702")),
        (5.4, 43.3, (31, "EPSG:32631")), (179.9, -60.0, (60, "EPSG:32760")), (181.0, 0.0, (1, "EPSG:32601")),
    ],
)  # fmt: skip
def test_a_zone_is_six_degrees_wide_and_counted_from_the_antimeridian(lon, lat, zone):
    assert geodesy.utm(lon, lat) == zone


def test_points_are_refused_with_the_shape_that_is_expected():
    assert geodesy.as_ground([1, 2, 3]).dtype == np.float64
    for wrong, said in (
        (np.zeros((3, 5)), r"shape \(3, 5\): \(\.\.\., 3\) is expected, lon, .* on the last axis; transpose them$"),
        (np.zeros((2, 5)), r"shape \(2, 5\): .* on the last axis$"),
        (np.zeros(4), r"shape \(4,\): .* on the last axis$"),
        (["a", "b", "c"], r"ground points: numbers are expected, \(\.\.\., 3\)"),
    ):
        with pytest.raises(InputError, match=said):
            geodesy.as_ground(wrong)


@pytest.mark.parametrize(
    ("points", "alt", "shape"),
    [((4, 5, 2), (5,), (4, 5)), ((2,), (3,), (3,)), ((4, 2), (), (4,)), ((4, 2), (3, 1), (3, 4))],
)
def test_altitudes_broadcast_with_points(points, alt, shape):
    rng = np.random.default_rng(0)
    xy, level = rng.normal(size=points), rng.normal(size=alt)
    (found,) = geodesy.pointwise(lambda p, a: [p[:, 0] + 10.0 * p[:, 1] + 100.0 * a], [()], xy, level)
    np.testing.assert_allclose(found, np.broadcast_to(xy[..., 0] + 10.0 * xy[..., 1] + 100.0 * level, shape))
    with pytest.raises(InputError, match=r"altitudes of shape \(7,\) for points .*: one, or an array"):
        geodesy.pointwise(lambda p, a: [p[:, 0]], [()], np.zeros((4, 2)), np.zeros(7))


def test_a_robust_spread_is_that_of_a_normal_distribution_and_of_none_it_is_zero():
    values = np.random.default_rng(1).normal(3.0, 2.0, (3, 40_001))
    assert robust_spread(values[0], 3.0) == pytest.approx(2.0, rel=0.02)
    assert robust_spread(values[0]) == pytest.approx(1.4826 * np.median(np.abs(values[0])), rel=1e-4)
    np.testing.assert_allclose(robust_spread(values, 3.0), 2.0, rtol=0.02)
    assert robust_spread(np.zeros(0)) == 0.0
    assert robust_spread(np.array([1.0, -1.0, 50.0])) == pytest.approx(1.4826, rel=1e-4)
