"""Files of correspondences: what is read, and what is refused with the reason."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from barpc.pointio.correspondences import read_correspondences
from tests.pointio.conftest import refused

ROWS = np.array([[5.4, 43.2, 100.0, 10.5, 20.25], [5.5, 43.3, 120.5, 11.0, 21.0]])


def check(path: Path) -> None:
    points = read_correspondences(path)
    assert np.array_equal(points.ground, ROWS[:, :3])
    assert np.array_equal(points.image, ROWS[:, 3:])


@pytest.mark.parametrize(
    "text",
    [
        "lon,lat,alt,col,row\n5.4,43.2,100,10.5,20.25\n5.5,43.3,120.5,11,21\n",
        "# points\nROW;COL;Latitude;Longitude;Height [m]\n20.25;10.5;43.2;5.4;100\n21;11;43.3;5.5;120.5\n",
        "5.4 43.2 100 10.5 20.25\n\n5.5 43.3 120.5 11 21  # last\n",
        "\ufeffid,line,sample,lon,lat,h\n1,20.25,10.5,5.4,43.2,100\n2,21,11,5.5,43.3,120.5\n",
    ],
)
def test_a_text_table_is_read_by_its_header_or_in_the_order_of_the_convention(tmp_path: Path, text: str) -> None:
    path = tmp_path / "points.csv"
    path.write_text(text, encoding="utf-8")
    check(path)


def test_npz_holds_two_arrays_or_one_a_column(tmp_path: Path) -> None:
    np.savez(tmp_path / "two.npz", ground=ROWS[:, :3], image=ROWS[:, 3:])
    np.savez(tmp_path / "five.npz", lon=ROWS[:, 0], lat=ROWS[:, 1], alt=ROWS[:, 2], col=ROWS[:, 3], row=ROWS[:, 4])
    check(tmp_path / "two.npz")
    check(tmp_path / "five.npz")


def test_geojson_points_carry_their_image_position(tmp_path: Path) -> None:
    features = [
        {"properties": {"ji": row[3:]}, "geometry": {"type": "Point", "coordinates": row[:3]}} for row in ROWS.tolist()
    ]
    path = tmp_path / "points.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    check(path)


@pytest.mark.parametrize(
    ("place", "crs", "says"),
    [
        ([5.0, 43.0], None, "GCP p has no altitude"),
        ([694517.1, 4796000.0, 100.0], "urn:ogc:def:crs:EPSG::32631", "its GCPs are in urn:ogc:def:crs:EPSG::32631"),
        ([5.0, 43.0, 100.0], "EPSG:4267", "its GCPs are in EPSG:4267"),  # another datum: 100 m and more
    ],
)
def test_geojson_points_that_are_no_places_on_wgs84_are_refused(tmp_path: Path, place, crs, says) -> None:
    feature = {"properties": {"id": "p", "ji": [1, 2]}, "geometry": {"type": "Point", "coordinates": place}}
    document = {"type": "FeatureCollection", "features": [feature]}
    document |= {"crs": {"properties": {"name": crs}}} if crs else {}
    (tmp_path / "a.geojson").write_text(json.dumps(document))
    refused(read_correspondences, tmp_path / "a.geojson", says)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", b"lon,lat,alt,col\n1,2,3,4\n", "no column row"),
        ("a.csv", b"lon,lat,alt,col,row\n1,2,3,4,x\n", "line 2"),
        ("a.csv", b"lon,lat,alt,col,row\n1,2,3\n", "line 2"),
        ("a.txt", b"5.4 43.2 100 10 20\n1 2 3 4\n", "line 2: expected lon, lat, alt, col, row"),
        ("a.csv", b"lon,lat,alt,col,row\n", "no points"),
        ("a.csv", b"lon lat alt col row\n# 5.4 43.2 100 10 20\n", r"a\.csv: no points in it$"),
        ("a.npz", b"PK\x03\x04 nothing", "not an archive of arrays"),
        ("a.json", b'{"type": "FeatureCollection", "features": [{}]}', "not a GeoJSON"),
        ("a.txt", b"LINE_OFF: 5\n", "neither a table"),
        ("a.bin", bytes(range(256)), "neither a table"),
        ("a.csv", b"", "the file is empty"),
    ],
)
def test_what_is_no_table_is_refused_with_the_reason(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    refused(read_correspondences, tmp_path / name, message)


def test_a_file_that_does_not_exist_is_said_so(tmp_path: Path) -> None:
    refused(read_correspondences, tmp_path / "none.csv", "no such file")
