"""The datum of a block: uncertainty of shift, tilt, turn, scale and bending of the scene, and its sources.

A change dp of the camera unknowns moves the points by dX = -V^-1 W^T dp. Ten motions of the scene (`MOTIONS`) are
fitted to dX by least squares; they are linear in dp and have a covariance.

Of all changes of cameras and points with a given motion, one has the least cost. The fraction of that cost in a prior
or a kind of control is its share of the information on the motion. Tie points have no share: they only constrain
cameras and points relative to each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg as la

from barpc.ba.constraints.ground import FIRST_PLACED
from barpc.ba.parameters.priors import EarlierScene, JointPrior
from barpc.ba.solving.covariance import Covariance
from barpc.ba.solving.normal import Reduced, by_cameras, solve_lower
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State
from barpc.base.geodesy import Array, enu_basis, ground_from_ecef
from barpc.base.statistics import evenly
from barpc.scene import BoolArray, IntArray

MOTIONS = ("east", "north", "up", "tilt east", "tilt north", "turn", "scale", "twist", "bend east", "bend north")
"""Motions of the scene [m].

Shifts are displacements. Tilts, turn and scale are displacements at the radius of the scene. Twist and bends are ranges
over the scene of heights proportional to east x north, east^2 and north^2, each minus its best-fitting plane. Rotations
of cameras that change with the row (drift) cause twist and bends.
"""
SIMILAR = MOTIONS.index("twist")
"""Index of the first motion that bends the scene; the motions before it keep its shape."""
SOURCES = ("cameras", "earlier_run", "fixed_views", "gcps", "heights", "reference", "altimetry")
"""Sources of information: camera priors as delivered, or of an earlier run; fixed views; GCPs; the DEM or assumed
altitudes, with their common errors; a reference orthoimage, with its common errors; altimetry (heights without image
coordinates)."""
_NUM_DEM_ERRORS = 3  # with a reference: its DEM has three common errors (offset, tilts), listed first


@dataclass(frozen=True)
class Mode:
    """Uncertainty of one motion of the scene, and the errors of the other motions that are correlated with it."""

    sigma: float  # posterior standard deviation of the motion [m]
    motion: Array  # (10,) expected errors of all `MOTIONS` where this one has an error of sigma [m]
    meaning: str  # name of the motion


@dataclass(frozen=True)
class GaugeReport:
    """Motion of the scene by an adjustment, and posterior standard deviations of its motions."""

    # (3,) mean displacement of the points from those of the delivered cameras, east, north, up [m]
    shift: Array
    sigma: Array  # (3,) posterior standard deviation of the position, east, north, up [m]
    motion_sigma: Array  # (10,) posterior standard deviations of all `MOTIONS` [m]
    modes: tuple[Mode, ...]  # the weakest first
    radius: float  # RMS distance of the points from their middle [m], at which tilts, turn and scale are measured
    by_unknown: Array = field(repr=False)  # (10, N q) derivatives of the motions by the camera unknowns
    own: Array = field(repr=False)  # (10, 10) covariance of the motions with the cameras fixed [m^2]
    # (3,) prior standard deviation of the position, from camera priors as widened, east, north, up [m]; NaN: unknown
    delivered_sigma: Array = field(default_factory=lambda: np.full(3, np.nan))


def gauge_report(
    covariance: Covariance, points: Array, before: Array, use: BoolArray, prior: Array | None = None
) -> GaugeReport:
    """Report the motion of the scene by an adjustment, from points (P, 3), ECEF [m], after and before it.

    `use` (P,) is the mask of points to use. `prior` (N, q) are the prior standard deviations of the camera unknowns;
    infinite ones are ignored.
    """
    shift, count = (points[use] - before[use]).mean(axis=0), use.sum()
    index = np.flatnonzero(use)
    use = np.zeros_like(use)
    use[index[evenly(len(index))]] = True
    middle = points[use].mean(axis=0)
    enu = enu_basis(ground_from_ecef(middle))
    local = (points[use] - middle) @ enu.T
    radius = max(float(np.sqrt((local[:, :2] ** 2).sum(axis=1).mean())), 1e-6)
    pick = motions_of_moves(local / radius) @ enu  # (10, n, 3) by ECEF moves
    by_unknown, own = _motion_by_unknowns(covariance.of_noise, pick, use, use.sum() / count)
    motions = by_unknown, own, _motion_by_shared(covariance, pick, np.flatnonzero(use))
    found = _assembled_report(covariance, enu @ shift, motions, radius)
    if prior is None:
        return found
    variance = np.where(np.isfinite(prior), prior, 0.0).ravel() ** 2
    return replace(found, delivered_sigma=np.sqrt(by_unknown[:3] ** 2 @ variance))


def earlier_scene(covariance: Covariance, prior: JointPrior, scene: EarlierScene, params: Array) -> GaugeReport:
    """Report the scene of an earlier block, whose cameras were adjusted again and now have the unknowns (N, q).

    New observations only reduce its uncertainty. The scene of the new points is another one and may be less certain.
    """
    by_unknown = np.zeros((len(MOTIONS), params.size))
    by_unknown[:, prior.index] = scene.by_unknown
    moved = scene.by_unknown @ (params.ravel()[prior.index] - prior.mean)
    return _assembled_report(covariance, moved[:3], (by_unknown, scene.own, 0.0), scene.radius)


def _assembled_report(
    covariance: Covariance, shift: Array, motions: tuple[Array, Array, Array | float], radius: float
) -> GaugeReport:
    """Return the report of a scene that moved by `shift` (3,), east, north, up [m].

    `motions` holds the derivatives of the motions by the camera unknowns (10, N q), their covariance with the cameras
    fixed (10, 10), and their derivatives by shared errors with the cameras fixed (10, k).
    """
    by_unknown, own, direct = motions
    motion_covariance = by_unknown @ covariance.of_noise.solve(by_unknown.T) + own
    if covariance.shared is not None:
        moves = by_unknown @ covariance.shared.by_unknown + direct
        motion_covariance += moves @ moves.T
    sigma = np.sqrt(np.maximum(np.diag(motion_covariance), 0.0))
    return GaugeReport(shift, sigma[:3], sigma, weakest_modes(motion_covariance), radius, by_unknown, own)


def _motion_by_shared(covariance: Covariance, pick: Array, index: IntArray) -> Array | float:
    """Return the derivatives (10, k) of the motions by errors common to several images, with the cameras fixed."""
    if covariance.shared is None:
        return 0.0
    return np.asarray(np.einsum("mni,nik->mk", pick, covariance.shared.of_points(index)))


def _motion_by_unknowns(covariance: Covariance, pick: Array, use: BoolArray, share: float) -> tuple[Array, Array]:
    """Return the derivatives (10, N q) of the motions by camera unknowns, and their covariance with these fixed.

    `pick` (10, n, 3) are the derivatives of the motions by the points of the mask `use`. `share` is the ratio of
    these sampled points to all points.
    """
    reduced, index = covariance.reduced, np.flatnonzero(use)
    # with V = L L^T and Y = L^-1 W^T, dX = -L^-T Y dp; the derivatives of the motions are multiplied by L^-T
    whitened = solve_lower(reduced.lower[:, index], pick.transpose(2, 0, 1)).transpose(2, 0, 1)
    by_camera = by_cameras(reduced.structure, reduced.cross, index, whitened)
    flat = whitened.reshape(-1, len(MOTIONS))
    own = share * flat.T @ flat
    if reduced.common is not None:
        counted = np.isin(reduced.common.index, index)
        at = np.searchsorted(index, reduced.common.index[counted])
        moved = np.einsum("qic,qim->cm", whitened[at], reduced.common.cross[counted])
        shared = -la.solve_triangular(reduced.common.upper, moved.T, trans="T").T
        by_camera, own = by_camera - shared @ reduced.common.by_camera, own + shared @ shared.T
    return by_camera, own


def motions_of_moves(local: Array) -> Array:
    """Return the matrix (10, n, 3) from displacements of points, east, north, up, to least-squares `MOTIONS`.

    `local` (n, 3) are the points relative to their centre, in radii of the scene. Motions that the points do not
    determine are 0.
    """
    n = len(local)
    e, o, one, zero = local[:, 0], local[:, 1], np.ones(n), np.zeros(n)
    shifts = [[one, zero, zero], [zero, one, zero], [zero, zero, one]]
    motions = np.array([*shifts, [zero, zero, e], [zero, zero, o], [-o, e, zero], [e, o, zero]])
    bends = np.zeros((3, 3, n))
    bends[:, 2] = _bending_modes(e, o)
    motions = np.concatenate([motions, bends])
    flat = np.swapaxes(motions, 1, 2).reshape(len(MOTIONS), -1)
    gram = flat @ flat.T + 1e-9 * n * np.eye(len(MOTIONS))
    return np.linalg.solve(gram, flat).reshape(len(MOTIONS), n, 3)


def _bending_modes(east: Array, north: Array) -> Array:
    """Return the heights (3, n) of a twist and two bends, minus their best-fitting planes, each of range one metre."""
    plane = np.stack([np.ones_like(east), east, north])
    curved = np.stack([east * north, east**2, north**2])
    if not len(east):
        return curved
    curved -= np.linalg.lstsq(plane.T, curved.T, rcond=None)[0].T @ plane
    return np.asarray(curved / np.maximum(np.ptp(curved, axis=1, keepdims=True), 1e-6))


def weakest_modes(motion_covariance: Array) -> tuple[Mode, ...]:
    """Return the motions of the scene, the most uncertain first, from their covariance (10, 10) [m^2]."""
    sigma = np.sqrt(np.maximum(np.diag(motion_covariance), 0.0))
    along = np.where(sigma > 0, motion_covariance, 0.0) / np.where(sigma > 0, sigma, 1.0)
    weakest = np.argsort(-sigma, kind="stable").tolist()
    return tuple(Mode(float(sigma[m]), along[:, m], MOTIONS[m]) for m in weakest)


def datum_shares(
    covariance: Covariance, by_unknown: Array, problem: Problem, state: State, weight: Array, known: tuple[int, int]
) -> Mapping[str, Array]:
    """Return the share (10,) of each source in the information on the motions; NaN where fixed cameras prevent one.

    Parameters
    ----------
    covariance : Covariance, at the solution
    by_unknown : (10, N q), derivatives of the motions by the camera unknowns
    problem, state, weight : of the last solve; weight (K,) is 1 / sigma of each observation
    known : (int, int), indices of the first GCP and of the first reference point
    """
    moves = covariance.of_noise.solve(by_unknown.T)
    variance = np.einsum("mn,nm->m", by_unknown, moves)
    determined = variance > 0.0
    scale = np.where(determined, 1.0 / np.sqrt(np.where(determined, variance, 1.0)), 0.0)
    unknowns = (moves * scale).reshape(problem.structure.num_views, -1, len(variance))
    cost_of = dict(zip(SOURCES, np.zeros((len(SOURCES), len(variance))), strict=True))
    cost_of["cameras"] += (problem.camera_prior.whitened(unknowns) ** 2).sum(axis=(0, 1))
    if (joint := problem.joint_prior) is not None:
        flat = unknowns.reshape(-1, len(variance))[joint.index]
        cost_of["earlier_run" if joint.earlier else "cameras"] += (flat * (joint.information @ flat)).sum(axis=0)
    prior = problem.point_prior
    if (prior is not None and len(prior.index)) or not problem.free.all():
        reduced, structure = covariance.reduced, problem.structure
        number, fixed = np.arange(structure.num_points), ~problem.free.reshape(structure.num_views, -1)[:, 0]
        kinds = {"gcps": (number >= known[0]) & (number < known[1]), "reference": number >= known[1]}
        with_prior = np.isin(number, structure.point[fixed[structure.view]])
        with_prior[[] if prior is None else prior.index] = True
        points = np.zeros((len(number), 3, len(variance)))
        points[with_prior] = reduced.carried(unknowns, np.flatnonzero(with_prior))
        held = _point_shares(cost_of, problem, reduced, unknowns, points, kinds)
        _add_observation_shares(cost_of, problem, state, weight, (unknowns, points), held)
    with np.errstate(divide="ignore", invalid="ignore"):
        return {source: np.where(determined, cost / sum(cost_of.values()), np.nan) for source, cost in cost_of.items()}


def _point_shares(
    cost_of: Mapping[str, Array],
    problem: Problem,
    reduced: Reduced,
    unknowns: Array,
    points: Array,
    kinds: Mapping[str, BoolArray],
) -> Mapping[str, BoolArray]:
    """Add the costs of priors on points to `cost_of`; return the mask (P,) of points with priors, for each kind."""
    held = {kind: np.zeros(len(rows), dtype=bool) for kind, rows in kinds.items()}
    prior, count = problem.point_prior, unknowns.shape[2]
    if prior is None:
        return held
    rest = np.ones(len(prior.index), dtype=bool)
    shared = np.zeros((prior.common.shape[2], count))
    if reduced.common is not None:
        shared = reduced.common.step(unknowns.reshape(-1, count))
    own_costs = ((prior.rows @ points[prior.index] - prior.common @ shared) ** 2).sum(axis=1)
    for kind, rows in kinds.items():
        own = rows[prior.index]
        held[kind][prior.index] = own
        cost_of[kind][:] += own_costs[own].sum(axis=0)
        rest &= ~own
    of_heights = _NUM_DEM_ERRORS if held["reference"].any() else FIRST_PLACED
    by_altimetry = rest & prior.common[:, :, FIRST_PLACED:].any(axis=(1, 2))
    cost_of["altimetry"][:] += own_costs[by_altimetry].sum(axis=0) + (shared[FIRST_PLACED:] ** 2).sum(axis=0)
    cost_of["heights"][:] += own_costs[rest & ~by_altimetry].sum(axis=0) + (shared[:of_heights] ** 2).sum(axis=0)
    cost_of["reference"][:] += (shared[of_heights:FIRST_PLACED] ** 2).sum(axis=0)
    return held


def _add_observation_shares(
    cost_of: Mapping[str, Array],
    problem: Problem,
    state: State,
    weight: Array,
    moves: tuple[Array, Array],
    held: Mapping[str, BoolArray],
) -> None:
    """Add the costs of observations of points with priors, and of tie points in fixed views, to `cost_of`."""
    structure, (unknowns, points) = problem.structure, moves
    is_free = problem.free[:: len(problem.free) // structure.num_views]  # views are free or fixed as a whole
    known = np.any(list(held.values()), axis=0)
    if is_free.all() and not known.any():
        return
    counted = known[structure.point] | ~is_free[structure.view]
    rows = np.flatnonzero(counted & (weight > 0))
    bounds = np.searchsorted(structure.view[rows], np.arange(structure.num_views + 1))
    ecef = structure.of_points(state.points)[:, rows]
    projected = problem.cameras.seeing(problem.xy[:, rows]).project(state.params, ecef, bounds)
    for v, part in enumerate(map(slice, bounds[:-1], bounds[1:])):
        at = structure.point[rows[part]]
        change = np.einsum("cqk,qm->ckm", projected.by_unknown[..., part], unknowns[v])
        change += np.einsum("cxk,kxm->ckm", projected.by_point[..., part], points[at])
        cost = ((change * weight[rows[part], None]) ** 2).sum(axis=0)
        for kind, held_points in held.items():
            cost_of[kind][:] += cost[held_points[at]].sum(axis=0)
        if not is_free[v]:
            cost_of["fixed_views"][:] += cost[~known[at]].sum(axis=0)
