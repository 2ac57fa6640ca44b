"""An RPC in a raster: a VRT that points at the untouched image, or a copy with the tag."""

from __future__ import annotations

import errno
import os
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from html import escape
from pathlib import Path
from typing import Any
from zlib import crc32

import rasterio
from rasterio._err import CPLE_BaseError
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.shutil import copy as raster_copy
from rasterio.windows import Window

from barpc.base.atomic import replacing, write_text
from barpc.base.errors import ImageError, OutputError
from barpc.base.remote import PathOrUrl
from barpc.base.safe_io import IMAGE, opened, plain_path
from barpc.rasters.raster import Mosaic, identify, open_raster
from barpc.rasters.vrt import GDAL_TYPES
from barpc.rpcio.carried import nitf_record, printable, put_tag, read_nitf
from barpc.rpcio.xml import rpc_domain
from barpc.sensor.rpc import RPC

TIFF_PROFILE = {"driver": "GTiff", "BIGTIFF": "IF_SAFER", "TILED": "YES", "COMPRESS": "DEFLATE"}
NITF_NAMES = (".ntf", ".nitf", ".nsf")
"""Ends of the names of NITF files, in any case."""
_FULL = 1 << 16  # bytes: with less free space GDAL's error is taken for that of a full disk


def write_rpc_vrt(
    rpc: RPC,
    image_path: Path | str,
    vrt_path: Path | str,
    *,
    relative: bool = True,
    overwrite: bool = False,
    place: Path | str | None = None,
) -> None:
    """Write a VRT with an RPC, and with its pixels from an untouched image.

    A geotransform without CRS (the origin of a crop in its full image) is left out: the RPC written here is
    the image's own. One with a CRS is kept. Every number of the RPC reads back to the bit.

    Parameters
    ----------
    rpc, image_path, vrt_path, overwrite : as of `write_rpc_copy`
    relative : bool, point at the image relative to the VRT, so that both may move; else by absolute path
    place : Path or str, optional, where the VRT will stand in the end, if not at `vrt_path`

    Raises
    ------
    ImageError, OutputError
        The image cannot be read; the VRT exists or cannot be written.
    """
    source, target = plain_source(image_path), Path(place or vrt_path).absolute()
    plain_path(source)
    plain_path(target)
    _refuse_same(source, target)
    name = os.path.relpath(source.resolve(), target.parent.resolve()) if relative else str(source)
    with open_raster(source) as dataset:
        width, height = dataset.width, dataset.height
        file = f'<SourceFilename relativeToVRT="{int(relative)}">{escape(name, quote=False)}</SourceFilename>'
        frame = f'xOff="0" yOff="0" xSize="{width}" ySize="{height}"'
        rects = f"<SrcRect {frame} /><DstRect {frame} />"
        lines = [f'<VRTDataset rasterXSize="{width}" rasterYSize="{height}">']
        if dataset.crs is not None:
            numbers = ", ".join(repr(v) for v in dataset.transform.to_gdal())
            lines.append(f"  <SRS>{escape(dataset.crs.to_wkt(), quote=False)}</SRS>")
            lines.append(f"  <GeoTransform>{numbers}</GeoTransform>")
        lines.append(rpc_domain(rpc))
        bands = zip(dataset.indexes, dataset.dtypes, dataset.nodatavals, dataset.colorinterp, strict=True)
        for index, dtype, nodata, color in bands:
            lines += [f'  <VRTRasterBand dataType="{GDAL_TYPES.get(dtype, dtype.capitalize())}" band="{index}">']
            lines += [] if nodata is None else [f"    <NoDataValue>{nodata!r}</NoDataValue>"]
            lines += [f"    <ColorInterp>{color.name.capitalize()}</ColorInterp>"]
            lines += [f"    <SimpleSource>{file}<SourceBand>{index}</SourceBand>{rects}</SimpleSource>"]
            lines += ["  </VRTRasterBand>"]
        if has_mask(dataset):
            mask = f"<SimpleSource>{file}<SourceBand>mask,1</SourceBand>{rects}</SimpleSource>"
            lines += [f'  <MaskBand><VRTRasterBand dataType="Byte">{mask}</VRTRasterBand></MaskBand>']
    write_text(vrt_path, "\n".join([*lines, "</VRTDataset>"]) + "\n", overwrite=overwrite)


def plain_source(image_path: Path | str) -> Path:
    """Return the file with an image's pixels: itself, or the source of a VRT written here (or ImageError)."""
    source, driver = identify(image_path)
    if not isinstance(source, Path):
        raise ImageError(
            f"{source}: a VRT points at files on disk only; have copies written, or no images (--images copy, none)"
        )
    if driver != "VRT":
        return source
    with open_raster(source) as mosaic:
        found: Path | None = mosaic.plain_source()
    if found is None:
        raise ImageError(
            f"{image_path}: a VRT that is more than one whole image is not pointed at; give the image that it is "
            "made of, or have copies written"
        )
    return found.resolve()


def has_mask(dataset: Any) -> bool:
    """Return whether a raster has a mask of its own, apart from an alpha band."""
    return MaskFlags.per_dataset in dataset.mask_flag_enums[0] and ColorInterp.alpha not in dataset.colorinterp


def write_rpc_copy(rpc: RPC, image_path: Path | str, copy_path: Path | str, *, overwrite: bool = False) -> None:
    """Write a GeoTIFF copy of an image that carries an RPC in its tag.

    A TIFF is copied byte by byte (pixels, compression, overviews and masks untouched, BigTIFF as well); any
    other raster is converted. A geotransform without CRS is left out, as in `write_rpc_vrt`. Offsets and
    scales of more digits than GDAL hands on are rounded and the coefficients make up for it (`printable`).

    Parameters
    ----------
    rpc : RPC, the camera of `image_path`
    image_path, copy_path : Path or str, the image, and the file to write
    overwrite : bool, replace an existing file, never the image itself

    Raises
    ------
    ImageError, OutputError
        The image cannot be read; the copy exists, is the image itself, or cannot be written.
    """
    with copying(image_path, copy_path, overwrite) as (dataset, partial):
        if not isinstance(dataset, Mosaic) and dataset.driver == "GTiff":
            with opened(image_path, IMAGE) as file, partial.open("wb") as copy:
                shutil.copyfileobj(file, copy)
        else:
            _translate(dataset, partial, Path(copy_path), **TIFF_PROFILE)
        put_tag(partial, printable(rpc), placed=dataset.crs is not None)


def write_rpc_nitf(rpc: RPC, image_path: Path | str, nitf_path: Path | str, *, overwrite: bool = False) -> None:
    """Write a NITF copy of an image with an RPC in its RPC00B extension (content: `nitf_record`)."""
    record = nitf_record(rpc)
    with copying(image_path, nitf_path, overwrite) as (dataset, partial):
        _translate(dataset, partial, Path(nitf_path), driver="NITF", TRE=f"RPC00B={record}")


def write_crop(
    rpc: RPC,
    image_path: Path | str,
    crop_path: Path | str,
    window: tuple[int, int, int, int],
    *,
    overwrite: bool = False,
) -> RPC:
    """Cut a window out of an image, pixels and RPC: exact, no refit.

    Parameters
    ----------
    rpc : RPC, the camera of `image_path`
    image_path, crop_path : Path or str, the image, and the file to write: a NITF by its name (`NITF_NAMES`), else a
        tiled GeoTIFF
    window : (col, row, width, height), whole pixels, inside the image
    overwrite : bool, replace an existing file, never the image itself

    Returns
    -------
    rpc : RPC, the crop's camera, as it stands in the file

    Raises
    ------
    ImageError, OutputError, RpcFormatError
        The window is not inside the image, or that cannot be read; the crop exists or cannot be written; a NITF does
        not hold its RPC.
    """
    col, row, width, height = window
    cropped, nitf = rpc.crop(col, row), Path(crop_path).name.lower().endswith(NITF_NAMES)
    layout = {"driver": "NITF", "TRE": f"RPC00B={nitf_record(cropped)}"} if nitf else TIFF_PROFILE
    with copying(image_path, crop_path, overwrite) as (dataset, partial):
        if not (0 <= col < col + width <= dataset.width and 0 <= row < row + height <= dataset.height):
            raise ImageError(
                f"{image_path}: window {window} is not inside the image of {dataset.width} x {dataset.height}"
            )
        _copy_window(dataset, partial, Path(crop_path), Window(col, row, width, height), **layout)
        if nitf:
            return read_nitf(partial) or cropped
        put_tag(partial, printable(cropped), placed=dataset.crs is not None)
    return printable(cropped)


@contextmanager
def copying(image_path: Path | str, target: Path | str, overwrite: bool) -> Iterator[tuple[Any, Path]]:
    """Yield an image and the temporary file of its copy; GDAL's errors when it cannot write become one error."""
    source, _ = identify(image_path)
    target = Path(target).absolute()
    _refuse_same(source, target)
    with open_raster(source) as dataset, replacing(target, overwrite=overwrite) as partial:
        try:
            yield dataset, partial
        except (RasterioError, CPLE_BaseError) as error:
            raise unwritten(target, str(error.__cause__ or error)) from error


def _translate(dataset: Any, partial: Path, target: Path, **options: str) -> None:
    """Copy an image by another driver; a VRT's pixels are GDAL's only when they stand in a file."""
    whole = Window(0, 0, dataset.width, dataset.height)
    if isinstance(dataset, Mosaic):
        _copy_window(dataset, partial, target, whole, **options)
    else:
        raster_copy(dataset, str(partial), **options)
        require_pixels(partial, target, lambda block: _sum(dataset, block))


def _copy_window(dataset: Any, partial: Path, target: Path, window: Window, **options: str) -> None:
    profile = {"width": window.width, "height": window.height, "count": dataset.count, **options}
    profile |= {"dtype": dataset.dtypes[0], "nodata": dataset.nodata}
    if dataset.crs is not None and options["driver"] == "GTiff":  # a NITF's corners are rounded, and north-up for some
        a, b, x, d, e, y = dataset.transform[:6]
        col, row = window.col_off, window.row_off
        moved = rasterio.Affine(a, b, x + a * col + b * row, d, e, y + d * col + e * row)
        profile |= {"crs": dataset.crs, "transform": moved}

    def part(block: Window) -> Window:
        return Window(window.col_off + block.col_off, window.row_off + block.row_off, block.width, block.height)

    with created(partial, profile) as crop:
        crop.colorinterp = dataset.colorinterp
        for _, block in crop.block_windows(1):
            crop.write(dataset.read(window=part(block)), window=block)
            if has_mask(dataset) and options["driver"] == "GTiff":
                crop.write_mask(dataset.read_masks(1, window=part(block)), window=block)
    require_pixels(partial, target, lambda block: _sum(dataset, part(block)))


@contextmanager
def created(path: Path, profile: Mapping[str, Any]) -> Iterator[Any]:
    """Yield a new raster, for writing; a mask becomes part of it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "w", **profile) as dataset:
            yield dataset


def _sum(dataset: Any, window: Window) -> int:
    return crc32(dataset.read(window=window).tobytes())


def require_pixels(partial: Path, target: Path, sums: Callable[[Window], int]) -> None:
    """Raise unless the blocks of a file have these checksums: GDAL closes a file on a full disk without a word."""
    try:
        with open_raster(partial) as made:
            same = all(_sum(made, block) == sums(block) for _, block in made.block_windows(1))
    except ImageError as error:
        raise unwritten(target, "it cannot be read back") from error
    if not same:
        raise unwritten(target, "it holds other pixels than were written")


def unwritten(target: Path, reason: str) -> OutputError:
    """Return the error of a file that differs from the written content; GDAL does not say that a disk is full."""
    full = shutil.disk_usage(target.parent).free < _FULL
    return OutputError(f"{target}: cannot be written ({os.strerror(errno.ENOSPC) if full else reason})")


def _refuse_same(source: PathOrUrl, target: Path) -> None:
    if isinstance(source, Path) and target.exists() and target.resolve() == source.resolve():
        raise OutputError(f"{target}: is the input image, which is never written to; choose another name")
