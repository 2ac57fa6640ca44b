"""Tables of the manual behind `<!-- printed by: COMMAND -->` say what that command prints today.

DATA in a command is the folder of real images. A page whose first lines say so is printed whole.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.pages import DOCS, PAGES, ROOT

PRINTED = re.compile(r"<!-- printed by: (.+?) -->\n")
NUMBER = re.compile(r"[-+]?\d+\.\d+(?:e[-+]?\d+)?")
RELATIVE, ABSOLUTE = 0.3, 0.012
"""What other versions of numpy, scipy and OpenCV change of a figure: px, m."""

FOUND = [(page, m[1], m.end()) for page in PAGES for m in PRINTED.finditer(page.read_text(encoding="utf-8"))]


def rows(text: str) -> dict[str, list[float]]:
    """The rows of all tables of a text: numbers with a point by the first cell and the table's head."""
    found, head = dict[str, list[float]](), ""
    for before, line in zip(["", *text.splitlines()], text.splitlines(), strict=False):
        if not line.startswith("|"):
            continue
        if not before.startswith("|"):
            head = line
        first, _, rest = line.strip("| ").partition("|")
        if numbers := [float(number) for number in NUMBER.findall(rest)]:
            found[f"{head} {first.strip()}"] = numbers
    return found


def unlike(said: str, now: str) -> list[str]:
    """The rows of a text that differ from those of another, in words."""
    before, after, wrong = rows(said), rows(now), list[str]()
    for name, numbers in before.items():
        found = after.get(name, [])
        near = len(found) == len(numbers) and all(
            abs(a - b) <= max(RELATIVE * abs(a), ABSOLUTE) for a, b in zip(numbers, found, strict=True)
        )
        wrong += [] if near else [f"{name}: {numbers} on the page, {found} now"]
    return wrong


def test_a_figure_that_is_another_now_is_noticed() -> None:
    table = "| run | px |\n|---|---|\n| a | 0.500, -0.010 |\n"
    assert not unlike(table, table.replace("0.500", "0.510"))
    assert unlike(table, table.replace("0.500", "0.700"))
    assert unlike(table, table.replace("-0.010", "+0.010"))
    assert unlike(table, table.replace("| a |", "| b |"))
    assert len(FOUND) >= 2


@pytest.mark.nightly
@pytest.mark.parametrize(("page", "command", "end"), FOUND, ids=lambda value: getattr(value, "stem", ""))
def test_a_table_is_what_its_command_prints(page: Path, command: str, end: int, request: pytest.FixtureRequest) -> None:
    words = shlex.split(command)
    if "DATA" in words:
        words[words.index("DATA")] = str(request.getfixturevalue("shared_data"))
    assert words[0] == "python"
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, *words[1:]], cwd=ROOT, env=env, check=True, capture_output=True, text=True)
    text = page.read_text(encoding="utf-8")
    said = text[end:] if page.parent == DOCS and not text[:end].count("|") else text[end:].partition("\n\n")[0]
    assert rows(said)
    assert not unlike(said, done.stdout)


FIGURE = re.compile(r"\b\d+(?:\.\d+)? ?(?:px|%|s|m|km|MB|minutes?|hours?)(?![\w/])")


def test_every_figure_of_the_readme_stands_on_the_page_that_it_links_to() -> None:
    text = re.sub(r"```.*?```", "", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.DOTALL)
    found = [
        (figure[0], re.search(r"\]\((docs/[\w/]+\.md)(?:#[\w-]+)?\)", paragraph[figure.end() :]))
        for paragraph in text.split("\n\n")
        for figure in FIGURE.finditer(paragraph)
    ]
    assert [figure for figure, _ in found] == ["4.8 px", "20 %", "94 %"]
    for figure, link in found:
        assert link is not None, figure
        assert figure in (ROOT / link[1]).read_text(encoding="utf-8")
