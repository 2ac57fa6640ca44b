"""What holds the scene: how much of what is known of its place, tilts, turn and scale comes from where.

Of all changes of cameras and points that move the scene in one of its motions, one is the most probable: the cheapest.
What each source pays of its cost is its share of what is known of the motion. Tie points have none: they tie cameras
and points to each other, and what bends between them is paid for those who hold on to the Earth.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from barpc.ba.held.ground import FIRST_PLACED
from barpc.ba.solving.covariance import Covariance
from barpc.ba.solving.normal import Reduced
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State
from barpc.base.geodesy import Array
from barpc.scene import BoolArray

SOURCES = ("cameras", "earlier_run", "fixed_views", "gcps", "heights", "reference", "altimetry")
"""The priors of the cameras, as delivered or of an earlier run; views that are fixed; GCPs; the DEM or assumed
altitudes, with what these are wrong by together; a reference orthoimage, with what it is wrong by as a whole; heights
without image coordinates."""
_OF_HEIGHTS = 3  # with a reference: errors in common that are a terrain's, in front of its own


def datum_shares(
    covariance: Covariance, by_unknown: Array, problem: Problem, state: State, weight: Array, known: tuple[int, int]
) -> Mapping[str, Array]:
    """Return the share (10,) that each source has in what is known of the scene's motions; NaN where no free
    camera tells.

    Parameters
    ----------
    covariance : Covariance, at the solution
    by_unknown : (10, N q), motions by the unknowns of the cameras
    problem, state, weight : as solved last, and 1 / sigma of every observation (K,)
    known : (int, int), points from the first on are GCPs, from the second on a reference's
    """
    moves = covariance.solve(by_unknown.T)
    variance = np.einsum("mn,nm->m", by_unknown, moves)
    with np.errstate(divide="ignore", invalid="ignore"):
        unknowns = (moves / np.sqrt(variance)).reshape(problem.structure.num_views, -1, len(variance))
    paid = dict(zip(SOURCES, np.zeros((len(SOURCES), len(variance))), strict=True))
    paid["cameras"] += np.einsum("nqm->m", (problem.camera_prior.jacobian()[..., None] * unknowns) ** 2)
    if (joint := problem.joint_prior) is not None:
        flat = unknowns.reshape(-1, len(variance))[joint.index]
        paid["earlier_run"] += ((joint.jacobian() @ flat) ** 2).sum(axis=0)
    prior = problem.point_prior
    if (prior is not None and len(prior.index)) or not problem.free.all():
        reduced, structure = covariance.reduced, problem.structure
        number, fixed = np.arange(structure.num_points), ~problem.free.reshape(structure.num_views, -1)[:, 0]
        kinds = {"gcps": (number >= known[0]) & (number < known[1]), "reference": number >= known[1]}
        asked = np.isin(number, structure.point[fixed[structure.view]])
        asked[[] if prior is None else prior.index] = True
        points = np.zeros((len(number), 3, len(variance)))
        points[asked] = reduced.carried(unknowns, np.flatnonzero(asked))
        held = _known_points(paid, problem, reduced, unknowns, points, kinds)
        _observations(paid, problem, state, weight, (unknowns, points), held)
    with np.errstate(invalid="ignore"):
        return {source: cost / sum(paid.values()) for source, cost in paid.items()}


def _known_points(
    paid: Mapping[str, Array],
    problem: Problem,
    reduced: Reduced,
    unknowns: Array,
    points: Array,
    kinds: Mapping[str, BoolArray],
) -> Mapping[str, BoolArray]:
    """Add what the places of known points and heights pay; the points (P,) of each kind that are held."""
    held = {kind: np.zeros(len(rows), dtype=bool) for kind, rows in kinds.items()}
    prior, count = problem.point_prior, unknowns.shape[2]
    if prior is None:
        return held
    rest = np.ones(len(prior.index), dtype=bool)
    shared = np.zeros((prior.common.shape[2], count))
    if reduced.common is not None:
        shared = reduced.common.step(unknowns.reshape(-1, count))
    left = ((prior.rows @ points[prior.index] - prior.common @ shared) ** 2).sum(axis=1)
    for kind, rows in kinds.items():
        own = rows[prior.index]
        held[kind][prior.index] = own
        paid[kind][:] += left[own].sum(axis=0)
        rest &= ~own
    of_heights = _OF_HEIGHTS if held["reference"].any() else FIRST_PLACED
    placed = rest & prior.common[:, :, FIRST_PLACED:].any(axis=(1, 2))
    paid["altimetry"][:] += left[placed].sum(axis=0) + (shared[FIRST_PLACED:] ** 2).sum(axis=0)
    paid["heights"][:] += left[rest & ~placed].sum(axis=0) + (shared[:of_heights] ** 2).sum(axis=0)
    paid["reference"][:] += (shared[of_heights:FIRST_PLACED] ** 2).sum(axis=0)
    return held


def _observations(
    paid: Mapping[str, Array],
    problem: Problem,
    state: State,
    weight: Array,
    moves: tuple[Array, Array],
    held: Mapping[str, BoolArray],
) -> None:
    """Add what the observations of known points pay, and those of tie points in fixed views, by moves of both."""
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
            paid[kind][:] += cost[held_points[at]].sum(axis=0)
        if not is_free[v]:
            paid["fixed_views"][:] += cost[~known[at]].sum(axis=0)
