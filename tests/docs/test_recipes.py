"""The commands of the manual run as they stand there.

Blocks marked `bash` and `python` of a page are run in its order, in one folder that holds data_samples/; a later page
finds what an earlier one left there, as a reader does. Before a commit the first pages run, on a part of each image.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from barpc.cli import main
from tests.docs.pages import DOCS, ROOT, blocks
from tests.pipeline.known import part

PAGES = [DOCS / "index.md", DOCS / "quickstart.md", *sorted((DOCS / "recipes").glob("*.md"))]
GATE = "# ends with exit code 3"
"""Said behind a command whose verdict asks for a look."""

RUN = [page for page in PAGES if blocks(page, "bash", "python")]
LATE = (
    "absolute",
    "dates",
    "drift",
    "dsm",
    "export",
    "matches",
)  # five seconds or more each, and more of the same kind


@pytest.fixture(scope="module")
def codes() -> dict[str, int]:
    """Commands that were run, and how they ended."""
    return {}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    here = tmp_path_factory.mktemp("recipes")
    shutil.copytree(ROOT / "data_samples", here / "data_samples")
    return here


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """The same folder with a part of each image."""
    shutil.copytree(ROOT / "data_samples", tmp_path / "data_samples")
    part(tmp_path / "data_samples", side=200)
    return tmp_path


def run_line(line: str, codes: dict[str, int]) -> None:
    """One command, unless an earlier page had it. Programs other than barpc run where they are installed."""
    if line in codes:
        return
    words = [name for word in shlex.split(line, comments=True) for name in expanded(word)]
    if words[0] == "barpc":
        with pytest.raises(SystemExit) as stop:
            main(words[1:])
        codes[line] = int(stop.value.code or 0)
        assert codes[line] == (3 if line.endswith(GATE) else 0), line
    elif words[0] == "python" or shutil.which(words[0]):
        words[0] = sys.executable if words[0] == "python" else words[0]
        subprocess.run(words, check=True, env={**os.environ, "PYTHONPATH": str(ROOT)})


def expanded(word: str) -> list[str]:
    """A word of a command; patterns as a shell expands them."""
    return sorted(str(path) for path in Path().glob(word)) or [word] if "*" in word else [word]


@pytest.mark.slow
def test_the_first_pages_run_on_parts_of_the_images(small, monkeypatch):
    monkeypatch.chdir(small)
    codes: dict[str, int] = {}
    for page in RUN[:2]:
        run_page(page, codes)
    assert len(codes) == 4


@pytest.mark.nightly
@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=pytest.mark.nightly if page.stem in LATE else ()) for page in RUN],
    ids=lambda page: str(page.relative_to(DOCS)),
)
def test_the_commands_of_a_page_run_as_they_stand(page, folder, codes, monkeypatch):
    monkeypatch.chdir(folder)
    run_page(page, codes)


def run_page(page: Path, codes: dict[str, int]) -> None:
    found = blocks(page, "bash", "python")
    assert found, "a page of commands without any"
    for block in found:
        if block.language == "python":
            exec(compile(block.text, str(page), "exec"), {"__name__": "page"})
            continue
        for line in block.text.splitlines():
            if line.strip() and not line.startswith("#"):
                run_line(line, codes)


@pytest.mark.slow
def test_the_python_block_of_the_readme_runs_on_the_samples(small, monkeypatch):
    folder = small
    monkeypatch.chdir(folder)
    for name, view in zip("abc", ("view_00", "view_01", "view_02"), strict=True):
        shutil.copy(folder / "data_samples" / f"{view}.tif", f"{name}.tif")
    code = "\n".join(block.text for block in blocks(ROOT / "README.md", "python"))
    names: dict = {"__name__": "readme"}
    exec(compile(code.replace('"adjusted', '"adjusted_readme'), "README.md", "exec"), names)
    assert names["result"].summary["headline"] == "All 3 images are adjusted."
    assert names["col_row"].shape == (1, 2)
