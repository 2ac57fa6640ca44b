"""What the block says about the priors of its cameras: piece by piece, by the formulas of the variance components."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import Adjustment, AdjustOptions, adjust_tracks
from barpc.ba.constraints.block import join, make_problem
from barpc.ba.parameters.additional_parameters import AdditionalParameters
from barpc.ba.parameters.priors import CameraPrior, prior_sigmas
from barpc.ba.parameters.unknowns import Unknowns
from barpc.ba.robust.posterior import QuadraticProblem
from barpc.ba.robust.variances import PriorTest, Variances, same_prior
from barpc.ba.solving.solve import State, minimise
from barpc.base.errors import BarpcWarning
from barpc.base.geodesy import ecef_from_ground
from barpc.base.statistics import SMALL
from barpc.simulate import SimulatedBlock, simulate_block
from tests.ba.conftest import as_stated, centers_of, solve
from tests.constants import Sized
from tests.distributions import chi2
from tests.lanes import rest_slow


def variances(n: int, model: str = "rotation", drift: int = 0, cautious: bool = False) -> Variances:
    """Priors of N views, the constants' with a standard deviation, drifts' with half of it."""
    unknowns = Unknowns(model, drift, np.zeros((n, 3)), np.ones(n), np.zeros((2, n)), np.ones((2, n)))
    constants = 3 * (unknowns.rotates + unknowns.translates)
    sigmas = np.full((n, unknowns.size), 2.0)
    sigmas[:, constants:] = 1.0
    return Variances(CameraPrior(np.full(sigmas.shape, 0.5), sigmas), unknowns, cautious)


def seen(known: np.ndarray) -> np.ndarray:
    """Shares (N, q) by which unknowns are determined, with those along lines of sight that there are none of."""
    return np.hstack([known, np.zeros((len(known), 1))])


def large(n: int, model: str = "rotation", drift: int = 0, cautious: bool = False) -> Variances:
    """The same as a part of a block so large that it learns once a solve: of degrees of drift that nothing shows."""
    rest = -(-(SMALL + 1) // (3 * n))
    return variances(n, model, drift + rest, cautious)


def learnt(
    v: Variances, params: np.ndarray, known: np.ndarray, last: PriorTest | None = None, now: np.ndarray | None = None,
    fixed: Any = (),
) -> tuple[CameraPrior, PriorTest]:  # fmt: skip
    """What a block says with unknowns (N, q) that its observations determine by so much, of further ones nothing.

    `now` are the standard deviations that it was solved with, where these are not the given ones; `fixed` are numbers
    of unknowns that are not estimated.
    """
    n, size = v.given.sigma.shape
    mean, share, sigma = v.given.mean.copy(), np.zeros((n, size)), v.given.sigma if now is None else now
    mean[:, : params.shape[1]], share[:, : known.shape[1]] = params, known
    free = ~np.isin(np.arange(n * size), fixed)
    variance = (1.0 - share) * np.where(np.isfinite(sigma), sigma, 1.0) ** 2
    covariance = SimpleNamespace(free=free, is_large=False, of_views=lambda: variance[:, :, None] * np.eye(size))
    problem: Any = SimpleNamespace(camera_prior=replace(v.given, sigma=sigma), free=free)
    minimum: Any = SimpleNamespace(state=SimpleNamespace(params=mean), covariance=lambda _: covariance)
    return v.learnt(problem, minimum, last)


def params_of(v: Variances, totals: list[float]) -> np.ndarray:
    """Constants whose squares over their variances have these sums, all in the first unknown of a view."""
    params = v.given.mean.copy()
    params[:, 0] += v.given.sigma[:, 0] * np.sqrt(totals)
    return params


def test_what_is_learnt_are_the_unknowns_in_space() -> None:
    for model, learns in (("rotation", True), ("affine", False)):
        given = variances(2, model)
        for control in (False, True):
            found = Variances.of(given.given, given.unknowns, AdjustOptions(), control)
            assert found.learns == learns
            assert found.cautious == (not control)  # control holds the scene, and the priors need not
    assert [variances(1, model, 1).constants for model in ("rotation", "rotation+translation")] == [3, 6]
    assert variances(1, "affine").constants == 0


def test_a_search_has_priors_as_given_but_for_wide_drifts() -> None:
    """A turn about a centre that flies on is a drift of a hundredth of it."""
    search = variances(2, "rotation+translation", 2).for_search()
    np.testing.assert_allclose(search.sigma[:, :6], 2.0)
    np.testing.assert_allclose(search.sigma[:, 6:9], np.hypot(30.0, 0.02))
    np.testing.assert_allclose(search.sigma[:, 9:], 30.0)
    np.testing.assert_array_equal(search.wider, 1.0)


def test_squares_and_freedom_are_those_of_the_unknowns_that_are_determined() -> None:
    v = replace(large(2, "rotation", 1), stated=np.array([True, False]))
    params = np.array([[2.5, 4.5, 0.5, 2.5, 0.5, 0.5], [0.5, 0.5, 0.5, 0.5, 3.5, 0.5]])
    known = np.array([[1.0, 0.5, 0.25, 0.5, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0, 0.75, 0.0]])
    place, of_stated, count, drift = learnt(v, params, known)[1].shown[:4]
    np.testing.assert_allclose([place, of_stated], [[1.0 + 4.0, 1.75]] * 2)
    assert count.tolist() == [1.0, 0.0]
    np.testing.assert_allclose(drift, [4.0 + 9.0, 1.5 + 1.75])
    # one that is not determined at all does not count, wherever it stands
    params[1, 0] = 99.0
    tested = learnt(v, params, known)[1]
    np.testing.assert_allclose([tested.ratio, tested.freedom], [5.0 / 1.75, 1.75])
    # nor one that is fixed, nor one without a prior of its own, nor one that is less known than before
    assert learnt(v, params, known, fixed=[2])[1].freedom == pytest.approx(1.5)
    without = v.given.sigma.copy()
    without[0, 1] = np.inf
    assert learnt(v, params, known, now=without)[1].freedom == pytest.approx(1.25)
    known[0, 0] = -0.25
    assert learnt(v, params, known)[1].freedom == pytest.approx(0.75)


def test_drifts_are_as_large_as_they_show_with_the_given_ones_counting_for_four() -> None:
    v = large(2, "rotation", 2)
    params, known = v.given.mean.copy(), np.ones((2, 9))
    params[:, 3] += 3.0  # sigma 1: squares 9 and 9 of 6 degrees
    params[0, 6] += 2.0
    prior, tested = learnt(v, params, known)
    expected = np.sqrt([(4 + 18) / (4 + 6), (4 + 4) / (4 + 6), 1.0])
    np.testing.assert_allclose(tested.wide[:3], expected)
    np.testing.assert_allclose(prior.sigma[:, 6:12], [np.repeat(expected[1:], 3)] * 2)
    assert tested.wide[-1] == 1.0


def test_a_drift_grows_thirtyfold_at_most_from_one_linearisation_to_the_next() -> None:
    """One that the observations hardly determine is anywhere in what is linear."""
    v = large(2, "rotation", 1)
    params, known = v.given.mean.copy(), np.ones((2, 6))
    params[:, 3] += 1e6
    first = learnt(v, params, known)[1]
    assert (first.wide[0], first.wide[-1]) == (30.0, 1.0)
    assert learnt(v, params, known, first)[1].wide[0] == 900.0


@pytest.mark.parametrize("cautious", [False, True])
@pytest.mark.parametrize(("share", "unexpected"), [(0.95, False), (1.05, True)])
def test_drifts_of_another_platform_are_let_be_as_large_as_they_may_be(cautious, share, unexpected) -> None:
    """As large as leaves a tenth of chance to something smaller; those of a thousandth's chance only."""
    v = large(2, "rotation", 1, cautious)
    total = share * chi2.isf(1e-3, 6)
    params, known = v.given.mean.copy(), np.ones((2, 6))
    params[0, 4] += np.sqrt(total)
    likely, possible = (4 + total) / (4 + 6), total / chi2.ppf(0.1, 6)
    assert possible > likely
    expected = possible if cautious and unexpected else likely
    np.testing.assert_allclose(learnt(v, params, known)[1].wide[0], np.sqrt(expected))
    np.testing.assert_allclose(learnt(v, params, 0.49 / 6 * known)[1].wide[0], np.sqrt((4 + total) / (4 + 0.49)))


@pytest.mark.parametrize("cautious", [False, True])
@pytest.mark.parametrize("totals", [[18.0, 6.0], [7.0, 6.0], [6.0, 6.0], [0.5, 0.4]])
def test_two_views_are_widened_together_and_without_control_rather_too_wide_than_too_narrow(cautious, totals) -> None:
    """Where they are too large for one chance in twenty, and never narrowed."""
    v = large(2, cautious=cautious)
    prior, tested = learnt(v, params_of(v, totals), np.ones((2, 3)))
    likely, possible = (4 + sum(totals)) / (4 + 6), sum(totals) / chi2.ppf(0.1, 6)
    expected = 1.0 if sum(totals) < chi2.isf(0.05, 6) else max(likely, possible) if cautious else likely
    np.testing.assert_allclose(tested.scale, np.sqrt(expected))
    np.testing.assert_allclose(prior.sigma[:, :3], 2.0 * np.sqrt(expected))
    assert not tested.odd.any()


@pytest.mark.parametrize(("share", "large"), [(0.97, False), (1.03, True)])
def test_corrections_are_too_large_where_chance_has_five_percent(share: float, large: bool) -> None:
    v, n = variances(6), 6
    known = np.ones((n, 3))
    params = params_of(v, [share * chi2.isf(0.05, 18) / 6] * 6)
    assert v._too_large(params, seen(known), np.ones(n)) == large
    assert not v._too_large(params, seen(known), np.full(n, 1.1))
    assert not v._too_large(params, seen(0.49 / 18 * known), np.ones(n))  # nothing is determined
    assert v._too_large(params_of(v, [99.0] * 6), seen(0.51 / 18 * known), np.ones(n))


def told(n: int, stated: float, off: dict[int, float], seed: int = 0) -> PriorTest:
    """What a block of n views says of its priors: all corrections are `stated` times what is stated, but for some."""
    block = simulate_block(n, 60 * n, seed=seed, attitude=5e-6)
    views = list(block.views)
    for view, pixels in off.items():
        views[view] = replace(views[view], sensor=views[view].sensor.crop(pixels, -0.7 * pixels))
    return adjusted(
        replace(block, views=tuple(views)), sigma_attitude=3.47 / stated, sigma_position=1.0 / stated,
        min_convergence=0.01, jitter="off",
    ).prior  # fmt: skip


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(("n", "wrong"), [(9, 4), (40, 17), (72, 33)])  # dense, by blocks, and of 432 unknowns
def test_what_is_said_of_views_does_not_depend_on_how_many_there_are(n: int, wrong: int) -> None:
    """As stated; all worse than stated; one far off; in a larger block both."""
    cases: list[tuple[float, dict[int, float]]] = [(1.0, {}), (6.0, {}), (1.0, {wrong: 70.0})]
    for stated, off in (*cases, *([(6.0, {wrong: 40.0})] if n == 40 else [])):
        prior = told(n, stated, off)
        assert np.flatnonzero(prior.odd).tolist() == [*off]
        others = np.delete(prior.scale, [*off])
        np.testing.assert_array_equal(others, others[0])
        assert others[0] == pytest.approx(stated, rel=0.0 if stated == 1.0 else 0.2)
        for view in off:
            assert prior.scale[view] > 3.0 * others[0]


@pytest.mark.parametrize(("n", "wrong", "pixels"), [(3, 1, 30.0), (4, 1, 50.0), (5, 2, 30.0)])
def test_a_view_that_alone_may_be_wrong_is_named_where_all_may_be(n: int, wrong: int, pixels: float) -> None:
    """Of few views an error of one is hardly likelier than larger errors of all; without an error none is named."""
    for seed in (0, 1):
        assert told(n, 1.0, {}, seed).perhaps_odd is None
        prior = told(n, 1.0, {wrong: pixels}, seed)
        assert not prior.odd.any()
        assert prior.scale.min() > 1.5
        assert prior.perhaps_odd is not None
        assert prior.perhaps_odd[wrong]
        assert prior.perhaps_odd.sum() <= n // 3 + 2


@pytest.mark.slow
def test_many_views_that_are_far_off_are_all_named() -> None:
    """Those of a large block that share no points are found at once, one beside another after it."""
    off = {3: 60.0, 4: -50.0, 20: 70.0, 41: -60.0, 60: 60.0, 61: 60.0}
    prior = told(72, 1.0, off)
    assert np.flatnonzero(prior.odd).tolist() == [*off]
    assert (prior.scale[prior.odd] > 3.0).all()
    np.testing.assert_array_equal(prior.scale[~prior.odd], 1.0)


def evidences(monkeypatch, v: Variances, alone: float, together: float) -> tuple[np.ndarray, ...]:
    """Widened where one odd view, the first, has one evidence and all together have another."""

    def odd(self: Variances, around: Any, wide: Any, usual: np.ndarray, rival: float | None = None) -> Any:
        if rival is None:
            return usual, np.zeros(3, dtype=bool), together
        assert rival == together
        return np.array([9.0, 1.0, 1.0]), np.array([True, False, False]), alone

    monkeypatch.setattr(Variances, "_odd", odd)
    around: Any = SimpleNamespace(problem=SimpleNamespace(free=None), small=False)
    return v._widened(around, params_of(v, [600.0, 3.0, 3.0]), seen(np.ones((3, 3))), np.ones(1))


def test_of_two_explanations_the_clearly_likelier_one_is_taken_and_else_both(monkeypatch) -> None:
    v = variances(3)
    common = np.sqrt((4 + 606) / (4 + 9))
    scale, odd, perhaps = evidences(monkeypatch, v, 3.1, 0.0)  # more than twenty times as likely
    assert odd.tolist() == [True, False, False]
    assert perhaps is None
    np.testing.assert_allclose(scale, [9.0, 1.0, 1.0])
    for alone in (2.9, 0.0, -4.9):
        scale, odd, perhaps = evidences(monkeypatch, v, alone, 0.0)
        assert not odd.any()
        assert perhaps.tolist() == [True, False, False]
        np.testing.assert_allclose(scale, [max(9.0, common), common, common])
    scale, odd, perhaps = evidences(monkeypatch, v, -5.1, 0.0)
    assert not odd.any()
    assert perhaps is None
    np.testing.assert_allclose(scale, common)


def forward(
    monkeypatch, gains: dict[tuple[int, ...], float], n: int = 6, rival: float | None = 0.0, pairs: Any = None
) -> tuple[list[int], np.ndarray, float]:
    """Views that are odd by evidences of sets of views; every one of them wants its number plus two as a factor."""

    def chosen(scale: np.ndarray) -> tuple[int, ...]:
        return tuple(np.flatnonzero(scale != 1.0).tolist())

    def alone(self: Variances, known: Any, wide: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sets = [tuple(sorted({*chosen(scale), v})) for v in range(n)]
        return np.array([gains.get(one, 0.0) for one in sets]), np.arange(n) + 2.0

    def posterior(prior: CameraPrior, around: Any = None) -> Any:
        odd = chosen(prior.sigma[:, 0] / v.given.sigma[:, 0])
        return SimpleNamespace(evidence=gains.get(odd, 0.0), together=lambda _, prior: posterior(prior))

    v = variances(n)
    monkeypatch.setattr(Variances, "_alone", alone)
    every = np.stack(np.triu_indices(n, 1), axis=1) if pairs is None else np.array(pairs)
    around: Any = SimpleNamespace(
        posterior=posterior, problem=SimpleNamespace(structure=SimpleNamespace(pair_view=every))
    )
    scale, odd, evidence = v._odd(around, np.ones(1), np.ones(n), rival)
    return np.flatnonzero(odd).tolist(), scale, evidence


CHOICE = float(np.log(6.0))  # of one of six views


def test_odd_views_are_added_as_long_as_each_makes_it_clearly_likelier(monkeypatch) -> None:
    odd, scale, evidence = forward(monkeypatch, {(1,): 20.0, (1, 4): 25.1, (4,): 3.0})
    assert odd == [1, 4]
    assert evidence == pytest.approx(25.1 - 2 * CHOICE)
    np.testing.assert_array_equal(scale, [1, 3, 1, 1, 6, 1])
    odd, _, evidence = forward(monkeypatch, {(1,): 20.0, (1, 4): 24.9})
    assert (odd, evidence) == ([1], pytest.approx(20.0 - CHOICE))
    # no more than a third of the views
    assert forward(monkeypatch, {(1,): 20.0, (1, 4): 40.0, (0, 1, 4): 90.0})[0] == [1, 4]
    assert forward(monkeypatch, {(0,): 20.0, (0, 1): 40.0}, 3)[0] == [0]


def test_one_at_least_is_odd_beside_a_rival_and_none_beside_all_that_are_wide(monkeypatch) -> None:
    assert 2 in forward(monkeypatch, {(2,): 4.0})[0]
    assert forward(monkeypatch, {(2,): 4.0}, rival=None)[0] == []
    assert forward(monkeypatch, {(2,): 5.1}, rival=None)[0] == [2]


def test_what_cannot_come_near_its_rival_any_more_is_left(monkeypatch) -> None:
    """Two of six may be odd, and together they add no more than each by itself."""
    gains = {(1,): 20.0, (4,): 12.0, (1, 4): 31.0}
    assert forward(monkeypatch, gains, rival=35.9)[0] == [1, 4]
    odd, scale, evidence = forward(monkeypatch, gains, rival=37.1)
    assert (odd, evidence) == ([], -np.inf)
    np.testing.assert_array_equal(scale, 1.0)


def test_views_that_share_no_points_are_added_at_once_and_neighbours_one_by_one(monkeypatch) -> None:
    pairs = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]
    gains = {(1,): 20.0, (2,): 15.5, (4,): 12.0, (1, 4): 32.0}
    odd, scale, evidence = forward(monkeypatch, gains, pairs=pairs, rival=None)
    assert odd == [1, 2, 4]  # the second explains nearly as well what the first does
    assert evidence == pytest.approx(32.0 - 2 * CHOICE)
    np.testing.assert_array_equal(scale, [1, 3, 4, 1, 6, 1])


def test_what_explains_as_well_as_the_best_is_odd_too(monkeypatch) -> None:
    odd, scale, _ = forward(monkeypatch, {(1,): 20.0, (2,): 15.1, (3,): 14.9})
    assert odd == [1, 2]
    np.testing.assert_array_equal(scale, [1, 3, 4, 1, 1, 1])


def test_priors_are_the_same_within_a_share_of_their_logarithms() -> None:
    prior = CameraPrior(np.zeros((1, 3)), np.array([[1.0, 2.0, np.inf]]))
    for factor, same in ((1.0, True), (1.21, True), (1 / 1.21, True), (1.23, False), (1 / 1.23, False)):
        assert same_prior(prior, CameraPrior(prior.mean, prior.sigma * [[1.0, factor, 1.0]]), 0.2) == same
    assert same_prior(prior, CameraPrior(prior.mean, np.array([[1.0, np.inf, np.inf]])), 0.2)


# --- on a block ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("n", rest_slow([50, 300], mark=pytest.mark.nightly))
def test_variances_of_a_large_block_are_exact_where_they_are_stated_and_probed_within_their_bound(
    sized: Sized, n: int
) -> None:
    """Against the inverse of the whole matrix (9 unknowns a view), whose drifts are a hundredth of the rotations."""
    block = simulate_block(n, 20 * n, seed=1, num_checks=0)
    if n < 300:
        sized(dense_views=0)
        sized(dense_unknowns=0)
    options = AdjustOptions(**({"min_convergence": 60.0} if n < 300 else {}))
    with pytest.warns(BarpcWarning, match="constrained in height"):  # they share an error, taken off the sparse matrix
        found = adjust_tracks(block.views, block.tracks, options, centers=centers_of(block))
    covariance = found.covariance
    assert covariance.is_large
    by_camera = covariance.reduced.common.by_camera
    matrix = covariance.reduced.matrix.plain() - by_camera.T @ by_camera
    true = np.linalg.inv(matrix).diagonal().reshape(n, 9)
    np.testing.assert_allclose(covariance.variances(), true, rtol=1e-6)
    off = covariance.probed_views().diagonal(axis1=1, axis2=2) / true - 1
    by_unknown = np.sqrt((off**2).mean(axis=0))
    assert (by_unknown > 0.05).all()  # they are probed, indeed
    assert (by_unknown < 0.3).all()
    assert (abs(off.mean(axis=0)) < 0.05).all()
    prior = prior_sigmas(block.views, found.options, 1, None, 0)
    known = 1 - true[:, :6] / prior[:, :6] ** 2
    turn, blocks = found.cameras.unknowns.sight / prior, covariance.of_views()
    along = 1 - ((turn[:, None] @ blocks)[:, 0] * turn).sum(axis=1)
    np.testing.assert_allclose(found.prior.freedom, known.sum() - along.sum(), rtol=1e-6)


@pytest.fixture(scope="module")
def made() -> SimulatedBlock:
    return simulate_block(3, 200, seed=5, attitude=5e-6)


@pytest.mark.parametrize("fixed", [(), ("view_0001",)])
def test_the_problem_under_other_priors_is_the_one_solved_with_them(made, fixed: tuple[str, ...]) -> None:
    """Unknowns, covariance and the ratio of the evidences, against minimising again."""
    options = AdjustOptions(drift=0, sigma_attitude=3.5, sigma_position=1.0, fixed=fixed)
    problem = make_problem(join(made.views, made.tracks, None, options), options, centers_of(made), None)
    mean = np.random.default_rng(3).normal(0, 2, (3, 6)) * problem.free.reshape(3, 6)
    problem = replace(problem, camera_prior=replace(problem.camera_prior, mean=mean))
    free = problem.free
    weight = np.full(len(problem.structure.view), 10.0)
    state = State(mean, ecef_from_ground(made.truth.ground))
    found, other = [], CameraPrior(mean, np.array([[9.0] * 6, [1.0] * 6, [2.0] * 3 + [5.0] * 3]))
    for prior in (problem.camera_prior, other):
        given = replace(problem, camera_prior=prior)
        minimum = minimise(given, state, weight, "sparse", 1e-14)
        matrix = minimum.reduced.plain(free)
        volume = np.linalg.slogdet(matrix)[1] + 2 * np.log(prior.sigma.ravel()[free]).sum()
        found.append((minimum, -0.5 * (minimum.state.cost + volume), np.linalg.inv(matrix)))
    around = QuadraticProblem(problem, found[0][0])
    (same, unmoved, _), (evidence, params, covariance) = (around.under(problem.camera_prior), around.under(other))
    assert evidence - same == pytest.approx(found[1][1] - found[0][1], abs=0.02)
    np.testing.assert_array_equal(unmoved, found[0][0].state.params)
    np.testing.assert_allclose(params, found[1][0].state.params, atol=2e-3)
    np.testing.assert_allclose(covariance.full[np.ix_(free, free)], found[1][2], rtol=2e-3, atol=1e-3)
    assert np.abs(params - unmoved).max() > 0.3


@pytest.mark.parametrize("n", [6, 40, pytest.param(120, marks=pytest.mark.slow)])  # dense, and by blocks
def test_other_priors_of_single_views_are_an_update_of_what_is_known(n: int) -> None:
    """Evidence, unknowns and covariance of every view: as factorised anew; a fixed view changes nothing."""
    block = simulate_block(n, 40 * n, seed=2)
    options = AdjustOptions(sigma_attitude=2.0, sigma_position=0.3, fixed=("view_0001",), min_convergence=0.01)
    problem = make_problem(join(block.views, block.tracks, None, options), options, centers_of(block), None)
    weight = np.full(len(problem.structure.view), 5.0)
    state = State(problem.camera_prior.mean, ecef_from_ground(block.truth.ground))
    around = QuadraticProblem(problem, minimise(problem, state, weight, "sparse", 1e-10))
    wider = problem.camera_prior.sigma * np.random.default_rng(0).uniform(1.0, 50.0, (n, 1))
    known, prior = around.posterior(problem.camera_prior), problem.camera_prior
    evidence, offset, blocks = known.alone(replace(prior, sigma=wider))
    for view in (0, 1, n // 2, n - 1):
        alone = replace(prior, sigma=np.where(np.arange(n)[:, None] == view, wider, prior.sigma))
        exact = around.posterior(alone)
        assert evidence[view] - known.evidence == pytest.approx(exact.evidence - known.evidence, abs=1e-6)
        np.testing.assert_allclose(offset[view], exact.offset[view], atol=1e-6)
        np.testing.assert_allclose(blocks[view], exact.blocks[view], rtol=1e-6, atol=1e-9 * np.abs(exact.blocks).max())
        if view == 1:
            assert evidence[view] == pytest.approx(known.evidence, abs=1e-6)
    assert (evidence > known.evidence + 20.0).any()
    now, scale = known, np.ones((n, 1))
    for views in ([0, n // 2], [1], [n - 1, 3]):  # one after the other, several at once
        scale[views] = np.random.default_rng(n).uniform(2.0, 50.0, (len(views), 1))
        now = now.together(np.array(views), replace(prior, sigma=prior.sigma * scale))
    exact = around.posterior(now.prior)
    assert now.evidence - known.evidence == pytest.approx(exact.evidence - known.evidence, abs=1e-6)
    np.testing.assert_allclose(now.offset, exact.offset, atol=1e-6)
    np.testing.assert_allclose(now.blocks, exact.blocks, rtol=1e-6, atol=1e-9 * np.abs(exact.blocks).max())


def adjusted(block: SimulatedBlock, **options: Any) -> Adjustment:
    return solve(block, drift=0, hold_out=False, **options)


@pytest.mark.slow
def test_priors_that_hold_have_a_ratio_of_one_and_stand() -> None:
    ratio, freedom = [], []
    for seed in range(8):
        block = simulate_block(4, 150, seed=seed, attitude=5e-6)
        prior = adjusted(block, sigma_attitude=3.47, sigma_position=1.0).prior
        ratio.append(prior.ratio)
        freedom.append(prior.freedom)
        assert prior.scale.max() < 1.6
    # of 24 unknowns the scene's motions stay with the priors, of rotations and translations that look alike one, and
    # what is along the lines of sight counts by itself
    assert 4 < np.mean(freedom) < 8
    assert np.mean(ratio) == pytest.approx(1.0, abs=2.0 * np.sqrt(2.0 / np.sum(freedom)))


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [3.0, 10.0])
def test_priors_that_are_too_narrow_are_widened_by_as_much(wrong: float) -> None:
    scale = []
    for seed in range(5):
        block = simulate_block(4, 150, seed=seed, attitude=5e-6)
        prior = adjusted(block, sigma_attitude=3.47 / wrong, sigma_position=1.0 / wrong).prior
        assert prior.ratio == pytest.approx(wrong**2, rel=0.9)
        assert not prior.odd.any()
        scale.append(np.median(prior.scale))
    assert 0.9 * wrong < np.median(scale) < 2.0 * wrong  # rather too wide


@pytest.mark.slow
@pytest.mark.parametrize(("wrong", "by"), [(2, (200.0, -150.0)), (1, (0.0, 300.0))])
def test_one_view_that_is_far_off_is_named_and_the_others_keep_their_priors(
    wrong: int, by: tuple[float, float]
) -> None:
    """Of three images two agree in one number only, which chance does once in 20 where all are 25 times worse than
    stated: it may be open, and is covered, whether it is one, where that is off across the flight.
    """
    across = by[0] != 0.0
    for seed in range(3):
        block = simulate_block(3, 150, seed=seed, attitude=5e-6)
        views = list(block.views)
        views[wrong] = replace(views[wrong], sensor=views[wrong].sensor.crop(*by))
        prior = adjusted(replace(block, views=tuple(views)), sigma_attitude=3.47, sigma_position=1.0).prior
        named = np.flatnonzero(prior.odd).tolist()
        assert named == [wrong] or (not named and across)
        assert 20.0 < prior.scale[wrong] < 90.0  # 250 or 300 px of 0.7 m are 50 or 60 sigmas
        assert prior.scale[wrong] == prior.scale.max()
        if named:
            np.testing.assert_array_equal(np.delete(prior.scale, wrong), 1.0)
        assert 50.0 < prior.ratio < 400.0


# --- how it is learnt -------------------------------------------------------------------------------------------------


def waved(n: int = 3, cautious: bool = False) -> Variances:
    """Priors of views of a large block with splines and a step."""
    unknowns = Unknowns(
        "rotation", 1 + SMALL // (3 * n), np.zeros((n, 3)), np.ones(n), np.zeros((2, n)), np.ones((2, n)),
        waves=AdditionalParameters(9, np.full((n, 2), 5.0)),
    )  # fmt: skip
    sigma = np.full((n, unknowns.size), 2.0)
    sigma[:, unknowns.in_waves] = 0.3
    return Variances(CameraPrior(np.zeros(sigma.shape), sigma), unknowns, cautious)


def test_splines_and_steps_are_as_large_as_each_view_shows_and_all_do() -> None:
    """Band by band; that of all views counts as four observations beside a view's own, 0.02 px as one beside all."""
    v, rng = waved(), np.random.default_rng(0)
    first, bands = v.unknowns.in_waves.start, v.unknowns.waves.bands
    sigma, shape = 5.0 * v.given.sigma, v.given.sigma.shape
    sigma[2, first:] = np.inf  # of an earlier block, whose matrix tells
    params, known = rng.normal(0, 0.1, shape), rng.uniform(0, 1, shape)
    params[:, :first] = 0.0
    known[:, :first] = 0.0
    found = learnt(v, params, known, now=sigma)[0].sigma
    np.testing.assert_allclose(found[:, :3], 2.0)  # no other prior follows
    np.testing.assert_allclose(found[:, 3:first], np.hypot(2.0, [0.02] * 3 + [0.0] * (first - 6))[None].repeat(3, 0))
    assert np.isinf(found[2, first:]).all()
    for band in np.unique(bands):
        rows = first + np.flatnonzero(bands == band)
        squares = [sum(params[view, k] ** 2 for k in rows) for view in (0, 1)]
        freedom = [sum(known[view, k] for k in rows) for view in (0, 1)]
        common = (0.02**2 + sum(squares)) / (1 + sum(freedom))
        for view in (0, 1):
            expected = np.sqrt((4 * common + squares[view]) / (4 + freedom[view]))
            np.testing.assert_allclose(found[view, rows], expected)
    np.testing.assert_array_equal(v.given.sigma[:, first:], 0.3)
    assert v.learn_waves
    assert not variances(2).learn_waves


def test_where_waves_are_followed_a_drift_is_as_large_as_it_shows() -> None:
    """Whatever control there is: what else bends heights is followed."""
    v = waved(2, cautious=True)
    params, known = np.zeros((2, 6)), np.ones((2, 6))
    params[0, 3] = 30.0
    tested = learnt(v, params, known)[1]
    np.testing.assert_allclose([tested.wide[0], tested.wide[-1]], np.sqrt([(4 + 225) / (4 + 6), 1.0]))


@pytest.fixture(scope="module")
def at_minimum() -> tuple[Any, Any]:
    """Four views with a drift of four times what is expected, and their minimum under the first priors."""
    made = simulate_block(4, 150, seed=2, attitude=5e-6, drift=2e-6)
    options = AdjustOptions(drift=1, sigma_attitude=3.5, sigma_position=1.0)
    problem = make_problem(join(made.views, made.tracks, None, options), options, centers_of(made), None)
    problem = replace(problem, camera_prior=replace(problem.camera_prior, sight=None))  # all constants are of one kind
    weight = np.full(len(problem.structure.view), 10.0)
    state = State(problem.camera_prior.mean, ecef_from_ground(made.truth.ground))
    return problem, minimise(problem, state, weight, "sparse", 1e-14)


def determined(problem: Any, minimum: Any, sigma: np.ndarray) -> np.ndarray:
    """How far each unknown is determined under the priors of the problem, by the inverse of the whole matrix."""
    inverse = np.linalg.inv(minimum.reduced.plain(problem.free))
    return (1 - inverse.diagonal().reshape(sigma.shape) / sigma**2).clip(0, 1)


def test_a_large_block_learns_once_a_solve(at_minimum, sized: Sized) -> None:
    """By the covariance at hand: the drift of all views by its squares, the constants by those of most."""
    problem, minimum = at_minimum
    sized(unknowns_tried=0)
    sigma, params = problem.camera_prior.sigma, minimum.state.params
    known = determined(problem, minimum, sigma)
    squares = (params / sigma) ** 2
    v = Variances(problem.camera_prior, problem.cameras.unknowns, False)
    prior, tested = v.learnt(problem, minimum)
    total, freedom = squares[:, :6].sum(), known[:, :6].sum()
    assert tested.ratio == pytest.approx(total / freedom)
    assert tested.freedom == pytest.approx(freedom)
    assert chi2.sf(total, freedom) > 0.05  # as stated
    np.testing.assert_array_equal(tested.scale, 1.0)
    assert not tested.odd.any()
    wide = np.sqrt((4 + squares[:, 6:].sum()) / (4 + known[:, 6:].sum()))
    assert wide > 1.5
    drift = np.hypot(wide * sigma[:, 6:], 0.01 * sigma[:, :3])
    np.testing.assert_allclose(prior.sigma[:, 6:], drift)
    np.testing.assert_array_equal(prior.sigma[:, :6], sigma[:, :6])
    assert tested.drift_sigma == pytest.approx([np.median(drift[:, 0])])


def test_priors_that_are_too_narrow_are_widened_by_what_all_views_show(at_minimum, sized: Sized) -> None:
    problem, minimum = at_minimum
    sized(unknowns_tried=0)
    narrow = problem.camera_prior.sigma.copy()
    narrow[:, :6] /= 5.0
    known = determined(problem, minimum, problem.camera_prior.sigma)
    v = Variances(CameraPrior(problem.camera_prior.mean, narrow), problem.cameras.unknowns, False)
    last = PriorTest(1.0, 2.0, np.full(4, 2.0), np.zeros(4, dtype=bool), ())  # widened before: the drift stands
    prior, tested = v.learnt(problem, minimum, last)
    total, freedom = (minimum.state.params[:, :6] / narrow[:, :6]) ** 2, known[:, :6]
    factor = (4 + total.sum()) / (4 + freedom.sum())
    assert not tested.odd.any()  # whether one view or all are worse than stated is open: the priors cover both
    np.testing.assert_allclose(np.sort(tested.scale)[:3], np.sqrt(factor))
    assert tested.scale.max() > 3.0 * np.sqrt(factor) > 5.0
    np.testing.assert_allclose(prior.sigma[:, :6], narrow[:, :6] * tested.scale[:, None])
    with as_stated():
        told = v.learnt(problem, minimum)
    np.testing.assert_array_equal(told[0].sigma, narrow)
    np.testing.assert_array_equal(told[1].scale, 1.0)
    assert told[1].ratio == pytest.approx(tested.ratio) == pytest.approx(total.sum() / freedom.sum())


def test_constants_of_a_large_block_once_widened_stay(at_minimum, sized: Sized) -> None:
    """They take from the drift, which is another then: asked whether it stands it would send them back, in turns."""
    problem, minimum = at_minimum
    sized(unknowns_tried=0)
    given = CameraPrior(problem.camera_prior.mean, problem.camera_prior.sigma.copy())
    given.sigma[:, :6] /= 30.0
    v = Variances(given, problem.cameras.unknowns, False)
    tested, priors, scales = None, [given], []
    for _ in range(12):
        now = replace(problem, camera_prior=priors[-1])
        there = minimise(now, minimum.state, np.full(len(problem.structure.view), 10.0), "sparse", 1e-12)
        prior, tested = v.learnt(now, there, tested)
        priors.append(prior)
        scales.append(tested.scale.min())
    first = np.flatnonzero(np.array(scales) > 1.0)[0]
    assert min(scales[first:]) > 3.0
    assert same_prior(priors[-1], priors[-2], 0.2)


def test_a_small_block_learns_until_its_priors_stand(at_minimum) -> None:
    """Those it ends with are what they would be after solving with them, wherever it began."""
    problem, minimum = at_minimum
    narrow = problem.camera_prior.sigma.copy()
    narrow[:, 6:] = 0.05
    v = Variances(CameraPrior(problem.camera_prior.mean, narrow), problem.cameras.unknowns, False)
    prior, tested = v.learnt(problem, minimum)

    def solved(sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        given = replace(problem, camera_prior=CameraPrior(problem.camera_prior.mean, sigma))
        there = minimise(given, minimum.state, np.full(len(problem.structure.view), 10.0), "sparse", 1e-14)
        return ((there.state.params / narrow) ** 2), determined(given, there, sigma)

    squares, known = solved(prior.sigma)
    wide = np.sqrt((4 + squares[:, 6:].sum()) / (4 + known[:, 6:].sum()))
    assert tested.drift_sigma[0] == pytest.approx(np.hypot(wide * 0.05, 0.035), rel=0.06)
    # as given, before anything was learnt
    started = narrow.copy()
    started[:, 6:] = np.hypot(0.05, 0.01 * narrow[:, :3])
    squares, known = solved(started)
    assert tested.ratio == pytest.approx(squares[:, :6].sum() / known[:, :6].sum(), rel=1e-3)
    assert tested.freedom == pytest.approx(known[:, :6].sum(), rel=1e-3)


def test_a_matrix_that_does_not_factorise_leaves_the_priors_as_they_are(at_minimum, sized: Sized, caplog) -> None:
    problem, minimum = at_minimum
    sized(unknowns_tried=0)

    def fails(*_: Any) -> None:
        raise np.linalg.LinAlgError("not positive definite")

    covariance = SimpleNamespace(free=problem.free, is_large=False, of_views=fails)
    unsolved: Any = SimpleNamespace(state=minimum.state, covariance=lambda _: covariance)
    prior, tested = Variances(problem.camera_prior, problem.cameras.unknowns, False).learnt(problem, unsolved)
    assert prior is problem.camera_prior
    assert np.isnan(tested.ratio)
    assert (tested.freedom, tested.drift_sigma) == (0.0, ())
    np.testing.assert_array_equal(tested.scale, 1.0)
    assert not tested.odd.any()
    assert tested.failed
    assert tested.shared == 1.0
    assert not caplog.records  # the last one alone is told: on the way to it much is tried


@pytest.mark.parametrize(("unknowns", "small"), [(400, True), (401, False)])
def test_every_view_is_tried_up_to_four_hundred_unknowns(unknowns: int, small: bool) -> None:
    problem: Any = SimpleNamespace(free=np.zeros(unknowns, dtype=bool))  # fixed ones, too
    around: Any = QuadraticProblem(problem, None)  # type: ignore[arg-type]
    assert around.small == small


@pytest.mark.parametrize(("model", "unknowns"), [("rotation", 3), ("rotation+translation", 6)])
@pytest.mark.parametrize("size", [0.0, 2.0, 3.0, 90.0])
def test_views_that_state_an_accuracy_share_what_they_are_off_by(model: str, unknowns: int, size: float) -> None:
    """As far as their corrections leave room: what is independent is as large as a thousandth's chance lets it."""
    v = replace(large(4, model, 1), stated=np.array([True, False, True, True]))
    params, known = v.given.mean.copy(), np.full((4, unknowns + 3), 0.5)
    params[0, 1] += size * 2.0  # of a standard deviation of 2
    params[1, :unknowns] += 99.0
    params[2, unknowns] += 50.0  # while the drift is learnt the constants are not
    known[3] = 0.0  # of this view nothing is determined

    def shared(v: Variances, known: np.ndarray) -> np.ndarray:
        return learnt(v, params, known)[0].sigma[:, 0] / 2.0

    freedom = 0.5 * 2 * unknowns
    alone = min(size**2 / chi2.ppf(1e-3, freedom), 1.0)
    expected = np.sqrt(max(alone + (1 - alone) * 2 * 3 / unknowns, 1.0))
    np.testing.assert_allclose(shared(v, known), [expected, 1.0, expected, expected])
    assert learnt(v, params, known)[1].shared == pytest.approx(expected)
    np.testing.assert_array_equal(shared(v, 0.49 / freedom * known), 1.0)  # nothing is determined
    np.testing.assert_array_equal(shared(replace(v, stated=None), known), 1.0)
