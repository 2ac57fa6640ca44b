"""Geoid grids of GeographicLib (.pgm), read like a dataset of rasterio.

A grid has a 16-bit number per node, in rows from the north pole southwards that run from Greenwich eastwards. Comments
in the header state an offset and a scale: height of the geoid [m] = offset + scale * number.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from rasterio import Affine
from rasterio.coords import BoundingBox
from rasterio.crs import CRS
from rasterio.transform import array_bounds
from rasterio.windows import Window

from barpc.base.errors import InputError
from barpc.base.remote import PathOrUrl
from barpc.base.safe_io import GRID, opened

_PGM_HEADER = re.compile(rb"P5\s++((?:#[^\n]*+\n\s*+)*+)(\d{1,6})\s++(\d{1,6})\s++((?:#[^\n]*+\n\s*+)*+)65535[ \t\r\n]")


@dataclass(frozen=True)
class Pgm:
    """An open grid with those attributes and methods of a dataset of rasterio that `barpc.rasters.dem` uses."""

    file: BinaryIO
    start: int  # position of the first number in the file [bytes]
    shape: tuple[int, int]
    offsets: tuple[float]
    scales: tuple[float]
    crs, units = CRS.from_epsg(4326), ("m",)

    @property
    def transform(self) -> Affine:
        """Affine map from col, row to lon, lat [deg]; nodes are the centres of cells."""
        rows, cols = self.shape
        east, south = 360.0 / cols, 180.0 / (rows - 1)
        return Affine(east, 0.0, -east / 2, 0.0, -south, 90.0 + south / 2)

    @property
    def bounds(self) -> BoundingBox:
        """Edges of the cells [deg]."""
        return BoundingBox(*array_bounds(*self.shape, self.transform))

    def read(self, _band: int, window: Window, masked: bool) -> Any:
        """Return the numbers of a window. Only its rows are read: a grid of one arc minute has half a gigabyte."""
        (top, bottom), columns = window.toranges()[0], slice(*window.toranges()[1])
        self.file.seek(self.start + 2 * top * self.shape[1])
        numbers = np.frombuffer(self.file.read(2 * (bottom - top) * self.shape[1]), dtype=">u2")
        return np.ma.MaskedArray(numbers.reshape(bottom - top, -1)[:, columns])


@contextmanager
def open_pgm(path: PathOrUrl) -> Iterator[Pgm]:
    """Open a geoid grid; InputError if it is not in GeographicLib's format."""
    with opened(path, GRID) as file:
        found = _PGM_HEADER.match(file.read(65536))
        if found is None:
            raise InputError(f"{path}: no .pgm of 16-bit numbers (P5, comments, width, height, 65535)")
        cols, rows = int(found[2]), int(found[3])
        pairs = re.findall(r"#[ \t]*+(\w++)[ \t]++([^\n]*+)", (found[1] + found[4]).decode("latin-1"))
        said = {key.lower(): text.strip() for key, text in pairs}
        try:
            offset, scale = float(said["offset"]), float(said["scale"])
        except (KeyError, ValueError):
            offset = scale = np.nan
        if not (np.isfinite([offset, scale]).all() and scale > 0):
            raise InputError(f"{path}: no geoid grid of GeographicLib, whose comments state '# Offset' and '# Scale'")
        origin, kind = said.get("origin", "90N 0E"), said.get("area_or_point", "Point")
        if (origin.split(), kind.lower()) != (["90N", "0E"], "point"):
            raise InputError(f"{path}: Origin {origin}, {kind}: only grids of points from 90N 0E on are read")
        length = found.end() + 2 * rows * cols
        if rows < 2 or cols < 2 or file.seek(0, 2) != length:
            raise InputError(f"{path}: {file.seek(0, 2)} bytes, its header of {cols} x {rows} numbers needs {length}")
        yield Pgm(file, found.end(), (rows, cols), (offset,), (scale,))
