"""What the report shows of the pixels: a quick-look of each image, and patches about tie points before and after."""

from __future__ import annotations

import base64
import json
import logging
from collections.abc import Iterable
from contextlib import ExitStack
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from rasterio.windows import Window

from barpc.errors import ImageError
from barpc.geodesy import Array
from barpc.raster import open_raster
from barpc.remote import Remote
from barpc.report import Run
from barpc.sensor import SensorModel
from barpc.sensor.geometry import epipolar_offset
from barpc.tie.raster import jpeg

logger = logging.getLogger(__name__)

SIDE = 360  # px of a quick-look at most
TIES = 10  # tie points with the largest residuals, and as many at random
HALF = 24  # px: a patch reaches so far to each side
MOST = 60  # images with a quick-look: as many as the report has residual maps
_LARGEST = 16e6  # px: of a larger image too much would be read
_MARGIN = 2  # px about a patch that are read, too

Pixels = npt.NDArray[np.uint8]


def pictures(run: Run, band: int) -> str:
    """The pictures of a run as JSON; an image that lies on another host, or cannot be read, has none."""
    views = [view for view in run.views if not isinstance(view.path, Remote) and view.path]
    looks, left_out = {}, dict[str, None]()
    for view in views[:: max(1, -(-len(views) // MOST))]:
        try:
            look = _quicklook(view.path, band)
        except ImageError as error:
            left_out[str(error)] = None
            continue
        if look is not None:
            looks[view.name] = _text(look)
    _say(left_out)
    return json.dumps({"quicklooks": looks, "ties": _ties(run, band)})


def _say(left_out: Iterable[str]) -> None:
    """What the report cannot show is no reason to end a run that has done its work."""
    for error in left_out:
        logger.warning("%s; the report does not show it", error)


def _text(pixels: Pixels) -> str:
    return base64.b64encode(jpeg(pixels)).decode()


def _stretched(pixels: Array) -> Pixels:
    """Grey values from the second to the 98th percentile as 0 to 255."""
    with np.errstate(invalid="ignore"):
        low, high = (
            np.percentile(pixels[np.isfinite(pixels)], [2, 98]) if np.isfinite(pixels).any() else (0, 1)
        )
        grey = np.clip((pixels - low) / max(high - low, 1e-30), 0.0, 1.0) * 255.0
    return np.nan_to_num(grey).astype(np.uint8)


def _quicklook(path: Any, band: int) -> Pixels | None:
    with open_raster(path) as dataset:
        width, height = int(dataset.width), int(dataset.height)
        if width * height > _LARGEST:
            return None
        step = -(-max(width, height) // SIDE)
        return _stretched(dataset.read(band)[step // 2 :: step, step // 2 :: step].astype(np.float64))


def _chosen(run: Run) -> list[tuple[str, int]]:
    """Tracks with the largest residual that counts, and others at random."""
    tracks, keep = run.tracks, run.keep
    norm = np.hypot(*(run.ties_after or run.ties_before).residuals.T)
    worst = np.zeros(tracks.num_points)
    np.maximum.at(worst, tracks.point[keep], np.nan_to_num(norm[keep]))
    able = np.flatnonzero((np.bincount(tracks.point[keep], minlength=tracks.num_points) > 1) & (worst > 0))
    first = able[np.argsort(-worst[able], kind="stable")][:TIES].tolist()
    rest = np.setdiff1d(able, first)
    others = np.random.default_rng(0).choice(rest, min(TIES, len(rest)), replace=False).tolist()
    return [("worst", track) for track in first] + [("random", track) for track in sorted(others)]


class _Tie(NamedTuple):
    """A tie point in two of its images, the better one first."""

    kind: str
    views: tuple[int, int]
    rows: tuple[int, int]  # of the tracks


def _pair(run: Run, kind: str, track: int) -> _Tie:
    rows = np.flatnonzero((run.tracks.point == track) & run.keep)
    norm = np.hypot(*(run.ties_after or run.ties_before).residuals[rows].T)
    first, last = int(rows[np.argmin(norm)]), int(rows[np.argmax(norm)])
    return _Tie(kind, (int(run.tracks.view[first]), int(run.tracks.view[last])), (first, last))


def _ties(run: Run, band: int) -> list[dict[str, Any]]:
    """Tie points in two images each: a patch of one, and that of the other brought over by cameras before and after.

    Cameras are asked once a pair of images, and images are opened once.
    """
    chosen = [_pair(run, kind, track) for kind, track in _chosen(run)]
    shown: dict[_Tie, dict[str, Any]] = {}
    left_out: dict[str, None] = {}
    with ExitStack() as stack:
        opened = cache(lambda view: stack.enter_context(open_raster(run.views[view].path)))
        for a, b in sorted({tie.views for tie in chosen}):
            if a == b or any(isinstance(run.views[k].path, Remote) or not run.views[k].path for k in (a, b)):
                continue
            ties = [tie for tie in chosen if tie.views == (a, b)]
            xy = run.tracks.xy[np.array([tie.rows for tie in ties])]
            alt = run.ground[run.tracks.point[[tie.rows[0] for tie in ties]], 2]
            cameras = [(s[a], s[b]) for s in (run.before, run.after) if s is not None]
            seen = [epipolar_offset(*two, xy[:, 0], xy[:, 1], alt, steps=2) for two in cameras]
            corners = np.rint(xy[:, 0])
            there = [_brought(*two, corners, alts) for two, (_, alts) in zip(cameras, seen, strict=True)]
            for n, tie in enumerate(ties):
                try:
                    patches = [_patch(opened(a), band, _grid() + corners[n])]
                    patches += [_patch(opened(b), band, places[n]) for places in there]
                    texts = [_text(_stretched(patch)) for patch in patches if patch is not None]
                    if len(texts) == len(patches):
                        shown[tie] = {
                            "kind": tie.kind,
                            "a": run.views[a].name,
                            "b": run.views[b].name,
                            "offset_px": [float(offset[n]) for offset, _ in seen],
                            "patches": texts,
                        }
                except ImageError as error:
                    left_out[str(error)] = None
    _say(left_out)
    return [shown[tie] for tie in chosen if tie in shown]


def _grid() -> Array:
    step = np.arange(-HALF, HALF + 1.0)
    return np.stack(np.meshgrid(step, step), axis=-1)


def _brought(a: SensorModel, b: SensorModel, corners: Array, alts: Array) -> Array:
    """Where the pixels of patches of A about corners (N, 2) lie in B (N, S, S, 2), on level ground at alts (N,)."""
    three = corners[:, None] + HALF * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    ground = a.localize(three.reshape(-1, 2), np.repeat(alts, 3))
    there = b.project(ground).reshape(-1, 3, 2)
    slopes = (there[:, 1:] - there[:, :1]) / HALF
    return np.asarray(there[:, :1, None] + np.einsum("rcs,nsk->nrck", _grid(), slopes))


def _patch(image: Any, band: int, places: Array) -> Array | None:
    """Grey values (S, S) at places (S, S, 2) [px], linearly; None where these leave the image."""
    if not np.isfinite(places).all():
        return None
    low = np.floor(places.min(axis=(0, 1))).astype(int) - _MARGIN
    high = np.ceil(places.max(axis=(0, 1))).astype(int) + _MARGIN
    if (low < 0).any() or high[0] >= image.width or high[1] >= image.height or (high - low).max() > 20 * HALF:
        return None
    size = high - low + 1
    grey = image.read(band, window=Window(low[0], low[1], size[0], size[1])).astype(np.float64)
    col, row = np.moveaxis(places - low, -1, 0)
    i, j = np.floor(row).astype(int), np.floor(col).astype(int)
    u, v = row - i, col - j
    top = grey[i, j] * (1 - v) + grey[i, j + 1] * v
    bottom = grey[i + 1, j] * (1 - v) + grey[i + 1, j + 1] * v
    return np.asarray(top * (1 - u) + bottom * u)
