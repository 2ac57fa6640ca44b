"""Single stages of the search for tie points, as `barpc.tie.find_tracks` goes through them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from barpc.base.geodesy import Array
from barpc.base.options import TIE_DEFAULTS, TieOptions
from barpc.base.tasks import Work, store_of
from barpc.scene import Tracks, View
from barpc.tie.matchers.features import Keypoints, locate
from barpc.tie.pairing.epipolar import EpipolarSegments
from barpc.tie.pairing.overlaps import WHOLE_SCOPE, Pair, Scope, best_pairs, possible_pairs


def select_pairs(views: Sequence[View], options: TieOptions, scope: Scope = WHOLE_SCOPE) -> list[Pair]:
    """The best partners of every view, and a spanning tree."""
    pairs = possible_pairs(views, options, scope)
    return pairs if scope.only else best_pairs(pairs, len(views), options.neighbours)


def detect(
    views: Sequence[View],
    options: TieOptions = TIE_DEFAULTS,
    *,
    executor: Any = None,
    progress: Any = None,
    **where: Any,
) -> list[Keypoints]:
    """The keypoints of every view in memory."""
    with store_of(executor) as store:
        return [of_view.load()[0] for of_view in locate(views, options, Work(executor, progress, store), **where)]


def common_tracks(tracks: Tracks, first: int, second: int) -> tuple[Array, Array]:
    """Image points (M, 2), (M, 2) of the tracks that two views have in common, in the same order."""
    a, b = tracks.view == first, tracks.view == second
    _, rows_a, rows_b = np.intersect1d(tracks.point[a], tracks.point[b], return_indices=True)
    return tracks.xy[a][rows_a], tracks.xy[b][rows_b]


def part_of(where: EpipolarSegments, rows: Any) -> EpipolarSegments:
    """Those segments that rows name."""
    names = "along", "across", "slope", "before", "after"
    return replace(where, **{name: getattr(where, name)[rows] for name in names})
