"""The GeoTIFF RPCCoefficientTag (50844): read to the bit, and put into a copy whose pixels stay untouched.

The tag is read from the file's directory itself: GDAL prints its numbers with 15 digits on the way. The
copy is made of the source's bytes; only its first directory is written anew, behind the pixels, so that
compression, tiles, overviews and masks stay as they are, in TIFF and BigTIFF alike.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from barpc.errors import ImageError, RpcFormatError
from barpc.rpcio.fields import COEFFICIENTS, ERRORS, OFFSETS, SCALES, fields_from_rpc, rpc_from_fields
from barpc.sensor.rpc import RPC
from barpc.sidefile import IMAGE, opened

RPC_TAG = 50844
GEOREFERENCE_TAGS = (33550, 33922, 34264)
"""ModelPixelScale, ModelTiepoint, ModelTransformation."""
MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

_TYPE_SIZES = {
    1: 1,
    2: 1,
    3: 2,
    4: 4,
    5: 8,
    6: 1,
    7: 1,
    8: 2,
    9: 4,
    10: 8,
    11: 4,
    12: 8,
    13: 4,
    16: 8,
    17: 8,
    18: 8,
}
_DOUBLE = 12
_MAX_ENTRIES = 4096


@dataclass(frozen=True)
class Entry:
    """One entry of a TIFF directory: tag, type, count, and its value or offset as it stands in the file."""

    tag: int
    kind: int
    count: int
    value: bytes


@dataclass(frozen=True)
class Directory:
    """The first directory of a TIFF file and what is needed to read its values."""

    order: str  # struct's "<" or ">"
    big: bool
    entries: tuple[Entry, ...]
    following: bytes  # offset of the next directory, as it stands in the file

    def find(self, tag: int) -> Entry | None:
        """The entry of a tag, or None."""
        return next((entry for entry in self.entries if entry.tag == tag), None)

    @property
    def offset_format(self) -> str:
        """The format of an offset, for struct."""
        return self.order + ("Q" if self.big else "I")


def is_tiff(head: bytes) -> bool:
    """Whether a file's first bytes are those of a TIFF or BigTIFF."""
    return head[:4] in MAGICS


def read_directory(file: BinaryIO, name: str) -> Directory:
    """The first directory of an open TIFF file.

    Raises
    ------
    RpcFormatError
        The file ends too early or the directory makes no sense.
    """
    try:
        head = file.read(16)
        order, big = ("<" if head[:2] == b"II" else ">"), head[2:4] in (b"+\0", b"\0+")
        (start,) = struct.unpack(order + ("Q" if big else "I"), head[8:16] if big else head[4:8])
        file.seek(start)
        (count,) = struct.unpack(order + ("Q" if big else "H"), file.read(8 if big else 2))
        if not 0 < count <= _MAX_ENTRIES:
            raise RpcFormatError(f"{name}: a TIFF directory of {count} entries")
        layout = order + ("HHQ8s" if big else "HHI4s")
        size = struct.calcsize(layout)
        block = file.read(size * count)
        entries = tuple(Entry(*struct.unpack_from(layout, block, size * i)) for i in range(count))
        following = file.read(8 if big else 4)
        if len(following) != (8 if big else 4):
            raise RpcFormatError(f"{name}: the TIFF directory is cut off")
    except (struct.error, OverflowError, OSError) as error:
        raise RpcFormatError(f"{name}: not a TIFF file that can be read ({error})") from error
    return Directory(order, big, entries, following)


def read_values(file: BinaryIO, directory: Directory, entry: Entry, name: str) -> bytes:
    """The bytes of an entry's values, wherever they stand."""
    size = _TYPE_SIZES.get(entry.kind, 1) * entry.count
    if size > 1 << 24:
        raise RpcFormatError(f"{name}: TIFF tag {entry.tag} claims {size} bytes")
    if size <= len(entry.value):
        return entry.value[:size]
    (offset,) = struct.unpack(directory.offset_format, entry.value)
    try:
        file.seek(offset)
        data = file.read(size)
    except (OverflowError, OSError) as error:
        raise RpcFormatError(f"{name}: TIFF tag {entry.tag} points nowhere ({error})") from error
    if len(data) != size:
        raise RpcFormatError(f"{name}: TIFF tag {entry.tag} lies beyond the end of the file")
    return data


def read_tag(path: Path) -> RPC | None:
    """The RPC in a TIFF's tag, or None where there is no such tag.

    Raises
    ------
    RpcFormatError
        The tag is there and does not hold 92 usable doubles.
    """
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
    single = ERRORS + OFFSETS + SCALES
    fields = {key: [value] for key, value in zip(single, values, strict=False)}
    fields |= {key: list(values[12 + 20 * i : 32 + 20 * i]) for i, key in enumerate(COEFFICIENTS)}
    if not all(math.isfinite(value) for value in values[2:]):
        raise RpcFormatError(f"{path}: the RPC tag holds a number that is not finite")
    return rpc_from_fields(fields, f"{path} (RPC tag)")


def tag_values(rpc: RPC) -> list[float]:
    """The 92 doubles of the tag; an unknown accuracy is -1."""
    fields = fields_from_rpc(rpc)
    single = [fields.get(key, [-1.0])[0] for key in ERRORS + OFFSETS + SCALES]
    return single + [value for key in COEFFICIENTS for value in fields[key]]


def put_tag(path: Path, rpc: RPC, drop: tuple[int, ...] = ()) -> None:
    """Give a TIFF an RPC tag, in place: for a fresh copy only, never for somebody's image.

    Parameters
    ----------
    path : Path
        The file that is changed: a new directory is written behind its end.
    rpc : RPC
        Goes into the tag, in place of the one that may be there.
    drop : tuple of int
        Tags to leave out of the new directory.

    Raises
    ------
    RpcFormatError
        No TIFF that can be read.
    ImageError
        The file would pass 4 GB, which only BigTIFF can hold.
    """
    with opened(path, IMAGE) as file:
        directory = read_directory(file, str(path))
    entries = [e for e in directory.entries if e.tag != RPC_TAG and e.tag not in drop]
    size = path.stat().st_size
    start = size + -size % 16
    if not directory.big and start + (1 << 16) > 0xFFFFFFFF:
        raise ImageError(
            f"{path}: a tag does not fit behind {size} bytes of classic TIFF; convert it to BigTIFF"
        )
    order, big = directory.order, directory.big
    values = struct.pack(f"{order}92d", *tag_values(rpc))
    entries.append(Entry(RPC_TAG, _DOUBLE, 92, struct.pack(directory.offset_format, start)))
    layout = order + ("HHQ8s" if big else "HHI4s")
    table = struct.pack(order + ("Q" if big else "H"), len(entries))
    for entry in sorted(entries, key=lambda e: e.tag):
        table += struct.pack(layout, entry.tag, entry.kind, entry.count, entry.value)
    with path.open("r+b") as file:
        file.seek(start)
        file.write(values + table + directory.following)
        _unmark_cog(file)
        file.seek(8 if big else 4)
        file.write(struct.pack(directory.offset_format, start + len(values)))


def _unmark_cog(file: BinaryIO) -> None:
    """Say in a cloud-optimised GeoTIFF's header that its directory is no longer in front.

    The header has a line for exactly this, of fixed width; readers then take the file as any tiled TIFF.
    """
    file.seek(0)
    head = file.read(1024)
    mark = b"KNOWN_INCOMPATIBLE_EDITION=NO\n "
    position = head.find(mark)
    if position >= 0:
        file.seek(position)
        file.write(b"KNOWN_INCOMPATIBLE_EDITION=YES\n")
