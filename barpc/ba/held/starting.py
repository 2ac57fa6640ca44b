"""What a block starts from: the problem, points where the delivered cameras put them, what holds those."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barpc.ba.algebra.structure import make_structure
from barpc.ba.estimated.priors import CameraPrior, prior_sigmas
from barpc.ba.estimated.projected import Cameras
from barpc.ba.estimated.unknowns import make_unknowns
from barpc.ba.estimated.waves import Waves
from barpc.ba.held.block import Block
from barpc.ba.held.ground import Heights, convergence_angles, ground_control, reference_control
from barpc.ba.held.incremental import BlockPrior, apply_prior
from barpc.ba.held.terrain import Relief, Terrain
from barpc.ba.solving.normal import cholesky3, point_products, solve_lower, solve_transposed
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State
from barpc.base.geodesy import Array, enu_basis, ground_from_ecef
from barpc.base.options import AdjustOptions


def make_problem(
    block: Block,
    options: AdjustOptions,
    centers: Array | None,
    prior: BlockPrior | None,
    drift: int | None = None,
    waves: Waves | None = None,
) -> Problem:
    """Set up observations, cameras and priors before anything is known about points; `drift` overrides the options'."""
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


def _first_drift(options: AdjustOptions, prior: BlockPrior | None) -> int:
    """Return the degree of the drift to start with."""
    if options.drift is not None:
        return options.drift
    if prior is not None:
        return prior.drift
    return int("rotation" in options.first_model)


def _known_centers(block: Block, options: AdjustOptions, centers: Array | None, prior: BlockPrior) -> Array:
    """Return the camera centres (N, 3) [m]: the earlier block's where it had them."""
    if centers is None:
        centers = make_unknowns(block.views, options.first_model).center
    known = dict(zip(prior.names, prior.center, strict=True))
    return np.array([known.get(name, center) for name, center in zip(block.names, centers, strict=True)])


def first_state(problem: Problem, block: Block, options: AdjustOptions, dem: Terrain | None) -> tuple[State, Heights]:
    """Triangulate the points with the delivered cameras, and return priors for those that the rays do not fix."""
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
    points = heights.hold(problem, points).triangulate(points, projected, weight)
    projected = problem.project_points(params, points)
    points = heights.hold(problem, points).triangulate(points, projected, weight)
    if heights.is_judged and len(tracks):
        heights = replace(heights, relief=_relief(problem, heights, points, weight))
    return State(params, points), heights


def _relief(problem: Problem, heights: Heights, points: Array, weight: Array) -> Relief:
    """Return the DEM beside points (P, 3) [m] that stand where the rays of the delivered cameras put them.

    What the cameras let expect of how these lie to it is first-order: points move by -V^-1 A^T B with the cameras.
    """
    assert heights.dem is not None
    structure, sigma = problem.structure, problem.camera_prior.sigma
    projected, ground = problem.linearise(problem.camera_prior.mean, points), ground_from_ecef(points)
    by_point = projected.by_point * weight
    lower = cholesky3(structure.sum_points(point_products(by_point, np.zeros_like(problem.xy))[:6]))
    up = enu_basis(ground)[:, 2].T
    strong = np.zeros(len(points), dtype=bool)
    strong[heights.tracks[~heights.weak[heights.tracks]]] = True
    sharp = np.linalg.norm(solve_lower(lower, up), axis=0)
    found = Relief.of(heights.dem, ground, strong, sharp, heights.options.dem_sigma)
    let = np.zeros(3)
    for m, fit in enumerate(found.fit):
        moved = solve_transposed(lower, solve_lower(lower, up * fit))
        pull = np.einsum("cxk,xk->ck", by_point, moved.take(structure.point, axis=1)) * weight
        by_unknown = structure.sum_views(np.einsum("ck,cqk->qk", pull, projected.by_unknown))
        free = problem.free.reshape(by_unknown.shape)
        let[m] = np.sqrt(((by_unknown * sigma)[free] ** 2).sum()) if np.isfinite(sigma[free]).all() else np.nan
    return replace(found, cameras=let)
