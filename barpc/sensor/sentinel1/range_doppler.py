"""The Range-Doppler model: a ground point is seen when the satellite passes it at zero Doppler.

The satellite's orbit is O(t) with velocity V(t). The azimuth time t of a ground point X is the zero of E(t) = V(t) .
(X - O(t)); its two-way slant range time is tau = 2 |X - O(t)| / c. A frame turns (t, tau) into (col, row).

Frames count rows by a constant interval of zero-Doppler time from the epoch, the time of row 0. Times are (2, N) here:
azimuth time and two-way slant range time [s]; so are image points: col and row [px]. Delays, added to the geometric
times of a ground point, give the times at which it is really found in the image; they are smooth over a swath, so that
an RPC can hold them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from numpy.polynomial import Polynomial

from barpc.base.errors import InputError, RpcFormatError
from barpc.base.frozen import Frozen
from barpc.base.geodesy import (
    EVERYWHERE,
    NEWTON_TOLERANCE,
    SPEED_OF_LIGHT,
    Array,
    ecef_from_ground,
    ecef_from_ground_jacobian,
    enu_basis,
    newton,
    pointwise,
    up,
)
from barpc.sensor.curve import Curve, fit_orbit
from barpc.sensor.document import seconds, warn_off_grid
from barpc.sensor.radar import Radar, aside, dot, on_circle
from barpc.sensor.sentinel1.annotation import Annotation, burst_rows, read_annotation, read_orbit_file

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

        def farther(slant: Array) -> Array:
            ground, by_slant, _ = self._ground_range(time, slant)
            return np.asarray(slant + (target - ground) / by_slant)

        slant, _ = newton(farther, self.origin.mean() + target * self.slope)
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

    def __bool__(self) -> bool:
        return self.atmosphere or self.bistatic is not None

    def shift(self, times: Array, ground: Array, sight: Array) -> Array:
        """Return the delays (2, N) [s] of points (N, 3) that see the satellite along unit vectors (3, N)."""
        out = np.zeros_like(times)
        if self.bistatic is not None:
            out[0] = self.bistatic - 0.5 * times[1]
        if self.atmosphere:
            out[1] = _ZENITH(ground[:, 2]) / (up(ground) * sight).sum(axis=0) * (2.0 / SPEED_OF_LIGHT)
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


RELIEF = (200.0, 500.0)
"""How far the terrain may lie below the lowest and above the highest point of the geolocation grid [m]."""
NO_DELAYS = Delays()  # pure geometry
ORBITS = {"AUX_POEORB": 0.05, "AUX_RESORB": 0.1, "AUX_PREORB": 0.4, "Auxiliary": 0.4, "Downlink": 2.5}
"""Source of an orbit -> its error [m], RMS in space. Precise, restituted: what is required (Copernicus Sentinel news of
13 April 2021); predicted: 0.15 to 0.35 m (9 September 2022). An annotation does not tell which of these its own is. The
receiver's own solution, downlinked, and of no known source: 2.43 m (the same news)."""
RESIDUAL_DELAYS = ((3.5, 0.5), (4.0, 0.5))
"""What the atmosphere adds to the range at the far side of a swath [m], and of that, corrected, ionosphere and water
vapour; the bistatic delay along the flight, and of that, corrected, the Doppler rate at another height than assumed."""


@dataclass(frozen=True, eq=False, repr=False)
class RangeDoppler(Radar):
    """A radar image in zero-Doppler geometry (Sentinel-1, TerraSAR-X): itself a `SensorModel`.

    Parameters
    ----------
    orbit : Curve, position of the satellite [m], ECEF; its time counts from `epoch`
    epoch : datetime64[ns], Zero-Doppler time (UTC) of row 0
    frame : SlantFrame or GroundFrame, (azimuth time, slant range time) to (col, row)
    size : (width, height) [px]
    alt_range : (low, high), altitudes that the image is used for [m above the ellipsoid]
    look : "right" or "left", side of the track; a point on the other side projects to NaN
    delays : Delays, smooth corrections between geometry and annotated times; none by default
    accuracy : (float, float) or None, standard deviations of range and of the place along the flight [m]

    Examples
    --------
    >>> barpc.open_camera("S1A_IW_SLC_....SAFE,swath=iw1").model.look  # doctest: +SKIP
    'right'
    """

    _kind: ClassVar[str] = "Range-Doppler model"

    orbit: Curve
    epoch: np.datetime64
    frame: RangeFrame
    size: tuple[int, int]
    alt_range: tuple[float, float]
    look: Literal["right", "left"] = "right"
    delays: Delays = NO_DELAYS
    accuracy: tuple[float, float] | None = None

    def _told(self) -> str:
        (width, height), (low, high) = self.size, self.alt_range
        start = np.datetime_as_string(self.epoch, "s")
        return f"{width} x {height} px from {start}, looks {self.look}, for {low:g} to {high:g} m"

    @classmethod
    def from_annotation(
        cls,
        source: Path | Annotation,
        *,
        burst: int | None = None,
        orbit: Path | None = None,
        atmosphere: bool = False,
        bistatic: Bistatic | None = None,
    ) -> RangeDoppler:
        """Return the model of one SLC swath (bursts stitched, or stripmap), one burst, or a GRD.

        Column 0 is the annotation's pixel 0. Row 0 is its line 0; in a stitched swath rows go on by
        zero-Doppler time, and `burst_rows` says where the lines of each burst lie.

        Parameters
        ----------
        source : Path or Annotation, the annotation XML
        burst : int, optional, the model of this burst alone, from 0; row 0 is its first line
        orbit : Path, optional, precise orbit file (``.EOF``) to use in place of the annotated state vectors
        atmosphere : bool, add the path delay of the atmosphere (see `Delays`)
        bistatic : "annotated" or "full", optional, add a bistatic correction (see `bistatic_constant`)

        Raises
        ------
        RpcError
            Not a Sentinel-1 annotation (an `RpcFormatError`), or an orbit that cannot be used. A geolocation grid that
            does not belong to the orbit is a BarpcWarning; only its range of heights is used then.
        InputError
            No such burst, or a correction that this product does not take.
        """
        annotation = source if isinstance(source, Annotation) else read_annotation(source)
        epoch, lines = line_extent(annotation, burst)
        return swaths_model([annotation], epoch, (annotation.samples, lines), orbit, atmosphere, bistatic)

    @property
    def all_ground(self) -> tuple[float, float] | None:
        """Altitudes of all ground on Earth [m], which an RPC of a swath holds to 5e-3 px; None of a GRD."""
        return None if self.advice else EVERYWHERE

    @property
    def advice(self) -> str:
        """Remedy where no RPC represents this model; empty where nothing special."""
        ground_range = "the ground range of a GRD changes every second, with the terrain: take the SLC of the scene"
        return ground_range if isinstance(self.frame, GroundFrame) else ""

    def azimuth_range(self, ground: Array) -> tuple[Array, Array]:
        """Return zero-Doppler [s from `epoch`] and two-way slant range times (...) [s] of points (..., 3).

        Pure geometry, without `delays`; NaN off the orbit's time span or on the other side.
        """
        azimuth_time, range_time = pointwise(
            lambda part: self._geometry(ecef_from_ground(part)).times, [(), ()], ground
        )
        return azimuth_time, range_time

    def _geometry(self, ecef: Array) -> _ZeroDopplerPoints:
        point = ecef.T
        low, high = self.orbit.span

        def later(time: Array) -> Array:
            position, velocity, acceleration = self.orbit.states(time)
            sight = position - point
            rate = -dot(acceleration, sight) - dot(velocity, velocity)
            return np.clip(time + dot(velocity, sight) / rate, low, high)

        middle = np.where(np.isfinite(point[0]), (low + high) / 2, np.nan)
        time, settled = newton(later, middle, NEWTON_TOLERANCE * self.frame.interval)
        position, velocity, acceleration = self.orbit.states(time)
        sight = position - point
        distance = np.sqrt(dot(sight, sight))
        sight /= distance
        rate = -distance * dot(acceleration, sight) - dot(velocity, velocity)
        side = dot(aside(position, velocity, self.look == "right"), sight)
        time[~((time > low) & (time < high) & (side < 0) & settled)] = np.nan
        times = np.stack([time, distance * (2.0 / SPEED_OF_LIGHT)])
        return _ZeroDopplerPoints(times, sight, distance, velocity, -velocity / rate)

    def _to_radar(self, ground: Array) -> Array:
        seen = self._geometry(ecef_from_ground(ground))
        return np.where(np.isnan(seen.times[0]), np.nan, seen.distance * seen.sight).T

    def _project(self, ground: Array) -> Array:
        seen = self._geometry(ecef_from_ground(ground))
        times = seen.times
        if self.delays:
            times = times + self.delays.shift(times, ground, seen.sight)
        image = self.frame.image(times)[0]
        image[:, ~np.isfinite(image).all(axis=0)] = np.nan
        return image.T

    def _derivatives(self, ground: Array) -> tuple[Array, Array]:
        seen = self._geometry(ecef_from_ground(ground))
        by_ecef = np.stack([seen.time_by_ecef.T, seen.sight.T * (-2.0 / SPEED_OF_LIGHT)])  # (2, N, 3)
        ecef_by_ground = ecef_from_ground_jacobian(ground)
        by_ground = np.einsum("inj,njk->ink", by_ecef, ecef_by_ground)
        times = seen.times
        if self.delays:
            by_sight = seen.sight_by_ecef() @ ecef_by_ground
            extra = self.delays.shift_jacobian(times, by_ground, ground, seen.sight, by_sight)
            times, by_ground = times + self.delays.shift(times, ground, seen.sight), by_ground + extra
        image, by_times = self.frame.image(times)
        jacobian = np.einsum("ijn,jnk->nik", by_times, by_ground)
        bad = ~np.isfinite(image).all(axis=0)
        image[:, bad], jacobian[bad] = np.nan, np.nan
        return image.T, jacobian

    def _localize(self, image: Array, alt: Array) -> Array:
        measured = times = self.frame.times(image.T)
        ground, sight = self._on_circle(times, alt)
        for _ in range(3 if self.delays else 0):  # delays change by 1e-5 of a step: three rounds are exact
            times = measured - self.delays.shift(times, ground, sight)
            ground, sight = self._on_circle(times, alt)
        return ground

    def _on_circle(self, times: Array, alt: Array) -> tuple[Array, Array]:
        """Return the points (N, 3) at times (2, N) and altitudes (N,), and the unit vectors (3, N) to the satellite."""
        low, high = self.orbit.span
        time = np.where((times[0] >= low) & (times[0] <= high), times[0], np.nan)
        position, velocity, _ = self.orbit.states(time)
        distance = 0.5 * SPEED_OF_LIGHT * times[1]
        return on_circle(position, velocity, distance, alt, self.look == "right")


@dataclass(frozen=True)
class _ZeroDopplerPoints:
    """Points at zero Doppler: times (2, N), sight (3, N) unit, distance (N,), velocity and dt/dX (3, N)."""

    times: Array
    sight: Array
    distance: Array
    velocity: Array
    time_by_ecef: Array

    def sight_by_ecef(self) -> Array:
        """Return (N, 3, 3): d(sight)/dX, the satellite moving along with the zero-Doppler time."""
        moved = np.einsum("in,jn->nij", self.velocity, self.time_by_ecef) - np.eye(3)
        moved += np.einsum("in,jn->nij", self.sight, self.sight)  # velocity has no part along the sight
        return np.asarray(moved / self.distance[:, None, None])


def line_extent(annotation: Annotation, burst: int | None = None) -> tuple[np.datetime64, int]:
    """Return the time of row 0 and the number of rows: of one burst, or of all bursts stitched."""
    if burst is not None:
        if not 0 <= burst < len(annotation.bursts):
            raise InputError(f"{annotation.name}: no burst {burst}, it has {len(annotation.bursts)}")
        return annotation.bursts[burst].time, annotation.lines_per_burst
    if not annotation.bursts:
        return annotation.first_line_time, annotation.lines
    last = max(b.first_row for b in burst_rows(annotation))
    return annotation.first_line_time, last + annotation.lines_per_burst


def swaths_model(
    swaths: Sequence[Annotation],
    epoch: np.datetime64,
    size: tuple[int, int],
    orbit: Path | None,
    atmosphere: bool,
    bistatic: Bistatic | None,
) -> RangeDoppler:
    """Return the model of swaths side by side, the nearest first; row 0 at `epoch`."""
    nearest = swaths[0]
    alt = np.concatenate([a.grid.ground[:, 2] for a in swaths])
    states = nearest.states if orbit is None else read_orbit_file(orbit, nearest)
    of_orbit = ORBITS.get(states.source, ORBITS["Downlink"])
    left = RESIDUAL_DELAYS[0][atmosphere], RESIDUAL_DELAYS[1][bistatic == "full"]
    start, stop = (float(seconds(t, epoch)) for t in (nearest.first_line_time, nearest.last_line_time))
    model = RangeDoppler(
        orbit=fit_orbit(seconds(states.time, epoch), states.position, states.velocity, (start, stop)),
        epoch=epoch,
        frame=_range_frame(nearest, epoch),
        size=size,
        alt_range=(float(np.floor(alt.min()) - RELIEF[0]), float(np.ceil(alt.max()) + RELIEF[1])),
        delays=Delays(atmosphere, None if bistatic is None else bistatic_constant(nearest, bistatic)),
        accuracy=(float(np.hypot(of_orbit, left[0])), float(np.hypot(of_orbit, left[1]))),
    )
    for annotation in swaths:
        warn_off_grid(annotation.name, grid_residuals(annotation, model))
    return model


def grid_residuals(annotation: Annotation, model: RangeDoppler) -> Array:
    """Return model minus geolocation grid (G, 2), pure geometry: range [samples], azimuth [lines]."""
    grid = annotation.grid
    azimuth_time, range_time = model.azimuth_range(grid.ground)
    samples = (range_time - grid.range_time) * annotation.range_sampling_rate
    lines = (azimuth_time - seconds(grid.time, model.epoch)) / annotation.azimuth_time_interval
    return np.stack([samples, lines], axis=1)


def _range_frame(annotation: Annotation, epoch: np.datetime64) -> RangeFrame:
    """Return the frame of an SLC, or of a GRD (which has ground range polynomials)."""
    interval, convert = annotation.azimuth_time_interval, annotation.ground_range
    if annotation.product_type == "SLC":
        return SlantFrame(annotation.slant_range_time, annotation.range_sampling_rate, interval)
    if annotation.product_type != "GRD" or convert is None:
        raise RpcFormatError(f"{annotation.name}: {annotation.kind} has no geometry that is known here")
    return GroundFrame(
        interval,
        annotation.range_pixel_spacing,
        seconds(convert.time, epoch),
        convert.slant_origin,
        convert.ground_from_slant,
        float(convert.slant_from_ground[:, 1].mean()),
    )
