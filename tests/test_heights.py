"""One gate for heights: the same place in any unit, datum, scale and kind of file has one altitude."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio import Affine

from barpc.pointio.correspondences import read_altimetry
from barpc.pointio.gcps import ControlReference, read_gcps
from barpc.rasters.dem import Dem, HeightGrid
from barpc.rasters.vertical import geoid_file

LON, LAT, ALT = 5.4, 43.3, 251.37  # m above the ellipsoid
N = float(HeightGrid.open(geoid_file("egm96")).sample(LON, LAT))
FEET, US_FEET = 0.3048, 1200 / 3937
DATUMS = {"ellipsoid": 0.0, "egm96": N, "depth": N}
"""What heights count from -> how far that lies above the ellipsoid."""
CENTIMETRE = 0.01


def number(metres: float, datum: str) -> float:
    """The altitude as a file of that unit and datum has it."""
    up = (ALT - DATUMS[datum]) / metres
    return -up if datum == "depth" else up


def dem(folder: Path, value: float, crs: str, *, unit: str = "", scale: float = 1.0, offset: float = 0.0) -> Path:
    """A plane of posts that all hold a number, in single precision."""
    path = folder / "dem.tif"
    size = {"driver": "GTiff", "width": 9, "height": 9, "count": 1, "dtype": "float64"}
    with rasterio.open(path, "w", crs=crs, transform=Affine(0.01, 0, 5.355, 0, -0.01, 43.345), **size) as file:
        file.scales, file.offsets = (scale,), (offset,)
        if unit:
            file.units = (unit,)
        file.write(np.full((1, 9, 9), (value - offset) / scale))
    return path


BANDS = {"m": 1.0, "metre": 1.0, "ft": FEET, "US survey foot": US_FEET, "cm": 0.01}
SYSTEMS = {"EPSG:4979": "ellipsoid", "EPSG:4326+5773": "egm96", "EPSG:4326+5715": "depth"}


@pytest.mark.filterwarnings("ignore:DEM dem.tif")  # a depth's geoid is EGM96's, or near it
@pytest.mark.parametrize(("unit", "system", "scale"), [*product(BANDS, SYSTEMS, [(1.0, 0.0), (0.1, 1000.0)])])
def test_a_dem_of_any_unit_scale_and_datum(tmp_path, unit, system, scale) -> None:
    value = number(BANDS[unit], SYSTEMS[system])
    path = dem(tmp_path, value, system, unit=unit, scale=scale[0], offset=scale[1])
    assert Dem.open(path)(LON, LAT) == pytest.approx(ALT, abs=CENTIMETRE)


@pytest.mark.parametrize("unit", BANDS)
@pytest.mark.parametrize(("said", "datum"), [("egm96", "egm96"), ("ellipsoidal", "ellipsoid")])
def test_a_dem_of_which_a_person_says_it(tmp_path, unit, said, datum) -> None:
    path = dem(tmp_path, number(BANDS[unit], datum), "EPSG:4326", unit=unit)
    assert Dem.open(path, None, said)(LON, LAT) == pytest.approx(ALT, abs=CENTIMETRE)
    assert Dem.open(path, said)(LON, LAT) == pytest.approx(ALT, abs=CENTIMETRE)


COLUMNS = {
    "alt": (1.0, "ellipsoid", None), "h_ellipsoidal": (1.0, "ellipsoid", None), "HAE (ft)": (FEET, "ellipsoid", None),
    "elevation_msl": (1.0, "egm96", None), "EGM96 [m]": (1.0, "egm96", None),
    "ortho height ftUS": (US_FEET, "egm96", None),
    "elev": (1.0, "egm96", "egm96"), "height_ft": (FEET, "egm96", "egm96"), "z": (1.0, "ellipsoid", "ellipsoidal"),
    "alt ": (1.0, "egm96", "egm96"), "orthometric_height": (1.0, "egm96", "ellipsoidal"),
}  # fmt: skip


@pytest.mark.parametrize("column", COLUMNS)
def test_points_whose_column_or_a_person_says_it(tmp_path, column) -> None:
    metres, datum, said = COLUMNS[column]
    value = number(metres, datum)
    table = tmp_path / "p.csv"
    table.write_text(f"id,lon,lat,{column.strip()},col,row\nA,{LON},{LAT},{value!r},1,2\n")
    features = [{"type": "Feature", "geometry": {"type": "Point", "coordinates": [LON, LAT]},
                 "properties": {"id": "A", column.strip(): value, "col": 1, "row": 2}}]  # fmt: skip
    (tmp_path / "p.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    for path in (table, tmp_path / "p.geojson"):
        found = read_gcps(path, ["a"], ControlReference(heights=said))
        assert found.lonlatalt[0] == pytest.approx([LON, LAT, ALT], abs=CENTIMETRE), path.name
        assert bool(found.datums) == (said is None or "ortho" in column)  # a person's word is not held against anything


@pytest.mark.parametrize("column", ["alt", "h_li", "elev", "height_ft", "elevation_msl", "h_te_best_fit"])
@pytest.mark.parametrize("said", [None, "ellipsoidal", "egm96"])
def test_altimetry_whose_column_or_a_person_says_it(tmp_path, column, said) -> None:
    stated = "msl" in column
    datum = "egm96" if stated or said == "egm96" else "ellipsoid"
    path = tmp_path / "p.csv"
    path.write_text(f"lon,lat,{column}\n{LON},{LAT},{number(FEET if 'ft' in column else 1.0, datum)!r}\n")
    found = read_altimetry(path, said)
    assert found.lonlatalt[0, 2] == pytest.approx(ALT, abs=CENTIMETRE)
    assert bool(found.datums) == (said is None or stated)


@pytest.mark.parametrize("system", ["EPSG:32631", "EPSG:4326", "EPSG:2154"])
@pytest.mark.parametrize(("vertical", "datum"), [("5773", "egm96"), ("5715", "depth")])
def test_points_in_a_compound_system(tmp_path, system, vertical, datum) -> None:
    (x,), (y,) = rasterio.warp.transform("EPSG:4326", system, [LON], [LAT])
    path = tmp_path / "p.csv"
    path.write_text(f"id,x,y,z,col,row\nA,{x!r},{y!r},{number(1.0, datum)!r},1,2\n")
    found = read_gcps(path, ["a"], ControlReference(f"{system}+{vertical}"))
    assert found.lonlatalt[0] == pytest.approx([LON, LAT, ALT], abs=CENTIMETRE)
