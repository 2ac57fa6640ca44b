"""The table on the terminal: nothing is dropped, in no terminal and in no pipe."""

from __future__ import annotations

import re

import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from barpc.cli import terminal
from barpc.cli.terminal import layout, print_summary

words = st.text("abcdef_", min_size=1, max_size=30)
cells = st.text("0123456789.+-", min_size=1, max_size=12)
heads = st.sampled_from(["error [px]", "tie points", "B/H", "height per px [m]"])


@st.composite
def any_table(draw):
    columns = draw(st.integers(1, 5))
    first = [["image", *(draw(heads) for _ in range(columns))]]
    rows = draw(st.integers(1, 4))
    return first + [[draw(words), *(draw(cells) for _ in range(columns))] for _ in range(rows)]


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


def shown(finished, width, monkeypatch):
    import click

    @click.command()
    def command():
        print_summary(finished.record)

    monkeypatch.setattr(terminal, "output_width", lambda: width)
    return CliRunner().invoke(command).output


@pytest.mark.parametrize("width", [None, 200, 100, 80, 60, 40])
def test_the_summary_keeps_every_column_at_every_width(block_run, width, monkeypatch):
    text = shown(block_run, width, monkeypatch)
    if width is not None:
        assert max(map(len, text.splitlines())) <= width
    squeezed = " ".join(text.split())
    for unit in ("[px]", "[deg]", "B/H"):
        assert unit in squeezed
    for view in block_run.summary["views"]:
        assert view["name"] in squeezed
        assert f"{view['rmse_after']:.3f}" in squeezed


def test_a_check_shows_no_columns_of_new_cameras(check_run, monkeypatch):
    text = shown(check_run, None, monkeypatch)
    assert "before [px]" in text
    assert "after [px]" not in text
