"""Images of one acquisition: bands of several resolutions have one camera, and so one correction (`Carried`).

The multispectral image of a panchromatic one has its RPC up to a scale and a shift in the image. Adjusted apart, each
has a prior of its own, and no tie point holds them together where their rays are parallel.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.ndimage as ndi

from barpc.base.geodesy import Array, ecef_from_ground
from barpc.report.outcome import COPIED, Carried
from barpc.scene import BoolArray, Camera, View
from barpc.sensor import SensorModel
from barpc.sensor.rpc import RPC
from barpc.sensor.sampler import image_grid
from barpc.tie.pixels import read_pixels

_SAME_RPC = 0.01  # px: RPCs of bands are equal to 1e-8, of other images of a pass they differ by 50 and more
_ALONG = 0.996  # cosine of 5 degrees: lines of sight that may be of one acquisition
_COMPARED_SIDE = 512  # px of the coarser image that are compared
_LEAST_PEAK, _MAX_SHIFT = 8.0, 2  # standard deviations of the correlation at its peak, and pixels it may be off


def one_each(
    views: Sequence[View], sources: Sequence[Camera], band: int, leads: frozenset[str] = frozenset()
) -> tuple[list[int], tuple[Carried, ...]]:
    """Return the views that are adjusted (their indices), one an acquisition, and those that get their correction.

    The finest image of an acquisition leads; before it those named in `leads`.
    """
    rpcs = [i for i, view in enumerate(views) if isinstance(view.sensor, RPC)]
    ends = np.array([_ends(views[i]) for i in rpcs]).reshape(-1, 2, 3)
    sight = np.array([_direction(one) for one in ends]).reshape(-1, 3)
    maps: dict[tuple[int, int], tuple[Array, Array]] = {}
    for n, j in enumerate(rpcs):
        alike = np.flatnonzero(sight[:n] @ sight[n] > _ALONG)
        for i in (rpcs[k] for k in alike[_same_rays(views[j].sensor, ends[alike])]):
            if (found := _image_map(views[i], views[j])) is None:
                continue
            step, start = found
            maps[i, j], maps[j, i] = (step, start), (1.0 / step, -start / step)
    led: dict[int, int] = {}
    rank = {
        i: (views[i].name not in leads, _pixel(views[i]), -np.prod(views[i].size), i) for both in maps for i in both
    }
    order = sorted(rank, key=rank.__getitem__)
    for i in order:
        for j in order:
            if i not in led and j != i and j not in led and (i, j) in maps and views[j].name not in leads:
                step, start = maps[i, j]
                if _shown(views[j], views[i], step, start) and _same_scene(views[i], views[j], step, start, band):
                    led[j] = i
    carried = [Carried(views[j], sources[j], views[i].name, *maps[i, j]) for j, i in sorted(led.items())]
    return [i for i in range(len(views)) if i not in led], tuple(carried)


def _ends(view: View) -> Array:
    """Return the ground points (2, 3) of the middle pixel at the lowest and the highest altitude."""
    middle = np.tile((np.array(view.size) - 1.0) / 2.0, (2, 1))
    return view.sensor.localize(middle, np.array(view.alt_range))


def _direction(ends: Array) -> Array:
    low, high = ecef_from_ground(ends)
    return np.asarray((high - low) / np.linalg.norm(high - low))


def _pixel(view: View) -> float:
    """Return the side of a pixel on the ground [m], rounded so that bands of one resolution are alike."""
    middle = (np.array(view.size) - 1.0) / 2.0
    at = view.sensor.localize(middle + np.array([[0.0, 0.0], [0.0, 1.0]]), np.full(2, view.altitude))
    return float(f"{np.linalg.norm(np.diff(ecef_from_ground(at), axis=0)):.2g}")


def _same_rays(sensor: SensorModel, ends: Array) -> BoolArray:
    """Return which lines of sight with ends (n, 2, 3) a camera sees as points."""
    seen = sensor.project(ends)
    return np.asarray(np.abs(seen[:, 1] - seen[:, 0]).max(axis=1) < _SAME_RPC)


def _image_map(one: View, other: View) -> tuple[Array, Array] | None:
    """Return the scale and shift (2,) from an image to another whose camera is equal up to these; None of others."""
    at, alt = image_grid(one.size, one.alt_range, (5, 3))
    seen = other.sensor.project(one.sensor.localize(at, alt))
    if not np.isfinite(seen).all():
        return None
    middle = at.mean(axis=0)
    apart = at - middle
    step = (apart * seen).sum(axis=0) / (apart**2).sum(axis=0)
    start = seen.mean(axis=0) - step * middle
    off = np.abs(at * step + start - seen).max()
    return (step, start) if off < _SAME_RPC * max(1.0, *step) and (step > 0).all() else None


def _shown(view: View, lead: View, step: Array, start: Array) -> bool:
    """Return whether the lead shows most of an image."""
    low = np.maximum(start - 0.5 * step, -0.5)
    high = np.minimum(start + (np.array(lead.size) - 0.5) * step, np.array(view.size) - 0.5)
    common = np.prod(np.maximum(high - low, 0.0))
    return bool(common >= COPIED * min(np.prod(view.size), np.prod(np.array(lead.size) * step)))


def _same_scene(lead: View, view: View, step: Array, start: Array, band: int) -> bool:
    """Return whether both images show the same where their cameras say so: an RPC may be copied to another image."""
    if not (lead.path and view.path):
        return False
    low = np.maximum(start, 0.0)
    high = np.minimum(start + (np.array(lead.size) - 1.0) * step, np.array(view.size) - 1.0)
    side = np.minimum(high - low, _COMPARED_SIDE).astype(np.int64)
    first = (0.5 * (low + high - side)).astype(np.int64)
    if side.min() < _COMPARED_SIDE // 8:
        return False
    ours, _ = read_pixels(view.path, (*first.tolist(), *side.tolist()), band)
    corner = np.floor((first - 1.0 - start) / step).astype(np.int64).clip(0)
    far = np.minimum(np.ceil((first + side + 1.0 - start) / step).astype(np.int64), lead.size)
    theirs, _ = read_pixels(lead.path, (*corner.tolist(), *(far - corner).tolist()), band)
    wide = [max(1, round(1.0 / by)) for by in step[::-1].tolist()]
    smooth = ndi.uniform_filter(theirs.astype(np.float64), wide)
    grid = np.stack(np.meshgrid(*map(np.arange, side), indexing="xy"), axis=-1)
    place = np.moveaxis((grid + first - start) / step - corner, -1, 0)[::-1]
    detail = [_edges(picture) for picture in (ours.astype(np.float64), ndi.map_coordinates(smooth, place, order=1))]
    spectrum = np.conj(np.fft.rfft2(detail[0])) * np.fft.rfft2(detail[1])
    surface = np.fft.irfft2(spectrum, s=detail[0].shape)
    row, col = np.unravel_index(int(np.argmax(surface)), surface.shape)
    off = max(min(row, surface.shape[0] - row), min(col, surface.shape[1] - col))
    return bool(off <= _MAX_SHIFT and surface.max() - surface.mean() > _LEAST_PEAK * surface.std())


def _edges(picture: Array) -> Array:
    """Return the strength of edges less its mean, weighted to 0 at the border."""
    strength = np.hypot(ndi.sobel(picture, 0), ndi.sobel(picture, 1))
    faded = (strength - strength.mean()) * np.outer(*(np.hanning(side) for side in strength.shape))
    return np.asarray(faded)
