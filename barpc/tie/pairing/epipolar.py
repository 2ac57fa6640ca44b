"""Epipolar segments: the predicted places of a point of one image in another, up to a small error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from barpc.base.geodesy import NEWTON_STEPS, Array
from barpc.base.statistics import BIWEIGHT, FEW, SURELY, kd_tree, robust_spread
from barpc.scene import BoolArray, IntArray, View

LEAST_REACH = 5.0
"""Half a segment [px] below which places along it say nothing of altitudes."""
SIGMA = 0.1
"""Standard deviation of a place registered by structure [px]; as much across an epipolar line is always tolerated."""
LEAST_SIGMA = 0.02
"""Standard deviation of a place [px] at least: of a rendered one that is matched best."""
_MIN_AGREEING_SHARE = 1 / 3
"""Part of the neighbours that agree: beside a straight edge half of them are of one side, less two standard deviations
of `FEW` draws."""


@dataclass(frozen=True, eq=False)
class EpipolarSegments:
    """Epipolar segments in image B of points of image A: axes along and across, between two altitudes."""

    axis: Array  # (2,) unit vector in B along which a point moves when its altitude grows
    along: Array  # (N,) coordinates of the points at the middle altitude [px]
    across: Array
    slope: Array  # (N,) d(across)/d(along)
    before: Array  # (N,) where to look along the axis [px]: from the lowest altitude (negative: backwards)
    after: Array  # to the highest
    derivative: Callable[[], Array]  # gives `linear`: few ask

    @property
    def linear(self) -> Array:
        """d(image B)/d(image A) (2, 2) at constant altitude, in the middle of the points."""
        return self.derivative()

    def turn(self, xy: Array) -> Array:
        """Return the coordinates along and across (..., 2) of points (..., 2) of image B [px]."""
        return xy @ _rotation(self.axis)

    def moved(self, across: Array | float) -> EpipolarSegments:
        """Return the frame with its points moved across the epipolar lines [px]."""
        return replace(self, across=self.across + across)

    def place(self, along: Array) -> Array:
        """Return the points of B (N, 2) [px] on the epipolar lines, `along` (N,) [px] from the middle altitude's."""
        turned = np.stack([self.along + along, self.across + self.slope * along], axis=-1)
        return turned @ _rotation(self.axis).T

    def errors(self, xy: Array) -> Array:
        """Return the distances along and across (N, 2) of points of B (N, 2) from their predictions."""
        u, w = self.turn(xy).T
        along = u - self.along
        return np.stack([along, w - self.across - self.slope * along], axis=-1)


def _rotation(axis: Array) -> Array:
    return np.array([[axis[0], -axis[1]], [axis[1], axis[0]]])


def common_range(*views: View) -> tuple[float, float]:
    """Return the altitudes [m] that several views have in common."""
    low, high = max(view.alt_range[0] for view in views), min(view.alt_range[1] for view in views)
    return min(low, high), max(low, high)


def epipolar_segments(first: View, second: View, xy: Array, axis: Array | None = None) -> EpipolarSegments:
    """Predict points of one view (N, 2) [px] in another, at the altitudes that both are used for.

    The axis is by default the mean direction of the points' epipolar segments. NaN where a camera fails.
    """
    levels = common_range(first, second)
    low, high = (second.sensor.project(first.sensor.localize(xy, np.full(len(xy), alt))) for alt in levels)
    step = high - low
    usable = np.isfinite(step).all(axis=1)
    if axis is None:
        mean = step[usable].mean(axis=0) if usable.any() else np.zeros(2)
        length = float(np.hypot(*mean))
        axis = mean / length if length > 1e-3 else np.array([1.0, 0.0])
    middle = np.median(xy[usable], axis=0) if usable.any() else np.zeros(2)
    (u0, w0), (u1, w1) = (low @ _rotation(axis)).T, (high @ _rotation(axis)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(np.abs(u1 - u0) > 1e-3, ((w1 - w0) / (u1 - u0)).clip(-1.0, 1.0), 0.0)
    slope[~usable] = np.nan
    along, across, reach = 0.5 * (u0 + u1), 0.5 * (w0 + w1), 0.5 * np.abs(u1 - u0)
    return EpipolarSegments(
        axis, along, across, slope, -reach, reach, cache(partial(linear_map, first, second, middle))
    )


def linear_map(first: View, second: View, xy: Array) -> Array:
    """Return d(B)/d(A) (..., 2, 2) at places of A (..., 2) [px], at mid altitude; identity where a camera fails."""
    alt = 0.5 * sum(common_range(first, second))
    ground = first.sensor.localize(xy, np.full(xy.shape[:-1], alt))
    by_a, by_b = (view.sensor.project_jacobian(ground)[1][..., :2] for view in (first, second))
    usable = np.isfinite(by_a + by_b).all(axis=(-2, -1), keepdims=True)
    return np.where(usable, by_b, np.eye(2)) @ np.linalg.inv(np.where(usable, by_a, np.eye(2)))


@dataclass(frozen=True, eq=False)
class Affine:
    """A scalar [px] affine over an image: coefficients (3,) . (1, x, y), (x, y) = (xy - middle) / scale."""

    coefficients: Array
    middle: Array
    scale: Array
    spread: float  # robust standard deviation of the values about it [px]

    def __call__(self, xy: Array) -> Array:
        """Values (N,) at points (N, 2)."""
        return _design(xy, self.middle, self.scale) @ self.coefficients


def _design(xy: Array, middle: Array, scale: Array) -> Array:
    return np.column_stack([np.ones(len(xy)), (xy - middle) / scale])


def robust_affine(xy: Array, values: Array) -> Affine:
    """Fit values (N,) at positions (N, 2) [px] by an affine function, a constant for few points, despite outliers.

    Tukey's biweight on a scale that follows the residuals' MAD.
    """
    middle, scale = np.median(xy, axis=0), np.maximum(np.ptp(xy, axis=0), 1.0)
    design = _design(xy, middle, scale)
    columns = 3 if len(xy) >= FEW else 1
    coefficients = np.array([np.median(values), 0.0, 0.0])
    for _ in range(NEWTON_STEPS):
        residual = values - design @ coefficients
        spread = max(robust_spread(residual), 1e-3)
        weight = np.maximum(0.0, 1.0 - (residual / (BIWEIGHT * spread)) ** 2)  # the biweight's root
        solution = np.linalg.lstsq(design[:, :columns] * weight[:, None], values * weight, rcond=1e-9)[0]
        change = np.abs(solution - coefficients[:columns]).max()
        coefficients[:columns] = solution
        if change < 1e-4 * spread:
            break
    return Affine(coefficients, middle, scale, robust_spread(values - design @ coefficients))


def gradient(xy: Array, values: Array) -> Array:
    """Return the gradient (2,) [per px] of values (N,) at positions (N, 2) [px] that most places share, between jumps.

    Each place tells the difference to one of its `FEW` nearest: few of these differences are those of a jump.
    """
    if len(values) <= FEW:
        return np.zeros(2)
    far = np.asarray(kd_tree(xy).query(xy, k=[FEW])[1])[:, 0]
    fitted = robust_affine(xy[far] - xy, values[far] - values)
    return fitted.coefficients[1:] / fitted.scale


def coherent(xy: Array, values: Array) -> tuple[BoolArray, Array]:
    """Return the mask of values (N,) [px] at positions (N, 2) [px] that neighbours share, and values less medians.

    An image may jump at a row or a column, so that no function of position holds all of it: a value that agrees with
    enough of the `FEW` nearest is none that came by chance. It does within `SURELY` robust standard deviations, or
    `SIGMA`.
    """
    if len(values) < 2:
        return np.ones(len(values), dtype=bool), np.zeros(len(values))
    level = values - xy @ gradient(xy, values)
    near = kd_tree(xy).query(xy, k=min(FEW + 1, len(xy)))[1]
    others = level[near]
    residual = level - np.median(others, axis=1)
    agree = np.abs(others - level[:, None]) <= max(SURELY * robust_spread(residual), SIGMA)
    return agree.sum(axis=1) - 1 >= _MIN_AGREEING_SHARE * (near.shape[1] - 1), residual


def grouped(*keys: npt.NDArray[Any]) -> list[IntArray]:
    """Return the indices of rows with equal keys, in ascending order of the keys."""
    table = np.stack(keys)
    order = np.lexsort(table[::-1])
    cuts = np.flatnonzero((np.diff(table[:, order], axis=1) != 0).any(axis=0)) + 1
    return np.split(order, cuts) if len(order) else []
