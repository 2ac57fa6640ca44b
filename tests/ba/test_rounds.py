"""The rounds: what they do to clean and to dirty blocks, and that they end where nothing changes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks, solution
from barpc.ba.constraints.block import first_state, join, make_problem
from barpc.ba.parameters.priors import CameraPrior
from barpc.ba.robust import rounds
from barpc.ba.robust.rounds import weighted_median
from barpc.ba.robust.systematic_residuals import SmoothTest
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import Minimum, State
from barpc.simulate import SimulatedBlock, simulate_block
from tests.ba.conftest import centers_of, solve
from tests.lanes import known

CALM = {"drift": 0, "hold_out": False}


@pytest.fixture(scope="module")
def clean() -> SimulatedBlock:
    return simulate_block(3, 150, seed=5)


def seen(monkeypatch: pytest.MonkeyPatch, module: Any, name: str) -> list[tuple[Any, ...]]:
    """The arguments of every call of a module's function from now on."""
    calls, function = [], getattr(module, name)

    def watched(*given: Any) -> Any:
        calls.append(given)
        return function(*given)

    monkeypatch.setattr(module, name, watched)
    return calls


def moved_together(block: SimulatedBlock, view: int, share: float, by: float) -> SimulatedBlock:
    """A share of the observations of a view moved by the same amount [px] along the columns."""
    tracks, xy = block.tracks, block.tracks.xy.copy()
    mine = np.flatnonzero(tracks.view == view)
    xy[mine[: round(share * len(mine))], 0] += by
    return replace(block, tracks=replace(tracks, xy=xy))


def test_a_clean_block_is_solved_twice_and_nothing_is_looked_at_again(clean, monkeypatch) -> None:
    again = seen(monkeypatch, rounds, "retriangulate_rejected"), seen(monkeypatch, solution, "agreeing")
    solves = seen(monkeypatch, rounds, "minimise")
    found = solve(clean, **CALM)
    assert found.status.startswith("2 passes of cutting")
    assert again == ([], [])
    coarse, exact = (given[4] for given in solves)
    assert coarse > 1e-3  # the second pass follows always
    assert exact <= 1e-6


def test_rounds_go_on_until_the_noise_stands(clean) -> None:
    tracks = replace(clean.tracks, sigma=np.full(len(clean.tracks), 0.02))  # five times the noise stated
    found = solve(replace(clean, tracks=tracks), **CALM)
    assert 2 <= int(found.status.split()[0]) <= 4
    assert found.noise == pytest.approx(5.0, rel=0.1)


def test_a_view_that_lost_much_is_solved_again_from_an_agreement(clean, monkeypatch) -> None:
    again = seen(monkeypatch, solution, "agreeing")
    for share, asked in ((0.15, 0), (0.25, 1)):
        again.clear()
        found = solve(moved_together(clean, 1, share, 40.0), **CALM)
        assert len(again) == asked
        assert found.inlier[clean.tracks.view == 1].mean() == pytest.approx(1 - share, abs=0.02)


@pytest.mark.parametrize(
    ("gcps", "ties", "asked"), [(0, True, [False]), (5, True, [False, False]), (5, False, [True, False])]
)
def test_control_is_let_in_after_the_ties_where_there_are_any(monkeypatch, gcps: int, ties: bool, asked: list) -> None:
    """Whether one pass was all that was asked for, and whether control held, each time that rounds were run."""
    made, run, once, held = simulate_block(3, 60, seed=5, num_gcps=gcps, num_checks=0), rounds.Rounds.run, [], []

    def watched(self: Any, only: bool = False, **given: bool) -> Any:
        once.append(given.get("once", only))
        held.append(bool((np.abs(self.heights.control[0].rows) > 1e-3).any()))  # by less than a kilometre
        return run(self, once[-1])

    monkeypatch.setattr(rounds.Rounds, "run", watched)
    tracks = made.tracks.select(np.full(len(made.tracks), ties))
    adjust_tracks(made.views, tracks, AdjustOptions(drift=0), made.gcps if gcps else None, hold_out=False)
    assert once == asked
    assert held == ([False, True] if gcps else [False])


def test_a_median_counts_each_value_by_its_weight() -> None:
    values = np.array([5.0, 2.0, 9.0, 3.0])
    assert weighted_median(values, np.ones(4)) == 3.0
    assert weighted_median(values, np.array([1.0, 1.0, 1.0, 0.5])) == 5.0
    assert weighted_median(values, np.array([0.0, 0.0, 1.0, 0.0])) == 9.0
    assert weighted_median(values, np.array([0.0, 3.0, 1.0, 1.0])) == 2.0
    assert weighted_median(values, np.zeros(4)) == 1.0  # as stated where nothing counts
    assert weighted_median(values[:0], values[:0]) == 1.0


def test_points_that_were_cut_are_seen_where_the_cameras_see_them_now(clean) -> None:
    """The truth's cameras; every third point 300 m away, and not in use."""
    problem = make_problem(
        join(clean.views, clean.tracks, None, AdjustOptions(drift=0)), AdjustOptions(drift=0),
        centers_of(clean), None,
    )  # fmt: skip
    good = solve(clean, **CALM)
    points = good.points.copy()
    lost = np.arange(len(points)) % 3 == 0
    points[lost] += 300.0
    use = ~lost[problem.structure.point]
    use[np.flatnonzero(~use)[0]] = True  # of this one, one observation was kept: it stays where it is
    kept = problem.structure.point[np.flatnonzero(use & lost[problem.structure.point])[0]]
    state = State(good.params, points, 7.0, (9.0, 8.0))
    residual = np.full(problem.xy.shape, 0.25)
    again, left = rounds.retriangulate_rejected(problem, state, residual, use, np.full(len(use), 10.0))
    lost[kept] = False
    np.testing.assert_array_equal(again.points[~lost], points[~lost])
    np.testing.assert_allclose(again.points[lost], good.points[lost], atol=0.5)
    assert (again.cost, again.history) == (7.0, (9.0, 8.0))
    of_lost = lost[problem.structure.point]
    assert (left[:, ~of_lost] == 0.25).all()
    np.testing.assert_allclose(left[:, of_lost], problem.residuals(good.params, again.points)[:, of_lost])
    assert np.abs(left[:, of_lost]).max() < 1.0
    projected = replace(problem, _room=[]).linearise(good.params, points)
    rounds.retriangulate_rejected(problem, state, residual, use, np.full(len(use), 10.0), projected)
    for name in ("image", "by_point", "by_unknown"):  # what is kept of a state follows it
        fresh = getattr(replace(problem, _room=[]).linearise(good.params, again.points), name)
        np.testing.assert_allclose(getattr(projected, name), fresh, rtol=1e-9, atol=1e-9)


def test_a_better_agreement_takes_the_place_of_a_compromise(clean) -> None:
    """40 % of a view moved by 3 px: what most of its partners contradict is left out."""
    dirty = moved_together(clean, 1, 0.4, 3.0)
    options = AdjustOptions(noise_floor=0.0, min_convergence=0.01, drift=0)
    found = adjust_tracks(dirty.views, dirty.tracks, options, centers=centers_of(dirty), hold_out=False)
    wrong = dirty.tracks.xy[:, 0] != clean.tracks.xy[:, 0]
    assert not found.inlier[wrong].any()
    partner = np.isin(dirty.tracks.point, dirty.tracks.point[wrong])
    assert found.inlier[~partner].mean() > 0.99
    assert found.inlier[~wrong].mean() > 0.9
    assert found.noise == pytest.approx(1.0, abs=0.15)


def test_residuals_settle_where_no_move_of_a_point_makes_them_smaller() -> None:
    made = simulate_block(3, 200, seed=5)
    block = join(made.views, made.tracks, None, AdjustOptions(drift=0))
    problem = make_problem(block, AdjustOptions(drift=0), centers_of(made), None)
    state, _ = first_state(problem, block, AdjustOptions(drift=0), None)
    projected = problem.project_points(state.params, state.points)
    rng = np.random.default_rng(0)
    residual, weight = rng.normal(0, 1, block.xy.shape), rng.uniform(0.5, 2, len(block.view))
    settled = problem.projected_off_points(projected, weight)(residual)
    for point in (0, 50):
        rows = block.point == point
        matrix = (projected.by_point[:, :, rows] * weight[rows]).transpose(0, 2, 1).reshape(-1, 3)
        whitened = (residual[:, rows] * weight[rows]).ravel()
        left = whitened - matrix @ np.linalg.lstsq(matrix, whitened, rcond=None)[0]
        np.testing.assert_allclose((settled[:, rows] * weight[rows]).ravel(), left, atol=1e-7)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [0, 1])
def test_scattered_wrong_observations_ask_for_no_third_pass(seed: int) -> None:
    """Their smooth part is chance: weights that took it for the views' misfit moved when they were cut."""
    made, rng = simulate_block(30, 10000, seed=seed, outliers=0.0), np.random.default_rng(seed)
    wrong = rng.random(len(made.tracks)) < 0.02
    ties = replace(made.tracks, xy=made.tracks.xy + wrong[:, None] * rng.normal(0, 20, made.tracks.xy.shape))
    found = adjust_tracks(made.views, ties, AdjustOptions(min_convergence=0.01))
    assert found.status.startswith("2 passes of cutting")
    assert found.inlier[wrong].mean() < 0.05
    assert found.inlier[~wrong].mean() > 0.88  # a tenth is held out


TRACE = known("the noise is 0.23 % larger")


@pytest.mark.landing(1)
@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=[pytest.mark.slow, TRACE])])
def test_accuracies_stated_far_too_well_leave_no_trace_once_they_are_learnt(seed: int) -> None:
    """What views could not follow under them weighed down their ties, and nothing else may go by it at the end."""
    made = simulate_block(10, 3000, seed=seed)
    right, narrow = (
        adjust_tracks(made.views, made.tracks, AdjustOptions(min_convergence=0.01, **stated))
        for stated in ({}, {"sigma_attitude": 2.0, "sigma_position": 0.3})
    )
    assert narrow.prior.scale.min() > 4.0
    assert narrow.noise == pytest.approx(right.noise, rel=2e-3)
    assert made.held_out_rms(list(narrow.sensors)) < 0.0075


# --- when they end, by script -------------------------------------------------------------------------------------


def passes(
    monkeypatch,
    cut: list[int],
    noise: list[float],
    prior: list[float],
    known: bool = False,
    misfit: tuple[float, ...] = (0.0,),
) -> tuple[int, list[int]]:
    """Number of passes where so many of 10,000 observations are cut, such noise is seen and such priors are learnt.

    And where views have such a misfit, by whose square weights shrink.

    The last of each goes on for ever. Also before which passes tracks were revived.
    """
    again: list[int] = []
    every = np.ones(10_000, dtype=bool)

    def learnt(n: int) -> CameraPrior:
        return CameraPrior(np.zeros((1, 2)), np.full((1, 2), prior[min(n, len(prior) - 1)]))

    class Scripted(rounds.Rounds):
        def __init__(self) -> None:
            nothing: Any = None
            self.problem = Problem(None, None, None, learnt(0), None)  # type: ignore[arg-type]
            self.state: Any = SimpleNamespace(points=None)
            self.everything, self.use = every, every
            self.passes, self.noise, self.is_known = 0, noise[0], known
            self.goes_on, self.learnt = known, None
            self.heights: Any = SimpleNamespace(hold=lambda problem, points: problem)
            self.observations: Any = SimpleNamespace(
                sigma=np.ones(10_000),
                weight=lambda use, noise, misfit: use / (noise * (1.0 + misfit**2)),
                tie_information=lambda weight: weight,
                mean_freedom=lambda use: 2.0,
            )
            self.misfit = misfit[0]
            self.variances: Any = SimpleNamespace(learnt=lambda *_: (learnt(self.passes), SimpleNamespace(shared=1.0)))
            self.smooth: Any = SimpleNamespace(test_neighbours=lambda *_: "smooth")
            self.residual = self.weight = np.zeros(1)
            covariance: Any = SimpleNamespace(is_large=False)
            self.found = Minimum(nothing, nothing, _known=[covariance])

        def _search(self) -> None:
            pass

        def _reject(self) -> None:
            self.use = np.arange(10_000) >= cut[min(self.passes - 1, len(cut) - 1)]

        def _solve(self) -> Any:
            self.projected: Any = SimpleNamespace(by_point=np.zeros(0))
            self.weight = self.observations.weight(self.use, self.noise, self.misfit)
            return self.found

        def _estimate_noise(self) -> Any:
            self.misfit = misfit[min(self.passes, len(misfit) - 1)]
            self.noise = noise[min(self.passes, len(noise) - 1)]

    made = Scripted()
    monkeypatch.setattr(
        rounds,
        "retriangulate_rejected",
        lambda problem, state, residual, *_: again.append(made.passes + 1) or (state, residual),
    )
    outcome = made.run()
    assert outcome.noise == noise[min(outcome.passes, len(noise) - 1)]
    np.testing.assert_array_equal(outcome.told, outcome.inlier / outcome.noise)
    return outcome.passes, again


@pytest.mark.parametrize(
    ("cut", "noise", "prior", "misfit", "expected"),
    [
        ([0], [1.0], [1.0], (0.0,), 2),  # never less than two
        ([0], [1.0], [1.0], (0.0, 2.0, 2.04), 2),  # of weights 1/5 and 1/5.16
        ([0], [1.0], [1.0], (0.0, 2.0, 2.1), 3),
        ([0], [1.0], [1.0], (0.0, 2.0, 0.5), 3),
        ([0, 10], [1.0], [1.0], (0.0,), 2),  # a thousandth
        ([0, 11], [1.0], [1.0], (0.0,), 3),
        ([0, 11, 22, 33, 44, 55, 66, 77], [1.0], [1.0], (0.0,), 6),  # and no more than six
        ([0], [1.0, 1.0, 1.049], [1.0], (0.0,), 2),
        ([0], [1.0, 1.0, 1.051], [1.0], (0.0,), 3),
        ([0], [1.0, 1.0, 0.949], [1.0], (0.0,), 3),
        ([0], [1.0], [1.0, 1.0, 1.21], (0.0,), 2),  # a fifth, as a logarithm
        ([0], [1.0], [1.0, 1.0, 1.23], (0.0,), 3),
        ([0], [1.0], [1.0, 1.0, 0.81], (0.0,), 3),
    ],
)
def test_rounds_end_where_cut_noise_and_priors_stand(monkeypatch, cut, noise, prior, misfit, expected) -> None:
    assert passes(monkeypatch, cut, noise, prior, misfit=misfit)[0] == expected


@pytest.mark.parametrize(
    ("cut", "noise", "prior", "expected"),
    [
        ([0], [1.0], [1.0], 1),  # what was known before stands
        ([11], [1.0], [1.0], 2),
        ([0], [1.0, 1.051], [1.0], 2),
        ([0], [1.0], [1.0, 1.23], 2),
        ([10], [1.0, 0.951], [1.0, 0.82], 1),
    ],
)
def test_rounds_that_go_on_from_an_outcome_end_at_once_where_nothing_changes(
    monkeypatch, cut, noise, prior, expected
) -> None:
    assert passes(monkeypatch, cut, noise, prior, known=True)[0] == expected


@pytest.mark.parametrize(
    ("cut", "revived"),
    [
        ([99], []),
        ([101], [2]),  # more than a hundredth, and not before the first
        ([101, 50, 50], [2]),
        ([50, 101, 150, 150], [3, 4]),
    ],
)
def test_tracks_are_revived_where_more_than_a_hundredth_was_cut(monkeypatch, cut, revived) -> None:
    assert passes(monkeypatch, cut, [1.0], [1.0])[1] == revived


@pytest.mark.parametrize("same", [True, False])
def test_what_was_known_is_gone_on_with_where_the_unknowns_are_the_same(clean, same: bool) -> None:
    """Cut, accuracies and misfit; with further unknowns what was cut may come back, but counts for nothing at first."""
    options = AdjustOptions(drift=0)
    block = join(clean.views, clean.tracks, None, options)
    problem = make_problem(block, options, centers_of(clean), None)
    state, heights = first_state(problem, block, options, None)
    rng = np.random.default_rng(0)
    inlier, use = (rng.random((2, len(block.view))) < 0.9).astype(bool)
    wider = CameraPrior(problem.camera_prior.mean, 2.0 * problem.camera_prior.sigma)
    unknowns = problem.cameras.unknowns if same else object()
    known: Any = SimpleNamespace(
        problem=SimpleNamespace(cameras=SimpleNamespace(unknowns=unknowns), camera_prior=wider),
        smooth=SmoothTest(np.array([0.1, 0.2, 0.3]), np.array([1e-9, 0.5, 1e-9]), *np.ones((2, 3))),
        inlier=inlier, noise=1.7, prior="what was learnt",
    )  # fmt: skip
    each = rounds.Rounds(problem, block, state, heights, use, known)
    assert each.goes_on == same
    assert each.is_known
    assert each.noise == 1.7
    assert (each.problem.camera_prior is wider) == same
    assert each.learnt == ("what was learnt" if same else None)
    tied = each.observations.tied
    np.testing.assert_array_equal(each.everything, tied(block.use))
    np.testing.assert_array_equal(each.use, tied(use & inlier & block.use if same else use & block.use))
    np.testing.assert_array_equal(each.counted, each.use & inlier)
    np.testing.assert_array_equal(each.misfit, [0.1, 0.0, 0.3] if same else 0.0)
    first = rounds.Rounds(problem, block, state, heights, use)
    assert (first.goes_on, first.is_known, first.noise, first.misfit, first.passes) == (False, False, 1.0, 0.0, 0)
    np.testing.assert_array_equal(first.counted, tied(use & block.use))
    assert first.problem.camera_prior is problem.camera_prior
    np.testing.assert_array_equal(first.observations.sigma, block.sigma)  # all ties count, for what is smooth, too


@pytest.mark.parametrize("waves", [0.0, 6.0])
def test_of_many_views_outliers_are_looked_for_on_a_sample(monkeypatch, waves) -> None:
    """Each view has its hundred, and what is right and wrong is as by all of them; by all where one loses its own."""
    block, rng = simulate_block(10, 2000, seed=3, num_checks=0, size=(4000, 4000)), np.random.default_rng(3)
    wrong = rng.random(len(block.tracks)) < 0.02
    xy = block.tracks.xy + wrong[:, None] * rng.uniform(10.0, 30.0, block.tracks.xy.shape)
    xy[:, 1] += waves * np.sin(xy[:, 1] / 100.0) * (block.tracks.view == 4)
    options = AdjustOptions(min_convergence=0.01)
    ties = join(block.views, replace(block.tracks, xy=xy), None, options)
    problem, calls = make_problem(ties, options, None, None), seen(monkeypatch, rounds, "_robust")
    found = []
    for fewest in (10, 11):
        monkeypatch.setattr(rounds, "_SAMPLED_VIEWS", fewest)
        found.append(rounds.Rounds(problem, ties, *first_state(problem, ties, options, None), ties.use))
        found[-1]._search()
    one, whole = found
    counts = [np.bincount(start.structure.view) for start, *_ in calls]
    assert counts[0].min() >= 100
    assert counts[0].sum() < 0.25 * len(xy)
    assert [count.sum() for count in counts[1:]] == [len(xy)] * (2 if waves else 1)
    if waves:
        np.testing.assert_array_equal(one.state.params, whole.state.params)
        return
    wrong = wrong[ties.order]
    assert one.noise == pytest.approx(whole.noise, rel=0.15)  # these have smooth parts
    assert one.counted[wrong].mean() < whole.counted[wrong].mean() + 0.01 < 0.1
    assert one.counted[~wrong].mean() > whole.counted[~wrong].mean() - 0.03 > 0.75
    right = ~wrong & (one.counted > 0.5) & (whole.counted > 0.5)
    rms = [np.sqrt((each.residual[:, right] ** 2).mean()) for each in (one, whole)]
    assert rms[0] == pytest.approx(rms[1], rel=0.1)
