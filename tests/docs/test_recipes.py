"""The commands of the manual run as they stand there.

Blocks marked `bash` and `python` of a page are run in its order, in one folder that holds data_samples/; a later page
finds what an earlier one left there, as a reader does.
"""

from __future__ import annotations

import glob
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from barpc.cli import main
from tests.docs.pages import DOCS, ROOT, blocks

PAGES = [DOCS / "index.md", DOCS / "quickstart.md", *sorted((DOCS / "recipes").glob("*.md"))]
RUN = [page for page in PAGES if blocks(page, "bash", "python")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    here = tmp_path_factory.mktemp("recipes")
    shutil.copytree(ROOT / "data_samples", here / "data_samples")
    return here


def run_line(line: str) -> None:
    """One command; patterns are expanded as a shell does. Other programs run where they are installed."""
    words = [name for word in shlex.split(line) for name in (sorted(glob.glob(word)) or [word])]
    if words[0] == "barpc":
        with pytest.raises(SystemExit) as stop:
            main(words[1:])
        assert stop.value.code == 0, line
    elif shutil.which(words[0]):
        subprocess.run(words, check=True)


@pytest.mark.parametrize("page", RUN, ids=lambda page: str(page.relative_to(DOCS)))
def test_the_commands_of_a_page_run_as_they_stand(page, folder, monkeypatch):
    monkeypatch.chdir(folder)
    for block in blocks(page, "bash", "python"):
        if block.language == "python":
            exec(compile(block.text, str(page), "exec"), {"__name__": "page"})
            continue
        for line in block.text.splitlines():
            if line.strip() and not line.startswith("#"):
                run_line(line)


def test_the_python_block_of_the_readme_runs_on_the_samples(folder, monkeypatch):
    monkeypatch.chdir(folder)
    for name, view in zip("abc", ("view_00", "view_01", "view_02"), strict=True):
        shutil.copy(folder / "data_samples" / f"{view}.tif", f"{name}.tif")
    code = "\n".join(block.text for block in blocks(ROOT / "README.md", "python"))
    names: dict = {"__name__": "readme"}
    exec(compile(code.replace('"adjusted', '"adjusted_readme'), "README.md", "exec"), names)
    assert "adjusted" in names["result"].summary["verdict"][0]
    assert names["col_row"].shape == (1, 2)
