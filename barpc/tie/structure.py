"""Dense matching of structure, where grey values say nothing: another season, sun or sensor.

Both images are brought onto the pixels of A, B by the cameras' local derivative, as channels of oriented gradients
(`barpc.tie.channels`). Templates on a regular grid of A are correlated with all that the band of a prediction covers
and with as much to both sides of it, so that bands moved aside compete with the true one point by point; the way back
must end where it began. A search for the cameras' error sums what neighbours see, then goes from coarse to fine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np

from barpc.geodesy import Array
from barpc.options import TieOptions
from barpc.scene import BoolArray, IntArray, View
from barpc.tie.channels import COARSE, FINE, channels, correlation, cut
from barpc.tie.epipolar import Frame, grouped, linear_map
from barpc.tie.features import Keypoints
from barpc.tie.matcher import NO_MATCHES, Matches, Prediction
from barpc.tie.ortho import picture, ticks
from barpc.tie.raster import Box, FloatImage

Files = Sequence[tuple[str, tuple[int, int]]]
"""Path and size (width, height) of two images."""

PATCH = 24
"""How far a patch reaches to each side when matches are registered [px]."""
SIGMA = 0.1
"""Standard deviation of a coordinate after that, at least [px]."""
_HALF = 16  # px: a template reaches so far to each side
_PAD = 8  # px around what is compared, where channels do not know what lies beyond
_TILE = 256  # px: points of a tile share a picture
_BATCH = 32  # templates that are correlated at a time, at most,
_AREA = 1 << 21  # of areas of so many px together: 60 bytes a px
_SURFACE = 1 << 23  # places at which a tile's points are compared, all together: 30 bytes each
_PITCH = 8  # px between points, at least
_POINTS = 200, 500, 1000  # looked for: of the cameras' error, in long bands, in short ones
_FINE_POINTS = 600, 1500  # of the cameras' error, in bands, where whole pixels are looked at
_RING = 3.5  # pitches about a point whose neighbours speak for its places, together
_SAY = (
    4.0  # times as loud as it does itself. Of four pairs that were hardest 1 is tied by 1.5 and 1, 3 by this
)
_BENT = 2  # px by which their parallax may differ, and does not count
_LONG, _LONGER = 48.0, 130.0  # px of half a band
_SMALLEST = 60  # px of a side of the common part, in the coarsest picture
_SHOWN = 0.9  # of a template must be a picture
_BACK = 1.5  # px that the way back may miss by
_FINER = 3  # px to each side that a finer picture is searched
_FINEST = 3  # and the last one, of half the step
_INNER = 16  # px: the last look sees less, so that it is the place itself that is found


class Structure:
    """A matcher of gradient structure: the most alike place in each point's band, where no decoy is more alike."""

    detects: ClassVar[bool] = False
    patch: float = 4.0 * _HALF
    """Side of a template [px], in the finest picture that is searched freely: matches nearer to each other are one."""
    widest: ClassVar[float] = float("inf")
    """How wrong cameras may be [px] where their error is looked for."""
    whole: ClassVar[bool] = False  # pixels are looked at, and no coarser picture

    def __init__(self, options: TieOptions, keypoints: tuple[Keypoints, Keypoints]) -> None:
        self._band = options.band
        self._known: dict[Callable[[Array], Frame], Matches] = {}

    def match(self, a: View, b: View, prediction: Prediction) -> Matches:
        """Match a grid of points: those whose best place, in the band and in decoys to both sides, lies in
        the band.

        All bands of a prediction, moved aside or not, are looked at at once; the next calls ask of what was found.
        """
        if prediction.where not in self._known:
            search = _Search(a, b, self._band, prediction, self.whole)
            if self.whole:
                self.patch = 2.0 * _RING * search.pitch
            self._known[prediction.where] = search.matches()
        found = self._known[prediction.where]
        if not len(found):
            return NO_MATCHES
        across = prediction.at(found.xy[:, 0]).errors(found.xy[:, 1])[:, 1]
        return found.select(np.abs(across) <= max(prediction.half_width, 1.5))


class FineStructure(Structure):
    """The same on whole pixels, about cameras that are not far off: lines that coarser pictures have lost.

    Where half of what is left has grown anew, few places are the best of their bands by themselves: neighbours speak
    for them, a little to the side of where they would be, and matches count as one that the same neighbours spoke for.
    """

    widest: ClassVar[float] = 20.0
    whole: ClassVar[bool] = True


class _Search:
    """One look at all points of a grid, at `whole` pixels or in a picture as coarse as the bands are long."""

    def __init__(self, a: View, b: View, band: int, prediction: Prediction, whole: bool = False) -> None:
        self._views, self._band, self._prediction, self._whole = (a, b), band, prediction, whole
        self._files = (a.path, a.size), (b.path, b.size)
        windows = prediction.windows()
        middles = np.array([(col + 0.5 * w, row + 0.5 * h) for col, row, w, h in windows]).reshape(-1, 2)
        where = prediction.at(middles)
        with np.errstate(invalid="ignore"):
            lengths = 0.5 * (where.after - where.before)[np.isfinite(where.after)]
        self._least = _resolution(where.linear)
        self.pitch = 1
        self._step, self._points = self._level(float(np.median(lengths)) if len(lengths) else 0.0, windows)

    def _level(self, half: float, windows: Sequence[Box]) -> tuple[int, Array]:
        """Return the step of the picture for bands of half a length [px of B], and the points of the grid."""
        if not windows:
            return 1, np.empty((0, 2))
        if self._whole:
            wanted, count = 1, _FINE_POINTS[self._prediction.probes is None]
        elif self._prediction.probes is None:
            wanted, count = (4, _POINTS[1]) if half > _LONGER else (2, _POINTS[1 + (half < _LONG)])
        else:
            width = self._prediction.half_width  # a twentieth of the image, or the altitudes, may be wide
            wanted, count = int(max(width / 20.0, min(half / 80.0, 4.0), 2.0)), _POINTS[0]
        boxes = np.array(windows)
        side = (boxes[:, :2] + boxes[:, 2:]).max(axis=0) - boxes[:, :2].min(axis=0)
        step = 1 << int(np.ceil(np.log2(wanted)))
        while step > 2 and side.min() < _SMALLEST * step:
            step //= 2
        step *= self._least
        area = float((boxes[:, 2] * boxes[:, 3]).sum())
        self.pitch = step * max(_PITCH, int((area / count) ** 0.5 / step))
        return step, np.concatenate([_lattice(box, self.pitch) for box in windows])

    def matches(self) -> Matches:
        """Return the best place of every point, on whole bands; found again in finer pictures."""
        a, b = self._views
        where = self._prediction.where(self._points)
        middle = 0.5 * (where.before + where.after)
        ends = np.stack([where.place(where.before), where.place(where.after)])
        with np.errstate(invalid="ignore"):
            seen = (ends.max(axis=0) > 0).all(axis=1) & (ends.min(axis=0) < np.array(b.size)).all(axis=1)
        rows = np.flatnonzero(seen & np.isfinite(where.along + where.across + middle))
        parts = [
            self._tile(where, rows[group])
            for group in grouped(*np.floor(self._points[rows][:, ::-1] / (self._step * _TILE)).T)
        ]
        if not parts:
            return NO_MATCHES
        at, xy, score = (np.concatenate(column) for column in zip(*parts, strict=True))
        step = self._step
        while len(at) and step > 2 * self._least:
            step //= 2
            found = [
                (
                    group,
                    *_found(
                        self._files,
                        self._band,
                        step,
                        at[group],
                        xy[group],
                        linear_map(a, b, at[group].mean(axis=0)),
                    ),
                )
                for group in grouped(*np.floor(at[:, ::-1] / (step * _TILE)).T)
            ]
            group, place, ok = (
                np.concatenate(column) for column in zip(*[f[:3] for f in found], strict=True)
            )
            at, xy, score = at[group[ok]], place[ok], score[group[ok]]
        return Matches.of_places(np.stack([at, xy], axis=1), score)

    def _tile(self, where: Frame, rows: IntArray) -> tuple[Array, Array, Array]:
        """Return the points of A, their best places in B and how unlike these look, of some rows."""
        at, asked = self._points[rows], self._prediction
        reach_along, slope = 0.5 * (where.after - where.before)[rows], where.slope[rows]
        middle = 0.5 * (where.before + where.after)
        linear = linear_map(*self._views, at.mean(axis=0))
        axes = np.stack([where.axis, [-where.axis[1], where.axis[0]]])
        half = max(asked.half_width, 0.75 * self._step)
        wide = half if asked.probes else 2.0 * asked.half_width + 6.0 + half
        wide = min(wide, float(np.abs(axes[1]) @ self._files[1][1]))  # B is no wider
        shift, longest = self._part_in_b(where, middle, rows, wide)
        turned = np.abs(np.linalg.inv(self._step * linear) @ axes.T)
        whole = np.abs(np.linalg.inv(self._step * linear)) @ self._files[1][1]
        reach = np.ceil(np.minimum(turned @ [longest, wide], whole)).astype(np.int64) + 1
        if len(rows) > 1 and len(rows) * (2 * reach + 1).prod() > _SURFACE:
            order = rows[np.argsort(at[:, np.ptp(at, axis=0).argmax()], kind="stable")]
            halves = [self._tile(where, np.sort(half)) for half in np.array_split(order, 2)]
            first, second, third = (np.concatenate(column) for column in zip(*halves, strict=True))
            return first, second, third
        centers = where.place(middle + shift)[rows]
        tile = Tile.of(self._files, self._band, self._step, at, centers, linear, reach, _HALF)
        surface = tile.surfaces()
        if self._whole:
            surface = _supported(surface, _near(at, _RING * self.pitch), _SAY)
        elif asked.probes:  # neighbours are moved alike
            near = _near(at, 1.5 * self.pitch)
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

    def _part_in_b(self, where: Frame, middle: Array, rows: IntArray, wide: float) -> tuple[float, float]:
        """Return the middle and half the length [px] of what a tile's segments have in B, from their middles:
        one for all.
        """
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


def _near(at: Array, reach: float) -> FloatImage:
    """1 where points (n, 2) lie within reach [px] of each other along both axes, else 0: (n, n)."""
    return np.asarray(np.abs(at[:, None] - at[None]).max(axis=2) <= reach, np.float32)


def _supported(surface: FloatImage, near: FloatImage, loud: float) -> FloatImage:
    """Correlations (n, y, x) averaged with the best of neighbours' (n, n) about the same place, so much `loud`er."""
    others = near - np.eye(len(near), dtype=np.float32)
    kernel = np.ones((2 * _BENT + 1,) * 2, np.uint8)
    about = np.stack([cv2.dilate(one, kernel) for one in surface])
    share = np.float32(loud) / np.maximum(others.sum(axis=1, keepdims=True), 1.0)
    return np.asarray((surface + np.tensordot(share * others, about, axes=1)) / np.float32(1.0 + loud))


def _resolution(linear: Array) -> int:
    """Return the pixels of A in one of B, where these are larger, as a power of two."""
    return 1 << int(np.rint(np.log2(max(1.0, abs(float(np.linalg.det(linear))) ** -0.5))).clip(0, 6))


def _lattice(box: Box, pitch: int) -> Array:
    """Return the points (n, 2) in a box whose coordinates are multiples of the pitch."""
    axes = [
        np.arange(-(-first // pitch) * pitch, first + length, pitch)
        for first, length in zip(box[:2], box[2:], strict=True)
    ]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2).astype(np.float64)


def _found(
    files: Files, band: int, step: int, at: Array, xy: Array, linear: Array, half: int = _HALF
) -> tuple[Array, BoolArray, Array]:
    """Return the places (n, 2) near those given, whether they stand out and the way back ends at its start;
    correlations.
    """
    tile = Tile.of(files, band, step, at, xy, linear, np.array([_FINER, _FINER]), half)
    surface = tile.surfaces()
    place, score = tile.peaks(surface)
    edge = np.abs(np.rint(place) - tile.whole).max(axis=1) < _FINER
    return tile.in_b(place), edge & tile.shown() & tile.returns(place), score


def register_places(
    files: Files, band: int, reference: Array, start: Array, linear: Array
) -> tuple[Array, BoolArray, Array]:
    """Register patches of A at `reference` about `start` (n, 2) [px] of B: places, success, correlations.

    On the channels, at the coarser of the two resolutions, and then at half its step: what is sharper than a pixel is
    lost between whole ones.
    """
    place, ok, score = start.copy(), np.zeros(len(start), dtype=bool), np.zeros(len(start))
    step = _resolution(np.median(linear, axis=0))
    for rows in grouped(*np.floor(reference[:, ::-1] / (step * _TILE)).T):
        at, turn = reference[rows], np.median(linear[rows], axis=0)
        near, found, _ = _found(files, band, step, at, start[rows], turn, PATCH)
        tile = Tile.of(files, band, 0.5 * step, at, near, turn, np.full(2, _FINEST), 2 * _INNER, FINE)
        best, score[rows] = tile.peaks(tile.surfaces())
        inside = np.abs(np.rint(best) - tile.whole).max(axis=1) < _FINEST
        place[rows], ok[rows] = tile.in_b(best), found & inside
    return place, ok, score


@dataclass(frozen=True, eq=False)
class Tile:
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
    def of(
        cls,
        files: Files,
        band: int,
        step: float,
        at: Array,
        xy: Array,
        linear: Array,
        reach: IntArray,
        half: int,
        blurs: tuple[float, float] = COARSE,
    ) -> Tile:
        """Return the pictures of two images about points of A and B (n, 2) [px]."""
        matrix, pad = step * linear, half + _PAD
        corner = np.floor(at.min(axis=0) / step) * step - pad * step
        first = np.rint((at - corner) / step).astype(np.int64)
        middle = np.median(xy, axis=0)
        place = (xy - middle) @ np.linalg.inv(matrix).T
        low = np.floor(place.min(axis=0)) - pad - reach - 1
        place -= low
        whole = np.rint(place).astype(np.int64)
        origin = middle + matrix @ low
        pictures = (
            _seen(files[0], band, corner, step * np.eye(2), first.max(axis=0) + pad + 1, blurs),
            _seen(files[1], band, origin, matrix, whole.max(axis=0) + pad + reach + 2, blurs),
        )
        return cls(pictures, first, whole, place - whole, reach, half, matrix, origin)

    def surfaces(self) -> FloatImage:
        """Return the correlations (n, y, x) at all places within reach."""
        x, y = (self.half + self.reach).tolist()
        parts = [
            correlation(
                cut(self.pictures[0], self.at[i], self.half, self.half),
                cut(self.pictures[1], self.whole[i], x, y),
            )
            for i in self._batches()
        ]
        return np.concatenate(parts)

    def _batches(self) -> list[slice]:
        area = int((2 * (self.half + self.reach) + 1).prod())
        batch = max(1, min(_BATCH, _AREA // area))
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
            there = cut(self.pictures[1], np.rint(place[i]).astype(np.int64), self.half, self.half)
            back = correlation(
                there, cut(self.pictures[0], self.at[i], self.half + search, self.half + search)
            )
            y, x = np.divmod(back.reshape(len(back), -1).argmax(axis=1), back.shape[2])
            missed.append(np.hypot(x - search, y - search))
        return np.asarray(np.concatenate(missed) <= _BACK)

    def shown(self) -> BoolArray:
        """Return the templates that hold structure."""
        known = (np.abs(self.pictures[0]).sum(axis=0, keepdims=True) > 0).astype(np.float32)
        return np.asarray(cut(known, self.at, self.half, self.half).mean(axis=(1, 2, 3)) > _SHOWN)

    def in_b(self, place: Array) -> Array:
        """Return the places (n, 2) of the second picture in B [px]."""
        return np.asarray(self.origin + place @ self.matrix.T)


def _seen(
    file: tuple[str, tuple[int, int]],
    band: int,
    origin: Array,
    matrix: Array,
    size: IntArray,
    blurs: tuple[float, float],
) -> FloatImage:
    """Return the channels (C, H, W) of an image on a grid: pixel k at `origin` + `matrix` k."""
    shape = int(size[1]), int(size[0])
    nodes = np.stack(np.meshgrid(ticks(shape[1]), ticks(shape[0])), axis=-1)
    return channels(*picture(file[0], (band,), file[1], origin + nodes @ matrix.T, shape), blurs)
