"""The rigorous pushbroom camera: exact inverse, exact derivative, honest failure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from barpc.base.errors import RpcError
from barpc.base.geodesy import EARTH_RATE
from barpc.sensor.curve import Curve, attitude_through
from barpc.sensor.geometry import view_angles
from barpc.sensor.pushbroom import Pushbroom
from barpc.simulate import GM, Look, fly
from tests.sensor.conftest import slopes_off

TARGET = np.array([5.4, 43.3, 200.0])
SIZE = (20000, 20000)
LOOKS = [
    Look(0.0, 0.0, 500e3),
    Look(25.0, 100.0, 694e3),
    Look(20.0, 300.0, 800e3, heading=350.0),
    Look(12.0, 200.0, 620e3, scan=90.0),
]


@pytest.fixture(params=LOOKS, ids=lambda look: f"{look.incidence:g}deg")
def sensor(request) -> Pushbroom:
    return fly(TARGET, request.param, SIZE, 0.5)


@pytest.fixture
def points() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return rng.uniform(0, SIZE[0], (2000, 2)), rng.uniform(-500, 9000, 2000)


def test_projection_inverts_localisation_to_rounding(sensor, points):
    image, alt = points
    ground = sensor.localize(image, alt)
    assert np.abs(sensor.project(ground) - image).max() < 2e-8
    assert np.array_equal(ground[:, 2], alt)


def test_what_cannot_be_seen_is_nan(sensor):
    antipode = np.array([TARGET[0] - 180.0, -TARGET[1], 0.0])
    ground = np.array([TARGET, antipode, [np.nan, 43.0, 0.0], [5.4, 10.0, 0.0]])
    image, jacobian = sensor.project_jacobian(ground)
    bad = np.array([False, True, True, True])
    assert np.array_equal(np.isnan(image).all(axis=1), bad)
    assert np.array_equal(np.isnan(jacobian).all(axis=(1, 2)), bad)
    far = np.array([[0.0, 1e9], [1e9, 0.0], [np.nan, 0.0], [0.0, 0.0]])
    assert np.array_equal(np.isnan(sensor.localize(far, np.array(0.0))).any(axis=1), [True, True, True, False])


def test_orbit_and_attitude_must_share_some_time(sensor):
    stop = sensor.orbit.knots[-1]
    late = Curve.polynomial(sensor.orbit.coeffs[0], stop, stop + 10.0)
    with pytest.raises(RpcError, match="share no time"):
        replace(sensor, orbit=late)
    assert replace(sensor, orbit=Curve.polynomial(sensor.orbit.coeffs[0], stop - 1e-6, stop)) != sensor


def test_an_orbit_sampled_every_ten_seconds_is_known_to_a_tenth_of_a_millimetre_in_between():
    radius, inclination = 7.07e6, np.radians(98.2)
    rate = np.sqrt(GM / radius**3)

    def place(t):
        inertial = radius * np.stack(
            [np.cos(rate * t), np.sin(rate * t) * np.cos(inclination), np.sin(rate * t) * np.sin(inclination)]
        )
        turn = Rotation.from_rotvec(np.outer(t, [0.0, 0.0, -EARTH_RATE]))
        return turn.apply(inertial.T)

    times = np.arange(0.0, 161.0, 10.0)
    orbit = Curve.through(times, place(times))
    between = np.linspace(30.0, 130.0, 501)
    assert np.abs(orbit(between)[0].T - place(between)).max() < 1e-4
    step = 1e-2
    speed = (place(between + step) - place(between - step)) / (2 * step)
    assert np.abs(orbit(between)[1].T - speed).max() < 1e-3


def test_a_camera_from_sampled_ephemeris_and_quaternions_is_the_camera_that_was_sampled(sensor, points):
    """Positions every 0.2 s, quaternions at 32 Hz of either sign, as deliveries have them: 1e-4 px."""
    start, stop = sensor.time(np.array([-3000.0, 23000.0]))
    times, ticks = np.arange(start, stop, 0.1), np.arange(start, stop, 1 / 32)
    place, w = sensor.orbit(times)[0].T, sensor.attitude(ticks)[0].T
    turned = Rotation.from_matrix(np.array(sensor.mount)) * Rotation.from_rotvec(w)
    quaternions = np.roll(turned.as_quat(), 1, axis=1) * np.where(np.arange(len(ticks)) % 3, 2.0, -0.5)[:, None]
    mount, attitude = attitude_through(ticks, quaternions)
    again = replace(sensor, orbit=Curve.through(times, place), attitude=attitude, mount=mount)
    image, alt = points
    ground = sensor.localize(image, alt)
    assert np.abs(again.project(ground) - image).max() < 1e-4
    assert np.abs(again.project(again.localize(image, alt)) - image).max() < 2e-8


@pytest.mark.few(2)
def test_a_shaking_attitude_still_inverts(sensor, points):
    """Jitter of half a pixel at 20 Hz, sampled at 500 Hz: forward and back to 1e-7 px, derivative exact."""
    ticks = np.arange(*sensor.time(np.array([-2000.0, 22000.0])), 1 / 500)
    w = sensor.attitude(ticks)[0].T + 0.4e-6 * np.sin(2 * np.pi * 20 * ticks)[:, None]
    shaken = replace(sensor, attitude=Curve.through(ticks, w, degree=3))
    image, alt = points
    ground = shaken.localize(image, alt)
    assert np.abs(shaken.project(ground) - image).max() < 1e-7
    assert slopes_off(shaken, ground[:100], np.array([1e-6, 1e-6, 0.1])) < 1e-5


@pytest.mark.few(4)
@pytest.mark.parametrize("angle", [30.0, 90.0, 135.0, 180.0])
def test_the_axes_of_the_camera_may_be_turned_about_its_line_of_sight(sensor, points, angle):
    """The same camera, its detector along any direction of its own axes."""
    cosine, sine = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    attitude = Curve(sensor.attitude.knots, sensor.attitude.coeffs @ turn)
    turned = replace(sensor, mount=sensor.mount @ turn, attitude=attitude, look=turn[:2, :2].T @ sensor.look)
    image, alt = points
    ground = sensor.localize(image, alt)
    np.testing.assert_allclose(turned.localize(image, alt)[:, :2], ground[:, :2], atol=1e-12)
    np.testing.assert_allclose(turned.project(ground), image, atol=1e-7)
    for found, expected in zip(turned.project_jacobian(ground), sensor.project_jacobian(ground), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7)


@pytest.mark.slow
@given(
    lon=st.floats(-180, 180),
    lat=st.floats(-80, 80),
    incidence=st.floats(0, 35),
    azimuth=st.floats(0, 360),
    altitude=st.floats(450e3, 850e3),
    heading=st.floats(0, 360),
)
@settings(max_examples=60, deadline=None)
def test_any_satellite_anywhere_sees_its_target_in_the_middle(lon, lat, incidence, azimuth, altitude, heading):
    look = Look(incidence, azimuth, altitude, heading)
    target = np.array([lon, lat, 150.0])
    sensor = fly(target, look, (2000, 1500), 0.5)
    assert np.abs(sensor.project(target) - (999.5, 749.5)).max() < 1e-6
    seen_incidence, seen_azimuth = view_angles(sensor, target)
    assert seen_incidence == pytest.approx(incidence, abs=1e-3)
    assert incidence < 0.1 or abs((seen_azimuth - azimuth + 180) % 360 - 180) < 0.1 / np.sin(np.radians(incidence))
    image = np.array([[0.0, 0.0], [1999.0, 1499.0], [0.0, 1499.0]])
    assert np.abs(sensor.project(sensor.localize(image, np.array(2000.0))) - image).max() < 2e-8


@pytest.mark.parametrize(
    ("samples", "asked", "degree"),
    [(2, 5, 1), (3, 5, 1), (4, 5, 3), (5, 5, 3), (6, 5, 5), (12, 5, 5), (4, 3, 3), (3, 3, 1), (9, 3, 3)],
)
def test_a_spline_has_the_highest_odd_degree_that_its_samples_determine(samples, asked, degree) -> None:
    rng = np.random.default_rng(0)
    times, values = np.cumsum(rng.uniform(1, 2, samples)), rng.normal(size=(samples, 3))
    curve = Curve.through(times, values, asked)
    assert curve.coeffs.shape[1] == degree + 1
    np.testing.assert_allclose(curve(times)[0].T, values, atol=1e-9)
    high, low = (curve(times[:-1] + 0.3 + step)[0] for step in (1e-5, -1e-5))
    np.testing.assert_allclose(curve(times[:-1] + 0.3)[1], (high - low) / 2e-5, atol=1e-5)
