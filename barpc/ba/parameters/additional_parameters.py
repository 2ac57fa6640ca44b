"""Additional parameters in the images: splines over the rows, steps between detectors, displaced parts, sinusoids.

All are displacements in the image, of where a point is seen: linear unknowns of a view beside its others. What the
drift can do is not theirs, so that their prior does not loosen it: splines are orthogonal to its polynomials of the
row, steps to a shift and a scale of the columns. A part of the rows or columns is displaced as a whole, and all rows of
an image with a known period. How large all of them are in a view is learnt (`barpc.ba.robust.variances`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.linalg as la

from barpc.base.geodesy import Array
from barpc.base.statistics import SAMPLE
from barpc.scene import IntArray
from barpc.sensor.image_corrections import RowSpline, bsplines, profile, sine_and_cosine

MIN_SPLINES = 7  # splines
FIRST_SIGMA = 1.0  # px: a prior's standard deviation before anything is known
OF_VIEWS = {"edges": (0,), "strips": (0, 5), "periods": (0,)}  # arrays with a row a view: shapes of empty rows
DRIFTS = 3  # polynomials of the row that are the drift's, a constant, a slope and a bend: splines are apart from them


@dataclass(frozen=True, eq=False)
class AdditionalParameters:
    """Layout of a view's unknowns in the image [px]: (col, row) of splines, then of steps, parts and sinusoids."""

    count: int  # B-splines over the rows of an image; 0: none
    # (N, C) columns where another detector begins [px], ascending; infinite where a view has fewer
    edges: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # (N, M, 5) strips that lie off, as `RowSpline` has them; infinite where a view has fewer
    strips: Array = field(default_factory=lambda: np.zeros((0, 0, 5)))
    # (N, M) periods of the rows' swings [px]; infinite where a view has fewer
    periods: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        views = max(map(len, self.of_views.values()))
        for name, shape in OF_VIEWS.items():
            if not len(getattr(self, name)):
                object.__setattr__(self, name, np.zeros((views, *shape)))

    @property
    def of_views(self) -> dict[str, Array]:
        """The arrays with a row (N, ...) a view, by their name."""
        return {name: getattr(self, name) for name in OF_VIEWS}

    @property
    def alike(self) -> IntArray:
        """Numbers of the displaced parts that all images have at the same columns: there they are one displacement."""
        places = self.strips
        same = np.isfinite(places).all(axis=(0, 2)) & (places == places[:1]).all(axis=(0, 2)) & (len(places) > 1)
        return np.flatnonzero(same & (places[:1, :, 0] == 0.0).all(axis=0))

    def select(self, views: IntArray) -> AdditionalParameters:
        """Return the layout of some views (n,); -1: of a new one, which has splines alone."""
        rows = {name: np.concatenate([x, np.full((1, *x.shape[1:]), np.inf)]) for name, x in self.of_views.items()}
        return AdditionalParameters(self.count, **{name: one[views] for name, one in rows.items()})

    def joined(self, others: AdditionalParameters) -> AdditionalParameters:
        """Return the layout of these views and, behind them, of others."""
        both = self.of_views.items(), others.of_views.values()
        rows = {name: np.concatenate([x, y]) for (name, x), y in zip(*both, strict=True)}
        return AdditionalParameters(self.count, **rows)

    def is_whole(self, views: int, size: int) -> bool:
        """Return whether its arrays are those of so many views, of `size` unknowns each."""
        own = self.of_views.values()
        return (
            [one.ndim for one in own] == [2, 3, 2]
            and self.strips.shape[2] == 5
            and all(len(one) == views and one.dtype == np.float64 for one in own)
            and bool((self.periods > 0.0).all())
            and (self.count == 0 or 4 <= self.count <= size)
        )

    @cached_property
    def _of_splines(self) -> Array:
        """(M, m) orthonormal coefficients of the complement of the polynomials, the slowest first."""
        if not self.count:
            return np.zeros((0, 0))
        u = np.linspace(-1.0, 1.0, SAMPLE, dtype=np.float64)
        free = _complement(bsplines(u, self.count) @ np.vander(u, DRIFTS))
        rough = np.diff(free, axis=0)
        vectors: Array = free @ la.eigh(rough.T @ rough)[1]
        return vectors * np.where(vectors[-1] < 0, -1.0, 1.0)

    def splines(self, row: Array) -> Array:
        """Return the displacement (m, n) at normalised rows (n,) by one unit of each spline unknown of a coordinate."""
        found: Array = self._of_splines.T @ bsplines(row, self.count)
        return found

    @cached_property
    def _of_steps(self) -> Array:
        """(C + 1, s) the same of detectors, against a shift and, of three and more, a scale."""
        num = self.edges.shape[1] + 1
        return _complement(np.vander(np.linspace(-1, 1, num), min(num - 1, 2))) if num > 1 else np.zeros((0, 0))

    @property
    def parts(self) -> tuple[int, int, int, int]:
        """Numbers of unknowns of one coordinate: splines, steps, parts, sinusoids (cosines, then sines)."""
        return (
            self._of_splines.shape[1],
            self._of_steps.shape[1],
            self.strips.shape[1],
            2 * self.periods.shape[1],
        )

    @property
    def size(self) -> int:
        """Number of unknowns of a view."""
        return 2 * sum(self.parts)

    @property
    def kinds(self) -> tuple[slice, ...]:
        """The unknowns of splines, steps, parts and sinusoids: those of the columns, then those of the rows."""
        stops = 2 * np.cumsum((0, *self.parts))
        return tuple(map(slice, stops[:-1].tolist(), stops[1:].tolist()))

    @property
    def _filled(self) -> list[slice]:
        return [part for part in self.kinds if part.stop > part.start]

    @cached_property
    def bands(self) -> Array:
        """Groups of unknowns (size,) of about the same size: half an octave of waves, steps, parts, sinusoids."""
        m, *others = self.parts
        octave = 2.0 * np.log2(np.arange(m) + float(DRIFTS))
        rank = np.unique(np.floor(octave), return_inverse=True)[1]
        found, further = [rank, rank], rank.max(initial=-1) + 1
        for count in others:
            found.append(np.full(2 * count, further))
            further += bool(count)
        return np.concatenate(found)

    def stretches(self, rows: float) -> float:
        """Return the number of parts of an image of so many rows over which an error shared by neighbours
        counts anew.

        A sinusoid takes the mean of one in each half of its waves, and of each coordinate.
        """
        known = np.isfinite(self.periods)
        waves = np.divide(rows, self.periods, where=known, out=np.zeros_like(self.periods)).sum(axis=1)
        of_swings = 2 * self.parts[3]
        return self.size - of_swings + max(4.0 * float(waves.max(initial=0.0)), of_swings)

    def basis(self, row: Array, seen: Array, index: IntArray) -> list[Array]:
        """Return the displacement (m, n) of points seen at (2, n) [px] by one unit of each unknown of a
        coordinate, kind by kind.

        Their rows (n,) normalised are given, too.
        """
        found = [self.splines(row)] if self.count else []
        if self.edges.shape[1]:
            steps = self._of_steps.T[:, (seen[0][:, None] >= self.edges[index]).sum(axis=1)]
            found.append(steps * np.isfinite(self.edges[index, 0]))
        if self.strips.shape[1]:
            axis, *shape = np.moveaxis(self.strips, -1, 0)[:, index]  # (n, M) each
            found.append(profile(np.where(axis == 0.0, seen[0][:, None], seen[1][:, None]), *shape).T)
        if self.periods.shape[1]:
            found.append(np.concatenate(list(sine_and_cosine(seen[1][:, None], self.periods[index])), axis=1).T)
        return found

    def displaced(self, params: Array, index: IntArray, basis: list[Array]) -> Array:
        """Return the displacement (2, n) [px] of observations of views `index` (n,) whose unknowns are
        `params` (N, size).
        """
        out = np.zeros((2, len(index)))
        for part, one in zip(self._filled, basis, strict=True):
            of_views = params[:, part].reshape(len(params), 2, -1)
            for v in np.unique(index):
                rows = index == v
                out[:, rows] += of_views[v] @ one[:, rows]
        return out

    def stack(self, out: Array, basis: list[Array]) -> None:
        """Write the derivatives by the unknowns into (2, size, n)."""
        out[...] = 0.0
        for part, one in zip(self._filled, basis, strict=True):
            middle = (part.start + part.stop) // 2
            out[0, part.start : middle] = out[1, middle : part.stop] = one

    def correction(self, params: Array, view: int, row_offset: float, row_scale: float) -> RowSpline:
        """Return the correction of a view with the unknowns (size,)."""
        splines, steps, moved, swung = (params[part].reshape(2, -1).T for part in self.kinds)
        edges, strips, periods = (one[view] for one in self.of_views.values())
        begins, lies_off, swings = np.isfinite(edges), np.isfinite(strips[:, 1]), np.isfinite(periods)
        return RowSpline(
            self._of_splines @ splines,
            row_offset,
            row_scale,
            edges[begins],
            (self._of_steps @ steps)[: begins.sum() + begins.any()],
            strips[lies_off],
            moved[lies_off],
            periods[swings],
            swung.reshape(2, -1, 2).swapaxes(0, 1)[swings],  # sinusoid, cosine or sine, coordinate
        )

    def carried(self, params: Array, known: AdditionalParameters) -> Array:
        """Return unknowns (N, size) started from those of another layout (N, known.size), where kinds agree."""
        out = np.zeros((len(params), self.size))
        same = self.count == known.count, False, bool(known.parts[2]), self.parts[3] == known.parts[3]
        for agrees, mine, theirs in zip(same, self.kinds, known.kinds, strict=True):
            if agrees:
                old = params[:, theirs].reshape(len(params), 2, -1)
                new = np.zeros((len(params), 2, (mine.stop - mine.start) // 2))
                new[..., : old.shape[2]] = old
                out[:, mine] = new.reshape(len(params), -1)
        return out


def _complement(vectors: Array) -> Array:
    """Return an orthonormal basis (n, n - k) of the complement of vectors (n, k)."""
    q: Array = np.asarray(la.qr(vectors)[0], dtype=np.float64)
    return q[:, vectors.shape[1] :]
