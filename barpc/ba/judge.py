"""Explanations compete on all observations, those that were cut among them: what gains most is taken, then the next."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from barpc.ba.block import Block
from barpc.ba.explanations import LOCAL, MOVING, WANDER, Explanation, Seen, Where, boxed, proposed, sharpened
from barpc.ba.mixture import Fit, fit, linearise, settled
from barpc.ba.moving import Found, Ground, Motion, group_of
from barpc.ba.rounds import Outcome, revived
from barpc.ba.scan import SURE, Interval, scan
from barpc.ba.weights import Observations
from barpc.geodesy import Array
from barpc.scene import BoolArray

_LOG = logging.getLogger(__name__)

_MOST = 6  # explanations of one block
_TRIED = 3  # intervals a round
_PARTS = 3  # of images that may explain together what something else does alone
_LOCAL = 2  # explanations of parts of an image whose ends are looked for, a round
_SHARPENED = 6  # times
_HELD_IN = 4  # images of which a part may hold what moves
_UNKNOWNS = 400  # of all views, up to which explanations are tried
_NUMBERS = 3e7  # of a mixture, at most: 240 MB


@dataclass(frozen=True, eq=False)
class Finding:
    """An explanation that was taken."""

    kind: str  # a name of `barpc.ba.explanations.EXPLANATIONS`
    view: int  # -1: of none
    where: Where | None
    size: (
        Array  # (2,) root mean square displacement of what it moves, col and row, with sign for a strip [px]
    )
    gain: float  # nats over the next without it
    gap: float  # nats over the runner-up
    runner_up: str  # its kind, or "" for none
    moved: Found | None = field(default=None, repr=False)
    motion: Motion | None = None  # what is said of it at the end


def standing_out(outcome: Outcome, block: Block, floor: float) -> list[Interval]:
    """Intervals of images in which ties were cut, or are off, more than elsewhere and chance allow.

    A mean below `floor` [px] is none.
    """
    problem = outcome.problem
    is_tie = (block.point < block.num_tracks) & block.use
    observations = Observations(problem, block.sigma, 0.0, is_tie)
    spread = (
        block.sigma * outcome.noise * np.sqrt(0.5 * observations.freedom(outcome.inlier.astype(np.float64)))
    )
    rows = is_tie & np.isfinite(outcome.residual).all(axis=0)
    size = np.array([view.size for view in block.views], dtype=np.float64).T
    wrong = (~outcome.inlier[rows]).astype(np.float64)
    off = np.where(outcome.inlier[rows], outcome.residual[:, rows] / spread[rows], 0.0)
    pixel = float(np.median(block.sigma[rows])) * outcome.noise if rows.any() else 1.0
    found = scan(block.view[rows], block.xy[:, rows], size, wrong, off, floor / pixel)
    return [replace(one, off=one.off * pixel) for one in found if one.gain > SURE]


def judge(outcome: Outcome, block: Block, floor: float) -> list[Finding]:
    """What explains the ties of a block beside its cameras, the first taken first; empty where nothing stands out."""
    problem = outcome.problem
    first = standing_out(outcome, block, floor)
    if not first or problem.free.size > _UNKNOWNS:
        return []
    state, _ = revived(
        problem, outcome.minimum.state, outcome.residual, outcome.inlier, block.use / block.sigma
    )
    use = block.use & (block.point < block.num_tracks)
    if _numbers(block, use) > _NUMBERS:
        return []
    low, high = block.alt_range
    linear = linearise(problem, state, use, block.sigma, high - low)
    size = np.array([view.size for view in block.views], dtype=np.float64).T
    nothing = np.zeros((2, 0, len(block.view)))
    return _Search(
        Seen(linear, Ground.of(problem, state), block.xy, size, fit(linear), nothing, np.zeros(0)),
        first,
        floor / float(np.median(block.sigma)),
    ).run()


def _numbers(block: Block, use: BoolArray) -> float:
    count = np.bincount(block.point[use]).astype(np.float64)
    return float((np.where(count <= 4, 2.0**count, count + 1.0) * 4.0 * count**2).sum())


_Tried = tuple[Explanation, Fit, float]


class _Search:
    """Taking one explanation after the other."""

    def __init__(self, seen: Seen, first: list[Interval], floor: float) -> None:
        self.seen, self.first, self.floor = seen, first, floor
        self.taken: list[tuple[Explanation, float, float, str]] = []  # with gain, gap and runner-up
        self.group: list[Explanation] = []  # looked for once

    def run(self) -> list[Finding]:
        """All that were taken."""
        tried = self._tried()
        while tried and tried[0][2] > SURE and len(self.taken) < _MOST:
            self._take(tried)
            if self.taken[-1][0].kind not in LOCAL:  # what is smooth is followed by other means
                break
            tried = self._tried()
        return [self._finding(n) for n in range(len(self.taken))]

    def _take(self, tried: list[_Tried]) -> None:
        """The best, or several parts of its image where these explain more together than it does alone."""
        best = tried[0]
        if best[0].kind not in LOCAL:
            parts, left = copy(self), _parts_of(best[0], tried)
            parts.taken = list(self.taken)
            total = 0.0
            for more in range(_PARTS, 0, -1):
                if (
                    not left or not left[0][2] > SURE or total + more * left[0][2] < best[2]
                ):  # each gains less
                    break
                total += left[0][2]
                parts._add(left)
                left = _parts_of(best[0], parts._tried())
            if total > best[2] + SURE:
                self.taken, self.seen = parts.taken, parts.seen
                return
        self._add(tried)

    def _add(self, tried: list[_Tried]) -> None:
        best = tried[0]
        same = [row for row in tried if row[2] > best[2] - SURE and _of_one_image(row[0], best[0])]
        one, made, gain = min(same, key=lambda row: _part(row[0], self.seen))  # of two that are as good
        other = next(((t[0].kind, t[2]) for t in tried if t[0] is not one and _differs(t[0], one)), ("", 0.0))
        _LOG.info("%s of view %d, %s: %.0f nats (%s %.0f)", one.kind, one.view, one.where, gain, *other)
        self.taken.append((one, gain, gain - max(other[1], 0.0), other[0]))
        extra = np.concatenate([self.seen.extra, one.extra], axis=1)
        sigma = np.append(self.seen.sigma, one.sigma)
        self.seen = replace(self.seen, base=made, extra=extra, sigma=sigma)

    def _finding(self, n: int) -> Finding:
        one, seen = self.taken[n][0], self.seen
        moved = None if one.group is None else group_of(seen.linear, seen.ground, one.group, seen.base)
        return Finding(one.kind, one.view, one.where, self._size(n), *self.taken[n][1:], moved)

    def _size(self, n: int) -> Array:
        one = self.taken[n][0]
        if one.group is not None:
            return np.zeros(2)
        start = sum(len(row[0].sigma) for row in self.taken[:n])
        of_one: Array = self.seen.base.extra[start : start + len(one.sigma)]
        if one.kind in LOCAL:
            return of_one
        rows = self.seen.linear.view == one.view
        moved = np.einsum("cek,e->ck", one.extra[:, :, rows], of_one)
        return np.asarray(np.sqrt((moved**2).mean(axis=1)))

    def _tried(self) -> list[_Tried]:
        """Explanations of what stands out now, fitted beside those taken, with their gains; the best first."""
        seen, linear = self.seen, self.seen.linear
        rows = np.zeros(len(linear.view), dtype=bool)
        for tracks in linear.tracks:
            rows[tracks.rows] = True
        left = (
            linear.left(seen.base.step) + np.einsum("cek,e->ck", seen.extra, seen.base.extra) / linear.sigma
        )
        wrong, off = (1.0 - seen.base.right)[rows], settled(linear, left, seen.base)[:, rows]
        out = scan(
            linear.view[rows], seen.place[:, rows], seen.size, wrong, off, self.floor / seen.base.noise
        )
        out = [*([] if self.taken else self.first), *(one for one in out if one.gain > SURE)]
        out = _distinct(sorted(out, key=lambda one: -one.gain))[:_TRIED]
        made = self._sorted((one, self._fit(one)) for one in self._proposed(out))
        more = [one for row in made if row[0].group and row[2] > SURE for one in self._members(row[1], rows)]
        made = self._sorted([*(row[:2] for row in made), *((one, self._fit(one)) for one in more)])
        if made and made[0][0].kind == WANDER:
            box = boxed(seen, *made[0][:2])
            made = self._sorted([*(row[:2] for row in made), (box, self._fit(box))])
        local = [row for row in made if row[0].kind in LOCAL]
        sharp = [self._sharpened(*row[:2]) for row in local[:_LOCAL]]
        rest = [row[:2] for row in made if row[0].kind not in LOCAL] + [row[:2] for row in local[_LOCAL:]]
        return self._sorted([*sharp, *rest])

    def _proposed(self, out: list[Interval]) -> list[Explanation]:
        """Explanations of intervals; the group is looked for once and then tried beside what was taken."""
        known = (MOVING,) if self.group else ()
        found = [*self.group, *proposed(self.seen, out, known)]
        self.group = [one for one in found if one.kind == MOVING]
        return found

    def _members(self, found: Fit, rows: BoolArray) -> Iterator[Explanation]:
        """Parts of images that hold what a group does: rows of one image that lie off move on the ground, too."""
        seen, none = self.seen, np.zeros((2, int(rows.sum())))
        places = scan(seen.linear.view[rows], seen.place[:, rows], seen.size, found.moving[rows], none)
        best = {one.view: one for one in reversed(places) if one.by_share and one.gain > SURE}
        intervals = sorted(best.values(), key=lambda one: -one.gain)[:_HELD_IN]
        return proposed(seen, intervals, (MOVING, WANDER))

    def _sorted(self, made: Iterable[tuple[Explanation, Fit]]) -> list[_Tried]:
        base = self.seen.base.evidence
        return sorted(
            ((*row, row[1].evidence - base - row[0].price) for row in made), key=lambda row: -row[2]
        )

    def _sharpened(self, one: Explanation, found: Fit) -> tuple[Explanation, Fit]:
        for _ in range(_SHARPENED):
            others = np.einsum("cek,e->ck", self.seen.extra, found.extra[: -len(one.sigma)])
            again = sharpened(self.seen, one, found, others)
            better = self._fit(again)
            if not better.evidence > found.evidence:
                break
            one, found = again, better
        return one, found

    def _fit(self, one: Explanation) -> Fit:
        sigma = np.append(self.seen.sigma, one.sigma)
        extra = np.concatenate([self.seen.extra, one.extra], axis=1)
        return fit(self.seen.linear, extra, sigma, self.seen.base, one.group)


def _parts_of(best: Explanation, tried: list[_Tried]) -> list[_Tried]:
    """Explanations of parts of an image, or of any beside what is of none."""
    return [row for row in tried if row[0].kind in LOCAL and best.view in (row[0].view, -1)]


def _distinct(intervals: list[Interval]) -> list[Interval]:
    """Without those of which most is in a better one, and most of that in them."""
    out: list[Interval] = []
    for one in intervals:
        if not any(_same(one, other) for other in out):
            out.append(one)
    return out


def _same(one: Interval, other: Interval) -> bool:
    common = min(one.stop, other.stop) - max(one.start, other.start)
    either = max(one.stop, other.stop) - min(one.start, other.start)
    return (one.view, one.axis) == (other.view, other.axis) and 2.0 * common > either


def _of_one_image(one: Explanation, other: Explanation) -> bool:
    """Whether two explanations may be a part of an image and its complement."""
    return one is other or (one.view == other.view and one.kind in LOCAL and other.kind in LOCAL)


def _part(one: Explanation, seen: Seen) -> float:
    """The part of its image that it moves: of two that explain as much it is the smaller one."""
    rows = seen.linear.view == one.view
    return float(one.extra[:, :, rows].any(axis=(0, 1)).sum() / max(rows.sum(), 1))


def _differs(one: Explanation, other: Explanation) -> bool:
    """Whether two explanations say something else: of one view's rows, overlapping strips are the same."""
    if (one.kind, one.view) != (other.kind, other.view):
        return True
    if one.where is None or other.where is None:
        return False
    axis, start, stop = one.where[:3]
    axis2, start2, stop2 = other.where[:3]
    return axis != axis2 or stop <= start2 or stop2 <= start
