"""Which pairs are tried: views of many dates by what a few keypoints say, and two paths to every view."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import date, timedelta

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree

from barpc.base.options import RunOptions
from barpc.base.tasks import Store, Work
from barpc.pipeline import adjust
from barpc.scene import connected_groups
from barpc.tie import Scope, TieOptions, find_tracks, tracks
from barpc.tie.matchers.features import KeypointFiles
from barpc.tie.matchers.matcher import NO_MATCHES
from barpc.tie.matchers.report import PairReport
from barpc.tie.pairing.overlaps import (
    Pair,
    best_pairs,
    forests,
    further_pairs,
    possible_pairs,
    scored_pair,
    several_dates,
    twice_tied,
)
from benchmarks.dates import block
from tests.costs import once
from tests.lanes import diagonal, rest_slow
from tests.scenes.dates import Years
from tests.tie.stages import select_pairs

from .test_pairs import METRE, camera, views


def pairs_of(rng: np.random.Generator, num: int, count: int) -> list[Pair]:
    """Distinct random pairs, ascending, under random angles."""
    every = [(i, j) for i in range(num) for j in range(i + 1, num)]
    picked = sorted(rng.choice(len(every), min(count, len(every)), replace=False).tolist())
    return [Pair(every[k], float(rng.uniform(0.1, 1)), float(rng.uniform(0, 40))) for k in picked]


def joined(num: int, links: list[tuple[int, int]], i: int, j: int) -> bool:
    return any(i in group and j in group for group in connected_groups(num, links))


# --- paths --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", rest_slow(range(12), keep=4))
def test_twice_tied_are_views_that_no_single_link_parts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    num = int(rng.integers(2, 10))
    links = [pair.views for pair in pairs_of(rng, num, int(rng.integers(0, 16)))]
    label = twice_tied(num, links)
    for i in range(num):
        for j in range(i):
            less = [links, *(links[:k] + links[k + 1 :] for k in range(len(links)))]
            assert (label[i] == label[j]) == all(joined(num, some, i, j) for some in less), (links, i, j)


def test_two_links_between_the_same_parts_are_two_paths() -> None:
    assert len(set(twice_tied(2, [(0, 1), (0, 1)]))) == 1
    assert len(set(twice_tied(2, [(0, 1)]))) == 2
    assert twice_tied(3, []) == [0, 1, 2]


@pytest.mark.parametrize("seed", rest_slow(range(8), keep=3))
def test_two_forests_keep_two_paths_wherever_there_are_two(seed: int) -> None:
    rng = np.random.default_rng(seed)
    num = 9
    links = [pair.views for pair in pairs_of(rng, num, 22)]
    kept = [links[k] for k in forests(links, num, 2)]
    assert len(kept) <= 2 * (num - 1) < len(links)
    before, after = twice_tied(num, links), twice_tied(num, kept)
    assert [[a == b for b in before] for a in before] == [[a == b for b in after] for a in after]


def test_a_second_path_is_the_best_pair_that_makes_one_and_none_is_tried_that_makes_none() -> None:
    """Two rings that one link joins: 0-1-2 and 3-4-5; a view beside them that hangs by one."""
    links = [(0, 1), (1, 2), (0, 2), (3, 4), (4, 5), (3, 5), (2, 3), (5, 6)]
    left = [Pair((0, 4), 0.5, 5.0), Pair((1, 5), 0.9, 5.0), Pair((4, 6), 0.3, 5.0)]
    found = further_pairs(left, 7, links, 2, twice=True)
    assert [(pair.views, pair.reason) for pair in found] == [((1, 5), "second path"), ((4, 6), "second path")]
    assert [p.views for p in further_pairs(left, 7, links, 3, twice=True)] == [(1, 5), (0, 4), (4, 6)]
    assert further_pairs(left, 7, [*links, (0, 5), (3, 6)], 2, twice=True) == []
    assert further_pairs(left, 7, links, 2) == []
    assert [p.views for p in further_pairs(left, 7, links[:-1], 2)] == [(4, 6)]


def test_seasons_are_tied_by_many_of_their_views() -> None:
    """Two of 20 views: partners within one are much more alike, and one pair between them would connect them."""
    rng, num = np.random.default_rng(0), 40
    pairs = [
        Pair((i, j), 1.0, 10.0, likeness=int(rng.integers(200, 300) if (i < 20) == (j < 20) else 20))
        for i in range(num)
        for j in range(i + 1, num)
    ]
    chosen = best_pairs(pairs, num, 8, twice=True)
    between = [pair for pair in chosen if (pair.views[0] < 20) != (pair.views[1] < 20)]
    across = np.bincount(np.ravel([pair.views for pair in between]), minlength=num)
    assert (across > 0).mean() > 0.8
    assert len(chosen) - len(best_pairs(pairs, num, 8)) <= num * 8 // 4
    near = [pair for pair in pairs if max(pair.views) < 9]  # each is a partner of each
    assert best_pairs(near, 9, 8, twice=True) == best_pairs(near, 9, 8)


def test_what_shares_nothing_is_tried_where_there_is_no_path_and_not_for_a_second_one() -> None:
    hopeless = Pair((0, 2), 0.9, 5.0, likeness=0)
    assert further_pairs([hopeless], 3, [(0, 1), (1, 2)], 2, twice=True) == []
    assert [pair.views for pair in further_pairs([hopeless], 3, [(0, 1)], 2, twice=True)] == [(0, 2)]


# --- the choice ---------------------------------------------------------------------------------------------


def by_overlap_and_angle(pairs: list[Pair], num: int, neighbours: int) -> set[tuple[int, int]]:
    """The best partners of every view and the best tree, by scipy's."""
    ranked = sorted(pairs, key=lambda pair: (-pair.score, pair.views))
    rank = np.arange(1, len(ranked) + 1)
    ends = tuple(np.array([pair.views for pair in ranked], dtype=np.int32).T)
    tree = minimum_spanning_tree(coo_array((rank, ends), shape=(num, num))).data
    chosen, taken = set(), np.zeros(num, dtype=int)
    for number, pair in zip(rank, ranked, strict=True):
        if number in tree or taken[list(pair.views)].min() < neighbours:
            chosen.add(pair.views)
            taken[list(pair.views)] += 1
    return chosen


@pytest.mark.parametrize(("neighbours", "seed"), diagonal([1, 3, 8], range(4)))
def test_without_dates_overlap_and_angle_choose(seed: int, neighbours: int) -> None:
    pairs = pairs_of(np.random.default_rng(seed), 24, 180)
    found = {pair.views for pair in best_pairs(pairs, 24, neighbours)}
    assert found == by_overlap_and_angle(pairs, 24, neighbours)
    more = [pair.views for pair in best_pairs(pairs, 24, neighbours, twice=True)]
    assert found <= set(more)
    assert len(set(twice_tied(24, more))) == len(set(twice_tied(24, [pair.views for pair in pairs])))


def dated(count: int, days: dict[int, str]) -> list:
    row = views(*(camera(10 * METRE * k, lean=0.0) for k in range(count)))
    return [replace(view, date=days.get(k, "")) for k, view in enumerate(row)]


def test_only_what_is_known_to_differ_makes_several_dates() -> None:
    assert not several_dates(dated(3, {}))
    assert not several_dates(dated(3, {0: "2020-01-01", 1: "2020-01-01"}))
    assert several_dates(dated(3, {0: "2020-01-01", 2: "2020-07-01"}))


def test_pairs_of_one_date_go_first_unless_they_share_nothing() -> None:
    two = dated(3, {0: "2020-01-01", 1: "2020-01-01", 2: "2020-07-01"})
    pair = Pair((0, 1), 0.9, 5.0)
    assert scored_pair(two, pair, 30).reason == "same date"
    assert scored_pair(two, pair, 0).reason == "quick score 0"  # the date is not true, or there are clouds
    assert scored_pair(two, Pair((1, 2), 0.9, 5.0), 30).reason == "quick score 30"
    assert scored_pair(dated(3, {}), pair, 30).reason == "quick score 30"


def test_half_of_the_partners_are_left_for_other_dates() -> None:
    """Two dates of six views each; the other date's pairs overlap less."""
    many = dated(12, {k: "2020-01-01" if k < 6 else "2020-07-01" for k in range(12)})
    pairs = []
    for i in range(12):
        for j in range(i + 1, 12):
            same = (i < 6) == (j < 6)
            pairs.append(scored_pair(many, Pair((i, j), 0.9 if same else 0.5, 5.0), 50 if same else 20))
    found = best_pairs(pairs, 12, 4)
    across = [pair.views for pair in found if (pair.views[0] < 6) != (pair.views[1] < 6)]
    count = np.bincount(np.array(across).ravel(), minlength=12)
    assert count.min() >= 1
    assert len(across) >= 10
    assert len(found) - len(across) >= 10
    assert len(found) < 12 * 4
    for neighbours, own in ((2, 5), (3, 5 + 4), (4, 5 + 4), (5, 5 + 4 + 3)):  # each has the first, and the second, ...
        found = best_pairs(pairs, 12, neighbours)
        assert sum((one.views[0] < 6) == (one.views[1] < 6) for one in found) == 2 * own


def test_what_is_given_is_kept_and_takes_no_place() -> None:
    row = views(*(camera(10 * METRE * k, lean=0.0) for k in range(12)))
    plain = {pair.views for pair in select_pairs(row, TieOptions(neighbours=2))}
    more = select_pairs(row, TieOptions(neighbours=2), Scope(given={(0, 11): NO_MATCHES}))
    assert {pair.views for pair in more} == plain | {(0, 11)}
    assert [pair.reason for pair in more if pair.views == (0, 11)] == ["given"]


# --- what is tried, round by round ---------------------------------------------------------------------------


class Looks:
    """Views of which some pairs would tie: what is tried of them, and what is asked for a quick score."""

    def __init__(self, monkeypatch, alike, neighbours: int = 3) -> None:
        self.alike, self.compared, self.tried = alike, [], []
        self.options = TieOptions(neighbours=neighbours)
        monkeypatch.setattr(tracks, "locate", lambda views, _, work, **rest: [KeypointFiles(work.store)] * len(views))
        monkeypatch.setattr(tracks, "match_pairs", self._match)
        monkeypatch.setattr(tracks, "quick_score", self._score)

    def _ties(self, names) -> bool:
        return self.alike(*(int(name[1:]) for name in names))

    def _match(self, views, keypoints, pairs, *args, once: bool = False, **rest):
        ends = [tuple(views[i].name for i in pair.views) for pair in pairs]
        if not once:  # of which each may have had a first look
            self.tried.append([pair.views for pair in pairs])
        return [(NO_MATCHES, PairReport(names, "ok" if self._ties(names) else "unlike", (9, 9))) for names in ends]

    def _score(self, views, keypoints, options) -> int:
        self.compared.append(tuple(view.name for view in views))
        return 50 * self._ties(self.compared[-1])

    def run(self, row) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """The pairs that were tried, and those of them that tie."""
        trials = tracks._Trials(row, self.options, Scope(), Work(store=Store("", "")))
        trials.run(pairs_in_a_row(len(row), self.options.neighbours), False)
        every = sorted(trials.tried)
        assert sorted(pair for some in self.tried for pair in some) == every  # none twice
        return every, [pair for pair, (_, _, report) in sorted(trials.tried.items()) if report.status == "ok"]


@once
def pairs_in_a_row(count: int, neighbours: int) -> list[Pair]:
    """Dates do not change where views lie."""
    return possible_pairs(dated(count, {}), TieOptions(neighbours=neighbours))


PLACE = np.random.default_rng(7).permutation(40)


def neighbours_in_the_year(i: int, j: int) -> bool:
    """Forty views along a year that has an end: a chain."""
    return abs(int(PLACE[i]) - int(PLACE[j])) == 1


def days(count: int) -> dict[int, str]:
    return {k: f"2020-{1 + k // 28:02d}-{1 + k % 28:02d}" for k in range(count)}


@pytest.mark.slow
def test_the_one_chain_through_forty_dates_is_found_at_once(monkeypatch) -> None:
    looks = Looks(monkeypatch, neighbours_in_the_year)
    tried, tied = looks.run(dated(40, days(40)))
    assert connected_groups(40, tied) == [list(range(40))]
    assert len(tied) == 39
    assert len(tried) <= 40 * 3
    assert len(looks.tried) == 1
    assert len(set(looks.compared)) == len(looks.compared) <= 40 * 39 / 2


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    "said",
    rest_slow(
        [
            pytest.param({}, id="no dates"),
            pytest.param(dict.fromkeys(range(40), "2020-01-01"), id="all one date"),
        ]
    ),
)
def test_what_fails_is_replaced_though_no_date_tells(monkeypatch, said) -> None:
    """Two partners in the year are alike: overlap and angle find few of these pairs."""
    looks = Looks(monkeypatch, lambda i, j: abs(int(PLACE[i]) - int(PLACE[j])) <= 3)
    row = dated(40, said)
    first = [pair.views for pair in select_pairs(row, TieOptions(neighbours=3)) if looks.alike(*pair.views)]
    assert len(connected_groups(40, first)) > 5
    tried, tied = looks.run(row)
    assert [sorted(pair) for pair in looks.tried[0]] == [list(p.views) for p in select_pairs(row, looks.options)]
    assert connected_groups(40, tied) == [list(range(40))]
    assert len(tried) < 40 * 39 / 4


def test_without_dates_nothing_more_is_asked_where_all_are_tied(monkeypatch) -> None:
    looks = Looks(monkeypatch, lambda i, j: True, neighbours=1)
    tried, _ = looks.run(dated(12, {}))
    assert tried == [pair.views for pair in select_pairs(dated(12, {}), TieOptions(neighbours=1))]
    assert looks.compared == []


def test_dates_that_lie_cost_nothing(monkeypatch) -> None:
    """Views of opposite seasons say that they are of one day; two pairs join the seasons."""
    looks = Looks(monkeypatch, lambda i, j: (i - j) % 2 == 0 or (i, j) in ((0, 7), (3, 10)))
    tried, tied = looks.run(dated(12, {k: f"2020-01-{1 + k // 2:02d}" for k in range(12)}))
    assert len(set(twice_tied(12, tied))) == 1
    assert not set(tried) & {(k, k + 1) for k in range(0, 12, 2)}


def test_groups_that_nothing_joins_end_after_some_tries(monkeypatch) -> None:
    looks = Looks(monkeypatch, lambda i, j: (i - j) % 2 == 0)
    tried, tied = looks.run(dated(12, days(12)))
    assert [len(group) for group in connected_groups(12, tied)] == [6, 6]
    assert 1 + 2 <= len(tried) - len(tied) <= 1 + 2 + 4 + 8


@pytest.mark.slow
def test_a_year_that_closes_ties_every_view_by_two_paths(monkeypatch) -> None:
    ring = Looks(monkeypatch, lambda i, j: abs(int(PLACE[i]) - int(PLACE[j])) in (1, 39), neighbours=1)
    _, tied = ring.run(dated(40, days(40)))
    assert len(set(twice_tied(40, tied))) == 1


@pytest.mark.slow
def test_a_view_under_clouds_is_given_up_after_some_tries_and_nothing_else_is_lost(monkeypatch) -> None:
    looks = Looks(monkeypatch, lambda i, j: 5 not in (i, j))
    tried, tied = looks.run(dated(40, days(40)))
    assert [len(group) for group in connected_groups(40, tied)] == [39, 1]
    assert 3 <= sum(5 in pair for pair in tried) <= 3 + 2 + 4 + 8


def test_two_views_of_two_dates_are_not_compared_but_matched(monkeypatch) -> None:
    looks = Looks(monkeypatch, lambda i, j: True)
    assert looks.run(dated(2, days(2)))[0] == [(0, 1)]
    assert looks.compared == []


# --- images -------------------------------------------------------------------------------------------------

ORDER = (3, 0, 5, 1, 6, 2, 4)
"""Place in the year of every view: neighbours in it look alike, those three places apart do not."""


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    phases = tuple(np.linspace(0.0, 0.72, 7)[list(ORDER)])
    years = Years(phases, tuple(range(7)), seed=3, growth=1.0, snow=0.0)
    folder = tmp_path_factory.mktemp("chain")
    for view, place in zip(years.write(folder), ORDER, strict=True):
        text = f"BEGIN_GROUP = IMAGE_1\n\tfirstLineTime = 2020-0{place + 1}-15T10:00:00.000000Z;\nEND;\n"
        (folder / f"{view.name}.IMD").write_text(text)
    return years, sorted(folder.glob("*.tif"))


@pytest.mark.nightly
def test_a_chain_of_seasons_is_found_where_overlap_and_angle_miss_it(chain, tmp_path) -> None:
    years, images = chain
    options = RunOptions(tie=TieOptions(neighbours=1))
    with ThreadPoolExecutor(2) as pool:
        result = adjust(images, tmp_path / "out", options, executor=pool)
    known = [replace(view, date="") for view in result.run.views]
    alike = [
        pair.views for pair in select_pairs(known, options.tie) if abs(ORDER[pair.views[0]] - ORDER[pair.views[1]]) <= 2
    ]
    assert len(connected_groups(7, alike)) > 1  # what would be tried without the dates
    assert len(result.run.matched) <= 12
    assert len(result.views) == 7
    assert years.errors(years.delivered).min() > 2
    assert years.errors([view.sensor for view in result.views]).max() < 0.5
    assert find_tracks(result.run.views, options.tie).tracks == result.run.tracks
    assert [view["date"] for view in result.summary["views"]] == [f"2020-0{k + 1}-15" for k in ORDER]
    reasons = {pair["chosen_by"].split()[0] for pair in result.summary["pairs"] if pair.get("chosen_by")}
    assert "quick" in reasons


@pytest.mark.nightly
def test_forty_dates_of_four_seasons_a_third_of_them_under_clouds_agree(tmp_path) -> None:
    """A hundred of such dates, by `benchmarks/dates.py`: 0.0163 px RMS, 726 pairs."""
    count, neighbours = 40, 8
    years = block(count, 0, 0, 400, 0.3, 4)
    assert sum(share > 0 for share in years.clouds) == count // 3
    dates = [date(2015 + k % 5, 1, 1) + timedelta(int(365 * phase)) for k, phase in enumerate(years.phases)]
    many = [replace(view, date=str(d)) for view, d in zip(years.write(tmp_path), dates, strict=True)]
    result = adjust(many, tmp_path / "out", RunOptions(tie=TieOptions(neighbours=neighbours)))
    assert [view.name for view in result.views] == [view.name for view in many]
    errors = years.errors([view.sensor for view in result.views])
    assert np.median(years.errors(years.delivered)) > 3
    assert np.sqrt((errors**2).mean()) < 0.03
    assert errors.max() < 0.06
    # of all 780: its partners are shared with others, and a few lead to other groups of views
    assert len(result.run.matched) <= count * neighbours
