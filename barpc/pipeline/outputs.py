"""The corrected RPCs as files, each reopened and compared before it counts as written."""

from __future__ import annotations

import json
from collections.abc import Sequence, Set
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from barpc.errors import OutputError
from barpc.fit import RpcFit
from barpc.handoff import verify
from barpc.options import RunOptions
from barpc.pipeline.beyond import REOPENED, grid_names, made_in_room
from barpc.pipeline.executor import CachingExecutor
from barpc.pipeline.inputs import PRIOR
from barpc.report import Run, Summary
from barpc.report.page import REPORT, can_render, report_html
from barpc.report.records import plain
from barpc.report.summary import OutputEntry, StageEntry
from barpc.report.tables import TABLES, gcps_geojson
from barpc.rpcio import CARRIERS, WRITABLE, sidecars, write_camera
from barpc.scene import View
from barpc.sensor import SensorModel
from barpc.sensor.rpc import RPC
from barpc.tie.tasks import Progress, ordered
from barpc.workspace import LAST, Workspace, own_files
from barpc.workspace import TABLES as TABLES_FOLDER

MATCHES = ("matches.csv", "matches.npz")
GCPS = f"{TABLES_FOLDER}/gcps.geojson"  # of a reference


Fitted = tuple[View, RpcFit, SensorModel]  # a view, its refitted RPC and P_BA
Written = dict[str, dict[str, float | str]]
"""File -> consumer -> difference to P_BA [px], or why it does not read it."""


def write_views(
    run: Workspace,
    fitted: Sequence[Fitted],
    images: str,
    formats: Sequence[str],
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> list[Written]:
    """Write every view's corrected RPC, and open every file again as its consumers do.

    Workers make the files in a room of the run folder, here they get their place, and workers open them again.
    OutputError where a file cannot be written, or barpc and GDAL do not read it back.
    """
    with CachingExecutor(run, {}, executor, keep=False) as fresh:
        with run.stage("write"):
            tasks = [(view, fit.rpc, images, tuple(formats), str(run.folder)) for view, fit, _ in fitted]
            made = made_in_room(run, fresh, make_files, tasks, "write", progress)
        with run.stage("verify"):
            paths = [tuple(str(run.folder / name) for name in names) for names in made]
            again = [(there, *one) for there, one in zip(paths, fitted, strict=True)]
            return ordered(fresh, verify_files, again, "verify", progress)


def make_files(view: View, rpc: RPC, images: str, formats: Sequence[str], folder: str, room: str) -> tuple[str, ...]:
    """Write the files of a view into a temporary folder before they go to `folder`; return their names."""
    place, names = Path(room) / view.name, file_names(view, images, formats)
    for name in names:
        try:
            place.mkdir(parents=True, exist_ok=True)
            write_camera(rpc, place / name, view.path, place=Path(folder) / name, overwrite=True)
        except OSError as error:
            if isinstance(error, OutputError) or error.errno is None:
                raise
            raise OutputError(f"{Path(folder) / name}: cannot be written ({error.strerror})") from error
    return tuple(names)


def verify_files(paths: Sequence[str], view: View, fit: RpcFit, model: SensorModel) -> Written:
    """Open the files of a view as their consumers do; OutputError where barpc or GDAL reads another camera."""
    largest = float(np.linalg.norm(fit.max_ckp)) + REOPENED
    written: Written = {Path(path).name: {} for path in paths}
    readings = verify([Path(path) for path in paths], model, view.size, view.alt_range)
    for reading in sorted(readings, key=lambda one: one.consumer != "barpc"):  # what barpc finds says more
        own = reading.consumer.partition(",")[0] in ("barpc", "gdal")  # which reads texts beside an image
        if own and not reading.max_error <= 2 * largest:
            raise OutputError(
                f"{reading.path}: {reading.consumer} reads it {reading.max_error:.3g} px off ({reading.note}); "
                "is the disk full, or another RPC file beside it?"
            )
    for reading in readings:
        written[reading.path.name][reading.consumer] = reading.note or reading.max_error
    return written


def file_names(view: View, images: str, formats: Sequence[str]) -> list[str]:
    """Return the files that `write_views` writes for a view."""
    ends = [CARRIERS[images].suffixes[0]] if images in CARRIERS else []
    return [view.name + end for end in (*ends, *(WRITABLE[key].beside for key in formats))]


def output_names(views: Sequence[View], options: RunOptions, folder: Path) -> list[str]:
    """Return the names of a run's outputs before it starts; of match files those that are already in the folder."""
    names = [*(f"{TABLES_FOLDER}/{name}" for name in TABLES), LAST]
    names += ["report.html"] * can_render() + [GCPS] * bool(options.reference)
    if options.stop_after == "matching":
        stems = {view.name for view in views}
        pairs = [path.name for path in (folder / "asp").glob("*__*.txt") if _is_pair(path.stem, stems)]
        return [*names, *MATCHES, *(f"asp/{name}" for name in pairs)]
    if options.stop_after == "all":
        names += [name for view in views for name in file_names(view, options.images, options.rpc_formats)]
        names += [name for view in views for name in grid_names(view, options)]
    return [*names, f"{TABLES_FOLDER}/{PRIOR}"]


def _is_pair(stem: str, names: Set[str]) -> bool:
    """Return whether a file name is two view names with __ between them; either may hold one, too."""
    parts = stem.split("__")
    cuts = (("__".join(parts[:i]), "__".join(parts[i:])) for i in range(1, len(parts)))
    return any(a in names and b in names for a, b in cuts)


def refuse_shadows(folder: Path, names: Sequence[str]) -> None:
    """Raise if a file in the folder, not of barpc, would be read in place of an RPC that is to be written."""
    own = (own_files(folder) if folder.is_dir() else set()).union(names)
    for name in names if folder.is_dir() else ():
        for sidecar in sidecars(folder / name) if name.endswith((".vrt", ".tif")) else ():
            read_first = sidecar.kind == "geom" or (sidecar.before_tag and not name.endswith(".vrt"))
            if read_first and sidecar.path.name not in own:
                raise OutputError(
                    f"{sidecar.path}: lies beside {name} and would be read in place of the new RPC; "
                    "move it away, or give another -o"
                )


def write_tables(workspace: Workspace, run: Run, summary: Summary) -> Summary:
    """Write the tables, report.html where jinja2 is there, and summary.json last: with it a folder is complete.

    Returns the summary with the stages that this took.
    """
    stages, start = summary.stages, len(workspace.stages)

    def now() -> Summary:
        return replace(summary, stages=(*stages, *map(StageEntry.read, workspace.stages[start:])))

    with workspace.stage("tables"):
        for name, content in TABLES.items():
            with workspace.output(f"{TABLES_FOLDER}/{name}") as partial:
                partial.write_bytes(content(run, summary))
        if run.reference is not None and run.reference.control is not None and run.adjustment is not None:
            workspace.write_text(GCPS, gcps_geojson(run).decode())
    with workspace.stage(REPORT):
        if can_render():
            workspace.write_text("report.html", report_html(now(), workspace.folder))
        # the report shows times and may be made again: it is no result
    results = sorted((name, sha) for name, sha in workspace.outputs.items() if name != "report.html")
    summary = replace(summary, outputs=tuple(OutputEntry(name, sha) for name, sha in results))
    texts = {key: _json(value) for key, value in plain(summary).items()}
    texts["stages"] = _json(plain(now().stages))
    body = ",\n".join(f"{json.dumps(key)}: {text}" for key, text in texts.items())
    workspace.write_text(LAST, f"{{\n{body}\n}}\n")
    return now()


def _json(value: Any) -> str:
    """Return a value as JSON, an item of a list a line."""
    if not isinstance(value, list):
        return json.dumps(value)
    return "[\n" + ",\n".join(map(json.dumps, value)) + "\n]" if value else "[]"
