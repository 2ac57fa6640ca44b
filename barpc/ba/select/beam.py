"""A beam search for the terms of a block: each step adds the term of most evidence to a combination of terms.

Evidence is the gain of the log marginal likelihood of all observations [nats], less the price of the choice. Up to
`RIVALS` combinations are kept. Correlated noise, which needs no term, competes with all of them.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from operator import itemgetter

import numpy as np

from barpc.ba.evidence.linearised import Linear
from barpc.ba.evidence.mixture import LIKELIHOOD_TOLERANCE, MixtureFit, fit_mixture, residuals_from_inliers
from barpc.ba.evidence.periods import Period, find_periods
from barpc.ba.evidence.scan import Interval, scan
from barpc.ba.select.anomalies import correlated_log_ratio
from barpc.ba.terms import TERMS, LowFrequency, MovingObjects, Sinusoid, proposed
from barpc.ba.terms.term import Finding, Residuals, Term
from barpc.base.geodesy import Array
from barpc.base.statistics import BACKFITTING, RIVALS, STANDS, SURE, TRIED
from barpc.scene import BoolArray

logger = logging.getLogger(__name__)

_MIN_AMPLITUDE = 2.5  # of sinusoids and motions, in noise floors; images without faults show up to 1.8
_Candidate = tuple[Term, MixtureFit, float]
"""A term, the fit that includes it, and its gain of evidence [nats]."""


@dataclass(frozen=True, eq=False)
class Selection:
    """The selected terms, with the cameras and inliers beside them."""

    findings: tuple[Finding, ...] = ()
    step: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (N, q) change of the camera unknowns
    right: Array = field(default_factory=lambda: np.zeros(0))  # (K,) probability of being an inlier


@dataclass(frozen=True, eq=False)
class _SelectedTerm:
    term: Term
    gain: float  # evidence over the state before [nats]
    gap: float  # evidence over the runner-up [nats]
    runner_up: str  # kind of the runner-up
    or_of: tuple[int, ...]  # other views with a similar gain
    before: Residuals  # residuals without the term

    @property
    def name(self) -> tuple[str, int]:
        """Kind and view of the term."""
        return self.term.NAME, self.term.view


@dataclass(frozen=True, eq=False)
class _SearchState:
    """A combination of terms."""

    seen: Residuals  # residuals with all terms of the combination
    taken: tuple[_SelectedTerm, ...] = ()  # in the order of selection
    ended: bool = False  # no further term is tried

    @property
    def gain(self) -> float:
        """Evidence gained by all terms."""
        return sum(row.gain for row in self.taken)

    @property
    def camera_fit(self) -> MixtureFit:
        """The fit with the final cameras: it leaves out a last term not estimated with them (`Term.FOLLOWED`)."""
        last = self.taken[-1]
        return self.seen.base if last.term.FOLLOWED else last.before.base

    @property
    def has_motion(self) -> bool:
        """Whether the last term is a moving group."""
        return bool(self.taken) and self.taken[-1].term.group is not None

    @property
    def gain_without_motion(self) -> float:
        """Evidence gained by all terms but a moving group."""
        return self.gain - (self.taken[-1].gain if self.has_motion else 0.0)

    def may_pass(self, best: _SearchState) -> bool:
        """Return whether the state may gain more than `best` if each further term gains as much as its last one."""
        left = RIVALS + len(best.taken) - 1 - len(self.taken)
        return self.gain + left * self.taken[-1].gain > best.gain

    def may_exceed(self, noise: float) -> bool:
        """Return whether the state may gain more than `noise` [nats] if each further term gains as much as its best."""
        return self.gain + (TRIED - len(self.taken)) * max(row.gain for row in self.taken) > noise

    def complements(self, best: _SearchState, beside: list[_Candidate]) -> bool:
        """Return whether the last term is among the next candidates `beside` of `best`, with a similar gain."""
        last, one = self.taken[-1], self.taken[-1].term
        same = [row.name for row in self.taken[:-1]] == [row.name for row in best.taken[:-1]]
        gains = [row[2] for row in beside if row[0].NAME == one.NAME and not row[0].differs(one)]
        return same and max(gains, default=0.0) > last.gain - SURE

    def with_best_of(self, tried: list[_Candidate]) -> _SearchState:
        """Return the state with the first candidate of `tried`, or with a smaller part of its image of equal gain."""
        first = tried[0]
        same = [row for row in tried if row[2] > first[2] - SURE and _of_one_image(row[0], first[0])]
        one, made, gain = min(same, key=lambda row: row[0].share(self.seen))
        others = [row for row in tried if row[0] is not one and row[0].differs(one)]
        other = max(
            ((row[0].NAME, _gain_bound(row, one, gain)) for row in others), default=("", 0.0), key=itemgetter(1)
        )
        close = [row[0] for row in others if row[2] > gain - SURE]
        or_of = tuple(sorted({row.view for row in close if isinstance(row, Sinusoid) and isinstance(one, Sinusoid)}))
        logger.info("%s of view %d, %s: %.0f nats (%s %.0f)", one.NAME, one.view, one.where, gain, *other)
        taken = (*self.taken, _SelectedTerm(one, gain, gain - max(other[1], 0.0), other[0], or_of, self.seen))
        extra = np.concatenate([self.seen.extra, one.columns], axis=1)
        seen = replace(self.seen, base=made, extra=extra, sigma=np.append(self.seen.sigma, one.sigma))
        return _SearchState(seen, taken, not one.FOLLOWED or len(taken) == TRIED)

    def without_noise_terms(self) -> _SearchState:
        """Return the state without its last terms, if correlated noise explains the residuals as well as these.

        Terms are kept if they gain more than the evidence for correlated noise falls by them, and more than remains of
        it. The gain of a term is too large: it counts correlated errors as independent ones.
        """
        still = _noise_evidence(self.seen) if self.taken else 0.0
        for n, row in enumerate(self.taken):
            gain = sum(one.gain for one in self.taken[n:])
            if gain <= max(still, _noise_evidence(row.before) + SURE - still):
                return _SearchState(row.before, self.taken[:n])
        return self

    def may_replace(self, best: _SearchState) -> bool:
        """Return whether the state gains as much as `best` with as many terms, or with fewer and correlated noise."""
        more = len(best.taken) - len(self.taken)
        corrected = all(row.term.FOLLOWED for row in self.taken)  # terms that are only reported do not correct images
        if not corrected or best.has_motion or more < 0:
            return False
        return best.gain - self.gain <= (_noise_evidence(self.seen) if more else 0.0)

    def other_views(self, states: list[_SearchState]) -> list[tuple[int, ...]]:
        """Return for each term its alternative views, from states that differ only in this view and gain as much."""
        found: list[set[int]] = [set(row.or_of) for row in self.taken]
        for state in states:
            differ = [n for n, (a, b) in enumerate(zip(self.taken, state.taken, strict=False)) if a.name != b.name]
            same = len(state.taken) == len(self.taken) and len(differ) == 1 and state.gain > self.gain - SURE
            if same and (other := state.taken[differ[0]].term).NAME == self.taken[differ[0]].term.NAME and other.LOCAL:
                found[differ[0]].add(other.view)
        return [tuple(sorted(views)) for views in found]

    def simplified(self) -> _SearchState:
        """Return the state with each term replaced by a simpler one where that has more evidence."""
        state = self
        for n, row in enumerate(self.taken):
            seen, plain = state.seen, row.term.simpler(state.seen)
            if plain is None or state.has_motion:
                continue
            at = slice(*(sum(len(one.term.sigma) for one in state.taken[: n + k]) for k in (0, 1)))
            extra = seen.extra.copy()
            extra[:, at] = plain.columns
            found = fit_mixture(seen.linear, extra, seen.sigma, seen.base)
            if found.evidence - plain.price > seen.base.evidence - row.term.price:
                taken = (*state.taken[:n], replace(row, term=plain), *state.taken[n + 1 :])
                state = replace(state, seen=replace(seen, base=found, extra=extra), taken=taken)
        return state

    def findings(self, margin: float, or_of: list[tuple[int, ...]]) -> Iterator[Finding]:
        """Yield the records of the terms; `margin` [nats] is the gain of the combination over its runner-up."""
        stop = 0
        for row, views in zip(self.taken, or_of, strict=True):
            start, stop = stop, stop + len(row.term.sigma)
            unknowns = self.seen.base.extra[start:stop]
            # a term that was not the best of its step was selected for the gain of the combination
            gap = row.gap if row.gap > 0.0 else margin
            yield from row.term.findings(
                self.seen, unknowns, gain=row.gain, gap=gap, runner_up=row.runner_up, or_of=views
            )


def _generalises(one: Term, other: Term) -> bool:
    """Return whether a term has `other` as a limit: an infinitely long decay is a step, or the complement of a step."""
    if not _of_one_image(one, other) or one.price <= other.price:
        return False
    assert one.where is not None
    assert other.where is not None
    (axis, start, stop, _, rate), (axis2, *ends) = one.where, other.where[:3]
    size = 0.5 * stop if rate > 0.0 else -start  # of the image, from the open end (`open_ended`)
    return axis == axis2 and (ends[0] == -size or ends[1] == 2.0 * size)


def _gain_bound(row: _Candidate, best: Term, gain: float) -> float:
    """Return a lower bound of the gain [nats] of a candidate after refinement: it may generalise the best term."""
    return max(row[2], gain + best.price - row[0].price) if _generalises(row[0], best) else row[2]


def _of_one_image(one: Term, other: Term) -> bool:
    """Return whether two terms displace parts of the same image, perhaps one the complement of the other."""
    return one is other or (one.view == other.view and one.LOCAL and other.LOCAL)


def _residuals(found: MixtureFit, linear: Linear, extra: Array) -> Array:
    """Return the residuals (2, K) of a fit with terms of columns `extra`, in stated standard deviations."""
    return np.asarray(linear.residual_after(found.step) + np.einsum("cek,e->ck", extra, found.extra) / linear.sigma)


def _noise_evidence(seen: Residuals) -> float:
    """Return the log-likelihood ratio [nats] of correlated over independent noise beside the terms of a state."""
    found, linear = seen.base, seen.linear
    off, _ = residuals_from_inliers(linear, _residuals(found, linear, seen.extra), found.right)
    track = np.full(len(linear.view), -1)
    for n, tracks in enumerate(linear.tracks):
        track[tracks.rows] = len(linear.view) * n + np.arange(len(tracks.rows))[:, None]
    right = (track >= 0) & (found.right > 0.5)
    if len(found.moving):
        right &= found.moving < 0.5
    # residuals beyond the outlier limit are no matching noise, and are ignored
    return correlated_log_ratio(linear.view, seen.place, seen.size, off, right, track)


class TermSearch:
    """The search for the terms of a block.

    Parameters
    ----------
    seen : Residuals
        The linearised block without terms.
    first : list of Interval
        Significant intervals of the solved block.
    floor, sigma : float, least displacement to find, and standard deviation of observations [px]
    moving : bool, whether moving objects are searched for
    """

    def __init__(self, seen: Residuals, first: list[Interval], floor: float, sigma: float, moving: bool = True) -> None:
        self.start, self.first, self.floor, self.sigma, self.moving = seen, first, floor, sigma, moving
        self.seen, self.taken = seen, tuple[_SelectedTerm, ...]()
        self.group: list[Term] = []  # moving groups, searched for once
        self.tested: dict[int, tuple[MixtureFit, list[Interval], list[Period]]] = {}  # by the identity of the fit

    def run(self) -> Selection:
        """Return the selected terms."""
        first, ended = self._extended([_SearchState(self.start)])
        states, noise = first, _noise_evidence(self.start)
        while not ended and any(state.may_exceed(noise) for state in states):
            states, ended = self._extended(states)
        if first[0].has_motion and states[0].gain_without_motion < first[0].gain:
            # the terms beside the moving group gain less than it did alone: it is taken alone
            states = first[:1]
        margin = states[0].gain - (states[1].gain if len(states) > 1 else 0.0)
        reduced = [state.without_noise_terms() for state in states]
        best = reduced[0]
        for state in sorted(reduced[1:], key=lambda state: -state.gain):
            if state.may_replace(best):
                best, margin = state, max(state.gain - best.gain, 0.0)
        or_of = best.other_views(reduced)
        best = best.simplified()
        if not best.taken:
            return Selection()
        return Selection(tuple(best.findings(margin, or_of)), best.camera_fit.step, best.camera_fit.right)

    def _extended(self, states: list[_SearchState]) -> tuple[list[_SearchState], bool]:
        """Return the best combinations with one more term, and whether the search ends with them."""
        best, grown, beside = states[0], list[_SearchState](), list[_Candidate]()
        for state in states:
            if state.ended or (best.ended and not state.may_pass(best)):
                grown.append(state)
                continue
            if state is not best and state.complements(best, beside):
                continue
            self.seen, self.taken = state.seen, state.taken
            tried = [row for row in self._candidates() if row[2] > SURE]
            if not tried and state is best:  # no residuals are significant
                return states, True
            beside = tried if state is best else beside
            for n in [0, *_rivals(tried)] if tried else []:
                grown.append(state.with_best_of([tried[n], *tried[:n], *tried[n + 1 :]]))
            grown += [] if tried else [replace(state, ended=True)]
        kept: list[_SearchState] = []
        for state in sorted(grown, key=lambda state: -state.gain):
            if not any({row.name for row in state.taken} == {row.name for row in one.taken} for one in kept):
                kept.append(state)
        kept = kept[:RIVALS]
        return kept, all(one.ended or (kept[0].ended and not one.may_pass(kept[0])) for one in kept)

    def _candidates(self) -> list[_Candidate]:
        """Return the candidates for the next term, the best first; gains may be negative."""
        seen = self.seen
        out, periods = self._significant(seen.base, seen.extra)
        # the fit to a pair may explain an interval by wrong matches: then the intervals of the solved block are used
        out = out or ([] if self.taken else self.first)
        made = self._with_fits([], self._most_promising(list(proposed(seen, out, periods))))
        made = self._refined(self._with_fits(made, made[0][0].alternatives(seen, made[0][1]) if made else []))
        moves = out or self.group or (not self.taken and MovingObjects.may_move(seen))
        if self.moving and moves and not (self._explains_all(made) and self._shows_no_motion(made[0])):
            made = self._sorted([row[:2] for row in (*made, *self._motion_candidates())])
        least = self.floor * _MIN_AMPLITUDE
        return self._sorted(row[:2] for row in made if row[0].amplitude(seen, row[1]) >= least)

    def _significant(self, found: MixtureFit, extra: Array) -> tuple[list[Interval], list[Period]]:
        """Return the significant intervals and periods beside a fit with terms of columns `extra` (2, e, K).

        They are cached by the fit: that of the best candidate is tested here and again in the next step.
        """
        if id(found) not in self.tested:
            self.tested[id(found)] = found, *self._find_significant(found, extra)
        return self.tested[id(found)][1:]

    def _find_significant(self, found: MixtureFit, extra: Array) -> tuple[list[Interval], list[Period]]:
        seen, linear = self.seen, self.seen.linear
        rows = linear.in_tracks
        wrong, view, place = (1.0 - found.right)[rows], linear.view[rows], seen.place[:, rows]
        all_residuals, known = residuals_from_inliers(linear, _residuals(found, linear, extra), found.right)
        off, weight = all_residuals[:, rows] / found.noise, (known[rows] | (wrong < 0.5)).astype(np.float64)
        floor = self.floor / self.sigma / found.noise
        out = scan(view, place, seen.size, wrong, off, weight, floor)
        return _without_overlaps(out)[:RIVALS], find_periods(view, place[1], seen.size, weight, off)[:RIVALS]

    def _explains_all(self, made: list[_Candidate]) -> bool:
        """Return whether no residuals are significant beside the best candidate: it needs no rival then."""
        if not made or made[0][2] <= SURE or not made[0][0].FOLLOWED:
            return False
        one, found, _ = made[0]
        return not any(self._significant(found, np.concatenate([self.seen.extra, one.columns], axis=1)))

    def _shows_no_motion(self, candidate: _Candidate) -> bool:
        """Return whether a score test finds no moving region of the ground beside a candidate."""
        one, found, _ = candidate
        extra = np.concatenate([self.seen.extra, one.columns], axis=1)
        sigma = np.append(self.seen.sigma, one.sigma)
        return not MovingObjects.may_move(replace(self.seen, base=found, extra=extra, sigma=sigma))

    def _motion_candidates(self) -> list[_Candidate]:
        """Return the moving groups, and as their rivals displaced image parts that contain the same observations."""
        self.group = self.group or list[Term](MovingObjects.of(self.seen))
        found = self._with_fits([], self.group)
        rows = self.seen.linear.in_tracks
        members = [(one, row[1]) for row in found if row[2] > SURE for one in self._parts_at_motion(row[1], rows)]
        fits = [(one, self._fit(one, base=still)) for one, still in members]  # from the cameras of still tracks
        return self._refined(self._sorted([*(row[:2] for row in found), *fits]))

    def _refined(self, made: list[_Candidate]) -> list[_Candidate]:
        """Return the candidates, best first; ends, periods and lengths of the most promising are refined.

        If no residuals are significant beside the best, terms that generalise it are not refined.
        """
        kinds = [kind for kind in TERMS.values() if kind.LOCAL]
        local = [one for kind in kinds for one in [row[0] for row in made if isinstance(row[0], kind)][:RIVALS]]
        # candidates that gain much less than the best wait for the next step
        least = max(SURE, made[0][2] / RIVALS) if made and made[0][2] > SURE else -np.inf
        out, enough = list[tuple[Term, MixtureFit]](), False
        for one, found, gain in made:
            asked = gain > least and (one in local or not (one.LOCAL or one.group))
            same = enough and _generalises(one, made[0][0])
            out.append(self._refine_one(one, found) if asked and not same else (one, found))
            enough = self._explains_all(self._sorted(out)) if len(out) == 1 else enough
        return self._sorted(out)

    def _most_promising(self, offered: list[Term]) -> list[Term]:
        """Return the terms that gain at least 1 / `RIVALS` of the best gain, on a sample of tracks."""
        few, linear = self.seen.few, self.seen.linear
        if 2 * np.count_nonzero(few.in_tracks) > np.count_nonzero(linear.in_tracks) or len(offered) < 3:
            return offered  # the sample saves too little
        base = fit_mixture(few, self.seen.extra, self.seen.sigma, self.seen.base)
        gains = [self._fit(one, few, base).evidence - base.evidence - one.price for one in offered]
        least = max(gains) / RIVALS if max(gains) > SURE else -np.inf
        return [one for one, gain in zip(offered, gains, strict=True) if gain >= least]

    def _parts_at_motion(self, found: MixtureFit, rows: BoolArray) -> Iterator[Term]:
        """Yield displaced image parts where the moving tracks of a fit concentrate: they may be the true cause."""
        seen, none = self.seen, np.zeros((2, int(rows.sum())))
        places = scan(seen.linear.view[rows], seen.place[:, rows], seen.size, found.moving[rows], none, none[0])
        best = {one.view: one for one in reversed(places) if one.by_share}
        intervals = sorted(best.values(), key=lambda one: -one.gain)[:RIVALS]
        return proposed(seen, intervals, [], (LowFrequency,))

    def _with_fits(self, made: list[_Candidate], more: list[Term]) -> list[_Candidate]:
        """Return the candidates `made` and the fitted terms `more`, the best first."""
        return self._sorted([*(row[:2] for row in made), *((one, self._fit(one)) for one in more)])

    def _sorted(self, made: Iterable[tuple[Term, MixtureFit]]) -> list[_Candidate]:
        base = self.seen.base.evidence
        return sorted(((*row, row[1].evidence - base - row[0].price) for row in made), key=lambda row: -row[2])

    def _refine_one(self, one: Term, found: MixtureFit) -> tuple[Term, MixtureFit]:
        """Return a term and its fit after alternate refinement of the shape and fits of all unknowns (backfitting)."""
        for _ in range(BACKFITTING):
            others = np.einsum("cek,e->ck", self.seen.extra, found.extra[: -len(one.sigma)])
            better, made = found, one
            for shape in one.shapes(self.seen, self._fit):
                again = shape.refined(self.seen, found, others)
                if not _unchanged(again, one):
                    # a fit with as many unknowns gives start values
                    fitted = self._fit(again, base=found if len(again.sigma) == len(one.sigma) else None)
                    more = fitted.evidence - again.price > better.evidence - made.price
                    better, made = (fitted, again) if more else (better, made)
            gain = better.evidence - made.price - (found.evidence - one.price)
            one, found = made, better
            if gain < LIKELIHOOD_TOLERANCE:
                break
        return one, found

    def _fit(self, one: Term, linear: Linear | None = None, base: MixtureFit | None = None) -> MixtureFit:
        """Return the fit with a term added; `base` gives the start values."""
        seen, sigma = self.seen, np.append(self.seen.sigma, one.sigma)
        extra = np.concatenate([seen.extra, one.columns], axis=1)
        return fit_mixture(linear or seen.linear, extra, sigma, base or seen.base, one.group)


def _unchanged(one: Term, before: Term) -> bool:
    """Return whether a refined term has the same place as `before`, and nearly the same prior."""
    same = one.where == before.where and len(one.sigma) == len(before.sigma)
    return same and bool((np.abs(np.log(one.sigma / before.sigma)) < STANDS).all())


def _rivals(tried: list[_Candidate]) -> list[int]:
    """Return the indices of the best candidates of other kinds or views, which may win with further terms."""
    found: dict[tuple[str, int], int] = {}
    for n, (one, _, gain) in enumerate(tried):
        if one.FOLLOWED and one.differs(tried[0][0]) and gain > tried[0][2] / RIVALS:
            found.setdefault((one.NAME, one.view), n)
    return list(found.values())[: RIVALS - 1]


def _without_overlaps(intervals: list[Interval]) -> list[Interval]:
    """Return the intervals, the best first, without those that mostly overlap a better one."""
    out: list[Interval] = []
    for one in intervals:
        if not any(_overlap(one, other) for other in out):
            out.append(one)
    return out


def _overlap(one: Interval, other: Interval) -> bool:
    """Return whether more than half of the union of two intervals is common to both."""
    common = min(one.stop, other.stop) - max(one.start, other.start)
    either = max(one.stop, other.stop) - min(one.start, other.start)
    return (one.view, one.axis) == (other.view, other.axis) and 2.0 * common > either
