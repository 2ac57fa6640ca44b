"""Foreign cameras: a view whose RPC does not match the image.

Such a view is found by leaving views out, then placed by what the others see.

A camera of another date, with its axes swapped, cut from another tile or above another height surface bends the whole
block. Its mark: without it the others agree to the noise, with it they do not. So where a block does not agree it is
solved without each of its views; where the others agree then, the one left out is placed alone against their points
(`barpc.ba.resection`). If more than half of its tie points contradict them wherever its camera is, it is the camera of
another image and stays as delivered. If they agree, though the block had to let go of them, or though the priors
leave no doubt that it is this view, it keeps the place found alone and bends the others no more. Where more
than half agree and the rest does not, parts of its image are displaced (`barpc.ba.select.search`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from barpc.ba.constraints.block import Block
from barpc.ba.evidence.mixture import fit_mixture
from barpc.ba.resection import Placed, RpcDiagnosis, diagnose_rpc, resect
from barpc.ba.select.parts import lost_shares
from barpc.ba.select.search import linearised_among
from barpc.ba.solution import Solution
from barpc.base.errors import AdjustError
from barpc.base.geodesy import Array
from barpc.base.options import GEOMETRIC, AdjustOptions
from barpc.base.statistics import CRITICAL, LARGEST, MUCH_NOISE, OUTLIER, SMALL, SURE, TRIED

logger = logging.getLogger(__name__)

FOREIGN_CAMERA = "foreign_camera"
_TELLING = 3  # views: without one a pair is left, which agrees about much; so each of three is left out

Solver = Callable[[Block, Block, AdjustOptions], Solution]
"""What is solved, what measures it, and how -> the block solved."""


@dataclass(frozen=True, eq=False)
class ForeignCamera:
    """A view that the others contradict, or several of which one may be.

    `gain` is by how many nats its share of contradicted tie points is likelier as its own than as that of the others
    (Kulldorff 1997; NaN where its prior told), `gap` the evidence over the runner-up, the view without which the
    others agree next best.
    """

    views: tuple[int, ...]  # the likeliest first; of more than one the ties do not tell, and nothing is done
    gain: float
    gap: float
    runner_up: int | None
    contradicted: float  # share of its tie points that contradict the others', wherever its camera is; NaN: unknown
    look: RpcDiagnosis
    placed: Placed | None  # where it was found alone; None: it is left as delivered
    scale: float = 1.0  # by how much its prior had to be widened, where that told

    @property
    def view(self) -> int:
        """The likeliest view."""
        return self.views[0]

    @property
    def clear(self) -> bool:
        """Whether it can only be this view."""
        return len(self.views) == 1

    @property
    def may_be_its_own(self) -> bool:
        """Whether it shows the scene and was not corrected: terms of its rows and columns may explain it.

        Not by few tie points, which splines would follow anywhere.
        """
        return (
            self.clear
            and self.placed is None
            and np.isfinite(self.gap)
            and (self.look.as_stated or self.look.offset is not None)
        )

    def is_view(self, view: int) -> bool:
        """Return whether a view is clearly the one that the others contradict."""
        return self.views == (view,)


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """A block whose views agree without one."""

    view: int
    block: Block
    found: Solution
    placed: Placed
    contradicted: float
    coherent: bool  # whether what contradicts is off as its neighbours are

    @property
    def usual(self) -> float:
        """The share of their tie points that the others lose."""
        return float(np.median(np.delete(lost_shares(self.found, self.block), self.view)))

    @property
    def strange(self) -> bool:
        """Whether fewer than half of the view's tie points agree, of those that would in another view.

        If the others lie anywhere, it is the matches that are wrong, and they are cut.
        """
        return self.coherent and self.disagrees

    @property
    def disagrees(self) -> bool:
        """Whether that holds wherever the others lie."""
        return 1.0 - self.contradicted < 0.5 * (1.0 - self.usual)

    def gain(self, lost: float) -> float:
        """Return the log-likelihood gain [nats] of the view's own lost share over that of the others; the
        choice among views is paid for.
        """
        rates = np.clip([max(lost, self.contradicted), self.usual], 1e-3, 1.0 - 1e-3)
        own, usual = np.array([rates, 1.0 - rates]).T
        seen = len(self.placed.squared)
        return float(seen * (own * np.log(own / usual)).sum() - np.log(len(self.block.views)))


def find_foreign_camera(
    first: Solution | None, block: Block, outer: Block, options: AdjustOptions, solve: Solver
) -> tuple[ForeignCamera | None, Solution | None]:
    """Find the view whose RPC does not match its image, where there is one, and the block solved without it.

    `first` is the block solved with all views; None: it has no solution. Nothing is tried where it agrees and no prior
    tells of one view. Measured on the observations of `outer`.
    """
    num, odd = len(block.views), None
    unknowns = num if first is None else first.problem.free.size  # at least
    asked_for_less = options.first_model != GEOMETRIC or options.drift == 0 or options.loss == "linear"
    if num < 3 or unknowns > LARGEST or asked_for_less:
        return None, None
    lost = np.ones(num) if first is None else lost_shares(first, block)
    gone = 1.0 - lost <= 0.5 * (1.0 - np.median(lost))
    asked = np.argsort(-lost, kind="stable")
    if first is not None:
        asked = asked[:TRIED]
        if agrees(first):
            odd = _odd(first, block) if num > _TELLING else None
            asked = asked[gone[asked]] if odd is None else np.array([odd])
        if unknowns > SMALL:
            asked = asked[gone[asked]]
    views = [v for v in asked.tolist() if block.names[v] not in options.fixed]
    left: list[LeaveOneOut] = []
    too_few: list[tuple[int, Solution]] = []  # views of which the others' points are too few to find them by
    for v, others, found in _leave_one_view_out(views, block, outer, options, solve):
        placed = resect(found, others, block, v)
        if placed is None:
            too_few.append((v, found))
            continue
        left.append(LeaveOneOut(v, others, found, placed, placed.contradicted(CRITICAL), placed.is_coherent(CRITICAL)))
        if num > _TELLING:  # those that agree without it contradict it, as far as it is wrong, in any block with it
            break
    if odd is not None and first is not None:
        return _by_prior(left, float(first.outcome.prior.scale[odd]), block)
    chosen = [
        one for one in left if one.strange or (one.placed.meets and gone[one.view]) or (first is None and one.disagrees)
    ]  # with matches that no cut copes with the block has no solution, and without them it has
    chosen = [one for one in chosen if one.gain(lost[one.view]) > SURE]
    if chosen:
        return _likeliest(chosen, left, lost, block)
    # a camera that drifts more than it is let makes ties scatter by some of their sigmas: no ground to leave it out
    asks = first is None or (len(too_few) == 1 and first.outcome.noise >= OUTLIER)
    return _of_few(too_few) if asks and too_few else (None, None)


def _of_few(without: list[tuple[int, Solution]]) -> tuple[ForeignCamera, Solution | None]:
    """Return the views without which a block agrees and with which it does not, and the solution without the only."""
    told = contradicted_view(*(v for v, _ in without))
    return told, without[0][1] if told.clear else None


def contradicted_view(*views: int) -> ForeignCamera:
    """Return the diagnosis of a view, or of one of several, of which nothing but its contradiction is known."""
    return ForeignCamera(views, np.nan, np.inf, None, np.nan, RpcDiagnosis(as_stated=True), None)


def agrees(found: Solution) -> bool:
    """Return whether the views of a block agree to the noise of their ties."""
    return found.outcome.noise < MUCH_NOISE and not found.has_trend and not found.is_skew


def _odd(found: Solution, block: Block) -> int | None:
    """Return the one view whose correction exceeds its prior, without control points in it; else None."""
    odd = np.flatnonzero(found.outcome.prior.odd)
    if len(odd) != 1 or (block.view[block.point >= block.num_tracks] == odd[0]).any():
        return None
    return int(odd[0])


def _leave_one_view_out(
    views: Sequence[int], block: Block, outer: Block, options: AdjustOptions, solve: Solver
) -> Iterator[tuple[int, Block, Solution]]:
    """Yield the block without one view after the other, where the rest is tied together and agrees."""
    for v in views:
        others = block.without(block.view == v)
        groups = others.groups(others.use & (others.point < others.num_tracks))
        if [v] not in groups or len(groups) != 2:
            continue
        try:
            found = solve(others, outer.without(outer.view == v), options)
        except (AdjustError, np.linalg.LinAlgError) as error:
            logger.info("without %s: %s", block.names[v], error)
            continue
        # the few left of many agree by choice
        if np.delete(lost_shares(found, others), v).max() < 0.5 and agrees(found):
            yield v, others, found


def _by_prior(left: list[LeaveOneOut], scale: float, block: Block) -> tuple[ForeignCamera | None, Solution | None]:
    """Return the view that its prior tells of, if it meets the others' points where it is found alone."""
    if not left or not left[0].placed.meets:
        return None, None
    (one,) = left
    said = diagnose_rpc(one.found, block, one.placed, one.view)
    told = ForeignCamera((one.view,), np.nan, np.inf, None, one.contradicted, said, one.placed, scale)
    return told, one.found


def _likeliest(
    chosen: list[LeaveOneOut], left: list[LeaveOneOut], lost: Array, block: Block
) -> tuple[ForeignCamera | None, Solution | None]:
    """Return the likeliest of the views `chosen`; `left` are those without which the rest agrees."""
    evidence = {one.view: _tie_evidence(one, block) for one in left} if len(left) > 1 else {chosen[0].view: 0.0}
    chosen = sorted(chosen, key=lambda one: -evidence[one.view])
    best = chosen[0]
    views = tuple(one.view for one in chosen if evidence[one.view] > evidence[best.view] - SURE)
    rest = sorted(((e, v) for v, e in evidence.items() if v not in views), reverse=True)
    gain = best.gain(lost[best.view])
    gap, runner_up = (evidence[best.view] - rest[0][0], rest[0][1]) if rest else (gain, None)
    said, placed = diagnose_rpc(best.found, block, best.placed, best.view), best.placed if best.placed.meets else None
    told = ForeignCamera(views, gain, gap, runner_up, best.contradicted, said, placed)
    logger.info("%s against the others: %.0f nats", ", ".join(block.names[v] for v in views), gain)
    return told, best.found if told.clear else None


def _tie_evidence(left: LeaveOneOut, block: Block) -> float:
    """Return the logarithm of the evidence of all ties of a block, of which those without one view are
    explained.

    Others lie anywhere in their images, as wrong ones do here: how far off a strange camera sees is not known. A
    part that is too large to be judged explains nothing.
    """
    ties = int((block.use & (block.point < block.num_tracks)).sum())
    size = np.array([view.size for view in block.views], dtype=np.float64)
    area = float(np.median(size.prod(axis=1)) / np.median(block.sigma) ** 2)
    problem = replace(left.found.outcome.problem, camera_prior=left.found.problem.camera_prior)  # as stated
    known = linearised_among(replace(left.found.outcome, problem=problem), left.block, np.arange(len(left.block.views)))
    if known is None:
        return -ties * float(np.log(area))
    linear, _ = known
    covered = sum(tracks.rows.size for tracks in linear.tracks)
    return fit_mixture(replace(linear, area=area, image=area)).evidence - (ties - covered) * float(np.log(area))
