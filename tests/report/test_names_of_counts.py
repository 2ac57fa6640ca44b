"""A count has one name, and a name one number for an image, a pair, the block: in page, map, terminal and summary.json.

tie points: ground details matched and verified in two images or more; observations: these, in all images;
of an image or a pair: used (in the adjustment), check (kept out of it), rejected (outliers), excluded (they move).
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from dataclasses import replace
from html import unescape

import pytest

from barpc.cli import terminal
from barpc.report.page import SECTIONS
from barpc.report.runfiles import Draped, read_tables
from barpc.report.summary import Summary

pytest.importorskip("jinja2")

KINDS = {"used": "num_observations", "check": "num_check", "rejected": "num_rejected", "excluded": "num_moving"}
WORDS = (*KINDS, "tie points", "observations")
TOLD = re.compile(rf"(\d[\d,]*) ({'|'.join(WORDS)})\b")
SUBJECT = re.compile(r"^([\w.]+(?: - [\w.]+)?): ")
AWAY = re.compile(r"\d+ (?:matches|inliers|held out|kept|cut|in use)\b")


@pytest.fixture
def counts():
    """Subject and word -> the numbers that are printed; the subject of a sentence without one is the block."""
    return defaultdict(set)


def read(counts, text: str) -> None:
    assert not AWAY.search(text), text
    subject = SUBJECT.match(text)
    for number, word in TOLD.findall(text):
        counts[subject[1] if subject else "", word].add(int(number.replace(",", "")))


def read_table(counts, heads: list[str], rows: list[list[str]]) -> None:
    for row in rows:
        for head, cell in zip(heads, row, strict=True):
            if head in WORDS:
                counts[row[0], head].add(int(cell))


def read_page(counts, files) -> None:
    for make in SECTIONS:
        if (shown := make(files)) is None or shown.key == "accuracy":
            continue
        for text in (shown.answer, *shown.points, *(caption for _, caption in (*shown.charts, *shown.panels))):
            read(counts, unescape(str(text)))
        for svg, _ in (*shown.charts, *shown.panels):
            for title in re.findall("<title[^>]*>(.*?)</title>", svg):
                read(counts, unescape(title))
        for table in shown.tables:
            if table.key in ("images", "pairs", "decided"):
                read_table(counts, list(table.columns), [[cell.text for cell in row] for row in table.rows])


def read_terminal(counts, summary: Summary, monkeypatch, capsys) -> None:
    monkeypatch.setattr(terminal, "_general", lambda name: name == "verbose")
    terminal.print_summary(summary)
    lines = capsys.readouterr().out.splitlines()
    for k, line in enumerate(lines):
        if line.startswith(("image  ", "pair  ")) or re.match(r"(image|pair) {2,}", line):
            heads = re.split(" {2,}", line)
            end = lines.index("", k)
            read_table(counts, heads, [re.split(" {2,}", row) for row in lines[k + 1 : end]])
        elif not re.match(r"\S+( - \S+)? {2,}", line):
            read(counts, line)


def test_a_name_is_one_number_wherever_it_is_printed(block_run, counts, monkeypatch, capsys):
    files = read_tables(block_run.record, block_run.folder)
    summary = files.summary
    files = replace(files, thumbnails=[Draped(view.name, (8, 8), "data:,") for view in summary.views])
    read_page(counts, files)
    read_terminal(counts, block_run.record, monkeypatch, capsys)
    for view in summary.views:
        for word, field in KINDS.items():
            counts[view.name, word].add(getattr(view, field))
    for pair in summary.pairs:
        counts[f"{pair.a} - {pair.b}", "used"].add(pair.num_matches)
    counts["", "tie points"].add(summary.tracks.num_tracks)
    counts["", "observations"].add(summary.tracks.num_observations)
    assert {key: numbers for key, numbers in counts.items() if len(numbers) > 1} == {}
    for word, field in KINDS.items():
        (num,) = counts.get(("", word)) or {0}
        assert num == sum(getattr(view, field) for view in summary.views), word
    parts = sum(getattr(view, field) for view in summary.views for field in KINDS.values())
    assert parts == summary.tracks.num_observations
    assert sum(summary.tracks.by_length.values()) == summary.tracks.num_tracks
    told = json.loads((block_run.folder / "summary.json").read_text())
    assert [view["num_check"] for view in told["views"]] == [view.num_check for view in summary.views]
    assert sum(view.num_check for view in summary.views) == summary.scene.num_held_out > 0
