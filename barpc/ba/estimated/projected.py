"""All views at once: corrected image points and their derivatives, observation by observation.

Arrays here are component-major, (..., K), observations sorted by view: whole components are contiguous,
and what differs between views is one small matrix product a view. A correction's unknowns are a row of
metres (see `Unknowns`), so that all of them weigh about the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Literal

import numpy as np

from barpc.ba.estimated.unknowns import Unknowns
from barpc.base.geodesy import Array, ground_from_ecef, ground_rows_from_ecef, parts
from barpc.scene import IntArray, View
from barpc.sensor.corrected import RigidMotion
from barpc.sensor.rpc import RpcStack

Wanted = Literal["image", "points", "unknowns"]


@dataclass(frozen=True)
class Projected:
    """Image points of K observations and their derivatives, sorted by view."""

    image: Array  # (2, K) col, row [px]
    by_point: Array  # (2, 3, K) d(image) / d(ECEF point) [px/m]
    by_unknown: Array  # (2, q, K) d(image) / d(unknowns of the observing view) [px per unit]


class Cameras:
    """The views of a block behind their corrections.

    A drift asks when each point was seen, and splines where: `seen` (2, K), as observed [px], sorted by view.
    """

    def __init__(self, views: Sequence[View], unknowns: Unknowns, seen: Array | None = None) -> None:
        self.seen = seen
        self.sensors = tuple(view.sensor for view in views)
        self.unknowns = unknowns
        self._stack = RpcStack(self.sensors)
        self.is_rpc = self._stack.is_rpc

    def seeing(self, seen: Array) -> Cameras:
        """Return the views with other observations, at image points (2, K) [px]."""
        cameras = copy(self)
        cameras.seen = seen
        return cameras

    def project(
        self,
        params: Array,
        ecef: Array,
        bounds: IntArray,
        wanted: Wanted = "unknowns",
        out: Projected | None = None,
    ) -> Projected:
        """Project the block's points: corrected image points with derivatives, written into `out` where it is
        given.

        Of unknowns (N, q) and every observation's point (3, K) [m]; observations of view v are bounds[v] :
        bounds[v + 1]. `wanted` are no derivatives ("image"), those by the "points", or by the "unknowns" too; what
        is not wanted has no rows.
        """
        found = self.room(ecef.shape[1], wanted) if out is None else out
        image, by_point, by_unknown = found.image, found.by_point, found.by_unknown
        for views in self._stack.runs(bounds, self.is_rpc):
            for part in parts(bounds[views.stop], start=bounds[views.start]):
                of_view = np.clip(bounds[views.start : views.stop + 1], part.start, part.stop) - part.start
                seen = None if self.seen is None else self.seen[:, part]
                piece = self._project(params, ecef[:, part], views, of_view, wanted, seen)
                image[:, part] = piece.image
                by_point[..., part] = piece.by_point[:, : by_point.shape[1]]
                by_unknown[..., part] = piece.by_unknown[:, : by_unknown.shape[1]]
        return found

    def room(self, count: int, wanted: Wanted = "unknowns") -> Projected:
        """Return empty arrays for the projections of `count` observations."""
        by_point = np.empty((2, 0 if wanted == "image" else 3, count))
        by_unknown = np.empty((2, self.unknowns.size if wanted == "unknowns" else 0, count))
        return Projected(np.empty((2, count)), by_point, by_unknown)

    def _project(
        self, params: Array, ecef: Array, views: slice, bounds: IntArray, wanted: Wanted, seen: Array | None
    ) -> Projected:
        index = np.repeat(np.arange(views.start, views.stop), np.diff(bounds))
        unknowns = self.unknowns
        if not unknowns.geometric:
            image, by_point = self._by_ecef(ecef, views, bounds)
            return Projected(*unknowns.in_image(params, index, image, by_point))
        if views.start in unknowns.radars:
            found = self._timed(params[views.start], ecef, views.start, wanted)
        else:
            found = self._moved(params, ecef, views, bounds, wanted, seen)
        if unknowns.waves is not None and seen is not None:
            unknowns.add_waves(found.image, found.by_unknown, params, index, seen)
        return found

    def _moved(
        self,
        params: Array,
        ecef: Array,
        views: slice,
        bounds: IntArray,
        wanted: Wanted,
        seen: Array | None,
    ) -> Projected:
        """Project points through cameras that are turned and shifted."""
        unknowns, of_views = self.unknowns, params[views]
        index = np.repeat(np.arange(views.start, views.stop), np.diff(bounds))
        if wanted != "unknowns" and not of_views.any():  # cameras as delivered
            none = np.empty((2, 0, len(index)))
            if wanted == "image":
                return Projected(self._image(ecef, views, bounds), none, none)
            return Projected(*self._by_ecef(ecef, views, bounds), none)
        drift = row = None
        if unknowns.drift:
            assert seen is not None
            row = (seen[1] - unknowns.middle[1, index]) / unknowns.half[1, index]
            drift = unknowns.drift_rotation(params, index, row)
        rotation, translation = unknowns.rotation(of_views, views), unknowns.translation(of_views)
        motion = RigidMotion(ecef, rotation, translation, unknowns.center[views], bounds, drift)
        if wanted == "image":
            none = np.empty((2, 0, len(index)))
            return Projected(self._image(motion.ecef, views, bounds), none, none)
        image, by_moved = self._by_ecef(motion.ecef, views, bounds)
        by_point = motion.by_point(by_moved)
        if wanted == "points":
            return Projected(image, by_point, by_point[:, :0])
        by_unknown = unknowns.stack(*motion.by_turns(by_moved), by_point, index, row)
        return Projected(image, by_point, by_unknown)

    def _timed(self, params: Array, ecef: Array, view: int, wanted: Wanted) -> Projected:
        """Project points into a radar whose clocks are corrected."""
        unknowns = self.unknowns
        model = unknowns.radars[view].timed(unknowns.timing(params, view))
        ground, by_ecef = ground_rows_from_ecef(ecef)
        if wanted == "image":
            none = np.empty((2, 0, ecef.shape[1]))
            return Projected(model.project(ground.T).T, none, none)
        image, by_ground, by_timing, along = model.timing_jacobian(ground.T)
        by_point = _times(np.moveaxis(by_ground, 0, -1), by_ecef)
        by_unknown = by_point[:, :0]
        if wanted == "unknowns":
            by_unknown = unknowns.stack_timing(np.moveaxis(by_timing, 0, -1), along, view)
        return Projected(image.T, by_point, by_unknown)

    def _image(self, ecef: Array, views: slice, bounds: IntArray) -> Array:
        """Return the uncorrected image points (2, n) without a derivative."""
        ground = ground_from_ecef(ecef.T)
        if self.is_rpc[views.start]:
            return self._stack.image(ground.T, views, bounds)
        image: Array = self.sensors[views.start].project(ground).T
        return image

    def _by_ecef(self, ecef: Array, views: slice, bounds: IntArray) -> tuple[Array, Array]:
        """Return the uncorrected image points (2, n) and their derivative by ECEF (2, 3, n)."""
        ground, by_ecef = ground_rows_from_ecef(ecef)
        if self.is_rpc[views.start]:
            image, by_ground = self._stack.project(ground, views, bounds)
        else:
            points, jacobian = self.sensors[views.start].project_jacobian(ground.T)
            image = points.T  # components laid out anew: products of strided ones take twice as long
            by_ground = np.ascontiguousarray(np.moveaxis(jacobian, 0, -1))
        return image, _times(by_ground, by_ecef)


def _times(a: Array, b: Array) -> Array:
    """Return the products (i, k, n) of small matrices (i, j, n) and (j, k, n)."""
    out: Array = a[:, 0, None] * b[0]
    for j in range(1, len(b)):
        out += a[:, j, None] * b[j]
    return out
