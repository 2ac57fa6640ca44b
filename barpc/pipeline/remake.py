"""The report of a finished run, made again."""

from __future__ import annotations

from pathlib import Path

from barpc.base.errors import BarpcError
from barpc.base.keywords import PathLike
from barpc.base.manifest import REPORT_FILE
from barpc.report.finished import FinishedRun
from barpc.report.page import can_render, page_of
from barpc.workspace import Workspace


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
