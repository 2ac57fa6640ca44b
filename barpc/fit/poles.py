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
import numpy.typing as npt
from scipy.linalg import solve_triangular

from barpc.fit.system import EPS, Compressed, IntArray, solution
from barpc.geodesy import CHUNK, Array
from barpc.sensor.rational import MONOMIALS, monomials
from barpc.sensor.rpc import RPC

FLOOR = 0.1
"""Least value of a denominator over what it is at the centre."""
BOX = 0.25  # share of the half width, around a box: of an RPC whose image is not known
_PIECES = 8  # of a side
_NODES = 3 * _PIECES + 1  # of its control net
_POWERS = np.array([[monomial.count(letter) for letter in "LPH"] for monomial in MONOMIALS])
_BERNSTEIN = np.array([[comb(i, k) / comb(3, k) for k in range(4)] for i in range(4)])
_LEVEL = 32  # directions that a hull is cut in, level with the ground; up and down are two more
_ANGLES = np.linspace(0.0, 2.0 * np.pi, _LEVEL, endpoint=False)
_DIRECTIONS = np.vstack([np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES), 0 * _ANGLES]), [[0, 0, 1], [0, 0, -1]]])
_AXES = np.array([[0, _LEVEL // 4, -2], [_LEVEL // 2, 3 * _LEVEL // 4, -1]])  # of them, and their opposites
_ROUNDS, _CUTS = 20, 40  # of a bounded least squares; inequalities that are taken in in one
_SLACK = 1e-9  # of a bound: rounding
_STEPS, _FARTHEST = 400, 20.0  # along a ray that a pole is looked for on; half widths


@cache
def _net() -> Array:
    """Return Bernstein coefficients (n, n, n, 20) of the monomials over the pieces of the cube -1 .. 1, n =
    `_NODES`.
    """
    width, rows = 2.0 / _PIECES, []
    for start in -1.0 + width * np.arange(_PIECES):
        shifted = np.zeros((4, 4))  # x^p as a polynomial of the place in the piece
        for p in range(4):
            for k in range(p + 1):
                shifted[k, p] = comb(p, k) * start ** (p - k) * width**k
        rows.append((_BERNSTEIN @ shifted)[:3])
    axis = np.vstack([*rows, np.ones((1, 4))])  # the last one is the value at 1
    a, b, c = (axis[:, _POWERS[:, i]] for i in range(3))
    return np.asarray(a[:, None, None] * b[None, :, None] * c[None, None])


@cache
def _lattice() -> tuple[Array, Array]:
    """Return the places (64, 3) in the cube, and what takes values there to the coefficients of a cubic (20, 64)."""
    places = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 4)] * 3), axis=-1).reshape(-1, 3)
    return places, np.asarray(np.linalg.pinv(monomials(places.T).T))


@dataclass(frozen=True, eq=False)
class Region:
    """Part of the normalised ground: a skew box, without what lies outside the hull of the points in it."""

    offset: Array  # (3,) of the centre
    axes: Array  # (3, 3) half axes, margin included, one a row
    inside: npt.NDArray[np.bool_]  # (n, n) nodes of the net that count, level with the ground

    @classmethod
    def box(cls, box: Array) -> Region:
        """Return a region that is a box (3, 2) in normalised coordinates."""
        return cls(box.mean(axis=1), np.diag(0.5 * (box[:, 1] - box[:, 0])), np.ones((_NODES, _NODES), dtype=bool))

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
        inverse = np.linalg.pinv(skew) @ _DIRECTIONS.T
        reach = np.max([(ground[i : i + CHUNK] @ inverse).max(axis=0) for i in range(0, len(ground), CHUNK)], axis=0)
        ends = reach[_AXES]
        middle, half = 0.5 * (ends[0] - ends[1]), 0.5 * (ends[0] + ends[1])
        inside = _inside(reach - _DIRECTIONS @ middle, half[:2])
        return cls(middle @ skew, (1.0 + margin) * half[:, None] * skew, inside)

    @cached_property
    def there(self) -> Array:
        """Matrix (20, 20) that takes a cubic's coefficients to those in the skew box; its first row gives the
        value at the centre.
        """
        places, inverse = _lattice()
        return np.asarray(inverse @ monomials((places @ self.axes + self.offset).T).T)

    def bernstein(self, cubic: Array) -> Array:
        """Return the Bernstein coefficients (K,) of a cubic (20,); the cubic is nowhere below the least of them."""
        return np.asarray((_net() @ (self.there @ cubic))[self.inside].ravel())

    def rows(self, index: IntArray) -> Array:
        """Return the rows (len(index), 20) that take a cubic's coefficients to some of its Bernstein coefficients."""
        nodes = np.flatnonzero(np.broadcast_to(self.inside[..., None], (_NODES,) * 3))
        return np.asarray(_net().reshape(-1, 20)[nodes[index]] @ self.there)

    def least(self, cubic: Array) -> float:
        """Return a lower bound of a cubic (20,) over the region, near its least value."""
        return float(self.bernstein(cubic).min())

    def above(self, cubic: Array) -> bool:
        """Return whether a denominator (20,) is above `FLOOR` of what it is at the centre."""
        return self.least(cubic) > FLOOR * float(self.there[0] @ cubic)

    def smallest(self, cubics: Array) -> float:
        """Return a lower bound of cubics (k, 20) over what they are at the centre; NaN where one is 0 there."""
        with np.errstate(all="ignore"):
            return float(min(self.least(cubic / (self.there[0] @ cubic)) for cubic in cubics))

    def nearest_pole(self, cubics: Array, margin: float) -> tuple[Array, float]:
        """Return the place (3,) nearest to the centre at which one of cubics (k, 20) is 0, and its distance
        (1: the end of the points).

        Of a region with a `margin`, along rays from its centre to every side; NaN and infinite where there is none.
        """
        places = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 9)] * 3), axis=-1).reshape(-1, 3)
        rays = places[np.abs(places).max(axis=1) == 1.0] @ self.axes / (1.0 + margin)
        far = np.linspace(0.0, _FARTHEST, _STEPS + 1)
        ground = self.offset + far[:, None, None] * rays
        value = cubics @ monomials(ground.reshape(-1, 3).T) / (cubics @ self.there[0])[:, None]
        poles = (value <= 0).any(axis=0).reshape(ground.shape[:2])
        if not poles.any():
            return np.full(3, np.nan), np.inf
        step = int(poles.any(axis=1).argmax())
        return ground[step, poles[step].argmax()], float(far[step])


def _inside(reach: Array, half: Array) -> npt.NDArray[np.bool_]:
    """Return the nodes (n, n) of the net of the pieces that a hull touches: its `reach` in all directions,
    half widths (2,).
    """
    width, level = 2.0 / _PIECES, _DIRECTIONS[:, :2] * half
    start = -1.0 + width * np.arange(_PIECES)
    corner = np.stack(np.meshgrid(start, start, indexing="ij"), axis=-1)
    nearest = corner @ level.T + width * np.minimum(level, 0.0).sum(axis=1)
    inside = np.zeros((_NODES, _NODES), dtype=bool)
    for i, j in np.argwhere((nearest[..., :_LEVEL] <= reach[:_LEVEL] + _SLACK).all(axis=-1)):
        inside[3 * i : 3 * i + 4, 3 * j : 3 * j + 4] = True
    return inside


def least_value(cubic: Array, box: Array) -> float:
    """Return a lower bound, near the least value, of a cubic (20,) over a `box` (3, 2)."""
    return Region.box(box).least(cubic)


def smallest_denominator(rpc: RPC, low: Array, high: Array) -> float:
    """Return a lower bound of the denominators over a box `low`, `high` (3,) [deg, deg, m] and 25 % around
    it.

    Over what they are at its centre.
    """
    return smallest_value(rpc.coeffs[1::2], rpc.normalize(np.stack([low, high])))


def smallest_value(cubics: Array, box: Array) -> float:
    """Return a lower bound of cubics (k, 20) over a box (3, 2) and 25 % around it, over what they are at its centre."""
    middle, half = box.mean(axis=1), 0.5 * np.abs(box[:, 1] - box[:, 0])
    return Region.box(middle[:, None] + (1.0 + BOX) * half[:, None] * np.array([-1.0, 1.0])).smallest(cubics)


def bounded(system: Compressed, region: Region, active: IntArray) -> Array | None:
    """Return the least-squares solution x (k,) of a system whose denominator is at least `FLOOR` over a
    region; None if there is none.

    The last unknowns are the coefficients of its `active` monomials but the constant one, which is 1. By the
    inequalities that x breaks, taken in few by few: least distance programming, by non-negative least squares (Lawson
    and Hanson, "Solving Least Squares Problems", 1974, chapter 23).
    """
    from scipy.optimize import nnls  # a tenth of a second, which smooth cameras do not need

    floor = FLOOR + 10.0 * _SLACK
    x, used, cubic, m = solution(system), np.empty(0, dtype=np.int64), np.eye(20)[0], len(active) - 1
    for _ in range(_ROUNDS):
        cubic[active[1:]] = x[-m:]
        short = region.bernstein(cubic) - floor * (region.there[0] @ cubic)
        short[used] = 0.0
        broken = np.argsort(short, kind="stable")[:_CUTS]
        broken = broken[short[broken] < -_SLACK]
        if not len(broken):
            return x
        used = np.append(used, broken)
        rows = region.rows(used) - floor * region.there[0]
        normal = solve_triangular(system.matrix, np.pad(rows[:, active[1:]], ((0, 0), (len(x) - m, 0))).T, trans="T")
        below = -rows[:, 0] - system.target @ normal
        size, last = np.linalg.norm(normal, axis=0), np.eye(len(x) + 1)[-1]
        columns = np.vstack([normal, below]) / size
        try:
            residual = columns @ nnls(columns, last)[0] - last
        except RuntimeError:  # too many iterations
            return None
        if not abs(residual[-1]) > EPS:  # no x keeps them all
            return None
        x = np.asarray(solve_triangular(system.matrix, system.target - residual[:-1] / residual[-1]))
    return None
