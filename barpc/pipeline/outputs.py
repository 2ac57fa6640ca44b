"""The corrected RPCs as files, each reopened and compared before it counts as written."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence, Set
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from barpc.base.errors import BarpcError, InputError, OutputError
from barpc.base.geodesy import Array
from barpc.base.identity import take
from barpc.base.options import RunOptions
from barpc.base.remote import is_url
from barpc.cameras import open_camera
from barpc.fit import RpcFit
from barpc.pipeline.beyond import REOPENED, RESAMPLED, grid_names, made_in_room
from barpc.pipeline.executor import CachingExecutor, by_groups
from barpc.pipeline.handoff import verify
from barpc.pipeline.inputs import PRIOR
from barpc.report import Run, Summary
from barpc.report.page import NAME, REPORT, can_render, report_html
from barpc.report.records import plain
from barpc.report.runfiles import FOLDER, TABLES, gcps_geojson, read_summary
from barpc.report.summary import OutputEntry, StageEntry
from barpc.report.summary.views import ViewEntry
from barpc.rpcio import CARRIERS, WRITABLE, row_of, sidecars, write_camera
from barpc.rpcio.grids import CORRECTION, GRID
from barpc.scene import View
from barpc.sensor import SensorModel
from barpc.sensor.geometry import ground_grids
from barpc.sensor.rpc import RPC
from barpc.tie.tasks import Progress
from barpc.workspace import LAST, Workspace, own_files

MATCHES = ("matches.csv", "matches.npz")
GCPS = f"{FOLDER}/gcps.geojson"  # of a reference


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
            return list(chain(*by_groups(fresh, verify_group, again, (), "verify", progress)))


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


def verify_group(group: Sequence[tuple[Sequence[str], View, RpcFit, SensorModel]]) -> list[Written]:
    """Return what `verify_files` says of some views, whose cameras are asked at once where they see the ground."""
    grids = ground_grids([(model, view.size, view.alt_range) for _, view, _, model in group])
    return [verify_files(*one, grid) for one, grid in zip(group, grids, strict=True)]


def verify_files(
    paths: Sequence[str], view: View, fit: RpcFit, model: SensorModel, grid: Array | None = None
) -> Written:
    """Open the files of a view as their consumers do; OutputError where barpc or GDAL reads another camera."""
    largest = float(np.linalg.norm(fit.max_ckp)) + REOPENED
    written: Written = {Path(path).name: {} for path in paths}
    readings = verify([Path(path) for path in paths], model, view.size, view.alt_range, grid)
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
    names = [*(f"{FOLDER}/{name}" for name in TABLES), LAST]
    names += [NAME] * can_render() + [GCPS] * bool(options.reference)
    if options.stop_after == "matching":
        stems = {view.name for view in views}
        pairs = [path.name for path in (folder / "asp").glob("*__*.txt") if _is_pair(path.stem, stems)]
        return [*names, *MATCHES, *(f"asp/{name}" for name in pairs)]
    if options.stop_after == "all":
        names += [name for view in views for name in file_names(view, options.images, options.rpc_formats)]
        names += [name for view in views for name in grid_names(view, options)]
    return [*names, f"{FOLDER}/{PRIOR}"]


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
            with workspace.output(f"{FOLDER}/{name}") as partial:
                partial.write_bytes(content(run, summary))
        if run.reference is not None and run.reference.control is not None and run.adjustment is not None:
            workspace.write_text(GCPS, gcps_geojson(run).decode())
    with workspace.stage(REPORT):
        if can_render():
            workspace.write_text(NAME, report_html(now(), workspace.folder))
        # the report shows times and may be made again: it is no result
    results = sorted((name, sha) for name, sha in workspace.outputs.items() if name != NAME)
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


# --- whether a finished run is still what it was ----------------------------------------------------------


SAME, MOVED, CHANGED, MISSING, UNKNOWN = "same", "moved", "changed", "missing", "not asked"
GOOD = (SAME, MOVED)


@dataclass(frozen=True)
class Proved:
    """What became of a file: its `kind` (input, output or camera), a word for its state, and details."""

    kind: str
    file: str
    now: str
    note: str = ""


def prove(folder: Path, places: Sequence[Path] = ()) -> list[Proved]:
    """Compare a run with what its summary says of it; inputs that are gone are looked for by name in `places`.

    InputError where the folder holds no finished run, or one of a release that hashed nothing.
    """
    summary = read_summary(folder)
    if summary.inputs is None or summary.outputs is None:
        raise InputError(f"{folder}: its summary holds no hashes: an older release wrote it; run the adjustment again")
    return [
        *_inputs(summary, (folder, folder.parent, *places)),
        *_outputs(summary, folder),
        *_cameras(summary, folder),
    ]


def _inputs(summary: Summary, places: Iterable[Path]) -> Iterator[Proved]:
    for one in summary.inputs or ():
        if is_url(one.path):
            yield Proved("input", one.path, UNKNOWN, "on another host")
            continue
        found = _digest(Path(one.path))
        if found == one.sha256:
            yield Proved("input", one.path, SAME)
            continue
        elsewhere = (place / Path(one.path).name for place in places)
        moved = next((str(path) for path in elsewhere if _digest(path) == one.sha256), None)
        if moved is not None:
            yield Proved("input", one.path, MOVED, f"it is {moved}")
        else:
            yield Proved("input", one.path, MISSING if found is None else CHANGED)


def _outputs(summary: Summary, folder: Path) -> Iterator[Proved]:
    for one in summary.outputs or ():
        found = _digest(folder / one.file)
        now = SAME if found == one.sha256 else MISSING if found is None else CHANGED
        yield Proved("output", one.file, now)


def _cameras(summary: Summary, folder: Path) -> Iterator[Proved]:
    for view in summary.views:
        for name, consumers in view.outputs.items():
            stated = consumers.get("barpc")
            if view.certified and isinstance(stated, float) and _holds_camera(folder / name):
                yield _camera(view, folder / name, name, stated)


def _holds_camera(path: Path) -> bool:
    """Return whether a file holds the camera of its whole image: a resampled image has its own."""
    if path.name.endswith(RESAMPLED):
        return False
    return path.name.endswith((GRID, CORRECTION)) or row_of(path) is not None


def _camera(view: ViewEntry, path: Path, name: str, stated: float) -> Proved:
    """Read the camera of a file as a reader finds it: another file beside it may go before."""
    points = np.array(view.certified)
    try:
        off = np.linalg.norm(open_camera(path).model.project(points[:, :3]) - points[:, 3:], axis=1)
    except (BarpcError, OSError) as error:
        return Proved("camera", name, MISSING if not path.exists() else CHANGED, str(error))
    if off.max() <= stated + REOPENED:
        return Proved("camera", name, SAME)
    far = f"reads {off.max():.3g} px off the certified camera, {stated:.1g} stated"
    return Proved("camera", name, CHANGED, far)


def _digest(path: Path) -> str | None:
    try:
        return take(path).sha256 if path.is_file() else None
    except OSError:
        return None


def remake_report(folder: Path | str) -> Path:
    """Make report.html of a finished run again, from its files.

    Raises
    ------
    InputError
        The folder holds no finished run.
    OutputError
        There is a report.html that barpc did not write, or that was changed since.
    BarpcError
        jinja2 is not installed.
    """
    folder = Path(folder)
    summary = read_summary(folder)
    if not can_render():
        raise BarpcError("the report needs jinja2: pip install 'barpc[report]'")
    html = report_html(summary, folder)
    with Workspace(folder, overwrite=True, names=[NAME], adds=True) as workspace:
        workspace.write_text(NAME, html)
    return folder / NAME
