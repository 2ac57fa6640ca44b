"""Footprints, angles, triangulation and camera centres."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from barpc.base.geodesy import ecef_from_ground, enu_basis, ground_from_ecef
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
from barpc.sensor.triangulation import epipolar_offset, intersect_pair, triangulate

from .conftest import make_rpc


def tilted_rpc(toward: tuple[float, float]) -> RPC:
    """An RPC that sees a point displaced in the image with altitude: px per metre in col and row."""
    rpc = make_rpc()
    coeffs = rpc.coeffs.copy()
    coeffs[0, 3] = toward[0] * 500 / rpc.image_scale[0]
    coeffs[2, 3] = toward[1] * 500 / rpc.image_scale[1]
    return RPC(coeffs, rpc.ground_offset, rpc.ground_scale, rpc.image_offset, rpc.image_scale)


SENSORS = [tilted_rpc((0.6, -0.4)), tilted_rpc((-0.3, 0.2)), tilted_rpc((0.1, 0.5))]


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
    a, b, _ = SENSORS
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
    a, b, _ = SENSORS
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


def test_the_epipolar_offset_is_the_shift_across_the_epipolar_line():
    a, b, _ = SENSORS
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


# --- intersections, against scipy's least squares of the weighted reprojection errors --------------------------------


def scene(tracks: int = 12, noise: float = 2.0):
    rng = np.random.default_rng(6)
    truth = SENSORS[0].localize(rng.uniform(4000, 15000, (tracks, 2)), rng.uniform(100, 900, tracks))
    view = np.concatenate([[0, 1, 2] if p % 3 else [2, 0] for p in range(tracks)])
    point = np.concatenate([[p] * (3 if p % 3 else 2) for p in range(tracks)])
    xy = np.array([SENSORS[v].project(truth[p]) for v, p in zip(view, point, strict=True)])
    order = rng.permutation(len(view))
    sigma = rng.uniform(0.3, 3.0, len(view))
    return truth, view[order], point[order], (xy + rng.normal(0, noise, xy.shape))[order], sigma


@pytest.mark.parametrize("weighted", [False, True])
def test_points_are_the_weighted_least_squares_ones(weighted) -> None:
    truth, view, point, xy, sigma = scene()
    found = triangulate(SENSORS, view, point, xy, sigma if weighted else None, alt=500.0)
    assert found.ok.all()
    for p in range(len(truth)):
        rows = np.flatnonzero(point == p)

        def residual(x: np.ndarray, rows: np.ndarray = rows, p: int = p) -> np.ndarray:
            ground = ground_from_ecef(ecef_from_ground(truth[p]) + x)
            errors = [(SENSORS[view[k]].project(ground) - xy[k]) / (sigma[k] if weighted else 1.0) for k in rows]
            return np.concatenate(errors)

        expected = least_squares(residual, np.zeros(3), diff_step=1e-4, x_scale=10.0).x
        np.testing.assert_allclose(found.points[p] - ecef_from_ground(truth[p]), expected, atol=2e-3)
        ground = ground_from_ecef(found.points[p])
        for k in rows:
            np.testing.assert_allclose(found.residuals[k], SENSORS[view[k]].project(ground) - xy[k], atol=1e-6)


def test_the_first_guess_is_where_it_is_asked_for_and_steps_are_counted() -> None:
    truth, view, point, xy, _ = scene(noise=0.0)
    start = triangulate(SENSORS, view, point, xy, alt=truth[:, 2], steps=1)
    assert np.linalg.norm(start.points - ecef_from_ground(truth), axis=1).max() < 1e-4
    far = triangulate(SENSORS, view, point, xy, alt=truth[:, 2] + 2000.0, steps=1)
    assert np.linalg.norm(far.points - ecef_from_ground(truth), axis=1).min() > 1e-3
    enough = triangulate(SENSORS, view, point, xy, alt=truth[:, 2] + 2000.0)
    assert np.abs(enough.points - ecef_from_ground(truth)).max() < 1e-5
    assert np.abs(enough.residuals).max() < 1e-6


@pytest.mark.parametrize(("degrees", "usable"), [(3e-4, False), (0.01, True), (1.0, True)])
def test_rays_that_are_parallel_to_a_thousandth_of_a_degree_determine_no_point(degrees, usable) -> None:
    """The second camera leans by so much more, half a metre a pixel."""
    lean = 0.2 + np.radians(degrees) / 0.5
    two = [tilted_rpc((0.2, 0.0)), tilted_rpc((lean, 0.0))]
    ground = two[0].localize(np.array([[9000.0, 9000.0]]), np.array([500.0]))
    xy = np.vstack([sensor.project(ground) for sensor in two])
    found = triangulate(two, [0, 1], [0, 0], xy, alt=480.0)
    assert found.ok.tolist() == [usable]
    assert np.isfinite(found.points).all() == usable
    assert np.isfinite(found.residuals).all() == usable


def test_a_track_without_an_observation_has_no_point() -> None:
    _, view, point, xy, _ = scene()
    found = triangulate(SENSORS, view, np.where(point >= 5, point + 1, point), xy, alt=500.0)
    assert np.flatnonzero(~found.ok).tolist() == [5]
    assert np.isnan(found.points[5]).all()
    assert np.isfinite(found.residuals).all()


class Other:
    """The first camera, but no RPC."""

    def __getattr__(self, name: str) -> object:
        return getattr(SENSORS[0], name)


class Blind(Other):
    """It localises nothing."""

    def localize(self, image: np.ndarray, alt: np.ndarray) -> np.ndarray:
        return np.full((len(image), 3), np.nan)


def test_it_stops_where_the_step_is_below_a_millimetre() -> None:
    truth, view, point, xy, _ = scene(noise=0.0)
    calls = []

    class Counted(Other):
        def project_jacobian(self, ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            calls.append(1)
            return SENSORS[0].project_jacobian(ground)

    triangulate([Counted(), *SENSORS[1:]], view, point, xy, alt=truth[:, 2] + 1.0)
    assert len(calls) in (2, 3)


def test_matches_of_a_pair_meet_where_their_tracks_do() -> None:
    rng = np.random.default_rng(8)
    truth = SENSORS[0].localize(rng.uniform(4000, 15000, (60, 2)), rng.uniform(100, 900, 60))
    image = [SENSORS[v].project(truth) + rng.normal(0, 2.0, (60, 2)) for v in (0, 1)]
    image[0][3] = image[1][5] = np.nan
    alt = np.full(60, 500.0)
    tracks = np.tile([0, 1], 60), np.repeat(np.arange(60), 2), np.stack(image, axis=1).reshape(-1, 2)
    wanted = ground_from_ecef(triangulate(SENSORS[:2], *tracks, alt=alt).points)
    found = intersect_pair(SENSORS[:2], image, alt)
    assert np.flatnonzero(np.isnan(found).any(axis=1)).tolist() == [3, 5]
    assert (np.isnan(found) == np.isnan(wanted)).all()
    known = np.isfinite(found[:, 0])
    assert np.abs(ecef_from_ground(found[known]) - ecef_from_ground(wanted[known])).max() < 1e-6
    assert np.abs(found[known, 2] - truth[known, 2]).max() > 1.0  # the noise counts
    parallel = intersect_pair([SENSORS[0], SENSORS[0]], [image[0], image[0]], alt)
    assert np.isnan(parallel).all()
    # the first camera's guess is none: the second's counts
    blind = [Blind(), SENSORS[1]]
    again = intersect_pair(blind, image, alt)
    for places in (ecef_from_ground(again), triangulate(blind, *tracks, alt=alt).points):
        assert np.abs(places[known] - ecef_from_ground(found[known])).max() < 0.1  # residuals of 2 px
