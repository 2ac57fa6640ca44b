"""Explanations: which unknowns, where, at what price, and how ends and rates follow single ties."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba.evidence.mixture import MixtureFit
from barpc.ba.evidence.periods import Period
from barpc.ba.evidence.scan import BINS, Interval, price
from barpc.ba.select import image_terms
from barpc.ba.terms import IN_IMAGES, LowFrequency, Sinusoid, Transient, decay, proposed, step
from barpc.ba.terms.decay import Decay
from barpc.ba.terms.step import Step, largest_part, open_ended
from barpc.ba.terms.term import SIZE_PRICE, Finding, Residuals
from barpc.sensor.image_corrections import profile

SIZE = np.array([[400.0, 500.0], [1000.0, 2000.0]])  # of two images, columns and rows


def seen(n: int = 30, views: int = 2, choices: int = 5) -> Residuals:
    """Observations that are evenly spread over the rows of some images, one after the other."""
    view = np.repeat(np.arange(views), n)
    size = SIZE[:, :views]
    part = np.tile((np.arange(n) + 0.5) / n, views)
    place = np.stack([part[::-1] * size[0, view], part * size[1, view]])
    linear: Any = SimpleNamespace(
        view=view, sigma=np.full(len(view), 0.25), choices=choices, taking_part=np.ones(len(view), dtype=bool),
        left=lambda step: np.zeros((2, len(view))) + step[0, 0],
    )  # fmt: skip
    nothing: Any = None
    base = fitted(len(view))
    return Residuals(linear, linear, nothing, place, size, base, np.zeros((2, 0, len(view))), np.zeros(0))


def fitted(n: int, extra: Any = (), step: float = 0.0) -> MixtureFit:
    return MixtureFit(0.0, np.full((2, 3), step), np.array(extra), 1.0, np.zeros(2), np.ones(n))


def interval(start: float, stop: float, view: int = 1, axis: int = 1) -> Interval:
    return Interval(view, axis, start, stop, 9.0, 0.1, 0.5, False)


# --- what is proposed -------------------------------------------------------------------------------------------------


def test_what_reaches_an_end_of_the_image_goes_on_beyond_it() -> None:
    assert open_ended(0.0, 1000.0, 1000.0) == (-1000.0, 2000.0)
    assert open_ended(-1.0, 1001.0, 1000.0) == (-1000.0, 2000.0)
    assert open_ended(0.1, 999.9, 1000.0) == (0.1, 999.9)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_strip_is_a_displacement_in_columns_and_one_in_rows(axis: int) -> None:
    s, size = seen(), SIZE[axis, 1]
    (one,) = Step.propose(s, interval(0.25 * size, 0.5 * size, axis=axis))
    inside = (s.linear.view == 1) & (s.place[axis] >= 0.25 * size) & (s.place[axis] < 0.5 * size)
    assert 5 < inside.sum() < 10
    np.testing.assert_array_equal(one.columns[0], np.stack([inside, 0 * inside]))
    np.testing.assert_array_equal(one.columns[1], np.stack([0 * inside, inside]))
    assert (one.NAME, one.view, one.where) == ("step", 1, (axis, 0.25 * size, 0.5 * size, 0.0, 0.0))
    np.testing.assert_array_equal(one.sigma, [1.0, 1.0])
    assert one.price == pytest.approx(price(5) + np.log(2.0 * np.log(30.0)))
    (whole,) = Step.propose(s, interval(0.0, size, axis=axis))
    assert whole.where == (axis, -size, 2.0 * size, 0.0, 0.0)


def test_what_fades_is_tried_on_both_sides_of_both_ends_over_halved_lengths(monkeypatch) -> None:
    """The cheapest upwards and the cheapest downwards: here a script wants one origin and length of each."""
    s, asked = seen(), list[tuple[float, float, float, float]]()

    def first_guess(
        few: Any, base: Any, extra: Any, own: np.ndarray, precision: np.ndarray
    ) -> tuple[None, None, float]:
        np.testing.assert_allclose(precision, 1.0)
        return None, None, costs.pop(0) if costs else 50.0

    monkeypatch.setattr(decay, "first_guess", first_guess)
    local = Decay.at

    def watched(residuals: Residuals, view: int, where: Any) -> Decay:
        asked.append(where[1:])
        return local(residuals, view, where)

    monkeypatch.setattr(Decay, "at", watched)
    costs = [9.0, 8.0, 7.0, 6.0, 5.0, 4.0]
    up, down = Decay.propose(s, interval(500.0, 1000.0))
    lengths = [(o, 1.0 / w) for _, _, o, w in asked]
    # from 500 to the end at 2000 over what is at least half of 500, from 1000 to it, and the other way
    upwards = [(500.0, 1500.0 / 2**n) for n in range(4)] + [(1000.0, 1000.0 / 2**n) for n in range(3)]
    downwards = [(500.0, -500.0 / 2**n) for n in range(2)] + [(1000.0, -1000.0 / 2**n) for n in range(3)]
    np.testing.assert_allclose(lengths, upwards + downwards)
    assert {row[:2] for row in asked} == {(500.0, 4000.0), (1000.0, 4000.0), (-2000.0, 500.0), (-2000.0, 1000.0)}
    assert up.where == (1, 1000.0, 4000.0, 1000.0, 1.0 / 500.0)  # the sixth was the cheapest
    assert down.where == (1, -2000.0, 500.0, 500.0, -1.0 / 500.0)  # of equal ones the first
    assert {one.NAME for one in (up, down)} == {"decay"}
    assert up.price == pytest.approx(price(5) + 2.0 * SIZE_PRICE)
    assert Decay.propose(s, interval(0.0, 100.0, axis=0)) == []
    assert len(Decay.propose(s, interval(0.0, 2000.0))) == 2


def test_what_settles_is_tried_from_either_end_over_all_to_a_hundredth_of_an_image(monkeypatch) -> None:
    s, rates = seen(), list[float]()
    made = Transient.at_rate
    monkeypatch.setattr(Transient, "at_rate", lambda *given: rates.append(given[1]) or made(*given))
    costs = [0.0] * 16
    costs[3] = -8.0  # what the fourth takes away
    monkeypatch.setattr(decay, "first_guess", lambda *_: (None, None, costs.pop(0)))
    (one,) = Transient.propose(s, interval(0.0, 1.0))
    lengths = 1500.0 * 2.0 ** np.arange(-7.0, 1.0)
    np.testing.assert_allclose(rates, np.concatenate([1.0 / lengths, -1.0 / lengths]))
    assert one.where == (1, -np.inf, np.inf, 0.0, pytest.approx(1.0 / lengths[3]))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_each_image_settles_by_its_own_amount_from_its_own_end(sign: float) -> None:
    s = seen()
    one = Transient.at_rate(s, sign / 100.0, 2.0)
    first = np.where(sign > 0, 0.0, SIZE[1, s.linear.view])
    faded = np.exp(-np.abs(s.place[1] - first) / 100.0)
    for v in (0, 1):
        own = np.where(s.linear.view == v, faded, 0.0)
        np.testing.assert_allclose(one.columns[:, 2 * v : 2 * v + 2], [[own, 0 * own], [0 * own, own]])
    np.testing.assert_array_equal(one.sigma, [2.0] * 4)
    assert one.price == pytest.approx(np.log(2.0) + 2.0 * SIZE_PRICE)
    assert (one.NAME, one.view, [part.view for part in one.parts]) == ("transient", -1, [0, 1])
    assert one.where == (1, -np.inf, np.inf, 0.0, sign / 100.0)


def test_a_rate_s_change_is_a_further_unknown_that_a_fit_says() -> None:
    """The derivative of a fade by the logarithm of its rate, by differences; all images' from their own ends."""
    s, step = seen(), 1e-6
    for made in (
        lambda rate: Decay.at(s, 1, (1, 300.0, 4000.0, 300.0, rate), 1.0),
        lambda rate: Decay.at(s, 1, (1, -2000.0, 900.0, 900.0, -rate), 1.0),
        lambda rate: Transient.at_rate(s, rate, 1.0),
        lambda rate: Transient.at_rate(s, -rate, 1.0),
    ):
        one, near = made(1.0 / 400.0), made(np.exp(step) / 400.0)
        found = one.with_rate(s)
        half = one.columns.shape[1]
        np.testing.assert_array_equal(found.columns[:, :half], one.columns)
        np.testing.assert_allclose(found.columns[:, half:], (near.columns - one.columns) / step, atol=1e-5)
        np.testing.assert_array_equal(found.sigma, np.ones(2 * half))


@pytest.mark.parametrize(
    ("moved", "slope", "step"), [([3, 4], [1, 2], 0.44), ([1, 0], [5, 9], 1), ([1, 0], [-5, 9], -1)]
)
def test_a_rate_changes_by_what_a_fit_asks_for_and_a_factor_e_at_most(moved, slope, step) -> None:
    one = Decay.at(seen(), 1, (1, 300.0, 4000.0, 300.0, 0.01), 1.0)
    found = one.at_rate_of(fitted(60, [7.0, *moved, *slope]))
    assert found.where is not None
    assert found.where[:4] == (1, 300.0, 4000.0, 300.0)
    assert found.where[4] == pytest.approx(0.01 * np.exp(step))
    assert one.at_rate_of(fitted(60, [0.0, 0.0, 1.0, 1.0])).where == one.where


def test_rows_that_wander_have_splines_as_many_as_ties_hold() -> None:
    for n, count in ((299, 9), (600, 14), (100, 7), (300, 10)):
        s = seen(n)
        (one,) = LowFrequency.propose(s, interval(0.0, 100.0))
        per = max(min(n // 30, 14), 7)
        assert per == count
        half = one.columns.shape[1] // 2
        assert half == count - 3  # but what a drift is
        rows = s.linear.view == 1
        assert not one.columns[:, :, ~rows].any()
        assert not one.columns[0, half:].any()
        assert not one.columns[1, :half].any()
        np.testing.assert_array_equal(one.columns[0, :half], one.columns[1, half:])
        np.testing.assert_array_equal(one.sigma, 1.0)
        assert one.price == pytest.approx(np.log(5.0) + SIZE_PRICE)
        assert (one.NAME, one.view, one.where) == ("low_frequency", 1, None)


def test_a_swing_is_a_cosine_and_a_sine_in_columns_and_in_rows() -> None:
    s = seen()
    one = Sinusoid.of(s, Period(1, 300.0, 9.0))
    rows = s.linear.view == 1
    phase = 2.0 * np.pi * s.place[1, rows] / 300.0
    waves = one.columns[0, :2, rows].T
    both = np.stack([np.cos(phase), np.sin(phase)])
    np.testing.assert_allclose(np.abs(waves @ waves.T), np.abs(both @ both.T), atol=1e-9)
    np.testing.assert_array_equal(one.columns[1, 2:], one.columns[0, :2])
    assert not one.columns[1, :2].any()
    assert not one.columns[:, :, ~rows].any()
    assert (one.NAME, one.view, one.period) == ("sinusoid", 1, 300.0)
    assert one.price == pytest.approx(np.log(4.0 * 2000.0 / 32.0 * 5) + SIZE_PRICE)


def test_what_is_proposed_once_is_not_again(monkeypatch) -> None:
    said: list[tuple[str, Any]] = []
    for kind in IN_IMAGES:
        monkeypatch.setattr(kind, "propose", lambda seen, one, kind=kind: said.append((kind.NAME, one)) or [kind.NAME])
    rows = [interval(0.0, 100.0), interval(0.0, 300.0), interval(0.0, 100.0, 0)]
    assert list(proposed(seen(), rows, [])) == [
        "step", "decay", "transient", "low_frequency", "step", "decay", "step", "decay", "low_frequency",
    ]  # fmt: skip
    assert [one for kind, one in said if kind == "low_frequency"] == [rows[0], rows[2]]
    assert list(proposed(seen(), rows[:1], [], [kind for kind in IN_IMAGES if kind is not Decay])) == [
        "step",
        "transient",
        "low_frequency",
    ]
    middle = [interval(0.0, 100.0), interval(500.0, 600.0)]
    assert list(proposed(seen(), middle, [], [Step, Decay, Transient])) == ["step", "decay", "step", "decay"]
    (only,) = proposed(seen(), [], [Period(0, 50.0, 1.0)])
    assert only.NAME == "sinusoid"


def test_all_begins_or_all_ends() -> None:
    s = seen()
    begins, ends = [interval(0.0, 9.0), interval(-1.0, 5.0, 0)], [interval(1500.0, 2000.0), interval(900.0, 1001.0, 0)]
    assert Transient.may_be(s, begins)
    assert Transient.may_be(s, ends)
    assert not Transient.may_be(s, [begins[0], ends[1]])
    assert not Transient.may_be(s, [begins[0], interval(0.1, 9.0)])
    assert not Transient.may_be(s, [interval(1500.0, 1999.0)])
    assert not Transient.may_be(s, [interval(0.0, 9.0, axis=0)])
    assert Transient.may_be(s, [interval(0.0, 2000.0)])


# --- ends by single ties ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gain", "part"),
    [([1, 1, -5, 2, 3, -1, 2, -9], (3, 6)), ([-1, -2, 3], (2, 2)), ([4, -1, 2], (0, 2)), ([-1, -1, -2], (0, 0))],
)
def test_thelargest_part_is_the_run_with_the_largest_sum(gain: list[int], part: tuple[int, int]) -> None:
    sums = {(i, j): sum(gain[i : j + 1]) for i in range(len(gain)) for j in range(i, len(gain))}
    assert largest_part(np.array(gain, dtype=float)) == part
    assert sums[part] == max(sums.values())


def gains(monkeypatch, s: Residuals, inside: np.ndarray) -> list[np.ndarray]:
    """Single ties of view 1 gain where they are `inside` and lose elsewhere; what they were asked with."""
    asked: list[np.ndarray] = []

    def log_likelihoods(linear: Any, residual: np.ndarray, found: MixtureFit) -> np.ndarray:
        asked.append(residual)
        return np.where(inside, 1.0, -1.0) if len(asked) % 2 else np.zeros(residual.shape[1])

    monkeypatch.setattr(step, "log_likelihoods", log_likelihoods)
    return asked


def test_a_strip_ends_between_ties_and_is_as_wide_as_it_is_large(monkeypatch) -> None:
    s = seen()
    rows = s.place[1] / SIZE[1, s.linear.view]
    one = Step.at(s, 1, (1, 500.0, 1000.0, 0.0, 0.0), 1.0)
    inside = (rows > 0.3) & (rows < 0.6)
    asked = gains(monkeypatch, s, inside)
    others = np.full((2, 60), 0.5)
    found = one.refined(s, fitted(60, [9.0, 3.0, -4.0], step=0.1), others)
    assert found.where == pytest.approx((1, 0.3 * 2000, 0.6 * 2000, 0.0, 0.0))  # ties lie at 0.283, 0.317, ..
    np.testing.assert_allclose(found.sigma, np.sqrt(12.5))
    displaced, left = asked
    np.testing.assert_allclose(left, 0.1 + 0.5 / 0.25)
    mine = s.linear.view == 1
    np.testing.assert_allclose(displaced - left, np.where(mine, [[3.0 / 0.25], [-4.0 / 0.25]], 0.0))
    for size, sigma in ((0.01, 1.0 / 30.0), (99.0, 30.0)):
        again = one.refined(s, fitted(60, [size, size]), others)
        np.testing.assert_allclose(again.sigma, sigma)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_strip_at_an_end_goes_on_beyond_it(monkeypatch, axis: int) -> None:
    s, size = seen(), SIZE[axis, 1]
    one = Step.at(s, 1, (axis, 0.1 * size, 0.3 * size, 0.0, 0.0), 1.0)
    part = s.place[axis] / SIZE[axis, s.linear.view]
    for inside, ends in (
        (part < 0.2, (-size, 0.2 * size)),
        (part > 0.8, (0.8 * size, 2.0 * size)),
        ((part > 0.8) & (part < 0.94), (0.8 * size, 2.0 * size)),  # two that contradict tell no end of it
        ((part > 0.06) & (part < 0.2), (-size, 0.2 * size)),
        ((part > 0.5) & (part < 0.7), (0.5 * size, 0.7 * size)),
        (part > 0.0, (-size, 2.0 * size)),
    ):
        gains(monkeypatch, s, inside)
        found = one.refined(s, fitted(60, [1.0, 1.0]), np.zeros((2, 60)))
        assert found.where == pytest.approx((axis, *ends, 0.0, 0.0))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_fade_begins_where_ties_say(monkeypatch, sign: float) -> None:
    """Of what it moves all is to be inside, on the side to which it fades."""
    s = seen()
    one = Decay.at(s, 1, (1, 300.0, 4000.0, 300.0, sign / 400.0), 1.0)
    part = s.place[1] / SIZE[1, s.linear.view]
    asked = gains(monkeypatch, s, part > 0.4 if sign > 0 else part < 0.4)
    found = one.refined(s, fitted(60, [1.0, 2.0]), np.zeros((2, 60)))
    ends = (800.0, 4000.0) if sign > 0 else (-2000.0, 800.0)
    assert found.where == pytest.approx((1, *ends, 800.0, sign / 400.0))
    assert found.NAME == "decay"
    mine = s.linear.view == 1  # what fades is asked everywhere
    everywhere = profile(s.place[1, mine], np.array(-np.inf), np.array(np.inf), np.array(300.0), np.array(sign / 400.0))
    np.testing.assert_allclose((asked[0] - asked[1])[:, mine], np.array([[4.0], [8.0]]) * everywhere)
    gains(monkeypatch, s, part > (-1.0 if sign > 0 else 2.0))
    again = one.refined(s, fitted(60, [1.0, 2.0]), np.zeros((2, 60)))
    assert again.where == pytest.approx(
        (1, -2000.0, 4000.0, 0.0, sign / 400.0) if sign > 0 else (1, -2000.0, 0.0, 0.0, sign / 400.0)
    )


def test_what_settles_and_what_has_no_place_are_as_wide_as_they_are_large() -> None:
    s = seen()
    swing = Sinusoid.of(s, Period(1, 300.0, 9.0))
    found = swing.refined(s, fitted(60, [5.0, 1.0, 1.0, 1.0, 3.0]), np.zeros((2, 60)))
    np.testing.assert_allclose(found.sigma, [np.sqrt(3.0)] * 4)
    assert found.columns is swing.columns
    settles = Transient.at_rate(s, 0.01, 1.0)
    found = settles.refined(s, fitted(60, [2.0] * 4), np.zeros((2, 60)))
    assert found.where == settles.where
    np.testing.assert_allclose(found.sigma, 2.0)
    np.testing.assert_array_equal(found.columns, settles.columns)


@pytest.mark.parametrize("shape", ["strip", "up", "down"])
def test_rows_that_wander_like_a_strip_or_a_fade_are_tried_as_such(shape: str) -> None:
    """A curve's shape that is found again by least squares over its splines, of images of 1000 rows."""
    s = seen(600)
    (one,) = LowFrequency.propose(s, interval(0.0, 1.0, view=0))
    at = s.place[1, s.linear.view == 0]
    where = {
        "strip": (300.0, 550.0, 0.0, 0.0),
        "up": (400.0, 2000.0, 400.0, 1.0 / 250.0),
        "down": (-1000.0, 600.0, 600.0, -1.0 / 250.0),
    }[shape]
    wanted = profile(at, *map(np.asarray, where))
    basis = one.columns[0, : one.columns.shape[1] // 2, s.linear.view == 0]
    along = np.linalg.lstsq(basis, wanted, rcond=None)[0]
    strip, fade = one.alternatives(s, fitted(1200, [8.0, *along, *(-2.0 * along)]))
    assert (strip.NAME, fade.NAME, strip.view) == ("step", "decay", 0)
    told = strip if shape == "strip" else fade
    assert told.where is not None
    if shape == "strip":
        np.testing.assert_allclose(told.where[1:3], [300.0, 550.0], atol=1000.0 / BINS + 1e-6)
    else:
        assert told.where[3] == pytest.approx(where[2], abs=1000.0 / BINS + 1e-6)
        assert np.sign(told.where[4]) == np.sign(where[3])
        assert 1.0 / abs(told.where[4]) in (62.5, 125.0, 250.0, 500.0, 1000.0)


# --- what is followed -------------------------------------------------------------------------------------------------


def test_what_was_found_are_unknowns_of_the_images_with_the_sizes_found() -> None:
    def found(kind: str, view: int, *unknowns: float, where: Any = None, period: float | None = None) -> Finding:
        return Finding(kind, view, where, np.zeros(2), 9.0, 1.0, "", np.array(unknowns), period)

    strip, fade = (1, 10.0, 20.0, 0.0, 0.0), (1, 30.0, 99.0, 30.0, 0.1)
    parts = [
        found("step", 2, 1.0, 2.0, where=strip),
        found("sinusoid", 0, 3.0, 4.0, 5.0, 6.0, period=50.0),
        found("decay", 2, 7.0, 8.0, where=fade),
        found("transient", 1, 9.0, 10.0, where=fade),
    ]
    layout = image_terms._layout_of(parts, 4)
    waves, params = layout.waves, layout.start
    assert params is not None
    assert waves.count == 0
    assert waves.edges.shape == (4, 0)
    assert waves.strips.shape == (4, 2, 5)
    np.testing.assert_array_equal(waves.strips[2], [strip, fade])
    np.testing.assert_array_equal(waves.strips[1, 0], fade)
    assert np.isinf(waves.strips[[0, 3]]).all()
    assert np.isinf(waves.strips[1, 1]).all()
    np.testing.assert_array_equal(waves.periods, [[50.0], [np.inf], [np.inf], [np.inf]])
    # columns of all strips, then rows; of swings too
    np.testing.assert_array_equal(params[2], [1, 7, 2, 8, 0, 0, 0, 0])
    np.testing.assert_array_equal(params[1], [9, 0, 10, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(params[0], [0, 0, 0, 0, 3, 4, 5, 6])
    assert not params[3].any()
