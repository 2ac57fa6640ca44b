"""From points to the coefficients of an RPC: one function a method."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from barpc.errors import FitError
from barpc.fit.lcurve import solve_lcurve
from barpc.fit.options import ALTITUDE_FLOOR, FitOptions, Normalization
from barpc.fit.points import extent
from barpc.fit.precision import PRECISIONS
from barpc.fit.ridge import expected_size, noise_scaled, solution
from barpc.fit.system import Compressed, Problem
from barpc.geodesy import Array
from barpc.sensor.rpc import RPC

_EVEN = 0.05  # a denominator within 1 -/+ this weights nothing


@dataclass(frozen=True, eq=False)
class Solution:
    """An RPC and how it was found.

    Parameters
    ----------
    rpc : RPC
        The result.
    problem : Problem
        What was solved.
    solved : list of Compressed
        Final systems of col and row, penalties included.
    h : (2,)
        Regularisation of col, row.
    iterations : int
        Passes over the points.
    method : str
        The solver.
    """

    rpc: RPC
    problem: Problem
    solved: list[Compressed]
    h: Array
    iterations: int
    method: str

    def leave_one_out(self) -> Iterator[Array]:
        """Residuals (n, 2) [px] that points would have if they had not been used, some hundred at a time.

        r / (1 - leverage), the leverage from the final system: exact for a linear problem.
        """
        inverses = [np.linalg.pinv(system.matrix) for system in self.solved]
        rows = [
            self.problem.rows(axis, self.rpc.coeffs[2 * axis + 1], len(inverse) > len(self.problem.active))
            for axis, inverse in enumerate(inverses)
        ]
        for both in zip(*rows, strict=True):
            part = both[0][0]
            residual = self.rpc.project(self.problem.ground[part]) - self.problem.image[part]
            for axis, (_, block) in enumerate(both):
                spread = block[:, :-1] @ inverses[axis]
                leverage = np.einsum("ij,ij->i", spread, spread)
                residual[:, axis] /= np.maximum(1.0 - leverage, 1e-6)
            yield residual


def tidy(values: Array) -> Array:
    """Values of at most twelve significant digits: they survive every reader that prints fifteen."""
    return np.array([float(f"{value:.12g}") for value in values])


def normalization(
    ground: Array, image: Array, options: FitOptions, vendor: RPC | None = None
) -> Normalization:
    """Offsets and scales that take points into [-1, 1].

    Parameters
    ----------
    ground : (N, 3)
        lon (continuous), lat [deg], alt [m].
    image : (N, 2)
        col, row [px].
    options : FitOptions
        Its ``normalization`` is taken as it is, its ``precision`` rounds what is found.
    vendor : RPC, optional
        Ground offsets and scales are taken from it.
    """
    if options.normalization is not None:
        return options.normalization
    (low, high), (left, right) = extent(ground), extent(image)
    offset, scale = 0.5 * (low + high), 0.5 * (high - low)
    if vendor is not None:
        offset, scale = vendor.ground_offset, vendor.ground_scale
    else:
        offset, scale = tidy(offset), tidy(np.maximum(scale, [1e-9, 1e-9, ALTITUDE_FLOOR]))
    middle, half = tidy(0.5 * (left + right)), tidy(np.maximum(0.5 * (right - left), 1e-6))
    found = Normalization(offset, scale, middle, half)
    return found if options.precision is None else PRECISIONS[options.precision].normalization(found)


def solve(
    ground: Array,
    image: Array,
    options: FitOptions,
    method: str,
    *,
    weight: Array | None = None,
    vendor: RPC | None = None,
) -> Solution:
    """Fit the coefficients of an RPC to points.

    Parameters
    ----------
    ground : (N, 3)
        lon (continuous), lat [deg], alt [m].
    image : (N, 2)
        col, row [px].
    options : FitOptions
        Parameters of the solvers.
    method : {"ridge", "lcurve", "vendor-denominators"}
        The solver.
    weight : (N,), optional
        Weights of the points (1 / standard deviation).
    vendor : RPC, optional
        Whose denominators "vendor-denominators" keeps.

    Raises
    ------
    FitError
        Too few points, or points that do not determine the coefficients.
    """
    keeps = method == "vendor-denominators"
    if keeps and vendor is None:
        raise FitError(
            "vendor-denominators: the model is not built on an RPC whose denominators could be kept"
        )
    norm = normalization(ground, image, options, vendor if keeps else None)
    problem = Problem(ground, image, norm, weight=weight).screened()
    unknowns = len(problem.active) * (1 if keeps else 2) - (0 if keeps else 1)
    if len(ground) <= unknowns:
        raise FitError(
            f"{len(ground)} points are too few: each coordinate has {unknowns} unknowns, "
            f"give {unknowns + 1} points or more"
        )
    return _METHODS[method](problem, options, vendor)


def _quantize(options: FitOptions) -> Callable[[Array], Array] | None:
    return None if options.precision is None else PRECISIONS[options.precision].coeffs


def _assembled(
    problem: Problem, coeffs: Array, solved: list[Compressed], h: Array, passes: int, method: str
) -> Solution:
    norm = problem.norm
    rpc = RPC(coeffs, norm.ground_offset, norm.ground_scale, norm.image_offset, norm.image_scale)
    return Solution(rpc, problem, solved, h, passes, method)


def _ridge(problem: Problem, options: FitOptions, vendor: RPC | None) -> Solution:
    expected = expected_size(problem.active, options.tau)
    quantize = _quantize(options)
    coeffs, solved, h, passes = np.zeros((4, 20)), [], np.zeros(2), 1
    for axis in range(2):
        denominator = None
        for done in range(1 + options.weighted):
            system, sigma = noise_scaled(problem.compressed(axis, denominator), expected)
            pair = problem.expanded(solution(system))
            denominator = pair[1]
            passes = max(passes, 1 + done)
            if np.abs(denominator[1:]).sum() < _EVEN:
                break
        coeffs[2 * axis : 2 * axis + 2] = (
            pair if quantize is None else problem.expanded(solution(system, quantize))
        )
        solved.append(system)
        h[axis] = sigma / options.tau
    return _assembled(problem, coeffs, solved, h, passes, "ridge")


def _lcurve(problem: Problem, options: FitOptions, vendor: RPC | None) -> Solution:
    groups = [[0, 1]] if options.joint else [[0], [1]]
    results = [solve_lcurve(problem, axes) for axes in groups]
    coeffs = np.concatenate([result[0] for result in results])
    solved = [system for result in results for system in result[1]]
    quantize = _quantize(options)
    if quantize is not None:
        pairs = [problem.expanded(solution(system, quantize)) for system in solved]
        coeffs = np.concatenate(pairs)
    h = np.broadcast_to([result[2] for result in results], 2).copy()
    return _assembled(problem, coeffs, solved, h, max(result[3] for result in results), "lcurve")


def _vendor_denominators(problem: Problem, options: FitOptions, vendor: RPC | None) -> Solution:
    quantize = _quantize(options)
    coeffs, solved = np.zeros((4, 20)), []
    for axis in range(2):
        denominator = vendor.coeffs[2 * axis + 1] if vendor is not None else coeffs[1]
        denominator = denominator / denominator[0]
        if quantize is not None:
            denominator = quantize(denominator)
        raw = problem.compressed(axis, denominator, free=False)
        system, _ = noise_scaled(raw, expected_size(problem.active, options.tau)[: len(raw.matrix)])
        x = solution(system, quantize)
        coeffs[2 * axis : 2 * axis + 2] = problem.expanded(x, denominator)
        solved.append(system)
    return _assembled(problem, coeffs, solved, np.zeros(2), 1, "vendor-denominators")


_METHODS: dict[str, Callable[[Problem, FitOptions, RPC | None], Solution]] = {
    "ridge": _ridge,
    "lcurve": _lcurve,
    "vendor-denominators": _vendor_denominators,
}
