"""Outlier rejection: robust steps with a shrinking scale, then passes of rejection and least squares."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace

import numpy as np

from barpc.ba.constraints.block import Block
from barpc.ba.constraints.ground import PointConstraints
from barpc.ba.evidence.scan import Interval
from barpc.ba.parameters.projected import Projected
from barpc.ba.robust.heldout import robust_points
from barpc.ba.robust.systematic_residuals import NUM_TERMS, NoiseCorrelation, Smooth, SmoothFit, SmoothTest
from barpc.ba.robust.variances import SAME_PRIOR, PriorTest, Variances, same_prior
from barpc.ba.robust.weights import MEDIAN, Observations, geman_mcclure
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import TOLERANCE, Minimum, State, gauss_newton, minimise
from barpc.ba.solving.structure import make_structure
from barpc.base.geodesy import Array
from barpc.base.statistics import (
    BACKFITTING,
    BEST,
    CRITICAL,
    GROSS,
    ITERATIONS,
    MANY,
    MUCH_NOISE,
    OUTLIER,
    SHRINK,
    SLIGHT,
    STANDS,
    STEPS,
    SURELY,
    TRIED,
)
from barpc.scene import BoolArray

logger = logging.getLogger(__name__)

_SMOOTH_SEEN = 0.3  # RMS of smooth parts [sigmas] above which they and the points are estimated alternately
_MIN_NOISE_RATIO = 0.5  # least noise in the robust steps, observed over stated standard deviation
_TRIANGULATE_AGAIN = 0.01  # share of rejected observations above which tracks without inliers are triangulated again
_SAMPLED_VIEWS = 10  # least number of views for robust steps on a sample


@dataclass(frozen=True, kw_only=True)
class Outcome(Minimum):
    """Result of `Rounds`: the last minimum, its observations and residuals."""

    problem: Problem  # with the final priors on the points
    residual: Array  # (2, K) projected - observed [px]
    weight: Array  # (K,) 1 / sigma of the observations in the last solve [1/px]
    inlier: BoolArray  # (K,) observations in the final solve
    noise: float  # observed over stated standard deviation of the observations
    passes: int  # number of passes of rejection and least squares
    told: Array  # (N,) information of the tie points of each view: sum of their squared weights [1/px^2]
    prior: PriorTest  # comparison of the corrections with the given priors, and the estimated priors
    smooth: SmoothTest  # of the final residuals
    by_point: Array  # (2, 3, K) derivatives of the image points by the final ground points [px/m]
    # cache: noise floor [px] -> significant intervals of the images
    significant_intervals: dict[float, list[Interval]] = field(default_factory=dict, init=False, repr=False)


class Rounds:
    """Robust steps, rejection and the final least squares, from observations `use` (K,) and a start `state`.

    `heights` are the constraints on points. Observations are rejected by their residuals without the smooth part of
    their view, because a systematic error of a camera is no error of tie points. `known` is the outcome of an
    adjustment with fewer unknowns. If it is given, the passes start from its inliers, without robust steps. Robust
    steps would reject observations that only the added unknowns explain.
    """

    def __init__(
        self,
        problem: Problem,
        block: Block,
        state: State,
        heights: PointConstraints,
        use: BoolArray,
        known: Outcome | None = None,
    ) -> None:
        unknowns, options = problem.cameras.unknowns, heights.options
        residual, projected = problem.prepare(state.params, state.points)
        self.problem, self.block = heights.hold(problem, state.points), block
        self.state, self.options, self.heights, self.residual = state, options, heights, residual
        is_tie = block.point < block.num_tracks
        of_reference = block.point >= block.num_known
        downweighted = downweighting(block, heights)[block.point]
        sigma = block.sigma * downweighted
        earlier = problem.joint_prior
        told = 0.0 if earlier is None else earlier.told
        self.observations = Observations(self.problem, sigma, options.noise_floor, is_tie, of_reference, told)
        # joint prior of an earlier block, and the mask of the observations in that block
        self.earlier, self.again = (None if block.known is None else earlier), block.known
        noise = NoiseCorrelation.of(block)
        self.smooth = Smooth(problem.structure, problem.xy, unknowns, noise, usable=downweighted == 1.0)
        given, control = problem.camera_prior, heights.has_control
        shown = None if earlier is None else earlier.shown
        self.variances = Variances.of(given, unknowns, options, control, block.views, shown, heights.widest)
        self.learnt: PriorTest | None = None  # test by which the present priors were estimated
        # `known` has the same unknowns: its inliers, priors and misfit are kept
        self.goes_on = known is not None and known.problem.cameras.unknowns is unknowns
        if known is not None and self.goes_on:
            self.problem, use = (replace(self.problem, camera_prior=known.problem.camera_prior), use & known.inlier)
            self.learnt = known.prior
        self.everything = self.observations.tied(block.use & np.isfinite(residual).all(axis=0))
        self.use = self.observations.tied(use & self.everything)
        self.counted = (self.use if known is None else self.use & known.inlier).astype(np.float64)
        self.is_known = known is not None
        self.projected = projected  # projection of the state; None if it was not computed
        self.passes, self.noise = 0, 1.0 if known is None else known.noise
        self.misfit: Array | float = 0.0
        if known is not None and self.goes_on:
            self.misfit = known.smooth.misfit()
        self.scatter: Array | None = None  # residuals without smooth parts; None: not computed yet
        self.weight = self.counted

    def run(self, once: bool = False) -> Outcome:
        """Repeat passes until inliers, weights and priors are constant; with `once` one pass only."""
        if not self.is_known:
            self._search()
        while True:
            outcome = self._reject_and_solve(once)
            if outcome is not None:
                return outcome

    def _search(self) -> None:
        """Run the robust steps, with wider priors on the cameras."""
        start = replace(self.problem, camera_prior=self.variances.for_search())
        given = self.state, self.residual, self.projected
        self.state, self.residual, self.counted, self.noise, self.projected = self._sampled(start) or _robust(
            start, self.observations, given, self.use, self.smooth
        )
        # outliers are included: they raise the misfit, which reduces the weight of their view
        self.misfit = self.smooth.test(self.residual, self.use).misfit()

    def _sampled(self, start: Problem) -> tuple[State, Array, Array, float, Projected | None] | None:
        """Return the result of `_robust`, with the cameras estimated from a sample of the tracks.

        Tracks are drawn until each view has `MANY` observations. The result is None if there are few views, a joint
        prior, or a reference image. It is None if the sample is a quarter of all observations or more. It is also None
        if a view lost a significantly larger share of its sample than the others: its smooth part cannot be
        estimated from so few observations.
        """
        structure, use = start.structure, self.use
        if structure.num_views < _SAMPLED_VIEWS or self.smooth.noise is not None or start.joint_prior is not None:
            return None
        drawn = np.random.default_rng(0).permutation(structure.num_points)[structure.point]
        order = np.lexsort((drawn, ~use, structure.view))
        chosen = np.isin(np.arange(structure.num_points), structure.point[~self.observations.is_tie])
        chosen[structure.point[order[np.arange(len(order)) - structure.bounds[structure.view] < MANY]]] = True
        rest = ~chosen[structure.point]
        if rest.sum() <= 0.75 * len(rest):
            return None
        part = self.block.without(rest)
        seen = make_structure(part.view, part.point, structure.num_views, structure.num_points, structure.place)
        problem = replace(self.problem, cameras=start.cameras.seeing(part.xy), structure=seen, xy=part.xy, _room=[])
        few = Rounds(problem, part, self.state, self.heights, use[~rest])
        few._search()
        kept, count = seen.sum_views(np.stack([few.counted, few.use])).T
        usual = kept.sum() / count.sum()
        if (kept < usual * count - SURELY * np.sqrt(usual * (1.0 - usual) * count)).any():
            return None
        params, sigma = few.state.params, np.where(use, self.observations.sigma * few.noise, np.inf)
        points, counted = robust_points(start, params, self.state.points, sigma)
        residual, projected = start.prepare(params, points)
        squared = self.observations.squared(residual, counted)
        counted = _observation_weights(self.observations, use, squared, counted)
        return replace(few.state, points=points), residual, counted, few.noise, projected

    def _reject_and_solve(self, once: bool) -> Outcome | None:
        """Reject observations, solve, and estimate priors and noise.

        The outcome is returned by the last pass only; else None.
        """
        was_in_use = self.use
        many_rejected = self.use.sum() < (1.0 - _TRIANGULATE_AGAIN) * self.everything.sum()
        if self.passes and many_rejected:
            weight = self.everything / self.observations.sigma
            self.state, self.residual = retriangulate_rejected(
                self.problem, self.state, self.residual, self.use, weight, self.projected
            )
            self.scatter = None
        self.problem = self.heights.hold(self.problem, self.state.points)
        self.passes += 1
        self._reject()
        found = self._solve()
        prior, tested = self.variances.learnt(self.problem, found, self.learnt)
        smooth = self._estimate_noise()
        numbers = self.passes, self.use.sum(), len(self.use), self.noise
        logger.info("pass %d: %d of %d observations, noise %.3f", *numbers)
        again = self.passes > 1 or self.goes_on
        same = again and int((self.use != was_in_use).sum()) <= SLIGHT * len(self.use)
        settled = self._weights_have_converged()
        # an error common to all views affects the accuracy of the scene, but no residual: its prior must converge
        share = STANDS if tested.shared > 1.0 else SAME_PRIOR
        settled &= same_prior(prior, self.problem.camera_prior, share)
        if once or self.passes >= TRIED or (settled and same):
            redundancy = 0.5 * self.observations.mean_freedom(self.use)
            smooth = self.smooth.test_neighbours(smooth, self.residual, self.use, redundancy)
            if found.covariance(self.problem.free).is_large:
                tested = self.variances.learnt(self.problem, found, self.learnt, exact=True)[1]
            return Outcome(
                **vars(found),
                problem=self.problem,
                residual=self.residual,
                weight=self.weight,
                inlier=self.use,
                noise=self.noise,
                passes=self.passes,
                told=self.observations.tie_information(self.use / (self.observations.sigma * self.noise)),
                prior=tested,
                smooth=smooth,
                by_point=self._projection().by_point.copy(),  # the next projection overwrites it
            )
        self.problem, self.learnt = replace(self.problem, camera_prior=prior), tested
        return None

    def _weights_have_converged(self) -> bool:
        """Return whether the new noise and misfit leave the weights of the observations unchanged."""
        next_weight = self.observations.weight(self.use, self.noise, self.misfit)[self.use]
        return bool((np.abs(self.weight[self.use] / next_weight - 1.0) < STANDS).all())

    def _reject(self) -> None:
        """Reject observations by their residuals without the smooth part."""
        scatter = self._scatter() if self.scatter is None else self.scatter
        s = self.observations.squared(scatter, self.use.astype(np.float64))
        near = self.observations.is_near(s, CRITICAL * self.noise)
        self.use = self.observations.tied(self.everything & near)

    def _solve(self) -> Minimum:
        """Minimise the squared residuals of the observations in use; to full convergence from the second pass on."""
        again = self.passes > 1 or self.goes_on
        tolerance = TOLERANCE if again else STANDS
        self.weight = weight = self.observations.weight(self.use, self.noise, self.misfit)
        if self.earlier is not None and self.again is not None:
            given = replace(self.problem, joint_prior=self.earlier)
            known = weight * self.observations.tied(self.use & self.again)
            self.problem = given.counted_once(self.state.params, self.state.points, known)
        found = minimise(self.problem, self.state, weight, self.options.solver, tolerance, self.projected)
        state = found.state
        self.residual, self.projected = found.ahead or self.problem.prepare(state.params, state.points)
        cost = self.problem.cost(state.params, state.points, self.residual * weight)
        self.state = replace(state, cost=cost, history=(*state.history, cost))
        self.counted = self.use.astype(np.float64)
        return replace(found, state=self.state, ahead=None)

    def _estimate_noise(self) -> SmoothTest:
        """Estimate the noise and the misfit of the observations in use; return the test of their smooth part."""
        fit = self.smooth.fit(self.residual, self.counted)
        tested = self.smooth.test(self.residual, self.use, fit)
        self.scatter = self._scatter(fit)
        self.noise = self.observations.noise(self.scatter, self.use, self.problem, 2 * NUM_TERMS * len(fit))
        self.misfit = tested.misfit()
        return tested

    def _projection(self) -> Projected:
        """Return the projection of the state, with derivatives by the points."""
        return self.projected or self.problem.project_points(self.state.params, self.state.points)

    def _scatter(self, fit: SmoothFit | None = None) -> Array:
        """Return the residuals (2, K) [px] without the smooth part of each view.

        A smooth error of one view moves the points, and so changes the residuals of the other views. Smooth parts that
        are not small are therefore estimated alternately with the points (backfitting).
        """
        residual, counted, sigma = self.residual, self.counted, self.observations.sigma
        part = self.smooth.part(residual, counted, fit)
        size = float(np.sqrt((counted * (part / sigma) ** 2).sum() / max(counted.sum(), 1.0)))
        if size < _SMOOTH_SEEN:
            return residual - part
        settled = self.problem.projected_off_points(self._projection(), counted**0.5 / sigma)
        for _ in range(BACKFITTING):
            part += self.smooth.part(settled(residual - part), counted)
        return settled(residual - part)


def downweighting(block: Block, heights: PointConstraints) -> Array:
    """Return the factors (P,) on the standard deviations of the observations of each point.

    The factor is `GROSS` for unused control points, else 1. The total weight of the tie points of a view is limited,
    that of unused control points is not: with factor 1, their common marking error would move the view. In an image
    without tie points the factor is 1, because these points alone connect the image.
    """
    alone = np.bincount(block.view[block.point < block.num_tracks], minlength=len(block.views)) == 0
    downweighted = np.zeros(block.num_points, dtype=bool)
    downweighted[block.num_tracks : block.num_known] = True
    downweighted[block.point[alone[block.view]]] = False
    if heights.has_control:
        downweighted[heights.control[0].index] = False
    return np.where(downweighted, GROSS, 1.0)


def _robust(
    problem: Problem,
    observations: Observations,
    start: tuple[State, Array, Projected | None],
    use: BoolArray,
    smooth: Smooth,
) -> tuple[State, Array, Array, float, Projected | None]:
    """Take robust steps while the scale of the loss shrinks to three standard deviations of the noise.

    Returned are the state, its residuals (2, K), the robust weights (K,), the noise, and the projection of the state.
    The noise is estimated from the weighted median of the squared residuals. It has two lower limits: the noise of the
    best fifth of the residuals, and half of the stated noise. Without these limits, only a few observations that fit by
    chance would keep their weight. Control points are excluded from the estimate if there are other observations: their
    residuals are too small as long as no control fixes their positions.
    """
    state, residual, projected = start
    counted, scale, noise = use.astype(np.float64), np.inf, 1.0
    s = observations.squared(residual, counted)
    tells = use & ~observations.is_control
    tells = tells if tells.any() else use
    for _ in range(ITERATIONS):
        least = float(np.sqrt(np.quantile(s[tells], BEST) / BEST)) if use.any() else 1.0
        noise = max(float(np.sqrt(weighted_median(s[tells], counted[tells]) / MEDIAN)), least, _MIN_NOISE_RATIO)
        if scale <= 3.6 * noise:
            break
        clean = noise < MUCH_NOISE and float((s[use] > (OUTLIER * noise) ** 2).mean()) < SLIGHT
        scale = SURELY * noise if np.isinf(scale) or clean else max(SURELY * noise, SHRINK * scale)
        counted = _observation_weights(observations, use, s, geman_mcclure(s / scale**2)[1])
        state = gauss_newton(problem, state, observations.weight(use, noise) * np.sqrt(counted), projected)
        residual, projected = problem.prepare(state.params, state.points)
        near = scale <= SURELY / SHRINK * noise  # the next scale is the final one
        s = observations.squared(residual - smooth.part(residual, counted) if near else residual, counted)
        counted = _observation_weights(observations, use, s, geman_mcclure(s / scale**2)[1])
    return state, residual, counted, noise, projected


def _observation_weights(observations: Observations, use: BoolArray, squared: Array, by_loss: Array) -> Array:
    """Return the robust weights (K,): 0 if not in use, 1 if exempt (`Observations.is_spared`), else `by_loss`."""
    return np.where(observations.is_spared(squared), use.astype(np.float64), use * by_loss)


def retriangulate_rejected(
    problem: Problem, state: State, residual: Array, use: BoolArray, weight: Array, projected: Projected | None = None
) -> tuple[State, Array]:
    """Triangulate the tracks without inliers again by the present cameras; return the state and residuals (2, K).

    The points of these tracks have not been adjusted since they were rejected, but the cameras have. After a new
    triangulation their observations may be inliers. `projected` is the projection of the state; it is updated in place.
    """
    structure = problem.structure
    dead = structure.sum_points(use[None].astype(np.float64))[0] == 0
    rows = np.flatnonzero(dead[structure.point])
    if not len(rows):
        return state, residual
    points, residual, xy = state.points.copy(), residual.copy(), problem.xy[:, rows]
    seen = make_structure(structure.view[rows], structure.point[rows], structure.num_views, structure.num_points)
    part = replace(problem, cameras=problem.cameras.seeing(xy), structure=seen, xy=xy, _room=[])
    for _ in range(STEPS):
        moved = part.triangulate(points, part.project_points(state.params, points), weight[rows])
        points[dead] = moved[dead]
    again = part.linearise(state.params, points)
    residual[:, rows] = again.image - xy
    if projected is not None:
        for name in ("image", "by_point", "by_unknown"):
            getattr(projected, name)[..., rows] = getattr(again, name)
    return replace(state, points=points), residual


def weighted_median(values: Array, weights: Array) -> float:
    """Return the weighted median of `values` (n,) with `weights` (n,); 1 if all weights are zero."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    if not len(total) or not total[-1] > 0:
        return 1.0
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])
