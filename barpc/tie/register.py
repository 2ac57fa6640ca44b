"""Sub-pixel registration: every observation of a track is registered to ONE reference patch.

The reference is the patch around the keypoint in the track's most central view, at a whole pixel, so that
it needs no interpolation and defines the point exactly: errors do not chain from view to view. The patch
of another view is pre-warped by the cameras' local derivative and registered by least squares with an
affine distortion, gain and bias (Gruen 1985), in the inverse compositional form (Baker and Matthews 2004):
the derivative is that of the reference, so one small pseudo-inverse a match serves all iterations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from barpc.geodesy import Array
from barpc.scene import BoolArray, IntArray
from barpc.tie.raster import Box, FloatImage, levelled, read_pixels

FloatArray = npt.NDArray[np.float32]

_CHUNK = 256  # patches worked on at a time: they stay in cache
_STEPS = 12
_SETTLED = 0.003  # px; a step below it is the last
_SMALLER = 0.7  # side of the patch of the second try and of the check
_TORN = 0.5  # px that the smaller patch may lie apart
_FINE = 4  # samples a pixel and axis
_GRID = 1.0 / (32 * _FINE)  # px; positions that the sampler tells apart
_REACH = 1.5  # px; a patch that moves farther has left its point
_WEIGHT = 0.7  # standard deviation of the patch's Gaussian weight, in half sides
_MIN_DETAIL = 1e-12  # relative variance below which a patch is flat
_LEAST_SIGMA = 1e-3  # px
_TAPS = 6  # samples on either side in the interpolation
_RIDGE = 1e-6


@dataclass(frozen=True, eq=False)
class Registration:
    """Where the reference patches were found.

    Parameters
    ----------
    xy : (N, 2)
        col, row in the other image [px].
    correlation : (N,)
        Of the patches after registration.
    sigma : (N,)
        Standard deviation of a coordinate [px], from the residual noise and the patch's detail.
    ok : (N,)
        Settled, near its start, on valid pixels.
    """

    xy: Array
    correlation: Array
    sigma: Array
    ok: BoolArray


def register_places(
    files: tuple[tuple[str, tuple[int, int]], tuple[str, tuple[int, int]]],
    band: int,
    reference: Array,
    start: Array,
    linear: Array,
    patch: int,
) -> Registration:
    """Read what is needed of two images, each a path and its size, and register as `register` does."""
    cv2.setNumThreads(1)
    margin = patch + _TAPS + int(_REACH)
    images, valid, origins = [], [], []
    for (path, size), xy in zip(files, (reference, start), strict=True):
        box = _around(xy, margin, size)
        pixels, usable = read_pixels(path, box, band)
        images.append(levelled(pixels, usable))
        valid.append(usable)
        origins.append(np.array(box[:2], dtype=np.float64))
    places = reference - origins[0], start - origins[1]
    found = register((images[0], images[1]), (valid[0], valid[1]), *places, linear, patch)
    return replace(found, xy=found.xy + origins[1])


def _around(xy: Array, margin: int, size: tuple[int, int]) -> Box:
    low = np.clip(np.floor(xy.min(axis=0)).astype(int) - margin, 0, np.array(size) - 1)
    high = np.clip(np.ceil(xy.max(axis=0)).astype(int) + margin + 1, low + 1, size)
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def _usable(valid: BoolArray, patch: int) -> BoolArray:
    """Pixels about which a whole patch is valid and inside."""
    kernel = np.ones((patch, patch), np.uint8)
    eroded = cv2.erode(valid.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    usable: BoolArray = eroded > 0
    return usable


def register(
    images: tuple[FloatImage, FloatImage],
    valid: tuple[BoolArray, BoolArray],
    reference: Array,
    start: Array,
    linear: Array,
    patch: int,
) -> Registration:
    """Register patches of the second image to patches of the first.

    What fails (at a border, on a steep slope) is tried again with a smaller patch; what succeeds must be
    confirmed by it.

    Parameters
    ----------
    images, valid : two (height, width) arrays
        Reference and other image, and the pixels that mean something: a patch holds no others.
    reference, start : (N, 2)
        Centres in the reference image, whole pixels; where they are about in the other one [px].
    linear : (N, 2, 2)
        First guess of d(other)/d(reference).
    patch : int
        Side of the patches [px], odd.
    """
    fine = _upsampled(images[1])
    best = Registration(
        np.array(start), np.zeros(len(start)), np.full(len(start), np.inf), np.zeros(len(start), dtype=bool)
    )
    smaller = int(_SMALLER * patch) | 1
    for side in (patch, smaller):
        template = _Template(images[0], side)
        usable = [_usable(mask, side) for mask in valid]
        possible = np.flatnonzero(~best.ok & _at(usable[0], reference) & _at(usable[1], start))
        for rows in _chunks(possible):
            found = template.find(fine, reference[rows].astype(np.int64), start[rows], linear[rows])
            best.xy[rows], best.correlation[rows], best.sigma[rows] = found.xy, found.correlation, found.sigma
            best.ok[rows] = found.ok & _at(usable[1], found.xy)
    for rows in _chunks(np.flatnonzero(best.ok)):  # on a step of the ground the inner part goes elsewhere
        inner = template.find(fine, reference[rows].astype(np.int64), best.xy[rows], linear[rows])
        apart = np.hypot(*(inner.xy - best.xy[rows]).T)
        best.ok[rows] = apart <= np.maximum(_TORN, 5.0 * inner.sigma)
    return best


def _chunks(rows: IntArray) -> list[IntArray]:
    return [rows[first : first + _CHUNK] for first in range(0, len(rows), _CHUNK)]


def _at(mask: BoolArray, xy: Array) -> BoolArray:
    col, row = np.rint(np.nan_to_num(xy, nan=-1.0)).astype(np.int64).T
    inside = (col >= 0) & (row >= 0) & (col < mask.shape[1]) & (row < mask.shape[0])
    out: BoolArray = inside & mask[row.clip(0, mask.shape[0] - 1), col.clip(0, mask.shape[1] - 1)]
    return out


def _upsampled(image: FloatImage) -> FloatImage:
    """More samples a side, by a windowed sinc; the sample `_FINE` (row, col) is the pixel (row, col).

    Between these a linear sample moves no phase; OpenCV's bicubic one would, by up to a twentieth of the step.
    """
    wide = np.empty((image.shape[0], _FINE * image.shape[1]), np.float32)
    out = np.empty((_FINE * image.shape[0], wide.shape[1]), np.float32)
    one, border = np.ones(1, np.float32), cv2.BORDER_REFLECT_101
    for phase, kernel in enumerate(_kernels()):
        wide[:, phase::_FINE] = cv2.sepFilter2D(image, -1, kernel, one, None, (_TAPS - 1, 0), 0.0, border)
    for phase, kernel in enumerate(_kernels()):
        out[phase::_FINE] = cv2.sepFilter2D(wide, -1, one, kernel, None, (0, _TAPS - 1), 0.0, border)
    return out


def _kernels() -> list[FloatArray]:
    """Weights (2 `_TAPS`,) of the pixels about a point, for every fraction of a pixel."""
    kernels = []
    for phase in range(_FINE):
        offset = np.arange(1 - _TAPS, _TAPS + 1) - phase / _FINE
        kernel = np.sinc(offset) * np.cos(0.5 * np.pi * offset / (_TAPS + 1)) ** 2
        kernels.append((kernel / kernel.sum()).astype(np.float32))
    return kernels


class _Template:
    """Reference patches of an image, ready to be found in another one."""

    def __init__(self, image: FloatImage, patch: int) -> None:
        self._image = image
        derivative = np.array([1, -8, 0, 8, -1], np.float32) / 12
        smooth = np.array([1, 2, 1], np.float32) / 4
        self._by_col = cv2.sepFilter2D(image, -1, derivative, smooth)
        self._by_row = cv2.sepFilter2D(image, -1, smooth, derivative)
        half = patch // 2
        row, col = np.mgrid[-half : half + 1, -half : half + 1]
        self._half = half
        self._col, self._row = col.ravel(), row.ravel()
        weight = np.exp(-0.5 * (self._col**2 + self._row**2) / (_WEIGHT * half) ** 2)
        self._effective = float(weight.sum() ** 2 / (weight**2).sum())  # pixels that count
        self._weight = (weight / weight.sum()).astype(np.float32)

    def _normalized(self, patches: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Patches of weighted mean 0 and variance 1, and their standard deviations (N, 1)."""
        mean = (patches @ self._weight)[:, None]
        centred = patches - mean
        deviation = np.sqrt((centred * centred) @ self._weight)[:, None]
        flat = deviation**2 <= _MIN_DETAIL * (1.0 + mean * mean)
        deviation = np.where(flat, np.float32(np.inf), deviation)
        return centred / deviation, deviation

    def find(self, fine: FloatImage, reference: IntArray, start: Array, linear: Array) -> Registration:
        """Register the patches about `reference` (N, 2), begun at `start` with the distortion `linear`."""
        cols, rows = reference[:, :1] + self._col, reference[:, 1:] + self._row
        values, deviation = self._normalized(self._image[rows, cols])
        by_col, by_row = self._by_col[rows, cols] / deviation, self._by_row[rows, cols] / deviation
        x, y = (self._col / self._half).astype(np.float32), (self._row / self._half).astype(np.float32)
        affine = [by_col, by_row, by_col * x, by_col * y, by_row * x, by_row * y]
        jacobian = np.stack([*affine, values, np.ones_like(values)], axis=1)
        weighted = jacobian * self._weight
        normal = (weighted @ jacobian.transpose(0, 2, 1)).astype(np.float64)
        normal += _RIDGE * (1.0 + np.trace(normal, axis1=1, axis2=2))[:, None, None] * np.eye(8)
        inverse = np.linalg.inv(normal)
        solver = inverse.astype(np.float32) @ weighted
        xy, step = self._iterate(fine, solver, start.copy(), linear.copy())
        sampled = self._normalized(self._sample(fine, *xy))[0]
        correlation = ((sampled * values) @ self._weight).astype(np.float64)
        noise = np.maximum(1.0 - correlation**2, 0.0) / (self._effective - 8.0)
        sigma = np.sqrt(0.5 * (inverse[:, 0, 0] + inverse[:, 1, 1]) * noise).clip(_LEAST_SIGMA)
        moved = np.hypot(*(xy[0] - start).T)
        ok = (step <= 10 * _SETTLED) & (moved <= _REACH) & np.isfinite(sigma)
        return Registration(xy[0], correlation, sigma, ok)

    def _iterate(
        self, fine: FloatImage, solver: FloatArray, centre: Array, linear: Array
    ) -> tuple[tuple[Array, Array], Array]:
        """Centres and distortions after the iterations, and the length of each one's last step [px]."""
        length = np.full(len(centre), np.inf)
        active = np.arange(len(centre))
        for _ in range(_STEPS):
            sampled = np.rint(centre[active] / _GRID) * _GRID  # else the sampler would round, and we not know
            patches = self._normalized(self._sample(fine, sampled, linear[active]))[0]
            solution = (solver[active] @ patches[:, :, None])[:, :, 0].astype(np.float64)
            change = solution[:, :6] / np.maximum(solution[:, 6:7], 0.2)  # gain: how like the patches are
            shift = np.clip(change[:, :2], -1.0, 1.0)
            distortion = np.clip(change[:, 2:].reshape(-1, 2, 2) / self._half, -0.2, 0.2)
            linear[active] = linear[active] @ np.linalg.inv(np.eye(2) + distortion)
            moved = sampled - (linear[active] @ shift[:, :, None])[:, :, 0]
            length[active] = np.hypot(*(moved - centre[active]).T)
            centre[active] = moved
            active = active[length[active] > _SETTLED]
            if not len(active):
                break
        return (centre, linear), length

    def _sample(self, fine: FloatImage, centre: Array, linear: Array) -> FloatArray:
        """Patches (N, P) of the other image about centres (N, 2) under distortions (N, 2, 2)."""
        offsets = np.stack([self._col, self._row]).astype(np.float32)
        where = _FINE * (linear.astype(np.float32) @ offsets + centre.astype(np.float32)[:, :, None])
        return np.asarray(
            cv2.remap(fine, where[:, 0], where[:, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101),
            np.float32,
        )
