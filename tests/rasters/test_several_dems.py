"""Several DEMs: the first that has a height counts, each above what it says, and tiles that abut have no seam."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.warp import transform

from barpc.base.errors import BarpcWarning, InputError
from barpc.rasters.dem import Dem, HeightGrid, localize_on_terrain
from barpc.rasters.vertical import geoid_file
from tests.rasters.test_dem import STEP, write_dem, write_geoid

HIGH, LAT = 37.0, 44.0


def plane(lon, lat):
    """The truth, ellipsoidal: linear, so that bilinear heights are exact wherever posts lie."""
    return 300.0 + 900.0 * (np.asarray(lon) - 5.0) - 700.0 * (np.asarray(lat) - LAT)


def tile(
    path: Path, west: float, cols: int, crs: object = 4979, lower: float = 0.0, step: float = STEP, rows: int = 21
):
    """A tile of the plane whose first cell's edge is `west`; its numbers are `lower` metres below the plane."""
    lon, lat = np.meshgrid(west + step * (np.arange(cols) + 0.5), LAT - step * (np.arange(rows) + 0.5))
    heights = (plane(lon, lat) - lower).astype(np.float64)
    return write_dem(path, crs, heights, transform=rasterio.Affine(step, 0, west, 0, -step, LAT))


def across(west: float, east: float, n: int = 400):
    return np.linspace(west, east, n), np.full(n, LAT - 10.3 * STEP)


def test_tiles_that_abut_have_no_seam_whatever_each_counts_from(tmp_path) -> None:
    """One above a geoid by its CRS, one ellipsoidal by its CRS: without the datum of each 37 m would lie between."""
    geoid = write_geoid(tmp_path / "g.gtx", HIGH)
    a = tile(tmp_path / "a.tif", 5.0, 30)
    b = tile(tmp_path / "b.tif", 5.3, 30, "EPSG:4326+5703", lower=HIGH)
    lon, lat = across(5.01, 5.59)
    alone = Dem.open(a)(lon, lat)
    for order in ((a, b), (b, a)):
        dem = Dem.open(order, geoid)
        np.testing.assert_allclose(dem(lon, lat), plane(lon, lat), atol=1e-6)
        assert dem.known
        assert np.isnan(dem(5.0, 45.0))
    assert np.isnan(alone).any()


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 2, 1, 0), (2, 0, 3, 1)])
def test_where_four_tiles_meet_heights_are_those_of_one_grid(order, tmp_path) -> None:
    rng = np.random.default_rng(1)
    heights, corner = rng.uniform(0, 500, (20, 24)), rasterio.Affine(STEP, 0, 5, 0, -STEP, LAT)
    whole, parts = Dem.open(write_dem(tmp_path / "w.tif", 4979, heights, transform=corner)), []
    for i, (rows, cols) in enumerate((r, c) for r in ((0, 9), (9, 20)) for c in ((0, 11), (11, 24))):
        moved = rasterio.Affine(STEP, 0, 5 + STEP * cols[0], 0, -STEP, LAT - STEP * rows[0])
        parts.append(write_dem(tmp_path / f"{i}.tif", 4979, heights[slice(*rows), slice(*cols)], transform=moved))
    lon, lat = rng.uniform((5.01, LAT - 0.19), (5.23, LAT - 0.01), (3000, 2)).T
    found = Dem.open([parts[i] for i in order])(lon, lat)
    np.testing.assert_allclose(found, whole(lon, lat), atol=1e-6)


def test_the_first_that_has_a_height_counts_and_the_order_is_that_of_the_files(tmp_path) -> None:
    a, b = tile(tmp_path / "a.tif", 5.0, 40), tile(tmp_path / "b.tif", 5.2, 40, lower=100.0)
    lon, lat = across(5.25, 5.35)
    np.testing.assert_allclose(Dem.open((a, b))(lon, lat), plane(lon, lat), atol=1e-6)
    np.testing.assert_allclose(Dem.open((b, a))(lon, lat), plane(lon, lat) - 100.0, atol=1e-6)
    # a scalar, and places of any shape
    assert Dem.open((a, b))(5.3, 43.9) == pytest.approx(plane(5.3, 43.9))
    assert Dem.open((a, b))(np.full((2, 1), 5.3), np.full(3, 43.9)).shape == (2, 3)


def test_a_gap_of_a_tile_is_none_and_voids_are_filled_by_the_next(tmp_path) -> None:
    a, c = tile(tmp_path / "a.tif", 5.0, 20), tile(tmp_path / "c.tif", 5.23, 20)
    dem = Dem.open((a, c))
    lon, lat = across(5.196, 5.234)
    assert np.isnan(dem(lon, lat)).all()
    lon, lat = np.meshgrid(5.0 + STEP * (np.arange(40) + 0.5), LAT - STEP * (np.arange(21) + 0.5))
    heights = plane(lon, lat)
    heights[5:9, 10:20] = -9999.0
    holed = write_dem(tmp_path / "h.tif", 4979, heights, transform=rasterio.Affine(STEP, 0, 5, 0, -STEP, LAT))
    coarse = tile(tmp_path / "k.tif", 4.9, 20, step=4 * STEP, rows=10)
    lon, lat = np.random.default_rng(2).uniform((5.09, LAT - 0.1), (5.22, LAT - 0.04), (500, 2)).T
    assert np.isnan(Dem.open(holed)(lon, lat)).any()
    np.testing.assert_allclose(Dem.open((holed, coarse))(lon, lat), plane(lon, lat), atol=1e-6)


def test_tiles_of_two_map_zones_meet(tmp_path) -> None:
    """North of 6 degrees east zones 31 and 32 meet: their grids are turned against each other."""

    def zone(path: Path, code: int, west: float, east: float) -> Path:
        (x0, x1), (y0, y1) = transform("EPSG:4326", f"EPSG:{code}", [west, east], [43.8, 44.0])
        cols, rows, step = int((x1 - x0) / 30) + 1, int(abs(y1 - y0) / 30) + 1, 30.0
        x, y = np.meshgrid(x0 + step * (np.arange(cols) + 0.5), max(y0, y1) - step * (np.arange(rows) + 0.5))
        lon, lat = (np.reshape(one, x.shape) for one in transform(f"EPSG:{code}", "EPSG:4326", x.ravel(), y.ravel()))
        forward = rasterio.Affine(step, 0, x0, 0, -step, max(y0, y1))
        return write_dem(path, code, plane(lon, lat), transform=forward)

    parts = zone(tmp_path / "a.tif", 32631, 5.9, 6.02), zone(tmp_path / "b.tif", 32632, 5.99, 6.1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BarpcWarning)
        dem = Dem.open(parts, "none")
    lon, lat = np.random.default_rng(3).uniform((5.92, 43.86), (6.08, 43.94), (2000, 2)).T
    np.testing.assert_allclose(dem(lon, lat), plane(lon, lat), atol=0.01)


def test_a_place_that_a_map_does_not_know_is_left_to_the_next(tmp_path) -> None:
    """Half a turn away from a zone, at a place that is none, and around the Earth's back."""
    corner = rasterio.Affine(30, 0, 5e5, 0, -30, 4.7e6)
    here = write_dem(tmp_path / "u.tif", "EPSG:32631+5773", np.full((50, 50), 7.0), transform=corner)
    there = tile(tmp_path / "a.tif", 179.95, 20)
    lon, lat = np.array([180.0, -179.95, 93.0, np.nan, 3.005]), np.array([43.9, 43.9, 0.0, 1.0, 42.445])
    for order in ((here, there), (there, here)):
        found = Dem.open(order)(lon, lat)
        np.testing.assert_allclose(found[:2], plane([180.0, 180.05], 43.9), atol=1e-6)
        assert np.isnan(found[2:4]).all()
        assert 50.0 < found[4] < 65.0  # EGM96's 50 m and more
    assert np.isnan(Dem.open(here)(lon[:4], lat[:4])).all()


def test_tiles_that_meet_at_the_date_line_have_no_seam(tmp_path) -> None:
    parts = []
    for name, west in (("a.tif", 179.8), ("b.tif", -180.0)):
        lon, lat = np.meshgrid(west % 360 + STEP * (np.arange(20) + 0.5), LAT - STEP * (np.arange(20) + 0.5))
        forward = rasterio.Affine(STEP, 0, west, 0, -STEP, LAT)
        parts.append(write_dem(tmp_path / name, 4979, plane(lon, lat), transform=forward))
    lon = np.linspace(179.81, 180.19, 300)
    for shift in (0.0, 360.0):
        np.testing.assert_allclose(Dem.open(parts)(lon - shift, np.full(300, 43.9)), plane(lon, 43.9), atol=1e-6)


# --- what each counts from ------------------------------------------------------------------------------------------


def test_what_is_given_holds_for_those_that_say_nothing(tmp_path) -> None:
    geoid = write_geoid(tmp_path / "g.gtx", HIGH)
    silent, own = tile(tmp_path / "s.tif", 5.0, 20, 4326), tile(tmp_path / "e.tif", 5.2, 20, "EPSG:4326+5773")
    where = np.array([5.1, 5.3]), np.array([43.9, 43.9])
    egm96 = HeightGrid.open(geoid_file("egm96")).sample(*where)
    np.testing.assert_allclose(Dem.open((silent, own), geoid)(*where) - plane(*where), [HIGH, egm96[1]], atol=1e-6)
    with pytest.warns(BarpcWarning, match=r"DEM s\.tif: .* TAKEN AS ELLIPSOIDAL"):
        dem = Dem.open((silent, own))
    np.testing.assert_allclose(dem(*where) - plane(*where), [0.0, egm96[1]], atol=1e-6)
    assert not dem.known
    assert re.search(r"s\.tif: .*; e\.tif: vertical reference EGM96 height, made ellipsoidal", dem.description)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dem = Dem.open((silent, own), "none")
    np.testing.assert_allclose(dem(*where) - plane(*where), [0.0, egm96[1]], atol=1e-6)
    assert dem.known


def test_a_grid_that_is_given_takes_the_place_of_one_that_stands_in(tmp_path) -> None:
    geoid = write_geoid(tmp_path / "g.gtx", HIGH)
    other, level = tile(tmp_path / "n.tif", 5.0, 20, "EPSG:4326+5703"), tile(tmp_path / "l.tif", 5.2, 20)
    where = np.array([5.1, 5.3]), np.array([43.9, 43.9])
    np.testing.assert_allclose(Dem.open((other, level), geoid)(*where) - plane(*where), [HIGH, 0.0], atol=1e-6)


@pytest.mark.parametrize("geoid", ["egm96", "none"])
def test_a_geoid_for_dems_that_say_it_all_is_refused(geoid, tmp_path) -> None:
    parts = tile(tmp_path / "a.tif", 5.0, 20, "EPSG:4326+5773"), tile(tmp_path / "b.tif", 5.2, 20)
    with pytest.raises(InputError, match=rf"a\.tif, .*b\.tif: each says what .*; leave out the geoid {geoid}"):
        Dem.open(parts, geoid)


# --- posts and lines of sight ---------------------------------------------------------------------------------------


def test_posts_are_those_of_the_dem_that_counts(tmp_path) -> None:
    a, b = tile(tmp_path / "a.tif", 5.0, 20), tile(tmp_path / "b.tif", 5.1, 30)
    dem = Dem.open((a, b))
    lon, lat = np.array([5.05, 5.051, 5.15, 5.15, 5.3, 5.9]), np.full(6, 43.903)
    numbers = dem.posts(lon, lat)
    assert (numbers[0] == numbers[1]).all()
    assert (numbers[2] == numbers[3]).all()
    assert np.isnan(numbers[5]).all()
    assert len(np.unique(numbers[:5])) == 12
    swapped = Dem.open((b, a)).posts(lon, lat)
    for got, first, other in ((numbers, a, 2), (swapped, b, 2)):  # where both cover, the first's
        alone = Dem.open(first).posts(lon[[other]], lat[[other]])
        assert (got[[other]] == alone).all()
    grid = np.stack(np.meshgrid(np.linspace(5.006, 5.394, 300), np.linspace(43.8, 43.99, 100)), -1).reshape(-1, 2)
    count = len(np.unique(dem.posts(*grid.T)[np.isfinite(dem(*grid.T))]))
    assert 0.9 * 20 * 40 <= count <= 1.1 * 21 * 40


def test_lines_of_sight_pass_from_one_tile_to_the_next(tmp_path) -> None:
    class Oblique:
        """Rays 60 degrees off the vertical: to the east by 1.7 m a metre of height."""

        def localize(self, image, alt):
            lon, lat = np.moveaxis(np.asarray(image, float), -1, 0)
            return np.stack(np.broadcast_arrays(lon - np.asarray(alt) * 1.7 / 80_000, lat, np.asarray(alt, float)), -1)

    dem = Dem.open((tile(tmp_path / "a.tif", 5.0, 30), tile(tmp_path / "b.tif", 5.3, 30)))
    image = np.stack(across(5.03, 5.55), -1)
    found = localize_on_terrain(Oblique(), image, dem, (-200.0, 2000.0))
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[:, 2], plane(found[:, 0], found[:, 1]), atol=1e-3)
