"""Terms: which unknowns, where, at what price, how places, ends and rates follow single ties, and what is recorded."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba.evidence.mixture import MixtureFit, fit_mixture, log_likelihoods
from barpc.ba.evidence.periods import Period
from barpc.ba.evidence.scan import BINS, Interval, price
from barpc.ba.terms import LowFrequency, Sinusoid, Transient, proposed
from barpc.ba.terms.decay import Decay
from barpc.ba.terms.step import Step, largest_part, open_ended
from barpc.ba.terms.term import SIZE_PRICE, Residuals, Term
from barpc.sensor.image_corrections import profile
from tests.ba.residuals import Displacement, decay, residuals_of, step, transient
from tests.lanes import rest_slow

SIZE = np.array([[400.0, 500.0], [1000.0, 2000.0]])  # of two images, columns and rows


def seen(n: int = 30, views: int = 2, choices: int = 5) -> Residuals:
    """Observations that are evenly spread over the rows of some images, one after the other."""
    view = np.repeat(np.arange(views), n)
    size = SIZE[:, :views]
    part = np.tile((np.arange(n) + 0.5) / n, views)
    place = np.stack([part[::-1] * size[0, view], part * size[1, view]])
    linear: Any = SimpleNamespace(
        view=view, sigma=np.full(len(view), 0.25), choices=choices, in_tracks=np.ones(len(view), dtype=bool),
        residual_after=lambda step: np.zeros((2, len(view))) + step[0, 0],
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
def test_a_step_is_a_displacement_in_columns_and_one_in_rows(axis: int) -> None:
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


def beside_right_cameras(*moved: Displacement, tracks: int = 150) -> Residuals:
    """Residuals beside a fit of which no camera has followed the displacement."""
    return replace(residuals_of(*moved, tracks=tracks), base=residuals_of(tracks=tracks).base)


@pytest.mark.parametrize(
    ("origin", "length"),
    # lengths are halved from the rest of the image on, to half of the interval at least
    [(0.4, 0.6), (0.4, 0.15), (0.4, 0.075), (0.6, 0.1), (0.6, -0.6), (0.6, -0.075), (0.4, -0.1)],
)
def test_a_decay_is_proposed_from_the_end_of_an_interval_from_which_it_goes_and_with_its_length(origin, length) -> None:
    s = beside_right_cameras(decay(3.0, 1, origin, length))
    told = Decay.propose(s, interval(8000.0, 12000.0))
    assert [np.sign(one.where[4]) for one in told if one.where] == [1.0, -1.0]
    one = told[0 if length > 0 else 1]
    start, stop = (20000 * origin, 40000.0) if length > 0 else (-20000.0, 20000 * origin)
    assert one.where == pytest.approx((1, start, stop, 20000 * origin, 1.0 / (20000 * length)))
    assert (one.NAME, one.view) == ("decay", 1)
    assert one.price == pytest.approx(price(s.linear.choices) + 2.0 * SIZE_PRICE)
    assert Decay.propose(s, interval(0.0, 1000.0, axis=0)) == []
    whole = [one.where[3] for one in Decay.propose(s, interval(0.0, 20000.0)) if one.where]
    assert whole == [0.0, 20000.0]  # from either end


@pytest.mark.parametrize("length", rest_slow([2.0**-4, -(2.0**-3), 2.0**-7, -1.0]))
def test_a_transient_is_proposed_from_its_end_with_its_length(length: float) -> None:
    (one,) = Transient.propose(beside_right_cameras(transient(6.0, length), tracks=600), interval(0.0, 1.0))
    assert one.where is not None
    assert one.where[:4] == (1, -np.inf, np.inf, 0.0)
    assert 1.0 / (20000 * one.where[4]) == pytest.approx(length)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_transient_has_an_amount_an_image_and_begins_at_its_end(sign: float) -> None:
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
    """The derivative of a decay by the logarithm of its rate, by differences; all images' from their own ends."""
    s, step = seen(), 1e-6
    for made in (
        lambda rate: Decay.at(s, 1, (1, 300.0, 4000.0, 300.0, rate), 1.0),
        lambda rate: Decay.at(s, 1, (1, -2000.0, 900.0, 900.0, -rate), 1.0),
        lambda rate: Transient.at_rate(s, rate, 1.0),
        lambda rate: Transient.at_rate(s, -rate, 1.0),
    ):
        one, near = made(1.0 / 400.0), made(np.exp(step) / 400.0)
        found = one.with_rate_derivatives(s)
        half = one.columns.shape[1]
        np.testing.assert_array_equal(found.columns[:, :half], one.columns)
        np.testing.assert_allclose(found.columns[:, half:], (near.columns - one.columns) / step, atol=1e-5)
        np.testing.assert_array_equal(found.sigma, np.ones(2 * half))


@pytest.mark.parametrize(
    ("moved", "slope", "step"), [([3, 4], [1, 2], 0.44), ([1, 0], [5, 9], 1), ([1, 0], [-5, 9], -1)]
)
def test_a_rate_changes_by_what_a_fit_asks_for_and_a_factor_e_at_most(moved, slope, step) -> None:
    one = Decay.at(seen(), 1, (1, 300.0, 4000.0, 300.0, 0.01), 1.0)
    found = one.with_rate_of(fitted(60, [7.0, *moved, *slope]))
    assert found.where is not None
    assert found.where[:4] == (1, 300.0, 4000.0, 300.0)
    assert found.where[4] == pytest.approx(0.01 * np.exp(step))
    assert one.with_rate_of(fitted(60, [0.0, 0.0, 1.0, 1.0])).where == one.where


def test_a_low_frequency_displacement_has_as_many_splines_as_ties_hold() -> None:
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


def test_a_sinusoid_is_a_cosine_and_a_sine_in_columns_and_in_rows() -> None:
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


def test_what_is_proposed_once_is_not_again() -> None:
    """A part of an image once an interval, a curve once an image, what is of all images once."""
    s = residuals_of(step(1.0, 1, 0.0, 0.3))
    rows = [interval(0.0, 4000.0), interval(0.0, 6000.0), interval(0.0, 4000.0, 0), interval(0.0, 4000.0)]

    def of(intervals: list[Interval], *without: Any) -> list[tuple[str, int]]:
        known = "step", "decay", "transient", "low_frequency"  # whatever else the table has
        return [(one.NAME, one.view) for one in proposed(s, intervals, [], without) if one.NAME in known]

    part = [("step", 1), ("decay", 1), ("decay", 1)]
    first = [("step", 1), *[("decay", 1)] * (len(Decay.propose(s, rows[0])))]
    assert of(rows) == [
        *first, ("transient", -1), ("low_frequency", 1), *part, *[(name, 0) for name, _ in first], ("low_frequency", 0),
    ]  # fmt: skip
    assert of(rows[:1], Decay) == [("step", 1), ("transient", -1), ("low_frequency", 1)]
    middle = [rows[0], interval(8000.0, 9000.0)]
    assert of(middle, Decay, LowFrequency) == [("step", 1), ("step", 1)]
    (only,) = proposed(s, [], [Period(0, 50.0, 1.0)])
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
def test_the_largest_part_is_the_run_with_the_largest_sum(gain: list[int], part: tuple[int, int]) -> None:
    sums = {(i, j): sum(gain[i : j + 1]) for i in range(len(gain)) for j in range(i, len(gain))}
    assert largest_part(np.array(gain, dtype=float)) == part
    assert sums[part] == max(sums.values())


@pytest.mark.parametrize("axis", [0, 1])
def test_a_single_tie_gains_what_its_track_is_likelier_displaced(axis: int) -> None:
    """By a fit with the term and another one, whose displacement is known; of a decay as if it were everywhere."""
    s = residuals_of(step(1.0, 1, 0.4, 0.6, axis), step(2.0, 2, 0.1, 0.3))
    other = Step.at(s, 2, (1, 2000.0, 6000.0, 0.0, 0.0))
    for one in (
        Step.at(s, 1, (axis, 0.3 * s.size[axis, 1], 0.7 * s.size[axis, 1], 0.0, 0.0)),
        Decay.at(s, 1, (axis, 3000.0, 40000.0, 3000.0, 1.0 / 5000.0)),
    ):
        columns = np.concatenate([other.columns, one.columns], axis=1)
        found = fit_mixture(s.linear, columns, np.ones(4), s.base)
        others = np.einsum("cek,e->ck", other.columns, found.extra[:2])
        place, gain = one.gains(s, found, others)
        rows = np.flatnonzero(s.linear.view == 1)
        rows = rows[np.argsort(s.place[axis, rows])]
        np.testing.assert_array_equal(place, s.place[axis, rows])
        for k in (0, 40, len(rows) - 1):
            left = s.linear.residual_after(found.step) + others / s.linear.sigma
            before = log_likelihoods(s.linear, left, found)[rows[k]]
            rate = one.where[4]  # type: ignore[index]
            size = np.exp(-max((place[k] - 3000.0) * rate, 0.0)) if rate else 1.0
            left[:, rows[k]] += found.extra[2:] * size / s.linear.sigma[rows[k]]
            assert gain[k] == pytest.approx(log_likelihoods(s.linear, left, found)[rows[k]] - before, abs=1e-6)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_step_ends_between_ties_and_its_prior_is_as_wide_as_it_is_large(axis: int) -> None:
    s = residuals_of(step(1.0, 1, 0.4, 0.6, axis))
    size = s.size[axis, 1]
    one = Step.at(s, 1, (axis, 0.34 * size, 0.62 * size, 0.0, 0.0))
    found = fit_mixture(s.linear, one.columns, one.sigma, s.base)
    again = one.refined(s, found, np.zeros((2, 1)))
    assert again.where is not None
    place = np.sort(s.place[axis, s.linear.view == 1])
    for end, true in zip(again.where[1:3], (0.4 * size, 0.6 * size), strict=True):
        k, between = int(np.searchsorted(place, end)), 0.5 * (place[1:] + place[:-1])
        assert end == pytest.approx(between[k - 1], abs=1e-6)
        assert abs(k - int(np.searchsorted(place, true))) <= 1
    np.testing.assert_allclose(again.sigma, np.sqrt((found.extra**2).mean()))
    np.testing.assert_array_equal(again.columns, Step.at(s, 1, again.where).columns)


def told(monkeypatch: pytest.MonkeyPatch, s: Residuals, one: Term, inside: np.ndarray) -> Any:
    """Where a term is refined to if single ties of view 1 gain a nat inside and lose one elsewhere."""
    axis = one.where[0]  # type: ignore[index]
    rows = np.flatnonzero(s.linear.view == 1)
    rows = rows[np.argsort(s.place[axis, rows])]
    gain = np.where(inside, 1.0, -1.0)[rows]
    monkeypatch.setattr(type(one), "gains", lambda *_: (s.place[axis, rows], gain))
    return one.refined(s, fitted(60, [1.0, 2.0]), np.zeros((2, 60))).where


@pytest.mark.parametrize("axis", [0, 1])
def test_a_step_at_an_end_goes_on_beyond_it(monkeypatch, axis: int) -> None:
    s, size = seen(), SIZE[axis, 1]
    one = Step.at(s, 1, (axis, 0.1 * size, 0.3 * size, 0.0, 0.0))
    part = s.place[axis] / SIZE[axis, s.linear.view]
    for inside, ends in (
        (part < 0.2, (-size, 0.2 * size)),
        (part > 0.8, (0.8 * size, 2.0 * size)),
        ((part > 0.8) & (part < 0.94), (0.8 * size, 2.0 * size)),  # two that contradict tell no end of it
        ((part > 0.06) & (part < 0.2), (-size, 0.2 * size)),
        ((part > 0.5) & (part < 0.7), (0.5 * size, 0.7 * size)),
        (part > 0.0, (-size, 2.0 * size)),
    ):
        assert told(monkeypatch, s, one, inside) == pytest.approx((axis, *ends, 0.0, 0.0))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_decay_begins_where_all_that_gains_is_on_the_side_to_which_it_goes(monkeypatch, sign: float) -> None:
    s, part = seen(), np.tile((np.arange(30) + 0.5) / 30, 2)
    one = Decay.at(s, 1, (1, 300.0, 4000.0, 300.0, sign / 400.0))
    for inside, place in (
        (part > 0.4 if sign > 0 else part < 0.4, (800.0, 4000.0, 800.0) if sign > 0 else (-2000.0, 800.0, 800.0)),
        (part > 0.0, (-2000.0, 4000.0, 0.0 if sign > 0 else 2000.0)),
    ):
        assert told(monkeypatch, s, one, inside) == pytest.approx((1, *place, sign / 400.0))


def test_priors_of_a_transient_and_of_terms_without_a_place_are_as_wide_as_they_are_large() -> None:
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
    for size, sigma in ((0.01, 1.0 / 30.0), (99.0, 30.0)):
        np.testing.assert_allclose(swing.refined(s, fitted(60, [size] * 4), np.zeros((2, 60))).sigma, sigma)


@pytest.mark.parametrize("shape", ["step", "up", "down"])
def test_a_curve_like_a_step_or_a_decay_is_tried_as_such(shape: str) -> None:
    """A curve's shape that is found again by least squares over its splines, of images of 1000 rows."""
    s = seen(600)
    (one,) = LowFrequency.propose(s, interval(0.0, 1.0, view=0))
    at = s.place[1, s.linear.view == 0]
    where = {
        "step": (300.0, 550.0, 0.0, 0.0),
        "up": (400.0, 2000.0, 400.0, 1.0 / 250.0),
        "down": (-1000.0, 600.0, 600.0, -1.0 / 250.0),
    }[shape]
    wanted = profile(at, *map(np.asarray, where))
    basis = one.columns[0, : one.columns.shape[1] // 2, s.linear.view == 0]
    along = np.linalg.lstsq(basis, wanted, rcond=None)[0]
    step_, decay_ = one.alternatives(s, fitted(1200, [8.0, *along, *(-2.0 * along)]))
    assert (step_.NAME, decay_.NAME, step_.view) == ("step", "decay", 0)
    told = step_ if shape == "step" else decay_
    assert told.where is not None
    if shape == "step":
        np.testing.assert_allclose(told.where[1:3], [300.0, 550.0], atol=1000.0 / BINS + 1e-6)
    else:
        assert told.where[3] == pytest.approx(where[2], abs=1000.0 / BINS + 1e-6)
        assert np.sign(told.where[4]) == np.sign(where[3])
        assert 1.0 / abs(told.where[4]) in (62.5, 125.0, 250.0, 500.0, 1000.0)


# --- what is recorded -------------------------------------------------------------------------------------------------


SAID: Any = {"gain": 9.0, "gap": 1.0, "runner_up": "", "or_of": ()}


def test_a_record_has_the_size_in_columns_and_rows_of_what_is_displaced() -> None:
    s = seen(600)
    (part,) = Step.propose(s, interval(0.0, 500.0))
    (one,) = part.findings(s, np.array([3.0, -4.0]), **SAID)
    assert (one.kind, one.view, one.where, one.size.tolist()) == ("step", 1, part.where, [3.0, -4.0])
    (one,) = Sinusoid.of(s, Period(1, 300.0, 9.0)).findings(s, np.array([3.0, -4.0, 5.0, 12.0]), **SAID)
    assert (one.kind, one.period, one.size.tolist()) == ("sinusoid", 300.0, [5.0, 13.0])  # amplitudes
    (curve,) = LowFrequency.propose(s, interval(0.0, 1.0))
    unknowns = np.random.default_rng(0).normal(size=len(curve.sigma))
    (one,) = curve.findings(s, unknowns, **SAID)
    moved = np.einsum("cek,e->ck", curve.columns, unknowns)[:, s.linear.view == 1]
    np.testing.assert_allclose(one.size, np.sqrt((moved**2).mean(axis=1)))
    (first, second) = Transient.at_rate(s, 0.01, 1.0).findings(s, np.arange(4.0), **SAID)
    assert (first.kind, first.view, second.view, second.size.tolist()) == ("transient", 0, 1, [2.0, 3.0])
    assert first.where == (1, -1000.0, 2000.0, 0.0, 0.01)
    assert all(row.gain == 9.0 for row in (first, second))


def test_a_decay_may_be_a_step_of_its_rows_and_no_other_term_is_simpler() -> None:
    s = seen()
    one = Decay.at(s, 1, (1, 800.0, 4000.0, 800.0, 1.0 / 400.0), 3.0)
    plain = one.simpler(s)
    assert (plain.NAME, plain.view, plain.where) == ("step", 1, (1, 800.0, 4000.0, 0.0, 0.0))
    np.testing.assert_array_equal(plain.sigma, [3.0, 3.0])
    np.testing.assert_array_equal(plain.columns[0, 0], (s.linear.view == 1) & (s.place[1] >= 800.0))
    assert plain.price == pytest.approx(one.price - SIZE_PRICE)
    assert plain.simpler(s) is None
    assert Transient.at_rate(s, 0.01, 1.0).simpler(s) is None


def test_terms_differ_by_kind_view_axis_and_rows_that_do_not_overlap() -> None:
    s, rows = seen(), (1, 2.0, 5.0, 0.0, 0.0)
    one = Step.at(s, 0, rows)
    for other, differs in (
        (Step.at(s, 0, (1, 4.9, 9.0, 0.0, 0.0)), False),
        (Step.at(s, 0, (1, 5.0, 9.0, 0.0, 0.0)), True),
        (Step.at(s, 0, (0, 2.0, 5.0, 0.0, 0.0)), True),
        (Step.at(s, 1, rows), True),
        (Decay.at(s, 0, rows), True),
        (replace(one, where=None), False),
    ):
        assert one.differs(other) == other.differs(one) == differs
    swings = [Sinusoid.of(s, Period(view, 300.0, 9.0)) for view in (0, 0, 1)]
    assert [swings[0].differs(other) for other in swings] == [False, False, True]


def test_a_part_is_counted_in_observations_of_its_image_or_of_all() -> None:
    s = seen()
    assert Step.at(s, 1, (1, 0.0, 1000.0, 0.0, 0.0)).share(s) == pytest.approx(0.5)
    assert Step.at(s, 7, (1, 0.0, 1000.0, 0.0, 0.0)).share(s) == 0.0
    assert Transient.at_rate(s, 0.01, 1.0).share(s) == 1.0


def test_an_amplitude_is_asked_of_sinusoids_alone() -> None:
    swing = Sinusoid.of(seen(), Period(1, 300.0, 9.0))
    assert swing.amplitude(seen(), fitted(60, [7.0, 0.36, 0.48, 0.48, 0.64])) == pytest.approx(1.0)
    assert Step.at(seen(), 1, (1, 0.0, 9.0, 0.0, 0.0)).amplitude(seen(), fitted(60, [0.0, 0.0])) == np.inf
