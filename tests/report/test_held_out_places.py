"""Tie points that took no part, over rows, columns and cells: what one median hides turns good into look."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.ba.evidence.scan import CheckTies, Interval, worst_regions
from barpc.base.statistics import CRITICAL
from barpc.report import Run, summarize
from barpc.report.outcome import MANY_REJECTED, SMOOTH_LEFT

from .conftest import run_of_block


@pytest.fixture(scope="module")
def run() -> Run:
    """A block of three views that is good."""
    return run_of_block(3, 900)


def moved(run: Run, view: int, rows: tuple[float, float], move: tuple[float, float]) -> Run:
    """The same run, of which only tie points that took no part say that rows of one image lie off."""
    found, tracks = run.adjustment, run.tracks
    assert found is not None
    height = run.views[view].size[1]
    hit = found.held_out & (tracks.view == view)
    hit &= (tracks.xy[:, 1] >= rows[0] * height) & (tracks.xy[:, 1] < rows[1] * height)
    residuals = found.residuals.copy()
    residuals[hit] += move
    return replace(run, adjustment=replace(found, residuals=residuals))


def test_a_good_block_says_that_they_agree(run: Run) -> None:
    summary = summarize(run)
    assert summary.passed
    assert summary.scene is not None
    assert summary.scene.held_out_places == ()


@pytest.mark.parametrize("move", [(0.5, 0.0), (0.0, -4.0)])
def test_rows_that_only_they_contradict_are_named_and_need_a_look(run: Run, move: tuple[float, float]) -> None:
    summary = summarize(moved(run, 1, (0.0, 0.25), move))
    assert (summary.status, summary.passed) == ("look", False)  # exit code 3
    assert summary.scene is not None
    (one,) = summary.scene.held_out_places or ()
    height = run.views[1].size[1]
    assert one.image == run.views[1].name
    assert one.rows is not None
    assert one.rows[0] < 0.2 * height
    assert one.rows[1] < 0.3 * height
    assert one.off_px == pytest.approx(np.hypot(*move), rel=0.3)
    assert summary.reasons == (f"{one.sentence}. Check for clouds, water, change there.",)
    assert f"of {one.image}: check tie points there" in one.sentence
    assert f"{one.off_px:.2f} px" in one.sentence
    assert (one.far > 0.3) == (move[1] != 0.0)
    median = summary.views[1].held_out_px  # which hides them
    assert median == summarize(run).views[1].held_out_px


def test_rows_that_stand_out_among_all_are_not_said_twice(run: Run) -> None:
    changed = moved(run, 1, (0.0, 0.25), (0.5, 0.0))
    first = Interval(1, 1, 0.0, 900.0, 50.0, 0.8, 0.1, True, 0.5, part=0.25)
    found: Any = replace(changed.adjustment, left=(first,))  # type: ignore[type-var]
    reasons = summarize(replace(changed, adjustment=found)).reasons
    assert len(reasons) == 1
    assert "disagree with the rest" in reasons[0]


def test_of_a_view_whose_rpc_is_not_its_own_it_is_not_asked(run: Run) -> None:
    changed = moved(run, 1, (0.0, 0.25), (0.5, 0.0))
    assert changed.adjustment is not None
    assert len(changed.met_worse) == 1
    strange: Any = replace(changed.adjustment, apart=SimpleNamespace(clear=True, view=1))  # type: ignore[arg-type]
    assert replace(changed, adjustment=strange).met_worse == []
    few = replace(changed.adjustment, held_out_noise=np.array([1.0, np.nan, 1.0]))
    assert replace(changed, adjustment=few).met_worse == []
    none = replace(changed.adjustment, held_out=np.zeros_like(changed.adjustment.held_out))
    assert replace(changed, adjustment=none).met_worse == []


def test_residuals_are_compared_in_standard_deviations_of_what_their_tracks_leave(run: Run) -> None:
    """Of the 2 n coordinates of a track three go into its point: of two images a quarter is left, of three a half."""
    changed = moved(run, 1, (0.0, 0.25), (0.5, 0.0))
    found, tracks = changed.adjustment, changed.tracks
    assert found is not None
    rows = found.held_out & np.isfinite(found.residuals).all(axis=1)
    seen = np.bincount(tracks.point[found.held_out])[tracks.point[rows]]
    assert set(seen) == {2, 3}
    view, size = tracks.view[rows], np.array([one.size for one in run.views], dtype=np.float64).T
    sigma = found.held_out_noise[view] * tracks.sigma[rows] * np.where(seen == 2, 0.5, 1.0) ** 0.5
    unused = CheckTies(view, tracks.xy[rows].T, found.residuals[rows].T, sigma)
    assert changed.met_worse == worst_regions(unused, size, CRITICAL, SMOOTH_LEFT, MANY_REJECTED)
