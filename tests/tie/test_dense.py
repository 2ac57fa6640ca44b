"""The picture in which two images are matched densely: its rows, its columns, what resampling leaves of noise."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from barpc.tie.patches.dense import (
    COLUMNS_PER_PIXEL,
    NOISE_VARIANCE,
    SLOPE_VARIANCE,
    dense_matches,
    epipolar_frame,
    refined_disparity,
)
from tests.geotiffs import write_image


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
    assert disparity.min() == pytest.approx(COLUMNS_PER_PIXEL, abs=1.0)
    assert frame.num - 16 < disparity.max() + 2 * COLUMNS_PER_PIXEL <= frame.num
    np.testing.assert_allclose(np.column_stack([first, disparity, np.ones(60)]) @ frame.altitude, alt, atol=1e-6)


def test_a_part_of_two_images_is_matched_where_it_was_asked_and_not_beside(tmp_path):
    """A level plain, 100 m up: the second image shows it two columns further for every ten metres of altitude."""
    noise = np.random.default_rng(7).standard_normal((240, 320)).astype(np.float32)
    ground = cv2.GaussianBlur(noise, (0, 0), 1.5) * 300.0 + 1000.0
    write_image(tmp_path / "a.tif", ground[:, 20:].astype(np.uint16))
    write_image(tmp_path / "b.tif", ground[:, :-20].astype(np.uint16))
    places = np.stack(np.meshgrid([80.0, 140.0, 200.0], [60.0, 110.0, 160.0]), axis=-1).reshape(-1, 2)
    alt = np.repeat([0.0, 100.0, 200.0], 9)
    a = np.tile(places, (3, 1))
    frame = epipolar_frame(a, a + np.column_stack([0.2 * alt, np.zeros(27)]), alt)
    found = dense_matches([str(tmp_path / name) for name in ("a.tif", "b.tif")], [(300, 240)] * 2, frame, 1)
    assert found is not None
    assert len(found.a) > 0.8 * 120 * 100
    assert found.a.min(axis=0) == pytest.approx([80.0, 60.0], abs=2.0)
    assert found.a.max(axis=0) == pytest.approx([200.0, 160.0], abs=2.0)
    assert np.median(np.abs(found.b - found.a - [20.0, 0.0]), axis=0) == pytest.approx(0.0, abs=0.1)
    assert np.median(found.alt) == pytest.approx(100.0, abs=1.0)
    assert frame.metres == pytest.approx(5.0)


@pytest.mark.parametrize(("off", "met"), [(0.0, True), (-5.0, True), (5.0, True), (-16.0, False), (20.0, False)])
def test_a_slope_is_found_about_a_coarser_surface(tmp_path, off, met):
    """Every pixel is a quarter of one farther in the second image; one coarse match of 199 is wrong by far.

    Of 160 columns, two a pixel, no more than 64 are searched: what lies beyond is not met.
    """
    rng = np.random.default_rng(7)
    ground = cv2.GaussianBlur(rng.standard_normal((240, 320)).astype(np.float32), (0, 0), 1.5) * 300.0 + 1000.0
    col, row = np.meshgrid(np.arange(380, dtype=np.float32), np.arange(240, dtype=np.float32))
    write_image(tmp_path / "a.tif", ground.astype(np.uint16))
    write_image(tmp_path / "b.tif", cv2.remap(ground, (col - 10.0) / 1.25, row, cv2.INTER_CUBIC).astype(np.uint16))
    places = np.stack(np.meshgrid([80.0, 140.0, 200.0], [60.0, 110.0, 160.0]), axis=-1).reshape(-1, 2)
    alt, a = np.repeat([0.0, 200.0, 400.0], 9), np.tile(places, (3, 1))
    frame = epipolar_frame(a, a + np.column_stack([0.2 * alt, np.zeros(27)]), alt)
    near = np.stack(np.meshgrid(np.arange(60.0, 220.0, 2.0), np.arange(40.0, 180.0, 2.0)), axis=-1).reshape(-1, 2)
    shift = 10.0 + 0.25 * near[:, 0] + rng.normal(0.0, 0.5, len(near)) + off
    shift[::199] += 30.0
    coarse = near, near + np.column_stack([shift, np.zeros(len(near))]), 2.0
    assert frame.num >= 160
    paths, sizes = [str(tmp_path / name) for name in ("a.tif", "b.tif")], [(320, 240), (380, 240)]
    found = dense_matches(paths, sizes, frame, 1, coarse=coarse)
    right = np.abs(found.b - found.a - np.column_stack([10.0 + 0.25 * found.a[:, 0], np.zeros(len(found.a))])) < 0.3
    share = right.all(axis=1).sum() / (120 * 100)
    assert (share > 0.8) if met else (share < 0.1)


@pytest.mark.parametrize("off", [-2.0, 2.0])
def test_a_step_of_least_squares_moves_no_match_by_more_than_a_column(off):
    rng = np.random.default_rng(5)
    left = cv2.GaussianBlur(rng.uniform(0, 255, (60, 90)).astype(np.float32), (0, 0), 4.0)
    left = cv2.normalize(left, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    right = np.roll(left, -5, axis=1)
    given = np.full(left.shape, 5.0 + off, np.float32)
    found = refined_disparity(left, right, given, np.ones(left.shape, dtype=bool))[0][10:-10, 10:-10] - 5.0
    assert np.abs(found - off).max() <= 1.0
    assert np.median(found) == pytest.approx(0.5 * off)  # towards the right place, as far as it may
    exact = refined_disparity(left, right, given - off, np.ones(left.shape, dtype=bool))[0][10:-10, 10:-10]
    assert np.abs(exact - 5.0).max() < 0.1


def test_rows_are_refined_alike_however_many_are_worked_on_together(sized):
    rng = np.random.default_rng(6)
    left = cv2.GaussianBlur(rng.uniform(0, 255, (70, 91)).astype(np.float32), (0, 0), 1.0).astype(np.uint8)
    good, disparity = rng.random(left.shape) < 0.8, rng.normal(5.0, 0.3, left.shape).astype(np.float32)
    found = []
    for rows in (70, 64, 8):
        sized(rows_refined=rows)
        found.append(refined_disparity(left, np.roll(left, -5, axis=1), disparity, good))
    assert found[0].shape == (2, 70, 46)
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], rtol=1e-4, atol=1e-4)


def test_what_resampling_leaves_of_noise_is_what_sigma_takes_for_it():
    noise = np.random.default_rng(3).standard_normal((700, 700)).astype(np.float32)
    found = []
    for turn in (0.1, 0.5, 0.8, 1.2, 2.0):
        along = COLUMNS_PER_PIXEL * np.array([np.cos(turn), np.sin(turn)])
        to_frame = np.array([[*along, 500.3], [-along[1] / COLUMNS_PER_PIXEL, along[0] / COLUMNS_PER_PIXEL, 350.2]])
        moved = cv2.warpAffine(noise, to_frame, (1000, 700), flags=cv2.INTER_CUBIC)
        inside = cv2.erode(cv2.warpAffine(np.ones_like(noise), to_frame, (1000, 700)), np.ones((9, 9))) > 0.999
        found.append([moved[inside].var(), np.gradient(moved, axis=1)[inside].var()])
    np.testing.assert_allclose(np.mean(found, axis=0), [NOISE_VARIANCE, SLOPE_VARIANCE], rtol=0.03)


@pytest.mark.parametrize(("gain", "offset", "lost"), [(0.7, 40.0, 0.0), (1.3, -40.0, 0.0), (1.3, -40.0, 0.4)])
def test_a_step_finds_the_place_between_columns_and_says_how_well_whatever_gain_and_offset(gain, offset, lost):
    """What is said is larger than what is off: it is of pictures that were resampled, which halves their noise."""
    rng = np.random.default_rng(1)
    texture = cv2.GaussianBlur(rng.standard_normal((120, 400)).astype(np.float32), (0, 0), 3.0)
    texture *= 25.0 / texture.std()
    cols, rows = np.meshgrid(np.arange(400, dtype=np.float32), np.arange(120, dtype=np.float32))
    moved = cv2.remap(texture, cols + 5.3, rows, cv2.INTER_LANCZOS4)
    pictures = [100.0 + texture, offset + gain * (100.0 + moved)]
    noisy = [np.clip(np.rint(one + 2.0 * rng.standard_normal(one.shape)), 0, 255).astype(np.uint8) for one in pictures]
    good = rng.random(texture.shape) >= lost  # what is not matched is anywhere
    found, sigma = refined_disparity(*noisy, np.where(good, 5.0, 70.0).astype(np.float32), good)
    inner = np.pad(good[15:-15, 40:-40], ((15, 15), (40, 40)))[:, ::COLUMNS_PER_PIXEL]
    off, said = found[inner] - 5.3, COLUMNS_PER_PIXEL * np.median(sigma[inner])
    assert abs(off.mean()) < 0.06
    assert off.std() < 0.12
    assert 1.2 < said / off.std() < 1.9
