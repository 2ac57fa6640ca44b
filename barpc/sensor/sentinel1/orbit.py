"""The satellite's orbit: one polynomial of time through the annotated state vectors.

Least squares on positions AND velocities, in Chebyshev polynomials of the time span. Positions are the
exact part (2e-6 m against a smooth orbit in auxiliary products, 2e-4 m in downlinked ones), velocities the
noisy part (1e-5 and 6e-3 m/s), so a metre per second counts as a metre: with equal weights by time span
the noise of downlinked velocities moves the orbit by centimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from barpc.errors import RpcError
from barpc.geodesy import Array
from barpc.sensor.sentinel1.record import Record

MARGIN = 70.0
"""State vectors so far before and after the image take part in the fit [s]."""
EXTRAPOLATION = 1.0
"""An orbit is used so far beyond its first and last state vector [s]."""
MIN_VECTORS = 4
MAX_DEGREE = 11

_TOLERANCE = 1.0  # m: state vectors that scatter more are not one orbit
_FLOOR = 2e-5  # m: a residual across the track that no pixel sees
_GAIN = 1.5  # a higher degree must lower the residual across the track by this factor


@dataclass(frozen=True, eq=False)
class Orbit(Record):
    """Position as a polynomial of time.

    Parameters
    ----------
    coeffs : (D + 1, 3)
        ECEF position [m], ascending powers of x = (t - center) / half.
    center, half : float
        Middle and half length of the time span [s from the epoch of the model].
    rms : float
        Residual of the state vectors' positions, per degree of freedom [m].
    """

    coeffs: Array
    center: float
    half: float
    rms: float

    @property
    def degree(self) -> int:
        """Degree of the polynomial."""
        return len(self.coeffs) - 1

    @property
    def span(self) -> tuple[float, float]:
        """First and last time that the orbit is used for [s]."""
        return self.center - self.half - EXTRAPOLATION, self.center + self.half + EXTRAPOLATION

    def states(self, time: Array) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration.

        Parameters
        ----------
        time : (N,)
            [s from the epoch].

        Returns
        -------
        position, velocity, acceleration : (3, N)
            ECEF [m, m/s, m/s^2].
        """
        powers = np.empty((len(self.coeffs), len(time)))
        powers[0] = 1.0
        powers[1] = (time - self.center) / self.half
        for k in range(2, len(powers)):
            np.multiply(powers[k - 1], powers[1], out=powers[k])
        out = self._derivatives @ powers
        return out[0:3], out[3:6], out[6:9]

    @property
    def _derivatives(self) -> Array:
        """(9, D + 1): position, velocity, acceleration on the powers of x."""
        k = np.arange(len(self.coeffs))
        first, second = np.zeros_like(self.coeffs), np.zeros_like(self.coeffs)
        first[:-1] = self.coeffs[1:] * k[1:, None] / self.half
        second[:-2] = self.coeffs[2:] * (k[2:] * (k[2:] - 1))[:, None] / self.half**2
        return np.concatenate([self.coeffs.T, first.T, second.T])


def fit_orbit(time: Array, position: Array, velocity: Array, window: tuple[float, float]) -> Orbit:
    """The orbit through state vectors, around the time of an image.

    The degree is the lowest that no higher one (to `MAX_DEGREE`) betters by more than half in the
    residual ACROSS the track: about 5 for downlinked vectors, 6 for auxiliary ones, more for a long span.
    Along the track the annotated times, whole microseconds, leave 2 mm that a high degree would follow.

    Parameters
    ----------
    time : (N,)
        [s from the epoch].
    position, velocity : (N, 3)
        ECEF [m, m/s].
    window : (float, float)
        First and last time of the image [s]; vectors within `MARGIN` of it are used.

    Returns
    -------
    orbit : Orbit

    Raises
    ------
    RpcError
        Fewer than `MIN_VECTORS` vectors, an image more than `EXTRAPOLATION` beyond them, or vectors that
        are not one orbit.
    """
    time, first = np.unique(time, return_index=True)
    use = (time >= window[0] - MARGIN) & (time <= window[1] + MARGIN)
    time, position, velocity = time[use], position[first][use], velocity[first][use]
    if len(time) < MIN_VECTORS:
        raise RpcError(
            f"orbit: {len(time)} state vectors within {MARGIN:g} s of the image, at least {MIN_VECTORS} "
            "needed; give a precise orbit file of that day"
        )
    if window[0] < time[0] - EXTRAPOLATION or window[1] > time[-1] + EXTRAPOLATION:
        raise RpcError(
            f"orbit: the image lasts from {window[0]:.1f} to {window[1]:.1f} s, the state vectors from "
            f"{time[0]:.1f} to {time[-1]:.1f} s; give a precise orbit file that covers it"
        )
    degrees = range(3, min(MAX_DEGREE, len(time)) + 1)
    fits = [_fit(time, position, velocity, degree) for degree in degrees]
    limit = _GAIN * max(_FLOOR, min(across for _, across in fits))
    orbit = next(fit for fit, across in fits if across <= limit)
    if not orbit.rms <= _TOLERANCE:
        raise RpcError(f"orbit: the state vectors scatter by {orbit.rms:.3g} m about any smooth orbit")
    return orbit


def _fit(time: Array, position: Array, velocity: Array, degree: int) -> tuple[Orbit, float]:
    """Least squares of one degree, and the residual of the positions across the track [m]."""
    center, half = 0.5 * (time[0] + time[-1]), 0.5 * (time[-1] - time[0])
    x = (time - center) / half
    basis = chebyshev.chebvander(x, degree)
    slope = chebyshev.chebval(x, chebyshev.chebder(np.eye(degree + 1))).T / half
    matrix, target = np.concatenate([basis, slope]), np.concatenate([position, velocity])
    solution = np.linalg.lstsq(matrix, target, rcond=None)[0]
    rest = (target - matrix @ solution)[: len(time)]
    along = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
    across = rest - (rest * along).sum(axis=1, keepdims=True) * along
    freedom = len(target) - len(solution)
    total, side = (float(np.sqrt((r**2).sum() / freedom)) for r in (rest, across))
    powers = np.stack([chebyshev.cheb2poly(c) for c in _padded(solution)], axis=1)
    return Orbit(powers, float(center), float(half), total), side


def _padded(solution: Array) -> Array:
    """Coefficients (3, D + 1) whose last term is never exactly zero: cheb2poly would drop it."""
    out = solution.T.copy()
    out[:, -1] = np.where(out[:, -1] == 0, np.finfo(float).tiny, out[:, -1])
    return out
