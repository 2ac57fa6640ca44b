"""Heights without image coordinates: they place a block, say how well, and do not when they do not agree.

The truth is a terrain of sines and cameras that are the samples' with errors of their own; heights are drawn from the
terrain itself and not from the tie points.
"""

from __future__ import annotations

from itertools import product, starmap
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest

from barpc.ba import Adjustment, adjust_tracks, altimetry
from barpc.ba.constraints import registration
from barpc.ba.constraints.block import join
from barpc.ba.constraints.gauge import gauge_report
from barpc.ba.constraints.registration import (
    PATCH_POINTS,
    GivenHeights,
    Registration,
    TieSurface,
    displacement,
    register,
    search_shift,
)
from barpc.ba.robust.heldout import keep_out
from barpc.ba.select.parts import Parts
from barpc.ba.solution import solve_block
from barpc.base.geodesy import ecef_from_ground, enu_basis, ground_from_ecef
from barpc.base.options import AdjustOptions
from barpc.cameras import open_camera
from barpc.scene import Altimetry, GroundPoints, Tracks, View
from barpc.sensor.corrected import Corrected, Correction
from tests.everywhere import tied
from tests.lanes import rest_slow

SAMPLES = Path(__file__).parents[2] / "data_samples"
BEFORE = np.array([9.0, 9.0, 55.0, 0.2, 0.6, 0.1, 0.1])


def relief(east: np.ndarray, north: np.ndarray, size: float = 1.0) -> np.ndarray:
    """Altitudes (n,) [m]: slopes of 0.3 m a metre where size is 1."""
    return size * (9.0 * np.sin(east / 28.0 + 0.4) + 8.0 * np.cos(north / 31.0 + east / 90.0))


def surface(rng: np.random.Generator, size: float = 1.0, noise: float = 0.1, n: int = 1500) -> np.ndarray:
    xy = rng.uniform(-260.0, 260.0, (n, 2))
    return np.column_stack([xy, relief(*xy.T, size) + rng.normal(0, noise, n)])


def given(
    rng: np.random.Generator, n: int, moved: Any, size: float = 1.0, sigma: float = 0.3, wrong: float = 0.0
) -> GivenHeights:
    """Heights of the relief after it was moved by (east, north, up); a share is wrong by up to 60 m, upwards."""
    xy = rng.uniform(-230.0, 230.0, (n, 2))
    alt = relief(*xy.T, size) + rng.normal(0, sigma, n)
    alt += np.where(rng.random(n) < wrong, rng.uniform(3.0, 60.0, n), 0.0)
    return GivenHeights(np.column_stack([xy, alt]) + moved, np.full(n, sigma), np.zeros(n))


def registered(rng: np.random.Generator, heights: GivenHeights, **scene: Any) -> Registration:
    return register(TieSurface.of(surface(rng, **scene)), heights, 200.0, BEFORE)


def test_the_search_gives_the_shift_on_which_most_heights_agree_and_none_where_there_is_no_surface():
    rng = np.random.default_rng(4)
    here = TieSurface.of(surface(rng))
    found = search_shift(here, given(rng, 400, [11.0, -7.0, 30.0], wrong=0.2), BEFORE)
    np.testing.assert_allclose(found[:3], [11.0, -7.0, 30.0], atol=2.5)
    assert found[3:].tolist() == [0.0] * 4
    assert search_shift(here, given(rng, 50, [5000.0, 0.0, 30.0]), BEFORE).tolist() == [0.0] * 7


def test_a_patch_has_its_own_height_and_slopes():
    rng = np.random.default_rng(0)
    xy = rng.uniform(0.0, 100.0, (300, 2))
    found = TieSurface.of(np.column_stack([xy, 5.0 + 0.3 * xy[:, 0] - 0.2 * xy[:, 1]]))
    slope, _ = found.slope(xy, np.arange(300))
    np.testing.assert_allclose(slope, np.tile([0.3, -0.2], (300, 1)), atol=1e-5)
    height, nearest, near = found.at(np.array([[40.0, 60.0], [500.0, 50.0]]))
    assert height[0] == pytest.approx(5.0, abs=1e-4)
    assert near.tolist() == [True, False]
    assert np.hypot(*(found.points[nearest[0], :2] - [40.0, 60.0])) <= 12.0


def test_motions_are_those_that_are_reported():
    local = np.array([[0.5, -0.25], [1.0, 2.0]])
    moves = displacement(local)
    np.testing.assert_array_equal(moves[1] @ [1, 2, 3, 0, 0, 0, 0], [1, 2, 3])
    np.testing.assert_array_equal(moves[0] @ [0, 0, 0, 2, 4, 0, 0], [0, 0, 0])  # 2 x 0.5 - 4 x 0.25
    np.testing.assert_array_equal(moves[1] @ [0, 0, 0, 1, 0, 0, 0], [0, 0, 1])  # up in the east
    np.testing.assert_array_equal(moves[1] @ [0, 0, 0, 0, 0, 1, 0], [-2, 1, 0])  # counterclockwise
    np.testing.assert_array_equal(moves[1] @ [0, 0, 0, 0, 0, 0, 1], [1, 2, 0])


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "seeds"), rest_slow(starmap(pytest.param, product([0.4, 0.0], [range(3), range(3, 6)])))
)
def test_a_surface_finds_its_place_with_the_right_sign_and_says_how_well(wrong: float, seeds: range):
    moved, ratio = np.array([5.0, -7.0, 90.0]), []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        found = registered(rng, given(rng, 150, moved, wrong=wrong))
        sigma = np.sqrt(np.diag(found.covariance))[:3]
        assert (sigma < [0.5, 0.5, 0.1]).all()
        assert (sigma > [0.02, 0.02, 0.005]).all()
        assert found.share == pytest.approx(1.0 - wrong, abs=0.1)
        ratio.append((found.motion[:3] - moved) / sigma)
    assert 0.4 < np.sqrt(np.mean(np.square(ratio))) < 1.5


@pytest.mark.nightly
def test_heights_that_mostly_disagree_agree_on_nothing():
    rng = np.random.default_rng(1)
    assert not registered(rng, given(rng, 150, [5.0, -7.0, 90.0], wrong=0.8)).is_most
    scattered = given(rng, 150, 0.0)
    elsewhere = GivenHeights(rng.permutation(scattered.place), scattered.sigma, scattered.sigma_flat)
    elsewhere.place[:, 2] = rng.uniform(0.0, 60.0, 150)
    assert not registered(rng, elsewhere).is_most


@pytest.mark.parametrize(
    ("agree", "near", "rivals", "most"),
    [
        (41, 100, 0, True),
        (40, 100, 0, False),
        (90, 100, 62, True),
        (90, 100, 66, False),
        (4, 4, 0, False),
        (5, 5, 0, True),
    ],
)
def test_most_is_a_half_but_for_chance_and_clearly_more_than_agree_elsewhere(agree, near, rivals, most):
    """By two standard deviations of a count, of a half of them as many as agree by chance."""
    zeros, which = np.zeros(near), np.arange(near) < agree
    one = Registration(np.zeros(7), np.eye(7), np.ones(near, bool), which, zeros, zeros, rivals)
    assert one.is_most == most
    assert one.share == pytest.approx(agree / near)


@pytest.mark.slow
def test_two_groups_of_equal_weight_are_no_majority():
    """Half of the heights in another datum, 30 m off: which half is right nobody knows."""
    rng = np.random.default_rng(3)
    heights = given(rng, 150, [5.0, -7.0, 90.0])
    heights.place[::2, 2] += 30.0
    found = registered(rng, heights)
    assert found.share == pytest.approx(0.5, abs=0.05)
    assert not found.is_most
    heights.place[::4, 2] -= 30.0  # three of four are right now
    found = registered(rng, heights)
    assert found.is_most
    np.testing.assert_allclose(found.motion[:3], [5.0, -7.0, 90.0], atol=0.6)


@pytest.mark.nightly
def test_a_plain_tells_heights_and_no_place():
    """Slopes of a plain are its noise: they do not know where it is."""
    rng = np.random.default_rng(2)
    found = registered(rng, given(rng, 200, [5.0, -7.0, 90.0], size=0.0), size=0.0, noise=0.3)
    sigma = np.sqrt(np.diag(found.covariance))[:3]
    assert (sigma[:2] > 9.0).all()
    assert sigma[2] < 0.5
    assert found.motion[2] == pytest.approx(90.0, abs=4.0 * sigma[2])


def test_slopes_that_are_noise_know_no_place():
    """A plain again, where it ends: what slopes claim to know is taken away from what they are uncertain by."""
    rng = np.random.default_rng(2)
    heights, free = given(rng, 400, 0.0, size=0.0), np.diag((10.0 * BEFORE) ** -2)
    plain = TieSurface.of(surface(rng, size=0.0, noise=0.3))
    sigma = np.sqrt(np.diag(registration.registration_at(plain, heights, np.zeros(7), 200.0, 1.0, free).covariance))
    assert (sigma[:2] > 9.0).all()
    assert sigma[2] < 0.5
    hills = TieSurface.of(surface(rng))
    found = registration.registration_at(hills, given(rng, 400, 0.0, wrong=0.2), np.zeros(7), 200.0, 1.0, free)
    assert (np.sqrt(np.diag(found.covariance))[:3] < [0.5, 0.5, 0.1]).all()
    assert found.share == pytest.approx(0.8, abs=0.1)


@pytest.mark.nightly
@pytest.mark.parametrize("seeds", rest_slow([range(2), range(2, 6)]), ids=str)
def test_noise_that_neighbours_share_is_no_knowledge(seeds: range):
    """Along twelve tracks a canopy moves stretches of 40 m by a metre or so: said is what is met."""
    ratio = []
    for seed in seeds:
        rng = np.random.default_rng(50 + seed)
        along = np.tile(np.arange(-230.0, 230.0, 4.0), 12)
        xy = np.column_stack([np.repeat(rng.uniform(-220, 220, 12), len(along) // 12), along])
        shared = np.repeat(rng.normal(0, 1.0, len(along) // 10 + 1), 10)[: len(along)]
        place = np.column_stack([xy, relief(*xy.T) + shared + rng.normal(0, 0.2, len(along))])
        heights = GivenHeights(place + [3.0, 2.0, -20.0], np.full(len(along), 0.5), np.zeros(len(along)))
        found = registered(rng, heights)
        ratio.append((found.motion[:3] - [3.0, 2.0, -20.0]) / np.sqrt(np.diag(found.covariance))[:3])
    assert np.sqrt(np.mean(np.square(ratio))) < 1.5


# --- blocks -----------------------------------------------------------------------------------------------

GEOD = pyproj.Geod(ellps="WGS84")
LON, LAT = 5.4, 43.3002


def ground(east: np.ndarray, north: np.ndarray, up: np.ndarray) -> np.ndarray:
    azimuth, n = np.degrees(np.arctan2(east, north)), len(east)
    lon, lat, _ = GEOD.fwd([LON] * n, [LAT] * n, azimuth.tolist(), np.hypot(east, north).tolist())
    return np.column_stack([lon, lat, up])


@pytest.fixture(scope="module")
def scene() -> tuple[list[View], Tracks, np.ndarray]:
    """Three views whose cameras are off by 10 urad and some metres, and ties of 0.1 px on the relief."""
    rng = np.random.default_rng(7)
    xy = rng.uniform(-200.0, 200.0, (900, 2))
    true = ground(*xy.T, 230.0 + relief(*xy.T))
    views, rows = [], []
    for number in range(3):
        camera = open_camera(SAMPLES / f"view_0{number}.tif")
        center = ecef_from_ground([LON, LAT, 7e5])
        exact = Corrected(camera.model, Correction(rng.normal(0, 1e-5, 3), rng.normal(0, 1.0, 3), center))
        seen = exact.project(true) + rng.normal(0, 0.1, (len(true), 2))
        rows.append(seen)
        views.append(View(f"v{number}", "", (1000, 1000), camera.model, camera.alt_range))
    return views, tied(np.stack(rows, axis=1), 0.1), true


@pytest.fixture(scope="module")
def before(scene: tuple[list[View], Tracks, np.ndarray]) -> Adjustment:
    """The scene, adjusted without heights."""
    return adjust_tracks(*scene[:2])


def heights(seed: int, wrong: float = 0.0, off: float = 0.0, n: int = 300) -> Altimetry:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-190.0, 190.0, (n, 2))
    alt = 230.0 + off + relief(*xy.T) + rng.normal(0, 0.3, n)
    alt += np.where(rng.random(n) < wrong, rng.uniform(3.0, 60.0, n), 0.0)
    return Altimetry(ground(*xy.T, alt), np.full(n, 0.3), np.zeros(n))


def terrain(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    """The relief, 3 m too high."""
    n = len(lon)
    azimuth, _, distance = (np.array(x) for x in GEOD.inv([LON] * n, [LAT] * n, lon.tolist(), lat.tolist()))
    return 233.0 + relief(distance * np.sin(np.radians(azimuth)), distance * np.cos(np.radians(azimuth)))


def error(adjusted: Any, true: np.ndarray) -> np.ndarray:
    """Mean east, north, up [m] of the adjusted tie points minus the truth."""
    found = ground_from_ecef(adjusted.points)
    kept = np.isfinite(found).all(axis=1)
    azimuth, _, distance = (np.array(x) for x in GEOD.inv(*true[kept, :2].T, *found[kept, :2].T))
    level = distance * np.array([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))])
    return np.array([*level.mean(axis=1), (found[kept, 2] - true[kept, 2]).mean()])


@pytest.mark.parametrize("wrong", rest_slow([0.4, 0.0]))
def test_a_block_is_placed_by_heights_within_what_it_says(scene: Any, before: Adjustment, wrong: float):
    views, tracks, true = scene
    assert np.abs(error(before, true)[2]) > 5.0  # the sign is told by where the heights lie
    after = adjust_tracks(views, tracks, altimetry=heights(3, wrong))
    test = after.altimetry
    assert not test.why_not
    assert (after.gauge.sigma < [1.0, 1.0, 0.5]).all()
    assert (np.abs(error(after, true)) < 3.0 * after.gauge.sigma).all()
    assert (np.abs(error(after, true)) < [1.0, 1.0, 0.3]).all()
    assert after.datum["altimetry"][:3].min() > 0.9
    assert np.nanmax(after.held_out_rms) < 1.02 * np.nanmax(before.held_out_rms)
    assert before.altimetry is None
    assert not before.datum["altimetry"].any()
    asked = error(before, true) + test.motion
    assert (np.abs(asked) < 4.0 * np.hypot(test.sigma, 0.05)).all()


@pytest.mark.parametrize("told", rest_slow([{"n": 10}, {"wrong": 0.8}]))
def test_heights_that_disagree_move_nothing(scene: Any, before: Adjustment, told: dict[str, Any]):
    views, tracks, _ = scene
    after = adjust_tracks(views, tracks, altimetry=heights(4, **told))
    assert after.altimetry.why_not
    np.testing.assert_array_equal(after.params, before.params)
    np.testing.assert_array_equal(after.gauge.sigma, before.gauge.sigma)


@pytest.mark.slow
def test_heights_that_contradict_control_points_are_not_used(scene: Any):
    views, tracks, true = scene
    rng = np.random.default_rng(0)
    chosen = np.arange(0, 900, 180)
    point, view = np.repeat(np.arange(5), 3), np.tile(np.arange(3), 5)
    rows = (3 * chosen[:, None] + np.arange(3)).ravel()
    xy = tracks.xy[rows] + rng.normal(0, 0.1, (15, 2))
    gcps = GroundPoints(tuple("abcde"), true[chosen], np.full((5, 3), 0.3), point, view, xy, np.full(15, 0.3))
    alone = adjust_tracks(views, tracks, gcps=gcps)
    geoid = adjust_tracks(views, tracks, gcps=gcps, altimetry=heights(6, off=-48.0))
    assert "contradict the other control" in geoid.altimetry.why_not
    assert geoid.altimetry.motion[2] == pytest.approx(-48.0, abs=1.0)
    np.testing.assert_array_equal(geoid.params, alone.params)
    right = adjust_tracks(views, tracks, gcps=gcps, altimetry=heights(6))
    assert not right.altimetry.why_not
    assert (right.gauge.sigma <= 1.001 * alone.gauge.sigma).all()


@pytest.mark.slow
def test_heights_and_a_terrain_hold_together(scene: Any):
    """A terrain 3 m too high with 5 m stated does not move what the heights know."""
    views, tracks, true = scene
    options = AdjustOptions(dem_sigma=2.0, dem_bias_sigma=5.0)
    after = adjust_tracks(views, tracks, options, dem=terrain, altimetry=heights(8), hold_out=False)
    assert not after.altimetry.why_not
    assert np.abs(error(after, true)[2]) < 0.4


def test_fewer_tie_points_than_a_patch_needs_are_said(scene: Any):
    views, tracks, _ = scene
    few = tracks.select(tracks.point < PATCH_POINTS)
    after = adjust_tracks(views, few, altimetry=heights(3), hold_out=False)
    assert "are needed" in after.altimetry.why_not
    assert (after.altimetry.near, after.altimetry.agree) == (0, 0)


def plane_of(slope: tuple[float, float], sigma: float, reach: float) -> Any:
    """A surface that is known but for a scatter, in patches."""
    east, north = slope

    def at(place: Any) -> Any:
        n = len(place)
        return place @ [east, north], np.zeros(n, dtype=int), np.abs(place).max(axis=1) <= 300.0

    return SimpleNamespace(
        at=at,
        slope=lambda place, nearest: (np.tile([east, north], (len(place), 1)), np.zeros((len(place), 2, 2))),
        variance=lambda place, nearest: np.full(len(place), sigma**2),
        reach=np.full(3, reach),
    )


@pytest.mark.parametrize(("noise", "reach"), [(0.7, 500.0), (1.5, 500.0), (1.0, 30.0)])
def test_what_a_plane_is_told_is_the_covariance_of_an_m_estimate(noise: float, reach: float):
    """Huber's: by Tukey's weights, whose cut is 4.685 sigmas; nothing shared where all lie within one patch, else as
    much as sums over patches scatter more than sums of independent errors do.
    """
    rng = np.random.default_rng(3)
    place = np.column_stack([rng.uniform(0.0, 400.0, (80, 2)), np.zeros(80)])
    place[:, 2] = place[:, :2] @ [0.3, -0.2] + rng.normal(0.0, 0.8, 80)
    place[:9, 2] += rng.uniform(2.0, 30.0, 9)
    place[:, 2] += (reach < 100.0) * 0.8 * np.sin(place[:, 0] // 60.0 + 2.0 * (place[:, 1] // 60.0))
    heights = GivenHeights(place, np.full(80, 0.5), np.full(80, 0.9))
    surface: Any = plane_of((0.3, -0.2), 0.4, reach)
    free = np.diag(np.arange(1.0, 8.0) ** -2.0)
    found = registration.registration_at(surface, heights, np.zeros(7), 200.0, noise, free)
    scale, cut = max(noise, 1.0), registration.BIWEIGHT
    sigma = np.sqrt(0.4**2 + 0.5**2 + (0.3**2 + 0.2**2) * 0.9**2)
    near = place[:, :2].max(axis=1) <= 300.0
    off = place[:, 2] - place[:, :2] @ [0.3, -0.2]
    np.testing.assert_allclose(found.residual, np.where(near, off, np.nan))
    np.testing.assert_allclose(found.sigma, sigma)
    np.testing.assert_array_equal(found.near, near)
    np.testing.assert_array_equal(found.agree, near & (np.abs(off) < registration.SURELY * scale * sigma))
    rows = np.einsum("c,ncm->nm", [-0.3, 0.2, 1.0], displacement(place[:, :2] / 200.0))
    z = off / (scale * sigma)
    inside = near & (np.abs(z) < cut)
    assert near.sum() > inside.sum() > 40

    def psi(x: np.ndarray) -> np.ndarray:
        return x * (1.0 - (x / cut) ** 2) ** 2

    step = 1e-6
    rate = ((psi(z + step) - psi(z - step)) / (2 * step))[inside].mean()
    bread = (rows[inside].T @ rows[inside]) * rate / (scale * sigma) ** 2 + free
    forms = rows[inside] * (psi(z[inside]) / (scale * sigma))[:, None]
    inverse = np.linalg.inv(bread)
    factor, size = np.ones(7), 2.0 * reach
    while len(cells := {tuple(one) for one in place[inside, :2] // size}) >= altimetry.FEWEST:
        sums = np.array([forms[(place[inside, :2] // size == cell).all(axis=1)].sum(axis=0) for cell in cells])
        ratio = (sums**2).sum(axis=0) / (forms**2).sum(axis=0) * len(cells) / (len(cells) - 7)
        for part in ([2, 3, 4], [0, 1, 5, 6]):  # up, and level
            factor[part] = np.maximum(factor[part], np.sqrt(ratio[part].mean()))
        size *= 2.0
    assert (factor.max() > 1.2) == (reach < 100.0)
    told = inverse @ (factor[:, None] * (forms.T @ forms) * factor + free) @ inverse
    expected = np.linalg.inv(np.linalg.inv(told) + free)
    np.testing.assert_allclose(found.covariance, expected, rtol=2e-3, atol=1e-6)
    rest = np.sort(off[near & ~found.agree])
    width = 2.0 * registration.SURELY * scale * sigma
    assert found.rivals == max((rest <= low + width).sum() - n for n, low in enumerate(rest))


@pytest.mark.parametrize(("whole", "most", "every"), [(False, 900, 1), (True, 900, 2), (False, 420, 2), (True, 600, 2)])
def test_a_motion_is_held_at_every_second_tie_point_beside_a_terrain(scene: Any, sized, whole, most, every):
    """And at no more than so many; they bend by what was known of tilts before, over where all of them lie."""
    views, tracks, _ = scene
    block = join(views, tracks, None, AdjustOptions())
    parts = Parts(block, keep_out(block), np.zeros(len(block.view), dtype=np.int64))
    found = solve_block(parts.inner, parts.outer, AdjustOptions(), terrain if whole else None, None, None)
    sized(altimetry_points=most)
    tried, said = altimetry.hold_by_altimetry(found, parts.inner, parts.outer, heights(3))
    assert not said.why_not
    ties, held = np.flatnonzero(found.seen), tried.heights.placed
    np.testing.assert_array_equal(held.index, ties[::every])
    points = found.final.points[ties]
    center = points.mean(axis=0)
    local = ((points - center) @ enu_basis(ground_from_ecef(center)).T)[:, :2]
    east, north = (local / np.sqrt((local**2).sum(axis=1).mean()))[::every].T
    covariance = found.outcome.covariance(found.problem.free)
    tilts = gauge_report(covariance, found.final.points, found.final.points, found.seen).by_unknown[3:5]
    known = np.sqrt(np.diag(tilts @ covariance.solve(tilts.T)).max())
    bend = held.common[:, 2, -3:] / np.stack([east**2, east * north, north**2], axis=1)
    np.testing.assert_allclose(bend, np.full(bend.shape, bend[0, 0]), rtol=1e-6)
    assert bend[0, 0] / np.linalg.norm(held.rows[0, 2]) == pytest.approx(100.0 * known, rel=0.01)  # beside a floor
