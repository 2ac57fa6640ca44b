"""A surface model of a block of images: tiles of a map, one after the other, into a Cloud-Optimised GeoTIFF."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
import shapely
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.errors import CRSError, NotGeoreferencedWarning
from rasterio.warp import transform
from rasterio.windows import Window

from barpc import __version__
from barpc.atomic import replacing
from barpc.dsm.block import Block, NoSurfaceError, block_of_images, block_of_run
from barpc.dsm.cells import F32, MATCHED, SIDE, Tile, surface_tile
from barpc.errors import InputError, OutputError
from barpc.geodesy import Array
from barpc.options import DsmOptions
from barpc.pipeline.executor import CachingExecutor
from barpc.pipeline.hashed import hash_files
from barpc.scene import View
from barpc.sensor.geometry import footprint, ground_sample_distance
from barpc.sidefile import plain_path
from barpc.tie.tasks import Progress, one_by_one
from barpc.workspace import Workspace

BANDS = (
    "height above the WGS84 ellipsoid [m]",
    "pairs of images",
    "disagreement of the pairs: NMAD [m]",
    "sigma of the height: matching [m]",
    "sigma of the height: cameras, without what all cells share [m]",
)
_NODES = 3  # a side of a tile, at which the cameras' errors are asked
_DATUM_NODES = 200  # points at which what all cells share is measured, at most


@dataclass(frozen=True)
class Surface:
    """What became of a surface: the file, its cells, and medians over them [m]; NaN where not known.

    `known`: cells with a height; `share`: of the pixels that both images of a pair show so many were matched;
    `datum`: standard deviation of the height that all cells share.
    """

    path: str
    pairs: tuple[str, ...]
    gsd: float
    size: tuple[int, int]
    known: int
    share: float
    nmad: float
    sigma: float
    sigma_cameras: float
    datum: float


def make_dsm(
    source: str | Path | Sequence[str],
    out: str | Path,
    options: DsmOptions | None = None,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Surface:
    """Make a first surface model of a finished run, or of images with their cameras.

    Parameters
    ----------
    source : path of a run folder, or a list of images
    out : path of the GeoTIFF
    options : DsmOptions, optional
    executor, progress : as of `barpc.adjust`; the bytes written do not depend on them

    Raises
    ------
    NoSurfaceError
        Images that SGBM cannot match: radar, too large an angle, hardly a pixel that is found back.
    InputError, OutputError
        See `barpc.errors`; nothing is written then.
    """
    options, out = options or DsmOptions(), Path(out)
    plain_path(out.absolute())
    if isinstance(source, str | Path):
        block = block_of_run(Path(source), options.alt)
    else:
        block = block_of_images(source, options.alt, options.band)
    if out.is_dir() or out.resolve() in {Path(view.path).resolve() for view in block.views}:
        raise OutputError(f"{out}: is a folder or one of the images; give -o the name of a new file")
    grid = Grid.of(block, options)
    with replacing(out, overwrite=options.overwrite) as partial, _workspace(out) as run:
        rough = run.partial / "tiles.tif"
        with run.stage("surface"):
            sums = grid.fill(rough, run, executor, progress)
        if not sums.known:
            raise NoSurfaceError(
                f"of the pixels that both images show {100 * max(sums.share, 0):.0f} % are found back at most, "
                f"fewer than {100 * MATCHED:.0f} %: other seasons, water, clouds or wrong cameras; nothing is written"
            )
        with run.stage("write"), rasterio.Env(GDAL_NUM_THREADS="1"):
            rasterio.shutil.copy(
                rough,
                partial,
                driver="COG",
                COMPRESS="DEFLATE",
                PREDICTOR="YES",
                BLOCKSIZE=str(SIDE),
                BIGTIFF="IF_SAFER",
            )
    shutil.rmtree(run.folder, ignore_errors=True)  # (what was kept for going on; it is done)
    return sums.told(out, grid)


@contextmanager
def _workspace(out: Path) -> Iterator[Workspace]:
    """Where results of tiles are kept beside the file until it is whole: the same command goes on with them."""
    with Workspace(out.parent / f"{out.name}.unfinished") as run:
        yield run


@dataclass
class _Sums:
    """What is counted as tiles come."""

    known: int = 0
    share: float = float("nan")
    medians: Any = None
    datum: float = float("nan")

    def told(self, out: Path, grid: Grid) -> Surface:
        """The same in a record."""
        names = [view.name for view in grid.block.views]
        pairs = tuple(f"{names[i]} - {names[j]}" for i, j in grid.used)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            nmad, sigma, cameras = (float(np.nanmedian(row)) for row in np.concatenate(self.medians, axis=1))
        found = self.known, self.share, nmad, sigma, cameras, self.datum
        return Surface(str(out), pairs, grid.step, grid.size, *found)


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
    outlines: tuple[Any, ...]  # of the pairs' common ground, on the map

    @classmethod
    def of(cls, block: Block, options: DsmOptions) -> Grid:
        """The cells in UTM or the CRS asked for, at twice the ground sampling distance unless told."""
        first = block.views[block.pairs[0][0]]
        middle = first.sensor.localize((np.array(first.size) - 1) / 2, np.array(first.altitude))
        crs = _crs(options.crs, middle)
        pixel = [_pixel(view) for view in block.views]
        step = options.gsd or float(f"{2 * max(pixel):.2g}")
        outlines = tuple(_common(block.views[i], block.views[j], crs) for i, j in block.pairs)
        whole = shapely.union_all(outlines)
        if whole.is_empty:
            raise NoSurfaceError("no two images overlap at the altitudes that they are used for")
        low, high = np.array(whole.bounds).reshape(2, 2)
        west, north = float(np.floor(low[0] / step) * step), float(np.ceil(high[1] / step) * step)
        size = int(np.ceil((high[0] - west) / step)), int(np.ceil((north - low[1]) / step))
        return cls(block, options, crs, west, north, step, size, outlines)

    @property
    def used(self) -> tuple[tuple[int, int], ...]:
        """Pairs that some tile is made of."""
        return tuple(dict.fromkeys(self.block.pairs[k] for _, ranks in self.tiles() for k in ranks))

    def tiles(self) -> list[tuple[tuple[int, int], list[int]]]:
        """First col, row of every tile that is seen, and the best pairs that see it."""
        found = []
        for row in range(0, self.size[1], SIDE):
            for col in range(0, self.size[0], SIDE):
                box = self.box(col, row)
                ranks = [k for k, outline in enumerate(self.outlines) if outline.intersects(box)]
                if ranks:
                    found.append(((col, row), ranks[: self.options.pairs]))
        return found

    def box(self, col: int, row: int) -> Any:
        """The outline of a tile on the map."""
        width, height = min(SIDE, self.size[0] - col), min(SIDE, self.size[1] - row)
        left, top = self.west + self.step * col, self.north - self.step * row
        return shapely.box(left, top - self.step * height, left + self.step * width, top)

    def tile(self, col: int, row: int) -> Tile:
        """The tile that begins at a cell."""
        size = min(SIDE, self.size[0] - col), min(SIDE, self.size[1] - row)
        views = self.block.views
        alts = max(v.alt_range[0] for v in views), min(v.alt_range[1] for v in views)
        corner = self.west + self.step * col, self.north - self.step * row
        return Tile(self.crs.to_wkt(), *corner, self.step, size, (min(alts), max(alts)))

    def fill(self, path: Path, run: Workspace, executor: Executor | None, progress: Progress | None) -> _Sums:
        """Write all tiles into a plain GeoTIFF; each is made by a worker and forgotten once it is written."""
        views, seen = self.block.views, self.tiles()
        tiles = [self.tile(*at) for at, _ in seen]
        pairs = [[self.block.pairs[k] for k in ranks] for _, ranks in seen]
        tasks = [
            (tuple((views[i], views[j]) for i, j in of_tile), tile, self.options.band)
            for tile, of_tile in zip(tiles, pairs, strict=True)
        ]
        paths = [view.path for view in views]
        inputs = dict(zip(paths, hash_files(paths), strict=True))
        shared = self._shared(tiles, pairs)
        sums = _Sums(medians=[])
        if self.block.errors is not None:
            sums.datum = float(self.block.errors.sigma(shared[None])[0])
        with self._opened(path, sums.datum) as file, CachingExecutor(run, inputs, executor) as caching:
            results = one_by_one(caching, surface_tile, tasks, "surface", progress)
            for ((col, row), _), tile, of_tile, result in zip(seen, tiles, pairs, results, strict=True):
                bands = self._bands(tile, of_tile, result, shared)
                file.write(bands, window=Window(col, row, *tile.size))
                known = np.isfinite(bands[0])
                sums.known += int(known.sum())
                sums.share = float(np.nanmax([sums.share, *result[4], -1.0]))
                sums.medians.append(bands[2:, known][:, :: max(1, known.sum() // 10_000)])
        return sums

    def _shared(self, tiles: Sequence[Tile], pairs: Sequence[Sequence[tuple[int, int]]]) -> Array:
        """Derivative (V q,) of the mean height of all cells by the cameras' unknowns."""
        errors = self.block.errors
        if errors is None:
            return np.zeros(0)
        some = range(0, len(tiles), 1 + len(tiles) // _DATUM_NODES)
        rows = [errors.rows(pair, _nodes(tiles[n])).mean(axis=0) for n in some for pair in pairs[n]]
        return np.asarray(np.mean(rows, axis=0))

    def _bands(
        self, tile: Tile, pairs: Sequence[tuple[int, int]], result: Sequence[F32], shared: Array
    ) -> F32:
        """The bands (5, rows, cols) of a tile."""
        height, nmad, sigma, seen, _ = result
        bits, cameras = np.nan_to_num(seen).astype(np.int64), np.full(height.shape, np.nan, np.float32)
        count, independent = np.zeros(height.shape), np.ones(height.shape)
        of_pairs = (
            [] if self.block.errors is None else [self.block.errors.rows(p, _nodes(tile)) for p in pairs]
        )
        for pattern in np.unique(bits[bits > 0]):
            chosen, cells = [k for k in range(len(pairs)) if pattern >> k & 1], bits == pattern
            count[cells] = len(chosen)
            # pairs of n images have n - 1 independent parallaxes
            independent[cells] = min(len(chosen), len({view for k in chosen for view in pairs[k]}) - 1)
            if self.block.errors is not None:
                rows = np.mean([of_pairs[k] for k in chosen], axis=0) - shared
                cameras[cells] = _spread(self.block.errors.sigma(rows), tile.size)[cells]
        return np.stack([height, count, nmad, sigma / np.sqrt(independent), cameras]).astype(np.float32)

    @contextmanager
    def _opened(self, path: Path, datum: float) -> Iterator[Any]:
        profile: dict[str, Any] = {"width": self.size[0], "height": self.size[1], "count": len(BANDS)}
        profile |= {
            "dtype": "float32",
            "nodata": float("nan"),
            "crs": self.crs,
            "tiled": True,
            "BIGTIFF": "IF_SAFER",
        }
        profile |= {"blockxsize": SIDE, "blockysize": SIDE, "compress": "deflate", "SPARSE_OK": True}
        profile["transform"] = Affine(self.step, 0.0, self.west, 0.0, -self.step, self.north)
        tags = {"BARPC": __version__, "VERTICAL_REFERENCE": "WGS84 ellipsoid", "IMAGES": self.block.source}
        if np.isfinite(datum):
            tags["SIGMA_SHARED_BY_ALL_CELLS_M"] = f"{datum:.4f}"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path, "w", driver="GTiff", **profile) as file:
                file.update_tags(**tags)
                for number, words in enumerate(BANDS, start=1):
                    file.set_band_description(number, words)
                yield file


def _nodes(tile: Tile) -> Array:
    """Ground points of a tile at its middle altitude."""
    nodes = tile.nodes(_NODES)
    return np.column_stack([nodes, np.full(len(nodes), sum(tile.alts) / 2)])


def _spread(values: Array, size: tuple[int, int]) -> Array:
    """Values at a tile's nodes over its cells (rows, cols), linearly."""
    at = [(np.arange(side) + 0.5) / side * (_NODES - 1) for side in size]
    grid, nodes = values.reshape(_NODES, _NODES), np.arange(_NODES)
    along = np.stack([np.interp(at[0], nodes, row) for row in grid])
    return np.stack([np.interp(at[1], nodes, col) for col in along.T], axis=1)


def _pixel(view: View) -> float:
    middle = (np.array(view.size) - 1) / 2
    ground = view.sensor.localize(middle, np.array(view.altitude))
    return float(ground_sample_distance(view.sensor, ground)[1])


def _crs(given: str | None, middle: Array) -> CRS:
    """The CRS that was asked for, in metres, or the UTM zone of a place."""
    if given is None:
        zone = int((middle[0] + 180.0) // 6.0) % 60 + 1
        return CRS.from_epsg((32600 if middle[1] >= 0 else 32700) + zone)
    try:
        found = CRS.from_user_input(given)
    except CRSError as error:
        raise InputError(f"--crs {given}: no reference system that PROJ knows ({error})") from error
    if not found.is_projected or found.linear_units_factor[1] != 1.0:
        raise InputError(
            f"--crs {given}: cells need a projected reference system in metres, such as EPSG:32631"
        )
    return found


def _common(first: View, second: View, crs: CRS) -> Any:
    """The ground that two views see at their lowest or highest altitude, on the map."""
    low, high = max(first.alt_range[0], second.alt_range[0]), min(first.alt_range[1], second.alt_range[1])
    parts = []
    for alt in (low, high):
        rings = []
        for view in (first, second):
            ring = footprint(view.sensor, view.size, alt)
            ring = ring[np.isfinite(ring).all(axis=1)]
            x, y = transform(CRS.from_epsg(4326), crs, ring[:, 0], ring[:, 1])
            rings.append(shapely.make_valid(shapely.Polygon(np.column_stack([x, y]))))
        parts.append(shapely.intersection(rings[0], rings[1]))
    return shapely.union_all(parts)
