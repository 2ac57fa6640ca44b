"""Points all over an image and its altitudes, and how far from these another camera, or a reader of its file, is.

`Sample`: points that a camera shows, of a regular grid. `Scattered`: points at random, for what a grid may miss. They
are drawn one a cell of the image and at an altitude of its own each, with more along its edges; where the error is
largest more are drawn around the worst, closer and closer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from barpc.base.errors import FitError
from barpc.base.geodesy import Array, BoolArray
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Corrected
from barpc.sensor.geometry import Several

GRID_NODES = 11, 5  # of a grid over an image, along its sides and its altitudes
NEGLIGIBLE_FIT_ERROR = 1e-6  # px: what no other method is tried on, and no round trip is held to
SAMPLE_CELLS = 45
"""Along each side of the image: 2025 points of the whole."""
_EDGE_POINTS = 12  # points along each edge of the image, at either end of the altitudes
_WORST, _AROUND, _ROUNDS = 16, 8, 5  # points that are looked around at, new ones around each, rounds, ever nearer

Projection = Callable[[Array], Array]
"""Ground points (N, 3) [deg, deg, m] -> image points (N, 2) [px], centre of the first pixel = (0, 0)."""


def image_grid(
    size: tuple[int, int], alt_range: tuple[float, float], nodes: tuple[int, int] = GRID_NODES
) -> tuple[Array, Array]:
    """Return the image points (N, 2) [px] and altitudes (N,) [m] of a grid over an image, columns slowest."""
    col, row = (np.linspace(0, side - 1, nodes[0]) for side in size)
    grid = np.stack(np.meshgrid(col, row, np.linspace(*alt_range, nodes[1]), indexing="ij"), axis=-1)
    return grid[..., :2].reshape(-1, 2), grid[..., 2].ravel()


@dataclass(frozen=True, eq=False)
class Sample:
    """Ground points (N, 3) lon, lat [deg], alt [m], or in another frame, and where a camera shows them (N, 2) [px]."""

    ground: Array
    image: Array

    @classmethod
    def grid(cls, model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float]) -> Sample:
        """Return the sample of a grid over an image of `size` (width, height) and its altitudes: `grids` of one."""
        return cls.grids([(model, size, alt_range)])[0]

    @classmethod
    def grids(
        cls,
        cameras: Sequence[tuple[SensorModel, tuple[int, int], tuple[float, float]]],
        nodes: tuple[int, int] = GRID_NODES,
    ) -> list[Sample]:
        """Return the samples of grids (`image_grid`) over images and their altitudes, without points not seen."""
        grids = [image_grid(size, alt_range, nodes) for _, size, alt_range in cameras]
        many = Several([model for model, _, _ in cameras], np.repeat(np.arange(len(grids)), nodes[0] ** 2 * nodes[1]))
        image, alt = map(np.concatenate, zip(*grids, strict=True))
        ground = many.localize(image, alt)
        places = zip(*(np.split(one, len(grids)) for one in (ground, many.project(ground, image))), strict=True)
        return [cls(one[known := np.isfinite(one).all(axis=1)], seen[known]) for one, seen in places]

    def compare(self, read: Projection) -> float:
        """Return the largest distance [px] of a reader's projections from where the camera shows the points."""
        return float(np.linalg.norm(read(self.ground) - self.image, axis=1).max())


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

    @property
    def rms(self) -> float:
        """Root mean square of the distances [px]."""
        return float(np.linalg.norm(self.rmse))

    @property
    def far(self) -> float:
        """Distance [px] of the largest error in columns and in rows together."""
        return float(np.linalg.norm(self.largest))


@dataclass(frozen=True, eq=False)
class Scattered:
    """Points of a model at random places of an image of `size` (width, height) and a range of altitudes."""

    model: SensorModel
    size: tuple[int, int]
    alt_range: tuple[float, float]
    points: Array  # (N, 3) col, row [px], altitude [m] with a ground point; those all over the image come first
    ground: Array  # (N, 3) lon, lat [deg], alt [m]
    count: int  # of those all over the image
    missing: float  # part of the image and the altitudes without a ground point

    @classmethod
    def over(
        cls,
        model: SensorModel,
        size: tuple[int, int],
        alt_range: tuple[float, float],
        cells: int = SAMPLE_CELLS,
        seed: int = 0,
    ) -> Scattered:
        """Sample a model at one random point in each of `cells` x `cells` parts of an image, and along its edges."""
        if min(size) < 1:
            raise FitError(f"image size {size[0]} x {size[1]}: nothing to fit over")
        points = _scaled(_scattered(cells, seed), size, alt_range)
        ground, known = _on_ground(model, points)
        inside = known[: cells**2]
        share = float(inside.mean())
        return cls(model, size, alt_range, points[known], ground[known], int(inside.sum()), 1.0 - share)

    def also(self, points: Array) -> Scattered:
        """Return the sample with more points (M, 3) col, row [px], altitude [m] around which to search for errors."""
        ground, known = _on_ground(self.model, points)
        more = np.concatenate([self.points, points[known]]), np.concatenate([self.ground, ground[known]])
        return replace(self, points=more[0], ground=more[1])

    def contradiction(self) -> float:
        """Return the largest distance [px] from where the model projects its ground; infinite where it fails.

        At the altitudes that were asked for, whatever altitudes it gave back.
        """
        asked = np.column_stack([self.ground[:, :2], self.points[:, 2]])
        image = self.points[:, :2]
        found = self.model.project(asked, image) if isinstance(self.model, Corrected) else self.model.project(asked)
        return float(_finite_size(found - image).max(initial=0.0))

    def compare(self, read: Projection, locates: bool = False) -> Errors:
        """Return the errors of a reader's projections, the largest around the points too; infinite where it has none.

        A reader that `locates` gives ground points (N, 3) of col, row, altitude (N, 3) instead.
        """

        def off(ground: Array, at: Array) -> Array:
            return _finite_size((self.model.project(read(at)) if locates else read(ground)) - at[:, :2])

        points, miss, errors = self.points, off(self.ground, self.points), Errors()
        errors.add(miss[: self.count])
        rng, reach = np.random.default_rng(1), np.array([1.0 / SAMPLE_CELLS, 1.0 / SAMPLE_CELLS, 0.25])
        unit = (points - _scaled(np.zeros(3), self.size, self.alt_range)) / self._span
        for _ in range(_ROUNDS if float(miss.max(initial=0.0)) > NEGLIGIBLE_FIT_ERROR else 0):
            worst = np.unique(np.concatenate([np.argsort(-miss[:, axis], kind="stable")[:_WORST] for axis in range(2)]))
            near = unit[np.repeat(worst, _AROUND)] + reach * rng.uniform(-1.0, 1.0, (len(worst) * _AROUND, 3))
            near = near.clip(0.0, 1.0)
            at = _scaled(near, self.size, self.alt_range)
            ground, known = _on_ground(self.model, at)
            found = off(ground[known], at[known])
            unit, miss, reach = np.concatenate([unit, near[known]]), np.concatenate([miss, found]), reach / 2
        if len(miss):
            errors.largest = miss.max(axis=0)
            errors.worst = _scaled(unit[miss.argmax(axis=0)], self.size, self.alt_range)
        return errors

    @property
    def _span(self) -> Array:
        return np.array([*self.size, max(self.alt_range[1] - self.alt_range[0], 1e-9)], dtype=np.float64)


@cache
def _scattered(cells: int, seed: int) -> Array:
    """Return a random place in each of `cells` x `cells` parts of an image, then places along its edges, in 0 .. 1."""
    rng = np.random.default_rng(seed)
    cell = np.stack(np.meshgrid(*[np.arange(cells)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    inside = np.column_stack([cell, rng.permutation(len(cell))]) + rng.random((len(cell), 3))
    inside /= [cells, cells, len(cell)]
    t, ends = np.linspace(0.0, 1.0, _EDGE_POINTS), (0.0, 1.0)
    edges = [(*at, h) for u in t for end in ends for at in ((u, end), (end, u)) for h in ends]
    return np.concatenate([inside, edges])


def _on_ground(model: SensorModel, points: Array) -> tuple[Array, BoolArray]:
    """Return the ground (N, 3) of points (N, 3) col, row [px], altitude [m], and where there is any (N,)."""
    ground = model.localize(points[:, :2], points[:, 2])
    return ground, np.asarray(np.isfinite(ground).all(axis=1))


def _finite_size(values: Array) -> Array:
    return np.nan_to_num(np.abs(values), nan=np.inf)


def _scaled(unit: Array, size: tuple[int, int], alt_range: tuple[float, float]) -> Array:
    """Return the col, row, altitude (..., 3) of places in 0 .. 1."""
    low, high = alt_range
    return np.asarray(unit * [*size, high - low] + [-0.5, -0.5, low])
