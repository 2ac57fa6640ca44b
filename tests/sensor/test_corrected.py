"""P_BA and its derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from barpc.base.errors import RpcError
from barpc.base.geodesy import ecef_from_ground, ground_from_ecef
from barpc.sensor.corrected import Corrected, Correction, correction_of
from barpc.sensor.curve import rotation_matrix

from .conftest import make_rpc


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-4, 0.3, 3.0])
def test_the_rotation_matrix_is_scipys(angle):
    vector = angle * np.array([0.6, -0.48, 0.64])
    np.testing.assert_allclose(rotation_matrix(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)


@pytest.mark.parametrize("bad", [[1.0, 2.0], [np.nan, 0.0, 0.0]])
def test_a_correction_that_is_not_three_finite_numbers_is_refused(bad):
    with pytest.raises(RpcError, match="rotation"):
        Correction(bad, np.zeros(3), np.zeros(3))


def test_a_similarity_of_the_ground_is_undone_before_the_camera_sees_it():
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
def test_a_point_is_localised_where_the_equation_projects_it_at_its_altitude_and_longitude(lon):
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
