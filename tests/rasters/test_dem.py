"""Terrain heights: known tiles, vertical references, voids, where lines of sight meet the ground."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
import rasterio.shutil

from barpc.base.errors import BarpcWarning, ImageError, InputError
from barpc.base.geodesy import DEFAULT, STATED
from barpc.rasters.dem import Dem, HeightGrid, datum_of, localize_on_terrain
from barpc.rasters.vertical import Vertical, geoid_file, vertical_of
from barpc.rpcio import read_rpc
from barpc.sensor.rpc import altitude_range
from tests.sensor.conftest import make_rpc

STEP = 0.01
GEOID = geoid_file("egm96")


def write_dem(
    path: Path, crs: object, heights: np.ndarray | None = None, band: dict[str, object] | None = None, **profile: object
) -> Path:
    """A plane of heights h = 100 + 10 col + row, nodes every hundredth of a degree from 5 E, 44 N."""
    if heights is None:
        row, col = np.mgrid[:21, :31]
        heights = (100.0 + 10 * col + row).astype(np.float32)
    transform = rasterio.Affine(STEP, 0, 5 - STEP / 2, 0, -STEP, 44 + STEP / 2)
    options = {"driver": "GTiff", "width": heights.shape[1], "height": heights.shape[0], "count": 1}
    options |= {"dtype": heights.dtype, "crs": crs, "transform": transform, "nodata": -9999.0} | profile
    with rasterio.open(path, "w", **options) as out:
        for name, value in (band or {}).items():  # scales, offsets, units
            setattr(out, name, (value,))
        out.write(heights, 1)
    return path


def header(shape: tuple[int, ...] = (19, 36), south: float = -90.0, step: float = 10.0) -> bytes:
    """Of a .gtx whose nodes begin at 180 degrees west."""
    return np.array([south, -180.0, step, step], ">f8").tobytes() + np.array(shape, ">i4").tobytes()


def write_geoid(path: Path, heights: float | np.ndarray = 50.0) -> Path:
    """A global .gtx with nodes every ten degrees, all of one height where one is given."""
    path.write_bytes(header() + np.broadcast_to(heights, (19, 36)).astype(">f4").tobytes())
    return path


def test_heights_between_nodes_are_bilinear(tmp_path):
    dem = Dem.open(write_dem(tmp_path / "a.tif", 4979))
    lon, lat = 5 + STEP * np.array([0.0, 3.5, 30.0]), 44 - STEP * np.array([0.0, 7.25, 20.0])
    np.testing.assert_allclose(dem(lon, lat), [100.0, 142.25, 420.0], atol=1e-6)
    assert dem(5.005, 43.995) == pytest.approx(105.5)


@pytest.mark.parametrize("shape", [(40, 5), (5, 40)])
def test_a_strip_is_read_to_its_ends_whichever_way_it_lies(shape, tmp_path):
    row, col = np.mgrid[: shape[0], : shape[1]]
    dem = Dem.open(write_dem(tmp_path / "a.tif", 4979, (100.0 + 10 * col + row).astype(np.float32)))
    at = np.array([[0.5, 0.5], [shape[1] - 1.5, shape[0] - 1.5], [shape[1] - 1.0, shape[0] - 1.0]])
    found = dem(*(np.array([5.0, 44.0]) + STEP * at * [1, -1]).T)
    np.testing.assert_allclose(found, 100.0 + at @ [10.0, 1.0], atol=1e-6)


def test_outside_and_where_a_void_has_weight_there_is_no_height(tmp_path):
    row, col = np.mgrid[:21, :31]
    heights = (100.0 + 10 * col + row).astype(np.float32)
    heights[5, 5] = -9999.0
    dem = Dem.open(write_dem(tmp_path / "a.tif", 4979, heights))
    at = 5 + STEP * np.array([4.5, 5.5, 4.0, 4.0, 6.0, -0.1, 30.1])
    lat = 44 - STEP * np.array([4.5, 5.5, 4.0, 5.0, 5.0, 3.0, 3.0])
    expected = [np.nan, np.nan, 144.0, 145.0, 165.0, np.nan, np.nan]
    np.testing.assert_allclose(dem(at, lat), expected, atol=1e-6)


def test_ellipsoidal_heights_are_taken_without_a_word(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dem = Dem.open(write_dem(tmp_path / "a.tif", 4979))
        assert dem(5.0, 44.0) == pytest.approx(100.0)
    assert "reference ellipsoid, ellipsoidal" in dem.description
    assert dem.known


def test_heights_above_a_geoid_are_made_ellipsoidal_and_it_is_said(tmp_path):
    path = write_dem(tmp_path / "a.tif", "EPSG:4326+5773")
    dem = Dem.open(path, write_geoid(tmp_path / "g.gtx"))
    assert dem(5.0, 44.0) == pytest.approx(150.0)
    assert "EGM96 height, made ellipsoidal with g.gtx" in dem.description
    assert dem.known


def surface(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    """Ellipsoidal altitudes [m] of a plane, which any file is to give."""
    return 180.0 + 2000.0 * (lon - 5.0) - 900.0 * (lat - 44.0)


@pytest.mark.landing(50)
@pytest.mark.few(25)
@pytest.mark.parametrize(
    ("crs", "geoid", "says"),
    [
        ("EPSG:4979", None, "ellipsoid"),
        ("EPSG:4326+5773", None, "egm96"),  # named by the file
        ("EPSG:4326+5773", "egm96", "egm96"),
        ("EPSG:4326+5773", "none", "ellipsoid"),  # a person knows better
        ("EPSG:4326", "egm96", "egm96"),
        ("EPSG:4326", "none", "ellipsoid"),
        ("EPSG:4326+5703", "egm96", "egm96"),  # NAVD88
        ("EPSG:4326+6360", "egm96", "egm96"),  # the same in US survey feet
        ("EPSG:4326+8228", "egm96", "egm96"),  # in feet
        ("EPSG:4326+5715", "egm96", "egm96"),  # a depth
    ],
)
@pytest.mark.parametrize("stored", ["numbers", "scaled", "integers"])
@pytest.mark.parametrize("unit", ["", "metre", "ft", "US survey foot", "cm"])
def test_a_height_is_one_whatever_unit_and_datum_it_stands_in(tmp_path, crs, geoid, says, stored, unit) -> None:
    """Of bands with a unit that counts, else their CRS', with scale and offset: to a centimetre."""
    lon, lat = np.meshgrid(5.0 + STEP * np.arange(31), 44.0 - STEP * np.arange(21))
    heights = surface(lon, lat)
    if says == "egm96":
        heights = heights - HeightGrid.open(GEOID).sample(lon, lat)
    axis = pyproj.CRS(crs).axis_info[-1]
    of_crs = 1.0 if pyproj.CRS(crs) == pyproj.CRS(4326) else axis.unit_conversion_factor
    metres = {"": of_crs, "metre": 1.0, "ft": 0.3048, "US survey foot": 1200 / 3937, "cm": 0.01}[unit]
    heights = heights / metres * (-1.0 if axis.direction == "down" else 1.0)
    scale, offset = {"numbers": (1.0, 0.0), "scaled": (0.5, -1000.0), "integers": (0.001 / metres, 250.0)}[stored]
    numbers = (heights - offset) / scale
    kind = np.int32 if stored == "integers" else np.float64
    numbers = np.round(numbers).astype(kind) if kind == np.int32 else numbers
    band = {"scales": scale, "offsets": offset} | ({"units": unit} if unit else {})
    path = write_dem(tmp_path / "a.tif", crs, numbers, band)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BarpcWarning)
        dem = Dem.open(path, geoid)
    at = np.array([5.003, 5.1, 5.29]), np.array([43.99, 43.85, 43.81])
    np.testing.assert_allclose(dem(*at), surface(*at), atol=0.01)
    assert dem.known


def test_a_datum_without_a_grid_of_its_own_is_met_by_another_which_is_said(tmp_path) -> None:
    with pytest.warns(BarpcWarning, match="NAVD88 height, made ellipsoidal with egm96.*within some 2 m"):
        dem = Dem.open(write_dem(tmp_path / "a.tif", "EPSG:4326+5703"))
    assert dem(5.0, 44.0) == pytest.approx(100.0 + float(HeightGrid.open(GEOID).sample(5.0, 44.0)))
    assert dem.known


def test_a_unit_that_is_no_length_is_refused(tmp_path) -> None:
    path = write_dem(tmp_path / "a.tif", 4979, band={"units": "kelvin"})
    with pytest.raises(InputError, match=r"a.tif: the unit 'kelvin' of its heights is not known"):
        Dem.open(path)


@pytest.mark.parametrize("stated", [True, False])
def test_tiles_in_a_vrt_are_heights_as_the_tiles_themselves_are(tmp_path, stated) -> None:
    """GDAL's own VRT, and one that leaves the unit to its source, as gdalbuildvrt does: by GDAL and by the tile."""
    tile = write_dem(tmp_path / "a.tif", "EPSG:4979", band={"units": "ft", "scales": 0.5, "offsets": 10.0})
    rasterio.shutil.copy(tile, tmp_path / "a.vrt", driver="VRT")
    text = (tmp_path / "a.vrt").read_text()
    assert all(name in text for name in ("<UnitType>ft", "<Scale>", "<Offset>"))
    (tmp_path / "a.vrt").write_text(text if stated else text.replace("<UnitType>ft</UnitType>", ""))
    dem, own = (Dem.open(tmp_path / name) for name in ("a.vrt", "a.tif"))
    at = np.array([5.003, 5.1, 5.29]), np.array([43.99, 43.85, 43.81])
    np.testing.assert_array_equal(dem(*at), own(*at))
    assert dem(5.0, 44.0) == pytest.approx((100.0 * 0.5 + 10.0) * 0.3048)
    (tmp_path / "a.vrt").write_text(
        text.replace("<SourceBand>1<", "<SourceBand>2<").replace("<UnitType>ft</UnitType>", "")
    )
    with pytest.raises(ImageError, match="there is no band 2"):
        Dem.open(tmp_path / "a.vrt")


def test_an_unknown_reference_raises_a_loud_warning_unless_a_person_says_it(tmp_path):
    path = write_dem(tmp_path / "a.tif", 4326)
    with pytest.warns(BarpcWarning, match="reference unknown, TAKEN AS ELLIPSOIDAL"):
        Dem.open(path)
    dem = Dem.open(path, write_geoid(tmp_path / "g.gtx"))
    assert dem(5.0, 44.0) == pytest.approx(150.0)
    assert Dem.open(path, None, str(tmp_path / "g.gtx"))(5.0, 44.0) == pytest.approx(150.0)
    assert Dem.open(path, "none", str(tmp_path / "g.gtx"))(5.0, 44.0) == pytest.approx(100.0)
    assert Dem.open(path, None, "ellipsoidal").known


def test_a_geoid_for_ellipsoidal_heights_is_a_contradiction(tmp_path):
    with pytest.raises(InputError, match="ellipsoidal already"):
        Dem.open(write_dem(tmp_path / "a.tif", 4979), write_geoid(tmp_path / "g.gtx"))


def test_a_projected_dem_is_met_in_its_own_crs(tmp_path):
    """UTM 31, nodes every kilometre, h = northing in kilometres - 4800."""
    row, _ = np.mgrid[:60, :80]
    transform = rasterio.Affine(1000, 0, 600_000 - 500, 0, -1000, 4_900_000 + 500)
    path = write_dem(tmp_path / "a.tif", "EPSG:32631+5773", (100.0 - row).astype(np.float32), transform=transform)
    dem = Dem.open(path, write_geoid(tmp_path / "g.gtx", 0.0))
    lon, lat = pyproj.Transformer.from_crs(32631, 4326, always_xy=True).transform(630_250.0, 4_880_500.0)
    assert dem(lon, lat) == pytest.approx(80.5, abs=1e-6)


def test_a_grid_that_goes_around_the_earth_has_no_seam(tmp_path):
    grid = HeightGrid.open(write_geoid(tmp_path / "g.gtx", np.cos(np.radians(np.arange(-180, 180, 10.0)))))
    expected = (-1.0 + np.cos(np.radians(170))) / 2
    np.testing.assert_allclose(grid.sample([175.0, -185.0, 535.0, -175.0], 0.0), expected, atol=1e-6)
    assert grid.sample(180.0, 90.0) == pytest.approx(-1.0)


@pytest.mark.parametrize(("step", "columns", "period"), [(10, 36, 36), (10, 37, 36), (10, 35, 0), (16, 22, 22)])
def test_a_grid_goes_around_the_earth_where_no_more_than_half_a_column_lacks(step, columns, period, tmp_path):
    (tmp_path / "g.gtx").write_bytes(header((3, columns), -80.0, step) + bytes(4 * 3 * columns))
    assert HeightGrid.open(tmp_path / "g.gtx").period == period


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("N44E005.hgt", b"x" * 10),
        ("tile.hgt", b"\0" * 2 * 1201**2),
        ("g.gtx", b""),
        ("g.gtx", b"\0" * 400),
        ("g.gtx", header()),
        ("g.gtx", header() + b"\0" * 4 * 19 * 36 + b"more"),
        ("g.gtx", b"II*\0" * 200),
        ("N44E005_v2.hgt", b"\0" * 2 * 1201**2),
    ],
)
def test_a_file_that_is_not_what_its_name_says_is_refused(name, data, tmp_path):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=name.replace(".", r"\.")):
        HeightGrid.open(tmp_path / name)


def test_a_tile_and_a_geoid_are_read_as_their_bytes_stand(tmp_path):
    """SRTM: rows from the north, big-endian, -32768 a void; GTX: rows from the south, -88.8888 a void."""
    rng = np.random.default_rng(4)
    tile = rng.integers(-100, 5000, (1201, 1201)).astype(">i2")
    tile[3, 5] = -32768
    (tmp_path / "S34W071.hgt").write_bytes(tile.tobytes())
    grid = HeightGrid.open(tmp_path / "S34W071.hgt")
    expected = np.where(tile == -32768, np.nan, tile.astype(float))
    np.testing.assert_array_equal(grid.read(0, 1201, 0, 1201), expected)
    assert grid.vertical == Vertical("EGM96 height", geoid="egm96", provenance="stated")
    assert grid.sample(-71.0, -33.0) == tile[0, 0]
    assert grid.sample(-70.0, -34.0) == tile[-1, -1]
    geoid = rng.normal(0, 30, (19, 36)).astype(">f4")
    geoid[2, 1] = -88.8888
    grid = HeightGrid.open(write_geoid(tmp_path / "g.gtx", geoid))
    heights = grid.sample(*np.meshgrid(np.arange(-180, 180, 10.0), np.arange(-90, 91, 10.0)))
    np.testing.assert_array_equal(heights, np.where(geoid == np.float32(-88.8888), np.nan, geoid.astype(float)))
    assert grid.vertical.reference == "ellipsoid"


def test_a_dem_without_crs_is_refused(tmp_path):
    with pytest.raises(InputError, match="needs a CRS"):
        HeightGrid.open(write_dem(tmp_path / "a.tif", None))
    with pytest.raises(InputError, match="no such file"):
        HeightGrid.open(tmp_path / "b.tif")


def test_srtm_over_mont_ventoux_is_what_gdal_reads_plus_the_geoid(shared_data):
    folder = shared_data / "dem"
    dem = Dem.open(folder / "N44E005.hgt", folder / "egm96_15.gtx")
    assert dem.grid.vertical.reference == "EGM96 height"
    with rasterio.open(folder / "N44E005.hgt") as tile:
        heights = tile.read(1).astype(float)
    rng = np.random.default_rng(0)
    row, col = rng.integers(0, 1201, (2, 500))
    known = heights[row, col] != -32768
    found = dem.grid.sample(5 + col / 1200, 45 - row / 1200)
    np.testing.assert_allclose(found[known], heights[row, col][known], atol=1e-6)
    assert np.isnan(found[~known]).all()
    with rasterio.open(folder / "egm96_15.gtx") as grid:
        geoid = float(next(grid.sample([(5.25, 44.25)]))[0])
    assert dem(5.25, 44.25) - dem.grid.sample(5.25, 44.25) == pytest.approx(geoid, abs=1e-5)


def test_the_image_of_ventoux_lies_on_heights_of_512_to_567_metres(shared_data):
    """Where its stereo pair puts it; SRTM is 90 m wide and tens of metres off on slopes."""
    dem = Dem.open(shared_data / "dem" / "N44E005.hgt", shared_data / "dem" / "egm96_15.gtx")
    rpc = read_rpc(shared_data / "optical" / "phr_ventoux" / "left_image.tif")
    image = np.stack(np.meshgrid(np.arange(0, 500, 50.0), np.arange(330, 500, 20.0)), axis=-1).reshape(-1, 2)
    ground = localize_on_terrain(rpc, image, dem, altitude_range(rpc))
    assert np.isfinite(ground).all()
    assert 505 < ground[:, 2].min() < ground[:, 2].max() < 575
    np.testing.assert_allclose(ground[:, 2], dem(ground[:, 0], ground[:, 1]), atol=1e-3)
    np.testing.assert_allclose(rpc.project(ground), image, atol=1e-8)


def test_a_line_of_sight_stops_at_the_first_ridge():
    """A wall of 300 m between the camera and the point behind it hides the point."""
    rpc = make_rpc()
    image = np.array([[9000.0, 9000.0], [11000.0, 9000.0]])
    foot, top = rpc.localize(image[:1], [400.0])[0], rpc.localize(image[:1], [800.0])[0]
    wall = (foot + top) / 2
    width = np.abs(top - foot)[:2].max() / 20

    def terrain(lon, lat):
        near = (np.abs(lon - wall[0]) < width) & (np.abs(lat - wall[1]) < width)
        return np.where(near, 900.0, 400.0)

    ground = localize_on_terrain(rpc, image, terrain, (0.0, 1000.0))
    assert ground[0, 2] > 550
    assert ground[1, 2] == pytest.approx(400.0, abs=1e-3)


@pytest.mark.parametrize("level", [np.nan, -50.0])
def test_where_no_terrain_is_met_there_is_no_point(level):
    found = localize_on_terrain(
        make_rpc(), np.array([[9000.0, 9000.0]]), lambda lon, _: np.full_like(lon, level), (0.0, 9.0)
    )
    assert np.isnan(found).all()


@pytest.mark.parametrize(
    ("level", "said"), [(1000.0, False), (1000.1, True), (0.0, False), (-0.1, True), (500.0, False), (np.nan, False)]
)
def test_that_lines_meet_no_terrain_is_said_where_it_reaches_out_of_the_altitudes(level, said, tmp_path):
    """Up or down, but not over a void, and not of terrain that just reaches an end."""
    rpc = make_rpc()
    image = np.array([[9000.0, 9000.0], [9500.0, 9000.0], [11000.0, 9000.0]])
    (lon, lat, _), _, (void, _, _) = rpc.localize(image, np.full(3, 500.0))
    heights = np.full((21, 31), level, np.float64)
    heights[:, 16:] = np.nan
    corner = rasterio.Affine(abs(void - lon) / 6, 0, lon - abs(void - lon) * 2, 0, -0.01, lat + 0.1)
    assert void > lon
    dem = Dem.open(write_dem(tmp_path / "a.tif", 4979, heights, transform=corner, nodata=np.nan))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ground = localize_on_terrain(rpc, image, dem, (0.0, 1000.0))
    met = 0.0 <= level <= 1000.0
    assert np.isfinite(ground).all(axis=1).tolist() == [met, met, False]
    assert len(caught) == said
    if said:
        assert (
            f"heights here are {level:.0f} to {level:.0f} m, the camera is made for 0 to 1000 m: 3 of 3 lines"
            in str(caught[0].message)
        )


@pytest.mark.parametrize(
    ("row", "col"),
    [((2.0, 3.5), (1.2, 4.0)), ((-2.0, 0.0), (-1.0, 0.5)), ((5.2, 9.0), (7.0, 20.0)), ((3.0, 3.0), (4.0, np.nan)),
     ((-3.0, -0.1), (1.0, 2.0)), ((1.0, 2.0), (-3.0, -0.1)), ((6.1, 7.0), (1.0, 2.0)), ((1.0, 2.0), (8.1, 9.0)),
     ((6.0, 7.0), (8.0, 9.0)), ((np.nan, np.nan), (1.0, 2.0)), ((0.0, 0.4), (0.0, 0.6))],
)  # fmt: skip
def test_the_ends_of_the_heights_about_places_are_those_of_the_nodes_around_them(row, col, tmp_path, sized):
    """Of the nodes of the smallest window that holds all; beyond the grid, and among voids, nothing is known."""
    heights = np.random.default_rng(3).uniform(0, 900, (7, 9)).astype(np.float32)
    heights[:2, :2] = np.nan
    grid = HeightGrid.open(write_dem(tmp_path / "a.tif", "EPSG:4979", heights))
    known = np.isfinite(row) & np.isfinite(col)
    inside = [
        [n for n in range(count) if known.any() and np.floor(np.min(at)) <= n <= np.ceil(np.max(at))]
        for at, count in ((np.array(row)[known], 7), (np.array(col)[known], 9))
    ]
    part = heights[np.ix_(*inside)]
    beyond = any(np.max(at) < 0 or np.min(at) > end for at, end in ((row, 6), (col, 8)))
    expected = (-np.inf, np.inf) if beyond or not np.isfinite(part).any() else (np.nanmin(part), np.nanmax(part))
    assert grid.extremes(np.array([row, col])) == expected
    for most, told in ((part.size, expected), (part.size - 1, (-np.inf, np.inf))):
        sized(cells_read=most)
        assert grid.extremes(np.array([row, col])) == told


def test_datums_are_those_of_the_dems_that_count_where_the_points_lie(tmp_path):
    heights = np.full((9, 9), 100.0, np.float32)
    near, far = (
        write_dem(
            tmp_path / f"{name}.tif", "EPSG:4326", heights, transform=rasterio.Affine(0.1, 0, west, 0, -0.1, 45.0)
        )
        for name, west in (("near", 5.0), ("far", 25.0))
    )
    ground = np.array([[5.2, 44.6, 0], [5.3, 44.5, 0], [5.6, 44.7, 0], [25.5, 44.5, 0], [25.4, np.nan, 0], [9, 44, 0]])
    egm96 = HeightGrid.open(geoid_file("egm96"))
    with pytest.warns(BarpcWarning):
        both = Dem.open([near, far])
    found = both.datums(ground)
    assert [(one.source, one.name, one.provenance, one.converted) for one in found] == [
        ("heights", f"the DEM {name}.tif", DEFAULT, False) for name in ("near", "far")
    ]
    undulations = egm96.sample([5.3, 25.5], [44.6, 44.5])
    assert [one.otherwise for one in found] == pytest.approx(undulations)
    (one,) = both.datums(ground[3:])  # none of the other lies there
    assert one.name == "the DEM far.tif"
    assert Dem.open(near, None, "egm96").datums(ground) == ()  # a person said it
    (one,) = datum_of(Vertical("EGM96", geoid="egm96", provenance=STATED), ground[:3], "gcps", "them")
    assert (one.otherwise, one.converted) == (pytest.approx(-undulations[0]), True)


def test_points_that_spread_over_too_many_cells_are_refused_at_once(tmp_path, sized):
    dem = Dem.open(write_dem(tmp_path / "a.tif", 4979))
    lon, lat = 5 + STEP * np.array([0.0, 2.5]), 44 - STEP * np.array([0.0, 3.5])  # nodes 0 .. 3 by 0 .. 4
    sized(cells_read=20)
    assert np.isfinite(dem(lon, lat)).all()
    sized(cells_read=19)
    with pytest.raises(InputError, match="spread over 20 cells"):
        dem(lon, lat)


@pytest.mark.parametrize("turn", [0.0, 360.0, -360.0])
@pytest.mark.parametrize("end", [5.2, 4.9])
def test_a_line_passes_the_posts_between_its_ends_however_longitudes_are_counted(tmp_path, end, turn):
    """From 5.05 E, on the DEM, to the east and to beyond its western edge: not once around the Earth."""
    dem = Dem.open(write_dem(tmp_path / "a.tif", 4979))
    start, stop = np.array([[5.05, 43.9, 0.0]]), np.array([[end + turn, 43.93, 0.0]])
    for one, other in ((start, stop), (stop, start)):
        posts, lowest, highest = dem.between(one, other)
        assert posts == pytest.approx(abs(end - 5.05) / STEP, abs=1e-6)
        assert lowest <= 100 + 10 * min(5, 100 * (end - 5)) + 7 or end < 5.0
        assert highest >= 100 + 10 * 5 + 7


@pytest.mark.parametrize(
    ("vertical", "metres", "unit"),
    [(5714, 1.0, ""), (5715, -1.0, ""), (6357, -1.0, ""), (6358, -1200 / 3937, "US survey foot"),
     (8051, -0.3048, "foot"), (8228, 0.3048, "foot")],
)  # fmt: skip
def test_the_unit_of_a_system_of_heights_counts_where_no_band_says_one(vertical, metres, unit):
    """Of what has no unit of a band, as a GeoTIFF of GDAL's always has; depths go down."""
    wkt = pyproj.CRS(f"EPSG:4326+{vertical}").to_wkt()
    found = vertical_of(wkt)
    assert (found.metres, found.unit) == (pytest.approx(metres, rel=1e-12), unit)
    assert vertical_of(wkt, "cm").metres == np.copysign(0.01, metres)
