"""The corrected RPCs as files, each reopened and compared before it counts as written."""

from __future__ import annotations

import json
from collections.abc import Sequence, Set
from concurrent.futures import Executor
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from barpc.base.errors import OutputError
from barpc.base.manifest import LAST, REPORT_FILE, SUMS
from barpc.base.options import RunOptions
from barpc.base.tasks import Progress
from barpc.fit import RpcFit
from barpc.pipeline.executor import CachingExecutor, by_groups
from barpc.pipeline.grid_outputs import Written, grid_names, made_in_room
from barpc.pipeline.proof import REOPENED
from barpc.pipeline.verify_outputs import verify
from barpc.report import Run, Summary
from barpc.report.geopackage import geopackage
from barpc.report.page import REPORT_STAGE, can_render, report_html
from barpc.report.records import json_form
from barpc.report.runfiles import FOLDER, IMAGES, PICTURES, PRIOR_FILE
from barpc.report.summary import OutputEntry
from barpc.report.tables import TABLES, gcps_geojson, map_layers
from barpc.rpcio import CARRIERS, WRITABLE, sidecars, write_camera
from barpc.scene import View
from barpc.sensor import SensorModel
from barpc.sensor.rpc import RPC
from barpc.sensor.sampler import Sample
from barpc.workspace import Workspace, own_files

MATCH_FILES = ("matches.csv", "matches.npz")
GCP_FILE = f"{FOLDER}/gcps.geojson"  # of a reference
MAP_FILE = "map.gpkg"


FittedView = tuple[View, RpcFit, SensorModel]  # a view, its refitted RPC and P_BA


def write_views(
    run: Workspace,
    fitted: Sequence[FittedView],
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
            return list(chain(*by_groups(fresh, verify_group, again, (), "verify", progress)))


def make_files(view: View, rpc: RPC, images: str, formats: Sequence[str], folder: str, room: str) -> tuple[str, ...]:
    """Write the files of a view into a temporary folder before they go to `folder`; return their names."""
    place, names = Path(room) / view.name, file_names(view, images, formats)
    for name in names:
        try:
            place.mkdir(parents=True, exist_ok=True)
            write_camera(rpc, place / name, view.path, place=Path(folder) / name, overwrite=True, size=view.size)
        except OSError as error:
            if isinstance(error, OutputError) or error.errno is None:
                raise
            raise OutputError(f"{Path(folder) / name}: cannot be written ({error.strerror})") from error
    return tuple(names)


def verify_group(group: Sequence[tuple[Sequence[str], View, RpcFit, SensorModel]]) -> list[Written]:
    """Return the results of `verify_files` for some views, whose cameras are evaluated together."""
    samples = Sample.grids([(model, view.size, view.alt_range) for _, view, _, model in group])
    return [verify_files(paths, fit, sample) for (paths, _, fit, _), sample in zip(group, samples, strict=True)]


def verify_files(paths: Sequence[str], fit: RpcFit, sample: Sample) -> Written:
    """Open the files of a view as their consumers do; OutputError where barpc or GDAL reads another camera."""
    largest = float(np.linalg.norm(fit.max_ckp)) + REOPENED
    written: Written = {Path(path).name: {} for path in paths}
    readings = verify(paths, sample)
    for reading in sorted(readings, key=lambda one: one.consumer != "barpc"):  # what barpc finds says more
        own = reading.consumer.partition(",")[0] in ("barpc", "gdal")  # which reads texts beside an image
        if own and not reading.max_error <= 2 * largest:
            raise OutputError(
                f"{reading.path}: {reading.consumer} reads it with an error of {reading.max_error:.3g} px "
                f"({reading.note}); is the disk full, or another RPC file beside it?"
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
    names = [*(f"{FOLDER}/{name}" for name in (*TABLES, PICTURES)), MAP_FILE, LAST, SUMS]
    names += [REPORT_FILE] * can_render() + [GCP_FILE] * bool(options.reference)
    if options.stop_after == "matching":
        stems = {view.name for view in views}
        pairs = [path.name for path in (folder / "asp").glob("*__*.txt") if _is_pair(path.stem, stems)]
        return [*names, *MATCH_FILES, *(f"asp/{name}" for name in pairs)]
    if options.stop_after == "all":
        names += [name for view in views for name in file_names(view, options.images, options.rpc_formats)]
        names += [name for view in views for name in grid_names(view)]
    return [*names, f"{FOLDER}/{IMAGES}", f"{FOLDER}/{PRIOR_FILE}"]


def _is_pair(stem: str, names: Set[str]) -> bool:
    """Return whether a file name is two view names with __ between them; either may hold one, too."""
    parts = stem.split("__")
    cuts = (("__".join(parts[:i]), "__".join(parts[i:])) for i in range(1, len(parts)))
    return any(a in names and b in names for a, b in cuts)


def refuse_shadows(folder: Path, names: Sequence[str]) -> None:
    """Raise if a file in the folder, not of barpc, would take precedence over an RPC to be written."""
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
    """Write the tables, report.html where jinja2 is there, and summary.json after them; return what that holds."""
    with workspace.stage("tables"):
        for name, content in TABLES.items():
            with workspace.output(f"{FOLDER}/{name}") as partial, partial.open("wb") as file:
                file.writelines(content(run, summary))
        with workspace.output(MAP_FILE) as partial:
            partial.write_bytes(geopackage(map_layers(run, summary)))
        if run.reference is not None and run.reference.control is not None and run.adjustment is not None:
            workspace.write_text(GCP_FILE, gcps_geojson(run).decode())
    with workspace.stage(REPORT_STAGE):
        if can_render():
            workspace.write_text(REPORT_FILE, report_html(summary, workspace.folder))
    # the report may be made again by another release, and pictures are to look at: neither is a result
    shown = REPORT_FILE, f"{FOLDER}/{PICTURES}"
    results = sorted((name, sha) for name, sha in workspace.outputs.items() if name not in shown)
    summary = replace(summary, outputs=tuple(OutputEntry(name, sha) for name, sha in results))
    texts = ",\n".join(f"{json.dumps(key)}: {_json(value)}" for key, value in json_form(summary).items())
    workspace.write_text(LAST, f"{{\n{texts}\n}}\n")
    return summary


def _json(value: Any) -> str:
    """Return a value as JSON, an item of a list a line."""
    if not isinstance(value, list):
        return json.dumps(value)
    return "[\n" + ",\n".join(map(json.dumps, value)) + "\n]" if value else "[]"
