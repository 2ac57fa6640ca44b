"""Periods of the rows: found with their period, never by chance, and nothing where rows wander."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.ba.evidence import periods
from barpc.ba.evidence.periods import find_periods, price_of_period
from barpc.base.statistics import SURE


def ties(seed: int, rows: float = 9000.0, views: int = 2) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    view = np.repeat(np.arange(views), 1500)
    row = rng.uniform(0.0, rows, len(view))
    return view, row, np.full((2, views), rows), rng.normal(size=(2, len(view)))


@pytest.mark.parametrize(("period", "rows"), [(60.0, 1000.0), (200.0, 9000.0), (600.0, 1000.0), (600.0, 30000.0)])
def test_a_swing_is_found_with_its_period_in_its_image(period: float, rows: float) -> None:
    view, row, size, off = ties(1, rows)
    phase = 2.0 * np.pi * row / period
    off += (view == 1) * 0.5 * np.stack([0.6 * np.sin(phase + 1.0), 0.8 * np.sin(phase + 1.0)])
    found = find_periods(view, row, size, np.ones(len(view)), off)
    assert found[0].view == 1
    # of a frequency the standard deviation is sqrt(6 / (n snr)) / pi waves of the image: 0.1 of one is three times that
    assert rows / found[0].period == pytest.approx(rows / period, abs=0.1)
    assert 0.2 * 1500 * 0.25 / 4.0 < found[0].gain < 1.5 * 1500 * 0.25 / 4.0
    assert all(one.gain < SURE for one in found[1:])


@pytest.mark.parametrize(("count", "told"), [(30, True), (29, False)])
def test_thirty_observations_that_swing_are_enough(count: int, told: bool) -> None:
    row = np.random.default_rng(3).uniform(0.0, 1000.0, count)
    off = 4.0 * np.sin(2.0 * np.pi * row / 200.0 + np.array([[0.5], [0.5]]))
    found = find_periods(np.zeros(count, dtype=int), row, np.full((2, 1), 1000.0), np.ones(count), off)
    assert [one.period for one in found] == ([pytest.approx(200.0, rel=0.02)] if told else [])


def test_chance_swings_nowhere() -> None:
    """Noise gains 5 nats once in 150 blocks: the level is what the number of frequencies asks for."""
    gains = []
    for seed in range(60):
        view, row, size, off = ties(seed, 3000.0)
        off[1] = 0.3 * off[0] if seed % 2 else off[1]  # of a pair: one direction alone is seen
        found = find_periods(view, row, size, np.ones(len(view)), off, 0.0)
        gains.append(found[0].gain if found else 0.0)
    assert np.mean(np.array(gains) > SURE) < 0.04
    assert np.mean(np.array(gains) > 0.0) > 0.1  # and is not far too high


def test_wrong_observations_have_no_say_and_few_rows_none() -> None:
    view, row, size, off = ties(2)
    wrong = np.random.default_rng(5).uniform(size=len(view)) < 0.3
    swung = np.where(wrong, 50.0 * np.sin(2.0 * np.pi * row / 150.0), 0.0) + off * ~wrong
    assert not any(one.gain > SURE for one in find_periods(view, row, size, 1.0 - wrong, swung * ~wrong))
    assert not find_periods(view, row / 100.0, size / 100.0, np.ones(len(view)), off)


@pytest.mark.parametrize("seed", range(4))
def test_rows_that_wander_gain_far_less_as_a_swing_than_they_are_off(seed: int) -> None:
    """A random walk has its largest wave at some frequency: those beside it are nearly as large."""
    view, row, size, off = ties(seed)
    walk = np.cumsum(np.random.default_rng(seed + 50).normal(size=300))
    off[0] += (view == 1) * 0.5 * np.interp(row, np.linspace(0.0, 9000.0, 300), (walk - walk.mean()) / walk.std())
    found = find_periods(view, row, size, np.ones(len(view)), off)
    explained = 0.5 * 1500 * 0.25
    assert not found or found[0].gain < 0.4 * explained


# --- piece by piece -------------------------------------------------------------------------------------------------


def test_a_period_costs_the_choice_among_four_a_shortest_wave_and_all_views() -> None:
    assert price_of_period(3200.0, 3) == pytest.approx(np.log(400 * 3))
    assert price_of_period(5.0, 3) == pytest.approx(np.log(3))


def test_the_vertex_is_that_of_the_parabola() -> None:
    at = np.arange(7.0)
    for vertex in (2.7, 3.0, 3.4):
        gain = 5.0 - 2.0 * (at - vertex) ** 2
        assert 3 + periods.parabola_vertex(gain, 3) == pytest.approx(vertex)
    assert periods.parabola_vertex(5.0 - (at - 9.0) ** 2, 3) == 0.5  # no farther than half a step
    assert periods.parabola_vertex(-gain, 3) == 0.0
    assert periods.parabola_vertex(gain, 0) == periods.parabola_vertex(gain, 6) == 0.0


def test_the_spectrum_is_half_of_what_least_squares_take_away() -> None:
    """A cosine and a sine in both coordinates, in units in which noise scatters alike, at places of whole bins."""
    rng = np.random.default_rng(3)
    rows, n = 1200.0, 400
    row = rng.integers(0, 150, n) * 8.0 + 1.0
    right, off = rng.uniform(0.3, 1.0, n), rng.normal(size=(2, n)) * [[1.0], [2.0]]
    off[1] += 0.5 * off[0] + 0.8 * np.sin(row / 30.0)
    one = periods._Periodogram(row, rows, right, off)
    found = one._spectrum(off)
    assert len(found) == 150  # of 37.5 waves
    centred = off - (off @ right / right.sum())[:, None]
    noise = (centred * right) @ (centred * right).T / right.sum()
    white = np.linalg.solve(np.linalg.cholesky(noise), centred)
    for k in (5, 12, 31):
        phase = 2.0 * np.pi * (k / 4) * np.floor(row / 8.0) / 150
        basis = np.stack([np.cos(phase), np.sin(phase)])
        pull = (basis * right) @ white.T
        taken = np.einsum("ic,ij,jc->", pull, np.linalg.inv((basis * right) @ basis.T), pull)
        assert found[k] == pytest.approx(0.5 * taken, rel=1e-6)


def test_the_level_beside_a_peak_is_one_of_noise_and_more_where_rows_wander() -> None:
    """In white noise it is 1 about a swing, of whatever size: the swing itself is taken away."""
    rng, rows, n = np.random.default_rng(8), 8000.0, 4000
    row, right = rng.uniform(0.0, rows, n), np.ones(n)
    noise, period = rng.normal(size=(2, n)), 400.0
    swing = np.sin(2.0 * np.pi * row / period)
    walk = np.interp(row, np.linspace(0.0, rows, 400), np.cumsum(rng.normal(size=400)))
    for size, wander, least, most in ((0.0, 0.0, 1.0, 1.3), (3.0, 0.0, 1.0, 1.3), (3.0, 0.3, 2.0, 40.0)):
        one = periods._Periodogram(row, rows, right, noise + size * swing + wander * walk)
        k = int(np.argmin(np.abs(one.cycles - rows / period)))
        assert least <= one._level(k, period) < most
