"""The solution of a block with one model: start, rounds of outlier rejection, residuals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from barpc.ba.constraints.block import MIN_OBSERVATIONS, Block, first_state, make_problem
from barpc.ba.constraints.ground import PointConstraints, staying
from barpc.ba.constraints.incremental import BlockPrior
from barpc.ba.constraints.shape import MOST_SIGMAS, Deformation, shape_change
from barpc.ba.constraints.terrain import Terrain
from barpc.ba.control.agreement import UNCONSTRAINED_SIGMA, Agreement, agreement, offsets_of
from barpc.ba.control.snooping import ControlTest, control_test
from barpc.ba.parameters.priors import DRIFT_SIGMA, NOISE_FLOOR
from barpc.ba.robust.consensus import agreeing
from barpc.ba.robust.heldout import HeldOut, is_better, measure
from barpc.ba.robust.rounds import Outcome, Rounds, downweighting, retriangulate_rejected
from barpc.ba.robust.systematic_residuals import SmoothTest
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State
from barpc.ba.solving.structure import Structure
from barpc.ba.terms.term import Finding
from barpc.base.errors import AdjustError
from barpc.base.geodesy import Array, enu_basis, ground_from_ecef
from barpc.base.options import AUTO, AdjustOptions
from barpc.base.statistics import MUCH_NOISE, SURELY
from barpc.scene import BoolArray

_FAR_OFF = 150.0  # m: larger offsets from a reference exceed the accuracy of delivered cameras
_TREND = MUCH_NOISE * NOISE_FLOOR  # px: with larger systematic residuals, other models are tried
SURE_TREND = SURELY * NOISE_FLOOR  # px: smaller displacements of an image may be of its tie points
_SKEW = 1e-3  # largest usual drift, relative to half the image length: 3 microradian per second
CLEARLY = 0.8  # largest ratio of noise to accept another start; also least fraction of inliers of a view


@dataclass(frozen=True, eq=False)
class Solution:
    """A block solved with one model."""

    problem: Problem  # of the last solve
    state: State  # at the start: delivered cameras, points triangulated with them
    before: Array  # (2, K) residuals at `state` [px]
    heights: PointConstraints  # priors on points
    outcome: Outcome  # of the rounds of outlier rejection
    start: HeldOut  # check tie points at the start
    after: HeldOut  # check tie points at the end
    tested: ControlTest | None  # tests of control points
    # "drift", "jitter" -> systematic residuals for which the degree was raised, or splines and steps were added
    asked: Mapping[str, SmoothTest] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()  # terms and moving groups, in order of selection
    agreed: Agreement | None = None  # selection of control points
    deformed: Deformation | None = None  # of an image by control

    @property
    def final(self) -> State:
        """The state at the end."""
        return self.outcome.state

    @property
    def goes_on(self) -> bool:
        """Whether it continues an earlier run."""
        return self.problem.joint_prior is not None and self.problem.joint_prior.earlier

    @property
    def seen(self) -> BoolArray:
        """Mask (P,) of points with an inlier."""
        seen = np.zeros(self.problem.structure.num_points, dtype=bool)
        seen[self.problem.structure.point[self.outcome.inlier]] = True
        return seen

    def first_points(self, block: Block, some: BoolArray) -> Array:
        """Return the points `some` (P,) triangulated by the delivered cameras, (P, 3) [m]; NaN for others.

        The image points are projections by the adjusted cameras, so the difference to the adjusted points is due to the
        cameras alone. There are no priors on points, except on the altitude of weak points.
        """
        points, projected, weak = self.final.points, self.outcome.residual + self.problem.xy, self.heights.weak
        reprojected = replace(self.problem, xy=projected, point_prior=staying(points, np.flatnonzero(some & weak)))
        points = np.where(weak[:, None], points, self.state.points)  # close enough for one linear step
        delivered = self.problem.project_points(self.problem.camera_prior.mean, points)
        points = reprojected.triangulate(points, delivered, block.use / block.sigma)
        return np.where(some[:, None], points, np.nan)

    @property
    def has_trend(self) -> bool:
        """Whether another model may be better: residuals are systematic, or much larger at check tie points."""
        return bool(self.outcome.smooth.found(_TREND).any()) or self._has_large_check_residuals

    @property
    def has_waves(self) -> bool:
        """Whether splines or detector steps may be better: neighbouring residuals are correlated.

        Jitter may also cause rejections; then the residuals of check tie points are much larger than those of inliers.
        """
        tested = self.outcome.smooth
        return bool((tested.found(_TREND) | (tested.shared > _TREND)).any()) or self._has_large_check_residuals

    @property
    def _has_large_check_residuals(self) -> bool:
        """Whether residuals of check tie points are much larger than those of the inliers."""
        return self.after.error > MUCH_NOISE * self.outcome.noise

    @property
    def is_skew(self) -> bool:
        """Whether the estimated drift shears images more than platforms do; the image may have been resampled."""
        learnt = self.outcome.prior.drift_sigma
        if not learnt or learnt[0] < 2.0 * DRIFT_SIGMA:
            return False
        problem = self.problem
        by_point = problem.project_points(self.final.params, self.final.points).by_point
        pixels = float(np.nanmedian(np.linalg.norm(by_point[1], axis=0)))  # per metre
        return learnt[0] > _SKEW * float(np.median(problem.cameras.unknowns.half[1])) / pixels


def solve_block(
    block: Block,
    outer: Block,
    options: AdjustOptions,
    dem: Terrain | None,
    centers: Array | None,
    prior: BlockPrior | None,
) -> Solution:
    """Solve a block with the model in the options: with tie points first, then with the control points that agree.

    If residuals suggest it, the block is solved again from a consensus of observations or with a higher degree of the
    drift. `outer` has the check observations.
    """
    problem = make_problem(block, options, centers, prior)
    state, given = first_state(_shifted_to_reference(problem, block), block, options, dem)
    heights = given.loose(UNCONSTRAINED_SIGMA) if block.gcps.names else given
    start = measure(problem, state.params, outer)
    rounds = Rounds(problem, block, state, heights, block.use)
    before, agreed, free = rounds.residual, None, None
    if block.gcps.names and not (block.point < block.num_tracks).any():  # only control constrains the cameras
        agreed, heights = _with_control(block, given, rounds.run(once=True))
        rounds = Rounds(problem, block, state, heights, block.use)
    outcome = rounds.run()
    if _is_suspect(outcome, problem.structure, block.use):
        projected = problem.project_points(state.params, state.points)
        agree = agreeing(problem.structure, problem.xy, before, projected, block.sigma, block.use)
        again = Rounds(problem, block, state, heights, agree).run()
        if again.noise < CLEARLY * outcome.noise and again.inlier.sum() > 0.5 * agree.sum():
            outcome = again
    drift = problem.cameras.unknowns.drift
    asked = dict[str, SmoothTest]()
    may_grow = options.drift is None and options.terms == AUTO and prior is None and drift
    if may_grow and outcome.smooth.found(SURE_TREND).any():
        less = outcome
        problem, outcome = _with_more_drift((problem, less), block, options, heights)
        asked = {} if outcome is less else {"drift": less.smooth}
    if block.gcps.names and agreed is None:
        free = Solution(problem, state, before, heights, outcome, start, start, None, asked)
        agreed, heights = _with_control(block, given, outcome)
        outcome = Rounds(problem, block, outcome.state, heights, block.use, outcome).run()
    _check_inliers(outcome, block)
    first = Solution(problem, state, before, heights, outcome, start, start, None, asked, (), agreed)
    found = finished(first, problem, block, outer, outcome)
    if free is not None and found.heights.has_control:
        found = _without_distorting_control(found, free, block, outer, options)
    return found if prior is not None else _without_deformation(found, block, outer)


def _shifted_to_reference(problem: Problem, block: Block) -> Problem:
    """Return the problem with cameras translated by their offsets from a reference, where these are large.

    The adjustment would not converge over hundreds of metres.
    """
    unknowns = problem.cameras.unknowns
    if block.reference is None or not unknowns.translates or problem.joint_prior is not None:
        return problem
    offset = np.nan_to_num(block.reference.offset)
    offset[np.linalg.norm(offset, axis=1) < _FAR_OFF] = 0.0
    if not offset.any():
        return problem
    ground = ground_from_ecef(unknowns.center)
    east, north, _ = np.moveaxis(enu_basis(ground), 1, 0)
    mean = problem.camera_prior.mean.copy()
    start = 3 * unknowns.rotates
    mean[:, start : start + 3] -= offset[:, :1] * east + offset[:, 1:] * north
    return replace(problem, camera_prior=replace(problem.camera_prior, mean=mean))


def _without_deformation(found: Solution, block: Block, outer: Block) -> Solution:
    """Return the solution; if control deforms an image, it is solved again with drift priors from tie points alone.

    Without tie points nothing is changed: control points must determine the drift.
    """
    heights, problem = found.heights, found.problem
    if not heights.kinds or not (block.point < block.num_tracks).any():
        return found
    sigmas, px = shape_change(problem, found.final.params, block.views)
    if not sigmas.max() > MOST_SIGMAS:
        return found
    start = State(np.zeros_like(found.final.params), found.state.points)
    free = Rounds(problem, block, start, heights.without_control(UNCONSTRAINED_SIGMA), block.use).run()
    by_ties, _ = shape_change(problem, free.state.params, block.views)
    view = int((sigmas - by_ties).argmax())
    if not sigmas[view] - by_ties[view] > MOST_SIGMAS:
        return found
    heights = replace(heights, widest=free.prior.wide)
    outcome = Rounds(problem, block, start, heights, block.use).run()
    deformed = Deformation(view, float(sigmas[view]), float(px[view]), heights.kinds)
    return finished(replace(found, heights=heights, deformed=deformed), problem, block, outer, outcome)


def _with_more_drift(
    solved: tuple[Problem, Outcome], block: Block, options: AdjustOptions, heights: PointConstraints
) -> tuple[Problem, Outcome]:
    """Return problem and outcome with one more degree of drift; those given if that rejects most of the inliers."""
    problem, outcome = solved
    unknowns = problem.cameras.unknowns
    more = make_problem(block, options, unknowns.center, None, unknowns.drift + 1)
    final, weight = outcome.state, block.use / block.sigma
    start, _ = retriangulate_rejected(problem, final, outcome.residual, outcome.inlier, weight)
    start = replace(start, params=np.hstack([start.params, np.zeros((len(block.views), 3))]))
    tried = Rounds(more, block, start, heights, outcome.inlier).run()
    # few remaining observations fit any model
    return (more, tried) if tried.inlier.sum() > 0.5 * outcome.inlier.sum() else solved


def _check_inliers(outcome: Outcome, block: Block) -> None:
    """Raise AdjustError if no view has enough inliers and no control point is an inlier."""
    kept = np.bincount(block.view[outcome.inlier])
    if kept.max(initial=0) < MIN_OBSERVATIONS and not (block.point[outcome.inlier] >= block.num_tracks).any():
        raise AdjustError(
            f"too few tie points agree: of {int(block.use.sum())} observations {int(kept.sum())} are inliers, and an "
            f"image needs {MIN_OBSERVATIONS}; give more matches, and check that all images show the same ground"
        )


def _without_distorting_control(
    found: Solution, free: Solution, block: Block, outer: Block, options: AdjustOptions
) -> Solution:
    """Return the solution with control `found`, or the one without, `free`, if control raises the check residuals."""
    without = measure(free.problem, free.final.params, outer)
    raised = found.after.whole_rms**2 - without.whole_rms**2
    # allowed increase [px^2]: noise_floor, the common error of the tie points of a view, once for each of q unknowns
    allowed = free.final.params.shape[1] * options.noise_floor**2
    if raised <= allowed or not is_better(without, found.after, outer):
        return found
    assert found.agreed is not None
    none = Agreement(np.zeros_like(found.agreed.used), torn=(without.whole_rms, found.after.whole_rms))
    return finished(replace(free, agreed=none), free.problem, block, outer, free.outcome)


def _with_control(block: Block, heights: PointConstraints, outcome: Outcome) -> tuple[Agreement, PointConstraints]:
    """Return the control points selected by an outcome without control, and the constraints with these points."""
    every, first = np.arange(len(block.gcps.names)), block.num_tracks
    point = block.point - first
    rejected = np.isin(every, point[block.use & ~outcome.inlier])  # outliers by hundreds of sigmas
    testable = np.isin(every, point[outcome.inlier]) & ~rejected
    # observed, but on moving ground that was excluded
    moving = np.isin(every, block.gcps.point) & ~np.isin(every, point[block.use])
    covariance = outcome.covariance(outcome.problem.free)
    faint = downweighting(block, heights.loose(UNCONSTRAINED_SIGMA))
    found = agreement(offsets_of(covariance, block, outcome.state.points, faint), testable)
    found = replace(found, used=found.used & ~rejected & ~moving)
    kept = heights.control[0].select(found.used[heights.control[0].index - first])
    kept = replace(kept, rows=kept.rows / found.scale)
    return found, replace(heights, control=(kept, *heights.control[1:]), has_control=bool(found.used.any()))


def finished(found: Solution, problem: Problem, block: Block, outer: Block, outcome: Outcome) -> Solution:
    """Return `found` with a new problem and outcome; control points are tested and check residuals measured."""
    tested = None
    if found.agreed is not None:
        covariance, points = outcome.covariance(problem.free), outcome.state.points
        faint = downweighting(block, found.heights)[block.num_tracks : block.num_known]
        tested = control_test(covariance, points, block.num_tracks, block.gcps, found.agreed, faint)
    after = measure(problem, outcome.state.params, outer)
    return replace(found, problem=problem, outcome=outcome, after=after, tested=tested)


def _is_suspect(outcome: Outcome, structure: Structure, use: BoolArray) -> bool:
    """Return whether the rounds may have ended in a local minimum: large noise, or a view with many outliers."""
    had, kept = (structure.sum_views(rows.astype(np.float64)[None])[:, 0] for rows in (use, outcome.inlier))
    return outcome.noise > MUCH_NOISE or bool((kept < CLEARLY * had).any())
