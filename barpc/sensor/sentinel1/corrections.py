"""Smooth delays between the geometry and the annotated times.

Added to the geometric times of a ground point, they give the times at which the point is really found in
the image. Both are smooth over a swath, so that an RPC can hold them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from barpc.errors import InputError
from barpc.geodesy import Array, enu_basis
from barpc.sensor.sentinel1.annotation import Annotation, seconds
from barpc.sensor.sentinel1.frames import SPEED_OF_LIGHT

Bistatic = Literal["annotated", "full"]
"""Which bistatic correction; see `bistatic_constant`."""

_RAD = np.pi / 180.0
_SPREAD = 1e-5  # s: what lines and azimuth times of a grid may scatter
_ZENITH = (2.41, -1.0 / 3411.0, 1.0 / 8.55e7)  # m, per m, per m^2 of altitude


@dataclass(frozen=True)
class Delays:
    """Which delays are added to the geometric times.

    Parameters
    ----------
    atmosphere : bool
        Path delay of the atmosphere, (2.41 - h/3411 + h^2/8.55e7) m / cos(incidence), one way, h the
        altitude [m] (Jehle et al., "Estimation of Atmospheric Path Delays in TerraSAR-X Data using Models
        vs. Measurements", Sensors 2008): 0.8 to 1.6 px in range.
    bistatic : float, optional
        Constant b [s] of the bistatic correction of azimuth time, b - tau/2 with tau the two-way slant
        range time; None for none.
    """

    atmosphere: bool = False
    bistatic: float | None = None

    def __bool__(self) -> bool:
        return self.atmosphere or self.bistatic is not None

    def shift(self, times: Array, ground: Array, sight: Array) -> Array:
        """What is added to the times.

        Parameters
        ----------
        times : (2, N)
            Geometric azimuth time, slant range time [s].
        ground : (N, 3)
            lon, lat [deg], alt [m].
        sight : (3, N)
            Unit vectors from the ground point to the satellite.

        Returns
        -------
        shift : (2, N)
            [s].
        """
        out = np.zeros_like(times)
        if self.bistatic is not None:
            out[0] = self.bistatic - 0.5 * times[1]
        if self.atmosphere:
            up = enu_basis(ground)[:, 2, :].T
            out[1] = _zenith(ground[:, 2])[0] / (up * sight).sum(axis=0) * (2.0 / SPEED_OF_LIGHT)
        return out

    def shift_jacobian(self, by_ground: Array, ground: Array, sight: Array, by_sight: Array) -> Array:
        """Derivative of `shift`.

        Parameters
        ----------
        by_ground : (2, N, 3)
            d(times)/d(lon, lat, alt) [s/deg, s/deg, s/m].
        ground : (N, 3)
            lon, lat [deg], alt [m].
        sight : (3, N)
            Unit vectors from the ground point to the satellite.
        by_sight : (N, 3, 3)
            d(sight)/d(lon, lat, alt).

        Returns
        -------
        jacobian : (2, N, 3)
            d(shift)/d(lon, lat, alt).
        """
        out = np.zeros_like(by_ground)
        if self.bistatic is not None:
            out[0] = -0.5 * by_ground[1]
        if self.atmosphere:
            enu = enu_basis(ground)
            east, north, cosine = np.einsum("nij,jn->in", enu, sight)
            by_cosine = np.einsum("nj,njk->nk", enu[:, 2, :], by_sight)
            by_cosine[:, 0] += east * np.cos(ground[:, 1] * _RAD) * _RAD
            by_cosine[:, 1] += north * _RAD
            zenith, slope = _zenith(ground[:, 2])
            out[1] = -(zenith / cosine**2)[:, None] * by_cosine
            out[1, :, 2] += slope / cosine
            out[1] *= 2.0 / SPEED_OF_LIGHT
        return out


def bistatic_constant(annotation: Annotation, form: Bistatic) -> float:
    """The constant b of the bistatic correction of azimuth time, b - tau/2.

    The satellite flies on while the pulse is on its way. The processor allows for that at one range, the
    middle of the whole product (IW2, EW3), which shows in its geolocation grid: the time of a grid line
    less the grid's azimuth time is b - tau/2 to 2 us, with b half the two-way time of that range.

    Parameters
    ----------
    annotation : Annotation
        One swath, or a GRD.
    form : "annotated" or "full"
        "annotated": that constant, so that the model meets the lines of the product's own grid: 0.04 to
        0.14 line in an SLC, to 0.19 in a GRD (Schubert et al., "Sentinel-1A Product Geolocation Accuracy:
        Commissioning Phase Results", Remote Sensing 2015). "full": also the pulses on their way, rank
        times pulse interval, for one SLC swath: to 0.26 line (Gisinger et al., "Recent Findings on the
        Sentinel-1 Geolocation Accuracy Using the Australian Corner Reflector Array", IGARSS 2018).

    Returns
    -------
    b : float
        [s].

    Raises
    ------
    InputError
        The processor did not correct the bistatic delay, the grid does not tell how, or "full" is asked
        for a GRD.
    """
    if not annotation.bistatic_applied:
        raise InputError(
            f"{annotation.name}: no bistatic correction by the processor to complete; leave it out"
        )
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


def _zenith(alt: Array) -> tuple[Array, Array]:
    """Zenith path delay (N,) [m] at altitudes [m], and its derivative."""
    a, b, c = _ZENITH
    return a + alt * (b + alt * c), b + 2 * c * alt
