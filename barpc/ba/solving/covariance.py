"""Covariance of corrections, points and relative heights from the reduced normal matrix."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg as la

from barpc.ba.solving.linear import Blocks, Factor
from barpc.ba.solving.normal import Reduced, solve_transposed
from barpc.ba.solving.structure import unknowns_of
from barpc.base.geodesy import Array, parts
from barpc.base.statistics import FEW, KEPT
from barpc.scene import BoolArray, IntArray

_DENSE_UNKNOWNS = 900  # unknowns up to which the whole matrix is kept, and known exactly


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Response of an adjustment to k errors that images have in common, by one standard deviation of each."""

    by_unknown: Array  # (N q, k) moves of the unknowns
    of_points: Callable[[IntArray], Array]  # of points (n,) their moves (n, 3, k) [m], ECEF, with the cameras held


@dataclass(frozen=True, eq=False)
class Covariance:
    """Posterior covariance of an adjustment; computed when asked, from the factorised normal matrix."""

    reduced: Reduced  # the problem linearised at its solution
    factor: Factor  # of the reduced matrix, free unknowns only
    free: BoolArray  # (N q,) unknowns that are not fixed
    shared: SharedErrors | None = None

    @property
    def num_unknowns(self) -> int:
        """Number of unknowns q of a view."""
        return int(self.reduced.cross.shape[2])

    def solve(self, rows: Array) -> Array:
        """Return S^-1 b for right-hand sides (N q, m); zero for fixed unknowns."""
        out = np.zeros(rows.shape)
        out[self.free] = self.factor.solve(np.ascontiguousarray(rows[self.free]))
        return out if self.shared is None else out + self.shared.by_unknown @ (self.shared.by_unknown.T @ rows)

    @cached_property
    def of_noise(self) -> Covariance:
        """The same without the errors that images have in common."""
        return self if self.shared is None else replace(self, shared=None)

    @property
    def is_large(self) -> bool:
        """Whether exact variances take seconds: as long as two factorisations."""
        return len(self.free) > _DENSE_UNKNOWNS

    def variances(self) -> Array:
        """Return the variances (N, q) of all unknowns; zero for fixed ones."""
        if self.factor.inverse is None:
            return self.full.diagonal().reshape(-1, self.num_unknowns)
        return np.asarray(self.of_views().diagonal(axis1=1, axis2=2))

    def of_views(self) -> Array:
        """Return the covariances (N, q, q) of every view's unknowns."""
        if self.factor.inverse is not None:
            return self._near.diagonal if self.shared is None else self._near.diagonal + self._of_shared()
        q, every = self.num_unknowns, np.arange(len(self.free) // self.num_unknowns)
        return np.asarray(self.full.reshape(-1, q, len(every), q)[every, :, every])

    def probed_views(self) -> Array:
        """Estimate the covariances (N, q, q) of every view's unknowns by random probes (Hutchinson 1990) at the cost of
        a few solutions: each variance within a quarter (RMS).

        Unknowns count in units of their standard deviation where all other views stood still: a variance would
        drown in those of others that are a hundred times as large.
        """
        q = self.num_unknowns
        views, unit = np.flatnonzero(self.free[::q]), np.ones((len(self.free) // q, q))
        unit[views] = np.sqrt(np.linalg.inv(self.reduced.of_views()[views]).diagonal(axis1=1, axis2=2))
        random = np.random.default_rng(unit.size).integers(0, 2, (unit.size, FEW))
        probes = np.where(random > 0, 1.0, -1.0)
        solved = self.solve(probes / unit.reshape(-1, 1)).reshape(*unit.shape, FEW)
        found = solved @ np.swapaxes(probes.reshape(*unit.shape, FEW), 1, 2) / FEW * unit[:, None]
        return np.asarray(0.5 * (found + np.swapaxes(found, 1, 2)))

    def view(self, i: int, j: int | None = None) -> Array:
        """Return the covariance (q, q) of the unknowns of view i (with those of view j)."""
        return self._of_pair(i, i if j is None else j, "full" in self.__dict__)

    def joint(self, views: IntArray) -> Array:
        """Return the covariance (m q, m q) of the unknowns of some views."""
        of_full = not self.is_large or "full" in self.__dict__
        if of_full or self.factor.inverse is None:
            place = unknowns_of(views, self.num_unknowns)
            return self.columns(place, of_full)[place]
        return np.block([[self._of_pair(int(i), int(j), False) for j in views] for i in views])

    def _of_pair(self, i: int, j: int, of_full: bool) -> Array:
        """Return the covariance (q, q) of view i with view j: where they share points, all such are known at once."""
        if self.factor.inverse is not None and not of_full:
            more = 0.0 if self.shared is None else self._of_shared(i) @ self._of_shared(j).T
            if i == j:
                return np.asarray(self._near.diagonal[i] + more)
            if (at := self._near.pair(min(i, j), max(i, j))) is not None:
                return np.asarray((self._near.pairs[at] if i < j else self._near.pairs[at].T) + more)
        own, other = (unknowns_of(np.array([view]), self.num_unknowns) for view in (i, j))
        return self.columns(other, of_full)[own]

    def _of_shared(self, view: int | None = None) -> Array:
        """Return the rows (q, k) of a view in common errors; without a view the covariances (N, q, q) by these."""
        assert self.shared is not None
        rows = self.shared.by_unknown.reshape(-1, self.num_unknowns, self.shared.by_unknown.shape[1])
        return np.asarray(rows @ np.swapaxes(rows, 1, 2) if view is None else rows[view])

    @cached_property
    def _near(self) -> Blocks:
        """The covariance of every view, and of those that share points."""
        assert self.factor.inverse is not None
        return self.factor.inverse()

    def columns(self, place: IntArray, of_full: bool = False) -> Array:
        """Return the covariance (N q, m) of all unknowns with those at `place` (m,)."""
        if of_full:
            return self.full[:, place]
        unit = np.zeros((len(self.free), len(place)))
        unit[place, np.arange(len(place))] = 1.0
        return self.solve(unit)

    @cached_property
    def full(self) -> Array:
        """Covariance (N q, N q) of all unknowns: N^2 numbers, meant for some hundred views."""
        out = np.zeros((len(self.free), len(self.free)))
        if self.factor.whole_inverse is not None:
            out[np.ix_(self.free, self.free)] = self.factor.whole_inverse()
            return out if self.shared is None else out + self.shared.by_unknown @ self.shared.by_unknown.T
        every = np.arange(len(self.free))
        for part in parts(len(every), max(KEPT // len(every), 1)):
            out[:, part] = self.columns(every[part])
        return 0.5 * (out + out.T)

    def shared_moves(self, index: IntArray) -> Array:
        """Return the moves (n, 3, k) [m], ECEF, of the points `index` (n,) by errors that images have in common."""
        assert self.shared is not None
        by_unknown = self.shared.by_unknown.reshape(-1, self.num_unknowns, self.shared.by_unknown.shape[1])
        return np.asarray(self.reduced.carried(by_unknown, index) + self.shared.of_points(index))

    def points(self, index: IntArray) -> Array:
        """Return the covariance (n, 3, 3) [m^2], ECEF, of the points `index` (n,): their own noise and the cameras'."""
        if self.shared is not None:
            moves = self.shared_moves(index)
            return np.asarray(self.of_noise.points(index) + moves @ np.swapaxes(moves, 1, 2))
        structure = self.reduced.structure
        out = np.empty((len(index), 3, 3))
        lower = self.reduced.lower[:, index]
        inverse = solve_transposed(lower, np.eye(3)[..., None]).transpose(2, 0, 1)  # L^-T
        for n, p in enumerate(index):
            rows = structure.by_point[structure.point_bounds[p] : structure.point_bounds[p + 1]]
            sensitivity = -inverse[n] @ self.reduced.cross[rows].transpose(1, 0, 2).reshape(3, -1)
            cameras = self.joint(structure.view[rows])
            out[n] = inverse[n] @ inverse[n].T + sensitivity @ cameras @ sensitivity.T
        return out if self.reduced.common is None else self._with_common(index, inverse, out)

    def _with_common(self, index: IntArray, inverse: Array, out: Array) -> Array:
        """Return `out` where points share errors, which move with every camera."""
        structure, common, q = self.reduced.structure, self.reduced.common, self.num_unknowns
        assert common is not None
        place = {int(p): n for n, p in enumerate(common.index)}
        for n, p in enumerate(index):
            if int(p) not in place:
                continue
            shared = -inverse[n] @ la.solve_triangular(common.upper, common.cross[place[int(p)]].T, trans="T").T
            rows = structure.by_point[structure.point_bounds[p] : structure.point_bounds[p + 1]]
            sensitivity = -shared @ common.by_camera
            for k in rows:
                at = structure.view[k] * q
                sensitivity[:, at : at + q] -= inverse[n] @ self.reduced.cross[k]
            out[n] = inverse[n] @ inverse[n].T + shared @ shared.T + sensitivity @ self.solve(sensitivity.T)
        return out
