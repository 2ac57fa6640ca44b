"""report.html: one self-contained page, made from summary.json and the tables of a run alone."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from barpc.errors import BarpcError
from barpc.plain import visible
from barpc.report.load import read_summary, read_tables
from barpc.report.sections import sections
from barpc.report.verdict import STATUS_WORDS
from barpc.workspace import Workspace

NAME = "report.html"


def can_render() -> bool:
    """Whether jinja2, which the page needs, is installed (the extra ``report``)."""
    return find_spec("jinja2") is not None


def report_html(summary: Mapping[str, Any], folder: Path | str) -> str:
    """The page of a run.

    Parameters
    ----------
    summary : mapping
        What summary.json holds.
    folder : path
        Where the run's tables lie.

    Returns
    -------
    html : str
        The same files give the same text.

    Raises
    ------
    InputError
        A table is missing or damaged.
    """
    import jinja2

    files = read_tables(summary, Path(folder))
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("barpc.report", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    template = environment.get_template("template.html.j2")
    return visible(template.render(summary=summary, sections=sections(files), words=STATUS_WORDS))


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
