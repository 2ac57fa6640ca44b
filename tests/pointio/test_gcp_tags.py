"""GCPs in an image's tags: where they count from is decided once, for control and for the camera that they are."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.control import GroundControlPoint
from rasterio.errors import NotGeoreferencedWarning

from barpc.pointio.correspondences import read_gcp_grid
from barpc.pointio.gcps import read_gcps

WIDTH, HEIGHT = 41, 23
CENTRES = "GCPs of left.tif, counted from the centre of the first pixel"
CORNER = "GCPs of left.tif, counted from the corner of the first pixel"


def grid(first: float, beyond: float, steps: int = 4) -> np.ndarray:
    """Nodes from `first` to `beyond` pixels behind the image's width and height."""
    cols, rows = (np.linspace(first, size + beyond, steps + 1) for size in (WIDTH, HEIGHT))
    return np.stack(np.meshgrid(cols, rows), -1).reshape(-1, 2)


SCATTERED = np.array([[3.25, 20.5], [30.0, 2.75], [17.5, 11.0], [38.0, 19.25], [8.0, 8.0]])


def write(path: Path, given: np.ndarray, point: bool, by_gdal: bool) -> Path:
    """An image with GCPs; those of a raster of points as GDAL turns the given ones, or as another tool stores them.

    GDAL adds half a pixel where it writes and where it reads: a tool that keeps to GeoTIFF stores centres as they are.
    """
    given = given - 0.5 * (point and not by_gdal)
    gcps = [GroundControlPoint(r, c, 5 + c * 1e-5, 43 - r * 1e-5, 100.0 + c) for c, r in given.tolist()]
    profile = {"driver": "GTiff", "width": WIDTH, "height": HEIGHT, "count": 1, "dtype": "uint8"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", gcps=gcps, crs="EPSG:4326", **profile) as out:
            if point:
                out.update_tags(AREA_OR_POINT="Point")
    return path


@pytest.mark.parametrize(
    ("given", "point", "by_gdal", "off", "said"),
    [
        (grid(0, -1), False, True, 0.0, CENTRES),  # as Sentinel-1's
        (grid(0, 0), False, True, 0.5, CORNER),  # from edge to edge
        (grid(0.5, -0.5), False, True, 0.5, CORNER),  # centres as GDAL counts them
        (grid(0, -1, 1), False, True, 0.0, CENTRES),  # four corners
        (grid(0, -4), False, True, 0.0, f"{CENTRES}, by default"),
        (grid(2, -1), False, True, 0.0, f"{CENTRES}, by default"),
        (SCATTERED, False, True, 0.0, f"{CENTRES}, by default"),
        (SCATTERED[:1], False, True, 0.0, f"{CENTRES}, by default"),
        (grid(0, -1), True, False, 0.0, CORNER),  # GDAL hands on what begins at 0 from 0.5 on
        (SCATTERED, True, False, 0.0, f"{CORNER}, as of a raster of points"),
        (grid(3, -7), True, False, 0.0, f"{CORNER}, as of a raster of points"),
        (grid(0, -1), True, True, 0.0, "counted from 1 px before the centre of the first pixel"),
        (grid(0, 0), True, True, 0.5, "counted from 1.5 px before the centre of the first pixel"),
    ],
)
def test_control_and_camera_count_from_the_same_place(given, point, by_gdal, off, said, tmp_path) -> None:
    path = write(tmp_path / "left.tif", given, point, by_gdal)
    control = read_gcps(path, ["left", "right"])
    camera, size = read_gcp_grid(path)
    assert size == (WIDTH, HEIGHT)
    np.testing.assert_allclose(control.xy, given - off, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(camera.image, control.xy)
    np.testing.assert_array_equal(camera.ground, control.lonlatalt)
    assert control.view.tolist() == [0] * len(given)
    assert camera.note.endswith(said)
    assert camera.note in control.said[0]


@pytest.mark.parametrize("nudge", [2e-4, 5e-3, 0.2])
def test_a_grid_that_ends_near_a_pixel_s_centre_ends_there_and_one_that_does_not_tells_nothing(nudge, tmp_path) -> None:
    given = grid(0.5, -0.5)
    given[-1] += nudge
    found = read_gcps(write(tmp_path / "left.tif", given, point=False, by_gdal=True), ["left"])
    np.testing.assert_allclose(found.xy, given - 0.5 * (nudge < 1e-3), rtol=0, atol=1e-9)
