"""What every sensor model promises (`barpc.sensor.SensorModel`)."""

from __future__ import annotations

import pickle
from dataclasses import FrozenInstanceError

import numpy as np
import pytest

from barpc.base.geodesy import metres_per_unit, wrap_longitude
from barpc.sensor import SensorModel
from tests.sensor.conftest import slopes_off


@pytest.fixture
def image_alt(case):
    rng = np.random.default_rng(1)
    image = rng.uniform(0, 1, (200, 2)) * (np.array(case.size) - 1)
    return image, rng.uniform(*case.alt_range, 200)


def test_a_model_has_the_three_methods(case):
    assert isinstance(case.model, SensorModel)


def test_projecting_a_localised_point_gives_it_back(case, image_alt):
    image, alt = image_alt
    ground = case.model.localize(image, alt)
    np.testing.assert_array_equal(ground[:, 2], alt)
    np.testing.assert_allclose(case.model.project(ground), image, rtol=0, atol=2e-6)


@pytest.mark.few(9)
def test_the_jacobian_is_the_central_difference(case, image_alt):
    ground = case.model.localize(*image_alt)
    value, _ = case.model.project_jacobian(ground)
    np.testing.assert_allclose(value, case.model.project(ground), rtol=0, atol=1e-7)
    assert slopes_off(case.model, ground, 20.0 / metres_per_unit(ground)) < 2e-5


@pytest.mark.few(5)
def test_leading_axes_broadcast(case, image_alt):
    image, alt = image_alt
    ground = case.model.localize(image.reshape(4, 50, 2), alt.reshape(4, 50))
    assert ground.shape == (4, 50, 3)
    flat = case.model.project(ground.reshape(-1, 3))
    np.testing.assert_allclose(case.model.project(ground).reshape(-1, 2), flat, rtol=0, atol=1e-9)
    value, jacobian = case.model.project_jacobian(ground)
    assert value.shape == (4, 50, 2)
    assert jacobian.shape == (4, 50, 2, 3)
    assert case.model.project(ground[0, 0]).shape == (2,)
    assert case.model.localize(image[0], alt[:7]).shape == (7, 3)
    assert case.model.project(np.empty((0, 3))).shape == (0, 2)
    assert case.model.localize(np.empty((0, 2)), np.empty(0)).shape == (0, 3)


@pytest.mark.few(5)
def test_one_bad_point_is_nan_and_harms_no_other(case, image_alt):
    image, alt = image_alt
    ground = case.model.localize(image, alt)
    expected = case.model.project(ground)
    broken = ground.copy()
    broken[7] = np.nan
    got = case.model.project(broken)
    assert np.isnan(got[7]).all()
    good = np.arange(len(ground)) != 7
    np.testing.assert_allclose(got[good], expected[good], rtol=0, atol=1e-9)
    value, jacobian = case.model.project_jacobian(broken)
    assert np.isnan(value[7]).all()
    assert np.isnan(jacobian[7]).all()
    image = image.copy()
    image[3, 0] = np.nan
    located = case.model.localize(image, alt)
    assert np.isnan(located[3, :2]).all()
    others = np.arange(len(image)) != 3
    np.testing.assert_allclose(located[others], ground[others], rtol=0, atol=1e-12)


@pytest.mark.few(5)
def test_whole_turns_of_longitude_change_nothing(case, image_alt):
    ground = case.model.localize(*image_alt)
    for turn in (-360.0, 360.0):
        moved = ground + [turn, 0, 0]
        np.testing.assert_allclose(case.model.project(moved), case.model.project(ground), rtol=0, atol=1e-6)
    assert np.abs(wrap_longitude(ground[:, 0], ground[0, 0]) - ground[:, 0]).max() < 1e-12


@pytest.mark.few(5)
def test_a_model_survives_pickling_and_compares_by_content(case, image_alt):
    copy = pickle.loads(pickle.dumps(case.model))
    assert copy == case.model
    assert hash(copy) == hash(case.model)
    ground = case.model.localize(*image_alt)
    np.testing.assert_array_equal(copy.project(ground), case.model.project(ground))


def test_a_model_cannot_be_changed(case):
    name = next(iter(vars(case.model)))
    with pytest.raises((FrozenInstanceError, AttributeError)):
        setattr(case.model, name, None)
    for value in vars(case.model).values():
        if isinstance(value, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                value[...] = 0
