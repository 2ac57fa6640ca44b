"""Images of other kinds than GeoTIFF that hold an RPC where GDAL reads it: PCIDSK, ENVI, JPEG 2000."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning
from rasterio.rpc import RPC as GdalRPC

from barpc.rpcio.text import COEFFICIENTS, OFFSETS, SCALES, fields_from_rpc
from barpc.sensor.rpc import RPC
from tests.rpcio.conftest import write_image

_BLOCK = 512  # bytes of PCIDSK's blocks, by which it counts from 1


def pcidsk(path: Path, rpc: RPC | None, *, numbers: int = 20, cells: dict[str, str] | None = None, **image) -> Path:
    """A PCIDSK file by GDAL, which writes no RPC into it: its segment RFMODEL, of seven blocks, is put behind the end.

    Eighty coefficients of 22 characters (`numbers` a list), offsets and scales before them; `cells` are put instead.
    """
    path = _written(path, driver="PCIDSK", **image)
    if rpc is None:
        return path
    data = bytearray(path.read_bytes())
    fields = fields_from_rpc(rpc)
    text = {key: f"{fields[key][0]:.15E}" for key in OFFSETS + SCALES} | (cells or {})
    blocks = [bytearray(b" " * _BLOCK) for _ in range(7)]
    blocks[0][:9], blocks[0][22:36] = b"RFMODEL 1", b"DS  12NDSENSOR"
    order = ("LONG", "LAT", "HEIGHT", "SAMP", "LINE")
    head = f"{numbers:4d}{40:10d}{60:10d}" + "".join(
        f"{text[f'{axis}_{part}']:>22}" for axis in order for part in ("OFF", "SCALE")
    )
    blocks[1][: len(head)] = head.encode()
    for block, key in zip(blocks[2:6], ("SAMP_NUM", "SAMP_DEN", "LINE_NUM", "LINE_DEN"), strict=True):
        row = "".join(f"{value:22.14E}" for value in fields[f"{key}_COEFF"][:numbers])
        block[: len(row)] = row.encode()
    blocks[6][:16] = b"LONG/LAT    D000"
    start = len(data) // _BLOCK
    pointers = _BLOCK * (int(data[440:456]) - 1)
    free = next(at for at in range(pointers, pointers + 32 * 64, 32) if data[at : at + 1] in (b" ", b"\0"))
    data[free : free + 32] = f"A180RFMODEL {start + 1:11d}{9:9d}".encode()
    data += f"{'RPC':64}{'':960}".encode() + b"".join(blocks)
    data[16:32] = f"{len(data) // _BLOCK:16d}".encode()
    path.write_bytes(data)
    return path


def envi(path: Path, rpc: RPC | None, more: str = "", **image) -> Path:
    """Raw pixels by GDAL, and the RPC in their header as ENVI has it."""
    _written(path, driver="ENVI", **image)
    if rpc is not None:
        fields = fields_from_rpc(rpc)
        values = [v for key in (*OFFSETS, *SCALES, *COEFFICIENTS) for v in fields[key]] + [0, 0, 1]
        more += "rpc info = {\n " + ",\n ".join(map(repr, values)) + "}\n"
    header = path.with_suffix(".hdr")
    header.write_text(header.read_text().rstrip("\n") + "\n" + more)
    return path


def jp2(path: Path, rpc: RPC | None, **image) -> Path:
    """A JPEG 2000 with the RPC in its GeoTIFF box."""
    options = {} if rpc is None else {"rpcs": rpc.to_rasterio()}
    return _written(path, driver="JP2OpenJPEG", REVERSIBLE="YES", QUALITY="100", **options, **image)


def _written(path: Path, data: np.ndarray | None = None, **profile: object) -> Path:
    """An image by GDAL of known pixels, or of `data`, and nothing but it and its header."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if data is None:
        write_image(path, **profile)
    else:
        count, height, width = data.shape
        with rasterio.open(path, "w", count=count, height=height, width=width, dtype=data.dtype, **profile) as out:
            out.write(data)
    path.with_name(f"{path.name}.aux.xml").unlink(missing_ok=True)
    return path


def seen_by_gdal(path: Path) -> GdalRPC | None:
    """The RPC that rasterio shows."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as dataset:
            return dataset.rpcs


def gdal_pixels(path: Path) -> np.ndarray:
    """The pixels that rasterio reads."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as dataset:
            return np.asarray(dataset.read())


MAKERS = {"pix": pcidsk, "img": envi, "dat": envi, "jp2": jp2}
"""End of a name -> who writes such a file with an RPC."""
