"""Tables laid out by hand for widths on both sides of every turn, and the lines that say what came out."""

from __future__ import annotations

import io
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import click
import pytest

from barpc.cli import cli, terminal
from barpc.cli.terminal import Formatter, layout, output_width, print_comparison, print_summary, tell_gate
from barpc.report.summary.block import DATUM, DatumEntry
from barpc.report.summary.ground_points import GCP_CAPTION
from tests.cli.test_progress import Window
from tests.report.made import a_gcp, a_pair, a_summary, a_view

NUMBERS = [["image", "error [px]", "tie points"], ["a", "0.5", "12"], ["bb", "10.25", "3"]]
LONG = [["image", "error [px]"], ["a_long_long_long_name", "0.5"], ["", "12.25"]]


@pytest.mark.parametrize("width", [None, 29, 200])
def test_a_table_that_has_room_has_its_heads_in_one_line(width: int | None) -> None:
    assert layout(NUMBERS, width) == [
        "image  error [px]  tie points",
        "a             0.5          12",
        "bb          10.25           3",
    ]


@pytest.mark.parametrize("width", [28, 20])
def test_heads_are_broken_over_lines_that_end_together(width: int) -> None:
    assert layout(NUMBERS, width) == [
        "       error     tie",
        "image   [px]  points",
        "a        0.5      12",
        "bb     10.25       3",
    ]


@pytest.mark.parametrize(("table", "width"), [(NUMBERS, 19), (NUMBERS, 1)])
def test_without_room_for_the_first_column_a_row_is_a_block(table: list[list[str]], width: int) -> None:
    assert layout(table, width) == [
        "a",
        "  error [px]: 0.5",
        "  tie points: 12",
        "bb",
        "  error [px]: 10.25",
        "  tie points: 3",
    ]


def test_the_first_column_is_folded_down_to_twelve_characters() -> None:
    assert layout(LONG, 19) == [
        "              error",
        "image          [px]",
        "a_long_long_    0.5",
        "long_name",
        "              12.25",
    ]
    assert layout(LONG, 20)[2:4] == ["a_long_long_l    0.5", "ong_name"]
    assert layout(LONG, 18) == ["a_long_long_long_name", "  error [px]: 0.5", "", "  error [px]: 12.25"]


def test_the_longest_cell_of_the_first_column_counts_as_much_as_its_head() -> None:
    table = [["a head of words", "n"], ["abcdef", "1"]]
    assert layout(table, 15) == ["a head", "of", "words   n", "abcdef  1"]
    assert layout(table, 9)[-1] == "abcdef  1"
    assert layout(table, 8) == ["abcdef", "  n: 1"]


@pytest.mark.parametrize("width", [None, 4])
def test_a_row_of_another_length_is_no_table(width: int | None) -> None:
    for table in ([["a", "b"], ["c"]], [["a"], ["c", "d"]]):
        with pytest.raises(ValueError, match="zip"):
            layout(table, width)


def test_only_a_terminal_has_a_width(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "57")
    monkeypatch.setattr(sys, "stdout", Window())
    assert output_width() == 57
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    assert output_width() is None


# --- lines ------------------------------------------------------------------------------------------------


def test_a_word_of_the_command_is_one_line_on_stderr(capsys: pytest.CaptureFixture[str]) -> None:
    terminal.say("a\n  b \x1b c")
    terminal.echo("x", nl=False)
    terminal.echo()
    assert capsys.readouterr() == ("x\n", "barpc: a b \\u001b c\n")


@pytest.mark.parametrize(
    ("count", "told"),
    [(0, ""), (1, " 1."), (5, " 1. 2. 3. 4. 5."), (6, " 1. 2. 3. 4. 5. and 1 more"),
     (9, " 1. 2. 3. 4. 5. and 4 more")],
)  # fmt: skip
def test_of_many_reasons_five_are_told(count: int, told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert tell_gate("It failed.", [f"{n}." for n in range(1, count + 1)]) == 3
    assert capsys.readouterr() == ("", f"barpc: needs review (exit code 3): It failed.{told}\n")


def test_a_record_of_the_log_is_a_line_and_a_traceback_keeps_its_own() -> None:
    try:
        raise ValueError("\x1b")
    except ValueError:
        record = logging.LogRecord("a", 30, "", 0, "one\n%s", ("\x07",), sys.exc_info())
    first, *trace = Formatter("%(message)s").format(record).split("\n")
    assert first == "one \\u0007"
    assert trace[0] == "Traceback (most recent call last):"
    assert trace[-1] == "ValueError: \\u001b"


# --- a run and two runs -----------------------------------------------------------------------------------


@pytest.fixture
def spoken(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, dict[str, Any]]]:
    """Every text that is printed, with how it looks."""
    found: list[tuple[str, dict[str, Any]]] = []
    monkeypatch.setattr(click, "secho", lambda text, err, nl, **style: found.append((text, {"err": err, **style})))
    return found


@contextmanager
def verbose() -> Iterator[None]:
    """As behind `-v`."""
    with click.Context(cli) as context:
        context.params["verbose"] = 1
        yield


def test_a_summary_is_tables_a_headline_in_colour_and_the_verdict(spoken: list[tuple[str, dict[str, Any]]]) -> None:
    summary = a_summary(
        [a_view("A"), a_view("B", rmse_before=3.0)],
        [a_pair("A", "B", 77)],
        status="look",
        headline="Look here.",
        verdict=("One.", "Two."),
        gcps=tuple(a_gcp(f"g{n}", 5.0, 43.0) for n in range(2)),
        out_dir="out",
    )
    with verbose():
        print_summary(summary)
    titles = [text for text, style in spoken if style.get("bold")]
    assert titles[:2] == [
        "Images: tie points, and the RMS of their residuals",
        "Pairs: offset from the epipolar line, median ± spread (1.4826 MAD)",
    ]
    assert titles[2:] == [GCP_CAPTION, "Look here."]
    tables = [text for text, style in spoken if not style.get("bold") and "\n" in text]
    assert [len(text.splitlines()) for text in tables] == [3, 2, 3]
    assert all(text.endswith("\n") for text in tables)
    assert tables[1].split("\n")[1].startswith("A - B")
    assert spoken[-4:] == [
        ("Look here.", {"err": False, "bold": True, "fg": "yellow"}),
        ("One.", {"err": False}),
        ("Two.", {"err": False}),
        ("Written to out (tables: -v, or report.html there)", {"err": False}),
    ]


def test_what_holds_the_scene_is_a_table_where_several_sources_do(capsys: pytest.CaptureFixture[str]) -> None:
    entry = DatumEntry("east", 0.5, 0.7, 0.0, 0.0, 0.3, 0.0)
    with verbose():
        print_summary(a_summary([], scene=SimpleNamespace(datum=(entry,))))
    title, head, row, *_ = capsys.readouterr().out.splitlines()
    assert title == DATUM
    assert [word in head for word in ("motion", "cameras", "earlier run")] == [True, True, False]
    assert row.split() == ["east", "0.50", "70%", "30%"]
    for alone in ((), (DatumEntry("east", 0.5, 0.996, 0.0, 0.0, 0.004, 0.0),)):  # the verdict says it
        with verbose():
            print_summary(a_summary([], scene=SimpleNamespace(datum=alone)))
        assert capsys.readouterr().out == "All well.\n"


@pytest.mark.parametrize(("status", "colour"), [("good", "green"), ("bad", "red")])
def test_what_is_empty_is_not_shown_and_lines_end_at_the_terminal_s_width(
    status: str, colour: str, spoken: list[tuple[str, dict[str, Any]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "12")
    monkeypatch.setattr(sys, "stdout", Window())
    print_summary(a_summary([], status=status, headline="All of it well.", verdict=("five tie-points of a view",)))
    assert spoken == [
        ("All of it well.", {"err": False, "bold": True, "fg": colour}),
        ("five\ntie-points\nof a view", {"err": False}),
    ]
    with verbose():
        print_summary(a_summary([a_view("A")], status=status))
    assert spoken[2][0] == "Images: tie\npoints, and\nthe RMS of\ntheir\nresiduals"


COMPARISON: dict[str, Any] = {
    "a": "one",
    "b": "two",
    "views": [
        {"name": "v", "num_observations": (10, 12), "rmse": (0.12345, None), "rpc_difference_px": 0.01234,
         "rpc_difference_without_shift_px": None},
    ],
    "pairs": [{"a": "v", "b": "w", "num_matches": (5, 6), "epipolar_rms": (None, 1.5)}],
    "lines": ["They differ in one option."],
}  # fmt: skip


def test_two_runs_stand_side_by_side(capsys: pytest.CaptureFixture[str]) -> None:
    print_comparison(COMPARISON)
    assert capsys.readouterr().out.split("\n") == [
        "A: one",
        "B: two",
        "",
        "Reprojection error (RMS) and RPC files",
        "image  points A  points B  error A [px]  error B [px]  RPCs differ [px]  without shift [px]",
        "v            10        12         0.123             -             0.012                   -",
        "",
        "Epipolar offset (RMS)",
        "pair   matches A  matches B  offset A [px]  offset B [px]",
        "v - w          5          6              -          1.500",
        "",
        "They differ in one option.",
        "",
    ]
    print_comparison({**COMPARISON, "pairs": []})
    assert "Epipolar" not in capsys.readouterr().out
