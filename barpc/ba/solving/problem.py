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
    """Observations sorted by view, cameras, priors."""

    cameras: Cameras  # N views with q unknowns each
    structure: Structure  # who sees what
    xy: Array  # (2, K) observed col, row [px]
    camera_prior: CameraPrior  # on every view's unknowns
    free: BoolArray  # (N q,) false for the unknowns of fixed views
    joint_prior: JointPrior | None = None  # on several views together
    point_prior: PointPrior | None = None  # GCPs and heights
    _room: list[Projected] = field(default_factory=list, repr=False)

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
        """Return the whole sum of squares, of whitened residuals (2, K) and the priors'."""
        flat = whitened.ravel()
        return float(flat @ flat) + self.prior_cost(params, points)

    def linearise(self, params: Array, points: Array) -> Projected:
        """Project all points with derivatives, for `reduce`; the next call may write over them."""
        structure, out = self.structure, None
        if self.xy.shape[1] <= KEPT:
            if not self._room:
                self._room.append(self.cameras.room(self.xy.shape[1]))
            out = self._room[0]
        return self.cameras.project(params, structure.of_points(points), structure.bounds, out=out)

    def prepare(self, params: Array, points: Array) -> tuple[Array, Projected | None]:
        """Return the residuals (2, K) [px], and the result of `linearise` unless it is too large for `reduce`."""
        if self.xy.shape[1] > KEPT:
            return self.residuals(params, points), None
        projected = self.linearise(params, points)
        return projected.image - self.xy, projected

    def reduce(self, params: Array, points: Array, weight: Array, projected: Projected | None = None) -> Reduced:
        """Linearise at a state and eliminate the points.

        `weight` (K,) is 1 / sigma of every observation [1/px], 0 for one that does not count; `projected` is
        `linearise` of this state, and is used up.
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
        """Return the image points and their derivative by the points, for `triangulate`."""
        structure = self.structure
        return self.cameras.project(params, structure.of_points(points), structure.bounds, "points")

    def triangulate(self, points: Array, projected: Projected, weight: Array) -> Array:
        """Move all points (P, 3) [m] by one Gauss-Newton step with the cameras held."""
        matrix, gradient = self.point_terms(points)
        sums = self.structure.sum_points(point_products(projected.by_point, projected.image - self.xy, weight))
        lower = cholesky3(sums[:6] + matrix)
        step = solve_transposed(lower, solve_lower(lower, sums[6:] + gradient))
        return points - step.T

    def projected_off_points(self, projected: Projected, weight: Array) -> Callable[[Array], Array]:
        """Return a function that takes residuals (2, K) [px] to those after the points have settled, to first order."""
        structure, by_point = self.structure, projected.by_point
        sums = structure.sum_points(point_products(by_point * weight, np.zeros_like(projected.image))[:6])
        whitened = whiten(by_point, cholesky3(sums).take(structure.point, axis=1))
        counted = whitened * weight**2

        def settled(residual: Array) -> Array:
            half = structure.sum_points(counted[0] * residual[0] + counted[1] * residual[1])
            moved: Array = (whitened * half.take(structure.point, axis=1)).sum(axis=1)
            return residual - moved

        return settled

    def point_terms(self, points: Array) -> tuple[Array, Array]:
        """Return the priors' part of the points' normal matrices (6, P) and gradients (3, P)."""
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
        """Return the problem with the joint prior without observations that it knows already, of `weight` (K,) [1/px].

        These keep the information of their tie points with others: the cost of the others given them. That holds
        for observations that the prior was not learnt from, too.
        """
        prior = self.joint_prior
        assert prior is not None
        nothing = CameraPrior(self.camera_prior.mean, np.full_like(self.camera_prior.sigma, np.inf))
        known = replace(self, camera_prior=nothing, joint_prior=None, _room=[]).reduce(params, points, weight)
        matrix = known.plain(np.ones(len(self.free), dtype=bool))[np.ix_(prior.index, prior.index)]
        return replace(self, joint_prior=prior.without(matrix, known.gradient[prior.index], params))
