"""Keypoints: found tile by tile, the strongest of every cell kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, fields, replace
from itertools import islice
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from barpc.geodesy import Array
from barpc.options import TieOptions
from barpc.scene import BoolArray, IntArray, View
from barpc.tie.pairs import Area, Pair, shared_tiles
from barpc.tie.raster import CELL, Box, ByteImage, Stretch, grow, read_pixels, sample_stretch, tiles
from barpc.tie.tasks import Progress, ordered

PER_CELL = 40
"""Strongest keypoints kept in a cell."""
CONTRAST = 0.01
"""SIFT's contrast threshold."""
_DEFAULTS = TieOptions()
_MARGIN = 48  # px read around a tile, so that keypoints at its border are those of the whole image


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Points of an image that can be found again in another one."""

    xy: Array  # (N, 2) col, row [full-resolution px]
    scale: Array  # (N,) diameter of the neighbourhood described [px]
    angle: Array  # (N,) orientation, from the column axis towards the row axis [rad]
    response: Array  # (N,) strength, comparable within an image
    descriptors: npt.NDArray[np.uint8]  # (N, D) unit vectors times 255 (RootSIFT: square roots of SIFT's)

    def __len__(self) -> int:
        """Number of keypoints N."""
        return len(self.xy)

    def select(self, which: IntArray | BoolArray) -> Keypoints:
        """The keypoints of a mask or of indices."""
        return Keypoints(*(getattr(self, field.name)[which] for field in fields(self)))


def join(parts: Sequence[Keypoints]) -> Keypoints:
    """Keypoints of several tiles as one set; an empty set of none."""
    none = np.empty(0)
    parts = parts or [Keypoints(np.empty((0, 2)), none, none, none, np.empty((0, 128), np.uint8))]
    columns = (np.concatenate([getattr(p, field.name) for p in parts]) for field in fields(Keypoints))
    return Keypoints(*columns)


class Sift:
    """SIFT (Lowe 2004) with RootSIFT descriptors (Arandjelovic and Zisserman 2012)."""

    def __init__(self) -> None:
        self._sift: Any = cv2.SIFT.create(contrastThreshold=CONTRAST)

    def detect(self, picture: ByteImage, keep: Callable[[Array, Array, Array], BoolArray]) -> Keypoints:
        """Keypoints for which `keep(xy, scale, response)` is true; only those are described."""
        found = self._sift.detect(picture, None)
        if not found:  # OpenCV fails where there is nothing to describe
            return join([])
        kept = np.flatnonzero(keep(*_table(found)))
        described, raw = self._sift.compute(picture, [found[i] for i in kept])
        if raw is None:
            return join([])
        xy, scale, response = _table(described)
        root = np.sqrt(raw / np.maximum(np.abs(raw).sum(axis=1, keepdims=True), 1e-9))
        angle = np.radians([k.angle for k in described])
        return Keypoints(xy, scale, angle, response, np.rint(255 * root).astype(np.uint8))


def _table(found: Sequence[Any]) -> tuple[Array, Array, Array]:
    table = np.array([(*k.pt, k.size, k.response) for k in found], dtype=np.float64).reshape(-1, 4)
    return table[:, :2], table[:, 2], table[:, 3]


def detect_tile(
    path: str, size: tuple[int, int], box: Box, stretch: Stretch, options: TieOptions
) -> Keypoints:
    """Keypoints of one tile of an image of `size` (width, height), at most a quota a cell, sorted by row and column.

    Coordinates and `stretch` are those of the whole image.
    """
    cv2.setNumThreads(1)
    window = grow(box, _MARGIN, size)
    pixels, valid = read_pixels(path, window, options.band)
    if not valid.any():
        return join([])
    distance = cv2.distanceTransform(np.pad(valid, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    origin = np.array(window[:2], dtype=np.float64)

    def keep(xy: Array, scale: Array, response: Array) -> BoolArray:
        col, row = np.rint(xy).astype(int).T
        place = xy + origin
        inside = ((place >= np.array(box[:2]) - 0.5) & (place < np.add(box[:2], box[2:]) - 0.5)).all(axis=1)
        inside &= distance[row.clip(0, window[3] - 1), col.clip(0, window[2] - 1)] > np.maximum(3.0, scale)
        index = np.flatnonzero(inside)
        strongest = quota(place[index], response[index], CELL, PER_CELL)
        return np.isin(np.arange(len(xy)), index[strongest])

    found = Sift().detect(stretch.apply(pixels, valid), keep)
    found = found.select(np.lexsort((found.angle, found.xy[:, 0], found.xy[:, 1])))
    return replace(found, xy=found.xy + origin)


def quota(xy: Array, response: Array, cell: float, most: int) -> IntArray:
    """Indices of the strongest of points (N, 2) [px] in every cell of a side [px], at most so many each, ascending."""
    if not len(xy):
        return np.empty(0, dtype=np.int64)
    cells = np.floor((xy + 0.5) / cell).astype(np.int64)
    cells -= cells.min(axis=0)
    key = cells[:, 1] * (cells[:, 0].max() + 1) + cells[:, 0]
    order = np.lexsort((xy[:, 0], xy[:, 1], -response, key))
    starts = np.r_[True, key[order][1:] != key[order][:-1]]
    rank = np.arange(len(order)) - np.maximum.accumulate(np.where(starts, np.arange(len(order)), 0))
    kept: IntArray = np.sort(order[rank < most])
    return kept


def bounded(keypoints: Keypoints, options: TieOptions) -> Keypoints:
    """At most `keypoints_per_image` keypoints, the strongest of every cell, evenly."""
    most = PER_CELL
    while len(keypoints) > options.keypoints_per_image and most > 1:
        most = max(1, int(most * options.keypoints_per_image / len(keypoints)))
        keypoints = keypoints.select(quota(keypoints.xy, keypoints.response, CELL, most))
    if len(keypoints) > options.keypoints_per_image:
        strongest = np.argsort(-keypoints.response, kind="stable")[: options.keypoints_per_image]
        keypoints = keypoints.select(np.sort(strongest))
    return keypoints


def detect(
    views: Sequence[View],
    options: TieOptions = _DEFAULTS,
    *,
    pairs: Sequence[Pair] | None = None,
    area: Area | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> list[Keypoints]:
    """Keypoints of every view; none in an image in which nothing varies.

    With `pairs`, tiles that no partner may see are not read, nor those outside `area`; the rest as for `find_tracks`.
    """
    stretches = ordered(executor, sample_stretch, [(v.path, options.band) for v in views], "read", progress)
    boxes = [tiles(view.size, options) for view in views]
    if pairs is not None:
        boxes = shared_tiles(views, pairs, options, area)
    boxes = [of_view if stretch else [] for of_view, stretch in zip(boxes, stretches, strict=True)]
    each = zip(views, stretches, boxes, strict=True)
    tasks = [
        (view.path, view.size, box, stretch, options) for view, stretch, of_view in each for box in of_view
    ]
    found = iter(ordered(executor, detect_tile, tasks, "detect", progress))
    return [bounded(join(list(islice(found, len(of_view)))), options) for of_view in boxes]
