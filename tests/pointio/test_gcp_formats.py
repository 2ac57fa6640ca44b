"""Control as other tools write it: one point, in every syntax, is the same point; what is not said is not guessed."""

from __future__ import annotations

import json
import os
import sqlite3
import struct
import subprocess
import sys
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
import shapely
from rasterio.warp import transform

from barpc.base.errors import InputError, plain
from barpc.base.geodesy import HeightDatum, ecef_from_ground
from barpc.pointio.columns import COLUMNS, guessed
from barpc.pointio.gcp_formats import GCP_FORMATS
from barpc.pointio.gcp_tables import GCP_NAMES as NAMES_OF
from barpc.pointio.gcps import ControlReference, read_gcps
from barpc.pointio.tables import degrees
from barpc.report.geopackage import MapLayer, geopackage, point_shapes
from barpc.scene import GroundPoints
from tests.geotiffs import write_image
from tests.pointio.conftest import refused

NAMES = ["left", "right"]
LON, LAT, ALT, COL, ROW = 5.4, 43.3, 240.0, 263.25, 889.75
"""A point, and where the centre of the pixels it lies between puts it, the first one being (0, 0)."""
(EAST,), (NORTH,) = transform("EPSG:4326", "EPSG:32631", [LON], [LAT])
MAP = f"{EAST:.6f}", f"{NORTH:.6f}"
WKT = (
    'GEOGCRS["WGS 84",DATUM["World Geodetic System 1984",ELLIPSOID["WGS 84",6378137,298.257223563]],CS[ellipsoidal,2],\
AXIS["latitude",north],AXIS["longitude",east],ANGLEUNIT["degree",0.0174532925199433],ID["EPSG",4326]]'
)


def old_geojson(place, **properties):
    feature = {"geometry": {"type": "Point", "coordinates": place}, "properties": {"filename": "left", **properties}}
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32631"}}
    return json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]})


def near(found, place):
    """To 10 micrometres on the ground, and 1 in height, which are written so."""
    assert (np.abs(found.lonlatalt - place) <= (1e-10, 1e-10, 1e-6)).all(), found.lonlatalt


def micmac(ground=True, image=True, name="left.tif", place=f"{LON} {LAT} {ALT}"):
    """Ground points, and the image points of one image."""
    first = f"<OneAppuisDAF><Pt>{place}</Pt><NamePt>p</NamePt><Incertitude>2 3 4</Incertitude></OneAppuisDAF>"
    second = (
        f"<SetOfMesureAppuisFlottants><MesureAppuiFlottant1Im><NameIm>{name}</NameIm><OneMesureAF1I><NamePt>p</NamePt>"
        f"<PtIm>{COL} {ROW}</PtIm></OneMesureAF1I></MesureAppuiFlottant1Im></SetOfMesureAppuisFlottants>"
    )
    return f'<?xml version="1.0"?><Global>{first * ground}{second * image}</Global>'


SAME = {
    "qgis new": ("left.points", f"#CRS: {WKT}\nmapX,mapY,sourceX,sourceY,enable,dX,dY,residual\n"
                 f"{LON},{LAT},{COL + 0.5},{-ROW - 0.5},1,0,0,0\n5,43,1,-1,0,0,0,0\n"),
    "qgis old": ("LEFT.TIF.points", f"mapX,mapY,pixelX,pixelY,enable\n{LON},{LAT},{COL + 0.5},{-ROW - 0.5},1\n"),
    "odm proj": ("g.txt", f"+proj=utm +zone=31 +datum=WGS84 +units=m +no_defs\n{MAP[0]}\t{MAP[1]}\tNaN\t{COL + 0.5}\t"
                 f"{ROW + 0.5}\tleft.JPG\n"),
    "envi degrees": ("left.pts", "; ENVI Image to Map GCP File\n; projection info = {Geographic Lat/Lon, WGS-84, "
                     f"units=Degrees}}\n; Map (x,y), Image (x,y)\n;\n{LON} {LAT} {COL + 1.5} {ROW + 1.5}\n"),
    "envi image first": ("left.pts", "; ENVI\n; Image (x,y), Map (x,y)\n" f"{COL + 1.5} {ROW + 1.5} {LON} {LAT}\n"),
    "metashape": ("m.csv", "# CoordinateSystem: EPSG:4979\n#Label,Camera,X/Longitude,Y/Latitude,Z/Altitude,px,py,"
                  f"Accuracy_(m),Error_(m)\np,left,{LON},{LAT},{ALT},{COL + 0.5},{ROW + 0.5},,0.3\n# Total Error\n"),
    "micmac": ("g.xml", micmac()),
    "old geojson": ("g.geojson", old_geojson([EAST, NORTH], col=COL, row=ROW)),
    "geojson in words": ("g.geojson", old_geojson([1.0, 2.0], lon="005d24'00\"E", lat="43 18 00 N", col=str(COL),
                         row=f" {ROW} ").replace("EPSG::32631", "OGC:1.3:CRS84")),
    "asp": ("g.gcp", f"p {LAT} {LON} {ALT} 1 1 1 left.tif {COL} {ROW} 0.5 0.5\n"),
    "csv dms": ("g.csv", "Lat;Lon;Alt [ft];photo;pixel x;pixel y\n43°18'00.0\"N;005° 24' 00\"E;"
                f"{ALT / 0.3048:.9f};C:\\flight\\LEFT.JPG;263,25;889,75\n"),
}  # fmt: skip
"""The same point in the syntax of each tool, its pixels counted as that tool does; `test_control_table` reads them."""
NO_ALTITUDE = "qgis new", "qgis old", "odm proj", "envi degrees", "envi image first", "old geojson", "geojson in words"


def test_every_format_has_a_sample() -> None:
    raster = {"image with GCP tags", "GeoPackage or Shapefile"}
    known = {
        next(name for name, form in GCP_FORMATS.items() if form.sniff(text.lstrip(), text.encode()))
        for _, text in SAME.values()
    }
    assert known | raster == set(GCP_FORMATS)


# --- reference systems ------------------------------------------------------------------------------------


def one(folder: Path, x: float, y: float, z: float, frame: ControlReference, alt: str = "h"):
    path = folder / "g.csv"
    path.write_text(f"id,easting,northing,{alt},col,row\np,{x!r},{y!r},{z!r},1,2\n", encoding="utf-8")
    return read_gcps(path, ["left"], frame)


US_FOOT = 1200 / 3937


@pytest.fixture
def geoid(tmp_path) -> str:
    """A geoid that lies 30 m below the ellipsoid everywhere."""
    path = tmp_path / "geoid.tif"
    place = rasterio.Affine(90, 0, -180, 0, -60, 90)
    return str(write_image(path, np.full((3, 4), -30.0, np.float32), crs="EPSG:4326", transform=place))


def known(found: GroundPoints) -> str | None:
    """What the altitudes count from as their file says it, or a person: then nothing else may be."""
    (*_, one) = found.datums or (HeightDatum("gcps", "", 0.0, "person"),)
    return {"stated": "ellipsoid", "inferred": "alt", "default": None}.get(one.provenance, "a geoid")


@pytest.mark.parametrize(
    ("crs", "horizontal", "z", "alt", "vertical"),
    [
        ("EPSG:26910", 26910, 100.0, 100.0, None),
        ("EPSG:26910+5703", 26910, 100.0, 70.0, "NAVD88 height"),
        ("EPSG:26910+6360", 26910, 100.0, 100 * US_FOOT - 30, "NAVD88 height (ftUS)"),
        ("EPSG:2226+8228", 2226, 100.0, 100 * 0.3048 - 30, "NAVD88 height (ft)"),
        ("EPSG:2226+5703", 2226, 100.0, 70.0, "NAVD88 height"),
        ("EPSG:32610+5715", 32610, 100.0, -130.0, "MSL depth"),
        ("EPSG:4979", 4326, 100.0, 100.0, "ellipsoid"),
    ],
)
def test_heights_are_in_the_unit_and_above_what_the_system_says(
    tmp_path, geoid, crs, horizontal, z, alt, vertical
) -> None:
    (x,), (y,) = transform("EPSG:4326", f"EPSG:{horizontal}", [-121.5], [38.5])
    found = one(tmp_path, x, y, z, ControlReference(crs, geoid))
    near(found, (-121.5, 38.5, alt))
    assert known(found) == (vertical if vertical in (None, "ellipsoid") else "a geoid")
    if vertical not in (None, "ellipsoid"):  # its own geoid, or the nearest that there is, and that is said
        assert one(tmp_path, x, y, z, ControlReference(crs, "none")).lonlatalt[0, 2] == pytest.approx(
            alt + 30.0, abs=1e-6
        )
        own = one(tmp_path, x, y, z, ControlReference(crs))
        assert -35.0 < own.lonlatalt[0, 2] - alt - 30.0 < -25.0  # EGM96 near Sacramento
        assert f"altitudes above {vertical} made ellipsoidal with egm96_15.tif" in own.said[0]


def test_no_grid_is_asked_of_the_network(tmp_path, geoid, monkeypatch) -> None:
    """PROJ that may go there, as a user sets it, gives the same place where nobody answers; and is left as it was."""
    monkeypatch.setenv("PROJ_NETWORK_ENDPOINT", "https://127.0.0.1:9")
    (x,), (y,) = transform("EPSG:4326", "EPSG:26910", [-121.5], [38.5])
    places = []
    for enabled in (False, True):
        pyproj.network.set_network_enabled(enabled)
        places.append(one(tmp_path, x, y, 100.0, ControlReference("EPSG:26910+5703", geoid)).lonlatalt)
        assert pyproj.network.is_network_enabled() == enabled
    pyproj.network.set_network_enabled(None)
    np.testing.assert_array_equal(*places)


def test_earth_centred_coordinates_have_their_altitude(tmp_path) -> None:
    ground = np.array([-121.5, 38.5, 123.0])
    found = one(tmp_path, *ecef_from_ground(ground).tolist(), ControlReference("EPSG:4978"))
    near(found, ground)
    assert known(found) == "ellipsoid"


@pytest.mark.parametrize(
    ("column", "factor", "vertical"),
    [
        ("height [m]", 1.0, None),
        ("Elev (ft)", 0.3048, None), ("z_ftUS", US_FOOT, None), ("alt_feet", 0.3048, None),
        ("height_us_survey_ft", US_FOOT, None), ("ellipsoidal height", 1.0, "ellipsoid"),
        ("h_ell_cm", 0.01, "ellipsoid"), ("z_level", 1.0, None), ("h_bell", 1.0, None),
        ("h_msl", 1.0, "the sea"), ("orthometric_height_ft", 0.3048, "the sea"),
        ("NAVD88 elev ft", 0.3048, "NAVD88 height"),
    ],
)  # fmt: skip
def test_a_column_says_its_unit_and_what_it_counts_from(tmp_path, geoid, column, factor, vertical) -> None:
    path = tmp_path / "g.csv"
    path.write_text(f"lon,lat,{column},col,row\n5,43,100,1,2\n", encoding="utf-8")
    found = read_gcps(path, ["left"], ControlReference(None, geoid))
    lift = -30.0 if vertical not in (None, "ellipsoid") else 0.0
    np.testing.assert_allclose(found.lonlatalt[0, 2], 100 * factor + lift, rtol=1e-12)
    assert known(found) == ("alt" if "alt" in column else vertical if vertical in (None, "ellipsoid") else "a geoid")


def test_the_flag_counts_before_the_file_and_that_is_said(tmp_path) -> None:
    (x,), (y,) = transform("EPSG:4326", "EPSG:32632", [LON], [LAT])
    path = tmp_path / "g.txt"
    path.write_text(f"EPSG:32631\n{x} {y} 100 1 2 left\n", encoding="utf-8")
    found = read_gcps(path, NAMES, ControlReference("EPSG:32632"))
    np.testing.assert_allclose(found.lonlatalt[0, :2], [LON, LAT], atol=1e-9)
    assert "instead of the file's reference system 'EPSG:32631'; WGS 84 / UTM zone 32N" in found.said[0]


@pytest.mark.parametrize(
    "crs", ["EPSG:99999", "nonsense", "EPSG:5703", "", 'LOCAL_CS["Local",UNIT["metre",1]]', "\ud800"]
)
def test_what_is_no_reference_system_of_places_is_refused(tmp_path, crs) -> None:
    with pytest.raises(InputError, match=r"(no|as a) reference system|map coordinates\?"):
        one(tmp_path, EAST, NORTH, 1.0, ControlReference(crs))


def test_without_a_reference_system_none_is_guessed_and_pyproj_not_imported(tmp_path) -> None:
    with pytest.raises(
        InputError, match=r"g\.csv: CSV, GCP p at 694\d+\.\d+, 4796\d+\.\d+: map coordinates\? Say .* --gcp-crs"
    ):
        one(tmp_path, EAST, NORTH, 1.0, ControlReference())
    (tmp_path / "a.gcp").write_text(SAME["asp"][1])
    code = f"import sys; from barpc.pointio.gcps import read_gcps as r; r({str(tmp_path / 'a.gcp')!r}, ['left']); " \
        "sys.exit('pyproj' in sys.modules)"  # fmt: skip
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- degrees ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "axis", "value"),
    [
        ("43°17'54.72\"N", "lat", 43.2985333333),
        ("43 17 54.72", "lat", 43.2985333333),
        ("S43:17:54.72", "lat", -43.2985333333),
        ("5d24m00sW", "lon", -5.4), ("-5° 24'", "lon", -5.4), ("-0°30'", "lon", -0.5),
        ("122°24′30.6″W", "lon", -122.4085),
        ("5,4 E", "lon", 5.4), ("43.2985°", "lat", 43.2985), ("43 17.912 N", "lat", 43.2985333333),
        ("33d52m10.5S", "lat", -33.86958333333),
        ("−33°52'10.5\"", "lat", -33.86958333333), ("5.4e0", "lon", 5.4),
        ("43deg 17min 54.72sec N", "lat", 43.2985333333),
        ("151° 12' 30'' E", "lon", 151.208333333333),
    ],
)  # fmt: skip
def test_degrees_minutes_and_seconds(text, axis, value) -> None:
    assert degrees(text, axis) == pytest.approx(value, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "axis"),
    [
        ("43°60'00\"N", "lat"), ("43°17'60\"N", "lat"), ("43°17'N", "lon"), ("5°24'W", "lat"), ("-5°24'W", "lon"),
        ("5°24'O", "lon"), ("43.5°17'N", "lat"), ("N 43 17 N", "lat"), ("1234°5'", "lon"), ("", "lon"), ("high", "lat"),
    ],
)  # fmt: skip
def test_what_is_no_angle_is_refused(text, axis) -> None:
    with pytest.raises(ValueError, match="is no "):
        degrees(text, axis)


# --- columns ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("header", "means"),
    [
        ("Point Name,Easting (m),Northing (m),Elevation (m),Image,Pixel X,Pixel Y", "id east north alt image col row"),
        ("X,Y,Z,x,y,photo", "east north alt col row image"),
        ("gps_lon,gps_lat,gps_alt,u,v", "lon lat alt col row"),
        ("pt,utm_e,utm_n,z,img_x,img_y", "id east north alt col row"),
        ("fid,LONGITUDE_WGS84,LATITUDE_WGS84,ELEV_M,SAMPLE,LINE", "id lon lat alt col row"),
        ("label,x,y,z,col,row", "id lon lat alt col row"),
        ("label,x,y", "id col row"),
        ("north,east,up_sigma,z,row,col", "north east - alt row col"),
        ("lat,lon,z_error,img_height,h,row_px,col_px", "lat lon - - alt row col"),
        ("h_ortho,h_ellipsoid,lon,lat,px,py", "- alt lon lat col row"),
        ("imageX,imageY,mapX,mapY", "col row east north"),
        ("Row,Col,Image,Name,Height,Latitude,Longitude", "row col image id alt lat lon"),
        ("label,file,x,y,h,col,row", "id image lon lat alt col row"),
        ("point,view,lon,lat,z,x,y", "id image lon lat alt col row"),
        ("id,image,lon,lat,alt,px,py", "id image lon lat alt col row"),
        ("gcp_name,E [m],N [m],H (m),file,x [px],y (Pixels)", "id east north alt image col row"),
        ("x_img,y_img,lon,lat,ele", "col row lon lat alt"),
    ],
)
def test_columns_are_taken_for_what_they_are_called(header, means) -> None:
    words = header.split(",")
    found, said, _ = guessed(words, NAMES_OF)
    assert found == {what: i for i, what in enumerate(means.split()) if what != "-"}
    listed = {alias for aliases in {**COLUMNS, **NAMES_OF}.values() for alias in aliases}
    for key, i in found.items():  # what is no listed name, but for case, blanks and unit, is said
        plainly = words[i].lower().partition(" (")[0].replace(" ", "_").replace("elev_m", "elev")
        if plainly not in listed | {"x", "y", "imagex", "imagey"}:
            assert f"column {words[i]!r} is {key}" in said


def test_two_columns_that_could_be_the_altitude_are_none() -> None:
    with pytest.raises(InputError, match="'z_top' and 'z_base' could be the altitude"):
        guessed(["lon", "lat", "z_top", "z_base", "col", "row"], {})


# --- images -----------------------------------------------------------------------------------------------


def test_images_are_found_by_stem_case_ending_and_path_and_it_is_said(tmp_path) -> None:
    path = tmp_path / "g.csv"
    images = ("D:\\data\\LEFT.JP2", "/a/b/left.tif", "Right", "right.xyz", "left2.tif")
    path.write_text("id,lon,lat,h,image,col,row\n" + "".join(f"{k},5,43,1,{n},1,2\n" for k, n in enumerate(images)))
    found = read_gcps(path, NAMES)
    assert found.view.tolist() == [0, 0, 1, 1]
    assert found.strangers == ("left2.tif",)
    assert "LEFT.JP2 is left, Right is right" in found.said[0]


@pytest.mark.parametrize(("name", "view"), [("right_gcps.csv", 1), ("left.tif.csv", 0), ("leftover.csv", None)])
def test_a_file_without_images_is_of_the_one_it_is_called_as(tmp_path, name, view) -> None:
    (tmp_path / name).write_text("lon,lat,h,col,row\n5,43,1,1,2\n")
    if view is None:
        with pytest.raises(InputError, match="no column image, and its name begins with none of left, right"):
            read_gcps(tmp_path / name, NAMES)
    else:
        assert read_gcps(tmp_path / name, NAMES).view.tolist() == [view]


# --- altitudes --------------------------------------------------------------------------------------------


def test_altitudes_that_are_not_there_are_zero_whatever_the_others_count_from(tmp_path, geoid) -> None:
    path = tmp_path / "g.csv"
    path.write_text("lon,lat,h,sigma,col,row\n5,43,100,0.1,1,2\n5.1,43,,0.1,1,2\n5.2,43,0,0.1,1,2\n")
    found = read_gcps(path, ["left"], ControlReference("EPSG:4326+5773", geoid))
    assert found.lonlatalt[:, 2].tolist() == [70.0, 0.0, 0.0]
    assert found.sigma.tolist() == [[0.1] * 3] * 3


def test_two_units_of_altitudes_are_one_too_many(tmp_path) -> None:
    with pytest.raises(InputError, match="altitudes in ft by their column, in another unit by 'EPSG:26910"):
        one(tmp_path, 5e5, 4e6, 1.0, ControlReference("EPSG:26910+5703"), "h_ft")
    assert one(tmp_path, 5e5, 4e6, 1.0, ControlReference("EPSG:26910+5703", "none"), "h [m]").lonlatalt[0, 2] == 1.0


# --- ground and image apart -------------------------------------------------------------------------------


def test_micmacs_image_points_are_found_beside_or_given(tmp_path) -> None:
    ground, image = tmp_path / "a-S3D.xml", tmp_path / "a-S2D.xml"
    ground.write_text(micmac(image=False))
    with pytest.raises(
        InputError, match=r"MicMac XML, ground points .*; give a file of image points with another --gcp"
    ):
        read_gcps(ground, NAMES)
    image.write_text(micmac(ground=False))
    for frame in (ControlReference(), ControlReference(others=(str(ground), str(image)))):
        found = read_gcps(ground, NAMES, frame)
        assert found.xy.tolist() == [[COL, ROW]]
        assert found.sigma.tolist() == [[2.0, 3.0, 4.0]]
        assert "image points of a-S2D.xml" in found.said[0]
    assert not read_gcps(image, NAMES, frame).names  # its points are those of the other file, once
    with pytest.raises(InputError, match="image points alone; give the file of ground points"):
        read_gcps(image, NAMES)
    (tmp_path / "b-S2D.xml").write_text(micmac(ground=False, name="right"))
    with pytest.raises(InputError, match=r"image points in a-S2D\.xml, b-S2D\.xml"):
        read_gcps(ground, NAMES)
    both = ControlReference(others=(str(ground), str(image), str(tmp_path / "b-S2D.xml")))
    assert read_gcps(ground, NAMES, both).view.tolist() == [0, 1]


def test_metashapes_files_of_an_image_each_go_with_its_reference(tmp_path) -> None:
    (tmp_path / "ref.csv").write_text(
        f"# CoordinateSystem: EPSG:4979\n#Label,X/Longitude,Y/Latitude,Z/Altitude\np,{LON},{LAT},9\n"
    )
    for view in NAMES:
        (tmp_path / f"{view}.csv").write_text("label,x,y\np,1,2\nq,3,4\n")
    files = tuple(str(tmp_path / name) for name in ("ref.csv", "left.csv", "right.csv"))
    found = read_gcps(files[0], NAMES, ControlReference(others=files))
    assert found.view.tolist() == [0, 1]
    assert found.names == ("p",)


# --- layers of a GIS --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("driver", "file"), [("GPKG", "left.gpkg"), ("ESRI Shapefile", "left.shp")])
def test_a_layer_of_gdal_s_is_read(tmp_path, driver, file) -> None:
    fiona = pytest.importorskip("fiona", reason="fiona writes the layers")
    schema = {"geometry": "3D Point", "properties": {"name": "str", "pixel": "float", "line": "float"}}
    with fiona.open(tmp_path / file, "w", driver=driver, crs="EPSG:32631", schema=schema) as layer:
        point = {"type": "Point", "coordinates": (EAST, NORTH, ALT)}
        layer.write({"type": "Feature", "geometry": point, "properties": {"name": "p", "pixel": COL, "line": ROW}})
    is_the_point(read_gcps(tmp_path / file, NAMES))


def is_the_point(found) -> None:
    assert found.names == ("p",)
    assert found.view.tolist() == [0]
    near(found, (LON, LAT, ALT))
    np.testing.assert_allclose(found.xy, [[COL, ROW]])


def geopackage_of(rows=(("p", COL, ROW),), shapes=None) -> bytes:
    shapes = point_shapes(np.array([[LON, LAT, ALT]] * len(rows))) if shapes is None else shapes
    return geopackage([MapLayer("control", shapes, ["name TEXT", "pixel REAL", "line REAL"], rows)])


UTM_PRJ = pyproj.CRS("EPSG:32631").to_wkt("WKT1_ESRI")


def shapefile_of(folder: Path, kind: int = 11, rows: int = 1, prj: str = UTM_PRJ, deleted: bool = False) -> Path:
    """A Shapefile by Esri's description of it (1998), its table by that of dBase III."""
    content = struct.pack("<I4d", kind, EAST, NORTH, ALT, 0.0)
    shapes = b"".join(struct.pack(">II", n + 1, len(content) // 2) + content for n in range(rows))
    (folder / "left.shp").write_bytes(b"\0\0\x27\x0a" + bytes(96) + shapes)
    fields = b"".join(
        name.ljust(11, b"\0") + form + bytes(4) + bytes([20, 9 * (form == b"N")]) + bytes(14)
        for name, form in ((b"name", b"C"), (b"pixel", b"N"), (b"line", b"N"))
    )
    row = b"".join(str(cell).encode().ljust(20) for cell in ("p", COL, ROW))
    table = [(b"*" if deleted and n else b" ") + row for n in range(rows)]
    head = struct.pack("<BBBBIHH20x", 3, 126, 1, 1, rows, 32 + len(fields) + 1, 61)
    (folder / "left.dbf").write_bytes(head + fields + b"\r" + b"".join(table) + b"\x1a")
    if prj:
        (folder / "left.prj").write_text(prj, encoding="utf-8")
    return folder / "left.shp"


def test_a_geopackage_and_a_shapefile_are_read_without_gdal(tmp_path) -> None:
    (tmp_path / "left.gpkg").write_bytes(geopackage_of())
    is_the_point(read_gcps(tmp_path / "left.gpkg", NAMES))
    is_the_point(read_gcps(shapefile_of(tmp_path), NAMES))
    is_the_point(read_gcps(shapefile_of(tmp_path, rows=2, deleted=True), NAMES))
    flat = read_gcps(shapefile_of(tmp_path, kind=1), NAMES)
    near(flat, (LON, LAT, 0.0))


def _changed(statement: str) -> bytes:
    with closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(geopackage_of())
        base.executescript(statement)
        return base.serialize()


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (lambda: _changed("UPDATE control SET geom = NULL"), "a feature without a geometry"),
        (lambda: _changed("UPDATE control SET geom = X'4750001100000000'"), "a feature without a geometry"),
        (lambda: geopackage_of(shapes=[shapely.box(0, 0, 1, 1)]), "no point"),
        (lambda: geopackage_of()[:5000], "damaged GeoPackage"),
        (lambda: b"SQLite format 3\0" + bytes(100), "damaged GeoPackage"),
        (lambda: _changed("DELETE FROM gpkg_geometry_columns"), "without a layer of points"),
        (lambda: _changed("DROP TABLE gpkg_geometry_columns"), "no such table"),
        (lambda: _changed("DROP TABLE control; CREATE VIEW control AS WITH RECURSIVE r(geom) AS (SELECT 1 UNION ALL "
                          "SELECT geom + 1 FROM r) SELECT geom FROM r WHERE geom < 0"), "interrupted"),
    ],
)  # fmt: skip
def test_a_geopackage_that_is_no_layer_of_points_is_said(tmp_path, monkeypatch, data, says) -> None:
    monkeypatch.setattr("barpc.pointio.layers._TURN", 10_000)
    (tmp_path / "left.gpkg").write_bytes(data())
    with pytest.raises(InputError, match=rf"left\.gpkg: .*{says}"):
        read_gcps(tmp_path / "left.gpkg", NAMES)


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({"prj": "GEOGCS[damaged"}, "not read as a reference system"),
        ({"prj": '\x01PROJCS["m'}, "not read as a reference system"),
        ({"prj": 'PROJCS["m"]'}, "no reference system"),
        ({"kind": 0}, "a feature without a geometry"),
        ({"kind": 5}, "no point"),
    ],
)
def test_a_shapefile_that_is_no_layer_of_points_is_said(tmp_path, how, says) -> None:
    with pytest.raises(InputError, match=rf"left\.shp: .*{says}"):
        read_gcps(shapefile_of(tmp_path, **how), NAMES)


@pytest.mark.parametrize("end", [".dbf", ".prj"])
def test_a_pipe_beside_a_shapefile_is_not_waited_for(tmp_path, end) -> None:
    path = shapefile_of(tmp_path)
    path.with_suffix(end).unlink()
    os.mkfifo(path.with_suffix(end))
    with pytest.raises(InputError, match=rf"left\{end}: a pipe"):
        read_gcps(path, NAMES)
    path.with_suffix(end).unlink()
    if end == ".dbf":
        with pytest.raises(InputError, match=r"without its left\.dbf"):
            read_gcps(path, NAMES)


# --- what is wrong is said --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "text", "says"),
    [
        ("left.points", "mapX,mapY,sourceX,sourceY\n5,43,1,2\n", "QGIS .points above its image"),
        ("left.points", "mapX,mapY,sourceX,sourceY\n5,43,1,high\n", "line 2: expected .*'high' is no number"),
        ("g.txt", "EPSG:32631\n1 2 3 4 5\n", "line 2|no GCP|no column image"),
        ("g.txt", "EPSG:32631\n1 2 3 4\n", r"line 2: expected .* \(no 'row'\)"),
        ("left.pts", "; Base (x,y), Warp (x,y)\n1 2 3 4\n", "ENVI .pts of two images"),
        ("g.xml", "<a/>", "XML without OneAppuisDAF"),
        ("g.xml", micmac(place="1 2"), "MicMac XML, expected Pt of three numbers, PtIm of two"),
        ("g.xml", "<a>", "not an XML document"),
        (
            "g.csv",
            "epsg,lon,lat,h,image,col,row\n1,5,43,1,left,1,2\n2,5,43,1,left,1,2\n",
            "points of 2 reference systems",
        ),
        ("g.csv", "lon,lat,h,image,col,row\n5;6,43,1,left,1,2\n", "line 2: expected"),
        ("g.dat", "what is this\n", r"in no format that is read \(.*QGIS \.points"),
        ("g.csv", "lon,lat,h,image,col,row\n5°24'N,43,1,left,1,2\n", "line 2: .*is no lon"),
        ("g.geojson", old_geojson([5, 43], col="1°30'E", row=2), "'col' of a point: .* is no number"),
        ("g.geojson", old_geojson([5, 43], col=1, row="2 30"), "'row' of a point: .* is no number"),
        ("g.geojson", old_geojson([5, 43, "high"], col=1, row=2), "'alt' of a point: 'high' is no number"),
        ("g.geojson", old_geojson(["5°24'N", 43], col=1, row=2), "'lon' of a point: .*is no lon"),
        ("g.geojson", old_geojson([5, True], col=1, row=2), "'lat' of a point: 'True' is no number"),
        ("g.geojson", old_geojson([5, None], col=1, row=2), "'lat' of a point: 'None' is no number"),
        ("g.geojson", old_geojson([5, 43], col=None, row=2), "'col' of a point: 'None' is no number"),
    ],
)
def test_a_message_names_the_place_and_no_python(tmp_path, file, text, says) -> None:
    (tmp_path / file).write_text(text, encoding="utf-8")
    refused(partial(read_gcps, names=NAMES), tmp_path / file, says)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: float("high"), "'high' is no number"), (lambda: int("1.5"), "'1.5' is no whole number"),
        (lambda: {}["ji"], "no 'ji'"), (lambda: [][1], "a value is missing, or of another kind"),
        (lambda: len(None), "a value is missing, or of another kind"),
        (lambda: np.array([[1], [1, 2]], dtype=float), "a value is missing, or of another kind"),
        (lambda: json.loads('{"a" 1}'), "Expecting ':' delimiter at line 1, column 6"),
    ],
)  # fmt: skip
def test_errors_of_python_are_said_in_other_words(make, says) -> None:
    with pytest.raises(Exception) as error:
        make()
    assert plain(error.value) == says
