"""Every observation of a track is registered to one reference patch, and verified.

The reference is the patch around the keypoint in the view most like the others, and defines the point exactly: errors
do not chain from view to view.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from barpc.base.geodesy import Array
from barpc.base.options import TieOptions
from barpc.base.statistics import FEW, kd_tree, robust_spread
from barpc.base.tasks import HERE, Work
from barpc.scene import BoolArray, IntArray, Tracks, View, row_pairs
from barpc.tie.pairing.epipolar import LEAST_REACH, LEAST_SIGMA, SIGMA, coherent, epipolar_segments, grouped, linear_map
from barpc.tie.patches.register import PatchRegistration, PatchSearch, register_parts, task_parts
from barpc.tie.pixels import SPAN

_DISTORTED = 2.0  # times the median sigma about it: the patch lies across a step of the ground


def refine(
    views: Sequence[View],
    tracks: Tracks,
    spreads: Mapping[tuple[int, int], float],
    options: TieOptions,
    *,
    structural: Collection[tuple[int, int]] = (),
    work: Work = HERE,
) -> Tracks:
    """Register every observation to its track's reference patch, and verify the result.

    Views of `structural` pairs are compared on channels of oriented gradients, all others on grey values.

    `spreads`, `PairReport.spread` of the pairs of views, tell which view of a track makes the best reference. Its
    observation is given at a whole pixel, the others as registered, without those that do not correlate. Each carries
    half the variance of its registration.
    """
    if not len(tracks):
        return tracks
    # channels register less exactly: what compares by grey values is the better reference
    exact = {ends: spread + SIGMA * (ends in structural) for ends, spread in spreads.items()}
    of_track = references(tracks, exact, len(views))
    other = np.flatnonzero(np.arange(len(tracks)) != of_track[tracks.point])
    links = _Registrations(views, tracks, of_track[tracks.point[other]], other, frozenset(structural))
    found = links.register(options.band, options.tile, work)
    each = grouped(tracks.view[links.reference[found.ok]])
    each = [np.flatnonzero(found.ok)[group] for group in each]
    told = work.ordered(verify_links, [(links.part(rows), found.select(rows)) for rows in each], "refine")
    good, sigma = np.zeros(len(links), dtype=bool), found.sigma.copy()
    for rows, (verified, scaled) in zip(each, told, strict=True):
        good[rows], sigma[rows] = verified, scaled
    return _shared_variance(tracks, of_track, other[good], found.xy[good], sigma[good])


def verify_links(links: _Registrations, found: PatchRegistration) -> tuple[BoolArray, Array]:
    """Return which registered links of a view are verified, and the sigmas [px] of these."""
    good, across = links.verified(found, found.ok)
    return good, links.scaled(found, good, across)


@dataclass(frozen=True, eq=False)
class _Registrations:
    """Observations that are registered (`other`), each with the reference of its track; rows of `tracks`."""

    views: Sequence[View]
    tracks: Tracks
    reference: IntArray
    other: IntArray
    structural: Collection[tuple[int, int]] = ()

    def __len__(self) -> int:
        return len(self.other)

    def part(self, links: IntArray) -> _Registrations:
        """Return some links, with no other views and tracks than theirs."""
        rows, where = np.unique([self.reference[links], self.other[links]], return_inverse=True)
        views, view = np.unique(self.tracks.view[rows], return_inverse=True)
        point = np.unique(self.tracks.point[rows], return_inverse=True)[1]
        tracks = Tracks(view, point, self.tracks.xy[rows], self.tracks.sigma[rows])
        return _Registrations([self.views[v] for v in views], tracks, *where.reshape(2, -1))

    @cached_property
    def origin(self) -> Array:
        """Whole pixels at which the reference patches stand."""
        return np.rint(self.tracks.xy[self.reference])

    def of(self, part: IntArray) -> tuple[View, View]:
        """Return the two views of links that have them in common."""
        ends = self.reference[part[0]], self.other[part[0]]
        return self.views[self.tracks.view[ends[0]]], self.views[self.tracks.view[ends[1]]]

    def groups(self, *more: IntArray) -> list[IntArray]:
        """Return the indices of the links between the same two views, and of equal values of `more`."""
        return grouped(self.tracks.view[self.reference], self.tracks.view[self.other], *more)

    def register(self, band: int, tile: int, work: Work) -> PatchRegistration:
        """Register all, tile by tile of the reference view."""
        origin = self.origin
        linear = np.empty((len(self), 2, 2))
        for group in self.groups():
            linear[group] = linear_map(*self.of(group), origin[group])
        rounding = (origin - self.tracks.xy[self.reference])[:, :, None]
        start = self.tracks.xy[self.other] + (linear @ rounding)[:, :, 0]
        parts = [part for group in self.groups() for part in task_parts(origin[group], group, tile)]
        tasks, rows, before = list[list[PatchSearch]](), list[list[IntArray]](), -1
        for part in parts:
            first, second = self.of(part)
            images = ((first.path, first.size), (second.path, second.size))
            places = origin[part], start[part], linear[part]
            ends = [int(self.tracks.view[row[part[0]]]) for row in (self.reference, self.other)]
            if ends[0] != before or sum(map(len, rows[-1])) + len(part) > SPAN:  # small ones of a view share a task
                tasks.append([])
                rows.append([])
            before = ends[0]
            tasks[-1].append((images, *places, tuple(sorted(ends)) in self.structural))
            rows[-1].append(part)
        done: list[PatchRegistration] = work.ordered(register_parts, [(task, band) for task in tasks], "refine")
        found = PatchRegistration.none(start)
        for some, one in zip(rows, done, strict=True):
            found.put(np.concatenate(some), one)
        return found

    def verified(self, found: PatchRegistration, good: BoolArray) -> tuple[BoolArray, Array]:
        """Return the mask of observations as certain as their neighbours and at one altitude with their track.

        And their distances (M,) [px] across epipolar lines.

        Those off their epipolar line stay: whether the match or the camera is wrong, the adjustment judges, and what it
        holds out is not to agree by selection.
        """
        verified = np.zeros(len(self), dtype=bool)
        altitude, reach, across = np.zeros((3, len(self)))  # from the middle of the range, in its halves
        for group in self.groups():
            group = group[good[group]]
            if len(group):
                usual = _usual(self.origin[group], found.sigma[group])
                group = group[found.sigma[group] <= _DISTORTED * usual]
                verified[group] = True
                where = epipolar_segments(*self.of(group), self.origin[group])
                along, across[group] = where.errors(found.xy[group]).T
                reach[group] = where.after
                altitude[group] = along / np.maximum(where.after, 1e-9)
        return verified & ~self._torn(verified, altitude, reach), across

    def _torn(self, good: BoolArray, altitude: Array, reach: Array) -> BoolArray:
        """Return the links that disagree in altitude with all neighbours in the track, up to an affine function."""
        rows = np.flatnonzero(good & (reach >= LEAST_REACH))
        first, second = rows[:-1], rows[1:]
        same = self.reference[first] == self.reference[second]
        first, second = first[same], second[same]
        apart = (altitude[first] - altitude[second]) * np.minimum(reach[first], reach[second])
        compared, agreed = np.zeros((2, len(self)), dtype=bool)
        views = self.tracks.view
        three = views[self.reference[first]], views[self.other[first]], views[self.other[second]]
        for group in grouped(*three):
            agree = coherent(self.origin[first[group]], apart[group])[0]
            for end in (first[group], second[group]):
                compared[end] = True
                agreed[end[agree]] = True
        return compared & ~agreed

    def scaled(self, found: PatchRegistration, good: BoolArray, across: Array) -> Array:
        """Return the sigmas [px] made larger where the distances `across` epipolar lines are."""
        sigma = found.sigma.copy()
        for group in self.groups():
            group = group[good[group]]
            if len(group) >= FEW:
                residual = coherent(self.origin[group], across[group])[1]
                sigma[group] *= max(1.0, robust_spread(residual / sigma[group]))
        return sigma


def _usual(places: Array, sigma: Array) -> Array:
    """Return the median of the sigmas (N,) of the nearest places (N, 2)."""
    near = kd_tree(places).query(places, k=min(FEW, len(places)))[1]
    return np.asarray(np.median(sigma[near.reshape(len(places), -1)], axis=1))


def _shared_variance(tracks: Tracks, of_track: IntArray, rows: IntArray, xy: Array, sigma: Array) -> Tracks:
    """Return the registered rows and their references; the variance of a registration is shared by both its ends."""
    points = tracks.point[rows]
    count = np.bincount(points, minlength=tracks.num_points)
    variance = np.zeros(len(tracks))
    variance[rows] = 0.5 * sigma**2
    variance[of_track] = np.bincount(points, weights=variance[rows], minlength=tracks.num_points)
    variance[of_track] /= np.maximum(count, 1)
    placed, keep = np.rint(tracks.xy), np.zeros(len(tracks), dtype=bool)
    placed[rows], keep[rows] = xy, True
    keep[of_track] = count > 0
    return Tracks(tracks.view, tracks.point, placed, np.sqrt(variance).clip(LEAST_SIGMA)).select(keep)


def references(tracks: Tracks, spreads: Mapping[tuple[int, int], float], num_views: int) -> IntArray:
    """Return the row of the reference observation of every track (P,): that of the view most like the others.

    That is where the pairs' spread across the epipolar line [px] is least: it grows with the angle between two views
    and with all else that makes them look different.
    """
    key = np.array([min(pair) * num_views + max(pair) for pair in spreads] or [-1], dtype=np.int64)
    spread = np.array(list(spreads.values()) or [0.0])[np.argsort(key)]
    key = np.sort(key)
    first, second = row_pairs(tracks.point)
    wanted = tracks.view[first] * num_views + tracks.view[second]
    place = np.searchsorted(key, wanted).clip(0, len(key) - 1)
    unlike = np.where(key[place] == wanted, spread[place], 2.0 * spread.max())
    cost = np.bincount(np.append(first, second), weights=np.append(unlike, unlike), minlength=len(tracks))
    order = np.lexsort((cost, tracks.point))
    return order[np.searchsorted(tracks.point, np.arange(tracks.num_points))]
