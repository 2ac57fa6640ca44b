"""Pairs of other resolutions: places of the finer image stay those of its file, and as exact as the coarser one's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from barpc.rasters.raster import open_raster
from barpc.rpcio import read_rpc
from barpc.scene import Tracks, View
from barpc.sensor.rpc import altitude_range
from barpc.sensor.triangulation import epipolar_offset
from barpc.tie import Matches, Pair, Scope, find_tracks
from barpc.tie.pairing.resolution import Coarser, Looks
from barpc.tie.pixels import PixelReader, read_picture, read_pixels, survey
from barpc.tie.tracks import _needed
from tests.geotiffs import write_image
from tests.lanes import rest_slow
from tests.tie.stages import common_tracks

from .conftest import Rendered, checks, view_of
from .test_pairs import METRE, camera

RNG = np.random.default_rng(4)
POINTS = np.array([[0.0, 0.0], [-0.5, 499.5], [312.25, 77.0]])


def averaged(view: View, folder: Path, columns: int, rows: int) -> View:
    """The view by means of so many columns and rows, as another sensor would give it: a file and an RPC of its own."""
    with open_raster(view.path) as image:
        pixels = image.read(1).astype(np.float32)
    height, width = pixels.shape[0] // rows, pixels.shape[1] // columns
    blocks = pixels[: height * rows, : width * columns].reshape(height, rows, width, columns)
    path = write_image(folder / f"{view.name}.tif", np.rint(blocks.mean(axis=(1, 3))).astype(np.uint16))
    return replace(view, path=str(path), size=(width, height), sensor=view.sensor.window(0, 0, columns, rows))


# --- which pixels -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ((1, 1), (1, 1), ((1, 1), (1, 1))),
        ((1, 1), (1.45, 1.45), ((1, 1), (1, 1))),  # one sensor under another angle: as it is
        ((1, 1), (1.55, 1.55), ((2, 2), (1, 1))),
        ((4, 4), (1, 1), ((1, 1), (4, 4))),
        ((1, 1), (8, 8), ((8, 8), (1, 1))),
        ((1, 4), (1, 1), ((1, 1), (1, 4))),  # columns, rows
        ((1, 4), (4, 1), ((4, 1), (1, 4))),
        ((1, 1), (60, 60), ((22, 22), (1, 1))),  # of 500 px: no fewer pixels than each holds
    ],
)
def test_the_finer_image_is_brought_to_the_pixel_of_the_coarser_one(first, second, expected) -> None:
    cameras = [camera(0.0).window(0, 0, *steps) for steps in (first, second)]
    both = [View(f"v{k}", "", (500, 500), one, (0.0, 500.0)) for k, one in enumerate(cameras)]
    looks = Looks.at(both, [Pair((0, 1), 1.0, 0.0)])
    ends = looks.ends[0, 1]
    assert [tuple(looks.pixel[k]) for k in ends] == list(expected)
    assert looks.of[list(ends)].tolist() == [0, 1]
    assert [looks.views[k].size for k in ends] == [(500 // a, 500 // b) for a, b in expected]
    assert ends[0] < ends[1]


def test_images_that_are_turned_are_compared_as_they_are_and_so_is_what_sees_no_ground() -> None:
    """A quarter of a turn exchanges columns and rows; 45 degrees leave a pixel as large as it was."""
    upright = camera(0.0)

    class Turned:
        def __init__(self, angle: float) -> None:
            self.turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])

        def localize(self, image, alt):
            return upright.localize(image @ self.turn, alt)

        def project(self, ground):
            return upright.project(ground) @ self.turn.T

        def project_jacobian(self, ground):
            image, slope = upright.project_jacobian(ground)
            return image @ self.turn.T, self.turn @ slope

    for angle in (np.pi / 4, np.pi / 2):
        both = [View(name, "", (500, 500), one, (0.0, 500.0)) for name, one in (("a", upright), ("b", Turned(angle)))]
        assert Looks.at(both, [Pair((0, 1), 1.0, 0.0)]).ends == {(0, 1): (0, 1)}
    wide = replace(both[0], sensor=upright.window(0, 0, 4, 1))
    looks = Looks.at([wide, both[1]], [Pair((0, 1), 1.0, 0.0)])
    assert [tuple(looks.pixel[k]) for k in looks.ends[0, 1]] == [(1, 1), (1, 4)]  # its rows lie along these columns
    blind = replace(both[0], sensor=upright.crop(1e9, 0))
    assert Looks.at([blind, wide], [Pair((0, 1), 1.0, 0.0)]).ends == {(0, 1): (0, 1)}


def test_a_view_is_looked_at_as_often_as_its_partners_ask_for_and_tracks_return_to_it() -> None:
    sizes = (1, 1, 2, 4)
    block = [View(f"v{k}", "", (400, 400), camera(0.0).window(0, 0, s, s), (0.0, 500.0)) for k, s in enumerate(sizes)]
    looks = Looks.at(block, [Pair(ends, 1.0, 0.0) for ends in ((0, 1), (0, 2), (0, 3), (2, 3))])
    assert looks.of.tolist() == [0, 0, 0, 1, 2, 2, 3]
    assert looks.pixel[:, 0].tolist() == [1, 2, 4, 1, 1, 2, 1]
    assert looks.ends == {(0, 1): (0, 3), (0, 2): (1, 4), (0, 3): (2, 6), (2, 3): (5, 6)}
    xy = np.array([[[10.0, 20.0], [3.0, 4.5]]])
    found = looks.places((0, 3), xy)
    assert found.tolist() == [[[2.125, 4.625], [3.0, 4.5]]]
    back = looks.tracks(Tracks(np.array([2, 6]), np.zeros(2, np.int64), found[0], np.array([0.1, 0.1])))
    assert back.view.tolist() == [0, 3]
    np.testing.assert_allclose(back.xy, xy[0], atol=1e-12)
    np.testing.assert_allclose(back.sigma, [0.4, 0.1])  # as exact as the coarser one's pixel


@pytest.mark.parametrize(("coarse", "kept"), [(0.06, [10.0, 20.0]), (0.04, [10.5, 20.5])])
def test_a_track_at_two_looks_of_a_view_is_observed_once_in_it(coarse: float, kept: list[float]) -> None:
    """Pixels of 1, 1.4 and 1.96: the first is linked to the third as it is, by the second, and by means of two."""
    sizes = (1.0, 1.4, 1.96)
    block = [View(f"v{k}", "", (400, 400), camera(0.0).window(0, 0, s, s), (0.0, 500.0)) for k, s in enumerate(sizes)]
    looks = Looks.at(block, [Pair(ends, 1.0, 0.0) for ends in ((0, 1), (0, 2), (1, 2))])
    assert looks.ends == {(0, 1): (0, 2), (0, 2): (1, 3), (1, 2): (2, 3)}
    xy, point = [[7.0, 8.0], [10.0, 20.0], [5.0, 10.0], [7.0, 14.0], [5.0, 10.0]], np.array([0, 1, 1, 1, 1])
    sigma = np.array([0.1, 0.1, coarse, 0.1, 0.1])
    back = looks.tracks(Tracks(np.array([3, 0, 1, 2, 3]), point, np.array(xy), sigma))
    assert back.view.tolist() == [2, 0, 1, 2]
    assert back.point.tolist() == [0, 1, 1, 1]
    np.testing.assert_allclose(back.xy, [xy[0], kept, *xy[3:]])
    np.testing.assert_allclose(back.sigma, [0.1, min(0.1, 2.0 * coarse), 0.1, 0.1])


def test_the_camera_of_a_look_is_that_of_the_coarser_image() -> None:
    """RPC.window is exact; the derivative is that of the projection."""
    rpc = camera(0.01)
    own, expected = Coarser(rpc, np.array([4.0, 3.0])), rpc.window(0, 0, 4.0, 3.0)
    ground = expected.localize(POINTS, np.full(3, 120.0))
    np.testing.assert_allclose(own.localize(POINTS, np.full(3, 120.0)), ground, atol=1e-9)
    np.testing.assert_allclose(own.project(ground), POINTS, atol=1e-6)
    image, slope = own.project_jacobian(ground)
    np.testing.assert_allclose(image, POINTS, atol=1e-6)
    np.testing.assert_allclose(slope, expected.project_jacobian(ground)[1], rtol=1e-9)


# --- what is read -------------------------------------------------------------------------------------------


def test_pixels_are_means_and_valid_where_all_that_they_hold_is(tmp_path, sized) -> None:
    sized(pixels_together=12)  # several parts
    data = RNG.integers(1, 4000, (83, 62)).astype(np.uint16)  # a rest on both sides
    data[30:40, 20:30] = 9
    path = write_image(tmp_path / "a.tif", data, nodata=9)
    size, box = (62 // 3, 83 // 4), (2, 1, 15, 18)
    with PixelReader(path, 1, size) as reader:
        pixels, valid = reader.read(box)
    part = data[4:76, 6:51].astype(float).reshape(18, 4, 15, 3)
    known = (part != 9).all(axis=(1, 3))
    assert 6 < (~known).sum() < 30
    np.testing.assert_array_equal(valid, known)
    np.testing.assert_allclose(pixels, np.where(known, part.mean(axis=(1, 3)), 0.0), rtol=1e-6)
    found = survey(path, 1, size)
    assert found is not None
    assert found.pixel == (3, 4)
    shown, known = read_picture(path, box, found)
    np.testing.assert_array_equal(shown[known], found.stretch.apply(pixels, valid)[known])
    twice, _ = read_picture(path, (2, 2, 14, 16), found, 2)  # few keypoints wanted of a large image: means of means
    assert twice.shape == (8, 7)


def test_means_of_numbers_near_the_largest_are_numbers(tmp_path) -> None:
    path = write_image(tmp_path / "a.tif", np.full((64, 64), 1.5e308))
    pixels, valid = read_pixels(path, (0, 0, 8, 8), 1, (8, 8))
    assert valid.all()
    np.testing.assert_allclose(pixels, 1.5e308)


# --- tie points ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "second"),
    rest_slow(
        pytest.param(*row)
        for row in (((1, 1), (3, 2)), ((2, 3), (1, 1)), ((1, 3), (3, 1)), ((2, 2), (2, 2)), ((1, 1), (4, 4)))
    ),
)
def test_rendered_pairs_are_tied_within_a_part_of_the_coarser_pixel(scene: Rendered, tmp_path, first, second) -> None:
    """A half pixel that is lost between the pixels is 0.25 to 0.38 of the coarser one: more than is allowed here."""
    both = [averaged(view, tmp_path, *by) for view, by in zip(scene.views, (first, second), strict=True)]
    result = find_tracks(both)
    assert result.tracks.num_points >= 15
    places = common_tracks(result.tracks, 0, 1)
    errors = scene.errors(0, 1, *((xy + 0.5) * by - 0.5 for xy, by in zip(places, (first, second), strict=True)))
    errors /= np.maximum(first, second)
    assert np.abs(np.median(errors, axis=0)).max() < 0.1
    assert 1.4826 * np.median(np.abs(errors)) < 0.3
    if first == (1, 1):  # its places are good to the other's pixel, and say so
        sigma = [np.median(result.tracks.sigma[result.tracks.view == v]) for v in (0, 1)]
        assert sigma[0] / sigma[1] == pytest.approx(max(second), rel=0.05)


@pytest.mark.slow
def test_matches_of_others_between_two_resolutions_become_as_exact_as_our_own(scene: Rendered, tmp_path) -> None:
    """Given in the pixels of the files: 0.5 px of the coarser one, and 1.5 of the finer, of noise; a fifth is false."""
    fine, coarse = scene.views[0], averaged(scene.views[1], tmp_path, 3, 3)
    rng = np.random.default_rng(8)
    first = rng.uniform(20, 279, (900, 2))
    other = (scene.place(0, 1, first) + 0.5) / 3 - 0.5
    rows = np.flatnonzero(((other > 7) & (other < 92)).all(axis=1))[:400]
    noise = [rng.normal(0, sigma, (len(rows), 2)) for sigma in (1.5, 0.5)]
    xy = np.stack([first[rows] + noise[0], other[rows] + noise[1]], axis=1)
    wrong = rng.random(len(rows)) < 0.2
    xy[wrong, 1] = rng.uniform(7, 92, (wrong.sum(), 2))
    index = -1 - np.stack([np.arange(len(rows))] * 2, axis=1)
    result = find_tracks([fine, coarse], scope=Scope(given={(0, 1): Matches(xy, np.zeros(len(xy)), index)}))
    assert result.tracks.num_points > 100
    one, two = common_tracks(result.tracks, 0, 1)
    errors = scene.errors(0, 1, one, 3 * two + 1.0) / 3
    assert np.abs(np.median(errors, axis=0)).max() < 0.05
    assert 1.4826 * np.median(np.abs(errors)) < 0.15


def test_pairs_that_registered_ones_leave_apart_keep_their_matches_and_no_others() -> None:
    three = [View(f"v{k}", "", (400, 400), camera(k * METRE), (0.0, 500.0)) for k in range(4)]
    looks = Looks.at(three, [Pair(ends, 1.0, 0.0) for ends in ((0, 1), (0, 2), (1, 2), (2, 3))])
    rows = [(v, p) for p in range(20) for v in (0, 1)] + [(v, p) for p in range(20, 26) for v in (1, 2)]
    view, point = np.array(rows).T
    tracks = Tracks(view, point, np.zeros((len(rows), 2)), np.full(len(rows), 0.1))
    pairs = [(0, 1), (0, 2), (1, 2), (2, 3)]
    assert _needed(looks, tracks, pairs, 12) == {(0, 2), (1, 2), (2, 3)}
    assert _needed(looks, tracks, pairs, 6) == {(2, 3)}


# --- real images --------------------------------------------------------------------------------------------


def shift_left(views: tuple[View, View], tracks: Tracks, where: tuple[np.ndarray, np.ndarray]) -> float:
    """What checks and tracks say of the shift across the epipolar lines, apart [px of the second view]."""
    alt = sum(views[0].alt_range) / 2
    ends = views[0].sensor, views[1].sensor
    ours, theirs = (epipolar_offset(*ends, *places, alt)[0] for places in (common_tracks(tracks, 0, 1), where))
    return float(np.median(ours) - np.median(theirs))


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("left", "right"),
    [
        *((1, 4), ((1, 4), (4, 1))),
        *(pytest.param(*row, marks=pytest.mark.nightly) for row in ((4, 1), (4, 4), (2, 4), (2, 1))),
    ],
)
def test_real_crops_of_a_few_hundred_pixels_are_tied_at_any_two_resolutions(
    ventoux, shared_data: Path, tmp_path, left, right
) -> None:
    """500 px and less, a third of it in common, 20 degrees on steep ground: about fifteen keypoints at a quarter."""
    by = [np.broadcast_to(one, 2) for one in (left, right)]
    both = tuple(averaged(view, tmp_path, *one) for view, one in zip(ventoux, by, strict=True))
    result = find_tracks(both)
    assert result.tracks.num_points >= 12
    where = [
        (xy + 0.5) / one - 0.5
        for xy, one in zip(checks(shared_data, "phr_ventoux__left_image__right_image"), by, strict=True)
    ]
    apart = shift_left(both, result.tracks, where)  # delivered: 4.8 px of the images as they are
    coarsest = np.maximum(*by)
    assert abs(apart * by[1] / coarsest).max() <= 0.15
    assert ("by keypoints" in result.pairs[0].means) == (coarsest.max() == 4 and coarsest.min() == 4)


@pytest.mark.slow
@pytest.mark.parametrize("swapped", rest_slow([False, True], mark=pytest.mark.nightly))
def test_a_multispectral_image_is_tied_to_the_panchromatic_one_of_the_other_view(
    ventoux, shared_data: Path, swapped: bool
) -> None:
    path = shared_data / "cross_sensor/phr_ventoux_xs/left_xs.tif"
    rpc = read_rpc(path)
    xs = replace(view_of(path, rpc), alt_range=altitude_range(rpc))
    pan, right = ventoux
    xy, other = checks(shared_data, "phr_ventoux__left_image__right_image")
    where = xs.sensor.project(pan.sensor.localize(xy, np.full(len(xy), 540.0))), other
    both = (right, xs) if swapped else (xs, right)
    result = find_tracks(both)
    assert result.tracks.num_points >= 12
    apart = shift_left(both, result.tracks, where[::-1] if swapped else where)
    assert abs(apart) / (1 if swapped else 4) <= 0.15  # of its pixel of 2 m
