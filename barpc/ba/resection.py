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
from barpc.base.statistics import CRITICAL, FEW, GROSS, MUCH_NOISE, SHRINK, SURELY, TIMES, kd_tree
from barpc.scene import BoolArray
from barpc.sensor.image_corrections import bsplines


@dataclass(frozen=True, eq=False)
class Placed:
    """A resected view: its camera alone was estimated, from ground points of the other views."""

    params: Array  # (q,) unknowns of the camera
    covariance: Array  # (q, q) of the unknowns, with the uncertainty of the points
    rows: BoolArray  # (K,) mask of the n observations of the block that were used
    xy: Array  # (2, n) their image coordinates [px]
    squared: Array  # (n,) squared whitened residuals (sum of two)
    left: Array  # (2, n) whitened residuals of a second fit, which also has splines over the rows
    noise: float  # ratio of observed to expected standard deviation of the residuals, from their median

    @property
    def meets(self) -> bool:
        """Whether the camera fits the points to the noise."""
        return self.noise < MUCH_NOISE

    @property
    def agree(self) -> BoolArray:
        """Mask (n,) of observations with residuals within `CRITICAL` standard deviations."""
        return np.asarray(self.squared <= 2.0 * CRITICAL**2)

    @property
    def contradicted(self) -> float:
        """Fraction of observations with residuals beyond `CRITICAL` standard deviations, with splines."""
        return float(self._is_outlier.mean())

    @property
    def is_coherent(self) -> bool:
        """Whether outliers have residuals like those of their neighbours: then the camera is wrong.

        Otherwise the matches are wrong. The difference of two independent residuals is 1.4 times their size, that of
        coherent residuals less than their size.
        """
        seen = np.asarray(np.isfinite(self.left).all(axis=0))
        if seen.mean() < 0.5:  # most points are outside the domain of the camera
            return True
        is_outlier = self._is_outlier & seen
        if is_outlier.sum() < FEW:
            return False
        outliers = self.left[:, is_outlier].T
        nearest = np.asarray(kd_tree(self.xy[:, is_outlier].T).query(self.xy[:, is_outlier].T, k=2)[1])[:, 1]
        difference, size = (np.linalg.norm(x, axis=1) for x in (outliers - outliers[nearest], outliers))
        return bool(np.median(difference) < np.median(size))

    @property
    def _is_outlier(self) -> BoolArray:
        return ~np.asarray((self.left**2).sum(axis=0) <= 2.0 * CRITICAL**2)


@dataclass(frozen=True, eq=False)
class RpcDiagnosis:
    """The one change that makes the RPC of a view as accurate as stated; none was found if all fields are defaults."""

    offset: Array | None = None  # (2,) projected minus observed points, col and row [px]
    height: float | None = None  # [m] error of the heights, if it explains the offset
    swapped: bool = False  # whether col and row are exchanged
    as_stated: bool = False  # whether it is as accurate as stated already: tie points may be wrong


def retained_tracks(found: Solution, block: Block) -> BoolArray:
    """Return the mask (P,) of tracks with two or more inliers."""
    kept = np.bincount(block.point[found.outcome.inlier], minlength=block.num_points) >= 2
    kept[block.num_tracks :] = False
    return kept


def resect(found: Solution, others: Block, block: Block, view: int) -> Placed | None:
    """Resect a view by the ground points in the solution of the `others`; None with too few common points.

    The camera prior is too wide to matter. The variances of the residuals are those of noise and ground points.
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
    """Return the ratio of observed to expected standard deviation, from `Placed.squared` (n,)."""
    return float(np.sqrt(np.median(squared) / chdtri(2.0, 0.5)))


class _Sight:
    """Observations of one view of ground points from the other views, with the covariances of their residuals."""

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
        """Project the points with derivatives, through cameras with unknowns (N, q)."""
        return self.cameras.project(params, self.ecef, self.bounds)

    def fit(self, splines: Array | None = None) -> tuple[Array, Array, Array]:
        """Return the unknowns (q,) of the view, their covariance (q, q), and whitened residuals (2, n).

        The robust loss has a scale that shrinks as in `barpc.ba.robust.rounds`. Splines with values (m, n) displace col
        and row, too.
        """
        params = self.problem.camera_prior.mean.copy()
        beside = np.zeros((0, self.xy.shape[1])) if splines is None else splines
        size, m = params.shape[1], len(beside)
        # wide priors: of the camera, and of splines [px]
        sigma = np.append(GROSS * self.problem.camera_prior.sigma[self.view], np.full(2 * m, TIMES))
        solution, residual, scale = np.zeros(size + 2 * m), np.zeros((0, 2)), np.inf
        matrix = np.diag(sigma**-2.0)
        root = np.linalg.inv(np.linalg.cholesky(self.covariance))
        for _ in range(FEW):
            params[self.view] = solution[:size]
            projected = self.project(params)
            derivatives = np.zeros((2, size + 2 * m, self.xy.shape[1]))
            derivatives[:, :size] = projected.by_unknown
            derivatives[0, size : size + m] = derivatives[1, size + m :] = beside
            image = projected.image + solution[size:] @ derivatives[:, size:]
            residual = np.einsum("ncd,dn->nc", root, image - self.xy)
            residual[~np.isfinite(residual).all(axis=1)] = np.inf
            squared = (residual**2).sum(axis=1)
            noise = median_noise(squared)
            if not np.isfinite(noise):
                break
            scale = SURELY * max(noise, 1.0) if np.isinf(scale) else max(SURELY, SHRINK * scale)
            near = np.flatnonzero(np.isfinite(squared))
            weight = geman_mcclure(squared[near] / (2.0 * scale**2))[1]
            rows = root[near] @ derivatives[:, :, near].transpose(2, 0, 1)
            weighted = (rows * weight[:, None, None]).reshape(-1, len(sigma)).T
            matrix = weighted @ rows.reshape(-1, len(sigma)) + np.diag(sigma**-2.0)
            gradient = weighted @ residual[near].ravel() + solution / sigma**2
            solution = solution - np.linalg.solve(matrix, gradient)
        covariance = np.asarray(np.linalg.inv(matrix)[:size, :size], dtype=np.float64)
        return solution[:size], covariance, residual.T


def diagnose_rpc(found: Solution, block: Block, placed: Placed, view: int) -> RpcDiagnosis:
    """Find the one change with which the RPC of a view is as accurate as stated.

    Each change is applied to the delivered camera, at the ground points of the other views. It is accepted if the
    median residual is then below the stated accuracy.
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
    near = abs(height) < GEOID  # the geoid differs from the ellipsoid by less
    explains = near and _median_length(off - height * by_height) < stated
    return RpcDiagnosis(offset=offset, height=height if explains else None)


def _median_length(off: Array) -> float:
    """Return the median length of residuals (2, n) [px]; values that are not finite count as infinite."""
    length = np.linalg.norm(off, axis=0)
    return float(np.median(np.where(np.isfinite(length), length, np.inf)))
