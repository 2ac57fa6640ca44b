"""Control does not deform an image: what it asks for beyond what tie points show is refused, and said."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rasterio import Affine

from barpc import adjust, open_camera
from barpc.ba import Adjustment, AdjustOptions, adjust_tracks
from barpc.ba.constraints.block import join, make_problem
from barpc.ba.constraints.shape import MOST_SIGMAS, shape_change
from barpc.base.geodesy import Array, metres_per_unit
from barpc.rasters.dem import localize_on_terrain
from barpc.report.quality_checks import deformation_reasons, dem_reasons
from barpc.scene import GroundPoints, Terrain, Tracks, View
from barpc.sensor.corrected import Corrected
from barpc.simulate import simulate_block
from tests.costs import once
from tests.geotiffs import write_image

LON, LAT, NOISE, SIZE = 5.4, 43.3, 0.05, (1200, 1200)
UNIT = metres_per_unit(np.array([[LON, LAT, 200.0]]))[0, :2]


def hills(seed: int, size: float = 40.0, level: float = 200.0) -> Terrain:
    """Waves of 0.3 to 1.2 km, `size` [m] RMS, about a level [m]."""
    rng = np.random.default_rng(seed)
    number, (angle, phase) = 2 * np.pi / rng.uniform(300.0, 1200.0, 12), rng.uniform(0, 2 * np.pi, (2, 12))

    def at(lon: Array, lat: Array) -> Array:
        x, y = (np.asarray(lon) - LON) * UNIT[0], (np.asarray(lat) - LAT) * UNIT[1]
        along = np.cos(angle) * x[..., None] + np.sin(angle) * y[..., None]
        return np.asarray(level + size * np.sin(number * along + phase).sum(axis=-1) / np.sqrt(6.0))

    return at


SAMPLES = Path(__file__).parents[2] / "data_samples"
GROUND = hills(1)
DEMS: dict[str, Terrain] = {
    "right": GROUND,
    "20 m above": lambda lon, lat: GROUND(lon, lat) + 20.0,
    "flat": lambda lon, lat: 200.0 + 0.0 * np.asarray(lon),
    "sea level": lambda lon, lat: 0.0 * np.asarray(lon),
    "tilted plane": lambda lon, lat: 200.0 + (np.asarray(lon) - LON) * UNIT[0] * 0.2,
    "another place": hills(2),
    "bent": lambda lon, lat: GROUND(lon, lat) + 40.0 * ((np.asarray(lat) - LAT) * UNIT[1] / 300.0) ** 2,
}


Moved = Callable[[Array, Array, Array], tuple[Array | float, ...]]
GCPS: dict[str, Moved] = {
    "right": lambda east, north, alt: (east, north, alt),
    "shifted": lambda east, north, alt: (east + 50.0, north, alt),
    "raised": lambda east, north, alt: (east, north, alt + 100.0),
    "flat": lambda east, north, _alt: (east, north, 200.0),
    "tilted": lambda east, north, alt: (east, north, alt + 0.2 * east),
    "bent": lambda east, north, alt: (east, north, alt + 100.0 * (north / 300.0) ** 2),
    "turned": lambda east, north, alt: (east - 0.05 * north, north + 0.05 * east, alt),
}
FALSE = "flat", "sea level", "tilted plane", "another place"
"""DEMs that differ from the ground by more than three times their stated standard deviation, place by place."""


def seen_by(num_views: int, count: int) -> tuple[tuple[View, ...], Array, Array]:
    """Views, points (n, 3) on the hills, and where the true cameras see them (N, n, 2)."""
    block, rng = simulate_block(num_views, 10, seed=4, size=SIZE), np.random.default_rng(6)
    sensors = [Corrected(v.sensor, c) for v, c in zip(block.views, block.truth.corrections, strict=True)]
    image = rng.uniform(0.02, 0.98, (count, 2)) * SIZE
    ground = localize_on_terrain(sensors[0], image, GROUND, (0.0, 500.0))
    seen = np.stack([sensor.project(ground) for sensor in sensors])
    inside = ((seen > 0) & (seen < np.array(SIZE) - 1.0)).all(axis=(0, 2))
    return block.views, ground[inside], seen[:, inside] + rng.normal(0, NOISE, (num_views, int(inside.sum()), 2))


@once
def ties(num_views: int) -> tuple[tuple[View, ...], Tracks]:
    """Views, and tie points on the hills."""
    views, _, seen = seen_by(num_views, 700)
    view, point = np.indices(seen.shape[:2])
    return views, Tracks(view.ravel(), point.ravel(), seen.reshape(-1, 2), np.full(view.size, NOISE))


def gcps(num_views: int, count: int, moved: Moved) -> GroundPoints:
    """GCPs that are said to be where `moved` puts them: from metres east, north, and altitude."""
    _, ground, seen = seen_by(num_views, count)
    east, north = ((ground[:, :2] - [LON, LAT]) * UNIT).T
    place = np.column_stack(np.broadcast_arrays(*moved(east, north, ground[:, 2])))
    place[:, :2] = [LON, LAT] + place[:, :2] / UNIT
    view, point = np.indices(seen.shape[:2])
    names, sigma = tuple(map(str, range(len(ground)))), np.full((len(ground), 3), 0.3)
    return GroundPoints(names, place, sigma, point.ravel(), view.ravel(), seen.reshape(-1, 2), np.full(view.size, 0.1))


def adjusted(num_views: int, **control: Any) -> tuple[Adjustment, Array]:
    """The adjustment beside control, and the deformations of its images in standard deviations."""
    views, tracks = ties(num_views)
    found = adjust_tracks(views, tracks, AdjustOptions(), **control)
    unknowns, options = found.cameras.unknowns, found.options
    problem = make_problem(join(views, tracks, None, options), options, unknowns.center, None, unknowns.drift)
    sigmas, _ = shape_change(problem, found.params[:, : unknowns.in_waves.start], views)
    return found, sigmas


@pytest.mark.landing(3)
@pytest.mark.slow
@pytest.mark.parametrize("dem", [None, *DEMS])
@pytest.mark.parametrize("num_views", [2, 3])
def test_no_dem_deforms_an_image_and_a_false_one_is_named(num_views: int, dem: str | None) -> None:
    found, sigmas = adjusted(num_views, dem=None if dem is None else DEMS[dem])
    assert (sigmas < MOST_SIGMAS).all()
    assert bool([*deformation_reasons(found), *dem_reasons(found)]) == (dem in FALSE)
    assert (found.deformed is None) or dem in FALSE


@pytest.mark.landing(3)
@pytest.mark.slow
@pytest.mark.parametrize("num_views", [2, 3])
@pytest.mark.parametrize("count", [60, 12, 6])
@pytest.mark.parametrize("kind", GCPS)
def test_no_gcps_deform_an_image_and_those_of_another_shape_are_not_used(num_views: int, count: int, kind: str) -> None:
    """Points of a wrong datum move the scene; which of the others agree is not for tie points to bend to."""
    found, sigmas = adjusted(num_views, gcps=gcps(num_views, count, GCPS[kind]))
    assert (sigmas < MOST_SIGMAS).all()
    assert found.deformed is None
    whole = kind in ("right", "shifted", "raised")
    assert found.control.used.all() if whole else not found.control.used.all(), kind


@pytest.mark.nightly
def test_a_drift_that_heights_alone_ask_for_is_held_to_what_tie_points_show(tmp_path) -> None:
    """A pair sees nothing of a drift about its base: a flat DEM would deform images of hills by 130 px, 229 sigma."""
    pair, dem = sorted(SAMPLES.glob("view_0[01].tif")), tmp_path / "flat.tif"
    lon, lat = open_camera(pair[0]).model.localize(np.array([[500.0, 500.0]]), np.array([130.0]))[0, :2]
    place = Affine(5e-4, 0.0, lon - 0.015, 0.0, -5e-4, lat + 0.015)
    write_image(dem, np.full((60, 60), 130.0, dtype=np.float32), transform=place, crs="EPSG:4326")
    found = adjust(pair, dem=dem, geoid="none", out_dir=tmp_path / "out").adjustment
    assert found.deformed.control == ("dem",)
    assert found.deformed.sigmas > 100.0
    (said,) = deformation_reasons(found)
    assert "To follow the DEM, view_0" in said
    for path, sensor in zip(pair, found.sensors, strict=True):
        camera = open_camera(path)
        corners = np.array([[x, y] for x in (0.0, camera.size[0]) for y in (0.0, camera.size[1])])
        moved = sensor.project(camera.model.localize(corners, np.full(4, 150.0))) - corners
        assert np.abs(moved - moved.mean(axis=0)).max() < 1.0
