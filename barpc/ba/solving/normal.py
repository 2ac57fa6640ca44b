"""The reduced normal equations: points eliminated (Schur complement), cameras left.

With whitened derivatives A_k by the point and B_k by the view's unknowns, V_p = sum A^T A = L L^T and
Y_k = L^-1 A_k^T B_k, the camera matrix is S = diag(sum B^T B) - sum_p Y^T Y and its gradient
g = sum B^T r - sum Y^T h, where h_p = L^-1 sum A^T r. Errors common to several heights are eliminated
after the points. They couple all cameras: where S is sparse, their (dense, low-rank) part of S is kept separately.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy.linalg as la

from barpc.ba.parameters.priors import PointPrior
from barpc.ba.solving.linear import Blocks, Factor, Matrix, factorize, factorize_blocks
from barpc.ba.solving.structure import LEAF, Structure
from barpc.base.geodesy import CHUNK, Array, parts
from barpc.scene import BoolArray, IntArray

TRIANGLE = tuple((i, j) for j in range(3) for i in range(j, 3))
"""Order of the elements of symmetric 3x3 matrices."""


@dataclass(frozen=True)
class Common:
    """Errors common to several points, eliminated after the points."""

    index: IntArray  # (Q,) the points
    cross: Array  # (Q, 3, m) L^-1 times the second derivatives by point and error
    upper: Array  # (m, m) U, where U^T U is their normal matrix after the elimination of the points
    by_camera: Array  # (m, N q) U^-T times the second derivatives by error and camera unknown
    half: Array  # (m,) U^-T times their gradient

    def step(self, step: Array) -> Array:
        """Return the changes (m, s) of the errors that follow from steps (N q, s) of the camera unknowns alone."""
        return -la.solve_triangular(self.upper, self.by_camera @ step)


@dataclass(frozen=True)
class Reduced:
    """The linearised problem with its points eliminated."""

    structure: Structure
    matrix: Matrix  # (N q, N q) S; if sparse, without the part of the common errors
    # (N q,) g: derivative of half the cost by the camera unknowns, with each point at its optimum (linearised)
    gradient: Array
    cost: float  # sum of squared whitened residuals
    gain: float  # decrease of the cost if only points (and common errors) moved: sum |h|^2
    lower: Array  # (6, P) L: its elements 00, 10, 20, 11, 21, 22
    half: Array  # (P, 3) h
    cross: Array  # (K, 3, q) Y
    common: Common | None = None  # None: points have no errors in common

    def plain(self, free: BoolArray) -> Array:
        """Return S (n, n) as a dense array, of the `free` (N q,) unknowns only."""
        dense = self.matrix if isinstance(self.matrix, np.ndarray) else self.matrix.plain()
        if self.common is not None and dense is not self.matrix:
            dense -= self.common.by_camera.T @ self.common.by_camera
        return dense if free.all() else dense[np.ix_(free, free)]

    def of_views(self) -> Array:
        """Return the diagonal blocks (N, q, q) of S."""
        if not isinstance(self.matrix, np.ndarray):
            if self.common is None:
                return self.matrix.diagonal
            less = self.common.by_camera.reshape(-1, *self.matrix.diagonal.shape[:2])
            return np.asarray(self.matrix.diagonal - np.einsum("mni,mnj->nij", less, less))
        n, q, every = self.structure.num_views, self.cross.shape[2], np.arange(self.structure.num_views)
        return np.asarray(self.matrix.reshape(n, q, n, q)[every, :, every, :])

    def factor(self, free: BoolArray, damping: float = 0.0) -> Factor:
        """Return the factorised S of the `free` (N q,) unknowns; each view is free or fixed as a whole."""
        if isinstance(self.matrix, np.ndarray):
            return factorize(self.plain(free), damping)
        order = self.structure.order(free[:: self.cross.shape[2]])
        less = None if self.common is None else self.common.by_camera[:, free]
        return factorize_blocks(self.matrix, order, damping, less)

    def with_diagonal(self, more: Array) -> Reduced:
        """Return the problem with information (N, q, q) of priors on single views added to the diagonal of S."""
        if isinstance(self.matrix, np.ndarray):
            return replace(self, matrix=self.matrix + la.block_diag(*more))
        return replace(self, matrix=replace(self.matrix, diagonal=self.matrix.diagonal + more))

    def with_joint(self, index: IntArray, information: Array) -> Matrix:
        """Return S plus the information (n, n) of a prior on `index` (n,): all unknowns of several views, in order."""
        if isinstance(self.matrix, np.ndarray):
            matrix = self.matrix.copy()
            matrix[np.ix_(index, index)] += information
            return matrix
        q = self.cross.shape[2]
        views = index[::q] // q
        blocks = information.reshape(len(views), q, len(views), q)
        diagonal, pairs = self.matrix.diagonal.copy(), self.matrix.pairs.copy()
        every = np.arange(len(views))
        diagonal[views] += blocks[every, :, every, :]
        i, j = np.nonzero(views[:, None] < views)
        key, n = self.structure.pair_view @ [len(diagonal), 1], len(diagonal)
        pairs[np.searchsorted(key, views[i] * n + views[j])] += blocks[i, :, j, :]
        return Blocks(diagonal, pairs, self.structure.pair_view)

    def point_step(self, step: Array) -> Array:
        """Return the step (P, 3) [m] of the points that belongs to a step (N, q) of the camera unknowns."""
        structure = self.structure
        moved = np.empty((3, len(self.cross)))
        for v, (start, stop) in enumerate(zip(structure.bounds[:-1], structure.bounds[1:], strict=True)):
            rows = self.cross[start:stop].reshape(-1, step.shape[1])
            moved[:, start:stop] = (rows @ step[v]).reshape(-1, 3).T
        half = self.half.T + structure.sum_points(moved)
        if self.common is not None:
            common = self.common.step(step.ravel()) - la.solve_triangular(self.common.upper, self.common.half)
            half[:, self.common.index] += (self.common.cross @ common).T
        return -solve_transposed(self.lower, half).T

    def carried(self, step: Array, index: IntArray) -> Array:
        """Return the displacements (n, 3, s) [m] of points `index` (n,) by steps (N, q, s) of the cameras alone."""
        structure = self.structure
        place = np.full(structure.num_points, -1)
        place[index] = np.arange(len(index))
        rows = np.flatnonzero(place[structure.point] >= 0)
        half = np.zeros((3, len(index), step.shape[2]))
        np.add.at(half.swapaxes(0, 1), place[structure.point[rows]], self.cross[rows] @ step[structure.view[rows]])
        if self.common is not None:
            common = self.common.cross @ self.common.step(step.reshape(-1, step.shape[2]))
            known = place[self.common.index] >= 0
            half[:, place[self.common.index[known]]] += common[known].swapaxes(0, 1)
        return np.moveaxis(-solve_transposed(self.lower[:, index, None], half), 0, 1)


def reduce_normal(
    structure: Structure,
    residual: Array,
    by_point: Array,
    by_unknown: Array,
    point_matrix: Array,
    point_gradient: Array,
    camera_matrix: Array,
    camera_gradient: Array,
    point_prior: PointPrior | None = None,
) -> Reduced:
    """Eliminate the points of a linearised problem; its cost excludes the priors.

    Residuals (2, K) are whitened, as are their derivatives `by_point` (2, 3, K) and `by_unknown` (2, q, K). Priors add
    `point_matrix` (6, P; elements as in `Reduced.lower`) to V and `point_gradient` (3, P) to sum A^T r. They add
    `camera_matrix` (N, q, q) to S and `camera_gradient` (N, q) to g. Common errors of `point_prior` are eliminated too.
    """
    sums = structure.sum_points(point_products(by_point, residual))
    lower = cholesky3(sums[:6] + point_matrix)
    half = solve_lower(lower, sums[6:] + point_gradient)
    cross = _eliminate(structure, by_point, by_unknown, lower)
    diagonal, gradient = _view_terms(structure, residual, by_unknown, cross, half)
    gradient += camera_gradient
    diagonal += camera_matrix
    matrix, full_gradient = _assemble(structure, diagonal, _pair_blocks(structure, cross)), gradient.ravel()
    gain = float((half**2).sum())
    common = None
    if point_prior is not None and point_prior.common.shape[2]:
        common = _common_part(structure, point_prior, lower, half, cross)
        full_gradient = full_gradient - common.by_camera.T @ common.half
        gain += float(common.half @ common.half)
        if isinstance(matrix, np.ndarray):
            matrix = matrix - common.by_camera.T @ common.by_camera
    return Reduced(structure, matrix, full_gradient, float((residual**2).sum()), gain, lower, half.T, cross, common)


def _common_part(structure: Structure, prior: PointPrior, lower: Array, half: Array, cross: Array) -> Common:
    """Return the common errors of a point prior. They are at their optimum for the given points, so their gradient
    comes only from the elimination of the points.
    """
    index, m = prior.index, prior.common.shape[2]
    by_point = np.swapaxes(prior.rows, 1, 2) @ -prior.common
    whitened = np.stack([solve_lower(lower[:, index], by_point[:, :, j].T).T for j in range(m)], axis=2)
    flat = whitened.reshape(-1, m)
    upper = la.cholesky(prior.information() - flat.T @ flat)
    by_camera = by_cameras(structure, cross, index, whitened)
    gradient = -np.einsum("qim,iq->m", whitened, half[:, index])
    return Common(
        index,
        whitened,
        upper,
        la.solve_triangular(upper, by_camera, trans="T"),
        la.solve_triangular(upper, gradient, trans="T"),
    )


def by_cameras(structure: Structure, cross: Array, index: IntArray, whitened: Array) -> Array:
    """Return the derivatives (m, N q) by the camera unknowns of m functions of the points `index` (Q,).

    `whitened` (Q, 3, m) is L^-1 times the derivatives by the points, `cross` (K, 3, q) the coupling Y.
    """
    place = np.full(structure.num_points, -1)
    place[index] = np.arange(len(index))
    rows, (q, m) = np.flatnonzero(place[structure.point] >= 0), (cross.shape[2], whitened.shape[2])
    out = np.empty((m, structure.num_views, q))
    for v, of_view in enumerate(np.split(rows, np.searchsorted(rows, structure.bounds[1:-1]))):
        of_points = whitened[place[structure.point[of_view]]].reshape(-1, m)
        out[:, v] = -of_points.T @ cross[of_view].reshape(-1, q)
    return out.reshape(m, -1)


def point_products(by_point: Array, residual: Array, weight: Array | None = None) -> Array:
    """Return the products (9, K): the six elements of A^T A (order of `TRIANGLE`) and the three of A^T r.

    Derivatives and residuals are whitened, or become so by weights (K,).
    """
    products = np.empty((9, residual.shape[1]))
    for part in parts(residual.shape[1]):
        (a, b), r = by_point[..., part], residual[:, part]
        if weight is not None:
            a, b, r = a * weight[part], b * weight[part], r * weight[part]
        for n, (i, j) in enumerate(TRIANGLE):
            np.add(a[i] * a[j], b[i] * b[j], out=products[n, part])
        np.add(a * r[0], b * r[1], out=products[6:, part])
    return products


def cholesky3(matrix: Array) -> Array:
    """Return the lower Cholesky factors (6, P) of symmetric 3x3 matrices, elements 00, 10, 20, 11, 21, 22.

    A direction without information gets the factor 1: its gradient is zero, so it does not move.
    """
    a, b, c, d, e, f = matrix
    tiny = 1e-12 * np.maximum(a + d + f, 1e-12)
    l00 = np.sqrt(np.where(a > tiny, a, 1.0))
    l10, l20 = b / l00, c / l00
    rest = d - l10 * l10
    l11 = np.sqrt(np.where(rest > tiny, rest, 1.0))
    l21 = (e - l20 * l10) / l11
    rest = f - l20 * l20 - l21 * l21
    l22 = np.sqrt(np.where(rest > tiny, rest, 1.0))
    return np.stack([l00, l10, l20, l11, l21, l22])


def solve_lower(lower: Array, rhs: Array) -> Array:
    """Return L^-1 b for factors (6, P) and right-hand sides (3, P)."""
    l00, l10, l20, l11, l21, l22 = lower
    x = rhs[0] / l00
    y = (rhs[1] - l10 * x) / l11
    return np.stack([x, y, (rhs[2] - l20 * x - l21 * y) / l22])


def solve_transposed(lower: Array, rhs: Array) -> Array:
    """Return L^-T b for factors (6, P) and right-hand sides (3, P)."""
    l00, l10, l20, l11, l21, l22 = lower
    z = rhs[2] / l22
    y = (rhs[1] - l21 * z) / l11
    return np.stack([(rhs[0] - l10 * y - l20 * z) / l00, y, z])


def _eliminate(structure: Structure, by_point: Array, by_unknown: Array, lower: Array) -> Array:
    """Return Y (K, 3, q), the whitened coupling of points and cameras."""
    q, count = by_unknown.shape[1:]
    cross = np.empty((count, 3, q))
    for part in parts(count):
        point = structure.point[part]
        whitened = whiten(by_point[..., part], lower.take(point, axis=1, mode="clip"))
        unknown = by_unknown[..., part]
        rows = whitened[0, :, None] * unknown[0]
        rows += whitened[1, :, None] * unknown[1]
        cross[part] = rows.reshape(3 * q, -1).T.reshape(-1, 3, q)
    return cross


def whiten(by_point: Array, lower: Array) -> Array:
    """Return a L^-T, (2, 3, n), of derivatives (2, 3, n) and factors (6, n)."""
    l00, l10, l20, l11, l21, l22 = lower
    out = np.empty_like(by_point)
    np.divide(by_point[:, 0], l00, out=out[:, 0])
    np.divide(by_point[:, 1] - l10 * out[:, 0], l11, out=out[:, 1])
    np.divide(by_point[:, 2] - l20 * out[:, 0] - l21 * out[:, 1], l22, out=out[:, 2])
    return out


def _view_terms(
    structure: Structure, residual: Array, by_unknown: Array, cross: Array, half: Array
) -> tuple[Array, Array]:
    """Return sum B^T B - sum Y^T Y (N, q, q) and sum B^T r - sum Y^T h (N, q) of each view."""
    q = cross.shape[2]
    matrix, gradient = np.empty((structure.num_views, q, q)), np.empty((structure.num_views, q))
    of_points = np.ascontiguousarray(half.T)
    for v, (start, stop) in enumerate(zip(structure.bounds[:-1], structure.bounds[1:], strict=True)):
        (col, row), r = by_unknown[..., start:stop], residual[:, start:stop]
        pulled = cross[start:stop].reshape(-1, q)
        h = of_points.take(structure.point[start:stop], axis=0, mode="clip").ravel()
        np.subtract(col @ col.T + row @ row.T, pulled.T @ pulled, out=matrix[v])
        gradient[v] = col @ r[0] + row @ r[1] - h @ pulled
    return matrix, gradient


def _pair_blocks(structure: Structure, cross: Array) -> Array:
    """Return the blocks -sum Y_i^T Y_j (M, q, q) of all pairs of views."""
    q = cross.shape[2]
    bounds = structure.pair_bounds
    out = np.empty((len(bounds) - 1, q, q))
    m = 0
    while m < len(out):  # as many whole view pairs as fit the chunk, at least one
        stop = max(m + 1, int(np.searchsorted(bounds, bounds[m] + CHUNK, side="right")) - 1)
        base = bounds[m]
        rows = slice(base, bounds[stop])  # "clip" is faster: it does not check the indices
        first = cross.take(structure.first[rows], axis=0, mode="clip").reshape(-1, q)
        second = cross.take(structure.second[rows], axis=0, mode="clip").reshape(-1, q)
        for n, (a, b) in enumerate(pairwise((3 * (bounds[m : stop + 1] - base)).tolist()), m):
            np.matmul(first[a:b].T, second[a:b], out=out[n])
        m = stop
    return np.negative(out, out=out)


def _assemble(structure: Structure, diagonal: Array, pairs: Array) -> Matrix:
    """Return the reduced matrix: a dense array if all views fit one front."""
    blocks = Blocks(diagonal, pairs, structure.pair_view)
    return blocks.plain() if len(diagonal) <= LEAF else blocks
