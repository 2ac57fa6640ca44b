"""The passes over a pair: what is found in bands, and what decoys say of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.tie import TieOptions
from barpc.tie.matchers import pair_search
from barpc.tie.matchers.features import join_keypoints
from barpc.tie.matchers.matcher import NO_MATCHES, Matches, Prediction
from barpc.tie.matchers.pair_search import PairSearch, _latest
from barpc.tie.matchers.report import PairReport, better, enough
from barpc.tie.pairing.epipolar import EpipolarSegments
from tests.tie.test_pairs import camera, views


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
def test_a_pair_is_tried_again_where_it_has_fewer_matches_than_it_should(keypoints, overlap, verified, stands) -> None:
    report = PairReport(("v0", "v1"), "ok", keypoints, verified, verified, overlap=overlap)
    assert enough(report) == stands
    assert not enough(replace(report, status="too few matches"))


def test_a_report_says_which_attempts_found_fewer_of_how_many_that_were_wanted() -> None:
    few = PairReport(("v0", "v1"), "ok", (360, 400), 40, 20, spread=0.5, angle=9.0, overlap=0.5)
    loose = replace(few, verified=25, loosened=True)
    many = replace(few, matcher="structure", keypoints=(0, 0), verified=240)
    first = better((NO_MATCHES, few), (NO_MATCHES, loose))
    assert first[1] == replace(loose, beaten=("guided 20 of 54",))
    assert better(first, (NO_MATCHES, many))[1] == replace(
        many, beaten=("guided 20 of 54", "guided, loosened 25 of 54")
    )
    none = replace(many, status="too few matches", verified=0)
    assert better(first, (NO_MATCHES, none))[1].beaten == ("guided 20 of 54", "structure 0 of 100")
    assert better((NO_MATCHES, few))[1].beaten == ()
    refused = replace(many, status="too few matches")
    for attempts in ((refused, few), (few, refused)):  # however many it has verified
        assert better(*((NO_MATCHES, one) for one in attempts))[1] == replace(few, beaten=("structure 240 of 100",))
    others = replace(NO_MATCHES)
    assert better((NO_MATCHES, few), (others, many))[0] is others
    assert better((NO_MATCHES, few), (others, few))[0] is NO_MATCHES  # of equals the earlier one


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
def search(in_table) -> Callable[..., PairSearch]:
    """`search(matcher, **options)`: the search of a pair of like cameras with it."""

    def made(matcher: Any, keypoints: Any = None, **options: Any) -> PairSearch:
        ends = tuple(views(camera(0.0), camera(0.0)))
        chosen = TieOptions(matcher=in_table(lambda *_: matcher), **options)
        return PairSearch(ends, keypoints or (join_keypoints([]),) * 2, chosen)

    return made


def test_a_matcher_without_keypoints_has_its_frame_at_the_middles_of_the_tiles_that_both_share(search, monkeypatch):
    asked: list[Any] = []
    monkeypatch.setattr(pair_search, "shared_tiles", lambda *_: [[(0, 0, 100, 50), (100, 20, 60, 40)]])
    monkeypatch.setattr(
        pair_search, "epipolar_segments", lambda a, b, points: asked.append(points) or SimpleNamespace(axis=None)
    )
    search(SimpleNamespace(detects=False))
    assert [points.tolist() for points in asked] == [[[50.0, 25.0], [130.0, 40.0]]]
    search(Scripted([]), (SimpleNamespace(xy="of the first"), SimpleNamespace(xy="of the second")))
    assert asked[1] == "of the first"


FLAT = Prediction(
    lambda xy: EpipolarSegments(np.array([1.0, 0.0]), *(np.zeros(len(xy)),) * 5, lambda: np.eye(2)), 3.0, list
)


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
    assert [column.shape for column in (NO_MATCHES.xy, NO_MATCHES.score, NO_MATCHES.index)] == [(0, 2, 2), (0,), (0, 2)]
    assert len(NO_MATCHES) == 0
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
        found = search(Wrong(along, np.full(200, -5.0))).offset
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
    found = search(Wrong(along, 0.004 * places[:, 0])).offset
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


@pytest.mark.parametrize(("peak", "found"), [(5, False), (7, True)])
def test_a_peak_stands_out_by_six_standard_deviations(search, peak: int, found: bool) -> None:
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


def test_passes_grow_wider_until_one_is_clear(search) -> None:
    clear = Listed(spread_out(70, 50))  # more than three tenths
    assert search(clear).offset is not None
    assert clear.asked == [(20.0, 1500)]
    unclear = Listed(spread_out(130, 50))
    found = search(unclear).offset
    assert [width for width, _ in unclear.asked] == [20.0, 80.0, 700.0]
    assert [probes for _, probes in unclear.asked] == [1500, 2000, 3000]
    assert found is not None
    assert found.half_width == 3.0


@pytest.mark.parametrize(
    ("asked", "passes"),
    [
        (700.0, [(20.0, 1500), (80.0, 2000), (700.0, 3000)]),
        (54.0, [(20.0, 1500), (54.0, 3000)]),
        (20.0, [(20.0, 3000)]),
    ],
)
def test_no_width_is_searched_twice(search, asked, passes) -> None:
    nothing = Listed(spread_out(300, 5, width=700.0))
    assert search(nothing, search=asked).offset is None
    assert nothing.asked == passes


def test_the_most_significant_peak_decides_where_none_is_clear(search) -> None:
    """Forty matches near the line among ninety, and ninety farther out among two hundred and sixty."""
    across = np.r_[spread_out(90, 40, at=5.0), spread_out(260, 90, at=60.0, width=90.0)]
    found = search(Listed(across)).offset
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
    matcher.places = np.array([[0.0, 0.0], [0.3, 0.2], [50.0, 0.0], [90.0, 0.0]]).repeat(2, 0).reshape(4, 2, 2)
    found, _ = search(matcher).trusted(FLAT, 1.0)
    assert found.xy[:, 0, 0].tolist() == [90.0, 50.0, 0.3]  # the first two are one place, the better stays
    assert found.score.tolist() == [0.1, 0.2, 0.3]
