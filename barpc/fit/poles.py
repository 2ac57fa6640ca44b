"""Where the denominators of an RPC are looked at, how small they are there, and the least squares that keeps them up.

A cubic over a box lies above the least coefficient of its Bernstein form over pieces of that box (Farouki 2012, "The
Bernstein polynomial basis: a centennial retrospective"): between samples, too, no pole is missed. These coefficients
are linear in those of the cubic, so that a least squares under a bound is one with linear inequalities.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from math import comb

import numpy as np
import scipy

from barpc.base.geodesy import CHUNK, Array, BoolArray, IntArray
from barpc.fit.system import EPS, MAX_PASSES, TriangularSystem, solution
from barpc.sensor.rational import POWERS, TRUSTED_REACH, monomials
from barpc.sensor.rpc import RPC

MIN_DENOMINATOR_RATIO = 0.1
"""Least value of a denominator over what it is at the centre."""
_PIECES = 8  # of a side
_BERNSTEIN = np.array([[comb(i, k) / comb(3, k) for k in range(4)] for i in range(4)])
_HULL_DIRECTIONS = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)  # in which a hull is cut, level with the ground
_DIRECTIONS = np.column_stack([np.cos(_HULL_DIRECTIONS), np.sin(_HULL_DIRECTIONS)])
_BOUND_SLACK = 1e-9  # of normalised coordinates and denominators: far above the rounding of float64
_CUTS = 40  # inequalities that are taken in in a pass of a bounded least squares


@cache
def _axis() -> Array:
    """Return Bernstein coefficients (n, 4) of the powers 0 .. 3 over the pieces of -1 .. 1."""
    width, rows = 2.0 / _PIECES, []
    for start in -1.0 + width * np.arange(_PIECES):
        shifted = np.zeros((4, 4))  # x^p as a polynomial of the place in the piece
        for p in range(4):
            for k in range(p + 1):
                shifted[k, p] = comb(p, k) * start ** (p - k) * width**k
        rows.append((_BERNSTEIN @ shifted)[:3])
    return np.vstack([*rows, np.ones((1, 4))])  # the last one is the value at 1


@cache
def _net() -> Array:
    """Return Bernstein coefficients (n, n, n, 20) of the monomials over the pieces of the cube -1 .. 1."""
    a, b, c = (_axis()[:, POWERS[:, i]] for i in range(3))
    return np.asarray(a[:, None, None] * b[None, :, None] * c[None, None])


@cache
def _cubic_nodes() -> tuple[Array, Array]:
    """Return nodes (64, 3) in the cube, and the matrix (20, 64) from values there to coefficients of a cubic."""
    places = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 4)] * 3), axis=-1).reshape(-1, 3)
    return places, np.asarray(np.linalg.pinv(monomials(places.T).T))


@dataclass(frozen=True, eq=False)
class Region:
    """A part of the normalised ground: a skew box, cut to the hull of its points."""

    offset: Array  # (3,) of the centre
    axes: Array  # (3, 3) half axes, margin included, one a row
    inside: BoolArray  # (n, n) nodes of the net that count, level with the ground

    @classmethod
    def box(cls, box: Array) -> Region:
        """Return the region of a box (3, 2) in normalised coordinates."""
        return cls(box.mean(axis=1), np.diag(0.5 * (box[:, 1] - box[:, 0])), np.ones(2 * (len(_axis()),), dtype=bool))

    @classmethod
    def around(cls, ground: Array, image: Array, margin: float) -> Region:
        """Return the region of the hull of normalised points (N, 3) and a margin, a share of its half width.

        The sides stand as those of the image do: lon, lat = `image` M + altitude k, M and k by least squares of points
        (N, 2) in the image.
        """
        some = slice(None, None, 1 + len(ground) // CHUNK)
        design = np.hstack([image[some], ground[some, 2:], np.ones((len(ground[some]), 1))])
        slope = np.linalg.lstsq(design - np.append(design[:, :3].mean(axis=0), 0.0), ground[some, :2], rcond=None)[0]
        skew = np.zeros((3, 3))
        skew[:2, :2], skew[2] = slope[:2], [*slope[2], 1.0]
        sides = np.hstack([np.eye(3), -np.eye(3), np.pad(_DIRECTIONS, ((0, 0), (0, 1))).T])
        away = np.linalg.pinv(skew) @ sides
        reach = np.max([(ground[i : i + CHUNK] @ away).max(axis=0) for i in range(0, len(ground), CHUNK)], axis=0)
        middle, half = 0.5 * (reach[:3] - reach[3:6]), 0.5 * (reach[:3] + reach[3:6])
        inside = _touched_nodes(reach[6:] - _DIRECTIONS @ middle[:2], half[:2])
        return cls(middle @ skew, (1.0 + margin) * half[:, None] * skew, inside)

    @cached_property
    def there(self) -> Array:
        """From a cubic's coefficients to those in the skew box (20, 20); its first row: the value at the centre."""
        places, inverse = _cubic_nodes()
        return np.asarray(inverse @ monomials((places @ self.axes + self.offset).T).T)

    def bernstein(self, cubic: Array) -> Array:
        """Return the Bernstein coefficients (K,) of a cubic (20,); the cubic is nowhere below the least of them."""
        net = np.zeros((4, 4, 4))
        net[tuple(POWERS.T)] = self.there @ cubic
        for _ in range(3):  # axis by axis: each is last when its turn is over
            net = np.tensordot(net, _axis(), (0, 1))
        return net[self.inside].ravel()

    def rows(self, index: IntArray) -> Array:
        """Return the rows (len(index), 20) that take a cubic's coefficients to some of its Bernstein coefficients."""
        nodes = np.flatnonzero(np.broadcast_to(self.inside[..., None], _net().shape[:3]))
        return np.asarray(_net().reshape(-1, 20)[nodes[index]] @ self.there)

    def least(self, cubic: Array) -> float:
        """Return a lower bound of a cubic (20,) over the region, near its least value."""
        return float(self.bernstein(cubic).min())

    def above(self, cubic: Array) -> bool:
        """Return whether a denominator (20,) is above `MIN_DENOMINATOR_RATIO` of its value at the centre."""
        return self.least(cubic) > MIN_DENOMINATOR_RATIO * float(self.there[0] @ cubic)

    def smallest(self, cubics: Array) -> float:
        """Return a lower bound of cubics (k, 20) relative to their values at the centre; NaN where one is 0 there."""
        with np.errstate(all="ignore"):
            return float(min(self.least(cubic / (self.there[0] @ cubic)) for cubic in cubics))


def _touched_nodes(reach: Array, half: Array) -> BoolArray:
    """Return the nodes (n, n) of the pieces that a hull of half widths (2,) touches: its `reach` in all directions."""
    width, level = 2.0 / _PIECES, _DIRECTIONS * half
    start = -1.0 + width * np.arange(_PIECES)
    corner = np.stack(np.meshgrid(start, start, indexing="ij"), axis=-1)
    nearest = corner @ level.T + width * np.minimum(level, 0.0).sum(axis=1)
    touched = (nearest <= reach + _BOUND_SLACK).all(axis=-1).astype(np.float64)
    nodes = np.arange(len(_axis()))[:, None] - 3 * np.arange(_PIECES)
    of_piece = ((nodes >= 0) & (nodes <= 3)).astype(np.float64)  # each piece has four, the last is the next one's first
    return np.asarray(of_piece @ touched @ of_piece.T > 0)


def smallest_denominator(rpc: RPC, low: Array, high: Array) -> float:
    """Return a lower bound of the denominators over a box (3,), (3,) and a margin, relative to its centre."""
    box = np.sort(rpc.normalize(np.stack([low, high])), axis=1)
    around = (TRUSTED_REACH - 1.0) * 0.5 * (box[:, 1] - box[:, 0])
    return Region.box(box + around[:, None] * np.array([-1.0, 1.0])).smallest(rpc.coeffs[1::2])


def bounded(system: TriangularSystem, region: Region, active: IntArray) -> Array | None:
    """Return a system's least squares x (k,) with a denominator of at least `MIN_DENOMINATOR_RATIO` over a region; None
    without one.

    The last unknowns are the coefficients of its `active` monomials but the constant one, which is 1. By the
    inequalities that x breaks, taken in few by few: least distance programming, by non-negative least squares (Lawson
    and Hanson, "Solving Least Squares Problems", 1974, chapter 23).
    """
    from scipy.optimize import nnls  # a tenth of a second, which smooth cameras do not need

    floor = MIN_DENOMINATOR_RATIO + 10.0 * _BOUND_SLACK
    x, used, cubic, m = solution(system), np.empty(0, dtype=np.int64), np.eye(20)[0], len(active) - 1
    for _ in range(MAX_PASSES):
        cubic[active[1:]] = x[-m:]
        short = region.bernstein(cubic) - floor * (region.there[0] @ cubic)
        short[used] = 0.0
        broken = np.argsort(short, kind="stable")[:_CUTS]
        broken = broken[short[broken] < -_BOUND_SLACK]
        if not len(broken):
            return x
        used = np.append(used, broken)
        rows = region.rows(used) - floor * region.there[0]
        normal = scipy.linalg.solve_triangular(
            system.matrix, np.pad(rows[:, active[1:]], ((0, 0), (len(x) - m, 0))).T, trans="T"
        )
        below = -rows[:, 0] - system.target @ normal
        size, last = np.linalg.norm(normal, axis=0), np.eye(len(x) + 1)[-1]
        columns = np.vstack([normal, below]) / size
        try:
            residual = columns @ nnls(columns, last)[0] - last
        except RuntimeError:  # too many iterations
            return None
        if not abs(residual[-1]) > EPS:  # no x keeps them all
            return None
        x = np.asarray(scipy.linalg.solve_triangular(system.matrix, system.target - residual[:-1] / residual[-1]))
    return None
