"""What is known of points: heights of a terrain and of a reference, and what is said of them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest

from barpc.ba.constraints.gauge import MOTIONS, motions_of_moves
from barpc.ba.constraints.ground import (
    DEM_BIAS,
    PointConstraints,
    flat_heights,
    ground_control,
    reference_control,
    terrain_heights,
)
from barpc.ba.constraints.terrain import NUM_BENDS, RegularisedDem, Relief
from barpc.ba.parameters.priors import DEFAULT_ACCURACY, USABLE_ACCURACY, prior_sigmas
from barpc.base.errors import BarpcWarning
from barpc.base.geodesy import ecef_from_ground, enu_basis, ground_from_ecef
from barpc.base.options import AdjustOptions
from barpc.scene import GroundPoints, Reference
from barpc.sensor.pushbroom import Pushbroom
from tests.ba.conftest import Held, as_stated, held_by

LON, LAT = 5.0, 43.0
GEOD = pyproj.Geod(ellps="WGS84")


def placed(east: Any, north: Any, alt: Any) -> np.ndarray:
    """Points so many metres east and north of a place, ECEF (n, 3) [m]; for distances of a few km."""
    east, north, alt = np.broadcast_arrays(*(np.atleast_1d(np.asarray(x, dtype=float)) for x in (east, north, alt)))
    n = len(east)
    azimuth, distance = np.degrees(np.arctan2(east, north)), np.hypot(east, north)
    lon, lat, _ = GEOD.fwd([LON] * n, [LAT] * n, azimuth.tolist(), distance.tolist())  # one of each is not a number
    return ecef_from_ground(np.column_stack([lon, lat, alt]))


def hill(lon: Any, lat: Any) -> np.ndarray:
    """Rises by 0.2 m a metre to the east, 0.1 m a metre to the south; unknown west of 2 km."""
    n = len(lon)
    azimuth, _, distance = map(np.array, GEOD.inv([LON] * n, [LAT] * n, lon.tolist(), lat.tolist()))
    east, north = distance * np.sin(np.radians(azimuth)), distance * np.cos(np.radians(azimuth))
    return np.where(east > -2000.0, 300.0 + 0.2 * east - 0.1 * north, np.nan)


def heights(n: int = 6, **given: Any) -> PointConstraints:
    """Of n tracks the last two are weak."""
    weak = np.arange(n) >= n - 2
    options = AdjustOptions(**given.pop("options", {}))
    return PointConstraints(
        (), weak, np.arange(n), (0.0, 500.0), options, given.pop("dem", hill), given.pop("reference", None)
    )


def test_what_altimetry_holds_a_terrain_does_not_and_of_the_rest_those_with_weak_rays_by_its_slopes() -> None:
    """Of a DEM that too few tie points can judge: six tracks, the first and the last of which altimetry holds."""
    points = placed([0.0, 300.0, -300.0, 500.0, 100.0, 0.0], [0.0, 300.0, 200.0, -100.0, 400.0, 50.0], 350.0)
    relief = Relief(None, np.zeros(6, dtype=bool), np.full(3, np.nan), np.zeros((3, 6)), np.full(3, np.nan))
    by_altimetry = flat_heights(points, np.array([0, 5]), 350.0, 1.0, 0.0)
    given = replace(heights(), relief=relief, placed=by_altimetry)
    held = held_by(given, points)
    assert held.index.tolist() == [1, 2, 3, 4, 0, 5]
    up = enu_basis(ground_from_ecef(points[1:5]))[:, 2]
    along = held.rows[:4, 0] / np.linalg.norm(held.rows[:4, 0], axis=1, keepdims=True)
    assert ((along * up).sum(axis=1) > 0.9999).tolist() == [True, True, True, False]


def test_what_is_believed_of_a_dem_holds_all_tracks_but_those_held_already(monkeypatch) -> None:
    """Single heights as well as so many are worth one; all of them wrong together by bends as large as is told."""
    points = placed([0.0, 300.0, -300.0, 500.0], [0.0, 300.0, 200.0, -100.0], 350.0)
    bent = np.linspace(-1.0, 1.0, 4 * NUM_BENDS).reshape(4, NUM_BENDS)
    alt, slopes = np.array([340.0, 341.0, np.nan, 343.0]), np.tile([0.2, -0.1], (4, 1))
    found = RegularisedDem(alt, slopes, bent, np.ones(3), 2.0, 4.0, 1.0, True)
    monkeypatch.setattr(PointConstraints, "_weighted_dem", lambda self, given: found if given is points else None)
    asked: list[float] = []
    relief: Any = SimpleNamespace(common_sigma=lambda bias: asked.append(bias) or np.arange(1.0, NUM_BENDS + 1.0))
    by_altimetry = flat_heights(points, np.array([3]), 350.0, 1.0, 0.0)
    held = held_by(replace(heights(4), relief=relief, placed=by_altimetry), points)
    assert held.index.tolist() == [0, 1, 3]
    off = held.apart(points)[:2, 0]
    np.testing.assert_allclose(off, (350.0 - alt[:2]) / 4.0, rtol=1e-5)  # sigmas of 2 m, of which four are worth one
    np.testing.assert_allclose(held.apart(placed([10.0] * 4, 0.0, 350.0))[:2, 0] - held.apart(
        placed([0.0] * 4, 0.0, 350.0))[:2, 0], -0.5, atol=1e-2)  # fmt: skip
    np.testing.assert_allclose(held.common[:2, 0], bent[:2] * np.arange(1.0, NUM_BENDS + 1.0) / 4.0)
    assert not held.common[:, 1:].any()
    assert asked == [DEM_BIAS]


def test_a_terrain_is_met_along_its_normal() -> None:
    points = placed([0.0, 500.0, -300.0], [0.0, 800.0, 100.0], 350.0)
    prior = terrain_heights(points, np.arange(3), hill, 2.0, 0.0)
    rows = prior.apart(points)
    expected = (350.0 - hill(*_ground(points)[:, :2].T)) / 2.0
    np.testing.assert_allclose(rows[:, 0], expected, rtol=1e-6)
    assert not rows[:, 1:].any()
    east = placed(np.array([0.0, 500.0, -300.0]) + 10.0, [0.0, 800.0, 100.0], 350.0)
    south = placed([0.0, 500.0, -300.0], np.array([0.0, 800.0, 100.0]) - 10.0, 350.0)
    np.testing.assert_allclose((prior.apart(east) - rows)[:, 0], -1.0, atol=2e-3)  # 10 m of 0.2, over two
    np.testing.assert_allclose((prior.apart(south) - rows)[:, 0], -0.5, atol=2e-3)


def _ground(points: np.ndarray) -> np.ndarray:
    to_ground = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    return np.stack(to_ground.transform(*points.T.tolist()), axis=-1)  # lists: one point is not a number


def test_slopes_are_taken_over_thirty_metres() -> None:
    asked: list[np.ndarray] = []

    def level(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
        asked.append(np.column_stack([lon, lat]))
        return np.zeros(len(lon))

    terrain_heights(placed(0.0, 0.0, 0.0), np.array([0]), level, 1.0, 0.0)
    middle, *around = np.concatenate(asked)
    azimuth, _, distance = GEOD.inv(*np.tile(middle, (4, 1)).T, *np.array(around).T)
    np.testing.assert_allclose(distance, 15.0, rtol=1e-5)
    np.testing.assert_allclose(azimuth % 360.0, [90.0, 270.0, 0.0, 180.0], atol=1e-3)


def test_where_the_slope_is_unknown_the_height_holds_alone_and_where_the_height_is_unknown_nothing() -> None:
    points = placed([-1990.0, -2100.0, 0.0], 0.0, 350.0)
    prior = terrain_heights(points, np.array([0, 1, 2]), hill, 1.0, 5.0)
    assert prior.index.tolist() == [0, 2]
    up = prior.rows[0, 0] @ (placed(-1990.0, 0.0, 351.0) - placed(-1990.0, 0.0, 350.0))[0]
    east = prior.rows[0, 0] @ (placed(-1980.0, 0.0, 350.0) - placed(-1990.0, 0.0, 350.0))[0]
    assert up == pytest.approx(1.0, rel=1e-6)
    assert abs(east) < 0.02
    nowhere = terrain_heights(points[1:2], np.array([0]), hill, 1.0, 5.0)
    assert nowhere.common.shape == (0, 3, 3)
    problem: Any = Held(prior)
    none = replace(heights(3, dem=None), weak=np.zeros(3, dtype=bool), placed=nowhere)
    assert none.hold(problem, points).point_prior is None


def test_what_heights_share_is_a_level_and_slopes_that_are_as_large_at_the_edges() -> None:
    points = placed([-1000.0, 0.0, 3000.0], [500.0, -1500.0, 1000.0], 300.0)
    prior = flat_heights(points, np.arange(3), 300.0, 2.0, 6.0)
    np.testing.assert_allclose(prior.common[:, 0, 0], 3.0)
    east, north = np.array([-1000.0, 0.0, 3000.0]), np.array([500.0, -1500.0, 1000.0])
    for column, offset in ((1, east), (2, north)):
        away = offset - offset.mean()
        np.testing.assert_allclose(prior.common[:, 0, column], 3.0 * away / np.abs(away).max(), atol=3e-3)
    assert not prior.common[:, 1:].any()
    # by the edges of others
    of_others = terrain_heights(points, np.array([0]), lambda lon, _: np.full(len(lon), 300.0), 2.0, 6.0, span=points)
    np.testing.assert_allclose(of_others.common[:, 0, 1:], prior.common[:1, 0, 1:], atol=3e-9)
    lone = flat_heights(points, np.array([0]), 300.0, 2.0, 6.0)
    np.testing.assert_allclose(lone.common[:, 0, 1:] / 3.0, 0.0, atol=1e-6)  # one point has no slope


def test_blocks_with_and_without_errors_in_common_are_joined() -> None:
    points = placed([0.0, 100.0, 200.0], 0.0, 300.0)
    gcps = GroundPoints(
        ("a",), _ground(points[:1]), [[0.1, 0.2, 0.4]], [0], [0], np.zeros((1, 2)), np.ones(1)
    )  # fmt: skip
    control, flat = ground_control(gcps, np.array([0])), flat_heights(points, np.array([1, 2]), 300.0, 2.0, 6.0)
    none = replace(heights(3, dem=None), weak=np.zeros(3, dtype=bool))
    joined = held_by(replace(none, control=(control,), placed=flat), points)
    assert joined.index.tolist() == [0, 1, 2]
    assert joined.common.shape == (3, 3, 3)
    assert not joined.common[0].any()
    np.testing.assert_array_equal(joined.common[1:], flat.common)
    moved = points + placed(0.0, 0.0, 301.0) - placed(0.0, 0.0, 300.0)
    np.testing.assert_allclose(control.apart(moved)[0], [0.0, 0.0, 2.5], atol=1e-6)


@pytest.mark.parametrize(("options", "bias"), [({"dem_bias_sigma": 3.0}, 3.0), ({}, DEM_BIAS)])
@as_stated()
def test_a_terrain_as_stated_holds_all_tracks(options: dict[str, Any], bias: float) -> None:
    points = placed(np.linspace(0, 2000, 6), np.linspace(0, 1000, 6), 350.0)
    held = held_by(heights(options={"dem_sigma": 4.0, **options}), points)
    assert held.index.tolist() == list(range(6))
    np.testing.assert_allclose(1.0 / (held.rows[:, 0] @ _up(points[0])), 4.0, rtol=1e-3)
    np.testing.assert_allclose(held.common[:, 0, 0], bias / 4.0)


def _up(point: np.ndarray) -> np.ndarray:
    lon, lat = np.radians(_ground(point[None])[0, :2])
    return np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])


@pytest.mark.parametrize(("n", "factor"), [(10, 1.0), (100, 2.0)])
def test_tracks_beside_a_reference_share_its_terrain(n: int, factor: float) -> None:
    """All are held, as well as 25 alone would be, and by the reference's own bias and edges."""
    points = placed(np.linspace(-1500, 1500, n), np.linspace(-800, 800, n), 350.0)
    span = placed([-4000.0, 4000.0], [-2000.0, 2000.0], 300.0)
    gcps = GroundPoints(("a", "b"), _ground(span), np.ones((2, 3)), [0, 1], [0, 0], np.zeros((2, 2)), np.ones(2))
    reference = Reference(gcps, np.array([1.0, 1.0, 8.0]), np.zeros((1, 2)))
    made = heights(n, reference=reference, options={"dem_sigma": 4.0, "dem_bias_sigma": 99.0})
    made = replace(made, control=(ground_control(gcps, np.arange(2)),) * 2)
    held = held_by(made, points)
    assert len(held.index) == n + 4  # behind both points of the reference, twice
    np.testing.assert_allclose(1.0 / (held.rows[4:, 0] @ _up(points[0])), 4.0 * factor, rtol=1e-3)
    np.testing.assert_allclose(held.common[4:, 0, 0], 2.0 / factor)
    assert held.common[-1, 0, 1] == pytest.approx(2.0 / factor * 1500 / 4000, rel=0.01)


def test_how_tie_points_lie_to_a_terrain_is_a_median_and_its_deviation() -> None:
    east = np.array([0.0, 100.0, 200.0, 300.0, -2500.0, 500.0])
    above = np.array([3.0, 7.0, 4.0, 900.0, 7.0, 9.0])
    points = placed(east, 0.0, np.nan_to_num(300.0 + 0.2 * east) + above)
    made = replace(heights(dem=hill), weak=np.arange(6) >= 3)
    seen = np.array([1, 1, 1, 1, 1, 0], dtype=bool)
    found = made.test(points, seen)
    assert (found.held, found.known, found.total, found.bias) == (1, 4, 5, 20.0)
    assert found.offset == pytest.approx(5.5, abs=1e-3)  # of 3, 4, 7 and 900
    assert found.spread == pytest.approx(1.4826 * 2.0, abs=2e-3)  # of 2.5, 1.5, 1.5, 894.5
    none = made.test(placed(-2500.0, 0.0, np.full(6, 300.0)), seen)
    assert (none.held, none.known) == (0, 0)
    assert np.isnan([none.offset, none.spread]).all()
    assert replace(made, dem=None).test(points, seen) is None


def test_tracks_that_are_held_in_height_without_a_terrain_are_counted(recwarn) -> None:
    with pytest.warns(BarpcWarning, match=r"^2 of 6 tracks are seen under less than 3 deg: without a DEM"):
        heights(dem=None, options={"min_convergence": 3.0}).warn()
    heights().warn()  # with a DEM
    replace(heights(dem=None), weak=np.zeros(6, dtype=bool)).warn()
    assert not recwarn.list


# --- what cameras state -------------------------------------------------------------------------------------------


def flown(*accuracy: float) -> Any:
    """A view of a camera of which so much is stated."""
    sensor: Any = object.__new__(Pushbroom)
    object.__setattr__(sensor, "accuracy", accuracy or None)
    return SimpleNamespace(sensor=sensor)


def test_a_camera_is_as_accurate_as_it_states_for_attitude_and_position() -> None:
    views: Any = (flown(0.01, 0.02), flown())
    stated = prior_sigmas(views, AdjustOptions(), 0, None, 0)
    np.testing.assert_array_equal(stated, [[USABLE_ACCURACY] * 6, [DEFAULT_ACCURACY] * 6])
    views = (flown(3.0, 0.5), flown(0.3, 9.0))
    sigma = prior_sigmas(views, AdjustOptions(), 2, None, 0)
    np.testing.assert_array_equal(sigma[0], np.repeat([3.0, 0.5, 0.2, 0.2], 3))
    np.testing.assert_array_equal(sigma[1], np.repeat([0.3, 9.0, 0.2, 0.2], 3))
    # one that is known to be off by more than that is not held to it, in either
    off = prior_sigmas(views, AdjustOptions(), 0, np.array([1.0, np.nan]), 0)
    np.testing.assert_array_equal(off, [np.repeat([3.0, 1.0], 3), np.repeat([0.3, 9.0], 3)])
    given = prior_sigmas(views, AdjustOptions(sigma_position=2.0), 1, None, 4)
    np.testing.assert_array_equal(given[:, 3:], [[2.0] * 3 + [0.2] * 3 + [1.0] * 4] * 2)


# --- motions of a scene ---------------------------------------------------------------------------------------------


def test_motions_of_points_are_those_of_least_squares() -> None:
    """Of a scene that was moved, tilted, turned, grown, twisted and bent by known amounts."""
    east, north = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-2, 2, 9)))
    local = np.column_stack([east, north])
    amount = np.arange(1.0, 11.0)
    # from one corner to the next, from the middle to the edges
    bent = amount[7] * east * north / 4 + amount[8] * east**2 + amount[9] * north**2 / 4
    moves = np.stack(
        [
            amount[0] - amount[5] * north + amount[6] * east,
            amount[1] + amount[5] * east + amount[6] * north,
            amount[2] + amount[3] * east + amount[4] * north + bent - bent.mean(),
        ],
        axis=1,
    )
    found = np.einsum("mnx,nx->m", motions_of_moves(np.column_stack([local, np.zeros(45)])), moves)
    np.testing.assert_allclose(found, amount, rtol=1e-6)
    assert MOTIONS[:7] == ("east", "north", "up", "tilt east", "tilt north", "turn", "scale")
    assert MOTIONS[7:] == ("twist", "bend east", "bend north")


def test_heights_of_a_narrow_scene_are_not_said_to_bend_where_it_is_not() -> None:
    """What bends is counted over the scene, not up to a distance that it does not have."""
    east, north = np.random.default_rng(1).uniform(-1, 1, (2, 400)) * [[0.01], [1.0]]
    up = np.random.default_rng(2).normal(0, 1.0, 400)
    moves = np.column_stack([np.zeros((400, 2)), up])
    found = np.einsum("mnx,nx->m", motions_of_moves(np.column_stack([east, north, up])), moves)
    assert np.abs(found[7:]).max() < 1.0
    line = motions_of_moves(np.column_stack([np.zeros(400), north, up]))
    assert np.isfinite(line).all()


def test_heights_without_a_terrain_may_be_wrong_together_by_the_range_of_their_altitudes() -> None:
    points = placed(np.linspace(0, 2000, 6), 0.0, 350.0)
    held = held_by(heights(dem=None), points)
    np.testing.assert_allclose(held.common[:, 0, 0], 2.0)  # each by half of it
    views: Any = (flown(),)
    np.testing.assert_array_equal(prior_sigmas(views, AdjustOptions(model="affine"), 0, None, 0), np.full((1, 6), 20.0))


def test_each_axis_of_a_reference_shares_its_own_error_over_its_own_sigma() -> None:
    lonlatalt = np.column_stack([5.0 + 1e-3 * np.arange(4), np.full(4, 43.0), np.full(4, 100.0)])
    sigma = np.tile([0.5, 2.0, 4.0], (4, 1))
    none = np.zeros(0, dtype=np.int64)
    points = GroundPoints(tuple("abcd"), lonlatalt, sigma, none, none, np.zeros((0, 2)), np.zeros(0))
    held = reference_control(Reference(points, np.array([3.0, 5.0, 8.0]), np.zeros((1, 2))), np.arange(4))
    np.testing.assert_allclose(held.common[:, 0, 3], 3.0 / 0.5)
    np.testing.assert_allclose(held.common[:, 1, 4], 5.0 / 2.0)
    np.testing.assert_allclose(held.common[:, 2, 0], 8.0 / 4.0)
    np.testing.assert_allclose(held.common[:, 2, 5], 1.0)
    assert not held.common[:, 0, 4].any()
    assert not held.common[:, 1, 3].any()
