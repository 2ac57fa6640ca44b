"""What is handed out of an adjustment, against its definition."""

from __future__ import annotations

import time
import warnings
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba import Adjustment, adjustment, pair_heights
from barpc.ba.robust import rounds
from barpc.ba.robust.variances import Variances
from barpc.base.errors import BarpcWarning
from barpc.base.geodesy import enu_basis, ground_from_ecef
from barpc.sensor.triangulation import triangulate
from barpc.simulate import SimulatedBlock, simulate_block
from tests.ba.conftest import solve
from tests.constants import Sized
from tests.lanes import rest_slow


@pytest.fixture(scope="module")
def made() -> SimulatedBlock:
    return simulate_block(3, 120, seed=6)


@pytest.fixture(scope="module")
def found(made) -> Adjustment:
    return solve(made, drift=0)


def test_errors_of_a_view_are_those_of_its_kept_observations(made, found) -> None:
    view = made.tracks.view
    for before, residual in ((True, found.residuals_before), (False, found.residuals)):
        expected = [np.sqrt((residual[found.inlier & (view == v)] ** 2).sum(axis=1).mean()) for v in range(3)]
        np.testing.assert_allclose(found.rmse(before), expected)
    assert (found.rmse(True) > 5 * found.rmse()).all()
    np.testing.assert_array_equal(found.observations, [(found.inlier & (view == v)).sum() for v in range(3)])
    none = replace(found, inlier=found.inlier & (view != 1))
    assert np.isnan(none.rmse()).tolist() == [False, True, False]


def test_seconds_are_those_of_the_adjustment(made) -> None:
    start = time.process_time()
    found = solve(made, drift=0)
    assert 0.0 < found.seconds <= time.process_time() - start


@pytest.mark.parametrize("asked", ["sparse", "auto"])
def test_what_did_not_settle_is_told_of_the_last_solve_alone(made, monkeypatch, caplog, asked) -> None:
    """On the way to it solves of wrong views, wrong starts and wider priors may fail, which nobody needs to know."""
    real, made_first = rounds.minimise, list[bool]()

    def once(*args: Any) -> Any:  # the first pass of the rounds does not settle, those after it do
        found = real(*args)
        made_first.append(True)
        return replace(found, settled=len(made_first) > 1)

    monkeypatch.setattr(rounds, "minimise", once)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert solve(made, drift=0, solver=asked).inlier.any()
    assert len(made_first) > 1
    assert not caplog.records
    monkeypatch.setattr(rounds, "minimise", lambda *args: replace(real(*args), settled=False))
    with pytest.warns(BarpcWarning, match="did not settle in 100 steps"):
        solve(made, drift=0, solver=asked)


def test_priors_that_cannot_be_learnt_are_told(made, monkeypatch) -> None:
    def fails(*_: Any) -> None:
        raise np.linalg.LinAlgError("not positive definite")

    monkeypatch.setattr(Variances, "_known", fails)
    with pytest.warns(BarpcWarning, match="accuracy of the cameras is taken as it is given"):
        solve(made, drift=0)


def measured(block: SimulatedBlock, found: Adjustment, pair: tuple[int, int]) -> tuple[float, float, int]:
    """Standard deviations of heights and of relative ones, by moving each unknown of two views by a little."""
    tracks = block.tracks
    kept = [np.unique(tracks.point[(tracks.view == v) & ~found.held_out]) for v in pair]
    seen = np.intersect1d(*kept)
    seen = seen[np.isfinite(found.points[seen, 0])]
    ground = ground_from_ecef(found.points[seen])
    unknowns, n, q = found.cameras.unknowns, len(seen), found.params.shape[1]
    image = np.vstack([found.sensors[v].project(ground) for v in pair])
    view, point = np.repeat([0, 1], n), np.tile(np.arange(n), 2)
    up = enu_basis(ground)[:, 2]

    def heights(params: np.ndarray) -> np.ndarray:
        sensors = unknowns.corrected(params, block.views)
        there = triangulate([sensors[v] for v in pair], view, point, image, alt=300.0).points
        return ((there - found.points[seen]) * up).sum(axis=1)

    columns = []
    for v in sorted(pair):
        for k in range(q):
            step = np.zeros_like(found.params)
            step[v, k] = 0.5
            columns.append(heights(found.params + step) - heights(found.params - step))
    by_camera = np.array(columns).T
    covariance = found.covariance.joint(np.array(sorted(pair)))

    def rms(rows: np.ndarray) -> float:
        return float(np.sqrt(np.mean([row @ covariance @ row for row in rows])))

    return rms(by_camera), rms(by_camera - by_camera.mean(axis=0)), n


@pytest.mark.parametrize("pair", rest_slow([(2, 1), (0, 1), (0, 2)]))
def test_heights_of_a_pair_move_as_its_cameras_do(made, found, pair) -> None:
    absolute, relative, count = measured(made, found, pair)
    heights = pair_heights(found, *pair)
    assert (heights.views, heights.count) == (pair, count)
    assert heights.absolute == pytest.approx(absolute, rel=1e-3)
    assert heights.relative == pytest.approx(relative, rel=1e-3)
    assert relative < 0.2 * absolute


def test_heights_are_measured_at_some_of_many_points_and_at_none_of_none(made, found, sized: Sized) -> None:
    whole = pair_heights(found, 0, 1)
    sized(heights_measured=20)
    some = pair_heights(found, 0, 1)
    assert 10 <= some.count <= 20
    assert some.absolute == pytest.approx(whole.absolute, rel=0.05)
    lost = replace(found, points=np.full_like(found.points, np.nan))
    nothing = pair_heights(lost, 0, 1)
    assert nothing.count == 0
    assert np.isnan([nothing.absolute, nothing.relative]).all()


def test_neighbours_are_asked_of_tie_points_that_were_cut(monkeypatch) -> None:
    """Not of what is used, was never, holds no residual, or is of control."""
    asked: list[Any] = []
    monkeypatch.setattr(adjustment, "neighbours_alike", lambda *given: asked.append(given) or "said")
    view, xy = np.arange(5), np.arange(10.0).reshape(2, 5)
    block: Any = SimpleNamespace(view=view, xy=xy, use=np.array([1, 1, 1, 0, 1], dtype=bool), views="abc")
    residual = xy + 20.0
    residual[1, 2] = np.nan
    outcome: Any = SimpleNamespace(inlier=np.array([0, 1, 0, 0, 0], dtype=bool), residual=residual)
    assert adjustment._neighbour_correlation(block, outcome, np.array([1, 1, 1, 1, 0], dtype=bool)) == "said"
    ((of_view, place, off, views),) = asked
    assert of_view.tolist() == [0]
    np.testing.assert_array_equal(place, xy[:, :1])
    np.testing.assert_array_equal(off, residual[:, :1])
    assert views == 3
