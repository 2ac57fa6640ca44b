"""The Range-Doppler model: a ground point is seen when the satellite passes it at zero Doppler.

The satellite's orbit is O(t) with velocity V(t). The azimuth time t of a ground point X is the zero of E(t) = V(t) .
(X - O(t)); its two-way slant range time is tau = 2 |X - O(t)| / c. A frame turns (t, tau) into (col, row).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from barpc.base.errors import InputError, RpcFormatError
from barpc.base.geodesy import (
    NEWTON_STEPS,
    NEWTON_TOLERANCE,
    SPEED_OF_LIGHT,
    Array,
    ecef_from_ground,
    ecef_from_ground_jacobian,
    pointwise,
)
from barpc.sensor.curve import Curve, Orbit, fit_orbit
from barpc.sensor.document import seconds, warn_off_grid
from barpc.sensor.sentinel1.annotation import Annotation, StateVectors, burst_rows, read_annotation, read_orbit_file
from barpc.sensor.sentinel1.frames import Bistatic, Delays, GroundFrame, RangeFrame, SlantFrame, bistatic_constant
from barpc.sensor.timing import Clocked, Timing, aside, dot, on_circle

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
class RangeDoppler(Clocked):
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

    azimuth_axis: ClassVar[int] = 1
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
        return None if self.advice else (-500.0, 9000.0)

    @property
    def advice(self) -> str:
        """Remedy where no RPC represents this model; empty where nothing special."""
        ground_range = "the ground range of a GRD changes every second, with the terrain: take the SLC of the scene"
        return ground_range if isinstance(self.frame, GroundFrame) else ""

    @property
    def speed(self) -> float:
        """Speed of the flight at the image's middle row [m/s]."""
        _, velocity = self.orbit(np.array([0.5 * self.size[1] * self.frame.interval]))
        return float(np.linalg.norm(velocity))

    def timed(self, timing: Timing) -> RangeDoppler:
        """Return the model with a timing by the row [px] in place of its own."""
        interval = self.frame.interval
        timing = replace(timing, offset=timing.offset * interval, scale=timing.scale * interval)
        return replace(self, delays=replace(self.delays, timing=timing))

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
        time, settled = (
            np.where(np.isfinite(point[0]), (low + high) / 2, np.nan),
            NEWTON_TOLERANCE * self.frame.interval,
        )
        for _ in range(NEWTON_STEPS):
            position, velocity, acceleration = self.orbit.states(time)
            sight = position - point
            rate = -dot(acceleration, sight) - dot(velocity, velocity)
            moved = np.clip(time + dot(velocity, sight) / rate, low, high)
            step, time = np.abs(moved - time), moved
            if not (step.max(initial=0.0, where=np.isfinite(step)) > settled):
                break
        position, velocity, acceleration = self.orbit.states(time)
        sight = position - point
        distance = np.sqrt(dot(sight, sight))
        sight /= distance
        rate = -distance * dot(acceleration, sight) - dot(velocity, velocity)
        side = dot(aside(position, velocity, self.look == "right"), sight)
        time[~((time > low) & (time < high) & (side < 0) & (step <= settled))] = np.nan
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

    def _derivatives(self, ground: Array) -> tuple[Array, Array, Array, Array]:
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
        by_timing = np.stack([by_times[:, 1] * (2.0 / SPEED_OF_LIGHT), by_times[:, 0]], axis=1)
        return image.T, jacobian, np.moveaxis(by_timing, -1, 0), seen.times[0] / self.frame.interval

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
    of_orbit, left = (
        ORBITS.get(states.source, ORBITS["Downlink"]),
        (RESIDUAL_DELAYS[0][atmosphere], RESIDUAL_DELAYS[1][bistatic == "full"]),
    )
    model = RangeDoppler(
        orbit=_fitted_orbit(nearest, states, epoch),
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


def _fitted_orbit(annotation: Annotation, states: StateVectors, epoch: np.datetime64) -> Orbit:
    start, stop = (float(seconds(t, epoch)) for t in (annotation.first_line_time, annotation.last_line_time))
    return fit_orbit(seconds(states.time, epoch), states.position, states.velocity, (start, stop))


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
