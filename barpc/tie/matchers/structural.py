"""Dense matching of gradient structure for pairs without like grey values: another season, sun or sensor.

Both images are brought onto the pixels of A, B by the cameras' local derivative, as channels of oriented gradients
(`barpc.tie.patches.channels`). Templates on a regular grid of A are correlated with all that the band of a prediction
covers and with as much to both sides of it, so that bands moved aside compete with the true one point by point; the
way back must end where it began. A search for the cameras' error sums what neighbours see, then goes from coarse to
fine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

import cv2
import numpy as np

from barpc.base.geodesy import Array, Box
from barpc.base.options import TieOptions
from barpc.scene import IntArray, View
from barpc.tie.matchers.features import Keypoints
from barpc.tie.matchers.matcher import DUPLICATE_DISTANCE, NO_MATCHES, Matches, Prediction
from barpc.tie.pairing.epipolar import EpipolarSegments, grouped, linear_map
from barpc.tie.patches.channels import INVALID_MARGIN
from barpc.tie.patches.oriented import HALF, MAX_PATCH_SHIFT, PatchTile, Sampling, found_about, resolution
from barpc.tie.pixels import PIECE, SPAN, FloatImage

GRID_POINTS = 200, 500, 1000
"""Points that are looked for: of the cameras' error, in long bands, in short ones."""
_RING = 3.5  # pitches about a point whose neighbours speak for its places, together
_SAY = 4.0  # times as loud as it does itself. Of four pairs that were hardest 1 is tied by 1.5 and 1, 3 by this
_SMALLEST = 60  # px of a side of the common part, in the coarsest picture
_LONG, _LONGER = 48.0, 130.0  # px of half a band


class GradientStructure:
    """A matcher of gradient structure: the best correlation in each point's band, if no decoy has a better one."""

    detects: ClassVar[bool] = False
    patch: float = 4.0 * HALF
    """Side of a template [px], in the finest picture that is searched freely: matches nearer to each other are one."""
    widest: ClassVar[float] = float("inf")
    """How wrong cameras may be [px] where their error is looked for."""
    whole: ClassVar[bool] = False  # pixels are looked at, and no coarser picture

    def __init__(self, options: TieOptions, keypoints: tuple[Keypoints, Keypoints]) -> None:
        self._band = options.band
        self._known: dict[Callable[[Array], EpipolarSegments], Matches] = {}

    def match(self, a: View, b: View, prediction: Prediction) -> Matches:
        """Match a grid of points: those whose best place lies in the band, and not in decoys to both sides.

        All bands of a prediction, moved aside or not, are looked at at once; the next calls ask of what was found.
        """
        if prediction.where not in self._known:
            search = _GridSearch(a, b, self._band, prediction, self.whole)
            if self.whole:
                self.patch = 2.0 * _RING * search.pitch
            self._known[prediction.where] = search.matches()
        found = self._known[prediction.where]
        if not len(found):
            return NO_MATCHES
        across = prediction.at(found.xy[:, 0]).errors(found.xy[:, 1])[:, 1]
        return found.select(np.abs(across) <= max(prediction.half_width, MAX_PATCH_SHIFT))


class FineStructure(GradientStructure):
    """Structure at full resolution, for cameras with small errors: fine lines are lost in coarser pictures.

    Where half of the vegetation has grown anew, few places have the best correlation of their bands by themselves: it
    is averaged with those of neighbours about the same place, and matches that share neighbours count as one.
    """

    widest: ClassVar[float] = 20.0
    whole: ClassVar[bool] = True


class _GridSearch:
    """Search for all points of a grid, at `whole` pixels or in a picture as coarse as the bands are long."""

    def __init__(self, a: View, b: View, band: int, prediction: Prediction, whole: bool = False) -> None:
        self._views, self._band, self._prediction, self._whole = (a, b), band, prediction, whole
        self._files = (a.path, a.size), (b.path, b.size)
        windows = prediction.windows()
        middles = np.array([(col + 0.5 * w, row + 0.5 * h) for col, row, w, h in windows]).reshape(-1, 2)
        where = prediction.at(middles)
        with np.errstate(invalid="ignore"):
            lengths = 0.5 * (where.after - where.before)[np.isfinite(where.after)]
        self._least = resolution(where.linear)
        self.pitch = 1
        self._step, self._points = self._level(float(np.median(lengths)) if len(lengths) else 0.0, windows)

    def _level(self, half: float, windows: Sequence[Box]) -> tuple[int, Array]:
        """Return the step of the picture for bands of half a length [px of B], and the points of the grid."""
        if not windows:
            return 1, np.empty((0, 2))
        if self._whole:
            wanted, count = 1, GRID_POINTS[1 + (self._prediction.probes is None)]
        elif self._prediction.probes is None:
            wanted, count = (4, GRID_POINTS[1]) if half > _LONGER else (2, GRID_POINTS[1 + (half < _LONG)])
        else:
            width = self._prediction.half_width  # a twentieth of the image, or the altitudes, may be wide
            wanted, count = max(int(width / 20.0), 4 if half > _LONGER else 2), GRID_POINTS[0]
        boxes = np.array(windows)
        side = (boxes[:, :2] + boxes[:, 2:]).max(axis=0) - boxes[:, :2].min(axis=0)
        step = 1 << int(np.ceil(np.log2(wanted)))
        while step > 2 and side.min() < _SMALLEST * step:
            step //= 2
        step *= self._least
        area = float((boxes[:, 2] * boxes[:, 3]).sum())
        self.pitch = step * max(HALF // 2, int((area / count) ** 0.5 / step))
        return step, np.concatenate([lattice_points(box, self.pitch) for box in windows])

    def matches(self) -> Matches:
        """Return the best place of every point on whole bands, refined in finer pictures."""
        where = self._prediction.where(self._points)
        ends = np.stack([where.place(where.before), where.place(where.after)])
        with np.errstate(invalid="ignore"):
            seen = (ends.max(axis=0) > 0).all(axis=1) & (ends.min(axis=0) < np.array(self._views[1].size)).all(axis=1)
        rows = np.flatnonzero(seen)
        parts = [
            self._tile(where, rows[group])
            for group in grouped(*np.floor(self._points[rows][:, ::-1] / (self._step * SPAN)).T)
        ]
        if not parts:
            return NO_MATCHES
        at, xy, score = (np.concatenate(column) for column in zip(*parts, strict=True))
        step = self._step
        while len(at) and step > 2 * self._least:
            step //= 2
            found = [
                (group, *found_about(self._sampling(step, at[group]), at[group], xy[group]))
                for group in grouped(*np.floor(at[:, ::-1] / (step * SPAN)).T)
            ]
            group, place, ok = (np.concatenate(column) for column in zip(*[f[:3] for f in found], strict=True))
            at, xy, score = at[group[ok]], place[ok], score[group[ok]]
        return Matches.of_places(np.stack([at, xy], axis=1), score)

    def _sampling(self, step: int, at: Array) -> Sampling:
        """Return the sampling of both images about some points of A."""
        return Sampling(self._files, self._band, step, linear_map(*self._views, at.mean(axis=0)))

    def _tile(self, where: EpipolarSegments, rows: IntArray) -> tuple[Array, Array, Array]:
        """Return the points of A, their best places in B and the dissimilarities, of some rows."""
        at, asked = self._points[rows], self._prediction
        reach_along, slope = 0.5 * (where.after - where.before)[rows], where.slope[rows]
        middle = 0.5 * (where.before + where.after)
        sampling = self._sampling(self._step, at)
        linear = sampling.linear
        axes = np.stack([where.axis, [-where.axis[1], where.axis[0]]])
        half = max(asked.half_width, MAX_PATCH_SHIFT)
        wide = half if asked.probes else 2.0 * asked.half_width + INVALID_MARGIN + half
        wide = min(wide, float(np.abs(axes[1]) @ self._files[1][1]))  # B is no wider
        shift, longest = self._part_in_b(where, middle, rows, wide)
        turned = np.abs(np.linalg.inv(self._step * linear) @ axes.T)
        whole = np.abs(np.linalg.inv(self._step * linear)) @ self._files[1][1]
        reach = np.ceil(np.minimum(turned @ [longest, wide], whole)).astype(np.int64) + 1
        if len(rows) > 1 and len(rows) * (2 * reach + 1).prod() > 2 * PIECE:
            order = rows[np.argsort(at[:, np.ptp(at, axis=0).argmax()], kind="stable")]
            halves = [self._tile(where, np.sort(half)) for half in np.array_split(order, 2)]
            first, second, third = (np.concatenate(column) for column in zip(*halves, strict=True))
            return first, second, third
        centers = where.place(middle + shift)[rows]
        tile = PatchTile.of(sampling, at, centers, reach, HALF)
        surface = tile.surfaces()
        if self._whole:
            surface = supported(surface, adjacency(at, _RING * self.pitch), _SAY)
        elif asked.probes:  # neighbours are moved alike
            near = adjacency(at, self.pitch)
            surface = np.tensordot(near, surface, axes=1) / near.sum(axis=1)[:, None, None]
        off = tile.offsets() @ axes.T  # along, across
        part = (tile.left @ tile.matrix.T @ axes.T)[:, None, None]
        along, across = off[..., 0] - part[..., 0], off[..., 1] - part[..., 1]
        across = across - slope[:, None, None] * along
        inside = (np.abs(along + shift) <= reach_along[:, None, None]) & (np.abs(across) <= wide)
        place, score = tile.peaks(np.where(inside, surface, np.float32(-1.0)))
        ok = (score > 0.0) & tile.shown()
        if not asked.probes:
            ok &= tile.returns(place)
        return at[ok], tile.in_b(place)[ok], 1.0 - score[ok]

    def _part_in_b(self, where: EpipolarSegments, middle: Array, rows: IntArray, wide: float) -> tuple[float, float]:
        """Return the middle and half the length [px] of the parts of a tile's segments inside B, from their middles."""
        start = where.place(middle)[rows]
        step = where.place(middle + 1.0)[rows] - start
        size = np.array(self._files[1][1], dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(-wide - start) / step, (size + wide - start) / step])
        ends = np.where(np.isfinite(ends), ends, np.array([-np.inf, np.inf])[:, None, None])
        most = 0.5 * (where.after - where.before)[rows]
        low = np.maximum(ends.min(axis=0).max(axis=1), -most)
        high = np.minimum(ends.max(axis=0).min(axis=1), most)
        cut = low <= high
        first, last = float(low[cut].min(initial=np.inf)), float(high[cut].max(initial=-np.inf))
        return (0.5 * (first + last), 0.5 * (last - first)) if first <= last else (0.0, 0.0)


def adjacency(at: Array, reach: float) -> FloatImage:
    """Return the matrix (n, n) of points (n, 2) within reach [px] of each other along both axes: 1, else 0."""
    return np.asarray(np.abs(at[:, None] - at[None]).max(axis=2) <= reach, np.float32)


def supported(surface: FloatImage, near: FloatImage, loud: float) -> FloatImage:
    """Return correlations (n, y, x) averaged with neighbours' (n, n) best about the same place, of weight `loud`."""
    others = near - np.eye(len(near), dtype=np.float32)
    kernel = np.ones((2 * DUPLICATE_DISTANCE + 1,) * 2, np.uint8)
    about = np.stack([cv2.dilate(one, kernel) for one in surface])
    share = np.float32(loud) / np.maximum(others.sum(axis=1, keepdims=True), 1.0)
    return np.asarray((surface + np.tensordot(share * others, about, axes=1)) / np.float32(1.0 + loud))


def lattice_points(box: Box, pitch: int) -> Array:
    """Return the points (n, 2) [px], col and row, in a box (col, row, width, height) at multiples of the pitch [px]."""
    axes = [
        np.arange(-(-first // pitch) * pitch, first + length, pitch)
        for first, length in zip(box[:2], box[2:], strict=True)
    ]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2).astype(np.float64)
