"""Rendering: every pixel shows what its line of sight meets, where the exact camera says, to 0.02 px."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.simulate import Look, fly, looks
from tests.lanes import rest_slow
from tests.scenes.render import Radiometry, expose, render
from tests.scenes.terrain import Grid, Plane, Ray, make_terrain
from tests.scenes.texture import Date, Surface, make_surfaces

SIZE = (240, 200)
PLANE = Plane(5.4, 43.3)
TARGET = np.array([5.4, 43.3, 230.0])


@pytest.fixture(scope="module")
def surface() -> Surface:
    rng = np.random.default_rng(5)
    terrain = make_terrain(rng, PLANE, (-110.0, -110.0, 110.0, 110.0), 230.0, 30.0, 25.0)
    return make_surfaces(rng, terrain, 0.25, [Date()])[0]


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(0, id="aft"),
        pytest.param(1, id="nadir", marks=pytest.mark.slow),
        pytest.param(2, id="fore", marks=pytest.mark.slow),
    ],
)
def sensor(request):
    return fly(TARGET, looks(3, 0.0)[request.param], SIZE, 0.5)


def cast(sensor, terrain, image, step=0.02):
    """First altitudes (N,) at which lines of sight are in something solid: brute force, in steps of 2 cm."""
    low, high = terrain.alt_range()
    found = np.full(len(image), np.nan)
    for alt in np.arange(high, low - step, -step):
        todo = np.flatnonzero(np.isnan(found))
        x, y = PLANE.xy(sensor.localize(image[todo], np.array(alt))).T
        found[todo[terrain.highest(x, y) >= alt]] = alt
    return found


@pytest.mark.nightly
@pytest.mark.parametrize("count", [100, pytest.param(300, marks=pytest.mark.nightly)])
def test_altitudes_are_those_of_brute_force_ray_casting(sensor, surface, count):
    """Where the tracer and 2 cm steps along the exact line of sight differ, it is on an edge of a building."""
    rng = np.random.default_rng(0)
    image = np.stack([rng.integers(0, n, count) for n in SIZE], axis=1).astype(float)
    rendered = render(sensor, SIZE, surface, samples=1).altitude[image[:, 1].astype(int), image[:, 0].astype(int)]
    expected = cast(sensor, surface.terrain, image)
    off = np.abs(rendered - expected)
    assert np.mean(off < 0.025) > 0.99
    assert np.median(off) < 0.0125


def tilted(sensor, terrain, image, alt):
    """How far (N,) a line of sight is from the surface at altitudes alt (N,), as pixels of parallax."""
    x, y = PLANE.xy(sensor.localize(image, alt)).T
    _, jacobian = sensor.project_jacobian(sensor.localize(image, alt))
    return np.abs(terrain.relief(x, y) - alt) * np.linalg.norm(jacobian[..., 2], axis=-1)


def test_relief_is_met_to_a_thousandth_of_a_pixel(sensor, surface):
    """At the altitude that was rendered, the exact line of sight is on the ground, to 1e-3 px of parallax."""
    bare = replace(surface, terrain=replace(surface.terrain, buildings=_none(surface.terrain.buildings)))
    altitude = render(sensor, SIZE, bare, samples=1).altitude.astype(float)
    cols, rows = np.meshgrid(np.arange(0, SIZE[0], 7.0), np.arange(0, SIZE[1], 7.0))
    image = np.stack([cols.ravel(), rows.ravel()], axis=1)
    alt = altitude[rows.astype(int), cols.astype(int)].ravel()
    assert tilted(sensor, bare.terrain, image, alt).max() < 1e-3


def _none(buildings):
    keep = slice(0, 0)
    names = ("center", "half", "angle", "top", "foot")
    return replace(buildings, **{name: getattr(buildings, name)[keep] for name in names})


def _spots(terrain, seed):
    """Ground with bright Gaussian spots of 1 m at known places, 16 m apart, and their x, y, alt."""
    rng = np.random.default_rng(seed)
    step = 0.125
    axis = np.arange(-110.0, 110.0, step)
    places = np.stack(np.meshgrid(np.arange(-32.0, 40.0, 16.0), np.arange(-32.0, 40.0, 16.0)), -1).reshape(-1, 2)
    places = places + rng.uniform(-2.0, 2.0, places.shape)
    values = np.zeros((len(axis), len(axis)))
    for px, py in places:
        values += np.exp(-0.5 * (axis[:, None] - py) ** 2) * np.exp(-0.5 * (axis - px) ** 2)
    alt = terrain.relief(*places.T).astype(float)
    grid = Grid(np.array([-110.0, -110.0]), step, values.astype(np.float32))
    return grid, np.concatenate([places, alt[:, None]], axis=1)


@pytest.mark.parametrize("seed", rest_slow([1, 2]))
def test_spots_stand_where_the_exact_camera_puts_them_within_a_hundredth_of_a_pixel(sensor, surface, seed):
    """Centroids of rendered spots against the projection of their centres: the rendering's own error."""
    flat = replace(surface.terrain.relief, values=np.full_like(surface.terrain.relief.values, 231.5))
    terrain = replace(surface.terrain, relief=flat, buildings=_none(surface.terrain.buildings))
    spots, places = _spots(terrain, seed)
    image = render(sensor, SIZE, replace(surface, terrain=terrain, ground=spots)).brightness.astype(float)
    expected = sensor.project(PLANE.ground(places))
    found = np.array([_centroid(image, place) for place in expected])
    assert np.abs(found - expected).max() < 0.01
    assert np.abs((found - expected).mean(axis=0)).max() < 0.002


def _centroid(image, place, half=11):
    col, row = np.rint(place).astype(int)
    part = image[row - half : row + half + 1, col - half : col + half + 1]
    offset = np.arange(-half, half + 1)
    return np.array([col + (part.sum(0) @ offset) / part.sum(), row + (part.sum(1) @ offset) / part.sum()])


def test_a_line_of_sight_into_the_sky_is_refused(surface):
    sideways = fly(TARGET, Look(25.0, 90.0), (64, 64), 0.5)
    upside_down = replace(sideways, mount=sideways.mount @ np.diag([1.0, -1.0, -1.0]))
    with pytest.raises(InputError, match="does not see the ground"):
        render(upside_down, (64, 64), surface)


def test_walls_show_on_the_side_of_the_camera_and_hide_the_ground_behind(surface):
    """A camera in the east sees east walls; the ground just west of a building is hidden."""
    terrain = surface.terrain
    east = fly(TARGET, Look(25.0, 90.0), SIZE, 0.5)
    altitude = render(east, SIZE, surface, samples=1).altitude
    tall = int(
        np.argmax((terrain.buildings.top - terrain.buildings.foot) * (np.abs(terrain.buildings.center) < 30).all(1))
    )
    u = np.linspace(-1.2, 1.2, 481) * np.hypot(*terrain.buildings.half[tall])
    x, y = terrain.buildings.center[tall, 0] + u, np.full(481, terrain.buildings.center[tall, 1])
    off_roof = terrain.highest(x, y) < terrain.buildings.top[tall]
    ground = PLANE.ground(np.stack([x, y, terrain.relief(x, y).astype(float)], axis=1))
    col, row = np.rint(east.project(ground)).astype(int).T
    hidden = altitude[row, col] > ground[:, 2] + 1.0
    assert hidden[off_roof & (u < 0)][-8:].all()
    assert not hidden[off_roof & (u > 0)][:8].any()


def test_shadows_lie_away_from_the_sun(surface):
    buildings = surface.terrain.buildings
    low_sun = make_surfaces(np.random.default_rng(0), surface.terrain, 0.5, [Date(90.0, 30.0)])[0]
    no_sun = make_surfaces(
        np.random.default_rng(0),
        replace(surface.terrain, buildings=_none(buildings)),
        0.5,
        [Date(90.0, 30.0)],
    )[0]
    ratio = low_sun.ground.values / no_sun.ground.values
    x, y = low_sun.ground.axes()
    for i in np.flatnonzero((np.abs(buildings.center) < 60).all(axis=1)):
        reach = np.hypot(*buildings.half[i]) + 0.5
        west = ratio[np.searchsorted(y, buildings.center[i, 1]), np.searchsorted(x, buildings.center[i, 0] - reach)]
        assert west < 0.9


def test_numbers_keep_zero_free_saturate_and_carry_the_noise_that_was_asked_for():
    rng = np.random.default_rng(0)
    grey = np.full((300, 300), 0.25, dtype=np.float32)
    plain = expose(grey, Radiometry(blur=0.0, gain=2000.0, offset=60.0, snr=0.0), rng)
    assert (plain == 560).all()
    noisy = expose(grey, Radiometry(blur=0.0, gain=2000.0, offset=60.0, snr=100.0), rng).astype(float)
    assert noisy.mean() == pytest.approx(560.0, abs=0.2)
    assert noisy.std() == pytest.approx(np.sqrt(0.25) * 20.0, rel=0.02)
    assert (expose(10 * grey, Radiometry(saturation=1000), rng) == 1000).all()
    assert expose(0 * grey, Radiometry(offset=0.0), rng).min() == 1


def test_clouds_hide_the_part_that_was_asked_for():
    rng = np.random.default_rng(0)
    grey = np.full((400, 400), 0.2, dtype=np.float32)
    numbers = expose(grey, Radiometry(snr=0.0, clouds=0.3), rng)
    clear = numbers == expose(grey, Radiometry(snr=0.0), rng)
    assert 0.5 < clear.mean() < 0.75
    assert (numbers > 1000).mean() == pytest.approx(0.3, abs=0.1)


def test_relief_is_never_too_steep_to_be_seen():
    terrain = make_terrain(np.random.default_rng(1), PLANE, (-50.0, -50.0, 50.0, 50.0), 0.0, 1000.0, 0.0)
    by_y, by_x = np.gradient(terrain.relief.values, terrain.relief.step)
    assert np.hypot(by_x, by_y).max() < 0.81
    assert len(terrain.buildings) == 0


def test_a_line_through_a_box_enters_and_leaves_where_it_must():
    terrain = make_terrain(np.random.default_rng(1), PLANE, (-50.0, -50.0, 50.0, 50.0), 0.0, 1.0, 20.0)
    box = replace(
        terrain.buildings,
        center=np.zeros((1, 2)),
        half=np.array([[5.0, 3.0]]),
        angle=np.zeros(1),
        top=np.array([10.0]),
        foot=np.array([-5.0]),
    )
    ray = Ray(
        np.array([0.0, 8.0, 0.0, 0.0]),
        np.zeros(4),
        np.array([0.0, -1.0, 0.0, 0.0]),
        np.array([0.0, 0, 1, 9]),
        0.0,
    )
    with np.errstate(invalid="ignore"):
        low, high, wall = box.inside(0, ray)
    assert np.allclose(high, [10.0, 10.0, 3.0, 1 / 3])
    assert np.allclose(low[1:], [3.0, -3.0, -1 / 3])
    assert wall.tolist() == [0, 0, 2, 2]
