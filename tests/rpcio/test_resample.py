"""Resampled images: what the camera of their RPC would have seen, to a fiftieth of a pixel, and no pixel invented."""

from __future__ import annotations

import warnings
from itertools import starmap
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning
from scipy import ndimage

from barpc.base.errors import ImageError, OutputError
from barpc.fit import fit_rpc
from barpc.rasters.raster import open_raster
from barpc.rpcio import grids, read_rpc, write_rpc_vrt
from barpc.rpcio.grids import write_resampled
from barpc.sensor.image_corrections import CorrectionGrid
from barpc.simulate import fly, looks
from tests.jitter import jittered
from tests.lanes import rest_slow
from tests.rpcio.conftest import make_rpc
from tests.scenes.render import render
from tests.scenes.terrain import Plane, make_terrain
from tests.scenes.texture import Date, make_surfaces

SIZE = (420, 360)  # two blocks each way


@pytest.fixture(autouse=True)
def _small_blocks(sized):
    sized(resampled_block=256)


def scenery(col, row):
    """Brightness 0 .. 1 of waves of 5 px and more, anywhere."""
    rng = np.random.default_rng(2)
    out = np.zeros(np.shape(col))
    for period in (5.0, 7.0, 11.0, 17.0, 40.0):
        a, phase = rng.uniform(0, 2 * np.pi, 2)
        out += 0.1 * np.sin(2 * np.pi * (col * np.cos(a) + row * np.sin(a)) / period + phase)
    return out + 0.5


def grid(dcol=lambda c, r: 0.7 * np.sin(r / 90.0), drow=lambda c, r: 0.5 * np.cos(r / 70.0) + c / 1000.0):
    cols, rows = np.linspace(-0.5, SIZE[0] - 0.5, 36), np.linspace(-0.5, SIZE[1] - 0.5, 141)
    c, r = np.meshgrid(cols, rows)
    return CorrectionGrid(cols, rows, np.stack([dcol(c, r) + 0 * c, drow(c, r) + 0 * c], axis=-1))


def raster(path: Path, data: np.ndarray, **profile: object) -> Path:
    options = {"driver": "GTiff", "count": data.shape[0], "height": data.shape[1], "width": data.shape[2]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", **options, dtype=data.dtype, **profile) as out:
            out.write(data)
    return path


def seen(top: float, dtype: str) -> np.ndarray:
    col, row = np.meshgrid(*map(np.arange, SIZE))
    values = scenery(col.astype(float), row.astype(float)) * top
    return (values if dtype == "float32" else np.rint(values)).astype(dtype)[None]


def wanted(lacking: CorrectionGrid, top: float) -> tuple[np.ndarray, np.ndarray]:
    """What should be seen, and where that is well inside the image."""
    at = lacking.apply(np.stack(np.meshgrid(*map(np.arange, SIZE)), axis=-1).astype(float))
    inside = ((at >= 2) & (at <= np.array(SIZE) - 3)).all(axis=-1)
    return scenery(at[..., 0], at[..., 1]) * top, inside


def pixels(path: Path) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as dataset:
            return dataset.read()


def shift(found: np.ndarray, truth, lacking: CorrectionGrid, inside: np.ndarray) -> np.ndarray:
    """How far (dcol, drow) what was found stands from where it should, by least squares."""
    at = lacking.apply(np.stack(np.meshgrid(*map(np.arange, SIZE)), axis=-1).astype(float))
    steps = [np.array([0.5, 0.0]), np.array([0.0, 0.5])]
    slopes = [scenery(*(at + s).T).T - scenery(*(at - s).T).T for s in steps]
    system = np.column_stack([slope[inside] for slope in slopes])
    return np.linalg.lstsq(system, (found - truth)[inside], rcond=None)[0]


@pytest.mark.parametrize(
    ("dtype", "top"),
    rest_slow(starmap(pytest.param, [("float32", 1.0), ("uint8", 250.0), ("uint16", 4000.0)])),
)
def test_every_pixel_is_what_the_camera_of_the_rpc_sees(tmp_path, dtype, top):
    lacking = grid()
    image = raster(tmp_path / "a.tif", seen(top, dtype))
    write_resampled(make_rpc(), lacking, image, tmp_path / "b.tif")
    with rasterio.open(tmp_path / "b.tif") as made:
        assert made.dtypes == (dtype,)
        assert (made.width, made.height) == SIZE
        assert made.profile["compress"] == "deflate"
        assert made.profile["tiled"]
    assert read_rpc(tmp_path / "b.tif").off(make_rpc()).max() < 1e-9
    truth, inside = wanted(lacking, top)
    found = pixels(tmp_path / "b.tif")[0].astype(float)
    step = {"uint8": 1.0, "uint16": 1.0, "float32": 0.0}[dtype]
    off = (found - truth)[inside]
    assert np.sqrt((off**2).mean()) < 0.004 * top + step
    assert np.abs(shift(found / top, truth / top, lacking, inside)).max() < 0.002  # px
    wrong, _ = wanted(CorrectionGrid(lacking.cols, lacking.rows, -lacking.shift), top)
    assert np.sqrt(((found - wrong)[inside] ** 2).mean()) > 0.05 * top  # the other sign


@pytest.mark.parametrize("planted", rest_slow([(0.02, -0.015), (0.02, 0.0), (0.0, -0.015)]))
def test_positions_are_not_rounded(tmp_path, planted):
    """Shifts of less than 1/32 px, which table interpolation would not see."""
    lacking = grid(lambda c, r: planted[0], lambda c, r: planted[1])
    image = raster(tmp_path / "a.tif", seen(1.0, "float32"))
    write_resampled(make_rpc(), lacking, image, tmp_path / "b.tif")
    none = grid(lambda c, r: 0.0, lambda c, r: 0.0)
    truth, inside = wanted(none, 1.0)
    found = shift(pixels(tmp_path / "b.tif")[0], truth, none, inside)
    np.testing.assert_allclose(found, planted, atol=1e-3)


def test_a_correction_of_whole_pixels_moves_numbers_and_changes_none(tmp_path):
    data = np.random.default_rng(1).integers(0, 65535, (2, *SIZE[::-1])).astype(np.uint16)
    image = raster(tmp_path / "a.tif", data)
    write_resampled(make_rpc(), grid(lambda c, r: 3.0, lambda c, r: -2.0), image, tmp_path / "b.tif")
    np.testing.assert_array_equal(pixels(tmp_path / "b.tif")[:, 2:, :-3], data[:, :-2, 3:])


@pytest.mark.slow
def test_blocks_leave_no_seams(tmp_path, sized):
    image = raster(tmp_path / "a.tif", seen(60000.0, "uint16"))
    write_resampled(make_rpc(), grid(), image, tmp_path / "b.tif")
    write_resampled(make_rpc(), grid(), image, tmp_path / "c.tif")
    assert (tmp_path / "b.tif").read_bytes() == (tmp_path / "c.tif").read_bytes()
    sized(resampled_block=512)
    write_resampled(make_rpc(), grid(), image, tmp_path / "c.tif", overwrite=True)
    assert np.abs(np.subtract(*(pixels(tmp_path / f"{name}.tif").astype(int) for name in "bc"))).max() <= 1


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("dtype", "nodata"),
    rest_slow(
        starmap(pytest.param, [("int16", -9999), ("float32", np.nan), ("uint8", 0), ("uint16", 65535)]),
        keep=2,
    ),
)
def test_nodata_stays_nodata_where_it_is_and_comes_nowhere_else(tmp_path, dtype, nodata):
    """Rows 100 .. 199 are unknown: the correction moves them by 1.3 px, nothing bleeds, and no known pixel is lost."""
    data = seen({"uint8": 250.0, "uint16": 60000.0, "int16": 30000.0, "float32": 1.0}[dtype], dtype)
    data[:, 300:330] = 1 if nodata == 0 else data.max()  # around here the spline undershoots
    data[:, 302:328:2] = data.min() if nodata == 0 else nodata - 1 if nodata == 65535 else data.min()
    data[:, 100:200] = nodata
    image = raster(tmp_path / "a.tif", data, nodata=nodata)
    write_resampled(make_rpc(), grid(lambda c, r: 0.3, lambda c, r: 1.3), image, tmp_path / "b.tif")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(tmp_path / "b.tif") as made:
            assert made.nodata == nodata or np.isnan(nodata)
            known, values = made.read_masks(1) != 0, made.read(1)
    assert not known[99:199, :-1].any()
    assert known[:98, :-1].all()
    assert known[200:-2, :-1].all()
    assert not known[-1].any()  # beyond the border: the image ends at row 359 + 0.5
    inside = values[60:98, 5:-5].astype(float)
    truth = scenery(*(np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), -1) + [0.3, 1.3]).T).T
    top = {"uint8": 250.0, "uint16": 60000.0, "int16": 30000.0, "float32": 1.0}[dtype]
    assert np.abs(inside / top - truth[60:98, 5:-5])[:-3].max() < 0.02


@pytest.mark.parametrize(("shift", "lost"), [(0.4, 0), (0.6, 1)])
def test_an_image_ends_half_a_pixel_beyond_its_last_centre(tmp_path, shift, lost):
    image = raster(tmp_path / "a.tif", np.full((1, *SIZE[::-1]), 7, np.uint8), nodata=0)
    write_resampled(make_rpc(), grid(lambda c, r: shift, lambda c, r: -shift), image, tmp_path / "b.tif")
    known = pixels(tmp_path / "b.tif")[0] == 7
    assert known[lost:, : SIZE[0] - lost].all()
    assert known.sum() == (SIZE[0] - lost) * (SIZE[1] - lost)


@pytest.mark.parametrize("shift", [(-500.0, 0.0), (0.0, -500.0), (500.0, 500.0)])
def test_of_an_image_that_is_moved_all_out_of_its_frame_nothing_is_known(tmp_path, shift):
    image = raster(tmp_path / "a.tif", np.full((1, 40, 60), 7, np.uint8), nodata=0)
    write_resampled(make_rpc(), grid(lambda c, r: shift[0], lambda c, r: shift[1]), image, tmp_path / "b.tif")
    assert not pixels(tmp_path / "b.tif").any()


def test_a_mask_and_an_alpha_band_go_along(tmp_path):
    data = seen(200.0, "uint8")
    mask = np.full(SIZE[::-1], 255, np.uint8)
    mask[:, 200:300] = 0
    image = raster(tmp_path / "a.tif", data)
    with warnings.catch_warnings(), rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(image, "r+") as out:
            out.write_mask(mask)
    alpha = raster(tmp_path / "c.tif", np.concatenate([data, mask[None]]), photometric="minisblack", alpha="yes")
    with open_raster(alpha) as dataset:
        assert dataset.colorinterp[1] == ColorInterp.alpha
    for source in (image, alpha):
        write_resampled(
            make_rpc(), grid(lambda c, r: 2.0, lambda c, r: 0.0), source, tmp_path / "b.tif", overwrite=True
        )
        with open_raster(tmp_path / "b.tif") as made:
            found = made.read_masks(1)
        np.testing.assert_array_equal(found[:, :-2], mask[:, 2:])
        assert not found[:, -2:].any()


def test_numbers_that_are_none_do_not_spread(tmp_path):
    data = seen(1.0, "float32")
    data[0, 250:260, 300:310] = np.nan
    data[0, 20, 20] = np.inf
    image = raster(tmp_path / "a.tif", data)
    write_resampled(make_rpc(), grid(lambda c, r: 0.2, lambda c, r: 0.2), image, tmp_path / "b.tif")
    lost = ~np.isfinite(pixels(tmp_path / "b.tif")[0])
    assert lost[250:260, 300:310].all()
    assert lost.sum() == 101


@pytest.mark.slow
def test_a_vrt_is_resampled_like_its_image(tmp_path):
    image = raster(tmp_path / "a.tif", seen(4000.0, "uint16"))
    write_rpc_vrt(make_rpc(), image, tmp_path / "a.vrt")
    for name in ("a.tif", "a.vrt"):
        write_resampled(make_rpc(), grid(), tmp_path / name, tmp_path / f"{name}.out.tif")
    np.testing.assert_array_equal(*(pixels(tmp_path / f"{name}.out.tif") for name in ("a.tif", "a.vrt")))


def test_what_cannot_be_resampled_is_one_line_and_leaves_nothing(tmp_path, monkeypatch):
    image = raster(tmp_path / "a.tif", np.ones((1, 40, 60), np.complex64))
    target = tmp_path / "out" / "b.tif"
    target.parent.mkdir()
    with pytest.raises(ImageError, match=r"a\.tif: complex"):
        write_resampled(make_rpc(), grid(), image, target)
    image = raster(tmp_path / "a.tif", seen(4000.0, "uint16"))
    wild = grid(lambda c, r: 20.0 * c, lambda c, r: 0.0)
    wide = raster(tmp_path / "w.tif", np.ones((1, 10, 9000), np.uint8))
    with pytest.raises(ImageError, match="spreads"):
        write_resampled(make_rpc(), wild, wide, target)
    with pytest.raises(OutputError, match="input image"):
        write_resampled(make_rpc(), grid(), image, image, overwrite=True)
    sums = iter(range(99))
    monkeypatch.setattr(grids, "crc32", lambda data: next(sums))
    with pytest.raises(OutputError, match="other pixels"):
        write_resampled(make_rpc(), grid(), image, target)
    assert not list(target.parent.iterdir())


def test_a_run_that_dies_half_way_leaves_nothing(tmp_path, monkeypatch):
    image = raster(tmp_path / "a.tif", seen(4000.0, "uint16"))
    real, count = grids._resample_block, iter(range(10))

    def dying(*given):
        if next(count) == 2:
            raise KeyboardInterrupt
        return real(*given)

    monkeypatch.setattr(grids, "_resample_block", dying)
    (tmp_path / "out").mkdir()
    with pytest.raises(KeyboardInterrupt):
        write_resampled(make_rpc(), grid(), image, tmp_path / "out" / "b.tif")
    assert not list((tmp_path / "out").iterdir())


def moved(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """How far (dcol, drow) one picture stands from another, by least squares on gradients."""
    drow, dcol = np.gradient(truth)
    system = np.column_stack([dcol.ravel(), drow.ravel()])
    return -np.linalg.lstsq(system, (found - truth).ravel(), rcond=None)[0]


@pytest.mark.slow
def test_a_rendered_image_with_jitter_becomes_that_of_a_camera_without(tmp_path):
    """Relief and houses seen by a camera that swings by a pixel, and by one that does not: strip by strip they agree to
    0.02 px once it is resampled, and by tenths before."""
    size, alts = (220, 600), (200.0, 260.0)
    nominal = fly(np.array([5.4, 43.3, 230.0]), looks(3)[0], size, 0.5)
    rpc, swinging = fit_rpc(nominal, size, alts).rpc, jittered(nominal, 400.0, 1.0)
    rng = np.random.default_rng(5)
    terrain = make_terrain(rng, Plane(5.4, 43.3), (-200.0, -200.0, 200.0, 200.0), 230.0, 20.0, 5.0)
    surface = make_surfaces(rng, terrain, 0.25, [Date()])[0]
    taken, ideal = (
        ndimage.gaussian_filter(render(camera, size, surface).brightness, 0.7) for camera in (swinging, nominal)
    )
    image = raster(tmp_path / "a.tif", np.rint(taken * 30000).astype(np.uint16)[None])
    lacking = CorrectionGrid.between(rpc, swinging, size, 230.0)
    assert np.abs(lacking.shift).max() > 0.7
    write_resampled(rpc, lacking, image, tmp_path / "b.tif")
    made = pixels(tmp_path / "b.tif")[0] / 30000
    strips = [slice(top, top + 80) for top in range(20, 580, 80)]
    after = np.array([moved(made[rows, 10:-10], ideal[rows, 10:-10]) for rows in strips])
    before = np.array([moved(taken[rows, 10:-10], ideal[rows, 10:-10]) for rows in strips])
    assert np.linalg.norm(after, axis=1).max() < 0.02
    assert np.linalg.norm(before, axis=1).max() > 0.3
