"""What a reader may rely on: links lead somewhere, generated pages are what the code says, the site builds."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import barpc
from barpc.pointio.gcp_formats import GCP_FORMATS
from barpc.report.tables import TABLES
from barpc.rpcio import FORMATS
from tests.docs.pages import DOCS, PAGES, ROOT, anchors, links


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_of_a_page_leads_to_a_file_and_a_heading_that_exist(page):
    for target in links(page):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        goal = (page.parent / name).resolve() if name else page
        assert goal.exists() or goal.name == "summary.schema.json", f"{target}: no such file"
        if anchor:
            assert anchor in anchors(goal), f"{target}: no such heading"


def test_pages_of_the_site_link_to_pages_of_the_site_only():
    for page in DOCS.rglob("*.md"):
        for target in links(page):
            if not re.match(r"[a-z]+:", target) and not target.startswith("#"):
                assert (page.parent / target.partition("#")[0]).resolve().is_relative_to(DOCS), (page, target)


def test_the_page_of_options_is_what_the_code_says():
    generator = script("generate_options")
    assert (DOCS / "options.md").read_text(encoding="utf-8") == generator.page()


def test_the_picture_of_the_house_is_what_the_code_says():
    generator = script("figures/architecture")
    assert generator.OUT.read_text(encoding="utf-8") == generator.drawing()
    off = (("ba/adjustment.py", "adjust_tracks", ""), ("fit/refit.py", "fit_rpc", ""), ("fit/refit.py", "no_such", ""))
    assert generator.broken(off) == ["fit/refit.py: fit_rpc", "fit/refit.py: no_such"]


def test_every_room_of_barpc_stands_in_the_plan_of_the_house():
    plan = (DOCS / "architecture.md").read_text(encoding="utf-8").split("```")[1]
    rooms = {path.name for path in (ROOT / "barpc").iterdir() if path.suffix == ".py"} - {"__init__.py", "__main__.py"}
    rooms |= {f"{path.parent.name}/" for path in (ROOT / "barpc").glob("*/__init__.py")}
    assert [room for room in sorted(rooms) if room not in plan] == []
    told = set(re.findall(r"\b[a-z]\w+\.py\b", plan))
    assert [name for name in sorted(told) if not list((ROOT / "barpc").rglob(name))] == []


def test_the_page_of_the_summary_is_what_its_records_say():
    page = script("generate_summary").page()
    assert (DOCS / "summary.md").read_text(encoding="utf-8") == page
    of_after = "RMS reprojection error through the new cameras; none where cameras were only checked"
    assert f"- `rmse_after`: {of_after} [px]." in page
    assert "- `kind` (`adjust`/`check`/`match`): " in page
    assert "- `size` (2 values): " in page
    assert page.count(": Median signed distance from the epipolar line [px].") == 1


def test_the_limits_are_those_of_the_code():
    generator = script("generate_limits")
    text = (DOCS / "reliability.md").read_text(encoding="utf-8")
    assert generator.page(text) == text
    told = dict(generator.rows())
    assert told["an XML file"] == "32 MiB, 100 levels, 2,000,000 elements"
    assert len(told) == len(generator.rows())


def test_the_tables_of_formats_are_those_of_the_code():
    generator = script("generate_formats")
    text = (DOCS / "formats.md").read_text(encoding="utf-8")
    assert generator.page(text) == text
    assert "7. **the image's own** (GTiff, NITF), 8. `X.tif.aux.xml`" in text
    assert all(row.reads for row in FORMATS.values())
    assert all(row.holds for row in GCP_FORMATS.values())
    with pytest.raises(ValueError, match="no place for 3 tables"):
        generator.page(text.replace(generator.END, ""))


def test_the_page_of_the_report_names_every_table_of_a_run():
    text = (DOCS / "report.md").read_text(encoding="utf-8")
    assert all(f"`tables/{name}`" in text for name in TABLES)


def test_type_checkers_know_every_public_name():
    text = (ROOT / "barpc" / "__init__.py").read_text(encoding="utf-8")
    typed = set(re.findall(r"^    from \S+ import \w+ as (\w+)$", text, re.MULTILINE))
    assert typed == set(barpc.__all__) - {"__version__"}


def build(tree: Path, work: Path) -> subprocess.CompletedProcess[str]:
    """The site of a tree, made by the very line of the gate where the tree has one."""
    for module in ("mkdocs", "material", "mkdocstrings", "latex2mathml"):
        pytest.importorskip(module)
    gate = ROOT / ".ci" / "run"
    text = gate.read_text(encoding="utf-8") if gate.exists() else 'mkdocs build --strict -d "$work/site"\n'
    line = re.findall(r"^mkdocs .*$", text, re.MULTILINE)
    assert len(line) == 1
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    given = {**os.environ, "PATH": path, "work": str(work), "NO_MKDOCS_2_WARNING": "1"}
    command = ["bash", "-euc", line[0]]
    return subprocess.run(command, cwd=tree, env=given, capture_output=True, text=True, check=False)


PLANTED = {
    "missing.md": "[a page](missing.md)",
    "no-such-heading": "[a heading](concepts.md#no-such-heading)",
    "barpc.missing": "[a name][barpc.missing]",
    "x>=7": "[default: 1] [x>=7]",
}
"""What a warning says -> the fault in a page that it is about."""


@pytest.mark.nightly
def test_the_site_does_not_build_with_a_broken_link(tmp_path):
    tree = tmp_path / "tree"
    shutil.copytree(DOCS, tree / "docs")
    shutil.copytree(ROOT / "barpc", tree / "barpc")
    shutil.copy(ROOT / "mkdocs.yml", tree)
    with (tree / "docs" / "faq.md").open("a", encoding="utf-8") as page:
        page.write("\n\n" + "\n\n".join(PLANTED.values()) + "\n")
    done = build(tree, tmp_path)
    assert done.returncode != 0
    warned = [line for line in done.stderr.splitlines() if "WARNING" in line]
    assert len(warned) == len(PLANTED), done.stderr
    for said in PLANTED:
        assert any(said in line and "faq.md" in line for line in warned), said


@pytest.mark.nightly
def test_the_site_builds_without_a_warning_and_loads_nothing_from_elsewhere(tmp_path):
    done = build(ROOT, tmp_path)
    assert done.returncode == 0, done.stderr
    for page in (tmp_path / "site").rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r"<(?:script|img|iframe)[^>]* src=\"([^\"]+)\"", text)
        loaded += re.findall(r"<link[^>]* rel=\"(?:stylesheet|preconnect|preload)\"[^>]*>", text)
        assert not [item for item in loaded if "//" in item], page
        assert 'class="arithmatex"' not in text, f"{page}: an equation that is not MathML"


@pytest.mark.parametrize(
    "name", sorted(p.name for p in Path(ROOT / "benchmarks").glob("*.py") if "__main__" in p.read_text())
)
@pytest.mark.nightly
def test_every_benchmark_says_what_it_does(name):
    command = [sys.executable, str(ROOT / "benchmarks" / name), "--help"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "usage:" in done.stdout


def test_the_citation_file_names_the_paper_and_the_licence_of_the_package():
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert "license: Apache-2.0" in text
    assert "Robust Rational Polynomial Camera Modelling for SAR and Pushbroom Imaging" in text
    for author in ("Akiki", "Marí", "de Franchis", "Morel", "Facciolo"):
        assert f"family-names: {author}" in text


OTHER = "README.md", "template.md.j2"
"""What is in changelog.d beside fragments."""


def test_changelog_fragments_have_a_type_that_the_changelog_knows():
    configuration = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    types = set(re.findall(r'^directory = "(\w+)"$', configuration, re.MULTILINE))
    for path in {*(ROOT / "changelog.d").iterdir()} - {ROOT / "changelog.d" / name for name in OTHER}:
        assert re.fullmatch(r"[\w-]+\.(\w+)\.md", path.name), path.name
        assert path.name.split(".")[1] in types, path.name
