"""What a run looks like on the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

Summary = Mapping[str, Any]


def print_summary(summary: Summary) -> None:
    """The verdict, a table of views and a table of pairs, on stdout."""
    console = Console(highlight=False)
    console.print(_views(summary))
    if summary["pairs"]:
        console.print(_pairs(summary))
    for line in summary["verdict"]:
        console.print(line, soft_wrap=True)
    if summary.get("out_dir"):
        console.print(f"Written to {summary['out_dir']}", soft_wrap=True)


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _views(summary: Summary) -> Table:
    adjusted = summary["kind"] == "adjust"
    title = "Reprojection error of the tie points"
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    table.add_column("image", overflow="fold")
    after = ("after [px]", "rotation [urad]", "moved [m]", "RPC fit [px]")
    for name in ("tie points", "before [px]", *(after if adjusted else ())):
        table.add_column(name, justify="right")
    for view in summary["views"]:
        row = [view["name"], str(view["num_observations"]), _number(view["rmse_before"])]
        if adjusted:
            correction, fit = view["correction"], view["fit"]
            row += [
                _number(view["rmse_after"]),
                "-" if correction is None else f"{correction['angle_urad']:.1f}",
                "-" if correction is None else f"{correction['translation_norm_m']:.2f}",
                "-" if fit is None else f"{max(fit['max_px']):.0e}",
            ]
        table.add_row(*row)
    return table


def _pairs(summary: Summary) -> Table:
    adjusted = summary["kind"] == "adjust"
    title = "Epipolar offset: median and spread (1.4826 MAD) across the epipolar line"
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    table.add_column("pair", overflow="fold")
    for name in ("matches", "angle [deg]", "before [px]", *(("after [px]",) if adjusted else ())):
        table.add_column(name, justify="right")
    for pair in summary["pairs"]:
        row = [f"{pair['a']} - {pair['b']}", str(pair["num_matches"]), _number(pair["convergence_deg"], 1)]
        for when in ("before", "after")[: 1 + adjusted]:
            offset = pair[f"epipolar_{when}"]
            row.append("-" if offset is None else f"{offset['median']:+.3f} ± {offset['spread']:.3f}")
        table.add_row(*row)
    return table
