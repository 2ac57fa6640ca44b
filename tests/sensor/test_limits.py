"""Pieces that every sensor model stands on: fields, times, circles, corrections, geometry; limits on either side."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.polynomial import polynomial
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from barpc.base.errors import InputError, RpcError, RpcFormatError
from barpc.base.geodesy import ecef_from_ground, enu_basis, ground_from_ecef
from barpc.sensor.centers import camera_center
from barpc.sensor.corrected import Corrected, Correction, RigidMotion, correction_of
from barpc.sensor.curve import Curve, about_middle, rotation_matrix
from barpc.sensor.document import XmlFields, parse_time, seconds
from barpc.sensor.geometry import Several, image_border, lines_of_sight, view_angles
from barpc.sensor.image_corrections import (
    CorrectionGrid,
    Displaced,
    ImageAffine,
    ImageCorrected,
)
from barpc.sensor.radar import aside, dot, on_circle
from barpc.sensor.rpc import RPC, altitude_range
from barpc.sensor.sampler import image_grid
from barpc.sensor.sicd import ImagePlane, Monostatic, PolarFormat, RangeAzimuth, ZeroDoppler, open_sicd
from tests.sensor.conftest import MODELS, make_rpc
from tests.sensor.radar_documents import document
from tests.sensor.test_geometry import tilted_rpc

# --- documents -------------------------------------------------------------------------------------------------


def fields(text: str) -> XmlFields:
    return XmlFields(ElementTree.fromstring(f"<root>{text}</root>"), "a.xml")


def test_a_field_is_its_text_its_number_or_its_numbers() -> None:
    found = fields("<a> x </a><b>3</b><c>1 2.5\n-3e1</c><d>1,2, 3</d><e><f>7</f></e><e><f>8</f></e>")
    assert found.text("a") == "x"
    assert found.number("b") == 3.0
    assert found.numbers("c").tolist() == [1.0, 2.5, -30.0]
    assert found.numbers("c", 3).tolist() == [1.0, 2.5, -30.0]
    assert found.numbers("d", 3, ",").tolist() == [1.0, 2.0, 3.0]
    assert [one.number("f") for one in found.all("e")] == [7.0, 8.0]
    assert found.one("e").number("f") == 7.0
    assert found.all("z") == []
    assert found.positive("c") == 1.0
    assert fields("<w>1000000</w><h>1</h>").size("w", "h") == (1_000_000, 1)


@pytest.mark.parametrize(
    ("text", "ask", "words"),
    [
        ("<a> </a>", lambda f: f.text("a"), "no a below <root>; is the file complete"),
        ("<w>1000001</w><h>1</h>", lambda f: f.size("w", "h"), "w"),
        ("", lambda f: f.one("a"), "no a below <root>"),
        ("<a>1 x</a>", lambda f: f.numbers("a"), "a is not a list of numbers"),
        ("<a>1 2</a>", lambda f: f.number("a"), "a holds 2 numbers, expected 1"),
        ("<a>1 2</a>", lambda f: f.numbers("a", 3), "a holds 2 numbers, expected 3"),
        ("<a>nan</a>", lambda f: f.numbers("a"), "a holds a number that is not finite or absurdly large"),
        ("<a>1.01e9</a>", lambda f: f.numbers("a"), "a holds a number that is not finite or absurdly large"),
        ("<a>-1.01e9</a>", lambda f: f.numbers("a"), "a holds a number that is not finite or absurdly large"),
        ("<a>0</a>", lambda f: f.positive("a"), "a is 0, expected above 0 and at most 1e"),
        ("<a>5.1</a>", lambda f: f.positive("a", 5.0), "a is 5.1, expected above 0 and at most 5"),
    ],
)
def test_a_field_that_is_not_so_is_refused_by_name(text: str, ask: Any, words: str) -> None:
    with pytest.raises(RpcFormatError, match=f"a.xml: {words}"):
        ask(fields(text))


def test_numbers_and_lengths_at_their_limits_are_taken() -> None:
    assert fields("<a>1e9</a>").numbers("a").tolist() == [1e9]
    assert fields("<a>5</a>").positive("a", 5.0) == 5.0
    assert fields("<a>1e-300</a>").positive("a") == 1e-300


@pytest.mark.parametrize(
    ("text", "nanoseconds"),
    [
        ("2021-02-16T15:12:07.000000001", 1), ("2021-02-16 15:12:07.5", 500_000_000),
        (" UTC=2021-02-16T15:12:08Z ", 10**9),
    ],
)  # fmt: skip
def test_times_count_to_the_nanosecond(text: str, nanoseconds: int) -> None:
    epoch = np.datetime64("2021-02-16T15:12:07", "ns")
    assert parse_time(text, "a") - epoch == np.timedelta64(nanoseconds, "ns")
    assert seconds(parse_time(text, "a"), epoch) == pytest.approx(nanoseconds * 1e-9, rel=1e-15)
    for wrong in (
        "1899-02-16T15:12:07", "2021-02-16T15:12:07.0123456789", "2021-02-16", "2021-02-30T15:12:07",
        "2021-02-16T15:12:07+01:00", "2021-13-01T00:00:00", "NaT", "", "none",
    ):  # fmt: skip
        with pytest.raises(RpcFormatError, match="is not a UTC time"):
            parse_time(wrong, "a")


# --- circles and turns -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("right", [True, False])
@pytest.mark.parametrize("ahead", [0.0, 0.1, -0.2])
def test_a_point_on_the_circle_has_its_range_its_angle_its_side_and_its_altitude(right: bool, ahead: float) -> None:
    position = ecef_from_ground(np.array([[10.0, 45.0, 7e5], [-170.0, -60.0, 5.2e5]])).T
    velocity = (
        np.stack([enu_basis(np.array([10.0, 45.0, 0.0]))[1], -enu_basis(np.array([-170.0, -60.0, 0.0]))[1]], 1) * 7500
    )
    distance, alt = np.array([9e5, 6.2e5]), np.array([1000.0, -50.0])
    ground, sight = on_circle(position, velocity, distance, alt, right, np.full(2, ahead))
    away = ecef_from_ground(ground).T - position
    np.testing.assert_allclose(np.linalg.norm(away, axis=0), distance, rtol=0, atol=1e-5)
    np.testing.assert_allclose((away * velocity).sum(axis=0) / distance / 7500, ahead, atol=1e-11)
    np.testing.assert_allclose(ground_from_ecef(ecef_from_ground(ground))[:, 2], alt, atol=1e-6)
    np.testing.assert_allclose(sight, -away / distance, atol=1e-11)
    side = (np.cross(velocity.T, position.T) * away.T).sum(axis=1)
    assert ((side > 0) == right).all()
    assert (dot(aside(position, velocity, right), away) > 0).all()
    with np.errstate(invalid="ignore"):
        short = on_circle(position, velocity, np.array([6e5, 6.2e5]), alt, right)[0]
    assert np.isnan(short[0, :2]).all()
    assert np.isfinite(short[1]).all()


def test_rotations_count_from_the_middle_one() -> None:
    turns = Rotation.from_rotvec(np.random.default_rng(1).normal(0, 0.2, (7, 3)))
    mount, vectors = about_middle(turns)
    np.testing.assert_allclose(mount, turns[3].as_matrix(), atol=1e-15)
    np.testing.assert_allclose(vectors[3], 0, atol=1e-15)
    for k in range(7):
        np.testing.assert_allclose(mount @ rotation_matrix(vectors[k]), turns[k].as_matrix(), atol=1e-14)


def test_a_curve_of_one_piece_and_of_two_halves_are_one() -> None:
    """Values, rates and accelerations, also beyond both ends."""
    coeffs = np.random.default_rng(2).normal(size=(5, 3))
    whole, at = Curve.polynomial(coeffs, 2.0, 6.0), np.array([1.0, 2.0, 3.9, 4.0, 4.1, 6.0, 7.5])
    moved = np.stack([polynomial.Polynomial(c)(polynomial.Polynomial([2.0, 1.0])).coef for c in coeffs.T], axis=1)
    halves = Curve(np.array([2.0, 4.0, 6.0]), np.stack([coeffs, moved]))
    for one, other, order in zip(whole.states(at), halves.states(at), range(3), strict=True):
        expected = polynomial.polyval(at - 2.0, polynomial.polyder(coeffs, order))
        np.testing.assert_allclose(one, expected, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(other, expected, rtol=1e-11, atol=1e-11)
    assert whole.span == (1.0, 7.0)
    for knots in ([2.0, 2.0], [2.0, 1.0]):
        with pytest.raises(RpcError, match="must ascend"):
            Curve(np.array(knots), coeffs[None])


# --- corrections -----------------------------------------------------------------------------------------------


def drifting(degree: int = 2) -> Correction:
    center = ecef_from_ground([7.0, 42.0, 7e5])
    drift = np.array([[3e-6, -2e-6, 4e-6], [-2e-6, 1e-6, 3e-6]])[:degree]
    return Correction([2e-5, -3e-5, 1e-5], [4.0, -3.0, 2.0], center, drift, 9000.0, 8000.0)


def test_a_drift_turns_a_point_on_by_the_row_at_which_it_is_seen() -> None:
    """exp(u d1 + u^2 d2) R (X - T - C) + C, u = (row - 9000) / 8000."""
    correction, rpc = drifting(), make_rpc()
    image = np.array([[3000.0, 1000.0], [12000.0, 17000.0]])
    model = Corrected(rpc, correction)
    ground = model.localize(image, np.array([100.0, 800.0]))
    x = ecef_from_ground(ground)
    for k in range(2):
        u = (image[k, 1] - 9000.0) / 8000.0
        turn = Rotation.from_rotvec(u * correction.drift[0] + u**2 * correction.drift[1])
        first = Rotation.from_rotvec(np.array(correction.rotation))
        moved = (turn * first).apply(x[k] - correction.translation - correction.center) + correction.center
        np.testing.assert_allclose(rpc.project(ground_from_ecef(moved)), image[k], rtol=0, atol=3e-6)
        np.testing.assert_allclose(correction.apply(x[k], image[k, 1]), moved, rtol=0, atol=1e-7)
    np.testing.assert_allclose(model.project(ground), image, rtol=0, atol=3e-6)
    rate = correction.drift_rate(image[:, 1])
    for k, step in enumerate(np.eye(2)):
        u = (image[k, 1] + np.array([1.0, -1.0]) - 9000.0) / 8000.0
        ends = u[:, None] * correction.drift[0] + u[:, None] ** 2 * correction.drift[1]
        np.testing.assert_allclose(rate @ step, (ends[0] - ends[1]) / 2, rtol=1e-9, atol=1e-20)


FAR_OFF = Correction(
    [1e-3, -2e-3, 1.5e-3], [40.0, -60.0, 20.0], drifting().center, [[2e-5, -1e-5, 3e-5]], 8000.0, 8000.0, scale=1.0001
)


@pytest.mark.parametrize(
    "correction", [drifting(0), drifting(1), drifting(2), FAR_OFF], ids=["still", "linear", "quadratic", "far off"]
)
def test_derivatives_of_a_drifting_camera_are_central_differences(correction: Correction) -> None:
    rpc = make_rpc()
    model = Corrected(rpc, correction)
    ecef = ecef_from_ground(model.localize(np.array([[3000.0, 1000.0], [12000.0, 17000.0]]), np.array([100.0, 800.0])))
    image, *found = model.project_ecef(ecef)
    np.testing.assert_allclose(image, model.project(ground_from_ecef(ecef)), rtol=0, atol=1e-6)
    for axis, e in enumerate(np.eye(3)):

        def at(x: float = 0.0, r: float = 0.0, t: float = 0.0, e: Any = e) -> Any:
            moved = replace(
                correction, rotation=correction.rotation + r * e, translation=correction.translation + t * e
            )
            return Corrected(rpc, moved).project(ground_from_ecef(ecef + x * e))

        for analytic, name, step in zip(found, "xrt", (50.0, 1e-5, 50.0), strict=True):
            difference = (at(**{name: step}) - at(**{name: -step})) / (2 * step)
            np.testing.assert_allclose(analytic[..., axis], difference, rtol=0, atol=3e-6 * np.abs(analytic).max())


def test_motions_of_many_views_are_those_of_each() -> None:
    rng = np.random.default_rng(3)
    rotation, translation, center = (
        rng.normal(0, 0.1, (2, 3)),
        rng.normal(size=(2, 3)),
        rng.normal(0, 9, (2, 3)),
    )
    ecef, drift = rng.normal(0, 50, (3, 5)), rng.normal(0, 0.1, (3, 5))
    whole = RigidMotion(ecef, rotation, translation, center, np.array([0, 2, 5]), drift)
    for n in range(5):
        v = int(n >= 2)
        turn = Rotation.from_rotvec(drift[:, n]) * Rotation.from_rotvec(rotation[v])
        expected = turn.apply(ecef[:, n] - translation[v] - center[v]) + center[v]
        np.testing.assert_allclose(whole.ecef[:, n], expected, atol=1e-12)
    by_moved = rng.normal(size=(2, 3, 5))
    parts = whole.by_point(by_moved), *whole.by_turns(by_moved)
    for k, step in enumerate((1e-4, 1e-6, 1e-6)):
        for axis, e in enumerate(np.eye(3)):
            ends = []
            for sign in (step, -step):
                x, r, d = (a + sign * e[:, None] * (k == j) for j, a in ((0, ecef), (1, rotation.T), (2, drift)))
                ends.append(RigidMotion(x, r.T, translation, center, np.array([0, 2, 5]), d).ecef)
            rate = (ends[0] - ends[1]) / (2 * step)
            np.testing.assert_allclose(parts[k][:, axis], (by_moved * rate).sum(axis=1), rtol=1e-6, atol=1e-7)
    still = RigidMotion(ecef, rotation, translation, center, np.array([0, 2, 5])).by_turns(by_moved)
    np.testing.assert_array_equal(*still)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-4, 0.3, 3.0])
def test_the_rotation_matrix_is_scipys(angle: float) -> None:
    vector = angle * np.array([0.6, -0.48, 0.64])
    np.testing.assert_allclose(rotation_matrix(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)


def test_a_similarity_of_the_ground_is_undone_before_the_camera_sees_it() -> None:
    rpc = make_rpc()
    xy = np.array([[3000.0, 4000.0], [12000.0, 800.0], [9000.0, 15000.0]])
    ground = rpc.localize(xy, np.array([100.0, 700.0, 400.0]))
    ecef = ecef_from_ground(ground)
    turn = 1.00003 * Rotation.from_rotvec([1e-4, 2e-4, -3e-4]).as_matrix()
    matrix = np.column_stack([turn, ecef[0] + [70.0, -20.0, 35.0] - turn @ ecef[0]])
    there = ground_from_ecef(ecef @ matrix[:, :3].T + matrix[:, 3])
    model = Corrected(rpc, correction_of(matrix, ecef[1]))
    np.testing.assert_allclose(model.project(there), xy, rtol=0, atol=1e-7)
    np.testing.assert_allclose(model.localize(xy, there[:, 2]), there, rtol=0, atol=1e-9)
    assert np.abs(model.project(ground) - xy).min() > 1


@pytest.mark.parametrize("lon", [-179.999, 5.4, 179.999])
def test_a_point_is_localised_where_the_equation_projects_it_at_its_altitude_and_longitude(lon: float) -> None:
    rpc = make_rpc(lon)
    middle = ecef_from_ground(rpc.ground_offset)
    turn, move, center = np.array([3e-6, -2e-5, 1e-5]), np.array([40.0, -25.0, 60.0]), 1.1 * middle
    camera = Corrected(rpc, Correction(turn, move, center, scale=1.00001))
    image = np.random.default_rng(4).uniform(0, 19000, (50, 2))
    alt = np.linspace(0.0, 1000.0, 50)
    ground = camera.localize(image, alt)
    np.testing.assert_array_equal(ground[:, 2], alt)
    assert np.abs(ground[:, 0] - lon).max() < 1.0  # not a turn away
    # equation 7 by scipy's rotation, and the projection of the RPC as delivered
    ecef = ecef_from_ground(ground)
    moved = 1.00001 * Rotation.from_rotvec(turn).apply(ecef - move - center) + center
    np.testing.assert_allclose(rpc.project(ground_from_ecef(moved)), image, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("change", "words"),
    [({"row_scale": 0.0}, "correction rows"), ({"row_scale": -5.0}, ""), ({"row_scale": np.inf}, "correction rows"),
     ({"row_offset": np.nan}, "correction rows"),
     ({"rotation": [1.0, 2.0]}, "rotation"), ({"rotation": [np.nan, 0.0, 0.0]}, "rotation"),
     ({"drift": np.zeros((1, 2))}, "drift"), ({"drift": np.full((1, 3), np.nan)}, "drift")],
)  # fmt: skip
def test_a_correction_is_of_finite_numbers_and_its_scale_of_rows_is_not_zero(
    change: dict[str, Any], words: str
) -> None:
    with pytest.raises(RpcError, match=words) if words else nullcontext():
        assert replace(drifting(), **change) != drifting()


def test_an_image_is_corrected_by_a_shift_and_a_slope() -> None:
    affine = ImageAffine([3.0, -4.0], [[0.01, 0.02], [-0.03, 0.04]])
    model, ground = (
        ImageCorrected(make_rpc(), affine),
        make_rpc().localize(np.array([1000.0, 500.0]), np.array(10.0)),
    )
    expected = [1000 + 3 + 0.01 * 1000 + 0.02 * 500, 500 - 4 - 0.03 * 1000 + 0.04 * 500]
    np.testing.assert_allclose(model.project(ground), expected, atol=1e-6)
    np.testing.assert_allclose(model.localize(np.array(expected), np.array(10.0)), ground, atol=1e-10)


def test_a_correction_grid_is_linear_between_its_nodes_and_constant_beyond() -> None:
    cols, rows = np.array([0.0, 10.0, 20.0]), np.array([0.0, 8.0])
    shift = np.array([[[0.0, 1.0], [1.0, 1.0], [4.0, 1.0]], [[0.0, 3.0], [1.0, 3.0], [4.0, 3.0]]])
    grid = CorrectionGrid(cols, rows, shift)
    found = grid.at(np.array([[5.0, 0.0], [15.0, 4.0], [-3.0, -3.0], [30.0, 9.0]]))
    np.testing.assert_allclose(found, [[0.5, 1.0], [2.5, 2.0], [0.0, 1.0], [4.0, 3.0]])
    np.testing.assert_allclose(grid.linearised(np.array([[5.0, 4.0]]))[1][0], [[1.1, 0.0], [0.0, 1.25]])
    np.testing.assert_allclose(grid.linearised(np.array([[10.0, 4.0]]))[1][0, 0, 0], 1.2)  # of either side
    assert np.isnan(grid.at(np.array([[np.nan, 1.0]]))).any()
    model = Displaced(make_rpc(), CorrectionGrid(cols * 1000, rows * 2000, shift))
    ground = model.localize(np.array([[4003.0, 5001.0]]), np.array([20.0]))
    np.testing.assert_allclose(model.project(ground), [[4003.0, 5001.0]], atol=1e-7)


# --- geometry ----------------------------------------------------------------------------------------------------


def test_a_grid_of_an_image_goes_from_first_to_last_centre_columns_slowest() -> None:
    image, alt = image_grid((11, 21), (0.0, 8.0), (3, 2))
    assert image[:4].tolist() == [[0, 0], [0, 0], [0, 10], [0, 10]]
    assert image[-1].tolist() == [10, 20]
    assert alt.tolist() == [0.0, 8.0] * 9
    assert len(image_grid((5, 5), (0.0, 1.0))[0]) == 11 * 11 * 5
    assert len(image_border((5, 5))) == 32
    rpc = replace(make_rpc(), ground_scale=[0.1, 0.1, -400.0])
    assert altitude_range(rpc) == (100.0, 900.0)


def test_many_radars_and_cameras_are_asked_for_their_angles_each_in_its_way(tmp_path) -> None:
    radar = MODELS["range-doppler"]().model
    at = radar.localize(np.array([9000.0, 6000.0]), np.array(100.0))
    optical = make_rpc(lon=float(at[0]), lat=float(at[1]))
    both = Several([radar, optical], [0, 1, 0])
    ground = np.array([at, at, at])
    incidence, azimuth = view_angles(both, ground)
    for n, sensor in enumerate((radar, optical, radar)):
        one = view_angles(sensor, at)
        assert (incidence[n], azimuth[n]) == pytest.approx(one, abs=1e-6)
    assert abs(incidence[0] - incidence[1]) > 5


def test_a_radar_states_its_centre_at_the_middle_of_image_and_altitudes() -> None:
    model = MODELS["range-doppler"]().model
    found = camera_center(model, model.size, (0.0, 1000.0))
    middle = model.localize((np.array(model.size) - 1) / 2, np.array(500.0))
    time, _ = model.azimuth_range(middle)
    np.testing.assert_allclose(found.ecef, model.orbit(np.array([time]))[0][:, 0], atol=1e-3)
    assert found.method == "stated"
    assert found.altitude == pytest.approx(ground_from_ecef(found.ecef)[2])
    with pytest.raises(RpcError, match="no ground point at its image's centre"):
        camera_center(model, (10, 10**8), (0.0, 1000.0))


@pytest.mark.parametrize(("rpc", "near"), [(make_rpc(), 1e-3), (tilted_rpc((1.7, 0.0)), 500.0)])
def test_a_nominal_centre_is_at_650_km_on_the_ray_of_the_middle_pixel_however_it_leans(rpc: RPC, near: float) -> None:
    """Of parallel rays, which meet nowhere; of those that lean by 60 degrees, too, though the first step is no longer
    than for 72."""
    found = camera_center(rpc, (20000, 19000), (0.0, 1000.0))
    assert found.method == "nominal"
    assert found.altitude == pytest.approx(650e3, abs=max(near, 5.0))
    origin, direction = lines_of_sight(rpc, np.array([9999.5, 9499.5]), (0.0, 1000.0))
    far = brentq(lambda s: ground_from_ecef(origin + s * direction)[2] - 650e3, 1e5, 5e6)
    assert np.linalg.norm(np.cross(found.ecef - origin, direction)) < near
    np.testing.assert_allclose(found.ecef, origin + far * direction, atol=max(near, 6.0))


# --- SICD ---------------------------------------------------------------------------------------------------------


TIME, PLACE = np.array([[3.0, 1e-4], [2e-5, 0.0]]), np.array([4e6, 5e5, 4.9e6])
FORMATIONS = {
    "polar format": PolarFormat(TIME, PLACE, [0.01, -0.003], [1.0, 0.1]),
    "range azimuth": RangeAzimuth(TIME, PLACE, 1e-6),
    "zero doppler": ZeroDoppler(TIME, [3.0, 1e-4], 8e5, [[1.0, 0.0]]),
    "image plane": ImagePlane(TIME, PLACE, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
}


@pytest.mark.parametrize(
    ("kind", "name", "wrong"),
    [
        *((kind, "time", wrong) for kind in FORMATIONS for wrong in ([1.0], [[np.nan]])),
        *((kind, "scp", [1.0, 2.0]) for kind in FORMATIONS if kind != "zero doppler"),
        *((kind, "scp", [np.inf] * 3) for kind in FORMATIONS if kind != "zero doppler"),
        ("polar format", "angle", [[1.0]]), ("polar format", "scale", 1.0), ("zero doppler", "closest_time", [[1.0]]),
        ("zero doppler", "scale", [1.0]), ("image plane", "along_x", [1.0]), ("image plane", "along_y", [np.nan] * 3),
    ],
)  # fmt: skip
def test_a_formation_of_other_numbers_is_refused(kind: str, name: str, wrong: Any) -> None:
    formation = FORMATIONS[kind]
    with pytest.raises(RpcError, match=name):
        replace(formation, **{name: wrong})
    assert not getattr(formation, name).flags.writeable


def test_each_formation_states_the_range_and_its_rate_by_its_formula() -> None:
    """SICD volume 3, section 5, for one pixel, by hand."""
    orbit = Curve.polynomial([[4.3e6, 2e5, 5.5e6], [1000.0, 7000.0, -800.0], [-3.0, 1.0, -4.0]], 0.0, 6.0)
    x, y = np.array([120.0]), np.array([-250.0])
    time = 3.0 + 1e-4 * y + 2e-5 * x
    position, velocity = orbit(time)
    sight = position[:, 0] - PLACE
    far = np.linalg.norm(sight)
    rate = velocity[:, 0] @ sight / far
    speed = np.linalg.norm(velocity)
    angle, turning = 0.01 - 0.003 * time[0], -0.003
    scale, by_angle = 1.0 + 0.1 * angle, 0.1
    along, across = x[0] * np.cos(angle) + y[0] * np.sin(angle), y[0] * np.cos(angle) - x[0] * np.sin(angle)
    point = PLACE + [x[0], y[0], 0.0]
    late = time[0] - (3.0 + 1e-4 * y[0])
    fast = np.linalg.norm(orbit(np.array([3.0 + 1e-4 * y[0]]))[1])
    near = np.hypot(8e5 + x[0], fast * late)
    expected = {
        "polar format": (far + scale * along, rate + (by_angle * along + scale * across) * turning),
        "range azimuth": (far + x[0], rate - speed * 1e-6 * y[0]),
        "zero doppler": (near, fast**2 * late / near),
        "image plane": (
            np.linalg.norm(position[:, 0] - point),
            velocity[:, 0] @ (position[:, 0] - point) / np.linalg.norm(position[:, 0] - point),
        ),
    }
    for kind, formation in FORMATIONS.items():
        found = formation.at(x, y, orbit)
        assert found.time == pytest.approx(time)
        np.testing.assert_allclose([found.distance[0], found.rate[0]], expected[kind], rtol=1e-12, err_msg=kind)
        np.testing.assert_array_equal(found.position, position)
        np.testing.assert_array_equal(found.velocity, velocity)


@pytest.mark.parametrize(
    ("change", "ok"),
    [
        ({"size": (1, 1)}, True), ({"size": (0, 5)}, False), ({"size": (1, 0)}, False),
        ({"alt_range": (3.0, 3.0)}, True), ({"alt_range": (3.0, 2.0)}, False),
        ({"spacing": (0.0, 1.0)}, False), ({"spacing": (1.0, -1.0)}, False), ({"look": "left"}, True),
        ({"look": "R"}, False), ({"look": "Left"}, False),
    ],
)  # fmt: skip
def test_a_radar_image_has_pixels_altitudes_spacing_and_a_side(change: dict[str, Any], ok: bool, tmp_path) -> None:
    for model, words in ((sicd(tmp_path), "SICD"), (MODELS["range-doppler"]().model, "Range-Doppler model")):
        if hasattr(model, *change):
            with nullcontext() if ok else pytest.raises(RpcError, match=words):
                assert replace(model, **change) != model


def sicd(folder: Any, kind: str = "PFA", change: tuple[str, str] = ("", "")) -> Monostatic:
    path, text = folder / "image.xml", document(kind)
    assert change[0] in text
    path.write_text(text.replace(*change) if change[0] else text)
    return open_sicd(path)


def test_an_image_is_believed_for_its_own_size_around_it(tmp_path) -> None:
    """One height and one width beyond each side."""
    model = sicd(tmp_path, "PLANE")
    width, height = model.size
    for image, known in (
        ((-width + 2.0, 100.0), True), ((-width - 2.0, 100.0), False), ((2 * width - 2.0, 100.0), True),
        ((2 * width + 2.0, 100.0), False), ((100.0, -height + 2.0), True), ((100.0, -height - 2.0), False),
        ((100.0, 2 * height - 2.0), True), ((100.0, 2 * height + 2.0), False),
    ):  # fmt: skip
        ground = model.localize(np.array([image]), np.array([120.0]))
        assert np.isfinite(ground).all() == known, image
        if known:
            np.testing.assert_allclose(model.project(ground), [image], atol=1e-5)


def test_the_altitudes_of_a_radar_image_are_a_kilometre_around_its_centre(tmp_path) -> None:
    model = sicd(tmp_path)
    assert model.alt_range == pytest.approx((120.0 - 1000.0, 120.0 + 1000.0), abs=1e-3)
    assert model.origin == (340, 460)
    assert model.spacing == (0.8, 0.9)
    assert model.accuracy is None
    position, _ = model.orbit(np.array([3.0]))
    ground = model.localize(np.array([460.0, 340.0]), np.array(120.0))
    np.testing.assert_allclose(model.to_radar(ground), position[:, 0] - ecef_from_ground(ground), atol=1e-3)


@pytest.mark.parametrize(("off", "ok"), [(0.9, True), (-0.9, True), (1.1, False), (-1.1, False)])
def test_the_centre_of_a_scene_is_seen_within_a_pixel_of_where_it_is_said_to_be(off: float, ok: bool, tmp_path) -> None:
    """Of an image near closest approach, whose stated range (R_CA_SCP) is moved by a part of a pixel."""
    text = document("INCA")
    begin = text.index("<R_CA_SCP>") + 10
    end = text.index("</R_CA_SCP>")
    moved = text[:begin] + repr(float(text[begin:end]) - off * 0.8) + text[end:]
    path = tmp_path / "image.xml"
    path.write_text(moved)
    if ok:
        assert open_sicd(path).size == (900, 700)
    else:
        with pytest.raises(RpcFormatError, match=r"not projected to its stated pixel \(error 1\.1"):
            open_sicd(path)


@pytest.mark.parametrize(("altitude", "ok"), [(-990.0, True), (-1010.0, False), (9490.0, True), (9510.0, False)])
def test_the_centre_of_a_scene_is_on_the_ground(altitude: float, ok: bool, tmp_path) -> None:
    path = tmp_path / "image.xml"
    path.write_text(document("PFA", ground=(5.4, 43.3, altitude)))
    if ok:
        assert np.mean(open_sicd(path).alt_range) == pytest.approx(altitude, abs=1e-3)
    else:
        with pytest.raises(RpcFormatError, match=f"is {altitude:.0f} m above the ellipsoid, not on the ground"):
            open_sicd(path)


def test_a_polynomial_of_a_document_has_powers_up_to_thirty(tmp_path) -> None:
    path, text = tmp_path / "image.xml", document("PFA")
    more = '<Coef exponent1="0" exponent2="{}">0.0</Coef></TimeCOAPoly>'
    for power, ok in (("30", True), ("31", False), ("1.0", False), ("", False), ("²", False)):
        path.write_text(text.replace("</TimeCOAPoly>", more.format(power)))
        with nullcontext() if ok else pytest.raises(RpcFormatError, match="of no power from 0 to 30"):
            assert open_sicd(path).formation.time.shape == (1, 31)
    path.write_text(text.replace("<CollectType>MONOSTATIC</CollectType>", ""))
    assert open_sicd(path) == sicd(tmp_path)
    path.write_text(text.replace("RGAZIM", "RGAZIN"))
    with pytest.raises(InputError, match="an image of the kind RGAZIN"):
        open_sicd(path)
