"""What is believed of a DEM: of terrains made of waves, DEMs with errors of their own, and points at known places."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks
from barpc.ba.constraints.block import first_state, join, make_problem
from barpc.ba.constraints.ground import PointConstraints
from barpc.ba.constraints.terrain import (
    NUM_BENDS,
    Bands,
    RegularisedDem,
    Relief,
    believe,
    quadratic_basis,
    variance_inflation,
    without_outliers,
)
from barpc.base.geodesy import ecef_from_ground, enu_basis, ground_from_ecef
from barpc.rasters.dem import Dem
from barpc.simulate import simulate_block
from benchmarks.worlds import judge
from benchmarks.worlds_families import make
from tests.ba.conftest import centers_of
from tests.lanes import rest_slow

LON, LAT, ALT = 5.0, 43.0, 300.0
UNIT = np.array([81460.0, 111090.0])  # m a degree, about
SIDE = 10000.0
Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]


def waves(seed: int, size: float, shortest: float, longest: float) -> Surface:
    """A surface of 24 waves, `size` m RMS, by lon and lat."""
    rng = np.random.default_rng(seed)
    length = np.exp(rng.uniform(np.log(shortest), np.log(longest), 24))
    angle, phase = rng.uniform(0, 2 * np.pi, (2, 24))
    number = 2 * np.pi / length

    def at(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
        x, y = (np.asarray(lon) - LON) * UNIT[0], (np.asarray(lat) - LAT) * UNIT[1]
        found = np.zeros(x.shape)
        for k in range(24):
            found += np.sin(number[k] * (np.cos(angle[k]) * x + np.sin(angle[k]) * y) + phase[k])
        return size * found / np.sqrt(12.0)

    return at


HILLS = waves(1, 40.0, 700.0, 4000.0)
SINGLE = waves(2, 5.0, 80.0, 160.0)
LONG = waves(3, 3.0, 1500.0, 4000.0)


def points(count: int = 900, east: float = 0.0, terrain: Surface = HILLS) -> np.ndarray:
    """Points of a terrain, put too far to the east by so many metres."""
    xy = np.random.default_rng(7).uniform(-SIDE / 2, SIDE / 2, (count, 2))
    lon, lat = LON + xy[:, 0] / UNIT[0], LAT + xy[:, 1] / UNIT[1]
    return np.column_stack([lon + east / UNIT[0], lat, ALT + terrain(lon, lat)])


def sum_of(*parts: Surface) -> Surface:
    return lambda lon, lat: ALT + sum(part(lon, lat) for part in parts)


def judged(dem: Surface, ground: np.ndarray, stated: float = 5.0, **given: Any) -> RegularisedDem | None:
    every = np.ones(len(ground), dtype=bool)
    relief = Relief.of(dem, ground, given.get("strong", every), np.full(len(ground), 0.3), stated)
    return believe(relief, np.arange(len(ground)), ground, stated)


def sure(found: RegularisedDem | None) -> RegularisedDem:
    assert found is not None
    return found


@pytest.mark.slow
def test_what_is_error_is_not_believed_and_what_is_terrain_is() -> None:
    """Errors that are short waves: their bands have no gain, those of the hills have all."""
    found = sure(judged(sum_of(HILLS, SINGLE), points()))
    assert found.gains[0] < 0.15
    assert (found.gains[1:] > 0.93).all()
    exact = sure(judged(sum_of(HILLS), points()))
    assert (exact.gains[-2:] > 0.99).all()
    # slopes: of the hills, and not of the errors, which are five times as steep
    step = 1.0 / UNIT
    ground = points()
    lon, lat = ground[:, 0], ground[:, 1]
    true = np.stack(
        [
            (HILLS(lon + step[0], lat) - HILLS(lon - step[0], lat)) / 2,
            (HILLS(lon, lat + step[1]) - HILLS(lon, lat - step[1])) / 2,
        ],
        axis=1,
    )
    for believed in (found, exact):
        assert np.sqrt(np.mean((believed.slopes - true) ** 2)) < 0.2 * np.sqrt(np.mean(true**2))


@pytest.mark.parametrize("east", rest_slow([-25.0, 25.0, 0.0]))
def test_points_are_asked_to_move_back_to_where_the_terrain_is(east: float) -> None:
    """Heights to hold to fall short along the slopes by as much as points lie too far to the east, and no more."""
    ground = points(east=east)
    found = sure(judged(sum_of(HILLS, SINGLE), ground))
    off = ground[:, 2] - found.alt
    design = np.column_stack([found.slopes, quadratic_basis((ground[:, :2] - [LON, LAT]) * UNIT / SIDE)])
    moved = np.linalg.lstsq(design, off, rcond=None)[0]
    assert moved[0] == pytest.approx(-east, abs=2.5)
    assert moved[1] == pytest.approx(0.0, abs=2.5)
    # what single heights differ by beside that is left to them
    assert np.std(off - design @ moved) < 0.5
    assert 0.7 < found.sigma < 1.6  # with a DEM whose errors, of 5 m, are not believed


def test_cameras_let_expect_what_their_unknowns_move_points_by() -> None:
    """Level and slopes of all points above a DEM, each unknown of each camera off by its own standard deviation."""
    made, options = simulate_block(3, 200, seed=1), AdjustOptions()
    block = join(made.views, made.tracks, None, options)
    problem = make_problem(block, options, centers_of(made), None)
    state, held = first_state(problem, block, options, lambda lon, lat: np.full(np.shape(lon), ALT))
    assert held.relief is not None
    mean, sigma, weight = problem.camera_prior.mean, problem.camera_prior.sigma, block.use / block.sigma
    up, squares = enu_basis(ground_from_ecef(state.points))[:, 2], np.zeros(3)
    for unknown in np.flatnonzero(problem.free):
        seen = []
        for sign in (1e-2, -1e-2):
            params, points = mean.copy(), state.points
            params.ravel()[unknown] += sign * sigma.ravel()[unknown]
            for _ in range(2):
                points = problem.triangulate(points, problem.project_points(params, points), weight)
            seen.append(points)
        squares += (held.relief.fit @ ((seen[0] - seen[1]) * up).sum(axis=1) / 2e-2) ** 2
    np.testing.assert_allclose(held.relief.cameras, np.sqrt(squares), rtol=1e-3)


@pytest.mark.slow
def test_errors_that_neighbours_share_make_heights_count_less() -> None:
    alone = sure(judged(sum_of(HILLS, SINGLE), points()))
    together = sure(judged(sum_of(HILLS, SINGLE, LONG), points()))
    assert 1.0 <= alone.alike < 1.7
    assert 1.9 < together.alike < 20.0
    assert together.effective_sigma == pytest.approx(together.sigma * together.alike**0.5)


@pytest.mark.slow
def test_a_dem_of_another_terrain_is_told_from_one_that_is_only_coarse() -> None:
    ground = points()
    flat = sure(judged(lambda lon, lat: np.full(len(lon), ALT), ground))
    assert (flat.shows, flat.relief) == (False, pytest.approx(0.0, abs=1e-6))
    feet = sure(judged(lambda lon, lat: sum_of(HILLS)(lon, lat) / 0.3048, ground))
    assert not feet.shows
    assert feet.relief == pytest.approx(1 / 0.3048, rel=1e-3)
    elsewhere = sure(judged(sum_of(waves(9, 40.0, 700.0, 4000.0)), ground))
    assert not elsewhere.shows
    for dem in (sum_of(HILLS, SINGLE, LONG), lambda lon, lat: sum_of(HILLS)(lon, lat) + 300.0):
        right = sure(judged(dem, ground))
        assert right.shows
        assert right.relief == pytest.approx(1.0, abs=0.05)
    plain = waves(1, 1.0, 700.0, 4000.0)  # of a metre: a DEM known to 5 m need not show it
    assert sure(judged(lambda lon, lat: np.full(len(lon), ALT), points(terrain=plain))).shows


def test_points_whose_errors_are_alike_are_worth_one_wherever_they_lie() -> None:
    """A thousand in eight groups along a line that are wrong alike: by cells a sixth of it long, and half of it."""
    rng = np.random.default_rng(2)
    group = np.repeat(np.arange(8), 125)
    along = (group + rng.uniform(0.2, 0.8, 1000)) / 8.0
    pull = rng.choice([-1.0, 1.0], 8)[group][:, None] * [1.0, 0.0] + rng.normal(size=(1000, 2)) * 0.1
    for at in (
        np.column_stack([along, 0.0 * along]),
        np.column_stack([along, along]),
        np.column_stack([0.2 * along, along]),
    ):
        found = [variance_inflation(1e4 * at + shift, pull) for shift in (0.0, [5e5, 0.0], [-3e4, 4e6])]
        assert found == pytest.approx([found[0]] * 3)
        assert 80.0 < found[0] < 250.0
    assert variance_inflation(np.column_stack([along, along]), rng.normal(size=(1000, 2))) < 3.0


def test_holes_and_what_fills_them_hold_nothing() -> None:
    def holed(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
        x = (lon - LON) * UNIT[0]
        height = np.where(x < -2000.0, np.nan, sum_of(HILLS, SINGLE)(lon, lat))
        return np.where(x > 3500.0, -9999.0, height)  # voids that nobody declared

    ground = points()
    found = sure(judged(holed, ground))
    x = (ground[:, 0] - LON) * UNIT[0]
    inside = (x > -1980.0) & (x < 3480.0)
    assert np.isnan(found.alt[(x < -2000.0) | (x > 3500.0)]).all()
    assert np.isfinite(found.alt[inside]).mean() > 0.98
    assert found.sigma < 7.0
    assert found.shows


def test_few_points_or_none_that_tell_believe_nothing() -> None:
    assert judged(sum_of(HILLS), points(59)) is None
    ground = points(100)
    assert judged(sum_of(HILLS), ground, strong=np.zeros(100, dtype=bool)) is None
    assert judged(lambda lon, lat: np.full(len(lon), np.nan), ground) is None


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_hills_that_are_seen_on_one_side_only_are_hills(side: float) -> None:
    """What all slopes have in common tells no less of the others: as seen from where the sun was, or the camera."""
    ground = points(3000)
    lon, lat, _ = ground.T
    rises = HILLS(lon + 5.0 / UNIT[0], lat) - HILLS(lon - 5.0 / UNIT[0], lat)
    seen = ground[side * rises > 0.0]
    assert 1000 < len(seen) < 2000
    np.testing.assert_allclose(sure(judged(sum_of(HILLS), seen)).gains[:3], 1.0, atol=0.1)
    np.testing.assert_allclose(sure(judged(sum_of(HILLS), ground)).gains[:3], 1.0, atol=0.1)


def test_what_contradicts_the_cameras_is_let_go_and_the_rest_is_not() -> None:
    ground = points(200)
    tilted = lambda lon, lat: sum_of(HILLS)(lon, lat) + 40.0 * (lon - LON) * UNIT[0] / (SIDE / 2)  # noqa: E731
    made = Relief.of(tilted, ground, np.ones(200, dtype=bool), np.full(200, 0.3), 0.0)
    assert made.delivered[1] == pytest.approx(-40.0 * 0.816, rel=0.05)  # at the RMS distance of a square's points
    assert np.abs(made.delivered[[0, 2]]).max() < 2.5
    assert np.isnan(made.beyond(2.0)).all()  # nothing is known of the cameras yet
    np.testing.assert_array_equal(made.common_sigma(2.0), np.full(NUM_BENDS, 2.0))
    object.__setattr__(made, "cameras", np.array([30.0, 0.5, 0.5]))
    sigma = made.common_sigma(2.0)
    assert sigma[1] == pytest.approx(-2.0 * made.delivered[1])
    np.testing.assert_array_equal(np.delete(sigma, 1), np.full(NUM_BENDS - 1, 2.0))
    np.testing.assert_array_equal(made.common_sigma(20.0), np.full(NUM_BENDS, 20.0))  # it may be as wrong as that


def test_a_dem_of_a_known_datum_is_wrong_together_by_less() -> None:
    class Level(Dem):
        def __call__(self, lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
            return np.full(len(lon), ALT)

    def bias(dem: Any, **options: Any) -> float:
        every = np.ones(9, dtype=bool)
        heights = PointConstraints((), every, np.arange(9), (0.0, 1.0), AdjustOptions(**options), dem)
        found = heights.test(ecef_from_ground(points(9)), every)
        assert found is not None
        return found.bias

    known, unknown = (Level(None, None, "", known) for known in (True, False))  # type: ignore[arg-type]
    assert (bias(known), bias(unknown), bias(lambda lon, lat: lon)) == (5.0, 20.0, 20.0)
    assert bias(known, dem_bias_sigma=0.7) == 0.7


def test_bends_are_a_level_two_slopes_and_what_is_curved() -> None:
    at = np.random.default_rng(0).uniform(-1, 1, (30, 2))
    found = quadratic_basis(at)
    assert found.shape == (30, NUM_BENDS)
    np.testing.assert_array_equal(found[:, 0], 1.0)
    np.testing.assert_array_equal(found[:, 1:3], at)
    assert np.linalg.matrix_rank(found) == NUM_BENDS


# --- whole blocks, flown by other cameras ---------------------------------------------------------------------------


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("hills", "seeds"),
    [(False, (4, 6, 20)), (False, range(0, 24, 2)), (True, range(1, 24, 2))],
    ids=["three plains", "plains", "hills"],
)
def test_a_dem_with_waves_places_a_scene_as_well_as_it_is_said_to(hills: bool, seeds: Sequence[int]) -> None:
    """Twelve draws; before, errors over what was said were 3.8 (plains) and 3.0 (hills), RMS, at worst 8.9."""
    over, off, delivered = [], [], []
    for seed in seeds:
        world = make("dem", seed)
        found = adjust_tracks(
            world.views, world.tracks, AdjustOptions(dem_sigma=5.0, dem_bias_sigma=2.0), dem=world.dem
        )
        move = np.array(judge(world, found.sensors).move)
        over.append(move / found.gauge.sigma)
        off.append(np.hypot(*move[:2]))
        delivered.append(np.hypot(*judge(world, [view.sensor for view in world.views]).move[:2]))
        assert found.terrain is not None
        assert found.terrain.shows
    rms = np.sqrt(np.mean(np.square(over), axis=0))
    assert (rms[:2] < 1.3).all()
    assert (rms[:2] > 0.4).all()
    assert rms[2] < 1.3
    assert np.sqrt(np.mean(np.square(off))) < (0.7 if hills else 0.85) * np.sqrt(np.mean(np.square(delivered)))


@pytest.mark.costs(4)
@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "kind"),
    [
        *((2, "tilt"), (7, "level"), (4, "shows")),
        *(pytest.param(*row, marks=pytest.mark.nightly) for row in ((10, "tilt"), (15, "level"), (5, "shows"))),
    ],
)
def test_a_wrong_dem_neither_bends_nor_moves_a_scene(seed: int, kind: str) -> None:
    world = make("wrong_dem", seed)
    options = AdjustOptions(dem_sigma=5.0, dem_bias_sigma=2.0)
    found = adjust_tracks(world.views, world.tracks, options, dem=world.dem)
    after = judge(world, found.sensors)
    assert found.terrain is not None
    beyond = np.array(found.terrain.beyond)
    assert found.terrain.shows == (kind != "shows")
    assert {"tilt": beyond[1] > 10, "level": beyond[0] > 7, "shows": found.terrain.held == 0}[kind]
    assert after.left < 0.05
    assert after.tilt < 1.3  # of what splines over the rows of a pair follow beside it, at most
    assert (np.abs(np.array(after.move) / found.gauge.sigma) < 3.0).all()


def test_heights_between_the_same_posts_are_no_independent_ones() -> None:
    """A DEM of wide posts has as many heights as posts under the points."""

    @dataclass
    class Posts:
        step: float

        def __call__(self, lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
            return sum_of(HILLS)(lon, lat)

        def posts(self, lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
            col, row = np.floor((np.stack([lon - LON, lat - LAT]) * UNIT[:, None] + SIDE / 2) / self.step)
            first = row * 1000.0 + col
            return np.stack([first, first + 1, first + 1000, first + 1001], axis=1)

    noisy = points(400)
    noisy[:, 2] += np.random.default_rng(0).normal(0.0, 1.0, 400)
    fine, coarse, coarsest = (sure(judged(Posts(SIDE / cells), noisy, 2.0)).alike for cells in (100, 5, 2))
    assert fine < 4.0  # some hundred posts
    assert coarse == pytest.approx(400 / 36, rel=0.15)
    assert coarsest == pytest.approx(400 / 9, rel=0.15)


@pytest.mark.slow
def test_a_small_block_is_held_by_the_terrain_and_points_by_their_rays() -> None:
    """Two views of hills, whose cameras say where they are to some metres; the DEM to half of one."""
    world = make("dem", 9)
    options = AdjustOptions(dem_sigma=5.0, dem_bias_sigma=2.0, jitter="off")
    found = adjust_tracks(world.views, world.tracks, options, dem=world.dem)
    assert found.terrain is not None
    assert found.terrain.held > 0.99 * found.terrain.known
    assert found.gauge.sigma[2] < 2.2
    assert 1.0 < found.gauge.sigma[0] < 4.0
    assert found.datum["heights"][0] > 0.5
    assert found.inlier[found.view >= 0].mean() > 0.8


@pytest.mark.parametrize(("side", "bands_of"), [(10000.0, 5), (2800.0, 4), (1000.0, 3)])
def test_bands_are_each_twice_as_wide_up_to_a_sixteenth_of_the_scene(side: float, bands_of: int) -> None:
    """From nodes of a three-hundredth of the scene and its margins on, or of 15 m."""
    xy = np.linspace(-0.5, 0.5, 201)[:, None] * [side / 0.98, 0.5 * side]
    ground = np.column_stack([LON + xy[:, 0] / UNIT[0], LAT + xy[:, 1] / UNIT[1], np.full(201, ALT)])
    assert len(Bands.of(HILLS, ground).smoothed) == bands_of


def test_a_slope_is_all_in_the_coarsest_band() -> None:
    """A plane, 40 m higher a kilometre east and 20 m lower a kilometre north: smoothed it is what it was."""
    rng = np.random.default_rng(4)
    ground = np.column_stack([5.4 + rng.uniform(-0.02, 0.02, 300), 43.3 + rng.uniform(-0.02, 0.02, 300), np.zeros(300)])

    def plane(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
        east, north = 111.32 * np.cos(np.radians(43.3)) * (lon - 5.4), 111.1 * (lat - 43.3)
        return 40.0 * east - 20.0 * north

    ground[:, 2] = plane(*ground[:, :2].T)
    heights, slopes = Bands.of(plane, ground).at(ground)
    np.testing.assert_allclose(heights.sum(axis=0), ground[:, 2], atol=1e-6)
    middle = np.abs(ground[:, :2] - [5.4, 43.3]).max(axis=1) < 0.01
    np.testing.assert_allclose(heights[-1, middle], ground[middle, 2], atol=5.0)
    assert np.abs(heights[:-1, middle]).max() < 2.0
    np.testing.assert_allclose(slopes.sum(axis=0)[middle], np.tile([0.04, -0.02], (middle.sum(), 1)), atol=2e-3)


def test_points_that_pull_alike_where_they_lie_together_count_as_one() -> None:
    """Four groups of nine: within each pulls are the same, or each has its own."""
    rng = np.random.default_rng(2)
    corners = np.array([[0.0, 0.0], [900.0, 0.0], [0.0, 900.0], [900.0, 900.0]])
    at = np.repeat(corners, 9, axis=0) + rng.uniform(0.0, 5.0, (36, 2))
    alike = np.repeat([[1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [-1.0, -1.0]], 9, axis=0)
    assert variance_inflation(at, alike) == pytest.approx(9.0, rel=0.1)
    apart = np.tile([[1.0, 0.0], [-1.0, 0.0]], (18, 1))
    assert 1.0 <= variance_inflation(at, apart) < 2.0
    assert variance_inflation(rng.uniform(0.0, 900.0, (1, 2)), np.ones((1, 2))) == 1.0
    far = np.array([[0.0, 0.0], [900.0, 900.0]])
    assert variance_inflation(far, np.array([[1.0, 1.0], [-1.0, -1.0]])) == pytest.approx(1.0)


def test_values_within_five_standard_deviations_of_the_median_are_the_middle_ones() -> None:
    """Of values whose median lies at 2 and whose median distance from it is 1: 1.4826 is a standard deviation."""
    values = 2.0 + np.array([-1.0, -1.0, 0.0, 1.0, 1.0, -7.4, 7.5, 1.0, -1.0])
    assert without_outliers(values).tolist() == [True] * 6 + [False] + [True] * 2


@pytest.mark.parametrize("part", [(0.0, 1.0), (0.0, 0.4), (0.6, 1.0)])
def test_bends_are_counted_from_the_middle_of_the_points_to_their_edges(part: tuple[float, float]) -> None:
    """Wherever the DEM begins and the points lie on it: what is said of bends is said of sizes at the scene's edges."""
    ground = points(2000)
    x = (ground[:, 0] - LON) * UNIT[0] / SIDE + 0.5
    ground = ground[(x >= part[0]) & (x <= part[1])]
    level, east, north = sure(judged(sum_of(HILLS), ground)).bends[:, :3].T
    at = (ground[:, :2] - ground[:, :2].mean(axis=0)) * UNIT
    half = np.abs(at).max()
    np.testing.assert_array_equal(level, 1.0)
    np.testing.assert_allclose(np.column_stack([east, north]), at / half, atol=0.02)
