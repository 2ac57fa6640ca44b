"""What an RPC is worth over a whole image: points that the fit has not seen, poles, round trips.

The points are drawn one a cell of the image and at an altitude of its own each, with more along its edges; where the
error is largest more are drawn around the worst, closer and closer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from barpc.errors import FitError
from barpc.geodesy import CHUNK, Array, wrap_longitude
from barpc.sensor import SensorModel
from barpc.sensor.rpc import RPC

BoolArray = npt.NDArray[np.bool_]

EXACT = 1e-6  # px: what no other method is tried on, and no round trip is held to
CELLS = 45
"""Along each side of the image: 2025 points of the whole."""
_EDGE = 12  # points along each edge of the image, at either end of the altitudes
_WORST, _AROUND, _ROUNDS = 16, 8, 5  # points that are looked around at, new ones around each, how often
_NEARER = 0.5  # each time


@dataclass
class Errors:
    """Running root mean square and largest error of (N, 2) residuals [px]."""

    count: int = 0
    squares: Array = field(default_factory=lambda: np.zeros(2))
    largest: Array = field(default_factory=lambda: np.zeros(2))
    # (k, 3) col, row [px], altitude [m] of the largest
    worst: Array = field(default_factory=lambda: np.empty((0, 3)))

    def add(self, residual: Array) -> None:
        """Add residuals (N, 2) [px]; one that is NaN makes the result NaN."""
        if len(residual):
            self.count += len(residual)
            self.squares = self.squares + np.einsum("ij,ij->j", residual, residual)
            self.largest = np.maximum(self.largest, np.abs(residual.T).max(axis=1))

    @property
    def rmse(self) -> Array:
        """Root mean square (2,) [px]."""
        return np.asarray(np.sqrt(self.squares / self.count)) if self.count else np.full(2, np.nan)


@dataclass(frozen=True, eq=False)
class Sample:
    """Points of a model all over an image of `size` (width, height) and a range of altitudes."""

    model: SensorModel
    size: tuple[int, int]
    alt_range: tuple[float, float]
    points: Array  # (N, 3) col, row [px], altitude [m] with a ground point; those all over the image come first
    ground: Array  # (N, 3) lon, lat [deg], alt [m]
    count: int  # of those all over the image
    missing: float  # part of the image and the altitudes without a ground point

    @classmethod
    def of(
        cls,
        model: SensorModel,
        size: tuple[int, int],
        alt_range: tuple[float, float],
        cells: int = CELLS,
        seed: int = 0,
    ) -> Sample:
        """Sample a model at one random point in each of `cells` x `cells` parts of an image, and along its edges."""
        if min(size) < 1:
            raise FitError(f"image size {size[0]} x {size[1]}: nothing to fit over")
        rng = np.random.default_rng(seed)
        cell = np.stack(np.meshgrid(*[np.arange(cells)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
        inside = np.column_stack([cell, rng.permutation(len(cell))]) + rng.random((len(cell), 3))
        inside /= [cells, cells, len(cell)]
        t, ends = np.linspace(0.0, 1.0, _EDGE), (0.0, 1.0)
        edges = [(*at, h) for u in t for end in ends for at in ((u, end), (end, u)) for h in ends]
        points = _scaled(np.concatenate([inside, edges]), size, alt_range)
        ground = model.localize(points[:, :2], points[:, 2])
        known: BoolArray = np.asarray(np.isfinite(ground).all(axis=1))
        share = float(known[: len(inside)].mean())
        return cls(model, size, alt_range, points[known], ground[known], int(known[: len(inside)].sum()), 1.0 - share)

    def also(self, points: Array) -> Sample:
        """Return the sample with more points (M, 3) col, row [px], altitude [m] around which the largest
        error is searched.
        """
        ground = self.model.localize(points[:, :2], points[:, 2])
        known = np.isfinite(ground).all(axis=1)
        return replace(
            self,
            points=np.concatenate([self.points, points[known]]),
            ground=np.concatenate([self.ground, ground[known]]),
        )

    def contradiction(self) -> float:
        """Return the largest distance [px] of the points from where the model projects their ground; infinite
        where it fails.

        At the altitudes that were asked for, whatever altitudes it gave back.
        """
        asked = np.column_stack([self.ground[:, :2], self.points[:, 2]])
        return float(_size(self.model.project(asked) - self.points[:, :2]).max(initial=0.0))

    def errors(self, rpc: RPC) -> tuple[Errors, Array]:
        """Return the errors of an RPC at the sampled points, and its largest errors (2,) [px] after searching
        around them.

        They are infinite where the RPC has no image point.
        """
        return self.sought(lambda ground, points: rpc.project(ground) - points[:, :2])

    def sought(self, off: Callable[[Array, Array], Array]) -> tuple[Errors, Array]:
        """Return the errors (N, 2) [px] of an RPC at ground points (N, 3) and their (N, 3) col, row [px],
        altitude [m].
        """
        points, miss = self.points, _size(off(self.ground, self.points))
        errors = Errors()
        errors.add(miss[: self.count])
        rng, reach = np.random.default_rng(1), np.array([1.0 / CELLS, 1.0 / CELLS, 0.25])
        unit = (points - _scaled(np.zeros(3), self.size, self.alt_range)) / self._span
        for _ in range(_ROUNDS if float(miss.max(initial=0.0)) > _TINY else 0):
            worst = np.unique(np.concatenate([np.argsort(-miss[:, axis], kind="stable")[:_WORST] for axis in range(2)]))
            near = unit[np.repeat(worst, _AROUND)] + reach * rng.uniform(-1.0, 1.0, (len(worst) * _AROUND, 3))
            near = near.clip(0.0, 1.0)
            at = _scaled(near, self.size, self.alt_range)
            ground = self.model.localize(at[:, :2], at[:, 2])
            known = np.isfinite(ground).all(axis=1)
            found = _size(off(ground[known], at[known]))
            unit, miss, reach = (
                np.concatenate([unit, near[known]]),
                np.concatenate([miss, found]),
                reach * _NEARER,
            )
        if len(miss):
            errors.worst = _scaled(unit[miss.argmax(axis=0)], self.size, self.alt_range)
        return errors, miss.max(axis=0, initial=0.0)

    @property
    def _span(self) -> Array:
        return np.array([*self.size, max(self.alt_range[1] - self.alt_range[0], 1e-9)], dtype=np.float64)


_TINY = 1e-7  # px: errors that are no larger are rounding, and alike everywhere


def _size(values: Array) -> Array:
    return np.nan_to_num(np.abs(values), nan=np.inf)


def _scaled(unit: Array, size: tuple[int, int], alt_range: tuple[float, float]) -> Array:
    """Return the col, row, altitude (..., 3) of places in 0 .. 1."""
    low, high = alt_range
    return np.asarray(unit * [*size, high - low] + [-0.5, -0.5, low])


def roundtrip(rpc: RPC, ground: Array) -> float:
    """Return the largest distance [px] between ground points (N, 3) and where their projections are localised."""
    image, jacobian = rpc.project_jacobian(ground)
    back = rpc.localize(image, ground[:, 2])
    miss = back - ground
    miss[:, 0] = wrap_longitude(miss[:, 0])
    distance = np.abs(np.einsum("nij,nj->ni", jacobian, miss))
    return float(distance.max(initial=0.0)) if np.isfinite(distance).all() else float("inf")


def coverage(image: Array, low: Array, high: Array) -> float:
    """Return the share of the rectangle `low`, `high` (2,) [px] inside the convex hull of image points (N, 2) [px]."""
    angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    direction = np.column_stack([np.cos(angle), np.sin(angle)])  # outside is beyond all in one direction
    reach = np.full(len(angle), -np.inf)
    for start in range(0, len(image), CHUNK):
        part = (image[start : start + CHUNK] - low) / (high - low)
        reach = np.maximum(reach, (direction @ part.T).max(axis=1))
    t = (np.arange(20) + 0.5) / 20
    cells = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    return float((cells @ direction.T <= reach + 1e-9).all(axis=1).mean())
