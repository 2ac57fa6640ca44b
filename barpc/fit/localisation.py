"""The localisation RPC, from image and altitude to the ground: the solvers of the RPC with roles exchanged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from barpc.fit.certificate import EXACT, Errors
from barpc.fit.methods import FitSolution, solve_problem
from barpc.fit.precision import Normalization
from barpc.fit.system import FitProblem
from barpc.geodesy import Array, metres_per_unit, wrap_longitude
from barpc.options import FitOptions
from barpc.sensor.rpc import RPC

Seen = Callable[[RPC, FitSolution], tuple[Errors, Array]]
"""What a localisation RPC is off by on points that it has not seen [m, px], and the largest (2,)."""


@dataclass(frozen=True)
class Localisation:
    """The certificate of a localisation RPC, on the check points of the fit.

    Parameters
    ----------
    rmse_m, max_m : float
        Root mean square and largest distance on the ground from where the camera localises them [m].
    rmse_px, max_px : float
        The same from where the fitted RPC projects the places found [px].
    min_denominator : float
        As for the RPC, over image and altitudes.
    method : str
        The solver whose result this is.
    """

    rmse_m: float
    max_m: float
    rmse_px: float
    max_px: float
    min_denominator: float
    method: str

    def verdict(self, tolerance: float) -> str:
        """Return the faults at a tolerance [px], in words; empty if there are none."""
        if not self.max_px <= tolerance:
            return (
                f"the localisation RPC misses the ground by up to {self.max_m:.3g} m ({self.max_px:.3g} px), wanted "
                f"{tolerance:g} px: fit a smaller altitude range or a smaller image, raise the tolerance, or do "
                "without it"
            )
        return "" if self.min_denominator > 0 else "the localisation RPC has a pole near the scene: do without it"


def off(rpc: RPC, found: Array, ground: Array, image: Array) -> Array:
    """Return the distances (N, 2) [m, px] of places `found` (N, 3) from ground points (N, 3), and of their
    projections.
    """
    miss = found - ground
    miss[:, 0] = wrap_longitude(miss[:, 0])
    metres = np.linalg.norm((miss * metres_per_unit(ground))[:, :2], axis=1)
    return np.column_stack([metres, np.linalg.norm(rpc.project(found) - image, axis=1)])


def inverse(rpc: RPC, ground: Array, image: Array, weight: Array | None = None) -> FitProblem:
    """Return the problem of the localisation RPC that goes with an RPC: its normalisation, its points, roles
    exchanged.
    """
    norm = Normalization(
        np.append(rpc.image_offset, rpc.ground_offset[2]),
        np.append(rpc.image_scale, rpc.ground_scale[2]),
        rpc.ground_offset[:2],
        rpc.ground_scale[:2],
    )
    lonlat = np.column_stack([wrap_longitude(ground[:, 0], rpc.ground_offset[0]), ground[:, 1]])
    return FitProblem(np.column_stack([image, ground[:, 2]]), lonlat, norm, weight=weight).screened()


def with_localisation(
    rpc: RPC, problem: Callable[[str], FitProblem], seen: Seen, options: FitOptions, exact: bool
) -> tuple[RPC, Localisation]:
    """Return an RPC and its localisation RPC, by a ridge; of a model (`exact`) also by Gauss-Newton, where
    that is better.
    """
    found: list[tuple[RPC, Localisation]] = []
    for method in ("ridge", "gauss-newton") if exact else ("ridge",):
        solution = solve_problem(problem(method), options, method)
        direct = replace(rpc, direct=solution.coeffs)
        errors, largest = seen(direct, solution)
        least = solution.region.smallest(solution.coeffs[1::2])
        (rmse_m, rmse_px), (max_m, max_px) = errors.rmse.tolist(), largest.tolist()
        found.append((direct, Localisation(rmse_m, max_m, rmse_px, max_px, least, method)))
        if max_px <= EXACT:
            break
    return min(found, key=lambda each: (not each[1].min_denominator > 0, each[1].rmse_m))
