"""Contrast-blind dense matching: patches as channels of oriented gradients, correlated.

Where a season, a sun or a sensor changes grey values, edges keep their place and their direction, not their sign. Every
pixel becomes its gradient with twice its angle, which is the same for both signs, blurred over neighbours and
normalised: what has no direction says nothing. These are two numbers; more orientations (CFOG, Ye et al. 2019) say
no more. Templates are
correlated densely within a search area; beside it lies a decoy area of the same size, where nothing true can be: a
peak counts where it is higher than the decoy's, and where the way back ends where it began.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from barpc.geodesy import Array
from barpc.scene import BoolArray, IntArray
from barpc.tie.pixels import FloatImage

CHANNELS = 2
COARSE, FINE = (0.8, 0.8), (1.0, 0.7)
"""How far pictures are blurred [px] before the gradients, and the channels: to be found, and to be found exactly."""
_WEAK = 0.5  # of the median gradient: what is weaker is noise
EDGE = 6
"""Pixels so near to invalid ones know of them [px]."""
BATCH = 32
"""Templates that are correlated at a time."""
_STEPS = 5
SETTLED = 0.003
"""A step below it is the last [px]."""
_GAP = 5  # px between a search area and its decoy: where a true peak ends
SHOWN = 0.9
"""Part of a template that must be a picture."""


def channels(pixels: FloatImage, valid: BoolArray, blurs: tuple[float, float] = COARSE) -> FloatImage:
    """Return the channels (CHANNELS, H, W) of a picture (H, W), blurred twice [px]; zeros beside what is not valid."""
    cv2.setNumThreads(1)
    filled = np.where(valid, pixels, np.float32(pixels[valid].mean() if valid.any() else 0.0))
    smooth = cv2.GaussianBlur(filled.astype(np.float32), (0, 0), blurs[0])
    east, south = cv2.Scharr(smooth, cv2.CV_32F, 1, 0), cv2.Scharr(smooth, cv2.CV_32F, 0, 1)
    length = np.sqrt(east**2 + south**2)
    doubled = np.stack([east**2 - south**2, 2.0 * east * south]) / (length + np.float32(1e-12))
    found = np.stack([cv2.GaussianBlur(part, (0, 0), blurs[1]) for part in doubled])
    size = cv2.GaussianBlur(length, (0, 0), blurs[1])
    known = cv2.erode(valid.astype(np.uint8), np.ones((2 * EDGE + 1,) * 2, np.uint8), borderValue=1) > 0
    weak = _WEAK * float(np.median(size[known])) if known.any() else 0.0
    return np.asarray(found * (known / (size + np.float32(weak + 1e-12))), np.float32)


def correlation(template: FloatImage, search: FloatImage) -> FloatImage:
    """Return the correlation coefficients (B, H - h + 1, W - w + 1) of templates (B, C, h, w) within areas
    (B, C, H, W).
    """
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


@dataclass(frozen=True, eq=False)
class FoundTemplates:
    """Places at which templates were found.

    Parameters
    ----------
    shift : (n, 2), from the place predicted [px], x, y
    score : (n,), correlation there
    decoy : (n,), the highest correlation in the decoy area
    back : (n,), how far from its start the way back ends [px]
    known : (n,), whether the template, and what it was found on, are pictures
    """

    shift: Array
    score: Array
    decoy: Array
    back: Array
    known: BoolArray

    def passed(self, margin: float = 0.0, back: float = 1.0) -> BoolArray:
        """Return the matches (n,) that beat their decoy by a margin and come back to within a distance [px]."""
        return np.asarray(self.known & (self.score > self.decoy + margin) & (self.back <= back))


def find(first: FloatImage, second: FloatImage, at: Array, half: int, search: int) -> FoundTemplates:
    """Find templates of one picture's channels (C, H, W) in another's, on the same grid.

    `at` (n, 2), n > 0, holds their centres x, y as whole px, at least `margin(half, search)` from the edge; they reach
    `half` px to each side, and are looked for up to `search` px away. The decoy area of the same size lies beside, to
    the right and left in turn.
    """
    rows = np.asarray(at, np.int64)
    return joined([_find(first, second, rows[i : i + BATCH], half, search) for i in range(0, len(rows), BATCH)])


def joined(parts: Sequence[FoundTemplates]) -> FoundTemplates:
    """Join matches found in several places, one after the other."""
    return FoundTemplates(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in FoundTemplates.__annotations__)
    )


def margin(half: int, search: int) -> int:
    """Return the least distance [px] of templates from the edge of a picture."""
    return half + 3 * search + _GAP + 3


def _find(first: FloatImage, second: FloatImage, at: IntArray, half: int, search: int) -> FoundTemplates:
    n, wide = len(at), 2 * search + 1
    template = cut(first, at, half, half)
    right = np.arange(n) % 2 > 0  # where the decoy lies; areas to the left are turned about, so that all are alike
    aside = np.where(right, 1, -1)[:, None] * [search + (_GAP + 1) // 2, 0]
    areas = cut(second, at + aside, half + 2 * search + (_GAP + 1) // 2, half + search)
    surface = correlation(template, areas)
    surface[~right] = surface[~right, :, ::-1]
    true, decoy = surface[:, :, :wide].reshape(n, -1), surface[:, :, -wide:].reshape(n, -1)
    y, x = np.divmod(true.argmax(axis=1), wide)
    inside = (x > 0) & (x < wide - 1) & (y > 0) & (y < wide - 1)
    whole = np.stack([np.where(right, x - search, search - x), y - search], axis=1)
    there = at + whole
    around = cut(second, there, half + 2, half + 2)
    found = around[:, :, 2:-2, 2:-2]
    pictures = [(np.abs(part).sum(axis=1) > 0).mean(axis=(1, 2)) > SHOWN for part in (template, found)]
    back = correlation(found, cut(first, at, half + search, half + search)).reshape(n, -1)
    back_y, back_x = np.divmod(back.argmax(axis=1), wide)
    part, still = _registered(template, around)
    return FoundTemplates(
        whole + part,
        true.max(axis=1).astype(np.float64),
        decoy.max(axis=1).astype(np.float64),
        np.hypot(back_x - search, back_y - search),
        inside & pictures[0] & pictures[1] & still,
    )


def cut(picture: FloatImage, at: IntArray, wide: int, high: int) -> FloatImage:
    """Return the windows (n, C, 2 high + 1, 2 wide + 1) around whole px x, y (n, 2)."""
    view = np.lib.stride_tricks.sliding_window_view(picture, (2 * high + 1, 2 * wide + 1), axis=(1, 2))
    return np.moveaxis(view[:, at[:, 1] - high, at[:, 0] - wide], 0, 1)


def _registered(template: FloatImage, around: FloatImage) -> tuple[Array, BoolArray]:
    """Return the least squares on the channels: how far (n, 2), at most a pixel, templates (n, C, h, w) lie
    beside the middle.

    Of patches that are 2 px larger all around; and whether that ended.
    """
    wanted = _unit(template)
    shift = np.zeros((len(template), 2))
    step = np.full_like(shift, np.inf)
    for _ in range(_STEPS):
        there = _shifted(_shifted(around, shift[:, 0], 3), shift[:, 1], 2)
        size = np.sqrt((there**2).sum(axis=(1, 2, 3), keepdims=True)) + np.float32(1e-12)
        there = there / size
        slopes = np.stack([np.gradient(there, axis=axis) for axis in (3, 2)], axis=1)
        flat, slopes = there.reshape(len(there), -1), slopes.reshape(len(there), 2, -1)
        slopes = slopes - (slopes @ flat[..., None]) * flat[:, None]
        normal = (slopes @ np.swapaxes(slopes, 1, 2)).astype(np.float64) + 1e-9 * np.eye(2)
        right = (slopes @ (wanted.reshape(flat.shape) - flat)[..., None]).astype(np.float64)
        step = np.linalg.solve(normal, right)[..., 0].clip(-0.5, 0.5)
        shift = (shift + step).clip(-1.0, 1.0)
        if np.abs(step).max() < SETTLED:
            break
    return shift, np.asarray((np.abs(step).max(axis=1) < 10 * SETTLED) & (np.abs(shift) < 1.0).all(axis=1))


def _unit(patches: FloatImage) -> FloatImage:
    size = np.sqrt((patches**2).sum(axis=(1, 2, 3), keepdims=True))
    return np.asarray(patches / (size + np.float32(1e-12)), np.float32)


def _shifted(patches: FloatImage, shift: Array, axis: int) -> FloatImage:
    """Return the patches between their pixels, by cubic convolution along an axis (2 or 3), which loses 2 px
    at each end.
    """
    length = patches.shape[axis] - 4
    out = np.zeros([n - 4 * (i == axis) for i, n in enumerate(patches.shape)], np.float32)
    for k in range(-2, 3):
        t = np.abs(k - shift)
        near, far = 1.5 * t**3 - 2.5 * t**2 + 1.0, -0.5 * t**3 + 2.5 * t**2 - 4.0 * t + 2.0
        weight = np.where(t <= 1.0, near, np.where(t < 2.0, far, 0.0)).astype(np.float32)
        part = [slice(None)] * 4
        part[axis] = slice(k + 2, k + 2 + length)
        out += weight[:, None, None, None] * patches[tuple(part)]
    return out
