"""How much an observation counts: losses in closed form, who is spared, and what is cut of whom."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba.constraints.ground import MAX_INDEPENDENT_ERRORS
from barpc.ba.parameters.additional_parameters import AdditionalParameters
from barpc.ba.parameters.priors import PointPrior
from barpc.ba.robust import rounds
from barpc.ba.robust.rounds import _robust
from barpc.ba.robust.weights import MEDIAN, Observations, geman_mcclure
from barpc.ba.solving.structure import make_structure
from tests import distributions as stats


def test_the_loss_of_two_scales_is_what_its_formula_says() -> None:
    np.testing.assert_allclose(geman_mcclure(np.array([0.0, 4.0])), [[0.0, 0.8], [1.0, 0.04]])


def test_the_median_lies_between_those_of_one_and_of_two_degrees_of_freedom() -> None:
    assert stats.chi2.median(1) < MEDIAN < stats.chi2.median(2) / 2


# 4 tracks, a GCP and two points of a reference, each seen by both views
POINTS, TRACKS, KNOWN = 7, 4, 5


def observations(
    noise_floor: float = 0.0, waves: AdditionalParameters | None = None, num: int = POINTS
) -> Observations:
    """The sigmas are 0.1 px; what counts from `KNOWN` on is a reference's."""
    point = np.tile(np.arange(num), 2)
    structure = make_structure(np.repeat([0, 1], num), point, 2, num)
    held = np.arange(TRACKS, num)
    prior = PointPrior(held, np.zeros((len(held), 3)), np.zeros((len(held), 3, 3)), np.zeros((len(held), 3, 0)))
    unknowns = SimpleNamespace(unknowns=SimpleNamespace(waves=waves, half=np.full((2, 2), 500.0)))
    problem: Any = SimpleNamespace(structure=structure, cameras=unknowns, point_prior=prior)
    return Observations(problem, np.full(2 * num, 0.1), noise_floor, point < TRACKS, point >= KNOWN)


@pytest.mark.parametrize(("sigmas", "spared"), [(0.0, True), (99.0, True), (101.0, False)])
def test_control_points_are_spared_unless_they_are_grossly_wrong(sigmas, spared) -> None:
    found = observations().is_spared(np.full(14, sigmas**2)).reshape(2, 7)
    assert (found == [*[False] * 4, spared, True, True]).all()


@pytest.mark.parametrize(
    ("sigmas", "near"),
    [
        (2.9, [1, 1, 1, 1, 1, 1, 1]),
        (3.0, [1, 1, 1, 1, 1, 1, 1]),
        (3.1, [0, 0, 0, 0, 1, 1, 1]),
        (4.9, [0, 0, 0, 0, 1, 1, 1]),
        (5.1, [0, 0, 0, 0, 1, 0, 0]),  # a reference's were compared with each other before
        (99.0, [0, 0, 0, 0, 1, 0, 0]),
        (101.0, [0, 0, 0, 0, 0, 0, 0]),
    ],
)
def test_what_is_cut_is_farther_off_than_so_many_sigmas(sigmas, near) -> None:
    assert (observations().is_near(np.full(14, sigmas**2), 3.0).reshape(2, 7) == near).all()


def test_points_of_a_reference_count_as_stated_whatever_the_noise_and_resemble_each_other() -> None:
    for more in (2, 60):
        num = KNOWN + more
        made = observations(num=num)
        use = np.ones(2 * num, dtype=bool)
        use[num - 1] = False
        weight = made.weight(use, 2.0).reshape(2, num)
        np.testing.assert_allclose(weight[:, :KNOWN], 5.0)
        for view, count in ((0, more - 1), (1, more)):
            expected = 10.0 * min(np.sqrt(MAX_INDEPENDENT_ERRORS / count), 1.0)
            np.testing.assert_allclose(weight[view, KNOWN : KNOWN + count], expected)
        assert weight[0, -1] == 0.0


def test_tie_points_of_a_view_count_together_at_most_as_the_floor_says() -> None:
    """That of every stretch of a spline: what neighbours share averages away over the unknowns of the image.

    What a camera cannot follow is as good as fourteen errors of its own, of three pixels at most: more would loosen the
    view that causes it.
    """
    waves = AdditionalParameters(13)
    use = np.ones(14, dtype=bool)
    use[3] = False
    for made, stretches in ((observations(0.3), 1), (observations(0.3, waves), waves.size)):
        weight = made.weight(use, 2.0).reshape(2, 7)
        information = np.array([TRACKS - 1, TRACKS]) / 0.2**2
        np.testing.assert_allclose((weight[:, :TRACKS] ** 2).sum(axis=1), np.minimum(information, stretches / 0.3**2))
        np.testing.assert_allclose(weight[:, TRACKS], 1 / 0.2)  # control has no part in it
        assert weight[0, 3] == 0.0
    for floor in (0.0, 0.3):
        weight = observations(floor).weight(use, 1.0, np.array([2.0, 9.0])).reshape(2, 7)[:, :TRACKS]
        np.testing.assert_allclose((weight**2).sum(axis=1), 1 / (floor**2 + np.array([2.0, 3.0]) ** 2 / 14))


@pytest.mark.parametrize(
    ("scatter", "common"), [(0.1, 0.02), (0.04, 0.02), (0.02, 0.01), (0.005, 0.0025), (0.001, 0.002), (1e-9, 0.002)]
)
def test_an_error_in_common_is_half_of_a_small_scatter_and_never_none(scatter: float, common: float) -> None:
    num = 40_000
    made = observations(0.02, num=num)
    made.is_tie[:] = True
    made.of_reference[:] = False
    weight = made.weight(np.ones(2 * num, dtype=bool), scatter / 0.1).reshape(2, num)
    np.testing.assert_allclose((weight**2).sum(axis=1), min(num / scatter**2, 1.0 / common**2))


def test_the_noise_is_that_of_the_tie_points_alone() -> None:
    num = 30
    made = observations(num=num)
    made.is_tie = np.tile(np.arange(num) < 25, 2)
    made.has_prior[:25] = False
    made.of_reference = ~made.is_tie
    made.is_control[:] = False
    residual = np.where(made.is_tie, 0.2, 9.0) * np.ones((2, 1))
    problem: Any = SimpleNamespace(free=np.array([True] * 5 + [False] * 7))
    use = np.ones(2 * num, dtype=bool)
    freedom = 100 - 75 - 5
    assert made.noise(residual, use, problem, 0) == pytest.approx(np.sqrt(4 * 100 / freedom))
    assert made.noise(residual, use, problem, fitted=1) == 1.0  # of 19 nothing is said
    assert made.noise(0 * residual, use, problem, 0) == 1e-6  # it is divided by


# --- robust rounds ------------------------------------------------------------------------------------------------


def robust(
    monkeypatch, levels: list[float], far: float = 0.0, share: float = 0.0, equal: bool = False
) -> tuple[list[float], list[bool], float, np.ndarray]:
    """Scales of the loss by script: squares over their expectation are chi-squares of such noise, a share far off.

    Also in which rounds it was asked what is smooth, the noise, and what counts in the end.
    """
    n = 4000
    base = np.ones(n) if equal else stats.chi2.ppf((np.arange(n) + 0.5) / n, 2) / 2
    scales: list[float] = []
    smooth: list[bool] = []
    given = iter(levels)
    now = {}

    def squared(self: Any, residual: Any, counted: Any) -> np.ndarray:
        now["s"] = base * next(given, levels[-1]) ** 2
        now["s"][: round(share * n)] = far**2
        return now["s"]

    def loss(scaled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        scales.append(float(np.sqrt(now["s"][-1] / scaled[-1])))
        smooth.append(False)
        return scaled, np.ones_like(scaled)  # all count, so that the noise is that of the script

    def part(*_: Any) -> float:
        smooth[-1] = True
        return 0.0

    made = observations()
    monkeypatch.setattr(Observations, "squared", squared)
    monkeypatch.setattr(made, "is_control", np.zeros(n, dtype=bool))
    monkeypatch.setattr(made, "of_reference", np.zeros(n, dtype=bool))
    monkeypatch.setattr(made, "weight", lambda use, noise: np.ones(n))
    monkeypatch.setattr(rounds, "gauss_newton", lambda problem, state, weight, projected: state)
    monkeypatch.setattr(rounds, "geman_mcclure", loss)
    problem: Any = SimpleNamespace(prepare=lambda params, points: (np.zeros(1), "projected"))
    state: Any = SimpleNamespace(params=None, points=None)
    _, _, counted, noise, _ = _robust(
        problem, made, (state, np.zeros(1), None), np.ones(n, dtype=bool), SimpleNamespace(part=part)
    )  # type: ignore[arg-type]
    return scales[::2], smooth[::2], noise, counted


UNIT = np.sqrt(np.log(2) / MEDIAN)  # the noise that is found where it is 1: squares of two degrees of freedom


def test_a_scale_starts_at_three_of_the_noise_and_shrinks_to_a_quarter_a_round(monkeypatch) -> None:
    scales, smooth, noise, _ = robust(monkeypatch, [40.0, 4.0])
    assert scales == pytest.approx([120.0 * UNIT, 30.0 * UNIT, 12.0 * UNIT], rel=0.02)
    assert scales[1] == pytest.approx(0.25 * scales[0], rel=1e-9)
    assert noise == pytest.approx(4.0 * UNIT, rel=0.02)
    # what is smooth is asked for where the loss is no wider than twelve of the noise before
    assert smooth == [True, True, True]
    scales, smooth, *_ = robust(monkeypatch, [80.0, 4.0])
    assert scales == pytest.approx([240.0 * UNIT, 60.0 * UNIT, 15.0 * UNIT, 12.0 * UNIT], rel=0.02)
    assert smooth == [True, False, True, True]


@pytest.mark.parametrize(("level", "rounds"), [(1.19, 1), (1.21, 2)])
def test_rounds_end_where_the_scale_is_no_more_than_a_fifth_too_wide(monkeypatch, level, rounds) -> None:
    scales, *_ = robust(monkeypatch, [10.0 * level, 10.0])
    assert len(scales) == rounds


def test_where_almost_nothing_is_far_off_there_is_nothing_to_be_careful_about(monkeypatch) -> None:
    """Five sigmas, a thousandth of all, noise of up to one and a half times what is stated."""
    for share, careful in ((0.0008, False), (0.0012, True)):
        scales, *_ = robust(monkeypatch, [30.0, 1.0], far=40.0, share=share)
        assert scales[1] == pytest.approx(0.25 * scales[0] if careful else 3.0 * UNIT, rel=0.1)
    for level, careful in ((1.25, False), (1.45, True)):
        scales, *_ = robust(monkeypatch, [60.0, level], far=0.0)
        assert scales[1] == pytest.approx(0.25 * scales[0] if careful else 3.0 * level * UNIT, rel=0.1)


def test_a_few_that_fit_by_chance_are_no_noise(monkeypatch) -> None:
    """Not below half of what is stated."""
    *_, noise, counted = robust(monkeypatch, [0.01])
    assert noise == 0.5
    np.testing.assert_allclose(counted, 1.0, atol=2e-3)


@pytest.mark.parametrize(("sigmas", "careful"), [(4.9, False), (5.1, True)])
def test_far_off_is_farther_than_five_sigmas_of_the_noise(monkeypatch, sigmas, careful) -> None:
    scales, *_ = robust(monkeypatch, [30.0, 1.0], far=sigmas * UNIT, share=0.01)
    assert scales[1] == pytest.approx(0.25 * scales[0] if careful else 3.0 * UNIT, rel=0.05)


@pytest.mark.parametrize(("ratio", "asked"), [(11.8, True), (12.2, False)])
def test_what_is_smooth_is_asked_where_the_loss_is_no_wider_than_twelve_sigmas(monkeypatch, ratio, asked) -> None:
    _, smooth, *_ = robust(monkeypatch, [4.0 * ratio / 0.75, 4.0])
    assert smooth[:2] == [True, asked]


def test_the_best_fifth_shows_the_least_noise(monkeypatch) -> None:
    *_, noise, _ = robust(monkeypatch, [3.0], equal=True)  # its median would be of less
    assert noise == pytest.approx(3.0 / np.sqrt(0.2), rel=1e-6)
