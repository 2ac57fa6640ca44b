"""Where a camera puts the middle of its image: how far that moved, and how well it is known."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.special import erf

from barpc.ba.estimated.priors import USABLE_ACCURACY
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, metres_per_unit
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


def moved_in_space(
    model: Corrected, covariance: Array, unknowns: str, ground: Array, seen: tuple[Array, ...] | None = None
) -> tuple[Array, Array, EllipseEntry]:
    """Return how far P_BA moves a ground point near the image's middle (2,) [px], its sigma (2,), and its ellipse.

    `covariance` (q, q) is of rotation (metres: angle x distance), translation [m], then any drift, which is zero in the
    middle row; `unknowns`: "rotation", "translation" or "rotation+translation"; `ground` (3,): lon, lat [deg], alt [m].
    `seen`, if known: what `project_ecef` says of it, and where the camera as delivered sees it.
    """
    ecef = ecef_from_ground(ground)
    image, by_point, by_rotation, by_translation, before = seen or (
        *model.project_ecef(ecef),
        model.sensor.project(ground),
    )
    distance = np.linalg.norm(ecef - model.correction.center)
    parts = {"rotation": by_rotation / distance, "translation": by_translation}
    jacobian = np.hstack([part for name, part in parts.items() if name in unknowns])
    return _known(image - before, jacobian, covariance, by_point @ enu_basis(ground)[:2].T)


def moved_by_clocks(model: Timed, covariance: Array, ground: Array) -> tuple[Array, Array, EllipseEntry]:
    """As `moved_in_space`, by a radar's clocks: `covariance` begins with range and place along the flight [m]."""
    image, by_timing = model.timing_jacobian(ground)
    by_level = (model.project_jacobian(ground)[1] / metres_per_unit(ground))[:, :2]
    return _known(image - model.sensor.project(ground), by_timing / [1.0, model.sensor.speed], covariance, by_level)


def _known(moved: Array, jacobian: Array, covariance: Array, by_level: Array) -> tuple[Array, Array, EllipseEntry]:
    """`jacobian` (2, q): [px] by the first unknowns; `by_level` (2, 2): [px/m] by east and north, at one altitude."""
    q = jacobian.shape[1]
    variance = jacobian @ covariance[:q, :q] @ jacobian.T
    seen = np.linalg.inv(by_level)
    values, axes = np.linalg.eigh(seen @ variance @ seen.T)
    minor, major = np.sqrt(np.maximum(values, 0.0)).tolist()
    azimuth = float(np.degrees(np.arctan2(axes[0, 1], axes[1, 1]))) % 180.0
    sigma = np.sqrt(np.maximum(np.diag(variance), 0.0))
    return moved, sigma, EllipseEntry(major, minor, azimuth, ce90(major, minor))


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
    if not major > 0.0:
        return major
    radius, along, weights = _circles()
    with np.errstate(divide="ignore"):
        held = erf(along / (np.sqrt(2.0) * np.float64(minor / major)))
    share = (held * weights).sum(axis=1)  # the integral over x of what y holds
    return major * float(np.interp(0.9, share, radius))  # to some 1e-6


@cache  # every image asks
def _circles() -> tuple[Array, Array, Array]:
    """Return radii [major axes]; across their halves the extent of y at points, and the weight of each, of x."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    angle, radius = 0.25 * np.pi * (nodes + 1.0), np.linspace(1.6, 2.2, 200)[:, None]
    along = radius * np.cos(angle)
    density = np.exp(-0.5 * (radius * np.sin(angle)) ** 2) * along
    return radius[:, 0], along, np.sqrt(2.0 / np.pi) * 0.25 * np.pi * density * weights
