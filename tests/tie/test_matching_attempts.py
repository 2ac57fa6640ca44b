"""What is tried with a pair, in which order, and what is taken as it is where registration finds too little."""

from __future__ import annotations

import logging
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.base.tasks import Work, store_of
from barpc.scene import Tracks, View
from barpc.tie import Matches, TieOptions
from barpc.tie.linking import link
from barpc.tie.matchers import matching
from barpc.tie.matchers.features import join_keypoints, locate
from barpc.tie.matchers.matcher import NO_MATCHES
from barpc.tie.matchers.matching import FALSE_SHARE, GroundAltitudes, match_pair, match_pairs
from barpc.tie.matchers.report import PairReport
from barpc.tie.pairing.overlaps import Pair
from barpc.tie.tracks import _merge_registered, _unlike, _with_unregistered

from .test_pairs import camera, views

PAIR = Pair((0, 1), 1.0, 5.0)
NOBODY = join_keypoints([]), join_keypoints([])


@pytest.fixture
def shares() -> list[float | None]:
    """The shares of false matches that attempts may accept."""
    return []


@pytest.fixture
def attempts(monkeypatch, shares):
    """`attempts(first, second)`: what the attempts report, one after the other; the options of those made."""
    made: list[TieOptions] = []

    def scripted(*reports: PairReport) -> list[TieOptions]:
        script = iter(reports)

        def attempt(_views, _keypoints, _pair, options: TieOptions, _looked=None, share=FALSE_SHARE) -> Any:
            made.append(options)
            shares.append(share)
            return NO_MATCHES, replace(next(script), matcher=options.matcher, loosened=share > FALSE_SHARE)

        monkeypatch.setattr(matching, "_attempt", attempt)
        return made

    return scripted


def report(verified: int, status: str = "ok", matches: int = 200) -> PairReport:
    """Of no NaN, which equals itself in one Python and not in another when records are compared."""
    measured = {"offset": (0.0, 0.0), "spread": 0.5, "angle": 9.0, "overlap": 1.0}
    return PairReport(("a", "b"), status, (900, 900), matches, verified, **measured)  # type: ignore[arg-type]


# --- thresholds ---------------------------------------------------------------------------------------------


def test_a_pair_with_enough_is_tried_once(attempts) -> None:
    made = attempts(report(100))
    assert match_pair((None, None), NOBODY, PAIR, TieOptions())[1] == report(100)  # type: ignore[arg-type]
    assert made == [TieOptions()]


@pytest.mark.parametrize(
    ("status", "ratio", "times"),
    [
        ("no common offset within 7 px", 0.85, 1),
        ("no common offset within 7 px", 0.7, 2),
        ("too few matches", 0.85, 2),
    ],
)
def test_where_clear_matches_show_no_offset_looser_thresholds_are_not_tried(attempts, status, ratio, times) -> None:
    """A stricter ratio than that of clear matches is loosened for these, too."""
    made = attempts(*[report(0, status)] * 2)
    match_pair((None, None), NOBODY, PAIR, TieOptions(ratio=ratio))  # type: ignore[arg-type]
    assert len(made) == times


@pytest.mark.parametrize(
    ("given", "loosened"),
    [
        ({}, (0.95, 0.05, 8)),
        ({"ratio": 0.97, "min_matches": 5}, (0.97, 0.05, 4)),
        ({"min_matches": 100}, (0.95, 0.05, 67)),
    ],
)
def test_a_pair_with_fewer_is_tried_again_with_looser_thresholds(attempts, shares, given, loosened) -> None:
    made = attempts(report(99), report(120))
    found = match_pair((None, None), NOBODY, PAIR, TieOptions(**given))[1]  # type: ignore[arg-type]
    assert found == replace(report(120), loosened=True, beaten=("guided 99 of 100",))
    assert (made[1].ratio, shares[1], made[1].min_matches) == loosened
    assert shares[0] == FALSE_SHARE
    assert len(made) == 2


def test_what_looser_thresholds_cannot_change_is_not_tried_again(attempts, monkeypatch) -> None:
    """No keypoints; a matcher of the user's own; structure that saw nothing."""
    few = report(0, "too few keypoints")
    made = attempts(few, report(120))
    assert match_pair((None, None), NOBODY, PAIR, TieOptions())[1] == few  # type: ignore[arg-type]
    own = TieOptions(matcher="somewhere:match")
    made = attempts(report(20), report(120))
    assert match_pair((None, None), NOBODY, PAIR, own)[1].verified == 20  # type: ignore[arg-type]
    structure = TieOptions(matcher=matching.STRUCTURE)
    for matches, second in ((7, matching.FINE_STRUCTURE), (8, matching.STRUCTURE)):
        made.clear()
        attempts(report(0, "too few matches", matches), report(120))
        match_pair((None, None), NOBODY, PAIR, structure)  # type: ignore[arg-type]
        assert [one.matcher for one in made] == [matching.STRUCTURE, second]


def test_whole_pixels_are_looked_at_where_structure_finds_nothing_and_only_there(attempts, shares) -> None:
    """Once, with looser thresholds; what it does not find either is refused for the first reason."""
    structure, nothing = TieOptions(matcher=matching.STRUCTURE), report(0, "no common offset within 700 px")
    made = attempts(nothing, replace(report(30), matcher=matching.FINE_STRUCTURE))
    found = match_pair((None, None), NOBODY, PAIR, structure)[1]  # type: ignore[arg-type]
    assert found.means == "fine-structure, loosened"
    assert [(one.matcher, share, one.min_matches) for one, share in zip(made, shares, strict=True)][1:] == [
        (matching.FINE_STRUCTURE, 0.05, 8)
    ]
    made.clear()
    attempts(nothing, report(0, "too few matches"))
    assert match_pair((None, None), NOBODY, PAIR, structure)[1].status == nothing.status  # type: ignore[arg-type]
    assert len(made) == 2
    made.clear()
    attempts(report(20), report(19))
    match_pair((None, None), NOBODY, PAIR, structure)  # type: ignore[arg-type]
    assert matching.FINE_STRUCTURE not in [one.matcher for one in made]


# --- structure ----------------------------------------------------------------------------------------------


@pytest.fixture
def second_look(monkeypatch):
    """`second_look(reports, **given)`: the pairs that structure is asked for, and what the others reported."""

    def asked(reports: list[PairReport], options: TieOptions, **given):
        script, again = iter(reports), []
        monkeypatch.setattr(matching, "match_pair", lambda *task: (given_matches(20), next(script)))

        def within(several, _keypoints, pair, other) -> tuple[Matches, PairReport]:
            again.append((pair.views, other.matcher, [v[0].alt_range for v in several]))
            return NO_MATCHES, replace(report(150), matcher=other.matcher)

        monkeypatch.setattr(matching, "_match_within", within)
        many = views(*(camera(0.0, lean=0.1 * k) for k in range(len(reports) + 1)))
        pairs = [Pair((k, k + 1), 1.0, 5.0) for k in range(len(reports))]
        found = match_pairs(many, [join_keypoints([])] * len(many), pairs, options, **given)
        return again, [one.matcher for _, one in found]

    return asked


def hills(lon, lat):
    return np.where(lon > 0.0, 90.0, 70.0)


def test_structure_is_asked_where_keypoints_find_few_and_not_where_there_are_none(second_look) -> None:
    reports = [report(100), report(99), report(0, "too few keypoints"), report(0, "too few matches")]
    again, matchers = second_look(reports, TieOptions())
    assert [(views, name) for views, name, _ in again] == [((1, 2), "structure"), ((3, 4), "structure")]
    assert matchers == ["guided", "structure", "guided", "structure"]


def test_a_matcher_that_is_named_is_what_is_wanted_unless_the_terrain_tells_structure_more(second_look) -> None:
    few = [report(40)]
    assert second_look(few, TieOptions(matcher="somewhere:match"), ground=GroundAltitudes(hills))[0] == []
    assert second_look(few, TieOptions(matcher="structure"))[0] == []
    ((_, name, ranges),) = second_look(few, TieOptions(matcher="structure"), ground=GroundAltitudes(hills))[0]
    assert name == "structure"
    assert ranges == [(0.0, 200.0), (20.0, 140.0)]  # 150 m about the terrain, and 50
    assert second_look([report(100)], TieOptions(matcher="structure"), ground=GroundAltitudes(hills))[0] == []


def test_a_pair_without_keypoints_has_no_match_and_no_share_of_them() -> None:
    two = views(camera(0.0), camera(0.0, lean=0.2))
    found, told = match_pair(tuple(two), (join_keypoints([]),) * 2, Pair((0, 1), 1.0, 5.0), TieOptions())
    assert not len(found)
    assert "keypoints" in told.status
    assert (told.matches, told.verified, told.inlier_share, told.control_share) == (0, 0, 0.0, 0.0)


def test_altitudes_are_known_from_pairs_whose_segments_are_five_pixels_to_either_side() -> None:
    """Of cameras that lean apart by so many pixels a metre, over two hundred metres."""
    for lean, tells in ((0.049, False), (0.051, True)):
        two = tuple(views(camera(0.0, lean=0.0), camera(0.0, lean=lean)))
        ground = np.column_stack([np.linspace(-1e-3, 1e-3, 201), np.zeros(201), np.linspace(0.0, 200.0, 201)])
        xy = np.stack([view.sensor.project(ground) for view in two], axis=1)
        known = GroundAltitudes(None, [(two, Matches.of_places(xy, np.zeros(201)))]).altitudes()
        assert (known is not None) == tells
        if known is not None:
            assert known == pytest.approx((4.0, 196.0), abs=0.5)  # percentiles 2 and 98


# --- what is taken as it is ---------------------------------------------------------------------------------


def of(*rows: tuple[int, int, float, float]) -> Tracks:
    view, point, x, y = (np.array(column) for column in zip(*rows, strict=True))
    return Tracks(view.astype(int), point.astype(int), np.column_stack([x, y]), np.full(len(rows), 0.1))


def test_a_point_that_is_registered_is_one_track_and_what_else_sees_it_goes_with_it() -> None:
    """Views a tenth of a pixel apart, the third with pixels half as large: what moves a pixel moves two there."""
    three = views(camera(0.0), camera(0.0), camera(0.0).window(0, 0, 0.5, 0.5))
    known = of((0, 0, 100.0, 100.0), (1, 0, 50.0, 50.0), (0, 1, 300.0, 300.0), (1, 1, 350.0, 300.0))
    other = of(
        (0, 0, 102.1, 100.0), (1, 0, 50.0, 47.9),  # both within two pixels and a bit: known
        (0, 1, 301.0, 299.5), (2, 1, 600.0, 600.0),  # seen by one more
        (0, 2, 50.0, 50.0), (2, 2, 100.0, 100.0),  # beside another view's
        (0, 3, 302.3, 300.0), (1, 3, 351.0, 299.0), (2, 3, 700.0, 700.0),  # known; the third has its place already
    )  # fmt: skip
    found = _merge_registered(three, known, other)
    assert found.point.tolist() == [0, 0, 1, 1, 1, 2, 2]
    assert found.view.tolist() == [0, 1, 0, 1, 2, 0, 2]
    expected = [[100, 100], [50, 50], [300, 300], [350, 300], [598, 601], [50, 50], [100, 100]]
    np.testing.assert_allclose(found.xy, expected, atol=1e-6)
    none = Tracks(*(np.empty(0, np.int64),) * 2, np.empty((0, 2)), np.empty(0))
    assert _merge_registered(three, none, other).num_points == 4


def given_matches(count: int) -> Matches:
    places = np.random.default_rng(0).uniform(50, 900, (count, 2))
    numbers = -1 - np.arange(count)
    return Matches(np.stack([places, places + 1.0], axis=1), np.zeros(count), np.stack([numbers] * 2, axis=1), 0.3)


@pytest.mark.parametrize(
    ("count", "kept", "unlike"),
    [(60, 0.47, True), (60, 0.51, False), (1000, 0.09, True), (1000, 0.11, False), (1000, 0.0, True), (1, 0.0, True)],
)
def test_grey_values_do_not_compare_where_under_half_of_the_matches_register_and_too_few_are_left(
    count, kept, unlike
) -> None:
    linked = link([(0, 1)], [given_matches(count)])
    registered = linked.select(linked.point < kept * linked.num_points)
    assert _unlike(linked, registered, [(0, 1)]) == ([(0, 1)] if unlike else [])
    assert _unlike(linked, registered, [(0, 2)]) == []  # no match of it is left to look at


def test_of_a_pair_with_tracks_of_its_own_those_of_a_third_view_vouch_for_nothing() -> None:
    """Of 60 tracks that only two see ten register, and all of 60 that a third sees as well."""
    own, shared = given_matches(60), given_matches(60)
    shared = replace(shared, xy=shared.xy + 0.5, index=shared.index - 1000)
    linked = link([(0, 1), (0, 1), (1, 2)], [own, shared, shared])
    of_two = np.bincount(linked.point)[linked.point] == 2
    assert of_two.sum() == 120
    assert (~of_two).sum() == 180
    registered = linked.select(~of_two | (linked.point < np.unique(linked.point[of_two])[10]))
    assert _unlike(linked, registered, [(0, 1)]) == [(0, 1)]
    third = linked.select(~of_two)  # without tracks of its own they are what there is
    assert _unlike(third, third, [(0, 1), (1, 2)]) == []
    assert _unlike(third, third.select(third.point < third.point.max() // 4), [(0, 1)]) == [(0, 1)]


def test_given_matches_are_added_where_fewer_than_are_wanted_could_be_registered(caplog) -> None:
    two, given = views(camera(0.0), camera(0.0)), {(0, 1): given_matches(40)}
    places = given[0, 1].xy[:20]
    registered = of(*((v, k, *places[k, v]) for k in range(20) for v in (0, 1)))
    assert _with_unregistered(two, registered, given, TieOptions(min_matches=20)) is registered
    with caplog.at_level(logging.WARNING):
        more = _with_unregistered(two, registered, given, TieOptions(min_matches=21))
    assert more.num_points == 40  # those that are registered once
    assert "20 of 40 matches could be registered: the others are used as found, good to 0.30 px" in caplog.text
    assert (np.diff(more.point) >= 0).all()
    assert np.unique(more.sigma).tolist() == [0.1, 0.3]
    assert (np.bincount(more.point) == 2).all()


def test_the_quick_score_is_of_the_strongest_and_nought_where_there_are_none(scene) -> None:
    pair = tuple(scene.views)
    with store_of(SimpleNamespace(store=None)) as store:  # type: ignore[arg-type]
        files = locate(pair, TieOptions(), Work(store=store))
        assert min(map(len, files)) > 500
        asked = [found.strongest(500) for found in files]
        assert all(500 <= len(few) <= 500 + len(few.boxes) for few in asked)
        score = matching.quick_score(pair, (files[0], files[1]), TieOptions())
        assert 60 < score < 400
        none = replace(files[1], counts=(0,) * len(files[1].counts))
        assert matching.quick_score(pair, (files[0], none), TieOptions()) == 0


@pytest.mark.parametrize(
    ("known", "within"),
    [
        (None, None),
        ((300.0, 400.0), (250.0, 450.0)),
        ((20.0, 120.0), (100.0, 170.0)),  # the views' own end stays
        ((880.0, 1000.0), (830.0, 900.0)),
        ((950.0, 1000.0), (900.0, 900.0)),
        ((951.0, 1000.0), None),  # altitudes of nothing that both may see
        ((0.0, 50.0), (100.0, 100.0)),
        ((0.0, 49.0), None),
    ],
)
def test_a_pair_is_sought_at_altitudes_that_others_lie_at(known, within) -> None:
    sensor: Any = None
    two = View("a", "a.tif", (50, 40), sensor, (0.0, 900.0)), View("b", "b.tif", (60, 30), sensor, (100.0, 1000.0))
    found = GroundAltitudes().within(two, known, 50.0)
    if within is None:
        assert found is two
    else:
        assert found == (replace(two[0], alt_range=within), replace(two[1], alt_range=within))
