"""Files of control points of the field: read as what they are, or refused by the name of their program."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.pointio.gcps import ControlReference, read_gcps
from tests.pointio.conftest import refused

SAMPLES = Path(__file__).resolve().parents[2] / "data_samples"
UTM = ControlReference("EPSG:32631", heights="ellipsoidal")
CASES = {
    "view_00_utm.points": (None, 0), "qgis.points": (None, 0), "gcp_e_n_xy.csv": (UTM, 6e-3), "gcp_utm.csv": (UTM, 0),
    "odm_gcp_list.txt": (None, 0), "envi.pts": (None, 0), "gcp_2d.csv": (None, 0),
}  # fmt: skip
"""File, what is said of it, and how its altitudes are rounded."""
FLAT = "view_00_utm.points", "qgis.points", "envi.pts", "gcp_2d.csv"


@pytest.mark.parametrize("name", CASES)
def test_files_of_other_tools_hold_the_points_of_the_samples(shared_data, name) -> None:
    pytest.importorskip("pyproj")
    frame, rounded = CASES[name]
    views = ["view_00", "view_01", "view_02"] if frame else ["view_00"]
    known = read_gcps(SAMPLES / "gcps.geojson", views)
    found = read_gcps(shared_data / "field_cases" / name, views, frame)
    np.testing.assert_array_equal(found.view, known.view)
    np.testing.assert_allclose(found.xy, known.xy, rtol=0, atol=rounded or 6e-4)  # ENVI's three decimals
    np.testing.assert_allclose(found.lonlatalt[:, :2], known.lonlatalt[:, :2], rtol=0, atol=2e-8)
    np.testing.assert_allclose(found.lonlatalt[:, 2], known.lonlatalt[:, 2] * (name not in FLAT), atol=rounded)


QGIS = "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual\n5.4,43.3,100.5,-200.5,1,0,0,0\n"


@pytest.mark.parametrize("cells", [1, 3, 8, 9, 60])
def test_a_comment_before_the_names_is_no_header_however_many_cells_it_has(tmp_path, cells):
    """QGIS writes the reference system in one line, whose commas are many where it is projected."""
    text = "#CRS: " + ",".join(f'WORD["a {n}"' for n in range(cells)) + "\n"
    (tmp_path / "a.points").write_text(text + QGIS)
    found = read_gcps(tmp_path / "a.points", ["a"], ControlReference(crs="EPSG:4326"))
    np.testing.assert_allclose(found.xy, [[100.0, 200.0]])
    np.testing.assert_allclose(found.lonlatalt[0, :2], [5.4, 43.3])


@pytest.mark.parametrize("head", ["#id,lon,lat,alt,image,col,row\n", "# made by hand\n#id,lon,lat,alt,image,col,row\n"])
def test_a_comment_of_names_before_numbers_is_the_header(tmp_path, head):
    (tmp_path / "a.csv").write_text(head + "p,5.4,43.3,7.5,a.tif,10,20\n")
    found = read_gcps(tmp_path / "a.csv", ["a"])
    np.testing.assert_allclose(found.lonlatalt, [[5.4, 43.3, 7.5]])
    np.testing.assert_allclose(found.xy, [[10.0, 20.0]])


@pytest.mark.parametrize("names", ["id,E,N,h,image,x,y", "id,x,y,h,image,col,row", "id,Easting,Northing,h,image,x,y"])
def test_x_and_y_are_the_pair_that_no_other_column_is_named_for(tmp_path, names):
    pytest.importorskip("pyproj")
    (tmp_path / "a.csv").write_text(f"{names}\np,694517.117,4796759.561,244.43,a.tif,263.60,888.93\n")
    found = read_gcps(tmp_path / "a.csv", ["a"], ControlReference(crs="EPSG:32631", heights="ellipsoidal"))
    np.testing.assert_allclose(found.xy, [[263.60, 888.93]])
    np.testing.assert_allclose(found.lonlatalt, [[5.39806846, 43.2985312, 244.43]], atol=1e-7)


@pytest.mark.parametrize(
    ("text", "program"),
    [
        ("264.1035\t-889.4270\t694517.1166\t4796759.5605\n", "ArcGIS links"),
        ('12.0,34.0,500000.0,4000000.0,"GCP 1",0.0\n', "Global Mapper's points"),
        ("view_00.tif,gcp1,12.5,33.1\n", "Pix4D's image points"),
        ("gcp1,500000.0,4000000.0,12.0\n", "Pix4D's ground points"),
        ("<?xml version='1.0'?><kml xmlns='http://www.opengis.net/kml/2.2'></kml>", "KML"),
    ],
)
def test_files_without_names_are_refused_by_their_program_and_the_cure(tmp_path, text, program):
    (tmp_path / "a.txt").write_text(text)
    assert "give" in refused(lambda path: read_gcps(path, ["view_00"]), tmp_path / "a.txt", program)


def test_low_heights_of_two_bytes_are_no_text(tmp_path):
    """They look like letters of UTF-16."""
    (tmp_path / "n44e005.hgt").write_bytes(np.full(1201**2, 0xAE, ">i2").tobytes())
    with pytest.raises(InputError, match="neither a text nor a file of points"):
        read_gcps(tmp_path / "n44e005.hgt", ["a"])
