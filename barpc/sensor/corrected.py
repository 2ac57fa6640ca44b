"""P_BA: a sensor model behind a rotation and a translation about its camera centre.

The paper's corrected projection, P_BA(X) = P(R (X - T - C) + C) with X in ECEF (eq. 1 of Akiki et al.
2021, "Robust Rational Polynomial Camera Modelling for SAR and Pushbroom Imaging"). R may change along the
strip, as a polynomial of the image row.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from barpc.errors import RpcError
from barpc.geodesy import (
    Array,
    ecef_from_ground,
    ecef_from_ground_jacobian,
    ground_from_ecef,
    ground_from_ecef_jacobian,
)
from barpc.sensor import SensorModel


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
        Rotation [rad] added by the powers u, u^2, ... of the normalised image row
        u = (row - row_offset) / row_scale, where row is the uncorrected sensor's; D = 0: none.
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

    def rotation_at(self, row: Array) -> Array:
        """Rotation vectors (..., 3) [rad] at image rows (...) [px] of the uncorrected sensor."""
        u = (np.asarray(row, dtype=np.float64) - self.row_offset) / self.row_scale
        powers = u[..., None] ** np.arange(1, len(self.drift) + 1)
        return self.rotation + powers @ self.drift

    def apply(self, ecef: Array, row: Array | None = None) -> Array:
        """R (X - T - C) + C for ECEF points X (..., 3) [m]; R at the rows (...) where there is a drift."""
        moved = np.asarray(ecef, dtype=np.float64) - (self.translation + self.center)
        if row is None:
            return moved @ rotation_matrix(self.rotation).T + self.center
        turned: Array = (rotation_matrix(self.rotation_at(row)) @ moved[..., None])[..., 0] + self.center
        return turned


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
    _matrix: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        matrix = rotation_matrix(self.correction.rotation)
        matrix.setflags(write=False)
        object.__setattr__(self, "_matrix", matrix)

    def project(self, ground: Array) -> Array:
        """Image points (..., 2) [px] of ground points (..., 3) [deg, deg, m]."""
        row = self.sensor.project(ground)[..., 1] if len(self.correction.drift) else None
        return self.sensor.project(ground_from_ecef(self.correction.apply(ecef_from_ground(ground), row)))

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

        Notes
        -----
        The derivative by the drift of degree d is `by_rotation` times u^d.
        """
        if len(self.correction.drift):
            return self._project_ecef_drift(ecef)
        moved = self.correction.apply(ecef)
        ground = ground_from_ecef(moved)
        image, by_ground = self.sensor.project_jacobian(ground)
        by_moved = by_ground @ ground_from_ecef_jacobian(ground)
        by_ecef = by_moved @ self._matrix
        lever = skew(moved - self.correction.center)
        by_rotation = -by_moved @ lever @ rotation_left_jacobian(self.correction.rotation)
        return image, by_ecef, by_rotation, -by_ecef

    def _project_ecef_drift(self, ecef: Array) -> tuple[Array, Array, Array, Array]:
        """`project_ecef` where R depends on the row, and so on X."""
        correction = self.correction
        before = ground_from_ecef(ecef)
        first, first_by_ground = self.sensor.project_jacobian(before)
        row_by_ecef = (first_by_ground[..., 1:, :] @ ground_from_ecef_jacobian(before))[..., 0, :]
        rotation = correction.rotation_at(first[..., 1])
        matrix = rotation_matrix(rotation)
        moved = correction.apply(ecef, first[..., 1])
        ground = ground_from_ecef(moved)
        image, by_ground = self.sensor.project_jacobian(ground)
        by_moved = by_ground @ ground_from_ecef_jacobian(ground)
        by_rotation = -by_moved @ skew(moved - correction.center) @ rotation_left_jacobian(rotation)
        by_translation = -by_moved @ matrix
        u = (first[..., 1] - correction.row_offset) / correction.row_scale
        degree = np.arange(1, len(correction.drift) + 1)
        rate = (degree * u[..., None] ** (degree - 1)) @ correction.drift / correction.row_scale
        by_row = by_rotation @ rate[..., None]
        return image, by_row * row_by_ecef[..., None, :] - by_translation, by_rotation, by_translation

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
