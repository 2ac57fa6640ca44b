"""An image resampled so that its RPC holds without a rest, block by block.

By cubic B-splines: of the contrast at half the highest frequency 1.5 % is lost, and positions are not rounded (OpenCV's
`remap` knows 32 a pixel, which alone is as much as the result may be off by).
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import numpy.typing as npt
import rasterio
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning
from rasterio.windows import Window

from barpc.errors import ImageError
from barpc.geodesy import Array
from barpc.raster import BLOCK, open_raster
from barpc.rpcio.images import TIFF, copying, has_mask, unwritten
from barpc.rpcio.tiff import printable, put_tag
from barpc.scene import BoolArray
from barpc.sensor.correction_grid import CorrectionGrid
from barpc.sensor.rpc import RPC

Pixels = npt.NDArray[Any]

_MARGIN = 16  # px around a block: a spline has forgotten what is farther away to 1e-9
_MOST = 4096  # px a side of what a block is made of


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
        profile = {"width": dataset.width, "height": dataset.height, "count": dataset.count, **TIFF}
        profile |= {"dtype": dataset.dtypes[0], "nodata": dataset.nodata}
        profile |= {"blockxsize": BLOCK, "blockysize": BLOCK}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(partial, "w", **profile) as out:
                out.colorinterp = dataset.colorinterp
                sums = [_fill(dataset, out, block, correction) for _, block in out.block_windows(1)]
        _require_sums(partial, sums, Path(path))
        put_tag(partial, printable(rpc), placed=False)


def _fill(dataset: Any, out: Any, block: Window, correction: CorrectionGrid) -> int:
    """Write one block of all bands, and of the mask; a checksum of its pixels."""
    cols, rows = block.col_off + np.arange(block.width), block.row_off + np.arange(block.height)
    at = correction.apply(np.stack(np.meshgrid(cols, rows), axis=-1).astype(np.float64))
    frame = np.array([dataset.width, dataset.height])
    low = np.clip(np.floor(at.min(axis=(0, 1))).astype(int) - _MARGIN, 0, frame - 1)
    size = np.clip(np.ceil(at.max(axis=(0, 1))).astype(int) + _MARGIN + 1, low + 1, frame) - low
    if size.max() > _MOST:
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


def _require_sums(partial: Path, sums: list[int], target: Path) -> None:
    """Raise unless a file holds the blocks with these checksums: GDAL closes a file on a full disk without a word."""
    try:
        with open_raster(partial) as made:
            found = [crc32(made.read(window=block).tobytes()) for _, block in made.block_windows(1)]
    except ImageError as error:
        raise unwritten(target, "it cannot be read back") from error
    if found != sums:
        raise unwritten(target, "it holds other pixels than were written")


def _interpolated(pixels: Pixels, known: BoolArray, place: Array) -> Array:
    """Return the values of a block at places (2, H, W), row before col; unknown pixels take the value of the
    nearest known one.
    """
    from scipy.ndimage import distance_transform_edt, map_coordinates, spline_filter  # of no other output

    values = pixels.astype(np.float64)
    if not known.any():
        return np.zeros(place.shape[1:])
    if not known.all():
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        values = values[tuple(nearest)]
    coefficients = spline_filter(values, order=3, mode="mirror")
    found: Array = map_coordinates(coefficients, place, order=3, mode="mirror", prefilter=False)
    return found


def _stored(values: Array, shown: BoolArray, dtype: np.dtype[Any], nodata: float | None) -> Pixels:
    """Return the values in the type of the image: rounded and cut at its range, none of those shown equal to nodata."""
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        values = np.clip(np.rint(values), limits.min, limits.max)
        if nodata is not None:
            values[shown & (values == nodata)] += 1 if nodata < limits.max else -1
    out: Pixels = values.astype(dtype)
    if nodata is not None:
        out[~shown] = nodata
    return out
