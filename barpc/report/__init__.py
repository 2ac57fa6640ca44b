"""Results of a run for people and programs: summary.json, tables, the report.

The names below are imported when first used: what a finished run says is read without what measured it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from barpc.report.outcome import Run
    from barpc.report.summary import Summary
    from barpc.report.verdict import summarize

__all__ = ["Run", "Summary", "summarize"]
_MODULES = {"Run": "outcome", "Summary": "summary", "summarize": "verdict"}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
