"""The entry: tracks in, corrections out."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from barpc.ba.block import Block, join
from barpc.ba.blocks import CameraPrior, Terrain, ground_control
from barpc.ba.cameras import Cameras
from barpc.ba.gauge import gauge_report
from barpc.ba.heights import Heights, convergence_angles
from barpc.ba.incremental import BlockPrior, apply_prior
from barpc.ba.options import AdjustOptions, prior_sigmas
from barpc.ba.problem import Problem
from barpc.ba.result import Adjustment
from barpc.ba.rounds import Observations, run_rounds
from barpc.ba.solve import State
from barpc.ba.structure import make_structure
from barpc.ba.unknowns import make_unknowns
from barpc.geodesy import Array, ecef_from_ground, enu_basis
from barpc.scene import GroundPoints, Tracks, View

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
    block = join(views, tracks, gcps, options)
    problem = make_problem(block, options, centers, prior)
    state, heights = _start(problem, block, options, gcps, dem)
    heights.warn()
    projected = problem.linearise(state.params, state.points)
    before = projected.image - problem.xy
    observations = Observations(
        heights.hold(problem, state.points), block.sigma, options.noise_floor, block.point < block.num_tracks
    )
    outcome = run_rounds(problem, observations, state, options, block.use, heights.hold, projected)
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
        status=f"{outcome.passes} passes of cutting; {covariance.factor.method} factorisation",
        cameras=cameras,
        covariance=covariance,
        gauge=gauge,
        held=heights.weak[: block.num_tracks],
        left_out=block.left_out,
        gcp_inlier=block.in_order(outcome.inlier)[len(tracks) :],
        gcp_residuals=_gcp_residuals(final.points[block.num_tracks :], gcps),
        seconds=time.process_time() - start,
        options=options,
    )


def make_problem(
    block: Block, options: AdjustOptions, centers: Array | None, prior: BlockPrior | None
) -> Problem:
    """Observations, cameras and priors, before anything is known about points."""
    views = block.views
    if prior is not None:
        centers = _known_centers(block, options, centers, prior)
    unknowns = make_unknowns(views, options.model, options.drift, centers, options.center_method)
    sigma = prior_sigmas(views, options)
    on_cameras, jointly = CameraPrior(np.zeros_like(sigma), sigma), None
    if prior is not None:
        on_cameras, jointly = apply_prior(prior, block.names, options.model, options.drift, on_cameras)
    return Problem(
        Cameras(views, unknowns),
        make_structure(block.view, block.point, len(views), block.num_points),
        block.xy,
        on_cameras,
        np.repeat([name not in options.fixed for name in block.names], unknowns.size),
        jointly,
    )


def _known_centers(block: Block, options: AdjustOptions, centers: Array | None, prior: BlockPrior) -> Array:
    """Camera centres (N, 3) [m]: the earlier block's where it had them."""
    if centers is None:
        centers = make_unknowns(block.views, options.model, 0, None, options.center_method).center
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
