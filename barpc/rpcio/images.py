"""RPCs that rasters carry: a VRT that points at the untouched image, a GeoTIFF's tag (50844); a NITF's RPC00B is read.

Any other raster's is what GDAL shows of it (`read_domain`).

The tag is read from the file's directory itself, to the bit: GDAL prints its numbers with 15 digits on the way. A copy
is made of the source's bytes; only its first directory is written anew, behind the pixels, so that compression, tiles,
overviews and masks stay as they are, in TIFF and BigTIFF alike.
"""

from __future__ import annotations

import errno
import math
import os
import re
import shutil
import struct
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO
from zlib import crc32

import numpy as np
import rasterio
from rasterio._err import CPLE_BaseError
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.shutil import copy as raster_copy
from rasterio.windows import Window

from barpc.base.atomic import replacing, write_text
from barpc.base.errors import ImageError, OutputError, RpcFormatError, plain
from barpc.base.geodesy import Array
from barpc.base.remote import PathOrUrl
from barpc.base.safe_io import IMAGE, opened, plain_path, read_head
from barpc.rasters.raster import earth_crs, has_mask, identify, open_raster, transformed, vrt_of
from barpc.rasters.vrt import Named, Source, vrt_text
from barpc.rpcio.text import (
    COEFFICIENTS,
    SINGLE,
    WIDTHS,
    ReadOptions,
    cells_of,
    fields_from_rpc,
    fields_in_order,
    rpc_from_fields,
)
from barpc.rpcio.xml import rpc_from_domain, rpc_items
from barpc.sensor.rational import DERIVATIVE, POWERS
from barpc.sensor.rpc import RPC

TIFF_PROFILE = {"driver": "GTiff", "BIGTIFF": "IF_SAFER", "TILED": "YES", "COMPRESS": "DEFLATE"}
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
    image, target = local_image(image_path), Path(place or vrt_path).absolute()
    plain_path(target)
    _refuse_same(image, target)
    with open_raster(image) as dataset:
        shown = vrt_of(dataset, image)
        for file in {source.file for source in shown.sources}:
            plain_path(file)
            _refuse_same(file, target)
        placed = shown.transform if shown.srs else None
        shown = replace(shown, transform=placed, metadata={"RPC": rpc_items(rpc)}, gcps=())
        folder = target.parent.resolve()

        def named(source: Source) -> Named:
            file = source.file
            return Named(os.path.relpath(file.resolve(), folder) if relative else str(file), relative)

        write_text(vrt_path, vrt_text(shown, named), overwrite=overwrite)


def local_image(image_path: Path | str) -> Path:
    """Return the file of an image that a VRT can point at (or ImageError)."""
    image, _ = identify(image_path)
    if not isinstance(image, Path):
        raise ImageError(
            f"{image}: a VRT points at files on disk only; have copies written, or no images (--images copy, none)"
        )
    return image


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
        if dataset.driver == "GTiff":
            with opened(image_path, IMAGE) as file, partial.open("wb") as copy:
                shutil.copyfileobj(file, copy)
        else:
            raster_copy(dataset, str(partial), **TIFF_PROFILE)
            require_pixels(partial, Path(copy_path), lambda block: _sum(dataset, block))
        put_tag(partial, printable(rpc), placed=earth_crs(dataset) is not None)


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
    image_path, crop_path : Path or str, the image, and the file to write, a tiled GeoTIFF
    window : (col, row, width, height), whole pixels, inside the image
    overwrite : bool, replace an existing file, never the image itself

    Returns
    -------
    rpc : RPC, the crop's camera, as it stands in the file

    Raises
    ------
    ImageError, OutputError
        The window is not inside the image, or that cannot be read; the crop exists or cannot be written.
    """
    col, row, width, height = window
    cropped = printable(rpc.crop(col, row))
    with copying(image_path, crop_path, overwrite) as (dataset, partial):
        if not (0 <= col < col + width <= dataset.width and 0 <= row < row + height <= dataset.height):
            raise ImageError(
                f"{image_path}: window {window} is not inside the image of {dataset.width} x {dataset.height}"
            )
        _copy_window(dataset, partial, Path(crop_path), Window(col, row, width, height))
        put_tag(partial, cropped, placed=earth_crs(dataset) is not None)
    return cropped


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


def _copy_window(dataset: Any, partial: Path, target: Path, window: Window) -> None:
    profile = {"width": window.width, "height": window.height, "count": dataset.count, **TIFF_PROFILE}
    profile |= {"dtype": dataset.dtypes[0], "nodata": dataset.nodata}
    if (crs := earth_crs(dataset)) is not None:
        a, b, _, d, e, _ = dataset.transform[:6]
        x, y = transformed(dataset.transform, window.col_off, window.row_off)
        moved = rasterio.Affine(a, b, x, d, e, y)
        profile |= {"crs": crs, "transform": moved}

    def part(block: Window) -> Window:
        return Window(window.col_off + block.col_off, window.row_off + block.row_off, block.width, block.height)

    with created(partial, profile) as crop:
        crop.colorinterp = dataset.colorinterp
        for _, block in crop.block_windows(1):
            crop.write(dataset.read(window=part(block)), window=block)
            if has_mask(dataset):
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


# --- the tag of a TIFF, and NITF ------------------------------------------------------------------------


RPC_TAG = 50844
_GEOREFERENCE_TAGS = (33550, 33922, 34264)  # ModelPixelScale, ModelTiepoint, ModelTransformation

# Of a type [bytes].
_TIFF_TYPE_BYTES = dict(enumerate((1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8, 4), 1)) | {16: 8, 17: 8, 18: 8}
_DOUBLE = 12
_MAX_ENTRIES = 4096
SCANNED = 1 << 24
"""Bytes of a file that are looked at: for an extension, for a date, or as the values of a tag."""


@dataclass(frozen=True)
class Entry:
    """One entry of a TIFF directory: tag, type, count, and the raw bytes of its value or offset."""

    tag: int
    kind: int
    count: int
    value: bytes


@dataclass(frozen=True)
class Directory:
    """The first directory of a TIFF file with its byte order and layout."""

    order: str  # struct's "<" or ">"
    big: bool
    entries: tuple[Entry, ...]
    following: bytes  # offset of the next directory, as it stands in the file

    def find(self, tag: int) -> Entry | None:
        """Return the entry of a tag, or None."""
        return next((entry for entry in self.entries if entry.tag == tag), None)

    @property
    def formats(self) -> tuple[str, str, str]:
        """Formats of an offset, of the number of entries and of an entry, for struct."""
        offset, count, entry = ("Q", "Q", "HHQ8s") if self.big else ("I", "H", "HHI4s")
        return self.order + offset, self.order + count, self.order + entry


def read_directory(file: BinaryIO, name: str) -> Directory:
    """Read the first directory of an open TIFF file; RpcFormatError where it ends too early or makes no sense."""
    try:
        head = file.read(16)
        found = Directory("<" if head[:2] == b"II" else ">", head[2:4] in (b"+\0", b"\0+"), (), b"")
        offset, number, layout = found.formats
        (start,) = struct.unpack(offset, head[8:16] if found.big else head[4:8])
        file.seek(start)
        (count,) = struct.unpack(number, file.read(struct.calcsize(number)))
        if not 0 < count <= _MAX_ENTRIES:
            raise RpcFormatError(f"{name}: a TIFF directory of {count} entries")
        block = file.read(struct.calcsize(layout) * count)
        entries = tuple(Entry(*values) for values in struct.iter_unpack(layout, block))
        following = file.read(struct.calcsize(offset))
        if len(following) != struct.calcsize(offset):
            raise RpcFormatError(f"{name}: the TIFF directory is cut off")
    except (struct.error, OverflowError, OSError) as error:
        raise RpcFormatError(f"{name}: not a TIFF file that can be read ({plain(error)})") from error
    return replace(found, entries=entries, following=following)


def read_values(file: BinaryIO, directory: Directory, entry: Entry, name: str) -> bytes:
    """Read the bytes of an entry's values, wherever they stand."""
    size = _TIFF_TYPE_BYTES.get(entry.kind, 1) * entry.count
    if size > SCANNED:
        raise RpcFormatError(f"{name}: TIFF tag {entry.tag} claims {size} bytes")
    if size <= len(entry.value):
        return entry.value[:size]
    (offset,) = struct.unpack(directory.formats[0], entry.value)
    try:
        file.seek(offset)
        data = file.read(size)
    except (OverflowError, OSError) as error:
        raise RpcFormatError(f"{name}: TIFF tag {entry.tag} points nowhere ({plain(error)})") from error
    if len(data) != size:
        raise RpcFormatError(f"{name}: TIFF tag {entry.tag} lies beyond the end of the file")
    return data


def read_tag(path: PathOrUrl) -> RPC | None:
    """Read the RPC in a TIFF's tag, None without one; RpcFormatError where it does not hold 92 usable doubles."""
    with opened(path, IMAGE) as file:
        directory = read_directory(file, str(path))
        entry = directory.find(RPC_TAG)
        if entry is None:
            return None
        if entry.kind != _DOUBLE or entry.count != 92:
            raise RpcFormatError(
                f"{path}: the RPC tag has {entry.count} values of type {entry.kind}, expected 92 doubles"
            )
        values = struct.unpack(f"{directory.order}92d", read_values(file, directory, entry, str(path)))
    if not all(math.isfinite(value) for value in values[2:]):
        raise RpcFormatError(f"{path}: the RPC tag holds a number that is not finite")
    return rpc_from_fields(fields_in_order(values, SINGLE), f"{path} (RPC tag)")


def tag_values(rpc: RPC) -> list[float]:
    """Return the 92 doubles of the tag; an unknown accuracy is -1."""
    fields = fields_from_rpc(rpc)
    return [value for key in SINGLE + COEFFICIENTS for value in fields.get(key, [-1.0])]


def put_tag(path: Path, rpc: RPC, placed: bool = True) -> None:
    """Put an RPC tag into a TIFF, in place: for a fresh copy only, never for somebody's image.

    A new directory, with its geotransform if `placed`, is written behind the end; ImageError if only BigTIFF holds it.
    """
    with opened(path, IMAGE) as file:
        directory = read_directory(file, str(path))
    size = path.stat().st_size
    start = size + -size % 16
    if not directory.big and start + (1 << 16) > 0xFFFFFFFF:
        raise ImageError(f"{path}: a tag does not fit behind {size} bytes of classic TIFF; convert it to BigTIFF")
    offset, number, layout = directory.formats
    values = struct.pack(f"{directory.order}92d", *tag_values(rpc))
    drop = {RPC_TAG} if placed else {RPC_TAG, *_GEOREFERENCE_TAGS}
    entries = [e for e in directory.entries if e.tag not in drop]
    entries.append(Entry(RPC_TAG, _DOUBLE, 92, struct.pack(offset, start)))
    table = struct.pack(number, len(entries))
    for entry in sorted(entries, key=lambda e: e.tag):
        table += struct.pack(layout, entry.tag, entry.kind, entry.count, entry.value)
    with path.open("r+b") as file:
        file.seek(start)
        file.write(values + table + directory.following)
        _unmark_cog(file)
        file.seek(8 if directory.big else 4)
        file.write(struct.pack(offset, start + len(values)))


def _unmark_cog(file: BinaryIO) -> None:
    """Say in a cloud-optimised GeoTIFF's header, which has a line for it, that its directory is no longer in front."""
    file.seek(0)
    position = file.read(1024).find(b"KNOWN_INCOMPATIBLE_EDITION=NO\n ")
    if position >= 0:
        file.seek(position)
        file.write(b"KNOWN_INCOMPATIBLE_EDITION=YES\n")


def _fifteen(values: Array) -> Array:
    return np.array([float(f"{value:.15g}") for value in values.tolist()])


def printable(rpc: RPC) -> RPC:
    """Return the camera with offsets and scales of at most fifteen digits, as GDAL hands on the tag's doubles.

    A longitude offset of 17 digits cut to 15 would move an image by up to 2e-8 px. The coefficients take up the
    difference: a normalised coordinate x becomes a x + b with b and a - 1 of 1e-13, the polynomials change by
    b dp/dx + (a - 1) x dp/dx, and the second-order remainder is 1e-26.
    """
    ground_offset, ground_scale = _fifteen(rpc.ground_offset), _fifteen(rpc.ground_scale)
    shift = (ground_offset - rpc.ground_offset) / rpc.ground_scale
    stretch = (ground_scale - rpc.ground_scale) / rpc.ground_scale
    coeffs = rpc.coeffs + rpc.coeffs * (POWERS @ stretch)
    coeffs[:, :10] += np.einsum("k,kij,pi->pj", shift, DERIVATIVE, rpc.coeffs)
    rpc = replace(rpc, coeffs=coeffs, ground_offset=ground_offset, ground_scale=ground_scale)
    return _counted_from(rpc, _fifteen(rpc.image_offset), _fifteen(rpc.image_scale))


def _counted_from(rpc: RPC, image_offset: Array, image_scale: Array) -> RPC:
    """Return the same camera with another offset and scale of the image: numerators take up the difference exactly."""
    coeffs, moved = rpc.coeffs.copy(), ((rpc.image_offset - image_offset) / image_scale)[:, None]
    coeffs[::2] = coeffs[::2] * (rpc.image_scale / image_scale)[:, None] + moved * coeffs[1::2]
    return replace(rpc, coeffs=coeffs, image_offset=image_offset, image_scale=image_scale)


# --- NITF -------------------------------------------------------------------------------------------------

_RPC_FIELD_WIDTHS = (7, 7, *WIDTHS)


def read_nitf(path: PathOrUrl) -> RPC | None:
    """Read the RPC in a NITF's RPC00B (or RPC00A) extension, None without one; RpcFormatError where it is not valid."""
    data = read_head(path, IMAGE, SCANNED)
    match = re.search(rb"RPC00([AB])01041", data)
    if match is None:
        return None
    record = data[match.end() :][:1041].decode("latin-1")
    name = f"{path} (RPC00{match.group(1).decode()})"
    if not record.startswith("1"):
        raise RpcFormatError(f"{name}: its SUCCESS flag is {record[:1]!r}, not 1: the vendor's fit failed")
    return rpc_from_fields(
        cells_of(record[1:], _RPC_FIELD_WIDTHS, SINGLE, name, f"RPC00{match.group(1).decode()}"), name
    )


# --- any raster -------------------------------------------------------------------------------------------


def read_domain(path: PathOrUrl, options: ReadOptions) -> RPC | None:
    """Read the RPC that GDAL shows of a raster without its side files, None without one.

    ImageError where it cannot be opened, RpcFormatError where numbers are missing or none.
    """
    with open_raster(path) as dataset:
        items, driver = dataset.tags(ns="RPC"), dataset.driver
    return rpc_from_domain(items, f"{path} (RPC by GDAL's driver {driver})", options) if items else None
