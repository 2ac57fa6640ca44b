"""The raster that a VRT describes, put together from its sources: what `rasterio.DatasetReader` would show."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rasterio
from rasterio.control import GroundControlPoint
from rasterio.coords import BoundingBox
from rasterio.crs import CRS
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.errors import CRSError
from rasterio.transform import array_bounds
from rasterio.windows import Window

from barpc.errors import ImageError
from barpc.scene import BoolArray
from barpc.vrt import Band, Rect, Source, Vrt

Pixels = npt.NDArray[Any]

_BLOCK = 512  # px
_MOST_OPEN = 64
_WIDE = (
    "int32",
    "uint32",
    "int64",
    "uint64",
    "float64",
)  # GDAL scales them as float64, all others as float32


class Mosaic:
    """A VRT opened for reading; what is asked of a dataset in this package, under rasterio's names.

    Parameters
    ----------
    name : str
        The VRT, for messages.
    vrt : Vrt
        What it says.
    opener : callable
        Opens a source with its own driver.

    Raises
    ------
    ImageError
        Its coordinate system is none.
    """

    def __init__(self, name: str, vrt: Vrt, opener: Callable[[Path], Any]) -> None:
        self.name, self._vrt, self._opener = name, vrt, opener
        self._stack, self._open = ExitStack(), dict[Path, Any]()
        self.width, self.height = vrt.size
        self.shape, self.count = (self.height, self.width), len(vrt.bands)
        self.indexes = tuple(range(1, self.count + 1))
        self.dtypes = tuple(band.dtype for band in vrt.bands)
        self.nodatavals = tuple(band.nodata for band in vrt.bands)
        self.nodata = self.nodatavals[0]
        self.block_shapes = [(min(_BLOCK, self.height), min(_BLOCK, self.width))] * self.count
        names = ColorInterp.__members__
        self.colorinterp = tuple(names.get(band.color, ColorInterp.undefined) for band in vrt.bands)
        self.crs = self._crs(vrt.srs)
        self.transform = (
            rasterio.Affine.from_gdal(*vrt.transform) if vrt.transform else rasterio.Affine.identity()
        )
        self.bounds = BoundingBox(*array_bounds(self.height, self.width, self.transform))
        self.mask_flag_enums = ([MaskFlags.per_dataset if vrt.mask else MaskFlags.all_valid],) * self.count

    def __enter__(self) -> Mosaic:
        """Itself."""
        return self

    def __exit__(self, *failure: object) -> None:
        """Close the sources."""
        self._close()

    def _close(self) -> None:
        self._open.clear()
        self._stack.close()

    def _crs(self, text: str) -> CRS | None:
        try:
            return CRS.from_string(text) if text else None
        except CRSError as error:
            raise ImageError(f"{self.name}: the VRT's coordinate system cannot be read ({error})") from error

    @property
    def gcps(self) -> tuple[list[GroundControlPoint], CRS | None]:
        """Ground control points and their CRS."""
        points = []
        for row in self._vrt.gcps:
            line, pixel, x, y, z = (float(row.get(key, "0")) for key in ("Line", "Pixel", "X", "Y", "Z"))
            points.append(GroundControlPoint(line, pixel, x, y, z, row.get("Id"), row.get("Info")))
        return points, self._crs(self._vrt.gcp_srs)

    def tags(self) -> dict[str, str]:
        """Metadata of the default domain."""
        return dict(self._vrt.metadata.get("", {}))

    def block_windows(self, _band: int = 1) -> Iterator[tuple[tuple[int, int], Window]]:
        """Blocks that cover the raster."""
        for row, col in product(range(0, self.height, _BLOCK), range(0, self.width, _BLOCK)):
            size = min(_BLOCK, self.width - col), min(_BLOCK, self.height - row)
            yield (row // _BLOCK, col // _BLOCK), Window(col, row, *size)

    def read(
        self, indexes: int | Sequence[int] | None = None, window: Window | None = None, masked: bool = False
    ) -> Pixels:
        """Pixels of one band (H, W), or of several (bands, H, W); masked where they mean nothing, if asked."""
        wanted = [indexes] if isinstance(indexes, int) else list(indexes or self.indexes)
        box = self._box(window)
        pixels = np.stack([self._assembled(self._vrt.bands[i - 1], box) for i in wanted])
        if masked:
            mask = np.stack([self.read_masks(i, window) == 0 for i in wanted])
            pixels = np.ma.MaskedArray(pixels, mask=mask, fill_value=self.nodatavals[wanted[0] - 1])
        return pixels[0] if isinstance(indexes, int) else pixels

    def read_masks(self, index: int, window: Window | None = None) -> npt.NDArray[np.uint8]:
        """0 where a pixel of a band (H, W) means nothing: by the VRT's mask, nodata or alpha band."""
        box, band = self._box(window), self._vrt.bands[index - 1]
        if self._vrt.mask is not None:
            return np.asarray(self._assembled(self._vrt.mask, box), np.uint8)
        if band.nodata is not None:
            return np.where(_equal(self._assembled(band, box), band.nodata), 0, 255).astype(np.uint8)
        if ColorInterp.alpha in self.colorinterp and self.colorinterp[index - 1] != ColorInterp.alpha:
            alpha = self._vrt.bands[self.colorinterp.index(ColorInterp.alpha)]
            return np.asarray(self._assembled(alpha, box), np.uint8)
        return np.full((box[3], box[2]), 255, np.uint8)

    def dataset_mask(self) -> npt.NDArray[np.uint8]:
        """Largest of the bands' masks, of the whole raster."""
        return np.asarray(np.max([self.read_masks(i) for i in self.indexes], axis=0), np.uint8)

    def plain_source(self) -> Path | None:
        """The raster that the VRT shows whole, as it is and alone; None if there is no such."""
        files = {source.file for source in self._vrt.sources}
        if len(files) != 1:
            return None
        dataset = self._dataset(file := files.pop())
        whole = (0, 0, self.width, self.height)
        for band, mask in ((b, b is self._vrt.mask) for b in (*self._vrt.bands, self._vrt.mask) if b):
            source = Source(file, 1 if mask else self._vrt.bands.index(band) + 1, mask, whole, whole)
            found = [
                Source(s.file, s.band, s.mask, s.src or whole, s.dst or whole, s.plain) for s in band.sources
            ]
            if found != [source]:
                return None
        if (dataset.shape, dataset.dtypes) != (self.shape, self.dtypes):
            return None
        nodata = _numbers(dataset.nodatavals), _numbers(self.nodatavals)
        return file if np.array_equal(*nodata, equal_nan=True) else None

    # --- pixels ---------------------------------------------------------------------------------------------

    def _box(self, window: Window | None) -> Rect:
        if window is None:
            return 0, 0, self.width, self.height
        box = int(window.col_off), int(window.row_off), int(window.width), int(window.height)
        if min(box) < 0 or box[0] + box[2] > self.width or box[1] + box[3] > self.height:
            raise ImageError(
                f"{self.name}: window {box} is not inside the image of {self.width} x {self.height}"
            )
        return box

    def _dataset(self, file: Path) -> Any:
        if file not in self._open:
            if len(self._open) >= _MOST_OPEN:
                self._close()
            self._open[file] = self._stack.enter_context(self._opener(file))
        return self._open[file]

    def _assembled(self, band: Band, box: Rect) -> Pixels:
        dtype = _dtype(band.dtype)
        out = np.broadcast_to(_converted(np.array(band.fill), dtype), (box[3], box[2])).copy()
        for source in band.sources:
            if source.dst is None or _common(box, source.dst):
                self._paste(source, band, box, out)
        return out

    def _paste(self, source: Source, band: Band, box: Rect, out: Pixels) -> None:
        dataset = self._dataset(source.file)
        if source.band > dataset.count or source.band < 1:
            raise ImageError(f"{self.name}: there is no band {source.band} in {os.fspath(source.file)}")
        whole = (0, 0, dataset.width, dataset.height)
        src, dst = source.src or whole, source.dst or (0, 0, self.width, self.height)
        if src[2:] != dst[2:]:
            raise ImageError(
                f"{self.name}: the VRT resamples {os.fspath(source.file)}, which is not read; write it out as a GeoTIFF"
            )
        right, down = dst[0] - src[0], dst[1] - src[1]
        inside = _common(dst, (right, down, dataset.width, dataset.height))
        part = _common(box, inside) if inside else None
        if part is None:
            return
        window = Window(part[0] - right, part[1] - down, part[2], part[3])
        values = (dataset.read_masks if source.mask else dataset.read)(source.band, window=window)
        place = out[part[1] - box[1] :, part[0] - box[0] :][: part[3], : part[2]]
        keep, values = _handed_on(values, source, band.dtype)
        place[keep] = _converted(values, out.dtype)[keep]


def _handed_on(values: Pixels, source: Source, dtype: str) -> tuple[Any, Pixels]:
    """Which values a source hands on, as an index, and what they become."""
    keep: Any = ...
    if source.plain:
        return keep, values
    work = np.dtype(np.float64 if dtype in _WIDE else np.float32)
    if np.iscomplexobj(values):
        raise ImageError(f"{source.file}: complex values are not scaled; give the images the VRT is made of")
    values = values.astype(work)
    if source.nodata is not None:
        keep = ~_equal(values, source.nodata)
    if source.scale != (1.0, 0.0):
        with np.errstate(all="ignore"):
            values = (values.astype(np.float64) * source.scale[0] + source.scale[1]).astype(work)
    return keep, values


def _equal(values: Pixels, nodata: float) -> BoolArray:
    with np.errstate(all="ignore"):
        found: BoolArray = np.isnan(values) if np.isnan(nodata) else values == _as(values.dtype, nodata)
    return found


def _as(dtype: np.dtype[Any], value: float) -> Any:
    return dtype.type(value) if dtype.kind in "fc" else value


def _dtype(name: str) -> np.dtype[Any]:
    return np.dtype("complex64" if name == "complex_int16" else name)


def _converted(values: Pixels, dtype: np.dtype[Any]) -> Pixels:
    """Values of another type as GDAL makes them: rounded half away from zero and cut at the type's range."""
    if values.dtype == dtype:
        return values
    with np.errstate(all="ignore"):
        if np.iscomplexobj(values) and dtype.kind != "c":
            values = values.real
        if dtype.kind not in "iu":
            return values.astype(dtype)
        limits = np.iinfo(dtype)
        low, high = limits.min, limits.max
        if values.dtype.kind in "iu":
            own = np.iinfo(values.dtype)
            return values.clip(max(low, own.min), min(high, own.max)).astype(dtype)
        rounded = np.trunc(values + np.copysign(values.dtype.type(0.5), values))
        out = np.nan_to_num(rounded, nan=0.0).clip(low, high)
        return np.where(out >= high, high, np.where(out <= low, low, out.astype(dtype))).astype(dtype)


def _common(a: Rect, b: Rect) -> Rect | None:
    """The rectangle that two have in common."""
    left, top = max(a[0], b[0]), max(a[1], b[1])
    right, bottom = min(a[0] + a[2], b[0] + b[2]), min(a[1] + a[3], b[1] + b[3])
    return (left, top, right - left, bottom - top) if right > left and bottom > top else None


def _numbers(values: Sequence[float | None]) -> list[float]:
    """None apart from every number, and NaN equal to itself."""
    return [number for value in values for number in (float(value is None), 0.0 if value is None else value)]
