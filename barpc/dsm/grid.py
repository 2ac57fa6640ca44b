"""The cells of a surface: their map, which pairs see which tile of it, and what becomes of the pairs' heights."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.errors import CRSError, NotGeoreferencedWarning
from rasterio.warp import transform
from rasterio.windows import Window

from barpc import __version__
from barpc.dsm.cells import F32, MATCHED, SIDE, Tile, surface_tile
from barpc.dsm.imagery import Block, NoSurfaceError, Pairs
from barpc.errors import InputError
from barpc.geodesy import Array, utm
from barpc.options import DsmOptions
from barpc.pipeline.executor import CachingExecutor, worker_count
from barpc.pipeline.inputs import hash_files
from barpc.scene import View
from barpc.sensor.geometry import footprint, ground_sample_distance
from barpc.tie.pairing.epipolar import common_range
from barpc.tie.tasks import Progress, one_by_one
from barpc.workspace import Workspace

BANDS = (
    "height above the WGS84 ellipsoid [m]",
    "pairs of images",
    "disagreement of the pairs: NMAD [m]",
    "sigma of the height: matching [m]",
    "sigma of the height: cameras, without what all cells share [m]",
)
CHANGE = "height minus that of the other images [m]"
SHARED = "SIGMA_SHARED_BY_ALL_CELLS_M"
_NODES = 3  # a side of a tile, at which the cameras' errors are asked
_DATUM_NODES = 200  # tiles at which what all cells share is measured, at most
_BITS = 16  # of a pattern of pairs
_WIDER = 1.1  # times the pixels of a usual tile that one has at most: the rounding of a cell's side
_SOME = 1 << 20  # cells, of all tiles, of which medians are told


@dataclass
class Counts:
    """Statistics gathered over tiles: cells with a height, largest share matched, some cells' bands, the datum."""

    known: int = 0
    share: float = float("nan")
    some: list[F32] = field(default_factory=list)
    datum: float = float("nan")


@dataclass(frozen=True, eq=False)
class Grid:
    """Cells of a map, and which pairs see which tile of it."""

    block: Block
    options: DsmOptions
    crs: CRS
    west: float
    north: float
    step: float
    size: tuple[int, int]
    side: int  # cells a side of a tile
    outlines: tuple[tuple[Any, ...], ...]  # of what each pair of each group sees in common, on the map

    @classmethod
    def of(cls, block: Block, options: DsmOptions) -> Grid:
        """Return the grid of cells in UTM or the CRS asked for, of twice the ground sampling distance unless told."""
        views = block.views
        middles = [v.sensor.localize((np.array(v.size) - 1) / 2, np.array(v.altitude)) for v in views]
        crs = _crs(options.crs, middles[block.groups[0][0][0]])
        pixels = [float(ground_sample_distance(v.sensor, at)[1]) for v, at in zip(views, middles, strict=True)]
        step = options.gsd or float(f"{2 * max(pixels):.2g}")
        _refuse_side(step, min(pixels), max(pixels))
        outlines = tuple(tuple(_common(views[i], views[j], crs) for i, j in group) for group in block.groups)
        whole = shapely.intersection_all([shapely.union_all(group) for group in outlines])
        if whole.is_empty:
            raise NoSurfaceError("the images do not overlap at the altitudes that they are used for")
        low, high = np.array(whole.bounds).reshape(2, 2)
        west, north = float(np.floor(low[0] / step) * step), float(np.ceil(high[1] / step) * step)
        size = int(np.ceil((high[0] - west) / step)), int(np.ceil((north - low[1]) / step))
        side = SIDE
        while side > 1 and side * step > _WIDER * SIDE * 2 * max(pixels):
            side //= 2
        return cls(block, options, crs, west, north, step, size, side, outlines)

    def tiles(self) -> list[tuple[tuple[int, int], tuple[Pairs, ...]]]:
        """Yield the first col, row of every tile that is seen, and the best pairs of each group that see it."""
        found = []
        for row in range(0, self.size[1], self.side):
            for col in range(0, self.size[0], self.side):
                box = self.box(col, row)
                groups = tuple(
                    tuple(pair for pair, outline in zip(*one, strict=True) if outline.intersects(box))
                    for one in zip(self.block.groups, self.outlines, strict=True)
                )
                if all(groups):
                    found.append(((col, row), tuple(group[: self.options.pairs] for group in groups)))
        return found

    def box(self, col: int, row: int) -> Any:
        """Return the outline of a tile on the map."""
        at = self.tile(col, row)
        return shapely.box(at.west, at.north - at.step * at.size[1], at.west + at.step * at.size[0], at.north)

    def tile(self, col: int, row: int) -> Tile:
        """Return the tile that begins at a cell."""
        size = min(self.side, self.size[0] - col), min(self.side, self.size[1] - row)
        corner = self.west + self.step * col, self.north - self.step * row
        return Tile(self.crs.to_wkt(), *corner, self.step, size, common_range(*self.block.views))

    def fill(self, path: Path, run: Workspace, executor: Executor | None, progress: Progress | None) -> Counts:
        """Write all tiles into a plain GeoTIFF; each is made by a worker and forgotten once it is written."""
        views, seen = self.block.views, self.tiles()
        tasks = [
            (tuple((views[i], views[j]) for i, j in group), self.tile(*at), self.options.band)
            for at, groups in seen
            for group in groups
        ]
        paths = [view.path for view in views]
        inputs = dict(zip(paths, hash_files(paths), strict=True))
        shared, counts = self._shared(seen), Counts()
        if self.block.errors is not None:
            counts.datum = float(self.block.errors.sigma(shared[None])[0])
        with self._opened(path, counts.datum) as file, CachingExecutor(run, inputs, executor) as caching:
            ahead = 4 * worker_count(executor)
            results = one_by_one(caching, surface_tile, tasks, "surface", progress, ahead)
            for at, groups in seen:
                tile, found = self.tile(*at), [next(results) for _ in groups]
                bands = self._bands(tile, groups, found, shared)
                file.write(bands, window=Window(*at, *tile.size))
                known = np.isfinite(bands[0])
                counts.known += int(known.sum())
                shares = [share for one in found for share in one[4]]
                counts.share = float(np.nanmax([counts.share, *shares, -1.0]))
                counts.some.append(bands[2:, known][:, :: 1 + int(known.sum()) * len(seen) // _SOME])
        return counts

    def _shared(self, seen: Sequence[tuple[tuple[int, int], tuple[Pairs, ...]]]) -> Array:
        """Return the derivative (V q,) of the mean height of all cells, or difference of it, by the cameras'
        unknowns.
        """
        errors, rows = self.block.errors, []
        if errors is None:
            return np.zeros(0)
        for at, groups in seen[:: 1 + len(seen) // _DATUM_NODES]:
            nodes = _nodes(self.tile(*at))
            means = [np.mean([errors.rows(pair, nodes).mean(axis=0) for pair in one], axis=0) for one in groups]
            rows.append(means[0] - sum(means[1:]))
        return np.asarray(np.mean(rows, axis=0))

    def _bands(self, tile: Tile, groups: Sequence[Pairs], results: Sequence[Sequence[F32]], shared: Array) -> F32:
        """Return the bands (5, rows, cols) of a tile: of one group of pairs, or of the first minus the second."""
        errors, shape = self.block.errors, results[0][0].shape
        height = results[0][0] - sum(one[0] for one in results[1:])
        parts = [np.nan_to_num(one[3]).astype(np.int64) << _BITS * g for g, one in enumerate(results)]
        bits = np.sum(parts, axis=0)
        nmad = np.sqrt(sum(one[1] ** 2 for one in results))
        count, noise, cameras = np.zeros(shape), np.full(shape, np.nan), np.full(shape, np.nan)
        nodes = _nodes(tile)
        by_pair = {} if errors is None else {p: errors.rows(p, nodes) for group in groups for p in group}
        known = np.isfinite(height)
        for pattern in np.unique(bits[known]):
            cells = known & (bits == pattern)
            chosen = [
                [pair for k, pair in enumerate(group) if pattern >> _BITS * g + k & 1] for g, group in enumerate(groups)
            ]
            count[cells] = min(map(len, chosen))
            # pairs of n images have n - 1 independent parallaxes
            free = [min(len(one), len({view for pair in one for view in pair}) - 1) for one in chosen]
            square = [found[2] ** 2 / n for found, n in zip(results, free, strict=True)]
            noise[cells] = np.sqrt(np.sum(square, axis=0))[cells]
            if errors is not None:
                means = [np.mean([by_pair[pair] for pair in one], axis=0) for one in chosen]
                rows = means[0] - sum(means[1:]) - shared
                cameras[cells] = _spread(errors.sigma(rows), tile.size)[cells]
        return np.stack([height, count, nmad, noise, cameras]).astype(np.float32)

    @contextmanager
    def _opened(self, path: Path, datum: float) -> Iterator[Any]:
        profile = {"width": self.size[0], "height": self.size[1], "count": len(BANDS), "crs": self.crs}
        profile |= {"dtype": "float32", "nodata": float("nan"), "compress": "deflate", "BIGTIFF": "IF_SAFER"}
        profile |= {"tiled": True, "blockxsize": SIDE, "blockysize": SIDE, "SPARSE_OK": True}
        profile["transform"] = Affine(self.step, 0.0, self.west, 0.0, -self.step, self.north)
        tags = {"BARPC": __version__, "VERTICAL_REFERENCE": "WGS84 ellipsoid", "IMAGES": self.block.source}
        if np.isfinite(datum):
            tags[SHARED] = f"{datum:.4f}"
        first = BANDS[0] if len(self.block.groups) == 1 else CHANGE
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path, "w", driver="GTiff", **profile) as file:
                file.update_tags(**tags)
                for number, words in enumerate((first, *BANDS[1:]), start=1):
                    file.set_band_description(number, words)
                yield file


def _nodes(tile: Tile) -> Array:
    """Return the ground points of a tile at its middle altitude."""
    nodes = tile.nodes(_NODES)
    return np.column_stack([nodes, np.full(len(nodes), sum(tile.alts) / 2)])


def _spread(values: Array, size: tuple[int, int]) -> Array:
    """Interpolate values at a tile's nodes over its cells (rows, cols), linearly."""
    at = [(np.arange(side) + 0.5) / side * (_NODES - 1) for side in size]
    grid, nodes = values.reshape(_NODES, _NODES), np.arange(_NODES)
    along = np.stack([np.interp(at[0], nodes, row) for row in grid])
    return np.stack([np.interp(at[1], nodes, col) for col in along.T], axis=1)


def _refuse_side(step: float, smallest: float, largest: float) -> None:
    """Raise an InputError for cells of which hardly one has a match, or one is more than is matched at once."""
    if (step / smallest) ** 2 < MATCHED:
        raise InputError(
            f"--gsd {step:g}: a pixel of {smallest:.2g} m has one match, so fewer than {100 * MATCHED:.0f} % of such "
            "cells would have a height"
        )
    if step > 2 * SIDE * largest:
        raise InputError(f"--gsd {step:g}: a cell of more than {2 * SIDE} pixels of {largest:.2g} m")


def _crs(given: str | None, middle: Array) -> CRS:
    """Return the CRS that was asked for, in metres, or the UTM zone of a place."""
    if given is None:
        return CRS.from_string(utm(*middle[:2])[1])
    try:
        if given.upper().startswith("EPSG:"):
            int(given[5:])  # older GDAL reads a code up to what is no digit
        found = CRS.from_user_input(given)
    except (CRSError, ValueError) as error:
        raise InputError(f"--crs {given}: no reference system that PROJ knows ({error})") from error
    if not found.is_projected or found.linear_units_factor[1] != 1.0:
        raise InputError(f"--crs {given}: cells need a projected reference system in metres, such as EPSG:32631")
    return found


def _common(first: View, second: View, crs: CRS) -> Any:
    """Return the ground that two views see at their lowest or highest altitude, on the map."""
    parts = []
    for alt in common_range(first, second):
        rings = []
        for view in (first, second):
            ring = footprint(view.sensor, view.size, alt)
            ring = ring[np.isfinite(ring).all(axis=1)]
            x, y = transform(CRS.from_epsg(4326), crs, ring[:, 0], ring[:, 1])
            rings.append(shapely.make_valid(shapely.Polygon(np.column_stack([x, y]))))
        parts.append(shapely.intersection(rings[0], rings[1]))
    return shapely.union_all(parts)
