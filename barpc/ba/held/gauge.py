"""What the observations cannot tell: the scene's shift, tilt, turn and bending, the weakest first.

A change of the camera unknowns moves the points by dX = -V^-1 W^T dp. The mean of that move and its
best-fitting tilts, turn, scale, twist and bending are linear in dp: ten numbers with a covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg as la

from barpc.ba.estimated.priors import EarlierScene, JointPrior
from barpc.ba.solving.covariance import Covariance
from barpc.ba.solving.normal import solve_lower
from barpc.ba.usual import SAMPLE
from barpc.base.geodesy import Array, enu_basis, ground_from_ecef
from barpc.scene import BoolArray

MOTIONS = ("east", "north", "up", "tilt east", "tilt north", "turn", "scale", "twist", "bend east", "bend north")
"""The scene's motions [m]: shift; then rise to the east and north, turn and scale, at the scene's edge; what heights do
that go with the product of east and north and with the square of each, beside a plane, from the lowest to the highest
place of the scene. A rotation that changes with the row does the last: rows follow each other along the flight."""
SIMILAR = MOTIONS.index("twist")
"""The first of these that bend the scene: those before keep its shape."""


@dataclass(frozen=True)
class Mode:
    """One of the scene's motions, and how the others go with it."""

    sigma: float  # its posterior standard deviation [m]
    # (10,) all `MOTIONS` where this one is off by that [m]: a column of their covariance over it
    motion: Array
    meaning: str  # which it is


@dataclass(frozen=True)
class GaugeReport:
    """Motion of the scene by an adjustment, and its standard deviations."""

    # (3,) mean move of the points from their place under the delivered cameras, east, north, up [m]
    shift: Array
    sigma: Array  # (3,) posterior standard deviation of the scene's place, east, north, up [m]
    motion_sigma: Array  # (10,) the same for all `MOTIONS` [m]
    modes: tuple[Mode, ...]  # the weakest first
    # RMS distance of the points from their middle [m]: where tilts, turn and scale are measured
    radius: float
    by_unknown: Array = field(repr=False)  # (10, N q) the motions by the unknowns of the cameras
    own: Array = field(repr=False)  # (10, 10) their covariance where the cameras are known [m^2]
    # (3,) how far off the delivered cameras let the scene be, east, north, up [m], by their priors as the block widened
    # them; NaN where that is not known
    delivered_sigma: Array = field(default_factory=lambda: np.full(3, np.nan))


def gauge_report(
    covariance: Covariance, points: Array, before: Array, use: BoolArray, prior: Array | None = None
) -> GaugeReport:
    """Report how an adjustment moved the scene: points (P, 3), ECEF [m], after and before it; those that
    count in `use` (P,).

    `prior` (N, q) are the standard deviations of the cameras' unknowns as delivered; infinite ones do not count.
    """
    shift, count = (points[use] - before[use]).mean(axis=0), use.sum()
    index = np.flatnonzero(use)
    use = np.zeros_like(use)
    use[index[:: len(index) // SAMPLE + 1]] = True
    middle = points[use].mean(axis=0)
    enu = enu_basis(ground_from_ecef(middle))
    local = (points[use] - middle) @ enu.T
    radius = max(float(np.sqrt((local[:, :2] ** 2).sum(axis=1).mean())), 1e-6)
    by_unknown, own = _motion_by_unknowns(covariance, local / radius, enu, use, use.sum() / count)
    found = _report(covariance, enu @ shift, by_unknown, own, radius)
    if prior is None:
        return found
    variance = np.where(np.isfinite(prior), prior, 0.0).ravel() ** 2
    return replace(found, delivered_sigma=np.sqrt(by_unknown[:3] ** 2 @ variance))


def earlier_scene(covariance: Covariance, prior: JointPrior, scene: EarlierScene, params: Array) -> GaugeReport:
    """Report the scene of an earlier block, by unknowns (N, q) of its cameras that were adjusted again.

    Whatever was added tells more of it: new points are another scene, and may know theirs less.
    """
    by_unknown = np.zeros((len(MOTIONS), params.size))
    by_unknown[:, prior.index] = scene.by_unknown
    moved = scene.by_unknown @ (params.ravel()[prior.index] - prior.mean)
    return _report(covariance, moved[:3], by_unknown, scene.own, scene.radius)


def _report(covariance: Covariance, shift: Array, by_unknown: Array, own: Array, radius: float) -> GaugeReport:
    motion_covariance = by_unknown @ covariance.solve(by_unknown.T) + own
    sigma = np.sqrt(np.maximum(np.diag(motion_covariance), 0.0))
    return GaugeReport(shift, sigma[:3], sigma, _modes(motion_covariance), radius, by_unknown, own)


def _motion_by_unknowns(
    covariance: Covariance, local: Array, enu: Array, use: BoolArray, share: float
) -> tuple[Array, Array]:
    """Return the motions by the cameras' unknowns (10, N q), their covariance (10, 10) with cameras known."""
    reduced = covariance.reduced
    structure = reduced.structure
    count, q = len(MOTIONS), covariance.num_unknowns
    index = np.flatnonzero(use)
    pick = _motion_of_points(local) @ enu  # (10, n, 3) by ECEF moves
    lower = reduced.lower[:, index]
    whitened = np.zeros((len(use), 3, count))  # L^-1 of each motion's weights: dX = -L^-T Y dp
    whitened[index] = solve_lower(lower, pick.transpose(2, 0, 1)).transpose(2, 0, 1)
    rows = np.flatnonzero(use[structure.point])
    by_view = np.empty((count, structure.num_views, q))
    for v, of_view in enumerate(np.split(rows, np.searchsorted(rows, structure.bounds[1:-1]))):
        of_points = whitened[structure.point[of_view]].reshape(-1, count)
        by_view[:, v] = -of_points.T @ reduced.cross[of_view].reshape(-1, q)
    by_camera = by_view.reshape(count, -1)
    flat = whitened[index].reshape(-1, count)
    own = share * flat.T @ flat
    if reduced.common is not None:
        moved = np.einsum("qic,qim->cm", whitened[reduced.common.index], reduced.common.cross)
        shared = -la.solve_triangular(reduced.common.upper, moved.T, trans="T").T
        by_camera, own = by_camera - shared @ reduced.common.by_camera, own + shared @ shared.T
    return by_camera, own


def _motion_of_points(local: Array) -> Array:
    """Return (10, n, 3): least-squares motions by the moves (east, north, up) of points at `local` (n, 3) radii."""
    n = len(local)
    e, o, one, zero = local[:, 0], local[:, 1], np.ones(n), np.zeros(n)
    shifts = [[one, zero, zero], [zero, one, zero], [zero, zero, one]]
    motions = np.array([*shifts, [zero, zero, e], [zero, zero, o], [-o, e, zero], [e, o, zero]])
    bends = np.zeros((3, 3, n))
    bends[:, 2] = _bends(e, o)
    motions = np.concatenate([motions, bends])
    flat = np.swapaxes(motions, 1, 2).reshape(len(MOTIONS), -1)
    gram = flat @ flat.T + 1e-9 * n * np.eye(len(MOTIONS))
    return np.linalg.solve(gram, flat).reshape(len(MOTIONS), n, 3)


def _bends(east: Array, north: Array) -> Array:
    """Return the heights (3, n) of a twist and two bends without the plane in them, each a metre in all."""
    plane = np.stack([np.ones_like(east), east, north])
    curved = np.stack([east * north, east**2, north**2])
    if not len(east):
        return curved
    curved -= np.linalg.lstsq(plane.T, curved.T, rcond=None)[0].T @ plane
    return np.asarray(curved / np.maximum(np.ptp(curved, axis=1, keepdims=True), 1e-6))


def _modes(motion_covariance: Array) -> tuple[Mode, ...]:
    """Return the scene's motions by their covariance, the weakest first."""
    sigma = np.sqrt(np.maximum(np.diag(motion_covariance), 0.0))
    along = np.where(sigma > 0, motion_covariance, 0.0) / np.where(sigma > 0, sigma, 1.0)
    weakest = np.argsort(-sigma, kind="stable").tolist()
    return tuple(Mode(float(sigma[m]), along[:, m], MOTIONS[m]) for m in weakest)
