"""Satellites that look at a place: they stand where asked, fly as gravity says, and scan as asked."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.base.geodesy import EARTH_RATE, ecef_from_ground, enu_basis, ground_from_ecef
from barpc.simulate import GM, Look, circular_orbit, fly, looks

TARGET = np.array([5.4, 43.3, 230.0])
SIZE, GSD = (401, 301), 0.5


def stands(look: Look) -> tuple[float, float, float]:
    """Incidence, azimuth [deg] of the satellite seen from the target, its distance from the middle of the Earth [m]."""
    sensor = fly(TARGET, look, SIZE, GSD)
    place = sensor.position(0.5 * (SIZE[1] - 1))
    east, north, up = enu_basis(TARGET) @ (place - ecef_from_ground(TARGET))
    incidence = np.degrees(np.arctan2(np.hypot(east, north), up))
    return float(incidence), float(np.degrees(np.arctan2(east, north)) % 360.0), float(np.linalg.norm(place))


@pytest.mark.parametrize(
    "look", [Look(0.0), Look(12.0, 90.0), Look(25.0, 200.0, altitude=5e5), Look(5.0, 350.0, heading=10.0)]
)
def test_a_satellite_stands_in_the_direction_and_at_the_altitude_that_were_asked_for(look) -> None:
    incidence, azimuth, radius = stands(look)
    assert incidence == pytest.approx(look.incidence, abs=1e-3)
    if look.incidence:
        assert azimuth == pytest.approx(look.azimuth, abs=1e-2)
    foot = np.linalg.norm(ecef_from_ground([TARGET[0], TARGET[1], 0.0]))
    assert radius == pytest.approx(foot + look.altitude, abs=1.0)


@pytest.mark.parametrize(("heading", "scan"), [(192.0, None), (192.0, 90.0), (10.0, None), (300.0, 45.0)])
def test_rows_advance_along_the_scan_and_columns_to_its_left(heading, scan) -> None:
    """At nadir, by a pixel for each `gsd`; the place that was asked for is in the middle."""
    sensor = fly(TARGET, Look(0.0, heading=heading, scan=scan), SIZE, GSD)
    middle = (np.array(SIZE) - 1) / 2
    np.testing.assert_allclose(sensor.project(TARGET), middle, atol=0.01)
    angle = np.radians(heading if scan is None else scan)
    along, left = np.array([np.sin(angle), np.cos(angle), 0]), np.array([-np.cos(angle), np.sin(angle), 0])
    for direction, moved in ((along, [0.0, 1.0]), (left, [1.0, 0.0])):
        there = ground_from_ecef(ecef_from_ground(TARGET) + 50.0 * direction @ enu_basis(TARGET))
        np.testing.assert_allclose((sensor.project(there) - middle) / 100.0, moved, atol=0.003)


def test_the_line_of_sight_passes_over_the_ground_at_a_line_a_period() -> None:
    sensor = fly(TARGET, Look(0.0), SIZE, GSD)
    place = sensor.position(150.0)
    rate = np.sqrt(GM / np.linalg.norm(place) ** 3)  # Kepler's third law
    assert 2 * np.pi / rate == pytest.approx(98.6 * 60, rel=0.01)  # the period at 694 km
    ends = sensor.localize(np.array([[200.0, 0.0], [200.0, 300.0]]), np.array([230.0, 230.0]))
    length = np.linalg.norm(np.subtract(*ecef_from_ground(ends)))
    assert length == pytest.approx(300 * GSD, rel=1e-3)
    period = GSD / (rate * np.linalg.norm(ecef_from_ground(TARGET)))
    flown = np.linalg.norm(sensor.position(300.0) - sensor.position(0.0)) / (300 * period)
    assert flown == pytest.approx(7500, rel=0.04)  # m/s, less or more by the turning Earth


def test_an_orbit_is_a_circle_in_space_and_the_earth_turns_below() -> None:
    place, rate, times = np.array([7.0e6, 1e5, 2e5]), 1e-3, np.array([-100.0, 0.0, 1e-3, 100.0, 1000.0])
    forward = np.array([0.3, 0.1, 1.0])
    found = circular_orbit(place, forward, rate, times)
    np.testing.assert_allclose(found[1], place)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), np.linalg.norm(place))
    level = forward - (forward @ place) / (place @ place) * place
    inertial = rate * np.linalg.norm(place) * level / np.linalg.norm(level)
    expected = inertial - np.cross([0.0, 0.0, EARTH_RATE], place)
    np.testing.assert_allclose((found[2] - found[1]) / 1e-3, expected, rtol=1e-4, atol=0.01)
    turned = EARTH_RATE * 1000.0
    back = np.array([[np.cos(turned), -np.sin(turned), 0], [np.sin(turned), np.cos(turned), 0], [0, 0, 1]])
    there = np.cos(1.0) * place + np.sin(1.0) * inertial / rate
    np.testing.assert_allclose(back @ found[4], there, rtol=1e-9)


def test_looks_spread_along_the_flight_evenly_and_across_it_by_the_golden_section() -> None:
    one = looks(1, 0.0)
    assert [(look.incidence, look.azimuth, look.altitude) for look in one] == [(0.0, 192.0, 694e3)]
    three = looks(3, 0.0, altitude=5e5)
    assert all(look.altitude == 5e5 for look in three)
    assert (three[0].incidence, three[0].azimuth) == pytest.approx((10.0, 12.0))  # behind, on the track
    for k, pitch in enumerate((-10.0, 0.0, 10.0)):
        roll = 8.0 * (2 * ((0.5 + 0.381966 * k) % 1.0) - 1.0)
        x, y = np.tan(np.radians([pitch, roll]))
        assert np.tan(np.radians(three[k].incidence)) == pytest.approx(np.hypot(x, y))
        turn = np.radians(three[k].azimuth - 192.0)
        assert np.tan(np.radians(three[k].incidence)) * np.cos(turn) == pytest.approx(x, abs=1e-9)
        assert np.tan(np.radians(three[k].incidence)) * np.sin(turn) == pytest.approx(y, abs=1e-9)
    assert three[1].incidence == pytest.approx(8.0 * 0.763932)
    tangent = np.hypot(*np.tan(np.radians([10.0, 4.0])))
    assert np.tan(np.radians(looks(2, turn=0.25)[0].incidence)) == pytest.approx(tangent)
