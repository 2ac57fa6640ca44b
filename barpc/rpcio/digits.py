"""An RPC whose offsets and scales survive GDAL's fifteen digits.

GDAL hands the tag's doubles on as text of fifteen digits. A longitude offset of 17 digits then moves an
image by up to 2e-8 px. Offsets and scales are a choice: here they are rounded to what is handed on, and the
coefficients take up the difference, so that the camera stays the same for every reader.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from barpc.geodesy import Array
from barpc.sensor.rational import DERIVATIVE, MONOMIALS
from barpc.sensor.rpc import RPC

_POWERS = np.array([[monomial.count(letter) for monomial in MONOMIALS] for letter in "LPH"], dtype=np.float64)


def _fifteen(values: Array) -> Array:
    return np.array([float(f"{value:.15g}") for value in values.tolist()])


def survives(rpc: RPC) -> bool:
    """Whether offsets and scales are the same after being printed with fifteen digits."""
    arrays = (rpc.ground_offset, rpc.ground_scale, rpc.image_offset, rpc.image_scale)
    return all(np.array_equal(_fifteen(array), array) for array in arrays)


def printable(rpc: RPC) -> RPC:
    """The same camera with offsets and scales of at most fifteen digits.

    A normalised coordinate x becomes a x + b with b and a - 1 of 1e-13: the polynomials change by
    b dp/dx + (a - 1) x dp/dx, and what is left of second order is 1e-26.

    Parameters
    ----------
    rpc : RPC
        Any.

    Returns
    -------
    rpc : RPC
        The argument itself where nothing is to be done.
    """
    if survives(rpc):
        return rpc
    ground_offset, ground_scale = _fifteen(rpc.ground_offset), _fifteen(rpc.ground_scale)
    image_offset, image_scale = _fifteen(rpc.image_offset), _fifteen(rpc.image_scale)
    shift = (ground_offset - rpc.ground_offset) / rpc.ground_scale
    stretch = (ground_scale - rpc.ground_scale) / rpc.ground_scale
    coeffs = np.array(rpc.coeffs)
    change = coeffs * (stretch @ _POWERS)
    change[:, :10] += np.einsum("k,kij,pi->pj", shift, DERIVATIVE, coeffs)
    coeffs += change
    numerator, denominator = coeffs[::2], coeffs[1::2]
    offset = ((rpc.image_offset - image_offset) / image_scale)[:, None]
    coeffs[::2] = numerator * (rpc.image_scale / image_scale)[:, None] + offset * denominator
    return replace(
        rpc,
        coeffs=coeffs,
        ground_offset=ground_offset,
        ground_scale=ground_scale,
        image_offset=image_offset,
        image_scale=image_scale,
    )
