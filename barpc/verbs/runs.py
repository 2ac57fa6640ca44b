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
from barpc.base.errors import UsageError
from barpc.base.verb_options import DsmOptions, ExportOptions, VerifyOptions
from barpc.verbs.options import OptionsLike, run_options
from barpc.verbs.workers import executor_for

if TYPE_CHECKING:
    from barpc.cameras import ImageLike
    from barpc.dsm import Surface
    from barpc.pipeline import AdjustResult
    from barpc.pipeline.proof import Proved
    from barpc.tie.tasks import Progress

PathLike = str | Path


def adjust(
    images: ImageLike | Iterable[ImageLike],
    out_dir: PathLike,
    options: OptionsLike = None,
    *,
    executor: Executor | None = None,
    jobs: int | str = 1,
    progress: Progress | None = None,
    **keywords: Any,
) -> AdjustResult:
    """Correct the cameras of overlapping images and write fresh RPCs.

    Parameters
    ----------
    images : one or many: paths, patterns, folders, open rasterio datasets, Views
        In any order: the files written do not depend on it. They are opened read-only. Cameras are found as by
        `barpc.open_camera`; a View brings its own model (a frozen dataclass, so that results can be cached).
    out_dir : path, folder for the results: one VRT and one ``_RPC.TXT`` an image, ``summary.json``, ``report.html``
    options : RunOptions, mapping as of a TOML file, or path of one; None: the defaults
    executor : concurrent.futures.Executor, optional, works on images, tiles, pairs, fits; results do not depend on it
    jobs : int or str, without an executor: number of processes (a script that asks for several has its work behind
        ``if __name__ == "__main__":``), or the address of a dask.distributed cluster
    progress : callable, optional, `progress(stage, done, total)`
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
        return pipeline.adjust(every(images), options=chosen, out_dir=where, executor=workers, progress=progress)


def match(
    images: ImageLike | Iterable[ImageLike],
    out_dir: PathLike,
    options: OptionsLike = None,
    *,
    executor: Executor | None = None,
    jobs: int | str = 1,
    progress: Progress | None = None,
    **keywords: Any,
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
    options: OptionsLike = None,
    *,
    executor: Executor | None = None,
    jobs: int | str = 1,
    progress: Progress | None = None,
    **keywords: Any,
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
    **keywords: Any,
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
    from barpc.dsm import make_dsm
    from barpc.verbs.images import every, one_or_many

    chosen = with_values(options or DsmOptions(), keywords, "dsm")
    given, _ = one_or_many(source)
    run = run_folder(given)
    if run is None and chosen.minus is not None:
        raise UsageError("--minus goes with a RUN: errors common to two dates are unknown for images alone")
    with executor_for(jobs, executor) as workers:
        return make_dsm(run or every(given), out, chosen, executor=workers, progress=progress)


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
    **keywords: Any,
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
        No such tool, no finished adjustment, altitudes that are no interval; `barpc.export.UnknownTimeError`: the time
        of acquisition of an image is unknown, and the tool needs it.
    OutputError
        The folder is in use, not empty, or the run's own.

    Examples
    --------
    >>> _ = barpc.adjust("data_samples/*.tif", "finished", points_per_image=500)
    >>> [path.name for path in barpc.export("finished", "nerf", "satnerf", time=["2020-06-01T10:30:00"])][:2]
    ['view_00.json', 'view_01.json']
    """
    from barpc.export import export_run

    return export_run(run_dir, to, out_dir, with_values(ExportOptions(), keywords, "export"))


def verify(
    run_dir: PathLike,
    places: PathLike | Sequence[PathLike] = (),
    *,
    progress: Progress | None = None,
    **keywords: Any,
) -> list[Proved]:
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
    list of Proved, a file each: `kind`, `file`, `now`, `note`, `passed`

    Raises
    ------
    InputError
        SHA256SUMS is missing or damaged.

    Examples
    --------
    >>> _ = barpc.match("data_samples/view_0[01].tif", "tied", points_per_image=500)
    >>> all(one.passed for one in barpc.verify("tied"))
    True
    """
    from barpc.pipeline.proof import prove

    chosen = with_values(VerifyOptions(), keywords, "verify")
    folders, expect = [places] if isinstance(places, (str, os.PathLike)) else places, chosen.expect
    found = prove(Path(run_dir), [Path(place) for place in folders], expect and expect.lower(), progress)
    if chosen.figures:
        from barpc.verbs.figures import reread_figures

        found += reread_figures(Path(run_dir))
    return found
