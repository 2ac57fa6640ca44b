"""Where a camera puts the middle of its image: how far that moved, and how well it is known."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.special import erf

from barpc.ba.estimated.priors import USABLE_ACCURACY
from barpc.geodesy import Array, ecef_from_ground, enu_basis, metres_per_unit
from barpc.report.records import Number, Record, said
from barpc.scene import View
from barpc.sensor.corrected import Corrected
from barpc.sensor.pushbroom import Pushbroom
from barpc.sensor.rpc import RPC
from barpc.sensor.timing import Timed


class EllipseEntry(Record):
    """How well a camera tells where a ground point in the middle of its image is, its altitude given."""

    major_m: Number = said("Larger semi-axis of the one-sigma ellipse", "m", "semi-axis", ".2f")
    minor_m: Number = said("Smaller semi-axis", "m", "other", ".2f")
    azimuth_deg: Number = said("Direction of the larger one, clockwise from north", "deg", "azimuth", ".0f")
    ce90_m: Number = said("Radius of the circle that holds 90 %", "m", "CE90", ".2f")


def shift_in_image(model: Corrected, covariance: Array, unknowns: str, ground: Array) -> tuple[Array, Array]:
    """Return how far P_BA moves a ground point (3,) near the image's middle, and that one's deviation.

    Parameters
    ----------
    model : Corrected
        P_BA.
    covariance : (q, q)
        Of rotation (metres: angle x distance), translation [m], then any drift, which is zero in the middle row.
    unknowns : str
        "rotation", "translation" or "rotation+translation".
    ground : (3,)
        lon, lat [deg], alt [m].

    Returns
    -------
    shift, sigma : (2,)
        col, row [px].
    """
    image, variance, _ = _in_image(model, covariance, unknowns, ground)
    return image - model.sensor.project(ground), np.sqrt(np.maximum(np.diag(variance), 0.0))


def ellipse(model: Corrected, covariance: Array, unknowns: str, ground: Array) -> EllipseEntry:
    """Return the standard error ellipse of where P_BA sees a pixel on the ground; arguments of `shift_in_image`."""
    _, variance, by_point = _in_image(model, covariance, unknowns, ground)
    return _drawn(variance, by_point @ enu_basis(ground)[:2].T)


def clocks_in_image(model: Timed, covariance: Array, ground: Array) -> tuple[Array, Array, EllipseEntry]:
    """As `shift_in_image` and `ellipse`, by a radar's clocks.

    `covariance` begins with range and place along the flight [m].
    """
    image, by_timing = model.timing_jacobian(ground)
    by_unknown = by_timing / [1.0, model.sensor.speed]
    variance = by_unknown @ covariance[:2, :2] @ by_unknown.T
    by_ground = model.project_jacobian(ground)[1] / metres_per_unit(ground)
    moved = image - model.sensor.project(ground)
    return moved, np.sqrt(np.maximum(np.diag(variance), 0.0)), _drawn(variance, by_ground[:, :2])


def _drawn(variance: Array, by_level: Array) -> EllipseEntry:
    """Return the ellipse of a covariance [px^2] in an image, of its derivative (2, 2) [px/m] by east and north."""
    seen = np.linalg.inv(by_level)  # at one altitude
    values, axes = np.linalg.eigh(seen @ variance @ seen.T)
    minor, major = np.sqrt(np.maximum(values, 0.0)).tolist()
    azimuth = float(np.degrees(np.arctan2(axes[0, 1], axes[1, 1]))) % 180.0
    return EllipseEntry(major, minor, azimuth, ce90(major, minor))


def _in_image(model: Corrected, covariance: Array, unknowns: str, ground: Array) -> tuple[Array, Array, Array]:
    """Return the image (2,) of a ground point, its covariance [px^2], its derivative (2, 3) by the point [px/m]."""
    ecef = ecef_from_ground(ground)
    image, by_point, by_rotation, by_translation = model.project_ecef(ecef)
    distance = np.linalg.norm(ecef - model.correction.center)
    parts = {"rotation": by_rotation / distance, "translation": by_translation}
    jacobian = np.hstack([part for name, part in parts.items() if name in unknowns])
    q = jacobian.shape[1]
    return image, jacobian @ covariance[:q, :q] @ jacobian.T, by_point


def stated_ce90(view: View) -> float | None:
    """Return CE90 [m] of a camera as delivered, of the accuracies per axis that it states."""
    sensor, sigma = view.sensor, None
    if isinstance(sensor, Pushbroom) and sensor.accuracy is not None:
        sigma = float(np.hypot(*sensor.accuracy))
    elif isinstance(sensor, RPC) and sensor.err_bias is not None and sensor.err_bias > USABLE_ACCURACY:
        sigma = float(np.hypot(sensor.err_bias, sensor.err_rand or 0.0))
    return None if sigma is None else ce90(sigma, sigma)


def ce90(major: float, minor: float) -> float:
    """Return the radius that holds 90 % of a normal distribution with such standard deviations along its axes.

    Examples
    --------
    >>> [round(ce90(1.0, minor), 3) for minor in (1.0, 0.5, 0.0)]
    [2.146, 1.737, 1.645]
    """
    ratio, radius = _radii()
    return major * float(np.interp(minor / major if major else 1.0, ratio, radius))


@cache
def _radii() -> tuple[Array, Array]:
    """Return the radius for a larger axis of one, by the smaller one: the integral over x of what y holds, bisected."""
    ratio = np.linspace(0.0, 1.0, 101)
    nodes, weights = np.polynomial.legendre.leggauss(64)
    low, high = np.full(len(ratio), 1.6), np.full(len(ratio), 2.2)
    for _ in range(40):
        radius = 0.5 * (low + high)
        x, rest = radius[:, None] * np.sin(0.5 * np.pi * nodes), np.cos(0.5 * np.pi * nodes)
        with np.errstate(divide="ignore"):
            held = erf(radius[:, None] * rest / (np.sqrt(2.0) * ratio[:, None]))
        density = np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi) * held * radius[:, None] * rest * 0.5 * np.pi
        low, high = np.where(density @ weights < 0.9, (radius, high), (low, radius))
    return ratio, radius
