"""The satellite's orbit: one polynomial of time through the annotated state vectors.

Least squares on positions AND velocities, in Chebyshev polynomials of the time span. How far each can be
trusted differs from product to product: positions to 2e-6 m in auxiliary products and 2e-4 m in downlinked
ones, velocities to 1e-5 and 6e-3 m/s, and where the annotated times, whole microseconds, are not the true
ones, positions ALONG the track to 3 mm only. So the standard deviations of positions along the track and
across it and of velocities are estimated along with the orbit, from the residuals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev

from barpc.errors import RpcError
from barpc.frozen import Frozen
from barpc.geodesy import Array

MARGIN = 70.0
"""State vectors so far before and after the image take part in the fit [s]."""
EXTRAPOLATION = 1.0
"""An orbit is used so far beyond its first and last state vector [s]."""
MIN_VECTORS = 4
MIN_DEGREE, MAX_DEGREE = 5, 11

_TOLERANCE = 1.0  # m: state vectors that scatter more are not one orbit
_FLOOR = 2e-5  # m: a residual across the track that no pixel sees
_DIGITS = np.array([1e-5, 1e-5, 1e-6])  # m, m, m/s: no standard deviation is smaller
_ROUNDS = 5  # of estimating them: they settle in three
_GAIN = 1.5  # a higher degree must lower the residual across the track by this factor


@dataclass(frozen=True, eq=False)
class Orbit(Frozen):
    """Position as a polynomial of time.

    Parameters
    ----------
    coeffs : (D + 1, 3)
        ECEF position [m], ascending powers of x = (t - center) / half.
    center, half : float
        Middle and half length of the time span [s from the epoch of the model].
    sigma : (3,)
        Standard deviations of the state vectors: positions along the track and across it [m], velocities
        [m/s].
    """

    coeffs: Array
    center: float
    half: float
    sigma: Array

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

    The degree is the lowest that no higher one (`MIN_DEGREE` to `MAX_DEGREE`) betters by more than half in the
    residual ACROSS the track: about 5 for downlinked vectors, 6 for auxiliary ones, more for a long span.
    Along the track a high degree would follow the rounding of the times.

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
    degrees = range(min(MIN_DEGREE, len(time)), min(MAX_DEGREE, len(time)) + 1)
    fits = [_fit(time, position, velocity, degree) for degree in degrees]
    limit = _GAIN * max(_FLOOR, min(float(fit.sigma[1]) for fit in fits))
    orbit = next(fit for fit in fits if fit.sigma[1] <= limit)
    if not orbit.sigma[:2].max() <= _TOLERANCE:
        raise RpcError(
            f"orbit: the state vectors scatter by {orbit.sigma.max():.3g} m about any smooth orbit"
        )
    return orbit


def _fit(time: Array, position: Array, velocity: Array, degree: int) -> Orbit:
    """Least squares of one degree, weighted by the standard deviations that its own residuals show."""
    center, half = 0.5 * (time[0] + time[-1]), 0.5 * (time[-1] - time[0])
    x = (time - center) / half
    basis = chebyshev.chebvander(x, degree)
    slope = chebyshev.chebval(x, chebyshev.chebder(np.eye(degree + 1))).T / half
    along = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    groups = [
        (_rows(along[:, None, :], basis), (along * position).sum(axis=1)),
        (_rows(across, basis), np.einsum("nij,nj->ni", across, position).ravel()),
        (_rows(np.broadcast_to(np.eye(3), across.shape), slope), velocity.ravel()),
    ]
    share = 1.0 - 0.5 * (degree + 1) / len(time)  # of the observations that the unknowns leave over
    count = len(time) * np.array([1.0, 2.0, 3.0]) * share
    sigma = np.ones(3)
    for _ in range(_ROUNDS):
        matrix = np.concatenate([a / s for (a, _), s in zip(groups, sigma, strict=True)])
        target = np.concatenate([y / s for (_, y), s in zip(groups, sigma, strict=True)])
        scale = np.linalg.norm(matrix, axis=0)
        solution = np.linalg.lstsq(matrix / scale, target, rcond=None)[0] / scale
        squares = np.array([((y - a @ solution) ** 2).sum() for a, y in groups])
        sigma = np.maximum(np.sqrt(squares / count), _DIGITS)
    powers = [chebyshev.cheb2poly(c) for c in _padded(solution.reshape(degree + 1, 3))]
    return Orbit(np.stack(powers, axis=1), float(center), float(half), sigma)


def _rows(directions: Array, basis: Array) -> Array:
    """Observation equations of components along (N, C, 3) `directions`: rows (N C), columns (D + 1, 3)."""
    rows: Array = directions[:, :, None, :] * basis[:, None, :, None]
    return rows.reshape(rows.shape[0] * rows.shape[1], -1)


def _padded(solution: Array) -> Array:
    """Coefficients (3, D + 1) whose last term is never exactly zero: cheb2poly would drop it."""
    out = solution.T.copy()
    out[:, -1] = np.where(out[:, -1] == 0, np.finfo(float).tiny, out[:, -1])
    return out
