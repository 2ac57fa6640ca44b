"""Images are looked at in less detail first: what that shows too little of is matched as if it had not been."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from barpc.tie import TieOptions, TieResult, find_tracks, tracks
from barpc.tie.matchers import features
from barpc.tie.matchers.features import KeypointDensity, worth_a_first_look
from barpc.tie.matchers.matcher import NO_MATCHES
from barpc.tie.matchers.report import PairReport, ample
from barpc.tie.pairing.overlaps import Pair
from tests.tie.conftest import altered

FEW = TieOptions(points_per_image=500)  # of which 300 px hold enough to look twice


def same(a: TieResult, b: TieResult) -> bool:
    return all(
        getattr(a.tracks, name).tobytes() == getattr(b.tracks, name).tobytes()
        for name in ("view", "point", "xy", "sigma")
    )


@pytest.fixture
def looks(monkeypatch) -> list[bool]:
    """Whether each look at images was a first one."""
    seen: list[bool] = []
    known = tracks.locate

    def watched(*args, coarse: bool = False, **rest):
        seen.append(coarse)
        return known(*args, coarse=coarse, **rest)

    monkeypatch.setattr(tracks, "locate", watched)
    return seen


@pytest.fixture
def without(monkeypatch):
    """Tie points found without a first look."""

    def found(views) -> TieResult:
        with monkeypatch.context() as patch:
            patch.setattr(tracks, "worth_a_first_look", lambda *_: False)
            return find_tracks(views, FEW)

    return found


@pytest.mark.parametrize(
    ("side", "points", "zoom", "worth"),
    [
        (600, 5000, 2, False), (700, 5000, 2, True),  # 2000 keypoints of 4500 a Mpx
        (3500, 5000, 2, True), (3600, 5000, 4, True),  # twice as coarse as a closer look
        (20_000, 5000, 4, True),
        (700, 20_000, 2, False),  # whoever wants more points gets all that there are
        (700, 80, 2, True),
    ],
)  # fmt: skip
def test_a_first_look_takes_half_the_detail_and_what_is_wanted_alone(side, points, zoom, worth) -> None:
    options = TieOptions(points_per_image=points)
    share = KeypointDensity.of((side, side), options, coarse=True)
    assert share.zoom == zoom
    assert share.density == pytest.approx(min(5 * points, features.PER_IMAGE) / side**2)
    assert worth_a_first_look([(side, side)], options) == worth
    assert not worth_a_first_look([(side, side), (100, 100)], options)


@pytest.mark.parametrize(
    ("points", "verified", "status", "is_ample"),
    [
        (5000, 500, "ok", True), (5000, 499, "ok", False), (9001, 900, "ok", False), (80, 100, "ok", True),
        (80, 99, "ok", False), (5000, 600, "too few matches", False),
    ],
)  # fmt: skip
def test_a_tenth_of_the_points_wanted_is_ample(points, verified, status, is_ample) -> None:
    report = PairReport(("a", "b"), status, (0, 0), verified=verified)
    assert ample(report, points) == is_ample


def test_a_closer_look_is_at_pairs_that_lack_and_knows_the_altitudes_of_the_others(monkeypatch) -> None:
    """Three pairs, of which a first look shows enough of one."""
    pairs = [Pair((0, 1), 1.0, 0.0), Pair((0, 2), 1.0, 0.0), Pair((1, 2), 1.0, 0.0)]
    report = PairReport(("a", "b"), "ok", (0, 0), verified=9)
    first = [(replace(NO_MATCHES), replace(report, verified=n)) for n in (9, 900, 9)]
    closer = [(replace(NO_MATCHES), replace(report, verified=n)) for n in (70, 80)]
    earlier, asked = (("x", "y"), NO_MATCHES), dict[str, Any]()

    def located(views, options, work, pairs, area):
        asked["near"] = pairs
        return ["files"] * 3

    def matched(views, keypoints, lacking, options, ground, work):
        asked.update(lacking=lacking, ground=ground, keypoints=keypoints)
        return closer

    monkeypatch.setattr(tracks, "first_look", lambda *_: first)
    monkeypatch.setattr(tracks, "locate", located)
    monkeypatch.setattr(tracks, "match_pairs", matched)
    monkeypatch.setattr(tracks, "stretched", lambda *_: False)
    monkeypatch.setattr(tracks, "replace", lambda files, start: (files, start))
    trials = object.__new__(tracks._Trials)
    trials.looks: Any = SimpleNamespace(views=["a", "b", "c"])
    trials._scope: Any = SimpleNamespace(terrain=None, area=None)
    trials._options, trials._keypoints, trials._work = TieOptions(), ["coarse"] * 3, None
    trials._coarse, trials._closer = True, 0
    found = trials._matched(pairs, [earlier])
    assert found == [closer[0], first[1], closer[1]]
    assert asked["near"] == asked["lacking"] == [pairs[0], pairs[2]]
    assert asked["keypoints"] == [("files", -1 << 32)] * 3
    assert list(asked["ground"].ties) == [earlier, (("a", "c"), first[1][0])]


@pytest.mark.slow
def test_what_a_first_look_shows_enough_of_is_looked_at_once(scene, looks, without) -> None:
    found = find_tracks(scene.views, FEW)
    assert looks == [True]
    assert 100 <= found.tracks.num_points < without(scene.views).tracks.num_points
    assert scene.typical(found.tracks).max() <= 0.06
    assert np.abs(np.median(scene.errors_of(found.tracks), axis=0)).max() <= 0.01


@pytest.mark.slow
def test_what_it_shows_too_little_of_is_matched_as_if_it_had_not_been(scene, looks, without, tmp_path) -> None:
    """An image of which half says nothing."""
    half = altered(scene.views[1], tmp_path, lambda d: np.where(np.arange(300) < 150, d, 900).astype(d.dtype))
    found = find_tracks([scene.views[0], half], FEW)
    assert looks == [True, False]
    expected = without([scene.views[0], half])
    assert same(found, expected)
    assert found.pairs == expected.pairs


@pytest.mark.slow
def test_points_of_two_looks_are_not_taken_for_each_other(three, looks, monkeypatch) -> None:
    """One pair of three is looked at closely: a number stands for one place of a view, and tracks are true."""
    names = tuple(view.name for view in (three.views[0], three.views[2]))
    monkeypatch.setattr(tracks, "ample", lambda report, _: report.names != names)
    linked, link = [], tracks.link
    monkeypatch.setattr(tracks, "link", lambda *given: linked.append(given) or link(*given))
    found = find_tracks(three.views, FEW)
    assert looks == [True, False]
    pairs, matches = max(linked, key=lambda given: sum(map(len, given[1])))
    assert len(pairs) == 3
    places: dict[tuple[int, int], tuple[float, ...]] = {}
    for pair, of_pair in zip(pairs, matches, strict=True):
        for end, view in enumerate(pair):
            for number, xy in zip(of_pair.index[:, end].tolist(), of_pair.xy[:, end].tolist(), strict=True):
                assert places.setdefault((view, number), tuple(xy)) == tuple(xy)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        errors = three.errors_of(found.tracks, i, j)
        assert len(errors) > 100
        off = np.abs(errors).max(axis=1)  # a point of another look lies pixels off; a roof's edge by up to 1.5 px
        assert np.median(off) <= 0.05
        assert np.quantile(off, 0.95) <= 0.2
        assert off.max() < 2.0


@pytest.mark.slow
def test_images_of_several_dates_are_looked_at_closely_at_once(scene, looks) -> None:
    """What two dates have in common may be fine, and little."""
    dated = [replace(v, date=f"2020-0{k + 1}-01") for k, v in enumerate(scene.views)]
    find_tracks(dated, FEW)
    assert looks == [False]


@pytest.mark.nightly
def test_check_points_of_real_images_are_met_as_with_all_their_detail(triplet, triplet_ties) -> None:
    every = find_tracks(triplet, TieOptions(points_per_image=20_000))
    assert triplet_ties.tracks.num_points < 0.6 * every.tracks.num_points
    assert all(report.verified >= 500 for report in triplet_ties.pairs)
    for one, other in zip(triplet_ties.pairs, every.pairs, strict=True):
        assert np.hypot(*np.subtract(one.offset, other.offset)) < 1.0  # the parallax of other ground
        assert abs(one.offset[1] - other.offset[1]) < 0.03
