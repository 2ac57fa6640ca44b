"""The entry: tracks in, corrections out."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from barpc.ba.block import Block, join
from barpc.ba.cameras import Cameras
from barpc.ba.consensus import agreeing, two_groups
from barpc.ba.covariance import Covariance
from barpc.ba.datum import datum_shares
from barpc.ba.detectors import find_edges
from barpc.ba.gauge import GaugeReport, gauge_report
from barpc.ba.ground import Heights, Terrain, convergence_angles, ground_control, reference_control
from barpc.ba.heldout import HeldOut, enu_offsets, is_better, keep_out, measure
from barpc.ba.incremental import BlockPrior, apply_prior
from barpc.ba.priors import DRIFT_SIGMA, CameraPrior, prior_sigmas
from barpc.ba.problem import Problem
from barpc.ba.result import Adjustment
from barpc.ba.rounds import MAX_PASSES, Outcome, Rounds, revived
from barpc.ba.smooth import SmoothTest
from barpc.ba.snooping import MOST_TESTED, ControlTest, control_test, image_test
from barpc.ba.solve import State
from barpc.ba.structure import Structure, make_structure
from barpc.ba.unknowns import make_unknowns
from barpc.ba.waves import Waves
from barpc.geodesy import Array
from barpc.options import AUTO, OFF, AdjustOptions
from barpc.scene import BoolArray, GroundPoints, Reference, Tracks, View

SMOOTH_LEAST = 0.06  # smooth residuals below this [px] are left alone: two views share what one is wrong by
_TREND = 0.03  # px: another model is tried
_MUCH_NOISE = 1.5  # times what is stated
_MUCH_LOST = 0.85  # of a view's observations are to be left
_SKEW = 1e-3  # of half an image's length, as drift: 3 microradian a second
_MANY_KEPT = 0.99  # of the observations: the others do not tell in a mean
_BETTER = 0.8  # of the noise
_WORTH = 0.004  # px that an affine must take away: it leaves the tilts of the scene open
_CLEARLY_BETTER = 0.9  # the same, where the drift that was learnt is no drift
_MUCH_BETTER = 0.7  # of the error on tracks that took no part: another model may do much to heights
_SPACING, _DENSER = 2000.0, 4  # rows between knots at first, and how often they are halved
_PER_SPLINE = 30  # observations of a view
_FEWEST = 7  # splines
_LOOKS = 2  # for detectors
_MISSES = 2  # one after the other
_MOST_SPLINES = 4000  # of all views: what a block of 300 takes is 2.6 times as long
_FIRST_STEPS = 1  # and one more: what is left is far below a pixel, and the solver takes it


def adjust_tracks(
    views: Sequence[View],
    tracks: Tracks,
    options: AdjustOptions | None = None,
    gcps: GroundPoints | None = None,
    dem: Terrain | None = None,
    *,
    centers: Array | None = None,
    prior: BlockPrior | None = None,
    reference: Reference | None = None,
    keep_largest: bool = False,
    hold_out: bool = True,
) -> Adjustment:
    """Correct the cameras of a block so that its tie points agree.

    Parameters
    ----------
    views, tracks : sequence of View, Tracks
        N views and their tie points; `Tracks.view` counts the views.
    options : AdjustOptions or None, None: the defaults
    gcps : GroundPoints or None, points of known position and where they are seen
    dem : callable or None
        lon, lat (n,) [deg] -> altitude (n,) [m above the ellipsoid], NaN outside.
    centers : (N, 3) or None
        Camera centres [m], ECEF; None: regressed from the sensors.
    prior : BlockPrior or None
        An earlier block, whose views are among these: its corrections and their joint covariance are the
        prior. `tracks` then holds new observations only.
    reference : Reference or None, control of an orthoimage and the terrain `dem`
    keep_largest, hold_out : bool
        Go on with the largest group of views where they are not all connected; keep a tenth of the tracks out, to
        measure the result on.

    Returns
    -------
    Adjustment

    Raises
    ------
    TiePointError, DisconnectedError
        A view has too few observations; the views fall into groups that share no tie point.
    AdjustError
        There is no usable solution.
    InputError
        Views, tracks and options contradict each other.
    """
    start = time.process_time()
    options = AdjustOptions() if options is None else options
    block = join(tuple(views), tracks, gcps, options, keep_largest, reference)
    rows = keep_out(block) if hold_out else np.zeros_like(block.use)
    inner, outer = block.without(rows), block.without(~rows)
    found, in_space = _choose_model(inner, outer, options, dem, centers, prior)
    found.heights.warn()
    return _adjustment(found, inner, outer, options, in_space, start)


@dataclass(frozen=True, eq=False)
class _Solution:
    """A block solved with one model."""

    problem: Problem  # as it was solved last
    state: State  # where it started: delivered cameras, points triangulated with them
    before: Array  # (2, K) residuals there [px]
    heights: Heights  # what holds points
    outcome: Outcome  # of the rounds
    start: HeldOut  # what the tracks that took no part say before
    after: HeldOut  # and after
    tested: ControlTest | None  # control points against the rest
    # "drift", "jitter" -> what was smooth before another degree was taken, splines or steps followed
    asked: Mapping[str, SmoothTest] = field(default_factory=dict)

    @property
    def final(self) -> State:
        """The minimum."""
        return self.outcome.minimum.state

    @property
    def seen(self) -> BoolArray:
        """Points (P,) with an observation that was kept."""
        seen = np.zeros(self.problem.structure.num_points, dtype=bool)
        seen[self.problem.structure.point[self.outcome.inlier]] = True
        return seen

    def first_points(self, block: Block) -> Array:
        """Where the delivered cameras put the points (P, 3) [m] if what was cut is seen where it should be."""
        points, kept = self.state.points, self.outcome.inlier
        if kept.sum() < _MANY_KEPT * block.use.sum():
            problem, final, delivered = self.problem, self.final, self.problem.camera_prior.mean
            mended = replace(problem, xy=problem.residuals(final.params, final.points) + problem.xy)
            for _ in range(_FIRST_STEPS + 1):
                projected = problem.project_points(delivered, points)
                points = mended.triangulate(points, projected, block.use / block.sigma)
        return points

    @property
    def has_trend(self) -> bool:
        """Whether something is left that another model may follow: smooth, or in what was cut."""
        left = bool(self.outcome.smooth.found(_TREND).any())
        return left or self.after.error > _MUCH_NOISE * self.outcome.noise

    @property
    def has_waves(self) -> bool:
        """Whether neighbours share something that splines over the rows or steps between detectors may follow."""
        tested = self.outcome.smooth
        return bool((tested.found(_TREND) | (tested.shared > _TREND)).any())

    @property
    def is_skew(self) -> bool:
        """Whether the drift that was learnt shears images more than a platform does: one of them was turned."""
        learnt = self.outcome.prior.drift_sigma
        if not learnt or learnt[0] < 2.0 * DRIFT_SIGMA:
            return False
        problem = self.problem
        by_point = problem.project_points(self.final.params, self.final.points).by_point
        pixels = float(np.nanmedian(np.linalg.norm(by_point[1], axis=0)))  # a metre
        return learnt[0] > _SKEW * float(np.median(problem.cameras.unknowns.half[1])) / pixels


def _choose_model(
    block: Block,
    outer: Block,
    options: AdjustOptions,
    dem: Terrain | None,
    centers: Array | None,
    prior: BlockPrior | None,
) -> tuple[_Solution, float | None]:
    """The block solved; by an affine in the image where the data choose it, and what the model in space left [px]."""
    found, in_space = _solve(block, outer, options, dem, centers, prior), None
    given = options.model != AUTO or options.drift is not None or prior is not None
    skew, chosen = found.is_skew, found
    trend = skew or found.has_trend or found.has_waves
    if trend and not given and _bent_by_control(found, block, outer, options, dem, centers):
        return found, None
    if (skew or found.has_trend) and not given:
        in_image = _solve(block, outer, replace(options, model="affine"), dem, None, None)
        better = in_image.after.error < (_CLEARLY_BETTER if skew else _MUCH_BETTER) * found.after.error
        if better and in_image.after.whole_rms < found.after.whole_rms - _WORTH:
            chosen, in_space = in_image, found.after.whole_rms
    if prior is None and found.problem.cameras.unknowns.geometric:
        followed = _followed(found, block, outer, options)
        if chosen is found or followed.after.error < _MUCH_BETTER * chosen.after.error:
            return followed, None
    return chosen, in_space


def _followed(found: _Solution, block: Block, outer: Block, options: AdjustOptions) -> _Solution:
    """The block with splines over the rows and steps between detectors, where asked for or where they tell.

    Knots are set twice as dense until nothing is left that neighbours share, the observations are too few, or the
    tracks that took no part are met no better.
    """
    given, asked = options.jitter != AUTO, bool(options.spacing or options.detectors)
    best, misses = found, 0
    for count in _spline_counts(block, options, found.has_waves):
        if misses == _MISSES or not (best.has_waves or (asked and best is found)):
            break
        waves = Waves(count, _given_edges(block, options))
        if options.detectors:
            tried = _with_waves(found, block, outer, options, waves)
        else:
            tried = _with_edges(_with_waves(found, block, outer, options, waves, 1), block, outer, options)
        better = given or (asked and best is found) or is_better(tried.after, best.after, outer)
        best, misses = (tried, 0) if better else (best, misses + 1)
    return best if best is found else replace(best, asked={**found.asked, "jitter": found.outcome.smooth})


def _with_edges(found: _Solution, block: Block, outer: Block, options: AdjustOptions) -> _Solution:
    """The block, of which one pass was solved with splines, with steps between detectors where residuals show them.

    What they explain shows others: it is looked for them again.
    """
    waves = found.problem.cameras.unknowns.waves
    assert waves is not None
    for _ in range(_LOOKS if found.has_waves else 0):
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
    """Numbers of splines to try, the fewest first, as many as the observations of a view hold."""
    rows = max(view.size[1] for view in block.views)
    if options.jitter == OFF:
        return [0] if options.detectors else []
    most = int(np.median(np.bincount(block.view[block.use], minlength=len(block.views)))) // _PER_SPLINE
    if options.spacing:
        return [max(min(int(np.ceil(rows / options.spacing)) + 3, most), _FEWEST)]
    most = min(most, _MOST_SPLINES // len(block.views))
    wanted = [int(np.ceil(rows / (_SPACING / 2**n))) + 3 for n in range(_DENSER)]
    dense = np.unique(np.clip(wanted, _FEWEST, most)).tolist() if has_waves and most >= _FEWEST else []
    return dense or [0] * bool(options.detectors)


def _with_waves(
    found: _Solution,
    block: Block,
    outer: Block,
    options: AdjustOptions,
    waves: Waves,
    most: int = MAX_PASSES,
) -> _Solution:
    """A block solved again with splines and steps, from where it ended; every observation may come back."""
    problem, ended = found.problem, found.outcome.minimum.state
    unknowns = problem.cameras.unknowns
    bent = make_problem(block, options, unknowns.center, None, unknowns.drift, waves)
    there, _ = revived(problem, ended, found.outcome.residual, found.outcome.inlier, block.use / block.sigma)
    known = unknowns.waves.kinds[0].stop if unknowns.waves and unknowns.waves.count == waves.count else 0
    params = np.zeros_like(bent.camera_prior.mean)
    params[:, : unknowns.in_waves.start + known] = there.params[:, : unknowns.in_waves.start + known]
    there = replace(there, params=params)
    outcome = Rounds(bent, block, there, options, found.heights, block.use, found.outcome).run(most)
    return _ended(found, bent, block, outer, options, outcome)


def _bent_by_control(
    found: _Solution,
    block: Block,
    outer: Block,
    options: AdjustOptions,
    dem: Terrain | None,
    centers: Array | None,
) -> bool:
    """Whether a trend is there only because control points that contradict something pull at the cameras."""
    if found.tested is None or found.tested.agrees:
        return False
    free = _solve(block.without(block.point >= block.num_tracks), outer, options, dem, centers, None)
    return not (free.is_skew or free.has_trend or free.has_waves)


def _solve(
    block: Block,
    outer: Block,
    options: AdjustOptions,
    dem: Terrain | None,
    centers: Array | None,
    prior: BlockPrior | None,
) -> _Solution:
    """Rounds with the model of the options, again from an agreement or with more drift where they ask for it.

    Measured on the observations of `outer`.
    """
    problem = make_problem(block, options, centers, prior)
    state, heights = _start(problem, block, options, dem)
    start = measure(problem, state.params, outer)
    rounds = Rounds(problem, block, state, options, heights, block.use)
    before, outcome = rounds.residual, rounds.run()
    if options.loss != "linear" and _is_suspect(outcome, problem.structure, block.use):
        projected = problem.project_points(state.params, state.points)
        agree = agreeing(problem.structure, problem.xy, before, projected, block.sigma, block.use)
        again = Rounds(problem, block, state, options, heights, agree).run()
        if again.noise < _BETTER * outcome.noise and again.inlier.sum() > 0.5 * agree.sum():
            outcome = again
    drift, asked = problem.cameras.unknowns.drift, dict[str, SmoothTest]()
    if options.drift is None and prior is None and drift and outcome.smooth.found(SMOOTH_LEAST).any():
        bent = make_problem(block, options, problem.cameras.unknowns.center, None, drift + 1)
        ended, weight = outcome.minimum.state, block.use / block.sigma
        there, _ = revived(problem, ended, outcome.residual, outcome.inlier, weight)
        there = replace(there, params=np.hstack([there.params, np.zeros((len(block.views), 3))]))
        asked = {"drift": outcome.smooth}
        problem, outcome = bent, Rounds(bent, block, there, options, heights, outcome.inlier).run()
    first = _Solution(problem, state, before, heights, outcome, start, start, None, asked)
    return _ended(first, problem, block, outer, options, outcome)


def _ended(
    found: _Solution, problem: Problem, block: Block, outer: Block, options: AdjustOptions, outcome: Outcome
) -> _Solution:
    """What the rounds of a problem ended with, its control tested and measured; where it started is `found`'s."""
    heights, tested = found.heights, None
    if block.gcps.names:
        outcome, heights, tested = _tested(problem, block, options, outcome, heights, found.state)
    after = measure(problem, outcome.minimum.state.params, outer)
    return replace(found, problem=problem, heights=heights, outcome=outcome, after=after, tested=tested)


def _tested(
    problem: Problem, block: Block, options: AdjustOptions, outcome: Outcome, heights: Heights, start: State
) -> tuple[Outcome, Heights, ControlTest]:
    """The block without the control points that the rounds cut, then without those that the rest finds wrong, one at a
    time and the worst first; each time solved from the start, as a gross error takes good tie points with it.
    """
    control, start = heights.control[0], replace(start, params=problem.camera_prior.mean)
    points, weight = start.points.copy(), block.use / block.sigma
    of_points = np.arange(block.num_tracks, block.num_known)
    cut = np.isin(of_points, block.point[block.use & ~outcome.inlier])
    used = np.ones(len(cut), dtype=bool)
    while True:
        if cut.any():
            used = used & ~cut
            heights = replace(heights, control=(control.select(used), *heights.control[1:]))
            let_go = heights.hold(problem, points)
            for _ in range(_FIRST_STEPS + 1):  # where their rays see them
                moved = let_go.triangulate(points, let_go.project_points(start.params, points), weight)
                points[of_points[cut]] = moved[of_points[cut]]
            there = replace(start, points=points.copy())
            outcome = Rounds(problem, block, there, options, heights, block.use).run()
        covariance = outcome.minimum.covariance(problem.free)
        final = outcome.minimum.state.points
        tested = control_test(covariance, final, block.num_tracks, block.gcps, used)
        culprit = tested.culprit()
        if culprit is None:
            return outcome, heights, tested
        cut = np.arange(len(used)) == culprit


def _adjustment(
    found: _Solution, block: Block, outer: Block, options: AdjustOptions, in_space: float | None, start: float
) -> Adjustment:
    """What is handed out, in the order of the tracks given."""
    outcome, final, seen = found.outcome, found.final, found.seen
    covariance = outcome.minimum.covariance(found.problem.free)
    projected = found.problem.project_points(final.params, final.points)
    cameras = found.problem.cameras
    points = np.where(seen[:, None], final.points, np.nan)
    points[found.after.index] = found.after.points
    inlier = block.in_order(outcome.inlier)
    ties = slice(0, len(inlier) - (block.point >= block.num_tracks).sum())
    is_tie = found.problem.structure.point < block.num_tracks
    view = np.maximum(block.in_order(block.view), outer.in_order(outer.view))[ties]
    before, after = (
        (block.in_order(inside.T) + outer.in_order(outside.residual.T))[ties]
        for inside, outside in ((found.before, found.start), (outcome.residual, found.after))
    )
    gauge, shares = _place(found, block, covariance)
    status = f"{outcome.passes} passes of cutting; {outcome.minimum.status}; {covariance.factor.method} factorisation"
    return Adjustment(
        names=block.names,
        sensors=cameras.unknowns.corrected(final.params, block.views),
        params=final.params,
        points=points[: block.num_tracks],
        residuals_before=before,
        residuals=after,
        inlier=inlier[ties],
        held_out=outer.in_order(np.ones(len(outer.view), dtype=bool))[ties],
        held_out_rms=found.after.rms,
        held_out_noise=found.after.noise,
        view=view,
        noise=outcome.noise,
        cost_history=final.history,
        steps=len(final.history) - outcome.passes,
        status=status,
        cameras=cameras,
        covariance=covariance,
        gauge=gauge,
        datum=shares,
        prior=outcome.prior,
        smooth=outcome.smooth,
        asked=found.asked,
        in_space_rms=in_space,
        two_groups=two_groups(found.problem.structure, outcome.residual, projected, outcome.inlier & is_tie),
        held=found.heights.weak[: block.num_tracks],
        terrain=found.heights.test(final.points, seen),
        left_out=block.left_out,
        **_control(found, block, covariance, inlier[ties.stop :]),
        seconds=time.process_time() - start,
        options=options,
    )


def _control(found: _Solution, block: Block, covariance: Covariance, inlier: BoolArray) -> dict[str, Any]:
    """What is said of GCPs and of a reference's points, whose observations (M + R,) were kept or not."""
    w, gcps = block.in_order(_control_w(found, block, covariance)), len(block.gcps.view)
    w = w[len(w) - len(inlier) :]
    return {
        "control": found.tested,
        "gcp_inlier": inlier[:gcps],
        "reference_inlier": inlier[gcps:],
        "gcp_w": w[:gcps],
        "reference_w": w[gcps:],
        "gcp_residuals": enu_offsets(
            found.final.points[block.num_tracks : block.num_known], block.gcps.lonlatalt
        ),
    }


def _control_w(found: _Solution, block: Block, covariance: Covariance) -> Array:
    """Baarda's w (K,) of the observations of known points; NaN for all others, and those that do not count."""
    outcome, w = found.outcome, np.full(len(block.point), np.nan)
    held = outcome.problem.point_prior
    is_held = outcome.inlier & (False if held is None else np.isin(block.point, held.index))
    of_gcps = np.flatnonzero(is_held & (block.point >= block.num_tracks) & (block.point < block.num_known))
    others = np.flatnonzero(is_held & (block.point >= block.num_known))
    rows = np.union1d(of_gcps, others[:: -(-len(others) // MOST_TESTED)] if len(others) else others)
    if len(rows):
        at_end = (found.final, outcome.residual, outcome.weight)
        w[rows] = image_test(covariance, outcome.problem, *at_end, rows)
    return w


def _place(found: _Solution, block: Block, covariance: Covariance) -> tuple[GaugeReport, Mapping[str, Array]]:
    """Where the scene went and how well that is known, and what holds it."""
    placed = found.seen & (np.arange(len(found.seen)) < block.num_known)
    counted = placed if placed.any() else found.seen
    gauge = gauge_report(covariance, found.final.points, found.first_points(block), counted)
    known, outcome = (block.num_tracks, block.num_known), found.outcome
    shares = datum_shares(covariance, gauge.by_unknown, outcome.problem, found.final, outcome.weight, *known)
    return gauge, shares


def _first_drift(options: AdjustOptions, prior: BlockPrior | None) -> int:
    """The degree of the drift to start with."""
    if options.drift is not None:
        return options.drift
    if prior is not None:
        return prior.drift
    return int("rotation" in options.first_model)


def _is_suspect(outcome: Outcome, structure: Structure, use: BoolArray) -> bool:
    """Whether the rounds may have ended between two solutions: much noise, or a view that lost much."""
    had, kept = (structure.sum_views(rows.astype(np.float64)[None])[:, 0] for rows in (use, outcome.inlier))
    return outcome.noise > _MUCH_NOISE or bool((kept < _MUCH_LOST * had).any())


def make_problem(
    block: Block,
    options: AdjustOptions,
    centers: Array | None,
    prior: BlockPrior | None,
    drift: int | None = None,
    waves: Waves | None = None,
) -> Problem:
    """Observations, cameras and priors, before anything is known about points; `drift` instead of the options'."""
    views = block.views
    drift = _first_drift(options, prior) if drift is None else drift
    if prior is not None:
        waves = prior.waves(block.names)
        centers = _known_centers(block, options, centers, prior)
    unknowns = make_unknowns(views, options.first_model, drift, centers, waves)
    off = None if block.reference is None else np.linalg.norm(block.reference.offset, axis=1)
    sigma = prior_sigmas(views, options, drift, off, 0 if waves is None else waves.size)
    on_cameras, jointly = CameraPrior(np.zeros_like(sigma), sigma), None
    if prior is not None:
        radars = [block.names[v] for v in unknowns.radars]
        on_cameras, jointly = apply_prior(prior, block.names, options.first_model, drift, on_cameras, radars)
    joined = None if jointly is None else np.unique(jointly.index // unknowns.size)
    return Problem(
        Cameras(views, unknowns, block.xy),
        make_structure(block.view, block.point, len(views), block.num_points, unknowns.place, joined),
        block.xy,
        on_cameras,
        np.repeat([name not in options.fixed for name in block.names], unknowns.size),
        jointly,
    )


def _known_centers(block: Block, options: AdjustOptions, centers: Array | None, prior: BlockPrior) -> Array:
    """Camera centres (N, 3) [m]: the earlier block's where it had them."""
    if centers is None:
        centers = make_unknowns(block.views, options.first_model).center
    known = dict(zip(prior.names, prior.center, strict=True))
    return np.array([known.get(name, center) for name, center in zip(block.names, centers, strict=True)])


def _start(
    problem: Problem, block: Block, options: AdjustOptions, dem: Terrain | None
) -> tuple[State, Heights]:
    """Points triangulated with the delivered cameras, and what holds those that the rays do not."""
    params = problem.camera_prior.mean
    points = block.first_points()
    points[~np.isfinite(points)] = 0.0
    control = [ground_control(block.gcps, np.arange(block.num_tracks, block.num_known))]
    if block.reference is not None:
        control.append(reference_control(block.reference, np.arange(block.num_known, block.num_points)))
    projected = problem.project_points(params, points)
    seen = np.bincount(block.point, minlength=block.num_points) > 0
    angles = convergence_angles(problem.structure, projected, points)
    weak = seen & (angles < np.radians(options.min_convergence))
    tracks = np.flatnonzero(seen[: block.num_tracks])
    heights = Heights(tuple(control), weak, tracks, block.alt_range, options, dem, block.reference)
    weight = block.use / block.sigma
    for _ in range(_FIRST_STEPS):
        points = heights.hold(problem, points).triangulate(points, projected, weight)
        projected = problem.project_points(params, points)
    points = heights.hold(problem, points).triangulate(points, projected, weight)
    return State(params, points), heights
