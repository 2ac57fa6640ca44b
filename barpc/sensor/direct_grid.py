"""A direct localisation grid as a camera: ground points of a regular grid of image points, layer by layer.

Vendors deliver their physical model as a table G(col, row, alt) = (lon, lat) on a grid. Between the nodes it is
a tensor-product cubic spline; `project` inverts it by Newton's method with the spline's own derivatives. Of any other
camera `DirectGrid.of` makes one, dense enough for those who interpolate linearly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from barpc.base.errors import RpcError
from barpc.base.geodesy import MAX_COORDINATE, NEWTON_STEPS, NEWTON_TOLERANCE, Array, is_lonlat, wrap_longitude
from barpc.sensor import Pointwise, SensorModel
from barpc.sensor.rational import DERIVATIVE, monomials

if TYPE_CHECKING:
    from scipy.interpolate import NdBSpline

LINEAR = 0.005  # px: what linear interpolation in a grid made here may miss by

_REDERIVE_SHRINK = 1e-4  # of a step to the next: more asks for new derivatives

MAX_NODE_SPACING = 1024.0, 1024.0, 1000.0  # px, px, m: from node to node of a grid made here
_MIN_GRID_CELLS, _MAX_GRID_CELLS = 3, 1024  # cells along an axis; splines are cubic from three on
_MAX_GRID_NODES = 4_000_000  # of a grid made here, at most
_CELLS_TRIED = 1000  # cells


@dataclass(frozen=True, eq=False, repr=False)
class DirectGrid(Pointwise):
    """A camera given by the ground points of a grid of image points: itself a `SensorModel`.

    The spline is continued by one cell around the grid and by a tenth of its altitudes; beyond, points are NaN.

    Parameters
    ----------
    cols : (W,), columns of the nodes [px], ascending; (0, 0) is the centre of the top-left pixel
    rows : (H,), rows of the nodes [px], ascending
    alts : (L,), altitudes of the layers [m], ascending
    lonlat : (L, H, W, 2), lon, lat [deg] of the nodes

    Raises
    ------
    RpcError
        Fewer than two nodes along an axis, nodes that do not ascend, values that are not finite.
    """

    cols: Array
    rows: Array
    alts: Array
    lonlat: Array
    _spline: NdBSpline = field(init=False, repr=False)
    _inverse: Array = field(init=False, repr=False)
    _lon: float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        # a fifth of a second, which RPCs do not need
        from scipy.interpolate import NdBSpline, make_interp_spline

        for name in ("cols", "rows", "alts", "lonlat"):
            self._keep(name, np.array(getattr(self, name), dtype=np.float64))
        axes = (self.alts, self.rows, self.cols)
        shape = (*(len(np.atleast_1d(axis)) for axis in axes), 2)
        if self.lonlat.shape != shape or min(shape) < 2:
            raise RpcError(f"localisation grid: lon, lat {self.lonlat.shape} on {shape[:3]} nodes")
        if not all((np.abs(axis) <= MAX_COORDINATE).all() and (np.diff(axis) > 0).all() for axis in axes):
            raise RpcError("localisation grid: columns, rows and altitudes must ascend")
        if not is_lonlat(self.lonlat).all():
            raise RpcError("localisation grid: a node has no ground point")
        center = float(self.lonlat[shape[0] // 2, shape[1] // 2, shape[2] // 2, 0])
        coeffs = self.lonlat.copy()
        coeffs[..., 0] = wrap_longitude(coeffs[..., 0], center)
        coeffs -= [center, 0.0]
        self._keep("_inverse", _inverse_cubic(axes, coeffs))
        splines = []
        for i, axis in enumerate(axes):
            splines.append(make_interp_spline(axis, coeffs, k=min(3, len(axis) - 1), axis=i))
            coeffs = np.moveaxis(splines[-1].c, 0, i)
        knots, degrees = tuple(s.t for s in splines), tuple(s.k for s in splines)
        self._keep("_spline", NdBSpline(knots, np.ascontiguousarray(coeffs), degrees))
        self._keep("_lon", center)

    @classmethod
    def from_points(cls, ground: npt.ArrayLike, image: npt.ArrayLike) -> DirectGrid:
        """Return the grid of nodes ground (N, 3), image (N, 2) in any order; RpcError if one is missing."""
        (alts, rows, cols), nodes = nodes_of(np.asarray(ground, np.float64), np.asarray(image, np.float64))
        if nodes is None:
            shape = len(alts), len(rows), len(cols)
            raise RpcError(f"localisation grid: {len(np.asarray(ground))} points do not fill a grid of {shape} nodes")
        return cls(cols, rows, alts, nodes[..., :2])

    @classmethod
    def of(
        cls, model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float], tolerance: float = LINEAR
    ) -> DirectGrid:
        """Return the grid of a camera over an image of `size` (width, height), corner to corner, and its altitudes.

        Linear interpolation between its nodes misses by no more than `tolerance` [px], unless that asks for
        millions of nodes. RpcError where the camera sees no ground.
        """
        low = np.array([-0.5, -0.5, alt_range[0]])
        high = np.array([size[0] - 0.5, size[1] - 0.5, alt_range[1]])
        middle = (low + high) / 2
        center = model.localize(middle[:2], middle[2])
        to_px = model.project_jacobian(center)[1][:, :2].T

        def seen(points: Array) -> Array:
            """Return the ground points (..., 2) of points (..., 3) col, row, altitude, about in pixels."""
            lonlat = model.localize(points[..., :2], points[..., 2])[..., :2]
            return np.asarray((wrap_longitude(lonlat, center[:2]) - center[:2]) @ to_px)

        cols, rows, alts = linear_axes(seen, low, high, np.array(MAX_NODE_SPACING), tolerance)
        plane = np.stack(np.meshgrid(cols, rows), axis=-1)
        layers = [model.localize(plane, np.full(plane.shape[:2], alt))[..., :2] for alt in alts]
        return cls(cols, rows, alts, np.stack(layers))

    def _localize(self, image: Array, alt: Array) -> Array:
        return np.column_stack([self._value(image, alt) + np.array([self._lon, 0.0]), alt])

    def _derivatives(self, ground: Array) -> tuple[Array, ...]:
        image, alt = self._project(ground), ground[:, 2]
        by_lon, by_lat = self._inverse_2x2(image, alt)
        rise = self._value(image, alt, (1, 0, 0))
        by_alt = -by_lon * rise[:, :1] - by_lat * rise[:, 1:]
        return image, np.stack([by_lon, by_lat, by_alt], axis=2)

    def _project(self, ground: Array) -> Array:
        """Return the image points (N, 2) of points (N, 3): Newton by the derivatives of an inverse cubic, mostly."""
        target, alt = ground[:, :2].copy(), ground[:, 2]
        target[:, 0] = wrap_longitude(target[:, 0], self._lon) - self._lon
        with np.errstate(all="ignore"):
            image, by_lon, by_lat = self._guess(target, alt)
            before = np.full(len(target), np.inf)
            for _ in range(NEWTON_STEPS):
                miss = target - self._value(image, alt)
                step = by_lon * miss[:, :1] + by_lat * miss[:, 1:]
                image = image + step
                length = np.abs(step).max(axis=1)
                todo = ~(length < NEWTON_TOLERANCE) & np.isfinite(length)
                if not todo.any():
                    break
                if (length > _REDERIVE_SHRINK * before)[todo].any():
                    by_lon, by_lat = self._inverse_2x2(image, alt)
                before = length
            image[~(length < NEWTON_TOLERANCE)] = np.nan
        return image

    def _guess(self, lonlat: Array, alt: Array) -> tuple[Array, Array, Array]:
        """Return the image points (N, 2) of the inverse cubic, within the grid, and derivatives by lon, lat."""
        (offset, scale), coeffs = self._inverse[:2], self._inverse[2:, :2]
        basis = monomials(((np.column_stack([lonlat, alt]) - offset) / scale).T)
        image = basis.T @ coeffs
        for k, axis in enumerate((self.cols, self.rows)):
            cell = axis[1] - axis[0]
            image[:, k] = np.clip(image[:, k], axis[0] - cell, axis[-1] + cell)
        by_lon, by_lat = (basis[:10].T @ (DERIVATIVE[k].T @ coeffs) / scale[k] for k in (0, 1))
        return image, by_lon, by_lat

    def _value(self, image: Array, alt: Array, derivative: tuple[int, int, int] = (0, 0, 0)) -> Array:
        """Return degrees east of the centre and lat (N, 2) [deg], or a derivative of them; NaN off the grid."""
        place = np.column_stack([alt, image[:, 1], image[:, 0]])
        margin = [0.1 * np.ptp(self.alts), self.rows[1] - self.rows[0], self.cols[1] - self.cols[0]]
        low, high = np.array([(axis[0], axis[-1]) for axis in (self.alts, self.rows, self.cols)]).T
        off = ~((place >= low - margin) & (place <= high + margin)).all(axis=1)
        place[off] = low
        value = np.asarray(self._spline(place, nu=derivative))
        value[off] = np.nan
        return value

    def _inverse_2x2(self, image: Array, alt: Array) -> tuple[Array, Array]:
        """Return d(col, row)/dlon and d(col, row)/dlat (N, 2)."""
        (a, b), (c, d) = self._value(image, alt, (0, 0, 1)).T, self._value(image, alt, (0, 1, 0)).T
        det = a * d - b * c
        return np.stack([d / det, -b / det], axis=1), np.stack([-c / det, a / det], axis=1)


def nodes_of(ground: Array, image: Array) -> tuple[list[Array], Array | None]:
    """Return the altitudes, rows and columns of points (N, 3), (N, 2), and these as nodes (L, H, W, 3), if they fill a
    grid; a node without a point is NaN.
    """
    values = (ground[:, 2], image[:, 1], image[:, 0])
    axes, places = zip(*(np.unique(value, return_inverse=True) for value in values), strict=True)
    shape = tuple(len(axis) for axis in axes)
    if len(ground) != np.prod(shape):
        return list(axes), None
    nodes = np.full((*shape, 3), np.nan)
    nodes[places] = ground
    return list(axes), nodes


def _inverse_cubic(axes: tuple[Array, Array, Array], lonlat: Array) -> Array:
    """Return the offsets, scales and coefficients (22, 3) of cubic polynomials from (lon, lat, alt) to (col, row)."""
    thin = tuple(slice(None, None, max(1, len(axis) // 12)) for axis in axes)
    alt, row, col = np.meshgrid(*(axis[part] for axis, part in zip(axes, thin, strict=True)), indexing="ij")
    lonlat = lonlat[thin]
    ground = np.column_stack([lonlat[..., 0].ravel(), lonlat[..., 1].ravel(), alt.ravel()])
    offset, scale = ground.mean(axis=0), 0.5 * np.ptp(ground, axis=0)
    basis = monomials(((ground - offset) / scale).T).T
    image = np.column_stack([col.ravel(), row.ravel(), np.zeros(col.size)])
    return np.vstack([offset, scale, np.linalg.lstsq(basis, image, rcond=None)[0]])


def linear_axes(
    value: Callable[[Array], Array], low: Array, high: Array, longest: Array, tolerance: float
) -> list[Array]:
    """Return the nodes along each axis of a box `low`, `high` (d,) for linear interpolation within a tolerance.

    The error along each axis is measured at random places of random cells, whose phase no wave can hide in; what few
    cells show is more than the tolerance ends a trial, what is within it all of them say.

    Parameters
    ----------
    value : callable, points (..., d) -> values (..., k), in the unit of `tolerance`
    longest : (d,), cells at the beginning; they are made smaller until the errors of all axes add up to `tolerance`
    """
    counts = np.maximum(_MIN_GRID_CELLS, np.ceil((high - low) / longest)).astype(np.int64)
    for axis in range(len(low)):
        rng, along, tried = np.random.default_rng(axis), np.eye(len(low))[axis], _CELLS_TRIED // 10
        while True:
            step = (high - low) / counts * along
            first, t = low + (high - low - step) * rng.random((tried, len(low))), rng.random((tried, 1))
            begin, end, between = value(np.stack([first, first + step, first + t * step]))
            miss = (1 - t) * begin + t * end - between
            worst = float(np.linalg.norm(miss, axis=1).max())
            if not np.isfinite(worst):
                raise RpcError("localisation grid: the camera has no ground point in part of the image")
            if worst <= tolerance / len(low) or counts[axis] >= _MAX_GRID_CELLS:
                if tried == _CELLS_TRIED:
                    break
                tried = _CELLS_TRIED
                continue
            more = 1.1 * (worst * len(low) / tolerance) ** 0.5
            counts[axis] = min(_MAX_GRID_CELLS, int(np.ceil(counts[axis] * more)))
    if np.prod(counts + 1.0) > _MAX_GRID_NODES:
        return linear_axes(value, low, high, longest, 2 * tolerance)
    return [np.linspace(a, b, n + 1) for a, b, n in zip(low, high, counts, strict=True)]
