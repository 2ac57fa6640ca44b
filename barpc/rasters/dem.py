"""Terrain heights from a DEM, always above the ellipsoid, and it is always said how they became so.

DEM files are mostly orthometric: above a geoid, up to 100 m from the ellipsoid. What a file says of unit, scale and
reference is applied; heights of unknown reference are taken as ellipsoidal, with a loud warning.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.windows import Window

from barpc.base.errors import BarpcWarning, ImageError, InputError
from barpc.base.geodesy import MAX_COORDINATE, STATED, Array, HeightDatum
from barpc.base.keywords import Files, PathLike
from barpc.base.remote import PathOrUrl, location
from barpc.base.safe_io import GRID, opened
from barpc.rasters.geographiclib import open_pgm
from barpc.rasters.raster import open_raster, reprojected, transformed
from barpc.rasters.vertical import ELLIPSOID, NO_GEOID, Vertical, geoid_file, geoid_of, vertical_of
from barpc.sensor import SensorModel

HEIGHT_DRIVERS = {
    ".hgt": ("SRTMHGT", Vertical("EGM96 height", geoid="egm96", provenance=STATED)),
    ".gtx": ("GTX", Vertical(ELLIPSOID, provenance=STATED)),
    ".pgm": ("PGM", Vertical(ELLIPSOID, provenance=STATED)),
}
"""Suffix -> the driver that may open it (its first bytes say nothing), and what its heights count from."""
_MAX_CELLS = 400_000_000
_TERRAIN_TOLERANCE = 1e-4  # m: of a place on the terrain
_A_POST = 4.0  # steps: with 60 m of noise a post, under 27 degrees, 1.7 % of lines pass a corner, of two steps 3.2 %
_SIGHT_STEPS = 64  # of a line of sight over a terrain whose posts are not known
_AT_ONCE = 500_000  # heights


@dataclass(frozen=True, eq=False)
class HeightGrid:
    """Heights at the nodes of a regular grid, read when they are asked for."""

    path: PathOrUrl
    driver: str | None
    shape: tuple[int, int]  # number of nodes: rows, cols
    crs: CRS
    to_pixel: Affine  # from coordinates to col, row, (0, 0) at the corner of the first node's cell
    west: float  # coordinate of the western edge
    vertical: Vertical  # what heights count from, and their unit
    linear: tuple[float, float]  # scale and offset of the numbers in the file, in that unit
    period: float  # columns in a full turn of longitude where the grid goes around the Earth, else 0

    @classmethod
    def open(cls, path: PathLike) -> HeightGrid:
        """Return a grid from ``.hgt`` (SRTM), ``.gtx`` (NOAA), ``.pgm`` (GeographicLib) or any raster with a CRS.

        InputError where it is none.
        """
        path = location(path)
        with opened(path, GRID) as file:
            length = file.seek(0, 2)
        driver, vertical = HEIGHT_DRIVERS.get(path.suffix.lower(), (None, None))
        try:
            with _open_heights(path, driver) as dataset:
                crs, shape, forward, extent = dataset.crs, dataset.shape, dataset.transform, dataset.bounds
                unit, linear = dataset.units[0] or "", (float(dataset.scales[0]), float(dataset.offsets[0]))
                if crs is None:
                    raise InputError(f"{path}: a DEM or geoid grid needs a CRS, and this raster has none")
                if not (np.isfinite(linear).all() and linear[0]):
                    raise InputError(f"{path}: its heights have scale {linear[0]:g} and offset {linear[1]:g}")
                if driver == "GTX" and length != 40 + 4 * shape[0] * shape[1]:
                    raise ImageError(f"{path}: its header does not go with its size")
        except ImageError as error:
            if driver is None:
                raise
            raise InputError(
                f"{error} (an SRTM tile is called as N44E005.hgt and has 1201 or 3601 nodes a side; a .gtx is as long "
                "as its header says)"
            ) from error
        to_pixel = _inverse_transform(forward, path)
        turn = 360.0 * abs(to_pixel.a) if crs.is_geographic else 0.0
        around = turn > 0 and (extent.right - extent.left) * abs(to_pixel.a) >= turn - 0.5
        vertical = vertical or vertical_of(crs.to_wkt(), unit, os.fspath(path))
        period = float(round(turn)) if around else 0.0
        return cls(path, driver, shape, crs, to_pixel, float(extent.left), vertical, linear, period)

    def read(self, top: int, bottom: int, left: int, right: int) -> Array:
        """Read the heights (bottom - top, right - left) [m] of a window, NaN in voids."""
        with _open_heights(self.path, self.driver) as dataset:
            window = Window.from_slices((top, bottom), (left, right))
            numbers = dataset.read(1, window=window, masked=True).astype(np.float64).filled(np.nan)
        scale, offset = self.linear
        return np.asarray((numbers * scale + offset) * self.vertical.metres)

    def locate(self, lon: Array, lat: Array) -> tuple[Array, Array]:
        """Return the fractional row, col (N,) of lon, lat (N,) [deg], node centres at integers."""
        if self.crs.is_geographic:
            x, y = self.west + np.mod(lon - self.west, 360.0), lat
        else:
            x, y = reprojected(self.path, CRS.from_epsg(4326), self.crs, lon, lat)
        col, row = transformed(self.to_pixel, x, y)
        return _snapped(row - 0.5), _snapped(col - 0.5)

    def place(self, row: Array, col: Array) -> tuple[Array, Array]:
        """Return the lon, lat (N,) [deg] of fractional row, col (N,), the inverse of `locate`."""
        x, y = transformed(~self.to_pixel, col + 0.5, row + 0.5)
        return (x, y) if self.crs.is_geographic else reprojected(self.path, self.crs, CRS.from_epsg(4326), x, y)

    def sample(self, lon: npt.ArrayLike, lat: npt.ArrayLike) -> Array:
        """Return the bilinear heights (...) [m] at lon, lat (...) [deg]; NaN outside and where a void has weight."""
        lon, lat = np.broadcast_arrays(np.asarray(lon, np.float64), np.asarray(lat, np.float64))
        row, col = self.locate(lon.ravel(), lat.ravel())
        if self.period:
            col = col % self.period
        height = np.full(lon.size, np.nan)
        rows, cols = self.shape
        edge = 1e-9 * max(rows, cols)  # a point on the outermost node, but for rounding
        last = self.period or cols - 1
        with np.errstate(invalid="ignore"):
            inside = (row >= -edge) & (row <= rows - 1 + edge) & (col >= -edge) & (col <= last + edge)
        if inside.any():
            height[inside] = self._bilinear(np.clip(row[inside], 0, rows - 1), np.clip(col[inside], 0, last))
        return height.reshape(lon.shape)

    def extremes(self, at: Array) -> tuple[float, float]:
        """Return the ends of the heights [m] around fractional row, col (2, N); infinite where unknown."""
        at, limits = at[:, np.isfinite(at).all(axis=0)], np.array(self.shape)
        if not at.size or self.period:  # around the Earth columns have no window
            return -np.inf, np.inf
        if (at.max(axis=1) < 0).any() or (at.min(axis=1) > limits - 1).any():
            return -np.inf, np.inf
        first = np.clip(np.floor(at.min(axis=1)).astype(np.int64), 0, limits - 1)
        last = np.clip(np.ceil(at.max(axis=1)).astype(np.int64) + 1, first + 1, limits)
        if np.prod(last - first) > _MAX_CELLS:
            return -np.inf, np.inf
        heights = self.read(int(first[0]), int(last[0]), int(first[1]), int(last[1]))
        heights = heights[np.isfinite(heights)]
        return (float(heights.min()), float(heights.max())) if len(heights) else (-np.inf, np.inf)

    def _bilinear(self, row: Array, col: Array) -> Array:
        from scipy.ndimage import map_coordinates  # a tenth of a second, of runs with terrain alone

        top, left = int(row.min()), int(col.min())
        bottom, right = int(row.max()) + 2, int(col.max()) + 2
        if (bottom - top) * (right - left) > _MAX_CELLS:
            raise InputError(f"{self.path}: the points spread over {(bottom - top) * (right - left)} cells")
        bottom, turn = min(bottom, self.shape[0]), int(self.period)
        if turn and right > self.shape[1]:
            parts = (left, min(turn, self.shape[1])), (0, right - turn)
            cells = np.concatenate([self.read(top, bottom, *part) for part in parts], axis=1)
        else:
            cells = self.read(top, bottom, left, min(right, self.shape[1]))
        void, at = np.isnan(cells), np.stack([row - top, col - left])
        height = map_coordinates(np.where(void, 0.0, cells), at, order=1, mode="nearest")
        height[map_coordinates(void.astype(np.float64), at, order=1, mode="nearest") > 0] = np.nan
        return np.asarray(height)


def _open_heights(path: PathOrUrl, driver: str | None) -> AbstractContextManager[Any]:
    return open_pgm(path) if driver == "PGM" else open_raster(path, driver)


def _snapped(index: Array) -> Array:
    """Return the fractional indices, on the node within a millionth of it: a void beyond has no weight."""
    node = np.rint(index)
    return np.where(np.abs(index - node) < 1e-6, node, index)


def _inverse_transform(forward: Affine, path: PathOrUrl) -> Affine:
    """Return the inverse transformation, from coordinates to pixels, where there is one."""
    numbers = np.array(forward[:6])
    area = abs(forward.determinant)
    if np.isfinite(numbers).all() and np.abs(numbers).max() <= MAX_COORDINATE and area >= MAX_COORDINATE**-2:
        return ~forward
    raise InputError(f"{path}: its geotransform {tuple(forward[:6])} maps no grid of nodes")


@dataclass(frozen=True, eq=False)
class Dem:
    """Altitudes of the terrain above the WGS84 ellipsoid: call it with lon, lat.

    Of several DEMs the first counts that has a height at a place. Where tiles abut, and their outermost posts are a
    step apart, heights are bilinear between the posts of both.
    """

    grid: HeightGrid  # the heights as the file gives them
    geoid: HeightGrid | None  # height of the geoid above the ellipsoid, added to `grid`
    description: str  # which vertical reference was read and what was done with it
    known: bool = True  # whether it is known what all of them count from
    taken: Vertical | None = None  # how the heights of this one were taken, where no person said it
    after: tuple[Dem, ...] = ()  # those that count where this one has no height, in their order

    @classmethod
    def open(cls, path: Files, geoid: PathLike | None = None, heights: str | None = None) -> Dem:
        """Open one DEM or several (``.hgt``, or any raster with a CRS), each with its own geoid or the one given.

        A geoid is a ``.gtx`` or raster, a name of `GEOIDS`, or "none" for ellipsoidal heights; `heights` the same for
        files that state none.

        What is given goes before what one DEM says of itself. Of several each is as it says; what is given holds for
        those that say nothing, and a grid also for those whose own geoid is not at hand.

        InputError or ImageError where it is none, or a geoid is given for heights that are ellipsoidal already, or for
        several of which each has its own; a BarpcWarning for an unknown vertical reference, or one for whose geoid
        another had to be taken.
        """
        said = None if geoid is None else os.fspath(geoid)
        grids = [HeightGrid.open(one) for one in ((path,) if isinstance(path, (str, os.PathLike)) else path)]
        first, *others = [cls._of(*both) for both in zip(grids, _given_geoids(grids, said, heights), strict=True)]
        words, known = "; ".join(one.description for one in (first, *others)), all(o.known for o in (first, *others))
        return replace(first, description=words, known=known, after=tuple(others))

    @classmethod
    def _of(cls, grid: HeightGrid, geoid: str | None) -> Dem:
        own, vertical = grid.vertical, grid.vertical.by(geoid)
        if own.reference == ELLIPSOID and vertical.geoid is not None:
            raise InputError(f"{grid.path}: its heights are ellipsoidal already; leave out the geoid {geoid}")
        file, done, loud = geoid_of(own, vertical, geoid is not None)
        unit = f" in {own.unit} ({abs(own.metres):.12g} m)" if own.unit else ""
        description = f"{location(grid.path).name}: vertical reference {own.reference}{unit}, {done}"
        if loud:
            warnings.warn(f"DEM {description}", BarpcWarning, stacklevel=3)
        taken = vertical if geoid is None else None
        return cls(grid, None if file is None else HeightGrid.open(file), description, vertical.stated, taken)

    @property
    def parts(self) -> tuple[Dem, ...]:
        """The DEMs in their order, this one without the others first."""
        return (replace(self, after=()), *self.after)

    def __call__(self, lon: npt.ArrayLike, lat: npt.ArrayLike) -> Array:
        """Altitude above the ellipsoid (...) [m] at lon, lat (...) [deg]; NaN in voids and outside."""
        if self.after:
            lon, lat = np.broadcast_arrays(np.asarray(lon, np.float64), np.asarray(lat, np.float64))
            return self._counted(lon.ravel(), lat.ravel())[0].reshape(lon.shape)
        height = self.grid.sample(lon, lat)
        return height if self.geoid is None else height + self.geoid.sample(lon, lat)

    def covering(self, lon: Array, lat: Array) -> Array:
        """Altitudes as of a call; InputError, which names the files, where none of the places has one."""
        height = self(lon, lat)
        if not len(lon) or np.isfinite(height).any():
            return height
        geoids = [part.geoid for part in self.parts if np.isfinite(part.grid.sample(lon, lat)).any()]
        lacking = dict.fromkeys(os.fspath(one.path) for one in geoids or [part.grid for part in self.parts] if one)
        place = f"({float(lon[0]):.4f}, {float(lat[0]):.4f})"
        raise InputError(f"{', '.join(lacking)}: has no height at the images' position {place}; check for another tile")

    def _counted(self, lon: Array, lat: Array, joined: bool = True) -> tuple[Array, npt.NDArray[np.int64]]:
        """Return the altitude (n,) at lon, lat (n,) and the number of the DEM that counts there, -1: none.

        Heights between the posts of one DEM go before those between the posts of several (`joined`).
        """
        height, which, parts = np.full(len(lon), np.nan), np.full(len(lon), -1), self.parts
        heights: list[Callable[[Array, Array], Array]] = [*parts]
        heights += [partial(part._joined, self) for part in parts if joined]
        for number, heights_of in enumerate(heights):
            left = np.flatnonzero(np.isnan(height))
            height[left] = heights_of(lon[left], lat[left])
            which[left[np.isfinite(height[left])]] = number % len(parts)
        return height, which

    def _joined(self, whole: Dem, lon: Array, lat: Array) -> Array:
        """Return altitudes (n,) within a step of the outermost posts: bilinear, the posts beyond are the others'."""
        row, col = self.grid.locate(lon, lat)
        with np.errstate(invalid="ignore"):
            near = (row > -1) & (col > -1) & (row < self.grid.shape[0]) & (col < self.grid.shape[1])
        found = np.full(len(lon), np.nan)
        top, left = np.floor(row[near]), np.floor(col[near])
        down, right = row[near] - top, col[near] - left
        total = np.zeros(int(near.sum()))
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            weight = np.abs(1 - i - down) * np.abs(1 - j - right)
            post = whole._counted(*self.grid.place(top + i, left + j), joined=False)[0]
            total += np.where(weight > 0, weight * post, 0.0)
        found[near] = total
        return found

    def datums(self, ground: Array) -> tuple[HeightDatum, ...]:
        """Return the vertical datums assumed for its heights at ground points (n, 3), without one from the user."""
        ground = ground[np.isfinite(ground).all(axis=1)]
        which = self._counted(*ground[:, :2].T)[1]
        return tuple(
            one
            for number, part in enumerate(self.parts)
            for one in datum_of(part.taken, ground[which == number], "heights", f"the DEM {part.grid.path.name}")
        )

    def posts(self, lon: Array, lat: Array) -> Array:
        """Return numbers (n, 4) of the posts whose heights make those at lon, lat (n,) [deg]; NaN at no place.

        Of several DEMs they are those of the one that counts there.
        """
        which = self._counted(lon, lat)[1] if self.after else np.zeros(len(lon), dtype=np.int64)
        found, before = np.full((len(lon), 4), np.nan), 0
        for number, part in enumerate(self.parts):
            own = which == number
            row, col = (np.floor(one) + 1 for one in part.grid.locate(lon[own], lat[own]))  # -1: beyond the first one
            wide = part.grid.shape[1] + 2
            found[own] = (before + row * wide + col)[:, None] + (0, 1, wide, wide + 1)
            before += (part.grid.shape[0] + 2) * wide
        return found

    def between(self, start: Array, end: Array) -> tuple[float, float, float]:
        """Return, for lines from `start` to `end` (N, 3), the most posts that one passes, and the terrain's ends [m].

        Zero and infinite ends where none of them is on the DEM; of several DEMs the ends are infinite.
        """
        if self.after:
            return max(part.between(start, end)[0] for part in self.parts), -np.inf, np.inf
        both = [np.stack(self.grid.locate(*points[:, :2].T)) for points in (start, end)]
        across = both[1] - both[0]
        if self.grid.crs.is_geographic:  # west of the DEM is a turn to the east
            turn = 360.0 * abs(self.grid.to_pixel.a)
            across[1] -= turn * np.rint(across[1] / turn)
        posts = float(np.nan_to_num(np.abs(across)).max(initial=0.0))
        lowest, highest = self.grid.extremes(np.concatenate(both, axis=1))
        lon, lat = np.concatenate([start, end])[:, :2].T
        lift = np.zeros(1) if self.geoid is None else self.geoid.sample(lon, lat)
        if np.isnan(lift).all():
            return posts, -np.inf, np.inf
        bend = float(np.ptp(lift[np.isfinite(lift)]))  # of the geoid: between the lines' ends no more again
        return posts, lowest + float(np.nanmin(lift)) - bend, highest + float(np.nanmax(lift)) + bend


def _given_geoids(grids: Sequence[HeightGrid], said: str | None, heights: str | None) -> list[str | None]:
    """Return the geoid that the user gives each DEM, None: none; InputError where several need none of the one said."""
    needy = [grid for grid in grids if said is not None and (len(grids) == 1 or _needs_geoid(grid.vertical, said))]
    if said is not None and not needy:
        names = ", ".join(os.fspath(grid.path) for grid in grids)
        raise InputError(f"{names}: each says what its heights count from; leave out the geoid {said}")
    return [said if grid in needy else None if grid.vertical.stated else heights for grid in grids]


def _needs_geoid(own: Vertical, said: str) -> bool:
    """Return whether a DEM needs a geoid from the user: it states none, or one without a grid at hand."""
    return not own.stated or (said.lower() != NO_GEOID and geoid_of(own, own, False)[2])


def localize_on_terrain(
    sensor: SensorModel,
    image: Array,
    terrain: Callable[[Array, Array], Array],
    alt_range: tuple[float, float],
) -> Array:
    """Return where lines of sight first meet the terrain, coming from the sensor.

    Lines are walked down by quarters of the posts of a `Dem` (of another terrain, in 64 steps) until they are below the
    terrain, then halved. A BarpcWarning where a line meets none and the terrain reaches out of `alt_range`.

    Parameters
    ----------
    image : (N, 2), col, row [px]
    terrain : callable, lon, lat [deg] -> altitude [m above the ellipsoid], such as a `Dem`
    alt_range : (low, high), altitudes between which the terrain lies [m], both included

    Returns
    -------
    ground : (N, 3), lon, lat [deg], alt [m], to 0.1 mm; NaN where a line meets a void or no terrain
    """
    image = np.asarray(image, dtype=np.float64)
    if not len(image):
        return np.empty((0, 3))
    high, low = alt_range[1], alt_range[0]
    ends = np.stack([sensor.localize(image, np.full(len(image), end)) for end in (high, low)])
    steps, lowest, highest = _SIGHT_STEPS, low, high
    if isinstance(terrain, Dem):
        posts, lowest, highest = terrain.between(*ends)
        top, bottom = np.clip([highest + _TERRAIN_TOLERANCE, lowest - _TERRAIN_TOLERANCE], low, high)
        steps = max(2, int(np.ceil(_A_POST * posts * (top - bottom) / max(high - low, _TERRAIN_TOLERANCE))))
        high, low = float(top), float(bottom)
    levels, size = np.linspace(high, low, steps + 1), max(1, _AT_ONCE // (steps + 1))
    parts = [_terrain_intersection(sensor, image[i : i + size], terrain, levels) for i in range(0, len(image), size)]
    ground = np.concatenate(parts)
    ground[np.isnan(ground[:, 2])] = np.nan
    without = int(np.isnan(ground[:, 2]).sum())
    outside = lowest < alt_range[0] - _TERRAIN_TOLERANCE or highest > alt_range[1] + _TERRAIN_TOLERANCE
    if without and outside and np.isfinite(highest):
        warnings.warn(
            f"the DEM's heights here are {lowest:.0f} to {highest:.0f} m, the camera is made for {alt_range[0]:g} to "
            f"{alt_range[1]:g} m: {without} of {len(image)} lines of sight meet no terrain there",
            BarpcWarning,
            stacklevel=2,
        )
    return ground


def _terrain_intersection(
    sensor: SensorModel, image: Array, terrain: Callable[[Array, Array], Array], levels: Array
) -> Array:
    """Return the ground points (N, 3) between descending levels [m]; terrain at the first and last counts."""

    def above(alt: Array) -> Array:
        ground = sensor.localize(np.broadcast_to(image, (*alt.shape, 2)), alt)
        return np.asarray(alt - terrain(ground[..., 0], ground[..., 1]))

    height = above(np.broadcast_to(levels[:, None], (len(levels), len(image))))
    height[0] += _TERRAIN_TOLERANCE
    height[-1] -= _TERRAIN_TOLERANCE
    met = (height[:-1] >= 0) & (height[1:] < 0)
    first = met.argmax(axis=0)
    upper = np.where(met.any(axis=0), levels[first], np.nan)
    lower = np.where(met.any(axis=0), levels[first + 1], np.nan)
    for _ in range(int(np.ceil(np.log2(max(levels[0] - levels[1], _TERRAIN_TOLERANCE) / _TERRAIN_TOLERANCE)))):
        middle = (upper + lower) / 2
        under = above(middle) < 0
        lower, upper = np.where(under, middle, lower), np.where(under, upper, middle)
    return sensor.localize(image, (upper + lower) / 2)


def datum_of(vertical: Vertical | None, ground: Array, source: str, name: str) -> tuple[HeightDatum, ...]:
    """Return the alternative datum of heights at positions (n, 2 or more), taken as `vertical`.

    None of them where the user stated it (`vertical` None).
    """
    if vertical is None or not len(ground):
        return ()
    undulation = float(HeightGrid.open(geoid_file("egm96")).sample(*np.median(ground[:, :2], axis=0)))
    converted = vertical.geoid is not None
    return (HeightDatum(source, name, -undulation if converted else undulation, vertical.provenance, converted),)
