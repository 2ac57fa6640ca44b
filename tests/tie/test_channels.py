"""Dense matching on channels: blind to grey values, exact to a fraction of a pixel, and honest by its decoys."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import ndimage

from barpc.tie.channels import channels, correlation, find, margin

SHIFT = np.array([3.3, -2.6])
HALF, SEARCH = 16, 10


def texture(seed: int, size: int = 320) -> np.ndarray:
    rng = np.random.default_rng(seed)
    parts = [rng.normal(size=(size, size)).astype(np.float32) for _ in range(2)]
    return 10 * cv2.GaussianBlur(parts[0], (0, 0), 1.5) + 40 * cv2.GaussianBlur(parts[1], (0, 0), 6)


def moved(picture: np.ndarray) -> np.ndarray:
    return ndimage.shift(picture, SHIFT[::-1], order=5, mode="grid-wrap")


def places(size: int = 320) -> np.ndarray:
    edge = margin(HALF, SEARCH)
    axis = np.arange(edge, size - edge, 8)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def seen(picture: np.ndarray) -> np.ndarray:
    return channels(picture, np.ones(picture.shape, dtype=bool))


@pytest.mark.parametrize(
    "date",
    [
        pytest.param(lambda grey: grey, id="same"),
        pytest.param(lambda grey: 500 - 3 * grey, id="inverted"),
        pytest.param(lambda grey: np.where(np.indices(grey.shape)[1] > 160, -grey, 0.2 * grey), id="partly"),
    ],
)
def test_a_shift_is_found_whatever_the_grey_values(date):
    picture = texture(1)
    noise = 0.5 * np.random.default_rng(2).normal(size=picture.shape).astype(np.float32)
    found = find(seen(picture), seen(date(moved(picture)).astype(np.float32) + noise), places(), HALF, SEARCH)
    passed = found.passed(0.1)
    assert passed.mean() > 0.97
    error = found.shift[passed] - SHIFT
    assert (np.abs(np.median(error, axis=0)) < 0.03).all()
    assert np.quantile(np.abs(error), 0.95) < 0.25


def test_what_is_not_there_does_not_beat_its_decoy():
    found = find(seen(texture(1)), seen(texture(3)), places(), HALF, SEARCH)
    won = found.score > found.decoy
    assert 0.3 < won.mean() < 0.7  # a coin's toss
    assert found.passed(0.1).mean() < 0.05


def test_beyond_the_search_nothing_is_found():
    picture = texture(1)
    there = np.roll(moved(picture), 14, axis=1)
    found = find(seen(picture), seen(there), places(), HALF, SEARCH)
    assert found.passed(0.1).mean() < 0.05


def test_where_half_is_missing_the_rest_is_found_and_the_hole_is_not():
    picture, valid = texture(1), np.ones((320, 320), dtype=bool)
    valid[:, :160] = False
    at = places()
    found = find(seen(picture), channels(moved(picture), valid), at, HALF, SEARCH)
    passed = found.passed(0.1)
    assert not passed[at[:, 0] < 160 - HALF].any()
    assert passed[at[:, 0] > 160 + HALF + SEARCH + 6].mean() > 0.95


def test_the_correlation_is_the_coefficient_written_out():
    rng = np.random.default_rng(0)
    template, area = (rng.normal(size=(2, 3, n, n)).astype(np.float32) for n in (5, 9))
    found = correlation(template, area)
    assert found.shape == (2, 5, 5)
    for b, row, col in ((0, 0, 0), (1, 4, 2), (0, 2, 4)):
        here = area[b, :, row : row + 5, col : col + 5]
        wanted = (here * template[b]).sum() / np.sqrt((here**2).sum() * (template[b] ** 2).sum())
        assert found[b, row, col] == pytest.approx(wanted, abs=1e-5)


def test_nothing_is_zeros():
    empty = channels(np.zeros((64, 64), np.float32), np.ones((64, 64), dtype=bool))
    assert not empty.any()
    assert not correlation(empty[None, :, :9, :9], empty[None]).any()
