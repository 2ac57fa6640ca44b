"""Weights of observations: by the robust loss, stated standard deviations, and the observed noise.

The loss rho(s) is of a squared, normalised residual s = (|r| / scale)^2. The adjustment minimises sum scale^2 rho(s) by
reweighting: an observation's squared weight is rho'(s), so that the gradient of the weighted problem is the gradient
of the robust one.
"""

from __future__ import annotations

import numpy as np

from barpc.ba.constraints.ground import MAX_INDEPENDENT_ERRORS
from barpc.ba.robust.systematic_residuals import SPLINES
from barpc.ba.solving.problem import Problem
from barpc.base.geodesy import Array
from barpc.base.statistics import FEWEST, GROSS, OUTLIER
from barpc.scene import BoolArray

MEDIAN = 0.55  # median of a squared residual over its mean; 1 (two views) to 2 (many) degrees of freedom
_LARGEST_MISFIT = 3.0  # px: upper limit; a larger misfit would take all weight from the view that causes it
_LITTLE_NOISE = 0.04
"""Standard deviation of tie points [px] below which the noise floor is reduced in proportion to it.

A noise floor of 0.02 px is half of this. In real images it is a fifth of the standard deviation, which is 0.1 px.
"""


def geman_mcclure(s: Array) -> tuple[Array, Array]:
    """Return the loss of Geman and McClure, rho(s) = s / (1 + s), and its derivative."""
    return s / (1.0 + s), 1.0 / (1.0 + s) ** 2


class Observations:
    """Weights of observations: stated `sigma` (K,) [px], observed noise, and a limit on the information of a view.

    `is_tie` and `of_reference` (K,) are the masks of tie points and of reference points.
    """

    def __init__(
        self,
        problem: Problem,
        sigma: Array,
        noise_floor: float,
        is_tie: BoolArray,
        of_reference: BoolArray | None = None,
        told: Array | float = 0.0,
    ) -> None:
        self.structure, self.sigma, self.noise_floor = problem.structure, sigma, noise_floor
        self.is_tie = is_tie
        self.told = told  # (N,) information of the tie points of each view in an earlier block [1/px^2]
        waves = problem.cameras.unknowns.waves
        # number of parts of an image between spline knots: the common error of neighbours is another one in each
        self.stretches = 1.0 if waves is None else waves.stretches(2.0 * float(problem.cameras.unknowns.half[1].max()))
        self.has_prior = np.zeros(self.structure.num_points, dtype=bool)
        if problem.point_prior is not None:
            self.has_prior[problem.point_prior.index] = True
        self.of_reference = np.zeros_like(is_tie) if of_reference is None else of_reference
        # control points: the other observations with a prior on their points
        self.is_control = ~is_tie & ~self.of_reference & self.has_prior[self.structure.point]

    def is_spared(self, squared: Array) -> BoolArray:
        """Return the mask (K,) of observations that the robust loss does not reject: of control and reference points.

        Control points without a gross error are tested at the end. Reference points were tested before.
        """
        return np.asarray((self.is_control & (squared < GROSS**2)) | self.of_reference)

    def is_near(self, squared: Array, scale: float) -> BoolArray:
        """Return the mask (K,) of observations within `scale` standard deviations.

        `squared` (K,) are squared normalised residuals. Reference points always have the limit `OUTLIER`, control
        points the limit `GROSS`, if that is larger than `scale`.
        """
        near = np.where(self.of_reference, squared <= OUTLIER**2, squared <= scale * scale)
        return np.asarray(near | (self.is_control & (squared < GROSS**2)))

    def freedom(self, counted: Array) -> Array:
        """Return the degrees of freedom (K,) of observations after their points are estimated: 1/2 (two views) to 2.

        `counted` (K,) are robust weights, 0 to 1. An observation of weight 0 is not counted among those of its point.
        """
        structure = self.structure
        largest = np.zeros(structure.num_points)
        np.maximum.at(largest, structure.point, counted)
        count = structure.sum_points(counted[None])[0] / np.maximum(largest, 1e-300)
        rows = 2.0 * np.maximum(count, 1.0)
        free = np.where(self.has_prior, rows, np.maximum(rows - 3.0, 0.25))
        freedom: Array = (2.0 * free / rows)[structure.point]
        return freedom

    def mean_freedom(self, use: BoolArray) -> Array:
        """Return the mean of `freedom` over the observations in use of each view (N,); 2 where there are none."""
        counted = use.astype(np.float64)
        total, count = self.structure.sum_views(np.stack([counted * self.freedom(counted), counted])).T
        return np.where(count > 0, total / np.maximum(count, 1.0), 2.0)

    def squared(self, residual: Array, counted: Array) -> Array:
        """Return the squared residuals (K,), divided by their expectations from the stated sigmas."""
        s: Array = (residual**2).sum(axis=0) / self.sigma**2 / self.freedom(counted)
        return np.where(np.isfinite(s), s, np.inf)

    def weight(self, use: BoolArray, noise: float, misfit: Array | float = 0.0) -> Array:
        """Return the weights 1 / sigma (K,) [1/px]; 0 of observations not in use.

        The total weight of the tie points of a view is limited by two errors that they share. The standard deviation of
        the first is `noise_floor`, or less if the noise is low. The second is the `misfit` (N,) [px] of the camera
        model of the view, which counts as `SPLINES` independent errors.
        """
        weight: Array = use / (self.sigma * noise)
        own, ties = self._of_ties(weight), self._of_ties(use.astype(np.float64))
        information, noise_px = np.maximum(own, self.told), np.sqrt(ties / np.maximum(own, 1e-300))
        # at least a tenth of the noise floor, because copies of an image have no noise
        common = (self.noise_floor * np.clip(noise_px / _LITTLE_NOISE, 0.1, 1.0)) ** 2
        floor = common / self.stretches + np.minimum(misfit, _LARGEST_MISFIT) ** 2 / SPLINES
        cap = 1.0 / np.sqrt(np.maximum(information * floor, 1.0))
        count = self.structure.sum_views((use & self.of_reference).astype(np.float64)[None])[:, 0]
        reduction = np.sqrt(np.minimum(MAX_INDEPENDENT_ERRORS / np.maximum(count, 1.0), 1.0))
        weight = np.where(self.of_reference, use / self.sigma * reduction[self.structure.view], weight)
        return np.where(self.is_tie, weight * cap[self.structure.view], weight)

    def tie_information(self, weight: Array) -> Array:
        """Return the information (N,) of the tie points of each view [1/px^2], at least that of an earlier block."""
        return np.maximum(self._of_ties(weight), self.told)

    def _of_ties(self, weight: Array) -> Array:
        """Return the sums (N,) of the squared weights of the tie points of each view."""
        return np.asarray(self.structure.sum_views((weight * self.is_tie)[None] ** 2)[:, 0])

    def noise(self, residual: Array, use: BoolArray, problem: Problem, fitted: int) -> float:
        """Estimate the observed over stated standard deviation of tie points in use; 1 if they are too few.

        `fitted` is the number of other parameters that were fitted to the residuals.
        """
        use = use & ~self.is_control & ~self.of_reference
        whitened = residual[:, use] / self.sigma[use]
        seen = np.zeros(self.structure.num_points, dtype=bool)
        seen[self.structure.point[use]] = True
        freedom = whitened.size - 3 * int((seen & ~self.has_prior).sum()) - int(problem.free.sum()) - fitted
        if freedom < FEWEST:
            return 1.0
        return max(float(np.sqrt((whitened**2).sum() / freedom)), 1e-6)

    def tied(self, use: BoolArray) -> BoolArray:
        """Return the mask `use` (K,) without points that have one observation and no prior."""
        structure = self.structure
        count = np.bincount(structure.point[use], minlength=structure.num_points)
        return use & ((count >= 2) | self.has_prior)[structure.point]
