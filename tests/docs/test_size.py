"""The documentation stays two short books, and its figures those of the release."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import barpc
from tests.docs.pages import DOCS, ROOT

MOST = {"README.md": 600, "book": 12_000, "docs": 32_000}
"""Words that a newcomer reads; that a user reads; all of them. Add by taking away."""
SECTIONS = re.compile(r"^  - (The book|The evidence):\n((?:    .*\n?)+)", re.MULTILINE)
FIGURES = "accuracy.md", "speed.md"
"""Pages that a benchmark writes."""


def words(*pages: Path) -> int:
    """Words as `wc -w` counts them."""
    return sum(len(page.read_text(encoding="utf-8").split()) for page in pages)


def book(title: str) -> list[Path]:
    """The pages of one of the two books."""
    parts = dict(SECTIONS.findall((ROOT / "mkdocs.yml").read_text(encoding="utf-8")))
    return [DOCS / name for name in re.findall(r": ([\w/]+\.md)$", parts[title], re.MULTILINE)]


def test_the_navigation_is_two_books():
    listed = re.findall(r": ([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(DOCS / name for name in listed) == sorted(DOCS.rglob("*.md"))
    assert sorted([*book("The book"), *book("The evidence"), DOCS / "index.md"]) == sorted(DOCS.rglob("*.md"))


def test_the_docs_do_not_grow():
    assert words(ROOT / "README.md") <= MOST["README.md"]
    assert words(DOCS / "index.md", *book("The book")) <= MOST["book"]
    assert words(*DOCS.rglob("*.md")) <= MOST["docs"]


def test_there_are_ten_recipes():
    assert len(list((DOCS / "recipes").glob("*.md"))) == 10 + 1  # and their list


@pytest.mark.parametrize("name", FIGURES)
def test_figures_carry_the_version_that_made_them_and_it_is_the_release(name):
    text = (DOCS / name).read_text(encoding="utf-8")
    again = f"python benchmarks/{Path(name).stem}.py --data DATA --write makes them again"
    assert re.findall(r"\bbarpc (\d+\.\d+\.\d+)", text) == [barpc.__version__], again
