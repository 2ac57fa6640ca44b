"""The ground that is simulated: smooth fractal relief with box-shaped buildings, in a local plane.

x (east) and y (north) are metres on a plane that is tied to longitude and latitude by two constant factors;
heights stay altitudes above the ellipsoid. Nothing is approximated by that: the plane is only a name for
(lon, lat), and lines of sight are brought into it from the rigorous camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import fft, ndimage

from barpc.base.errors import InputError
from barpc.base.geodesy import Array, BoolArray, metres_per_unit, wrap_longitude

Float32 = npt.NDArray[np.float32]

STEEPEST = 0.8
"""Largest slope of the relief: below 1 / tan(incidence), so that only buildings hide anything."""
TALLEST = 40.0
"""Height of the tallest building [m]."""


@dataclass(frozen=True)
class Plane:
    """Local metres around a place.

    Parameters
    ----------
    lon, lat : float
        Origin [deg].
    """

    lon: float
    lat: float

    def xy(self, ground: Array) -> Array:
        """x, y (..., 2) [m] of ground points (..., 3)."""
        delta = np.stack([wrap_longitude(ground[..., 0], self.lon) - self.lon, ground[..., 1] - self.lat], -1)
        return np.asarray(delta * self._factor)

    def ground(self, xyz: Array) -> Array:
        """Ground points (..., 3) [deg, deg, m] of x, y, alt (..., 3) [m]."""
        out = np.array(xyz, dtype=np.float64)
        out[..., :2] = out[..., :2] / self._factor + (self.lon, self.lat)
        out[..., 0] = wrap_longitude(out[..., 0])
        return out

    @property
    def _factor(self) -> Array:
        return metres_per_unit(np.array([self.lon, self.lat, 0.0]))[:2]


@dataclass(frozen=True, eq=False)
class Grid:
    """Values on a square grid, linear in each cell: value(x, y) is defined everywhere, to the last digit.

    Parameters
    ----------
    origin : (2,)
        x, y [m] of values[0, 0]; rows go north, columns east.
    step : float
        [m]
    values : (H, W)
        float32.
    beyond : str
        What is beyond the edge: "nearest", the edge's; "mirror", all of it again and again.
    """

    origin: Array
    step: float
    values: Float32
    beyond: str = "nearest"

    def __call__(self, x: Array, y: Array) -> Float32:
        """Values (...) at places x, y (...) [m]."""
        place = np.stack([(y - self.origin[1]) / self.step, (x - self.origin[0]) / self.step])
        out: Float32 = ndimage.map_coordinates(
            self.values, place, output=np.float32, order=1, mode=self.beyond, prefilter=False
        )
        return out

    def axes(self) -> tuple[Array, Array]:
        """Of the nodes: x (W,) and y (H,) [m]."""
        height, width = self.values.shape
        return self.origin[0] + self.step * np.arange(width), self.origin[1] + self.step * np.arange(height)


@dataclass(frozen=True, eq=False)
class Buildings:
    """Boxes with flat roofs.

    Parameters
    ----------
    center : (B, 2)
        x, y [m].
    half : (B, 2)
        Half sides [m].
    angle : (B,)
        Direction of the first side, counter-clockwise from x [rad].
    top : (B,)
        Altitude of the roof [m].
    foot : (B,)
        Altitude below which the walls are underground all around [m].
    """

    center: Array
    half: Array
    angle: Array
    top: Array
    foot: Array

    def __len__(self) -> int:
        """Number of buildings B."""
        return len(self.top)

    def repeated(self, low: Array, side: Array, first: Array, last: Array) -> Buildings:
        """The same on a ground that is mirrored: of the part from `low` with `side` (2,) [m] the copies `first` to
        `last` (2,) each way; copy 0 is the part itself.
        """
        copies = [(k, n) for n in range(first[1], last[1] + 1) for k in range(first[0], last[0] + 1)]
        at = np.array(copies)[:, None, :]
        place = self.center - low
        center = low + side * at + np.where(at % 2, side - place, place)
        turned = np.where(at.sum(axis=2) % 2, -self.angle, self.angle).ravel()
        half, top, foot = (np.concatenate([one] * len(copies)) for one in (self.half, self.top, self.foot))
        return Buildings(center.reshape(-1, 2), half, turned, top, foot)

    def sides(self, index: int, x: Array, y: Array) -> tuple[Array, Array]:
        """Coordinates (...) of places along the two sides of one building, from its centre [m]."""
        cosine, sine = np.cos(self.angle[index]), np.sin(self.angle[index])
        dx, dy = x - self.center[index, 0], y - self.center[index, 1]
        return cosine * dx + sine * dy, cosine * dy - sine * dx

    def under(self, index: int, x: Array, y: Array) -> BoolArray:
        """Whether places (...) lie beneath the roof of one building."""
        u, v = self.sides(index, x, y)
        return np.asarray((np.abs(u) < self.half[index, 0]) & (np.abs(v) < self.half[index, 1]))

    def corners(self) -> Array:
        """x, y, alt (B, 8, 3) [m] of the corners, four at the foot and four at the top."""
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        u, v = np.moveaxis(signs * self.half[:, None], 2, 0)
        cosine, sine = np.cos(self.angle)[:, None], np.sin(self.angle)[:, None]
        x = self.center[:, :1] + cosine * u - sine * v
        y = self.center[:, 1:] + sine * u + cosine * v
        out = np.empty((len(self), 8, 3))
        out[:, :4, 0] = out[:, 4:, 0] = x
        out[:, :4, 1] = out[:, 4:, 1] = y
        out[:, :4, 2], out[:, 4:, 2] = self.foot[:, None], self.top[:, None]
        return out

    def inside(self, index: int, ray: Ray) -> tuple[Array, Array, Array]:
        """Between which altitudes lines run through one building.

        Parameters
        ----------
        index : int
            Which building.
        ray : Ray
            The lines (...).

        Returns
        -------
        low, high : (...)
            [m]; low >= high where the line misses the building.
        wall : (...)
            What is met at `high`, coming from above: 0 the roof, 1 or 2 a wall across the first or second
            side.
        """
        u, v = self.sides(index, ray.x, ray.y)
        cosine, sine = np.cos(self.angle[index]), np.sin(self.angle[index])
        with np.errstate(divide="ignore", invalid="ignore"):
            low_u, high_u = _slab(u, cosine * ray.dx + sine * ray.dy, self.half[index, 0])
            low_v, high_v = _slab(v, cosine * ray.dy - sine * ray.dx, self.half[index, 1])
        side = np.minimum(high_u, high_v) + ray.alt
        wall = np.where(side >= self.top[index], 0, np.where(high_u < high_v, 1, 2))
        return np.maximum(low_u, low_v) + ray.alt, np.minimum(side, self.top[index]), wall


@dataclass(frozen=True, eq=False)
class Ray:
    """Straight lines in the plane's coordinates: x(z) = x + dx (z - alt), y(z) = y + dy (z - alt).

    Parameters
    ----------
    x, y : (...)
        [m] at the altitude `alt`.
    dx, dy : (...)
        Metres a metre of altitude.
    alt : float
        [m]
    """

    x: Array
    y: Array
    dx: Array
    dy: Array
    alt: float | Array

    def at(self, alt: Array | float) -> tuple[Array, Array]:
        """x, y (...) [m] at altitudes (...)."""
        rise = alt - self.alt
        return self.x + self.dx * rise, self.y + self.dy * rise

    def part(self, *index: slice) -> Ray:
        """Some of the lines."""
        return Ray(self.x[index], self.y[index], self.dx[index], self.dy[index], self.alt)


def _slab(start: Array, rate: Array, half: float) -> tuple[Array, Array]:
    """Where start + rate t lies between -half and +half: from t = low to t = high."""
    one, other = (-half - start) / rate, (half - start) / rate
    return np.minimum(one, other), np.maximum(one, other)


@dataclass(frozen=True, eq=False)
class Terrain:
    """Relief and buildings.

    Parameters
    ----------
    plane : Plane
        Where x, y are.
    relief : Grid
        Altitude of the bare ground [m].
    buildings : Buildings
        What stands on it.
    """

    plane: Plane
    relief: Grid
    buildings: Buildings

    def alt_range(self) -> tuple[float, float]:
        """Lowest ground and highest roof [m]."""
        top = self.buildings.top.max(initial=float(self.relief.values.max()))
        return float(self.relief.values.min()), float(top)

    def highest(self, x: Array, y: Array) -> Array:
        """Altitudes (N,) of the highest there is at places (N,): the ground, or a roof."""
        alt = self.relief(x, y).astype(np.float64)
        for i in range(len(self.buildings)):
            on = self.buildings.under(i, x, y)
            alt[on] = np.maximum(alt[on], self.buildings.top[i])
        return alt

    def trace(self, ray: Ray, steps: int = 8) -> Array:
        """Altitudes (...) where lines meet the bare ground: the secant method, from the middle altitude."""
        z0 = np.full(np.shape(ray.x), float(self.relief.values.mean()))
        f0 = self.relief(*ray.at(z0)) - z0
        z1 = z0 + f0
        for _ in range(steps):
            f1 = np.asarray(self.relief(*ray.at(z1)) - z1)
            if np.abs(f1).max(initial=0.0) < 1e-4:
                return np.asarray(z1 + f1)
            with np.errstate(divide="ignore", invalid="ignore"):
                slope = (f1 - f0) / (z1 - z0)
            # f falls by 1 -+ slope x tan(incidence) a metre: keep the step where rounding hides that
            step = -f1 / np.where((slope < -0.3) & (slope > -2.0), slope, -1.0)
            z0, f0, z1 = z1, f1, z1 + step
        return np.asarray(z1)


def fractal(rng: np.random.Generator, shape: tuple[int, int], exponent: float, shortest: float = 2.0) -> Float32:
    """Noise with the amplitude spectrum f^-exponent, mean 0 and standard deviation 1.

    Parameters
    ----------
    rng : numpy.random.Generator
    shape : tuple of int
        Rows, columns.
    exponent : float
        1 has as much contrast in every octave; larger is smoother.
    shortest : float
        Wavelengths below fade out [cells].

    Returns
    -------
    noise : (H, W)
        float32.
    """
    full = [fft.next_fast_len(n, real=True) for n in shape]
    spectrum = fft.rfft2(rng.standard_normal(full, dtype=np.float32))
    fy, fx = np.fft.fftfreq(full[0])[:, None], np.fft.rfftfreq(full[1])
    f2 = (fy * fy + fx * fx).astype(np.float32)
    f2[0, 0] = 1.0
    gain = f2 ** np.float32(-0.5 * exponent) * np.exp(f2 * np.float32(-(shortest**2)))
    gain[0, 0] = 0.0
    noise: Float32 = fft.irfft2(spectrum * gain, s=full).astype(np.float32)[: shape[0], : shape[1]]
    return np.asarray((noise - noise.mean()) / noise.std(), dtype=np.float32)


def make_terrain(
    rng: np.random.Generator,
    plane: Plane,
    bounds: tuple[float, float, float, float],
    alt: float,
    relief: float,
    density: float,
) -> Terrain:
    """Fractal relief with buildings.

    Parameters
    ----------
    rng : numpy.random.Generator
    plane : Plane
    bounds : tuple of float
        Lowest x and y, highest x and y [m].
    alt : float
        Mean altitude of the ground [m].
    relief : float
        Difference between its highest and lowest point [m]; less where slopes would exceed `STEEPEST`.
    density : float
        Buildings a hectare.

    Returns
    -------
    terrain : Terrain
    """
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
    if not (high > low).all() or relief < 0 or density < 0:
        raise InputError("terrain: bounds must have an area, relief and density must not be negative")
    step = 2.0
    width, height = (int(n) for n in np.ceil((high - low) / step) + 1)
    shape = fractal(rng, (height, width), 2.2, 8.0)
    shape = (shape - shape.mean()) / np.ptp(shape)
    slope = max(float(np.abs(np.diff(shape, axis=axis)).max()) / step for axis in (0, 1)) * np.sqrt(2.0)
    size = min(relief, STEEPEST / slope)
    ground = Grid(low, step, (np.float32(alt) + np.float32(size) * shape).astype(np.float32))
    return Terrain(plane, ground, _buildings(rng, ground, low, high, density))


def _buildings(rng: np.random.Generator, ground: Grid, low: Array, high: Array, density: float) -> Buildings:
    """Boxes that do not touch each other, most of them low, along a few directions."""
    count = rng.poisson(density * np.prod(high - low) / 1e4)
    center = rng.uniform(low, high, (count, 2))
    half = rng.uniform(4.0, 12.0, (count, 2)) * rng.choice([0.7, 1.0, 1.6], (count, 1), p=[0.4, 0.5, 0.1])
    radius = np.hypot(*half.T) + 2.0
    keep: list[int] = []
    for i in range(count):
        apart = np.hypot(*(center[keep] - center[i]).T) > radius[keep] + radius[i]
        if apart.all():
            keep.append(i)
    center, half, radius = center[keep], half[keep], radius[keep]
    angle = rng.choice(rng.uniform(0, np.pi / 2, 3), len(keep)) + rng.normal(0, 0.05, len(keep))
    floors = np.minimum(rng.gamma(2.0, 1.6, len(keep)) + 1.0, TALLEST / 3.0)
    at = ground(*center.T).astype(np.float64)
    return Buildings(center, half, angle, at + 3.0 * floors, at - STEEPEST * radius - 2.0)
