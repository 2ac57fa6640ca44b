"""The picture in which two images are matched densely: its rows, its columns, what resampling leaves of noise."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from barpc.tie.patches.dense import _LEFT, _SLOPE, FINER, epipolar_frame


@pytest.mark.parametrize("turn", np.radians([20.0, 100.0, 170.0, 200.0, 280.0, 350.0]))
def test_rows_of_the_frame_run_down_and_columns_to_the_right_whichever_way_the_images_are_flown(turn):
    """Epipolar lines in any direction, the second image turned against the first: rows of the frame are those of the
    images, not upside down, and an altitude is told by the disparity.
    """
    rng = np.random.default_rng(5)
    ground, alt = rng.uniform(0.0, 400.0, (60, 2)), np.repeat([0.0, 50.0, 100.0], 20)
    along = np.array([np.cos(turn), np.sin(turn)])
    rotated = np.array([[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]])
    a, b = ground + 0.1 * alt[:, None] * along, (ground - 0.2 * alt[:, None] * along) @ rotated.T
    frame = epipolar_frame(a, b, alt)
    assert frame.across < 1e-9
    first, second = (points @ one[:, :2].T + one[:, 2] for points, one in zip((a, b), frame.maps, strict=True))
    across = np.array([-along[1], along[0]]) * np.sign(along[0])
    for one, angle in zip(frame.maps, (np.eye(2), rotated), strict=True):
        np.testing.assert_allclose(one[1, :2], angle @ across, atol=1e-9)
        assert np.linalg.det(one[:, :2]) > 0.0
    np.testing.assert_allclose(first[:, 1], second[:, 1], atol=1e-9)
    disparity = first[:, 0] - second[:, 0]
    assert disparity.min() == pytest.approx(FINER, abs=1.0)
    assert frame.num - 16 < disparity.max() + 2 * FINER <= frame.num
    np.testing.assert_allclose(np.column_stack([first, disparity, np.ones(60)]) @ frame.altitude, alt, atol=1e-6)


def test_what_resampling_leaves_of_noise_is_what_sigma_takes_for_it():
    noise = np.random.default_rng(3).standard_normal((700, 700)).astype(np.float32)
    found = []
    for turn in (0.1, 0.5, 0.8, 1.2, 2.0):
        along = FINER * np.array([np.cos(turn), np.sin(turn)])
        to_frame = np.array([[*along, 500.3], [-along[1] / FINER, along[0] / FINER, 350.2]])
        moved = cv2.warpAffine(noise, to_frame, (1000, 700), flags=cv2.INTER_CUBIC)
        inside = cv2.erode(cv2.warpAffine(np.ones_like(noise), to_frame, (1000, 700)), np.ones((9, 9))) > 0.999
        found.append([moved[inside].var(), np.gradient(moved, axis=1)[inside].var()])
    np.testing.assert_allclose(np.mean(found, axis=0), [_LEFT, _SLOPE], rtol=0.03)
