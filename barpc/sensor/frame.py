"""A frame camera: one instant, one projective centre, radial distortion.

A ground point X is seen along p = R^T (X - C), C the centre and R = ecef_from_camera, under the
tangents u = p_xy / p_z.
A pixel lies at the place d = A (col, row, 1) of the focal plane, in focal lengths, and there u = d (1 - k(|d|^2)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from barpc.base.errors import RpcError
from barpc.base.geodesy import (
    NEWTON_STEPS,
    SETTLED,
    Array,
    ecef_from_ground,
    ecef_from_ground_jacobian,
    ground_from_ecef,
    reach,
    wrap_longitude,
)
from barpc.sensor import Pointwise


@dataclass(frozen=True, eq=False, repr=False)
class Frame(Pointwise):
    """A frame camera: itself a `SensorModel`.

    Parameters
    ----------
    center : (3,), projective centre [m], ECEF
    rotation : (3, 3), ecef_from_camera: columns are the camera's x, y and z, z towards the ground
    plane : (2, 3), (col, row, 1) [px] to the place in the focal plane, in focal lengths
    distortion : (K,), k as a polynomial of the squared distance from the axis, ascending powers

    Raises
    ------
    RpcError
        A wrong shape, a value that is not finite, a `rotation` that is none, a `plane` without area.
    """

    center: Array
    rotation: Array
    plane: Array
    distortion: Array

    def __post_init__(self) -> None:
        for name, shape in (
            ("center", (3,)),
            ("rotation", (3, 3)),
            ("plane", (2, 3)),
            ("distortion", (None,)),
        ):
            self._array(name, shape, RpcError)
        if np.abs(self.rotation @ self.rotation.T - np.eye(3)).max() > 1e-9 or np.linalg.det(self.rotation) < 0:
            raise RpcError("frame camera: rotation is not a rotation matrix")
        if not abs(np.linalg.det(self.plane[:, :2])) > 0:
            raise RpcError("frame camera: plane has no area")

    def _project(self, ground: Array) -> Array:
        return self._seen(ecef_from_ground(ground).T)[0].T

    def _localize(self, image: Array, alt: Array) -> Array:
        at = self.plane @ np.vstack([image.T, np.ones(len(image))])
        tangents = at * (1.0 - polyval((at**2).sum(axis=0), self.distortion))
        ray = self.rotation @ np.vstack([tangents, np.ones(len(image))])
        origin = np.broadcast_to(self.center[:, None], ray.shape)
        ground = reach(origin, ray / np.sqrt((ray * ray).sum(axis=0)), alt)
        ground[:, 0] = wrap_longitude(ground[:, 0], float(ground_from_ecef(self.center)[0]))
        return ground

    def _seen(self, ecef: Array) -> tuple[Array, Array, Array]:
        """Return the image points (2, N), places in the focal plane (2, N) and vectors in the camera (3, N)
        of ECEF points.
        """
        p = self.rotation.T @ (ecef - self.center[:, None])
        tangents = p[:2] / np.where(p[2] > 0, p[2], np.nan)
        at = tangents * self._farther(np.sqrt((tangents**2).sum(axis=0)))
        return np.asarray(np.linalg.solve(self.plane[:, :2], at - self.plane[:, 2:]), np.float64), at, p

    def _farther(self, radius: Array) -> Array:
        """Return the factor (N,) by which a place in the focal plane is farther out than the tangents; NaN if
        nowhere.
        """
        slope, found = polyder(self.distortion), radius
        settled = SETTLED * float(np.abs(self.plane[:, :2]).max())  # focal lengths
        step = np.zeros_like(radius)
        for _ in range(NEWTON_STEPS):
            square = found**2
            left = found * (1.0 - polyval(square, self.distortion)) - radius
            rate = 1.0 - polyval(square, self.distortion) - 2.0 * square * polyval(square, slope)
            step = left / np.where(rate > 0, rate, np.nan)
            found = found - step
            if not (np.abs(step) > settled).any():
                break
        found = np.where(np.abs(step) <= settled, found, np.nan)
        return np.asarray(found / np.where(radius > 0, radius, 1.0))  # in the middle any factor is right

    def _derivatives(self, ground: Array) -> tuple[Array, ...]:
        image, at, p = self._seen(ecef_from_ground(ground).T)
        square = (at**2).sum(axis=0)
        size = 1.0 - polyval(square, self.distortion)
        bend = -2.0 * polyval(square, polyder(self.distortion))
        by_place = size * np.eye(2)[:, :, None] + bend * at[:, None] * at[None]  # d tangent / d place (2, 2, N)
        tangents = p[:2] / p[2]
        rows = np.stack([self.rotation[:, k, None] - tangents[k] * self.rotation[:, 2, None] for k in range(2)]) / p[2]
        by_image = np.einsum("ijn,jk->nik", by_place, self.plane[:, :2])
        jacobian = np.linalg.solve(by_image, np.moveaxis(rows, 2, 0)) @ ecef_from_ground_jacobian(ground)
        return image.T, jacobian
