"""GCP files: what each syntax holds arrives, and what is wrong is said with its place."""

from __future__ import annotations

from functools import partial

import numpy as np
import pyproj
import pytest
from rasterio.control import GroundControlPoint

from barpc.pointio.gcps import read_gcps
from tests.geotiffs import write_image
from tests.pointio.conftest import refused

NAMES = ["left", "right"]

ASP = """# WKT: GEOGCS[...]
1 43.25 5.44 120.5 0.1 0.2 0.3 /data/left.tif 100.5 200.25 0.5 0.4 right.tif 110 210 1 1
2 43.26 5.45 130 1 1 1 left.tif 300 400 1 1 other.tif 5 6 1 1
"""


def test_an_asp_file_gives_points_sigmas_and_observations(tmp_path):
    path = tmp_path / "a.gcp"
    path.write_text(ASP)
    found = read_gcps(path, NAMES)
    assert found.names == ("1", "2")
    np.testing.assert_array_equal(found.lonlatalt, [[5.44, 43.25, 120.5], [5.45, 43.26, 130.0]])
    np.testing.assert_array_equal(found.sigma, [[0.1, 0.2, 0.3], [1, 1, 1]])
    np.testing.assert_array_equal(found.point, [0, 0, 1])
    np.testing.assert_array_equal(found.view, [0, 1, 0])
    np.testing.assert_array_equal(found.xy, [[100.5, 200.25], [110, 210], [300, 400]])
    np.testing.assert_array_equal(found.xy_sigma, [0.5, 1, 1])


def test_a_text_whose_first_letters_are_those_of_a_tiff_is_a_text(tmp_path):
    path = tmp_path / "a.gcp"
    path.write_text("II-7 43.26 5.45 130 1 1 1 left.tif 300 400 1 1\n")
    assert read_gcps(path, NAMES).names == ("II-7",)


def test_tags_in_a_map_projection_are_brought_to_wgs84(tmp_path):
    gcps = [GroundControlPoint(row=2, col=1, x=5e5, y=4.7e6, z=100.0, id="p")]
    path = write_image(tmp_path / "left.tif", np.zeros((4, 4), np.uint8), gcps=gcps, crs="EPSG:32631")
    x, y = pyproj.Proj(proj="utm", zone=31, ellps="WGS84")(5e5, 4.7e6, inverse=True)
    np.testing.assert_allclose(read_gcps(path, NAMES).lonlatalt, [[x, y, 100.0]], atol=1e-10)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1 43 5 120 1 1 1 left.tif 1 2 1\n", "line 1"),
        ("1 43 5 120 1 1\n", "line 1"),
        ("1 4812345.6 512345.6 120 1 1 1 left.tif 1 2 1 1\n", "map coordinates"),
        ("1 43 5 120 1 1 1 far.tif 1 2 1 1\n", "no GCP of left, right; it names far.tif"),
        ("# nothing\n", "no GCP"),
        ('{"features": [{"properties": {}}]}', "not a GeoJSON"),
        ("{broken", "not a GeoJSON"),
        ("1 43 5 120 0 1 1 left.tif 1 2 1 1\n", "sigmas positive"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(tmp_path, text, says):
    path = tmp_path / "bad.gcp"
    path.write_text(text)
    refused(partial(read_gcps, names=NAMES), path, says)


def test_a_missing_file_is_an_input_error(tmp_path):
    refused(partial(read_gcps, names=NAMES), tmp_path / "none.gcp", "no such file")


def test_the_quickbird_points_read_alike_from_geojson_and_from_tags(shared_data):
    folder = shared_data / "optical" / "qb2_single"
    text = read_gcps(folder / "gcps.geojson", ["qb2_basic1b"])
    tags = read_gcps(folder / "qb2_basic1b.tif", ["qb2_basic1b"])
    assert len(text.names) == 5
    np.testing.assert_allclose(text.xy, tags.xy)
    np.testing.assert_allclose(text.lonlatalt, tags.lonlatalt)
