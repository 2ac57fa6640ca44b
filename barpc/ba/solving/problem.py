"""The adjustment as a problem: observations and priors linearised together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from barpc.ba.parameters.priors import CameraPrior, JointPrior, PointPrior
from barpc.ba.parameters.projected import Cameras, Projected
from barpc.ba.solving.normal import (
    TRIANGLE,
    Reduced,
    cholesky3,
    point_products,
    reduce_normal,
    solve_lower,
    solve_transposed,
    whiten,
)
from barpc.ba.solving.structure import Structure
from barpc.base.geodesy import Array
from barpc.base.statistics import KEPT
from barpc.scene import BoolArray


@dataclass(frozen=True)
class Problem:
    """Observations, cameras and priors of an adjustment; observations are sorted by view."""

    cameras: Cameras  # N views with q unknowns each
    structure: Structure  # which view sees which point
    xy: Array  # (2, K) observed col, row [px]
    camera_prior: CameraPrior  # on the unknowns of single views
    free: BoolArray  # (N q,) false for the unknowns of fixed views
    joint_prior: JointPrior | None = None  # on several views together
    point_prior: PointPrior | None = None  # GCPs and heights; may have errors in common
    _room: list[Projected] = field(default_factory=list, repr=False)  # reused by `linearise`

    def residuals(self, params: Array, points: Array) -> Array:
        """Return the residuals, projected - observed (2, K) [px], sorted by view."""
        structure = self.structure
        ecef = structure.of_points(points)
        return self.cameras.project(params, ecef, structure.bounds, "image").image - self.xy

    def prior_cost(self, params: Array, points: Array) -> float:
        """Return the sum of the squared residuals of all priors."""
        cost = float((self.camera_prior.residual(params) ** 2).sum())
        if self.joint_prior is not None:
            cost += self.joint_prior.cost(params)
        return cost if self.point_prior is None else cost + self.point_prior.cost(points)

    def cost(self, params: Array, points: Array, whitened: Array) -> float:
        """Return the sum of squares of whitened residuals (2, K) and of the residuals of all priors."""
        flat = whitened.ravel()
        return float(flat @ flat) + self.prior_cost(params, points)

    def linearise(self, params: Array, points: Array) -> Projected:
        """Project all points with derivatives, for `reduce`; the next call may overwrite the result."""
        structure, out = self.structure, None
        if self.xy.shape[1] <= KEPT:
            if not self._room:
                self._room.append(self.cameras.room(self.xy.shape[1]))
            out = self._room[0]
        return self.cameras.project(params, structure.of_points(points), structure.bounds, out=out)

    def prepare(self, params: Array, points: Array) -> tuple[Array, Projected | None]:
        """Return the residuals (2, K) [px], and the result of `linearise` (None: more than `KEPT` observations)."""
        if self.xy.shape[1] > KEPT:
            return self.residuals(params, points), None
        projected = self.linearise(params, points)
        return projected.image - self.xy, projected

    def reduce(self, params: Array, points: Array, weight: Array, projected: Projected | None = None) -> Reduced:
        """Linearise at a state and eliminate the points.

        `weight` (K,) is 1 / sigma of every observation [1/px], 0 for a rejected one. `projected` is the result of
        `linearise` at this state; it is overwritten.
        """
        structure = self.structure
        projected = self.linearise(params, points) if projected is None else projected
        residual = (projected.image - self.xy) * weight
        by_point, by_unknown = projected.by_point, projected.by_unknown
        by_point *= weight
        by_unknown *= weight
        precision = self.camera_prior.precision()
        reduced = reduce_normal(
            structure,
            residual,
            by_point,
            by_unknown,
            *self.point_terms(points),
            precision,
            (precision @ (params - self.camera_prior.mean)[..., None])[..., 0],
            self.point_prior,
        )
        reduced = replace(reduced, cost=reduced.cost + self.prior_cost(params, points))
        return self._add_joint(reduced, params)

    def project_points(self, params: Array, points: Array) -> Projected:
        """Return the image points and their derivatives by the ground points, for `triangulate`."""
        structure = self.structure
        return self.cameras.project(params, structure.of_points(points), structure.bounds, "points")

    def triangulate(self, points: Array, projected: Projected, weight: Array) -> Array:
        """Return all points (P, 3) [m] after one Gauss-Newton step with fixed cameras."""
        matrix, gradient = self.point_terms(points)
        sums = self.structure.sum_points(point_products(projected.by_point, projected.image - self.xy, weight))
        lower = cholesky3(sums[:6] + matrix)
        step = solve_transposed(lower, solve_lower(lower, sums[6:] + gradient))
        return points - step.T

    def projected_off_points(self, projected: Projected, weight: Array) -> Callable[[Array], Array]:
        """Return a function of residuals (2, K) [px] that subtracts the part the points can absorb, to first order."""
        structure, by_point = self.structure, projected.by_point
        sums = structure.sum_points(point_products(by_point * weight, np.zeros_like(projected.image))[:6])
        whitened = whiten(by_point, cholesky3(sums).take(structure.point, axis=1))
        counted = whitened * weight**2

        def off_points(residual: Array) -> Array:
            half = structure.sum_points(counted[0] * residual[0] + counted[1] * residual[1])
            absorbed: Array = (whitened * half.take(structure.point, axis=1)).sum(axis=1)
            return residual - absorbed

        return off_points

    def point_terms(self, points: Array) -> tuple[Array, Array]:
        """Return the point prior's part of the normal matrices (6, P) and gradients (3, P) of the points."""
        matrix, gradient = np.zeros((6, len(points))), np.zeros((3, len(points)))
        prior = self.point_prior
        if prior is not None:
            rows = prior.jacobian()
            information = rows.transpose(0, 2, 1) @ rows
            for n, (i, j) in enumerate(TRIANGLE):
                matrix[n, prior.index] = information[:, i, j]
            gradient[:, prior.index] = np.einsum("qij,qi->jq", rows, prior.residual(points))
        return matrix, gradient

    def _add_joint(self, reduced: Reduced, params: Array) -> Reduced:
        prior = self.joint_prior
        if prior is None:
            return reduced
        gradient = reduced.gradient.copy()
        gradient[prior.index] += prior.gradient(params)
        return replace(reduced, matrix=reduced.with_joint(prior.index, prior.information), gradient=gradient)

    def counted_once(self, params: Array, points: Array, weight: Array) -> Problem:
        """Return the problem whose joint prior lacks the information of the observations with `weight` (K,) [1/px].

        The prior contains them already: they would count twice. Other observations of the same tie points still add
        the information that they have given these. The same holds for observations that the prior does not contain.
        """
        prior = self.joint_prior
        assert prior is not None
        no_prior = CameraPrior(self.camera_prior.mean, np.full_like(self.camera_prior.sigma, np.inf))
        contained = replace(self, camera_prior=no_prior, joint_prior=None, _room=[]).reduce(params, points, weight)
        matrix = contained.plain(np.ones(len(self.free), dtype=bool))[np.ix_(prior.index, prior.index)]
        return replace(self, joint_prior=prior.without(matrix, contained.gradient[prior.index], params))
