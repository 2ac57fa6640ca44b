"""map.gpkg: a GIS finds every image, tie point and ground point of a run where the tables have them."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import get_args, get_type_hints
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely

from barpc.report.geopackage import STYLES, MapLayer, geopackage, point_shapes
from barpc.report.runfiles import read_tables
from barpc.report.summary.ground_points import GcpEntry
from barpc.report.summary.words import STATUS_WORDS


def layer(path: Path, name: str) -> tuple[list[shapely.Geometry], list[dict[str, object]]]:
    """Geometries and columns of a layer, read as the standard says a geometry is encoded."""
    with closing(sqlite3.connect(path)) as data:
        found = data.execute(f"SELECT * FROM {name} ORDER BY fid")
        names, rows = [column[0] for column in found.description], found.fetchall()
    for row in rows:
        assert row[1][:4] == b"GP\0\1"
        assert int.from_bytes(row[1][4:8], "little") == 4326
    return [shapely.from_wkb(row[1][8:]) for row in rows], [dict(zip(names, row, strict=True)) for row in rows]


@pytest.mark.parametrize("fixture", ["block_run", "antimeridian_run"])
def test_the_map_holds_what_the_tables_hold(fixture, request):
    finished = request.getfixturevalue(fixture)
    path, tables = finished.folder / "map.gpkg", read_tables(finished.record, finished.folder)
    shapes, rows = layer(path, "footprints")
    features = json.loads((finished.folder / "tables/footprints.geojson").read_text())["features"]
    assert [row["name"] for row in rows] == [one["properties"]["name"] for one in features]
    for shape, row, feature in zip(shapes, rows, features, strict=True):
        assert shape.equals(shapely.geometry.shape(feature["geometry"]))
        assert {key: row[key] for key in feature["properties"]} == feature["properties"]
    shapes, rows = layer(path, "tie_points")
    np.testing.assert_allclose(shapely.get_coordinates(shapes, include_z=True), tables.points[:, :3], atol=1e-4)
    assert [row["track"] for row in rows] == tables.tracks.tolist()
    np.testing.assert_allclose([row["residual_px"] for row in rows], tables.points[:, 3], atol=1e-4)


def test_gcps_stand_where_they_were_given_with_their_verdicts(block_run):
    given, entries = block_run.run.gcps, block_run.record.gcps
    assert entries
    shapes, rows = layer(block_run.folder / "map.gpkg", "gcps")
    assert [(row["name"], row["status"]) for row in rows] == [(one.name, one.status) for one in entries]
    place = dict(zip(given.names, given.lonlatalt.tolist(), strict=True))
    found = shapely.get_coordinates(shapes, include_z=True)
    np.testing.assert_allclose(found, [place[one.name] for one in entries], atol=1e-9)
    assert [row["up_m"] for row in rows] == [one.residual_enu_m[2] for one in entries]


def test_the_standard_s_tables_name_every_layer_and_none_that_is_empty(block_run):
    with closing(sqlite3.connect(block_run.folder / "map.gpkg")) as data:
        assert data.execute("PRAGMA application_id").fetchone()[0] == int.from_bytes(b"GPKG", "big")
        assert data.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert data.execute("PRAGMA foreign_key_check").fetchall() == []
        contents = {row[0]: row for row in data.execute("SELECT * FROM gpkg_contents")}
        columns = {row[0]: row for row in data.execute("SELECT * FROM gpkg_geometry_columns")}
        assert [row[0] for row in data.execute("SELECT srs_id FROM gpkg_spatial_ref_sys ORDER BY 1")] == [-1, 0, 4326]
    assert contents.keys() - columns.keys() == {"layer_styles"}
    assert columns.keys() == {"footprints", "tie_points", "gcps"}
    assert contents["layer_styles"][1:3] == ("attributes", "layer_styles")
    west, south, east, north = contents["tie_points"][5:9]
    assert west < east
    assert south < north
    assert columns["tie_points"][2:5] == ("POINT", 4326, 1)
    assert columns["footprints"][2:5] == ("POLYGON", 4326, 0)


def test_qgis_finds_a_style_of_every_layer_that_draws_each_status_as_the_report_does(block_run):
    """As its OGR provider asks: by the names of table and geometry, with empty ones of catalogue and schema."""
    with closing(sqlite3.connect(block_run.folder / "map.gpkg")) as data, data:
        asked = "SELECT styleQML, useAsDefault FROM layer_styles WHERE f_table_schema = '' AND f_table_name = ? AND "
        found = {
            name: data.execute(f"{asked} f_geometry_column = ?", (name, column)).fetchall()
            for name, column in data.execute("SELECT table_name, column_name FROM gpkg_geometry_columns")
        }
        held = {name: [row[1] for row in data.execute(f"PRAGMA table_info({name})")] for name in found}
    assert found.keys() == {"footprints", "tie_points", "gcps"}
    css = (Path(geopackage.__code__.co_filename).parent / "template.html.j2").read_text()
    for name, rows in found.items():
        ((text, default),) = rows
        assert default == 1
        root = ElementTree.fromstring(text)
        assert root.findtext("layerGeometryType") == ("2" if name == "footprints" else "0")
        renderer = root.find("renderer-v2")
        assert renderer.get("attr") in held[name]
        symbols = {one.get("name"): one for one in renderer.iter("symbol")}
        values = {one.get("value"): symbols[one.get("symbol")] for one in renderer.iter("category")}
        assert len(values) == len(symbols)
        assert "" in values  # QGIS: all other values
        known = {"footprints": STATUS_WORDS, "gcps": get_args(get_type_hints(GcpEntry)["status"])}.get(name, ())
        assert values.keys() - {""} <= set(known)
        for value, symbol in values.items():
            props = {one.get("k"): one.get("v") for one in symbol.iter("prop")}
            colour = props["outline_color" if name == "footprints" else "color"].split(",")
            assert "#{:02x}{:02x}{:02x}".format(*map(int, colour)) in css, (name, value)


def test_ties_are_small_and_check_points_are_gcps_upside_down():
    drawn = {
        name: {one.get("k"): one.get("v") for one in ElementTree.fromstring(style.qml()).iter("prop")}
        for name, style in STYLES.items()
    }
    assert drawn["footprints"]["outline_width"] == "0.5"
    assert drawn["tie_points"]["size"] == "0.8"
    (gcps, checks), shape = (drawn["gcps"], drawn["check_points"]), ("name", "size", "outline_style")
    assert [gcps[key] for key in shape] == [checks[key] for key in shape] == ["triangle", "3.5", "no"]
    assert (int(checks["angle"]) - int(gcps["angle"])) % 360 == 180


def test_numbers_that_are_not_known_are_null():
    found = geopackage([MapLayer("a", point_shapes(np.array([[1.0, 2.0, 3.0]])), ["x DOUBLE"], [(float("nan"),)])])
    with closing(sqlite3.connect(":memory:")) as data:
        data.deserialize(found)
        assert data.execute("SELECT x FROM a").fetchall() == [(None,)]


@pytest.mark.parametrize("reader", ["pyogrio", "fiona"])
def test_gdal_opens_every_layer(reader, block_run):
    module, path = pytest.importorskip(reader), block_run.folder / "map.gpkg"
    names = [str(name) for name, *_ in module.list_layers(path)] if reader == "pyogrio" else module.listlayers(path)
    assert list(names) == ["footprints", "tie_points", "gcps", "layer_styles"]
    if reader == "pyogrio":
        about, _, shapes, columns = module.raw.read(path, layer="tie_points")
        assert (about["crs"], about["geometry_type"]) == ("EPSG:4326", "Point Z")
        found, tracks = shapely.from_wkb(shapes), columns[list(about["fields"]).index("track")].tolist()
    else:
        with module.open(path, layer="tie_points") as rows:
            assert rows.crs.to_epsg() == 4326
            read = list(rows)
        found = [shapely.geometry.shape(row["geometry"]) for row in read]
        tracks = [row["properties"]["track"] for row in read]
    tables = read_tables(block_run.record, block_run.folder)
    assert tracks == tables.tracks.tolist()
    np.testing.assert_allclose(shapely.get_coordinates(found, include_z=True), tables.points[:, :3], atol=1e-4)
