"""The picture that convinces: the same window of the ground by the cameras as delivered, and corrected."""

from __future__ import annotations

import base64
import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rasterio.windows import Window
from scipy.ndimage import map_coordinates

from barpc.base.errors import BarpcError
from barpc.cameras import open_camera
from barpc.dsm.cells import F32, Tile, surface_tile
from barpc.dsm.stereo import Block, Groups
from barpc.pipeline.outputs import remake_report
from barpc.rasters.raster import open_raster
from barpc.report.page import can_render
from barpc.report.runfiles import FOLDER, SURFACE, run_key
from barpc.report.summary import Summary
from barpc.scene import View
from barpc.tie.pixels import jpeg, read_pixels, sample_stretch
from barpc.workspace import Workspace

logger = logging.getLogger(__name__)

_LIGHT = np.array([-0.5, 0.5, np.sqrt(0.5)])  # from the north-west, 45 degrees up


def show_in_report(
    folder: Path,
    run: Summary,
    block: Block,
    tiles: Sequence[tuple[tuple[int, int], Tile, Groups]],
    made: Path,
    band: int,
) -> None:
    """Show both reliefs of the tile that has most heights, and two images on the surface, in a run's report; where
    that fails a line says why.
    """
    try:
        with open_raster(made) as file:
            read = ((t, groups[0], file.read([1, 3], window=Window(*at, *t.size))) for at, t, groups in tiles)
            tile, pairs, after = max(read, key=lambda row: np.isfinite(row[2][0]).sum())
        views = {i: _delivered(block.views[i], run.views[i].rpc_source) for pair in pairs for i in pair}
        before = surface_tile([(views[i], views[j]) for i, j in pairs], tile, band)
        shown: list[dict[str, object]] = []  # as `barpc.report.runfiles` reads them
        for cameras, (height, nmad) in (("delivered", before[:2]), ("corrected", after)):
            middle = float(np.nanmedian(nmad)) if np.isfinite(nmad).any() else None
            row = {"cameras": cameras, "share": float(np.isfinite(height).mean()), "nmad_m": middle}
            shown.append(row | _picture(shaded(height, tile.step)))
        seen = (block.views[i] for i in pairs[0])
        shown += [{"image": view.name, **_picture(draped(view, tile, after[0], band))} for view in seen]
        text, name = json.dumps({"run": run_key(run), "shown": shown}), f"{FOLDER}/{SURFACE}"
        with Workspace(folder, overwrite=True, names=[name], adds=True) as own:
            own.write_text(name, text)
        if can_render():
            remake_report(folder)
    except (BarpcError, OSError) as error:
        logger.warning("the report does not show the surface: %s", error)


def _delivered(view: View, source: Any) -> View:
    """Return a view with the camera that came with its image, from its `source`."""
    if source is None:
        raise BarpcError(f"{view.name}: no file holds its delivered camera")
    return replace(view, sensor=open_camera(view.path, camera=source.path).model)


def _picture(grey: npt.NDArray[np.uint8]) -> dict[str, object]:
    return {"size": [grey.shape[1], grey.shape[0]], "picture": base64.b64encode(jpeg(grey)).decode()}


def draped(view: View, tile: Tile, height: F32, band: int) -> npt.NDArray[np.uint8]:
    """Return what a view shows of a tile's cells of these heights (rows, cols) [m]; black where nothing is known."""
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
    light = np.einsum("i,ijk->jk", _LIGHT, normal / np.linalg.norm(normal, axis=0))
    return np.asarray(np.nan_to_num(np.clip(light, 0.05, 1.0) * 255.0), np.uint8)
