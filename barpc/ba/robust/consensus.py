"""Consensus of observations before the adjustment, for blocks in which many observations of a view moved together.

Moving clouds, or a repeated pattern, shift many tie points of one view by the same amount. Least squares, also robust,
then converge to a mean of both groups. Whatever the errors of two cameras, the epipolar offsets of their matches change
slowly over the image. Therefore the largest set of matches whose offsets lie on one plane is found for every pair of
views (RANSAC), and an observation that disagrees in most of its pairs is excluded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.special import expit

from barpc.ba.parameters.projected import Projected
from barpc.ba.solving.structure import Structure
from barpc.base.geodesy import Array, parts
from barpc.base.statistics import CONVERGED, FEW, ITERATIONS, LEVEL, MANY, OUTLIER, STEPS, SURE, TRIALS
from barpc.scene import BoolArray, IntArray
from barpc.sensor.curve import cross


@dataclass(frozen=True)
class TwoGroups:
    """A pair of views whose epipolar offsets have two modes. The pair does not determine the right one."""

    views: tuple[int, int]  # the pair
    share: float  # part of the matches in the smaller group
    apart: float  # distance of the modes, across the epipolar lines [px]


def two_groups(structure: Structure, residual: Array, by_point: Array, use: BoolArray) -> tuple[TwoGroups, ...]:
    """Find the pairs of views whose epipolar offsets are a mixture of two normals, from the observations in use."""
    many = np.repeat(np.diff(structure.pair_bounds) >= MANY, np.diff(structure.pair_bounds))
    rows = np.flatnonzero(many & use[structure.first] & use[structure.second])
    offset = _epipolar_offsets(residual, by_point, structure.first[rows], structure.second[rows])
    bounds = np.searchsorted(rows, structure.pair_bounds)
    count = np.diff(bounds)
    by_pair = sp.csr_array((np.ones(len(rows)), np.arange(len(rows)), bounds), (len(count), len(rows)))
    found = []
    with np.errstate(all="ignore"):
        z = offset - np.repeat(by_pair @ offset / count, count)
        square, cube, fourth = (by_pair @ (z * z * more) / count for more in (1.0, z, z * z))
        # Sarle's bimodality coefficient: 1/3 for a normal distribution, 5/9 for a uniform one; their mean is the limit
        maybe = (cube**2 / square**3 + 1.0) >= 4.0 / 9.0 * fourth / square**2
    for pair in np.flatnonzero(maybe & (count >= MANY)):
        share, apart, gain = two_normals(z[bounds[pair] : bounds[pair + 1]])
        if share > LEVEL and gain > 3.0 * SURE:  # [nats] a likelihood ratio of three million against one group
            first, second = structure.pair_view[pair].tolist()
            found.append(TwoGroups((first, second), share, apart))
    return tuple(found)


def two_normals(z: Array) -> tuple[float, float, float]:
    """Fit two normal distributions of equal width to values z (n,), by expectation maximisation.

    Returned are the share of the smaller one, the distance of the centres, and the gain of log-likelihood over one
    normal [nats]. Share and distance are 0 where the centres are less than two standard deviations apart; all
    three are 0 where one distribution has all values.
    """
    z = z - z.mean()
    whole = float((z**2).mean())
    (low, high), square, part = np.quantile(z, [LEVEL, 1.0 - LEVEL]), whole, 0.5
    for _ in range(ITERATIONS):
        # of equal width: the log ratio of their densities is linear in z
        second = expit((high - low) * (z - 0.5 * (low + high)) / square - np.log(part / (1.0 - part)))
        part = 1.0 - float(second.mean())
        if not 0.0 < part < 1.0:
            return 0.0, 0.0, 0.0
        high = float(second @ z) / len(z) / (1.0 - part)
        low = -high * (1.0 - part) / part
        rest = whole - part * low**2 - (1.0 - part) * high**2
        before, square = square, max(rest, np.finfo(float).eps * whole)  # smaller values are rounding errors
        if abs(square - before) < CONVERGED**2 * whole:
            break
    sigma, apart = np.sqrt(square), float(high - low)
    groups = ((part, low), (1.0 - part, high))
    both = np.logaddexp(*(np.log(share) - 0.5 * (z - center) ** 2 / square for share, center in groups))
    gain = float((both + 0.5).sum() + 0.5 * len(z) * np.log(whole / square))
    if apart < 2.0 * sigma:  # the density has one mode only
        return 0.0, 0.0, gain
    return min(part, 1.0 - part), apart, gain


def agreeing(
    structure: Structure, xy: Array, residual: Array, projected: Projected, sigma: Array, use: BoolArray
) -> BoolArray:
    """Return the mask `use` (K,) without observations that contradict others of their points.

    Two observations of a point disagree if their epipolar offset is not on the plane of their pair of views. Of each
    point the observations with the most disagreements are removed, repeatedly, until no two observations disagree.
    `xy` (2, K) are observed col, row; the residuals (2, K) are at approximate points; `sigma` (K,) is stated. All [px].
    """
    first, second = structure.first, structure.second
    offset = _epipolar_offsets(residual, projected.by_point, first, second)
    spread = np.hypot(sigma[first], sigma[second])
    in_conflict = np.zeros(len(first), dtype=bool)
    usable = use[first] & use[second] & np.isfinite(offset)
    for m, (start, stop) in enumerate(zip(structure.pair_bounds[:-1], structure.pair_bounds[1:], strict=True)):
        rows = start + np.flatnonzero(usable[start:stop])
        if len(rows) >= FEW:
            place = xy[:, first[rows]]
            in_conflict[rows] = ~_on_one_plane(place, offset[rows], spread[rows], seed=m)
    keep = use.copy()
    for _ in range(structure.num_views):
        active = in_conflict & keep[first] & keep[second]
        if not active.any():
            break
        count = np.bincount(first[active], minlength=len(use)) + np.bincount(second[active], minlength=len(use))
        worst = np.zeros(structure.num_points)
        np.maximum.at(worst, structure.point, count)
        keep &= ~((count > 0) & (count == worst[structure.point]))
    return keep


def _epipolar_offsets(residual: Array, by_point: Array, first: IntArray, second: IntArray) -> Array:
    """Return the epipolar offsets (Q,) [px] of pairs of observations. They do not depend on the ground point."""
    offset = np.empty(len(first))
    for part in parts(len(first)):
        one, two = by_point.take(first[part], axis=2), by_point.take(second[part], axis=2)
        rays = cross(one[0], one[1]), cross(two[0], two[1])  # a shift of the point along a ray does not move its image
        of_first, of_second = (one * rays[1]).sum(axis=1), (two * rays[0]).sum(axis=1)
        normal = np.stack([of_first[1], -of_first[0], of_second[1], -of_second[0]])
        four = np.concatenate([residual.take(first[part], axis=1), residual.take(second[part], axis=1)])
        with np.errstate(all="ignore"):
            offset[part] = np.sqrt(2.0) * (normal * four).sum(axis=0) / np.linalg.norm(normal, axis=0)
    return offset


def _on_one_plane(place: Array, offset: Array, spread: Array, seed: int) -> BoolArray:
    """Return the mask (n,) of the largest set of offsets on one plane over the image (RANSAC, then least squares)."""
    low, high = place.min(axis=1, keepdims=True), place.max(axis=1, keepdims=True)
    design = np.vstack([np.ones(len(offset)), 2.0 * (place - low) / np.maximum(high - low, 1.0) - 1.0])
    rng = np.random.default_rng(seed)
    triples = rng.integers(0, len(offset), (TRIALS, 3))
    matrices = design[:, triples].transpose(1, 2, 0)
    good = np.abs(np.linalg.det(matrices)) > 1e-2
    planes = np.linalg.solve(matrices[good], offset[triples[good]][..., None])[..., 0]
    flat = np.column_stack([offset[triples[:, 0]], np.zeros((TRIALS, 2))])
    planes = np.concatenate([flat, planes])
    spread = 2.0 * OUTLIER * spread  # tolerance: drift and relief deviate from a plane
    near = np.abs(planes @ design - offset) < spread
    best: BoolArray = near[int(near.sum(axis=1).argmax())]
    for _ in range(STEPS):
        if best.sum() < 3:
            break
        plane = np.linalg.lstsq(design[:, best].T, offset[best], rcond=None)[0]
        best = np.abs(plane @ design - offset) < spread
    return best
