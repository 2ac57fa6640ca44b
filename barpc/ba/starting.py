"""What a block starts from: the problem, points where the delivered cameras put them, what holds those."""

from __future__ import annotations

import numpy as np

from barpc.ba.block import Block
from barpc.ba.cameras import Cameras
from barpc.ba.ground import Heights, Terrain, convergence_angles, ground_control, reference_control
from barpc.ba.incremental import BlockPrior, apply_prior
from barpc.ba.priors import CameraPrior, prior_sigmas
from barpc.ba.problem import Problem
from barpc.ba.solve import State
from barpc.ba.structure import make_structure
from barpc.ba.unknowns import make_unknowns
from barpc.ba.waves import Waves
from barpc.geodesy import Array
from barpc.options import AdjustOptions

FIRST_STEPS = 1  # and one more: what is left is far below a pixel, and the solver takes it


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


def _first_drift(options: AdjustOptions, prior: BlockPrior | None) -> int:
    """The degree of the drift to start with."""
    if options.drift is not None:
        return options.drift
    if prior is not None:
        return prior.drift
    return int("rotation" in options.first_model)


def _known_centers(block: Block, options: AdjustOptions, centers: Array | None, prior: BlockPrior) -> Array:
    """Camera centres (N, 3) [m]: the earlier block's where it had them."""
    if centers is None:
        centers = make_unknowns(block.views, options.first_model).center
    known = dict(zip(prior.names, prior.center, strict=True))
    return np.array([known.get(name, center) for name, center in zip(block.names, centers, strict=True)])


def first_state(
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
    for _ in range(FIRST_STEPS):
        points = heights.hold(problem, points).triangulate(points, projected, weight)
        projected = problem.project_points(params, points)
    points = heights.hold(problem, points).triangulate(points, projected, weight)
    if heights.is_judged and len(tracks):
        heights = heights.beside(problem, points, projected, weight)
    return State(params, points), heights
