"""Which observations agree before any camera has moved: for blocks in which many of a view's moved together.

Moving clouds, or a repeated pattern, shift a good part of one view's tie points by the same amount. Least squares, also
robust, then starts in the middle. Two views' rays miss each other by an offset across the epipolar line that changes
slowly over the image, whatever the cameras are wrong by: so for every pair of views the largest set of observations
whose offsets lie on one plane is looked for, and an observation that most of its partners contradict is put aside.
"""

from __future__ import annotations

import numpy as np

from barpc.ba.cameras import Projected
from barpc.ba.structure import Structure
from barpc.geodesy import Array
from barpc.scene import BoolArray, IntArray

_TRIALS = 150
_LEAST = 30  # matches of a pair that is looked at
_NEAR = 10.0  # sigmas: what a plane cannot follow of a drift and of relief
_STEPS = 3


def agreeing(
    structure: Structure, xy: Array, residual: Array, projected: Projected, sigma: Array, use: BoolArray
) -> BoolArray:
    """Observations (K,) that are left once those are put aside which most of their partners contradict.

    Parameters
    ----------
    structure : Structure
        Who sees what.
    xy : (2, K)
        Observed col, row [px].
    residual : (2, K)
        Projected - observed [px], points anywhere near.
    projected : Projected
        With derivatives by the points.
    sigma : (K,)
        Standard deviations [px].
    use : (K,)
        Observations to look at.
    """
    first, second = structure.first, structure.second
    offset = _across(residual, projected.by_point, first, second)
    spread = np.hypot(sigma[first], sigma[second])
    against = np.zeros(len(first), dtype=bool)
    usable = use[first] & use[second] & np.isfinite(offset)
    for m, (start, stop) in enumerate(
        zip(structure.pair_bounds[:-1], structure.pair_bounds[1:], strict=True)
    ):
        rows = start + np.flatnonzero(usable[start:stop])
        if len(rows) >= _LEAST:
            place = xy[:, first[rows]]
            against[rows] = ~_on_one_plane(place, offset[rows], spread[rows], seed=m)
    keep = use.copy()
    for _ in range(structure.num_views):
        live = against & keep[first] & keep[second]
        if not live.any():
            break
        count = np.bincount(first[live], minlength=len(use)) + np.bincount(second[live], minlength=len(use))
        worst = np.zeros(structure.num_points)
        np.maximum.at(worst, structure.point, count)
        keep &= ~((count > 0) & (count == worst[structure.point]))
    return keep


def _across(residual: Array, by_point: Array, first: IntArray, second: IntArray) -> Array:
    """Offset across the epipolar line (Q,) [px]: what no move of the point takes away from two observations."""
    rows = np.concatenate([by_point[:, :, first], by_point[:, :, second]])  # (4, 3, Q)
    four = np.concatenate([residual[:, first], residual[:, second]])
    normal = np.empty_like(four)
    for i in range(4):
        a, b, c = (rows[k] for k in range(4) if k != i)
        normal[i] = (-1) ** i * (a * np.cross(b, c, axis=0)).sum(axis=0)
    size = np.linalg.norm(normal, axis=0)
    with np.errstate(all="ignore"):
        offset: Array = np.sqrt(2.0) * (normal * four).sum(axis=0) / size
    return offset


def _on_one_plane(place: Array, offset: Array, spread: Array, seed: int) -> BoolArray:
    """The largest set of offsets (n,) that lie on a plane over the image, by random triples and refits."""
    low, high = place.min(axis=1, keepdims=True), place.max(axis=1, keepdims=True)
    design = np.vstack([np.ones(len(offset)), 2.0 * (place - low) / np.maximum(high - low, 1.0) - 1.0])
    rng = np.random.default_rng(seed)
    triples = rng.integers(0, len(offset), (_TRIALS, 3))
    matrices = design[:, triples].transpose(1, 2, 0)
    good = np.abs(np.linalg.det(matrices)) > 1e-2
    planes = np.linalg.solve(matrices[good], offset[triples[good]][..., None])[..., 0]
    flat = np.column_stack([offset[triples[:, 0]], np.zeros((_TRIALS, 2))])
    planes = np.concatenate([flat, planes])
    near = np.abs(planes @ design - offset) < _NEAR * spread
    best: BoolArray = near[int(near.sum(axis=1).argmax())]
    for _ in range(_STEPS):
        if best.sum() < 3:
            break
        plane = np.linalg.lstsq(design[:, best].T, offset[best], rcond=None)[0]
        best = np.abs(plane @ design - offset) < _NEAR * spread
    return best
