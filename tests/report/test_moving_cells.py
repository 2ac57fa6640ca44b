"""Where tie points move: every cell with its share, counted point by point."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.geodesy import ecef_from_ground
from barpc.report.summary.whole import moving_cells


def run_of(lonlat: np.ndarray, moves: np.ndarray, cut: np.ndarray, unknown: Any = ()) -> Any:
    """Tracks of two observations each; those that were cut count for nothing."""
    points = ecef_from_ground(np.column_stack([lonlat, np.full(len(lonlat), 100.0)]))
    points[list(unknown)] = np.nan
    twice = np.repeat([moves, ~(moves | cut)], 2, axis=1)
    tracks = SimpleNamespace(point=np.repeat(np.arange(len(lonlat)), 2), num_points=len(lonlat))
    found = SimpleNamespace(moving=twice[0], inlier=twice[1], points=points)
    return SimpleNamespace(adjustment=found, tracks=tracks)


@pytest.mark.parametrize("middle", [5.0, 180.0, -180.0])
def test_cells_hold_the_share_of_their_tie_points_that_moves(middle: float) -> None:
    rng = np.random.default_rng(3)
    offset = rng.uniform(-0.12, 0.12, (2000, 2))
    offset[:2] = [(-0.12, -0.12), (0.12, 0.12)]  # the ends
    moves = (offset[:, 0] > 0.04) & (offset[:, 1] < 0.0) & (rng.random(2000) < 0.6)
    cut = np.arange(2000) % 7 == 3
    offset[10] = (40.0, 20.0)  # a wrong match on another continent
    cut[10], moves[10] = True, False
    cut &= ~moves
    found = moving_cells(run_of(offset + (middle, 43.0), moves, cut, unknown=[11]))
    assert found
    for one in found:
        west, south, east, _ = one.box
        assert (east - west) % 360.0 == pytest.approx(0.02, abs=1e-9)
        assert -180.0 <= west <= 180.0
        low = np.array([(west - middle + 180.0) % 360.0 - 180.0, south - 43.0])
        inside = ((offset >= low) & (offset < low + 0.02)).all(axis=1) & ~cut & (np.arange(2000) != 11)
        assert abs(int(inside.sum()) - one.count) <= 1  # the last lies on the end
        assert one.share == pytest.approx(moves[inside].mean(), abs=0.05)
        assert low[0] >= 0.04 - 0.0201
        assert low[1] < 0.0
    assert len(found) == 4 * 6


def test_where_nothing_moves_or_nothing_was_adjusted_there_are_none() -> None:
    still = np.zeros(4, dtype=bool)
    assert moving_cells(run_of(np.eye(4, 2), still, still)) == ()
    nothing: Any = SimpleNamespace(adjustment=None)
    assert moving_cells(nothing) == ()
    (one,) = moving_cells(run_of(np.array([(5.0, 43.0)] * 3), ~np.zeros(3, dtype=bool), np.zeros(3, dtype=bool)))
    assert (one.count, one.share) == (3, 1.0)
