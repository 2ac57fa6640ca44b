"""Search for matches of a pair of views: blind passes for the cameras' relative error, then narrow bands."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np

from barpc.base.geodesy import Array
from barpc.base.options import TieOptions
from barpc.base.statistics import FEW, STEPS, SURELY, kd_tree, robust_spread
from barpc.scene import BoolArray, View
from barpc.tie.matchers.features import Keypoints
from barpc.tie.matchers.guided import CLEAR_RATIO, Guided
from barpc.tie.matchers.matcher import DUPLICATE_DISTANCE, NO_MATCHES, Hook, Matcher, Matches, Prediction, hooked
from barpc.tie.matchers.report import FINE_STRUCTURE, STRUCTURE, SUFFICIENT_SHARE
from barpc.tie.matchers.structural import FineStructure, GradientStructure
from barpc.tie.pairing.epipolar import EpipolarSegments, coherent, epipolar_segments, gradient, robust_affine
from barpc.tie.pairing.overlaps import Pair, reach_of, shared_tiles
from barpc.tie.patches.channels import INVALID_MARGIN
from barpc.tie.pixels import tiles

MATCHERS: dict[str, type[Matcher]] = {"guided": Guided, STRUCTURE: GradientStructure, FINE_STRUCTURE: FineStructure}
"""Name -> matcher."""
BAND_HALFWIDTH = 3.0
"""Largest half width of the band about the corrected epipolar line [px]."""
_PASSES = ((20.0, 1500), (80.0, 2000), (float("inf"), 3000))
"""Blind passes: half width of the band [px] (at most `PairSearch.reach`), number of points of A to try."""
_SIGNIFICANT_PEAK = 6.0  # standard deviations
_NEIGHBOURS_COUNTED, _SPARSE_FACTOR = 3, 2.0
"""A point is isolated if its third-nearest match is farther than twice the median of that distance for matches."""
BOTH = Pair((0, 1), 1.0, 0.0)  # the two views of a search as a pair; overlap and angle are not used
LOOSE_FALSE_SHARE = 0.05  # largest share of false matches among those that the next pass starts from
Ends = tuple[View, View]  # images A and B of a pair


def matcher_named(name: str) -> type[Matcher] | Hook:
    """Return the matcher named by an option: an entry of `MATCHERS`, or the function or class `module:name`."""
    return MATCHERS[name] if name in MATCHERS else hooked(name)


def _latest(where: Callable[[Array], EpipolarSegments]) -> Callable[[Array], EpipolarSegments]:
    """Return the function with a cache of its last value: matchers ask for the same array again."""
    known: list[tuple[Array, EpipolarSegments]] = []

    def remembered(xy: Array) -> EpipolarSegments:
        if not known or known[0][0] is not xy:
            known[:] = [(xy, where(xy))]
        return known[0][1]

    return remembered


class _Peak(NamedTuple):
    """Result of a blind pass: the peak of the errors across the epipolar lines."""

    prediction: Prediction  # where to search next
    share: float  # of the matches that lie in the peak
    significance: float  # excess over the number expected by chance [standard deviations]


class PairSearch:
    """Search for matches of one pair of views, pass by pass."""

    def __init__(self, views: Ends, keypoints: tuple[Keypoints, Keypoints], options: TieOptions) -> None:
        self._views, self._options = views, options
        self._matcher = matcher_named(options.matcher)(options, keypoints)
        self.reach = min(reach_of(views[1], options.search), getattr(self._matcher, "widest", float("inf")))
        points = keypoints[0].xy
        boxes = [tiles(view.size, options.tile) for view in views]
        self._windows = cache(lambda: shared_tiles(views, [BOTH], boxes, options.search)[0])
        if not self._matcher.detects:  # without keypoints, tiles have the predictions
            middles = [(col + 0.5 * width, row + 0.5 * height) for col, row, width, height in self._windows()]
            points = np.array(middles).reshape(-1, 2)
        self._points, first = points, epipolar_segments(*views, points)
        self._axis = first.axis
        self._frame = _latest(lambda xy: first if xy is points else epipolar_segments(*views, xy, first.axis))

    def loosened(self, keypoints: tuple[Keypoints, Keypoints], options: TieOptions) -> PairSearch:
        """Return the search with the looser thresholds of `options`, without repeating blind passes in vain."""
        other = copy(self)
        if self._matcher.detects:
            other._matcher = matcher_named(options.matcher)(options, keypoints)
        if self._options.ratio < CLEAR_RATIO:  # blind passes use smaller ratios only: others have the same result
            vars(other).pop("offset", None)
        return other

    @property
    def patch(self) -> float:
        """Side of the template about a point [px]; 0 without templates."""
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
        """Return the best matches of which at most `false_share` are false, and the estimated share.

        Bands shifted to either side (decoys) hold no true match: the number of their matches up to a score estimates
        that of false ones (target-decoy search: Elias and Gygi 2007).
        """
        found, aside = self._distinct(prediction), 2.0 * prediction.half_width + INVALID_MARGIN
        decoys = [np.sort(self._distinct(replace(prediction, aside=side * aside)).score) for side in (-1.0, 1.0)]
        few, many = np.sort([np.searchsorted(decoy, found.score, side="right") for decoy in decoys], axis=0)
        # displaced rows may have true matches in one decoy band: if the counts differ, the lower is used
        false = np.where(many - few > SURELY * np.sqrt(few + many), few, 0.5 * (few + many))
        share = false / np.arange(1, len(found) + 1)
        good = np.flatnonzero(share <= false_share)
        count = good[-1] + 1 if len(good) else 0
        return found.select(np.arange(count)), float(share[count - 1]) if count else 0.0

    @cached_property
    def offset(self) -> Prediction | None:
        """Prediction corrected for the cameras' relative error; None without a significant peak.

        Blind passes of growing width find it: the first with `SUFFICIENT_SHARE` of the matches in its peak, else the
        one with the most significant peak.
        """
        best: _Peak | None = None
        passes = {min(width, self.reach): probes for width, probes in _PASSES}  # of equal widths the last: most probes
        for width, probes in passes.items():
            found = self._blind(width, probes)
            if found is not None and (best is None or found.significance > best.significance):
                best = found
            if best is not None and best.share >= SUFFICIENT_SHARE:
                break
        return None if best is None else best.prediction

    def further(self, tight: Matches) -> Matches:
        """Return the matches and those of isolated points at other offsets, if a blind pass shows any.

        Rows or columns of an image beyond some edge may be displaced against the rest.
        """
        for _ in range(STEPS if self._matcher.detects and len(tight) >= FEW else 0):
            peak = self._beside(tight)
            more = NO_MATCHES if peak is None else self.trusted(peak.prediction, LOOSE_FALSE_SHARE)[0]
            both = tight.and_others(more)
            if len(both) == len(tight):
                break
            tight = both
        return tight

    def _beside(self, found: Matches) -> _Peak | None:
        """Return the peak of a blind pass over the isolated points, in a band that includes the offset of `found`."""
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
        """Return the peak of the errors across the epipolar lines of `probes` points, if it is significant.

        `bare`: mask of points (N, 2) [px] of A to use; None: all.
        """
        every = self._frame  # closures must not refer to self: its cached `offset` would refer back to it

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
        window = 2 * DUPLICATE_DISTANCE  # px: extent of true matches
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
        """Return the prediction corrected by the errors of the nearest matches: a narrow band for each point."""
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
