"""RPCs of given points; of fewer than determine one, the smaller models that points carry, each point left out in turn.

Coefficients that are not of a model are 0, those of a denominator's constant 1: the result is an RPC as any other.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from barpc.base.errors import BarpcWarning, FitError
from barpc.base.geodesy import CHUNK, Array, metres_per_unit
from barpc.base.options import FitOptions
from barpc.fit.certificate import RpcFit, roundtrip
from barpc.fit.methods import FitSolution, normalization, solve
from barpc.fit.points import checked_points, column_ranges, screened
from barpc.fit.refit import BETTER, accepted, best_method, certified, wrong_axes_of_grid
from barpc.fit.system import FitProblem
from barpc.sensor.rational import monomials
from barpc.sensor.rpc import RPC
from barpc.sensor.sampler import Errors

WHOLE = 40
"""Points that determine the 39 unknowns of each coordinate of a whole RPC, and one to spare."""
NOISY = 400
"""Points from which on the noise of a whole RPC's unknowns is a third of that of a point, or less."""
_WEIGHTINGS = 4  # in which a projective model is weighted by its denominator: it varies by some per cent


def fit_rpc_points(
    ground: npt.ArrayLike,
    image: npt.ArrayLike,
    *,
    sigma: npt.ArrayLike | None = None,
    check: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
    size: tuple[int, int] | None = None,
    options: FitOptions | None = None,
    strict: bool = True,
) -> RpcFit:
    """Fit an RPC to given correspondences: GCPs, tables, exported grids.

    Parameters
    ----------
    ground : (N, 3), lon, lat [deg], alt [m above the ellipsoid]; all at one altitude give an RPC for that altitude only
    image : (N, 2), col, row [px]
    sigma : (N,), optional, relative standard deviations of the image points; else equal
    check : (ground, image), optional
        Check points (M, 3) and (M, 2). Without them the certificate holds leave-one-out residuals.
    size : (width, height), optional, image whose coverage is stated [px]; else the points' own extent
    options : FitOptions, optional
        Solver, tolerance. Points that are noisy want a ``tolerance`` of three or four times their noise.
    strict : bool, as for `fit_rpc`

    Returns
    -------
    RpcFit, the RPC and its certificate

    Raises
    ------
    FitError
        Fewer than four points, not finite, out of range, in a plane, a grid of exchanged axes; or the tolerance is not
        reached. Of fewer than 40 the largest model that they carry is taken (`RpcFit.few`), of fewer than 400 the
        better one.

    Warns
    -----
    BarpcWarning : the points show the ground mirrored

    Examples
    --------
    >>> rng, rpc = np.random.default_rng(0), barpc.read_rpc("data_samples/view_00.tif")
    >>> image = rng.uniform(0, 1000, (400, 2))
    >>> ground = rpc.localize(image, rng.uniform(0, 400, 400))
    >>> bool(barpc.fit_rpc_points(ground, image).max_ckp.max() < 1e-3)
    True
    """
    options, given = options or FitOptions(), _looked_at(ground, image)
    axes, weight = wrong_axes_of_grid(*given), relative_weight(sigma, len(given[0]))
    held_out = None if check is None else checked_points(*check)

    if len(given[0]) < WHOLE:
        return accepted(_few_points(given, weight, held_out, size, options), options, strict)

    def attempt(method: str) -> RpcFit:
        solution = solve(*given, options, method, weight=weight)
        return replace(_certified_on_points(solution, held_out, size), axes=axes)

    fit = best_method(attempt, options, strict and len(given[0]) >= NOISY, exact=False)
    if len(given[0]) < NOISY and options.method == "auto":
        small = replace(_few_points(given, weight, held_out, size, options), axes=axes, few="")
        smaller = float(np.linalg.norm(small.rmse_ckp)) < BETTER * float(np.linalg.norm(fit.rmse_ckp))
        fit = accepted(small if smaller else fit, options, strict)
    return fit


def _few_points(
    given: tuple[Array, Array],
    weight: Array | None,
    held_out: tuple[Array, Array] | None,
    size: tuple[int, int] | None,
    options: FitOptions,
) -> RpcFit:
    """Return the fit of the largest model that some points, too few for an RPC, carry."""
    (ground, image), norm = given, normalization(*given)
    place = (ground - norm.ground_offset) / norm.ground_scale
    found = fit_few(place, (image - norm.image_offset) / norm.image_scale, weight)
    problem = FitProblem(ground, image, norm, weight=weight, margin=options.pole_margin)
    solution = FitSolution(found.coeffs, problem, [], np.zeros(2), 1, found.model.name)
    left_out = found.left_out * norm.image_scale
    fit = _certified_on_points(solution, held_out, size, [left_out])
    error = np.sqrt((left_out**2).sum(axis=1).mean())
    few = (
        f"{len(ground)} points carry {found.model.name}, which misses points left out by {error:.3g} px (RMS): "
        f"give {WHOLE} or more for a whole RPC"
    )
    return replace(fit, few=few)


def _certified_on_points(
    solution: FitSolution,
    held_out: tuple[Array, Array] | None,
    size: tuple[int, int] | None,
    left_out: Iterable[Array] | None = None,
) -> RpcFit:
    """Return a fit to given points with its certificate, on check points or on each point, left out (N, 2) [px].

    Its RPC is limited to the altitudes of the points.
    """
    ground, image, errors = solution.problem.ground, solution.problem.image, Errors()
    if held_out is not None:
        errors.add(solution.rpc.project(held_out[0]) - held_out[1])
    if held_out is None:
        for residual in solution.leave_one_out() if left_out is None else left_out:
            errors.add(residual)
    loop = roundtrip(solution.rpc, ground[:: max(1, len(ground) // CHUNK)])
    fit = certified(solution, errors, loop, size)
    rpc = _limited_to_altitudes(fit.rpc, ground[:, 2])
    return replace(fit, rpc=rpc, height_px=_height_unknown(ground, image, float(fit.rmse_cnp.max())))


def _limited_to_altitudes(rpc: RPC, alt: Array) -> RPC:
    """Return the same RPC, stated for no other altitudes than those of points (N,) [m], and a metre at least."""
    scale = rpc.ground_scale.copy()
    scale[2] = max(float(f"{0.5 * np.ptp(alt):.12g}"), 1.0)
    powers = monomials(np.array([[1.0], [1.0], [scale[2] / rpc.ground_scale[2]]]))[:, 0]
    return replace(rpc, coeffs=rpc.coeffs * powers, ground_scale=scale)


def _height_unknown(ground: Array, image: Array, rmse: float) -> float:
    """Return the uncertainty [px] of the shift by 100 m of altitude, from points with residuals `rmse` [px].

    The slope of col or row by altitude is known by the altitudes that longitude and latitude do not tell (of a surface
    its relief, less a cubic). Of none of these all is open: 100 m are as much aside under 45 degrees.
    """
    (low, high), some = column_ranges(ground), ground[:: max(1, len(ground) // CHUNK)]
    place = monomials(((some - 0.5 * (low + high)) / np.maximum(0.5 * (high - low), 1e-9)).T)
    flat = place[[0, 1, 2, 4, 7, 8, 11, 12, 14, 15]].T  # the terms without altitude
    rest = some[:, 2] - flat @ np.linalg.lstsq(flat, some[:, 2], rcond=None)[0]
    scatter = float(np.linalg.norm(rest)) * (len(ground) / len(some)) ** 0.5
    metres = np.ptp(ground[:, :2], axis=0) * metres_per_unit(0.5 * (low + high))[:2]
    pixels = float(np.linalg.norm(np.ptp(image, axis=0)) / np.linalg.norm(metres))
    return float(100.0 * min(rmse / max(scatter, 1e-12), pixels))


def _looked_at(ground: npt.ArrayLike, image: npt.ArrayLike) -> tuple[Array, Array]:
    """Return given points, screened; where they show the ground mirrored that is warned of."""
    ground, image, mirrored = screened(ground, image)
    if mirrored:
        message = "points: they show the ground mirrored: the image is, or two of lon, lat or of col, row are exchanged"
        warnings.warn(message, BarpcWarning, stacklevel=3)
    return ground, image


def relative_weight(sigma: npt.ArrayLike | None, count: int) -> Array | None:
    """Return the weights (count,) of standard deviations (count,), 1 for the smallest; None for none."""
    if sigma is None:
        return None
    value = np.asarray(sigma, dtype=np.float64)
    if value.shape != (count,) or not (np.isfinite(value).all() and (value > 0).all()):
        raise FitError(f"sigma: expected {count} positive numbers")
    weight = value.min() / value
    if not (weight > np.finfo(float).eps).all():
        raise FitError(f"sigma: from {value.min():g} to {value.max():g}, too far apart for one fit")
    return np.asarray(weight)


@dataclass(frozen=True)
class SmallModel:
    """A model of few terms: its name, terms of a numerator, whether denominators are linear, the points it needs."""

    name: str
    terms: int
    projective: bool
    least: int


MODELS = (
    SmallModel("an affine without heights", 3, False, 4),
    SmallModel("an affine with heights", 4, False, 8),
    SmallModel("a projective camera", 4, True, 11),
    SmallModel("quadratic polynomials", 10, False, 16),
)
"""The simplest first; of points at one altitude the first alone."""


@dataclass(frozen=True, eq=False)
class FewFit:
    """Coefficients (4, 20) of a model, and the residuals (N, 2) [px, normalised] of points left out in turn."""

    model: SmallModel
    coeffs: Array
    left_out: Array

    @property
    def error(self) -> float:
        """Root mean square of the residuals left out."""
        return float(np.sqrt((self.left_out**2).sum(axis=1).mean()))


def fit_few(place: Array, image: Array, weight: Array | None = None) -> FewFit:
    """Fit the largest model that few points carry.

    Parameters
    ----------
    place, image : (N, 3), (N, 2), normalised ground and image points
    weight : (N,) or None, 1 / standard deviation

    Returns
    -------
    FewFit

    Raises
    ------
    FitError
        Fewer than four points.
    """
    count, flat = len(place), not np.ptp(place[:, 2]) > 0.0
    root = np.ones(count) if weight is None else weight
    usable = [model for model in MODELS if count >= model.least and (model.terms == 3 or not flat)]
    if not usable:
        raise FitError(f"points: {count} are too few: 4 give an affine at their altitude, {WHOLE} a whole RPC")
    best = _few_fit(usable[0], place, image, root)
    for model in usable[1:]:
        tried = _few_fit(model, place, image, root)
        if tried.error < BETTER * best.error or best.model.terms == 3:  # heights are asked for where they vary
            best = tried
    return best


def _few_fit(model: SmallModel, place: Array, image: Array, root: Array) -> FewFit:
    out = np.empty_like(image)
    for n in range(len(place)):
        kept = np.arange(len(place)) != n
        coeffs = _coefficients(model, place[kept], image[kept], root[kept])
        out[n] = (_projected(coeffs, place[n : n + 1]) - image[n])[0]
    return FewFit(model, _coefficients(model, place, image, root), out)


def _projected(coeffs: Array, place: Array) -> Array:
    col, col_den, row, row_den = coeffs @ monomials(place.T)
    return np.column_stack([col / col_den, row / row_den])


def _coefficients(model: SmallModel, place: Array, image: Array, root: Array) -> Array:
    """Return the coefficients (4, 20), numerator and denominator of the column, then of the row, by least squares."""
    terms = monomials(place.T)[: model.terms].T
    coeffs = np.zeros((4, 20))
    coeffs[1::2, 0] = 1.0
    if not model.projective:
        found = np.linalg.lstsq(terms * root[:, None], image * root[:, None], rcond=None)[0]
        coeffs[[0, 2], : model.terms] = found.T
        return coeffs
    none, weight = np.zeros_like(terms), root
    for _ in range(_WEIGHTINGS):
        of_col = np.hstack([terms, none, -image[:, :1] * terms[:, 1:]])
        of_row = np.hstack([none, terms, -image[:, 1:] * terms[:, 1:]])
        rows, right = np.vstack([of_col, of_row]) * np.tile(weight, 2)[:, None], image.T.ravel() * np.tile(weight, 2)
        found = np.linalg.lstsq(rows, right, rcond=None)[0]
        coeffs[0, :4], coeffs[2, :4] = found[:4], found[4:8]
        coeffs[1, 1:4] = coeffs[3, 1:4] = found[8:]
        weight = root / np.abs(1.0 + terms[:, 1:] @ found[8:])
    return coeffs
