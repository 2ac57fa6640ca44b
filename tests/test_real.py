"""The check points of real images are in no favour of either camera: no matter how the images are turned."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.real import features, matched


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_check_points_are_at_the_same_place_in_a_turned_image(turns: int) -> None:
    texture = np.random.default_rng(4).normal(size=(40, 48)).repeat(6, axis=0).repeat(6, axis=1)
    for axis in (0, 1):  # blurred: keypoints of several sizes
        for _ in range(3):
            texture = (np.roll(texture, 1, axis) + texture + np.roll(texture, -1, axis)) / 3
    grey = np.clip(128 + 40 * texture, 0, 255).astype(np.uint8)
    rows = matched(features(grey), features(np.ascontiguousarray(np.rot90(grey, turns))))
    height, width = grey.shape
    col, row, *other = rows.T
    right = [(col, row), (row, width - 1 - col), (width - 1 - col, height - 1 - row), (height - 1 - row, col)][turns]
    assert len(rows) > 100
    off = np.array(other) - right
    assert np.abs(np.median(off, axis=1)).max() < 0.02
    assert np.median(np.abs(off)) < 0.1
