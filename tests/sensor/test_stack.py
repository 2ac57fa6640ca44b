"""Many cameras at once give what each gives alone."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from barpc.base.geodesy import ecef_from_ground
from barpc.rpcio import read_rpc
from barpc.sensor.centers import camera_center, camera_centers
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.geometry import Several, sight_enu
from barpc.sensor.rpc import RPC, RpcStack, localize_stack
from barpc.sensor.sampler import GRID_NODES, Sample, image_grid
from barpc.simulate import simulate_block
from tests.sensor.test_rpc import VENDORS, box

FIELDS = "coeffs", "ground_offset", "ground_scale", "image_offset", "image_scale"


@pytest.fixture(scope="module")
def sensors():
    """RPCs on both sides of the antimeridian; one with a pole in its box; one that is no RPC."""
    views = [view.sensor for view in simulate_block(6, 0, num_checks=0, lon=179.99).views]
    bent = views[2].coeffs.copy()
    bent[1, 1] = 2.0
    views[2] = replace(views[2], coeffs=bent)
    views[4] = Corrected(views[4], Correction(np.full(3, 1e-5), np.zeros(3), np.array([4e6, 4e5, 5e6])))
    return views


@pytest.mark.few(2)
@pytest.mark.parametrize("reach", [1.0, 3.0])
@pytest.mark.parametrize("counts", [(5, 0, 40, 7, 3, 60), (0, 0, 0, 1, 0, 0), (1500, 1, 1, 0, 9000, 2)])
def test_ground_points_are_those_of_each_camera(sensors, counts, reach):
    rng, bounds = np.random.default_rng(1), np.cumsum([0, *counts])
    image, alt = (
        10_000 + reach * rng.uniform(-10_000, 10_000, (bounds[-1], 2)),
        rng.uniform(0, 900, bounds[-1]),
    )
    with np.errstate(all="ignore"):
        found = localize_stack(sensors, image, alt, bounds)
        parts = [slice(*ends) for ends in pairwise(bounds)]
        alone = [one.localize(image[part], alt[part]) for one, part in zip(sensors, parts, strict=True)]
    np.testing.assert_allclose(found, np.concatenate(alone), rtol=0, atol=2e-12)


def test_image_points_are_those_of_each_camera(sensors):
    """Of consecutive RPCs, on both sides of the antimeridian, one of them asked for nothing."""
    bounds, rng = np.array([0, 40, 40, 47]), np.random.default_rng(1)
    alone = [sensors[i].localize(rng.uniform(0, 20_000, (n, 2)), rng.uniform(0, 900, n))
             for i, n in zip((0, 1, 3), (40, 0, 7), strict=True)]  # fmt: skip
    stack = RpcStack([sensors[i] for i in (5, 0, 1, 3)])
    found = stack.image(np.concatenate(alone).T, slice(1, 4), bounds)
    expected = [sensors[i].project(points) for i, points in zip((0, 1, 3), alone, strict=True)]
    np.testing.assert_allclose(found.T, np.concatenate(expected), rtol=0, atol=1e-6)
    np.testing.assert_allclose(stack.project(np.concatenate(alone).T, slice(1, 4), bounds)[0], found, atol=1e-6)


@pytest.mark.parametrize("count", [7, 0, 5000])
def test_cameras_of_all_kinds_are_asked_as_each_alone(sensors, count):
    """RPCs with few points together, others, and with many points, one by one."""
    rng, bounds = np.random.default_rng(1), count * np.arange(len(sensors) + 1)
    image, alt = rng.uniform(0, 20_000, (bounds[-1], 2)), rng.uniform(0, 900, bounds[-1])
    stack, ground = RpcStack(sensors), localize_stack(sensors, image, alt, bounds)
    parts = [slice(*ends) for ends in pairwise(bounds)]
    alone = [one.project_jacobian(ground[part]) for one, part in zip(sensors, parts, strict=True)]
    seen, by_ground = (np.concatenate(values) for values in zip(*alone, strict=True))
    np.testing.assert_allclose(stack.seen(ground, bounds).T, seen, rtol=0, atol=1e-8)
    told = np.isfinite(seen)
    assert not count or told.mean() > 0.9
    np.testing.assert_allclose(seen[told], image[told], rtol=0, atol=1e-6)
    found = stack.seen_jacobian(ground, bounds)
    np.testing.assert_allclose(found[0].T, seen, rtol=0, atol=1e-8)
    np.testing.assert_allclose(np.moveaxis(found[1], -1, 0), by_ground, rtol=1e-9, atol=1e-9)


class Mute(RPC):
    """An RPC that localises nothing by itself."""

    localize = None


def test_a_camera_whose_points_are_certain_is_not_asked_alone(sensors):
    some, rng = [sensors[i] for i in (0, 1, 3)], np.random.default_rng(1)
    image, alt, bounds = rng.uniform(5_000, 15_000, (60, 2)), rng.uniform(200, 700, 60), np.array([0, 20, 40, 60])
    alone = [
        one.localize(image[part], alt[part]) for one, part in zip(some, map(slice, bounds, bounds[1:]), strict=False)
    ]
    mute = [Mute(*(getattr(one, name) for name in FIELDS)) for one in some]
    np.testing.assert_allclose(localize_stack(mute, image, alt, bounds), np.concatenate(alone), rtol=0, atol=2e-12)


@pytest.mark.parametrize("drifts", [(1, 1, 1), (0, 1, 1), (None, None, None)])
def test_cameras_behind_corrections_are_asked_as_each_alone(drifts):
    """One behind many corrections, or, where their drifts are of several degrees, each by itself; RPCs behind none;
    in any order."""
    rng, rpcs = np.random.default_rng(2), [view.sensor for view in simulate_block(3, 0, num_checks=0).views]
    center = ecef_from_ground(rpcs[0].ground_offset) * 1.1
    some = []
    for k, (rpc, degree) in enumerate(zip(rpcs, drifts, strict=True)):
        if degree is None:
            some.append(rpc)
            continue
        turn, move, drift = (rng.normal(0, size, shape) for size, shape in ((2e-5, 3), (3.0, 3), (1e-5, (degree, 3))))
        some.append(Corrected(rpc, Correction(turn, move, center + 9.0 * k, drift, 9e3, 8e3, 1.0 + 1e-6 * k)))
    view = rng.integers(0, 3, 60)
    image, alt = rng.uniform(0, 20_000, (60, 2)), rng.uniform(0, 600, 60)
    many, alone = Several(some, view), [some[v] for v in view]
    ground = many.localize(image, alt)
    np.testing.assert_allclose(ground, [s.localize(*at) for s, *at in zip(alone, image, alt, strict=True)], atol=1e-10)
    np.testing.assert_allclose(many.project(ground), image, rtol=0, atol=1e-5)
    np.testing.assert_allclose(many.project(ground, image), image, rtol=0, atol=1e-5)
    seen, jacobian = many.project_jacobian(ground)
    expected = [one.project_jacobian(point) for one, point in zip(alone, ground, strict=True)]
    np.testing.assert_allclose(seen, [one for one, _ in expected], rtol=0, atol=1e-7)
    np.testing.assert_allclose(jacobian, [one for _, one in expected], rtol=1e-8, atol=1e-9)
    sights = [sight_enu(one, point) for one, point in zip(alone, ground, strict=True)]
    np.testing.assert_allclose(sight_enu(many, ground), sights, rtol=0, atol=1e-9)
    asked = many.each(lambda sensor, points: points + some.index(sensor), ground)
    np.testing.assert_array_equal(asked, ground + view[:, None])
    sizes = [(20_000, 19_000), (9_000, 8_000), (5_000, 20_000)]
    cameras = [(sensor, size, (0.0, 0.01 * size[0])) for sensor, size in zip(some, sizes, strict=True)]
    for (sensor, size, alts), found in zip(cameras, Sample.grids(cameras), strict=True):
        at, level = image_grid(size, alts, GRID_NODES)
        np.testing.assert_allclose(found.ground, sensor.localize(at, level), rtol=0, atol=1e-5)
        np.testing.assert_allclose(found.image, at, rtol=0, atol=1e-5)


def test_nothing_is_asked_of_no_camera():
    assert localize_stack([], np.zeros((0, 2)), np.zeros(0), np.zeros(1, dtype=np.int64)).shape == (0, 3)
    assert camera_centers([], [], []) == []


def test_centres_are_those_of_each_camera(sensors):
    some = [sensors[i] for i in (0, 1, 4)]
    found = camera_centers(some, [(20_000, 19_000)] * 3, [(0.0, 1000.0)] * 3)
    for sensor, one in zip(some, found, strict=True):
        alone = camera_center(sensor, (20_000, 19_000), (0.0, 1000.0))
        np.testing.assert_allclose(one.ecef, alone.ecef, rtol=0, atol=1e-3)
        assert one.method == alone.method == "line"


def test_vendors_cameras_are_met_far_from_their_boxes(shared_data):
    rpcs = [read_rpc(shared_data / file) for file in VENDORS]
    image, alt = map(np.concatenate, zip(*(box(rpc, 3.0, 200) for rpc in rpcs), strict=True))
    with np.errstate(all="ignore"):
        found = localize_stack(rpcs, image, alt, 200 * np.arange(len(rpcs) + 1))
        alone = [rpc.localize(image[200 * n :][:200], alt[200 * n :][:200]) for n, rpc in enumerate(rpcs)]
    np.testing.assert_allclose(found, np.concatenate(alone), rtol=0, atol=1e-12)
