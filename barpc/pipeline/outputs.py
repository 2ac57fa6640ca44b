"""The corrected RPCs as files, each reopened and compared before it counts as written."""

from __future__ import annotations

import json
from collections.abc import Sequence, Set
from pathlib import Path

import numpy as np

from barpc.errors import OutputError
from barpc.fit import RpcFit
from barpc.handoff import verify
from barpc.options import RunOptions
from barpc.pipeline.inputs import PRIOR
from barpc.report import Run, Summary
from barpc.report.page import can_render, report_html
from barpc.report.records import plain
from barpc.report.tables import TABLES, gcps_geojson
from barpc.rpcio import CARRIERS, WRITABLE, sidecars, write_camera
from barpc.scene import View
from barpc.sensor import SensorModel
from barpc.workspace import Workspace, own_files

MATCHES = ("matches.csv", "matches.npz")
GCPS = "gcps.geojson"  # of a reference

REOPENED = 1e-5
"""A reopened file may differ from P_BA by the error of the fit and this [px] more (15-digit printing)."""


def write_view(
    run: Workspace, view: View, fit: RpcFit, model: SensorModel, images: str, formats: Sequence[str]
) -> dict[str, dict[str, float | str]]:
    """Write one view's corrected RPC, and open every file again as its consumers do.

    File name -> consumer -> its largest difference to P_BA, `model` [px], or why it does not read the file. OutputError
    where a file cannot be written, or barpc and GDAL do not read it back.
    """
    names = file_names(view, images, formats)
    for name in names:
        with run.output(name) as partial:
            write_camera(fit.rpc, partial, view.path, place=run.folder / name, overwrite=True)
    largest = float(np.linalg.norm(fit.max_ckp)) + REOPENED
    written: dict[str, dict[str, float | str]] = {name: {} for name in names}
    for reading in verify([run.folder / name for name in names], model, view.size, view.alt_range):
        own = reading.consumer in ("barpc", "gdal")
        if own and not reading.max_error <= 2 * largest:
            raise OutputError(
                f"{reading.path}: {reading.consumer} reads it {reading.max_error:.3g} px off ({reading.note}); "
                "is the disk full, or another RPC file beside it?"
            )
        written[reading.path.name][reading.consumer] = reading.note or reading.max_error
    return written


def file_names(view: View, images: str, formats: Sequence[str]) -> list[str]:
    """The files that `write_view` writes for a view."""
    ends = [CARRIERS[images].suffixes[0]] if images in CARRIERS else []
    return [view.name + end for end in (*ends, *(WRITABLE[key].beside for key in formats))]


def output_names(views: Sequence[View], options: RunOptions, folder: Path) -> list[str]:
    """The outputs of a run, before it starts; of the tie points of pairs those that are in the folder."""
    names = [*TABLES, "summary.json", *(["report.html"] if can_render() else [])]
    names += [GCPS] * bool(options.reference)
    if options.stop_after == "matching":
        stems = {view.name for view in views}
        pairs = [path.name for path in (folder / "asp").glob("*__*.txt") if _is_pair(path.stem, stems)]
        return [*names, *MATCHES, *(f"asp/{name}" for name in pairs)]
    if options.stop_after == "all":
        names += [name for view in views for name in file_names(view, options.images, options.rpc_formats)]
    return [*names, PRIOR]


def _is_pair(stem: str, names: Set[str]) -> bool:
    """Whether a file name is two view names with __ between them; either may hold one, too."""
    parts = stem.split("__")
    cuts = (("__".join(parts[:i]), "__".join(parts[i:])) for i in range(1, len(parts)))
    return any(a in names and b in names for a, b in cuts)


def refuse_shadows(folder: Path, names: Sequence[str]) -> None:
    """Raise if a file in the folder, not of barpc, would be read in place of an RPC that is to be written."""
    own = own_files(folder) if folder.is_dir() else set()
    for name in names if folder.is_dir() else ():
        for sidecar in sidecars(folder / name) if name.endswith((".vrt", ".tif")) else ():
            read_first = sidecar.kind == "geom" or (sidecar.before_tag and not name.endswith(".vrt"))
            if read_first and sidecar.path.name not in own.union(names):
                raise OutputError(
                    f"{sidecar.path}: lies beside {name} and would be read in place of the new RPC; "
                    "move it away, or give another -o"
                )


def write_tables(workspace: Workspace, run: Run, summary: Summary) -> None:
    """The tables, report.html where jinja2 is installed, and summary.json last: a folder with it is complete."""
    for name, content in TABLES.items():
        with workspace.output(name) as partial:
            partial.write_bytes(content(run, summary))
    if run.reference is not None and run.reference.control is not None and run.adjustment is not None:
        workspace.write_text(GCPS, gcps_geojson(run).decode())
    if can_render():
        workspace.write_text("report.html", report_html(summary, workspace.folder))
    workspace.write_text("summary.json", json.dumps(plain(summary), indent=1) + "\n")
