"""Levenberg-Marquardt by script: what is damped, what is taken, and why it ends."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from barpc.ba import AdjustOptions
from barpc.ba.constraints.block import first_state, join, make_problem
from barpc.ba.solving import solve
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import Minimum, State, has_converged
from barpc.base.errors import AdjustError
from barpc.simulate import simulate_block
from tests.constants import Sized

STATE = State(np.zeros((1, 2)), np.zeros((1, 3)), history=(7.0,))
FACTOR = object()


def run(
    monkeypatch: pytest.MonkeyPatch,
    costs: list[float],
    gains: list[float],
    tolerance: float = 1e-6,
    kept: float | None = None,
) -> tuple[Minimum | str, list[float]]:
    """The minimum, or the error's text, and the damping of every step; a gain of NaN: the matrix does not factorise.

    Costs are those at the start and after each step; the last of them and the last gain go on for ever. `kept` is the
    cost that is found after every step in their place, before it is linearised.
    """
    dampings: list[float] = []
    given = iter(costs)
    at: dict[float, float] = {}

    def cost(params: Any, *_: Any) -> float:
        at[float(params[0, 0])] = found = next(given, costs[-1])
        return found if kept is None else kept

    def reduce(params: Any, *_: Any) -> Any:
        if not at:
            cost(params)
        return SimpleNamespace(cost=at[float(params[0, 0])], point_step=lambda step: np.ones((1, 3)))

    def camera_step(problem: Any, reduced: Any, damping: float = 0.0) -> tuple[Any, float, Any]:
        gain = gains[min(len(dampings), len(gains) - 1)]
        dampings.append(damping)
        if np.isnan(gain):
            raise np.linalg.LinAlgError
        return np.full((1, 2), 0.5), gain, FACTOR

    monkeypatch.setattr(solve, "camera_step", camera_step)
    if kept is None:
        monkeypatch.setattr(solve, "_is_as_predicted", lambda *_: False)  # none is the last for that
    problem: Any = SimpleNamespace(reduce=reduce, prepare=lambda *_: (np.zeros(1), None), cost=cost)
    try:
        return solve._levenberg_marquardt(problem, STATE, np.ones(1), tolerance, None), dampings
    except AdjustError as error:
        return str(error), dampings


def test_steps_are_taken_until_one_gains_too_little(monkeypatch) -> None:
    found, dampings = run(monkeypatch, [100.0, 40.0, 30.0], [60.0, 10.0, 2.9e-5])
    assert isinstance(found, Minimum)
    assert dampings == [0.0] * 3
    assert found.state.history == (7.0, 100.0, 40.0, 30.0)
    np.testing.assert_allclose(found.state.params, 1.5)  # the last step is taken, too
    np.testing.assert_allclose(found.state.points, 3.0)
    assert found.state.cost == pytest.approx(30.0 - 2.9e-5)
    assert found.factor is FACTOR
    assert found.reduced.cost == 30.0
    assert "4 evaluations in all: the next step gains too little" in found.status
    _, dampings = run(monkeypatch, [100.0, 40.0, 30.0], [60.0, 10.0, 1e-2, 1e-9])
    assert len(dampings) == 4


@pytest.mark.parametrize(("off", "last"), [(1.9e-7, True), (-1.9e-7, True), (2.1e-7, False), (-2.1e-7, False)])
def test_a_step_that_gains_what_it_should_is_the_last(monkeypatch, off: float, last: bool) -> None:
    found, dampings = run(monkeypatch, [100.0, 40.0, 30.0], [60.0, 10.0, 1e-9], kept=40.0 + off)  # 5e-9 of the cost
    assert isinstance(found, Minimum)
    assert len(dampings) == (1 if last else 3)
    if last:
        assert found.state.history == (7.0, 100.0)
        assert found.state.cost == 40.0 + off
        assert found.factor is FACTOR
        assert found.ahead is not None
        assert "gained what it should" in found.status


@pytest.mark.parametrize(
    ("gain", "before", "last"),
    [
        (9.9e-4, np.inf, True),  # of a cost of 1000, tolerance 1e-6
        (1.1e-3, np.inf, False),
        (3.1e-3, 10.0, True),  # leaves its square over the one before: a thousandth of what is tolerated
        (3.3e-3, 10.0, False),
        (0.099, 1e4, True),
        (0.101, 1e4, False),
        (0.0, 0.0, True),
    ],
)
def test_a_step_is_the_last_where_what_it_leaves_does_not_matter(gain, before, last) -> None:
    assert has_converged(gain, before, 1000.0, 1e-6) == last


def test_a_step_that_fails_is_damped_and_the_damping_let_go(monkeypatch) -> None:
    costs = [100.0, 150.0, 140.0, 90.0, 80.0, 70.0, 60.0, 50.0]
    found, dampings = run(monkeypatch, costs, [50.0] * 7 + [1e-9])
    np.testing.assert_allclose(dampings, [0.0, 1e-6, 1e-5, 1e-6, 1e-7, 1e-8, 0.0, 0.0], rtol=1e-9, atol=1e-12)
    assert isinstance(found, Minimum)
    assert found.state.history == (7.0, 100.0, 90.0, 80.0, 70.0, 60.0, 50.0)
    np.testing.assert_allclose(found.state.params, 0.5 * 6)  # of those that failed nothing stays


@pytest.mark.parametrize(("gained", "ends"), [(0.049, True), (0.051, False)])
def test_a_damped_step_that_lowers_the_cost_by_next_to_nothing_is_the_last(monkeypatch, gained, ends) -> None:
    found, dampings = run(monkeypatch, [100.0, 150.0, 100.0 - gained, 90.0], [50.0, 50.0, 50.0, 1e-9])
    assert isinstance(found, Minimum)
    assert ("a damped step gains too little" in found.status) == ends
    assert len(dampings) == (2 if ends else 4)
    assert found.settled
    assert found.state.history[-1] == found.reduced.cost == (100.0 - gained if ends else 90.0)


def test_a_minimum_that_was_damped_has_no_factor_to_hand_on(monkeypatch) -> None:
    found, _ = run(monkeypatch, [100.0, 150.0, 90.0], [50.0, 50.0, 1e-9])
    assert isinstance(found, Minimum)
    assert found.factor is None


def test_a_matrix_that_does_not_factorise_is_damped_from_less(monkeypatch) -> None:
    nan = float("nan")
    found, dampings = run(monkeypatch, [100.0, 90.0], [nan, nan, nan, 1e-9])
    np.testing.assert_allclose(dampings, [0.0, 1e-8, 1e-7, 1e-6])
    assert isinstance(found, Minimum)


@pytest.mark.parametrize("cost", [1.0, 1000.0])
@pytest.mark.parametrize(("gain", "ends"), [(0.9e-9, True), (1.1e-9, False)])
def test_a_cost_that_rises_by_its_rounding_is_the_least(monkeypatch, gain: float, ends: bool, cost: float) -> None:
    """What a step gains is a fraction of the cost."""
    found, dampings = run(monkeypatch, [cost, cost * (1.0 + 1e-9)], [gain * cost], 1e-12)
    if ends:
        assert isinstance(found, Minimum)
        assert "what a step gains is lost in rounding" in found.status
        assert dampings == [0.0]
        assert not found.state.params.any()
    else:
        assert len(dampings) > 10


@pytest.mark.parametrize(("gain", "lost"), [(0.9e-6, True), (1.1e-6, False)])
def test_where_no_damping_however_strong_helps_it_ends(monkeypatch, gain: float, lost: bool) -> None:
    found, dampings = run(monkeypatch, [1.0, 2.0], [gain], 1e-9)
    assert max(dampings) == pytest.approx(1e8)
    if lost:
        assert isinstance(found, Minimum)
        assert "lost in rounding" in found.status
    else:
        assert found == "no step lowers the cost 1: the solution is not usable"


def test_a_cost_that_stands_is_no_failure_and_the_steps_are_counted(monkeypatch, sized: Sized) -> None:
    sized(steps=5)
    found, dampings = run(monkeypatch, [1.0, 1.0 + 5e-13], [0.5])
    assert isinstance(found, Minimum)
    assert dampings == [0.0] * 5
    assert "the number of steps is used up" in found.status
    assert not found.settled
    assert Minimum(found.state, found.reduced).settled
    assert len(found.state.history) == 7


@pytest.mark.parametrize("cost", [np.nan, np.inf])
def test_a_cost_that_is_not_finite_is_an_error(monkeypatch, cost: float) -> None:
    assert "the cost is not finite" in str(run(monkeypatch, [cost], [1.0])[0])


@pytest.mark.parametrize(
    ("free", "asked", "tolerance", "taken"),
    [
        (0, "auto", 1e-6, "sparse"),  # all cameras are fixed
        (1, "auto", 1e-6, "scipy"),
        (200, "auto", 1e-9, "scipy"),
        (201, "auto", 1e-6, "sparse"),
        (1, "auto", 1e-3, "sparse"),  # a stage of the robust rounds
        (1, "sparse", 1e-6, "sparse"),
    ],
)
def test_auto_asks_scipy_for_the_minimum_of_up_to_200_unknowns(
    monkeypatch, free: int, asked: str, tolerance: float, taken: str
) -> None:
    def solver(name: str) -> Any:
        return lambda problem, state, weight, tolerance, projected: SimpleNamespace(
            state=STATE, said=(name, tolerance, projected)
        )

    monkeypatch.setattr(solve, "_scipy", solver("scipy"))
    monkeypatch.setattr(solve, "_levenberg_marquardt", solver("sparse"))
    problem: Any = SimpleNamespace(free=np.arange(300) < free)
    found: Any = solve.minimise(problem, STATE, np.ones(1), asked, tolerance, "projected")  # type: ignore[arg-type]
    assert found.said == (taken, tolerance, "projected")


@pytest.fixture
def begun() -> tuple[Problem, State, np.ndarray]:
    """A small problem, where it begins, and the weights of its observations."""
    options, made = AdjustOptions(), simulate_block(3, 60, attitude=1e-6, position=0.2)
    block = join(made.views, made.tracks, None, options)
    problem = make_problem(block, options, None, None)
    return problem, first_state(problem, block, options, None)[0], block.use / block.sigma


def test_a_step_of_least_squares_that_fails_leaves_the_points_where_they_were(begun, monkeypatch) -> None:
    """Far off, points are nowhere: going back from there by their linearisation would not bring them back."""
    problem, state, weight = begun

    def astray(residual: Any, start: Any, jacobian: Any, **_: Any) -> Any:
        least = float((residual(start) ** 2).sum())
        for size in (1e4, 3e5):  # farther off the matrix there has no factor, with some processors or SciPy 1.18
            assert float((residual(start + size) ** 2).sum()) > 1e3 * least
        assert float((residual(start) ** 2).sum()) == pytest.approx(least, rel=1e-12)
        return SimpleNamespace(x=start, nfev=4, message="ended.", success=True)

    monkeypatch.setattr(scipy.optimize, "least_squares", astray)
    found = solve.minimise(problem, state, weight)
    np.testing.assert_array_equal(found.state.points, state.points)
    np.testing.assert_array_equal(found.state.params, state.params)
    assert found.state.cost == found.reduced.cost == min(found.state.history)


@pytest.mark.parametrize("nearer", [False, True])
def test_a_matrix_that_is_rounding_is_no_matter_far_off_and_ends_least_squares_near(
    begun, monkeypatch, caplog, nearer
) -> None:
    """Whether a matrix of astray points is positive definite depends on the version of LAPACK."""
    problem, state, weight = begun
    whole, fails = scipy.linalg.cholesky, []

    def cholesky(matrix: Any, **given: Any) -> Any:
        if fails:
            raise np.linalg.LinAlgError("a leading minor is not positive definite")
        return whole(matrix, **given)

    def tries(residual: Any, start: Any, jacobian: Any, **given: Any) -> Any:
        step = -np.linalg.lstsq(jacobian(start), residual(start), rcond=None)[0]  # Gauss and Newton's
        fails.append(True)
        far = float((residual(start + (step if nearer else 1e3)) ** 2).sum())
        fails.clear()
        assert far == pytest.approx(problem.reduce(*tried[-1]).cost, rel=1e-12)  # processors sum in orders of their own
        assert far > 1e3 * float((residual(start) ** 2).sum())
        return least_squares(residual, start, jacobian, **given)

    tried, reduce, least_squares = [], type(problem).reduce, scipy.optimize.least_squares

    def followed(self: Any, *given: Any) -> Any:
        if fails:
            tried.append(given)
        return reduce(self, *given)

    monkeypatch.setattr(type(problem), "reduce", followed)
    monkeypatch.setattr(scipy.linalg, "cholesky", cholesky)
    monkeypatch.setattr(scipy.optimize, "least_squares", tries)
    found = solve.minimise(problem, state, weight)
    assert found.settled
    assert ("scipy" in found.status) is not nearer
    assert ("going on by Levenberg-Marquardt" in caplog.text) is nearer
