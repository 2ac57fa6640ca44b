"""Results of a run for people and programs: summary.json, tables, the report. Names are imported when used."""

from importlib import import_module

TYPE_CHECKING = False  # as of `typing`, whose import is most of what `import barpc` would cost

if TYPE_CHECKING:
    from typing import Any

    from barpc.report.outcome import Run
    from barpc.report.summary import Summary
    from barpc.report.verdict import summarize

_MODULES = {"Run": "outcome", "Summary": "summary", "summarize": "verdict"}
__all__ = ["Run", "Summary", "summarize"]


def __getattr__(name: str) -> "Any":
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
