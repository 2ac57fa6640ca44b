"""Image frames: (azimuth time, slant range time) to (col, row) and back.

Both frames count rows by a constant interval of zero-Doppler time from the epoch, the time of row 0. Times
and image points are (2, N) here: azimuth time [s] and two-way slant range time [s]; col and row [px].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barpc.frozen import Frozen
from barpc.geodesy import Array

SPEED_OF_LIGHT = 299792458.0
"""In vacuum [m/s]."""

_INVERSION_STEPS = 8


@dataclass(frozen=True, eq=False)
class SlantFrame(Frozen):
    """The frame of an SLC: columns at a constant interval of slant range time.

    Parameters
    ----------
    first_range_time : float
        Two-way slant range time of column 0 [s].
    sampling_rate : float
        Columns a second of two-way time [Hz].
    interval : float
        Azimuth time between rows [s].
    """

    first_range_time: float
    sampling_rate: float
    interval: float

    def image(self, times: Array) -> tuple[Array, Array]:
        """Image points (2, N) [px] of times (2, N) [s], and d(col, row)/d(times) (2, 2, N)."""
        out, slope = np.empty_like(times), np.zeros((2, *times.shape))
        out[0] = (times[1] - self.first_range_time) * self.sampling_rate
        out[1] = times[0] / self.interval
        slope[0, 1], slope[1, 0] = self.sampling_rate, 1.0 / self.interval
        return out, slope

    def times(self, image: Array) -> Array:
        """Times (2, N) [s] of image points (2, N) [px]."""
        return np.stack([image[1] * self.interval, image[0] / self.sampling_rate + self.first_range_time])


@dataclass(frozen=True, eq=False)
class GroundFrame(Frozen):
    """The frame of a GRD: columns at a constant interval of ground range.

    Ground range is a polynomial of slant range, whose coefficients and origin are interpolated linearly
    between the times they are listed for (Sentinel-1 Product Specification, "coordinate conversion").

    Parameters
    ----------
    interval : float
        Azimuth time between rows [s].
    spacing : float
        Ground range between columns [m].
    listed : (M,)
        Times of the polynomials [s from the epoch], ascending.
    origin : (M,)
        Slant range origins [m].
    coeffs : (M, K)
        Ascending powers of (slant range - origin) [m].
    slope : float
        Slant range a ground range at mid swath, roughly: where the inversion starts.
    """

    interval: float
    spacing: float
    listed: Array
    origin: Array
    coeffs: Array
    slope: float

    def image(self, times: Array) -> tuple[Array, Array]:
        """Image points (2, N) [px] of times (2, N) [s], and d(col, row)/d(times) (2, 2, N)."""
        metres = 0.5 * SPEED_OF_LIGHT
        ground, by_slant, by_time = self._ground_range(times[0], metres * times[1])
        out, slope = np.empty_like(times), np.zeros((2, *times.shape))
        out[0], out[1] = ground / self.spacing, times[0] / self.interval
        slope[0, 0], slope[0, 1] = by_time / self.spacing, by_slant * metres / self.spacing
        slope[1, 0] = 1.0 / self.interval
        return out, slope

    def times(self, image: Array) -> Array:
        """Times (2, N) [s] of image points (2, N) [px]: Newton on the polynomial."""
        time, target = image[1] * self.interval, image[0] * self.spacing
        slant = self.origin.mean() + target * self.slope
        for _ in range(_INVERSION_STEPS):
            ground, by_slant, _ = self._ground_range(time, slant)
            step = (target - ground) / by_slant
            slant = slant + step
            if not (np.abs(step).max(initial=0.0, where=np.isfinite(step)) > 1e-3):
                break  # quadratic: the next step is below rounding
        return np.stack([time, slant * (2.0 / SPEED_OF_LIGHT)])

    def _ground_range(self, time: Array, slant: Array) -> tuple[Array, Array, Array]:
        """Ground range (N,) [m] and its derivatives by slant range [m/m] and time [m/s]."""
        coeffs, rates, origin, drift = self._listed_at(time)
        u = slant - origin
        value, by_slant, by_time = np.zeros_like(u), np.zeros_like(u), np.zeros_like(u)
        for c, r in zip(coeffs[::-1], rates[::-1], strict=True):  # Horner, both derivatives alongside
            by_slant = by_slant * u + value
            value = value * u + c
            by_time = by_time * u + r
        return value, by_slant, by_time - drift * by_slant

    def _listed_at(self, time: Array) -> tuple[Array, Array, Array, Array]:
        """Coefficients (K, N) and their rates [1/s], origins (N,) [m] and theirs [m/s], at times (N,)."""
        if len(self.listed) == 1:
            coeffs = np.broadcast_to(self.coeffs.T, (self.coeffs.shape[1], len(time)))
            still = np.zeros(len(time))
            return coeffs, np.zeros_like(coeffs), still + self.origin[0], still
        k = np.clip(np.searchsorted(self.listed, time) - 1, 0, len(self.listed) - 2)
        span, since = self.listed[k + 1] - self.listed[k], time - self.listed[k]
        rates = ((self.coeffs[k + 1] - self.coeffs[k]) / span[:, None]).T
        drift = (self.origin[k + 1] - self.origin[k]) / span
        return self.coeffs[k].T + rates * since, rates, self.origin[k] + drift * since, drift


Frame = SlantFrame | GroundFrame
