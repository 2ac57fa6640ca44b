"""What the adjustment may be told: one frozen record, every field with its unit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from barpc.ba.loss import LOSSES
from barpc.errors import InputError
from barpc.geodesy import Array
from barpc.scene import View
from barpc.sensor.rpc import RPC

AUTO, GEOMETRIC = "auto", "rotation+translation"

MODELS = (AUTO, GEOMETRIC, "rotation", "translation", "shift", "shift-drift", "affine")
"""Unknowns of a view; the last three act in the image. "auto": a rotation and translation; an affine in the
image where that leaves a trend which the affine takes away."""

DEFAULT_ACCURACY = 5.0
"""Horizontal standard deviation [m] of a camera that does not state its own (Pleiades: CE90 8.5 m = 4 m)."""

DRIFT_SIGMA = 0.2
"""Drift of a view at its first and last row [m]: 0.3 microradian from 700 km, as good platforms have it."""

USABLE_ACCURACY = 0.1
"""Stated accuracies below this [m] are pixels of a fit (as Airbus states them), not metres of geolocation."""


@dataclass(frozen=True)
class AdjustOptions:
    """How the adjustment runs.

    Parameters
    ----------
    model : str
        Unknowns of each view, one of `MODELS`.
    drift : int or None
        Degree of the rotation as a polynomial of the image row: 0 constant, 1 or 2. None: 1 for models with a
        rotation, and 2 where the residuals of 1 ask for it.
    sigma_attitude : float or None
        Prior standard deviation of the rotation, metres on the ground (angle x distance). None: the
        accuracy that the RPC states where it is usable, else 5 m.
    sigma_position : float or None
        Prior standard deviation of the translation [m] an axis. None: as for the attitude.
    sigma_drift : float or None
        Prior standard deviation of the drift at the first and last row, metres on the ground. None: learnt
        from the block, `DRIFT_SIGMA` counting as a few observations of it.
    learn_priors : bool
        Widen the priors of rotation and translation where the corrections contradict them, of all views or
        of an odd one, and learn the drift's.
    sigma_shift : float
        Image models: prior standard deviation of every coefficient at the edge of the image [px].
    noise_floor : float
        Part of a view's tie-point errors that does not average away [px]: however many observations a
        view has, their information together is at most 1 / noise_floor^2. 0 for independent errors.
    loss : str
        Robust loss of the first rounds, a key of `barpc.ba.loss.LOSSES`; "linear" skips them.
    robust_threshold : float
        Observations beyond so many standard deviations are cut after the robust rounds.
    num_passes : int
        At most so many rounds of cutting and solving; it stops when nothing changes.
    estimate_noise : bool
        Scale the observations' sigmas by what the residuals show.
    fixed : tuple of str
        Views that keep the camera they came with.
    view_weights : mapping of str to float
        Relative weight of a view's observations (1 where absent): their sigmas are divided by it.
    dem_sigma : float
        Standard deviation of single heights of the DEM [m].
    dem_bias_sigma : float
        Standard deviation of what all of its heights are wrong by together (a geoid left out: 20 m and more),
        and of its slopes at the scene's edges [m].
    dem_for_all : bool
        Hold every track to the DEM; otherwise only those seen under too small an angle.
    min_convergence : float
        Tracks whose rays meet under a smaller angle [deg] are held in height.
    min_observations : int
        A view with fewer observations stops the run.
    hold_out : bool
        Keep a tenth of the tracks out, to measure the result on.
    keep_largest : bool
        Go on with the largest group of views where they are not all connected.
    solver : str
        "auto", "scipy" (least_squares on the compressed problem) or "sparse" (Levenberg-Marquardt).
    max_steps : int
        Steps of one solve.
    tolerance : float
        A solve ends when a step would lower the cost by less than this fraction.
    center_method : str
        Camera centre: "line" or "projective" (see `barpc.sensor.geometry.camera_center`).
    """

    model: str = AUTO
    drift: int | None = None
    sigma_attitude: float | None = None
    sigma_position: float | None = None
    sigma_drift: float | None = None
    learn_priors: bool = True
    sigma_shift: float = 20.0
    noise_floor: float = 0.02
    loss: str = "geman_mcclure"
    robust_threshold: float = 4.0
    num_passes: int = 5
    estimate_noise: bool = True
    fixed: tuple[str, ...] = ()
    view_weights: Mapping[str, float] = field(default_factory=dict)
    dem_sigma: float = 10.0
    dem_bias_sigma: float = 20.0
    dem_for_all: bool = False
    min_convergence: float = 1.0
    min_observations: int = 4
    hold_out: bool = True
    keep_largest: bool = False
    solver: str = "auto"
    max_steps: int = 30
    tolerance: float = 1e-6
    center_method: str = "line"

    def __post_init__(self) -> None:
        _one_of("model", self.model, MODELS)
        _one_of("loss", self.loss, tuple(LOSSES))
        _one_of("solver", self.solver, ("auto", "scipy", "sparse"))
        _one_of("drift", self.drift, (None, 0, 1, 2))
        if self.drift and "rotation" not in self.first_model:
            raise InputError(f"drift {self.drift} needs a model with a rotation, not {self.model!r}")
        for name in (
            "sigma_attitude",
            "sigma_position",
            "sigma_drift",
            "sigma_shift",
            "dem_sigma",
            "dem_bias_sigma",
        ):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"{name} must be positive, found {value}")

    @property
    def first_model(self) -> str:
        """The model to start with."""
        return GEOMETRIC if self.model == AUTO else self.model


def _one_of(name: str, value: object, allowed: tuple[object, ...]) -> None:
    if value not in allowed:
        raise InputError(f"{name} {value!r} is not one of {', '.join(map(str, allowed))}")


def stated_accuracy(view: View) -> float:
    """Horizontal accuracy of a view as delivered [m]: what its RPC states where usable, else 5 m."""
    stated = view.sensor.err_bias if isinstance(view.sensor, RPC) else None
    return stated if stated is not None and stated > USABLE_ACCURACY else DEFAULT_ACCURACY


def prior_sigmas(views: tuple[View, ...], options: AdjustOptions, drift: int) -> Array:
    """Prior standard deviations (N, q) of every view's unknowns, in the unknowns' units (m or px)."""
    stated = np.array([stated_accuracy(view) for view in views])
    parts = []
    if "rotation" in options.first_model:
        parts.append(np.tile(_given(options.sigma_attitude, stated), (1, 3)))
    if "translation" in options.first_model:
        parts.append(np.tile(_given(options.sigma_position, stated), (1, 3)))
    parts += [np.full((len(views), 3), options.sigma_drift or DRIFT_SIGMA)] * drift
    if not parts:
        size = {"shift": 2, "shift-drift": 4, "affine": 6}[options.first_model]
        parts.append(np.full((len(views), size), options.sigma_shift))
    return np.hstack(parts)


def _given(value: float | None, stated: Array) -> Array:
    return stated[:, None] if value is None else np.full((len(stated), 1), value)
