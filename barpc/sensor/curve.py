"""Position and attitude over time: vectors as polynomial pieces, and rotations by a rotation vector."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from numpy.polynomial import chebyshev

from barpc.base.errors import RpcError
from barpc.base.frozen import Frozen
from barpc.base.geodesy import NEWTON_STEPS, Array

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

EXTRAPOLATION = 1.0  # seconds beyond its knots that a curve is still believed
ORBIT_MARGIN = 70.0  # state vectors so far before and after the image take part in the fit of an orbit [s]
MIN_VECTORS = 4
ORBIT_DEGREES = range(5, 12)

_MAX_ORBIT_SCATTER = 1.0  # m: state vectors that scatter more are not one orbit
_UNSEEN = 1e-4  # m/s: at 900 km 1.6 us, the rounding of times and a thousandth of a line
_MIN_ORBIT_SIGMAS = np.array([1e-5, 1e-5, 1e-6])  # m, m, m/s: no standard deviation is smaller
_DEGREE_GAIN = 1.5  # a higher degree must lower the residual across the track by this factor


@dataclass(frozen=True, eq=False, repr=False)
class Curve(Frozen):
    """A piecewise polynomial of time with values in three dimensions."""

    knots: Array  # (M + 1,): times [s], ascending; piece m holds between knots m and m + 1
    coeffs: Array  # (M, K, 3): piece m is the sum over k of coeffs[m, k] (t - knots[m])^k
    _table: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        knots = self._array("knots", (None,), RpcError)
        coeffs = self._array("coeffs", (len(knots) - 1, None, 3), RpcError)
        if not (np.diff(knots) > 0).all():
            raise RpcError("Curve knots: they must ascend")
        power = np.arange(1, coeffs.shape[1])[:, None]
        table = np.zeros((9, coeffs.shape[1], len(coeffs)))  # value, rate, acceleration by power and piece
        table[:3] = coeffs.transpose(2, 1, 0)
        table[3:6, :-1] = table[:3, 1:] * power
        table[6:, :-1] = table[3:6, 1:] * power
        self._keep("_table", table)

    @classmethod
    def polynomial(cls, coeffs: npt.ArrayLike, start: float, stop: float) -> Curve:
        """Return one polynomial, sum over k of coeffs[k] (t - start)^k, used from `start` to `stop` [s]."""
        return cls(np.array([start, stop]), np.asarray(coeffs, dtype=np.float64)[None])

    @classmethod
    def through(cls, times: npt.ArrayLike, values: npt.ArrayLike, degree: int = 5) -> Curve:
        """Return the spline through samples: smooth to the second but one derivative, not-a-knot at its ends.

        `values` (N, 3) are positions [m] or rotation vectors [rad]; `degree` is 3 or 5, less where there are too few
        samples. A quintic through positions every 10 s is true to 1e-4 m between them. RpcError for fewer than two
        samples, times that do not ascend, numbers that are not finite.
        """
        times, values = np.asarray(times, dtype=np.float64), np.asarray(values, dtype=np.float64)
        if times.ndim != 1 or len(times) < 2 or values.shape != (len(times), 3):
            raise RpcError(f"curve: {values.shape} values at {times.shape} times; two samples or more needed")
        if not (np.isfinite(times).all() and np.isfinite(values).all() and (np.diff(times) > 0).all()):
            raise RpcError("curve: sample times must ascend and all numbers must be finite")
        from scipy.interpolate import make_interp_spline  # a third of a second, which RPCs do not need

        order = min(degree, len(times) - 1)
        spline = make_interp_spline(times, values, k=order - (order + 1) % 2)
        knots = np.unique(spline.t)
        taylor = [spline(knots[:-1], nu=k) / math.factorial(k) for k in range(spline.k + 1)]
        return cls(knots, np.stack(taylor, axis=1))

    @property
    def span(self) -> tuple[float, float]:
        """First and last time [s] at which the curve is used."""
        return float(self.knots[0]) - EXTRAPOLATION, float(self.knots[-1]) + EXTRAPOLATION

    def __call__(self, time: Array) -> tuple[Array, Array]:
        """Values (3, N) and their derivatives by time (3, N) at times (N,) [s]."""
        out = self._evaluate(time, 6)
        return out[:3], out[3:]

    def states(self, time: Array) -> tuple[Array, Array, Array]:
        """Return the position, velocity and acceleration (3, N) at times (N,) [s]."""
        out = self._evaluate(time, 9)
        return out[:3], out[3:6], out[6:]

    def _evaluate(self, time: Array, count: int) -> Array:
        """Return the first `count` rows of the table's polynomials (count, N)."""
        table = self._table[:count]
        if len(self.coeffs) == 1:  # one matrix product: a fifth of the time of Horner's scheme
            dt = time - self.knots[0]
            powers = np.ones((table.shape[1], len(time)))
            for k in range(1, len(powers)):
                np.multiply(powers[k - 1], dt, out=powers[k])
            return np.asarray(table[:, :, 0] @ powers)
        piece = np.searchsorted(self.knots[1:-1], time, side="right")
        dt = time - self.knots[piece]
        out = table[:, -1].take(piece, axis=1)
        for k in range(table.shape[1] - 2, -1, -1):
            out *= dt
            out += table[:, k].take(piece, axis=1)
        return out


def about_middle(rotations: Rotation) -> tuple[Array, Array]:
    """Return the middle (3, 3) of N rotations and the vectors (N, 3) [rad] of all from there, in its axes."""
    middle = rotations[len(rotations) // 2]
    return np.asarray(middle.as_matrix()), np.asarray((middle.inv() * rotations).as_rotvec())


def attitude_through(times: npt.ArrayLike, quaternions: npt.ArrayLike) -> tuple[Array, Curve]:
    """Return the attitude from quaternions: axes at the middle sample, and the rotation vector from there.

    Parameters
    ----------
    times : (N,) [s], ascending
    quaternions : (N, 4), ecef_from_camera, scalar first; of any sign and length but zero

    Returns
    -------
    mount : (3, 3), ecef_from_camera at the middle sample
    attitude : Curve, rotation vector [rad] in the axes of `mount`: a cubic spline

    RpcError for a quaternion that is zero or not finite, an attitude that turns by more than 2 rad from the middle.
    """
    from scipy.spatial.transform import Rotation

    q = np.asarray(quaternions, dtype=np.float64)
    if q.ndim != 2 or q.shape[1] != 4 or not (np.isfinite(q).all() and q.any(axis=1).all()):
        raise RpcError(f"attitude: quaternions {q.shape} must be finite, not zero, four numbers each")
    mount, vectors = about_middle(Rotation.from_quat(q, scalar_first=True))
    if np.linalg.norm(vectors, axis=1).max() > 2.0:
        raise RpcError("attitude: it turns by more than 2 rad; cut the samples to the image")
    return mount, Curve.through(times, vectors, degree=3)


@dataclass(frozen=True, eq=False)
class Orbit(Curve):
    """The polynomial through state vectors, and the velocity that they state where it is not its derivative."""

    sigma: Array  # (3,): standard deviations of positions along and across the track [m], of velocities [m/s]
    stated: Array  # (K, 3): stated velocity less derivative [m/s], as a polynomial of the time from the first knot

    def __post_init__(self) -> None:
        super().__post_init__()
        self._array("sigma", (3,), RpcError)
        more, table = self._array("stated", (None, 3), RpcError), self._table.copy()
        table[3:6, : len(more), 0] += more.T
        table[6:, : len(more) - 1, 0] += (more[1:] * np.arange(1, len(more))[:, None]).T
        self._keep("_table", table)


def fit_orbit(time: Array, position: Array, velocity: Array, window: tuple[float, float]) -> Orbit:
    """Return the orbit through state vectors around the time of an image: one polynomial of time.

    Least squares on positions AND velocities. How far each can be trusted differs from product to product
    (Sentinel-1: positions to 2e-6 m in auxiliary products and 2e-4 m in downlinked ones, velocities to 1e-5 and
    6e-3 m/s, and where the annotated times, whole microseconds, are not the true ones, positions ALONG the track
    to 3 mm only), so the standard deviations of positions along the track and across it and of velocities are
    estimated along with the orbit, from the residuals. The degree is the lowest of `ORBIT_DEGREES` that no higher one
    betters by more than half in the residual ACROSS the track: about 5 for downlinked vectors, 6
    for auxiliary ones, more for a long span. Along the track a high degree would follow the rounding of the times.

    Velocities are those that are stated: of downlinked vectors not the derivatives of their positions, by 4 to 17 mm/s
    that change smoothly. The processor's zero Doppler goes by them (as SNAP's does): by the derivatives rows are 0.01
    to 0.23 lines off the product's own grid, up to 2 m; by a quadratic for the difference, where that explains it, 1e-4
    (1e-3 in stripmap).

    Parameters
    ----------
    time : (N,) [s from the epoch]
    position, velocity : (N, 3), ECEF [m, m/s]
    window : (float, float), first and last time of the image [s]; vectors within `ORBIT_MARGIN` of it are used

    Raises
    ------
    RpcError
        Fewer than `MIN_VECTORS` vectors, an image more than `EXTRAPOLATION` beyond them, or no one orbit.
    """
    time, first = np.unique(time, return_index=True)
    use = (time >= window[0] - ORBIT_MARGIN) & (time <= window[1] + ORBIT_MARGIN)
    time, position, velocity = time[use], position[first][use], velocity[first][use]
    if len(time) < MIN_VECTORS:
        raise RpcError(
            f"orbit: {len(time)} state vectors within {ORBIT_MARGIN:g} s of the image, at least {MIN_VECTORS} "
            "needed; give a precise orbit file of that day"
        )
    if window[0] < time[0] - EXTRAPOLATION or window[1] > time[-1] + EXTRAPOLATION:
        raise RpcError(
            f"orbit: the image lasts from {window[0]:.1f} to {window[1]:.1f} s, the state vectors from "
            f"{time[0]:.1f} to {time[-1]:.1f} s; give a precise orbit file that covers it"
        )
    fits = [
        _fit_orbit(time, position, velocity, degree) for degree in sorted({min(d, len(time)) for d in ORBIT_DEGREES})
    ]
    limit = _DEGREE_GAIN * min(float(fit.sigma[1]) for fit in fits)
    orbit = next(fit for fit in fits if fit.sigma[1] <= limit)
    if not orbit.sigma[:2].max() <= _MAX_ORBIT_SCATTER:
        raise RpcError(f"orbit: the state vectors scatter by {orbit.sigma.max():.3g} m about any smooth orbit")
    return orbit


def _fit_orbit(time: Array, position: Array, velocity: Array, degree: int) -> Orbit:
    """Return the least squares of one degree, weighted by the standard deviations that its own residuals show."""
    half = 0.5 * (time[-1] - time[0])
    x = (time - time[0]) / half - 1.0
    basis = chebyshev.chebvander(x, degree)
    slope = chebyshev.chebval(x, chebyshev.chebder(np.eye(degree + 1))).T / half
    along = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    groups = [  # observations along directions (N, C, 3): rows (N C), columns (D + 1, 3)
        (np.einsum("nci,nd->ncdi", directions, functions).reshape(-1, 3 * (degree + 1)), values.ravel())
        for directions, functions, values in (
            (along[:, None, :], basis, (along * position).sum(axis=1)),
            (across, basis, np.einsum("nij,nj->ni", across, position)),
            (np.broadcast_to(np.eye(3), across.shape), slope, velocity),
        )
    ]
    share = 1.0 - 0.5 * (degree + 1) / len(time)  # of the observations that the unknowns leave over
    count = len(time) * np.array([1.0, 2.0, 3.0]) * share
    sigma = np.ones(3)
    for _ in range(NEWTON_STEPS):
        matrix = np.concatenate([a / s for (a, _), s in zip(groups, sigma, strict=True)])
        target = np.concatenate([y / s for (_, y), s in zip(groups, sigma, strict=True)])
        scale = np.linalg.norm(matrix, axis=0)
        solution = np.linalg.lstsq(matrix / scale, target, rcond=None)[0] / scale
        squares = np.array([((y - a @ solution) ** 2).sum() for a, y in groups])
        sigma = np.maximum(np.sqrt(squares / count), _MIN_ORBIT_SIGMAS)
    series = solution.reshape(degree + 1, 3)
    taylor, derivative = [], series
    for k in range(degree + 1):
        taylor.append(chebyshev.chebval(-1.0, derivative) / (half**k * math.factorial(k)))
        derivative = chebyshev.chebder(derivative)
    lacking = velocity - chebyshev.chebval(x, chebyshev.chebder(series)).T / half
    quadratic = (time - time[0])[:, None] ** np.arange(3)
    stated = np.linalg.lstsq(quadratic, lacking, rcond=None)[0]
    left, free = lacking - quadratic @ stated, max(len(time) - 3, 1) / len(time)
    if not np.sqrt((lacking**2).mean()) > _DEGREE_GAIN * max(_UNSEEN, np.sqrt((left**2).mean() / free)):
        stated = np.zeros((1, 3))
    return Orbit(time[[0, -1]], np.array(taylor)[None], sigma, stated)


class Turn:
    """Rotations exp([w]x) of rotation vectors w (..., 3, N) [rad], and their derivatives."""

    def __init__(self, w: Array) -> None:
        x = (w * w).sum(axis=-2, keepdims=True)  # the angles, squared
        self._w = w
        self._largest = float(x.max(initial=0.0))
        self._a: Array | float = 1.0
        self._b: Array | float = 0.5
        self._c: Array | float = 1.0 / 6.0
        if self._largest < 1e-10:  # to the rounding of what is turned
            return
        if self._largest < 1e-4:  # sin(a)/a, (1 - cos a)/a^2, (a - sin a)/a^3: to 3e-16
            self._a, self._b, self._c = 1 - x / 6 * (1 - x / 20), 0.5 - x / 24 * (1 - x / 30), 1 / 6 - x / 120
            return
        angle = np.sqrt(x)
        self._a = np.sinc(angle / np.pi)
        self._b = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2  # without cancellation
        with np.errstate(all="ignore"):
            self._c = np.where(x > 1e-4, (1.0 - self._a) / x, 1.0 / 6 - x / 120)

    def forth(self, v: Array) -> Array:
        """Return exp([w]x) v, vectors (..., 3, N) rotated (Rodrigues)."""
        bent = cross(self._w, v)
        return np.asarray(v + self._a * bent + self._b * cross(self._w, bent))

    def back(self, v: Array, error: float = 0.0) -> Array:
        """Return exp(-[w]x) v, vectors (..., 3, N) rotated back."""
        bent = cross(self._w, v)
        if self._largest < error:
            return np.asarray(v - bent)
        return np.asarray(v - self._a * bent + self._b * cross(self._w, bent))

    def back_and_rate(self, v: Array, error: float) -> tuple[Array, Array]:
        """Return `back` and `rate` of the same vectors."""
        bent = cross(self._w, v)
        if self._largest < error:
            return v - bent, v - 0.5 * bent
        twice = cross(self._w, bent)
        return v - self._a * bent + self._b * twice, v - self._b * bent + self._c * twice

    def rate(self, v: Array) -> Array:
        """Return the right Jacobian times v (..., 3, N): to first order exp([w + v]x) is exp([w]x) exp([rate]x)."""
        bent = cross(self._w, v)
        return np.asarray(v - self._b * bent + self._c * cross(self._w, bent))


def rotation_matrix(rotation: npt.ArrayLike) -> Array:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    return Turn(np.asarray(rotation, dtype=np.float64)[..., None]).forth(np.eye(3))


def rotation_left_jacobian(rotation: npt.ArrayLike) -> Array:
    """Return the left Jacobians J (..., 3, 3) of vectors w (..., 3) [rad]: R(w + dw) is R(J dw) R(w) to first order."""
    return Turn(-np.asarray(rotation, dtype=np.float64)[..., None]).rate(np.eye(3))


def cross(a: Array, b: Array) -> Array:
    """Return the cross products along the last axis but one of (..., 3, N) arrays, broadcast."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(a[..., j, :], b[..., k, :], out=out[..., i, :])
        out[..., i, :] -= a[..., k, :] * b[..., j, :]
    return out
