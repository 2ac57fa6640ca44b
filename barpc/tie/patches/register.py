"""Sub-pixel registration of patches of an image to reference patches of another one.

A reference patch stands at a whole pixel, so that it needs no interpolation. The patch of the other image is
pre-warped by the cameras' local derivative and registered by least squares with an affine distortion, gain and bias
(Gruen 1985), in the inverse compositional form (Baker and Matthews 2004): the derivative is that of the reference, so
one small pseudo-inverse a match serves all iterations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from barpc.base.fields import field_values
from barpc.base.frozen import join_fields
from barpc.base.geodesy import CHUNK, NEWTON_STEPS, Array
from barpc.scene import BoolArray, IntArray
from barpc.tie.pairing.epipolar import SIGMA, grouped
from barpc.tie.patches import oriented
from barpc.tie.pixels import SPAN, FloatImage, OpenReaders, PixelReader, grow, levelled

MIN_CORRELATION = 0.8
"""Of two registered patches, or the match is left out."""
PATCH = 21
"""Side of the patches that are registered [px], odd."""
_INNER = 0.7  # part of a patch that counts most: its Gaussian weight's sigma; the patch of second tries and the check
_SUBPIXEL_SAMPLES = 4  # samples a pixel and axis
_SAMPLER_STEPS = cv2.INTER_TAB_SIZE * _SUBPIXEL_SAMPLES
"""Positions a pixel and axis that the sampler tells apart; iterations end at a step between two of them."""
_TAPS = 6  # samples on either side in the interpolation
_SINGLE_PRECISION_EPS = float(np.finfo(np.float32).eps)


@dataclass(frozen=True, eq=False)
class PatchRegistration:
    """Places at which reference patches were found in the other image."""

    xy: Array  # (N, 2) [px]
    correlation: Array  # (N,) of the patches after registration
    sigma: Array  # (N,) standard deviation of a coordinate [px], from the residual noise and the patch's detail
    ok: BoolArray  # (N,) settled, near its start, on valid pixels

    @staticmethod
    def none(start: Array) -> PatchRegistration:
        """Return an empty registration of points (N, 2)."""
        zero = np.zeros(len(start))
        return PatchRegistration(start.copy(), zero, zero + np.inf, zero > 0)

    def select(self, rows: IntArray) -> PatchRegistration:
        """Return the registration of some rows."""
        return PatchRegistration(*(column[rows] for column in field_values(self).values()))

    def put(self, rows: IntArray, found: PatchRegistration) -> None:
        """Add the registration of some rows."""
        for name, column in field_values(found).items():
            getattr(self, name)[rows] = column


def register_places(
    files: oriented.ImageFiles,
    band: int,
    reference: Array,
    start: Array,
    linear: Array,
    patch: int,
    readers: OpenReaders | None = None,
) -> PatchRegistration:
    """Register patches of two image files, each a path and its size, by `register_patches`, tile by tile.

    Where a size is a part of the file's, pixels are means of the file's (`PixelReader`).
    """
    cv2.setNumThreads(1)
    margin = patch + _TAPS + int(oriented.MAX_PATCH_SHIFT)
    sparse, every = _sparse(reference, margin), PatchRegistration.none(start)
    read, groups = (_mosaics, [np.arange(len(start))]) if sparse else (_window_pixels, _by_tile(reference, SPAN))
    (path, size), (other, beyond) = files
    with OpenReaders() as own:
        first, second = (readers or own).of(path, band, size), (readers or own).of(other, band, beyond)
        for rows in groups:
            a, valid_a, shift_a = read(first, size, reference[rows], margin)
            if not valid_a.any():  # nothing to look for
                continue
            b, valid_b, shift_b = read(second, beyond, start[rows], margin)
            places = reference[rows] - shift_a, start[rows] - shift_b
            found = register_patches((a, b), (valid_a, valid_b), *places, linear[rows], patch)
            every.put(rows, replace(found, xy=found.xy + shift_b))
    return every


ReadWindow = tuple[FloatImage, BoolArray, Array]
"""Pixels, the mask of valid ones, and the place of the image's origin (2,) or (N, 2) [px]."""


def _sparse(xy: Array, margin: int) -> bool:
    """Return whether windows about single points (N, 2) are less than half of the window about all."""
    return len(xy) * (2 * margin + 1) ** 2 < 0.5 * float(np.prod(np.ptp(xy, axis=0) + 2 * margin + 1))


def _window_pixels(reader: PixelReader, size: tuple[int, int], xy: Array, margin: int) -> ReadWindow:
    """Return the pixels about all points."""
    low, high = np.floor(xy.min(axis=0)).astype(int), np.ceil(xy.max(axis=0)).astype(int)
    box = grow((low[0], low[1], *(high - low + 1)), margin, size)
    pixels, usable = reader.read(box)
    return levelled(pixels, usable), usable, np.array(box[:2], dtype=np.float64)


def _mosaics(reader: PixelReader, size: tuple[int, int], xy: Array, margin: int) -> ReadWindow:
    """Return the pixels about every point, side by side in one picture without those between points."""
    side = 2 * margin + 1
    columns = int(np.ceil(np.sqrt(len(xy))))
    shape = -(-len(xy) // columns) * side, columns * side
    picture, usable = np.zeros(shape, np.float32), np.zeros(shape, dtype=bool)
    shift = np.empty((len(xy), 2))
    for number, corner in enumerate(np.rint(xy).astype(np.int64) - margin):
        col, row = number % columns * side, number // columns * side
        shift[number] = corner - (col, row)
        low, high = corner.clip(0), np.minimum(corner + side, size)
        if (high > low).all():
            pixels, known = reader.read((int(low[0]), int(low[1]), *(high - low).tolist()))
            if not known.any():
                continue
            (left, top), (right, below) = low - corner, corner + side - high
            place, border = np.s_[row : row + side, col : col + side], (top, below, left, right)
            picture[place] = cv2.copyMakeBorder(levelled(pixels, known), *border, cv2.BORDER_REFLECT_101)
            usable[row + top : row + side - below, col + left : col + side - right] = known
    return picture, usable, shift


def task_parts(origin: Array, links: IntArray, tile: int) -> list[IntArray]:
    """Return the links of each task: of whole tiles, or, where few, of bands of rows: blocks decode once."""
    if not _sparse(origin, PATCH + _TAPS + int(oriented.MAX_PATCH_SHIFT)):
        return [links[rows] for rows in _merge_groups(_by_tile(origin, tile), CHUNK)]
    order = np.lexsort((origin[:, 0], origin[:, 1] // SPAN))
    bands = np.split(order, np.flatnonzero(np.diff(origin[order, 1] // SPAN)) + 1)
    pieces = [piece for band in bands for piece in _chunks(band)]
    return [links[rows] for rows in _merge_groups(pieces, SPAN)]


def _chunks(rows: IntArray) -> list[IntArray]:
    """Return rows in parts of `SPAN` at most."""
    return [rows[first : first + SPAN] for first in range(0, len(rows), SPAN)]


def _by_tile(xy: Array, tile: int) -> list[IntArray]:
    """Return the rows of the points (N, 2) in every tile, row by row of tiles."""
    return grouped(*np.floor(xy[:, ::-1] / tile).astype(np.int64).T)


def _merge_groups(groups: Sequence[IntArray], most: int) -> list[IntArray]:
    """Merge consecutive groups while they hold at most `most` rows together."""
    parts: list[list[IntArray]] = []
    for group in groups:
        if not parts or sum(map(len, parts[-1])) + len(group) > most:
            parts.append([])
        parts[-1].append(group)
    return [np.concatenate(part) for part in parts]


PatchSearch = tuple[oriented.ImageFiles, Array, Array, Array, bool]
"""Patches of one image to be found in another: both files, reference, start, linear, whether structure is compared."""


def register_parts(parts: Sequence[PatchSearch], band: int) -> PatchRegistration:
    """Register patches by their grey values, or by channels of oriented gradients; `ok` where they are alike.

    Every file is opened once for all parts.
    """
    found = list[PatchRegistration]()
    with OpenReaders() as readers:
        for files, reference, start, linear, structural in parts:
            if structural:
                xy, ok, correlation = oriented.register_oriented(files, band, reference, start, linear, readers)
                found.append(PatchRegistration(xy, correlation, np.full(len(xy), SIGMA), ok))
            else:
                one = register_places(files, band, reference, start, linear, PATCH, readers)
                found.append(replace(one, ok=one.ok & (one.correlation >= MIN_CORRELATION)))
    return PatchRegistration(**join_fields(found))


def register_patches(
    images: tuple[FloatImage, FloatImage],
    valid: tuple[BoolArray, BoolArray],
    reference: Array,
    start: Array,
    linear: Array,
    patch: int,
) -> PatchRegistration:
    """Register patches of the second image to patches of the first; a patch, `patch` [px] a side (odd), is all valid.

    They are centred at `reference` (N, 2), whole pixels, and at about `start` (N, 2) [px] in the second image, with
    `linear` (N, 2, 2) a first guess of d(second)/d(first). What fails (at a border, on a steep slope) is tried again
    with a smaller patch; what succeeds must be confirmed by it.
    """
    best = PatchRegistration.none(start)
    if not all(mask.any() for mask in valid):
        return best
    fine, pictures = upsampled(images[1]), _with_derivatives(images[0])
    smaller = int(_INNER * patch) | 1
    for side in (patch, smaller):
        template = _Template(pictures, images[0].shape[1], side)
        whole = np.ones((side, side), np.uint8)
        usable = [cv2.erode(mask.astype(np.uint8), whole, borderValue=0) > 0 for mask in valid]
        possible = np.flatnonzero(~best.ok & _at(usable[0], reference) & _at(usable[1], start))
        for rows in _chunks(possible):
            found = template.find(fine, reference[rows].astype(np.int64), start[rows], linear[rows])
            best.put(rows, replace(found, ok=found.ok & _at(usable[1], found.xy)))
    for rows in _chunks(np.flatnonzero(best.ok)):  # on a step of the ground the inner part goes elsewhere
        inner = template.find(fine, reference[rows].astype(np.int64), best.xy[rows], linear[rows], 10 / _SAMPLER_STEPS)
        apart = np.hypot(*(inner.xy - best.xy[rows]).T)
        best.ok[rows] = apart <= 5.0 * np.maximum(SIGMA, inner.sigma)
    return best


def _at(mask: BoolArray, xy: Array) -> BoolArray:
    col, row = np.rint(np.nan_to_num(xy, nan=-1.0)).astype(np.int64).T
    inside = (col >= 0) & (row >= 0) & (col < mask.shape[1]) & (row < mask.shape[0])
    return np.asarray(inside & mask[row.clip(0, mask.shape[0] - 1), col.clip(0, mask.shape[1] - 1)])


def upsampled(image: FloatImage) -> FloatImage:
    """Upsample an image (H, W) by a windowed sinc to (4 H, 4 W): the sample (4 row, 4 col) is the pixel (row, col).

    Between these a linear sample moves no phase; OpenCV's bicubic one would, by up to a twentieth of the step.
    """
    one, border = np.ones(1, np.float32), cv2.BORDER_REFLECT_101
    across, down = (_TAPS - 1, 0), (0, _TAPS - 1)
    columns = [cv2.sepFilter2D(image, -1, kernel, one, None, across, 0.0, border) for kernel in _kernels()]
    wide = cv2.merge([image, *columns]).reshape(len(image), -1)
    out = np.empty((_SUBPIXEL_SAMPLES * len(image), wide.shape[1]), np.float32)
    out[::_SUBPIXEL_SAMPLES] = wide
    for phase, kernel in enumerate(_kernels(), start=1):
        cv2.sepFilter2D(wide, -1, one, kernel, out[phase::_SUBPIXEL_SAMPLES], down, 0.0, border)
    return out


def _kernels() -> list[FloatImage]:
    """Return the weights (2 `_TAPS`,) of the pixels about a point, for every fraction of a pixel but 0."""
    kernels = []
    for phase in range(1, _SUBPIXEL_SAMPLES):
        offset = np.arange(1 - _TAPS, _TAPS + 1) - phase / _SUBPIXEL_SAMPLES
        kernel = np.sinc(offset) * np.cos(0.5 * np.pi * offset / (_TAPS + 1)) ** 2
        kernels.append((kernel / kernel.sum()).astype(np.float32))
    return kernels


def _with_derivatives(image: FloatImage) -> list[FloatImage]:
    """Return the pixels (H W,) of an image and their derivatives by column and row."""
    derivative = np.array([1, -8, 0, 8, -1], np.float32) / 12
    smooth = np.array([1, 2, 1], np.float32) / 4
    by_col = cv2.sepFilter2D(image, -1, derivative, smooth)
    by_row = cv2.sepFilter2D(image, -1, smooth, derivative)
    return [np.asarray(one, np.float32).ravel() for one in (image, by_col, by_row)]


class _Template:
    """Reference patches of an image, ready to be found in another one."""

    def __init__(self, pictures: Sequence[FloatImage], width: int, patch: int) -> None:
        self._pictures, self._width = pictures, width
        half = patch // 2
        row, col = np.mgrid[-half : half + 1, -half : half + 1]
        self._half = half
        self._col, self._row = col.ravel(), row.ravel()
        weight = np.exp(-0.5 * (self._col**2 + self._row**2) / (_INNER * half) ** 2)
        self._effective = float(weight.sum() ** 2 / (weight**2).sum())  # pixels that count
        self._weight = (weight / weight.sum()).astype(np.float32)
        self._root = np.sqrt(self._weight)

    def _normalized(self, patches: FloatImage) -> tuple[FloatImage, FloatImage]:
        """Return the patches of weighted mean 0 and variance 1, and their standard deviations (N, 1)."""
        mean = (patches @ self._weight)[:, None]
        centred = patches - mean
        deviation = np.sqrt((centred * centred) @ self._weight)[:, None]
        flat = deviation**2 <= _SINGLE_PRECISION_EPS**2 * (1.0 + mean * mean)
        deviation = np.where(flat, np.float32(np.inf), deviation)
        return centred / deviation, deviation

    def find(
        self, fine: FloatImage, reference: IntArray, start: Array, linear: Array, settled: float = 1 / _SAMPLER_STEPS
    ) -> PatchRegistration:
        """Register the patches about `reference` (N, 2), begun at `start` with the distortion `linear`."""
        offset = self._row * self._width + self._col
        place = reference[:, 1:] * self._width + reference[:, :1] + offset
        image, by_col, by_row = (picture.take(place) for picture in self._pictures)
        values, deviation = self._normalized(image)
        x, y = (self._col / self._half).astype(np.float32), (self._row / self._half).astype(np.float32)
        jacobian = np.empty((len(reference), 8, len(offset)), np.float32)  # times the roots of the weights
        jacobian[:, 0], jacobian[:, 1] = (by * (self._root / deviation) for by in (by_col, by_row))
        for row, (by, lever) in enumerate(((0, x), (0, y), (1, x), (1, y)), start=2):
            np.multiply(jacobian[:, by], lever, out=jacobian[:, row])
        jacobian[:, 6], jacobian[:, 7] = values * self._root, self._root
        normal = (jacobian @ jacobian.transpose(0, 2, 1)).astype(np.float64)
        normal += _SINGLE_PRECISION_EPS * (1.0 + np.trace(normal, axis1=1, axis2=2))[:, None, None] * np.eye(8)
        inverse = np.asarray(np.linalg.inv(normal), np.float64)
        xy, step, correlation = self._iterate(fine, (jacobian, inverse), start.copy(), linear.copy(), settled)
        noise = np.maximum(1.0 - correlation**2, 0.0) / (self._effective - normal.shape[-1])
        sigma = np.sqrt(0.5 * (inverse[:, 0, 0] + inverse[:, 1, 1]) * noise).clip(_SINGLE_PRECISION_EPS)
        moved = np.hypot(*(xy - start).T)
        ok = (step <= 10 * settled) & (moved <= oriented.MAX_PATCH_SHIFT) & np.isfinite(sigma)
        return PatchRegistration(xy, correlation, sigma, ok)

    def _iterate(
        self, fine: FloatImage, solver: tuple[FloatImage, Array], centre: Array, linear: Array, settled: float
    ) -> tuple[Array, Array, Array]:
        """Return the centres after the iterations, their last steps' lengths [px], and the correlations.

        The gain between patches of variance 1, where nothing else is left to fit, is their correlation.
        """
        length, gain = np.full(len(centre), np.inf), np.zeros(len(centre))
        active = np.arange(len(centre))
        jacobian, inverse = solver
        for _ in range(NEWTON_STEPS):
            # else the sampler would round, and we not know
            sampled = np.rint(centre[active] * _SAMPLER_STEPS) / _SAMPLER_STEPS
            patches = self._normalized(self._sample(fine, sampled, linear[active]))[0]
            right = (jacobian @ (self._root * patches)[:, :, None]).astype(np.float64)
            solution = (inverse @ right)[:, :, 0]
            gain[active] = solution[:, 6]
            change = solution[:, :6] / np.maximum(solution[:, 6:7], 0.2)
            shift = np.clip(change[:, :2], -1.0, 1.0)
            distortion = np.clip(change[:, 2:].reshape(-1, 2, 2) / self._half, -0.2, 0.2)
            linear[active] = linear[active] @ np.linalg.inv(np.eye(2) + distortion)
            moved = sampled - (linear[active] @ shift[:, :, None])[:, :, 0]
            length[active] = np.hypot(*(moved - centre[active]).T)
            centre[active] = moved
            going = length[active] > settled
            if not going.any():
                break
            if not going.all():
                active, jacobian, inverse = active[going], jacobian[going], inverse[going]
        return centre, length, gain

    def _sample(self, fine: FloatImage, centre: Array, linear: Array) -> FloatImage:
        """Return the patches (N, P) of the other image about centres (N, 2) under distortions (N, 2, 2)."""
        offsets = np.stack([self._col, self._row]).astype(np.float32)
        where = _SUBPIXEL_SAMPLES * (linear.astype(np.float32) @ offsets + centre.astype(np.float32)[:, :, None])
        border = cv2.BORDER_REFLECT_101
        patches = cv2.remap(fine, where[:, 0], where[:, 1], cv2.INTER_LINEAR, borderMode=border)
        return np.asarray(patches, np.float32)
