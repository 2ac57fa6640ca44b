"""Certificate, weights, poles, corner and every option of the fit, each against its plain definition."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from barpc.base.errors import FitError, InputError
from barpc.base.geodesy import Array, metres_per_unit
from barpc.fit import FitOptions, RpcFit, fit_rpc, fit_rpc_points
from barpc.fit.certificate import coverage, roundtrip
from barpc.fit.given import relative_weight
from barpc.fit.methods import METHODS, _reweighted, corner
from barpc.fit.points import control_points, screened, spaced, terrain_range
from barpc.fit.poles import smallest_denominator
from barpc.fit.refit import innermost
from barpc.fit.system import FitProblem, TriangularSystem, expected_size, noise_scaled, solution
from barpc.sensor.rpc import RPC
from barpc.sensor.sampler import Errors
from tests.constants import CONSTANTS, chosen
from tests.fit.cameras import Camera, random_points, synthetic_rpc
from tests.fit.models import Bent, made, waves

ALL = np.arange(20)

# --- every option ------------------------------------------------------------------------------------------


class Row(NamedTuple):
    """An option from one value to another, and what grows (1) or shrinks (-1) by it."""

    field: str
    low: Any
    high: Any
    observable: Callable[[RpcFit], float]
    sign: int
    rest: dict[str, Any] = {}  # noqa: RUF012 - never changed
    noise: float = 0.0


def denominators(fit: RpcFit) -> float:
    return float(np.abs(fit.rpc.coeffs[1::2, 1:]).sum())


ROWS = [
    Row("method", "ridge", "lcurve-joint", lambda fit: fit.iterations, 1, {"grid": (6, 6, 5)}, 0.3),
    Row("grid", (5, 5, 4), (8, 7, 6), lambda fit: fit.num_cnp, 1),
    Row("tau", 1e-5, 1e-1, denominators, 1, {"method": "ridge"}, 0.3),
]
ELSEWHERE = {
    "weighted": "test_weighted_passes_are_made_where_the_denominator_varies",
    "space": "test_the_grid_is_regular_where_it_is_asked_for",
    "tolerance": "test_the_tolerance_decides_whether_a_fit_is_accepted",
    "pole_margin": "test_a_wider_margin_keeps_denominators_up_farther_out",
}


def test_every_option_has_a_row() -> None:
    assert {row.field for row in ROWS} | set(ELSEWHERE) == {field.name for field in fields(FitOptions)} | set(
        CONSTANTS[FitOptions]
    )
    assert set(ELSEWHERE.values()) <= set(globals())


class Shaking:
    """A camera whose image points are noisy, the same at every call."""

    def __init__(self, camera: Camera, noise: float) -> None:
        self.camera, self.noise = camera, noise

    def project(self, ground: Any) -> Any:
        image = self.camera.model.project(ground)
        phase = np.sum(np.asarray(ground) * [1e6, 1.7e6, 13.0], axis=-1)[..., None]
        return image + self.noise * np.sin(phase + [0.0, 1.0])

    def localize(self, image: Any, alt: Any) -> Any:
        return self.camera.model.localize(image, alt)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.camera.model, name)


@pytest.mark.few(2)
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.field)
def test_an_option_changes_the_result_in_its_direction(camera: Camera, row: Row) -> None:
    found = []
    for value in (row.low, row.high):
        model: Any = Shaking(camera, row.noise) if row.noise else camera.model
        with chosen(FitOptions, **{"space": "ground", **row.rest, row.field: value}) as options:
            fit = fit_rpc(model, camera.size, camera.alt_range, options=options, strict=False)
        found.append(row.observable(fit))
    assert (found[1] - found[0]) * row.sign > 0.05 * abs(found[0]), found


def test_weighted_passes_are_made_where_the_denominator_varies(camera: Camera) -> None:
    """Residuals count by 1 / b: a table whose b runs from 0.6 to 1.4 is met better with it, pass by pass."""
    rpc = _with_denominator(0, 0.4)
    ground = camera.model.localize(*_image_points(camera, 600))
    exact = rpc.project(ground)
    noisy = exact + np.random.default_rng(1).normal(0, 0.3, exact.shape)
    for passes in (0, 1, 3):
        with chosen(FitOptions, method="ridge", weighted=passes, tolerance=5.0, tau=1.0) as options:
            fit = fit_rpc_points(ground, noisy, options=options, strict=False)
        assert fit.iterations == 1 + passes
    with chosen(FitOptions, weighted=3) as options:
        flat = fit_rpc(camera.model, camera.size, camera.alt_range, options=options)
    assert flat.iterations == 1  # within 5 %


@pytest.mark.parametrize("sides", ["lon", "lat", "alt"])
def test_a_denominator_that_varies_along_any_axis_weights_a_second_pass(camera: Camera, sides: str) -> None:
    for slope, passes in ((0.4, 2), (0.04, 1)):
        rpc = _with_denominator(0, slope, sides)
        ground = camera.model.localize(*_image_points(camera, 600))
        fit = fit_rpc_points(ground, rpc.project(ground), options=FitOptions(method="ridge", tolerance=1.0))
        assert fit.iterations == passes


def test_the_regularisation_is_the_noise_over_the_size_expected(camera: Camera) -> None:
    """Both in units of an image coordinate over its scale; a denominator is expected within 0.003 of 1."""
    ground, image = random_points(camera, 2500, np.random.default_rng(7))
    noisy = image + np.random.default_rng(8).normal(0, 1, image.shape) * [0.2, 0.6]
    fit = fit_rpc_points(ground, noisy, options=FitOptions(method="ridge", tolerance=5.0))
    assert fit.h * fit.rpc.image_scale * 0.003 == pytest.approx([0.2, 0.6], rel=0.1)


def _image_points(camera: Camera, count: int) -> tuple[Any, Any]:
    rng = np.random.default_rng(6)
    return rng.uniform(0, 1, (count, 2)) * camera.size, rng.uniform(*camera.alt_range, count)


def test_the_grid_is_regular_where_it_is_asked_for(camera: Camera) -> None:
    for space in ("image", "ground"):
        options = FitOptions(grid=(5, 6, 4), space=space)
        ground, image = control_points(camera.model, camera.size, (100.0, 400.0), options)
        assert ground.shape == (5, 6, 4, 3)
        np.testing.assert_allclose(camera.model.project(ground), image, atol=1e-6)
        regular = image if space == "image" else ground
        for axis, count in ((0, 5), (1, 6)):
            ends = regular[..., axis].min(), regular[..., axis].max()
            nodes = spaced(*ends, count, even=space == "ground")
            along = np.moveaxis(regular[..., axis], axis, -1)
            np.testing.assert_allclose(along, np.broadcast_to(nodes, along.shape), atol=1e-6)
        np.testing.assert_allclose(ground[0, 0, :, 2], spaced(100, 400, 4, even=space == "ground"))
        if space == "image":
            assert image[0, 0, 0].tolist() == [-0.5, -0.5]
            assert image[-1, -1, -1].tolist() == [camera.size[0] - 0.5, camera.size[1] - 0.5]


@pytest.mark.slow
def test_a_wider_margin_keeps_denominators_up_farther_out(camera: Camera) -> None:
    """The same misfit under two margins: the narrower, the better, and the smaller what is a step outside."""
    bent = Bent(camera.model, lambda at: np.stack([20.0 * np.exp(6e-4 * (at[..., 0] - 2e4)), 0.0 * at[..., 0]], -1))
    narrow, wide = (
        fit_rpc(bent, camera.size, camera.alt_range, options=FitOptions(pole_margin=margin), strict=False)
        for margin in (0.0, 0.5)
    )
    assert np.linalg.norm(narrow.rmse_ckp) < 0.5 * np.linalg.norm(wide.rmse_ckp)
    middle, half = camera.rpc.ground_offset, camera.rpc.ground_scale
    outside = [smallest_denominator(fit.rpc, middle - half, middle + half) for fit in (narrow, wide)]
    assert outside[0] < outside[1]


def test_the_tolerance_decides_whether_a_fit_is_accepted(camera: Camera) -> None:
    model: Any = Bent(camera.model, waves(20000, 3.0, 0.3))
    worst = fit_rpc(model, camera.size, camera.alt_range, options=FitOptions(method="ridge"), strict=False)
    most = float(worst.max_ckp.max())
    assert 0.1 < most < 1.0
    loose = FitOptions(method="ridge", tolerance=most * 1.01)
    assert fit_rpc(model, camera.size, camera.alt_range, options=loose).verdict(loose.tolerance) == ""
    missed = rf"misses its check points by up to .* wanted {most * 0.99:.2g}"
    assert re.search(missed, worst.verdict(most * 0.99))
    with pytest.raises(FitError, match=missed):
        fit_rpc(model, camera.size, camera.alt_range, options=FitOptions(method="ridge", tolerance=most * 0.99))


def test_points_of_a_strip_are_as_mirrored_as_the_whole(camera: Camera) -> None:
    ground, image = random_points(camera, 2000, np.random.default_rng(0))
    strip = image[:, 1] < 0.15 * camera.size[1]  # its pixels are as square as those of the whole
    for rows in (slice(300), strip):
        for sign in (1.0, -1.0):
            assert screened(ground[rows], (image * [sign, 1.0])[rows])[2] == (sign < 0)


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-6])
def test_a_scene_of_any_size_is_one_in_space(camera: Camera, size: float) -> None:
    """Shrunk in longitude and latitude, to a hand's width at last: not flat for that; its diagonal plane still is."""
    ground, image = random_points(camera, 300, np.random.default_rng(0))
    middle = ground.mean(axis=0)
    small = middle + (ground - middle) * [size, size, 1.0]
    screened(small, image)
    small[:, 1] = middle[1] + (small[:, 0] - middle[0])
    with pytest.raises(FitError, match="in a plane"):
        screened(small, image)


@pytest.mark.parametrize(
    ("jacobian", "mirrored"),
    [
        ([[2, 0], [0, 2]], True), ([[2, 0], [0, -2]], False),  # mirrored; as seen from above
        ([[2, 0], [0, 1.02]], True), ([[2, 0], [0, 0.98]], False), ([[0.98, 0], [0, 2]], False),
        ([[1.02, 0], [0, 2]], True), ([[2, 0.9], [0, 2]], True), ([[2, 2.4], [0, 2]], False),
        ([[2, -2.4], [0, 2]], False), ([[0, 2], [2, 0]], False), ([[0, 2], [-2, 0]], True),
    ],
)  # fmt: skip
def test_only_an_upright_square_image_is_suspected_of_swapped_columns(jacobian: Any, mirrored: bool) -> None:
    """Rows run down: a view from above has a negative determinant. Oblong by two, or askew by 60 degrees: left be."""
    metres = np.random.default_rng(0).uniform(-5000, 5000, (60, 3)) * [1.0, 1.0, 0.02]
    place = np.array([5.4, 43.2, 100.0])
    assert screened(place + metres / metres_per_unit(place), metres[:, :2] @ np.transpose(jacobian))[2] is mirrored


@pytest.mark.parametrize(
    "wrong",
    [{"grid": (3, 4, 4)}, {"grid": (4, 4, 3)}, {"tolerance": 0.0}],
)
def test_options_out_of_range_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        FitOptions(**wrong)
    FitOptions(grid=(4, 4, 4))


# --- certificate -------------------------------------------------------------------------------------------


def test_errors_are_root_mean_square_and_largest() -> None:
    rng = np.random.default_rng(0)
    residual = rng.normal(size=(50, 2)) * [1.0, 3.0]
    errors = Errors()
    assert np.isnan(errors.rmse).all()
    errors.add(np.array([[1.0, np.nan]]))
    assert errors.rmse[0] == 1.0
    assert np.isnan(errors.rmse[1])
    errors = Errors()
    errors.add(residual[:20])
    errors.add(residual[:0])
    errors.add(residual[20:])
    assert errors.count == 50
    np.testing.assert_allclose(errors.rmse, np.sqrt((residual**2).mean(axis=0)))
    np.testing.assert_allclose(errors.largest, np.abs(residual).max(axis=0))


def _with_denominator(axis: int, slope: float, sides: str = "lon") -> RPC:
    """An RPC one of whose denominators is 1 + slope x along a ground axis, the box of which is [-1, 1]."""
    plain = synthetic_rpc()
    coeffs = plain.coeffs.copy()
    coeffs[1::2] = 0.0
    coeffs[1::2, 0] = 1.0
    coeffs[2 * axis + 1, {"lon": 1, "lat": 2, "alt": 3}[sides]] = slope
    return replace(plain, coeffs=coeffs)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sides", ["lon", "lat", "alt"])
@pytest.mark.parametrize("slope", [0.5, -0.5, 0.79, 0.81, -0.9, 1.2])
def test_poles_are_looked_for_in_the_box_and_a_quarter_around_it(axis: int, sides: str, slope: float) -> None:
    """1 + slope x over x in [-1.25, 1.25]: a pole beyond the box is found where it lies within a quarter."""
    rpc = _with_denominator(axis, slope, sides)
    low, high = rpc.ground_offset - rpc.ground_scale, rpc.ground_offset + rpc.ground_scale
    assert smallest_denominator(rpc, low, high) == pytest.approx(1 - 1.25 * abs(slope))
    # of half the box, and off its centre: relative to the value at its own centre
    middle = rpc.ground_offset + 0.5 * rpc.ground_scale
    half = smallest_denominator(rpc, rpc.ground_offset, high)
    center = 1 + 0.5 * slope
    assert half == pytest.approx((center - 0.625 * abs(slope)) / center)
    assert np.isfinite(middle).all()


@pytest.mark.parametrize(
    ("changes", "tolerance", "message"),
    [
        ({}, 0.0051, ""),
        ({}, 0.0049, "misses"),
        ({"max_ckp": np.array([1e-4, 0.006])}, 0.0055, "misses"),
        ({"max_ckp": np.array([np.nan, 0.006])}, 1.0, "misses"),
        ({"min_denominator": 0.0}, 0.1, "pole"),
        ({"min_denominator": -0.3}, 0.1, "pole"),
        ({"min_denominator": 1e-3}, 0.1, ""),
        ({"roundtrip": 0.11}, 0.1, "inverted"),
        ({"roundtrip": 0.09}, 0.1, ""),
        ({"roundtrip": 5e-7, "max_ckp": np.zeros(2)}, 1e-9, ""),
        ({"roundtrip": np.inf}, 0.1, "inverted"),
    ],
)
def test_a_verdict_names_what_is_wrong(changes: dict[str, Any], tolerance: float, message: str) -> None:
    verdict = made(**changes).verdict(tolerance)
    assert message in verdict
    assert bool(verdict) == bool(message)


def test_the_round_trip_is_measured_in_pixels() -> None:
    class Off:
        """Localises 2 m too high up north."""

        def __init__(self, rpc: RPC) -> None:
            self.rpc = rpc

        def project_jacobian(self, ground: Any) -> Any:
            return self.rpc.project_jacobian(ground)

        def localize(self, image: Any, alt: Any) -> Any:
            return self.rpc.localize(image, alt) + [360.0, 1e-4, 0.0]

    rpc = synthetic_rpc()
    ground = rpc.localize(np.array([[3000.0, 4000.0], [12000.0, 9000.0]]), np.array([100.0, 400.0]))
    _, jacobian = rpc.project_jacobian(ground)
    expected = np.abs(jacobian[..., 1]).max() * 1e-4
    assert roundtrip(Off(rpc), ground) == pytest.approx(expected, rel=1e-4)  # type: ignore[arg-type]
    assert roundtrip(rpc, ground) < 1e-6
    assert roundtrip(rpc, np.array([[5.4, 43.2, np.nan]])) == float("inf")


@pytest.mark.parametrize("step", [1, 3, 8])
def test_a_narrow_strip_covers_its_own_share(step: int) -> None:
    """A strip of a tenth of the image's side, across it askew: its hull is no wider for being thin."""
    angle = 2 * np.pi * step / 64
    along, across = np.array([-np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
    ends = [0.5 + a * along + b * across for a in (-0.4, 0.4) for b in (-0.05, 0.05)]
    assert coverage(np.array(ends), np.zeros(2), np.ones(2)) == pytest.approx(0.08, abs=0.012)


# --- grid --------------------------------------------------------------------------------------------------


def test_the_terrains_range_is_that_under_the_image(camera: Camera) -> None:
    ring = camera.model.localize(np.array([[0.0, 0.0], [19999.0, 18999.0]]), np.array([0.0, 1000.0]))
    inside = ring[:, 1].mean()

    def dem(lon: Any, lat: Any) -> Any:
        return np.where(np.abs(lat - inside) < 0.02, 700.0, np.where(lon > ring[:, 0].mean(), np.nan, 50.0))

    assert terrain_range(camera.model, camera.size, (0.0, 1000.0), dem, 30.0) == (20.0, 730.0)


# --- solvers -----------------------------------------------------------------------------------------------


def test_points_count_by_the_inverse_of_their_sigma(camera: Camera) -> None:
    """Against numpy's weighted least squares of the linearised system."""
    rng = np.random.default_rng(2)
    ground, image = random_points(camera, 200, rng)
    image = image + rng.normal(0, 0.5, image.shape)
    sigma = rng.uniform(0.5, 4.0, 200)
    weight = relative_weight(sigma, 200)
    np.testing.assert_allclose(weight, sigma.min() / sigma)
    assert relative_weight(None, 3) is None
    for wrong in (np.ones(199), np.r_[0.0, np.ones(199)], np.r_[np.nan, np.ones(199)]):
        with pytest.raises(FitError, match="positive"):
            relative_weight(wrong, 200)
    equal, weighted = FitProblem(ground, image, camera.norm), FitProblem(ground, image, camera.norm, weight=weight)
    for axis in (0, 1):
        whole = dense(equal, axis)
        expected = np.linalg.lstsq(whole[:, :-1] / sigma[:, None], whole[:, -1] / sigma, rcond=None)[0]
        found = solution(weighted.compressed(axis))
        np.testing.assert_allclose(whole[:, :-1] @ found, whole[:, :-1] @ expected, atol=1e-9)


def test_weights_reach_the_fit(camera: Camera) -> None:
    """One of two equal halves shifted by a pixel: the fit lies where the weights balance them."""
    rng = np.random.default_rng(3)
    ground, image = random_points(camera, 400, rng)
    both = np.vstack([ground, ground])
    shifted = np.vstack([image, image + [1.0, 0.0]])
    sigma = np.r_[np.ones(400), np.full(400, 2.0)]
    options = FitOptions(method="ridge", tolerance=2.0)
    fit = fit_rpc_points(both, shifted, sigma=sigma, options=options, strict=False)
    shift = (fit.rpc.project(ground) - image).mean(axis=0)
    assert shift == pytest.approx([1 / 5, 0.0], abs=0.01)  # weights 1 and 1/4


def test_the_noise_is_found_whatever_the_number_of_points(camera: Camera) -> None:
    rng = np.random.default_rng(4)
    for count in (80, 2500):
        sigmas = []
        for _ in range(5):
            ground, image = random_points(camera, count, rng)
            problem = FitProblem(ground, image + rng.normal(0, 0.4, image.shape), camera.norm)
            sigmas.append(noise_scaled(problem.compressed(0), expected_size(ALL))[1] * 10100.0)
        assert np.sqrt(np.mean(np.square(sigmas))) == pytest.approx(0.4, rel=0.15)


def test_expected_sizes_fall_with_the_degree() -> None:
    size = expected_size(ALL)
    np.testing.assert_allclose(size[:20], np.r_[[np.inf] * 4, [0.1] * 6, [0.03] * 10])
    np.testing.assert_allclose(size[20:], np.r_[[0.003] * 3, [0.0003] * 6, [0.00003] * 10])


def test_the_camera_under_a_model_is_found_through_its_corrections(camera: Camera) -> None:
    assert innermost(camera.model) is camera.rpc
    assert innermost(camera.rpc) is camera.rpc
    assert innermost(np) is np


def test_the_papers_solver_counts_its_passes_over_the_points(camera: Camera) -> None:
    ground, image = random_points(camera, 300, np.random.default_rng(2))
    image = image + np.random.default_rng(3).normal(0, 0.2, image.shape)
    calls = []

    class Counted(FitProblem):
        def compressed(self, *given: Any, **how: Any) -> Any:
            calls.append(1)
            return super().compressed(*given, **how)

    *_, passes = METHODS["lcurve-joint"](Counted(ground, image, camera.norm))
    assert 2 * passes == len(calls)  # of col and of row
    assert passes >= 5


@pytest.fixture(scope="module")
def problem(camera: Camera) -> FitProblem:
    rng = np.random.default_rng(1)
    ground, image = random_points(camera, 1300, rng)
    return FitProblem(ground, image + rng.normal(0, 0.3, image.shape), camera.norm)


def dense(problem: FitProblem, axis: int, denominator: Array | None = None) -> Array:
    """The whole system (M | y) at once."""
    return np.concatenate([rows for _, rows in problem.rows(axis, denominator)])


@pytest.mark.parametrize("axis", [0, 1])
def test_the_compressed_system_is_the_system(camera: Camera, problem: FitProblem, axis: int) -> None:
    whole = dense(problem, axis, camera.rpc.coeffs[2 * axis + 1])
    system = problem.compressed(axis, camera.rpc.coeffs[2 * axis + 1])
    assert system.triangle.T @ system.triangle == pytest.approx(whole.T @ whole, abs=1e-9)
    x = np.linspace(-1, 1, 39)
    assert system.squares(x) == pytest.approx(((whole[:, :-1] @ x - whole[:, -1]) ** 2).sum())
    free = np.linalg.lstsq(whole[:, :-1], whole[:, -1], rcond=None)
    assert system.sigma == pytest.approx(np.sqrt(free[1][0] / (1300 - 39)))


def test_rows_are_the_papers_equation(camera: Camera, problem: FitProblem) -> None:
    """w (m(x), -y m'(x)) (a, b') = w y holds for the coefficients of the RPC that made the points."""
    exact = FitProblem(problem.ground, camera.rpc.project(problem.ground), problem.norm)
    for axis in (0, 1):
        numerator, denominator = camera.rpc.coeffs[2 * axis : 2 * axis + 2]
        for weight in (None, denominator):
            rows = dense(exact, axis, weight)
            assert rows[:, :-1] @ np.r_[numerator, denominator[1:]] == pytest.approx(rows[:, -1], abs=1e-12)


def test_the_penalised_solution_is_that_of_the_normal_equations(problem: FitProblem) -> None:
    whole = dense(problem, 0)
    penalty = np.r_[np.zeros(4), np.linspace(0.1, 3, 35)]
    matrix = whole[:, :-1]
    expected = np.linalg.solve(matrix.T @ matrix + np.diag(penalty**2), matrix.T @ whole[:, -1])
    assert solution(problem.compressed(0).penalized(penalty)) == pytest.approx(expected, abs=1e-9)


def test_the_penalty_follows_the_noise(camera: Camera, problem: FitProblem) -> None:
    system = problem.compressed(0, camera.rpc.coeffs[1])
    added, sigma = noise_scaled(system, expected_size(ALL))
    assert sigma * 10100 == pytest.approx(0.3, rel=0.05)
    more = added.triangle.T @ added.triangle - system.triangle.T @ system.triangle
    assert np.sqrt(np.diag(more)[20:23]) == pytest.approx(sigma / 0.003, rel=0.05)


def test_the_corner_of_the_l_curve_has_the_largest_curvature(problem: FitProblem) -> None:
    """Against the curvature of the sampled curve (log |M x - y|, log |x|)."""
    system = problem.compressed(0)
    h = corner([system])
    grid = h * np.exp(np.linspace(-0.4, 0.4, 401))
    curve = []
    for value in grid:
        x = np.linalg.lstsq(
            np.vstack([system.matrix, value * np.eye(39)]), np.r_[system.target, np.zeros(39)], rcond=None
        )[0]
        curve.append([0.5 * np.log(system.squares(x)), np.log(np.linalg.norm(x))])
    rho, eta = np.gradient(np.array(curve), np.log(grid), axis=0).T
    rho2, eta2 = np.gradient(rho, np.log(grid)), np.gradient(eta, np.log(grid))
    curvature = (rho * eta2 - rho2 * eta) / (rho**2 + eta**2) ** 1.5
    assert abs(np.log(grid[5 + np.argmax(curvature[5:-5])] / h)) <= 0.02


def test_a_corner_that_is_not_sharp_is_one() -> None:
    """Singular values from 1 to 0.001, of a curve whose curvature is at most 0.47: against the sampled curve."""
    s = np.geomspace(1.0, 1e-3, 5)
    triangle = np.zeros((6, 6))
    triangle[:5], triangle[5, 5] = np.column_stack([np.diag(s), s]), 1.0
    t = np.linspace(np.log(1e-3), 0.0, 20001)
    f = s**2 / (s**2 + np.exp(2 * t)[:, None])
    rho, eta = 0.5 * np.log((((1 - f) * s) ** 2).sum(axis=1) + 1.0), 0.5 * np.log((f**2).sum(axis=1))
    rho1, eta1 = np.gradient(rho, t), np.gradient(eta, t)
    rho2, eta2 = np.gradient(rho1, t), np.gradient(eta1, t)
    curvature = (rho1 * eta2 - rho2 * eta1) / (rho1**2 + eta1**2) ** 1.5
    best = 10 + int(np.argmax(curvature[10:-10]))
    assert curvature[best] == pytest.approx(0.47, abs=0.01)
    assert corner([TriangularSystem(triangle, 10)]) == pytest.approx(np.exp(t[best]), rel=0.01)


def test_without_a_corner_the_regularisation_is_the_least() -> None:
    """Of exact points whose L-curve is concave from the smallest singular value to the largest."""
    s, beta = np.array([0.4, 0.1]), np.array([0.05, 0.9])
    triangle = np.zeros((3, 3))
    triangle[:2] = np.column_stack([np.diag(s), beta])
    assert corner([TriangularSystem(triangle, 10)]) == pytest.approx(0.1)


def test_one_point_more_than_unknowns_tells_the_noise(problem: FitProblem) -> None:
    """The residual of 40 points and 39 unknowns has one degree of freedom, as that of fewer is taken to have."""
    few = FitProblem(problem.ground[:40], problem.image[:40], problem.norm)
    whole = dense(few, 0)
    residual = np.linalg.lstsq(whole[:, :-1], whole[:, -1], rcond=None)[1]
    assert few.compressed(0).sigma == pytest.approx(float(np.sqrt(residual[0])), rel=1e-3)


def test_weighted_by_its_own_denominator_the_residual_is_that_of_the_image(camera: Camera, problem: FitProblem) -> None:
    rmse, _ = _reweighted(problem, camera.rpc.coeffs, np.ones(39), False)
    residual = camera.rpc.project(problem.ground) - problem.image
    assert rmse == pytest.approx(np.sqrt((residual**2).mean()))
