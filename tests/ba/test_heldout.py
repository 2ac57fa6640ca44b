"""Tracks that are kept out: drawn as if at random, always the same; what they, and known points, say of the cameras."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.special import gammaln

from barpc.ba import AdjustOptions
from barpc.ba.constraints.block import Block, join, make_problem
from barpc.ba.robust.heldout import (
    HeldOut,
    check_residuals,
    is_better,
    keep_out,
    measure,
    noise_ratios,
    split_points,
    splitmix64,
)
from barpc.ba.solving.problem import Problem
from barpc.base.errors import InputError
from barpc.base.geodesy import ecef_from_ground, enu_basis, ground_from_ecef
from barpc.scene import GroundPoints
from barpc.sensor.corrected import Corrected
from barpc.simulate import simulate_block
from tests.ba.conftest import centers_of
from tests.constants import chosen
from tests.distributions import gamma

OPTIONS = AdjustOptions(drift=0)


@pytest.fixture(scope="module")
def made():
    return simulate_block(4, 1500, seed=9, num_gcps=3)


def block_of(made, gcps=None, keep=None) -> Block:
    tracks = made.tracks if keep is None else made.tracks.select(keep)
    with chosen(AdjustOptions, min_observations=1):
        return join(made.views, tracks, gcps, OPTIONS)


def test_numbers_are_scrambled_as_splitmix_does_it() -> None:
    """The first outputs of SplitMix64 from the seed 0 (Vigna's reference code)."""
    odd = np.uint64(0x9E3779B97F4A7C15)
    with np.errstate(over="ignore"):
        found = splitmix64(np.arange(1, 4, dtype=np.uint64) * odd)
    assert [hex(int(x)) for x in found] == ["0xe220a8397b1dcdaf", "0x6e789e6aa1b965f4", "0x6c45d188009454f"]


def test_who_is_kept_out_is_told_by_quarters_of_a_pixel_and_stays_the_same(made) -> None:
    """In whole numbers of Python: 2^64 over the golden ratio times the column, and the row, scrambled and summed."""
    block, most = block_of(made), 2**64

    def scrambled(x: int) -> int:
        x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9 % most
        x = (x ^ (x >> 27)) * 0x94D049BB133111EB % most
        return x ^ (x >> 31)

    drawn = np.zeros(block.num_points, dtype=object)
    for point, (col, row) in zip(block.point, np.rint(4 * block.xy.T).astype(int).tolist(), strict=True):
        drawn[point] = (drawn[point] + scrambled((col * 0x9E3779B97F4A7C15 + row) % most)) % most
    out = np.array([scrambled(int(number)) < 0.1 * most for number in drawn])
    out &= np.bincount(block.point, minlength=len(out)) >= 2
    assert out.any()
    np.testing.assert_array_equal(keep_out(block), out[block.point])


def test_about_a_tenth_is_kept_out_everywhere_in_the_image(made) -> None:
    block = block_of(made)
    out = keep_out(block)
    assert out.mean() == pytest.approx(0.1, abs=0.025)
    for axis in (0, 1):
        half = block.xy[axis] > np.median(block.xy[axis])
        assert abs(out[half].mean() - out[~half].mean()) < 0.04
    assert len(np.unique(block.point[out])) * 1.0 == len(set(block.point[out]) - set(block.point[~out]))


def test_what_rounding_does_to_positions_draws_hardly_another_track(made) -> None:
    block = block_of(made)
    rng = np.random.default_rng(0)
    out = keep_out(block)
    near, far = (keep_out(replace(block, xy=block.xy + rng.normal(0, size, block.xy.shape))) for size in (1e-9, 1.0))
    assert (near == out).all()
    assert (far != out).mean() > 0.1


def test_what_a_small_view_needs_and_what_holds_the_place_is_never_drawn(made) -> None:
    mine = np.flatnonzero(made.tracks.view == 2)
    for count, needed in ((99, True), (100, False)):
        keep = np.ones(len(made.tracks), dtype=bool)
        keep[mine[count:]] = False
        block = block_of(made, keep=keep)
        out = keep_out(block)
        left = np.bincount(block.view, minlength=4)[2]
        assert (left < 100) == needed
        assert out[block.view == 2].any() != needed
        assert out[block.view != 2].any()
    block = block_of(made, made.gcps)
    moved = (replace(block, xy=block.xy + step) for step in range(40))
    assert not any(keep_out(each)[block.point >= block.num_tracks].any() for each in moved)


def test_a_track_with_an_observation_that_is_not_used_is_never_drawn(made) -> None:
    block = block_of(made)
    out = keep_out(block)
    one = np.flatnonzero(out)[0]
    use = block.use.copy()
    use[one] = False
    again = keep_out(replace(block, use=use))
    assert not again[block.point == block.point[one]].any()
    assert (again == out)[block.point != block.point[one]].all()


@pytest.fixture(scope="module")
def flown(made) -> tuple[Block, Problem, np.ndarray]:
    """A block, its problem, and the cameras' unknowns (N, 6) by the truth."""
    block = block_of(made)
    problem = make_problem(block, OPTIONS, centers_of(made), None)
    each = zip(made.truth.corrections, problem.cameras.unknowns.distance, strict=True)
    return block, problem, np.array([np.r_[c.rotation * d, c.translation] for c, d in each])


def test_what_is_kept_out_is_measured_by_its_own_points(made, flown) -> None:
    """With the truth's cameras: white noise of 0.1 px a coordinate."""
    block, problem, exact = flown
    found = measure(problem, exact, block)
    assert found.noise.mean() == pytest.approx(1.0, abs=0.12)  # medians, of two views' tracks and of more
    assert (np.abs(found.noise - 1.0) < 0.3).all()
    np.testing.assert_allclose(found.error, np.sqrt((found.noise**2).mean()))
    np.testing.assert_allclose(found.whole_rms, np.sqrt((found.rms**2).mean()))
    true = np.sqrt((found.residual**2).sum(axis=0).mean())
    assert found.whole_rms == pytest.approx(true, rel=0.1)
    error = np.linalg.norm(found.points - ecef_from_ground(made.truth.ground), axis=1)
    assert np.median(error) < 1.0
    np.testing.assert_array_equal(found.index, np.arange(block.num_points))
    # one observation in ten 30 px off: the medians and two of three views stand
    rng = np.random.default_rng(1)
    wrong = rng.random(len(block.view)) < 0.05
    spoilt = measure(problem, exact, replace(block, xy=block.xy + 30.0 * wrong))
    assert (spoilt.noise < 1.6).all()
    three = (np.bincount(block.point)[block.point] >= 3) & (np.bincount(block.point, wrong)[block.point] == 1)
    assert np.median(np.abs(spoilt.residual[0, three & wrong])) == pytest.approx(30.0, abs=1.0)
    assert np.median(np.abs(spoilt.residual[0, three & ~wrong])) < 0.5


@pytest.mark.parametrize("off", [0.3, -0.6, 1.2])
def test_a_point_is_where_reweighted_rays_meet(made, flown, off: float) -> None:
    """Of a track of three views one off by some sigmas: three rounds by Geman and McClure's weights at four of them."""
    block, problem, params = flown
    point = int(np.flatnonzero(np.bincount(block.point) == 3)[0])
    rows = np.flatnonzero(block.point == point)
    xy = block.xy.copy()
    xy[:, rows[1]] += [off, -0.5 * off]
    found = measure(problem, params, replace(block, xy=xy))
    projected = problem.project_points(params, ecef_from_ground(made.truth.ground))
    matrix = projected.by_point[:, :, rows].transpose(2, 0, 1)  # (3, 2, 3)
    start, counted = (projected.image - xy)[:, rows].T, np.ones(3)
    for step in range(4):
        weight = np.sqrt(counted) / block.sigma[rows]
        rhs = (weight[:, None] * start).ravel()
        move = np.linalg.lstsq((weight[:, None, None] * matrix).reshape(6, 3), -rhs, rcond=None)[0]
        left = start + matrix @ move
        counted = 1.0 / (1.0 + (left**2).sum(axis=1) / (4.0 * block.sigma[rows]) ** 2) ** 2
        if step == 0:
            plain = left
    np.testing.assert_allclose(found.residual[:, rows].T, left, atol=2e-4)
    assert np.abs(left - plain).max() > 0.002


def test_a_view_of_fewer_than_twenty_says_nothing(made) -> None:
    tracks = made.tracks
    for count in (19, 20):
        keep = np.ones(len(tracks), dtype=bool)
        keep[np.flatnonzero(tracks.view == 1)[count:]] = False
        block = block_of(made, keep=keep)
        problem = make_problem(block, OPTIONS, centers_of(made), None)
        found = measure(problem, np.zeros((4, 6)), block)
        left = int((block.view == 1).sum())
        assert np.isnan(found.noise[1]) == (left < 20)
        assert np.isfinite(found.noise[[0, 2, 3]]).all()
        assert np.isfinite(found.error)
    assert np.isnan(HeldOut(np.zeros((2, 0)), np.zeros(0, int), np.zeros((0, 3)), *np.full((2, 4), np.nan)).error)


# --- which of two solutions is better -----------------------------------------------------------------------------


def held(residual: np.ndarray, noise: float) -> HeldOut:
    n = residual.shape[1]
    return HeldOut(residual, np.arange(n), np.zeros((n, 3)), np.full(2, noise), np.full(2, noise))


def compared(own: np.ndarray, other: np.ndarray, noise: tuple[float, float] = (0.9, 1.0)) -> bool:
    """Whether residuals (K,) along the columns [px] of half as many tracks, each seen twice, are better than others."""
    block: Any = SimpleNamespace(point=np.repeat(np.arange(len(own) // 2), 2), sigma=np.full(len(own), 0.1))
    one, two = (np.stack([given, 0 * given]) for given in (own, other))
    return is_better(held(one, noise[0]), held(two, noise[1]), block)


def test_better_is_what_is_clearly_better_in_the_same_tracks() -> None:
    other = np.random.default_rng(0).normal(0, 0.1, 400)
    assert compared(0.9 * other, other)
    assert not compared(other, other)
    assert not compared(1.1 * other, other)
    assert not compared(other[:0], other[:0])


@pytest.mark.parametrize(("share", "better"), [(0.985, True), (1.005, False)])
def test_a_smaller_error_is_asked_for(share, better) -> None:
    other = np.random.default_rng(0).normal(0, 0.1, 400)
    assert compared(0.5 * other, other, (share, 1.0)) == better


def costs(residual: np.ndarray, noise: float) -> np.ndarray:
    """Squares of every track by the other's error, of which 16 is the most."""
    square = (residual / (0.1 * noise)) ** 2
    return (square / (1 + square / 16)).reshape(-1, 2).sum(axis=1)


@pytest.mark.parametrize("noise", [1.0, 2.0])
@pytest.mark.parametrize(("deviations", "better"), [(2.9, False), (3.1, True)])
def test_squares_are_to_be_less_by_three_standard_deviations_of_chance(deviations, better, noise) -> None:
    rng = np.random.default_rng(0)
    other, change = rng.normal(0, 0.2, (2, 400))
    low, high = 0.0, 0.5  # how much of the other's is taken away, against a change of any sign
    for _ in range(60):
        share = 0.5 * (low + high)
        own = (1 - share) * other + 0.2 * change
        less = costs(other, noise) - costs(own, noise)
        sure = less.mean() / (less.std() / np.sqrt(200))
        low, high = (share, high) if sure < deviations else (low, share)
    assert sure == pytest.approx(deviations, abs=1e-6)
    assert compared(own, other, (0.9, noise)) == better


@pytest.mark.few(3)
@pytest.mark.parametrize("wrong", [0.0, 0.1, 0.3, 0.5])
@pytest.mark.parametrize("freedom", [1.0, 2.0])
def test_wrong_matches_do_not_change_how_right_ones_scatter(freedom: float, wrong: float) -> None:
    """Residuals of two views lie along a line, of many in the plane; wrong ones anywhere up to 200 deviations."""
    rng = np.random.default_rng(8)
    found = []
    for _ in range(40):
        squared = 9.0 * rng.chisquare(freedom, 400) / freedom  # three times as large as stated
        far = rng.uniform(size=400) < wrong
        squared[far] = (200.0 * rng.uniform(size=far.sum()) ** (1.0 / freedom)) ** 2
        found += noise_ratios(squared, np.full(400, freedom), np.zeros(400, dtype=int)).tolist()
    assert np.mean(found) == pytest.approx(3.0, rel=0.05)
    assert np.std(found) < 0.3


def test_errors_that_half_of_the_ties_share_are_no_wrong_matches() -> None:
    rng = np.random.default_rng(9)
    squared = (rng.normal(size=400) + np.repeat([0.0, 2.5], 200)) ** 2
    none, view = np.zeros(20), np.repeat([0, 1], [400, 20])
    of_ties, of_nothing = noise_ratios(np.append(squared, none), np.ones(420), view)  # views do not tell of each other
    assert of_ties > 1.6
    assert of_nothing < 1e-5
    assert of_ties == noise_ratios(squared, np.ones(400), view[:400])[0]


def test_the_scatter_is_where_expectation_and_maximisation_end() -> None:
    """Step by step for one view after the other: a chi-square of right ones, wrong ones uniform up to the farthest."""
    rng = np.random.default_rng(4)
    counts, free = [30, 41, 25], [1.0, 2.0, 0.5]
    view, freedom = np.repeat([0, 1, 2], counts), np.repeat(free, counts)
    squared = rng.chisquare(np.maximum(freedom, 1.0)) * 2.5
    squared[rng.random(len(view)) < 0.3] *= 90.0
    expected = []
    for v, n in enumerate(counts):
        rows, half = np.sort(squared[view == v]), 0.5 * max(free[v], 1.0)
        variance, wrong = np.quantile(rows, 0.2) / 0.2, 0.1
        for _ in range(100):
            far = rows.max()
            density = gamma.logpdf(
                rows, half, scale=variance / half
            )  # of |r|^2, whose uniform one is flat in |r|^2 half
            flat = np.log(half) + (half - 1.0) * np.log(rows) - half * np.log(far)
            peak = half * np.log(half * far / variance) - gammaln(half + 1.0)
            odds = (1.0 - wrong) / wrong * np.exp(density - flat) * np.exp(max(peak, 4.5) - peak)
            right = odds / (1.0 + odds)
            last, variance = variance, (right * rows).sum() / right.sum()
            wrong = (1.0 + (1.0 - right).sum()) / (10.0 + n)
            if abs(variance - last) < 1e-3 * last:
                break
        expected.append(np.sqrt(variance))
    order = np.lexsort((rng.random(len(view)), view))
    np.testing.assert_allclose(noise_ratios(squared[order], freedom[order], view[order]), expected, rtol=1e-9)


def test_the_scatter_is_a_ratio_whatever_deviation_is_stated(made, flown) -> None:
    """Residuals and stated deviations twenty times as large scatter as much: degrees of freedom have no unit."""
    block, problem, exact = flown
    true = np.full((2, len(block.view)), np.nan)
    for v, (view, correction) in enumerate(zip(made.views, made.truth.corrections, strict=True)):
        rows = block.view == v
        true[:, rows] = Corrected(view.sensor, correction).project(made.truth.ground[block.point[rows]]).T
    found = [
        measure(problem, exact, replace(block, xy=true + times * (block.xy - true), sigma=times * block.sigma))
        for times in (1.0, 20.0)
    ]
    np.testing.assert_allclose(found[1].noise, found[0].noise, rtol=1e-3)
    np.testing.assert_allclose(found[1].rms, 20.0 * found[0].rms, rtol=1e-3)


# --- points that are known --------------------------------------------------------------------------------------------

MOVE = np.array([3.0, -2.0, 5.0])  # east, north, up [m]


@pytest.fixture(scope="module")
def case():
    """Exact cameras, exact image points of five points; the given places lie by `MOVE` beside the true ones."""
    block = simulate_block(3, 10, seed=1)
    sensors = [Corrected(v.sensor, c) for v, c in zip(block.views, block.truth.corrections, strict=True)]
    true = block.truth.check_ground[:5]
    given = [ground_from_ecef(ecef_from_ground(g) - enu_basis(g).T @ MOVE) for g in true]
    point = np.array([0, 0, 0, 1, 1, 2, 4, 4])  # the third seen once, the fourth never
    view = np.array([0, 1, 2, 2, 0, 1, 1, 2])
    xy = np.array([sensors[v].project(true[p]) for v, p in zip(view, point, strict=True)])
    order = np.array([3, 0, 7, 5, 1, 6, 2, 4])
    names = tuple("abcde")
    points = GroundPoints(names, given, np.ones((5, 3)), point[order], view[order], xy[order], np.full(8, 0.1))
    return sensors, points


def test_points_seen_twice_or_more_have_their_offset_and_others_none(case) -> None:
    sensors, points = case
    found = check_residuals(sensors, points)
    np.testing.assert_allclose(found.ground[[0, 1, 4]], np.tile(MOVE, (3, 1)), atol=1e-3)
    assert np.isnan(found.ground[[2, 3]]).all()
    for k in range(8):
        expected = sensors[points.view[k]].project(points.lonlatalt[points.point[k]]) - points.xy[k]
        np.testing.assert_allclose(found.image[k], expected, atol=1e-9)
    image, ground = found.rms()
    np.testing.assert_allclose(ground, np.abs(MOVE), atol=1e-3)
    np.testing.assert_allclose(image, np.sqrt((found.image**2).mean(axis=0)))
    alone = check_residuals(sensors, points.select(np.arange(5) == 2))
    assert np.isnan(alone.rms()[1]).all()


def test_points_are_divided_by_name_with_their_observations(case) -> None:
    _, points = case
    control, check = split_points(points, ["b", "e"])
    assert (control.names, check.names) == (("a", "c", "d"), ("b", "e"))
    for part in (control, check):
        for k in range(len(part.view)):
            name = part.names[part.point[k]]
            row = (points.view == part.view[k]) & (np.array(points.names)[points.point] == name)
            np.testing.assert_array_equal(part.xy[k], points.xy[row][0])
        for name, place in zip(part.names, part.lonlatalt, strict=True):
            np.testing.assert_array_equal(place, points.lonlatalt[points.names.index(name)])
    assert len(control.view) == 4
    assert len(check.view) == 4
    with pytest.raises(InputError, match="named x, y"):
        split_points(points, ["b", "y", "x"])
