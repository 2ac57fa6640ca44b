"""Projection of all observations of a block through their corrected cameras, with derivatives.

Arrays are component-major, (..., K), with observations sorted by view. So components are contiguous, and each view
needs one small matrix product. The unknowns of a correction are scaled to metres (see `Unknowns`).
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Literal

import numpy as np

from barpc.ba.parameters.unknowns import Unknowns
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
    """The cameras of a block and the layout of their corrections.

    `seen` (2, K) [px] are the observed image points, sorted by view. Drift is evaluated at their rows, additional
    parameters at both coordinates.
    """

    def __init__(self, views: Sequence[View], unknowns: Unknowns, seen: Array | None = None) -> None:
        self.seen = seen
        self.sensors = tuple(view.sensor for view in views)
        self.unknowns = unknowns
        self._stack = RpcStack(self.sensors)
        self.is_rpc = self._stack.is_rpc

    def seeing(self, seen: Array) -> Cameras:
        """Return the cameras with other observations, at image points (2, K) [px]."""
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
        """Return the corrected image points of all observations with derivatives, written into `out` if given.

        `params` (N, q) are the unknowns, `ecef` (3, K) [m] the point of each observation; those of view v are
        bounds[v] : bounds[v + 1]. `wanted`: no derivatives ("image"), those by points ("points"), or those by points
        and unknowns ("unknowns"). Arrays of other derivatives are empty.
        """
        found = self.room(ecef.shape[1], wanted) if out is None else out
        image, by_point, by_unknown = found.image, found.by_point, found.by_unknown
        for views in self._stack.runs(bounds, self.is_rpc):
            for part in parts(bounds[views.stop], start=bounds[views.start]):
                of_view = np.clip(bounds[views.start : views.stop + 1], part.start, part.stop) - part.start
                seen = None if self.seen is None else self.seen[:, part]
                piece = Projected(image[:, part], by_point[..., part], by_unknown[..., part])
                self._project(params, ecef[:, part], views, of_view, seen, piece)
        return found

    def room(self, count: int, wanted: Wanted = "unknowns") -> Projected:
        """Return uninitialised arrays for the projections of `count` observations."""
        by_point = np.empty((2, 0 if wanted == "image" else 3, count))
        by_unknown = np.empty((2, self.unknowns.size if wanted == "unknowns" else 0, count))
        return Projected(np.empty((2, count)), by_point, by_unknown)

    def _project(
        self, params: Array, ecef: Array, views: slice, bounds: IntArray, seen: Array | None, out: Projected
    ) -> None:
        unknowns = self.unknowns
        index = np.repeat(np.arange(views.start, views.stop), np.diff(bounds))
        if not unknowns.geometric:
            found = unknowns.in_image(params, index, *self._by_ecef(ecef, views, bounds))
            out.image[:] = found[0]
            out.by_point[:] = found[1][:, : out.by_point.shape[1]]
            out.by_unknown[:] = found[2][:, : out.by_unknown.shape[1]]
        else:
            self._project_rigid(params[views], ecef, views, bounds, seen, out)
        if unknowns.waves is not None and seen is not None:
            unknowns.add_waves(out.image, out.by_unknown, params, index, seen)

    def _project_rigid(
        self, params: Array, ecef: Array, views: slice, bounds: IntArray, seen: Array | None, out: Projected
    ) -> None:
        """Project points through rotated and translated cameras, into `out`."""
        unknowns, image_only, all_wanted = self.unknowns, not out.by_point.shape[1], bool(out.by_unknown.shape[1])
        as_delivered = not params.any()
        if as_delivered and not all_wanted:
            if image_only:
                out.image[:] = self._image(ecef, views, bounds)
            else:
                out.image[:], out.by_point[:] = self._by_ecef(ecef, views, bounds)
            return
        drift = row = None
        if unknowns.drift:
            assert seen is not None
            count = np.diff(bounds)
            middle, half = (np.repeat(rows[1, views], count) for rows in (unknowns.middle, unknowns.half))
            row = (seen[1] - middle) / half
            drift = None if as_delivered else unknowns.drift_rotation(params, views, count, row)
        rotation, translation = unknowns.rotation(params, views), unknowns.translation(params)
        motion = RigidMotion(ecef, rotation, translation, unknowns.center[views], bounds, drift)
        if image_only:
            out.image[:] = self._image(motion.ecef, views, bounds)
            return
        out.image[:], by_moved = self._by_ecef(motion.ecef, views, bounds)
        motion.by_point(by_moved, out.by_point)
        if all_wanted:
            inverse = np.repeat(1.0 / unknowns.distance[views], np.diff(bounds))
            unknowns.stack(*motion.by_turns(by_moved), out.by_point, inverse, row, out.by_unknown)

    def _image(self, ecef: Array, views: slice, bounds: IntArray) -> Array:
        """Return the image points (2, n) of the delivered cameras."""
        ground = ground_from_ecef(ecef.T)
        if self.is_rpc[views.start]:
            return self._stack.image(ground.T, views, bounds)
        image: Array = self.sensors[views.start].project(ground).T
        return image

    def _by_ecef(self, ecef: Array, views: slice, bounds: IntArray) -> tuple[Array, Array]:
        """Return the image points (2, n) of the delivered cameras, and their derivatives by ECEF (2, 3, n)."""
        ground, by_ecef = ground_rows_from_ecef(ecef)
        if self.is_rpc[views.start]:
            image, by_ground = self._stack.project(ground, views, bounds)
        else:
            points, jacobian = self.sensors[views.start].project_jacobian(ground.T)
            image = points.T  # copied: products of strided arrays take twice as long
            by_ground = np.ascontiguousarray(np.moveaxis(jacobian, 0, -1))
        return image, _matrix_products(by_ground, by_ecef)


def _matrix_products(a: Array, b: Array) -> Array:
    """Return the products (i, k, n) of small matrices (i, j, n) and (j, k, n)."""
    out: Array = a[:, 0, None] * b[0]
    for j in range(1, len(b)):
        out += a[:, j, None] * b[j]
    return out
