"""Heights behind a jump that no image shows along its epipolar lines are said to be unknown, to the metre."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from barpc.ba import adjust_tracks
from barpc.base.geodesy import ground_from_ecef
from barpc.report import Run, summarize
from barpc.report.measures.block import explanations
from barpc.report.unseen import unseen_parts
from barpc.simulate import simulate_block

FROM = 350  # row


def jumped(lines: float, views: int = 2, axis: int = 1, seed: int = 0) -> tuple[Run, np.ndarray]:
    """A block whose second image has its last rows, or columns, displaced along their axis; its true heights."""
    made = simulate_block(views, 1500, seed=seed, per_site=views, size=(600, 600), attitude=5e-6, position=0.3, noise=0)
    xy = made.tracks.xy.copy()
    part = (made.tracks.view == 1) & (xy[:, axis] > FROM)
    xy[part, axis] -= lines
    noise = np.random.default_rng(seed).normal(0.0, 0.05, xy.shape)
    tracks = replace(made.tracks, xy=xy + noise)
    return Run("adjust", made.views, (), tracks, adjustment=adjust_tracks(made.views, tracks)), made.truth.ground


def apart(run: Run, true: np.ndarray) -> float:
    """By how much heights behind the jump are off beside those before it [m]."""
    ground = ground_from_ecef(run.adjustment.points)
    off = ground[:, 2] - true[:, 2]
    row = np.full(len(ground), np.nan)
    of = run.tracks.view == 1
    row[run.tracks.point[of]] = run.tracks.xy[of, 1]
    return float(np.nanmedian(off[row > FROM + 30]) - np.nanmedian(off[row < FROM - 30]))


def test_a_pair_with_a_jump_says_by_how_much_heights_behind_are_off() -> None:
    run, true = jumped(1.6)
    (part,) = unseen_parts(run, 1)
    assert not list(unseen_parts(run, 0))
    first, last = (int(word) for word in part.place.removeprefix("rows ").split("-"))
    assert min(abs(first - FROM), abs(last - FROM)) < 25
    assert part.metres == pytest.approx(abs(apart(run, true)), rel=0.15)
    (view,) = [view for view in summarize(run).views if view.cause == "along_lines"]
    assert "may be off by" in view.advice
    assert not summarize(run).passed


@pytest.mark.costs(4)
@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.few(1)
@pytest.mark.parametrize(("lines", "word"), [(3.0, "3 lines were lost"), (-5.0, "5 lines were repeated")])
def test_a_whole_number_of_lines_is_lost_and_heights_behind_are_right(lines: float, word: str) -> None:
    run, true = jumped(lines)
    assert abs(apart(run, true)) < 0.05  # 3.9 and 6.5 m by the part across the epipolar lines alone
    (told,) = explanations(run.adjustment)
    edge = re.fullmatch(rf"{word} at row (\d+) of view_0001.*", told.sentence)
    assert edge is not None
    assert abs(int(edge[1]) - FROM) < 25
    assert summarize(run).passed


@pytest.mark.nightly
def test_rows_displaced_in_both_coordinates_are_no_lost_lines() -> None:
    made = simulate_block(3, 1000, seed=0, per_site=3, size=(600, 600), attitude=5e-6, position=0.3, noise=0.05)
    xy = made.tracks.xy.copy()
    xy[(made.tracks.view == 1) & (xy[:, 1] > FROM)] += [0.5, -2.0]
    found = adjust_tracks(made.views, replace(made.tracks, xy=xy))
    assert [one.kind for one in found.findings] == ["step"]


@pytest.mark.parametrize(("lines", "views"), [pytest.param(3.0, 3, marks=pytest.mark.nightly), (0.0, 2)])
def test_a_third_image_sees_it_and_where_nothing_jumped_nothing_is_said(lines: float, views: int) -> None:
    run, _ = jumped(lines, views)
    assert not [part for i in range(views) for part in unseen_parts(run, i)]
