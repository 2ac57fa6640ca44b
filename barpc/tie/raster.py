"""Windowed reading of rasters: valid pixels, and an 8-bit picture for the detector."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from rasterio.windows import Window

from barpc.errors import ImageError
from barpc.geodesy import Array
from barpc.raster import open_raster
from barpc.scene import BoolArray

FloatImage = npt.NDArray[np.float32]
ByteImage = npt.NDArray[np.uint8]
Box = tuple[int, int, int, int]
"""col, row of the first pixel, width, height [px]."""

_SAMPLES = 5  # blocks a side whose pixels make the stretch
_SAMPLE_SIDE = 128  # px
_NEGLIGIBLE = 1e-6  # a range below this share of the values is a constant image


@dataclass(frozen=True)
class Stretch:
    """The pixel values that become 0 and 255."""

    low: float
    high: float

    def apply(self, pixels: FloatImage, valid: BoolArray) -> ByteImage:
        """8-bit picture; invalid pixels take the mean of the valid ones, so that they make few edges."""
        scaled = (pixels - np.float32(self.low)) * np.float32(255.0 / (self.high - self.low))
        if not valid.all():
            scaled = np.where(valid, scaled, scaled[valid].mean() if valid.any() else np.float32(0.0))
        picture: ByteImage = np.clip(np.rint(scaled), 0, 255).astype(np.uint8)
        return picture


def read_pixels(path: str | os.PathLike[str], box: Box, band: int = 1) -> tuple[FloatImage, BoolArray]:
    """Pixels of a window and which of them mean something.

    Parameters
    ----------
    path : path
        Raster file.
    box : Box
        Window, inside the raster.
    band : int
        Band, from 1.

    Returns
    -------
    pixels : (height, width)
        Values as stored; 0 where invalid.
    valid : (height, width)
        False at nodata, masked, non-finite and saturated pixels, and in undeclared zero borders.

    Raises
    ------
    ImageError
        The file cannot be read, has no such band, or holds complex numbers.
    """
    with open_raster(path) as dataset:
        check_band(dataset, path, band)
        return _read(dataset, box, band)


def check_band(dataset: Any, path: str | os.PathLike[str], band: int) -> None:
    """Raise ImageError unless `band` exists and holds real numbers."""
    if not 1 <= band <= dataset.count:
        raise ImageError(f"{os.fspath(path)}: there is no band {band}, only {dataset.count}")
    if dataset.dtypes[band - 1].startswith("complex"):
        raise ImageError(f"{os.fspath(path)}: band {band} is complex; give its amplitude as an image")


def _read(dataset: Any, box: Box, band: int) -> tuple[FloatImage, BoolArray]:
    window = Window(*box)
    raw = dataset.read(band, window=window)
    pixels: FloatImage = raw.astype(np.float32)
    valid: BoolArray = dataset.read_masks(band, window=window) != 0
    valid &= np.isfinite(pixels)
    if np.issubdtype(raw.dtype, np.integer):
        valid &= raw < np.iinfo(raw.dtype).max
        if dataset.nodata is None:  # zeros without a name: a border where they stand together
            zeros = cv2.morphologyEx((raw == 0).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
            valid &= zeros == 0
    return np.where(valid, pixels, np.float32(0.0)), valid


def sample_stretch(path: str | os.PathLike[str], band: int = 1) -> Stretch | None:
    """The stretch of a raster from blocks spread over it; None where nothing varies.

    Parameters
    ----------
    path : path
        Raster file.
    band : int
        Band, from 1.

    Returns
    -------
    stretch : Stretch or None
        Between the 0.5 and 99.5 percentiles of the valid pixels.
    """
    found: list[Array] = []
    with open_raster(path) as dataset:
        check_band(dataset, path, band)
        side_x, side_y = (min(_SAMPLE_SIDE, n) for n in (dataset.width, dataset.height))
        for row in np.linspace(0, dataset.height - side_y, _SAMPLES).astype(int):
            for col in np.linspace(0, dataset.width - side_x, _SAMPLES).astype(int):
                pixels, valid = _read(dataset, (int(col), int(row), side_x, side_y), band)
                found.append(pixels[valid][::7].astype(np.float64))
    values = np.concatenate(found)
    if not len(values):
        return None
    low, high = np.percentile(values, [0.5, 99.5])
    if not high - low > _NEGLIGIBLE * max(abs(low), abs(high)):
        return None
    return Stretch(float(low), float(high))


def grow(box: Box, margin: int, size: tuple[int, int]) -> Box:
    """A box with a margin on every side, cut at an image of `size` (width, height)."""
    col, row, width, height = box
    left, top = max(0, col - margin), max(0, row - margin)
    right, bottom = min(size[0], col + width + margin), min(size[1], row + height + margin)
    return left, top, max(0, right - left), max(0, bottom - top)
