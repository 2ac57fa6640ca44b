"""The linearised system of points and an RPC, and its solution; offsets and scales, and the digits of a format.

One coordinate y = a(x) / b(x), b_0 = 1, is linear in its unknowns once it is multiplied by b:

    w (m(x), -y m'(x)) (a, b') = w y,      w = 1 / b(x)  or 1                       (eq. 3 of the paper)

m are the twenty monomials in RPC00B order, m' those without the constant one. The triangular factor of (M | y) is made
chunk by chunk: no condition number is squared, whatever the number of points.

An RPC copied into a format with few digits loses what the format cuts off. Fitted with its offsets and
scales already rounded, and each coefficient rounded while the others can still make up for it, it does not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import scipy

from barpc.base.errors import FitError
from barpc.base.frozen import Frozen
from barpc.base.geodesy import Array, IntArray, parts
from barpc.base.statistics import SURELY
from barpc.sensor.rational import POWERS, monomials

_TRIANGLE_ROWS = 1024  # taken into the triangle at a time: what is worked on stays in cache
_HOUSEHOLDER_COLUMNS = 8  # columns of a Householder block
_MONOMIAL_DEGREES = POWERS.sum(axis=1)
_NUMERATOR = np.array([np.inf, np.inf, 0.1, 0.03])
_DENOMINATOR = np.array([np.inf, 1.0, 0.1, 0.01])
_RANK_TOLERANCE = 1e-9  # RMS that a monomial adds to those of lower degree: with less it depends on them
_SIGMA_STEPS = 2
TAU = 0.003
"""Standard deviation that ``ridge`` expects of a denominator coefficient of degree one (no unit)."""
EPS = float(np.finfo(np.float64).eps)
MAX_PASSES = 20
"""Most passes of an iteration."""


@dataclass(frozen=True, eq=False, repr=False)
class Normalization(Frozen):
    """The offsets and scales of an RPC.

    Parameters
    ----------
    ground_offset, ground_scale : (3,)
        lon, lat [deg], alt [m]. A scale may be negative, not zero.
    image_offset, image_scale : (2,), col, row [px]
    """

    ground_offset: Array
    ground_scale: Array
    image_offset: Array
    image_scale: Array

    def __post_init__(self) -> None:
        for name in ("ground_offset", "ground_scale", "image_offset", "image_scale"):
            value = self._array(name, (3 if name.startswith("ground") else 2,), FitError)
            if name.endswith("scale") and not value.all():
                raise FitError(f"Normalization {name}: a scale is zero")


@dataclass(frozen=True, eq=False)
class TriangularSystem:
    """Triangle R (k + 1, k + 1) of the QR decomposition of (M | y) of one coordinate, M of `num_points` rows.

    Its last column is Q' y, its last entry the norm of the part of y that no solution reaches.
    """

    triangle: Array
    num_points: int

    @property
    def matrix(self) -> Array:
        """Triangle (k, k) that stands for M."""
        return self.triangle[:-1, :-1]

    @property
    def target(self) -> Array:
        """Column (k,) that stands for y."""
        return self.triangle[:-1, -1]

    @property
    def freedom(self) -> int:
        """Points beyond the number of unknowns, at least one."""
        return max(self.num_points - len(self.matrix), 1)

    @property
    def sigma(self) -> float:
        """Standard deviation of the noise in y, from the residual of the free solution."""
        return abs(float(self.triangle[-1, -1])) / float(np.sqrt(self.freedom))

    def squares(self, solution: Array) -> float:
        """Return the sum of squares of M x - y."""
        rest = self.matrix @ solution - self.target
        return float(rest @ rest + self.triangle[-1, -1] ** 2)

    def penalized(self, penalty: Array, toward: Array | float = 0.0) -> TriangularSystem:
        """Return the system with the rows diag(`penalty`) x = `toward` below."""
        rows = np.column_stack([np.diag(penalty), np.broadcast_to(toward, penalty.shape)])
        return TriangularSystem(_take_in(self.triangle, rows), self.num_points)


def _take_in(triangle: Array, rows: Array) -> Array:
    """Return the triangular factor of `triangle` on top of `rows`."""
    block = min(_HOUSEHOLDER_COLUMNS, len(triangle))
    return np.asarray(scipy.linalg.lapack.dtpqrt(0, block, triangle, np.asfortranarray(rows), overwrite_b=True)[0])


@dataclass(frozen=True, eq=False)
class FitProblem:
    """Points, and the offsets and scales of the RPC to be fitted to them."""

    ground: Array  # (N, 3) lon, lat [deg], alt [m]
    image: Array  # (N, 2) [px]
    norm: Normalization
    active: IntArray = field(default_factory=partial(np.arange, 20))  # monomials in use, the constant one first
    weight: Array | None = None  # (N,)
    # share of the half width of the points, around them, over which denominators are kept up
    margin: float = 0.1
    first: TriangularSystem | None = None  # of col without a denominator, where it is known already

    def screened(self) -> FitProblem:
        """Return the problem without the monomials that depend at its points on those of lower degree.

        All twenty stay where altitudes abound; of points at one altitude those without H, of two altitudes those of
        degree one in H. A dependent one would make a = b = 0 a solution.
        """
        first = self.compressed(0)
        adds = np.abs(np.diag(first.matrix)[: len(self.active)]) > _RANK_TOLERANCE * np.sqrt(len(self.image))
        return replace(self, first=first) if adds.all() else replace(self, active=self.active[adds])

    def rows(
        self, axis: int, denominator: Array | None = None, free: bool = True, numerator: Array | None = None
    ) -> Iterator[tuple[slice, Array]]:
        """Yield the rows (n, k + 1) of (M | y) of col (`axis` 0) or row (1), some hundred points at a time.

        A denominator (20,) weights the rows by 1 / b; its coefficients are unknowns too where `free`. With a numerator,
        too, they are those of the linearised a / b.
        """
        m, norm = len(self.active), self.norm
        k = 2 * m - 1 if free else m
        for part in parts(len(self.image), _TRIANGLE_ROWS):
            x = np.subtract(self.ground[part].T, norm.ground_offset[:, None], order="C")
            basis = monomials(x / norm.ground_scale[:, None])
            y = (self.image[part, axis] - norm.image_offset[axis]) / norm.image_scale[axis]
            used = basis if m == len(basis) else basis[self.active]
            if numerator is not None and denominator is not None:
                value, below = (numerator @ basis) / (denominator @ basis), denominator @ basis
                y = below * (y - value) + value
            else:
                value = y
            block = np.empty((k + 1, len(y)))
            block[:m] = used
            if free:
                np.multiply(used[1:], -value, out=block[m:k])
            block[k] = y
            if denominator is not None:
                block[: k + 1 if free else m] /= denominator @ basis
            if self.weight is not None:
                block *= self.weight[part]
            yield part, block.T

    def compressed(
        self, axis: int, denominator: Array | None = None, free: bool = True, numerator: Array | None = None
    ) -> TriangularSystem:
        """Return the system of the rows of the same parameters."""
        if self.first is not None and axis == 0 and denominator is None and free:
            return self.first
        size = 2 * len(self.active) if free else len(self.active) + 1
        triangle: Array = np.zeros((size, size), order="F")
        for _, rows in self.rows(axis, denominator, free, numerator):
            triangle = _take_in(triangle, rows)
        return TriangularSystem(np.triu(triangle), len(self.image))

    def expanded(self, solution: Array, denominator: Array | None = None) -> Array:
        """Return the numerator and denominator (2, 20) of a solution; monomials not in use are zero."""
        m, out = len(self.active), np.zeros((2, 20))
        out[0, self.active] = solution[:m]
        if denominator is not None:
            out[1] = denominator
        else:
            out[1, 0], out[1, self.active[1:]] = 1.0, solution[m:]
        return out

    def packed(self, expanded: Array) -> Array:
        """Return the solution (k,) of which `expanded` makes these numerators and denominator."""
        return np.concatenate([expanded[0, self.active], expanded[1, self.active[1:]]])


def expected_size(active: IntArray) -> Array:
    """Return the size (k,) expected of each unknown, those of the denominator last; infinite where nothing is expected.

    Numerator: 0.1 of degree two, 0.03 of degree three. Denominator: `TAU` of degree one, a tenth of it
    of degree two, a hundredth of degree three: what vendors' RPCs show, with room.
    """
    degree = _MONOMIAL_DEGREES[active]
    return np.concatenate([_NUMERATOR[degree], TAU * _DENOMINATOR[degree[1:]]])


def noise_scaled(system: TriangularSystem, expected: Array) -> tuple[TriangularSystem, float]:
    """Return the system with each unknown penalised by sigma / its expected size, and sigma.

    The free solution lets noisy denominators shrink, and the residual with them; the residual of the
    penalised one tells the noise better. What it shows to be surely larger than expected, against its penalty, is
    expected of that size: of radar's columns a denominator's first degree is 55 times an optical one's, and the misfit
    of a model without noise, taken for noise, would hold it down. Never quite singular: there is a floor at the
    rounding.
    """
    floor = 16 * EPS * float(np.abs(system.matrix).max())
    sigma = system.sigma
    for _ in range(_SIGMA_STEPS):
        penalty = np.where(np.isfinite(expected), np.maximum(sigma / expected, floor), 0.0)
        penalised = system.penalized(penalty)
        found = solution(penalised)
        sigma = float(np.sqrt(system.squares(found) / system.freedom))
        expected = np.where(np.abs(found) > SURELY * expected, np.abs(found), expected)
    return penalised, sigma


def solution(system: TriangularSystem) -> Array:
    """Return the least-squares solution (k,), by back substitution."""
    return np.asarray(scipy.linalg.solve_triangular(system.matrix, system.target))
