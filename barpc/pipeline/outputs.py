"""The corrected RPCs as files, each reopened and compared before it counts as written."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from barpc.errors import OutputError
from barpc.fit import RpcFit
from barpc.geodesy import Array
from barpc.report import Run
from barpc.report.page import can_render, report_html
from barpc.report.tables import TABLES
from barpc.rpcio import FORMATS, read_rpc, write_rpc, write_rpc_copy, write_rpc_vrt
from barpc.scene import View
from barpc.sensor import SensorModel
from barpc.workspace import Workspace

SUFFIXES = {"txt": "_RPC.TXT", "rpb": ".RPB", "geom": ".geom", "json": ".rpc.json", "xml": ".rpc.xml"}
"""RPC file written for each format, after the view's name."""

REOPENED = 1e-5
"""A reopened file that differs from the RPC it was made of by more than this [px] is an error."""


def check_grid(model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float]) -> Array:
    """Ground points (N, 3) over an image and an altitude range, off the nodes of any fit."""
    t = (np.arange(9) + 0.37) / 9.74
    col, row, alt = np.meshgrid(
        t * (size[0] - 1), t * (size[1] - 1), alt_range[0] + t * (alt_range[1] - alt_range[0]), indexing="ij"
    )
    ground = model.localize(np.column_stack([col.ravel(), row.ravel()]), alt.ravel())
    return ground[np.isfinite(ground).all(axis=1)]


def write_view(
    run: Workspace, view: View, fit: RpcFit, model: SensorModel, images: str, formats: Sequence[str]
) -> dict[str, float]:
    """Write one view's corrected RPC and reopen every file.

    Parameters
    ----------
    run : Workspace
        Where to.
    view : View
        The image.
    fit : RpcFit
        Its refitted RPC.
    model : SensorModel
        P_BA, which the files must reproduce.
    images : {"vrt", "copy", "none"}
        What carries the RPC.
    formats : sequence of str
        RPC files to write, keys of `SUFFIXES`.

    Returns
    -------
    written : dict of str to float
        File name to the largest difference to P_BA [px] of what was read back.

    Raises
    ------
    OutputError
        A file cannot be written, or does not read back.
    """
    ground = check_grid(model, view.size, view.alt_range)
    truth = model.project(ground)
    own = np.abs(fit.rpc.project(ground) - truth).max()
    written = {}
    names = {"vrt": [f"{view.name}.vrt"], "copy": [f"{view.name}.tif"], "none": []}[images]
    for name in names + [view.name + SUFFIXES[key] for key in formats]:
        with run.output(name) as partial:
            if name.endswith(".vrt"):
                write_rpc_vrt(fit.rpc, view.path, partial, overwrite=True)
            elif name.endswith(".tif"):
                write_rpc_copy(fit.rpc, view.path, partial, overwrite=True)
            else:
                write_rpc(fit.rpc, partial, overwrite=True)
            difference = float(np.abs(read_rpc(partial).project(ground) - truth).max())
            if not difference <= own + REOPENED:
                raise OutputError(
                    f"{run.folder / name}: reads back {difference:.3g} px off; is the disk full or a sidecar beside it?"
                )
        written[name] = difference
    return written


def write_tables(workspace: Workspace, run: Run, summary: Mapping[str, Any]) -> None:
    """The tables, report.html where jinja2 is installed, and summary.json last: a folder with it is complete.

    Parameters
    ----------
    workspace : Workspace
        Where to.
    run : Run
        What was found.
    summary : mapping
        Its summary.
    """
    for name, content in TABLES.items():
        with workspace.output(name) as partial:
            partial.write_bytes(content(run, summary))
    if can_render():
        workspace.write_text("report.html", report_html(summary, workspace.folder))
    workspace.write_text("summary.json", json.dumps(summary, indent=1) + "\n")


def unknown_formats(formats: Sequence[str]) -> list[str]:
    """Names that are not formats barpc writes."""
    return [name for name in formats if name not in SUFFIXES or name not in FORMATS]
