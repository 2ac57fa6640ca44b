"""Windowed reading of rasters: valid pixels, and an 8-bit picture for the detector."""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from rasterio.enums import MaskFlags
from rasterio.windows import Window

from barpc.base.errors import ImageError
from barpc.base.geodesy import Array, Box, ByteImage
from barpc.rasters.raster import open_raster
from barpc.rasters.vrt import BLOCK_SIZE
from barpc.scene import BoolArray

FloatImage = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.float32] | npt.NDArray[np.float64]
"""float32 where it holds every number of the file's type (integers of up to 16 bits), else float64."""

CELL = 64
"""Side of the cells that each hold a quota of keypoints [px]; tiles are whole cells."""
SPAN = BLOCK_SIZE
"""Rows that are read at a time (at least one row of blocks), and what else is done in parts of so many."""
PIECE = 1 << 22
"""Pixels of pictures, places of templates in them, or numbers of descriptors that are worked on together; decides on no
figure."""
_STRETCH_BLOCKS = 5  # blocks a side whose pixels make the stretch
_PERCENT = 0.5, 99.5  # of them that are black and white
_WHITE = 255.0
_NEGLIGIBLE = 8.0  # a range below so many steps of a float type is a constant image


@dataclass(frozen=True)
class Stretch:
    """Linear stretch of pixel values to 0 .. 255."""

    low: float
    high: float

    @staticmethod
    def of(values: Pixels) -> Stretch | None:
        """Return the stretch of the middle 99 % of some 100,000 of the values (N,); None where nothing varies."""
        return Stretch.between(values[:: 1 + len(values) // 100_000])

    @staticmethod
    def between(values: Pixels, least: float = 0.0, percent: tuple[float, float] = _PERCENT) -> Stretch | None:
        """Return the stretch between two percentiles of values (N,); None where they differ by `least` or less."""
        low, high = np.percentile(values, percent) if len(values) else (0.0, 0.0)
        varies = high / 2 - low / 2 > least * max(abs(low), abs(high)) / 2  # halves: a difference may have no number
        return Stretch(float(low), float(high)) if varies else None

    def apply(self, pixels: Pixels, valid: BoolArray) -> ByteImage:
        """Return an 8-bit picture; invalid pixels take the mean of the valid ones, so that they make few edges."""
        if pixels.dtype == np.float32:
            scaled = (pixels - np.float32(self.low)) * np.float32(_WHITE / (self.high - self.low))
        else:
            scaled = _contrast_stretched(pixels, self.low, self.high)
        if not valid.all():
            scaled = np.where(valid, scaled, scaled[valid].mean() if valid.any() else np.float32(0.0))
        return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


def _contrast_stretched(pixels: Pixels, low: float, high: float) -> FloatImage:
    """Return `low` and `high` as black and white; whatever the scale, nothing overflows."""
    with np.errstate(over="ignore"):
        share = (pixels / 2 - low / 2) / (high / 2 - low / 2)  # halves: a difference may have no number
    most = _WHITE**2  # beyond it a pixel would drown its surroundings
    return np.clip(share * _WHITE, -most, most).astype(np.float32)


def levelled(pixels: Pixels, valid: BoolArray) -> FloatImage:
    """Return the pixels of a window in float32, as they are or (from float64) on a scale of the window's own.

    Registration does not see offset and scale; float32 would lose the picture beside 2e9, and overflow squaring 1e30.
    """
    if pixels.dtype == np.float32:
        return pixels.astype(np.float32, copy=False)
    known = pixels[valid]
    stretch = Stretch.of(known) or Stretch.between(known, percent=(0.0, 100.0))
    if stretch is None:
        return np.zeros(pixels.shape, np.float32)
    return np.where(valid, _contrast_stretched(pixels, stretch.low, stretch.high), np.float32(0.0))


def read_pixels(
    path: str | os.PathLike[str], box: Box, band: int, size: tuple[int, int] | None = None
) -> tuple[Pixels, BoolArray]:
    """Read the pixels (height, width) of a window as stored, 0 where invalid, and the mask of valid ones.

    Those at nodata, masked, non-finite, saturated or in undeclared zero borders do not. ImageError: the file cannot
    be read, has no such band (from 1), or holds complex numbers.
    """
    with PixelReader(path, band, size) as reader:
        return reader.read(box)


class PixelReader(ExitStack):
    """`read_pixels` for many windows: a block that two of them share is decoded once.

    With a `size` (width, height) that the file holds several times, boxes and pixels are those of the picture of that
    size: means of the file's; of `thin` a side of these.
    """

    def __init__(
        self, path: str | os.PathLike[str], band: int, size: tuple[int, int] | None = None, thin: int = 1
    ) -> None:
        super().__init__()
        dataset = self.enter_context(open_raster(path))
        wide, high = _picture_factors(dataset, size)
        self._pixel = thin * wide, thin * high
        try:
            self._band = _RasterBand.of(dataset, path, band)
        except ImageError:
            self.close()
            raise

    def read(self, box: Box) -> tuple[Pixels, BoolArray]:
        """Read the pixels of a window and the mask of valid ones."""
        return _block_means(self._band, box, self._pixel)


class OpenReaders(ExitStack):
    """Readers (`PixelReader`), each opened once and kept open."""

    def __init__(self) -> None:
        super().__init__()
        self._known: dict[tuple[str, int, tuple[int, int], int], PixelReader] = {}

    def of(self, path: str, band: int, size: tuple[int, int], thin: int = 1) -> PixelReader:
        """Return the reader of an image; arguments as those of `PixelReader`."""
        key = path, band, size, thin
        if key not in self._known:
            self._known[key] = self.enter_context(PixelReader(path, band, size, thin))
        return self._known[key]


def _picture_factors(dataset: Any, size: tuple[int, int] | None) -> tuple[int, int]:
    """Return the columns and rows of a raster in a pixel of its picture of a size (width, height)."""
    width, height = size or (dataset.width, dataset.height)
    return max(1, dataset.width // width), max(1, dataset.height // height)


def _block_means(band: _RasterBand, box: Box, pixel: tuple[int, int], level: int = 1) -> tuple[Pixels, BoolArray]:
    """Return the pixels of a window, means of `pixel` (columns, rows) of the file's; valid where all of these are."""
    if pixel == (1, 1):
        return band.read(box, level)
    (col, row, width, height), (wide, high), parts = box, pixel, []
    step = max(1, SPAN // high)
    for top in range(row, row + height, step):
        rows = min(step, row + height - top)
        raw, known = band.read((wide * col, high * top, wide * width, high * rows))
        raw /= wide * high  # before the sum: it might have no number
        mean = cv2.resize(raw, (width, rows), interpolation=cv2.INTER_AREA) * raw.dtype.type(wide * high)
        parts.append((mean, known.reshape(rows, high, width, wide).all(axis=(1, 3))))
    pixels, valid = (np.concatenate(column) for column in zip(*parts, strict=True))
    pixels[~valid] = 0.0
    return pixels, valid


@dataclass(frozen=True, eq=False)
class _RasterBand:
    """A band of an open raster, and its properties common to all windows."""

    dataset: Any
    number: int
    nodata: float | None  # of the raster
    invalid: float | None  # the value of the band's pixels that are none
    by_value: bool  # values alone tell which pixels are valid: GDAL would decode a window again for its mask

    @classmethod
    def of(cls, dataset: Any, path: str | os.PathLike[str], number: int) -> _RasterBand:
        """Return a band, from 1; there is none, or of complex numbers: ImageError."""
        if not 1 <= number <= dataset.count:
            raise ImageError(f"{os.fspath(path)}: there is no band {number}, only {dataset.count}")
        if dataset.dtypes[number - 1].startswith("complex"):
            raise ImageError(f"{os.fspath(path)}: band {number} is complex; give its amplitude as an image")
        flags = dataset.mask_flag_enums[number - 1]
        invalid = dataset.nodatavals[number - 1] if MaskFlags.nodata in flags else None
        told = flags in ([MaskFlags.nodata], [MaskFlags.all_valid])
        return cls(dataset, number, dataset.nodata, invalid, told)

    def read(self, box: Box, zoom: int = 1) -> tuple[Pixels, BoolArray]:
        """Return the pixels of a window, of every `zoom` a side one; above 1 only where the file holds that level."""
        window = Window(*box)
        more: dict[str, Any] = {"out_shape": (box[3] // zoom, box[2] // zoom)} if zoom > 1 else {}
        raw = self.dataset.read(self.number, window=window, **more)
        whole = raw.dtype.kind in "iu"
        single = raw.dtype.kind != "f" and np.can_cast(raw.dtype, np.float32)
        pixels: Pixels = raw.astype(np.float32 if single else np.float64)
        valid = raw < np.iinfo(raw.dtype).max if whole else np.isfinite(pixels)
        if not (whole and self.by_value):
            valid &= self.dataset.read_masks(self.number, window=window, **more) != 0
        elif self.invalid is not None:
            valid &= raw != self.invalid
        if whole and self.nodata is None and not raw.any():
            valid[:] = False
        elif whole and self.nodata is None and not raw.all():
            # zeros without a name: a border where they stand together
            cv2.setNumThreads(1)  # the work is spread by processes
            zeros = cv2.morphologyEx((raw == 0).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
            valid &= zeros == 0
        if not valid.all():
            pixels[~valid] = 0.0
        return pixels, valid


def sample_stretch(path: str | os.PathLike[str], band: int, size: tuple[int, int] | None = None) -> Stretch | None:
    """Estimate the stretch, 0.5 to 99.5 %, of a raster (or its picture); None where nothing varies."""
    found: list[Array] = []
    with open_raster(path) as dataset:
        read = _RasterBand.of(dataset, path, band)
        kind = np.dtype(dataset.dtypes[band - 1])
        pixel, (width, height) = _picture_factors(dataset, size), size or (dataset.width, dataset.height)
        zoom = _overview_factor(dataset, band) if pixel == (1, 1) else 1
        side_x, side_y = (min(zoom * 2 * CELL, n) for n in (width, height))
        for row in np.linspace(0, height - side_y, _STRETCH_BLOCKS).astype(int):
            for col in np.linspace(0, width - side_x, _STRETCH_BLOCKS).astype(int):
                box = int(col), int(row), side_x, side_y
                pixels, valid = _block_means(read, box, pixel, zoom)
                found.append(pixels[valid][::7].astype(np.float64))
    step = float(np.finfo(kind).eps) if kind.kind == "f" else 0.0
    return Stretch.between(np.concatenate(found), _NEGLIGIBLE * step)


@dataclass(frozen=True)
class Survey:
    """Stretch and layout of a raster, known before its tiles are searched."""

    stretch: Stretch
    block: tuple[int, int]  # width and height of what is decoded at a time [px]
    levels: bool  # decoding is dear, and every second or fourth pixel costs less (JPEG 2000)
    pixel: tuple[int, int] = (1, 1)  # columns and rows of the file that a pixel holds
    band: int = 1


def survey(path: str | os.PathLike[str], band: int, size: tuple[int, int] | None = None) -> Survey | None:
    """Survey a raster: its stretch, or its picture of a size, and its layout; None where nothing varies."""
    stretch = sample_stretch(path, band, size)
    with open_raster(path) as dataset:
        height, width = dataset.block_shapes[band - 1]
        wide, high = pixel = _picture_factors(dataset, size)
        levels = pixel == (1, 1) and _overview_factor(dataset, band) > 1
    block = max(1, width // wide), max(1, height // high)
    return None if stretch is None else Survey(stretch, block, levels, pixel, band)


def _overview_factor(dataset: Any, band: int) -> int:
    """Return the side [px] of pixels that overviews average at less cost: 4 (and 2) where decoding is dear, else 1."""
    return 4 if dataset.driver == "JP2OpenJPEG" and {2, 4} <= set(dataset.overviews(band)) else 1


def read_picture(path: str | os.PathLike[str], box: Box, found: Survey, zoom: int = 1) -> tuple[ByteImage, BoolArray]:
    """Read an 8-bit picture of a window and its valid pixels, each of `zoom` px a side; see `read_pixels`.

    `box` begins at whole multiples of `zoom`. Blocks are decoded once, row by row of them.
    """
    col, row, width, height = box[0], box[1], box[2] // zoom * zoom, box[3] // zoom * zoom
    picture = np.empty((height // zoom, width // zoom), np.uint8)
    valid = np.empty(picture.shape, dtype=bool)
    level = zoom if found.levels else 1
    with open_raster(path) as dataset:
        read = _RasterBand.of(dataset, path, found.band)
        step = zoom * found.block[1]
        step *= max(1, SPAN // step)
        top = row
        while top < row + height:
            stop = min(row + height, (top // step + 1) * step)
            pixels, known = _block_means(read, (col, top, width, stop - top), found.pixel, level)
            part = slice((top - row) // zoom, (stop - row) // zoom)
            picture[part], valid[part] = _reduced(found.stretch.apply(pixels, known), known, zoom // level)
            top = stop
    return picture, valid


def _reduced(picture: ByteImage, valid: BoolArray, zoom: int) -> tuple[ByteImage, BoolArray]:
    """Return a picture of every `zoom` pixels a side one; valid are those of which all are."""
    if zoom == 1:
        return picture, valid
    size = picture.shape[1] // zoom, picture.shape[0] // zoom
    small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    known: BoolArray = np.asarray(valid.reshape(size[1], zoom, size[0], zoom).all(axis=(1, 3)))
    return small, known


def thumbnail(path: str | os.PathLike[str], size: tuple[int, int], side: int, band: int) -> ByteImage | None:
    """Return an 8-bit picture of a whole raster of `size` (width, height), at most `side` px a side.

    None where nothing varies; invalid pixels are black. Two pixels a side are read for one, from overviews where the
    file has them: a picture to look at, at a fraction of the cost of all pixels.
    """
    with open_raster(path) as dataset:
        read = _RasterBand.of(dataset, path, band)
        ends = dataset.width, dataset.height
        zoom = max(1, min(max(ends) // (2 * side), *ends))
        width, height = (n // zoom * zoom for n in ends)
        step = zoom * max(1, SPAN // zoom)
        parts = [read.read((0, top, width, min(step, height - top)), zoom) for top in range(0, height, step)]
    pixels, valid = (np.concatenate(column) for column in zip(*parts, strict=True))
    stretch = Stretch.of(pixels[valid])
    if stretch is None:
        return None
    shape = [max(1, round(n * min(1.0, side / max(size)))) for n in size]
    picture = np.where(valid, stretch.apply(pixels, valid), np.uint8(0))
    return np.asarray(cv2.resize(picture, shape, interpolation=cv2.INTER_AREA), np.uint8)


def jpeg(pixels: ByteImage, most: float = np.inf) -> bytes:
    """Encode grey values (H, W) as a JPEG file, of at most so many bytes: at a lower quality, then smaller."""
    for quality in (70, 50, 30):
        found = bytes(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])
        if len(found) <= most or min(pixels.shape) < 2:
            return found
    return jpeg(np.asarray(cv2.resize(pixels, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA), np.uint8), most)


def grow(box: Box, margin: int, size: tuple[int, int]) -> Box:
    """Return a box with a margin on every side, cut at an image of `size` (width, height); at least one pixel."""
    col, row, width, height = box
    low = np.clip(np.array([col, row]) - margin, 0, np.array(size) - 1)
    high = np.clip(np.array([col + width, row + height]) + margin, low + 1, size)
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def tiles(size: tuple[int, int], tile: int, zoom: int = 1, found: Survey | None = None) -> list[Box]:
    """Return the boxes that cover an image of `size` (width, height) without overlap, cut at whole cells.

    A side is `tile` times `zoom` px; strips are taken whole, and so are blocks that are dear to
    decode.
    """
    sides = [zoom * tile] * 2
    if found is not None and found.block[0] >= size[0]:
        sides[0] = max(sides[0], size[0])
    if found is not None and found.levels:
        sides = [max(2, side // (zoom * block)) * zoom * block for side, block in zip(sides, found.block, strict=True)]
    edges = []
    for length, side in zip(size, sides, strict=True):
        step = side
        if not (found is not None and found.levels):
            step = -(-length // -(-length // side))  # equal tiles, none larger than asked
            step = -(-step // CELL) * CELL
        edges.append([(start, min(step, length - start)) for start in range(0, length, step)])
    return [(col, row, width, height) for row, height in edges[1] for col, width in edges[0]]
