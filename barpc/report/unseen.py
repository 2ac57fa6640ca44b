"""Heights behind a displaced part of an image, where no line of sight shows all of its displacement.

Two images show a displacement across their epipolar lines and none along them: there the points of the part move up or
down with it. Rows that are displaced as a whole (a clock that jumps) are displaced along the rows' axis; the part along
the lines then follows from that across them. A whole number of lines is taken for lost and held
(`barpc.ba.select.image_terms.with_lines_lost`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from barpc.base.geodesy import Array
from barpc.report.outcome import LEAST_MOVED, Run
from barpc.report.summary.block import AXES
from barpc.sensor.geometry import Several
from barpc.sensor.image_corrections import Splined

_PARALLEL = 0.05  # sine of the angle between lines and axis under which a part across tells nothing of that along
_SAMPLE = 200  # tie points at which the direction of the lines is measured


@dataclass(frozen=True)
class UnseenPart:
    """Rows or columns of an image, and by how much their heights may be off [m]."""

    place: str
    metres: float


def unseen_parts(run: Run, i: int) -> Iterator[UnseenPart]:
    """Yield the displaced parts of view i of which no image shows the displacement along the epipolar lines."""
    adjustment = run.adjustment
    assert adjustment is not None
    if not any(one.view == i and one.where is not None for one in adjustment.findings):
        return
    unknowns, camera = adjustment.cameras.unknowns, adjustment.sensors[i]
    waves = unknowns.waves
    if waves is None or not isinstance(camera, Splined):
        return
    of_parts = waves.kinds[2]
    count = (of_parts.stop - of_parts.start) // 2
    first = unknowns.in_waves.start + of_parts.start
    moved = adjustment.params[i, first : first + 2 * count].reshape(2, count)
    for n in np.flatnonzero(np.isfinite(waves.strips[i, :, 1])).tolist():
        own = first + np.array([n, count + n])
        variance, axes = np.linalg.eigh(adjustment.covariance.view(i)[np.ix_(own, own)])
        if not np.sqrt(variance[1]) > max(LEAST_MOVED, 2.0 * np.sqrt(max(variance[0], 0.0))):
            continue  # seen from several sides
        axis, start, stop = int(waves.strips[i, n, 0]), *waves.strips[i, n, 1:3]
        along, across = axes[:, 1], axes[:, 0]
        if not abs(across[axis]) > _PARALLEL:
            continue
        displaced = float(moved[:, n] @ across / across[axis])  # along the axis, were that all of it
        metres = abs(displaced * along[axis]) * _metres_a_pixel(run, i, along)
        low, high = max(start, 0.0), min(stop, run.views[i].size[axis] - 1.0)
        if abs(displaced * along[axis]) > LEAST_MOVED and np.isfinite(metres):
            yield UnseenPart(f"{AXES[axis]} {low:.0f}-{high:.0f}", metres)


def _metres_a_pixel(run: Run, i: int, along: Array) -> float:
    """Return by how much a point's height changes [m] where view i moves by a pixel along a direction (2,).

    By the view that shares most of its tie points: the point stays on that one's ray.
    """
    shared = {ties.views: len(ties.a) for ties in run.pairs if i in ties.views}
    if not shared:
        return float("nan")
    views = max(shared, key=lambda pair: shared[pair])
    other = views[1 - views.index(i)]
    points = np.unique(run.tracks.point[(run.tracks.view == other) & run.keep])
    ground = run.ground[points[:: max(1, len(points) // _SAMPLE)]]
    ground = ground[np.isfinite(ground).all(axis=1)]
    ray = Several(run.cameras, np.full(len(ground), other))
    higher = ray.localize(ray.project(ground), ground[:, 2] + 1.0)
    seen = Several(run.cameras, np.full(len(ground), i))
    rate = np.nanmedian((seen.project(higher) - seen.project(ground)) @ along)
    return float(1.0 / abs(rate)) if abs(rate) > 0.0 else float("nan")
