"""All views at once: corrected image points and their derivatives, observation by observation.

Arrays here are component-major, (..., K), observations sorted by view: whole components are contiguous,
and what differs between views is one small matrix product a view. A correction's unknowns are a row of
metres (see `Unknowns`), so that all of them weigh about the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from barpc.ba.unknowns import Unknowns
from barpc.geodesy import Array, ground_from_ecef, ground_from_ecef_jacobian, wrap_longitude
from barpc.scene import IntArray, View
from barpc.sensor import SensorModel
from barpc.sensor.corrected import rotation_left_jacobian, rotation_matrix
from barpc.sensor.rpc import RPC, monomials

CHUNK = 8192
"""Observations worked on at a time, so that temporaries stay in cache."""


@dataclass(frozen=True)
class Projected:
    """Image points of K observations and their derivatives, sorted by view.

    Parameters
    ----------
    image : (2, K)
        col, row [px].
    by_point : (2, 3, K)
        d(image) / d(ECEF point) [px/m].
    by_unknown : (2, q, K)
        d(image) / d(unknowns of the observing view) [px per unit].
    """

    image: Array
    by_point: Array
    by_unknown: Array


class Cameras:
    """The views of a block behind their corrections.

    Parameters
    ----------
    views : sequence of View
        N views.
    unknowns : Unknowns
        What is corrected, and in which units.
    """

    def __init__(self, views: Sequence[View], unknowns: Unknowns) -> None:
        self.sensors = tuple(view.sensor for view in views)
        self.unknowns = unknowns
        self.is_rpc = np.array([isinstance(sensor, RPC) for sensor in self.sensors])
        self._stack = _RpcStack(self.sensors)

    def project(self, params: Array, ecef: Array, bounds: IntArray, with_unknowns: bool = True) -> Projected:
        """Corrected image points with derivatives.

        Parameters
        ----------
        params : (N, q)
            Unknowns of every view.
        ecef : (3, K)
            The point of every observation [m], sorted by view.
        bounds : (N + 1,)
            Observations of view v are bounds[v] : bounds[v + 1].
        with_unknowns : bool
            Whether the derivative by the unknowns is wanted (else it has no rows).

        Returns
        -------
        Projected
        """
        count = ecef.shape[1]
        image, by_point = np.empty((2, count)), np.empty((2, 3, count))
        by_unknown = np.empty((2, self.unknowns.size if with_unknowns else 0, count))
        for views in self._chunks(bounds):
            for part in _parts(bounds[views.start], bounds[views.stop]):
                of_view = np.clip(bounds[views.start : views.stop + 1], part.start, part.stop) - part.start
                piece = self._project(params, ecef[:, part], views, of_view)
                image[:, part], by_point[..., part] = piece.image, piece.by_point
                by_unknown[..., part] = piece.by_unknown[:, : by_unknown.shape[1]]
        return Projected(image, by_point, by_unknown)

    def _chunks(self, bounds: IntArray) -> Iterator[slice]:
        """Runs of views of one kind with about CHUNK observations together; other sensors one by one."""
        start, n = 0, len(self.sensors)
        while start < n:
            stop = start + 1
            while (
                stop < n
                and self.is_rpc[start]
                and self.is_rpc[stop]
                and bounds[stop + 1] - bounds[start] <= CHUNK
            ):
                stop += 1
            if bounds[stop] > bounds[start]:
                yield slice(start, stop)
            start = stop

    def _project(self, params: Array, ecef: Array, views: slice, bounds: IntArray) -> Projected:
        index = np.repeat(np.arange(views.start, views.stop), np.diff(bounds))
        unknowns = self.unknowns
        if not unknowns.geometric:
            image, by_point = self._by_ecef(ecef, views, bounds)
            return Projected(*unknowns.in_image(params[views], index - views.start, index, image, by_point))
        rotation, translation = unknowns.rotation(params), unknowns.translation(params)
        center = unknowns.center[index].T
        first_by_point, row = None, None
        if unknowns.drift:
            first, first_by_point = self._by_ecef(ecef, views, bounds)
            row = unknowns.normalized_row(first[1], index)
            vector = rotation[index] + unknowns.drift_rotation(params, index, row)
            matrix = np.moveaxis(rotation_matrix(vector), 0, -1)
            left = np.moveaxis(rotation_left_jacobian(vector), 0, -1)
        else:
            local = index - views.start
            matrix = np.moveaxis(rotation_matrix(rotation[views]), 0, -1)[..., local]
            left = np.moveaxis(rotation_left_jacobian(rotation[views]), 0, -1)[..., local]
        lever = _times(matrix, (ecef - translation[index].T - center)[:, None])[:, 0]
        image, by_moved = self._by_ecef(lever + center, views, bounds)
        by_translation = -_times(by_moved, matrix)
        by_rotation = _times(_cross(lever, by_moved), left)
        by_point = -by_translation
        if first_by_point is not None and row is not None:
            rate = unknowns.drift_rate(params, index, row)
            by_point += (
                (by_rotation * rate).sum(axis=1)[:, None] * first_by_point[1] / unknowns.row_scale[index]
            )
        by_unknown = unknowns.stack(by_rotation, by_translation, index, row)
        return Projected(image, by_point, by_unknown)

    def _by_ecef(self, ecef: Array, views: slice, bounds: IntArray) -> tuple[Array, Array]:
        """Uncorrected image points (2, n) and their derivative by ECEF (2, 3, n)."""
        ground = ground_from_ecef(ecef.T)
        if self.is_rpc[views.start]:
            image, by_ground = self._stack.project(ground, views, bounds)
        else:
            points, jacobian = self.sensors[views.start].project_jacobian(ground)
            image, by_ground = points.T, np.moveaxis(jacobian, 0, -1)
        return image, _times(by_ground, np.moveaxis(ground_from_ecef_jacobian(ground), 0, -1))


class _RpcStack:
    """The RPCs among the sensors, their numbers stacked (V of N rows are used, the others stay zero)."""

    def __init__(self, sensors: Sequence[SensorModel]) -> None:
        n = len(sensors)
        self.coeffs, self.gradient = np.zeros((n, 4, 20)), np.zeros((n, 12, 10))
        self.ground_offset, self.ground_scale = np.zeros((n, 3)), np.ones((n, 3))
        self.image_offset, self.image_scale = np.zeros((n, 2)), np.ones((n, 2))
        for i, sensor in enumerate(sensors):
            if isinstance(sensor, RPC):
                self.coeffs[i], self.gradient[i] = sensor.coeffs, sensor._gradient
                self.ground_offset[i], self.ground_scale[i] = sensor.ground_offset, sensor.ground_scale
                self.image_offset[i], self.image_scale[i] = sensor.image_offset, sensor.image_scale

    def project(self, ground: Array, views: slice, bounds: IntArray) -> tuple[Array, Array]:
        """Image points (2, n) and derivative (2, 3, n) of ground points (n, 3) seen by consecutive views."""
        local = np.repeat(np.arange(views.start, views.stop), np.diff(bounds))
        ground_scale, image_scale = self.ground_scale[local].T, self.image_scale[local].T
        normalized = np.array(ground.T)
        normalized[0] = wrap_longitude(normalized[0], self.ground_offset[local, 0])
        normalized -= self.ground_offset[local].T
        normalized /= ground_scale
        basis = monomials(normalized)
        poly, rates = np.empty((4, len(ground))), np.empty((12, len(ground)))
        for v in range(views.start, views.stop):
            part = slice(bounds[v - views.start], bounds[v - views.start + 1])
            poly[:, part] = self.coeffs[v] @ basis[:, part]
            rates[:, part] = self.gradient[v] @ basis[:10, part]
        slope = rates.reshape(4, 3, -1)
        with np.errstate(all="ignore"):
            inverse = 1.0 / poly[1::2]
            value = poly[::2] * inverse
            jacobian = (slope[::2] - value[:, None] * slope[1::2]) * (inverse * image_scale)[:, None]
        return value * image_scale + self.image_offset[local].T, jacobian / ground_scale


def _parts(start: int, stop: int) -> Iterator[slice]:
    for first in range(start, stop, CHUNK):
        yield slice(first, min(first + CHUNK, stop))


def _times(a: Array, b: Array) -> Array:
    """Products (i, k, n) of small matrices (i, j, n) and (j, k, n)."""
    out: Array = a[:, 0, None] * b[0]
    for j in range(1, len(b)):
        out += a[:, j, None] * b[j]
    return out


def _cross(lever: Array, rows: Array) -> Array:
    """Lever x row, (2, 3, n): the derivative by a small rotation of what `rows` (2, 3, n) measure."""
    out = np.empty_like(rows)
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        out[:, i] = lever[j] * rows[:, k] - lever[k] * rows[:, j]
    return out
