"""Check points and check tie points: they are kept out of the adjustment and measure its accuracy.

Inliers of an adjustment agree because the others were rejected. Therefore a tenth of all tracks is kept out before, and
triangulated by the adjusted cameras. These tracks contain wrong matches. Their errors are therefore modelled as a
mixture, normal for right matches and uniform for wrong ones. The noise is that of the right matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import expit, gammaln

from barpc.ba.constraints.block import Block
from barpc.ba.evidence.mixture import NEAR_LIMIT, WRONG_SHARE_PRIOR
from barpc.ba.robust.weights import Observations, geman_mcclure
from barpc.ba.solving.problem import Problem
from barpc.base.errors import InputError, listed
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis
from barpc.base.statistics import BEST, CONVERGED, CRITICAL, FEWEST, ITERATIONS, MANY, STEPS, SURE, SURELY
from barpc.scene import BoolArray, GroundPoints, IntArray
from barpc.sensor import SensorModel
from barpc.sensor.triangulation import triangulate

_CHECK_SHARE = 0.1  # of all tracks
_STEPS_PER_PIXEL = 4.0  # of coordinates rounded for the hash: changes of their last digits alter few draws
_MIN_VARIANCE = float(np.finfo(np.float64).tiny)  # reached if all residuals are zero


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Residuals of check tie points, and the noise of each view estimated from them."""

    residual: Array  # (2, H) projected - observed [px]; the points are triangulated by the cameras
    index: IntArray  # (Q,) point numbers of the check tie points
    points: Array  # (Q, 3) the triangulated points, ECEF [m]
    noise: Array  # (N,) observed over stated standard deviation in each view; NaN with too few observations
    rms: Array  # (N,) expected RMS residual of right matches with this noise [px]

    @property
    def error(self) -> float:
        """Root mean square of `noise` over the views, without a unit; NaN if it is known for no view."""
        return _finite_rms(self.noise)

    @property
    def whole_rms(self) -> float:
        """Root mean square of `rms` over the views [px]; NaN if it is known for no view."""
        return _finite_rms(self.rms)


def _finite_rms(values: Array) -> float:
    """Return the root mean square of the finite values (n,); NaN if none is finite."""
    known = values[np.isfinite(values)]
    return float(np.sqrt((known**2).mean())) if len(known) else np.nan


def keep_out(block: Block) -> BoolArray:
    """Return the mask (K,) of the observations of about every tenth track, to be kept out of the adjustment.

    Tracks are drawn by a hash of their image coordinates, so the choice does not depend on the order of rows or views.
    Tracks that a view with few observations needs are not drawn.
    """
    few = np.bincount(block.view[block.use], minlength=len(block.views)) < MANY
    needed = np.bincount(block.point[few[block.view] | ~block.use], minlength=block.num_points)
    count = np.bincount(block.point, minlength=block.num_points)
    drawn = np.zeros(block.num_points, dtype=np.uint64)
    col, row = np.rint(block.xy * _STEPS_PER_PIXEL).astype(np.int64).astype(np.uint64)
    np.add.at(drawn, block.point, splitmix64(col * np.uint64(0x9E3779B97F4A7C15) + row))
    chosen = splitmix64(drawn) < np.uint64(_CHECK_SHARE * 2.0**64)
    chosen &= (count >= 2) & (needed == 0) & (np.arange(block.num_points) < block.num_tracks)
    return chosen[block.point]


def splitmix64(numbers: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Return pseudo-random hashes of numbers (the finalizer of SplitMix64, Steele et al. 2014)."""
    numbers = (numbers ^ (numbers >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    numbers = (numbers ^ (numbers >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return numbers ^ (numbers >> np.uint64(31))


def problem_of_block(problem: Problem, params: Array, block: Block) -> tuple[Problem, Array]:
    """Return the problem with the observations of `block` alone, and the points (Q, 3) triangulated from these.

    `params` (N, q) are the unknowns of the cameras. The points have no prior.
    """
    index, structure = block.own_points
    cameras = problem.cameras.seeing(block.xy)
    part = replace(problem, cameras=cameras, structure=structure, xy=block.xy, point_prior=None, _room=[])
    first = block.first_points()[index]
    return part, part.triangulate(first, part.project_points(params, first), 1.0 / block.sigma)


def robust_points(problem: Problem, params: Array, first: Array, sigma: Array) -> tuple[Array, Array]:
    """Triangulate points (P, 3) with a robust loss; return them and the robust weights (K,).

    `params` (N, q) are the camera unknowns and `sigma` (K,) [px] the standard deviations. The cameras are linearised at
    the points `first`.
    """
    xy, counted = problem.xy, np.ones(len(sigma))
    projected = problem.project_points(params, first)  # `first` is near the solution, where the projection is linear
    points = problem.triangulate(first, projected, 1.0 / sigma)
    for _ in range(STEPS):  # enough to reject one of three observations
        residual = projected.image - xy
        residual += (projected.by_point * problem.structure.of_points(points - first)).sum(axis=1)
        counted = geman_mcclure((residual**2).sum(axis=0) / (CRITICAL * sigma) ** 2)[1]
        points = problem.triangulate(first, projected, np.sqrt(counted) / sigma)
    return points, counted


def measure(problem: Problem, params: Array, block: Block) -> HeldOut:
    """Measure the residuals and the noise of the check tie points of `block` by cameras with unknowns (N, q)."""
    views = len(block.views)
    if not len(block.view):
        unknown = np.full(views, np.nan)
        return HeldOut(np.zeros((2, 0)), block.point, np.zeros((0, 3)), unknown, unknown)
    index = block.own_points[0]
    part, first = problem_of_block(problem, params, block)
    observations = Observations(part, block.sigma, 0.0, np.ones(len(block.view), dtype=bool))
    points, counted = robust_points(part, params, first, block.sigma)
    residual = part.residuals(params, points)
    squared = observations.squared(residual, counted)
    expected = block.sigma**2 * observations.freedom(counted)
    count, noise = np.bincount(block.view, minlength=views), np.full(views, np.nan)
    many = count >= FEWEST
    many_rows = many[block.view]
    number = (np.cumsum(many) - 1)[block.view[many_rows]]
    noise[many] = noise_ratios(squared[many_rows], expected[many_rows] / block.sigma[many_rows] ** 2, number)
    rms = noise * np.sqrt(np.bincount(block.view, expected, views) / np.maximum(count, 1))
    return HeldOut(residual, index, points, noise, rms)


def noise_ratios(squared: Array, freedom: Array, view: IntArray) -> Array:
    """Return the observed over stated standard deviation (N,) of right matches in each view.

    Up to half of the matches may be wrong. Squared residuals of right matches are chi-square distributed; residuals of
    wrong ones are uniform up to the largest. The parameters are found by expectation maximisation. The log density of
    wrong matches is at least `NEAR_LIMIT` nats below the peak of that of right matches. Otherwise right matches in the
    tails would count as wrong.

    Parameters
    ----------
    squared : (K,)
        Squared residuals, divided by their expectations from the stated standard deviations.
    freedom : (K,)
        Degrees of freedom of each observation.
    view : (K,)
        View numbers 0 .. N - 1, ascending; each has at least one observation.
    """
    half = 0.5 * np.maximum(freedom, 1.0)  # at least 1: two views have residuals across the epipolar line only
    starts = np.flatnonzero(np.diff(view, prepend=-1))
    count = np.diff(starts, append=len(view)).astype(np.float64)
    ordered = squared[np.lexsort((squared, view))]
    at = BEST * (count - 1.0)
    low = ordered[starts + np.floor(at).astype(np.int64)]
    middle = low + (at % 1.0) * (ordered[starts + np.ceil(at).astype(np.int64)] - low)
    far = np.maximum(ordered[starts + count.astype(np.int64) - 1], _MIN_VARIANCE)
    variance = np.maximum(middle / BEST, _MIN_VARIANCE)
    wrong = np.full(len(count), WRONG_SHARE_PRIOR[0] / WRONG_SHARE_PRIOR[1])
    log_far, constant = half * np.log(half * far[view]) - gammaln(half + 1.0), half * squared
    moves = np.ones(len(count), dtype=bool)  # views that have not converged
    for _ in range(ITERATIONS):
        peak = np.maximum(log_far - half * np.log(variance)[view], NEAR_LIMIT)
        right = expit(peak - constant / variance[view] - np.log(wrong / (1.0 - wrong))[view])
        of_right, squares = (np.add.reduceat(rows, starts) for rows in (right, right * squared))
        found = np.maximum(squares / np.maximum(of_right, 1e-300), _MIN_VARIANCE)
        converged = np.abs(found - variance) < CONVERGED * variance
        variance = np.where(moves, found, variance)
        wrong = np.where(moves, (WRONG_SHARE_PRIOR[0] + count - of_right) / (WRONG_SHARE_PRIOR[1] + count), wrong)
        moves &= ~converged
        if not moves.any():
            break
    return np.asarray(np.sqrt(variance))


def is_better(one: HeldOut, other: HeldOut, block: Block) -> bool:
    """Return whether the residuals of the check tracks of `block` are significantly smaller in `one` than in `other`.

    The robust losses of each track are compared, because both adjustments have the same matching errors.
    """
    if not len(block.point) or not one.error < other.error:
        return False
    index, point = np.unique(block.point, return_inverse=True)
    cost = [(h.residual**2).sum(axis=0) / (other.error * block.sigma) ** 2 for h in (one, other)]
    less = np.bincount(point, geman_mcclure(cost[1] / CRITICAL**2)[0] - geman_mcclure(cost[0] / CRITICAL**2)[0])
    return bool(less.mean() > SURELY * less.std() / np.sqrt(len(index)))


def is_admitted(tried: HeldOut, before: HeldOut, block: Block, evidence: float = 0.0) -> bool:
    """Return whether a model with more unknowns, or fewer observations, is preferred to the one before.

    `evidence` is the log evidence of all observations for the model [nats]. If it is significant, the model is
    preferred unless the residuals of the check tracks of `block` grow significantly. Otherwise it is preferred only if
    these residuals shrink significantly.
    """
    return not is_better(before, tried, block) if evidence > SURE else is_better(tried, before, block)


@dataclass(frozen=True, eq=False)
class CheckResiduals:
    """Residuals of known points under given cameras.

    Parameters
    ----------
    image : (M, 2)
        Projected - observed [px] of every observation.
    ground : (G, 3)
        Triangulated - known, east, north, up [m]; NaN for a point that fewer than two views see.
    """

    image: Array
    ground: Array

    def rms(self) -> tuple[Array, Array]:
        """Return the RMS of col, row (2,) [px], and that of east, north, up (3,) [m].

        The RMS of east, north, up is NaN if no point is triangulated.
        """
        known = np.isfinite(self.ground).all(axis=1)
        ground = np.full(3, np.nan)
        if known.any():
            ground = np.sqrt((self.ground[known] ** 2).mean(axis=0))
        return np.sqrt((self.image**2).mean(axis=0)), ground


def check_residuals(sensors: Sequence[SensorModel], points: GroundPoints) -> CheckResiduals:
    """Return the residuals of known points under given cameras.

    Parameters
    ----------
    sensors : sequence of SensorModel
        One for each view: `Adjustment.sensors`, or the sensors as delivered.
    points : GroundPoints
        Check points.

    Returns
    -------
    CheckResiduals
    """
    image = np.empty((len(points.view), 2))
    for v in np.unique(points.view):
        rows = points.view == v
        image[rows] = sensors[v].project(points.lonlatalt[points.point[rows]]) - points.xy[rows]
    ground = np.full((len(points.names), 3), np.nan)
    seen = np.bincount(points.point, minlength=len(points.names)) >= 2
    rows = np.flatnonzero(seen[points.point])
    if len(rows):
        order = rows[np.lexsort((points.view[rows], points.point[rows]))]
        index, place = np.unique(points.point[order], return_inverse=True)
        found = triangulate(list(sensors), points.view[order], place.ravel(), points.xy[order])
        ground[index] = enu_offsets(found.points, points.lonlatalt[index])
    return CheckResiduals(image, ground)


def enu_offsets(points: Array, known: Array) -> Array:
    """Return the east, north, up (n, 3) [m] of points, ECEF [m], minus known lon, lat, alt (n, 3)."""
    offset = points - ecef_from_ground(known)
    return (enu_basis(known) @ offset[..., None])[..., 0]


def split_points(points: GroundPoints, checks: Sequence[str]) -> tuple[GroundPoints, GroundPoints]:
    """Split points into control for the solve and check points that stay out of it.

    Parameters
    ----------
    points : GroundPoints
        All of them.
    checks : sequence of str
        Names of the check points.

    Returns
    -------
    control, check : GroundPoints

    Raises
    ------
    InputError
        A name is not among the points.
    """
    unknown = sorted(set(checks) - set(points.names))
    if unknown:
        raise InputError(f"no ground point is named {listed(unknown)}")
    is_check = np.isin(np.array(points.names, dtype=object), list(checks))
    return points.select(~is_check), points.select(is_check)
