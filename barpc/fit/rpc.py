"""Fit an RPC to any sensor model, or to given points, and certify it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable

import numpy as np
import numpy.typing as npt

from barpc.errors import BarpcWarning, FitError
from barpc.fit.certificate import Errors, RpcFit, coverage, roundtrip, smallest_denominator
from barpc.fit.points import check_points, control_points, extent, numbers, screened, widened
from barpc.fit.solve import Solution, solve
from barpc.geodesy import Array
from barpc.options import FitOptions
from barpc.sensor import SensorModel
from barpc.sensor.rpc import RPC

_CHUNK = 8192
_LOOPS = 4096  # round trips that a table of points is tried on, about


def fit_rpc(
    model: SensorModel,
    size: tuple[int, int],
    alt_range: tuple[float, float],
    *,
    options: FitOptions | None = None,
    strict: bool = True,
) -> RpcFit:
    """Fit an RPC to a sensor model over an image and an altitude range.

    Parameters
    ----------
    model : SensorModel
        Any camera: an RPC behind a correction, a pushbroom or radar model.
    size : (width, height)
        Image that the RPC is for [px].
    alt_range : (low, high)
        Altitudes that the RPC is for [m above the ellipsoid]; at least 100 m are taken around a flat
        scene.
    options : FitOptions, optional
        Grid, solver, tolerance.
    strict : bool
        Raise where the RPC misses the tolerance; otherwise give the best one found, to be judged by its
        `RpcFit.verdict`.

    Returns
    -------
    RpcFit
        The RPC and its certificate on check points.

    Raises
    ------
    FitError
        The model cannot be localised over the image, or the RPC does not reach the tolerance.

    Warns
    -----
    BarpcWarning
        A few control points have no ground point.
    """
    options = options or FitOptions()
    ground, image = control_points(model, size, widened(alt_range), options)
    cnp, cnp_image = _found(ground.reshape(-1, 3), image.reshape(-1, 2), alt_range)
    vendor = underlying_rpc(model)

    def attempt(method: str) -> RpcFit:
        solution = solve(cnp, cnp_image, options, method, vendor=vendor)
        residuals = (solution.rpc.project(middle) - model.project(middle) for middle in check_points(ground))
        loop = max((roundtrip(solution.rpc, middle) for middle in check_points(ground)), default=0.0)
        return _certified(solution, residuals, loop, size)

    return _first_accepted(attempt, options, vendor, strict)


def _found(cnp: Array, image: Array, alt_range: tuple[float, float]) -> tuple[Array, Array]:
    """The control points (N, 3) and (N, 2) at which the model was localised."""
    ok = np.isfinite(cnp).all(axis=1) & np.isfinite(image).all(axis=1)
    if ok.mean() < 0.9:
        raise FitError(
            f"the model has no ground point for {1 - ok.mean():.0%} of the image over altitudes "
            f"{alt_range[0]:g} to {alt_range[1]:g} m: give an altitude range that it is made for"
        )
    if ok.all():
        return cnp, image
    warnings.warn(
        f"{np.count_nonzero(~ok)} of {ok.size} control points have no ground point and are left out: the "
        "RPC extrapolates there",
        BarpcWarning,
        stacklevel=3,
    )
    return cnp[ok], image[ok]


def fit_rpc_points(
    ground: npt.ArrayLike,
    image: npt.ArrayLike,
    *,
    sigma: npt.ArrayLike | None = None,
    check: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
    size: tuple[int, int] | None = None,
    vendor: RPC | None = None,
    options: FitOptions | None = None,
    strict: bool = True,
) -> RpcFit:
    """Fit an RPC to given correspondences: GCPs, tables, exported grids.

    Parameters
    ----------
    ground : (N, 3)
        lon, lat [deg], alt [m above the ellipsoid]. Points that all have one altitude give an RPC without
        altitude terms, to be used at that altitude.
    image : (N, 2)
        col, row [px].
    sigma : (N,), optional
        Relative standard deviations of the image points; equal if not given.
    check : (ground, image), optional
        Check points (M, 3) and (M, 2). Without them the certificate holds leave-one-out residuals.
    size : (width, height), optional
        Image whose coverage is stated [px]; the points' own extent if not given.
    vendor : RPC, optional
        Whose denominators may be kept.
    options : FitOptions, optional
        Solver, tolerance. Points that are noisy want a ``tolerance`` of three or four times their noise.
    strict : bool
        As for `fit_rpc`.

    Returns
    -------
    RpcFit
        The RPC and its certificate.

    Raises
    ------
    FitError
        Too few points, not finite, swapped columns, points in a plane; or the tolerance is not reached.
    """
    options = options or FitOptions()
    cnp, cnp_image = screened(ground, image, options.allow_mirrored)
    weight = relative_weight(sigma, len(cnp))
    held_out = None if check is None else numbers(*check)

    def attempt(method: str) -> RpcFit:
        solution = solve(cnp, cnp_image, options, method, weight=weight, vendor=vendor)
        left = None if held_out is None else [solution.rpc.project(held_out[0]) - held_out[1]]
        loop = roundtrip(solution.rpc, cnp[:: max(1, len(cnp) // _LOOPS)])
        return _certified(solution, left or solution.leave_one_out(), loop, size)

    return _first_accepted(attempt, options, vendor, strict)


def underlying_rpc(model: object) -> RPC | None:
    """The RPC that a model is built on: itself, or what its corrections stand in front of."""
    while model is not None and not isinstance(model, RPC):
        model = getattr(model, "sensor", None)
    return model


def relative_weight(sigma: npt.ArrayLike | None, count: int) -> Array | None:
    """Weights (count,) of standard deviations (count,), 1 for the smallest; None for none."""
    if sigma is None:
        return None
    value = np.asarray(sigma, dtype=np.float64)
    if value.shape != (count,) or not (np.isfinite(value).all() and (value > 0).all()):
        raise FitError(f"sigma: expected {count} positive numbers")
    return np.asarray(value.min() / value)


def _certified(
    solution: Solution, residuals: Iterable[Array], loop: float, size: tuple[int, int] | None
) -> RpcFit:
    """The fit with its certificate; `residuals` (n, 2) [px] of the check points come some at a time."""
    problem, rpc = solution.problem, solution.rpc
    ground, image = problem.ground, problem.image
    on_cnp, on_ckp = Errors(), Errors()
    for residual in residuals:
        on_ckp.add(residual)
    for start in range(0, len(ground), _CHUNK):
        part = slice(start, start + _CHUNK)
        on_cnp.add(rpc.project(ground[part]) - image[part])
    (low, high), (left, right) = extent(ground), extent(image)
    if size is not None:
        left, right = np.full(2, -0.5), np.asarray(size) - 0.5
    return RpcFit(
        rpc=rpc,
        rmse_cnp=on_cnp.rmse,
        max_cnp=on_cnp.largest,
        rmse_ckp=on_ckp.rmse,
        max_ckp=on_ckp.largest,
        min_denominator=smallest_denominator(rpc, low, high),
        roundtrip=loop,
        coverage=coverage(image, left, right),
        h=solution.h,
        iterations=solution.iterations,
        num_cnp=on_cnp.count,
        num_ckp=on_ckp.count,
        method=solution.method,
    )


def _first_accepted(
    attempt: Callable[[str], RpcFit], options: FitOptions, vendor: RPC | None, strict: bool
) -> RpcFit:
    """The fit by the method asked for; with ``auto``, the first that is accepted.

    Raises
    ------
    FitError
        None is, and `strict`; the message is about the best.
    """
    methods = [str(options.method)]
    if options.method == "auto":
        methods = ["ridge", "lcurve"] + (["vendor-denominators"] if vendor is not None else [])
    fits = []
    for method in methods:
        fit = attempt(method)
        if not fit.verdict(options.tolerance):
            return fit
        fits.append(fit)
    best = min(fits, key=lambda fit: (not fit.min_denominator > 0, float(fit.max_ckp.max())))
    if strict:
        raise FitError(best.verdict(options.tolerance))
    return best
