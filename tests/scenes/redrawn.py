"""Another date of a picture, of another kind than `tests/scenes/season.py`: classes of ground, not of grey.

Ground is told by how bright it is and how rough; a class takes another tone, and its contrast is turned over or its
texture grown anew. Shadows are lifted where they lie and cast where they do not, snow lies in blobs, and the picture
is exposed under uneven light with a curve of its own. Everything keeps its place.
"""

from __future__ import annotations

import cv2
import numpy as np

ROUGH = 6.0  # px about a place that tell its class
REGROWN = 3  # classes of six; the contrast of the others is turned over
SNOW = 0.6
DARK = 0.08  # share of the pixels that lie in shadow
Grey = np.ndarray


def _smooth(picture: Grey, sigma: float) -> Grey:
    return cv2.GaussianBlur(picture, (0, 0), sigma)


def _noise(rng: np.random.Generator, shape: tuple[int, ...], sigma: float) -> Grey:
    """Smooth noise of mean 0 and variance 1."""
    out = _smooth(rng.normal(size=shape).astype(np.float32), sigma)
    return np.asarray((out - out.mean()) / out.std())


def _classes(grey: Grey) -> tuple[Grey, Grey, Grey]:
    """Class 0 to 5 of every pixel, thirds by the local mean and halves by the local spread; that mean and spread."""
    mean = _smooth(grey, ROUGH)
    spread = np.sqrt(np.maximum(_smooth(grey * grey, ROUGH) - mean * mean, 0.0))
    bright = np.digitize(mean, np.quantile(mean, [1 / 3, 2 / 3]))
    return bright + 3 * (spread > np.median(spread)), mean, spread


def _shadows(rng: np.random.Generator, grey: Grey, today: Grey) -> Grey:
    """The darkest places as bright as what is about them; the same shapes, wider, cast 6 to 14 px beside."""
    dark = (_smooth(grey, 1.0) < np.quantile(grey, DARK)).astype(np.uint8)
    dark = cv2.morphologyEx(dark, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    light = cv2.dilate(dark, np.ones((3, 3), np.uint8)).astype(np.float32)
    about = _smooth(today * (1 - light), 8.0) / np.maximum(_smooth(1 - light, 8.0), 1e-3)
    soft = _smooth(light, 0.7)
    lifted = (1 - soft) * today + soft * about
    angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(6.0, 14.0)
    matrix = np.array([[1.0, 0.0, length * np.cos(angle)], [0.0, 1.0, length * np.sin(angle)]])
    elsewhere = cv2.warpAffine(light, matrix, grey.shape[::-1])
    return np.asarray(lifted * (1 - 0.5 * _smooth(elsewhere, 0.7)))


def redrawn(pixels: Grey, seed: int, snow: float = SNOW) -> Grey:
    """A picture on another date, uint16."""
    rng = np.random.default_rng([seed, 91])
    low, high = np.percentile(pixels, [0.5, 99.5])
    grey = np.clip((pixels.astype(np.float32) - low) / (high - low), 0, 1)
    kind, mean, spread = _classes(grey)
    tone = rng.permutation(np.linspace(0.15, 0.6, 6))
    grown = rng.permutation(np.arange(6) < REGROWN)[kind]
    turned = rng.uniform(0.6, 1.2, 6)[kind] * (mean - grey)
    texture = 0.8 * _noise(rng, grey.shape, 1.2) + 0.6 * _noise(rng, grey.shape, 3.0)
    detail = np.where(grown, spread * texture, turned)
    today = _shadows(rng, grey, (tone[kind] + detail).astype(np.float32))
    if snow:
        blobs = _noise(rng, grey.shape, 18.0)
        edge = np.quantile(blobs, 1.0 - snow)
        cover = (0.5 + (blobs - edge) / 0.12).clip(0.0, 1.0)
        today = (1 - cover) * today + cover * (0.9 + 0.02 * _noise(rng, grey.shape, 2.0))
    light = 1.0 + 0.2 * _noise(rng, grey.shape, 0.25 * min(grey.shape)).clip(-2, 2)
    today = np.clip(today * light, 0.02, 1.5) ** rng.uniform(0.6, 1.6)
    today = _smooth(today.astype(np.float32), 0.5) + rng.normal(0, 0.01, grey.shape)
    return np.clip(100 + 1500 * today, 1, 4000).astype(np.uint16)
