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

_DENSE_UNKNOWNS = 900  # most unknowns for which the whole covariance matrix is computed


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Response of an adjustment to k errors shared by several images: changes per standard deviation of each error."""

    by_unknown: Array  # (N q, k) changes of the unknowns
    of_points: Callable[[IntArray], Array]  # displacements (n, 3, k) [m], ECEF, of points (n,), fixed cameras


@dataclass(frozen=True, eq=False)
class Covariance:
    """Posterior covariance of an adjustment, computed on request from the factorised normal matrix."""

    reduced: Reduced  # the problem linearised at its solution
    factor: Factor  # of its reduced matrix S, free unknowns only
    free: BoolArray  # (N q,) unknowns that are not fixed
    shared: SharedErrors | None = None  # errors shared by several images; None: there are none

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
        """The covariance without the errors shared by images."""
        return self if self.shared is None else replace(self, shared=None)

    @property
    def is_large(self) -> bool:
        """Whether exact variances are slow: they take as long as two factorisations."""
        return len(self.free) > _DENSE_UNKNOWNS

    def variances(self) -> Array:
        """Return the variances (N, q) of all unknowns; zero for fixed ones."""
        if self.factor.inverse is None:
            return self.full.diagonal().reshape(-1, self.num_unknowns)
        return np.asarray(self.of_views().diagonal(axis1=1, axis2=2))

    def of_views(self) -> Array:
        """Return the covariances (N, q, q) of every view's unknowns."""
        if self.factor.inverse is not None:
            return self._sparse.diagonal if self.shared is None else self._sparse.diagonal + self._shared_part()
        q, every = self.num_unknowns, np.arange(len(self.free) // self.num_unknowns)
        return np.asarray(self.full.reshape(-1, q, len(every), q)[every, :, every])

    def probed_views(self) -> Array:
        """Estimate the covariances (N, q, q) of every view's unknowns by random probes (Hutchinson 1990).

        This costs a few solutions; the relative error of a variance is a quarter (RMS). Each unknown is scaled by its
        standard deviation with all other views fixed. Otherwise the noise of the probes, which grows with the largest
        variances, would exceed the small ones.
        """
        q = self.num_unknowns
        views, scale = np.flatnonzero(self.free[::q]), np.ones((len(self.free) // q, q))
        scale[views] = np.sqrt(np.linalg.inv(self.reduced.of_views()[views]).diagonal(axis1=1, axis2=2))
        random = np.random.default_rng(scale.size).integers(0, 2, (scale.size, FEW))
        probes = np.where(random > 0, 1.0, -1.0)
        solved = self.solve(probes / scale.reshape(-1, 1)).reshape(*scale.shape, FEW)
        estimate = solved @ np.swapaxes(probes.reshape(*scale.shape, FEW), 1, 2) / FEW * scale[:, None]
        return np.asarray(0.5 * (estimate + np.swapaxes(estimate, 1, 2)))

    def view(self, i: int, j: int | None = None) -> Array:
        """Return the covariance (q, q) of the unknowns of view i, or between those of views i and j."""
        return self._of_pair(i, i if j is None else j, "full" in self.__dict__)

    def joint(self, views: IntArray) -> Array:
        """Return the covariance (m q, m q) of the unknowns of some views."""
        of_full = not self.is_large or "full" in self.__dict__
        if of_full or self.factor.inverse is None:
            place = unknowns_of(views, self.num_unknowns)
            return self.columns(place, of_full)[place]
        return np.block([[self._of_pair(int(i), int(j), False) for j in views] for i in views])

    def _of_pair(self, i: int, j: int, of_full: bool) -> Array:
        """Return the covariance (q, q) of views i and j; all pairs that share points are computed together."""
        if self.factor.inverse is not None and not of_full:
            more = 0.0 if self.shared is None else self._shared_part(i) @ self._shared_part(j).T
            if i == j:
                return np.asarray(self._sparse.diagonal[i] + more)
            if (at := self._sparse.pair(min(i, j), max(i, j))) is not None:
                return np.asarray((self._sparse.pairs[at] if i < j else self._sparse.pairs[at].T) + more)
        own, other = (unknowns_of(np.array([view]), self.num_unknowns) for view in (i, j))
        return self.columns(other, of_full)[own]

    def _shared_part(self, view: int | None = None) -> Array:
        """Return the response (q, k) of a view to the shared errors; without a view, covariances (N, q, q)."""
        assert self.shared is not None
        rows = self.shared.by_unknown.reshape(-1, self.num_unknowns, self.shared.by_unknown.shape[1])
        return np.asarray(rows @ np.swapaxes(rows, 1, 2) if view is None else rows[view])

    @cached_property
    def _sparse(self) -> Blocks:
        """The covariance of every view and of every pair that shares points, without shared errors."""
        assert self.factor.inverse is not None
        return self.factor.inverse()

    def columns(self, place: IntArray, of_full: bool = False) -> Array:
        """Return the covariance (N q, m) between all unknowns and those at the indices `place` (m,)."""
        if of_full:
            return self.full[:, place]
        unit = np.zeros((len(self.free), len(place)))
        unit[place, np.arange(len(place))] = 1.0
        return self.solve(unit)

    @cached_property
    def full(self) -> Array:
        """Covariance (N q, N q) of all unknowns; its size limits it to some hundred views."""
        out = np.zeros((len(self.free), len(self.free)))
        if self.factor.whole_inverse is not None:
            out[np.ix_(self.free, self.free)] = self.factor.whole_inverse()
            return out if self.shared is None else out + self.shared.by_unknown @ self.shared.by_unknown.T
        every = np.arange(len(self.free))
        for part in parts(len(every), max(KEPT // len(every), 1)):
            out[:, part] = self.columns(every[part])
        return 0.5 * (out + out.T)

    def shared_moves(self, index: IntArray) -> Array:
        """Return the displacements (n, 3, k) [m], ECEF, of points `index` (n,) by one sigma of each shared error."""
        assert self.shared is not None
        by_unknown = self.shared.by_unknown.reshape(-1, self.num_unknowns, self.shared.by_unknown.shape[1])
        return np.asarray(self.reduced.carried(by_unknown, index) + self.shared.of_points(index))

    def points(self, index: IntArray) -> Array:
        """Return the covariance (n, 3, 3) [m^2], ECEF, of the points `index` (n,), by noise and by the cameras."""
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
        """Return `out` (n, 3, 3), recomputed for points with errors in common, which depend on every camera."""
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
