"""A block solved again with splines over the rows and steps between detectors, where residuals ask for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barpc.ba.estimated.waves import FEWEST, Waves
from barpc.ba.evidence.detectors import find_edges
from barpc.ba.held.block import Block
from barpc.ba.held.starting import make_problem
from barpc.ba.judging.explanations import FOLLOWED, LOCAL, SETTLING, SWING
from barpc.ba.judging.judge import Finding, Judgement, standing_out
from barpc.ba.judging.solution import Solution, finished
from barpc.ba.robust.heldout import is_better
from barpc.ba.robust.rounds import Rounds, revived
from barpc.ba.usual import FEW, LARGEST
from barpc.base.geodesy import Array
from barpc.base.options import AUTO, OFF, AdjustOptions

_SPACING, _DENSER = 2000.0, 4  # rows between knots at first, and how often they are halved
_TWICE = 2  # detectors are looked for, and splines may be no better, one after the other


def follow(found: Solution, block: Block, outer: Block, options: AdjustOptions) -> Solution:
    """Solve the block with splines over the rows and detector steps, where asked for or where residuals show
    them.

    Knots are set twice as dense until nothing is left that neighbours share, the observations are too few, or the
    tracks that took no part are met no better.
    """
    given, asked = options.jitter != AUTO, bool(options.spacing or options.detectors)
    best, misses = found, 0
    for count in _spline_counts(block, options, found.has_waves):
        if misses == _TWICE or not (best.has_waves or (asked and best is found)):
            break
        waves = Waves(count, _given_edges(block, options))
        if options.detectors:
            tried = _with_waves(found, block, outer, options, waves)
        else:
            tried = _with_edges(_with_waves(found, block, outer, options, waves, True), block, outer, options)
        better = given or (asked and best is found) or is_better(tried.after, best.after, outer)
        best, misses = (tried, 0) if better else (best, misses + 1)
    return best if best is found else replace(best, asked={**found.asked, "jitter": found.outcome.smooth})


def without_strips(found: Solution, judged: Judgement, block: Block, outer: Block, options: AdjustOptions) -> Solution:
    """Solve the block with the strips, fades and swings that the judge found.

    Refused where it makes tracks worse that took no part, or no better than what follows an image as a whole.
    """
    parts = [one for one in judged.findings if one.kind in FOLLOWED]
    if not parts or options.jitter == OFF or options.is_plain:
        return found
    waves, params = _waves_of(parts, len(block.views))
    tried = _with_waves(_judged(found, judged, block), block, outer, options, waves, start=params)
    plainly = replace(found, findings=tuple(one for one in found.findings if one.moved is not None))
    if is_better(found.after, tried.after, outer):
        return plainly
    # one image's rows that wander have competed with these already; what all images have in common has not: detectors,
    # or a platform that shakes
    shaken = len({one.view for one in parts}) == len(block.views)
    # of swings the last image may be what the others are seen against
    swing = len({one.view for one in parts if one.kind == SWING}) >= max(len(block.views) - 1, 2)
    if not (shaken or swing) and not any(one.where is not None and one.where[0] == 0 for one in parts):
        return tried
    plain = follow(found, block, outer, options)  # splines and detectors may explain the same, and leave nothing
    left = [sum(one.gain for one in standing_out(of.outcome, block, options.noise_floor)) for of in (plain, tried)]
    calm = plain is not found and left[0] <= left[1]
    least = swing and not shaken  # the fewer unknowns stay, where the others are not surely better
    stays = not is_better(plain.after, tried.after, outer) if least else is_better(tried.after, plain.after, outer)
    if not calm or stays:
        return tried
    return plainly if shaken or swing else found


def _judged(found: Solution, judged: Judgement, block: Block) -> Solution:
    """Return the block where the judge leaves it: cameras, and tracks that meet where its right observations do."""
    outcome, is_tie = found.outcome, block.point < block.num_tracks
    inlier = np.where(is_tie, block.use & (judged.right > 0.5), outcome.inlier)
    ended = outcome.minimum.state
    moved = replace(ended, params=ended.params + judged.step)
    return replace(found, outcome=replace(outcome, inlier=inlier, minimum=replace(outcome.minimum, state=moved)))


def _waves_of(parts: list[Finding], views: int) -> tuple[Waves, Array]:
    """Return the unknowns in the image that explanations are, and what these found (N, size)."""
    own = [
        [[one for one in parts if one.view == v and one.kind in kinds] for v in range(views)]
        for kinds in ((*LOCAL, SETTLING), (SWING,))
    ]
    most = [max(map(len, of_kind)) for of_kind in own]
    places, periods = np.full((views, most[0], 5), np.inf), np.full((views, most[1]), np.inf)
    moved, swung = np.zeros((views, 2, most[0])), np.zeros((views, 2, 2, most[1]))
    for v, (strips, of_swings) in enumerate(zip(*own, strict=True)):
        for n, one in enumerate(strips):
            assert one.where is not None
            places[v, n], moved[v, :, n] = one.where, one.unknowns
        for n, one in enumerate(of_swings):
            assert one.period is not None
            periods[v, n], swung[v, :, :, n] = one.period, one.unknowns.reshape(2, 2)
    params = np.hstack([moved.reshape(views, -1), swung.reshape(views, -1)])
    return Waves(0, np.zeros((views, 0)), places, periods), params


def _with_edges(found: Solution, block: Block, outer: Block, options: AdjustOptions) -> Solution:
    """Return the block, of which one pass was solved with splines, with steps between detectors where
    residuals show them.

    What they explain shows others: it is looked for them again.
    """
    waves = found.problem.cameras.unknowns.waves
    assert waves is not None
    for _ in range(_TWICE if found.has_waves else 0):
        outcome = found.outcome
        sigma = block.sigma * outcome.noise
        edges = find_edges(outcome.problem, found.final, outcome.residual, outcome.inlier, sigma)
        if edges.shape[1] <= waves.edges.shape[1]:
            break
        waves = Waves(waves.count, edges)
        found = _with_waves(found, block, outer, options, waves)
    return found if waves.edges.size else _with_waves(found, block, outer, options, waves)


def _given_edges(block: Block, options: AdjustOptions) -> Array:
    return np.tile(np.array(options.detectors, dtype=np.float64) - 0.5, (len(block.views), 1))


def _spline_counts(block: Block, options: AdjustOptions, has_waves: bool) -> list[int]:
    """Return the numbers of splines to try, the fewest first, as many as the observations of a view hold."""
    rows = max(view.size[1] for view in block.views)
    if options.jitter == OFF or options.is_plain:
        return [0] if options.detectors else []
    most = int(np.median(np.bincount(block.view[block.use], minlength=len(block.views)))) // FEW
    if options.spacing:
        return [max(min(int(np.ceil(rows / options.spacing)) + 3, most), FEWEST)]
    most = min(most, LARGEST // (2 * len(block.views)))
    wanted = [int(np.ceil(rows / (_SPACING / 2**n))) + 3 for n in range(_DENSER)]
    dense = np.unique(np.clip(wanted, FEWEST, most)).tolist() if has_waves and most >= FEWEST else []
    return dense or [0] * bool(options.detectors)


def _with_waves(
    found: Solution,
    block: Block,
    outer: Block,
    options: AdjustOptions,
    waves: Waves,
    once: bool = False,
    start: Array | None = None,
) -> Solution:
    """Return a block solved again with splines and steps, from where it ended; every observation may come
    back.

    `start` (N, waves.size) are those unknowns, where something is known of them.
    """
    ended, unknowns = found.outcome.minimum.state, found.problem.cameras.unknowns
    if unknowns.waves is not None:  # strips and swings that were found stay
        waves = replace(waves, strips=unknowns.waves.strips, periods=unknowns.waves.periods)
    bent = make_problem(block, options, unknowns.center, None, unknowns.drift, waves)
    params = np.zeros_like(bent.camera_prior.mean)
    params[:, : unknowns.in_waves.start] = ended.params[:, : unknowns.in_waves.start]
    if start is not None:
        params[:, unknowns.in_waves.start :] = start
    elif unknowns.waves is not None:
        params[:, unknowns.in_waves.start :] = waves.carried(ended.params[:, unknowns.in_waves], unknowns.waves)
    outcome, weight = found.outcome, block.use / block.sigma
    known = outcome.inlier
    if start is not None:  # the cameras have moved: every point is seen anew, where any are right by these
        count = np.bincount(block.point[known], minlength=bent.structure.num_points)
        weight, known = weight * (known | (count < 2)[block.point]), np.zeros_like(known)
    there, _ = revived(bent, replace(ended, params=params), outcome.residual, known, weight)
    outcome = Rounds(bent, block, there, found.heights, block.use, outcome).run(once)
    return finished(found, bent, block, outer, options, outcome)
