"""The pushbroom camera against rays that are worked out from scratch: bent orbits, attitudes and look angles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial.polynomial import polyval
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from barpc.base.errors import RpcError
from barpc.base.geodesy import ecef_from_ground, enu_basis, ground_from_ecef, metres_per_unit, up
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.curve import Curve
from barpc.sensor.pushbroom import STRAIGHT, Light, Pushbroom
from tests.sensor.conftest import slopes

ORIGIN = 4100.5
PERIOD, FIRST = 7.1e-5, 3.25
ROWS, COLS = 9000.0, 8000.0
BENT = {"straight": STRAIGHT, "aberration": Light(aberration=True), "refraction": Light(refraction=True)}
BENT["both"] = Light(True, True)

# l_x and l_y by col - ORIGIN: the slope of l_y changes by a quarter from edge to edge, that of l_x its sign
LOOK = np.array(
    [[2e-3, 3e-8, 4e-12, -2e-16], [-1e-3, 7.1e-7, 9e-12, 5e-16]],
)


def camera(look: np.ndarray = LOOK, period: float = PERIOD, light: Light = STRAIGHT) -> Pushbroom:
    """Above 12 E 47 N at 650 km, 20 degrees off the nadir; orbit and attitude are cubics of time."""
    over = ecef_from_ground([12.0, 47.0, 6.5e5])
    east, north, vertical = enu_basis(np.array([12.0, 47.0, 0.0]))
    flight = 0.2 * east - np.sqrt(1 - 0.04) * north
    start, stop = FIRST, FIRST + period * ROWS
    low, high = min(start, stop) - 0.3, max(start, stop) + 0.3
    since = (start + stop) / 2 - low  # the satellite is over its place in the middle of the image
    speed = 7100 * flight
    orbit = np.array([over - since * speed, speed, -4.1 * vertical, 0.01 * east])
    mount = np.column_stack([flight, np.cross(-vertical, flight), -vertical])
    mount = mount @ Rotation.from_euler("xyz", [0.3, 0.15, -0.4]).as_matrix()
    attitude = np.array([[0.004, -0.006, 0.01], [-0.009, 0.004, 0.012], [3e-3, 2e-3, -4e-3], [1e-3, -1e-3, 0.0]])
    return Pushbroom(
        Curve.polynomial(orbit, low, high),
        Curve.polynomial(attitude, low, high),
        mount,
        look,
        ORIGIN,
        period,
        FIRST,
        light,
    )


CASES = {
    "curved": camera(),
    "turned over": camera(period=-PERIOD),
    "parabolic": camera(LOOK[:, :3]),
    "of a frame": camera(LOOK[:, :2]),
}
each = pytest.mark.parametrize("case", CASES)


def scatter(seed: int = 0, count: int = 12) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    image = rng.uniform(0, 1, (count, 2)) * [COLS, ROWS]
    image[:4] = [[0, 0], [COLS, 0], [0, ROWS], [COLS, ROWS]]
    return image, rng.uniform(-100, 4000, count)


def ray(model: Pushbroom, col: float, row: float) -> tuple[np.ndarray, np.ndarray]:
    """Place and unit direction of one pixel, from the polynomials alone."""
    time = model.first_line + row * model.line_period
    place = polyval(time - model.orbit.knots[0], model.orbit.coeffs[0])
    turn = Rotation.from_rotvec(polyval(time - model.attitude.knots[0], model.attitude.coeffs[0]))
    inside = np.append(polyval(col - model.look_origin, model.look.T), 1.0)
    direction = model.mount @ turn.apply(inside)
    return place, direction / np.linalg.norm(direction)


def down(place: np.ndarray, direction: np.ndarray, alt: float) -> np.ndarray:
    """Where a line comes to an altitude, by bisection."""
    far = brentq(lambda s: ground_from_ecef(place + s * direction)[2] - alt, 3e5, 1.5e6, xtol=1e-7)
    return ground_from_ecef(place + far * direction)


def metres(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(ecef_from_ground(one) - ecef_from_ground(other), axis=-1).max())


@each
def test_a_pixel_sees_what_lies_on_its_ray(case: str) -> None:
    model, (image, alt) = CASES[case], scatter()
    origin, direction = model.line_of_sight(image)
    rays = [ray(model, *point) for point in image]
    np.testing.assert_allclose(origin, [place for place, _ in rays], rtol=0, atol=1e-6)
    np.testing.assert_allclose(direction, [way for _, way in rays], rtol=0, atol=1e-13)
    truth = np.array([down(*r, a) for r, a in zip(rays, alt, strict=True)])
    assert metres(model.localize(image, alt), truth) < 1e-5
    np.testing.assert_allclose(model.project(truth), image, rtol=0, atol=2e-5)
    np.testing.assert_array_equal(model.position(image[:, 1]), origin)


@pytest.mark.few(3)
@pytest.mark.parametrize("light", list(BENT))
@each
def test_the_derivative_is_the_central_difference_of_the_projection(case: str, light: str) -> None:
    model = replace(CASES[case], light=BENT[light])
    ground = model.localize(*scatter(1, 40))
    image, jacobian = model.project_jacobian(ground)
    np.testing.assert_allclose(image, model.project(ground), rtol=0, atol=1e-9)
    metres = metres_per_unit(ground)
    # that the bend changes with the direction is left out
    off = 2e-5 if model.light.refraction else 5e-6 if model.light.aberration else 5e-7
    assert np.abs((jacobian - slopes(model, ground, 3.0 / metres)) / metres[:, None]).max() < off


def test_the_case_is_bent_enough_to_tell_one_slope_from_another() -> None:
    """From edge to edge the ground sampling changes by a tenth, across and along, and the rows lean."""
    model = CASES["curved"]
    ground = model.localize(np.array([[0.0, 4500.0], [COLS, 4500.0]]), np.zeros(2))
    metric = model.project_jacobian(ground)[1][..., :2] / metres_per_unit(ground)[:, None, :2]
    sides = np.linalg.norm(np.linalg.inv(metric), axis=1)  # of a pixel, along col and row
    assert sides[1, 0] / sides[0, 0] > 1.1 or sides[0, 0] / sides[1, 0] > 1.1
    assert (np.abs(metric) > 0.1).all()


@pytest.mark.parametrize("light", ["aberration", "refraction", "both"])
def test_bent_light_comes_back_to_its_pixel(light: str) -> None:
    model, (image, alt) = replace(CASES["curved"], light=BENT[light]), scatter(2, 60)
    ground = model.localize(image, alt)
    np.testing.assert_allclose(model.project(ground), image, rtol=0, atol=3e-8)
    moved = np.linalg.norm(ecef_from_ground(ground) - ecef_from_ground(CASES["curved"].localize(image, alt)), axis=1)
    low, high = {"aberration": (8, 40), "refraction": (0.2, 4), "both": (8, 40)}[light]
    assert low < moved.min()
    assert moved.max() < high


# --- light ---------------------------------------------------------------------------------------------------


def above(zenith: float, azimuth: float, alt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A point, a camera 700 km away at a zenith distance, and unit vectors: the vertical, the level way to it."""
    ground = np.array([-70.0, -20.0, alt])
    east, north, vertical = enu_basis(ground)
    level = np.sin(azimuth) * east + np.cos(azimuth) * north
    point = ecef_from_ground(ground)
    camera_at = point + 7e5 * (np.cos(zenith) * vertical + np.sin(zenith) * level)
    return point, camera_at, vertical, level


@pytest.mark.parametrize("alt", [0.0, 2000.0, 8000.0])
@pytest.mark.parametrize("zenith", [0.0, 10.0, 45.0, 80.0])
def test_refraction_moves_a_point_away_from_the_camera_by_2_316_m_tan_z_over_cos2_z(zenith, alt) -> None:
    z = np.radians(zenith)
    point, place, _, level = above(z, 1.1, alt)
    still = np.zeros((3, 1))
    seen = Light(refraction=True).seen(point[:, None], place[:, None], still)[:, 0]
    size = 2.316 * np.tan(z) / np.cos(z) ** 2 * np.exp(-alt / 8000.0)
    np.testing.assert_allclose(seen - (point - place), -size * level, rtol=0, atol=1e-7 + 1e-7 * size)


@pytest.mark.parametrize(("zenith", "known"), [(84.0, True), (84.5, False)])
def test_refraction_is_known_down_to_a_tenth_of_the_vertical(zenith, known) -> None:
    point, place, *_ = above(np.radians(zenith), 0.3, 0.0)
    seen = Light(refraction=True).seen(point[:, None], place[:, None], np.zeros((3, 1)))
    assert np.isfinite(seen).all() == known


def test_aberration_tilts_the_sight_by_the_speed_against_the_point_over_that_of_light() -> None:
    point, place, *_ = above(0.4, 2.0, 100.0)
    velocity = np.array([3000.0, -5000.0, 4500.0])
    seen = Light(aberration=True).seen(point[:, None], place[:, None], velocity[:, None])[:, 0]
    sight = point - place
    against = velocity - np.cross([0.0, 0.0, 7.292115e-5], sight)
    expected = sight + np.linalg.norm(sight) * against / 299792458.0
    np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("light", list(BENT))
def test_the_derivative_of_what_is_seen_is_its_central_difference(light: str) -> None:
    """Of every component of the seen vector; that refraction changes with the direction is left out."""
    point, place, *_ = above(0.7, 2.0, 1500.0)
    velocity = np.array([[3000.0], [-5000.0], [4500.0]])
    bent = BENT[light]
    off = 1.5e-5 if bent.refraction else 5e-7
    for k in range(3):
        gradient = np.eye(3)[:, [k]]
        found = bent.by_point(gradient, point[:, None], place[:, None], velocity)[:, 0]
        steps = 50.0 * np.eye(3)
        ahead, behind = (
            np.array([bent.seen((point + s)[:, None], place[:, None], velocity)[k, 0] for s in sign * steps])
            for sign in (1, -1)
        )
        np.testing.assert_allclose(found, (ahead - behind) / 100.0, rtol=0, atol=off)


def test_what_is_seen_in_thinner_air_is_part_of_the_derivative() -> None:
    """A point that rises seems to come back from where the air had moved it: 2 m over 8 km."""
    point, place, vertical, level = above(np.radians(60), 0.5, 0.0)
    gradient = level[:, None]
    found = Light(refraction=True).by_point(gradient, point[:, None], place[:, None], np.zeros((3, 1)))[:, 0]
    lift = 2.316 * np.tan(np.radians(60)) * 4
    np.testing.assert_allclose((found - level) @ vertical, lift / 8000.0, rtol=1e-6)


# --- what it does not see --------------------------------------------------------------------------------------


def test_the_ground_ends_a_second_beyond_orbit_and_attitude_whichever_is_shorter() -> None:
    model = CASES["curved"]
    low, high = model.orbit.knots
    shorter = Curve.polynomial(model.attitude.coeffs[0], low, high - 0.5)
    for camera_, stop in ((model, high + 1.0), (replace(model, attitude=shorter), high + 0.5)):
        for time, known in ((stop - 1e-3, True), (stop + 1e-3, False)):
            image = np.array([ORIGIN, (time - FIRST) / PERIOD])
            assert np.isfinite(camera_.localize(image, np.zeros(()))).all() == known
            if known:
                ground = camera_.localize(image, np.zeros(()))
                np.testing.assert_allclose(camera_.project(ground), image, atol=1e-5)
    for time, known in ((low - 0.999, True), (low - 1.001, False)):
        image = np.array([ORIGIN, (time - FIRST) / PERIOD])
        assert np.isfinite(model.localize(image, np.zeros(()))).all() == known


def test_a_point_behind_the_camera_and_one_beyond_the_horizon_are_not_seen() -> None:
    model = CASES["curved"]
    place, direction = ray(model, 4000.0, 4500.0)
    behind = ground_from_ecef(place - 1e5 * direction)
    assert np.isnan(model.project(behind)).all()
    ground = model.localize(np.array([4000.0, 4500.0]), np.zeros(()))
    np.testing.assert_allclose(model.project(np.array([behind, ground]))[1], [4000.0, 4500.0], atol=1e-6)
    away = replace(model, mount=-model.mount @ np.diag([1.0, -1.0, 1.0]))
    assert np.isnan(away.localize(np.array([4000.0, 4500.0]), np.zeros(()))).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"look": LOOK[:, :1]}, "look has no slope"),
        ({"look": LOOK * [1.0, np.nan, 1.0, 1.0]}, "finite"),
        ({"mount": np.eye(2)}, "shape"),
        ({"look_origin": np.nan}, "finite"),
        ({"line_period": np.inf}, "finite"),
        ({"first_line": np.nan}, "finite"),
        ({"line_period": 0.0}, "line period of zero"),
        ({"mount": np.diag([1.0, 1.0, -1.0])}, "rotation"),
        ({"mount": np.eye(3) + 1e-8}, "rotation"),
        ({"attitude": Curve.polynomial(np.zeros((1, 3)), 5.95, 6.0)}, "share no time"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(RpcError, match=words):
        replace(CASES["curved"], **change)
    nearly = CASES["curved"].mount + 1e-11
    assert replace(CASES["curved"], mount=nearly) != CASES["curved"]


def test_a_camera_tells_its_height_its_pace_and_for_how_long_it_is_known() -> None:
    told = repr(CASES["curved"])
    lasts = PERIOD * ROWS + 0.6 + 2.0
    for words in ("0.071 ms a row", f"for {lasts:.3g} s"):
        assert words in told
    height = float(told.split(" km high")[0].split("(")[-1].split()[-1])
    assert height == pytest.approx(650.0, abs=2.0)
    assert CASES["curved"].advice == ""
    times = np.linspace(*CASES["curved"].attitude.knots, 9)
    sampled = Curve.through(times, CASES["curved"].attitude(times)[0].T)
    swinging = replace(CASES["curved"], attitude=sampled)
    assert "which no RPC represents" in swinging.advice
    assert Corrected(swinging, Correction(np.zeros(3), np.zeros(3), np.zeros(3))).advice == swinging.advice


def test_the_vertical_of_the_oracle_is_that_of_the_ellipsoid() -> None:
    ground = np.array([[12.0, 47.0, 0.0]])
    high = ecef_from_ground(ground + [0, 0, 1000.0]) - ecef_from_ground(ground)
    np.testing.assert_allclose(up(ground)[:, 0], high[0] / 1000.0, atol=1e-9)
