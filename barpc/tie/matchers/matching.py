"""Matching two views along the epipolar segments that their cameras predict, with any matcher.

A blind pass finds how wrong the cameras are relative to each other; a tight pass searches a narrow band about the
corrected segments; a local pass looks again at the altitudes of the neighbours; matches that disagree with their
neighbours across the lines are rejected. The same searches in bands that are shifted aside find only false matches:
they say how unlike two places may look for a wanted share of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from barpc.base.options import TIE_DEFAULTS, TieOptions
from barpc.base.statistics import MANY, SAMPLE, robust_spread
from barpc.base.tasks import HERE, Work
from barpc.scene import IntArray, View
from barpc.sensor.sampler import GRID_NODES, image_grid
from barpc.tie.matchers.features import AMPLE, KeypointFiles, Keypoints, join_keypoints
from barpc.tie.matchers.guided import CLEAR_RATIO
from barpc.tie.matchers.matcher import NO_MATCHES, Matches
from barpc.tie.matchers.pair_search import BOTH, LOOSE_FALSE_SHARE, MATCHERS, Ends, PairSearch, matcher_named
from barpc.tie.matchers.placings import Placing, likeliest_placing, stretched
from barpc.tie.matchers.report import FINE_STRUCTURE, STRUCTURE, PairReport, better, enough, worth_more
from barpc.tie.pairing.epipolar import LEAST_REACH, LEAST_SIGMA, coherent, common_range, epipolar_segments
from barpc.tie.pairing.overlaps import Pair, Terrain, reach_of, shared_tiles

_NOWHERE = "no common offset"
FALSE_SHARE = 0.01
"""Share of false matches that is accepted, as control bands estimate it."""
_LOOSE_RATIO, _LOOSE_NEEDED = 0.95, 2 / 3
"""Ratio of the second attempt, and its part of the matches that a pair needs."""
_MARGINS = 150.0, 50.0  # m beyond known altitudes: how wrong cameras make them, and seldom do


Points = tuple[Keypoints | KeypointFiles, Keypoints | KeypointFiles]
"""Of both views; empty for a matcher that wants none."""


@dataclass(frozen=True, eq=False)
class GroundAltitudes:
    """Sources of the altitudes of the ground: a terrain, and the matches of pairs with enough of them."""

    terrain: Terrain | None = None
    ties: Sequence[tuple[Ends, Matches]] = ()

    def altitudes(self) -> tuple[float, float] | None:
        """Return the 2nd and 98th percentile [m] of the altitudes of the matches."""
        found = []
        for views, matches in self.ties:
            where, (low, high) = epipolar_segments(*views, matches.xy[:, 0]), common_range(*views)
            if np.median(where.after) >= LEAST_REACH:
                along = where.errors(matches.xy[:, 1])[:, 0] / where.after
                found.append(0.5 * (low + high) + 0.5 * (high - low) * np.percentile(along, [2, 98]))
        return (float(np.min(found)), float(np.max(found))) if found else None

    def within(self, views: Ends, known: tuple[float, float] | None, margin: float) -> Ends:
        """Return two views restricted to the altitudes of the terrain, or else to `known` ones, with a margin [m]."""
        low, high = common_range(*views)
        if self.terrain is not None:
            middle = 0.5 * (low + high)
            ground = views[0].sensor.localize(*image_grid(views[0].size, (middle, middle), (GRID_NODES[0], 1)))
            heights = self.terrain(ground[:, 0], ground[:, 1])
            other = views[1].sensor.project(np.column_stack([ground[:, :2], heights]))
            with np.errstate(invalid="ignore"):
                seen = ((other > 0.0) & (other < views[1].size)).all(axis=1)
            heights = heights[seen & np.isfinite(heights)]
            known = (float(heights.min()), float(heights.max())) if len(heights) else known
        if known is None or known[0] - margin > high or known[1] + margin < low:
            return views
        within = max(low, known[0] - margin), min(high, known[1] + margin)
        return replace(views[0], alt_range=within), replace(views[1], alt_range=within)


_UNKNOWN_GROUND = GroundAltitudes()


def match_pair(views: Ends, keypoints: Points, pair: Pair, options: TieOptions) -> tuple[Matches, PairReport]:
    """Match two views; a matcher without a detector takes empty keypoints. The report gives reasons of failure.

    Where few or none are found, loosened thresholds are tried, and what finds more counts; where none are, or matches
    of another size than the cameras say, it is asked whether a picture lies otherwise than its camera says.
    """
    found, report = _attempts(views, keypoints, pair, options)
    if options.matcher != TIE_DEFAULTS.matcher or (report.status == "ok" and not stretched(views, *found.ends)):
        return found, report
    a, b = (points.strongest(SAMPLE).load()[0] for points in keypoints)
    placings = _placing(views[::-1], (b, a), pair, options), _placing(views, (a, b), pair, options)
    if placings == (None, None):
        return found, report
    status = "a picture lies otherwise than its RPC says" if report.status == "ok" else report.status
    return NO_MATCHES, replace(report, status=status, verified=0, placings=placings)


def _placing(views: Ends, keypoints: tuple[Keypoints, Keypoints], pair: Pair, options: TieOptions) -> Placing | None:
    """Return the placing of the second picture, if it differs from its camera's and verified matches confirm it."""
    a, b = keypoints
    placing, count = likeliest_placing(views, keypoints) if len(a) and len(b) else (None, 0)
    if placing is None or count < options.min_matches or placing.is_stated(reach_of(views[1], options.search)):
        return None
    return placing if _attempt(views, (a, placing.undone(b)), pair, options)[1].status == "ok" else None


def _attempts(views: Ends, keypoints: Points, pair: Pair, options: TieOptions) -> tuple[Matches, PairReport]:
    looked: dict[str, PairSearch] = {}
    first = _attempt(views, keypoints, pair, options, looked)
    if enough(first[1]) or "keypoints" in first[1].status or options.matcher not in MATCHERS:
        return first
    loose = replace(
        options,
        ratio=max(options.ratio, _LOOSE_RATIO),
        min_matches=max(4, math.ceil(options.min_matches * _LOOSE_NEEDED)),
    )
    tried, structural = [first], options.matcher == STRUCTURE
    if not (
        (structural and first[1].matches < loose.min_matches)  # thresholds do not say where it looks
        or (first[1].status.startswith(_NOWHERE) and options.ratio >= CLEAR_RATIO)
    ):  # nor do looser ones let more through where only clear matches count
        tried.append(_attempt(views, keypoints, pair, loose, looked, LOOSE_FALSE_SHARE))
    if structural and all(report.status != "ok" for _, report in tried):
        fine = replace(loose, matcher=FINE_STRUCTURE)
        tried.append(_attempt(views, keypoints, pair, fine, looked, LOOSE_FALSE_SHARE))
    return better(*tried)


def _attempt(
    views: Ends,
    keypoints: Points,
    pair: Pair,
    options: TieOptions,
    looked: dict[str, PairSearch] | None = None,
    false_share: float | None = None,
) -> tuple[Matches, PairReport]:
    """Match a pair by all passes of one matcher; searches in `looked` are shared between attempts.

    `false_share`: the share of false matches that is accepted, by default `FALSE_SHARE`.
    """
    looked = {} if looked is None else looked
    false_share = FALSE_SHARE if false_share is None else false_share
    names, counts = (views[0].name, views[1].name), (len(keypoints[0]), len(keypoints[1]))
    known: dict[str, Any] = {"angle": pair.angle, "overlap": pair.overlap, "reason": pair.reason}
    report = PairReport(names, "ok", counts, matcher=options.matcher, loosened=false_share > FALSE_SHARE, **known)
    kind = matcher_named(options.matcher)
    if kind.detects and min(counts) < options.min_matches:
        return NO_MATCHES, replace(report, status="too few keypoints")
    loaded, numbers = _overlap_keypoints(views, keypoints, options.search)
    before = looked.get(options.matcher)
    search = PairSearch(views, loaded, options) if before is None else before.loosened(loaded, options)
    looked[options.matcher] = search
    coarse = search.offset
    if coarse is None:
        return NO_MATCHES, replace(report, status=f"{_NOWHERE} within {search.reach:.4g} px")
    tight = search.further(search.trusted(coarse, LOOSE_FALSE_SHARE)[0])
    report = replace(report, matches=len(tight))
    if len(tight) < options.min_matches:
        return NO_MATCHES, replace(report, status="too few matches")
    found, control = search.trusted(search.local(tight), false_share)
    errors = search.errors(found)
    keep, residual = coherent(found.xy[:, 0], errors[:, 1])
    report = replace(report, matches=len(found), verified=int(keep.sum()), control_share=control)
    cells = np.floor(found.xy[keep, 0] / search.patch) if search.patch else found.xy[keep, 0]
    if len(np.unique(cells, axis=0)) < options.min_matches:  # others share their patches
        return NO_MATCHES, replace(report, status="too few matches on common epipolar lines")
    spread, share = robust_spread(residual[keep]), report.verified / len(found)
    along, across = np.median(errors[keep], axis=0).tolist()
    report = replace(report, inlier_share=share, offset=(along, across), spread=spread)
    if kind.detects:
        index = np.stack([number[column] for number, column in zip(numbers, found.index.T, strict=True)], axis=-1)
        found = replace(found, index=index)
    return replace(found.select(keep), sigma=max(spread, LEAST_SIGMA)), report


def _overlap_keypoints(
    views: Ends, keypoints: Points, search: float | None
) -> tuple[tuple[Keypoints, Keypoints], tuple[IntArray, IntArray]]:
    """Return the keypoints, and their numbers, of the tiles that both views may see; of one tile, or in memory, all."""
    boxes = [points.boxes for points in keypoints]
    seen = shared_tiles(views, [BOTH], boxes, search) if max(map(len, boxes)) > 1 else boxes
    first, second = (points.load(some) for points, some in zip(keypoints, seen, strict=True))
    return (first[0], second[0]), (first[1], second[1])


def quick_score(views: Ends, keypoints: tuple[KeypointFiles, KeypointFiles], options: TieOptions) -> int:
    """Return the number of matches, at most 5 % of them false, among a few keypoints: a cheap forecast for a pair."""
    few = (keypoints[0].strongest(AMPLE * MANY), keypoints[1].strongest(AMPLE * MANY))
    if not (len(few[0]) and len(few[1])):
        return 0
    search = PairSearch(views, _overlap_keypoints(views, few, options.search)[0], replace(options, ratio=_LOOSE_RATIO))
    coarse = search.offset
    return 0 if coarse is None else len(search.trusted(coarse, LOOSE_FALSE_SHARE)[0])


def first_look(
    views: Sequence[View], keypoints: Sequence[KeypointFiles], pairs: Sequence[Pair], options: TieOptions, work: Work
) -> list[tuple[Matches, PairReport]]:
    """Match keypoints of reduced resolution once for each pair: those with `ample` matches need no more."""
    return work.ordered(_attempt, _tasks(views, keypoints, pairs, options), "match")


def _tasks(
    views: Sequence[View], keypoints: Sequence[Keypoints | KeypointFiles], pairs: Sequence[Pair], options: TieOptions
) -> list[tuple[Ends, tuple[Any, Any], Pair, TieOptions]]:
    ends = [(pair, *pair.views) for pair in pairs]
    return [((views[i], views[j]), (keypoints[i], keypoints[j]), pair, options) for pair, i, j in ends]


def match_pairs(
    views: Sequence[View],
    keypoints: Sequence[Keypoints | KeypointFiles],
    pairs: Sequence[Pair],
    options: TieOptions = TIE_DEFAULTS,
    ground: GroundAltitudes = _UNKNOWN_GROUND,
    work: Work = HERE,
) -> list[tuple[Matches, PairReport]]:
    """Match every pair, each with its report: `match_pair` over all, and `STRUCTURE` where it finds few.

    `ground`, or else the matches of other pairs, tells the altitudes at which that looks.
    """
    tasks = _tasks(views, keypoints, pairs, options)
    found: list[tuple[Matches, PairReport]] = work.ordered(match_pair, tasks, "match")
    named = options.matcher != TIE_DEFAULTS.matcher
    if named and (options.matcher != STRUCTURE or ground.terrain is None):  # a name is what is wanted
        return found
    thin = [k for k, (_, report) in enumerate(found) if not enough(report) and worth_more(report)]
    good = [(task[0], one[0]) for task, one in zip(tasks, found, strict=True) if thin and enough(one[1])]
    known = GroundAltitudes(ground.terrain, (*ground.ties, *good)).altitudes() if thin else None
    none, other = join_keypoints([]), replace(options, matcher=STRUCTURE)
    again = [
        ([ground.within(tasks[k][0], known, margin) for margin in _MARGINS], (none, none), pairs[k], other)
        for k in thin
    ]
    for k, one in zip(thin, work.ordered(_match_within, again, STRUCTURE), strict=True):
        found[k] = better(found[k], one)
    return found


def _match_within(
    several: Sequence[Ends], keypoints: tuple[Keypoints, Keypoints], pair: Pair, options: TieOptions
) -> tuple[Matches, PairReport]:
    """Match two views within an altitude range, and within narrower ones where that finds few."""
    tried = [match_pair(several[0], keypoints, pair, options)]
    for views in several[1:]:
        if not enough(tried[-1][1]) and views[0].alt_range != several[0][0].alt_range:
            tried.append(match_pair(views, keypoints, pair, options))
    return better(*tried)
