"""Sentences in the field's terms: phrases that leave their noun out do not come back."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from barpc.cli import COMMANDS
from tests.docs.pages import DOCS, ROOT, command

PACKAGE = ROOT / "barpc"
DIALECT = (
    r"t(?:ook|akes?) no part",  # check tie points; were excluded
    r"met (?:worse|better|alike)",  # larger, smaller, equal residuals
    r"(?:is|are|be) left with",  # has residuals of
    r"left as it was",  # was not changed
    r"farther off",  # less accurate
    r"(?:not|is) its own\b",  # does not match the image
    r"\b(?:lie|lies|lying) off\b",  # is displaced by
    r"needs? (?:a|no) look",  # needs review
    r"place is known|is known to \d",  # position, uncertainty
    r"(?:hold|holds|held) the (?:scene|block|images)",  # constrain
    r"holds? nothing|move[sd]? nothing",  # was not used
    r"what holds\b",  # sources, constraints
    r"worth one\b",  # counts as one
    r"lets? expect",  # expected
    r"cannot tell\b",  # does not determine
    r"(?:nothing|nobody) (?:tells|says)",  # is not stated
    r"\bwander|\bswings?\b",  # low-frequency, sinusoidal
    r"\bfad(?:e|es|ing)\b",  # decay
    r"stands? out",  # is significant, is inconsistent with the rest
    r"what (?:is|was|were|are) (?:left|wrong|said|known|asked|seen)",  # remainder, fault, ...
    r"of what (?:is|are)\b",
    r"that was asked\b",  # requested
    r"held in height",  # constrained in height
    r"meets? under",  # has a convergence angle of
    r"\bsideways\b",  # horizontally
    r"(?:is|are|be) believed",  # is accepted, is valid
    r"\bcut as\b|used all the same|\bout of place\b",
)
"""Phrases of sentences and docstrings, with the terms instead of them."""
WORDS = re.compile("|".join(DIALECT), re.IGNORECASE)
FREE = tuple(sorted(path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()))
"""All folders of the package."""
VAGUE = re.compile(r"\bwhat\b|\bthat is\b|\bas it\b", re.IGNORECASE)
NAMES = re.compile(r"periods of the sinusoids over all rows \[px\]\s+swings")
"""A field of archives of earlier runs is called so."""


def texts(folder: Path) -> Iterator[tuple[str, str]]:
    """Place and text of every string with a blank in the modules of a folder: docstrings, messages, captions."""
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
                yield f"{path.relative_to(ROOT)}:{node.lineno}", NAMES.sub("", " ".join(node.value.split()))


def found(text: str) -> list[str]:
    return [match[0] for match in WORDS.finditer(" ".join(text.split()))]


def phrases(folder: Path) -> list[tuple[str, str]]:
    return [(place, phrase) for place, text in texts(folder) for phrase in found(text)]


@pytest.mark.few(4)
@pytest.mark.parametrize("folder", FREE)
def test_no_sentence_or_docstring_of_a_folder_is_in_the_old_dialect(folder: str) -> None:
    assert phrases(PACKAGE / folder) == []


PAGES = ROOT / "README.md", *sorted(DOCS.rglob("*.md")), *sorted(PACKAGE.rglob("*.j2"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_page_or_template_is_in_the_old_dialect(page: Path) -> None:
    assert found(page.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("verb", COMMANDS)
def test_no_help_is_in_the_old_dialect(verb: str) -> None:
    helps = [command(verb).help, *(getattr(parameter, "help", None) for parameter in command(verb).params)]
    assert [phrase for text in helps for phrase in found(text or "")] == []


@pytest.mark.few(3)
@pytest.mark.parametrize("folder", FREE)
def test_first_sentences_of_docstrings_have_nouns(folder: str) -> None:
    vague = []
    for path in sorted((PACKAGE / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (text := ast.get_docstring(node)):
                first = " ".join(re.split(r"(?<=[.;])\s|\n\n", text, maxsplit=1)[0].split())
                vague += [f"{path.relative_to(ROOT)}: {first}"] * bool(VAGUE.search(first))
    assert vague == []


def test_the_words_are_noticed_across_lines_and_not_within_others() -> None:
    assert found("tie points that took\n    no part are met worse") == ["took no part", "met worse"]
    assert found("It needs a look: rows lie off by 2 px.") == ["needs a look", "lie off"]
    assert found("The stand-out outline of a swinging bridge is faded; offset by 2 px, nothing left.") == []
    assert len(list(texts(PACKAGE / "report"))) > 500
