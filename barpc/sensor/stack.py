"""Many cameras at once, each at its own points: RPCs by their numbers stacked, others one by one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from barpc.base.geodesy import CHUNK, NEWTON_STEPS, Array, wrap_longitude
from barpc.sensor import SensorModel
from barpc.sensor.rational import DERIVATIVE, REACH, BoolArray, monomials
from barpc.sensor.rpc import RPC

IntArray = npt.NDArray[np.int64]

_MANY = 1024  # points of a view: its own inverse is sooner made
_SHRINK = 0.25  # of the step before: nothing singular is near (Kantorovich: a half)
_ARRIVED = 1e-6  # of the box's half width: a step is squared, and what it leaves is below rounding


class RpcStack:
    """The RPCs among the sensors, their numbers stacked (V of N rows are used, the others stay zero)."""

    def __init__(self, sensors: Sequence[SensorModel]) -> None:
        n = len(sensors)
        self.coeffs, self.gradient = np.zeros((n, 4, 20)), np.zeros((n, 12, 10))
        self.ground_offset, self.ground_scale = np.zeros((n, 3)), np.ones((n, 3))
        self.image_offset, self.image_scale = np.zeros((n, 2)), np.ones((n, 2))
        rpcs = {i: sensor for i, sensor in enumerate(sensors) if isinstance(sensor, RPC)}
        if rpcs:
            rows = list(rpcs)
            for name in ("coeffs", "ground_offset", "ground_scale", "image_offset", "image_scale"):
                getattr(self, name)[rows] = [getattr(rpc, name) for rpc in rpcs.values()]
            slopes = np.einsum("npi,aij->npaj", self.coeffs, DERIVATIVE)  # of four polynomials by three axes
            self.gradient = (slopes / self.ground_scale[:, None, :, None]).reshape(n, 12, 10)

    def image(self, ground: Array, views: slice, bounds: IntArray) -> Array:
        """Return the image points (2, n) of ground points (3, n) seen by consecutive views."""
        count = np.diff(bounds)
        poly = _polynomials(self.coeffs[views], self._basis(ground, views, count), bounds)
        with np.errstate(all="ignore"):
            value = poly[::2] / poly[1::2]
        value *= np.repeat(self.image_scale[views].T, count, axis=1)
        value += np.repeat(self.image_offset[views].T, count, axis=1)
        return value

    def project(self, ground: Array, views: slice, bounds: IntArray) -> tuple[Array, Array]:
        """Return the image points (2, n) and derivative (2, 3, n) of ground points (3, n) seen by consecutive views."""
        count = np.diff(bounds)
        basis = self._basis(ground, views, count)
        poly = _polynomials(self.coeffs[views], basis, bounds)
        slope = _polynomials(self.gradient[views], basis[:10], bounds).reshape(4, 3, -1)
        image_scale = np.repeat(self.image_scale[views].T, count, axis=1)
        with np.errstate(all="ignore"):
            inverse = 1.0 / poly[1::2]
            value = poly[::2] * inverse
            inverse *= image_scale
            jacobian = value[:, None] * slope[1::2]
            np.subtract(slope[::2], jacobian, out=jacobian)
            jacobian *= inverse[:, None]
        value *= image_scale
        value += np.repeat(self.image_offset[views].T, count, axis=1)
        return value, jacobian

    def _basis(self, ground: Array, views: slice, count: IntArray) -> Array:
        """Return the monomials (20, n) of the normalised coordinates of ground points, `count` of each view."""
        normalized = ground - np.repeat(self.ground_offset[views].T, count, axis=1)
        if not np.abs(normalized[0]).max(initial=0.0) <= 180.0:
            normalized[0] = wrap_longitude(normalized[0])
        normalized *= np.repeat(1.0 / self.ground_scale[views].T, count, axis=1)
        return monomials(normalized)


def _polynomials(coeffs: Array, basis: Array, bounds: IntArray) -> Array:
    """Return the polynomials (m, n) of consecutive views (v, m, 20), each at its own points: a small product a view."""
    out = np.empty((coeffs.shape[1], basis.shape[1]))
    for matrix, start, stop in zip(coeffs, bounds[:-1], bounds[1:], strict=True):
        out[:, start:stop] = matrix @ basis[:, start:stop]
    return out


def localize_stack(sensors: Sequence[SensorModel], image: Array, alt: Array, bounds: IntArray) -> Array:
    """Localise image points (n, 2) [px] at altitudes (n,) [m]: ground points (n, 3), as each camera's `localize`.

    Those of camera v are bounds[v] : bounds[v + 1].
    """
    ground, stack = np.full((len(image), 3), np.nan), RpcStack(sensors)
    count = np.diff(bounds)
    few = np.array([isinstance(sensor, RPC) for sensor in sensors], dtype=bool) & (count <= _MANY)
    alone, start = (count > 0) & ~few, 0
    while start < len(sensors):
        last = int(np.searchsorted(bounds, bounds[start] + CHUNK, side="right")) - 1
        others = np.flatnonzero(~few[start:])
        stop = min(max(start + 1, last), start + int(others[0]) if len(others) else len(sensors))
        if stop > start:
            rows, views = slice(bounds[start], bounds[stop]), slice(start, stop)
            within = bounds[start : stop + 1] - bounds[start]
            ground[rows], found = _newton(stack, image[rows].T, alt[rows], views, within)
            lost = np.add.reduceat(~found, within[:-1][count[views] > 0]) > 0 if len(found) else ~found
            alone[views][count[views] > 0] = lost
        start = max(stop, start + 1)
    for v in np.flatnonzero(alone).tolist():
        part = slice(bounds[v], bounds[v + 1])
        ground[part] = sensors[v].localize(image[part], alt[part])
    return ground


def _newton(stack: RpcStack, image: Array, alt: Array, views: slice, bounds: IntArray) -> tuple[Array, BoolArray]:
    """Return Newton's ground points (n, 3) of consecutive RPCs from their centres, and whether each (n,) is
    certain: within the box, and no step long beside the one before.
    """
    count = np.diff(bounds)
    offset, scale = (np.repeat(rows[views].T, count, axis=1) for rows in (stack.ground_offset, stack.ground_scale))
    ground, before = offset.copy(), np.full(len(alt), np.inf)
    ground[2] = alt
    certain = np.ones(len(alt), dtype=bool)
    for _ in range(NEWTON_STEPS):
        value, ((a, b, _), (c, d, _)) = stack.project(ground, views, bounds)
        with np.errstate(all="ignore"):
            col, row = image - value
            step = np.stack([d * col - b * row, a * row - c * col]) / (a * d - b * c)
        ground[:2] += step
        size = np.abs(step / scale[:2]).max(axis=0)
        certain &= size <= np.maximum(_SHRINK * before, _ARRIVED)
        if not certain.any() or size[certain].max() <= _ARRIVED:
            break
        before = size
    certain &= (size <= _ARRIVED) & (np.abs(ground - offset) <= REACH * np.abs(scale)).all(axis=0)
    return ground.T, certain
