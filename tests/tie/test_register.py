"""Registration of patches: exact on what is known, and sure to say when it failed."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import ndimage

from barpc.tie.patches import register
from barpc.tie.patches.register import _Template, _with_derivatives, register_patches, register_places, upsampled
from barpc.tie.pixels import PixelReader
from tests.constants import Sized
from tests.geotiffs import write_image
from tests.lanes import diagonal

SIZE = 400


@pytest.fixture(scope="module")
def texture() -> np.ndarray:
    noise = np.random.default_rng(2).normal(0, 1, (SIZE, SIZE))
    return (1000 + 800 * ndimage.gaussian_filter(noise, 1.5)).astype(np.float32)


def warped(image: np.ndarray, linear: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """other(linear @ (x - c) + c + shift) = image(x), by a quintic spline."""
    c = np.full(2, SIZE / 2)
    inverse = np.linalg.inv(linear)
    grid = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1).reshape(-1, 2)
    source = (grid - c - shift) @ inverse.T + c
    return (
        ndimage.map_coordinates(image.astype(np.float64), source[:, ::-1].T, order=5)
        .reshape(SIZE, SIZE)
        .astype(np.float32)
    )


def run(first, second, reference, start, linear, patch: int = 21, valid=None):
    valid = valid if valid is not None else np.ones((SIZE, SIZE), bool)
    many = np.broadcast_to(linear, (len(reference), 2, 2)).copy()
    return register_patches((first, second), (valid, valid), reference, start, many, patch)


@pytest.fixture(scope="module")
def reference() -> np.ndarray:
    return np.random.default_rng(3).integers(80, SIZE - 80, (300, 2)).astype(np.float64)


@pytest.mark.parametrize(
    ("linear", "shift"),
    diagonal(
        [np.eye(2), np.array([[1.04, 0.02], [-0.03, 0.97]]), np.array([[0.9, 0.15], [0.0, 1.0]])],
        [(0.0, 0.0), (0.5, -0.25), (-0.9, 0.7)],
    ),
)
def test_a_known_affine_map_is_found_to_a_hundredth_of_a_pixel(texture, reference, linear, shift) -> None:
    other = warped(texture, linear, np.array(shift))
    centre = np.full(2, SIZE / 2)
    truth = (reference - centre) @ linear.T + centre + shift
    start = truth + np.random.default_rng(4).uniform(-0.5, 0.5, truth.shape)
    found = run(texture, other, reference, start, np.eye(2) if shift == (0.0, 0.0) else linear)
    error = (found.xy - truth)[found.ok]
    assert found.ok.mean() > 0.95
    assert np.sqrt((error**2).mean()) < 0.01
    assert np.abs(error.mean(axis=0)).max() < 0.001


def fine_means(fine: np.ndarray, begin: int) -> np.ndarray:
    """Means of 5 x 5 px, from column and row `begin` on: nothing is interpolated."""
    part = fine[begin : begin + 5 * 160, begin : begin + 5 * 160]
    return part.reshape(160, 5, 160, 5).mean(axis=(1, 3)).astype(np.float32)


@pytest.mark.parametrize("begin", [1, 4])
def test_no_phase_of_a_pixel_pulls_either_way(begin) -> None:
    """Two pictures by pixels of one scene, a fifth of a pixel apart; left and right exchanged; below 0.002 px."""
    noise = np.random.default_rng(8).normal(size=(810, 810))
    fine = ndimage.gaussian_filter(noise, 0.58 * 5) + 2.0 * ndimage.gaussian_filter(noise, 8.0)
    first, second = fine_means(1e3 * fine, 0), fine_means(1e3 * fine, begin)
    at = np.stack(np.meshgrid(*[np.arange(24.0, 140.0, 10.0)] * 2), axis=-1).reshape(-1, 2)
    for pair, truth in (((first, second), at - begin / 5), ((second, first), at + begin / 5)):
        valid = np.ones(first.shape, bool)
        found = run(*pair, at, at.copy(), np.eye(2), valid=valid)
        error = (found.xy - truth)[found.ok]
        assert found.ok.mean() > 0.95
        assert np.abs(error.mean(axis=0)).max() < 0.002
        assert error.std() < 0.005


def test_the_correlation_told_is_that_of_the_patches(texture, reference) -> None:
    """Of an image moved by whole pixels, noisy and of another contrast, whose patches need no interpolation."""
    noise = np.random.default_rng(6).normal(0, 0.35 * texture.std(), texture.shape)
    other = (500 + 0.6 * np.roll(texture + noise, (2, 3), axis=(0, 1))).astype(np.float32)
    found = run(texture, other, reference, reference + (3.2, 2.1), np.eye(2))
    y, x = np.mgrid[-10:11, -10:11]
    weight = np.exp(-0.5 * (x**2 + y**2) / 7.0**2)
    weight /= weight.sum()
    told = []
    for col, row in reference[found.ok].astype(int):
        a, b = texture[row + y, col + x].astype(float), other[row + 2 + y, col + 3 + x].astype(float)
        a, b = a - (weight * a).sum(), b - (weight * b).sum()
        told.append((weight * a * b).sum() / np.sqrt((weight * a * a).sum() * (weight * b * b).sum()))
    assert found.ok.mean() > 0.9
    assert found.correlation[found.ok].max() < 1.0
    off = found.correlation[found.ok] - told  # six unknowns fit a little of the noise, too
    assert 0.0 <= np.median(off) < 0.01
    assert np.abs(off).max() < 0.05


@pytest.mark.few(1)
@pytest.mark.parametrize("zoom", [1.0, 1.3])
def test_enough_is_read_about_a_place_for_the_patch_and_its_interpolation(texture, tmp_path, zoom) -> None:
    """One place at a time, from files, is registered as in the whole images."""
    first = np.rint(texture)
    second = np.rint(warped(first, zoom * np.eye(2), np.array([0.4, -0.3])))
    files = []
    for name, image in (("a.tif", first), ("b.tif", second)):
        write_image(tmp_path / name, image.astype(np.uint16))
        files.append((str(tmp_path / name), (SIZE, SIZE)))
    places = np.random.default_rng(5).integers(120, SIZE - 120, (20, 2)).astype(np.float64)
    start = (places - SIZE / 2) * zoom + SIZE / 2 + [0.9, -0.8]
    many = np.broadcast_to(zoom * np.eye(2), (20, 2, 2))
    whole = run(first, second, places, start, zoom * np.eye(2))
    assert whole.ok.mean() > 0.8
    for k in range(20):
        alone = register_places(tuple(files), 1, places[k : k + 1], start[k : k + 1], many[k : k + 1], 21)
        assert alone.ok[0] == whole.ok[k]
        np.testing.assert_allclose(alone.xy[0], whole.xy[k], atol=2e-4)
        np.testing.assert_allclose(alone.correlation[0], whole.correlation[k], atol=1e-5)


@pytest.mark.parametrize("holed", [0, 1])
def test_what_is_invalid_in_either_file_is_not_used(texture, tmp_path, holed: int) -> None:
    files = []
    for k in (0, 1):
        image = np.rint(texture).astype(np.uint16)
        if k == holed:
            image[195:206, 195:206] = 65535
        write_image(tmp_path / f"{k}.tif", image)
        files.append((str(tmp_path / f"{k}.tif"), (SIZE, SIZE)))
    places = np.array([[203.0, 198.0], [100.0, 120.0], [300.0, 200.0]])
    found = register_places(tuple(files), 1, places, places + 0.3, np.broadcast_to(np.eye(2), (3, 2, 2)), 21)
    assert found.ok.tolist() == [False, True, True]


def test_images_that_hold_nothing_are_read_as_little_as_it_takes_to_know(tmp_path, monkeypatch) -> None:
    read: list[object] = []
    files = [(str(tmp_path / f"{k}.tif"), (SIZE, SIZE)) for k in (0, 1)]
    for path, _ in files:
        write_image(path, np.zeros((SIZE, SIZE), np.uint16))
    kept = PixelReader.read
    monkeypatch.setattr(PixelReader, "read", lambda self, box: read.append(box) or kept(self, box))
    monkeypatch.setattr(register, "upsampled", None)  # would fail
    xy = np.array([[50.0, 50.0], [SIZE - 50.0, SIZE - 60.0]])
    found = register_places(files, 1, xy, xy + 0.25, np.tile(np.eye(2), (2, 1, 1)), 21)
    assert not found.ok.any()
    assert len(read) == len(xy)


def test_gain_and_offset_between_the_images_do_not_matter(texture, reference) -> None:
    found = run(texture, 0.37 * texture + 210, reference, reference + 0.4, np.eye(2))
    assert found.ok.all()
    assert np.abs(found.xy - reference).max() < 0.005
    assert found.correlation.min() > 0.999


def test_swapping_the_images_gives_the_inverse(texture, reference) -> None:
    other = warped(texture, np.eye(2), np.array([0.3, 0.2]))
    forth = run(texture, other, reference, reference, np.eye(2)).xy - reference
    back = run(other, texture, reference, reference, np.eye(2)).xy - reference
    assert np.abs(forth.mean(axis=0) + back.mean(axis=0)).max() < 0.001


def test_the_stated_sigma_is_the_true_one_in_noise(texture, reference) -> None:
    rng = np.random.default_rng(6)
    noise = 0.05 * texture.std()
    first, second = (texture + rng.normal(0, noise, texture.shape).astype(np.float32) for _ in range(2))
    found = run(first, second, reference, reference + 0.3, np.eye(2))
    error = (found.xy - reference)[found.ok] / found.sigma[found.ok, None]
    assert found.ok.mean() > 0.98
    assert 0.75 < np.sqrt((error**2).mean()) < 1.15


def test_different_ground_does_not_correlate(texture, reference) -> None:
    found = run(texture, np.flipud(texture).copy(), reference, reference, np.eye(2))
    assert (found.ok & (found.correlation >= 0.8)).mean() < 0.02


def test_flat_patches_fail_without_a_warning(texture, reference) -> None:
    for flat in (np.zeros_like(texture), np.full_like(texture, 4e4)):
        for first, second in ((texture, flat), (flat, texture), (flat, flat)):
            assert not (run(first, second, reference, reference, np.eye(2)).correlation > 0.5).any()


def test_patches_beyond_the_image_or_on_invalid_pixels_are_not_used(texture) -> None:
    valid = np.ones((SIZE, SIZE), bool)
    valid[200, 200] = False
    points = np.array([[3.0, 200.0], [200.0, SIZE - 3.0], [195.0, 204.0], [-50.0, 20.0], [100.0, 100.0]])
    found = run(texture, texture, points, points, np.eye(2), valid=valid)
    assert found.ok.tolist() == [False, False, False, False, True]


def test_no_patches_at_all_is_no_error(texture) -> None:
    assert len(run(texture, texture, np.empty((0, 2)), np.empty((0, 2)), np.eye(2)).ok) == 0


@pytest.mark.parametrize(("period", "error"), [(3, 0.01), (4, 0.003), (5, 0.004), (8, 0.002)])
def test_upsampling_keeps_the_pixels_and_a_wave_between_them(period: int, error: float) -> None:
    wave = np.tile(np.cos(2 * np.pi * np.arange(240.0) / period), (50, 1)).astype(np.float32)
    fine = upsampled(wave)
    np.testing.assert_allclose(fine[::4, ::4], wave, atol=1e-6)
    expected = np.cos(2 * np.pi * np.arange(960) / (4 * period))
    np.testing.assert_allclose(fine[80, 80:-80], expected[80:-80], atol=error)
    np.testing.assert_allclose(upsampled(wave.T.copy()), fine.T, atol=1e-6)


def test_the_result_does_not_depend_on_opencv_threads(texture, reference) -> None:
    before = cv2.getNumThreads()
    results = []
    for threads in (1, 2):
        cv2.setNumThreads(threads)
        results.append(run(texture, texture, reference, reference + 0.3, np.eye(2)).xy)
    cv2.setNumThreads(before)
    np.testing.assert_array_equal(*results)


def test_what_has_not_settled_is_not_ok(texture, reference, sized: Sized) -> None:
    """After one step from half a pixel away the last step is far longer than one that settles."""
    assert run(texture, texture, reference, reference + 0.5, np.eye(2)).ok.all()
    sized(newton_steps=1)
    assert not run(texture, texture, reference, reference + 0.5, np.eye(2)).ok.any()
    assert run(texture, texture, reference, reference + 0.001, np.eye(2)).ok.all()


def test_a_patch_that_moves_farther_than_its_reach_is_not_ok(texture, reference) -> None:
    for away, ok in ((1.45, 0.9), (1.55, 0.0)):
        found = run(texture, texture, reference, reference + [0.0, away], np.eye(2))
        near = np.abs(found.xy - reference).max(axis=1) < 0.05
        assert near.mean() > 0.9
        assert (found.ok & near).mean() >= ok
        assert ok or not (found.ok & near).any()


def test_sigma_grows_with_the_noise_and_shrinks_with_the_patch(texture, reference) -> None:
    """Twice the noise, twice the sigma; twice the side, half of it."""
    rng = np.random.default_rng(8)
    grain = rng.normal(0, 0.02 * texture.std(), (2, *texture.shape)).astype(np.float32)
    sigma = {}
    for times, patch in ((1, 21), (2, 21), (1, 41)):
        found = run(texture, texture + times * grain[0], reference, reference, np.eye(2), patch)
        sigma[times, patch] = np.median(found.sigma[found.ok])
    assert sigma[2, 21] / sigma[1, 21] == pytest.approx(2.0, rel=0.1)
    assert sigma[1, 21] / sigma[1, 41] == pytest.approx(2.0, rel=0.15)


def test_the_derivative_of_a_ramp_is_its_slope() -> None:
    row, col = np.mgrid[:60, :80].astype(np.float32)
    pictures = _with_derivatives(3.0 * col - 5.0 * row)
    by_col, by_row = (picture.reshape(60, 80)[5:-5, 5:-5] for picture in pictures[1:])
    np.testing.assert_allclose(by_col, 3.0, rtol=1e-5)
    np.testing.assert_allclose(by_row, -5.0, rtol=1e-5)
    template = _Template(pictures, 80, 21)
    assert template._weight.sum() == pytest.approx(1.0, rel=1e-5)
    middle, edge = template._weight[220], template._weight[210]
    assert edge / middle == pytest.approx(np.exp(-0.5 / 0.7**2), rel=1e-5)
    weight = template._weight.reshape(21, 21) / middle
    for other in (weight[0, 10], weight[20, 10], weight[10, 20]):
        assert other == pytest.approx(edge / middle, rel=1e-5)
    assert weight[0, 0] == pytest.approx(np.exp(-1.0 / 0.7**2), rel=1e-5)
    np.testing.assert_allclose(weight, weight.T, rtol=1e-6)
    np.testing.assert_allclose(weight, weight[::-1, ::-1], rtol=1e-6)


@pytest.mark.parametrize(("detail", "flat"), [(0.00005, True), (0.003, False)])
def test_a_patch_is_flat_below_what_float32_tells_of_its_level(detail: float, flat: bool) -> None:
    """Of level 1000 two steps of float32 are 0.00012."""
    template = _Template(_with_derivatives(np.zeros((60, 60), np.float32)), 60, 21)
    noise = np.random.default_rng(9).normal(0, detail, (1, 21 * 21))
    patch, deviation = template._normalized((1000.0 + noise).astype(np.float32))
    assert (patch == 0).all() == flat
    assert np.isinf(deviation).all() == flat
    if not flat:
        assert deviation[0, 0] == pytest.approx(detail, rel=0.2)
        assert (patch**2 @ template._weight)[0] == pytest.approx(1.0, rel=1e-3)


def test_what_fails_at_a_border_is_tried_again_with_a_smaller_patch(texture) -> None:
    """A patch of 21 needs ten pixels about it, one of 15 seven."""
    points = np.array(
        [[9.0, 200.0], [7.0, 200.0], [6.0, 200.0], [200.0, SIZE - 8.0], [200.0, SIZE - 7.0], [10.0, 10.0]]
    )
    found = run(texture, texture, points, points + 0.2, np.eye(2))
    assert found.ok.tolist() == [True, True, False, True, False, True]
    np.testing.assert_allclose(found.xy[found.ok], points[found.ok], atol=0.01)


@pytest.mark.parametrize(
    ("apart", "sigma", "ok"),
    [(0.45, 0.01, True), (0.55, 0.01, False), (0.55, 0.12, True), (0.65, 0.12, False)],
)
def test_a_patch_whose_inner_part_goes_elsewhere_is_not_ok(texture, reference, monkeypatch, apart, sigma, ok) -> None:
    """By more than half a pixel, and more than five standard deviations: it lies across a step of the ground."""
    find = _Template.find

    def found_apart(self, fine, reference, start, linear, *settled):
        found = find(self, fine, reference, start, linear, *settled)
        if self._half == 10:
            return found
        return replace(found, xy=found.xy + apart * np.array([0.6, -0.8]), sigma=np.full(len(start), sigma))

    monkeypatch.setattr(_Template, "find", found_apart)
    found = run(texture, texture, reference, reference + 0.2, np.eye(2))
    assert found.ok.all() if ok else not found.ok.any()
    np.testing.assert_allclose(found.xy, reference, atol=0.01)
