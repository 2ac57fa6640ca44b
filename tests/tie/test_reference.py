"""Registering images to an orthoimage of another season: how far every camera is off, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.dem import Dem
from barpc.errors import InputError
from barpc.geodesy import metres_per_unit
from barpc.pipeline.views import load_views
from barpc.rpcio import read_rpc
from barpc.scene import View
from barpc.sensor.rpc import RPC
from barpc.tie.reference import PEAK, register
from tests.scenes import ImageOptions, Scene
from tests.scenes.season import other_season, write_dem, write_reference
from tests.scenes.terrain import Grid

SAMPLES = Path(__file__).resolve().parents[2] / "data_samples"
GSD = 2.0


@pytest.fixture(scope="module")
def truth():
    return json.loads((SAMPLES / "truth.json").read_text())


@pytest.fixture(scope="module")
def scene(truth):
    options = {key: tuple(v) if isinstance(v, list) else v for key, v in truth["options"].items()}
    return Scene(ImageOptions(**options))


@pytest.fixture(scope="module")
def season(scene):
    return other_season(scene, 3)


@pytest.fixture(scope="module")
def reference(scene, season, tmp_path_factory):
    return str(write_reference(tmp_path_factory.mktemp("reference") / "ref.tif", scene, season, GSD))


@pytest.fixture(scope="module")
def dem(scene, tmp_path_factory):
    return Dem.open(write_dem(tmp_path_factory.mktemp("dem") / "dem.tif", scene, 3, error=1.0))


@pytest.fixture(scope="module")
def views():
    return load_views(sorted(SAMPLES.glob("*.tif"))).views[:1]


def off(view: View, truth) -> np.ndarray:
    """How far a camera shows the check points from their place, east, north (2,) [m]."""
    points = [point for point in truth["check_points"] if view.name in point["image"]]
    ground = np.array([point["ground"] for point in points])
    image = np.array([point["image"][view.name] for point in points])
    there = view.sensor.localize(image, ground[:, 2])
    return ((there - ground)[:, :2] * metres_per_unit(ground)[:, :2]).mean(axis=0)


def shifted(view: View, px: tuple[float, float]) -> View:
    sensor = view.sensor
    assert isinstance(sensor, RPC)
    return replace(view, sensor=replace(sensor, image_offset=sensor.image_offset + px))


@pytest.mark.parametrize("px", [(0.0, 0.0), (120.0, -90.0)])
def test_the_camera_is_off_by_what_was_done_to_it(px, views, reference, dem, truth):
    view = shifted(views[0], px)
    found = register([view], [reference], dem)
    (match,) = found.views
    assert match.peak > PEAK
    assert match.points > 100
    east, north = np.abs(match.offset - off(view, truth))
    assert east < 0.2
    assert (
        north < 1.0
    )  # along the line of sight: houses, and what of the terrain's error does not average out
    assert np.linalg.norm(off(view, truth)) > (5.0 if px == (0.0, 0.0) else 60.0)
    points = found.control.points
    exact = read_rpc_of(truth, view.name).project(points.lonlatalt[points.point])
    error = (points.xy - exact) * 0.5  # m
    assert np.median(np.linalg.norm(error, axis=1)) < 1.2
    assert found.step == pytest.approx(GSD, rel=1e-3)
    assert found.sigma == 0.5


def read_rpc_of(truth, name: str) -> RPC:
    (record,) = (view["exact_rpc"] for view in truth["views"] if view["name"] == name)
    return RPC(**{key: np.array(value) for key, value in record.items()})


def test_a_reference_that_lies_off_moves_what_it_finds(views, scene, season, dem, reference, truth, tmp_path):
    there = str(write_reference(tmp_path / "ref.tif", scene, season, GSD, shift=(6.0, -4.0)))
    first, second = (register(views, [path], dem, sigma=5.0) for path in (reference, there))
    moved = np.subtract(second.views[0].offset, first.views[0].offset)
    assert moved == pytest.approx([-6.0, 4.0], abs=0.2)
    assert second.control.bias[:2] == pytest.approx([5.0, 5.0])


def test_other_places_and_no_texture_are_refused(views, scene, season, dem, tmp_path):
    mirrored = Grid(season.origin, season.step, np.ascontiguousarray(season.values[:, ::-1]))
    plain = Grid(season.origin, season.step, np.full_like(season.values, 0.3))
    for name, grid in (("mirrored", mirrored), ("plain", plain)):
        path = str(write_reference(tmp_path / f"{name}.tif", scene, grid, GSD))
        found = register(views, [path], dem)
        assert found.control is None, name
        assert found.views[0].peak < PEAK - 1.0
        assert found.views[0].points == 0


def test_a_reference_that_does_not_reach_the_image_is_no_error(views, scene, season, dem, tmp_path):
    path = str(write_reference(tmp_path / "far.tif", scene, season, GSD, shift=(5000.0, 0.0)))
    found = register(views, [path], dem)
    assert found.control is None
    assert found.views[0].peak == 0.0


def test_of_several_files_each_shows_its_part(views, reference, dem, tmp_path):
    with rasterio.open(reference) as file:
        pixels, profile, place = file.read(1), file.profile, file.transform
    paths, half = [], pixels.shape[1] // 2
    for name, part, left in (("west", pixels[:, :half], 0), ("east", pixels[:, half:], half)):
        paths.append(str(tmp_path / f"{name}.tif"))
        profile.update(
            width=part.shape[1], transform=rasterio.Affine(GSD, 0, place.c + GSD * left, 0, -GSD, place.f)
        )
        with rasterio.open(paths[-1], "w", **profile) as file:
            file.write(part, 1)
    whole, parts = register(views, [reference], dem), register(views, paths, dem)
    assert parts.views[0].points > 0.6 * whole.views[0].points
    assert np.subtract(parts.views[0].offset, whole.views[0].offset) == pytest.approx([0, 0], abs=0.2)
    east = register(views, paths[1:], dem).control.points
    whole_east = whole.control.points.lonlatalt[:, 0].max()
    assert east.lonlatalt[:, 0].max() == pytest.approx(whole_east, abs=1e-3)
    assert east.lonlatalt[:, 0].min() > whole.control.points.lonlatalt[:, 0].min() + 1e-3


def test_a_raster_without_a_place_is_refused(views, dem):
    with pytest.raises(InputError, match="no place on the ground"):
        register(views, [views[0].path], dem)
    assert read_rpc(views[0].path) is not None
