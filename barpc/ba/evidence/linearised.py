"""Tie points linearised at a state of a block, grouped by track so that ground points can be integrated out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy.sparse as sp

from barpc.ba.solving.normal import TRIANGLE, cholesky3, whiten
from barpc.ba.solving.problem import Problem
from barpc.ba.solving.solve import State
from barpc.base.geodesy import Array
from barpc.base.statistics import OUTLIER, evenly
from barpc.scene import BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of observations i <= j of the same track, grouped by their pair of views."""

    order: IntArray  # (M,) index of each pair in the list of pairs track by track, as of `TrackGroup`
    first: IntArray  # (M,) observations i
    second: IntArray  # (M,) observations j
    bounds: IntArray  # (P + 1,) first pair of each pair of views; the last element is M
    views: IntArray  # (P, 2) these pairs of views


@dataclass(frozen=True, eq=False)
class TrackGroup:
    """T tracks of n observations each. Tracks are sorted by their views."""

    rows: IntArray  # (T, n) indices of the observations
    view: IntArray  # (T, n) their views
    subsets: Array  # (S, n) possible sets of inliers of a track: 1 for an inlier, else 0
    point_bases: Array  # (T, 3 S, 2n) basis of residuals that the ground point absorbs, three rows per subset
    log_volume: Array  # (T, S) log of the ground point's posterior volume over its prior volume
    by_unknown: Array  # (T, n, 2, q) derivatives of the residuals by the unknowns of their view

    def without_view(self, some: IntArray, view: int) -> tuple[Array, Array]:
        """Return weights (T, 2n, 1) and point bases (T, 3, 2n) of the tracks `some`, with a view excluded.

        Its observations have weight 0, all others 1. It is not excluded from tracks of two views.
        """
        n = self.rows.shape[1]
        of_view = self.view[some] == view
        subset = np.where(of_view.any(axis=1) & (n > 2), n - of_view.argmax(axis=1), 0)  # index of `_subsets`
        counts = np.repeat(self.subsets[subset], 2, axis=1)[..., None]
        return counts, self.point_bases[some[:, None], 3 * subset[:, None] + np.arange(3)]

    def projectors(self, weight: Array) -> Array:
        """Return the projectors (T, 2n, 2n) that remove the ground points, summed with weights of subsets (T, S)."""
        of_rows = np.repeat(weight, 3, axis=1)[..., None] * self.point_bases
        out: Array = -(np.swapaxes(self.point_bases, 1, 2) @ of_rows)
        diagonal = np.einsum("tii->ti", out)
        diagonal += np.repeat(weight @ self.subsets, 2, axis=1)
        return out


@dataclass(frozen=True, eq=False)
class Subsets:
    """Subsets (S,) and observations (M,) of all tracks (T,), listed track by track."""

    rows: IntArray  # (M,) indices of the observations
    of_row: IntArray  # (M,) track of each observation
    of_subset: IntArray  # (S,) track of each subset
    members: sp.csr_array  # (S, M) 1 for the observations of a subset
    member_of: sp.csc_array  # (M, S) its transpose
    size: IntArray  # (S,) number of observations of each subset
    views: IntArray  # (T,) number of observations of each track
    begins: tuple[IntArray, IntArray]  # (T,) first observation, and first subset, of each track in the lists
    parts: tuple[tuple[slice, slice], ...]  # slices of observations and of subsets of each `TrackGroup`
    log_volume: Array  # (S,) `TrackGroup.log_volume`

    @classmethod
    def of(cls, tracks: Sequence[TrackGroup]) -> Subsets:
        """Return the subsets of all groups of tracks."""
        count, many, n = np.array([(len(one.rows), *one.subsets.shape) for one in tracks]).T
        views, subsets = np.repeat(n, count), np.repeat(many, count)
        every = np.arange(len(views))
        members = sp.csr_array(sp.block_diag([sp.kron(sp.eye_array(len(one.rows)), one.subsets) for one in tracks]))
        members.eliminate_zeros()
        ends = (np.append(0, np.cumsum(count * length)).tolist() for length in (n, many))
        return cls(
            np.concatenate([one.rows.ravel() for one in tracks]),
            np.repeat(every, views),
            np.repeat(every, subsets),
            members,
            members.T,
            np.diff(members.indptr),
            views,
            (np.cumsum(views) - views, np.cumsum(subsets) - subsets),
            tuple(zip(*([slice(*one) for one in pairwise(bounds)] for bounds in ends), strict=True)),
            np.concatenate([one.log_volume.ravel() for one in tracks]),
        )


@dataclass(frozen=True, eq=False)
class Linear:
    """Tie points linearised at a state, in units of their stated standard deviations, and the cameras' priors."""

    view: IntArray  # (K,) view of each observation, ascending
    residual: Array  # (2, K) projected - observed
    by_unknown: Array  # (2, q, K) derivatives of the residuals by the unknowns of their view
    sigma: Array  # (K,) stated standard deviations [px]
    tracks: tuple[TrackGroup, ...]
    shape: tuple[int, int]  # N views, q unknowns
    precision: Array  # (N q,) inverse variances of the priors
    offset: Array  # (N q,) unknowns at the state minus the means of the priors
    area: float  # of the region in which wrong matches are uniformly distributed [sigma^2]
    image_area: float  # [sigma^2]
    choices: int  # number of views of the whole block; N may be smaller

    @property
    def views(self) -> int:
        """Number of views N."""
        return self.shape[0]

    def of_views(self, views: IntArray) -> Linear:
        """Return the part of some views (n,) that contain all tracks. Its views and observations are numbered anew."""
        number, index = np.full(self.views, -1), np.full(len(self.view), -1)
        number[views] = np.arange(len(views))
        rows = np.flatnonzero(number[self.view] >= 0)
        index[rows] = np.arange(len(rows))
        tracks = tuple(replace(one, rows=index[one.rows], view=number[one.view]) for one in self.tracks)
        return replace(
            self,
            view=number[self.view[rows]],
            residual=self.residual[:, rows],
            by_unknown=self.by_unknown[..., rows],
            sigma=self.sigma[rows],
            tracks=tracks,
            shape=(len(views), self.shape[1]),
            precision=self.precision.reshape(self.shape)[views].ravel(),
            offset=self.offset.reshape(self.shape)[views].ravel(),
        )

    @cached_property
    def subsets(self) -> Subsets:
        """The subsets of all tracks."""
        return Subsets.of(self.tracks)

    @cached_property
    def pairs(self) -> Pairs:
        """All pairs of observations of the same track, each observation with itself included."""
        rows = np.concatenate(
            [
                tracks.rows[:, np.triu_indices(tracks.rows.shape[1])].transpose(1, 0, 2).reshape(2, -1)
                for tracks in self.tracks
            ],
            axis=1,
        )
        views = self.view[rows]
        order = np.lexsort(views[::-1])
        sorted_views = views[:, order]
        begin = np.flatnonzero((np.diff(sorted_views, axis=1, prepend=-1) != 0).any(axis=0))
        bounds = np.append(begin, len(order))
        return Pairs(order, rows[0, order], rows[1, order], bounds, sorted_views[:, begin].T)

    @cached_property
    def by_row(self) -> Array:
        """`by_unknown` with the observations along the first axis, (K, 2, q)."""
        return np.ascontiguousarray(self.by_unknown.transpose(2, 0, 1))

    @cached_property
    def bounds(self) -> list[int]:
        """Index of the first observation of each view (N + 1,); the last element is K."""
        found: list[int] = np.searchsorted(self.view, np.arange(self.views + 1)).tolist()
        return found

    @property
    def in_tracks(self) -> BoolArray:
        """Mask (K,) of the observations that are in one of the tracks."""
        rows = np.zeros(len(self.view), dtype=bool)
        rows[self.subsets.rows] = True
        return rows

    def residual_after(self, step: Array) -> Array:
        """Return the residuals (2, K) after a step (N, q) of the camera unknowns."""
        left, by_row = self.residual.copy(), self.by_row.reshape(-1, self.shape[1])
        for v, (a, b) in enumerate(pairwise(self.bounds)):
            left[:, a:b] += (by_row[2 * a : 2 * b] @ step[v]).reshape(-1, 2).T
        return left

    def thinned(self, most: int | None = None) -> Linear:
        """Return every k-th track; k is the least for which about `most` observations remain (see `evenly`)."""
        every = evenly(sum(tracks.rows.size for tracks in self.tracks), most).step
        if every <= 1:
            return self
        groups = []
        for tracks in self.tracks:
            view = tracks.view[::every]
            parts = (tracks.point_bases[::every], tracks.log_volume[::every], tracks.by_unknown[::every])
            groups.append(TrackGroup(tracks.rows[::every], view, tracks.subsets, *parts))
        return replace(self, tracks=tuple(groups))


def linearise(problem: Problem, state: State, use: BoolArray, sigma: Array, span: float) -> Linear:
    """Linearise the tie points `use` (K,) at a state; `sigma` (K,) [px] is stated, `span` [m] the range of heights."""
    structure = problem.structure
    projected = problem.linearise(state.params, state.points)
    residual = (projected.image - problem.xy) / sigma
    by_point, by_unknown = projected.by_point / sigma, projected.by_unknown / sigma
    finite = np.isfinite(residual).all(axis=0) & np.isfinite(by_point).all(axis=(0, 1))
    order = structure.by_point[(use & finite)[structure.by_point]]
    point = structure.point[order]
    start = np.flatnonzero(np.diff(point, prepend=-1))
    count = np.diff(np.append(start, len(point)))
    half, information = problem.cameras.unknowns.half, problem.point_terms(state.points)[0]
    image = float(np.median(4.0 * half[0] * half[1]) / np.median(sigma) ** 2)
    pixels = float(np.median(np.linalg.norm(by_point[:, :, order], axis=1)))  # per metre
    volume = image / pixels**2 * max(span, 1.0)
    tracks, baselines = [], [np.zeros(0)]
    for n in np.unique(count[count >= 2]).tolist():
        rows = order[start[count == n][:, None] + np.arange(n)]
        rows = rows[np.lexsort(structure.view[rows].T)]
        view = structure.view[rows]
        ground = by_point[:, :, rows].transpose(2, 3, 0, 1).reshape(len(rows), 2 * n, 3)
        subsets = _subsets(n)
        basis, log_det = _ground_bases(ground, subsets, information[:, structure.point[rows[:, 0]]])
        by_camera = np.ascontiguousarray(by_unknown[:, :, rows].transpose(2, 3, 0, 1))
        tracks.append(TrackGroup(rows, view, subsets.astype(np.float64), basis, log_det - np.log(volume), by_camera))
        ends = ground.reshape(len(rows), n, 2, 3)[:, [0, -1]].reshape(len(rows), 4, 3)
        baselines.append(np.sqrt(np.maximum(np.linalg.det(np.swapaxes(ends, 1, 2) @ ends), 0.0)))
    largest = (
        max(float(np.quantile(np.linalg.norm(residual[:, order], axis=0), 0.99)), OUTLIER) if len(order) else OUTLIER
    )
    parallax = float(np.median(np.concatenate(baselines))) * volume / image if len(order) else 0.0
    prior = problem.camera_prior
    return Linear(
        structure.view,
        residual,
        by_unknown,
        sigma,
        tuple(tracks),
        (structure.num_views, by_unknown.shape[1]),
        prior.loosest().ravel() ** -2.0,
        (state.params - prior.mean).ravel(),
        2.0 * largest * max(2.0 * largest, parallax),
        image,
        structure.num_views,
    )


def array_elements(count: IntArray) -> float:
    """Return the memory [array elements] of the `TrackGroup.point_bases` of tracks with `count` (T,) observations."""
    return float((6.0 * (count + 1.0) * count).sum())


def _subsets(n: int) -> BoolArray:
    """Return the possible sets of inliers (S, n) of a track: all n and, if n > 2, all but one."""
    return np.vstack([np.ones((1, n), dtype=bool), ~np.eye(n, dtype=bool)[::-1]])[: n + 1 if n > 2 else 1]


def _ground_bases(ground: Array, subsets: BoolArray, information: Array) -> tuple[Array, Array]:
    """Return `TrackGroup.point_bases` and -log det L (T, S), from derivatives `ground` (T, 2n, 3) by the points.

    With J for those of a subset, the bases are L^-1 J' and L L' = J' J + prior `information` (6, T).
    """
    count, size = ground.shape[:2]
    point_bases, log_volume = np.empty((count, len(subsets), 3, size)), np.empty((count, len(subsets)))
    for k, subset in enumerate(subsets):
        part = ground * np.repeat(subset, 2).astype(np.float64)[:, None]
        matrix = np.swapaxes(part, 1, 2) @ part
        lower = cholesky3(np.stack([matrix[:, i, j] for i, j in TRIANGLE]) + information)
        point_bases[:, k] = whiten(part.transpose(1, 2, 0), lower).transpose(2, 1, 0)
        log_volume[:, k] = -np.log(lower[[0, 3, 5]]).sum(axis=0)
    return point_bases.reshape(count, -1, size), log_volume
