"""The localisation RPC against models that are not ours and its reader; one denominator of both."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import FitError, RpcFormatError
from barpc.base.geodesy import Array, ecef_from_ground
from barpc.fit import FitOptions, RpcFit, fit_rpc, fit_rpc_points
from barpc.rpcio import read_rpc, write_rpc
from tests.fit.cameras import Camera, random_points, synthetic
from tests.fit.models import hard

BOTH = FitOptions(localisation=True)
FRAME = "frame, k1 0.02"


@pytest.fixture(scope="module")
def frame() -> RpcFit:
    return fit_rpc(*hard()[FRAME], options=BOTH, strict=False)


def places(name: str, count: int) -> tuple[Array, Array]:
    """Ground and image points all over a model."""
    model, size, alt_range = hard()[name]
    rng = np.random.default_rng(8)
    image = rng.uniform([-0.5, -0.5], np.array(size) - 0.5, (count, 2))
    return model.localize(image, rng.uniform(*alt_range, count)), image


def test_its_certificate_is_what_twenty_thousand_points_say_in_metres_and_in_pixels(frame: RpcFit) -> None:
    ground, image = places(FRAME, 20_000)
    found, certified = frame.rpc.localize_direct(image, ground[:, 2]), frame.localisation
    metres = np.linalg.norm(ecef_from_ground(found) - ecef_from_ground(ground), axis=1)
    pixels = np.linalg.norm(frame.rpc.project(found) - image, axis=1)
    for distance, rmse, largest in (
        (metres, certified.rmse_m, certified.max_m),
        (pixels, certified.rmse_px, certified.max_px),
    ):
        assert distance.max() / 1.2 <= largest <= 1.5 * distance.max()
        np.testing.assert_allclose(np.sqrt((distance**2).mean()), rmse, rtol=0.1)
    assert metres.max() < 0.05  # of 9 km at 0.4 m a pixel
    assert certified.min_denominator > 0.5


def test_rpcm_localises_with_what_is_written(camera: Camera, tmp_path: Path) -> None:
    rpcm = pytest.importorskip("rpcm")
    fit = fit_rpc(camera.model, camera.size, camera.alt_range, options=BOTH)
    ground, image = random_points(camera, 300, np.random.default_rng(2))
    write_rpc(fit.rpc, tmp_path / "a_RPC.TXT")
    write_rpc(fit.rpc, tmp_path / "a.json")
    held = [rpcm.rpc_from_rpc_file(str(tmp_path / "a_RPC.TXT"))]
    held.append(rpcm.RPCModel(json.loads((tmp_path / "a.json").read_text())["rpc"], dict_format="rpcm"))
    for theirs in held:
        assert hasattr(theirs, "lon_num")
        lon, lat = theirs.localization(image[:, 0], image[:, 1], ground[:, 2])
        assert np.abs(np.column_stack([lon, lat]) - ground[:, :2]).max() < 2e-8  # 2 mm
        ours = fit.rpc.localize_direct(image, ground[:, 2])
        assert np.abs(np.column_stack([lon, lat]) - ours[:, :2]).max() < 1e-12


def test_files_that_hold_it_give_it_back_to_the_bit_and_others_leave_it_out(camera: Camera, tmp_path: Path) -> None:
    rpc = fit_rpc(camera.model, camera.size, camera.alt_range, options=BOTH).rpc
    for name, kept in (
        ("a_RPC.TXT", True),
        ("a.json", True),
        ("a.RPB", False),
        ("a.geom", False),
        ("a.XML", False),
    ):
        write_rpc(rpc, tmp_path / name)
        again = read_rpc(tmp_path / name)
        assert (again.coeffs == rpc.coeffs).all()
        assert (again.direct is None) if not kept else (again.direct == rpc.direct).all(), name
    lines = (tmp_path / "a_RPC.TXT").read_text().splitlines()
    (tmp_path / "b_RPC.TXT").write_text("\n".join(line for line in lines if "LAT_DEN_COEFF" not in line))
    with pytest.raises(RpcFormatError, match="LAT_DEN_COEFF is missing"):
        read_rpc(tmp_path / "b_RPC.TXT")


def test_a_crop_and_a_coarser_image_keep_it(camera: Camera) -> None:
    rpc = fit_rpc(camera.model, camera.size, camera.alt_range, options=BOTH).rpc
    image, alt = np.array([[5000.0, 7000.0], [9000.0, 800.0]]), np.array([100.0, 900.0])
    truth = rpc.localize_direct(image, alt)
    np.testing.assert_allclose(rpc.crop(400, 30).localize_direct(image - [400, 30], alt), truth, rtol=1e-13)
    coarse = rpc.window(400, 30, 2.0, 4.0)
    at = (image + 0.5 - [400, 30]) / [2.0, 4.0] - 0.5
    np.testing.assert_allclose(coarse.localize_direct(at, alt), truth, rtol=1e-13)


def test_one_that_misses_is_refused(frame: RpcFit) -> None:
    tolerance = 0.5 * (frame.max_ckp.max() + frame.localisation.max_px)
    assert frame.max_ckp.max() < tolerance < frame.localisation.max_px
    with pytest.raises(FitError, match=r"^the localisation RPC misses the ground by up to .* m \(0\.0.* px\)"):
        fit_rpc(*hard()[FRAME], options=FitOptions(localisation=True, tolerance=tolerance))


@pytest.mark.parametrize("lon", [180.0, 5.4])
def test_given_points_have_one_too_across_the_antimeridian_and_with_noise(lon: float) -> None:
    camera = synthetic(lon=lon)
    rng = np.random.default_rng(3)
    ground, image = random_points(camera, 600, rng)
    noisy = image + rng.normal(0, 0.2, image.shape)
    options = FitOptions(localisation=True, tolerance=3.0)
    left_out = fit_rpc_points(ground, noisy, options=options)
    checked = fit_rpc_points(ground, noisy, options=options, check=(ground, image))
    gsd = 0.8  # of 10,000 px in 0.12 and 0.09 degrees, about
    assert 0.2 * gsd < left_out.localisation.rmse_m < 0.4 * gsd
    assert checked.localisation.rmse_m < 0.3 * left_out.localisation.rmse_m  # the truth is nearer than the noise
    fresh, at = random_points(camera, 500, rng)
    found = left_out.rpc.localize_direct(at, fresh[:, 2])
    assert np.linalg.norm(ecef_from_ground(found) - ecef_from_ground(fresh), axis=1).max() < 0.5
