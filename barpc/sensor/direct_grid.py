"""A direct localisation grid as a camera: ground points of a regular grid of image points, layer by layer.

Vendors deliver their physical model as a table G(col, row, alt) = (lon, lat) on a grid. Between the nodes it is
a tensor-product cubic spline; `project` inverts it by Newton's method with the spline's own derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.interpolate import make_interp_spline

from barpc.errors import RpcError
from barpc.frozen import Frozen
from barpc.geodesy import Array, pointwise, wrap_longitude
from barpc.sensor.rational import monomials

CHUNK = 2048
"""Points worked on at a time: what belongs to them stays in cache."""

Basis = tuple[npt.NDArray[np.int64], Array, Array]

_FAR = 1e9  # px and m: beyond it no node lies
_STEPS = 8
_SETTLED = 1e-5  # px: Newton is quadratic, what is left after a step of this size is below rounding


@dataclass(frozen=True, eq=False)
class DirectGrid(Frozen):
    """A camera given by the ground points of a grid of image points: itself a `SensorModel`.

    Parameters
    ----------
    cols : (W,)
        Columns of the nodes [px], ascending; (0, 0) is the centre of the top-left pixel.
    rows : (H,)
        Rows of the nodes [px], ascending.
    alts : (L,)
        Altitudes of the layers [m], ascending.
    lonlat : (L, H, W, 2)
        lon, lat [deg] of the nodes.

    Raises
    ------
    RpcError
        Fewer than two nodes along an axis, nodes that do not ascend, values that are not finite.

    Notes
    -----
    The spline is continued by one cell around the grid and by a tenth of its altitude range; beyond, points
    are NaN.
    """

    cols: Array
    rows: Array
    alts: Array
    lonlat: Array
    _knots: tuple[Array, Array, Array] = field(init=False, repr=False)
    _spline: Array = field(init=False, repr=False)
    _inverse: Array = field(init=False, repr=False)
    _lon: float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("cols", "rows", "alts", "lonlat"):
            self._keep(name, np.array(getattr(self, name), dtype=np.float64))
        axes = (self.alts, self.rows, self.cols)
        shape = (*(len(np.atleast_1d(axis)) for axis in axes), 2)
        if self.lonlat.shape != shape or min(shape) < 2:
            raise RpcError(f"localisation grid: lon, lat {self.lonlat.shape} on {shape[:3]} nodes")
        if not all((np.abs(axis) <= _FAR).all() and (np.diff(axis) > 0).all() for axis in axes):
            raise RpcError("localisation grid: columns, rows and altitudes must ascend")
        if not (np.abs(self.lonlat) <= (540.0, 90.0)).all():  # NaN neither
            raise RpcError("localisation grid: a node has no ground point")
        center = float(self.lonlat[shape[0] // 2, shape[1] // 2, shape[2] // 2, 0])
        coeffs = self.lonlat.copy()
        coeffs[..., 0] = wrap_longitude(coeffs[..., 0], center)
        coeffs -= [center, 0.0]
        inverse = _inverse_cubic(axes, coeffs)
        knots = []
        for i, axis in enumerate(axes):
            spline = make_interp_spline(axis, coeffs, k=min(3, len(axis) - 1), axis=i)
            knots.append(np.asarray(spline.t))
            coeffs = np.moveaxis(np.asarray(spline.c), 0, i) if i else np.asarray(spline.c)
        table = np.ascontiguousarray(coeffs.reshape(-1, 2).T)  # (2, nodes)
        self._keep("_inverse", inverse)
        self._keep("_spline", table)
        self._keep("_knots", tuple(knots))
        self._keep("_lon", center)

    @classmethod
    def from_points(cls, ground: npt.ArrayLike, image: npt.ArrayLike) -> DirectGrid:
        """The grid whose nodes are listed in any order.

        Parameters
        ----------
        ground : (N, 3)
            lon, lat [deg], alt [m] of every node.
        image : (N, 2)
            col, row [px].

        Raises
        ------
        RpcError
            The points are not the nodes of a full regular grid.
        """
        ground = np.asarray(ground, dtype=np.float64)
        image = np.asarray(image, dtype=np.float64)
        values = (ground[:, 2], image[:, 1], image[:, 0])
        axes, places = zip(*(np.unique(value, return_inverse=True) for value in values), strict=True)
        shape = tuple(len(axis) for axis in axes)
        if len(ground) != np.prod(shape):
            raise RpcError(f"localisation grid: {len(ground)} points do not fill a grid of {shape} nodes")
        lonlat = np.full((*shape, 2), np.nan)
        lonlat[places] = ground[:, :2]
        return cls(axes[2], axes[1], axes[0], lonlat)

    def project(self, ground: Array) -> Array:
        """Image points (..., 2) [px] of ground points (..., 3) [deg, deg, m]; NaN off the grid."""
        return pointwise(lambda part: [self._solve(part)], CHUNK, [(2,)], ground)[0]

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Image points (..., 2) [px] and their derivative (..., 2, 3) [px/deg, px/deg, px/m]."""
        image, jacobian = pointwise(self._jacobian, CHUNK, [(2,), (2, 3)], ground)
        return image, jacobian

    def localize(self, image: Array, alt: Array) -> Array:
        """Ground points (..., 3) seen at image points (..., 2) [px] at altitudes (...) [m]; NaN off the grid."""
        return pointwise(self._localize, CHUNK, [(3,)], image, alt)[0]

    def _localize(self, image: Array, alt: Array) -> list[Array]:
        """`localize` of points (N, 2) at altitudes (N,)."""
        return [np.column_stack([self._value(image, alt)[0] + [self._lon, 0.0], alt])]

    def _jacobian(self, ground: Array) -> tuple[Array, Array]:
        """`project_jacobian` of points (N, 3)."""
        image = self._solve(ground)
        _, rate = self._value(image, ground[:, 2])
        by_lonlat = _inverse_2x2(rate[:, :2])  # (N, 2, 2): d(col, row)/d(lon, lat)
        by_alt = -np.einsum("nij,nj->ni", by_lonlat, rate[:, 2])
        return image, np.concatenate([by_lonlat, by_alt[:, :, None]], axis=2)

    def _solve(self, ground: Array) -> Array:
        """Image points (N, 2) of ground points (N, 3): Newton from an inverse cubic polynomial."""
        target = ground[:, :2].copy()
        target[:, 0] = wrap_longitude(target[:, 0], self._lon) - self._lon
        with np.errstate(all="ignore"):
            image = self._guess(target, ground[:, 2])
            settled = np.zeros(len(ground), dtype=bool)
            for _ in range(_STEPS):
                value, rate = self._value(image, ground[:, 2])
                step = np.einsum("nij,nj->ni", _inverse_2x2(rate[:, :2]), target - value)
                image = image + step
                settled = np.abs(step).max(axis=1) < _SETTLED
                if not (~settled & np.isfinite(step).all(axis=1)).any():
                    break
        image[~settled] = np.nan
        return image

    def _guess(self, lonlat: Array, alt: Array) -> Array:
        """Image points (N, 2) by the inverse cubic, brought back onto the grid."""
        offset, scale = self._inverse[0, :3], self._inverse[1, :3]
        image = monomials(((np.column_stack([lonlat, alt]) - offset) / scale).T).T @ self._inverse[2:, :2]
        for k, axis in enumerate((self.cols, self.rows)):
            cell = 0.9 * (axis[1] - axis[0])
            image[:, k] = np.clip(image[:, k], axis[0] - cell, axis[-1] + cell)
        return np.asarray(image)

    def _value(self, image: Array, alt: Array) -> tuple[Array, Array]:
        """East of the centre and lat (N, 2) [deg], and their derivatives (N, 3, 2) by col, row, alt."""
        places = (alt, image[:, 1], image[:, 0])
        margins = (0.1 * np.ptp(self.alts), self.rows[1] - self.rows[0], self.cols[1] - self.cols[0])
        inside = np.ones(len(alt), dtype=bool)
        bases = []
        for place, margin, knots in zip(places, margins, self._knots, strict=True):
            ok = (place >= knots[0] - margin) & (place <= knots[-1] + margin)
            inside &= ok
            bases.append(_basis(knots, np.where(ok, place, knots[0])))
        total = self._contract(bases)
        total[:, :, ~inside] = np.nan
        return total[0].T, np.moveaxis(total[1:], 2, 0)

    def _contract(self, bases: list[Basis]) -> Array:
        """Value, d/dcol, d/drow, d/dalt (4, 2, N) from the B-splines along altitude, row and column."""
        (k, layers, by_alt), (i, rows, by_row), (j, cols, by_col) = bases
        height, width = self.lonlat.shape[1:3]
        start = (k * height + i) * width + j
        total = np.zeros((4, 2, len(start)))
        for dk in range(len(layers)):
            plane = np.zeros((3, 2, len(start)))
            for di in range(len(rows)):
                line, line_rate = np.zeros((2, 2, len(start)))
                for dj in range(len(cols)):
                    node = self._spline.take(start + ((dk * height + di) * width + dj), axis=1)
                    line += cols[dj] * node
                    line_rate += by_col[dj] * node
                plane[0] += rows[di] * line
                plane[1] += rows[di] * line_rate
                plane[2] += by_row[di] * line
            total[:3] += layers[dk] * plane
            total[3] += by_alt[dk] * plane[0]
        return total


def _basis(knots: Array, x: Array) -> Basis:
    """First index (N,), values and slopes (k + 1, N) of the B-splines that are not zero at x (N,).

    Cox and de Boor's recursion; the end pieces are continued beyond the outer knots.
    """
    degree = int(np.argmax(knots > knots[0])) - 1
    span = np.clip(np.searchsorted(knots, x, side="right") - 1, degree, len(knots) - degree - 2)
    values = [np.ones(len(x))]
    slopes: list[Array] = []
    for order in range(1, degree + 1):
        zero = np.zeros(len(x))
        grown, slopes = [zero] * (order + 1), [zero] * (order + 1)
        for r in range(order):
            right, left = knots[span + r + 1], knots[span + r + 1 - order]
            part = values[r] / (right - left)
            grown[r] = grown[r] + (right - x) * part
            grown[r + 1] = (x - left) * part
            slopes[r] = slopes[r] - order * part
            slopes[r + 1] = order * part
        values = grown
    return span - degree, np.stack(values), np.stack(slopes)


def _inverse_2x2(matrix: Array) -> Array:
    """Inverses d(col, row)/d(lon, lat) of (N, 2, 2) derivatives of (lon, lat) by col and by row."""
    (a, b), (c, d) = np.moveaxis(matrix, 0, 2)  # a, b: lon, lat by col; c, d: by row
    out = np.stack([np.stack([d, -c], axis=-1), np.stack([-b, a], axis=-1)], axis=1)
    return np.asarray(out / (a * d - b * c)[:, None, None])


def _inverse_cubic(axes: tuple[Array, Array, Array], lonlat: Array) -> Array:
    """Offsets, scales and coefficients (22, 3) of cubic polynomials from (lon, lat, alt) to (col, row)."""
    thin = tuple(slice(None, None, max(1, len(axis) // 12)) for axis in axes)
    alt, row, col = np.meshgrid(*(axis[part] for axis, part in zip(axes, thin, strict=True)), indexing="ij")
    lonlat = lonlat[thin]
    ground = np.column_stack([lonlat[..., 0].ravel(), lonlat[..., 1].ravel(), alt.ravel()])
    offset, scale = ground.mean(axis=0), 0.5 * np.ptp(ground, axis=0)
    basis = monomials(((ground - offset) / scale).T).T
    image = np.column_stack([col.ravel(), row.ravel(), np.zeros(col.size)])
    return np.vstack([offset, scale, np.linalg.lstsq(basis, image, rcond=None)[0]])
