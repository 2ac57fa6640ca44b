"""What rotations, translations and drifts leave in the images: splines over the rows, steps between detectors.

Both are displacements in the image, of where a point is seen: linear unknowns of a view beside its others. What the
drift can do is not theirs, so that their prior does not loosen it: splines are orthogonal to its polynomials of the
row, steps to a shift and a scale of the columns. How large they are in a view is learnt (`barpc.ba.variances`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.linalg as la

from barpc.geodesy import Array
from barpc.scene import IntArray
from barpc.sensor.splined import RowSpline, bsplines

FIRST_SIGMA = 0.3  # px: a prior's standard deviation before anything is known
_DEGREE = 2  # of the polynomials of the row that are the drift's
_SAMPLES = 40  # a spline, to integrate over


@dataclass(frozen=True, eq=False)
class Waves:
    """Layout of a view's unknowns in the image [px]: (col, row) of the splines, then of the steps."""

    count: int  # B-splines over the rows of an image; 0: none
    # (N, C) columns where another detector begins [px], ascending; infinite where a view has fewer
    edges: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @cached_property
    def _of_splines(self) -> Array:
        """(M, m) orthonormal coefficients of what is orthogonal to the polynomials, the slowest first."""
        if not self.count:
            return np.zeros((0, 0))
        u = np.linspace(-1.0, 1.0, self.count * _SAMPLES, dtype=np.float64)
        free = _complement(bsplines(u, self.count) @ np.vander(u, _DEGREE + 1))
        rough = np.diff(free, axis=0)
        vectors: Array = free @ la.eigh(rough.T @ rough)[1]
        return vectors * np.where(vectors[-1] < 0, -1.0, 1.0)

    @cached_property
    def _of_steps(self) -> Array:
        """(C + 1, s) the same of detectors, against a shift and, of three and more, a scale."""
        num = self.edges.shape[1] + 1
        return (
            _complement(np.vander(np.linspace(-1, 1, num), min(num - 1, 2))) if num > 1 else np.zeros((0, 0))
        )

    @property
    def parts(self) -> tuple[int, int]:
        """Unknowns of one coordinate: of splines, of steps."""
        return self._of_splines.shape[1], self._of_steps.shape[1]

    @property
    def size(self) -> int:
        """Unknowns of a view."""
        return 2 * sum(self.parts)

    @property
    def kinds(self) -> tuple[slice, slice]:
        """The unknowns of splines and of steps: those of the columns, then those of the rows."""
        m, s = self.parts
        return slice(0, 2 * m), slice(2 * m, 2 * (m + s))

    @property
    def _filled(self) -> list[slice]:
        return [part for part in self.kinds if part.stop > part.start]

    @cached_property
    def bands(self) -> Array:
        """Which unknowns (size,) are about as large: half an octave of waves, or steps."""
        m, s = self.parts
        octave = 2.0 * np.log2(np.arange(m) + _DEGREE + 1.0)
        rank = np.unique(np.floor(octave), return_inverse=True)[1]
        return np.concatenate([rank, rank, np.full(2 * s, rank.max(initial=-1) + 1)])

    def basis(self, row: Array, col: Array, index: IntArray) -> list[Array]:
        """What one unit of the unknowns of one coordinate adds (m, n), kind by kind; rows are normalised."""
        found = [self._of_splines.T @ bsplines(row, self.count)] if self.count else []
        if self.edges.shape[1]:
            steps = self._of_steps.T[:, (col[:, None] >= self.edges[index]).sum(axis=1)]
            found.append(steps * np.isfinite(self.edges[index, 0]))
        return found

    def displaced(self, params: Array, index: IntArray, basis: list[Array]) -> Array:
        """Displacement (2, n) [px] of observations of views `index` (n,) whose unknowns are `params` (N, size)."""
        out = np.zeros((2, len(index)))
        for part, one in zip(self._filled, basis, strict=True):
            of_views = params[:, part].reshape(len(params), 2, -1)
            for v in np.unique(index):
                rows = index == v
                out[:, rows] += of_views[v] @ one[:, rows]
        return out

    def stack(self, out: Array, basis: list[Array]) -> None:
        """Put the derivatives by the unknowns into (2, size, n)."""
        out[...] = 0.0
        for part, one in zip(self._filled, basis, strict=True):
            middle = (part.start + part.stop) // 2
            out[0, part.start : middle] = out[1, middle : part.stop] = one

    def correction(self, params: Array, view: int, row_offset: float, row_scale: float) -> RowSpline:
        """The correction of a view with the unknowns (size,)."""
        m, s = self.parts
        coeffs = self._of_splines @ params[: 2 * m].reshape(2, m).T if m else np.zeros((0, 2))
        known = np.isfinite(self.edges[view]) if s else np.zeros(0, dtype=bool)
        if not known.any():
            return RowSpline(coeffs, row_offset, row_scale)
        steps = self._of_steps @ params[2 * m :].reshape(2, s).T
        return RowSpline(coeffs, row_offset, row_scale, self.edges[view][known], steps[: known.sum() + 1])


def _complement(vectors: Array) -> Array:
    """An orthonormal basis (n, n - k) of what is orthogonal to vectors (n, k)."""
    q: Array = np.asarray(la.qr(vectors)[0], dtype=np.float64)
    return q[:, vectors.shape[1] :]
