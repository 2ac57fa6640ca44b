"""What users install: a wheel with the package and nothing else, an archive with all that it takes to test it."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email.message import Message
from email.parser import Parser
from pathlib import Path

import pytest

import barpc
from tests.docs.pages import ROOT

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The wheel and the source archive, built by the backend that pip uses."""
    pytest.importorskip("hatchling")
    pytest.importorskip("hatch_fancy_pypi_readme")
    out = tmp_path_factory.mktemp("dist")
    code = "from hatchling import build; print(build.build_wheel({0!r})); print(build.build_sdist({0!r}))"
    command = [sys.executable, "-c", code.format(str(out))]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    wheel, sdist = done.stdout.split()[-2:]
    return out / wheel, out / sdist


@pytest.fixture
def metadata(archives: tuple[Path, Path]) -> Message:
    """What the wheel says of itself."""
    with zipfile.ZipFile(archives[0]) as wheel:
        name = next(name for name in wheel.namelist() if name.endswith("METADATA"))
        return Parser().parsestr(wheel.read(name).decode())


def test_the_wheel_holds_the_whole_package_and_no_tests_or_samples(archives):
    with zipfile.ZipFile(archives[0]) as wheel:
        names = set(wheel.namelist())
    packaged = {name for name in names if ".dist-info/" not in name and ".data/" not in name}
    expected = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "barpc").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert packaged == expected
    assert {"barpc/py.typed", "barpc/report/template.html.j2"} <= packaged
    assert sum(1 for name in names if name.endswith("licenses/LICENSE")) == 1
    manual = f"barpc-{barpc.__version__}.data/data/share/man/man1/barpc.1"
    assert [name for name in names if ".data/" in name] == [manual]


def test_the_wheel_says_what_it_is(archives, metadata):
    with zipfile.ZipFile(archives[0]) as wheel:
        scripts = next(n for n in wheel.namelist() if n.endswith("entry_points.txt"))
        assert "barpc = barpc.cli:main" in wheel.read(scripts).decode()
    assert metadata["Version"] == barpc.__version__
    assert metadata["License-Expression"] == "Apache-2.0"
    assert metadata["Requires-Python"] == ">=3.11"
    versions = [c.rpartition(" ")[2] for c in metadata.get_all("Classifier") if "Python :: 3." in c]
    assert versions == ["3.11", "3.12", "3.13"]
    needed = {r.split(">")[0] for r in metadata.get_all("Requires-Dist") if "extra ==" not in r}
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    assert needed == {r.split(">")[0] for r in declared}


def test_what_an_index_shows_has_no_link_into_the_repository_and_all_the_words(metadata):
    assert metadata["Description-Content-Type"] == "text/markdown"
    text, readme = metadata.get_payload(), (ROOT / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"\]\((?!https:)", readme)
    assert not re.findall(r"\]\((?!https:)|<img", text)
    for fence in re.findall(r"```.*?```", readme, re.DOTALL):
        assert fence in text
    assert "quick start · two notebooks · concepts · recipes" in text


def test_an_index_takes_the_archives(archives):
    pytest.importorskip("twine")
    command = [sys.executable, "-m", "twine", "check", "--strict", *map(str, archives)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_the_source_archive_holds_what_it_takes_to_test_and_to_build_the_manual(archives):
    with tarfile.open(archives[1]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    needed = (
        *("pyproject.toml", "README.md", "LICENSE", "CITATION.cff", "mkdocs.yml", "barpc/py.typed", "conftest.py"),
        *("tests/conftest.py", "data_samples/view_00.tif", "docs/index.md", "benchmarks/kernels.py"),
        *("recipe/recipe.yaml", "Dockerfile", "docs/man/barpc.1", "notebooks/first_run.ipynb"),
    )
    assert [name for name in needed if name not in names] == []
    assert not [name for name in names if "__pycache__" in name]
    rasters = {name for name in names if name.lower().endswith((".tif", ".ntf", ".hgt", ".jp2", ".gtx"))}
    rasters -= {"barpc/rasters/egm96_15.tif"}  # heights of the geoid, in the public domain
    assert {name.rpartition("/")[0] for name in rasters} == {"data_samples"}
    assert archives[1].stat().st_size < 10e6


def test_the_wheel_works_where_nothing_else_of_the_project_is(archives, tmp_path):
    with zipfile.ZipFile(archives[0]) as wheel:
        wheel.extractall(tmp_path / "site")
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path / 'site')!r}); import barpc; print(barpc.__file__); "
        "from barpc.cli import main; main(['info', '--json', sys.argv[1]])"
    )
    command = [sys.executable, "-c", code, str(ROOT / "data_samples" / "view_00.tif")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(tmp_path / "site"))
    assert '"rpc"' in done.stdout
