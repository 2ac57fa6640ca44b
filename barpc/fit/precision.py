"""The offsets and scales of an RPC, and what a file format can hold of its numbers.

An RPC copied into a format with few digits loses what the format cuts off. Fitted with its offsets and
scales already rounded, and each coefficient rounded while the others can still make up for it, it does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from barpc.errors import FitError
from barpc.frozen import Frozen
from barpc.geodesy import Array

ALTITUDE_FLOOR = 50.0
"""Smallest altitude half range [m] that a model is sampled over, and smallest altitude scale of an RPC."""


@dataclass(frozen=True, eq=False, repr=False)
class Normalization(Frozen):
    """The offsets and scales of an RPC.

    Parameters
    ----------
    ground_offset, ground_scale : (3,)
        lon, lat [deg], alt [m]. A scale may be negative, not zero.
    image_offset, image_scale : (2,)
        col, row [px].
    """

    ground_offset: Array
    ground_scale: Array
    image_offset: Array
    image_scale: Array

    def __post_init__(self) -> None:
        for name in ("ground_offset", "ground_scale", "image_offset", "image_scale"):
            value = self._array(name, (3 if name.startswith("ground") else 2,), FitError)
            if name.endswith("scale") and not value.all():
                raise FitError(f"Normalization {name}: a scale is zero")


@dataclass(frozen=True)
class Precision:
    """The digits of a format.

    Parameters
    ----------
    normalization : callable
        Takes a `Normalization` and gives the one that the format holds; scales never shrink.
    coeffs : callable
        Takes coefficients (...) and gives the nearest ones that the format holds.
    """

    normalization: Callable[[Normalization], Normalization]
    coeffs: Callable[[Array], Array]


def _rounded(norm: Normalization, ground_step: Array, image_step: Array) -> Normalization:
    return Normalization(
        np.rint(norm.ground_offset / ground_step) * ground_step,
        np.sign(norm.ground_scale) * np.ceil(np.abs(norm.ground_scale) / ground_step) * ground_step,
        np.rint(norm.image_offset / image_step) * image_step,
        np.sign(norm.image_scale) * np.ceil(np.abs(norm.image_scale) / image_step) * image_step,
    )


def _nitf_normalization(norm: Normalization) -> Normalization:
    """Return 1e-4 degrees, metres, pixels."""
    rounded = _rounded(norm, np.array([1e-4, 1e-4, 1.0]), np.ones(2))
    return Normalization(  # 1e-4 is no binary number: take what the printed digits read back as
        np.round(rounded.ground_offset, 4),
        np.round(rounded.ground_scale, 4),
        rounded.image_offset,
        rounded.image_scale,
    )


def _nitf_coeffs(coeffs: Array) -> Array:
    """Return coefficients rounded to seven digits and an exponent of one digit: +d.ddddddE-d."""
    value = np.asarray(coeffs, dtype=np.float64)
    exponent = np.clip(np.floor(np.log10(np.maximum(np.abs(value), 1e-300))), -9, 9)
    text = [f"{v:.{6 + int(e) * -1}f}" for v, e in zip(value.ravel(), exponent.ravel(), strict=True)]
    return np.array([float(t) for t in text]).reshape(value.shape)


def _twelve_decimals(value: Array) -> Array:
    return np.round(value, 12)


def _rpcm_normalization(norm: Normalization) -> Normalization:
    fields = (norm.ground_offset, norm.ground_scale, norm.image_offset, norm.image_scale)
    return Normalization(*(np.round(value, 12) for value in fields))


PRECISIONS: dict[str, Precision] = {
    "nitf": Precision(_nitf_normalization, _nitf_coeffs),
    "rpcm": Precision(_rpcm_normalization, _twelve_decimals),
}
"""Format -> its digits: the RPC00B record of NITF, and text files with twelve decimals as rpcm writes them."""
