"""Every option of the tie points: what changes with it, in which direction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.scene import Tracks
from barpc.tie import TieOptions, find_tracks, link
from barpc.tie.matchers.features import KeypointDensity, Keypoints, detect_tile
from barpc.tie.matchers.matching import match_pair
from barpc.tie.matchers.report import PairReport
from barpc.tie.pairing.epipolar import common_range, epipolar_segments
from barpc.tie.pairing.overlaps import Pair
from barpc.tie.patches import dense
from barpc.tie.patches.links import refine
from barpc.tie.pixels import survey, tiles
from tests.constants import CONSTANTS, chosen
from tests.costs import once
from tests.tie.conftest import Rendered, altered
from tests.tie.stages import detect, select_pairs
from tests.tie.test_pairs import METRE, camera, views


class Row(NamedTuple):
    """An option from one value to another, and what grows (1) or shrinks (-1) by it."""

    field: str
    low: Any
    high: Any
    observable: Callable[[Rendered, TieOptions], float]
    sign: int
    rest: dict[str, Any] = {}  # noqa: RUF012 - never changed


@once
def known(scene: Rendered) -> tuple[tuple[Keypoints, Keypoints], list[Pair]]:
    """Keypoints and pairs as they are by default."""
    first, second = detect(scene.views, TieOptions())
    return (first, second), select_pairs(scene.views, TieOptions())


def report(scene: Rendered, options: TieOptions) -> PairReport:
    found, pairs = known(scene)
    return match_pair((scene.views[0], scene.views[1]), found, pairs[0], options)[1]


def keypoints(scene: Rendered, options: TieOptions) -> float:
    return sum(map(len, detect(scene.views, options)))


def verified(scene: Rendered, options: TieOptions) -> float:
    return report(scene, options).verified


@once
def linked(scene: Rendered) -> Tracks:
    """What is registered by default."""
    found, pairs = known(scene)
    matches, _ = match_pair((scene.views[0], scene.views[1]), found, pairs[0], TieOptions())
    return link([pairs[0].views], [matches])


def kept(scene: Rendered, options: TieOptions) -> float:
    return len(refine(scene.views, linked(scene), {}, options))


def sigma(scene: Rendered, options: TieOptions) -> float:
    return float(np.median(refine(scene.views, linked(scene), {}, options).sigma))


def found(scene: Rendered, options: TieOptions) -> float:
    return len(find_tracks(scene.views, options).tracks)


ROWS = [
    Row("cell", 32, 150, keypoints, -1, {"keypoints_per_cell": 10}),
    Row("keypoints_per_cell", 10, 40, keypoints, 1),
    Row("keypoints_per_image", 200, 5000, keypoints, 1),
    Row("contrast", 0.005, 0.05, keypoints, -1, {"keypoints_per_cell": 1000}),
    Row("ratio", 0.5, 0.9, verified, 1),
    Row("false_share", 0.0005, 0.2, verified, 1),
    Row("tolerance", 0.01, 3.0, lambda scene, options: report(scene, options).matches, 1),
    Row("min_correlation", 0.5, 0.99, kept, -1),
    Row("points_per_image", 100, 5000, found, 1),
    Row("patch", 9, 31, sigma, -1, {"min_correlation": 0.01}),
]
ELSEWHERE = {
    "band": "test_the_band_that_is_asked_for_is_matched",
    "matcher": "test_names_are_those_of_the_tables",
    "tile": "test_tiles_are_as_large_as_asked_for",
    "min_overlap": "test_pairs_are_those_within_the_bounds",
    "angles": "test_pairs_are_those_within_the_bounds",
    "neighbours": "test_a_view_gets_as_many_partners_as_asked_for",
    "search": "test_the_search_reaches_as_far_as_asked_for",
    "min_matches": "test_a_pair_needs_as_many_matches_as_asked_for",
}


def test_every_option_has_a_row() -> None:
    assert {row.field for row in ROWS} | set(ELSEWHERE) == {field.name for field in fields(TieOptions)} | set(
        CONSTANTS[TieOptions]
    )
    assert set(ELSEWHERE.values()) <= set(globals())


@pytest.mark.few(4)
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.field)
def test_an_option_changes_the_result_in_its_direction(scene: Rendered, row: Row) -> None:
    found = []
    for value in (row.low, row.high):
        with chosen(TieOptions, **{**row.rest, row.field: value}) as options:
            found.append(row.observable(scene, options))
    few, many = found
    assert (many / few if row.sign > 0 else few / many) > 1.05, (few, many)


def test_what_is_found_lies_where_the_truth_is_and_errs_as_it_says(scene: Rendered) -> None:
    found = scene.tied
    first, second = (found.tracks.view == v for v in (0, 1))
    assert np.array_equal(found.tracks.point[first], found.tracks.point[second])
    errors, typical = scene.errors_of(found.tracks), scene.typical(found.tracks)
    assert len(errors) > 200
    assert (typical < 0.12).all()
    assert np.abs(np.median(errors, axis=0)).max() < 0.03
    # both ends carry half the variance of a registration
    stated = np.sqrt(np.median(found.tracks.sigma[first] ** 2 + found.tracks.sigma[second] ** 2))
    assert 0.5 < np.median(typical) / stated < 1.6
    report = found.pairs[0]
    assert report.inlier_share == report.verified / report.matches
    assert report.control_share <= 0.01
    assert report.angle == pytest.approx(20.85, abs=0.1)
    # of exact image points from their prediction by the delivered cameras, along and across
    one, two = (shot.exact for shot in scene.scene.shots)
    xy = np.random.default_rng(0).uniform(20, 280, (200, 2))
    seen = two.project(one.localize(xy, np.full(200, float(np.nanmean(scene.altitude[0])))))
    truth = np.median(epipolar_segments(*scene.views, xy).errors(seen), axis=0)
    assert report.offset == pytest.approx(truth, abs=2.0)


@pytest.mark.slow
def test_the_band_that_is_asked_for_is_matched(scene: Rendered, tmp_path) -> None:
    stacked = [altered(view, tmp_path, lambda d: np.stack([np.zeros_like(d), d])) for view in scene.views]
    both = [scene.tied, find_tracks(stacked, TieOptions(band=2))]
    np.testing.assert_array_equal(both[0].tracks.xy, both[1].tracks.xy)


def test_names_are_those_of_the_tables() -> None:
    with pytest.raises(InputError, match="matcher 'other' is not one of guided, structure"):
        TieOptions(matcher="other")


def test_tiles_are_as_large_as_asked_for(scene: Rendered) -> None:
    assert max(side for box in tiles((1000, 700), 256) for side in box[2:]) == 256
    view = scene.views[0]
    stored = survey(view.path, 1)
    assert stored is not None
    small = detect_tile(view.path, view.size, (0, 0, 128, 128), stored, KeypointDensity(0.1, 1, 128))
    assert (small.xy < 128).all()


@pytest.mark.parametrize(("shift", "overlap"), [(250, 0.51), (400, 0.21)])
def test_pairs_are_those_within_the_bounds(shift: float, overlap: float) -> None:
    """Half a kilometre square, shifted; one leans 0.1 px a metre, 5 m to the other, seen under 2.9 degrees."""
    two = views(camera(0.0, lean=0.0), camera(shift * METRE, lean=0.1))
    (pair,) = select_pairs(two, TieOptions())
    assert pair.views == (0, 1)
    assert pair.overlap == pytest.approx(overlap, abs=0.01)
    assert pair.angle == pytest.approx(float(np.degrees(np.arctan(0.05))), abs=0.05)
    within: list[dict[str, Any]] = [
        {"min_overlap": pair.overlap - 0.01}, {"angles": (pair.angle - 0.01, 60)}, {"angles": (0, pair.angle + 0.01)},
    ]  # fmt: skip
    beyond: list[dict[str, Any]] = [
        {"min_overlap": pair.overlap + 0.01}, {"angles": (pair.angle + 0.01, 60)}, {"angles": (0, pair.angle - 0.01)},
    ]  # fmt: skip
    for given in within:
        assert select_pairs(two, TieOptions(**given, search=0.1)) == [pair]
    for given in beyond:
        with pytest.raises(Exception, match="groups"):
            select_pairs(two, TieOptions(**given, search=0.1))


def test_a_view_gets_as_many_partners_as_asked_for() -> None:
    row = [camera(10 * METRE * k, lean=0.0) for k in range(12)]
    for asked in (1, 2, 4):
        pairs = select_pairs(views(*row), TieOptions(neighbours=asked))
        count = np.bincount([i for pair in pairs for i in pair.views], minlength=12)
        assert count.min() >= asked
        assert len(pairs) <= 12 * asked
    assert len(pairs) < 12 * 11 / 2


@pytest.mark.slow
def test_the_search_reaches_as_far_as_asked_for(scene: Rendered) -> None:
    """The second camera is 80 px wrong across the epipolar lines."""
    where = epipolar_segments(*scene.views, np.array([[150.0, 150.0]]))
    aside = np.array([-where.axis[1], where.axis[0]]) * 80.0
    second = scene.views[1]
    wrong = (scene.views[0], replace(second, sensor=second.sensor.crop(*-aside)))
    found, pairs = known(scene)
    _, there = match_pair(wrong, found, pairs[0], TieOptions(search=150.0))
    assert there.offset[1] - scene.tied.pairs[0].offset[1] == pytest.approx(-80.0, abs=1.5)
    _, nowhere = match_pair(wrong, found, pairs[0], TieOptions(search=30.0))
    assert nowhere.status == "no common offset within 30 px"


@pytest.mark.slow
def test_a_pair_needs_as_many_matches_as_asked_for(scene: Rendered) -> None:
    kept, verified = len(scene.tied.tracks) // 2, scene.tied.pairs[0].verified
    assert kept < verified
    assert len(find_tracks(scene.views, TieOptions(min_matches=kept)).tracks) == 2 * kept
    more = find_tracks(scene.views, TieOptions(min_matches=kept + 1))  # those that are not registered stay
    assert kept < more.tracks.num_points <= verified
    assert more.pairs[0].unregistered == more.tracks.num_points - kept


@pytest.mark.nightly  # every way is tried
def test_a_pair_of_fewer_matches_than_asked_for_is_refused(scene: Rendered) -> None:
    with pytest.raises(Exception, match="too few matches"):
        find_tracks(scene.views, TieOptions(min_matches=2 * scene.tied.pairs[0].verified))


@pytest.mark.parametrize(
    "wrong",
    [
        {"tile": 127}, {"min_matches": 3}, {"min_overlap": 1.01},
        {"ratio": 1.01}, {"angles": (-0.1, 9.0)}, {"angles": (9.0, 8.0)},
        {"search": 0.0}, {"band": 0},
    ],
)  # fmt: skip
def test_options_out_of_range_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        TieOptions(**wrong)


def test_options_at_the_end_of_their_range_are_taken() -> None:
    low = TieOptions(tile=128, min_matches=4, min_overlap=0.0, angles=(0.0, 0.0), ratio=1.0)
    assert (low.tile, low.ratio) == (128, 1.0)
    assert TieOptions(min_overlap=1.0, band=1).min_overlap == 1.0


@pytest.mark.parametrize(
    ("overlap", "angle", "score"),
    [
        (0.8, 0.0, 0.8),
        (0.8, 3.0, 0.8),
        (0.8, 14.5, 0.8),
        (0.8, 15.0, 0.8),
        (0.8, 16.5, 0.8 * np.exp(-0.1)),
        (0.8, 30.0, 0.8 / np.e),
        (0.5, 45.0, 0.5 / np.e**2),
    ],
)
def test_a_pairs_worth_is_its_overlap_less_by_e_for_every_fifteen_degrees(overlap, angle, score) -> None:
    assert Pair((0, 1), overlap, angle).score == pytest.approx(score)


def test_of_partners_with_the_same_overlap_the_moderate_angle_is_taken() -> None:
    """Three leaning cameras about one place: 0 and 1 under a small angle, 2 far off both."""
    three = views(camera(0.0, lean=0.0), camera(0.0, lean=0.3), camera(0.0, lean=2.0))
    pairs = select_pairs(three, TieOptions(neighbours=1))
    assert [pair.views for pair in pairs] == [(0, 1), (1, 2)]


def test_common_altitudes_are_those_that_both_ranges_hold() -> None:
    two = views(camera(0.0), camera(0.0))
    ranges = [((0, 100), (40, 200), (40, 100)), ((0, 10), (50, 90), (10, 50)), ((0, 9), (2, 3), (2, 3))]
    for first, second, common in ranges:
        given = (replace(two[0], alt_range=first), replace(two[1], alt_range=second))
        assert common_range(*given) == common
        assert common_range(*given[::-1]) == common


def test_the_penalties_of_dense_matching_are_opencv_s_for_disparities_twice_as_fine() -> None:
    """8 and 32 times the pixels of a window, by the manual of StereoSGBM; of one channel."""
    assert dense.COLUMNS_PER_PIXEL == 2
    assert dense.SGBM["P1"] == dense.COLUMNS_PER_PIXEL * 8 * dense.SGBM["blockSize"] ** 2 == 400
    assert dense.SGBM["P2"] == dense.COLUMNS_PER_PIXEL * 32 * dense.SGBM["blockSize"] ** 2 == 1600
