"""Fit an RPC to any sensor model, and certify it on points that the fit has not seen."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from barpc.base.errors import BarpcWarning, FitError
from barpc.base.geodesy import WGS84_A, Array, ecef_from_ground, wrap_longitude
from barpc.base.options import FitOptions
from barpc.fit.certificate import RpcFit, coverage, reason, roundtrip
from barpc.fit.methods import FitSolution, solve
from barpc.fit.points import column_ranges, control_points, screened, widened
from barpc.fit.poles import MIN_DENOMINATOR_RATIO
from barpc.sensor import SensorModel
from barpc.sensor.direct_grid import nodes_of
from barpc.sensor.geometry import LEAST_RANGE
from barpc.sensor.image_corrections import Calibrated, Splined
from barpc.sensor.rpc import RPC
from barpc.sensor.sampler import NEGLIGIBLE_FIT_ERROR, Errors, Scattered

BETTER = 0.9
"""Times the error left out: what is less plain must be better by a tenth, the scatter of an error of 16 points."""
_MAX_MISSING_SHARE = 0.1  # part of the image without a ground point, at most
_SCATTERED_CELLS = 72  # of ``gauss-newton``, along each side of the image


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
    model : SensorModel, any camera: an RPC behind a correction, a pushbroom or radar model
    size : (width, height), image that the RPC is for [px]
    alt_range : (low, high), altitudes [m above the ellipsoid]; at least 100 m are taken around a flat scene
    options : FitOptions, optional, grid, solver, tolerance
    strict : bool
        Raise where the tolerance is missed; otherwise give the best fit found, to be judged by `RpcFit.verdict`. A
        camera behind a spline (`barpc.sensor.image_corrections`) is expected to miss it.

    Returns
    -------
    RpcFit, the RPC and its certificate

    Raises
    ------
    FitError
        The model cannot be localised over the image, its two directions contradict each other, it exchanges longitude
        and latitude or the altitude's sign (`wrong_axes`, not of one built on an RPC), or the RPC does not reach the
        tolerance.

    Warns
    -----
    BarpcWarning : part of the image has no ground point

    Examples
    --------
    >>> rpc = barpc.read_rpc("data_samples/view_00.tif")
    >>> bool(barpc.fit_rpc(rpc, (1000, 1000), (0.0, 400.0)).max_ckp.max() < 1e-6)
    True
    """
    return _fit_model(model, size, alt_range, options, strict)


def _fit_model(
    model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float], options: FitOptions | None, strict: bool
) -> RpcFit:
    options, alt_range = options or FitOptions(), widened(alt_range)
    sample = _check_sample(model, size, alt_range)
    screened(sample.ground, sample.points[:, :2])
    contradiction = sample.contradiction()
    # the lines of sight of an RPC are cubics' own
    axes = "" if isinstance(innermost(model), RPC) else wrong_axes(model, size, alt_range)

    def attempt(method: str, source: SensorModel = model) -> RpcFit:
        solution = solve(*_points_for_method(source, size, alt_range, options, method), options, method)
        loop, beyond = roundtrip(solution.rpc, sample.ground), 1.0 - 0.05 ** (1.0 / sample.count)
        errors = sample.compare(solution.rpc.project)
        return replace(certified(solution, errors, loop, size, beyond), contradiction=contradiction, axes=axes)

    try:
        fit = best_method(attempt, options, False, exact=True)
        if isinstance(model, Splined | Calibrated):
            fit = _plainer(fit, attempt("ridge", model.sensor))
        if not float(fit.max_ckp.max()) <= options.tolerance:
            fit = replace(fit, reason=reason(fit.rpc, sample))
        return accepted(fit, options, strict and not isinstance(model, Splined | Calibrated))
    except FitError as error:
        advice = getattr(model, "advice", "")  # of a model that knows why
        raise FitError("; ".join(filter(None, (str(error), advice)))) from error


def fit_only(model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float]) -> RPC:
    """Return the RPC of a sensor model by ``ridge``, without a certificate: the caller measures its misfit."""
    options = FitOptions()
    return solve(*_points_for_method(model, size, widened(alt_range), options, "ridge"), options, "ridge").rpc


def _check_sample(model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float]) -> Scattered:
    """Return the check points of a model; FitError where it has no ground for too much of its image."""
    sample = Scattered.over(model, size, alt_range)
    if sample.missing > _MAX_MISSING_SHARE:
        raise FitError(
            f"the model has no ground point for {sample.missing:.0%} of the image over altitudes "
            f"{alt_range[0]:g} to {alt_range[1]:g} m: give an altitude range that it is made for"
        )
    if sample.missing > 0:
        message = f"{sample.missing:.1%} of the image has no ground point and is left out: the RPC extrapolates there"
        warnings.warn(message, BarpcWarning, stacklevel=3)
    return sample


def _plainer(fit: RpcFit, plain: RpcFit) -> RpcFit:
    """Choose between two RPCs for a camera behind a spline: the one made without the spline where it is about as good.

    Its denominators are calmer; jitter that is faster than cubics of the row only makes the other one wave.
    """
    error, other = (float(np.linalg.norm(one.rmse_ckp)) for one in (fit, plain))
    return plain if error >= BETTER * other or not fit.min_denominator > 0 else fit


def _points_for_method(
    model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float], options: FitOptions, method: str
) -> tuple[Array, Array]:
    """Return the ground (N, 3) and image points (N, 2) for a method."""
    if method == "gauss-newton":  # what an RPC cannot follow has any frequency: scattered points alias none
        scattered = Scattered.over(model, size, alt_range, _SCATTERED_CELLS, seed=1)
        ground, image = scattered.ground, scattered.points[:, :2]
    else:
        grid = control_points(model, size, alt_range, options)
        ground, image = grid[0].reshape(-1, 3), grid[1].reshape(-1, 2)
    known = np.isfinite(ground).all(axis=1) & np.isfinite(image).all(axis=1)
    ground, image = ground[known], image[known]
    if len(ground):
        ground[:, 0] = wrap_longitude(ground[:, 0], ground[0, 0])
    return ground, image


def innermost(model: object) -> object:
    """Return the camera that a model's corrections stand in front of, or itself."""
    while (inner := getattr(model, "sensor", None)) is not None:
        model = inner
    return model


def certified(
    solution: FitSolution, seen: Errors, loop: float, size: tuple[int, int] | None, beyond: float = 1.0
) -> RpcFit:
    """Return the fit with its certificate: errors on the check points, the largest found near them."""
    problem, rpc = solution.problem, solution.rpc
    ground, image = problem.ground, problem.image
    used = Errors()
    used.add(rpc.project(ground) - image)
    left, right = column_ranges(image)
    if size is not None:
        left, right = np.full(2, -0.5), np.asarray(size) - 0.5
    return RpcFit(
        rpc=rpc,
        rmse_cnp=used.rmse,
        max_cnp=used.largest,
        rmse_ckp=seen.rmse,
        max_ckp=seen.largest,
        beyond=beyond,
        min_denominator=solution.region.smallest(rpc.coeffs[1::2]),
        roundtrip=loop,
        coverage=coverage(image, left, right),
        h=solution.h,
        iterations=solution.iterations,
        num_cnp=used.count,
        num_ckp=seen.count,
        method=solution.method,
    )


def accepted(fit: RpcFit, options: FitOptions, strict: bool) -> RpcFit:
    """Return the fit; FitError where `strict` and something is wrong with it."""
    if strict and (wrong := fit.verdict(options.tolerance)):
        raise FitError(wrong)
    return fit


def best_method(attempt: Callable[[str], RpcFit], options: FitOptions, strict: bool, exact: bool) -> RpcFit:
    """Return the fit by the method asked for; of several (``auto``) the best accepted, or else the best, or a FitError.

    Points of a model are `exact`: what a ridge leaves of them is misfit, and the least squares of that are looked for;
    so they are where the ridge has a pole near the scene.
    """
    if options.method != "auto":
        return accepted(attempt(str(options.method)), options, strict)
    fits = [attempt("ridge")]
    calm = fits[0].min_denominator >= MIN_DENOMINATOR_RATIO
    if exact and not (calm and float(fits[0].max_ckp.max()) <= NEGLIGIBLE_FIT_ERROR):
        fits.append(attempt("gauss-newton"))
    wrong = [fit.verdict(options.tolerance) for fit in fits]
    rank = [
        (bool(said), not fit.min_denominator >= MIN_DENOMINATOR_RATIO, float(np.linalg.norm(fit.rmse_ckp)))
        for said, fit in zip(wrong, fits, strict=True)
    ]
    return accepted(fits[rank.index(min(rank))], options, strict)


# --- axes of a model ------------------------------------------------------------------------------------
#
# By its lines of sight. A mirrored image tells nothing: detectors are numbered to the left of the flight or to the
# right. But the lines of sight of a row of an optical image meet where the camera stood, or those of a column, and a
# radar's row lies in a plane, that of its beam. On a round Earth both hold in the right order and with the right sign
# only. A camera stands above.


_POINT, _PLANE = 100.0, 1e4
"""Times that another reading is better before it is accepted. Errors of a model are common to all its readings: of 160
honest models none was better by more than 2.2 in a wrong one; one over a flat Earth may be by tens, its planes by 2000.
Of models with axes exchanged or upside down physical ones were better by 320 and more, the planes of radars by 5e6."""
_FLAT_CONVERGENCE = 2.0 / WGS84_A  # 1/m: of a camera's distance; verticals meet at the Earth's centre, -1 / WGS84_A
_ECEF_ROUNDING = 1e-8  # m: of places in ECEF, and of what iterations leave
_MIN_NODES = 5  # nodes along a line: of few lines of sight any two or three meet
_LINE_POSITIONS, _POINT_POSITIONS = np.linspace(0.1, 0.9, 5), np.linspace(0.02, 0.98, 9)  # of the image's sides


def wrong_axes(model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float]) -> str:
    """Return the fault in the ground axes of a model over an image of `size` and altitudes [m], in words; or empty.

    Exchanged longitude and latitude, or altitudes that grow downwards; of models with a noise of some 1e-3 px, of
    places where both orders are about the same (lon = lat = 0) and lines of sight of neither kind nothing is said.
    """
    rows = np.stack(np.meshgrid(_POINT_POSITIONS, _LINE_POSITIONS), axis=-1)
    places = np.stack([rows, rows[..., ::-1]]) * size - 0.5
    image = np.repeat(places[..., None, :], 2, axis=-2)
    alt = np.broadcast_to(alt_range, image.shape[:-1])
    ground = model.localize(image, alt)
    return _geometry_fault(np.concatenate([ground[..., :2], alt[..., None]], axis=-1))  # whatever altitude it gave back


def wrong_axes_of_grid(ground: Array, image: Array) -> str:
    """Return the same of points (N, 3), (N, 2) that are all the nodes of a grid; of others nothing is said."""
    (alts, *sides), nodes = nodes_of(ground, image)
    if nodes is None or np.ptp(alts) < LEAST_RANGE or min(map(len, sides)) < _MIN_NODES:
        return ""
    nodes = np.moveaxis(nodes[[0, -1]], 0, 2)  # rows, columns, low and high
    (row, rows), (col, cols) = (
        [(part * (len(side) - 1)).round().astype(int) for part in (_LINE_POSITIONS, _POINT_POSITIONS)] for side in sides
    )
    return _geometry_fault(np.stack([nodes[np.ix_(row, cols)], nodes[np.ix_(rows, col)].swapaxes(0, 1)]))


def _geometry_fault(ground: Array) -> str:
    """Return the fault of ground points (2, lines, points, 2, 3) of rows and of columns, at two altitudes."""
    point, plane, _ = _sights(ground)
    for what, other in _interpretations(ground):
        at, within, near = _sights(other)
        if near > _FLAT_CONVERGENCE and (point > _POINT * at or plane > _PLANE * within):
            return f"the model's lines of sight are those of a camera only {what}: give lon, lat [deg], alt [m], up"
    return ""


def _interpretations(ground: Array) -> Iterator[tuple[str, Array]]:
    """Yield alternative axes, in words and as ground points, the lower altitude first."""
    yield "with the altitude's sign changed", ground[..., ::-1, :] * [1.0, 1.0, -1.0]
    if np.nanmax(np.abs(ground[..., 0]), initial=0.0) < 90.0:
        yield "with longitude and latitude exchanged", ground[..., [1, 0, 2]]


def _sights(ground: Array) -> tuple[float, float, float]:
    """Return how far lines of sight are from a point and a plane, of rows or columns, whichever are nearer.

    Of ground points (2, lines, points, 2, 3) at two altitudes: root mean square angles [rad], thickness over length,
    and the largest 1 / distance of the point [1/m], above positive; NaN where no line is all on the ground.
    """
    known = [
        np.array([bundle_of_lines(ecef_from_ground(one)) for one in lines if np.isfinite(one).all()])
        for lines in ground
    ]
    known = [bundles for bundles in known if len(bundles)]
    if not known:
        return np.nan, np.nan, np.nan
    point, plane = np.min([np.sqrt((bundles[:, :2] ** 2).mean(axis=0)) for bundles in known], axis=0).tolist()
    return point, plane, max(float(bundles[:, 2].mean()) for bundles in known)


def bundle_of_lines(ecef: Array) -> tuple[float, float, float]:
    """Return how far lines through pairs of points (n, 2, 3) [m] are from a bundle, and 1 / distance of its centre.

    From one point: the RMS angle [rad] between them and lines through the centre; from one plane: the thickness of all
    points over their width; and [1/m]. LinAlgError for points that are not finite.

    A line through o with the slope t across the mean direction m passes the point at the distance h along m where
    o + h t is one for all: (o - (o m) (m + t)) / h - g = -t, linear in 1 / h and g.
    """
    ecef = ecef - ecef.mean(axis=(0, 1))
    sight = ecef[:, 1] - ecef[:, 0]
    mean = sight.sum(axis=0) / np.linalg.norm(sight.sum(axis=0))
    slope, depth = sight / (sight @ mean)[:, None] - mean, (ecef[:, 0] @ mean)[:, None]
    across = ecef[:, 0] - depth * (mean + slope)
    width = np.abs(across).max() or 1.0
    system = np.column_stack([across.ravel() / width, np.tile(np.eye(3), (len(ecef), 1))])
    found = np.linalg.lstsq(system, -slope.ravel(), rcond=None)[0]
    off, rounding = system @ found + slope.ravel(), _ECEF_ROUNDING / np.linalg.norm(sight, axis=1).min()
    spread = np.linalg.svd(ecef.reshape(-1, 3), compute_uv=False)
    thickness = (spread[2] + _ECEF_ROUNDING) / spread[0]
    return float(np.sqrt((off**2).mean()) + rounding), float(thickness), float(found[0] / width)
