"""Tie points on rendered scenes, whose truth is known; hard light, clouds, and what cannot work."""

from __future__ import annotations

import pickle
import re
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from barpc.ba import adjust_tracks
from barpc.base.errors import DisconnectedError, ImageError, TiePointError
from barpc.scene import Tracks, View
from barpc.sensor.corrected import Corrected
from barpc.tie import TieOptions, find_tracks
from tests.geotiffs import write_image
from tests.lanes import rest_slow
from tests.tie.stages import common_tracks

from .conftest import SIDES, altered


def rms(scene, tracks: Tracks, i: int, j: int) -> np.ndarray:
    """True error of the tie points of two views (col, row) [px]: seen from i in j, and from j in i."""
    first, second = common_tracks(tracks, i, j)
    errors = [scene.errors(i, j, first, second), scene.errors(j, i, second, first)]
    return np.array([np.sqrt((e**2).mean(axis=0)) for e in errors])


@pytest.mark.slow
@pytest.mark.parametrize("side", SIDES)
def test_the_true_error_is_below_a_twelfth_of_a_pixel_in_both_directions(render, side: int) -> None:
    """Of the ties that an adjustment keeps: those off their epipolar lines are left to it, as cameras may cause it."""
    scene = render(views=3, size=(side, side))
    found = adjust_tracks(scene.views, scene.tied.tracks)
    tracks = scene.tied.tracks.select(found.inlier | found.held_out)
    assert len(tracks) > 0.95 * len(scene.tied.tracks)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        errors = rms(scene, tracks, i, j)
        assert len(common_tracks(tracks, i, j)[0]) > 1000 * (side / 600) ** 2
        assert errors.max() <= (0.08 if side == 600 else 0.1)  # of fewer: one error says more
        assert scene.typical(tracks, i, j).max() <= 0.06
        bias = np.median(scene.errors_of(tracks, i, j), axis=0)
        assert np.abs(bias).max() <= 0.005 * 600 / side


@pytest.mark.nightly
@pytest.mark.parametrize(
    "conditions",
    [
        {"sun_azimuth": (150.0, 210.0), "clouds": 0.5},
        pytest.param({"sun_azimuth": (150.0, 210.0)}, marks=pytest.mark.nightly),
    ],
    ids=["clouds and another sun", "another sun"],
)
def test_tie_points_hold_under_other_light_and_half_the_sky_in_clouds(render, conditions) -> None:
    scene = render(views=2, size=(700, 700), **conditions)
    result = find_tracks(scene.views)
    assert result.tracks.num_points >= 100
    assert scene.typical(result.tracks).max() <= 0.1
    assert (np.abs(scene.errors_of(result.tracks)).max(axis=1) > 1.0).mean() <= 0.02


@pytest.mark.slow
@pytest.mark.parametrize("side", SIDES)
def test_the_corrected_cameras_of_a_second_pass_find_the_same_ground(render, side: int) -> None:
    scene = render(views=3, size=(side, side))
    exact = [
        replace(v, sensor=Corrected(v.sensor, s.correction))
        for v, s in zip(scene.views, scene.scene.shots, strict=True)
    ]
    first, second = scene.tied, find_tracks(exact)
    assert second.tracks.num_points >= 0.98 * first.tracks.num_points
    for report in second.pairs:
        assert abs(report.offset[1]) < 0.1
    assert any(abs(report.offset[1]) > 1.0 for report in first.pairs)


class Pickled(ThreadPoolExecutor):
    """Threads that are handed what another process would be."""

    def submit(self, function, /, *args, **rest):
        return super().submit(_unpickled, pickle.dumps((function, args, rest)))


def _unpickled(task: bytes):
    function, args, rest = pickle.loads(task)
    return pickle.loads(pickle.dumps(function(*args, **rest)))


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("workers", "number", "side"),
    [
        (Pickled, 2, 300),
        (ProcessPoolExecutor, 2, 300),
        pytest.param(ThreadPoolExecutor, 3, 600, marks=pytest.mark.nightly),
        pytest.param(ProcessPoolExecutor, 3, 600, marks=pytest.mark.nightly),
    ],
)
def test_the_result_is_the_same_to_the_byte_for_any_workers(render, workers, number: int, side: int) -> None:
    views = render(views=number, size=(side, side)).views
    options = TieOptions(tile=256)
    expected = find_tracks(views, options)
    seen: list[tuple[str, int, int]] = []
    with workers(2) as executor:
        result = find_tracks(views, options, executor=executor, progress=lambda *step: seen.append(step))
    for name in ("view", "point", "xy", "sigma"):
        assert getattr(result.tracks, name).tobytes() == getattr(expected.tracks, name).tobytes()
    assert result.pairs == expected.pairs
    assert {stage for stage, _, _ in seen} == {"read", "detect", "match", "refine", "detail"}
    assert all(1 <= done <= total for _, done, total in seen)


@pytest.fixture
def pair(scene) -> list[View]:
    return scene.views


@pytest.mark.slow
def test_tie_points_hold_where_both_images_saturate(scene, tmp_path) -> None:
    bright = [altered(view, tmp_path, lambda d: np.minimum(d, 1200)) for view in scene.views]
    tracks = find_tracks(bright).tracks
    assert tracks.num_points >= 100
    assert scene.typical(tracks).max() <= 0.1
    assert (np.abs(scene.errors_of(tracks)).max(axis=1) > 1.0).mean() <= 0.02


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(
    "change",
    rest_slow(
        [
            pytest.param(
                lambda d: np.where(np.arange(d.shape[1]) < len(d) // 6, np.nan, d.astype(np.float64)),
                id="nan border",
            ),
            pytest.param(lambda d: (d // 16).astype(np.uint8), id="uint8"),
            pytest.param(lambda d: d.astype(np.float32), id="float"),
            pytest.param(lambda d: d.astype(np.int16), id="int16"),
            pytest.param(lambda d: np.stack([d, d[::-1]]), id="two bands"),
        ]
    ),
)
def test_any_real_pixel_type_works(render, tmp_path, change, side: int) -> None:
    first, second = render(views=2, size=(side, side)).views
    views = [first, altered(second, tmp_path, change)]
    assert find_tracks(views).tracks.num_points > 400 * (side / 600) ** 2


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize(
    "change",
    rest_slow(
        [
            pytest.param(lambda d: (d.astype(np.int64) + 2_000_000_000).astype(np.int32), id="int32 + 2e9"),
            pytest.param(lambda d: d.astype(np.float64) * 1e30, id="float64 x 1e30"),
            pytest.param(lambda d: d.astype(np.float32) * np.float32(1e-30), id="float32 x 1e-30"),
        ]
    ),
)
def test_a_linear_change_of_the_grey_values_moves_no_tie_point(render, tmp_path, change, side: int) -> None:
    scene = render(views=2, size=(side, side))
    (first, second), expected = scene.views, scene.tied.tracks
    found = find_tracks([first, altered(second, tmp_path, change)]).tracks
    ends = []
    for tracks in (expected, found):
        first, second = (tracks.xy[tracks.view == k][np.argsort(tracks.point[tracks.view == k])] for k in (0, 1))
        whole = (first == np.rint(first)).all(axis=1)  # the reference patch stands in the first view
        ends.append({tuple(a): b for a, b in zip(first[whole], second[whole], strict=True)})
    common = ends[0].keys() & ends[1].keys()
    assert len(common) > 0.9 * len(ends[0]) > 100
    apart = np.array([np.subtract(ends[0][key], ends[1][key]) for key in common])
    assert np.percentile(np.abs(apart), 95) < 0.01


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: np.zeros_like(d), "too few keypoints ([0-9]+ and 0 keypoints"),
        (lambda d: np.full_like(d, 800), "too few keypoints"),
        (lambda d: np.full(d.shape, np.nan, np.float32), "too few keypoints"),
        pytest.param(
            lambda d: np.random.default_rng(0).integers(1, 4000, d.shape).astype(np.uint16),
            "no common offset",
            marks=pytest.mark.nightly,
        ),
    ],
    ids=["nodata", "constant", "nan", "noise"],
)
def test_what_does_not_match_is_refused_by_name_with_counts_and_advice(pair, tmp_path, change, message) -> None:
    views = [pair[0], altered(pair[1], tmp_path, change)]
    with pytest.raises(TiePointError, match=message.replace("(", r"\(", 1)) as caught:
        find_tracks(views)
    text = str(caught.value)
    assert re.search(r"view_00 - view_01", text)
    assert ("no detail in view_01" if "and 0 keypoints" in text else "loosen") in text
    assert "\n" not in text


@pytest.mark.slow
def test_a_view_that_matches_no_other_is_named(three, tmp_path) -> None:
    views = [*three.views[:2], altered(three.views[2], tmp_path, np.zeros_like)]
    with pytest.raises(DisconnectedError, match=r"2 groups \(view_00, view_01; view_02\)") as caught:
        find_tracks(views)
    assert caught.value.groups == (("view_00", "view_01"), ("view_02",))


def test_a_file_that_vanished_is_named(pair, tmp_path) -> None:
    views = [pair[0], replace(pair[1], path=str(tmp_path / "gone.tif"))]
    with pytest.raises(ImageError, match=r"gone\.tif: no such file"):
        find_tracks(views)


def test_one_pixel_is_too_few(pair, tmp_path) -> None:
    tiny = replace(pair[1], size=(1, 1), path=str(write_image(tmp_path / "t.tif", np.ones((1, 1), np.uint8))))
    with pytest.raises(TiePointError):
        find_tracks([pair[0], tiny])
