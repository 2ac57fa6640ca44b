"""The stages in a row: images to tracks."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from barpc.errors import TiePointError
from barpc.geodesy import ground_from_ecef
from barpc.options import TieOptions
from barpc.scene import Tracks, View, middle_altitude
from barpc.sensor.geometry import triangulate
from barpc.tie.area import Area
from barpc.tie.features import Keypoints, bounded, detect_tile, join
from barpc.tie.matcher import Matches
from barpc.tie.matching import MATCHERS, PairReport, match_pair
from barpc.tie.pairs import Pair, require_connected, select_pairs, shared_tiles
from barpc.tie.raster import sample_stretch, tiles
from barpc.tie.tasks import Progress, ordered
from barpc.tie.tracks import link, refine, thin

_DEFAULTS = TieOptions()
_SPARE = 1.3  # tracks registered for each one kept


@dataclass(frozen=True, eq=False)
class TieResult:
    """Tie points, and how they came about.

    Parameters
    ----------
    tracks : Tracks
        The tie points.
    pairs : tuple of PairReport
        One a pair that was tried.
    keypoints : tuple of int
        Keypoints of each view.
    """

    tracks: Tracks
    pairs: tuple[PairReport, ...]
    keypoints: tuple[int, ...]


def detect(
    views: Sequence[View],
    options: TieOptions = _DEFAULTS,
    *,
    pairs: Sequence[Pair] | None = None,
    area: Area | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> list[Keypoints]:
    """Keypoints of every view.

    Parameters
    ----------
    views : sequence of View
        The images.
    options : TieOptions
        Band, tiles, quotas.
    pairs : sequence of Pair, optional
        As `select_pairs` gave them: tiles that no partner may see are not read. None: all are.
    area : Area, optional
        Together with `pairs`: tiles outside are not read either.
    executor, progress : optional
        Who does the work, and who hears how far it is: see `ordered`. The result does not depend on them.

    Returns
    -------
    keypoints : list of Keypoints
        One a view; none in an image in which nothing varies.
    """
    stretches = ordered(executor, sample_stretch, [(v.path, options.band) for v in views], "read", progress)
    boxes = [tiles(view.size, options) for view in views]
    if pairs is not None:
        boxes = shared_tiles(views, pairs, options, area)
    owners, tasks = [], []
    for owner, (view, stretch) in enumerate(zip(views, stretches, strict=True)):
        of_view = boxes[owner] if stretch is not None else []
        owners += [owner] * len(of_view)
        tasks += [(view.path, view.size, box, stretch, options) for box in of_view]
    found = ordered(executor, detect_tile, tasks, "detect", progress)
    parts: list[list[Keypoints]] = [[] for _ in views]
    for owner, part in zip(owners, found, strict=True):
        parts[owner].append(part)
    return [bounded(join(part), options) for part in parts]


def match(
    views: Sequence[View],
    keypoints: Sequence[Keypoints],
    pairs: Sequence[Pair],
    options: TieOptions = _DEFAULTS,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> list[tuple[Matches, PairReport]]:
    """Matches of every pair, each with its report: `match_pair` over all pairs."""
    tasks = []
    for pair in pairs:
        i, j = pair.views
        tasks.append(((views[i], views[j]), (keypoints[i], keypoints[j]), pair, options))
    return ordered(executor, match_pair, tasks, "match", progress)


def find_tracks(
    views: Sequence[View],
    options: TieOptions = _DEFAULTS,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
    only: Sequence[tuple[int, int]] = (),
    area: Area | None = None,
) -> TieResult:
    """Find the tie points of overlapping images.

    Parameters
    ----------
    views : sequence of View
        At least two; in a second pass with their corrected cameras, `replace(view, sensor=...)`.
    options : TieOptions
        How.
    executor, progress : optional
        Who does the work, and who hears how far it is: see `ordered`. The result does not depend on them.
    only : sequence of (int, int)
        Match these pairs and no others.
    area : Area, optional
        Tie points only here, as the cameras see it; None: everywhere.

    Returns
    -------
    result : TieResult
        Tracks and reports.

    Raises
    ------
    TiePointError
        Fewer than two images, or two that do not match.
    DisconnectedError
        The images fall into groups that share no tie points.
    ImageError
        An image cannot be read.
    """
    pairs = select_pairs(views, options, only=only, area=area)
    keypoints = [join([])] * len(views)
    if MATCHERS[options.matcher].detects:
        keypoints = detect(views, options, pairs=pairs, area=area, executor=executor, progress=progress)
    matched = match(views, keypoints, pairs, options, executor=executor, progress=progress)
    found, reports = [matches for matches, _ in matched], tuple(report for _, report in matched)
    require_matches(views, pairs, reports)
    sizes, most = [view.size for view in views], options.points_per_image
    linked = inside(views, link([pair.views for pair in pairs], found), area)
    spreads = {p.views: r.spread for p, r in zip(pairs, reports, strict=True) if r.status == "ok"}
    linked = thin(linked, sizes, int(_SPARE * most))
    tracks = refine(views, linked, spreads, options, executor=executor, progress=progress)
    tracks = thin(inside(views, tracks, area), sizes, most)
    require_tracks(views, tracks, pairs, reports, options)
    return TieResult(tracks, reports, tuple(len(k) for k in keypoints))


def inside(views: Sequence[View], tracks: Tracks, area: Area | None) -> Tracks:
    """The tracks whose ground points lie in an area, all without one; TiePointError where none does."""
    if area is None or not len(tracks):
        return tracks
    cameras = [view.sensor for view in views]
    points = triangulate(cameras, tracks.view, tracks.point, tracks.xy, alt=middle_altitude(views)).points
    ground = ground_from_ecef(points)
    kept = area.contains(ground[:, :2])
    if not kept.any():
        raise TiePointError(f"none of {len(kept)} tie points lies in the area of interest: enlarge it")
    return tracks.select(kept[tracks.point])


def require_matches(views: Sequence[View], pairs: Sequence[Pair], reports: Sequence[PairReport]) -> None:
    """Raise TiePointError where two views do not match, DisconnectedError where more fall into groups."""
    failed = [report for report in reports if report.status != "ok"]
    told = "; ".join(
        f"{r.names[0]} - {r.names[1]}: {r.status} ({r.keypoints[0]} and {r.keypoints[1]} keypoints, "
        f"{r.verified} of {r.matches} matches verified)"
        for r in failed[:4]
    )
    bare = [r for r in failed if r.status == "too few keypoints"]
    blank = sorted({name for r in bare for name, n in zip(r.names, r.keypoints, strict=True) if not n})
    advice = "look at the images (clouds? dates? band?), or loosen ratio, search or min_matches"
    if blank:
        names = ", ".join(blank[:4])
        advice = f"no detail in {names} (one value? no valid pixels? clouds?): look at the images"
    if len(views) == 2 and failed:
        raise TiePointError(f"too few tie points: {told}: {advice}")
    links = [pair.views for pair, report in zip(pairs, reports, strict=True) if report.status == "ok"]
    require_connected(views, links, f"no tie points between them: {told}: {advice}")


def require_tracks(
    views: Sequence[View],
    tracks: Tracks,
    pairs: Sequence[Pair],
    reports: Sequence[PairReport],
    options: TieOptions,
) -> None:
    """As `require_matches`, for the pairs that `min_matches` tracks or more are left of."""
    left = []
    for pair, report in zip(pairs, reports, strict=True):
        common = len(np.intersect1d(*(tracks.point[tracks.view == view] for view in pair.views)))
        status = "ok" if common >= options.min_matches else f"only {common} tracks after registration"
        left.append(replace(report, status=status if report.status == "ok" else report.status))
    require_matches(views, pairs, left)
