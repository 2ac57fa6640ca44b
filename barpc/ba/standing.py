"""A block in parts: what is solved, what is kept out to measure it, and groups of ties that moved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from barpc.ba.evidence.scan import Interval, scan
from barpc.ba.held.block import MIN_OBSERVATIONS, Block
from barpc.ba.judging.judge import Finding, Judgement, judge
from barpc.ba.judging.moving import Found, Motion, members
from barpc.ba.judging.solution import Solution
from barpc.ba.robust.heldout import is_better, measure
from barpc.ba.usual import LEVEL, MUCH_NOISE, RIVALS, SURE
from barpc.base.geodesy import Array, ground_from_ecef, wrap_longitude
from barpc.base.options import AdjustOptions
from barpc.scene import BoolArray, IntArray, connected_groups

_NAMES = ("west", "east"), ("south", "north")


@dataclass(frozen=True, eq=False)
class Parts:
    """Observations (K,) of a block, each in one part: solved, held out, or moving."""

    block: Block
    kept_out: BoolArray  # (K,)
    group: IntArray  # (K,) number of the group that moved from 1 on, 0: of none

    @cached_property
    def inner(self) -> Block:
        """Observations that are solved."""
        return self.block.without(self.kept_out | (self.group > 0))

    @cached_property
    def outer(self) -> Block:
        """Observations that measure the result."""
        return self.block.without(~self.kept_out | (self.group > 0))

    @cached_property
    def apart(self) -> Block:
        """Observations that move."""
        return self.block.without(self.group == 0)

    def without_view(self, view: int) -> Parts:
        """Return the parts without all observations of one view."""
        of_it = self.block.view == view
        return Parts(self.block.without(of_it), self.kept_out[~of_it], self.group[~of_it])

    def less(self, found: Solution, one: Found) -> Parts:
        """Return the parts with one more group taken out."""
        number, group = self.group.max(initial=0) + 1, self.group.copy()
        still = group == 0
        group[still & ~self.kept_out] = number * one.member
        outer = members(found.problem, found.final.params, one, self.outer)
        group[still & self.kept_out] = number * outer
        return replace(self, group=group)

    def is_tied(self) -> bool:
        """Return whether every view keeps enough observations and the views stay connected as they were."""
        block, inner = self.block, self.inner
        kept, had = (np.bincount(b.view[b.use], minlength=len(b.views)) for b in (inner, block))
        enough = bool((kept[had > 0] >= MIN_OBSERVATIONS).all())
        return enough and _groups(inner) == _groups(block)

    def mostly_moving(self, inlier: BoolArray) -> list[Interval]:
        """Return the rows of images, of the kept (K,) of `inner`, of which more ties move than stand."""
        block, gone = self.block, self.group > 0
        if not gone.any():
            return []
        rows = gone.copy()
        rows[~self.kept_out & ~gone] = inlier & (self.inner.point < block.num_tracks)
        size = np.array([view.size for view in block.views], dtype=np.float64).T
        none = np.zeros((2, int(rows.sum())))
        found = scan(block.view[rows], block.xy[:, rows], size, gone[rows].astype(np.float64), none, none[0])
        sure = [one for one in found if one.by_share and one.axis == 1 and one.gain > SURE]
        return [replace(one, moves=True) for one in sure if one.share > 0.5]

    def motion(self, number: int, one: Found, points: Array) -> Motion:
        """Return the motion of a group, of the points (P, 3) [m] of all tracks."""
        placed = self.block.point[self.block.point < self.block.num_tracks]
        placed = placed[np.isfinite(points[placed, 0])]
        every, of_group = np.unique(placed), np.unique(self.block.point[self.group == number])
        of_group = np.intersect1d(every, of_group)
        ground, all_of = ground_from_ecef(points[of_group]), ground_from_ecef(points[every])
        center = float(all_of[0, 0])
        place, whole = (np.column_stack([wrap_longitude(g[:, 0], center), g[:, 1]]) for g in (ground, all_of))
        low, high = np.quantile(place, (LEVEL, 1.0 - LEVEL), axis=0)
        middle = np.quantile(whole, (LEVEL, 1.0 - LEVEL), axis=0).mean(axis=0)  # a wrong match may lie anywhere
        sides = [
            names[0] if high[axis] < middle[axis] else names[1] if low[axis] > middle[axis] else ""
            for axis, names in enumerate(_NAMES)
        ]
        west, east = (float(wrap_longitude(lon)) for lon in (low[0], high[0]))
        box = west, float(low[1]), east, float(high[1])
        share = len(of_group) / max(len(every), 1)
        return Motion(one.metres, one.between, share, box, "-".join(side for side in sides[::-1] if side))


def _groups(block: Block) -> int:
    """Count the groups into which views fall."""
    rows = np.flatnonzero(block.use)
    rows = rows[np.lexsort((block.view[rows], block.point[rows]))]
    same = np.flatnonzero(np.diff(block.point[rows]) == 0)
    pairs = np.unique(np.column_stack([block.view[rows[same]], block.view[rows[same + 1]]]), axis=0)
    return len(connected_groups(len(block.views), [(int(i), int(j)) for i, j in pairs]))


def without_moving(
    found: Solution, parts: Parts, options: AdjustOptions, solve: Callable[[Block, Block, AdjustOptions], Solution]
) -> tuple[Solution, Parts, Judgement]:
    """Solve the block again without groups of ties that move, and find what explains the rest.

    `Solution.findings` has both.

    Refused where tracks that took no part, and do not move, are met worse, or the views do not hang together any more.
    """
    # who wants least squares has no observation that may be wrong; a model too small bends all images
    noise = MUCH_NOISE * found.outcome.noise * float(np.median(parts.inner.sigma))
    too_small = options.is_plain and bool(found.outcome.smooth.found(noise).all())
    if options.loss == "linear" or too_small:
        return found, parts, Judgement()
    groups: list[Finding] = []
    while True:
        judged = judge(found.outcome, parts.inner, options.noise_floor)
        findings = judged.findings
        one = findings[-1] if findings else None
        if one is None or one.moved is None:
            break
        findings = findings[:-1]
        # what moves may be what the model does not follow, or the little that is left of what the cameras will
        if options.is_plain or any(row.gain > one.gain for row in findings):
            break
        less = parts.less(found, one.moved)
        if len(groups) == RIVALS or not less.is_tied():
            break
        tried = solve(less.inner, less.outer, options)
        if is_better(measure(found.problem, found.final.params, less.outer), tried.after, less.outer):
            break
        found, parts = tried, less
        groups.append(one)
    judged = replace(judged, findings=findings)
    return replace(found, findings=(*groups, *findings)), parts, judged
