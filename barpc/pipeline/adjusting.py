"""From the views of a run to its tie points and its adjustment."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Literal

import numpy as np

from barpc.ba import Adjustment, BlockPrior, adjust_tracks, consistent_observations, passes_told
from barpc.ba.constraints.ground import DEM_BIAS, KNOWN_BIAS
from barpc.base.errors import BarpcError, DisconnectedError, InputError, TiePointError
from barpc.base.geodesy import ground_from_ecef
from barpc.base.options import AdjustOptions
from barpc.base.tasks import Progress, Work
from barpc.pipeline.calibrations import common_errors, refuse_strange
from barpc.pipeline.control import load_altimetry, load_gcps
from barpc.pipeline.earlier import Earlier, GrowingRun, chosen_pairs, of_new
from barpc.pipeline.exchanged import exchanged_cameras
from barpc.pipeline.inputs import given_matches, given_tracks, read_pairs, reference_names
from barpc.pipeline.outputs import MATCH_FILES
from barpc.pointio.matches import asp_text, write_matches
from barpc.pointio.names import pair_name
from barpc.rasters.dem import Dem
from barpc.report.outcome import MANY_REJECTED, WHOLE_PIXELS, pair_ties
from barpc.scene import BoolArray, Reference, View
from barpc.sensor.centers import CameraCenter, camera_centers
from barpc.tie import Scope, find_tracks, read_area
from barpc.tie.reference import Accuracy, ReferenceControl, register_views
from barpc.workspace import Workspace

logger = logging.getLogger(__name__)


def tied_and_adjusted(run: GrowingRun, dem: Dem | None, workspace: Workspace, work: Work) -> GrowingRun:
    """Return the run with tie points and its adjustment; with tie points alone where it stops after matching."""
    with workspace.stage("tie points"):
        run = with_own_cameras(with_ties(run, work, dem), work, dem)
    if run.options.stop_after == "matching":
        _write_asp_matches(run, workspace)
        return replace(run, kind="match")
    if run.earlier is not None:
        run = _met(run, run.earlier)
    if dem is not None and run.options.reference:
        with workspace.stage("reference"):
            run = replace(run, reference=_register_to_reference(run, dem, work))
    with workspace.stage("adjustment"), _passes(work.progress):
        return _with_adjustment(run, dem)


def with_ties(run: GrowingRun, work: Work, terrain: Dem | None = None) -> GrowingRun:
    """Return the run with tie points: from a file, or matched."""
    views = run.views
    if run.options.matches and run.options.matches_only:
        return replace(run, tracks=given_tracks(run.options.matches, views))
    if len(views) < 2:
        return run
    scope = scope_of(run, terrain)
    if run.options.matches:
        scope = replace(scope, given=given_matches(run.options.matches, views, partly=bool(run.left_out)))
    try:
        ties = find_tracks(views, run.options.tie, scope, executor=work.executor, progress=work.progress)
    except DisconnectedError as error:
        groups = [group for group in error.groups if run.earlier is None or {*group} & {*run.earlier.number}]
        if not run.options.keep_going or not groups or len(groups[0]) < 2:
            raise
        kept = _only(run, frozenset(groups[0]), error.said)
        logger.warning("%d of %d images are tied together and kept", len(kept.views), len(views))
        return with_ties(kept, work, terrain)
    detail = ties.detail if run.earlier is None else ()  # where the earlier run saw more, they lack on purpose
    return replace(run, tracks=ties.tracks, matched=ties.pairs, detail=detail)


def scope_of(run: GrowingRun, terrain: Dem | None) -> Scope:
    """Return the pairs and the area in which tie points are looked for."""
    views, old = run.views, _is_old(run)
    scope = Scope(terrain=terrain, joined=np.flatnonzero(old).tolist())
    if run.options.overlap_list is not None:
        scope = replace(scope, only=read_pairs(run.options.overlap_list, views, [path for path, _ in run.left_out]))
    elif run.earlier is not None:
        scope = replace(scope, only=chosen_pairs(views, old.tolist(), run.options.tie))
    return scope if run.options.aoi is None else replace(scope, area=read_area(run.options.aoi))


def with_own_cameras(run: GrowingRun, work: Work, terrain: Dem | None = None) -> GrowingRun:
    """Return the run; InputError where images fit each other's cameras, or with `keep_going` the run without them."""
    found = exchanged_cameras(run.views, run.tracks)
    if found is None:
        return run
    names = [view.name for view in run.views]
    sentence = found.sentence(names)
    others = frozenset(name for i, name in enumerate(names) if i not in found.views)
    if not run.options.keep_going or len(others) < 2:
        raise InputError(f"{sentence}: give each image its own RPC (IMAGE,camera=FILE)")
    logger.warning("%s: left out", sentence)
    kept = _only(run, others, {names[view]: sentence for view in found.views})
    return with_ties(kept, work, terrain)


def _only(run: GrowingRun, names: frozenset[str], said: Mapping[str, str]) -> GrowingRun:
    """Return the loaded run without the views not tied to the main group."""
    why = "it shares no tie points with the largest group of images"
    dropped = tuple((view.path, said.get(view.name, why)) for view in run.views if view.name not in names)
    kept = [i for i, view in enumerate(run.views) if view.name in names]
    return replace(
        run,
        views=tuple(run.views[i] for i in kept),
        sources=tuple(run.sources[i] for i in kept),
        left_out=(*run.left_out, *dropped),
        adjustment=None,
        reference=None,
    )


def _met(run: GrowingRun, earlier: Earlier) -> GrowingRun:
    """Return the run with the tie points of its new images, and those of the earlier ones that have some.

    The others stay as the earlier run has them, but for what control is given of them.
    """
    old, tracks = _is_old(run), of_new(run.tracks, _is_old(run))
    tied = np.bincount(tracks.view, minlength=len(run.views)) > 0
    leads = {one.lead for one in run.carried}
    keep = ~old | tied | bool(run.options.gcp or run.options.reference) | np.array([v.name in leads for v in run.views])
    if not (old & keep).any():
        raise TiePointError(
            f"no tie point of the images given is seen in one of {earlier.folder}: look at the images (clouds? "
            "dates?), or give matches (--matches)"
        )
    place = np.cumsum(keep) - 1
    kept = [i for i in range(len(keep)) if keep[i]]
    return replace(
        run,
        views=tuple(run.views[i] for i in kept),
        sources=tuple(run.sources[i] for i in kept),
        tracks=replace(tracks, view=place[tracks.view]),
    )


def _is_old(run: GrowingRun) -> BoolArray:
    """Return which views (N,) are images of the earlier run; none without one."""
    known = () if run.earlier is None else run.earlier.number
    return np.array([view.name in known for view in run.views], dtype=bool)


def _register_to_reference(run: GrowingRun, dem: Dem, work: Work) -> ReferenceControl:
    """Register the views, with the cameras as delivered, to the reference."""
    given = run.options.adjust.dem_bias_sigma
    bias = (KNOWN_BIAS if dem.known else DEM_BIAS) if given is None else given
    accuracy = Accuracy(run.options.reference_sigma, run.options.adjust.dem_sigma, bias)
    return register_views(run.views, reference_names(run.options), dem, run.options.tie.band, accuracy, work)


def _with_adjustment(run: GrowingRun, dem: Dem | None) -> GrowingRun:
    """Return the run with an adjustment and its inputs."""
    gcps, checks = (
        load_gcps(paths, run.views, run.options, dem) for paths in (run.options.gcp, run.options.check_points)
    )
    centers = _centers(run.views, run.options.adjust.center)
    if run.reference is not None and run.reference.control is None and not len(run.tracks) and gcps is None:
        raise TiePointError(
            f"{', '.join(run.options.reference)}: the reference {run.reference.refusal}, and nothing else constrains "
            "the images: check its position and the DEM's, or use a finer one"
        )
    altimetry = load_altimetry(run.options.altimetry, run.views, run.options.heights)

    def solved(options: AdjustOptions, prior: BlockPrior | None) -> Adjustment:
        return adjust_tracks(
            run.views,
            replace(run.tracks, xy=run.undistorted(run.tracks.view, run.tracks.xy)),
            options,
            None if gcps is None else replace(gcps, xy=run.undistorted(gcps.view, gcps.xy)),
            dem,
            centers=np.array([center.ecef for center in centers]),
            prior=prior,
            known=None if prior is None else np.ones(len(run.tracks), dtype=bool),  # at best some are new
            reference=_undistorted_reference(run),
            altimetry=altimetry,
            keep_largest=keep_going,
            common=common_errors(run),
        )

    chosen, keep_going = _with_rounding(run, run.options.adjust), run.options.keep_going
    adjustment = solved(chosen, None if run.earlier is None else run.earlier.prior)
    if run.earlier is not None and not run.options.update:
        run, adjustment = _with_earlier_held(run, run.earlier, adjustment, chosen, solved)
    refuse_strange(run, adjustment)
    ground = [ground_from_ecef(adjustment.points)]  # none without tie points
    control = None if run.reference is None else run.reference.control
    ground += [one.lonlatalt for one in (gcps, None if control is None else control.points) if one is not None]
    datums = [] if dem is None else [*dem.datums(np.concatenate(ground))]
    datums += [one for given in (gcps, altimetry) if given is not None for one in given.datums]
    return replace(run, centers=centers, gcps=gcps, check_points=checks, adjustment=adjustment, datums=tuple(datums))


def _with_earlier_held(
    run: GrowingRun,
    earlier: Earlier,
    joint: Adjustment,
    options: AdjustOptions,
    solved: Callable[[AdjustOptions, BlockPrior], Adjustment],
) -> tuple[GrowingRun, Adjustment]:
    """Return the adjustment of new images to the cameras of the earlier run as they are written, and the run with the
    one that moves them all.

    The uncertainty of the scene's place and shape is that of the latter, as cameras that are held are not exact.
    """
    prior, old = earlier.prior, {*earlier.number}
    fixed = tuple(dict.fromkeys((*options.fixed, *(view.name for view in run.views if view.name in old))))
    held = solved(replace(options, fixed=fixed), replace(prior, params=prior.as_written))
    gauge = replace(joint.gauge, shift=held.gauge.shift)
    return replace(run, joint=joint), replace(held, gauge=gauge, datum=joint.datum, covariance=joint.covariance)


def _undistorted_reference(run: GrowingRun) -> Reference | None:
    control = None if run.reference is None else run.reference.control
    if control is None or not run.calibrated:
        return control
    points = control.points
    return replace(control, points=replace(points, xy=run.undistorted(points.view, points.xy)))


def _with_rounding(run: GrowingRun, options: AdjustOptions) -> AdjustOptions:
    """Return the options with the part of errors that does not average away as large as whole pixels leave it."""
    if not run.whole_pixels.issuperset(view.name for view in run.views):
        return options
    return replace(options, noise_floor=max(options.noise_floor, WHOLE_PIXELS))


def _centers(views: Sequence[View], how: Literal["line", "projective"]) -> tuple[CameraCenter, ...]:
    found = camera_centers([v.sensor for v in views], [v.size for v in views], [v.alt_range for v in views], how)
    for view, center in zip(views, found, strict=True):
        if center.method == "nominal":
            logger.warning("%s: its camera determines no projection centre; a nominal one is used", view.name)
    return tuple(found)


@contextmanager
def _passes(progress: Progress | None) -> Iterator[None]:
    """Report the passes of an adjustment: their total, which residuals decide, is 0 until its end."""
    last = 0

    def tell(number: int) -> None:
        nonlocal last
        last = number
        if progress is not None:
            progress("adjustment", number, 0)

    tell(0)
    with passes_told(tell):
        yield
    if progress is not None:
        progress("adjustment", last, last)


def agreeing_observations(run: GrowingRun, options: AdjustOptions) -> BoolArray | None:
    """Return the observations (K,) of a check without those that an adjustment would cut; None for all of them.

    Where it would cut many of an image these are no wrong matches: the cameras disagree.
    """
    if len(run.views) < 2 or not len(run.tracks):
        return None
    try:
        found = consistent_observations(run.views, run.tracks, options)
    except BarpcError:  # too few
        return None
    total, kept = (np.bincount(run.tracks.view, rows, len(run.views)) for rows in (None, found))
    return found if (kept >= (1.0 - MANY_REJECTED) * total).all() else None


def _write_asp_matches(run: GrowingRun, workspace: Workspace) -> None:
    names = [view.name for view in run.views]
    for name in MATCH_FILES:
        with workspace.output(name) as partial:
            write_matches(partial, run.tracks, names)
    for ties in pair_ties(run.tracks):
        i, j = ties.views
        text = asp_text(run.tracks.xy[ties.a], run.tracks.xy[ties.b])
        workspace.write_text(f"asp/{pair_name(names[i], names[j])}.txt", text)
