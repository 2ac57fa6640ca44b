"""Keypoints: detected tile by tile, evenly by a quota, stored in files for the matching of pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar

import cv2
import numpy as np
import numpy.typing as npt

from barpc.base.fields import field_names, field_values
from barpc.base.frozen import join_fields
from barpc.base.geodesy import Array, Box, ByteImage
from barpc.base.options import TIE_DEFAULTS, TieOptions
from barpc.base.statistics import MANY
from barpc.base.tasks import Store, Work, names_of
from barpc.scene import BoolArray, IntArray, View
from barpc.tie.pairing.area import Area
from barpc.tie.pairing.overlaps import Pair, shared_tiles
from barpc.tie.pixels import CELL, Survey, grow, read_picture, survey, tiles

PER_CELL = 40
"""Strongest keypoints kept in a cell."""
PER_IMAGE = 100_000
"""Keypoints an image, at most; its cells hold fewer where more would be found."""
CONTRAST = 0.01
"""SIFT's contrast threshold."""
AMPLE = 5
"""Keypoints for each tie point wanted."""
_ZOOMS = ((1.25e-4, 4), (2e-3, 2))
"""Keypoints wanted a px, below which so many pixels a side are looked at as one: real images hold 1200e-6, 4500e-6."""
_HOLDS = {2: 4.5e-3, 4: 1.2e-3}  # keypoints a px that real images hold, looked at so
_PART = 0.1
"""Verified matches of a pair that make a closer look needless, as a part of the points wanted of an image, at least
`MANY`: with 250 tracks in place of 3664 three real pairs meet check points alike, to 0.139, 0.154, 0.129 px."""
_MIN_KEYPOINT_RATIO = 4.0
"""Keypoints that images are to hold for each of these, or nothing is gained; the triplet has 2.1 to 2.5."""
_TILES_KEPT = 32  # in a process's memory, of about a megabyte


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of an image with descriptors."""

    xy: Array  # (N, 2) col, row [full-resolution px]
    scale: Array  # (N,) diameter of the neighbourhood described [px]
    angle: Array  # (N,) orientation, from the column axis towards the row axis [rad]
    response: Array  # (N,) strength, comparable within an image
    descriptors: npt.NDArray[np.uint8]  # (N, D) unit vectors times 255 (RootSIFT: square roots of SIFT's)

    def __len__(self) -> int:
        """Number of keypoints N."""
        return len(self.xy)

    def select(self, which: IntArray | BoolArray) -> Keypoints:
        """Return the keypoints of a mask or of indices."""
        return Keypoints(*(column[which] for column in field_values(self).values()))

    def strongest(self, most: int) -> Keypoints:
        """Return the `most` strongest keypoints."""
        return self.select(np.argsort(-self.response, kind="stable")[:most])

    boxes: ClassVar[tuple[Box, ...]] = ()  # of tiles: there are none in memory

    def load(self, _: Sequence[Box] = ()) -> tuple[Keypoints, IntArray]:
        """Return all keypoints and their numbers; the interface of `KeypointFiles`."""
        return self, np.arange(len(self))


def join_keypoints(parts: Sequence[Keypoints]) -> Keypoints:
    """Join the keypoints of several tiles; an empty set of none."""
    none = np.empty(0)
    parts = parts or [Keypoints(np.empty((0, 2)), none, none, none, np.empty((0, 128), np.uint8))]
    return Keypoints(**join_fields(parts))


class Sift:
    """SIFT (Lowe 2004) with RootSIFT descriptors (Arandjelovic and Zisserman 2012)."""

    def __init__(self) -> None:
        self._sift: Any = cv2.SIFT.create(contrastThreshold=CONTRAST)

    def detect(self, picture: ByteImage, keep: Callable[[Array, Array, Array], IntArray]) -> Keypoints:
        """Detect keypoints, of which `keep(xy, scale, response)` gives the indices; only those are described."""
        found = self._sift.detect(picture, None)
        if not found:  # OpenCV fails where there is nothing to describe
            return join_keypoints([])
        kept = keep(*_keypoint_arrays(found))
        described, raw = self._sift.compute(picture, [_an_octave_up(found[i]) for i in kept])
        if raw is None:
            return join_keypoints([])
        xy, scale, response = _keypoint_arrays(described)
        root = np.sqrt(raw / np.maximum(np.abs(raw).sum(axis=1, keepdims=True), 1e-9))
        angle = np.radians([k.angle for k in described])
        return Keypoints(xy, scale, angle, response, np.rint(255 * root).astype(np.uint8))


def _an_octave_up(keypoint: Any) -> Any:
    """Return a keypoint with its octave raised by one: a quarter of the samples describe it, as distinctly.

    OpenCV packs the octave (signed) and its picture, 1 to 3, into a byte each; picture 3 is the next octave's 0.
    """
    octave = keypoint.octave
    keypoint.octave = octave & ~0xFFFF | (octave + 1) & 0xFF | max(((octave >> 8) & 0xFF) - 3, 0) << 8
    return keypoint


def _keypoint_arrays(found: Sequence[Any]) -> tuple[Array, Array, Array]:
    table = np.array([(*k.pt, k.size, k.response) for k in found], dtype=np.float64).reshape(-1, 4)
    return table[:, :2], table[:, 2], table[:, 3]


@dataclass(frozen=True)
class KeypointDensity:
    """Density and resolution at which the keypoints of a tile are detected."""

    density: float  # keypoints a px of the image
    zoom: int = 1  # px of the image a side of a pixel that is looked at
    tile: int = TIE_DEFAULTS.tile  # side of the parts that share a quota [px of that size]

    @staticmethod
    def of(size: tuple[int, int], options: TieOptions, coarse: bool = False) -> KeypointDensity:
        """Return the density for an image of `size` (width, height); `coarse`: at reduced resolution."""
        area = size[0] * size[1]
        wanted = min(PER_IMAGE, AMPLE * options.points_per_image) / area
        zooms = (zoom for below, zoom in _ZOOMS if wanted < below and min(size) > zoom * options.tile)
        zoom = next(zooms, 1)
        if coarse:
            return KeypointDensity(wanted, min(2 * zoom, max(_HOLDS)), options.tile)
        return KeypointDensity(PER_IMAGE / area, zoom, options.tile)

    def expected(self, size: tuple[int, int]) -> float:
        """Estimate the number of keypoints of an image of `size` (width, height) with detail all over."""
        return min(self.density, _HOLDS.get(self.zoom, np.inf)) * size[0] * size[1]

    def within(self, used: float) -> KeypointDensity:
        """Return the density where only a part of the image is used, in powers of two, so that it seldom changes."""
        return replace(self, density=self.density * 2.0 ** float(np.floor(-np.log2(min(max(used, 1e-6), 1.0)))))

    def most(self, box: Box) -> int:
        """Return the largest number of keypoints of a box."""
        return int(self.density * box[2] * box[3] + 1e-6)

    @property
    def cell(self) -> int:
        """Side of the quota's cells [px]: about one keypoint each at a low density."""
        return CELL * max(1, round(float(np.sqrt(1.0 / self.density)) / CELL))


def ample_matches(points_per_image: int) -> int:
    """Return the number of verified matches at reduced resolution that replaces matching at full resolution."""
    return max(MANY, int(np.ceil(_PART * points_per_image)))


def worth_a_first_look(sizes: Sequence[tuple[int, int]], options: TieOptions) -> bool:
    """Return whether images of `sizes` (width, height) are large enough to be matched at reduced resolution first."""
    needed = _MIN_KEYPOINT_RATIO * ample_matches(options.points_per_image)
    return all(KeypointDensity.of(size, options, coarse=True).expected(size) >= needed for size in sizes)


def detect_tile(path: str, size: tuple[int, int], box: Box, found: Survey, share: KeypointDensity) -> Keypoints:
    """Detect the keypoints of one tile of an image of `size` (width, height), the most important first.

    Coordinates and `found` are those of the whole image.
    """
    cv2.setNumThreads(1)
    zoom = share.zoom
    window = box if found.levels else grow(box, zoom * CELL, size)
    picture, valid = read_picture(path, window, found, zoom)
    middle = 0.0 if found.levels else 0.5 * (zoom - 1)  # a wavelet's level holds the even pixels
    parts, side = [], zoom * share.tile
    for row in range(box[1], box[1] + box[3], side):
        for col in range(box[0], box[0] + box[2], side):
            part = (col, row, min(side, box[0] + box[2] - col), min(side, box[1] + box[3] - row))
            near = grow((col - window[0], row - window[1], *part[2:]), zoom * CELL, window[2:])
            left, top, right, below = (n // zoom for n in (near[0], near[1], near[0] + near[2], near[1] + near[3]))
            place = slice(top, below), slice(left, right)
            if valid[place].any():
                origin = np.array([window[0] + zoom * left + middle, window[1] + zoom * top + middle])
                parts.append(_detect_part(picture[place], valid[place], part, origin, share))
    every = join_keypoints(parts)
    return every.select(ranked(every.xy, every.response, share.cell, len(every)))


def _detect_part(picture: ByteImage, valid: BoolArray, part: Box, origin: Array, share: KeypointDensity) -> Keypoints:
    """Return the keypoints inside a part of an image; the first pixel's centre is at `origin` [px]."""
    inner = np.array(part[:2]) - 0.5, np.add(part[:2], part[2:]) - 0.5
    distance = None
    if not valid.all():
        distance = cv2.distanceTransform(np.pad(valid, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]

    def keep(xy: Array, scale: Array, response: Array) -> IntArray:
        place = share.zoom * xy + origin
        inside = ((place >= inner[0]) & (place < inner[1])).all(axis=1)
        end = np.array(picture.shape[::-1]) - 1
        away = np.minimum(xy, end - xy).min(axis=1) + 1.0
        if distance is not None:
            col, row = np.rint(xy).astype(int).clip(0, end).T
            away = distance[row, col]
        index = np.flatnonzero(inside & (away > np.maximum(3.0, scale)))
        index = index[quota(place[index], response[index], CELL, PER_CELL)]
        return index[ranked(place[index], response[index], share.cell, share.most(part))]

    found = Sift().detect(picture, keep)
    return replace(found, xy=share.zoom * found.xy + origin, scale=share.zoom * found.scale)


def _cell_ranks(xy: Array, response: Array, cell: float) -> IntArray:
    """Return the rank, from 0, of every point (N, 2) [px] by strength within its cell."""
    cells = np.floor((xy + 0.5) / cell).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    key = cells[:, 1] * (cells[:, 0].max(initial=0) + 1) + cells[:, 0]
    order = np.lexsort((xy[:, 0], xy[:, 1], -response, key))
    starts = np.diff(key[order], prepend=-1) != 0
    rank = np.empty(len(order), dtype=np.int64)
    each = np.arange(len(order))
    rank[order] = each - np.maximum.accumulate(np.where(starts, each, 0))
    return rank


def quota(xy: Array, response: Array, cell: float, most: int) -> IntArray:
    """Return the indices, ascending, of the `most` strongest points (N, 2) [px] of every cell."""
    return np.flatnonzero(_cell_ranks(xy, response, cell) < most)


def ranked(xy: Array, response: Array, cell: float, most: int) -> IntArray:
    """Return the indices of `most` points (N, 2) [px]: the strongest of every cell, then the second, and so on."""
    order = np.lexsort((xy[:, 0], xy[:, 1], -response, _cell_ranks(xy, response, cell)))
    return order[:most]


@dataclass(frozen=True)
class KeypointFiles:
    """Keypoints of a view stored in files, a tile each; `counts` of them, the first, are used."""

    store: Store
    boxes: tuple[Box, ...] = ()
    names: tuple[str, ...] = ()
    counts: tuple[int, ...] = ()
    start: int = 0  # the number of the first

    def __len__(self) -> int:
        """Number of keypoints."""
        return sum(self.counts)

    def strongest(self, most: int) -> KeypointFiles:
        """Return about `most` keypoints, the same share of every tile."""
        share = min(1.0, most / max(len(self), 1))
        return replace(self, counts=tuple(int(np.ceil(share * count)) for count in self.counts))

    def load(self, wanted: Sequence[Box] | None = None) -> tuple[Keypoints, IntArray]:
        """Return the keypoints of some tiles (None: of all), by row and column in a tile, and their numbers."""
        parts, numbers, first = [], [np.empty(0, dtype=np.int64)], self.start
        chosen = set(self.boxes if wanted is None else wanted)
        for box, name, count in zip(self.boxes, self.names, self.counts, strict=True):
            if count and box in chosen:
                kept, order = _kept_tile(self.store, name, box, count)
                parts.append(kept)
                numbers.append(first + order)
            first += count
        return join_keypoints(parts), np.concatenate(numbers)


@lru_cache(maxsize=_TILES_KEPT)
def _kept_tile(store: Store, name: str, box: Box, count: int) -> tuple[Keypoints, IntArray]:
    """Return the first keypoints of a tile, by row and column, and their numbers: pair after pair asks for them."""
    kept = _unpacked(store.need(name), box).select(np.arange(count))
    order = np.lexsort((kept.angle, kept.xy[:, 0], kept.xy[:, 1]))
    return kept.select(order), order


def keep_tile(store: Store, name: str, task: tuple[str, tuple[int, int], Box, Survey, KeypointDensity]) -> int:
    """Detect the keypoints of a tile by `detect_tile(*task)` and keep them in the store; return their number."""
    known = store.read(name)
    if known is not None and "xy" in known:
        return len(known["xy"])
    keypoints = detect_tile(*task)
    store.write(name, _packed(keypoints, task[2]))
    return len(keypoints)


def _packed(keypoints: Keypoints, box: Box) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of 148 bytes a keypoint; places count from the tile's corner."""
    values = field_values(replace(keypoints, xy=keypoints.xy - np.array(box[:2])))
    return {name: v.astype(np.float32) if v.dtype == np.float64 else v for name, v in values.items()}


def _unpacked(arrays: dict[str, npt.NDArray[Any]], box: Box) -> Keypoints:
    described = np.asarray(arrays["descriptors"], np.uint8)
    xy, scale, angle, response = (np.asarray(arrays[name], np.float64) for name in field_names(Keypoints)[:4])
    return Keypoints(xy + np.array(box[:2]), scale, angle, response, described)


def locate(
    views: Sequence[View],
    options: TieOptions,
    work: Work,
    *,
    pairs: Sequence[Pair] | None = None,
    area: Area | None = None,
    coarse: bool = False,
) -> list[KeypointFiles]:
    """Detect the keypoints of every view into files of the store; none in an image in which nothing varies.

    With `pairs`, tiles that no partner may see are not read, nor those outside `area`; with `coarse` images are looked
    at in less detail, and for fewer keypoints.
    """
    assert work.store is not None
    found = work.ordered(survey, [(v.path, options.band, v.size) for v in views], "read")
    shares = [KeypointDensity.of(view.size, options, coarse) for view in views]
    each = zip(views, found, shares, strict=True)
    boxes = [tiles(v.size, options.tile, share.zoom, known) if known else [] for v, known, share in each]
    if pairs is not None:
        boxes = shared_tiles(views, pairs, boxes, options.search, area)
    used = [sum(b[2] * b[3] for b in some) / (v.size[0] * v.size[1]) for v, some in zip(views, boxes, strict=True)]
    shares = [share.within(part) for share, part in zip(shares, used, strict=True)]
    tasks = [
        (view.path, view.size, box, known, share)
        for view, known, share, of_view in zip(views, found, shares, boxes, strict=True)
        for box in of_view
    ]
    names = [f"{name}{'-coarse' * coarse}" for name in names_of(work.executor, detect_tile, tasks)]
    keeping = [(work.store, name, task) for name, task in zip(names, tasks, strict=True)]
    counts: list[int] = work.ordered(keep_tile, keeping, "detect")
    files, first = [], 0
    for of_view in boxes:
        part = slice(first, first := first + len(of_view))
        files.append(KeypointFiles(work.store, tuple(of_view), tuple(names[part]), tuple(counts[part])))
    return files
