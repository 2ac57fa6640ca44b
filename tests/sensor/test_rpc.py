"""The RPC beyond the contract of all sensor models: accuracy, far points, poles, longitudes, crops."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from barpc.base.errors import RpcError
from barpc.rpcio import read_rpc
from barpc.sensor.rational import monomials
from barpc.sensor.rpc import RPC
from tests.lanes import rest_slow
from tests.sensor.conftest import make_rpc, slopes_off

VENDORS = [
    "optical/phr_triplet_north/img_01.tif",
    "optical/phr_ventoux/left_image.geom",
    "optical/qb2_single/qb2_basic1b.tif",
    "rpc_formats/20191015_073816_ssc1d3_0011_basic_l1a_panchromatic_dn_RPC.TXT",
    "rpc_formats/JAX_068_001_RGB.json",
    "rpc_formats/WV02_10300100D0772D00.r100.xml",
    "rpc_formats/ikonos-1.geom",
    "rpc_formats/md_dg.RPB",
    "rpc_formats/md_ov_rpc.txt",
    "rpc_formats/qb-1.geom",
    "rpc_formats/rpc_IKONOS.txt",
    "rpc_formats/rpc_PLANET_L1A.txt",
    "rpc_formats/rpc_PLEIADES.xml",
    "rpc_formats/rpc_SPOT6.xml",
    "rpc_formats/rpc_unsupported.xml",
    "rpc_formats/rpc_WV2.xml",
    "rpc_formats/wv3_20.NTF",
]
REACHES = [3.0, 100.0, 1e4]
vendors = pytest.mark.parametrize("file", VENDORS)
few_vendors = pytest.mark.parametrize("file", rest_slow(VENDORS, keep=4))
FAR = [
    pytest.param(file, reach, 4_000 if n == m else 20_000, marks=() if n == m else pytest.mark.nightly)
    for n, file in enumerate(VENDORS)
    for m, reach in enumerate(REACHES)
]


def box(rpc: RPC, reach: float, count: int = 20_000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Image points in `reach` times the RPC's box, and altitudes in three times its range at most."""
    rng = np.random.default_rng(seed)
    image = rpc.image_offset + rng.uniform(-reach, reach, (count, 2)) * rpc.image_scale
    return image, rpc.ground_offset[2] + rng.uniform(-1, 1, count) * min(reach, 3) * rpc.ground_scale[2]


def rounding(rpc: RPC, ground: np.ndarray) -> float:
    """What half a unit in the last place of lon and lat moves in the image [px]."""
    _, jacobian = rpc.project_jacobian(ground)
    return float((np.abs(jacobian[:, :, :2]) * 0.5 * np.spacing(np.abs(ground[:, None, :2]))).sum(axis=2).max())


@vendors
def test_localising_inside_the_box_is_exact_but_for_the_rounding_of_degrees(file, shared_data):
    rpc = read_rpc(shared_data / file)
    image, alt = box(rpc, 1.0, 4_000)
    ground = rpc.localize(image, alt)
    assert np.isfinite(ground).all()
    error = np.abs(rpc.project(ground) - image).max()
    assert error <= 1e-9 + 1.1 * rounding(rpc, ground)
    assert error <= 3e-9


@pytest.mark.few(1)
@pytest.mark.parametrize(("file", "reach", "count"), FAR)
def test_far_out_no_point_raises_and_none_is_silently_wrong(file, reach, count, shared_data):
    rpc = read_rpc(shared_data / file)
    image, alt = box(rpc, reach, count)
    ground = rpc.localize(image, alt)
    found = np.isfinite(ground).all(axis=1)
    assert np.isnan(ground[~found]).all()
    error = np.abs(rpc.project(ground[found]) - image[found])
    assert (error <= 1e-8 + 1e-12 * np.abs(image[found])).all()
    if reach == 3.0:
        assert found.all()


@pytest.mark.few(2)
@few_vendors
def test_a_point_found_far_out_lies_on_the_sheet_of_the_centre(file, shared_data):
    """A quotient of cubics has other preimages; across a pole or a fold they are no view of the camera."""
    rpc = read_rpc(shared_data / file)
    image, alt = box(rpc, 300.0, 4000)
    ground = rpc.localize(image, alt)
    ground = ground[np.isfinite(ground).all(axis=1)]
    denominators = rpc.coeffs[1::2] @ monomials(rpc.normalize(np.vstack([rpc.ground_offset, ground])))
    assert (np.sign(denominators) == np.sign(denominators[:, :1])).all()
    _, jacobian = rpc.project_jacobian(np.vstack([rpc.ground_offset, ground]))
    orientation = np.sign(np.linalg.det(jacobian[:, :, :2]))
    assert (orientation == orientation[0]).all()


@vendors
def test_the_jacobian_is_the_central_difference(file, shared_data):
    rpc = read_rpc(shared_data / file)
    ground = rpc.localize(*box(rpc, 0.9, 200))
    value, _ = rpc.project_jacobian(ground)
    np.testing.assert_allclose(value, rpc.project(ground), rtol=0, atol=1e-9 + 1e-13 * np.abs(value).max())
    assert slopes_off(rpc, ground, 1e-4 * np.abs(rpc.ground_scale)) < 2e-6


def test_a_chunk_border_shows_nowhere():
    rpc = make_rpc()
    image, alt = box(rpc, 1.0, 8192 * 2 + 5)
    ground = rpc.localize(image, alt)
    pieces = np.concatenate([rpc.localize(image[i : i + 1000], alt[i : i + 1000]) for i in range(0, len(alt), 1000)])
    np.testing.assert_allclose(pieces, ground, rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        rpc.project(ground),
        np.concatenate([rpc.project(g) for g in np.array_split(ground, 7)]),
        rtol=0,
        atol=1e-10,
    )
    value, jacobian = rpc.project_jacobian(ground)
    np.testing.assert_allclose(value, image, rtol=0, atol=2e-9)
    assert jacobian.shape == (len(alt), 2, 3)


def test_one_bad_point_among_many_is_nan_alone():
    rpc = make_rpc()
    image, alt = box(rpc, 1.0, 1000)
    image[17, 0], image[18, 1], alt[19] = np.nan, np.inf, np.nan
    ground = rpc.localize(image, alt)
    bad = np.isin(np.arange(1000), [17, 18, 19])
    np.testing.assert_array_equal(np.isnan(ground).any(axis=1), bad)
    clean = rpc.localize(image[~bad], alt[~bad])
    np.testing.assert_allclose(ground[~bad], clean, rtol=0, atol=1e-13)
    projected = rpc.project(ground)
    np.testing.assert_array_equal(np.isnan(projected).any(axis=1), bad)
    _, jacobian = rpc.project_jacobian(ground)
    np.testing.assert_array_equal(np.isnan(jacobian).all(axis=(1, 2)), bad)


def test_a_vanishing_denominator_gives_nan_not_infinity():
    coeffs = np.zeros((4, 20))
    coeffs[0, 1] = coeffs[2, 2] = coeffs[1, 0] = coeffs[3, 0] = 1.0
    coeffs[1, 1] = 1.0  # a pole at normalised longitude -1
    rpc = RPC(coeffs, [0.0] * 3, [1.0] * 3, [0.0] * 2, [1000.0] * 2)
    image = rpc.project([[-1.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    assert np.isnan(image[0]).all()
    np.testing.assert_allclose(image[1], [1000 / 3, 0.0])
    beyond = rpc.localize([[1500.0, 0.0]], [0.0])  # seen only across the pole, at longitude -3
    assert np.isnan(beyond).all()


@pytest.mark.parametrize("lon", [179.97, -179.97, 180.0, -180.0])
def test_longitudes_count_by_whole_turns(lon):
    rpc = make_rpc(lon=lon)
    image, alt = box(rpc, 1.0, 500)
    ground = rpc.localize(image, alt)
    assert np.abs(ground[:, 0] - lon).max() < 1.0  # continuous across the antimeridian
    for turn in (-360.0, 360.0):
        np.testing.assert_allclose(rpc.project(ground + [turn, 0, 0]), image, rtol=0, atol=2e-8)
    wrapped = (ground[:, :1] + 180) % 360 - 180
    np.testing.assert_allclose(rpc.project(np.hstack([wrapped, ground[:, 1:]])), image, rtol=0, atol=2e-8)


def test_an_offset_of_0_to_360_is_the_same_camera():
    here, there = make_rpc(lon=-60.0), make_rpc(lon=300.0)
    ground = here.localize(*box(here, 1.0, 500))
    np.testing.assert_allclose(there.project(ground), here.project(ground), rtol=0, atol=2e-8)


def plain(offset: tuple[float, float, float], scale: tuple[float, float, float]) -> RPC:
    """Columns run east, rows south, a hundred pixels a scale: col = 100 L, row = -100 P."""
    coeffs = np.zeros((4, 20))
    coeffs[0, 1], coeffs[2, 2], coeffs[1::2, 0] = 1.0, -1.0, 1.0
    return RPC(coeffs, offset, scale, [0.0, 0.0], [100.0, 100.0])


@pytest.mark.parametrize(
    ("offset", "scale", "image", "found"),
    [
        ((0.0, 0.0, 0.0), (160.0, 10.0, 100.0), (112.0, 0.0), True),  # 179.2 degrees east
        ((0.0, 0.0, 0.0), (160.0, 10.0, 100.0), (113.0, 0.0), False),
        ((20.0, 0.0, 0.0), (160.0, 10.0, 100.0), (-112.0, 0.0), True),  # half a turn counts from the offset
        ((20.0, 0.0, 0.0), (160.0, 10.0, 100.0), (-113.0, 0.0), False),
        ((0.0, 0.0, 0.0), (10.0, 75.0, 100.0), (0.0, -119.0), True),  # 89.25 degrees north
        ((0.0, 0.0, 0.0), (10.0, 75.0, 100.0), (0.0, -121.0), False),
        ((0.0, 80.0, 0.0), (10.0, 9.0, 100.0), (0.0, -110.0), True),
        ((0.0, 80.0, 0.0), (10.0, 9.0, 100.0), (0.0, -112.0), False),
        ((0.0, -80.0, 0.0), (10.0, 9.0, 100.0), (0.0, 112.0), False),
        ((0.0, 80.0, 0.0), (10.0, -9.0, 100.0), (0.0, 112.0), False),
        ((0.0, 0.0, 0.0), (-160.0, 10.0, 100.0), (113.0, 0.0), False),
    ],
)
def test_ground_lies_within_half_a_turn_of_the_offset_and_between_the_poles(offset, scale, image, found):
    rpc = plain(offset, scale)
    ground = rpc.localize(np.array([image]), np.zeros(1))[0]
    assert np.isfinite(ground).all() == found
    if found:
        np.testing.assert_allclose(ground[:2], np.array(offset[:2]) + np.array(scale[:2]) * image / [100, -100])


def test_there_is_no_ground_beyond_a_pole():
    rpc = make_rpc(lat=89.95)
    image, alt = box(rpc, 1.0, 4000)
    ground = rpc.localize(image, alt)
    lost = np.isnan(ground).any(axis=1)
    assert 0 < lost.sum() < len(lost)
    assert np.nanmax(ground[:, 1]) <= 90.0


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    lon=st.floats(-180, 180),
    lat=st.floats(-85, 85),
    scale=st.floats(1e-3, 0.5),
    seed=st.integers(0, 1000),
)
def test_any_camera_of_this_kind_localises_what_it_projects(lon, lat, scale, seed):
    base = make_rpc(lon, lat, seed)
    rpc = replace(base, ground_scale=base.ground_scale * [scale, scale, 1.0])
    image, alt = box(rpc, 1.0, 50, seed)
    ground = rpc.localize(image, alt)
    assert np.abs(rpc.project(ground) - image).max() <= 1e-9 + 1.1 * rounding(rpc, ground)


@pytest.mark.parametrize("col", [0.0, 4e8])
def test_a_point_found_far_out_may_be_off_by_the_rounding_of_its_pixel(col):
    """1e-8 px and a part in 10^12 of the pixel's number."""
    rpc = replace(plain((0.0, 0.0, 0.0), (160.0, 10.0, 100.0)), image_offset=[col, 0.0])
    ground, allowed = np.array([[3.0, 2.0, 0.0]] * 2), 1e-8 + 1e-12 * col
    seen = rpc.project(ground)
    for share, holds in ((0.7, True), (1.3, False)):
        off = seen + np.array([[share * allowed, 0.0], [0.0, share * 1e-8]])
        np.testing.assert_array_equal(rpc._holds(ground, off), [holds, holds])


def test_an_rpc_tells_its_box():
    rpc = RPC(make_rpc().coeffs, [5.0, 43.0, 500.0], [-0.25, 0.5, 400.0], [1000.0, 900.0], [-1100.0, 950.0])
    ground = "lon 4.7500 to 5.2500, lat 42.5000 to 43.5000, 100 to 900 m"
    assert repr(rpc) == f"RPC({ground}, col -100 to 2100, row -50 to 1850)"


def test_rpcs_are_off_by_what_their_image_points_are_apart_over_the_box():
    rpc = make_rpc()
    moved = rpc.crop(3.0, -2.0)
    off = rpc.off(moved)
    assert off.shape == (729, 2)
    np.testing.assert_allclose(off, np.tile([3.0, 2.0], (729, 1)), rtol=0, atol=1e-8)
    coeffs = rpc.coeffs.copy()
    coeffs[0, 1] += 0.01  # of the normalised longitude: most at the sides of the box
    np.testing.assert_allclose(rpc.off(replace(rpc, coeffs=coeffs))[:, 0].max(), 0.01 * 10100, rtol=1e-3)
    pole = np.zeros((4, 20))
    pole[0, 1] = pole[2, 2] = pole[1, 0] = pole[3, 0] = pole[1, 1] = 1.0
    poles = RPC(pole, [0.0] * 3, [1.0] * 3, [0.0] * 2, [1000.0] * 2)
    assert (poles.off(poles) == 0).all()
    whole = replace(poles, coeffs=poles.coeffs * (np.arange(20) != 1) + (np.arange(20) == 1) * [[1], [0], [0], [0]])
    assert np.isnan(poles.off(whole)[:, 0]).sum() == 81  # the side of the box that is a pole for one alone


def test_a_window_of_coarser_pixels_counts_from_its_own_corner():
    """Pixels of 2 x 4: the middle of the new first one is that of eight old ones."""
    rpc = make_rpc()
    coarse = rpc.window(400.0, 30.0, 2.0, 4.0)
    ground = rpc.localize(np.array([400.5, 31.5]), np.array(10.0))
    np.testing.assert_allclose(coarse.project(ground), [0.0, 0.0], atol=1e-7)
    ground = rpc.localize(np.array([400.5 + 20.0, 31.5 + 40.0]), np.array(10.0))
    np.testing.assert_allclose(coarse.project(ground), [10.0, 10.0], atol=1e-7)
    assert rpc.window(400.0, 30.0, 2.0, 1.0) != rpc.crop(400.0, 30.0)


def test_a_crop_and_a_window_of_step_one_are_the_same_to_the_bit():
    rpc = make_rpc()
    assert rpc.crop(12.5, 7.0) == rpc.window(12.5, 7.0)
    np.testing.assert_array_equal(rpc.crop(3, 4).image_offset, rpc.image_offset - [3, 4])


def test_equality_goes_by_content_of_which_the_inverse_that_is_kept_is_no_part():
    """Of arrays, hashes and pickles: `tests/base/test_frozen.py`."""
    rpc, twin = make_rpc(), make_rpc()
    rpc.localize([[1.0, 2.0]], [0.0])
    assert (rpc, hash(rpc)) == (twin, hash(twin))
    assert rpc != replace(rpc, err_bias=None)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coeffs": np.zeros((4, 19))}, "shape"),
        ({"coeffs": np.full((4, 20), np.nan)}, "not finite"),
        ({"coeffs": np.zeros((4, 20))}, "zero everywhere"),
        ({"ground_scale": [1.0, 0.0, 1.0]}, "scale is zero"),
        ({"image_offset": [np.inf, 0.0]}, "not finite"),
    ],
)
def test_a_camera_that_cannot_be_used_is_refused_when_it_is_made(change, message):
    with pytest.raises(RpcError, match=message):
        replace(make_rpc(), **change)


@few_vendors
def test_rpcm_and_the_localisation_agree(file: str, shared_data: Path):
    rpcm = pytest.importorskip("rpcm.rpc_model")
    rpc = read_rpc(shared_data / file)
    model = rpcm.RPCModel(rpc.to_rpcm_dict(), dict_format="rpcm")
    image, alt = box(rpc, 0.9, 300)
    ground = rpc.localize(image, alt)
    col, row = model.projection(ground[:, 0], ground[:, 1], alt)
    assert np.abs(np.column_stack([col, row]) - image).max() <= 3e-9
