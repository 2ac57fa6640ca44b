"""The cells of a surface: their map, which pairs see which tile of it, and what becomes of the pairs' heights."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.errors import CRSError, NotGeoreferencedWarning
from rasterio.warp import transform as warped
from rasterio.windows import Window
from scipy.ndimage import map_coordinates

from barpc import __version__
from barpc.base.errors import InputError
from barpc.base.geodesy import Array, utm
from barpc.base.options import DsmOptions
from barpc.dsm.cells import F32, MATCHED, NODES, SIDE, Tile, surface_tile
from barpc.dsm.imagery import Block, NoSurfaceError, Pairs
from barpc.pipeline.executor import CachingExecutor, worker_count
from barpc.rasters.raster import hashed
from barpc.scene import View
from barpc.sensor.geometry import ground_sample_distance
from barpc.tie.pairing.epipolar import common_range
from barpc.tie.pairing.overlaps import Footprints
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
Groups = tuple[Pairs, ...]
"""Pairs of a surface; of a difference those of the surface that is taken away, too."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Cells of a map, and which pairs see which tile of it."""

    block: Block
    options: DsmOptions
    whole: Tile
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
        seen = shapely.intersection_all([shapely.union_all(group) for group in outlines])
        if seen.is_empty:
            raise NoSurfaceError("the images do not overlap at the altitudes that they are used for")
        west, south, east, north = np.array(seen.bounds) / step
        west, north = np.floor(west), np.ceil(north)
        size = int(np.ceil(east - west)), int(np.ceil(north - south))
        whole = Tile(crs.to_wkt(), float(west * step), float(north * step), step, size, common_range(*views))
        # a tile shows about as many pixels, however large its cells are
        return cls(block, options, whole, SIDE >> max(0, round(np.log2(step / (2 * max(pixels))))), outlines)

    def tiles(self) -> list[tuple[tuple[int, int], Tile, Groups]]:
        """Return the first col, row of every tile that is seen, the tile, and the best pairs of each group there."""
        found = []
        for row in range(0, self.whole.size[1], self.side):
            for col in range(0, self.whole.size[0], self.side):
                tile = self.whole.part(col, row, (self.side, self.side))
                width, height = (tile.step * count for count in tile.size)
                box = shapely.box(tile.west, tile.north - height, tile.west + width, tile.north)
                groups = tuple(
                    tuple(pair for pair, outline in zip(*one, strict=True) if outline.intersects(box))
                    for one in zip(self.block.groups, self.outlines, strict=True)
                )
                if all(groups):
                    found.append(((col, row), tile, tuple(group[: self.options.pairs] for group in groups)))
        return found

    def fill(
        self, path: Path, run: Workspace, executor: Executor | None, progress: Progress | None
    ) -> tuple[int, float]:
        """Write all tiles into a plain GeoTIFF, each made by a worker and forgotten once it is written.

        Returns
        -------
        known, share : cells with a height, and the largest share matched of the pixels that both images of a pair show
        """
        views, seen, known, best = self.block.views, self.tiles(), 0, -1.0
        tasks = [
            (tuple((views[i], views[j]) for i, j in group), tile, self.options.band)
            for _, tile, groups in seen
            for group in groups
        ]
        paths, shared = [view.path for view in views], self.shared(seen)
        inputs = {path: hashed(path) for path in paths}
        with self._opened(path, shared) as file, CachingExecutor(run, inputs, executor) as caching:
            ahead = 4 * worker_count(executor)
            results = one_by_one(caching, surface_tile, tasks, "surface", progress, ahead)
            for at, tile, groups in seen:
                found = [next(results) for _ in groups]
                bands = self._bands(tile, groups, found, shared)
                file.write(bands, window=Window(*at, *tile.size))
                known += int(np.isfinite(bands[0]).sum())
                best = float(np.nanmax([best, *(share for one in found for share in one[4])]))
        return known, best

    def shared(self, seen: Sequence[tuple[tuple[int, int], Tile, Groups]]) -> Array:
        """Return the derivative (V q,) of the mean height of all tiles, or difference of it, by the cameras' unknowns;
        of images without a run none.
        """
        rows = [_difference(self._rows(tile, groups), groups).mean(axis=0) for _, tile, groups in seen]
        return np.zeros(0) if self.block.errors is None else np.asarray(np.mean(rows, axis=0))

    def _rows(self, tile: Tile, groups: Groups) -> dict[tuple[int, int], Array]:
        """Return the derivative (nodes, V q) of the heights of a tile's pairs by the cameras' unknowns."""
        nodes, errors = tile.nodes(), self.block.errors
        ground = np.column_stack([nodes, np.full(len(nodes), sum(tile.alts) / 2)])
        pairs = {pair for group in groups for pair in group}
        return {pair: np.zeros((len(nodes), 0)) if errors is None else errors.rows(pair, ground) for pair in pairs}

    def _bands(self, tile: Tile, groups: Groups, results: Sequence[Sequence[F32]], shared: Array) -> F32:
        """Return the bands (5, rows, cols) of a tile: of one group of pairs, or of the first minus the second."""
        height, *minus = (one[0] for one in results)
        bands = np.full((len(BANDS), *height.shape), np.nan, np.float32)
        bands[0], bands[1], bands[2] = height - sum(minus), 0.0, np.sqrt(sum(one[1] ** 2 for one in results))
        firsts = np.cumsum([0, *map(len, groups)])  # bit of a group's first pair
        bits = sum(np.nan_to_num(one[3]).astype(np.int64) << first for one, first in zip(results, firsts, strict=False))
        rows, known = self._rows(tile, groups), np.isfinite(bands[0])
        for pattern in np.unique(bits[known]):
            cells = known & (bits == pattern)
            chosen = [
                [pair for k, pair in enumerate(group, start=first) if pattern >> k & 1]
                for group, first in zip(groups, firsts, strict=False)
            ]
            bands[1, cells] = min(map(len, chosen))
            # pairs of n images have n - 1 independent parallaxes
            free = [min(len(one), len({view for pair in one for view in pair}) - 1) for one in chosen]
            bands[3, cells] = np.sqrt(sum(one[2][cells] ** 2 / n for one, n in zip(results, free, strict=True)))
            if self.block.errors is not None:
                sigma = self.block.errors.sigma(_difference(rows, chosen) - shared).reshape(NODES, NODES)
                at = [(np.arange(count) + 0.5) / count * (NODES - 1) for count in height.shape]
                every = map_coordinates(sigma, np.meshgrid(*at, indexing="ij"), order=1)
                bands[4, cells] = every[cells]
        return bands

    def _opened(self, path: Path, shared: Array) -> Any:
        """Open the file to be written, with the words and tags that it is to have."""
        cells = self.whole
        layout = {"tiled": True, "blockxsize": SIDE, "blockysize": SIDE, "SPARSE_OK": True, "BIGTIFF": "IF_SAFER"}
        place = {
            "crs": CRS.from_wkt(cells.crs),
            "transform": Affine(cells.step, 0, cells.west, 0, -cells.step, cells.north),
        }
        kind = {"dtype": "float32", "nodata": float("nan"), "compress": "deflate"}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            file = rasterio.open(path, "w", "GTiff", *cells.size, len(BANDS), **place, **kind, **layout)
        file.update_tags(BARPC=__version__, VERTICAL_REFERENCE="WGS84 ellipsoid", IMAGES=self.block.source)
        if self.block.errors is not None:
            file.update_tags(**{SHARED: f"{self.block.errors.sigma(shared[None])[0]:.4f}"})
        file.descriptions = (BANDS[0] if len(self.block.groups) == 1 else CHANGE, *BANDS[1:])
        return file


def _difference(rows: dict[tuple[int, int], Array], groups: Sequence[Sequence[tuple[int, int]]]) -> Array:
    """Return the mean of the rows of the first group's pairs, minus those of the others."""
    first, *others = (np.mean([rows[pair] for pair in group], axis=0) for group in groups)
    return np.asarray(first - sum(others))


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
        prints = Footprints((first, second), alt)
        common = shapely.intersection(prints.outlines[0], prints.outlines[1])
        ground = prints.ground(shapely.get_coordinates(common))
        x, y = warped(CRS.from_epsg(4326), crs, *ground[:, :2].T)
        parts.append(shapely.set_coordinates(common, np.column_stack([x, y])))
    return shapely.union_all(parts)
