"""Explanations compete on all observations, those that were cut among them: what gains most is taken, then the next."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from barpc.ba.block import Block
from barpc.ba.explanations import LOCAL, Explanation, Seen, Where, proposed, sharpened
from barpc.ba.mixture import Fit, fit, linearise, settled
from barpc.ba.rounds import Outcome, revived
from barpc.ba.scan import SURE, Interval, scan
from barpc.ba.weights import Observations
from barpc.geodesy import Array
from barpc.scene import BoolArray

_LOG = logging.getLogger(__name__)

_MOST = 6  # explanations of one block
_TRIED = 3  # intervals a round
_LOCAL = 3  # explanations of parts of an image whose ends are looked for, a round
_SHARPENED = 6  # times
_UNKNOWNS = 400  # of all views, up to which explanations are tried
_NUMBERS = 3e7  # of a mixture, at most: 240 MB


@dataclass(frozen=True, eq=False)
class Finding:
    """An explanation that was taken."""

    kind: str  # a name of `barpc.ba.explanations.EXPLANATIONS`
    view: int
    where: Where | None
    size: (
        Array  # (2,) root mean square displacement of what it moves, col and row, with sign for a strip [px]
    )
    gain: float  # nats over the next without it
    gap: float  # nats over the runner-up
    runner_up: str  # its kind, or "" for none


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
        Seen(linear, block.xy, size, fit(linear), nothing), first, floor / float(np.median(block.sigma))
    ).run()


def _numbers(block: Block, use: BoolArray) -> float:
    count = np.bincount(block.point[use]).astype(np.float64)
    return float((np.where(count <= 4, 2.0**count, count + 1.0) * 4.0 * count**2).sum())


class _Search:
    """Taking one explanation after the other."""

    def __init__(self, seen: Seen, first: list[Interval], floor: float) -> None:
        self.seen, self.first, self.floor = seen, first, floor
        self.taken: list[Explanation] = []
        self.best = seen.base

    def run(self) -> list[Finding]:
        found: list[tuple[Explanation, float, float, str]] = []
        while len(found) < _MOST:
            tried = [(one, made, self._worth(one, made)) for one, made in self._tried()]
            tried.sort(key=lambda row: -row[2])
            if not tried or not tried[0][2] > SURE:
                break
            same = [
                row for row in tried if row[2] > tried[0][2] - SURE and _of_one_image(row[0], tried[0][0])
            ]
            one, made, gain = min(same, key=lambda row: _part(row[0], self.seen))  # of two that are as good
            other = next(
                ((t[0].kind, t[2]) for t in tried if t[0] is not one and _differs(t[0], one)), ("", 0.0)
            )
            _LOG.info("%s of view %d, %s: %.0f nats (%s %.0f)", one.kind, one.view, one.where, gain, *other)
            found.append((one, gain, gain - max(other[1], 0.0), other[0]))
            self.taken.append(one)
            self.best = made
            extra = np.concatenate([self.seen.extra, one.extra], axis=1)
            self.seen = replace(self.seen, base=made, extra=extra)
            if one.kind not in LOCAL:  # what is smooth is followed by other means
                break
        return [Finding(*self._said(n), *row[1:]) for n, row in enumerate(found)]

    def _said(self, n: int) -> tuple[str, int, Where | None, Array]:
        one = self.taken[n]
        start = sum(len(other.sigma) for other in self.taken[:n])
        of_one = self.best.extra[start : start + len(one.sigma)]
        if one.kind in LOCAL:
            return one.kind, one.view, one.where, of_one
        rows = self.seen.linear.view == one.view
        moved = np.einsum("cek,e->ck", one.extra[:, :, rows], of_one)
        return one.kind, one.view, one.where, np.sqrt((moved**2).mean(axis=1))

    def _worth(self, one: Explanation, made: Fit) -> float:
        return made.evidence - self.best.evidence - one.price

    def _tried(self) -> list[tuple[Explanation, Fit]]:
        """Explanations of what stands out now, each fitted beside those that were taken."""
        linear = self.seen.linear
        rows = np.zeros(len(linear.view), dtype=bool)
        for tracks in linear.tracks:
            rows[tracks.rows] = True
        left = linear.left(self.best.step) + self._moved(self.best.extra) / linear.sigma
        wrong = (1.0 - self.best.right)[rows]
        off = settled(linear, left, self.best)[:, rows]
        floor = self.floor / self.best.noise
        out = scan(linear.view[rows], self.seen.place[:, rows], self.seen.size, wrong, off, floor)
        out = [*([] if self.taken else self.first), *(one for one in out if one.gain > SURE)]
        out = _distinct(sorted(out, key=lambda one: -one.gain))[:_TRIED]
        made = [(one, self._fit(one)) for one in proposed(self.seen, out)]
        made.sort(key=lambda row: row[0].price - row[1].evidence)
        strips = [n for n, row in enumerate(made) if row[0].kind in LOCAL][:_LOCAL]
        for n in strips:
            made[n] = self._sharpened(*made[n])
        return made

    def _sharpened(self, one: Explanation, found: Fit) -> tuple[Explanation, Fit]:
        for _ in range(_SHARPENED):
            again = sharpened(self.seen, one, found, self._moved(found.extra[: -len(one.sigma)]))
            better = self._fit(again)
            if not better.evidence > found.evidence:
                break
            one, found = again, better
        return one, found

    def _fit(self, one: Explanation) -> Fit:
        both = [*self.taken, one]
        extra = np.concatenate([each.extra for each in both], axis=1)
        return fit(self.seen.linear, extra, np.concatenate([each.sigma for each in both]), self.best)

    def _moved(self, extra: Array) -> Array:
        """What those that were taken move (2, K) [px]."""
        out, start = np.zeros_like(self.seen.place), 0
        for one in self.taken:
            stop = start + len(one.sigma)
            out += np.einsum("cek,e->ck", one.extra, extra[start:stop])
            start = stop
        return out


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
    return float(one.extra[:, :, rows].any(axis=(0, 1)).mean())


def _differs(one: Explanation, other: Explanation) -> bool:
    """Whether two explanations say something else: of one view's rows, overlapping strips are the same."""
    if (one.kind, one.view) != (other.kind, other.view):
        return True
    if one.where is None or other.where is None:
        return False
    axis, start, stop = one.where[:3]
    axis2, start2, stop2 = other.where[:3]
    return axis != axis2 or stop <= start2 or stop2 <= start
