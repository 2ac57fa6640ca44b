"""Footprints keep to RFC 7946: closed rings, counter-clockwise, cut at the antimeridian."""

from __future__ import annotations

import json

import numpy as np
import pytest
from shapely import Point
from shapely.geometry import LinearRing, shape


def outlines(finished):
    return json.loads((finished.folder / "tables/footprints.geojson").read_text())["features"]


def rings(geometry):
    parts = geometry["coordinates"] if geometry["type"] == "MultiPolygon" else [geometry["coordinates"]]
    return [ring for part in parts for ring in part]


@pytest.mark.parametrize("fixture", ["block_run", "antimeridian_run"])
def test_rings_are_closed_counter_clockwise_and_within_the_range_of_longitudes(fixture, request):
    """And those of an image across the antimeridian on both sides of it."""
    finished = request.getfixturevalue(fixture)
    features = outlines(finished)
    assert [f["properties"]["name"] for f in features] == [view.name for view in finished.views]
    for feature in features:
        geometry = feature["geometry"]
        for ring in rings(geometry):
            assert ring[0] == ring[-1]
            assert LinearRing(ring).is_ccw
            assert np.abs(np.array(ring)[:, 0]).max() <= 180.0
        if fixture == "antimeridian_run":
            assert geometry["type"] == "MultiPolygon"
            sides = sorted(float(np.mean(np.array(ring)[:, 0])) for ring in rings(geometry))
            assert sides[0] < -179 < 179 < sides[-1]


def test_tie_points_lie_in_the_footprints(block_run):
    ground = block_run.run.ground
    whole = [shape(feature["geometry"]) for feature in outlines(block_run)]
    tracks = block_run.run.tracks
    for k in np.linspace(0, len(tracks) - 1, 40).astype(int):
        if block_run.run.keep[k] and np.isfinite(ground[tracks.point[k]]).all():
            place = Point(*ground[tracks.point[k], :2])
            assert whole[tracks.view[k]].buffer(2e-3).contains(place)  # relief moves a point by some 100 m
