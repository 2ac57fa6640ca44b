"""The pairs of a run, measured: their geometry, and the distance of their matches from the epipolar lines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np

from barpc.base.geodesy import CHUNK, Array, ground_from_ecef
from barpc.base.statistics import MAD
from barpc.report.outcome import PairTies, Run, pair_ties
from barpc.report.records import json_form
from barpc.report.summary.pairs import OffsetEntry, PairEntry
from barpc.report.summary.words import medians
from barpc.scene import IntArray
from barpc.sensor import SensorModel
from barpc.sensor.geometry import Several, base_to_height, convergence_angle, ground_sample_distance
from barpc.sensor.triangulation import epipolar_offset

MAX_PER_PAIR = 1000  # Matches of a pair that its epipolar offset is measured on, evenly taken

_PAIR_REPORT_FIELDS = attrgetter("means", "control_share", "spread", "beaten", "reason")


def measure_pairs(run: Run) -> tuple[PairEntry, ...]:
    """Return the record of every pair of images with common tie points."""
    reports = {report.names: report for report in run.matched}
    none: _OffsetEntries = [None] * len(run.pairs)
    before, _ = _pair_offsets(run, run.before, ground_from_ecef(run.ties_before.points)[:, 2])
    after, kept = (none, none) if run.after is None else _pair_offsets(run, run.after, run.ground[:, 2])
    entries = []
    offsets = zip(before, after, kept, strict=True)
    for ties, (angle, base, height), (first, last, used) in zip(run.pairs, _pair_geometry(run), offsets, strict=True):
        names = (run.views[ties.views[0]].name, run.views[ties.views[1]].name)
        report = reports.get(names)
        told = () if report is None else _PAIR_REPORT_FIELDS(report)
        measured = PairEntry(*names, len(ties.a), angle, base, height, first, last, json_form(report), *told)
        entries.append(replace(measured, epipolar_kept=used))
    return tuple(entries)


def _pair_geometry(run: Run) -> list[list[float]]:
    """Return the medians over a hundred points of each pair: angle [deg], B/H, height per pixel [m]."""
    picks = [slice(None, None, max(1, len(ties.a) // 100)) for ties in run.pairs]
    a, b, pair = _picked_matches(run.pairs, picks)
    seen = np.isfinite(run.ground[run.tracks.point[a]]).all(axis=1)
    a, b, pair = a[seen], b[seen], pair[seen]
    values = np.empty((3, len(a)))
    for part, first, second in _match_parts(run, run.before, a, b):
        at = run.ground[run.tracks.point[a[part]]]
        base = base_to_height(first, second, at)
        finer = np.minimum(ground_sample_distance(first, at)[1], ground_sample_distance(second, at)[1])
        with np.errstate(divide="ignore"):
            values[:, part] = convergence_angle(first, second, at), base, finer / base
    found = np.array([medians(value, pair, len(run.pairs)) for value in values]).T
    return [list(row) for row in found.tolist()]


_OffsetEntries = list[OffsetEntry | None]


def _pair_offsets(run: Run, sensors: Sequence[SensorModel], alt: Array) -> tuple[_OffsetEntries, _OffsetEntries]:
    """Return the epipolar offsets of each pair's verified matches, and of those of them that are in use.

    The altitudes (P,) [m] of the tracks through these cameras are near the closest approach of a pair's rays: two steps
    from there converge. Tracks without one, of which nothing is in use, start from that of the scene.
    """
    of_all = {ties.views: ties for ties in pair_ties(run.tracks)}
    every = [of_all[ties.views] for ties in run.pairs]
    picks = [_shown_tracks(len(ties.a)) for ties in every]
    a, b, pair = _picked_matches(every, picks)
    height = np.where(np.isfinite(alt), alt, run.altitude)[run.tracks.point[a]]
    offset, xy = np.empty(len(a)), run.tracks.xy
    for part, first, second in _match_parts(run, sensors, a, b):
        offset[part], _ = epipolar_offset(first, second, xy[a[part]], xy[b[part]], height[part])
    used, num = run.keep[a] & run.keep[b], len(every)
    return _offset_entries(offset, pair, num), _offset_entries(offset[used], pair[used], num)


def _shown_tracks(count: int) -> slice | IntArray:
    return slice(count) if count <= MAX_PER_PAIR else np.linspace(0, count - 1, MAX_PER_PAIR).astype(np.int64)


def _offset_entries(offset: Array, pair: IntArray, num: int) -> _OffsetEntries:
    """Return the records of offsets (n,) of pairs (n,), of `num` pairs in all."""
    known = np.isfinite(offset)
    offset, pair = offset[known], pair[known]
    center = medians(offset, pair, num)
    spread = MAD * medians(np.abs(offset - center[pair]), pair, num)
    count, square = np.bincount(pair, minlength=num), np.bincount(pair, offset**2, minlength=num)
    rms = np.sqrt(square / np.maximum(count, 1))
    rows = zip(center.tolist(), spread.tolist(), rms.tolist(), count.tolist(), strict=True)
    return [OffsetEntry(*row) if row[3] else None for row in rows]


def _match_parts(
    run: Run, sensors: Sequence[SensorModel], a: IntArray, b: IntArray
) -> Iterator[tuple[slice, Several, Several]]:
    """Yield pieces of matches that stay in cache, and the cameras of their observations a and b."""
    for start in range(0, len(a), CHUNK):
        part = slice(start, start + CHUNK)
        yield part, Several(sensors, run.tracks.view[a[part]]), Several(sensors, run.tracks.view[b[part]])


def _picked_matches(
    pairs: Sequence[PairTies], picks: Sequence[slice | IntArray]
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the selected matches of all pairs: their observations in both views, and the index of their pair."""
    none = np.empty(0, dtype=np.int64)
    a, b = ([getattr(t, of)[pick] for t, pick in zip(pairs, picks, strict=True)] for of in ("a", "b"))
    pair = np.repeat(np.arange(len(a)), [len(rows) for rows in a])
    return np.concatenate([none, *a]), np.concatenate([none, *b]), pair
