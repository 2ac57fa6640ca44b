"""Results of a run for people and programs: summary.json, tables, the report."""

from __future__ import annotations

from barpc.report.outcome import Run
from barpc.report.summary import Summary
from barpc.report.verdict import summarize

__all__ = ["Run", "Summary", "summarize"]
