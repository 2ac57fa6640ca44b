"""A tile of a surface: the best pairs that see it are matched, intersected and gathered into its cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from rasterio.crs import CRS
from rasterio.warp import transform

from barpc.geodesy import Array, ground_from_ecef, wrap_longitude
from barpc.scene import View
from barpc.sensor.geometry import triangulate
from barpc.tie.patches.dense import (
    ACROSS,
    FINER,
    WINDOW,
    DenseMatches,
    EpipolarFrame,
    dense_matches,
    epipolar_frame,
)

SIDE = 512
"""Cells a side of a tile: the blocks of the file."""
MATCHED = 0.2
"""Share of the pixels of a part that is matched at least, or the pair says nothing there.

Of pictures of different ground 2 to 11 % are (22 trials, rendered, and real ones turned over), of pairs 92 to 97 %.
"""
_NODES = 5  # a side of a tile, at which cameras and maps are asked
_LEVELS = 3  # altitudes
_SPAN = 128.0  # px of disparity that are searched at once, else a coarser picture says where
_COARSE = 8  # times a pixel at most of the coarser picture
_ROOM = 4.0  # px of the coarser picture that heights may lie beyond what it shows
_ENDS = 1.0  # per cent of its heights at either end that do not count
_AT_ONCE = 1 << 17  # matches intersected at a time
_BITS, _EXACT = 32, 1e-4  # heights are ranked within cells as whole numbers of so many metres
_QUARTERS = (0, 0), (0, 1), (1, 0), (1, 1)
_SPLIT = 3  # times that a part is halved at most

F32 = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Tile:
    """Cells of a map: its CRS (WKT), the corner in the north-west, the side of a cell [m], `size` cells each way.

    `alts`: the altitudes [m] between which its ground is looked for.
    """

    crs: str
    west: float
    north: float
    step: float
    size: tuple[int, int]
    alts: tuple[float, float]

    def nodes(self, cols: int = _NODES, rows: int | None = None) -> Array:
        """Return the longitude, latitude (rows cols, 2) [deg] on a grid from corner to corner, the north first."""
        x = self.west + self.step * np.linspace(0, self.size[0], cols)
        y = self.north - self.step * np.linspace(0, self.size[1], rows or cols)
        east, north = (part.ravel() for part in np.meshgrid(x, y))
        return np.column_stack(transform(CRS.from_wkt(self.crs), CRS.from_epsg(4326), east, north))

    def centres(self) -> Array:
        """Return the longitude, latitude (rows cols, 2) [deg] of the cells' middles."""
        half, (cols, rows) = self.step / 2, self.size
        inner = replace(self, west=self.west + half, north=self.north - half, size=(cols - 1, rows - 1))
        return inner.nodes(cols, rows)

    def parts(self) -> list[Tile]:
        """Return the tile's quarters, of as many cells of half the side."""
        half = replace(self, step=self.step / 2)
        width, height = (half.step * side for side in self.size)
        return [replace(half, west=self.west + c * width, north=self.north - r * height) for r, c in _QUARTERS]

    def places(self) -> Callable[[Array], Array]:
        """Return a function from lon, lat (n, 2) [deg] to col, row (n, 2) of the tile's cells (cubics: 0.1 mm
        over 10 km).
        """
        nodes = self.nodes()
        col, row = np.meshgrid(np.linspace(0, self.size[0], _NODES), np.linspace(0, self.size[1], _NODES))
        middle = nodes.mean(axis=0) if np.ptp(nodes[:, 0]) < 180.0 else nodes[0]
        spread = np.abs(self._near(nodes, middle)).max(axis=0)
        rows = _cubic(self._near(nodes, middle) / spread)
        coefficients = np.linalg.lstsq(rows, np.column_stack([col.ravel(), row.ravel()]), rcond=None)[0]
        return lambda lonlat: np.asarray(_cubic(self._near(lonlat, middle) / spread) @ coefficients)

    @staticmethod
    def _near(lonlat: Array, middle: Array) -> Array:
        return np.column_stack([wrap_longitude(lonlat[:, 0], middle[0]), lonlat[:, 1]]) - middle


def _cubic(at: Array) -> Array:
    """Return the monomials (n, 10) up to the third degree."""
    x, y = at.T
    xx, yy = x * x, y * y
    return np.column_stack([np.ones(len(x)), x, y, xx, x * y, yy, xx * x, xx * y, x * yy, yy * y])


def surface_tile(pairs: Sequence[tuple[View, View]], tile: Tile, band: int) -> tuple[F32, ...]:
    """Compute the cells of a tile in a worker: the median of each pair's matches, then of the pairs' heights.

    Returns
    -------
    height, nmad, sigma : (rows, cols) [m], NaN where unknown; of the pairs' disagreement, and of the noise of one
        match through the intersection (root mean square of the pairs)
    seen : (rows, cols), as float32: bit k is set where pair k has a height
    shares : (pairs,), of the pixels that both images show so many were matched; NaN: they show nothing of it
    """
    shape = (len(pairs), tile.size[1], tile.size[0])
    heights, sigmas = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
    shares = np.full(len(pairs), np.nan, np.float32)
    for k, pair in enumerate(pairs):
        found = _points(pair, tile, band)
        if found is None:
            continue
        ground, sigma, shares[k] = found
        if shares[k] >= MATCHED:
            heights[k], sigmas[k] = _gathered(tile, ground, sigma)
    return (*_merged(heights, sigmas), shares)


def _merged(heights: F32, sigmas: F32) -> tuple[F32, ...]:
    """Return the median height of the pairs, their NMAD (NaN of one pair), RMS sigma, and which pairs have one."""
    known = np.isfinite(heights)
    height = _median(heights)
    nmad = 1.4826 * _median(np.abs(heights - height))
    nmad[known.sum(axis=0) < 2] = np.nan
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.where(known, sigmas**2, 0.0).sum(axis=0) / known.sum(axis=0))
    bits = (known * (1 << np.arange(len(known)))[:, None, None]).sum(axis=0)
    return height, nmad, sigma.astype(np.float32), bits.astype(np.float32)


def _median(values: F32) -> F32:
    """Return the median over the first axis of what is known; NaN where nothing is."""
    ordered, count = np.sort(values, axis=0), np.isfinite(values).sum(axis=0)  # NaN come last
    at = np.stack([np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(values) - 1)])
    return np.asarray(np.take_along_axis(ordered, at, axis=0).mean(axis=0), np.float32)


def _points(pair: tuple[View, View], tile: Tile, band: int, halved: int = 0) -> tuple[Array, Array, float] | None:
    """Return the ground points (n, 3), their standard deviation in height (n,) [m] and the share matched;
    None where unseen.
    """
    frame = _frame(pair, tile)
    zoom = 1 if frame is None else _zoom(frame)
    while zoom > 1 and frame is not None:
        found = _matched(pair, tile, band, zoom)
        if found is None or found[2] < MATCHED or not len(found[0]):
            return found
        low, high = np.percentile(found[0][:, 2], [_ENDS, 100.0 - _ENDS])
        room = _ROOM * zoom * frame.metres
        tile = replace(tile, alts=(max(tile.alts[0], float(low) - room), min(tile.alts[1], float(high) + room)))
        frame = _frame(pair, tile)
        zoom = 1 if frame is None else min(zoom // 2, _zoom(frame))
    if frame is not None and frame.across > ACROSS and halved < _SPLIT:
        parts = [_points(pair, part, band, halved + 1) for part in tile.parts()]
        return _joined([part for part in parts if part is not None])
    return _matched(pair, tile, band)


def _zoom(frame: EpipolarFrame) -> int:
    """Return the pixels a side that are one of a picture in which all disparities are searched at once."""
    return min(_COARSE, 1 << max(0, int(np.ceil(np.log2(frame.num / (FINER * _SPAN))))))


def _matched(pair: tuple[View, View], tile: Tile, band: int, zoom: int = 1) -> tuple[Array, Array, float] | None:
    """Match as `_points`, on pictures whose pixels are means of `zoom` px a side."""
    frame = _frame(pair, tile, zoom)
    sizes = [(view.size[0] // zoom, view.size[1] // zoom) for view in pair]
    found = None if frame is None else dense_matches([view.path for view in pair], sizes, frame, band)
    if frame is None or found is None:
        return None
    ground = _intersected(pair, found, zoom)
    known = np.isfinite(ground[:, 2])
    return ground[known], found.sigma[known] * frame.metres, found.share


def _joined(parts: Sequence[tuple[Array, Array, float]]) -> tuple[Array, Array, float] | None:
    if not parts:
        return None
    ground, sigma = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    return ground, sigma, float(np.mean([part[2] for part in parts]))


def _frame(pair: tuple[View, View], tile: Tile, zoom: int = 1) -> EpipolarFrame | None:
    """Return the frame of the part of two pictures that shows a tile; None where a camera has no answer."""
    nodes = tile.nodes()
    levels = np.repeat(np.linspace(tile.alts[0], max(tile.alts[1], tile.alts[0] + 1.0), _LEVELS), len(nodes))
    ground = np.column_stack([np.tile(nodes, (_LEVELS, 1)), levels])
    a, b = ((view.sensor.project(ground) + 0.5) / zoom - 0.5 for view in pair)
    return epipolar_frame(a, b, levels) if np.isfinite(a + b).all() else None


def _intersected(pair: tuple[View, View], found: DenseMatches, zoom: int) -> Array:
    """Return the ground points (n, 3) of matches; NaN where the rays do not meet."""
    ground = np.empty((len(found.a), 3))
    places = (np.stack([found.a, found.b], axis=1) + 0.5) * zoom - 0.5
    for start in range(0, len(ground), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        num = len(places[part])
        view, point = np.tile([0, 1], num), np.repeat(np.arange(num), 2)
        sensors = [one.sensor for one in pair]
        meeting = triangulate(sensors, view, point, places[part].reshape(-1, 2), alt=found.alt[part])
        ground[part] = ground_from_ecef(meeting.points)
    return ground


def _gathered(tile: Tile, ground: Array, sigma: Array) -> tuple[F32, F32]:
    """Return the median height of the points in each cell (rows, cols) and its sigma; NaN where there is none."""
    width, height = tile.size
    col, row = np.floor(tile.places()(ground[:, :2])).astype(np.int64).T
    inside = (col >= 0) & (col < width) & (row >= 0) & (row < height)
    cell = row[inside] * width + col[inside]
    low = ground[inside, 2].min(initial=np.inf)
    ranked = np.sort((cell << _BITS) + np.rint((ground[inside, 2] - low) / _EXACT).astype(np.int64))
    of = ranked >> _BITS
    start = np.flatnonzero(np.diff(of, prepend=-1))
    count = np.diff(np.append(start, len(of)))
    cells = np.full((2, width * height), np.nan, np.float32)
    middle = ((ranked[start + (count - 1) // 2] + ranked[start + count // 2]) / 2) - (of[start] << _BITS)
    cells[0, of[start]] = low + _EXACT * middle
    total = np.bincount(cell, sigma[inside] ** 2, width * height)[of[start]]
    cells[1, of[start]] = np.sqrt(total / count) * _averaged(np.sqrt(count))
    return cells[0].reshape(height, width), cells[1].reshape(height, width)


def _averaged(side: Array) -> Array:
    """Return what is left of sigma in the mean of `side` x `side` matches, whose windows overlap.

    Of matches k px apart 1 - k / WINDOW of the grey values are the same: a sum over all pairs, an axis at a time.
    """
    shorter, longer = np.minimum(side, WINDOW), np.maximum(side, WINDOW)
    return np.asarray(WINDOW / longer * (1.0 - (shorter**2 - 1.0) / (3.0 * side * WINDOW)))
