"""The raster that a VRT, or a list of tiles, describes: pixels put together of its sources."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rasterio import Affine
from rasterio.control import GroundControlPoint
from rasterio.coords import BoundingBox
from rasterio.crs import CRS
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.errors import CRSError
from rasterio.transform import array_bounds
from rasterio.windows import Window

from barpc.base.errors import ImageError
from barpc.rasters.crs import plain_crs
from barpc.rasters.raster import BLOCK_SIZE
from barpc.rasters.vrt import Band, Rect, Source, Vrt

PixelArray = npt.NDArray[Any]

_MOST_OPEN = 64
_WIDE = ("int32", "uint32", "int64", "uint64", "float64")  # GDAL scales them as float64, others as float32


class Mosaic:
    """A VRT, called `name`, opened for reading, with the methods of a dataset in use here, under rasterio's names.

    A list of tiles is one, too.
    """

    def __init__(self, name: str, vrt: Vrt, opener: Callable[[Path], Any]) -> None:
        self.name, self.vrt, self._opener = name, vrt, opener
        self._stack, self._open = ExitStack(), dict[Path, Any]()
        self.width, self.height = vrt.size
        self.shape, self.count = (self.height, self.width), len(vrt.bands)
        self.indexes = tuple(range(1, self.count + 1))
        self.dtypes = tuple(band.dtype for band in vrt.bands)
        self.nodatavals = tuple(band.nodata for band in vrt.bands)
        self.nodata = self.nodatavals[0]
        self.scales, self.offsets = zip(*(band.linear for band in vrt.bands), strict=True)
        self.block_shapes = [(min(BLOCK_SIZE, self.height), min(BLOCK_SIZE, self.width))] * self.count
        names = ColorInterp.__members__
        self.colorinterp = tuple(names.get(band.color, ColorInterp.undefined) for band in vrt.bands)
        self.crs = self._crs(vrt.srs)
        self.transform = Affine.from_gdal(*vrt.transform) if vrt.transform else Affine.identity()
        self.bounds = BoundingBox(*array_bounds(self.height, self.width, self.transform))
        self.mask_flag_enums = ([MaskFlags.per_dataset if vrt.mask else MaskFlags.all_valid],) * self.count

    def __enter__(self) -> Mosaic:
        return self

    def __exit__(self, *failure: object) -> None:
        self._open.clear()
        self._stack.close()

    def _crs(self, text: str) -> CRS | None:
        try:
            return CRS.from_string(plain_crs(text, self.name, ImageError)) if text else None
        except CRSError as error:
            raise ImageError(f"{self.name}: the VRT's coordinate system cannot be read ({error})") from error

    @property
    def units(self) -> tuple[str | None, ...]:
        """Units of the bands: of their first source where the VRT states none, as gdalbuildvrt leaves them out."""
        firsts = [(band.unit, next(iter(band.sources), None)) for band in self.vrt.bands]
        return tuple(
            self._of_source(source).units[source.band - 1] if unit is None and source else unit
            for unit, source in firsts
        )

    @property
    def gcps(self) -> tuple[list[GroundControlPoint], CRS | None]:
        """Ground control points and their CRS."""
        points = []
        for row in self.vrt.gcps:
            line, pixel, x, y, z = (float(row.get(key, "0")) for key in ("Line", "Pixel", "X", "Y", "Z"))
            points.append(GroundControlPoint(line, pixel, x, y, z, row.get("Id"), row.get("Info")))
        return points, self._crs(self.vrt.gcp_srs)

    def tags(self, ns: str | None = None) -> dict[str, str]:
        """Return the metadata of a domain, by default of that without a name."""
        return dict(self.vrt.metadata.get(ns or "", {}))

    def read(
        self, indexes: int | Sequence[int] | None = None, window: Window | None = None, masked: bool = False
    ) -> PixelArray:
        """Read the pixels of one band (H, W), or of several (bands, H, W); masked where they mean nothing, if asked."""
        wanted = [indexes] if isinstance(indexes, int) else list(indexes or self.indexes)
        box = self._box(window)
        pixels = np.stack([self._assembled(self.vrt.bands[i - 1], box) for i in wanted])
        if masked:
            mask = np.stack([self.read_masks(i, window) == 0 for i in wanted])
            pixels = np.ma.MaskedArray(pixels, mask=mask, fill_value=self.nodatavals[wanted[0] - 1])
        return pixels[0] if isinstance(indexes, int) else pixels

    def read_masks(self, index: int, window: Window | None = None) -> npt.NDArray[np.uint8]:
        """Read the mask of a band (H, W), 0 where a pixel is invalid: by the VRT's mask, nodata or alpha band."""
        box, band = self._box(window), self.vrt.bands[index - 1]
        if self.vrt.mask is not None:
            return np.asarray(self._assembled(self.vrt.mask, box), np.uint8)
        if band.nodata is not None:
            return np.where(_equal(self._assembled(band, box), band.nodata), 0, 255).astype(np.uint8)
        if ColorInterp.alpha in self.colorinterp and self.colorinterp[index - 1] != ColorInterp.alpha:
            alpha = self.vrt.bands[self.colorinterp.index(ColorInterp.alpha)]
            return np.asarray(self._assembled(alpha, box), np.uint8)
        return np.full((box[3], box[2]), 255, np.uint8)

    def _box(self, window: Window | None) -> Rect:
        if window is None:
            return 0, 0, self.width, self.height
        box = int(window.col_off), int(window.row_off), int(window.width), int(window.height)
        if min(box) < 0 or box[0] + box[2] > self.width or box[1] + box[3] > self.height:
            raise ImageError(f"{self.name}: window {box} is not inside the image of {self.width} x {self.height}")
        return box

    def _dataset(self, file: Path) -> Any:
        if file not in self._open:
            if len(self._open) >= _MOST_OPEN:
                self.__exit__()
            self._open[file] = self._stack.enter_context(self._opener(file))
        return self._open[file]

    def _of_source(self, source: Source) -> Any:
        dataset = self._dataset(source.file)
        if source.band > dataset.count or source.band < 1:
            raise ImageError(f"{self.name}: there is no band {source.band} in {os.fspath(source.file)}")
        return dataset

    def _assembled(self, band: Band, box: Rect) -> PixelArray:
        dtype = np.dtype("complex64" if band.dtype == "complex_int16" else band.dtype)
        out = np.broadcast_to(_converted(np.array(band.fill), dtype), (box[3], box[2])).copy()
        for source in band.sources:
            if source.dst is None or _intersection(box, source.dst):
                self._paste(source, band, box, out)
        return out

    def _paste(self, source: Source, band: Band, box: Rect, out: PixelArray) -> None:
        dataset = self._of_source(source)
        whole = (0, 0, dataset.width, dataset.height)
        src, dst = source.src or whole, source.dst or (0, 0, self.width, self.height)
        if src[2:] != dst[2:]:
            raise ImageError(
                f"{self.name}: {os.fspath(source.file)} is {src[2]} x {src[3]} px and would be resampled to {dst[2]} x "
                f"{dst[3]} px, which is not done; write it out as a GeoTIFF"
            )
        right, down = dst[0] - src[0], dst[1] - src[1]
        inside = _intersection(dst, (right, down, dataset.width, dataset.height))
        part = _intersection(box, inside) if inside else None
        if part is None:
            return
        window = Window(part[0] - right, part[1] - down, part[2], part[3])
        values = (dataset.read_masks if source.mask else dataset.read)(source.band, window=window)
        place = out[part[1] - box[1] :, part[0] - box[0] :][: part[3], : part[2]]
        keep, values = _handed_on(values, source, band.dtype)
        place[keep] = _converted(values, out.dtype)[keep]


def _handed_on(values: PixelArray, source: Source, dtype: str) -> tuple[Any, PixelArray]:
    """Return the mask of valid values of a source, and their converted values."""
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


def _equal(values: PixelArray, nodata: float) -> npt.NDArray[np.bool_]:
    with np.errstate(all="ignore"):
        wanted = values.dtype.type(nodata) if values.dtype.kind in "fc" else nodata
        found: npt.NDArray[np.bool_] = np.isnan(values) if np.isnan(nodata) else values == wanted
    return found


def _converted(values: PixelArray, dtype: np.dtype[Any]) -> PixelArray:
    """Convert values to another type as GDAL does: rounded half away from zero and cut at the type's range."""
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


def _intersection(a: Rect, b: Rect) -> Rect | None:
    left, top = max(a[0], b[0]), max(a[1], b[1])
    right, bottom = min(a[0] + a[2], b[0] + b[2]), min(a[1] + a[3], b[1] + b[3])
    return (left, top, right - left, bottom - top) if right > left and bottom > top else None
