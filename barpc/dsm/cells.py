"""A tile of a surface: the best pairs that see it are matched, intersected and gathered into its cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from numpy.polynomial.polynomial import polyval2d, polyvander2d
from rasterio.crs import CRS
from rasterio.warp import transform

from barpc.base.geodesy import Array, ground_from_ecef, wrap_longitude
from barpc.scene import View
from barpc.sensor.geometry import triangulate
from barpc.tie.patches.dense import ACROSS, FINER, WINDOW, DenseMatches, EpipolarFrame, dense_matches, epipolar_frame

SIDE = 512
"""Cells a side of a tile: the blocks of the file."""
MATCHED = 0.2
"""Share of the pixels of a part that is matched at least, or the pair says nothing there.

Of pictures of different ground 2 to 11 % are (22 trials, rendered, and real ones turned over), of pairs 92 to 97 %.
"""
NODES = 5
"""Places a side of a tile, at which cameras and maps are asked."""
_LEVELS = 3  # altitudes
_SPAN = 128.0  # px of disparity that are searched at once, else a coarser picture says where
_COARSE = 8  # times a pixel at most of the coarser picture
_ROOM = 4.0  # px of the coarser picture that heights may lie beyond what it shows
_AT_ONCE = 1 << 17  # matches intersected at a time
_SPLIT = 3  # times that a part is halved at most

F32 = npt.NDArray[np.float32]
Found = tuple[Array, Array, float]
"""Ground points (n, 3), their standard deviations in height (n,) [m], and the share of the pixels matched."""


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

    def part(self, col: int, row: int, size: tuple[int, int]) -> Tile:
        """Return the cells from a col, row on, so many each way or as many as there are."""
        size = min(size[0], self.size[0] - col), min(size[1], self.size[1] - row)
        return replace(self, west=self.west + self.step * col, north=self.north - self.step * row, size=size)

    def quarters(self) -> list[Tile]:
        """Return the tile's quarters, of as many cells of half the side."""
        fine = replace(self, step=self.step / 2, size=(2 * self.size[0], 2 * self.size[1]))
        return [fine.part(col, row, self.size) for row in (0, self.size[1]) for col in (0, self.size[0])]

    def nodes(self, cols: int = NODES, rows: int = NODES) -> Array:
        """Return the longitude, latitude (rows cols, 2) [deg] on a grid from corner to corner, the north first."""
        x = self.west + self.step * np.linspace(0, self.size[0], cols)
        y = self.north - self.step * np.linspace(0, self.size[1], rows)
        east, north = (part.ravel() for part in np.meshgrid(x, y))
        return np.column_stack(transform(CRS.from_wkt(self.crs), CRS.from_epsg(4326), east, north))

    def centres(self) -> Array:
        """Return the longitude, latitude (rows cols, 2) [deg] of the cells' middles."""
        half, (cols, rows) = self.step / 2, self.size
        inner = replace(self, west=self.west + half, north=self.north - half, size=(cols - 1, rows - 1))
        return inner.nodes(cols, rows)

    def places(self) -> Callable[[Array], Array]:
        """Return a function from lon, lat (n, 2) [deg] to col, row (n, 2) of the cells (cubics: 0.1 mm over 10 km)."""
        nodes = self.nodes()
        middle = nodes[len(nodes) // 2]

        def near(lonlat: Array) -> Array:
            off: Array = np.stack([wrap_longitude(lonlat[:, 0], middle[0]), lonlat[:, 1]]) - middle[:, None]
            return off

        spread = np.abs(near(nodes)).max(axis=1, keepdims=True)
        x, y = near(nodes) / spread
        goal = np.stack(np.meshgrid(*(np.linspace(0, count, NODES) for count in self.size)), axis=-1).reshape(-1, 2)
        cubics = np.linalg.lstsq(polyvander2d(x, y, [3, 3]), goal, rcond=None)[0].reshape(4, 4, 2)

        def places(lonlat: Array) -> Array:
            x, y = near(lonlat) / spread
            return np.asarray(polyval2d(x, y, cubics)).T

        return places


def surface_tile(pairs: Sequence[tuple[View, View]], tile: Tile, band: int) -> tuple[F32, ...]:
    """Compute the cells of a tile in a worker: the median of each pair's matches, then of the pairs' heights.

    Returns
    -------
    height, nmad, sigma : (rows, cols) [m], NaN where unknown; of the pairs' disagreement, and of the noise of one
        match through the intersection (root mean square of the pairs)
    seen : (rows, cols), as float32: bit k is set where pair k has a height
    shares : (pairs,), of the pixels that both images show so many were matched; NaN: they show nothing of it
    """
    cells = np.full((2, len(pairs), tile.size[1], tile.size[0]), np.nan, np.float32)
    shares = np.full(len(pairs), np.nan, np.float32)
    for k, pair in enumerate(pairs):
        if (found := _points(pair, tile, band)) is not None:
            shares[k] = found[2]
            if found[2] >= MATCHED:
                cells[:, k] = gathered(tile, *found[:2])
    known = np.isfinite(cells[0])
    height = _median(cells[0])
    nmad = np.where(known.sum(axis=0) < 2, np.float32(np.nan), 1.4826 * _median(np.abs(cells[0] - height)))
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.where(known, cells[1] ** 2, 0.0).sum(axis=0) / known.sum(axis=0))
    seen = np.tensordot(1 << np.arange(len(pairs)), known, axes=1)
    return (height, *(np.asarray(one, np.float32) for one in (nmad, sigma, seen)), shares)


def _median(values: F32) -> F32:
    """Return the median over the first axis of what is known; NaN where nothing is."""
    ordered, count = np.sort(values, axis=0), np.isfinite(values).sum(axis=0)  # NaN come last
    at = np.stack([np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(values) - 1)])
    return np.asarray(np.take_along_axis(ordered, at, axis=0).mean(axis=0), np.float32)


def _points(pair: tuple[View, View], tile: Tile, band: int, halved: int = 0) -> Found | None:
    """Return what is found of a tile; None where it is unseen. Coarser pictures narrow the altitudes first."""
    zoom = _COARSE
    while (frame := _frame(pair, tile)) is not None:
        zoom = min(zoom, 1 << max(0, int(np.ceil(np.log2(frame.num / (FINER * _SPAN))))))
        if zoom == 1 and frame.across > ACROSS and halved < _SPLIT:
            every = (_points(pair, part, band, halved + 1) for part in tile.quarters())
            parts = [part for part in every if part is not None]
            return _joined(parts) if parts else None
        found = _matched(pair, tile, band, zoom)
        if zoom == 1 or found is None or found[2] < MATCHED or not len(found[0]):
            return found
        low, high = np.percentile(found[0][:, 2], [1.0, 99.0]) + np.array([-1.0, 1.0]) * _ROOM * zoom * frame.metres
        tile = replace(tile, alts=(max(tile.alts[0], float(low)), min(tile.alts[1], float(high))))
        zoom //= 2
    return None


def _joined(parts: Sequence[Found]) -> Found:
    ground, sigma, share = zip(*parts, strict=True)
    return np.concatenate(ground), np.concatenate(sigma), float(np.mean(share))


def _matched(pair: tuple[View, View], tile: Tile, band: int, zoom: int) -> Found | None:
    """Match as `_points`, on pictures whose pixels are means of `zoom` px a side."""
    frame = _frame(pair, tile, zoom)
    sizes = [(view.size[0] // zoom, view.size[1] // zoom) for view in pair]
    found = None if frame is None else dense_matches([view.path for view in pair], sizes, frame, band)
    if frame is None or found is None:
        return None
    ground = _intersected(pair, found, zoom)
    known = np.isfinite(ground[:, 2])
    return ground[known], found.sigma[known] * frame.metres, found.share


def _frame(pair: tuple[View, View], tile: Tile, zoom: int = 1) -> EpipolarFrame | None:
    """Return the frame of the part of two pictures that shows a tile; None where a camera has no answer."""
    nodes = tile.nodes()
    levels = np.repeat(np.linspace(tile.alts[0], max(tile.alts[1], tile.alts[0] + 1.0), _LEVELS), len(nodes))
    ground = np.column_stack([np.tile(nodes, (_LEVELS, 1)), levels])
    a, b = ((view.sensor.project(ground) + 0.5) / zoom - 0.5 for view in pair)
    return epipolar_frame(a, b, levels) if np.isfinite(a + b).all() else None


def _intersected(pair: tuple[View, View], found: DenseMatches, zoom: int) -> Array:
    """Return the ground points (n, 3) of matches; NaN where the rays do not meet."""
    places, ground = (np.stack([found.a, found.b], axis=1) + 0.5) * zoom - 0.5, np.empty((len(found.a), 3))
    for start in range(0, len(ground), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        view, point = np.tile([0, 1], len(places[part])), np.repeat(np.arange(len(places[part])), 2)
        sensors, xy = [one.sensor for one in pair], places[part].reshape(-1, 2)
        ground[part] = ground_from_ecef(triangulate(sensors, view, point, xy, alt=found.alt[part]).points)
    return ground


def gathered(tile: Tile, ground: Array, sigma: Array) -> F32:
    """Return the median height of the points in each cell and its sigma (2, rows, cols); NaN where there is none."""
    width, height = tile.size
    col, row = np.floor(tile.places()(ground[:, :2])).astype(np.int64).T
    inside = np.flatnonzero((col >= 0) & (col < width) & (row >= 0) & (row < height))
    cell, alt = row[inside] * width + col[inside], ground[inside, 2]
    order = np.lexsort((alt, cell))
    of, start, count = np.unique(cell[order], return_index=True, return_counts=True)
    cells = np.full((2, height * width), np.nan, np.float32)
    cells[0, of] = (alt[order[start + (count - 1) // 2]] + alt[order[start + count // 2]]) / 2
    total = np.bincount(cell, sigma[inside] ** 2, height * width)[of]
    cells[1, of] = np.sqrt(total / count) * averaged(np.sqrt(count))
    return cells.reshape(2, height, width)


def averaged(side: Array) -> Array:
    """Return what is left of sigma in the mean of `side` x `side` matches, whose windows overlap.

    Of matches k px apart 1 - k / WINDOW of the grey values are the same: a sum over all pairs, an axis at a time.
    """
    shorter, longer = np.minimum(side, WINDOW), np.maximum(side, WINDOW)
    return np.asarray(WINDOW / longer * (1.0 - (shorter**2 - 1.0) / (3.0 * side * WINDOW)))
