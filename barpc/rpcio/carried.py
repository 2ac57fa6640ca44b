"""RPCs that rasters carry: a GeoTIFF's RPCCoefficientTag (50844) and a NITF's RPC00B extension.

The tag is read from the file's directory itself, to the bit: GDAL prints its numbers with 15 digits on the way. A copy
is made of the source's bytes; only its first directory is written anew, behind the pixels, so that compression, tiles,
overviews and masks stay as they are, in TIFF and BigTIFF alike.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from barpc.base.errors import ImageError, RpcFormatError, plain
from barpc.base.geodesy import Array
from barpc.base.remote import PathOrUrl
from barpc.base.safe_io import IMAGE, opened, read_head
from barpc.rpcio.text import COEFFICIENTS, SINGLE, WIDTHS, cells_of, fields_from_rpc, fields_in_order, rpc_from_fields
from barpc.sensor.rational import DERIVATIVE, POWERS
from barpc.sensor.rpc import RPC

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


def nitf_record(rpc: RPC) -> str:
    """Return the 1041 characters of an RPC00B extension; RpcFormatError where a number does not fit its field.

    Image and height offsets and scales are integers, degrees have four decimals, coefficients seven digits: an
    RPC that was not fitted for it (`barpc.fit`, precision "nitf") loses tenths of a pixel. The image's offsets have
    no sign: those of a part of an image may be negative, and start from 0. An unknown accuracy is written as zero, as
    the format asks.
    """
    fields = fields_from_rpc(
        _counted_from(rpc, np.maximum(np.rint(rpc.image_offset), 0.0), np.maximum(np.rint(rpc.image_scale), 1.0))
    )
    decimals = {"ERR": 2, "LAT": 4, "LONG": 4}
    cells = ["1"]
    for key, width in zip(SINGLE, _RPC_FIELD_WIDTHS, strict=True):
        value = fields.get(key, [0.0])[0]
        axis = key.split("_")[0]
        sign = "+" if axis in ("LAT", "LONG", "HEIGHT") else ""
        cell = format(value, f"{sign}0{width}.{decimals.get(axis, 0)}f")
        if len(cell) != width or (not sign and value < 0):
            raise RpcFormatError(f"NITF RPC00B: {key} = {value:g} does not fit {width} characters")
        cells.append(cell)
    cells += [_nitf_coefficient(value, key) for key in COEFFICIENTS for value in fields[key]]
    return "".join(cells)


def _nitf_coefficient(value: float, key: str) -> str:
    mantissa, exponent = f"{value:+.6E}".split("E")
    power = int(exponent)
    if power < -9:
        return "+0.000000E+0"
    if power > 9:
        raise RpcFormatError(f"NITF RPC00B: a coefficient of {key} is {value:g}, beyond the format")
    return f"{mantissa}E{power:+d}"
