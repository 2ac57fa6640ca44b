"""Covariance of corrections, points and relative heights from the reduced normal matrix."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg as la

from barpc.ba.linear import Factor
from barpc.ba.normal import Reduced, solve_transposed
from barpc.geodesy import Array
from barpc.scene import BoolArray, IntArray

_COLUMNS = 240  # unit vectors solved for at a time


@dataclass(frozen=True, eq=False)
class Covariance:
    """Posterior covariance of an adjustment; computed when asked, from the factorised normal matrix.

    Parameters
    ----------
    reduced : Reduced
        The problem linearised at its solution.
    factor : Factor
        Of the reduced matrix, free unknowns only.
    free : (N q,)
        Unknowns that are not fixed.
    """

    reduced: Reduced
    factor: Factor
    free: BoolArray

    @property
    def num_unknowns(self) -> int:
        """q, the unknowns of a view."""
        return int(self.reduced.cross.shape[2])

    def solve(self, rows: Array) -> Array:
        """S^-1 b for right-hand sides (N q, m); zero for fixed unknowns."""
        out = np.zeros(rows.shape)
        out[self.free] = self.factor.solve(np.ascontiguousarray(rows[self.free]))
        return out

    def view(self, i: int, j: int | None = None) -> Array:
        """Covariance (q, q) of the unknowns of view i (with those of view j)."""
        q = self.num_unknowns
        j = i if j is None else j
        if "full" in self.__dict__:
            return self.full[i * q : (i + 1) * q, j * q : (j + 1) * q]
        unit = np.zeros((len(self.free), q))
        unit[j * q + np.arange(q), np.arange(q)] = 1.0
        return self.solve(unit)[i * q : (i + 1) * q]

    @cached_property
    def full(self) -> Array:
        """Covariance (N q, N q) of all unknowns: N^2 numbers, meant for some hundred views."""
        n = len(self.free)
        out = np.empty((n, n))
        for start in range(0, n, _COLUMNS):
            stop = min(start + _COLUMNS, n)
            unit = np.zeros((n, stop - start))
            unit[np.arange(start, stop), np.arange(stop - start)] = 1.0
            out[:, start:stop] = self.solve(unit)
        return 0.5 * (out + out.T)

    def points(self, index: IntArray) -> Array:
        """Covariance (n, 3, 3) [m^2], ECEF, of the points `index` (n,): their own noise and the cameras'."""
        structure = self.reduced.structure
        out = np.empty((len(index), 3, 3))
        lower = self.reduced.lower[:, index]
        inverse = _inverse_transposed(lower)
        for n, p in enumerate(index):
            rows = structure.by_point[structure.point_bounds[p] : structure.point_bounds[p + 1]]
            sensitivity = -inverse[n] @ self.reduced.cross[rows].transpose(1, 0, 2).reshape(3, -1)
            cameras = self.joint(structure.view[rows])
            out[n] = inverse[n] @ inverse[n].T + sensitivity @ cameras @ sensitivity.T
        return out if self.reduced.common is None else self._with_common(index, inverse, out)

    def _with_common(self, index: IntArray, inverse: Array, out: Array) -> Array:
        """`out` where points share errors, which move with every camera."""
        structure, common, q = self.reduced.structure, self.reduced.common, self.num_unknowns
        assert common is not None
        place = {int(p): n for n, p in enumerate(common.index)}
        for n, p in enumerate(index):
            if int(p) not in place:
                continue
            shared = (
                -inverse[n] @ la.solve_triangular(common.upper, common.cross[place[int(p)]].T, trans="T").T
            )
            rows = structure.by_point[structure.point_bounds[p] : structure.point_bounds[p + 1]]
            sensitivity = -shared @ common.by_camera
            for k in rows:
                at = structure.view[k] * q
                sensitivity[:, at : at + q] -= inverse[n] @ self.reduced.cross[k]
            out[n] = inverse[n] @ inverse[n].T + shared @ shared.T + sensitivity @ self.solve(sensitivity.T)
        return out

    def joint(self, views: IntArray) -> Array:
        """Covariance (m q, m q) of the unknowns of some views."""
        q = self.num_unknowns
        place = (views[:, None] * q + np.arange(q)).ravel()
        if len(self.free) <= 2000 or "full" in self.__dict__:
            of_views: Array = self.full[np.ix_(place, place)]
            return of_views
        unit = np.zeros((len(self.free), len(place)))
        unit[place, np.arange(len(place))] = 1.0
        solved: Array = self.solve(unit)[place]
        return solved


def _inverse_transposed(lower: Array) -> Array:
    """L^-T (n, 3, 3) of factors (6, n)."""
    n = lower.shape[1]
    out = np.empty((n, 3, 3))
    for i in range(3):
        unit = np.zeros((3, n))
        unit[i] = 1.0
        out[:, :, i] = solve_transposed(lower, unit).T
    return out
