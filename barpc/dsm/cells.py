"""A tile of a surface: the best pairs that see it are matched, intersected and gathered into its cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from rasterio.warp import transform

from barpc.base.geodesy import Array, ground_from_ecef, parts
from barpc.scene import View
from barpc.sensor.geometry import triangulate
from barpc.tie.patches.dense import ACROSS, FINER, WINDOW, DenseMatches, dense_matches, epipolar_frame

MATCHED = 0.2
"""Share of the pixels of a part that is matched at least, or the pair says nothing there.

Of pictures of different ground 2 to 11 % are (22 trials, rendered, and real ones turned over), of pairs 92 to 97 %.
"""
NODES = 5
"""Places a side of a tile, at which cameras are asked."""
_LEVELS = 3  # altitudes
_SPAN = 128.0  # px of disparity that are searched at once, else a coarser picture says where
_COARSE = 8  # times a pixel at most of the coarser picture
_ROOM = 4.0  # px of the coarser picture that heights may lie beyond what it shows
_SPLIT = 3  # times that a part is halved at most

_median: Callable[..., Any] = np.ma.median  # of what is known

F32 = npt.NDArray[np.float32]
Found = tuple[Array, Array, float]
"""Ground points (n, 3), their standard deviations in height (n,) [m], and the share of the pixels matched."""


@dataclass(frozen=True)
class Tile:
    """Cells of a map: its CRS, the corner in the north-west, the side of a cell [m], `size` cells each way.

    `alts`: the altitudes [m] between which its ground is looked for.
    """

    crs: str
    west: float
    north: float
    step: float
    size: tuple[int, int]
    alts: tuple[float, float]

    def part(self, col: int, row: int, side: int) -> Tile:
        """Return the cells from a col, row on, so many each way or as many as there are."""
        size = min(side, self.size[0] - col), min(side, self.size[1] - row)
        return replace(self, west=self.west + self.step * col, north=self.north - self.step * row, size=size)

    def quarters(self) -> list[Tile]:
        """Return the tile's quarters, of as many cells of half the side."""
        width, height = (self.step * count / 2 for count in self.size)
        near = partial(replace, self, step=self.step / 2)
        return [near(west=self.west + i * width, north=self.north - j * height) for j in (0, 1) for i in (0, 1)]

    def nodes(self, count: tuple[int, int] = (NODES, NODES), edge: float = 0.0) -> Array:
        """Return the longitude, latitude (rows cols, 2) [deg] of a grid, `edge` cells inside, the north first."""
        col, row = np.meshgrid(*(np.linspace(edge, side - edge, n) for side, n in zip(self.size, count, strict=True)))
        east, north = self.west + self.step * col.ravel(), self.north - self.step * row.ravel()
        return np.column_stack(transform(self.crs, "EPSG:4326", east, north))

    def ground(self) -> Array:
        """Return the ground points (NODES NODES, 3) of the nodes at the middle altitude."""
        return np.column_stack([self.nodes(), np.full(NODES**2, sum(self.alts) / 2)])


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
        if found := _points(pair, tile, band):
            ground, sigma, share = zip(*found, strict=True)
            shares[k] = np.mean(share)
            if shares[k] >= MATCHED:
                cells[:, k] = gathered(tile, np.concatenate(ground), np.concatenate(sigma))
    heights, sigmas = np.ma.masked_invalid(cells)
    height, known = _median(heights, axis=0), np.isfinite(cells[0])
    nmad = np.ma.masked_where(known.sum(axis=0) < 2, 1.4826 * _median(np.abs(heights - height), axis=0))
    seen = np.tensordot(1 << np.arange(len(pairs)), known, axes=1).astype(np.float32)
    mean = np.ma.sqrt(np.ma.mean(sigmas**2, axis=0))
    return (*(one.filled(np.nan).astype(np.float32) for one in (height, nmad, mean)), seen, shares)


def _points(pair: tuple[View, View], tile: Tile, band: int, halved: int = 0) -> list[Found]:
    """Return what is found of a tile, part by part; of one unseen nothing. Coarser pictures narrow the altitudes."""
    zoom, nodes = _COARSE, tile.nodes()
    while True:
        levels = np.repeat(np.linspace(tile.alts[0], max(tile.alts[1], tile.alts[0] + 1.0), _LEVELS), len(nodes))
        ground = np.column_stack([np.tile(nodes, (_LEVELS, 1)), levels])
        a, b = (view.sensor.project(ground) + 0.5 for view in pair)
        if not np.isfinite(a + b).all():
            return []
        frame = epipolar_frame(a - 0.5, b - 0.5, levels)
        zoom = min(zoom, 1 << max(0, int(np.ceil(np.log2(frame.num / (FINER * _SPAN))))))
        if zoom == 1 and frame.across > ACROSS and halved < _SPLIT:
            return [one for part in tile.quarters() for one in _points(pair, part, band, halved + 1)]
        frame = epipolar_frame(a / zoom - 0.5, b / zoom - 0.5, levels)  # of pictures of means of `zoom` px a side
        sizes = [(view.size[0] // zoom, view.size[1] // zoom) for view in pair]
        found = dense_matches([view.path for view in pair], sizes, frame, band)
        if found is None:
            return []
        ground = _intersected(pair, found, zoom)
        known = np.isfinite(ground[:, 2])
        ground = ground[known]
        if zoom == 1 or found.share < MATCHED or not len(ground):
            return [(ground, found.sigma[known] * frame.metres, found.share)]
        low, high = np.percentile(ground[:, 2], [1.0, 99.0]) + np.array([-1.0, 1.0]) * _ROOM * frame.metres
        tile = replace(tile, alts=(max(tile.alts[0], float(low)), min(tile.alts[1], float(high))))
        zoom //= 2


def _intersected(pair: tuple[View, View], found: DenseMatches, zoom: int) -> Array:
    """Return the ground points (n, 3) of matches; NaN where the rays do not meet."""
    places, ground = (np.stack([found.a, found.b], axis=1) + 0.5) * zoom - 0.5, np.empty((len(found.a), 3))
    for part in parts(len(ground)):
        view, point = np.tile([0, 1], len(places[part])), np.repeat(np.arange(len(places[part])), 2)
        sensors, xy = [one.sensor for one in pair], places[part].reshape(-1, 2)
        ground[part] = ground_from_ecef(triangulate(sensors, view, point, xy, alt=found.alt[part]).points)
    return ground


def gathered(tile: Tile, ground: Array, sigma: Array) -> F32:
    """Return the median height of the points in each cell and its sigma (2, rows, cols); NaN where there is none."""
    width, height = tile.size
    east, north = map(np.array, transform("EPSG:4326", tile.crs, *ground[:, :2].T))
    col, row = (np.floor(one / tile.step).astype(np.int64) for one in (east - tile.west, tile.north - north))
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
    """Return what is left of sigma in the mean of `side` x `side` matches, which look at much the same.

    Each is a mean over WINDOW of steps that look at WINDOW pixels: matches correlate as a cubic B-spline of their
    distance, with knots every WINDOW. A sum over all pairs, axis by axis, interpolated between whole sides.
    """
    lag = np.arange(int(np.ceil(side.max(initial=1.0))))
    far, num = lag / WINDOW, lag + 1.0
    alike = np.where(far < 1.0, 1.0 - 1.5 * far**2 + 0.75 * far**3, 0.25 * np.maximum(2.0 - far, 0.0) ** 3)
    alike[0] = 0.5  # a match is once beside itself, and twice beside another
    left = 2.0 * (num * np.cumsum(alike) - np.cumsum(lag * alike)) / num**2
    return np.asarray(np.interp(side, num, left))
