"""Results of a run for people and programs: summary.json, tables, the report.

The names below are imported when first used: what a finished run says is read without what measured it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from barpc.base import used_later

if TYPE_CHECKING:
    from barpc.report.outcome import Run
    from barpc.report.summary import Summary
    from barpc.report.verdict import summarize

__all__ = ["Run", "Summary", "summarize"]
__getattr__ = used_later(__name__, {"Run": "outcome", "Summary": "summary", "summarize": "verdict"})
