"""Matching two views along the epipolar segments that their cameras predict.

A blind pass finds how wrong the cameras are relative to each other; a tight pass searches a narrow band
about the corrected segments; a robust affine fit, window by window, throws out what does not lie on them.
The same search on bands that are shifted aside finds only false matches: their number is a control.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from barpc.geodesy import Array
from barpc.scene import BoolArray, IntArray, View
from barpc.sensor import SensorModel
from barpc.tie.epipolar import Affine, Frame, frame, mad, robust_affine
from barpc.tie.features import Keypoints
from barpc.tie.options import TieOptions
from barpc.tie.pairs import Pair

_NEAR = 20.0  # px, the first blind pass
_PEAK = 4.0  # px, width of the window in which true matches of a blind pass fall
_PROBES = 1500  # keypoints of A tried in a blind pass
_WINDOW = 2048.0  # px, side of the windows of the verification
_WINDOW_MATCHES = 60
_MAX_TURN = np.radians(25.0)
_MAX_ZOOM = np.log(1.7)
_APART = 2.0  # px; nearer candidates are the same point


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


@dataclass(frozen=True, eq=False)
class Band:
    """Where the points of A are looked for in B, relative to a `Frame`.

    Parameters
    ----------
    before, after : (N,) or float
        How far along the axis, backwards (negative) and forwards [px].
    across : float
        Half width [px].
    """

    before: Array
    after: Array
    across: float


class Matcher(Protocol):
    """Finds for points of A their best counterparts in B within a band."""

    def match(self, a: Keypoints, b: Keypoints, where: Frame, band: Band) -> tuple[IntArray, Array]:
        """Indices (M, 2) of mutual best matches, and their ambiguity (M,): best over second best distance."""
        ...


class Guided:
    """Mutual best descriptors within the band, cell by cell of A, with like scale and orientation."""

    cell = 128.0

    def match(self, a: Keypoints, b: Keypoints, where: Frame, band: Band) -> tuple[IntArray, Array]:
        """Indices (M, 2) of mutual best matches, and their ambiguity (M,): best over second best distance."""
        turned = where.turn(b.xy)
        strips = _Strips(turned)
        unit_a, unit_b = _unit(a.descriptors), _unit(b.descriptors)
        angle, scale = _expected(a, where.linear)
        best = np.full(len(a), -1)
        top, second = np.full(len(a), -2.0), np.full(len(a), -2.0)
        back, back_top = np.full(len(b), -1), np.full(len(b), -2.0, dtype=np.float32)
        for rows in _cells(where, self.cell):
            lo, hi = where.along[rows] + band.before[rows], where.along[rows] + band.after[rows]
            tilt = np.abs(where.slope[rows]).max() * max(
                np.abs(band.before[rows]).max(), np.abs(band.after[rows]).max()
            )
            w = where.across[rows]
            cols = strips.inside(
                lo.min(), hi.max(), w.min() - band.across - tilt, w.max() + band.across + tilt
            )
            if not len(cols):
                continue
            du = turned[cols, 0] - where.along[rows, None]
            dw = turned[cols, 1] - w[:, None] - where.slope[rows, None] * du
            allowed = (du >= band.before[rows, None]) & (du <= band.after[rows, None])
            allowed &= np.abs(dw) <= band.across
            turn = np.abs((b.angle[cols] - angle[rows, None] + np.pi) % (2 * np.pi) - np.pi)
            allowed &= (turn <= _MAX_TURN) & (np.abs(np.log(b.scale[cols] / scale[rows, None])) <= _MAX_ZOOM)
            likeness = np.where(allowed, unit_a[rows] @ unit_b[cols].T, np.float32(-2.0))
            pick = likeness.argmax(axis=1)
            each = np.arange(len(rows))
            best[rows], top[rows] = cols[pick], likeness[each, pick]
            same = np.abs(turned[cols] - turned[cols[pick]][:, None]).max(axis=2) <= _APART
            second[rows] = np.where(same, np.float32(-2.0), likeness).max(axis=1)
            back_pick = likeness.argmax(axis=0)
            value = likeness[back_pick, np.arange(len(cols))]
            better = value > back_top[cols]
            back[cols[better]], back_top[cols[better]] = rows[back_pick[better]], value[better]
        found = np.flatnonzero(top > -1.0)
        found = found[back[best[found]] == found]
        distance = np.sqrt(np.maximum(2.0 - 2.0 * top[found], 0.0))
        other = np.sqrt(np.maximum(2.0 - 2.0 * second[found], 1e-12))
        return np.stack([found, best[found]], axis=1), distance / np.where(second[found] < -1, 1.0, other)


MATCHERS: dict[str, Callable[[], Matcher]] = {"guided": Guided}
"""Name -> matcher."""


class _Strips:
    """Points of B sorted into strips across the epipolar direction, and along it within a strip."""

    height = 32.0

    def __init__(self, turned: Array) -> None:
        self._first = float(turned[:, 1].min()) if len(turned) else 0.0
        strip = np.floor((turned[:, 1] - self._first) / self.height).astype(np.int64)
        self._order = np.lexsort((turned[:, 0], strip))
        self._along = turned[self._order, 0]
        self._starts = np.searchsorted(strip[self._order], np.arange(strip.max(initial=-1) + 2))

    def inside(self, left: float, right: float, low: float, high: float) -> IntArray:
        """Indices of the points in strips that touch [low, high] across, within [left, right] along."""
        last = len(self._starts) - 2
        strips = range(
            max(0, int((low - self._first) // self.height)),
            min(last, int((high - self._first) // self.height)) + 1,
        )
        parts = []
        for strip in strips:
            start, stop = self._starts[strip], self._starts[strip + 1]
            first, after = np.searchsorted(self._along[start:stop], [left, right])
            parts.append(self._order[start + first : start + after])
        return np.sort(np.concatenate(parts)) if parts else np.empty(0, dtype=np.int64)


def _unit(descriptors: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    values = descriptors.astype(np.float32)
    unit: npt.NDArray[np.float32] = values / np.maximum(
        np.linalg.norm(values, axis=1, keepdims=True), np.float32(1e-6)
    )
    return unit


def _expected(a: Keypoints, linear: Array) -> tuple[Array, Array]:
    """Orientation [rad] and scale [px] that keypoints of A should have in B."""
    turned = np.stack([np.cos(a.angle), np.sin(a.angle)], axis=-1) @ linear.T
    return np.arctan2(turned[:, 1], turned[:, 0]), a.scale * np.sqrt(np.abs(np.linalg.det(linear)))


def _cells(where: Frame, side: float) -> list[IntArray]:
    """Indices of the predicted points of A, cell by cell of B; points without a prediction are left out."""
    usable = np.flatnonzero(np.isfinite(where.along + where.across + where.slope))
    if not len(usable):
        return []
    cell = np.floor(np.stack([where.across[usable], where.along[usable]], axis=1) / side)
    order = np.lexsort((cell[:, 1], cell[:, 0]))
    cuts = np.flatnonzero((np.diff(cell[order], axis=0) != 0).any(axis=1)) + 1
    return np.split(usable[order], cuts)


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
        Search distances, ratio, smallest number of matches.
    sensors : two SensorModel, optional
        Corrected cameras to use instead of the views' own.

    Returns
    -------
    matches : Matches
        None where the pair failed: the report says why.
    report : PairReport
        Counts and measures.
    """
    a, b = keypoints
    cameras = sensors or (views[0].sensor, views[1].sensor)
    names, counts = (views[0].name, views[1].name), (len(a), len(b))
    nothing = Matches(pair.views, np.empty((0, 2), dtype=np.int64), np.empty((0, 2, 2)), np.empty(0))
    failed = PairReport(names, "", counts, angle=pair.angle, overlap=pair.overlap)
    if min(counts) < options.min_matches:
        return nothing, replace(failed, status="too few keypoints")
    alt_range = (
        max(views[0].alt_range[0], views[1].alt_range[0]),
        min(views[0].alt_range[1], views[1].alt_range[1]),
    )
    where = frame(*cameras, a.xy, (min(alt_range), max(alt_range)))
    matcher = MATCHERS[options.matcher]()
    coarse = find_offset(matcher, a, b, where, options)
    if coarse is None:
        return nothing, replace(failed, status=f"no common offset within {options.search:g} px")
    centre, band = coarse
    found, accepted, model = _tight(matcher, a, b, where.moved(0.0, centre(a.xy)), band, options)
    if len(accepted) < options.min_matches:
        return nothing, replace(failed, status="too few matches", matches=len(found), verified=len(accepted))
    aside = where.moved(0.0, centre(a.xy) + 6 * options.tolerance)
    control = _count_within(matcher, a, b, aside, band, options, 3.0 * model.spread)
    errors = where.errors(accepted[:, 0], b.xy[accepted[:, 1]])
    report = replace(
        failed,
        status="ok",
        matches=len(found),
        verified=len(accepted),
        inlier_share=len(accepted) / len(found),
        control_share=control / len(accepted),
        offset=(float(np.median(errors[:, 0])), float(np.median(errors[:, 1]))),
        spread=model.spread,
    )
    xy = np.stack([a.xy[accepted[:, 0]], b.xy[accepted[:, 1]]], axis=1)
    return Matches(pair.views, accepted, xy, np.full(len(accepted), max(model.spread, 0.05))), report


def find_offset(
    matcher: Matcher, a: Keypoints, b: Keypoints, where: Frame, options: TieOptions
) -> tuple[Affine, Band] | None:
    """How wrong the cameras are, from blind passes of growing width; None where none finds a clear peak.

    Parameters
    ----------
    matcher : Matcher
        Finds candidates.
    a, b : Keypoints
        Of the two views.
    where : Frame
        Prediction of the points of `a`.
    options : TieOptions
        `search`, `ratio`, `min_matches`.

    Returns
    -------
    across : Affine
        Error across the epipolar lines as a function of position in A.
    band : Band
        How far along to search, for all points of `a`.
    """
    probes = np.linspace(0, len(a) - 1, min(len(a), _PROBES)).astype(np.int64)
    for width in (_NEAR, options.search):
        chosen = probes if width == _NEAR else np.arange(0, len(a), -(-len(a) // (2 * _PROBES)))
        part = Frame(
            where.axis,
            where.along[chosen],
            where.across[chosen],
            where.slope[chosen],
            where.reach[chosen],
            where.linear,
        )
        band = Band(-part.reach - width, part.reach + width, width)
        found, ambiguity = matcher.match(a.select(chosen), b, part, band)
        found = found[ambiguity <= min(options.ratio, 0.8)]
        errors = part.errors(found[:, 0], b.xy[found[:, 1]])
        peak = _peak(errors[:, 1], width)
        if peak is None:
            continue
        inside = np.abs(errors[:, 1] - peak) <= _PEAK
        across = robust_affine(a.xy[chosen][found[inside, 0]], errors[inside, 1])
        low, high = np.percentile(errors[inside, 0], [2, 98])
        margin = 0.5 * (high - low) + 10.0
        return across, Band(np.full(len(a), low - margin), np.full(len(a), high + margin), options.tolerance)
    return None


def _peak(errors: Array, width: float) -> float | None:
    """Middle of the window that holds far more errors than chance would put there."""
    if len(errors) < 8:
        return None
    values = np.sort(errors)
    count = np.searchsorted(values, values + _PEAK, side="right") - np.arange(len(values))
    start = int(count.argmax())
    middle = float(np.median(values[start : start + count[start]]))
    chance = (len(values) - count[start]) * _PEAK / (2 * width)
    if count[start] < 8 or count[start] < chance + 6 * np.sqrt(chance) + 4 or abs(middle) > width - _PEAK / 2:
        return None
    return middle


def _tight(
    matcher: Matcher, a: Keypoints, b: Keypoints, where: Frame, band: Band, options: TieOptions
) -> tuple[IntArray, IntArray, Affine]:
    """Matches in a narrow band; those that agree with an affine error in their window; the overall fit."""
    found = _distinct(_unambiguous(matcher, a, b, where, band, options), a, b)
    errors = where.errors(found[:, 0], b.xy[found[:, 1]])[:, 1]
    xy = a.xy[found[:, 0]]
    if len(found) < options.min_matches:
        return found, found[:0], robust_affine(np.zeros((1, 2)), np.zeros(1))
    overall = robust_affine(xy, errors)
    keep = np.zeros(len(found), dtype=bool)
    for rows in _windows(xy):
        model = robust_affine(xy[rows], errors[rows]) if len(rows) >= _WINDOW_MATCHES else overall
        residual = errors[rows] - model(xy[rows])
        keep[rows] = np.abs(residual) <= max(3.0 * mad(residual), 0.3)
    kept = robust_affine(xy[keep], errors[keep]) if keep.any() else overall
    return found, found[keep], kept


def _unambiguous(
    matcher: Matcher, a: Keypoints, b: Keypoints, where: Frame, band: Band, options: TieOptions
) -> IntArray:
    found, ambiguity = matcher.match(a, b, where, band)
    return found[ambiguity <= options.ratio]


def _count_within(
    matcher: Matcher, a: Keypoints, b: Keypoints, where: Frame, band: Band, options: TieOptions, limit: float
) -> int:
    """Matches found within `limit` of a band's middle, where none is true."""
    found = _distinct(_unambiguous(matcher, a, b, where, band, options), a, b)
    return int((np.abs(where.errors(found[:, 0], b.xy[found[:, 1]])[:, 1]) <= limit).sum())


def _distinct(found: IntArray, a: Keypoints, b: Keypoints) -> IntArray:
    """One match for keypoints at the same place that differ in orientation only."""
    key = np.rint(np.concatenate([a.xy[found[:, 0]], b.xy[found[:, 1]]], axis=1))
    _, first = np.unique(key, axis=0, return_index=True)
    return found[np.sort(first)]


def _windows(xy: Array) -> list[IntArray]:
    """Indices of points, window by window."""
    cell = np.floor(xy / _WINDOW)
    order = np.lexsort((cell[:, 0], cell[:, 1]))
    cuts = np.flatnonzero((np.diff(cell[order], axis=0) != 0).any(axis=1)) + 1
    return np.split(order, cuts)
