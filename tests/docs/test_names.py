"""What a page names in code exists: flags, options, modules, functions, files, values of the summary."""

from __future__ import annotations

import importlib
import json
import re
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import barpc
from barpc.base.declarations import declared
from barpc.base.options import RunOptions
from barpc.cli import COMMANDS
from barpc.report.summary import published_schema
from tests.docs.pages import DOCS, PRESENT, ROOT, blocks, flags
from tests.scenes.__main__ import command as draw_scene

GENERAL = {"--help", "--version", "--quiet", "--verbose", "--debug", "--json"}
"""Flags of every verb."""
SCRIPTS = [ROOT / "benchmarks", ROOT / "tests", ROOT / "docs", ROOT / ".ci"]
"""Where flags of the project's other programs are declared."""
OTHERS = {"--nthreads", "--use-lon-lat-height-gcp-error"}
"""Flags of dask's worker and of ASP."""
FOLDERS = "barpc|benchmarks|tests|docs|examples|notebooks|data_samples|changelog.d|recipe|.ci"


def inline(page: Path) -> list[str]:
    """Pieces of code within sentences and tables."""
    text = re.sub(r"^( *)```.*?^\1```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    return re.findall(r"`([^`\n]+)`", text)


@cache
def all_flags() -> set[str]:
    """Flags of all verbs."""
    return GENERAL.union(*map(flags, COMMANDS))


@cache
def other_flags() -> set[str]:
    """Flags that scripts of the repository declare."""
    sources = [path.read_text(encoding="utf-8") for folder in SCRIPTS for path in folder.rglob("*.py")]
    sources += [(ROOT / ".ci" / "nightly").read_text(encoding="utf-8")] if (ROOT / ".ci").exists() else []
    of_scenes = {flag for one in draw_scene.params for flag in one.opts}
    return OTHERS | of_scenes | set(re.findall(r"add_argument\(\s*\"(--[a-z-]+)\"", "\n".join(sources)))


def unknown_flags(code: str) -> set[str]:
    """Flags of a piece of code that neither a verb nor a script has."""
    if re.match(
        r"(pip|rattler-build|pytest|ruff|mkdocs|gdal|git|python -m build|twine|oty|otbcli|sbatch|srun|towncrier)", code
    ):
        return set()
    return set(re.findall(r"(?<!\S)--[a-z][a-z-]*", code)) - all_flags() - other_flags()


def options() -> dict[str, set[str]]:
    """Table of an options file -> its options; "" holds those of all tables."""
    top = declared(RunOptions)
    tables = {name: set(declared(type(top[name].default))) for name in ("tie", "adjust", "fit")}
    return {**tables, "": set(top).union(*tables.values())}


def wrong_options(code: str) -> list[str]:
    """Options of a piece of code, as `[tie] search` or `search = 2000`, that no table has."""
    known = options()
    named = re.fullmatch(r"\[(tie|adjust|fit)\] (\w+)(?: = .*)?", code)
    if named:
        return [] if named[2] in known[named[1]] else [code]
    given = re.fullmatch(r"([a-z_]{3,})\s?=\s?(?:\d[\d.e-]*|\"[\w+-]+\"|true|false)", code)
    return [code] if given and given[1] not in known[""] | KEYWORDS else []


KEYWORDS = {"atmosphere", "bistatic", "first_pixel", "strict", "model", "executor", "driver", "keep_largest"}
"""Arguments of functions, and choices behind a file's name."""


IMPORT = re.compile(r"^ *(?:from (barpc[\w.]*) import ([\w, ]+)|import (barpc\.[\w.]+))", re.MULTILINE)


def private(code: str) -> list[str]:
    """What Python code takes from modules of the package that is neither in `barpc` nor on the page of the API."""
    listed = set(re.findall(r"^::: (\S+)$", (DOCS / "api.md").read_text(encoding="utf-8"), re.MULTILINE))
    taken = [
        f"{of}.{name.split(' as ')[0].strip()}"
        for of, names, _ in IMPORT.findall(code)
        for name in names.split(",")
        if of
    ]
    taken += [whole for *_, whole in IMPORT.findall(code) if whole]
    return [name for name in taken if name not in listed and name.removeprefix("barpc.") not in barpc.__all__]


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem)
def test_notebooks_take_public_names_only(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert [name for cell in cells if cell["cell_type"] == "code" for name in private("".join(cell["source"]))] == []


def found(name: str) -> bool:
    """Whether a dotted name leads to a module, or to something in one."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            thing: Any = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            if part not in getattr(thing, "__dataclass_fields__", ()) and not hasattr(thing, part):
                return False
            thing = getattr(thing, part, None)
        return True
    return False


def names(page: Path) -> set[str]:
    """Dotted names of the package in a page's sentences and references, from `barpc` or from a folder of it."""
    text = page.read_text(encoding="utf-8")
    codes = [re.match(r"(?:barpc|ba|tie|fit)\.[\w.]*\w(?=$|[(\[ ,])", code) for code in inline(page)]
    said = {code[0] for code in codes if code} | set(re.findall(r"^::: (\S+)$", text, re.MULTILINE))
    return {name if name.startswith("barpc") else f"barpc.{name}" for name in said}


def paths(page: Path) -> set[str]:
    """Files and folders of the repository in a page's sentences and commands."""
    shell = [line for block in blocks(page, "", "bash", "sh") for line in block.text.splitlines()]
    text = "\n".join([*inline(page), *shell])
    modules = re.findall(r"python -m ((?:benchmarks|tests)[\w.]*)", text)
    plain = re.findall(rf"(?<![\w/.-])(?:{FOLDERS})/[\w./-]*\w", text)
    return {*plain, *(module.replace(".", "/") for module in modules)}


def value(name: str) -> bool:
    """Whether the schema of summary.json has a value, such as `pairs[].chosen_by`."""
    records, part = published_schema()["$defs"], "Summary"
    for step in name.split("."):
        found = records.get(part, {}).get("properties", {}).get(step.removesuffix("[]"))
        if found is None or step.endswith("[]") is not ("items" in str(found)):
            return False
        part = next(iter(re.findall(r"/(\w+)'", str(found))), "")
    return True


def wrong_values(page: Path) -> list[str]:
    """Values of the summary that a page names and that there are not."""
    if "truth.json" in page.read_text(encoding="utf-8"):
        return []  # has views of its own
    said = [code for code in inline(page) if re.fullmatch(r"(views\[\]|pairs\[\]|gcps\[\]|scene)\.[\w.\[\]]+", code)]
    return [name for name in said if not value(name)]


WRONG: dict[str, Callable[[Path], Iterable[str]]] = {
    "flags": lambda page: set().union(*map(unknown_flags, inline(page))),
    "options": lambda page: {wrong for code in inline(page) for wrong in wrong_options(code)},
    "public names in code": lambda page: [name for block in blocks(page, "python") for name in private(block.text)],
    "modules and functions": lambda page: {name for name in names(page) if not found(name)},
    "files": lambda page: {n for n in paths(page) if not (ROOT / n).exists() and not (ROOT / f"{n}.py").exists()},
    "values of the summary": wrong_values,
}
"""What a page names -> what it names of these that does not exist."""


@pytest.mark.parametrize("what", WRONG)
@pytest.mark.parametrize("page", PRESENT, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_names_exists(page, what):
    assert sorted(WRONG[what](page)) == []


def test_the_checks_notice_what_does_not_exist(tmp_path):
    page = tmp_path / "page.md"
    code = "from barpc import fit_rpc\nfrom barpc.base.geodesy import Array\nimport barpc.ba\n"
    page.write_text(
        "`--no-such`, `[tie] drift`, `serach = 3`, `barpc.tie.no`, `ba.no`, `benchmarks/no.py`, `scene.no`, "
        f"`views[].no`, `pairs[].chosen_by`\n\n```python\n{code}```\n"
    )
    assert {what: sorted(wrong(page)) for what, wrong in WRONG.items()} == {
        "flags": ["--no-such"],
        "options": ["[tie] drift", "serach = 3"],
        "public names in code": ["barpc.ba", "barpc.base.geodesy.Array"],
        "modules and functions": ["barpc.ba.no", "barpc.tie.no"],
        "files": ["benchmarks/no.py"],
        "values of the summary": ["scene.no", "views[].no"],
    }
    assert found("barpc.RpcFit.no") is False
    assert found("barpc.rpcio.FORMATS")


@pytest.mark.parametrize("package", ["barpc", "barpc.fit", "barpc.pipeline", "barpc.report", "barpc.tie"])
def test_every_name_that_a_package_imports_when_used_is_there(package: str) -> None:
    module = importlib.import_module(package)
    assert [name for name in module.__all__ if not hasattr(module, name)] == []


def test_the_names_are_read_from_pages_that_have_them():
    assert sum(len(names(page)) for page in PRESENT) > 60
    assert sum(len(paths(page)) for page in PRESENT) > 40
    assert "barpc.ba.evidence.scan" in names(DOCS / "adjustment.md")


def test_what_a_diff_of_contributing_starts_from_is_in_the_files_that_it_names():
    parts = [part for block in blocks(ROOT / "CONTRIBUTING.md", "diff") for part in block.text.split("\n\n")]
    known = ""
    for part in parts:
        for line in part.splitlines():
            if line.startswith("# "):
                known = "".join(
                    path.read_text() for name in re.findall(r"barpc/[\w/]+\.py", line) if (path := ROOT / name).exists()
                )
            elif not line.startswith("+"):
                assert line[1:] in known, line
    assert len(parts) >= 5
