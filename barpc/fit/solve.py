"""From correspondences to the coefficients of an RPC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from barpc.errors import FitError
from barpc.fit.options import ALTITUDE_FLOOR, FitOptions, Normalization
from barpc.fit.ridge import Compressed, compress, solve_noise_scaled
from barpc.geodesy import Array, wrap_longitude
from barpc.sensor.rpc import MONOMIALS, RPC

_ALL = np.arange(20)
_FLAT = np.array([i for i, monomial in enumerate(MONOMIALS) if "H" not in monomial])


@dataclass(frozen=True, eq=False)
class Solution:
    """An RPC and how it was found: regularisation (2,) of col and row, passes over the points."""

    rpc: RPC
    h: Array
    iterations: int
    method: str


def normalization(ground: Array, image: Array, options: FitOptions) -> Normalization:
    """Offsets and scales that take points into [-1, 1].

    Parameters
    ----------
    ground : (N, 3)
        lon (continuous), lat [deg], alt [m].
    image : (N, 2)
        col, row [px].
    options : FitOptions
        Its ``normalization`` is taken as it is, its ``quantize`` rounds what is found.
    """
    if options.normalization is not None:
        return options.normalization
    low, high = ground.min(axis=0), ground.max(axis=0)
    left, right = image.min(axis=0), image.max(axis=0)
    floor = np.array([1e-9, 1e-9, ALTITUDE_FLOOR])
    found = Normalization(
        0.5 * (low + high),
        np.maximum(0.5 * (high - low), floor),
        0.5 * (left + right),
        np.maximum(0.5 * (right - left), 1e-6),
    )
    return found if options.quantize is None else options.quantize(found)


def solve(
    ground: Array, image: Array, norm: Normalization, options: FitOptions, weight: Array | None = None
) -> Solution:
    """Fit the coefficients of an RPC to points, its offsets and scales given.

    Parameters
    ----------
    ground : (N, 3)
        lon, lat [deg], alt [m].
    image : (N, 2)
        col, row [px].
    norm : Normalization
        Offsets and scales.
    options : FitOptions
        Solver and its parameters.
    weight : (N,), optional
        Weights of the points (1 / standard deviation).
    """
    normalized = ((ground - norm.ground_offset) / norm.ground_scale).T
    normalized[0] = (
        wrap_longitude(ground[:, 0], norm.ground_offset[0]) - norm.ground_offset[0]
    ) / norm.ground_scale[0]
    target = ((image - norm.image_offset) / norm.image_scale).T
    active = _FLAT if np.ptp(normalized[2]) < 1e-9 else _ALL
    if len(ground) < 2 * len(active):
        raise FitError(
            f"{len(ground)} points are too few: {2 * len(active) - 1} unknowns a coordinate need at least "
            f"{2 * len(active)}"
        )
    coeffs, h = np.zeros((4, 20)), np.zeros(2)
    for i in range(2):
        denominator = None
        for _ in range(1 + options.weighted):
            system = compress(normalized, target[i], active, denominator, weight)
            solution, h[i] = solve_noise_scaled(system, options.tau)
            coeffs[2 * i : 2 * i + 2] = expand(system, solution, active)
            denominator = coeffs[2 * i + 1]
    rpc = RPC(coeffs, norm.ground_offset, norm.ground_scale, norm.image_offset, norm.image_scale)
    return Solution(rpc, h, 1 + options.weighted, "ridge")


def expand(system: Compressed, solution: Array, active: np.ndarray) -> Array:
    """Numerator and denominator (2, 20) of a solution; monomials not in use are zero."""
    out = np.zeros((2, 20))
    out[0, active] = solution[: system.num_numerators]
    out[1, 0] = 1.0
    out[1, active[1:]] = solution[system.num_numerators :]
    return out
