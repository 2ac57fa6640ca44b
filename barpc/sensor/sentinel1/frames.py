"""Times and image points: the frames of an image, and smooth delays between the geometry and the annotated times.

Both frames count rows by a constant interval of zero-Doppler time from the epoch, the time of row 0. Times are
(2, N) here: azimuth time and two-way slant range time [s]; so are image points: col and row [px]. Delays, added
to the geometric times of a ground point, give the times at which it is really found in the image; they are smooth
over a swath, so that an RPC can hold them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.polynomial import Polynomial

from barpc.base.errors import InputError
from barpc.base.frozen import Frozen
from barpc.base.geodesy import NEWTON_STEPS, NEWTON_TOLERANCE, SPEED_OF_LIGHT, Array, enu_basis, up
from barpc.sensor.document import seconds
from barpc.sensor.sentinel1.annotation import Annotation
from barpc.sensor.timing import Timing

Bistatic = Literal["annotated", "full"]  # which bistatic correction; see `bistatic_constant`
_SPREAD = 1e-5  # s: what lines and azimuth times of a grid may scatter
_ZENITH = Polynomial([2.41, -1.0 / 3411.0, 1.0 / 8.55e7])  # path delay [m] by altitude [m]


@dataclass(frozen=True, eq=False, repr=False)
class SlantFrame(Frozen):
    """The frame of an SLC: columns at a constant interval of slant range time."""

    first_range_time: float  # two-way slant range time of column 0 [s]
    sampling_rate: float  # columns a second of two-way time [Hz]
    interval: float  # azimuth time between rows [s]

    def image(self, times: Array) -> tuple[Array, Array]:
        """Return the image points (2, N) [px] of times (2, N) [s], and d(col, row)/d(times) (2, 2, N)."""
        out, slope = np.empty_like(times), np.zeros((2, *times.shape))
        out[0] = (times[1] - self.first_range_time) * self.sampling_rate
        out[1] = times[0] / self.interval
        slope[0, 1], slope[1, 0] = self.sampling_rate, 1.0 / self.interval
        return out, slope

    def times(self, image: Array) -> Array:
        """Return the times (2, N) [s] of image points (2, N) [px]."""
        return np.stack([image[1] * self.interval, image[0] / self.sampling_rate + self.first_range_time])


@dataclass(frozen=True, eq=False, repr=False)
class GroundFrame(Frozen):
    """The frame of a GRD: columns at a constant interval of ground range.

    Ground range is a polynomial of slant range, whose coefficients and origin are interpolated linearly
    between the times they are listed for (Sentinel-1 Product Specification, "coordinate conversion").
    """

    interval: float  # azimuth time between rows [s]
    spacing: float  # ground range between columns [m]
    listed: Array  # (M,): times of the polynomials [s from the epoch], ascending
    origin: Array  # (M,): slant range origins [m]
    coeffs: Array  # (M, K): ascending powers of (slant range - origin) [m]
    slope: float  # slant range a ground range at mid swath, roughly: where the inversion starts

    def image(self, times: Array) -> tuple[Array, Array]:
        """Return the image points (2, N) [px] of times (2, N) [s], and d(col, row)/d(times) (2, 2, N)."""
        metres = 0.5 * SPEED_OF_LIGHT
        ground, by_slant, by_time = self._ground_range(times[0], metres * times[1])
        out, slope = np.empty_like(times), np.zeros((2, *times.shape))
        out[0], out[1] = ground / self.spacing, times[0] / self.interval
        slope[0, 0], slope[0, 1] = by_time / self.spacing, by_slant * metres / self.spacing
        slope[1, 0] = 1.0 / self.interval
        return out, slope

    def times(self, image: Array) -> Array:
        """Return the times (2, N) [s] of image points (2, N) [px]: Newton on the polynomial."""
        time, target = image[1] * self.interval, image[0] * self.spacing
        slant = self.origin.mean() + target * self.slope
        for _ in range(NEWTON_STEPS):
            ground, by_slant, _ = self._ground_range(time, slant)
            step = (target - ground) / by_slant
            slant = slant + step
            if not (np.abs(step).max(initial=0.0, where=np.isfinite(step)) > NEWTON_TOLERANCE):
                break
        return np.stack([time, slant * (2.0 / SPEED_OF_LIGHT)])

    def _ground_range(self, time: Array, slant: Array) -> tuple[Array, Array, Array]:
        """Return the ground range (N,) [m] and its derivatives by slant range [m/m] and time [m/s]."""
        coeffs, rates, origin, drift = self._listed_at(time)
        u = slant - origin
        value, by_slant, by_time = np.zeros((3, len(u)))
        for c, r in zip(coeffs[::-1], rates[::-1], strict=True):  # Horner, both derivatives alongside
            by_slant = by_slant * u + value
            value = value * u + c
            by_time = by_time * u + r
        return value, by_slant, by_time - drift * by_slant

    def _listed_at(self, time: Array) -> tuple[Array, Array, Array, Array]:
        """Return the coefficients (K, N) and their rates [1/s], origins (N,) [m] and theirs [m/s], at times (N,)."""
        if len(self.listed) == 1:
            coeffs, still = np.repeat(self.coeffs.T, len(time), axis=1), np.zeros(len(time))
            return coeffs, np.zeros_like(coeffs), still + self.origin[0], still
        k = np.clip(np.searchsorted(self.listed, time) - 1, 0, len(self.listed) - 2)
        span, since = self.listed[k + 1] - self.listed[k], time - self.listed[k]
        rates = ((self.coeffs[k + 1] - self.coeffs[k]) / span[:, None]).T
        drift = (self.origin[k + 1] - self.origin[k]) / span
        return self.coeffs[k].T + rates * since, rates, self.origin[k] + drift * since, drift


RangeFrame = SlantFrame | GroundFrame


@dataclass(frozen=True)
class Delays:
    """Delays that are added to the geometric times.

    That of the path through the atmosphere, one way, is (2.41 - h/3411 + h^2/8.55e7) m / cos(incidence), h the altitude
    [m] (Jehle et al., "Estimation of Atmospheric Path Delays in TerraSAR-X Data using Models vs. Measurements", Sensors
    2008): 0.8 to 1.6 px in range. The bistatic correction of azimuth time is b - tau/2, tau the slant range time.
    """

    atmosphere: bool = False
    bistatic: float | None = None  # b [s]; None for no correction
    timing: Timing | None = None  # by azimuth time [s]; None for none

    def __bool__(self) -> bool:
        return self.atmosphere or self.bistatic is not None or self.timing is not None

    def shift(self, times: Array, ground: Array, sight: Array) -> Array:
        """Return the delays (2, N) [s] of points (N, 3) that see the satellite along unit vectors (3, N)."""
        out = np.zeros_like(times)
        if self.bistatic is not None:
            out[0] = self.bistatic - 0.5 * times[1]
        if self.atmosphere:
            out[1] = _ZENITH(ground[:, 2]) / (up(ground) * sight).sum(axis=0) * (2.0 / SPEED_OF_LIGHT)
        if self.timing is not None:
            out += _as_times(self.timing.at(times[0]))
        return out

    def shift_jacobian(self, times: Array, by_ground: Array, ground: Array, sight: Array, by_sight: Array) -> Array:
        """Return the derivative of `shift` by (lon, lat, alt) (2, N, 3) [s/deg, s/deg, s/m].

        `by_ground` (2, N, 3) is that of the times, `by_sight` (N, 3, 3) that of the sight.
        """
        out = np.zeros_like(by_ground)
        if self.bistatic is not None:
            out[0] = -0.5 * by_ground[1]
        if self.atmosphere:
            enu = enu_basis(ground)
            east, north, cosine = np.einsum("nij,jn->in", enu, sight)
            by_cosine = np.einsum("nj,njk->nk", enu[:, 2, :], by_sight)
            by_cosine[:, 0] += np.radians(east * np.cos(np.radians(ground[:, 1])))
            by_cosine[:, 1] += np.radians(north)
            zenith, slope = _ZENITH(ground[:, 2]), _ZENITH.deriv()(ground[:, 2])
            out[1] = -(zenith / cosine**2)[:, None] * by_cosine
            out[1, :, 2] += slope / cosine
            out[1] *= 2.0 / SPEED_OF_LIGHT
        if self.timing is not None:
            out += _as_times(self.timing.rate(times[0]))[..., None] * by_ground[0]
        return out


def bistatic_constant(annotation: Annotation, form: Bistatic) -> float:
    """Return the constant b [s] of the bistatic correction of azimuth time, b - tau/2.

    The satellite flies on while the pulse is on its way. The processor allows for that at one range, the
    middle of the whole product (IW2, EW3), which shows in its geolocation grid: the time of a grid line
    less the grid's azimuth time is b - tau/2 to 2 us, with b half the two-way time of that range.

    "annotated": that constant, so that the model meets the lines of the product's own grid: 0.04 to 0.14 line in an
    SLC, to 0.19 in a GRD (Schubert et al., "Sentinel-1A Product Geolocation Accuracy: Commissioning Phase Results",
    Remote Sensing 2015). "full": also the pulses on their way, rank times pulse interval, for one SLC swath: to 0.26
    line (Gisinger et al., "Recent Findings on the Sentinel-1 Geolocation Accuracy Using the Australian Corner Reflector
    Array", IGARSS 2018). InputError where the processor did not correct it, the grid does not tell how, or "full" is
    asked for a GRD.
    """
    if not annotation.bistatic_applied:
        raise InputError(f"{annotation.name}: no bistatic correction by the processor to complete; leave it out")
    grid = annotation.grid
    late = seconds(annotation.line_time(grid.image[:, 1]), annotation.first_line_time)
    late = late - seconds(grid.time, annotation.first_line_time) + 0.5 * grid.range_time
    constant = float(np.median(late))
    if not np.median(np.abs(late - constant)) <= _SPREAD:
        raise InputError(f"{annotation.name}: the geolocation grid does not tell the bistatic correction")
    if form == "annotated":
        return constant
    if annotation.product_type != "SLC":
        raise InputError(f"{annotation.name}: the full bistatic correction is of one SLC swath")
    return annotation.rank * annotation.pulse_interval - constant


def _as_times(late: Array) -> Array:
    """Return the range [m] and azimuth time [s] (2, N) as azimuth time and two-way range time [s]."""
    return np.stack([late[1], late[0] * (2.0 / SPEED_OF_LIGHT)])
