"""Fit an RPC to any sensor model, or to given points, and certify it on points that the fit has not seen."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from barpc.errors import BarpcWarning, FitError
from barpc.fit.points import control_points, extent, numbers, screened, widened
from barpc.fit.solve import Solution, solve
from barpc.geodesy import Array, wrap_longitude
from barpc.options import FitOptions
from barpc.sensor import SensorModel
from barpc.sensor.rational import monomials
from barpc.sensor.rpc import RPC

_CHUNK = 8192  # points, check points too, worked on at a time, about
_LOOPS = 4096  # round trips that a table of points is tried on, about
_BEYOND = 1.25  # the box and 25 %


@dataclass(frozen=True, eq=False)
class RpcFit:
    """A fitted RPC and its certificate.

    Parameters
    ----------
    rpc : RPC
        The result.
    rmse_cnp, max_cnp : (2,)
        Root mean square and largest error of col, row on the control points [px].
    rmse_ckp, max_ckp : (2,)
        The same on the check points, which the fit has not seen [px].
    min_denominator : float
        Smallest denominator over the ground box and 25 % around it, over that at its centre; near or below 0: a pole.
    roundtrip : float
        Largest distance of a check point from where its projection is localised [px]; infinite where that fails.
    coverage : float
        Share of the image inside the convex hull of the control points.
    h : (2,)
        Regularisation used for col, row.
    iterations : int
        Passes over the points.
    num_cnp, num_ckp : int
        Number of points.
    method : str
        The solver whose result this is.
    """

    rpc: RPC
    rmse_cnp: Array
    max_cnp: Array
    rmse_ckp: Array
    max_ckp: Array
    min_denominator: float
    roundtrip: float
    coverage: float
    h: Array
    iterations: int
    num_cnp: int
    num_ckp: int
    method: str

    def summary(self) -> dict[str, Any]:
        """The certificate as plain numbers and lists, col before row, lengths in px."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "rpc"}
        return {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in values.items()}

    def verdict(self, tolerance: float) -> str:
        """What is wrong with this fit at a tolerance [px], in words; empty if nothing is."""
        worst = float(self.max_ckp.max())
        if not worst <= tolerance:
            return (
                f"the RPC misses its check points by up to {worst:.3g} px (RMSE col {self.rmse_ckp[0]:.3g}, "
                f"row {self.rmse_ckp[1]:.3g}), wanted {tolerance:g}: fit a smaller altitude range or a "
                "smaller image, or raise the tolerance"
            )
        if not self.min_denominator > 0:
            return "the RPC has a pole near the scene: use more control points or a stronger regularisation"
        if not self.roundtrip <= max(tolerance, 1e-6):
            return f"the RPC cannot be inverted over the scene (round trip {self.roundtrip:.3g} px)"
        return ""


@dataclass
class Errors:
    """Running root mean square and largest error of (N, 2) residuals [px]."""

    count: int = 0
    squares: Array = field(default_factory=lambda: np.zeros(2))
    largest: Array = field(default_factory=lambda: np.zeros(2))

    def add(self, residual: Array) -> None:
        """Take in residuals (N, 2); one that is NaN makes the result NaN."""
        if len(residual):
            self.count += len(residual)
            self.squares = self.squares + np.einsum("ij,ij->j", residual, residual)
            self.largest = np.maximum(self.largest, np.abs(residual.T).max(axis=1))

    @property
    def rmse(self) -> Array:
        """Root mean square (2,) [px]."""
        return np.asarray(np.sqrt(self.squares / self.count)) if self.count else np.full(2, np.nan)


def check_points(ground: Array) -> Iterator[Array]:
    """Middles (M, 3) of consecutive control points (n_x, n_y, n_alt, 3), the finite ones, some thousands at a time.

    Strictly inside the box, and never used by the fit.
    """
    step = max(1, _CHUNK // max(1, (ground.shape[1] - 1) * (ground.shape[2] - 1)))
    for start in range(0, ground.shape[0] - 1, step):
        middle = ground[start : start + step + 1]
        for axis in range(3):
            head = middle[(slice(None),) * axis + (slice(None, -1),)]
            tail = middle[(slice(None),) * axis + (slice(1, None),)]
            middle = 0.5 * (head + tail)
        flat = middle.reshape(-1, 3)
        yield flat[np.isfinite(flat).all(axis=1)]


def smallest_denominator(rpc: RPC, low: Array, high: Array) -> float:
    """Smallest denominator over a box `low`, `high` (3,) [deg, deg, m] and 25 % around it, over that at its centre."""
    corner = rpc.normalize(np.stack([low, high]))
    middle, half = corner.mean(axis=1), 0.5 * np.abs(corner[:, 1] - corner[:, 0])
    t = np.linspace(-_BEYOND, _BEYOND, 11)
    lattice = np.stack(np.meshgrid(t, t, t, indexing="ij")).reshape(3, -1)
    value = rpc.coeffs[1::2] @ monomials(middle[:, None] + half[:, None] * lattice)
    center = value[:, [lattice.shape[1] // 2]]
    return float((value / center).min())


def roundtrip(rpc: RPC, ground: Array) -> float:
    """Largest distance [px] between ground points (N, 3) and where their projections are localised."""
    image, jacobian = rpc.project_jacobian(ground)
    back = rpc.localize(image, ground[:, 2])
    miss = back - ground
    miss[:, 0] = wrap_longitude(miss[:, 0])
    distance = np.abs(np.einsum("nij,nj->ni", jacobian, miss))
    return float(distance.max(initial=0.0)) if np.isfinite(distance).all() else float("inf")


def coverage(image: Array, low: Array, high: Array) -> float:
    """Share of the rectangle `low`, `high` (2,) [px] inside the convex hull of image points (N, 2) [px]."""
    angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    direction = np.column_stack([np.cos(angle), np.sin(angle)])  # outside is beyond all in one direction
    reach = np.full(len(angle), -np.inf)
    for start in range(0, len(image), _CHUNK):
        part = (image[start : start + _CHUNK] - low) / (high - low)
        reach = np.maximum(reach, (direction @ part.T).max(axis=1))
    t = (np.arange(20) + 0.5) / 20
    cells = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    return float((cells @ direction.T <= reach + 1e-9).all(axis=1).mean())


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
        Altitudes that the RPC is for [m above the ellipsoid]; at least 100 m are taken around a flat scene.
    options : FitOptions, optional
        Grid, solver, tolerance.
    strict : bool
        Raise where the tolerance is missed; otherwise give the best fit found, to be judged by `RpcFit.verdict`.

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
    count = f"{np.count_nonzero(~ok)} of {ok.size} control points"
    message = f"{count} have no ground point and are left out: the RPC extrapolates there"
    warnings.warn(message, BarpcWarning, stacklevel=3)
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
        lon, lat [deg], alt [m above the ellipsoid]; all at one altitude give an RPC for that altitude only.
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
    """The fit by the method asked for, with ``auto`` the first accepted; without one the best, or a FitError on it."""
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
