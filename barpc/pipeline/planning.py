"""The plan of a run: pairs, time, memory, the datum assumed, doubts on its input."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barpc.base.geodesy import DEFAULT, HeightDatum
from barpc.base.options import RunOptions
from barpc.pipeline.control import load_altimetry, load_gcps
from barpc.rasters.dem import Dem
from barpc.report import Run
from barpc.scene import GroundPoints
from barpc.tie.matchers import features
from barpc.tie.pairing.overlaps import Pair

_START_SECONDS, _VIEW_SECONDS, _MEGAPIXEL_SECONDS, _PAIR_SECONDS, _PAIR_MEGAPIXEL_SECONDS = 1.5, 0.15, 0.9, 0.1, 0.4
"""CPU seconds on a slow core: of a run; a view; a megapixel of it (keypoints); a pair; a megapixel of its smaller one.

Measured, and by these: a pair and triplet of 1.0 Mpx 5.0 (4.2) and 5.6 (6.2), a real triplet of 0.54 Mpx 4.2 (4.4), a
pair of 0.25 Mpx 1.8 (2.5). On a core 2.5 times as fast 1000 small views took 60 (60), and a pair of them 0.04 (0.04).
"""
_FASTER = 2.5  # times a slow core: what is said is from such a fast one to a slow one
_DENSITY = 5500.0  # keypoints of a megapixel; beyond `features.PER_IMAGE` of them a larger image costs a pair no more
_PROCESS_MB, _VIEW_MB = 350.0, 0.5
"""Of a process: a run of three views has 335 to 385, two views of 400 Mpx on five processes 338 each; of 10,000 views
5,100 in one."""


@dataclass(frozen=True)
class Plan:
    """The plan of `barpc.adjust`; nothing was matched or written.

    Parameters
    ----------
    views : tuple of str, names of the images that can be used
    pairs : tuple of (str, str, float, float), pairs to match first: both names, share of the smaller footprint that
        they have in common, convergence angle [deg]; where too few of them match others follow
    cpu_seconds : (float, float), on a fast core and on a slow one, whatever the number of processes
    memory_mb : float, of all processes on this machine
    datum : tuple of str, what the scene's position and heights count from, in sentences
    doubts : tuple of str, reservations about the input, in sentences; empty without any

    Examples
    --------
    >>> found = barpc.plan("data_samples/*.tif")
    >>> found.pairs[0][:2], len(found.pairs), found.doubts
    (('view_00', 'view_01'), 3, ())
    """

    views: tuple[str, ...]
    pairs: tuple[tuple[str, str, float, float], ...]
    cpu_seconds: tuple[float, float]
    memory_mb: float
    datum: tuple[str, ...]
    doubts: tuple[str, ...]


def planned(run: Run, options: RunOptions, dem: Dem | None, pairs: Sequence[Pair], processes: int) -> Plan:
    """Return the plan of a run whose views are loaded, and whose pairs are chosen."""
    names, size = [view.name for view in run.views], np.array([view.size for view in run.views])
    area, most = size.prod(axis=1) / 1e6, features.PER_IMAGE / _DENSITY
    matched = sum(float(np.minimum(area[list(pair.views)].min(), most)) for pair in pairs)
    slow = _START_SECONDS + _VIEW_SECONDS * len(names)
    if pairs:
        slow += _MEGAPIXEL_SECONDS * float(area.sum()) + _PAIR_SECONDS * len(pairs) + _PAIR_MEGAPIXEL_SECONDS * matched
    points = [load_gcps(paths, run.views, options, dem) for paths in (options.gcp, options.check_points)]
    return Plan(
        tuple(names),
        tuple((names[p.views[0]], names[p.views[1]], p.overlap, p.angle) for p in pairs),
        (slow / _FASTER, slow),
        _PROCESS_MB * processes + _VIEW_MB * len(names),
        tuple(_datum_lines(run, options, dem, points[0])),
        tuple(_doubt_lines(run, points)),
    )


def _datum_lines(run: Run, options: RunOptions, dem: Dem | None, gcps: GroundPoints | None) -> Iterator[str]:
    """Yield the constraints on the scene's position, and the datums assumed for heights, in sentences."""
    if not (options.gcp or options.reference or options.add_to):
        holds = "the cameras as delivered" + (" and the DEM" if dem is not None else "")
        yield f"The scene's position is that of {holds}: no ground control."
    found = list[HeightDatum]()
    for given in (gcps, load_altimetry(options.altimetry, run.views, options.heights)):
        found += [] if given is None else given.datums
    if dem is not None:
        places = [view.sensor.localize((np.array(view.size) - 1) / 2, np.array(view.altitude)) for view in run.views]
        found += dem.datums(np.array(places))
    for one in found:
        how = "not stated, assumed" if one.provenance == DEFAULT else one.provenance
        kinds = ("above sea level", "ellipsoidal")[:: 1 if one.converted else -1]
        off = f"{abs(one.otherwise):.1f} m {'higher' if one.otherwise > 0 else 'lower'}"
        yield f"Heights of {one.name} are taken as {kinds[0]} ({how}); if they are {kinds[1]}, they lie {off}."
    if options.geoid or options.heights:
        given_datum = Path(options.geoid or options.heights or "").name
        yield f"Heights without a datum of their own count from {given_datum}, as given."


def _doubt_lines(run: Run, points: Iterable[GroundPoints | None]) -> Iterator[str]:
    """Yield the doubts on images, cameras and ground points, in sentences."""
    yield from (line for given in points if given is not None for line in given.left_out)
    for view, source in zip(run.views, run.sources, strict=True):
        yield from (f"{view.name}: {doubt.sentence}" for doubt in source.doubts)
    for path, reason in run.left_out:
        yield reason if reason.startswith(path) else f"{path}: {reason}"
    for band in run.carried:
        yield f"{band.view.name}: a band of {band.lead}, whose correction it gets"
