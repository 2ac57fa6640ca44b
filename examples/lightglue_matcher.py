"""Match with kornia's DISK and LightGlue: `PYTHONPATH=examples barpc match ... --matcher lightglue_matcher:match`.

Needs `pip install kornia`, and the weights, which kornia loads when it is used first. Tiles of the first view are
matched to where the cameras say that they lie in the second; barpc calls `match` some ten times for a pair and keeps
what lies where it asks, so the work is done once and remembered.
"""

from __future__ import annotations

from functools import cache, lru_cache

import numpy as np
from rasterio.windows import Window

from barpc.rasters.raster import open_raster

KEYPOINTS = 2048  # of a tile
REACH = 100  # px that a tile of the second view is larger on every side: the cameras may be wrong
LEAST = 64  # px, side of a tile worth looking at
NONE = np.empty((0, 2, 2)), np.empty(0)

_pairs: dict = {}


def match(view_a, view_b, prediction):
    """Places (M, 2, 2) [px] in both views, and how unlike they look (M,)."""
    key = view_a, view_b  # cameras and all: with others, a later pass looks elsewhere
    if key not in _pairs:
        _pairs.clear()  # a worker has one pair at a time
        found = [NONE, *(_tile(view_a, view_b, box, prediction) for box in prediction.windows())]
        _pairs[key] = np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])
    return _pairs[key]


def _tile(view_a, view_b, box, prediction):
    col, row, width, height = box
    corners = np.array(
        [(col, row), (col + width, row), (col, row + height), (col + width, row + height)], float
    )
    where = prediction.at(corners)
    ends = np.concatenate([where.place(where.before), where.place(where.after)])
    if not np.isfinite(ends).all():
        return NONE
    low = np.maximum(np.floor(ends.min(axis=0)) - REACH, 0).astype(int)
    high = np.minimum(np.ceil(ends.max(axis=0)) + REACH, view_b.size).astype(int)
    if min(width, height, *(high - low)) < LEAST:
        return NONE
    first = _features(view_a.path, (col, row, width, height))
    second = _features(view_b.path, (*low.tolist(), *(high - low).tolist()))
    torch, kornia, _, matcher = _models()
    frames = [
        kornia.laf_from_center_scale_ori(f.keypoints[None], torch.ones(1, len(f.keypoints), 1, 1))
        for f in (first, second)
    ]
    sizes = (height, width), tuple((high - low)[::-1].tolist())
    with torch.inference_mode():
        score, pairs = matcher(first.descriptors, second.descriptors, *frames, *sizes)
    pairs = np.asarray(pairs)
    unlike = 1.0 - np.asarray(score, float).ravel()  # a good match has a score near 1
    places = [np.asarray(f.keypoints, float)[pairs[:, i]] for i, f in enumerate((first, second))]
    return np.stack(places, axis=1) + np.array([(col, row), low]), unlike


@cache
def _models():
    import kornia.feature
    import torch

    disk = kornia.feature.DISK.from_pretrained("depth").eval()
    return torch, kornia.feature, disk, kornia.feature.LightGlueMatcher("disk").eval()


@lru_cache(maxsize=2)
def _features(path, box):
    """Keypoints [px of the box] and descriptors of a part of an image."""
    torch, _, disk, _ = _models()
    with open_raster(path) as image:
        pixels = image.read(1, window=Window(*box)).astype(np.float64)
    low, high = np.percentile(pixels, [0.5, 99.5])
    grey = ((pixels - low) / max(high - low, 1e-6)).clip(0, 1).astype(np.float32)
    with torch.inference_mode():
        return disk(torch.from_numpy(np.stack([grey] * 3)[None]), KEYPOINTS, pad_if_not_divisible=True)[0]
