"""The summary of a run, measured: the records of `barpc.report.summary` are made here, each by a module of its own."""

from __future__ import annotations

import platform
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from barpc import __version__
from barpc.report.measures.block import measure_scene
from barpc.report.measures.ground_points import (
    measure_check_points,
    measure_control,
    measure_gcps,
    measure_reference,
)
from barpc.report.measures.pairs import measure_pairs
from barpc.report.outcome import Run
from barpc.report.records import json_form
from barpc.report.summary import (
    SCHEMA,
    CarriedEntry,
    LeftOutEntry,
    StageEntry,
    Summary,
    TablesEntry,
    TracksEntry,
)
from barpc.report.summary.views import ViewEntry


def _versions() -> dict[str, str]:
    """Return the versions of the libraries in use."""
    names = {"numpy": "numpy", "scipy": "scipy", "cv2": "opencv", "rasterio": "rasterio", "shapely": "shapely"}
    return {name: str(sys.modules[module].__version__) for module, name in names.items() if module in sys.modules}


def measure_run(run: Run, views: tuple[ViewEntry, ...], verdict: Mapping[str, Any]) -> Summary:
    """Return the summary of a run, with its views and the verdict on it; numbers may be NaN."""
    usable, written = int(np.isfinite(run.ground).all(axis=1).sum()), len(run.written_tracks)
    lengths = np.bincount(np.bincount(run.tracks.point))
    return Summary(
        schema=SCHEMA,
        barpc=__version__,
        kind=run.kind,
        **verdict,
        out_dir=run.out_dir,
        altitude_m=run.altitude,
        views=views,
        pairs=measure_pairs(run),
        left_out=tuple(LeftOutEntry(path, reason) for path, reason in run.left_out),
        tracks=TracksEntry(
            num_tracks=run.tracks.num_points,
            num_observations=len(run.tracks),
            by_length={str(n): int(count) for n, count in enumerate(lengths) if n and count},
        ),
        tables=TablesEntry(usable, written, complete=written == usable),
        scene=measure_scene(run),
        gcps=measure_gcps(run),
        control_test=measure_control(run),
        check_points=measure_check_points(run),
        reference=measure_reference(run),
        carried=tuple(
            CarriedEntry(one.view.name, one.view.path, one.lead, json_form(one.written)) for one in run.carried
        )
        or None,
        stages=tuple(StageEntry.read(stage) for stage in run.stages),
        options=json_form(run.options),
        versions={"python": platform.python_version(), **_versions()},
    )
