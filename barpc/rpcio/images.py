"""An RPC in a raster: a VRT that points at the untouched image, or a copy with the tag."""

from __future__ import annotations

import errno
import os
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import rasterio
from rasterio._err import CPLE_BaseError
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.shutil import copy as raster_copy
from rasterio.windows import Window

from barpc.atomic import replacing, write_text
from barpc.errors import ImageError, OutputError
from barpc.mosaic import Mosaic
from barpc.plain import plain_path
from barpc.raster import identify, open_raster
from barpc.rpcio.digits import printable
from barpc.rpcio.fixed import nitf_record
from barpc.rpcio.tiff import GEOREFERENCE_TAGS, put_tag
from barpc.rpcio.xml import rpc_domain
from barpc.sensor.rpc import RPC
from barpc.vrt import GDAL_TYPES

_TIFF = {"driver": "GTiff", "BIGTIFF": "IF_SAFER", "TILED": "YES", "COMPRESS": "DEFLATE"}
_FULL = 1 << 16  # bytes: with less free space GDAL's error is taken for that of a full disk


def write_rpc_vrt(
    rpc: RPC, image_path: Path | str, vrt_path: Path | str, *, relative: bool = True, overwrite: bool = False
) -> None:
    """Write a VRT that carries an RPC and takes its pixels from an image that stays as it is.

    A geotransform without CRS (the origin of a crop in its full image) is left out: the RPC written here is
    the image's own. One with a CRS is kept.

    Parameters
    ----------
    rpc : RPC
        The camera of `image_path`, every number written with the digits that read back to the bit.
    image_path, vrt_path : Path or str
        The image, and the file to write.
    relative : bool
        Point at the image relative to the VRT, so that both may move together; else by absolute path.
    overwrite : bool
        Replace an existing VRT.

    Raises
    ------
    ImageError
        The image cannot be read.
    OutputError
        The VRT exists or cannot be written.
    """
    write_text(vrt_path, rpc_vrt(rpc, image_path, vrt_path, relative=relative), overwrite=overwrite)


def rpc_vrt(rpc: RPC, image_path: Path | str, vrt_path: Path | str, *, relative: bool = True) -> str:
    """The text that `write_rpc_vrt` writes."""
    source = plain_path(plain_source(image_path))
    target = plain_path(Path(vrt_path).absolute())
    _refuse_same(source, target)
    name = os.path.relpath(source.resolve(), target.parent.resolve()) if relative else str(source)
    with open_raster(source) as dataset:
        return _vrt(dataset, rpc, name, relative)


def plain_source(image_path: Path | str) -> Path:
    """The file that holds an image's pixels: itself, or what a VRT written here points at.

    Raises
    ------
    ImageError
        The image cannot be read, or is a VRT that shows more, or less, than one whole image as it is.
    """
    source, driver = identify(image_path)
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


def _vrt(dataset: Any, rpc: RPC, source: str, relative: bool) -> str:
    width, height = dataset.width, dataset.height
    lines = [f'<VRTDataset rasterXSize="{width}" rasterYSize="{height}">']
    if dataset.crs is not None:
        numbers = ", ".join(repr(v) for v in dataset.transform.to_gdal())
        lines += [f"  <SRS>{escape(dataset.crs.to_wkt())}</SRS>", f"  <GeoTransform>{numbers}</GeoTransform>"]
    lines.append(rpc_domain(rpc))
    frame = f'xOff="0" yOff="0" xSize="{width}" ySize="{height}"'
    for index in dataset.indexes:
        kind = GDAL_TYPES.get(dataset.dtypes[index - 1], dataset.dtypes[index - 1].capitalize())
        lines.append(f'  <VRTRasterBand dataType="{kind}" band="{index}">')
        if (nodata := dataset.nodatavals[index - 1]) is not None:
            lines.append(f"    <NoDataValue>{nodata!r}</NoDataValue>")
        lines += [
            f"    <ColorInterp>{dataset.colorinterp[index - 1].name.capitalize()}</ColorInterp>",
            "    <SimpleSource>",
            f'      <SourceFilename relativeToVRT="{int(relative)}">{escape(source)}</SourceFilename>',
            f"      <SourceBand>{index}</SourceBand>",
            f"      <SrcRect {frame} />",
            f"      <DstRect {frame} />",
            "    </SimpleSource>",
            "  </VRTRasterBand>",
        ]
    if MaskFlags.per_dataset in dataset.mask_flag_enums[0] and not _has_alpha(dataset):
        lines += [
            "  <MaskBand>",
            '    <VRTRasterBand dataType="Byte">',
            "      <SimpleSource>",
            f'        <SourceFilename relativeToVRT="{int(relative)}">{escape(source)}</SourceFilename>',
            "        <SourceBand>mask,1</SourceBand>",
            f"        <SrcRect {frame} />",
            f"        <DstRect {frame} />",
            "      </SimpleSource>",
            "    </VRTRasterBand>",
            "  </MaskBand>",
        ]
    return "\n".join([*lines, "</VRTDataset>"]) + "\n"


def _has_alpha(dataset: Any) -> bool:
    return ColorInterp.alpha in dataset.colorinterp


def write_rpc_copy(
    rpc: RPC, image_path: Path | str, copy_path: Path | str, *, overwrite: bool = False
) -> None:
    """Write a GeoTIFF copy of an image that carries an RPC in its tag.

    A TIFF is copied byte by byte (pixels, compression, overviews and masks untouched, BigTIFF as well); any
    other raster is converted. A geotransform without CRS is left out, as in `write_rpc_vrt`. Offsets and
    scales of more digits than GDAL hands on are rounded and the coefficients make up for it (`printable`).

    Parameters
    ----------
    rpc : RPC
        The camera of `image_path`.
    image_path, copy_path : Path or str
        The image, and the file to write.
    overwrite : bool
        Replace an existing file, never the image itself.

    Raises
    ------
    ImageError
        The image cannot be read.
    OutputError
        The copy exists, is the image itself, or cannot be written.
    """
    source, driver = identify(image_path)
    target = Path(copy_path).absolute()
    _refuse_same(source, target)
    with _copying(source) as dataset:
        drop = () if dataset.crs is not None else GEOREFERENCE_TAGS
        with replacing(target, overwrite=overwrite) as partial:
            if driver == "GTiff":
                shutil.copyfile(source, partial)
            else:
                with _gdal_writes(target):
                    _convert(dataset, partial, **_TIFF)
                _require_same(dataset, Window(0, 0, dataset.width, dataset.height), partial, target)
            put_tag(partial, printable(rpc), drop)


@contextmanager
def _copying(source: Path) -> Iterator[Any]:
    """An open raster whose copies leave no ``.aux.xml`` behind under a temporary name."""
    with open_raster(source) as dataset, rasterio.Env(GDAL_PAM_ENABLED="NO"):
        yield dataset


def _convert(dataset: Any, target: Path, **options: str) -> None:
    """A copy by another driver; a VRT's pixels are GDAL's only when they stand in a file."""
    if isinstance(dataset, Mosaic):
        _copy_window(dataset, target, Window(0, 0, dataset.width, dataset.height), **options)
    else:
        raster_copy(dataset, str(target), **options)


def write_rpc_nitf(
    rpc: RPC, image_path: Path | str, nitf_path: Path | str, *, overwrite: bool = False
) -> None:
    """Write a NITF copy of an image with an RPC in its RPC00B extension (`nitf_record` says what it holds)."""
    source, _ = identify(image_path)
    target = Path(nitf_path).absolute()
    _refuse_same(source, target)
    record = nitf_record(rpc)
    with _copying(source) as dataset, replacing(target, overwrite=overwrite) as partial:
        with _gdal_writes(target):
            _convert(dataset, partial, driver="NITF", TRE=f"RPC00B={record}")
        _require_same(dataset, Window(0, 0, dataset.width, dataset.height), partial, target)


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
    rpc : RPC
        The camera of `image_path`.
    image_path, crop_path : Path or str
        The image, and the tiled GeoTIFF to write.
    window : (col, row, width, height)
        Whole pixels, inside the image.
    overwrite : bool
        Replace an existing file, never the image itself.

    Returns
    -------
    rpc : RPC
        The crop's camera, as it stands in the file.

    Raises
    ------
    ImageError
        The window does not lie inside the image, or the image cannot be read.
    OutputError
        The crop exists, is the image itself, or cannot be written.
    """
    source, _ = identify(image_path)
    target = Path(crop_path).absolute()
    _refuse_same(source, target)
    col, row, width, height = window
    cropped = printable(rpc.crop(col, row))
    with open_raster(source) as dataset:
        if not (0 <= col < col + width <= dataset.width and 0 <= row < row + height <= dataset.height):
            raise ImageError(
                f"{image_path}: window {window} is not inside the image of {dataset.width} x {dataset.height}"
            )
        with replacing(target, overwrite=overwrite) as partial:
            with _gdal_writes(target):
                _copy_window(dataset, partial, Window(col, row, width, height), **_TIFF)
            _require_same(dataset, Window(col, row, width, height), partial, target)
            put_tag(partial, cropped, () if dataset.crs is not None else GEOREFERENCE_TAGS)
    return cropped


def _copy_window(dataset: Any, target: Path, window: Window, **options: str) -> None:
    profile = {
        "width": window.width,
        "height": window.height,
        "count": dataset.count,
        "dtype": dataset.dtypes[0],
        "nodata": dataset.nodata,
        **options,
    }
    if dataset.crs is not None:
        a, b, x, d, e, y = dataset.transform[:6]
        col, row = window.col_off, window.row_off
        moved = rasterio.Affine(a, b, x + a * col + b * row, d, e, y + d * col + e * row)
        profile |= {"crs": dataset.crs, "transform": moved}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        masked = MaskFlags.per_dataset in dataset.mask_flag_enums[0] and not _has_alpha(dataset)
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(target, "w", **profile) as crop:
            crop.colorinterp = dataset.colorinterp
            for _, block in crop.block_windows(1):
                part = Window(
                    window.col_off + block.col_off, window.row_off + block.row_off, block.width, block.height
                )
                crop.write(dataset.read(window=part), window=block)
                if masked and options["driver"] == "GTiff":
                    crop.write_mask(dataset.read_masks(1, window=part), window=block)


@contextmanager
def _gdal_writes(target: Path) -> Iterator[None]:
    """What GDAL says when it cannot write, which it does not always, as one error."""
    try:
        yield
    except (RasterioError, CPLE_BaseError) as error:
        raise _unwritten(target, str(error.__cause__ or error)) from error


def _require_same(dataset: Any, window: Window, partial: Path, target: Path) -> None:
    """Raise unless a copy holds the pixels of a window: GDAL closes a file on a full disk without a word."""
    try:
        with open_raster(partial) as copy:
            for _, block in copy.block_windows(1):
                place = Window(
                    window.col_off + block.col_off, window.row_off + block.row_off, block.width, block.height
                )
                if dataset.read(window=place).tobytes() != copy.read(window=block).tobytes():
                    raise _unwritten(target, "it holds other pixels than were written")
    except ImageError as error:
        raise _unwritten(target, "it cannot be read back") from error


def _unwritten(target: Path, reason: str) -> OutputError:
    full = shutil.disk_usage(target.parent).free < _FULL
    return OutputError(f"{target}: cannot be written ({os.strerror(errno.ENOSPC) if full else reason})")


def _refuse_same(source: Path, target: Path) -> None:
    if target.exists() and target.resolve() == source.resolve():
        raise OutputError(f"{target}: is the input image, which is never written to; choose another name")
