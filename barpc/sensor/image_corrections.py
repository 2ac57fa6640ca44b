"""Corrections in the image beyond rotations and RPCs; a model with such a correction is again a sensor model.

An affine map, as others correct RPCs. A spline over the rows, steps, strips and sinusoids: attitude jitter displaces
image rows, a focal plane of several detectors columns, a jump of the attitude or of the clock a strip of rows, an
unbalanced wheel all rows periodically. All are functions of where a point is *seen*, so that
x = P(X) + s(x): localisation is explicit, projection iterates. The correction grid of an RPC, by
the RPC's image point: true image position = RPC's + (dcol, drow).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

from barpc.base.errors import RpcError
from barpc.base.frozen import Frozen
from barpc.base.geodesy import Array, IntArray, as_image
from barpc.sensor import Behind, SensorModel, fixed_point
from barpc.sensor.direct_grid import LINEAR, MAX_NODE_SPACING, linear_axes

if TYPE_CHECKING:
    from scipy.interpolate import RegularGridInterpolator


class Displacement(Protocol):
    """A correction of image points: from their positions by an uncorrected model to corrected ones, and back."""

    def apply(self, image: Array) -> Array:
        """Return the corrected positions of uncorrected image points (..., 2) [px]."""
        ...

    def linearised(self, image: Array) -> tuple[Array, Array]:
        """Return the corrected positions, and their derivative (..., 2, 2) by the uncorrected ones."""
        ...

    def undo(self, image: Array) -> Array:
        """Return the uncorrected positions of corrected image points (..., 2) [px]."""
        ...


@dataclass(frozen=True)
class Displaced(Behind):
    """`sensor` with its image points corrected by `correction`; itself a `SensorModel`."""

    sensor: SensorModel
    correction: Displacement

    def project(self, ground: Array) -> Array:
        """Project ground points (..., 3) [deg, deg, m] to image points (..., 2) [px]."""
        return self.correction.apply(self.sensor.project(ground))

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Return image points (..., 2) [px] and their derivatives (..., 2, 3) [px/deg, px/deg, px/m]."""
        image, jacobian = self.sensor.project_jacobian(ground)
        image, slope = self.correction.linearised(image)
        return image, slope @ jacobian

    def localize(self, image: Array, alt: Array) -> Array:
        """Localise image points (..., 2) [px] at altitudes (...) [m]: ground points (..., 3)."""
        return self.sensor.localize(self.correction.undo(as_image(image)), alt)


@dataclass(frozen=True, eq=False, repr=False)
class ImageAffine(Frozen):
    """An affine correction in the image: image + shift + slope @ image."""

    shift: Array  # (2,): col, row [px]
    slope: Array  # (2, 2): change of (col, row) by (col, row) [px/px]

    def __post_init__(self) -> None:
        self._array("shift", (2,), RpcError)
        self._array("slope", (2, 2), RpcError)

    def apply(self, image: Array) -> Array:
        """Return the corrected image points (..., 2) [px]."""
        return image @ (np.eye(2) + self.slope).T + self.shift

    def linearised(self, image: Array) -> tuple[Array, Array]:
        """Return the same, and the derivative (2, 2)."""
        return self.apply(image), np.eye(2) + self.slope

    def undo(self, image: Array) -> Array:
        """Return the image points (..., 2) [px] without the correction."""
        return (image - self.shift) @ np.linalg.inv(np.eye(2) + self.slope).T


@dataclass(frozen=True)
class ImageCorrected(Displaced):
    """`sensor` with its image points corrected by an affine map; itself a `SensorModel`.

    The bias corrections (shift, drift, affine) of Fraser and Hanley ("Bias compensation in rational functions for
    Ikonos satellite imagery", 2003) and Grodecki and Dial ("Block adjustment of high-resolution satellite images
    described by rational polynomials", 2003), for comparison with the correction in space.
    """

    correction: ImageAffine  # added to its image points


def bspline_pieces(u: Array, count: int, rate: bool = False) -> tuple[IntArray, Array]:
    """Return the first (n,) of the four uniform cubic B-splines that are not 0 at u (n,) in -1 .. 1, and these (4, n).

    The first and the last value hold beyond; `rate`: their derivatives by u instead. By the recursion of de Boor.
    """
    at = (np.clip(np.nan_to_num(u), -1.0, 1.0) + 1.0) * (0.5 * (count - 3))
    first = np.minimum(at.astype(np.int64), count - 4)
    t = at - first
    pieces = [np.ones(len(t))]
    for degree in range(1, 3 if rate else 4):
        low = [(k + 1 - t) / degree * piece for k, piece in enumerate(pieces)]
        high = [(degree - 1 - k + t) / degree * piece for k, piece in enumerate(pieces)]
        pieces = [low[0], *map(np.add, low[1:], high), high[-1]]
    if not rate:
        return first, np.stack(pieces)
    pieces = [-pieces[0], *map(np.subtract, pieces, pieces[1:]), pieces[-1]]
    return first, np.stack(pieces) * np.where(np.abs(u) <= 1.0, 0.5 * (count - 3), 0.0)


def bsplines(u: Array, count: int) -> Array:
    """Return all uniform cubic B-splines (count, n) at u (n,) in -1 .. 1."""
    first, pieces = bspline_pieces(u, count)
    basis = np.zeros((count, len(u)))
    for n, piece in enumerate(pieces):
        basis[first + n, np.arange(len(u))] = piece
    return basis


def profile(place: Array, start: Array, stop: Array, origin: Array, rate: Array) -> Array:
    """Return the share of a step's displacement at places [px] (see `RowSpline.steps`)."""
    with np.errstate(invalid="ignore"):
        inside = (place >= start) & (place < stop)
        return np.asarray(np.where(inside, np.exp(-np.maximum((place - origin) * rate, 0.0)), 0.0))


def sine_and_cosine(row: Array, period: Array) -> Array:
    """Return the cosine and sine (2, ...) of one period [px] at rows (...) [px]; zero where the period is infinite."""
    phase = 2.0 * np.pi * np.asarray(row) / period
    return np.where(np.isfinite(period), np.stack([np.cos(phase), np.sin(phase)]), 0.0)


class _Curved(Frozen):
    """Base of displacements by cubic B-splines along one image coordinate, `_axis`, of the corrected position."""

    _axis: ClassVar[int]
    _by_image: Callable[[Array], Array]  # the displacement (..., 2) [px] of points seen at (..., 2) [px]
    rate: Callable[[Array], Array]  # its derivative (..., 2) [px/px] by that coordinate (...)

    def apply(self, image: Array) -> Array:
        """Return where points that a model without it has at (..., 2) [px] are seen."""
        return fixed_point(lambda seen: image + self._by_image(seen), image)

    def linearised(self, image: Array) -> tuple[Array, Array]:
        """Return the same, and its derivative (..., 2, 2): a coordinate moves the spline, and the spline it."""
        seen, axis = self.apply(image), self._axis
        rate = self.rate(seen[..., axis])
        slope = np.broadcast_to(np.eye(2), (*image.shape, 2)).copy()
        slope[..., axis] += rate / (1.0 - rate[..., axis, None])
        return seen, slope

    def undo(self, image: Array) -> Array:
        """Return where a model without it has points that are seen at (..., 2) [px]."""
        return image - self._by_image(image)

    @staticmethod
    def _splined(coeffs: Array, u: Array, rate: bool) -> Array:
        """Return the spline (..., 2) of coefficients (M, 2) at u (...) in -1 .. 1, or its derivative by u."""
        first, pieces = bspline_pieces(u.ravel(), len(coeffs), rate)
        out = sum(piece[:, None] * coeffs[first + n] for n, piece in enumerate(pieces))
        return np.asarray(out).reshape(*u.shape, 2)


@dataclass(frozen=True, eq=False, repr=False)
class RowSpline(_Curved):
    """A displacement of image points: corrected minus uncorrected position, as a function of the corrected one.

    Parameters
    ----------
    splines : (M, 2)
        Coefficients of uniform cubic B-splines over the rows, (col, row) [px]; M = 0: none, else at least 4.
    row_offset, row_scale : float, middle row, and rows from there to the ends of the knots [px]
    detector_edges : (C,), columns at which another detector begins [px], ascending
    detector_steps : (C + 1, 2), displacement of each detector, (col, row) [px]; without any detector (0, 2)
    steps : (M, 5)
        Displaced columns or rows: axis (0: columns, 1: rows), first and last place, and origin and rate of the decay
        exp(-(x - origin) rate) [px, 1/px]; rate 0: none. They may overlap.
    step_sizes : (M, 2), displacement of each step, (col, row) [px]; with a decay, at its origin
    periods : (M,), periods of the sinusoids over all rows [px]
    amplitudes : (M, 2, 2), amplitudes of cosine and sine of 2 pi row / period, (col, row) [px]

    Examples
    --------
    >>> step = barpc.RowSpline(np.zeros((0, 2)), detector_edges=[500.0], detector_steps=[[0.0, 0.0], [0.2, 0.0]])
    >>> step.apply(np.array([[100.0, 7.0], [600.0, 7.0]])).tolist()
    [[100.0, 7.0], [600.2, 7.0]]
    """

    _axis = 1
    splines: Array
    row_offset: float = 0.0
    row_scale: float = 1.0
    detector_edges: Array = field(default_factory=lambda: np.zeros(0))
    detector_steps: Array = field(default_factory=lambda: np.zeros((0, 2)))
    steps: Array = field(default_factory=lambda: np.zeros((0, 5)))
    step_sizes: Array = field(default_factory=lambda: np.zeros((0, 2)))
    periods: Array = field(default_factory=lambda: np.zeros(0))
    amplitudes: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))

    def __post_init__(self) -> None:
        shapes = (("splines", (None, 2)), ("detector_edges", (None,)), ("detector_steps", (None, 2)))
        further = ("steps", (None, 5)), ("step_sizes", (None, 2)), ("periods", (None,)), ("amplitudes", (None, 2, 2))
        for name, shape in (*shapes, *further):
            self._array(name, shape, RpcError)
        fine = np.isin(self.steps[:, 0], (0.0, 1.0)).all()
        if len(self.steps) != len(self.step_sizes) or not fine:
            raise RpcError("steps: each has an axis (0 or 1), two ends, an origin, a rate and a displacement")
        if len(self.periods) != len(self.amplitudes) or not (self.periods > 0).all():
            raise RpcError("sinusoids: each has a period above 0 and amplitudes of its cosine and sine")
        if 0 < len(self.splines) < 4:
            raise RpcError(f"a cubic spline has at least 4 coefficients, found {len(self.splines)}")
        edges = self.detector_edges
        if len(self.detector_steps) != (len(edges) + 1) * bool(len(edges)) or (np.diff(edges) <= 0).any():
            raise RpcError("detectors: their edges ascend, and there is one detector more than edges")
        if not (np.isfinite(self.row_offset) and np.isfinite(self.row_scale) and self.row_scale > 0):
            raise RpcError(f"spline rows: offset {self.row_offset}, scale {self.row_scale}")

    @property
    def spacing(self) -> float:
        """Rows between knots [px]; NaN without a spline."""
        return 2.0 * self.row_scale / (len(self.splines) - 3) if len(self.splines) else np.nan

    def at(self, image: Array) -> Array:
        """Return the displacement (..., 2) [px] of points seen at image points (..., 2) [px]."""
        out = self._along(image[..., 1], rate=False)
        if len(self.detector_steps):
            detector = np.searchsorted(self.detector_edges, image[..., 0], side="right")
            out += self.detector_steps[detector.clip(0, len(self.detector_edges))]
        for step, size in zip(self.steps, self.step_sizes, strict=True):
            out += profile(image[..., int(step[0])], *step[1:])[..., None] * size
        for period, moves in zip(self.periods, self.amplitudes, strict=True):
            out += np.moveaxis(sine_and_cosine(image[..., 1], period), 0, -1) @ moves
        return np.where(np.isfinite(image).all(axis=-1, keepdims=True), out, np.nan)

    _by_image = at

    def rate(self, row: Array) -> Array:
        """Return its derivative by the row (..., 2) [px/px] at rows (...) [px]."""
        out = self._along(row, rate=True) / self.row_scale
        for (axis, start, stop, origin, rate), size in zip(self.steps, self.step_sizes, strict=True):
            if axis == 1.0:
                fading = ((row - origin) * rate > 0.0) * rate
                out -= (profile(row, start, stop, origin, rate) * fading)[..., None] * size
        for period, (by_cos, by_sin) in zip(self.periods, self.amplitudes, strict=True):
            cos, sin = sine_and_cosine(row, period)[..., None] * (2.0 * np.pi / period)
            out += cos * by_sin - sin * by_cos
        return out

    def _along(self, row: Array, rate: bool) -> Array:
        u = (np.asarray(row, dtype=np.float64) - self.row_offset) / self.row_scale
        return self._splined(self.splines, u, rate) if len(self.splines) else np.zeros((*u.shape, 2))


@dataclass(frozen=True)
class Splined(Displaced):
    """`sensor`, usually P_BA, with image points displaced by spline, steps and sinusoids; itself a `SensorModel`.

    Examples
    --------
    >>> rpc = barpc.read_rpc("data_samples/view_00.tif")
    >>> step = barpc.RowSpline(np.zeros((0, 2)), detector_edges=[500.0], detector_steps=[[0.0, 0.0], [0.2, 0.0]])
    >>> (barpc.Splined(rpc, step).project([5.4, 43.3, 120.0]) - rpc.project([5.4, 43.3, 120.0])).round(9).tolist()
    [0.2, 0.0]
    """

    correction: RowSpline  # added to its image points


@dataclass(frozen=True, eq=False, repr=False)
class ColumnSpline(_Curved):
    """Displacement by column alone: the distortion and detector steps of a sensor, alike in all its images.

    Parameters
    ----------
    width : int, columns of its line of detectors
    coeffs : (M, 2), coefficients of uniform cubic B-splines from end to end of the line, (col, row) [px]; M >= 4
    edges : (C,), columns of the line at which another detector begins [px], ascending
    steps : (C, 2), what is added from each edge on, (col, row) [px]
    start : float, the column of the line that is the first of the image [px]
    """

    _axis = 0
    width: int
    coeffs: Array
    edges: Array = field(default_factory=lambda: np.zeros(0))
    steps: Array = field(default_factory=lambda: np.zeros((0, 2)))
    start: float = 0.0

    def __post_init__(self) -> None:
        coeffs, edges = self._array("coeffs", (None, 2), RpcError), self._array("edges", (None,), RpcError)
        self._array("steps", (len(edges), 2), RpcError)
        if self.width < 2 or len(coeffs) < 4 or (np.diff(edges) <= 0).any():
            raise RpcError("columns: two of them and four coefficients are needed at least, and edges ascend")

    def at(self, col: Array) -> Array:
        """Return the displacement (..., 2) [px] of points seen in columns (...) [px]; NaN at NaN."""
        out = self._along(col, rate=False)
        if len(self.edges):
            begun = np.concatenate([np.zeros((1, 2)), np.cumsum(self.steps, axis=0)])
            out += begun[np.searchsorted(self.edges, col + self.start, side="right").clip(0, len(self.edges))]
        return np.where(np.isfinite(col)[..., None], out, np.nan)

    def _by_image(self, image: Array) -> Array:
        return self.at(image[..., 0])

    def rate(self, col: Array) -> Array:
        """Return its derivative by the column (..., 2) [px/px] in columns (...) [px]."""
        return self._along(col, rate=True) * (2.0 / self.width)

    def _along(self, col: Array, rate: bool) -> Array:
        of_line = np.asarray(col, dtype=np.float64) + self.start + 0.5
        return self._splined(self.coeffs, of_line * (2.0 / self.width) - 1.0, rate)


@dataclass(frozen=True)
class Calibrated(Displaced):
    """A sensor model with its image points displaced by a column correction; itself a `SensorModel`."""

    correction: ColumnSpline  # what is added to its image points


@dataclass(frozen=True, eq=False, repr=False)
class CorrectionGrid(Frozen):
    """Displacements (dcol, drow) over an image, linear between the nodes and constant beyond them.

    Parameters
    ----------
    cols, rows : (W,), (H,), nodes [px], evenly spaced and ascending; (0, 0) is the centre of the top-left pixel
    shift : (H, W, 2), what is added to the image point of the RPC to get the true one [px]
    """

    cols: Array
    rows: Array
    shift: Array
    _linear: RegularGridInterpolator = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("cols", "rows"):
            axis = self._array(name, (None,), RpcError)
            if len(axis) < 2 or not (np.diff(axis) > 0).all():
                raise RpcError(f"correction grid: {name} must ascend")
        shift = self._array("shift", (len(self.rows), len(self.cols), 2), RpcError)
        from scipy.interpolate import RegularGridInterpolator  # a quarter of a second, of grids alone

        self._keep("_linear", RegularGridInterpolator((self.rows, self.cols), shift, bounds_error=False))

    @classmethod
    def between(
        cls, rpc: SensorModel, model: SensorModel, size: tuple[int, int], alt: float, tolerance: float = LINEAR
    ) -> CorrectionGrid:
        """Return the correction from image points of `rpc` to those of `model`, for ground of one altitude [m].

        Linear interpolation misses by no more than `tolerance` [px]. RpcError where a camera sees no ground.
        """

        def lacking(points: Array) -> Array:
            return model.project(rpc.localize(points, np.full(points.shape[:-1], alt))) - points

        low, high = np.full(2, -0.5), np.asarray(size) - 0.5
        cols, rows = linear_axes(lacking, low, high, np.array(MAX_NODE_SPACING[:2]), tolerance)
        nodes = np.stack(np.meshgrid(cols, rows), axis=-1)
        return cls(cols, rows, lacking(nodes).astype(np.float32).astype(np.float64))

    def at(self, image: Array) -> Array:
        """Return the displacements (..., 2) [px] at image points (..., 2) [px] of the RPC; NaN at NaN."""
        low, high = np.array([(axis[0], axis[-1]) for axis in (self.cols, self.rows)]).T
        inside = np.clip(image, low, high)[..., ::-1]
        return np.asarray(self._linear(inside)).reshape(inside.shape)

    def apply(self, image: Array) -> Array:
        """Return the true image points (..., 2) [px] of those of the RPC (..., 2) [px]."""
        return np.asarray(image + self.at(image))

    def linearised(self, image: Array) -> tuple[Array, Array]:
        """Return the same, and its derivative (..., 2, 2), over a tenth of a cell around the image points."""
        reach = 0.05 * np.array([self.cols[1] - self.cols[0], self.rows[1] - self.rows[0]])
        by_axis = [(self.apply(image + step) - self.apply(image - step)) / (2 * step.sum()) for step in np.diag(reach)]
        return self.apply(image), np.stack(by_axis, axis=-1)

    def undo(self, image: Array) -> Array:
        """Return the image points (..., 2) [px] of the RPC that belong to true ones."""
        return fixed_point(lambda of_rpc: image - self.at(of_rpc), image)
