"""What is expected of the cameras' corrections before any is known."""

from __future__ import annotations

import numpy as np

from barpc.geodesy import Array
from barpc.options import AdjustOptions
from barpc.scene import View
from barpc.sensor.rpc import RPC

DEFAULT_ACCURACY = 5.0
"""Horizontal standard deviation [m] of a camera that does not state its own (Pleiades: CE90 8.5 m = 4 m)."""

DRIFT_SIGMA = 0.2
"""Drift of a view at its first and last row [m]: 0.3 microradian from 700 km, as good platforms have it."""

USABLE_ACCURACY = 0.1
"""Stated accuracies below this [m] are pixels of a fit (as Airbus states them), not metres of geolocation."""

IMAGE_SIGMA = 20.0
"""Models in the image: prior standard deviation of every coefficient, at the edge of the image [px]."""


def stated_accuracy(view: View) -> float:
    """Horizontal accuracy of a view as delivered [m]: what its RPC states where usable, else 5 m."""
    stated = view.sensor.err_bias if isinstance(view.sensor, RPC) else None
    return stated if stated is not None and stated > USABLE_ACCURACY else DEFAULT_ACCURACY


def prior_sigmas(views: tuple[View, ...], options: AdjustOptions, drift: int) -> Array:
    """Prior standard deviations (N, q) of every view's unknowns, in the unknowns' units (m or px)."""
    stated = np.array([stated_accuracy(view) for view in views])
    parts = []
    if "rotation" in options.model:
        parts.append(np.tile(_given(options.sigma_attitude, stated), (1, 3)))
    if "translation" in options.model:
        parts.append(np.tile(_given(options.sigma_position, stated), (1, 3)))
    parts += [np.full((len(views), 3), options.sigma_drift or DRIFT_SIGMA)] * drift
    if not parts:
        size = {"shift": 2, "shift-drift": 4, "affine": 6}[options.model]
        parts.append(np.full((len(views), size), IMAGE_SIGMA))
    return np.hstack(parts)


def _given(value: float | None, stated: Array) -> Array:
    return stated[:, None] if value is None else np.full((len(stated), 1), value)
