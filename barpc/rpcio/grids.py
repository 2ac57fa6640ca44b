"""Cameras beyond an RPC: small GeoTIFFs of localisation and correction grids, and resampled images.

A localisation grid is laid out as CARS (shareloc) reads it: bands lon, lat of each layer, their altitudes in the tags
``ALTITUDE_Bn``, nodes where the geotransform puts the corners of the pixels. A correction grid holds dcol and drow;
its nodes are the centres of its pixels, as GDAL sees them, and its RPC tag is the RPC that they are added to.

An image is resampled block by block, so that its RPC holds without a rest, by cubic B-splines: of the contrast at half
the highest frequency 1.5 % is lost, and positions are not rounded (OpenCV's `remap` knows 32 a pixel, which alone is as
much as the error allowed).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import numpy.typing as npt
import rasterio
from rasterio.enums import ColorInterp
from rasterio.windows import Window

from barpc.base.atomic import replacing
from barpc.base.errors import ImageError, RpcError, RpcFormatError
from barpc.base.geodesy import MAX_COORDINATE, Array
from barpc.base.remote import PathOrUrl
from barpc.base.safe_io import BYTES_PER_NUMBER, Kind
from barpc.rasters.raster import BLOCK_SIZE, PixelArray, has_mask, open_raster
from barpc.rpcio.formats import SIGN
from barpc.rpcio.images import TIFF_PROFILE, copying, created, printable, put_tag, read_tag, require_pixels
from barpc.scene import BoolArray
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


# --- images -----------------------------------------------------------------------------------------------

_SPLINE_MARGIN = 16  # px around a block: a spline has forgotten what is farther away to 1e-9
_MAX_BLOCK_SIDE = 4096  # px a side of what a block is made of


def write_resampled(
    rpc: RPC, correction: CorrectionGrid, image_path: Path | str, path: Path | str, *, overwrite: bool = False
) -> None:
    """Write an image as the camera `rpc` would have seen it, with that RPC in its tag; tiled GeoTIFF, same type.

    Memory does not grow with the image. What is not known (nodata, mask, beyond the border) stays so; without
    a word for it the border is continued. No known pixel becomes nodata.

    Parameters
    ----------
    rpc, correction : what is true of `image_path`: its image points are those of `rpc` and the correction
    image_path, path : the image, and the file to write
    overwrite : bool, replace an existing file, never the image itself

    Raises
    ------
    ImageError, OutputError
        The image cannot be read, or is complex; the file exists or cannot be written.
    """
    with copying(image_path, path, overwrite) as (dataset, partial):
        if any(np.dtype(kind).kind == "c" for kind in dataset.dtypes):
            raise ImageError(f"{image_path}: complex pixels are not resampled; give the amplitude as an image")
        profile = {"width": dataset.width, "height": dataset.height, "count": dataset.count, **TIFF_PROFILE}
        profile |= {"dtype": dataset.dtypes[0], "nodata": dataset.nodata}
        profile |= {"blockxsize": BLOCK_SIZE, "blockysize": BLOCK_SIZE}
        with created(partial, profile) as out:
            out.colorinterp = dataset.colorinterp
            blocks = [block for _, block in out.block_windows(1)]
            sums = {
                (block.col_off, block.row_off): _resample_block(dataset, out, block, correction) for block in blocks
            }
        require_pixels(partial, Path(path), lambda block: sums[block.col_off, block.row_off])
        put_tag(partial, printable(rpc), placed=False)


def _resample_block(dataset: Any, out: Any, block: Window, correction: CorrectionGrid) -> int:
    """Write one block of all bands, and of the mask; a checksum of its pixels."""
    cols, rows = block.col_off + np.arange(block.width), block.row_off + np.arange(block.height)
    at = correction.apply(np.stack(np.meshgrid(cols, rows), axis=-1).astype(np.float64))
    frame = np.array([dataset.width, dataset.height])
    low = np.clip(np.floor(at.min(axis=(0, 1))).astype(int) - _SPLINE_MARGIN, 0, frame - 1)
    size = np.clip(np.ceil(at.max(axis=(0, 1))).astype(int) + _SPLINE_MARGIN + 1, low + 1, frame) - low
    if size.max() > _MAX_BLOCK_SIDE:
        raise ImageError(f"{dataset.name}: a correction that spreads a block over {size.max()} px is none")
    source, place = Window(*low, *size), np.clip(at - low, 0, size - 1)[..., ::-1]
    nearest = tuple(np.moveaxis(np.rint(place).astype(int), -1, 0))
    inside = ((at >= -0.5) & (at < frame - 0.5)).all(axis=-1)
    made, shown = [], inside
    for band in dataset.indexes:
        pixels, known = dataset.read(band, window=source), dataset.read_masks(band, window=source) != 0
        if dataset.colorinterp[band - 1] == ColorInterp.alpha:
            made.append(np.where(inside, pixels[nearest], 0).astype(pixels.dtype))
            continue
        known &= np.isfinite(pixels)
        shown = known[nearest] & inside
        values = _interpolated(pixels, known, np.moveaxis(place, -1, 0))
        if pixels.dtype.kind == "f":
            values[~known[nearest]] = np.nan
        made.append(_stored(values, shown, pixels.dtype, dataset.nodatavals[band - 1]))
    whole = np.stack(made)
    out.write(whole, window=block)
    if has_mask(dataset):
        out.write_mask(np.where(shown, 255, 0).astype(np.uint8), window=block)
    return crc32(whole.tobytes())


def _interpolated(pixels: PixelArray, known: BoolArray, place: Array) -> Array:
    """Return a block's values at places (2, H, W), row before col; unknown pixels are as the nearest known one."""
    from scipy.ndimage import distance_transform_edt, map_coordinates, spline_filter  # of no other output

    values = pixels.astype(np.float64)
    if not known.any():
        return np.zeros(place.shape[1:])
    if not known.all():
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        values = values[tuple(nearest)]
    coefficients = spline_filter(values, order=3, mode="mirror")
    return map_coordinates(coefficients, place, order=3, mode="mirror", prefilter=False)


def _stored(values: Array, shown: BoolArray, dtype: np.dtype[Any], nodata: float | None) -> PixelArray:
    """Return the values in the type of the image: rounded and cut at its range, none of those shown equal to nodata."""
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        values = np.clip(np.rint(values), limits.min, limits.max)
        if nodata is not None:
            values[shown & (values == nodata)] += 1 if nodata < limits.max else -1
    out: PixelArray = values.astype(dtype)
    if nodata is not None:
        out[~shown] = nodata
    return out
