"""Simpler cameras near an RPC: affine, a projective matrix, a pinhole without skew; each with its largest error.

All of them see points in metres east, north, up of the scene's origin, and image points as barpc counts them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import rq

from barpc.geodesy import Array

_STEPS = 40  # of Levenberg's method
_REWEIGHTED = 8
_TIMES = 1.0, 2.0, 3.0  # an image that is affine along its flight is best seen from farther away than it was


@dataclass(frozen=True, eq=False)
class Sampled:
    """Points (N, 3) of the scene [m] and where an image shows them (N, 2) [px]."""

    world: Array
    image: Array

    def error(self, projected: Array) -> float:
        """Return the largest distance [px] of projections (N, 2) from where the image shows the points."""
        return float(np.linalg.norm(projected - self.image, axis=1).max())


@dataclass(frozen=True, eq=False)
class Pinhole:
    """K (R X + t): rotation (3, 3) and translation (3,) of the world into right, down, forward; K without skew."""

    focal: Array  # (2,) [px]
    center: Array  # (2,) principal point [px], seldom inside the image: it takes the place of a skew
    rotation: Array
    translation: Array

    def project(self, world: Array) -> Array:
        """Return the image points (N, 2) [px] of points (N, 3) [m]."""
        seen = world @ self.rotation.T + self.translation
        return np.asarray(seen[:, :2] / seen[:, 2:] * self.focal + self.center)


def fit_affine(samples: Sampled) -> Array:
    """Return the matrix (2, 4) of (X, Y, Z, 1), by least squares."""
    scale = np.abs(samples.world).max()
    rows = np.column_stack([samples.world / scale, np.ones(len(samples.world))])
    found = np.linalg.lstsq(rows, samples.image)[0].T
    return np.asarray(found / [scale, scale, scale, 1.0])


def project_affine(matrix: Array, world: Array) -> Array:
    """Return the image points (N, 2) [px]."""
    return np.asarray(world @ matrix[:, :3].T + matrix[:, 3])


def fit_projective(samples: Sampled) -> Array:
    """Return the matrix (3, 4) of a pinhole with skew, 1 in its last place: least squares, weighted with its depths."""
    scale, middle = np.abs(samples.world).max(), samples.image.mean(axis=0)
    reach = np.abs(samples.image - middle).max()
    world, image = samples.world / scale, (samples.image - middle) / reach
    rows = np.zeros((2, len(world), 11))
    for axis in (0, 1):
        rows[axis, :, 4 * axis : 4 * axis + 3], rows[axis, :, 4 * axis + 3] = world, 1.0
        rows[axis, :, 8:] = -image[:, axis, None] * world
    goal, depth = image.T, np.ones(len(world))
    for _ in range(_REWEIGHTED):
        weighted = (rows / depth[:, None]).reshape(-1, 11)
        found = np.linalg.lstsq(weighted, (goal / depth).ravel(), rcond=1e-15)[0]
        depth = 1.0 + world @ found[8:]
    matrix = np.append(found, 1.0).reshape(3, 4) / [scale, scale, scale, 1.0]
    back = np.array([[reach, 0.0, middle[0]], [0.0, reach, middle[1]], [0.0, 0.0, 1.0]])
    return np.asarray(back @ matrix)


def project_projective(matrix: Array, world: Array) -> Array:
    """Return the image points (N, 2) [px]."""
    seen = world @ matrix[:, :3].T + matrix[:, 3]
    return np.asarray(seen[:, :2] / seen[:, 2:])


def factored(matrix: Array) -> tuple[Array, Array, Array]:
    """Return K (3, 3) with its skew, rotation, translation of a projective matrix: K [R | t] in proportion to it."""
    calibration, rotation = rq(matrix[:, :3])
    signs = np.where(np.diag(calibration) < 0, -1.0, 1.0)
    calibration, rotation = calibration * signs, signs[:, None] * rotation
    turn = np.sign(np.linalg.det(rotation))
    translation = np.linalg.solve(calibration, matrix[:, 3]) * turn
    return calibration / calibration[2, 2], turn * rotation, translation


def fit_pinhole(samples: Sampled, at: Array, pixel: Array, rows: Array, sight: Array, far: float) -> Pinhole:
    """Return the nearest pinhole camera without skew.

    Parameters
    ----------
    at, pixel : (3,), (2,), a point in the middle of the scene [m] and where the image shows it [px]
    rows : (2, 3), derivative of the image point there [px/m]
    sight : (3,), unit vector to the sensor there
    far : float, distance of the sensor [m]
    """
    starts = [_start(sign, at, pixel, rows, sight, times * far) for times in _TIMES for sign in (1.0, -1.0)]
    found = [_refined(start, samples) for start in starts]
    return min(found, key=lambda pinhole: samples.error(pinhole.project(samples.world)))


def _start(sign: float, at: Array, pixel: Array, rows: Array, sight: Array, far: float) -> Pinhole:
    """Return the pinhole of a derivative: axes that are not perpendicular are seen far from the principal point."""
    length = np.linalg.norm(rows, axis=1)
    axes = rows / length[:, None]
    mirrored = 1.0 if np.cross(axes[0], axes[1]) @ sight < 0 else -1.0
    axes[1] *= mirrored
    skew = float(axes[0] @ axes[1])
    a = sign * np.sqrt(abs(skew) / (1.0 - abs(skew)))
    ray = np.array([a, np.copysign(a, a * skew) if skew else 0.0, 1.0])  # to the point, in the camera
    size = np.linalg.norm(ray)
    tilted = np.array([[1.0, 0.0, -ray[0]], [0.0, 1.0, -ray[1]], ray / size])
    long = np.linalg.norm(tilted[:2], axis=1)
    left, _, right = np.linalg.svd(np.linalg.solve(tilted, np.vstack([axes * long[:, None], -sight])))
    rotation, depth = left @ right, far / size
    focal = length * depth / long * [1.0, mirrored]
    return Pinhole(focal, pixel - focal * ray[:2], rotation, -rotation @ (at + far * sight))


def _refined(start: Pinhole, samples: Sampled) -> Pinhole:
    """Return the least squares solution, by Levenberg's method on small turn, move, focal lengths, principal point."""
    pinhole, damping = start, 1e-3
    cost, left = _cost(pinhole, samples)
    for _ in range(_STEPS):
        jacobian = _jacobian(pinhole, samples.world)
        scale = np.linalg.norm(jacobian, axis=0)
        system = np.vstack([jacobian / scale, np.sqrt(damping) * np.eye(10)])
        step = np.linalg.lstsq(system, np.append(left, np.zeros(10)), rcond=1e-15)[0] / scale
        tried = _moved(pinhole, step)
        now, rest = _cost(tried, samples)
        if now < cost:
            done = cost - now <= 1e-12 * cost
            pinhole, cost, left, damping = tried, now, rest, damping * 0.1
            if done:
                break
        else:
            damping *= 10.0
    return pinhole


def _cost(pinhole: Pinhole, samples: Sampled) -> tuple[float, Array]:
    left = (samples.image - pinhole.project(samples.world)).ravel()
    return float(left @ left) if np.isfinite(left).all() else np.inf, left


def _jacobian(pinhole: Pinhole, world: Array) -> Array:
    """Return the derivative (2 N, 10) of the projections by turn, translation, logarithms of focal lengths, centre."""
    turned = world @ pinhole.rotation.T
    x, y, depth = (turned + pinhole.translation).T
    out = np.zeros((len(world), 2, 10))
    for axis, over in enumerate((x, y)):
        by_point = np.zeros((len(world), 3))
        by_point[:, axis], by_point[:, 2] = 1.0 / depth, -over / depth**2
        by_point *= pinhole.focal[axis]
        out[:, axis, :3] = np.cross(turned, by_point)  # of a small turn w: w x (R X)
        out[:, axis, 3:6] = by_point
        out[:, axis, 6 + axis] = over / depth * pinhole.focal[axis]
        out[:, axis, 8 + axis] = 1.0
    return out.reshape(-1, 10)


def _moved(pinhole: Pinhole, step: Array) -> Pinhole:
    from barpc.sensor.curve import rotation_matrix

    turn = rotation_matrix(step[:3])
    return Pinhole(
        pinhole.focal * np.exp(step[6:8]),
        pinhole.center + step[8:],
        turn @ pinhole.rotation,
        pinhole.translation + step[3:6],
    )
