"""P_BA: a sensor model behind a rotation and a translation about its camera centre.

The paper's corrected projection, P_BA(X) = P(R (X - T - C) + C) with X in ECEF (eq. 1 of Akiki et al.
2021, "Robust Rational Polynomial Camera Modelling for SAR and Pushbroom Imaging"). A second rotation, a
polynomial of the image row, may follow R: the drift of the attitude along the strip. `Motion` is all of it with
its derivatives, for one view here and for blocks of views in the adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from barpc.errors import RpcError
from barpc.geodesy import (
    Array,
    ecef_from_ground,
    ecef_from_ground_jacobian,
    ground_from_ecef,
    ground_from_ecef_jacobian,
)
from barpc.sensor import SensorModel

IntArray = npt.NDArray[np.int64]

_ROW_STEPS = (
    8  # a drift moves an image point by some thousandths of a pixel a row: each step gains three digits
)
_ROW_SETTLED = 1e-6  # px: what is left is a thousandth of it


def skew(vector: Array) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): skew(a) @ b = a x b."""
    vector = np.asarray(vector, dtype=np.float64)
    out = np.zeros((*vector.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -vector[..., 2], vector[..., 1], -vector[..., 0]
    out -= np.swapaxes(out, -1, -2).copy()
    return out


def rotation_matrix(rotation: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]: Rodrigues, a series near zero."""
    rotation = np.asarray(rotation, dtype=np.float64)
    angle2 = (rotation * rotation).sum(axis=-1)[..., None, None]
    angle = np.sqrt(angle2)
    k = skew(rotation)
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2  # (1 - cos) / angle^2 without cancellation
    matrix: Array = np.eye(3) + a * k + b * (k @ k)
    return matrix


def rotation_left_jacobian(rotation: Array) -> Array:
    """Left Jacobians (..., 3, 3) of rotation vectors (..., 3) [rad].

    R(w + dw) = R(J dw) R(w) to first order: d(R v)/dw = -skew(R v) J.
    """
    rotation = np.asarray(rotation, dtype=np.float64)
    angle2 = (rotation * rotation).sum(axis=-1)[..., None, None]
    angle = np.sqrt(angle2)
    k = skew(rotation)
    b = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        c = np.where(angle2 > 1e-4, (1.0 - np.sinc(angle / np.pi)) / angle2, 1.0 / 6 - angle2 / 120)
    jacobian: Array = np.eye(3) + b * k + c * (k @ k)
    return jacobian


def _cross(a: Array, b: Array) -> Array:
    """Cross products along the axis before the last of (..., 3, n) arrays, broadcast."""
    (a0, a1, a2), (b0, b1, b2) = (np.moveaxis(v, -2, 0) for v in (a, b))
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=-2)


def _by_view(matrices: Array, rows: Array, bounds: IntArray) -> Array:
    """Matrices (m, 3, 3) times the columns bounds[i] : bounds[i + 1] of rows (..., 3, n)."""
    out = np.empty_like(rows)
    for matrix, start, stop in zip(matrices, bounds[:-1], bounds[1:], strict=True):
        np.matmul(matrix, rows[..., start:stop], out=out[..., start:stop])
    return out


class Motion:
    """exp(d) R (X - T - C) + C for points of one view or many, and the derivatives: all that P_BA adds to P.

    Arrays are component-major, columns sorted by view; R, T and C are those of each view, the drift d is that of
    each point.

    Parameters
    ----------
    ecef : (3, n)
        X [m].
    rotation, translation, center : (m, 3)
        Rotation vectors [rad], T and C [m] of m views.
    bounds : (m + 1,)
        Points of view v are bounds[v] : bounds[v + 1].
    drift : (3, n) or None
        Rotation vectors [rad].
    """

    def __init__(
        self,
        ecef: Array,
        rotation: Array,
        translation: Array,
        center: Array,
        bounds: IntArray,
        drift: Array | None = None,
    ) -> None:
        self._rotation, self._bounds, self._drift = rotation, bounds, drift
        self._matrix = rotation_matrix(rotation)
        count = np.diff(bounds)
        self._lever = _by_view(
            self._matrix, ecef - np.repeat((translation + center).T, count, axis=1), bounds
        )
        turned = self._lever
        if drift is not None:
            self._series = _series((drift * drift).sum(axis=0))
            first = _cross(drift, turned)
            turned = turned + self._series[0] * first + self._series[1] * _cross(drift, first)
        self._turned = turned
        self.ecef = turned + np.repeat(center.T, count, axis=1)

    def derivatives(self, by_moved: Array) -> tuple[Array, Array, Array]:
        """Derivatives by X, by R and by d of what depends on the moved points; by T they are those by X, negative.

        Parameters
        ----------
        by_moved : (2, 3, n)
            Derivatives by the moved points [1/m].

        Returns
        -------
        by_point : (2, 3, n)
            [1/m], the drift held.
        by_rotation, by_drift : (2, 3, n)
            [1/rad]; the second is the first where there is no drift.
        """
        back, by_drift = by_moved, None
        if self._drift is not None:
            d, (a, b, c) = self._drift, self._series
            first = _cross(by_moved, d)
            back = by_moved + a * first + b * _cross(first, d)
            swung = _cross(self._turned, by_moved)
            first = _cross(d, swung)
            by_drift = swung - b * first + c * _cross(d, first)
        by_point = _by_view(self._matrix.swapaxes(1, 2), back, self._bounds)
        left = rotation_left_jacobian(self._rotation).swapaxes(1, 2)
        by_rotation = _by_view(left, _cross(self._lever, back), self._bounds)
        return by_point, by_rotation, by_rotation if by_drift is None else by_drift


def _series(angle2: Array) -> tuple[Array, Array, Array]:
    """sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3 of squared angles."""
    if angle2.max(initial=0.0) < 1e-4:
        return 1 - angle2 / 6 * (1 - angle2 / 20), 0.5 - angle2 / 24, 1.0 / 6 - angle2 / 120
    angle = np.sqrt(angle2)
    sine = np.sinc(angle / np.pi)
    with np.errstate(all="ignore"):
        third = np.where(angle2 > 1e-4, (1.0 - sine) / angle2, 1.0 / 6 - angle2 / 120)
    return sine, 0.5 * np.sinc(0.5 * angle / np.pi) ** 2, third


@dataclass(frozen=True, eq=False)
class Correction:
    """Rotation and translation of one view about its camera centre.

    Parameters
    ----------
    rotation : (3,)
        Rotation vector [rad], ECEF axes.
    translation : (3,)
        [m], ECEF.
    center : (3,)
        Camera centre [m], ECEF.
    drift : (D, 3)
        A second rotation [rad] after the first: the vectors times the powers u, u^2, ... of the normalised image
        row u = (row - row_offset) / row_scale at which the point is seen; D = 0: none.
    row_offset, row_scale : float
        Row of u = 0 and rows to u = 1 [px].
    """

    rotation: Array
    translation: Array
    center: Array
    drift: Array = field(default_factory=lambda: np.zeros((0, 3)))
    row_offset: float = 0.0
    row_scale: float = 1.0

    def __post_init__(self) -> None:
        for name in ("rotation", "translation", "center", "drift"):
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape[-1:] != (3,) or value.ndim != 1 + (name == "drift"):
                raise RpcError(f"correction {name}: expected three numbers, found {value.tolist()}")
            if not np.isfinite(value).all():
                raise RpcError(f"correction {name}: not finite ({value.tolist()})")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if not (np.isfinite(self.row_offset) and np.isfinite(self.row_scale) and self.row_scale != 0):
            raise RpcError(f"correction rows: offset {self.row_offset}, scale {self.row_scale}")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Correction) and self._content() == other._content()

    def __hash__(self) -> int:
        return hash(self._content())

    def _content(self) -> tuple[float, ...]:
        fixed = (*self.rotation.tolist(), *self.translation.tolist(), *self.center.tolist())
        return (*fixed, *self.drift.ravel().tolist(), self.row_offset, self.row_scale)

    def drift_at(self, row: Array) -> Array:
        """Rotation vectors (..., 3) [rad] of the drift at image rows (...) [px]."""
        u = (np.asarray(row, dtype=np.float64) - self.row_offset) / self.row_scale
        drift: Array = u[..., None] ** np.arange(1, len(self.drift) + 1) @ self.drift
        return drift

    def drift_rate(self, row: Array) -> Array:
        """Their derivative by the row (..., 3) [rad/px]."""
        u = (np.asarray(row, dtype=np.float64) - self.row_offset) / self.row_scale
        degree = np.arange(1, len(self.drift) + 1)
        rate: Array = (degree * u[..., None] ** (degree - 1)) @ self.drift / self.row_scale
        return rate

    def motion(self, ecef: Array, row: Array | None = None) -> Motion:
        """The motion of points (3, n) [m], ECEF, seen at the rows (n,) [px]."""
        drift = None if row is None else np.ascontiguousarray(self.drift_at(row).T)
        bounds = np.array([0, ecef.shape[1]])
        return Motion(ecef, self.rotation[None], self.translation[None], self.center[None], bounds, drift)

    def apply(self, ecef: Array, row: Array | None = None) -> Array:
        """R (X - T - C) + C for ECEF points X (..., 3) [m]; turned on by the drift at the rows (...) if given."""
        ecef = np.asarray(ecef, dtype=np.float64)
        rows = None if row is None else np.broadcast_to(row, ecef.shape[:-1]).reshape(-1)
        return self.motion(ecef.reshape(-1, 3).T, rows).ecef.T.reshape(ecef.shape)


@dataclass(frozen=True)
class Corrected:
    """P_BA: `sensor` behind `correction`; itself a `SensorModel`.

    Parameters
    ----------
    sensor : SensorModel
        The model as delivered, P.
    correction : Correction
        R, T and C.
    """

    sensor: SensorModel
    correction: Correction

    def project(self, ground: Array) -> Array:
        """Image points (..., 2) [px] of ground points (..., 3) [deg, deg, m]."""
        ecef = ecef_from_ground(ground)
        if not len(self.correction.drift):
            return self.sensor.project(ground_from_ecef(self.correction.apply(ecef)))
        image = self.sensor.project(ground)
        for _ in range(_ROW_STEPS):
            row = image[..., 1]
            image = self.sensor.project(ground_from_ecef(self.correction.apply(ecef, row)))
            change = np.abs(image[..., 1] - row)
            if not (change.max(initial=0.0, where=np.isfinite(change)) > _ROW_SETTLED):
                break
        return image

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Image points (..., 2) [px] and their derivative (..., 2, 3) [px/deg, px/deg, px/m]."""
        image, by_ecef, _, _ = self.project_ecef(ecef_from_ground(ground))
        return image, by_ecef @ ecef_from_ground_jacobian(ground)

    def project_ecef(self, ecef: Array) -> tuple[Array, Array, Array, Array]:
        """Image points of ECEF points, with the derivatives that the adjustment needs.

        Parameters
        ----------
        ecef : (..., 3)
            x, y, z [m].

        Returns
        -------
        image : (..., 2)
            col, row [px].
        by_ecef : (..., 2, 3)
            d(image)/dX [px/m].
        by_rotation : (..., 2, 3)
            d(image)/dR [px/rad].
        by_translation : (..., 2, 3)
            d(image)/dT [px/m].
        """
        ecef = np.asarray(ecef, dtype=np.float64)
        columns, shape = np.ascontiguousarray(ecef.reshape(-1, 3).T), ecef.shape[:-1]
        row = None
        if len(self.correction.drift):
            row = self.project(ground_from_ecef(columns.T))[:, 1]
        motion = self.correction.motion(columns, row)
        image, by_moved = self._by_ecef(motion.ecef)
        by_point, by_rotation, by_drift = motion.derivatives(by_moved)
        by_translation = -by_point
        if row is not None:  # the point moves the row, and the row the drift
            by_row = (by_drift * self.correction.drift_rate(row).T).sum(axis=1)
            share = by_row / (1.0 - by_row[1])
            by_point, by_rotation, by_translation = (
                part + share[:, None] * part[1] for part in (by_point, by_rotation, by_translation)
            )
        parts = (
            np.moveaxis(part, -1, 0).reshape(*shape, *part.shape[:-1])
            for part in (by_point, by_rotation, by_translation)
        )
        by_ecef, of_rotation, of_translation = parts
        return image.T.reshape(*shape, 2), by_ecef, of_rotation, of_translation

    def _by_ecef(self, ecef: Array) -> tuple[Array, Array]:
        """The uncorrected sensor's image points (2, n) of ECEF points (3, n), and their derivative (2, 3, n)."""
        ground = ground_from_ecef(ecef.T)
        image, by_ground = self.sensor.project_jacobian(ground)
        return image.T, np.moveaxis(by_ground @ ground_from_ecef_jacobian(ground), 0, -1)

    def localize(self, image: Array, alt: Array) -> Array:
        """Ground points seen at image points, at known altitudes.

        Newton on (lon, lat), started where the uncorrected sensor puts the point.

        Parameters
        ----------
        image : (..., 2)
            col, row [px].
        alt : (...)
            Altitude above the WGS84 ellipsoid [m].

        Returns
        -------
        ground : (..., 3)
            lon, lat [deg], alt [m]; NaN where the iteration does not settle.
        """
        ground = self.sensor.localize(image, alt)
        return refine_localization(self, ground, np.asarray(image, dtype=np.float64))


def refine_localization(
    sensor: SensorModel, ground: Array, image: Array, steps: int = 12, tolerance: float = 1e-7
) -> Array:
    """Newton steps on (lon, lat) until `ground` projects to `image`.

    Parameters
    ----------
    sensor : SensorModel
        Any model.
    ground : (..., 3)
        First guess; lon, lat [deg], alt [m] (kept).
    image : (..., 2)
        col, row [px].
    steps : int
        At most so many.
    tolerance : float
        [px]; a point that stays farther away is NaN.

    Returns
    -------
    ground : (..., 3)
        lon, lat [deg], alt [m].
    """
    ground = np.array(ground, dtype=np.float64)
    with np.errstate(all="ignore"):
        for _ in range(steps):
            value, jacobian = sensor.project_jacobian(ground)
            residual = image - value
            a, b, c, d = (jacobian[..., i, j] for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
            det = a * d - b * c
            ground[..., 0] += (d * residual[..., 0] - b * residual[..., 1]) / det
            ground[..., 1] += (a * residual[..., 1] - c * residual[..., 0]) / det
            if not (np.abs(residual).max(initial=0.0, where=np.isfinite(residual)) > 1e-4):
                break  # quadratic: what is left after this step is below rounding
        miss = np.abs(sensor.project(ground) - image).max(axis=-1)
        ground[~(miss <= tolerance + 8 * np.finfo(float).eps * np.abs(image).max(axis=-1))] = np.nan
    return ground
