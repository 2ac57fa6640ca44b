"""The observations of a block in three parts: solved, held out as checks, or of a moving group."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from barpc.ba.constraints.block import MIN_OBSERVATIONS, Block
from barpc.ba.evidence.scan import Interval, scan
from barpc.ba.solution import Solution
from barpc.ba.terms.moving_ground import Motion, MovingGroup, members, motion_of
from barpc.base.geodesy import Array, ground_from_ecef, wrap_longitude
from barpc.base.options import AdjustOptions
from barpc.base.statistics import LEVEL
from barpc.scene import BoolArray, IntArray

_COMPASS_SIDES = ("west", "east"), ("south", "north")


@dataclass(frozen=True, eq=False)
class Parts:
    """Observations (K,) of a block: solved, held out as checks, or of a moving group."""

    block: Block
    kept_out: BoolArray  # (K,) check observations
    group: IntArray  # (K,) number of the moving group, from 1; 0: none

    @cached_property
    def inner(self) -> Block:
        """The block of observations that are solved."""
        return self.block.without(self.kept_out | (self.group > 0))

    @cached_property
    def outer(self) -> Block:
        """The block of check observations."""
        return self.block.without(~self.kept_out | (self.group > 0))

    @cached_property
    def splined(self) -> dict[tuple[int, AdjustOptions], tuple[Solution, Solution]]:
        """Cache of `with_splines`: identity of the outcome and options -> solutions without and with splines."""
        return {}

    @cached_property
    def moving(self) -> Block:
        """The block of observations of moving groups."""
        return self.block.without(self.group == 0)

    def ties(self, *, moving: bool = True) -> Block:
        """Return all tie points in use, solved or held out; with `moving` those of moving groups, too."""
        block = self.block
        return block.without((block.point >= block.num_tracks) | ~block.use | (not moving) & (self.group > 0))

    def without_view(self, view: int) -> Parts:
        """Return the parts without all observations of one view."""
        of_it = self.block.view == view
        return Parts(self.block.without(of_it), self.kept_out[~of_it], self.group[~of_it])

    def with_group(self, found: Solution, one: MovingGroup) -> Parts:
        """Return the parts with one more moving group, which was found beside the cameras of `found`."""
        number, group, block = self.group.max(initial=0) + 1, self.group.copy(), self.block
        still = group == 0
        group[still & ~self.kept_out] = number * one.member
        # check tracks and control points were not in the fit of the group; those on moving ground belong to it, too
        of_gcps = (block.point >= block.num_tracks) & (block.point < block.num_known)
        for rows in (still & self.kept_out, still & of_gcps):
            group[rows] = number * members(found.problem, found.final.params, one, block.without(~rows))
        return replace(self, group=group)

    def without_motion(self, found: Solution, one: MovingGroup) -> Block:
        """Return all tie points, those of the last group, `one`, with their motion removed; cameras are of `found`."""
        ties = self.ties()
        member = self.group[np.isin(self.block.order, ties.order)] == self.group.max(initial=0)
        moved = motion_of(found.problem, found.final.params, one, ties)
        return replace(ties, xy=ties.xy - np.nan_to_num(moved) * member)

    def motion_pixels(self, one: MovingGroup) -> float:
        """Return the largest motion of a group between two images, in pixels of the coarser one."""
        view = self.inner.view
        return one.metres / max(one.ground.pixel_of(np.flatnonzero(view == v)) for v in one.between)

    def exchanged(self) -> Parts:
        """Return the parts with the last moving group as ground, and the ground as the moving group."""
        number = self.group.max(initial=0)
        moves = np.where(self.group == 0, number, np.where(self.group == number, 0, self.group))
        return replace(self, group=moves)

    def is_tied(self) -> bool:
        """Return whether each view has enough solved observations, and they connect the views as all of them do."""
        block, inner = self.block, self.inner
        kept, had = (np.bincount(b.view[b.use], minlength=len(b.views)) for b in (inner, block))
        enough = bool((kept[had > 0] >= MIN_OBSERVATIONS).all())
        return enough and len(inner.groups(inner.use)) == len(block.groups(block.use))

    def fits_view(self, found: Solution, view: int) -> bool:
        """Return whether the inlier rate of a view is at least half of the usual one, and there is no moving group.

        The observations of a wrong view might be taken for such a group.
        """
        kept = 1.0 - lost_shares(found, self.inner)
        return not self.group.any() and bool(kept[view] >= 0.5 * np.median(np.delete(kept, view)))

    def mostly_moving(self, inlier: BoolArray) -> list[Interval]:
        """Return the intervals of rows with more moving tie points than inliers (K,) of `inner`."""
        block, gone = self.block, self.group > 0
        if not gone.any():
            return []
        rows = gone.copy()
        rows[~self.kept_out & ~gone] = inlier & (self.inner.point < block.num_tracks)
        size = np.array([view.size for view in block.views], dtype=np.float64).T
        none = np.zeros((2, int(rows.sum())))
        found = scan(block.view[rows], block.xy[:, rows], size, gone[rows].astype(np.float64), none, none[0])
        sure = [one for one in found if one.by_share and one.axis == 1]
        return [replace(one, moves=True) for one in sure if one.share > 0.5]

    def motion(self, number: int, one: MovingGroup, points: Array) -> Motion:
        """Return the record of moving group `number` (from 1), given the points (P, 3) [m] of all tracks, ECEF."""
        placed = self.block.point[self.block.point < self.block.num_tracks]
        placed = placed[np.isfinite(points[placed, 0])]
        every, of_group = np.unique(placed), np.unique(self.block.point[self.group == number])
        of_group = np.intersect1d(every, of_group)
        ground, all_of = ground_from_ecef(points[of_group]), ground_from_ecef(points[every])
        center = float(all_of[0, 0])
        place, whole = (np.column_stack([wrap_longitude(g[:, 0], center), g[:, 1]]) for g in (ground, all_of))
        low, high = np.quantile(place, (LEVEL, 1.0 - LEVEL), axis=0)
        middle = np.quantile(whole, (LEVEL, 1.0 - LEVEL), axis=0).mean(axis=0)  # without wrong matches far off
        sides = [
            names[0] if high[axis] < middle[axis] else names[1] if low[axis] > middle[axis] else ""
            for axis, names in enumerate(_COMPASS_SIDES)
        ]
        west, east = (float(wrap_longitude(lon)) for lon in (low[0], high[0]))
        box = west, float(low[1]), east, float(high[1])
        share = len(of_group) / max(len(every), 1)
        side = "-".join(one_side for one_side in sides[::-1] if one_side)
        gcps = np.unique(self.block.point[(self.group == number) & (self.block.point >= self.block.num_tracks)])
        names = tuple(self.block.gcps.names[g - self.block.num_tracks] for g in gcps.tolist())
        first, second = (self.block.views[v].date for v in one.between)
        return Motion(one.metres, one.between, share, box, side, names, (first, second))


def lost_shares(found: Solution, block: Block) -> Array:
    """Return the share (N,) of rejected tie points of each view; 1 for a view without any."""
    ties = block.use & (block.point < block.num_tracks)
    had, kept = (
        np.bincount(block.view[rows], minlength=len(block.views)) for rows in (ties, ties & found.outcome.inlier)
    )
    return np.asarray(1.0 - kept / np.maximum(had, 1))
