"""Results of a run for people and programs: summary.json, tables, the report. Names are imported when used."""

from barpc.base import used_later

TYPE_CHECKING = False  # as of `typing`, whose import is most of what `import barpc` would cost

if TYPE_CHECKING:
    from barpc.report.outcome import Run
    from barpc.report.summary import Summary
    from barpc.report.verdict import summarize

__all__ = ["Run", "Summary", "summarize"]
__getattr__ = used_later(
    __name__, {"Run": f"{__name__}.outcome", "Summary": f"{__name__}.summary", "summarize": f"{__name__}.verdict"}
)
