"""`adjust` and `check`: the stages in a row."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np

from barpc.ba import Adjustment, BlockPrior, block_prior
from barpc.base.errors import BarpcWarning, FitError, InputError
from barpc.base.geodesy import feature_collection
from barpc.base.identity import Input, Stamp, ask, guarded, recorded
from barpc.base.options import FitOptions, RunOptions, file_options
from barpc.base.process import one_blas_thread
from barpc.base.remote import here
from barpc.base.safe_io import plain_path
from barpc.base.sealed import portable
from barpc.base.tasks import Progress, Work
from barpc.fit import RpcFit, fit_rpc
from barpc.fit.refit import innermost
from barpc.pipeline.acquisitions import one_each
from barpc.pipeline.adjusting import agreeing_observations, scope_of, tied_and_adjusted, with_own_cameras, with_ties
from barpc.pipeline.calibrations import calibrated, calibrations_of
from barpc.pipeline.earlier import Earlier, GrowingRun, added, images_table, join_earlier, movers
from barpc.pipeline.executor import CachingExecutor, by_groups
from barpc.pipeline.grid_outputs import write_grids
from barpc.pipeline.inputs import hash_inputs, input_files, side_inputs, with_located
from barpc.pipeline.loading import Image, image_path, load_views
from barpc.pipeline.outputs import output_names, refuse_shadows, write_tables, write_views
from barpc.pipeline.pictures import write_pictures
from barpc.pipeline.planning import Plan, planned
from barpc.pipeline.results import RunResult
from barpc.pipeline.verify_outputs import unverified
from barpc.pointio.names import require_pair_names
from barpc.report import Run, Summary, summarize
from barpc.report.page import REPORT_STAGE
from barpc.report.runfiles import FOLDER, IMAGES, PRIOR_FILE
from barpc.report.summary import InputEntry, StageEntry
from barpc.report.tables import outline_features
from barpc.rpcio import local_image
from barpc.scene import Tracks, View
from barpc.sensor import SensorModel
from barpc.sensor.rpc import RPC
from barpc.tie.pairing.overlaps import Pair, best_pairs, possible_pairs
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
                run = tied_and_adjusted(run, given, workspace, Work(caching, progress))
            if run.adjustment is not None and options.stop_after == "all":
                with workspace.stage("fit"):
                    run = _with_refits(run, options, Work(caching, progress))
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
    run: GrowingRun, images: Sequence[Image], inputs: Mapping[str, Input], workspace: Workspace, work: Work
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
    run: GrowingRun, images: Sequence[Image], inputs: Mapping[str, Input], workspace: Workspace, work: Work
) -> GrowingRun:
    """Write the block and the list of its images, and with `update` the cameras that move; return what that says."""
    assert run.adjustment is not None
    options, earlier = run.options, run.earlier
    with _stage_progress(workspace, "block", work.progress):
        block = block_prior(run.joint or run.adjustment)
        if earlier is not None:
            run = replace(run, added=added(run, earlier, block, options.adjust.noise_floor))
            block = _as_written(run, earlier.prior, block)
        with workspace.output(f"{FOLDER}/{PRIOR_FILE}") as partial:
            block.save(partial)
        text = images_table(run, images, inputs, workspace.folder, block)
        workspace.write_text(f"{FOLDER}/{IMAGES}", text)
    if earlier is not None and options.update and options.stop_after == "all":
        views, sensors, sources = movers(run, earlier, block, {view.name for view in run.views}, options.allow_remote)
        used = calibrations_of(options.calibration, views, sources, some=True)
        sensors = calibrated(sensors, [used.get(view.name) for view in views])
        assert run.adjustment is not None
        fits = _fits(views, sensors, run.adjustment, options, work)
        with guarded(inputs.values()):
            fitted = list(zip(views, fits, sensors, strict=True))
            write_views(workspace, fitted, options.images, options.rpc_formats, work.executor, work.progress)
            write_grids(workspace, fitted, options, work.executor, work.progress)
    return run


def _as_written(run: Run, prior: BlockPrior, block: BlockPrior) -> BlockPrior:
    """Return a block that has grown out of an earlier one with the unknowns of the cameras that are written."""
    assert run.adjustment is not None
    assert run.added is not None
    number = {name: i for i, name in enumerate(block.names)}
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


def _portable_run(run: GrowingRun, folder: Path) -> GrowingRun:
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
    run = with_own_cameras(with_ties(_with_views("check", images, options, work), work), work)
    if (found := agreeing_observations(run, options.adjust)) is not None:
        run = replace(run, agreeing=found)
    return AdjustResult(_as_given(run.views, images, options), run, summarize(run))


def plan(
    images: Sequence[Image],
    out_dir: str | Path | None = None,
    options: RunOptions | None = None,
    *,
    processes: int,
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
        scope = scope_of(run, dem)
        pairs = possible_pairs(run.views, options.tie, scope)
        pairs = pairs if scope.only else best_pairs(pairs, len(run.views), options.tie.neighbours)
    return planned(run, options, dem, pairs, processes)


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
) -> GrowingRun:
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
    run = GrowingRun(
        kind, loaded.views, loaded.sources, none, left_out=loaded.left_out, options=options, earlier=earlier
    )
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


def _with_refits(run: GrowingRun, options: RunOptions, work: Work) -> GrowingRun:
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


def _written(run: GrowingRun, options: RunOptions, workspace: Workspace, work: Work) -> GrowingRun:
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
