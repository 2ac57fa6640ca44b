"""A reference of another season has little of the grey values left, and all of the edges in their place."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from scipy import ndimage

from barpc.rasters.dem import Dem
from tests.scenes import ImageOptions, Scene
from tests.scenes.redrawn import redrawn
from tests.scenes.season import other_season, write_dem, write_reference


@pytest.mark.slow
def test_a_season_changes_what_it_says(tmp_path):
    scene = Scene(ImageOptions(views=1, size=(200, 200), buildings=2.0))
    grey = scene.surfaces[0].ground.values
    mild, other = (other_season(scene, 1, changed=part, snow=0.0).values for part in (0.0, 0.8))
    assert abs(np.corrcoef(grey.ravel(), mild.ravel())[0, 1]) < 0.7
    assert (np.abs(mild - other) > 1e-6).mean() > 0.6
    with rasterio.open(write_reference(tmp_path / "r.tif", scene, other_season(scene, 1), 2.0)) as file:
        assert file.crs.to_epsg() == 32631
        assert file.res == (2.0, 2.0)
        assert (file.read(1) > 0).mean() > 0.8
    dem, middle = Dem.open(write_dem(tmp_path / "d.tif", scene, 1, error=0.0, bias=7.0)), scene.target
    height = float(scene.terrain.relief(np.zeros(1), np.zeros(1))[0])
    assert abs(float(dem(middle[0], middle[1])) - height - 7.0) < 2.0


def test_a_redrawn_picture_says_little_of_the_one_before_but_where_lines_are():
    scene = Scene(ImageOptions(views=1, size=(200, 200), buildings=2.0))
    grey = (1 + 900 * scene.surfaces[0].ground.values[:300, :400]).astype(np.uint16)
    bare, white = redrawn(grey, 1, snow=0.0), redrawn(grey, 1)
    assert np.array_equal(white, redrawn(grey, 1))
    assert not np.array_equal(white, redrawn(grey, 2))
    fine = [one.astype(float) - ndimage.gaussian_filter(one.astype(float), 2.0) for one in (grey, bare)]
    assert np.corrcoef(fine[0].ravel(), fine[1].ravel())[0, 1] < 0.1
