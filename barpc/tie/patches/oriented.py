"""Correlation of templates between two pictures' channels, brought to one resolution and orientation.

A place counts where its surroundings are a picture, where it is no edge of the search, and where the way back ends
where it began. Matching by structure, registration by structure and control from a reference all look so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from barpc.base.geodesy import Array
from barpc.scene import BoolArray, IntArray
from barpc.tie.pairing.epipolar import grouped
from barpc.tie.patches.channels import INVALID_MARGIN, channels, correlation, picture, ticks, windows_around
from barpc.tie.pixels import CELL, PIECE, SPAN, FloatImage, OpenReaders

ImageFiles = Sequence[tuple[str, tuple[int, int]]]
"""Path and size (width, height) of two images."""

TEMPLATE_REACH = 24
"""How far one reaches when matches are registered [px]."""
HALF = 16
"""How far a template reaches to each side [px]."""
MIN_PICTURE_SHARE = 0.9
"""Part of a template that must be a picture."""
MAX_PATCH_SHIFT = 1.5
"""What a registered patch may move [px], and the way back from a template miss by: beyond, it is another point."""
_REFINEMENT_RADIUS = 3  # px to each side that a finer picture is searched, and the last one, of half its step


def resolution(linear: Array) -> int:
    """Return the pixels of A in one of B, where these are larger, as a power of two."""
    return 1 << int(np.rint(np.log2(max(1.0, abs(float(np.linalg.det(linear))) ** -0.5))).clip(0, 6))


@dataclass(frozen=True, eq=False)
class Sampling:
    """Sampling of two images on grids of one resolution and orientation."""

    files: ImageFiles
    band: int
    step: float  # px of A that a pixel of the grids holds
    linear: Array  # (2, 2) d(B)/d(A)
    readers: OpenReaders | None = None  # of both images, where blocks would be decoded again

    def seen(self, which: int, origin: Array, matrix: Array, size: IntArray) -> FloatImage:
        """Return the channels (C, H, W) of an image on a grid: pixel k at `origin` + `matrix` k."""
        (path, whole), shape = self.files[which], (int(size[1]), int(size[0]))
        nodes = np.stack(np.meshgrid(ticks(shape[1]), ticks(shape[0])), axis=-1)
        return channels(*picture(path, (self.band,), whole, origin + nodes @ matrix.T, shape, self.readers))


def found_about(sampling: Sampling, at: Array, xy: Array, half: int = HALF) -> tuple[Array, BoolArray, Array]:
    """Return the refined places (n, 2), whether they are clear peaks that match back, and correlations."""
    tile = PatchTile.of(sampling, at, xy, np.full(2, _REFINEMENT_RADIUS), half)
    place, ok, score = tile.found()
    return tile.in_b(place), ok & tile.returns(place), score


def register_oriented(
    files: ImageFiles, band: int, reference: Array, start: Array, linear: Array, readers: OpenReaders | None = None
) -> tuple[Array, BoolArray, Array]:
    """Register patches of A at `reference` about `start` (n, 2) [px] of B: places, success, correlations.

    On the channels, at the coarser of the two resolutions, and then at half its step: what is sharper than a pixel is
    lost between whole ones.
    """
    place, ok, score = start.copy(), np.zeros(len(start), dtype=bool), np.zeros(len(start))
    step = resolution(np.median(linear, axis=0))
    with OpenReaders() as own:
        readers = readers or own
        for rows in grouped(*np.floor(reference[:, ::-1] / (step * SPAN)).T):
            at, turn = reference[rows], np.median(linear[rows], axis=0)
            near, found, _ = found_about(Sampling(files, band, step, turn, readers), at, start[rows], TEMPLATE_REACH)
            closer = Sampling(files, band, 0.5 * step, turn, readers)
            tile = PatchTile.of(closer, at, near, np.full(2, _REFINEMENT_RADIUS), 2 * HALF)
            best, inside, score[rows] = tile.found()
            place[rows], ok[rows] = tile.in_b(best), found & inside
    return place, ok, score


@dataclass(frozen=True, eq=False)
class PatchTile:
    """Pictures around points of A and their search areas in B, of the same resolution and orientation."""

    pictures: tuple[FloatImage, FloatImage]  # channels (C, H, W) of A and of B
    at: IntArray  # (n, 2) in the first
    whole: IntArray  # (n, 2) in the second: whole px next to what is predicted
    left: Array  # (n, 2) what that leaves [px]
    reach: IntArray  # (2,) how far to look, x, y [px]
    half: int  # how far templates reach [px]
    matrix: Array  # (2, 2) d(B)/d(second picture)
    origin: Array  # (2,) of the second picture, in B

    @classmethod
    def of(cls, sampling: Sampling, at: Array, xy: Array, reach: IntArray, half: int) -> PatchTile:
        """Return the pictures of two images about points of A and B (n, 2) [px]."""
        step, matrix = sampling.step, sampling.step * sampling.linear
        pad = half + INVALID_MARGIN + 2  # beside it, channels do not know what lies beyond
        corner = np.floor(at.min(axis=0) / step) * step - pad * step
        first = np.rint((at - corner) / step).astype(np.int64)
        middle = np.median(xy, axis=0)
        place = (xy - middle) @ np.linalg.inv(matrix).T
        low = np.floor(place.min(axis=0)) - pad - reach - 1
        place -= low
        whole = np.rint(place).astype(np.int64)
        origin = middle + matrix @ low
        pictures = (
            sampling.seen(0, corner, step * np.eye(2), first.max(axis=0) + pad + 1),
            sampling.seen(1, origin, matrix, whole.max(axis=0) + pad + reach + 2),
        )
        return cls(pictures, first, whole, place - whole, reach, half, matrix, origin)

    @classmethod
    def same(cls, pictures: tuple[FloatImage, FloatImage], at: Array, reach: int, half: int) -> PatchTile:
        """Return pictures on one grid, points of which (n, 2) [whole px] are looked for about the same places."""
        whole, none = np.asarray(at, np.int64), np.zeros((len(at), 2))
        return cls(pictures, whole, whole, none, np.full(2, reach), half, np.eye(2), np.zeros(2))

    def surfaces(self) -> FloatImage:
        """Return the correlations (n, y, x) at all places within reach."""
        x, y = (self.half + self.reach).tolist()
        parts = [
            correlation(
                windows_around(self.pictures[0], self.at[i], self.half, self.half),
                windows_around(self.pictures[1], self.whole[i], x, y),
            )
            for i in self._batches()
        ]
        return np.concatenate(parts)

    def found(self) -> tuple[Array, BoolArray, Array]:
        """Return the best places (n, 2) in the second picture, whether they are no edge of the search and the template
        is a picture, and correlations.
        """
        place, score = self.peaks(self.surfaces())
        inside = (np.abs(np.rint(place) - self.whole) < self.reach).all(axis=1)
        return place, inside & self.shown(), score

    def decoys(self) -> Array:
        """Return the best correlations (n,) beside the search, where nothing true can be, to the right and left in
        turn.
        """
        aside = np.where(np.arange(len(self.at)) % 2, 1, -1)[:, None] * [2 * self.reach[0] + INVALID_MARGIN, 0]
        return np.asarray(replace(self, whole=self.whole + aside).surfaces().max(axis=(1, 2)), np.float64)

    def _batches(self) -> list[slice]:
        area = int((2 * (self.half + self.reach) + 1).prod())
        batch = max(1, min(CELL, PIECE // area))
        return [slice(i, i + batch) for i in range(0, len(self.at), batch)]

    def offsets(self) -> Array:
        """Return the offsets (y, x, 2) [px] in B of the places of a surface from the whole pixel."""
        axes = (np.arange(-n, n + 1) for n in self.reach.tolist())
        return np.stack(np.meshgrid(*axes), axis=-1) @ self.matrix.T

    def peaks(self, surface: FloatImage) -> tuple[Array, Array]:
        """Return the best places (n, 2) in the second picture, to sub-pixel precision, and their correlations (n,)."""
        n, height, width = surface.shape
        flat = surface.reshape(n, -1).argmax(axis=1)
        y, x = np.divmod(flat, width)
        part = np.zeros((n, 2))
        inside = (x > 0) & (x < width - 1) & (y > 0) & (y < height - 1)
        i, row, col = np.flatnonzero(inside), y[inside], x[inside]
        for k, (dy, dx) in enumerate(((0, 1), (1, 0))):
            low, here, high = (surface[i, row + s * dy, col + s * dx].astype(np.float64) for s in (-1, 0, 1))
            bend = np.minimum(low - 2.0 * here + high, -1e-6)
            part[i, k] = (0.5 * (low - high) / bend).clip(-0.5, 0.5)
        score = surface.reshape(n, -1)[np.arange(n), flat].astype(np.float64)
        return self.whole + np.stack([x, y], axis=1) - self.reach + part, score

    def returns(self, place: Array) -> BoolArray:
        """Return whether matching back from places of the second picture ends where it began."""
        search, missed = 4, []
        for i in self._batches():
            there = windows_around(self.pictures[1], np.rint(place[i]).astype(np.int64), self.half, self.half)
            back = correlation(
                there, windows_around(self.pictures[0], self.at[i], self.half + search, self.half + search)
            )
            y, x = np.divmod(back.reshape(len(back), -1).argmax(axis=1), back.shape[2])
            missed.append(np.hypot(x - search, y - search))
        return np.asarray(np.concatenate(missed) <= MAX_PATCH_SHIFT)

    def shown(self, place: Array | None = None) -> BoolArray:
        """Return the mask of places (n, 2) in the second picture, or of templates, with structure about them."""
        at = self.at if place is None else np.rint(place).astype(np.int64)
        known = (np.abs(self.pictures[place is not None]).sum(axis=0, keepdims=True) > 0).astype(np.float32)
        return np.asarray(windows_around(known, at, self.half, self.half).mean(axis=(1, 2, 3)) > MIN_PICTURE_SHARE)

    def in_b(self, place: Array) -> Array:
        """Return the places (n, 2) of the second picture in B [px]."""
        return np.asarray(self.origin + place @ self.matrix.T)
