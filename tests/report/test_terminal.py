"""The table on the terminal: nothing is dropped, in no terminal and in no pipe."""

from __future__ import annotations

import re

import click
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from barpc.cli import terminal
from barpc.cli.terminal import layout, print_summary
from barpc.report.summary import LeftOutEntry, StepEntry
from barpc.report.summary.pairs import OffsetEntry
from barpc.report.summary.words import CAUSES

from .made import a_pair, a_summary, a_view

words = st.text("abcdef_", min_size=1, max_size=30)
cells = st.text("0123456789.+-", min_size=1, max_size=12)
heads = st.sampled_from(["error [px]", "tie points", "B/H", "height per px [m]"])


@st.composite
def any_table(draw):
    columns = draw(st.integers(1, 5))
    first = [["image", *(draw(heads) for _ in range(columns))]]
    rows = draw(st.integers(1, 4))
    return first + [[draw(words), *(draw(cells) for _ in range(columns))] for _ in range(rows)]


@pytest.mark.slow
@given(any_table(), st.one_of(st.none(), st.integers(5, 120)))
def test_no_cell_and_no_unit_is_ever_dropped(table, width):
    text = "\n".join(layout(table, width))
    squeezed = re.sub(r"\s", "", text)
    for row in table[1:]:
        for cell in row[1:]:
            assert cell in text
        if width is None:
            assert row[0] in text
    for head in table[0][1:]:
        for word in head.split():
            assert word in squeezed


@given(any_table(), st.integers(48, 120))
def test_lines_fit_the_terminal(table, width):
    assert max(map(len, layout(table, width))) <= width


@given(any_table())
def test_in_a_pipe_a_row_is_one_line_and_columns_line_up(table):
    lines = layout(table, None)
    assert len(lines) == len(table)
    ends = {len(line) for line in lines}
    assert len(ends) == 1


def shown(summary, width, monkeypatch, verbose=True):
    monkeypatch.setattr(terminal, "output_width", lambda: width)
    monkeypatch.setattr(terminal, "_general", lambda name: verbose and name == "verbose")
    return CliRunner().invoke(click.command()(lambda: print_summary(summary))).output


@pytest.mark.parametrize("width", [None, 200, 100, 80, 60, 40])
def test_the_summary_keeps_every_column_at_every_width(block_run, width, monkeypatch):
    text = shown(block_run.record, width, monkeypatch)
    if width is not None:
        assert max(map(len, text.splitlines())) <= width
    squeezed = " ".join(text.split())
    assert "[px]" in squeezed
    for view in block_run.summary["views"]:
        assert view["name"] in squeezed
        assert f"{view['rmse_after']:.3f}" in squeezed


def test_a_check_shows_no_columns_of_new_cameras(check_run, monkeypatch):
    text = shown(check_run.record, None, monkeypatch)
    assert text.count("now [px]") == 2
    assert "before" not in text
    assert "after" not in text


@pytest.mark.parametrize("width", [None, 200, 80, 60, 40])
def test_few_pairs_keep_every_column_at_every_width(width, monkeypatch):
    squeezed = " ".join(shown(a_summary([a_view("A"), a_view("B")], [a_pair("A", "B")]), width, monkeypatch).split())
    for word in ("used", "angle", "[deg]", "B/H", "before", "after", "+0.300 ± 0.200"):
        assert word in squeezed


# --- three hundred images ---------------------------------------------------------------------------------


def a_large_run(bad: int, torn: int = 40, num: int = 300, **fields):
    """Images and pairs, so many of them bad by one of three causes, so many torn."""
    causes = ("held_out", "contradicted", "few")
    views = []
    for k in range(num):
        cause = causes[k % 3]
        advice = CAUSES[cause].advice(error=1.0 + k, noise=9.0, share=90.0, few=k)
        of_bad = {"status": CAUSES[cause].status, "advice": advice, "cause": cause, "rmse_after": 1.0 + k}
        views.append(a_view(f"view_{k:04d}", **(of_bad if k < bad else {})))
    offsets = [{"epipolar_after": OffsetEntry(0.0, 0.1, 0.6 + k, 50)} if k < torn else {} for k in range(num - 1)]
    pairs = [a_pair(f"view_{k:04d}", f"view_{k + 1:04d}", **offset) for k, offset in enumerate(offsets)]
    verdict = ("It rests on this.", *(view.reservation for view in views if view.advice), *fields.pop("more", ()))
    reserved = {"status": "bad", "headline": "Look.", "reasons": verdict[1:], "passed": False}
    return a_summary(views, pairs, verdict=verdict, out_dir="out", **reserved, **fields)


@pytest.mark.few(2)
@pytest.mark.parametrize("width", [None, 200, 80])
@pytest.mark.parametrize("bad", [0, 3, 8, 299])
def test_a_summary_is_fourteen_lines_whatever_its_size(bad, width, monkeypatch):
    many = tuple(f"{n} is another reason of the block, with words enough to fill more than a line." for n in range(60))
    files = tuple(LeftOutEntry(f"{n}.tif", f"{n}.tif: no RPC") for n in range(90))
    use = StepEntry("use", "Use A.vrt.", tuple(f"barpc {verb} . -o {'long ' * 20}" for verb in ("dsm", "ortho")))
    for fields in ({}, {"more": many}, {"left_out": files, "more": tuple(one.reason_text for one in files)}):
        text = shown(a_large_run(bad, next=(use,), **fields), width, monkeypatch, False)
        lines = text.splitlines()
        assert len(lines) <= 14
        assert lines[0].startswith("Look (exit code 3).")
        assert [line for line in lines if line.startswith("Written to out")]
        for line in lines:
            assert not line.startswith("  barpc") or line.endswith("long ")  # a command is copied whole
    said = " ".join(text.split())
    if bad == 8 and width:  # as many causes as there are lines: the rest is counted
        assert re.search(r"And \d+ more: -v, or report\.html\.", said)
    else:
        assert "90 files were left out" in said


def test_what_there_is_no_room_for_is_counted(monkeypatch):
    many = tuple(f"Reason {n}." for n in range(60))
    lines = shown(a_large_run(0, more=many), 80, monkeypatch, False).splitlines()
    assert (lines[0], lines[1], len(lines)) == ("Look (exit code 3).", "It rests on this.", 14)
    assert lines[-2] == "And 50 more: -v, or report.html."
    assert lines[2:-2] == [f"Reason {n}." for n in range(10)]


def test_of_three_hundred_images_the_worst_are_shown_and_the_rest_is_counted(monkeypatch):
    lines = shown(a_large_run(299), None, monkeypatch).splitlines()
    rows = [line.split()[0] for line in lines[2:12]]
    assert rows == [f"view_{k:04d}" for k in range(298, 268, -3)]  # those that contradict the others, by their error
    assert "290 more in summary.json" in lines
    pairs = [line.split()[2] for line in lines if " - view_" in line]
    assert pairs == [f"view_{k + 1:04d}" for k in range(39, 29, -1)]
    assert "289 more in tables/pairs.csv" in lines
    causes = [line for line in lines if " images: " in line]
    assert [line.partition(": view_")[0] for line in causes] == [
        "100 images: needs review, contradicts the others",
        "100 images: needs review, large residuals of check tie points",
        "99 images: weakly connected, few tie points",
    ]
    assert "view_0298, view_0295, view_0292, view_0289, view_0286 and 95 more" in causes[0]


def test_of_a_large_run_that_is_good_only_counts_are_shown(monkeypatch):
    text = shown(a_large_run(0, torn=0), None, monkeypatch)
    assert text.splitlines() == [
        "300 images, none with a reservation: all in summary.json",
        "",
        "299 pairs, none with an epipolar offset of more than 0.5 px (RMS): all in tables/pairs.csv",
        "",
        "Look (exit code 3).",
        "It rests on this.",
        "Written to out (tables: -v, or report.html there)",
    ]


def test_few_images_keep_their_order_and_a_sentence_each(monkeypatch):
    summary = a_large_run(3, torn=1, num=4)
    lines = shown(summary, None, monkeypatch).splitlines()
    assert [line.split()[0] for line in lines[2:6]] == [f"view_{k:04d}" for k in range(4)]
    assert [line for line in lines if line.startswith("view_000") and ": " in line] == [
        summary.views[k].reservation for k in (1, 0, 2)
    ]
