"""Every option of the tie points, and the pieces of the matcher, each against its plain definition."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest

from barpc.errors import InputError
from barpc.raster import open_raster
from barpc.scene import Tracks
from barpc.tie import TieOptions, TieResult, find_tracks, select_pairs
from barpc.tie.epipolar import (
    Affine,
    Frame,
    agreeing,
    common_range,
    frame,
    grouped,
    linear_map,
    robust_affine,
    robust_spread,
)
from barpc.tie.features import Share, detect_tile, join
from barpc.tie.matcher import NO_MATCHES, Matches, Prediction
from barpc.tie.matching import MATCHERS, PairReport, _better, _latest, _Search, enough
from barpc.tie.pairs import Pair
from barpc.tie.raster import survey, tiles
from barpc.tie.register import (
    Registration,
    _at,
    _joined,
    _Links,
    _parts,
    _shared,
    _sparse,
    references,
    register_places,
)
from barpc.tie.tracks import require_tracks, thin
from tests.constants import CONSTANTS, chosen
from tests.tie.conftest import Rendered, write_image
from tests.tie.test_pairs import METRE, camera, views


@pytest.fixture(scope="module")
def scene(render) -> Rendered:
    return render(views=2, size=(300, 300))


class Row(NamedTuple):
    """An option from one value to another, and what grows (1) or shrinks (-1) by it."""

    field: str
    low: Any
    high: Any
    observable: Callable[[TieResult], float]
    sign: int
    rest: dict[str, Any] = {}  # noqa: RUF012 - never changed


def keypoints(found: TieResult) -> float:
    return sum(found.keypoints)


def verified(found: TieResult) -> float:
    return found.pairs[0].verified


def kept(found: TieResult) -> float:
    return len(found.tracks)


ROWS = [
    Row("cell", 32, 150, keypoints, -1, {"keypoints_per_cell": 10}),
    Row("keypoints_per_cell", 10, 40, keypoints, 1),
    Row("keypoints_per_image", 200, 5000, keypoints, 1),
    Row("contrast", 0.005, 0.05, keypoints, -1, {"keypoints_per_cell": 1000}),
    Row("ratio", 0.5, 0.9, verified, 1),
    Row("false_share", 0.0005, 0.2, verified, 1),
    Row("tolerance", 0.01, 3.0, lambda found: found.pairs[0].matches, 1),
    Row("min_correlation", 0.5, 0.99, kept, -1),
    Row("points_per_image", 100, 5000, kept, 1),
    Row("patch", 9, 31, lambda found: float(np.median(found.tracks.sigma)), -1, {"min_correlation": 0.01}),
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


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.field)
def test_an_option_changes_the_result_in_its_direction(scene: Rendered, row: Row) -> None:
    found = []
    for value in (row.low, row.high):
        with chosen(TieOptions, **{**row.rest, row.field: value}) as options:
            found.append(row.observable(find_tracks(scene.views, options)))
    few, many = found
    assert (many / few if row.sign > 0 else few / many) > 1.05, (few, many)


def test_what_is_found_lies_where_the_truth_is_and_errs_as_it_says(scene: Rendered) -> None:
    found = find_tracks(scene.views)
    first, second = (found.tracks.view == v for v in (0, 1))
    xy = found.tracks.xy
    assert np.array_equal(found.tracks.point[first], found.tracks.point[second])
    errors = scene.errors(0, 1, xy[first], xy[second])
    assert len(errors) > 200
    typical = 1.4826 * np.median(np.abs(errors), axis=0)
    assert (typical < 0.12).all()
    assert np.abs(np.median(errors, axis=0)).max() < 0.03
    # both ends carry half the variance of a registration
    stated = np.sqrt(np.median(found.tracks.sigma[first] ** 2 + found.tracks.sigma[second] ** 2))
    assert 0.5 < np.median(typical) / stated < 1.6
    report = found.pairs[0]
    assert report.inlier_share == report.verified / report.matches
    assert report.control_share <= 0.01
    assert report.angle == pytest.approx(20.85, abs=0.1)
    truth = _offset(scene)
    assert report.offset == pytest.approx(truth, abs=2.0)


def _offset(scene: Rendered) -> tuple[float, float]:
    """Of exact image points from their prediction by the delivered cameras, along and across."""
    one, two = (shot.exact for shot in scene.scene.shots)
    rng = np.random.default_rng(0)
    xy = rng.uniform(20, 280, (200, 2))
    alt = float(np.nanmean(scene.altitude[0]))
    seen = two.project(one.localize(xy, np.full(200, alt)))
    along, across = np.median(frame(*scene.views, xy).errors(seen), axis=0)
    return float(along), float(across)


def test_the_band_that_is_asked_for_is_matched(scene: Rendered, tmp_path) -> None:
    stacked = []
    for view in scene.views:
        with open_raster(view.path) as source:
            pixels = source.read(1)
        path = write_image(tmp_path / f"{view.name}.tif", np.stack([np.zeros_like(pixels), pixels]))
        stacked.append(replace(view, path=str(path)))
    both = [find_tracks(scene.views), find_tracks(stacked, TieOptions(band=2))]
    np.testing.assert_array_equal(both[0].tracks.xy, both[1].tracks.xy)


def test_names_are_those_of_the_tables() -> None:
    with pytest.raises(InputError, match="matcher 'other' is not one of guided, structure"):
        TieOptions(matcher="other")


def test_tiles_are_as_large_as_asked_for(scene: Rendered) -> None:
    boxes = tiles((1000, 700), TieOptions(tile=256))
    assert {(c, r) for c, r, _, _ in boxes} == {
        (c, r) for c in range(0, 1000, 256) for r in range(0, 700, 256)
    }
    assert max(w for _, _, w, _ in boxes) == 256
    assert sum(w * h for _, _, w, h in boxes) == 700_000
    view = scene.views[0]
    stored = survey(view.path, 1)
    assert stored is not None
    small = detect_tile(view.path, view.size, (0, 0, 128, 128), stored, Share(0.1), TieOptions(tile=128))
    assert (small.xy < 128).all()


@pytest.mark.parametrize(("shift", "overlap"), [(250, 0.5), (400, 0.2)])
def test_pairs_are_those_within_the_bounds(shift: float, overlap: float) -> None:
    """Half a kilometre square, shifted; one leans 0.1 px a metre, seen under 2.9 degrees."""
    two = views(camera(0.0, lean=0.0), camera(shift * METRE, lean=0.1))
    (pair,) = select_pairs(two, TieOptions())
    angle = float(np.degrees(np.arctan(0.05)))
    assert pair.angle == pytest.approx(angle, abs=0.05)
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


def test_the_search_reaches_as_far_as_asked_for(scene: Rendered) -> None:
    """The second camera is 80 px wrong across the epipolar lines."""
    where = frame(*scene.views, np.array([[150.0, 150.0]]))
    aside = np.array([-where.axis[1], where.axis[0]]) * 80.0
    second = scene.views[1]
    wrong = [scene.views[0], replace(second, sensor=second.sensor.crop(*-aside))]
    across = find_tracks(wrong, TieOptions(search=150.0)).pairs[0].offset[1]
    true = find_tracks(scene.views, TieOptions(search=150.0)).pairs[0].offset[1]
    assert across - true == pytest.approx(-80.0, abs=1.5)
    with pytest.raises(Exception, match="no common offset within 30 px"):
        find_tracks(wrong, TieOptions(search=30.0))


def test_a_pair_needs_as_many_matches_as_asked_for(scene: Rendered) -> None:
    kept = len(find_tracks(scene.views).tracks) // 2
    assert len(find_tracks(scene.views, TieOptions(min_matches=kept)).tracks) == 2 * kept
    with pytest.raises(Exception, match=f"only {kept} tracks after registration"):
        find_tracks(scene.views, TieOptions(min_matches=kept + 1))


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


# --- pairs -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overlap", "angle", "score"),
    [(0.8, 3.0, 0.8), (0.8, 15.0, 0.8), (0.8, 30.0, 0.8 / np.e), (0.5, 45.0, 0.5 / np.e**2)],
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


# --- epipolar ----------------------------------------------------------------------------------------------


def test_a_frame_predicts_where_a_point_lies_at_any_altitude(scene: Rendered) -> None:
    one, two = (view.sensor for view in scene.views)
    xy = np.random.default_rng(0).uniform(0, 300, (50, 2))
    low, high = common_range(*scene.views)
    where = frame(*scene.views, xy)
    assert np.hypot(*where.axis) == pytest.approx(1.0)
    for alt in np.linspace(low, high, 5):
        seen = two.project(one.localize(xy, np.full(50, alt)))
        errors = where.errors(seen)
        expected = where.after * (2 * (alt - low) / (high - low) - 1)
        np.testing.assert_allclose(errors[:, 0], expected, atol=0.02)
        np.testing.assert_allclose(errors[:, 1], 0, atol=0.05)
    np.testing.assert_array_equal(where.before, -where.after)
    moved = where.moved(-2.0).errors(seen) - where.errors(seen)
    np.testing.assert_allclose(moved, [[0.0, 2.0]] * 50, atol=1e-9)
    turned = frame(*scene.views, xy[:7], np.array([0.0, 1.0]))
    np.testing.assert_array_equal(turned.axis, [0.0, 1.0])
    np.testing.assert_allclose(turned.errors(turned.place(where.after[:7]))[:, 1], 0, atol=1e-9)


def test_the_linear_map_is_the_central_difference_at_one_altitude(scene: Rendered) -> None:
    one, two = (view.sensor for view in scene.views)
    xy, alt = np.array([[100.0, 200.0], [30.0, 40.0]]), np.full(2, np.mean(common_range(*scene.views)))
    found = linear_map(*scene.views, xy)
    for axis in (0, 1):
        step = np.eye(2)[axis]
        high, low = (two.project(one.localize(xy + s * step, alt)) for s in (0.5, -0.5))
        np.testing.assert_allclose(found[..., axis], high - low, atol=1e-4)


def test_an_affine_function_is_found_among_outliers_with_its_spread() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(0, 5000, (400, 2))
    truth = 3.0 + 2e-4 * xy[:, 0] - 5e-4 * xy[:, 1]
    values = truth + rng.normal(0, 0.2, 400)
    values[::4] += rng.uniform(5, 50, 100)
    found = robust_affine(xy, values)
    assert isinstance(found, Affine)
    np.testing.assert_allclose(found(xy), truth, atol=0.1)
    assert 0.2 < found.spread < 0.4  # a quarter is wrong
    clean = robust_affine(xy, truth + rng.normal(0, 0.2, 400))
    assert clean.spread == pytest.approx(0.2, rel=0.12)
    constant = robust_affine(xy[:29], truth[:29])
    assert (constant.coefficients[1:] == 0).all()
    assert (robust_affine(xy[:30], truth[:30]).coefficients[1:] != 0).all()


def test_an_affine_function_is_that_of_its_own_weights() -> None:
    """Tukey's biweight at the end of the iteration: the weighted residuals are orthogonal to 1, x and y."""
    rng = np.random.default_rng(6)
    xy = rng.uniform(0, 5000, (400, 2))
    values = 1e-3 * xy[:, 0] + rng.normal(0, 0.2, 400)
    values[:120] += rng.uniform(1, 10, 120)
    residual = values - robust_affine(xy, values)(xy)
    weight = np.maximum(0.0, 1.0 - (residual / (4.685 * robust_spread(residual))) ** 2) ** 2
    design = np.column_stack([np.ones(400), (xy - 2500) / 5000])
    assert np.abs(design.T @ (weight * residual)).max() < 1e-3 * np.abs(design.T @ np.abs(residual)).max()


@pytest.mark.parametrize("scale", [0.02, 1.0, 1000.0])
def test_an_affine_function_of_values_of_any_size_is_the_same(scale: float) -> None:
    """A third is wrong by up to fifty standard deviations: from the median it takes several steps."""
    rng = np.random.default_rng(6)
    xy = rng.uniform(0, 5000, (400, 2))
    values = 1e-3 * xy[:, 0] + rng.normal(0, 0.2, 400)
    values[:130] += rng.uniform(0.5, 10, 130)
    exact = robust_affine(xy, values, steps=100)
    found = robust_affine(xy, scale * values)
    np.testing.assert_allclose(found.coefficients / scale, exact.coefficients, atol=2e-3)
    assert found.spread / scale == pytest.approx(exact.spread, rel=2e-3)


def test_the_mad_is_a_standard_deviation_about_zero() -> None:
    assert robust_spread(np.array([-2.0, 1.0, 3.0])) == pytest.approx(1.4826 * 2.0)
    assert robust_spread(np.empty(0)) == 0.0
    shifted = np.array(
        [8.0, 10.0, 13.0]
    )  # of residuals the shift counts, of a sample about its median it does not
    assert robust_spread(shifted) == pytest.approx(1.4826 * 10.0)
    assert robust_spread(shifted, np.median(shifted)) == pytest.approx(1.4826 * 2.0)
    assert robust_spread(np.stack([shifted, -shifted]), np.array([[10.0], [0.0]])) == pytest.approx(
        [1.4826 * 2, 1.4826 * 10]
    )
    assert robust_spread(np.random.default_rng(0).normal(0, 5, 20000)) == pytest.approx(5.0, rel=0.03)


def test_what_agrees_lies_within_three_deviations_or_the_floor_window_by_window() -> None:
    rng = np.random.default_rng(2)
    xy = np.vstack([rng.uniform(0, 2000, (200, 2)), rng.uniform(0, 2000, (200, 2)) + [4096, 0]])
    noise = rng.uniform(-0.1, 0.1, 400)
    values = noise + np.where(xy[:, 0] > 3000, 40.0, 0.0)
    values[5], values[6], values[205] = 0.32, 0.28, 40.0 + 0.32
    keep, residual = agreeing(xy, values, floor=0.3)
    assert np.flatnonzero(~keep).tolist() == [5, 205]
    np.testing.assert_allclose(residual[:5], values[:5], atol=0.05)
    wide = rng.normal(0, 1.0, 400)
    wide[7], wide[8] = 4.5, 2.3
    keep, _ = agreeing(xy[:200], wide[:200], floor=0.3)
    assert not keep[7]
    assert keep[8]
    assert agreeing(xy[:0], values[:0])[0].shape == (0,)


# --- refinement --------------------------------------------------------------------------------------------


def _tracks(*rows: tuple[int, int]) -> Tracks:
    view, point = np.array(rows).T
    xy = np.arange(2.0 * len(rows)).reshape(-1, 2) * 10.0 + 0.3
    return Tracks(view, point, xy, np.full(len(rows), 0.2))


def test_the_reference_of_a_track_is_the_view_most_like_the_others() -> None:
    tracks = _tracks((0, 0), (1, 0), (2, 0), (0, 1), (2, 1), (1, 2), (2, 2))
    assert references(tracks, {(0, 1): 0.1, (1, 2): 0.1, (0, 2): 0.5}, 3).tolist() == [1, 3, 5]
    assert references(tracks, {(0, 1): 0.1, (1, 2): 0.5, (0, 2): 0.1}, 3).tolist() == [0, 3, 5]
    # a pair that was not matched counts as twice the worst
    assert references(tracks, {(0, 2): 0.3, (1, 2): 0.4}, 3).tolist() == [2, 3, 5]


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
@pytest.mark.parametrize(
    "spreads",
    [
        {(0, 1): 0.1, (0, 2): 0.5, (1, 2): 0.9, (1, 3): 0.9, (2, 3): 0.1},
        {(0, 1): 0.9, (0, 2): 0.9, (1, 2): 1.0, (2, 3): 0.1},
        {(0, 1): 0.1, (0, 2): 0.1, (1, 3): 0.7, (2, 3): 1.0, (1, 2): 0.9},
        {(0, 1): 0.1, (0, 2): 0.1, (1, 3): 0.9, (2, 3): 0.5, (1, 2): 0.5},
    ],
)
def test_a_pair_that_was_not_matched_is_twice_as_unlike_as_the_worst(spreads, scale) -> None:
    def unlike(i: int, j: int) -> float:
        return spreads.get((min(i, j), max(i, j)), 2 * max(spreads.values())) if i != j else 0.0

    best = int(np.argmin([sum(unlike(i, j) for j in range(4)) for i in range(4)]))
    found = references(_tracks(*((v, 0) for v in range(4))), {p: scale * x for p, x in spreads.items()}, 4)
    assert found.tolist() == [best]


def test_a_point_is_on_the_mask_where_its_nearest_pixel_is() -> None:
    mask = np.zeros((4, 6), dtype=bool)
    mask[0, 0] = mask[3, 5] = mask[0, 5] = mask[2, 3] = mask[1, 1] = True
    places = [[0, 0], [0.4, -0.4], [0, 1], [5, 3], [5.4, 3.4], [5, 0], [5, 2], [3, 2], [2, 3], [-0.6, 0], [0, -0.6],
              [5.6, 3], [5, 3.6], [np.nan, 0], [np.nan, 1], [1, np.nan], [np.nan, np.nan]]  # fmt: skip
    expected = [1, 1, 0, 1, 1, 1, 0, 1] + [0] * 9
    np.testing.assert_array_equal(_at(mask, np.array(places, dtype=float)), np.array(expected, dtype=bool))


def test_the_variance_of_a_registration_is_shared_by_both_ends() -> None:
    tracks = _tracks((0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (0, 2), (2, 2))
    of_track = np.array([0, 3, 5])
    rows, xy = np.array([1, 2, 4]), np.array([[1.25, 2.5], [3.25, 4.5], [5.5, 6.5]])
    sigma = np.array([0.2, 0.4, 0.01])
    found = _shared(tracks, of_track, rows, xy, sigma)
    assert found.point.tolist() == [0, 0, 0, 1, 1]  # the third is found nowhere
    expected = [np.sqrt((0.02 + 0.08) / 2), np.sqrt(0.02), np.sqrt(0.08), 0.02, 0.02]
    np.testing.assert_allclose(found.sigma, expected)
    np.testing.assert_allclose(found.xy[[1, 2, 4]], xy)
    np.testing.assert_array_equal(found.xy[[0, 3]], np.rint(tracks.xy[[0, 3]]))


@pytest.mark.parametrize(
    ("count", "noise", "scaled"), [(200, 0.3, 0.3), (200, 0.02, 0.1), (19, 0.3, 0.1), (20, 0.3, 0.3)]
)
def test_sigmas_are_those_of_the_epipolar_lines_where_these_say_more(count, noise, scaled) -> None:
    two = views(camera(0.0, lean=0.0), camera(0.0, lean=0.2))
    rng = np.random.default_rng(4)
    places = rng.integers(100, 900, (count, 2)).astype(float)
    xy = np.stack([places, frame(*two, places).place(np.zeros(count))], axis=1).reshape(-1, 2)
    tracks = Tracks(np.tile([0, 1], count), np.repeat(np.arange(count), 2), xy, np.full(2 * count, 0.1))
    links = _Links(two, tracks, np.arange(0, 2 * count, 2), np.arange(1, 2 * count, 2))
    across = rng.normal(0, noise, count)
    found = Registration.none(xy[1::2] + np.column_stack([rng.uniform(-5, 5, count), across]))
    found.sigma[:] = 0.1
    sigma = links.scaled(found, np.ones(count, dtype=bool))
    np.testing.assert_allclose(sigma, scaled, rtol=0.3 if scaled > 0.1 else 1e-12)


def links_of(count: int, seen: int) -> _Links:
    """Tracks in a row of `seen` like views, referred to the first."""
    many = views(*(camera(0.0, lean=0.2 * v) for v in range(seen)))
    xy = np.repeat(np.random.default_rng(5).integers(100, 900, (count, 2)).astype(float), seen, axis=0)
    tracks = Tracks(
        np.tile(np.arange(seen), count), np.repeat(np.arange(count), seen), xy, np.full(seen * count, 0.1)
    )
    rows = np.arange(seen * count)
    other = rows[rows % seen > 0]
    return _Links(many, tracks, other - other % seen, other)


def test_links_that_disagree_in_altitude_with_all_their_neighbours_are_torn() -> None:
    """Three views: two links a track, 20 px of half a segment. Two pixels of altitude apart, neither is believed."""
    links = links_of(60, 3)
    good, reach = np.ones(120, dtype=bool), np.full(120, 20.0)
    altitude = np.repeat(np.random.default_rng(1).uniform(-0.5, 0.5, 60), 2)
    assert not links._torn(good, altitude, reach).any()
    wrong = altitude.copy()
    wrong[[10, 41]] += 0.1
    assert np.flatnonzero(links._torn(good, wrong, reach)).tolist() == [10, 11, 40, 41]
    tolerated = altitude.copy()
    tolerated[10] += 0.19 / 20.0  # a fifth of a pixel
    assert not links._torn(good, tolerated, reach).any()
    # an affine function of place is a camera's error
    tilted = altitude.copy()
    tilted[1::2] += 1e-3 * links.origin[1::2, 0] / 20.0 * 20.0
    assert not links._torn(good, tilted, reach).any()
    # short segments tell no altitude, nor do links that are out already
    assert not links._torn(good, wrong, np.full(120, 4.9)).any()
    assert links._torn(good, wrong, np.full(120, 5.1)).sum() == 4
    good[11] = False
    assert np.flatnonzero(links._torn(good, wrong, reach)).tolist() == [40, 41]


def test_of_four_views_the_link_that_contradicts_two_neighbours_is_torn_alone() -> None:
    links = links_of(60, 4)
    altitude = np.repeat(np.random.default_rng(1).uniform(-0.5, 0.5, 60), 3)
    altitude[30] += 0.2  # the first of its track: its neighbour agrees with the third
    torn = links._torn(np.ones(180, dtype=bool), altitude, np.full(180, 20.0))
    assert np.flatnonzero(torn).tolist() == [30]


def test_what_is_verified_is_on_its_line_at_its_altitude_and_no_less_certain_than_others() -> None:
    links = links_of(60, 3)
    altitude = np.repeat(np.random.default_rng(1).uniform(-0.5, 0.5, 60), 2)
    xy = np.empty((120, 2))
    for group in links.groups():
        where = frame(*links.of(group), links.origin[group])
        xy[group] = where.place(altitude[group] * where.after)
        assert 15.0 < np.median(where.after) < 45.0
        aside = np.array([-where.axis[1], where.axis[0]])
    found = Registration(xy, np.ones(120), np.full(120, 0.1), np.ones(120, dtype=bool))
    every = np.ones(120, dtype=bool)
    assert links.verified(found, every).all()
    few = every.copy()
    few[::3] = False
    np.testing.assert_array_equal(links.verified(found, few), few)
    off = Registration(xy.copy(), found.correlation, found.sigma.copy(), found.ok)
    off.xy[20] += 0.15 * aside  # off its line
    off.xy[51] += 3.0 * np.array([aside[1], -aside[0]])  # along it: at another altitude than its neighbour
    off.sigma[80], off.sigma[90] = 0.21, 0.19  # of the median 0.1 twice is tolerated
    left = links.verified(off, every)
    assert np.flatnonzero(~left).tolist() == [20, 50, 51, 80]


def test_tiles_that_follow_each_other_share_a_task_as_far_as_it_holds_their_points() -> None:
    groups = [np.arange(first, last) for first, last in ((0, 3), (3, 5), (5, 6), (6, 12), (12, 14))]
    for most, lengths in ((1, [3, 2, 1, 6, 2]), (5, [5, 1, 6, 2]), (6, [6, 6, 2]), (14, [14])):
        joined = _joined(groups, most)
        assert [len(part) for part in joined] == lengths
        np.testing.assert_array_equal(np.concatenate(joined), np.arange(14))
    assert _joined([], 5) == []


@pytest.mark.parametrize("count", [1300, 60_000])
def test_few_points_are_registered_in_bands_of_rows_swept_by_columns(count: int) -> None:
    places = np.random.default_rng(0).uniform(0, 40_000, (count, 2))
    links = np.arange(count) + 7
    parts = _parts(places, links, 1024)
    assert max(len(part) for part in parts) <= 512
    assert len(parts) <= 1.1 * count / 512 + count / 400  # nearly full
    assert sorted(np.concatenate(parts)) == links.tolist()
    if count < 10_000:  # a band is in one task: strips are decoded once
        bands = [set(places[part - 7, 1] // 512) for part in parts]
        assert sum(map(len, bands)) == len(set.union(*bands))
    swept = places[np.concatenate(parts) - 7]
    assert (np.diff(swept[:, 1] // 512) >= 0).all()
    same = np.diff(swept[:, 1] // 512) == 0
    assert (np.diff(swept[:, 0])[same] >= 0).all()


@pytest.mark.parametrize("integers", [True, False])
def test_places_far_apart_are_found_as_in_one_window(tmp_path, monkeypatch, integers: bool) -> None:
    """Some of them near the border; the second image shows the first one moved."""
    noise = np.random.default_rng(0).uniform(100, 3000, (700, 600)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    moved = np.ascontiguousarray(np.roll(smooth, (3, -2), axis=(0, 1)))
    data = [image.astype(np.uint16) if integers else image.astype(np.float64) for image in (smooth, moved)]
    files = tuple(
        (str(write_image(tmp_path / f"{k}.tif", image)), (600, 700)) for k, image in enumerate(data)
    )
    reference = np.array([[100.0, 150.0], [9, 300], [400, 690], [300, 400], [585, 20], [50, 680], [250, 250]])
    start = reference + [-1.6, 3.3]
    linear = np.tile(np.eye(2), (len(start), 1, 1))
    assert _sparse(reference, 28)
    apart = register_places(files, 1, reference, start, linear, 21)
    monkeypatch.setattr("barpc.tie.register._sparse", lambda *_: False)
    together = register_places(files, 1, reference, start, linear, 21)
    np.testing.assert_array_equal(apart.ok, together.ok)
    assert 4 <= apart.ok.sum() < len(start)  # a patch that reaches beyond the border is not registered
    np.testing.assert_allclose(apart.xy[apart.ok], together.xy[apart.ok], atol=0.002)
    np.testing.assert_allclose(apart.xy[apart.ok], (reference + [-2, 3])[apart.ok], atol=0.01)


def test_patches_are_registered_tile_by_tile(monkeypatch) -> None:
    links, seen = links_of(80, 3), []

    def ordered(executor: Any, function: Any, tasks: Any, name: str, progress: Any) -> list[Registration]:
        seen.extend(tasks)
        return [Registration.none(task[3]) for task in tasks]

    monkeypatch.setattr("barpc.tie.register.ordered", ordered)
    monkeypatch.setattr("barpc.tie.register._sparse", lambda *_: False)
    monkeypatch.setattr("barpc.tie.register._ALL_OF_A_PAIR", 1)
    found = links.register(TieOptions(tile=256), None, None)
    assert len(found.xy) == 160
    for _, band, origin, start, linear, structural, tile in seen:
        assert (np.ptp(np.floor(origin / 256), axis=0) == 0).all()
        assert (band, structural, tile) == (1, False, 256)
        assert len(origin) == len(start) == len(linear)
    assert sum(len(task[2]) for task in seen) == 160
    assert len(seen) > 20
    np.testing.assert_array_equal(
        np.sort(found.xy, axis=0), np.sort(np.concatenate([t[3] for t in seen]), axis=0)
    )


def test_rows_aregrouped_by_equal_keys() -> None:
    a, b = np.array([1, 0, 1, 1, 0]), np.array([2, 5, 2, 1, 5])
    groups = grouped(a, b)
    assert [group.tolist() for group in groups] == [[1, 4], [3], [0, 2]]
    assert grouped(a[:0], b[:0]) == []


def test_tracks_must_tie_every_pair_after_registration() -> None:
    two = views(camera(0.0), camera(100 * METRE))
    pairs = select_pairs(two, TieOptions())
    reports = [PairReport(("v0", "v1"), "ok", (50, 50), 30, 20)]
    tracks = _tracks(*[(v, p) for p in range(12) for v in (0, 1)])
    require_tracks(two, tracks, pairs, reports, TieOptions(min_matches=12))
    with pytest.raises(Exception, match="only 12 tracks after registration"):
        require_tracks(two, tracks, pairs, reports, TieOptions(min_matches=13))


# --- matching ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keypoints", "overlap", "verified", "stands"),
    [
        ((5000, 4000), 1.0, 100, True),
        ((5000, 4000), 1.0, 99, False),
        ((360, 400), 0.5, 54, True),  # a third of what a small image has in the common area
        ((360, 400), 0.5, 53, False),
        ((360, 400), 0.1, 30, True),
        ((360, 400), 0.1, 29, False),
        ((0, 0), 1.0, 99, False),  # of a matcher that wants no keypoints
        ((360, 400), float("nan"), 99, False),
    ],
)
def test_a_pair_is_tried_again_where_it_has_fewer_matches_than_it_should(
    keypoints, overlap, verified, stands
) -> None:
    report = PairReport(("v0", "v1"), "ok", keypoints, verified, verified, overlap=overlap)
    assert enough(report) == stands
    assert not enough(replace(report, status="too few matches"))


def test_a_report_says_which_attempts_found_fewer_of_how_many_that_were_wanted() -> None:
    few = PairReport(("v0", "v1"), "ok", (360, 400), 40, 20, overlap=0.5)
    loose = replace(few, verified=25, loosened=True)
    many = replace(few, matcher="structure", keypoints=(0, 0), verified=240)
    first = _better((NO_MATCHES, few), (NO_MATCHES, loose))
    assert first[1] == replace(loose, beaten=("guided 20 of 54",))
    assert _better(first, (NO_MATCHES, many))[1] == replace(
        many, beaten=("guided 20 of 54", "guided, loosened 25 of 54")
    )
    none = replace(many, status="too few matches", verified=0)
    assert _better(first, (NO_MATCHES, none))[1].beaten == ("guided 20 of 54", "structure 0 of 100")
    assert _better((NO_MATCHES, few))[1].beaten == ()


class Scripted:
    """A matcher that knows its answers: scores in the true band, and in the bands to either side."""

    detects = True

    def __init__(self, true: list[float], aside: tuple[list[float], list[float]] = ([], [])) -> None:
        self.true, self.aside, self.asked = true, aside, []
        self.places = np.random.default_rng(0).uniform(0, 999, (100, 2, 2))

    def match(self, a: Any, b: Any, prediction: Prediction) -> Matches:
        shift = float(prediction.at(np.zeros((1, 2))).across[0])
        self.asked.append(shift)
        score = np.array(self.true if shift == 0 else self.aside[int(shift > 0)])
        return Matches.of_places(self.places[: len(score)], score)


@pytest.fixture
def search(monkeypatch) -> Callable[[Scripted], _Search]:
    def made(matcher: Scripted) -> _Search:
        monkeypatch.setitem(MATCHERS, "scripted", lambda *_: matcher)
        return _Search(
            tuple(views(camera(0.0), camera(0.0))), (join([]), join([])), TieOptions(matcher="scripted")
        )

    return made


FLAT = Prediction(lambda xy: Frame(np.array([1.0, 0.0]), *(np.zeros(len(xy)),) * 5, np.eye(2)), 3.0, list)


@pytest.mark.parametrize(
    ("aside", "share", "count", "stated"),
    [
        (([], []), 0.01, 100, 0.0),
        (([0.505], [0.505]), 0.01, 100, 0.01),  # two bands: half of two false ones in a hundred
        (([0.505], [0.505]), 0.0099, 50, 0.0),
        (([0.105], [0.205, 0.805]), 0.02, 100, 0.015),
        (([0.105], [0.205, 0.805]), 0.0149, 80, 0.0125),
        (([0.001] * 9, []), 0.04, 0, 0.0),
    ],
)
def test_as_many_matches_are_trusted_as_the_bands_aside_allow(search, aside, share, count, stated) -> None:
    """A hundred matches of scores 0.01 to 1; what lies in a shifted band is half of what is false."""
    matcher = Scripted([0.01 * k for k in range(1, 101)], aside)
    found, control = search(matcher).trusted(FLAT, share)
    assert len(found) == count
    assert control == pytest.approx(stated)
    assert matcher.asked == [0.0, -12.0, 12.0]  # twice the band's half width and six pixels more


def test_no_matches_are_none_in_every_column() -> None:
    assert [len(NO_MATCHES), len(NO_MATCHES.xy), len(NO_MATCHES.score), len(NO_MATCHES.index)] == [0] * 4
    assert NO_MATCHES.index.shape == (0, 2)
    assert np.isnan(NO_MATCHES.sigma) or NO_MATCHES.sigma >= 0


def test_where_the_same_points_lie_is_worked_out_once() -> None:
    asked = []

    def where(xy: np.ndarray) -> Any:
        asked.append(xy)
        return object()

    remembered, xy = _latest(where), np.zeros((3, 2))
    assert remembered(xy) is remembered(xy)
    assert len(asked) == 1
    other = xy.copy()
    assert remembered(other) is not remembered(xy)  # other points, though they are equal
    assert [given is xy for given in asked] == [True, False, True]


class Wrong:
    """A matcher of two like cameras, the second of which is wrong by given amounts along and across the rows."""

    detects = True

    def __init__(self, along: np.ndarray, across: np.ndarray) -> None:
        places = np.random.default_rng(1).uniform(0, 999, (len(along), 2))
        xy = np.stack([places, places + np.column_stack([along, across])], axis=1)
        self.found = Matches.of_places(xy, np.linspace(0, 1, len(along)))

    def match(self, a: Any, b: Any, prediction: Prediction) -> Matches:
        return self.found.select(prediction.contains(self.found.xy))


def test_after_a_blind_pass_the_search_is_where_its_matches_lie(search) -> None:
    """Half their spread and ten pixels more either side along the lines; on the line itself across them."""
    rng = np.random.default_rng(2)
    for spread in (4.0, 12.0):
        along = rng.uniform(3 - spread, 3 + spread, 200)
        found = search(Wrong(along, np.full(200, -5.0))).offset()
        assert found is not None
        places = rng.uniform(0, 999, (5, 2))
        where = found.at(places)
        low, high = np.percentile(along, [2, 98])
        np.testing.assert_allclose(where.before, low - 0.5 * (high - low) - 10.0)
        np.testing.assert_allclose(where.after, high + 0.5 * (high - low) + 10.0)
        np.testing.assert_allclose(where.place(np.full(5, 3.0)), places + [3.0, -5.0], atol=1e-6)


def test_the_correction_across_the_lines_is_one_by_the_place_in_the_first_view(search) -> None:
    """Of a camera that is 300 px off along the lines, and across them by more the farther east."""
    places = np.random.default_rng(1).uniform(0, 999, (200, 2))  # those of `Wrong`
    along = np.random.default_rng(2).uniform(295, 305, 200)
    found = search(Wrong(along, 0.004 * places[:, 0])).offset()
    assert found is not None
    np.testing.assert_allclose(found.at(places).across, places[:, 1] + 0.004 * places[:, 0], atol=0.05)


class Listed(Wrong):
    """Errors across the lines as listed; it writes down what it is asked."""

    def __init__(self, across: np.ndarray) -> None:
        super().__init__(np.linspace(-8, 8, len(across)), across)
        self.asked: list[tuple[float, int | None]] = []

    def match(self, a: Any, b: Any, prediction: Prediction) -> Matches:
        self.asked.append((prediction.half_width, prediction.probes))
        return super().match(a, b, prediction)


def spread_out(count: int, peak: int, at: float = 0.0, width: float = 20.0) -> np.ndarray:
    """So many errors in a peak, the others evenly within the band, outside the peak's window."""
    low, high = (at - 4.5, at + 4.5)
    others = np.linspace(-width + 0.1, width - 0.1, 4 * count)
    others = others[(others < low) | (others > high)]
    return np.r_[np.full(peak, at), others[np.linspace(0, len(others) - 1, count).astype(int)]]


@pytest.mark.parametrize(("peak", "found"), [(7, False), (8, True)])
def test_a_peak_has_eight_matches_or_more(search, peak: int, found: bool) -> None:
    assert (search(Listed(np.full(peak, 2.0)))._blind(20.0, 100) is not None) == found
    # among others, which are too few to matter
    assert (search(Listed(spread_out(3, peak)))._blind(60.0, 100) is not None) == found


@pytest.mark.parametrize(
    ("count", "peak", "width", "found"),
    [(90, 32, 20.0, True), (90, 26, 20.0, False), (90, 17, 60.0, True), (90, 14, 60.0, False)],
)
def test_a_peak_stands_out_by_six_standard_deviations_of_chance(search, count, peak, width, found) -> None:
    chance = count * 4.0 / (2 * width)
    significance = (peak - chance) / np.sqrt(chance + 1)
    assert found == (significance > 6.0)
    assert abs(significance - 6.0) < 1.9
    known = search(Listed(spread_out(count, peak, width=width)))._blind(width, 100)
    assert (known is not None) == found
    if known is not None:
        assert known.share == pytest.approx(peak / (count + peak))
        assert known.significance == pytest.approx(significance, rel=0.03)


@pytest.mark.parametrize(("at", "found"), [(15.9, True), (16.1, False), (-15.9, True), (-16.1, False)])
def test_a_peak_at_the_end_of_the_band_may_go_on_beyond_it(search, at: float, found: bool) -> None:
    assert (search(Listed(np.full(50, at)))._blind(20.0, 100) is not None) == found


def test_passes_grow_wider_until_one_is_clear(search) -> None:
    clear = Listed(spread_out(70, 50))  # more than two fifths
    assert search(clear).offset() is not None
    assert clear.asked == [(20.0, 1500)]
    unclear = Listed(spread_out(80, 50))
    found = search(unclear).offset()
    assert [width for width, _ in unclear.asked] == [20.0, 80.0, TieOptions().search]
    assert [probes for _, probes in unclear.asked] == [1500, 2000, 3000]
    assert found is not None
    assert found.half_width == 3.0
    none = Listed(spread_out(300, 5, width=TieOptions().search))
    assert search(none).offset() is None
    assert len(none.asked) == 3


def test_the_most_significant_peak_decides_where_none_is_clear(search) -> None:
    """Forty matches near the line among ninety, and ninety farther out among two hundred and sixty."""
    across = np.r_[spread_out(90, 40, at=5.0), spread_out(260, 90, at=60.0, width=90.0)]
    found = search(Listed(across)).offset()
    assert found is not None
    places = np.array([[500.0, 500.0]])
    np.testing.assert_allclose(found.at(places).across, [560.0], atol=0.5)


@pytest.mark.parametrize(("noise", "width"), [(0.01, 0.6), (0.3, 1.2), (2.0, 3.0)])
def test_the_local_band_is_four_standard_deviations_wide_within_its_bounds(search, noise, width) -> None:
    rng = np.random.default_rng(3)
    wrong = Wrong(np.full(400, 7.0), rng.normal(0, noise, 400))
    found = search(wrong).local(wrong.found)
    assert found.half_width == pytest.approx(width, rel=0.15)
    where = found.at(np.array([[500.0, 500.0]]))
    np.testing.assert_allclose([where.before, where.after], [[3.0], [11.0]], atol=1e-6)


def test_the_best_come_first_and_each_place_once(search) -> None:
    matcher = Scripted([0.4, 0.3, 0.2, 0.1])
    matcher.places = (
        np.array([[0.0, 0.0], [0.3, 0.2], [50.0, 0.0], [90.0, 0.0]]).repeat(2, 0).reshape(4, 2, 2)
    )
    found = search(matcher)._distinct(FLAT)
    assert found.xy[:, 0, 0].tolist() == [90.0, 50.0, 0.3]  # the first two are one place, the better stays
    assert found.score.tolist() == [0.1, 0.2, 0.3]


def test_a_frames_linear_map_is_that_of_the_middle_of_the_points_that_are_seen(scene: Rendered) -> None:
    xy = np.random.default_rng(0).uniform(100, 5000, (51, 2))
    xy[:3] = np.nan
    with np.errstate(all="ignore"):
        where = frame(*scene.views, xy)
    expected = linear_map(*scene.views, np.median(xy[3:], axis=0))
    np.testing.assert_array_equal(where.linear, expected)
    assert np.abs(linear_map(*scene.views, np.zeros(2)) - expected).max() > 1e-7
    assert np.isnan(where.slope[:3]).all()
    assert np.isfinite(where.slope[3:]).all()


def test_few_tracks_are_handed_back_as_they_are() -> None:
    tracks = _tracks(*[(v, p) for p in range(30) for v in (0, 1)])
    for most in (30, 31, 1000):
        assert thin(tracks, [(1000, 800)] * 2, most) is tracks
    assert thin(tracks, [(1000, 800)] * 2, 29).num_points == 29
    none = tracks.select(tracks.point < 0)
    assert thin(none, [(1000, 800)] * 2, 5) is none


def test_every_place_has_its_four_before_one_has_five() -> None:
    """A hundred tracks at one place of an image and six each at three others."""
    place = np.array([[100.0, 100.0], [900.0, 100.0], [100.0, 900.0], [900.0, 900.0]])
    of = np.repeat([0, 1, 2, 3], [100, 6, 6, 6])
    xy = np.repeat(place[of], 2, axis=0)
    tracks = Tracks(np.tile([0, 1], 118), np.repeat(np.arange(118), 2), xy, np.full(236, 0.1))

    def kept(most: int) -> list[int]:
        left = thin(tracks, [(1000, 1000)] * 2, most)
        near = np.abs(left.xy[left.view == 0][:, None] - place).sum(axis=2).argmin(axis=1)
        return np.bincount(near, minlength=4).tolist()

    assert kept(16) == [4, 4, 4, 4]
    assert kept(28) == [10, 6, 6, 6]
    assert kept(100) == [16, 6, 6, 6]  # and none more than sixteen


def test_cells_hold_the_first_quota_of_as_many_observations_as_are_kept(monkeypatch) -> None:
    seen = []

    def fill(tracks: Tracks, cell: list[int], cells: int, most: int, views: int) -> np.ndarray:
        seen.append((cell, cells))
        return np.ones(tracks.num_points, dtype=bool)

    monkeypatch.setattr(sys.modules["barpc.tie.tracks"], "_fill", fill)
    tracks = _tracks(*[(v, p) for p in range(30) for v in (0, 1)])
    thin(tracks, [(1000, 800), (700, 700)], 20)
    ((cell, count),) = seen
    sides = [np.sqrt(4 * 1000 * 800 / 20), np.sqrt(4 * 700 * 700 / 20)]
    columns, rows = (
        [int(1000 / sides[0]) + 2, int(700 / sides[1]) + 2],
        [int(800 / sides[0]) + 2, int(700 / sides[1]) + 2],
    )
    assert count == columns[0] * rows[0] + columns[1] * rows[1]
    for k, found in enumerate(cell):
        v = int(tracks.view[k])
        col, row = ((tracks.xy[k] + 0.5) // sides[v]).astype(int)
        assert found == v * columns[0] * rows[0] + row * columns[v] + col
