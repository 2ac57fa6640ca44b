"""What a run looks like on the terminal.

A table takes the room there is: heads in one line, then heads broken over lines, then the first column folded,
then one block a row. No column and no unit is ever dropped; in a pipe a row is always one line.
"""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from barpc.cli.terminal import echo

Summary = Mapping[str, Any]

GAP = "  "
NARROWEST = 12
"""The first column is not folded below so many characters."""

_COLORS = {"good": "green", "look": "yellow", "bad": "red"}


def print_summary(summary: Summary) -> None:
    """The verdict, a table of views and a table of pairs, on stdout."""
    width = output_width()
    for title, table in (
        ("Reprojection error of the tie points", _views(summary)),
        ("Epipolar offset: median ± spread (1.4826 MAD) across the epipolar line", _pairs(summary)),
    ):
        if len(table) > 1:
            _echo_table(title, table, width)
    echo(summary["headline"], bold=True, fg=_COLORS[summary["status"]])
    _echo_lines(summary["verdict"], width)
    if summary.get("out_dir"):
        echo(f"Written to {summary['out_dir']}")


def print_comparison(comparison: Mapping[str, Any]) -> None:
    """Two runs side by side, on stdout."""
    width = output_width()
    echo(f"A: {comparison['a']}\nB: {comparison['b']}\n")
    heads = ["image", "points A", "points B", "error A [px]", "error B [px]", "RPCs differ [px]"]
    views = [[*heads, "without shift [px]"]]
    for view in comparison["views"]:
        differences = [view["rpc_difference_px"], view["rpc_difference_without_shift_px"]]
        counts, errors = [str(n) for n in view["num_observations"]], [_number(e) for e in view["rmse"]]
        views.append(
            [view["name"], *counts, *errors, *("-" if d is None else f"{d:.2g}" for d in differences)]
        )
    _echo_table("Reprojection error (RMS) and RPC files", views, width)
    pairs = [["pair", "matches A", "matches B", "offset A [px]", "offset B [px]"]]
    for pair in comparison["pairs"]:
        offsets = [_number(value) for value in pair["epipolar_rms"]]
        pairs.append([f"{pair['a']} - {pair['b']}", *(str(n) for n in pair["num_matches"]), *offsets])
    if len(pairs) > 1:
        _echo_table("Epipolar offset (RMS)", pairs, width)
    _echo_lines(comparison["lines"], width)


def output_width() -> int | None:
    """Columns of the terminal that stdout is; None for a pipe or a file, where lines have no end."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def layout(table: Sequence[Sequence[str]], width: int | None) -> list[str]:
    r"""Lines of a table whose first row are the heads and whose first column is text, the others numbers.

    The table has `width` columns on the terminal; None: any number.

    Examples
    --------
    >>> print("\n".join(layout([["image", "error [px]"], ["a", "0.5"]], None)))
    image  error [px]
    a             0.5
    >>> print("\n".join(layout([["image", "error [px]"], ["a", "0.5"]], 13)))
           error
    image   [px]
    a        0.5
    >>> print("\n".join(layout([["image", "error [px]"], ["a_long_long_name", "0.5"]], 14)))
    a_long_long_name
      error [px]: 0.5
    """
    heads, rows = table[0], table[1:]
    numbers = [max(map(len, column)) for column in zip(*table, strict=True)]
    if width is None or sum(numbers) + len(GAP) * (len(heads) - 1) <= width:
        return [_line(row, numbers) for row in table]
    narrow = [max(map(len, [*head.split(), *column])) for head, *column in zip(*table, strict=True)]
    room = width - sum(narrow[1:]) - len(GAP) * (len(heads) - 1)
    if room < min(narrow[0], NARROWEST):
        cells = ((f"  {head}: {cell}" for head, cell in zip(heads[1:], row[1:], strict=True)) for row in rows)
        return [line for row, block in zip(rows, cells, strict=True) for line in (row[0], *block)]
    widths = [min(narrow[0], room), *narrow[1:]]
    broken = [textwrap.wrap(head, size) for head, size in zip(heads, widths, strict=True)]
    depth = max(map(len, broken))
    lines = [
        _line(row, widths)
        for row in zip(*([""] * (depth - len(head)) + head for head in broken), strict=True)
    ]
    for row in rows:
        first, *folded = textwrap.wrap(row[0], widths[0]) or [""]
        lines += [_line([first, *row[1:]], widths), *folded]
    return lines


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    numbers = (cell.rjust(size) for cell, size in zip(row[1:], widths[1:], strict=True))
    return GAP.join([row[0].ljust(widths[0]), *numbers]).rstrip()


def _echo_table(title: str, table: Sequence[Sequence[str]], width: int | None) -> None:
    echo("\n".join([title] if width is None else textwrap.wrap(title, width)), bold=True)
    echo("\n".join(layout(table, width)) + "\n")


def _echo_lines(lines: Sequence[str], width: int | None) -> None:
    for line in lines:
        echo(line if width is None else textwrap.fill(line, width, break_on_hyphens=False))


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _views(summary: Summary) -> list[list[str]]:
    adjusted = summary["kind"] == "adjust"
    after = ("after [px]", "shift col, row [px]", "RPC fit [px]")
    table = [["image", "verdict", "tie points", "before [px]", *(after if adjusted else ())]]
    for view in summary["views"]:
        row = [view["name"], view["status"], str(view["num_observations"]), _number(view["rmse_before"])]
        if adjusted:
            shift, fit = (view["correction"] or {}).get("center_shift_px"), view["fit"]
            row += [
                _number(view["rmse_after"]),
                "-" if shift is None else f"{shift[0]:+.2f}, {shift[1]:+.2f}",
                "-" if fit is None else f"{max(fit['max_px']):.0e}",
            ]
        table.append(row)
    return table


def _pairs(summary: Summary) -> list[list[str]]:
    adjusted = summary["kind"] == "adjust"
    table = [["pair", "matches", "angle [deg]", "B/H", "before [px]", *(("after [px]",) if adjusted else ())]]
    for pair in summary["pairs"]:
        row = [f"{pair['a']} - {pair['b']}", str(pair["num_matches"]), _number(pair["convergence_deg"], 1)]
        row.append(_number(pair["base_to_height"], 2))
        for when in ("before", "after")[: 1 + adjusted]:
            offset = pair[f"epipolar_{when}"]
            row.append("-" if offset is None else f"{offset['median']:+.3f} ± {offset['spread']:.3f}")
        table.append(row)
    return table
