"""Additional parameters in the images: splines over the rows, steps between detectors, displaced parts, sinusoids.

All displace image points, by linear unknowns of a view beside those of its camera. Splines are orthogonal to the drift
polynomials in the row, and steps to a shift and a scale of the columns: what a camera can model stays subject to the
camera's prior. A displaced part is an interval of rows or columns. A sinusoid displaces all rows with a given period.
The prior variances of all of them are estimated (`barpc.ba.robust.variances`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.linalg as la

from barpc.base.geodesy import Array
from barpc.base.statistics import FEW, SAMPLE
from barpc.scene import IntArray
from barpc.sensor.image_corrections import RowSpline, bsplines, profile, sine_and_cosine

MIN_SPLINES = 7  # fewest splines of an image
FIRST_SIGMA = 1.0  # px: prior standard deviation before variances are estimated
OF_VIEWS = {"edges": (0,), "steps": (0, 5), "periods": (0,)}  # arrays with a row per view -> shape of an empty row
DRIFTS = 3  # polynomials in the row (constant, linear, quadratic) to which splines are orthogonal


def most_splines(view: IntArray) -> int:
    """Return how many splines of an image observations of views (K,) allow: `FEW` for each, by the median view."""
    return int(np.median(np.bincount(view))) // FEW


@dataclass(frozen=True, eq=False)
class AdditionalParameters:
    """Layout of a view's additional unknowns [px]: splines, steps, parts, sinusoids; each for col, then for row."""

    count: int  # B-splines over the rows of an image; 0: none
    # (N, C) first columns of further detectors [px], ascending; infinite where a view has fewer
    edges: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # (N, M, 5) displaced parts, as `RowSpline.steps`; infinite where a view has fewer
    steps: Array = field(default_factory=lambda: np.zeros((0, 0, 5)))
    # (N, M) periods of the sinusoids over the rows [px]; infinite where a view has fewer
    periods: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        views = max(map(len, self.of_views.values()))
        for name, shape in OF_VIEWS.items():
            if not len(getattr(self, name)):
                object.__setattr__(self, name, np.zeros((views, *shape)))

    @property
    def of_views(self) -> dict[str, Array]:
        """Name -> array (N, ...) with a row per view."""
        return {name: getattr(self, name) for name in OF_VIEWS}

    @property
    def alike(self) -> IntArray:
        """Indices of displaced parts that are the same columns in all images: they share one displacement."""
        places = self.steps
        same = np.isfinite(places).all(axis=(0, 2)) & (places == places[:1]).all(axis=(0, 2)) & (len(places) > 1)
        return np.flatnonzero(same & (places[:1, :, 0] == 0.0).all(axis=0))

    def select(self, views: IntArray) -> AdditionalParameters:
        """Return the layout of the given views (n,); -1: a new view, which has only splines."""
        rows = {name: np.concatenate([x, np.full((1, *x.shape[1:]), np.inf)]) for name, x in self.of_views.items()}
        return AdditionalParameters(self.count, **{name: one[views] for name, one in rows.items()})

    def joined(self, others: AdditionalParameters) -> AdditionalParameters:
        """Return the layout of these views followed by those of `others`."""
        both = self.of_views.items(), others.of_views.values()
        rows = {name: np.concatenate([x, y]) for (name, x), y in zip(*both, strict=True)}
        return AdditionalParameters(self.count, **rows)

    def beside(self, params: Array, added: AdditionalParameters, of_added: Array) -> tuple[AdditionalParameters, Array]:
        """Return the layout with the displaced parts and sinusoids of `added` after its own, and the unknowns of both.

        `params` (N, size) and `of_added` (N, added.size) are the unknowns of each [px].
        """
        kinds = []
        for own, other, rows in zip(
            self.kinds, added.kinds, (2, 2, 2, 4), strict=True
        ):  # rows: col, row; of waves twice
            both = params[:, own], of_added[:, other]
            kinds.append(np.concatenate([one.reshape(len(one), rows, -1) for one in both], axis=2))
        steps = np.concatenate([self.steps, added.steps], axis=1)
        periods = np.concatenate([self.periods, added.periods], axis=1)
        unknowns = np.hstack([one.reshape(len(params), -1) for one in kinds])
        return replace(self, steps=steps, periods=periods), unknowns

    def is_whole(self, views: int, size: int) -> bool:
        """Return whether the arrays are valid for `views` views of `size` unknowns each."""
        own = self.of_views.values()
        return (
            [one.ndim for one in own] == [2, 3, 2]
            and self.steps.shape[2] == 5
            and all(len(one) == views and one.dtype == np.float64 for one in own)
            and bool((self.periods > 0.0).all())
            and (self.count == 0 or 4 <= self.count <= size)
        )

    @cached_property
    def _spline_basis(self) -> Array:
        """Orthonormal combinations (M, m) of the M B-splines, orthogonal to the polynomials, the smoothest first."""
        if not self.count:
            return np.zeros((0, 0))
        u = np.linspace(-1.0, 1.0, SAMPLE, dtype=np.float64)
        complement = _complement(bsplines(u, self.count) @ np.vander(u, DRIFTS))
        rough = np.diff(complement, axis=0)
        vectors: Array = complement @ la.eigh(rough.T @ rough)[1]
        return vectors * np.where(vectors[-1] < 0, -1.0, 1.0)

    def splines(self, row: Array) -> Array:
        """Return the displacements (m, n) at normalised rows (n,) per unit of each spline unknown of one coordinate."""
        found: Array = self._spline_basis.T @ bsplines(row, self.count)
        return found

    @cached_property
    def _step_basis(self) -> Array:
        """Orthonormal displacements (C + 1, s) of detectors, orthogonal to a shift and (from three on) a scale."""
        num = self.edges.shape[1] + 1
        return _complement(np.vander(np.linspace(-1, 1, num), min(num - 1, 2))) if num > 1 else np.zeros((0, 0))

    @property
    def parts(self) -> tuple[int, int, int, int]:
        """Numbers of unknowns of one coordinate: of splines, steps, parts and sinusoids (cosines, then sines)."""
        return (
            self._spline_basis.shape[1],
            self._step_basis.shape[1],
            self.steps.shape[1],
            2 * self.periods.shape[1],
        )

    @property
    def size(self) -> int:
        """Number of additional unknowns of a view."""
        return 2 * sum(self.parts)

    @property
    def kinds(self) -> tuple[slice, ...]:
        """Slices of the unknowns of splines, steps, parts and sinusoids; each has those of col, then those of row."""
        stops = 2 * np.cumsum((0, *self.parts))
        return tuple(map(slice, stops[:-1].tolist(), stops[1:].tolist()))

    @property
    def _nonempty(self) -> list[slice]:
        return [part for part in self.kinds if part.stop > part.start]

    @cached_property
    def bands(self) -> Array:
        """Variance group (size,) of each unknown: splines by half octaves, then steps, parts and sinusoids."""
        m, *others = self.parts
        octave = 2.0 * np.log2(np.arange(m) + float(DRIFTS))
        rank = np.unique(np.floor(octave), return_inverse=True)[1]
        groups, next_group = [rank, rank], rank.max(initial=-1) + 1
        for count in others:
            groups.append(np.full(2 * count, next_group))
            next_group += bool(count)
        return np.concatenate(groups)

    def stretches(self, rows: float) -> float:
        """Return the number of intervals of an image of `rows` rows whose common errors are independent of each other.

        One per unknown, which follows the error; for a sinusoid, one per half period and coordinate.
        """
        known = np.isfinite(self.periods)
        periods_per_image = np.divide(rows, self.periods, where=known, out=np.zeros_like(self.periods)).sum(axis=1)
        of_sinusoids = 2 * self.parts[3]
        return self.size - of_sinusoids + max(4.0 * float(periods_per_image.max(initial=0.0)), of_sinusoids)

    def basis(self, row: Array, seen: Array, index: IntArray) -> list[Array]:
        """Return, for each kind in use, displacements (m, n) of points per unit of each unknown of one coordinate.

        Points are at `seen` (2, n) [px], normalised rows `row` (n,), in the views `index` (n,).
        """
        found = [self.splines(row)] if self.count else []
        if self.edges.shape[1]:
            steps = self._step_basis.T[:, (seen[0][:, None] >= self.edges[index]).sum(axis=1)]
            found.append(steps * np.isfinite(self.edges[index, 0]))
        if self.steps.shape[1]:
            axis, *shape = np.moveaxis(self.steps, -1, 0)[:, index]  # (n, M) each
            found.append(profile(np.where(axis == 0.0, seen[0][:, None], seen[1][:, None]), *shape).T)
        if self.periods.shape[1]:
            found.append(np.concatenate(list(sine_and_cosine(seen[1][:, None], self.periods[index])), axis=1).T)
        return found

    def displaced(self, params: Array, index: IntArray, basis: list[Array]) -> Array:
        """Return the displacements (2, n) [px] of observations in views `index` (n,) by unknowns `params` (N, size)."""
        out = np.zeros((2, len(index)))
        for part, one in zip(self._nonempty, basis, strict=True):
            of_views = params[:, part].reshape(len(params), 2, -1)
            for v in np.unique(index):
                rows = index == v
                out[:, rows] += of_views[v] @ one[:, rows]
        return out

    def stack(self, out: Array, basis: list[Array]) -> None:
        """Write the derivatives of the displacements by the unknowns into `out` (2, size, n)."""
        out[...] = 0.0
        for part, one in zip(self._nonempty, basis, strict=True):
            middle = (part.start + part.stop) // 2
            out[0, part.start : middle] = out[1, middle : part.stop] = one

    def correction(self, params: Array, view: int, row_offset: float, row_scale: float) -> RowSpline:
        """Return the image correction of a view with unknowns (size,); rows are normalised by offset and scale."""
        splines, detectors, displacements, amplitudes = (params[part].reshape(2, -1).T for part in self.kinds)
        edges, steps, periods = (one[view] for one in self.of_views.values())
        in_edges, in_part, in_period = np.isfinite(edges), np.isfinite(steps[:, 1]), np.isfinite(periods)
        return RowSpline(
            self._spline_basis @ splines,
            row_offset,
            row_scale,
            edges[in_edges],
            (self._step_basis @ detectors)[: in_edges.sum() + in_edges.any()],
            steps[in_part],
            displacements[in_part],
            periods[in_period],
            amplitudes.reshape(2, -1, 2).swapaxes(0, 1)[in_period],  # sinusoid, cosine or sine, coordinate
        )

    def carried(self, params: Array, known: AdditionalParameters) -> Array:
        """Return start values (N, size) from unknowns (N, known.size) of another layout; 0 for kinds that differ."""
        out = np.zeros((len(params), self.size))
        same = self.count == known.count, False, bool(known.parts[2]), self.parts[3] == known.parts[3]
        for is_same, mine, theirs in zip(same, self.kinds, known.kinds, strict=True):
            if is_same:
                old = params[:, theirs].reshape(len(params), 2, -1)
                new = np.zeros((len(params), 2, (mine.stop - mine.start) // 2))
                new[..., : old.shape[2]] = old
                out[:, mine] = new.reshape(len(params), -1)
        return out


def _complement(vectors: Array) -> Array:
    """Return an orthonormal basis (n, n - k) of the complement of vectors (n, k)."""
    q: Array = np.asarray(la.qr(vectors)[0], dtype=np.float64)
    return q[:, vectors.shape[1] :]
