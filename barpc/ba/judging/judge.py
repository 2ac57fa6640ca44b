"""Explanations compete on all observations, those that were cut among them: what gains most is taken, then the next."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from barpc.ba.constraints.block import Block
from barpc.ba.evidence.correlated_noise import shared_errors
from barpc.ba.evidence.linearised import Linear, array_elements, linearise
from barpc.ba.evidence.mixture import LIKELIHOOD_TOLERANCE, MixtureFit, fit_mixture, off_from_right
from barpc.ba.evidence.periods import Swing, swings
from barpc.ba.evidence.scan import Interval, scan
from barpc.ba.judging.explanations import (
    EXPLANATIONS,
    FADE,
    FOLLOWED,
    LOCAL,
    MOVING,
    SWING,
    TRANSIENT,
    WANDER,
    BlockResiduals,
    Explanation,
    Where,
    alike,
    bent,
    faster,
    proposed,
    sharpened,
    step_of,
)
from barpc.ba.judging.moving import GroundMotion, Motion, MovingGroup, group_of
from barpc.ba.robust.rounds import Outcome, retriangulate_rejected
from barpc.ba.robust.weights import Observations
from barpc.ba.solving.solve import State
from barpc.base.geodesy import Array
from barpc.base.statistics import BACKFITTING, KEPT, LARGEST, OUTLIER, RIVALS, SAMPLE, SMALL, STANDS, SURE, TRIED
from barpc.scene import BoolArray, IntArray

logger = logging.getLogger(__name__)

_SEEN = 2.5  # floors: swings and motions that are taken; sound crops show swings of 1.8, where ties share errors
MAX_OBSERVATIONS = KEPT
"""Of a block, up to which parts of it are judged."""
_NEAREST = 12  # views of a part


@dataclass(frozen=True, eq=False)
class Finding:
    """An explanation that was taken."""

    kind: str  # a name of `barpc.ba.judging.explanations.EXPLANATIONS`
    view: int  # -1: of none
    where: Where | None
    # (2,) displacement of what it moves, col and row [px]: a strip's with its sign, a swing's amplitude, else the root
    # mean square
    size: Array
    gain: float  # nats over the next without it
    gap: float  # nats over the runner-up
    runner_up: str  # its kind, or "" for none
    unknowns: Array  # (e,) as `barpc.ba.judging.explanations` has them [px]
    period: float | None = None  # after which it repeats itself [px]
    or_of: tuple[int, ...] = ()  # other views that may be meant: their evidence is within `SURE` of the view's
    moved: MovingGroup | None = field(default=None, repr=False)
    motion: Motion | None = None  # what is said of it at the end


@dataclass(frozen=True, eq=False)
class Selection:
    """The explanations taken, and the state of cameras and observations with them."""

    findings: tuple[Finding, ...] = ()
    step: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (N, q) of the cameras' unknowns
    right: Array = field(default_factory=lambda: np.zeros(0))  # (K,) probability that an observation of a tie is


def standing_out(outcome: Outcome, block: Block, floor: float) -> list[Interval]:
    """Find the intervals of images in which more ties were cut, or are displaced, than elsewhere and chance
    allow.

    A mean below `floor` [px] is none.
    """
    if floor not in outcome.standing_out:
        outcome.standing_out[floor] = _standing_out(outcome, block, floor)
    return outcome.standing_out[floor]


def _standing_out(outcome: Outcome, block: Block, floor: float) -> list[Interval]:
    rows, off = _whitened(outcome, block)
    right = outcome.inlier[rows].astype(np.float64)  # of few ties some that were cut make a mean by chance
    pixel = float(np.median(block.sigma[rows])) * outcome.noise if rows.any() else 1.0
    found = scan(block.view[rows], block.xy[:, rows], _sizes(block), 1.0 - right, off, right, floor / pixel)
    return [replace(one, off=one.off * pixel) for one in found if one.gain > SURE]


def left_over(outcome: Outcome, block: Block, floor: float) -> list[Interval]:
    """Return the intervals that stand out at the end, with the offsets of the ties that were cut there.

    As their tracks see it that are triangulated with all that may be seen, where all of one was cut.
    """
    found = standing_out(outcome, block, floor)
    if not all(
        one.by_share for one in found
    ):  # noise that neighbours share makes means of them, and is none of an image's part
        by_neighbours = correlated_noise_gain(outcome, block)
        found = [one for one in found if one.by_share or one.gain > by_neighbours]
    if not any(one.by_share for one in found):
        return found
    state, weight = outcome.minimum.state, block.use / block.sigma
    residual = retriangulate_rejected(outcome.problem, state, outcome.residual, outcome.inlier, weight)[1]
    off = np.hypot(*residual)
    cut = (block.point < block.num_tracks) & block.use & ~outcome.inlier & np.isfinite(off)
    inside = [
        cut & (block.view == one.view) & (block.xy[one.axis] >= one.start) & (block.xy[one.axis] < one.stop)
        for one in found
    ]
    return [
        replace(one, apart=float(np.median(off[rows])) if rows.any() else 0.0)
        for one, rows in zip(found, inside, strict=True)
    ]


def swinging(outcome: Outcome, block: Block) -> list[Swing]:
    """Find the periods with which the rows of images swing more than chance allows, at most one an image."""
    rows, off = _whitened(outcome, block)
    return swings(
        block.view[rows], block.xy[1, rows], _sizes(block), _confirmed_observations(outcome, block)[rows], off
    )


def correlated_noise_gain(outcome: Outcome, block: Block) -> float:
    """Return by how much noise that neighbours share explains the ties kept better than noise of each alone [nats]."""
    rows, off = _whitened(outcome, block)
    return _correlated_log_ratio(
        block.view[rows], block.xy[:, rows], _sizes(block), off, outcome.inlier[rows], block.point[rows]
    )


def _correlated_log_ratio(
    view: IntArray, place: Array, size: Array, off: Array, right: BoolArray, track: IntArray
) -> float:
    """Return what noise that neighbours share explains [nats], of ties (k,) off by (2, k) standard deviations.

    A track of n views leaves 2 n - 3 of its 2 n residuals free.
    """
    right = right & (np.hypot(*off) < OUTLIER)
    free = 1.0 - 1.5 * len(np.unique(track[right])) / max(int(right.sum()), 1)
    return free * float(shared_errors(view[right], place[:, right], size, off[:, right]).sum())


def _confirmed_observations(outcome: Outcome, block: Block) -> Array:
    """Return 1 for observations (K,) of points that others tell: what was cut is seen as well as the rest."""
    right = np.bincount(block.point[outcome.inlier], minlength=block.num_points)
    return (right[block.point] >= 2).astype(np.float64)


def _whitened(outcome: Outcome, block: Block) -> tuple[BoolArray, Array]:
    """Return the observations of tracks (K,), and residuals (2, k) of these in standard deviations."""
    is_tie = (block.point < block.num_tracks) & block.use
    freedom = Observations(outcome.problem, block.sigma, 0.0, is_tie).freedom(outcome.inlier.astype(np.float64))
    spread = block.sigma * outcome.noise * np.sqrt(0.5 * freedom)
    rows = is_tie & np.isfinite(outcome.residual).all(axis=0)
    return rows, outcome.residual[:, rows] / spread[rows]


def _sizes(block: Block) -> Array:
    return np.array([view.size for view in block.views], dtype=np.float64).T


def judge(outcome: Outcome, block: Block, floor: float) -> Selection:
    """Find what explains the ties of a block beside its cameras, the first taken first; empty where nothing
    stands out.

    Of more unknowns than `SMALL` each image that stands out is judged among those that it shares most tracks with:
    what moves on the ground competes there, but is not followed.
    """
    size, views = outcome.problem.free.size, np.arange(len(block.views))
    if size > LARGEST or len(block.view) > MAX_OBSERVATIONS:
        return Selection()
    asks = [one.view for one in standing_out(outcome, block, floor)]
    if not asks or size > SMALL:
        asks += [one.view for one in swinging(outcome, block)]
    if size <= SMALL:
        return _judged_among(outcome, block, floor, views) if asks else Selection()
    found = Selection((), np.zeros((len(views), size // len(views))), outcome.inlier.astype(np.float64))
    done: set[int] = set()
    for view in dict.fromkeys(asks):
        if view not in done:
            views = _neighbour_views(block, view)
            done.update(views.tolist())
            one = _judged_among(outcome, block, floor, views)
            if one.findings and one.findings[-1].moved is None:
                found = _with_findings(found, one, views, np.flatnonzero(np.isin(block.view, views)))
    return found if found.findings else Selection()


def _judged_among(outcome: Outcome, block: Block, floor: float, views: IntArray) -> Selection:
    """Judge the ties that some views have among them; views and observations are renumbered."""
    found = around(outcome, block, views)
    if found is None:
        return Selection()
    linear, state = found
    rows, ground = np.flatnonzero(np.isin(block.view, views)), GroundMotion.of(outcome.problem, state)
    linear, ground = linear.among(views), ground.part(rows)
    nothing, place = np.zeros((2, 0, len(rows))), block.xy[:, rows]
    number, outs = np.full(len(block.views), -1), standing_out(outcome, block, floor)
    number[views] = np.arange(len(views))
    try:
        base, few = fit_mixture(linear), linear.thinned(SAMPLE)
        seen = BlockResiduals(linear, few, ground, place, _sizes(block)[:, views], base, nothing, np.zeros(0))
        first = [replace(one, view=int(number[one.view])) for one in outs if number[one.view] >= 0]
        return _ExplanationSearch(seen, first, floor, float(np.median(block.sigma))).run()
    except np.linalg.LinAlgError as error:  # priors so wide that rounding is what holds the weakest mode
        logger.warning("what explains the tie points is not judged: %s", error)
        return Selection()


def _neighbour_views(block: Block, view: int) -> IntArray:
    """Return a view and those that share most tracks with it, in their order."""
    ties = block.use & (block.point < block.num_tracks)
    of_view = np.zeros(block.num_points, dtype=bool)
    of_view[block.point[ties & (block.view == view)]] = True
    shared = np.bincount(block.view[ties & of_view[block.point]], minlength=len(block.views))
    shared[view] = len(ties) + 1
    nearest = np.argsort(-shared, kind="stable")[:_NEAREST]
    return np.sort(nearest[shared[nearest] > 0])


def _with_findings(all_of: Selection, one: Selection, views: IntArray, rows: IntArray) -> Selection:
    """Return a judgement with the findings among some views added, for observations at `rows`."""
    step, right = all_of.step.copy(), all_of.right.copy()
    new = ~step[views].any(axis=1)
    step[views[new]] = one.step[new]
    right[rows] = one.right
    findings = (
        replace(row, view=int(views[row.view]), or_of=tuple(int(views[v]) for v in row.or_of)) for row in one.findings
    )
    return Selection((*all_of.findings, *findings), step, right)


def around(outcome: Outcome, block: Block, views: IntArray) -> tuple[Linear, State] | None:
    """Linearise the ties among some views of a block at its solution; None where they are too many to be judged."""
    problem = outcome.problem
    use = block.use & (block.point < block.num_tracks) & np.isin(block.view, views)
    unknowns = problem.free.size // len(block.views) * len(views)
    if unknowns > SMALL or array_elements(np.bincount(block.point[use])) > 30 * KEPT:  # 240 MB
        return None
    state, _ = retriangulate_rejected(
        problem, outcome.minimum.state, outcome.residual, outcome.inlier, block.use / block.sigma
    )
    low, high = block.alt_range
    return linearise(problem, state, use, block.sigma, high - low), state


_Tried = tuple[Explanation, MixtureFit, float]


@dataclass(frozen=True, eq=False)
class _TakenExplanation:
    one: Explanation
    gain: float
    gap: float
    runner_up: str
    or_of: tuple[int, ...]
    beside: BlockResiduals  # what was taken before

    @property
    def what(self) -> tuple[str, int]:
        """Kind and view of the explanation."""
        return self.one.kind, self.one.view


@dataclass(frozen=True, eq=False)
class _SearchState:
    """A search with some explanations taken."""

    seen: BlockResiduals
    followed: MixtureFit  # the last of what the adjustment follows
    taken: tuple[_TakenExplanation, ...] = ()
    ended: bool = False  # nothing may be taken beside what was

    @property
    def gain(self) -> float:
        """Evidence gained by all explanations taken."""
        return sum(row.gain for row in self.taken)

    @property
    def moves(self) -> bool:
        """Whether ground that moves is what was taken last."""
        return bool(self.taken) and self.taken[-1].one.group is not None

    @property
    def gain_beside_motion(self) -> float:
        """Evidence gained by what is followed beside ground that moves; all of it where none does."""
        return self.gain - (self.taken[-1].gain if self.moves else 0.0)

    def may_pass(self, best: _SearchState) -> bool:
        """Return whether some more, each gaining less than the last, may explain more than another that ended."""
        left = RIVALS + len(best.taken) - 1 - len(self.taken)
        return self.gain + left * self.taken[-1].gain > best.gain

    def adds_to(self, best: _SearchState, beside: list[_Tried]) -> bool:
        """Return whether what was taken last gains as much beside the best: it is no other way then."""
        last, one = self.taken[-1], self.taken[-1].one
        same = [row.what for row in self.taken[:-1]] == [row.what for row in best.taken[:-1]]
        gains = [row[2] for row in beside if row[0].kind == one.kind and not _differs(row[0], one)]
        return same and max(gains, default=0.0) > last.gain - SURE

    def added(self, tried: list[_Tried]) -> _SearchState:
        """Return the state with the first of the explanations tried; the others are its rivals."""
        first = tried[0]
        same = [row for row in tried if row[2] > first[2] - SURE and _of_one_image(row[0], first[0])]
        one, made, gain = min(same, key=lambda row: _image_share(row[0], self.seen))  # of two that are as good
        others = [row for row in tried if row[0] is not one and _differs(row[0], one)]
        other = max(((row[0].kind, row[2]) for row in others), default=("", 0.0), key=lambda row: row[1])
        close = [row[0] for row in others if row[2] > gain - SURE]
        or_of = tuple(sorted({row.view for row in close if one.kind == row.kind == SWING}))
        logger.info("%s of view %d, %s: %.0f nats (%s %.0f)", one.kind, one.view, one.where, gain, *other)
        taken = (*self.taken, _TakenExplanation(one, gain, gain - max(other[1], 0.0), other[0], or_of, self.seen))
        extra = np.concatenate([self.seen.extra, one.extra], axis=1)
        sigma = np.append(self.seen.sigma, one.sigma)
        seen = replace(self.seen, base=made, extra=extra, sigma=sigma)
        follows = one.kind in FOLLOWED
        return _SearchState(seen, made if follows else self.followed, taken, not follows or len(taken) == TRIED)


def _by_neighbours(seen: BlockResiduals) -> float:
    """Return what noise that neighbours share explains beside what was taken [nats]."""
    found, linear = seen.base, seen.linear
    left = linear.left(found.step) + np.einsum("cek,e->ck", seen.extra, found.extra) / linear.sigma
    off, _ = off_from_right(linear, left, found.right)
    track = np.full(len(linear.view), -1)
    for n, tracks in enumerate(linear.tracks):
        track[tracks.rows] = len(linear.view) * n + np.arange(len(tracks.rows))[:, None]
    right = (track >= 0) & (found.right > 0.5)
    # what is larger than what matchers are stated to err by is no noise of theirs
    return _correlated_log_ratio(linear.view, seen.place, seen.size, off, right, track)


class _ExplanationSearch:
    """Search for explanations, one after the other, by the best and its rivals."""

    def __init__(self, seen: BlockResiduals, first: list[Interval], floor: float, sigma: float) -> None:
        self.start, self.first, self.floor, self.sigma = seen, first, floor, sigma  # [px]
        self.seen, self.taken = seen, tuple[_TakenExplanation, ...]()
        self.group: list[Explanation] = []  # looked for once

    def run(self) -> Selection:
        """Return all that were taken."""
        first, ended = self._grown([_SearchState(self.start, self.start.base)])
        states = first
        while not ended:
            states, ended = self._grown(states)
        if first[0].moves and states[0].gain_beside_motion < first[0].gain:
            # what is found with ground that moves explains less than that alone: all competes again without it
            states = first[:1]
        best, margin = states[0], states[0].gain - (states[1].gain if len(states) > 1 else 0.0)
        for n, row in enumerate(best.taken):  # what is left, as well
            if sum(one.gain for one in best.taken[n:]) <= _by_neighbours(row.beside):
                best = _SearchState(row.beside, row.beside.base, best.taken[:n])
                break
        if not best.taken:
            return Selection()
        best = _simplified(best)
        self.seen = best.seen
        # what was not the best by itself is beside the others: by what these gain together
        taken = [row if row.gap > 0.0 else replace(row, gap=margin) for row in best.taken]
        followed = sum(row.one.kind in FOLLOWED for row in taken)
        base = best.seen.base if followed == len(taken) else best.followed
        found = tuple(one for n in range(len(taken)) for one in _findings_of(taken, n, best.seen))
        return Selection(found, base.step, base.right)

    def _grown(self, states: list[_SearchState]) -> tuple[list[_SearchState], bool]:
        """Return the best with one more explanation, and whether they are the last."""
        best, grown, beside = states[0], list[_SearchState](), list[_Tried]()
        for state in states:
            if state.ended or (best.ended and not state.may_pass(best)):
                grown.append(state)
                continue
            if state is not best and state.adds_to(best, beside):
                continue
            self.seen, self.taken = state.seen, state.taken
            tried = [row for row in self._tried() if row[2] > SURE]
            if not tried and state is best:  # it explains all
                return states, True
            beside = tried if state is best else beside
            for n in [0, *_rival_states(tried)] if tried else []:
                grown.append(state.added([tried[n], *tried[:n], *tried[n + 1 :]]))
            grown += [] if tried else [replace(state, ended=True)]
        kept: list[_SearchState] = []
        for state in sorted(grown, key=lambda state: -state.gain):
            if not any({row.what for row in state.taken} == {row.what for row in one.taken} for one in kept):
                kept.append(state)
        kept = kept[:RIVALS]
        return kept, all(one.ended or (kept[0].ended and not one.may_pass(kept[0])) for one in kept)

    def _tried(self) -> list[_Tried]:
        """Return the explanations of what stands out beside those taken, with their gains; the best first."""
        seen = self.seen
        out, periods = self._standing_out(seen.base, seen.extra)
        # in a pair more wrong matches at an end explain what was cut there as well, and nothing stands out beside them
        out = out or ([] if self.taken else self.first)
        made = self._with([], self._worth_more(list(proposed(seen, out, periods, (MOVING,)))))
        if made and made[0][0].kind == WANDER:
            made = self._with(made, alike(seen, *made[0][:2]))
        made = self._sharp(made)
        if (out or self.group) and not self._leaves_nothing(made):
            made = self._sorted([row[:2] for row in (*made, *self._moving(out, made))])
        return self._sorted(row[:2] for row in made if not self._is_nothing(*row[:2]))

    def _standing_out(self, found: MixtureFit, extra: Array) -> tuple[list[Interval], list[Swing]]:
        """Return the intervals and periods that stand out beside what a fit moves (2, e, K)."""
        seen, linear = self.seen, self.seen.linear
        rows = linear.taking_part
        left = linear.left(found.step) + np.einsum("cek,e->ck", extra, found.extra) / linear.sigma
        wrong, view, place = (1.0 - found.right)[rows], linear.view[rows], seen.place[:, rows]
        all_off, known = off_from_right(linear, left, found.right)
        off, told = all_off[:, rows] / found.noise, (known[rows] | (wrong < 0.5)).astype(np.float64)
        floor = self.floor / self.sigma / found.noise
        out = [one for one in scan(view, place, seen.size, wrong, off, told, floor) if one.gain > SURE]
        return _uncovered(out)[:RIVALS], swings(view, place[1], seen.size, told, off)[:RIVALS]

    def _leaves_nothing(self, made: list[_Tried]) -> bool:
        """Return whether nothing stands out beside the best of few unknowns: no rival is needed then."""
        best = [row for row in made[:1] if row[2] > SURE and row[0].kind in FOLLOWED]
        beside = (
            self._standing_out(found, np.concatenate([self.seen.extra, one.extra], axis=1)) for one, found, _ in best
        )
        return any(not any(one) for one in beside)

    def _moving(self, out: list[Interval], made: list[_Tried]) -> list[_Tried]:
        """Return the ties that move on the ground, and parts of images that hold what they do.

        They are looked for once and then tried beside what was taken.
        """
        self.group = self.group or EXPLANATIONS[MOVING](self.seen, out[0])
        found = self._with([], self.group)
        rows = self.seen.linear.taking_part
        sure = [row for row in found if row[2] > SURE]
        return self._sharp(self._with(found, [one for row in sure for one in self._members(row[1], rows)]))

    def _sharp(self, made: list[_Tried]) -> list[_Tried]:
        """Return the explanations, best first, with ends, periods and lengths searched where these may gain most."""
        local = [one for kind in LOCAL for one in [row[0] for row in made if row[0].kind == kind][:RIVALS]]
        # where something is sure already, what is not waits for the next round
        blunt = max(SURE, made[0][2] / RIVALS) if made and made[0][2] > SURE else -np.inf
        return self._sorted(
            self._sharpened(one, found)
            if gain > blunt and (one in local or one.kind in (TRANSIENT, SWING, WANDER))
            else (one, found)
            for one, found, gain in made
        )

    def _worth_more(self, offered: list[Explanation]) -> list[Explanation]:
        """Return the explanations that, by few tracks, may gain most, alone or as the largest of some parts."""
        few = self.seen.few
        if few is self.seen.linear or len(offered) < 3:
            return offered
        base = fit_mixture(few, self.seen.extra, self.seen.sigma, self.seen.base)
        gains = [self._fit(one, few, base).evidence - base.evidence - one.price for one in offered]
        least = max(gains) / RIVALS if max(gains) > SURE else -np.inf
        return [one for one, gain in zip(offered, gains, strict=True) if gain >= least]

    def _is_nothing(self, one: Explanation, found: MixtureFit) -> bool:
        """Return whether a swing or a group's motion is smaller than what an adjustment is asked to find."""
        size = np.inf
        if one.kind == SWING:
            size = float(np.hypot(*_amplitude(found.extra[-len(one.sigma) :])))
        elif one.group is not None and (found.moving > 0.5).any():
            away = np.einsum("cmk,m->ck", one.group.by_move[:, :, found.moving > 0.5], found.move)
            size = float(np.sqrt((away**2).sum(axis=0).mean()))
        return bool(size < self.floor * _SEEN)

    def _members(self, found: MixtureFit, rows: BoolArray) -> Iterator[Explanation]:
        """Yield the parts of images that hold what a group does: rows that lie off move on the ground, too."""
        seen, none = self.seen, np.zeros((2, int(rows.sum())))
        places = scan(seen.linear.view[rows], seen.place[:, rows], seen.size, found.moving[rows], none, none[0])
        best = {one.view: one for one in reversed(places) if one.by_share and one.gain > SURE}
        intervals = sorted(best.values(), key=lambda one: -one.gain)[:RIVALS]
        return proposed(seen, intervals, [], (MOVING, WANDER))

    def _with(self, made: list[_Tried], more: list[Explanation]) -> list[_Tried]:
        """Return the explanations tried so far and more, the best first."""
        return self._sorted([*(row[:2] for row in made), *((one, self._fit(one)) for one in more)])

    def _sorted(self, made: Iterable[tuple[Explanation, MixtureFit]]) -> list[_Tried]:
        base = self.seen.base.evidence
        return sorted(((*row, row[1].evidence - base - row[0].price) for row in made), key=lambda row: -row[2])

    def _sharpened(self, one: Explanation, found: MixtureFit) -> tuple[Explanation, MixtureFit]:
        for _ in range(BACKFITTING):
            others = np.einsum("cek,e->ck", self.seen.extra, found.extra[: -len(one.sigma)])
            tried = [faster(one, self._fit(bent(self.seen, one))), one] if one.kind in (FADE, TRANSIENT) else [one]
            better, made = found, one
            for shape in tried:
                again = sharpened(self.seen, shape, found, others)
                # what is as it was gains no more than another did
                if better.evidence < found.evidence + LIKELIHOOD_TOLERANCE or not _stands(again, one):
                    fitted = self._fit(again, base=found)
                    better, made = (fitted, again) if fitted.evidence > better.evidence else (better, made)
            more = better.evidence - found.evidence
            one, found = made, better
            if more < LIKELIHOOD_TOLERANCE:
                break
        return one, found

    def _fit(self, one: Explanation, linear: Linear | None = None, base: MixtureFit | None = None) -> MixtureFit:
        seen, sigma = self.seen, np.append(self.seen.sigma, one.sigma)
        extra = np.concatenate([seen.extra, one.extra], axis=1)
        return fit_mixture(linear or seen.linear, extra, sigma, base or seen.base, one.group)


def _simplified(state: _SearchState) -> _SearchState:
    """Return a search with steps for decays that explain no more, now that all others are found."""
    for n, row in enumerate(state.taken):
        one, seen = row.one, state.seen
        if one.kind != FADE or state.moves:
            continue
        assert one.where is not None
        plain = step_of(seen, one)
        at = slice(*(sum(len(row.one.sigma) for row in state.taken[: n + k]) for k in (0, 1)))
        extra = seen.extra.copy()
        extra[:, at] = plain.extra
        found = fit_mixture(seen.linear, extra, seen.sigma, seen.base)
        if found.evidence - plain.price > seen.base.evidence - one.price:
            taken = (*state.taken[:n], replace(row, one=plain), *state.taken[n + 1 :])
            state = replace(state, seen=replace(seen, base=found, extra=extra), followed=found, taken=taken)
    return state


def _stands(one: Explanation, before: Explanation) -> bool:
    """Return whether an explanation is where it was, with a prior about as wide."""
    return one.where == before.where and bool((np.abs(np.log(one.sigma / before.sigma)) < STANDS).all())


def _amplitude(unknowns: Array) -> Array:
    """Return the amplitude of a swing (2,), col and row."""
    size: Array = np.hypot(*unknowns.reshape(2, 2).T)
    return size


def _findings_of(rows: list[_TakenExplanation], n: int, seen: BlockResiduals) -> Iterator[Finding]:
    taken, one = rows[n], rows[n].one
    start = sum(len(row.one.sigma) for row in rows[:n])
    size = unknowns = seen.base.extra[start : start + len(one.sigma)]
    moved = None
    for part, own in zip(one.parts, np.split(unknowns, len(one.parts)) if one.parts else (), strict=True):
        yield Finding(TRANSIENT, part.view, part.where, own, taken.gain, taken.gap, taken.runner_up, own)
    if one.parts:
        return
    if one.group is not None:
        size, moved = np.zeros(2), group_of(seen.linear, seen.ground, one.group, seen.base)
    elif one.kind == SWING:
        size = _amplitude(unknowns)
    elif one.kind not in LOCAL:
        of_view = seen.linear.view == one.view
        size = np.sqrt((np.einsum("cek,e->ck", one.extra[:, :, of_view], unknowns) ** 2).mean(axis=1))
    said = taken.gain, taken.gap, taken.runner_up, unknowns, one.period, taken.or_of
    yield Finding(one.kind, one.view, one.where, size, *said, moved)


def _rival_states(tried: list[_Tried]) -> list[int]:
    """Return the best of other kinds or views that are followed, and may win with some beside."""
    found: dict[tuple[str, int], int] = {}
    for n, (one, _, gain) in enumerate(tried):
        if one.kind in FOLLOWED and _differs(one, tried[0][0]) and gain > tried[0][2] / RIVALS:
            found.setdefault((one.kind, one.view), n)
    return list(found.values())[: RIVALS - 1]


def _uncovered(intervals: list[Interval]) -> list[Interval]:
    """Return the explanations without those that a better one covers."""
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
    """Return whether two explanations may be a part of an image and its complement."""
    return one is other or (one.view == other.view and one.kind in LOCAL and other.kind in LOCAL)


def _image_share(one: Explanation, seen: BlockResiduals) -> float:
    """Return the part of its image that it moves: of two that explain as much it is the smaller one."""
    rows = (seen.linear.view == one.view) | (one.view < 0)
    return float(one.extra[:, :, rows].any(axis=(0, 1)).sum() / max(rows.sum(), 1))


def _differs(one: Explanation, other: Explanation) -> bool:
    """Return whether two explanations say something else: of one view's rows, overlapping strips are the same."""
    if (one.kind, one.view) != (other.kind, other.view):
        return True
    if one.where is None or other.where is None:
        return False
    axis, start, stop = one.where[:3]
    axis2, start2, stop2 = other.where[:3]
    return axis != axis2 or stop <= start2 or stop2 <= start
