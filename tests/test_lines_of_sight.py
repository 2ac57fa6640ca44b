"""Lines of sight on terrain: no ridge is passed through, both ends of the range count, what is outside is said."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from rasterio import Affine

from barpc.base.errors import BarpcWarning
from barpc.rasters.dem import Dem, localize_on_terrain
from tests.geotiffs import write_image
from tests.lanes import rest_slow

STEP = 30.0 / 111_195.0  # deg: posts of some 30 m
WEST, NORTH = 10.0, 0.2
SIDE = 600


class Oblique:
    """Parallel lines of sight that rise to the east by one over a slope: lon = col, lat = row, all exact."""

    def __init__(self, slope: float) -> None:
        self.slope = slope  # m east a metre of altitude

    def project(self, ground):
        return np.stack(
            [(ground[..., 0] - WEST) / STEP - self.slope * ground[..., 2] / 30.0, (NORTH - ground[..., 1]) / STEP],
            axis=-1,
        )

    def localize(self, image, alt):
        alt = np.broadcast_to(alt, np.shape(image)[:-1])
        lon = WEST + STEP * (image[..., 0] + self.slope * alt / 30.0)
        return np.stack([lon, NORTH - STEP * image[..., 1], alt], axis=-1)


def dem(tmp_path, heights) -> Dem:
    """A DEM whose node (row, col) is at col, row of `Oblique` on the ground."""
    place = Affine(STEP, 0.0, WEST - STEP / 2, 0.0, -STEP, NORTH + STEP / 2)
    return Dem.open(write_image(tmp_path / "dem.tif", heights.astype(np.float32), crs="EPSG:4979", transform=place))


def first_met(slope: float, profile: np.ndarray, col: float, high: float) -> float:
    """Altitude where a line meets a profile of linear pieces first, from above: by its pieces, one after the other."""
    line = (np.arange(len(profile)) - col) * 30.0 / slope  # over the nodes
    above = line - profile
    (pieces,) = np.nonzero((line[:-1] <= high) & (above[1:] >= 0) & (above[:-1] < 0))
    if not len(pieces):
        return float("nan")
    low, up = pieces[-1], pieces[-1] + 1
    return float(line[up] + (line[low] - line[up]) * above[up] / (above[up] - above[low]))


@pytest.mark.parametrize("slope", [1.0, 3.0, 0.3])
@pytest.mark.parametrize("high", rest_slow([9000.0, 700.0, 1500.0], keep=1))
def test_a_ridge_of_sixty_metres_on_one_post_is_met_and_not_passed_through(tmp_path, slope, high):
    profile = np.zeros(SIDE) + 100.0
    profile[300] = 160.0
    terrain = dem(tmp_path, np.tile(profile, (9, 1)))
    image = np.column_stack([np.linspace(150.0, 299.5, 400), np.full(400, 4.3)])
    found = localize_on_terrain(Oblique(slope), image, terrain, (-500.0, high))
    truth = np.array([first_met(slope, profile, col, high) for col in image[:, 0]])
    right = np.abs(found[:, 2] - truth) < 2e-4
    assert right.mean() >= 0.99  # what only grazes the ridge by less than a quarter of a post
    assert (right & (truth > 101.0)).any()
    np.testing.assert_allclose(Oblique(slope).project(found), image, atol=1e-6)


def test_the_far_side_of_a_rough_range_is_that_of_its_pieces(tmp_path):
    profile = 200.0 + 60.0 * np.random.default_rng(3).random(SIDE)
    terrain = dem(tmp_path, np.tile(profile, (5, 1)))
    image = np.column_stack([np.linspace(20.0, 480.0, 400), np.full(400, 2.0)])
    for low, high in ((0.0, 1000.0), (-500.0, 9000.0)):
        found = localize_on_terrain(Oblique(2.0), image, terrain, (low, high))
        truth = [first_met(2.0, profile, col, high) for col in image[:, 0]]
        wrong = ~(np.abs(found[:, 2] - truth) < 2e-4)
        assert wrong.mean() <= 0.02  # what only grazes a post by less than a quarter of one


@pytest.mark.parametrize("alt", [0.0, 500.0, 250.0])
def test_terrain_at_an_end_of_the_range_is_ground(tmp_path, alt):
    terrain, image = dem(tmp_path, np.full((9, 200), alt)), np.array([[50.0, 3.0], [80.5, 4.5]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = localize_on_terrain(Oblique(0.5), image, terrain, (0.0, 500.0))
        plain = localize_on_terrain(Oblique(0.5), image, lambda lon, lat: np.full(np.shape(lon), alt), (0.0, 500.0))
    np.testing.assert_allclose(found[:, 2], alt, atol=2e-4)
    np.testing.assert_allclose(plain[:, 2], alt, atol=2e-4)


def test_of_a_dem_half_outside_the_points_inside_are_found(tmp_path):
    heights = np.full((9, 200), 100.0)
    heights[:, 100:] = 900.0
    with pytest.warns(BarpcWarning, match=r"100 to 900 m, .* 1 of 2 lines"):
        found = localize_on_terrain(
            Oblique(0.01), np.array([[50.0, 3.0], [150.0, 3.0]]), dem(tmp_path, heights), (0.0, 500.0)
        )
    assert found[0, 2] == pytest.approx(100.0, abs=2e-4)
    assert np.isnan(found[1]).all()


def test_voids_and_the_edge_of_a_dem_stay_without_ground_and_without_a_word(tmp_path):
    heights = np.full((9, 200), 100.0)
    heights[:, 60:90] = np.nan
    image = np.array([[70.0, 3.0], [30.0, 3.0], [900.0, 3.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = localize_on_terrain(Oblique(0.1), image, dem(tmp_path, heights), (0.0, 500.0))
    assert np.isnan(found[[0, 2]]).all()
    assert found[1, 2] == pytest.approx(100.0, abs=2e-4)
    assert localize_on_terrain(Oblique(0.1), image[:0], dem(tmp_path, heights), (0.0, 500.0)).shape == (0, 3)
