"""`barpc ortho`: every pixel of the map shows what the camera sees there, on heights above the ellipsoid."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio

import barpc
from barpc.base.errors import InputError, OutputError, Remark
from barpc.rasters.dem import Dem
from barpc.rpcio import write_rpc_copy
from tests.cli.test_images import run
from tests.geotiffs import write_image
from tests.lanes import rest_slow
from tests.pipeline.known import SAMPLES
from tests.rasters.test_dem import write_geoid
from tests.scenes.files import write_scene
from tests.scenes.images import ImageOptions, Scene
from tests.scenes.season import write_dem as write_ground

SIDE = 400
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")  # of raw images
UTM = pyproj.Transformer.from_crs(32631, 4979, always_xy=True)


def hills(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    return 150 + 40 * np.sin((lon - 5.4) * 1500) * np.cos((lat - 43.3) * 1500)


def write_hills(path: Path, crs: str = "EPSG:4979", less: float = 0.0, start: float = 5.39, **how: object) -> Path:
    """Hills of 80 m on posts of some 15 m, in degrees or in UTM."""
    origin, step, size = (start, 43.31, 1.5e-4), 1.5e-4, 140
    if "32631" in crs:
        origin, step = (694000.0, 4797600.0, 15.0), 15.0
    x, y = np.meshgrid(origin[0] + step * (np.arange(size) + 0.5), origin[1] - step * (np.arange(size) + 0.5))
    lon, lat = UTM.transform(x, y) if "32631" in crs else (np.mod(x + 180, 360) - 180, y)
    place = rasterio.Affine(step, 0, origin[0], 0, -step, origin[1])
    return write_image(path, (hills(lon, lat) - less).astype(np.float32), crs=crs, transform=place, **how)


RAMP = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE))).astype(np.float32)
CAMERA = barpc.read_rpc(SAMPLES[2]).crop(300, 300)


def shot(path: Path, pixels: np.ndarray = RAMP, rpc: barpc.RPC = CAMERA, **profile: object) -> Path:
    """An image that a camera sees; its pixels are their own columns and rows."""
    write_rpc_copy(rpc, write_image(path.with_name("raw.tif"), pixels, **profile), path)
    return path


@pytest.fixture(scope="module")
def ramp(tmp_path_factory) -> Path:
    return shot(tmp_path_factory.mktemp("ramp") / "ramp.tif")


def errors(made: Path, ramp: Path, heights: object, least: float = 0.8) -> np.ndarray:
    """Distance [px] of what the map shows from where the camera sees its pixels' ground, 20 px within the image.

    By PROJ, numpy and the camera: neither GDAL nor the grid of the map has a say.
    """
    with rasterio.open(made) as file:
        shown, crs = file.read(), file.crs
        x, y = file.transform @ np.meshgrid(np.arange(file.width) + 0.5, np.arange(file.height) + 0.5)
    lon, lat = pyproj.Transformer.from_crs(crs, 4326, always_xy=True).transform(x, y)
    alt = heights(lon, lat) if callable(heights) else np.full(lon.shape, heights)
    seen = np.moveaxis(barpc.read_rpc(ramp).project(np.stack([lon, lat, alt], axis=-1)), -1, 0)
    inside = ((seen > 20) & (seen < SIDE - 21)).all(axis=0)
    assert inside.sum() > least * SIDE**2
    return np.linalg.norm(shown - seen, axis=0)[inside]


@pytest.mark.few(1)
@pytest.mark.parametrize(("crs", "start"), [("EPSG:4979", 5.39), ("EPSG:32631", 0.0), ("EPSG:4979", 365.39)])
def test_every_pixel_is_where_the_camera_sees_it_on_the_dem(crs, start, ramp, tmp_path):
    """Of a DEM in degrees, in UTM, and one whose longitudes are a whole turn on."""
    dem, geoid = write_hills(tmp_path / "dem.tif", crs, start=start), "none" if "32631" in crs else None
    (made,) = barpc.ortho(ramp, tmp_path / "maps", dem=dem, geoid=geoid)
    off = errors(made.path, ramp, Dem.open(dem, geoid))
    assert np.isfinite(off).all()
    assert off.max() < 0.1
    assert np.sqrt((off**2).mean()) < 0.02
    flat = errors(made.path, ramp, 150.0)
    assert np.nanmax(flat) > 5  # else the relief would show nothing


@pytest.mark.landing(2)
@pytest.mark.parametrize("start", [179.99, -180.01])
@pytest.mark.parametrize("middle", rest_slow([180.0, 179.9995, -180.0, -179.9995]))
def test_a_scene_across_the_antimeridian_is_whole(middle, start, tmp_path):
    """On DEMs that begin on either side of it; the camera's longitudes go on beyond 180 degrees."""
    east = middle - CAMERA.localize([SIDE / 2, SIDE / 2], 150.0)[0]
    image = shot(tmp_path / "ramp.tif", rpc=replace(CAMERA, ground_offset=CAMERA.ground_offset + [east, 0.0, 0.0]))
    dem = write_hills(tmp_path / "dem.tif", start=start)
    (made,) = barpc.ortho(image, tmp_path / "maps", dem=dem)
    off = errors(made.path, image, Dem.open(dem))
    assert np.isfinite(off).all()
    assert off.max() < 0.1
    with pytest.raises(InputError, match="crs EPSG:3857: lies at both ends of this map"):  # not 40,000 km of it
        barpc.ortho(image, tmp_path / "far", alt=150, crs="EPSG:3857")
    (made,) = barpc.ortho(image, tmp_path / "middle", alt=150, crs="EPSG:3832")  # Mercator about 150 E
    assert errors(made.path, image, 150.0).max() < 0.2


def test_heights_above_a_geoid_are_lifted_to_the_ellipsoid(ramp, tmp_path):
    geoid = write_geoid(tmp_path / "g.gtx", 50.0)
    low, true = write_hills(tmp_path / "low.tif", "EPSG:4326", less=50.0), write_hills(tmp_path / "true.tif")
    (made,) = barpc.ortho(ramp, tmp_path / "maps", dem=low, geoid=str(geoid))
    assert errors(made.path, ramp, Dem.open(true)).max() < 0.1
    wrong = errors(made.path, ramp, lambda lon, lat: Dem.open(true)(lon, lat) - 50.0)
    assert np.nanmedian(wrong) > 10  # px that 50 m are worth here
    assert "g.gtx" in made.heights


def test_without_a_dem_the_altitude_is_the_one_given_or_said(ramp, tmp_path):
    (made,) = barpc.ortho(ramp, tmp_path / "maps", alt=150)
    assert errors(made.path, ramp, 150.0).max() < 0.1
    assert made.heights == "all ground at 150 m"
    with pytest.warns(Remark, match="terrain height unknown, 250 m assumed"):
        (made,) = barpc.ortho(ramp, tmp_path / "assumed")
    assert errors(made.path, ramp, 250.0).max() < 0.1


def test_where_the_dem_has_a_void_there_are_no_pixels_and_beyond_it_no_map(ramp, tmp_path):
    dem = write_hills(tmp_path / "dem.tif", nodata=-9999.0)
    with rasterio.open(dem, "r+") as file:
        heights = file.read(1)
        heights[:, :73] = -9999.0
        file.write(heights, 1)
    with pytest.warns(Remark, match=r"the DEM has no height under 0\.\d+ of the image"):
        (made,) = barpc.ortho(ramp, tmp_path / "maps", dem=dem)
    with rasterio.open(made.path) as file:
        shown = file.read(1)
        edge, _ = pyproj.Transformer.from_crs(4326, file.crs, always_xy=True).transform(5.39 + 73 * 1.5e-4, 43.3)
        col = int((edge - file.transform.c) / file.transform.a)
        assert np.isnan(file.nodata)
    assert np.isnan(shown[:, : col - 40]).all()
    assert np.isfinite(shown[SIDE // 2, col + 40 : col + 80]).all()
    with pytest.raises(InputError, match=r"far\.tif: has no height at the images' position"):
        barpc.ortho(ramp, tmp_path / "none", dem=write_hills(tmp_path / "far.tif", start=7.0))
    assert not (tmp_path / "none").exists()


def test_numbers_keep_their_type_and_what_meant_nothing_still_does(tmp_path):
    pixels = np.full((1, SIDE, SIDE), 7, np.uint16)
    pixels[:, :, : SIDE // 2] = 65535
    with rasterio.open(shot(tmp_path / "a.tif", pixels, nodata=65535)) as image:
        (made,) = barpc.ortho(image, tmp_path / "maps", alt=150, crs="EPSG:2154", gsd=1)
    assert (made.crs, made.gsd) == ("EPSG:2154", 1.0)
    with rasterio.open(made.path) as file:
        shown = file.read(1)
        assert (file.dtypes, file.nodata, file.crs.to_epsg()) == (("uint16",), 65535, 2154)
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert file.transform.c % 1 == file.transform.f % 1 == 0  # maps of one size of pixel lie on one grid
    assert set(np.unique(shown)) == {7, 65535}
    assert 0.1 < (shown == 7).mean() < 0.5


def test_nothing_is_replaced_and_radar_s_complex_pixels_are_named(ramp, tmp_path, capsys):
    assert run("ortho", ramp, "--alt", 150, "-o", tmp_path / "maps", "--json") == 0
    (told,) = json.loads(capsys.readouterr().out)
    assert (told["crs"], told["gsd"], Path(told["path"]).name) == ("EPSG:32631", 0.5, "ramp.tif")
    before = (tmp_path / "maps/ramp.tif").read_bytes()
    assert run("ortho", ramp, "--alt", 100, "-o", tmp_path / "maps") == 1
    assert "give --overwrite or another -o" in capsys.readouterr().err
    assert (tmp_path / "maps/ramp.tif").read_bytes() == before
    assert run("ortho", ramp, "--alt", 150, "--overwrite", "-o", tmp_path / "maps") == 0
    assert (tmp_path / "maps/ramp.tif").read_bytes() == before
    assert run("ortho", ramp, "--alt", 150, "--overwrite", "-o", ramp.parent) == 1
    assert "is an input and is never written" in capsys.readouterr().err
    waves = shot(tmp_path / "complex.tif", np.ones((SIDE, SIDE), np.complex64))
    with pytest.raises(InputError, match=r"complex\.tif: complex pixels"):
        barpc.ortho(waves, tmp_path / "other", alt=150)
    assert not list((tmp_path / "other").glob("*.tif"))
    with pytest.raises(InputError, match="gsd must be a number above 0"):
        barpc.ortho(ramp, tmp_path / "other", alt=150, gsd=0)
    for gsd in (1e-6, 1e6):  # neither a map without end nor an image in one pixel
        with pytest.raises(InputError, match=r"an image pixel of 0\.5\d? m: give 0\.05\d* m to 3\d m"):
            barpc.ortho(ramp, tmp_path / "other", alt=150, gsd=gsd)
    with pytest.raises(InputError, match="shows no ground at 9e"):
        barpc.ortho(ramp, tmp_path / "other", alt=9e9)
    with pytest.raises(OutputError):
        barpc.ortho(ramp, waves, alt=150)


def test_a_coarse_map_is_the_mean_of_the_image_s_pixels(ramp, tmp_path):
    (made,) = barpc.ortho(ramp, tmp_path / "maps", alt=150, gsd=5)
    off = errors(made.path, ramp, 150.0, least=0.005)
    assert off.max() < 0.5
    assert made.size[0] < SIDE / 8


def moved(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """How far b lies from a, col, row [px], by the peak of their phase correlation."""
    import cv2

    window = cv2.createHanningWindow(a.shape[::-1], cv2.CV_64F)
    return np.array(cv2.phaseCorrelate(a.astype(np.float64), b.astype(np.float64), window)[0])


@pytest.mark.costs(3)
@pytest.mark.slow
def test_orthoimages_of_one_scene_lie_on_each_other(tmp_path):
    """Rendered views of bare ground, 25 degrees apart: their maps agree on true heights, and not on a level."""
    options = ImageOptions(views=2, size=(700, 700), seed=4, relief=80.0, buildings=0.0, attitude=0.0, position=0.0)
    images = write_scene(tmp_path / "scene", options)
    dem = write_ground(tmp_path / "dem.tif", Scene(options), 0, error=0.0, spacing=5.0)
    found = []
    for how in ({"dem": dem}, {"alt": 230.0}):
        made = barpc.ortho(images, tmp_path / next(iter(how)), **how)
        shown = []
        for one in made:
            with rasterio.open(one.path) as file:
                left, top = round(file.transform.c / one.gsd), round(file.transform.f / one.gsd)
                shown.append((left, top, file.read(1)))
        left, top = max(one[0] for one in shown), min(one[1] for one in shown)
        cut = [
            pixels[north - top + 250 : north - top + 570, left - west + 250 : left - west + 570]
            for west, north, pixels in shown
        ]
        parts = [(slice(i, i + 160), slice(j, j + 160)) for i in (0, 160) for j in (0, 160)]
        found.append(np.array([np.linalg.norm(moved(cut[0][part], cut[1][part])) for part in parts]))
    assert found[0].max() <= 0.5
    assert found[1].max() > 1.5
