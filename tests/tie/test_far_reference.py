"""Cameras that are hundreds of metres off are found on a real orthoimage, and right ones stay where they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import barpc
from barpc.rasters.dem import Dem
from barpc.scene import View
from barpc.tie.reference import register_views
from barpc.verbs.moving import moved

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::barpc.base.errors.BarpcWarning")]


@pytest.mark.nightly
@pytest.mark.parametrize("off", [(0.0, 0.0), (150.0, 0.0), (400.0, -300.0), (-700.0, 500.0)])
def test_cameras_far_off_are_found_on_an_orthoimage(shared_data: Path, off: tuple[float, float]) -> None:
    folder = shared_data / "cross_sensor/ngi_2015"
    file = folder / "ngi_05_0182.tif"
    camera = barpc.open_camera(file)
    (there,) = moved([camera], (*off, 0.0), None)
    view = View("a", str(file), camera.extent, there.model, camera.alt_range)
    found = register_views(
        [view], [str(folder / "ortho_05_0182.tif")], Dem.open([str(folder / "dem.tif")], None, None), 1
    )
    (match,) = found.views
    assert match.peak > 10.0
    assert match.points > 300
    np.testing.assert_allclose(match.offset, off, atol=0.5)


@pytest.mark.nightly
def test_an_orthoimage_of_another_place_is_refused(shared_data: Path) -> None:
    folder = shared_data / "cross_sensor/ngi_2015"
    file = folder / "ngi_05_0182.tif"
    camera = barpc.open_camera(file)
    (there,) = moved([camera], (2500.0, -1500.0, 0.0), None)
    view = View("a", str(file), camera.extent, there.model, camera.alt_range)
    dem = Dem.open([str(folder / "dem.tif")], None, None)
    found = register_views([view], [str(folder / "ortho_05_0182.tif")], dem, 1)
    assert found.control is None
