"""Blocks without pixels: the truth that they state is the truth that they were made from."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.errors import InputError
from barpc.geodesy import ecef_from_ground
from barpc.sensor.corrected import Corrected
from barpc.sensor.geometry import camera_center, convergence_angle, triangulate
from barpc.simulate import recentred, simulate_block


@pytest.fixture(scope="module")
def block():
    return simulate_block(12, 1500, seed=4, outliers=0.1, noise=0.2, num_gcps=7)


def exact(block):
    return [Corrected(v.sensor, c) for v, c in zip(block.views, block.truth.corrections, strict=True)]


def test_the_exact_cameras_see_the_held_out_points_where_they_are(block):
    check = block.truth.check
    for i, sensor in enumerate(exact(block)):
        rows = check.view == i
        seen = sensor.project(block.truth.check_ground[check.point[rows]])
        assert np.abs(seen - check.xy[rows]).max() < 1e-9
    assert block.held_out_rms(exact(block)) < 1e-8


def test_the_delivered_cameras_are_wrong_by_what_their_attitude_says():
    """15 urad at 700 km are 10 m: about 20 px, of which one camera's part is seen as parallax."""
    block = simulate_block(12, 100, attitude=15e-6, position=0.0)
    assert 5.0 < block.held_out_rms([v.sensor for v in block.views]) < 50.0


def test_the_tracks_carry_the_noise_and_the_outliers_that_were_asked_for(block):
    tracks, truth = block.tracks, block.truth
    error = np.empty((len(tracks), 2))
    for i, sensor in enumerate(exact(block)):
        rows = tracks.view == i
        error[rows] = tracks.xy[rows] - sensor.project(truth.ground[tracks.point[rows]])
    assert truth.outlier.sum() == round(0.1 * len(tracks))
    assert error[~truth.outlier].std() == pytest.approx(0.2, rel=0.03)
    assert error[truth.outlier].std() == pytest.approx(30 / np.sqrt(3), rel=0.1)
    assert (tracks.sigma == 0.2).all()


def test_every_track_is_seen_twice_and_rows_stand_in_order(block):
    tracks = block.tracks
    assert tracks.num_points == 1500
    assert (np.bincount(tracks.point) >= 2).all()
    assert (np.lexsort((tracks.view, tracks.point)) == np.arange(len(tracks))).all()
    assert len(block.gcps.names) == 7
    assert np.array_equal(np.unique(block.gcps.point), np.arange(7))


def test_the_geometry_is_that_of_agile_satellites(block):
    """Three views of a site converge by 6 to 26 degrees, from 694 km."""
    middle = block.truth.ground[:50]
    for i in range(0, 12, 3):
        angles = [
            convergence_angle(block.views[a].sensor, block.views[b].sensor, middle).mean()
            for a, b in ((i, i + 1), (i + 1, i + 2), (i, i + 2))
        ]
        assert min(angles) > 6.0
        assert max(angles) < 26.0


def test_the_stated_camera_centre_is_the_one_that_the_delivered_rpc_shows(block):
    for view, correction in zip(block.views, block.truth.corrections, strict=True):
        found = camera_center(view.sensor, view.size, view.alt_range)
        distance = np.linalg.norm(correction.center) - 6.37e6
        assert np.linalg.norm(found.ecef - correction.center) < 0.02 * distance


def test_drift_is_zero_in_the_middle_row_and_grows_towards_the_ends():
    block = simulate_block(3, 400, drift=20e-6, noise=0.0)
    tracks = block.tracks
    for i, sensor in enumerate(exact(block)):
        rows = tracks.view == i
        error = tracks.xy[rows] - sensor.project(block.truth.ground[tracks.point[rows]])
        part = tracks.xy[rows, 1] / block.views[i].size[1] - 0.5
        slope = error.T @ part / (part @ part)
        assert np.abs(error - part[:, None] * slope).max() < 0.05 * np.abs(error).max()
        assert np.abs(error).max() > 1.0


def test_the_same_seed_gives_the_same_block_and_another_gives_another():
    a, b, c = (simulate_block(4, 50, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(a.tracks.xy, b.tracks.xy)
    assert a.truth.corrections == b.truth.corrections
    assert [v.sensor for v in a.views] == [v.sensor for v in b.views]
    assert a.truth.corrections != c.truth.corrections


def test_a_correction_moves_points_alike_about_any_centre(block):
    correction = block.truth.corrections[0]
    other = recentred(correction, correction.center + np.array([2e4, -1e4, 3e4]))
    points = ecef_from_ground(block.truth.ground)
    assert np.abs(other.apply(points) - correction.apply(points)).max() < 1e-8


@pytest.mark.parametrize(("lon", "lat"), [(180.0, 0.0), (0.0, -60.0), (-179.99, 70.0)])
def test_blocks_anywhere_on_earth_triangulate_exactly(lon, lat):
    block = simulate_block(6, 200, lon=lon, lat=lat, noise=0.0)
    tracks = block.tracks
    found = triangulate(exact(block), tracks.view, tracks.point, tracks.xy)
    error = np.linalg.norm(found.points - ecef_from_ground(block.truth.ground), axis=1)
    assert found.ok.all()
    assert error.max() < 1e-5


def test_a_layout_without_overlap_is_refused_in_one_line():
    with pytest.raises(InputError, match="seen by 2 views"):
        simulate_block(4, 100, per_site=1, overlap=0.0)
    with pytest.raises(InputError, match="between 0 and 1"):
        simulate_block(4, 100, outliers=2.0)


@pytest.mark.slow
def test_a_thousand_views_are_simulated():
    block = simulate_block(1000, 20000)
    assert len(block.views) == 1000
    assert block.tracks.num_points == 20000
