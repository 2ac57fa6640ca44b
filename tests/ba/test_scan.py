"""Scans for rows and columns that stand out: found where they are, never by chance, never below the floor."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.ba.evidence import scan as scanning
from barpc.ba.evidence.scan import BINS, neighbours_alike, price
from barpc.base.statistics import SURE
from tests.lanes import rest_slow

SIZE = np.array([[8000.0, 4000.0], [12000.0, 6000.0]])  # of two images, columns and rows


def ties(seed: int, wrong: float = 0.05) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    view = np.repeat([0, 1], [1500, 1000])
    place = rng.uniform(0.0, 1.0, (2, len(view))) * SIZE[:, view]
    return view, place, (rng.uniform(size=len(view)) < wrong).astype(float), rng.normal(size=(2, len(view)))


def scan(view, place, size, wrong, off, floor=0.0):
    return scanning.scan(view, place, size, wrong, off, 1.0 - wrong, floor, -np.inf)


def test_the_price_is_that_of_one_of_all_runs_of_bins_of_both_axes_of_all_views() -> None:
    runs = [(first, last) for first in range(BINS) for last in range(first, BINS)]
    assert np.exp(price(3)) == pytest.approx(len(runs) * 2 * 3)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_stretch_with_more_wrong_ties_is_found_where_it_is(axis: int) -> None:
    view, place, wrong, off = ties(1)
    inside = (view == 1) & (place[axis] > 0.5 * SIZE[axis, 1]) & (place[axis] < 0.6 * SIZE[axis, 1])
    found = scan(view, place, SIZE, np.where(inside, 0.6, wrong), np.where(wrong > 0.5, 0.0, off))[0]
    assert (found.view, found.axis, found.by_share) == (1, axis, True)
    assert (found.start, found.stop) == pytest.approx((0.5 * SIZE[axis, 1], 0.6 * SIZE[axis, 1]))
    assert found.share == pytest.approx(0.6)
    assert found.gain > 5.0 * SURE
    assert not found.moves
    assert found.apart == 0.0  # not measured yet


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, -1.0), (0.7, 0.7)])
def test_a_stretch_that_is_off_is_found_by_what_it_shares(direction: tuple[float, float]) -> None:
    view, place, wrong, off = ties(2, wrong=0.0)
    inside = (view == 0) & (place[1] < 0.25 * SIZE[1, 0])
    found = scan(view, place, SIZE, wrong, off + inside * np.array(direction)[:, None])[0]
    assert (found.view, found.axis, found.by_share) == (0, 1, False)
    # of two parts that lie apart either may be meant: the smaller one is named
    assert (found.start, found.stop) == pytest.approx((0.0, 0.25 * SIZE[1, 0]))
    assert found.off == pytest.approx(1.0, abs=0.2)  # 0.1 in each coordinate


def test_of_two_parts_the_smaller_one_lies_off_at_either_end() -> None:
    """What all share is taken up by the camera: the larger part seems to lie where it should."""
    view, place, wrong, off = ties(2, wrong=0.0)
    for first, inside in ((0.0, place[1] < 0.1 * SIZE[1, 0]), (0.9, place[1] > 0.9 * SIZE[1, 0])):
        larger = ((view == 0) & ~inside).astype(float)
        inside &= view == 0
        for moved in (np.where(view == 0, inside - inside[view == 0].mean(), 0.0), -larger):
            found = scan(view, place, SIZE, wrong, off + 2.0 * moved)[0]
            ends = np.array([first, first + 0.1]) * SIZE[1, 0]
            assert (found.view, found.axis, found.start, found.stop) == pytest.approx((0, 1, *ends))
            assert found.off == pytest.approx(2.0 * np.sqrt(2.0), abs=0.2)  # along both


@pytest.mark.slow
def test_chance_and_outliers_that_lie_anywhere_stand_out_nowhere() -> None:
    """An image alike all over gains 5 nats once in 150 scans, at most: the price is what the choice costs."""
    gains = []
    for seed in range(80):
        for share in (0.0, 0.1, 0.4):
            view, place, wrong, off = ties(seed, share)
            gains.append(scan(view, place, SIZE, wrong, off * (1.0 - wrong))[0].gain)
    assert np.mean(np.array(gains) > SURE) <= 0.0125
    assert max(gains) < SURE + 3.0
    assert np.median(gains) > -price(2)


def test_what_lies_below_the_floor_is_let_be() -> None:
    view, place, wrong, off = ties(3, wrong=0.0)
    off = off + (place[1] < 0.3 * SIZE[1, view]) * 0.4
    assert scan(view, place, SIZE, wrong, off)[0].gain > SURE
    assert scan(view, place, SIZE, wrong, off, floor=0.4)[0].gain < SURE
    assert scanning.scan(view, place, SIZE, wrong, off, 1.0 - wrong, 0.4) == []  # only what is sure is given


@pytest.mark.parametrize("at", [0.3, 0.5, 0.62])
def test_a_step_beside_what_the_camera_follows_is_found_where_it_is(at: float) -> None:
    """Least squares by the camera leaves a saw's tooth, of which the middle stands out; beside them it is the step."""
    view, place, wrong, off = ties(6, wrong=0.1)
    u = place[1] / SIZE[1, view]
    step = (view == 0) & (u > at)
    smooth = np.vander(u[view == 0], 3)
    moved = 2.0 * step.astype(float)
    moved[view == 0] -= smooth @ np.linalg.lstsq(smooth, moved[view == 0], rcond=None)[0]
    seen = off + moved
    told = np.ones(len(view))
    wrong = np.where(np.hypot(*seen) > 3.0, 1.0, wrong)  # what is cut is seen all the same
    found = next(one for one in scanning.scan(view, place, SIZE, wrong, seen, told) if not one.by_share)
    ends = (0.0, at * SIZE[1, 0]) if at <= 0.5 else (at * SIZE[1, 0], SIZE[1, 0])
    assert (found.view, found.axis) == (0, 1)
    assert (found.start, found.stop) == pytest.approx(ends, abs=1.5 * SIZE[1, 0] / BINS)
    assert found.off == pytest.approx(2.0 * np.sqrt(2.0), rel=0.15)
    bend = (view == 0) * (3.0 - 5.0 * u + 4.0 * u**2)
    again = next(one for one in scanning.scan(view, place, SIZE, wrong, seen + bend, told) if not one.by_share)
    assert np.abs(np.array([again.start, again.stop]) - at * SIZE[1, 0]).min() < 1.5 * SIZE[1, 0] / BINS


def test_the_share_s_likelihood_is_that_of_two_binomials() -> None:
    rng = np.random.default_rng(4)
    view = np.zeros(40, dtype=np.int64)
    place = np.tile((np.arange(40) + 0.5) * 8000.0 / BINS, (2, 1))  # one in each bin
    wrong = (rng.uniform(size=40) < np.where(np.arange(40) < 12, 0.8, 0.1)).astype(float)

    def log(k: float, n: float) -> float:
        return sum(x * np.log(x / n) for x in (k, n - k) if x > 0)

    best = max(
        log(wrong[a:b].sum(), b - a) + log(wrong.sum() - wrong[a:b].sum(), 40 - b + a) - log(wrong.sum(), 40)
        for a in range(40)
        for b in range(a + 1, 41)
        if b - a < 40 and wrong[a:b].mean() > wrong.mean()
    )
    found = scan(view, place, np.full((2, 1), 8000.0), wrong, np.zeros((2, 40)))[0]
    assert found.gain + price(1) == pytest.approx(best)


@pytest.mark.parametrize(("total", "bad", "told"), [(40.0, 1.0, False), (180.0, 1.0, True), (40.0, 2.0, True)])
def test_where_so_few_are_wrong_their_place_tells_nothing(total: float, bad: float, told: bool) -> None:
    """All of them in one observation's interval: the rest would be certain, whatever is wrong."""
    bins = np.zeros((2, 1, scanning.BINS))
    bins[:, 0, 0], bins[0, 0, 1] = bad, total - bad
    gain = scanning.share_log_ratios(bins)
    whole = bad * np.log(bad / total) + (total - bad) * np.log(1.0 - bad / total)
    assert gain[0, 0] == pytest.approx(-whole if told else 0.0)
    assert (whole < -SURE) == told
    assert gain[1, 0] == 0.0  # a share that is smaller inside is no place


def test_one_residual_that_is_far_off_is_one_residual() -> None:
    view, place, wrong, off = ties(5, wrong=0.0)
    off[:, 7] = 1e6
    assert scan(view, place, SIZE, wrong, off)[0].gain < SURE + 0.5 * 8.0**2 * 2
    assert np.isfinite([one.gain for one in scan(view, place, SIZE, wrong, off)]).all()


@pytest.mark.parametrize("counts", rest_slow([(2, 20), (2, 20, 200, 2000)]), ids=str)
def test_wrong_matches_lie_in_any_direction(counts: tuple[int, ...]) -> None:
    """In none of 100 images of each of two shapes is a direction common, however few or many are wrong."""
    rng = np.random.default_rng(4)
    for count in counts:
        view, place = np.repeat([0, 1], [count, count]), rng.uniform(0.0, 9000.0, (2, 2 * count))
        for _ in range(50):
            off = rng.uniform(-30.0, 30.0, (2, 2 * count))
            assert (neighbours_alike(view, place, off, 2) <= SURE).all()
            along = np.outer((0.6, -0.8), off[0])  # of two views they lie along one line
            assert (neighbours_alike(view, place, along, 2) <= SURE).all()
            biased = np.stack([off[0], 0.1 + 0.002 * off[1]])  # a trace of the other direction, all the same way
            assert (neighbours_alike(view, place, biased, 2) <= SURE).all()
            curved = np.stack([off[0], off[0] ** 2 / 90.0])  # far along a ray relief bends the other, all the same way
            assert (neighbours_alike(view, place, curved, 2) <= SURE).all()
            bent = off[:, view == 0] - 15.0 * np.sign(off[:, view == 0])
            assert np.isneginf(neighbours_alike(view[view == 0], place[:, view == 0], bent, 2)[1])


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("component", [0, 1])
def test_what_shakes_or_moves_goes_the_same_way_as_its_neighbours(axis: int, component: int) -> None:
    rng = np.random.default_rng(5)
    view, place = np.repeat([0, 1], [300, 300]), rng.uniform(0.0, 9000.0, (2, 600))
    off = rng.uniform(-30.0, 30.0, (2, 600))
    swing = 3.0 * np.sin(2.0 * np.pi * place[axis] / 700.0) + rng.normal(0.0, 0.3, 600)
    off[component] = np.where(view == 1, swing, off[component])
    first, second = neighbours_alike(view, place, off, 2)
    assert first <= SURE
    assert 20.0 < second < 300 * np.log(2.0)


@pytest.mark.parametrize("axis", [0, 1])
def test_the_gain_of_a_displacement_is_that_of_least_squares(axis: int) -> None:
    """With a parabola beside it, of bins each: half the squares that it takes away, over what scatters there."""
    rng = np.random.default_rng(7)
    view, place, wrong, off = ties(7, wrong=0.0)
    told = rng.uniform(0.2, 1.0, len(view))
    inside = (view == 0) & (place[axis] >= 0.4 * SIZE[axis, 0]) & (place[axis] < 0.6 * SIZE[axis, 0])
    off = (off + inside * np.array([[2.0], [1.0]])).clip(-5.0, 5.0)
    found = [one for one in scanning.scan(view, place, SIZE, wrong, off, told, 0.3) if not one.by_share]
    one = next(one for one in found if (one.view, one.axis) == (0, axis))
    assert (one.start, one.stop) == pytest.approx((0.4 * SIZE[axis, 0], 0.6 * SIZE[axis, 0]))
    rows = view == 0
    u = np.floor(place[axis, rows] / SIZE[axis, 0] * BINS) / (BINS - 1) * 2.0 - 1.0
    smooth, weight, step = np.vander(u, 3), told[rows], inside[rows].astype(float)
    root = np.sqrt(weight)[:, None]
    followed = np.linalg.lstsq(root * smooth, root * np.column_stack([off[:, rows].T, step]), rcond=None)[0]
    left, own = off[:, rows].T - smooth @ followed[:, :2], step - smooth @ followed[:, 2]
    known = weight @ own**2
    score = (weight * own) @ left
    scatter = (left * weight[:, None]).T @ left / (weight.sum() + 1.0)
    size, axes = np.linalg.eigh(scatter)
    gain = 0.5 * ((score @ axes) ** 2 / known / (np.maximum(size, 1.0) + known * 0.3**2)).sum()
    assert one.gain + price(2) == pytest.approx(gain, rel=1e-6)
    assert one.off == pytest.approx(np.hypot(*score) / known, rel=1e-6)


def test_evidence_of_neighbours_is_the_entropy_of_their_signs() -> None:
    """Of one line of residuals: 30 in the order of rows, whose sign changes six times."""
    off = np.zeros((2, 31))
    off[0] = np.repeat([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0], [5, 5, 5, 5, 5, 5, 1]) * 3.0
    place = np.stack([np.zeros(31), np.arange(31.0)])
    order = np.random.default_rng(0).permutation(31)
    share = 24 / 30
    expected = 30 * (np.log(2) + share * np.log(share) + (1 - share) * np.log(1 - share)) - np.log(4 * 3)
    found = neighbours_alike(np.full(31, 1), place[:, order], off[:, order], 3)
    rows_in_order = (off[0][order][1:] * off[0][order][:-1] > 0).mean()
    assert rows_in_order < share
    assert found[1] == pytest.approx(expected)
    assert np.isneginf(found[[0, 2]]).all()
    single = neighbours_alike(np.array([0]), place[:, :1], off[:, :1], 1)
    assert np.isneginf(single).all()
    assert np.isfinite(neighbours_alike(np.zeros(2, int), place[:, :2], off[:, :2], 1)).all()
