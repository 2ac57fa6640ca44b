"""Pushbroom cameras on circular orbits, their errors, relief, RPC fits, for `worlds.py`: of barpc's only `RPC`.

The camera frame has x along the scan, z along the line of sight of the middle column, and columns run along -y. The
attitude is a polynomial of time (the guided pointing) about its middle; what is wrong with it is a turn about the
camera's own axes, as a function of the image row.

    python -m benchmarks.worlds --selftest
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from barpc.sensor.rpc import RPC

Array = npt.NDArray[np.float64]
Pointing = Callable[[Array], Array]
"""Rows (n,) -> how far the picture is off there, col and row (n, 2) [px]."""

EARTH, FLAT = 6378137.0, 1.0 / 298.257223563
TURN, GRAVITY = 7.2921150e-5, 3.986004418e14
_E2 = FLAT * (2.0 - FLAT)
_NODES, _DEGREE = 15, 7  # of the guided pointing
CHIPS = 8


# --- the Earth --------------------------------------------------------------------------------------------


def ecef(ground: Array) -> Array:
    """Geocentric places (..., 3) [m] of longitude, latitude [deg], altitude [m]."""
    lon, lat, alt = np.radians(ground[..., 0]), np.radians(ground[..., 1]), ground[..., 2]
    normal = EARTH / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    flat = (normal + alt) * np.cos(lat)
    return np.stack([flat * np.cos(lon), flat * np.sin(lon), (normal * (1 - _E2) + alt) * np.sin(lat)], -1)


def geodetic(place: Array) -> Array:
    """Longitude, latitude [deg], altitude [m] of geocentric places (..., 3) [m]."""
    x, y, z = np.moveaxis(place, -1, 0)
    flat = np.hypot(x, y)
    lat = np.arctan2(z, flat * (1.0 - _E2))
    for _ in range(6):
        normal = EARTH / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
        alt = flat * np.cos(lat) + z * np.sin(lat) - EARTH * np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
        lat = np.arctan2(z, flat * (1.0 - _E2 * normal / (normal + alt)))
    alt = flat * np.cos(lat) + z * np.sin(lat) - EARTH * np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    return np.stack([np.degrees(np.arctan2(y, x)), np.degrees(lat), alt], -1)


def compass(ground: Array) -> Array:
    """East, north, up as rows (..., 3, 3) at ground points (..., 3)."""
    lon, lat = np.radians(ground[..., 0]), np.radians(ground[..., 1])
    sl, cl, sp, cp, zero = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat), np.zeros_like(lon)
    rows = [[-sl, cl, zero], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def beside(place: Array, enu: Array) -> Array:
    """Ground points (..., 3) at metres east, north, up (..., 3) of one (3,), altitudes being over the ellipsoid."""
    flat = geodetic(ecef(place) + enu[..., :2] @ compass(place)[:2])
    flat[..., 2] = place[2] + enu[..., 2]
    return flat


def unit(v: Array) -> Array:
    """Vectors (..., 3) of length one."""
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def turned(w: Array) -> Array:
    """Rotation matrices (n, 3, 3) of rotation vectors (n, 3) [rad]."""
    angle = np.linalg.norm(w, axis=-1)[:, None, None]
    zero = np.zeros(len(w))
    x, y, z = w.T
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    safe = np.maximum(angle, 1e-30)
    first = np.where(angle > 1e-9, np.sin(angle) / safe, 1.0)
    second = np.where(angle > 1e-9, 2.0 * np.sin(angle / 2.0) ** 2 / safe**2, 0.5)
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


def vector(matrix: Array) -> Array:
    """Rotation vectors (n, 3) of rotation matrices (n, 3, 3) that turn by less than a right angle."""
    skew = np.stack(
        [
            matrix[:, 2, 1] - matrix[:, 1, 2],
            matrix[:, 0, 2] - matrix[:, 2, 0],
            matrix[:, 1, 0] - matrix[:, 0, 1],
        ],
        -1,
    )
    sine = np.linalg.norm(skew, axis=1, keepdims=True) / 2.0
    return np.asarray(skew / 2.0 * np.where(sine > 1e-9, np.arcsin(np.clip(sine, 0, 1)) / np.maximum(sine, 1e-30), 1))


@dataclass(frozen=True, eq=False)
class Pass:
    """A circular orbit, at time 0 nearest to a target.

    Parameters
    ----------
    target : (3,), longitude, latitude [deg], altitude [m]
    altitude : float, of the orbit [m]
    heading : float, direction of the flight [deg from north]
    roll : float, incidence at the target at time 0, to the right of the flight [deg]
    """

    target: Array
    altitude: float
    heading: float
    roll: float

    @property
    def _frame(self) -> tuple[float, Array, Array]:
        east, north, up = compass(self.target)
        beta = np.radians(self.heading)
        ahead = np.sin(beta) * east + np.cos(beta) * north
        aside = np.cross(ahead, up)
        ground = ecef(self.target)
        radius = float(np.linalg.norm(ground)) + self.altitude
        centre = unit(ground)
        ahead = unit(ahead - (ahead @ centre) * centre)
        arc = earth_arc(self.roll, self.altitude)
        return radius, np.cos(arc) * centre + np.sin(arc) * unit(aside), ahead

    @property
    def rate(self) -> float:
        """Angular velocity [rad/s]."""
        return float(np.sqrt(GRAVITY / (np.linalg.norm(ecef(self.target)) + self.altitude) ** 3))

    def at(self, t: Array) -> tuple[Array, Array]:
        """Geocentric places and unit directions of the flight (n, 3) at times (n,) [s], on the turning Earth."""
        radius, u, v = self._frame
        u = unit(u - (u @ v) * v)
        angle = self.rate * t[:, None]
        place, ahead = np.cos(angle) * u + np.sin(angle) * v, np.cos(angle) * v - np.sin(angle) * u
        c, s = np.cos(TURN * t), np.sin(TURN * t)

        def spun(a: Array) -> Array:
            return np.stack([c * a[:, 0] + s * a[:, 1], c * a[:, 1] - s * a[:, 0], a[:, 2]], -1)

        return radius * spun(place), spun(ahead)

    def time(self, pitch: float) -> float:
        """When the satellite is seen under an incidence along its flight, looking back at the target [s]."""
        return float(earth_arc(pitch, self.altitude)) / self.rate


def earth_arc(incidence: float, altitude: float) -> float:
    """Angle at the Earth's centre between a target and the satellite seen under an incidence [rad]."""
    i = np.radians(incidence)
    return float(i - np.arcsin(np.sin(i) * 6371e3 / (6371e3 + altitude)))


# --- cameras ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Flaw:
    """What is wrong with a camera.

    Parameters
    ----------
    attitude, place : (3,), constant turn [rad] and shift of the orbit [m, geocentric]
    drift : (3,), turn at the last row, its opposite at the first [rad]
    pointing : functions of the row: col and row by which the picture is off [px]
    chips : (8, 2), displacement of the detectors, col and row [px]
    focal, rate : float, relative errors of focal length and line period
    air : float, displacement along the columns' middle line of sight by height: at `air_alt` +- `air_half` [px]
    lost : row after which lines were never written, and their number; all that follows is numbered too low
    """

    attitude: Array = field(default_factory=lambda: np.zeros(3))
    place: Array = field(default_factory=lambda: np.zeros(3))
    drift: Array = field(default_factory=lambda: np.zeros(3))
    pointing: tuple[Pointing, ...] = ()
    chips: Array = field(default_factory=lambda: np.zeros((CHIPS, 2)))
    focal: float = 0.0
    rate: float = 0.0
    air: float = 0.0
    air_alt: float = 0.0
    air_half: float = 1.0
    lost: tuple[float, float] = (np.inf, 0.0)


SOUND = Flaw()


@dataclass(frozen=True, eq=False)
class Camera:
    """A pushbroom that scans while it turns.

    Parameters
    ----------
    orbit : Pass
    time : float, of the middle row [s]
    period : float, of a row [s]
    size : (cols, rows)
    ifov : float, angle of a pixel [rad]
    middle : (3, 3), attitude at the middle row: camera axes as columns
    turns : (degree + 1, 3), Chebyshev coefficients of the rotation vector from there, over the scan and a margin
    bow, bend : float, nominal optics: detectors off the straight line, and cubic distortion, at the edges [px]
    """

    orbit: Pass
    time: float
    period: float
    size: tuple[int, int]
    ifov: float
    middle: Array
    turns: Array
    bow: float
    bend: float

    def _half(self) -> float:
        return _half_span(self.size[1], self.period)

    def _pose(self, row: Array, flaw: Flaw) -> tuple[Array, Array]:
        """Place (n, 3) and attitude (n, 3, 3) at rows."""
        lag = (row - (self.size[1] - 1) / 2.0) * self.period * (1.0 + flaw.rate)
        turn = np.asarray(np.polynomial.chebyshev.chebval(np.clip(lag / self._half(), -1.2, 1.2), self.turns).T, float)
        off = np.zeros((len(row), 2))
        for pointing in flaw.pointing:
            off = off + pointing(row)
        wrong = flaw.attitude + flaw.drift * (2.0 * row / (self.size[1] - 1) - 1.0)[:, None]
        wrong = wrong + np.stack([-off[:, 0], -off[:, 1], np.zeros(len(row))], -1) * self.ifov
        return self.orbit.at(self.time + lag)[0] + flaw.place, self.middle @ (turned(turn) @ turned(wrong))

    def _look(self, col: Array, flaw: Flaw) -> Array:
        """Tangents x, y (n, 2) of columns; of `flaw` the focal length."""
        half = (self.size[0] - 1) / 2.0
        u = (col - half) / half
        return np.stack([self.bow * u**2, -(u * half + self.bend * u**3)], -1) * self.ifov * (1.0 + flaw.focal)

    def _column(self, y: Array, flaw: Flaw) -> Array:
        """The column (n,) of a tangent y (n,)."""
        half = (self.size[0] - 1) / 2.0
        goal = -y / (self.ifov * (1.0 + flaw.focal))
        offset = goal
        for _ in range(5):
            offset = goal - self.bend * (offset / half) ** 3
        return offset + half

    def sight(self, image: Array, flaw: Flaw = SOUND) -> tuple[Array, Array]:
        """Where rays (n, 3) start and their directions."""
        place, attitude = self._pose(image[:, 1] + flaw.lost[1] * (image[:, 1] > flaw.lost[0]), flaw)
        look = self._look(image[:, 0], flaw)
        return place, unit((attitude @ np.column_stack([look, np.ones(len(look))])[..., None])[..., 0])

    def localize(self, image: Array, alt: Array, flaw: Flaw = SOUND) -> Array:
        """Ground points (n, 3) seen at image points (n, 2) at altitudes (n,)."""
        place, direction = self.sight(image, flaw)
        length = np.full(len(image), self.orbit.altitude)
        for _ in range(12):
            ground = geodetic(place + length[:, None] * direction)
            length += (alt - ground[:, 2]) / np.sum(direction * compass(ground)[:, 2], axis=1)
        return geodetic(place + length[:, None] * direction)

    def project(self, ground: Array, flaw: Flaw = SOUND) -> Array:
        """Image points (n, 2) of ground points (n, 3); NaN where no row sees one, as at a jump."""
        goal = ecef(ground)
        row = np.full(len(ground), (self.size[1] - 1) / 2.0)
        slope = np.full(len(ground), -1.0)
        before = (row, np.zeros(len(ground)))
        for step in range(40):
            miss, col = self._miss(row, goal, flaw)
            if step == 1:
                far = np.abs(row - before[0]) > 100.0
                slope[far] = np.clip((miss - before[1])[far] / (row - before[0])[far], -1.6, -0.6)
            if not np.nanmax(np.abs(miss)) > 1e-8:
                break
            before, row = (row, miss), np.clip(row - miss / slope, -1.5 * self.size[1], 2.5 * self.size[1])
        chip = np.clip(col * CHIPS // self.size[0], 0, CHIPS - 1).astype(np.int64)
        image = np.column_stack([col, row]) + flaw.chips[chip]
        if flaw.air:
            image[:, 1] += flaw.air * (ground[:, 2] - flaw.air_alt) / flaw.air_half
            image[:, 0] += 0.5 * flaw.air * ((ground[:, 2] - flaw.air_alt) / flaw.air_half) ** 2
        low, gone = flaw.lost
        image[(np.abs(miss) > 1e-6) | ((row > low) & (row < low + gone))] = np.nan
        image[row > low, 1] -= gone
        return image

    def _miss(self, row: Array, goal: Array, flaw: Flaw) -> tuple[Array, Array]:
        """How far a row looks past places (n, 3) [px], and their columns."""
        place, attitude = self._pose(row, flaw)
        v = (np.swapaxes(attitude, 1, 2) @ (goal - place)[..., None])[..., 0]
        col = self._column(v[:, 1] / v[:, 2], flaw)
        return (v[:, 0] / v[:, 2] - self._look(col, flaw)[:, 0]) / self.ifov, col


def _half_span(rows: int, period: float) -> float:
    return 0.55 * rows * period + 0.05


def aim(
    orbit: Pass,
    pitch: float,
    size: tuple[int, int],
    gsd: float,
    *,
    scan: float | None = None,
    speed: float = 1.0,
    optics: tuple[float, float] = (2.0, 1.5),
) -> Camera:
    """A camera over the orbit's target, looking back by `pitch` degrees of incidence at its middle row.

    Parameters
    ----------
    scan : float, None: it looks steadily along its flight; else it slews so as to scan towards an azimuth [deg]
    speed : float, of an agile scan over the ground, the steady one being 1
    optics : bow, bend [px]
    """
    time = orbit.time(pitch)
    place, ahead = orbit.at(np.array([time]))
    target = ecef(orbit.target)
    ifov = gsd / float(np.linalg.norm(target - place[0]))
    steady = _steady_rate(orbit, time, place[0], ahead[0])
    period = gsd / (float(np.linalg.norm(steady)) * speed)
    lag = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES) * _half_span(size[1], period)
    if scan is None:
        first = _frame(target - place[0], steady)
        carried = np.swapaxes(_level(place, ahead), 1, 2)[0] @ first
        attitude = _level(*orbit.at(time + lag)) @ carried
    else:
        beta = np.radians(scan)
        ground = np.stack([np.sin(beta) * lag, np.cos(beta) * lag, 0 * lag], -1)
        step = np.array([np.sin(beta), np.cos(beta), 0.0])
        over = step @ compass(orbit.target)
        pull = np.linalg.norm(over - (over @ unit(target - place[0])) * unit(target - place[0]))
        pace = gsd / period / pull
        aims = [ecef(beside(orbit.target, pace * (ground + d * step))) for d in (-0.05, 0.0, 0.05)]
        look = aims[1] - orbit.at(time + lag)[0]
        attitude = np.stack([_frame(d, v) for d, v in zip(look, aims[2] - aims[0], strict=True)])
        first = _frame(target - place[0], over)
    turns = np.polynomial.chebyshev.chebfit(lag / _half_span(size[1], period), vector(first.T @ attitude), _DEGREE)
    return Camera(orbit, time, period, size, ifov, first, np.asarray(turns, dtype=float), *optics)


def _level(place: Array, ahead: Array) -> Array:
    """Axes (n, 3, 3) that go with the flight, as columns: ahead, aside, down."""
    down = -unit(place)
    return np.stack([unit(ahead), np.cross(down, unit(ahead)), down], -1)


def _frame(look: Array, motion: Array) -> Array:
    """Camera axes as columns, z along a look and x along what a motion over the ground does to it."""
    z = unit(look)
    x = unit(motion - (motion @ z) * z)
    return np.stack([x, np.cross(z, x), z], -1)


def _steady_rate(orbit: Pass, time: float, place: Array, ahead: Array) -> Array:
    """How fast the ground in view moves, across the line of sight, while the attitude goes with the flight [m/s]."""
    target = ecef(orbit.target)
    carried = _level(place[None], ahead[None])[0].T @ unit(target - place)
    found = []
    for dt in (-0.1, 0.1):
        start, onward = orbit.at(np.array([time + dt]))
        direction = _level(start, onward)[0] @ carried
        length = np.linalg.norm(target - place)
        for _ in range(6):
            ground = geodetic(start[0] + length * direction)
            length += (orbit.target[2] - ground[2]) / (direction @ compass(ground)[2])
        found.append(start[0] + length * direction)
    motion = (found[1] - found[0]) / 0.2
    z = unit(target - place)
    return np.asarray(motion - (motion @ z) * z)


# --- the delivered RPC ------------------------------------------------------------------------------------

_POWERS = np.array(
    [
        (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (2, 0, 0), (0, 2, 0), (0, 0, 2),
        (1, 1, 1), (3, 0, 0), (1, 2, 0), (1, 0, 2), (2, 1, 0), (0, 3, 0), (0, 1, 2), (2, 0, 1), (0, 2, 1), (0, 0, 3),
    ]
)  # fmt: skip
"""Of longitude, latitude, altitude in the twenty terms, as RPC00B orders them."""


def _terms(x: Array) -> Array:
    power = [np.ones_like(x), x, x * x, x * x * x]
    return np.stack([power[i][:, 0] * power[j][:, 1] * power[k][:, 2] for i, j, k in _POWERS], axis=1)


def rpc_of(camera: Camera, alt_range: tuple[float, float]) -> tuple[RPC, float]:
    """The RPC of a sound camera over altitudes, and its largest error [px] on points of another grid."""
    image, ground = _grid(camera, alt_range, (19, 19, 7), 0.02)
    low, high = ground.min(axis=0), ground.max(axis=0)
    low[2], high[2] = alt_range
    centre, scale = (low + high) / 2.0, (high - low) / 2.0
    half = (np.array(camera.size) - 1) / 2.0
    terms, goal = _terms((ground - centre) / scale), (image - half) / half
    coeffs = np.concatenate([_quotient(terms, g) for g in goal.T]).reshape(4, 20)
    rpc = RPC(coeffs, centre, scale, half, half)
    image, ground = _grid(camera, alt_range, (12, 14, 4), 0.0)
    return rpc, float(np.abs(rpc.project(ground) - image).max())


def _grid(camera: Camera, alt_range: tuple[float, float], counts: Sequence[int], margin: float) -> tuple[Array, Array]:
    cols, rows = camera.size
    col = np.linspace(-margin, 1 + margin, counts[0]) * (cols - 1)
    row = np.linspace(-margin, 1 + margin, counts[1]) * (rows - 1)
    alt = np.linspace(*alt_range, counts[2])
    mesh = np.stack(np.meshgrid(col, row, alt), -1).reshape(-1, 3)
    return mesh[:, :2], camera.localize(mesh[:, :2], mesh[:, 2])


def _quotient(terms: Array, goal: Array) -> Array:
    """Numerator and denominator (40,), the latter's constant being 1, by least squares that ask for small ones."""
    weight = np.ones(len(goal))
    ridge = 1e-7 * np.sqrt(len(goal)) * np.eye(39)
    for _ in range(4):
        matrix = np.hstack([terms, -goal[:, None] * terms[:, 1:]]) * weight[:, None]
        found = np.linalg.lstsq(np.vstack([matrix, ridge]), np.append(goal * weight, np.zeros(39)), rcond=None)[0]
        below = np.append(1.0, found[20:])
        weight = 1.0 / (terms @ below)
    return np.concatenate([found[:20], below])


# --- relief -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Relief:
    """Fractal hills about a place.

    Parameters
    ----------
    place : (3,), longitude, latitude [deg], mean altitude [m]
    waves : (n, 4), east and north wave number [1/m], amplitude [m], phase
    """

    place: Array
    waves: Array

    @classmethod
    def draw(cls, place: Array, height: float, extent: float, rng: np.random.Generator) -> Relief:
        """Hills that reach over `height` metres; the longest wave is as long as the scene."""
        length = extent * 2.0 ** -rng.uniform(0.0, 7.0, 90)
        angle = rng.uniform(0, 2 * np.pi, 90)
        amplitude = length**0.95 * rng.uniform(0.3, 1.0, 90)
        number = 2 * np.pi / length
        waves = np.column_stack(
            [number * np.cos(angle), number * np.sin(angle), amplitude, rng.uniform(0, 2 * np.pi, 90)]
        )
        waves[:, 2] *= height / (5.0 * np.sqrt(0.5 * np.sum(amplitude**2)))
        return cls(place, waves)

    def over(self, enu: Array) -> Array:
        """Ground points (n, 3) at metres east, north (n, 2) of the place."""
        phase = enu @ self.waves[:, :2].T + self.waves[:, 3]
        return beside(self.place, np.column_stack([enu, np.sin(phase) @ self.waves[:, 2]]))


def main() -> None:
    """Say what this is for."""
    argparse.ArgumentParser(description="Cameras for benchmarks/worlds.py, which has the commands.").parse_args()


if __name__ == "__main__":
    main()
