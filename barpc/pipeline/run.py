"""`adjust` and `check`: the stages in a row."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np

from barpc.ba import Adjustment, BlockPrior, adjust_tracks, block_prior, consistent_observations, passes_told
from barpc.ba.constraints.ground import DEM_BIAS, KNOWN_BIAS
from barpc.base.blas import one_blas_thread
from barpc.base.errors import BarpcError, BarpcWarning, DisconnectedError, FitError, InputError, TiePointError
from barpc.base.geodesy import feature_collection, ground_from_ecef
from barpc.base.identity import Input, Stamp, ask, guarded, recorded
from barpc.base.options import AdjustOptions, FitOptions, RunOptions, file_options
from barpc.base.remote import here
from barpc.base.safe_io import plain_path
from barpc.base.sealed import portable
from barpc.base.tasks import Progress, Work
from barpc.fit import RpcFit, fit_rpc
from barpc.fit.refit import innermost
from barpc.pipeline.acquisitions import one_each
from barpc.pipeline.calibrate import calibrated, calibrations_of, common_errors, refuse_strange
from barpc.pipeline.earlier import Earlier, added, chosen_pairs, images_table, join_earlier, movers, of_new
from barpc.pipeline.exchanged import exchanged_cameras
from barpc.pipeline.executor import CachingExecutor, by_groups
from barpc.pipeline.grid_outputs import write_grids
from barpc.pipeline.inputs import (
    given_matches,
    given_tracks,
    hash_inputs,
    input_files,
    load_altimetry,
    load_gcps,
    read_pairs,
    reference_names,
    side_inputs,
    with_located,
)
from barpc.pipeline.loading import Image, image_path, load_views
from barpc.pipeline.outputs import MATCH_FILES, output_names, refuse_shadows, write_tables, write_views
from barpc.pipeline.pictures import write_pictures
from barpc.pipeline.planning import Plan, planned
from barpc.pipeline.results import RunResult
from barpc.pipeline.verify_outputs import unverified
from barpc.pointio.matches import asp_text, write_matches
from barpc.pointio.names import pair_name, require_pair_names
from barpc.rasters.dem import Dem
from barpc.report import Run, Summary, summarize
from barpc.report.outcome import MANY_REJECTED, WHOLE_PIXELS, pair_ties
from barpc.report.page import REPORT_STAGE
from barpc.report.runfiles import FOLDER, IMAGES, PRIOR_FILE
from barpc.report.summary import InputEntry, StageEntry
from barpc.report.tables import outline_features
from barpc.rpcio import local_image
from barpc.scene import BoolArray, Reference, Tracks, View
from barpc.sensor import SensorModel
from barpc.sensor.geometry import CameraCenter, camera_centers
from barpc.sensor.rpc import RPC
from barpc.tie import Scope, find_tracks, read_area
from barpc.tie.pairing.overlaps import Pair, best_pairs, possible_pairs
from barpc.tie.reference import Accuracy, ReferenceControl, register_views
from barpc.workspace import Workspace, timed

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, repr=False)
class AdjustResult(RunResult):
    """The result of a run.

    Parameters
    ----------
    views : tuple of View, the images used, in the order given; after an adjustment with their refitted RPCs as sensors
    run : Run
        All intermediate results. Here and in `tracks`, `adjustment`, `summary` and files images stand in the
        order of their names, `run.views`, whatever the order given.
    record : Summary, content of summary.json as a typed record
    root : str, the SHA-256 of SHA256SUMS, by which `barpc verify` knows the run; empty where nothing was written

    Examples
    --------
    >>> found = barpc.check("data_samples/view_0[01].tif", points_per_image=300)
    >>> found.run.kind, [view.name for view in found.views]
    ('check', ['view_00', 'view_01'])
    """

    views: tuple[View, ...]
    run: Run
    record: Summary
    root: str = ""

    @property
    def adjustment(self) -> Adjustment:
        """The adjustment itself; its views are `run.views`."""
        assert self.run.adjustment is not None
        return self.run.adjustment

    @property
    def tracks(self) -> Tracks:
        """The tie points; `Tracks.view` counts `run.views`."""
        return self.run.tracks

    def to_geojson(self) -> dict[str, Any]:
        """Return the outlines of the images with their figures, as GeoJSON."""
        return feature_collection(outline_features(self.run, self.record))


@one_blas_thread()
def adjust(
    images: Sequence[Image],
    out_dir: str | Path,
    options: RunOptions | None = None,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> AdjustResult:
    """Correct the cameras of overlapping images, paths or Views, and write fresh RPCs: see `barpc.adjust`."""
    options, folder = with_located(options or RunOptions()), Path(out_dir)
    plain_path(folder.absolute())
    stages, seen, work = list[dict[str, Any]](), dict[str, Stamp](), Work(executor, progress)
    with timed("inputs", stages) as workers:
        with recorded(seen):
            run = _with_views("adjust", images, options, work, workers)
        names, keep = _planned_files(run, options, folder)
        workspace = Workspace(out_dir, overwrite=options.overwrite, keep=keep, names=names)
    with workspace:
        workspace.stages += stages
        with workspace.stage("fingerprints"), recorded(seen):
            given = side_inputs(options, run.views)
            inputs = hash_inputs(run, options, seen, executor, progress)
            if run.earlier is not None:
                run.earlier.refuse_changed(run, inputs)
        with CachingExecutor(workspace, inputs, executor) as caching:
            with guarded(inputs.values()):
                run = _tied_and_adjusted(run, options, given, workspace, Work(caching, progress))
            if run.adjustment is not None and options.stop_after == "all":
                with workspace.stage("fit"):
                    run = _fitted(run, options, Work(caching, progress))
        with guarded(inputs.values()):  # asked again before outputs appear, and before the last one
            ask()
            if run.fits:
                run = _written(run, options, workspace, work)
        run = replace(run, out_dir=str(out_dir), stages=workspace.stages)
        summary = _summed_up(run, images, inputs, workspace, work)
        workspace.remove_stale()
        for one in chain.from_iterable(given.every() for given in inputs.values()):
            workspace.note({portable(one.path, workspace.folder): one.stamp} if one.stamp is not None else {})
        root = workspace.seal()
    views = [replace(view, sensor=one) for view, one in zip(run.views, run.after or run.before, strict=True)]
    views += [replace(one.view, sensor=one.fit.rpc) for one in run.carried if one.fit is not None]
    return AdjustResult(_as_given(views, images, options), run, summary, root)


def _summed_up(
    run: Run, images: Sequence[Image], inputs: Mapping[str, Input], workspace: Workspace, work: Work
) -> Summary:
    """Write the block for later runs, summary, tables and report: the same bytes in any folder, at any time."""
    progress = work.progress
    if run.adjustment is not None:
        run = _with_block(run, images, inputs, workspace, work)
    opened, run = run, _portable_run(run, workspace.folder)
    with _stage_progress(workspace, "summary", progress):
        entries = _entries(inputs.values(), workspace.folder)
        summary = replace(summarize(run), inputs=entries, out_dir=None, stages=None)
    with _stage_progress(workspace, "pictures", progress):
        write_pictures(workspace, opened, summary, work)
    _report_progress(progress, REPORT_STAGE, 0)
    summary = write_tables(workspace, run, summary)
    _report_progress(progress, REPORT_STAGE, 1)
    return replace(summary, out_dir=run.out_dir, stages=tuple(map(StageEntry.read, workspace.stages)))


def _with_block(
    run: Run, images: Sequence[Image], inputs: Mapping[str, Input], workspace: Workspace, work: Work
) -> Run:
    """Write the block and the list of its images, and with `update` the cameras that move; return what that says."""
    assert run.adjustment is not None
    options = run.options
    with _stage_progress(workspace, "block", work.progress):
        block = block_prior(run.joint or run.adjustment)
        if run.earlier is not None:
            run = replace(run, added=added(run, run.earlier, block, options.adjust.noise_floor))
            block = _as_written(run, block)
        with workspace.output(f"{FOLDER}/{PRIOR_FILE}") as partial:
            block.save(partial)
        text = images_table(run, images, inputs, workspace.folder, block)
        workspace.write_text(f"{FOLDER}/{IMAGES}", text)
    if run.earlier is not None and options.update and options.stop_after == "all":
        views, sensors, sources = movers(run, block, {view.name for view in run.views}, options.allow_remote)
        used = calibrations_of(options.calibration, views, sources, some=True)
        sensors = calibrated(sensors, [used.get(view.name) for view in views])
        assert run.adjustment is not None
        fits = _fits(views, sensors, run.adjustment, options, work)
        with guarded(inputs.values()):
            fitted = list(zip(views, fits, sensors, strict=True))
            write_views(workspace, fitted, options.images, options.rpc_formats, work.executor, work.progress)
            write_grids(workspace, fitted, options, work.executor, work.progress)
    return run


def _as_written(run: Run, block: BlockPrior) -> BlockPrior:
    """Return a block that has grown out of an earlier one with the unknowns of the cameras that are written."""
    assert run.adjustment is not None
    assert run.added is not None
    prior, number = run.earlier.prior, {name: i for i, name in enumerate(block.names)}
    moved = {name for name, _ in run.added.beyond} if run.joint is None else set()
    written = block.params.copy()
    for name, before in zip(prior.names, prior.as_written, strict=True):
        if name not in moved:
            written[number[name]] = before
    for i, name in enumerate(run.adjustment.names):
        if name in number and name not in run.unwritten:
            written[number[name]] = run.adjustment.params[i]
    return replace(block, written=written)


def _entries(inputs: Iterable[Input], folder: Path) -> tuple[InputEntry, ...]:
    """Return every file that was read, once, by its path."""
    files = {portable(one.path, folder): one for given in inputs for one in given.every()}
    return tuple(InputEntry(path, one.size, one.sha256) for path, one in sorted(files.items()))


def _portable_run(run: Run, folder: Path) -> Run:
    """Return the run with every path relative to its folder, and without `overwrite`."""

    def at(path: Any) -> Any:
        return tuple(map(at, path)) if isinstance(path, tuple) else portable(os.fspath(path), folder)

    options = run.options
    given = {key: getattr(options, key) for key in file_options()}
    return replace(
        run,
        views=tuple(replace(view, path=at(view.path)) for view in run.views),
        sources=tuple(replace(source, path=at(source.path)) for source in run.sources),
        carried=tuple(replace(one, view=replace(one.view, path=at(one.view.path))) for one in run.carried),
        left_out=tuple((at(path), reason.replace(path, at(path))) for path, reason in run.left_out),
        options=replace(options, overwrite=False, **{key: at(value) for key, value in given.items() if value}),
    )


def _report_progress(progress: Progress | None, stage: str, done: int) -> None:
    if progress is not None:
        progress(stage, done, 1)


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


@contextmanager
def _stage_progress(workspace: Workspace, stage: str, progress: Progress | None) -> Iterator[None]:
    """Report the progress of a stage of one task."""
    _report_progress(progress, stage, 0)
    with workspace.stage(stage):
        yield
    _report_progress(progress, stage, 1)


def check(
    images: Sequence[Image],
    options: RunOptions | None = None,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> AdjustResult:
    """Measure how well the cameras of overlapping images agree; nothing is adjusted or written.

    Parameters and errors are those of `adjust`, without a folder; the result has no adjustment.
    """
    options, work = with_located(options or RunOptions()), Work(executor, progress)
    run = _with_own_cameras(_with_ties(_with_views("check", images, options, work), options, work), options, work)
    if (found := _agreeing(run, options.adjust)) is not None:
        run = replace(run, agreeing=found)
    return AdjustResult(_as_given(run.views, images, options), run, summarize(run))


def plan(
    images: Sequence[Image],
    out_dir: str | Path | None = None,
    options: RunOptions | None = None,
    *,
    processes: int = 1,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Return the plan of `adjust`; files are opened as there, and nothing is matched or written."""
    options = with_located(options or RunOptions())
    run = _with_views("adjust", images, options, Work(executor, progress))
    if out_dir is not None:
        names, keep = _planned_files(run, options, Path(out_dir))
        Workspace.require_free(out_dir, options.overwrite, keep, names)
    dem, pairs = side_inputs(options, run.views), list[Pair]()
    if len(run.views) > 1 and not options.matches_only:
        scope = _scope(run, options, dem)
        pairs = possible_pairs(run.views, options.tie, scope)
        pairs = pairs if scope.only else best_pairs(pairs, len(run.views), options.tie.neighbours)
    return planned(run, options, dem, pairs, processes)


def _agreeing(run: Run, options: AdjustOptions) -> BoolArray | None:
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


def _as_given(views: Iterable[View], images: Sequence[Image], options: RunOptions) -> tuple[View, ...]:
    place = {str(image_path(image, options.allow_remote)): number for number, image in enumerate(images)}
    given = (view for view in views if view.path in place)  # not those of an earlier run that these meet
    return tuple(sorted(given, key=lambda view: place[view.path]))


def _with_views(
    kind: Literal["adjust", "check"],
    images: Sequence[Image],
    options: RunOptions,
    work: Work,
    workers: list[float] | None = None,
) -> Run:
    """Return the run with its views; CPU seconds of other processes go to `workers`."""
    for path in input_files(options):
        plain_path(path)
    least = 1 if options.gcp or options.reference else 2  # one image and control are enough
    how: dict[str, Any] = {
        "min_views": least,
        "control": kind == "adjust" and options.stop_after != "matching",
        "keep_going": options.keep_going,
        "band": options.tie.band,
        "hosts": options.allow_remote,
        "executor": work.executor,
        "progress": work.progress,
    }
    earlier = None if options.add_to is None else Earlier.open(options.add_to)
    loaded = load_views(images, **how) if earlier is None else join_earlier(images, options, earlier, how)
    if workers is not None:
        workers.append(loaded.worker_seconds)
    none = Tracks(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)), np.empty(0))
    run = Run(kind, loaded.views, loaded.sources, none, left_out=loaded.left_out, options=options, earlier=earlier)
    of_run = frozenset(earlier.number if earlier else ())
    kept, carried = one_each(run.views, run.sources, options.tie.band, of_run)
    run = replace(
        run,
        views=tuple(run.views[i] for i in kept),
        sources=tuple(run.sources[i] for i in kept),
        carried=carried,
    )
    if carried and earlier is not None and all(view.name in of_run for view in run.views):
        one = carried[0]
        raise InputError(
            f"{one.view.name}: has the camera of {one.lead} of {earlier.folder}, up to scale and shift: adjust it with "
            "the images of that run"
        )
    if len(kept) < least and carried:
        one = carried[0]
        raise InputError(
            f"{one.view.name}: a band of {one.lead}, of one acquisition: give an image taken from elsewhere"
        )
    run = replace(run, calibrated=calibrations_of(options.calibration, run.views, run.sources))
    if earlier is None or options.update:
        return run
    given = {str(image_path(image, options.allow_remote)) for image in images}
    return replace(run, unwritten=frozenset(view.name for view in run.views if view.path not in given))


def _planned_files(run: Run, options: RunOptions, folder: Path) -> tuple[list[str], set[Path]]:
    """Return the files that a run writes and those that it keeps; what is in the way is refused before any work."""
    views = [view for view in run.views if view.name not in run.unwritten]
    views += [one.view for one in run.carried]
    if options.stop_after == "matching":
        require_pair_names([view.name for view in views])
    if options.images == "vrt" and options.stop_after == "all":
        for view in views:
            local_image(view.path)
    inputs = [*(view.path for view in run.views), *(source.path for source in run.sources)]
    inputs += [path for one in run.carried for path in (one.view.path, one.source.path)]
    keep = {*here(inputs), *input_files(options)}
    names = output_names(views, options, folder)
    refuse_shadows(folder, names)
    return names, keep


def _tied_and_adjusted(run: Run, options: RunOptions, dem: Dem | None, workspace: Workspace, work: Work) -> Run:
    with workspace.stage("tie points"):
        run = _with_own_cameras(_with_ties(run, options, work, dem), options, work, dem)
    if options.stop_after == "matching":
        _write_asp_matches(run, workspace)
        return replace(run, kind="match")
    if run.earlier is not None:
        run = _met(run, options)
    if dem is not None and options.reference:
        with workspace.stage("reference"):
            run = replace(run, reference=_register_to_reference(run, options, dem, work))
    with workspace.stage("adjustment"), _passes(work.progress):
        return _with_adjustment(run, options, dem)


def _met(run: Run, options: RunOptions) -> Run:
    """Return the run with the tie points of its new images, and those of the earlier ones that have some.

    The others stay as the earlier run has them, but for what control is given of them.
    """
    old, tracks = _is_old(run), of_new(run.tracks, _is_old(run))
    tied = np.bincount(tracks.view, minlength=len(run.views)) > 0
    leads = {one.lead for one in run.carried}
    keep = ~old | tied | bool(options.gcp or options.reference) | np.array([v.name in leads for v in run.views])
    if not (old & keep).any():
        raise TiePointError(
            f"no tie point of the images given is seen in one of {run.earlier.folder}: look at the images (clouds? "
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


def _is_old(run: Run) -> BoolArray:
    """Return which views (N,) are images of the earlier run; none without one."""
    known = () if run.earlier is None else run.earlier.number
    return np.array([view.name in known for view in run.views], dtype=bool)


def _register_to_reference(run: Run, options: RunOptions, dem: Dem, work: Work) -> ReferenceControl:
    """Register the views, with the cameras as delivered, to the reference."""
    given = options.adjust.dem_bias_sigma
    bias = (KNOWN_BIAS if dem.known else DEM_BIAS) if given is None else given
    accuracy = Accuracy(options.reference_sigma, options.adjust.dem_sigma, bias)
    return register_views(run.views, reference_names(options), dem, options.tie.band, accuracy, work)


def _with_adjustment(run: Run, options: RunOptions, dem: Dem | None) -> Run:
    """Return the run with an adjustment and its inputs."""
    gcps, checks = (load_gcps(paths, run.views, options, dem) for paths in (options.gcp, options.check_points))
    centers = _centers(run.views, options.adjust.center)
    if run.reference is not None and run.reference.control is None and not len(run.tracks) and gcps is None:
        raise TiePointError(
            f"{', '.join(options.reference)}: the reference {run.reference.refusal}, and nothing else constrains "
            "the images: check its position and the DEM's, or use a finer one"
        )
    altimetry = load_altimetry(options.altimetry, run.views, options.heights)

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

    chosen, keep_going = _with_rounding(run, options.adjust), options.keep_going
    adjustment = solved(chosen, None if run.earlier is None else run.earlier.prior)
    if run.earlier is not None and not options.update:
        run, adjustment = _with_earlier_held(run, adjustment, chosen, solved)
    refuse_strange(run, adjustment)
    ground = [ground_from_ecef(adjustment.points)]  # none without tie points
    control = None if run.reference is None else run.reference.control
    ground += [one.lonlatalt for one in (gcps, None if control is None else control.points) if one is not None]
    datums = [] if dem is None else [*dem.datums(np.concatenate(ground))]
    datums += [one for given in (gcps, altimetry) if given is not None for one in given.datums]
    return replace(run, centers=centers, gcps=gcps, check_points=checks, adjustment=adjustment, datums=tuple(datums))


def _with_earlier_held(
    run: Run, joint: Adjustment, options: AdjustOptions, solved: Callable[[AdjustOptions, BlockPrior], Adjustment]
) -> tuple[Run, Adjustment]:
    """Return the adjustment of new images to the cameras of the earlier run as they are written, and the run with the
    one that moves them all.

    The uncertainty of the scene's place and shape is that of the latter, as cameras that are held are not exact.
    """
    prior: BlockPrior = run.earlier.prior
    old = {*run.earlier.number}
    fixed = tuple(dict.fromkeys((*options.fixed, *(view.name for view in run.views if view.name in old))))
    held = solved(replace(options, fixed=fixed), replace(prior, params=prior.as_written))
    gauge = replace(joint.gauge, shift=held.gauge.shift)
    return replace(run, joint=joint), replace(held, gauge=gauge, datum=joint.datum, covariance=joint.covariance)


def _undistorted_reference(run: Run) -> Reference | None:
    control = None if run.reference is None else run.reference.control
    if control is None or not run.calibrated:
        return control
    points = control.points
    return replace(control, points=replace(points, xy=run.undistorted(points.view, points.xy)))


def _with_rounding(run: Run, options: AdjustOptions) -> AdjustOptions:
    """Return the options with the part of errors that does not average away as large as whole pixels leave it."""
    if not run.whole_pixels.issuperset(view.name for view in run.views):
        return options
    return replace(options, noise_floor=max(options.noise_floor, WHOLE_PIXELS))


def _with_ties(run: Run, options: RunOptions, work: Work, terrain: Dem | None = None) -> Run:
    """Return the run with tie points: from a file, or matched."""
    views = run.views
    if options.matches and options.matches_only:
        return replace(run, tracks=given_tracks(options.matches, views))
    if len(views) < 2:
        return run
    scope = _scope(run, options, terrain)
    if options.matches:
        scope = replace(scope, given=given_matches(options.matches, views, partly=bool(run.left_out)))
    try:
        ties = find_tracks(views, options.tie, scope, executor=work.executor, progress=work.progress)
    except DisconnectedError as error:
        groups = [group for group in error.groups if run.earlier is None or {*group} & {*run.earlier.number}]
        if not options.keep_going or not groups or len(groups[0]) < 2:
            raise
        kept = _only(run, frozenset(groups[0]), error.said)
        logger.warning("%d of %d images are tied together and kept", len(kept.views), len(views))
        return _with_ties(kept, options, work, terrain)
    detail = ties.detail if run.earlier is None else ()  # where the earlier run saw more, they lack on purpose
    return replace(run, tracks=ties.tracks, matched=ties.pairs, detail=detail)


def _scope(run: Run, options: RunOptions, terrain: Dem | None) -> Scope:
    """Return the pairs and the area in which tie points are looked for."""
    views, old = run.views, _is_old(run)
    scope = Scope(terrain=terrain, joined=np.flatnonzero(old).tolist())
    if options.overlap_list is not None:
        scope = replace(scope, only=read_pairs(options.overlap_list, views, [path for path, _ in run.left_out]))
    elif run.earlier is not None:
        scope = replace(scope, only=chosen_pairs(views, old.tolist(), options.tie))
    return scope if options.aoi is None else replace(scope, area=read_area(options.aoi))


def _with_own_cameras(run: Run, options: RunOptions, work: Work, terrain: Dem | None = None) -> Run:
    """Return the run; InputError where images fit each other's cameras, or with `keep_going` the run without them."""
    found = exchanged_cameras(run.views, run.tracks)
    if found is None:
        return run
    names = [view.name for view in run.views]
    sentence = found.sentence(names)
    others = frozenset(name for i, name in enumerate(names) if i not in found.views)
    if not options.keep_going or len(others) < 2:
        raise InputError(f"{sentence}: give each image its own RPC (IMAGE,camera=FILE)")
    logger.warning("%s: left out", sentence)
    kept = _only(run, others, {names[view]: sentence for view in found.views})
    return _with_ties(kept, options, work, terrain)


def _write_asp_matches(run: Run, workspace: Workspace) -> None:
    names = [view.name for view in run.views]
    for name in MATCH_FILES:
        with workspace.output(name) as partial:
            write_matches(partial, run.tracks, names)
    for ties in pair_ties(run.tracks):
        i, j = ties.views
        text = asp_text(run.tracks.xy[ties.a], run.tracks.xy[ties.b])
        workspace.write_text(f"asp/{pair_name(names[i], names[j])}.txt", text)


def _only(run: Run, names: frozenset[str], said: Mapping[str, str]) -> Run:
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


def _centers(views: Sequence[View], how: Literal["line", "projective"]) -> tuple[CameraCenter, ...]:
    found = camera_centers([v.sensor for v in views], [v.size for v in views], [v.alt_range for v in views], how)
    for view, center in zip(views, found, strict=True):
        if center.method == "nominal":
            logger.warning("%s: its camera determines no projection centre; a nominal one is used", view.name)
    return tuple(found)


def _fitted(run: Run, options: RunOptions, work: Work) -> Run:
    """Refit every P_BA: only when all can be written is any."""
    assert run.adjustment is not None
    number = run.number
    sensors = [one.camera(run.cameras[number[one.lead]]) for one in run.carried]
    views = [*run.views, *(one.view for one in run.carried)]
    fits = _fits(views, [*run.cameras, *sensors], run.adjustment, options, work)
    carried = [replace(one, fit=fit) for one, fit in zip(run.carried, fits[len(run.views) :], strict=True)]
    return replace(run, fits=tuple(fits[: len(run.views)]), carried=tuple(carried))


def _fits(
    views: Sequence[View], sensors: Sequence[SensorModel], adjustment: Adjustment, options: RunOptions, work: Work
) -> list[RpcFit]:
    """Return the RPCs fitted to the corrected cameras of views."""
    # what is known of the place afterwards is the error common to the image; the noise of a point is the vendor's
    bias = float(np.sqrt((adjustment.gauge.sigma[:2] ** 2).mean()))
    known = bias if np.isfinite(bias) and bias > 0 else None
    corrected = zip(views, sensors, strict=True)
    cameras = [(model, view.size, view.alt_range) for view, model in corrected]
    given = options.fit, not (options.keep_going or options.grids)
    found = chain(*by_groups(work.executor, fit_group, cameras, given, "fit", work.progress))
    fits: list[RpcFit] = []
    for view, (fit, error, warned) in zip(views, found, strict=True):
        if fit is None:
            raise FitError(f"{view.name}: {error}")
        for message in warned:
            warnings.warn(f"{view.name}: {message}", BarpcWarning, stacklevel=2)
        rand = view.sensor.err_rand if isinstance(view.sensor, RPC) else None
        fits.append(replace(fit, rpc=replace(fit.rpc, err_bias=known, err_rand=rand)))
    return fits


def fit_group(
    cameras: Sequence[tuple[SensorModel, tuple[int, int], tuple[float, float]]],
    options: FitOptions,
    strict: bool,
) -> list[tuple[RpcFit | None, str, tuple[str, ...]]]:
    """Fit RPCs to some cameras in a worker: each fit, or None and the reason, and its warnings."""
    out: list[tuple[RpcFit | None, str, tuple[str, ...]]] = []
    for model, size, alt_range in cameras:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", BarpcWarning)
            fit, error = None, ""
            try:
                # what a physical camera does beyond an RPC is its own: grids hold it
                wanted = strict and isinstance(innermost(model), RPC)
                fit = fit_rpc(model, size, alt_range, options=options, strict=wanted)
            except FitError as failed:
                error = str(failed)
        out.append((fit, error, tuple(str(one.message) for one in caught)))
    return out


def _written(run: Run, options: RunOptions, workspace: Workspace, work: Work) -> Run:
    """Write the refitted RPCs, and open them again."""
    assert run.adjustment is not None
    every = zip(run.views, run.fits, run.cameras, strict=True)
    fitted = [one for one in every if one[0].name not in run.unwritten]
    number = run.number
    for band in run.carried:
        assert band.fit is not None
        fitted.append((band.view, band.fit, band.camera(run.cameras[number[band.lead]])))
    written = write_views(workspace, fitted, options.images, options.rpc_formats, work.executor, work.progress)
    beyond = write_grids(workspace, fitted, options, work.executor, work.progress)
    names = [*written[0], *(name for one in beyond for name in one)]
    for sentence in unverified([workspace.folder / name for name in names]):
        logger.warning(sentence)
    found = {one[0].name: {**w, **more} for one, w, more in zip(fitted, written, beyond, strict=True)}
    carried = tuple(replace(band, written=found[band.view.name]) for band in run.carried)
    return replace(run, written=tuple(found.get(view.name, {}) for view in run.views), carried=carried)
