"""The comparison of a selected model with the plain one, on all verified matches.

A model that excludes observations fits the rest, whether it is right or not. Therefore two models are compared on all
matches, including those that one of them excluded or rejected: by the median epipolar offset of each pair of images,
and of each eighth of their rows and columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barpc.ba.constraints.block import Block
from barpc.ba.robust.heldout import measure, problem_of_block
from barpc.ba.robust.weights import geman_mcclure
from barpc.ba.solution import Solution
from barpc.base.geodesy import Array
from barpc.base.statistics import BANDS, MAD, OUTLIER, SURELY
from barpc.scene import IntArray

_MIN_OFFSETS = 12  # offsets of a band: fewer give no reliable median


@dataclass(frozen=True, eq=False)
class OffsetBands:
    """Pairs of images, and eighths of their rows and columns, with the epipolar offsets of their tie points.

    An offset is the distance [px] of an observation from the epipolar line of another one of its track. It does not
    depend on the position of the ground point: the residuals of both observations are multiplied by a left null vector
    of their derivatives by the point.
    """

    ties: Block
    first: IntArray  # (M,) first observation of each pair: both are of one point
    second: IntArray  # (M,)
    group: IntArray  # (5 M,) band of each offset: by columns and by rows of both images, and the whole pair
    count: IntArray  # (B,) number of offsets of each band

    @classmethod
    def of(cls, ties: Block) -> OffsetBands:
        """Return the bands of the tie points of a block."""
        structure = ties.own_points[1]
        first, second = structure.first, structure.second
        pair: IntArray = np.repeat(np.arange(len(structure.pair_view)), np.diff(structure.pair_bounds))
        bands = [_band(ties.xy[axis, rows], pair) for rows in (first, second) for axis in (0, 1)]
        group = np.concatenate([(4 * BANDS + 1) * pair + BANDS * n + one for n, one in enumerate([*bands, 0 * pair])])
        return cls(ties, first, second, group, np.bincount(group))

    def offsets(self, found: Solution) -> Array:
        """Return the offsets (5 M,) [px] of all bands under the cameras of a solution."""
        ties, cameras = self.ties, found.final.params
        problem, points = problem_of_block(found.problem, cameras, ties)
        projected = problem.project_points(cameras, points)
        residual, by_point = projected.image - ties.xy, np.moveaxis(projected.by_point, -1, 0)
        ray = np.cross(by_point[:, 0], by_point[:, 1])
        normal = np.cross(ray[self.first], ray[self.second])
        across = [_line_normals(by_point[rows], normal) for rows in (self.first, self.second)]
        products = [(one * residual[:, rows].T).sum(axis=1) for one, rows in zip(across, self.both, strict=True)]
        with np.errstate(invalid="ignore", divide="ignore"):
            one, other = ((products[0] - products[1]) / np.linalg.norm(part, axis=1) for part in across)
        return np.concatenate([one, one, other, other, other])

    @property
    def both(self) -> tuple[IntArray, IntArray]:
        """The two observations of every pair."""
        return self.first, self.second

    def medians(self, offsets: Array) -> Array:
        """Return the median (B,) of the finite offsets (5 M,) of every band with enough of them; NaN of others."""
        known = np.flatnonzero(np.isfinite(offsets) & (self.count >= _MIN_OFFSETS)[self.group])
        order = known[np.argsort(offsets[known])]
        # one number for band and rank of the offset: sorting it takes 0.4 of the time of two keys
        number = np.sort(self.group[order] * len(order) + np.arange(len(order)))
        count = np.bincount(self.group[order], minlength=len(self.count))
        many, middle = count >= _MIN_OFFSETS, np.full(len(count), np.nan)
        start, count = (np.cumsum(count) - count)[many], count[many]
        low, high = (offsets[order[number[start + half] % len(order)]] for half in ((count - 1) // 2, count // 2))
        middle[many] = 0.5 * (low + high)
        return middle

    def errors(self, offsets: Array, middle: Array) -> Array:
        """Return the standard errors (B,) [px] of the medians `middle` (B,) [px] of offsets (5 M,) [px]."""
        spread = MAD * self.medians(np.abs(offsets - middle[self.group]))
        # of normal errors, a median has sqrt(pi / 2) times the standard error of a mean
        return np.asarray(np.sqrt(np.pi / 2.0) * spread / np.sqrt(np.maximum(self.count, 1)))


def _line_normals(by_point: Array, normal: Array) -> Array:
    """Return the normals (M, 2) of epipolar lines, from derivatives (M, 2, 3) by the point and normals of planes."""
    square = by_point @ np.swapaxes(by_point, 1, 2)
    return np.asarray(np.linalg.solve(square, by_point @ normal[..., None])[..., 0])


def _band(place: Array, pair: IntArray) -> IntArray:
    """Return the index (M,) of the band of each coordinate: equal parts of the extent of its pair of images."""
    low, high = np.full((2, pair.max(initial=0) + 1), np.inf)
    np.minimum.at(low, pair, place)
    np.minimum.at(high, pair, -place)
    part = BANDS * (place - low[pair]) / np.maximum(-high - low, 1e-9)[pair]
    return np.asarray(np.minimum(part.astype(np.int64), BANDS - 1))


def is_closer(tried: Solution, plain: Solution, ties: Block, still: Block | None = None) -> bool:
    """Return whether a model has significantly smaller residuals than the plain one, over all tie points of a block.

    Losses are robust (Geman-McClure), with the smaller noise of the two solutions as scale. They include matches that
    either model rejected or excluded, so a model gains nothing by fitting another subset of the matches as well. A
    model with a moving group is measured on `still`, the tie points with the motion of the group removed.
    """
    noise = min(tried.outcome.noise, plain.outcome.noise)
    sides = (tried, ties if still is None else still), (plain, ties)
    far = [(measure(one.problem, one.final.params, of).residual ** 2).sum(axis=0) for one, of in sides]
    less = np.subtract(*(geman_mcclure(one / (noise * ties.sigma) ** 2)[0] for one in far[::-1]))
    index, point = np.unique(ties.point, return_inverse=True)
    by_track = np.bincount(point, less)
    return bool(by_track.mean() > SURELY * by_track.std() / np.sqrt(len(index)))


@dataclass(frozen=True)
class Comparison:
    """The comparison of a model with the plain one, by epipolar offsets in bands of tie points."""

    worse: bool  # whether the median offset of a band grows significantly, by more than that of any other falls
    changed: float  # largest median change of the offsets of a band [px]


def compared(tried: Solution, plain: Solution, ties: Block) -> Comparison:
    """Compare a model with the plain one on the tie points of a block.

    Medians are limited to `OUTLIER` standard deviations of tie points: both models reject matches beyond.
    """
    bands = None if tried.outcome is plain.outcome else OffsetBands.of(ties)
    if bands is None or not len(bands.first):
        return Comparison(False, 0.0)
    offsets = [bands.offsets(one) for one in (tried, plain)]
    middles = [bands.medians(each) for each in (*offsets, offsets[0] - offsets[1])]
    (one, other, changed), error = np.abs(middles), bands.errors(offsets[1], middles[1])
    most = OUTLIER * plain.outcome.noise * float(np.median(ties.sigma))
    grown = np.minimum(one, most) - np.minimum(other, most)
    surely = (grown > SURELY * error).any() and np.nanmax(grown) > -np.nanmin(grown)
    return Comparison(bool(surely), float(np.nanmax(changed, initial=0.0)))


def largest_offset(found: Solution, ties: Block) -> float:
    """Return the largest absolute median epipolar offset of a band [px]; 0 without one. Wrong matches hardly count."""
    bands = OffsetBands.of(ties)
    middle = bands.medians(bands.offsets(found))[0] if len(bands.first) else np.zeros(0)
    return float(np.nan_to_num(middle).max(initial=0.0))
