"""Least squares of a quotient, the choice among fits, the search for the largest error: each by its definition."""

from __future__ import annotations

import json
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from barpc.base.errors import BarpcWarning, FitError
from barpc.base.geodesy import Array
from barpc.fit import FitOptions, Normalization, RpcFit, fit_rpc, fit_rpc_points
from barpc.fit import methods as solve_module
from barpc.fit import refit as fit_module
from barpc.fit.methods import normalization, solve, tidy
from barpc.fit.points import control_points
from barpc.fit.poles import Region
from barpc.fit.refit import _plainer
from barpc.fit.system import FitProblem
from barpc.sensor.rational import monomials
from barpc.sensor.rpc import RPC
from barpc.sensor.sampler import SAMPLE_CELLS, Scattered
from tests.fit.cameras import Camera, random_points, synthetic
from tests.fit.models import FLAT, made, quotient

# --- the least squares of a quotient -------------------------------------------------------------------------


def wavy(camera: Camera, count: int = 160, height: float = 2.0, seed: int = 3) -> tuple[Array, Array, Normalization]:
    """Points whose image swings by some pixels, as no RPC does."""
    ground, image = random_points(camera, count, np.random.default_rng(seed))
    bent = image + height * np.sin(image[:, ::-1] / 6000.0 + [0.3, 1.0])
    return ground, bent, camera.norm


def normalised(problem: FitProblem, axis: int) -> tuple[Array, Array]:
    """Terms (20, N) of the points, and a coordinate (N,) of theirs in units of the image scale."""
    norm = problem.norm
    basis = monomials(((problem.ground - norm.ground_offset) / norm.ground_scale).T)
    return basis, (problem.image[:, axis] - norm.image_offset[axis]) / norm.image_scale[axis]


def left(problem: FitProblem, coeffs: Array) -> Array:
    """What coefficients (4, 20) leave of the points (N, 2) [px], weighted."""
    norm = problem.norm
    rpc = RPC(coeffs, norm.ground_offset, norm.ground_scale, norm.image_offset, norm.image_scale)
    weight = 1.0 if problem.weight is None else problem.weight[:, None]
    return (rpc.project(problem.ground) - problem.image) * weight


def best(problem: FitProblem, axis: int, start: Array) -> float:
    """Sum of squares of the best numerator and denominator of a coordinate, by scipy, from coefficients (4, 20)."""
    basis, y = normalised(problem, axis)
    weight = 1.0 if problem.weight is None else problem.weight

    def residual(x: Array) -> Array:
        return weight * (quotient(x, basis) - y) * problem.norm.image_scale[axis]

    x = np.concatenate([start[2 * axis], start[2 * axis + 1, 1:]])
    return float((least_squares(residual, x, method="lm", xtol=1e-14, ftol=1e-14).fun ** 2).sum())


@pytest.mark.parametrize("weighted", [False, True])
def test_gauss_newton_ends_where_no_neighbour_is_better(camera: Camera, weighted: bool) -> None:
    ground, image, norm = wavy(camera)
    weight = np.random.default_rng(1).uniform(0.2, 1.0, len(ground)) if weighted else None
    problem = FitProblem(ground, image, norm, weight=weight)
    coeffs, solved, h, passes = solve_module.METHODS["gauss-newton"](problem)
    squares = (left(problem, coeffs) ** 2).sum(axis=0)
    for axis in range(2):
        assert squares[axis] <= 1.01 * best(problem, axis, coeffs)
    assert (h == 0).all()
    assert len(solved) == 2
    assert 2 <= passes <= 20
    ridge = solve_module.METHODS["ridge"](problem)[0]
    assert squares.sum() < (left(problem, ridge) ** 2).sum()


def test_rows_with_a_numerator_are_the_quotient_and_its_derivatives(camera: Camera) -> None:
    """M x - y is what is left at x, and M how it changes."""
    ground, image, norm = wavy(camera, 60)
    problem = FitProblem(ground, image, norm)
    for axis in range(2):
        numerator, denominator = camera.rpc.coeffs[2 * axis : 2 * axis + 2]
        rows = np.concatenate([r for _, r in problem.rows(axis, denominator, True, numerator)])
        x = np.concatenate([numerator, denominator[1:]])
        basis, y = normalised(problem, axis)
        np.testing.assert_allclose(rows[:, :-1] @ x - rows[:, -1], quotient(x, basis) - y, atol=1e-12)
        for k in (0, 3, 11, 20, 25, 38):
            step = 1e-6 * np.eye(39)[k]
            numeric = (quotient(x + step, basis) - quotient(x - step, basis)) / 2e-6
            np.testing.assert_allclose(rows[:, k], numeric, atol=1e-8)


def test_a_ridge_with_a_pole_makes_way_for_a_polynomial(camera: Camera, monkeypatch: Any) -> None:
    """Gauss-Newton begins with the best polynomials of the points, each coordinate with its own."""
    ground, image, norm = wavy(camera)
    problem, starts = FitProblem(ground, image, norm), []
    whole = solve_module._minimised

    def seen(problem: FitProblem, axis: int, x: Array, region: Region) -> Any:
        starts.append(x)
        return whole(problem, axis, x, region)

    monkeypatch.setattr(solve_module, "_minimised", seen)
    plain, *_ = solve_module._gauss_newton_fit(problem)
    ridge = solve_module._ridge(problem)
    np.testing.assert_array_equal(starts[0], np.concatenate([ridge[0][0], ridge[0][1, 1:]]))
    reach = -solve_module.region_of(problem).least(-np.eye(20)[1])  # of L: the image, and a tenth around it
    assert 1.05 < reach < 1.25
    for slope, kept in ((0.89 / reach, True), (0.91 / reach, False)):  # 1 - slope L: above a tenth, and below
        starts.clear()
        poles = ridge[0].copy()
        poles[1::2] = 0.0
        poles[1::2, 0], poles[1::2, 1] = 1.0, -slope
        monkeypatch.setattr(solve_module, "_ridge", lambda *_, poles=poles: (poles, *ridge[1:]))
        found, *_ = solve_module._gauss_newton_fit(problem)
        for axis in range(2):
            basis, y = normalised(problem, axis)
            polynomial = np.append(np.linalg.lstsq(basis.T, y, rcond=None)[0], np.zeros(19))
            given = np.concatenate([poles[2 * axis], poles[2 * axis + 1, 1:]])
            np.testing.assert_allclose(starts[axis], given if kept else polynomial, atol=1e-9)
        squares = (left(problem, found) ** 2).sum()
        assert squares <= 1.02 * (left(problem, plain) ** 2).sum()


def test_a_step_that_makes_things_worse_is_not_taken(camera: Camera) -> None:
    """From a start far off: the sum of squares never rises, and no denominator comes near zero."""
    ground, image, norm = wavy(camera, 120, 20.0)
    problem = FitProblem(ground, image, norm)
    rng, around = np.random.default_rng(0), np.full((3, 2), [-1.25, 1.25])
    for axis in range(2):
        start = np.concatenate([rng.normal(0, 1, 20), rng.normal(0, 0.02, 19)])
        above, below = problem.expanded(start)
        before = problem.compressed(axis, below, numerator=above).squares(start)
        x, system, passes = solve_module._minimised(problem, axis, start, Region.box(around))
        assert system.squares(x) < 0.1 * before
        assert Region.box(around).least(problem.expanded(x)[1]) > 0.1 - 1e-8
        assert passes <= 20
        basis, y = normalised(problem, axis)
        assert ((quotient(x, basis) - y) ** 2).sum() == pytest.approx(system.squares(x), rel=1e-9)


def test_numbers_are_tidied_to_twelve_digits() -> None:
    assert tidy(np.array([1.23456789012345, 1e-7 / 3, -2e5 / 3])).tolist() == [
        1.23456789012, 3.33333333333e-8, -66666.6666667,
    ]  # fmt: skip


def test_offsets_and_scales_are_the_middle_and_the_half_of_the_points() -> None:
    ground = np.array([[4.0, 42.0, 100.0], [6.0, 45.0, 900.0], [5.0, 44.0, 300.0]])
    image = np.array([[10.0, -20.0], [30.0, 60.0], [15.0, 0.0]])
    norm = normalization(ground, image)
    assert norm.ground_offset.tolist() == [5.0, 43.5, 500.0]
    assert norm.ground_scale.tolist() == [1.0, 1.5, 400.0]
    assert norm.image_offset.tolist() == [20.0, 20.0]
    assert norm.image_scale.tolist() == [10.0, 40.0]
    flat = normalization(ground * [0, 0, 0] + [5.0, 43.0, 7.0], image * 0)
    assert flat.ground_scale.tolist() == [1e-9, 1e-9, 50.0]
    assert flat.image_scale.tolist() == [1e-6, 1e-6]


# --- which fit is taken ----------------------------------------------------------------------------------------


POLES = [{"min_denominator": least, "max_ckp": np.full(2, 0.02)} for least in (-0.1, 0.0, float("nan"))]
WORSE = {"max_ckp": np.full(2, 0.03)}
EXACT = {"max_ckp": np.full(2, 1e-8)}


@pytest.mark.parametrize(
    ("ridge", "newton", "how", "taken"),
    [
        # the least squares are looked for where a ridge leaves a millionth of a pixel of a model, and only there
        ({"max_ckp": np.array([0.9e-6, 1e-9])}, None, {}, "ridge"),
        ({"max_ckp": np.array([1.1e-6, 1e-9])}, {"rmse_ckp": np.full(2, 1.0)}, {}, "ridge"),
        ({}, None, {"exact": False}, "ridge"),
        ({}, None, {"method": "ridge"}, "ridge"),
        # and where it has a pole, however exact it is
        *((pole | EXACT, {"min_denominator": 0.4}, {}, "gauss-newton") for pole in POLES),
        ({"min_denominator": 0.09} | EXACT, {"min_denominator": 0.4}, {}, "gauss-newton"),
        # of accepted fits the one with the least error
        ({"rmse_ckp": np.array([3e-3, 4e-3])}, {"rmse_ckp": np.array([4.5e-3, 1e-3])}, {}, "gauss-newton"),
        ({"rmse_ckp": np.array([3e-3, 4e-3])}, {"rmse_ckp": np.array([5.1e-3, 0.0])}, {}, "ridge"),
        ({"max_ckp": np.full(2, 0.1), "rmse_ckp": np.zeros(2)}, {}, {}, "gauss-newton"),
        ({"max_ckp": np.full(2, 0.1)}, None, {"exact": False}, r"0\.1 px"),
        ({"max_ckp": np.full(2, 0.1)}, None, {"method": "ridge"}, r"0\.1 px"),
        # one with a pole gives way to one without, if that is accepted or nobody asks
        *((pole, WORSE, {"tolerance": 0.1}, "gauss-newton") for pole in POLES),
        *((pole, WORSE, {"tolerance": 0.01, "strict": False}, "gauss-newton") for pole in POLES),
        *((pole, WORSE, {"tolerance": 0.01}, r"0\.03 px") for pole in POLES),
        ({"max_ckp": np.full(2, 0.02)}, WORSE, {"tolerance": 0.01, "strict": False}, "ridge"),
    ],
)
def test_of_several_fits_the_best_is_taken(ridge, newton, how, taken) -> None:
    fits = {"ridge": made(**ridge)} | (
        {} if newton is None else {"gauss-newton": made(method="gauss-newton", **newton)}
    )
    tried: list[str] = []
    given = dict(how)
    strict, exact = given.pop("strict", True), given.pop("exact", True)

    def attempt(method: str) -> RpcFit:
        tried.append(method)
        return fits[method]

    with pytest.raises(FitError, match=taken) if " px" in taken else nullcontext():
        assert fit_module.best_method(attempt, FitOptions(**given), strict, exact).method == taken
    assert tried == list(fits)


@pytest.mark.parametrize(
    ("rmse", "least", "plain"), [(1.09, 0.5, True), (1.12, 0.5, False), (1.5, 0.0, True), (1.5, -1.0, True)]
)
def test_behind_a_spline_the_calmer_fit_is_taken_where_it_is_a_tenth_worse_at_most(rmse, least, plain) -> None:
    fit = made(rmse_ckp=np.array([0.6, 0.8]), min_denominator=least)
    other = made(rmse_ckp=np.array([0.8, 0.6]) * rmse, method="lcurve-joint")
    assert (_plainer(fit, other) is other) == plain


def test_what_a_file_lost_is_added_to_the_errors() -> None:
    fit = made()
    written = fit.as_written(fit.rpc.crop(3.0, -4.0))
    np.testing.assert_allclose(written.rmse_ckp, [3.003, 4.003], atol=1e-9)
    np.testing.assert_allclose(written.max_ckp, [3.005, 4.005], atol=1e-9)
    np.testing.assert_array_equal(written.rmse_cnp, fit.rmse_cnp)
    told = json.loads(json.dumps(fit.summary()))
    assert told["rmse_ckp"] == [3e-3, 3e-3]
    assert "rpc" not in told


def test_a_model_without_ground_for_a_tenth_of_its_image_is_refused() -> None:
    """One point in each of 45 x 45 cells: four of 45 rows of them may be without, five may not."""
    camera = synthetic()

    class Holed:
        def __init__(self, cells: int) -> None:
            self.below = cells / SAMPLE_CELLS * camera.size[1] - 0.5

        def localize(self, image: Any, alt: Any) -> Any:
            ground = camera.model.localize(image, alt)
            return np.where(image[..., 1:] < self.below, np.nan, ground)

        def __getattr__(self, name: str) -> Any:
            return getattr(camera.model, name)

    with pytest.warns(BarpcWarning, match=r"^8\.9% of the image has no ground point"):
        fit = fit_rpc(Holed(4), camera.size, camera.alt_range)  # type: ignore[arg-type]
    assert fit.coverage < 1.0
    assert fit.max_ckp.max() < 1e-6
    assert fit.num_ckp == 41 * 45
    with pytest.raises(FitError, match=r"no ground point for 11% of the image over altitudes 0 to 1000 m"):
        fit_rpc(Holed(5), camera.size, camera.alt_range)  # type: ignore[arg-type]


def test_the_points_of_an_image_cover_it_from_corner_to_corner() -> None:
    """However small it is; given points cover what they cover of the image that is stated."""
    camera = synthetic()
    assert fit_rpc(camera.model, (8, 6), camera.alt_range, options=FitOptions(method="ridge")).coverage == 1.0
    rng = np.random.default_rng(0)
    image = rng.uniform(-0.5, 9.5, (600, 2))
    image[:4] = [[-0.5, -0.5], [9.5, -0.5], [9.5, 9.5], [-0.5, 9.5]]
    ground = camera.model.localize(image, rng.uniform(0, 1000, 600))
    for size, share in (((10, 10), 1.0), ((20, 10), 0.5), ((20, 40), 0.125), (None, 1.0)):
        fit = fit_rpc_points(ground, image, size=size, options=FitOptions(method="ridge"), strict=False)
        assert fit.coverage == pytest.approx(share, abs=0.001)


def test_the_certificate_counts_what_it_says(camera: Camera) -> None:
    options = FitOptions(grid=(6, 7, 5), method="ridge")
    fit = fit_rpc(camera.model, camera.size, camera.alt_range, options=options)
    assert (fit.num_cnp, fit.num_ckp) == (6 * 7 * 5, SAMPLE_CELLS**2)
    assert fit.beyond == pytest.approx(1 - 0.05 ** (1 / SAMPLE_CELLS**2), rel=1e-9)
    ground, image = (
        p.reshape(-1, k)
        for p, k in zip(control_points(camera.model, camera.size, camera.alt_range, options), (3, 2), strict=True)
    )
    error = fit.rpc.project(ground) - image
    np.testing.assert_allclose(fit.rmse_cnp, np.sqrt((error**2).mean(axis=0)), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(fit.max_cnp, np.abs(error).max(axis=0), rtol=1e-6, atol=1e-12)
    scattered = solve(ground, image, FitOptions(method="ridge"), "ridge")
    np.testing.assert_allclose(scattered.rpc.project(ground), fit.rpc.project(ground), atol=1e-7)


# --- looking for the largest error -----------------------------------------------------------------------------


@pytest.mark.slow
def test_around_the_worst_points_of_either_coordinate_more_are_looked_at_closer_and_closer() -> None:
    camera = synthetic()
    sample = Scattered.over(FLAT, camera.size, camera.alt_range)
    assert sample.count == SAMPLE_CELLS**2
    assert len(sample.points) == SAMPLE_CELLS**2 + 12 * 2 * 2 * 2  # along the edges, at either end of the altitudes
    scale, low = np.array([*camera.size, 1000.0]), np.array([-0.5, -0.5, 0.0])
    peaks = np.array([[0.3, 0.4, 0.6], [0.8, 0.7, 0.2]])  # of col and of row
    asked: list[Array] = []

    def hills(at: Array) -> Array:
        unit = (at - low) / scale
        asked.append(unit)
        distance = np.linalg.norm((unit[:, None] - peaks) * [1.0, 1.0, 0.1], axis=-1)
        return np.exp(-((distance / 0.1) ** 2)) * [1.0, -2.0]

    errors = sample.compare(lambda ground: ground[:, :2] + hills(ground))
    largest = errors.largest
    assert len(asked) == 1 + 5
    assert [len(points) for points in asked[1:]] == [2 * 16 * 8] * 5
    known, reach = asked[0], np.array([1 / 45, 1 / 45, 0.25])
    for points in asked[1:]:
        shift = np.abs(points[:, None] - known) / reach
        nearest = shift.max(axis=-1).min(axis=1)
        assert nearest.max() <= 1.0 + 1e-9
        worst = [np.argsort(-np.abs(hills(known * scale + low))[:, k], kind="stable")[:16] for k in range(2)]
        asked.pop()
        of_worst = np.repeat(np.unique(np.concatenate(worst)), 8)
        moved = np.abs(points - known[of_worst]) / reach
        assert moved.max() <= 1.0 + 1e-9
        assert moved.max() > 0.97
        known, reach = np.concatenate([known, points]), reach / 2
    np.testing.assert_allclose(largest, [1.0, 2.0], rtol=2e-3)
    assert (largest >= np.abs(hills(asked[0] * scale + low)).max(axis=0)).all()
    first = np.abs(hills(asked[0] * scale + low))[: sample.count]
    np.testing.assert_allclose(errors.rmse, np.sqrt((first**2).mean(axis=0)))


@pytest.mark.parametrize(("size", "rounds"), [(0.9e-6, 0), (1.1e-6, 5)])
def test_rounding_is_not_looked_into(size: float, rounds: int) -> None:
    camera = synthetic()
    sample = Scattered.over(FLAT, camera.size, camera.alt_range)
    asked: list[int] = []

    def level(ground: Array) -> Array:
        asked.append(len(ground))
        return ground[:, :2] + size

    assert sample.compare(level).largest == pytest.approx([size, size], abs=1e-11)
    assert len(asked) == 1 + rounds
