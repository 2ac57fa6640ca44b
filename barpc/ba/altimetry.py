"""Altimetry as control: heights without image coordinates constrain the block if its surface agrees with them.

The block is first solved without them. Then the surface of its tie points is registered to the heights, most of which
must agree (`barpc.ba.constraints.registration`). The tie points get priors at the registered positions, with the
covariance of the registration as common errors. Motions that the heights do not determine stay free.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barpc.ba.constraints.block import Block
from barpc.ba.constraints.gauge import MOTIONS, SIMILAR, gauge_report
from barpc.ba.constraints.ground import FIRST_PLACED
from barpc.ba.constraints.registration import (
    PATCH_POINTS,
    GivenHeights,
    Registration,
    TieSurface,
    displacement,
    register,
)
from barpc.ba.parameters.priors import PointPrior
from barpc.ba.robust.heldout import is_better
from barpc.ba.robust.rounds import Rounds
from barpc.ba.solution import Solution, finished
from barpc.ba.solving.covariance import Covariance
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, ground_from_ecef
from barpc.base.statistics import CRITICAL, FEWEST, GROSS, LEVEL, evenly, robust_spread
from barpc.scene import Altimetry, IntArray


@dataclass(frozen=True)
class AltimetryTest:
    """Result of registering heights without image coordinates to the block."""

    given: int  # heights in the files
    near: int  # heights on the surface of the tie points (of a sample)
    agree: int  # inliers of the registration among these
    spread: float  # robust standard deviation of the residuals of the inliers [m]
    expected: float  # median of their a-priori standard deviations (heights and surface) [m]
    motion: Array  # (3,) shift that registers the block to the heights, east, north, up [m]
    sigma: Array  # (3,) standard deviation of this shift, by the heights alone [m]
    why_not: str = ""  # why the heights are not used; empty: they are used


def hold_by_altimetry(found: Solution, block: Block, outer: Block, given: Altimetry) -> tuple[Solution, AltimetryTest]:
    """Return the solution constrained by heights too; unchanged if these contradict each other or other control."""
    ties = np.flatnonzero(found.seen[: block.num_tracks])
    points = found.final.points
    near, num_given = np.zeros(0, dtype=np.int64), len(given.sigma)
    if len(ties) > PATCH_POINTS:
        middle = points[ties].mean(axis=0)
        enu = enu_basis(ground_from_ecef(middle))
        local = (points[ties] - middle) @ enu.T
        place = (ecef_from_ground(given.lonlatalt) - middle) @ enu.T
        radius = max(float(np.sqrt((local[:, :2] ** 2).sum(axis=1).mean())), 1e-6)
        covariance = found.outcome.covariance(found.problem.free)
        before = _covariance_without_heights(covariance, found, ties)
        margin = CRITICAL * np.sqrt(np.diag(before)[:2])
        low, high = local[:, :2].min(axis=0) - margin, local[:, :2].max(axis=0) + margin
        near = np.flatnonzero(((place[:, :2] >= low) & (place[:, :2] <= high)).all(axis=1))
        near = near[evenly(len(near))]
    if len(near) < FEWEST:
        return found, _unused(num_given, len(near), f"at least {FEWEST} heights on the tie points' surface are needed")
    surface = TieSurface.of(local)
    heights = GivenHeights(place[near], given.sigma[near], given.sigma_flat[near])
    registered = register(surface, heights, radius, np.sqrt(np.diag(before)))
    test = _tested(registered, num_given)
    why_not = _why_not(registered, before, _is_held(found, block))
    if why_not:
        return found, replace(test, why_not=why_not)
    least = 1 if found.heights.dem is None else 2  # half of the tie points keep the prior of the DEM
    sampled = np.arange(0, len(ties), max(evenly(len(ties)).step, least))
    placed = _registered_ties(
        points, ties[sampled], local[sampled, :2] / radius, enu, registered, np.sqrt(np.diag(before))
    )
    tried = _solved_with_heights(found, block, outer, placed)
    if is_better(found.after, tried.after, outer):
        return found, replace(test, why_not="held by them, the images would agree less with each other")
    return tried, test


def _covariance_without_heights(covariance: Covariance, found: Solution, ties: IntArray) -> Array:
    """Return the covariance (7, 7) of the motions of the scene without the heights [m^2]."""
    use = np.zeros(len(found.seen), dtype=bool)
    use[ties] = True
    report = gauge_report(covariance, found.final.points, found.final.points, use)
    by_unknown = report.by_unknown[:SIMILAR]
    matrix = by_unknown @ covariance.solve(by_unknown.T)
    floor = 1e-3 * report.motion_sigma[:SIMILAR].max() + 1e-3
    return np.asarray(matrix + floor**2 * np.eye(SIMILAR))


def _is_held(found: Solution, block: Block) -> bool:
    """Return whether other control, an earlier run or fixed views determine the position of the scene."""
    problem = found.problem
    others = block.gcps.names or block.reference is not None or found.goes_on
    return bool(others) or not problem.free.all()


def _why_not(registered: Registration, before: Array, is_held: bool) -> str:
    """Return the reason not to use the heights; empty if they may be used."""
    if registered.near.sum() < FEWEST or (registered.is_most and registered.agree.sum() < FEWEST):
        return f"at least {FEWEST} heights on the tie points' surface are needed"
    if not registered.is_most:
        return "no place of the scene is found on which most of them agree"
    total = before[:3, :3] + registered.covariance[:3, :3]
    off = registered.motion[:3]
    if is_held and float(off @ np.linalg.solve(total, off)) > CRITICAL**2:
        return "they contradict the other control"
    return ""


def _registered_ties(
    points: Array, index: IntArray, at: Array, enu: Array, registered: Registration, before: Array
) -> PointPrior:
    """Return priors on the tie points `index` (n,) at their registered positions, with common errors.

    These are the errors of the motion, and free bends. The points are `at` (n, 2) [radii of the scene].
    """
    moves = displacement(at)
    # sigma of single points: together they add a twentieth to the variance of the motion
    sigma = float(np.sqrt(LEVEL * np.diag(registered.covariance)[:3].min() * len(index)))
    bends = np.zeros((len(index), 3, len(MOTIONS) - SIMILAR))
    bends[:, 2] = np.stack([at[:, 0] ** 2, at[:, 0] * at[:, 1], at[:, 1] ** 2], axis=1)
    bend_sigma = GROSS * float(before[3:5].max())
    shared = np.concatenate([moves @ np.linalg.cholesky(registered.covariance), bend_sigma * bends], axis=2) / sigma
    common = np.concatenate([np.zeros((len(index), 3, FIRST_PLACED)), shared], axis=2)
    mean = points[index] + (moves @ registered.motion) @ enu
    return PointPrior(index, mean, np.tile(enu / sigma, (len(index), 1, 1)), common)


def _solved_with_heights(found: Solution, block: Block, outer: Block, placed: PointPrior) -> Solution:
    """Return the block solved again from its final state, with the priors `placed` on tie points."""
    held = replace(found, heights=replace(found.heights, placed=placed))
    rounds = Rounds(found.problem, block, found.final, held.heights, block.use, found.outcome)
    return finished(held, found.problem, block, outer, rounds.run())


def _tested(registered: Registration, num_given: int) -> AltimetryTest:
    agree = registered.agree
    spread = robust_spread(registered.residual[agree]) if agree.any() else np.nan
    expected = float(np.median(registered.sigma[agree])) if agree.any() else np.nan
    sigma = np.sqrt(np.diag(registered.covariance)[:3])
    counts = int(registered.near.sum()), int(agree.sum())
    return AltimetryTest(num_given, *counts, spread, expected, registered.motion[:3], sigma)


def _unused(num_given: int, near: int, why_not: str) -> AltimetryTest:
    unknown = np.full(3, np.nan)
    return AltimetryTest(num_given, near, 0, np.nan, np.nan, unknown, unknown, why_not)
