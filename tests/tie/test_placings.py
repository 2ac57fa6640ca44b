"""Pictures that lie otherwise than their RPCs say: each is named, the others go on, and none that is right is asked."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from barpc.base.errors import DisconnectedError, TiePointError
from barpc.scene import View
from barpc.sensor.corrected import Corrected, Correction
from barpc.tie import TieOptions, find_tracks
from barpc.tie.matchers import matching
from barpc.tie.matchers.features import Sift
from barpc.tie.matchers.placings import Placing, _mirrored, misplaced, stretched
from tests.lanes import rest_slow

from .conftest import altered
from .test_pairs import camera


def _mean(pixels: np.ndarray, side: int) -> np.ndarray:
    rows, cols = (n // side for n in pixels.shape)
    return pixels[: rows * side, : cols * side].reshape(rows, side, cols, side).mean(axis=(1, 3)).astype(pixels.dtype)


def _times(pixels: np.ndarray, factor: int) -> np.ndarray:
    return cv2.resize(pixels, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)


LAID = {
    "with rows and columns exchanged,": np.transpose,
    "at half the size that its RPC is for,": lambda pixels: _mean(pixels, 2),
    "mirrored, its columns reversed,": np.fliplr,
    "mirrored, its rows reversed,": np.flipud,
    "turned by 90 degrees clockwise,": lambda pixels: np.rot90(pixels, -1),
    "turned by 180 degrees,": lambda pixels: np.rot90(pixels, 2),
    "turned by 90 degrees counter-clockwise,": np.rot90,
    "with rows and columns exchanged and both reversed,": lambda pixels: np.rot90(pixels, 2).T,
    "at a quarter of the size that its RPC is for,": lambda pixels: _mean(pixels, 4),
    "at a third of the size that its RPC is for,": lambda pixels: _mean(pixels, 3),
    "at twice the size that its RPC is for,": lambda pixels: _times(pixels, 2),
    "at 4 times the size that its RPC is for,": lambda pixels: _times(pixels, 4),
    "mirrored, its columns reversed, at half the size that its RPC is for,": lambda pixels: _mean(pixels[:, ::-1], 2),
}


def laid(view: View, how: str, folder: Path) -> View:
    return altered(view, folder, LAID[how])


@pytest.mark.landing(4)
@pytest.mark.parametrize("how", rest_slow(LAID, 2))
def test_a_picture_that_lies_otherwise_is_named_and_how(three, tmp_path, how: str) -> None:
    wrong = list(LAID).index(how) % 3
    views = [laid(view, how, tmp_path) if k == wrong else view for k, view in enumerate(three.views)]
    with pytest.raises(DisconnectedError) as caught:
        find_tracks(views)
    name = views[wrong].name
    assert list(caught.value.said) == [name]
    assert caught.value.said[name].startswith(f"shows the picture {how} as keypoints of view_0")
    assert f"{views[wrong].path}: shows the picture {how}" in str(caught.value)
    assert caught.value.groups == (tuple(v.name for k, v in enumerate(views) if k != wrong), (name,))


@pytest.mark.costs(4)
@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize("how", LAID)
def test_so_it_is_among_real_images(triplet, ventoux, tmp_path, how: str) -> None:
    views = [triplet[0], laid(triplet[1], how, tmp_path), triplet[2]]
    with pytest.raises(DisconnectedError, match=f"img_02.tif: shows the picture {how} as keypoints of img_0"):
        find_tracks(views)
    if "quarter" in how:  # of 500 px, of which they share a third
        return
    with pytest.raises(TiePointError, match=f"right_image.tif: shows the picture {how}|left_image.tif: shows "):
        find_tracks([ventoux[0], laid(ventoux[1], how, tmp_path)])


@pytest.mark.slow
def test_of_two_images_the_size_of_the_whole_tells_which(scene, tmp_path) -> None:
    """An RPC for the whole image ends where this does; of a crop nothing tells, and both are named."""
    how = "at half the size that its RPC is for,"
    for wrong in (0, 1):
        views = [laid(view, how, tmp_path) if k == wrong else view for k, view in enumerate(scene.views)]
        with pytest.raises(TiePointError, match=rf"{views[wrong].path}: shows the picture {how} as keypoints of"):
            find_tracks(views)
    said = r"view_01.tif: shows the picture turned by 180 .*or view_00 the reverse, as .*give the picture that"
    with pytest.raises(TiePointError, match=said):
        find_tracks([scene.views[0], laid(scene.views[1], "turned by 180 degrees,", tmp_path)])


def test_a_crop_whose_rpc_counts_from_the_whole_image_is_named_beyond_the_search(scene, tmp_path) -> None:
    """Within it the camera is corrected; a crop with its own RPC is right."""
    second = scene.views[1]
    crop = altered(second, tmp_path, lambda d: d[60:, 80:])
    with pytest.raises(TiePointError) as caught:
        find_tracks([scene.views[0], crop], TieOptions(search=30.0))
    said = re.search(
        r"moved by some (\S+) columns and (\S+) rows, more than was searched, as a crop is", str(caught.value)
    )
    assert said is not None
    sign = -1.0 if "view_00.tif: shows" in str(caught.value) else 1.0
    np.testing.assert_allclose([sign * float(word) for word in said.groups()], [80, 60], atol=30)  # parallax, too
    assert find_tracks([scene.views[0], crop]).tracks.num_points > 100
    right = replace(crop, sensor=second.sensor.crop(80.0, 60.0))
    assert find_tracks([scene.views[0], right], TieOptions(search=30.0)).tracks.num_points > 100


def test_images_that_are_right_are_not_asked(scene, triplet, ventoux, monkeypatch) -> None:
    """Nor crops with RPCs of their own, which end where the whole images do."""

    def never(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(matching, "likeliest_placing", never)
    for views in (scene.views, triplet[:2], ventoux):
        assert find_tracks(views).tracks.num_points > 200


@pytest.mark.nightly
def test_pictures_of_nothing_in_common_lie_no_how(scene, tmp_path) -> None:
    first, second = scene.views
    noise = np.random.default_rng(1).integers(100, 3000, (300, 300)).astype(np.uint16)
    for pixels in (noise, np.full((300, 300), 900, np.uint16)):
        with pytest.raises(TiePointError) as caught:
            find_tracks([first, altered(second, tmp_path, lambda _, pixels=pixels: pixels)])
        assert "shows the picture" not in str(caught.value)


def test_descriptors_of_a_mirrored_picture_are_those_of_the_picture_in_another_order() -> None:
    picture = cv2.GaussianBlur(np.random.default_rng(4).integers(0, 255, (200, 200)).astype(np.float32), (0, 0), 2.5)
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)

    def found(pixels: np.ndarray) -> object:
        return Sift().detect(np.ascontiguousarray(pixels), lambda xy, _scale, _response: np.arange(len(xy)))

    ours, theirs = found(picture), found(picture[::-1])
    matched = 0
    for xy, angle, described in zip(ours.xy, ours.angle, _mirrored(ours.descriptors), strict=True):
        near = np.hypot(*(theirs.xy - [xy[0], 199 - xy[1]]).T) + 50 * np.abs(
            np.exp(1j * theirs.angle) - np.exp(-1j * angle)
        )
        k = int(near.argmin())
        if near[k] < 3.0:
            matched += 1
            cosine = np.dot(described / 255.0, theirs.descriptors[k] / 255.0)
            assert cosine > 0.9
    assert matched > 50
    assert (_mirrored(_mirrored(ours.descriptors)) == ours.descriptors).all()


@pytest.mark.parametrize(
    ("scale", "asked"), [(1.0, False), (0.75, False), (1.35, False), (0.5, True), (2.0, True), (-1.0, True)]
)
def test_scale_is_asked_across_the_lines_where_relief_has_no_say(scene, scale: float, asked: bool) -> None:
    rng = np.random.default_rng(2)
    first = rng.uniform(0, 299, (200, 2))
    where = matching.epipolar_segments(*scene.views, first)
    across = where.across.mean() + scale * (where.across - where.across.mean()) + rng.normal(0, 0.3, 200)
    second = replace(where, across=across).place(rng.normal(0, 40, 200))
    assert stretched((scene.views[0], scene.views[1]), first, second) is asked
    line = np.abs(where.across - np.median(where.across)) < 0.3  # on one line nothing tells
    assert not stretched((scene.views[0], scene.views[1]), first[line], second[line])
    assert not stretched((scene.views[0], scene.views[1]), first[:0], second[:0])


@pytest.mark.parametrize(
    ("size", "turns", "wide", "off", "fills"),
    [(2.0, 0, 0, 0.0, True), (2.0, 0, 2, 0.0, True), (2.0, 0, 3, 0.0, False), (2.0, 0, -3, 0.0, False),
     (0.5, 0, 1, 0.0, True), (0.5, 0, -2, 0.0, False), (2.0, 1, 0, 0.0, True), (2.0, 1, 0, 0.9, True),
     (2.0, 1, 0, 1.1, False), (2.0, 1, 0, -0.9, True), (2.0, 1, 0, -1.1, False), (1.0, 0, 0, 0.0, False)],
)  # fmt: skip
def test_an_rpc_of_a_whole_image_of_another_size_fills_its_file(size, turns, wide, off, fills) -> None:
    """To a pixel of the larger of both on any side; `off`, where it begins."""
    whole, end = np.array([1000.0, 800.0]), off + 0.5
    rpc = replace(camera(0.0), image_offset=0.5 * (whole - 1.0) + [end, 0.0], image_scale=0.5 * (whole - 1.0))
    width, height = np.rint(size * (whole[::-1] if turns else whole)).astype(int)
    view = View("v", "", (int(width) + wide, int(height)), rpc, (0.0, 200.0))
    assert Placing(False, turns, size).fills(view) == fills
    assert not Placing(False, turns, size).fills(
        replace(view, sensor=Corrected(rpc, Correction(*np.zeros((2, 3)), np.full(3, 6e6))))
    )


def test_who_is_wrong_is_who_the_others_are_not_tied_to(scene) -> None:
    """Of two groups alike both are named; of pairs that lie alike none is."""
    views = [replace(scene.views[0], name=name) for name in "abcd"]
    turned = Placing(False, 2, 1.0)
    assert list(misplaced(views, [(0, 1), (1, 2)], {(0, 3): (turned, turned), (2, 3): (turned, None)})) == ["d"]
    said = misplaced(views, [(0, 1), (2, 3)], {(0, 2): (turned, turned)})
    assert list(said) == ["c"]
    assert "or a the reverse" in said["c"]
    assert misplaced(views, [(0, 1), (1, 2)], {(0, 3): (None, None)}) == {}
    assert misplaced(views, [(0, 1), (1, 2)], {(0, 2): (turned, turned)}) == {}
