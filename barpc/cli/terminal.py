"""The one door to the terminal: whatever names, files and errors hold, no control character leaves it.

A table takes the room there is: heads in one line, then heads broken over lines, then the first column folded,
then one block a row. No column and no unit is ever dropped; in a pipe a row is always one line.
"""

from __future__ import annotations

import json
import logging
import shlex
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from itertools import accumulate
from typing import TYPE_CHECKING, Any

import click

from barpc.base.errors import visible
from barpc.base.fields import field_values, is_record

if TYPE_CHECKING:
    from click._termui_impl import ProgressBar

    from barpc.base.tasks import Progress
    from barpc.report import Summary


EXIT_GATE = 3
MOST_LINES = 14  # of a summary, whatever its size; with -v any number
_FIRST = 3  # sentences of the results that come before reservations: how they agree, what moved, how sure
_COMMAND = "  "  # before a command to copy
_TERMINAL_COLUMNS = 80  # columns of a terminal
_LIMITS = {
    "views": "{:,} images, none with a reservation: all {}",
    "pairs": "{:,} pairs, none with an epipolar offset of more than 0.5 px (RMS): all {}",
}
COLUMN_GAP = "  "
_REASONS = 5  # in the line that says why a run does not pass
NARROWEST = 12  # The first column of a table is not folded below so many characters
_COLORS = {"good": "green", "look": "yellow", "bad": "red"}


def wants_json() -> bool:
    """Return whether results go to stdout as JSON: `--json`, before or behind the verb."""
    return bool(_general("as_json"))


def is_quiet() -> bool:
    """Return whether errors and requested numbers alone are printed: `-q`."""
    return bool(_general("quiet"))


def _general(name: str) -> int:
    """Return how often a flag was given that every verb has."""
    context = click.get_current_context(silent=True)
    return 0 if context is None else int(context.find_root().params.get(name) or 0)


def echo(text: object = "", *, err: bool = False, nl: bool = True, **style: Any) -> None:
    """Print lines, with everything that does not print escaped; `style` as `click.style` has it."""
    click.secho(visible(str(text)), err=err, nl=nl, **style)


def say(message: str) -> None:
    """Print one line on stderr, of this command."""
    echo(f"barpc: {' '.join(message.split())}", err=True)


def remark(message: str) -> None:
    """Print one line on stderr, a remark and no error; with -q nothing."""
    if not is_quiet():
        say(message)


def tell(data: object, *lines: object) -> None:
    """Print the result of a command on stdout: its lines, or with --json its data; with -q the JSON alone."""
    if wants_json():
        echo(json.dumps(data, indent=1, default=lambda part: field_values(part) if is_record(part) else str(part)))
    else:
        for line in () if is_quiet() else lines:
            echo(line)


def tell_gate(headline: str, reasons: list[str]) -> int:
    """Say why a command that finished does not pass; its exit code."""
    more = [f"and {len(reasons) - _REASONS} more"] if len(reasons) > _REASONS else []
    say(" ".join([f"needs review (exit code {EXIT_GATE}):", headline, *reasons[:_REASONS], *more]))
    return EXIT_GATE


class Formatter(logging.Formatter):
    """Records of the log as single lines; only a traceback has more."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """Return the line of a record."""
        return visible(super().formatMessage(record).replace("\n", " "))

    def formatException(self, ei: Any) -> str:
        """Return a traceback."""
        return visible(super().formatException(ei))


def print_summary(summary: Summary) -> None:
    """Print verdict, motion, uncertainty, reservations and next commands of a run in at most `MOST_LINES` lines.

    With `-v` every sentence, below the tables of views, pairs and control.
    """
    from barpc.report.ranking import sentences

    width, folder = output_width(), shlex.quote(summary.out_dir or ".")
    results, wrong = sentences(summary)
    first, rest = results[:_FIRST], results[_FIRST:]
    head = summary.headline if summary.passed else f"{summary.headline[:-1]} (exit code {EXIT_GATE})."
    written = [f"Written to {summary.out_dir} (tables: -v, or report.html there)"] * bool(summary.out_dir)
    steps = list[str]()
    for step in summary.next:
        if step.kind != "review":
            commands = (_COMMAND + command.replace(" . ", f" {folder} ") for command in step.commands)
            steps += [step.text, *commands]
    if _general("verbose"):
        for title, texts, more in _printed_tables(summary):
            _echo_table(title, texts, width, more)
    else:
        counted = width and max(width, _TERMINAL_COLUMNS)  # nothing is dropped because a terminal is narrow
        room = MOST_LINES - 1 - sum(len(_wrapped(line, counted)) for line in [head, *first, *written])
        num = len(wrong) + len(rest)
        wrong, steps, rest = _fitting((wrong, steps, rest), room, counted)
        left = num - len(wrong) - len(rest)
        wrong += [f"And {left} more: -v, or report.html."] * bool(left)
    echo(head, bold=True, fg=_COLORS[summary.status])
    _echo_lines([*first, *rest, *wrong, *written, *steps], width)


def _fitting(groups: Sequence[Sequence[str]], room: int, width: int | None) -> Iterator[list[str]]:
    """Yield of each group the first lines that there is room for, when those of the groups before it are taken."""
    for lines in groups:
        ends = accumulate(len(_wrapped(line, width)) for line in lines)
        taken = [(line, end) for line, end in zip(lines, ends, strict=True) if end <= room]
        room -= taken[-1][1] if taken else 0
        yield [line for line, _ in taken]


def _printed_tables(summary: Summary) -> list[tuple[str, list[list[str]], str]]:
    """Return titles, cells and a remark on omitted rows: of many rows the worst of those beyond a limit are kept."""
    from barpc.report import ranking
    from barpc.report.records import table
    from barpc.report.summary.block import DATUM, DatumEntry
    from barpc.report.summary.ground_points import GCP_CAPTION, GcpEntry
    from barpc.report.summary.pairs import PairEntry
    from barpc.report.summary.views import ViewEntry

    rows = ranking.TABLE_ROWS_SHOWN
    views, pairs, adjusted = summary.views, summary.pairs, summary.adjusted
    some_views = views if len(views) <= rows else ranking.flagged(views)[:rows]
    some_pairs = pairs if len(pairs) <= rows else ranking.torn(pairs)[:rows]
    datum = () if summary.scene is None else summary.scene.datum
    if len(DatumEntry.columns(datum).split()) <= 3:  # one source holds all: the verdict says so
        datum = ()
    gcps = GcpEntry.worst(summary.gcps, rows)
    places = ("in summary.json", "in tables/pairs.csv") if summary.out_dir else ("with --json",) * 2
    wanted = (
        (table("views", ViewEntry.CAPTION, some_views, ViewEntry, ViewEntry.TERMINAL, adjusted), len(views), places[0]),
        (table("pairs", PairEntry.CAPTION, some_pairs, PairEntry, PairEntry.TERMINAL, adjusted), len(pairs), places[1]),
        (table("gcps", GCP_CAPTION, gcps, GcpEntry, GcpEntry.TERMINAL), len(summary.gcps), places[0]),
        (table("datum", DATUM, datum, DatumEntry, DatumEntry.columns(datum)), len(datum), ""),
    )
    found = []
    for shown, total, place in wanted:
        left = total - len(shown.rows)
        if total:
            more = f"{left:,} more {place}" if shown.rows else _LIMITS[shown.key].format(total, place)
            found.append((shown.caption, shown.texts if shown.rows else [], more if left else ""))
    return found


def _wrapped(text: str, width: int | None) -> list[str]:
    """Return the lines of a text; a command is one, as it is copied."""
    whole = width is None or text.startswith(_COMMAND)
    return [text] if whole else textwrap.wrap(text, width or 1, break_on_hyphens=False) or [""]


def print_comparison(comparison: Mapping[str, Any]) -> None:
    """Print two runs side by side, on stdout."""
    width = output_width()
    echo(f"A: {comparison['a']}\nB: {comparison['b']}\n")
    heads = ["image", "points A", "points B", "error A [px]", "error B [px]", "RPCs differ [px]"]
    views = [[*heads, "without shift [px]"]]
    for view in comparison["views"]:
        numbers = [*map(str, view["num_observations"]), *map(_three_decimals, view["rmse"])]
        differences = [view["rpc_difference_px"], view["rpc_difference_without_shift_px"]]
        numbers += ["-" if value is None else f"{value:.2g}" for value in differences]
        views.append([view["name"], *numbers])
    _echo_table("Reprojection error (RMS) and RPC files", views, width)
    pairs = [["pair", "matches A", "matches B", "offset A [px]", "offset B [px]"]]
    for pair in comparison["pairs"]:
        numbers = [*map(str, pair["num_matches"]), *map(_three_decimals, pair["epipolar_rms"])]
        pairs.append([f"{pair['a']} - {pair['b']}", *numbers])
    if len(pairs) > 1:
        _echo_table("Epipolar offset (RMS)", pairs, width)
    _echo_lines(comparison["lines"], width)


def output_width() -> int | None:
    """Return columns of the terminal that stdout is; None for a pipe or a file, where lines have no end."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def layout(table: Sequence[Sequence[str]], width: int | None) -> list[str]:
    r"""Return lines of a table whose first row are the heads and whose first column is text, the others numbers.

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
    if width is None or sum(numbers) + len(COLUMN_GAP) * (len(heads) - 1) <= width:
        return [_table_row(row, numbers) for row in table]
    narrow = [max(map(len, [*head.split(), *column])) for head, *column in zip(*table, strict=True)]
    room = width - sum(narrow[1:]) - len(COLUMN_GAP) * (len(heads) - 1)
    if room < min(narrow[0], NARROWEST):
        cells = ((f"  {head}: {cell}" for head, cell in zip(heads[1:], row[1:], strict=True)) for row in rows)
        return [line for row, block in zip(rows, cells, strict=True) for line in (row[0], *block)]
    widths = [min(narrow[0], room), *narrow[1:]]
    broken = [textwrap.wrap(head, size) for head, size in zip(heads, widths, strict=True)]
    depth = max(map(len, broken))
    deep = ([""] * (depth - len(head)) + head for head in broken)
    lines = [_table_row(row, widths) for row in zip(*deep, strict=True)]
    for row in rows:
        first, *folded = textwrap.wrap(row[0], widths[0]) or [""]
        lines += [_table_row([first, *row[1:]], widths), *folded]
    return lines


def _table_row(row: Sequence[str], widths: Sequence[int]) -> str:
    numbers = (cell.rjust(size) for cell, size in zip(row[1:], widths[1:], strict=True))
    return COLUMN_GAP.join([row[0].ljust(widths[0]), *numbers]).rstrip()


def _echo_table(title: str, table: Sequence[Sequence[str]], width: int | None, more: str = "") -> None:
    if table:
        echo("\n".join(_wrapped(title, width)), bold=True)
    lines = [*(layout(table, width) if table else ()), *(_wrapped(more, width) if more else ())]
    echo("\n".join(lines) + "\n")


def _echo_lines(lines: Sequence[str], width: int | None) -> None:
    for line in lines:
        echo("\n".join(_wrapped(line, width)))


def _three_decimals(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


# --- progress ---------------------------------------------------------------------------------------------


MINUTE = 60.0  # s between two lines where nobody sees bars


def at_work() -> AbstractContextManager[Progress]:
    """Return the progress of a verb, as the flags that every verb has want it told."""
    return progress_told(is_quiet(), _general("verbose"))


@contextmanager
def progress_told(quiet: bool, verbose: int) -> Iterator[Progress]:
    """Yield a callback `progress(stage, done, total)`: bars on a terminal, else and with -v lines; silent with -q."""
    if quiet:
        yield lambda _stage, _done, _total: None
    elif sys.stderr.isatty() and not verbose:
        with _bars() as progress:
            yield progress
    else:
        lines, over = Lines(groups=bool(verbose)), threading.Event()
        threading.Thread(target=lines.watch, args=(over,), daemon=True).start()
        try:
            yield lines
        finally:
            over.set()


class Lines:
    """Says a line a minute where the run is, and with `groups` one for each tenth of a stage, too.

    `clock` tells seconds; `say` takes the line.
    """

    def __init__(
        self,
        groups: bool = False,
        clock: Callable[[], float] = time.monotonic,
        say: Callable[[str], None] = say,
    ) -> None:
        self._groups, self._clock, self._say = groups, clock, say
        self._lock = threading.Lock()
        self._stage, self._done, self._total = "", 0, 1
        self._began = self._said = clock()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Store the progress of a stage."""
        with self._lock:
            if stage != self._stage:
                self._stage, self._done, self._began = stage, 0, self._clock()
            tenth = self._groups and total > 1 and 10 * done // total > 10 * self._done // total
            self._done, self._total = done, total
        self.look(tenth)

    def look(self, now: bool = False) -> None:
        """Say where the run is, if a minute has passed since it was said, or `now`."""
        with self._lock:
            time, spent = self._clock(), self._clock() - self._began
            if not self._stage or not (now or time - self._said >= MINUTE):
                return
            self._said = time
            line = f"{self._stage}: {self._done} of {self._total}"
            if self._total <= 1:
                at = f"pass {self._done}, " * (self._done > self._total)
                line = f"{self._stage}: {at}at work for {_minutes(spent)}"
            elif 0 < self._done < self._total:
                line += f", about {_minutes(spent / self._done * (self._total - self._done))} left"
        self._say(line)

    def watch(self, over: threading.Event) -> None:
        """Check every second: a stage of one task reports nothing by itself."""
        while not over.wait(1.0):
            self.look()


def _minutes(seconds: float) -> str:
    for unit, name in ((3600.0, "h"), (60.0, "min")):
        if seconds >= unit:
            return f"{seconds / unit:.1f} {name}"
    return f"{seconds:.0f} s"


@contextmanager
def _bars() -> Iterator[Progress]:
    """Yield one bar a stage at a time, with the remaining time."""
    bars: dict[str, ProgressBar[int]] = {}

    def finish() -> None:
        for bar in bars.values():
            bar.render_finish()
        bars.clear()

    def show(stage: str, done: int, total: int) -> None:
        if stage not in bars:
            finish()
            label = visible(f"{stage:<22}")
            bars[stage] = click.progressbar(length=total, label=label, show_pos=True, file=sys.stderr)
        bars[stage].length = total or None  # None: the number alone, and no time left
        bars[stage].update(done - bars[stage].pos)

    try:
        yield show
    finally:
        finish()
