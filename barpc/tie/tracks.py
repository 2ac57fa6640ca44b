"""Images to tracks: matches linked, evenly thinned, registered; `find_tracks` runs all stages."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from barpc.base.options import TIE_DEFAULTS, TieOptions
from barpc.base.statistics import FEW, MANY, kd_tree
from barpc.base.tasks import Progress, Work, store_of
from barpc.scene import IntArray, Tracks, View, connected_labels
from barpc.tie.detail import Seen, seen_detail
from barpc.tie.linking import link, pair_counts, require_tracks, thin, tracks_inside
from barpc.tie.matchers.features import KeypointFiles, locate, worth_a_first_look
from barpc.tie.matchers.given import GivenMatches, beside_given, verify_given
from barpc.tie.matchers.matcher import Matches
from barpc.tie.matchers.matching import GroundAltitudes, first_look, match_pairs, quick_score
from barpc.tie.matchers.pair_search import MATCHERS, matcher_named
from barpc.tie.matchers.placings import stretched
from barpc.tie.matchers.report import PairReport, ample, enough, require_matches
from barpc.tie.pairing.epipolar import grouped, linear_map
from barpc.tie.pairing.overlaps import (
    COMPARED,
    GIVEN_PAIR,
    TRIES,
    WHOLE_SCOPE,
    Pair,
    Scope,
    best_pairs,
    further_pairs,
    possible_pairs,
    scored_pair,
    several_dates,
)
from barpc.tie.pairing.resolution import Looks, finer
from barpc.tie.patches.links import refine
from barpc.tie.patches.oriented import MAX_PATCH_SHIFT
from barpc.tie.pixels import sample_stretch

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class TieResult:
    """Tie points and the reports of their pairs."""

    tracks: Tracks
    pairs: tuple[PairReport, ...]  # one a pair that was tried
    keypoints: tuple[int, ...]  # of each view
    detail: tuple[IntArray, ...] = ()  # of each view: what partners see of it, as `seen_detail` counts


def find_tracks(
    views: Sequence[View],
    options: TieOptions = TIE_DEFAULTS,
    scope: Scope = WHOLE_SCOPE,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> TieResult:
    """Find the tie points of overlapping images.

    Parameters
    ----------
    views : sequence of View
        At least two; in a second pass with their corrected cameras, `replace(view, sensor=...)`.
    options : TieOptions
        Options of the search.
    scope : Scope
        Pairs, area, matches and terrain that are known beside the images.
    executor, progress : optional
        Executor of the tasks, and callable for progress: see `ordered`. The result does not depend on them.

    Raises
    ------
    TiePointError
        Fewer than two images, or two that do not match.
    DisconnectedError
        The images fall into groups that share no tie points.
    ImageError
        An image cannot be read.
    """
    with store_of(executor) as store:
        trials = _Trials(views, options, scope, Work(executor, progress, store))
        trials.run(possible_pairs(views, options, scope), all_of_them=bool(scope.only))
        require_matches(views, *trials.outcome, scope.joined)
        tracks, bare = _registered_tracks(trials, scope, options, Work(executor, progress))
        detail = trials.detail()
    pairs, reports = trials.outcome
    reports = [replace(r, unregistered=bare.get(p.views, 0)) for p, r in zip(pairs, reports, strict=True)]
    require_tracks(views, tracks, pairs, reports, scope.joined)
    return TieResult(tracks, tuple(reports), trials.keypoints, detail)


def _registered_tracks(
    trials: _Trials, scope: Scope, options: TieOptions, work: Work
) -> tuple[Tracks, dict[tuple[int, int], int]]:
    """Link, thin and register the matches of the pairs tried; return also how many could not be registered."""
    looks, area, most = trials.looks, scope.area, options.points_per_image
    matches, tried = trials.by_looks
    sizes = [view.size for view in looks.views]
    linked = thin(tracks_inside(looks.views, link(list(matches), list(matches.values())), area), sizes, most)
    spreads = {ends: report.spread for ends, report in tried.items() if report.status == "ok"}
    structural = [ends for ends, report in tried.items() if report.structural]
    theirs = {ends for ends, report in tried.items() if report.matcher == GIVEN_PAIR}
    verified = {ends: found for ends, found in matches.items() if len(found)}
    tracks = refine(looks.views, linked, spreads, options, structural=structural, work=work)
    if unlike := _with_pictures(
        looks.views, _unlike(linked, tracks, sorted(theirs & set(verified))), options.band, work
    ):
        tracks = refine(looks.views, linked, spreads, options, structural=[*structural, *unlike], work=work)
        counts = pair_counts(tracks)
        if trials.rematch({pair: counts.get(pair, 0) for pair in _unlike(linked, tracks, unlike)}):
            return _registered_tracks(trials, scope, options, work)
    needed = theirs | _needed(looks, tracks, list(verified), options.min_matches)
    whole = _with_unregistered(
        looks.views, tracks, {ends: verified[ends] for ends in verified if ends in needed}, options
    )
    return looks.tracks(thin(tracks_inside(looks.views, whole, area), sizes, most)), _lost(looks, tracks, whole)


def _lost(looks: Looks, registered: Tracks, tracks: Tracks) -> dict[tuple[int, int], int]:
    """Return how many tracks of pairs of views are not registered."""
    exact, of = pair_counts(registered), looks.of.tolist()
    return {(of[i], of[j]): count - exact.get((i, j), 0) for (i, j), count in pair_counts(tracks).items()}


def _needed(looks: Looks, tracks: Tracks, pairs: Sequence[tuple[int, int]], least: int) -> set[tuple[int, int]]:
    """Return the pairs of looks between views not connected by pairs with enough registered tracks."""
    counts = pair_counts(tracks)
    firm = [(int(looks.of[i]), int(looks.of[j])) for i, j in pairs if counts.get((i, j), 0) >= least]
    part = connected_labels(int(looks.of.max()) + 1, firm)[looks.of]
    return {(i, j) for i, j in pairs if part[i] != part[j]}


class _Trials:
    """Matching of pairs, round by round, until the views are tied or no pair remains."""

    def __init__(self, views: Sequence[View], options: TieOptions, scope: Scope, work: Work) -> None:
        self._views, self._options, self._work = views, options, work
        self._given, self._scope = scope.given, scope
        self._compares = options.matcher == TIE_DEFAULTS.matcher  # by keypoints
        self.looks = Looks.at(views, [])
        self._coarse, self._closer = False, 0
        self._keypoints: list[KeypointFiles] = []
        self.tried: dict[tuple[int, int], tuple[Pair, Matches, PairReport]] = {}
        self._scores: dict[tuple[int, int], int] = {}
        self._beside: dict[tuple[int, int], tuple[Matches, PairReport]] = {}  # given, and too few: own count beside

    def run(self, pool: Sequence[Pair], all_of_them: bool) -> None:
        """Match the best pairs of a pool, or all, and others in place of those that fail."""
        own = self._options.matcher in MATCHERS  # another one reads the files itself
        self.looks = Looks.at(self._views, pool, apart=own)
        self._verify([pair for pair in pool if pair.views in self._given])
        assert self._work.store is not None
        self._keypoints = [KeypointFiles(self._work.store)] * len(self.looks.views)
        sizes = [view.size for view in self.looks.views]
        dates, num = several_dates(self._views), len(self._views)
        self._coarse = self._compares and not dates and worth_a_first_look(sizes, self._options)
        twice = self._compares and dates
        chosen = self._located(pool, all_of_them, twice)
        for tries in (*TRIES, 0):
            self._try(chosen)
            left = [pair for pair in pool if pair.views not in self.tried]
            links = [pair.views for pair, _, report in self.tried.values() if report.status == "ok"]
            crossing = self._judged(further_pairs(left, num, links, COMPARED, twice)) if tries else []
            chosen = further_pairs(crossing, num, links, tries, twice)
            if not chosen:
                break

    def _located(self, pool: Sequence[Pair], all_of_them: bool, twice: bool) -> Sequence[Pair]:
        """Return the pairs to begin with, their keypoints found; of several dates (`twice`) a few of all pairs tell."""
        num, most = len(self._views), self._options.neighbours
        chosen = pool if all_of_them else best_pairs(pool, num, most)
        compared = twice and len(chosen) < len(pool)
        self._locate(pool if compared else chosen)
        return best_pairs(self._judged(best_pairs(pool, num, COMPARED)), num, most, twice) if compared else chosen

    def _verify(self, known: Sequence[Pair]) -> None:
        """Verify the matches given; pairs of which too few are right are matched as if none were given, too."""
        looks = self.looks
        given = {
            looks.ends[pair]: replace(self._given[pair], xy=looks.places(pair, self._given[pair].xy))
            for pair in (pair.views for pair in known)
        }
        found = verify_given(looks.views, given, [looks.pair(pair) for pair in known], self._options, self._work)
        for pair, one in zip(known, found, strict=True):
            if enough(one[1]):
                self.tried[pair.views] = pair, *one
            else:
                self._beside[pair.views] = one
        self._given = {pair: self._given[pair] for pair in self.tried}

    def _locate(self, pairs: Sequence[Pair]) -> None:
        """Find the keypoints that pairs need."""
        others = [self.looks.pair(pair) for pair in pairs if pair.views not in self._given]
        if others and matcher_named(self._options.matcher).detects:
            where: dict[str, Any] = {"pairs": others, "area": self._scope.area, "coarse": self._coarse}
            self._keypoints = locate(self.looks.views, self._options, self._work, **where)

    @property
    def keypoints(self) -> tuple[int, ...]:
        """Number of keypoints found in each view."""
        count = np.bincount(self.looks.of, weights=[len(k) for k in self._keypoints])
        return tuple(count.astype(int).tolist())

    def detail(self) -> tuple[IntArray, ...]:
        """Return the counts of keypoints of every view seen by partners that keypoints tie to it: `seen_detail`.

        None of an area of interest: beside it no tie points are wanted.
        """
        seen: list[list[Seen]] = [[] for _ in self._views]
        for (i, j), (_, found, report) in self.tried.items():
            if self._scope.area is None and report.matcher == TIE_DEFAULTS.matcher and len(found) >= FEW:
                first, second = map(finer, found.ends, self.looks.pixel[list(self.looks.ends[i, j])])
                seen[i].append((first, second, self._views[j].size))
                seen[j].append((second, first, self._views[i].size))
        whole = [int(np.flatnonzero(self.looks.of == v)[0]) for v in range(len(self._views))]
        tasks = [(self._keypoints[k], view.size, one) for k, view, one in zip(whole, self._views, seen, strict=True)]
        return tuple(self._work.ordered(seen_detail, tasks, "detail"))

    @property
    def outcome(self) -> tuple[list[Pair], list[PairReport]]:
        """The pairs tried, ascending, and their reports."""
        tried = [self.tried[views] for views in sorted(self.tried)]
        return [pair for pair, _, _ in tried], [report for _, _, report in tried]

    @property
    def by_looks(self) -> tuple[dict[tuple[int, int], Matches], dict[tuple[int, int], PairReport]]:
        """The matches and reports of the pairs tried, ascending, by the looks at which they were compared."""
        tried = {self.looks.ends[views]: self.tried[views] for views in sorted(self.tried)}
        return {ends: one[1] for ends, one in tried.items()}, {ends: one[2] for ends, one in tried.items()}

    def _judged(self, pairs: Sequence[Pair]) -> list[Pair]:
        """Return the pairs with their quick scores, where keypoints can tell."""
        new = [p for p in pairs if self._compares and p.views not in self._given and p.views not in self._scores]
        tasks = [(*self._ends(pair), self._options) for pair in new]
        scores = self._work.ordered(quick_score, tasks, "compare")
        self._scores |= {pair.views: score for pair, score in zip(new, scores, strict=True)}
        known = self._scores
        return [scored_pair(self._views, p, known[p.views]) if p.views in known else p for p in pairs]

    def _ends(self, pair: Pair) -> tuple[tuple[View, View], tuple[KeypointFiles, KeypointFiles]]:
        i, j = self.looks.ends[pair.views]
        return (self.looks.views[i], self.looks.views[j]), (self._keypoints[i], self._keypoints[j])

    def _try(self, pairs: Sequence[Pair]) -> None:
        others = [pair for pair in pairs if pair.views not in self.tried]
        before = [(self._ends(pair)[0], found) for pair, found, report in self.tried.values() if enough(report)]
        own = self._matched([self.looks.pair(pair) for pair in others], before)
        for pair, one in zip(others, own, strict=True):
            self.tried[pair.views] = pair, *beside_given(one, self._beside.get(pair.views))

    def rematch(self, registered: Mapping[tuple[int, int], int]) -> bool:
        """Match pairs of looks with only so many `registered` given matches; return whether own matches replace any.

        They do where more of them can be registered, and enough.
        """
        looks, options, of = self.looks, self._options, self.looks.of
        pairs = [self.tried[int(of[i]), int(of[j])][0] for i, j in registered]
        own = self._looked_closer([looks.pair(pair) for pair in pairs], GroundAltitudes(self._scope.terrain))
        changed = False
        for pair, (ends, count), (found, report) in zip(pairs, registered.items(), own, strict=True):
            structural = [ends] * report.structural
            linked = thin(link([ends], [found]), [view.size for view in looks.views], options.points_per_image)
            tracks = refine(looks.views, linked, {}, options, structural=structural, work=self._work)
            if tracks.num_points >= max(count + 1, options.min_matches):
                words = "%s - %s: of %d matches given %d could be registered, of own ones %d: these are used"
                logger.warning(words, *report.names, len(self.tried[pair.views][1]), count, tracks.num_points)
                self.tried[pair.views], changed = (pair, found, report), True
        return changed

    def _matched(
        self, pairs: Sequence[Pair], before: Sequence[tuple[tuple[View, View], Matches]]
    ) -> list[tuple[Matches, PairReport]]:
        """Match pairs of looks at reduced resolution, and at full resolution where that finds too few."""
        views, options, keypoints = self.looks.views, self._options, self._keypoints
        first = first_look(views, keypoints, pairs, options, self._work) if self._coarse else []
        found = {p.views: one for p, one in zip(pairs, first, strict=False) if self._is_ample(p, *one)}
        lacking = [pair for pair in pairs if pair.views not in found]
        known = [((views[p.views[0]], views[p.views[1]]), found[p.views][0]) for p in pairs if p.views in found]
        ground = GroundAltitudes(self._scope.terrain, (*before, *known))
        if self._coarse and lacking:
            again = self._looked_closer(lacking, ground)
        else:
            again = match_pairs(views, keypoints, lacking, options, ground, self._work)
        found |= {pair.views: one for pair, one in zip(lacking, again, strict=True)}
        return [found[pair.views] for pair in pairs]

    def _is_ample(self, pair: Pair, found: Matches, report: PairReport) -> bool:
        i, j = pair.views
        return ample(report, self._options.points_per_image) and not stretched(
            (self.looks.views[i], self.looks.views[j]), *found.ends
        )

    def _looked_closer(self, pairs: Sequence[Pair], ground: GroundAltitudes) -> list[tuple[Matches, PairReport]]:
        """Match pairs of looks by keypoints of their own."""
        views, options = self.looks.views, self._options
        detects = matcher_named(options.matcher).detects
        closer = locate(views, options, self._work, pairs=pairs, area=self._scope.area) if detects else self._keypoints
        self._closer += 1  # each numbers its keypoints, below 0, where no place is
        keypoints = [replace(files, start=-self._closer << 32) for files in closer]
        return match_pairs(views, keypoints, pairs, options, ground, self._work)


def _unlike(linked: Tracks, registered: Tracks, pairs: Collection[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the pairs with unlike grey values, by which too few of their matches could be registered.

    Of tracks that only both see, where there are enough: in others a third view may be what does not compare.
    """
    counts, found = [], []
    for tracks in (linked, registered):
        of_two = tracks.select(np.bincount(tracks.point, minlength=tracks.num_points)[tracks.point] == 2)
        counts.append((pair_counts(of_two), pair_counts(tracks)))
    for pair in pairs:
        kind = 0 if counts[0][0].get(pair, 0) >= FEW else 1
        before, after = (count[kind].get(pair, 0) for count in counts)
        found += [pair] if after < min(0.5 * before, MANY) else []
    return found


def _with_pictures(
    views: Sequence[View], pairs: Sequence[tuple[int, int]], band: int, work: Work
) -> list[tuple[int, int]]:
    """Return the pairs of images with detail: structure compares no uniform image either."""
    some = sorted({view for pair in pairs for view in pair})
    stretches = work.ordered(sample_stretch, [(views[i].path, band, views[i].size) for i in some], "survey")
    blank = {i for i, stretch in zip(some, stretches, strict=True) if stretch is None}
    return [pair for pair in pairs if not blank & set(pair)]


def _with_unregistered(views: Sequence[View], tracks: Tracks, given: GivenMatches, options: TieOptions) -> Tracks:
    """Return the tracks with the verified matches of those given pairs with too few registered tracks."""
    counts = pair_counts(tracks)
    lost = [pair for pair in given if counts.get(pair, 0) < options.min_matches]
    if not lost:
        return tracks
    for i, j in lost:
        words = "%s - %s: %d of %d matches could be registered: the others are used as found, good to %.2f px"
        count, known = counts.get((i, j), 0), given[i, j]
        logger.warning(words, views[i].name, views[j].name, count, len(known), known.sigma)
    sizes, most = [view.size for view in views], options.points_per_image
    more = thin(link(lost, [given[pair] for pair in lost]), sizes, most)
    return _merge_registered(views, tracks, more)


def _merge_registered(views: Sequence[View], tracks: Tracks, others: Tracks) -> Tracks:
    """Merge registered and other tracks: observations beside a registered one are the same point."""
    reach = MAX_PATCH_SHIFT + float(np.hypot(0.5, 0.5))  # registration, and rounding, may move a point by so much
    known, asked = (np.array([2 * reach * part.view, *part.xy.T]).T for part in (tracks, others))
    near, row = map(np.asarray, kd_tree(known).query(asked, distance_upper_bound=reach))
    same = np.flatnonzero(np.isfinite(near))
    point, which = np.unique(others.point[same], return_index=True)
    anchor = np.full(others.num_points, -1)  # the row of each track that says where it stands, if one does
    anchor[point] = same[which]
    number, xy = tracks.num_points + others.point, others.xy.copy()
    found = np.flatnonzero(anchor[others.point] >= 0)
    start = anchor[others.point[found]]
    number[found] = tracks.point[row[start]]
    moved = tracks.xy[row[start]] - others.xy[start]  # registration moves a point, and all views of it with it
    for group in grouped(others.view[start], others.view[found]):
        first, second = (views[others.view[end[group[0]]]] for end in (start, found))
        linear = linear_map(first, second, others.xy[start[group]])
        xy[found[group]] += (linear @ moved[group, :, None])[..., 0]
    view, number = np.concatenate([tracks.view, others.view]), np.concatenate([tracks.point, number])
    once = np.unique(np.stack([number, view]), axis=1, return_index=True)[1]  # in the order that tracks have
    point = np.unique(number[once], return_inverse=True)[1].reshape(-1)
    xy, sigma = np.concatenate([tracks.xy, xy]), np.concatenate([tracks.sigma, others.sigma])
    return Tracks(view[once], point, xy[once], sigma[once])
