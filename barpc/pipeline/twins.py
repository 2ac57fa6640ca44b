"""Each image once: the same image twice ties itself to itself, perfectly and uselessly."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from rasterio.windows import Window

from barpc.errors import InputError
from barpc.raster import open_raster
from barpc.scene import View

_SAMPLES = ((0.5, 0.5), (0.25, 0.25), (0.75, 0.75))  # of width and height: where the sampled windows lie
_MORE = tuple((x / 5, y / 5) for x in range(6) for y in range(6))  # where nothing varies there
_SAMPLE_SIDE = (256, 16)  # px: many columns and few rows, so that few strips are decoded
_CHUNK = 1 << 20  # px that are hashed at a time


class Twins:
    """Finds an image that was given before: the same file, the same camera, or the same pixels.

    Parameters
    ----------
    band : int
        The band whose pixels are compared, from 1.

    Notes
    -----
    Pixels are compared as decoded values, so that copies in another compression, layout, number type or
    behind a VRT are found. Three small windows of each image are read; images in which these agree are then
    read whole, each once. An image in which nothing varies, in these and in 36 more, is compared with none. The
    work is linear in the number of images.
    """

    def __init__(self, band: int = 1) -> None:
        self._band = band
        self._known: dict[Hashable, str] = {}
        self._alike: dict[Hashable, str | None] = {}

    def add(self, view: View) -> None:
        """Take a view in.

        Raises
        ------
        InputError
            It is an image that was taken in before; the message names both.
        ImageError
            Its pixels cannot be read.
        """
        file = Path(view.path).stat()
        marks: dict[Hashable, str] = {
            (file.st_dev, file.st_ino): "is the same file as {}",
            (view.size, view.sensor): "is the same size and the same RPC as {}",
        }
        self._refuse(view, marks)
        pixels = self._pixels(view)
        if pixels is not None:
            marks[pixels] = "shows the same pixels as {} under another RPC"
            self._refuse(view, marks)
        self._known.update(dict.fromkeys(marks, view.path))

    def _refuse(self, view: View, marks: dict[Hashable, str]) -> None:
        for mark, what in marks.items():
            if mark in self._known:
                raise InputError(f"{view.path}: {what.format(self._known[mark])}; give each image once")

    def _pixels(self, view: View) -> Hashable | None:
        """A mark of the whole image where another is like it in the samples; None for the first of its like."""
        with open_raster(view.path) as image:
            sampled = _digest(image, self._band, _samples(*view.size), vary=True)
            if sampled is None:  # fill, perhaps: the rest is asked before anything is read whole
                sampled = _digest(image, self._band, _samples(*view.size, _MORE), vary=True)
            if sampled is None:
                return None
            like = (view.size, sampled)
            if like not in self._alike:
                self._alike[like] = view.path
                return None
            mark = _whole(image, self._band)
        first, self._alike[like] = self._alike[like], None
        if first is not None:
            with open_raster(first) as image:
                before = _whole(image, self._band)
            if before is not None:
                self._known[view.size, before] = first
        return None if mark is None else (view.size, mark)


def _samples(width: int, height: int, at: Sequence[tuple[float, float]] = _SAMPLES) -> list[Window]:
    wide, high = (min(side, size) for side, size in zip(_SAMPLE_SIDE, (width, height), strict=True))
    return [Window(int(x * (width - wide)), int(y * (height - high)), wide, high) for x, y in at]


def _whole(image: Any, band: int) -> bytes | None:
    """A hash of all pixels, row by row; None for an image in which nothing varies: it shows nothing."""
    block = image.block_shapes[band - 1][0]
    rows = max(1, _CHUNK // (image.width * block)) * block  # whole blocks, so that each is decoded once
    tops = range(0, image.height, rows)
    return _digest(
        image, band, [Window(0, top, image.width, min(rows, image.height - top)) for top in tops], vary=True
    )


def _digest(image: Any, band: int, windows: list[Window], *, vary: bool = False) -> bytes | None:
    """A hash of pixels; None where they should vary and do not."""
    found = blake2b(digest_size=16)
    low = high = np.nan
    for window in windows:
        for raw in image.read(band, window=window):
            row = _numbers(raw)
            found.update(row.tobytes())
            low, high = np.fmin(low, np.fmin.reduce(row)), np.fmax(high, np.fmax.reduce(row))
    return found.digest() if high > low or not vary else None


def _numbers(raw: Any) -> Any:
    """Pixels as 8-byte floats (complex ones as two), with one kind of zero and one of NaN."""
    parts = raw.astype(np.complex128).view(np.float64) if np.iscomplexobj(raw) else raw
    numbers = parts.astype(np.float64) + 0.0
    numbers[np.isnan(numbers)] = np.nan
    return numbers
