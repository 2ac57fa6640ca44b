"""Rigorous cameras: pushbroom, by orbit, attitude, detector line of sight and line time, and frame.

A line of a pushbroom image is taken at one instant. At time t the camera stands at O(t) and its axes in ECEF are
A(t) = mount exp([w(t)]x), x along the scan, y along the detector line, z towards the ground. Column c looks
along A(t) (l_x(c), l_y(c), 1), l being two polynomials of the column. A ground point X is seen at (t, c) with

    p = A(t)^T (X - O(t)),    p_x / p_z = l_x(c),    p_y / p_z = l_y(c),

two equations that Newton's method solves with analytic derivatives; the derivative of (c, t) by X follows
from the same 2x2 system. Where light is bent on its way, X is lifted to where it seems to be from O(t), and p is
the direction in which the moving camera sees it (`Light`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from numpy.polynomial.polynomial import polyder, polyval

from barpc.base.errors import RpcError
from barpc.base.geodesy import (
    EARTH_RATE,
    NEWTON_TOLERANCE,
    SPEED_OF_LIGHT,
    WGS84_A,
    WGS84_B,
    Array,
    ecef_from_ground,
    ecef_from_ground_jacobian,
    ground_from_ecef,
    newton,
    reach,
    wrap_longitude,
)
from barpc.sensor import Pointwise
from barpc.sensor.curve import EXTRAPOLATION, Curve, Turn, cross

_AIR = 2.316  # m: of refraction at sea level, times tan z / cos^2 z of the zenith distance z (Noerdlinger 1999)
_AIR_HEIGHT = 8000.0  # m: in which the air thins to 1/e
_ELLIPSOID_QUADRIC = np.array([[WGS84_A], [WGS84_A], [WGS84_B]]) ** -2.0  # its quadric grows along the vertical
_BENDS = 3  # light is bent by 3e-5: each step gains four digits
_GRAZING = 0.1  # cosine of the zenith distance below which refraction is not this simple


@dataclass(frozen=True)
class Light:
    """Aberration and refraction of a camera's lines of sight.

    A moving camera sees a point in the direction of (X - O) / |X - O| + b, b = V / c: V is the camera's velocity in the
    inertial frame less that of the point, O' - omega x (X - O) in ECEF. Refraction lets a point seem farther from
    the nadir, by metres that fall with the air above it.
    """

    aberration: bool = False
    refraction: bool = False

    def seen(self, ecef: Array, origin: Array, velocity: Array) -> Array:
        """Return the apparent directions (3, N) [m] of points from places at velocities (3, N), ECEF."""
        sight = ecef - origin
        if self.refraction:
            sight = sight + self._lift(ecef, sight)[0]
        if self.aberration:
            sight = sight + np.sqrt((sight * sight).sum(axis=0)) * _drag(sight, velocity)
        return sight

    def by_point(self, gradient: Array, ecef: Array, origin: Array, velocity: Array) -> Array:
        """Return derivatives (3, N) by ground points from those by apparent directions, `gradient`, to 1e-6."""
        sight = ecef - origin
        out = gradient
        if self.aberration:
            along = sight / np.sqrt((sight * sight).sum(axis=0))
            out = out + along * (gradient * _drag(sight, velocity)).sum(axis=0)
        if self.refraction:
            lift, vertical = self._lift(ecef, sight)
            out = out - vertical * (gradient * lift).sum(axis=0) / _AIR_HEIGHT
        return out

    def _lift(self, ecef: Array, sight: Array) -> tuple[Array, Array]:
        """Return the apparent displacement by refraction (3, N) [m], and the vertical (3, N); NaN near the horizon.

        Altitudes are of the quadric through a point, to 1e-4 m up to 9 km; verticals of where it stands on the ground.
        """
        vertical = ecef * _ELLIPSOID_QUADRIC
        level = np.sqrt((ecef * vertical).sum(axis=0))
        length = np.sqrt((vertical * vertical).sum(axis=0))
        alt = (level - 1.0) * level / length
        vertical = (ecef - (alt / length) * vertical) * _ELLIPSOID_QUADRIC
        vertical = vertical / np.sqrt((vertical * vertical).sum(axis=0))
        along = sight / np.sqrt((sight * sight).sum(axis=0))
        cosine = -(vertical * along).sum(axis=0)
        with np.errstate(all="ignore"):
            size = _AIR * np.exp(-alt / _AIR_HEIGHT) / cosine**3
        return (along + cosine * vertical) * np.where(cosine > _GRAZING, size, np.nan), vertical


def _drag(sight: Array, velocity: Array) -> Array:
    """Return the velocity of a camera against the points (3, N) [m] away, over that of light."""
    carried = np.stack([-sight[1], sight[0], np.zeros(sight.shape[1])]) * EARTH_RATE
    return np.asarray((velocity - carried) / SPEED_OF_LIGHT)


STRAIGHT = Light()


def _check_rotation(matrix: Array, what: str) -> None:
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-9 or np.linalg.det(matrix) < 0:
        raise RpcError(f"{what} is not a rotation matrix")


@dataclass(frozen=True, eq=False, repr=False)
class Pushbroom(Pointwise):
    """A rigorous pushbroom camera: itself a `SensorModel`, believed a second (`EXTRAPOLATION`) beyond its samples.

    Parameters
    ----------
    orbit : Curve, position of the camera over time [m], ECEF
    attitude : Curve, rotation vector w over time [rad], in the axes of `mount`
    mount : (3, 3), ecef_from_camera where w = 0: columns are the camera's x, y and z
    look : (2, K), l_x and l_y as polynomials of (col - look_origin), ascending powers [1/px^k]
    look_origin : float, column [px] from which `look` counts
    line_period : float, time from one row to the next [s]; negative where the image was turned over
    first_line : float, time of row 0 [s]
    light : Light, bending of the line of sight
    accuracy : (float, float) or None, stated standard deviations of attitude, as metres on the ground, and position [m]

    Raises
    ------
    RpcError
        A wrong shape, a value that is not finite, a `mount` that is no rotation, a line period of zero.

    Examples
    --------
    >>> from barpc.simulate import fly, looks
    >>> camera = fly(np.array([5.4, 43.3, 120.0]), looks(3, 0.0)[0], (1000, 1000), 0.5)
    >>> camera.project([5.4, 43.3, 120.0]).round(1)
    array([499.5, 499.5])
    """

    orbit: Curve
    attitude: Curve
    mount: Array
    look: Array
    look_origin: float
    line_period: float
    first_line: float = 0.0
    light: Light = STRAIGHT
    accuracy: tuple[float, float] | None = None
    _lon: float = field(init=False, repr=False, default=0.0)

    def __post_init__(self) -> None:
        self._array("mount", (3, 3), RpcError)
        self._array("look", (2, None), RpcError)
        self._check()
        middle = [self.look_origin, (sum(self._span) / 2 - self.first_line) / self.line_period]
        with np.errstate(all="ignore"):
            center = self._localize(np.array([middle]), np.zeros(1))
        self._keep("_lon", float(np.nan_to_num(center[0, 0])))

    def _check(self) -> None:
        if self.look.shape[1] < 2:
            raise RpcError("pushbroom: look has no slope, expected (2, K) with K of two or more")
        if not np.isfinite((self.look_origin, self.line_period, self.first_line)).all():
            raise RpcError("pushbroom: all numbers must be finite")
        if self.line_period == 0:
            raise RpcError("pushbroom: a line period of zero")
        _check_rotation(self.mount, "pushbroom: mount")
        if not self._span[1] - self._span[0] > 2 * EXTRAPOLATION:
            raise RpcError("pushbroom: orbit and attitude share no time")

    @property
    def advice(self) -> str:
        """Remedy where no RPC represents this model; empty where its motion is one polynomial."""
        sampled = (
            "the attitude may oscillate within the image, which no RPC represents: raise the tolerance, fit a part, or"
            " write correction grids with 'barpc adjust --grids'"
        )
        return sampled if len(self.attitude.coeffs) > 1 else ""

    @property
    def _span(self) -> tuple[float, float]:
        """First and last time of validity of both curves [s]."""
        (a, b), (c, d) = self.orbit.span, self.attitude.span
        return max(a, c), min(b, d)

    def _told(self) -> str:
        start, end = self._span
        height = ground_from_ecef(self.position((np.mean(self._span) - self.first_line) / self.line_period))[2]
        period = f"{1e3 * self.line_period:.6g} ms a row"
        return f"{height / 1e3:.1f} km high, {period}, orbit and attitude for {end - start:.3g} s"

    def time(self, row: npt.ArrayLike) -> Array:
        """Time [s] of rows (...) [px]."""
        return self.first_line + self.line_period * np.asarray(row, dtype=np.float64)

    def position(self, row: npt.ArrayLike) -> Array:
        """Return the camera centres (..., 3) [m, ECEF] of rows (...) [px]."""
        time = self.time(row)
        return np.moveaxis(self.orbit(time.reshape(-1))[0], 0, -1).reshape(*time.shape, 3)

    def _project(self, ground: Array) -> Array:
        return self._solve(ecef_from_ground(ground).T).T

    def line_of_sight(self, image: Array) -> tuple[Array, Array]:
        """Return the camera centres [m] and unit directions of sight (..., 3), ECEF, of image points (..., 2)."""
        image = np.asarray(image, dtype=np.float64)
        origin, direction = self._rays(image.reshape(-1, 2))
        return origin.T.reshape(*image.shape[:-1], 3), direction.T.reshape(*image.shape[:-1], 3)

    def _rays(self, image: Array) -> tuple[Array, Array]:
        """Return the camera centres and unit directions of sight, (3, N), of image points (N, 2)."""
        time = self.time(image[:, 1])
        tangents = self._look(image[:, 0])[0]
        inside = np.stack([tangents[0], tangents[1], np.ones(len(time))])
        direction = self.mount @ Turn(self.attitude(time)[0]).forth(inside)
        direction /= np.sqrt((direction * direction).sum(axis=0))
        return self.orbit(time)[0], direction

    def _localize(self, image: Array, alt: Array) -> Array:
        """Return the ground points (N, 3) where lines of sight (N, 2) reach altitudes (N,).

        They meet the ellipsoid whose axes are longer by the altitude in closed form; Newton's method on the distance
        brings that to the altitude itself.
        """
        origin, seen = self._rays(image)
        time, (start, stop) = self.time(image[:, 1]), self._span
        ground = reach(origin, seen, alt)
        if self.light != STRAIGHT:
            velocity, direction = self.orbit(time)[1], seen
            for _ in range(_BENDS):
                bent = self.light.seen(ecef_from_ground(ground).T, origin, velocity)
                direction = direction + seen - bent / np.sqrt((bent * bent).sum(axis=0))
                ground = reach(origin, direction, alt)
        ground[:, 0] = wrap_longitude(ground[:, 0], self._lon)
        ground[~((time >= start) & (time <= stop))] = np.nan
        return ground

    def _look(self, col: Array) -> tuple[Array, Array]:
        """Return the tangents (2, N) of the line of sight and their derivatives by the column."""
        x = col - self.look_origin
        value = np.broadcast_to(self.look[:, -1:], (2, len(x)))
        rate = np.zeros((2, 1))
        for k in range(self.look.shape[1] - 2, -1, -1):
            rate = rate * x + value
            value = value * x + self.look[:, k : k + 1]
        return value, np.broadcast_to(rate, value.shape)

    def _seen(self, ecef: Array, time: Array) -> tuple[Array, Array, Array]:
        """Return the tangents (2, N) under which points (3, N) are seen at times (N,), their rates, and p_z (N,)."""
        origin, velocity = self.orbit(time)
        w, w_rate = self.attitude(time)
        turn = Turn(w)
        p = turn.back(self.mount.T @ self.light.seen(ecef, origin, velocity))
        p_rate = cross(p, turn.rate(w_rate)) - turn.back(self.mount.T @ velocity)
        tangents = p[:2] / p[2]
        return tangents, (p_rate[:2] - tangents * p_rate[2]) / p[2], p[2]

    def _solve(self, ecef: Array) -> Array:
        """Return the image points (2, N) of ECEF points (3, N): Newton on (col, row)."""
        start, stop = self._span
        depth = np.empty(0)

        def moved(found: Array) -> Array:
            nonlocal depth
            col, time = found
            tangents, rate, depth = self._seen(ecef, time)
            look, slope = self._look(col)
            miss = look - tangents
            det = rate[1] * slope[0] - rate[0] * slope[1]
            time = np.clip(time + (slope[0] * miss[1] - slope[1] * miss[0]) / det, start, stop)
            return np.stack([col + (rate[0] * miss[1] - rate[1] * miss[0]) / det, time])

        middle = np.repeat([[self.look_origin], [(start + stop) / 2]], ecef.shape[1], axis=1)
        (col, time), settled = newton(moved, middle, NEWTON_TOLERANCE * np.array([[1.0], [abs(self.line_period)]]))
        out = np.stack([col, (time - self.first_line) / self.line_period])
        out[:, ~(settled.all(axis=0) & (depth > 0) & (time > start) & (time < stop))] = np.nan
        return out

    def _derivatives(self, ground: Array) -> tuple[Array, ...]:
        ecef = ecef_from_ground(ground).T
        found = self._solve(ecef)
        return found.T, self._by_ecef(ecef, found) @ ecef_from_ground_jacobian(ground)

    def _by_ecef(self, ecef: Array, image: Array) -> Array:
        """Return d(col, row)/dX (N, 2, 3) [px/m] at ECEF points (3, N) seen at image points (2, N)."""
        time = self.time(image[1])
        turn, motion = Turn(self.attitude(time)[0]), self.orbit(time)
        tangents, rate, depth = self._seen(ecef, time)
        slope = self._look(image[0])[1]
        zero, one = np.zeros(len(time)), np.ones(len(time))
        by_x = self.light.by_point(
            self.mount @ turn.forth(np.stack([one, zero, -tangents[0]])) / depth, ecef, *motion
        )  # d(tangent x)/dX
        by_y = self.light.by_point(self.mount @ turn.forth(np.stack([zero, one, -tangents[1]])) / depth, ecef, *motion)
        det = rate[1] * slope[0] - rate[0] * slope[1]
        row = (slope[1] * by_x - slope[0] * by_y) / det / self.line_period
        col = (rate[1] * by_x - rate[0] * by_y) / det
        return np.moveaxis(np.stack([col, row]), 2, 0)


@dataclass(frozen=True, eq=False, repr=False)
class Frame(Pointwise):
    """A frame camera, one instant, one projective centre, radial distortion: itself a `SensorModel`.

    A ground point X is seen along p = R^T (X - C), C the centre and R = ecef_from_camera, under the tangents
    u = p_xy / p_z. A pixel lies at the place d = A (col, row, 1) of the focal plane, in focal lengths, and there
    u = d (1 - k(|d|^2)).

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
        for name, *shape in (("center", 3), ("rotation", 3, 3), ("plane", 2, 3), ("distortion", None)):
            self._array(name, tuple(shape), RpcError)
        _check_rotation(self.rotation, "frame camera: rotation")
        if not abs(np.linalg.det(self.plane[:, :2])) > 0:
            raise RpcError("frame camera: plane has no area")

    def _project(self, ground: Array) -> Array:
        return self._seen(ecef_from_ground(ground).T)[0].T

    def _localize(self, image: Array, alt: Array) -> Array:
        at = self.plane @ np.vstack([image.T, np.ones(len(image))])
        tangents = at * (1.0 - polyval((at**2).sum(axis=0), self.distortion))
        ray = self.rotation @ np.vstack([tangents, np.ones(len(image))])
        origin = np.broadcast_to(self.center[:, None], ray.shape)
        ground = reach(origin, ray, alt)
        ground[:, 0] = wrap_longitude(ground[:, 0], float(ground_from_ecef(self.center)[0]))
        return ground

    def _seen(self, ecef: Array) -> tuple[Array, Array, Array]:
        """Return image points (2, N), places in the focal plane (2, N), vectors in the camera (3, N)."""
        p = self.rotation.T @ (ecef - self.center[:, None])
        tangents = p[:2] / np.where(p[2] > 0, p[2], np.nan)
        at = tangents * self._farther(np.sqrt((tangents**2).sum(axis=0)))
        return np.asarray(np.linalg.solve(self.plane[:, :2], at - self.plane[:, 2:]), np.float64), at, p

    def _farther(self, radius: Array) -> Array:
        """Return how much (N,) farther out than its tangents a place in the focal plane is; NaN if nowhere."""
        slope, pixel = polyder(self.distortion), float(np.abs(self.plane[:, :2]).max())  # in focal lengths

        def farther(found: Array) -> Array:
            square = found**2
            left = found * (1.0 - polyval(square, self.distortion)) - radius
            rate = 1.0 - polyval(square, self.distortion) - 2.0 * square * polyval(square, slope)
            return found - left / np.where(rate > 0, rate, np.nan)

        found, settled = newton(farther, radius, NEWTON_TOLERANCE * pixel)
        # in the middle any factor is right
        return np.asarray(np.where(settled, found, np.nan) / np.where(radius > 0, radius, 1.0))

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
