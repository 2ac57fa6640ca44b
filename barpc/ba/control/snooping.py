"""Control points tested against each other and the cameras: data snooping (Baarda 1968).

A control point that is used pulls its own residual towards zero, the more the less there is beside it. With Q_l the
covariance stated of its place and Q_x that of the adjusted point, the residual v = adjusted - given has the covariance
Q_v = Q_l - Q_x, and what all the others predict of it is off by Q_l Q_v^-1 v: leave-one-out without leaving one out.
All together they are tested by the sum of v^T Q_l^-1 v over the points: errors that are no one's alone show there.

Where they are seen is tested, too: every residual in an image over its own standard deviation, Baarda's w.
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

CHECKED = 0.1  # redundancy of a point that something beside the cameras' priors tells about


@dataclass(frozen=True, eq=False)
class ControlTest:
    """Ground control points against each other and the cameras.

    Parameters
    ----------
    used : (G,)
        Points that were used; the others were found wrong.
    residual : (G, 3)
        Place of a point by all others minus its given place, east, north, up [m], in the directions that they
        tell of; NaN where there is none.
    w : (G,)
        Largest component of the residual over its standard deviation.
    redundancy : (G,)
        Redundancy, how far the others could tell: 0 not at all, 1 as if the point were not used.
    scatter : float
        Root mean square residual of the points used over what is expected; NaN where too little is told.
    fits : bool
        Whether that may be chance.
    agreed : Agreement or None
        Agreement by which the points used were found.
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
        """Whether the others check any point used."""
        return bool((self.redundancy[self.used] > CHECKED).any())

    @property
    def agrees(self) -> bool:
        """Whether no point used is contradicted, alone or all together, and one set outweighs the others."""
        status = [self.status(g) for g in range(len(self.used))]
        return self.fits and not self.torn and not {"contradicts", "undecided"} & set(status)

    @property
    def sets(self) -> tuple[BoolArray, ...]:
        """Two sets of points (G,) that contradict each other with equal weight; empty where one is used."""
        return () if self.agreed is None else self.agreed.sets

    @property
    def torn(self) -> tuple[float, ...]:
        """Residuals of check tie points without and with control [px], where control distorts the block."""
        return () if self.agreed is None else self.agreed.torn

    def status(self, point: int) -> str:
        """Return the state of a point, in a word."""
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
        Adjusted, ECEF [m]; from `first` on the GCPs.
    first : int
        Number of tracks.
    gcps : GroundPoints
        As given.
    agreed : Agreement
        Whose place was held, and how.
    faint : (G,)
        Times by which their observations counted as noisier.
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
        told, axes = np.linalg.eigh(left / np.outer(sigmas[g], sigmas[g]))
        if told[-1] < RIDGE:
            continue
        axes = axes[:, told > RIDGE]
        whitened = offset[g] / sigmas[g] @ axes
        shown = axes @ (whitened / told[told > RIDGE]) if used[g] else axes @ whitened
        residual[g] = sigmas[g] * shown
        spread = np.sqrt(np.maximum(np.diag(left) / sigmas[g] ** 2, RIDGE))
        w[g] = (np.abs(offset[g] / sigmas[g]) / spread).max()
    scatter, fits = global_test(offset / sigmas, redundancy, used)
    fits &= agreed.scale == 1.0
    return ControlTest(used, residual, w, redundancy, scatter * agreed.scale, fits, agreed)


def global_test(whitened: Array, redundancy: Array, used: BoolArray) -> tuple[float, bool]:
    """Return the scatter of the points used (G,), in standard deviations, and whether it may be chance.

    `whitened` (G, 3): residuals over their standard deviations; `redundancy` (G,): the mean part of these that others
    hold. Their sum of squares is expected to be the redundancies' sum R, and its variance at most 2 R: that of a
    chi-square. Of less than one degree of freedom NaN and True.
    """
    freedom = 3.0 * float(redundancy[used].sum())
    if freedom < 1.0:
        return np.nan, True
    squares = float((whitened[used & (redundancy > 0)] ** 2).sum())
    return float(np.sqrt(squares / freedom)), bool(squares <= chdtri(freedom, CHANCE))


def image_test(
    covariance: Covariance, problem: Problem, state: State, residual: Array, weight: Array, rows: IntArray
) -> Array:
    """Return Baarda's w (n,) of observations in the images: the larger of |col| and |row| over its standard
    deviation.

    A whitened residual has the covariance 1 - J C J^T, C that of camera and point together. NaN: nothing checks it.

    Parameters
    ----------
    covariance : Covariance
        Of the solution.
    problem, state, weight : as solved last, and 1 / sigma of every observation (K,)
    residual : (2, K)
        Projected - observed [px].
    rows : (n,)
        Observations to test, ascending: of those that count, at known points.
    """
    structure, reduced, q = problem.structure, covariance.reduced, covariance.num_unknowns
    bounds = np.searchsorted(structure.view[rows], np.arange(structure.num_views + 1))
    ecef = structure.of_points(state.points)[:, rows]
    seen = problem.cameras.seeing(problem.xy[:, rows]).project(state.params, ecef, bounds)
    by_point, by_unknown = (part.transpose(2, 0, 1) for part in (seen.by_point, seen.by_unknown))
    lower = reduced.lower[:, structure.point[rows]]
    inverse = solve_transposed(lower, np.eye(3)[..., None]).transpose(2, 0, 1)  # L^-T
    place = {} if reduced.common is None else {int(p): n for n, p in enumerate(reduced.common.index)}
    left = np.empty((len(rows), 2))
    waiting: list[tuple[int, Array]] = []  # rows (2, N q) of the derivative by all cameras, solved for together
    for n, k in enumerate(rows.tolist()):
        p = int(structure.point[k])
        together = structure.by_point[structure.point_bounds[p] : structure.point_bounds[p + 1]]
        own = weight[k] * by_point[n] @ inverse[n]
        moves = -own @ reduced.cross[together]
        moves[together == k] += weight[k] * by_unknown[n]
        left[n] = 1.0 - (own**2).sum(axis=1)
        if p not in place:
            flat = moves.transpose(1, 0, 2).reshape(2, -1)
            left[n] -= np.diag(flat @ covariance.joint(structure.view[together]) @ flat.T)
            continue
        assert reduced.common is not None
        shared = own @ la.solve_triangular(reduced.common.upper, reduced.common.cross[place[p]].T, trans="T").T
        whole = shared @ reduced.common.by_camera
        for view, move in zip(structure.view[together].tolist(), moves, strict=True):
            whole[:, view * q : (view + 1) * q] += move
        left[n] -= (shared**2).sum(axis=1)
        waiting.append((n, whole))
        if len(waiting) * whole.size > KEPT:
            _take_off(left, waiting, covariance)
    _take_off(left, waiting, covariance)
    with np.errstate(invalid="ignore", divide="ignore"):
        w = np.abs(residual[:, rows].T * weight[rows, None]) / np.sqrt(np.where(left > RIDGE, left, np.nan))
    return np.asarray(np.fmax(*w.T))


def _take_off(left: Array, waiting: list[tuple[int, Array]], covariance: Covariance) -> None:
    """Subtract the part of the cameras' uncertainty from the waiting observations, and clear them."""
    if not waiting:
        return
    index, parts = zip(*waiting, strict=True)
    waiting.clear()
    whole = np.concatenate(parts)
    left[list(index)] -= np.einsum("ij,ji->i", whole, covariance.solve(whole.T)).reshape(-1, 2)
