"""Intersections against scipy's least squares of the weighted reprojection errors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from barpc.base.geodesy import ecef_from_ground, ground_from_ecef
from barpc.sensor.rpc import RPC
from barpc.sensor.triangulation import intersect_pair, triangulate
from tests.sensor.test_geometry import tilted_rpc

SENSORS = [tilted_rpc((0.6, -0.4)), tilted_rpc((-0.3, 0.2)), tilted_rpc((0.1, 0.5))]


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


def test_it_stops_where_the_step_is_below_a_millimetre() -> None:
    truth, view, point, xy, _ = scene(noise=0.0)
    calls = []

    class Counted:
        def project_jacobian(self, ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            calls.append(1)
            return SENSORS[0].project_jacobian(ground)

        def __getattr__(self, name: str) -> object:
            return getattr(SENSORS[0], name)

    triangulate([Counted(), *SENSORS[1:]], view, point, xy, alt=truth[:, 2] + 1.0)
    assert len(calls) in (2, 3)


class Blind(RPC):
    """An RPC that localises nothing."""

    def localize(self, image: np.ndarray, alt: np.ndarray) -> np.ndarray:
        return np.full((len(image), 3), np.nan)


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
    one = SENSORS[0]
    blind = Blind(one.coeffs, one.ground_offset, one.ground_scale, one.image_offset, one.image_scale)
    again = intersect_pair([blind, SENSORS[1]], image, alt)
    assert np.abs(ecef_from_ground(again[known]) - ecef_from_ground(found[known])).max() < 0.1  # residuals of 2 px
