"""Dense matching of a part of two images: resampled along their epipolar lines, matched both ways by OpenCV's SGBM."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from barpc.base.geodesy import Array, Box, ByteImage, IntArray, parts
from barpc.scene import BoolArray
from barpc.tie.pixels import FloatImage, Stretch, levelled, read_pixels

ACROSS = 0.02
"""A part in which an affine frame misses the epipolar lines by more [px] is too large for one."""
COLUMNS_PER_PIXEL = 2
"""Columns of the frame a pixel: heights of a Pleiades triplet differ by 0.62 m (NMAD), with one by 0.83 m."""
_ALLOWANCE = 4.0
"""Pixels of a coarser picture that a surface may lie beyond what that shows."""
WINDOW = 7
"""Pixels a side over which the step of least squares compares grey values, and matches of one surface are averaged."""
SGBM = {
    "blockSize": 5,
    "P1": 16 * 5**2,  # twice OpenCV's own, as disparities are twice as fine: 0.62 m, of its own 0.71 m
    "P2": 64 * 5**2,
    "preFilterCap": 63,  # of 15, OpenCV's own, 0.96 m in place of 0.83 m: it cuts strong edges
    "uniquenessRatio": 5,
    "speckleWindowSize": 100,
    "speckleRange": 4,
    "disp12MaxDiff": -1,  # asked for here, of a second pass
    "mode": cv2.STEREO_SGBM_MODE_SGBM_3WAY,  # 0.64 m, of five ways 0.62 m at half as much time again
}
_STRIP_ROWS = 64  # rows refined together, which stay in cache
NOISE_VARIANCE, SLOPE_VARIANCE = 0.741, 0.305  # in the frame, of white noise of variance 1 and of its slope


@dataclass(frozen=True, eq=False)
class EpipolarFrame:
    """Affine maps (2, 2, 3) of two images to a frame whose rows are epipolar lines, and the part to be matched.

    `places` (N, 2) [px of the frame]: points about the part; `num`: disparities, from 0 on; `across`: how far rows miss
    the lines at most [px]; `altitude` (4,): of a match, by col, row of the frame, disparity and 1 [m].
    """

    maps: Array
    places: Array
    num: int
    across: float
    altitude: Array

    @property
    def metres(self) -> float:
        """Height that a pixel of disparity stands for [m]."""
        return abs(float(self.altitude[2])) * COLUMNS_PER_PIXEL


@dataclass(frozen=True, eq=False)
class DenseMatches:
    """Dense matches: their `place` (3, n): col, row in the frame, disparity; standard deviations along lines [px].

    `share`: of the pixels that both images show so many were matched.
    """

    frame: EpipolarFrame
    place: Array
    sigma: Array
    share: float

    def some(self, of: slice | IntArray) -> DenseMatches:
        """Return some of the matches."""
        return replace(self, place=self.place[:, of], sigma=self.sigma[of])

    @property
    def a(self) -> Array:
        """Places (n, 2) in the first image [px]."""
        return _back(self.frame.maps[0], self.place[:2].T)

    @property
    def b(self) -> Array:
        """Places (n, 2) in the second image [px]."""
        col, row, disparity = self.place
        return _back(self.frame.maps[1], np.column_stack([col - disparity, row]))

    @property
    def alt(self) -> Array:
        """Start altitudes (n,) [m]."""
        return np.asarray(self.frame.altitude[:3] @ self.place + self.frame.altitude[3])


def epipolar_frame(a: Array, b: Array, alt: Array) -> EpipolarFrame:
    """Estimate the epipolar frame of a part of two images from ground points at several altitudes.

    Parameters
    ----------
    a, b : (N, 2), col, row [px]; at least three altitudes, at each at least three points
    alt : (N,), altitudes [m]
    """
    both = np.hstack([a, b])
    mean = both.mean(axis=0)
    normal = np.linalg.svd(both - mean, full_matrices=False)[2][-1]  # normal . (a, b) is the same everywhere
    normal = normal if normal[1] > 0 else -normal
    lengths = np.hypot(*normal[:2]), np.hypot(*normal[2:])
    scale = np.sqrt(lengths[0] * lengths[1])
    first = np.zeros((2, 3))
    first[0, :2] = np.array([normal[1], -normal[0]]) * (COLUMNS_PER_PIXEL / lengths[0])
    first[1] = np.array([*normal[:2], -normal[:2] @ mean[:2]]) / scale
    along = a @ first[0, :2]
    middle = np.abs(alt - np.median(alt)) < 1e-6 * (1.0 + np.ptp(alt))
    system = np.column_stack([b, np.ones(len(b))])
    second = np.array(
        [
            np.linalg.lstsq(system[middle], along[middle], rcond=None)[0],
            np.array([*-normal[2:], normal[2:] @ mean[2:]]) / scale,
        ]
    )
    disparity = along - system @ second[0]
    second[0, 2] += np.floor(disparity.min()) - COLUMNS_PER_PIXEL
    disparity = along - system @ second[0]
    num = 16 * int(np.ceil((disparity.max() + 2 * COLUMNS_PER_PIXEL) / 16))
    rows = a @ first[1, :2] + first[1, 2]
    across = float(np.abs(rows - system @ second[1]).max())
    known = np.column_stack([along, rows, disparity, np.ones(len(a))])
    altitude = np.linalg.lstsq(known, alt, rcond=None)[0]
    return EpipolarFrame(np.stack([first, second]), known[:, :2], num, across, altitude)


def dense_matches(
    images: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    frame: EpipolarFrame,
    band: int,
    coarse: tuple[Array, Array, float] | None = None,
) -> DenseMatches | None:
    """Match a part of two images; None where they do not show enough of it.

    Parameters
    ----------
    images : paths of both; pictures of them of `sizes` (width, height) are matched, means of whole pixels
    frame : EpipolarFrame, of places in these pictures
    band : int, the band that is read, from 1
    coarse : two arrays (n, 2), matches of coarser pictures as places [px] in these, and the side of their pixels: the
        surface is looked for about them
    """
    window = _frame_window(sizes, frame)
    if window is None:
        return None
    low, shape = window
    beside = frame.num // 2  # columns that the right picture begins before the left one: disparities are about zero
    pictures = [
        _picture_in_frame(path, size, np.column_stack([one[:, :2], one[:, 2] - low + [more, 0.0]]), shape, band)
        for path, size, one, more in zip(images, sizes, frame.maps, (0, beside), strict=True)
    ]
    if any(one is None for one in pictures):
        return None
    (left, shown_left), (right, shown_right) = pictures  # type: ignore[misc]
    both = shown_left & shown_right
    about = None if coarse is None else _coarse_disparity(coarse, frame, low, shape)
    if about is None or about[2] >= frame.num:
        disparity, good = _both_ways(left, right, -beside, frame.num)
    else:
        level, first, num = about
        edge = max(0, beside - max(first + num, -first))  # at either side, which a narrower search does without
        inner, beside = slice(edge, shape[0] - edge), beside + edge
        left, shown_left, both = np.ascontiguousarray(left[:, inner]), shown_left[:, inner], both[:, inner]
        disparity, good = _about_coarse(left, right, level[:, inner] - beside, first, num)
        low[0] += edge
    good &= shown_left & (_warped(shown_right.astype(np.uint8), _places(disparity), cv2.INTER_NEAREST) > 0)
    matched = (good & _part_mask((left.shape[1], shape[1]), low, frame))[:, ::COLUMNS_PER_PIXEL]  # a match a pixel
    moves, sigma = refined_disparity(left, right, disparity, good)
    # the mean of those about it that differ by less than a pixel or so, which is one surface
    moves = np.where(good[:, ::COLUMNS_PER_PIXEL], moves, np.float32(-2 * frame.num))
    moves = cv2.bilateralFilter(moves, WINDOW, sigmaColor=COLUMNS_PER_PIXEL, sigmaSpace=np.inf)
    row, col = np.nonzero(matched)
    place = np.stack([COLUMNS_PER_PIXEL * col + low[0], row + low[1], moves[row, col] + np.float64(beside)])
    share = np.count_nonzero(good) / max(int(np.count_nonzero(both)), 1)
    return DenseMatches(frame, place, sigma[row, col].astype(np.float64), share)


def _frame_window(sizes: Sequence[tuple[int, int]], frame: EpipolarFrame) -> tuple[Array, tuple[int, int]] | None:
    """Return the first pixel (2,) and width, height of the part as far as both images reach, with margins."""
    margin = COLUMNS_PER_PIXEL * WINDOW  # matched, too: paths of SGBM begin at the ends
    low, high = frame.places.min(axis=0) - margin, frame.places.max(axis=0) + margin
    reach = np.array([frame.num, 0.0])
    for size, one, more in zip(sizes, frame.maps, (np.zeros(2), reach), strict=True):
        corners = (np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size - 0.5) @ one[:, :2].T + one[:, 2]
        low, high = np.maximum(low, corners.min(axis=0)), np.minimum(high, corners.max(axis=0) + more)
    if (high - low < 2 * margin).any():
        return None
    low, high = np.floor(low - reach / 2), np.ceil(high + reach / 2)
    return low, (int(high[0] - low[0]) + margin, int(high[1] - low[1]))  # SGBM leaves the last ones out


def _part_mask(shape: tuple[int, int], low: Array, frame: EpipolarFrame) -> BoolArray:
    """Return the pixels of the window that belong to the part."""
    hull = cv2.convexHull((frame.places - low).astype(np.float32))
    mask = cv2.fillConvexPoly(np.zeros(shape[::-1], np.uint8), np.rint(hull).astype(np.int32), 1)
    return np.asarray(mask > 0)


def _back(one: Array, place: Array) -> Array:
    """Return the image points (n, 2) of places (n, 2) in the frame."""
    return (place - one[:, 2]) @ np.linalg.inv(one[:, :2]).T


def _picture_in_frame(
    path: str, size: tuple[int, int], one: Array, shape: tuple[int, int], band: int
) -> tuple[ByteImage, BoolArray] | None:
    """Return an image in the frame, in 8 bits, and where it is known; None without valid pixels there."""
    corners = _back(one, np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]) * shape)
    low = np.clip(np.floor(corners.min(axis=0)).astype(int) - 2, 0, size)
    high = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 3, 0, size)
    if (high - low < 2).any():
        return None
    box: Box = int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])
    raw, valid = read_pixels(path, box, band, size)
    pixels = levelled(raw, valid)
    stretch = Stretch.of(pixels[valid])
    if stretch is None:
        return None
    picture = stretch.apply(pixels, valid)
    # the affine map of the box's own pixels; positions are rounded to 1/32 px, 0.016 px at most
    to_frame = np.column_stack([one[:, :2], one[:, 2] + one[:, :2] @ low])
    cv2.setNumThreads(1)  # the work is spread by processes
    moved = cv2.warpAffine(picture, to_frame, shape, flags=cv2.INTER_CUBIC)
    shown = cv2.warpAffine(valid.astype(np.uint8) * 255, to_frame, shape, flags=cv2.INTER_LINEAR)
    return np.asarray(moved, np.uint8), np.asarray(shown == 255)


def _coarse_disparity(
    coarse: tuple[Array, Array, float], frame: EpipolarFrame, low: Array, shape: tuple[int, int]
) -> tuple[FloatImage, int, int]:
    """Return smooth disparities (rows, columns) through coarser matches, and the first and number of those about it."""
    a, b = (place @ one[:, :2].T + one[:, 2] - low for place, one in zip(coarse, frame.maps, strict=False))
    side = int(np.ceil(COLUMNS_PER_PIXEL * coarse[2]))  # columns of a coarser pixel, and as many rows: a cell
    disparity, octaves = a[:, 0] - b[:, 0], int(np.ceil(np.log2(max(shape) / side + 1.0)))
    count = 1 << octaves
    col, row = np.clip((a / side).astype(np.int64), 0, count - 1).T
    sums = [
        np.stack([np.bincount(row * count + col, one, count**2).reshape(count, count) for one in (None, disparity)])
    ]
    for octave in range(octaves - 1, -1, -1):
        sums.append(sums[-1].reshape(2, 1 << octave, 2, 1 << octave, 2).sum(axis=(2, 4)))
    level = np.full((1, 1), float(np.median(disparity)))
    for known, total in reversed(sums):  # what is far counts where nothing is near
        near, of = (cv2.GaussianBlur(one, (0, 0), 1.0) for one in (known, total))
        level = cv2.resize(level, known.shape, interpolation=cv2.INTER_LINEAR)
        level += near / (near + 1.0) * (of / np.maximum(near, np.finfo(np.float64).tiny) - level)
    level = cv2.resize(level.astype(np.float32), None, fx=side, fy=side, interpolation=cv2.INTER_LINEAR)
    level = level[: shape[1], : shape[0]]
    place = np.clip(np.rint(a).astype(np.int64), 0, np.array(shape) - 1)
    beside = disparity - level[place[:, 1], place[:, 0]]
    first, last = span_of_surface(beside, coarse[2] * COLUMNS_PER_PIXEL)
    first = int(np.floor(first))
    return np.asarray(level, np.float32), first, 16 * int(np.ceil((last - first) / 16))


def span_of_surface(values: Array, pixel: float) -> tuple[float, float]:
    """Return the ends of a surface of which a coarser picture shows `values` (n,), a pixel of it standing for `pixel`.

    Values of the hundredth part at either end are not believed.
    """
    low, high = np.percentile(values, [1.0, 99.0])
    return float(low - _ALLOWANCE * pixel), float(high + _ALLOWANCE * pixel)


def _about_coarse(
    left: ByteImage, right: ByteImage, level: FloatImage, first: int, num: int
) -> tuple[FloatImage, BoolArray]:
    """Match as `_both_ways`, right where it is bent so that the coarse surface has no disparity."""
    bent = np.asarray(_warped(right, _places(level), cv2.INTER_CUBIC), np.uint8)
    beside, good = _both_ways(left, bent, first, num)
    return np.asarray(beside + _warped(level, _places(beside), cv2.INTER_LINEAR), np.float32), good


def _both_ways(left: ByteImage, right: ByteImage, first: int, num: int) -> tuple[FloatImage, BoolArray]:
    """Match both ways: `num` disparities of `left` from the first on, kept where the way back from `right` ends at most
    a pixel beside.
    """
    matcher = cv2.StereoSGBM.create(minDisparity=first, numDisparities=num, **SGBM)
    there = matcher.compute(left, right)
    turned = [np.ascontiguousarray(one[:, ::-1]) for one in (right, left)]
    back = np.ascontiguousarray(matcher.compute(*turned)[:, ::-1])
    scale = cv2.StereoMatcher_DISP_SCALE
    disparity = there * np.float32(1 / scale)
    met = _warped(back, _places(disparity), cv2.INTER_NEAREST)
    return disparity, (there >= first * scale) & (np.abs(there - met) <= COLUMNS_PER_PIXEL * scale)


def refined_disparity(left: ByteImage, right: ByteImage, disparity: FloatImage, good: BoolArray) -> FloatImage:
    """Refine SGBM's disparities [columns] by a step of least squares matching; return them and their sigmas [px]
    (2, rows, pixels), of each pixel's first column.

    SGBM locks to whole columns and lags on slopes; the step does not. A window's grey values are a gain, an offset and
    a shift along the line of the other's; noise is what these leave. Noise is in the slopes, too, and is taken out of
    what they tell. The step counts by the variance of SGBM's word over the sum of both.
    """
    found, reach = [], WINDOW - 1  # of the windows about pixels that were moved by the means of theirs
    for part in parts(len(left), _STRIP_ROWS):
        top = max(part.start - reach, 0)
        near = slice(top, part.stop + reach)
        strip = _least_squares_step(left[near], right[near], disparity[near], good[near])
        found.append(strip[:, part.start - top : part.stop - top])
    return np.concatenate(found, axis=1)


def _least_squares_step(left: ByteImage, right: ByteImage, disparity: FloatImage, good: BoolArray) -> FloatImage:
    """Return the refined disparities and sigmas of a strip of rows, with rows about it that its windows reach."""
    weight = good.astype(np.float32)
    side = COLUMNS_PER_PIXEL * WINDOW, WINDOW
    total = np.maximum(cv2.boxFilter(weight, cv2.CV_32F, side), 1e-3)
    level = cv2.boxFilter(disparity * weight, cv2.CV_32F, side) / total
    square = cv2.boxFilter(disparity * disparity * weight, cv2.CV_32F, side) / total
    even = square - level**2 < 1.0  # a column: no edge of a roof in the window
    start = np.where(good & even, level, disparity)
    places = _places(start)
    b = _warped(right.astype(np.float32), places, cv2.INTER_CUBIC)
    slope = _slopes(left) + _warped(_slopes(right), places, cv2.INTER_LINEAR)
    total = np.ascontiguousarray(total[:, ::COLUMNS_PER_PIXEL])

    def mean(values: FloatImage) -> FloatImage:
        """Return the means over the windows about each pixel's first column: of it and the column before together."""
        pixels = values[:, ::2].copy()
        pixels[:, 1:] += values[:, 1:-1:2]
        pixels[:, 0] += values[:, 1]
        return np.asarray(cv2.boxFilter(pixels, cv2.CV_32F, (WINDOW, WINDOW)) / (2 * total), np.float32)

    a, b, s = (one * weight for one in (left, b, slope))
    level_a, level_b, level_s = mean(a), mean(b), mean(s)
    aa, bb, ss = mean(a * a) - level_a**2, mean(b * b) - level_b**2, mean(s * s) - level_s**2
    ab, bs, a_s = mean(a * b) - level_a * level_b, mean(b * s) - level_b * level_s, mean(a * s) - level_a * level_s
    bb = np.maximum(bb, 1e-3)
    told = np.maximum(ss - bs**2 / bb, 1e-3)
    shift = (a_s - ab * bs / bb) / told
    pixels, hat = WINDOW**2 * total, 2 / 12  # variance of two roundings: of grey values, of what SGBM says [columns^2]
    left_over = np.maximum(aa - ab**2 / bb - told * shift**2, 0.0)
    noise = np.maximum(left_over * pixels / np.maximum(pixels - 3, 1) / NOISE_VARIANCE, hat)  # 3: the unknowns
    variance = noise / pixels / np.maximum(told - noise * SLOPE_VARIANCE / 4, 0.1 * told)
    found, near = start[:, ::COLUMNS_PER_PIXEL] - shift * (hat / (hat + variance)), disparity[:, ::COLUMNS_PER_PIXEL]
    return np.stack([np.clip(found, near - 1.0, near + 1.0), np.sqrt(variance) / COLUMNS_PER_PIXEL])


def _slopes(picture: ByteImage) -> FloatImage:
    """Return half the slopes of a picture along its rows, per column."""
    return np.asarray(cv2.Sobel(picture, cv2.CV_32F, 1, 0, ksize=1, scale=0.25), np.float32)


def _places(disparity: FloatImage) -> tuple[FloatImage, FloatImage]:
    """Return the col, row of the right picture that the left one's pixels are at by their disparities."""
    cols, rows = np.meshgrid(*(np.arange(side, dtype=np.float32) for side in disparity.shape[::-1]))
    return cols - disparity, rows


def _warped(values: npt.NDArray[Any], places: tuple[FloatImage, FloatImage], how: int) -> npt.NDArray[Any]:
    """Return the right picture resampled at places in it."""
    return np.asarray(cv2.remap(values, *places, how))
