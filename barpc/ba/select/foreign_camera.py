"""Foreign cameras: a view whose RPC does not match the image, found by leaving each view out.

The RPC may be of another date or tile, have its axes swapped, or refer to another height surface. It deforms the whole
block: the other views fit to the noise only without it. Therefore a block that does not fit is solved without each of
its views. If the others then fit, the left-out view is resected from their ground points (`barpc.ba.resection`):

1. More than half of its tie points are outliers for any camera: the image is another one. Its RPC stays as delivered.
2. Its tie points fit the resected camera, but were rejected in the block, or its correction is the only one beyond its
   prior: the resected camera is kept. Its observations do not act on the other cameras.
3. More than half fit, the rest does not: parts of its image are displaced (`barpc.ba.select.search`).
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
from barpc.base.statistics import LARGEST, MUCH_NOISE, OUTLIER, SMALL, SURE, TRIED

logger = logging.getLogger(__name__)

FOREIGN_CAMERA = "foreign_camera"  # kind of this anomaly in `summary.json`
AMBIGUOUS_VIEWS = 3  # in a block of so few views any may be the wrong one: a remaining pair may fit by chance

Solver = Callable[[Block, Block, AdjustOptions], Solution]
"""(block to solve, block of check observations, options) -> solution."""


@dataclass(frozen=True, eq=False)
class ForeignCamera:
    """A view whose RPC contradicts the other views, or several candidates between which tie points do not decide."""

    views: tuple[int, ...]  # candidates, the likeliest first; with more than one no camera is changed
    gain: float  # log-likelihood ratio [nats] of an own outlier rate over the usual one; NaN: found by its prior
    gap: float  # evidence [nats] over the runner-up, the view whose removal explains the tie points second best
    runner_up: int | None
    contradicted: float  # outlier rate of its tie points after resection; NaN: unknown
    look: RpcDiagnosis  # its diagnosis: swapped axes, an offset, ...
    placed: Placed | None  # its resected camera; None: it stays as delivered
    scale: float = 1.0  # factor by which its prior had to be widened, if it was found by its prior

    @property
    def view(self) -> int:
        """The likeliest view."""
        return self.views[0]

    @property
    def clear(self) -> bool:
        """Whether there is only one candidate."""
        return len(self.views) == 1

    @property
    def may_be_distorted(self) -> bool:
        """Whether displaced rows or columns may explain it: the image shows the scene, but no single camera fits.

        False where few tie points identified the view: splines would fit these anywhere.
        """
        return (
            self.clear
            and self.placed is None
            and np.isfinite(self.gap)
            and (self.look.as_stated or self.look.offset is not None)
        )

    def is_view(self, view: int) -> bool:
        """Return whether a view is the only candidate."""
        return self.views == (view,)


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """A view without which the others fit."""

    view: int
    block: Block  # without it
    found: Solution  # of that block
    placed: Placed  # the resected view
    contradicted: float  # outlier rate of its tie points after resection
    coherent: bool  # whether its outliers have residuals like those of their neighbours

    @property
    def usual(self) -> float:
        """Median share of rejected tie points of the other views."""
        return float(np.median(np.delete(lost_shares(self.found, self.block), self.view)))

    @property
    def is_foreign(self) -> bool:
        """Whether the view disagrees, with spatially coherent outliers: incoherent ones are wrong matches."""
        return self.coherent and self.disagrees

    @property
    def disagrees(self) -> bool:
        """Whether its inlier rate is less than half of the usual one."""
        return 1.0 - self.contradicted < 0.5 * (1.0 - self.usual)

    def gain(self, lost: float) -> float:
        """Return the log-likelihood ratio [nats] of the own outlier rate over the usual one (Kulldorff 1997).

        The own rate is the larger of `lost`, the share of tie points rejected with all views, and `contradicted`. The
        logarithm of the number of views is subtracted.
        """
        rates = np.clip([max(lost, self.contradicted), self.usual], 1e-3, 1.0 - 1e-3)
        own, usual = np.array([rates, 1.0 - rates]).T
        seen = len(self.placed.squared)
        return float(seen * (own * np.log(own / usual)).sum() - np.log(len(self.block.views)))


def find_foreign_camera(
    first: Solution | None, block: Block, outer: Block, options: AdjustOptions, solve: Solver
) -> tuple[ForeignCamera | None, Solution | None]:
    """Find the view whose RPC does not match its image, if there is one, and solve the block without it.

    `first` is the solution with all views (None: there is none); `outer` has the check observations. If `first` fits
    to the noise, only the one view whose correction exceeds its prior is left out, or else each of those with mostly
    rejected tie points. Blocks of fewer than three views or too many unknowns are not searched, nor restricted models.
    """
    num, beyond_prior = len(block.views), None
    unknowns = num if first is None else first.problem.free.size  # a lower bound without a solution
    asked_for_less = options.first_model != GEOMETRIC or options.drift == 0
    if num < 3 or unknowns > LARGEST or asked_for_less:
        return None, None
    lost = np.ones(num) if first is None else lost_shares(first, block)
    rejected = 1.0 - lost <= 0.5 * (1.0 - np.median(lost))  # views with at most half of the usual inlier rate
    candidates = np.argsort(-lost, kind="stable")
    if first is not None:
        candidates = candidates[:TRIED]
        if agrees(first):
            beyond_prior = _beyond_prior(first, block) if num > AMBIGUOUS_VIEWS else None
            candidates = candidates[rejected[candidates]] if beyond_prior is None else np.array([beyond_prior])
        if unknowns > SMALL:
            candidates = candidates[rejected[candidates]]
    views = [v for v in candidates.tolist() if block.names[v] not in options.fixed]
    left: list[LeaveOneOut] = []
    too_few: list[tuple[int, Solution]] = []  # views with too few points for a resection
    for v, others, found in _leave_one_view_out(views, block, outer, options, solve):
        placed = resect(found, others, block, v)
        if placed is None:
            too_few.append((v, found))
            continue
        left.append(LeaveOneOut(v, others, found, placed, placed.contradicted, placed.is_coherent))
        if num > AMBIGUOUS_VIEWS:  # the others fit without it: no second view needs to be tried
            break
    if beyond_prior is not None and first is not None:
        return _by_prior(left, float(first.outcome.prior.scale[beyond_prior]), block)
    chosen = [
        one
        for one in left
        if one.is_foreign or (one.placed.meets and rejected[one.view]) or (first is None and one.disagrees)
    ]  # many wrong matches in one view may prevent a first solution
    chosen = [one for one in chosen if one.gain(lost[one.view]) > SURE]
    if chosen:
        return _likeliest(chosen, left, lost, block)
    # unmodelled drift also raises residuals to a few sigma, which is no reason to leave a view out
    may_be_few = first is None or (len(too_few) == 1 and first.outcome.noise >= OUTLIER)
    return _without_resection(too_few) if may_be_few and too_few else (None, None)


def _without_resection(without: list[tuple[int, Solution]]) -> tuple[ForeignCamera, Solution | None]:
    """Return views with too few points for a resection as candidates; if only one, also the solution without it."""
    foreign = contradicted_view(*(v for v, _ in without))
    return foreign, without[0][1] if foreign.clear else None


def contradicted_view(*views: int) -> ForeignCamera:
    """Return a foreign camera, or candidates for one, without gain, resection and diagnosis."""
    return ForeignCamera(views, np.nan, np.inf, None, np.nan, RpcDiagnosis(as_stated=True), None)


def agrees(found: Solution) -> bool:
    """Return whether a solution fits to the noise, without systematic residuals."""
    return found.outcome.noise < MUCH_NOISE and not found.has_trend and not found.is_skew


def _beyond_prior(found: Solution, block: Block) -> int | None:
    """Return the only view whose correction exceeds its prior, if it has no control points; else None."""
    views = np.flatnonzero(found.outcome.prior.odd)
    if len(views) != 1 or (block.view[block.point >= block.num_tracks] == views[0]).any():
        return None
    return int(views[0])


def _leave_one_view_out(
    views: Sequence[int], block: Block, outer: Block, options: AdjustOptions, solve: Solver
) -> Iterator[tuple[int, Block, Solution]]:
    """Yield each view, the block without it and its solution, where the rest is connected and fits."""
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
        # if most tie points were rejected, the rest fits by the choice of inliers
        if np.delete(lost_shares(found, others), v).max() < 0.5 and agrees(found):
            yield v, others, found


def _by_prior(left: list[LeaveOneOut], scale: float, block: Block) -> tuple[ForeignCamera | None, Solution | None]:
    """Return the view whose correction exceeds its prior by `scale`, if its resection fits."""
    if not left or not left[0].placed.meets:
        return None, None
    (one,) = left
    diagnosis = diagnose_rpc(one.found, block, one.placed, one.view)
    foreign = ForeignCamera((one.view,), np.nan, np.inf, None, one.contradicted, diagnosis, one.placed, scale)
    return foreign, one.found


def _likeliest(
    chosen: list[LeaveOneOut], left: list[LeaveOneOut], lost: Array, block: Block
) -> tuple[ForeignCamera | None, Solution | None]:
    """Return the likeliest of the views `chosen`; `left` are all views without which the rest fits."""
    evidence = {one.view: _tie_evidence(one, block) for one in left} if len(left) > 1 else {chosen[0].view: 0.0}
    chosen = sorted(chosen, key=lambda one: -evidence[one.view])
    best = chosen[0]
    views = tuple(one.view for one in chosen if evidence[one.view] > evidence[best.view] - SURE)
    rest = sorted(((e, v) for v, e in evidence.items() if v not in views), reverse=True)
    gain = best.gain(lost[best.view])
    gap, runner_up = (evidence[best.view] - rest[0][0], rest[0][1]) if rest else (gain, None)
    placed = best.placed if best.placed.meets else None
    diagnosis = diagnose_rpc(best.found, block, best.placed, best.view)
    foreign = ForeignCamera(views, gain, gap, runner_up, best.contradicted, diagnosis, placed)
    logger.info("%s against the others: %.0f nats", ", ".join(block.names[v] for v in views), gain)
    return foreign, best.found if foreign.clear else None


def _tie_evidence(left: LeaveOneOut, block: Block) -> float:
    """Return the log evidence of all tie points of a block, solved without one view.

    Those of the other views follow the mixture. Those of the left-out view are uniformly distributed over the image,
    as wrong matches are: the error of a wrong RPC is not known. All are uniform if the block is too large to linearise.
    """
    ties = int((block.use & (block.point < block.num_tracks)).sum())
    size = np.array([view.size for view in block.views], dtype=np.float64)
    area = float(np.median(size.prod(axis=1)) / np.median(block.sigma) ** 2)
    problem = replace(left.found.outcome.problem, camera_prior=left.found.problem.camera_prior)  # not widened
    known = linearised_among(replace(left.found.outcome, problem=problem), left.block, np.arange(len(left.block.views)))
    if known is None:
        return -ties * float(np.log(area))
    linear, _ = known
    covered = sum(tracks.rows.size for tracks in linear.tracks)
    return fit_mixture(replace(linear, area=area, image_area=area)).evidence - (ties - covered) * float(np.log(area))
