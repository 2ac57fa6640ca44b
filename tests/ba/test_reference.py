"""Control of a reference: many points that share errors hold a block, and do not know more than these allow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks
from barpc.ba.constraints.ground import MAX_INDEPENDENT_ERRORS, reference_control
from barpc.base.geodesy import ecef_from_ground, enu_basis, ground_from_ecef, metres_per_unit
from barpc.scene import GroundPoints, Reference
from barpc.simulate import simulate_block
from tests.lanes import rest_slow

BIAS = np.array([0.5, 0.5, 5.0])
POINT = np.array([0.05, 0.05, 10.0])
ALT = 240.0


@pytest.fixture(scope="module")
def block():
    return simulate_block(3, 600, seed=4, num_gcps=400, attitude=60e-6, alt_range=(ALT - 1.0, ALT + 1.0))


def reference_of(block, shift=(0.0, 0.0, 0.0), noise=0.3, offset=(40.0, 0.0)) -> Reference:
    """The block's exact points, all of them given wrongly by `shift` (east, north, up) [m]."""
    gcps = block.gcps
    place = gcps.lonlatalt + np.array(shift) / metres_per_unit(gcps.lonlatalt)
    points = GroundPoints(
        gcps.names,
        place,
        np.tile(POINT, (len(place), 1)),
        gcps.point,
        gcps.view,
        gcps.xy,
        np.full(len(gcps.view), noise),
    )
    return Reference(points, BIAS, np.tile(offset, (len(block.views), 1)))


def level(lon, lat):
    return np.full(np.shape(lon), ALT)


def adjusted(block, reference, **options):
    return adjust_tracks(
        block.views, block.tracks, AdjustOptions(**options), dem=level, reference=reference, hold_out=False
    )


def move(found, block) -> np.ndarray:
    """Mean error of the tie points, east, north, up (3,) [m]."""
    known = np.isfinite(found.points[:, 0])
    offset = (found.points - ecef_from_ground(block.truth.ground))[known].mean(axis=0)
    return enu_basis(block.truth.ground.mean(axis=0)) @ offset


@pytest.mark.slow
def test_the_scene_comes_to_where_the_reference_says(block):
    alone = adjust_tracks(block.views, block.tracks, hold_out=False)
    assert np.abs(move(alone, block)).max() > 10.0
    found = adjusted(block, reference_of(block))
    assert (np.abs(move(found, block)) < [0.1, 0.1, 1.5]).all()
    assert found.reference_inlier.mean() > 0.97


@pytest.mark.slow
@pytest.mark.parametrize("shift", rest_slow([(3.0, -2.0), (-0.7, 0.4)]))
def test_what_a_reference_is_wrong_by_moves_the_scene_and_is_stated(block, shift):
    free, moved = (adjusted(block, reference_of(block, (*there, 0.0))) for there in ((0.0, 0.0), shift))
    went = move(moved, block) - move(free, block)
    assert went[:2] == pytest.approx(shift, rel=0.05)
    assert moved.gauge.sigma[:2] == pytest.approx(BIAS[:2], rel=0.1)
    assert 0.95 * BIAS[2] < moved.gauge.sigma[2] < 1.3 * BIAS[2]


@pytest.mark.slow
def test_points_that_disagree_are_cut_by_themselves(block):
    reference = reference_of(block)
    wrong = np.arange(len(reference.points.view)) % 20 == 0
    xy = reference.points.xy + np.outer(wrong, [8.0, 0.0])  # across the lines of sight: no height explains it
    found = adjusted(block, replace(reference, points=replace(reference.points, xy=xy)))
    assert not found.reference_inlier[wrong].any()
    assert found.reference_inlier[~wrong].mean() > 0.95
    assert np.abs(move(found, block)[:2]).max() < 0.15


@pytest.mark.slow
def test_many_points_know_no_more_than_a_few_would():
    """With ten times the points heights and images are known no better, once there are more than are alike."""
    sigmas = []
    for count in (150, 1500):
        block = simulate_block(3, 200, seed=4, num_gcps=count, alt_range=(ALT - 1.0, ALT + 1.0))
        found = adjusted(block, reference_of(block), noise_floor=0.05)
        sigmas.append([*found.gauge.sigma, *found.gauge.motion_sigma[3:6]])
    assert sigmas[1] == pytest.approx(sigmas[0], rel=0.15)


def test_common_errors_are_the_terrain_s_the_orthoimage_s_and_what_stands_on_it(block):
    reference = reference_of(block)
    n = len(reference.points.names)
    prior = reference_control(reference, np.arange(n))
    points = ecef_from_ground(reference.points.lonlatalt)
    up = POINT[2] * np.sqrt(n / MAX_INDEPENDENT_ERRORS)
    assert 1.0 / np.linalg.norm(prior.rows[0], axis=1) == pytest.approx([POINT[0], POINT[1], up])
    middle = ground_from_ecef(points.mean(axis=0))
    for axis, columns in ((0, [3]), (1, [4]), (2, [0, 5])):
        move = np.eye(3)[axis] @ enu_basis(middle)
        whitened = prior.apart(points + move)
        for column in columns:
            size = {3: BIAS[0], 4: BIAS[1], 0: BIAS[2], 5: POINT[2]}[column]
            assert size * whitened[:, axis] == pytest.approx(prior.common[:, axis, column], rel=1e-3)
            assert not np.delete(prior.common[:, :, column], axis, axis=1).any()
    edge = np.abs(prior.common[:, 2, 1:3]).max(axis=0) * up
    assert edge == pytest.approx([BIAS[2], BIAS[2]], rel=1e-6)
