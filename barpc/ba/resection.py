"""Resection of one view by the ground points of the other views, and a diagnosis of its RPC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from barpc.ba.constraints.block import Block
from barpc.ba.parameters.projected import Projected
from barpc.ba.robust.systematic_residuals import SPLINES
from barpc.ba.robust.weights import geman_mcclure
from barpc.ba.solution import Solution
from barpc.ba.solving.normal import cholesky3, point_products, whiten
from barpc.base.geodesy import GEOID, Array, enu_basis, ground_from_ecef
from barpc.base.statistics import FEW, GROSS, MUCH_NOISE, SHRINK, SURELY, TIMES, kd_tree
from barpc.scene import BoolArray
from barpc.sensor.image_corrections import bsplines


@dataclass(frozen=True, eq=False)
class Placed:
    """A resected view: its camera was estimated alone, from known ground points."""

    params: Array  # (q,) unknowns of the camera
    covariance: Array  # (q, q) of these, uncertainty of the points included
    rows: BoolArray  # (K,) of the block: the n observations used
    xy: Array  # (2, n) their image coordinates [px]
    squared: Array  # (n,) squared residuals over variances
    left: Array  # (2, n) residuals over sigmas of a second fit, with splines over the rows
    noise: float  # observed over expected standard deviation of the residuals, by the median

    @property
    def meets(self) -> bool:
        """Whether the camera fits the points to the noise."""
        return self.noise < MUCH_NOISE

    def agree(self, limit: float) -> BoolArray:
        """Return the mask (n,) of observations within `limit` standard deviations."""
        return np.asarray(self.squared <= 2.0 * limit * limit)

    def contradicted(self, limit: float) -> float:
        """Return the share of observations beyond `limit` standard deviations of the fit with splines."""
        return float(self._far(limit).mean())

    def is_coherent(self, limit: float) -> bool:
        """Return whether outliers have residuals like their neighbours: then the camera is wrong, not the matches.

        Independent residuals differ by 1.4 times their size; coherent ones by less than it.
        """
        seen = np.asarray(np.isfinite(self.left).all(axis=0))
        if seen.mean() < 0.5:  # most points are outside the domain of the camera
            return True
        far = self._far(limit) & seen
        if far.sum() < FEW:
            return False
        left = self.left[:, far].T
        nearest = np.asarray(kd_tree(self.xy[:, far].T).query(self.xy[:, far].T, k=2)[1])[:, 1]
        difference, size = (np.linalg.norm(x, axis=1) for x in (left - left[nearest], left))
        return bool(np.median(difference) < np.median(size))

    def _far(self, limit: float) -> BoolArray:
        return ~np.asarray((self.left**2).sum(axis=0) <= 2.0 * limit * limit)


@dataclass(frozen=True, eq=False)
class RpcDiagnosis:
    """The change that makes the RPC of a view as accurate as stated; unknown if all fields have their defaults."""

    offset: Array | None = None  # (2,) col, row [px] of projected minus observed points
    height: float | None = None  # [m] by which heights are too high, if that explains the offset
    swapped: bool = False  # whether col and row are exchanged
    as_stated: bool = False  # no change: then its tie points may be wrong instead of the RPC


def retained_tracks(found: Solution, block: Block) -> BoolArray:
    """Return the mask (P,) of tracks with two or more inliers."""
    kept = np.bincount(block.point[found.outcome.inlier], minlength=block.num_points) >= 2
    kept[block.num_tracks :] = False
    return kept


def resect(found: Solution, others: Block, block: Block, view: int) -> Placed | None:
    """Resect a view by the ground points of a solution of the `others`; None with too few common points.

    The camera prior is so wide that it hardly acts. Variances of residuals are those of the noise and of the points.
    """
    rows = (block.view == view) & retained_tracks(found, others)[block.point]
    unknowns = found.problem.cameras.unknowns
    if rows.sum() < FEW:
        return None
    sight = _Sight(found, others, block, view, rows)
    u = (block.xy[1, rows] - unknowns.middle[1, view]) / unknowns.half[1, view]
    params, covariance, residual = sight.fit()
    squared = (residual**2).sum(axis=0)
    left = sight.fit(bsplines(u, SPLINES))[2]
    return Placed(params, covariance, rows, sight.xy, squared, left, median_noise(squared))


def median_noise(squared: Array) -> float:
    """Return the observed over expected standard deviation, from the median of squares (n,) of two coordinates."""
    return float(np.sqrt(np.median(squared) / chdtri(2.0, 0.5)))


class _Sight:
    """Observations of one view, of ground points from the other views, with covariances."""

    def __init__(self, found: Solution, others: Block, block: Block, view: int, rows: BoolArray) -> None:
        self.problem, self.view, self.xy = found.problem, view, block.xy[:, rows]
        self.cameras = self.problem.cameras.seeing(self.xy)
        self.ecef = np.ascontiguousarray(found.final.points[block.point[rows]].T)
        self.bounds = np.where(np.arange(len(block.views) + 1) > view, int(rows.sum()), 0)
        state, noise = found.final, found.outcome.noise
        weight = found.outcome.inlier / (others.sigma * noise)
        by_point = self.problem.project_points(state.params, state.points).by_point * weight
        sums = self.problem.structure.sum_points(point_products(by_point, np.zeros_like(others.xy))[:6])
        lower = cholesky3(sums + self.problem.point_terms(state.points)[0])
        spread = whiten(self.project(np.zeros_like(state.params)).by_point, lower[:, block.point[rows]])
        self.covariance = np.einsum("cin,din->ncd", spread, spread)
        self.covariance += ((block.sigma[rows] * noise) ** 2)[:, None, None] * np.eye(2)

    def project(self, params: Array) -> Projected:
        """Project the points through cameras of unknowns (N, q), with derivatives."""
        return self.cameras.project(params, self.ecef, self.bounds)

    def fit(self, splines: Array | None = None) -> tuple[Array, Array, Array]:
        """Return the unknowns (q,) of the view, their covariance, and residuals (2, n) over standard deviations.

        Robust, with a scale that shrinks as in `barpc.ba.robust.rounds`. `splines` (m, n) also displace col and row.
        """
        params = self.problem.camera_prior.mean.copy()
        beside = np.zeros((0, self.xy.shape[1])) if splines is None else splines
        size, m = params.shape[1], len(beside)
        # wide priors: of the camera, and of splines [px]
        sigma = np.append(GROSS * self.problem.camera_prior.sigma[self.view], np.full(2 * m, TIMES))
        moved, residual, scale = np.zeros(size + 2 * m), np.zeros((0, 2)), np.inf
        matrix = np.diag(sigma**-2.0)
        root = np.linalg.inv(np.linalg.cholesky(self.covariance))
        for _ in range(FEW):
            params[self.view] = moved[:size]
            projected = self.project(params)
            along = np.zeros((2, size + 2 * m, self.xy.shape[1]))
            along[:, :size] = projected.by_unknown
            along[0, size : size + m] = along[1, size + m :] = beside
            image = projected.image + moved[size:] @ along[:, size:]
            residual = np.einsum("ncd,dn->nc", root, image - self.xy)
            residual[~np.isfinite(residual).all(axis=1)] = np.inf
            squared = (residual**2).sum(axis=1)
            middle = median_noise(squared)
            if not np.isfinite(middle):
                break
            scale = SURELY * max(middle, 1.0) if np.isinf(scale) else max(SURELY, SHRINK * scale)
            near = np.flatnonzero(np.isfinite(squared))
            counted = geman_mcclure(squared[near] / (2.0 * scale**2))[1]
            rows = root[near] @ along[:, :, near].transpose(2, 0, 1)
            weighted = (rows * counted[:, None, None]).reshape(-1, len(sigma)).T
            matrix = weighted @ rows.reshape(-1, len(sigma)) + np.diag(sigma**-2.0)
            gradient = weighted @ residual[near].ravel() + moved / sigma**2
            moved = moved - np.linalg.solve(matrix, gradient)
        covariance = np.asarray(np.linalg.inv(matrix)[:size, :size], dtype=np.float64)
        return moved[:size], covariance, residual.T


def diagnose_rpc(found: Solution, block: Block, placed: Placed, view: int) -> RpcDiagnosis:
    """Find the one change with which the RPC of a view is as accurate as stated.

    Each change is applied to the delivered camera at the ground points of the others. The median residual must then be
    below the stated accuracy.
    """
    problem, point = found.problem, block.point[placed.rows]
    xy = block.xy[:, placed.rows]
    bounds = np.where(np.arange(len(block.views) + 1) > view, xy.shape[1], 0)
    ecef = found.final.points[point]
    params = problem.camera_prior.mean
    projected = problem.cameras.seeing(xy).project(params, np.ascontiguousarray(ecef.T), bounds, "points")
    off = projected.image - xy
    up = enu_basis(ground_from_ecef(ecef))[:, 2]
    by_height = np.einsum("cin,ni->cn", projected.by_point, up)
    constants = problem.cameras.unknowns.constants
    metres = float(np.sqrt((problem.camera_prior.sigma[view, :constants:3] ** 2).sum()))
    stated = metres * float(np.nanmedian(np.linalg.norm(projected.by_point, axis=1)))
    if not placed.meets and _median_length(off) < SURELY * stated:
        return RpcDiagnosis(as_stated=True)
    swapped = projected.image[::-1] - xy
    if _median_length(swapped) < SURELY * stated < _median_length(off):
        return RpcDiagnosis(swapped=True)
    offset = np.nanmedian(off, axis=1)
    if not (_median_length(off - offset[:, None]) < stated):
        return RpcDiagnosis()
    height = float(np.nanmedian((by_height * off).sum(axis=0) / (by_height**2).sum(axis=0)))
    near = abs(height) < GEOID  # height surfaces differ by less
    explains = near and _median_length(off - height * by_height) < stated
    return RpcDiagnosis(offset=offset, height=height if explains else None)


def _median_length(off: Array) -> float:
    """Return the median length of residuals (2, n) [px]; those that are not finite count as infinite."""
    length = np.linalg.norm(off, axis=0)
    return float(np.median(np.where(np.isfinite(length), length, np.inf)))
