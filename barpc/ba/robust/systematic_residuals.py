"""The smooth part of the residuals of each view: it is removed before outliers are rejected, and tested at the end.

Noise and wrong matches scatter. Errors that a camera model cannot represent (jitter, distortion, a wrong rotation) are
smooth functions of the image, and would be rejected as outliers. Therefore the residuals of each view are split into a
smooth part and the scatter. The smooth part is fitted by weighted least squares. It is a spline over the rows plus
polynomials of low degree of the columns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from barpc.ba.constraints.block import Block
from barpc.ba.constraints.ground import MAX_INDEPENDENT_ERRORS
from barpc.ba.parameters.unknowns import Unknowns
from barpc.ba.solving.structure import Structure
from barpc.base.geodesy import Array, metres_per_unit, parts
from barpc.base.statistics import KEPT, MANY, OUTLIER, RIDGE, evenly
from barpc.scene import BoolArray, IntArray
from barpc.sensor.image_corrections import bsplines

SmoothFit = dict[int, tuple[slice, Array]]
"""View number -> slice of its observations, and coefficients (2, NUM_TERMS) of their smooth part."""

SPLINES = 14
"""Number of cubic B-splines over the rows of an image. They represent changes over a tenth of the rows or more."""

NUM_TERMS = SPLINES + 4  # number of terms: splines, and col, col^2, col^3, row col
_PER_TERM = 10  # least number of observations per term; views with fewer have no smooth part
# The squared second differences of spline coefficients are penalised, for rows without observations: weight over the
# mean weight that observations give a coefficient, and matrix of the squares.
_BEND = 1e-2
_BENDING = np.diff(np.eye(SPLINES), n=2, axis=0).T @ np.diff(np.eye(SPLINES), n=2, axis=0)


@dataclass(frozen=True, eq=False)
class NoiseCorrelation:
    """Correlation of the noise of a block's K observations.

    Points registered to a reference image have correlated errors: their templates overlap, and seasons, shadows and
    terrain have the same effect on many of them. A smooth part of their residuals is therefore not the camera's alone.
    The correlation of two points is the overlap of their templates. For each term of the smooth part, all reference
    points of a view count as at most `MAX_INDEPENDENT_ERRORS` independent observations.
    """

    of_reference: BoolArray  # (K,) mask of the observations of reference points
    place: Array  # (2, K) east, north of reference points [m]
    width: float  # of their templates [m]
    share: Array  # (K,) effective number of independent observations of each, at most 1
    precision: Array  # (K,) weight: `share` times the variance of the view's tie points over that of the observation

    @classmethod
    def of(cls, block: Block) -> NoiseCorrelation | None:
        """Return the noise correlation of the observations of a block; None if it has no reference image."""
        given = block.reference
        if given is None:
            return None
        rows = block.point >= block.num_known
        lonlatalt = given.points.lonlatalt
        east_north = (lonlatalt * metres_per_unit(lonlatalt.mean(axis=0)))[:, :2].T
        place = np.zeros((2, len(rows)))
        place[:, rows] = east_north[:, block.point[rows] - block.num_known]
        share, precision = np.ones(len(rows)), np.ones(len(rows))
        found = cls(rows, place, given.width, share, precision)
        for view in np.unique(block.view[rows]):
            own = np.flatnonzero(rows & (block.view == view))
            ties = ~rows & (block.view == view)
            sampled = own[evenly(len(own), MANY)]  # points of a grid: some are representative of all
            alike = found.overlap(sampled[:, None], own[None]).sum(axis=1).mean()
            share[own] = 1.0 / (alike + len(own) / (NUM_TERMS * MAX_INDEPENDENT_ERRORS))
            usual = np.median(block.sigma[ties] if ties.any() else block.sigma[own])
            precision[own] = share[own] * (usual / block.sigma[own]) ** 2
        return found

    def overlap(self, first: IntArray, second: IntArray) -> Array:
        """Return the overlap (...) of the templates of two reference observations, as a share of their area."""
        apart = np.abs(self.place[:, first] - self.place[:, second])
        if self.width == 0:
            return np.asarray((apart == 0).all(axis=0), np.float64)
        return np.asarray(np.maximum(1.0 - apart / self.width, 0.0).prod(axis=0))

    def correlation(self, first: IntArray, second: IntArray) -> Array:
        """Return the correlation (...), 0 to 1, of the noise of two observations of one view."""
        both = self.of_reference[first] & self.of_reference[second]
        same = self.overlap(first, second)
        return np.asarray(both * (same + (1.0 - same) / MAX_INDEPENDENT_ERRORS))


@dataclass(frozen=True, eq=False)
class SmoothTest:
    """The smooth part of the residuals of each view, and its significance."""

    # (N,) RMS length of the smooth part [px], less the contribution of noise; 0 for a view with too few observations
    rms: Array
    # (N,) p-value of an F test of the smooth part; 1 for a view with too few observations
    significance: Array
    # (N,) share of its sum of squares that the splines over the rows explain; NaN for a view without a fit
    by_row: Array
    # (N,) RMS of the error that neighbours along the columns or the rows share [px]; the larger of both, 0 if it is not
    # significant. Jitter and steps that are too fine for the smooth part are included
    shared: Array
    # (N,) share of a squared camera error that remains in the residuals; ground points absorb the rest
    redundancy: Array | float = 1.0

    def of_cameras(self) -> Array:
        """Return the systematic errors (N,) of the cameras [px].

        Each is the larger of `rms` and `shared`, over the square root of the redundancy.
        """
        return np.maximum(self.rms, self.shared) / np.sqrt(self.redundancy)

    def misfit(self) -> Array:
        """Return the RMS (N,) of significant smooth parts [px]; 0 for views without one."""
        return np.where(self.found(0.0), self.rms, 0.0)

    def found(self, least: float, level: float = 1e-4) -> BoolArray:
        """Return the mask (N,) of views with a significant smooth part (p-value below `level`) above `least` [px]."""
        return np.asarray((self.rms > least) & (self.significance < level))


class Smooth:
    """Model of the smooth parts of the residuals of all views, for observations at `xy` (2, K) [px].

    `noise` is the correlation of the noise of the observations; None: they are independent. Only the observations in
    the mask `usable` (K,) are used.
    """

    def __init__(
        self,
        structure: Structure,
        xy: Array,
        unknowns: Unknowns,
        noise: NoiseCorrelation | None = None,
        usable: BoolArray | None = None,
    ) -> None:
        self.structure, self.noise = structure, noise
        self._usable = np.ones(xy.shape[1], dtype=bool) if usable is None else usable
        col, row = unknowns.normalized(xy, structure.view).clip(-1.0, 1.0)
        self._place = xy
        self._col, self._row = col, row
        self._kept = self._all_terms() if len(col) <= KEPT else None

    def _basis(self, rows: slice) -> Array:
        """Return the terms (NUM_TERMS, n) at some observations, computed now or kept."""
        return self._terms(rows) if self._kept is None else self._kept[:, rows]

    def _all_terms(self) -> Array:
        """Compute the terms (NUM_TERMS, K) at all observations."""
        out = np.empty((NUM_TERMS, len(self._col)))
        for part in parts(len(self._col)):
            out[:, part] = self._terms(part)
        return out

    def _terms(self, rows: slice) -> Array:
        """Compute the terms (NUM_TERMS, n) at some observations."""
        col, row = self._col[rows], self._row[rows]
        return np.vstack([bsplines(row, SPLINES), col, col * col, col * col * col, row * col])

    def part(self, residual: Array, weight: Array, fit: SmoothFit | None = None) -> Array:
        """Return the smooth part (2, K) of residuals (2, K) [px], fitted with weights (K,) >= 0.

        It is zero for views with too few observations of positive weight.
        """
        out = np.zeros_like(residual)
        for rows, coefficients in (self.fit(residual, weight) if fit is None else fit).values():
            out[:, rows] = coefficients @ self._basis(rows)
        return out

    def test(self, residual: Array, use: BoolArray, fit: SmoothFit | None = None) -> SmoothTest:
        """Test the smooth part of the residuals (2, K) [px] of the observations in use.

        `shared` is not tested here, see `test_neighbours`.
        """
        n = self.structure.num_views
        rms, significance, by_row = np.zeros(n), np.ones(n), np.full(n, np.nan)
        use = use & self._usable
        weight = use.astype(np.float64)
        residual = np.where(use, residual, 0.0)
        share, precision = (
            (weight, weight) if self.noise is None else (weight * self.noise.share, weight * self.noise.precision)
        )
        terms = 2.0 * NUM_TERMS
        for v, (rows, coefficients) in (self.fit(residual, weight) if fit is None else fit).items():
            count, root = 2 * float(share[rows].sum()), np.sqrt(precision[rows])
            basis = self._basis(rows)
            smooth = (coefficients @ basis) * root
            explained = float((smooth**2).sum())
            along = (coefficients[:, :SPLINES] @ basis[:SPLINES]) * root
            by_row[v] = min(float((along**2).sum()) / max(explained, 1e-30), 1.0)
            if count <= terms + 1.0:  # no degrees of freedom are left
                continue
            left = float(((residual[:, rows] * root) ** 2).sum()) - explained
            scatter = max(left / (count - terms), 1e-30)
            significance[v] = float(fdtrc(terms, count - terms, explained / terms / scatter))
            rms[v] = np.sqrt(max(explained - terms * scatter, 0.0) / float(precision[rows].sum()))
        return SmoothTest(rms, significance, by_row, np.zeros(n))

    def test_neighbours(
        self, tested: SmoothTest, residual: Array, use: BoolArray, redundancy: Array | float
    ) -> SmoothTest:
        """Return the test with `shared` and `redundancy` added.

        `shared` is the square root of the mean product of the residuals of neighbours, in views with a smooth part.
        """
        kept = np.flatnonzero(use & self._usable & np.isfinite(tested.by_row)[self.structure.view])
        shared, view = np.zeros_like(tested.rms), self.structure.view[kept]
        last = view[1:]
        pairs = (last == view[:-1]).astype(np.float64)  # of neighbours in one view
        count = np.maximum(self._sums(last, pairs), 1.0)
        apart = view * (np.ptp(self._place) + 1.0)
        for place in self._place[:, kept]:
            order = kept[np.argsort(apart + place, kind="stable")]
            ordered, num_pairs = residual[:, order], count
            product = (ordered[:, 1:] * ordered[:, :-1]).sum(axis=0)
            if self.noise is not None:
                product, num_pairs = self._beyond_noise(product, (ordered**2).sum(axis=0), order, pairs)
            mean = self._sums(last, product * pairs) / count
            scatter = np.sqrt(self._sums(last, (product - mean[last]) ** 2 * pairs) / count)
            is_significant = mean > OUTLIER * scatter / np.sqrt(np.maximum(num_pairs, 1.0))
            shared = np.maximum(shared, np.sqrt(np.where(is_significant, mean, 0.0)))
        return replace(tested, shared=shared, redundancy=redundancy)

    def _sums(self, view: IntArray, values: Array) -> Array:
        """Return the sums (N,) of values (n,) over those of each view."""
        return np.asarray(np.bincount(view, values, self.structure.num_views))

    def _beyond_noise(self, product: Array, square: Array, order: IntArray, pairs: Array) -> tuple[Array, Array]:
        """Return the products (n - 1,) of neighbours' residuals, less their expectation for correlated noise.

        `square` (n,) are the squared residuals. `pairs` (n - 1,) is 1 for neighbours in one view, else 0. Also returned
        is the equivalent number (N,) of independent pairs in each view.
        """
        assert self.noise is not None
        first, second = order[:-1], order[1:]
        view, same = self.structure.view[second], self.noise.correlation(first, second)
        weight = np.sqrt(self.noise.precision[first] * self.noise.precision[second])
        beyond = weight * (product - same * 0.5 * (square[1:] + square[:-1]))
        size = self._sums(view, weight * (1.0 - same) * pairs) / np.maximum(self._sums(view, pairs), 1.0)
        return beyond / np.maximum(size, 1e-12)[view], self._sums(view, self.noise.share[second] * pairs)

    def fit(self, residual: Array, weight: Array) -> SmoothFit:
        """Fit the smooth part of residuals (2, K) [px] with weights (K,), in each view with enough observations."""
        weight = weight * self._usable
        counts = self.structure.sum_views(weight[None])[:, 0]
        views = np.flatnonzero(counts >= _PER_TERM * NUM_TERMS)
        counted = weight if self.noise is None else weight * self.noise.precision
        with np.errstate(invalid="ignore"):
            target = np.where(weight > 0, residual, 0.0)
        parts = [slice(*self.structure.bounds[v : v + 2].tolist()) for v in views]
        matrix, right = np.empty((len(views), NUM_TERMS, NUM_TERMS)), np.empty((len(views), NUM_TERMS, 2))
        for n, rows in enumerate(parts):
            basis = self._basis(rows)
            weighted = basis * counted[rows]
            np.matmul(weighted, basis.T, out=matrix[n])
            np.matmul(weighted, target[:, rows].T, out=right[n])
        every = np.arange(NUM_TERMS)
        diagonal = matrix[:, every, every]
        matrix[:, every, every] += RIDGE * (diagonal + diagonal.mean(axis=1, keepdims=True))
        bend = _BEND * diagonal[:, :SPLINES].mean(axis=1)
        matrix[:, :SPLINES, :SPLINES] += bend[:, None, None] * _BENDING
        found = np.swapaxes(np.linalg.solve(matrix, right), 1, 2)
        return dict(zip(views.tolist(), zip(parts, found, strict=True), strict=True))
