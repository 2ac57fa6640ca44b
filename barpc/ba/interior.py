"""Interior distortion of a sensor, the same in all its images: displacements by column, and their uncertainty.

Without a calibration, the distortion has a prior of mean 0. The sigma of each coordinate is `_PRIOR_SIGMA`; the
correlation between columns d apart is exp(-d / `_PRIOR_LENGTH`), as for steps between chips at random columns.
Constant and slope are removed, since the correction of a camera absorbs them.

An error of the curve displaces the observations of all images of the sensor. The response of an adjustment is one
Gauss-Newton step with displaced observations: unknowns change by S^-1 g, and points by the changes of the cameras and
by their own displaced observations.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from barpc.ba.parameters.additional_parameters import FIRST_SIGMA
from barpc.ba.solving.covariance import Covariance, SharedErrors
from barpc.ba.solving.normal import Reduced, solve_transposed, whiten
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State
from barpc.base.geodesy import Array
from barpc.base.statistics import SLIGHT
from barpc.scene import BoolArray, IntArray
from barpc.sensor.image_corrections import ColumnSpline, bspline_pieces, bsplines

LINE_SPLINES = 28  # over 25 intervals: lenses and focal planes bend over a twentieth of the line or more
_COEFFICIENT_SIGMA = 3.0  # px: prior sigma of a spline coefficient, far above the distortion of any optics
# px: interior orientation is calibrated in flight to 0.05-0.1 px RMS (SPOT 5 HRS and HRG: Gachet 2004, "SPOT5 in-flight
# commissioning: inner orientation of HRG and HRS instruments", Int. Arch. Photogramm. XXXV-B1; before calibration the
# curves reach 0.4 px) or to "better than 0.3 px" (ZY-1 02C: Yang and Wang 2013, J. Remote Sens. 17(5)). The prior has
# the larger value, 0.3: 0.42 before the constant and the slope of a line of 30,000 columns are removed.
_PRIOR_SIGMA = 0.42
# px: half the width of the widest chips in use (Pleiades: five of 6,000 columns), as the steps between chips dominate
_PRIOR_LENGTH = 3000.0


@dataclass(frozen=True, eq=False)
class LineCurve:
    """Layout of the unknowns of a sensor's curve: splines and steps at columns `edges` (C,), of col, then of row."""

    width: int
    edges: Array

    @property
    def size(self) -> int:
        """Number of unknowns of each coordinate."""
        return LINE_SPLINES + len(self.edges)

    def local(self, col: Array) -> tuple[Array, IntArray]:
        """Return the coefficients (four splines, one detector) that act at columns (K,): values and indices (K, 5)."""
        first, pieces = bspline_pieces(self.along(col), LINE_SPLINES)
        detector = LINE_SPLINES + np.searchsorted(self.edges, col, side="right")
        return np.column_stack([pieces.T, np.ones(len(col))]), np.column_stack(
            [first[:, None] + np.arange(4), detector]
        )

    @cached_property
    def by_detector(self) -> Array:
        """Matrix (size + 1, size) from the unknowns of a coordinate to its coefficients of splines and detectors."""
        return np.asarray(la.block_diag(np.eye(LINE_SPLINES), np.tri(len(self.edges) + 1, len(self.edges), -1)))

    def along(self, col: Array) -> Array:
        """Return columns [px] normalised: -1 at the start of the line, 1 at its end."""
        return np.asarray((2.0 * col + 1.0) / self.width - 1.0)

    def basis(self, col: Array) -> Array:
        """Return the displacements (n, size) at columns (n,) per unit of each unknown of a coordinate."""
        steps = (col[:, None] >= self.edges).astype(np.float64)
        return np.concatenate([bsplines(self.along(col), LINE_SPLINES).T, steps], axis=1)

    def prior(self, bend: float) -> Array:
        """Return the prior information (n, n) of the unknowns; `bend` is the sigma of third differences [px]."""
        rough = np.diff(np.eye(LINE_SPLINES), n=3, axis=0) / bend
        smooth = rough.T @ rough + np.eye(LINE_SPLINES) / _COEFFICIENT_SIGMA**2
        return la.block_diag(*2 * [la.block_diag(smooth, np.eye(len(self.edges)) / FIRST_SIGMA**2)])

    @cached_property
    def columns(self) -> Array:
        """All columns (width,)."""
        return np.arange(self.width, dtype=np.float64)

    @cached_property
    def bent(self) -> Array:
        """Projection (n, n) of the unknowns that removes a constant and a slope; splines represent both exactly."""
        slope = (np.arange(LINE_SPLINES) - 1.0) * 2.0 / (LINE_SPLINES - 3) - 1.0
        lines = np.stack([np.ones(LINE_SPLINES), slope], axis=1)
        straight = np.stack([np.ones(self.width), self.along(self.columns)], axis=1)
        one = np.eye(self.size)
        one[:LINE_SPLINES] -= lines @ np.linalg.pinv(straight) @ self.basis(self.columns)
        return np.asarray(la.block_diag(one, one))

    def sizes(self, unknowns: Array) -> Array:
        """Return the RMS (2,) of col and row [px] over the columns: of a curve (n,), or of its sigmas (n, n)."""
        basis = self.basis(self.columns)
        parts = slice(0, self.size), slice(self.size, None)
        if unknowns.ndim == 1:
            return np.array([np.sqrt(np.mean((basis @ unknowns[part]) ** 2)) for part in parts])
        blocks = (unknowns[part, part] for part in parts)
        return np.sqrt([np.einsum("ni,ni->n", basis @ block, basis).mean() for block in blocks])

    def spline(self, unknowns: Array) -> ColumnSpline:
        """Return the image correction with unknowns (n,)."""
        col, row = unknowns.reshape(2, -1)
        both = np.stack([col, row], axis=1)
        return ColumnSpline(self.width, both[:LINE_SPLINES], self.edges, both[LINE_SPLINES:])


@dataclass(frozen=True, eq=False)
class Calibration:
    """The curve of a sensor, its covariance (n, n) [px^2], and its file with the hash.

    `starts`: number of columns of a product narrower than the line -> column of the line at which it begins.
    """

    sensor: str
    spline: ColumnSpline
    covariance: Array
    path: str
    sha256: str
    starts: Mapping[int, float] = field(default_factory=dict)

    @classmethod
    @cache
    def prior(cls, sensor: str, width: int) -> Calibration:
        """Return the prior of a sensor with `width` columns: mean 0, and a covariance from published figures."""
        curve = LineCurve(width, np.zeros(0))
        knots = np.arange(LINE_SPLINES) * width / (LINE_SPLINES - 3)
        kernel = _PRIOR_SIGMA**2 * np.exp(-np.abs(knots[:, None] - knots) / _PRIOR_LENGTH)
        covariance = curve.bent @ la.block_diag(kernel, kernel) @ curve.bent.T
        return cls(sensor, ColumnSpline(width, np.zeros((LINE_SPLINES, 2))), covariance, "", f"prior {sensor} {width}")

    @property
    def curve(self) -> LineCurve:
        """Layout of the unknowns."""
        return LineCurve(self.spline.width, self.spline.edges)

    @cached_property
    def root(self) -> Array:
        """Independent errors (n, k) of the curve, of one standard deviation each, the largest first."""
        size, vectors = la.eigh(self.covariance)
        kept = np.flatnonzero(size > SLIGHT * size.sum())[::-1]
        return np.asarray(vectors[:, kept] * np.sqrt(size[kept]))


@dataclass(frozen=True, eq=False)
class CommonErrors:
    """Errors common to all images of a sensor: those of its calibration or, without one, of the prior."""

    of_view: tuple[Calibration | None, ...]  # of each of N views; None: no common errors

    @cached_property
    def _calibrations(self) -> list[tuple[Calibration, BoolArray]]:
        """The calibrations, each with the mask (N,) of its views."""
        used = {one.sha256: one for one in self.of_view if one is not None}
        found = np.array([None if one is None else one.sha256 for one in self.of_view])
        return [(one, found == key) for key, one in used.items()]

    @cached_property
    def _starts(self) -> Array:
        """Columns of the line (N,) [px] at which the views begin."""
        return np.array([0.0 if one is None else one.spline.start for one in self.of_view])

    @property
    def count(self) -> int:
        """Number k of independent errors."""
        return sum(one.root.shape[1] for one, _ in self._calibrations)

    def moved(self, view: IntArray, col: Array) -> Array:
        """Return the displacements (k, K, 2) [px] at columns (K,) of views (K,) by one sigma of each error."""
        found, on_line = [np.zeros((0, len(col), 2))], col + self._starts[view]
        for one, of in self._calibrations:
            basis = one.curve.basis(on_line) * of[view][:, None]
            found.append(np.stack([basis @ part for part in np.split(one.root, 2)]).transpose(2, 1, 0))
        return np.concatenate(found)

    def _displaced(self, view: IntArray, col: Array, weight: Array) -> Iterator[tuple[int, sp.csr_array, Array]]:
        """Yield, by calibration and coordinate (0: col, 1: row): the coordinate, the weighted displacements (K, m) per
        coefficient, and the coefficients (m, k) per error.
        """
        first, on_line = 0, col + self._starts[view]
        for one, of in self._calibrations:
            curve, last, own = one.curve, first + one.root.shape[1], of[view]
            values, place = curve.local(on_line[own])
            bounds = np.concatenate([[0], np.cumsum(values.shape[1] * own)])
            weighted = (values * weight[own][:, None]).ravel()
            matrix = sp.csr_array((weighted, place.ravel(), bounds), shape=(len(col), curve.size + 1))
            for axis, part in enumerate(np.split(one.root, 2)):
                by_error = np.zeros((curve.size + 1, self.count))
                by_error[:, first:last] = curve.by_detector @ part
                yield axis, matrix, by_error
            first = last

    def respond(self, problem: Problem, state: State, weight: Array, covariance: Covariance) -> SharedErrors:
        """Return the response of an adjustment, of weights (K,) [1/px], to one standard deviation of each error."""
        structure, reduced, q = problem.structure, covariance.reduced, covariance.num_unknowns
        projected = problem.linearise(state.params, state.points)
        projected.by_point[:] *= weight
        whitened = whiten(projected.by_point, reduced.lower[:, structure.point])
        gradient, common = np.zeros((structure.num_views, q, self.count)), reduced.common
        axes = structure.num_points * np.arange(3)
        of_common = np.zeros((0 if common is None else len(common.half), self.count))
        for axis, matrix, by_error in self._displaced(structure.view, problem.xy[0], weight):
            of_points = _point_sums(whitened[axis], structure.by_point, np.diff(structure.point_bounds)) @ matrix
            moved = np.diff(of_points.indptr)[: structure.num_points] > 0
            for v, rows in enumerate(map(slice, structure.bounds[:-1], structure.bounds[1:])):
                if not moved[structure.point[rows]].any():
                    continue
                at = (structure.point[rows, None] + axes).ravel()
                found = matrix[rows].T @ (projected.by_unknown[axis, :, rows] * weight[rows]).T
                found -= of_points[at].T @ reduced.cross[rows].reshape(-1, q)
                gradient[v] += found.T @ by_error
            if common is not None:
                at = (common.index[:, None] + axes).ravel()
                of_common -= common.cross.reshape(len(at), -1).T @ (of_points[at] @ by_error)
        flat = gradient.reshape(-1, self.count)
        if common is not None:
            of_common = la.solve_triangular(common.upper, of_common, trans="T")
            flat = flat - common.by_camera.T @ of_common
        linearised = replace(problem, _room=[]), state, weight, reduced  # kept as long as the result
        return SharedErrors(covariance.solve(flat), partial(self._point_moves, linearised, of_common))

    def _point_moves(
        self,
        linearised: tuple[Problem, State, Array, Reduced],
        of_common: Array,
        index: IntArray,
    ) -> Array:
        """Return the displacements (n, 3, k) [m] of points `index`, fixed cameras; `of_common` is of height errors."""
        problem, state, weight, reduced = linearised
        structure = problem.structure
        place = np.full(structure.num_points, -1)
        place[index] = np.arange(len(index))
        rows = np.flatnonzero(place[structure.point] >= 0)
        point, bounds = structure.point[rows], np.searchsorted(rows, structure.bounds)
        ecef, xy = structure.of_points(state.points)[:, rows], problem.xy[:, rows]
        projected = problem.cameras.seeing(xy).project(state.params, ecef, bounds, "points")
        whitened = whiten(projected.by_point * weight[rows], reduced.lower[:, point])
        at = place[point]
        sums = partial(_point_sums, order=np.argsort(at, kind="stable"), count=np.bincount(at, minlength=len(index)))
        flat = np.zeros((3 * len(index), self.count))
        for axis, matrix, by_error in self._displaced(structure.view[rows], xy[0], weight[rows]):
            flat += (sums(whitened[axis]) @ matrix) @ by_error
        half = flat.reshape(3, len(index), -1).swapaxes(0, 1)
        if (common := reduced.common) is not None:
            held = place[common.index] >= 0
            half[place[common.index[held]]] -= common.cross[held] @ la.solve_triangular(common.upper, of_common)
        return np.asarray(solve_transposed(reduced.lower[:, index, None], half.transpose(1, 0, 2)).transpose(1, 0, 2))


def _point_sums(whitened: Array, order: IntArray, count: IntArray) -> sp.csr_array:
    """Return derivatives (3, K) by points as a sparse matrix (3 P, K), which sums observations over each point.

    `order` (K,) sorts the observations by point; `count` (P,) is the number of observations of each point.
    """
    bounds = np.concatenate([[0], np.cumsum(np.tile(count, 3))])
    return sp.csr_array((whitened[:, order].ravel(), np.tile(order, 3), bounds), shape=(3 * len(count), len(order)))
