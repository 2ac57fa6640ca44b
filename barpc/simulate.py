"""Known truth: blocks of views with tie points and their exact geometry, without pixels, to try an adjustment on.

The delivered camera of a view is an RPC P fitted to a pushbroom model; the exact camera is P behind a known
correction, P(R (X - T - C) + C). So the corrections that an adjustment looks for exist to the last digit, for
ten views or ten thousand. One RPC is fitted for every row of sites and every look; within a row the cameras
are turned about the Earth's axis, under which an RPC only changes the offset of its longitude.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from numpy.polynomial.polynomial import polyfit
from scipy.spatial.transform import Rotation

from barpc.base.errors import InputError
from barpc.base.geodesy import EARTH_RATE, Array, ecef_from_ground, enu_basis, metres_per_unit, wrap_longitude
from barpc.fit import fit_rpc
from barpc.scene import BoolArray, GroundPoints, IntArray, Tracks, View
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.curve import Curve, about_middle, rotation_matrix
from barpc.sensor.pushbroom import Pushbroom
from barpc.sensor.rpc import RPC
from barpc.sensor.triangulation import triangulate

__all__ = ["BlockOptions", "BlockTruth", "Look", "SimulatedBlock", "fly", "recentred", "simulate_block"]


@dataclass(frozen=True)
class BlockOptions:
    """Layout and errors of a simulated block."""

    per_site: int = 3  # views of every site
    size: tuple[int, int] = (20000, 20000)  # width, height of every image [px]
    gsd: float = 0.5  # ground sampling distance at nadir [m]
    overlap: float = 0.2  # part of an image's side that it shares with the next site, at most 0.5
    alt_range: tuple[float, float] = (0.0, 600.0)  # altitudes of the ground [m]
    visible: float = 0.9  # probability that a view that covers a point shows it
    attitude: float = 15e-6  # standard deviation of each component of the attitude error [rad]
    position: float = 1.0  # standard deviation of each component of the position error [m]
    drift: float = 0.0  # standard deviation of each component of the attitude's drift over an image [rad]
    noise: float = 0.1  # standard deviation of each image coordinate [px]
    outliers: float = 0.0  # part of the observations that are wrong
    outlier_size: float = 30.0  # wrong observations are off by up to so much in each coordinate [px]

    def __post_init__(self) -> None:
        if self.per_site < 1 or min(self.size) < 64 or not self.gsd > 0:
            raise InputError("block: per_site, size and gsd must be positive")
        parts = {"overlap": self.overlap, "visible": self.visible, "outliers": self.outliers}
        for name, value in parts.items():
            if not 0.0 <= value <= 1.0:
                raise InputError(f"block: {name} {value} is not between 0 and 1")
        if self.overlap > 0.5 or not self.alt_range[0] < self.alt_range[1]:
            raise InputError("block: overlap must be at most 0.5 and the altitude range no point")


@dataclass(frozen=True)
class _SiteGrid:
    """Sites on a square grid, row by row: counts, centre and steps [deg]."""

    columns: int
    rows: int
    lon: float
    lat: float
    step: tuple[float, float]

    @classmethod
    def square(cls, num_views: int, options: BlockOptions, lon: float, lat: float) -> _SiteGrid:
        """Return the grid that holds `num_views` views around a centre [deg]."""
        sites = -(-num_views // options.per_site)
        columns = int(np.ceil(np.sqrt(sites)))
        rows = -(-sites // columns)
        metres = (1.0 - options.overlap) * options.gsd * np.array(options.size, dtype=np.float64)
        step = metres / metres_per_unit(np.array([lon, lat, 0.0]))[:2]
        if abs(lat) + 0.5 * rows * step[1] > 85.0:
            raise InputError("block: it would reach beyond 85 degrees of latitude")
        return cls(columns, rows, lon, lat, (float(step[0]), float(step[1])))

    def lonlat(self, row: npt.ArrayLike, column: npt.ArrayLike) -> tuple[Array, Array]:
        """Return the longitude and latitude [deg] of (fractional) places on the grid."""
        lon = self.lon + self.step[0] * (np.asarray(column) - 0.5 * (self.columns - 1))
        lat = self.lat - self.step[1] * (np.asarray(row) - 0.5 * (self.rows - 1))
        return wrap_longitude(lon), lat


@dataclass(frozen=True, eq=False)
class _SimulatedScene:
    """Who sees what: ground points drawn over the block and projected by the exact cameras."""

    cameras: tuple[Corrected, ...]
    grid: _SiteGrid
    options: BlockOptions
    rng: np.random.Generator

    def observe(self, count: int, fewest: int, visible: float) -> tuple[Array, Tracks]:
        """Return ground points (count, 3) that `fewest` views or more show, and their exact image points."""
        grounds = [np.empty((0, 3))]
        found = [(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 2)))]
        have = 0
        for _ in range(50):
            if have >= count:
                break
            ground, view, point, xy = self._draw(max(64, int(1.2 * (count - have))), visible)
            good = np.flatnonzero(np.bincount(point, minlength=len(ground)) >= fewest)
            wanted = min(len(good), count - have)  # points are sorted by site: take evenly, not the first
            good = good[np.arange(wanted) * len(good) // max(wanted, 1)]
            index = np.full(len(ground), -1)
            index[good] = have + np.arange(len(good))
            keep = index[point] >= 0
            grounds.append(ground[good])
            found.append((view[keep], index[point[keep]], xy[keep]))
            have += len(good)
        if have < count:
            raise InputError(f"block: only {have} of {count} points are seen by {fewest} views; more overlap")
        view, point, xy = (np.concatenate(parts) for parts in zip(*found, strict=True))
        order = np.lexsort((view, point))
        return np.concatenate(grounds), Tracks(view[order], point[order], xy[order], np.ones(len(order)))

    def _draw(self, count: int, visible: float) -> tuple[Array, IntArray, IntArray, Array]:
        """Draw random ground points and all of their observations: ground, view, point, xy."""
        grid, per_site = self.grid, self.options.per_site
        home = np.sort(self.rng.integers(0, -(-len(self.cameras) // per_site), count))
        offset = self.rng.uniform(-0.5, 0.5, (2, count)) / (1.0 - self.options.overlap)
        lon, lat = grid.lonlat(home // grid.columns + offset[0], home % grid.columns + offset[1])
        ground = np.stack([lon, lat, self.rng.uniform(*self.options.alt_range, count)], axis=1)
        size = np.array(self.options.size) - 1.0
        shown: list[tuple[IntArray, IntArray, Array]] = []
        for view, camera in enumerate(self.cameras):
            near = self._near(view // per_site, home)
            xy = camera.project(ground[near])
            inside = ((xy >= 0) & (xy <= size)).all(axis=1) & (self.rng.random(len(near)) < visible)
            shown.append((np.full(int(inside.sum()), view), near[inside], xy[inside]))
        views, point, image = (np.concatenate(parts) for parts in zip(*shown, strict=True))
        return ground, views, point, image

    def _near(self, site: int, home: IntArray) -> IntArray:
        """Return the indices of the points whose home is this site or one of its eight neighbours; `home`
        (N,) ascends.
        """
        row, column = divmod(site, self.grid.columns)
        rows = np.arange(max(0, row - 1), min(self.grid.rows, row + 2)) * self.grid.columns
        first = np.searchsorted(home, rows + max(0, column - 1))
        last = np.searchsorted(home, rows + min(self.grid.columns, column + 2))
        return np.concatenate([np.arange(a, b) for a, b in zip(first, last, strict=True)])


@dataclass(frozen=True, eq=False)
class BlockTruth:
    """Truth of a simulated block."""

    corrections: tuple[Correction, ...]  # of each view's sensor: with it, and its drift, the camera is exact
    drift: Array  # (V, 3): rotation vector over the height of the image [rad]; zero in the middle row
    ground: Array  # (P, 3): the tracks' ground points; lon, lat [deg], alt [m]
    outlier: BoolArray  # (K,): which observations are wrong
    check_ground: Array  # (Q, 3): held-out ground points; lon, lat [deg], alt [m]
    check: Tracks  # their exact image points in every view that sees them


@dataclass(frozen=True, eq=False)
class SimulatedBlock:
    """Views, tie points and GCPs as an adjustment receives them, with the truth."""

    views: tuple[View, ...]  # without pixels; `sensor` is the delivered RPC
    tracks: Tracks  # observations with noise and outliers
    gcps: GroundPoints  # exact ground points with noisy observations; empty unless asked for
    truth: BlockTruth  # what is to be found

    def held_out_rms(self, sensors: list[SensorModel]) -> float:
        """Return the root mean square residual [px, per coordinate] of the held-out points in other cameras.

        The points are triangulated anew from their exact image points: what no image can tell (a shift of the whole
        scene) does not count.
        """
        check = self.truth.check
        found = triangulate(sensors, check.view, check.point, check.xy)
        return float(np.sqrt(np.mean(found.residuals**2)))


def recentred(correction: Correction, center: Array) -> Correction:
    """Return a correction expressed about another camera centre (3,) [m, ECEF]: R stays, T takes up the difference."""
    turn = rotation_matrix(correction.rotation)
    shift = center - correction.center
    return Correction(correction.rotation, correction.translation + turn.T @ shift - shift, center)


def simulate_block(
    num_views: int = 3,
    num_tracks: int = 2000,
    *,
    seed: int = 0,
    lon: float = 5.4,
    lat: float = 43.3,
    num_checks: int = 500,
    num_gcps: int = 0,
    **options: object,
) -> SimulatedBlock:
    """Return a block of views with tie points, GCPs and held-out points.

    Views stand in groups of `per_site` over sites on a square grid; neighbouring sites overlap.

    Parameters
    ----------
    num_tracks, num_checks, num_gcps : int, a track or check point is seen by two views or more, a GCP by one
    seed : int, the same seed gives the same block
    lon, lat : float, centre of the block [deg]
    **options
        Fields of `BlockOptions`; InputError where they contradict each other, or the views do not overlap.
    """
    if num_views < 1 or num_tracks < 0 or num_checks < 0 or num_gcps < 0:
        raise InputError("block: at least one view, and no negative count")
    chosen = BlockOptions(**options)  # type: ignore[arg-type]
    rng = np.random.default_rng(seed)
    grid = _SiteGrid.square(num_views, chosen, lon, lat)
    views, centers = _simulated_views(grid, num_views, chosen)
    corrections = tuple(
        Correction(rng.normal(0, chosen.attitude, 3), rng.normal(0, chosen.position, 3), center) for center in centers
    )
    drift = rng.normal(0, chosen.drift, (num_views, 3)) if chosen.drift else np.zeros((num_views, 3))
    rows = chosen.size[1]
    exact = tuple(
        Corrected(v.sensor, replace(c, drift=d[None], row_offset=rows / 2, row_scale=rows) if d.any() else c)
        for v, c, d in zip(views, corrections, drift, strict=True)
    )
    scene = _SimulatedScene(exact, grid, chosen, rng)

    ground, tracks = scene.observe(num_tracks, fewest=2, visible=chosen.visible)
    noisy, outlier = _disturbed(tracks, chosen, rng)
    check_ground, check = scene.observe(num_checks, fewest=2, visible=1.0)
    gcps = _gcps(*scene.observe(num_gcps, fewest=1, visible=chosen.visible), chosen, rng)
    truth = BlockTruth(corrections, drift, ground, outlier, check_ground, check)
    return SimulatedBlock(views, noisy, gcps, truth)


def _gcps(ground: Array, seen: Tracks, options: BlockOptions, rng: np.random.Generator) -> GroundPoints:
    """Return GCPs at ground points (G, 3), where they are seen but for noise."""
    noisy, _ = _disturbed(seen, replace(options, outliers=0.0), rng)
    names, sigma = tuple(f"gcp_{i:03d}" for i in range(len(ground))), np.full((len(ground), 3), 0.1)
    return GroundPoints(names, ground, sigma, noisy.point, noisy.view, noisy.xy, noisy.sigma)


def _simulated_views(grid: _SiteGrid, num_views: int, options: BlockOptions) -> tuple[tuple[View, ...], list[Array]]:
    """Return the views with delivered RPCs, and their camera centres (3,) [m, ECEF]; site by site."""
    views: list[View] = []
    centers: list[Array] = []
    low, high = options.alt_range
    margin = 0.1 * (high - low) + 50.0
    alt_range = (low - margin, high + margin)
    for row in range(grid.rows):
        lon0, lat = grid.lonlat(row, 0)
        target = np.array([lon0, lat, 0.5 * (low + high)])
        flown = [fly(target, look, options.size, options.gsd) for look in looks(options.per_site, 0.17 * row)]
        fitted = [fit_rpc(model, options.size, alt_range).rpc for model in flown]
        places = [model.position(0.5 * (options.size[1] - 1)) for model in flown]
        for column in range(grid.columns):
            for rpc, place in zip(fitted, places, strict=True):
                if len(views) == num_views:
                    return tuple(views), centers
                turn = column * grid.step[0]
                name = f"view_{len(views):04d}"
                views.append(View(name, "", options.size, _turned(rpc, turn), alt_range))
                centers.append(rotation_matrix(np.array([0.0, 0.0, np.radians(turn)])) @ place)
    return tuple(views), centers


def _turned(rpc: RPC, degrees: float) -> RPC:
    offset = rpc.ground_offset + np.array([degrees, 0.0, 0.0])
    offset[0] = wrap_longitude(offset[0])
    return replace(rpc, ground_offset=offset)


def _disturbed(tracks: Tracks, options: BlockOptions, rng: np.random.Generator) -> tuple[Tracks, BoolArray]:
    """Return the observations with noise and outliers, and which are outliers (K,)."""
    count = len(tracks)
    xy = tracks.xy + (rng.normal(0, options.noise, (count, 2)) if options.noise else 0.0)
    outlier = np.zeros(count, dtype=bool)
    outlier[rng.permutation(count)[: round(options.outliers * count)]] = True
    xy[outlier] += rng.uniform(-options.outlier_size, options.outlier_size, (int(outlier.sum()), 2))
    return Tracks(tracks.view, tracks.point, xy, np.full(count, options.noise or 0.1)), outlier


# --- satellites on circular orbits: pushbroom cameras that look at a place from where asked ---------------


GM = 3.986004418e14  # gravitational constant of the Earth (WGS84) [m^3/s^2]
PITCH = 10.0  # views of one site are spread from -PITCH to +PITCH degrees of incidence along the flight
ROLL = 8.0  # largest incidence across the flight [deg]
_ORBIT_DEGREE = 4  # of the polynomials of time for position and attitude


@dataclass(frozen=True)
class Look:
    """Look direction, orbit and scan of a satellite."""

    incidence: float = 0.0  # angle between the vertical at the target and the satellite [deg]
    azimuth: float = 90.0  # of the satellite seen from the target, clockwise from north [deg]
    altitude: float = 694e3  # of the satellite above the ellipsoid [m]
    heading: float = 192.0  # of the flight [deg]; 192: a descending sun-synchronous pass in middle latitudes
    scan: float | None = None  # direction in which the rows advance over the ground [deg]; None: the heading


def looks(count: int, turn: float, altitude: float = Look.altitude) -> list[Look]:
    """Return looks at one place: pitch spread evenly, roll by the golden section, which starts at `turn` [turns]."""
    out = []
    for k in range(count):
        pitch = PITCH * (2 * k / (count - 1) - 1.0) if count > 1 else 0.0
        roll = ROLL * (2 * ((turn + 0.5 + 0.381966 * k) % 1.0) - 1.0)
        tangent = np.tan(np.radians([pitch, roll]))
        incidence = float(np.degrees(np.arctan(np.hypot(*tangent))))
        azimuth = (Look.heading + np.degrees(np.arctan2(tangent[1], tangent[0]))) % 360.0
        out.append(Look(incidence, float(azimuth), altitude))
    return out


def fly(target: Array, look: Look, size: tuple[int, int], gsd: float) -> Pushbroom:
    """Return a pushbroom camera that scans a target from a circular orbit.

    The orbit is a circle in the inertial frame, seen from the turning Earth. The attitude follows the scan:
    the line of sight of the middle of the detector moves over the ground in the direction of scan at `gsd` a
    line, the detector line stands across it, and columns run to the LEFT of the scan (for a descending pass
    north is up and east is right). Both are polynomials of time of degree 4.

    Parameters
    ----------
    target : (3,), ground point at the image's centre; lon, lat [deg], alt [m]
    size : (width, height) [px]
    gsd : float, ground sampling distance at nadir [m]; the pixel's angle is gsd / altitude
    """
    place, aim, enu = _standpoint(target, look), ecef_from_ground(target), enu_basis(target)
    heading = np.radians(look.heading)
    along = _horizontal(heading if look.scan is None else np.radians(look.scan)) @ enu
    rate = np.sqrt(GM / np.linalg.norm(place) ** 3)
    period = gsd / float(rate * np.linalg.norm(aim))
    half = 0.5 * (size[1] - 1) * period
    stop = 1.1 * half + 8 * period
    count = 2 * _ORBIT_DEGREE + 1  # times at which the guided motion is sampled
    times = stop * np.cos(np.pi * (np.arange(count) + 0.5) / count)[::-1]

    position = circular_orbit(place, _horizontal(heading) @ enu, rate, times)
    z = aim + (gsd / period) * times[:, None] * along - position
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    y = np.cross(z, along)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    mount, vectors = about_middle(Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=2)))
    orbit, attitude = (
        Curve.polynomial(polyfit(times + stop, values, _ORBIT_DEGREE), -stop, stop) for values in (position, vectors)
    )
    look_angles = np.array([[0.0, 0.0], [0.0, -gsd / look.altitude]])
    return Pushbroom(orbit, attitude, mount, look_angles, 0.5 * (size[0] - 1), period, -half)


def _horizontal(azimuth: float) -> Array:
    return np.array([np.sin(azimuth), np.cos(azimuth), 0.0])


def _standpoint(target: Array, look: Look) -> Array:
    """Return the satellite's position (3,) [m, ECEF]: on the line of sight, `altitude` beyond the radius at
    the target.
    """
    incidence, azimuth = np.radians([look.incidence, look.azimuth])
    enu = np.sin(incidence) * _horizontal(azimuth) + [0.0, 0.0, np.cos(incidence)]
    origin, direction = ecef_from_ground(target), enu @ enu_basis(target)
    foot = ecef_from_ground(np.array([target[0], target[1], 0.0]))
    along = origin @ direction
    radius = np.linalg.norm(foot) + look.altitude
    return np.asarray(origin + direction * (np.sqrt(along**2 + radius**2 - origin @ origin) - along))


def circular_orbit(place: Array, forward: Array, rate: float, times: Array) -> Array:
    """Return positions (N, 3) [m], ECEF, on an orbit that is a circle in inertial space, at times (N,) [s].

    At time 0 it is at `place` (3,) [m] and flies towards `forward` (3,), at `rate` [rad/s].
    """
    forward = forward - (forward @ place) / (place @ place) * place
    forward *= np.linalg.norm(place) / np.linalg.norm(forward)
    inertial = np.outer(np.cos(rate * times), place) + np.outer(np.sin(rate * times), forward)
    return Rotation.from_rotvec(np.outer(-EARTH_RATE * times, [0.0, 0.0, 1.0])).apply(inertial)
