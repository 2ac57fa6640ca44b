"""Heights behind a jump that no image shows along its epipolar lines are said to be unknown, to the metre."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.ba import adjust_tracks
from barpc.base.geodesy import ground_from_ecef
from barpc.report import Run, summarize
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


@pytest.mark.parametrize(("lines", "named"), [(3.0, 3), (1.6, 0), (-5.0, 5)])
def test_a_pair_with_lines_lost_says_by_how_much_heights_behind_are_off(lines: float, named: int) -> None:
    run, true = jumped(lines)
    (part,) = unseen_parts(run, 1)
    assert not list(unseen_parts(run, 0))
    assert part.lines == named
    first, last = (int(word) for word in part.place.removeprefix("rows ").split("-"))
    assert min(abs(first - FROM), abs(last - FROM)) < 25
    ground = ground_from_ecef(run.adjustment.points)
    off = ground[:, 2] - true[:, 2]
    row = np.full(len(ground), np.nan)
    of = run.tracks.view == 1
    row[run.tracks.point[of]] = run.tracks.xy[of, 1]
    apart = abs(np.nanmedian(off[row > FROM + 30]) - np.nanmedian(off[row < FROM - 30]))
    assert part.metres == pytest.approx(apart, rel=0.15)
    (view,) = [view for view in summarize(run).views if view.cause == "along_lines"]
    assert "may be off by" in view.advice
    assert (f"{named} lines lost there would explain it" in view.advice) == bool(named)
    assert not summarize(run).passed


@pytest.mark.parametrize(("lines", "views"), [(3.0, 3), (0.0, 2)])
def test_a_third_image_sees_it_and_where_nothing_jumped_nothing_is_said(lines: float, views: int) -> None:
    run, _ = jumped(lines, views)
    assert not [part for i in range(views) for part in unseen_parts(run, i)]
