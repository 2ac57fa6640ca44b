"""The corrected RPCs as files, each reopened and compared before it counts as written."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence, Set
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from barpc.base import manifest
from barpc.base.atomic import STATE
from barpc.base.errors import BarpcError, InputError, OutputError, listed
from barpc.base.geodesy import Array
from barpc.base.identity import fingerprint
from barpc.base.keywords import PathLike
from barpc.base.manifest import LAST, REPORT_FILE, SUMS, Layer
from barpc.base.options import RunOptions
from barpc.base.remote import is_url
from barpc.base.sealed import Sealed
from barpc.cameras import open_camera
from barpc.fit import RpcFit
from barpc.pipeline.executor import CachingExecutor, by_groups
from barpc.pipeline.grid_outputs import REOPENED, RESAMPLED, Written, grid_names, made_in_room
from barpc.pipeline.verify_outputs import verify
from barpc.report import Run, Summary
from barpc.report.finished import FinishedRun
from barpc.report.geopackage import geopackage
from barpc.report.page import REPORT_STAGE, can_render, page_of, report_html
from barpc.report.records import json_form
from barpc.report.runfiles import (
    FOLDER,
    IMAGES,
    PICTURES,
    PRIOR_FILE,
    TABLES,
    gcps_geojson,
    map_layers,
    read_summary,
)
from barpc.report.summary import OutputEntry
from barpc.report.summary.views import ViewEntry
from barpc.rpcio import CARRIERS, WRITABLE, format_for, hidden_by, sidecars, write_camera
from barpc.rpcio.grids import CORRECTION, GRID_SUFFIX
from barpc.scene import View
from barpc.sensor import SensorModel
from barpc.sensor.geometry import ground_grids
from barpc.sensor.rpc import RPC
from barpc.tie.tasks import Progress
from barpc.workspace import Workspace, own_files

MATCH_FILES = ("matches.csv", "matches.npz")
GCP_FILE = f"{FOLDER}/gcps.geojson"  # of a reference
MAP_FILE = "map.gpkg"


Fitted = tuple[View, RpcFit, SensorModel]  # a view, its refitted RPC and P_BA


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
            write_camera(rpc, place / name, view.path, place=Path(folder) / name, overwrite=True, size=view.size)
        except OSError as error:
            if isinstance(error, OutputError) or error.errno is None:
                raise
            raise OutputError(f"{Path(folder) / name}: cannot be written ({error.strerror})") from error
    return tuple(names)


def verify_group(group: Sequence[tuple[Sequence[str], View, RpcFit, SensorModel]]) -> list[Written]:
    """Return the results of `verify_files` for some views, whose cameras are evaluated together."""
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
        names += [name for view in views for name in grid_names(view, options)]
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


# --- whether a finished run is still what it was ----------------------------------------------------------


SAME, MOVED, LATER, NOT_ASKED = "same", "moved", "later", "not asked"
PASSED_STATES = (SAME, MOVED, LATER, NOT_ASKED)
CHANGED, MISSING, ADDED = "changed", "missing", "added"


@dataclass(frozen=True)
class Proved:
    """The state of a verified file: its `kind` (root, input, output or camera), a word for the state, and details."""

    kind: str
    file: str
    now: str
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether the file counts as unchanged."""
        return self.now in PASSED_STATES


class Verification(tuple[Proved, ...]):
    """The state of every file of a folder, a `Proved` each; it is false where one of them has changed."""

    def __bool__(self) -> bool:
        return all(one.passed for one in self)

    def __repr__(self) -> str:
        wrong = [f"{one.file} {one.now}" for one in self if not one.passed]
        return f"Verification({len(self)} files, {listed(wrong, 3) or 'none has changed'})"


def prove(
    folder: Path, places: Sequence[Path] = (), expected: str | None = None, progress: Progress | None = None
) -> list[Proved]:
    """Compare a run, or an export, with its SHA256SUMS, and that with an `expected` root, of any of its layers.

    Inputs that are gone are looked for by name in `places`. InputError where SHA256SUMS is missing or damaged.
    """
    if not os.path.lexists(folder / SUMS):
        read_summary(folder)
    sealed = Sealed.open(folder)
    root, layers, noted, listed = sealed.root, sealed.layers, sealed.noted, sealed.listed
    roots = {root, *(layer.after for layer in layers[1:])}
    tell = progress or (lambda *_: None)
    found = [*_roots(root, noted.get(SUMS, root), layers, expected)]
    for number, one in enumerate(_outputs(folder, listed, noted, roots), start=1):
        tell("verify outputs", min(number, len(listed)), len(listed))  # more of them where files were added
        found.append(one)
    for path, image, _ in hidden_by(folder / name for name in listed if name not in layers[0].files):
        if image.name in layers[0].files:  # no command of barpc writes such a file
            found.append(Proved("output", path.name, ADDED, f"for some tools it goes before the RPC of {image.name}"))
    if LAST in listed:
        try:
            summary = read_summary(folder)
        except InputError as error:
            return [*found, Proved("input", LAST, MISSING, f"what it says of inputs: {error}")]
        for number, one in enumerate(_inputs(summary, sealed, places), start=1):
            tell("verify inputs", number, len(summary.inputs or ()))
            found.append(one)
        found += _verify_cameras(summary, folder)
    return found


def _roots(root: str, noted: str, layers: Sequence[Layer], expected: str | None) -> Iterator[Proved]:
    """Yield the state of SHA256SUMS against the expected root, now or before a later layer, and later files."""
    if noted != root != expected:
        yield Proved("root", SUMS, CHANGED, f"its root is {root}, and {noted} was noted")
    elif expected in (None, root):
        yield Proved("root", SUMS, SAME, f"{root}, layer {len(layers)} of {len(layers)}")
    if expected in (None, root):
        return
    number = next((k for k in range(1, len(layers)) if layers[k].after == expected), 0)
    if not number or manifest.root_of(layers[:number]) != expected:
        yield Proved("root", SUMS, CHANGED, f"its root is {root}, and none of its {len(layers)} layers has {expected}")
        return
    yield Proved("root", SUMS, SAME, f"{expected}, layer {number} of {len(layers)}")
    before = {name for layer in layers[:number] for name in layer.files}
    for name in sorted({name for layer in layers[number:] for name in layer.files}):
        yield Proved("root", name, LATER, "made again after that root" if name in before else "added after that root")


def _outputs(folder: Path, listed: Mapping[str, str], noted: Mapping[str, str], roots: Set[str]) -> Iterator[Proved]:
    """Compare every file with its `listed` hash; one that is `noted` otherwise is of a command that was ended.

    Of folders below with a SHA256SUMS, exports of a run with one of the `roots` are compared, too.
    """
    for name, sha in sorted(listed.items()):
        found = _file_digest(folder / name)
        now = SAME if found == sha else MISSING if found is None else CHANGED
        yield Proved("output", name, now, _ENDED if found == noted.get(name) and now == CHANGED else "")
    parents = {parent.as_posix() for name in listed for parent in PurePosixPath(name).parents}
    for name, below in _folder_files(folder, parents):
        if below is None and name not in listed and name != SUMS:
            yield Proved("output", name, ADDED, _ENDED if name in noted else "by nobody who noted it")
        elif below is not None and manifest.read(below)[1][0].after in roots:  # an export of this run
            yield from (replace(one, file=f"{name}/{one.file}") for one in prove(below))
        elif below is not None:
            yield Proved("output", name, NOT_ASKED, f"not of this run: barpc verify {below}")


_ENDED = "by a command that did not come to its end: give it again"


def _folder_files(folder: Path, parents: Set[str]) -> Iterator[tuple[str, Path | None]]:
    """Yield every file and link in a folder by name, but its state; of a folder below with a SHA256SUMS only that."""

    def refuse(error: OSError) -> None:
        raise InputError(f"{error.filename}: cannot be read ({error.strerror})")

    for top, folders, files in os.walk(folder, onerror=refuse):
        at, no_folders, kept = Path(top).relative_to(folder), set(files), []
        for name in sorted([*folders, *files]):
            path, known = folder / at / name, (at / name).as_posix()
            if name in no_folders or path.is_symlink():
                yield known, None
            elif (path / SUMS).is_file() and known not in parents:
                yield known, path
            elif known != STATE:
                kept.append(name)
        folders[:] = kept


def _inputs(summary: Summary, sealed: Sealed, places: Sequence[Path]) -> Iterator[Proved]:
    for one in summary.inputs or ():
        if is_url(one.path):
            yield Proved("input", one.path, NOT_ASKED, "on another host")
            continue
        found = sealed.find(one.path, one.sha256, one.bytes, places, whole=True)
        if found is None:
            yield Proved("input", one.path, CHANGED if os.path.lexists(sealed.located(one.path)) else MISSING)
        elif found in sealed.seen(one.path):
            yield Proved("input", one.path, SAME)
        else:
            yield Proved("input", one.path, MOVED, f"it is {found}")


def _verify_cameras(summary: Summary, folder: Path) -> Iterator[Proved]:
    for view in summary.views:
        for name, consumers in view.outputs.items():
            stated = consumers.get("barpc")
            if view.certified and isinstance(stated, float) and _holds_camera(folder / name):
                yield _camera(view, folder / name, name, stated)


def _holds_camera(path: Path) -> bool:
    """Return whether a file holds the camera of its whole image: a resampled image has its own."""
    if path.name.endswith(RESAMPLED):
        return False
    return path.name.endswith((GRID_SUFFIX, CORRECTION)) or format_for(path) is not None


def _camera(view: ViewEntry, path: Path, name: str, stated: float) -> Proved:
    """Read the camera of a file as a reader finds it: another file beside it may go before."""
    points = np.array(view.certified)
    try:
        off = np.linalg.norm(open_camera(path).model.project(points[:, :3]) - points[:, 3:], axis=1)
    except (BarpcError, OSError) as error:
        return Proved("camera", name, MISSING if not path.exists() else CHANGED, str(error))
    if off.max() <= stated + REOPENED:
        return Proved("camera", name, SAME)
    far = f"differs from the certified camera by {off.max():.3g} px, {stated:.1g} stated"
    return Proved("camera", name, CHANGED, far)


def _file_digest(path: Path) -> str | None:
    try:
        return fingerprint(path).sha256 if path.is_file() else None
    except OSError:
        return None


def remake_report(folder: PathLike) -> Path:
    """Make report.html of a finished run again, from its files.

    Raises
    ------
    InputError
        The folder holds no finished run, or its summary or tables were changed since.
    OutputError
        There is a report.html that barpc did not write, or that was changed since.
    BarpcError
        jinja2 is not installed.
    """
    run = FinishedRun.open(folder)
    if not can_render():
        raise BarpcError("the report needs jinja2: pip install 'barpc[report]'")
    html = page_of(run.tables(of_page=True))
    with Workspace(run.folder, overwrite=True, names=[REPORT_FILE], adds=True) as workspace:
        workspace.write_text(REPORT_FILE, html)
    return run.folder / REPORT_FILE
