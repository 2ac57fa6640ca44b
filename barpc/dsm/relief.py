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

from barpc.cameras import open_camera
from barpc.dsm.cells import F32, surface_tile
from barpc.dsm.grid import Grid
from barpc.errors import BarpcError
from barpc.raster import open_raster
from barpc.report.page import can_render, remake_report
from barpc.report.tables import SURFACE, read_summary
from barpc.scene import View
from barpc.tie.pixels import jpeg
from barpc.workspace import TABLES, Workspace

logger = logging.getLogger(__name__)

_LIGHT = np.array([-0.5, 0.5, np.sqrt(0.5)])  # from the north-west, 45 degrees up


def show_in_report(folder: Path, grid: Grid, out: Path) -> None:
    """Add both reliefs to the report of a run; where that fails a line says why, and the surface stays."""
    try:
        text, name = json.dumps(_reliefs(folder, grid, out)), f"{TABLES}/{SURFACE}"
        with Workspace(folder, overwrite=True, names=[name], adds=True) as run:
            run.write_text(name, text)
        if can_render():
            remake_report(folder)
    except (BarpcError, OSError) as error:
        logger.warning("the report does not show the surface: %s", error)


def _reliefs(folder: Path, grid: Grid, out: Path) -> list[dict[str, object]]:
    """Return the reliefs, as `barpc.report.tables` reads them, of the tile that has most heights."""
    with open_raster(out) as file:
        found = []
        for at, groups in grid.tiles():
            bands = file.read([1, 3], window=Window(*at, *grid.tile(*at).size))
            found.append((np.isfinite(bands[0]).sum(), at, groups[0], bands))
    _, at, pairs, after = max(found, key=lambda row: row[0])
    views = _delivered(folder, grid.block.views)
    before = surface_tile([(views[i], views[j]) for i, j in pairs], grid.tile(*at), grid.options.band)
    return [
        _one("delivered", before[0], before[1], grid.step),
        _one("corrected", after[0], after[1], grid.step),
    ]


def _delivered(folder: Path, views: tuple[View, ...]) -> list[View]:
    """Return the views with the cameras that came with their images."""
    sources = {view.name: view.rpc_source for view in read_summary(folder).views}
    found = []
    for view in views:
        source = sources[view.name]
        if source is None:
            raise BarpcError(f"{view.name}: no file holds its delivered camera")
        found.append(replace(view, sensor=open_camera(view.path, camera=source.path).model))
    return found


def _one(cameras: str, height: F32, nmad: F32, step: float) -> dict[str, object]:
    known = np.isfinite(nmad)
    return {
        "cameras": cameras,
        "size": [height.shape[1], height.shape[0]],
        "share": float(np.isfinite(height).mean()),
        "nmad_m": float(np.median(nmad[known])) if known.any() else None,
        "picture": base64.b64encode(jpeg(shaded(height, step))).decode(),
    }


def shaded(height: F32, step: float) -> npt.NDArray[np.uint8]:
    """Return a relief (rows, cols) [m] in the light of the north-west, cells of `step` [m]; black where
    nothing is known.
    """
    by_row, by_col = np.gradient(height.astype(np.float64), step)
    normal = np.stack([-by_col, by_row, np.ones(height.shape)])  # rows count to the south
    light = np.einsum("i,ijk->jk", _LIGHT, normal / np.linalg.norm(normal, axis=0))
    grey: npt.NDArray[np.uint8] = np.nan_to_num(np.clip(light, 0.05, 1.0) * 255.0).astype(np.uint8)
    return grey
