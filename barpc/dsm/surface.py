"""A surface model of a block of images, or what changed between two dates, as a Cloud-Optimised GeoTIFF."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
import rasterio.shutil

from barpc.base.atomic import refuse_existing, replacing
from barpc.base.errors import InputError, OutputError
from barpc.base.options import DsmOptions
from barpc.base.sidefile import plain_path
from barpc.dsm.cells import MATCHED, SIDE
from barpc.dsm.grid import SHARED, Grid
from barpc.dsm.imagery import NoSurfaceError, block_of_images, block_of_run
from barpc.dsm.relief import show_in_report
from barpc.rasters.raster import open_raster
from barpc.tie.tasks import Progress
from barpc.workspace import Workspace


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
        See `barpc.base.errors`; nothing is written then.
    """
    options, out = options or DsmOptions(), Path(out)
    plain_path(out.absolute())
    folder = Path(source) if isinstance(source, str | Path) else None
    if isinstance(source, str | Path):
        block = block_of_run(Path(source), options.alt, None if options.minus is None else Path(options.minus))
    elif options.minus is not None:
        raise InputError("minus: what two dates share is known of a run alone, not of images")
    else:
        block = block_of_images(source, options.alt, options.band)
    if out.is_dir() or out.resolve() in {Path(view.path).resolve() for view in block.views}:
        raise OutputError(f"{out}: is a folder or one of the images; give -o the name of a new file")
    grid = Grid.of(block, options)
    _place(out, folder, options.overwrite)
    room = out.parent / f"{out.name}.unfinished"  # results of tiles, until the file is whole
    try:
        with Workspace(room) as run:
            rough, made = run.partial / "tiles.tif", run.partial / "dsm.tif"
            known, share = _made(run, grid, executor, progress)
            if folder is not None and block.run is not None and options.minus is None:
                show_in_report(folder, block.run, grid, made)
            found = _told(out, grid, rough, known, share)
            _place(out, folder, options.overwrite, made)
    except NoSurfaceError:
        shutil.rmtree(room, ignore_errors=True)
        raise
    shutil.rmtree(room, ignore_errors=True)
    return found


def _made(run: Workspace, grid: Grid, executor: Executor | None, progress: Progress | None) -> tuple[int, float]:
    """Make the files `tiles.tif` and `dsm.tif` in a room; return the cells with a height and the share matched."""
    rough, made = run.partial / "tiles.tif", run.partial / "dsm.tif"
    with run.stage("surface"):
        known, share = grid.fill(rough, run, executor, progress)
    if not known:
        raise NoSurfaceError(
            f"of the pixels that both images show {100 * max(share, 0):.0f} % are found back at most, "
            f"fewer than {100 * MATCHED:.0f} %: other seasons, water, clouds or wrong cameras; nothing is written"
        )
    layout = {"COMPRESS": "DEFLATE", "PREDICTOR": "YES", "BLOCKSIZE": str(SIDE), "BIGTIFF": "IF_SAFER"}
    with run.stage("write"), rasterio.Env(GDAL_NUM_THREADS="1"):
        rasterio.shutil.copy(rough, made, driver="COG", **layout)
    return known, share


def _place(out: Path, folder: Path | None, overwrite: bool, made: Path | None = None) -> None:
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


def _told(out: Path, grid: Grid, cells: Path, known: int, share: float) -> Surface:
    """Return what is said of a surface: its pairs, and medians over its cells or, of many, some of them."""
    names = [view.name for view in grid.block.views]
    used = dict.fromkeys(pair for _, _, groups in grid.tiles() for group in groups for pair in group)
    pairs = tuple(f"{names[i]} - {names[j]}" for i, j in used)
    with open_raster(cells) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        some = file.read([3, 4, 5], out_shape=(3, *(min(side, 2 * SIDE) for side in file.shape)))
        nmad, sigma, cameras = map(float, np.nanmedian(some, axis=(1, 2)))
        datum = float(file.tags().get(SHARED, "nan"))
    return Surface(str(out), pairs, grid.whole.step, grid.whole.size, known, share, nmad, sigma, cameras, datum)
