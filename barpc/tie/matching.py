"""Matching two views along the epipolar segments that their cameras predict.

A blind pass finds how wrong the cameras are relative to each other; a tight pass searches a narrow band
about the corrected segments; a local pass looks again where the neighbours' altitudes are; a robust affine
fit, window by window, throws out what does not lie on the lines. The same searches in bands that are
shifted aside find only false matches: they say how far descriptors may differ for a wanted share of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from barpc.geodesy import Array
from barpc.scene import BoolArray, IntArray, View
from barpc.sensor import SensorModel
from barpc.tie.epipolar import Affine, Frame, agreeing, frame, mad, robust_affine
from barpc.tie.features import Keypoints
from barpc.tie.guided import MATCHERS, Band, Matcher
from barpc.tie.options import TieOptions
from barpc.tie.pairs import Pair

_PASSES = ((20.0, 1500), (80.0, 2000), (float("inf"), 3000))
"""Blind passes: half width [px] (the last: `search`), keypoints of A that are tried."""
_PEAK = 4.0  # px, width of the window in which true matches of a blind pass fall
_LEAST_PEAK = 8  # matches
_SIGNIFICANT = 6.0  # standard deviations
_CLEAR = 0.4  # share of the matches that makes wider passes needless
_CLEAR_RATIO = 0.8
_FALSE_SHARE_TIGHT = 0.05  # of the tight pass, which only serves the local one
_NEIGHBOURS = 12


@dataclass(frozen=True, eq=False)
class Matches:
    """Keypoints of two views that show the same ground.

    Parameters
    ----------
    pair : tuple of int
        Indices of the views.
    index : (M, 2)
        Keypoints in the first and in the second view.
    xy : (M, 2, 2)
        col, row in the first and in the second view [px].
    sigma : (M,)
        Standard deviation of each coordinate [px].
    """

    pair: tuple[int, int]
    index: IntArray
    xy: Array
    sigma: Array

    def __len__(self) -> int:
        """Number of matches M."""
        return len(self.index)

    def select(self, keep: IntArray | BoolArray) -> Matches:
        """The matches of a mask or of indices."""
        return Matches(self.pair, self.index[keep], self.xy[keep], self.sigma[keep])


@dataclass(frozen=True)
class PairReport:
    """What became of a pair of views.

    Parameters
    ----------
    names : tuple of str
        The views.
    status : str
        "ok", or what went wrong.
    keypoints : tuple of int
        Keypoints of the two views.
    matches, verified : int
        After the tight pass; after the verification.
    inlier_share : float
        verified / matches.
    control_share : float
        Share of the verified matches that chance alone would give.
    offset : tuple of float
        Median distance of the matches from the prediction at the middle altitude, along and across the
        epipolar direction [px].
    spread : float
        Robust standard deviation across the epipolar line after the affine fit [px].
    angle : float
        Convergence angle [deg].
    overlap : float
        Common area over that of the smaller footprint.
    """

    names: tuple[str, str]
    status: str
    keypoints: tuple[int, int]
    matches: int = 0
    verified: int = 0
    inlier_share: float = 0.0
    control_share: float = 0.0
    offset: tuple[float, float] = (float("nan"), float("nan"))
    spread: float = float("nan")
    angle: float = float("nan")
    overlap: float = float("nan")


def match_pair(
    views: tuple[View, View],
    keypoints: tuple[Keypoints, Keypoints],
    pair: Pair,
    options: TieOptions,
    sensors: tuple[SensorModel, SensorModel] | None = None,
) -> tuple[Matches, PairReport]:
    """Match the keypoints of two views.

    Parameters
    ----------
    views : two View
        The views.
    keypoints : two Keypoints
        Their keypoints.
    pair : Pair
        As `select_pairs` gave it.
    options : TieOptions
        Search distances, ratio, share of false matches, smallest number of matches.
    sensors : two SensorModel, optional
        Corrected cameras to use instead of the views' own.

    Returns
    -------
    matches : Matches
        None where the pair failed: the report says why.
    report : PairReport
        Counts and measures.
    """
    cameras = sensors or (views[0].sensor, views[1].sensor)
    report = PairReport(
        (views[0].name, views[1].name),
        "ok",
        (len(keypoints[0]), len(keypoints[1])),
        angle=pair.angle,
        overlap=pair.overlap,
    )
    nothing = Matches(pair.views, np.empty((0, 2), dtype=np.int64), np.empty((0, 2, 2)), np.empty(0))
    if min(report.keypoints) < options.min_matches:
        return nothing, replace(report, status="too few keypoints")
    where = frame(*cameras, keypoints[0].xy, common_range(*views))
    search = _Search(*keypoints, MATCHERS[options.matcher](), options)
    coarse = find_offset(search, where)
    if coarse is None:
        return nothing, replace(report, status=f"no common offset within {options.search:g} px")
    tight, _ = search.trusted(where.moved(0.0, coarse.across(search.a.xy)), coarse.band, _FALSE_SHARE_TIGHT)
    report = replace(report, matches=len(tight))
    if len(tight) < options.min_matches:
        return nothing, replace(report, status="too few matches")
    found, control = search.trusted(*_local(search, where, tight), options.false_share)
    errors = where.errors(found[:, 0], search.b.xy[found[:, 1]])
    keep, residual = agreeing(search.a.xy[found[:, 0]], errors[:, 1])
    verified = found[keep]
    report = replace(report, matches=len(found), verified=len(verified), control_share=control)
    if len(verified) < options.min_matches:
        return nothing, replace(report, status="too few matches on common epipolar lines")
    spread = mad(residual[keep])
    report = replace(
        report,
        inlier_share=len(verified) / len(found),
        offset=(float(np.median(errors[keep, 0])), float(np.median(errors[keep, 1]))),
        spread=spread,
    )
    xy = np.stack([search.a.xy[verified[:, 0]], search.b.xy[verified[:, 1]]], axis=1)
    return Matches(pair.views, verified, xy, np.full(len(verified), max(spread, 0.05))), report


def common_range(first: View, second: View) -> tuple[float, float]:
    """The altitudes [m] at which two views may see the same ground."""
    low = max(first.alt_range[0], second.alt_range[0])
    high = min(first.alt_range[1], second.alt_range[1])
    return min(low, high), max(low, high)


@dataclass(frozen=True, eq=False)
class Coarse:
    """What a blind pass finds.

    Parameters
    ----------
    across : Affine
        Error across the epipolar lines as a function of position in A.
    band : Band
        Where to search next.
    share : float
        Part of the matches that stand in the peak.
    significance : float
        Matches in the peak beyond chance, in standard deviations.
    """

    across: Affine
    band: Band
    share: float
    significance: float


@dataclass(frozen=True, eq=False)
class _Search:
    """Searches among the keypoints of one pair."""

    a: Keypoints
    b: Keypoints
    matcher: Matcher
    options: TieOptions

    def unambiguous(self, where: Frame, band: Band) -> tuple[IntArray, Array]:
        """Distinct matches (M, 2) that pass the ratio test, and their descriptor distances (M,)."""
        found = self.matcher.match(self.a, self.b, where, band)
        keep = np.flatnonzero(found.ambiguity <= self.options.ratio)
        keep = keep[np.argsort(found.distance[keep], kind="stable")]
        index = found.index[keep]
        places = np.rint(np.concatenate([self.a.xy[index[:, 0]], self.b.xy[index[:, 1]]], axis=1))
        first = np.sort(np.unique(places, axis=0, return_index=True)[1])  # equal up to the orientation
        return index[first], found.distance[keep][first]

    def trusted(self, where: Frame, band: Band, false_share: float) -> tuple[IntArray, float]:
        """Matches (M, 2) among which at most a share is false, and that share as estimated.

        Bands shifted to either side hold no true match; their matches tell how many false ones come with
        a descriptor distance. (The "decoys" of peptide identification: Elias and Gygi 2007.)
        """
        index, distance = self.unambiguous(where, band)
        aside = 2.0 * band.across + 6.0
        decoys = [self.unambiguous(where.moved(0.0, side * aside), band)[1] for side in (-1.0, 1.0)]
        false = 0.5 * np.searchsorted(np.sort(np.concatenate(decoys)), distance, side="right")
        share = false / np.arange(1, len(distance) + 1)
        good = np.flatnonzero(share <= false_share)
        if not len(good):
            return index[:0], 0.0
        return index[: good[-1] + 1], float(share[good[-1]])


def find_offset(search: _Search, where: Frame) -> Coarse | None:
    """How wrong the cameras are, from blind passes of growing width; None where none finds a clear peak.

    The first pass in whose peak most matches stand decides; without one, the pass with the most
    significant peak.

    Parameters
    ----------
    search : _Search
        The pair.
    where : Frame
        Prediction of the points of A.
    """
    best: Coarse | None = None
    for width, probes in _PASSES:
        found = _blind(search, where, min(width, search.options.search), probes)
        if found is not None and (best is None or found.significance > best.significance):
            best = found
        if best is not None and best.share >= _CLEAR:
            break
    return best


def _blind(search: _Search, where: Frame, width: float, probes: int) -> Coarse | None:
    """One pass: a peak among the errors across the epipolar lines of some points, if there is one."""
    a, b, options = search.a, search.b, search.options
    chosen = np.linspace(0, len(a) - 1, min(len(a), probes)).astype(np.int64)
    part = where.select(chosen)
    found = search.matcher.match(
        a.select(chosen), b, part, Band(-part.reach - width, part.reach + width, width)
    )
    index = found.index[found.ambiguity <= min(options.ratio, _CLEAR_RATIO)]
    errors = part.errors(index[:, 0], b.xy[index[:, 1]])
    if len(errors) < _LEAST_PEAK:
        return None
    values = np.sort(errors[:, 1])
    count = np.searchsorted(values, values + _PEAK, side="right") - np.arange(len(values))
    start, most = int(count.argmax()), int(count.max())
    middle = float(np.median(values[start : start + most]))
    chance = (len(values) - most) * _PEAK / (2 * width)
    significance = (most - chance) / np.sqrt(chance + 1.0)
    if most < _LEAST_PEAK or significance < _SIGNIFICANT or abs(middle) > width - _PEAK:
        return None
    inside = np.abs(errors[:, 1] - middle) <= _PEAK
    across = robust_affine(a.xy[chosen][index[inside, 0]], errors[inside, 1])
    low, high = np.percentile(errors[inside, 0], [2, 98])
    margin = 0.5 * (high - low) + 10.0
    band = Band(np.full(len(a), low - margin), np.full(len(a), high + margin), options.tolerance)
    return Coarse(across, band, most / len(values), float(significance))


def _local(search: _Search, where: Frame, tight: IntArray) -> tuple[Frame, Band]:
    """Prediction corrected by the matches so far, and for each point a band about its neighbours' places."""
    a, b = search.a, search.b
    errors = where.errors(tight[:, 0], b.xy[tight[:, 1]])
    across = robust_affine(a.xy[tight[:, 0]], errors[:, 1])
    near = cKDTree(a.xy[tight[:, 0]]).query(a.xy, k=min(_NEIGHBOURS, len(tight)))[1]
    along = errors[near, 0]
    middle = np.median(along, axis=1)
    half = 4.0 + 3.0 * 1.4826 * np.median(np.abs(along - middle[:, None]), axis=1)
    width = float(np.clip(4.0 * across.spread, 0.6, search.options.tolerance))
    return where.moved(0.0, across(a.xy)), Band(middle - half, middle + half, width)
