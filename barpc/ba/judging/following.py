"""A block solved again with splines over the rows and steps between detectors, where residuals ask for them.

Where one detector of a focal plane ends and the next begins change points of the residuals over the columns say. A step
in one view is seen in the residuals of all that share its points, smaller. So the largest changes of all views are
taken first, what they explain is taken out of all residuals, the points following, and so on. Images that are equally
wide may come from one focal plane: then the changes of all are added up. What explains more is taken.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from barpc.ba.constraints.block import Block, make_problem
from barpc.ba.judging.explanations import FOLLOWED, LOCAL, SWING, TRANSIENT
from barpc.ba.judging.judge import Finding, Selection, correlated_noise_gain, standing_out
from barpc.ba.judging.solution import MUCH_BETTER, Solution, finished
from barpc.ba.parameters.additional_parameters import MIN_SPLINES, AdditionalParameters
from barpc.ba.robust.heldout import is_better
from barpc.ba.robust.rounds import Rounds, retriangulate_rejected
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State
from barpc.base.geodesy import Array
from barpc.base.options import AUTO, OFF, AdjustOptions
from barpc.base.statistics import BACKFITTING, FEW, ITERATIONS, LARGEST, SURE
from barpc.scene import BoolArray

_MIN_LOG_RATIO = (
    40.0  # twice the logarithm of a likelihood ratio: the largest of 10,000 places by chance once in 100,000 views
)
_A_VIEW = 4.0  # and so much more for every other view of a focal plane
_AS_LARGE = 0.5  # of the largest change: not what another view's step leaves here, a quarter of it with three views
_SPACING, _DENSER = 2000.0, 4  # rows between knots at first, and how often they are halved
_TWICE = 2  # detectors are looked for, and splines may be no better, one after the other

Edges = list[list[float]]  # of every group of views, ascending


class _Columns:
    """The observations in use of groups of views, which have their detectors in common, in the order of columns."""

    def __init__(self, problem: Problem, use: BoolArray, sigma: Array, groups: list[list[int]]) -> None:
        bounds, col = problem.structure.bounds, problem.xy[0]
        inside = [a + np.flatnonzero(use[a:b]) for a, b in pairwise(bounds)]
        self.order = [rows[np.argsort(col[rows], kind="stable")] for rows in inside]
        self.col = [col[rows] for rows in self.order]
        self.weight = [1.0 / sigma[rows] ** 2 for rows in self.order]
        self.groups = groups
        every = [np.unique(np.concatenate([self.col[v] for v in group])) for group in groups]
        self.places = [0.5 * (one[1:] + one[:-1]) for one in every]

    def means(self, residual: Array, edges: Edges) -> Array:
        """Return every detector's mean (2, K) of residuals (2, K) at its observations in use; zero elsewhere."""
        out = np.zeros_like(residual)
        for group, of_group in zip(self.groups, edges, strict=True):
            for v in group if of_group else ():
                for a, b in pairwise([0, *np.searchsorted(self.col[v], of_group), len(self.col[v])]):
                    rows, weight = self.order[v][a:b], self.weight[v][a:b]
                    out[:, rows] = (residual[:, rows] @ weight / max(weight.sum(), 1e-30))[:, None]
        return out

    def split(self, g: int, low: float, high: float, residual: Array) -> tuple[float, float]:
        """Return the largest change between two columns of a group: what it explains beyond chance, and where."""
        places = self.places[g][np.searchsorted(self.places[g], low) : np.searchsorted(self.places[g], high)]
        if not len(places):
            return 0.0, low
        gain = sum(self._gains(v, low, high, residual, places) for v in self.groups[g])
        at = int(np.argmax(gain))
        return float(np.max(gain)) - _A_VIEW * (len(self.groups[g]) - 1), float(places[at])

    def _gains(self, v: int, low: float, high: float, residual: Array, places: Array) -> Array:
        a, b = np.searchsorted(self.col[v], [low, high])
        at, weight = np.searchsorted(self.col[v], places) - a, self.weight[v][a:b]
        total = np.append(0.0, np.cumsum(weight))
        sums = np.cumsum(residual[:, self.order[v][a:b]] * weight, axis=1)
        sums = np.hstack([np.zeros((2, 1)), sums])
        left, right = np.maximum(total[at], 1e-30), np.maximum(total[-1] - total[at], 1e-30)
        apart = sums[:, at] / left - (sums[:, -1:] - sums[:, at]) / right
        gain = (apart**2).sum(axis=0) * left * right / max(total[-1], 1e-30)
        return np.where((at >= FEW) & (b - a - at >= FEW), gain, 0.0)


def find_edges(problem: Problem, state: State, residual: Array, use: BoolArray, sigma: Array) -> Array:
    """Find the columns (N, C) [px] at which residuals (2, K) [px] step; infinite where a view has fewer."""
    weight, widths = use / sigma, problem.cameras.unknowns.half[0]
    settled = problem.projected_off_points(problem.project_points(state.params, state.points), weight)
    residual, views = settled(_without_steps(problem, state, residual)), list(range(len(widths)))
    edges, cost = _grown(_Columns(problem, use, sigma, [[v] for v in views]), residual, settled, weight)
    if any(edges) and len(views) > 1 and (widths == widths[0]).all():
        common, in_common = _grown(_Columns(problem, use, sigma, [views]), residual, settled, weight)
        edges = common * len(views) if in_common < cost else edges
    out = np.full((len(edges), max(map(len, edges))), np.inf)
    for v, of_view in enumerate(edges):
        out[v, : len(of_view)] = of_view
    return out


def _without_steps(problem: Problem, state: State, residual: Array) -> Array:
    """Return the residuals (2, K) [px] of cameras without the steps that were found before."""
    unknowns, steps = problem.cameras.unknowns, np.zeros_like(residual)
    if unknowns.waves is not None and unknowns.waves.edges.size:
        params = state.params.copy()
        for others in unknowns.waves.kinds[::2]:
            params[:, unknowns.in_waves][:, others] = 0.0
        unknowns.add_waves(steps, steps[:, None, :][:, :0], params, problem.structure.view, problem.xy)
    return residual - steps


def _grown(columns: _Columns, residual: Array, settled: Callable[[Array], Array], weight: Array) -> tuple[Edges, float]:
    """Return the edges of every group, the largest first and then placed, and the cost of what is left."""
    edges: Edges = [[] for _ in columns.groups]
    part = np.zeros_like(residual)
    for _ in range(ITERATIONS):
        left = settled(residual - part)
        found = [
            (g, *columns.split(g, *stretch, left))
            for g, of_group in enumerate(edges)
            for stretch in pairwise([-np.inf, *of_group, np.inf])
        ]
        largest = max(gain for _, gain, _ in found)
        if largest < _MIN_LOG_RATIO:
            break
        for g, gain, col in found:
            if gain >= max(_MIN_LOG_RATIO, _AS_LARGE * largest):
                edges[g] = sorted([*edges[g], col])
        for _ in range(BACKFITTING):
            part += columns.means(settled(residual - part), edges)
    left = settled(residual - part)
    cost = float(((left * weight) ** 2).sum())
    cost += sum(
        len(one) * (_MIN_LOG_RATIO + _A_VIEW * (len(group) - 1))
        for one, group in zip(edges, columns.groups, strict=True)
    )
    return [_edge_positions(columns, g, of_group, part + left) for g, of_group in enumerate(edges)], cost


def _edge_positions(columns: _Columns, g: int, edges: list[float], residual: Array) -> list[float]:
    """Return the edges of a group, each where it is best between its neighbours, that explain enough."""
    found: list[float] = []
    for at in range(len(edges)):
        low = found[-1] if found else -np.inf
        gain, col = columns.split(g, low, edges[at + 1] if at + 1 < len(edges) else np.inf, residual)
        found += [col] if gain >= _MIN_LOG_RATIO else []
    return found


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
        waves = AdditionalParameters(count, _given_edges(block, options))
        if options.detectors:
            tried = _with_waves(found, block, outer, options, waves)
        else:
            tried = _with_edges(_with_waves(found, block, outer, options, waves, True), block, outer, options)
        better = given or (asked and best is found) or is_better(tried.after, best.after, outer)
        best, misses = (tried, 0) if better else (best, misses + 1)
    if best is found or not (given or asked or _explains(best, found, block)):
        return found
    return replace(best, asked={**found.asked, "jitter": found.outcome.smooth})


def _explains(tried: Solution, found: Solution, block: Block) -> bool:
    """Return whether what is followed explains most of what neighbouring ties share, or much is gained.

    Ties that took no part err as their neighbours do: they do not tell cameras from noise that many share.
    """
    left, before = (correlated_noise_gain(one.outcome, block) for one in (tried, found))
    return left <= max(0.5 * before, SURE) or tried.after.error < MUCH_BETTER * found.after.error


def without_strips(found: Solution, judged: Selection, block: Block, outer: Block, options: AdjustOptions) -> Solution:
    """Solve the block with the strips, fades and swings that the judge found.

    Refused where it makes tracks worse that took no part, or no better than what follows an image as a whole.
    """
    parts = [one for one in judged.findings if one.kind in FOLLOWED]
    if not parts or options.jitter == OFF or options.is_plain:
        return found
    waves, params = _waves_of(parts, len(block.views))
    at = _at_selection(found, judged, block)
    tried = _with_waves(at, block, outer, options, waves, start=params)
    if "drift" in found.asked:  # before the parts were found: is it still asked for?
        drift = found.problem.cameras.unknowns.drift - 1
        plain = _with_waves(at, block, outer, options, waves, start=params, drift=drift)
        tried = tried if is_better(tried.after, plain.after, outer) else replace(plain, asked={})
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
    # of parts of few images the fewer unknowns stay, where the others are not surely better
    stays = is_better(tried.after, plain.after, outer) if shaken else not is_better(plain.after, tried.after, outer)
    if not calm or stays:
        return tried
    return plainly if shaken or swing else found


def _at_selection(found: Solution, judged: Selection, block: Block) -> Solution:
    """Return the block where the judge leaves it: cameras, and tracks that meet where its right observations do."""
    outcome, is_tie = found.outcome, block.point < block.num_tracks
    inlier = np.where(is_tie, block.use & (judged.right > 0.5), outcome.inlier)
    ended = outcome.minimum.state
    moved = replace(ended, params=ended.params + judged.step)
    return replace(found, outcome=replace(outcome, inlier=inlier, minimum=replace(outcome.minimum, state=moved)))


def _waves_of(parts: list[Finding], views: int) -> tuple[AdditionalParameters, Array]:
    """Return the unknowns in the image that explanations are, and what these found (N, size)."""
    own = [
        [[one for one in parts if one.view == v and one.kind in kinds] for v in range(views)]
        for kinds in ((*LOCAL, TRANSIENT), (SWING,))
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
    return AdditionalParameters(0, np.zeros((views, 0)), places, periods), params


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
        waves = AdditionalParameters(waves.count, edges)
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
        return [max(min(int(np.ceil(rows / options.spacing)) + 3, most), MIN_SPLINES)]
    most = min(most, LARGEST // (2 * len(block.views)))
    wanted = [int(np.ceil(rows / (_SPACING / 2**n))) + 3 for n in range(_DENSER)]
    dense = np.unique(np.clip(wanted, MIN_SPLINES, most)).tolist() if has_waves and most >= MIN_SPLINES else []
    return dense or [0] * bool(options.detectors)


def _with_waves(
    found: Solution,
    block: Block,
    outer: Block,
    options: AdjustOptions,
    waves: AdditionalParameters,
    once: bool = False,
    start: Array | None = None,
    drift: int | None = None,
) -> Solution:
    """Return a block solved again with splines and steps, from where it ended; every observation may come
    back.

    `start` (N, waves.size) are those unknowns, where something is known of them.
    """
    ended, unknowns = found.outcome.minimum.state, found.problem.cameras.unknowns
    if unknowns.waves is not None:  # strips and swings that were found stay
        waves = replace(waves, strips=unknowns.waves.strips, periods=unknowns.waves.periods)
    bent = make_problem(block, options, unknowns.center, None, unknowns.drift if drift is None else drift, waves)
    params, first = np.zeros_like(bent.camera_prior.mean), bent.cameras.unknowns.in_waves.start
    params[:, :first] = ended.params[:, :first]
    if start is not None:
        params[:, first:] = start
    elif unknowns.waves is not None:
        params[:, unknowns.in_waves.start :] = waves.carried(ended.params[:, unknowns.in_waves], unknowns.waves)
    outcome, weight = found.outcome, block.use / block.sigma
    known = outcome.inlier
    if start is not None:  # the cameras have moved: every point is seen anew, where any are right by these
        count = np.bincount(block.point[known], minlength=bent.structure.num_points)
        weight, known = weight * (known | (count < 2)[block.point]), np.zeros_like(known)
    there, _ = retriangulate_rejected(bent, replace(ended, params=params), outcome.residual, known, weight)
    outcome = Rounds(bent, block, there, found.heights, block.use, outcome).run(once)
    return finished(found, bent, block, outer, options, outcome)
