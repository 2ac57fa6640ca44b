"""Tests of ground control points against each other and the cameras: data snooping (Baarda 1968).

A control point that is used pulls the block to itself, which reduces its residual v = adjusted - given. With Q_l the
covariance of the given position and Q_x that of the adjusted point, v has the covariance Q_v = Q_l - Q_x, and the
leave-one-out residual is Q_l Q_v^-1 v. The global test compares the sum of v^T Q_l^-1 v over the points with its
expectation. The image test divides each image residual by its standard deviation (Baarda's w).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
from scipy.special import chdtri

from barpc.ba.control.agreement import Agreement
from barpc.ba.robust.heldout import enu_offsets
from barpc.ba.solving.covariance import Covariance
from barpc.ba.solving.normal import solve_transposed
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State
from barpc.base.geodesy import Array, enu_basis
from barpc.base.statistics import CHANCE, CRITICAL, KEPT, RIDGE
from barpc.scene import BoolArray, GroundPoints, IntArray

CHECKED = 0.1  # least redundancy of a checked point; camera priors alone give less


@dataclass(frozen=True, eq=False)
class ControlTest:
    """Results of the tests of G ground control points.

    Parameters
    ----------
    used : (G,)
        Mask of the points that were used; the others were rejected.
    residual : (G, 3)
        Leave-one-out residual: position from all other observations minus given position, east, north, up [m].
        It has no component in directions without redundancy; NaN if no direction has redundancy.
    w : (G,)
        Largest component of adjusted minus given position, divided by its standard deviation.
    redundancy : (G,)
        Mean redundancy number of a point: 0 if only its given position determines it, 1 if others alone do.
    scatter : float
        RMS residual of the points used, divided by its expectation; NaN below one degree of freedom.
    fits : bool
        Whether `scatter` passes the chi-square test.
    agreed : Agreement or None
        How the points to use were found.
    """

    used: BoolArray
    residual: Array
    w: Array
    redundancy: Array
    scatter: float = np.nan
    fits: bool = True
    agreed: Agreement | None = None

    @property
    def checked(self) -> bool:
        """Whether any point used has a redundancy above `CHECKED`."""
        return bool((self.redundancy[self.used] > CHECKED).any())

    @property
    def agrees(self) -> bool:
        """Whether every point used passes its test, the global test is passed, and no sets contradict each other."""
        status = [self.status(g) for g in range(len(self.used))]
        return self.fits and not self.torn and not {"contradicts", "undecided"} & set(status)

    @property
    def sets(self) -> tuple[BoolArray, ...]:
        """Two contradicting sets of points (G,) of equal evidence; empty where one set is used."""
        return () if self.agreed is None else self.agreed.sets

    @property
    def torn(self) -> tuple[float, ...]:
        """RMS of check tie points without and with control [px], if control distorts the block. Empty otherwise."""
        return () if self.agreed is None else self.agreed.torn

    def status(self, point: int) -> str:
        """Return the state of a point: "used", "contradicts", "rejected" or "undecided"."""
        if not self.used[point]:
            return "undecided" if self.sets else "rejected"
        return "contradicts" if self.w[point] > CRITICAL else "used"


def control_test(
    covariance: Covariance, points: Array, first: int, gcps: GroundPoints, agreed: Agreement, faint: Array
) -> ControlTest:
    """Test the control points at a solution.

    Parameters
    ----------
    covariance : Covariance
        Of the solution.
    points : (P, 3)
        Adjusted tie points and, from index `first`, control points, ECEF [m].
    first : int
        Index of the first control point: the number of tracks.
    gcps : GroundPoints
        As given.
    agreed : Agreement
        The points used, and the factor on their standard deviations.
    faint : (G,)
        Factors by which the solution enlarged the standard deviations of the observations of each control point.
    """
    count, used, sigmas = len(gcps.names), agreed.used, gcps.sigma * agreed.scale
    seen = np.bincount(gcps.point, minlength=count)
    enu = enu_basis(gcps.lonlatalt)
    offset = enu_offsets(points[first : first + count], gcps.lonlatalt)
    index = first + np.arange(count)
    rays = solve_transposed(covariance.reduced.lower[:, index], np.eye(3)[..., None]).transpose(2, 0, 1)
    own = (1.0 - faint**-2.0)[:, None, None] * rays @ np.swapaxes(rays, 1, 2)
    adjusted = enu @ (covariance.points(index) - own) @ np.swapaxes(enu, 1, 2)
    residual, w, redundancy = np.full((count, 3), np.nan), np.full(count, np.nan), np.zeros(count)
    for g in range(count):
        stated = np.diag(sigmas[g] ** 2)
        if seen[g] == 0 or (not used[g] and seen[g] < 2):
            continue
        left = stated - adjusted[g] if used[g] else stated + adjusted[g]
        redundancy[g] = min(float((np.diag(left) / np.diag(stated)).mean()), 1.0)
        eigenvalues, axes = np.linalg.eigh(left / np.outer(sigmas[g], sigmas[g]))
        if eigenvalues[-1] < RIDGE:
            continue
        axes = axes[:, eigenvalues > RIDGE]
        whitened = offset[g] / sigmas[g] @ axes
        leave_one_out = axes @ (whitened / eigenvalues[eigenvalues > RIDGE]) if used[g] else axes @ whitened
        residual[g] = sigmas[g] * leave_one_out
        spread = np.sqrt(np.maximum(np.diag(left) / sigmas[g] ** 2, RIDGE))
        w[g] = (np.abs(offset[g] / sigmas[g]) / spread).max()
    scatter, fits = global_test(offset / sigmas, redundancy, used)
    fits &= agreed.scale == 1.0
    return ControlTest(used, residual, w, redundancy, scatter * agreed.scale, fits, agreed)


def global_test(whitened: Array, redundancy: Array, used: BoolArray) -> tuple[float, bool]:
    """Return the ratio of the RMS residual of the points used (G,) to its expectation, and a chi-square test of it.

    `whitened` (G, 3) are residuals divided by the standard deviations of the given positions, `redundancy` (G,) mean
    redundancy numbers. The sum of squares is expected to be the sum R of the redundancy numbers of all components. Its
    variance is at most that of a chi-square, 2 R. The result is NaN, True below one degree of freedom.
    """
    freedom = 3.0 * float(redundancy[used].sum())
    if freedom < 1.0:
        return np.nan, True
    squares = float((whitened[used & (redundancy > 0)] ** 2).sum())
    return float(np.sqrt(squares / freedom)), bool(squares <= chdtri(freedom, CHANCE))


def image_test(
    covariance: Covariance, problem: Problem, state: State, residual: Array, weight: Array, rows: IntArray
) -> Array:
    """Return Baarda's w (n,) of image observations: the larger of |col| and |row|, each over its standard deviation.

    A whitened residual has the covariance I - J C J^T, with C the joint covariance of the cameras and the point, and J
    the derivatives of the observation. w is NaN if both variances are zero.

    Parameters
    ----------
    covariance : Covariance
        Of the solution.
    problem, state, weight
        Of the last solve, with weights 1 / sigma (K,) of all observations [1/px].
    residual : (2, K)
        Projected - observed [px].
    rows : (n,)
        Indices of the observations to test, ascending: inliers of control points.
    """
    structure, reduced, q = problem.structure, covariance.reduced, covariance.num_unknowns
    bounds = np.searchsorted(structure.view[rows], np.arange(structure.num_views + 1))
    ecef = structure.of_points(state.points)[:, rows]
    seen = problem.cameras.seeing(problem.xy[:, rows]).project(state.params, ecef, bounds)
    by_point, by_unknown = (part.transpose(2, 0, 1) for part in (seen.by_point, seen.by_unknown))
    lower = reduced.lower[:, structure.point[rows]]
    inverse = solve_transposed(lower, np.eye(3)[..., None]).transpose(2, 0, 1)  # L^-T
    place = {} if reduced.common is None else {int(p): n for n, p in enumerate(reduced.common.index)}
    variance = np.empty((len(rows), 2))
    waiting: list[tuple[int, Array]] = []  # observation, its derivatives (2, N q) by all cameras
    for n, k in enumerate(rows.tolist()):
        p = int(structure.point[k])
        of_point = structure.by_point[structure.point_bounds[p] : structure.point_bounds[p + 1]]
        own = weight[k] * by_point[n] @ inverse[n]
        moves = -own @ reduced.cross[of_point]
        moves[of_point == k] += weight[k] * by_unknown[n]
        variance[n] = 1.0 - (own**2).sum(axis=1)
        if p not in place:
            flat = moves.transpose(1, 0, 2).reshape(2, -1)
            variance[n] -= np.diag(flat @ covariance.joint(structure.view[of_point]) @ flat.T)
            continue
        assert reduced.common is not None
        shared = own @ la.solve_triangular(reduced.common.upper, reduced.common.cross[place[p]].T, trans="T").T
        whole = shared @ reduced.common.by_camera
        for view, move in zip(structure.view[of_point].tolist(), moves, strict=True):
            whole[:, view * q : (view + 1) * q] += move
        variance[n] -= (shared**2).sum(axis=1)
        waiting.append((n, whole))
        if len(waiting) * whole.size > KEPT:
            _subtract_camera_part(variance, waiting, covariance)
    _subtract_camera_part(variance, waiting, covariance)
    with np.errstate(invalid="ignore", divide="ignore"):
        w = np.abs(residual[:, rows].T * weight[rows, None]) / np.sqrt(np.where(variance > RIDGE, variance, np.nan))
    return np.asarray(np.fmax(*w.T))


def _subtract_camera_part(variance: Array, waiting: list[tuple[int, Array]], covariance: Covariance) -> None:
    """Subtract the part due to the cameras from `variance`, for the observations in `waiting`, and clear the list."""
    if not waiting:
        return
    index, parts = zip(*waiting, strict=True)
    waiting.clear()
    whole = np.concatenate(parts)
    variance[list(index)] -= np.einsum("ij,ji->i", whole, covariance.solve(whole.T)).reshape(-1, 2)
