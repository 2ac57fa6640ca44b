"""Priors on cameras and points: residuals divided by standard deviations, linear in the unknowns.

The residuals of tie-point observations, which are not linear, are in `barpc.ba.solving.problem`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from barpc.ba.parameters.additional_parameters import FIRST_SIGMA, AdditionalParameters
from barpc.base.geodesy import Array
from barpc.base.options import AdjustOptions
from barpc.scene import BoolArray, IntArray, View
from barpc.sensor.pushbroom import Pushbroom
from barpc.sensor.radar import Radar
from barpc.sensor.rpc import RPC

DEFAULT_ACCURACY = 7.5  # m, for rotation and translation each (10.6 m together): that of less accurate delivered RPCs
DRIFT_SIGMA = 0.2  # m, at the first and last row of a view: 0.3 microradian at 700 km, typical of good platforms
USABLE_ACCURACY = 0.1  # m: smaller values (as in Airbus RPCs) state the error of the RPC fit, not of geolocation
ALIKE_SIGMA = 0.01  # px: sigma of the differences of a detector step between images of a pass (0.1 micrometres)
IMAGE_MODEL_SIGMA = 20.0  # px at the edge of the image: prior sigma of each coefficient of image models

NOISE_FLOOR = AdjustOptions().noise_floor
"""Error [px] common to all tie points of a view: no camera is more accurate, and smaller residuals are tolerated."""


@dataclass(frozen=True)
class CameraPrior:
    """Independent normal priors on camera unknowns, with a larger sigma for rotations about the lines of sight.

    A stated accuracy is that of the middle of the image, and such a rotation does not move the middle.
    """

    mean: Array  # (N, q) of the unknowns of each view
    sigma: Array  # (N, q) standard deviations
    sight: Array | None = None  # (N, q) unit vectors of rotations about the line of sight; zeros: no rotation
    wider: Array | float = 1.0  # (N, 1) factor on the standard deviation of that rotation

    @property
    def turn(self) -> Array:
        """Unit vectors (N, q) of rotations about the lines of sight; zeros without rotations."""
        return np.zeros_like(self.sigma) if self.sight is None else self.sight

    def residual(self, params: Array) -> Array:
        """Return the whitened residuals (N, q) of unknowns (N, q)."""
        return self.whitened(params - self.mean)

    def whitened(self, values: Array) -> Array:
        """Return changes of unknowns (N, q) or (N, q, m), whitened: divided by their standard deviations."""
        flat = values.reshape(*self.sigma.shape, -1) / self.sigma[..., None]
        if np.any(self.wider != 1.0):
            flat -= ((1.0 - 1.0 / self.wider) * self.turn)[..., None] * (self.turn[:, None] @ flat)
        return flat.reshape(values.shape)

    def loosest(self) -> Array:
        """Return the standard deviations (N, q) of an uncorrelated prior, at least as wide in every direction."""
        return np.where(self.turn != 0.0, self.wider, 1.0) * self.sigma

    def precision(self) -> Array:
        """Return the information matrices (N, q, q)."""
        root = self.whitened(np.broadcast_to(np.eye(self.sigma.shape[1]), (*self.sigma.shape, self.sigma.shape[1])))
        return np.swapaxes(root, 1, 2) @ root


@dataclass(frozen=True, eq=False)
class EarlierScene:
    """Dependence of the scene's motions (`barpc.ba.constraints.gauge.MOTIONS`) on the cameras of an earlier block."""

    by_unknown: Array  # (10, n) derivatives of the motions by the camera unknowns
    own: Array  # (10, 10) covariance of the motions with the cameras fixed [m^2]
    radius: float  # distance at which tilts, rotation and scale are measured [m]


@dataclass(frozen=True)
class JointPrior:
    """A correlated prior on unknowns p of several views, of cost d' information d + 2 slope d, where d = p - mean.

    The information of observations that are adjusted again is subtracted; the rest may not be positive definite.
    """

    index: IntArray  # (n,) indices of the unknowns in the raveled (N, q) array
    mean: Array  # (n,) their prior mean
    information: Array  # (n, n)
    scene: EarlierScene | None = None  # motions of the scene of the earlier block
    told: Array | float = 0.0  # (N,) information of earlier tie points on each view [1/px^2]
    shown: Array | None = None  # sums over earlier corrections, for the camera priors (`Variances.shown`)
    slope: Array | float = 0.0  # (n,) half the gradient of the cost at the mean
    earlier: bool = True  # whether it comes from an earlier block

    @classmethod
    def of_alike(cls, waves: AdditionalParameters, views: int, size: int) -> JointPrior | None:
        """Return the prior, of `ALIKE_SIGMA`, that a part common to all images has one displacement; None: no part.

        There are `views` views of `size` unknowns each; the last of these are those of `waves`.
        """
        if not len(waves.alike):
            return None
        first = size - waves.size + waves.kinds[2].start
        own = first + np.concatenate([waves.alike, waves.alike + waves.steps.shape[1]])
        of_view = np.zeros(size)
        of_view[own] = ALIKE_SIGMA**-2.0
        information = np.asarray(np.kron(np.eye(views) - 1.0 / views, np.diag(of_view)), np.float64)
        return cls(np.arange(views * size), np.zeros(views * size), information, earlier=False)

    @classmethod
    def of_values(cls, index: IntArray, values: Array, shape: tuple[int, ...]) -> JointPrior:
        """Return the prior that unknowns `index` (m,) of the raveled `shape` are `values` (m,), sigma `ALIKE_SIGMA`."""
        size, mean_and_information = int(np.prod(shape)), np.zeros((2, int(np.prod(shape))))
        mean_and_information[0, index], mean_and_information[1, index] = values, ALIKE_SIGMA**-2.0
        return cls(np.arange(size), mean_and_information[0], np.diag(mean_and_information[1]), earlier=False)

    def gradient(self, params: Array) -> Array:
        """Return half the gradient (n,) of the cost by the unknowns `index`, at unknowns (N, q)."""
        return self.information @ (params.ravel()[self.index] - self.mean) + self.slope

    def cost(self, params: Array) -> float:
        """Return the cost (see the class) of unknowns (N, q)."""
        return float((params.ravel()[self.index] - self.mean) @ (self.gradient(params) + self.slope))

    def without(self, information: Array, gradient: Array, params: Array) -> JointPrior:
        """Return the prior less the information (n, n), and gradient (n,) at `params`, of some observations."""
        slope = information @ (params.ravel()[self.index] - self.mean) - gradient
        return replace(self, information=self.information - information, slope=self.slope + slope)


@dataclass(frozen=True)
class PointPrior:
    """Priors on points X with common errors b: residuals rows (X - mean) - common b, with b standard normal.

    The errors b are eliminated, so they are no unknowns of the adjustment. Their estimate is `offset`.
    """

    index: IntArray  # (Q,) distinct points
    mean: Array  # (Q, 3) ECEF [m]
    rows: Array  # (Q, 3, 3) whitening matrices [1/m]; rows of zeros: no constraint
    common: Array  # (Q, 3, m) effect of one sigma of each common error on the whitened residuals

    def offset(self, points: Array) -> Array:
        """Estimate the common errors (m,) from points (P, 3) [m], in units of their standard deviations."""
        whitened = self.apart(points)
        return np.linalg.solve(self.information(), np.einsum("qim,qi->m", self.common, whitened))

    def residual(self, points: Array) -> Array:
        """Return the whitened residuals (Q, 3) of points (P, 3) [m], after subtraction of the common errors."""
        return self.apart(points) - self.common @ self.offset(points)

    def cost(self, points: Array) -> float:
        """Return the sum of squared residuals, and of squared common errors."""
        return float((self.residual(points) ** 2).sum() + (self.offset(points) ** 2).sum())

    def information(self) -> Array:
        """Return the information (m, m) on the common errors, with the points fixed."""
        information: Array = np.einsum("qim,qin->mn", self.common, self.common)
        information += np.eye(len(information))
        return information

    def select(self, keep: BoolArray) -> PointPrior:
        """Return the prior on some of its rows (Q,)."""
        return PointPrior(self.index[keep], self.mean[keep], self.rows[keep], self.common[keep])

    def apart(self, points: Array) -> Array:
        """Return the whitened residuals (Q, 3) of points (P, 3) [m], before subtraction of the common errors."""
        return (self.rows @ (points[self.index] - self.mean)[..., None])[..., 0]

    def jacobian(self) -> Array:
        """Return the derivatives (Q, 3, 3) by the points `index` [1/m]."""
        return self.rows


def stated_accuracy(view: View) -> float:
    """Return the horizontal accuracy of a delivered view [m]: that stated in its RPC if usable, else 7.5 m."""
    stated = view.sensor.err_bias if isinstance(view.sensor, RPC) else None
    return stated if stated is not None and states_accuracy(view) else DEFAULT_ACCURACY


def states_accuracy(view: View) -> bool:
    """Return whether a view's RPC states a usable accuracy."""
    stated = view.sensor.err_bias if isinstance(view.sensor, RPC) else None
    return stated is not None and stated > USABLE_ACCURACY


def is_stated(view: View, options: AdjustOptions) -> bool:
    """Return whether options, a file or radar metadata state the accuracy of a view; else it is the default."""
    given = options.sigma_attitude is not None or options.sigma_position is not None
    of_model = isinstance(view.sensor, Pushbroom | Radar) and view.sensor.accuracy is not None
    return given or of_model or states_accuracy(view)


def _stated_accuracy(view: View) -> tuple[float, float]:
    """Return the stated accuracies [m] of a view's attitude (on the ground) and position."""
    sensor = view.sensor
    if isinstance(sensor, Radar) and sensor.accuracy is not None:
        return (max(*sensor.accuracy, USABLE_ACCURACY),) * 2
    if isinstance(sensor, Pushbroom) and sensor.accuracy is not None:
        attitude, position = sensor.accuracy
        return max(attitude, USABLE_ACCURACY), max(position, USABLE_ACCURACY)
    return (stated_accuracy(view),) * 2


def prior_sigmas(views: tuple[View, ...], options: AdjustOptions, drift: int, off: Array | None, waves: int) -> Array:
    """Return the prior standard deviations (N, q) of every view's unknowns, in the unknowns' units (m or px).

    `off` (N,) [m] are measured offsets of the views. Where larger than the stated accuracy, they replace it. `waves`
    is the number of additional parameters of a view.
    """
    stated = np.array([_stated_accuracy(view) for view in views])
    if off is not None:
        stated = np.fmax(stated, off[:, None])
    parts, count = [], len(views)
    given = (("rotation", options.sigma_attitude), ("translation", options.sigma_position))
    for (name, sigma), own in zip(given, stated.T, strict=True):
        if name in options.first_model:
            of_views = own if sigma is None else np.full(count, sigma)
            parts.append(np.tile(of_views[:, None], (1, 3)))
    if not parts:
        size = {"shift": 2, "shift-drift": 4, "affine": 6}[options.first_model]
        return np.hstack([np.full((count, size), IMAGE_MODEL_SIGMA), np.full((count, waves), FIRST_SIGMA)])
    parts += [np.full((count, 3), DRIFT_SIGMA)] * drift
    parts.append(np.full((count, waves), FIRST_SIGMA))
    return np.hstack(parts)
