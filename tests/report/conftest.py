"""Simulated runs with everything in them: adjusted, refitted, tables and report written."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from barpc.ba import AdjustOptions
from barpc.base.options import RunOptions
from barpc.pipeline.outputs import write_tables
from barpc.report import Run, Summary, verdict
from barpc.report.records import json_form
from barpc.rpcio import write_rpc
from barpc.scene import View
from barpc.sensor.centers import camera_center
from barpc.simulate import simulate_block
from barpc.workspace import Workspace
from tests.sealing import seal

from .worlds import run_of

STAGE = {"stage": "adjustment", "seconds": 2.5, "cpu_seconds": 2.0, "peak_memory_mb": 150.0}


def run_of_block(
    num_views: int, num_tracks: int, *, gcps: bool = False, names: list[str] | None = None, **block_options: object
) -> Run:
    """A block adjusted and refitted, as a run."""
    block = simulate_block(num_views, num_tracks, seed=5, num_gcps=6 * gcps, attitude=3e-6, **block_options)
    if names is not None:
        views = (replace(view, name=name) for view, name in zip(block.views, names, strict=True))
        block = replace(block, views=tuple(views))
    fields = {
        "centers": tuple(camera_center(view.sensor, view.size, view.alt_range) for view in block.views),
        "written": tuple({f"{v.name}_RPC.TXT": {"gdal": 1e-9, "rpcm": "cannot read it"}} for v in block.views),
        "options": RunOptions(adjust=AdjustOptions(), gcp=("points.gcp",) if gcps else ()),
        "stages": [STAGE],
    }
    return run_of(block, gcps=block.gcps if gcps else None, run=fields)


def summarize(run: Run) -> dict[str, Any]:
    """What summary.json holds of a run."""
    return json_form(verdict.summarize(run))


def written(run: Run, folder: Path) -> dict[str, Any]:
    """Tables, RPC files, report and summary of a run in a folder; the summary as the file holds it."""
    summary = verdict.summarize(run)
    with Workspace(folder, overwrite=True) as workspace:
        summary = write_tables(workspace, run, summary)
        for view, fit in zip(run.views, run.fits, strict=bool(run.fits)):
            write_rpc(fit.rpc, folder / f"{view.name}_RPC.TXT", overwrite=True)
    seal(folder)
    return json_form(summary)


@dataclass(frozen=True)
class Finished:
    """A run, its summary, and its folder."""

    run: Run
    summary: dict[str, Any]
    folder: Path

    @property
    def record(self) -> Summary:
        """The summary as a typed record."""
        return Summary.read(self.summary)

    @property
    def views(self) -> tuple[View, ...]:
        return self.run.views


@pytest.fixture
def copied(tmp_path) -> Callable[..., Path]:
    """Copies the folder of a run, `change` made to what its summary holds."""

    def made(finished: Finished, name: str = "copy", change: Callable[[dict[str, Any]], object] | None = None) -> Path:
        shutil.copytree(finished.folder, folder := tmp_path / name)
        if change is not None:
            change(summary := json.loads((folder / "summary.json").read_text()))
            (folder / "summary.json").write_text(json.dumps(summary))
        return folder

    return made


@pytest.fixture(scope="session")
def block_run(tmp_path_factory) -> Finished:
    """Nine views over three sites with outliers and GCPs."""
    run = run_of_block(9, 1200, gcps=True, outliers=0.05)
    folder = tmp_path_factory.mktemp("block") / "run"
    return Finished(run, written(run, folder), folder)


@pytest.fixture(scope="session")
def check_run(tmp_path_factory, block_run) -> Finished:
    """The same views as delivered: nothing adjusted."""
    run = Run("check", block_run.run.views, (), block_run.run.tracks)
    folder = tmp_path_factory.mktemp("check") / "run"
    return Finished(run, written(run, folder), folder)


@pytest.fixture(scope="session")
def antimeridian_run(tmp_path_factory) -> Finished:
    """Three views of one site on the 180th meridian, with names that are hard on CSV, HTML and eyes."""
    names = ['a,"quoted" & <b>bold</b>', "x" * 60, "IMG_PHR1A_P_201304171032_SEN_0001"]
    run = run_of_block(3, 400, lon=180.0, names=names)
    run = replace(run, written=({}, {}, {}), fits=())
    folder = tmp_path_factory.mktemp("antimeridian") / "run"
    return Finished(run, written(run, folder), folder)
