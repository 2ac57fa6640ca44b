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
from barpc.base.geodesy import CHUNK
from barpc.base.statistics import robust_spread
from barpc.report.outcome import PairTies, pair_ties
from barpc.scene import Tracks, View
from barpc.sensor.geometry import Several, convergence_angle
from barpc.sensor.triangulation import epipolar_offset

_NEGLIGIBLE_SCATTER = 0.1  # px across epipolar lines: less does not matter
FEWER = 5.0
"""Times less scatter otherwise than as given that tell a mistake: cameras exchanged 10 to 360 of three public sets,
right ones 1."""
_PER_PAIR = 100  # of a pair
_LEAST_ANGLE = 0.5  # deg between rays: along nearer ones no epipolar line is told
_MOST_LEFT = 1.0  # px of scatter with the cameras exchanged
_MOST_TRIED = 20  # images, those that scatter most, that are tried in pairs
_FULLY_PERMUTED = 4  # images of which every order is tried


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
    pairs = _converging(views, pair_ties(tracks))
    measured = zip(pairs, _scatters(views, tracks, pairs, [ties.views for ties in pairs]), strict=True)
    known = [(ties, scatter) for ties, scatter in measured if np.isfinite(scatter)]  # others have too few matches
    pairs, as_given = [ties for ties, _ in known], [scatter for _, scatter in known]
    worst = sorted((k for k in range(len(pairs)) if as_given[k] > _NEGLIGIBLE_SCATTER), key=lambda k: -as_given[k])
    suspects = sorted([*dict.fromkeys(view for k in worst for view in pairs[k].views)][:_MOST_TRIED])
    orders = [[*both][::-1] for both in combinations(suspects, 2)]
    tried = [dict(zip(sorted(order), order, strict=True)) for order in orders]
    if 2 < len(suspects) <= _FULLY_PERMUTED:
        tried += [dict(zip(suspects, order, strict=True)) for order in permutations(suspects)]
    best: Exchange | None = None
    for cameras in tried:
        moved = {view: camera for view, camera in cameras.items() if view != camera}
        met = [k for k, ties in enumerate(pairs) if moved.keys() & set(ties.views)]
        before = [as_given[k] for k in met]
        if not moved or not met or max(before) <= _NEGLIGIBLE_SCATTER:
            continue
        after = []
        for k in met:  # the first pair that gains nothing ends most trials
            i, j = pairs[k].views
            after += _scatters(views, tracks, [pairs[k]], [(moved.get(i, i), moved.get(j, j))])
            if not FEWER * after[-1] < min(max(as_given[k], _NEGLIGIBLE_SCATTER), FEWER * _MOST_LEFT):
                break
        else:
            found = Exchange(tuple(moved), tuple(moved.values()), float(np.median(before)), float(np.median(after)))
            if best is None or found.exchanged < best.exchanged:
                best = found
    return best


def _converging(views: Sequence[View], pairs: list[PairTies]) -> list[PairTies]:
    """Return the pairs of views whose rays meet at an angle that tells epipolar lines."""
    sensors, ends = [view.sensor for view in views], np.array([ties.views for ties in pairs], np.int64).reshape(-1, 2)
    middle = np.array([(np.array(view.size) - 1.0) / 2.0 for view in views])
    altitude = np.array([view.altitude for view in views])
    first, second = (Several(sensors, end) for end in ends.T)
    angle = convergence_angle(first, second, first.localize(middle[ends[:, 0]], altitude[ends[:, 0]]))
    return [pairs[k] for k in np.flatnonzero(angle > _LEAST_ANGLE)]


def _scatters(
    views: Sequence[View], tracks: Tracks, pairs: Sequence[PairTies], cameras: Sequence[tuple[int, int]]
) -> list[float]:
    """Return the robust scatter of pairs' matches across epipolar lines through cameras of some views [px].

    Infinite where too few matches have a line.
    """
    sensors, found = [view.sensor for view in views], list[float]()
    for first in range(0, len(pairs), CHUNK // _PER_PAIR):
        some = slice(first, first + CHUNK // _PER_PAIR)
        rows = [np.unique(np.linspace(0, len(t.a) - 1, min(len(t.a), _PER_PAIR)).astype(np.int64)) for t in pairs[some]]
        a, b = (
            np.concatenate([getattr(ties, of)[row] for ties, row in zip(pairs[some], rows, strict=True)])
            for of in ("a", "b")
        )
        counts = [len(row) for row in rows]
        left, right = np.repeat(np.array(cameras[some]), counts, axis=0).T
        height = np.array([view.altitude for view in views])[left]
        offset, _ = epipolar_offset(Several(sensors, left), Several(sensors, right), tracks.xy[a], tracks.xy[b], height)
        for one in np.split(offset, np.cumsum(counts)[:-1]):
            one = one[np.isfinite(one)]
            many = len(one) >= _PER_PAIR // 10
            found.append(float(robust_spread(one - np.median(one))) if many else np.inf)
    return found
