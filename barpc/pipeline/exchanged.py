"""Images that fit each other's cameras and not their own: RPCs that were exchanged.

Matches of the right cameras scatter across their epipolar lines by matching noise, whatever the cameras' pointing
errors; of exchanged cameras by pixels, as relief moves them another way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np

from barpc.base.errors import listed
from barpc.base.statistics import robust_spread
from barpc.report.outcome import PairTies, pair_ties
from barpc.scene import Tracks, View
from barpc.sensor.geometry import convergence_angle, epipolar_offset

_SCATTER = 0.1  # px across epipolar lines: less does not matter
_FEWER = 5.0  # times less scatter with the cameras exchanged: 10 to 360 of three public sets, 1 of right cameras
_MATCHES = 100  # of a pair
_LEAST_ANGLE = 0.5  # deg between rays: along nearer ones no epipolar line is told
_MOST_LEFT = 1.0  # px of scatter with the cameras exchanged
_MOST_TRIED = 20  # images, those that scatter most, that are tried in pairs
_FEW = 4  # images of which every order is tried


@dataclass(frozen=True)
class Exchange:
    """Views with the cameras that fit them (indices, alike), and the scatter across epipolar lines before and after."""

    views: tuple[int, ...]
    cameras: tuple[int, ...]
    scatter: float  # median of the pairs with one of the views, as given [px]
    exchanged: float  # with the cameras exchanged [px]

    def sentence(self, names: Sequence[str]) -> str:
        """Return the finding in words; `names`: of all views."""
        own = [names[view] for view in self.views]
        fit = listed([f"{names[v]} fits the RPC of {names[c]}" for v, c in zip(self.views, self.cameras, strict=True)])
        who = f"{' and '.join(own)} fit each other's RPC" if len(own) == 2 else fit
        return (
            f"{who} and not the one given: matches scatter by {self.scatter:.2g} px across epipolar lines, with these "
            f"RPCs exchanged by {self.exchanged:.2g} px"
        )


def exchanged_cameras(views: Sequence[View], tracks: Tracks) -> Exchange | None:
    """Return the exchange of cameras that brings the matches of views to their epipolar lines; None without one."""
    pairs = [ties for ties in pair_ties(tracks) if _converges(views, ties)]
    measured = [(ties, _scatter(views, tracks, ties, ties.views)) for ties in pairs]
    measured = [(ties, scatter) for ties, scatter in measured if np.isfinite(scatter)]  # others have too few matches
    pairs, as_given = [ties for ties, _ in measured], [scatter for _, scatter in measured]
    worst = sorted((k for k in range(len(pairs)) if as_given[k] > _SCATTER), key=lambda k: -as_given[k])
    suspects = sorted([*dict.fromkeys(view for k in worst for view in pairs[k].views)][:_MOST_TRIED])
    orders = [[*both][::-1] for both in combinations(suspects, 2)]
    tried = [dict(zip(sorted(order), order, strict=True)) for order in orders]
    if 2 < len(suspects) <= _FEW:
        tried += [dict(zip(suspects, order, strict=True)) for order in permutations(suspects)]
    best: Exchange | None = None
    for cameras in tried:
        moved = {view: camera for view, camera in cameras.items() if view != camera}
        met = [k for k, ties in enumerate(pairs) if moved.keys() & set(ties.views)]
        before = [as_given[k] for k in met]
        if not moved or not met or max(before) <= _SCATTER:
            continue
        after = []
        for k in met:  # the first pair that gains nothing ends most trials
            i, j = pairs[k].views
            after.append(_scatter(views, tracks, pairs[k], (moved.get(i, i), moved.get(j, j))))
            if not _FEWER * after[-1] < min(max(as_given[k], _SCATTER), _FEWER * _MOST_LEFT):
                break
        else:
            found = Exchange(tuple(moved), tuple(moved.values()), float(np.median(before)), float(np.median(after)))
            if best is None or found.exchanged < best.exchanged:
                best = found
    return best


def _converges(views: Sequence[View], ties: PairTies) -> bool:
    """Return whether the rays of two views meet at an angle that tells epipolar lines."""
    first, second = (views[view] for view in ties.views)
    at = first.sensor.localize((np.array(first.size) - 1.0) / 2.0, np.array(first.altitude))
    return bool(convergence_angle(first.sensor, second.sensor, at) > _LEAST_ANGLE)


def _scatter(views: Sequence[View], tracks: Tracks, ties: PairTies, cameras: tuple[int, int]) -> float:
    """Return the robust scatter of a pair's matches across epipolar lines through cameras of some views [px].

    Infinite where too few matches have a line.
    """
    rows = np.unique(np.linspace(0, len(ties.a) - 1, min(len(ties.a), _MATCHES)).astype(np.int64))
    first, second = (views[camera] for camera in cameras)
    seen = tracks.xy[ties.a[rows]], tracks.xy[ties.b[rows]]
    offset, _ = epipolar_offset(first.sensor, second.sensor, *seen, first.altitude)
    offset = offset[np.isfinite(offset)]
    return float(robust_spread(offset - np.median(offset))) if len(offset) >= _MATCHES // 10 else np.inf
