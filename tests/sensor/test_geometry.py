"""Footprints, angles, triangulation and camera centres."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.base.geodesy import ecef_from_ground, enu_basis
from barpc.sensor.centers import camera_center
from barpc.sensor.geometry import (
    base_to_height,
    convergence_angle,
    footprint,
    ground_sample_distance,
    image_border,
    lines_of_sight,
    view_angles,
)
from barpc.sensor.rpc import RPC
from barpc.sensor.triangulation import epipolar_offset, triangulate

from .conftest import make_rpc


def tilted_rpc(toward: tuple[float, float]) -> RPC:
    """An RPC that sees a point displaced in the image with altitude: px per metre in col and row."""
    rpc = make_rpc()
    coeffs = rpc.coeffs.copy()
    coeffs[0, 3] = toward[0] * 500 / rpc.image_scale[0]
    coeffs[2, 3] = toward[1] * 500 / rpc.image_scale[1]
    return RPC(coeffs, rpc.ground_offset, rpc.ground_scale, rpc.image_offset, rpc.image_scale)


def test_the_border_runs_clockwise_on_the_edges_of_the_outer_pixels():
    border = image_border((10, 20), per_side=4)
    assert len(border) == 16
    np.testing.assert_array_equal(border[[0, 4, 8, 12]], [[-0.5, -0.5], [9.5, -0.5], [9.5, 19.5], [-0.5, 19.5]])


def test_a_footprint_projects_onto_the_images_border():
    rpc = make_rpc()
    ring = footprint(rpc, (800, 600), 300.0)
    image = rpc.project(np.column_stack([ring, np.full(len(ring), 300.0)]))
    np.testing.assert_allclose(image, image_border((800, 600)), rtol=0, atol=1e-6)


def test_a_footprint_across_the_antimeridian_is_in_one_piece():
    rpc = make_rpc(lon=180.0)
    ring = footprint(rpc, (20000, 19000), 0.0)
    assert np.ptp(ring[:, 0]) < 0.5
    assert ring[:, 0].min() < 180.0 < ring[:, 0].max()


def test_the_view_angles_are_those_of_the_line_of_sight():
    rpc = tilted_rpc((0.6, -0.4))
    image = np.array([[5000.0, 4000.0], [15000.0, 12000.0]])
    ground = rpc.localize(image, np.full(2, 500.0))
    incidence, azimuth = view_angles(rpc, ground)
    _, direction = lines_of_sight(rpc, image, (490.0, 510.0))
    enu = (enu_basis(ground) @ direction[..., None])[..., 0]
    np.testing.assert_allclose(np.cos(np.radians(incidence)), enu[:, 2], rtol=0, atol=1e-5)
    np.testing.assert_allclose(azimuth, np.degrees(np.arctan2(enu[:, 0], enu[:, 1])) % 360, atol=0.02)
    assert (incidence > 10).all()


def test_the_convergence_angle_is_the_angle_between_the_rays():
    a, b = tilted_rpc((0.6, -0.4)), tilted_rpc((-0.3, 0.2))
    ground = a.localize(np.array([9000.0, 9000.0]), np.array(500.0))
    rays = [lines_of_sight(m, m.project(ground), (490.0, 510.0))[1] for m in (a, b)]
    expected = np.degrees(np.arccos(rays[0] @ rays[1]))
    assert convergence_angle(a, b, ground) == pytest.approx(expected, abs=0.01)
    assert convergence_angle(a, a, ground) == pytest.approx(0.0, abs=1e-9)


def test_base_to_height_is_the_parallax_on_the_ground_of_a_metre_of_height():
    """Of two cameras on one side of the vertical, too, where 2 tan(angle / 2) is far smaller."""
    a, b = tilted_rpc((3.0, 0.0)), tilted_rpc((1.5, 0.5))
    place = np.array([5.0, 43.0, 500.0])
    place = a.localize(a.project(place), np.array(500.0))
    top = place + [0.0, 0.0, 1.0]
    seen = [ecef_from_ground(rpc.localize(rpc.project(top), np.array(500.0))) for rpc in (a, b)]
    parallax = np.linalg.norm(seen[0] - seen[1])
    assert base_to_height(a, b, place) == pytest.approx(parallax, rel=1e-3)
    halved = 2 * np.tan(np.radians(convergence_angle(a, b, place)) / 2)
    assert halved < 0.8 * parallax


def test_the_ground_sample_distance_is_how_far_neighbouring_pixels_lie_apart():
    rpc = tilted_rpc((0.3, 0.2))
    image, alt = np.array([3000.0, 4000.0]), np.array(500.0)
    here, right, below = (ecef_from_ground(rpc.localize(image + step, alt)) for step in ((0, 0), (1, 0), (0, 1)))
    sides, mean = ground_sample_distance(rpc, rpc.localize(image, alt))
    assert sides == pytest.approx([np.linalg.norm(right - here), np.linalg.norm(below - here)], rel=1e-5)
    assert mean == pytest.approx(np.sqrt(np.linalg.norm(np.cross(right - here, below - here))), rel=1e-5)


def test_points_without_an_intersection_are_nan_and_flagged():
    a, b = tilted_rpc((0.6, -0.4)), tilted_rpc((-0.3, 0.2))
    ground = a.localize(np.array([9000.0, 9000.0]), np.array(500.0))
    pa, pb = a.project(ground), b.project(ground)
    # track 0: fine; 1: one view only; 2: the same view twice, so parallel rays; 3: not finite
    xy = np.array([pa, pb, pa, pa, pa, pa, [np.nan, 1.0]])
    result = triangulate([a, b], [0, 1, 0, 0, 0, 0, 1], [0, 0, 1, 2, 2, 3, 3], xy)
    assert result.ok.tolist() == [True, False, False, False]
    assert np.isnan(result.points[1:]).all()
    assert np.isnan(result.residuals[2:]).all()


def test_no_tracks_give_no_points():
    result = triangulate([], [], [], np.empty((0, 2)))
    assert result.points.shape == (0, 3)


def test_a_centre_that_cannot_be_is_replaced_by_a_nominal_one_on_the_central_ray():
    rpc = make_rpc()  # its rays are parallel: they meet nowhere
    center = camera_center(rpc, (20000, 19000), (0.0, 1000.0))
    assert center.method == "nominal"
    assert center.altitude == pytest.approx(650e3, rel=1e-5)
    origin, direction = lines_of_sight(rpc, np.array([9999.5, 9499.5]), (0.0, 1000.0))
    off = np.cross(center.ecef - origin, direction)
    assert np.linalg.norm(off) < 1e-3


def test_the_epipolar_offset_is_the_shift_across_the_epipolar_line():
    a, b = tilted_rpc((0.6, -0.4)), tilted_rpc((-0.3, 0.2))
    rng = np.random.default_rng(4)
    truth = a.localize(rng.uniform(4000, 15000, (50, 2)), rng.uniform(0, 1000, 50))
    xa, xb = a.project(truth), b.project(truth)
    offset, alt = epipolar_offset(a, b, xa, xb, 0.0)
    np.testing.assert_allclose(offset, 0, atol=1e-6)
    np.testing.assert_allclose(alt, truth[:, 2], atol=1e-5)
    start = np.full(50, 480.0)
    np.testing.assert_array_equal(epipolar_offset(a, b, xa, xb, start, steps=0)[1], start)
    once, twice = (epipolar_offset(a, b, xa, xb, start, steps=steps)[1] for steps in (1, 2))
    assert (np.abs(once - truth[:, 2]) < 0.2 * np.abs(start - truth[:, 2])).all()
    assert (np.abs(twice - truth[:, 2]) <= np.abs(once - truth[:, 2])).all()
    # b moves by (-0.9, 0.6) px per metre against a: along it nothing shows, across it all does
    rise = b.project(a.localize(xa, truth[:, 2] + 1)) - xb
    along = rise / np.linalg.norm(rise, axis=1)[:, None]
    across = np.column_stack([-along[:, 1], along[:, 0]])  # to the right of rising ground: rows run down
    offset, alt = epipolar_offset(a, b, xa, xb + 3 * rise + 2 * across, 0.0)
    np.testing.assert_allclose(offset, 2, atol=1e-3)
    np.testing.assert_allclose(alt, truth[:, 2] + 3, atol=0.1)


@pytest.mark.parametrize(
    ("given", "taken"), [((300.0, 300.0), 400.0), ((300.0, 350.0), 400.0), ((300.0, 900.0), 900.0)]
)
def test_lines_of_sight_run_between_altitudes_a_hundred_metres_apart_or_more(given, taken):
    rpc, image = tilted_rpc((0.6, -0.4)), np.array([[3000.0, 9000.0], [12000.0, 500.0]])
    origin, direction = lines_of_sight(rpc, image, given)
    low, high = (ecef_from_ground(rpc.localize(image, np.full(2, alt))) for alt in (300.0, taken))
    np.testing.assert_allclose(origin, low, atol=1e-6)
    apart = high - low
    np.testing.assert_allclose(direction, apart / np.linalg.norm(apart, axis=1)[:, None], atol=1e-9)
