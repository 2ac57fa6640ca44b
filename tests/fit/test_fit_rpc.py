"""An RPC fitted to P_BA is P_BA: the paper's central step, at four orders of magnitude below its errors."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from rasterio.transform import RPCTransformer

from barpc.base.errors import FitError
from barpc.fit import FitOptions, fit_rpc, fit_rpc_points
from barpc.fit.points import control_points
from barpc.simulate import Look, fly
from tests.fit.cameras import Camera, random_points, synthetic
from tests.lanes import rest_slow

PECULIAR = "rpc_formats/md_ov_rpc.txt"  # P_BA of this RPC is no rational cubic: 1.2e-6 px remain in col


def miss(camera: Camera) -> float:
    """How far [px] the RPC before the adjustment is from P_BA: what a fit that did nothing would miss."""
    ground, image = random_points(camera, 50, np.random.default_rng(0))
    return float(np.abs(camera.rpc.project(ground) - image).max())


@pytest.mark.slow
@pytest.mark.parametrize("grid", rest_slow([(10, 10, 6), (12, 12, 7)]))
def test_every_vendors_rpc_is_refitted_to_a_hundred_millionth_of_a_pixel(
    vendors: list[Camera], grid: tuple[int, int, int]
) -> None:
    options = FitOptions(grid=grid)
    fits = {c.name: fit_rpc(c.model, c.size, c.alt_range, options=options) for c in vendors}
    assert len(fits) >= 28
    assert min(map(miss, vendors)) >= 1.0
    peculiar = fits.pop(PECULIAR)
    rmse = np.array([fit.rmse_ckp for fit in fits.values()])
    assert rmse[:, 0].mean() <= 5e-9
    assert rmse[:, 1].mean() <= 5e-9
    assert rmse.max() <= 2e-8
    assert max(fit.max_ckp.max() for fit in fits.values()) <= 1e-7
    assert max(fit.max_cnp.max() for fit in fits.values()) <= 1e-7
    assert min(fit.min_denominator for fit in fits.values()) >= 0.5
    assert all(fit.method == "ridge" and fit.coverage == 1.0 for fit in fits.values())
    assert peculiar.rmse_ckp[0] <= 2e-6
    assert peculiar.rmse_ckp[1] <= 5e-9
    assert peculiar.max_ckp.max() <= 5e-6


def test_every_image_point_of_every_camera_has_its_ground_point(vendors: list[Camera]) -> None:
    """At 0.3 m pixels the rounding of ECEF is 1e-8 px: no reason to give a point up."""
    rng = np.random.default_rng(0)
    for camera in vendors:
        image = rng.uniform(0, 1, (2000, 2)) * camera.size - 0.5
        assert np.isfinite(camera.model.localize(image, rng.uniform(*camera.alt_range, 2000))).all(), camera.name


def test_the_certificate_holds_on_points_that_neither_grid_contains(camera: Camera) -> None:
    fit = fit_rpc(camera.model, camera.size, camera.alt_range)
    ground, image = random_points(camera, 5000, np.random.default_rng(1))
    error = fit.rpc.project(ground) - image
    assert miss(camera) >= 1.0
    assert (fit.method, fit.rmse_ckp.max() < 2e-8) == ("ridge", True)  # a smooth camera
    assert fit.iterations <= 2
    assert fit.max_ckp.max() <= 5e-8  # edges and corners included; its own rounding of coordinates
    assert np.abs(error).max() <= 3 * fit.max_ckp.max()
    assert np.all(np.sqrt((error**2).mean(axis=0)) <= 3 * fit.rmse_ckp)


def test_a_grid_on_the_ground_reaches_the_rounding_of_coordinates_too(camera: Camera) -> None:
    fit = fit_rpc(camera.model, camera.size, camera.alt_range, options=FitOptions(space="ground"))
    assert fit.max_ckp.max() <= 1e-7
    assert fit.coverage == 1.0


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize("third", rest_slow([0, 1, 2]))
def test_the_error_does_not_grow_with_the_area(vendors: list[Camera], third: int) -> None:
    for camera in vendors[third::3]:
        if camera.name == PECULIAR:
            continue
        errors = []
        for share in (0.05, 0.25, 1.0):
            width, height = (max(1, round(n * np.sqrt(share))) for n in camera.size)
            errors.append(fit_rpc(camera.model, (width, height), camera.alt_range).rmse_ckp.max())
        assert max(errors) < 10 * min(errors), camera.name


def test_an_rpc_holds_outside_its_box(vendors: list[Camera]) -> None:
    """A quarter more in longitude and latitude and 2,500 m more of altitude, Pleiades."""
    pleiades = [c for c in vendors if "PHR1B" in c.name or "PLEIADES" in c.name]
    assert len(pleiades) >= 5
    for camera in pleiades:
        rpc = fit_rpc(camera.model, camera.size, camera.alt_range).rpc
        t = np.linspace(-1.25, 1.25, 9)
        lon, lat = (rpc.ground_offset[i] + t * rpc.ground_scale[i] for i in (0, 1))
        alt = np.linspace(camera.alt_range[0] - 2500, camera.alt_range[1] + 2500, 9)
        ground = np.stack(np.meshgrid(lon, lat, alt), axis=-1)
        assert np.abs(rpc.project(ground) - camera.model.project(ground)).max() <= 1e-3


def test_a_rigorous_model_is_fitted_by_the_same_function() -> None:
    model = fly(np.array([5.4, 43.2, 300.0]), Look(20.0, 60.0), (6000, 5000), 0.5)
    fit = fit_rpc(model, (6000, 5000), (0.0, 600.0))
    assert fit.max_ckp.max() <= 1e-4
    assert fit.roundtrip <= 1e-8


def test_a_scene_across_the_antimeridian_is_one_scene() -> None:
    camera = synthetic(lon=179.99)
    fit = fit_rpc(camera.model, camera.size, camera.alt_range)
    assert fit.max_ckp.max() <= 1e-7
    assert fit.rpc.ground_scale[0] < 1.0


def test_a_flat_scene_keeps_its_altitude_terms(camera: Camera) -> None:
    fit = fit_rpc(camera.model, camera.size, (300.0, 300.0))
    ground, image = random_points(replace(camera, alt_range=(255.0, 345.0)), 500, np.random.default_rng(2))
    assert fit.rpc.ground_scale[2] >= 50.0
    assert np.abs(fit.rpc.project(ground) - image).max() <= 1e-7


def test_the_papers_solver_fits_a_ten_thousandth_of_a_pixel(camera: Camera) -> None:
    fit = fit_rpc(camera.model, camera.size, camera.alt_range, options=FitOptions(method="lcurve-joint"))
    assert fit.rmse_ckp.max() <= 2e-4
    assert fit.h[0] == fit.h[1] > 0


def test_a_model_without_ground_under_its_image_is_refused(camera: Camera) -> None:
    with pytest.raises(FitError, match="altitude range"):
        fit_rpc(camera.model, camera.size, (1e7, 2e7))
    with pytest.raises(FitError, match="not an interval"):
        fit_rpc(camera.model, camera.size, (500.0, 0.0))
    with pytest.raises(FitError, match="nothing to fit over"):
        fit_rpc(camera.model, (0, 5), camera.alt_range)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_points(camera: Camera) -> None:
    ground, image = control_points(camera.model, camera.size, camera.alt_range, FitOptions(grid=(80, 80, 32)))
    ground, image = ground.reshape(-1, 3)[:200_000], image.reshape(-1, 2)[:200_000]
    for count, limit in ((25_000, 8e6), (200_000, 16e6)):
        tracemalloc.start()
        fit_rpc_points(ground[:count], image[:count])
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak <= limit


def test_the_coefficients_stand_in_rpc00b_order_for_rpcm_and_gdal(camera: Camera) -> None:
    rpcm = pytest.importorskip("rpcm")
    rpc = fit_rpc(camera.model, camera.size, camera.alt_range).rpc
    assert all(len(np.unique(row)) == 20 for row in rpc.coeffs)
    ground, image = random_points(camera, 200, np.random.default_rng(4))
    peer = rpcm.RPCModel(rpc.to_rpcm_dict(), dict_format="rpcm")
    assert np.abs(np.array(peer.projection(*ground.T)) - image.T).max() <= 1e-7
    with RPCTransformer(rpc.to_rasterio()) as transformer:
        row, col = transformer.rowcol(*ground.T, op=lambda v: v)
    assert np.abs(np.column_stack([col, row]) - 0.5 - image).max() <= 1e-7
