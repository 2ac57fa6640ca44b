"""A surface model of a block of images, or its change between two dates, as a Cloud-Optimised GeoTIFF.

And the picture that convinces: the same window of the ground by the cameras as delivered, and corrected.
"""

from __future__ import annotations

import json
import logging
import shutil
import warnings
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rasterio
import rasterio.shutil
import shapely
from rasterio import Affine
from rasterio.crs import CRS
from rasterio.errors import NotGeoreferencedWarning
from rasterio.warp import transform
from rasterio.windows import Window
from scipy.ndimage import map_coordinates

from barpc import __version__
from barpc.base.atomic import refuse_existing, replacing
from barpc.base.errors import BarpcError, InputError, OutputError
from barpc.base.geodesy import Array
from barpc.base.safe_io import plain_path
from barpc.base.tasks import Progress, one_by_one
from barpc.base.verb_options import DsmOptions
from barpc.cameras import open_camera
from barpc.dsm.consensus import F32
from barpc.dsm.stereo import (
    MATCHED,
    TILE_NODES,
    Groups,
    NoSurfaceError,
    StereoBlock,
    Tile,
    block_of_images,
    block_of_run,
    surface_tile,
)
from barpc.pipeline.executor import CachingExecutor, worker_count
from barpc.pipeline.pictures import encoded
from barpc.pipeline.remake import remake_report
from barpc.rasters.raster import hashed, map_crs, open_raster
from barpc.rasters.vrt import BLOCK_SIZE
from barpc.report.finished import FinishedRun
from barpc.report.page import can_render
from barpc.report.runfiles import FOLDER, SURFACE, run_key
from barpc.scene import View
from barpc.sensor.geometry import ground_sample_distance
from barpc.tie.pairing.epipolar import common_range
from barpc.tie.pairing.overlaps import Footprints
from barpc.tie.pixels import read_pixels, sample_stretch
from barpc.workspace import Workspace

logger = logging.getLogger(__name__)

SURFACE_BANDS = (
    "height above the WGS84 ellipsoid [m]",
    "pairs of images",
    "disagreement of the pairs: NMAD [m]",
    "sigma of the height: matching [m]",
    "sigma of the height: cameras, without what all cells share [m]",
)
CHANGE = "height minus that of the other images [m]"
SHARED = "SIGMA_SHARED_BY_ALL_CELLS_M"
# cells a side in the report: they are matched again, with the delivered cameras, in about a second. Matches of the
# corrected ones, intersected with these, would have heights in 99.9 % of the cells where SGBM finds none
_RELIEF_SIDE = BLOCK_SIZE // 2
_SHADING_DIRECTION = np.array([-0.5, 0.5, np.sqrt(0.5)])  # from the north-west, 45 degrees up


@dataclass(frozen=True)
class Surface:
    """Result of a surface: its file, its cells, and medians over them [m]; NaN where not known.

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
    """Make a first surface model of a finished run (a path), or of images with their cameras: see `barpc.dsm`."""
    options, out, folder = options or DsmOptions(), Path(out), None
    plain_path(out.absolute())
    if isinstance(source, str | Path):
        folder = Path(source)
        block = block_of_run(folder, options.alt, options.minus)
    elif options.minus is not None:
        raise InputError("minus: what two dates share is known of a run alone, not of images")
    else:
        block = block_of_images(source, options.alt, options.band)
    if out.is_dir() or out.resolve() in {Path(view.path).resolve() for view in block.views}:
        raise OutputError(f"{out}: is a folder or one of the images; give -o the name of a new file")
    grid = Grid(block, options)
    _publish(out, folder, options.overwrite)
    room = out.parent / f"{out.name}.unfinished"  # results of tiles, until the file is whole
    try:
        with Workspace(room) as run:
            made = run.partial / "dsm.tif"
            found = grid.write(out, made, run, executor, progress)
            if folder is not None and block.run is not None and options.minus is None:
                show_in_report(block.run, block, grid.tiles, made, options.band)
            _publish(out, folder, options.overwrite, made)
    except NoSurfaceError:
        shutil.rmtree(room, ignore_errors=True)
        raise
    shutil.rmtree(room, ignore_errors=True)
    return found


def _publish(out: Path, folder: Path | None, overwrite: bool, made: Path | None = None) -> None:
    """Give a file its place, in the folder of its run as one of the run's own; without a file ask whether it may."""
    if folder is None or out.parent.resolve() != folder.resolve():
        refuse_existing(out, overwrite)
        if made is not None:
            with replacing(out, overwrite=overwrite, room=made.parent) as partial:
                made.replace(partial)
        return
    with Workspace(folder, overwrite=overwrite, names=[out.name], adds=True) as own:
        if made is not None:
            with own.output(out.name) as partial:
                made.replace(partial)


class Grid:
    """Cells of a map, in UTM or the CRS asked for, of twice the ground sampling distance unless told.

    `whole`: all of them; `side` a tile; `tiles`: first col, row of every tile that is seen, the tile, and the best
    pairs of each group there.
    """

    def __init__(self, block: StereoBlock, options: DsmOptions) -> None:
        self.block, self.options, views = block, options, block.views
        middles = [v.sensor.localize((np.array(v.size) - 1) / 2, np.array(v.altitude)) for v in views]
        crs = map_crs(options.crs, middles[block.groups[0][0][0]])
        pixels = [float(ground_sample_distance(v.sensor, at)[1]) for v, at in zip(views, middles, strict=True)]
        step = options.gsd or float(f"{2 * max(pixels):.2g}")
        if (step / min(pixels)) ** 2 < MATCHED:
            raise InputError(
                f"--gsd {step:g}: a pixel of {min(pixels):.2g} m has one match, so fewer than {100 * MATCHED:.0f} % of "
                "such cells would have a height"
            )
        if step > 2 * BLOCK_SIZE * max(pixels):
            raise InputError(f"--gsd {step:g}: a cell of more than {2 * BLOCK_SIZE} pixels of {max(pixels):.2g} m")
        outlines = [[_common_ground(views[i], views[j], crs) for i, j in group] for group in block.groups]
        seen = shapely.intersection_all([shapely.union_all(group) for group in outlines])
        if seen.is_empty:
            raise NoSurfaceError("the images do not overlap at the altitudes that they are used for")
        west, south, east, north = np.array(seen.bounds) / step
        west, north = float(np.floor(west)), float(np.ceil(north))
        size = int(np.ceil(east - west)), int(np.ceil(north - south))
        self.whole = Tile(crs.to_wkt(), west * step, north * step, step, size, common_range(*views))
        # a tile shows about as many pixels, however large its cells are
        self.side = BLOCK_SIZE >> max(0, round(np.log2(step / (2 * max(pixels)))))
        self.tiles: list[tuple[tuple[int, int], Tile, Groups]] = []
        for row, col in np.ndindex(-(-size[1] // self.side), -(-size[0] // self.side)):
            at = self.side * col, self.side * row
            tile = self.whole.part(*at, self.side)
            east, south = tile.west + step * tile.size[0], tile.north - step * tile.size[1]
            box = shapely.box(tile.west, south, east, tile.north)
            groups = [
                [pair for pair, outline in zip(*one, strict=True) if outline.intersects(box)][: options.pairs]
                for one in zip(block.groups, outlines, strict=True)
            ]
            if all(groups):
                self.tiles.append((at, tile, groups))

    def write(
        self, out: Path, made: Path, run: Workspace, executor: Executor | None, progress: Progress | None
    ) -> Surface:
        """Write the surface for `out` as `made`; a worker makes each tile, and it is forgotten once written."""
        views, known, share, rough = self.block.views, 0, -1.0, run.partial / "tiles.tif"
        tasks = [
            (tuple((views[i], views[j]) for i, j in group), tile, self.options.band)
            for _, tile, groups in self.tiles
            for group in groups
        ]
        paths, shared = [view.path for view in views], self.shared()
        inputs = {path: hashed(path) for path in paths}
        with run.stage("surface"), self._opened(rough) as file, CachingExecutor(run, inputs, executor) as caching:
            results = one_by_one(caching, surface_tile, tasks, "surface", progress, 4 * worker_count(executor))
            for at, tile, groups in self.tiles:
                found = [next(results) for _ in groups]
                bands = self._bands(tile, groups, found, shared)
                file.write(bands, window=Window(*at, *tile.size))
                known += int(np.isfinite(bands[0]).sum())
                share = float(np.nanmax([share, *(part for one in found for part in one[4])]))
            if self.block.errors is not None:
                file.update_tags(**{SHARED: f"{self.block.errors.sigma(shared[None])[0]:.4f}"})
        if not known:
            raise NoSurfaceError(
                f"of the pixels that both images show {100 * max(share, 0):.0f} % are found back at most, "
                f"fewer than {100 * MATCHED:.0f} %: other seasons, water, clouds or wrong cameras; nothing is written"
            )
        layout = {"COMPRESS": "DEFLATE", "PREDICTOR": "YES", "BLOCKSIZE": str(BLOCK_SIZE), "BIGTIFF": "IF_SAFER"}
        with run.stage("write"), rasterio.Env(GDAL_NUM_THREADS="1"):
            rasterio.shutil.copy(rough, made, driver="COG", **layout)
        with open_raster(made) as file, warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # medians of nothing
            some = file.read([3, 4, 5], out_shape=(3, *(min(side, 2 * BLOCK_SIZE) for side in file.shape)))
            medians = map(float, [*np.nanmedian(some, axis=(1, 2)), file.tags().get(SHARED, "nan")])
        used = dict.fromkeys(pair for _, _, groups in self.tiles for group in groups for pair in group)
        pairs = tuple(f"{views[i].name} - {views[j].name}" for i, j in used)
        return Surface(str(out), pairs, self.whole.step, self.whole.size, known, share, *medians)

    def shared(self) -> Array:
        """Return the derivative (V q,) of the mean height of all tiles, or difference of it, by the cameras' unknowns;
        of images without a run none.
        """
        if self.block.errors is None:
            return np.zeros(0)
        rows = [self.block.errors.rows(groups, tile.ground()).mean(axis=0) for _, tile, groups in self.tiles]
        return np.asarray(np.mean(rows, axis=0))

    def _bands(self, tile: Tile, groups: Groups, results: Sequence[Sequence[F32]], shared: Array) -> F32:
        """Return the bands (5, rows, cols) of a tile: of one group of pairs, or of the first minus the second."""
        height, *minus = (one[0] for one in results)
        bands, errors = np.full((len(SURFACE_BANDS), *height.shape), np.nan, np.float32), self.block.errors
        bands[0], bands[1], bands[2] = height - sum(minus), 0.0, np.sqrt(sum(one[1] ** 2 for one in results))
        known, seen = np.isfinite(bands[0]), np.stack([np.asarray(one[3], np.int64) for one in results])
        for patterns in np.unique(seen[:, known], axis=1).T:
            cells = known & (seen == patterns[:, None, None]).all(axis=0)
            chosen = [
                [pair for k, pair in enumerate(group) if pattern >> k & 1]
                for group, pattern in zip(groups, patterns, strict=True)
            ]
            bands[1, cells] = min(map(len, chosen))
            # pairs of n images have n - 1 independent parallaxes
            free = [min(len(one), len({view for pair in one for view in pair}) - 1) for one in chosen]
            bands[3, cells] = np.sqrt(sum(one[2][cells] ** 2 / n for one, n in zip(results, free, strict=True)))
            if errors is not None:
                sigma = errors.sigma(errors.rows(chosen, tile.ground()) - shared).reshape(TILE_NODES, TILE_NODES)
                at = (np.argwhere(cells) + 0.5) / height.shape * (TILE_NODES - 1)
                bands[4, cells] = map_coordinates(sigma, at.T, order=1)
        return bands

    def _opened(self, path: Path) -> Any:
        """Open the file to be written, with the words and tags that it is to have."""
        cells = self.whole
        place = {"crs": cells.crs, "transform": Affine(cells.step, 0, cells.west, 0, -cells.step, cells.north)}
        layout = {
            "tiled": True,
            "blockxsize": BLOCK_SIZE,
            "blockysize": BLOCK_SIZE,
            "SPARSE_OK": True,
            "BIGTIFF": "IF_SAFER",
        }
        kind = {"dtype": "float32", "nodata": float("nan"), "compress": "deflate"}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            file = rasterio.open(path, "w", "GTiff", *cells.size, len(SURFACE_BANDS), **place, **kind, **layout)
        file.update_tags(BARPC=__version__, VERTICAL_REFERENCE="WGS84 ellipsoid", IMAGES=self.block.source)
        file.descriptions = (SURFACE_BANDS[0] if len(self.block.groups) == 1 else CHANGE, *SURFACE_BANDS[1:])
        return file


def _common_ground(first: View, second: View, crs: CRS) -> Any:
    """Return the ground that two views see at their lowest or highest altitude, on the map."""
    parts = []
    for alt in common_range(first, second):
        prints = Footprints((first, second), alt)
        common = shapely.intersection(prints.outlines[0], prints.outlines[1])
        ground = prints.ground(shapely.get_coordinates(common))
        on_map = np.column_stack(transform("EPSG:4326", crs, *ground[:, :2].T))
        parts.append(shapely.set_coordinates(common, on_map))
    return shapely.union_all(parts)


def show_in_report(
    run: FinishedRun,
    block: StereoBlock,
    tiles: Sequence[tuple[tuple[int, int], Tile, Groups]],
    made: Path,
    band: int,
) -> None:
    """Show both reliefs of the part of a tile that has most heights, and two images on the surface, in a run's report;
    where that fails a line says why.
    """
    try:
        windows = [
            ((col + right, row + down), tile.part(right, down, _RELIEF_SIDE), groups[0])
            for (col, row), tile, groups in tiles
            for right in range(0, tile.size[0], _RELIEF_SIDE)
            for down in range(0, tile.size[1], _RELIEF_SIDE)
        ]
        with open_raster(made) as file:
            read = ((part, some, file.read([1, 3], window=Window(*at, *part.size))) for at, part, some in windows)
            tile, pairs, after = max(read, key=lambda row: np.isfinite(row[2][0]).sum())
        views = {i: _delivered(block.views[i], run, i) for pair in pairs for i in pair}
        before = surface_tile([(views[i], views[j]) for i, j in pairs], tile, band)
        shown: list[dict[str, object]] = []  # as `barpc.report.runfiles` reads them
        for cameras, (height, nmad) in (("delivered", before[:2]), ("corrected", after)):
            middle = float(np.nanmedian(nmad)) if np.isfinite(nmad).any() else None
            row = {"cameras": cameras, "share": float(np.isfinite(height).mean()), "nmad_m": middle}
            shown.append(row | encoded(shaded(height, tile.step)))
        seen = (block.views[i] for i in pairs[0])
        shown += [{"image": view.name, **encoded(draped(view, tile, after[0], band))} for view in seen]
        text, name = json.dumps({"run": run_key(run.summary), "shown": shown}), f"{FOLDER}/{SURFACE}"
        with Workspace(run.folder, overwrite=True, names=[name], adds=True) as own:
            own.write_text(name, text)
        if can_render():
            remake_report(run.folder)
    except (BarpcError, OSError) as error:
        logger.warning("the report does not show the surface: %s", error)


def _delivered(view: View, run: FinishedRun, number: int) -> View:
    """Return a view of a run with the camera that came with its image."""
    source = run.summary.views[number].rpc_source
    if source is None:
        raise BarpcError(f"{view.name}: no file holds its delivered camera")
    return replace(view, sensor=open_camera(view.path, camera=run.input(source.path)).model)


def draped(view: View, tile: Tile, height: F32, band: int) -> npt.NDArray[np.uint8]:
    """Return the grey values of a view at a tile's cells with these heights (rows, cols) [m]; black where unknown."""
    grey, known = np.zeros(height.shape, np.uint8), np.isfinite(height)
    at = view.sensor.project(np.column_stack([tile.nodes(tile.size, 0.5), height.ravel()])[known.ravel()])
    at = np.clip(np.nan_to_num(at), 0.0, np.array(view.size) - 1.0)
    low, high = np.floor(at.min(axis=0)).astype(int), np.ceil(at.max(axis=0)).astype(int) + 1
    stretch, box = sample_stretch(view.path, band, view.size), (*low.tolist(), *(high - low).tolist())
    if stretch is not None:
        picture = stretch.apply(*read_pixels(view.path, box, band, view.size))
        grey[known] = map_coordinates(picture, (at - low).T[::-1], order=1)
    return grey


def shaded(height: F32, step: float) -> npt.NDArray[np.uint8]:
    """Return a relief (rows, cols) [m] of cells of `step` [m] in the light of the north-west; the unknown black."""
    by_row, by_col = np.gradient(height.astype(np.float64), step)
    normal = np.stack([-by_col, by_row, np.ones(height.shape)])  # rows count to the south
    light = np.einsum("i,ijk->jk", _SHADING_DIRECTION, normal / np.linalg.norm(normal, axis=0))
    return np.asarray(np.nan_to_num(np.clip(light, 0.05, 1.0) * 255.0), np.uint8)
