"""Every command of the manual, run or not, is one that the program understands."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from barpc.base.options import read_options
from barpc.cli import COMMANDS
from tests.docs.pages import DOCS, PRESENT, ROOT, blocks, flags

GENERAL = {"--help", "-h", "--version", "-q", "-v", "-vv", "--quiet", "--verbose", "--debug", "--json"}


def commands(page: Path) -> list[str]:
    """Lines and inline code that begin with `barpc`."""
    lines = [line for block in blocks(page, "", "bash", "sh", "console") for line in block.text.splitlines()]
    lines += re.findall(r"`(barpc [^`\n]+)`", page.read_text(encoding="utf-8"))
    lines += [part for line in lines for part in line.split("&&")[1:]]
    return [line.strip() for line in lines if re.match(r"\s*barpc\s+[-a-z]", line)]


@pytest.mark.parametrize("page", PRESENT, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_names_a_verb_and_flags_that_exist(page):
    for line in commands(page):
        words = shlex.split(line.split("   ")[0].replace("'", ""), comments=True)[1:]
        verb = next((word for word in words if not word.startswith("-")), None)
        given = {word for word in words if re.fullmatch(r"--?[a-z][a-z-]*", word)} - GENERAL
        if verb is None:
            assert not given, line
            continue
        assert verb in COMMANDS, line
        assert given <= flags(verb), f"{line}: {sorted(given - flags(verb))}"


def test_options_files_of_the_manual_are_read(tmp_path):
    found = [block.text for page in DOCS.rglob("*.md") for block in blocks(page, "toml")]
    assert found
    for number, text in enumerate(found):
        path = tmp_path / f"{number}.toml"
        path.write_text(text, encoding="utf-8")
        read_options(path)


def test_the_check_of_flags_notices_a_wrong_one(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("```bash\nbarpc adjust *.tif --no-such-flag -o x\n```\n", encoding="utf-8")
    assert commands(page) == ["barpc adjust *.tif --no-such-flag -o x"]
    assert "--no-such-flag" not in flags("adjust")
