"""The pages of the documentation, their code blocks and their links."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import click

from barpc.cli import cli

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted({*ROOT.glob("*.md"), *DOCS.rglob("*.md")} - {ROOT / "nightly.md"})  # that is figures of a machine

PRESENT = [page for page in PAGES if page.name != "CHANGELOG.md"]
"""Pages that speak of what is: the changelog speaks of what was, too."""

_FENCE = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\]\(([^)\s]+)\)")


@dataclass(frozen=True)
class Block:
    """A fenced block: its language and text."""

    language: str
    text: str


def blocks(page: Path, *languages: str) -> list[Block]:
    """The blocks of a page in these languages, in order."""
    found = [Block(m[2], m[3]) for m in _FENCE.finditer(page.read_text(encoding="utf-8"))]
    return [block for block in found if block.language in languages]


def links(page: Path) -> list[str]:
    """Targets of a page's links, outside code."""
    text = _FENCE.sub("", page.read_text(encoding="utf-8"))
    return _LINK.findall(re.sub(r"`[^`\n]*`", "", text))


def command(verb: str) -> click.Command:
    """The command of a verb of the program."""
    found = cli.get_command(click.Context(cli, **cli.context_settings), verb)
    assert found is not None
    return found


def flags(verb: str) -> set[str]:
    """Flags of a verb, without those that every verb has."""
    return {name for one in command(verb).params for name in (*one.opts, *one.secondary_opts)}


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as the site and code hosts make them."""
    text = _FENCE.sub("", page.read_text(encoding="utf-8"))
    heads = re.findall(r"^#+ +(.+)$", text, re.MULTILINE)
    return {re.sub(r"[\s]+", "-", re.sub(r"[^\w\s-]", "", head.lower()).strip()) for head in heads}
