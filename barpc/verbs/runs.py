"""Runs of the pipeline and commands on finished ones: `adjust`, `match`, `check`, `dsm`, `export`, `verify`."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from barpc import pipeline
from barpc.base.declarations import with_values
from barpc.base.errors import ReservationError, UsageError
from barpc.base.verb_options import DsmOptions, ExportOptions, VerifyOptions
from barpc.verbs.options import OptionsLike, run_options
from barpc.verbs.workers import executor_for

if TYPE_CHECKING:
    from typing import Unpack

    from barpc.base.keywords import DsmKeywords, ExportKeywords, PathLike, RunKeywords, VerifyKeywords
    from barpc.base.tasks import Progress
    from barpc.cameras import ImageLike
    from barpc.dsm.surface import Surface
    from barpc.pipeline import AdjustResult, Plan
    from barpc.pipeline.proof import Verification
    from barpc.pipeline.results import OpenedRun


def adjust(
    images: ImageLike | Iterable[ImageLike],
    /,
    out_dir: PathLike,
    options: OptionsLike = None,
    *,
    check: bool = False,
    executor: Executor | None = None,
    jobs: int | str = 1,
    progress: Progress | None = None,
    **keywords: Unpack[RunKeywords],
) -> AdjustResult:
    """Correct the cameras of overlapping images and write fresh RPCs.

    Parameters
    ----------
    images : one or many: paths, patterns, folders, open rasterio datasets, Views
        In any order: the files written do not depend on it. They are opened read-only. Cameras are found as by
        `barpc.open_camera`; a View brings its own model (a frozen dataclass, so that results can be cached).
    out_dir : path, folder for the results: one VRT and one ``_RPC.TXT`` an image, ``summary.json``, ``report.html``
    options : RunOptions, mapping as of a TOML file, or path of one; None: the defaults
    check : bool, raise ReservationError where the result has not `passed`: the files are written, and are its `result`
    executor : concurrent.futures.Executor, optional, works on images, tiles, pairs, fits; results do not depend on it
    jobs : int or str, without an executor: number of processes (a script that asks for several has its work behind
        ``if __name__ == "__main__":``), or the address of a dask.distributed cluster
    progress : callable, optional, `progress(stage, done, total)`; total 0: unknown, as of an adjustment's passes
    **keywords : any option by its name, as the flags of `barpc adjust`: ``gcp="points.csv"``, ``dem=["a.tif"]``

    Returns
    -------
    AdjustResult, with `views`, `summary`, `tracks`, `adjustment`, `passed`

    Raises
    ------
    BarpcError
        See `barpc.base.errors`; nothing is written then.

    Examples
    --------
    >>> result = barpc.adjust("data_samples/*.tif", "adjusted", points_per_image=500)
    >>> result.passed, result.summary["headline"]
    (True, 'All 3 images are adjusted.')
    >>> result.views[0].sensor.project([5.4, 43.3, 120.0]).shape
    (2,)
    """
    from barpc.verbs.images import every

    chosen, where = run_options(options, **keywords), os.fspath(out_dir)
    with executor_for(jobs, executor) as workers:
        done = pipeline.adjust(every(images), options=chosen, out_dir=where, executor=workers, progress=progress)
    if check and not done.passed:
        raise ReservationError(" ".join((done.record.headline, *done.record.reasons)), done)
    return done


def plan(
    images: ImageLike | Iterable[ImageLike],
    /,
    out_dir: PathLike | None = None,
    options: OptionsLike = None,
    *,
    executor: Executor | None = None,
    jobs: int | str = 1,
    progress: Progress | None = None,
    **keywords: Unpack[RunKeywords],
) -> Plan:
    """Return the plan of `barpc.adjust`: pairs, time, memory, the datum assumed, doubts on the input.

    Parameters
    ----------
    images, options, executor, jobs, progress, **keywords : as of `barpc.adjust`; all files are opened as there
    out_dir : path, optional, where results are to go: what is in the way there is said

    Returns
    -------
    Plan; nothing is matched or written

    Raises
    ------
    BarpcError
        As of `barpc.adjust`, before it starts to match.

    Examples
    --------
    >>> found = barpc.plan("data_samples/*.tif", points_per_image=500)
    >>> found.views, found.doubts
    (('view_00', 'view_01', 'view_02'), ())
    """
    from barpc.verbs.images import every

    chosen, processes = run_options(options, **keywords), jobs + (jobs > 1) if isinstance(jobs, int) else 1
    where = None if out_dir is None else os.fspath(out_dir)
    with executor_for(jobs, executor) as workers:
        how: dict[str, Any] = {"processes": processes, "executor": workers, "progress": progress}
        return pipeline.plan(every(images), where, chosen, **how)


def match(
    images: ImageLike | Iterable[ImageLike],
    /,
    out_dir: PathLike,
    options: OptionsLike = None,
    *,
    executor: Executor | None = None,
    jobs: int | str = 1,
    progress: Progress | None = None,
    **keywords: Unpack[RunKeywords],
) -> AdjustResult:
    """Match tie points and stop, for ``adjust(..., matches=...)`` and other tools.

    Parameters
    ----------
    images, out_dir, options, executor, jobs, progress, **keywords : as of `barpc.adjust`
        matches.csv and matches.npz are written, and a text file for each pair as ASP reads them.

    Returns
    -------
    AdjustResult, with `tracks` and without an adjustment

    Raises
    ------
    BarpcError
        As of `barpc.adjust`.

    Examples
    --------
    >>> found = barpc.match("data_samples/view_0[01].tif", "ties", points_per_image=500)
    >>> found.tracks.num_points > 100
    True
    """
    chosen = replace(run_options(options, **keywords), stop_after="matching")
    return adjust(images, out_dir, chosen, executor=executor, jobs=jobs, progress=progress)


def check(
    images: ImageLike | Iterable[ImageLike],
    /,
    options: OptionsLike = None,
    *,
    executor: Executor | None = None,
    jobs: int | str = 1,
    progress: Progress | None = None,
    **keywords: Unpack[RunKeywords],
) -> AdjustResult:
    """Measure how well the cameras of overlapping images agree; nothing is adjusted or written.

    Parameters
    ----------
    images, options, executor, jobs, progress, **keywords : as of `barpc.adjust`

    Returns
    -------
    AdjustResult, with `tracks` and `summary`, without an adjustment

    Raises
    ------
    BarpcError
        As of `barpc.adjust`.

    Examples
    --------
    >>> found = barpc.check("data_samples/view_0[01].tif", points_per_image=500)
    >>> found.passed, found.summary["pairs"][0]["num_matches"] > 100
    (False, True)
    """
    from barpc.verbs.images import every

    chosen = run_options(options, **keywords)
    with executor_for(jobs, executor) as workers:
        return pipeline.check(every(images), options=chosen, executor=workers, progress=progress)


def dsm(
    source: ImageLike | Iterable[ImageLike],
    out: PathLike,
    options: DsmOptions | None = None,
    *,
    executor: Executor | None = None,
    jobs: int | str = 1,
    progress: Progress | None = None,
    **keywords: Unpack[DsmKeywords],
) -> Surface:
    """Make a first surface model of a finished run, or of images with their cameras.

    Parameters
    ----------
    source : path of a run folder, or images: paths, patterns, open rasterio datasets
    out : path of the GeoTIFF
    options : DsmOptions, optional
    executor, jobs, progress : as of `barpc.adjust`; the bytes written do not depend on them
    **keywords : fields of `DsmOptions`: gsd, crs, alt, pairs, band, minus, overwrite

    Returns
    -------
    Surface, the file, its cells and their medians

    Raises
    ------
    NoSurfaceError
        Images that cannot be matched in this way: radar, too large an angle, hardly a pixel that is found back.
    InputError, OutputError
        See `barpc.base.errors`; nothing is written then.

    Examples
    --------
    >>> _ = barpc.adjust("data_samples/view_0[01].tif", "run", points_per_image=500)
    >>> surface = barpc.dsm("run", "dsm.tif", gsd=2)
    >>> surface.gsd, surface.known > 1000
    (2.0, True)
    """
    from barpc.dsm.surface import make_dsm
    from barpc.verbs.images import every, one_or_many

    chosen = with_values(options or DsmOptions(), keywords, "dsm")
    given, _ = one_or_many(source)
    run = run_folder(given)
    if run is None and chosen.minus is not None:
        raise UsageError("--minus goes with a RUN: errors common to two dates are unknown for images alone")
    with executor_for(jobs, executor) as workers:
        return make_dsm(run or every(given), os.fspath(out), chosen, executor=workers, progress=progress)


def run_folder(source: Sequence[Any]) -> Path | None:
    """Return the finished run given in place of images, if any. UsageError for a run beside others."""
    paths = [Path(one) for one in source if isinstance(one, (str, os.PathLike))]
    runs = [path for path in paths if (path / "summary.json").is_file()]
    if runs and len(source) > 1:
        raise UsageError(f"{runs[0]} is a finished run: give it alone (--minus OTHER_RUN is for two dates)")
    return runs[0] if runs else None


def export(
    run_dir: PathLike,
    out_dir: PathLike,
    to: str,
    **keywords: Unpack[ExportKeywords],
) -> list[Path]:
    """Hand a finished run to another tool: its images, corrected cameras and tie points in files that it reads.

    Parameters
    ----------
    run_dir : path of a finished adjustment
    out_dir : path, a new folder; files in it point at images and run relative to it
    to : str, the tool: satnerf, colmap, s2p, cars, asp, stac, points
    **keywords : fields of `ExportOptions`: alt, time, overwrite, ...

    Returns
    -------
    list of Path, the files written

    Raises
    ------
    InputError
        No such tool, no finished adjustment, altitudes that are no interval; its child `UnknownTimeError`: the time of
        acquisition of an image is unknown, and the tool needs it.
    OutputError
        The folder is in use, not empty, or the run's own.

    Examples
    --------
    >>> _ = barpc.adjust("data_samples/*.tif", "finished", points_per_image=500)
    >>> [path.name for path in barpc.export("finished", "nerf", "satnerf", time=["2020-06-01T10:30:00"])][:2]
    ['view_00.json', 'view_01.json']
    """
    from barpc.export.targets import export_run

    return export_run(run_dir, to, out_dir, with_values(ExportOptions(), keywords, "export"))


def open_run(run_dir: PathLike) -> OpenedRun:
    """Open a finished run: the result of `adjust` or `match`, from the files in its folder.

    Parameters
    ----------
    run_dir : path of a finished run

    Returns
    -------
    OpenedRun, with `views`, `tracks`, `tables`, `summary`, `record`, `passed`, `report()`, `to_geojson()`

    Raises
    ------
    InputError
        The folder holds no finished run, or a file that is asked for was changed since.

    Examples
    --------
    >>> _ = barpc.match("data_samples/view_0[01].tif", "opened", points_per_image=500)
    >>> run = barpc.open_run("opened")
    >>> len(run.tracks) == len(run.tables.observations.xy), run.summary["kind"]
    (True, 'match')
    """
    from barpc.pipeline.results import OpenedRun

    return OpenedRun.of_folder(Path(run_dir))


def report(run_dir: PathLike, *others: PathLike, csv: bool = False) -> Any:
    """Make report.html of a finished run again, compare two runs, or list any number of runs.

    Parameters
    ----------
    run_dir, *others : path of a finished run; of two to compare, of the same images; with `csv` of any number
    csv : bool, a row for each run instead

    Returns
    -------
    Path, of report.html; of two runs a dict, the figures of `barpc report --json A B`; with `csv` a list of dicts, the
    rows of `barpc report --csv`: verdict, figures and reasons of each run

    Raises
    ------
    InputError
        No finished run, or one that was changed since; with `csv` its `status` is "none", with the reason.

    Examples
    --------
    >>> _ = barpc.match("data_samples/view_0[01].tif", "listed", points_per_image=500)
    >>> [(row["status"], row["images"]) for row in barpc.report("listed", "data_samples", csv=True)]
    [('good', 2), ('none', None)]
    """
    if csv:
        from barpc.report.overview import overview

        return overview((run_dir, *others))
    if len(others) > 1:
        raise UsageError(f"{len(others) + 1} runs: give one, two to compare, or any number with --csv")
    if others:
        from barpc.report.compare import compare_runs

        return compare_runs(run_dir, *others)
    from barpc.pipeline.remake import remake_report

    return remake_report(run_dir)


def verify(
    run_dir: PathLike,
    places: PathLike | Sequence[PathLike] = (),
    *,
    progress: Progress | None = None,
    **keywords: Unpack[VerifyKeywords],
) -> Verification:
    """Compare the files of a run or export with its SHA256SUMS, and its cameras with those certified.

    Parameters
    ----------
    run_dir : path of a finished run, or of an export
    places : path or paths, optional, folders in which missing inputs are searched by name
    progress : callable, optional, `progress(stage, done, total)`
    **keywords : fields of `VerifyOptions`: expect, the root that was printed, or a later one; figures, to measure the
        RMS of the images again, by their files as another tool reads them

    Returns
    -------
    Verification, a tuple of a row for each file: `kind`, `file`, `now`, `note`, `passed`; false where one has changed

    Raises
    ------
    InputError
        SHA256SUMS is missing or damaged.

    Examples
    --------
    >>> _ = barpc.match("data_samples/view_0[01].tif", "tied", points_per_image=500)
    >>> barpc.verify("tied")
    Verification(... files, none has changed)
    """
    from barpc.pipeline.proof import Verification, prove

    chosen = with_values(VerifyOptions(), keywords, "verify")
    folders, expect = [places] if isinstance(places, (str, os.PathLike)) else places, chosen.expect
    found = prove(Path(run_dir), [Path(place) for place in folders], expect and expect.lower(), progress)
    if chosen.figures:
        from barpc.verbs.figures import reread_figures

        found += reread_figures(Path(run_dir))
    return Verification(found)
