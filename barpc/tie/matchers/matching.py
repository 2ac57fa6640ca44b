"""Matching two views along the epipolar segments that their cameras predict, with any matcher.

A blind pass finds how wrong the cameras are relative to each other; a tight pass searches a narrow band about the
corrected segments; a local pass looks again at the altitudes of the neighbours; matches that disagree with their
neighbours across the lines are rejected. The same searches in bands that are shifted aside find only false matches:
they say how unlike two places may look for a wanted share of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np

from barpc.base.geodesy import Array
from barpc.base.options import TIE_DEFAULTS, TieOptions
from barpc.base.statistics import FEW, MANY, SAMPLE, STEPS, SURELY, kd_tree, robust_spread
from barpc.base.tasks import HERE, Work
from barpc.scene import BoolArray, IntArray, View
from barpc.sensor.sampler import GRID_NODES, image_grid
from barpc.tie.matchers.features import AMPLE, KeypointFiles, Keypoints, join_keypoints
from barpc.tie.matchers.guided import CLEAR_RATIO, Guided
from barpc.tie.matchers.matcher import DUPLICATE_DISTANCE, NO_MATCHES, Hook, Matcher, Matches, Prediction, hooked
from barpc.tie.matchers.placings import Placing, likeliest_placing, stretched
from barpc.tie.matchers.report import (
    FINE_STRUCTURE,
    STRUCTURE,
    SUFFICIENT_SHARE,
    PairReport,
    better,
    enough,
    worth_more,
)
from barpc.tie.matchers.structural import FineStructure, GradientStructure
from barpc.tie.pairing.epipolar import (
    LEAST_REACH,
    LEAST_SIGMA,
    EpipolarSegments,
    coherent,
    common_range,
    epipolar_segments,
    gradient,
    robust_affine,
)
from barpc.tie.pairing.overlaps import Pair, Terrain, reach_of, shared_tiles
from barpc.tie.patches.channels import INVALID_MARGIN
from barpc.tie.pixels import tiles

MATCHERS: dict[str, type[Matcher]] = {"guided": Guided, STRUCTURE: GradientStructure, FINE_STRUCTURE: FineStructure}
"""Name -> matcher."""


def matcher_named(name: str) -> type[Matcher] | Hook:
    """Return the matcher that an option names: a row of `MATCHERS`, or the function or class `module:name`."""
    return MATCHERS[name] if name in MATCHERS else hooked(name)


BAND_HALFWIDTH = 3.0
"""Half the width of the band about the corrected epipolar line, at most [px]."""
_PASSES = ((20.0, 1500), (80.0, 2000), (float("inf"), 3000))
"""Blind passes: half width [px] (the last: `search`), points of A that are tried."""
_SIGNIFICANT_PEAK = 6.0  # standard deviations
_NEIGHBOURS_COUNTED, _SPARSE_FACTOR = 3, 2.0
"""A point has no matches near where so many lie so many times as far from it as from another."""
_NOWHERE = "no common offset"
FALSE_SHARE = 0.01
"""Share of false matches that is accepted, as control bands estimate it."""
_LOOSE_RATIO, _LOOSE_FALSE_SHARE, _LOOSE_NEEDED = 0.95, 0.05, 2 / 3
"""Ratio and false share of the second attempt; its part of the matches that a pair needs."""
_MARGINS = 150.0, 50.0  # m beyond known altitudes: how wrong cameras make them, and seldom do
_BOTH = Pair((0, 1), 1.0, 0.0)  # two views, of which nothing else is asked


Ends = tuple[View, View]
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
    looked: dict[str, _PairSearch] = {}
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
        tried.append(_attempt(views, keypoints, pair, loose, looked, _LOOSE_FALSE_SHARE))
    if structural and all(report.status != "ok" for _, report in tried):
        fine = replace(loose, matcher=FINE_STRUCTURE)
        tried.append(_attempt(views, keypoints, pair, fine, looked, _LOOSE_FALSE_SHARE))
    return better(*tried)


def _attempt(
    views: Ends,
    keypoints: Points,
    pair: Pair,
    options: TieOptions,
    looked: dict[str, _PairSearch] | None = None,
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
    search = _PairSearch(views, loaded, options) if before is None else before.loosened(loaded, options)
    looked[options.matcher] = search
    coarse = search.offset
    if coarse is None:
        return NO_MATCHES, replace(report, status=f"{_NOWHERE} within {search.reach:.4g} px")
    tight = search.further(search.trusted(coarse, _LOOSE_FALSE_SHARE)[0])
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
    seen = shared_tiles(views, [_BOTH], boxes, search) if max(map(len, boxes)) > 1 else boxes
    first, second = (points.load(some) for points, some in zip(keypoints, seen, strict=True))
    return (first[0], second[0]), (first[1], second[1])


def quick_score(views: Ends, keypoints: tuple[KeypointFiles, KeypointFiles], options: TieOptions) -> int:
    """Return the number of matches, at most 5 % of them false, among a few keypoints: a cheap forecast for a pair."""
    few = (keypoints[0].strongest(AMPLE * MANY), keypoints[1].strongest(AMPLE * MANY))
    if not (len(few[0]) and len(few[1])):
        return 0
    search = _PairSearch(views, _overlap_keypoints(views, few, options.search)[0], replace(options, ratio=_LOOSE_RATIO))
    coarse = search.offset
    return 0 if coarse is None else len(search.trusted(coarse, _LOOSE_FALSE_SHARE)[0])


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


def _latest(where: Callable[[Array], EpipolarSegments]) -> Callable[[Array], EpipolarSegments]:
    """Return the function with a cache of its last value: matchers ask for the same array again."""
    known: list[tuple[Array, EpipolarSegments]] = []

    def remembered(xy: Array) -> EpipolarSegments:
        if not known or known[0][0] is not xy:
            known[:] = [(xy, where(xy))]
        return known[0][1]

    return remembered


class _Peak(NamedTuple):
    """Result of a blind pass."""

    prediction: Prediction  # where to search next
    share: float  # of the matches that stand in the peak
    significance: float  # in standard deviations beyond chance


class _PairSearch:
    """The passes over one pair of views."""

    def __init__(self, views: Ends, keypoints: tuple[Keypoints, Keypoints], options: TieOptions) -> None:
        self._views, self._options = views, options
        self._matcher = matcher_named(options.matcher)(options, keypoints)
        self.reach = min(reach_of(views[1], options.search), getattr(self._matcher, "widest", float("inf")))
        points = keypoints[0].xy
        boxes = [tiles(view.size, options.tile) for view in views]
        self._windows = cache(lambda: shared_tiles(views, [_BOTH], boxes, options.search)[0])
        if not self._matcher.detects:
            middles = [(col + 0.5 * width, row + 0.5 * height) for col, row, width, height in self._windows()]
            points = np.array(middles).reshape(-1, 2)
        self._points, first = points, epipolar_segments(*views, points)
        self._axis = first.axis
        self._frame = _latest(lambda xy: first if xy is points else epipolar_segments(*views, xy, first.axis))

    def loosened(self, keypoints: tuple[Keypoints, Keypoints], options: TieOptions) -> _PairSearch:
        """Return the search with looser thresholds; its predictions stay the same."""
        other = copy(self)
        if self._matcher.detects:
            other._matcher = matcher_named(options.matcher)(options, keypoints)
        if self._options.ratio < CLEAR_RATIO:  # nor which matches are clear, but for this
            vars(other).pop("offset", None)
        return other

    @property
    def patch(self) -> float:
        """Side of the template about a point [px]; 0: none."""
        return float(getattr(self._matcher, "patch", 0.0))

    def errors(self, found: Matches) -> Array:
        """Return the distances (M, 2) [px] of matches from the predictions, along and across epipolar lines."""
        return epipolar_segments(*self._views, found.xy[:, 0], self._axis).errors(found.xy[:, 1])

    def _predicted(self, where: Callable[[Array], EpipolarSegments], half_width: float) -> Prediction:
        return Prediction(_latest(where), half_width, self._windows)

    def _distinct(self, prediction: Prediction) -> Matches:
        """Return the matches, the best first, at most one between the same two pixels."""
        found = self._matcher.match(*self._views, prediction)
        found = found.select(np.argsort(found.score, kind="stable"))
        pixels = np.rint(found.xy).reshape(-1, 4)
        return found.select(np.sort(np.unique(pixels, axis=0, return_index=True)[1]))

    def trusted(self, prediction: Prediction, false_share: float) -> tuple[Matches, float]:
        """Return the matches among which at most a share is false, and that share as estimated.

        Bands shifted to either side hold no true match: theirs tell how many false ones come with a score. (The
        "decoys" of peptide identification: Elias and Gygi 2007.)
        """
        found, aside = self._distinct(prediction), 2.0 * prediction.half_width + INVALID_MARGIN
        decoys = [np.sort(self._distinct(replace(prediction, aside=side * aside)).score) for side in (-1.0, 1.0)]
        few, many = np.sort([np.searchsorted(decoy, found.score, side="right") for decoy in decoys], axis=0)
        # some in one of them are true where an image's rows lie as far off
        false = np.where(many - few > SURELY * np.sqrt(few + many), few, 0.5 * (few + many))
        share = false / np.arange(1, len(found) + 1)
        good = np.flatnonzero(share <= false_share)
        count = good[-1] + 1 if len(good) else 0
        return found.select(np.arange(count)), float(share[count - 1]) if count else 0.0

    @cached_property
    def offset(self) -> Prediction | None:
        """Corrected prediction by blind passes of growing width for the cameras' relative error.

        The first pass in whose peak most matches stand decides, else the one with the most significant peak, if any.
        """
        best: _Peak | None = None
        passes = {min(width, self.reach): probes for width, probes in _PASSES}  # of one width the last
        for width, probes in passes.items():
            found = self._blind(width, probes)
            if found is not None and (best is None or found.significance > best.significance):
                best = found
            if best is not None and best.share >= SUFFICIENT_SHARE:
                break
        return None if best is None else best.prediction

    def further(self, tight: Matches) -> Matches:
        """Return the matches with those at other offsets: of points without matches near them, where these show a peak.

        From some row on, or column, an image may lie elsewhere.
        """
        for _ in range(STEPS if self._matcher.detects and len(tight) >= FEW else 0):
            peak = self._beside(tight)
            more = NO_MATCHES if peak is None else self.trusted(peak.prediction, _LOOSE_FALSE_SHARE)[0]
            both = tight.and_others(more)
            if len(both) == len(tight):
                break
            tight = both
        return tight

    def _beside(self, found: Matches) -> _Peak | None:
        """Return a blind pass over the points without matches near them, about the offset of the matches found."""
        places, offset = found.xy[:, 0], float(np.median(self.errors(found)[:, 1]))
        tree = kd_tree(places)

        def nearest(xy: Array, count: int) -> Array:
            return np.asarray(tree.query(xy, k=[count])[0])[:, 0]

        reach = _SPARSE_FACTOR * float(np.median(nearest(places, _NEIGHBOURS_COUNTED + 1)))
        count = int((nearest(self._points, _NEIGHBOURS_COUNTED) > reach).sum())
        if not count:
            return None
        width, probes = _PASSES[0][0] + abs(offset), _PASSES[0][1]
        return self._blind(
            width, probes * len(self._points) // count, lambda xy: nearest(xy, _NEIGHBOURS_COUNTED) > reach
        )

    def _blind(self, width: float, probes: int, bare: Callable[[Array], BoolArray] | None = None) -> _Peak | None:
        """Return the peak of the errors across the epipolar lines of some points, if it is significant.

        Only of points that are `bare` where that is given.
        """
        every = self._frame  # and not this search: what it found would keep it, and it what it found

        def everywhere(xy: Array) -> EpipolarSegments:
            where = every(xy)
            along = where.along if bare is None else np.where(bare(xy), where.along, np.nan)
            return replace(where, along=along, before=where.before - width, after=where.after + width)

        prediction = replace(self._predicted(everywhere, width), probes=probes)
        found = self._matcher.match(*self._views, prediction)
        if not len(found):
            return None
        errors = self.errors(found)
        values = np.sort(errors[:, 1])
        window = 2 * DUPLICATE_DISTANCE  # px, in which true matches fall
        count = np.searchsorted(values, values + window, side="right") - np.arange(len(values))
        start, most = int(count.argmax()), int(count.max())
        middle = float(np.median(values[start : start + most]))
        chance = (len(values) - most) * window / (2 * width)
        significance = (most - chance) / np.sqrt(chance + 1.0)
        if significance < _SIGNIFICANT_PEAK or abs(middle) > width - window:
            return None
        inside = np.abs(errors[:, 1] - middle) <= window
        across = robust_affine(found.xy[inside, 0], errors[inside, 1])
        low, high = np.percentile(errors[inside, 0], [2, 98])
        margin = 0.5 * (high - low) + 10.0
        first, last = low - margin, high + margin

        def corrected(xy: Array) -> EpipolarSegments:
            where, same = every(xy).moved(across(xy)), np.ones(len(xy))
            return replace(where, before=first * same, after=last * same)

        return _Peak(self._predicted(corrected, BAND_HALFWIDTH), most / len(values), float(significance))

    def local(self, tight: Matches) -> Prediction:
        """Return the corrected prediction: each point in a band about its neighbours' places by the matches so far."""
        errors, places = self.errors(tight), tight.xy[:, 0]
        tree, every = kd_tree(places), self._frame
        slope, spread = gradient(places, errors[:, 1]), robust_spread(coherent(places, errors[:, 1])[1])
        level = errors[:, 1] - places @ slope

        def nearby(xy: Array) -> EpipolarSegments:
            near = tree.query(xy, k=min(FEW, len(tight)))[1]
            along = errors[near, 0]
            middle = np.median(along, axis=1)
            half = 2 * DUPLICATE_DISTANCE + SURELY * robust_spread(along, middle[:, None])
            where = every(xy).moved(xy @ slope + np.median(level[near], axis=1))
            return replace(where, before=middle - half, after=middle + half)

        return self._predicted(nearby, float(np.clip(4.0 * spread, 0.6, BAND_HALFWIDTH)))
