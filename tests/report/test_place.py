"""How well a camera tells where a point on the ground is: against cameras drawn at random."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks
from barpc.ba.interior import Calibration, CommonErrors
from barpc.base.geodesy import ecef_from_ground, metres_per_unit
from barpc.report import Run
from barpc.report.measures.views import ce90, measure_views, moved_in_space, stated_ce90
from barpc.sensor.pushbroom import Pushbroom
from barpc.sensor.rpc import RPC
from barpc.simulate import simulate_block

MODELS = ("rotation+translation", "rotation", "translation")


@pytest.mark.parametrize("model", MODELS)
def test_the_ellipse_and_the_shift_are_what_each_unknown_does(block_run, model):
    """Against differences of the whole camera, one unknown after the other, under a covariance of any shape."""
    sensor, view = block_run.run.adjustment.sensors[2], block_run.run.views[2]
    pixel, alt = (np.array(view.size) - 1) / 2, np.array(block_run.run.altitude)
    middle = sensor.localize(pixel, alt)
    distance = np.linalg.norm(ecef_from_ground(middle) - sensor.correction.center)
    by_ground, by_image = [], []
    for name in model.split("+"):
        for step in np.eye(3) / (distance if name == "rotation" else 1.0):
            ahead, behind = (
                replace(
                    sensor,
                    correction=replace(sensor.correction, **{name: getattr(sensor.correction, name) + sign * step}),
                )
                for sign in (0.5, -0.5)
            )
            off = ahead.localize(pixel, alt) - behind.localize(pixel, alt)
            by_ground.append((off * metres_per_unit(middle))[:2])
            by_image.append(ahead.project(middle) - behind.project(middle))
    root = np.random.default_rng(4).normal(size=(6, 6))[: len(by_ground)] * [1.0, 0.2, 0.5, 2.0, 0.1, 0.7]
    covariance = np.full((9, 9), 77.0)  # a drift's rows stand behind, and do not count in the middle row
    covariance[: len(root), : len(root)] = root @ root.T
    shift, sigma, found = moved_in_space(sensor, covariance, model, middle)
    in_image = np.array(by_image).T @ root
    assert sigma == pytest.approx(np.sqrt((in_image**2).sum(axis=1)), rel=1e-4)
    assert shift == pytest.approx(pixel - sensor.sensor.project(middle), abs=1e-5)
    # an error that images have in common moves the unknowns, and the image besides: what is left of it counts
    response = root @ np.random.default_rng(5).normal(0.0, 0.3, (6, 2))
    beside = np.random.default_rng(6).normal(size=(2, 2)) * in_image.std()
    padded = np.vstack([response, np.ones((3, 2))])
    left = np.array(by_image).T @ response - beside
    alone = np.array(by_image).T @ (root @ root.T - response @ response.T) @ np.array(by_image)
    _, shared, _ = moved_in_space(sensor, covariance, model, middle, None, (padded, beside))
    assert shared**2 == pytest.approx(np.diag(alone + left @ left.T), rel=5e-3)
    values, axes = np.linalg.eigh(np.array(by_ground).T @ root @ root.T @ np.array(by_ground))
    assert [found.minor_m, found.major_m] == pytest.approx(np.sqrt(values), rel=2e-3)
    azimuth = np.degrees(np.arctan2(*axes[:, 1])) % 180.0
    assert abs((found.azimuth_deg - azimuth + 90.0) % 180.0 - 90.0) < 0.2
    assert 0.0 <= found.azimuth_deg < 180.0
    assert found.ce90_m == ce90(found.major_m, found.minor_m)


@pytest.mark.nightly
@pytest.mark.parametrize("model", MODELS)
def test_the_ellipse_is_that_of_cameras_drawn_from_the_covariance(block_run, model):
    run = block_run.run
    adjustment = adjust_tracks(run.views, run.tracks, AdjustOptions(model=model, drift=0))
    sensor, covariance = adjustment.sensors[2], adjustment.covariance.view(2)
    pixel = (np.array(run.views[2].size) - 1) / 2
    middle = sensor.sensor.localize(pixel, np.array(run.altitude))
    _, _, found = moved_in_space(sensor, covariance, model, middle)
    at = sensor.localize(pixel, np.array(run.altitude))
    distance = adjustment.cameras.unknowns.distance[2]
    drawn = np.random.default_rng(1).multivariate_normal(np.zeros(len(covariance)), covariance, 3000)
    places = []
    for step in drawn:
        parts = dict(zip(model.split("+"), step.reshape(-1, 3), strict=True))
        turned = sensor.correction.rotation + parts.get("rotation", np.zeros(3)) / distance
        moved = sensor.correction.translation + parts.get("translation", np.zeros(3))
        changed = replace(sensor, correction=replace(sensor.correction, rotation=turned, translation=moved))
        places.append(changed.localize(pixel, np.array(run.altitude)))
    east_north = ((np.array(places) - at) * metres_per_unit(at))[:, :2]
    values, axes = np.linalg.eigh(np.cov(east_north.T))
    assert [found.minor_m, found.major_m] == pytest.approx(np.sqrt(values), rel=0.06)
    assert np.mean(np.hypot(*east_north.T) < found.ce90_m) == pytest.approx(0.9, abs=0.02)
    if found.major_m > 1.2 * found.minor_m:
        azimuth = np.degrees(np.arctan2(*axes[:, 1]))
        assert abs((found.azimuth_deg - azimuth + 90) % 180 - 90) < 12


def test_errors_that_images_share_are_in_the_ellipse_of_each():
    """Of a sensor whose columns are known to some pixels: what its cameras follow of it is none."""
    block = simulate_block(3, 250, seed=3, size=(2000, 1200))
    prior = Calibration.prior("A", 2000)
    wide = replace(prior, covariance=1e4 * prior.covariance)
    common, options = CommonErrors((wide, None, wide)), AdjustOptions(jitter="off")
    found = adjust_tracks(block.views, block.tracks, options, common=common, hold_out=False)
    run = Run("adjust", block.views, (), block.tracks, adjustment=found)
    for i, one in enumerate(measure_views(run)):
        sensor, middle = (
            found.sensors[i],
            block.views[i].sensor.localize(np.array([999.5, 599.5]), np.array(run.altitude)),
        )
        off = common.moved(np.array([i]), sensor.project(middle)[None, 0])[:, 0].T
        shared = found.covariance.shared.by_unknown.reshape(3, -1, off.shape[1])[i], off
        given = sensor, found.covariance.view(i), found.cameras.unknowns.model, middle
        _, sigma, ellipse = moved_in_space(*given, None, shared)
        assert one.correction.ellipse.major_m == pytest.approx(ellipse.major_m, rel=1e-3)
        assert one.correction.center_sigma_px == pytest.approx(sigma, rel=1e-3)
        alone = moved_in_space(*given)[1]
        assert (np.abs(sigma / alone - 1.0) > 1e-3).any() == off.any()


def test_what_is_stated_is_taken_from_where_the_priors_take_it(block_run):
    view = block_run.run.views[0]
    assert isinstance(view.sensor, RPC)
    per_axis = 2.1460  # CE90 of one sigma along each axis

    def stated(**accuracy):
        return stated_ce90(replace(view, sensor=replace(view.sensor, **accuracy)))

    assert stated(err_bias=3.0, err_rand=4.0) == pytest.approx(per_axis * 5.0, rel=1e-4)
    assert stated(err_bias=3.0, err_rand=None) == pytest.approx(per_axis * 3.0, rel=1e-4)
    assert stated(err_bias=None, err_rand=4.0) is None
    assert stated(err_bias=0.05, err_rand=0.1) is None  # of a fit, in pixels
    physical = Pushbroom.__new__(Pushbroom)
    object.__setattr__(physical, "accuracy", (3.0, 4.0))
    assert stated_ce90(replace(view, sensor=physical)) == pytest.approx(per_axis * 5.0, rel=1e-4)
