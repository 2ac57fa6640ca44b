"""Check points: what cameras make of them, each against its own definition."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.ba import check_residuals, split_points
from barpc.base.geodesy import ecef_from_ground, enu_basis, ground_from_ecef
from barpc.scene import GroundPoints
from barpc.sensor.corrected import Corrected
from barpc.simulate import simulate_block

MOVE = np.array([3.0, -2.0, 5.0])  # east, north, up [m]


@pytest.fixture(scope="module")
def case():
    """Exact cameras, exact image points of five points; the given places lie by `MOVE` beside the true ones."""
    block = simulate_block(3, 10, seed=1)
    sensors = [Corrected(v.sensor, c) for v, c in zip(block.views, block.truth.corrections, strict=True)]
    true = block.truth.check_ground[:5]
    given = [ground_from_ecef(ecef_from_ground(g) - enu_basis(g).T @ MOVE) for g in true]
    point = np.array([0, 0, 0, 1, 1, 2, 4, 4])  # the third seen once, the fourth never
    view = np.array([0, 1, 2, 2, 0, 1, 1, 2])
    xy = np.array([sensors[v].project(true[p]) for v, p in zip(view, point, strict=True)])
    order = np.array([3, 0, 7, 5, 1, 6, 2, 4])
    names = tuple("abcde")
    points = GroundPoints(names, given, np.ones((5, 3)), point[order], view[order], xy[order], np.full(8, 0.1))
    return sensors, points


def test_points_seen_twice_or_more_have_their_offset_and_others_none(case) -> None:
    sensors, points = case
    found = check_residuals(sensors, points)
    np.testing.assert_allclose(found.ground[[0, 1, 4]], np.tile(MOVE, (3, 1)), atol=1e-3)
    assert np.isnan(found.ground[[2, 3]]).all()
    for k in range(8):
        expected = sensors[points.view[k]].project(points.lonlatalt[points.point[k]]) - points.xy[k]
        np.testing.assert_allclose(found.image[k], expected, atol=1e-9)
    image, ground = found.rms()
    np.testing.assert_allclose(ground, np.abs(MOVE), atol=1e-3)
    np.testing.assert_allclose(image, np.sqrt((found.image**2).mean(axis=0)))


def test_points_are_divided_by_name_with_their_observations(case) -> None:
    _, points = case
    control, check = split_points(points, ["b", "e"])
    assert (control.names, check.names) == (("a", "c", "d"), ("b", "e"))
    for part in (control, check):
        for k in range(len(part.view)):
            name = part.names[part.point[k]]
            row = (points.view == part.view[k]) & (np.array(points.names)[points.point] == name)
            np.testing.assert_array_equal(part.xy[k], points.xy[row][0])
        for name, place in zip(part.names, part.lonlatalt, strict=True):
            np.testing.assert_array_equal(place, points.lonlatalt[points.names.index(name)])
    assert len(control.view) == 4
    assert len(check.view) == 4
