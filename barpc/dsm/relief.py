"""The picture that convinces: the same window of the ground by the cameras as delivered, and corrected."""

from __future__ import annotations

import base64
import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rasterio.windows import Window
from scipy.ndimage import map_coordinates

from barpc.cameras import open_camera
from barpc.dsm.cells import F32, Tile, surface_tile
from barpc.dsm.grid import Grid
from barpc.dsm.imagery import Block
from barpc.errors import BarpcError
from barpc.raster import open_raster
from barpc.report.page import can_render, remake_report
from barpc.report.tables import SURFACE, run_key
from barpc.scene import View
from barpc.tie.pixels import jpeg, read_pixels, sample_stretch
from barpc.workspace import TABLES, Workspace

logger = logging.getLogger(__name__)

_LIGHT = np.array([-0.5, 0.5, np.sqrt(0.5)])  # from the north-west, 45 degrees up


def show_in_report(folder: Path, grid: Grid, out: Path) -> None:
    """Show both reliefs, and two images on the surface, in a run's report; where that fails a line says why."""
    try:
        assert grid.block.run is not None
        made = {"run": run_key(grid.block.run), "shown": _reliefs(grid, out)}
        text, name = json.dumps(made), f"{TABLES}/{SURFACE}"
        with Workspace(folder, overwrite=True, names=[name], adds=True) as run:
            run.write_text(name, text)
        if can_render():
            remake_report(folder)
    except (BarpcError, OSError) as error:
        logger.warning("the report does not show the surface: %s", error)


def _reliefs(grid: Grid, out: Path) -> list[dict[str, object]]:
    """Return the pictures, as `barpc.report.tables` reads them, of the tile that has most heights."""
    with open_raster(out) as file:
        read = (
            (at, groups[0], file.read([1, 3], window=Window(*at, *grid.tile(*at).size))) for at, groups in grid.tiles()
        )
        at, pairs, after = max(read, key=lambda row: np.isfinite(row[2][0]).sum())
    views = _delivered(grid.block)
    before = surface_tile([(views[i], views[j]) for i, j in pairs], grid.tile(*at), grid.options.band)
    found: list[dict[str, object]] = []
    for cameras, (height, nmad) in (("delivered", before[:2]), ("corrected", after)):
        known = np.isfinite(nmad)
        middle = float(np.median(nmad[known])) if known.any() else None
        row = {"cameras": cameras, "share": float(np.isfinite(height).mean()), "nmad_m": middle}
        found.append(row | _picture(shaded(height, grid.step)))
    for view in (grid.block.views[i] for i in pairs[0]):
        grey = draped(view, grid.tile(*at), after[0], grid.options.band)
        found.append({"image": view.name, **_picture(grey)})
    return found


def _delivered(block: Block) -> list[View]:
    """Return the views with the cameras that came with their images."""
    assert block.run is not None
    sources = {view.name: view.rpc_source for view in block.run.views}
    found = []
    for view in block.views:
        source = sources[view.name]
        if source is None:
            raise BarpcError(f"{view.name}: no file holds its delivered camera")
        found.append(replace(view, sensor=open_camera(view.path, camera=source.path).model))
    return found


def _picture(grey: npt.NDArray[np.uint8]) -> dict[str, object]:
    return {"size": [grey.shape[1], grey.shape[0]], "picture": base64.b64encode(jpeg(grey)).decode()}


def draped(view: View, tile: Tile, height: F32, band: int) -> npt.NDArray[np.uint8]:
    """Return what a view shows of a tile's cells of these heights (rows, cols) [m]; black where nothing is known."""
    grey, known = np.zeros(height.shape, np.uint8), np.isfinite(height)
    at = view.sensor.project(np.column_stack([tile.centres(), height.ravel()])[known.ravel()])
    at = np.clip(np.nan_to_num(at), 0.0, np.array(view.size) - 1.0)
    low, high = np.floor(at.min(axis=0)).astype(int), np.ceil(at.max(axis=0)).astype(int) + 1
    box = int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])
    stretch = sample_stretch(view.path, band, view.size)
    if stretch is not None:
        picture = stretch.apply(*read_pixels(view.path, box, band, view.size))
        grey[known] = map_coordinates(picture, (at - low).T[::-1], order=1)
    return grey


def shaded(height: F32, step: float) -> npt.NDArray[np.uint8]:
    """Return a relief (rows, cols) [m] in the light of the north-west, cells of `step` [m]; black where
    nothing is known.
    """
    by_row, by_col = np.gradient(height.astype(np.float64), step)
    normal = np.stack([-by_col, by_row, np.ones(height.shape)])  # rows count to the south
    light = np.einsum("i,ijk->jk", _LIGHT, normal / np.linalg.norm(normal, axis=0))
    grey: npt.NDArray[np.uint8] = np.nan_to_num(np.clip(light, 0.05, 1.0) * 255.0).astype(np.uint8)
    return grey
