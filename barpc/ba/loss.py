"""Robust losses rho(s) of a squared, normalised residual s = (|r| / scale)^2.

The adjustment minimises sum scale^2 rho(s) by reweighting: an observation's squared weight is rho'(s),
so that the gradient of the weighted problem is the gradient of the robust one. One loss a function, one
row in `LOSSES`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from barpc.geodesy import Array

Loss = Callable[[Array], tuple[Array, Array]]
"""s (...) -> rho(s), rho'(s); rho(0) = 0, rho'(0) = 1."""


def linear(s: Array) -> tuple[Array, Array]:
    """Least squares: rho = s."""
    return s, np.ones_like(s)


def huber(s: Array) -> tuple[Array, Array]:
    """Squares up to 1, absolute values beyond."""
    root = np.sqrt(np.maximum(s, 1.0))
    return np.where(s <= 1.0, s, 2.0 * root - 1.0), 1.0 / root


def soft_l1(s: Array) -> tuple[Array, Array]:
    """A smooth form of the absolute value: rho = 2 (sqrt(1 + s) - 1)."""
    root = np.sqrt(1.0 + s)
    return 2.0 * (root - 1.0), 1.0 / root


def cauchy(s: Array) -> tuple[Array, Array]:
    """Rho = log(1 + s)."""
    return np.log1p(s), 1.0 / (1.0 + s)


def geman_mcclure(s: Array) -> tuple[Array, Array]:
    """Rho = s / (1 + s): an outlier's pull vanishes; meant for a scale that shrinks round by round."""
    return s / (1.0 + s), 1.0 / (1.0 + s) ** 2


LOSSES: dict[str, Loss] = {
    "linear": linear,
    "huber": huber,
    "soft_l1": soft_l1,
    "cauchy": cauchy,
    "geman_mcclure": geman_mcclure,
}
"""Name -> loss."""
