"""Dense matching on channels: blind to grey values, exact to a fraction of a pixel, and honest by its decoys."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import ndimage

from barpc.tie.patches.channels import INVALID_MARGIN, channels, correlation
from barpc.tie.patches.channels import picture as resampled
from barpc.tie.patches.oriented import PatchTile
from tests.geotiffs import write_image

SIZE = 256
SHIFT = np.array([3.3, -2.6])
HALF, SEARCH = 16, 10


class Found:
    """What a template is found by, written out as a caller asks for it."""

    def __init__(self, first: np.ndarray, second: np.ndarray, at: np.ndarray, half: int, search: int) -> None:
        tile = PatchTile.same((first, second), at, search, half)
        place, self.known, self.score = tile.found()
        self.shift, self.decoy, self.back = place - at, tile.decoys(), tile.returns(place)

    def passed(self, margin: float) -> np.ndarray:
        return self.known & self.back & (self.score > self.decoy + margin)


find = Found


def margin(half: int, search: int) -> int:
    """Where decoys end."""
    return half + 3 * search + INVALID_MARGIN


def texture(seed: int, size: int = SIZE) -> np.ndarray:
    rng = np.random.default_rng(seed)
    parts = [rng.normal(size=(size, size)).astype(np.float32) for _ in range(2)]
    return 10 * cv2.GaussianBlur(parts[0], (0, 0), 1.5) + 40 * cv2.GaussianBlur(parts[1], (0, 0), 6)


def moved(picture: np.ndarray) -> np.ndarray:
    return ndimage.shift(picture, SHIFT[::-1], order=5, mode="grid-wrap")


def places(size: int = SIZE) -> np.ndarray:
    edge = margin(HALF, SEARCH)
    axis = np.arange(edge, size - edge, 8)
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def seen(picture: np.ndarray) -> np.ndarray:
    return channels(picture, np.ones(picture.shape, dtype=bool))


@pytest.mark.parametrize(
    "date",
    [
        pytest.param(lambda grey: grey, id="same", marks=pytest.mark.slow),
        pytest.param(lambda grey: 500 - 3 * grey, id="inverted", marks=pytest.mark.slow),
        pytest.param(lambda grey: np.where(np.indices(grey.shape)[1] > SIZE // 2, -grey, 0.2 * grey), id="partly"),
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


@pytest.mark.slow
def test_what_is_not_there_does_not_beat_its_decoy():
    found = find(seen(texture(1)), seen(texture(3)), places(), HALF, SEARCH)
    won = found.score > found.decoy
    assert 0.3 < won.mean() < 0.7  # a coin's toss
    assert found.passed(0.1).mean() < 0.05


@pytest.mark.slow
def test_beyond_the_search_nothing_is_found():
    picture = texture(1)
    there = np.roll(moved(picture), 14, axis=1)
    found = find(seen(picture), seen(there), places(), HALF, SEARCH)
    assert found.passed(0.1).mean() < 0.05


def test_where_half_is_missing_the_rest_is_found_and_the_hole_is_not():
    picture, valid = texture(1), np.ones((SIZE, SIZE), dtype=bool)
    valid[:, : SIZE // 2] = False
    at = places()
    found = find(seen(picture), channels(moved(picture), valid), at, HALF, SEARCH)
    passed = found.passed(0.1)
    assert not passed[at[:, 0] < SIZE // 2 - HALF].any()
    assert passed[at[:, 0] > SIZE // 2 + HALF + SEARCH + 6].mean() > 0.95


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


# --- pieces -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("slope", "direction"),
    [
        ((2.0, 0.0), (1, 0)),
        ((-2.0, 0.0), (1, 0)),
        ((0.0, 5.0), (-1, 0)),
        ((3.0, 3.0), (0, 1)),
        ((-3.0, 3.0), (0, -1)),
    ],
)
def test_a_channel_is_twice_the_angle_of_the_gradient_less_a_third_for_noise(slope, direction):
    """Of an even slope: what is as strong as the median keeps 1 / (1 + 1/2)."""
    row, col = np.mgrid[:60, :80].astype(np.float32)
    found = channels(slope[0] * col + slope[1] * row, np.ones((60, 80), dtype=bool))
    inner = found[:, 8:-8, 8:-8]
    np.testing.assert_allclose(inner[0], direction[0] / 1.5, atol=1e-3)
    np.testing.assert_allclose(inner[1], direction[1] / 1.5, atol=1e-3)


def test_weak_gradients_say_less_than_the_median_and_strong_ones_more():
    col = np.indices((60, 120))[1].astype(np.float32)
    picture = np.where(col < 70, 3.0 * col, 210.0 + np.maximum(col - 70, 0) * 0.3)
    found = channels(picture, np.ones((60, 120), dtype=bool))
    assert found[0, 30, 30] == pytest.approx(1 / 1.5, abs=0.01)  # more than half of the picture is so
    assert found[0, 30, 100] == pytest.approx(0.1 / 0.6, abs=0.01)


def test_six_pixels_beside_what_is_not_valid_say_nothing_and_the_next_does():
    valid = np.ones((61, 81), dtype=bool)
    valid[30, 40] = False
    picture = texture(1, 81)[:61].copy()
    whole = channels(picture, np.ones_like(valid))
    picture[30, 40] = 1e4
    found = channels(picture, valid)
    near = np.zeros_like(valid)
    near[24:37, 34:47] = True
    np.testing.assert_array_equal(np.abs(found).sum(axis=0) == 0, near)
    np.testing.assert_allclose(found[:, 20, 20], whole[:, 20, 20], atol=0.02)
    assert np.abs(found[:, :, :6]).sum() > 0  # the picture's own edge is none


def test_where_little_is_a_correlation_is_of_a_fiftieth_of_the_template_at_least():
    template = np.ones((1, 1, 3, 3), np.float32)
    area = np.zeros((1, 1, 3, 5), np.float32)
    area[0, 0, 1, 1] = 0.3  # 0.09 of energy beside 0.02 * 9
    expected = 0.3 / np.sqrt(0.18 * 9)
    np.testing.assert_allclose(correlation(template, area)[0, 0], [expected, expected, 0.0], atol=1e-6)
    area[0, 0, 1, 1] = 0.5  # 0.25: more
    expected = 0.5 / np.sqrt(0.25 * 9)
    np.testing.assert_allclose(correlation(template, area)[0, 0], [expected, expected, 0.0], atol=1e-6)


def test_nothing_that_is_looked_at_lies_beyond_the_margin():
    """The decoy's far end: the template, three searches, and what is between."""
    edge = margin(8, 4)
    picture = seen(texture(1, 2 * edge + 1))
    corner = np.array([[edge, edge]])
    whole = find(picture, picture, corner, 8, 4)
    np.testing.assert_allclose(whole.shift, 0.0, atol=0.02)
    assert whole.score[0] == pytest.approx(1.0, abs=1e-5)
    assert whole.back.all()
    assert whole.known.all()


@pytest.mark.parametrize("shift", [(3, -2), (-4, 1), (0, 4)])
def test_whole_pixels_are_found_to_either_side_on_either_decoys_side(shift):
    """Points in turn have their decoys to the right and to the left; a place on the search's edge is no peak."""
    picture = texture(1, 140)
    there = np.roll(picture, shift[::-1], axis=(0, 1))
    at = np.array([[60, 60], [75, 60], [60, 77], [81, 70]])
    found = find(seen(picture), seen(there), at, HALF, 5)
    np.testing.assert_allclose(found.shift, np.tile(shift, (4, 1)), atol=0.01)
    assert found.passed(0.1).all()
    assert (found.decoy < 0.7).all()
    edge = find(seen(picture), seen(there), at, HALF, max(map(abs, shift)))
    assert not edge.known.any()


@pytest.mark.parametrize("step", [1.5, 2.9])
def test_a_finer_picture_is_averaged_alike_along_both_axes(tmp_path, step):
    """White noise, seen on a grid so many pixels apart: less of it, and as much across as down."""
    grey = np.random.default_rng(3).normal(1000.0, 100.0, (400, 400))
    path = write_image(tmp_path / "a.tif", grey.astype(np.uint16))
    ticks = 20.0 + 8.0 * step * np.arange(15)  # nodes every eighth
    nodes = np.stack(np.meshgrid(ticks, ticks), axis=-1)
    found, valid = resampled(str(path), (1,), (400, 400), nodes, (113, 113))
    assert valid.all()
    across, down = (np.diff(found, axis=axis).std() for axis in (1, 0))
    assert across == pytest.approx(down, rel=0.1)
    plain, _ = resampled(str(path), (1,), (400, 400), nodes / step, (113, 113))
    assert found.std() < 0.75 * plain.std()
