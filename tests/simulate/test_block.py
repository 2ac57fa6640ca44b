"""Blocks without pixels: the truth that they state is the truth that they were made from."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.base.geodesy import ecef_from_ground, metres_per_unit
from barpc.sensor.centers import camera_center
from barpc.sensor.corrected import Corrected
from barpc.sensor.geometry import convergence_angle
from barpc.sensor.triangulation import triangulate
from barpc.simulate import BlockOptions, fly, looks, recentred, simulate_block


@pytest.fixture(scope="module")
def block():
    return simulate_block(12, 1500, seed=4, outliers=0.1, noise=0.2, num_gcps=7)


def exact(block):
    return [Corrected(v.sensor, c) for v, c in zip(block.views, block.truth.corrections, strict=True)]


def errors(block, seen, ground):
    """How far observations lie from where the exact cameras see their points (N, 2) [px]."""
    found = np.empty((len(seen.view), 2))
    for i, sensor in enumerate(exact(block)):
        rows = seen.view == i
        found[rows] = seen.xy[rows] - sensor.project(ground[seen.point[rows]])
    return found


def test_the_exact_cameras_see_the_held_out_points_where_they_are(block):
    assert np.abs(errors(block, block.truth.check, block.truth.check_ground)).max() < 1e-9
    assert block.held_out_rms(exact(block)) < 1e-8


def test_the_delivered_cameras_are_wrong_by_what_their_attitude_says():
    """15 urad at 700 km are 10 m: about 20 px, of which one camera's part is seen as parallax."""
    block = simulate_block(12, 100, attitude=15e-6, position=0.0)
    assert 5.0 < block.held_out_rms([v.sensor for v in block.views]) < 50.0


def test_the_tracks_carry_the_noise_and_the_outliers_that_were_asked_for(block):
    tracks, truth = block.tracks, block.truth
    error = errors(block, tracks, truth.ground)
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
    tracks, every = block.tracks, errors(block, block.tracks, block.truth.ground)
    for i in range(3):
        rows = tracks.view == i
        error = every[rows]
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


@pytest.mark.nightly
def test_a_thousand_views_are_simulated():
    block = simulate_block(1000, 20000)
    assert len(block.views) == 1000
    assert block.tracks.num_points == 20000


# --- pieces -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("num_views", "per_site", "columns", "rows"),
    [
        (1, 3, 1, 1),
        (3, 3, 1, 1),
        (4, 3, 2, 1),
        (12, 3, 2, 2),
        (13, 3, 3, 2),
        (27, 3, 3, 3),
        (28, 3, 4, 3),
        (5, 1, 3, 2),
    ],
)  # fmt: skip
def test_sites_stand_on_a_grid_as_square_as_can_be(num_views, per_site, columns, rows):
    lon, lat = sites(num_views, per_site=per_site, lon=5.0, lat=43.0).round(9).T
    assert (len(np.unique(lon)), len(np.unique(lat))) == (columns, rows)


def sites(num_views, **options):
    """Where the middles of the images lie, a site's first, as (lon, lat): cameras as delivered that are right."""
    block = simulate_block(num_views, 0, num_checks=0, attitude=0.0, position=0.0, **options)
    first = block.views[:: options.get("per_site", 3)]
    middle = [view.sensor.localize((np.array(view.size) - 1.0) / 2.0, np.mean(view.alt_range)) for view in first]
    return np.array(middle)[:, :2]


def test_neighbouring_sites_are_an_image_less_the_overlap_apart():
    found = sites(12, size=(4000, 3000), overlap=0.25, gsd=0.5, lon=5.0, lat=43.0)
    step = np.array([0.75 * 2000, 0.75 * 1500]) / metres_per_unit(np.array([5.0, 43.0, 0.0]))[:2]
    signs = [[-0.5, 0.5], [0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]]  # rows run south
    np.testing.assert_allclose(found, [5.0, 43.0] + step * signs, atol=1e-7)
    west, east = sites(6, lon=180.0, lat=0.0)[:, 0]
    assert west == pytest.approx(-east, abs=1e-7)
    assert 179.0 < west < 180.0


def test_a_block_ends_before_the_pole():
    step = np.ptp(sites(9, per_site=1, lon=0.0, lat=84.0)[:, 1]) / 2.0
    for lat in (85.0 - 0.5 * step - 1e-3, -85.0 + 0.5 * step + 1e-3):
        assert len(sites(1, lon=0.0, lat=lat)) == 1
        with pytest.raises(InputError, match="beyond 85"):
            simulate_block(1, 0, lon=0.0, lat=lat + np.copysign(2e-3, lat))


@pytest.mark.parametrize("wrong", [{"num_views": 0}, {"num_tracks": -1}, {"num_checks": -1}, {"num_gcps": -1}], ids=str)
def test_counts_are_not_negative_and_there_is_a_view(wrong):
    with pytest.raises(InputError, match="at least one view"):
        simulate_block(**wrong)


def test_ground_control_is_exact_on_the_ground_and_noisy_in_the_images(block):
    gcps = block.gcps
    assert gcps.names[0] == "gcp_000"
    assert (gcps.sigma == 0.1).all()
    assert (gcps.xy_sigma == 0.2).all()
    error = errors(block, gcps, gcps.lonlatalt)
    assert 0.1 < error.std() < 0.3
    assert np.abs(error).max() < 1.0  # no outliers


def test_points_lie_at_all_altitudes_that_were_asked_for_and_all_over_the_block():
    block = simulate_block(12, 1500, seed=1, alt_range=(100.0, 300.0), noise=0.0)
    alt = block.truth.ground[:, 2]
    assert 100.0 <= alt.min() < 105.0
    assert 295.0 < alt.max() <= 300.0
    assert (block.tracks.sigma == 0.1).all()
    assert not block.truth.outlier.any()
    for i, view in enumerate(block.views):
        xy = block.tracks.xy[block.tracks.view == i] / (np.array(view.size) - 1.0)
        assert len(xy) > 100
        assert xy.min() >= 0.0
        assert xy.max() <= 1.0
        assert (xy.min(axis=0) < 0.1).all()
        assert (xy.max(axis=0) > 0.9).all()
    assert [view.name for view in block.views[:2]] == ["view_0000", "view_0001"]


@pytest.mark.slow
def test_fewer_observations_are_made_where_less_is_visible():
    lengths = [np.bincount(simulate_block(9, 400, seed=2, visible=share).tracks.point).mean() for share in (1.0, 0.6)]
    assert lengths[1] < 0.85 * lengths[0]


@pytest.mark.parametrize(
    ("field", "taken", "refused"),
    [
        ("per_site", [1], [0]), ("size", [(64, 64), (64, 900)], [(63, 64), (900, 63)]), ("gsd", [0.01], [0.0, -1.0]),
        ("overlap", [0.0, 0.5], [-0.01, 0.51]), ("visible", [0.0, 1.0], [-0.01, 1.01]),
        ("outliers", [0.0, 1.0], [-0.01, 1.01]), ("alt_range", [(0.0, 0.1)], [(5.0, 5.0), (6.0, 5.0)]),
    ],
)  # fmt: skip
def test_the_layout_of_a_block_is_taken_up_to_its_bounds(field, taken, refused):
    for value in taken:
        assert getattr(BlockOptions(**{field: value}), field) == value
    for value in refused:
        with pytest.raises(InputError, match="block: "):
            BlockOptions(**{field: value})


def test_a_block_may_have_no_tracks():
    block = simulate_block(3, 0, num_checks=5)
    assert block.tracks.num_points == 0
    assert block.truth.check.num_points == 5
    assert simulate_block(3, 5, num_checks=0).truth.check.num_points == 0


def test_corrections_turn_about_where_the_satellite_is_in_the_middle_of_the_image():
    layout = {"lon": 20.0, "lat": 10.0, "per_site": 2, "size": (3000, 9000), "alt_range": (100.0, 300.0)}
    block, there, options = simulate_block(4, 50, **layout), sites(4, **layout), BlockOptions(size=(3000, 9000))
    for number, correction in enumerate(block.truth.corrections):
        lon, lat = there[number // 2]
        flown = fly(np.array([lon, lat, 200.0]), looks(2, 0.0)[number % 2], options.size, options.gsd)
        assert np.linalg.norm(correction.center - flown.position(4499.5)) < 1.0
    low, high = block.views[0].alt_range
    assert (low, high) == pytest.approx((100.0 - 70.0, 300.0 + 70.0))  # a tenth of 200 m, and 50 m
