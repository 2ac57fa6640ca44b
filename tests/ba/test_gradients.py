"""Every derivative of the adjustment against central differences.

A right derivative proves nothing about the value that it belongs to: `test_recovery` does that.
"""

from __future__ import annotations

from inspect import isfunction
from typing import get_args, get_type_hints

import numpy as np
import pytest

from barpc.ba.constraints import ground as on_points
from barpc.ba.constraints.ground import flat_heights, ground_control, reference_control, staying, terrain_heights
from barpc.ba.parameters.additional_parameters import AdditionalParameters
from barpc.ba.parameters.priors import CameraPrior, JointPrior, PointPrior
from barpc.ba.parameters.projected import Cameras
from barpc.ba.parameters.unknowns import make_unknowns
from barpc.ba.robust.weights import geman_mcclure
from barpc.base.geodesy import ecef_from_ground, ground_from_ecef
from barpc.base.options import AUTO, Model
from barpc.scene import GroundPoints, Reference, View
from barpc.sensor.corrected import Corrected
from barpc.simulate import simulate_block

MODELS = [(model, 0) for model in get_args(Model) if model != AUTO]
MODELS += [("rotation+translation", 1), ("rotation", 2)]


@pytest.fixture(scope="module")
def views() -> tuple[View, ...]:
    """Two RPCs, and a third sensor that is none."""
    block = simulate_block(3, 10, seed=5)
    odd = block.views[2]
    other = Corrected(odd.sensor, block.truth.corrections[2])
    return (*block.views[:2], View(odd.name, "", odd.size, other, odd.alt_range))


@pytest.fixture(scope="module")
def ecef(views: tuple[View, ...]) -> np.ndarray:
    """Points (3, 30), ten a view."""
    rng = np.random.default_rng(8)
    image = rng.uniform(2000, 18000, (10, 2))
    ground = [view.sensor.localize(image, rng.uniform(0, 500, 10)) for view in views]
    return ecef_from_ground(np.concatenate(ground)).T


def _setup(views, model, drift, ecef, scale=5.0):
    """Cameras that see ten points each, where their corrected sensors see them."""
    edges = np.array([[5000.0, 12000.0], [9000.0, np.inf], [np.inf, np.inf]])
    periods = np.array([[2000.0, 5000.0], [np.inf, np.inf], [7000.0, np.inf]])
    waves = AdditionalParameters(9, edges, np.zeros((3, 0, 5)), periods) if drift == 2 or model == "affine" else None
    unknowns, bounds = make_unknowns(views, model, drift, waves=waves), np.array([0, 10, 20, 30])
    assert unknowns.size
    params = np.random.default_rng(3).normal(0, scale, (3, unknowns.size))
    params[:, unknowns.in_waves] *= 0.05
    if waves is not None:  # a drift is not at the row that a swing moves to: 1e-3 px a pixel
        params[:, unknowns.in_waves][:, waves.kinds[3]] *= 0.1
    ground = ground_from_ecef(ecef.T).reshape(3, 10, 3)
    sensors = unknowns.corrected(params, views)
    seen = np.concatenate([sensor.project(part) for sensor, part in zip(sensors, ground, strict=True)]).T
    return Cameras(views, unknowns, seen), params, bounds


@pytest.mark.few(2)
@pytest.mark.parametrize(("model", "drift"), MODELS)
def test_tie_observations_have_the_derivatives_of_central_differences(views, ecef, model, drift):
    cameras, params, bounds = _setup(views, model, drift, ecef)
    found = cameras.project(params, ecef, bounds)
    for j in range(params.shape[1]):
        step = np.zeros_like(params)
        step[:, j] = 0.5
        high, low = (cameras.project(params + s * step, ecef, bounds, "image").image for s in (1, -1))
        np.testing.assert_allclose(found.by_unknown[:, j], high - low, rtol=0, atol=2e-6)
    for axis in range(3):
        step = np.zeros((3, 1))
        step[axis] = 0.5
        high, low = (cameras.project(params, ecef + s * step, bounds, "image").image for s in (1, -1))
        np.testing.assert_allclose(found.by_point[:, axis], high - low, rtol=0, atol=2e-6)


@pytest.mark.few(4)
@pytest.mark.parametrize(("model", "drift"), MODELS)
def test_views_together_project_like_each_corrected_sensor_alone(views, ecef, model, drift):
    cameras, params, bounds = _setup(views, model, drift, ecef)
    image = cameras.project(params, ecef, bounds).image
    sensors = cameras.unknowns.corrected(params, views)
    for v, sensor in enumerate(sensors):
        part = slice(bounds[v], bounds[v + 1])
        alone = sensor.project(ground_from_ecef(ecef[:, part].T))
        near = 2e-7 if cameras.unknowns.waves is None else 1e-3  # a drift at the row seen, or a spline aside
        np.testing.assert_allclose(image[:, part].T, alone, rtol=0, atol=near)


@pytest.mark.parametrize("drift", [1, 2])
def test_a_drifting_correction_is_a_sensor_with_right_derivatives_and_localisation(views, ecef, drift):
    cameras, params, _ = _setup(views, "rotation+translation", drift, ecef)
    sensor = cameras.unknowns.corrected(params, views)[0]
    image = np.random.default_rng(1).uniform(1000, 19000, (20, 2))
    ground = sensor.localize(image, np.full(20, 300.0))
    np.testing.assert_allclose(sensor.project(ground), image, rtol=0, atol=1e-7)
    _, jacobian = sensor.project_jacobian(ground)
    for axis, step in enumerate((1e-5, 1e-5, 1.0)):
        offset = np.eye(3)[axis] * step
        numeric = (sensor.project(ground + offset) - sensor.project(ground - offset)) / (2 * step)
        np.testing.assert_allclose(jacobian[..., axis] * step, numeric * step, rtol=0, atol=1e-6)


def _point_priors():
    points = ecef_from_ground([[5.4, 43.2, 200.0], [5.5, 43.3, 250.0], [5.6, 43.4, 300.0]])
    index = np.array([0, 2])
    none = np.zeros(0, dtype=int)
    gcps = GroundPoints(
        ("a", "b"), ground_from_ecef(points[index]), [[0.2, 0.3, 0.5]] * 2, none, none, np.zeros((0, 2)), np.zeros(0)
    )
    return points, {
        "ground_control": ground_control(gcps, index),
        "reference_control": reference_control(Reference(gcps, np.array([0.4, 0.7, 2.0]), np.zeros((1, 2))), index),
        "terrain_heights": terrain_heights(
            points, index, lambda lon, lat: 100.0 + 800.0 * (lon - 5.4) + 300.0 * (lat - 43), 3.0, 0.0
        ),
        "flat_heights": flat_heights(points, index, 210.0, 20.0, 0.0),
        "staying": staying(points + [30.0, 40.0, 50.0], index),
        "with a common error": flat_heights(points, index, 210.0, 20.0, 7.0),
    }


def test_heights_with_a_common_error_cost_what_their_joint_normal_distribution_says():
    points, blocks = _point_priors()
    block = blocks["with a common error"]
    ground = ground_from_ecef(points[[0, 2]])
    east_north = np.array([-1.0, 1.0])  # two points: each at the edge of both slopes, up to the curve of the earth
    design = np.column_stack([np.ones(2), east_north, east_north])
    covariance = 20.0**2 * np.eye(2) + 7.0**2 * design @ design.T
    offset = ground[:, 2] - 210.0
    assert block.cost(points) == pytest.approx(offset @ np.linalg.solve(covariance, offset), rel=1e-3)
    for axis in range(3):  # the gradient of half the cost is rows^T residual: the common errors are the best ones
        for n, p in enumerate([0, 2]):
            step = np.zeros_like(points)
            step[p, axis] = 0.5
            numeric = (block.cost(points + step) - block.cost(points - step)) / 2
            assert block.jacobian()[n, :, axis] @ block.residual(points)[n] == pytest.approx(numeric, abs=1e-9)


BLOCKS = [
    name
    for name, make in vars(on_points).items()
    if isfunction(make) and name[0] != "_" and get_type_hints(make).get("return") is PointPrior
]
"""What makes a block of priors on points: each is tried, and stands in `_point_priors` by its name."""


@pytest.mark.parametrize("name", BLOCKS)
def test_priors_on_points_have_the_derivatives_of_central_differences(name):
    points, blocks = _point_priors()
    block = blocks[name]
    for axis in range(3):
        step = np.zeros_like(points)
        step[:, axis] = 1.0
        numeric = (block.apart(points + step) - block.apart(points - step)) / 2
        np.testing.assert_allclose(block.jacobian()[..., axis], numeric, rtol=0, atol=1e-7)
        slope = (block.cost(points + step) - block.cost(points - step)) / 4  # common errors are the best ones
        wanted = (block.jacobian()[..., axis] * block.residual(points)).sum()
        assert slope == pytest.approx(wanted, rel=1e-6, abs=1e-6)


def test_priors_on_cameras_have_the_derivatives_of_central_differences():
    rng = np.random.default_rng(0)
    params = rng.normal(size=(3, 6))
    prior = CameraPrior(rng.normal(size=(3, 6)), rng.uniform(1, 5, (3, 6)))
    root, taken, at = rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), rng.normal(size=(3, 6))
    joint = JointPrior(np.array([2, 7, 11]), rng.normal(size=3), root.T @ root)
    joint = joint.without(taken.T @ taken, rng.normal(size=3), at)
    for n in range(params.size):
        step = np.zeros(params.size)
        step[n] = 0.5
        step = step.reshape(params.shape)
        numeric = prior.residual(params + step) - prior.residual(params - step)
        np.testing.assert_allclose(numeric.ravel()[n], prior.whitened(np.ones_like(prior.sigma)).ravel()[n], atol=1e-12)
        numeric = joint.cost(params + step) - joint.cost(params - step)
        np.testing.assert_allclose(numeric, 2.0 * joint.gradient(params)[joint.index == n].sum(), atol=1e-12)


def test_what_is_taken_off_a_joint_prior_is_the_cost_of_what_was_observed_there() -> None:
    """Of linear observations A p = b known before, at any point where their gradient was taken: but for a constant."""
    rng = np.random.default_rng(1)
    root, a, b = rng.normal(size=(5, 3)), rng.normal(size=(4, 3)), rng.normal(size=4)
    joint = JointPrior(np.arange(3), rng.normal(size=3), root.T @ root)
    for _ in range(3):
        at = rng.normal(size=(1, 3))
        left = joint.without(a.T @ a, a.T @ (a @ at[0] - b), at)
        rest = [left.cost(p) - joint.cost(p) + ((a @ p[0] - b) ** 2).sum() for p in rng.normal(size=(4, 1, 3))]
        np.testing.assert_allclose(rest, rest[0], atol=1e-10)


def test_the_loss_has_the_derivative_of_central_differences_and_starts_as_squares():
    loss = geman_mcclure
    s = np.geomspace(1e-3, 1e3, 60)
    s = s[np.abs(s - 1) > 1e-3]
    step = 1e-5 * s
    numeric = (loss(s + step)[0] - loss(s - step)[0]) / (2 * step)
    np.testing.assert_allclose(loss(s)[1], numeric, rtol=1e-6, atol=1e-12)
    value, slope = loss(np.array([1e-12]))
    np.testing.assert_allclose(value, 1e-12, rtol=1e-3)
    np.testing.assert_allclose(slope, 1.0, rtol=1e-3)
