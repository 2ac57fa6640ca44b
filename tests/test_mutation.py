"""The measure of the tests itself: its mutants are changes that Python accepts, its list names what exists."""

from __future__ import annotations

import ast
import importlib
import random
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

SCRIPT = Path(__file__).resolve().parents[1] / "benchmarks/mutation.py"


@pytest.fixture(scope="module")
def mutation() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.path", [*sys.path, str(SCRIPT.parent)])  # processes of its own find it by its name
        yield importlib.import_module(SCRIPT.stem)


@pytest.fixture(scope="module")
def every(mutation) -> list[Any]:
    return list(mutation.mutants([*mutation.parts()]))


def test_every_listed_mutant_has_its_place_and_its_tests(mutation) -> None:
    tests = mutation.parts()
    for mutant in mutation.chosen():
        before, after = mutant.source()
        assert before != after
        compile(after, mutant.file, "exec")
        assert tests[mutant.part]


@pytest.mark.nightly
def test_mutants_are_programs_that_differ(mutation, every) -> None:
    assert {mutant.part for mutant in every} == set(mutation.parts())
    for mutant in random.Random(0).sample(every, 60):
        before, after = mutant.source()
        assert before != after
        compile(after, mutant.file, "exec")


@pytest.mark.nightly
def test_mutants_named_equivalent_are_still_there(mutation, every) -> None:
    listed = mutation.equivalents()
    files = {file for file, _ in listed}
    known = {(mutant.file, mutation.changed(mutant)) for mutant in every if mutant.file in files}
    assert set(listed) <= known


def test_a_length_that_a_reshape_works_out_has_a_sign_and_no_size(mutation) -> None:
    raw = b"x = a.reshape(-1, 3)\ny = b[-1]"
    found = [(raw[start:stop], new) for start, stop, new in mutation.Places(raw).walk(ast.parse(raw))]
    assert found == [(b"-1", "(1)"), (b"3", "4"), (b"-1", "(1)"), (b"1", "2")]


def test_the_score_leaves_out_equivalents(mutation) -> None:
    fates = ["caught"] * 8 + ["SURVIVED"] * 2 + ["equivalent"] * 5
    rows = [{"part": "ba", "fate": fate, "diff": str(n)} for n, fate in enumerate(fates)]
    found = mutation.score(rows)
    assert found["score"]["ba"] == {"caught": 8, "SURVIVED": 2, "equivalent": 5, "share": 0.8}
    assert found["survivors"] == ["8", "9"]


def test_every_folder_of_the_package_is_a_part_with_tests(mutation) -> None:
    root = SCRIPT.parents[1]
    folders = {path.parent.name for path in (root / "barpc").glob("*/*.py")} | {"remote"}  # a room of the base
    assert set(mutation.parts()) == folders | {"top", "simulate"}  # a module that has a folder of tests
    assert all(mutation.parts().values())
    assert "tests/test_mutation.py" not in mutation.parts()["top"]
    assert {path.name for path in (root / "barpc").glob("*.py")} <= {
        Path(mutant.file).name for mutant in mutation.mutants(["top", "simulate"])
    } | {"__init__.py", "__main__.py", "errors.py"}


# --- the tool at work -------------------------------------------------------------------------------------


@pytest.fixture
def small(mutation, tmp_path, monkeypatch) -> ModuleType:
    """The tool on a package of one function, whose sign is tested and whose rounding is not."""
    for folder in ("barpc/ba", "tests/ba", "benchmarks"):
        (tmp_path / folder).mkdir(parents=True)
    for folder in ("barpc", "barpc/ba"):
        (tmp_path / folder / "__init__.py").write_text("")
    (tmp_path / "barpc/ba/sums.py").write_text("def total(a, b):\n    return round(a + b, 6)\n")
    (tmp_path / "benchmarks/data.py").write_text("PAIRS = [(1.0, 2.0, 3.0)]\n")
    (tmp_path / "tests/ba/test_sums.py").write_text(
        "from benchmarks.data import PAIRS\n"
        "from barpc.ba.sums import total\n\n"
        "def test_total():\n    assert all(total(a, b) == c for a, b, c in PAIRS)\n"
    )
    (tmp_path / "tests/ba/test_unread.py").write_text("def test_nothing():\n    assert True\n")
    (tmp_path / "pyproject.toml").write_text('[tool.pytest.ini_options]\nmarkers = ["slow"]\n')
    monkeypatch.setattr(mutation, "ROOT", tmp_path)
    return mutation


@pytest.mark.slow
def test_what_tests_see_is_caught_and_what_they_do_not_see_survives(small, tmp_path, capfd) -> None:
    rows = list(small.run(small.mutants(["ba"]), 2))
    fates = {str(row["diff"]).splitlines()[-1].strip("+ "): row["fate"] for row in rows}
    assert fates == {
        "return round(a - b, 6)": "caught",
        "return round(a + b, 7)": "SURVIVED",
        "return round(6, a + b)": "caught",
    }
    assert "test_sums.py::test_total" in next(str(row["test"]) for row in rows if row["fate"] == "caught")
    assert small.score(rows)["score"]["all"]["share"] == 0.667
    assert "a + b, 6" in (tmp_path / "barpc/ba/sums.py").read_text()  # the tree itself is never touched
    capfd.readouterr()


def test_tests_that_fail_without_a_mutant_are_refused(small, tmp_path, capfd) -> None:
    """Else every mutant would count as caught."""
    (tmp_path / "benchmarks/data.py").unlink()
    with pytest.raises(SystemExit, match=r"ba: the tests fail without a mutant: ERROR tests/ba/test_sums\.py"):
        list(small.run(small.mutants(["ba"]), 1))
    capfd.readouterr()


@pytest.mark.slow
def test_tests_that_are_ended_are_told_from_tests_that_fail(small, tmp_path) -> None:
    """As numba ends a process that was forked from one with its threads: none of the tests has said a word."""
    (tmp_path / "tests/ba/test_sums.py").write_text(
        "import os, signal\n\ndef test_ended():\n    os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    tree = small.Tree(tmp_path.with_name("copy"))
    failed, told, _ = tree.failing(["tests/ba/test_sums.py"], 60.0)
    assert failed
    assert told == "no test is named: exit code -15"


@pytest.mark.slow
def test_what_runs_the_tests_was_not_forked_from_a_process_with_threads(small, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("sys.used_before", True, raising=False)
    (tmp_path / "tests/ba/test_sums.py").write_text(
        "import sys\n\ndef test_fresh():\n    assert not hasattr(sys, 'used_before')\n"
    )
    tree = small.Tree(tmp_path.with_name("copy"))
    assert tree.failing(["tests/ba/test_sums.py"], 60.0)[:2] == (False, "")


@pytest.mark.nightly
def test_a_mutant_of_each_part_is_tried_by_tests_that_pass_without_it(mutation, every, capfd) -> None:
    picked = [random.Random(0).choice([one for one in every if one.part == part]) for part in mutation.parts()]
    rows = list(mutation.run(picked, 2))
    assert [row["part"] for row in rows] == [*mutation.parts()]
    assert {row["fate"] for row in rows} <= {"caught", "SURVIVED", "equivalent"}
    assert sum(row["fate"] == "caught" for row in rows) >= 8
    capfd.readouterr()
