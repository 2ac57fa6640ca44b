"""`adjust` and `check`: the stages in a row."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from barpc.ba import Adjustment, adjust_tracks
from barpc.errors import InputError
from barpc.fit import RpcFit, fit_rpc
from barpc.pipeline.options import RunOptions
from barpc.pipeline.outputs import SUFFIXES, write_tables, write_view
from barpc.pipeline.views import LoadedViews, load_views
from barpc.report import Run, summarize
from barpc.scene import Tracks, View
from barpc.sensor.geometry import CameraCenter, camera_center
from barpc.tie import TieResult, find_tracks
from barpc.workspace import Workspace

logger = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class AdjustResult:
    """What a run ends with.

    Parameters
    ----------
    views : tuple of View
        The images; after an adjustment with their refitted RPCs as sensors.
    run : Run
        Everything found on the way.
    summary : dict
        What summary.json holds.
    """

    views: tuple[View, ...]
    run: Run
    summary: dict[str, Any]

    @property
    def passed(self) -> bool:
        """Whether every image was used and every quality gate met."""
        return bool(self.summary["passed"])

    @property
    def adjustment(self) -> Adjustment:
        """The adjustment itself."""
        assert self.run.adjustment is not None
        return self.run.adjustment

    @property
    def tracks(self) -> Tracks:
        """The tie points."""
        return self.run.tracks


def adjust(
    images: Sequence[str | Path],
    out_dir: str | Path,
    options: RunOptions | None = None,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> AdjustResult:
    """Correct the cameras of overlapping images and write fresh RPCs.

    Parameters
    ----------
    images : sequence of path
        Two or more rasters with RPCs. They are opened read-only.
    out_dir : path
        Folder for the results: one VRT and one ``_RPC.TXT`` an image, ``summary.json``.
    options : RunOptions, optional
        None: the defaults.
    executor : concurrent.futures.Executor, optional
        Works on tiles and pairs; the result does not depend on it.
    progress : callable, optional
        `progress(stage, done, total)`.

    Returns
    -------
    AdjustResult

    Raises
    ------
    BarpcError
        See `barpc.errors`; nothing is written then.
    """
    options = options or RunOptions()
    unknown = [name for name in options.rpc_formats if name not in SUFFIXES]
    if unknown:
        raise InputError(f"rpc_formats {unknown[0]!r} is not one of {', '.join(SUFFIXES)}")
    loaded = load_views(images, keep_going=options.keep_going, band=options.tie.band)
    keep = frozenset(
        Path(p) for v, s in zip(loaded.views, loaded.sources, strict=True) for p in (v.path, s.path)
    )
    with Workspace(out_dir, overwrite=options.overwrite, keep=keep) as workspace:
        run = _solve(loaded, options, workspace, executor, progress)
        if run.adjustment is not None and options.stop_after == "all":
            with workspace.stage("fit"):
                run = _fit_and_write(run, options, workspace, progress)
        run = replace(run, stages=workspace.stages, out_dir=str(out_dir))
        summary = summarize(run)
        write_tables(workspace, run, summary)
        workspace.remove_stale()
    views = tuple(
        replace(view, sensor=sensor) for view, sensor in zip(run.views, run.after or run.before, strict=True)
    )
    return AdjustResult(views, run, summary)


def check(
    images: Sequence[str | Path],
    options: RunOptions | None = None,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> AdjustResult:
    """Measure how well the cameras of overlapping images agree; nothing is adjusted or written."""
    options = options or RunOptions()
    loaded = load_views(images, keep_going=options.keep_going, band=options.tie.band)
    ties = find_tracks(loaded.views, options.tie, executor=executor, progress=progress)
    run = Run(
        "check",
        loaded.views,
        loaded.sources,
        ties.tracks,
        ties.pairs,
        left_out=loaded.left_out,
        options=options,
    )
    return AdjustResult(loaded.views, run, summarize(run))


def _solve(
    loaded: LoadedViews,
    options: RunOptions,
    workspace: Workspace,
    executor: Executor | None,
    progress: Progress | None,
) -> Run:
    """Tie points and the adjustment, as often as there are passes."""
    views = loaded.views
    run = Run(
        "adjust",
        views,
        loaded.sources,
        Tracks([], [], np.empty((0, 2)), []),
        left_out=loaded.left_out,
        options=options,
    )
    centers = tuple(_center(view, options) for view in views)
    adjustment: Adjustment | None = None
    for number in range(options.num_passes):
        again = f" (pass {number + 1})" if number else ""
        with workspace.stage("tie points" + again):
            sensors = None if adjustment is None else adjustment.sensors
            ties: TieResult = find_tracks(
                views, options.tie, executor=executor, progress=progress, sensors=sensors
            )
        run = replace(run, tracks=ties.tracks, matched=ties.pairs)
        if options.stop_after == "matching":
            return replace(run, kind="check")
        with workspace.stage("adjustment" + again):
            adjustment = adjust_tracks(
                views, ties.tracks, options.adjust, centers=np.array([center.ecef for center in centers])
            )
    return replace(run, adjustment=adjustment, centers=centers)


def _center(view: View, options: RunOptions) -> CameraCenter:
    method: Any = options.adjust.center_method
    center = camera_center(view.sensor, view.size, view.alt_range, method)
    if center.method != method:
        logger.warning(
            "%s: the camera centre is not to be had from its RPC; a nominal one is used", view.name
        )
    return center


def _fit_and_write(run: Run, options: RunOptions, workspace: Workspace, progress: Progress | None) -> Run:
    """Refit every P_BA first, and write only when all can be written."""
    assert run.adjustment is not None
    fits: list[RpcFit] = []
    tolerance = np.inf if options.force else options.fit.tolerance
    for i, (view, model) in enumerate(zip(run.views, run.adjustment.sensors, strict=True)):
        fits.append(
            fit_rpc(model, view.size, view.alt_range, options=replace(options.fit, tolerance=tolerance))
        )
        if progress is not None:
            progress("fit", i + 1, len(run.views))
    written = []
    for i, (view, fit, model) in enumerate(zip(run.views, fits, run.adjustment.sensors, strict=True)):
        written.append(write_view(workspace, view, fit, model, options.images, options.rpc_formats))
        if progress is not None:
            progress("write", i + 1, len(run.views))
    return replace(run, fits=tuple(fits), written=tuple(written))
