"""Geoids by name: heights that the agencies publish, and a line that says where a grid is to be had."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from barpc.base.errors import BarpcWarning, InputError
from barpc.base.options import RunOptions
from barpc.pipeline.inputs import with_located
from barpc.rasters import vertical as geoids
from barpc.rasters.dem import Dem, HeightGrid
from barpc.rasters.vertical import geoid_file
from tests.rasters.test_dem import write_dem


@pytest.fixture
def nowhere(monkeypatch, tmp_path):
    """No folder of PROJ but those of its variables."""
    for name in ("PROJ_DATA", "PROJ_LIB"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "none"))
    monkeypatch.setattr(geoids, "find_spec", lambda _: None)
    monkeypatch.setattr(geoids.sys, "prefix", str(tmp_path / "none"))
    return monkeypatch


@pytest.fixture
def packages(nowhere):
    """Python packages by name, none but those that a test puts in."""
    found = {}
    nowhere.setattr(geoids, "find_spec", found.get)
    return found


@pytest.mark.parametrize(
    ("lat", "lon", "undulation"),  # of NGA's own test of its program F477: within what 15' and bilinear leave
    [(38.628155, 269.779155, -31.628), (-14.621217, 305.021114, -2.969), (46.874319, 102.448729, -43.575),
     (-23.617446, 133.874712, 15.871), (38.625473, 359.9995, 50.066), (-0.466744, 0.0023, 17.329)],
)  # fmt: skip
@pytest.mark.parametrize("name", ["egm96", "EGM96"])
def test_egm96_is_there_and_is_what_its_makers_say(name, lat, lon, undulation):
    grid = HeightGrid.open(geoid_file(name))
    assert grid.period == 1440
    assert grid.sample(lon, lat) == pytest.approx(undulation, abs=0.15)


def test_egm96_is_named_by_its_makers_and_is_small():
    path = Path(geoid_file("egm96"))
    assert path.stat().st_size < 2_000_000
    assert b"Public domain: US National Geospatial-Intelligence Agency" in path.read_bytes()


@pytest.mark.parametrize("file", ["us_nga_egm08_25.tif", "egm08_25.gtx"])
@pytest.mark.parametrize("variable", ["PROJ_DATA", "PROJ_LIB"])
def test_egm2008_is_found_where_proj_keeps_it(nowhere, packages, tmp_path, variable, file):
    (tmp_path / "grids").mkdir()
    path = Path(shutil.copy(geoid_file("egm96"), tmp_path / "grids" / file))
    nowhere.setenv(variable, f"/no/such/folder:{tmp_path / 'grids'}")
    assert geoid_file("egm2008") == str(path)
    nowhere.delenv(variable)
    package = {"PROJ_DATA": ("rasterio", "proj_data"), "PROJ_LIB": ("pyproj", "proj_dir/share/proj")}[variable]
    packages[package[0]] = SimpleNamespace(origin=str(path))
    own = tmp_path / "grids" / package[1]
    own.mkdir(parents=True)
    assert str(shutil.move(path, own)) == geoid_file("egm2008")


def test_a_geoid_that_is_not_there_is_a_line_that_says_where_to_get_it(nowhere, tmp_path):
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        folder.mkdir()
    nowhere.setenv("PROJ_DATA", ":".join(map(str, folders)))
    with pytest.raises(InputError, match=r"geoid egm2008: no us_nga_egm08_25\.tif or egm08_25\.gtx in PROJ's") as told:
        geoid_file("egm2008")
    text = str(told.value)
    assert "\n" not in text
    for word in (", ".join(map(str, folders)), "projsync --file", "https://cdn.proj.org/us_nga_egm08_25.tif", "egm96"):
        assert word in text


def test_heights_above_a_geoid_that_is_not_there_are_met_by_another_unless_a_person_asks_for_it(nowhere, tmp_path):
    path = write_dem(tmp_path / "b.tif", "EPSG:4326+3855")
    with pytest.warns(BarpcWarning, match="EGM2008 height, made ellipsoidal with egm96"):
        Dem.open(path)
    with pytest.raises(InputError, match="geoid egm2008: no "):
        Dem.open(path, "egm2008")


def test_a_file_of_that_name_and_any_other_path_are_taken_as_given(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "egm2008").write_bytes(b"")
    assert geoid_file("egm2008") == "egm2008"
    assert geoid_file("grids/mine.gtx") == "grids/mine.gtx"
    assert geoid_file(Path("grids/mine.gtx")) == "grids/mine.gtx"


def test_heights_above_a_geoid_by_name_are_ellipsoidal(tmp_path):
    heights = np.full((1201, 1201), 100, ">i2")
    (tmp_path / "N43E005.hgt").write_bytes(heights.tobytes())
    dem = Dem.open(tmp_path / "N43E005.hgt", "egm96")
    assert dem(5.4, 43.3) == pytest.approx(100 + 49.3, abs=0.6)  # about Marseille the geoid lies 49 m up
    assert "made ellipsoidal with egm96_15.tif" in dem.description
    found = with_located(RunOptions(dem=str(tmp_path / "N43E005.hgt"), geoid="egm96"))
    assert str(found.geoid).endswith("egm96_15.tif")
