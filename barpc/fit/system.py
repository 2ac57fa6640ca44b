"""The linearised system of a fit, compressed to a triangle whatever the number of points.

One coordinate y = a(x) / b(x), b_0 = 1, is linear in its unknowns once it is multiplied by b:

    w (m(x), -y m'(x)) (a, b') = w y,      w = 1 / b(x)  or 1                       (eq. 3 of the paper)

m are the twenty monomials in RPC00B order, m' those without the constant one. Every solver works on the
triangular factor of (M | y), which is made chunk by chunk: a squared condition never appears.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg.lapack import dtpqrt

from barpc.fit.precision import Normalization
from barpc.geodesy import Array, wrap_longitude
from barpc.sensor.rpc import monomials

IntArray = npt.NDArray[np.int64]

CHUNK = 1024
"""Rows taken into the triangle at a time: what is worked on stays in cache."""
_BLOCK = 8  # columns of a Householder block

ALL = np.arange(20)
_DEPENDENT = 1e-9  # rms of what a monomial adds to those of lower degree, on these points


@dataclass(frozen=True, eq=False)
class Compressed:
    """Triangular factor of the system (M | y) of one coordinate.

    Parameters
    ----------
    triangle : (k + 1, k + 1)
        R of the QR decomposition of (M | y): its last column is Q' y, its last entry the norm of the part
        of y that no solution reaches.
    num_points : int
        Rows of M.
    """

    triangle: Array
    num_points: int

    @property
    def matrix(self) -> Array:
        """(k, k): what stands for M."""
        return self.triangle[:-1, :-1]

    @property
    def target(self) -> Array:
        """(k,): what stands for y."""
        return self.triangle[:-1, -1]

    @property
    def sigma(self) -> float:
        """Standard deviation of the noise in y, from the residual of the free solution."""
        dof = max(self.num_points - len(self.matrix), 1)
        return abs(float(self.triangle[-1, -1])) / float(np.sqrt(dof))

    def squares(self, solution: Array) -> float:
        """Sum of squares of M x - y."""
        rest = self.matrix @ solution - self.target
        return float(rest @ rest + self.triangle[-1, -1] ** 2)

    def stacked(self, rows: Array) -> Compressed:
        """The system with `rows` (n, k + 1) below."""
        return Compressed(_take_in(self.triangle, rows), self.num_points)


def _take_in(triangle: Array, rows: Array) -> Array:
    """Triangular factor of `triangle` on top of `rows`."""
    block = min(_BLOCK, len(triangle))
    factor: Array = dtpqrt(0, block, triangle, np.asfortranarray(rows), overwrite_b=True)[0]
    return factor


@dataclass(frozen=True, eq=False)
class Problem:
    """Points, and the offsets and scales of the RPC that is to be fitted to them.

    Parameters
    ----------
    ground : (N, 3)
        lon, lat [deg], alt [m].
    image : (N, 2)
        col, row [px].
    norm : Normalization
        Offsets and scales.
    active : (m,)
        Monomials in use, the constant one first.
    weight : (N,), optional
        Weights of the points.
    first : Compressed, optional
        The compressed system of col without a denominator, where it is known already.
    """

    ground: Array
    image: Array
    norm: Normalization
    active: IntArray = field(default_factory=lambda: ALL)
    weight: Array | None = None
    first: Compressed | None = None

    def screened(self) -> Problem:
        """The same problem without the monomials that its points cannot tell apart."""
        first = self.compressed(0)
        active = self._independent(first)
        return replace(self, first=first) if len(active) == len(self.active) else replace(self, active=active)

    def _independent(self, system: Compressed) -> IntArray:
        """The monomials that these points tell from those before them, which are of lower degree.

        All twenty where altitudes abound; of points at one altitude those without H, of two altitudes
        those of degree one in H. A dependent one would make a = b = 0 a solution.
        """
        diagonal = np.diag(system.matrix)[: len(self.active)]
        return np.asarray(self.active[np.abs(diagonal) > _DEPENDENT * np.sqrt(len(self.image))])

    def rows(
        self, axis: int, denominator: Array | None = None, free: bool = True
    ) -> Iterator[tuple[slice, Array]]:
        """Rows (n, k + 1) of (M | y) of col (0) or row (1), some hundred points at a time.

        Parameters
        ----------
        axis : int
            0 col, 1 row.
        denominator : (20,), optional
            Weights the rows by 1 / b.
        free : bool
            Whether the denominator's coefficients are unknowns too.
        """
        m = len(self.active)
        k = 2 * m - 1 if free else m
        norm = self.norm
        for start in range(0, len(self.image), CHUNK):
            part = slice(start, start + CHUNK)
            lonlatalt = self.ground[part].T.copy()
            lonlatalt[0] = wrap_longitude(lonlatalt[0], norm.ground_offset[0])
            basis = monomials((lonlatalt - norm.ground_offset[:, None]) / norm.ground_scale[:, None])
            y = (self.image[part, axis] - norm.image_offset[axis]) / norm.image_scale[axis]
            used = basis if m == len(basis) else basis[self.active]
            block = np.empty((k + 1, len(y)))
            block[:m] = used
            if free:
                np.multiply(used[1:], -y, out=block[m:k])
            block[k] = y
            if denominator is not None:
                if free:
                    block /= denominator @ basis
                else:
                    block[:m] /= denominator @ basis
            if self.weight is not None:
                block *= self.weight[part]
            yield part, block.T

    def compressed(self, axis: int, denominator: Array | None = None, free: bool = True) -> Compressed:
        """The compressed system of col (0) or row (1); parameters as of `rows`."""
        if self.first is not None and axis == 0 and denominator is None and free:
            return self.first
        size = 2 * len(self.active) if free else len(self.active) + 1
        triangle: Array = np.zeros((size, size), order="F")
        for _, rows in self.rows(axis, denominator, free):
            triangle = _take_in(triangle, rows)
        return Compressed(np.triu(triangle), len(self.image))

    def expanded(self, solution: Array, denominator: Array | None = None) -> Array:
        """Numerator and denominator (2, 20) of a solution; monomials not in use are zero."""
        m = len(self.active)
        out = np.zeros((2, 20))
        out[0, self.active] = solution[:m]
        if denominator is not None:
            out[1] = denominator
        else:
            out[1, 0] = 1.0
            out[1, self.active[1:]] = solution[m:]
        return out
