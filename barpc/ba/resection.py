"""Resection of one view by the points that the other views agree on, and a diagnosis of its RPC."""

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
    """A view whose camera was estimated alone against known points."""

    params: Array  # (q,)
    covariance: Array  # (q, q) with the points as they are
    rows: BoolArray  # (K,) of the block: its observations of points that the others know
    xy: Array  # (2, n) where these are [px]
    squared: Array  # (n,) squared residuals of these over their variances
    left: Array  # (2, n) residuals where splines over the rows follow what the camera does not, over their sigmas
    noise: float  # observed over stated standard deviation of the residuals, by the median

    @property
    def meets(self) -> bool:
        """Whether it meets the points to the noise."""
        return self.noise < MUCH_NOISE

    def agree(self, limit: float) -> BoolArray:
        """Return the observations (n,) within a number of standard deviations."""
        return np.asarray(self.squared <= 2.0 * limit * limit)

    def contradicted(self, limit: float) -> float:
        """Return the share of observations beyond a number of standard deviations and a smooth displacement of rows."""
        return float(self._far(limit).mean())

    def is_coherent(self, limit: float) -> bool:
        """Return whether observations beyond that are displaced like their neighbours: the camera is wrong,
        not the matches.

        Errors that know nothing of each other differ by 1.4 times what they are.
        """
        seen = np.asarray(np.isfinite(self.left).all(axis=0))
        if seen.mean() < 0.5:  # it does not see the place at all
            return True
        far = self._far(limit) & seen
        if far.sum() < FEW:
            return False
        left = self.left[:, far].T
        nearest = np.asarray(kd_tree(self.xy[:, far].T).query(self.xy[:, far].T, k=2)[1])[:, 1]
        apart, size = (np.linalg.norm(x, axis=1) for x in (left - left[nearest], left))
        return bool(np.median(apart) < np.median(size))

    def _far(self, limit: float) -> BoolArray:
        return ~np.asarray((self.left**2).sum(axis=0) <= 2.0 * limit * limit)


@dataclass(frozen=True, eq=False)
class RpcDiagnosis:
    """A diagnosis of a view's RPC: as accurate as stated, by an offset, other heights or swapped axes, or not at all.

    Where it is, and more than half of its tie points contradict the others', these may be wrong as well as it.
    """

    offset: Array | None = None  # (2,) col, row [px] by which it puts points too far
    height: float | None = None  # [m] by which its heights are too high, where that explains as much
    swapped: bool = False
    as_stated: bool = False


def retained_tracks(found: Solution, block: Block) -> BoolArray:
    """Return the tracks (P,) with two or more observations kept."""
    kept = np.bincount(block.point[found.outcome.inlier], minlength=block.num_points) >= 2
    kept[block.num_tracks :] = False
    return kept


def resect(found: Solution, others: Block, block: Block, view: int) -> Placed | None:
    """Estimate the camera of a view alone against the points of a solution of the `others`; None with too few
    of them.

    Its camera is as good as free. Residuals are judged by the others' noise and what their points are known to.
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
    """Return the observed over expected standard deviation, by the median of squares (n,) of two coordinates each."""
    return float(np.sqrt(np.median(squared) / chdtri(2.0, 0.5)))


class _Sight:
    """One view's observations of points that others know."""

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
        """Return the view's unknowns (q,), their covariance, and residuals (2, n) over their standard
        deviations.

        Robust, as rounds are (`barpc.ba.robust.rounds`): beside them splines (m, n) move columns and rows.
        """
        params = self.problem.camera_prior.mean.copy()
        beside = np.zeros((0, self.xy.shape[1])) if splines is None else splines
        size, m = params.shape[1], len(beside)
        # a row may be anywhere near, in px
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
    """Find the one change with which a view's RPC is as good as stated.

    Each is asked of the delivered camera at the points of the others: half of these are then met to what the camera is
    stated to be known to.
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
    if not placed.meets and _half(off) < SURELY * stated:
        return RpcDiagnosis(as_stated=True)
    swapped = projected.image[::-1] - xy
    if _half(swapped) < SURELY * stated < _half(off):
        return RpcDiagnosis(swapped=True)
    offset = np.nanmedian(off, axis=1)
    if not (_half(off - offset[:, None]) < stated):
        return RpcDiagnosis()
    height = float(np.nanmedian((by_height * off).sum(axis=0) / (by_height**2).sum(axis=0)))
    explains = _half(off - height * by_height) < stated and abs(height) < GEOID  # no mistaken height surface is farther
    return RpcDiagnosis(offset=offset, height=height if explains else None)


def _half(off: Array) -> float:
    """Return the median length of the offsets (2, n) [px]; infinity for an offset that is none."""
    length = np.linalg.norm(off, axis=0)
    return float(np.median(np.where(np.isfinite(length), length, np.inf)))
