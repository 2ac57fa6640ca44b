"""Cameras beyond an RPC: small GeoTIFFs of localisation and correction grids.

A localisation grid is laid out as CARS (shareloc) reads it: bands lon, lat of each layer, their altitudes in the tags
``ALTITUDE_Bn``, nodes where the geotransform puts the corners of the pixels. A correction grid holds dcol and drow;
its nodes are the centres of its pixels, as GDAL sees them, and its RPC tag is the RPC that they are added to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rasterio

from barpc.base.atomic import replacing
from barpc.base.errors import RpcError, RpcFormatError
from barpc.base.geodesy import MAX_COORDINATE, Array
from barpc.base.remote import PathOrUrl
from barpc.base.safe_io import BYTES_PER_NUMBER, Kind
from barpc.rasters.raster import open_raster
from barpc.rpcio.formats import SIGN
from barpc.rpcio.images import created, printable, put_tag, read_tag
from barpc.sensor.direct_grid import DirectGrid
from barpc.sensor.image_corrections import CorrectionGrid
from barpc.sensor.rpc import RPC

_GRID_PROFILE: dict[str, Any] = {"driver": "GTiff", "COMPRESS": "DEFLATE", "PREDICTOR": 3}
_SPACING_TOLERANCE = 1e-6  # of a step: how far nodes may be off
_GRID_KIND = Kind("a correction grid", 1 << 30, RpcFormatError)


def write_grid(grid: DirectGrid, path: Path | str, *, overwrite: bool = False) -> None:
    """Write a localisation grid, which `barpc.cameras.open_camera`, CARS and shareloc read.

    RpcError where its nodes are not evenly spaced.
    """
    origin, steps = _even(grid.cols, grid.rows)
    layers = np.moveaxis(grid.lonlat, -1, 1).reshape(-1, *grid.lonlat.shape[1:3])
    tags = {f"ALTITUDE_B{i}": repr(float(grid.alts[i // 2])) for i in range(len(layers))}
    with replacing(path, overwrite=overwrite) as partial:
        _write_bands(partial, layers, origin, steps, {"REF": "EPSG:4326", **tags})


def write_correction(grid: CorrectionGrid, rpc: RPC, path: Path | str, *, overwrite: bool = False) -> None:
    """Write the correction grid of the image points of `rpc`; RpcError where its nodes are not evenly spaced."""
    origin, steps = _even(grid.cols, grid.rows)
    layers = np.moveaxis(grid.shift, -1, 0).astype(np.float32)
    with replacing(path, overwrite=overwrite) as partial:
        _write_bands(partial, layers, origin - steps / 2, steps, {"CORRECTION": SIGN}, ("dcol", "drow"))
        put_tag(partial, printable(rpc))


def read_correction(path: PathOrUrl) -> tuple[RPC, CorrectionGrid]:
    """Read the RPC and the displacements of a correction grid; RpcFormatError where the file is none."""
    with open_raster(path) as dataset:
        _GRID_KIND.check(f"{path}, read", BYTES_PER_NUMBER * dataset.count * dataset.width * dataset.height)
        if dataset.count != 2 or dataset.tags().get("CORRECTION") != SIGN:
            raise RpcFormatError(f"{path}: no correction grid: it lacks the tag CORRECTION or its two bands")
        shift = np.moveaxis(np.real(dataset.read()), 0, -1).astype(np.float64)
        a, b, c, d, e, f = dataset.transform[:6]
        shape = dataset.shape
    rpc = read_tag(path)
    if rpc is None or b or d:
        raise RpcFormatError(f"{path}: a correction grid without its RPC, or one that is turned")
    with np.errstate(all="ignore"):
        cols = c + a * (np.arange(shape[1]) + 0.5) - 0.5
        rows = f + e * (np.arange(shape[0]) + 0.5) - 0.5
    if not all((np.abs(axis) <= MAX_COORDINATE).all() for axis in (cols, rows, shift)):
        raise RpcFormatError(f"{path}: a node of it is no image point, or has no displacement")
    try:
        return rpc, CorrectionGrid(cols, rows, shift)
    except RpcError as error:
        raise RpcFormatError(f"{path}: {error}") from error


def _even(cols: Array, rows: Array) -> tuple[Array, Array]:
    """Return the first node (2,), from the corner of the first pixel, and the steps (2,) [px] of an even grid."""
    steps = np.array([(axis[-1] - axis[0]) / (len(axis) - 1) for axis in (cols, rows)])
    for axis, step in zip((cols, rows), steps, strict=True):
        if np.abs(np.diff(axis) - step).max() > _SPACING_TOLERANCE * step:
            raise RpcError("a grid whose nodes are not evenly spaced is not written")
    return np.array([cols[0], rows[0]]) + 0.5, steps


def _write_bands(
    path: Path,
    layers: npt.NDArray[Any],
    origin: Array,
    steps: Array,
    tags: Mapping[str, str],
    names: Sequence[str] = (),
) -> None:
    profile = {**_GRID_PROFILE, "count": len(layers), "dtype": layers.dtype.name}
    # one strip a band: the places of many would push the tags out of the file's head, by which it is known
    profile |= {"height": layers.shape[1], "width": layers.shape[2], "blockysize": layers.shape[1]}
    profile["transform"] = rasterio.Affine(steps[0], 0.0, origin[0], 0.0, steps[1], origin[1])
    with created(path, profile) as dataset:
        dataset.update_tags(**tags)  # before the values: in front of them
        for band, name in enumerate(names, start=1):
            dataset.set_band_description(band, name)
        dataset.write(layers)
