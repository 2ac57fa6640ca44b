"""Fit an RPC to any sensor model, or to given points, and certify it."""

from __future__ import annotations

import numpy as np

from barpc.errors import FitError
from barpc.fit.certificate import Errors, RpcFit, coverage, roundtrip, smallest_denominator
from barpc.fit.grid import check_points, control_points, widened
from barpc.fit.options import FitOptions
from barpc.fit.solve import normalization, solve
from barpc.geodesy import Array
from barpc.sensor import SensorModel


def fit_rpc(
    model: SensorModel,
    size: tuple[int, int],
    alt_range: tuple[float, float],
    *,
    options: FitOptions | None = None,
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

    Returns
    -------
    RpcFit
        The RPC and its certificate on check points.

    Raises
    ------
    FitError
        The model cannot be localised over the image, or the RPC does not reach the tolerance.
    """
    options = options or FitOptions()
    ground, image = control_points(model, size, widened(alt_range), options)
    flat_ground, flat_image = ground.reshape(-1, 3), image.reshape(-1, 2)
    ok = np.isfinite(flat_ground).all(axis=1) & np.isfinite(flat_image).all(axis=1)
    if ok.mean() < 0.9:
        raise FitError(
            f"the model has no ground point for {1 - ok.mean():.0%} of the image over altitudes "
            f"{alt_range[0]:g} to {alt_range[1]:g} m: give an altitude range that it is made for"
        )
    cnp, cnp_image = (flat_ground, flat_image) if ok.all() else (flat_ground[ok], flat_image[ok])
    solution = solve(cnp, cnp_image, normalization(cnp, cnp_image, options), options)
    rpc = solution.rpc
    on_cnp, on_ckp, loop = Errors(), Errors(), 0.0
    on_cnp.add(rpc.project(cnp) - cnp_image)
    for middle in check_points(ground):
        on_ckp.add(rpc.project(middle) - model.project(middle))
        loop = max(loop, roundtrip(rpc, middle))
    fit = RpcFit(
        rpc=rpc,
        rmse_cnp=on_cnp.rmse,
        max_cnp=on_cnp.largest,
        rmse_ckp=on_ckp.rmse,
        max_ckp=on_ckp.largest,
        min_denominator=smallest_denominator(rpc, cnp.min(axis=0), cnp.max(axis=0)),
        roundtrip=loop,
        coverage=coverage(cnp_image, size),
        h=solution.h,
        iterations=solution.iterations,
        num_cnp=on_cnp.count,
        num_ckp=on_ckp.count,
        method=solution.method,
    )
    return accepted(fit, options)


def accepted(fit: RpcFit, options: FitOptions) -> RpcFit:
    """The fit itself.

    Raises
    ------
    FitError
        Its verdict at the tolerance is not empty.
    """
    verdict = fit.verdict(options.tolerance)
    if verdict:
        raise FitError(verdict)
    return fit


def unit_weight(sigma: Array | float | None, count: int) -> Array | None:
    """Weights (count,) of standard deviations, relative to the smallest; None if all are equal."""
    if sigma is None or np.ndim(sigma) == 0:
        return None
    value = np.asarray(sigma, dtype=np.float64)
    if value.shape != (count,) or not (np.isfinite(value).all() and (value > 0).all()):
        raise FitError(f"sigma: expected {count} positive numbers")
    return np.asarray(value.min() / value)
