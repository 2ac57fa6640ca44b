"""Where the views of a block stand and which ground points they show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from barpc.errors import InputError
from barpc.geodesy import Array, ecef_from_ground, ground_from_ecef, metres_per_unit, wrap_longitude
from barpc.scene import IntArray, Tracks, View
from barpc.sensor.corrected import Correction, rotation_matrix


@dataclass(frozen=True)
class BlockOptions:
    """How a block is laid out and disturbed.

    Parameters
    ----------
    per_site : int
        Views of every site.
    size : tuple of int
        Width, height of every image [px].
    gsd : float
        Ground sampling distance at nadir [m].
    overlap : float
        Part of an image's side that it shares with the next site, at most 0.5.
    alt_range : tuple of float
        Altitudes of the ground [m].
    visible : float
        Probability that a view that covers a point shows it.
    attitude : float
        Standard deviation of each component of the attitude error [rad].
    position : float
        Standard deviation of each component of the position error [m].
    drift : float
        Standard deviation of each component of the attitude drift over an image's height [rad].
    noise : float
        Standard deviation of each image coordinate [px].
    outliers : float
        Part of the observations that are wrong.
    outlier_size : float
        Wrong observations are off by up to so much in each coordinate [px].
    """

    per_site: int = 3
    size: tuple[int, int] = (20000, 20000)
    gsd: float = 0.5
    overlap: float = 0.2
    alt_range: tuple[float, float] = (0.0, 600.0)
    visible: float = 0.9
    attitude: float = 15e-6
    position: float = 1.0
    drift: float = 0.0
    noise: float = 0.1
    outliers: float = 0.0
    outlier_size: float = 30.0

    def __post_init__(self) -> None:
        if self.per_site < 1 or min(self.size) < 64 or not self.gsd > 0:
            raise InputError("block: per_site, size and gsd must be positive")
        parts = {"overlap": self.overlap, "visible": self.visible, "outliers": self.outliers}
        for name, value in parts.items():
            if not 0.0 <= value <= 1.0:
                raise InputError(f"block: {name} {value} is not between 0 and 1")
        if self.overlap > 0.5 or not self.alt_range[0] < self.alt_range[1]:
            raise InputError("block: overlap must be at most 0.5 and the altitude range no point")


def exact_project(view: View, correction: Correction, drift: Array, ground: Array) -> Array:
    """Image points in the exact camera of a view, with drift.

    Parameters
    ----------
    view : View
        With the delivered sensor.
    correction : Correction
        Exact at the middle row.
    drift : (3,)
        Change of the rotation vector over the height of the image [rad].
    ground : (N, 3)
        lon, lat [deg], alt [m].

    Returns
    -------
    image : (N, 2)
        col, row [px].
    """
    ecef = ecef_from_ground(ground)
    image = view.sensor.project(ground_from_ecef(correction.apply(ecef)))
    if not drift.any():
        return image
    lever = ecef - (correction.translation + correction.center)
    for _ in range(4):  # the row moves by a thousandth of what it was wrong
        part = image[:, 1] / view.size[1] - 0.5
        turn = rotation_matrix(correction.rotation + drift * part[:, None])
        moved = np.einsum("nij,nj->ni", turn, lever) + correction.center
        image = view.sensor.project(ground_from_ecef(moved))
    return image


@dataclass(frozen=True)
class Grid:
    """Sites on a square grid, row by row: counts, centre and steps [deg]."""

    columns: int
    rows: int
    lon: float
    lat: float
    step: tuple[float, float]

    @classmethod
    def square(cls, num_views: int, options: BlockOptions, lon: float, lat: float) -> Grid:
        """The grid that holds `num_views` views around a centre [deg]."""
        sites = -(-num_views // options.per_site)
        columns = int(np.ceil(np.sqrt(sites)))
        rows = -(-sites // columns)
        metres = (1.0 - options.overlap) * options.gsd * np.array(options.size, dtype=np.float64)
        step = metres / metres_per_unit(np.array([lon, lat, 0.0]))[:2]
        if abs(lat) + 0.5 * rows * step[1] > 85.0:
            raise InputError("block: it would reach beyond 85 degrees of latitude")
        return cls(columns, rows, lon, lat, (float(step[0]), float(step[1])))

    def lonlat(self, row: npt.ArrayLike, column: npt.ArrayLike) -> tuple[Array, Array]:
        """Longitude and latitude [deg] of (fractional) places on the grid."""
        lon = self.lon + self.step[0] * (np.asarray(column) - 0.5 * (self.columns - 1))
        lat = self.lat - self.step[1] * (np.asarray(row) - 0.5 * (self.rows - 1))
        return wrap_longitude(lon), lat


@dataclass(frozen=True, eq=False)
class Seen:
    """Who sees what: ground points drawn over the block and projected by the exact cameras."""

    views: tuple[View, ...]
    corrections: tuple[Correction, ...]
    drift: Array
    grid: Grid
    options: BlockOptions
    rng: np.random.Generator

    def observe(self, count: int, fewest: int, visible: float) -> tuple[Array, Tracks]:
        """So many ground points (count, 3) that `fewest` views or more show, and their exact image points."""
        grounds: list[Array] = []
        found: list[tuple[IntArray, IntArray, Array]] = []
        have = 0
        for _ in range(50):
            if have >= count:
                break
            ground, view, point, xy = self._draw(max(64, int(1.2 * (count - have))), visible)
            times = np.bincount(point, minlength=len(ground))
            good = np.flatnonzero(times >= fewest)
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
        if not grounds:
            empty = np.empty(0, dtype=np.int64)
            return np.empty((0, 3)), Tracks(empty, empty, np.empty((0, 2)), np.empty(0))
        view, point = (np.concatenate([part[i] for part in found]) for i in (0, 1))
        xy = np.concatenate([part[2] for part in found])
        order = np.lexsort((view, point))
        return np.concatenate(grounds), Tracks(view[order], point[order], xy[order], np.ones(len(order)))

    def _draw(self, count: int, visible: float) -> tuple[Array, IntArray, IntArray, Array]:
        """Random ground points and all of their observations: ground, view, point, xy."""
        grid, per_site = self.grid, self.options.per_site
        sites = -(-len(self.views) // per_site)
        home = np.sort(self.rng.integers(0, sites, count))
        row, column = home // grid.columns, home % grid.columns
        offset = self.rng.uniform(-0.5, 0.5, (2, count)) / (1.0 - self.options.overlap)
        lon, lat = grid.lonlat(row + offset[0], column + offset[1])
        ground = np.stack([lon, lat, self.rng.uniform(*self.options.alt_range, count)], axis=1)
        starts = np.searchsorted(home, np.arange(sites + 1))
        shown: list[tuple[IntArray, IntArray, Array]] = []
        for site in range(sites):
            near = self._near(site, starts)
            for view in range(site * per_site, min((site + 1) * per_site, len(self.views))):
                xy = exact_project(self.views[view], self.corrections[view], self.drift[view], ground[near])
                size = np.array(self.views[view].size) - 1.0
                inside = ((xy >= 0) & (xy <= size)).all(axis=1) & (self.rng.random(len(near)) < visible)
                shown.append((np.full(int(inside.sum()), view), near[inside], xy[inside]))
        view_, point = (np.concatenate([part[i] for part in shown]) for i in (0, 1))
        return ground, view_, point, np.concatenate([part[2] for part in shown])

    def _near(self, site: int, starts: IntArray) -> IntArray:
        """Indices of the points whose home is this site or one of its eight neighbours."""
        row, column = divmod(site, self.grid.columns)
        parts = []
        for r in range(max(0, row - 1), min(self.grid.rows, row + 2)):
            first = r * self.grid.columns
            low = first + max(0, column - 1)
            high = min(first + min(self.grid.columns, column + 2), len(starts) - 1)
            if low < high:
                parts.append(np.arange(starts[low], starts[high]))
        return np.concatenate(parts)
