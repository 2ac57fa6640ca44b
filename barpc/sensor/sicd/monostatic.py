"""A monostatic radar image as a camera: a ground point is seen where range and range rate are those of the pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np

from barpc.errors import RpcError
from barpc.frozen import Frozen
from barpc.geodesy import (
    NEWTON_STEPS,
    SETTLED,
    Array,
    ecef_from_ground,
    ecef_from_ground_jacobian,
    pointwise,
    wrap_longitude,
)
from barpc.sensor.circle import aside, dot, on_circle
from barpc.sensor.curve import Curve
from barpc.sensor.sicd.formation import Aperture, Formation
from barpc.sensor.timing import Timing

_STEP = 1.0  # m: central differences over so much are exact to 1e-9
_BEYOND = 1.0  # sides of the image around it that its polynomials are believed for


@dataclass(frozen=True, eq=False, repr=False)
class Monostatic(Frozen):
    """A SICD image: itself a `SensorModel`.

    Rows of the image go on in range (x), columns along the flight (y), so that `image` is (column, row) as ever.

    Parameters
    ----------
    orbit : Curve, position of the antenna (ARPPoly) [m], ECEF; time counts from the start of the collection
    formation : Formation, (x, y) to range and range rate
    spacing : (float, float), x and y of a pixel [m]
    origin : (float, float), row and column [px] of the scene centre point
    size : (width, height) [px]
    alt_range : (low, high), altitudes that the image is used for [m above the ellipsoid]
    look : "right" or "left", side of the track; a point on the other side projects to NaN
    timing : Timing or None, of the clocks, by y [m]: the antenna is where the orbit had it earlier, the range less
    accuracy : (float, float) or None, standard deviations of range and of the place along the flight [m]
    """

    orbit: Curve
    formation: Formation
    spacing: tuple[float, float]
    origin: tuple[float, float]
    size: tuple[int, int]
    alt_range: tuple[float, float]
    look: Literal["right", "left"] = "right"
    timing: Timing | None = None
    accuracy: tuple[float, float] | None = None

    advice: ClassVar[str] = ""
    azimuth_axis: ClassVar[int] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.size) < 1 or not self.alt_range[0] <= self.alt_range[1] or not min(self.spacing) > 0:
            raise RpcError(f"SICD: size {self.size}, spacing {self.spacing} m, altitudes {self.alt_range}")
        if self.look not in ("right", "left"):
            raise RpcError(f"SICD: look {self.look!r}, expected 'right' or 'left'")

    def project(self, ground: Array) -> Array:
        """Project ground points (..., 3) [deg, deg, m] to image points (..., 2) [px]; NaN far off, or on the
        other side.
        """
        return pointwise(lambda part: [self._image(self._solve(ecef_from_ground(part).T)[0])], [(2,)], ground)[0]

    def project_jacobian(self, ground: Array) -> tuple[Array, Array]:
        """Return image points (..., 2) [px] and their derivatives (..., 2, 3) [px/deg, px/deg, px/m]."""
        image, jacobian = pointwise(lambda part: self._derivatives(part)[:2], [(2,), (2, 3)], ground)
        return image, jacobian

    def localize(self, image: Array, alt: Array) -> Array:
        """Localise image points (..., 2) [px] at altitudes (...) [m]: ground points (..., 3).

        Longitudes run on across the antimeridian; NaN far off the image or where the range does not reach.
        """
        ground = pointwise(self._localize, [(3,)], image, alt)[0]
        with np.errstate(all="ignore"):
            ground[..., 0] = wrap_longitude(ground[..., 0], self._middle)
        return ground

    def to_radar(self, ground: Array) -> Array:
        """Return the vectors (..., 3) [m], ECEF, from ground points (..., 3) to the antenna that sees them;
        NaN as `project`.
        """
        return pointwise(lambda part: [self._to_radar(part)], [(3,)], ground)[0]

    @property
    def speed(self) -> float:
        """Speed of the flight in the middle of the collection [m/s]."""
        _, velocity = self.orbit(np.array([np.mean(self.orbit.knots)]))
        return float(np.linalg.norm(velocity))

    def timed(self, timing: Timing) -> Monostatic:
        """Return the model with a timing by the column [px] in place of its own."""
        pixel, zero = self.spacing[1], self.origin[1]
        timing = replace(timing, offset=(timing.offset - zero) * pixel, scale=timing.scale * pixel)
        return replace(self, timing=timing)

    def timing_jacobian(self, ground: Array) -> tuple[Array, Array, Array, Array]:
        """Return image points and derivatives as `barpc.sensor.timing.Clocked` asks; the coordinate is the column."""
        image, by_ground, by_timing, col = pointwise(self._derivatives, [(2,), (2, 3), (2, 2), ()], ground)
        return image, by_ground, by_timing, col

    @cached_property
    def _middle(self) -> float:
        image = 0.5 * np.array(self.size, dtype=np.float64)[None, :]
        with np.errstate(all="ignore"):
            lon = float(self._localize(image, np.array([np.mean(self.alt_range)]))[0][0, 0])
        return lon if np.isfinite(lon) else 0.0

    @cached_property
    def _bounds(self) -> tuple[Array, Array]:
        """The lowest and highest (x, y) (2, 1) [m] that are believed."""
        sides = np.array([self.size[1], self.size[0]], dtype=np.float64)
        spacing, origin = np.array(self.spacing), np.array(self.origin)
        low, high = (-_BEYOND * sides - origin) * spacing, ((1 + _BEYOND) * sides - origin) * spacing
        return low[:, None], high[:, None]

    def _image(self, plane: Array) -> Array:
        """Return (col, row) (N, 2) of (x, y) (2, N)."""
        row, col = plane / np.array(self.spacing)[:, None] + np.array(self.origin)[:, None]
        return np.column_stack([col, row])

    def _seen(self, plane: Array) -> Aperture:
        """Return range and range rate of the pixels (2, N), clocks corrected."""
        seen = self.formation.at(plane[0], plane[1], self.orbit)
        if self.timing is None:
            return seen
        far, late = self.timing.at(plane[1])
        position, velocity = self.orbit(seen.time - late)
        distance, time = seen.distance - far, seen.time - late
        return seen._replace(position=position, velocity=velocity, distance=distance, time=time)

    def _miss(self, plane: Array, point: Array) -> tuple[Array, Aperture, Array, Array]:
        """Return the pixel - point in range and rate (2, N), the aperture, and the point's sight (3, N) and
        distance (N,).
        """
        seen = self._seen(plane)
        sight = seen.position - point
        distance = np.sqrt(dot(sight, sight))
        sight = sight / distance
        miss = np.stack([seen.distance - distance, seen.rate - dot(seen.velocity, sight)])
        return miss, seen, sight, distance

    def _by_plane(self, plane: Array, point: Array) -> Array:
        """Return the derivative (2, 2, N) of `_miss` by (x, y)."""
        steps = _STEP * np.eye(2)[:, :, None]
        columns = [self._miss(plane + s, point)[0] - self._miss(plane - s, point)[0] for s in steps]
        return np.stack(columns, axis=1) / (2 * _STEP)

    def _solve(self, point: Array) -> tuple[Array, Array]:
        """Return (x, y) (2, N) of points (3, N), ECEF, by Newton from the scene centre; and the last
        derivative (2, 2, N).
        """
        low, high = self._bounds
        plane = np.where(np.isfinite(point[:2]), 0.0, np.nan)
        for _ in range(NEWTON_STEPS):
            slope = self._by_plane(plane, point)
            moved = np.clip(plane - _solve(slope, self._miss(plane, point)[0]), low, high)
            step, plane = np.abs(moved - plane).max(axis=0), moved
            if not (step.max(initial=0.0, where=np.isfinite(step)) > SETTLED):
                break
        _, seen, sight, _ = self._miss(plane, point)
        side = dot(aside(seen.position, seen.velocity, self.look == "right"), sight)
        inside = ((plane > low) & (plane < high)).all(axis=0)
        plane[:, ~(inside & (side < 0) & (step <= SETTLED))] = np.nan
        return plane, slope

    def _to_radar(self, ground: Array) -> Array:
        point = ecef_from_ground(ground).T
        _, _, sight, distance = self._miss(self._solve(point)[0], point)
        return (sight * distance).T

    def _derivatives(self, ground: Array) -> tuple[Array, Array, Array, Array]:
        """Return image points and derivatives for `timing_jacobian`."""
        point = ecef_from_ground(ground).T
        plane, slope = self._solve(point)
        _, seen, sight, distance = self._miss(plane, point)
        toward = dot(seen.velocity, sight)
        by_point = np.stack([sight, (seen.velocity - toward * sight) / distance])  # (2, 3, N)
        moved = -np.stack([_solve(slope, by_point[:, k]) for k in range(3)], axis=1)  # d(x, y)/dX
        by_ground = np.einsum("ikn,nkj->nij", moved, ecef_from_ground_jacobian(ground))
        acceleration = self.orbit.states(seen.time)[2]
        turning = dot(acceleration, sight) + (dot(seen.velocity, seen.velocity) - toward**2) / distance
        zero = np.zeros_like(toward)
        by_late = np.array([[-zero - 1.0, toward], [zero, turning]])  # of the miss, by range and time
        by_timing = -np.stack([_solve(slope, by_late[:, k]) for k in range(2)], axis=1)
        image, pixel = self._image(plane), np.array(self.spacing)[:, None]
        timing = np.moveaxis(by_timing, -1, 0) / pixel
        return image, (by_ground / pixel)[:, ::-1], timing[:, ::-1], image[:, 0]

    def _localize(self, image: Array, alt: Array) -> list[Array]:
        low, high = self._bounds
        plane = ((image[:, ::-1] - np.array(self.origin)) * np.array(self.spacing)).T
        plane[:, ~((plane > low) & (plane < high)).all(axis=0)] = np.nan
        seen = self._seen(plane)
        ahead = -seen.rate / np.sqrt(dot(seen.velocity, seen.velocity))
        ground, _ = on_circle(seen.position, seen.velocity, seen.distance, alt, self.look == "right", ahead)
        return [ground]


def _solve(matrix: Array, right: Array) -> Array:
    """Return the solutions (2, N) of 2 x 2 systems (2, 2, N)."""
    (a, b), (c, d) = matrix
    solved: Array = np.stack([d * right[0] - b * right[1], a * right[1] - c * right[0]]) / (a * d - b * c)
    return solved
