"""Search for terms that explain the residuals of a solved block, rejected observations included."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from barpc.ba.constraints.block import Block
from barpc.ba.evidence.linearised import Linear, array_elements, linearise
from barpc.ba.evidence.mixture import MixtureFit, fit_mixture
from barpc.ba.robust.rounds import Outcome, retriangulate_rejected
from barpc.ba.select.anomalies import image_sizes, periods_of, significant_intervals
from barpc.ba.select.beam import Selection, TermSearch
from barpc.ba.solving.solve import State
from barpc.ba.terms.moving_ground import GroundMotion
from barpc.ba.terms.term import Residuals
from barpc.base.statistics import KEPT, LARGEST, SLIGHT, SMALL
from barpc.scene import IntArray

logger = logging.getLogger(__name__)

MAX_OBSERVATIONS = KEPT
"""Observations of the largest block that is searched."""
_NEAREST = 12  # views that are searched together in a large block


def search_terms(outcome: Outcome, block: Block, floor: float, moving: bool = True) -> Selection:
    """Find the terms of a block beside its cameras, in order of selection; none if no residuals are significant.

    With `moving`, moving objects are among them.

    In a block of more unknowns than `SMALL` each image with significant residuals is searched together with those
    that share most tracks with it. A search that selects moving objects there is discarded.
    """
    size, views = outcome.problem.free.size, np.arange(len(block.views))
    if size > LARGEST or len(block.view) > MAX_OBSERVATIONS:
        return Selection()
    suspects = [one.view for one in significant_intervals(outcome, block, floor)]
    if not suspects or size > SMALL:
        suspects += [one.view for one in periods_of(outcome, block)]
    if size <= SMALL:
        # moving ground may have systematic residuals without a significant interval of rows or columns
        systematic = outcome.smooth.found(floor).any()
        return _search_views(outcome, block, floor, views, moving) if suspects or systematic else Selection()
    found = Selection((), np.zeros((len(views), size // len(views))), outcome.inlier.astype(np.float64))
    done: set[int] = set()
    for view in dict.fromkeys(suspects):
        if view not in done:
            views = _neighbour_views(block, view)
            done.update(views.tolist())
            one = _search_views(outcome, block, floor, views, moving)
            if one.findings and one.findings[-1].moved is None:
                found = _with_findings(found, one, views, np.flatnonzero(np.isin(block.view, views)))
    return found if found.findings else Selection()


def _search_views(outcome: Outcome, block: Block, floor: float, views: IntArray, moving: bool) -> Selection:
    """Search the tie points of some views; the result numbers views and observations from 0 among these."""
    found = linearised_among(outcome, block, views)
    if found is None:
        return Selection()
    linear, state = found
    rows, ground = np.flatnonzero(np.isin(block.view, views)), GroundMotion.of(outcome.problem, state)
    linear, ground = linear.of_views(views), ground.part(rows)
    nothing, place = np.zeros((2, 0, len(rows))), block.xy[:, rows]
    number, outs = np.full(len(block.views), -1), significant_intervals(outcome, block, floor)
    number[views] = np.arange(len(views))
    try:
        base, few = _base_fit(linear, outcome, rows), linear.thinned()
        seen = Residuals(linear, few, ground, place, image_sizes(block)[:, views], base, nothing, np.zeros(0))
        first = [replace(one, view=int(number[one.view])) for one in outs if number[one.view] >= 0]
        return TermSearch(seen, first, floor, float(np.median(block.sigma)), moving).run()
    except np.linalg.LinAlgError as error:  # priors so wide that rounding dominates the weakest mode
        logger.warning("the residuals of the tie points are not explained: %s", error)
        return Selection()


def _base_fit(linear: Linear, outcome: Outcome, rows: IntArray) -> MixtureFit:
    """Return the mixture fit of the observations `rows` (K,) at the solution; its noise is at most that of inliers.

    If many observations are displaced, a fit with larger noise has more evidence, but hides them. Therefore the fit has
    the larger evidence of those with the limit and without it: terms must exceed both.
    """
    right, count = outcome.inlier[rows].astype(np.float64), np.bincount(linear.view, minlength=linear.views)
    wrong = np.bincount(linear.view, 1.0 - right, linear.views) / np.maximum(count, 1)
    nothing, eps = np.zeros(0), np.clip(wrong, SLIGHT, 1.0 - SLIGHT)
    solved = MixtureFit(-np.inf, np.zeros(linear.shape), nothing, outcome.noise, eps, right)
    kept, free = (fit_mixture(linear, warm=solved, noisiest=most) for most in (outcome.noise, np.inf))
    return replace(kept, evidence=max(kept.evidence, free.evidence))


def _neighbour_views(block: Block, view: int) -> IntArray:
    """Return a view and up to `_NEAREST` - 1 others that share most tracks with it, ascending."""
    ties = block.use & (block.point < block.num_tracks)
    of_view = np.zeros(block.num_points, dtype=bool)
    of_view[block.point[ties & (block.view == view)]] = True
    shared = np.bincount(block.view[ties & of_view[block.point]], minlength=len(block.views))
    shared[view] = len(ties) + 1
    nearest = np.argsort(-shared, kind="stable")[:_NEAREST]
    return np.sort(nearest[shared[nearest] > 0])


def _with_findings(all_of: Selection, one: Selection, views: IntArray, rows: IntArray) -> Selection:
    """Return `all_of` extended by the selection `one` among some views, whose observations are `rows` of the block."""
    step, right = all_of.step.copy(), all_of.right.copy()
    new = ~step[views].any(axis=1)
    step[views[new]] = one.step[new]
    right[rows] = one.right
    findings = (
        replace(row, view=int(views[row.view]), or_of=tuple(int(views[v]) for v in row.or_of)) for row in one.findings
    )
    return Selection((*all_of.findings, *findings), step, right)


def linearised_among(outcome: Outcome, block: Block, views: IntArray) -> tuple[Linear, State] | None:
    """Linearise the tie points of some views at the solution of a block; None if there are none or too many."""
    problem = outcome.problem
    use = block.use & (block.point < block.num_tracks) & np.isin(block.view, views)
    unknowns = problem.free.size // len(block.views) * len(views)
    if not use.any() or unknowns > SMALL or array_elements(np.bincount(block.point[use])) > 30 * KEPT:  # 240 MB
        return None
    state, _ = retriangulate_rejected(problem, outcome.state, outcome.residual, outcome.inlier, block.use / block.sigma)
    low, high = block.alt_range
    return linearise(problem, state, use, block.sigma, high - low), state
