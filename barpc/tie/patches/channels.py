"""Contrast-blind dense matching: patches as channels of oriented gradients, correlated.

Where a season, a sun or a sensor changes grey values, edges keep their place and their direction, not their sign. Every
pixel becomes its gradient with twice its angle, which is the same for both signs, blurred over neighbours and
normalised: what has no direction says nothing. These are two numbers; more orientations (CFOG, Ye et al. 2019) say
no more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce

import cv2
import numpy as np
from rasterio import Affine
from rasterio.crs import CRS

from barpc.base.errors import InputError
from barpc.base.frozen import Frozen
from barpc.base.geodesy import Array, metres_per_unit
from barpc.rasters.raster import open_raster, reprojected, transformed
from barpc.scene import BoolArray, IntArray, View
from barpc.tie.pairing.overlaps import Terrain
from barpc.tie.pixels import FloatImage, OpenReaders, grow, levelled

_BLUR = 0.75  # px: of pictures before the gradients, and of channels
_WEAK = 0.5  # of the median gradient: what is weaker is noise
INVALID_MARGIN = 6
"""Pixels so near to invalid ones know of them [px]; so far beside a search area, where true peaks end, decoys lie."""


def channels(pixels: FloatImage, valid: BoolArray) -> FloatImage:
    """Return the channels (2, H, W) of a picture (H, W); zeros beside what is not valid."""
    cv2.setNumThreads(1)
    filled = np.where(valid, pixels, np.float32(pixels[valid].mean() if valid.any() else 0.0))
    smooth = cv2.GaussianBlur(filled.astype(np.float32), (0, 0), _BLUR)
    east, south = cv2.Scharr(smooth, cv2.CV_32F, 1, 0), cv2.Scharr(smooth, cv2.CV_32F, 0, 1)
    length = np.sqrt(east**2 + south**2)
    doubled = np.stack([east**2 - south**2, 2.0 * east * south]) / (length + np.float32(1e-12))
    found = np.stack([cv2.GaussianBlur(part, (0, 0), _BLUR) for part in doubled])
    size = cv2.GaussianBlur(length, (0, 0), _BLUR)
    known = cv2.erode(valid.astype(np.uint8), np.ones((2 * INVALID_MARGIN + 1,) * 2, np.uint8), borderValue=1) > 0
    weak = _WEAK * float(np.median(size[known])) if known.any() else 0.0
    return np.asarray(found * (known / (size + np.float32(weak + 1e-12))), np.float32)


def correlation(template: FloatImage, search: FloatImage) -> FloatImage:
    """Return the correlations (B, H - h + 1, W - w + 1) of templates (B, C, h, w) within areas (B, C, H, W)."""
    (h, w), (height, width) = template.shape[2:], search.shape[2:]
    from scipy import fft  # of structure alone

    size = fft.next_fast_len(height, real=True), fft.next_fast_len(width, real=True)
    spectrum = (fft.rfft2(search, size) * fft.rfft2(template, size).conj()).sum(axis=1)
    product = fft.irfft2(spectrum, size)[:, : height - h + 1, : width - w + 1]
    inner = np.s_[h // 2 : height - (h - 1) // 2, w // 2 : width - (w - 1) // 2]
    energy = (cv2.boxFilter(one, -1, (w, h), normalize=False)[inner] for one in (search**2).sum(axis=1))
    here = np.stack([*energy])
    own = (template.astype(np.float64) ** 2).sum(axis=(1, 2, 3))
    scale = np.sqrt(np.maximum(here, 0.02 * own[:, None, None]) * own[:, None, None])  # little there: no ratio
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.nan_to_num(product / scale), np.float32)


def windows_around(picture: FloatImage, at: IntArray, wide: int, high: int) -> FloatImage:
    """Return the windows (n, C, 2 high + 1, 2 wide + 1) around whole px x, y (n, 2)."""
    view = np.lib.stride_tricks.sliding_window_view(picture, (2 * high + 1, 2 * wide + 1), axis=(1, 2))
    return np.moveaxis(view[:, at[:, 1] - high, at[:, 0] - wide], 0, 1)


_NODE = 8  # px between exact projections; straight lines between them


@dataclass(frozen=True, eq=False, repr=False)
class Patch(Frozen):
    """A grid on the ground, rows to the south.

    Parameters
    ----------
    lonlat : (2,), of its first pixel [deg]
    step : float [m]
    shape : (int, int), rows, columns
    heights : (m, n), of the terrain at its nodes [m above the ellipsoid]
    moved : (2,), how far a camera shows everything from its place, east, north [m]
    """

    lonlat: Array
    step: float
    shape: tuple[int, int]
    heights: Array
    moved: Array

    @classmethod
    def on(cls, terrain: Terrain, lonlat: Array, step: float, shape: tuple[int, int], moved: Array) -> Patch:
        """Return a patch with the heights of a terrain."""
        nodes = _nodes(lonlat, step, shape)
        return cls(lonlat, step, shape, terrain(nodes[..., 0], nodes[..., 1]), moved)

    def nodes(self) -> Array:
        """Return the lon, lat (m, n, 2) [deg] of the nodes."""
        return _nodes(self.lonlat, self.step, self.shape)

    def image(self, view: View) -> Array:
        """Return the image points (m, n, 2) [px] of the nodes by a view whose camera is off by `moved`."""
        lonlat = self.nodes() + self.moved / metres_per_unit(np.append(self.lonlat, 0.0))[:2]
        return view.sensor.project(np.concatenate([lonlat, self.heights[..., None]], axis=2))

    def seen(self, view: View, at: Array) -> Array:
        """Return the image points (n, 2) [px] of places x, y (n, 2) [px] of the grid; NaN beside an unknown node."""
        rows, cols, nodes = _between(at[:, 1], self.shape[0]), _between(at[:, 0], self.shape[1]), self.image(view)
        known = _known_nodes(nodes)
        found = np.einsum("nr,rck,nc->nk", rows, np.where(known[..., None], nodes, 0.0), cols)
        found[np.einsum("nr,rc,nc->n", rows, 1.0 - known, cols) > 0] = np.nan
        return np.asarray(found)


def ticks(count: int) -> Array:
    """Return the positions of the nodes of an axis of `count` px [px]."""
    return np.linspace(0.0, count - 1.0, -(-(count - 1) // _NODE) + 1)


def _between(at: Array, count: int) -> Array:
    """Return the weights (n, nodes) of the nodes along an axis of `count` px for places (n,)."""
    nodes = ticks(count)
    return np.stack([np.interp(at, nodes, row) for row in np.eye(len(nodes))], axis=1)


@lru_cache(maxsize=64)
def _between_all(count: int) -> Array:
    """Return the weights (count, nodes) of the nodes along an axis for each of its px."""
    weights = _between(np.arange(count, dtype=np.float64), count)
    weights.flags.writeable = False
    return weights


def _known_nodes(nodes: Array) -> BoolArray:
    """Return the nodes (m, n) of which both coordinates (m, n, 2) are known."""
    return np.asarray(np.isfinite(nodes).all(axis=2))


def _nodes(lonlat: Array, step: float, shape: tuple[int, int]) -> Array:
    metres = metres_per_unit(np.append(lonlat, 0.0))[:2]
    lon = lonlat[0] + step * ticks(shape[1]) / metres[0]
    lat = lonlat[1] - step * ticks(shape[0]) / metres[1]
    return np.stack(np.meshgrid(lon, lat), axis=2)


@dataclass(frozen=True, eq=False)
class Sheet:
    """An orthoimage and its map projection."""

    path: str
    crs: CRS
    to_pixel: Affine
    size: tuple[int, int]
    bands: tuple[int, ...]  # that are averaged

    @classmethod
    def read(cls, path: str) -> Sheet:
        """Read an orthoimage from any raster with a CRS; else an InputError."""
        with open_raster(path) as dataset:
            crs, forward, size = dataset.crs, dataset.transform, (dataset.width, dataset.height)
            bands = (1, 2, 3) if dataset.count >= 3 else (1,)
        if crs is None or not abs(forward.determinant) > 0:
            raise InputError(f"{path}: a reference is an orthoimage, and this raster has no place on the ground")
        return cls(path, crs, ~forward, size, bands)

    def image(self, lonlat: Array) -> Array:
        """Return the col, row (..., 2) [px] of lon, lat (..., 2) [deg]."""
        places = reprojected(self.path, CRS.from_epsg(4326), self.crs, *lonlat.reshape(-1, 2).T)
        return np.stack(transformed(self.to_pixel, *places), axis=1).reshape(lonlat.shape) - 0.5

    def shows(self, lonlat: Array) -> BoolArray:
        """Return whether places (..., 2) [deg] lie on the orthoimage."""
        at = self.image(lonlat)
        return np.asarray(((at >= 0) & (at <= np.array(self.size) - 1.0)).all(axis=-1))

    def step(self, lonlat: Array) -> float:
        """Return the pixel size at a place (2,) [m]."""
        metres = metres_per_unit(np.append(lonlat, 0.0))[:2]
        at = self.image(lonlat + np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]]) / metres)
        return float(10.0 / np.sqrt(abs(np.linalg.det(at[1:] - at[0]))))


def of_image(view: View, band: int, patch: Patch) -> FloatImage:
    """Return the channels (C, H, W) of an image on a patch, through its camera."""
    return channels(*picture(view.path, (band,), view.size, patch.image(view), patch.shape))


def of_reference(paths: Sequence[str], patch: Patch) -> FloatImage:
    """Return the channels (C, H, W) of a patch, of the first of several orthoimages that shows a place."""
    nodes = patch.nodes()
    each = (
        channels(*picture(sheet.path, sheet.bands, sheet.size, sheet.image(nodes), patch.shape))
        for sheet in map(Sheet.read, paths)
    )
    return reduce(lambda first, other: np.where(first.any(axis=0), first, other), each)


def picture_share(picture: FloatImage) -> float:
    """Return the share of the pixels of channels (C, H, W) that are not empty."""
    return float((np.abs(picture).sum(axis=0) > 0).mean())


def picture(
    path: str,
    bands: Sequence[int],
    size: tuple[int, int],
    nodes: Array,
    shape: tuple[int, int],
    readers: OpenReaders | None = None,
) -> tuple[FloatImage, BoolArray]:
    """Resample a raster to a grid (H, W) with nodes (m, n, 2) at its col, row [px]; return also valid pixels.

    Where it is finer than the grid, it is averaged first. What lies between nodes of which one is NaN is not valid.
    """
    nothing = np.zeros(shape, np.float32), np.zeros(shape, dtype=bool)
    known = _known_nodes(nodes)
    if not (known[1:, 1:] & known[:-1, 1:] & known[1:, :-1]).any():
        return nothing
    low, high = np.floor(nodes[known].min(axis=0)).astype(int), np.ceil(nodes[known].max(axis=0)).astype(int)
    if (high < 0).any() or (low >= size).any():
        return nothing
    pixels = (np.array(shape) - 1) / (np.array(known.shape) - 1)  # between nodes
    sides = [np.nanmedian(np.diff(nodes, axis=axis), axis=(0, 1)) / pixels[axis] for axis in (0, 1)]
    apart = float(np.sqrt(abs(np.linalg.det(np.stack(sides)))))
    thin = max(1, int(apart))
    if min(size) < thin:
        return nothing
    low, high = low // thin, high // thin
    box = grow((int(low[0]), int(low[1]), *(high - low + 1).tolist()), 4, (size[0] // thin, size[1] // thin))
    with OpenReaders() as own:
        each = [(readers or own).of(path, band, size, thin).read(box) for band in bands]
    valid = np.all([known for _, known in each], axis=0)
    if not valid.any():
        return nothing
    picture = np.asarray(sum(levelled(pixels, known) for pixels, known in each), np.float32)
    picture[~valid] = picture[valid].mean()
    cv2.setNumThreads(1)
    if (left := apart / thin) > 1.0:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.5 * (left**2 - 1.0) ** 0.5), np.float32)
    rows, cols = (_between_all(n) for n in shape)
    nodes = (np.where(known[..., None], nodes, 0.0) + 0.5) / thin - 0.5 - box[:2]
    x, y = ((rows @ nodes[..., i] @ cols.T).astype(np.float32) for i in (0, 1))
    found = cv2.remap(picture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    lacking = cv2.remap(
        (~valid).astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0
    )
    within = known.all() or rows @ (1.0 - known) @ cols.T == 0.0
    return np.asarray(found, np.float32), np.asarray((lacking == 0.0) & within)
