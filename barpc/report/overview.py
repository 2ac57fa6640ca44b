"""Many runs at a glance: a row each, with the verdict, figures and reasons."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from barpc.base.errors import InputError
from barpc.base.keywords import PathLike
from barpc.pointio.names import cell
from barpc.report.finished import FinishedRun
from barpc.report.records import json_form
from barpc.report.summary.words import median

NO_RUN = "none"  # in place of the status
_ENU = "east", "north", "up"
RUN_COLUMNS = (
    "run", "status", "passed", "kind", "images", "left_out", "tie_points", "rmse_before_px", "rmse_after_px",
    *(f"moved_{axis}_m" for axis in _ENU), *(f"sigma_{axis}_m" for axis in _ENU), "gcps", "check_points",
    "headline", "reasons",
)  # fmt: skip


def overview(folders: Sequence[PathLike]) -> list[dict[str, Any]]:
    """Return a row of `RUN_COLUMNS` for each folder; without a finished run the reason, `status` is "none"."""
    rows: list[dict[str, Any]] = json_form([_run_row(os.fspath(folder)) for folder in folders])
    return rows


def _run_row(folder: str) -> dict[str, Any]:
    try:
        run = FinishedRun.open(folder).summary
    except InputError as error:
        return {**dict.fromkeys(RUN_COLUMNS), "run": folder, "status": NO_RUN, "passed": False, "reasons": str(error)}
    rmse = (median(getattr(view, key) for view in run.views) for key in ("rmse_before", "rmse_after"))
    moved, sigma = ((None,) * 3,) * 2 if run.scene is None else (run.scene.shift_enu_m, run.scene.sigma_enu_m)
    counts = len(run.views), len(run.left_out), run.tracks.num_tracks
    said = len(run.gcps), len(run.check_points), run.headline, " ".join(run.reasons)
    figures = run.status, run.passed, run.kind, *counts, *rmse, *moved, *sigma, *said
    return dict(zip(RUN_COLUMNS, (folder, *figures), strict=True))


def as_csv(rows: Sequence[dict[str, Any]]) -> str:
    """Return rows as CSV with a header; what is not known is empty."""
    return "\n".join([",".join(RUN_COLUMNS), *(",".join(map(_text, row.values())) for row in rows)])


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return cell(value) if isinstance(value, str) else "" if value is None else str(value).lower()
