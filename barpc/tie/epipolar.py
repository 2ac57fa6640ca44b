"""Where the cameras say that a point of one image lies in another: along a segment, up to a small error."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barpc.geodesy import Array
from barpc.scene import BoolArray, IntArray
from barpc.sensor import SensorModel

_FEW = 30  # points below which an affine error is not told from a constant one
_TUKEY = 4.685
_WINDOW = 2048.0  # px, side of the windows of the verification
_WINDOW_POINTS = 60  # that a window needs for a fit of its own


@dataclass(frozen=True, eq=False)
class Frame:
    """Points of image A in image B, in axes along and across the epipolar direction.

    Parameters
    ----------
    axis : (2,)
        Unit vector in B along which a point moves when its altitude grows.
    along : (N,)
        Coordinate of the point along the axis at the middle altitude [px].
    across : (N,)
        Coordinate across it at the middle altitude [px].
    slope : (N,)
        d(across)/d(along).
    reach : (N,)
        Half the way between the lowest and the highest altitude [px].
    linear : (2, 2)
        d(image B)/d(image A) at constant altitude, in the middle of the points.
    """

    axis: Array
    along: Array
    across: Array
    slope: Array
    reach: Array
    linear: Array

    def turn(self, xy: Array) -> Array:
        """Coordinates along and across (..., 2) of points (..., 2) of image B [px]."""
        turned: Array = xy @ np.array([[self.axis[0], -self.axis[1]], [self.axis[1], self.axis[0]]])
        return turned

    def select(self, rows: IntArray) -> Frame:
        """The frame of some points."""
        return replace(
            self,
            along=self.along[rows],
            across=self.across[rows],
            slope=self.slope[rows],
            reach=self.reach[rows],
        )

    def moved(self, along: Array | float, across: Array | float) -> Frame:
        """The frame with its points moved [px]."""
        return replace(self, along=self.along + along, across=self.across + across)

    def errors(self, index: IntArray, xy: Array) -> Array:
        """Distance along and across (M, 2) of points of B (M, 2) from the points `index` of A."""
        u, w = self.turn(xy).T
        along = u - self.along[index]
        return np.stack([along, w - self.across[index] - self.slope[index] * along], axis=-1)


def frame(sensor_a: SensorModel, sensor_b: SensorModel, xy: Array, alt_range: tuple[float, float]) -> Frame:
    """Predict points of image A in image B.

    Parameters
    ----------
    sensor_a, sensor_b : SensorModel
        The cameras.
    xy : (N, 2)
        col, row in A [px].
    alt_range : tuple of float
        Lowest and highest altitude [m].

    Returns
    -------
    frame : Frame
        NaN where a camera fails.
    """
    low, high = (sensor_b.project(sensor_a.localize(xy, np.full(len(xy), alt))) for alt in alt_range)
    step = high - low
    usable = np.isfinite(step).all(axis=1)
    mean = step[usable].mean(axis=0) if usable.any() else np.zeros(2)
    length = float(np.hypot(*mean))
    axis = mean / length if length > 1e-3 else np.array([1.0, 0.0])
    result = Frame(
        axis,
        *(np.empty(0),) * 4,
        linear_map(
            sensor_a,
            sensor_b,
            np.median(xy[usable], axis=0) if usable.any() else np.zeros(2),
            0.5 * sum(alt_range),
        ),
    )
    (u0, w0), (u1, w1) = result.turn(low).T, result.turn(high).T
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(np.abs(u1 - u0) > 1e-3, (w1 - w0) / (u1 - u0), 0.0)
    slope[~usable] = np.nan
    return replace(
        result, along=0.5 * (u0 + u1), across=0.5 * (w0 + w1), slope=slope, reach=0.5 * np.abs(u1 - u0)
    )


def linear_map(sensor_a: SensorModel, sensor_b: SensorModel, xy: Array, alt: Array | float) -> Array:
    """Derivative of the coordinates in B by those in A at constant altitude.

    Parameters
    ----------
    sensor_a, sensor_b : SensorModel
        The cameras.
    xy : (..., 2)
        col, row in A [px].
    alt : (...)
        Altitude [m].

    Returns
    -------
    linear : (..., 2, 2)
        [px/px]; the identity where a camera fails.
    """
    ground = sensor_a.localize(xy, np.broadcast_to(np.asarray(alt, dtype=np.float64), xy.shape[:-1]))
    by_a = sensor_a.project_jacobian(ground)[1][..., :2]
    by_b = sensor_b.project_jacobian(ground)[1][..., :2]
    usable = np.isfinite(by_a).all(axis=(-2, -1)) & np.isfinite(by_b).all(axis=(-2, -1))
    usable = np.asarray(usable)[..., None, None]
    by_a, by_b = np.where(usable, by_a, np.eye(2)), np.where(usable, by_b, np.eye(2))
    out: Array = by_b @ np.linalg.inv(by_a)
    return out


@dataclass(frozen=True, eq=False)
class Affine:
    """A scalar that varies affinely over an image: value = coefficients . (1, x, y), x and y normalised.

    Parameters
    ----------
    coefficients : (3,)
        [px].
    middle, scale : (2,)
        x = (col - middle) / scale.
    spread : float
        Robust standard deviation of the values about it [px].
    """

    coefficients: Array
    middle: Array
    scale: Array
    spread: float

    def __call__(self, xy: Array) -> Array:
        """Values (N,) at points (N, 2)."""
        value: Array = _design(xy, self.middle, self.scale) @ self.coefficients
        return value


def _design(xy: Array, middle: Array, scale: Array) -> Array:
    return np.column_stack([np.ones(len(xy)), (xy - middle) / scale])


def robust_affine(xy: Array, values: Array, steps: int = 12) -> Affine:
    """Fit `values` by an affine function of position, in spite of outliers.

    Tukey's biweight on a scale that follows the residuals' MAD; a constant for few points.

    Parameters
    ----------
    xy : (N, 2)
        Positions [px].
    values : (N,)
        What is fitted [px].
    steps : int
        Reweighting steps.
    """
    middle, scale = np.median(xy, axis=0), np.maximum(np.ptp(xy, axis=0), 1.0)
    design = _design(xy, middle, scale)
    columns = 3 if len(xy) >= _FEW else 1
    coefficients = np.array([np.median(values), 0.0, 0.0])
    for _ in range(steps):
        residual = values - design @ coefficients
        spread = max(mad(residual), 1e-3)
        weight = np.maximum(0.0, 1.0 - (residual / (_TUKEY * spread)) ** 2)  # the biweight's root
        solution = np.linalg.lstsq(design[:, :columns] * weight[:, None], values * weight, rcond=1e-9)[0]
        change = np.abs(solution - coefficients[:columns]).max()
        coefficients[:columns] = solution
        if change < 1e-4 * spread:
            break
    return Affine(coefficients, middle, scale, mad(values - design @ coefficients))


def mad(values: Array) -> float:
    """Robust standard deviation: 1.4826 times the median of the absolute values (about zero)."""
    return 1.4826 * float(np.median(np.abs(values))) if len(values) else 0.0


def agreeing(xy: Array, values: Array, floor: float = 0.3) -> tuple[BoolArray, Array]:
    """Which values agree with an affine function of position, window by window.

    Parameters
    ----------
    xy : (N, 2)
        Positions [px].
    values : (N,)
        Errors across the epipolar lines [px].
    floor : float
        What is always tolerated [px].

    Returns
    -------
    keep : (N,)
        Within three robust standard deviations of the window's function.
    residual : (N,)
        Distance from that function [px].
    """
    keep = np.zeros(len(values), dtype=bool)
    if not len(values):
        return keep, values
    residual = values - robust_affine(xy, values)(xy)
    for rows in _windows(xy):
        if len(rows) >= _WINDOW_POINTS:
            residual[rows] = values[rows] - robust_affine(xy[rows], values[rows])(xy[rows])
        keep[rows] = np.abs(residual[rows]) <= max(3.0 * mad(residual[rows]), floor)
    return keep, residual


def _windows(xy: Array) -> list[IntArray]:
    cell = np.floor(xy / _WINDOW)
    order = np.lexsort((cell[:, 0], cell[:, 1]))
    cuts = np.flatnonzero((np.diff(cell[order], axis=0) != 0).any(axis=1)) + 1
    return np.split(order, cuts)
