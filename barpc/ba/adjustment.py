"""The entry: tracks in, corrections out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from barpc.ba.block import Block, join
from barpc.ba.blocks import CameraPrior, Terrain, ground_control
from barpc.ba.cameras import Cameras
from barpc.ba.consensus import agreeing
from barpc.ba.gauge import gauge_report
from barpc.ba.heights import Heights, convergence_angles
from barpc.ba.incremental import BlockPrior, apply_prior
from barpc.ba.priors import prior_sigmas
from barpc.ba.problem import Problem
from barpc.ba.result import Adjustment
from barpc.ba.rounds import Observations, Outcome, revived, run_rounds
from barpc.ba.smooth import Smooth
from barpc.ba.solve import State
from barpc.ba.structure import Structure, make_structure
from barpc.ba.unknowns import make_unknowns
from barpc.ba.variances import Variances
from barpc.geodesy import Array, ecef_from_ground, enu_basis
from barpc.options import AdjustOptions
from barpc.scene import BoolArray, GroundPoints, Tracks, View

SMOOTH_LEAST = 0.06
"""Smooth residuals below this [px] are left alone: two views share what one is wrong by."""

_MUCH_NOISE = 1.5  # times what is stated
_MUCH_LOST = 0.85  # of a view's observations are to be left
_BETTER = 0.8  # of the noise

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
    keep_largest: bool = False,
) -> Adjustment:
    """Correct the cameras of a block so that its tie points agree.

    Parameters
    ----------
    views : sequence of View
        N views; `Tracks.view` counts them.
    tracks : Tracks
        Tie points.
    options : AdjustOptions or None
        None: the defaults.
    gcps : GroundPoints or None
        Points of known position and where they are seen.
    dem : callable or None
        lon, lat (n,) [deg] -> altitude (n,) [m above the ellipsoid], NaN outside.
    centers : (N, 3) or None
        Camera centres [m], ECEF; None: regressed from the sensors.
    prior : BlockPrior or None
        An earlier block, whose views are among these: they start at its corrections, and its joint
        covariance is their prior. `tracks` then holds new observations only.
    keep_largest : bool
        Go on with the largest group of views where they are not all connected.

    Returns
    -------
    Adjustment

    Raises
    ------
    TiePointError
        A view has too few observations.
    DisconnectedError
        The views fall into groups that share no tie point.
    AdjustError
        There is no usable solution.
    InputError
        Views, tracks and options contradict each other.
    """
    start = time.process_time()
    options = AdjustOptions() if options is None else options
    views = tuple(views)
    block = join(views, tracks, gcps, options, keep_largest)
    problem = make_problem(block, options, centers, prior)
    drift = problem.cameras.unknowns.drift
    state, heights = _start(problem, block, options, gcps, dem)
    heights.warn()
    before = problem.residuals(state.params, state.points)
    outcome = _rounds(problem, block, state, options, heights, block.use)
    if options.loss != "linear" and _is_suspect(outcome, problem.structure, block.use):
        projected = problem.project_points(state.params, state.points)
        agree = agreeing(problem.structure, problem.xy, before, projected, block.sigma, block.use)
        again = _rounds(problem, block, state, options, heights, agree)
        if again.noise < _BETTER * outcome.noise and again.inlier.sum() > 0.5 * agree.sum():
            outcome = again
    if options.drift is None and prior is None and drift and outcome.smooth.found(SMOOTH_LEAST).any():
        bent = make_problem(block, options, problem.cameras.unknowns.center, None, drift + 1)
        there, _ = revived(
            problem, outcome.minimum.state, outcome.residual, outcome.inlier, block.use / block.sigma
        )
        there = replace(there, params=np.hstack([there.params, np.zeros((len(views), 3))]))
        problem, outcome = bent, _rounds(bent, block, there, options, heights, outcome.inlier, outcome.noise)
    final = outcome.minimum.state
    covariance = outcome.minimum.covariance(problem.free)
    seen = np.zeros(block.num_points, dtype=bool)
    seen[block.point[outcome.inlier]] = True
    gauge = gauge_report(covariance, final.points, state.points, seen)
    cameras = problem.cameras
    return Adjustment(
        names=block.names,
        sensors=cameras.unknowns.corrected(final.params, views),
        params=final.params,
        points=np.where(seen[:, None], final.points, np.nan)[: block.num_tracks],
        residuals_before=block.in_order(before.T)[: len(tracks)],
        residuals=block.in_order(outcome.residual.T)[: len(tracks)],
        inlier=block.in_order(outcome.inlier)[: len(tracks)],
        view=tracks.view,
        noise=outcome.noise,
        cost_history=final.history,
        steps=len(final.history) - outcome.passes,
        status="; ".join(
            [
                f"{outcome.passes} passes of cutting",
                outcome.minimum.status,
                f"{covariance.factor.method} factorisation",
            ]
        ),
        cameras=cameras,
        covariance=covariance,
        gauge=gauge,
        prior=outcome.prior,
        smooth=outcome.smooth,
        held=heights.weak[: block.num_tracks],
        left_out=block.left_out,
        gcp_inlier=block.in_order(outcome.inlier)[len(tracks) :],
        gcp_residuals=_gcp_residuals(final.points[block.num_tracks :], gcps),
        seconds=time.process_time() - start,
        options=options,
    )


def _first_drift(options: AdjustOptions, prior: BlockPrior | None) -> int:
    """The degree of the drift to start with."""
    if options.drift is not None:
        return options.drift
    if prior is not None:
        return prior.drift
    return int("rotation" in options.model)


def _is_suspect(outcome: Outcome, structure: Structure, use: BoolArray) -> bool:
    """Whether the rounds may have ended between two solutions: much noise, or a view that lost much."""
    had, kept = (structure.sum_views(rows.astype(np.float64)[None])[:, 0] for rows in (use, outcome.inlier))
    return outcome.noise > _MUCH_NOISE or bool((kept < _MUCH_LOST * had).any())


def _rounds(
    problem: Problem,
    block: Block,
    state: State,
    options: AdjustOptions,
    heights: Heights,
    use: BoolArray,
    known_noise: float | None = None,
) -> Outcome:
    """Robust rounds and cuts from a state, with the observations in use (K,) to start with."""
    unknowns = problem.cameras.unknowns
    observations = Observations(
        heights.hold(problem, state.points), block.sigma, options.noise_floor, block.point < block.num_tracks
    )
    middle = np.column_stack([unknowns.col_offset, unknowns.row_offset])
    half = np.column_stack([unknowns.col_scale, unknowns.row_scale])
    smooth = Smooth(problem.structure, problem.xy, middle, half)
    variances = Variances.of(problem.camera_prior, unknowns, options)
    return run_rounds(problem, observations, state, options, block.use, use, heights.hold, variances, smooth)


def make_problem(
    block: Block,
    options: AdjustOptions,
    centers: Array | None,
    prior: BlockPrior | None,
    drift: int | None = None,
) -> Problem:
    """Observations, cameras and priors, before anything is known about points; `drift` instead of the options'."""
    views = block.views
    drift = _first_drift(options, prior) if drift is None else drift
    if prior is not None:
        centers = _known_centers(block, options, centers, prior)
    unknowns = make_unknowns(views, options.model, drift, centers)
    sigma = prior_sigmas(views, options, drift)
    on_cameras, jointly = CameraPrior(np.zeros_like(sigma), sigma), None
    if prior is not None:
        on_cameras, jointly = apply_prior(prior, block.names, options.model, drift, on_cameras)
    return Problem(
        Cameras(views, unknowns, block.xy[1]),
        make_structure(block.view, block.point, len(views), block.num_points),
        block.xy,
        on_cameras,
        np.repeat([name not in options.fixed for name in block.names], unknowns.size),
        jointly,
    )


def _known_centers(block: Block, options: AdjustOptions, centers: Array | None, prior: BlockPrior) -> Array:
    """Camera centres (N, 3) [m]: the earlier block's where it had them."""
    if centers is None:
        centers = make_unknowns(block.views, options.model).center
    known = dict(zip(prior.names, prior.center, strict=True))
    return np.array([known.get(name, center) for name, center in zip(block.names, centers, strict=True)])


def _start(
    problem: Problem, block: Block, options: AdjustOptions, gcps: GroundPoints | None, dem: Terrain | None
) -> tuple[State, Heights]:
    """Points triangulated with the delivered cameras, and what holds those that the rays do not."""
    params = problem.camera_prior.mean
    points = block.first_points(gcps)
    points[~np.isfinite(points)] = 0.0
    control = [] if gcps is None else [ground_control(gcps, block.num_tracks + np.arange(len(gcps.names)))]
    projected = problem.project_points(params, points)
    weak = convergence_angles(problem.structure, projected, points) < np.radians(options.min_convergence)
    heights = Heights(tuple(control), weak, np.arange(block.num_tracks), block.alt_range, options, dem)
    weight = block.use / block.sigma
    for _ in range(_FIRST_STEPS):
        points = heights.hold(problem, points).triangulate(points, projected, weight)
        projected = problem.project_points(params, points)
    points = heights.hold(problem, points).triangulate(points, projected, weight)
    return State(params, points), heights


def _gcp_residuals(points: Array, gcps: GroundPoints | None) -> Array:
    if gcps is None:
        return np.zeros((0, 3))
    offset = points - ecef_from_ground(gcps.lonlatalt)
    enu: Array = (enu_basis(gcps.lonlatalt) @ offset[..., None])[..., 0]
    return enu
