"""Sensor models behind a correction in space: P_BA.

The paper's corrected projection is P_BA(X) = P(R (X - T - C) + C) with X in ECEF (eq. 7 of Akiki et al.
2021, "Robust Rational Polynomial Camera Modelling for SAR and Pushbroom Imaging"). A second rotation, a
polynomial of the image row, may follow R: the drift of the attitude along the strip. `RigidMotion` is all of it with
its derivatives, for one view here and for blocks of views in the adjustment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from barpc.base.errors import RpcError
from barpc.base.fields import field_names
from barpc.base.frozen import Frozen
from barpc.base.geodesy import (
    NEWTON_STEPS,
    NEWTON_TOLERANCE,
    Array,
    IntArray,
    as_image,
    ecef_from_ground,
    ecef_from_ground_jacobian,
    ground_from_ecef,
    ground_from_ecef_jacobian,
    pointwise,
    wrap_longitude,
)
from barpc.sensor import Behind, SensorModel, fixed_point
from barpc.sensor.curve import Turn, cross, rotation_left_jacobian, rotation_matrix

_DERIVATIVE_ACCURACY = 1e-8  # of derivatives: the solver's steps ask for no more


class RigidMotion:
    """The motion exp(d) R (X - T - C) + C of ground points of one or many views, with its derivatives.

    Arrays are component-major, columns sorted by view; R, T, C are each view's, the drift d is each point's.

    Parameters
    ----------
    ecef : (3, n), X [m]
    rotation, translation, center : (m, 3), rotation vectors [rad], T and C [m] of m views
    bounds : (m + 1,), points of view v are bounds[v] : bounds[v + 1]
    drift : (3, n) or None, rotation vectors [rad]
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
        self._rotation, self._bounds = rotation, bounds
        self._drift = None if drift is None else Turn(drift)
        self._matrix = rotation_matrix(rotation)
        count = np.diff(bounds)
        lever = _by_view(self._matrix, ecef - np.repeat((translation + center).T, count, axis=1), bounds)
        self._turned = lever if self._drift is None else self._drift.forth(lever)
        self.ecef = self._turned + np.repeat(center.T, count, axis=1)

    def by_point(self, by_moved: Array, out: Array | None = None) -> Array:
        """Return the derivatives (2, 3, n) by X [1/m] from those by the moved points; by T they are negative."""
        back = by_moved if self._drift is None else self._drift.back(by_moved, _DERIVATIVE_ACCURACY)
        return _by_view(self._matrix.swapaxes(1, 2), back, self._bounds, out)

    def by_turns(self, by_moved: Array) -> tuple[Array, Array]:
        """Return those by R and d [1/rad]: the same where there is no drift."""
        before = by_turn = cross(self._turned, by_moved)
        if self._drift is not None:
            before, by_turn = self._drift.back_and_rate(by_turn, _DERIVATIVE_ACCURACY)
        left = rotation_left_jacobian(self._rotation).swapaxes(1, 2)
        by_rotation = _by_view(left, before, self._bounds)
        return by_rotation, by_rotation if self._drift is None else by_turn


def _by_view(matrices: Array, rows: Array, bounds: IntArray, out: Array | None = None) -> Array:
    """Return the matrices (m, 3, 3) times the columns bounds[i] : bounds[i + 1] of rows (..., 3, n)."""
    out = np.empty_like(rows) if out is None else out
    for matrix, start, stop in zip(matrices, bounds[:-1], bounds[1:], strict=True):
        np.matmul(matrix, rows[..., start:stop], out=out[..., start:stop])
    return out


@dataclass(frozen=True, eq=False, repr=False)
class Correction(Frozen):
    """Rotation, translation and scale of the ground of one view: s R (X - T - C) + C, C its camera centre.

    Parameters
    ----------
    rotation : (3,), rotation vector [rad], ECEF axes
    translation : (3,), [m], ECEF
    center : (3,), camera centre [m], ECEF
    drift : (D, 3)
        A second rotation [rad] after the first: the vectors times the powers u, u^2, ... of the normalised image
        row u = (row - row_offset) / row_scale at which the point is seen; D = 0: none.
    row_offset, row_scale : float, row of u = 0 and rows to u = 1 [px]
    scale : float, s; 1 in an adjustment, else of a similarity that another tool found

    Examples
    --------
    >>> move = barpc.Correction(np.zeros(3), [1.0, 0.0, 0.0], [7.1e6, 0.0, 0.0])
    >>> move
    Correction(rotation 0 urad, translation 1 m)
    """

    rotation: Array
    translation: Array
    center: Array
    drift: Array = field(default_factory=lambda: np.zeros((0, 3)))
    row_offset: float = 0.0
    row_scale: float = 1.0
    scale: float = 1.0

    def __post_init__(self) -> None:
        for name in ("rotation", "translation", "center"):
            self._array(name, (3,), RpcError)
        self._array("drift", (None, 3), RpcError)
        if not (np.isfinite(self.row_offset) and np.isfinite(self.row_scale) and self.row_scale != 0):
            raise RpcError(f"correction rows: offset {self.row_offset}, scale {self.row_scale}")
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise RpcError(f"correction scale {self.scale}, expected a number above 0")

    def _told(self) -> str:
        turn, move, *drift = (np.linalg.norm(v) for v in (self.rotation, self.translation, *self.drift))
        bent = "".join(f", drift {1e6 * d:.3g} urad" for d in drift)
        grown = f", scale {self.scale:.12g}" if self.scale != 1 else ""
        return f"rotation {1e6 * turn:.3g} urad, translation {move:.3g} m{bent}{grown}"

    def motion(self, ecef: Array, row: Array | None = None) -> RigidMotion:
        """Return the motion of points (3, n) [m], ECEF, seen at the rows (n,) [px]."""
        drift = None if row is None else self._turns(row)
        translation, center = self._columns
        shift = self.scale * translation + (self.scale - 1.0) * center  # T of the points s X
        bounds = ecef.shape[1] * np.arange(center.shape[1] + 1) // center.shape[1]
        return RigidMotion(self.scale * ecef, np.atleast_2d(self.rotation), shift.T, center.T, bounds, drift)

    def drift_rate(self, row: Array) -> Array:
        """Return the derivative of the drift by the row (3, n) [rad/px] at rows (n,) [px]."""
        u, degree = (row - self.row_offset) / self.row_scale, np.arange(1, len(self.drift) + 1)[:, None]
        return self._drifted(degree * u ** (degree - 1)) / self.row_scale

    def apply(self, ecef: Array, row: Array | None = None) -> Array:
        """Return s R (X - T - C) + C of ECEF points X (..., 3) [m]; with the drift, if given rows (...)."""
        ecef = np.asarray(ecef, dtype=np.float64)
        translation, center = self._columns
        moved = self.scale * self._turned(ecef.reshape(-1, 3).T - (translation + center))
        if row is not None:
            moved = Turn(self._turns(np.broadcast_to(row, ecef.shape[:-1]).reshape(-1))).forth(moved)
        return np.asarray((moved + center).T).reshape(ecef.shape)

    def undo(self, ecef: Array, row: Array) -> Array:
        """Return the points X (N, 3) [m] that `apply` takes to ECEF points (N, 3) at rows (N,)."""
        translation, center = self._columns
        back = ecef.T - center
        if len(self.drift):
            back = Turn(self._turns(row)).back(back)
        return np.asarray((self._turned(back, back=True) / self.scale + (translation + center)).T)

    @cached_property
    def _columns(self) -> tuple[Array, Array]:
        return np.atleast_2d(self.translation).T, np.atleast_2d(self.center).T

    @cached_property
    def _matrix(self) -> Array:
        return rotation_matrix(self.rotation)

    def _turned(self, columns: Array, back: bool = False) -> Array:
        """Return the columns (3, n) rotated by R, or back."""
        return np.asarray((self._matrix.T if back else self._matrix) @ columns)

    def _turns(self, row: Array) -> Array:
        """Return the drift's rotation vectors (3, n) [rad] at rows (n,) [px]."""
        u = (row - self.row_offset) / self.row_scale
        return self._drifted(u ** np.arange(1, len(self.drift) + 1)[:, None])

    def _drifted(self, powers: Array) -> Array:
        return np.asarray((np.atleast_3d(self.drift) * powers[:, None]).sum(axis=0))


@dataclass(frozen=True, eq=False, repr=False)
class Corrections(Correction):
    """Corrections of many cameras as one: every field with a row, its last axis of the drift, for each point."""

    def __post_init__(self) -> None:
        """The cameras' own fields are known to be good."""

    @classmethod
    def of(cls, corrections: Sequence[Correction], view: IntArray) -> Corrections:
        """Return the motion of point n by the correction of camera `view[n]`; their drifts are of one degree."""
        rows: dict[str, Any] = {
            name: np.array([getattr(one, name) for one in corrections])[view] for name in field_names(Correction)
        }
        return cls(**rows | {"drift": np.moveaxis(rows["drift"], 0, -1)})

    def _turned(self, columns: Array, back: bool = False) -> Array:
        return np.asarray(np.einsum("nji,jn->in" if back else "nij,jn->in", self._matrix, columns))


def correction_of(matrix: Array, at: Array) -> Correction:
    """Return the correction of a camera whose ground was moved: it shows X where it showed X before the motion.

    Parameters
    ----------
    matrix : (3, 4), [s R | t]: the motion X -> s R X + t, ECEF [m]
    at : (3,), a point of the scene [m], ECEF, which moves as the matrix says to the last digit
    """
    from scipy.spatial.transform import Rotation  # a third of a second, of motions alone

    left, stretch, right = np.linalg.svd(matrix[:, :3])  # the rotation that a rounded matrix is nearest to
    motion = matrix @ np.append(at, 1.0) - at
    turn = Rotation.from_matrix((left @ right).T).as_rotvec()
    return Correction(turn, motion, at, scale=1.0 / float(stretch.mean()))


@dataclass(frozen=True)
class Corrected(Behind):
    """P_BA: `sensor` behind `correction`; itself a `SensorModel`.

    Examples
    --------
    >>> rpc = barpc.read_rpc("data_samples/view_00.tif")
    >>> still = barpc.Correction(np.zeros(3), np.zeros(3), [7.1e6, 0.0, 0.0])
    >>> bool(np.allclose(barpc.Corrected(rpc, still).project([5.4, 43.3, 120.0]), rpc.project([5.4, 43.3, 120.0])))
    True
    """

    sensor: SensorModel  # the model as delivered, P
    correction: Correction  # R, T and C

    def project(self, ground: Array, near: Array | None = None) -> Array:
        """Project ground points (..., 3) [deg, deg, m] to image points (..., 2) [px], starting from `near`."""
        ecef = ecef_from_ground(ground)
        if not len(self.correction.drift):
            return self.sensor.project(ground_from_ecef(self.correction.apply(ecef)))

        def seen(image: Array) -> Array:
            return self.sensor.project(ground_from_ecef(self.correction.apply(ecef, image[..., 1])))

        return fixed_point(seen, self.sensor.project(ground) if near is None else near)

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Return image points (..., 2) [px] and their derivatives (..., 2, 3) [px/deg, px/deg, px/m]."""
        image, by_ecef, _, _ = self.project_ecef(ecef_from_ground(ground))
        return image, by_ecef @ ecef_from_ground_jacobian(ground)

    def project_ecef(self, ecef: Array) -> tuple[Array, Array, Array, Array]:
        """Project ECEF points X (..., 3) [m] to image points (..., 2) [px], with an adjustment's derivatives.

        d(image)/dX [px/m], d(image)/dR [px/rad], d(image)/dT [px/m], (..., 2, 3) each.
        """
        ecef = np.asarray(ecef, dtype=np.float64)
        columns, shape = np.ascontiguousarray(ecef.reshape(-1, 3).T), ecef.shape[:-1]
        row = None
        if len(self.correction.drift):
            row = self.project(ground_from_ecef(columns.T))[:, 1]
        motion = self.correction.motion(columns, row)
        ground = ground_from_ecef(motion.ecef.T)
        image, by_ground = self.sensor.project_jacobian(ground)
        by_moved = np.moveaxis(by_ground @ ground_from_ecef_jacobian(ground), 0, -1)
        by_point, (by_rotation, by_drift) = motion.by_point(by_moved), motion.by_turns(by_moved)
        by_point *= self.correction.scale
        parts = [by_point, by_rotation, -by_point]
        if row is not None:  # the point moves the row, and the row the drift
            by_row = (by_drift * self.correction.drift_rate(row)).sum(axis=1)
            share = by_row / (1.0 - by_row[1])
            parts = [part + share[:, None] * part[1] for part in parts]
        by_ecef, of_rotation, of_translation = (np.moveaxis(part, -1, 0).reshape(*shape, 2, 3) for part in parts)
        return image.reshape(*shape, 2), by_ecef, of_rotation, of_translation

    def localize(self, image: Array, alt: Array) -> Array:
        """Localise image points (..., 2) [px] at altitudes (...) [m]: ground points (..., 3).

        Where the uncorrected sensor sees them, brought back; at the altitude from which the correction brings them to
        the one asked for. It turns by so little that each step gains four digits. NaN where that does not settle.
        """
        return pointwise(lambda *part: [self.localize_rows(*part)], [(3,)], as_image(image), alt)[0]

    def localize_rows(self, image: Array, alt: Array) -> Array:
        """Localise image points (n, 2) at altitudes (n,), all at once."""
        ground, off, asked = np.zeros((len(alt), 3)), alt, alt
        for step in range(NEWTON_STEPS):
            found = self.sensor.localize(image, asked)
            before, ground = ground, ground_from_ecef(self.correction.undo(ecef_from_ground(found), image[:, 1]))
            last, off = off, alt - ground[:, 2]
            if step and not (np.abs(off) > NEWTON_TOLERANCE).any():
                break
            asked = asked + off
        moved = ground - before  # along the ray, which is straight so near
        moved[:, 0] = wrap_longitude(moved[:, 0])
        ground += moved * np.where(last, off / last, 0.0)[:, None]
        ground[~(np.abs(off) <= NEWTON_TOLERANCE)] = np.nan
        ground[:, 2] = alt
        ground[:, 0] = wrap_longitude(ground[:, 0], found[:, 0])
        return ground
