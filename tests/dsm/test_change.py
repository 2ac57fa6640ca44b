"""Differences of two dates of one block: what both share is no error of theirs, by many blocks and by pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import rasterio

from barpc.ba import adjust_tracks, block_prior
from barpc.base.geodesy import ground_from_ecef
from barpc.base.options import AdjustOptions
from barpc.base.verb_options import DsmOptions
from barpc.dsm.stereo import CameraErrors
from barpc.dsm.surface import make_dsm
from barpc.pipeline import adjust
from barpc.sensor.corrected import Corrected
from barpc.sensor.triangulation import triangulate
from barpc.simulate import simulate_block
from tests.cli.test_main import run
from tests.everywhere import rows_of
from tests.lanes import rest_slow
from tests.scenes import ImageOptions, Scene
from tests.scenes.files import _write_image

DATES = (0, 1), (2, 3)


def heights(sensors, seen, pair, ground):
    rows = rows_of(np.stack([seen[k] for k in pair], axis=1))
    found = triangulate([sensors[k] for k in pair], *rows, alt=ground[:, 2])
    return ground_from_ecef(found.points)[:, 2]


def one_block(seed):
    """Error of the height difference of two dates at some points, its sigma, and that of independent dates."""
    # (an image's tie points are never believed beyond 0.02 px together: 0.3 px of 60 are 0.04)
    block = simulate_block(4, 60, seed=seed, per_site=4, size=(6000, 6000), noise=0.3)
    found = adjust_tracks(block.views, block.tracks, AdjustOptions(drift=0))
    views = [replace(view, sensor=sensor) for view, sensor in zip(block.views, found.sensors, strict=True)]
    errors = CameraErrors.of(block_prior(found), views)
    corrections = zip(block.views, block.truth.corrections, strict=True)
    seen_by = [Corrected(view.sensor, correction) for view, correction in corrections]
    ground = block.truth.check_ground[:20]
    seen = [sensor.project(ground) for sensor in seen_by]
    first, second = (heights(found.sensors, seen, pair, ground) for pair in DATES)
    rows = [errors.rows([[pair]], ground) for pair in DATES]
    naive = np.hypot(*(errors.sigma(one) for one in rows))
    return first - second, errors.sigma(errors.rows([[pair] for pair in DATES], ground)), naive, first - ground[:, 2]


@pytest.mark.slow
@pytest.mark.parametrize("blocks", rest_slow([12, 60], mark=pytest.mark.nightly))
def test_the_sigma_of_a_difference_is_honest_and_a_third_of_the_naive_sum_at_most(blocks: int):
    found = [one_block(seed) for seed in range(blocks)]
    off, sigma, naive, absolute = (np.array(part) for part in zip(*found, strict=True))
    nees = (off / sigma) ** 2
    assert 0.8 < nees.mean() < 1.25
    assert (sigma < naive / 3.0).all()
    assert np.abs(absolute).mean() > 3.0 * np.abs(off).mean()  # as the dates do share an error
    assert ((off / naive) ** 2).mean() < 0.2  # what the naive sum would have said


@pytest.fixture(scope="module")
def two_dates(tmp_path_factory):
    """Four images of two dates; on the second a building is 12 m taller. Both adjusted together, the first alone."""
    folder = tmp_path_factory.mktemp("dates")
    options = ImageOptions(views=4, size=(420, 400), seed=9, buildings=3.0, relief=20.0)
    before, after = Scene(options), Scene(options)
    raised = tallest(after, before)
    for i, shot in enumerate(before.shots):
        scene = before if i < 2 else after
        _write_image(folder / f"{shot.name}.tif", scene.picture(i).numbers, shot.delivered)
    paths = [folder / f"{shot.name}.tif" for shot in before.shots]
    adjust(paths, folder / "both")
    adjust(paths[:2], folder / "first")
    return before, folder, raised


def tallest(after, before):
    """Raise the largest roof near the middle by 12 m; its place."""
    buildings = after.terrain.buildings
    middle = after.terrain.plane.xy(after.target[None])[0][:2]
    far = np.linalg.norm(buildings.center - middle, axis=1)
    chosen = int(np.argmax(np.where(far < 60.0, buildings.half.min(axis=1), 0.0)))
    buildings.top[chosen] += 12.0
    assert before.terrain.buildings.top[chosen] + 12.0 == pytest.approx(buildings.top[chosen])
    return chosen


@pytest.mark.nightly
def test_a_building_that_grew_is_the_change_and_the_rest_is_none(two_dates, tmp_path):
    scene, folder, chosen = two_dates
    assert run("-q", "dsm", folder / "both", "-o", tmp_path / "change.tif", "--minus", folder / "first") == 0
    with rasterio.open(tmp_path / "change.tif") as file:
        bands, place, crs, tags = file.read(), file.transform, file.crs, file.tags()
        assert file.descriptions[0].startswith("height minus")
    plane, buildings = scene.terrain.plane, scene.terrain.buildings
    lon, lat, _ = plane.ground(np.append(buildings.center[chosen], buildings.top[chosen])[None])[0]
    x, y = (part[0] for part in rasterio.warp.transform("EPSG:4326", crs, [lon], [lat]))
    col, row = (int(part) for part in (~place) @ (x, y))
    roof = bands[0, row - 1 : row + 2, col - 1 : col + 2]
    assert np.nanmedian(roof) == pytest.approx(12.0, abs=1.0)  # the second date minus the first
    known = np.isfinite(bands[0])
    shared = float(tags["SIGMA_SHARED_BY_ALL_CELLS_M"])
    sigma = np.sqrt(bands[3][known] ** 2 + bands[4][known] ** 2 + shared**2)
    assert abs(np.median(bands[0][known])) < 3.0 * np.hypot(shared, 0.05)
    assert 0.55 < np.mean(np.abs(bands[0][known]) < sigma) < 0.90
    whole = make_dsm(folder / "both", tmp_path / "whole.tif", DsmOptions())
    assert shared < whole.datum / 3.0
