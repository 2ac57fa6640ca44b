"""Fitting given correspondences: noise, tables, grids - and what must not be fitted in silence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import BarpcWarning, FitError
from barpc.base.geodesy import Array
from barpc.fit import FitOptions, fit_rpc_points
from barpc.pointio.correspondences import read_correspondences
from barpc.rpcio import read_rpc
from barpc.sensor.rational import monomials
from tests.fit.cameras import Camera, random_points, synthetic
from tests.fit.models import Radar

NOISY = FitOptions(tolerance=20.0)


def rms(residual: Array) -> float:
    return float(np.sqrt((residual**2).mean()))


@pytest.fixture(scope="module")
def points(camera: Camera) -> tuple[Array, Array]:
    return random_points(camera, 600, np.random.default_rng(5))


def test_exact_points_give_an_exact_rpc(camera: Camera, points: tuple[Array, Array]) -> None:
    fit = fit_rpc_points(*points)
    ground, image = random_points(camera, 2000, np.random.default_rng(6))
    assert np.abs(fit.rpc.project(ground) - image).max() <= 1e-6
    assert np.abs(camera.rpc.project(ground) - image).max() >= 1.0
    assert 0.9 < fit.coverage <= 1.0


@pytest.mark.landing(2)
def test_denominators_of_columns_and_of_rows_are_looked_at(camera: Camera, points: tuple[Array, Array]) -> None:
    """An image that is turned by 90 degrees has those of the image."""
    ground, image = points
    turned = np.column_stack([image[:, 1], 30_000.0 - image[:, 0]])
    fits = [fit_rpc_points(ground, one) for one in (image, turned)]
    assert fits[1].min_denominator == pytest.approx(fits[0].min_denominator, rel=1e-6)
    for fit in fits:
        place = fit.rpc.normalize(ground)
        least = [(monomials(place).T @ c / c[0]).min() for c in fit.rpc.coeffs[1::2]]
        assert 0.8 * min(least) < fit.min_denominator <= min(least) + 1e-9


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "factor"),
    [(60, 2.5), *(pytest.param(*row, marks=pytest.mark.slow) for row in ((300, 1.5), (4000, 1.2)))],
)
def test_noise_neither_makes_poles_nor_costs_more_than_the_unknowns_do(
    vendors: list[Camera], count: int, factor: float
) -> None:
    """0.3 px of noise and 39 unknowns leave 0.3 sqrt(39 / N) px, times a factor for the image's corners."""
    rng = np.random.default_rng(count)
    for camera in vendors[::2]:
        ground, image = random_points(camera, count, rng)
        fit = fit_rpc_points(ground, image + rng.normal(0, 0.3, image.shape), options=NOISY)
        truth_ground, truth_image = random_points(camera, 1000, rng)
        assert fit.min_denominator >= 0.5, camera.name
        assert rms(fit.rpc.project(truth_ground) - truth_image) <= 0.3 * factor * np.sqrt(39 / count), camera.name
        assert abs(rms(fit.rmse_ckp) - 0.3) <= 0.3 * max(0.1, 12 / np.sqrt(count))


@pytest.mark.nightly
def test_leave_one_out_residuals_are_those_of_fits_without_the_point(camera: Camera) -> None:
    rng = np.random.default_rng(8)
    ground, image = random_points(camera, 60, rng)
    image = image + rng.normal(0, 0.3, image.shape)
    one_by_one = []
    for i in range(len(ground)):
        others = np.arange(len(ground)) != i
        fit = fit_rpc_points(ground[others], image[others], options=NOISY)
        one_by_one.append(fit.rpc.project(ground[i]) - image[i])
    predicted = fit_rpc_points(ground, image, options=NOISY).rmse_ckp
    assert predicted == pytest.approx(np.sqrt((np.array(one_by_one) ** 2).mean(axis=0)), rel=0.15)


def test_the_papers_radar_points_are_met_as_well_as_by_its_own_code(shared_data: Path) -> None:
    folder = shared_data / "sar" / "rpcfit"
    train = [np.load(folder / f"s1_train{d}d.npy") for d in (3, 2)]
    test = [np.load(folder / f"s1_test{d}d.npy") for d in (3, 2)]
    fit = fit_rpc_points(*train, check=(test[0], test[1]))
    assert fit.rmse_ckp[1] <= 1.11e-4
    assert fit.rmse_ckp[0] <= 1.08e-4
    assert fit.min_denominator >= 0.5
    paper = fit_rpc_points(*train, check=(test[0], test[1]), options=FitOptions(method="lcurve-joint"))
    assert paper.rmse_ckp == pytest.approx([1.073e-4, 1.102e-4], rel=2e-3)


def middles(values: Array) -> Array:
    return 0.5 * (values[1:] + values[:-1])


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_few_points_of_a_wide_radar_image_are_fitted_as_well_as_by_the_paper(side: float) -> None:
    """A denominator's first degree is 50 times an optical image's there, and the misfit is no noise."""
    radar = Radar(11.0, 46.0, -12.0, side)  # 250 km wide
    edges = [np.linspace(-24000, 36000, 7), np.linspace(-18000, 27000, 7), np.linspace(0, 3000, 10)]
    points = [np.stack(np.meshgrid(*at, indexing="ij"), -1).reshape(-1, 3) for at in (edges, map(middles, edges))]
    given, unseen = ((radar.localize(at[:, :2], at[:, 2]), at[:, :2]) for at in points)
    error = {}
    for method in ("auto", "lcurve-joint"):
        fit = fit_rpc_points(*given, options=FitOptions(method=method), strict=False)
        error[method] = rms(fit.rpc.project(unseen[0]) - unseen[1])
    assert 0.95 * error["lcurve-joint"] <= error["auto"] <= 1.02 * error["lcurve-joint"]


@pytest.mark.parametrize("highest", [1300.0, 5000.0])
def test_a_physical_models_grid_is_fitted_better_than_by_its_vendor(shared_data: Path, highest: float) -> None:
    points = read_correspondences(shared_data / "physical" / "GRID_P1BP--2017092838284574CP.tif")
    vendor = read_rpc(shared_data / "physical" / "RPC_P1BP--2017092838284574CP.XML")
    low = points.ground[:, 2] <= 1202.5
    used = points.ground[:, 2] <= highest
    fit = fit_rpc_points(points.ground[used], points.image[used])
    error = fit.rpc.project(points.ground[low]) - points.image[low]
    vendors_error = vendor.project(points.ground[low]) - points.image[low]
    assert np.all(np.abs(vendors_error.mean(axis=0)) <= 1e-3)  # (0, 0) is the centre of the first pixel
    assert np.all(error.std(axis=0) <= 0.05 * vendors_error.std(axis=0))
    assert fit.max_ckp.max() <= 2e-4
    assert fit.min_denominator >= 0.5


def test_layers_at_two_altitudes_do_not_make_the_zero_solution(camera: Camera) -> None:
    image = np.stack(np.meshgrid(np.linspace(0, 20000, 9), np.linspace(0, 19000, 9)), axis=-1).reshape(-1, 2)
    image = np.concatenate([image, image])
    ground = camera.model.localize(image, np.repeat([0.0, 1000.0], 81))
    fit = fit_rpc_points(ground, image)
    assert fit.min_denominator >= 0.5
    assert not fit.rpc.coeffs[:, 9].any()  # HH
    assert np.abs(fit.rpc.project(ground) - image).max() <= 1e-3


def test_points_at_one_altitude_give_an_rpc_for_that_altitude(camera: Camera) -> None:
    image = np.random.default_rng(10).uniform(0, 19000, (200, 2))
    ground = camera.model.localize(image, np.full(200, 200.0))
    with pytest.raises(FitError, match=r"no height terms: .* altitudes alone, 199 to 201 m, and 100 m beyond errs by"):
        fit_rpc_points(ground, image)
    fit = fit_rpc_points(ground, image, strict=False)
    assert np.abs(fit.rpc.project(ground) - image).max() <= 1e-3
    assert fit.rpc.ground_scale[2] == 1.0
    assert np.isfinite(fit.rpc.coeffs).all()
    higher = camera.model.localize(image, np.full(200, 300.0))
    assert 1.0 < np.abs(fit.rpc.project(higher) - image).max() < fit.height_px  # the worst that a camera may look aside


@pytest.mark.parametrize("relief", [3.0, 22.0, 400.0])
def test_points_on_a_surface_tell_heights_as_far_as_its_relief_lets_them(camera: Camera, relief: float) -> None:
    """What is said of ground 100 m higher, by noise of 0.3 px, is the least it is off by; the range is the points'."""
    said, off = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        image = rng.uniform(0, 19000, (400, 2))
        alt = 200.0 + relief * rng.uniform(-0.5, 0.5, 400)
        ground = camera.model.localize(image, alt)
        noisy = image + rng.normal(0.0, 0.3, image.shape)
        fit = fit_rpc_points(ground, noisy, options=FitOptions(tolerance=3.0), strict=False)
        assert fit.rpc.ground_offset[2] == pytest.approx(200.0, abs=0.1 * relief)
        assert fit.rpc.ground_scale[2] == pytest.approx(0.5 * relief, rel=0.1)
        inside = camera.model.localize(image, np.full(400, 200.0))
        assert np.sqrt(np.mean((fit.rpc.project(inside) - image) ** 2)) < 0.3
        higher = camera.model.localize(image, np.full(400, 300.0))
        off.append(np.mean((fit.rpc.project(higher) - fit.rpc.project(inside)) ** 2))
        said.append(fit.height_px)
        assert ("no height terms" in fit.verdict(3.0)) == (fit.height_px > 3.0)
    assert np.ptp(said) < 0.3 * np.mean(said)
    assert (np.mean(said) > 1.0) == (relief == 3.0)
    assert np.sqrt(np.mean(off)) > 0.5 * np.mean(said)


@pytest.mark.parametrize("shift", [360.0, -360.0])
def test_longitudes_of_another_turn_are_the_same_points(
    camera: Camera, points: tuple[Array, Array], shift: float
) -> None:
    ground, image = points
    fit = fit_rpc_points(ground + [shift, 0.0, 0.0], image)
    assert np.abs(fit.rpc.project(ground) - image).max() <= 1e-6


def test_points_across_the_antimeridian_are_one_scene() -> None:
    camera = synthetic(lon=179.99)
    ground, image = random_points(camera, 500, np.random.default_rng(11))
    ground[:, 0] = (ground[:, 0] + 180.0) % 360.0 - 180.0
    assert np.ptp(ground[:, 0]) > 359.0
    fit = fit_rpc_points(ground, image)
    assert np.abs(fit.rpc.project(ground) - image).max() <= 1e-6
    assert fit.rpc.ground_scale[0] < 1.0


@pytest.mark.parametrize("columns", [[1, 0, 2, 3, 4], [0, 1, 2, 4, 3], [0, 1, 2, 3, 4]])
def test_a_mirrored_image_is_fitted_and_said(points: tuple[Array, Array], columns: list[int]) -> None:
    """Two columns exchanged, or one that counts the other way: the ground alone does not tell which."""
    table = np.column_stack(points)[:, columns]
    table[:, 3] = 20000.0 - table[:, 3] if columns == sorted(columns) else table[:, 3]
    with pytest.warns(BarpcWarning, match="they show the ground mirrored"):
        fit = fit_rpc_points(table[:, :3], table[:, 3:])
    assert np.abs(fit.rpc.project(table[:, :3]) - table[:, 3:]).max() <= 1e-6


def test_bad_points_are_refused_with_the_reason(points: tuple[Array, Array]) -> None:
    """What is looked at of points one by one: `test_numbers.py`."""
    ground, image = points
    hole = ground.copy()
    hole[17, 2] = np.nan
    plane = ground.copy()
    plane[:, 2] = 100.0 + 2000.0 * (ground[:, 0] - 5.4) + 1000.0 * (ground[:, 1] - 43.2)
    for bad_ground, bad_image, message in (
        (hole, image, "1 of 600 are not finite .* point 17"),
        (ground[:3], image[:3], "in a plane"),
        (plane, image, "in a plane"),
        (ground[:, [2, 1, 0]], image, "not a longitude"),
        (ground[:, [0, 2, 1]], image, "not a latitude"),
        (np.column_stack([image, ground[:, 2]]), ground[:, :2], "not a l"),
    ):
        with pytest.raises(FitError, match=message):
            fit_rpc_points(bad_ground, bad_image)
    with pytest.raises(FitError, match="sigma"):
        fit_rpc_points(ground, image, sigma=np.zeros(len(ground)))
    fit_rpc_points(ground[:40], image[:40], options=FitOptions(tolerance=1e3, method="ridge"), strict=False)


def test_points_that_no_camera_made_are_refused(points: tuple[Array, Array]) -> None:
    ground, image = points
    shuffled = np.random.default_rng(12).permutation(image)
    with pytest.raises(FitError, match=r"misses its check points|pole"):
        fit_rpc_points(ground, shuffled, options=FitOptions(tolerance=100.0))
