"""Footprints as RFC 7946 asks."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from shapely.geometry import shape

from barpc.base.geodesy import feature_collection, geojson_feature, polygon
from barpc.sensor.geometry import footprint
from barpc.simulate import Look, fly
from tests.sensor.conftest import make_rpc


def ring(west: float, south: float, east: float, north: float) -> np.ndarray:
    return np.array([[west, south], [west, north], [east, north], [east, south]])


def test_a_polygon_is_closed_counter_clockwise_and_in_range():
    geometry = polygon(ring(5, 43, 6, 44))
    coordinates = np.array(geometry["coordinates"][0])
    assert geometry["type"] == "Polygon"
    np.testing.assert_array_equal(coordinates[0], coordinates[-1])
    assert shape(geometry).exterior.is_ccw
    assert shape(geometry).equals(shapely.box(5, 43, 6, 44))


@pytest.mark.parametrize(
    ("ends", "parts"),
    [
        *(((179.5 + turn, 181 + turn), [(179.5, 180), (-180, -179)]) for turn in (-360.0, 0.0, 360.0)),
        ((179, 180), [(179, 180)]),  # it only touches the antimeridian
        ((180, 181), [(-180, -179)]),
        ((300, 301), [(-60, -59)]),
    ],
)
def test_a_footprint_lies_in_range_and_the_antimeridian_cuts_it_in_two(ends, parts):
    geometry = shape(polygon(ring(ends[0], 10, ends[1], 11)))
    assert geometry.geom_type == ("MultiPolygon" if len(parts) == 2 else "Polygon")
    assert geometry.equals(shapely.union_all([shapely.box(west, 10, east, 11) for west, east in parts]))
    assert all(part.exterior.is_ccw for part in getattr(geometry, "geoms", [geometry]))


@pytest.mark.parametrize(("lat", "pole"), [(80.0, 90.0), (-80.0, -90.0)])
def test_an_outline_around_a_pole_holds_the_pole(lat, pole):
    lon = np.arange(0.0, 360.0, 10.0)
    for order in (1, -1):
        geometry = shape(polygon(np.column_stack([lon, np.full_like(lon, lat)])[::order]))
        assert geometry.is_valid
        assert geometry.area == pytest.approx(3600.0)
        assert geometry.covers(shapely.Point(17.0, (lat + pole) / 2))
        assert not geometry.intersects(shapely.Point(17.0, 0.0))


def test_an_image_of_the_pole_holds_the_pole():
    """Its outline goes once around, which a plain polygon of its corners does not know."""
    camera = fly(np.array([10.0, 90.0, 0.0]), Look(), (4000, 4000), 0.5)
    geometry = shape(polygon(footprint(camera, (4000, 4000), 0.0)))
    assert geometry.is_valid
    for lon in (-170.0, -90.0, 0.0, 90.0, 170.0):
        assert geometry.covers(shapely.Point(lon, 89.9999))


def test_an_outline_that_misses_the_ground_has_no_geometry():
    assert polygon(np.array([[0.0, 0.0], [np.nan, 1.0], [1.0, 1.0]])) is None


def test_a_camera_across_the_antimeridian_keeps_its_area():
    here = shape(polygon(footprint(make_rpc(lon=5.0), (20000, 19000), 500.0)))
    there = shape(polygon(footprint(make_rpc(lon=180.0), (20000, 19000), 500.0)))
    assert there.geom_type == "MultiPolygon"
    assert there.area == pytest.approx(here.area, rel=1e-9)
    assert there.bounds[0] >= -180
    assert there.bounds[2] <= 180


def test_features_carry_their_properties():
    document = feature_collection([geojson_feature(ring(5, 43, 6, 44), name="a", alt=3.0)])
    assert document["features"][0]["properties"] == {"name": "a", "alt": 3.0}
